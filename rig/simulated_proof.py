"""Holds a recording of a simulated rig against what was simulated: all is there, every fault is told.

The tolerances are those of what can be known: a silence begins and ends between two samples, a device is
tried again every quarter of a second, disk and wall clock are looked at ten times a second.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acino_fte.data_tools.rig_recording import Event, Manifest, read_manifest
from acino_fte.rig.faults import Fault, wall_shift_s
from acino_fte.rig.recorder import TICK_S
from acino_fte.rig.recorder_readers import RETRY_S
from acino_fte.rig.rig_file import RigFile
from acino_fte.rig.simulated import SimulatedSource
from acino_fte.rig.sources import SourceStream, camera_topic

_LATE_S = 0.004  # of a sample: the simulated delay, and rounding
_VIDEO_NS = 1_000_000  # times in Matroska are whole ms
_NO_LOSS = ("started", "stopped")


@dataclass(frozen=True)
class Expected:
    """An event that must be there: when and how long, s, how many; and to what (s) that can be known."""

    kind: str
    stream: str
    at_s: float
    seconds: float
    count: int | None
    time_error_s: float
    length_error_s: float

    def fits(self, event: Event, started_ns: int) -> bool:
        """Whether this is the event."""
        at = (event.time_ns - started_ns) * 1e-9
        return (
            event.kind == self.kind
            and event.stream == self.stream
            and abs(at - self.at_s) <= self.time_error_s
            and abs(event.seconds - self.seconds) <= self.length_error_s
            and (self.count is None or event.count == self.count)
        )


def expected_events(
    rig: RigFile, sources: Sequence[SimulatedSource], faults: Sequence[Fault]
) -> list[Expected]:
    """What the faults must show as."""
    streams = [stream for source in sources for stream in source.streams]
    frame_s = 1 / next(iter(rig.cameras.values())).fps if rig.cameras else 0.0
    found = []
    for fault in faults:
        hit = [stream for stream in streams if fault.hits(stream.name)]
        found += [_of_stream(fault, stream) for stream in hit if fault.kind in ("stall", "unplug", "lost")]
        if fault.kind == "clock":
            found.append(Expected("clock_jump", "", fault.at_s, fault.amount, None, TICK_S, 1e-3))
        elif fault.kind == "disk":
            found.append(Expected("disk_full", "", fault.at_s, 0.0, None, TICK_S, 0.0))
        elif fault.kind == "lens":
            camera, error = next(iter(rig.cameras)), frame_s + _LATE_S
            back = fault.at_s + fault.amount
            found.append(Expected("lens_moved", camera, fault.at_s, fault.amount, None, error, error))
            found.append(Expected("lens_back", camera, back, 0.0, None, error, 0.0))
    return found


def _of_stream(fault: Fault, stream: SourceStream) -> Expected:
    period = 1 / stream.expected_hz
    error = period + _LATE_S
    if fault.kind == "lost":
        n = int(fault.amount)
        return Expected("lost", stream.name, fault.at_s, n * period, n, error, error)
    if fault.kind == "stall":
        n = len(_inside(fault, period))
        return Expected("stall", stream.name, fault.at_s, fault.amount, n, error, error)
    again = RETRY_S + period + _LATE_S  # it is there again when it was tried, and the next sample came
    middle = fault.amount + again / 2
    return Expected("unplugged", stream.name, fault.at_s, middle, None, error, again / 2 + error)


def _inside(fault: Fault, period: float) -> range:
    """Numbers of the samples in a stall."""
    first, last = (int(np.ceil(at / period - 1e-6)) for at in (fault.at_s, fault.at_s + fault.amount))
    return range(first, last)


def problems_of(
    folder: Path,
    rig: RigFile,
    sources: Sequence[SimulatedSource],
    faults: Sequence[Fault],
    decode_every: int = 1,
) -> list[str]:
    """What is wrong with a recording, one sentence each; nothing where it is as it must be.

    Parameters
    ----------
    folder : Path
        The recording.
    rig : RigFile
        As it was recorded with.
    sources : sequence of SimulatedSource
        They know what they delivered.
    faults : sequence of Fault
        As they were set.
    decode_every : int
        Frames of which one is decoded, to compare the number burnt into it.
    """
    manifest = read_manifest(folder)
    found = list(_event_problems(manifest, expected_events(rig, sources, faults)))
    if manifest.state != "closed" or not all(segment.closed for segment in manifest.segments):
        found.append("the manifest is not that of a closed recording")
    counts: dict[str, int] = {}
    for segment in manifest.segments:
        if segment.kind == "messages":
            found += _segment_problems(folder, manifest, rig, segment.index, faults, decode_every, counts)
    delivered = {name: n for source in sources for name, n in source.delivered.items()}
    delivered |= {camera_topic(name): delivered[name] for name in rig.cameras}
    found += [
        f"{name}: {n} delivered, {counts.get(name, 0)} on the disk"
        for name, n in delivered.items()
        if counts.get(name, 0) != n
    ]
    return found


def _event_problems(manifest: Manifest, expected: list[Expected]) -> Iterator[str]:
    left = [event for event in manifest.events if event.kind not in _NO_LOSS]
    for one in expected:
        match = next((event for event in left if one.fits(event, manifest.started_ns)), None)
        if match is None:
            yield f"not told as it was: {one}"
        else:
            left.remove(match)
    for event in left:
        yield f"told, but it was not: {event}"


def _segment_problems(
    folder: Path, manifest: Manifest, rig: RigFile, index: int, faults: Sequence[Fault], decode_every: int,
    counts: dict[str, int],
) -> Iterator[str]:  # fmt: skip
    """One segment: messages whole and stamped, each frame with its message."""
    from acino_fte.data_tools.bags import BagReader
    from acino_fte.data_tools.recording import PictureInfo

    infos: dict[str, list[tuple[int, int]]] = {camera_topic(name): [] for name in rig.cameras}
    last: dict[str, int] = {}
    with BagReader(folder / f"messages-{index:04d}.mcap") as reader:
        for record in reader.records():
            name, log = record.stream, record.received_ns or 0
            counts[name] = counts.get(name, 0) + 1
            if log <= last.get(name, 0):
                yield f"{name}: log times do not rise at message {counts[name]}"
            last[name] = log
            shift = ((record.published_ns or 0) - log) * 1e-9
            true = wall_shift_s(faults, (log - manifest.started_ns) * 1e-9)
            if abs(shift - true) > 1e-3 and not _at_jump(faults, (log - manifest.started_ns) * 1e-9):
                yield f"{name}: wall time {shift:+.3f} s off at message {counts[name]}, not {true:+.3f} s"
            if isinstance(record.value, PictureInfo):
                if len(record.value.encoders) != len(rig.encoders):
                    yield f"{name}: no encoder counts at message {counts[name]}"
                infos[name].append((log, record.value.number))
        if not reader.damage.whole:
            yield f"segment {index}: {reader.damage}"
    for camera in rig.cameras:
        path = folder / f"{camera}-{index:04d}.mkv"
        if path.exists() or infos[camera_topic(camera)]:
            yield from _video_problems(
                path, manifest, infos[camera_topic(camera)], decode_every, counts, camera
            )


def _at_jump(faults: Sequence[Fault], elapsed: float) -> bool:
    return any(fault.kind == "clock" and abs(fault.at_s - elapsed) < 1e-6 for fault in faults)


def _video_problems(
    path: Path, manifest: Manifest, infos: list[tuple[int, int]], decode_every: int, counts: dict[str, int],
    camera: str,
) -> Iterator[str]:  # fmt: skip
    """One video: as many frames as messages, at their times, with their numbers."""
    from acino_fte.data_tools.video import VideoReader
    from acino_fte.rig.simulated_camera import burnt_number

    with VideoReader(path) as video:
        stamps = video.stamps_ns
        counts[camera] = counts.get(camera, 0) + len(stamps)
        if len(stamps) != len(infos):
            yield f"{path.name}: {len(stamps)} frames, {len(infos)} messages"
            return
        logs = np.array([log for log, _ in infos], np.int64) - manifest.started_ns
        off = np.abs(stamps - logs).max(initial=0)
        if off > _VIDEO_NS:
            yield f"{path.name}: times differ by {off * 1e-6:.3f} ms from those of the messages"
        for k in range(0, len(infos), decode_every):
            number = burnt_number(video.at(k).pixels)
            if number != infos[k][1]:
                yield f"{path.name}: frame {k} shows the number {number}, its message says {infos[k][1]}"
