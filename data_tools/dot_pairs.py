"""Bare dots of several views joined to pieces of track together, as points in space.

Where animals step as far as they are apart, one view cannot tell which dot is the next one
(:mod:`dot_linking`). Two views can: dots of one frame that lie near one plane of the pencil are a possible
pair, a point in space (:mod:`pair_candidates`). Of the pairs some are animals, more are chance; but space is
wide, and a chance pair hardly ever continues. Which pairs are real, and how they follow one another, is
settled together (:mod:`pair_beliefs`); how they move is learnt from the recording (:mod:`pair_motion`).
Shapes: P dots of a view, K pairs sorted by frame, E links.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.pair_beliefs import PairBeliefs, PairModel
from acino_fte.data_tools.pair_candidates import Pairs, find_pairs, pair_displacement
from acino_fte.data_tools.pair_motion import first_motion

SURE = 0.95
_ROUNDS, _EXCHANGES, _LAST_EXCHANGES = 3, 6, 10
_LEARN_FROM, _BLOCK, _MARGIN = 3_000, 30_000, 8  # pairs, pairs, frames


def link_jointly(
    cameras: CameraArray,
    frames: Sequence[np.ndarray],
    xys: Sequence[np.ndarray],
    noise_px: float,
    max_gap: int = 3,
    sure: float = SURE,
) -> list[np.ndarray]:
    """Pieces of track from the dots of all views, pair of views by pair of views.

    Parameters
    ----------
    cameras : CameraArray
        Fixed or moving.
    frames : (P,) int of each view
        Row of the poses of each dot, in any order.
    xys : (P, 2) of each view
        px.
    noise_px : float
        Standard deviation of a dot's coordinate, px.
    max_gap : int
        Longest gap that a link bridges, frames from dot to dot.
    sure : float
        Least probability of a link.

    Returns
    -------
    list of (P,) int
        For each view: the piece of every dot, from 0; −1 for a dot that joins nothing.
    """
    order = [np.argsort(frame, kind="stable") for frame in frames]
    frames = [np.asarray(f)[o].astype(np.int64) for f, o in zip(frames, order, strict=True)]
    xys = [np.asarray(x, dtype=float)[o] for x, o in zip(xys, order, strict=True)]
    found: list[list[tuple[np.ndarray, ...]]] = [[] for _ in frames]
    for a, b in combinations(range(len(frames)), 2):
        pairs = find_pairs(cameras, (a, b), (frames[a], frames[b]), (xys[a], xys[b]), noise_px)
        if pairs is None:
            continue
        source, target, probability = _pair_links(pairs, max_gap)
        for side, k in enumerate((a, b)):
            found[k].append(
                _dot_links(pairs.dots[source, side], pairs.dots[target, side], probability, len(frames[k]))
            )
    out = []
    for k, o in enumerate(order):
        piece = np.full(len(o), -1)
        if found[k]:
            source, target, probability = (np.concatenate(part) for part in zip(*found[k], strict=True))
            piece[o] = _pieces(source, target, probability, len(o), sure)
        out.append(piece)
    return out


def clearer(single: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """Of two ways (P,) to join the dots of a view, the one that joins more: linked dots less pieces."""

    def n_links(piece: np.ndarray) -> int:
        return int((piece >= 0).sum()) - len(np.unique(piece[piece >= 0]))

    return joint if n_links(joint) >= n_links(single) else single


def _pair_links(pairs: Pairs, max_gap: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Links between pairs: source, target and probability."""
    nothing = np.empty(0, dtype=np.int64)
    moved = pair_displacement(pairs)
    if moved is None:
        return nothing, nothing, np.empty(0)
    reach = 1.5 * moved[1]
    missed = 0.1 ** np.arange(max_gap)
    n_dots = _n_dots(pairs)
    share = float(np.clip(0.7 * n_dots.min() / len(pairs), 0.02, 0.9))
    model = PairModel(first_motion(*moved), missed / missed.sum() * 0.9, 0.1, 0.1, share, np.full(2, 0.3))
    return _block_links(pairs, reach, max_gap, _learn(pairs, reach, max_gap, model))


