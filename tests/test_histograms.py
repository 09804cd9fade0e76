"""The command that compares runs: what it writes, and one clear message for whatever is wrong."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import typer
from evaluation_made import make_run
from test_run_cli import snapshot
from typer.testing import CliRunner

from acino_fte.adjust_files import as_text
from acino_fte.adjustments import Adjustments
from acino_fte.cli_histograms import histograms
from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.evaluation_runs import open_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two runs of one recording, labels of a camera, and adjustments of the first run."""
    folder = tmp_path_factory.mktemp("histograms")
    for seed, name in enumerate(("day1", "day2")):
        make_run(folder, name, seed=seed)
    run = open_run(folder / "day1")
    document = Adjustments(run)
    for frame, step in ((12, 0.03), (13, 0.04), (14, 0.05)):
        before = np.array(document.before(frame, "nose"))
        document.change(frame, "nose", before + [0, 0, step], "cam1")
    write_text_whole(folder / "day1.json", as_text(document))
    pixels = run.reprojected()[2:5, 0, 0] + 6.0
    rows = [f"{f},nose,{u:.6f},{v:.6f}" for f, (u, v) in zip((12, 13, 14), pixels, strict=True)]
    (folder / "labels.csv").write_text("frame,marker,u,v\n" + "\n".join(rows), encoding="utf-8")
    return folder


def command(*arguments):
    app = typer.Typer()
    app.command()(histograms)
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, [str(a) for a in arguments])


def test_everything_in_one_folder(folder, tmp_path):
    out = tmp_path / "out"
    before = snapshot(folder)
    options = ["--labels", f"day1:cam1={folder / 'labels.csv'}", "--adjustments", folder / "day1.json"]
    done = command(folder / "day1", folder / "day2", "-o", out, *options, "--threshold-px", "8")
    assert done.exit_code == 0, done.output
    assert snapshot(folder) == before
    tables = [f"{name}{end}" for name in ("reprojection", "adjustments") for end in (".csv", ".md", ".tex")]
    parts = [f"{name}_{end}.tex" for name in ("reprojection", "adjustments") for end in ("parts", "markers")]
    assert {p.name for p in out.iterdir()} == {*tables, *parts, "figures", "evaluation.json"}
    stems = ("reprojection_histograms", "reprojection_markers", "adjustment_histograms", "adjustment_markers")
    assert {p.name for p in (out / "figures").iterdir()} == {
        f"{s}.{e}" for s in stems for e in ("png", "pdf")
    }
    for pdf in (out / "figures").glob("*.pdf"):
        assert pdf.read_bytes().startswith(b"%PDF") and b"/Subtype /Image" not in pdf.read_bytes()  # vectors
    errors = pd.read_csv(out / "reprojection.csv").set_index(["run", "name"])
    assert errors.of["day1", "all"] == "labels" and errors.of["day2", "all"] == "detections"
    assert errors.n["day1", "nose"] == 3
    assert errors.rmse["day1", "nose"] == pytest.approx(6 * np.sqrt(2), abs=1e-4)
    assert errors.outlier_ratio["day1", "nose"] == 1.0  # 8.5 px are beyond 8
    moves = pd.read_csv(out / "adjustments.csv").set_index(["run", "name"])
    assert moves.rmse["day1", "all"] == pytest.approx(0.01 * np.sqrt(50 / 3))
    assert moves.adjusted["day1", "nose"] == pytest.approx(3 / 12)
    assert "8 px" in (out / "reprojection.md").read_text(encoding="utf-8")
    record = json.loads((out / "evaluation.json").read_text(encoding="utf-8"))
    assert record["threshold"] == {"value": 8.0, "unit": "px"}
    assert record["runs"]["day1"]["identity"] == open_run(folder / "day1").identity
    assert "day2: no labels" in done.output.replace("\n", " ")
    again = command(folder / "day2", "-o", out, "--no-figures", "-q")  # an earlier one is replaced
    assert again.exit_code == 0 and not (out / "figures").exists() and not (out / "adjustments.csv").exists()


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["day"], "did you mean 'day"),
        (["empty"], "no run"),
        (["unfinished"], "unfinished"),
        (["labels.csv"], "a folder, not a file"),
        (["recording"], "no run"),
        (["day1", "day1"], "twice"),
        (["day1", "--threshold-px", "0"], "more than 0"),
        (["day1", "--threshold-px", "9", "--threshold-sd", "3"], "two thresholds"),
        (["day1", "--labels", "cam9=labels.csv"], "no camera 'cam9'"),
        (["day1", "--labels", "cam1=absent.csv"], "absent.csv"),
        (["day1", "--labels", "cam1=day1.json"], "no table of labels"),
        (["day2", "--adjustments", "day1.json"], "another run"),
        (["day1", "--adjustments", "labels.csv"], "cannot be read"),
        (["day1", "--adjustments", "day1.json", "--adjustments", "day1.json"], "Two files"),
        (["day1", "-o", "day1"], "input folder"),
        (["day1", "-o", "day1/out"], "inside the input folder"),
        (["day1", "-o", "recording"], "not a comparison of runs"),
    ],
)
def test_wrong_input_is_one_message_and_exit_2(folder, monkeypatch, arguments, words):
    monkeypatch.chdir(folder)
    (folder / "empty").mkdir(exist_ok=True)
    if not (folder / "unfinished").exists():
        shutil.copytree(folder / "day1", folder / "unfinished")
        (folder / "unfinished" / "fte.nc").unlink()
    before = snapshot(folder)
    done = command(*(["-o", "new"] if "-o" not in arguments else []), *arguments)
    assert done.exit_code == 2, done.output
    assert words in done.output and done.output.count("error:") == 1 and "Traceback" not in done.output
    assert snapshot(folder) == before and not (folder / "new").exists()
