"""Simulated recordings: any species, a motion, a set of cameras and a detector with faults.

:func:`simulate` is pure: it computes and writes nothing. :func:`simulation_to_sequence` gives what a
reader would have read, :func:`acino_fte.simulation_files.write_simulation` writes a sequence folder.

Shapes: N frames, C cameras, M markers, Q degrees of freedom.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal

import numpy as np

from acino_fte.camera_ring import CameraModel, Layout, camera_ring, default_radius
from acino_fte.cameras import CameraArray
from acino_fte.detector import Detections, Faults, detect
from acino_fte.errors import InputError
from acino_fte.kinematics import load_kinematics
from acino_fte.motions import find_recipe, make_motion
from acino_fte.occlusion import hidden_by_body
from acino_fte.skeleton import Skeleton

if TYPE_CHECKING:
    from acino_fte.sequence import Sequence

_PATH = 3.0  # longest path, in distances of the cameras


@dataclass(frozen=True)
class SimulationOptions:
    """Everything that decides a simulated recording. The same options give the same recording.

    Attributes
    ----------
    motion : str
        One of :func:`acino_fte.motions.motion_names`; ``"wander"`` fits every species.
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
    seed: int = 0

    def __post_init__(self) -> None:
        for key in ("missing", "outliers", "swaps"):
            _check(self, key, 0.0, 1.0, "a fraction from 0 to 1")
        _check(self, "n_frames", 1, 1_000_000, "at least 1")
        _check(self, "n_cameras", 1, 1000, "at least 1")
        _check(self, "fps", 1e-3, 1e6, "frames per second, above 0")
        _check(self, "seed", 0, 2**63, "a whole number from 0")
        _check(self, "occlusion_px", 0.0, 1e4, "px, at least 0")
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


