"""LVX files in: recordings of Livox lidars, versions 1.0 and 1.1 and LVX2.

The file is read once, a few megabytes at a time. Everything that is whole is read, before and after damage.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from acino_fte.data_tools.lvx_head import LvxHead, is_lvx, open_binary, read_head
from acino_fte.data_tools.lvx_losses import ErrorLog, LidarWarning, StampLog
from acino_fte.data_tools.lvx_packets import (
    FARTHEST_M,
    IMU_NS,
    LINES,
    SAMPLE_NS,
    LvxDevice,
    Version,
    decode_imu,
    decode_points,
    decode_stamps,
)
from acino_fte.data_tools.lvx_recognise import PackageTest
from acino_fte.data_tools.lvx_walk import Hole, RawFrame, Walk
from acino_fte.data_tools.recording import (
    Clock,
    Damage,
    ImuSamples,
    Kind,
    LidarReturns,
    Record,
    Stream,
)

__all__ = ["LvxDevice", "LvxReader", "is_lvx"]

_SHOWN = 20
_PEEK_FRAMES = 4
_PPS_NS = 1_000_000_000


class LvxReader:
    """A Livox recording: streams ``lidar<index>`` and ``imu<index>``, a record of each per frame of the file.

    Every return has its own time: the stamp of its package plus its sample's number times the lidar's step
    (Tele-15: 4167 ns); returns of one sample share it. Samples without a return are left out. Positions are
    in the frame of the lidar: extrinsics of the head are not applied. Times are by the lidar's clock; there
    is no time of the computer. Stamps since a pulse (PPS) count on from the first second of the device.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    version : {"1.0", "1.1", "2"}
    devices : tuple of LvxDevice
        Of the head, then those that it does not name.
    notes : tuple of str
        What is odd but cost nothing: a wrong head or offset, warnings of the lidar; complete in the end.

    Raises
    ------
    InputError
        There is no such file, or it is no LVX at all.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        with open_binary(self.path) as file:
            self._head = read_head(file, self.path)
            self._test, self._notes = _package_test(self._head), list(self._head.notes)
            seen = self._peek(Walk(file, self._test, self._head.start))
            if not seen and self._test.devices:
                self._test = PackageTest(self._head.layout)
                seen = self._peek(Walk(file, self._test, self._head.start))
                if seen:
                    self._notes.append("The packages are of devices that the head does not name.")
        self.version: Version = self._head.layout.version
        self._reading = _Reading(self._head, self._test)
        self._streams = self._named(seen)

    @property
    def devices(self) -> tuple[LvxDevice, ...]:
        """The devices, by index."""
        return tuple(self._reading.devices.values())

    @property
    def streams(self) -> tuple[Stream, ...]:
        """The streams; one that begins late in the file appears once it was reached."""
        known = {stream.name for stream in self._streams}
        late = [stream for stream in self._named(self._reading.kinds) if stream.name not in known]
        return (*self._streams, *late)

    @property
    def damage(self) -> Damage:
        """What was lost so far; complete once all records were read."""
        return self._reading.damage(self._head.cut)

    @property
    def stamp_logs(self) -> dict[str, StampLog]:
        """Of every stream so far, which packages are missing; complete once all records were read."""
        return dict(self._reading.logs)

    @property
    def warnings(self) -> tuple[LidarWarning, ...]:
        """What the lidars' error codes say; complete once all records were read."""
        return self._reading.errors.warnings

    @property
    def notes(self) -> tuple[str, ...]:
        """What is odd but cost nothing."""
        return (*self._notes, *self._reading.notes())

    def records(
        self, kinds: Collection[Kind] | None = None, streams: Collection[str] | None = None
    ) -> Iterator[Record]:
        """Records in the order of the file; only those of some kinds and streams, where they are named."""
        self._reading = reading = _Reading(self._head, self._test)
        with open_binary(self.path) as file:
            reading.walk = Walk(file, self._test, self._head.start)
            for frame in reading.frames():
                for record in reading.records(frame):
                    if (kinds is None or record.kind in kinds) and (
                        streams is None or record.stream in streams
                    ):
                        yield record

    def __enter__(self) -> LvxReader:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing stays open between records."""

    def _peek(self, walk: Walk) -> dict[tuple[int, int], None]:
        """Devices (as packages call them) and data types of the first frames."""
        seen: dict[tuple[int, int], None] = {}
        for number, frame in enumerate(walk.frames()):
            seen.update(dict.fromkeys((device, kind) for device, kind, _ in frame.packages))
            if number >= _PEEK_FRAMES:
                break
        return seen

    def _named(self, seen: dict[tuple[int, int], None]) -> tuple[Stream, ...]:
        """Streams of devices and data types; a device of the head without packages has one too."""
        layout = self._head.layout
        names: dict[str, Stream] = {}
        for number, kind in seen:
            index = self._reading.index(number)
            imu = kind == layout.imu_kind
            name = f"{'imu' if imu else 'lidar'}{index}"
            names.setdefault(name, Stream(name, "imu" if imu else "lidar", layout.kinds[kind].name))
        for device in self._head.devices:
            name = f"lidar{device.index}"
            if device.type != 0:  # a hub has no returns of its own
                names.setdefault(name, Stream(name, "lidar", "livox"))
        return tuple(sorted(names.values(), key=lambda s: (s.kind != "lidar", len(s.name), s.name)))


def _package_test(head: LvxHead) -> PackageTest:
    return PackageTest(head.layout, head.numbers or None)


class _Reading:
    """One pass through the file: packages to records, and the account of what is missing."""

    def __init__(self, head: LvxHead, test: PackageTest) -> None:
        self.devices = {device.index: device for device in head.devices}
        self.kinds: dict[tuple[int, int], None] = {}
        self.walk: Walk | None = None
        self._layout, self._test = head.layout, test
        self._numbers = dict(head.numbers)
        self._types: dict[tuple[int, int], np.dtype] = {}
        self.logs: dict[str, StampLog] = {}
        self.errors = ErrorLog()
        self._clocks: dict[str, set[str]] = {}
        self._last_pps: dict[int, int] = {}
        self._held: dict[tuple[int, bool, int], list[tuple[int, bytes]]] = {}
        self._final = False
        self._n_read = self._n_far = 0

    def index(self, number: int) -> int:
        """Index of the device that packages call `number`."""
        if number not in self._numbers:
            second = self._layout.version == "2"
            self._numbers[number] = max(self.devices, default=-1) + 1 if second else number
        index = self._numbers[number]
        self.devices.setdefault(index, LvxDevice(index, type=None))
        return index

    def frames(self) -> Iterator[RawFrame]:
        """The frames of the walk, and an empty one at the end for the packages that wait."""
        if self.walk is not None:
            yield from self.walk.frames()
        self._final = True
        yield RawFrame()

    def records(self, frame: RawFrame) -> Iterator[Record]:
        """One record of every device's returns and of its inertial samples."""
        groups, self._held = self._held, {}
        clock_at = 6 if self._layout.version == "2" else 9
        imu_kind = self._layout.imu_kind
        for number, kind, package in frame.packages:
            self.kinds.setdefault((number, kind))
            groups.setdefault((number, kind == imu_kind, package[clock_at]), []).append((kind, package))
        self._n_read += len(frame.packages)
        for (number, imu, code), packages in groups.items():
            index = self.index(number)
            clock = self._layout.clocks.get(code, "unknown")
            name = f"{'imu' if imu else 'lidar'}{index}"
            self._clocks.setdefault(name, set()).add(clock)
            tables, stamps, keep = self._tables(index, name, imu, packages, clock)
            if self.logs[name].held:
                self._held[number, imu, code] = packages[-1:]
            value = self._imu(tables, stamps, keep, clock) if imu else None
            if not imu:
                value = self._lidar(index, name, tables, stamps, keep, clock)
            if value is not None and len(value):
                yield Record(stream=name, kind="imu" if imu else "lidar", received_ns=None, value=value)

    def _tables(
        self, index: int, name: str, imu: bool, packages: list[tuple[int, bytes]], clock: Clock
    ) -> tuple[list[tuple[int, np.ndarray, np.ndarray]], np.ndarray, np.ndarray]:
        """Packages by layout as (data type, places, table); stamps (P,) ns, and which are whole (P,)."""
        by_layout: dict[tuple[int, int], list[int]] = {}
        for place, (kind, package) in enumerate(packages):
            by_layout.setdefault((kind, len(package)), []).append(place)
        stamps = np.zeros(len(packages), np.int64)
        samples = np.zeros(len(packages), np.int64)
        tables = []
        for (kind, size), chosen in by_layout.items():
            if (kind, size) not in self._types:
                n = self._test.samples(packages[chosen[0]][1])
                self._types[kind, size] = self._layout.package(kind, n)
            table = np.frombuffer(b"".join(packages[i][1] for i in chosen), self._types[kind, size])
            places = np.array(chosen)
            stamps[places] = decode_stamps(table["header"]["stamp"], clock, self._layout.version)
            samples[places] = table["samples"].shape[1]
            tables.append((kind, places, table))
            if "error" in (table["header"].dtype.names or ()):
                self.errors.add(index, table["header"]["error"], stamps[places])
        if clock == "pps":
            stamps = self._counted_on(index, stamps)
        return tables, stamps, self._log(index, name, imu).add(stamps, samples, self._final)

    def _log(self, index: int, name: str, imu: bool) -> StampLog:
        if name not in self.logs:
            kind = self.devices[index].type
            step = IMU_NS if imu else SAMPLE_NS.get(-1 if kind is None else kind)
            self.logs[name] = StampLog(name, step)
        return self.logs[name]

    def _counted_on(self, index: int, stamps: np.ndarray) -> np.ndarray:
        """Stamps since the last pulse, as stamps since the first one: the nearest second to those before."""
        stamps = np.unwrap(stamps, period=_PPS_NS)
        last = self._last_pps.get(index, int(stamps[0]))
        stamps = stamps + round((last - int(stamps[0])) / _PPS_NS) * _PPS_NS
        self._last_pps[index] = int(stamps[-1])
        return stamps

    def _imu(
        self,
        tables: list[tuple[int, np.ndarray, np.ndarray]],
        stamps: np.ndarray,
        keep: np.ndarray,
        clock: Clock,
    ) -> ImuSamples:
        rate, force = np.zeros((len(stamps), 3)), np.zeros((len(stamps), 3))
        for _, places, table in tables:
            rate[places], force[places] = decode_imu(table["samples"][:, 0])
        keep = keep & np.isfinite(rate).all(1) & np.isfinite(force).all(1)
        return ImuSamples(stamps[keep], rate[keep], force[keep], clock)

    def _lidar(
        self,
        index: int,
        name: str,
        tables: list[tuple[int, np.ndarray, np.ndarray]],
        stamps: np.ndarray,
        keep: np.ndarray,
        clock: Clock,
    ) -> LidarReturns:
        step = round(self.logs[name].step_ns())
        lines = LINES.get(self.devices[index].type or 0, 1)
        parts = []
        for kind, places, table in tables:
            rows = keep[places]
            with np.errstate(over="ignore", invalid="ignore"):
                xyz, reflectivity, tag = decode_points(self._layout.kinds[kind], table["samples"][rows])
                here = (xyz != 0).any(-1)
                near = (xyz**2).sum(-1) <= FARTHEST_M**2
            self._n_far += int((here & ~near).sum())
            here &= near
            sample = np.arange(xyz.shape[1])
            times = stamps[places][rows][:, None, None] + (step * sample)[:, None]
            line = np.broadcast_to((sample % lines).astype(np.uint8)[:, None], here.shape)
            parts.append(
                (
                    np.broadcast_to(times, here.shape)[here],
                    xyz[here],
                    reflectivity[here].astype(np.float32),
                    tag[here],
                    line[here],
                )
            )
        if len(parts) == 1:
            return LidarReturns(*parts[0], clock=clock)
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        order = np.argsort(columns[0], kind="stable")
        return LidarReturns(*(column[order] for column in columns), clock=clock)

    def notes(self) -> list[str]:
        """What was odd on the way."""
        out = self.errors.sentences()
        if self.walk is not None and self.walk.n_wrong_offsets:
            out.append(
                f"{self.walk.n_wrong_offsets} frames have wrong offsets; they were found all the same."
            )
        out += [
            f"{name}: the stamps change between clocks: {', '.join(sorted(clocks))}."
            for name, clocks in self._clocks.items()
            if len(clocks) > 1
        ]
        return out

    def damage(self, cut_head: bool) -> Damage:
        """The account so far."""
        holes = self.walk.holes if self.walk is not None else []
        logs = list(self.logs.values())
        places = ["The file ends within its head."] if cut_head else []
        places += [_sentence(hole) for hole in holes[:_SHOWN]]
        if len(holes) > _SHOWN:
            places.append(f"{len(holes) - _SHOWN} more damaged places.")
        places += [sentence for log in logs for sentence in log.sentences()]
        if self._n_far:
            places.append(f"{self._n_far} returns beyond {FARTHEST_M:.0f} m are damaged; they were left out.")
        left_out = sum(log.n_outliers for log in logs)
        return Damage(
            n_read=self._n_read - left_out,
            n_lost=sum(log.n_lost for log in logs) + sum(hole.n_lost or 0 for hole in holes),
            bytes_lost=sum(hole.stop - hole.start for hole in holes),
            places=tuple(places),
        )


def _sentence(hole: Hole) -> str:
    length = hole.stop - hole.start
    what = f"{length} bytes from byte {hole.start} on were skipped: {hole.why}"
    if not length:
        what = f"At byte {hole.start}: {hole.why}"
    return f"{what}; about {hole.n_lost} packages are lost." if hole.n_lost else f"{what}."
