"""3D paths drop the dots that do not belong to them, and claim loose ones.

A piece of track that lies further from what all other dots of its animal predict than noise allows leaves it;
the paths of one animal on both sides of a gap are joined (:mod:`track_joins`). A dot that no animal has,
because a detector lost it in an encounter or its piece was too short to decide, goes to the animal whose path
runs through it: with the squared distance z from the predicted pixel, the determinant |S| of its covariance
and the density ρ of loose dots, the odds of the pair are exp(−z/2)/(2π √|S| ρ) times the odds
that a place without a dot has one among the loose ones at all, which the recording tells. In every frame and
view the claims are settled together, and one that another claim makes uncertain is left.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from acino_fte.data_tools.track_dots import runs
from acino_fte.data_tools.track_joins import join_paths
from acino_fte.data_tools.trajectories3d import SOURCES, Trajectories, smooth_trajectories
from acino_fte.data_tools.trajectory_rows import ViewRows

if TYPE_CHECKING:
    from acino_fte.data_tools.track_matching import TrackMatches
    from acino_fte.data_tools.trajectory_motion import MotionModel

_GATE = 16.0
_BEYOND = 8
_NEVER = 1e3
_SPAN = np.int64(1 << 40)  # more than the frames of any recording
_SURE = 0.9
_EM_STEPS = 30
_MOST_ROUNDS, _FEW = 12, 0.003


def claim_loose_dots(matches: TrackMatches, max_gap: int) -> TrackMatches:
    """The matching after its 3D paths had their say, with the paths.

    Parameters
    ----------
    matches : TrackMatches
        Before.
    max_gap : int
        Longest gap that a path bridges, frames.
    """
    n_rows = sum(len(view) for view in matches.recording.views)
    for _ in range(_MOST_ROUNDS):
        paths = _paths(matches, max_gap, min(max_gap, _BEYOND))
        kept = _without_strangers(matches, paths)
        group = np.append(join_paths(paths, kept, max_gap), -1)
        claimed = _with_claims(kept, paths)
        joined = _joined(kept, claimed, group)
        won = sum(int((a != b).sum()) for a, b in zip(kept.groups, claimed.groups, strict=True))
        same = all(np.array_equal(a, b) for a, b in zip(matches.groups, joined.groups, strict=True))
        matches = joined
        if won <= _FEW * n_rows:
            break
    tidy = _numbered(matches)
    same &= tidy is matches
    paths = _without_extension(paths) if same else _paths(tidy, max_gap, motion=paths.motion)
    return replace(tidy, trajectories=paths)


def _numbered(matches: TrackMatches) -> TrackMatches:
    """Groups that one view alone is left of are none; the others in the order of their first frames."""
    n = matches.n_groups
    views, first = np.zeros(n, dtype=int), np.full(n, np.iinfo(np.int64).max)
    for view, group in zip(matches.recording.views, matches.groups, strict=True):
        rows = group >= 0
        views[np.unique(group[rows])] += 1
        np.minimum.at(first, group[rows], view.frame[rows])
    kept = np.flatnonzero(views >= 2)
    number = np.full(n + 1, -1)  # the last one for no group
    number[kept[np.argsort(first[kept], kind="stable")]] = np.arange(len(kept))
    if np.array_equal(number[:n], np.arange(n)):
        return matches
    groups = tuple(number[group] for group in matches.groups)
    sure = tuple(np.where(g >= 0, c, np.nan) for g, c in zip(groups, matches.confidence, strict=True))
    rival = number[matches.rival]
    likely = np.where(rival >= 0, matches.rival_probability, 0.0)
    return replace(matches, groups=groups, confidence=sure, rival=rival, rival_probability=likely)


def _joined(before: TrackMatches, claimed: TrackMatches, group: np.ndarray) -> TrackMatches:
    """Groups under their new numbers; a claim yields to a dot that the joined group has there already."""
    groups, sure = [], []
    for k, view in enumerate(claimed.recording.views):
        old, new = group[before.groups[k]], group[claimed.groups[k]]
        won = np.flatnonzero((old < 0) & (new >= 0))
        held = new[old >= 0] * _SPAN + view.frame[old >= 0]
        key = new[won] * _SPAN + view.frame[won]
        order = np.argsort(-claimed.confidence[k][won], kind="stable")
        twice = np.ones(len(won), dtype=bool)
        twice[order[np.unique(key[order], return_index=True)[1]]] = False
        yields = won[twice | np.isin(key, held)]
        new[yields] = -1
        groups.append(new)
        confidence = claimed.confidence[k].copy()
        confidence[yields] = np.nan
        sure.append(confidence)
    return replace(claimed, groups=tuple(groups), confidence=tuple(sure), rival=group[claimed.rival])


def _paths(
    matches: TrackMatches, max_gap: int, extend: int = 0, motion: MotionModel | None = None
) -> Trajectories:
    recording = matches.recording
    views = [
        ViewRows(view.frame, view.xy, group)
        for view, group in zip(recording.views, matches.groups, strict=True)
    ]
    return smooth_trajectories(
        recording.cameras,
        views,
        matches.noise.total,
        motion=motion,
        max_gap=max_gap,
        extend=extend,
        first_frame=recording.first_frame,
    )


def _without_extension(paths: Trajectories) -> Trajectories:
    """The paths without the frames beyond their ends."""
    inside = paths.source != SOURCES.index("extended")
    names = ("group", "frame", "piece", "position", "covariance", "source", "n_views", "reprojection")
    return replace(paths, **{name: getattr(paths, name)[inside] for name in names})


def _without_strangers(matches: TrackMatches, paths: Trajectories) -> TrackMatches:
    """Pieces most of whose dots are not on their group's path leave it.

    A tracker's piece was cut wherever another view contradicts it, so its dots are of one animal; a few of
    them off the path tell of a sudden turn. Dots in no piece were claimed one by one, and leave one by one.
    """
    n = len(matches.rival)
    off, all_ = np.zeros(n + 1), np.zeros(n + 1)
    for piece, wrong, group in zip(matches.pieces, paths.wrong, matches.groups, strict=True):
        off += np.bincount(piece[(group >= 0) & wrong] + 1, minlength=n + 1)
        all_ += np.bincount(piece[group >= 0] + 1, minlength=n + 1)
    stranger = off > 0.5 * all_
    groups, sure = [], []
    parts = zip(matches.pieces, paths.wrong, matches.groups, matches.confidence, strict=True)
    for piece, wrong, group, confidence in parts:
        leaves = np.where(piece < 0, wrong, stranger[piece + 1])
        groups.append(np.where(leaves, -1, group))
        sure.append(np.where(leaves, np.nan, confidence))
    return replace(matches, groups=tuple(groups), confidence=tuple(sure))


def _with_claims(matches: TrackMatches, paths: Trajectories) -> TrackMatches:
    groups, sure = list(matches.groups), list(matches.confidence)
    for k in range(len(groups)):
        rows, group, probability = _claims(matches, paths, k)
        better = probability >= _SURE
        groups[k], sure[k] = groups[k].copy(), sure[k].copy()
        groups[k][rows[better]] = group[better]
        sure[k][rows[better]] = probability[better]
    return replace(matches, groups=tuple(groups), confidence=tuple(sure))


def _claims(matches: TrackMatches, paths: Trajectories, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loose rows of view k, the path that each goes to and the probability."""
    view, group, camera = matches.recording.views[k], matches.groups[k], matches.recording.cameras[k]
    loose = np.flatnonzero(group < 0)
    taken = np.unique(group[group >= 0] * _SPAN + view.frame[group >= 0])
    point = np.arange(len(paths))
    free = ~np.isin(paths.group * _SPAN + paths.frame, taken)
    point = point[free]
    row, at = _same_frame(view.frame[loose], paths.frame[point])
    row, at = loose[row], point[at]
    empty = np.empty(0, dtype=np.int64)
    if not len(row):
        return empty, empty, np.empty(0)
    used, inverse = np.unique(at, return_inverse=True)
    pixels, covariance = paths.predict_pixels(camera, paths.group[used], paths.frame[used])
    covariance = covariance + matches.noise.total**2 * np.eye(2)
    miss = view.xy[row] - pixels[inverse]
    known = np.isfinite(pixels).all(1) & np.isfinite(covariance).all((1, 2))  # not behind the camera
    covariance[~known] = np.eye(2)
    determinant = np.linalg.det(covariance)
    solved = np.linalg.solve(covariance[inverse], miss[..., None])[..., 0]
    squared = (miss * solved).sum(1)
    near = (squared < _GATE) & known[inverse]
    row, at, squared, inverse = row[near], at[near], squared[near], inverse[near]
    area = float(np.prod(np.ptp(view.xy, axis=0) + 1.0))
    density = max(len(loose), 1) / max(len(np.unique(view.frame)), 1) / area
    ratio = np.exp(-0.5 * squared) / (2 * np.pi * np.sqrt(determinant[inverse]) * density)
    beyond = paths.source == SOURCES.index("extended")
    prior = np.zeros(len(row))
    for kind in (beyond, ~beyond):
        claims = kind[at]
        prior[claims] = _log_odds_of_loose(ratio[claims], at[claims], int(kind[point].sum()))
    chosen, probability = _settle(row, at, np.log(ratio) + prior)
    return row[chosen], paths.group[at[chosen]], probability


