"""The lidar of a simulated rig: a scan that never repeats, cast against an animal, grass and bushes.

The sensor is like a Livox Tele-15: 240 000 points a second in a field of 14.5° by 16.2°. Its pattern here
is a model, not Livox's own: six beams draw a rosette whose two turns are in no whole ratio, and whose radius
is such that the density is the same all over the ellipse. A point comes 4167 ns after the one before. Beams
are lines, or have a width in which every return has a place of its own.

Frame of the lidar, as Livox has it: x forward, y left, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from acino_fte.motions import Motion
from acino_fte.rig_motion import CameraPath
from acino_fte.rig_options import RigOptions
from acino_fte.rig_rays import ray_capsules, ray_level, ray_spheres

FIELD = (math.radians(14.5), math.radians(16.2))  # whole width and height
BEAMS = 6
_TURNS, _PETALS = 1078.69, 211.3  # Hz
REACH = 320.0  # m: no returns beyond
_CHUNK = 60_000  # points cast at once
_FOLIAGE = 0.3  # m that a beam enters a bush, at most
_MARGIN = 0.3  # m about the markers in which there may be body
INTENSITY = {"body": (35.0, 8.0), "grass": (60.0, 12.0), "bush": (25.0, 8.0)}  # mean, standard deviation
MOUNT_ROTATION = (4e-3, -3e-3, 2e-3)  # rad, rotation vector of the lidar against the axes of the camera
MOUNT_TRANSLATION = (0.14, 0.05, 0.02)  # m, of the lidar in the camera's frame
LIVOX_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns of the simulated lidar with what they hit. K returns.

    Attributes
    ----------
    time : (K,)
        True, s since frame 0.
    xyz : (K, 3)
        m, frame of the lidar.
    intensity : (K,)
    on_body : (K,) bool
        It comes from the animal.
    link : (K,) int
        The drawn line (of :attr:`acino_fte.skeleton.Skeleton.edges`) whose capsule it comes from, else −1.
    marker : (K,) int
        The marker that a ``"pseudo"`` return was made for, else −1.
    misled : (K,) bool
        The beam pointed at the animal, and the return is from behind it or from foliage before it.
    distance : (K,)
        True distance of what was hit, m: the range without its noise.
    """

    time: np.ndarray
    xyz: np.ndarray
    intensity: np.ndarray
    on_body: np.ndarray
    link: np.ndarray
    marker: np.ndarray
    misled: np.ndarray
    distance: np.ndarray


@dataclass(frozen=True, eq=False)
class Scenery:
    """What stands still: bushes as spheres, `centre` (B, 3) and `radius` (B,), m, world, on level ground."""

    centre: np.ndarray
    radius: np.ndarray
    grass: float


@dataclass(frozen=True, eq=False)
class Body:
    """The animal as capsules: drawn lines as marker pairs (E, 2), and radii (E,), m."""

    pairs: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, options: RigOptions, motion: Motion) -> Body:
        """The body of a species as the options have it."""
        skeleton = motion.kinematics.skeleton
        solid = {}
        if options.body == "capsules":
            solid = {frozenset((a, b)): radius for a, b, radius in skeleton.capsules}
        pairs = np.array(skeleton.edges, dtype=int).reshape(-1, 2)
        radius = [solid.get(frozenset(pair), options.surface_m) for pair in pairs.tolist()]
        return cls(pairs, np.array(radius, dtype=float))


def scan_directions(time: np.ndarray) -> np.ndarray:
    """Unit directions (K, 3) of the points at times (K,), s, frame of the lidar.

    Point k is of beam k modulo six. In the ellipse of the field (half axes 7.25° and 8.1°) its angle is
    2π·1078.69·t + beam·60° and the square of its radius a triangle wave of 211.3 Hz from 0 to 1: what is
    uniform in angle and squared radius is uniform in area. Counts in small cells vary less than those of
    random points do, after a frame of 1/60 s already.
    """
    beam = np.arange(len(time)) % BEAMS
    angle = 2 * np.pi * (_TURNS * time + beam / BEAMS)
    wave = (_PETALS * time + beam / (2 * BEAMS)) % 1.0
    radius = np.sqrt(1.0 - np.abs(2.0 * wave - 1.0))
    left, up = 0.5 * FIELD[0] * radius * np.cos(angle), 0.5 * FIELD[1] * radius * np.sin(angle)
    return np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)], axis=1)


def firing_period(options: RigOptions) -> float:
    """True time between two points, s: whole nanoseconds of the lidar's own clock."""
    return 1e-9 * round(1e9 / options.points_per_second) / (1.0 + 1e-6 * options.lidar_drift_ppm)


def mean_density(distance: float, points_per_second: float = 240_000.0) -> float:
    """Returns per second and square metre of a surface that faces the lidar at a distance (m)."""
    return points_per_second / (math.pi / 4 * FIELD[0] * FIELD[1] * distance**2)


