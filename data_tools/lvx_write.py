"""LVX files out: what Livox Viewer records, for simulated rigs, tests and copies."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.lvx_packets import (
    LAYOUTS,
    MAGIC,
    PUBLIC,
    SAMPLE_NS,
    SIGNATURE,
    LvxDevice,
    PacketKind,
    Version,
    encode_imu,
    encode_points,
    encode_stamps,
)
from acino_fte.data_tools.recording import Clock, ImuSamples, LidarReturns
from acino_fte.errors import InputError

Frame = Mapping[str, LidarReturns | ImuSamples]
_CODES_1: dict[Clock, int] = {"power_on": 0, "unknown": 0, "ptp": 1, "unix": 1, "gps": 3, "pps": 4}
_CODES_2: dict[Clock, int] = {"power_on": 0, "unknown": 0, "pps": 0, "ptp": 1, "unix": 1, "gps": 2}
_PAUSE_NS = 1_000_000_000


def write_lvx(
    path: Path | str, devices: Sequence[LvxDevice], frames: Iterable[Frame], **options: Any
) -> None:
    """Write a whole LVX file; see :class:`LvxWriter` for the arguments.

    Examples
    --------
    >>> devices = [LvxDevice(index=0, code="3GGDJ6K00100101", type=2)]
    >>> write_lvx("rig.lvx", devices, ({"lidar0": returns, "imu0": samples} for returns, samples in rig))
    """
    with LvxWriter(path, devices, **options) as writer:
        for frame in frames:
            writer.write(frame)


class LvxWriter:
    """Write an LVX file frame by frame; it appears at its place when the writer closes, whole.

    A lidar fires at fixed intervals: the returns are put into packages of its samples, and a sample without a
    return is written as such, (0, 0, 0). So the times of the returns must lie on that grid, first time of a
    device + n × `sample_ns`, to half a step. Positions are rounded to the steps of the file (type 2: mm), IMU
    samples to float. A package that a frame does not fill waits for the next one.

    Parameters
    ----------
    path : Path
        The file; it is replaced.
    devices : sequence of LvxDevice
        ``LvxDevice(index=0, code="...", type=2)`` is a Tele-15. Its streams are ``lidar0`` and ``imu0``.
    version : {"1.1", "1.0", "2"}
    data_type : int, optional
        Of the returns; the default is 2 (x, y, z, reflectivity, tag), 0 for version 1.0 and 1 for version 2.
        Types with two or three returns take returns of one time as those of one sample.
    frame_duration_ms : int
        What the header claims.
    sample_ns : int, optional
        Between two samples; the default is the device's (Tele-15: 4167 ns), for unknown devices 4167 ns.
    error : callable, optional
        (device index, number of the package) → error code to write.
    drop : callable, optional
        (device index, number of the package) → True where the datagram shall be missing.

    Raises
    ------
    InputError
        The file cannot be written, or returns do not fit (two in one sample, backwards in time).

    Examples
    --------
    >>> with LvxWriter("rig.lvx", [LvxDevice(index=0, type=2)]) as writer:
    ...     writer.write({"lidar0": returns, "imu0": samples})
    """

    def __init__(
        self,
        path: Path | str,
        devices: Sequence[LvxDevice],
        *,
        version: Version = "1.1",
        data_type: int | None = None,
        frame_duration_ms: int = 50,
        sample_ns: int | None = None,
        error: Callable[[int, int], int] | None = None,
        drop: Callable[[int, int], bool] | None = None,
    ) -> None:
        self.path = Path(path)
        self._layout = LAYOUTS[version]
        self._type = {"1.1": 2, "1.0": 0, "2": 1}[version] if data_type is None else data_type
        if self._type not in self._layout.kinds or self._type == self._layout.imu_kind:
            allowed = sorted(set(self._layout.kinds) - {self._layout.imu_kind})
            raise InputError(
                f"LVX {version} has no such data type of returns.",
                expected=f"{allowed}",
                found=f"{self._type}",
            )
        self._devices = {device.index: device for device in devices}
        self._error, self._drop = error, drop
        self._sample_ns = sample_ns
        self._grids: dict[int, _Grid] = {}
        self._imu_counts: dict[int, int] = {}
        self._frames = 0
        try:
            handle, name = tempfile.mkstemp(
                prefix=f".{self.path.name}.", suffix=".part", dir=self.path.parent
            )
        except OSError as fault:
            raise InputError("The file cannot be written.", file=path, found=str(fault)) from fault
        self._part = Path(name)
        self._file = os.fdopen(handle, "wb")
        self._file.write(_file_header(self._layout.version, devices, frame_duration_ms))

    def write(self, frame: Frame) -> None:
        """Append one frame: returns and inertial samples of streams ``lidar0``, ``imu0``, …."""
        packages: list[tuple[int, bytes]] = []
        for stream, value in frame.items():
            index = self._index(stream, value)
            if isinstance(value, LidarReturns):
                packages += self._lidar(index, value)
            else:
                packages += self._imu(index, value)
        self._append(packages)

    def close(self) -> None:
        """Write what waits for a full package, and put the file at its place."""
        rest = [package for index in self._grids for package in self._lidar(index, None)]
        if rest:
            self._append(rest)
        self._file.close()
        self._part.chmod(0o644)
        self._part.replace(self.path)

    def __enter__(self) -> LvxWriter:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self.close()
        finally:
            self._file.close()
            self._part.unlink(missing_ok=True)

    def _append(self, packages: list[tuple[int, bytes]]) -> None:
        """One frame, its packages in the order of time."""
        body = b"".join(data for _, data in sorted(packages, key=lambda package: package[0]))
        start, size = self._file.tell(), self._layout.frame_bytes
        header = [start, start + size + len(body), self._frames]
        if self._layout.version == "1.0":
            header.append(len(packages))
        self._file.write(np.array(header, "<u8").tobytes() + body)
        self._frames += 1

    def _index(self, stream: str, value: LidarReturns | ImuSamples) -> int:
        prefix = "lidar" if isinstance(value, LidarReturns) else "imu"
        number = stream.removeprefix(prefix)
        if not stream.startswith(prefix) or not number.isdecimal() or int(number) not in self._devices:
            raise InputError(
                f"There is no device for the stream '{stream}'.",
                file=self.path,
                expected=", ".join(f"{prefix}{index}" for index in self._devices),
                found=stream,
            )
        return int(number)

    def _imu(self, index: int, value: ImuSamples) -> list[tuple[int, bytes]]:
        kind = self._layout.imu_kind
        packages = np.zeros(len(value), self._layout.package(kind))
        packages["samples"][:, 0] = encode_imu(value.rate, value.force)
        first = self._imu_counts.get(index, 0)
        self._imu_counts[index] = first + len(value)
        numbers = np.arange(first, first + len(value))
        return self._headed(packages, index, kind, value.time_ns, numbers, value.clock, False)

    def _lidar(self, index: int, value: LidarReturns | None) -> list[tuple[int, bytes]]:
        """Full packages of the returns so far; all of them where `value` is None."""
        kind = self._layout.kinds[self._type]
        if index not in self._grids:
            device = self._devices[index].type
            step = self._sample_ns or SAMPLE_NS.get(device if device is not None else -1, 4_167)
            self._grids[index] = _Grid(kind, step, self.path)
        grid = self._grids[index]
        ready = grid.flush() if value is None else grid.add(value)
        out = []
        for times, numbers, xyz, reflectivity, tag in ready:
            packages = np.zeros(len(times), self._layout.package(self._type))
            packages["samples"] = encode_points(kind, xyz, reflectivity, tag)
            out += self._headed(packages, index, self._type, times, numbers, grid.clock, True)
        return out

    def _headed(
        self,
        packages: np.ndarray,
        index: int,
        kind: int,
        times: np.ndarray,
        numbers: np.ndarray,
        clock: Clock,
        lidar: bool,
    ) -> list[tuple[int, bytes]]:
        """Packages with their headers, as (time, bytes); the dropped ones are left out."""
        header = packages["header"]
        header["kind"] = kind
        header["stamp"] = encode_stamps(times, clock, self._layout.version)
        if self._layout.version == "2":
            header["clock"] = _CODES_2[clock]
            header["lidar"], header["lidar_type"] = index + 1, 8
            header["counter"] = numbers % 65_536
            header["length"] = packages.dtype["samples"].itemsize
        else:
            header["clock"] = _CODES_1[clock]
            header["index"], header["version"], header["slot"], header["lidar"] = index, 5, 1, 1
            if self._error is not None:
                header["error"] = [self._error(index, int(number)) for number in numbers]
        drop = self._drop if lidar else None
        return [
            (int(time), package.tobytes())
            for time, number, package in zip(times, numbers, packages, strict=True)
            if drop is None or not drop(index, int(number))
        ]


Ready = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class _Grid:
    """The samples of one lidar: where its returns go."""

    def __init__(self, kind: PacketKind, step: int, path: Path) -> None:
        self.clock: Clock = "unknown"
        self._kind, self._step, self._path = kind, step, path
        self._start: int | None = None
        self._last = 0  # time of the last return
        self._first = 0  # number of the first package since the start
        self._done = 0  # packages written since the start
        self._wait: tuple[np.ndarray, ...] = ()

    def add(self, value: LidarReturns) -> list[Ready]:
        """Packages that no later return can fall into."""
        if not len(value):
            return []
        time = np.asarray(value.time_ns, np.int64)
        columns: tuple[np.ndarray, ...] = (time, value.xyz, value.intensity, value.tag)
        ready = []
        if (self._start is not None and time[0] - self._last > _PAUSE_NS) or value.clock != self.clock:
            ready = self.flush()
            self._start, self._first, self._done = None, self._first + self._done, 0
        self.clock, self._last = value.clock, int(time[-1])
        if self._start is None:
            self._start = int(time[0])
        if self._wait:
            columns = tuple(np.concatenate(pair) for pair in zip(self._wait, columns, strict=True))
        slots = self._slots(columns[0])
        package = slots // self._kind.samples
        stop = (int(slots[-1]) + 1) // self._kind.samples  # a package that is full need not wait
        full = package < stop
        self._wait = tuple(column[~full] for column in columns) if not full.all() else ()
        if full.any():
            ready += self._packages(slots[full], tuple(column[full] for column in columns), stop)
        return ready

    def flush(self) -> list[Ready]:
        """The packages that wait, full or not."""
        if not self._wait:
            return []
        columns, self._wait = self._wait, ()
        slots = self._slots(columns[0])
        return self._packages(slots, columns, int(slots[-1]) // self._kind.samples + 1)

    def _slots(self, time: np.ndarray) -> np.ndarray:
        """The sample of every return, counted from the start."""
        start = self._start if self._start is not None else int(time[0])
        slots = (time - start + self._step // 2) // self._step
        steps = np.diff(slots, prepend=self._done * self._kind.samples)
        if (steps < 0).any():
            raise InputError(
                "The lidar's returns go back in time.",
                file=self._path,
                expected="returns in the order of their times",
                found=f"a step of {int(np.diff(time).min(initial=0))} ns",
                remedy="sort them, and hand over the frames in their order",
            )
        return slots

    def _packages(self, slots: np.ndarray, columns: tuple[np.ndarray, ...], stop: int) -> list[Ready]:
        """Packages up to number `stop`, empty ones included, as times, numbers, xyz, reflectivity and tag."""
        samples, returns = self._kind.samples, self._kind.returns
        begin = np.r_[True, np.diff(slots) > 0]
        place = np.arange(len(slots)) - np.flatnonzero(begin)[np.cumsum(begin) - 1]
        if place.max() >= returns:
            raise InputError(
                "Several returns fall into one sample of the lidar.",
                file=self._path,
                expected=f"at most {returns} in {self._step} ns",
                found=f"{int(place.max()) + 1} at {int(columns[0][place.argmax()])} ns",
                remedy="give the returns times first + n × sample_ns, or write a data type of more returns",
            )
        numbers = np.arange(self._done, stop)
        shape = (len(numbers), samples, returns)
        where = (slots // samples - self._done, slots % samples, place)
        xyz, reflectivity, tag = np.zeros((*shape, 3)), np.zeros(shape, "u1"), np.zeros(shape, "u1")
        xyz[where], tag[where] = columns[1], columns[3]
        reflectivity[where] = np.clip(np.rint(columns[2]), 0, 255)
        start = self._start if self._start is not None else 0
        times = start + numbers * samples * self._step
        self._done = stop
        return [(times, self._first + numbers, xyz, reflectivity, tag)]


def _file_header(version: Version, devices: Sequence[LvxDevice], duration_ms: int) -> bytes:
    """Public and private header, and the devices."""
    layout = LAYOUTS[version]
    public = np.zeros((), PUBLIC)
    public["signature"], public["version"], public["magic"] = SIGNATURE, layout.number, MAGIC
    private = np.zeros((), layout.private)
    private["devices"] = len(devices)
    if "duration" in (layout.private.names or ()):
        private["duration"] = duration_ms
    table = np.zeros(len(devices), layout.device)
    for row, device in zip(table, devices, strict=True):
        row["code"], row["hub"] = device.code.encode()[:15], device.hub.encode()[:15]
        row["type"] = device.type or 0
        row["angles"] = np.degrees([device.roll, device.pitch, device.yaw])
        row["translation"] = device.translation
        if version != "1.0":
            row["enabled"] = device.extrinsics_enabled
        if version == "2":
            row["lidar"], row["lidar_type"] = device.index + 1, 8
        else:
            row["index"] = device.index
    return public.tobytes() + private.tobytes() + table.tobytes()
