"""The two ways to match 2D tracks, with one kind of answer: ours, and the thesis's for comparison."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.match_rows import compact
from acino_fte.data_tools.track_dots import Noise
from acino_fte.data_tools.track_matching import TrackMatches
from acino_fte.data_tools.tracks2d import TrackRecording

if TYPE_CHECKING:
    from acino_fte.data_tools.thesis_method import ThesisOptions


def thesis_matches(
    recording: TrackRecording,
    options: ThesisOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> TrackMatches:
    """Match by the thesis's method; there are no confidence, no rivals, no noise and no smoothed paths.

    Parameters
    ----------
    recording : TrackRecording
        Two views or more.
    options : ThesisOptions, optional
        By default the thesis's Set 2.
    progress : callable, optional
        Called with the name of every step.

    Returns
    -------
    TrackMatches
        Groups are numbered anew, in order of their first frames; one that a single view has left is none.
    """
    from acino_fte.data_tools.thesis_method import match_thesis

    (progress or (lambda step: None))("matching")
    groups = _renumbered(recording, match_thesis(recording, options))
    pieces, offset = [], 0
    for view in recording.views:
        pieces.append(np.where(view.track >= 0, view.track + offset, -1))
        offset += len(view.labels)
    return TrackMatches(
        recording,
        tuple(groups),
        tuple(np.full(len(view), np.nan) for view in recording.views),
        tuple(pieces),
        np.full(offset, -1),
        np.zeros(offset),
        Noise(np.nan, np.nan),
    )


def _renumbered(recording: TrackRecording, groups: list[np.ndarray]) -> list[np.ndarray]:
    """Groups of two views or more from 0, by first frame."""
    compacted, n = compact(groups)
    views = np.zeros(n, dtype=int)
    first = np.full(n, np.iinfo(np.int64).max)
    for view, group in zip(recording.views, compacted, strict=True):
        views[np.unique(group[group >= 0])] += 1
        np.minimum.at(first, group[group >= 0], view.frame[group >= 0])
    kept = np.flatnonzero(views >= 2)
    number = np.full(n + 1, -1)  # the last for −1
    number[kept[np.argsort(first[kept], kind="stable")]] = np.arange(len(kept))
    return [number[group] for group in compacted]
