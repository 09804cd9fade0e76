"""The compare command: every method scored on the same detections, tables to use, and clear refusals."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_run_cli import ENVIRONMENT, refused, snapshot, words
from typer.testing import CliRunner

import acino_fte.methods
from acino_fte.cli import app
from acino_fte.comparison import COLUMNS, VARIANTS, Block, Row, columns_of, mean_block
from acino_fte.comparison_files import COMPARISON
from acino_fte.comparison_tables import latex, markdown
from acino_fte.data_tools.load import load_sequence
from acino_fte.errors import InputError
from acino_fte.estimate import EstimateOptions
from acino_fte.evaluate import evaluate_holdout
from acino_fte.kinematics import load_kinematics
from acino_fte.methods import estimate
from acino_fte.result import Status
from acino_fte.simulate import SimulationOptions, simulate
from acino_fte.simulation_files import write_simulation
from acino_fte.skeleton import load_skeleton

ODD = "run_1 & 50%"  # what LaTeX and Markdown take for their own
LEFT_OUT = ["cam1", "cam4"]
SCRIPT = Path(__file__).resolve().parent.parent / "scripts" / "compare_methods.py"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """40 frames with exchanged sides, and a name that has to be escaped; tests must leave it as it is."""
    options = SimulationOptions(n_frames=40, n_cameras=4, missing=0.1, outliers=0.02, swaps=0.1)
    folder = tmp_path_factory.mktemp("recordings") / ODD
    return write_simulation(simulate(load_skeleton("cheetah"), options), folder)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in, where figures, which take time, are empty files."""

    def empty(blocks, mean, folder):
        (folder / "comparison.png").touch()
        (folder / "comparison.pdf").touch()

    monkeypatch.setattr("acino_fte.plots_comparison.save_comparison_figure", empty)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def compared(recording, tmp_path_factory):
    """Three methods with two cameras left out: the folder, and what was printed."""
    out = tmp_path_factory.mktemp("out") / "comparison"
    before = snapshot(recording)
    names = "fte-plain,sba-cameras,tri"
    result = compare(recording, "--methods", names, "--holdout-cameras", ",".join(LEFT_OUT), "-o", out)
    assert result.exit_code == 0, result.output
    assert snapshot(recording) == before
    assert {p.name for p in out.parent.iterdir()} == {out.name}  # no temporary folder is left
    return out, result.output


def compare(*arguments):
    """The command in this process."""
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, ["compare", *map(str, arguments)])


def pretend(monkeypatch, changes):
    """Let methods end otherwise than they do: method → status, or the error that it raises."""

    def otherwise(method, *args, **kwargs):
        change = changes.get(method)
        if isinstance(change, Exception):
            raise change
        result = estimate(method, *args, **kwargs)
        return replace(result, status=change) if change else result

    monkeypatch.setattr(acino_fte.methods, "estimate", otherwise)


# --- the numbers -------------------------------------------------------------------------------------


def test_files_and_rows(compared):
    out, text = compared
    assert {p.name for p in out.iterdir()} == set(COMPARISON.files)
    table = pd.read_csv(out / "comparison.csv")
    assert list(table.method) == ["fte-plain", "sba-cameras", "tri"]
    assert set(table.sequence) == {ODD}
    assert [c.name for c in COLUMNS if c.name not in table] == []
    assert table[[c.name for c in COLUMNS]].notna().all(axis=None)
    assert table.n_detections.nunique() == 1
    assert (out / "comparison.png").stat().st_size > 10_000
    assert (out / "comparison.pdf").read_bytes().startswith(b"%PDF")
    for part in ("FTE, plain", "Left out, cross-fitted", "mean error (mm)", "written to"):
        assert part in words(text)


