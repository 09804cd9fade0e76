"""How probable is every link, given all others? Belief propagation over the graph of possible links.

A dot has at most one link that comes in and one that goes out, and what it says of the two together is a
density: where an animal that came this way goes next. Sums over the alternatives pass along the links,
forwards and backwards, as in the data association of Williams & Lau (2014, "Approximate evaluation of
marginal association probabilities with belief propagation"), here with a factor that couples both sides
of a dot.
Exact where the graph has no loop. Shapes: P dots, E links, T pairs of links that follow one another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.dot_candidates import Links

_SMALL = 1e-12


@dataclass(frozen=True, eq=False)
class Weights:
    """What dots say of their links.

    Attributes
    ----------
    first, second : (T,) int
        Links that follow one another.
    follow : (T,)
        Density (1/px²) of the target of the second link after the first, times the chance of its gap.
    begin : (E,)
        The same for a link whose source has no link that comes in.
    birth : (P,)
        Density (1/px²) of dots that have none.
    end : (P,)
        Probability that a dot has no link that goes out.
    """

    first: np.ndarray
    second: np.ndarray
    follow: np.ndarray
    begin: np.ndarray
    birth: np.ndarray
    end: np.ndarray


@dataclass(frozen=True, eq=False)
class Messages:
    """What is passed along every link, (E,) each.

    Attributes
    ----------
    forward, backward : (E,)
        Odds of the link by all that is earlier (1/px²), and by all that is later (px²).
    probability : (E,)
    """

    forward: np.ndarray
    backward: np.ndarray
    probability: np.ndarray

    def only(self, keep: np.ndarray) -> Messages:
        """Those of the links that a mask (E,) keeps."""
        return Messages(self.forward[keep], self.backward[keep], self.probability[keep])


def first_messages(links: Links, weights: Weights) -> Messages:
    """Messages of a graph in which every link stands alone."""
    forward, backward = weights.begin.copy(), 1.0 / weights.birth[links.target]
    odds = forward * backward
    return Messages(forward, backward, odds / (1.0 + odds))


def propagate(links: Links, weights: Weights, messages: Messages) -> Messages:
    """The messages after one exchange.

    Around the smallest loop, two animals that may have changed places, plain belief propagation counts the
    same evidence over and over and is sure of either. Here rivals are weighed with what they would be worth
    were the dot that they contest free, and the exchange of two is exact.
    """
    n_dots, n_links = len(weights.birth), len(links)
    source, target = links.source, links.target
    first, second = weights.first, weights.second
    past = messages.forward

    def sums(of: np.ndarray, value: np.ndarray, length: int) -> np.ndarray:
        return np.bincount(of, value, length)

    goes_on = weights.end[target] + sums(first, weights.follow * messages.backward[second], n_links)
    alone = weights.birth * (weights.end + sums(source, weights.begin * messages.backward, n_dots))
    coming = weights.birth + sums(target, past, n_dots)
    on = sums(second, weights.follow * past[first], n_links) + weights.birth[source] * weights.begin

    def forward(backward: np.ndarray) -> np.ndarray:
        through, begun = weights.follow * backward[second], weights.begin * backward
        rivals = np.maximum(sums(first, through, n_links)[first] - through, 0.0)
        rivals_begun = np.maximum(sums(source, begun, n_dots)[source] - begun, 0.0)
        off = weights.end[source] * coming[source] + sums(second, past[first] * rivals, n_links)
        return on / (off + weights.birth[source] * rivals_begun + _SMALL * on)

    def backward(forward: np.ndarray) -> np.ndarray:
        taken = forward * goes_on
        rivals = np.maximum(sums(target, taken, n_dots)[target] - taken, 0.0)
        return goes_on / (alone[target] + rivals)

    later = backward(forward(goes_on / alone[target]))
    odds = forward(later) * later
    onward = forward(backward(on / (weights.end * coming)[source]))
    return Messages(onward, later, odds / (1.0 + odds))
