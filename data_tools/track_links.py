"""Does a piece of track go on as another piece of the same view? Log-odds from how the animals move.

A piece is carried on from its end in a straight line, the later one backwards from its beginning. How far
such guesses miss after a gap of g frames is learnt from the unbroken tracks of the same view, in units of the
root of the noise and of the animal's own last steps, so that a bird on a perch and a bird in flight both get
their due. The odds set the density of the miss (Student's t: animals turn) against the rate of pieces that
begin there for another reason, and then against all other continuations of either piece: only an unambiguous
link counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from acino_fte.data_tools.track_dots import runs

_FIT = 4
_LONGEST, _AGREE = 32, 3.0
_TAIL = 4.0  # degrees of freedom of the t distribution
_LEAST = 30
_FAR, _BATCH = 12.0, 1_000_000
_CALM, _CROWD = 0.2, 5.0
_SAMPLE = 4_000


@dataclass(frozen=True, eq=False)
class ViewPieces:
    """Pieces of one view. Rows are sorted by piece, then by frame.

    Attributes
    ----------
    frame : (P,) int
    xy : (P, 2)
        px.
    start : (K + 1,) int
        Rows of piece k are ``start[k]:start[k + 1]``.
    """

    frame: np.ndarray
    xy: np.ndarray
    start: np.ndarray

    @property
    def n(self) -> int:
        """K."""
        return len(self.start) - 1

    @property
    def first(self) -> np.ndarray:
        """Frame of the first dot of each piece, (K,)."""
        return self.frame[self.start[:-1]]

    @property
    def last(self) -> np.ndarray:
        """Frame of the last dot of each piece, (K,)."""
        return self.frame[self.start[1:] - 1]


def link_pieces(pieces: ViewPieces, noise: float, max_gap: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pieces that may continue one another.

    Parameters
    ----------
    pieces : ViewPieces
        Of one view.
    noise : float
        σ, px.
    max_gap : int
        Longest gap looked at, frames from the last dot to the next.

    Returns
    -------
    earlier, later : (E,) int
        Pieces.
    weight : (E,)
        Log-odds against every other continuation of either; only positive ones.
    """
    if not _any_follows(pieces, max_gap):
        none = np.empty(0, dtype=np.int64)
        return none, none, np.empty(0)
    model = _learn(pieces, noise, max_gap)
    tail = _ends(pieces, noise, forwards=True)
    head = _ends(pieces, noise, forwards=False)
    earlier, later = _candidates(pieces, _useful_gap(pieces, tail, model, max_gap))
    near = _within_reach(tail, head, earlier, later, pieces, model)
    earlier, later = earlier[near], later[near]
    if not len(earlier):
        return earlier, later, np.empty(0)
    gap = pieces.first[later] - pieces.last[earlier]
    moving = 0.5 * (
        _log_density(tail, earlier, head.place[later], gap, model)
        + _log_density(head, later, tail.place[earlier], gap, model)
    )
    resting = _log_density_at_rest(tail, head, earlier, later, gap, model)
    both_still = tail.still[earlier] & head.still[later]
    density = np.where(both_still, resting, moving)
    odds = _against_chance(density, gap, later, pieces)
    good = odds > -3.0
    earlier, later, odds = earlier[good], later[good], odds[good]
    rival = np.maximum(_rivals(earlier, later, odds, pieces), _rivals(later, earlier, odds, pieces))
    weight = odds - rival
    keep = weight > 0
    return earlier[keep], later[keep], weight[keep]


@dataclass(frozen=True, eq=False)
class _Ends:
    """One end of every piece.

    Place (K, 2), px; velocity away from the piece (K, 2), px/frame; scale (K,), px; whether it is still (K,).
    """

    place: np.ndarray
    velocity: np.ndarray
    scale: np.ndarray
    still: np.ndarray

    @cached_property
    def speed(self) -> np.ndarray:
        """(K,) px/frame."""
        return np.linalg.norm(self.velocity, axis=1)


def _ends(pieces: ViewPieces, noise: float, forwards: bool) -> _Ends:
    """Place and velocity of one end of every piece.

    The last dots are averaged over the longest run of 2, 4, 8 … of them whose halves agree within the noise;
    a piece that stands still so far has no velocity. Otherwise the velocity is that of the last few dots.
    """
    rows = pieces.start[1:] - 1 if forwards else pieces.start[:-1]
    n_dots = np.diff(pieces.start)
    sums = np.vstack([np.zeros((1, 2)), np.cumsum(pieces.xy, axis=0)])

    def mean(count: np.ndarray) -> np.ndarray:
        low = rows + 1 - count if forwards else rows
        return (sums[low + count] - sums[low]) / count[:, None]

    used = np.ones(pieces.n, dtype=np.int64)
    place = pieces.xy[rows]
    open_ = np.ones(pieces.n, dtype=bool)
    count = 2
    while count <= _LONGEST:
        open_ &= n_dots >= count
        counts = np.where(open_, count, 1)
        longer = mean(counts)
        shift = ((longer - place) ** 2).sum(1)
        open_ &= shift < _AGREE * noise**2 * (2.0 / count - 1.0 / count) * 2
        place = np.where(open_[:, None], longer, place)
        used = np.where(open_, count, used)
        count *= 2
    back = np.minimum(n_dots - 1, _FIT)
    other = rows - back if forwards else rows + back
    frames = np.abs(pieces.frame[rows] - pieces.frame[other])
    velocity, scale = _motion(pieces.xy[rows] - pieces.xy[other], frames, noise)
    still = used >= 2 * _FIT
    velocity = np.where(still[:, None], 0.0, velocity)
    place = np.where(still[:, None], place, pieces.xy[rows])
    return _Ends(place, velocity, np.where(still, noise / np.sqrt(used), scale), still)


