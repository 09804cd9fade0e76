"""A simulated rig is recorded, with faults, on a virtual clock: all is there, every fault is told."""

import json
from dataclasses import replace

import numpy as np
import pytest

from acino_fte.data_tools.open_recording import open_recording
from acino_fte.data_tools.rig_recording import Event, read_manifest, write_manifest
from acino_fte.errors import InputError
from acino_fte.rig import recorder_readers
from acino_fte.rig.faults import parse_fault
from acino_fte.rig.recorder_verdict import unexplained
from acino_fte.rig.rig_file import CameraPart, EncoderPart, LidarPart, RigFile, Storage
from acino_fte.rig.rig_read import read_rig
from acino_fte.rig.session import Session, SessionOptions
from acino_fte.rig.simulated_proof import expected_events, problems_of

RIG = RigFile(
    cameras={"cam1": CameraPart(width=96, height=64)},
    lidars={"lidar1": LidarPart(points=40, imu_hz=50.0)},
    storage=Storage(segment_s=4.0, reserve_gb=0.01),
)
FAULTS = (
    *("stall:cam1@1+2", "stall:lidar1/imu@1.5+2", "unplug:lidar1@4.2+2", "lost:cam1@4.7+5", "clock@5-5"),
    *("clock@6.25+5", "lens:zoom@5.5+1", "lens:focus@6+1", "lost:lidar1/points@7.5+2", "unplug:cam1@8.5+1.5"),
    *("stall:lidar1@9+2", "disk@11.45"),
)


def record(folder, texts=(), seconds=12.0, rig=RIG, **options):
    faults = tuple(parse_fault(text, rig) for text in texts)
    session = Session(
        rig, folder, SessionOptions(simulate=True, fast=True, faults=faults, probe=False, **options)
    )
    session.preflight()
    return session, session.record(seconds), faults


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig") / "faulty"
    return folder, *record(folder, FAULTS)


def test_every_fault_is_told_with_its_time_and_length_and_nothing_else_is_lost(faulty):
    """Times and lengths to a period (a look ten times a second for disk and clock, a quarter of a second to
    find a device again): the tolerances of `expected_events`. All that was delivered is on the disk, each
    frame with its message, its time and its number."""
    folder, session, manifest, faults = faulty
    assert problems_of(folder, RIG, session.equipment.sources, faults) == []
    assert unexplained(manifest, faults) == []
    assert manifest.state == "closed" and session.state == "idle"
    assert [s.index for s in manifest.segments if s.kind == "video"] == [0, 1, 2]


def test_the_tolerances_are_as_narrow_as_what_can_be_known(faulty):
    _, session, _, faults = faulty
    for one in expected_events(RIG, session.equipment.sources, faults):
        period = 1 / {"cam1": 60.0, "/lidar1/imu": 50.0}.get(one.stream, 10.0)
        assert one.time_error_s <= period + 0.005
        assert one.length_error_s <= (
            0.25 + 1.5 * period + 0.02 if one.kind == "unplugged" else period + 0.005
        )


@pytest.mark.parametrize(
    "change",
    [
        lambda events: events[:2] + events[3:],
        lambda events: (*events, Event("stall", events[0].time_ns, "cam1", 2.0, 120)),
        lambda events: tuple(replace(e, time_ns=e.time_ns + 40_000_000) for e in events),
        lambda events: tuple(replace(e, seconds=e.seconds * 1.1) for e in events),
        lambda events: tuple(replace(e, count=e.count + 1) for e in events),
    ],
    ids=["one missing", "one too many", "late", "too long", "miscounted"],
)
def test_the_proof_sees_events_that_are_wrong(faulty, change):
    from acino_fte.rig.simulated_proof import _event_problems

    _, session, manifest, faults = faulty
    expected = expected_events(RIG, session.equipment.sources, faults)
    assert not list(_event_problems(manifest, expected))
    assert list(_event_problems(replace(manifest, events=change(manifest.events)), expected))


def test_the_folder_reads_as_one_recording(faulty):
    folder, session, manifest, _ = faulty
    with open_recording(folder) as reader:
        counts = {stream.name: stream.count for stream in reader.streams}
        assert reader.damage.whole
    delivered = session.equipment.sources[0].delivered["cam1"]
    assert counts["/cam1/info"] == counts["/cam1/image"] == delivered
    assert read_rig(folder / "rig.yaml") == RIG
    assert {stream.name for stream in manifest.streams} == {
        *("cam1", "/cam1/info", "/lidar1/points", "/lidar1/imu")
    }
    assert all(stream.received == stream.written for stream in manifest.streams)


