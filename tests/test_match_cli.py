"""The match command as a user meets it: results, exit codes, and one clear message for whatever is wrong."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_run_cli import ENVIRONMENT, refused, snapshot, start, words
from typer.testing import CliRunner

from acino_fte.cli import app
from acino_fte.cli_common import Clock
from acino_fte.data_tools.match_files import MATCHING
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_folder import write_tracks

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "scripts" / "match_tracks.py"
SHARED = ROOT.parent / "shared" / "data"
TABLES = {"observations.csv", "tracks_3d.csv", "matches.csv", "metrics.json"}
BATS = SHARED / "bats"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Fragments of four animals in two cameras, with truth; tests must leave it as it is."""
    options = TrackSimulation(
        n_animals=4, n_frames=120, tracks="fragments", missed=0.05, clutter=0.05, seed=5
    )
    return write_tracks(simulate_tracks(options), tmp_path_factory.mktemp("recordings") / "birds")


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


def match(*arguments):
    """The command in this process."""
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, ["match", *map(str, arguments)])


def metrics_of(folder):
    return json.loads((Path(folder) / "metrics.json").read_text())


# --- what works --------------------------------------------------------------------------------------


def test_the_script_from_end_to_end(recording, here):
    before = snapshot(recording)
    result = start(sys.executable, SCRIPT, recording, "-o", "out/birds", "--fps", "30", cwd=here)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    assert snapshot(recording) == before
    out = here / "out" / "birds"
    assert {p.name for p in out.iterdir()} == set(MATCHING.files)
    assert {p.name for p in out.parent.iterdir()} == {"birds"}  # no temporary folder is left
    figures = {p.name for p in (out / "figures").iterdir()}
    assert {f"{name}.{kind}" for name in ("tracks_3d", "timeline") for kind in ("png", "pdf")} <= figures
    metrics = metrics_of(out)
    assert metrics["recording"] == "birds"
    assert metrics["fps"] == 30.0
    assert metrics["n_animals"] == 4
    assert metrics["truth"]["pairing_accuracy"] > 0.99
    assert metrics["truth"]["recall"] > 0.99
    for part in ("4 animals in 120 frames of 2 cameras", "noise", "pairing accuracy", "NEES/3", "written to"):
        assert part in result.stdout
    page = (out / "report.html").read_text()
    assert "http" not in page.replace("http-equiv", "")
    assert "@" not in page.split("<script")[0].split("</style>")[1]


def test_out_has_a_default_and_quiet_is_quiet(recording, here):
    result = match(recording, "-q", "--no-figures", "--format", "csv")
    assert result.exit_code == 0
    assert result.output == ""
    assert {p.name for p in (here / "out" / "birds").iterdir()} == TABLES


def test_a_result_is_replaced_and_foreign_files_are_not(recording, here):
    arguments = (recording, "-q", "--no-figures", "-o", here / "out")
    assert match(*arguments).exit_code == 0
    assert match(*arguments, "--format", "netcdf").exit_code == 0
    assert (here / "out" / "tracks_3d.nc").is_file()
    (here / "out" / "notes.txt").write_text("mine")
    refused(match(*arguments), "other files added", "notes.txt")
    assert (here / "out" / "notes.txt").read_text() == "mine"


def test_options_reach_the_matching(recording, here):
    chosen = ("--noise-px", 4, "--max-gap", 0.5, "--encounter", 5, "--no-follow", "--min-confidence", 0.9)
    assert match(recording, "-q", "--no-figures", "-o", "out", *chosen).exit_code == 0
    found = metrics_of("out")
    expected = {"noise_px": 4.0, "max_gap_s": 0.5, "encounter": 5.0, "follow": False, "min_confidence": 0.9}
    assert found["options"].items() >= expected.items()
    assert found["noise_px"]["total"] == 4.0
    assert set(found["points_3d"]["by_source"]) == {"triangulated"}


@pytest.mark.parametrize("sets", [1, 3])
def test_the_thesis_s_method(recording, here, sets):
    chosen = ("--method", "thesis", "--sets", sets, "--fixed", "--gate-px", 40)
    result = match(recording, "--no-figures", "-o", "out", *chosen)
    assert result.exit_code == 0, result.output
    found = metrics_of("out")
    assert found["method"] == "thesis"
    assert found["options"]["sets"] == sets
    assert found["options"]["fixed"]
    assert found["options"]["gate_px"] == 40.0
    assert found["truth"]["pairing_accuracy"] > 0.5
    assert pd.read_csv("out/observations.csv").confidence.isna().all()


