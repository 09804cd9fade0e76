"""Adjustments by hand: undo, the file and its survival, what a drag does, which frame is next."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import typer
from data_tools_synthetic import message
from evaluation_made import CORRECTION, START, STOP, edited, make_run
from test_run_cli import ENVIRONMENT
from typer.testing import CliRunner

from acino_fte.adjust_files import as_text, positions_csv, read_adjustments
from acino_fte.adjust_session import open_session
from acino_fte.adjustments import Adjustments
from acino_fte.cli_adjust import adjust
from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError
from acino_fte.evaluation_runs import open_run
from acino_fte.evaluation_statistics import move_rows

PARAMETERS = {"time_offset_s": {"cam2": 0.003}, "extrinsics": {"cam3": CORRECTION}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two runs of one recording: 'run', with corrections, and 'other'."""
    folder = tmp_path_factory.mktemp("adjust")
    make_run(folder, "run", parameters=PARAMETERS, unplaced=(2, 5))
    make_run(folder, "other", seed=1)
    return folder


@pytest.fixture(scope="module")
def run(folder):
    return open_run(folder / "run")


@pytest.fixture
def session(run, tmp_path):
    return open_session(run, tmp_path / "a.json")


def request(frame, marker, view, pixel, **more):
    return {"frame": frame, "marker": marker, "view": view, "pixel": list(pixel), **more}


def seen(session, frame, view, marker):
    """Pixel of a marker as the page is told."""
    shown = session.frame(frame)
    c = session.run.camera_names.index(view)
    return np.array(shown["now"][c][session.run.markers.index(marker)])


# --- the document --------------------------------------------------------------------------------------


def test_undo_and_redo_go_through_every_change(run):
    document = Adjustments(run)
    here, there = np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0])
    document.change(12, "nose", here, "cam1")
    document.change(12, "nose", there, "cam2")
    document.change(13, "spine", here, "cam1")
    document.check(14)
    document.reset(12, "nose")
    states = [dict(document.entries)]
    assert [document.undo() for _ in range(5)] == [12, 14, 13, 12, 12]
    assert document.undo() is None and not document.entries and not document.checked
    np.testing.assert_array_equal(document.positions(), run.positions)
    assert [document.redo() for _ in range(5)] == [12, 12, 13, 14, 12]
    assert document.redo() is None and document.entries == states[0] and document.checked == {14}
    assert not document.reset(12, "nose")
    document.undo()
    assert document.entries[12, "nose"].after == (1.0, 2.0, 3.0)
    document.change(15, "nose", here, "cam1")
    assert not document.can_redo  # a new change ends what was taken back


def test_turns_of_the_wheel_are_one_step(run):
    document = Adjustments(run)
    document.change(12, "nose", np.full(3, 0.5), "cam1")  # a drag is a step of its own
    for k in range(4):
        document.change(12, "nose", np.full(3, k), "cam1", together=True)
    document.change(12, "nose", np.full(3, 9.0), "cam2", together=True)  # of another view
    assert document.undo() == 12 and document.entries[12, "nose"].after == (3.0, 3.0, 3.0)
    assert document.undo() == 12 and document.entries[12, "nose"].after == (0.5, 0.5, 0.5)
    document.change(12, "nose", np.full(3, 7.0), "cam1", together=True)  # after an undo it begins anew
    assert document.undo() == 12 and document.undo() == 12 and not document.entries


def test_magnitudes_against_closed_forms(run):
    """Lengths 3, 4, 5 cm: RMSE √(50/3) cm, sd √(2/3) cm; three of the positions that were looked at."""
    document = Adjustments(run)
    for k, (frame, marker) in enumerate([(12, "nose"), (13, "nose"), (13, "spine")], 3):
        before = np.array(document.before(frame, marker))
        document.change(frame, marker, before + 0.01 * k * np.array([0.6, 0.0, -0.8]), "cam1")
    document.change(12, run.markers[5], np.ones(3), "cam1")  # had no position: no length
    rows = {row["name"]: row for row in move_rows(document.moves())}
    n = len(run.markers) * (STOP - START) - 1
    assert rows["all"]["n"] == n and rows["all"]["n_adjusted"] == 3
    assert rows["all"]["adjusted"] == pytest.approx(3 / n)
    assert rows["all"]["rmse"] == pytest.approx(0.01 * np.sqrt(50 / 3))
    assert rows["all"]["sd"] == pytest.approx(0.01 * np.sqrt(2 / 3))
    assert rows["all"]["max"] == pytest.approx(0.05)
    assert rows["nose"]["n_adjusted"] == 2 and rows["nose"]["adjusted"] == pytest.approx(2 / (STOP - START))
    assert rows["l_eye"]["rmse"] is None and rows["l_eye"]["adjusted"] == 0.0
    assert document.moves().n_placed == 1
    for frame in (12, 13, 15):
        document.check(frame)
    rows = {row["name"]: row for row in move_rows(document.moves())}
    assert rows["all"]["n"] == 3 * len(run.markers) - 1  # frames 12, 13, 15
    assert rows["nose"]["adjusted"] == pytest.approx(2 / 3)


