"""What the residuals of one camera say of its time and its pose: a robust regression.

The residual of a detection has a signature. A camera that is late by τ sees markers ahead along their own
image velocity ẋ; in a camera that moved, all are displaced alike. Both are estimated together,

    observed − predicted = τ·ẋ + (du, dv) + noise,

with Cauchy's weights (IRLS; Holland and Welsch 1977). Detections of neighbouring frames share their errors,
and so do those of one marker (which the species file puts in a wrong place): the covariance is that of a
sandwich with clusters of both kinds (Cameron, Gelbach and Miller 2011, eq. 2.11, without the term it
subtracts, which errs on the safe side).

Shapes: N frames, M markers, K detections. An *effect* (3,) is τ (s), du, dv (px).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

PARTS = {"delay": slice(0, 1), "moved": slice(1, 3)}  # of an effect
_REACH = 0.02  # s, on both sides of a frame, over which a velocity is taken
_LEAST = 40  # detections of a regression
_BLOCKS = 12  # of consecutive frames, which share their errors
_CAUCHY = 2.385  # 95 % efficient (Holland and Welsch 1977)
_STEPS, _LENGTHS = 40, 5  # of the regression; the first of them minimise a sum of lengths
_ENOUGH = 0.01  # px, a step that ends it


@dataclass(frozen=True, eq=False)
class View:
    """Detections of one camera in the order of frames.

    Attributes
    ----------
    frame, marker : (K,) int
        Row of the frame, and marker.
    residual : (K, 2)
        Observed − predicted, px.
    velocity : (K, 2)
        Of the prediction, px/s.
    sd : (K,)
        Standard deviation of the detection, px.
    """

    frame: np.ndarray
    marker: np.ndarray
    residual: np.ndarray
    velocity: np.ndarray
    sd: np.ndarray

    @classmethod
    def of(cls, observed: np.ndarray, predicted: np.ndarray, fps: float, sd_px: np.ndarray) -> View:
        """From pixels (N, M, 2) and standard deviations (M,), px."""
        velocity = _slope(predicted, max(1, round(_REACH * fps))) * fps
        residual = observed - predicted
        frame, marker = np.nonzero(np.isfinite(residual).all(-1) & np.isfinite(velocity).all(-1))
        at = frame, marker
        return cls(frame, marker, residual[at], velocity[at], np.asarray(sd_px, dtype=float)[marker])

    def __len__(self) -> int:
        return len(self.sd)

    def between(self, start: int, stop: int) -> View:
        """Detections in the rows start ≤ row < stop."""
        part = slice(*np.searchsorted(self.frame, [start, stop]).tolist())
        return View(*(getattr(self, name)[part] for name in self.__dataclass_fields__))

    def without(self, effect: np.ndarray, start: int, stop: int) -> View:
        """The same with an effect (3,) taken from the residuals in some rows."""
        inside = ((self.frame >= start) & (self.frame < stop))[:, None]
        return replace(self, residual=self.residual - np.where(inside, self.design @ effect, 0.0))

    @property
    def design(self) -> np.ndarray:
        """(K, 2, 3): the residual for a unit of each part of an effect."""
        return np.concatenate([self.velocity[..., None], np.broadcast_to(np.eye(2), (len(self), 2, 2))], -1)

    def unexplained(self, effect: np.ndarray) -> np.ndarray:
        """Residuals (K, 2) beside an effect (3,), in standard deviations."""
        return (self.residual - self.design @ effect) / self.sd[:, None]

    def gain(self, effect: np.ndarray, over: np.ndarray) -> np.ndarray:
        """Gain (K,) in log-likelihood (Cauchy's loss) by an effect (3,) over another."""
        costs = [
            _CAUCHY**2 / 2 * np.log1p((self.unexplained(x) ** 2).sum(-1) / _CAUCHY**2) for x in (over, effect)
        ]
        return costs[0] - costs[1]


def _slope(pixels: np.ndarray, reach: int) -> np.ndarray:
    """Change per frame (N, M, 2): of a line through up to ``reach`` frames on both sides, NaN where unknown.

    Σ k (x[n+k] − x[n−k]) / 2Σ k² over the pairs of known frames (Savitzky and Golay 1964). The frame itself
    has no weight: its noise, which the residual has too, must not correlate with its velocity.
    """
    rise, weight = np.zeros_like(pixels), np.zeros(pixels.shape)
    for k in range(1, min(reach, (len(pixels) - 1) // 2) + 1):
        step = pixels[2 * k :] - pixels[: -2 * k]
        known = np.isfinite(step)
        rise[k:-k] += np.where(known, k * step, 0.0)
        weight[k:-k] += np.where(known, 2 * k**2, 0.0)
    with np.errstate(invalid="ignore"):
        slope = rise / weight
    if len(slope) > 2:
        slope[0], slope[-1] = slope[1], slope[-2]
    return slope


@dataclass(frozen=True, eq=False)
class Estimate:
    """An effect (3,) and its covariance (3, 3)."""

    effect: np.ndarray
    covariance: np.ndarray


def estimate(view: View) -> Estimate | None:
    """Effect on some detections; None when there are fewer than 40, or of fewer than 3 frames or markers."""
    n_frames, n_markers = len(np.unique(view.frame)), len(np.unique(view.marker))
    if len(view) < _LEAST or n_frames < 3 or n_markers < 3:
        return None
    effect, weight, slope = regress(view)
    design = view.design / view.sd[:, None, None]
    normal = _squares(design, weight) * slope
    score = (design * (weight[:, None] * view.unexplained(effect))[..., None]).sum(1)
    first, last = view.frame[0], view.frame[-1] + 1
    block = (view.frame - first) * min(_BLOCKS, n_frames) // (last - first)
    spread = clustered(score, block) + clustered(score, view.marker)
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    return Estimate(effect, inverse @ spread @ inverse)


def _squares(design: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Σ w XᵀX (3, 3) of (K, 2, 3) and (K,)."""
    return (design * weight[:, None, None]).reshape(-1, 3).T @ design.reshape(-1, 3)


def regress(view: View, part: slice | None = None) -> tuple[np.ndarray, np.ndarray, float]:
    """Robust regression with all parts of an effect or one.

    Returns
    -------
    (3,), (K,), float
        Effect; weights ψ/e; and mean ψ′ over mean ψ/e, by which the normal matrix is to be multiplied. The
        first steps minimise the sum of lengths, from which the scale of the rest is found.
    """
    unit = np.array([max(1e-9, float(np.sqrt(np.mean(view.velocity**2)))), 1.0, 1.0])
    used = np.zeros(3)
    used[part or slice(None)] = 1.0
    design = view.design / view.sd[:, None, None] / unit * used
    target = view.residual / view.sd[:, None]
    effect = np.zeros(3)
    for step in range(_STEPS):
        size = np.sqrt(((target - design @ effect) ** 2).sum(-1) / 2)
        scale = max(1.0, float(np.median(size)) / np.sqrt(np.log(2)))  # √ln 2: its median for normal noise
        e = size / (_CAUCHY * scale)
        weight = 1 / np.maximum(size, 0.1 * scale) if step < _LENGTHS else 1 / (1 + e**2)
        normal = _squares(design, weight)
        before = effect
        right = (target * weight[:, None]).ravel() @ design.reshape(-1, 3)
        effect = np.linalg.solve(normal + 1e-9 * (1 + np.trace(normal)) * np.eye(3), right)
        if step > _LENGTHS and np.abs(effect - before).max() < _ENOUGH:
            break
    slope = float(np.mean((1 - e**2) / (1 + e**2) ** 2) / np.mean(weight))
    return effect / unit, weight, max(slope, 0.3)


def clustered(score: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Σ s sᵀ (P, P) over the clusters, s being a cluster's sum of scores (K, P)."""
    _, place = np.unique(label, return_inverse=True)
    count = int(place.max()) + 1
    sums = np.stack([np.bincount(place, column, minlength=count) for column in score.T], axis=1)
    return sums.T @ sums * (count / max(1, count - 1))
