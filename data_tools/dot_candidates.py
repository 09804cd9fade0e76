"""Which dots of later frames may be a dot's next, and how far animals move in a frame.

How far they move needs no link: around a dot, the next frame has one dot more than its own frame has (the
dot itself, a frame later). The number of pairs of dots of consecutive frames within a distance, less that of
pairs of one frame, is therefore the distribution of the displacements, however dense the dots are.
Shapes: P dots of one view sorted by frame, E links.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

_MOST_PAIRS = 10_000_000
_MOST_TRIPLES, _FEWEST, _MOST = 600_000, 3, 6
_NEIGHBOURS = 6
_REACH = 2.0  # of what nearly all links have
_SURE = 4.0  # standard errors


@dataclass(frozen=True, eq=False)
class Links:
    """Possible links.

    Attributes
    ----------
    source, target : (E,) int
        Dots; the target is later. Sorted by source.
    gap : (E,) int
        Frames from one to the other.
    unlisted : (P,)
        For each dot, the probability that its next one is further away than all that are listed.
    """

    source: np.ndarray
    target: np.ndarray
    gap: np.ndarray
    unlisted: np.ndarray

    def __len__(self) -> int:
        return len(self.source)

    def only(self, keep: np.ndarray) -> Links:
        """The links that a mask (E,) keeps."""
        return Links(self.source[keep], self.target[keep], self.gap[keep], self.unlisted)

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """All pairs (link, link that leaves its target), (T,) each."""
        low = np.searchsorted(self.source, self.target)
        count = np.searchsorted(self.source, self.target, side="right") - low
        first = np.repeat(np.arange(len(self)), count)
        return first, np.arange(count.sum()) + np.repeat(low - np.cumsum(count) + count, count)


@dataclass(frozen=True, eq=False)
class Displacements:
    """How far dots move in one frame.

    Attributes
    ----------
    radius : (B,)
        px.
    share : (B,)
        Share of the dots that have a next dot within the radius; at most one.
    found : float
        Share of the dots that are seen in the next frame again.
    """

    radius: np.ndarray
    share: np.ndarray
    found: float

    def quantile(self, q: float) -> float:
        """Radius within which the share q of those that have a next dot have it, px."""
        return float(self.radius[np.argmax(self.share >= q * self.share[-1])])


def measure_displacements(frame: np.ndarray, xy: np.ndarray) -> Displacements | None:
    """Displacements from one frame to the next, by the excess of pairs; None where there is no excess.

    Parameters
    ----------
    frame : (P,) int
        Sorted.
    xy : (P, 2)
        px.
    """
    size = float(np.hypot(*np.ptp(xy, axis=0))) + 1.0
    radius = np.geomspace(1e-3, size, 200)
    frames, start = np.unique(frame, return_index=True)
    stop = np.r_[start[1:], len(frame)]
    following = np.flatnonzero(np.diff(frames) == 1)
    cost = np.cumsum((stop - start)[following] * ((stop - start)[following] + (stop - start)[following + 1]))
    if not len(following):
        return None
    every = int(np.ceil(cost[-1] / _MOST_PAIRS))
    later, same = np.zeros(len(radius)), np.zeros(len(radius))
    n_dots = 0
    for f in following[:: max(every, 1)]:
        here, there = xy[start[f] : stop[f]], xy[start[f + 1] : stop[f + 1]]
        later += _histogram(here, there, radius)
        same += _histogram(here, here, radius) - np.r_[len(here), np.zeros(len(radius) - 1)]
        n_dots += len(here)
    later, same = np.cumsum(later), np.cumsum(same)
    excess = (later - same) / n_dots
    error = np.sqrt(later + same) / n_dots
    sure = np.flatnonzero(excess > np.maximum(_SURE * error, 0.02))
    if not len(sure):
        return None
    top = min(1.0, float((excess - 3.0 * error)[sure].max()))
    share = np.clip(np.maximum.accumulate(excess), 0.0, top)
    furthest = _REACH * radius[np.argmax(share >= 0.97 * top)]
    found = float(np.clip(excess[np.searchsorted(radius, furthest).clip(max=len(radius) - 1)], top, 1.0))
    return Displacements(radius, share, found)


def _histogram(here: np.ndarray, there: np.ndarray, radius: np.ndarray) -> np.ndarray:
    distance = np.hypot(*(here[:, None] - there[None]).reshape(-1, 2).T)
    return np.bincount(np.searchsorted(radius, distance).clip(max=len(radius) - 1), minlength=len(radius))


def local_density(frame: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Dots per px² around each dot in its own frame, mixed half and half with the mean of the view, (P,)."""
    n_frames = len(np.unique(frame))
    size = np.ptp(xy, axis=0) + 1.0
    mean = len(frame) / n_frames / float(size[0] * size[1])
    apart = float(np.hypot(*size)) * 2.0
    rows = np.column_stack([frame * apart, xy])
    distance, _ = cKDTree(rows).query(rows, k=_NEIGHBOURS + 1, distance_upper_bound=apart * 0.99)
    near = np.isfinite(distance).sum(1) - 1
    furthest = np.where(np.isfinite(distance), distance, 0.0).max(1)
    around = np.where(near > 0, near / (np.pi * np.maximum(furthest, 1.0) ** 2), mean)
    return 0.5 * (mean + around)


def find_candidates(frame: np.ndarray, xy: np.ndarray, moved: Displacements, max_gap: int) -> Links:
    """Pairs of dots close enough in space and time.

    Parameters
    ----------
    frame : (P,) int
        Sorted.
    xy : (P, 2)
        px.
    moved : Displacements
        How far dots move.
    max_gap : int
        Longest gap, frames from dot to dot.
    """
    reach = _REACH * moved.quantile(0.97)
    apart = 4.0 * reach * max_gap
    tree = cKDTree(np.column_stack([frame * apart, xy]))
    source, target, gaps = [], [], []
    unlisted = np.zeros(len(frame))
    most = int(np.clip(np.sqrt(_MOST_TRIPLES / len(frame)), _FEWEST, _MOST))
    for gap in range(1, max_gap + 1):
        query = np.column_stack([(frame + gap) * apart, xy])
        k = most if gap == 1 else max(most // 2, 1)
        distance, found = tree.query(query, k=np.arange(1, k + 1), distance_upper_bound=reach * gap**0.75)
        row, column = np.nonzero(np.isfinite(distance))
        source.append(row)
        target.append(found[row, column])
        gaps.append(np.full(len(row), gap))
        if gap == 1:
            full = np.isfinite(distance[:, -1])
            within = np.interp(distance[full, -1], moved.radius, moved.share / moved.share[-1])
            unlisted[full] = 1.0 - within
    s, t, g = np.concatenate(source), np.concatenate(target), np.concatenate(gaps)
    order = np.argsort(s, kind="stable")
    return Links(s[order], t[order], g[order], unlisted)
