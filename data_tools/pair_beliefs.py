"""How probable is every pair of dots, and every link of two pairs, given all others?

A pair is real or not; a real one has at most one link that comes in and one that goes out; a dot has at most
one real pair. Sums over the alternatives pass along the links, forwards and backwards, and between the pairs
that share a dot (Williams & Lau 2014, "Approximate evaluation of marginal association probabilities with
belief propagation", has the latter).

With ρ the density of real pairs, c of chance ones (1/m³) and δ the share of the dots of a view that have no
partner, the odds that a pair at distance d is real rather than two single dots are

    N(d; 0, σ²)/U(d) · f/(c δ_a δ_b)

where f is the density of its place: that of the motion (:mod:`pair_motion`) when it continues another pair,
β ρ when it begins.
Shapes: K pairs sorted by frame, E links, T pairs of links that follow one another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from acino_fte.data_tools.dot_candidates import Links
from acino_fte.data_tools.pair_candidates import Pairs
from acino_fte.data_tools.pair_motion import PairMotion, begin_density, follow_density, learned

_MOST = 10
_UNLIKELY = {2: 1e-4, 4: 1e-3, 7: 1e-3}  # links below are dropped before these exchanges
_MOTION_FROM = 2  # exchanges without it are enough to see which links are hopeless
_DAMPING = 0.7


@dataclass(frozen=True, eq=False)
class PairModel:
    """How pairs behave.

    Attributes
    ----------
    motion : PairMotion
    seen : (G,)
        Probability that an animal's next pair comes after 1, 2 … frames.
    end, birth : float
        Probability that a real pair has none after it, none before it.
    share : float
        Share of the pairs that are real.
    single : (2,)
        Share of the dots of each view without a partner.
    """

    motion: PairMotion
    seen: np.ndarray
    end: float
    birth: float
    share: float
    single: np.ndarray


def _find_links(pairs: Pairs, reach: float, max_gap: int) -> Links:
    """Pairs of pairs close enough in space and time."""
    apart = 8.0 * reach * max_gap
    tree = cKDTree(np.column_stack([pairs.frame * apart, pairs.point]))
    source, target, gaps = [], [], []
    for gap in range(1, max_gap + 1):
        k = _MOST if gap == 1 else _MOST // 2
        query = np.column_stack([(pairs.frame + gap) * apart, pairs.point])
        distance, found = tree.query(query, k=np.arange(1, k + 1), distance_upper_bound=reach * gap**0.75)
        row, column = np.nonzero(np.isfinite(distance))
        source.append(row)
        target.append(found[row, column])
        gaps.append(np.full(len(row), gap))
    s, t, g = (np.concatenate(part) for part in (source, target, gaps))
    order = np.argsort(s, kind="stable")
    return Links(s[order], t[order], g[order], np.zeros(len(pairs)))


@dataclass(frozen=True, eq=False)
class _Weights:
    """What is known before the beliefs.

    Attributes
    ----------
    odds, birth : (K,)
        Odds of a pair for a density of one (m³); β ρ, 1/m³.
    begin : (E,)
        Density of a link's target from its source alone, times the chance of the gap, 1/m³.
    first, second : (T,) int
        Links that follow one another; none while motion is left out.
    follow : (T,)
        Density of the target of the second after the first, times the chance of the gap, 1/m³.
    """

    odds: np.ndarray
    birth: np.ndarray
    begin: np.ndarray
    first: np.ndarray
    second: np.ndarray
    follow: np.ndarray


@dataclass(frozen=True, eq=False)
class _Messages:
    """Odds of every link by all that is earlier, and by all that is later (E,); how free dots are (2, K)."""

    forward: np.ndarray
    backward: np.ndarray
    free: np.ndarray


class PairBeliefs:
    """Beliefs about the pairs of a stretch of time and their links.

    Attributes
    ----------
    links : Links
        Those that are not hopeless.
    probability : (E,)
        Of the links.
    real : (K,)
        Probability of the pairs.
    """

    links: Links
    probability: np.ndarray
    real: np.ndarray
    weights: _Weights

    def __init__(self, pairs: Pairs, reach: float, max_gap: int) -> None:
        self.pairs = pairs
        self.all_links = _find_links(pairs, reach, max_gap)
        self.dot = [np.unique(pairs.dots[:, side], return_inverse=True)[1] for side in (0, 1)]

    def believe(self, model: PairModel, exchanges: int) -> None:
        """Probabilities of links and pairs under a model, from the start."""
        self.links = self.all_links
        weights, n = self._weights(model), len(self.pairs)
        messages = _Messages(np.zeros(len(self.links)), np.ones(len(self.links)), np.ones((2, n)))
        for k in range(exchanges):
            if k in _UNLIKELY:
                keep = self.probability > _UNLIKELY[k]
                weights, messages = self._only(model, weights, messages, keep)
            if k == _MOTION_FROM:
                weights = self._with_motion(model, weights)
            messages = self._exchange(model, weights, messages, k)
        self.weights = weights

    def _weights(self, model: PairModel) -> _Weights:
        pairs = self.pairs
        odds = pairs.surplus / (pairs.density * (1 - model.share) * model.single.prod())
        begin = begin_density(model.motion, pairs.point, pairs.covariance, self.links)
        begin = begin * model.seen[self.links.gap - 1]
        nothing = np.empty(0, dtype=np.int64)
        return _Weights(odds, pairs.density * model.share * model.birth, begin, nothing, nothing, np.empty(0))

    def _only(
        self, model: PairModel, weights: _Weights, messages: _Messages, keep: np.ndarray
    ) -> tuple[_Weights, _Messages]:
        """What is left when only the links that a mask (E,) keeps remain."""
        self.links = self.links.only(keep)
        kept = keep[weights.first] & keep[weights.second]
        number = np.cumsum(keep) - 1
        first, second = number[weights.first[kept]], number[weights.second[kept]]
        weights = replace(
            weights, begin=weights.begin[keep], first=first, second=second, follow=weights.follow[kept]
        )
        return weights, replace(messages, forward=messages.forward[keep], backward=messages.backward[keep])

    def _with_motion(self, model: PairModel, weights: _Weights) -> _Weights:
        first, second = self.links.pairs()
        at = self.pairs.point, self.pairs.covariance
        follow = follow_density(model.motion, *at, self.links, first, second)
        follow = follow * model.seen[self.links.gap[second] - 1]
        return replace(weights, first=first, second=second, follow=follow)

    def _exchange(self, model: PairModel, w: _Weights, messages: _Messages, k: int) -> _Messages:
        """The messages after one exchange, and the probabilities by them."""
        source, target = self.links.source, self.links.target
        n, m = len(self.pairs), len(self.links)
        forward, backward, free = messages.forward, messages.backward, messages.free

        def sums(of: np.ndarray, value: np.ndarray, length: int = n) -> np.ndarray:
            return np.bincount(of, value, length)

        u = w.odds * free[0] * free[1]
        coming = w.birth + sums(target, forward)
        out_alone = model.end + sums(source, w.begin * backward)
        if k < _MOTION_FROM:
            on, goes_on = w.begin * coming[source], out_alone[target]
        else:
            on = w.birth[source] * w.begin + sums(w.second, w.follow * forward[w.first], m)
            goes_on = model.end + sums(w.first, w.follow * backward[w.second], m)
        leaving, taken = on * backward, forward * goes_on
        goes, comes = sums(source, leaving), sums(target, taken)
        off = 1 + u[source] * (model.end * coming[source] + np.maximum(goes[source] - leaving, 0.0))
        rivals = np.maximum(comes[target] - taken, 0.0)
        later = 1 + u[target] * ((w.birth * out_alone)[target] + rivals)
        new_forward, new_backward = u[source] * on / off, u[target] * goes_on / later
        if k:
            new_forward = forward ** (1 - _DAMPING) * new_forward**_DAMPING
            new_backward = backward ** (1 - _DAMPING) * new_backward**_DAMPING
        real = w.odds * (model.end * coming + goes)
        free = self._free(real, free)
        both, whole = new_forward * new_backward, real * free[0] * free[1]
        self.probability, self.real = both / (1 + both), whole / (1 + whole)
        return _Messages(new_forward, new_backward, free)

    def _free(self, real: np.ndarray, free: np.ndarray) -> np.ndarray:
        """How free each dot of a pair is, given its other pairs, (2, K)."""
        new = np.empty_like(free)
        for side in (0, 1):
            claim = real * free[1 - side]
            total = np.bincount(self.dot[side], claim)[self.dot[side]]
            new[side] = 1.0 / (1.0 + np.maximum(total - claim, 0.0))
        return free ** (1 - _DAMPING) * new**_DAMPING

    def learn(self, model: PairModel, n_dots: np.ndarray) -> PairModel:
        """The model that fits the beliefs."""
        p, links = self.probability, self.links
        motion = learned(
            model.motion,
            self.pairs.point,
            self.pairs.covariance,
            links,
            p,
            self.weights.first,
            self.weights.second,
        )
        n_real = float(self.real.sum()) + 1.0
        by_gap = np.bincount(links.gap - 1, p, len(model.seen)) + 0.3
        end = float(np.clip(1 - p.sum() / n_real, 0.01, 0.3))
        share = float(np.clip(n_real / len(self.pairs), 0.02, 0.95))
        single = np.clip(1 - n_real / n_dots, 0.03, 0.9)
        return replace(
            model,
            motion=motion,
            seen=by_gap / by_gap.sum() * (1 - end),
            end=end,
            birth=end,
            share=share,
            single=single,
        )
