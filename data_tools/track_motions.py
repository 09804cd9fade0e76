"""Paths of many animals as points, to simulate recordings without markers. Shapes: N frames, A animals.

All paths stay in a box and follow from a random generator alone.

============  ==============================================================================================
smooth        Fast flight: the speed of every frame is uniform in 8–12 m/s, the heading turns by about 20° a
              frame, walls reflect (the motion that the text of the thesis describes).
jumpy         Every axis steps by a uniform random amount of up to 0.16 m a frame in its present direction,
              which turns at the walls and now and then in between (like the generator of the thesis's code).
perched       Birds that sit on perches for seconds and hop along them or fly to another one. The perches
              run along x, so that cameras beside each other see many birds in one epipolar plane.
flock         Animals that move together: one smooth path, and slowly changing places in the flock.
============  ==============================================================================================
"""

from __future__ import annotations

from typing import Literal

import numpy as np

Motion = Literal["smooth", "jumpy", "perched", "flock"]
MOTIONS: tuple[Motion, ...] = ("smooth", "jumpy", "perched", "flock")
Box = tuple[tuple[float, float, float], tuple[float, float, float]]

# Lowest and highest x, y, z (m) in the frame of the first camera of the thesis's rig.
BOXES: dict[Motion, Box] = {
    "smooth": ((-0.1, -0.9, 3.0), (2.07, 0.9, 5.0)),
    "jumpy": ((-0.5, -0.6, 2.5), (2.5, 0.6, 3.0)),
    "perched": ((0.0, -0.8, 3.0), (2.0, 0.8, 5.0)),
    "flock": ((-0.1, -0.9, 3.0), (2.07, 0.9, 5.0)),
}
_SPEED = (8.0, 12.0)  # m/s
_TURN = 0.27  # change of the unit heading in a frame at 30 Hz, each axis
_STEP = 4.74  # m/s on each axis at most; 0.158 m at 30 Hz
_REVERSAL = 0.02  # chance that an axis reverses in a frame at 30 Hz
_PERCHES, _HOP, _FLY = 3, 0.3, 0.1  # perches; hops and flights of one bird, per second
_SWAY, _FLIGHT_SPEED, _ARCH = 0.003, 3.0, 0.15  # m, m/s, height of a hop against its length


def animal_paths(
    motion: Motion, n_animals: int, n_frames: int, fps: float, box: Box, rng: np.random.Generator
) -> np.ndarray:
    """Positions (N, A, 3), m.

    Parameters
    ----------
    motion : str
        One of :data:`MOTIONS`.
    n_animals : int
        A.
    n_frames : int
        N.
    fps : float
        Frames per second.
    box : tuple
        Lowest and highest (x, y, z), m. ``jumpy`` oversteps it by up to one step.
    rng : numpy.random.Generator
        Source of all that is random.
    """
    low, high = np.array(box, dtype=float)
    make = {"smooth": _smooth, "jumpy": _jumpy, "perched": _perched, "flock": _flock}[motion]
    return make(n_animals, n_frames, fps, low, high, rng)


def _smooth(
    n_animals: int, n_frames: int, fps: float, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    x = rng.uniform(low, high, (n_animals, 3))
    heading = rng.normal(size=(n_animals, 3))
    paths = np.empty((n_frames, n_animals, 3))
    for n in range(n_frames):
        paths[n] = x
        heading = heading / np.linalg.norm(heading, axis=1, keepdims=True)
        heading = heading + rng.normal(size=heading.shape) * _TURN * np.sqrt(30.0 / fps)
        step = heading / np.linalg.norm(heading, axis=1, keepdims=True)
        x = x + step * rng.uniform(*_SPEED, (n_animals, 1)) / fps
        below, above = x < low, x > high
        x = np.where(below, 2 * low - x, np.where(above, 2 * high - x, x))
        x = np.clip(x, low, high)  # a box narrower than a step
        heading = np.where(below | above, -heading, heading)
    return paths


def _jumpy(
    n_animals: int, n_frames: int, fps: float, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    x = rng.uniform(low, high, (n_animals, 3))
    direction = rng.choice([-1.0, 1.0], (n_animals, 3))
    paths = np.empty((n_frames, n_animals, 3))
    for n in range(n_frames):
        paths[n] = x
        direction = np.where(rng.random(x.shape) < _REVERSAL * 30.0 / fps, -direction, direction)
        direction = np.where(x < low, 1.0, np.where(x > high, -1.0, direction))
        x = x + direction * rng.uniform(0.0, _STEP / fps, x.shape)
    return paths


def _perched(
    n_animals: int, n_frames: int, fps: float, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    perches = rng.uniform(low[1:], high[1:], (_PERCHES, 2))  # y and z of each
    paths = np.stack([_bird(n_frames, fps, perches, low[0], high[0], rng) for _ in range(n_animals)], axis=1)
    time = np.arange(n_frames)[:, None, None] / fps
    return paths + _SWAY * _waves(time, (n_animals, 3), rng, slowest=0.2, fastest=1.5)


def _bird(
    n_frames: int, fps: float, perches: np.ndarray, left: float, right: float, rng: np.random.Generator
) -> np.ndarray:
    """One bird, (N, 3): sits, and moves from seat to seat on minimum-jerk paths (Flash and Hogan 1985)."""
    path = np.empty((n_frames, 3))
    perch = int(rng.integers(len(perches)))
    seat = np.array([rng.uniform(left, right), *perches[perch]])
    n = 0
    while n < n_frames:
        leave = n + 1 + int(rng.exponential(fps / (_HOP + _FLY)))
        path[n:leave] = seat
        n = leave
        if rng.random() < _FLY / (_HOP + _FLY):
            perch = int(rng.integers(len(perches)))
            target = np.array([rng.uniform(left, right), *perches[perch]])
        else:
            along = seat[0] + rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.4)
            target = np.array([np.clip(along, left, right), *seat[1:]])
        distance = float(np.linalg.norm(target - seat))
        count = max(2, int(np.ceil(distance / _FLIGHT_SPEED * fps)))
        s = np.arange(1, count + 1)[:, None] / count
        flight = seat + (target - seat) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        flight[:, 1] -= _ARCH * distance * 4.0 * (s * (1.0 - s))[:, 0]
        path[n : n + count] = flight[: max(n_frames - n, 0)]
        n, seat = n + count, target
    return path


def _flock(
    n_animals: int, n_frames: int, fps: float, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    time = np.arange(n_frames)[:, None, None] / fps
    half = 0.5 * (high - low)
    common = 0.65 * _waves(time, (1, 3), rng, slowest=0.5, fastest=1.5)
    place = rng.uniform(-0.25, 0.25, (n_animals, 3)) + 0.1 * _waves(
        time, (n_animals, 3), rng, slowest=0.05, fastest=0.5
    )
    return 0.5 * (low + high) + half * (common + place)


def _waves(
    time: np.ndarray, shape: tuple[int, int], rng: np.random.Generator, *, slowest: float, fastest: float
) -> np.ndarray:
    """Sums of three sines of random frequency (Hz) and phase, within ±1, (N, *shape)."""
    total = np.zeros((len(time), *shape))
    for _ in range(3):
        frequency = rng.uniform(slowest, fastest, shape)
        total += np.sin(2 * np.pi * (frequency * time + rng.uniform(0.0, 1.0, shape))) / 3.0
    return total
