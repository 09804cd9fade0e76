"""The scene command as a user meets it: results, exit codes, and one clear message for whatever is wrong."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_run_cli import refused, snapshot, start, words
from typer.testing import CliRunner

pytest.importorskip("pycolmap")

from acino_fte.cli import app
from acino_fte.cli_scene_input import gap_frames, rig_choice
from acino_fte.data_tools.scene_files import SCENE
from acino_fte.data_tools.scene_folder import write_scene
from acino_fte.data_tools.scene_settings import SceneSettings, read_scene_settings
from acino_fte.data_tools.simulate_scene import SceneSimulation, simulate_scene
from acino_fte.errors import InputError

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "scripts" / "triangulate_scene.py"
TABLES = {"tracks_3d.csv", "points_3d.csv", "observations.csv", "camera_paths.csv", "metrics.json"}
PLAIN = ("-q", "--no-figures", "--format", "csv")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Four cameras on a rig over a wand and an animal; tests must leave it as it is."""
    options = SceneSimulation(n_frames=121, n_landmarks=150, landmarks_per_image=12, seed=3)
    return write_scene(simulate_scene(options), tmp_path_factory.mktemp("recordings") / "lawn")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def mine(recording, tmp_path):
    """A copy of the recording to spoil."""
    return Path(shutil.copytree(recording, tmp_path / "mine"))


def scene(*arguments):
    """The command in this process."""
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, ["scene", *map(str, arguments)])


def metrics_of(folder):
    return json.loads((Path(folder) / "metrics.json").read_text())


# --- what works --------------------------------------------------------------------------------------


def test_the_script_from_end_to_end(recording, here):
    before = snapshot(recording)
    truth = recording / "truth_3d.csv"
    result = start(sys.executable, SCRIPT, recording, "-o", "out/wand", "--truth", truth, cwd=here)
    assert result.returncode == 0, result.stderr
    assert "Traceback" not in result.stderr
    assert snapshot(recording) == before
    out = here / "out" / "wand"
    assert {p.name for p in out.iterdir()} == set(SCENE.files)
    assert {p.name for p in out.parent.iterdir()} == {"wand"}  # no temporary folder is left
    assert {p.name for p in (out / "figures").iterdir()} == {
        f"{name}.{kind}" for name in ("scene", "quality") for kind in ("png", "pdf")
    }
    metrics = metrics_of(out)
    assert metrics["status"] == "triangulated"
    assert metrics["fps"] == 30.0
    assert metrics["n_cameras"] == 4
    assert len(metrics["individuals"]) == 3
    assert metrics["scale"]["distances"][0]["length_m"] == 0.6
    assert metrics["rigs"][0]["cameras"] == ["cam0", "cam1", "cam2", "cam3"]
    assert metrics["truth_mm"]["tracks"]["views"]["rmse"] < 20.0
    assert metrics["truth_mm"]["tracks"]["views"]["rmse"] < metrics["truth_mm"]["points"]["views"]["rmse"]
    assert metrics["options"]["rig"] == "auto"
    assert metrics["seconds"]["total"] > 0.0
    said = "3 individuals in 121 frames of 4 cameras", "points", "noise", "rig of cam0", "truth", "written to"
    for part in said:
        assert part in result.stdout
    table = pd.read_csv(out / "tracks_3d.csv")
    assert len(table) == metrics["n_points"]["all"]
    assert set(table.source) <= {"views", "single", "interpolated"}


def test_out_has_a_default_and_quiet_says_warnings_only(recording, here):
    result = scene(recording, *PLAIN)
    assert result.exit_code == 0, result.output
    assert result.stdout == ""
    assert "written" not in result.output
    assert {p.name for p in (here / "out" / "lawn").iterdir()} == TABLES


def test_options_reach_the_scene(recording, here):
    chosen = ("--rig", "cam0,cam1", "--no-smooth", "--noise-px", 2.5, "--scale", "cam0-cam1=6", "--fps", 60)
    assert scene(recording, *PLAIN, *chosen, "--gravity", "none", "-o", "out").exit_code == 0
    found = metrics_of("out")
    assert found["noise_px"] == 2.5
    assert found["fps"] == 60.0
    assert [rig["cameras"] for rig in found["rigs"]] == [["cam0", "cam1"]]
    assert found["points_3d"]["smooth"] is False
    assert found["scale"]["distances"][0]["length_m"] == 6.0
    assert found["axes"]["how"] == "the model's own axes"
    assert not (here / "out" / "points_3d.csv").exists()
    wand = pd.read_csv(here / "out" / "tracks_3d.csv")
    assert np.ptp(wand.x) > 0


