"""For how long does one look at an animal last? The memory of a piece of track.

Two animals that are near one plane by chance stay near it until one of them moves. The memory L of a piece is
the lag, in frames, after which it has left its plane by two standard deviations of the noise: from the mean
squared change of θ over lags 1, 2, 4 …, in px, less the noise's own 2σ². Members of a flock leave a plane
together, so the memory is no shorter than that of the angle *between* the piece and those next to it in the
view.
"""

from __future__ import annotations

import numpy as np

from acino_fte.data_tools.track_dots import Dots, usable_rows

_NEIGHBOURS = (-2, -1, 1, 2)


def memories(dots: Dots, noise: float) -> np.ndarray:
    """L of each piece, (pieces,) frames; no more than its number of dots.

    Parameters
    ----------
    dots : Dots
        Of one view.
    noise : float
        σ, px.
    """
    rows = usable_rows(dots)
    rows = rows[np.lexsort((dots.frame[rows], dots.piece[rows]))]
    piece, frame = dots.piece[rows], dots.frame[rows]
    angle, slope = dots.angles.angle[rows], dots.angles.slope[rows]
    n_dots = np.bincount(piece, minlength=dots.n_pieces).astype(float)
    alone = _decay(piece, frame, angle, slope, noise, dots.n_pieces)
    together = np.ones(dots.n_pieces)
    for step in _NEIGHBOURS:
        i, j = _beside(piece, frame, angle, step, dots.n_pieces)
        between = angle[i] - angle[j]
        lasting = _decay(piece[i], frame[i], between, np.hypot(slope[i], slope[j]), noise, dots.n_pieces)
        shared = np.bincount(piece[i], minlength=dots.n_pieces)
        together = np.maximum(together, np.where(2 * shared >= n_dots, lasting, 1.0))
    return np.minimum(np.maximum(alone, together), np.maximum(n_dots, 1.0))


def _beside(
    piece: np.ndarray, frame: np.ndarray, angle: np.ndarray, step: int, n_pieces: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of every piece and of the one that is `step` places beside it in its middle frame, frame by frame.

    Rows are sorted by piece and frame.
    """
    count = np.bincount(piece, minlength=n_pieces)
    middle = np.cumsum(count) - count + count // 2
    order = np.lexsort((angle, frame))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    some = np.flatnonzero(count > 0)
    beside = place[middle[some]] + step
    inside = (beside >= 0) & (beside < len(order))
    some, beside = some[inside], order[beside[inside]]
    same = frame[beside] == frame[middle[some]]
    partner = np.full(n_pieces, -1)
    partner[some[same]] = piece[beside[same]]
    span = np.int64(frame.max(initial=0) + 1)
    key = piece * span + frame
    i = np.flatnonzero(partner[piece] >= 0)
    wanted = partner[piece[i]] * span + frame[i]
    j = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    there = key[j] == wanted
    return i[there], j[there]


def _decay(
    piece: np.ndarray, frame: np.ndarray, angle: np.ndarray, slope: np.ndarray, noise: float, n_pieces: int
) -> np.ndarray:
    """Lag after which an angle has left its place, (pieces,), at most the number of rows; sorted rows."""
    n_rows = np.maximum(np.bincount(piece, minlength=n_pieces), 1).astype(float)
    memory = n_rows.copy()
    undecided = np.ones(n_pieces, dtype=bool)
    before = np.zeros(n_pieces)
    lag = 1
    while lag < len(piece) and undecided.any():
        same = (piece[lag:] == piece[:-lag]) & (frame[lag:] - frame[:-lag] <= 2 * lag)
        owner = piece[lag:][same]
        turn = angle[lag:][same] - angle[:-lag][same]
        change = (turn - 2 * np.pi * np.round(turn / (2 * np.pi))) / slope[lag:][same]
        count = np.bincount(owner, minlength=n_pieces)
        mean = np.bincount(owner, weights=change**2, minlength=n_pieces) / np.maximum(count, 1)
        moved = np.sqrt(np.maximum(mean - 2 * noise**2, 0.0)) / (2 * noise)
        left = undecided & (count > 0) & (moved >= 1.0)
        share = (1.0 - before[left]) / np.maximum(moved[left] - before[left], 1e-9)
        memory[left] = np.maximum((1.0 + share) * lag / 2, 1.0) if lag > 1 else 1.0
        undecided &= ~left & (count > 0)
        before = moved
        lag *= 2
    return np.minimum(memory, n_rows)
