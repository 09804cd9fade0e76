"""Triangulates all points of a scene at once: robust, least squares in pixels, with covariances.

Without outliers the steps are: the point nearest to all rays; two Gauss–Newton steps on the reprojection
error; and one more with the weights that the errors of the poses demand (:mod:`scene_noise`). Points whose
dots contradict each other are decided by consensus: every pair of views proposes a point, the one with the
smallest truncated cost (MSAC: Torr and Zisserman 2000) tells which dots are wrong; where two views alone
contradict each other nothing is decided. Without a rig, dots may disagree as much as the errors of their
poses let expect. Shapes: P dots, T points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.scene_noise import (
    NOISE_FLOOR,
    PointInformation,
    SceneNoise,
    determinant_3x3,
    inverse_3x3,
    median_of_chi2,
    sum_of_each,
)
from acino_fte.data_tools.scene_rows import SceneRows, Views

_STEPS = 2
_GATE = 25.0  # squared distance of a dot in consensus, in its variance
_MISFIT = {1: 15.1, 2: 18.4, 3: 21.1}  # 1e-4 quantiles of χ², for the degrees of freedom of a few views
_PARALLEL = 1e-7  # squared sine of the angle between rays that do not meet
_PAIRS = 45


@dataclass(frozen=True, eq=False)
class PointFit:
    """Triangulated points.

    Attributes
    ----------
    position : (T, 3)
        NaN where fewer than two views agree.
    covariance : (T, 3, 3)
        Pixels and poses.
    used : (P,) bool
        Dots that count.
    noise : SceneNoise
        Of the dots and the poses.
    """

    position: np.ndarray
    covariance: np.ndarray
    used: np.ndarray
    noise: SceneNoise


def triangulate_points(rows: SceneRows, views: Views, noise_px: float | None = None) -> PointFit:
    """Triangulate every point that two views see.

    Parameters
    ----------
    rows : SceneRows
        The dots.
    views : Views
        The cameras they belong to.
    noise_px : float, optional
        Standard deviation of a dot's coordinate; by default it is estimated from the residuals of all points.

    Returns
    -------
    PointFit
        The points.
    """
    used = np.bincount(rows.point, minlength=rows.n_points)[rows.point] >= 2
    first, every = refine(rows, nearest_points(rows, used), used), used
    total = np.full(rows.n_points, max(_typical(rows, first, every), (noise_px or 0.0) ** 2))
    used, position = _consensus(rows, first, every, total)
    information = PointInformation(rows, views, position, used)
    noise = information.estimate_noise(noise_px)
    if len(views.bases) > 1:  # poses err more between key frames, and dots may disagree more there
        expected = PointInformation(rows, views, first, every).expected_variance(noise)
        used, position = _consensus(rows, first, every, np.fmax(total, expected))
        information = PointInformation(rows, views, position, used)
    position, covariance = information.solve(noise)
    return PointFit(position, covariance, used & np.isfinite(position[rows.point, 0]), noise)


def retriangulate(rows: SceneRows, views: Views, fit: PointFit, used: np.ndarray) -> PointFit:
    """The same with other dots (P,) that count."""
    used = used & (np.bincount(rows.point[used], minlength=rows.n_points)[rows.point] >= 2)
    changed = np.bincount(rows.point[used != fit.used], minlength=rows.n_points) > 0
    if not changed.any():
        return fit
    some, dots = rows.of_points(changed)
    found = refine(some, nearest_points(some, used[dots]), used[dots])
    position, covariance = fit.position.copy(), fit.covariance.copy()
    information = PointInformation(some, views, found, used[dots])
    position[changed], covariance[changed] = information.solve(fit.noise)
    return PointFit(position, covariance, used & np.isfinite(position[rows.point, 0]), fit.noise)


def nearest_points(rows: SceneRows, used: np.ndarray) -> np.ndarray:
    """Points (T, 3) nearest to all rays, NaN without two that meet in front of their cameras."""
    dots = np.flatnonzero(used)
    origin, direction = rows.measured.subset(dots, rows.point[dots]).rays()
    return _nearest(origin, direction, rows.point[dots], rows.n_points)


def _nearest(origin: np.ndarray, direction: np.ndarray, point: np.ndarray, n_points: int) -> np.ndarray:
    across = np.eye(3) - direction[:, :, None] * direction[:, None]
    weight = np.ones(len(point))
    position = np.full((n_points, 3), np.nan)
    count = np.bincount(point, minlength=n_points)
    for _ in range(2):  # first by distance, then by angle
        each = weight[:, None, None] * np.concatenate([across, across @ origin[..., None]], axis=2)
        total = sum_of_each(each, point, n_points)
        scale = np.trace(total[..., :3], axis1=1, axis2=2) / 3.0
        met = (count >= 2) & (determinant_3x3(total[..., :3]) > _PARALLEL * scale**3) & (scale > 0)
        position[:] = np.nan
        position[met] = (inverse_3x3(total[met][..., :3]) @ total[met][..., 3:])[..., 0]
        ahead = ((position[point] - origin) * direction).sum(1)
        weight = np.where(ahead > 0, 1.0 / np.maximum(ahead, 1e-12) ** 2, 0.0)
    return position


def refine(rows: SceneRows, position: np.ndarray, used: np.ndarray, steps: int = _STEPS) -> np.ndarray:
    """Gauss–Newton steps on the reprojection error; a point that comes behind a camera is lost."""
    for _ in range(steps):
        residual, slope = rows.measured.linearise(position)
        good = used & np.isfinite(residual).all(1) & np.isfinite(slope).all((1, 2))
        information, gradient = rows.measured.information(residual, slope, good, rows.n_points)
        seen = np.bincount(rows.point[good], minlength=rows.n_points) >= 2
        position = np.where(seen[:, None], position + _solve(information, gradient), np.nan)
    return position


def _solve(information: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Steps (T, 3); NaN where the information is singular."""
    scale = np.trace(information, axis1=1, axis2=2) / 3.0
    with np.errstate(invalid="ignore"):
        firm = determinant_3x3(information) > 1e-12 * scale**3
    step = np.full(gradient.shape, np.nan)
    step[firm] = (inverse_3x3(information[firm]) @ gradient[firm][..., None])[..., 0]
    return step


