"""The most probable paths of all groups, and the rows that do not belong to them.

Shapes: T nodes, P rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acino_fte.data_tools.trajectory_depth import LoneRows
from acino_fte.data_tools.trajectory_estimate import estimate_agility, estimate_motion, sample_windows
from acino_fte.data_tools.trajectory_motion import (
    MotionModel,
    Pieces,
    innovation_variances,
    innovations,
    tail_weights,
)
from acino_fte.data_tools.trajectory_rows import Measurements
from acino_fte.data_tools.trajectory_smoother import ChainFactor
from acino_fte.data_tools.trajectory_start import starting_path

_MIN_HEAVY = 4  # steps with heavy tails
_MAX_STEPS, _DONE = 25, 0.5  # Gauss–Newton; the last step moves no pixel by more than this part of σ
_GAIN = 0.1  # nor does it make a path cheaper by more than half of this, which depth may that no pixel shows
_WORSE, _SHORTEST = 1e-9, 1e-3  # a step that makes a path dearer is halved, down to this part of it
_BEHIND = 1e6  # what a row behind its camera costs
_ALONE = 1e-3  # keeps rows that nothing else predicts from being judged by rounding errors
_ROUNDS, _HEAVY_ROUNDS, _ESTIMATES = 12, 3, 3
_CROWD, _CROWD_FRAMES = 4, 5  # rows that leave within so many frames are a crowd
_TAILS = 3.0  # degrees of freedom of heavy tails
_BATCH = 30_000  # nodes fitted at once
_NEIGHBOURS = 2  # frames before and after in which only the worst row leaves
_DOUBT = 30.0  # squared residual of a frame's rows, in σ², beyond which they do not count at first


@dataclass(frozen=True, eq=False)
class PathFit:
    """Most probable paths.

    Attributes
    ----------
    x : (T, 3)
        Positions, m.
    covariance : (T, 3, 3)
        m².
    used : (P,) bool
        Rows that belong.
    distance : (P,)
        Squared distance of each row from what the others predict, in units of its uncertainty.
    residual : (P, 2)
        Measured less predicted, px.
    motion : MotionModel
        The prior.
    """

    x: np.ndarray
    covariance: np.ndarray
    used: np.ndarray
    distance: np.ndarray
    residual: np.ndarray
    motion: MotionModel


def fit_paths(
    rows: Measurements,
    pieces: Pieces,
    points: np.ndarray,
    motion: MotionModel | None,
    gate: float,
    sudden: bool = True,
    group: np.ndarray | None = None,
) -> PathFit:
    """Fit all paths; wrong rows leave, and rows that belong after all come back.

    Parameters
    ----------
    rows : Measurements
        The rows.
    pieces : Pieces
        Which frames hang together.
    points : (T, 3)
        Where the rays of each node meet, NaN where they do not. Each piece has one at least.
    motion : MotionModel, optional
        The prior; by default it is estimated, and again once wrong rows have left.
    gate : float
        Distance beyond which a row is wrong.
    sudden : bool
        Whether a crowd of wrong rows may be a sudden movement.
    group : (S,) int, optional
        The animal of each piece, where each may be as agile as it is.
    """
    prior = motion
    if prior is None:
        prior, pieces = _estimated(rows, pieces, points, gate, sudden, group)
    n = pieces.n_nodes
    x, covariance = np.empty((n, 3)), np.empty((n, 3, 3))
    used, distance, residual = np.empty(len(rows), dtype=bool), np.empty(len(rows)), np.empty((len(rows), 2))
    batch = pieces.start // _BATCH
    for number in np.unique(batch):
        mine = batch == number
        at = slice(pieces.start[mine][0], pieces.start[mine][-1] + pieces.length[mine][-1])
        chosen = np.flatnonzero((rows.node >= at.start) & (rows.node < at.stop))
        part = rows.subset(chosen, rows.node[chosen] - at.start)
        fit = _settled(part, pieces.take(mine), points[at], prior, gate, sudden)
        x[at], covariance[at] = fit.x, fit.covariance
        used[chosen], distance[chosen], residual[chosen] = fit.used, fit.distance, fit.residual
    return PathFit(x, covariance, used, distance, residual, prior)


def _settled(
    rows: Measurements,
    pieces: Pieces,
    points: np.ndarray,
    motion: MotionModel,
    gate: float,
    sudden: bool,
) -> PathFit:
    """Fit with a given prior until no row leaves or returns.

    A sudden flight makes many right rows in a row look wrong; wrong rows are scattered. Pieces from which
    rows leave in a crowd are fitted again with all rows and heavy tails, which forgive a rare large
    innovation. That counts where it spares half of the rows; a group of two animals stays as it was.
    """
    start = starting_path(rows, pieces, points, ~rows.doubtful)
    linear = rows.linearise(start)
    fit = _fit(rows, pieces, start, ~_doubtful(rows, linear[0], points), motion, linear)
    everywhere = np.ones(len(pieces.length), dtype=bool)
    fit = _rounds(fit, rows, pieces, motion, gate, everywhere, _ROUNDS)
    crowded = _crowded(rows.node[~fit.used], pieces)
    if sudden and crowded.any() and not np.isfinite(motion.tails):
        heavy = replace(motion, tails=_TAILS)
        used = fit.used | crowded[pieces.owner[rows.node]]
        other = _refit(fit, rows, pieces, used, crowded, heavy)
        other = _rounds(other, rows, pieces, heavy, gate, crowded, _HEAVY_ROUNDS)
        fit = _better(fit, other, rows, pieces)
    return fit


def _better(fit: PathFit, other: PathFit, rows: Measurements, pieces: Pieces) -> PathFit:
    """Of each piece the other fit if it takes half as many rows for wrong, or fewer."""
    owner, n = pieces.owner, len(pieces.length)
    lost, lost_other = (np.bincount(owner[rows.node[~one.used]], minlength=n) for one in (fit, other))
    take = 2 * lost_other < lost
    at_node, at_row = take[owner], take[owner[rows.node]]

    def pick(key: str, where: np.ndarray) -> np.ndarray:
        mine, theirs = getattr(fit, key), getattr(other, key)
        return np.where(where.reshape(-1, *[1] * (mine.ndim - 1)), theirs, mine)

    nodes = {key: pick(key, at_node) for key in ("x", "covariance")}
    return PathFit(
        motion=fit.motion, **nodes, **{key: pick(key, at_row) for key in ("used", "distance", "residual")}
    )


def _rounds(
    fit: PathFit,
    rows: Measurements,
    pieces: Pieces,
    motion: MotionModel,
    gate: float,
    where: np.ndarray,
    n_rounds: int,
) -> PathFit:
    """Let rows leave and return in some pieces, (S,) bool, until none does."""
    mine = where[pieces.owner[rows.node]]
    for _ in range(n_rounds):
        used = np.where(mine, _judge(fit, rows, pieces, gate), fit.used)
        changed = np.bincount(pieces.owner[rows.node[used != fit.used]], minlength=len(pieces.length)) > 0
        if not changed.any():
            break
        fit = _refit(fit, rows, pieces, used, changed, motion)
    return fit


def _crowded(node: np.ndarray, pieces: Pieces) -> np.ndarray:
    """Pieces (S,) with many of the given nodes (one for each wrong row) within a few frames."""
    total = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=pieces.n_nodes))])
    crowd = total[_CROWD_FRAMES:] - total[:-_CROWD_FRAMES] >= _CROWD
    owner = pieces.owner
    inside = owner[: len(crowd)] == owner[_CROWD_FRAMES - 1 :]
    return np.bincount(owner[: len(crowd)][crowd & inside], minlength=len(pieces.length)) > 0


def _estimated(
    rows: Measurements,
    pieces: Pieces,
    points: np.ndarray,
    gate: float,
    sudden: bool,
    group: np.ndarray | None,
) -> tuple[MotionModel, Pieces]:
    """The prior from windows spread over all pieces; again after wrong rows have left.

    Also the pieces with how agile their animals are, where these are told apart.
    """
    if not pieces.n_nodes:
        return MotionModel(1.0), pieces
    nodes, windows = sample_windows(pieces, np.isfinite(points[:, 0]))
    place = np.full(pieces.n_nodes, -1)
    place[nodes] = np.arange(len(nodes))
    chosen = np.flatnonzero(place[rows.node] >= 0)
    rows, points = rows.subset(chosen, place[rows.node[chosen]]), points[nodes]
    x = starting_path(rows, windows, points, ~rows.doubtful)
    residual, slope = rows.linearise(x)
    used = ~_doubtful(rows, residual, points)
    motion = estimate_motion(x, *rows.information(residual, slope, used, len(x)), windows)
    for _ in range(_ESTIMATES):
        fit = _settled(rows, windows, points, motion, gate, sudden)
        if (fit.used == used).all():
            break
        used, x = fit.used, fit.x
        at_path = rows.information(*rows.linearise(x), used, len(x))
        motion = estimate_motion(x, *at_path, windows, motion)
    if group is None or len(np.unique(group)) == 1:
        return motion, pieces
    at_path = rows.information(*rows.linearise(x), used, len(x))
    owner = group[pieces.owner[nodes[windows.start]]]
    found = estimate_agility(x, *at_path, windows, motion, owner)
    return motion, Pieces(pieces.length, np.array([found.get(int(one), 1.0) for one in group]))


def _doubtful(rows: Measurements, residual: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Rows (P,) that are given as such, or of nodes whose rays pass each other at some distance."""
    n_nodes, met = len(points), np.isfinite(points[:, 0])
    squared = np.nan_to_num((residual**2).sum(1) / rows.variance, nan=np.inf)
    total = np.bincount(rows.node, squared, n_nodes)
    return rows.doubtful | (met & (total > _DOUBT * np.bincount(rows.node, minlength=n_nodes)))[rows.node]


