"""The clocks of a simulated rig: camera and lidar count from their own start, each at its own speed.

True time is seconds since frame 0. A record reaches the computer later, and the computer stamps it then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.rig_options import RigOptions

CAMERA_START, LIDAR_START = 734.25, 1861.5  # s, that the sensors were on before frame 0
UNIX_START = 1_767_272_400_000_000_000  # ns: of frame 0 by the computer, 2026-01-01 13:00 UTC
LATENCY = {"camera": 9e-3, "lidar": 2e-3}  # s, the constant part
_FIRST_NUMBER = 4711  # of the camera's count at frame 0


@dataclass(frozen=True, eq=False)
class FrameStamps:
    """What is known of the frames. N frames.

    Attributes
    ----------
    time : (N,)
        True, s since frame 0.
    camera_ns : (N,) int64
        By the clock of the camera, ns since it was switched on.
    received_ns : (N,) int64
        By the clock of the computer, ns since 1970.
    number : (N,) int
        As the camera counted.
    dropped : (N,) bool
        Never recorded.
    """

    time: np.ndarray
    camera_ns: np.ndarray
    received_ns: np.ndarray
    number: np.ndarray
    dropped: np.ndarray


def camera_clock(options: RigOptions, time: np.ndarray) -> np.ndarray:
    """True times (K,), s, as ns of the camera's clock."""
    return _clock(time, CAMERA_START, options.camera_drift_ppm)


def lidar_clock(options: RigOptions, time: np.ndarray) -> np.ndarray:
    """True times (K,), s, as ns of the lidar's clock, which is also that of the IMU."""
    return _clock(time, LIDAR_START + options.rest_s, options.lidar_drift_ppm)


def computer_clock(time: np.ndarray) -> np.ndarray:
    """True times (K,), s, as ns of the computer's clock, since 1970."""
    return UNIX_START + np.round(1e9 * np.asarray(time, dtype=float)).astype(np.int64)


def received(options: RigOptions, time: np.ndarray, sensor: str) -> np.ndarray:
    """When the computer stamps records (K,) that were complete at true times (K,), ns; in order."""
    late = options.stream(f"latency {sensor}").exponential(1e-3 * options.latency_ms, len(time))
    return np.maximum.accumulate(computer_clock(time + LATENCY[sensor] + late))


def stamp_frames(options: RigOptions) -> FrameStamps:
    """Stamps of all frames, and which of them were dropped: neither the first nor the last."""
    time = np.arange(options.n_frames) / options.fps
    jitter = options.stream("jitter").standard_normal(len(time)) * 1e-6 * options.jitter_us
    dropped = options.stream("drops").random(len(time)) < options.drops
    dropped[[0, -1]] = False
    return FrameStamps(
        time,
        camera_clock(options, time + jitter),
        received(options, time, "camera"),
        _FIRST_NUMBER + np.arange(len(time)),
        dropped,
    )


def _clock(time: np.ndarray, start: float, drift_ppm: float) -> np.ndarray:
    return np.round(1e9 * (start + (1.0 + 1e-6 * drift_ppm) * np.asarray(time, dtype=float))).astype(np.int64)
