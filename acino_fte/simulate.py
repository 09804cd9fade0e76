"""Simulated recordings: any species, a motion, a set of cameras and a detector with faults.

:func:`simulate` is pure: it computes and writes nothing. :func:`simulation_to_sequence` gives what a
reader would have read, :func:`acino_fte.simulation_files.write_simulation` writes a sequence folder.

Shapes: N frames, C cameras, M markers, Q degrees of freedom.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.camera_ring import camera_ring, default_radius
from acino_fte.cameras import CameraArray
from acino_fte.detector import Detections, Faults, detect
from acino_fte.imperfections import Imperfections, draw_imperfections
from acino_fte.kinematics import load_kinematics
from acino_fte.motions import find_recipe, make_motion, plan_motion
from acino_fte.occlusion import hidden_by_body
from acino_fte.prior_motion import prior_motion
from acino_fte.simulation_options import PRIOR_MOTION, SimulationOptions
from acino_fte.skeleton import Skeleton

if TYPE_CHECKING:
    from acino_fte.sequence import Sequence

_PATH = 3.0  # longest path, in distances of the cameras


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
        True positions at the frames of the points that the detector looks for, m, world frame; the ground
        is z = 0.
    cameras : CameraArray
        The calibration as it is given to the user.
    pixels : (N, C, M, 2)
        True projections, px, at the moments that each camera saw; NaN behind a camera.
    detections : Detections
        What the detector made of them.
    true_cameras : CameraArray
        Where the cameras really were.
    parameters : dict
        What else was not as it should be: ``time_offset_s`` of the cameras (s); ``extrinsics`` (the
        correction ``rotation_rad``, ``translation_m`` of each given camera, x_camera =
        Exp(rotation)·(R x + t) + translation); ``segment_scale`` of the segment groups;
        ``marker_offset_m`` (in the link's frame). Complete: zeros and ones where nothing is wrong.
    """

    skeleton: Skeleton
    options: SimulationOptions
    q: np.ndarray
    positions: np.ndarray
    cameras: CameraArray
    pixels: np.ndarray
    detections: Detections
    true_cameras: CameraArray
    parameters: dict[str, Any]

    @property
    def swapped(self) -> list[list[Any]]:
        """[frame, camera, [marker, …]] wherever detections took the places of their twins."""
        camera, marker = self.cameras.names, self.skeleton.marker_names
        return [
            [int(n), camera[c], [marker[m] for m in np.flatnonzero(self.detections.swapped[n, c])]]
            for n, c in np.argwhere(self.detections.swapped.any(axis=2))
        ]

    @property
    def truth_parameters(self) -> dict[str, Any]:
        """``parameters`` and, as ``swapped``, the left/right swaps: all plain values."""
        return {**self.parameters, "swapped": self.swapped}

    @property
    def notes(self) -> list[str]:
        """What the user should know about the recording, one sentence each."""
        options, notes = self.options, []
        path, longest = _path_length(self.skeleton, options), _longest_path(self.skeleton, options)
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
    flaws = draw_imperfections(skeleton, options)
    q, seen = _states(skeleton, options, flaws)
    likeness = _states(skeleton, options)[0] if options.proportions else q
    cameras = camera_ring(
        load_kinematics(skeleton).positions(likeness),  # the species: proportions do not move the cameras
        options.n_cameras,
        radius=options.radius,
        height=options.height,
        model=options.camera_model,
        layout=options.layout,
    )
    kinematics, parameters = flaws.animal(skeleton)
    positions = kinematics.positions(q, parameters)
    views = [positions if s is q else kinematics.positions(s, parameters) for s in seen]
    pixels = np.stack([camera.project(view) for camera, view in zip(cameras, views, strict=True)], axis=1)
    in_image = np.stack([camera.inside(pixels[:, c]) for c, camera in enumerate(cameras)], axis=1)
    hidden = np.zeros(in_image.shape, dtype=bool)
    if options.occlusion:
        for c, view in enumerate(views):
            hidden[:, c] = hidden_by_body(skeleton, view, CameraArray((cameras[c],)))[:, 0]
    resolution = np.array([camera.resolution for camera in cameras], dtype=float)
    detections = detect(skeleton, pixels, in_image, hidden, resolution, _faults(skeleton, options))
    return Simulation(
        skeleton,
        options,
        q,
        positions,
        flaws.given_cameras(cameras),
        pixels,
        detections,
        cameras,
        flaws.parameters(skeleton, cameras.names),
    )


def _states(
    skeleton: Skeleton, options: SimulationOptions, flaws: Imperfections | None = None
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Degrees of freedom (N, Q): at the frames, and for each camera at the moments that it sees."""
    if options.motion == PRIOR_MOTION:
        q = prior_motion(
            skeleton,
            options.n_frames,
            options.fps,
            seed=options.seed,
            noise_scale=options.noise_scale,
            prior_width=options.prior_width,
        )
        return q, [q] * options.n_cameras
    kinematics, parameters = flaws.body(skeleton) if flaws else (load_kinematics(skeleton), None)
    motion = plan_motion(
        kinematics,
        options.motion,
        options.n_frames,
        options.fps,
        seed=options.seed,
        longest_path=_longest_path(skeleton, options),
        parameters=parameters,
    )
    q = motion.at_frames
    return q, [motion(motion.time + delay) if delay else q for delay in flaws.delay] if flaws else []


def _path_length(skeleton: Skeleton, options: SimulationOptions) -> float:
    """How far the motion would travel, m."""
    if options.motion == PRIOR_MOTION:
        return 0.0
    return find_recipe(skeleton, options.motion, options.seed).speed * options.n_frames / options.fps


def _longest_path(skeleton: Skeleton, options: SimulationOptions) -> float:
    """How far it may travel, m, before it moves as on a treadmill."""
    if options.longest_path is not None:
        return options.longest_path
    if options.radius is not None:
        return _PATH * options.radius
    if options.motion == PRIOR_MOTION:
        return math.inf
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
        truth_parameters=simulation.truth_parameters,
    )
