"""2D tracks of simulated scenes: noise, misses in bursts, gross errors, exchanged identities.

Shapes: N frames, I individuals, P rows of one camera.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.tracks2d import Tracks2D

if TYPE_CHECKING:
    from acino_fte.data_tools.simulate_scene import SceneSimulation


def simulate_view(
    camera: Camera,
    points: np.ndarray,
    names: tuple[str, ...],
    options: SceneSimulation,
    rng: np.random.Generator,
) -> tuple[Tracks2D, np.ndarray]:
    """What a tracker makes of one camera.

    Parameters
    ----------
    camera : Camera
        With a pose for each frame.
    points : (N, I, 3)
        Individuals at the moments of its frames, world, m.
    names : tuple of str
        Of the individuals.
    options : SceneSimulation
        What to simulate.
    rng : numpy.random.Generator
        Source of all that is random.

    Returns
    -------
    view : Tracks2D
        Its rows.
    wild : (P,) bool
        Rows that are grossly wrong.
    """
    exact = camera.project(points)
    pixels = exact + options.noise_px * rng.normal(size=exact.shape)
    there = in_view(camera, camera.to_camera(points)) & camera.inside(pixels)
    there &= ~in_bursts(options.missed, options.miss_frames, there.shape, rng)
    angle = rng.uniform(0.0, 2 * np.pi, there.shape)
    off = rng.uniform(20.0, 150.0, there.shape)[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    wild = rng.random(there.shape) < options.outliers
    pixels = np.where(wild[..., None], pixels + off, pixels)
    track = _exchanged(options, len(names), rng)
    frame, individual = np.nonzero(there)
    view = Tracks2D(camera.name, frame, track[there], pixels[there], names, individual)
    return view, wild[there]


def in_view(camera: Camera, local: np.ndarray) -> np.ndarray:
    """Whether points (…, 3) in the camera's frame are in the image, not folded into it from far outside."""
    angle = np.arctan2(np.hypot(local[..., 0], local[..., 1]), local[..., 2])
    near = angle < min(camera.valid_angle, 0.5 * np.pi - 1e-6)
    lens = replace(camera, rotation=np.eye(3), translation=np.zeros(3))
    near[near] = camera.inside(lens.project(local[near]))
    return near


def in_bursts(share: float, length: float, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """A mask (N, M) with bursts of True, about `length` rows each, that cover a share of its columns."""
    n, m = shape
    if share in (0.0, 1.0) or not n:
        return np.full(shape, share == 1.0)
    length = max(length, 1.0, share / (1.0 - share))
    mean = (length * (1.0 - share) / share, length)  # of runs without and with
    count = 2 * (int(n / sum(mean) * 1.5) + 10)
    runs = np.stack([rng.geometric(1.0 / mean[k % 2], m) for k in range(count)])
    runs[0, rng.random(m) < share] = 0  # begins with a burst
    ends = np.cumsum(runs, axis=0)
    return np.stack([np.searchsorted(ends[:, c], np.arange(n), "right") % 2 for c in range(m)], 1) == 1


def _exchanged(options: SceneSimulation, n_individuals: int, rng: np.random.Generator) -> np.ndarray:
    """Name (N, I) under which the tracker reports each individual."""
    track = np.tile(np.arange(n_individuals), (options.n_frames, 1))
    for _ in range(options.swaps):
        a, b = rng.choice(n_individuals, 2, replace=False)
        rows = slice(start := int(rng.integers(options.n_frames)), start + 15)
        track[rows, [a, b]] = track[rows, [b, a]]
    return track
