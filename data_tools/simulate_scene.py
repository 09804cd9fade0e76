"""Simulated scenes with moving cameras, with their truth: key frames, landmarks, 2D tracks.

Cameras move over uneven ground (:mod:`scene_motions`); structure from motion knows their poses in key frames
with errors, in a world of its own (:mod:`simulated_structure`); trackers see a wand and animals with noise,
misses, gross errors and exchanged identities. Everything follows from one seed.

Shapes: N frames, C cameras, I individuals.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import get_args

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.scene_motions import (
    Formation,
    Platform,
    ScenePath,
    individuals,
    platform,
    rig_sensors,
    standing,
    target_path,
)
from acino_fte.data_tools.similarity import Similarity
from acino_fte.data_tools.simulated_lenses import SCENE_LENSES, scene_lens
from acino_fte.data_tools.simulated_structure import SceneStructure, simulate_structure
from acino_fte.data_tools.simulated_views import simulate_view
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError


@dataclass(frozen=True)
class SceneSimulation:
    """What to simulate.

    Attributes
    ----------
    n_frames : int
        N, of every camera, each on its own clock.
    fps : float
        Frames per second.
    path : str
        ``survey``, ``orbit`` or ``walk``; see :mod:`scene_motions`.
    formation : str
        ``rig``: cameras in one rigid body; ``free``: each is carried on its own; ``fixed``: tripods, which
        need an orbit's target, since it stays where it is.
    n_cameras : int
        C. They are called ``cam0``, ``cam1``, …
    distance : float
        From the cameras to what they look at, m.
    lane : float
        Length of a survey's lanes, m; they are 2 m apart.
    rig_side : float
        Distance between neighbours in a rig, m.
    lens : str or tuple of str
        COLMAP's name of the camera model (:data:`simulated_lenses.SCENE_LENSES`), or one for each camera.
    shared_lens : bool
        All images belong to one camera of the model.
    resolution : tuple of int
        Width and height, px.
    focal : float
        About the focal length, px.
    key_step : int
        Every so many frames of a camera are in the model.
    unregistered : float
        Share of key frames that the model misses, in bursts.
    centre_noise, turn_noise : float
        Errors of the poses, for each image and axis: standard deviation in m and degrees.
    resection : bool
        Errors of the poses come from the noise of the image's landmarks instead, as in a bundle adjustment
        with known points; images with fewer than eight landmarks are unregistered.
    n_landmarks, landmarks_per_image : int
        Points of the model, and how many of them an image sees at most.
    landmark_noise, landmark_noise_px : float
        Standard deviation of their places (m, each axis), and of their pixels.
    relief : float
        Height of the ground's bumps, m.
    wand : float, optional
        Length of a stick of which both ends are tracked, m; None: none.
    n_animals : int
    roam : float
        How far individuals go from what the cameras follow, m, each way.
    noise_px : float
        Standard deviation of each pixel coordinate.
    missed : float
        Share of rows that the trackers miss, in bursts of about `miss_frames`.
    miss_frames : float
    outliers : float
        Share of rows that are 20–150 px off.
    swaps : int
        In each camera, how many times two individuals exchange their names, for 15 frames.
    clock_offset : tuple of float
        Frames, one for each camera, or none. A camera's frame f shows the moment of frame
        ``f + offset + drift · f`` of the reference clock.
    clock_drift : tuple of float
        Frames per frame.
    gauge : bool
        The model's world is turned, moved and scaled at random; otherwise it is the true one (z up, m).
    gauge_seed : int, optional
        Of that; by default it follows from `seed`. Nothing else depends on it.
    seed : int
    """

    n_frames: int = 600
    fps: float = 30.0
    path: ScenePath = "survey"
    formation: Formation = "rig"
    n_cameras: int = 4
    distance: float = 2.7
    lane: float = 4.0
    rig_side: float = 0.6
    lens: str | tuple[str, ...] = "OPENCV"
    shared_lens: bool = False
    resolution: tuple[int, int] = (2704, 1520)
    focal: float = 1250.0
    key_step: int = 8
    unregistered: float = 0.03
    centre_noise: float = 0.002
    turn_noise: float = 0.03
    resection: bool = False
    n_landmarks: int = 600
    landmarks_per_image: int = 30
    landmark_noise: float = 0.001
    landmark_noise_px: float = 0.5
    relief: float = 0.15
    wand: float | None = 0.5
    n_animals: int = 1
    roam: float = 0.9
    noise_px: float = 1.0
    missed: float = 0.3
    miss_frames: float = 8.0
    outliers: float = 0.0
    swaps: int = 0
    clock_offset: tuple[float, ...] = ()
    clock_drift: tuple[float, ...] = ()
    gauge: bool = True
    gauge_seed: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        _check(self)

    @property
    def lenses(self) -> tuple[str, ...]:
        """COLMAP's model of each camera."""
        return (self.lens,) * self.n_cameras if isinstance(self.lens, str) else self.lens

    def clock(self, camera: int) -> np.ndarray:
        """Moments (N,) of the frames of a camera, on the reference clock, frames."""
        own = np.arange(self.n_frames, dtype=float)
        offset = self.clock_offset[camera] if self.clock_offset else 0.0
        drift = self.clock_drift[camera] if self.clock_drift else 0.0
        return own + offset + drift * own