def test_every_method_is_scored_on_the_detections_as_they_were_read(compared, recording):
    table = pd.read_csv(compared[0] / "comparison.csv").set_index("method")
    sequence = load_sequence(recording)
    kinematics = load_kinematics(load_skeleton("cheetah"))
    truth = sequence.truth.sel(marker=kinematics.skeleton.marker_names).values
    pixels = sequence.pixels(kinematics.skeleton.marker_names, 0.5)
    changed = 0
    for name in table.index:
        variant = VARIANTS[name]
        options = EstimateOptions(fit=variant.fit, noise=variant.noise)
        result = estimate(variant.method, sequence, kinematics, options)
        changed += int((np.isfinite(pixels) & (result.observed != pixels)).any())
        errors = np.linalg.norm(result.reprojected - pixels, axis=-1)
        errors = errors[np.isfinite(errors)]
        row = table.loc[name]
        assert row.n_detections == np.isfinite(pixels).all(-1).sum()
        assert row.reprojection_median_px == pytest.approx(np.median(errors), rel=1e-6)
        assert row.reprojection_mean_px == pytest.approx(errors.mean(), rel=1e-6)
        assert row.reprojection_rmse_px == pytest.approx(np.hypot(errors.mean(), errors.std()), rel=1e-6)
        assert row.reprojection_std_px == pytest.approx(errors.std(), rel=1e-6)
        assert row.reprojection_p90_px == pytest.approx(np.quantile(errors, 0.9), rel=1e-6)
        assert row.within_20px == pytest.approx((errors <= 20).mean(), abs=1e-9)
        seen = np.isfinite(pixels).all(-1).any(axis=1)
        there = np.isfinite(result.positions).all(-1)
        assert row.coverage == pytest.approx(there[seen].mean())
        distance = np.linalg.norm(result.positions - truth, axis=-1)
        assert row.truth_mpjpe_mm == pytest.approx(1000 * np.nanmean(distance), rel=1e-6)
    assert changed == 1  # full trajectory estimation put sides right, and is scored on the wrong ones too
    assert table.coverage["tri"] < table.coverage["fte-plain"] == 1.0


def test_cameras_left_out(compared, recording):
    table = pd.read_csv(compared[0] / "comparison.csv").set_index("method")
    sequence = load_sequence(recording)
    kinematics = load_kinematics(load_skeleton("cheetah"))
    options = EstimateOptions(fit=("extrinsics",))
    result = estimate("sba", sequence, kinematics, options)
    expected = evaluate_holdout(sequence, kinematics, "sba", options, result, LEFT_OUT)
    row = table.loc["sba-cameras"]
    assert row.heldout_median_px == pytest.approx(expected["heldout_px"]["median"], rel=1e-6)
    assert row.heldout_within_20px == pytest.approx(expected["heldout_px"]["within_20px"])
    assert row.heldout_coverage == pytest.approx(expected["heldout_px"]["coverage"])
    nominal = expected["heldout_nominal_px"]
    assert row.heldout_nominal_median_px == pytest.approx(nominal["median"], rel=1e-6)
    assert row.heldout_nominal_within_20px == pytest.approx(nominal["within_20px"])


def test_the_json_has_every_metric(compared):
    found = json.loads((compared[0] / "comparison.json").read_text())
    assert found["options"]["holdout_cameras"] == "cam1,cam4"
    assert set(found["methods"]) == {"fte-plain", "sba-cameras", "tri"}
    sequence = found["sequences"][ODD]
    assert sequence["frames"] == [0, 40]
    table = pd.read_csv(compared[0] / "comparison.csv").set_index("method")
    for name, metrics in sequence["methods"].items():
        spent = metrics["seconds"]
        assert table.seconds[name] == pytest.approx(spent["initialise"] + spent["build"] + spent["solve"])
        assert metrics["n_observations"] == sequence["n_detections"]
        assert set(metrics["heldout_px"]["per_camera"]) == set(LEFT_OUT)
        numbers = {k: v for k, v in columns_of(metrics).items() if v is not None}
        assert numbers == pytest.approx(table.loc[name, list(numbers)].to_dict())
    assert "mean" not in found


def test_the_mean_gives_every_sequence_the_same_weight():
    fte, tri = VARIANTS["fte"], VARIANTS["tri"]

    def row(variant, median, truth, status="converged"):
        error = {"median": median, "coverage": 1.0}
        return Row(
            variant, status, columns_of({"reprojection_px": error, "truth_mm": truth and {"mpjpe": truth}})
        )

    lost = Row(tri, "refused", columns_of({}), notes=("nothing to see",))
    first = Block("a", "", (row(fte, 2.0, 5.0), row(tri, 3.0, 7.0)))
    second = Block("b", "", (row(fte, 4.0, None, "max_time"), lost))
    mean = mean_block([first, second])
    whole, part = mean.rows
    assert whole.numbers["reprojection_median_px"] == 3.0
    assert whole.numbers["truth_mpjpe_mm"] == 5.0  # the other sequence has none
    assert whole.numbers["heldout_median_px"] is None
    assert whole.notes == ("did not converge on 1 of them",)
    assert part.numbers["reprojection_median_px"] == 3.0
    assert part.notes == ("mean of 1 of 2 sequences",)
    text = markdown([first, second, mean])
    assert "| Triangulation (refused) | nothing to see |" in text
    assert "| FTE (max time) | 4.00 |" in text
    assert "Triangulation \\* | 3.00 |" in text


# --- the tables --------------------------------------------------------------------------------------


