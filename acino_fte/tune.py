"""Process noise from the data: maximum marginal likelihood, by the Laplace approximation.

With the trajectory and the parameters integrated out, the evidence for the process noise σ_w (a factor on the
species' values for every degree of freedom) is

    log p(z | σ_w) ≈ −f(x̂) − Σ log σ_w − ½ log det H + const                         (MacKay 2003, eq. 27.6)

with f the negative log-posterior at its minimum x̂ and H its Hessian there. It is stationary where

    σ_w² = Σ ŵ² / γ,   γ = Σ (1 − Var(w)/σ_w²)                                        (MacKay 1992, eq. 4.9)

per degree of freedom: ŵ the jumps of acceleration at the minimum, Var(w) their posterior variance, γ the
number of jumps that the data tell. A few rounds of this, each followed by a fit, and only while the evidence
rises. The prior on the logarithm of a factor is Gaussian about the species' value (:data:`WIDTH`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from acino_fte.posterior import Posterior
from acino_fte.problem import FTEProblem
from acino_fte.solve import Minimum

WIDTH = 2.0  # standard deviation of the prior of log(factor)
_ROUNDS = 6
_ENOUGH = 1.0  # gain of log-evidence below which a further round is not worth its time
_STEP = 1.5  # largest change of log(factor) in a round
_STENCIL = np.array([1.0, -3.0, 3.0, -1.0])  # jump of acceleration, times Δt²

Refit = Callable[[np.ndarray], tuple[FTEProblem, Minimum, Posterior | None]]


@dataclass(frozen=True, eq=False)
class Tuned:
    """Where tuning ended: factors (Q,) on the process noise, the fit with them, log-evidence gained."""

    factors: np.ndarray
    problem: FTEProblem
    minimum: Minimum
    posterior: Posterior
    gained: float

    @property
    def finding(self) -> str:
        """What was gained, in words."""
        low, middle, high = np.quantile(self.factors, (0, 0.5, 1))
        return (
            f"process noise tuned: log-likelihood gained {self.gained:.1f}; factors on the species' values "
            f"{low:.2g} to {high:.2g}, median {middle:.2g}"
        )


def evidence(problem: FTEProblem, minimum: Minimum, spread: Posterior) -> float:
    """Laplace approximation of the log-evidence, up to a constant in the process noise."""
    spreads = sum(float(np.log(t.sd[t.frames >= t.residual.reach]).sum()) for t in _jumps(problem))
    return -minimum.objective - spreads - 0.5 * spread.log_determinant


def _jumps(problem: FTEProblem) -> list:
    return [t for t in problem.terms if t.family == "model"]


def jump_moments(problem: FTEProblem, minimum: Minimum, spread: Posterior) -> tuple[np.ndarray, np.ndarray]:
    """Jumps of acceleration ŵ and their posterior variances, (N − 3, Q) each."""
    q, dt2 = minimum.q, problem.dt**2
    n = len(q)
    jumps = sum(w * q[3 - i : n - i] for i, w in enumerate(_STENCIL)) / dt2
    variance = np.zeros_like(jumps)
    for i, a in enumerate(_STENCIL):
        for j, b in enumerate(_STENCIL):
            newer, lag = min(i, j), abs(i - j)
            blocks = spread.q_blocks[lag][3 - newer : n - newer]
            variance += a * b * np.diagonal(blocks, axis1=1, axis2=2)
    return jumps, np.maximum(variance, 0.0) / dt2**2


def proposal(
    problem: FTEProblem, minimum: Minimum, spread: Posterior, factors: np.ndarray, sd: np.ndarray
) -> np.ndarray:
    """Factors of the next round, from those of this one and σ_w (Q,) with them."""
    jumps, variance = jump_moments(problem, minimum, spread)
    told = np.maximum((1.0 - variance / sd**2).sum(0), 0.0)
    target = np.log(np.sqrt((jumps**2).sum(0) / np.maximum(told, 1e-9)) / sd) + np.log(factors)
    weight = told / (told + 1.0 / (2.0 * WIDTH**2))  # curvature of the evidence is 2γ in log σ_w
    wanted = np.where(told > 1e-3, weight * target, np.log(factors))
    return np.exp(np.log(factors) + np.clip(wanted - np.log(factors), -_STEP, _STEP))


def tune(problem: FTEProblem, minimum: Minimum, spread: Posterior, refit: Refit) -> Tuned:
    """Raise the evidence for the process noise; ``refit`` fits with the factors it is given."""
    start = evidence(problem, minimum, spread)
    factors = np.ones(len(problem.lower))
    best = Tuned(factors, problem, minimum, spread, 0.0)
    base = np.zeros(len(factors))
    for term in _jumps(problem):
        base[term.items[:, 0]] = term.sd
    for _ in range(_ROUNDS if _jumps(problem) and problem.n_frames > 4 else 0):
        sd = base * best.factors
        factors = proposal(best.problem, best.minimum, best.posterior, best.factors, sd)
        again, solved, narrowed = refit(factors)
        if narrowed is None or not solved.status.ok:
            break
        gained = evidence(again, solved, narrowed) - start
        if gained <= best.gained:
            break
        small = gained - best.gained < _ENOUGH
        best = Tuned(factors, again, solved, narrowed, gained)
        if small:
            break
    return best