@dataclass(frozen=True, eq=False)
class SimulatedScene:
    """A simulated scene.

    Attributes
    ----------
    options : SceneSimulation
    true_cameras : tuple of Camera
        With a true pose for each frame of the camera's own clock (true world, z up, m).
    individuals : tuple of str
    true_positions : (I, N, 3)
        In the true world, m, at the frames of the reference clock.
    structure : SceneStructure
        What structure from motion found, in the true world.
    gauge : Similarity
        The model's world from the true one.
    views : tuple of Tracks2D
        Of each camera, on its own clock; `animal` is the true individual.
    outlier : tuple of (P,) bool
        Rows of `views` that are grossly wrong.
    """

    options: SceneSimulation
    true_cameras: tuple[Camera, ...]
    individuals: tuple[str, ...]
    true_positions: np.ndarray
    structure: SceneStructure
    gauge: Similarity
    views: tuple[Tracks2D, ...]
    outlier: tuple[np.ndarray, ...]

    @property
    def true_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (C, N, 3, 3) and translations (C, N, 3), world to camera, on the cameras' own clocks."""
        return (
            np.stack([camera.rotation for camera in self.true_cameras]),
            np.stack([camera.translation for camera in self.true_cameras]),
        )

    def cameras(self) -> tuple[KeyedCamera, ...]:
        """Cameras and key frames in the model's world."""
        return tuple(camera.moved(self.gauge) for camera in self.structure.cameras)

    def tracks(self) -> tuple[Tracks2D, ...]:
        """2D tracks of each camera, in the order of the cameras."""
        return self.views

    def cloud(self):
        """The landmarks in the model's world, as a PointCloud."""
        from acino_fte.data_tools.point_cloud import PointCloud

        s = self.structure
        return PointCloud(self.gauge.points(s.landmarks), s.rgb, s.error)

    def regauged(self, gauge: Similarity) -> SimulatedScene:
        """The same scene with a model in another world."""
        from dataclasses import replace

        return replace(self, gauge=gauge)


def simulate_scene(options: SceneSimulation) -> SimulatedScene:
    """Simulate a scene.

    Parameters
    ----------
    options : SceneSimulation
        What to simulate.

    Returns
    -------
    SimulatedScene
        With its truth; the same options give the same numbers.
    """
    path_rng, animal_rng, lens_rng, model_rng, gauge_rng, *view_rngs = _generators(options)
    target = target_path(options.path, options.lane, path_rng)
    names, paths = individuals(target, options.n_animals, options.wand, options.roam, animal_rng)
    poses = _poses(options, target, path_rng)
    cameras = tuple(
        _camera(options, c, rotation, centre, lens_rng) for c, (rotation, centre) in enumerate(poses)
    )
    structure = simulate_structure(options, cameras, target, model_rng)
    seen = [
        simulate_view(camera, paths(options.clock(c) / options.fps), names, options, rng)
        for c, (camera, rng) in enumerate(zip(cameras, view_rngs, strict=True))
    ]
    return SimulatedScene(
        options,
        cameras,
        names,
        np.moveaxis(paths(np.arange(options.n_frames) / options.fps), 1, 0),
        structure,
        _gauge(options, gauge_rng),
        tuple(view for view, _ in seen),
        tuple(wild for _, wild in seen),
    )