def cells(line, width):
    """Number of columns that a row of a LaTeX table spans."""
    assert line.endswith(r"\\")
    spans = [int(n) for n in re.findall(r"\\multicolumn\{(\d+)\}", line)]
    return len(re.findall(r"(?<!\\)&", line)) + 1 + sum(spans) - len(spans)


def balanced(text):
    """Braces and environments close, every row is full, and nothing special stands unescaped."""
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    bare = re.sub(r"\\[{}%&#_$]", "", "\n".join(lines))
    assert bare.count("{") == bare.count("}")
    assert bare.count("$") % 2 == 0
    assert not re.search(r"[%#_~^]", bare)
    begun = re.findall(r"\\begin\{(\w+)\}", bare)
    assert begun == re.findall(r"\\end\{(\w+)\}", bare) == ["tabular"]
    width = len(re.search(r"\\begin\{tabular\}\{(\w+)\}", bare)[1])
    rows = [line for line in lines if "&" in line or "multicolumn" in line]
    assert [line for line in rows if cells(line, width) != width] == []
    for first, last in re.findall(r"\\cmidrule\(lr\)\{(\d+)-(\d+)\}", bare):
        assert 2 <= int(first) <= int(last) <= width
    for rule in ("toprule", "midrule", "bottomrule"):
        assert f"\\{rule}" in bare
    return rows


def test_latex_is_well_formed(compared):
    rows = balanced((compared[0] / "comparison.tex").read_text())
    assert len(rows) == 2 + 3
    assert "median (px)" in rows[1] and r"within 20 px (\%)" in rows[1] and "mean error (mm)" in rows[1]
    assert rows[0].count("Left out") == 2


def test_latex_escapes_what_comes_from_files():
    row = Row(VARIANTS["fte"], "max_iterations", columns_of({"reprojection_px": {"median": 2.345}}))
    hostile = r"a_b & \input{x} $%#~^{"
    lost = Row(VARIANTS["tri"], "refused", columns_of({}), notes=(hostile,))
    noted = replace(row, notes=(hostile,))
    text = latex([Block(hostile, "3 frames", (row, lost)), Block("b", "4 frames", (noted, lost))])
    rows = balanced(text)
    assert r"FTE (max iterations) & 2.35 \\" in rows or r"FTE (max iterations) & 2.34 \\" in rows
    assert r"\input{" not in text.replace(r"\textbackslash{}input\{", "")


def test_markdown(compared):
    lines = (compared[0] / "comparison.md").read_text().splitlines()
    table = [line for line in lines if line.startswith("|")]
    assert len(table) == 2 + 3
    assert len({line.count("|") for line in table}) == 1
    assert r"## run\_1 & 50%" in lines
    csv = pd.read_csv(compared[0] / "comparison.csv").set_index("method")
    assert f"| FTE, plain | {csv.reprojection_median_px['fte-plain']:.2f} |" in table[2]


# --- several sequences, and methods that fail ---------------------------------------------------------


def test_two_sequences_of_one_name_and_one_that_cannot_be_read(recording, here):
    other = here / "later" / ODD
    shutil.copytree(recording, other)
    (here / "empty").mkdir()
    result = compare(recording, other, "empty", "--methods", "tri", "--frames", ":6")
    assert result.exit_code == 0, result.output
    out = here / "out" / "comparison"
    table = pd.read_csv(out / "comparison.csv")
    assert list(table.sequence) == [f"{recording.parent.name}/{ODD}", f"later/{ODD}", "empty"]
    assert list(table.status) == ["converged", "converged", "refused"]
    assert table.seconds.isna().tolist() == [False, False, True]
    assert "empty is left out" in words(result.output)
    found = json.loads((out / "comparison.json").read_text())
    assert found["mean"]["tri"]["reprojection_median_px"] == pytest.approx(
        table.reprojection_median_px.mean()
    )
    assert found["mean"]["tri"]["notes"][0] == "mean of 2 of 3 sequences"
    balanced((out / "comparison.tex").read_text())
    assert "Mean of 3 sequences" in result.output


def test_a_method_that_fails_is_a_line(recording, here, monkeypatch):
    pretend(monkeypatch, {"ekf": InputError("There is nothing to filter.", key="frames")})
    result = compare(recording, "--methods", "tri,ekf", "--frames", ":4", "-q")
    assert result.exit_code == 0, result.output
    assert "There is nothing to filter." in result.output
    out = here / "out" / "comparison"
    assert "| EKF (refused) | There is nothing to filter. |" in (out / "comparison.md").read_text()
    assert "refused: There is nothing to filter." in (out / "comparison.tex").read_text()
    row = pd.read_csv(out / "comparison.csv").iloc[1]
    assert (row.status, row.note) == ("refused", "There is nothing to filter.")
    methods = json.loads((out / "comparison.json").read_text())["sequences"][ODD]["methods"]
    assert methods["ekf"]["reason"].startswith("There is nothing to filter.")