# --- the file ------------------------------------------------------------------------------------------


def test_the_file_keeps_before_and_after(run, tmp_path):
    document = Adjustments(run)
    document.change(13, "spine", np.array([1.0, 2.0, 3.0]), "cam2", {"cam2": (3.5, 4.5)})
    document.change(12, "nose", np.array([0.0, 1.0, 2.0]), "cam1")
    document.change(12, run.markers[5], np.array([4.0, 1.0, 2.0]), "cam1")
    document.check(17)
    path = tmp_path / "a.json"
    write_text_whole(path, as_text(document))
    data = json.loads(path.read_text(encoding="utf-8"))
    assert data["format"] == "acino-fte/adjustments/1" and data["run"]["sha256"] == run.identity
    first = data["adjustments"][0]
    assert (first["frame"], first["marker"], first["view"]) == (12, "nose", "cam1")
    np.testing.assert_allclose(first["before"], run.positions[12 - START, run.markers.index("nose")])
    assert first["after"] == [0.0, 1.0, 2.0] and first["time"].endswith("Z")
    assert data["adjustments"][1]["before"] is None
    again = read_adjustments(path, [run])
    assert again.entries == document.entries and again.checked == {17}
    assert as_text(again) == as_text(document)


def test_adjustments_of_another_run_are_refused(folder, run, tmp_path):
    other = open_run(folder / "other")
    path = tmp_path / "a.json"
    write_text_whole(path, as_text(Adjustments(other)))
    error = message(read_adjustments, path, [run])
    assert (
        "another run" in str(error) and other.identity[:12] in str(error) and run.identity[:12] in str(error)
    )
    assert read_adjustments(path, [run, other]).run is other
    with pytest.raises(InputError, match="another run"):
        open_session(run, path)


def entry(run, **changes):
    nose = run.positions[0, 0].tolist()
    whole = {"frame": START, "marker": "nose", "before": nose, "after": [0, 0, 1], "view": "cam1"}
    return {**whole, "time": "2026-01-01T00:00:00Z", **changes}


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"format": "acino-fte/adjustments/9"}, "format"),
        ({"adjustments": 3}, "adjustments"),
        ({"adjustments": [{"frame": 1}]}, "adjustments"),
        ({"checked": [999]}, "checked"),
        ({"adjustments": [{"frame": 999}]}, "not in the run"),
        ({"adjustments": [{"marker": "wing"}]}, "not in the run"),
        ({"adjustments": [{}, {}]}, "twice"),
        ({"adjustments": [{"before": [1, 2, 3]}]}, "before"),
        ({"adjustments": [{"before": None}]}, "before"),
        ({"adjustments": [{"after": [1, 2, float("nan")]}]}, "after"),
        ({"surplus": 1}, "surplus"),
    ],
)
def test_files_edited_by_hand_get_one_clear_message(run, tmp_path, changes, words):
    path = tmp_path / "a.json"
    write_text_whole(path, as_text(Adjustments(run)))
    if isinstance(changes.get("adjustments"), list) and changes["adjustments"] != [{"frame": 1}]:
        changes = {"adjustments": [entry(run, **c) for c in changes["adjustments"]]}
    assert words in str(message(read_adjustments, edited(path, **changes), [run]))


@pytest.mark.parametrize("content", ["", "{", "[1]", "\x00\xff"])
def test_what_is_no_such_file_is_told(run, tmp_path, content):
    path = tmp_path / "a.json"
    path.write_text(content, encoding="latin-1")
    message(read_adjustments, path, [run])
    message(read_adjustments, tmp_path / "absent.json", [run])


