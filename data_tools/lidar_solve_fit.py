"""Robust least squares of camera and lidar from pairs, by Levenberg and Marquardt, from one start.

P pairs, D parameters. The noise of the picks is known in its proportions, not in its size: its scale is found
from the pairs themselves, by the median first and from all that are no outliers at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.lidar_solve_model import (
    PickNoise,
    Priors,
    moved,
    pick_covariance,
    projection,
    whitening,
)

CAUCHY = 2.4
"""Where Cauchy's weight is a half, in units of the noise: 95 % efficient for Gaussian errors."""
OUTLIER = 4.685**2
"""Squared distance beyond which a pair is an outlier, in units of the noise: Tukey's constant, squared."""
_WHOLE = 13.8
"""Squared distance up to which a pair counts in full, in units of the assumed noise: 99.9 % of χ² of 2."""
_MEDIAN = 1.386  # of χ² with 2 degrees of freedom
_LEAST = 0.03  # of the scale: nobody picks better than so many of the assumed standard deviations
_PRIOR_PAIRS = 2.0  # how many pairs the assumed size of the noise counts for
_ROUGH, _NEAR = 0.1, 1e-5  # steps, in standard deviations of the parameters, that end a search
_FAR = 1e6  # squared distance of a pair that the camera cannot see


@dataclass(frozen=True, eq=False)
class Fit:
    """The least squares at one camera.

    Attributes
    ----------
    camera : Camera
    names : tuple of str
        Of the parameters.
    residual : (P, 2)
        Projection minus pick, px; NaN where the camera cannot see the point.
    slope : (P, 2, D)
        Derivative of the residual, px.
    whiten : (P, 2, 2)
        To units of the assumed noise.
    priors : Priors
    weight : (P,)
        0 for pairs that are not used or are outliers.
    scale : float
        Size of the noise, compared to what was assumed.
    converged : bool
    """

    camera: Camera
    names: tuple[str, ...]
    residual: np.ndarray
    slope: np.ndarray
    whiten: np.ndarray
    priors: Priors
    weight: np.ndarray
    scale: float = 1.0
    converged: bool = True

    @cached_property
    def error(self) -> np.ndarray:
        """Residual (P, 2) in units of the assumed noise; 0 where the camera cannot see the point."""
        return _times(self.whiten, np.nan_to_num(self.residual))

    @cached_property
    def white(self) -> np.ndarray:
        """Slope (P, 2, D) in units of the assumed noise; 0 where the camera cannot see the point."""
        return self.whiten @ np.nan_to_num(self.slope)

    @cached_property
    def squared(self) -> np.ndarray:
        """Squared distances (P,) in units of the assumed noise."""
        return _squared(self.error, self.residual)

    @property
    def information(self) -> np.ndarray:
        """Normal matrix (D, D): pairs by weight and scale, and what was known before."""
        known = self.priors.terms(self.camera, self.names)[1]
        return _normal(self.white, self.weight / self.scale**2) + np.diag(known**2)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (D, D) of the parameters."""
        return inverse(self.information)


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric positive matrix whose rows have units of very different size."""
    size = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.linalg.pinv(matrix * np.outer(size, size), rcond=1e-14, hermitian=True) * np.outer(size, size)


def at(
    camera: Camera,
    names: tuple[str, ...],
    pixel: np.ndarray,
    xyz: np.ndarray,
    noise: PickNoise,
    priors: Priors,
) -> Fit:
    """The least squares at a camera, all pairs with weight 1."""
    found, slope, for_point = projection(camera, xyz, names)
    whiten = whitening(pick_covariance(for_point, xyz, noise))
    residual = np.where(whiten.any(axis=2), found - pixel, np.nan)  # beside the camera it is not seen either
    return Fit(camera, names, residual, slope, whiten, priors, np.ones(len(pixel)))


def robust_fit(
    camera: Camera,
    names: tuple[str, ...],
    pixel: np.ndarray,
    xyz: np.ndarray,
    noise: PickNoise,
    priors: Priors,
    *,
    rough: bool = False,
) -> Fit:
    """The robust least squares from a start: Cauchy's loss with the scale of the median.

    `rough`: only as far as it takes to tell good starts from bad ones.
    """
    problem = (names, pixel, xyz, noise, priors)
    fit = at(camera, *problem)
    scale = median_scale(fit.squared, len(names))
    for _ in range(4 if rough else 12):
        steps, near = (10, _ROUGH) if rough else (60, _NEAR)
        fit = _descend(fit, problem, partial(_cauchy, scale=scale), scale, steps, near)
        last, scale = scale, median_scale(fit.squared, len(names))
        if abs(scale - last) < 0.03 * last:
            break
    return replace(fit, weight=_cauchy(fit.squared, scale), scale=scale)


