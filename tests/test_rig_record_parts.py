"""Parts of the recorder: watches over streams, clocks, faults, the lock, drivers and video."""

import os
from threading import Thread

import numpy as np
import pytest

from acino_fte.data_tools.video import VideoReader
from acino_fte.errors import InputError
from acino_fte.rig import sources
from acino_fte.rig.faults import Fault, parse_fault
from acino_fte.rig.lock import RigLock
from acino_fte.rig.recorder_clock import Stamper, VirtualClock
from acino_fte.rig.recorder_events import EventLog, LensWatch, Watch
from acino_fte.rig.rig_file import CameraPart, LidarPart, RigFile
from acino_fte.rig.session import Session, SessionOptions
from acino_fte.rig.simulated import SimulatedRig
from acino_fte.rig.simulated_camera import BITS, burn_number, burnt_number
from acino_fte.rig.sources import DeviceGone
from acino_fte.rig.writers_video import LOSSLESS, RAW, VideoFile, choose_codec

T0 = 1_700_000_000_000_000_000
MS = 1_000_000


def watched(samples, hz=100.0, close=None):
    """Events of one stream: samples are (ms, number, ms by the device)."""
    log = EventLog()
    watch = Watch("cam1", hz, log, T0)
    for at, number, device in samples:
        watch.check(T0 + at * MS)
        watch.received_at(T0 + at * MS, number, 10**9 + device * MS)
    if close is not None:
        watch.check(T0 + close * MS)
        watch.close(T0 + close * MS)
    return [(e.kind, (e.time_ns - T0) // MS, round(e.seconds, 3), e.count) for e in log.all()], log


def steady(first, last, shift=0):
    return [(10 * i, i + shift, 10 * i) for i in range(first, last)]


def test_gaps_in_the_numbers_are_lost_and_those_close_together_one_event():
    events, _ = watched([*steady(0, 20), *steady(23, 40), *steady(41, 200), *steady(202, 210)])
    assert events == [("lost", 200, 0.21, 4), ("lost", 2000, 0.02, 2)]


def test_numbers_that_come_twice_are_told_and_nothing_is_missing():
    events, log = watched([*steady(0, 20), (191, 19, 190), *steady(20, 30)])
    assert events == [("lost", 191, 0.0, 0)] and "twice" in log.get(0).detail


def test_a_device_that_is_late_lost_nothing():
    late = [(600 + i, 20 + i, 200 + 10 * i) for i in range(40)]  # they waited in the device
    events, log = watched([*steady(0, 20), *late, *steady(60, 70)])
    assert events == [("stall", 200, 0.4, 0)] and "nothing is missing" in log.get(0).detail


def test_a_stall_counts_what_did_not_come_by_numbers_or_by_time():
    by_number, _ = watched([*steady(0, 20), *steady(100, 110)])
    by_time, _ = watched([*steady(0, 20), *[(at, n - 80, device) for at, n, device in steady(100, 110)]])
    unnumbered, _ = watched([(at, None, device) for at, _, device in (*steady(0, 20), *steady(100, 110))])
    assert by_number == by_time == unnumbered == [("stall", 200, 0.8, 80)]


def test_a_stall_lasts_until_the_end():
    events, log = watched(steady(0, 20), close=1200)
    assert events == [("stall", 200, 1.0, 100)] and "until the end" in log.get(0).detail


def test_a_device_that_begins_anew_has_lost_nothing():
    events, _ = watched([*steady(0, 20), *[(200 + 10 * i, i, 10 * i) for i in range(10)]])
    assert events == []


def test_a_stall_that_turns_out_to_be_an_unplugged_device():
    log = EventLog()
    watch = Watch("cam1", 100.0, log, T0)
    for at, number, device in steady(0, 20):
        watch.received_at(T0 + at * MS, number, device * MS)
    watch.check(T0 + 700 * MS)
    assert log.get(0).kind == "stall"
    watch.gone(T0 + 800 * MS, "unplugged")
    watch.received_at(T0 + 1200 * MS, 0, 0)
    (event,) = log.all()
    assert (event.kind, event.time_ns, event.count) == ("unplugged", T0 + 200 * MS, 100)
    assert event.seconds == pytest.approx(1.0)


def test_what_an_unplugged_device_misses_is_counted_from_when_it_was_due():
    log = EventLog()
    watch = Watch("cam1", 100.0, log, T0)
    for at, number, device in steady(0, 20):
        watch.received_at(T0 + at * MS, number, device * MS)
    watch.gone(T0 + 192 * MS, "unplugged")
    watch.received_at(T0 + 500 * MS, 0, 0)
    (event,) = log.all()
    assert (event.time_ns, event.count) == (T0 + 192 * MS, 30)  # due at 200, 210, ... 490 ms


def test_a_stream_that_never_begins_is_silent_from_the_start():
    events, _ = watched([], close=2000)
    assert events == [("stall", 0, 2.0, 200)]


def test_the_lens_is_watched_within_its_tolerance():
    log = EventLog()
    watch = LensWatch([(0, "zoom", 20.0), (1, "focus", 5.0)], "cam1", log)
    for ms, counts in (
        (0, (100, 7)),
        (10, (120, 12)),
        (20, (121, 12)),
        (30, (80, 12)),
        (40, (80, 1)),
        (50, ()),
    ):
        watch.seen(T0 + ms * MS, counts)
    watch.close(T0 + 60 * MS)
    found = [(e.kind, (e.time_ns - T0) // MS, round(e.seconds, 3), e.detail.split()[0]) for e in log.all()]
    assert found == [
        ("lens_moved", 20, 0.01, "zoom"),
        ("lens_back", 30, 0.0, "zoom"),
        ("lens_moved", 40, 0.02, "focus"),
        ("stall", 50, 0.01, "nothing"),
    ]


def test_log_times_rise_while_the_wall_clock_jumps():
    jumps = []
    clock = VirtualClock(T0, lambda elapsed: 5.0 if elapsed >= 1.0 else 0.0)
    clock.begin()
    stamper = Stamper(clock, lambda at, seconds: jumps.append((at, seconds)))
    stamps = []
    for _ in range(200):
        stamps.append(stamper.stamp())
        clock.wait(0.01)
    log, wall = np.array(stamps).T
    assert (np.diff(log) == 10 * MS).all()
    assert np.abs(wall - log).max() == 5e9 and jumps == [(T0 + 10**9, pytest.approx(5.0))]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("stall:cam1@10+2", Fault("stall", "cam1", 10.0, 2.0)),
        (" unplug:lidar1@0.5+0.25", Fault("unplug", "lidar1", 0.5, 0.25)),
        ("lost:lidar1/imu@3+7", Fault("lost", "lidar1/imu", 3.0, 7.0)),
        ("clock@1-5", Fault("clock", "", 1.0, -5.0)),
        ("disk@60", Fault("disk", "", 60.0, 0.0)),
        ("lens:focus@1+1", Fault("lens", "focus", 1.0, 1.0)),
    ],
)
def test_faults_are_read(text, fault):
    assert parse_fault(text, RigFile()) == fault


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("stal:cam1@1+1", "did you mean 'stall'"),
        ("stall:cam2@1+1", "did you mean 'cam1'"),
        *((text, "--fault") for text in ("", "stall", "stall@1+2", "stall:cam1@1", "stall:cam1@1-2")),
        *((text, "--fault") for text in ("disk:cam1@3", "disk@3+1", "lost:cam1@1+1.5", "lens:pan@1+1")),
        *((text, "--fault") for text in ("clock@1", "stall:cam1@-1+2", "stall:cam1@1+nan", "stall:cam1@1+0")),
    ],
)
def test_faults_that_are_none_are_refused(text, says):
    with pytest.raises(InputError, match=says):
        parse_fault(text, RigFile())


