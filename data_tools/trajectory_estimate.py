"""Estimates how animals move between frames, from the pixels of all views.

Shapes: T nodes.
"""

from __future__ import annotations

import numpy as np

from acino_fte.data_tools.small_search import bounded_minimum, descend
from acino_fte.data_tools.trajectory_motion import (
    N_LAGS,
    MotionModel,
    Pieces,
    innovation_variances,
    innovations,
    log_information,
)
from acino_fte.data_tools.trajectory_smoother import ChainFactor

_WINDOW, _SAMPLE = 50, 1500  # frames in a window, nodes to estimate the prior from
_BROAD = np.array([2.0, 1.5, 1.5])  # standard deviations of log q and atanh r before any data
_BROAD_AGILITY, _MOST_AGILE = 0.7, 2.5  # of the logarithm: standard deviation before any data, and bound
_FEW = 10  # frames below which the moments say nothing
_FLAT = 0.002  # gradient at which the search ends, less than the error of log q
_REACH = 3.5  # largest inverse hyperbolic tangent of a partial autocorrelation


def estimate_motion(
    x: np.ndarray,
    information: np.ndarray,
    gradient: np.ndarray,
    pieces: Pieces,
    start: MotionModel | None = None,
) -> MotionModel:
    """The prior of greatest marginal likelihood.

    With the views linearised at x, the path is Gaussian and its integral is exact,

        −2 log p(pixels) = min_x (χ²(pixels) + xᵀP x) + log det(Λ + P) − log det P + const.

    A broad normal law of log q and of atanh r decides where a few frames cannot.

    Parameters
    ----------
    x : (T, 3)
        Where the views are linearised.
    information, gradient : (T, 3, 3), (T, 3)
        Λ and Jᵀr/σ² there.
    pieces : Pieces
        Which frames hang together.
    start : MotionModel, optional
        Where to begin; by default from the moments of the displacements.
    """
    noise = _noise(information)
    x = x - np.repeat(x[pieces.start], pieces.length, axis=0)  # a path's place means nothing
    scale = max(2.0 * float(np.linalg.norm(x, axis=1).max()), 100.0 * noise, 1e-6)
    first = start or _from_moments(x, noise, information, pieces)
    centre = np.array([np.log(3.0 * noise + 1e-6 * scale), 0.0, 0.0])

    def value(parameters: np.ndarray) -> float:
        motion = _motion(parameters, scale)
        try:
            evidence = log_evidence(x, information, gradient, pieces, motion)
        except np.linalg.LinAlgError:
            return np.inf
        penalty = 0.5 * (((parameters - centre) / _BROAD) ** 2).sum()
        return (penalty - evidence) / (3.0 * pieces.n_nodes)  # curvature about 1 for log q

    begin = np.array([np.log(first.step), *np.arctanh(np.clip(first.memory, -0.99, 0.99))])
    return _motion(descend(value, begin, flat=_FLAT), scale)


def estimate_agility(
    x: np.ndarray,
    information: np.ndarray,
    gradient: np.ndarray,
    pieces: Pieces,
    motion: MotionModel,
    group: np.ndarray,
) -> dict[int, float]:
    """How agile each group of pieces is against the prior of all: of greatest marginal likelihood.

    A broad law of its logarithm around 0 decides for groups with few frames.

    Parameters
    ----------
    x, information, gradient, pieces
        As for :func:`estimate_motion`.
    motion : MotionModel
        Of all together.
    group : (S,) int
        The animal of each piece.
    """
    x = x - np.repeat(x[pieces.start], pieces.length, axis=0)
    return {
        int(one): _agility(x, information, gradient, pieces, motion, group == one) for one in np.unique(group)
    }


def _agility(
    x: np.ndarray,
    information: np.ndarray,
    gradient: np.ndarray,
    pieces: Pieces,
    motion: MotionModel,
    mine: np.ndarray,
) -> float:
    """Of the pieces (S,) bool."""
    nodes, length = mine[pieces.owner], pieces.length[mine]
    x, information, gradient = x[nodes], information[nodes], gradient[nodes]

    def value(log_agility: float) -> float:
        agile = Pieces(length, np.full(len(length), np.exp(log_agility)))
        try:
            evidence = log_evidence(x, information, gradient, agile, motion)
        except np.linalg.LinAlgError:
            return np.inf
        return 0.5 * (log_agility / _BROAD_AGILITY) ** 2 - evidence

    return float(np.exp(bounded_minimum(value, -_MOST_AGILE, _MOST_AGILE, 0.02)))


