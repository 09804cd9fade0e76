"""How sure the estimate is: the Gaussian about the optimum whose information matrix is the Hessian there.

With f the negative log-posterior, Σ = (∇²f)⁻¹ at its minimum (Laplace; MacKay 2003, ch. 27). The Hessian is
banded with an arrow, and its inverse is only needed inside the band (:mod:`acino_fte.arrow`): O(N). Markers
follow by the chain rule,

    cov(p) = J Σ_qq Jᵀ + J Σ_qθ Kᵀ + K Σ_θq Jᵀ + K Σ_θθ Kᵀ,   J = ∂p/∂q, K = ∂p/∂θ.

A variable held at its bound by a multiplier z has, beside the bound, a density that falls like exp(−z·x): its
variance is 1/z², which enters as information z².

A robust loss is not the logarithm of the noise's density, and its curvature not the information in the
data: an observation is worth E[ψ']²/E[ψ²] (Huber 1964), while the Hessian has E[ψ']. So the data's part of
the Hessian is multiplied by

    w = Σ ψ'(e) / Σ ψ²(e)

over the residuals e, which are divided by √(1 − leverage) as in :mod:`acino_fte.noise`: then the
information of the data equals the variance of their score (Lyddon, Holmes and Walker 2019). For Gaussian
noise of the assumed σ, w is 1 with the squared loss and 1.21 with Geman and McClure's at c = 5; noise
beyond the assumed lowers it.

Shapes: N frames, Q degrees of freedom, M markers, P parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acino_fte.arrow import ArrowFactor, NotPositiveDefinite
from acino_fte.compiled_terms import CompiledTerm, Evaluation
from acino_fte.condensed import Condensed
from acino_fte.losses import Loss
from acino_fte.problem import FTEProblem
from acino_fte.solve import Minimum

MOST_LEVERAGE = 0.9  # a residual is never divided by less than √(1 − this)
_PRIOR_COUNT = 20.0  # residuals as Gaussian noise would have them, that count beside those there are
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(64)

Parts = tuple[list[np.ndarray], np.ndarray, np.ndarray]


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
    with_cameras : (N, M, 3, P − K)
        Of every marker and the parameters that are not those of the kinematics.
    log_determinant : float
        Of the objective's own Hessian for q and θ.
    exact : bool
        False when the exact Hessian was not positive definite and Gauss–Newton's took its place.
    data_weight : float
        w: factor on the data's part of the Hessian (module docstring).
    """

    q_blocks: list[np.ndarray]
    cross: np.ndarray
    theta: np.ndarray
    positions: np.ndarray
    with_cameras: np.ndarray
    log_determinant: float
    exact: bool
    data_weight: float = 1.0

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
    parts = condensed.hessian_parts(condensed.pack(minimum.q, minimum.theta))
    factor = factorise(problem, *parts, minimum.multipliers)
    first = _covariances(problem, condensed, minimum, factor)
    weight = _data_weight(condensed, first, exact=exact)
    sd = problem.parameters.sd
    scale = 2.0 * float(np.log(sd).sum())  # the determinant is that for θ, not for θ/σ
    scaled = factorise(problem, *_weighted(problem, minimum, parts, weight, exact), minimum.multipliers)
    covariances = _covariances(problem, condensed, minimum, scaled)
    return replace(
        covariances, log_determinant=factor.log_determinant - scale, exact=exact, data_weight=weight
    )


def _covariances(
    problem: FTEProblem, condensed: Condensed, minimum: Minimum, factor: ArrowFactor
) -> Posterior:
    """What the inverse of a factored Hessian says, with its determinant for θ/σ_θ."""
    inverse, sd = factor.selected_inverse(), problem.parameters.sd
    cross, theta = inverse.cross * sd, inverse.corner * np.outer(sd, sd)
    markers = _markers(problem, minimum, inverse.blocks[0], cross, theta)
    return Posterior(inverse.blocks, cross, theta, *markers, factor.log_determinant, condensed.exact)


def _weighted(problem: FTEProblem, minimum: Minimum, parts: Parts, weight: float, exact: bool) -> Parts:
    """The Hessian with the part of the data multiplied by ``weight``: w H + (1 − w) H_rest."""
    rest = replace(problem, terms=tuple(t for t in problem.terms if t.family != "meas"))
    condensed = Condensed(rest, exact=exact)
    others = condensed.hessian_parts(condensed.pack(minimum.q, minimum.theta))
    blocks = [weight * block for block in parts[0]]
    for block, other in zip(blocks, others[0], strict=False):  # the data may reach further back
        block += (1.0 - weight) * other
    border = weight * parts[1] + (1.0 - weight) * others[1]
    corner = weight * parts[2] + (1.0 - weight) * others[2]
    return blocks, border, corner


