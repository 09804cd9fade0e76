"""Measurement noise from the data: one robust scale for every marker, with the species' table as prior.

A residual of a good fit is smaller than the noise, since the fit follows the noise: with v the variance of
the predicted pixel, Var(r) = σ² − v (leverage; Rousseeuw and Leroy 1987, ch. 6), so residuals are divided by
√(1 − v/σ²) first. Their scale is found from the median absolute deviation and refined by the variance of what
lies within ±cσ of zero, corrected for the truncation,

    σ² = E[r² | |r| < cσ] / κ,   κ = 1 − 2cφ(c)/(2Φ(c) − 1),

which is little disturbed by gross errors and nearly as precise as the standard deviation without them. The
table counts like ``PRIOR_COUNT`` observations, in the logarithm.
"""

from __future__ import annotations

import math

import numpy as np

from acino_fte.condensed import Condensed
from acino_fte.posterior import Posterior, leverage
from acino_fte.problem import FTEProblem
from acino_fte.solve import Minimum

PRIOR_COUNT = 20.0
_CUT = 2.5
_MAD = 1.482602218505602  # 1/Φ⁻¹(¾)
_ROUNDS = 4


def robust_scale(residuals: np.ndarray) -> float:
    """Standard deviation of the bulk of some residuals about zero (any shape, NaN left out)."""
    size = np.abs(residuals[np.isfinite(residuals)])
    if not len(size):
        return math.nan
    sigma = _MAD * float(np.median(size))
    density = math.exp(-0.5 * _CUT**2) / math.sqrt(2 * math.pi)
    kappa = 1.0 - 2 * _CUT * density / math.erf(_CUT / math.sqrt(2))
    for _ in range(_ROUNDS):
        inside = size[size <= _CUT * sigma]
        if not len(inside) or sigma == 0:
            break
        sigma = math.sqrt(float(np.mean(inside**2)) / kappa)
    return sigma


def estimate_noise(
    problem: FTEProblem, minimum: Minimum, posterior: Posterior | None, table: np.ndarray
) -> np.ndarray:
    """Standard deviation of every marker's detections (M,), px.

    ``table`` (M,) is what the species file says; ``posterior`` gives the leverage, none when left out.
    """
    condensed = Condensed(problem)
    condensed.objective(condensed.pack(minimum.q, minimum.theta))
    pools: list[list[np.ndarray]] = [[] for _ in table]
    for term, found in condensed.evaluated():
        if term.term.family != "meas":
            continue
        share = 0.0 if posterior is None else leverage(term, found, posterior)
        scaled = found.e * term.sd / np.sqrt(1.0 - share)
        for marker in np.unique(term.term.items[:, 0]):
            pools[marker].append(scaled[:, term.term.items[:, 0] == marker].ravel())
    result = table.copy()
    for m, pool in enumerate(pools):
        values = np.concatenate(pool) if pool else np.empty(0)
        sigma = robust_scale(values)
        if sigma > 0:
            count = len(values)
            logs = count * math.log(sigma) + PRIOR_COUNT * math.log(table[m])
            result[m] = math.exp(logs / (count + PRIOR_COUNT))
    return result
