"""Process noise from the data: maximum marginal likelihood, by the Laplace approximation.

With the trajectory and the parameters integrated out, the evidence for the process noise σ_w (a factor on the
species' values for every degree of freedom) is

    log p(z | σ_w) ≈ −f(x̂) + ½ log det P(σ_w) − ½ log det H + const                  (MacKay 2003, eq. 27.6)

with f the negative log-posterior at its minimum x̂, H its Hessian there and P the precision of the prior of
the trajectory, for a degree of freedom whose joint has a prior of width s

    P = DᵀD/σ_w² + I/s²,   w = D q.

A joint's own prior limits its slow motion whatever σ_w is, which det P takes into account; without it det P
is σ_w to the power of −2 (N − 3). The evidence is stationary where

    σ_w² = Σ ŵ² / γ,   γ = Σ (Var₀(w) − Var(w))/σ_w²                                  (MacKay 1992, eq. 4.9)

per degree of freedom: ŵ the jumps of acceleration at the minimum, Var(w) their posterior variance and
Var₀(w) that before any data, γ the number of jumps that the data tell. A few rounds of this, each followed
by a fit, and only while the evidence rises. The prior on the logarithm of a factor is Gaussian about the
species' value (:data:`WIDTH`).

All this is for the losses of the data multiplied by their weight w (:mod:`acino_fte.posterior`): only then
does the trajectory vary as much as its posterior covariance says, which is what the noise is judged by. A
multiple of a loss is the same loss with other parameters and another σ.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from acino_fte.arrow import NotPositiveDefinite
from acino_fte.condensed_solve import minimise
from acino_fte.losses import Loss
from acino_fte.posterior import Posterior, posterior
from acino_fte.problem import FTEProblem
from acino_fte.solve import Minimum
from acino_fte.terms import Term

WIDTH = 2.0  # standard deviation of the prior of log(factor)
_ROUNDS = 8
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


def tune(problem: FTEProblem, minimum: Minimum, spread: Posterior, refit: Refit) -> Tuned:
    """Raise the evidence for the process noise; ``refit`` fits the problem with the factors it is given."""
    nothing = Tuned(np.ones(len(problem.lower)), problem, minimum, spread, 0.0)
    if problem.n_frames <= 4 or not any(t.family == "model" for t in problem.terms):
        return nothing
    weighted = with_data_weight(problem, spread.data_weight)
    start = _tried(weighted, minimum, nothing.factors)
    if start is None:
        return nothing
    best = start
    for _ in range(_ROUNDS):
        again = _tried(weighted, best.minimum, best.proposal)
        if again is None or again.worth <= best.worth:
            break
        small = again.worth - best.worth < _ENOUGH
        best = again
        if small:
            break
    if best is start:
        return nothing
    found, solved, narrowed = refit(best.factors)
    if narrowed is None:
        return nothing
    return Tuned(best.factors, found, solved, narrowed, best.worth - start.worth)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A fit with some factors (Q,), its log-evidence with the prior of the factors, and what to try next."""

    factors: np.ndarray
    minimum: Minimum
    worth: float
    proposal: np.ndarray


def _tried(problem: FTEProblem, near: Minimum, factors: np.ndarray) -> _Trial | None:
    """The problem solved with factors on its process noise; None when that fails."""
    problem = _with_factors(problem, factors)
    minimum = minimise(problem, near.q, theta=near.theta)
    if not minimum.status.ok:
        return None
    try:
        spread = posterior(problem, minimum)
    except NotPositiveDefinite:
        return None
    prior = 0.5 * float(np.sum((np.log(factors) / WIDTH) ** 2))
    worth = evidence(problem, minimum, spread) - prior
    return _Trial(factors, minimum, worth, proposal(problem, minimum, spread, factors))


def _with_factors(problem: FTEProblem, factors: np.ndarray) -> FTEProblem:
    """The problem with factors (Q,) on its process noise."""
    terms = (
        replace(t, sd=t.sd * factors[t.items[:, 0]]) if t.family == "model" else t for t in problem.terms
    )
    return replace(problem, terms=tuple(terms))


