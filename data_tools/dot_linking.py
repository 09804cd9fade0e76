"""Bare dots of one view joined to short, pure pieces of track.

A link is made only where it is unambiguous: its probability given all other possible links
(:mod:`dot_beliefs`) is near one. How animals move is learnt from the view itself (:mod:`dot_motion`), and how
often dots come again from the pairs of dots (:mod:`dot_candidates`). What stays open is for other views to
settle (:mod:`track_matching`).
Shapes: P dots, E links, T pairs of links that follow one another, M modes of motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from acino_fte.data_tools.dot_beliefs import Messages, Weights, first_messages, propagate
from acino_fte.data_tools.dot_candidates import (
    Displacements,
    Links,
    find_candidates,
    local_density,
    measure_displacements,
)
from acino_fte.data_tools.dot_motion import (
    Motion,
    States,
    begun,
    density,
    density_at,
    first_motion,
    learn_motion,
    step,
    updated,
)

SURE = 0.99
_UNLIKELY = 1e-4
_DROPS = (2, 4)
_ROUNDS, _EXCHANGES = 4, 4
_LAST_EXCHANGES = 8
_LEARN_FROM = 6_000  # dots
_BLOCK, _MARGIN = 25_000, 6  # dots, frames
_HOPELESS = 0.01


@dataclass(frozen=True, eq=False)
class DotModel:
    """How the dots of a view behave.

    Attributes
    ----------
    motion : Motion
    seen : (G,)
        Probability that the next dot comes after 1, 2 … frames.
    end : float
        Probability that none comes.
    birth : float
        Share of the dots that have none before them.
    """

    motion: Motion
    seen: np.ndarray
    end: float
    birth: float


def link_dots(
    frame: np.ndarray, xy: np.ndarray, noise_px: float | None = None, max_gap: int = 2, sure: float = SURE
) -> np.ndarray:
    """Pieces of track from the dots of one view.

    Parameters
    ----------
    frame : (P,) int
        Frame of each dot, in any order.
    xy : (P, 2)
        px.
    noise_px : float, optional
        Standard deviation of a dot's coordinate, px; learnt when not given.
    max_gap : int
        Longest gap that a link bridges, frames from dot to dot.
    sure : float
        Least probability of a link.

    Returns
    -------
    (P,) int
        The piece of every dot, from 0, in the order of their first frames; −1 for a dot that joins nothing.
    """
    order = np.argsort(frame, kind="stable")
    frame, xy = np.asarray(frame)[order].astype(np.int64), np.asarray(xy, dtype=float)[order]
    piece = np.full(len(frame), -1)
    moved = measure_displacements(frame, xy) if len(frame) else None
    if moved is None:
        return piece
    model = _learn(frame, xy, moved, noise_px, max_gap)
    if model is None:
        return piece
    links, probability = _beliefs(frame, xy, moved, model, max_gap)
    piece[order] = _pieces(links, probability, len(frame), sure)
    return piece


def _learn(
    frame: np.ndarray, xy: np.ndarray, moved: Displacements, noise: float | None, max_gap: int
) -> DotModel | None:
    """The model by expectation and maximisation, on a stretch of the recording when it is long.

    None when hardly a link there can be told from its rivals.
    """
    slow, fast = moved.quantile(0.25) / 0.76, moved.quantile(0.9) / 2.15
    found = moved.found
    missed = np.clip((1 - found) / 2, 0.005, 0.3)
    seen = missed ** np.arange(max_gap)
    model = DotModel(
        first_motion(slow / 1.5, fast * 1.5, noise), seen / seen.sum() * (1 - missed), missed, missed
    )
    part = _stretch(frame, _LEARN_FROM)
    work = _Linking(frame[part], xy[part], moved, max_gap)
    for _ in range(_ROUNDS):
        work.believe(model, _EXCHANGES)
        model = work.learn(model, noise)
    likely = work.messages.probability > 0.5
    return model if likely.sum() > _HOPELESS * len(work.frame) else None


def _stretch(frame: np.ndarray, most: int) -> slice:
    """The middle of the recording, whole frames, about so many dots."""
    if len(frame) <= most:
        return slice(None)
    low = (len(frame) - most) // 2
    low, high = frame[low], frame[low + most]
    return slice(np.searchsorted(frame, low), np.searchsorted(frame, max(high, low + 8)))


def _beliefs(
    frame: np.ndarray, xy: np.ndarray, moved: Displacements, model: DotModel, max_gap: int
) -> tuple[Links, np.ndarray]:
    """Links and their probability, block by block: a belief depends on a few frames around it."""
    frames, start = np.unique(frame, return_index=True)
    start = np.r_[start, len(frame)]
    found: list[tuple[np.ndarray, ...]] = []
    low = 0
    while low < len(frames):
        high = int(np.searchsorted(start, start[low] + _BLOCK, side="right")) - 1
        high = min(max(high, low + 1), len(frames))
        rows = slice(start[max(low - _MARGIN, 0)], start[min(high + _MARGIN, len(frames))])
        work = _Linking(frame[rows], xy[rows], moved, max_gap)
        work.believe(model, _LAST_EXCHANGES)
        source = work.links.source + rows.start
        mine = (source >= start[low]) & (source < start[high])
        links = source, work.links.target + rows.start, work.links.gap, work.messages.probability
        found.append(tuple(part[mine] for part in links))
        low = high
    source, target, gap, probability = (np.concatenate(part) for part in zip(*found, strict=True))
    return Links(source, target, gap, np.zeros(len(frame))), probability


class _Linking:
    """Beliefs under way about the links of one view."""

    links: Links
    messages: Messages
    states: States
    squared: np.ndarray

    def __init__(self, frame: np.ndarray, xy: np.ndarray, moved: Displacements, max_gap: int) -> None:
        self.frame, self.xy, self.max_gap = frame, xy, max_gap
        self.all_links = find_candidates(frame, xy, moved, max_gap)
        self.density = local_density(frame, xy)

    def believe(self, model: DotModel, exchanges: int) -> None:
        """Probabilities of the links under a model, from the start; unlikely links are dropped on the way."""
        self.links = self.all_links
        begin = self._begin(model)
        nothing = np.empty(0, dtype=np.int64)
        alone = self._weights(model, begin, nothing, nothing, np.empty(0))
        messages = first_messages(self.links, alone)
        keep = self._hopeful(messages, alone)
        self.links, begin = self.links.only(keep), begin[keep]
        messages = messages.only(keep)
        states, squared = self._states(model, messages.probability, None)
        first, second = self.links.pairs()
        for k in range(exchanges):
            if k in _DROPS:
                keep = messages.probability > _UNLIKELY
                self.links, begin, states = self.links.only(keep), begin[keep], states[keep]
                messages = messages.only(keep)
                first, second = self.links.pairs()
            follow = self._follow(model, states, first, second)
            weights = self._weights(model, begin, first, second, follow)
            messages = propagate(self.links, weights, messages)
            states, squared = self._states(model, messages.probability, states)
        self.messages, self.states, self.squared = messages, states, squared

    def _hopeful(self, messages: Messages, weights: Weights) -> np.ndarray:
        """Links that are not hopeless beside their rivals, even if motion were to favour them."""
        odds = messages.forward * messages.backward
        best = np.zeros(len(self.frame))
        np.maximum.at(best, self.links.source, odds)
        np.maximum.at(best, self.links.target, odds)
        return odds > 1e-6 * np.maximum(1.0, np.minimum(best[self.links.source], best[self.links.target]))

    def _begin(self, model: DotModel) -> np.ndarray:
        """Density of every link's target from its source alone, times the chance of the gap."""
        value = np.empty(len(self.links))
        predicted = begun(self.xy, model.motion)
        for gap in range(1, self.max_gap + 1):
            predicted = step(predicted, model.motion)
            of = np.flatnonzero(self.links.gap == gap)
            where = predicted[self.links.source[of]]
            value[of] = model.seen[gap - 1] * density(where, self.xy[self.links.target[of]], model.motion)
        return value

    def _follow(self, model: DotModel, states: States, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        value = np.empty(len(first))
        gaps = self.links.gap[second]
        for gap in range(1, self.max_gap + 1):
            of = np.flatnonzero(gaps == gap)
            if gap == 1:
                states = step(states, model.motion)
                which = first[of]
            elif len(of):
                used, which = np.unique(first[of], return_inverse=True)
                states_then = states[used]
                for _ in range(gap - 1):
                    states_then = step(states_then, model.motion)
            xy = self.xy[self.links.target[second[of]]]
            if len(of):
                after = states if gap == 1 else states_then
                value[of] = model.seen[gap - 1] * density_at(after, which, xy, model.motion)
        return value

    def _weights(
        self, model: DotModel, begin: np.ndarray, first: np.ndarray, second: np.ndarray, follow: np.ndarray
    ) -> Weights:
        birth = self.density * (model.birth + self.links.unlisted)
        return Weights(first, second, follow, begin, birth, model.end + self.links.unlisted)

    def _states(
        self, model: DotModel, probability: np.ndarray, before: States | None
    ) -> tuple[States, np.ndarray]:
        """State at the target of every link, after the likeliest link that comes to its source."""
        links = self.links
        if before is None:
            predicted = begun(self.xy[links.source], model.motion)
        else:
            previous = best_link(links.target, probability, len(self.frame))[links.source]
            predicted = before[np.maximum(previous, 0)]
            unknown = np.flatnonzero(previous < 0)
            predicted.put(unknown, begun(self.xy[links.source[unknown]], model.motion))
        predicted = step(predicted, model.motion)
        for gap in range(2, self.max_gap + 1):
            of = np.flatnonzero(links.gap >= gap)
            predicted.put(of, step(predicted[of], model.motion))
        return updated(predicted, self.xy[links.target], model.motion)

    def learn(self, model: DotModel, noise: float | None) -> DotModel:
        """The model that fits the beliefs."""
        links, p = self.links, self.messages.probability
        n_dots = len(self.frame)
        previous = best_link(links.target, p, n_dots)
        second = np.flatnonzero(previous[links.source] >= 0)
        first = previous[links.source[second]]
        third = previous[links.source[first]]
        chain = np.column_stack([third, first, second])[third >= 0]
        chain = chain[(links.gap[chain] == 1).all(1)]
        step_ = (self.xy[links.target] - self.xy[links.source]) / links.gap[:, None]
        weight = p * (links.gap == 1)
        motion = learn_motion(model.motion, step_, chain, weight, self.states.odds, self.squared, noise)
        return replace(model, motion=motion)


def best_link(dot: np.ndarray, probability: np.ndarray, n_dots: int) -> np.ndarray:
    """The likeliest link of each dot (P,), given the dot (E,) of every link; −1 when none is likelier."""
    order = np.argsort(probability, kind="stable")
    best = np.full(n_dots, -1)
    best[dot[order]] = order
    total = np.bincount(dot, probability, n_dots)
    top = np.where(best >= 0, probability[best], 0.0)
    return np.where(top >= np.maximum(1 - total, 0.0), best, -1)


def _pieces(links: Links, probability: np.ndarray, n_dots: int, sure: float) -> np.ndarray:
    """Dots joined by sure links; −1 for a dot alone."""
    made = np.flatnonzero(probability >= sure)
    into = best_link(links.target, probability, n_dots)[links.target[made]]
    out = best_link(links.source, probability, n_dots)[links.source[made]]
    made = made[(into == made) & (out == made)]
    ones = np.ones(len(made), dtype=bool)
    graph = coo_array((ones, (links.source[made], links.target[made])), shape=(n_dots, n_dots))
    _, label = connected_components(graph, directed=False)
    alone = np.bincount(label)[label] == 1
    _, first, inverse = np.unique(np.where(alone, -1, label), return_index=True, return_inverse=True)
    if alone.any():
        first, inverse = first[1:], inverse - 1
    number = np.argsort(np.argsort(first, kind="stable"), kind="stable")
    return np.where(alone, -1, number[inverse] if len(number) else -1)
