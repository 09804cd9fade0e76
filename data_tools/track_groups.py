"""Pieces of tracks in all views into groups, one group an animal.

Every edge between two pieces carries log-odds of being one animal; a group is worth the sum of its edges, in
every pair of views and along time, so views that disagree pay for it, and a third view decides what two leave
open. Two pieces of one view that are there at the same time are never one animal.

The largest sum is sought by joining groups from the surest pair to the least sure (edge contraction, as
Keuper et al. 2015, *Efficient decomposition of image and mesh graphs by lifted multicuts*, but by margin
instead of by gain): the *margin* of a pair is its log-odds against everything it would exclude. What is open
at first, two birds on one perch, is left until pieces joined meanwhile have pooled their evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.track_dots import runs

ABSENT = -4.0
"""Log-odds a frame of two pieces that overlap in time and were seldom near each other."""
_MARGINS = (40.0, 20.0, 10.0, 6.0, 4.0, 2.0, 1.0)
_BYTES = 50_000_000


@dataclass(frozen=True, eq=False)
class PieceGraph:
    """Pieces of all views and the evidence between them.

    Attributes
    ----------
    view, first, last : (V,) int
        View of each piece and the frames of its first and last dot, from 0.
    u, v : (E,) int
        Pieces that an edge joins; each pair at most once.
    weight : (E,)
        Log Bayes factor of being one animal, of pieces of different views; log-odds, of pieces of one view.
    price : float
        Log of the number of animals in view, any of which might have been the one: two groups that nothing
        links within a view pay it when they are joined.
    """

    view: np.ndarray
    first: np.ndarray
    last: np.ndarray
    u: np.ndarray
    v: np.ndarray
    weight: np.ndarray
    price: float = 0.0


@dataclass(frozen=True, eq=False)
class _Edges:
    """Edges between groups.

    Ends, summed weights, frames of overlap that the sums account for, and number of links within a view.
    """

    u: np.ndarray
    v: np.ndarray
    weight: np.ndarray
    seen: np.ndarray
    links: np.ndarray

    @classmethod
    def of(cls, graph: PieceGraph) -> _Edges:
        links = (graph.view[graph.u] == graph.view[graph.v]).astype(float)
        return cls(graph.u, graph.v, graph.weight, _overlap(graph, graph.u, graph.v), links)

    def take(self, which: np.ndarray) -> _Edges:
        return _Edges(self.u[which], self.v[which], self.weight[which], self.seen[which], self.links[which])


def group_pieces(graph: PieceGraph, least: float = 0.0) -> np.ndarray:
    """Group of every piece, (V,) int from 0; a piece that joined nothing is a group of its own.

    Parameters
    ----------
    graph : PieceGraph
        The evidence.
    least : float
        Margin, log-odds, above which two groups are joined.
    """
    label = np.arange(len(graph.view))
    if not len(graph.u):
        return label
    occupied = _occupancy(graph)
    edges = _Edges.of(graph)
    for margin in (*(m for m in _MARGINS if m > least), least):
        while True:
            edges = _contract(edges, label)
            total, compatible = _totals(edges, occupied, graph.price)
            edges, total = edges.take(compatible), total[compatible]
            pairs = _surest(edges, total, occupied, margin)
            if not len(pairs):
                break
            keep, gone = edges.u[pairs], edges.v[pairs]
            occupied[keep] |= occupied[gone]
            target = np.arange(len(label))
            target[gone] = keep
            label = target[label]
    return np.unique(label, return_inverse=True)[1]


def total_log_odds(graph: PieceGraph, label: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Summed log-odds between groups of pieces, for those that have an edge and can be one animal.

    Parameters
    ----------
    graph : PieceGraph
        The evidence.
    label : (V,) int
        Group of every piece; any numbers from 0.

    Returns
    -------
    u, v : (E,) int
        Groups, u < v.
    total : (E,)
        Log-odds, overlaps without an edge included.
    """
    names, dense = np.unique(label, return_inverse=True)
    order = np.argsort(dense, kind="stable")
    heads = np.searchsorted(dense[order], np.arange(len(names)))
    occupied = np.bitwise_or.reduceat(_occupancy(graph)[order], heads, axis=0)
    edges = _contract(_Edges.of(graph), dense)
    total, compatible = _totals(edges, occupied, graph.price)
    return names[edges.u[compatible]], names[edges.v[compatible]], total[compatible]


