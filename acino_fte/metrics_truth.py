"""The trajectory and its claimed uncertainty against the truth.

Every definition, with its source, is in ``docs/metrics.md``. Shapes: N frames, M markers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from acino_fte.result import FTEResult

ELLIPSOID = 0.95
"""Probability that a marker lies in the ellipsoid of ``ellipsoid_coverage_95``."""
_FLAT = 1e-12  # an ellipsoid with a smaller ratio of its least to its greatest variance cannot be inverted


def true_positions(result: FTEResult) -> np.ndarray | None:
    """(N, M, 3) true positions, m, world frame; NaN where there is no truth; None without any."""
    if result.sequence.truth is None:
        return None
    truth = result.sequence.truth.reindex(marker=result.skeleton.marker_names)
    return truth.transpose("frame", "marker", "space").values


def truth_vectors(result: FTEResult) -> np.ndarray | None:
    """(N, M, 3) estimated − true position, m, world frame; NaN where one is missing; None without truth."""
    true = true_positions(result)
    return None if true is None else result.positions - true


def truth_errors(result: FTEResult) -> np.ndarray | None:
    """(N, M) distance to the true positions, m; NaN where there is no truth; None without any."""
    vectors = truth_vectors(result)
    return None if vectors is None else np.linalg.norm(vectors, axis=-1)


def truth_metrics(result: FTEResult) -> dict[str, Any] | None:
    """mpjpe (mean per-joint position error), rmse, median and p95 against truth, mm; None without truth."""
    errors = truth_errors(result)
    if errors is None:
        return None
    millimetres = 1000.0 * errors[np.isfinite(errors)]
    return {
        "mpjpe": float(millimetres.mean()) if millimetres.size else None,
        "rmse": float(np.sqrt(np.mean(millimetres**2))) if millimetres.size else None,
        "median": quantile(millimetres, 0.5),
        "p95": quantile(millimetres, 0.95),
    }


def marker_sd(result: FTEResult) -> np.ndarray | None:
    """(N, M) standard deviation of a marker along a mean axis, √(trace/3), m; None without covariance."""
    if result.position_covariance is None:
        return None
    variance = np.trace(result.position_covariance, axis1=-2, axis2=-1) / 3.0
    with np.errstate(invalid="ignore"):
        return np.sqrt(variance)


def uncertainty_metrics(result: FTEResult) -> dict[str, Any] | None:
    """What the covariances say, and with truth also whether they are right; None without covariance.

    Returns
    -------
    dict
        ``median_sd_mm``, ``predicted_rmse_mm`` and, with truth, ``nees_per_dim`` and
        ``ellipsoid_coverage_95`` (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).
    """
    sd = marker_sd(result)
    if sd is None:
        return None
    known = sd[np.isfinite(sd)]
    metrics: dict[str, Any] = {
        "median_sd_mm": 1000.0 * float(np.median(known)) if known.size else None,
        "predicted_rmse_mm": 1000.0 * float(np.sqrt(3.0 * np.mean(known**2))) if known.size else None,
    }
    nees = normalised_errors(result)
    if nees is not None:
        from scipy.stats import chi2

        nees = nees[np.isfinite(nees)]
        metrics["nees_per_dim"] = float(nees.mean()) / 3.0 if nees.size else None
        inside = nees <= chi2.ppf(ELLIPSOID, 3)
        metrics["ellipsoid_coverage_95"] = float(inside.mean()) if nees.size else None
    return metrics


def normalised_errors(result: FTEResult) -> np.ndarray | None:
    """(N, M) normalised estimation error squared, eᵀ S⁻¹ e, with e = estimated − true position.

    NaN where there is no truth, no covariance, or a covariance without an inverse; None without either.
    """
    vectors, covariance = truth_vectors(result), result.position_covariance
    if vectors is None or covariance is None:
        return None
    known = np.isfinite(vectors).all(-1) & np.isfinite(covariance).all((-2, -1))
    nees = np.full(vectors.shape[:-1], np.nan)
    variances, axes = np.linalg.eigh(covariance[known])  # ascending
    solid = variances[:, 0] > _FLAT * variances[:, -1]
    along = np.einsum("kij,ki->kj", axes, vectors[known])
    safe = np.where(solid[:, None], variances, np.nan)
    nees[known] = np.sum(along**2 / safe, axis=-1)
    return nees


def quantile(values: np.ndarray, share: float) -> float | None:
    """Quantile by linear interpolation (Hyndman and Fan 1996, type 7); None when empty or infinite."""
    if not values.size:
        return None
    ordered = np.sort(values)
    place = share * (len(ordered) - 1)
    low, high = ordered[math.floor(place)], ordered[math.ceil(place)]
    if not math.isfinite(high):
        return float(low) if place == math.floor(place) and math.isfinite(low) else None
    return float(low + (place - math.floor(place)) * (high - low))