def test_one_recorder_for_a_rig(tmp_path):
    path = tmp_path / "rig.lock"
    with RigLock(path, tmp_path / "first") as first:
        assert first.taken_over == ""
        with pytest.raises(InputError, match=f"process {os.getpid()}"), RigLock(path, tmp_path / "second"):
            pass
    with RigLock(path, tmp_path / "third") as third:
        assert third.taken_over == ""
    path.write_text('{"pid": 1234567, "since": "yesterday", "recording": "field/run1"}')
    with RigLock(path, tmp_path / "fourth") as fourth:
        assert "1234567" in fourth.taken_over and "rig recover field/run1" in fourth.taken_over
    path.write_text("{not whole")
    with RigLock(path, tmp_path / "fifth") as fifth:
        assert "died without closing" in fifth.taken_over


def test_no_lock_is_left_and_none_is_held_twice(tmp_path):
    """Ten threads, each time a file that another one is about to remove."""
    path, inside, taken, most = tmp_path / "rig.lock", [], [], []

    def take():
        for _ in range(60):
            try:
                with RigLock(path, tmp_path):
                    inside.append(1)
                    most.append(len(inside))
                    inside.pop()
                    taken.append(1)
            except InputError:
                continue

    threads = [Thread(target=take) for _ in range(10)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(most) == 1 and taken
    assert not list(tmp_path.iterdir())


def test_two_sessions_of_a_rig_cannot_record_at_once(tmp_path):
    rig = RigFile(cameras={"cam1": CameraPart(width=64, height=48)}, lidars={})
    first, second = (
        Session(rig, tmp_path / name, SessionOptions(simulate=True, fast=True, probe=False)) for name in "ab"
    )
    first.preflight()
    with pytest.raises(InputError, match="Another recorder"):
        second.preflight()
    assert second.state == "idle" and not (tmp_path / "b").exists()
    first.record(0.2)
    second.preflight()
    second.record(0.2)
    assert first.state == second.state == "idle"


def test_a_session_goes_its_way_only(tmp_path):
    rig = RigFile(cameras={"cam1": CameraPart(width=64, height=48)}, lidars={})
    session = Session(rig, tmp_path / "a", SessionOptions(simulate=True, fast=True, probe=False))
    with pytest.raises(RuntimeError, match="idle"):
        session.record(0.1)
    states = []
    session.preflight()
    states.append(session.state)
    session.record(0.3, lambda status: states.append(session.state))
    assert states == ["preflight", "recording", "recording", "recording"] and session.state == "idle"


def test_drivers_are_found_by_name_and_others_refused(tmp_path, monkeypatch):
    rig = RigFile(cameras={"cam1": CameraPart(device="webcam")}, lidars={"lidar1": LidarPart(device="livox")})
    with pytest.raises(InputError, match=r"cameras\.cam1\.device[\s\S]*simulated"):
        Session(rig, tmp_path / "a")
    monkeypatch.setitem(sources.DRIVERS, "webcam", lambda name, part: object())
    with pytest.raises(InputError, match=r"no driver here[\s\S]*rig_devices\.md"):
        Session(rig, tmp_path / "a")
    with pytest.raises(InputError, match="nothing real"):
        Session(RigFile(), tmp_path / "a")


class Missing:
    """A camera that is not there until the third try."""

    tries = 0

    def __init__(self, name, part):
        rig = RigFile(cameras={name: part}, lidars={})
        self._camera = SimulatedRig(rig).sources[0]
        self.name, self.streams = name, self._camera.streams

    def open(self):
        Missing.tries += 1
        if Missing.tries < 3:
            raise DeviceGone("no camera on the bus")
        self._camera.open()

    def close(self):
        self._camera.close()

    def read(self, timeout_s):
        return self._camera.read(timeout_s)

    def describe(self):
        return "a test camera"


def test_a_driver_that_fails_is_told_and_the_others_are_recorded(tmp_path, monkeypatch):
    class Broken(Missing):
        def open(self):
            raise RuntimeError("no such library")

    parts = {name: CameraPart(width=20, height=16, device=name, fps=50.0) for name in ("broken", "sound")}
    rig = RigFile(name=tmp_path.name, cameras=parts, lidars={}, encoders={})
    monkeypatch.setitem(sources.DRIVERS, "broken", Broken)
    monkeypatch.setitem(
        sources.DRIVERS,
        "sound",
        lambda name, p: SimulatedRig(RigFile(cameras={name: p}, lidars={})).sources[0],
    )
    session = Session(rig, tmp_path / "a", SessionOptions(probe=False))
    checks = {check.name: check for check in session.preflight()}
    assert not checks["broken"].passed and "no such library" in checks["broken"].detail
    manifest = session.record(0.3)
    assert {s.name: s.written > 0 for s in manifest.streams if s.kind == "image"} == {
        "broken": False, "sound": True
    }  # fmt: skip
    assert any(e.kind == "error" and e.stream == "broken" for e in manifest.events)


def test_a_device_that_does_not_answer_is_told_and_joins_when_it_comes(tmp_path, monkeypatch):
    """In real time: preflight warns, the other device is recorded, the missing one from when it is there."""
    part = CameraPart(width=64, height=48, device="missing", fps=50.0)
    rig = RigFile(
        name=tmp_path.name, cameras={"cam1": part, "cam2": part.model_copy(update={"device": "there"})},
        lidars={}, encoders={},
    )  # fmt: skip
    monkeypatch.setitem(sources.DRIVERS, "missing", Missing)
    monkeypatch.setitem(
        sources.DRIVERS,
        "there",
        lambda name, p: SimulatedRig(RigFile(cameras={name: p}, lidars={})).sources[0],
    )
    session = Session(rig, tmp_path / "a", SessionOptions(probe=False))
    checks = {check.name: check for check in session.preflight()}
    assert not checks["cam1"].passed and "no camera on the bus" in checks["cam1"].detail
    assert checks["cam2"].passed
    manifest = session.record(1.2)
    events = [e for e in manifest.events if e.stream == "cam1"]
    assert [e.kind for e in events] == ["unplugged"] and events[0].time_ns <= manifest.started_ns
    assert events[0].seconds > 0.25  # a try when it began at the earliest, one a quarter of a second later
    written = {stream.name: stream.written for stream in manifest.streams}
    assert 0 < written["cam1"] < written["cam2"]


@pytest.mark.parametrize("shape", [(64, 96), (33, 50), (32, 48, 3)])
def test_the_number_of_a_frame_outlives_the_codec(tmp_path, shape):
    part = CameraPart(width=shape[1], height=shape[0], fps=50.0)
    video = VideoFile(tmp_path / "a.mkv", "cam1", part, choose_codec(part), T0, np.zeros(shape, np.uint8))
    numbers = [0, 1, 2**BITS - 1, 0b101010101010101010101010, 77]
    stamps = [0, 20, 20, 60, 80]  # ms; the third comes at once
    for number, stamp in zip(numbers, stamps, strict=True):
        pixels = np.full(shape, 90, np.uint8)
        for plane in (pixels,) if pixels.ndim == 2 else np.moveaxis(pixels, -1, 0):
            burn_number(plane, number)
        video.write(pixels, T0 + stamp * MS)
    video.close()
    with VideoReader(tmp_path / "a.mkv") as reader:
        assert [burnt_number(record.value.pixels) for record in reader.records()] == numbers
        assert (reader.stamps_ns // MS).tolist() == [0, 20, 21, 60, 80]


@pytest.mark.parametrize(
    ("bits", "colour", "codec"), [(8, False, RAW), (12, False, LOSSLESS), (8, True, RAW)]
)
def test_raw_video_keeps_every_pixel(tmp_path, bits, colour, codec):
    part = CameraPart(width=48, height=32, codec="raw", bits=bits)
    assert choose_codec(part) == codec
    rng = np.random.default_rng(0)
    shape = (3, 32, 48, 3) if colour else (3, 32, 48)
    frames = rng.integers(0, 1 << bits, shape).astype(np.uint8 if bits == 8 else np.uint16)
    video = VideoFile(tmp_path / "a.mkv", "cam1", part, codec, T0, frames[0])
    for i, pixels in enumerate(frames):
        video.write(pixels, T0 + i * 20 * MS)
    video.close()
    with VideoReader(tmp_path / "a.mkv") as reader:
        assert np.array_equal([record.value.pixels for record in reader.records()], frames)
