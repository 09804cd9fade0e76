"""The run command as a user meets it: results, exit codes, and one clear message for whatever is wrong."""

import json
import os
import re
import shutil
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import typer
import xarray as xr
import yaml
from typer.testing import CliRunner

import acino_fte
from acino_fte.cli import app
from acino_fte.plots import FIGURES
from acino_fte.result_files import FILES
from acino_fte.simulate import SimulationOptions, simulate
from acino_fte.simulation_files import write_simulation
from acino_fte.skeleton import load_skeleton

CODE = Path(acino_fte.__file__).parent.parent
SCRIPT = Path(__file__).resolve().parent.parent / "scripts" / "run_fte.py"
PLAIN = ("--fit", "none", "--noise", "table", "--no-swaps")  # quick, where the estimate is not the matter
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(CODE), "COLUMNS": "200", "MPLBACKEND": "Agg"}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A short simulated recording on disk; tests must leave it as it is."""
    options = SimulationOptions(n_frames=12, n_cameras=4, missing=0.1, outliers=0.02)
    folder = tmp_path_factory.mktemp("recordings") / "gallop"
    return write_simulation(simulate(load_skeleton("cheetah"), options), folder)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def snapshot(folder):
    """Every file of a folder with its content and time of change."""
    return {
        str(p.relative_to(folder)): (p.stat().st_mtime_ns, sha256(p.read_bytes()).hexdigest())
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def run(*arguments):
    """The command in this process."""
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, ["run", *map(str, arguments)])


def start(*command, cwd):
    return subprocess.run(command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=300)


def words(text):
    """A message without the frame and the line breaks that the terminal adds."""
    return re.sub(r"[\s│╭╮╰╯─]+", " ", text)


def refused(result, *parts):
    """Exit code 2 and one message with all these parts in it, and no traceback."""
    text = words(result.output)
    assert result.exit_code == 2, result.output
    for part in parts:
        assert part in text, f"{part!r} is not in: {text}"
    assert "Traceback" not in text
    assert len(re.findall(r"^(?:error:|╭─+ Error)", result.output, re.MULTILINE)) == 1
    assert isinstance(result.exception, SystemExit)


# --- what works --------------------------------------------------------------------------------------


def test_a_run(recording, here):
    before = snapshot(recording)
    result = run(recording, "--no-figures")
    assert result.exit_code == 0, result.output
    out = here / "out" / "gallop"
    found = {p.name for p in out.iterdir()}
    assert found == set(FILES) - {"figures", "depth.csv"}
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["status"] == "converged"
    assert metrics["frames"] == [0, 12]
    assert metrics["reprojection_px"]["median"] < 5
    assert metrics["truth_mm"]["mpjpe"] < 20
    assert set(metrics["seconds"]) >= {"load", "initialise", "build", "solve", "total"}
    with xr.open_dataset(out / "fte.nc") as dataset:
        assert dataset.position.dims == ("time", "space", "keypoints", "individuals")
        assert dataset.attrs["status"] == "converged"
        assert np.isfinite(dataset.position).all()
    table = pd.read_csv(out / "positions.csv")
    assert len(table) == 12 * 24
    assert yaml.safe_load((out / "sequence.yaml").read_text())["species"] == "cheetah"
    text = words(result.output)
    for part in ("gallop: cheetah, 12 frames at 120 Hz, 4 cameras", "converged after", "px", "written to"):
        assert part in text
    assert snapshot(recording) == before
    assert not [p for p in here.rglob(".*")]  # no temporary folder is left


def test_frames_and_out(recording, here):
    result = run(recording, "--frames", "4:", "-o", "somewhere/else", "--no-figures", *PLAIN)
    assert result.exit_code == 0, result.output
    metrics = json.loads((here / "somewhere" / "else" / "metrics.json").read_text())
    assert metrics["frames"] == [4, 12]
    assert not (here / "out").exists()


def test_a_second_run_replaces_the_first(recording, here):
    for frames in ("0:5", "0:6"):
        assert run(recording, "--frames", frames, "--no-figures", *PLAIN).exit_code == 0
    assert json.loads((here / "out" / "gallop" / "metrics.json").read_text())["frames"] == [0, 6]


def test_quiet(recording, here):
    result = run(recording, "--frames", ":4", "--quiet", "--no-figures")
    assert result.exit_code == 0
    assert result.output == ""


@pytest.mark.parametrize("loss", ["squared", "huber", "cauchy", "geman_mcclure"])
def test_every_loss(recording, here, loss):
    result = run(recording, "--frames", ":5", "--loss", loss, "--no-figures", "-q")
    assert result.exit_code == 0, result.output
    dataset = xr.load_dataset(here / "out" / "gallop" / "fte.nc")
    assert json.loads(dataset.attrs["options"])["problem"]["loss"]["name"] == loss


def test_explicit(recording, here):
    condensed = run(recording, "--frames", ":4", "--no-figures", "-o", "a")
    explicit = run(recording, "--frames", ":4", "--lowering", "explicit", "--no-figures", "-o", "b")
    assert (condensed.exit_code, explicit.exit_code) == (0, 0), explicit.output
    first, second = (json.loads((here / n / "metrics.json").read_text()) for n in "ab")
    assert (first["method"], second["method"]) == ("fte-condensed", "fte-explicit")
    assert second["objective"] == pytest.approx(first["objective"], rel=1e-3)


def test_figures(recording, here, monkeypatch):
    """Two of them, for time; test_plots draws all, and test_docs a whole result."""
    names = ("reprojection_error", "camera_views")
    monkeypatch.setattr("acino_fte.plots.FIGURES", {name: FIGURES[name] for name in names})
    result = run(recording, "--frames", ":4", *PLAIN)
    assert result.exit_code == 0, result.output
    figures = {p.name for p in (here / "out" / "gallop" / "figures").iterdir()}
    assert figures == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}


@pytest.mark.parametrize("command", [[str(SCRIPT)], ["-m", "acino_fte", "run"]], ids=["script", "module"])
def test_as_a_program(recording, here, command):
    options = ("--frames", ":4", "--no-figures", *PLAIN)
    done = start(sys.executable, *command, str(recording), *options, cwd=here)
    assert done.returncode == 0, done.stderr
    assert "converged" in done.stdout
    assert done.stderr == ""  # nothing but warnings and errors goes there, and no progress bar in a pipe
    assert (here / "out" / "gallop" / "fte.nc").is_file()
    done = start(sys.executable, *command, "nowhere", cwd=here)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "nowhere" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("command", [[str(SCRIPT)], ["-m", "acino_fte", "run"]], ids=["script", "module"])
def test_help(here, command):
    done = start(sys.executable, *command, "--help", cwd=here)
    assert done.returncode == 0
    for part in ("SEQUENCE", "--species", "--frames", "START:STOP", "--likelihood", "0.5", "--max-iter"):
        assert part in done.stdout


# --- unconverged and interrupted ---------------------------------------------------------------------


def test_an_unconverged_run_is_saved_and_marked(recording, here):
    before = snapshot(recording)
    result = run(recording, "--max-iter", 1, "--no-figures")
    assert result.exit_code == 3
    assert "max_iterations" in result.output
    assert "--max-iter" in result.output
    assert "Traceback" not in result.output
    out = here / "out" / "gallop"
    assert json.loads((out / "metrics.json").read_text())["status"] == "max_iterations"
    attributes = xr.load_dataset(out / "fte.nc").attrs
    assert (attributes["status"], attributes["converged"]) == ("max_iterations", 0)
    assert "max_iterations" in (out / "report.html").read_text()
    assert snapshot(recording) == before


def test_an_unconverged_run_says_so_even_when_quiet(recording, here):
    result = run(recording, "--max-iter", 1, "--no-figures", "--quiet")
    assert result.exit_code == 3
    assert "--max-iter" in result.output


def test_an_explicit_run_out_of_iterations(recording, here):
    arguments = ("--frames", ":4", "--lowering", "explicit", "--max-iter", 1, "--no-figures", *PLAIN)
    result = run(recording, *arguments)
    assert result.exit_code == 3, result.output
    assert json.loads((here / "out" / "gallop" / "metrics.json").read_text())["status"] == "max_iterations"


INTERRUPT = """
import os, signal, sys
from acino_fte import condensed_solve