def test_the_adjusted_trajectory_as_csv(run):
    document = Adjustments(run)
    document.change(12, "nose", np.array(document.before(12, "nose")) + [0, 0, 0.25], "cam1")
    import io

    table = pd.read_csv(io.StringIO(positions_csv(document)))
    assert len(table) == run.positions.shape[0] * len(run.markers)
    moved = table[table.adjusted == 1]
    assert list(moved.marker) == ["nose"] and list(moved.frame) == [12]
    assert moved.moved_m.item() == pytest.approx(0.25, abs=1e-6)
    xyz = table[["x", "y", "z"]].to_numpy().reshape(run.positions.shape)
    np.testing.assert_allclose(xyz, document.positions(), atol=1e-6)


WORK = """
import sys
import numpy as np
from pathlib import Path
from acino_fte.adjust_session import open_session
from acino_fte.evaluation_runs import open_run

session = open_session(open_run(Path(sys.argv[1])), Path(sys.argv[2]))
print("ready", flush=True)
for k in range(100_000):
    frame, marker = 10 + k % 12, session.run.markers[k % 24]
    session.document.change(frame, marker, np.full(3, float(k)), "cam1")
    session.save()
    print(k, flush=True)
"""


def test_a_killed_process_loses_nothing(folder, run, tmp_path):
    """Killed (SIGKILL) amid changes: what was told to be saved is there, and work goes on from it."""
    path = tmp_path / "a.json"
    command = [sys.executable, "-c", WORK, str(folder / "run"), str(path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT)
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.3)
    process.send_signal(signal.SIGKILL)
    told = [int(line) for line in process.communicate()[0].split()]
    session = open_session(run, path)
    entries = {(e.frame, e.marker): e.after[0] for e in session.document.entries.values()}
    assert len(told) > 5
    for k in told[-12:]:
        assert entries[10 + k % 12, run.markers[k % 24]] in (k, k + 24)
    session.document.change(12, "nose", np.zeros(3), "cam1")
    session.save()
    assert read_adjustments(path, [run]).entries[12, "nose"].after == (0, 0, 0)


def test_what_cannot_be_saved_is_said_and_kept(session, monkeypatch, tmp_path):
    def full(*_):
        raise OSError(28, "No space left on device")

    before = session.path.read_text(encoding="utf-8")
    with monkeypatch.context() as m:
        m.setattr("os.fsync", full)
        session.drag(request(12, "nose", "cam1", seen(session, 12, "cam1", "nose") + 9), commit=True)
    assert "No space left" in session.problem and session.state()["problem"]
    assert session.path.read_text(encoding="utf-8") == before
    assert [p.name for p in session.path.parent.iterdir()] == ["a.json"]  # no temporary file is left
    session.save()
    assert not session.problem and len(read_adjustments(session.path, [session.run]).entries) == 1


def test_a_file_that_cannot_be_written_is_told_before_any_work(run, tmp_path):
    (tmp_path / "file").write_text("x", encoding="utf-8")
    assert "cannot be written" in str(message(open_session, run, tmp_path / "file" / "a.json"))


def test_the_work_of_another_program_is_not_overwritten(run, tmp_path):
    first, second = (open_session(run, tmp_path / "a.json") for _ in range(2))
    first.check(12)
    second.check(13)
    assert not first.problem and "another program" in second.problem
    assert read_adjustments(tmp_path / "a.json", [run]).checked == {12}


# --- what a drag does ----------------------------------------------------------------------------------


def test_one_view_moves_in_its_plane_and_two_triangulate(session):
    """cam2 is late and cam3 has a corrected pose: both are seen through as the run saw."""
    run, frame = session.run, 15
    m = run.markers.index("tail1")
    true = run.positions[frame - START, m] + [0.05, -0.08, 0.06]
    shifted = run.positions.copy()
    shifted[:, m] += [0.05, -0.08, 0.06]
    wanted = run.reprojected(shifted)[frame - START, :, m]
    assert np.abs(wanted[1] - seen(session, frame, "cam2", "tail1")).max() > 5
    session.drag(request(frame, "tail1", "cam2", wanted[1]), commit=True)
    np.testing.assert_allclose(seen(session, frame, "cam2", "tail1"), wanted[1], atol=0.02)
    alone = np.array(session.document.entries[frame, "tail1"].after)
    assert np.linalg.norm(alone - true) > 0.01  # one view does not tell the depth
    answer = session.drag(request(frame, "tail1", "cam3", wanted[2]), commit=False)
    assert set(answer["pins"]) == {"cam2", "cam3"}
    np.testing.assert_allclose(answer["xyz"], true, atol=1e-4)
    assert np.array_equal(session.document.entries[frame, "tail1"].after, alone)  # not yet let go
    session.drag(request(frame, "tail1", "cam3", wanted[2]), commit=True)
    np.testing.assert_allclose(session.document.entries[frame, "tail1"].after, true, atol=1e-5)


