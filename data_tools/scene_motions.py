"""Paths of cameras and animals outdoors, as functions of time, to simulate scenes with moving cameras.

World: z up, ground near z = 0, m. Every path can be asked at any time (s), so that a camera whose clock is
late sees the moment that it really saw. All follows a *target*, a point on the ground that moves along.

============  ==============================================================================================
survey        Cameras above the target, looking down, back and forth over a field (a lawnmower's path).
orbit         Cameras circle a target that hardly moves and look sideways at it (a diver, a drone).
walk          Cameras beside a target that walks along, panned to keep it in view.
============  ==============================================================================================

Shapes: T times, S cameras, I individuals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

ScenePath = Literal["survey", "orbit", "walk"]
Formation = Literal["rig", "free", "fixed"]
Signal = Callable[[np.ndarray], np.ndarray]

_SPACING = 2.0  # m, between the lanes of a survey
_SPEED = {"survey": 0.8, "orbit": 0.3, "walk": 1.0}  # m/s; of an orbit, rad/s
_SWAY, _TURN = 0.05, np.radians(2.0)  # of a camera in a hand or on a drone: m and rad
_SWAY_BAND, _ROAM_BAND = (0.05, 0.6), (0.05, 0.4)  # Hz
_TOE = np.radians(3.0)  # cameras of a rig are not parallel


def waves(rng: np.random.Generator, shape: tuple[int, ...], band: tuple[float, float]) -> Signal:
    """Sums of four sines of random phase and frequency in `band` (Hz), within ±1: (T,) → (T, *shape)."""
    frequency = 2 * np.pi * rng.uniform(*band, (4, *shape))
    phase = rng.uniform(0.0, 2 * np.pi, (4, *shape))

    def at(time: np.ndarray) -> np.ndarray:
        time = np.asarray(time, dtype=float).reshape(-1, *[1] * len(shape))
        total = np.zeros((len(time), *shape))
        for f, p in zip(frequency, phase, strict=True):
            total += np.sin(f * time + p) / len(frequency)
        return total

    return at


def target_path(path: ScenePath, lane: float, rng: np.random.Generator) -> Signal:
    """Where on the ground (T, 3) cameras and animals are about; `lane`: length of a survey's lanes, m."""
    if path == "survey":
        return lambda time: _lawnmower(_SPEED["survey"] * np.asarray(time, dtype=float), lane)
    drift = waves(rng, (2,), (0.02, 0.1))

    def at(time: np.ndarray) -> np.ndarray:
        xy = 0.5 * drift(time)
        if path == "walk":
            xy = 2.0 * xy + np.asarray(time, dtype=float)[:, None] * [_SPEED["walk"], 0.0]
        return np.pad(xy, ((0, 0), (0, 1)))

    return at


def _lawnmower(along: np.ndarray, length: float) -> np.ndarray:
    """Points at arc lengths (T,) of straight lanes of a length (m) joined by half circles, (T, 3)."""
    radius = 0.5 * _SPACING
    period = length + np.pi * radius
    lane = np.floor(along / period)
    rest = along - lane * period
    forward = np.where(lane % 2 == 0, 1.0, -1.0)
    angle = np.maximum(rest - length, 0.0) / radius
    x = np.minimum(rest, length) + radius * np.sin(angle)
    y = lane * _SPACING + radius * (1.0 - np.cos(angle))
    return np.stack([np.where(forward > 0, x, length - x), y, np.zeros_like(x)], axis=-1)


@dataclass(frozen=True)
class Platform:
    """What carries a camera, or a whole rig.

    Attributes
    ----------
    path : str
        ``survey``, ``orbit`` or ``walk``.
    target : callable
        From :func:`target_path`.
    distance : float
        From the target, m.
    bearing : float
        Where about the target, rad.
    aside : tuple of float
        Displacement on the ground, m.
    shift, turn : callable
        Sway: (T, 3) m and rad.
    """

    path: ScenePath
    target: Signal
    distance: float
    bearing: float
    aside: tuple[float, float]
    shift: Signal
    turn: Signal

    def pose(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (T, 3, 3), world to camera, and centres (T, 3)."""
        target = self.target(time)
        if self.path == "survey":
            centre = target + [*self.aside, self.distance] + self.shift(time)
            forward = np.broadcast_to([0.0, 0.0, -1.0], centre.shape)
            up = np.array([-np.sin(self.bearing), np.cos(self.bearing), 0.0])
        else:
            bearing = np.full(len(target), self.bearing)
            if self.path == "orbit":
                bearing = bearing + _SPEED["orbit"] * time
            out = np.stack([np.cos(bearing), np.sin(bearing), np.full(len(bearing), 0.35)], axis=-1)
            centre = target + self.distance * out + self.shift(time)
            forward, up = target + [0.0, 0.0, 0.5] - centre, np.array([0.0, 0.0, 1.0])
        sway = Rotation.from_rotvec(self.turn(time)).as_matrix()
        return sway @ _looking(forward, up), centre


def _looking(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World to camera (T, 3, 3) of cameras that look forward (T, 3); `up` points to the top of the image."""
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=-2)