def test_files_can_be_named(recording, here, tmp_path):
    apart = tmp_path / "apart"
    apart.mkdir()
    for old, new in (("cameras.json", "rig.json"), ("cam0.csv", "left.csv"), ("cam1.csv", "right.csv")):
        shutil.copy(recording / old, apart / new)
    named = ("--tracks", f"cam0={apart / 'left.csv'}", "--tracks", f"cam1={apart / 'right.csv'}")
    truth = ("--truth", recording / "truth_3d.csv", "--cameras", apart / "rig.json")
    result = match(apart, "-q", "--no-figures", "-o", "out", *named, *truth)
    assert result.exit_code == 0, result.output
    assert metrics_of("out")["truth"] is None  # no true animals beside the tracks
    assert metrics_of("out")["n_animals"] == 4


@pytest.mark.parametrize("method", ["tracks", "thesis"])
def test_tracks_can_be_forgotten(recording, here, method):
    """The names of the tracks stay in the tables, but nothing comes of them."""
    result = match(recording, "-q", "--no-figures", "-o", "out", "--bare", "--method", method)
    assert result.exit_code == 0, result.output
    table = pd.read_csv("out/observations.csv")
    given = pd.read_csv(recording / "cam0.csv")
    np.testing.assert_array_equal(table.track[: len(given)], given.track)
    assert metrics_of("out")["truth"]["pairing_accuracy"] > 0.5
    if method == "tracks":
        assert not metrics_of("out")["options"]["tracks"]


def test_rows_without_coordinates_are_told_and_kept(mine, here):
    table = pd.read_csv(mine / "cam0.csv")
    table.loc[[3, 4], "x"] = np.nan
    table.to_csv(mine / "cam0.csv", index=False)
    result = match(mine, "--no-figures", "-o", "out")
    assert result.exit_code == 0
    assert "2 rows of camera 'cam0' have no coordinates" in words(result.output)
    rows = pd.read_csv("out/observations.csv")
    assert rows.group[[3, 4]].isna().all()
    assert (rows.camera == "cam0").sum() == len(table)


def test_nothing_to_match_is_said(mine, here):
    """One camera looks the other way: saved, and exit code 1."""
    for k, shift in ((0, 0.0), (1, 1.0)):
        rows = np.arange(30)
        xy = {"x": 100.0 + rows * 3, "y": 100.0 + 700 * shift + rows}
        pd.DataFrame({"frame": rows, "track": 1, **xy}).to_csv(mine / f"cam{k}.csv", index=False)
        (mine / f"cam{k}_truth.csv").unlink()
    result = match(mine, "-o", "out", "--noise-px", 1)
    assert result.exit_code == 1
    assert "nothing was matched" in words(result.output)
    assert metrics_of("out")["status"] == "nothing_matched"
    assert (Path("out") / "figures" / "tracks_3d.pdf").is_file()
    assert "Nothing was matched" in (Path("out") / "report.html").read_text()


def test_time_of_steps_adds_up(monkeypatch):
    now = iter([0.0, 1.0, 1.0, 3.0, 3.0, 7.0])
    monkeypatch.setattr("acino_fte.cli_common.time.perf_counter", lambda: next(now))
    clock = Clock()
    for step in ("noise", "matching", "noise"):
        clock.begin(step)
    clock.end()
    clock.end()
    assert clock.seconds == {"noise": 5.0, "matching": 2.0}


def test_help_is_light():
    heavy = "('numpy', 'pandas', 'matplotlib')"
    code = f"import sys, acino_fte.cli; sys.exit(any(m in sys.modules for m in {heavy}))"
    assert start(sys.executable, "-c", code, cwd=ROOT).returncode == 0
    text = words(match("--help").output)
    for part in ("--tracks", "--resolution", "--noise-px", "--no-follow", "--sets", "--format", "Example:"):
        assert part in text
    assert "PYTHONPATH" in ENVIRONMENT


# --- what does not -----------------------------------------------------------------------------------


def nothing_written(here):
    return not any(here.rglob("*"))


def test_typo_in_the_path(recording, here):
    refused(match(recording.parent / "brids"), "There is no such recording", "check the path")
    assert nothing_written(here)


def test_empty_folder(here, tmp_path):
    (tmp_path / "empty").mkdir()
    refused(match(tmp_path / "empty"), "no camera file", "cameras.json", "--cameras FILE")
    assert nothing_written(here)