def _motion(moved: np.ndarray, frames: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (px/frame) and scale (noise and step together, px) of displacements over some frames."""
    frames = np.maximum(frames, 1)
    squared = (moved**2).sum(1)
    sure = squared / (squared + 4 * noise**2)  # of two coordinates, two dots
    velocity = moved * (sure / frames)[:, None]
    return velocity, np.sqrt(noise**2 + (velocity**2).sum(1))


@dataclass(frozen=True, eq=False)
class _Model:
    """Typical miss per gap, (G,): of a line and of no motion in units of the scale, and of a rest in px."""

    gap: np.ndarray
    line: np.ndarray
    none: np.ndarray
    rest: np.ndarray


def _learn(pieces: ViewPieces, noise: float, max_gap: int) -> _Model:
    """Medians of the misses of guesses inside pieces, for gaps 1, 2, 3, 5, 8 …"""
    found: list[tuple[float, float, float, float]] = []
    piece = np.repeat(np.arange(pieces.n), np.diff(pieces.start))
    sums = np.vstack([np.zeros((1, 2)), np.cumsum(pieces.xy, axis=0)])
    gap, following = 1, 2
    while gap <= max_gap:
        rows = _runs(pieces, piece, _FIT + gap)
        if len(rows) < _LEAST:
            break
        here, there = pieces.xy[rows + _FIT], pieces.xy[rows + _FIT + gap]
        velocity, scale = _motion(here - pieces.xy[rows], np.full(len(rows), _FIT), noise)
        line = _typical((there - here - gap * velocity) / scale[:, None])
        none = _typical((there - here) / scale[:, None])
        half = 2 * _FIT
        rows = _runs(pieces, piece, 2 * half + gap - 2)
        before, after = (
            sums[rows + half] - sums[rows],
            sums[rows + 2 * half + gap - 1] - sums[rows + half + gap - 1],
        )
        calm = _typical((after - before) / half) if len(rows) >= _LEAST else np.inf
        rest = np.sqrt(max(calm**2 - 2 * noise**2 / half, 0.0))
        found.append((gap, max(line, 0.7), max(none, 0.7), rest))
        gap, following = following, gap + following
    if not found:
        return _Model(np.array([1.0]), np.array([2.0]), np.array([3.0]), np.array([noise]))
    gaps, *misses = np.array(found).T
    return _Model(gaps, *(np.maximum.accumulate(miss) for miss in misses))


def _runs(pieces: ViewPieces, piece: np.ndarray, span: int) -> np.ndarray:
    """Rows from which `span` further frames follow without a gap in one piece; an even choice of many."""
    rows = np.arange(max(len(piece) - span, 0))
    rows = rows[piece[rows] == piece[rows + span]]
    rows = rows[pieces.frame[rows + span] - pieces.frame[rows] == span]
    return rows[:: max(1, len(rows) // _SAMPLE)]


def _typical(miss: np.ndarray) -> float:
    """Scale of a bivariate t distribution from the median of its radius."""
    return float(np.median(np.linalg.norm(miss, axis=1)) / np.sqrt(_TAIL * (2 ** (2 / _TAIL) - 1)))


def _log_density(
    ends: _Ends, which: np.ndarray, place: np.ndarray, gap: np.ndarray, model: _Model
) -> np.ndarray:
    """Log-density of finding a place, 1/px²; of a straight line or of no motion, whichever misses less."""
    beyond = np.maximum(gap / model.gap[-1], 1.0) * ends.scale[which]
    line, none = (
        np.interp(gap, model.gap, model.line) * beyond,
        np.interp(gap, model.gap, model.none) * beyond,
    )
    straight = line <= none
    guess = ends.place[which] + np.where(straight, gap, 0)[:, None] * ends.velocity[which]
    return _log_t(((place - guess) ** 2).sum(1), np.where(straight, line, none))


def _log_density_at_rest(
    tail: _Ends, head: _Ends, earlier: np.ndarray, later: np.ndarray, gap: np.ndarray, model: _Model
) -> np.ndarray:
    """Log-density, 1/px², of where a piece begins at rest, when the earlier one ended at rest."""
    drift = np.interp(gap, model.gap, model.rest) * np.sqrt(np.maximum(gap / model.gap[-1], 1.0))
    scale = np.sqrt(tail.scale[earlier] ** 2 + head.scale[later] ** 2 + np.minimum(drift, 1e6) ** 2)
    return _log_t(((head.place[later] - tail.place[earlier]) ** 2).sum(1), scale)


def _log_t(squared: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Log of the bivariate t density at a squared distance, 1/px²."""
    return -np.log(2 * np.pi * scale**2) - (_TAIL + 2) / 2 * np.log1p(squared / scale**2 / _TAIL)


def _against_chance(
    density: np.ndarray, gap: np.ndarray, later: np.ndarray, pieces: ViewPieces
) -> np.ndarray:
    """Log-odds of each link against a piece that begins there by chance.

    Both the distribution of the gaps and the rate of beginnings that no link explains (1/px² and frame) are
    those of the recording: the links that are likely so far are counted, three times over.
    """
    size = np.ptp(pieces.xy, axis=0) + 1.0
    frames = float(pieces.frame.max() - pieces.frame.min() + 1)
    longest = int(gap.max())
    share = np.full(longest + 1, 1.0 / longest)
    begun = float(pieces.n)
    for _ in range(4):
        odds = density + np.log(share[gap]) - np.log(begun / (size[0] * size[1] * frames))
        best = np.full(pieces.n, -np.inf)
        np.maximum.at(best, later, odds)
        begun = 1.0 + float((best < 0).sum())
        chosen = (odds > 0) & (odds >= best[later])
        count = np.bincount(gap[chosen], minlength=longest + 1) + 3.0 / longest
        share = count / count[1:].sum()
    return odds


def _any_follows(pieces: ViewPieces, max_gap: int) -> bool:
    """Whether any piece begins within the longest gap after another has ended."""
    first = np.sort(pieces.first)
    low, high = (np.searchsorted(first, pieces.last + gap, side="right") for gap in (0, max_gap))
    return bool((high > low).any())


def _candidates(pieces: ViewPieces, max_gap: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of pieces of which one begins after the other has ended, within the longest gap."""
    order = np.argsort(pieces.first, kind="stable")
    first = pieces.first[order]
    low = np.searchsorted(first, pieces.last, side="right")
    count = np.searchsorted(first, pieces.last + max_gap, side="right") - low
    earlier = np.repeat(np.arange(pieces.n), count)
    later = order[runs(low, count)]
    return earlier, later


def _useful_gap(pieces: ViewPieces, tail: _Ends, model: _Model, max_gap: int) -> int:
    """Longest gap in which few other pieces begin where even a calm animal may have got to, frames."""
    calm = np.quantile(tail.scale, _CALM) * np.minimum(model.line, model.none)
    spread = np.minimum(calm, np.maximum(model.rest, calm / _LONGEST)) if tail.still.mean() > _CALM else calm
    size = np.ptp(pieces.xy, axis=0) + 1.0
    begin = pieces.n / (size[0] * size[1] * (np.ptp(pieces.frame) + 1.0))
    crowded = begin * model.gap * 2 * np.pi * spread**2 > _CROWD
    return int(min(model.gap[np.argmax(crowded)], max_gap)) if crowded.any() else max_gap


def _within_reach(
    tail: _Ends, head: _Ends, earlier: np.ndarray, later: np.ndarray, pieces: ViewPieces, model: _Model
) -> np.ndarray:
    """Candidates that the motion could join at all; spares most of the work when there are many animals."""
    near = np.empty(len(earlier), dtype=bool)
    for start in range(0, len(earlier), _BATCH):
        part = slice(start, start + _BATCH)
        e, k = earlier[part], later[part]
        gap = pieces.first[k] - pieces.last[e]
        beyond = np.maximum(gap / model.gap[-1], 1.0)
        miss = (
            np.minimum(np.interp(gap, model.gap, model.line), np.interp(gap, model.gap, model.none)) * beyond
        )
        rest = np.interp(gap, model.gap, np.minimum(model.rest, 1e6)) * np.sqrt(beyond)
        carried = gap * np.maximum(tail.speed[e], head.speed[k])
        limit = carried + _FAR * (miss * np.maximum(tail.scale[e], head.scale[k]) + rest)
        near[part] = ((head.place[k] - tail.place[e]) ** 2).sum(1) < limit**2
    return near


def _rivals(who: np.ndarray, other: np.ndarray, odds: np.ndarray, pieces: ViewPieces) -> np.ndarray:
    """Log of one (no link) plus the odds of the links of the same piece that this one excludes, (E,).

    Two continuations exclude each other when they are there at the same time.
    """
    order = np.argsort(who, kind="stable")
    low = np.searchsorted(who[order], who)
    count = np.searchsorted(who[order], who, side="right") - low
    mine = np.repeat(np.arange(len(who)), count)
    rival = order[runs(low, count)]
    first, last = pieces.first[other], pieces.last[other]
    clash = (first[mine] <= last[rival]) & (first[rival] <= last[mine]) & (mine != rival)
    mine, rival = mine[clash], rival[clash]
    return np.log1p(np.bincount(mine, weights=np.exp(np.minimum(odds[rival], 50.0)), minlength=len(who)))
