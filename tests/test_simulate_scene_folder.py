"""Folders of simulated scenes, the command that makes them, and the example."""

import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from data_tools_synthetic import message
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from acino_fte.data_tools.colmap import read_colmap
from acino_fte.data_tools.colmap_images import keyed_cameras, parse_image_names
from acino_fte.data_tools.scene_folder import write_scene
from acino_fte.data_tools.scene_scale import parse_distance
from acino_fte.data_tools.simulate_scene import SceneSimulation, simulate_scene
from acino_fte.data_tools.tracks import read_scene_tracks

REPOSITORY = Path(__file__).resolve().parents[1]
EXAMPLE = REPOSITORY / "examples" / "wand_rig"
SHORT = SceneSimulation(n_frames=64, n_landmarks=100, landmarks_per_image=10, outliers=0.05, swaps=1)


@pytest.fixture(scope="module")
def run():
    """Run the command; returns its result."""
    import typer

    from acino_fte.cli_simulate_scene import simulate_scene as command

    app = typer.Typer()
    app.command()(command)
    return lambda *arguments: CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.mark.parametrize("layout", ["prefix", "folder"])
@pytest.mark.parametrize("lens", ["OPENCV", ("PINHOLE", "OPENCV_FISHEYE", "SIMPLE_RADIAL", "OPENCV")])
def test_a_folder_reads_back(tmp_path, layout, lens):
    pytest.importorskip("pycolmap")
    scene = simulate_scene(replace(SHORT, lens=lens))
    folder = write_scene(scene, tmp_path / "s", layout=layout)
    model = read_colmap(folder)
    said = yaml.safe_load((folder / "scene.yaml").read_text())
    assert said["fps"] == 30.0
    keyed = keyed_cameras(model, parse_image_names(model.names, said["pattern"]))
    for mine, theirs in zip(scene.cameras(), keyed, strict=True):
        assert (mine.name, mine.model_id, mine.lens.model) == (
            theirs.name,
            theirs.model_id,
            theirs.lens.model,
        )
        np.testing.assert_array_equal(mine.frame, theirs.frame)
        np.testing.assert_allclose(theirs.rotation, mine.rotation, atol=1e-12)
        np.testing.assert_allclose(theirs.translation, mine.translation, atol=1e-12)
        point = np.array([0.3, -0.2, 1.0])
        np.testing.assert_allclose(theirs.lens.project(point), mine.lens.project(point), atol=1e-9)
    np.testing.assert_allclose(model.cloud.xyz, scene.cloud().xyz, atol=1e-6)
    np.testing.assert_allclose(model.observed_xy.mean(0), scene.structure.xy.mean(0), atol=1e-3)
    tracks = read_scene_tracks(folder / "tracks", [c.name for c in keyed]).tracks
    for mine, read in zip(scene.tracks(), tracks, strict=True):
        order = np.lexsort((mine.frame, np.array(mine.labels)[mine.track]))
        again = np.lexsort((read.frame, np.array(read.labels)[read.track]))
        np.testing.assert_array_equal(mine.frame[order], read.frame[again])
        np.testing.assert_allclose(read.xy[again], mine.xy[order], atol=6e-4)


def test_the_truth_is_there(tmp_path):
    scene = simulate_scene(SHORT)
    folder = write_scene(scene, tmp_path / "s")
    truth = pd.read_csv(folder / "truth_3d.csv")
    wand = truth[truth.individual == "wand_b"].sort_values("frame")[["x", "y", "z"]]
    np.testing.assert_allclose(wand, scene.true_positions[1], atol=1e-5)
    poses = pd.read_csv(folder / "truth_cameras.csv")
    own = poses[poses.camera == "cam2"]
    np.testing.assert_allclose(own[["x", "y", "z"]], scene.true_cameras[2].centre, atol=1e-6)
    turn = Rotation.from_quat(own[["qx", "qy", "qz", "qw"]]).as_matrix()
    np.testing.assert_allclose(turn, scene.true_cameras[2].rotation, atol=5e-6)
    rows = pd.read_csv(folder / "truth_tracks" / "cam1.csv")
    assert rows.outlier.sum() == scene.outlier[1].sum() > 0
    said = pd.read_csv(folder / "tracks" / "cam1.csv").individual
    assert (rows.individual != said).sum() == (scene.views[1].track != scene.views[1].animal).sum() > 0
    gauge = json.loads((folder / "simulation.json").read_text())["gauge"]
    assert gauge["scale"] == pytest.approx(scene.gauge.scale)


