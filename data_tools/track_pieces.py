"""Tracks of one view in pieces that hold one animal each, as far as can be known.

A piece begins as a track of the tracker. Where the other views contradict it, it is cut at its encounters:
the frames in which another dot of the same view comes so close that a tracker may have exchanged the two. The
dots inside an encounter belong to no piece.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from acino_fte.data_tools.track_links import ViewPieces

_MISSED = 3


@dataclass(frozen=True, eq=False)
class PiecedView:
    """The dots of one view, sorted by frame, and the piece each belongs to.

    Attributes
    ----------
    order : (P,) int
        Row of the input of each dot.
    frame : (P,) int
        From 0.
    xy : (P, 2)
        px.
    piece : (P,) int
        −1 for a dot in no piece.
    n_pieces : int
    """

    order: np.ndarray
    frame: np.ndarray
    xy: np.ndarray
    piece: np.ndarray
    n_pieces: int

    def by_piece(self) -> ViewPieces:
        """The dots of all pieces, sorted by piece and frame."""
        rows = np.flatnonzero(self.piece >= 0)
        rows = rows[np.argsort(self.piece[rows], kind="stable")]
        start = np.searchsorted(self.piece[rows], np.arange(self.n_pieces + 1))
        return ViewPieces(self.frame[rows], self.xy[rows], start)


def belongs(piece: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Whether each dot's piece (P,) is one of the chosen (K,) bool; False for dots in no piece."""
    if not len(chosen):
        return np.zeros(len(piece), dtype=bool)
    return (piece >= 0) & chosen[piece]


def pieced(frame: np.ndarray, track: np.ndarray, xy: np.ndarray) -> PiecedView:
    """Whole tracks as pieces; a bare point is in no piece."""
    order = np.argsort(frame, kind="stable")
    _, piece = np.unique(np.where(track < 0, -1, track)[order], return_inverse=True)
    if (track < 0).any():
        piece = piece - 1
    return PiecedView(order, frame[order], xy[order], piece, int(piece.max(initial=-1)) + 1)


def cut_at_encounters(view: PiecedView, doubtful: np.ndarray, radius: float) -> PiecedView:
    """Cut some pieces wherever another dot comes near; dots inside an encounter are in no piece then.

    A dot that was missed for a few frames is taken to be between its neighbours.

    Parameters
    ----------
    view : PiecedView
        Before.
    doubtful : (K,) bool
        Pieces to cut.
    radius : float
        What is near, px.
    """
    rows = np.flatnonzero(belongs(view.piece, doubtful))
    if not len(rows):
        return view
    rows = rows[np.argsort(view.piece[rows], kind="stable")]
    met = _has_company(view, rows, radius)
    other_piece = np.r_[True, view.piece[rows][1:] != view.piece[rows][:-1]]
    return _renumbered(view, rows, np.cumsum(other_piece | np.r_[True, met[1:] != met[:-1]]), met)


def cut_at(view: PiecedView, piece: np.ndarray, frame: np.ndarray) -> PiecedView:
    """Cut pieces in two, each before a frame.

    Parameters
    ----------
    view : PiecedView
        Before.
    piece, frame : (K,) int
        What to cut and where; a piece may appear more than once.
    """
    rows = np.flatnonzero(np.isin(view.piece, piece))
    if not len(rows):
        return view
    rows = rows[np.argsort(view.piece[rows], kind="stable")]
    span = int(view.frame.max()) + 1
    key = view.piece[rows].astype(np.int64) * span + view.frame[rows]
    cuts = np.searchsorted(np.sort(piece.astype(np.int64) * span + frame), key, side="right")
    other = np.r_[True, (view.piece[rows][1:] != view.piece[rows][:-1]) | (cuts[1:] != cuts[:-1])]
    return _renumbered(view, rows, np.cumsum(other), np.zeros(len(rows), dtype=bool))


def _renumbered(view: PiecedView, rows: np.ndarray, part: np.ndarray, left_out: np.ndarray) -> PiecedView:
    """The view with new pieces, numbered from 0 without gaps."""
    piece = view.piece.copy()
    piece[rows] = np.where(left_out, -1, view.n_pieces + part)
    kept, renumbered = np.unique(piece[piece >= 0], return_inverse=True)
    piece[piece >= 0] = renumbered
    return PiecedView(view.order, view.frame, view.xy, piece, len(kept))


def _has_company(view: PiecedView, rows: np.ndarray, radius: float) -> np.ndarray:
    """Whether each row has another dot within the radius, or would have, had it not been missed."""
    frame, xy = _with_missed(view)
    tree = cKDTree(np.column_stack([frame * (4.0 * radius), xy]))
    query = np.column_stack([view.frame[rows] * (4.0 * radius), view.xy[rows]])
    distance, _ = tree.query(query, k=2, distance_upper_bound=radius)
    return np.isfinite(distance[:, 1])


def _with_missed(view: PiecedView) -> tuple[np.ndarray, np.ndarray]:
    """Frames and places of all dots, with short gaps of the pieces filled along straight lines."""
    pieces = view.by_piece()
    piece = np.repeat(np.arange(pieces.n), np.diff(pieces.start))
    step = np.diff(pieces.frame)
    gaps = np.flatnonzero((piece[1:] == piece[:-1]) & (step > 1) & (step <= _MISSED + 1))
    before = np.repeat(gaps, step[gaps] - 1)
    k = np.arange(len(before)) - np.repeat(np.cumsum(step[gaps] - 1) - (step[gaps] - 1), step[gaps] - 1) + 1
    share = (k / step[before])[:, None]
    between = pieces.xy[before] * (1 - share) + pieces.xy[before + 1] * share
    return np.r_[view.frame, pieces.frame[before] + k], np.vstack([view.xy, between])
