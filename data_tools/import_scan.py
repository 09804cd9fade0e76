"""What a recording holds: one walk through it that keeps stamps and inertial samples, and nothing large."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from acino_fte.data_tools.open_recording import open_recording
from acino_fte.data_tools.recording import (
    Damage,
    ImuSamples,
    Kind,
    LidarReturns,
    Picture,
    PictureInfo,
    Record,
    RecordingReader,
)
from acino_fte.data_tools.sync import Stamps
from acino_fte.errors import InputError, did_you_mean

_NAMES = {"lidar": "lidar", "imu": "inertial sensor", "image": "camera", "image_info": "camera"}
_OPTIONS = {
    "lidar": "--lidar-topic",
    "imu": "--imu-topic",
    "image": "--camera-topic",
    "image_info": "--camera-topic",
}


@dataclass(eq=False)
class StreamScan:
    """Stamps of one stream. K messages.

    Attributes
    ----------
    name, kind, type : str
    device, received, number : list of int
        Of every message: stamp of the sensor (of a lidar, of the last return), time of reception, number of
        the frame; `received` is empty where there is none, `number` where frames are not counted.
    clock : str
        Which clock the stamps of the sensor are of.
    n_values : int
        Returns or samples.
    first_ns : int
        Stamp of the first return or sample of the first message.
    spread : bool
        Whether the returns of a message have times of their own.
    imu : list of ImuSamples
        Of an inertial sensor.
    encoders : list of tuple
        Of a camera's messages.
    """

    name: str
    kind: Kind
    type: str
    device: list[int] = field(default_factory=list)
    received: list[int] = field(default_factory=list)
    number: list[int] = field(default_factory=list)
    clock: str = "unknown"
    n_values: int = 0
    spread: bool = False
    first_ns: int = 0
    imu: list[ImuSamples] = field(default_factory=list)
    encoders: list[tuple[int, ...]] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.device)

    @property
    def stamps(self) -> Stamps:
        """All stamps as arrays."""
        device = np.array(self.device, dtype=np.int64)
        received = np.array(self.received, dtype=np.int64) if len(self.received) == len(device) else None
        number = np.array(self.number, dtype=np.int64) if len(self.number) == len(device) else None
        return Stamps(device, received, number)

    @property
    def duration(self) -> float:
        """From the first stamp to the last, s, by the computer's clock where it is known."""
        times = self.received or self.device
        return (max(times) - min(times)) * 1e-9 if times else 0.0

    @property
    def rate(self) -> float:
        """Messages (of an inertial sensor: samples) per second; 0 where there is only one."""
        n = self.n_values if self.kind == "imu" else len(self)
        return (n - 1) / self.duration if self.duration > 0 and n > 1 else 0.0

    def samples(self) -> ImuSamples:
        """All inertial samples, in the order of the recording."""
        return ImuSamples(
            np.concatenate([one.time_ns for one in self.imu]),
            np.concatenate([one.rate for one in self.imu]),
            np.concatenate([one.force for one in self.imu]),
            self.imu[0].clock,
        )

    def add(self, record: Record) -> None:
        """Take note of one record."""
        value = record.value
        if isinstance(value, LidarReturns | ImuSamples):
            if not len(value):
                return
            first, last = int(value.time_ns.min()), int(value.time_ns.max())
            if not self.device:
                self.first_ns = first
            self.device.append(last)
            self.clock = value.clock
            self.n_values += len(value)
            self.spread |= last > first
            if isinstance(value, ImuSamples):
                self.imu.append(value)
        elif isinstance(value, Picture | PictureInfo):
            self.device.append(value.time_ns)
            self.n_values += 1
            if value.number is not None:
                self.number.append(value.number)
            if isinstance(value, PictureInfo):
                self.encoders.append(value.encoders)
        else:
            return
        if record.received_ns is not None:
            self.received.append(record.received_ns)


