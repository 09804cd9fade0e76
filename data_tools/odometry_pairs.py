"""How a camera moved between two pictures: a turn alone, or a turn and the direction of a step.

Points of the first and second picture are normalised coordinates x_1, x_2 (homogeneous below); the pose takes
the first camera's frame to the second's, X_2 = R X_1 + t. Both models are found by sampling, then refined by
robust least squares, whose normal equations give the covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.rotations import rotation_matrix
from acino_fte.extras import load_cv2

LEAST_POINTS = 20
_HYPOTHESES = 300
_ITERATIONS = 12
_CAUCHY = 2.385  # standard deviations; 95 % efficient for Gaussian noise
_OUTLIER = 3.5  # standard deviations


@dataclass(frozen=True, eq=False)
class TwoView:
    """The motion between two pictures.

    Attributes
    ----------
    rotation : (3, 3)
        First camera to second.
    direction : (3,)
        Of t, unit; zeros of a turn alone.
    covariance : (3, 3)
        Of a small turn in the second camera's frame, rad².
    direction_sd : float
        rad, root mean square over its two angles; NaN of a turn alone.
    inliers : (K,) bool
    noise : float
        Standard deviation of a coordinate of a point, normalised.
    residual : (K,)
        Distance from the model over the noise of a coordinate: of a turn over two axes, else over one.
    """

    rotation: np.ndarray
    direction: np.ndarray
    covariance: np.ndarray
    direction_sd: float
    inliers: np.ndarray
    noise: float
    residual: np.ndarray


def turn_between(a: np.ndarray, b: np.ndarray, threshold: float) -> TwoView | None:
    """A turn alone: x_2 ∝ R x_1, as of a camera on a tripod (the homography K R K⁻¹).

    Parameters
    ----------
    a, b : (K, 2)
        Normalised coordinates of matches.
    threshold : float
        Of an inlier while sampling, normalised.

    Returns
    -------
    TwoView or None
        None where no turn has :data:`LEAST_POINTS` inliers.
    """
    if len(a) < LEAST_POINTS:
        return None
    u, v = _rays(a), _rays(b)
    start = _sampled_turn(u, v, b, threshold)

    def residual(change: np.ndarray) -> np.ndarray:
        moved = a_rays @ (rotation_matrix(change[:3]) @ start).T
        return moved[:, :2] / moved[:, 2:] - b_in

    off = u @ start.T
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (np.linalg.norm(off[:, :2] / off[:, 2:] - b, axis=1) < threshold) & (off[:, 2] > 0)
    if near.sum() < LEAST_POINTS:
        return None
    a_rays, b_in = u[near], b[near]
    change, information, scale = _refined(residual, 3)
    rotation = rotation_matrix(change) @ start
    moved = u @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.linalg.norm(moved[:, :2] / moved[:, 2:] - b, axis=1)
    left = np.where(moved[:, 2] > 0, left, np.inf)
    inliers = left < _OUTLIER * scale
    if inliers.sum() < LEAST_POINTS:
        return None
    noise = scale / np.sqrt(2.0)  # both pictures' points are noisy
    covariance = scale**2 * np.linalg.pinv(information)
    return TwoView(rotation, np.zeros(3), covariance, np.nan, inliers, noise, left / scale)


def step_between(a: np.ndarray, b: np.ndarray, threshold: float) -> TwoView | None:
    """A turn and the direction of a step, by the essential matrix [t]× R.

    RANSAC, RANSAC with local optimisation and MAGSAC++ (Barath et al. 2020), all of OpenCV, sample it, since
    each alone now and then ends in a wrong motion. Sampson's distance (Hartley, Zisserman 2004, eq. 11.9) is
    then least over the five parameters with Cauchy's loss, and the best of the three is kept.

    Parameters
    ----------
    a, b, threshold
        As :func:`turn_between`.
    """
    if len(a) < LEAST_POINTS:
        return None
    starts = [
        start
        for way in ("USAC_ACCURATE", "USAC_MAGSAC", "RANSAC")
        if (start := _sampled_step(a, b, threshold, way))
    ]
    found = [view for start in starts if (view := _refined_step(a, b, start)) is not None]
    if not found:
        return None
    least = min(view.noise for view in found)
    return min(found, key=lambda v: float(np.log1p((v.residual * v.noise / least / _CAUCHY) ** 2).sum()))


def _refined_step(
    a: np.ndarray, b: np.ndarray, start: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> TwoView | None:
    """The best turn and step near a start: a turn, a direction, and the inliers (K,) of the two."""
    turn, way, near = start
    across = np.linalg.svd(way[None])[2][1:]  # two directions across t
    u, v = _rays(a), _rays(b)

    def model(change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        direction = rotation_matrix(np.cross(way, change[3:] @ across)) @ way
        return rotation_matrix(change[:3]) @ turn, direction

    for _ in range(2):  # once with the sampled inliers, once with those of the refined model
        used, seen = u[near], v[near]

        def residual(c: np.ndarray, used: np.ndarray = used, seen: np.ndarray = seen) -> np.ndarray:
            return sampson(used, seen, *model(c))[:, None]

        change, information, scale = _refined(residual, 5)
        rotation, direction = model(change)
        left = np.abs(sampson(u, v, rotation, direction))
        near = (left < _OUTLIER * scale) & in_front(u, v, rotation, direction)
        if near.sum() < LEAST_POINTS:
            return None
    covariance = scale**2 * np.linalg.pinv(information)
    spread = float(np.sqrt(0.5 * np.trace(covariance[3:, 3:])))
    return TwoView(rotation, direction, covariance[:3, :3], spread, near, scale, left / scale)


def sampson(u: np.ndarray, v: np.ndarray, rotation: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Sampson's distances (K,), signed, of homogeneous points (K, 3) from their epipolar lines."""
    x, y, z = direction
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    line, back = u @ essential.T, v @ essential
    size = np.sqrt((line[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    return (v * line).sum(1) / np.maximum(size, 1e-12)


def in_front(u: np.ndarray, v: np.ndarray, rotation: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Whether points (K, 3) lie in front of both cameras, or too far to tell."""
    turned = u @ rotation.T
    across = np.cross(v, direction)
    inverse = -(across * np.cross(v, turned)).sum(1) / np.maximum((across**2).sum(1), 1e-18)
    return inverse > -0.02


def _rays(points: np.ndarray) -> np.ndarray:
    return np.column_stack([points, np.ones(len(points))])


def _sampled_turn(u: np.ndarray, v: np.ndarray, b: np.ndarray, threshold: float) -> np.ndarray:
    """The turn of two matches that suits most: a pair of rays makes a frame, the turn is between frames."""
    rng = np.random.default_rng(0)
    pick = rng.integers(0, len(u), (_HYPOTHESES, 2))
    pick = pick[pick[:, 0] != pick[:, 1]]
    frames = [_frame(x[pick[:, 0]], x[pick[:, 1]]) for x in (u, v)]
    turns = frames[1] @ np.swapaxes(frames[0], 1, 2)
    rows = rng.permutation(len(u))[:250]
    moved = np.einsum("hij,kj->hki", turns, u[rows])
    with np.errstate(divide="ignore", invalid="ignore"):
        left = ((moved[..., :2] / moved[..., 2:] - b[rows]) ** 2).sum(-1)
    cost = np.where(
        moved[..., 2] > 0, np.minimum(np.nan_to_num(left, nan=np.inf), threshold**2), threshold**2
    )
    return turns[cost.sum(1).argmin()]


def _frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Frames (H, 3, 3), columns, of pairs of rays (H, 3)."""
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    middle = first + second
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    normal = np.cross(first, second)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.stack([middle, normal, np.cross(middle, normal)], axis=2)


def _sampled_step(
    a: np.ndarray, b: np.ndarray, threshold: float, way: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    cv2 = load_cv2()
    try:
        essential, mask = cv2.findEssentialMat(
            a, b, np.eye(3), method=getattr(cv2, way), prob=0.9999, threshold=threshold
        )
    except cv2.error:
        return None
    if essential is None or essential.shape != (3, 3) or mask is None:
        return None
    near = mask.ravel() > 0
    if near.sum() < LEAST_POINTS:
        return None
    _, rotation, step, _ = cv2.recoverPose(essential, a[near], b[near], np.eye(3))
    if not (np.isfinite(rotation).all() and np.isfinite(step).all()):
        return None
    return rotation, step.ravel() / np.linalg.norm(step), near


def _refined(residual: Callable[[np.ndarray], np.ndarray], size: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Robust least squares of residuals (K, d) over a small change (size,), by iterated weights.

    Returns the change, JᵀWJ (size, size), and the standard deviation of a residual's component (from the
    median).
    """
    change, step = np.zeros(size), 1e-6
    left = residual(change)
    cost = np.inf
    for _ in range(_ITERATIONS):
        distance = np.linalg.norm(left, axis=1)
        scale = max(float(np.median(distance)) * (1.4826 if left.shape[1] == 1 else 0.8493), 1e-9)
        weight = 1.0 / (1.0 + (distance / (_CAUCHY * scale)) ** 2)
        slope = np.stack([(residual(change + step * e) - left) / step for e in np.eye(size)], axis=-1)
        information = np.einsum("k,kdi,kdj->ij", weight, slope, slope)
        gradient = np.einsum("k,kdi,kd->i", weight, slope, left)
        move = -np.linalg.solve(information + 1e-12 * np.trace(information) * np.eye(size), gradient)
        change = change + move
        left = residual(change)
        now = float((np.log1p((np.linalg.norm(left, axis=1) / (_CAUCHY * scale)) ** 2)).sum())
        if abs(cost - now) < 1e-9 * now or np.linalg.norm(move) < 1e-9:
            break
        cost = now
    return change, information, scale


def information_criterion(turn: TwoView | None, step: TwoView | None, n: int) -> tuple[float, float]:
    """GRIC of a turn alone and of a turn with a step; the smaller explains the matches better.

    Σ min(e²/σ², λ_3 (r − d)) + λ_1 d n + λ_2 k with r = 4 coordinates of a match, d = 2 or 3 the dimension of
    what the model admits, k = 3 or 5 parameters, λ_1 = ln r, λ_2 = ln(r n), λ_3 = 2 (Torr 1998, eq. 18). σ is
    the noise under the more general model.
    """
    found = [view for view in (turn, step) if view is not None]
    noise = max(min((view.noise for view in found), default=0.0), 1e-12)
    values = []
    for view, d, k in ((turn, 2, 3), (step, 3, 5)):
        if view is None:
            values.append(np.inf)
            continue
        scale = np.sqrt(2.0) * view.noise if d == 2 else view.noise
        square = (view.residual * scale / noise) ** 2 / (2.0 if d == 2 else 1.0)
        values.append(float(np.minimum(square, 2.0 * (4 - d)).sum() + np.log(4) * d * n + np.log(4 * n) * k))
    return values[0], values[1]
