"""Small folders as the rig's recorder writes them, with faults at known times."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from acino_fte.data_tools.bags_serial import CDR, definitions, encode
from acino_fte.data_tools.recording import ImuSamples, LidarReturns, PictureInfo
from acino_fte.data_tools.rig_recording import Event, Manifest, RecordedStream, Segment, write_manifest
from acino_fte.data_tools.ros_messages import to_message
from acino_fte.data_tools.video import write_video

START = 1_750_000_000_000_000_000
INFO, IMAGE, POINTS, IMU = "/cam1/info", "/cam1/image", "/lidar1/points", "/lidar1/imu"
POWER_ON = {INFO: 50_000_000_000, POINTS: 900_000_000_000, IMU: 900_000_000_000}
SIZE = 48, 64


@dataclass
class Faults:
    """What goes wrong. Times are seconds since the start.

    `stalls`: topic → (start, length). `lost_frames`: numbers that the camera's messages skip. `unfilmed`:
    frames whose message is there and whose picture is not. `wall_jumps` and `device_jumps` (topic): (time,
    seconds). `twice`, `swapped`: numbers of messages by topic. `spikes`: frame → counts of the first encoder.
    """

    stalls: dict[str, tuple[float, float]] = field(default_factory=dict)
    lost_frames: tuple[int, ...] = ()
    unfilmed: tuple[int, ...] = ()
    wall_jumps: tuple[tuple[float, float], ...] = ()
    device_jumps: dict[str, tuple[float, float]] = field(default_factory=dict)
    drift: dict[str, float] = field(default_factory=dict)
    twice: dict[str, int] = field(default_factory=dict)
    swapped: dict[str, int] = field(default_factory=dict)
    spikes: dict[int, int] = field(default_factory=dict)
    zoomed: tuple[float, float] | None = None
    exposure: tuple[float, float] | None = None
    brightness: int = 110
    thin: tuple[int, ...] = ()
    rates: dict[str, float] = field(default_factory=dict)


def write_folder(
    path: Path,
    faults: Faults | None = None,
    *,
    seconds: float = 12.0,
    segment_s: float = 5.0,
    events: tuple[Event, ...] = (),
    manifest: bool = True,
    state: str = "closed",
    seed: int = 0,
    video: bool = True,
) -> Path:
    """Write a folder: a camera of 30 Hz with a video, a lidar of 10 Hz and its inertial sensor of 100 Hz."""
    faults = faults or Faults()
    path.mkdir(parents=True)
    messages = rig_messages(faults, seconds, seed)
    segments, counts = [], {INFO: 0, POINTS: 0, IMU: 0}
    for index in range(int(np.ceil(seconds / segment_s))):
        low, high = index * segment_s, (index + 1) * segment_s
        mine = [m for m in messages if low <= (m[1] - START) * 1e-9 < high]
        file = path / f"messages-{index:04d}.mcap"
        _write_mcap(file, mine, faults)
        held = {topic: sum(m[0] == topic for m in mine) for topic in counts}
        counts = {topic: n + held[topic] for topic, n in counts.items()}
        segments.append(_segment(file, "messages", index, held))
        frames = [m for m in mine if m[0] == INFO and m[2].number not in faults.unfilmed]
        if frames and video:
            file = path / f"cam1-{index:04d}.mkv"
            write_video(
                file,
                (picture(m[2].number, faults.brightness) for m in frames),
                30.0,
                [m[1] for m in frames],
                "ffv1",
            )
            segments.append(_segment(file, "video", index, {"cam1": len(frames)}))
    if manifest:
        rates = {INFO: 30.0, POINTS: 10.0, IMU: 100.0}
        kinds = {INFO: "image_info", POINTS: "lidar", IMU: "imu"}
        streams = tuple(
            RecordedStream(topic, kinds[topic], rates[topic], n, n) for topic, n in counts.items()
        )
        ends = (Event("started", START), *events, Event("stopped", START + round(seconds * 1e9)))
        write_manifest(
            path,
            Manifest(
                path.name,
                state,
                START,
                7_000_000_000,
                START + round(seconds * 1e9) if state == "closed" else None,
                streams=streams,
                segments=tuple(segments),
                events=ends,
            ),
        )
    return path


def rig_messages(faults: Faults, seconds: float, seed: int = 0) -> list[tuple]:
    """(topic, log time, value, wall time) of all messages, as they were received."""
    rng = np.random.default_rng(seed)
    messages = [m for topic in (INFO, POINTS, IMU) for m in _messages(topic, seconds, faults, rng)]
    return sorted(messages, key=lambda m: m[1])


def picture(number: int, brightness: int = 110) -> np.ndarray:
    """A picture whose bright column tells its number, to 4."""
    pixels = np.full(SIZE, brightness, np.uint8)
    column = 4 * (number % 16)
    pixels[:, column : column + 4] = 220 if brightness < 180 else 20
    return np.repeat(pixels[..., None], 3, axis=2)


def _messages(topic, seconds, faults, rng):
    """(topic, log time, value, wall time) of every message of a topic."""
    rate = faults.rates.get(topic) or {INFO: 30.0, POINTS: 10.0, IMU: 100.0}[topic]
    since = np.rint(np.arange(0, seconds, 1 / rate) * 1e9).astype(np.int64) + 3_000_000
    device = POWER_ON[topic] + since - np.rint(faults.drift.get(topic, 0.0) * since).astype(np.int64)
    if topic in faults.device_jumps:
        at, size = faults.device_jumps[topic]
        device = device + np.where(since >= at * 1e9, round(size * 1e9), 0)
    log = START + since + np.rint(rng.exponential(2e5, len(since))).astype(np.int64) + 200_000
    wall = log.copy()
    for at, size in faults.wall_jumps:
        wall = wall + np.where(since >= at * 1e9, round(size * 1e9), 0)
    keep = np.ones(len(since), bool)
    if topic in faults.stalls:
        at, length = faults.stalls[topic]
        keep &= (since < at * 1e9) | (since >= (at + length) * 1e9)
    if topic == INFO:
        keep[[n for n in faults.lost_frames if n < len(keep)]] = False
    rows = np.flatnonzero(keep).tolist()
    if topic in faults.twice:
        rows.insert(faults.twice[topic], rows[faults.twice[topic]])
    values = [_value(topic, n, int(device[n]), since[n] * 1e-9, faults) for n in rows]
    if topic in faults.swapped:
        i = faults.swapped[topic]
        values[i], values[i + 1] = values[i + 1], values[i]
    return [(topic, int(log[n]), value, int(wall[n])) for n, value in zip(rows, values, strict=True)]


def _value(topic, n, stamp, time, faults):
    if topic == IMU:
        return ImuSamples(np.array([stamp]), np.zeros((1, 3)), np.array([[0.0, 0.0, 9.81]]), "power_on")
    if topic == POINTS:
        k = 20 if n in faults.thin else 100
        times = stamp + np.arange(k) * 4167
        xyz = np.column_stack([np.linspace(20, 30, k), np.zeros(k), np.ones(k)])
        return LidarReturns(times, xyz, np.full(k, 30.0), np.zeros(k, np.uint8), np.zeros(k, np.uint8))
    zoom = 1000 + faults.spikes.get(n, 0)
    if faults.zoomed is not None:
        begin, end = faults.zoomed
        zoom += round(300 * min(max(time - begin, 0), 0.5)) - round(300 * min(max(time - end, 0), 0.5))
    pan = round(40 * np.sin(time))
    exposure = 1000.0
    if faults.exposure is not None and time >= faults.exposure[0]:
        exposure = faults.exposure[1]
    return PictureInfo(stamp // 1000 * 1000, n, exposure, 0.0, (zoom, 500, pan, -pan))


def _write_mcap(file, messages, faults):
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=20_000, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        channels = {}
        for topic, log, value, wall in messages:
            name, fields = to_message(value, "rig")
            if topic not in channels:
                schema = writer.register_schema(name, "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = encode(fields, name, definitions(name, "", 2), CDR)
            writer.add_message(channels[topic], log, data, wall)
        writer.finish()


def _segment(file, kind, index, counts):
    return Segment(file.name, kind, index, True, counts=counts, n_bytes=file.stat().st_size)
