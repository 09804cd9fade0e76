"""Recognise packages of Livox in bytes: whether one begins here, how long it is, whether it can be real."""

from __future__ import annotations

from struct import Struct

import numpy as np

from acino_fte.data_tools.lvx_packets import FARTHEST_M, Layout, decode_imu, decode_points, decode_stamps

_LENGTH = Struct("<I")


class PackageTest:
    """Whether a package begins at a place, how long it is, and whose it is.

    Parameters
    ----------
    layout : Layout
    devices : mapping of int to int, optional
        Index of the device by what packages call it; any device is taken without.
    """

    def __init__(self, layout: Layout, devices: dict[int, int] | None = None) -> None:
        self.layout, self.devices = layout, devices
        self.second = layout.version == "2"
        self.header = layout.header.itemsize
        self._sizes = {kind: layout.package(kind).itemsize for kind in layout.kinds}
        self._steps = {kind: layout.kinds[kind].sample.itemsize for kind in layout.kinds}

    def size(self, data: bytes, at: int) -> int:
        """Bytes of the package that begins at `at`; 0 where none does."""
        if at + self.header > len(data) or (self.devices and self.device(data, at) not in self.devices):
            return 0
        if not self.second:
            return self._sizes.get(data[at + 10], 0) if data[at + 1] == 5 and data[at + 9] <= 5 else 0
        kind = data[at + 17]
        length = _LENGTH.unpack_from(data, at + 18)[0]
        fits = data[at + 6] <= 5 and kind in self._steps and 0 < length <= 1_500
        return self.header + length if fits and length % self._steps[kind] == 0 else 0

    def device(self, data: bytes, at: int = 0) -> int:
        """What the package calls its device."""
        return _LENGTH.unpack_from(data, at + 1)[0] if self.second else data[at]

    def kind(self, data: bytes, at: int = 0) -> int:
        """The data type."""
        return data[at + (17 if self.second else 10)]

    def samples(self, package: bytes) -> int:
        """How many samples a package has."""
        return (len(package) - self.header) // self._steps[self.kind(package)]

    def candidates(self, data: bytes, start: int, stop: int) -> np.ndarray:
        """Places in [start, stop) where a package may begin."""
        last = min(stop, len(data) - self.header + 1)
        if last <= start:
            return np.zeros(0, dtype=np.int64)
        byte = np.frombuffer(data, np.uint8)

        def at(offset: int) -> np.ndarray:
            return byte[start + offset : last + offset]

        if self.second:
            fits = (at(6) <= 5) & (at(17) <= 3) & (at(19) <= 5) & (at(20) == 0) & (at(21) == 0)
        else:
            fits = (at(1) == 5) & (at(9) <= 5) & (at(10) <= 8)
        return np.flatnonzero(fits) + start

    def follows(self, before: bytes, data: bytes, at: int) -> bool:
        """Whether the package at `at` is of the lidar and kind of one before, within ten seconds of it."""
        header = self.layout.header
        old = np.frombuffer(before, header, 1)
        new = np.frombuffer(data, header, 1, at)
        for name in ("index", "version", "slot", "lidar", "lidar_type", "reserved", "clock", "kind"):
            if name in (header.names or ()) and old[name] != new[name]:
                return False
        clock = self.layout.clocks.get(int(old["clock"][0]), "unknown")
        first, second = (decode_stamps(h["stamp"], clock, self.layout.version)[0] for h in (old, new))
        if clock == "pps":
            return 0 <= second < 1_000_000_000
        return bool(0 < second - first <= 10_000_000_000)

    def plausible(self, package: bytes) -> bool:
        """Whether its points are such as a lidar can see, or its inertial sample such as a rig can feel."""
        kind = self.kind(package)
        of = self.layout.kinds[kind]
        samples = np.frombuffer(package, of.sample, offset=self.header)
        with np.errstate(over="ignore", invalid="ignore"):
            if of.form == "imu":
                rate, force = decode_imu(samples)
                return bool((np.abs(rate) < 100).all() and (np.abs(force) < 1_000).all())
            return bool((np.linalg.norm(decode_points(of, samples)[0], axis=-1) <= FARTHEST_M).all())