def _n_dots(pairs: Pairs) -> np.ndarray:
    """Dots of each view that have a possible partner, (2,)."""
    return np.array([len(np.unique(pairs.dots[:, side])) for side in (0, 1)])


def _learn(pairs: Pairs, reach: float, max_gap: int, model: PairModel) -> PairModel:
    """The model by expectation and maximisation, on a stretch of the recording when it is long."""
    part = pairs.only(_stretch(pairs.frame, _LEARN_FROM))
    work, n_dots = PairBeliefs(part, reach, max_gap), _n_dots(part)
    for _ in range(_ROUNDS):
        work.believe(model, _EXCHANGES)
        model = work.learn(model, n_dots)
    return model


def _block_links(
    pairs: Pairs, reach: float, max_gap: int, model: PairModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Links and their probability, block by block: a belief depends on a few frames around it."""
    frames, start = np.unique(pairs.frame, return_index=True)
    start = np.r_[start, len(pairs)]
    found = []
    low = 0
    while low < len(frames):
        high = int(np.searchsorted(start, start[low] + _BLOCK, side="right")) - 1
        high = min(max(high, low + 1), len(frames))
        rows = slice(start[max(low - _MARGIN, 0)], start[min(high + _MARGIN, len(frames))])
        work = PairBeliefs(pairs.only(rows), reach, max_gap)
        work.believe(model, _LAST_EXCHANGES)
        source = work.links.source + rows.start
        mine = (source >= start[low]) & (source < start[high])
        found.append((source[mine], work.links.target[mine] + rows.start, work.probability[mine]))
        low = high
    return tuple(np.concatenate(p) for p in zip(*found, strict=True))  # type: ignore[return-value]


def _dot_links(
    source: np.ndarray, target: np.ndarray, probability: np.ndarray, n_dots: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Links of dots: whichever partners they have, the sum over the pairs."""
    keys, inverse = np.unique(source * np.int64(n_dots) + target, return_inverse=True)
    return keys // n_dots, keys % n_dots, np.minimum(np.bincount(inverse, probability, len(keys)), 1.0)


def _stretch(frame: np.ndarray, most: int) -> slice:
    """The middle of the recording, whole frames, about so many pairs."""
    if len(frame) <= most:
        return slice(0, len(frame))
    low = (len(frame) - most) // 2
    first, last = frame[low], frame[low + most]
    return slice(int(np.searchsorted(frame, first)), int(np.searchsorted(frame, max(last, first + 8))))


def _pieces(
    source: np.ndarray, target: np.ndarray, probability: np.ndarray, n_dots: int, sure: float
) -> np.ndarray:
    """Dots joined by sure links that no other contradicts; −1 for a dot alone."""
    keep = probability >= sure
    keys, inverse = np.unique(source[keep] * np.int64(n_dots) + target[keep], return_inverse=True)
    best = np.zeros(len(keys))
    np.maximum.at(best, inverse, probability[keep])
    source, target = keys // n_dots, keys % n_dots
    order = np.argsort(best, kind="stable")
    out, into = np.full(n_dots, -1), np.full(n_dots, -1)
    out[source[order]], into[target[order]] = order, order
    made = np.flatnonzero((out[source] == np.arange(len(keys))) & (into[target] == np.arange(len(keys))))
    ones = np.ones(len(made), dtype=bool)
    graph = coo_array((ones, (source[made], target[made])), shape=(n_dots, n_dots))
    _, label = connected_components(graph, directed=False)
    alone = np.bincount(label, minlength=1)[label] == 1
    number = np.full(n_dots, -1)
    number[~alone] = np.unique(label[~alone], return_inverse=True)[1]
    return number