def random_gauge(seed: int | np.random.Generator) -> Similarity:
    """A random similarity: any turn, up to 10 units away, 0.2 to 5 units per metre."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return Similarity(float(np.exp(rng.uniform(-1.6, 1.6))), turn, rng.uniform(-10.0, 10.0, 3))


def _generators(options: SceneSimulation) -> Iterator[np.random.Generator]:
    """One generator for each part: an option of one moves no other."""
    seeds = np.random.SeedSequence(options.seed).spawn(5 + options.n_cameras)
    return map(np.random.default_rng, seeds)


def _gauge(options: SceneSimulation, rng: np.random.Generator) -> Similarity:
    if not options.gauge:
        return Similarity()
    return random_gauge(rng if options.gauge_seed is None else options.gauge_seed)


def _poses(options: SceneSimulation, target, rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotations (N, 3, 3) and centres (N, 3) of each camera, on its own clock."""
    n, distance = options.n_cameras, options.distance
    times = [options.clock(c) / options.fps for c in range(n)]
    if options.formation == "rig":
        body = platform(options.path, target, distance, None, rng)
        turns, offsets = rig_sensors(n, options.rig_side, rng)
        poses = []
        for time, turn, offset in zip(times, turns, offsets, strict=True):
            rotation, centre = body.pose(time)
            poses.append((turn @ rotation, centre + np.einsum("nji,j->ni", rotation, offset)))
        return poses
    bodies: list[Platform] = [platform(options.path, target, distance, (c, n), rng) for c in range(n)]
    if options.formation == "fixed":
        bodies = [standing(body) for body in bodies]
    return [body.pose(time) for body, time in zip(bodies, times, strict=True)]


def _camera(
    options: SceneSimulation,
    number: int,
    rotation: np.ndarray,
    centre: np.ndarray,
    rng: np.random.Generator,
) -> Camera:
    first_or_own = np.zeros(6) if options.shared_lens else rng.normal(size=6)
    model, matrix, distortion = scene_lens(
        options.lenses[number], options.focal, options.resolution, first_or_own
    )
    translation = -np.einsum("nij,nj->ni", rotation, centre)
    return Camera(f"cam{number}", model, matrix, distortion, rotation, translation, options.resolution)


def _check(options: SceneSimulation) -> None:
    """Raise InputError for options that cannot be."""
    for key, names in (("path", get_args(ScenePath)), ("formation", get_args(Formation))):
        if getattr(options, key) not in names:
            _fail(options, key, f"one of {', '.join(names)}")
    lowest = {
        "n_frames": 1,
        "n_cameras": 1,
        "key_step": 1,
        "fps": 1e-6,
        "distance": 1e-3,
        "focal": 1e-3,
        "lane": 0.1,
    }
    for key in (field.name for field in fields(options)):
        value = getattr(options, key)
        if isinstance(value, float | int) and not lowest.get(key, 0) <= value < np.inf:
            _fail(options, key, f"a number, at least {lowest.get(key, 0):g}")
    for key in ("unregistered", "missed", "outliers"):
        if getattr(options, key) > 1:
            _fail(options, key, "between 0 and 1")
    unknown = sorted({*options.lenses} - {*SCENE_LENSES})
    if unknown or len(options.lenses) != options.n_cameras:
        _fail(options, "lens", f"one for all cameras or one for each, of {', '.join(SCENE_LENSES)}")
    if options.shared_lens and len({*options.lenses}) > 1:
        _fail(options, "lens", "one for all cameras when they share it")
    if options.formation == "fixed" and options.path != "orbit":
        _fail(options, "formation", "'fixed' with path 'orbit': another target leaves what fixed cameras see")
    for key in ("clock_offset", "clock_drift"):
        value = getattr(options, key)
        if value and (len(value) != options.n_cameras or not np.isfinite(value).all()):
            _fail(options, key, "a number for each camera, or none at all")
    if options.wand is None and options.n_animals < 1:
        _fail(options, "n_animals", "an animal at least when there is no wand")
    if options.swaps and options.n_animals + 2 * (options.wand is not None) < 2:
        _fail(options, "swaps", "two individuals at least, to exchange their names")


def _fail(options: SceneSimulation, key: str, expected: str) -> None:
    raise InputError(
        "The scene cannot be simulated.", key=key, expected=expected, found=str(getattr(options, key))
    )
