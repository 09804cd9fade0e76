"""Which detection belongs to which marker: exchanged sides, and several candidates for one marker.

Between two fits the trajectory predicts where every marker should be seen; here the detections are assigned
to markers so that the losses Σ ρ((z − prediction)/σ) of the trajectory problem fall as far as they can. Two
kinds of hypotheses compete:

* *candidates*: for one marker the detector offers several places. Each costs its loss and the log-ratio of
  the likelihoods of the first place and of this one;
* *left and right*: the detections of a limb and of its twin may have changed places, or those of the whole
  animal. In every camera a hidden Markov chain runs over the frames, whose states are the sets of exchanged
  limbs. Every limb in the set costs :data:`RARE` a frame, every limb that enters or leaves it ``hysteresis``;
  the whole animal counts as one limb, so k of G limbs count as min(k, 1 + G − k). The chain of least total
  cost is found by dynamic programming (Viterbi 1967; Rabiner 1989, section III.B).

With the same σ, fits and assignments lower one objective in turn, so their alternation does not run in
circles.

What the costs mean: a limb is exchanged in a single frame only if that saves T = 2 · ``hysteresis`` + RARE.
Let D = Σ |left − right|²/σ² over its pairs of predicted pixels. Under Gaussian noise of this σ an exchange
saves a normal variate of variance 2 D, with mean D where the sides are exchanged and −D where they are not.
Thus a swap in a single frame is found with probability Φ((D − T)/√(2D)), and a false alarm has the
probability Φ(−(D + T)/√(2D)), at most Φ(−√(2T)), where D = T.

Shapes: N frames, C cameras, M markers, K candidates, G limbs, S sets of limbs.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from acino_fte.losses import Loss
from acino_fte.skeleton import Skeleton

# nats, a limb. With RARE it makes T = 8: noise alone gives no more than one false alarm in 30000 frames. In
# simulated recordings of three species the swaps found and the false alarms hardly depend on it from 1 to 6.
HYSTERESIS = 3.0
RARE = 2.0  # nats, a limb and frame: log-odds of 1 frame in 8. Weak evidence does not add up over many frames
KEEP = 1.0  # nats: a marker changes to another candidate only if that saves more
_AT_ONCE = 3  # most limbs that are exchanged independently of each other and of the whole animal
_FLOOR = 1e-3  # likelihoods below this count as this
_SHOWN = 8  # ranges of frames listed in a finding


@dataclass(frozen=True, eq=False)
class Assignment:
    """Detections assigned to markers.

    Attributes
    ----------
    pixels : (N, C, M, 2)
        The detection of each marker, px, NaN where there is none.
    swapped : (N, C, M) bool
        It was detected as the marker's twin.
    candidate : (N, C, M) int
        Which candidate it is, of the marker or, if swapped, of its twin; 0 is the first.
    """

    pixels: np.ndarray
    swapped: np.ndarray
    candidate: np.ndarray

    @property
    def n_swapped(self) -> int:
        """Number of detections that changed sides."""
        return int(self.swapped.sum())

    @property
    def n_changed(self) -> int:
        """Number of detections that changed sides, or are not the first candidate."""
        return int((self.swapped | (self.candidate > 0)).sum())

    def n_different(self, other: Assignment) -> int:
        """Number of detections that another assignment takes from elsewhere."""
        return int(((self.swapped != other.swapped) | (self.candidate != other.candidate)).sum())

    def findings(self, cameras: list[str], frames: np.ndarray, skeleton: Skeleton) -> list[str]:
        """What was changed, a sentence or two for each camera where anything was.

        ``frames`` (N,) are frame numbers; ranges of them are half-open.
        """
        limbs = limb_groups(skeleton)
        found = []
        for c, camera in enumerate(cameras):
            exchanged = self._exchanged(c, frames, limbs)
            if exchanged:
                count = int(self.swapped[:, c].any(axis=-1).sum())
                found.append(
                    f"{camera}: left and right exchanged in {count} of {len(frames)} frames: {exchanged}"
                )
            other = (self.candidate[:, c] > 0).sum(axis=0)
            if other.any():
                names = [f"{skeleton.markers[m].name} {other[m]}" for m in np.argsort(-other) if other[m]]
                what = "detections are not the detector's first choice"
                found.append(f"{camera}: {other.sum()} {what}: {', '.join(names)}")
        return found

    def _exchanged(self, c: int, frames: np.ndarray, limbs: list[tuple[str, np.ndarray]]) -> str:
        """Limbs and frames in which they were exchanged in one camera; the whole animal counts as one."""
        if not limbs:
            return ""
        flags = np.stack([self.swapped[:, c, pairs.ravel()].any(axis=-1) for _, pairs in limbs], axis=1)
        seen = np.isfinite(self.pixels[:, c, :, 0])
        there = np.stack([seen[:, pairs.ravel()].any(axis=-1) for _, pairs in limbs], axis=1)
        whole = (flags | ~there).all(axis=1) & (flags.sum(axis=1) > 1)
        parts = [("the whole animal", whole)]
        parts += [(name, flags[:, g] & ~whole) for g, (name, _) in enumerate(limbs)]
        return "; ".join(f"{name} in {f.sum()} ({_ranges(frames[f])})" for name, f in parts if f.any())


def _ranges(numbers: np.ndarray) -> str:
    """Frame numbers as half-open ranges: ``3:6, 17``."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    texts = [f"{r[0]}:{r[-1] + 1}" if len(r) > 1 else f"{r[0]}" for r in runs]
    more = len(texts) - _SHOWN
    return ", ".join(texts[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def limb_groups(skeleton: Skeleton) -> list[tuple[str, np.ndarray]]:
    """Twin markers by limb: (name, indices (pairs, 2) of the left and the right markers).

    Twins belong to one limb when their links hang on one chain below the link that both sides share (the fore
    limbs of a cheetah: shoulder, knee, ankle, paw), or sit on one link themselves (eyes and ears). Names are
    made of the markers' names without what tells the sides apart: ``shoulder to front_paw``.
    """
    members: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for left, right in skeleton.twins:
        pair = skeleton.marker(left), skeleton.marker(right)
        members.setdefault(_limb_roots(skeleton, *pair), []).append(pair)
    limbs = []
    for pairs in members.values():
        names = [_common_name(skeleton.markers[a].name, skeleton.markers[b].name) for a, b in pairs]
        limbs.append((names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}", np.array(pairs)))
    return limbs


def _limb_roots(skeleton: Skeleton, left: int, right: int) -> tuple[int, int]:
    """First links of the two chains that carry a left and a right marker, below the link that both share."""
    chains: list[list[int]] = []
    for marker in (left, right):
        link, chain = skeleton.markers[marker].link, list[int]()
        while link >= 0:
            chain.insert(0, link)
            link = skeleton.links[link].parent
        chains.append(chain)
    ours, theirs = chains
    shared = next((i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b), None)
    if shared is None:  # on one link, or one on a link that carries the other
        return ours[-1], theirs[-1]
    return ours[shared], theirs[shared]


def _common_name(left: str, right: str) -> str:
    """What two names have in common, word by word; the left name when that is nothing."""
    words = [a for a, b in zip(left.split("_"), right.split("_"), strict=False) if a == b]
    return "_".join(words) or left


def resolve(
    skeleton: Skeleton,
    detections: np.ndarray,
    predicted: np.ndarray,
    sd_px: np.ndarray,
    loss: Loss,
    *,
    candidates: np.ndarray | None = None,
    candidate_likelihood: np.ndarray | None = None,
    previous: Assignment | None = None,
    hysteresis: float = HYSTERESIS,
) -> Assignment:
    """Assign detections to markers, given where the markers should be seen.

    Parameters
    ----------
    skeleton : Skeleton
        For its twins.
    detections : (N, C, M, 2)
        px, NaN where missing. They are the only candidates if there are no others.
    predicted : (N, C, M, 2)
        px; where it is NaN (behind a camera) nothing is changed on its account.
    sd_px : (M,)
        Standard deviation of the detections, px.
    loss : Loss
        Of the trajectory problem. A bounded one, so that one gross error cannot outvote the rest of a limb.
    candidates : (N, C, M, K, 2), optional
        px, NaN where there are fewer; the first ones are the detections.
    candidate_likelihood : (N, C, M, K), optional
        Without it all candidates are equally likely.
    previous : Assignment, optional
        Of the last round: its candidates stay unless others save more than :data:`KEEP`. Without it the
        first candidates do.
    hysteresis : float
        Cost of a limb's change from "as detected" to "exchanged" or back, nats.
    """
    places = detections[..., None, :] if candidates is None else candidates
    unlikely = _unlikeliness(candidate_likelihood, places)
    before = np.zeros(places.shape[:3], dtype=int) if previous is None else previous.candidate
    swapped_before = np.zeros(places.shape[:3], dtype=bool) if previous is None else previous.swapped
    twin = np.arange(len(skeleton.markers))
    limbs = [pairs for _, pairs in limb_groups(skeleton)]
    for pairs in limbs:
        twin[pairs] = pairs[:, ::-1]
    own = _best(places, unlikely, predicted, sd_px, loss, np.where(swapped_before, 0, before))
    places, unlikely = places[:, :, twin], unlikely[:, :, twin]
    other = _best(places, unlikely, predicted, sd_px, loss, np.where(swapped_before, before, 0))
    known = np.isfinite(predicted).all(axis=-1)
    saved = np.where(known & known[..., twin], own.cost - other.cost, 0.0)
    exchanged = _exchanges(saved, limbs, hysteresis)
    pixels = np.where(exchanged[..., None], other.pixels, own.pixels)
    there = np.isfinite(pixels).all(axis=-1)
    candidate = np.where(exchanged, other.candidate, own.candidate)
    return Assignment(pixels, exchanged & there, np.where(there, candidate, 0))


def _unlikeliness(likelihood: np.ndarray | None, places: np.ndarray) -> np.ndarray:
    """log(likelihood of the first candidate / likelihood of each), (N, C, M, K)."""
    if likelihood is None:
        return np.zeros(places.shape[:-1])
    logs = np.log(np.maximum(np.nan_to_num(likelihood), _FLOOR))
    return logs[..., :1] - logs


@dataclass(frozen=True, eq=False)
class _Best:
    """Best candidates: cost (N, C, M), 0 where there are none; number (N, C, M); pixels (N, C, M, 2)."""

    cost: np.ndarray
    candidate: np.ndarray
    pixels: np.ndarray


def _best(
    places: np.ndarray,
    unlikely: np.ndarray,
    predicted: np.ndarray,
    sd_px: np.ndarray,
    loss: Loss,
    favourite: np.ndarray,
) -> _Best:
    """The candidate of least cost for every marker; the others cost :data:`KEEP` more than the favourite."""
    there = np.isfinite(places).all(axis=-1)
    e = (places - predicted[..., None, :]) / sd_px[:, None, None]
    cost = unlikely + loss.value(np.nan_to_num(e)).sum(axis=-1)
    cost = np.where(there, cost, np.inf)
    handicap = KEEP * (np.arange(places.shape[3]) != favourite[..., None])
    chosen = np.argmin(cost + handicap, axis=-1)
    cost = np.take_along_axis(cost, chosen[..., None], axis=-1)[..., 0]
    pixels = np.take_along_axis(places, chosen[..., None, None], axis=-2)[..., 0, :]
    return _Best(np.where(np.isfinite(cost), cost, 0.0), chosen, pixels)


def _exchanges(saved: np.ndarray, limbs: list[np.ndarray], hysteresis: float) -> np.ndarray:
    """Markers (N, C, M) bool whose limb is exchanged, from what each saves by it (N, C, M), nats."""
    exchanged = np.zeros(saved.shape, dtype=bool)
    if not limbs:
        return exchanged
    gain = np.stack([saved[..., pairs.ravel()].sum(axis=-1) for pairs in limbs], axis=-1)  # (N, C, G)
    sets = np.array(list(product((False, True), repeat=len(limbs))))  # (S, G), the first one empty
    sets = sets[_count(sets) <= _AT_ONCE]
    change = hysteresis * _count(sets[:, None] ^ sets)
    chain = viterbi(RARE * _count(sets) - gain @ sets.T, change)
    for g, pairs in enumerate(limbs):
        exchanged[..., pairs.ravel()] = sets[chain, g, None]
    return exchanged


def _count(sets: np.ndarray) -> np.ndarray:
    """Number of limbs in sets (…, G) bool, the whole animal being one limb."""
    size = sets.sum(axis=-1)
    return np.minimum(size, 1 + sets.shape[-1] - size)


def viterbi(cost: np.ndarray, change: np.ndarray) -> np.ndarray:
    """States of least total cost of many chains side by side, (N, C) int.

    ``cost`` (N, C, S) is what each state costs in each frame, ``change`` (S, S) what it costs to go from the
    first to the second. Where several are equal the first state is taken.
    """
    n_frames, n_chains, _ = cost.shape
    total = cost[0]
    before = np.zeros(cost.shape, dtype=np.int16)
    for n in range(1, n_frames):
        through = total[:, :, None] + change
        before[n] = through.argmin(axis=1)
        total = through.min(axis=1) + cost[n]
    states = np.empty((n_frames, n_chains), dtype=int)
    states[-1] = total.argmin(axis=1)
    for n in range(n_frames - 1, 0, -1):
        states[n - 1] = before[n, np.arange(n_chains), states[n]]
    return states
