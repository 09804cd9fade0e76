"""Simulations as a whole: cameras, determinism, folders, the command, and the example."""

import json
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from acino_fte.data_tools.load import load_sequence
from acino_fte.errors import InputError
from acino_fte.kinematics import load_kinematics
from acino_fte.models import species_path
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.simulation_files import write_simulation
from acino_fte.skeleton import load_skeleton

REPOSITORY = Path(__file__).resolve().parent.parent
EXAMPLE = REPOSITORY / "examples" / "cheetah_gallop"
SHORT = SimulationOptions(n_frames=12, missing=0.2, outliers=0.05)


@pytest.fixture(scope="module")
def cheetah():
    return load_skeleton("cheetah")


@pytest.fixture(scope="module")
def run():
    """Run the command; returns its result."""
    import typer

    from acino_fte.cli_simulate import simulate as command

    app = typer.Typer()
    app.command()(command)
    return lambda *arguments: CliRunner().invoke(app, [str(a) for a in arguments])


def test_same_options_same_recording(cheetah):
    first, second = simulate(cheetah, SHORT), simulate(cheetah, SHORT)
    assert np.array_equal(first.detections.position, second.detections.position, equal_nan=True)
    assert np.array_equal(first.detections.likelihood, second.detections.likelihood)
    other = simulate(cheetah, SimulationOptions(n_frames=12, missing=0.2, outliers=0.05, seed=1))
    assert not np.array_equal(first.detections.missing, other.detections.missing)


@pytest.mark.parametrize("layout", ["sides", "ring"])
@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_cameras_look_at_the_animal(cheetah, layout, model):
    simulation = simulate(
        cheetah, SimulationOptions(layout=layout, camera_model=model, n_cameras=5, n_frames=60)
    )
    assert simulation.cameras.names == ["cam1", "cam2", "cam3", "cam4", "cam5"]
    assert {c.model for c in simulation.cameras} == {model}
    assert {c.resolution for c in simulation.cameras} == {(2704, 1520)}
    assert simulation.detections.in_image.mean() > 0.95
    head, feet = cheetah.marker("nose"), cheetah.marker("l_front_paw")
    pixels = simulation.pixels[30]
    assert np.all(pixels[:, head, 1] < pixels[:, feet, 1])  # upright images


def test_radius_and_height_of_the_cameras(cheetah):
    options = SimulationOptions(radius=6.0, height=1.7, n_frames=60, layout="sides", n_cameras=6)
    centres = np.array([c.centre for c in simulate(cheetah, options).cameras])
    assert np.allclose(np.abs(centres[:, 1]), 6.0, atol=0.2)
    assert np.allclose(centres[:, 2], 1.7)
    assert sum(centres[:, 1] > 0) == 3


def test_a_single_camera_and_a_single_frame(cheetah):
    simulation = simulate(cheetah, SimulationOptions(n_frames=1, n_cameras=1))
    assert simulation.detections.position.shape == (1, 1, 24, 2)


def test_sequence_in_memory(cheetah):
    simulation = simulate(cheetah, SHORT)
    sequence = simulation_to_sequence(simulation)
    assert (sequence.species, sequence.fps, sequence.n_frames) == ("cheetah", 120.0, 12)
    assert sequence.markers == cheetah.marker_names
    assert sequence.detections.position.dims == ("frame", "camera", "marker", "space")
    truth = load_kinematics(cheetah).positions(simulation.q)
    assert np.allclose(sequence.truth.values, truth)


def test_long_recordings_are_quick_and_in_view(cheetah):
    simulate(cheetah, SHORT)  # compiles
    start = time.perf_counter()
    simulation = simulate(cheetah, SimulationOptions(n_frames=2000, missing=0.3, outliers=0.05))
    simulation_to_sequence(simulation)
    assert time.perf_counter() - start < 2.0
    assert simulation.detections.in_image.mean() > 0.9
    assert any("treadmill" in note for note in simulation.notes)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("missing", 1.5),
        ("outliers", -0.1),
        ("swaps", float("nan")),
        ("n_frames", 0),
        ("n_frames", 2.5),
        ("n_cameras", 0),
        ("fps", 0.0),
        ("noise_px", -1.0),
        ("noise_px", "loud"),
        ("radius", 0.0),
        ("camera_model", "omni"),
        ("layout", "line"),
        ("seed", -1),
    ],
)
def test_wrong_options_are_named(option, value):
    with pytest.raises(InputError, match=f"option '{option}' is wrong") as error:
        SimulationOptions(**{option: value})
    assert error.value.found == repr(value)
    assert error.value.expected


