"""Paths of one animal on both sides of a gap, joined in space.

A group ends where all its views lose it, and another begins. Both paths are carried on by their motion prior;
in the frame in the middle of the gap they are at places x_A and x_B with covariances S_A and S_B. With ρ the
rate at which groups begin (1/m³ and frame), the log-odds of their being one animal are

    log N(x_A − x_B; 0, S_A + S_B) − log(ρ · gap)

and, as with pieces of tracks, only those count that stand out against every other continuation of either
path.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.track_dots import runs

if TYPE_CHECKING:
    from acino_fte.data_tools.track_matching import TrackMatches
    from acino_fte.data_tools.trajectories3d import Trajectories

_LEAST = 3.0
_LIKELY = -3.0


def join_paths(paths: Trajectories, matches: TrackMatches, max_gap: int) -> np.ndarray:
    """New number of every group, (G,), from 0 without gaps; joined groups get one number.

    Parameters
    ----------
    paths : Trajectories
        With some frames beyond both ends.
    matches : TrackMatches
        Whose groups the paths are.
    max_gap : int
        Longest gap, frames.
    """
    n = matches.n_groups
    first, last = _spans(matches, n)
    earlier, later = _candidates(first, last, max_gap)
    odds = _log_odds(paths, earlier, later, first, last)
    likely = odds > _LIKELY
    earlier, later, odds = earlier[likely], later[likely], odds[likely]
    margin = odds - np.maximum(_others(earlier, odds, n), _others(later, odds, n))
    label = np.arange(n)
    for e in np.argsort(-margin, kind="stable"):
        if margin[e] <= _LEAST:
            break
        label[label == label[later[e]]] = label[earlier[e]]
    return np.unique(label, return_inverse=True)[1]


def _spans(matches: TrackMatches, n: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last frame of each group in each view, (C, G); a view without it does not limit."""
    views = matches.recording.views
    first = np.full((len(views), n), np.iinfo(np.int64).max)
    last = np.full((len(views), n), np.iinfo(np.int64).min)
    for k, (view, group) in enumerate(zip(views, matches.groups, strict=True)):
        rows = group >= 0
        np.minimum.at(first[k], group[rows], view.frame[rows])
        np.maximum.at(last[k], group[rows], view.frame[rows])
    return first, last


def _candidates(first: np.ndarray, last: np.ndarray, max_gap: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of groups of which one has left every view before the other comes into it."""
    begin, end = first.min(0), last.max(0)
    order = np.argsort(begin, kind="stable")
    low = np.searchsorted(begin[order], end - max_gap)
    count = np.searchsorted(begin[order], end + max_gap, side="right") - low
    earlier = np.repeat(np.arange(len(end)), count)
    later = order[runs(low, count)]
    apart = (last[:, earlier] < first[:, later]).all(0) & (begin[earlier] < begin[later])
    return earlier[apart], later[apart]


def _log_odds(
    paths: Trajectories, earlier: np.ndarray, later: np.ndarray, first: np.ndarray, last: np.ndarray
) -> np.ndarray:
    """Log-odds of each pair against a group that begins there by chance; −∞ where the paths do not reach."""
    odds = np.full(len(earlier), -np.inf)
    begin, end = first.min(0), last.max(0)
    middle = (end[earlier] + begin[later]) // 2
    a, b = paths.find(earlier, middle), paths.find(later, middle)
    good = np.flatnonzero((a >= 0) & (b >= 0))
    if not len(good):
        return odds
    a, b = a[good], b[good]
    covariance = paths.covariance[a] + paths.covariance[b]
    miss = paths.position[a] - paths.position[b]
    squared = (miss * np.linalg.solve(covariance, miss[..., None])[..., 0]).sum(1)
    density = -0.5 * (squared + np.log(np.linalg.det(2 * np.pi * covariance)))
    low, high = np.percentile(paths.position, [2, 98], axis=0)
    frames = float(end.max() - begin.min() + 1)
    rate = len(begin) / (float(np.prod(high - low + 1e-9)) * frames)
    gap = np.maximum(np.abs(begin[later] - end[earlier])[good], 1)
    odds[good] = density - np.log(rate * gap)
    return odds


def _others(who: np.ndarray, odds: np.ndarray, n: int) -> np.ndarray:
    """Log of one (no continuation) and the odds of all other pairs of the same group, (E,)."""
    bounded = np.exp(np.minimum(odds, 500.0))
    rest = np.bincount(who, weights=bounded, minlength=n)[who] - bounded
    return np.log1p(np.maximum(rest, 0.0))