def _log_odds_of_loose(ratio: np.ndarray, place: np.ndarray, n_places: int) -> float:
    """Log-odds that a place of a path without a dot has one among the loose, by expectation–maximisation.

    Where a detector misses animals and sees clutter there is none to be claimed; after an encounter there is.

    Parameters
    ----------
    ratio : (E,)
        Likelihood ratio of each claim against a chance dot.
    place : (E,) int
        Path point of each claim.
    n_places : int
        Path points without a dot in this view.
    """
    _, which = np.unique(place, return_inverse=True)
    total = np.bincount(which, weights=ratio)
    share = 0.5
    for _ in range(_EM_STEPS):
        found = share * total / (1.0 - share + share * total)
        share = (found.sum() + 0.5) / (n_places + 1.0)
    return float(np.log(share) - np.log1p(-share))


def _settle(row: np.ndarray, point: np.ndarray, odds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Claims (E) settled together: the chosen ones, and their probabilities.

    The sum of the log-odds is made largest. The alternatives to a claim are none, another point or another
    row for it, and an exchange with another claim.
    """
    rows, i = np.unique(row, return_inverse=True)
    points, j = np.unique(point, return_inverse=True)
    n = len(rows)
    _, component = connected_components(
        coo_array((np.ones(len(i)), (i, j + n)), shape=(n + len(points), n + len(points))), directed=False
    )
    part = component[i]
    alone = np.bincount(part)[part] == 1
    probability = np.zeros(len(i))
    probability[alone] = 1.0 / (1.0 + np.exp(-odds[alone]))
    order = np.argsort(part, kind="stable")
    order = order[~alone[order]]
    bounds = np.flatnonzero(np.r_[True, np.diff(part[order]) > 0, True]) if len(order) else np.zeros(1, int)
    for low, high in zip(bounds[:-1], bounds[1:], strict=True):
        e = order[low:high]
        _, r = np.unique(i[e], return_inverse=True)
        _, c = np.unique(j[e], return_inverse=True)
        probability[e] = _settle_together(r, c, odds[e])
    chosen = np.flatnonzero(probability > 0)
    return chosen, probability[chosen]


def _settle_together(r: np.ndarray, c: np.ndarray, odds: np.ndarray) -> np.ndarray:
    """Probabilities of the claims of the best assignment, 0 for the others."""
    table = np.full((r.max() + 1, c.max() + 1), -_NEVER)
    table[r, c] = odds
    rows, columns = linear_sum_assignment(np.maximum(table, 0.0), maximize=True)
    kept = table[rows, columns] > 0
    rows, columns = rows[kept], columns[kept]
    free_rows, free_columns = np.ones(table.shape[0], dtype=bool), np.ones(table.shape[1], dtype=bool)
    free_rows[rows], free_columns[columns] = False, False
    out = np.zeros(len(r))
    for a, b in zip(rows, columns, strict=True):
        own = table[a, b]
        others = np.concatenate([[0.0], table[a, free_columns], table[free_rows, b]])
        exchange = table[a, columns] + np.maximum(table[rows, b], 0.0) - table[rows, columns]
        against = np.concatenate([others, exchange[rows != a]]) - own
        out[(r == a) & (c == b)] = 1.0 / (1.0 + np.exp(np.minimum(against, 500.0)).sum())
    return out


def _same_frame(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of entries with one frame."""
    order = np.argsort(b, kind="stable")
    low = np.searchsorted(b[order], a)
    count = np.searchsorted(b[order], a, side="right") - low
    i = np.repeat(np.arange(len(a)), count)
    return i, order[runs(low, count)]
