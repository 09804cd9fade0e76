"""The animal in the video as moving lines: keypoints without their outliers, between frames as well.

N frames, M markers, E links; px and s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_REACH = 0.05  # s on either side, of the frames that a marker's place is made of
_LEAST = 4  # of them with a detection
_LIKELY = 0.5  # detections that count
_ROUNDS = 4
_TUKEY = 4.685  # scales beyond which a detection is an outlier (Huber 1981)
_LEAST_PX = 0.5
_SEEN = 0.2  # of the frames, in which a marker must be to count


@dataclass(frozen=True, eq=False)
class Outline:
    """Markers of the animal and the lines between them.

    Attributes
    ----------
    time : (N,)
        Of the frames, s, growing.
    pixel, rate : (N, M, 2)
        Place of every marker, px, and how fast it moves, px/s; NaN where it is not known.
    edges : (E, 2) int
        Links, pairs of markers.
    noise_px : float
        Median of the markers' scatter about their own motion, px.
    """

    time: np.ndarray
    pixel: np.ndarray
    rate: np.ndarray
    edges: np.ndarray
    noise_px: float

    @property
    def size(self) -> float:
        """Of the animal in the picture: median diagonal of the box about its markers, px."""
        known = np.isfinite(self.pixel).all(axis=(1, 2))
        some = self.pixel[known] if known.sum() > 2 else self.pixel[np.isfinite(self.pixel).any(axis=(1, 2))]
        box = np.nanmax(some, axis=1) - np.nanmin(some, axis=1)
        return float(np.median(np.linalg.norm(box, axis=1)))

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places and rates (K, M, 2) at times (K,), linear between frames; NaN across gaps and outside."""
        step = float(np.median(np.diff(self.time)))
        after = np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1)
        before = after - 1
        length = self.time[after] - self.time[before]
        share = ((time - self.time[before]) / length)[:, None, None]
        inside = (time >= self.time[0]) & (time <= self.time[-1]) & (length < 3.5 * step)
        share = np.where(inside[:, None, None], share, np.nan)
        place = (1 - share) * self.pixel[before] + share * self.pixel[after]
        return place, (1 - share) * self.rate[before] + share * self.rate[after]


def outline_of(
    time: np.ndarray,
    position: np.ndarray,
    likelihood: np.ndarray,
    edges: Sequence[tuple[int, int]] | np.ndarray = (),
) -> Outline:
    """The outline of an animal from its detections.

    Every marker is fitted, at every frame, with a parabola through the frames about it (Savitzky and Golay
    1964), with Tukey's weights against outliers.

    Parameters
    ----------
    time : (N,)
        Of the frames, s.
    position, likelihood : (N, M, 2), (N, M)
        Detections, px, NaN where there is none.
    edges : (E, 2), optional
        Links between markers; by default the tree that joins them by distances that stay short.
    """
    seen = np.isfinite(position).all(axis=-1) & (likelihood >= _LIKELY)
    often = seen.mean(axis=0) >= _SEEN
    seen &= often
    period = float(np.median(np.diff(time)))
    half = max(2, round(_REACH / period))
    rows = np.arange(len(time))[:, None] + np.arange(-half, half + 1)
    whole = np.clip(rows, 0, len(time) - 1)
    since = time[whole] - time[:, None]
    near = (rows == whole) & (np.abs(since) <= (half + 0.5) * period)
    weight = first = _first_weights(position, seen)
    scale = np.ones(position.shape[1])
    for _ in range(_ROUNDS):
        pixel, rate = _parabolas(since / period, position, weight, whole, near)
        apart = np.linalg.norm(position - pixel, axis=-1)
        apart[~seen] = np.nan
        for m in np.flatnonzero(often):
            known = apart[:, m][np.isfinite(apart[:, m])]
            scale[m] = max(1.5 * float(np.median(known)) if len(known) else 1.0, _LEAST_PX)
        u = np.minimum(apart / (_TUKEY * scale), 1.0)
        weight = np.where(np.isfinite(u), (1 - u**2) ** 2, first)
    links = np.array(edges, dtype=int).reshape(-1, 2)
    links = links[often[links].all(axis=1)] if len(links) else _tree(pixel, often)
    noise = float(np.median(scale[often])) if often.any() else 1.0
    return Outline(time, pixel, rate / period, links, noise)