report = condensed_solve._Callbacks.after

def after(self, iteration, *rest):
    if iteration == {iteration} and {when}:
        os.kill(os.getpid(), signal.SIGINT)
    return report(self, iteration, *rest)

condensed_solve._Callbacks.after = after
sys.argv = ["acino-fte", "run", *sys.argv[1:]]
from acino_fte.cli import main
main()
"""


def test_an_interrupted_run_is_saved_and_marked(recording, here):
    """A program of its own that gets SIGINT, as by Ctrl-C, in the second iteration of its solve."""
    code = INTERRUPT.format(iteration=2, when="not self.enough")
    done = start(sys.executable, "-c", code, str(recording), "--no-figures", *PLAIN, cwd=here)
    assert done.returncode == 3, done.stderr
    assert "interrupted" in done.stderr
    assert "Traceback" not in done.stderr
    metrics = json.loads((here / "out" / "gallop" / "metrics.json").read_text())
    assert metrics["status"] == "interrupted"
    assert metrics["iterations"] <= 3
    assert xr.load_dataset(here / "out" / "gallop" / "fte.nc").attrs["status"] == "interrupted"


def test_an_interrupted_first_fit_is_saved_and_marked(recording, here):
    """The rough fit that noise and sides are judged by: what it had is kept, and nothing follows."""
    code = INTERRUPT.format(iteration=1, when="self.enough == estimate._ROUGH")
    code = code.replace("import condensed_solve", "import condensed_solve, estimate")
    done = start(sys.executable, "-c", code, str(recording), "--no-figures", cwd=here)
    assert done.returncode == 3, done.stderr
    metrics = json.loads((here / "out" / "gallop" / "metrics.json").read_text())
    assert metrics["status"] == "interrupted"
    assert "uncertainty" not in metrics


def test_an_interrupt_before_there_is_anything_to_save(recording, here):
    """While looking for a start."""
    code = INTERRUPT.format(iteration=1, when="self.enough")
    done = start(sys.executable, "-c", code, str(recording), "--no-figures", cwd=here)
    assert done.returncode == 1, done.stderr
    assert "interrupted" in done.stderr
    assert "nothing was written" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (here / "out").exists()


# --- what is wrong -----------------------------------------------------------------------------------


def _option_names():
    command = typer.main.get_command(app).commands["run"]
    options = [p for p in command.params if p.param_type_name == "option"]
    return [name for p in options for name in [*p.opts, *p.secondary_opts] if name.startswith("--")]


@pytest.mark.parametrize("name", _option_names())
def test_a_typo_in_every_option(recording, here, name):
    typo = name[:-2] + name[-1] + name[-2]
    if typo == name:
        typo = name + "s"
    refused(run(recording, typo, "1"), typo, "No such option", name)
    assert list(here.iterdir()) == []


WRONG = {
    "species": (["--species", "cheeta"], ["cheeta", "did you mean 'cheetah'"]),
    "species file": (["--species", "nothing/here.yaml"], ["nothing/here.yaml"]),
    "frames form": (["--frames", "80-190"], ["--frames", "'80-190'", "START:STOP"]),
    "frames words": (["--frames", "first:last"], ["--frames", "'first:last'", "START:STOP"]),
    "frames three": (["--frames", "1:2:3"], ["--frames", "'1:2:3'", "START:STOP"]),
    "frames outside": (["--frames", "5:100"], ["5:100", "0 ≤ START < STOP ≤ 12"]),
    "frames negative": (["--frames", "-3:5"], ["-3:5", "0 ≤ START < STOP ≤ 12"]),
    "frames empty": (["--frames", "5:5"], ["5:5", "0 ≤ START < STOP ≤ 12"]),
    "frames reversed": (["--frames", "8:4"], ["8:4", "0 ≤ START < STOP ≤ 12"]),
    "likelihood large": (["--likelihood", "2"], ["--likelihood"]),
    "likelihood word": (["--likelihood", "high"], ["--likelihood"]),
    "likelihood of all": (["--likelihood", "1"], ["likelihood"]),
    "fps zero": (["--fps", "0"], ["fps"]),
    "fps negative": (["--fps", "-120"], ["fps"]),
    "fps word": (["--fps", "fast"], ["--fps"]),
    "fps nan": (["--fps", "nan"], ["fps"]),
    "loss": (["--loss", "hubber"], ["--loss", "hubber", "huber"]),
    "noise scale": (["--noise-scale", "0"], ["noise_scale", "0"]),
    "lowering": (["--lowering", "condenced"], ["--lowering", "condensed"]),
    "hessian": (["--hessian", "newton"], ["--hessian", "gauss-newton"]),
    "max-iter": (["--max-iter", "-1"], ["--max-iter"]),
    "max-iter word": (["--max-iter", "many"], ["--max-iter"]),
    "tol": (["--tol", "0"], ["tol", "0"]),
    "max-seconds": (["--max-seconds", "0"], ["max_seconds", "0"]),
    "linear solver": (["--linear-solver", "mump"], ["linear_solver", "'mump'", "mumps"]),
    "second folder": (["another"], ["another"]),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_value(recording, here, case):
    arguments, parts = WRONG[case]
    before = snapshot(recording)
    refused(run(recording, *arguments, "--no-figures"), *parts)
    assert list(here.iterdir()) == []
    assert snapshot(recording) == before


def test_no_sequence_at_all(here):
    refused(run(), "SEQUENCE")


def test_a_folder_that_is_not_there(here):
    refused(run(here / "gallup"), "gallup")
    assert list(here.iterdir()) == []


def test_an_empty_folder(here):
    (here / "empty").mkdir()
    refused(run("empty"), "empty")
    assert list((here / "empty").iterdir()) == []


@pytest.mark.parametrize("name", ["clip.mp4", "notes.txt", "table.csv", "fte.nc"])
def test_a_file_of_the_wrong_kind(here, name):
    (here / name).write_bytes(b"\x00\x01 this is no sequence")
    refused(run(name), name)
    assert [p.name for p in here.iterdir()] == [name]


def test_a_sequence_file_that_is_no_yaml(here):
    (here / "sequence.yaml").write_text("species: [cheetah\nfps: {")
    refused(run("sequence.yaml"), "sequence.yaml")


def test_detections_that_are_all_nan(recording, here):
    folder = here / "blind"
    shutil.copytree(recording, folder)
    for file in (folder / "dlc").glob("*.csv"):
        head, *rows = file.read_text().splitlines()
        del head
        lines = file.read_text().splitlines()[:3]
        lines += [",".join([row.split(",")[0], *[""] * row.count(",")]) for row in rows[2:]]
        file.write_text("\n".join(lines) + "\n")
    refused(run(folder, "--no-figures"), "blind")
    assert not (here / "out").exists()


def test_views_of_a_single_camera(recording, here):
    """Nothing can be triangulated, and no lidar tells the depth: the result says where its size is from."""
    folder = here / "one"
    shutil.copytree(recording, folder)
    entry = yaml.safe_load((folder / "sequence.yaml").read_text())
    entry["keypoints"] = dict(list(entry["keypoints"].items())[:1])
    (folder / "sequence.yaml").write_text(yaml.safe_dump(entry))
    result = run(folder, "--no-figures")
    assert result.exit_code == 0, result.output
    size = "one camera and no lidar; the animal's size, and with it every distance, is that of the species"
    assert size in words(result.output)
    (out,) = (here / "out").iterdir()
    assert any(size in finding for finding in json.loads((out / "metrics.json").read_text())["findings"])


# --- the output folder -------------------------------------------------------------------------------


def test_out_inside_the_input(recording, here):
    before = snapshot(recording)
    for out in (recording, recording / "result", recording / "dlc" / "deep"):
        refused(run(recording, "-o", out, "--no-figures"), "input folder", "-o")
    refused(run(recording, "-o", recording.parent, "--no-figures"), "holds the input folder", "-o")
    assert snapshot(recording) == before


def test_out_that_holds_something_else(recording, here):
    (here / "thesis").mkdir()
    (here / "thesis" / "chapter1.tex").write_text("years of work")
    refused(run(recording, "-o", "thesis", "--no-figures"), "thesis", "chapter1.tex", "-o")
    assert (here / "thesis" / "chapter1.tex").read_text() == "years of work"
    assert len(list(here.rglob("*"))) == 2


def test_out_is_a_file_or_below_one(recording, here):
    (here / "file").write_text("kept")
    refused(run(recording, "-o", "file", "--no-figures"), "is a file", "-o")
    refused(run(recording, "-o", "file/deeper", "--no-figures"), "cannot be made", "-o")
    assert (here / "file").read_text() == "kept"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_out_without_permission(recording, here):
    (here / "locked").mkdir(mode=0o500)
    refused(run(recording, "-o", "locked/result", "--no-figures"), "no permission", "-o")


def test_out_is_checked_before_the_work(recording, here, monkeypatch):
    def never(*_):
        raise AssertionError("the run went on")

    monkeypatch.setattr("acino_fte.initialise.initial_trajectory", never)
    (here / "thesis").mkdir()
    (here / "thesis" / "chapter1.tex").touch()
    refused(run(recording, "-o", "thesis"), "thesis")


def test_anything_else_leaves_with_one(recording, here, monkeypatch):
    """A fault of the program is not dressed up as wrong input, and leaves no half result."""

    def broken(*_args, **_kwargs):
        raise RuntimeError("a fault of the program")

    monkeypatch.setattr("acino_fte.result_files.write_tables", broken)
    result = run(recording, "--frames", ":4", "--no-figures", *PLAIN)
    assert result.exit_code == 1
    assert isinstance(result.exception, RuntimeError)
    assert list((here / "out").iterdir()) == []