def place_scenery(options: RigOptions, path: CameraPath, motion: Motion) -> Scenery:
    """Bushes 5–40 m behind the path as the camera sees it, all over the view of its whole pan."""
    rng = options.stream("scenery")
    middle = motion.kinematics.positions(motion.at_frames, motion.parameters).mean(axis=1)
    pan = path.pan(motion.time)
    far = float(np.max(np.hypot(*(middle - path.centre)[:, :2].T)))
    n = options.bushes
    bearing = rng.uniform(pan.min() - FIELD[0] / 2, pan.max() + FIELD[0] / 2, n)
    distance = far + rng.uniform(5.0, 40.0, n)
    radius = rng.uniform(0.7, 2.5, n)
    height = 0.6 * radius
    place = np.stack([np.sin(bearing) * distance, np.cos(bearing) * distance, height], axis=1)
    return Scenery(place + path.centre * (1.0, 1.0, 0.0), radius, options.grass_m)


def scan(
    options: RigOptions,
    motion: Motion,
    path: CameraPath,
    lidar_to_camera: tuple[np.ndarray, np.ndarray],
    scenery: Scenery,
) -> Returns:
    """All returns from half a frame before the first frame to half a frame after the last."""
    start, stop = -0.5 / options.fps, (options.n_frames - 0.5) / options.fps
    period = firing_period(options)
    first, last = math.ceil(start / period), math.ceil(stop / period)
    first -= first % BEAMS
    streams = ("grass", "range", "direction", "beam", "background", "intensity")
    rng = {name: options.stream(name) for name in streams}
    body = Body.of(options, motion)
    parts = []
    for index in range(first, last, _CHUNK):
        time = np.arange(index, min(index + _CHUNK, last)) * period
        parts.append(_scan_part(options, motion, path, lidar_to_camera, scenery, body, time, rng))
    return Returns(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _scan_part(
    options: RigOptions,
    motion: Motion,
    path: CameraPath,
    lidar_to_camera: tuple[np.ndarray, np.ndarray],
    scenery: Scenery,
    body: Body,
    time: np.ndarray,
    rng: dict[str, np.random.Generator],
) -> tuple[np.ndarray, ...]:
    """The columns of Returns for points at times (K,)."""
    nominal = scan_directions(time)
    direction, origin = to_world(path, lidar_to_camera, time, _in_beam(options, rng["beam"], nominal))
    if options.angle_noise_mrad:
        direction = _turned(rng["direction"], direction, 1e-3 * options.angle_noise_mrad)
    still, is_bush = _still_distance(scenery, origin, direction, rng["grass"])
    animal, link = _animal_distance(motion, body, origin, direction, time)
    met = animal < still
    misled = met & (rng["background"].random(len(time)) < options.background)
    distance = np.where(met, animal, still)
    distance[misled] = _misled(rng["background"], animal[misled], still[misled])
    kinds = np.where(met & ~misled, 0, np.where(is_bush | misled, 2, 1))
    seen = np.isfinite(distance) & (distance < REACH)
    noisy = distance + rng["range"].standard_normal(len(time)) * _range_sd(options, distance)
    on_body = met & ~misled
    columns = (
        time,
        nominal * noisy[:, None],
        _intensity(rng["intensity"], kinds),
        on_body,
        np.where(on_body, link, -1),
        np.full(len(time), -1),
        misled,
        distance,
    )
    return tuple(column[seen] for column in columns)


def to_world(
    path: CameraPath,
    lidar_to_camera: tuple[np.ndarray, np.ndarray],
    time: np.ndarray,
    direction: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Directions in the lidar's frame at times (K,), and its places, in the world: (K, 3) and (K, 3)."""
    turn = path.rotation(time)
    rotation, translation = lidar_to_camera
    world = np.einsum("kji,kj->ki", turn, direction @ rotation.T)
    return world, path.centre + np.einsum("kji,j->ki", turn, translation)


def _still_distance(
    scenery: Scenery, origin: np.ndarray, direction: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (K,) to grass or bush, and whether it is a bush.

    A beam meets the grass at a height of its own, with an exponential distribution.
    """
    ground = ray_level(origin, direction, rng.exponential(scenery.grass, len(origin)))
    into = rng.uniform(0.0, _FOLIAGE, len(origin))
    bush = np.full(len(origin), np.inf)
    if len(scenery.radius):
        bush = ray_spheres(origin, direction, scenery.centre, scenery.radius).min(axis=1) + into
    return np.minimum(ground, bush), bush < ground


def _animal_distance(
    motion: Motion, body: Body, origin: np.ndarray, direction: np.ndarray, time: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (K,) to the capsules of the animal as it is at the time of each ray, and which (K,)."""
    distance, link = np.full(len(time), np.inf), np.full(len(time), -1)
    if not len(body.radius):
        return distance, link
    few = np.linspace(time[0], time[-1], max(2, round((time[-1] - time[0]) / 0.01) + 1))
    points = motion.kinematics.positions(motion(few), motion.parameters)
    middle = points.mean(axis=1)
    reach = np.linalg.norm(points - middle[:, None], axis=2).max() + body.radius.max() + _MARGIN
    offset = np.stack([np.interp(time, few, middle[:, i]) for i in range(3)], axis=1) - origin
    along = np.einsum("ki,ki->k", offset, direction)
    near = np.flatnonzero(np.linalg.norm(offset - along[:, None] * direction, axis=1) < reach)
    if not near.size:
        return distance, link
    positions = motion.kinematics.positions(motion(time[near]), motion.parameters)
    start, end = positions[:, body.pairs[:, 0]], positions[:, body.pairs[:, 1]]
    met = ray_capsules(origin[near], direction[near], start, end, body.radius)
    link[near] = met.argmin(axis=1)
    distance[near] = met.min(axis=1)
    return distance, np.where(np.isfinite(distance), link, -1)


def _misled(rng: np.random.Generator, animal: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Distances (K,) of returns that are not from the animal: half behind it, half from foliage before."""
    behind = np.where(np.isfinite(still), still, animal + rng.uniform(5.0, 40.0, len(animal)))
    before = np.maximum(animal - rng.uniform(0.3, 5.0, len(animal)), 0.5)
    return np.where(rng.random(len(animal)) < 0.5, behind, before)


def _intensity(rng: np.random.Generator, kinds: np.ndarray) -> np.ndarray:
    """Reflectivities (K,), 0–255, of kinds (K,): 0 body, 1 grass, 2 bush."""
    mean, sd = np.array(list(INTENSITY.values())).T
    return np.clip(np.round(mean[kinds] + sd[kinds] * rng.standard_normal(len(kinds))), 0.0, 255.0)


def _range_sd(options: RigOptions, distance: np.ndarray) -> np.ndarray:
    """Standard deviation of ranges at distances (K,), m; that of no distance where it is infinite."""
    if not options.range_noise_per_m:
        return np.full(len(distance), options.range_noise_m)
    reached = np.where(np.isfinite(distance), distance, 0.0)
    return np.hypot(options.range_noise_m, options.range_noise_per_m * reached)


def _in_beam(options: RigOptions, rng: np.random.Generator, nominal: np.ndarray) -> np.ndarray:
    """Directions (K, 3), frame of the lidar, at which the beams that point at `nominal` meet something."""
    quarter = 0.25 * np.radians([options.beam_width_deg, options.beam_height_deg])
    if not quarter.any():
        return nominal
    aside = rng.standard_normal((len(nominal), 2)) * quarter
    turned = nominal + np.concatenate([np.zeros((len(nominal), 1)), aside], axis=1)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _turned(rng: np.random.Generator, direction: np.ndarray, sd: float) -> np.ndarray:
    noise = rng.standard_normal(direction.shape) * sd
    turned = direction + np.cross(noise, direction)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def pseudo_returns(
    options: RigOptions,
    positions: np.ndarray,
    visible: np.ndarray,
    path: CameraPath,
    lidar_to_camera: tuple[np.ndarray, np.ndarray],
) -> Returns:
    """One return at the time of each frame and on the camera's line of sight to each visible marker.

    ``positions`` (N, M, 3) are true, m, world; ``visible`` (N, M) says which markers are seen.
    """
    rng = {name: options.stream(name) for name in ("range", "background", "intensity")}
    frame, marker = np.nonzero(visible)
    time = frame / options.fps
    turn = path.rotation(np.arange(len(positions)) / options.fps)[frame]
    local = np.einsum("kij,kj->ki", turn, positions[frame, marker] - path.centre)
    away = np.linalg.norm(local, axis=1)
    surface = away - options.surface_m
    misled = rng["background"].random(len(time)) < options.background
    distance = surface.copy()
    distance[misled] = _misled(rng["background"], surface[misled], np.full(int(misled.sum()), np.inf))
    rotation, translation = lidar_to_camera
    place = local / away[:, None] * distance[:, None]
    xyz = (place - translation) @ rotation
    reach = np.linalg.norm(xyz, axis=1)
    xyz *= (1.0 + rng["range"].standard_normal(len(time)) * _range_sd(options, reach) / reach)[:, None]
    kinds = np.where(misled, 2, 0)
    return Returns(
        time,
        xyz,
        _intensity(rng["intensity"], kinds),
        ~misled,
        np.full(len(time), -1),
        np.where(misled, -1, marker),
        misled,
        reach,
    )