def test_a_method_that_fails_only_without_a_camera(recording, here, monkeypatch):
    def holdout(*_):
        raise InputError("Two cameras are not enough.")

    monkeypatch.setattr("acino_fte.evaluate.evaluate_holdout", holdout)
    result = compare(recording, "--methods", "tri", "--frames", ":4", "--holdout-cameras", "each", "-q")
    assert result.exit_code == 0, result.output
    row = pd.read_csv(here / "out" / "comparison" / "comparison.csv").iloc[0]
    assert row.note == "without a camera: Two cameras are not enough."
    assert np.isfinite(row.reprojection_median_px) and np.isnan(row.heldout_median_px)


def test_when_nothing_works_the_input_is_wrong(recording, here, monkeypatch):
    pretend(monkeypatch, {"tri": InputError("No rays meet."), "ekf": InputError("No filter.")})
    refused(compare(recording, "--methods", "tri", "--frames", ":4", "-q"), "No rays meet.")
    result = compare(recording, "--methods", "tri,ekf", "--frames", ":4")
    assert result.exit_code == 2
    assert "No method could be applied. found: No rays meet. No filter." in words(result.output)
    assert not list(here.iterdir())


@pytest.mark.parametrize("status", [Status.MAX_ITERATIONS, Status.FAILED])
def test_unconverged(recording, here, monkeypatch, status):
    pretend(monkeypatch, {"sba": status})
    result = compare(recording, "--methods", "sba,tri", "--frames", ":4")
    assert result.exit_code == 3
    assert f"SBA ({str(status).replace('_', ' ')})" in result.output
    table = pd.read_csv(here / "out" / "comparison" / "comparison.csv")
    assert list(table.status) == [str(status), "converged"]
    assert table.reprojection_median_px.notna().all()


def test_interrupted(recording, here, monkeypatch):
    pretend(monkeypatch, {"sba": Status.INTERRUPTED})
    result = compare(recording, "--methods", "sba,tri", "--frames", ":4")
    assert result.exit_code == 1
    assert "nothing was written" in words(result.output)
    assert not list(here.iterdir())


# --- what is refused ---------------------------------------------------------------------------------


def test_typos(recording, here):
    refused(compare(recording, "--methods", "fte,ekv"), "no method 'ekv'; did you mean 'ekf'?", "--methods")
    refused(compare(recording, "--methods", "sba-camera"), "did you mean 'sba-cameras'?")
    refused(compare(recording, "--methods", ","), "No method is named")
    refused(compare(recording, "--frames", "9"), "START:STOP")
    refused(compare(recording, "--holdout-cameras", "cam9"), "no camera 'cam9'")
    refused(compare(recording, recording), "named twice")
    assert not list(here.iterdir())


def test_folders_that_hold_nothing(here):
    (here / "empty").mkdir()
    (here / "bare").mkdir()
    refused(compare("empty"), "empty")
    result = compare("empty", "bare")
    assert result.exit_code == 2
    assert "No method could be applied" in result.output
    refused(compare("absent"), "absent")
    assert not (here / "out").exists()


def test_the_output_folder(recording, here):
    arguments = (recording, "--methods", "tri", "-q", "-o", here / "table")
    assert compare(*arguments, "--frames", ":4").exit_code == 0
    assert compare(*arguments, "--frames", ":5").exit_code == 0  # an earlier comparison is replaced
    found = json.loads((here / "table" / "comparison.json").read_text())
    assert found["sequences"][ODD]["frames"] == [0, 5]
    (here / "table" / "notes.txt").write_text("mine")
    refused(compare(*arguments), "earlier comparison with other files added", "notes.txt")
    assert (here / "table" / "notes.txt").read_text() == "mine"
    (here / "other").mkdir()
    (here / "other" / "metrics.json").write_text("{}")
    refused(compare(recording, "-o", here / "other"), "not a comparison of this program")
    refused(compare(recording, "-o", recording / "table"), "lies inside the input folder")
    assert {p.name for p in here.iterdir()} == {"table", "other"}


def test_the_script(here):
    done = subprocess.run(
        [sys.executable, SCRIPT, "--help"], cwd=here, env=ENVIRONMENT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    text = words(done.stdout)
    assert "--holdout-cameras" in text and "C + 1 times as long" in text
