"""Rescue of the recorder's folder: every segment, and a manifest that says what the copy holds."""

import hashlib
import json
import shutil
import signal
import subprocess
import sys
import time

import pytest

from acino_fte.data_tools.rig_reader import RigReader
from acino_fte.data_tools.rig_recording import MANIFEST, Manifest, read_manifest, write_manifest
from acino_fte.errors import InputError
from acino_fte.rig.recover import recover
from acino_fte.rig.rig_file import CameraPart, LidarPart, RigFile, Storage
from acino_fte.rig.rig_read import rig_text

av = pytest.importorskip("av")
pytest.importorskip("mcap")
pytest.importorskip("rosbags")

RIG = RigFile(
    name="recover-test",
    cameras={"cam1": CameraPart(width=64, height=48, bitrate_mbit=0.3)},
    lidars={"lidar1": LidarPart(points=200)},
    storage=Storage(segment_s=2.0, reserve_gb=0.01),
)
TOPICS = ("/cam1/info", "/lidar1/imu", "/lidar1/points")


def state(folder):
    """Names, contents and times of all files."""
    return {
        file.name: (hashlib.sha256(file.read_bytes()).hexdigest(), file.stat().st_mtime_ns)
        for file in sorted(folder.iterdir())
    }


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    """Five seconds in three segments, closed in good order."""
    from acino_fte.rig.session import Session, SessionOptions

    folder = tmp_path_factory.mktemp("rec") / "run"
    session = Session(RIG, folder, SessionOptions(simulate=True, fast=True, probe=False))
    session.preflight()
    session.record(5.0)
    return folder


def messages(path):
    """(topic, sequence, log time) by the package mcap."""
    from mcap.reader import SeekingReader

    with path.open("rb") as file:
        return [(c.topic, m.sequence, m.log_time) for _, c, m in SeekingReader(file).iter_messages()]


def video_times(path):
    with av.open(str(path)) as container:
        return [int(p.pts) for p in container.demux(video=0) if p.size]


def ends_of_messages(path):
    """Where each message of an uncompressed MCAP ends: records are an operation, a length and content."""
    data, ends = path.read_bytes(), []
    at = 8
    while at < len(data) - 8:
        op, length = data[at], int.from_bytes(data[at + 1 : at + 9], "little")
        if op == 6:  # a chunk: its records are walked next
            at += 9 + 32 + int.from_bytes(data[at + 9 + 28 : at + 9 + 32], "little") + 8
            continue
        at += 9 + length
        if op == 5:
            ends.append(at)
    return ends


def ends_of_frames(path):
    """Where each frame of a video ends in its file."""
    data, ends, at = path.read_bytes(), [], 0
    with av.open(str(path)) as container:
        for packet in container.demux(video=0):
            if packet.size:
                at = data.index(bytes(packet), at) + packet.size
                ends.append(at)
    return ends


def assert_consistent(folder):
    """The manifest says of every file what standard readers count in it, and names no other."""
    manifest = read_manifest(folder)
    totals = {}
    for segment in manifest.segments:
        path = folder / segment.file
        assert segment.closed and segment.n_bytes == path.stat().st_size
        if segment.kind == "messages":
            rows = messages(path)
            counts = {topic: sum(row[0] == topic for row in rows) for topic in {row[0] for row in rows}}
            assert (segment.first_ns, segment.last_ns) == (min(r[2] for r in rows), max(r[2] for r in rows))
        else:
            times = video_times(path)
            counts = {segment.file.split("-")[0]: len(times)}
            assert segment.first_ns == manifest.started_ns + times[0] * 10**6
            assert segment.last_ns == manifest.started_ns + times[-1] * 10**6
        assert segment.counts == counts
        for name, n in counts.items():
            totals[name] = totals.get(name, 0) + n
    assert {stream.name: stream.written for stream in manifest.streams} == totals
    assert {s.file for s in manifest.segments} == {
        f.name for f in folder.iterdir() if f.suffix in (".mcap", ".mkv")
    }
    return manifest


def broken(closed, folder, cut=None, manifest="recording"):
    """A copy as a recorder leaves it that was killed: nothing closed in the last segment."""
    shutil.copytree(closed, folder)
    last = max(int(f.stem[-4:]) for f in folder.glob("*.mcap"))
    for file in sorted(folder.glob(f"*-{last:04d}.*")):
        data = file.read_bytes()
        file.write_bytes(data[: int(len(data) * (cut or 1))])
    before = read_manifest(folder)
    if manifest == "recording":
        from dataclasses import replace

        segments = tuple(
            replace(s, closed=False, counts={}, n_bytes=0) if s.index == last else s for s in before.segments
        )
        write_manifest(
            folder, Manifest(**{**vars(before), "state": "recording", "ended_ns": None, "segments": segments})
        )
    elif manifest == "torn":
        (folder / MANIFEST).write_bytes((folder / MANIFEST).read_bytes()[:200])
    else:
        (folder / MANIFEST).unlink()
    return folder


def test_a_sound_folder_is_left_alone(closed, tmp_path):
    before = state(closed)
    found = recover(closed)
    assert found.whole and found.copy is None and state(closed) == before
    saved = {stream.name: stream.saved for stream in found.streams}
    assert {n: abs(k - {"cam1": 300, "/cam1/info": 300, "/lidar1/imu": 1000, "/lidar1/points": 50}[n]) <= 2
            for n, k in saved.items()} == dict.fromkeys(("cam1", *TOPICS), True)  # fmt: skip
    copy = recover(closed, tmp_path / "copy").copy
    assert {f.name for f in copy.iterdir()} == {f.name for f in closed.iterdir()} | {"recovery.json"}


