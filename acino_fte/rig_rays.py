"""Where rays meet simple bodies, in closed form. K rays: origins (K, 3) and unit directions (K, 3), m.

All give the distance to where the ray enters the body, infinity where it misses it.
"""

from __future__ import annotations

import numpy as np

_PARALLEL = 1e-12


def ray_capsules(
    origin: np.ndarray, direction: np.ndarray, start: np.ndarray, end: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """Distances (K, E) to capsules whose axes run from `start` to `end` (K, E, 3), of `radius` (E,).

    The nearer root of the quadratic of the infinite cylinder where it lies between the ends of the axis, else
    that of the sphere about the nearer end (both follow from |o + t d − a − s (b − a)| = r).
    """
    axis, offset = end - start, origin[:, None] - start
    length = _dot(axis, axis)
    along = _dot(axis, direction[:, None])
    behind = _dot(axis, offset)
    a = length - along**2
    b = length * _dot(offset, direction[:, None]) - behind * along
    c = length * _dot(offset, offset) - behind**2 - radius**2 * length
    root = b**2 - a * c
    tilted = a > _PARALLEL * np.maximum(length, _PARALLEL)
    with np.errstate(invalid="ignore"):
        side = np.where(tilted & (root >= 0), (-b - np.sqrt(root)) / np.where(tilted, a, 1.0), np.inf)
        place = behind + np.where(np.isfinite(side), side, 0.0) * along
    on_side = np.isfinite(side) & (place >= 0) & (place <= length) & (side >= 0)
    caps = np.minimum(
        ray_spheres(origin, direction, start, radius), ray_spheres(origin, direction, end, radius)
    )
    return np.where(on_side, side, caps)


def ray_spheres(
    origin: np.ndarray, direction: np.ndarray, centre: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """Distances (K, B) to spheres about `centre` (B, 3) or (K, B, 3), of `radius` (B,)."""
    if centre.ndim == 2:  # the same spheres for all rays: products of matrices
        ahead = direction @ centre.T - _dot(origin, direction)[:, None]
        squared = _dot(origin, origin)[:, None] - 2 * origin @ centre.T + (_dot(centre, centre) - radius**2)
    else:
        offset = origin[:, None] - centre
        ahead, squared = -_dot(offset, direction[:, None]), _dot(offset, offset) - radius**2
    root = ahead * ahead
    root -= squared
    near = np.full(root.shape, np.inf)
    met = root >= 0
    near[met] = ahead[met] - np.sqrt(root[met])
    near[near < 0] = np.inf
    return near


def ray_level(origin: np.ndarray, direction: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Distances (K,) to the level plane at a `height` (K,) of each ray's own."""
    down = direction[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (height - origin[:, 2]) / down
    return np.where((down < 0) & (distance >= 0), distance, np.inf)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)
