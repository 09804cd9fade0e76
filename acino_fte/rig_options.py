"""Everything that decides a simulated recording of a rig: one telephoto camera, a lidar and an IMU."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from acino_fte.errors import InputError
from acino_fte.simulation_options import PRIOR_MOTION

FULL_WIDTH, FULL_HEIGHT = 2048, 1088  # px, of the sensor
PITCH = 5.5e-6  # m, of its pixels at full width
_MOST_JITTER = 0.1  # of the time of a frame
_CHOICES = {"body": ("links", "capsules"), "lidar": ("scan", "pseudo", "none")}


@dataclass(frozen=True)
class RigOptions:
    """Everything that decides a simulated recording of a rig. The same options give the same recording.

    Attributes
    ----------
    species : str
        Name of a species, or the path of a species file.
    motion : str
        One of :func:`acino_fte.motions.motion_names`.
    n_frames, fps : int, float
        Length and frame rate (Hz).
    distance : float
        From the camera to the middle of the path, m.
    angle : float
        Between the path and the image, degrees: 0 runs across the view from left to right, at 90 the animal
        comes straight to the camera.
    height : float
        Of the camera above the ground, m.
    longest_path : float, optional
        m; a longer run is made as on a treadmill. By default six tenths of the distance for a camera that
        pans, and half of the width of the view for one that is fixed.
    width : int
        Of the picture, px. The field of view does not depend on it.
    focal_mm : float
        Focal length of the lens, mm, before pixels of 5.5 µm at a width of 2048 px: 27 273 px.
    focal_px : float, optional
        Focal length, px, instead of ``focal_mm``.
    pan : bool
        The camera follows the animal; otherwise it looks at the middle of the path.
    follow_deg : float
        How well a hand follows: standard deviation of the slow error of pan and tilt, degrees.
    shake_mrad : float
        Standard deviation of each component of a shake of 1–8 Hz, mrad.
    noise_px, missing, outliers, swaps, occlusion, occlusion_px, quantise
        Of the detector, as :class:`acino_fte.simulation_options.SimulationOptions` has them.
    proportions, offsets_mm : float
        Of the animal and its markers, as :class:`acino_fte.simulation_options.SimulationOptions` has them.
    lidar : str
        ``"scan"``: the returns of a scanning lidar. ``"pseudo"``: one return a frame at the pixel of every
        marker that is in the picture and not hidden. ``"none"``: no lidar.
    body : str
        What the lidar meets: ``"links"``, capsules of the radius ``surface_m`` about all drawn lines of the
        species; ``"capsules"``, the species' solid body where it has one, and those elsewhere.
    surface_m : float
        How far the skin is from the links, m.
    background : float
        Fraction of the returns on the body that come from something else: half from behind it, half from
        foliage before it.
    range_noise_m, angle_noise_mrad : float
        Standard deviation of a range, m, and of each of the two angles of a direction, mrad.
    range_noise_per_m : float
        What the standard deviation of a range has in addition for every metre of it, in quadrature.
    beam_width_deg, beam_height_deg : float
        Full width of a beam along y and z of the lidar, degrees. A return comes from a place in it with a
        standard deviation of a quarter of that. At 0 beams are lines; a Tele-15 has 0.02 and 0.12.
    points_per_second : float
        Of the lidar.
    grass_m : float
        Mean height at which a beam meets the grass, m.
    bushes : int
        How many of them stand 5–40 m behind the path.
    lidar_turned_mrad, lidar_moved_mm : float
        Error of the given calibration of lidar and camera: standard deviation of each component.
    focal_error : float
        Relative error of the given focal length: 0.01 is 1 % too long.
    pose_drift_mrad : float
        Error of the given poses of the camera: a random walk whose components have this standard deviation
        at the last frame.
    sync_ms : float
        Error of the synchronisation: the lidar's given times are late by this.
    rest_s : float
        Before frame 0 the rig stands still for this long, and then takes a second to follow the animal.
    imu_rate : float
        Samples per second of the IMU.
    gyro_bias, gyro_noise : float
        Length of the constant bias and standard deviation of a component's noise per sample, rad/s.
    accel_bias, accel_noise : float
        The same of the accelerometer, m/s².
    drops : float
        Fraction of the frames (but the first and the last) that are not recorded.
    camera_drift_ppm, lidar_drift_ppm : float
        By how much the clocks of the sensors are too fast, 1e-6.
    jitter_us : float
        Standard deviation of the camera's stamps, µs.
    latency_ms : float
        Mean of the random part of the time that a record takes to the computer, ms.
    seed : int
        Of all random streams. Every fault has its own, so that switching one off leaves the others as
        they were.
    """

    species: str = "cheetah"
    motion: str = "gallop"
    n_frames: int = 120
    fps: float = 60.0
    distance: float = 90.0
    angle: float = 0.0
    height: float = 1.5
    longest_path: float | None = None
    width: int = FULL_WIDTH
    focal_mm: float = 150.0
    focal_px: float | None = None
    pan: bool = True
    follow_deg: float = 0.1
    shake_mrad: float = 0.2
    noise_px: float | Literal["species"] = 3.0
    missing: float = 0.15
    outliers: float = 0.03
    swaps: float = 0.0
    occlusion: bool = False
    occlusion_px: float = 15.0
    quantise: bool = False
    proportions: float = 0.0
    offsets_mm: float = 0.0
    lidar: Literal["scan", "pseudo", "none"] = "scan"
    body: Literal["links", "capsules"] = "links"
    surface_m: float = 0.04
    background: float = 0.1
    range_noise_m: float = 0.02
    angle_noise_mrad: float = 0.0
    range_noise_per_m: float = 0.0
    beam_width_deg: float = 0.0
    beam_height_deg: float = 0.0
    points_per_second: float = 240_000.0
    grass_m: float = 0.05
    bushes: int = 60
    lidar_turned_mrad: float = 0.0
    lidar_moved_mm: float = 0.0
    focal_error: float = 0.0
    pose_drift_mrad: float = 0.0
    sync_ms: float = 0.0
    rest_s: float = 5.0
    imu_rate: float = 200.0
    gyro_bias: float = 0.01
    gyro_noise: float = 0.0015
    accel_bias: float = 0.05
    accel_noise: float = 0.02
    drops: float = 0.0
    camera_drift_ppm: float = 20.0
    lidar_drift_ppm: float = -15.0
    jitter_us: float = 20.0
    latency_ms: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for key, lower, upper, expected in _RANGES:
            if getattr(self, key) is not None:
                _check(self, key, lower, upper, expected)
        if self.noise_px != "species":
            _check(self, "noise_px", 0.0, 1e4, "px, at least 0, or 'species'")
        for key, known in _CHOICES.items():
            if getattr(self, key) not in known:
                raise _wrong(self, key, " or ".join(f"'{k}'" for k in known))
        if 1e-6 * self.jitter_us * self.fps > _MOST_JITTER:
            raise InputError(
                "The stamps of the frames would not be in order.",
                key="jitter_us",
                expected=f"at most {1e6 * _MOST_JITTER / self.fps:g} µs, a tenth of a frame's time",
                found=f"{self.jitter_us:g} µs",
                remedy="less jitter, or fewer frames per second",
            )
        if self.motion == PRIOR_MOTION:
            raise InputError(
                "A motion drawn from the prior is known at the frames only, but a lidar sees between them.",
                key="motion",
                found=self.motion,
                remedy="choose another motion, 'wander' works for every species",
            )

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height of the picture, px."""
        return self.width, max(1, round(self.width * FULL_HEIGHT / FULL_WIDTH))

    @property
    def focal(self) -> float:
        """Focal length, px."""
        if self.focal_px is not None:
            return self.focal_px
        return 1e-3 * self.focal_mm / PITCH * self.width / FULL_WIDTH

    @property
    def path_limit(self) -> float:
        """The longest path, m."""
        if self.longest_path is not None:
            return self.longest_path
        return 0.6 * self.distance if self.pan else 0.5 * self.distance * self.width / self.focal

    def stream(self, purpose: str) -> np.random.Generator:
        """The random stream of one purpose."""
        return np.random.default_rng([self.seed, *purpose.encode()])