def test_one_camera(mine, here):
    cameras = json.loads((mine / "cameras.json").read_text())
    (mine / "cameras.json").write_text(json.dumps(cameras[:1]))
    (mine / "cam1.csv").unlink()
    refused(match(mine), "only one camera", "two or more")
    assert nothing_written(here)


def test_wrong_kind_of_file(mine, here):
    (mine / "cam0.csv").write_bytes(b"\x89PNG\r\n\x1a\n\x00\x00")
    refused(match(mine), "cam0.csv")
    (mine / "cam0.csv").write_text("a,b\n1,2\n")
    refused(match(mine), "cam0.csv", "frame")
    refused(match(mine / "cameras.json"))
    assert nothing_written(here)


def test_words_instead_of_numbers(mine, here):
    text = (mine / "cam1.csv").read_text().replace("\n", "\nten,", 1)
    (mine / "cam1.csv").write_text(text)
    refused(match(mine), "cam1.csv")
    assert nothing_written(here)


def test_output_in_the_input(mine, here):
    before = snapshot(mine)
    refused(match(mine, "-o", mine), "is the input folder")
    refused(match(mine, "-o", mine / "out"), "inside the input folder")
    refused(match(mine, "-o", mine.parent), "holds the input folder")
    assert snapshot(mine) == before


def test_foreign_folder_is_kept(recording, here):
    (here / "thesis").mkdir()
    (here / "thesis" / "chapter.tex").write_text("years of work")
    refused(match(recording, "-o", "thesis"), "would be lost", "chapter.tex")
    assert (here / "thesis" / "chapter.tex").read_text() == "years of work"


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--noise-px", 0], ["--noise-px", "above 0"]),
        (["--noise-px", "nan"], ["--noise-px"]),
        (["--max-gap", -1], ["--max-gap"]),
        (["--min-confidence", 2], ["--min-confidence"]),
        (["--format", "xls"], ["--format", "netcdf"]),
        (["--resolution", "big"], ["--resolution", "1920x1080"]),
        (["--fps", 0], ["fps"]),
        (["--cameras", "nowhere.json"], ["nowhere.json"]),
        (["--tracks", "nowhere.csv"], ["nowhere.csv"]),
        (["--tracks", "cam0=a.csv", "--tracks", "b.csv"], ["CAMERA=FILE"]),
        (["--tracks", "cam0=a.csv", "--tracks", "cam0=b.csv"], ["two files", "cam0"]),
        (["--method", "magic"], ["--method"]),
        (["--method", "thesis", "--sets", 4], ["--sets"]),
        (["--method", "thesis", "--window", 1], ["window"]),
    ],
)
def test_impossible_options(recording, here, arguments, parts):
    refused(match(recording, "-o", "out", *arguments), *parts)
    assert nothing_written(here)


# --- recordings of others ----------------------------------------------------------------------------


@pytest.mark.skipif(not BATS.is_dir(), reason="the bats of Ushichka are not here")
def test_bats(here):
    tracks = BATS / "bats_P000-15000_xypts.csv"
    refused(match(BATS, "--tracks", tracks), "how large the images are", "--resolution WIDTHxHEIGHT")
    chosen = ("--tracks", tracks, "--resolution", "640x512", "--fps", 25)
    result = match(BATS, "--no-figures", "-o", "out", *chosen)
    assert result.exit_code == 0, result.output
    found = metrics_of("out")
    assert found["n_cameras"] == 3
    assert 11 <= found["n_animals"] <= 17
    assert found["truth"]["pairing_accuracy"] > 0.98
    assert found["truth"]["identity_switches"] == 0


HARD = SHARED / "tracks" / "synthetic" / "code_n20_s3_hard_seed0"


@pytest.mark.skipif(not HARD.is_dir(), reason="the shared synthetic tracks are not here")
def test_hard_set(here):
    result = match(HARD, "--no-figures", "-o", "out")
    assert result.exit_code == 0, result.output
    found = metrics_of("out")
    assert found["truth"]["pairing_accuracy"] >= 0.998
    assert found["truth"]["recall"] >= 0.997
    assert found["noise_px"]["total"] == pytest.approx(3.0, rel=0.1)
    rows = pd.read_csv("out/observations.csv")
    for n in range(2):
        given = pd.read_csv(HARD / f"cam{n}.csv")
        mine = rows[rows.camera == f"cam{n}"]
        np.testing.assert_array_equal(mine[["frame", "track"]], given[["frame", "track"]])
        np.testing.assert_allclose(mine[["x", "y"]], given[["x", "y"]])