def platform(
    path: ScenePath, target: Signal, distance: float, place: tuple[int, int] | None, rng: np.random.Generator
) -> Platform:
    """The platform of a rig, or of a camera on its own.

    Parameters
    ----------
    path : str
        ``survey``, ``orbit`` or ``walk``.
    target : callable
        From :func:`target_path`.
    distance : float
        From the target, m.
    place : tuple of int, optional
        Number of this camera and of all; None for a rig, which has the only platform.
    rng : numpy.random.Generator
        Source of all that is random.
    """
    bearing, aside = (0.0 if path == "survey" else -0.5 * np.pi), np.zeros(2)
    if place is not None:
        spacing = min(np.radians(40.0), 2 * np.pi / place[1])
        bearing += spacing * (place[0] - 0.5 * (place[1] - 1)) + rng.uniform(-0.1, 0.1)
        angle = 2 * np.pi * place[0] / place[1]
        aside = 0.2 * distance * np.array([np.cos(angle), np.sin(angle)])
        distance = distance * rng.uniform(0.9, 1.1)
    shift, turn = waves(rng, (3,), _SWAY_BAND), waves(rng, (3,), _SWAY_BAND)
    return Platform(
        path,
        target,
        distance,
        bearing,
        (float(aside[0]), float(aside[1])),
        lambda time: _SWAY * shift(time),
        lambda time: _TURN * turn(time),
    )


def standing(moving: Platform) -> Platform:
    """A platform that stays where this one is at time 0 (a tripod)."""

    def still(signal: Signal) -> Signal:
        return lambda time: np.repeat(signal(np.zeros(1)), len(np.atleast_1d(time)), axis=0)

    target = moving.target(np.zeros(1))
    return Platform(
        "walk",  # an orbit would go on circling
        lambda time: np.repeat(target, len(np.atleast_1d(time)), axis=0),
        moving.distance,
        moving.bearing,
        moving.aside,
        still(moving.shift),
        still(moving.turn),
    )


def rig_sensors(n_cameras: int, side: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Cameras of a rigid rig, at the corners of a regular polygon with this side (m) across the view.

    Returns
    -------
    rotation : (S, 3, 3)
        Rig to camera; each camera is turned by about 3° its own way.
    offset : (S, 3)
        Centres in the rig's frame (x right, y down, z forward), m.
    """
    turn = Rotation.from_rotvec(_TOE * rng.normal(size=(n_cameras, 3)) / np.sqrt(3.0)).as_matrix()
    radius = 0.5 * side / np.sin(np.pi / n_cameras) if n_cameras > 1 else 0.0
    angle = 2 * np.pi * (np.arange(n_cameras) + 0.5) / n_cameras
    return turn, radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(n_cameras)], axis=-1)


def individuals(
    target: Signal, n_animals: int, wand: float | None, roam: float, rng: np.random.Generator
) -> tuple[tuple[str, ...], Signal]:
    """Names and paths of what is tracked: the two ends of a wand, and animals.

    Parameters
    ----------
    target : callable
        They stay about it.
    n_animals : int
        How many animals.
    wand : float, optional
        Length, m; None: no wand.
    roam : float
        How far they go from the target, m, each way.
    rng : numpy.random.Generator
        Source of all that is random.

    Returns
    -------
    names : tuple of str
    paths : callable
        Times (T,) → (T, I, 3), m.
    """
    place = waves(rng, (n_animals + 1, 3), _ROAM_BAND)
    direction = waves(rng, (2,), _ROAM_BAND)
    spread = np.array([roam, roam, 0.4])

    def at(time: np.ndarray) -> np.ndarray:
        points = target(time)[:, None] + 1.5 * spread * place(time) + [0.0, 0.0, 0.8]
        if wand is None:
            return points[:, 1:]
        azimuth, elevation = np.pi * direction(time).T
        level = np.cos(0.3 * elevation)
        along = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(0.3 * elevation)], -1)
        ends = points[:, :1] + 0.5 * wand * along[:, None] * np.array([[-1.0], [1.0]])
        return np.concatenate([ends, points[:, 1:]], axis=1)

    animals = tuple(f"animal_{n + 1}" for n in range(n_animals))
    return (*(() if wand is None else ("wand_a", "wand_b")), *animals), at


def ground(rng: np.random.Generator, relief: float) -> Callable[[np.ndarray], np.ndarray]:
    """Height (…,), m, of an uneven ground at places (…, 2): four bumps and hollows on each other."""
    wave = rng.normal(size=(4, 2)) * 1.2  # rad/m
    phase = rng.uniform(0.0, 2 * np.pi, 4)
    return lambda xy: relief * np.mean(np.sin(np.asarray(xy) @ wave.T + phase), axis=-1)


def landmarks(
    path: ScenePath,
    target: Signal,
    n_landmarks: int,
    seconds: float,
    spread: float,
    relief: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Points that structure from motion would find, (L, 3): the ground, and things that stand on it.

    Parameters
    ----------
    path : str
        Cameras that look sideways also see what stands about: one point in three is up to 2.5 m high.
    target : callable
        They lie about it, wherever it goes in the first `seconds`.
    n_landmarks : int
        L.
    seconds : float
        Length of the recording.
    spread : float
        How far from the target, m.
    relief : float
        Height of the ground's bumps, m.
    rng : numpy.random.Generator
        Source of all that is random.
    """
    about = target(rng.uniform(0.0, seconds, n_landmarks))
    angle = rng.uniform(0.0, 2 * np.pi, n_landmarks)
    reach = spread * np.sqrt(rng.uniform(0.0, 1.0, n_landmarks))
    about[:, :2] += reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    about[:, 2] = ground(rng, relief)(about[:, :2]) + rng.exponential(0.08, n_landmarks)
    if path != "survey":
        standing_high = rng.random(n_landmarks) < 1 / 3
        about[standing_high, 2] += rng.uniform(0.0, 2.5, standing_high.sum())
    return about
