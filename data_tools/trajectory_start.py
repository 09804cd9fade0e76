"""Where the fit of paths begins: points where rays meet, bridges between them, and the rays of single views.

Shapes: T nodes, P rows.
"""

from __future__ import annotations

import numpy as np

from acino_fte.data_tools.trajectory_motion import Pieces
from acino_fte.data_tools.trajectory_rows import Measurements

_MIN_SINE2 = np.sin(np.radians(1.0)) ** 2


def meeting_points(measurements: Measurements, n_nodes: int) -> np.ndarray:
    """Points nearest to the rays of each node (T, 3); NaN without rays that meet at over 1°."""
    origin, direction = measurements.rays()
    across = np.eye(3) - direction[:, :, None] * direction[:, None]
    good = np.isfinite(across).all((-1, -2))
    across = np.where(good[:, None, None], across, 0.0)
    each = np.concatenate([across, across @ origin[..., None]], axis=2)
    total = np.zeros((n_nodes, 3, 4))
    for at, _ in measurements.parts():
        np.add.at(total, measurements.node[at], each[at])
    meet = np.linalg.det(total[..., :3]) > 2 * _MIN_SINE2  # two rays at an angle a: 2 sin² a
    points = np.full((n_nodes, 3), np.nan)
    points[meet] = np.linalg.solve(total[meet][..., :3], total[meet][..., 3:])[..., 0]
    return points


def starting_path(
    measurements: Measurements, pieces: Pieces, points: np.ndarray, used: np.ndarray | None = None
) -> np.ndarray:
    """Where the fit begins, (T, 3): meeting points, bridges between them, on the ray of a single view.

    From a point beside its ray the first Gauss–Newton step goes astray: pixels are not linear in depth.
    """
    path = bridge(points, pieces)
    lone = np.isnan(points[:, 0])[measurements.node]
    if used is not None:
        lone &= used
    if not lone.any():
        return path
    chosen = np.flatnonzero(lone)
    node = measurements.node[chosen]
    origin, direction = measurements.subset(chosen, node).rays()
    depth = ((path[node] - origin) * direction).sum(1)
    on_ray = origin + direction * depth[:, None]
    good = np.isfinite(on_ray).all(1) & (depth > 0)
    path[node[good]] = on_ray[good]
    return path


def bridge(points: np.ndarray, pieces: Pieces) -> np.ndarray:
    """Points (T, 3) with NaN replaced along each piece: linear between neighbours, constant at the ends."""
    known = np.isfinite(points[:, 0])
    index = np.arange(len(points))
    start = np.repeat(pieces.start, pieces.length)
    end = np.repeat(pieces.start + pieces.length - 1, pieces.length)
    before = np.maximum.accumulate(np.where(known, index, -1))
    after = np.minimum.accumulate(np.where(known, index, len(points))[::-1])[::-1]
    left = np.where(before >= start, before, np.where(after <= end, after, 0))
    right = np.where(after <= end, after, left)
    share = np.where(right > left, (index - left) / np.maximum(right - left, 1), 0.0)[:, None]
    return (1 - share) * points[left] + share * points[right]