def _check(options: SimulationOptions, key: str, lower: float, upper: float, expected: str) -> None:
    value = getattr(options, key)
    whole = next(f.type for f in fields(options) if f.name == key) == "int"
    right = isinstance(value, (int, np.integer) if whole else (int, float, np.number))
    if isinstance(value, bool) or not right or not lower <= value <= upper:
        raise InputError(
            f"The simulation option '{key}' is wrong.", key=key, expected=expected, found=repr(value)
        )


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated recording with its truth.

    Attributes
    ----------
    skeleton : Skeleton
    options : SimulationOptions
    q : (N, Q)
        True degrees of freedom, rad and m.
    positions : (N, M, 3)
        True marker positions, m, world frame; the ground is z = 0.
    cameras : CameraArray
    pixels : (N, C, M, 2)
        True projections, px; NaN behind a camera.
    detections : Detections
        What the detector made of them.
    """

    skeleton: Skeleton
    options: SimulationOptions
    q: np.ndarray
    positions: np.ndarray
    cameras: CameraArray
    pixels: np.ndarray
    detections: Detections

    @property
    def notes(self) -> list[str]:
        """What the user should know about the recording, one sentence each."""
        options, notes = self.options, []
        recipe = find_recipe(self.skeleton, options.motion, options.seed)
        path = recipe.speed * options.n_frames / options.fps
        longest = _longest_path(self.skeleton, options)
        if path > longest:
            notes.append(
                f"the path would be {path:.0f} m long; the animal moves as on a treadmill over "
                f"{longest:.0f} m instead, so that the cameras see it (the longest path is an option)"
            )
        twice = float(np.mean(self.detections.in_image.sum(axis=1) >= 2))
        if twice < 0.9:
            notes.append(
                f"only {twice:.0%} of the markers are in the images of two cameras or more; "
                "a larger radius or more cameras would see more"
            )
        return notes


def simulate(skeleton: Skeleton, options: SimulationOptions | None = None) -> Simulation:
    """Simulate a recording.

    Parameters
    ----------
    skeleton : Skeleton
        Of any species.
    options : SimulationOptions, optional
        By default one second of gallop before six cameras.

    Returns
    -------
    Simulation

    Raises
    ------
    InputError
        There is no such motion, or it does not fit the species.
    """
    options = options or SimulationOptions()
    kinematics = load_kinematics(skeleton)
    q = _motion(skeleton, options)
    positions = kinematics.positions(q)
    cameras = camera_ring(
        positions,
        options.n_cameras,
        radius=options.radius,
        height=options.height,
        model=options.camera_model,
        layout=options.layout,
    )
    pixels = cameras.project(positions)
    in_image = np.stack([camera.inside(pixels[:, c]) for c, camera in enumerate(cameras)], axis=1)
    if options.occlusion:
        hidden = hidden_by_body(skeleton, positions, cameras)
    else:
        hidden = np.zeros(in_image.shape, dtype=bool)
    resolution = np.array([camera.resolution for camera in cameras], dtype=float)
    detections = detect(skeleton, pixels, in_image, hidden, resolution, _faults(skeleton, options))
    return Simulation(skeleton, options, q, positions, cameras, pixels, detections)


def _motion(skeleton: Skeleton, options: SimulationOptions) -> np.ndarray:
    """Degrees of freedom (N, Q), on a treadmill where the path would be too long."""
    return make_motion(
        load_kinematics(skeleton),
        options.motion,
        options.n_frames,
        options.fps,
        seed=options.seed,
        longest_path=_longest_path(skeleton, options),
    )


def _longest_path(skeleton: Skeleton, options: SimulationOptions) -> float:
    if options.longest_path is not None:
        return options.longest_path
    if options.radius is not None:
        return _PATH * options.radius
    kinematics = load_kinematics(skeleton)
    pose = make_motion(kinematics, options.motion, 1, options.fps, seed=options.seed)
    return _PATH * default_radius(kinematics.positions(pose))


def _faults(skeleton: Skeleton, options: SimulationOptions) -> Faults:
    if options.noise_px == "species":
        noise = np.array([m.sd_px for m in skeleton.markers])
    else:
        noise = np.full(len(skeleton.markers), float(options.noise_px))
    return Faults(
        noise_px=noise,
        missing=options.missing,
        outliers=options.outliers,
        swaps=options.swaps,
        occlusion_px=options.occlusion_px,
        quantise=options.quantise,
        seed=options.seed,
    )


def is_bundled(skeleton: Skeleton) -> bool:
    """Whether the species comes with the toolkit, so that its name finds it."""
    from acino_fte.models import species_names, species_path

    if skeleton.path is None:
        return True
    return (
        skeleton.name in species_names() and skeleton.path.resolve() == species_path(skeleton.name).resolve()
    )


def simulation_to_sequence(simulation: Simulation, name: str | None = None) -> Sequence:
    """The recording, with its truth, as a reader would give it, in memory.

    Like a reader it gives what was not detected a likelihood of zero.
    """
    import xarray as xr

    from acino_fte.sequence import Sequence

    skeleton, options = simulation.skeleton, simulation.options
    coordinates = {
        "frame": np.arange(options.n_frames),
        "camera": simulation.cameras.names,
        "marker": skeleton.marker_names,
    }
    dims = ("frame", "camera", "marker")
    found = np.isfinite(simulation.detections.position).all(axis=-1)
    detections = xr.Dataset(
        {
            "position": ((*dims, "space"), simulation.detections.position),
            "likelihood": (dims, np.where(found, simulation.detections.likelihood, 0.0)),
        },
        coords={**coordinates, "space": ["u", "v"]},
    )
    truth = xr.DataArray(
        simulation.positions,
        dims=("frame", "marker", "space"),
        coords={"frame": coordinates["frame"], "marker": coordinates["marker"], "space": ["x", "y", "z"]},
    )
    return Sequence(
        name=name or f"{skeleton.name}_{options.motion}",
        species=skeleton.name if is_bundled(skeleton) else str(skeleton.path),
        fps=float(options.fps),
        detections=detections,
        cameras=simulation.cameras,
        truth=truth,
    )
