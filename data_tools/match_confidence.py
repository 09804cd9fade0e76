"""How sure is a match? The posterior probability of every piece's place, and what else it might have been.

With everything else as it is, a piece may stay, be alone, go to another group, or change places with what
that group holds in its view at the time. The log-odds of each alternative against the present state come from
the same sums that made the groups, and

    P(right) = 1 / (1 + Σ exp(log-odds of an alternative)).

A joining was priced with all the animals in view, of which any might have been the one; once the others have
found theirs, only those still at large might, and the difference is paid back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acino_fte.data_tools.track_dots import runs
from acino_fte.data_tools.track_groups import PieceGraph

_MOST = 700.0
_IMPROBABLE = -40.0


@dataclass(frozen=True, eq=False)
class Confidence:
    """Of V pieces.

    Attributes
    ----------
    probability : (V,)
        That the piece belongs to its group; NaN for a piece that is alone.
    log_odds : (V,)
        Against being alone.
    rival : (V,) int
        The most likely other group, −1 for none.
    rival_probability : (V,)
        Its probability; 0 for none.
    """

    probability: np.ndarray
    log_odds: np.ndarray
    rival: np.ndarray
    rival_probability: np.ndarray


def confidence_of(graph: PieceGraph, label: np.ndarray) -> Confidence:
    """Confidence of every piece of a grouping.

    Parameters
    ----------
    graph : PieceGraph
        The evidence.
    label : (V,) int
        Group of every piece.
    """
    n = len(label)
    piece, group, gain = _gains(graph, label)
    own = np.zeros(n)
    mine = label[piece] == group
    own[piece[mine]] = gain[mine]
    joined = np.zeros(n, dtype=bool)
    joined[piece[mine]] = True
    other = ~mine & (gain - own[piece] > _IMPROBABLE)
    piece, group, gain = piece[other], group[other], gain[other]
    change = gain - own[piece] + _displaced(graph, label, own, piece, group)
    odds = np.exp(np.clip(change, -_MOST, _MOST))
    alone = -own - (graph.price - np.log1p(np.minimum(_at_large(graph, joined), np.expm1(graph.price))))
    against = np.exp(np.clip(alone, -_MOST, _MOST)) + np.bincount(piece, weights=odds, minlength=n)
    rival, best = np.full(n, -1), np.zeros(n)
    order = np.argsort(odds, kind="stable")  # the last one written is the largest
    rival[piece[order]], best[piece[order]] = group[order], odds[order]
    chance = 1.0 / (1.0 + against)
    return Confidence(np.where(joined, chance, np.nan), own, rival, best * chance)


def _at_large(graph: PieceGraph, joined: np.ndarray) -> np.ndarray:
    """Mean number of pieces of another view that are there with each piece and have joined nothing, (V,)."""
    n_views, n_frames = int(graph.view.max(initial=0)) + 1, int(graph.last.max(initial=0)) + 2
    change = np.zeros((n_views, n_frames))
    alone = np.flatnonzero(~joined)
    np.add.at(change, (graph.view[alone], graph.first[alone]), 1.0)
    np.add.at(change, (graph.view[alone], graph.last[alone] + 1), -1.0)
    there = np.cumsum(change, axis=1)
    elsewhere = (there.sum(0) - there) / max(n_views - 1, 1)
    total = np.concatenate([np.zeros((n_views, 1)), np.cumsum(elsewhere, axis=1)], axis=1)
    span = total[graph.view, graph.last + 1] - total[graph.view, graph.first]
    return span / (graph.last - graph.first + 1)


def without_phantoms(confidence: Confidence, label: np.ndarray, prior: np.ndarray) -> Confidence:
    """Doubt groups that consist only of pieces as clutter has them.

    A piece of a length at which few have a partner is likelier to belong to an animal that is known from
    longer pieces than to be all that was ever seen of another one. Groups of nothing else pay the logarithm
    of the number of such pieces for each known animal.

    Parameters
    ----------
    confidence : Confidence
        Of the groups.
    label : (V,) int
        Group of every piece.
    prior : (V,)
        Log-odds of having a partner, 0 at most (:mod:`track_prior`).
    """
    unlikely = prior < 0
    solid = np.zeros(len(label), dtype=bool)
    solid[label[~unlikely & np.isfinite(confidence.probability)]] = True
    price = np.log(max(unlikely.sum() / max(np.count_nonzero(solid), 1), 1.0))
    with np.errstate(divide="ignore"):
        odds = np.log(confidence.probability) - np.log1p(-confidence.probability)
    doubted = 1.0 / (1.0 + np.exp(-(odds - price)))
    return replace(confidence, probability=np.where(solid[label], confidence.probability, doubted))


def _gains(graph: PieceGraph, label: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What each piece adds to each group that it has an edge to, its own without itself."""
    n = len(label)
    piece = np.concatenate([graph.u, graph.v])
    group = label[np.concatenate([graph.v, graph.u])]
    weight = np.concatenate([graph.weight, graph.weight])
    key, inverse = np.unique(piece * np.int64(n) + group, return_inverse=True)
    links = np.tile(graph.view[graph.u] == graph.view[graph.v], 2)
    linked = np.bincount(inverse, weights=links, minlength=len(key)) > 0
    total = np.bincount(inverse, weights=weight, minlength=len(key))
    return key // n, key % n, np.where(linked, total, total - graph.price)


def _displaced(
    graph: PieceGraph, label: np.ndarray, own: np.ndarray, piece: np.ndarray, group: np.ndarray
) -> np.ndarray:
    """What pieces that are in a group when another comes may gain in exchange, less what they lose, (E,)."""
    by_group = np.argsort(label, kind="stable")
    low = np.searchsorted(label[by_group], group)
    count = np.searchsorted(label[by_group], group, side="right") - low
    offer = np.repeat(np.arange(len(piece)), count)
    there = by_group[runs(low, count)]
    comer = piece[offer]
    clash = (graph.view[there] == graph.view[comer]) & (
        np.minimum(graph.last[there], graph.last[comer]) >= np.maximum(graph.first[there], graph.first[comer])
    )
    offer, there, comer = offer[clash], there[clash], comer[clash]
    all_piece, all_group, all_gain = _gains(graph, label)
    n = np.int64(len(label))
    known = all_piece * n + all_group
    wanted = there * n + label[comer]
    at = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
    swap = np.where(known[at] == wanted, np.maximum(all_gain[at], 0.0), 0.0) if len(known) else 0.0
    return np.bincount(offer, weights=swap - np.maximum(own[there], 0.0), minlength=len(piece))
