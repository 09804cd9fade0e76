"""``acino-fte rig recover``: exit codes, what it says, and that it never harms anything."""

import errno
import hashlib
import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from lvx_synthetic import recording
from recover_made import PAYLOADS, make, read_standard
from typer.testing import CliRunner

from acino_fte.cli import app
from acino_fte.errors import InputError
from acino_fte.rig import recover as module
from acino_fte.rig import recover_mcap
from acino_fte.rig.recover import recover

pytest.importorskip("rosbags")
pytest.importorskip("mcap")


def state(folder):
    """Names, contents and times of all files."""
    return {
        str(file): (hashlib.sha256(file.read_bytes()).hexdigest(), file.stat().st_mtime_ns)
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def run(*words):
    done = CliRunner(env={"COLUMNS": "200"}).invoke(app, ["rig", "recover", *map(str, words)])
    assert not isinstance(done.exception, Exception) or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, " ".join(done.output.split())


@pytest.fixture
def cut(tmp_path):
    """A cut MCAP file alone in its folder."""
    path, _ = make(tmp_path, "mcap-zstd")
    folder = tmp_path / "field"
    folder.mkdir()
    (folder / "run.mcap").write_bytes(path.read_bytes()[:-9000])
    return folder / "run.mcap"


def test_one_command_without_options(cut):
    before = state(cut.parent)
    code, said = run(cut)
    assert code == 0 and "run.mcap: MCAP file, damaged" in said and "the original was not touched" in said
    copy, report = cut.with_name("run-recovered.mcap"), cut.with_name("run-recovered.mcap.recovery.json")
    saved = read_standard(copy, "mcap")
    assert saved == PAYLOADS[: len(saved)] and f"{len(saved)} messages" in said
    assert state(cut.parent).items() >= before.items() and len(list(cut.parent.iterdir())) == 3
    content = json.loads(report.read_text())
    assert content["saved"] == len(saved) and content["copy"] == str(copy)
    assert sum(stream["saved"] for stream in content["streams"]) == len(saved)
    code, said = run(cut)
    assert code == 2 and "exists already" in said and read_standard(copy, "mcap") == saved
    code, said = run(copy)
    assert code == 0 and "Nothing is wrong with it, so no copy was made." in said
    code, said = run(copy, "--out", cut.parent / "third", "--json")
    assert (
        code == 0
        and json.loads(said)["whole"]
        and (cut.parent / "third.mcap").read_bytes() == copy.read_bytes()
    )


def test_what_goes_wrong_is_one_message(cut, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "note.txt").write_text("hello")
    (tmp_path / "none.bag").write_bytes(b"")
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "a.csv").write_text("1,2")
    for words, expected in (
        ((cut.with_name("rum.mcap"),), "did you mean 'run.mcap'"),
        ((tmp_path / "empty",), "folder is empty"),
        ((tmp_path / "note.txt",), "no recording"),
        ((tmp_path / "none.bag",), "empty"),
        ((tmp_path / "texts",), "has no recordings"),
        ((cut, "--like", "nothing.mp4"), "no such sound recording"),
        ((cut, "--fps", "-3"), "impossible"),
        ((cut, "--out", tmp_path / "note.txt"), "exists already"),
        ((cut, "--out", tmp_path / "note.txt" / "x.mcap"), "cannot be written"),
        ((cut.parent, "--out", cut.parent / "inside"), "inside the original"),
    ):
        before = state(tmp_path)
        code, said = run(*words)
        assert code == 2 and expected in said and "Traceback" not in said, (words, said)
        assert state(tmp_path) == before
    assert run()[0] == 2


def test_the_copy_is_whole_or_absent(cut, monkeypatch):
    """The disk fills while the copy is written; it was too full before; the copy reads wrong."""
    before = state(cut.parent)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def broken(*_):
        raise OSError(errno.EIO, "Input/output error")

    for name, what, says in (
        ("message", full, "cannot be written"),
        ("close", full, "cannot be written"),
        ("message", broken, "ddrescue"),
    ):
        with monkeypatch.context() as patch, pytest.raises(InputError, match=says):
            patch.setattr(recover_mcap._McapWriter, name, what)
            recover(cut)
        assert state(cut.parent) == before and len(list(cut.parent.iterdir())) == 1
    with monkeypatch.context() as patch, pytest.raises(InputError, match="no room"):
        patch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(1000, 900, 100))
        recover(cut)
    with monkeypatch.context() as patch, pytest.raises(InputError, match="does not read as it should"):
        patch.setattr(module, "count_of", lambda *_: 3)
        recover(cut)
    assert state(cut.parent) == before and len(list(cut.parent.iterdir())) == 1


def test_a_folder_that_cannot_be_written(cut, tmp_path, monkeypatch):
    """As a card that is locked: the copy comes into the working folder."""
    monkeypatch.setattr(module, "_writable", lambda folder: folder != cut.parent)
    monkeypatch.chdir(tmp_path)
    before = state(cut.parent)
    cut.parent.chmod(0o555)
    try:
        found = recover(cut)
    finally:
        cut.parent.chmod(0o755)
    assert found.copy == tmp_path / "run-recovered.mcap" and found.copy.is_file()
    assert state(cut.parent) == before


def test_a_folder_of_recordings(cut, tmp_path):
    """Cut, sound and hopeless ones, a bag of ROS 2 and files that are none: each for itself."""
    folder = cut.parent
    shutil.copy(make(tmp_path, "ros1-lz4")[0], folder / "sound.bag")
    data = recording(tmp_path / "a.lvx", n_frames=3, per=2)
    (folder / "scan.lvx").write_bytes(data[: len(data) // 2])
    (folder / "gone.bag").write_bytes(b"#ROSBAG V2.0\n" + np.random.default_rng(1).bytes(500))
    (folder / "notes.txt").write_text("two cheetahs")
    (folder / "bag").mkdir()
    shutil.copy(make(tmp_path, "db3")[0], folder / "bag" / "bag_0.db3")
    before = state(folder)
    code, said = run(folder)
    assert code == 0 and "5 recordings: 1 whole, 3 rescued, 1 of which nothing could be saved" in said
    assert "gone.bag: nothing could be saved" in said
    assert state(folder) == before
    copies = tmp_path / "field-recovered"
    assert {f.name for f in copies.iterdir()} == {
        "run.mcap", "run.mcap.recovery.json", "scan.lvx", "scan.lvx.recovery.json", "bag", "recovery.json",
    }  # fmt: skip
    assert json.loads((copies / "recovery.json").read_text())["failed"][0]["file"] == "gone.bag"
    shutil.rmtree(copies)
    for name in ("run.mcap", "scan.lvx", "sound.bag", "bag/bag_0.db3"):
        (folder / name).unlink()
    code, said = run(folder)
    assert code == 2 and "Nothing could be saved" in said and not copies.exists()


def test_the_page_shows_what_is_printed(tmp_path, monkeypatch):
    """docs/rig_recover.md: its example, its commands, what they print (test_docs runs it whole, too)."""
    page = (Path(__file__).resolve().parent.parent / "docs" / "rig_recover.md").read_text(encoding="utf-8")
    parts = re.findall(r"^```(\w*)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names = {}
    for language, text in parts:
        if language == "python":
            exec(text, names)
        elif language == "bash":
            for line in text.splitlines():
                code, said = run(*shlex.split(line)[3:])
                assert code == 0, (line, said)
                shown = next(t for kind, t in parts if kind == "text")
                assert line != "acino-fte rig recover card/walk.bag" or " ".join(shown.split()) in said
    assert names["found"].saved == 1103
