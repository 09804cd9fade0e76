"""When the video was taken, by the animal itself: the lag at which the lidar's returns lie on its links.

Camera and lidar are fixed to each other and calibrated, so every return has a place in the picture. At the
right lag, returns from the animal lie on the lines between its markers; legs that swing past tell the time to
a millisecond. The returns at the animal's distance are told from grass and bushes by the distance that is
frequent on the animal and not beside it.

Steps: a search of all lags on a raster of the picture; the best few refined by robust least squares for the
lag and a constant shift of the picture (an error of the calibration does not pass for time); a verdict.
K returns, N frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acino_fte.data_tools.sync_outline import Outline, nearest_link
from acino_fte.errors import InputError

_THICK = 0.03  # of the animal's size: about half the thickness of a trunk, and more than that of a leg
_WIDE, _RING = 2.0, 6.0  # thicknesses: half widths of the lines of the raster, and of what lies beside them
_CELLS = 192  # the most of the raster along the picture
_WINDOW = 0.25  # s, in which the animal has one distance
_BIN = 0.5  # m
_FASTEST = 15.0  # m/s towards the camera or away
_REACH = 400.0  # m
_BLOCKS = 12  # of time, for the standard deviation
_TRIED = 6  # candidates that are refined
_ROUNDS = 25
_MOST_LOST = 6  # frames, by which a quarter of the video may be beside the others
_LEAST_RETURNS = 40
_FLOOR = 1e-3  # s: a body is no bundle of lines
_LEAST_SIGMAS = 3.0  # of the difference to the next best lag
_LEAST_COVER = 0.5  # of the frames with an animal, that have returns
_MOST_SD = 1.0  # frames
_SAME = 1.5  # frames: lags of one peak


@dataclass(frozen=True, eq=False)
class Glimpses:
    """Lidar returns in the picture: `time` (K,), s; `pixel` (K, 2); `depth` (K,) along the axis, m."""

    time: np.ndarray
    pixel: np.ndarray
    depth: np.ndarray

    def rows(self, which: np.ndarray) -> Glimpses:
        """Some of them."""
        return Glimpses(self.time[which], self.pixel[which], self.depth[which])


@dataclass(frozen=True, eq=False)
class AnimalLag:
    """Lag of the lidar's clock: a frame of time t was taken at t + lag.

    Attributes
    ----------
    lag, sd : float
        s.
    shift : (2,)
        By which the returns lie beside the keypoints, px.
    n_returns : int
        On the animal.
    sigmas : float
        By which the lag is better than any other, in standard deviations.
    parts : (4,)
        Lags of the quarters of the video beyond that of the whole, s: other than 0 where they are clearly
        others, because frames are missing that nothing tells of.
    """

    lag: float
    sd: float
    shift: np.ndarray
    n_returns: int
    sigmas: float
    parts: np.ndarray


@dataclass(frozen=True, eq=False)
class _Fit:
    """A lag with the score of every block of frames; NaN where there are no returns."""

    lag: float
    sd: float
    shift: np.ndarray
    n: int
    score: np.ndarray


def animal_lag(outline: Outline, glimpses: Glimpses, lags: tuple[float, float]) -> AnimalLag:
    """Find the lag between `lags` (s) at which the returns lie on the animal.

    The standard deviation is the sandwich over blocks of time, with the errors of the keypoints in it.

    Raises
    ------
    InputError
        There are too few returns on the animal, or another lag fits as well.
    """
    period = float(np.median(np.diff(outline.time)))
    if not len(outline.edges) or not np.isfinite(outline.pixel).any():
        raise InputError(
            "The keypoints show too little of the animal.",
            key="--pivot",
            expected="markers that are sure and seen in a fifth of the frames",
            found=f"{len(outline.edges)} lines between such markers",
        )
    raster = _Raster(outline, glimpses)
    fits: list[_Fit] = []
    for lag in _search(raster, np.arange(lags[0], lags[1] + 0.5 * period, 0.5 * period)):
        fit = _refined(raster, lag)
        if fit is None or fit.n < _LEAST_RETURNS or not np.isfinite(fit.sd):
            continue
        if lags[0] - period <= fit.lag <= lags[1] + period:
            fits.append(fit)
    best, sd, sigmas = _chosen(fits, period)
    if sd > _MOST_SD * period:
        raise InputError(
            "The animal moves too little in the picture to tell the time.",
            key="--pivot",
            expected=f"a time known to a frame, {1e3 * period:.1f} ms",
            found=f"± {1e3 * sd:.1f} ms",
            remedy="import more frames, or frames in which it runs",
        )
    parts = _parts(outline, glimpses, best.lag)
    return AnimalLag(best.lag, sd, best.shift, best.n, float(sigmas), parts)


def _chosen(fits: list[_Fit], period: float) -> tuple[_Fit, float, float]:
    """The best of some lags, its standard deviation (s), and by how many of them it beats the next.

    Raises
    ------
    InputError
        There is none, or another one is nearly as good.
    """
    if not fits:
        raise InputError(
            "The lidar does not show the animal of the video.",
            key="--pivot",
            expected=f"{_LEAST_RETURNS} returns or more on the animal",
            found="fewer, at any time",
            remedy="check that video, keypoints and calibration belong to this recording, or give the event "
            "by hand: --pivot FRAME=SECONDS",
        )
    fits.sort(key=lambda one: -float(np.nanmean(one.score)))
    best = fits[0]
    near = [one for one in fits[1:] if abs(one.lag - best.lag) <= _SAME * period]
    others = [one for one in fits[1:] if abs(one.lag - best.lag) > _SAME * period]
    doubt = max((abs(one.lag - best.lag) for one in near if _better(best, one) < _LEAST_SIGMAS), default=0.0)
    sd = float(np.hypot(best.sd, 0.5 * doubt))  # a peak with two tops
    sigmas = min((_better(best, other) for other in others), default=np.inf)
    if sigmas < _LEAST_SIGMAS:
        rival = min(others, key=lambda other: _better(best, other))
        raise InputError(
            "The animal's motion fits the lidar at several times.",
            key="--pivot",
            expected=f"one that is better than all others by {_LEAST_SIGMAS:g} sigma",
            found=f"{best.lag:.3f} s and {rival.lag:.3f} s, {sigmas:.1f} sigma apart",
            remedy="say roughly when: --pivot strike:FRAME=SECONDS; or, where the camera dropped frames, how "
            "many it took: --exposed N",
        )
    return best, sd, sigmas


def _better(best: _Fit, other: _Fit) -> float:
    """By how many standard deviations the blocks of one fit score better than those of another."""
    apart = best.score - other.score
    apart = apart[np.isfinite(apart)]
    if len(apart) < 4:
        return 0.0
    return float(apart.mean() / max(apart.std(ddof=1) / np.sqrt(len(apart)), 1e-9))


def _search(raster: _Raster, lags: np.ndarray) -> list[float]:
    """The lags with the most returns on the animal, best first."""
    scores = np.array([raster.score(lag) for lag in lags])
    found: list[float] = []
    apart = 1.5 * float(np.median(np.diff(raster.outline.time)))
    for i in np.argsort(-scores, kind="stable"):
        if scores[i] <= 0 or len(found) == _TRIED:
            break
        if all(abs(lags[i] - other) > apart for other in found):
            found.append(float(lags[i]))
    return found


class _Raster:
    """Pictures of the animal's lines, a frame each: 2 on them, 1 beside them, 0 elsewhere."""

    def __init__(self, outline: Outline, glimpses: Glimpses) -> None:
        import cv2

        self.outline = outline
        thick = _THICK * outline.size
        self.corner = np.nanmin(outline.pixel, axis=(0, 1)) - _RING * thick
        far = np.nanmax(outline.pixel, axis=(0, 1)) + _RING * thick
        self.cell = max(float((far - self.corner).max()) / _CELLS, 0.5 * thick)
        shape = np.ceil((far - self.corner) / self.cell).astype(int) + 1
        self.maps = np.zeros((len(outline.time), shape[1], shape[0]), dtype=np.uint8)
        place = (outline.pixel - self.corner) / self.cell
        widths = [max(round(2 * k * thick / self.cell), 1) for k in (_RING, _WIDE)]
        for picture, points in zip(self.maps, place, strict=True):
            for label, width in zip((1, 2), widths, strict=True):
                for a, b in outline.edges:
                    if np.isfinite(points[[a, b]]).all():
                        ends = np.rint(points[[a, b]]).astype(int).tolist()
                        cv2.line(picture, ends[0], ends[1], label, width)
        cells = np.rint((glimpses.pixel - self.corner) / self.cell)
        inside = ((cells >= 0) & (cells < shape)).all(axis=1) & (glimpses.depth < _REACH)
        self.glimpses = glimpses.rows(inside)
        self.cells = cells[inside].astype(int)
        self.drawn: np.ndarray = np.asarray(self.maps.any(axis=(1, 2)))

    def labels(self, lag: float) -> tuple[slice, np.ndarray, np.ndarray]:
        """Returns (a slice) that are within the video at a lag, their frames and their labels."""
        time, frames = self.glimpses.time, self.outline.time
        near = slice(*np.searchsorted(time, [frames[0] + lag, frames[-1] + lag]))
        frame = np.searchsorted(0.5 * (frames[1:] + frames[:-1]), time[near] - lag)
        cells = self.cells[near]
        return near, frame, self.maps[frame, cells[:, 1], cells[:, 0]]

    def path(self, lag: float) -> tuple[float, slice, np.ndarray, np.ndarray]:
        """Returns on the animal beyond those beside it; which; their labels; whether at its depth."""
        near, frame, label = self.labels(lag)
        if not len(frame):
            return 0.0, near, label, np.zeros(0, dtype=bool)
        seconds = self.outline.time[frame] - self.outline.time[0]
        window = (seconds / _WINDOW).astype(int)
        depth = (self.glimpses.depth[near] / _BIN).astype(int)
        n = int(_REACH / _BIN) + 1
        cell, size = window * n + depth, n * (int(window.max()) + 1)
        beside, on = (np.bincount(cell[label == k], minlength=size) for k in (1, 2))
        excess = (on - on.sum() / max(int(beside.sum()), 1) * beside).reshape(-1, n)
        excess = excess + np.roll(excess, 1, axis=1) + np.roll(excess, -1, axis=1)
        bins, total = _smooth_path(excess, max(round(_FASTEST * _WINDOW / _BIN), 1))
        covered = self.drawn[np.unique(frame)].sum() / max(int(self.drawn.sum()), 1)
        at = np.abs(self.glimpses.depth[near] - (bins[window] + 0.5) * _BIN) < 2.0 * _BIN
        return (total / covered if covered >= _LEAST_COVER else 0.0), near, label, at

    def body(self, lag: float) -> Glimpses:
        """The returns near the animal's lines, at its depth, at a lag."""
        _, near, label, at_depth = self.path(lag)
        return self.glimpses.rows(np.flatnonzero(np.logical_and(at_depth, label > 0)) + near.start)

    def score(self, lag: float) -> float:
        """Returns on the animal, beyond those beside it."""
        return self.path(lag)[0]