def test_depth_keeps_the_pixel_of_its_view(session):
    before = seen(session, 12, "cam1", "nose")
    elsewhere = seen(session, 12, "cam3", "nose")
    for _ in range(3):
        change = request(12, "nose", "cam1", before, mode="depth", factor=1.02, together=True)
        session.drag(change, commit=True)
    np.testing.assert_allclose(seen(session, 12, "cam1", "nose"), before, atol=0.01)
    assert np.abs(seen(session, 12, "cam3", "nose") - elsewhere).max() > 2
    assert session.undo() == 12 and not session.document.entries  # three turns, one step


def test_a_marker_without_a_position_is_placed_at_the_animals_distance(session):
    run, frame, marker = session.run, START + 2, session.run.markers[5]
    assert session.frame(frame)["xyz"][5] is None
    session.drag(request(frame, marker, "cam1", (960.0, 500.0)), commit=True)
    entry = session.document.entries[frame, marker]
    assert entry.before is None
    np.testing.assert_allclose(seen(session, frame, "cam1", marker), (960, 500), atol=0.02)
    distance = np.linalg.norm(run.positions[2] - run.cameras["cam1"].centre, axis=-1)
    assert np.linalg.norm(entry.after - run.cameras["cam1"].centre) == pytest.approx(np.nanmedian(distance))
    assert session.frame(frame)["moved"][5] == -1.0


def test_a_pixel_without_a_direction_moves_nothing(session):
    assert session.drag(request(12, "nose", "cam1", (1e6, 1e6)), commit=True) is None
    assert not session.document.entries


def test_the_next_frame_with_a_large_residual(run, tmp_path):
    residual = np.linalg.norm(run.residual, axis=-1)
    worst = np.nanmax(residual.reshape(len(residual), -1), axis=1)
    threshold = float(np.sort(worst[1:-1])[-3])
    session = open_session(run, tmp_path / "a.json", threshold)
    expected = [START + n for n in np.flatnonzero(worst > threshold) if n > 0]
    found, frame = [], START
    while (there := session.next_large(frame)) is not None:
        frame, marker = there
        found.append(frame)
        m = run.markers.index(marker)
        assert np.nanmax(residual[frame - START, :, m]) == pytest.approx(worst[frame - START])
    assert found == expected and len(found) >= 2
    assert session.next_large(expected[1], -1)[0] == expected[0]
    session.check(expected[1])
    after = session.next_large(expected[0])
    assert after is None or after[0] == expected[2]  # checked frames are passed over


# --- the command ---------------------------------------------------------------------------------------


def command(*arguments):
    app = typer.Typer()
    app.command()(adjust)
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, [str(a) for a in arguments])


def test_export_without_a_page(folder, tmp_path):
    done = command(folder / "run", "--export", "-o", tmp_path / "a.json")
    assert done.exit_code == 0, done.output
    assert len(pd.read_csv(tmp_path / "a.csv")) == (STOP - START) * 24


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["runn"], "did you mean 'run'"),
        (["recording"], "no run"),
        (["run", "--video", "cam9=x.mp4"], "no camera 'cam9'"),
        (["run", "--video", "x.mp4"], "which camera"),
        (["run", "--video", "cam1=absent.mp4"], "absent.mp4"),
        (["run", "--images", "absent"], "which camera"),
        (["run", "--images", "recording"], "no pictures of a camera"),
        (["run", "-o", "run/a.json"], "inside the run's folder"),
        (["run", "-o", "a.csv"], "ends in .json"),
        (["run", "--large-px", "-1"], "more than 0"),
    ],
)
def test_wrong_input_is_one_message_and_exit_2(folder, monkeypatch, arguments, words):
    monkeypatch.chdir(folder)
    before = sorted(str(p) for p in Path().rglob("*"))
    done = command(*arguments, "--no-browser")
    assert done.exit_code == 2, done.output
    assert words in done.output and "Traceback" not in done.output
    left = [p for p in Path().rglob("*") if str(p) not in before]
    assert [p.name for p in left] in ([], ["run.adjustments.json"])
    for p in left:
        p.unlink()