def with_data_weight(problem: FTEProblem, weight: float) -> FTEProblem:
    """The problem with the losses of its detections multiplied by a weight."""
    return replace(
        problem, terms=tuple(_times(t, weight) if t.family == "meas" else t for t in problem.terms)
    )


def _times(term: Term, weight: float) -> Term:
    """w ρ_c(r/σ) = ρ_c'(r/σ') with c' = √w c and σ' = σ/√w, as every loss is a square times one of e/c."""
    root = math.sqrt(weight)
    parameters = {name: value * root for name, value in term.loss.parameters.items()}
    return replace(term, sd=term.sd / root, loss=Loss(term.loss.name, parameters))


# --- the evidence ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Motion:
    """The prior of the trajectory: σ_w (Q,), s (Q,), infinite where a joint has none; eigenvalues of DᵀD."""

    noise: np.ndarray
    width: np.ndarray
    modes: np.ndarray

    @staticmethod
    def of(problem: FTEProblem) -> _Motion:
        """That of a problem."""
        noise, width = np.zeros(len(problem.lower)), np.full(len(problem.lower), np.inf)
        for term in problem.terms:
            if term.family == "model":
                noise[term.items[:, 0]] = term.sd
            elif term.family == "prior":
                width[term.items[:, 0]] = term.sd
        return _Motion(noise, width, _modes(problem.n_frames) / problem.dt**4)

    @property
    def _bent(self) -> np.ndarray:
        """(modes, Q): λ + σ_w²/s², of P = (λ + σ_w²/s²)/σ_w² along a mode."""
        return self.modes[:, None] + (self.noise / self.width) ** 2

    @property
    def log_determinant(self) -> float:
        """log det P but for directions that σ_w does not matter to."""
        return float(np.sum(np.log(self._bent) - 2.0 * np.log(self.noise)))

    @property
    def free(self) -> np.ndarray:
        """(Q,) Σ Var₀(w)/σ_w²: how many jumps the joints' own priors leave to the process noise."""
        return (self.modes[:, None] / self._bent).sum(0)


@cache
def _modes(n_frames: int) -> np.ndarray:
    """Eigenvalues (N − 3,) of DᵀD that are not zero, for a time of 1 between frames."""
    from scipy.linalg import eig_banded

    rows = np.convolve(_STENCIL, _STENCIL[::-1])[3:]  # D Dᵀ has the same, and one value on each diagonal
    count = n_frames - 3
    bands = np.repeat(rows[: min(4, count)][:, None], count, axis=1)
    return np.maximum(eig_banded(bands, lower=True, eigvals_only=True), 1e-15)


def evidence(problem: FTEProblem, minimum: Minimum, spread: Posterior) -> float:
    """Laplace approximation of the log-evidence, up to a constant without the process noise."""
    return -minimum.objective + 0.5 * (_Motion.of(problem).log_determinant - spread.log_determinant)


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


def proposal(problem: FTEProblem, minimum: Minimum, spread: Posterior, factors: np.ndarray) -> np.ndarray:
    """Factors (Q,) of the next round, from those that the problem has."""
    jumps, variance = jump_moments(problem, minimum, spread)
    motion = _Motion.of(problem)
    told = np.maximum(motion.free - (variance / motion.noise**2).sum(0), 0.0)
    size = np.maximum((jumps**2).sum(0), 1e-30) / np.maximum(told, 1e-9)
    target = 0.5 * np.log(size / motion.noise**2) + np.log(factors)
    weight = told / (told + 1.0 / (2.0 * WIDTH**2))  # curvature of the evidence is 2γ in log σ_w
    wanted = np.where(told > 1e-3, weight * target, np.log(factors))
    return np.exp(np.log(factors) + np.clip(wanted - np.log(factors), -_STEP, _STEP))
