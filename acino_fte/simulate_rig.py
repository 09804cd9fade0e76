"""Simulated recordings of a rig: one telephoto camera, a lidar and an IMU on the door of a car.

:func:`simulate_rig` is pure: it computes and writes nothing. :func:`rig_to_sequence` gives what a reader
would have read, :func:`acino_fte.rig_files.write_rig_simulation` writes a sequence folder and recordings.

World: z up, the ground is z = 0, the middle of the path is over the origin and the animal runs along x.
Shapes: N frames, M markers, Q degrees of freedom, K returns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.recording import ImuSamples
from acino_fte.data_tools.rotations import rotation_matrix
from acino_fte.detector import Detections, Faults, detect
from acino_fte.imperfections import Imperfections, draw_imperfections
from acino_fte.lidar import Lidar
from acino_fte.motions import Motion, plan_motion
from acino_fte.occlusion import hidden_by_body
from acino_fte.rig_clocks import FrameStamps, stamp_frames
from acino_fte.rig_imu import simulate_imu
from acino_fte.rig_lidar import (
    LIVOX_AXES,
    MOUNT_ROTATION,
    MOUNT_TRANSLATION,
    Returns,
    Scenery,
    place_scenery,
    pseudo_returns,
    scan,
)
from acino_fte.rig_motion import CameraPath, plan_camera
from acino_fte.rig_options import RigOptions
from acino_fte.simulate import is_bundled
from acino_fte.simulation_options import SimulationOptions
from acino_fte.skeleton import Skeleton, load_skeleton

if TYPE_CHECKING:
    from acino_fte.sequence import Sequence

CAMERA = "cam1"
TIME_SD = 0.0005  # s, what the synchronisation claims
_LEAST_RANGE_SD = 0.001  # m


@dataclass(frozen=True, eq=False)
class RigSimulation:
    """A simulated recording of a rig with its truth.

    Attributes
    ----------
    skeleton : Skeleton
    options : RigOptions
    q : (N, Q)
        True degrees of freedom at the frames, rad and m.
    positions : (N, M, 3)
        True positions at the frames of the points that the detector looks for, m, world.
    camera : Camera
        As it is given to the user, with a pose a frame unless it is fixed.
    true_camera : Camera
        As it was: one pose a frame.
    pixels : (N, M, 2)
        True projections, px; NaN behind the camera.
    detections : Detections
        What the detector made of them, with an axis of one camera; nothing in dropped frames.
    lidar : Lidar, optional
        Returns as they are given to the user: with the given calibration, in the clock of the frames.
    returns : Returns, optional
        The same returns with what they hit, and their true times.
    lidar_to_camera : (3, 3) and (3,)
        True rotation and translation (m): x_camera = rotation @ x_lidar + translation.
    imu : ImuSamples
        In the frame of the lidar, ns since frame 0, from the rest before it.
    imu_bias : dict
        True biases: ``gyro`` rad/s, ``accel`` m/s².
    stamps : FrameStamps
    path : CameraPath
        The true pose of the camera at any time.
    scenery : Scenery
        The bushes.
    motion : Motion
        The animal at any time, with its proportions.
    parameters : dict
        True ``segment_scale``, ``marker_offset_m`` and, of the camera, zeros, as
        :attr:`acino_fte.simulate.Simulation.parameters` has them.
    """

    skeleton: Skeleton
    options: RigOptions
    q: np.ndarray
    positions: np.ndarray
    camera: Camera
    true_camera: Camera
    pixels: np.ndarray
    detections: Detections
    lidar: Lidar | None
    returns: Returns | None
    lidar_to_camera: tuple[np.ndarray, np.ndarray]
    imu: ImuSamples
    imu_bias: dict[str, list[float]]
    stamps: FrameStamps
    path: CameraPath
    scenery: Scenery
    motion: Motion
    parameters: dict[str, Any]

    @property
    def truth_parameters(self) -> dict[str, Any]:
        """``parameters`` and, as ``swapped``, the left/right swaps: all plain values."""
        marker, swapped = self.skeleton.marker_names, self.detections.swapped
        places = [
            [int(n), CAMERA, [marker[m] for m in np.flatnonzero(swapped[n, 0])]]
            for n in np.flatnonzero(swapped.any(axis=(1, 2)))
        ]
        return {**self.parameters, "swapped": places}

    @property
    def notes(self) -> list[str]:
        """What the user should know about the recording, one sentence each."""
        options, notes = self.options, []
        longest = options.path_limit
        travel = self.motion.recipe.speed * options.n_frames / options.fps
        if travel > longest:
            notes.append(
                f"the path would be {travel:.0f} m long; the animal moves as on a treadmill over "
                f"{longest:.1f} m instead (the longest path is an option)"
            )
        inside = float(np.mean(self.true_camera.inside(self.pixels)))
        if inside < 0.95:
            notes.append(f"only {inside:.0%} of the markers are in the picture")
        return notes


def simulate_rig(options: RigOptions | None = None, skeleton: Skeleton | None = None) -> RigSimulation:
    """Simulate a recording of a rig.

    Parameters
    ----------
    options : RigOptions, optional
        By default two seconds of a galloping cheetah 90 m away.
    skeleton : Skeleton, optional
        By default that of ``options.species``.

    Raises
    ------
    InputError
        There is no such species or motion, or they do not fit each other.
    """
    options = options or RigOptions()
    skeleton = skeleton or load_skeleton(options.species)
    flaws = _draw_flaws(skeleton, options)
    kinematics, parameters = flaws.body(skeleton)
    motion = plan_motion(
        kinematics,
        options.motion,
        options.n_frames,
        options.fps,
        seed=options.seed,
        longest_path=options.path_limit,
        parameters=parameters,
    )
    kinematics, parameters = flaws.animal(skeleton)
    path = plan_camera(options, motion)
    camera = true_camera(options, path)
    positions = kinematics.positions(motion.at_frames, parameters)
    pixels = camera.project(positions)
    stamps = stamp_frames(options)
    hidden = hidden_by_body(skeleton, positions, CameraArray((camera,)))
    mount = rotation_matrix(np.array(MOUNT_ROTATION)) @ LIVOX_AXES, np.array(MOUNT_TRANSLATION)
    scenery = place_scenery(options, path, motion)
    returns = _returns(
        options, motion, path, mount, scenery, (positions, camera.inside(pixels) & ~hidden[:, 0])
    )
    imu, bias = simulate_imu(options, path, mount)
    return RigSimulation(
        skeleton,
        options,
        motion.at_frames,
        positions,
        _given_camera(options, camera),
        camera,
        pixels,
        _detections(skeleton, options, camera, pixels, hidden, stamps.dropped),
        _given_lidar(options, returns, mount) if returns is not None else None,
        returns,
        mount,
        imu,
        bias,
        stamps,
        path,
        scenery,
        motion,
        flaws.parameters(skeleton, [CAMERA]),
    )


def _returns(
    options: RigOptions,
    motion: Motion,
    path: CameraPath,
    mount: tuple[np.ndarray, np.ndarray],
    scenery: Scenery,
    shown: tuple[np.ndarray, np.ndarray],
) -> Returns | None:
    """What the lidar returns, if there is one; `shown` are markers (N, M, 3), and which are seen (N, M)."""
    if options.lidar == "scan":
        return scan(options, motion, path, mount, scenery)
    return pseudo_returns(options, *shown, path, mount) if options.lidar == "pseudo" else None


def _draw_flaws(skeleton: Skeleton, options: RigOptions) -> Imperfections:
    """Proportions of the animal and places of its markers."""
    asked = SimulationOptions(
        n_cameras=1, proportions=options.proportions, offsets_mm=options.offsets_mm, seed=options.seed
    )
    return draw_imperfections(skeleton, asked)


def true_camera(options: RigOptions, path: CameraPath) -> Camera:
    """The camera with its true pose at every frame."""
    rotation = path.rotation(np.arange(options.n_frames) / options.fps)
    width, height = options.resolution
    matrix = np.array(
        [[options.focal, 0.0, (width - 1) / 2], [0.0, options.focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
    )
    return Camera(
        CAMERA, "pinhole", matrix, np.zeros(0), rotation, -rotation @ path.centre, options.resolution
    )


def _given_camera(options: RigOptions, camera: Camera) -> Camera:
    """The camera with the errors of its calibration; one pose where it was fixed."""
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1.0 + options.focal_error
    rotation, translation = camera.rotation, camera.translation
    if options.pose_drift_mrad:
        rng = options.stream("pose drift")
        walk = np.cumsum(rng.standard_normal((options.n_frames, 3)), axis=0) / np.sqrt(options.n_frames)
        turn = rotation_matrix(1e-3 * options.pose_drift_mrad * walk)
        rotation, translation = turn @ rotation, np.einsum("nij,nj->ni", turn, translation)
    elif not (options.pan or options.shake_mrad):
        rotation, translation = rotation[0], translation[0]
    return replace(camera, matrix=matrix, rotation=rotation, translation=translation)


def _given_lidar(options: RigOptions, returns: Returns, mount: tuple[np.ndarray, np.ndarray]) -> Lidar:
    """The returns with the errors of calibration and synchronisation."""
    turn = options.stream("lidar turned").standard_normal(3) * 1e-3 * options.lidar_turned_mrad
    shift = options.stream("lidar moved").standard_normal(3) * 1e-3 * options.lidar_moved_mm
    return Lidar(
        CAMERA,
        returns.time + 1e-3 * options.sync_ms,
        returns.xyz,
        returns.intensity,
        rotation_matrix(turn) @ mount[0],
        mount[1] + shift,
        max(options.range_noise_m, _LEAST_RANGE_SD),
        max(TIME_SD, 1e-3 * abs(options.sync_ms)),
        options.range_noise_per_m,
        np.radians([options.beam_width_deg, options.beam_height_deg]),
    )


def _detections(
    skeleton: Skeleton,
    options: RigOptions,
    camera: Camera,
    pixels: np.ndarray,
    hidden: np.ndarray,
    dropped: np.ndarray,
) -> Detections:
    """What the detector finds: nothing in frames that were dropped."""
    if options.noise_px == "species":
        noise = np.array([m.sd_px for m in skeleton.markers])
    else:
        noise = np.full(len(skeleton.markers), float(options.noise_px))
    faults = Faults(
        noise, options.missing, options.outliers, options.swaps, options.occlusion_px, options.quantise,
        options.seed,
    )  # fmt: skip
    in_image = camera.inside(pixels)[:, None]
    resolution = np.array([camera.resolution], dtype=float)
    seen = hidden if options.occlusion else np.zeros_like(hidden)
    found = detect(skeleton, pixels[:, None], in_image, seen, resolution, faults)
    position, likelihood = found.position.copy(), found.likelihood.copy()
    position[dropped], likelihood[dropped] = np.nan, 0.0
    return replace(found, position=position, likelihood=likelihood)


def rig_to_sequence(simulation: RigSimulation, name: str | None = None) -> Sequence:
    """The recording, with its truth, as a reader would give it, in memory.

    Like a reader it gives what was not detected a likelihood of zero.
    """
    import xarray as xr

    from acino_fte.sequence import Sequence

    skeleton, options = simulation.skeleton, simulation.options
    frames = np.arange(options.n_frames)
    dims = ("frame", "camera", "marker")
    found = np.isfinite(simulation.detections.position).all(axis=-1)
    detections = xr.Dataset(
        {
            "position": ((*dims, "space"), simulation.detections.position),
            "likelihood": (dims, np.where(found, simulation.detections.likelihood, 0.0)),
        },
        coords={"frame": frames, "camera": [CAMERA], "marker": skeleton.marker_names, "space": ["u", "v"]},
    )
    truth = xr.DataArray(
        simulation.positions,
        dims=("frame", "marker", "space"),
        coords={"frame": frames, "marker": skeleton.marker_names, "space": ["x", "y", "z"]},
    )
    return Sequence(
        name=name or f"{skeleton.name}_{options.motion}_rig",
        species=skeleton.name if is_bundled(skeleton) else str(skeleton.path),
        fps=float(options.fps),
        detections=detections,
        cameras=CameraArray((simulation.camera,)),
        truth=truth,
        truth_parameters=simulation.truth_parameters,
        lidar=simulation.lidar,
    )