@dataclass(frozen=True, eq=False)
class Scan:
    """A recording after one walk through it."""

    path: Path
    streams: dict[str, StreamScan]
    damage: Damage
    notes: tuple[str, ...]

    def of_kind(self, kind: Kind) -> list[StreamScan]:
        """The streams of a kind that have messages."""
        return [stream for stream in self.streams.values() if stream.kind == kind and len(stream)]

    def choose(self, kind: Kind, name: str | None, *, needed: bool = False) -> StreamScan | None:
        """The stream of a kind: the named one, or the only one.

        Raises
        ------
        InputError
            It is not there though it was named or is needed, or there are several and none was named.
        """
        found = self.of_kind(kind)
        if name is not None:
            for stream in found:
                if stream.name == name:
                    return stream
            if kind in ("image", "image_info"):  # one topic names both, which lie side by side
                beside = [one for one in found if one.name.rpartition("/")[0] == name.rpartition("/")[0]]
                return beside[0] if len(beside) == 1 else None
            names = [stream.name for stream in found]
            raise InputError(
                f"The recording has no such {_NAMES[kind]}{did_you_mean(name, names)}",
                file=self.path,
                key=_OPTIONS[kind],
                expected=", ".join(names) or f"no {_NAMES[kind]} at all",
                found=name,
                remedy="see what it holds with --inspect",
            )
        if len(found) > 1:
            raise InputError(
                f"The recording has several streams of this kind: {_NAMES[kind]}.",
                file=self.path,
                key=_OPTIONS[kind],
                expected="one of them to be named",
                found=", ".join(stream.name for stream in found),
                remedy=f"name one, as {_OPTIONS[kind]} {found[0].name}",
            )
        if not found and needed:
            kinds = sorted({stream.kind for stream in self.streams.values()}) or ["nothing"]
            raise InputError(
                f"There is no {_NAMES[kind]} in the recording.",
                file=self.path,
                expected=f"messages of a {_NAMES[kind]}",
                found=", ".join(kinds),
                remedy="give the recording that has the lidar; the video goes to --video",
            )
        return found[0] if found else None


def scan_recording(
    path: Path | str, tell: Callable[[str], None] | None = None, *, pictures: bool = False
) -> Scan:
    """Walk through a recording once.

    Parameters
    ----------
    path : Path
        A file, or the folder of a ROS 2 bag.
    tell : callable, optional
        Is told how far it is.
    pictures : bool
        Whether to decode pictures even where the camera's driver describes them in messages of its own.

    Raises
    ------
    InputError
        There is no such recording.
    """
    with open_recording(path) as reader:
        known = reader.streams
        kinds: set[Kind] = {"lidar", "imu", "image_info"}
        if pictures or not any(stream.kind == "image_info" for stream in known):
            kinds.add("image")
        scans = {stream.name: StreamScan(stream.name, stream.kind, stream.type) for stream in known}
        for n, record in enumerate(reader.records(kinds=kinds)):
            if record.stream not in scans:
                scans[record.stream] = StreamScan(record.stream, record.kind, "")
            scans[record.stream].add(record)
            if tell is not None and n % 2000 == 1999:
                tell(f"reading: {n} messages")
        _count_unread(reader, scans, kinds)
        notes = tuple(getattr(reader, "notes", ()))
        return Scan(Path(path), scans, reader.damage, notes)


def _count_unread(reader: RecordingReader, scans: dict[str, StreamScan], kinds: set[Kind]) -> None:
    """Counts of streams whose messages were not decoded."""
    for stream in reader.streams:
        scan = scans.setdefault(stream.name, StreamScan(stream.name, stream.kind, stream.type))
        if stream.kind not in kinds and stream.count:
            scan.n_values = stream.count


def inspection(scan: Scan) -> list[str]:
    """Lines that say what a recording holds: streams with counts, rates and lengths, and damage."""
    rows = [("stream", "kind", "messages", "per second", "seconds", "type")]
    for stream in scan.streams.values():
        n = len(stream) or stream.n_values
        rate = f"{stream.rate:.1f}" if stream.rate else "-"
        seconds = f"{stream.duration:.2f}" if len(stream) else "-"
        rows.append((stream.name, stream.kind, str(n), rate, seconds, stream.type))
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    lines = []
    for row in rows:
        left = "  ".join(cell.ljust(width) for cell, width in zip(row[:2], widths, strict=False))
        right = "  ".join(cell.rjust(width) for cell, width in zip(row[2:5], widths[2:], strict=False))
        lines.append(f"{left}  {right}  {row[5]}".rstrip())
    return [*lines, damage_line(scan.damage), *scan.notes]


def damage_line(damage: Damage) -> str:
    """One sentence on what could not be read."""
    if damage.whole:
        return "damage: none"
    parts = [f"{damage.n_lost} messages lost", f"{damage.bytes_lost} bytes skipped"]
    more = "; …" if len(damage.places) > 3 else ""
    places = f" ({'; '.join(damage.places[:3])}{more})" if damage.places else ""
    return f"damage: {', '.join(parts)}, {damage.n_read} read{places}"