def test_messages_of_all_streams_lie_together(faulty):
    """On the virtual clock too: where a file is cut, all streams end within a quarter of a second."""
    from mcap.reader import NonSeekingReader

    for path in faulty[0].glob("messages-*.mcap"):
        with path.open("rb") as file:
            found = NonSeekingReader(file).iter_messages(log_time_order=False)
            logs = np.array([message.log_time for _, _, message in found])
        assert (np.maximum.accumulate(logs) - logs).max() < 0.25e9, path


def test_what_cannot_be_written_is_told_and_the_sensor_goes_on(tmp_path, monkeypatch):
    """A driver that once says NaN where a number must be."""
    from acino_fte.rig.simulated_camera import SimulatedCamera

    sample = SimulatedCamera.sample

    def odd(self, stream, number, device_ns):
        found = sample(self, stream, number, device_ns)
        return replace(found, info=replace(found.info, exposure_us=np.nan)) if number in (9, 10) else found

    monkeypatch.setattr(SimulatedCamera, "sample", odd)
    rig = RigFile(cameras={"cam1": CameraPart(width=64, height=48)}, lidars={})
    _, manifest, _ = record(tmp_path / "rig", seconds=1.0, rig=rig)
    assert [(s.received, s.written) for s in manifest.streams] == [(60, 58)] * 2
    (error,) = [event for event in manifest.events if event.kind == "error"]
    assert "NaN" in error.detail and error.stream == "cam1"
    assert any("2 were received and not written" in text for text in unexplained(manifest))
    with open_recording(tmp_path / "rig") as reader:
        shown = {stream.name: stream.count for stream in reader.streams}
    assert shown == {"/cam1/info": 58, "/cam1/image": 58}


def test_counts_of_the_encoders_come_with_every_image(faulty):
    folder, _, manifest, _ = faulty
    with open_recording(folder) as reader:
        infos = [(r.received_ns - manifest.started_ns, r.value) for r in reader.records(["image_info"])]
    at = np.array([ns for ns, _ in infos]) * 1e-9
    counts = np.array([info.encoders for _, info in infos])
    assert counts.shape == (len(infos), 4)
    zoomed, focused = counts[:, 0] != counts[0, 0], counts[:, 1] != counts[0, 1]
    assert at[zoomed].min() == pytest.approx(5.5, abs=0.02) and at[zoomed].max() == pytest.approx(
        6.5, abs=0.02
    )
    assert at[focused].min() == pytest.approx(6.0, abs=0.02)
    assert len(set(counts[:, 2])) > 10  # pan moves, which is no fault


def test_without_faults_nothing_is_told(tmp_path):
    """Frames of the lidar on demand, every six images; a second camera; grey of 12 bits kept as it is."""
    cameras = {
        "cam1": CameraPart(width=50, height=33),
        "cam2": CameraPart(width=48, height=32, fps=20.0, codec="raw", bits=12),
    }
    rig = RIG.model_copy(update={"cameras": cameras})
    session, manifest, _ = record(tmp_path / "r", rig=rig, seconds=5.0, lidar_every=6)
    assert [event.kind for event in manifest.events] == ["started", "stopped"]
    assert problems_of(tmp_path / "r", rig, session.equipment.sources, ()) == []
    written = {stream.name: stream.written for stream in manifest.streams}
    assert written["cam1"] == 300 and written["cam2"] == 100
    assert written["/lidar1/points"] == 51  # one when it began, then one every six images
    assert manifest.events[-1].seconds == pytest.approx(5.0)


def test_the_lidar_on_demand_goes_on_without_the_camera(tmp_path):
    texts = ("stall:cam1@1+2", "lost:lidar1/points@3.6+2")
    session, manifest, faults = record(tmp_path / "r", texts, 5.0, lidar_every=6)
    assert problems_of(tmp_path / "r", RIG, session.equipment.sources, faults, 20) == []
    points = next(stream for stream in manifest.streams if stream.name == "/lidar1/points")
    assert points.received > 35  # about 50 asked for, fewer while the camera is silent
    assert unexplained(manifest, faults) == []


