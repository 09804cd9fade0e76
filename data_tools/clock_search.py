"""The offset between the clocks of two cameras, to a frame: where the rays to common individuals meet.

For every whole offset the distances between the rays of the two cameras are averaged, log(1 + z²/9) each, so
that wrong identities hardly count; in parts of the recording, so that clocks that drift are found too.
Shapes: O offsets, B parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.timed_rays import TimedRays, misses

_SAMPLES = 1000
_PARTS = 8
_FASTEST = 1e-3  # drift between two clocks that is looked for, frames per frame
_WIDTH = 3.0  # miss that counts half as much as it should, in standard deviations for one pixel
_FEWEST = 30  # samples of an offset
_CLEAR = 3.0  # standard errors between the best offset and the next hollow


@dataclass(frozen=True)
class PairOffset:
    """Offset and drift of camera a's clock less that of camera b, to a frame.

    Attributes
    ----------
    a, b : int
        Indices of the cameras.
    offset, drift : float
        Frames; frames per frame.
    contrast : float
        How much lower the cost is than its median over all offsets, in standard errors.
    n : int
        Dots of camera a with one of camera b at this offset.
    notes : tuple of str
    """

    a: int
    b: int
    offset: float
    drift: float
    contrast: float
    n: int
    notes: tuple[str, ...] = ()


def search_pairs(
    rays: Sequence[TimedRays], max_offset: int, middle: float, drift: bool
) -> tuple[PairOffset, ...]:
    """The offsets of all pairs of cameras that have individuals in common."""
    found = []
    for a in range(len(rays)):
        for b in range(a + 1, len(rays)):
            pair = _search(rays[a], rays[b], max_offset, middle, drift)
            if pair is not None:
                offset, slope, contrast, n, notes = pair
                found.append(PairOffset(a, b, offset, slope, contrast, n, notes))
    return tuple(found)


def _search(
    a: TimedRays, b: TimedRays, max_offset: int, middle: float, drift: bool
) -> tuple[float, float, float, int, tuple[str, ...]] | None:
    offsets = np.arange(-max_offset, max_offset + 1)
    rows = _thinned(a, b, max_offset)
    if len(rows) < _FEWEST:
        return None
    there = b.row(a.individual[rows, None], a.frame[rows, None] + offsets)
    z = misses(a, b, np.broadcast_to(rows[:, None], there.shape), there)
    cost = np.where(there >= 0, np.log1p((z / _WIDTH) ** 2), 0.0)
    part = np.arange(len(rows)) * _PARTS // len(rows)
    total = np.stack([cost[part == i].sum(0) for i in range(_PARTS)])
    count = np.stack([(there[part == i] >= 0).sum(0) for i in range(_PARTS)])
    when = np.array([a.frame[rows][part == i].mean() for i in range(_PARTS)]) - middle
    ends = int(np.ceil(_FASTEST * np.abs(when).max())) if drift else 0
    best: tuple[float, int, float, np.ndarray, np.ndarray] | None = None
    for end in sorted(range(-ends, ends + 1), key=abs):
        slope = end / max(float(np.abs(when).max()), 1.0)
        place = np.arange(len(offsets)) + np.round(slope * when).astype(int)[:, None]
        inside = (place >= 0) & (place < len(offsets))
        place = np.clip(place, 0, len(offsets) - 1)
        sums = np.where(inside, np.take_along_axis(total, place, 1), 0.0)
        counts = np.where(inside, np.take_along_axis(count, place, 1), 0)
        n = counts.sum(0)
        usable = n >= max(_FEWEST, 0.3 * n.max())
        mean = np.where(usable, sums.sum(0) / np.maximum(n, 1), np.inf)
        if usable.any() and (best is None or mean.min() < best[0] - 1e-6):
            best = (float(mean.min()), int(np.argmin(mean)), slope, sums, counts)
    if best is None:
        return None
    _, at, slope, sums, counts = best
    contrast, notes = _clarity(sums, counts, at)
    if at in (0, len(offsets) - 1):
        notes += (f"the best offset, {offsets[at]}, is the last that was tried: allow greater ones.",)
    return float(offsets[at]), slope, contrast, int(counts[:, at].sum()), notes


def _thinned(a: TimedRays, b: TimedRays, max_offset: int) -> np.ndarray:
    """Dots of a whose individual b sees within reach of the search, in order of time, a thousand or two."""
    if not (len(a.frame) and len(b.frame)):
        return np.zeros(0, int)
    seen = np.unique(b.individual)
    ok = np.isin(a.individual, seen)
    ok &= (a.frame >= b.frame.min() - max_offset) & (a.frame <= b.frame.max() + max_offset)
    rows = np.flatnonzero(ok)
    rows = rows[np.argsort(a.frame[rows], kind="stable")]
    return rows[:: max(1, len(rows) // _SAMPLES)]


def _clarity(sums: np.ndarray, counts: np.ndarray, at: int) -> tuple[float, tuple[str, ...]]:
    """How clear the best offset is against all others, and a note when another hollow is as deep."""
    filled = counts[:, at] > 0
    mean = sums[filled] / np.maximum(counts[filled], 1)
    mean = np.where(counts[filled] > 0, mean, mean[:, at, None])
    weight = counts[filled, at]
    above = mean - mean[:, at, None]
    curve = np.average(above, axis=0, weights=weight)
    scatter = np.sqrt(np.average((above - curve) ** 2, axis=0, weights=weight) / max(filled.sum() - 1, 1))
    clear = curve / np.maximum(scatter, 1e-9 + 0.02 * curve.max())
    hollows = np.flatnonzero((curve[1:-1] <= curve[:-2]) & (curve[1:-1] <= curve[2:])) + 1
    level = float(np.median(curve))
    close = [int(i) for i in hollows if abs(i - at) > 2 and clear[i] < _CLEAR]
    rivals = [i for i in close if _ridge(curve, at, i) > 0.5 * level]
    notes: tuple[str, ...] = ()
    if rivals and level > 0:
        near = min((i - at for i in rivals), key=abs)
        notes = (f"an offset of {near:+d} frames from the best one is almost as good.",)
    return float(np.median(clear)), notes


def _ridge(curve: np.ndarray, one: int, other: int) -> float:
    """The highest point of a curve between two places."""
    return float(curve[min(one, other) : max(one, other) + 1].max())