def _misfit(rows: SceneRows, position: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum of squared residuals of each point (T,), px², and its degrees of freedom (T,)."""
    residual, _ = rows.measured.linearise(position)
    squared = np.where(used, (residual**2).sum(1), 0.0)
    total = np.bincount(rows.point, np.nan_to_num(squared, nan=np.inf), rows.n_points)
    freedom = 2 * np.bincount(rows.point[used], minlength=rows.n_points) - 3
    return np.where(np.isfinite(position[:, 0]), total, np.nan), freedom


def _typical(rows: SceneRows, position: np.ndarray, used: np.ndarray) -> float:
    """Variance of a residual coordinate that the median point has, px²."""
    misfit, freedom = _misfit(rows, position, used)
    good = np.isfinite(misfit) & (freedom > 0)
    if not good.any():
        return 1.0
    ratio = misfit[good] / (freedom[good] * median_of_chi2(freedom[good]))
    return max(float(np.median(ratio)), NOISE_FLOOR**2)


def _limit(freedom: np.ndarray) -> np.ndarray:
    """Above this χ² is improbable (1e-4)."""
    spread = 2.0 / (9.0 * np.maximum(freedom, 1))
    general = np.maximum(freedom, 1) * (1.0 - spread + 3.719 * np.sqrt(spread)) ** 3
    for count, value in _MISFIT.items():
        general = np.where(freedom == count, value, general)
    return general


def _consensus(
    rows: SceneRows, position: np.ndarray, used: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Dots (P,) that count, and points, after every contradiction was decided or given up.

    `variance` (T,) is that of a residual coordinate of each point, px².
    """
    misfit, freedom = _misfit(rows, position, used)
    with np.errstate(invalid="ignore"):
        doubtful = (freedom > 0) & ~(misfit <= variance * _limit(freedom))
    if not doubtful.any():
        return used, position
    some, dots = rows.of_points(doubtful)
    variance = variance[doubtful]
    right = np.zeros(len(dots), dtype=bool)
    count = np.bincount(some.point, minlength=some.n_points)
    order = np.argsort(some.point, kind="stable")
    for n in np.unique(count[count > 2]):
        block = order[np.repeat(count == n, count)].reshape(-1, n)
        right[block] = _vote(some, block, variance[some.point[block[:, 0]], None])
    right &= np.bincount(some.point[right], minlength=some.n_points)[some.point] >= 2
    found = refine(some, nearest_points(some, right), right)
    found[~_agreed(some, found, right, variance)] = np.nan
    position, used = position.copy(), used.copy()
    position[doubtful] = found
    used[dots] = right & np.isfinite(found[some.point, 0])
    return used, position


def _agreed(rows: SceneRows, position: np.ndarray, used: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Points (T,) that each of their dots is near; two views alone have to meet.

    A point that all views see somewhat worse than others is still a point.
    """
    misfit, freedom = _misfit(rows, position, used)
    residual, _ = rows.measured.linearise(position)
    far = used & ~((residual**2).sum(1) < _GATE * variance[rows.point])
    near = np.bincount(rows.point[far], minlength=rows.n_points) == 0
    with np.errstate(invalid="ignore"):
        return np.where(freedom > 1, near, misfit <= variance * _limit(freedom)) & np.isfinite(misfit)


def _vote(rows: SceneRows, block: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Dots (K, n) of K points with n views each that agree with the best pair's proposal."""
    k, n = block.shape
    pairs = [(i, j) for i in range(n) for j in range(i)]
    if len(pairs) > _PAIRS:
        pairs = [pairs[i] for i in np.random.default_rng(0).choice(len(pairs), _PAIRS, replace=False)]
    origin, direction = _rays(rows, block)
    best, inlier = np.full(k, np.inf), np.zeros((k, n), dtype=bool)
    for i, j in pairs:
        owner, two = np.repeat(np.arange(k), 2), [i, j]
        proposal = _nearest(origin[:, two].reshape(-1, 3), direction[:, two].reshape(-1, 3), owner, k)
        squared = _squared(rows, block, proposal)
        cost = np.minimum(np.nan_to_num(squared / variance, nan=np.inf), _GATE).sum(1)
        better = cost < best
        best[better] = cost[better]
        inlier[better] = (squared < _GATE * variance)[better]
    inlier &= (inlier.sum(1) >= 2)[:, None]
    return inlier


def _rays(rows: SceneRows, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (K, n, 3) of a block of dots (K, n)."""
    flat = block.ravel()
    order = np.argsort(flat, kind="stable")
    back = np.argsort(order, kind="stable")
    origin, direction = rows.measured.subset(flat[order], rows.point[flat[order]]).rays()
    return origin[back].reshape(*block.shape, 3), direction[back].reshape(*block.shape, 3)


def _squared(rows: SceneRows, block: np.ndarray, proposal: np.ndarray) -> np.ndarray:
    """Squared residuals (K, n) of dots for proposed points (K, 3), px²."""
    flat = block.ravel()
    order = np.argsort(flat, kind="stable")
    owner = np.repeat(np.arange(len(block)), block.shape[1])[order]
    residual, _ = rows.measured.subset(flat[order], owner).linearise(proposal)
    out = np.empty(len(flat))
    out[order] = (residual**2).sum(1)
    return out.reshape(block.shape)
