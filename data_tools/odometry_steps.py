"""How long the steps of a moving camera are beside each other, by depths carried from frame to frame.

One camera sees directions only, so the first step is the unit. Points seen over it get a depth; seen again,
they tell how long the next step was. Depths are kept as inverse depths with their variance, so far points do
no harm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.odometry_pairs import TwoView

_LEAST = 8  # points with a depth
_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class Depths:
    """Inverse depths (K,) of a frame's features, per unit, and their variances; inf: not known."""

    inverse: np.ndarray
    variance: np.ndarray

    @classmethod
    def unknown(cls, n: int) -> Depths:
        """Of n features that nothing is known of."""
        return cls(np.zeros(n), np.full(n, np.inf))


def step_length(view: TwoView, a: np.ndarray, b: np.ndarray, depths: Depths) -> tuple[float, float] | None:
    """Length of a step, and its standard deviation, from points with a depth; None with too few.

    For X_1 = x_1/ρ the second picture sees R x_1 + s ρ t. Robust least squares over s, from the weighted
    median of what each point says.

    Parameters
    ----------
    view : TwoView
        With a direction.
    a, b : (K, 2)
        Normalised coordinates of its matches.
    depths : Depths
        (K,) of the same matches, in the first camera.
    """
    sure = view.inliers & (depths.inverse > 0) & (depths.variance < (0.3 * depths.inverse) ** 2)
    if sure.sum() < _LEAST:
        return None
    turned = np.column_stack([a[sure], np.ones(sure.sum())]) @ view.rotation.T
    way = depths.inverse[sure, None] * view.direction
    seen = np.column_stack([b[sure], np.ones(sure.sum())])
    pull, rest = np.cross(seen, way), np.cross(seen, turned)
    each = -(pull * rest).sum(1) / np.maximum((pull**2).sum(1), 1e-18)
    length = _weighted_median(each, np.linalg.norm(pull, axis=1))
    for _ in range(_ROUNDS):
        place = turned + length * way
        left = place[:, :2] / place[:, 2:] - b[sure]
        slope = (way[:, :2] - way[:, 2:] * place[:, :2] / place[:, 2:]) / place[:, 2:]
        along = length * slope / depths.inverse[sure, None] * np.sqrt(depths.variance[sure, None])
        variance = 2.0 * view.noise**2 + (along**2).sum(1)
        distance = (left**2).sum(1) / variance
        weight = 1.0 / (1.0 + distance / 5.7) / variance
        information = float((weight * (slope**2).sum(1)).sum())
        move = -float((weight * (slope * left).sum(1)).sum()) / max(information, 1e-18)
        length += move
        if abs(move) < 1e-9 * max(abs(length), 1e-9):
            break
    return length, float(np.sqrt(1.0 / max(information, 1e-18)))


def carried_depths(
    view: TwoView, length: float, a: np.ndarray, b: np.ndarray, depths: Depths
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depths (K,) in the second camera, and variances, from those in the first and from the step.

    What the step shows of each point, ρ = −(x_2 × s t)·(x_2 × R x_1)/|x_2 × s t|², is weighed with what was
    known.
    """
    turned = np.column_stack([a, np.ones(len(a))]) @ view.rotation.T
    step = length * view.direction
    seen = np.column_stack([b, np.ones(len(b))])
    pull = np.cross(seen, step)
    size = np.maximum((pull**2).sum(1), 1e-18)
    shown = -(pull * np.cross(seen, turned)).sum(1) / size
    precision_new = size / (2.0 * view.noise**2) if length > 0 else np.zeros(len(a))
    precision_old = 1.0 / depths.variance
    total = np.maximum(precision_new + precision_old, 1e-18)
    inverse = (precision_new * shown + precision_old * depths.inverse) / total
    depth = turned[:, 2] + inverse * step[2]
    good = view.inliers & (depth > 1e-6) & (inverse > -3.0 / np.sqrt(total))
    moved = np.where(good, inverse / np.where(good, depth, 1.0), 0.0)
    slope = turned[:, 2] / np.where(good, depth, 1.0) ** 2
    return moved, np.where(good, slope**2 / total, np.inf)


def _weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])