def test_folder_reads_back(cheetah, tmp_path):
    simulation = simulate(cheetah, SHORT)
    folder = write_simulation(simulation, tmp_path / "run")
    names = {
        "README.md",
        "sequence.yaml",
        "cameras.json",
        "dlc",
        "truth.csv",
        "truth_states.csv",
        "simulation.json",
    }
    assert {p.name for p in folder.iterdir()} == names
    assert [p.name for p in tmp_path.iterdir()] == ["run"]  # nothing temporary is left
    sequence, expected = load_sequence(folder), simulation_to_sequence(simulation)
    assert sequence.name == "run"
    assert np.allclose(
        sequence.detections.position.values, expected.detections.position.values, atol=6e-4, equal_nan=True
    )
    assert np.allclose(
        sequence.detections.likelihood.values, expected.detections.likelihood.values, atol=6e-4
    )
    assert np.allclose(sequence.truth.values, expected.truth.values, atol=6e-6)
    states = pd.read_csv(folder / "truth_states.csv")
    assert list(states) == ["frame", *cheetah.dof_names]
    assert np.allclose(states[cheetah.dof_names], simulation.q, atol=1e-6)


def test_own_species_is_copied_along(tmp_path):
    own = tmp_path / "mine.yaml"
    own.write_text(species_path("dog").read_text().replace("name: dog", "name: mine"))
    simulation = simulate(load_skeleton(own), SimulationOptions(motion="wander", n_frames=5))
    folder = write_simulation(simulation, tmp_path / "run")
    own.unlink()
    assert load_sequence(folder).markers == simulation.skeleton.marker_names
    assert "mine.yaml" not in (folder / "sequence.yaml").read_text()


def test_targets_are_only_replaced_when_asked(cheetah, tmp_path):
    simulation = simulate(cheetah, SHORT)
    folder = write_simulation(simulation, tmp_path / "run")
    (folder / "old").touch()
    with pytest.raises(InputError, match="a simulation already") as error:
        write_simulation(simulation, folder)
    assert "--overwrite" in str(error.value)
    assert (folder / "old").exists()
    write_simulation(simulation, folder, overwrite=True)
    assert not (folder / "old").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    other = tmp_path / "thesis"
    other.mkdir()
    (other / "chapter.txt").touch()
    with pytest.raises(InputError, match="not a simulation"):
        write_simulation(simulation, other, overwrite=True)
    with pytest.raises(InputError, match="a file, not a folder"):
        write_simulation(simulation, other / "chapter.txt", overwrite=True)
    with pytest.raises(InputError, match="cannot be made"):
        write_simulation(simulation, other / "chapter.txt" / "run")


def test_a_failed_write_leaves_nothing(cheetah, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("acino_fte.simulation_files._write_states", fail)
    with pytest.raises(OSError, match="disk full"):
        write_simulation(simulate(cheetah, SHORT), tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_command_writes_a_sequence(run, tmp_path):
    flags = (
        "--species human --motion walk --frames 8 --cameras 4 --noise-px species --quantise --no-occlusion"
    )
    result = run(tmp_path / "walk", *flags.split())
    assert result.exit_code == 0, result.output
    sequence = load_sequence(tmp_path / "walk")
    assert (sequence.n_frames, len(sequence.cameras), sequence.species) == (8, 4, "human")
    recorded = json.loads((tmp_path / "walk" / "simulation.json").read_text())["command"]
    for flag in (
        "--frames 8",
        "--cameras 4",
        "--noise-px species",
        "--quantise",
        "--no-occlusion",
        "--seed 0",
    ):
        assert flag in recorded


IMPERFECT = "--delay-ms 4 --moved-mm 20 --moved-deg 0.5 --proportions 0.05 --offsets-mm 10"


def test_command_writes_imperfections_and_how_to_make_them_again(run, tmp_path):
    result = run(tmp_path / "a", *f"--frames 8 --swaps 0.4 --seed 3 {IMPERFECT}".split())
    assert result.exit_code == 0, result.output
    recorded = json.loads((tmp_path / "a" / "simulation.json").read_text())["command"]
    assert IMPERFECT in recorded
    again = run(tmp_path / "b", *shlex.split(recorded)[3:])
    assert again.exit_code == 0, again.output
    first, second = (load_sequence(tmp_path / name) for name in "ab")
    assert first.truth_parameters == second.truth_parameters
    assert first.detections.equals(second.detections)
    assert len(first.truth_parameters["swapped"]) > 5


def test_command_draws_from_the_prior(run, tmp_path):
    flags = "--motion prior --frames 8 --noise-scale 0.5 --prior-width 0.2"
    result = run(tmp_path / "a", *flags.split())
    assert result.exit_code == 0, result.output
    options = json.loads((tmp_path / "a" / "simulation.json").read_text())["options"]
    assert (options["motion"], options["noise_scale"], options["prior_width"]) == ("prior", 0.5, 0.2)


def test_help_lists_the_imperfections(run):
    shown = run("--help").output
    for flag in [*IMPERFECT.split()[::2], "--noise-scale", "--prior-width"]:
        assert flag in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--motion galop", "did you mean 'gallop'"),
        ("--motion walk", "does not fit"),
        ("--species cheeta", "did you mean 'cheetah'"),
        ("--noise-px loud", "neither a number of pixels nor 'species'"),
        ("--missing 2", "missing"),
        ("--frames 0", "frames"),
        ("--camera-model omni", "camera-model"),
        ("--delay-ms -1", "delay-ms"),
        ("--delay-ms nan", "delay-ms"),
        ("--delay-ms 2 --motion prior", "no camera can be late"),
        ("--moved-mm far", "moved-mm"),
        ("--moved-deg 90", "moved-deg"),
        ("--proportions 3", "proportions"),
        ("--offsets-mm -5", "offsets-mm"),
        ("--noise-scale 0", "noise-scale"),
        ("--prior-width 0", "prior-width"),
    ],
)
def test_wrong_arguments_leave_with_2_and_a_message(run, tmp_path, arguments, message):
    result = run(tmp_path / "x", *arguments.split())
    assert result.exit_code == 2
    assert message in result.output
    assert "Traceback" not in result.output
    assert not (tmp_path / "x").exists()


