"""3D paths drop the dots that do not belong to them, and claim loose ones.

A dot that lies further from what all other dots of its animal predict than noise allows leaves it. A dot that no
animal has, because a detector lost it in an encounter or its piece was too short to decide, goes to the animal
whose path runs through it: with the squared distance z from the predicted pixel, the determinant |S| of its
covariance and the density ρ of loose dots, the odds of the pair are exp(−z/2)/(2π √|S| ρ); in every frame and view
the claims are settled together, and one that another claim makes uncertain is left.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.trajectories3d import Trajectories, smooth_trajectories
from acino_fte.data_tools.trajectory_rows import ViewRows

if TYPE_CHECKING:
    from acino_fte.data_tools.track_matching import TrackMatches

_GATE = 16.0
_MOST_TO_FRAME = 4096


def claim_loose_dots(matches: TrackMatches, max_gap: int) -> TrackMatches:
    """The matching after its 3D paths had their say, with the paths.

    Parameters
    ----------
    matches : TrackMatches
    max_gap : int
        Longest gap that a path bridges, frames.
    """
    paths = _paths(matches, max_gap)
    dropped = _without_wrong(matches, paths)
    claimed = _with_claims(dropped, paths)
    if any(not np.array_equal(a, b) for a, b in zip(matches.groups, claimed.groups, strict=True)):
        paths = _paths(claimed, max_gap)
        claimed = _without_wrong(claimed, paths)
    return replace(claimed, trajectories=paths)


def _paths(matches: TrackMatches, max_gap: int) -> Trajectories:
    recording = matches.recording
    views = [
        ViewRows(view.frame, view.xy, group)
        for view, group in zip(recording.views, matches.groups, strict=True)
    ]
    return smooth_trajectories(
        recording.cameras,
        views,
        matches.noise.total,
        max_gap=max_gap,
        first_frame=recording.first_frame,
    )


def _without_wrong(matches: TrackMatches, paths: Trajectories) -> TrackMatches:
    groups = tuple(np.where(w, -1, g) for w, g in zip(paths.wrong, matches.groups, strict=True))
    sure = tuple(np.where(w, np.nan, c) for w, c in zip(paths.wrong, matches.confidence, strict=True))
    return replace(matches, groups=groups, confidence=sure)


def _with_claims(matches: TrackMatches, paths: Trajectories) -> TrackMatches:
    groups, sure = list(matches.groups), list(matches.confidence)
    for k, view in enumerate(matches.recording.views):
        rows, group, probability = _claims(matches, paths, k)
        better = probability >= 0.9
        groups[k], sure[k] = groups[k].copy(), sure[k].copy()
        groups[k][rows[better]] = group[better]
        sure[k][rows[better]] = probability[better]
        del view
    return replace(matches, groups=tuple(groups), confidence=tuple(sure))


def _claims(matches: TrackMatches, paths: Trajectories, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loose rows of view k, the path that each goes to and the probability."""
    view, group, camera = matches.recording.views[k], matches.groups[k], matches.recording.cameras[k]
    loose = np.flatnonzero(group < 0)
    taken = np.unique(group[group >= 0] * np.int64(1 << 40) + view.frame[group >= 0])
    point = np.arange(len(paths))
    free = ~np.isin(paths.group * np.int64(1 << 40) + paths.frame, taken)
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
    determinant = np.linalg.det(covariance)
    solved = np.linalg.solve(covariance[inverse], miss[..., None])[..., 0]
    squared = (miss * solved).sum(1)
    near = squared < _GATE
    row, at, squared, inverse = row[near], at[near], squared[near], inverse[near]
    area = float(np.prod(np.ptp(view.xy, axis=0) + 1.0))
    density = max(len(loose), 1) / max(len(np.unique(view.frame)), 1) / area
    odds = np.exp(-0.5 * squared) / (2 * np.pi * np.sqrt(determinant[inverse]) * density)
    total = 1.0 + np.bincount(row, weights=odds, minlength=len(view))[row]
    other = 1.0 + np.bincount(at, weights=odds, minlength=len(paths))[at]
    probability = odds / (total + other - 1.0 - odds)
    best = np.argsort(-probability, kind="stable")
    _, first = np.unique(row[best], return_index=True)
    best = best[np.sort(first)]
    _, first = np.unique(at[best], return_index=True)
    best = best[np.sort(first)]
    return row[best], paths.group[at[best]], probability[best]


def _same_frame(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of entries with one frame."""
    order = np.argsort(b, kind="stable")
    low = np.searchsorted(b[order], a)
    count = np.searchsorted(b[order], a, side="right") - low
    i = np.repeat(np.arange(len(a)), count)
    return i, order[np.arange(count.sum()) + np.repeat(low - np.cumsum(count) + count, count)]
