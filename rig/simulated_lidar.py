"""A simulated lidar with its inertial sensor: a wall with hills, seen from a rig that trembles."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from zlib import crc32

import numpy as np

from acino_fte.data_tools.recording import GRAVITY, ImuSamples, LidarReturns
from acino_fte.rig.faults import Fault
from acino_fte.rig.recorder_clock import Clock
from acino_fte.rig.rig_file import LidarPart
from acino_fte.rig.simulated import SimulatedSource
from acino_fte.rig.sources import Sample, SourceStream, imu_topic, lidar_topic

_PATTERNS = 7  # prepared frames, of which one after another is delivered
_LINES = 6
_DISTANCE_M = 90.0


class SimulatedLidar(SimulatedSource):
    """A lidar whose frames are cut by its own clock, or on demand where :attr:`triggered` is set."""

    def __init__(self, name: str, part: LidarPart, clock: Clock, faults: Sequence[Fault] = ()) -> None:
        streams = [SourceStream(lidar_topic(name), "lidar", part.rate_hz)]
        if part.imu_hz > 0:
            streams.append(SourceStream(imu_topic(name), "imu", part.imu_hz))
        super().__init__(name, tuple(streams), clock, faults, crc32(name.encode()))
        self._part = part
        self._frames: list[np.ndarray] = []

    @property
    def triggered(self) -> bool:
        """Whether frames are cut on demand."""
        return self._tables[0].triggers is not None

    def trigger(self) -> None:
        """Cut a frame now; the first call ends frames by the lidar's own clock."""
        table = self._tables[0]
        if table.triggers is None:
            table.triggers = deque()
        table.triggers.append(self.clock.monotonic_ns())

    def open(self) -> None:
        """Connect, and prepare the frames."""
        super().open()
        if not self._frames:
            rng = np.random.default_rng(crc32(self.name.encode()))
            self._frames = [_pattern(self._part, rng) for _ in range(_PATTERNS)]

    def sample(self, stream: SourceStream, number: int, device_ns: int) -> Sample:
        """A frame, or one inertial sample."""
        if stream.kind == "imu":
            return Sample(stream.name, _tremble(device_ns), device_ns)
        xyz = self._frames[number % _PATTERNS]
        n = len(xyz)
        period = 1e9 / self._part.rate_hz  # of which the frame holds the returns that came before it
        offsets = (np.arange(n) * (period / max(n, 1)) - period).astype(np.int64)
        intensity = 20.0 + np.arange(n) % 60
        tag, line = np.zeros(n, np.uint8), (np.arange(n) % _LINES).astype(np.uint8)
        returns = LidarReturns(device_ns + offsets, xyz, intensity, tag, line, "power_on")
        return Sample(stream.name, returns, device_ns)


def _tremble(device_ns: int) -> ImuSamples:
    """One sample: gravity along z, and the engine of the car."""
    phase = 2 * np.pi * 12.5 * (device_ns % 10**9) * 1e-9
    rate = np.array([[0.002 * np.sin(phase), 0.001 * np.cos(phase), 0.0]])
    force = np.array([[0.05 * np.cos(phase), 0.0, GRAVITY + 0.1 * np.sin(phase)]])
    return ImuSamples(np.array([device_ns], np.int64), rate, force, "power_on")


def _pattern(part: LidarPart, rng: np.random.Generator) -> np.ndarray:
    """(points, 3) m, x forward: rays over the field of view onto a wall with hills."""
    angles = np.deg2rad((rng.random((part.points, 2)) - 0.5) * part.fov_deg)
    away = _DISTANCE_M + 2 * np.sin(40 * angles[:, 0]) + rng.normal(0, 0.02, part.points)
    return np.stack([away, away * np.tan(angles[:, 0]), away * np.tan(angles[:, 1])], axis=1)
