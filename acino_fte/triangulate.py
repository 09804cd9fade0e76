"""Robust triangulation of markers from all views, batched over frames and markers.

Every pair of views proposes a point (linear triangulation); the proposal with the smallest robust cost over
all views wins (MSAC: Torr and Zisserman 2000); a few IRLS Gauss–Newton steps on the reprojection error
refine it. All views are reduced to ideal pinhole ones first (pixels undistorted, one residual scale a
point), so the inner loops are plain array operations.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.sequence import Sequence

_MAX_PAIRS = 36
_CHUNK = 4096
_MIN_ANGLE = np.radians(1.0)


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Triangulated markers. Shapes: N frames, C cameras, M markers.

    Attributes
    ----------
    points : (N, M, 3)
        World frame, m; NaN where fewer than two views agree.
    inliers : (N, C, M) bool
        Views that agree with the point.
    errors : (N, M)
        Root mean square reprojection error over the inliers, px.
    """

    points: np.ndarray
    inliers: np.ndarray
    errors: np.ndarray


@dataclass
class _Views:
    """Ideal views of K points: normalised coordinates (K, C, 2), focal lengths (C,), poses (K | 1, C, …)."""

    seen: np.ndarray
    observed: np.ndarray
    focal: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray


def triangulate(cameras: CameraArray, pixels: np.ndarray, threshold_px: float = 20.0) -> Triangulation:
    """Triangulate markers seen by two views or more.

    Parameters
    ----------
    cameras : CameraArray
        Fixed or moving.
    pixels : (N, C, M, 2)
        Detections, NaN where missing.
    threshold_px : float
        Residual beyond which a view is an outlier.
    """
    n, c, m, _ = pixels.shape
    observed = cameras.undistort(pixels).transpose(0, 2, 1, 3).reshape(n * m, c, 2)
    seen = np.isfinite(observed).all(-1)
    focal = np.array([0.5 * (camera.parameters[0] + camera.parameters[1]) for camera in cameras])
    moves = any(camera.moves for camera in cameras)
    rotation, translation = cameras.poses(n if moves else 1)
    points = np.full((n * m, 3), np.nan)
    inliers = np.zeros((n * m, c), dtype=bool)
    errors = np.full(n * m, np.nan)
    todo = np.flatnonzero(seen.sum(1) >= 2)
    for start in range(0, len(todo), _CHUNK):
        part = todo[start : start + _CHUNK]
        pose = part // m if moves else slice(None)
        views = _Views(
            seen[part],
            np.where(seen[part, :, None], observed[part], 0.0),
            focal,
            rotation[pose],
            translation[pose],
        )
        points[part], inliers[part], errors[part] = _solve(views, threshold_px)
    return Triangulation(
        points.reshape(n, m, 3), inliers.reshape(n, m, c).transpose(0, 2, 1), errors.reshape(n, m)
    )