def _first_weights(position: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """1 where a detection is near the median of five frames about it, else 0: (N, M)."""
    padded = np.pad(
        np.where(seen[..., None], position, np.nan), ((2, 2), (0, 0), (0, 0)), constant_values=np.nan
    )
    windows = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0)
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # windows without any detection
        apart = np.linalg.norm(position - np.nanmedian(windows, axis=-1), axis=-1)
        apart[~seen] = np.nan
        scale = np.maximum(np.nanmedian(apart, axis=0), 3 * _LEAST_PX)
    return np.where(seen & (apart < 8 * scale), 1.0, 0.0)


def _parabolas(
    since: np.ndarray, position: np.ndarray, weight: np.ndarray, rows: np.ndarray, near: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Value and slope (N, M, 2) in the middle of weighted parabolas; NaN where too few detections are."""
    base = np.stack([np.ones_like(since), since, since**2], axis=-1)  # (N, W, 3)
    w = weight[rows] * near[..., None]  # (N, W, M)
    values = np.nan_to_num(position, nan=0.0)[rows]  # (N, W, M, 2)
    normal = np.einsum("nwm,nwi,nwj->nmij", w, base, base)
    right = np.einsum("nwm,nwi,nwmc->nmic", w, base, values)
    count = (w > 0.1).sum(axis=1)
    both = ((w > 0.1) & (since <= 0)[..., None]).any(1) & ((w > 0.1) & (since >= 0)[..., None]).any(1)
    known = (count >= _LEAST) & both
    normal[~known] = np.eye(3)
    found = np.linalg.solve(normal + 1e-9 * np.eye(3), right)
    found[~known] = np.nan
    return found[..., 0, :], found[..., 1, :]


def _tree(pixel: np.ndarray, often: np.ndarray) -> np.ndarray:
    """Links (E, 2): the tree of markers whose distances stay shortest (their 90 % quantile)."""
    from scipy.sparse.csgraph import minimum_spanning_tree

    names = np.flatnonzero(often)
    some = pixel[:: max(len(pixel) // 300, 1)][:, names]
    apart = np.linalg.norm(some[:, :, None] - some[:, None], axis=-1)
    known = np.isfinite(apart).sum(axis=0) > 2
    long = np.full(known.shape, np.inf)
    long[known] = np.nanquantile(apart[:, known], 0.9, axis=0)
    long[~np.isfinite(long)] = 0.0  # no link
    tree = minimum_spanning_tree(np.triu(long, 1)).tocoo()
    return np.column_stack([names[tree.row], names[tree.col]])


def nearest_link(
    place: np.ndarray, rate: np.ndarray, edges: np.ndarray, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far points (K, 2) are from the nearest link of markers at `place` (K, M, 2), moving at `rate`.

    Returns
    -------
    distance : (K,)
        With a sign that goes with the normal, px; NaN where no link is known.
    normal : (K, 2)
        Of the link, or from its end to the point.
    speed : (K,)
        Of the link at its nearest point, along the normal, px/s.
    """
    start, end = place[:, edges[:, 0]], place[:, edges[:, 1]]
    axis = end - start
    squared = np.maximum((axis**2).sum(-1), 1e-9)
    share = np.clip(((point[:, None] - start) * axis).sum(-1) / squared, 0.0, 1.0)
    offset = point[:, None] - start - share[..., None] * axis
    away = (offset**2).sum(-1)
    which = np.where(np.isnan(away), np.inf, away).argmin(axis=1)
    k = np.arange(len(point))
    offset, axis, share = offset[k, which], axis[k, which], share[k, which][:, None]
    side = np.stack([-axis[:, 1], axis[:, 0]], axis=1) / np.sqrt(squared[k, which])[:, None]
    length = np.linalg.norm(offset, axis=1)
    beyond = ((share <= 0) | (share >= 1))[:, 0] & (length > 0)
    normal = np.where(beyond[:, None], offset / np.maximum(length, 1e-9)[:, None], side)
    moving = (1 - share) * rate[k, edges[which, 0]] + share * rate[k, edges[which, 1]]
    return (offset * normal).sum(1), normal, (moving * normal).sum(1)