_RANGES: tuple[tuple[str, float, float, str], ...] = (
    ("n_frames", 1, 1_000_000, "at least 1"),
    ("fps", 1e-3, 1e6, "frames per second, above 0"),
    ("distance", 1.0, 1e4, "m, from 1"),
    ("angle", -90.0, 90.0, "degrees, from −90 to 90"),
    ("height", 0.1, 1e3, "m, above the ground"),
    ("longest_path", 1e-6, math.inf, "m, above 0"),
    ("width", 16, 20_000, "px, from 16"),
    ("focal_mm", 1e-3, 1e5, "mm, above 0"),
    ("focal_px", 1.0, 1e7, "px, above 0"),
    ("follow_deg", 0.0, 10.0, "degrees, from 0 to 10"),
    ("shake_mrad", 0.0, 100.0, "mrad, from 0 to 100"),
    ("missing", 0.0, 1.0, "a fraction from 0 to 1"),
    ("outliers", 0.0, 1.0, "a fraction from 0 to 1"),
    ("swaps", 0.0, 1.0, "a fraction from 0 to 1"),
    ("occlusion_px", 0.0, 1e4, "px, at least 0"),
    ("proportions", 0.0, 1.0, "of a logarithm of lengths, from 0 to 1"),
    ("offsets_mm", 0.0, 1e3, "mm, from 0 to 1000"),
    ("surface_m", 1e-4, 1.0, "m, above 0"),
    ("background", 0.0, 1.0, "a fraction from 0 to 1"),
    ("range_noise_m", 0.0, 1.0, "m, from 0 to 1"),
    ("angle_noise_mrad", 0.0, 100.0, "mrad, from 0 to 100"),
    ("range_noise_per_m", 0.0, 1.0, "m per metre, from 0 to 1"),
    ("beam_width_deg", 0.0, 10.0, "degrees, from 0 to 10"),
    ("beam_height_deg", 0.0, 10.0, "degrees, from 0 to 10"),
    ("points_per_second", 1.0, 1e8, "above 0"),
    ("grass_m", 0.0, 10.0, "m, at least 0"),
    ("bushes", 0, 10_000, "at least 0"),
    ("lidar_turned_mrad", 0.0, 1000.0, "mrad, at least 0"),
    ("lidar_moved_mm", 0.0, 1e4, "mm, at least 0"),
    ("focal_error", -0.5, 1.0, "a fraction from −0.5 to 1"),
    ("pose_drift_mrad", 0.0, 1000.0, "mrad, at least 0"),
    ("sync_ms", -1e4, 1e4, "ms"),
    ("rest_s", 0.0, 1e4, "s, at least 0"),
    ("imu_rate", 1.0, 1e5, "Hz, from 1"),
    ("gyro_bias", 0.0, 10.0, "rad/s, at least 0"),
    ("gyro_noise", 0.0, 10.0, "rad/s, at least 0"),
    ("accel_bias", 0.0, 100.0, "m/s², at least 0"),
    ("accel_noise", 0.0, 100.0, "m/s², at least 0"),
    ("drops", 0.0, 0.9, "a fraction from 0 to 0.9"),
    ("camera_drift_ppm", -1e5, 1e5, "parts in a million"),
    ("lidar_drift_ppm", -1e5, 1e5, "parts in a million"),
    ("jitter_us", 0.0, 1e6, "µs, at least 0"),
    ("latency_ms", 0.0, 1e5, "ms, at least 0"),
    ("seed", 0, 2**63, "a whole number from 0"),
)


def _check(options: RigOptions, key: str, lower: float, upper: float, expected: str) -> None:
    value = getattr(options, key)
    whole = next(f.type for f in fields(options) if f.name == key) == "int"
    right = isinstance(value, (int, np.integer) if whole else (int, float, np.number))
    if isinstance(value, bool) or not right or not lower <= value <= upper:
        most = f"; at most {upper:,.15g}" if math.isfinite(upper) and " to " not in expected else ""
        raise _wrong(options, key, expected + most)


def _wrong(options: RigOptions, key: str, expected: str) -> InputError:
    return InputError(
        f"The simulation option '{key}' is wrong.",
        key=key,
        expected=expected,
        found=repr(getattr(options, key)),
    )