def test_gaps_are_frames_or_seconds(mine, here):
    """An animal whose dots are missing for half a second."""
    for path in (mine / "tracks").glob("*.csv"):
        table = pd.read_csv(path)
        table[(table.frame < 50) | (table.frame > 65)].to_csv(path, index=False)
    counts = []
    for gap in ("0", "2s"):
        assert scene(mine, *PLAIN, "--max-gap", gap, "-o", "out").exit_code == 0
        counts.append(metrics_of("out")["n_points"]["interpolated"])
    assert counts[0] == 0 < counts[1]


def test_clocks_are_brought_together(tmp_path, here):
    late = SceneSimulation(
        n_frames=241, n_landmarks=150, landmarks_per_image=12, clock_offset=(0.0, 5.0, 0.0, 0.0), seed=4
    )
    folder = write_scene(simulate_scene(late), tmp_path / "late")
    result = scene(folder, "--no-figures", "--format", "csv", "--time-offsets", "-o", "out")
    assert result.exit_code == 0, result.output
    found = metrics_of("out")["time_offsets"]
    offsets = {name: one["offset_frames"] for name, one in found["cameras"].items()}
    assert offsets["cam1"] - offsets["cam0"] == pytest.approx(5.0, abs=0.5)
    assert offsets["cam2"] - offsets["cam0"] == pytest.approx(0.0, abs=0.5)
    assert "clocks against" in result.stdout


def test_an_earlier_result_is_replaced_and_foreign_files_are_not(recording, here):
    arguments = (recording, *PLAIN, "-o", here / "out")
    assert scene(*arguments).exit_code == 0
    assert scene(*arguments).exit_code == 0
    (here / "out" / "notes.txt").write_text("mine")
    refused(scene(*arguments), "other files added", "notes.txt")
    assert (here / "out" / "notes.txt").read_text() == "mine"


def test_nothing_triangulated_is_saved_and_exit_1(mine, here):
    for k, path in enumerate(sorted((mine / "tracks").glob("*.csv"))):
        table = pd.read_csv(path)
        table[table.frame % 4 == k].to_csv(path, index=False)  # no two cameras see anything at one time
    result = scene(mine, *PLAIN, "-o", "out")
    assert result.exit_code == 1, result.output
    assert "nothing was triangulated" in words(result.output)
    assert metrics_of("out")["status"] == "nothing_triangulated"


# --- scene.yaml --------------------------------------------------------------------------------------


def test_the_scene_file_says_what_the_command_does_not(mine, here):
    (mine / "scene.yaml").write_text("fps: 25\nscale: [cam0-cam1=0.3]\nrig: [cam2, cam3]\ngravity: none\n")
    assert scene(mine, *PLAIN, "-o", "out", "--fps", 50).exit_code == 0
    found = metrics_of("out")
    assert found["fps"] == 50.0
    assert found["scale"]["distances"][0]["length_m"] == 0.3
    assert [rig["cameras"] for rig in found["rigs"]] == [["cam2", "cam3"]]
    assert found["axes"]["how"] == "the model's own axes"


def test_without_a_scene_file_nothing_is_said(tmp_path):
    assert read_scene_settings(tmp_path) == SceneSettings()
    (tmp_path / "scene.yaml").write_text("")
    assert read_scene_settings(tmp_path) == SceneSettings()


def test_paths_in_the_scene_file_are_beside_it(tmp_path):
    (tmp_path / "imu.csv").write_text("")
    text = "model: colmap/0\ngravity: imu.csv\nscale: a-b=1\nrig: [[a, b], [c, d]]\n"
    (tmp_path / "scene.yaml").write_text(text)
    found = read_scene_settings(tmp_path)
    assert found.model == tmp_path / "colmap" / "0"
    assert found.gravity == str(tmp_path / "imu.csv")
    assert found.scale == ("a-b=1",)
    assert found.rig == (("a", "b"), ("c", "d"))