@pytest.mark.parametrize("cut", [0.2, 0.55, 0.9])
def test_cut_segments(closed, cut, tmp_path):
    """All messages whole before the cut; the sound segments byte for byte; the original untouched."""
    folder = broken(closed, tmp_path / "run", cut)
    before = state(folder)
    found = recover(folder)
    assert state(folder) == before and found.copy == tmp_path / "run-recovered"
    manifest = assert_consistent(found.copy)
    assert manifest.state == "recovered" and manifest.started_ns == read_manifest(folder).started_ns
    assert (found.copy / "messages-0000.mcap").read_bytes() == (closed / "messages-0000.mcap").read_bytes()
    assert (found.copy / "rig.yaml").is_file()
    for name, ends in (("messages-0002.mcap", ends_of_messages), ("cam1-0002.mkv", ends_of_frames)):
        whole = sum(end <= (folder / name).stat().st_size for end in ends(closed / name))
        saved = next((s.counts for s in manifest.segments if s.file == name), {})
        assert sum(saved.values()) == whole > 5, name
    with RigReader(found.copy) as reader:
        counted = {stream.name: stream.count for stream in reader.streams}
        infos = sum(1 for _ in reader.records(kinds={"image_info"}))
    assert infos == counted["/cam1/info"] == sum(s.counts.get("/cam1/info", 0) for s in manifest.segments)
    for stream in read_manifest(folder).streams:  # what it says was written, and is not there
        (saved,) = (s for s in found.streams if s.name == stream.name)
        assert saved.saved + saved.lost == stream.written
        assert saved.lost_seconds == pytest.approx(saved.lost / stream.expected_hz)
    assert found.lost > 0
    report = json.loads((found.copy / "recovery.json").read_text())
    assert report["saved"] == found.saved and not report["whole"]
    again = recover(found.copy)
    assert again.whole and again.saved == found.saved


@pytest.mark.parametrize("manifest", ["torn", "missing"])
def test_a_folder_without_a_manifest(closed, manifest, tmp_path):
    """When it began is told by messages and pictures; what was expected by the messages themselves."""
    folder = broken(closed, tmp_path / "run", 0.7, manifest)
    found = recover(folder, tmp_path / "copy")
    made = assert_consistent(found.copy)
    said = read_manifest(closed)
    assert made.state == "recovered" and abs(made.started_ns - said.started_ns) < 2_000_000
    rates = {s.name: s.expected_hz for s in said.streams}
    for stream in made.streams:
        assert stream.kind == next(s.kind for s in said.streams if s.name == stream.name)
        assert stream.expected_hz == pytest.approx(rates[stream.name], rel=0.1)
    assert any("manifest" in note for note in made.notes)


def test_a_segment_that_is_missing_or_empty(closed, tmp_path):
    folder = broken(closed, tmp_path / "run", 0.7)
    (folder / "messages-0001.mcap").unlink()
    (folder / "cam1-0001.mkv").write_bytes(b"")
    found = recover(folder)
    assert_consistent(found.copy)
    notes = " ".join(found.notes)
    assert all(stream.lost > stream.saved / 3 for stream in found.streams)
    assert "messages-0001.mcap is not there" in notes and "cam1-0001.mkv: nothing can be saved" in notes
    for file in folder.glob("*-000?.m*"):
        file.write_bytes(bytes(500))
    with pytest.raises(InputError, match="Nothing could be saved"):
        recover(folder, tmp_path / "other")
    assert not (tmp_path / "other").exists() and not list(tmp_path.glob(".*"))


def of_topic(folder, topic):
    """(sequence, log time) of its messages in all segments."""
    rows = [row for file in sorted(folder.glob("messages-*.mcap")) for row in messages(file)]
    return {row[1:] for row in rows if row[0] == topic}


def start(folder):
    """A recorder that runs, as a process of its own."""
    folder.mkdir()
    (folder / "rig.yaml").write_text(rig_text(RIG))
    code = "from acino_fte.cli import main; main()"
    command = [sys.executable, "-c", code, "rig", "record", str(folder / "rig.yaml"), "--simulate", "--quiet"]
    return subprocess.Popen(
        [*command, "--out", str(folder / "run")], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no kill -9 here")
def test_a_recorder_that_was_killed(tmp_path):
    """kill -9 of the command: readable, consistent, and all that was on the disk a second before.

    More kills, at random moments, are in test_rig_record_kill and benchmarks/bench_recorder.py.
    """
    process, run = start(tmp_path / "a"), tmp_path / "a" / "run"
    try:
        until = time.monotonic() + 60
        while not list(run.glob("cam1-*.mkv")) and time.monotonic() < until:
            time.sleep(0.02)
        time.sleep(0.6)
        shutil.copytree(run, tmp_path / "before")
        assert any("still runs" in note for note in recover(run, tmp_path / "meanwhile").notes)
        time.sleep(1.0)
    finally:
        process.kill()
        process.wait()
    before = state(run)
    found = recover(run)
    assert state(run) == before
    manifest = assert_consistent(found.copy)
    assert manifest.state == "recovered" and manifest.events[-1].kind == "stopped"
    assert not any("still runs" in note for note in found.notes)
    earlier = recover(tmp_path / "before")
    for topic in TOPICS:
        saved, then = of_topic(found.copy, topic), of_topic(earlier.copy, topic)
        assert len(saved & then) >= 0.99 * len(then) and len(then) > 2
