"""Simulated picks for a camera beside a lidar: to try a plan of targets before going out, and for tests.

The lidar's frame has x forward, y to the left, z up. The camera looks forward, a few decimetres and degrees
off, and zooms in as targets are farther away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.lidar_pairs import LidarPairs
from acino_fte.data_tools.lidar_solve_model import PickNoise
from acino_fte.data_tools.rotations import rotation_matrix

RESOLUTION = (2048, 1088)
TARGETS = ("board", "boards", "scene")
"""One tilted board; four placements of it; places anywhere in a scene with depth."""
_FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_BOARD, _TILT = (2.0, 1.5), (35.0, 55.0)  # m; degrees about an axis across the view
_PX_PER_M = 250.0  # of a target at the distance: the zoom follows it
_DEPTH = 0.15  # of a scene, to both sides, as a share of the distance


@dataclass(frozen=True, eq=False)
class SimulatedPicks:
    """Picks for calibrating, others that are held out, and the camera that saw them."""

    camera: Camera
    pairs: LidarPairs
    held_out: LidarPairs


def simulated_picks(
    distance: float,
    targets: str,
    n_pairs: int,
    seed: int,
    *,
    noise: PickNoise | None = None,
    n_held_out: int = 60,
    distortion: tuple[float, float] = (0.0, 0.0),
    outliers: float = 0.0,
    spread: bool = True,
) -> SimulatedPicks:
    """Picks on targets at a distance.

    Parameters
    ----------
    distance : float
        Of the targets from the rig, m.
    targets : {"board", "boards", "scene"}
        What was picked on; see :data:`TARGETS`.
    n_pairs : int
        Pairs for calibrating.
    seed : int
        Of rig, targets and noise.
    noise : PickNoise, optional
        1 px and 2 cm along the ray, unless told.
    n_held_out : int
        Further pairs, of the same kind.
    distortion : (k1, k2)
        Of the lens.
    outliers : float
        Share of the calibrating pairs that belong to other places, 20–200 px off.
    spread : bool
        Whether the calibrating pairs are spread evenly over their targets, as is advised; those that are held
        out are anywhere on them.
    """
    rng = np.random.default_rng(seed)
    noise = noise or PickNoise()
    camera = _camera(distance, distortion, rng)
    n = n_pairs + n_held_out
    xyz, placement = _places(camera, distance, targets, n, n_pairs if spread else 0, rng)
    pixel = camera.project(xyz) + rng.normal(0, noise.pixel, (n, 2))
    wild = np.arange(n) < round(outliers * n_pairs)
    angle = rng.uniform(0, 2 * np.pi, wild.sum())
    pixel[wild] += rng.uniform(20, 200, (wild.sum(), 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pixel = np.clip(pixel, 0, np.array(RESOLUTION) - 1.0)
    pairs = LidarPairs(pixel, _noisy(xyz, noise, rng), tuple(f"placement_{i}" for i in placement))
    rows = np.arange(n)
    return SimulatedPicks(camera, pairs.take(rows[:n_pairs]), pairs.take(rows[n_pairs:]))


def _camera(distance: float, distortion: tuple[float, float], rng: np.random.Generator) -> Camera:
    width, height = RESOLUTION
    focal = _PX_PER_M * distance * rng.uniform(0.8, 1.2)
    cx, cy = 0.5 * (width - 1) + rng.normal(0, 20), 0.5 * (height - 1) + rng.normal(0, 20)
    matrix = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])
    wobble = np.minimum(0.5, 100.0 / focal)  # rad; a mount that has the target in the image
    rotation = rotation_matrix(rng.normal(0, [wobble, wobble, 0.1])) @ _FORWARD
    centre = rng.uniform([-0.2, -0.4, -0.3], [0.2, 0.4, 0.3])
    name, k = "cam1", np.array([*distortion, 0.0, 0.0, 0.0])
    return Camera(name, "pinhole", matrix, k, rotation, -rotation @ centre, RESOLUTION)


def _places(
    camera: Camera, distance: float, targets: str, n: int, n_spread: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) in the lidar's frame that the camera sees, and their placement (n,)."""
    n_boards = {"board": 1, "boards": 4}.get(targets, 0)
    if not n_boards:
        depth = distance * rng.uniform(1 - _DEPTH, 1 + _DEPTH, n)
        return _in_view(camera, depth, 0.95, _even(n, n_spread, rng)), np.zeros(n, int)
    reach = 0.1 if n_boards == 1 else 0.6
    middles = _in_view(camera, distance * rng.uniform(0.95, 1.05, n_boards), reach, rng.random((n_boards, 2)))
    xyz, placement = np.empty((n, 3)), np.arange(n) % n_boards
    for i, middle in enumerate(middles):
        axis = rng.normal(size=2)
        tilt = np.radians(rng.uniform(*_TILT)) * axis / np.linalg.norm(axis)
        board = camera.rotation.T @ rotation_matrix(np.array([*tilt, 0.0]))[:, :2]  # (3, 2)
        rows = np.flatnonzero(placement == i)
        flat = (_even(len(rows), int((rows < n_spread).sum()), rng) - 0.5) * _BOARD
        xyz[rows] = middle + flat @ board.T
    return xyz, placement


def _in_view(camera: Camera, depth: np.ndarray, share: float, where: np.ndarray) -> np.ndarray:
    """Places (K, 3) at depths (K,), somewhere (K, 2), 0 to 1, in the middle share of the image."""
    size = np.array(RESOLUTION, dtype=float)
    pixel = 0.5 * (size - 1) + share * size * (where - 0.5)
    return camera.back_project(pixel[None], depth[None])[0]


def _even(n: int, n_even: int, rng: np.random.Generator) -> np.ndarray:
    """Numbers (n, 2) from 0 to 1, the first of them evenly spread: multiples of the plastic number's powers.

    (Kronecker sequence of the plastic number; Roberts 2018.)
    """
    out = rng.random((n, 2))
    steps = np.arange(n_even)[:, None] * [0.7548776662466927, 0.5698402909980532]
    out[:n_even] = (rng.random(2) + steps) % 1.0
    return out


def _noisy(xyz: np.ndarray, noise: PickNoise, rng: np.random.Generator) -> np.ndarray:
    """Returns (K, 3) with errors along their ray and across it."""
    distance = np.linalg.norm(xyz, axis=1, keepdims=True)
    ray = xyz / distance
    across = rng.normal(0, 1, xyz.shape) * noise.lateral * distance
    across -= (across * ray).sum(axis=1, keepdims=True) * ray
    return xyz + rng.normal(0, noise.range, (len(xyz), 1)) * ray + across