def _shape(graph: PieceGraph) -> tuple[int, int]:
    """Views and bytes of the bit fields."""
    return int(graph.view.max()) + 1, -(-(int(graph.last.max()) + 1) // 8)


def _overlap(graph: PieceGraph, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    shared = np.minimum(graph.last[u], graph.last[v]) - np.maximum(graph.first[u], graph.first[v]) + 1
    return np.where(graph.view[u] == graph.view[v], 0, np.maximum(shared, 0)).astype(float)


def _occupancy(graph: PieceGraph) -> np.ndarray:
    """(V, views, bytes) bit field: the frames in which a group has a piece in a view."""
    occupied = np.zeros((len(graph.view), *_shape(graph)), dtype=np.uint8)
    byte = np.arange(occupied.shape[2])
    low, high = graph.first // 8, graph.last // 8
    head = (0xFF >> (graph.first % 8)).astype(np.uint8)  # the first frame is the highest bit
    tail = (0xFF00 >> (graph.last % 8 + 1) & 0xFF).astype(np.uint8)
    step = max(1, _BYTES // len(byte))
    for start in range(0, len(graph.view), step):
        part = np.arange(start, min(start + step, len(graph.view)))
        inside = (byte >= low[part, None]) & (byte <= high[part, None])
        occupied[part, graph.view[part]] = np.where(inside, 0xFF, 0)
    pieces = np.arange(len(graph.view))
    occupied[pieces, graph.view, low] &= head
    occupied[pieces, graph.view, high] &= tail
    return occupied


def _contract(edges: _Edges, label: np.ndarray) -> _Edges:
    """Edges between the groups of `label`, parallel ones summed, u < v."""
    u, v = label[edges.u], label[edges.v]
    u, v = np.minimum(u, v), np.maximum(u, v)
    other = u != v
    key = u[other] * np.int64(len(label)) + v[other]
    order = np.argsort(key, kind="stable")
    key = key[order]
    if not len(key):
        return edges.take(np.zeros(0, dtype=int))
    heads = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    weight, seen, links = (
        np.add.reduceat(values[other][order], heads) for values in (edges.weight, edges.seen, edges.links)
    )
    return _Edges(key[heads] // len(label), key[heads] % len(label), weight, seen, links)


_ONES = np.array([bin(value).count("1") for value in range(256)], dtype=np.uint8)


def _totals(edges: _Edges, occupied: np.ndarray, price: float) -> tuple[np.ndarray, np.ndarray]:
    """Log-odds of each pair of groups, overlaps without an edge included; whether it can be one animal."""
    views = range(occupied.shape[1])
    overlap = np.zeros(len(edges.u))
    compatible = np.ones(len(edges.u), dtype=bool)
    step = max(1, _BYTES // (occupied.shape[1] * occupied.shape[2]))
    for start in range(0, len(edges.u), step):
        part = slice(start, start + step)
        one, two = occupied[edges.u[part]], occupied[edges.v[part]]
        compatible[part] = ~(one & two).any((1, 2))
        for a in views:
            for b in views:
                if a != b:
                    overlap[part] += _ONES[one[:, a] & two[:, b]].sum(1, dtype=np.int64)
    total = edges.weight + ABSENT * np.maximum(overlap - edges.seen, 0.0)
    return np.where(edges.links > 0, total, total - price), compatible


def _surest(edges: _Edges, total: np.ndarray, occupied: np.ndarray, least: float) -> np.ndarray:
    """Edges with a margin above `least` that are the surest of both their groups."""
    margin = margins(edges.u, edges.v, total, occupied)
    good = np.flatnonzero(margin > least)
    if not len(good):
        return good
    best = np.full(len(occupied), -np.inf)
    np.maximum.at(best, edges.u[good], margin[good])
    np.maximum.at(best, edges.v[good], margin[good])
    mutual = good[(margin[good] >= best[edges.u[good]]) & (margin[good] >= best[edges.v[good]])]
    taken: set[int] = set()  # equal margins: the first one
    chosen = []
    for e in mutual.tolist():
        ends = {int(edges.u[e]), int(edges.v[e])}
        if not ends & taken:
            chosen.append(e)
            taken |= ends
    return np.array(chosen, dtype=int)


def margins(u: np.ndarray, v: np.ndarray, total: np.ndarray, occupied: np.ndarray) -> np.ndarray:
    """Log-odds of each pair against being apart and against every pair that it excludes, (E,).

    A pair (u, v) excludes (u, v') when v and v' are there at the same time in one view.
    """
    margin = np.full(len(u), -np.inf)
    useful = np.flatnonzero(total > 0)
    u, v, total = u[useful], v[useful], total[useful]
    against = np.maximum(_rivals(u, v, total, occupied), _rivals(v, u, total, occupied))
    margin[useful] = total - against
    return margin


def _rivals(who: np.ndarray, other: np.ndarray, total: np.ndarray, occupied: np.ndarray) -> np.ndarray:
    """Log of one (apart) and the odds of the pairs of the same group that a pair excludes, (E,)."""
    order = np.argsort(who, kind="stable")
    low = np.searchsorted(who[order], who)
    count = np.searchsorted(who[order], who, side="right") - low
    mine = np.repeat(np.arange(len(who)), count)
    rival = order[runs(low, count)]
    apart = mine != rival
    mine, rival = mine[apart], rival[apart]
    clash = np.zeros(len(mine), dtype=bool)
    step = max(1, _BYTES // (occupied.shape[1] * occupied.shape[2]))
    for start in range(0, len(mine), step):
        part = slice(start, start + step)
        clash[part] = (occupied[other[mine[part]]] & occupied[other[rival[part]]]).any((1, 2))
    mine, rival = mine[clash], rival[clash]
    top = np.zeros(len(who))
    np.maximum.at(top, mine, total[rival])
    share = np.bincount(mine, weights=np.exp(total[rival] - top[mine]), minlength=len(who))
    return top + np.log(np.exp(-top) + share)