def _solve(views: _Views, threshold: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    k, c = views.seen.shape
    best = np.full((k, 3), np.nan)
    best_cost = np.full(k, np.inf)
    for a, b in _pairs(c):
        both = np.flatnonzero(views.seen[:, a] & views.seen[:, b])
        if not len(both):
            continue
        proposal = _from_two_rays(views, both, a, b)
        squared = _squared_residuals(views, both, proposal)
        cost = np.where(views.seen[both], np.minimum(squared, threshold**2), 0.0).sum(1)
        better = cost < best_cost[both]  # NaN proposals never win
        best[both[better]], best_cost[both[better]] = proposal[better], cost[better]
    found = np.flatnonzero(np.isfinite(best_cost))
    for _ in range(4):
        best[found] = _refine(views, found, best[found], threshold)
    squared = np.full((k, c), np.inf)
    squared[found] = _squared_residuals(views, found, best[found])
    inliers = views.seen & (squared < threshold**2)
    count = inliers.sum(1)
    error = np.sqrt(np.where(inliers, squared, 0.0).sum(1) / np.maximum(count, 1))
    good = count >= 2
    return np.where(good[:, None], best, np.nan), inliers & good[:, None], np.where(good, error, np.nan)


def _pairs(n_cameras: int) -> list[tuple[int, int]]:
    """Pairs of views that propose points; an even, fixed choice when there are many."""
    pairs = list(combinations(range(n_cameras), 2))
    if len(pairs) <= _MAX_PAIRS:
        return pairs
    chosen = np.random.default_rng(0).permutation(len(pairs))[: max(_MAX_PAIRS, n_cameras)]
    neighbours = {(i, i + 1) for i in range(n_cameras - 1)}  # so that every view proposes
    return sorted({pairs[i] for i in chosen} | neighbours)


def _pose(views: _Views, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if len(views.rotation) == 1:
        return views.rotation, views.translation
    return views.rotation[rows], views.translation[rows]


def _from_two_rays(views: _Views, rows: np.ndarray, a: int, b: int) -> np.ndarray:
    """Midpoint of the shortest segment between two rays, (K, 3); NaN for nearly parallel rays."""
    rotation, translation = _pose(views, rows)
    centres, rays = [], []
    for c in (a, b):
        centres.append(-np.einsum("kji,kj->ki", rotation[:, c], translation[:, c]))
        local = np.concatenate([views.observed[rows, c], np.ones((len(rows), 1))], axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        if len(rotation) == 1:
            rays.append(local @ rotation[0, c])
        else:
            rays.append(np.einsum("kji,kj->ki", rotation[:, c], local))
    base = centres[1] - centres[0]
    cosine = (rays[0] * rays[1]).sum(1)
    sine2 = np.maximum(1.0 - cosine**2, 1e-16)
    along0, along1 = (rays[0] * base).sum(1), (rays[1] * base).sum(1)
    s = (along0 - cosine * along1) / sine2
    t = (cosine * along0 - along1) / sine2
    middle = 0.5 * (centres[0] + s[:, None] * rays[0] + centres[1] + t[:, None] * rays[1])
    good = (sine2 > np.sin(_MIN_ANGLE) ** 2) & (s > 0) & (t > 0)
    return np.where(good[:, None], middle, np.nan)


def _local(views: _Views, rows: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (K, 3) in every camera's frame, (K, C, 3)."""
    rotation, translation = _pose(views, rows)
    if len(rotation) == 1:
        c = rotation.shape[1]
        return (points @ rotation[0].reshape(-1, 3).T).reshape(-1, c, 3) + translation
    return np.einsum("kcij,kj->kci", rotation, points) + translation


def _squared_residuals(views: _Views, rows: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Squared reprojection residuals in px², (K, C); infinite behind a camera."""
    local = _local(views, rows, points)
    z = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        d = local[..., :2] / z[..., None] - views.observed[rows]
        squared = (d[..., 0] ** 2 + d[..., 1] ** 2) * views.focal**2
    return np.where(z > 0, squared, np.inf)


def _refine(views: _Views, rows: np.ndarray, points: np.ndarray, threshold: float) -> np.ndarray:
    """One Gauss–Newton step with Cauchy weights over the views within reach."""
    local = _local(views, rows, points)
    z = np.where(local[..., 2] > 1e-6, local[..., 2], np.nan)
    a = local[..., :2] / z[..., None]
    residual = (a - views.observed[rows]) * views.focal[:, None]
    squared = (residual**2).sum(-1)
    weight = np.where(views.seen[rows] & (squared < (2 * threshold) ** 2), 1 / (1 + squared / 25.0), 0.0)
    rotation, _ = _pose(views, rows)
    slope = rotation[..., :2, :] - a[..., None] * rotation[..., 2:, :]  # (K, C, 2, 3)
    slope = slope * (views.focal / z)[..., None, None]
    weight, slope = np.where(np.isnan(z), 0.0, weight), np.nan_to_num(slope)
    residual = np.nan_to_num(residual)
    weighted = slope * weight[..., None, None]
    k = len(rows)
    flat, flat_w = slope.reshape(k, -1, 3), weighted.reshape(k, -1, 3)
    normal = flat_w.transpose(0, 2, 1) @ flat
    right = flat_w.transpose(0, 2, 1) @ residual.reshape(k, -1, 1)
    normal += 1e-9 * (1.0 + np.trace(normal, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    return points - np.linalg.solve(normal, right)[..., 0]


def check_any(points: np.ndarray, sequence: Sequence, likelihood: float) -> None:
    """Raise InputError when there is no point at all."""
    if not np.isfinite(points).any():
        raise InputError(
            f"No marker of sequence '{sequence.name}' is seen by two cameras at once with rays that meet.",
            expected=f"likelihood above {likelihood:g} in two of {', '.join(sequence.cameras.names)}",
            remedy="lower --likelihood, choose other frames, or check that each keypoint file belongs to "
            "its camera",
        )
