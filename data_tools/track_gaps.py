"""Gaps and jumps in paths, of pixels or of points in space: where to cut, what to fill.

A gap is the number of frames without a point between two points of one individual: 0 for neighbouring frames.
Nothing changes its input. Shapes: T points, D coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from acino_fte.data_tools.tracks2d import BARE
from acino_fte.errors import InputError

_PIECE = "~"  # "0~1": a point would make 0.1 and 0.10 the same number to whoever reads a table


def find_pieces(
    individual: np.ndarray,
    frame: np.ndarray,
    position: np.ndarray,
    *,
    max_distance: float | None = None,
    max_gap: int | None = None,
) -> np.ndarray:
    """Which piece of its individual's path each point belongs to.

    A path ends where the next point is too far or too late: the distance is greater than `max_distance` for
    each frame in between, or the gap is longer than `max_gap`. An animal that was lost for a while may have
    gone further, so the distance alone is not enough.

    Parameters
    ----------
    individual : (T,) int
        −1 belongs to no path, and every such point is piece 0.
    frame : (T,) int
        In any order.
    position : (T, D)
        Pixels or metres.
    max_distance : float, optional
        For each frame, in units of `position`.
    max_gap : int, optional
        Frames without a point.

    Returns
    -------
    (T,) int
        0, 1, … for each individual, in the order of time.
    """
    _check_limits(max_distance, max_gap)
    individual, frame = np.asarray(individual), np.asarray(frame)
    order = np.lexsort((frame, individual))
    new = np.diff(individual[order], prepend=BARE) != 0
    step = np.diff(frame[order], prepend=0)
    cut = np.zeros(len(order), dtype=bool)
    if max_distance is not None and len(order):
        moved = np.diff(np.asarray(position, dtype=float)[order], axis=0)
        cut[1:] |= np.linalg.norm(moved, axis=1) > max_distance * np.maximum(step[1:], 1)
    if max_gap is not None:
        cut |= step - 1 > max_gap
    count = np.cumsum(cut & ~new & (individual[order] != BARE))
    before = np.maximum.accumulate(np.where(new, count, 0))
    piece = np.empty(len(order), dtype=np.int64)
    piece[order] = count - before
    piece[individual == BARE] = 0
    return piece


def interpolate_points(
    individual: np.ndarray, frame: np.ndarray, position: np.ndarray, max_gap: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points on straight lines across short gaps; nothing is added before a path or after it.

    Parameters
    ----------
    individual, frame : (T,) int
        In any order; −1 belongs to no path.
    position : (T, D)
        Pixels or metres.
    max_gap : int
        Longer gaps stay: frames without a point.

    Returns
    -------
    tuple
        individual (T',), frame (T',) and position (T', D), sorted by individual, then frame; and the index of
        the point that each is, −1 for those that were filled in.
    """
    _check_limits(None, max_gap)
    order = np.lexsort((frame, individual))
    who, when, where = individual[order], frame[order], np.asarray(position, dtype=float)[order]
    gap = np.diff(when) - 1
    n_new = np.where((np.diff(who) == 0) & (who[1:] != BARE) & (gap <= max_gap), gap, 0).clip(0)
    before = np.repeat(np.arange(len(n_new)), n_new)
    step = np.arange(len(before)) - np.repeat(np.cumsum(n_new) - n_new, n_new) + 1
    part = (step / (gap[before] + 1))[:, None]
    filled = where[before] * (1 - part) + where[before + 1] * part
    all_who = np.concatenate([who, who[before]])
    all_when = np.concatenate([when, when[before] + step])
    source = np.concatenate([order, np.full(len(before), -1)])
    again = np.lexsort((all_when, all_who))
    return all_who[again], all_when[again], np.concatenate([where, filled])[again], source[again]


def name_pieces(
    individual: np.ndarray, piece: np.ndarray, labels: Sequence[str]
) -> tuple[np.ndarray, tuple[str, ...], np.ndarray]:
    """The number of each row's piece, the names of all pieces, and of which label each is; order is kept."""
    n_pieces = np.ones(len(labels), dtype=np.int64)
    joined = individual != BARE
    np.maximum.at(n_pieces, individual[joined], piece[joined] + 1)
    first = np.cumsum(n_pieces) - n_pieces
    parent = np.repeat(np.arange(len(labels)), n_pieces)
    names = _piece_names(labels, n_pieces)
    number = np.where(joined, np.append(first, 0)[individual] + piece, BARE)
    return number, names, parent


def _piece_names(labels: Sequence[str], n_pieces: np.ndarray) -> tuple[str, ...]:
    """Names of pieces; a name that a label has already is passed over."""
    taken = set(labels)
    names = []
    for label, n in zip(labels, n_pieces, strict=True):
        names.append(label)
        number = 0
        for _ in range(1, int(n)):
            number += 1
            while f"{label}{_PIECE}{number}" in taken:
                number += 1
            names.append(f"{label}{_PIECE}{number}")
    return tuple(names)


def _check_limits(max_distance: float | None, max_gap: int | None) -> None:
    if max_distance is not None and not max_distance >= 0:
        raise InputError(
            "The greatest distance is impossible.",
            key="max_distance",
            expected="≥ 0",
            found=f"{max_distance}",
        )
    if max_gap is not None and not max_gap >= 0:
        raise InputError("The gap is impossible.", key="max_gap", expected="≥ 0", found=f"{max_gap}")
