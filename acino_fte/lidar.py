"""Lidar returns of a sequence, in the clock of its frames and the frame of its camera."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from acino_fte.errors import InputError

BEAM_DEG = (0.02, 0.12)
"""Full width of the beam of a Livox Tele-15, horizontally and vertically, degrees (its user manual, 2020)."""
RANGE_SD_PER_M = 1e-4
"""How the noise of a range grows with it: 1 cm in 100 m, in quadrature with 2 cm close by (an assumption)."""


@dataclass(frozen=True, eq=False)
class Lidar:
    """Returns of one lidar over a sequence. K returns, ordered by time.

    Attributes
    ----------
    camera : str
        The camera that the lidar is calibrated to: it moves with it.
    time : (K,)
        s, since frame 0 of the recording.
    xyz : (K, 3)
        m, frame of the lidar.
    intensity : (K,)
        Reflectivity, 0–255.
    rotation, translation : (3, 3), (3,)
        Lidar to camera: x_camera = rotation @ x_lidar + translation, m.
    range_sd : float
        Standard deviation of a range close by, m.
    time_sd : float
        Standard deviation of the synchronisation of lidar and camera, s.
    range_sd_per_m : float
        What the standard deviation of a range has in addition (in quadrature) for every metre of it.
    beam : (2,)
        Full width of the beam along y (horizontal) and z (vertical) of the lidar's frame, rad.
    """

    camera: str
    time: np.ndarray
    xyz: np.ndarray
    intensity: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    range_sd: float = 0.02
    time_sd: float = 0.0
    range_sd_per_m: float = RANGE_SD_PER_M
    beam: np.ndarray = field(default_factory=lambda: np.radians(BEAM_DEG))

    def __post_init__(self) -> None:
        shapes = {"time": (len(self.time),), "xyz": (len(self.time), 3), "intensity": (len(self.time),)}
        for key, shape in shapes.items():
            value = np.asarray(getattr(self, key), dtype=float)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(
                    "The lidar returns are not usable.",
                    key=key,
                    expected=f"finite numbers of the shape {shape}",
                    found=f"shape {value.shape}, {int((~np.isfinite(value)).sum())} not finite",
                )
            object.__setattr__(self, key, value)
        beam = np.asarray(self.beam, dtype=float)
        if beam.shape != (2,) or not (beam >= 0).all():
            raise InputError(
                "The lidar's beam is not usable.",
                key="beam",
                expected="two widths, rad",
                found=str(self.beam),
            )
        object.__setattr__(self, "beam", beam)

    def __len__(self) -> int:
        return len(self.time)

    def to_camera(self) -> np.ndarray:
        """Returns (K, 3) in the camera's frame, m: x right, y down, z forward."""
        return self.xyz @ np.asarray(self.rotation).T + self.translation

    def between(self, start: float, stop: float) -> Lidar:
        """The returns with start ≤ time < stop, s."""
        return self.select((self.time >= start) & (self.time < stop))

    def select(self, keep: np.ndarray) -> Lidar:
        """Some of the returns: a mask (K,) or rows."""
        return replace(self, time=self.time[keep], xyz=self.xyz[keep], intensity=self.intensity[keep])