def _smooth_path(gain: np.ndarray, step: int) -> tuple[np.ndarray, float]:
    """The path through the columns of rows (W, B) with the greatest sum that moves `step` columns at most."""
    from scipy.ndimage import maximum_filter1d

    best = np.empty_like(gain)
    best[0] = gain[0]
    for i in range(1, len(gain)):
        best[i] = gain[i] + maximum_filter1d(best[i - 1], 2 * step + 1)
    at = [int(best[-1].argmax())]
    for i in range(len(gain) - 2, -1, -1):
        low = max(at[-1] - step, 0)
        at.append(low + int(best[i, low : at[-1] + step + 1].argmax()))
    return np.array(at[::-1]), float(best[-1].max())


def _parts(outline: Outline, glimpses: Glimpses, lag: float) -> np.ndarray:
    """Lags (4,) of the quarters of the video beyond that of the whole, s; 0 where none fits better."""
    period = float(np.median(np.diff(outline.time)))
    edges = np.linspace(0, len(outline.time), 5).astype(int)
    out = np.zeros(4)
    for i, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        part = replace(outline, time=outline.time[a:b], pixel=outline.pixel[a:b], rate=outline.rate[a:b])
        if b - a < 12 or not np.isfinite(part.pixel).any():
            continue
        raster = _Raster(part, glimpses)
        same = _refined(raster, lag, free=0)
        for other in _search(raster, lag + period * np.arange(-_MOST_LOST, _MOST_LOST + 0.5, 0.5)):
            fit = _refined(raster, other)
            if fit is None or abs(fit.lag - lag) < _SAME * period:
                continue
            if same is None or _better(fit, same) > _LEAST_SIGMAS:
                out[i] = fit.lag - lag
                same = fit
    return out