def _judge(fit: PathFit, rows: Measurements, pieces: Pieces, gate: float) -> np.ndarray:
    """Rows (P,) to use next: the worst of each neighbourhood leaves, rows within the gate return."""
    wrong = fit.used & (fit.distance > gate)
    worst = np.full(len(fit.x), -np.inf)
    np.maximum.at(worst, rows.node[wrong], fit.distance[wrong])
    piece = pieces.owner
    around = worst.copy()
    for lag in range(1, _NEIGHBOURS + 1):
        same = piece[lag:] == piece[:-lag]
        around[lag:] = np.where(same, np.maximum(around[lag:], worst[:-lag]), around[lag:])
        around[:-lag] = np.where(same, np.maximum(around[:-lag], worst[lag:]), around[:-lag])
    leave = wrong & (fit.distance >= around[rows.node])
    return (fit.used & ~leave) | (~fit.used & (fit.distance <= gate))


def _fit(
    rows: Measurements,
    pieces: Pieces,
    start: np.ndarray,
    used: np.ndarray,
    motion: MotionModel,
    linear: tuple[np.ndarray, np.ndarray] | None = None,
) -> PathFit:
    x, covariance, residual, slope = improve(rows, used, start, pieces, motion, linear)
    distance = deleted_distance(residual, slope, used, rows.variance, covariance[rows.node])
    return PathFit(x, covariance, used, distance, residual, motion)