def _data_weight(condensed: Condensed, spread: Posterior, *, exact: bool) -> float:
    """w, from the residuals that ``condensed`` evaluated last and the covariance without it.

    The Hessian that is to be multiplied has E[ψ'], or Gauss–Newton's E[ψ/e].
    """
    total = np.zeros(3)
    for term, found in condensed.evaluated():
        if term.term.family == "meas":
            free = 1.0 - leverage(term, found, spread)
            moments = _moments(term.term.loss, found.e / np.sqrt(free))
            total += (free * moments).sum(axis=(1, 2))
            gaussian = _moments(term.term.loss, _NODES) @ (_WEIGHTS / _WEIGHTS.sum())
    if not total.any():
        return 1.0
    bend, score, weight = total + _PRIOR_COUNT * gaussian
    if exact and bend <= 0:
        raise NotPositiveDefinite("most residuals lie where the loss bends down")
    return float(bend / score if exact else bend**2 / (score * weight))


def _moments(loss: Loss, e: np.ndarray) -> np.ndarray:
    """ψ', ψ² and ψ/e (3, …) of normalised residuals (…)."""
    _, psi, bend, weight = loss.derivatives(e)
    return np.stack([bend, psi**2, weight])


def leverage(term: CompiledTerm, found: Evaluation, spread: Posterior) -> np.ndarray:
    """v/σ² (c, K): variance of the predicted pixel over that of the detection, of every component.

    Marker and camera count together: what is unsure of both together, as the frame of the world is, leaves
    the pixel as it is. The marker of a late camera has the variance that it has at the frame.
    """
    slot = next(s for s in term.slots if s.kind == "position")
    own = [s for s in term.slots if s.kind == "parameter"]
    slope = found.slope[:, slot.rows]
    covariance = spread.positions[slot.frames, slot.items]
    variance = np.einsum("cak,kab,cbk->ck", slope, covariance, slope, optimize=True)
    if own:
        places = np.stack([s.items for s in own], axis=-1)  # (K, p)
        turn = found.slope[:, [s.rows.start for s in own]]
        first = len(spread.theta) - spread.with_cameras.shape[-1]
        mixed = spread.with_cameras[slot.frames[:, None], slot.items[:, None], :, places - first]  # (K, p, 3)
        variance += 2.0 * np.einsum("cak,kpa,cpk->ck", slope, mixed, turn, optimize=True)
        cameras = spread.theta[places[:, :, None], places[:, None]]
        variance += np.einsum("cpk,kpr,crk->ck", turn, cameras, turn, optimize=True)
    return np.clip(variance / term.sd**2, 0.0, MOST_LEVERAGE)


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


def _markers(
    problem: FTEProblem, minimum: Minimum, q: np.ndarray, cross: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the markers (N, M, 3, 3), and theirs with the other parameters (N, M, 3, P − K)."""
    linear = problem.kinematics.linearise(minimum.q, problem.proportions(minimum.theta))
    jacobian, kinematic = linear.jacobian, problem.parameters.n_kinematic  # (N, M, 3, Q)
    n, m, _, d = jacobian.shape
    rows = jacobian.reshape(n, 3 * m, d)
    result = (rows @ q).reshape(jacobian.shape) @ jacobian.swapaxes(-1, -2)
    with_cameras = (rows @ cross[:, :, kinematic:]).reshape(n, m, 3, -1)
    g = linear.growth.shape[-1]
    for i in range(m if kinematic else 0):
        own = np.arange(g + 3 * i, g + 3 * i + 3) if linear.rotations.shape[1] else np.empty(0, dtype=int)
        places = np.concatenate([np.arange(g), own])
        parts = [linear.growth[:, i]] + ([linear.rotations[:, i]] if len(own) else [])
        k = np.concatenate(parts, axis=-1)  # (N, 3, places)
        mixed = jacobian[:, i] @ cross[:, :, places] @ k.swapaxes(-1, -2)
        result[:, i] += mixed + mixed.swapaxes(-1, -2)
        result[:, i] += k @ theta[np.ix_(places, places)] @ k.swapaxes(-1, -2)
        with_cameras[:, i] += k @ theta[places, kinematic:]
    return result, with_cameras