def polished(
    camera: Camera,
    names: tuple[str, ...],
    pixel: np.ndarray,
    xyz: np.ndarray,
    noise: PickNoise,
    priors: Priors,
    scale: float,
) -> Fit:
    """The least squares with a redescending weight: pairs far off do not count at all, near ones in full.

    Tukey's biweight (Beaton and Tukey 1974) with its scale found together with the parameters, but flat in
    the middle (as Hampel's, Hampel et al. 1986, section 2.6): where picks are as good as assumed, it is least
    squares, and a dozen pairs do not lose the tenth of what they tell that the biweight costs. Where they are
    worse, their errors are not the assumed ones, and the biweight is what is left.
    """
    problem = (names, pixel, xyz, noise, priors)
    fit = at(camera, *problem)
    for _ in range(20):
        weigh = partial(_redescending, scale=scale, n_parameters=len(names))
        fit = _descend(fit, problem, weigh, scale, 60, _NEAR)
        last, scale = scale, final_scale(fit.squared, fit.weight > 0, len(names))
        if abs(scale - last) < 0.003 * last:
            break
    return replace(fit, weight=_redescending(fit.squared, scale, len(names)), scale=scale)


def _cauchy(squared: np.ndarray, scale: float) -> np.ndarray:
    """Weights (P,): 1 / (1 + d²/c²)."""
    return 1.0 / (1.0 + squared / (CAUCHY * scale) ** 2)


def _redescending(squared: np.ndarray, scale: float, n_parameters: int) -> np.ndarray:
    """Weights (P,): 1 where the assumed noise reaches, from there to 0 as (1 − d²/c²)².

    0 where the camera cannot see the point. Else never 0 for more than half of the pairs, nor for so many
    that fewer are left than unknowns ask for.
    """
    least = min(len(squared), max((len(squared) + 1) // 2, (n_parameters + 1) // 2 + 1))
    limit = max(OUTLIER * scale**2, 1.5 * float(np.partition(squared, least - 1)[least - 1]))
    whole = _WHOLE * min(scale, 1.0) ** 2
    weight = np.clip((limit - squared) / (limit - whole), 0.0, 1.0) ** 2
    return np.where(squared < _FAR, weight, 0.0)


def median_scale(squared: np.ndarray, n_parameters: int) -> float:
    """Size of the noise from the median of the squared distances (P,)."""
    n = len(squared)
    lost = n / max(n - 0.5 * n_parameters, 0.25 * n)
    return float(max(np.sqrt(np.median(squared) / _MEDIAN * lost), _LEAST))


def final_scale(squared: np.ndarray, kept: np.ndarray, n_parameters: int) -> float:
    """Size of the noise from the pairs that are kept (P,); what was assumed counts for two pairs."""
    free = max(2.0 * kept.sum() - n_parameters, 0.0)
    total = squared[kept].sum() + 2.0 * _PRIOR_PAIRS
    return float(max(np.sqrt(total / (free + 2.0 * _PRIOR_PAIRS)), _LEAST))


def _descend(
    fit: Fit,
    problem: tuple,
    weigh: Callable[[np.ndarray], np.ndarray],
    scale: float,
    n_steps: int,
    near: float,
) -> Fit:
    """Levenberg and Marquardt with weights from squared distances; the noise's shape follows the camera."""
    damping, converged = 1e-4, False
    for _ in range(n_steps):
        off, known = fit.priors.terms(fit.camera, fit.names)
        by_pair = weigh(fit.squared) / scale**2
        gradient = np.tensordot(by_pair[:, None] * fit.error, fit.white, 2) + known * off
        matrix = _normal(fit.white, by_pair) + np.diag(known**2)
        cost = by_pair @ fit.squared + off @ off
        fit_new, step_size = None, np.inf
        while damping < 1e12:
            step = -_solve(matrix + damping * np.diag(np.diag(matrix) + 1e-12), gradient)
            trial = _trial(fit, problem, step)
            if trial is not None:
                ahead = trial.priors.terms(trial.camera, trial.names)[0]
                squared = _squared(_times(fit.whiten, np.nan_to_num(trial.residual)), trial.residual)
                if cost - by_pair @ squared - ahead @ ahead >= -1e-12 * cost:
                    fit_new, step_size = trial, float(np.sqrt(np.abs(step @ matrix @ step)))
                    break
            damping *= 10.0
        if fit_new is None:
            break
        fit, damping = fit_new, max(damping * 0.1, 1e-12)
        if step_size < near:
            converged = True
            break
    return replace(fit, weight=weigh(fit.squared), scale=scale, converged=converged)


def _normal(white: np.ndarray, by_pair: np.ndarray) -> np.ndarray:
    """Σ w AᵀA (D, D) of slopes (P, 2, D) and weights (P,)."""
    rows = white.reshape(-1, white.shape[-1])
    return rows.T @ (np.repeat(by_pair, 2)[:, None] * rows)


def _times(whiten: np.ndarray, residual: np.ndarray) -> np.ndarray:
    return np.einsum("pij,pj->pi", whiten, residual)


def _squared(error: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Squared lengths (P,) of errors (P, 2), very large where the residual is no number."""
    return np.where(np.isfinite(residual).all(axis=1), (error**2).sum(axis=1), _FAR)


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solution of a symmetric system whose rows have units of very different size."""
    size = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return size * np.linalg.lstsq(matrix * np.outer(size, size), size * right, rcond=1e-15)[0]


def _trial(fit: Fit, problem: tuple, step: np.ndarray) -> Fit | None:
    """The least squares after a step; None where that is no camera."""
    if not np.isfinite(step).all() or np.abs(step[:3]).max() > 1.0:
        return None
    for name, change in zip(fit.names, step, strict=True):
        if name.startswith("log_") and abs(change) > 1.0:
            return None
    return at(moved(fit.camera, fit.names, step), *problem)
