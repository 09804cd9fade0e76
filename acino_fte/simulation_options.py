"""Everything that decides a simulated recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from acino_fte.camera_ring import CameraModel, Layout
from acino_fte.errors import InputError

PRIOR_MOTION = "prior"
IMPERFECTIONS = ("delay_ms", "moved_mm", "moved_deg", "proportions", "offsets_mm")


@dataclass(frozen=True)
class SimulationOptions:
    """Everything that decides a simulated recording. The same options give the same recording.

    Attributes
    ----------
    motion : str
        One of :func:`acino_fte.motions.motion_names`; ``"wander"`` fits every species. ``"prior"`` draws
        from the prior of the estimator (:func:`acino_fte.prior_motion.prior_motion`).
    n_frames, fps : int, float
        Length and frame rate (Hz).
    n_cameras : int
    camera_model : str
        ``"fisheye"`` (the action cameras of AcinoSet) or ``"pinhole"``.
    layout : str
        ``"sides"`` (along both sides of the path), ``"ring"`` (about it) or ``"auto"`` (a ring for a path
        shorter than the distance of the cameras).
    radius, height : float, optional
        Of the cameras, m; by default in proportion to the animal.
    longest_path : float, optional
        Metres; a longer run is simulated as on a treadmill, so that a fixed set of cameras sees all of
        it. By default three times the distance of the cameras (22 m for a cheetah); infinity for none.
    noise_px : float or "species"
        Standard deviation of u and of v, px; ``"species"`` takes each marker's ``sd_px``.
    missing : float
        Fraction of the markers in an image that are not detected (dropouts, at random): NaN.
    outliers : float
        Fraction of the remaining detections that are gross errors: half on another marker, half anywhere
        in a box about the animal.
    swaps : float
        Fraction of the images (per frame and camera) in which left and right are exchanged: of the whole
        animal in half of them, of one limb in the others.
    occlusion : bool
        Markers hidden by the body (its capsules) get a guessed place and mostly a low likelihood.
    occlusion_px : float
        Standard deviation of such a guess, px.
    quantise : bool
        Round to DeepLabCut's grid: 8 k + 4 px.
    delay_ms : float
        Every camera but the first is triggered late, by up to this, or early: uniform in ±delay_ms.
    moved_mm, moved_deg : float
        Every camera but the first has moved since it was calibrated: standard deviation of each
        component of the shift, mm, and of the rotation vector, degrees.
    proportions : float
        The animal is not the species: standard deviation of the logarithm of each segment group's length.
    offsets_mm : float
        The detector does not find the markers where the species has them: standard deviation of each
        component of a marker's constant displacement in its link's frame, mm.
    noise_scale, prior_width : float
        Of the motion ``"prior"``, as :class:`acino_fte.problem.FTEOptions` has them.
    seed : int
        Of all random streams. Every fault has its own, so that switching one off leaves the others as
        they were.
    """

    motion: str = "gallop"
    n_frames: int = 120
    fps: float = 120.0
    n_cameras: int = 6
    camera_model: CameraModel = "fisheye"
    layout: Layout = "auto"
    radius: float | None = None
    height: float | None = None
    longest_path: float | None = None
    noise_px: float | Literal["species"] = 2.0
    missing: float = 0.1
    outliers: float = 0.02
    swaps: float = 0.0
    occlusion: bool = True
    occlusion_px: float = 15.0
    quantise: bool = False
    delay_ms: float = 0.0
    moved_mm: float = 0.0
    moved_deg: float = 0.0
    proportions: float = 0.0
    offsets_mm: float = 0.0
    noise_scale: float = 1.0
    prior_width: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        for key in ("missing", "outliers", "swaps"):
            _check(self, key, 0.0, 1.0, "a fraction from 0 to 1")
        _check(self, "n_frames", 1, 1_000_000, "at least 1")
        _check(self, "n_cameras", 1, 1000, "at least 1")
        _check(self, "fps", 1e-3, 1e6, "frames per second, above 0")
        _check(self, "seed", 0, 2**63, "a whole number from 0")
        _check(self, "occlusion_px", 0.0, 1e4, "px, at least 0")
        for key, upper, unit in (
            ("delay_ms", 1e4, "ms, from 0 to 10000"),
            ("moved_mm", 1e5, "mm, from 0 to 100000"),
            ("moved_deg", 45.0, "degrees, from 0 to 45"),
            ("proportions", 1.0, "of a logarithm of lengths, from 0 to 1"),
            ("offsets_mm", 1e3, "mm, from 0 to 1000"),
        ):
            _check(self, key, 0.0, upper, unit)
        for key in ("noise_scale", "prior_width"):
            _check(self, key, 1e-6, 1e6, "above 0")
        for key in ("radius", "longest_path"):
            if getattr(self, key) is not None:
                _check(self, key, 1e-6, math.inf, "metres, above 0")
        if self.height is not None:
            _check(self, "height", -1e6, 1e6, "metres")
        if self.noise_px != "species":
            _check(self, "noise_px", 0.0, 1e4, "px, at least 0, or 'species'")
        for key, known in (("camera_model", ("fisheye", "pinhole")), ("layout", ("auto", "sides", "ring"))):
            if getattr(self, key) not in known:
                raise InputError(
                    f"The simulation option '{key}' is wrong.",
                    key=key,
                    expected=" or ".join(f"'{k}'" for k in known),
                    found=repr(getattr(self, key)),
                )
        if self.motion == PRIOR_MOTION and self.delay_ms:
            raise InputError(
                "A motion drawn from the prior is known at the frames only: no camera can be late.",
                key="delay_ms",
                expected=f"0 with the motion '{PRIOR_MOTION}'",
                found=repr(self.delay_ms),
                remedy="leave the delay out, or choose another motion",
            )

    @property
    def has_imperfections(self) -> bool:
        """Whether there is more to know of the recording than where the animal was."""
        return any(getattr(self, key) > 0 for key in (*IMPERFECTIONS, "swaps"))


def _check(options: SimulationOptions, key: str, lower: float, upper: float, expected: str) -> None:
    value = getattr(options, key)
    whole = next(f.type for f in fields(options) if f.name == key) == "int"
    right = isinstance(value, (int, np.integer) if whole else (int, float, np.number))
    if isinstance(value, bool) or not right or not lower <= value <= upper:
        raise InputError(
            f"The simulation option '{key}' is wrong.", key=key, expected=expected, found=repr(value)
        )
