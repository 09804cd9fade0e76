"""docs/rig.md does what it says, and the operator's card too: every command runs, simulated."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from rig_commands import execute, program
from test_new_species_tutorial import blocks

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
pytest.importorskip("av")

from acino_fte.data_tools.rig_recording import read_manifest

REPOSITORY = Path(__file__).resolve().parent.parent
DOCS = REPOSITORY / "docs"
PAGE = (DOCS / "rig.md").read_text(encoding="utf-8")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_VARIES = re.compile(r"[\d.]+ MB|from [\d-]+ [\d:]+ UTC")
sys.path.insert(0, str(DOCS))


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """The folder after the whole page, and what its commands printed."""
    folder = tmp_path_factory.mktemp("rig")
    printed, names = {}, {"__name__": "docs"}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("MPLBACKEND", "Agg")
        for language, block in blocks(PAGE):
            if language == "yaml" and (match := re.match(r"# (\S+\.yaml)\n", block)):
                (folder / match[1]).write_text(block, encoding="utf-8")
            elif language == "bash":
                for line in filter(str.strip, block.splitlines()):
                    printed[line] = execute(line, folder)
            elif language == "python":
                exec(compile(block, f"rig.md: {block.splitlines()[0]}", "exec"), names)
    return folder, printed


def shown_lines(first: str) -> list[str]:
    """Lines of the text block of the page that begins with these words."""
    return next(text for kind, text in blocks(PAGE) if kind == "text" and text.startswith(first)).splitlines()


def assert_printed(lines: list[str], printed: str) -> None:
    """The same words, and nearly the same numbers; sizes and times of day differ."""
    by_words = {_NUMBER.sub("#", line.strip()): line for line in printed.splitlines()}
    for line in lines:
        theirs = by_words[_NUMBER.sub("#", line.strip())]
        numbers = [[float(n) for n in _NUMBER.findall(_VARIES.sub("", text))] for text in (line, theirs)]
        np.testing.assert_allclose(*numbers, rtol=0.03, err_msg=theirs)


def printed_by(printed: dict[str, str], words: str) -> str:
    return next(text for line, text in printed.items() if words in line)


def test_the_recording_is_whole_and_the_check_says_so(followed):
    folder, printed = followed
    manifest = read_manifest(folder / "hunt")
    assert manifest.state == "closed"
    written = {stream.name: stream.written for stream in manifest.streams}
    assert written == {"cam1": 180, "/cam1/info": 180, "/lidar1/points": 30, "/lidar1/imu": 600}
    assert_printed(shown_lines("3.0 s"), printed_by(printed, " rig record "))
    assert_printed(shown_lines("PASS"), printed_by(printed, " rig check "))


def test_a_silent_camera_is_told_as_the_page_says(followed):
    folder, _ = followed
    record = "rig record small.yaml --simulate --fast --minutes 0.05 --fault stall:cam1@1+0.5 -o stalled"
    assert "`--fault stall:cam1@1+0.5`" in PAGE
    printed = execute(f"acino-fte {record}", folder)
    printed += execute("acino-fte rig check stalled", folder, code=1)  # explained; but pictures are missing
    assert_printed(shown_lines("warning: at 1.00 s"), printed)


def test_what_was_cut_is_readable_again(followed):
    folder, _ = followed
    before, after = read_manifest(folder / "hunt"), read_manifest(folder / "cut-recovered")
    saved = {stream.name: stream.written for stream in after.streams}
    for stream in before.streams:
        if stream.kind != "image_info":
            assert 0.5 * stream.written < saved[stream.name] < stream.written, stream.name
    assert (folder / "cut-recovered" / "recovery.json").is_file()


def test_the_sequence_waits_for_its_keypoints_only(followed):
    folder, printed = followed
    sequence = folder / "hunt_sequence"
    cameras = json.loads((sequence / "cameras.json").read_text())["cameras"]
    assert len(cameras[0]["rotation"]) == 180
    assert_printed(shown_lines("damage: none"), printed_by(printed, "import-recording"))


def test_the_card_names_commands_of_this_page(followed):
    """Each of its commands ran above, with simulated devices; its options are options of that command."""
    from rig_pictures import CARD

    _, printed = followed
    commands = {command for _, _, rows in CARD for _, _, _, command in rows if command}
    listed = set(re.findall(r"^\| [\w ]*\| `(acino-fte [\w ]+?)(?: --for rig)?` \|", PAGE, re.MULTILINE))
    assert len(commands) == 7
    for line in commands:
        name = re.match(r"acino-fte (?:rig )?\w+", line)[0]
        assert name in listed
        assert name == "acino-fte doctor" or any(other.startswith(f"{name} ") for other in printed), name
        command, words = program(), line.replace("FOLDER", "hunt").split()[1:]
        while words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words.pop(0)]
        command.make_context(name, words)  # takes the words, or raises


def test_the_words_of_the_card_are_those_of_the_screen():
    from rig_pictures import CARD, SCREEN

    from acino_fte.cli_rig_record import status_line
    from acino_fte.rig.recorder import Status

    status = Status(
        state="recording",
        elapsed_s=61.0,
        fps={"cam1": 60.0},
        written={"cam1": 3600},
        dropped=12,
        lost=0,
        silent=("/lidar1/points",),
        lens_moved=True,
        free_bytes=10**10,
        minutes_left=14.0,
        waiting=0.0,
    )
    shown = status_line(status)
    words = [
        what.replace("…", "").strip() for _, _, rows in CARD for kind, what, *_ in rows if kind == SCREEN
    ]
    assert len(words) == 4
    for word in words:
        assert word in shown


def test_what_the_page_says_of_the_doctor_is_so():
    """The example of a failure is what the doctor prints for it."""
    from acino_fte import doctor_devices

    text = next(text for kind, text in blocks(PAGE) if kind == "text" and text.startswith("FAIL"))
    assert doctor_devices._GROUP.format(group="dialout") in text
    for name in ("ok", "note", "FAIL", "--"):
        assert f"`{name}`" in PAGE


def test_the_numbers_of_the_bill_of_materials_are_those_of_the_planner():
    from acino_fte.doctor_storage import recording_needs
    from acino_fte.rig.rig_file import RigFile

    rig = RigFile()
    camera, lidar = rig.cameras["cam1"], rig.lidars["lidar1"]
    assert f"{camera.width} × {camera.height} pixels of {camera.pixel_um} µm" in PAGE
    assert f"{camera.frame_overhead_us} µs + {camera.line_us} µs a line" in PAGE
    assert f"{lidar.fov_deg[0]}° × {lidar.fov_deg[1]}°" in PAGE
    assert f"{rig.encoders['zoom'].counts_per_turn} counts a turn" in PAGE
    needs = recording_needs()
    assert f"write {needs.h264_mb_s:.1f} MB/s; raw pictures {needs.raw_mb_s:.0f} MB/s" in PAGE