def _refined(raster: _Raster, lag: float, free: int = 3) -> _Fit | None:
    """The lag near one by robust least squares (Welsch's weights), with a constant shift of the picture.

    Of lag and shift (2,), the first `free` are found.
    """
    outline, thick = raster.outline, _THICK * raster.outline.size
    period = float(np.median(np.diff(outline.time)))
    limit = np.array([0.5 * period, thick, thick])
    body, state = raster.body(lag), np.array([lag, 0.0, 0.0])
    for i in range(_ROUNDS if free else 0):
        fit = _linear(outline, body, state, thick)
        if fit is None:
            return None
        weight, apart, slope = fit
        normal = (weight[:, None] * slope).T @ slope + 1e-9 * np.eye(3)
        change = np.clip(-np.linalg.solve(normal, slope.T @ (weight * apart)), -limit, limit)
        state = state + change
        if i > 3 and abs(change[0]) < 1e-3 * period:
            break
    fit = _linear(outline, body, state, thick)
    return None if fit is None else _with_errors(raster, body, state, fit)


def _linear(
    outline: Outline, body: Glimpses, state: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Weights (K,), distances from the nearest link (K,) and their slopes by lag and shift (K, 3)."""
    place, rate = outline.at(body.time - state[0])
    apart, side, speed = nearest_link(place, rate, outline.edges, body.pixel - state[1:])
    known = np.isfinite(apart) & np.isfinite(speed)
    if known.sum() < _LEAST_RETURNS // 4:
        return None
    apart = np.where(known, apart, 0.0)
    slope = np.where(known[:, None], np.column_stack([speed, -side]), 0.0)
    return known * np.exp(-0.5 * (apart / scale) ** 2), apart, slope


def _with_errors(
    raster: _Raster, body: Glimpses, state: np.ndarray, fit: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> _Fit:
    """Standard deviation and score of a lag, by blocks of frames."""
    frames, since = raster.outline.time, body.time - state[0]
    variance = _sandwich(*fit, _THICK * raster.outline.size, _block(frames, since, _BLOCKS))
    score = np.bincount(_block(frames, since, 2 * _BLOCKS), fit[0], 2 * _BLOCKS)
    seen = raster.glimpses.time - state[0]
    seen = seen[(seen >= frames[0]) & (seen <= frames[-1])]
    present = np.bincount(_block(frames, seen, 2 * _BLOCKS), minlength=2 * _BLOCKS) > 0
    return _Fit(
        float(state[0]),
        float(np.hypot(np.sqrt(variance), _FLOOR)),
        state[1:],
        int((fit[0] > 0.3).sum()),
        np.where(present, score, np.nan),
    )


def _block(frames: np.ndarray, time: np.ndarray, n: int) -> np.ndarray:
    """Which of n blocks of the video times (K,) are in."""
    return np.asarray(np.searchsorted(np.linspace(frames[0], frames[-1], n + 1)[1:-1], time))


def _sandwich(
    weight: np.ndarray, apart: np.ndarray, slope: np.ndarray, scale: float, block: np.ndarray
) -> float:
    """Variance of the lag by the scatter of returns, single or in blocks: the larger one (Huber 1967), s².

    Infinite where the fit is no maximum.
    """
    curvature = ((weight * (1 - (apart / scale) ** 2))[:, None] * slope).T @ slope
    if np.linalg.eigvalsh(curvature)[0] <= 0:
        return np.inf
    inverse = np.linalg.inv(curvature)
    gradient = (weight * apart)[:, None] * slope
    parts = np.stack([np.bincount(block, one, _BLOCKS) for one in gradient.T], axis=1)
    together = parts.T @ parts * (_BLOCKS / (_BLOCKS - 4))
    return max(float((inverse @ one @ inverse)[0, 0]) for one in (together, gradient.T @ gradient))