def _refit(
    fit: PathFit,
    rows: Measurements,
    pieces: Pieces,
    used: np.ndarray,
    changed: np.ndarray,
    motion: MotionModel,
) -> PathFit:
    """Fit some of the pieces again, (S,) bool, with other rows and another prior.

    What single views see begins on its rays again: a wrong row may have pulled it where no step leads back.
    """
    at_node, at_row = changed[pieces.owner], changed[pieces.owner[rows.node]]
    chosen = np.flatnonzero(at_row)
    new_node = np.cumsum(at_node) - 1
    mine, its = rows.subset(chosen, new_node[rows.node[chosen]]), pieces.take(changed)
    views = np.bincount(mine.node[used[chosen]], minlength=its.n_nodes)
    begin = starting_path(mine, its, np.where(views[:, None] >= 2, fit.x[at_node], np.nan), used[chosen])
    part = _fit(mine, its, begin, used[chosen], motion)
    whole = {key: getattr(fit, key).copy() for key in ("x", "covariance", "distance", "residual")}
    for key in ("x", "covariance"):
        whole[key][at_node] = getattr(part, key)
    for key in ("distance", "residual"):
        whole[key][chosen] = getattr(part, key)
    return PathFit(used=used, motion=fit.motion, **whole)


def improve(
    measurements: Measurements,
    used: np.ndarray,
    x: np.ndarray,
    pieces: Pieces,
    motion: MotionModel,
    linear: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gauss–Newton steps to the most probable paths.

    Single views push their paths away (:mod:`trajectory_depth`). With heavy tails every step also renews the
    weights of the innovations (expectation–maximisation).
    Returns the paths (T, 3), their covariances (T, 3, 3), the residuals (P, 2) and the derivatives (P, 2, 3)
    of the predictions.

    Parameters
    ----------
    measurements : Measurements
        The rows.
    used : (P,) bool
        Rows that count.
    x : (T, 3)
        Where to begin.
    pieces : Pieces
        Which frames hang together.
    motion : MotionModel
        The prior.
    linear : tuple, optional
        What :meth:`Measurements.linearise` gives at x, if it is known.
    """
    sigma = np.sqrt(measurements.variance)
    heavy, weight = np.isfinite(motion.tails), None
    lone = LoneRows(measurements, used, pieces, motion)
    before, length = None, np.ones(len(pieces.length))
    for number in range(_MAX_STEPS):
        residual, slope = linear or measurements.linearise(x)
        linear = None
        cost = _cost(measurements, residual, used, x, pieces, motion)
        cost += np.bincount(pieces.owner[lone.node], lone.cost(slope), len(pieces.length))
        if before is not None and not heavy:
            worse = ~(cost <= before[0] + _WORSE * (1.0 + np.abs(before[0]))) & (length > _SHORTEST)
            if worse.any():  # a shorter step for these paths
                length = np.where(worse, 0.5 * length, length)
                x = np.where(
                    worse[pieces.owner][:, None], before[1] + length[pieces.owner][:, None] * before[2], x
                )
                continue
        information, gradient = measurements.information(residual, slope, used, len(x))
        lone.push(x, slope, information, gradient)
        factor = ChainFactor(information, motion, pieces, weight)
        downhill = gradient - factor.prior_times(x)
        step = factor.solve(downhill)
        before, length = (cost, x, step), np.ones(len(pieces.length))
        gain = np.bincount(pieces.owner, (step * downhill).sum(1), len(pieces.length))
        x = x + step
        moved = (slope * step[measurements.node][:, None]).sum(2)
        covariance, squared = factor.covariance_and_spread() if heavy else (None, None)
        still = not np.nanmax(np.abs(moved) * (used / sigma)[:, None], initial=0.0) > _DONE
        if still and not (gain > _GAIN).any() and not (heavy and number < _MIN_HEAVY):
            break
        if heavy:
            squared += (innovations(motion, pieces, x) ** 2).sum(1)
            weight = tail_weights(motion, pieces, squared)
    if covariance is None:
        covariance = factor.covariance()
    return x, covariance, residual - moved, slope


def _cost(
    measurements: Measurements,
    residual: np.ndarray,
    used: np.ndarray,
    x: np.ndarray,
    pieces: Pieces,
    motion: MotionModel,
) -> np.ndarray:
    """What each path (S,) costs: its rows and its innovations, in units of their variances."""
    squared = np.where(used, (residual**2).sum(1) / measurements.variance, 0.0)
    rows = np.bincount(
        pieces.owner[measurements.node], np.nan_to_num(squared, nan=_BEHIND), len(pieces.length)
    )
    new = (innovations(motion, pieces, x) ** 2).sum(1) / innovation_variances(motion, pieces)
    return rows + np.bincount(pieces.owner, np.where(pieces.age > 0, new, 0.0), len(pieces.length))


def deleted_distance(
    residual: np.ndarray, slope: np.ndarray, used: np.ndarray, variance: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Squared distance (P,) of each row from what all other rows predict, in units of its uncertainty.

    For a row that is used, rᵀ (σ²I − J Σ Jᵀ)⁻¹ r equals the distance from the path without it (deletion
    formula of least squares; Cook and Weisberg 1982, §2.2); else rᵀ (σ²I + J Σ Jᵀ)⁻¹ r. For
    right rows it follows χ² with two degrees of freedom.
    """
    first, second = slope[:, 0], slope[:, 1]
    u, v = ((covariance * side[:, None]).sum(2) for side in (first, second))
    sign = np.where(used, -1.0, 1.0)
    a, b, c = (sign * (left * right).sum(1) for left, right in ((first, u), (second, v), (first, v)))
    a, b = a + variance * (1 + _ALONE), b + variance * (1 + _ALONE)
    det = a * b - c**2
    r0, r1 = residual.T
    quadratic = b * r0**2 - 2 * c * r0 * r1 + a * r1**2
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = quadratic / np.maximum(det, 0.01 * (_ALONE * variance) ** 2)
    return np.where(np.isfinite(distance), distance, np.inf)