def log_evidence(
    x: np.ndarray, information: np.ndarray, gradient: np.ndarray, pieces: Pieces, motion: MotionModel
) -> float:
    """log p(pixels) of a prior, up to a constant that no prior changes; arguments as above."""
    factor = ChainFactor(information, motion, pieces)
    step = factor.solve(gradient - factor.prior_times(x))
    cost = np.einsum("ni,nij,nj->", step, information, step) - 2 * np.vdot(gradient, step)
    new = innovations(motion, pieces, x + step)  # xᵀP x itself would drown in rounding errors
    cost += ((new**2).sum(1) / innovation_variances(motion, pieces)).sum()
    return -0.5 * (float(cost) + factor.log_determinant) + 1.5 * log_information(motion, pieces)


def _motion(parameters: np.ndarray, scale: float) -> MotionModel:
    step = float(np.exp(np.clip(parameters[0], np.log(1e-6 * scale), np.log(10 * scale))))
    r1, r2 = np.tanh(np.clip(parameters[1:], -_REACH, _REACH))
    return MotionModel(step, (float(r1), float(r2)))


def sample_windows(pieces: Pieces, known: np.ndarray) -> tuple[np.ndarray, Pieces]:
    """Nodes of windows spread over all pieces; each has one node at least that is known (T,) bool."""
    count = -(-pieces.length // _WINDOW)
    begin = np.repeat(pieces.start, count) + _WINDOW * _count_up(count)
    end = np.minimum(begin + _WINDOW, np.repeat(pieces.start + pieces.length, count))
    total = np.concatenate([[0], np.cumsum(known)])
    there = total[end] > total[begin]
    begin, length = begin[there], (end - begin)[there]
    order = np.random.default_rng(0).permutation(len(length))
    chosen = np.sort(order[: np.searchsorted(np.cumsum(length[order]), _SAMPLE) + 1])
    nodes = np.repeat(begin[chosen], length[chosen]) + _count_up(length[chosen])
    agility = None if pieces.agility is None else pieces.agility[pieces.owner[begin[chosen]]]
    return nodes, Pieces(length[chosen], agility)


def _count_up(counts: np.ndarray) -> np.ndarray:
    """0 … c − 1 for each count c."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


def _noise(information: np.ndarray) -> float:
    """Typical standard deviation of a coordinate that the views alone leave, m."""
    trace = np.trace(information, axis1=1, axis2=2)
    seen = trace > 0
    if not seen.any():
        return 0.0
    sure = np.linalg.inv(information[seen] + 1e-6 * trace[seen, None, None] * np.eye(3))
    return float(np.sqrt(np.median(np.trace(sure, axis1=1, axis2=2)) / 3.0))


def _from_moments(x: np.ndarray, noise: float, information: np.ndarray, pieces: Pieces) -> MotionModel:
    """A rough prior from the covariances of displacements, less what the pixels' noise adds to them."""
    determinant = np.linalg.det(information)
    met = determinant > 0.01 * np.quantile(determinant, 0.9)  # a single view leaves its ray's direction open
    inner = (pieces.age >= N_LAGS) & met
    for lag in range(1, N_LAGS + 1):
        inner[lag:] &= met[:-lag]
    if inner.sum() < _FEW:
        return MotionModel(3.0 * noise + 1e-6)
    step = np.diff(x, axis=0, prepend=x[:1])
    g0, g1, g2 = (float(np.mean((step[lag:] * step[: len(step) - lag])[inner[lag:]])) for lag in range(3))
    own = max(g0 - 2 * noise**2, 0.05 * g0, 1e-12)
    r1 = float(np.clip((g1 + noise**2) / own, -0.5, 0.98))
    r2 = float(np.clip((g2 / own - r1**2) / (1 - r1**2), -0.8, 0.8))
    return MotionModel(float(np.sqrt(own * (1 - r1**2) * (1 - r2**2))), (r1, r2))
