"""What two sensors share: a light that goes on, a knock on the rig, the rig's own turning."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from acino_fte.errors import InputError

_SIDE = 480  # px, of images in which motion is measured
_CORNERS, _FEWEST_CORNERS = 150, 8
_BLOCKS = 12
_BLUR = 2.0  # steps of the slower sensor, of both signals alike
_LEAST_SIGMAS = 5.0
_LEAST_CONTRAST = 1.3
_FEWER_SIGMAS, _MORE_CONTRAST = 3.0, 3.0  # of short records
_LEAST_OVERLAP = 1.0  # s
_AROUND = 6  # frames on either side of a step


@dataclass(frozen=True)
class Event:
    """An event at a time (s, or frames) with its standard deviation; `contrast` is its size in noise."""

    time: float
    sd: float
    contrast: float


def led_step(brightness: np.ndarray) -> Event:
    """Frame at which a light in the picture goes on (or off).

    It changes between two frames, so the event is half a frame before the first that shows it, with the
    standard deviation of an even distribution, 1/√12 frame.

    Parameters
    ----------
    brightness : (N,)
        Mean of the region of the light, one a frame; see :func:`region_brightness`.

    Raises
    ------
    InputError
        There is no step that stands out.
    """
    value = np.asarray(brightness, dtype=float)
    w = min(_AROUND, len(value) // 3)
    if w < 1:
        raise InputError(
            "There are too few frames to find a light that goes on.", found=f"{len(value)} frames"
        )
    sums = np.concatenate([[0.0], np.cumsum(value)])
    at = np.arange(w, len(value) - w + 1)
    step = np.abs((sums[at + w] - sums[at]) - (sums[at] - sums[at - w])) / w
    size = np.abs(np.diff(value))
    k = int(at[step.argmax()])
    around = np.arange(max(k - 1, 1), min(k + 2, len(value)))
    k = int(around[size[around - 1].argmax()])
    others = np.delete(size, slice(max(k - 3, 0), k + 2))
    noise = max(1.4826 * float(np.median(others)) if len(others) else 0.0, 0.25)
    contrast = float(step.max()) / noise
    if contrast < 5:
        raise InputError(
            "No light goes on or off in this region of the images.",
            key="led",
            expected="a step of the brightness of at least five times its noise",
            found=f"{contrast:.1f} times, at frame {k}",
            remedy="check the region, or give the frame by hand: --pivot FRAME=SECONDS",
        )
    return Event(k - 0.5, 1 / np.sqrt(12), contrast)


def region_brightness(pictures: Iterable[np.ndarray], region: tuple[int, int, int, int]) -> np.ndarray:
    """Mean brightness (N,) of a region x, y, width, height (px) of images (H, W) or (H, W, 3).

    Raises
    ------
    InputError
        The region lies outside the images.
    """
    x, y, width, height = region
    out = []
    for pixels in pictures:
        part = pixels[max(y, 0) : y + height, max(x, 0) : x + width]
        if part.size == 0:
            raise InputError(
                "The region of the light lies outside the images.",
                key="led",
                expected=f"x, y, width, height within {pixels.shape[1]}×{pixels.shape[0]} px",
                found=",".join(map(str, region)),
            )
        out.append(float(part.mean()))
    return np.array(out)


def knock(time: np.ndarray, force: np.ndarray) -> Event:
    """Time of a knock on the rig: the sharpest change of the specific force.

    Parameters
    ----------
    time : (K,)
        s.
    force : (K, 3) or (K,)
        Specific force, or any signal that a knock shakes, such as the motion of the image.

    Raises
    ------
    InputError
        No change stands out from all others.
    """
    values = np.asarray(force, dtype=float).reshape(len(time), -1)
    if len(values) < 8:
        raise InputError("There are too few samples to find a knock.", found=f"{len(values)}")
    change = np.linalg.norm(np.diff(values, axis=0), axis=1)
    step = float(np.median(np.diff(time)))
    k = int(change.argmax())
    noise = max(1.4826 * float(np.median(change)), 1e-12)
    burst = (time[:-1] > time[k] - 0.1) & (change > 0.3 * change[k])
    begun = int(np.argmax(burst))  # the first change of the same burst that stands out
    far = np.abs(time[:-1] - time[k]) > max(0.5, 3 * step)
    rival = float(change[far].max()) if far.any() else 0.0
    if change[k] < 10 * noise or change[k] < 1.5 * rival:
        raise InputError(
            "No knock stands out.",
            expected="one change ten times the noise, and half as large again as any other",
            found=f"{change[k] / noise:.1f} times the noise, {change[k] / max(rival, 1e-12):.2f} another",
            remedy="give the frame and the time by hand: --pivot FRAME=SECONDS",
        )
    half = (time[begun + 1] - time[begun]) / 2
    return Event(float(time[begun] + half), float(2 * half / np.sqrt(12)), float(change[k] / noise))


def image_motion(pictures: Iterable[np.ndarray]) -> np.ndarray:
    """Shift (N - 1, 2) of the scene from each frame to the next, px of the full image.

    The median over corners that are followed (Lucas and Kanade 1981 on pyramids, OpenCV's), so that an animal
    before it does not matter; frames without enough corners are bridged.
    """
    import cv2

    last: Any = None
    out: list[np.ndarray] = []
    for pixels in pictures:
        grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        scale = max(max(grey.shape) / _SIDE, 1.0)
        size = (max(round(grey.shape[1] / scale), 16), max(round(grey.shape[0] / scale), 16))
        small: Any = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        small = small if small.dtype == np.uint8 else cv2.convertScaleAbs(small, alpha=1 / 256)
        if last is not None:
            out.append(_shift(last, small) * scale)
        last = small
    return _bridged(np.array(out).reshape(-1, 2))


def _shift(before: Any, after: Any) -> np.ndarray:
    """Median shift (2,) of corners, px; NaN without enough of them."""
    import cv2

    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 6)
    if corners is None or len(corners) < _FEWEST_CORNERS:
        return np.full(2, np.nan)
    found, status, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy(), maxLevel=4)
    good = status.ravel() == 1
    if good.sum() < _FEWEST_CORNERS:
        return np.full(2, np.nan)
    return np.asarray(np.median((found - corners).reshape(-1, 2)[good], axis=0))


def _bridged(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values).all(axis=1)
    if known.all():
        return values
    if not known.any():
        return np.zeros_like(values)
    at = np.arange(len(values))
    return np.column_stack([np.interp(at, at[known], column[known]) for column in values.T])


def lag_of(
    time_a: np.ndarray, a: np.ndarray, time_b: np.ndarray, b: np.ndarray, step: float | None = None
) -> Event:
    """By how much the clock of b is ahead of that of a, from one motion that both show: b(t + lag) ~ a(t).

    The peak of the normalised cross-correlation (Knapp and Carter 1976) over all lags with one second of
    overlap or more, refined by its derivative. The standard deviation is the sandwich over blocks of time, so
    that errors may be correlated.

    Parameters
    ----------
    time_a : (K,)
        s.
    a : (K,) or (K, D)
        Motion: an amount, or components.
    time_b, b : (L,), (L,) or (L, D)
        The same of the other.
    step : float, optional
        Of the common samples, s; by default half the shorter step of the two.

    Raises
    ------
    InputError
        There is no lag at which they agree, or several.
    """
    step = step or min(float(np.median(np.diff(time_a))), float(np.median(np.diff(time_b)))) / 2
    blur = _BLUR * max(float(np.median(np.diff(time_a))), float(np.median(np.diff(time_b)))) / step
    grid_a, x = _resampled(time_a, a, step, blur)
    grid_b, y = _resampled(time_b, b, step, blur)
    score, count, lags = _correlation(x, y, max(round(_LEAST_OVERLAP / step), 8))
    if len(score) == 0:
        raise InputError(
            "The video and the inertial sensor have too little time in common to compare their motion.",
            expected=f"{_LEAST_OVERLAP:g} s or more of each",
            found=f"{len(x) * step:.1f} s and {len(y) * step:.1f} s",
            remedy="give one event by hand: --pivot FRAME=SECONDS",
        )
    width = max(_width(x), _width(y))
    sigmas = np.arctanh(np.clip(score, -0.9999, 0.9999)) * np.sqrt(count / (2 * width))  # Fisher 1921
    best = int(sigmas.argmax())
    far = np.abs(np.arange(len(score)) - best) > 3 * width
    rival = float(max(sigmas[far].max(), 0.0)) if far.any() else 0.0
    peak = float(sigmas[best])
    clear = peak >= _LEAST_SIGMAS and peak >= _LEAST_CONTRAST * rival
    alone = peak >= _FEWER_SIGMAS and peak >= _MORE_CONTRAST * rival
    if not (clear or alone):
        raise InputError(
            "The motion in the images and that of the inertial sensor do not tell when they were.",
            expected=f"a match of {_LEAST_SIGMAS:g} sigma, {_LEAST_CONTRAST:g} times any other, or of "
            f"{_FEWER_SIGMAS:g} sigma, {_MORE_CONTRAST:g} times any other",
            found=f"{peak:.1f} sigma (a correlation of {score[best]:.2f}), and {rival:.1f} at another time",
            remedy="give one event by hand: --pivot FRAME=SECONDS",
        )
    rough = grid_b[0] - grid_a[0] + lags[best] * step
    lag, sd = _refined(grid_a, x, grid_b, y, rough, step)
    return Event(lag, sd, peak / max(rival, 1.0))


def _resampled(
    time: np.ndarray, values: np.ndarray, step: float, blur: float
) -> tuple[np.ndarray, np.ndarray]:
    """Even times (I,) and blurred values (I, D), of mean 0 and of variance 1 all together."""
    from scipy.ndimage import gaussian_filter1d

    grid = np.arange(time[0], time[-1], step)
    columns = np.asarray(values, dtype=float).reshape(len(time), -1).T
    out = np.column_stack([gaussian_filter1d(np.interp(grid, time, one), blur) for one in columns])
    out -= out.mean(axis=0)
    return grid, out / max(float(np.sqrt(np.mean(out**2))), 1e-12)


def _correlation(x: np.ndarray, y: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correlation of y[i + l] with x[i] at lags l with enough samples in common; their number; the lags."""
    from scipy.signal import correlate, correlation_lags

    lags = correlation_lags(len(y), len(x))
    ones_x, ones_y = np.ones(len(x)), np.ones(len(y))
    n = np.maximum(np.rint(correlate(ones_y, ones_x)), 1)
    product, var_x, var_y = (np.zeros(len(lags)) for _ in range(3))
    for one, other in zip(x.T, y.T, strict=True):
        sum_x, sum_y = correlate(ones_y, one), correlate(other, ones_x)
        product += correlate(other, one) - sum_x * sum_y / n
        var_x += correlate(ones_y, one**2) - sum_x**2 / n
        var_y += correlate(other**2, ones_x) - sum_y**2 / n
    score = product / np.sqrt(np.maximum(var_x * var_y, 1e-9 * n**2))
    keep = n >= max(least, 0.25 * min(len(x), len(y)))
    return score[keep], n[keep], lags[keep]


def _width(x: np.ndarray) -> int:
    """Samples after which a signal (I, D) is like itself by half, at most."""
    from scipy.signal import correlate

    self_likeness = sum(correlate(one, one)[len(x) - 1 :] for one in x.T)
    below = np.flatnonzero(self_likeness < 0.5 * self_likeness[0])
    return int(below[0]) if len(below) else len(x)


def _refined(
    grid_a: np.ndarray, x: np.ndarray, grid_b: np.ndarray, y: np.ndarray, lag: float, step: float
) -> tuple[float, float]:
    """The lag at which Σ x'(t) (y(t + lag) - g x(t)) is zero, and its standard deviation.

    Both signals are noisy: the slope of that sum is Σ x' y', to which noise adds nothing on average.
    """
    sd = np.inf
    for _ in range(12):
        t = grid_a[(grid_a + lag >= grid_b[0] + step) & (grid_a + lag <= grid_b[-1] - step)]
        mine = np.column_stack([np.interp(t, grid_a, one) for one in x.T])
        other = np.column_stack([np.interp(t + lag, grid_b, one) for one in y.T])
        mine, other = mine - mine.mean(axis=0), other - other.mean(axis=0)
        slope, other_slope = np.gradient(mine, step, axis=0), np.gradient(other, step, axis=0)
        gain = float((mine * other).sum()) / max(float((mine**2).sum()), 1e-12)
        score = (slope * (other - gain * mine)).sum(axis=1)
        turn = max(float((slope * other_slope).sum()), 1e-12)
        blocks = np.array([part.sum() for part in np.array_split(score, _BLOCKS)])
        sd = float(np.sqrt(blocks @ blocks * _BLOCKS / (_BLOCKS - 4))) / turn
        change = float(np.clip(-score.sum() / turn, -3 * step, 3 * step))
        lag += change
        if abs(change) < 1e-3 * step:
            break
    return lag, sd
