"""How sure the estimate is: the Gaussian about the optimum whose information matrix is the Hessian there.

With f the negative log-posterior, Σ = (∇²f)⁻¹ at its minimum (Laplace; MacKay 2003, ch. 27). The Hessian is
banded with an arrow, and its inverse is only needed inside the band (:mod:`acino_fte.arrow`): O(N). Markers
follow by the chain rule,

    cov(p) = J Σ_qq Jᵀ + J Σ_qθ Kᵀ + K Σ_θq Jᵀ + K Σ_θθ Kᵀ,   J = ∂p/∂q, K = ∂p/∂θ.

A variable held at its bound by a multiplier z has, beside the bound, a density that falls like exp(−z·x): its
variance is 1/z², which enters as information z².

Shapes: N frames, Q degrees of freedom, M markers, P parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.arrow import ArrowFactor, NotPositiveDefinite
from acino_fte.condensed import Condensed
from acino_fte.problem import FTEProblem
from acino_fte.solve import Minimum


@dataclass(frozen=True, eq=False)
class Posterior:
    """Covariances at an optimum.

    Attributes
    ----------
    q_blocks : list of (N, Q, Q)
        Item L: covariance of q at frames n and n − L.
    cross : (N, Q, P)
        Of q and θ.
    theta : (P, P)
        Of θ.
    positions : (N, M, 3, 3)
        Of every marker, m².
    log_determinant : float
        Of the Hessian for q and θ.
    exact : bool
        False when the exact Hessian was not positive definite and Gauss–Newton's took its place.
    """

    q_blocks: list[np.ndarray]
    cross: np.ndarray
    theta: np.ndarray
    positions: np.ndarray
    log_determinant: float
    exact: bool

    @property
    def q_sd(self) -> np.ndarray:
        """(N, Q) standard deviations of q, m and rad."""
        return np.sqrt(np.maximum(np.diagonal(self.q_blocks[0], axis1=1, axis2=2), 0.0))

    @property
    def theta_sd(self) -> np.ndarray:
        """(P,) standard deviations of θ."""
        return np.sqrt(np.maximum(np.diag(self.theta), 0.0))


def posterior(problem: FTEProblem, minimum: Minimum) -> Posterior:
    """The posterior of a solved problem.

    Raises
    ------
    NotPositiveDefinite
        The minimum is none: even the Gauss–Newton Hessian has a direction without information.
    """
    try:
        return _posterior(problem, minimum, exact=True)
    except NotPositiveDefinite:
        return _posterior(problem, minimum, exact=False)


def _posterior(problem: FTEProblem, minimum: Minimum, *, exact: bool) -> Posterior:
    condensed = Condensed(problem, exact=exact)
    x = condensed.pack(minimum.q, minimum.theta)
    blocks, border, corner = condensed.hessian_parts(x)
    factor = factorise(problem, blocks, border, corner, minimum.multipliers)
    inverse, sd = factor.selected_inverse(), problem.parameters.sd
    cross, theta = inverse.cross * sd, inverse.corner * np.outer(sd, sd)
    positions = _positions(problem, condensed, minimum, inverse.blocks[0], cross, theta)
    scale = 2.0 * float(np.log(sd).sum())  # the determinant is that for θ, not for θ/σ
    return Posterior(inverse.blocks, cross, theta, positions, factor.log_determinant - scale, exact)


def factorise(
    problem: FTEProblem,
    blocks: list[np.ndarray],
    border: np.ndarray,
    corner: np.ndarray,
    multipliers: np.ndarray | None = None,
) -> ArrowFactor:
    """Factor of a Hessian for (q, θ/σ_θ), given for (q, θ); bounds count by their multipliers squared."""
    sd = problem.parameters.sd
    corner = corner * np.outer(sd, sd)
    blocks = [blocks[0].copy(), *blocks[1:]]
    if multipliers is not None:
        held = multipliers**2
        n, d = problem.n_frames, len(problem.lower)
        diagonal = np.arange(d)
        blocks[0][:, diagonal, diagonal] += held[: n * d].reshape(n, d)
        corner[np.diag_indices(len(sd))] += held[n * d :]
    return ArrowFactor(blocks, border * sd, corner)


def _positions(
    problem: FTEProblem,
    condensed: Condensed,
    minimum: Minimum,
    q: np.ndarray,
    cross: np.ndarray,
    theta: np.ndarray,
) -> np.ndarray:
    """Covariance of the markers (N, M, 3, 3)."""
    linear = problem.kinematics.linearise(minimum.q, problem.proportions(minimum.theta))
    jacobian = linear.jacobian  # (N, M, 3, Q)
    result = (jacobian @ q[:, None]) @ jacobian.swapaxes(-1, -2)
    g = linear.growth.shape[-1]
    for m in range(jacobian.shape[1] if problem.parameters.n_kinematic else 0):
        own = np.arange(g + 3 * m, g + 3 * m + 3) if linear.rotations.shape[1] else np.empty(0, dtype=int)
        places = np.concatenate([np.arange(g), own])
        parts = [linear.growth[:, m]] + ([linear.rotations[:, m]] if len(own) else [])
        k = np.concatenate(parts, axis=-1)  # (N, 3, places)
        mixed = jacobian[:, m] @ cross[:, :, places] @ k.swapaxes(-1, -2)
        result[:, m] += mixed + mixed.swapaxes(-1, -2)
        result[:, m] += k @ theta[np.ix_(places, places)] @ k.swapaxes(-1, -2)
    return result
