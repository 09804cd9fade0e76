"""Where a track goes from one animal to another, as another view tells it.

A tracker exchanges two animals when they meet, or takes another one up after a gap. In the other views the
track then has one partner before and one after. For each piece, the partner in every frame is found by
dynamic programming (Viterbi 1967): a dot of the partner within reach earns `chance − ½ (d/σ)²`, a dot beyond
it costs ½ reach², a partner that is not seen says nothing, having none earns nothing, and every change costs
as much as the evidence asked for. A piece is cut where the best partner changes.
"""

from __future__ import annotations

import numpy as np

from acino_fte.data_tools.track_dots import Dots, Noise
from acino_fte.data_tools.track_evidence import REACH, log_chance, near_dots
from acino_fte.data_tools.track_memory import memories
from acino_fte.data_tools.track_pieces import belongs

CHANGE = 12.0
"""Log-odds that a change of partner must bring."""
_PARTNERS = 12


def find_changes(
    pair: tuple[Dots, Dots], side: int, noise: Noise, doubtful: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Frames at which doubtful pieces of one view change their partner in another.

    Parameters
    ----------
    pair : (Dots, Dots)
        The two views, in the order of their plane angles.
    side : {0, 1}
        The view to look at.
    noise : Noise
        Of a dot's coordinate.
    doubtful : (K,) bool
        Pieces of it to look at.

    Returns
    -------
    piece, frame : (E,) int
        The frame is the first after the change.
    """
    a, b = pair[side], pair[1 - side]
    rows = np.flatnonzero(belongs(a.piece, doubtful) & np.isfinite(a.angles.angle))
    rows = rows[np.argsort(a.piece[rows], kind="stable")]
    pieces = np.unique(a.piece[rows])
    start = np.searchsorted(a.piece[rows], pieces)
    stop = np.searchsorted(a.piece[rows], pieces, side="right")
    chosen = np.zeros(len(a.frame), dtype=bool)
    chosen[rows] = True
    near = [_of_chosen(chunk, side, chosen) for chunk in near_dots(*pair, REACH * noise.total)]
    if not near or not len(pieces):
        return np.empty(0, dtype=int), np.empty(0, dtype=int)
    i, j, d = (np.concatenate(part) for part in zip(*near, strict=True))
    gain = log_chance(a, b, noise.total) / np.maximum(memories(a, noise.total), 1.0)
    place = np.empty(len(a.frame), dtype=np.int64)  # of a row within its piece
    place[rows] = np.arange(len(rows)) - np.repeat(start, stop - start)
    there = _presence(b)
    by_piece = np.argsort(a.piece[i], kind="stable")
    i, j, d = i[by_piece], j[by_piece], d[by_piece]
    low = np.searchsorted(a.piece[i], pieces)
    high = np.searchsorted(a.piece[i], pieces, side="right")
    found_piece, found_frame = [], []
    for k, piece in enumerate(pieces.tolist()):
        part = slice(low[k], high[k])
        frames = a.frame[rows[start[k] : stop[k]]]
        score = _score(b.piece[j[part]], place[i[part]], d[part], frames, there, gain[piece], noise)
        path = _best_path(score)
        changes = np.flatnonzero(path[1:] != path[:-1]) + 1
        found_piece.append(np.full(len(changes), piece))
        found_frame.append(frames[changes])
    return np.concatenate(found_piece), np.concatenate(found_frame)


def _of_chosen(chunk, side: int, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Near dots of a chunk whose end on one side is chosen; that end first."""
    _, _, i, j, d = chunk
    mine, other = (i, j) if side == 0 else (j, i)
    keep = chosen[mine]
    return mine[keep], other[keep], d[keep]


def _presence(dots: Dots) -> np.ndarray:
    """(pieces, frames) whether a piece has a usable dot."""
    there = np.zeros((dots.n_pieces, int(dots.frame.max(initial=0)) + 1), dtype=bool)
    rows = np.flatnonzero((dots.piece >= 0) & np.isfinite(dots.angles.angle))
    there[dots.piece[rows], dots.frame[rows]] = True
    return there


def _score(partner, place, d, frames, there, gain: float, noise: Noise) -> np.ndarray:
    """Evidence of each partner in each frame of one piece, (n, K + 1); the last column is for none."""
    names, local, count = np.unique(partner, return_inverse=True, return_counts=True)
    best = np.argsort(-count, kind="stable")[:_PARTNERS]
    column = np.full(len(names), -1)
    column[best] = np.arange(len(best))
    inside = frames < there.shape[1]
    present = np.zeros((len(frames), len(best)), dtype=bool)
    present[inside] = there[names[best]][:, frames[inside]].T
    score = np.zeros((len(frames), len(best) + 1))
    score[:, :-1] = np.where(present, -0.5 * REACH**2, 0.0)
    keep = column[local] >= 0
    score[place[keep], column[local[keep]]] = gain - 0.5 * (d[keep] / noise.total) ** 2
    return score


def _best_path(score: np.ndarray) -> np.ndarray:
    """Column of the best path through (n, K) scores with a price on every change, (n,)."""
    n, k = score.shape
    came = np.empty((n, k), dtype=np.int64)
    stay = np.arange(k)
    total = score[0].copy()
    for t in range(1, n):
        best = int(total.argmax())
        moved = total[best] - CHANGE > total
        came[t] = np.where(moved, best, stay)
        total = np.where(moved, total[best] - CHANGE, total) + score[t]
    path = np.empty(n, dtype=np.int64)
    path[-1] = int(total.argmax())
    for t in range(n - 1, 0, -1):
        path[t - 1] = came[t, path[t]]
    return path