def test_what_a_writer_cannot_take_is_dropped_and_counted(tmp_path, monkeypatch):
    """In real time nobody waits: what a full queue has no room for is dropped, and told."""
    put = recorder_readers.SensorWriter.put
    n = iter(range(10**9))
    monkeypatch.setattr(
        recorder_readers.SensorWriter, "put", lambda self, item: not 20 <= next(n) < 25 and put(self, item)
    )
    session, manifest, _ = record(tmp_path / "r", seconds=1.0)
    assert sum(s.dropped for s in manifest.streams if s.kind != "image_info") == 5
    dropped = [event for event in manifest.events if event.kind == "dropped"]
    assert sum(event.count for event in dropped) == 5
    assert any("could not keep up" in sentence for sentence in unexplained(manifest))
    assert all(s.received == s.written + s.dropped for s in manifest.streams)
    assert not [event for event in manifest.events if event.kind in ("lost", "stall")]


def test_a_sensor_whose_writer_fails_ends_and_the_others_go_on(tmp_path, monkeypatch):
    from acino_fte.rig.writers_video import VideoFile

    def fail(self, pixels, log_ns):
        raise ValueError("the encoder is gone")

    monkeypatch.setattr(VideoFile, "write", fail)
    _, manifest, _ = record(tmp_path / "r", seconds=2.0)
    errors = [event for event in manifest.events if event.kind == "error"]
    assert [(e.stream, "encoder is gone" in e.detail) for e in errors] == [("cam1", True)]
    written = {stream.name: stream.written for stream in manifest.streams}
    assert written["cam1"] == 0 and written["/lidar1/points"] == 20 and written["/lidar1/imu"] == 100
    assert any(sentence.startswith("cam1: error") for sentence in unexplained(manifest))
    assert all(segment.closed for segment in manifest.segments if segment.kind == "messages")


def test_a_disk_that_takes_no_more_ends_the_recording_in_good_order(tmp_path, monkeypatch):
    import errno

    from acino_fte.rig.writers_messages import MessageFile

    write = MessageFile.write

    def full(self, topic, value, log_ns, wall_ns, frame):
        if self.counts.get("/lidar1/imu", 0) >= 60:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(self, topic, value, log_ns, wall_ns, frame)

    monkeypatch.setattr(MessageFile, "write", full)
    _, manifest, _ = record(tmp_path / "r", seconds=5.0)
    assert "disk_full" in [event.kind for event in manifest.events]
    assert manifest.state == "closed" and manifest.events[-1].seconds < 5.0
    assert read_manifest(tmp_path / "r") == manifest


def test_an_unexplained_loss_is_one_that_nothing_explains(faulty):
    folder, _, manifest, faults = faulty
    lost = unexplained(manifest)  # as if the faults were not induced
    assert len(lost) == 2 and all("lost at" in sentence for sentence in lost)
    streams = tuple(replace(s, written=s.written - 1) for s in manifest.streams)
    assert len(unexplained(replace(manifest, streams=streams), faults)) == len(streams)


def test_the_manifest_says_what_is_under_way(tmp_path):
    """While it records: the state, the files that are open, a silence that lasts."""
    seen = []

    def look(status):
        if 2.4 < status.elapsed_s < 2.6:
            seen.append((status, read_manifest(tmp_path / "r")))

    faults = (parse_fault("stall:cam1@1+2", RIG),)
    session = Session(
        RIG, tmp_path / "r", SessionOptions(simulate=True, fast=True, faults=faults, probe=False)
    )
    session.preflight()
    session.record(4.0, look)
    status, manifest = seen[0]
    assert manifest.state == "recording" and not any(segment.closed for segment in manifest.segments)
    assert [(e.kind, e.stream) for e in manifest.events[1:]] == [("stall", "cam1")]
    assert "still lasts" in manifest.events[1].detail
    assert status.silent == ("cam1",) and status.fps["/lidar1/points"] == pytest.approx(10, abs=1)


def test_a_folder_is_never_written_over(tmp_path, faulty):
    folder = faulty[0]
    with pytest.raises(InputError, match="something already"):
        Session(RIG, folder, SessionOptions(simulate=True))
    before = json.loads((folder / "manifest.json").read_text())
    write_manifest(tmp_path, read_manifest(folder))
    assert json.loads((tmp_path / "manifest.json").read_text()) == before


def test_a_rig_without_encoders_or_with_one(tmp_path):
    for name, encoders in (("a", {}), ("b", {"focus": EncoderPart(counts_per_turn=100.0)})):
        rig = RIG.model_copy(update={"encoders": encoders})
        session, manifest, _ = record(tmp_path / name, rig=rig, seconds=0.5)
        assert problems_of(tmp_path / name, rig, session.equipment.sources, (), 10) == []