def test_existing_target_is_refused_before_the_work(run, tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "precious").touch()
    result = run(tmp_path / "x", "--overwrite")
    assert result.exit_code == 2
    assert "left alone" in result.output


def test_script_runs_from_a_checkout(tmp_path):
    script = REPOSITORY / "scripts" / "simulate.py"
    command = [sys.executable, str(script), str(tmp_path / "x"), "--motion", "gallop", "--frames", "5"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "x" / "sequence.yaml").is_file()


def test_help_imports_nothing_heavy():
    code = "import sys, acino_fte.cli_simulate; print('numpy' in sys.modules, 'sympy' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["False", "False"]


def test_the_example_is_made_by_the_command_recorded_in_it(run, tmp_path):
    recorded = json.loads((EXAMPLE / "simulation.json").read_text())["command"]
    assert recorded in (EXAMPLE / "README.md").read_text()
    python, script, _, *flags = shlex.split(recorded)
    assert (python, script) == ("python", "scripts/simulate.py")
    again = tmp_path / EXAMPLE.name
    result = run(again, *flags)
    assert result.exit_code == 0, result.output
    files = sorted(p.relative_to(EXAMPLE) for p in EXAMPLE.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    assert (again / "sequence.yaml").read_text() == (EXAMPLE / "sequence.yaml").read_text()
    for file in files:
        if file.suffix == ".csv":
            _assert_same_table(EXAMPLE / file, again / file)
    old, new = load_sequence(EXAMPLE), load_sequence(again)
    for a, b in zip(old.cameras, new.cameras, strict=True):
        assert np.allclose(a.rotation, b.rotation, atol=1e-9)
        assert np.allclose(a.translation, b.translation, atol=1e-9)


def _assert_same_table(first, second):
    """Equal text, and numbers equal to the last digit written (which may be rounded either way)."""
    a, b = (pd.read_csv(f, header=None, dtype=str).to_numpy(dtype=object) for f in (first, second))
    assert a.shape == b.shape
    for x, y in zip(a.ravel(), b.ravel(), strict=True):
        if x != y and not (pd.isna(x) and pd.isna(y)):
            assert float(x) == pytest.approx(float(y), abs=1.5e-3 if "dlc" in str(first) else 1.5e-5)


def test_the_example_is_what_the_readme_promises():
    assert sum(p.stat().st_size for p in EXAMPLE.rglob("*") if p.is_file()) <= 1_000_000
    options = json.loads((EXAMPLE / "simulation.json").read_text())["options"]
    assert (options["noise_px"], options["outliers"], options["missing"]) == (2.0, 0.05, 0.3)
    assert not options["quantise"]
    sequence = load_sequence(EXAMPLE)
    assert not sequence.warnings
    assert (sequence.n_frames, len(sequence.cameras), len(sequence.markers)) == (120, 6, 24)
    projected = sequence.cameras.project(sequence.truth.values)
    assert all(camera.inside(projected[:, c]).all() for c, camera in enumerate(sequence.cameras))
    text = "".join(p.read_text() for p in EXAMPLE.rglob("*") if p.is_file())
    assert str(REPOSITORY) not in text