def test_what_a_recording_is_like_can_stand_in_the_scene_file(tmp_path, mine, here):
    text = "pixel_origin: corner\nnoise_px: 1.5\ntime_offsets: true\nrig: off\n"
    (tmp_path / "scene.yaml").write_text(text)
    found = read_scene_settings(tmp_path)
    assert (found.pixel_origin, found.noise_px, found.time_offsets) == ("corner", 1.5, True)
    assert found.rig == "none"
    (mine / "scene.yaml").write_text("pixel_origin: corner\nnoise_px: 1.5\n")
    assert scene(mine, *PLAIN, "-o", "out").exit_code == 0
    assert metrics_of("out")["noise_px"] == 1.5
    assert metrics_of("out")["options"]["pixel_origin"] == "corner"
    assert scene(mine, *PLAIN, "-o", "out", "--pixel-origin", "centre").exit_code == 0
    assert metrics_of("out")["options"]["pixel_origin"] == "centre"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("fsp: 30\n", ("mean nothing", "fsp", "fps")),
        ("fps: fast\n", ("fps", "above 0", "fast")),
        ("fps: true\n", ("fps", "above 0")),
        ("rig: [cam0]\n", ("rig", "two or more")),
        ("scale: 0.6\n", ("scale", "list")),
        ("- a\n", ("no table",)),
        ("a: [\n", ("cannot be read",)),
    ],
)
def test_a_wrong_scene_file_is_refused(mine, here, text, parts):
    (mine / "scene.yaml").write_text(text)
    refused(scene(mine, *PLAIN, "-o", "out"), "scene.yaml", *parts)
    assert not (here / "out").exists()


# --- what is wrong -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("--format", "parquet"), ("--format", "netcdf, ply", "parquet")),
        (("--rig", "cam0"), ("--rig", "two cameras")),
        (("--rig", "cam0,left"), ("left",)),
        (("--max-gap", "soon"), ("--max-gap", "1.5s", "soon")),
        (("--max-pose-gap", "-3"), ("--max-pose-gap", "-3")),
        (("--noise-px", "0"), ("--noise-px", "above 0")),
        (("--fps", "-1"), ("--fps", "above 0")),
        (("--scale", "0.6"), ("known distance",)),
        (("--scale", "cam0-camX=0.6"), ("camX", "cam1")),
        (("--gravity", "moon"), ("gravity", "moon")),
        (("--tracks", "nowhere"), ("nowhere", "--tracks")),
        (("--model", "nowhere"), ("nowhere",)),
        (("--dense", "nowhere.ply"), ("nowhere.ply",)),
        (("--truth", "nowhere.csv"), ("nowhere.csv",)),
        (("--pattern", "{camera}-{frame}.tif"), ("cam0_",)),
    ],
)
def test_wrong_options_are_one_message(recording, here, arguments, parts):
    refused(scene(recording, *PLAIN, "-o", "out", *arguments), *parts)
    assert not (here / "out").exists()


def test_a_missing_folder_and_an_output_in_the_input(recording, here):
    refused(scene("nowhere", *PLAIN), "nowhere")
    refused(scene(recording, *PLAIN, "-o", recording / "out"), "inside the input")
    assert not (here / "out").exists()


def test_a_gap_in_seconds_needs_the_frame_rate(mine, here):
    (mine / "scene.yaml").unlink()
    refused(scene(mine, *PLAIN, "-o", "out", "--max-gap", "1s"), "--max-gap", "--fps")


def test_figures_that_were_begun_end_with_an_error(recording, here):
    """The process that draws is gone, and its traceback is not shown."""
    result = scene(recording, "-q", "-o", "out", "--scale", "cam0-camX=0.6")
    refused(result, "camX")
    assert {p.name for p in here.iterdir()} == set()


def test_how_gaps_and_rigs_are_written():
    assert gap_frames("--max-gap", "1.5s", 30.0) == 45
    assert gap_frames("--max-gap", "40", None) == 40
    assert gap_frames("--max-gap", None, None) is None
    assert rig_choice("Auto") == "auto"
    assert rig_choice("a, b; c,d") == (("a", "b"), ("c", "d"))
    for wrong in ("", "a", "a,b;c"):
        with pytest.raises(InputError):
            rig_choice(wrong)


def test_help_names_every_group():
    result = scene("--help")
    assert result.exit_code == 0
    for panel in ("Input", "Cameras", "World", "Tracks", "Output"):
        assert f" {panel} " in result.output