@pytest.mark.parametrize(
    ("change", "scale"),
    [
        ({}, "cam0-cam1"),
        ({"formation": "free"}, "wand_a"),
        ({"formation": "free", "wand": None, "swaps": 0}, None),
    ],
)
def test_known_distances_can_be_read(tmp_path, change, scale):
    folder = write_scene(simulate_scene(replace(SHORT, **change)), tmp_path / "s")
    said = yaml.safe_load((folder / "scene.yaml").read_text())
    assert ("scale" in said) == (scale is not None)
    for text in said.get("scale", []):
        assert scale in text
        assert parse_distance(text).length == (0.6 if "cam" in text else 0.5)


def test_nothing_of_anyone_is_replaced(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "precious").touch()
    scene = simulate_scene(SHORT)
    assert "left alone" in str(message(write_scene, scene, tmp_path / "s", overwrite=True))
    write_scene(scene, tmp_path / "t")
    assert "--overwrite" in str(message(write_scene, scene, tmp_path / "t"))
    write_scene(scene, tmp_path / "t", overwrite=True)


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("disk full")

    monkeypatch.setattr("acino_fte.data_tools.scene_folder._write_truth", fail)
    with pytest.raises(RuntimeError):
        write_scene(simulate_scene(SHORT), tmp_path / "s")
    assert not list(tmp_path.iterdir())


FLAGS = (
    "--frames 40 --fps 50 --path orbit --formation free --cameras 2 --distance 4 --lane 9 "
    "--lens OPENCV,RADIAL --clock-offset 0,-2.5 --clock-drift 0,0.001 --key-step 4 --unregistered 0.1 "
    "--centre-noise-mm 1 --turn-noise 0.1 --landmarks 80 --no-gauge --layout folder --wand 0 --animals 2 "
    "--noise-px 0.5 --missed 0.2 --outliers 0.1 --swaps 1 --seed 3"
)


def test_the_recorded_command_makes_the_same_folder(run, tmp_path):
    first = run(tmp_path / "a", *FLAGS.split())
    assert first.exit_code == 0, first.output
    command = json.loads((tmp_path / "a" / "simulation.json").read_text())["command"]
    program, name, _, *flags = shlex.split(command)
    assert (program, name) == ("acino-fte", "simulate-scene")
    assert sorted(flags) == sorted([*FLAGS.split()])
    assert run(tmp_path / "b", *flags).exit_code == 0
    files = [p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*") if p.is_file()]
    assert len(files) > 8
    for file in files:
        if file.suffix in (".csv", ".txt", ".yaml"):
            assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--lens GOPRO", "OPENCV_FISHEYE"),
        ("--lens OPENCV,PINHOLE", "one for each"),
        ("--clock-offset soon", "no list of numbers"),
        ("--clock-offset 1,2", "for each camera"),
        ("--formation fixed", "path 'orbit'"),
        ("--wand 0 --animals 0", "an animal at least"),
        ("--missed 2", "missed"),
        ("--path swim", "path"),
    ],
)
def test_wrong_arguments_leave_with_2_and_a_message(run, tmp_path, arguments, said):
    result = run(tmp_path / "x", *arguments.split())
    assert result.exit_code == 2
    assert said in result.output
    assert "Traceback" not in result.output
    assert not (tmp_path / "x").exists()


def test_help_imports_nothing_heavy():
    code = "import sys, acino_fte.cli_simulate_scene; print('numpy' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["False"]


def test_the_example_is_made_by_the_command_recorded_in_it(run, tmp_path):
    recorded = json.loads((EXAMPLE / "simulation.json").read_text())["command"]
    assert recorded in (EXAMPLE / "README.md").read_text()
    _, _, folder, *flags = shlex.split(recorded)
    assert folder == "examples/wand_rig"
    again = tmp_path / EXAMPLE.name
    assert run(again, *flags).exit_code == 0
    files = sorted(p.relative_to(EXAMPLE) for p in EXAMPLE.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    assert (again / "scene.yaml").read_text() == (EXAMPLE / "scene.yaml").read_text()
    for file in files:
        if file.suffix == ".csv":
            mine, theirs = pd.read_csv(EXAMPLE / file), pd.read_csv(again / file)
            pd.testing.assert_frame_equal(mine, theirs, atol=1.5e-3, rtol=0)
    assert sum(p.stat().st_size for p in EXAMPLE.rglob("*") if p.is_file()) < 1_500_000
