"""``acino-fte rig check`` as it is typed: the guide, wrong input, a simulated rig with faults."""

import json
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
pytest.importorskip("av")

from rig_check_folders import write_folder

from acino_fte.cli_rig import app
from acino_fte.rig.check import check_recording

GUIDE = Path(__file__).parents[1] / "docs" / "rig_check.md"
RIG = """\
format: acino-fte/rig/1
name: small
cameras:
  cam1: {width: 64, height: 48, fps: 60, bitrate_mbit: 1}
lidars:
  lidar1: {points: 480, imu_hz: 100}
storage: {segment_s: 5, reserve_gb: 0.001}
"""


def run(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments)])


def record(folder, minutes, *faults):
    options = [part for fault in faults for part in ("--fault", fault)]
    rig = folder / "rig.yaml"
    rig.write_text(RIG)
    command = ("record", rig, "--simulate", "--fast", "--minutes", minutes, "-q")
    found = run(*command, *options, "-o", folder / "recording")
    assert found.exit_code in (0, 1), found.output
    return folder / "recording"


def test_the_commands_of_the_guide(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.yaml").write_text(RIG)
    text = GUIDE.read_text()
    lines = [line for block in re.findall(r"```bash\n(.*?)```", text, re.S) for line in block.splitlines()]
    commands = sorted({tuple(shlex.split(line)[2:]) for line in lines}, key=lambda words: words[0] == "check")
    assert len(commands) == 3
    for words in commands:
        found = run(*words)
        assert found.exit_code in (0, 1) and "Traceback" not in found.output, (words, found.output)
        if words[0] == "check":
            assert found.exit_code == 1  # the practice has a stall
            shown = re.search(r"```text\n(✗.*?)\n```", text, re.S)[1]
            assert shown in found.output
    assert sorted(path.name for path in Path("checked").iterdir()) == [
        "check.html", "check.json", "timeline.png"
    ]  # fmt: skip
    assert json.loads(Path("practice.json").read_text()) == json.loads(Path("checked/check.json").read_text())
    exec(re.search(r"```python\n(.*?)```", text, re.S)[1], {})  # noqa: S102 - the guide's own example
    assert "/cam1/info" in capsys.readouterr().out
    again = run("check", "practice", "-o", "checked")
    assert again.exit_code == 2 and "--overwrite" in again.output


def test_every_fault_of_a_simulated_rig_is_found_and_nothing_else(tmp_path):
    path = record(
        tmp_path, 0.15, "stall:cam1@1+1", "unplug:lidar1@2.5+1", "lost:cam1@3+5", "clock@4-5", "clock@5+5",
        "stall:lidar1/imu@6+1.5", "lens:zoom@7+1",
    )  # fmt: skip
    check = check_recording(path)
    begin = check.found.manifest.started_ns
    streams = check.found.streams
    expected = {
        "/cam1/info": [(1.0, 1.0, 60), (3.0, 5 / 60, 5)],
        "/lidar1/points": [(2.5, 1.0, 10)],
        "/lidar1/imu": [(2.5, 1.0, 100), (6.0, 1.5, 150)],
        "/cam1/image": [],
    }
    for name, gaps in expected.items():
        found = streams[name].gaps
        assert len(found) == len(gaps), name
        for gap, (start, length, lost) in zip(found, gaps, strict=True):
            slack = 2.5 / streams[name].rate_hz
            assert (gap.start_ns - begin) * 1e-9 == pytest.approx(start, abs=slack)
            assert gap.seconds == pytest.approx(length, abs=slack)  # an unplugged device comes when it comes
            assert gap.lost == pytest.approx(lost, abs=1) and gap.explained
    jumps = [((jump.time_ns - begin) * 1e-9, jump.seconds) for jump in check.found.wall.jumps]
    assert jumps == [
        (pytest.approx(4.0, abs=0.02), pytest.approx(-5.0, abs=0.01)),
        (pytest.approx(5.0, abs=0.02), pytest.approx(5.0, abs=0.01)),
    ]
    (moved,) = check.found.cameras["/cam1/info"].lens
    assert ((moved[0] - begin) * 1e-9, (moved[1] - begin) * 1e-9) == pytest.approx((7.0, 8.0), abs=0.1)
    assert check.found.cameras["/cam1/info"].n_glitches == 0
    assert check.unexplained == () and check.found.damage.whole
    for stream in streams.values():
        assert stream.duplicates == stream.out_of_order == 0


def test_nothing_is_found_in_a_clean_simulated_recording(tmp_path):
    found = run("check", record(tmp_path, 0.05), "-q", "-o", tmp_path / "checked")
    assert (found.exit_code, found.output) == (0, "")
    again = run("check", tmp_path / "recording", "-o", tmp_path / "checked", "--overwrite")
    assert again.exit_code == 0 and "PASS: 3.0 s" in again.output, again.output


def test_a_full_disk_ends_it_with_a_warning(tmp_path):
    found = run("check", record(tmp_path, 0.1, "disk@2"))
    assert found.exit_code == 0 and "the disk was full after 2.0 s" in found.output, found.output


def test_wrong_input(tmp_path):
    folder = write_folder(tmp_path / "rig", seconds=1.0, video=False)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("lunch at noon")
    (tmp_path / "picture.bag").write_bytes(b"\x89PNG" + bytes(100))
    (tmp_path / "nothing.lvx").write_bytes(b"")
    for arguments, said in (
        ([tmp_path / "rigg"], "no such recording"),
        ([tmp_path / "empty"], "empty"),
        ([tmp_path / "notes.txt"], "text"),
        ([tmp_path / "picture.bag"], "PNG"),
        ([tmp_path / "nothing.lvx"], "empty"),
        ([folder, "-o", folder], "input folder"),
        ([folder, "-o", folder / "checked"], "inside the input"),
        ([folder, "-o", tmp_path / "notes.txt"], "a file, not a folder"),
        ([folder, "--json", tmp_path / "notes.txt" / "a.json"], "cannot be written"),
        ([], "Missing argument"),
    ):
        found = run("check", *arguments)
        assert found.exit_code == 2 and said.lower() in found.output.lower(), (arguments, found.output)
        assert "Traceback" not in found.output
    assert sorted(path.name for path in folder.iterdir()) == ["manifest.json", "messages-0000.mcap"]
