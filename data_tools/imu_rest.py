"""What a sensor at rest tells: the bias of its gyroscope, and which way is up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.imu import checked_samples, seconds
from acino_fte.data_tools.recording import GRAVITY, ImuSamples
from acino_fte.data_tools.rotations import cross_matrix
from acino_fte.errors import InputError

_WINDOW = 0.5  # s, over which the sensor has to be still
_ABOVE_FLOOR = 2.0  # times the quietest windows that still counts as rest
_QUIET = 0.02  # rad/s, 0.3 m/s²: above it not even the quietest window is rest
_QUIET_FORCE = 0.3
_TRIM = 0.25  # s, off each end of a rest beside motion, which begins softly
_ODD = 4.0  # standard deviations of a mean rate, beyond which it is one of motion
_BLOCK = 0.25  # s, whose means tell how slowly the noise wanders


@dataclass(frozen=True, eq=False)
class Rest:
    """A span in which the sensor did not move.

    Attributes
    ----------
    start, stop : int
        Of the samples, half-open.
    duration : float
        s.
    bias : (3,)
        Mean rate, rad/s: the bias of the gyroscope (and, where it matters, the turn of the Earth).
    bias_covariance : (3, 3)
        Of that mean, (rad/s)².
    rate_density : float
        White noise of the rates, rad/s/√Hz.
    force : (3,)
        Mean specific force, m/s², sensor's frame: it points up.
    force_sd : float
        Of each component of that mean, m/s², without the accelerometer's own bias.
    """

    start: int
    stop: int
    duration: float
    bias: np.ndarray
    bias_covariance: np.ndarray
    rate_density: float
    force: np.ndarray
    force_sd: float


def bias_from_rest(samples: ImuSamples, *, at_least: float = 2.0, max_bias: float = 0.1) -> Rest:
    """The longest span of rest, found by itself, and the bias of the gyroscope in it.

    Rest is where, over half a second, rates and forces vary no more than in the quietest windows (as the
    detectors compared by Skog, Händel, Nilsson and Rantakokko 2010), and rates are small enough for a bias. A
    turn at a constant, slow rate about the vertical looks the same to any detector: say where the rest is, by
    giving only those samples, when the recording has one.

    Parameters
    ----------
    samples : ImuSamples
        Of one sensor.
    at_least : float
        Shortest rest that is believed, s.
    max_bias : float
        Largest bias, rad/s.

    Returns
    -------
    Rest
        The covariance of the bias is that of a mean of correlated noise: from the means of quarter seconds.

    Raises
    ------
    InputError
        The sensor never rests so long.
    """
    samples, _ = checked_samples(samples, least=8)
    time = seconds(samples)
    still = _still(samples, time, max_bias)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    spans = [_trimmed(time, samples.rate, int(a), int(b)) for a, b in edges.reshape(-1, 2)]
    start, stop = max(spans, key=lambda s: time[s[1] - 1] - time[s[0]], default=(0, 1))
    duration = float(time[stop - 1] - time[start])
    if duration < at_least:
        raise InputError(
            "The sensor never rests long enough to measure the bias of its gyroscope.",
            expected=f"{at_least:g} s of rest",
            found=f"{duration:.2f} s at the longest",
            remedy="give a shorter least rest, give the bias, or go without (it drifts)",
        )
    return rest_of(samples, start, stop)


def _trimmed(time: np.ndarray, rate: np.ndarray, start: int, stop: int) -> tuple[int, int]:
    """A span without the ends that lie beside motion; at the ends of the recording nothing is taken off.

    Motion begins softly, below the noise of a sample: a quarter second goes, and more for as long as the mean
    rate of a quarter is not that of the middle one.
    """
    block = ((time[start:stop] - time[start]) / _TRIM).astype(int)
    firsts = np.flatnonzero(np.diff(block, prepend=-1))
    means = np.add.reduceat(rate[start:stop], firsts) / np.diff(firsts, append=stop - start)[:, None]
    apart = np.abs(means - np.median(means, axis=0))
    even = np.flatnonzero((apart <= _ODD * 1.4826 * np.median(apart, axis=0)).all(1))
    edges = start + np.append(firsts, stop - start)
    if len(even) and start > 0:
        start = int(edges[max(even[0], 1)])
    if len(even) and stop < len(time):
        last = int(np.searchsorted(time, time[stop - 1] - _TRIM))
        stop = min(last, int(edges[even[-1] + 1]))
    return (start, stop) if stop > start + 1 else (start, start + 1)


def rest_of(samples: ImuSamples, start: int, stop: int) -> Rest:
    """Mean rate and force over the samples start ≤ k < stop, in which the sensor is known to rest."""
    time = seconds(samples)[start:stop]
    rate, force = samples.rate[start:stop], samples.force[start:stop]
    duration = float(time[-1] - time[0])
    step = duration / max(len(time) - 1, 1)
    return Rest(
        start,
        stop,
        duration,
        rate.mean(0),
        _mean_covariance(time, rate),
        float(np.sqrt(rate.var(axis=0, ddof=1).mean() * step)),
        force.mean(0),
        float(np.sqrt(np.trace(_mean_covariance(time, force)) / 3.0)),
    )


def _still(samples: ImuSamples, time: np.ndarray, max_bias: float) -> np.ndarray:
    """Whether each sample (K,) lies in a window of rest."""
    first = np.searchsorted(time, time - 1e-9)
    last = np.searchsorted(time, time + _WINDOW)
    whole = (time + _WINDOW <= time[-1]) & (last - first >= 4)
    if not whole.any():
        return np.zeros(len(time), dtype=bool)
    count = np.maximum(last - first, 1)

    def spread(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        centred = values - values.mean(0)
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(centred, axis=0)])
        square = np.concatenate([np.zeros((1, 3)), np.cumsum(centred**2, axis=0)])
        mean = (total[last] - total[first]) / count[:, None]
        variance = (square[last] - square[first]) / count[:, None] - mean**2
        return mean + values.mean(0), np.sqrt(np.maximum(variance, 0.0).sum(1))

    mean, rate_sd = spread(samples.rate)
    _, force_sd = spread(samples.force)
    quiet = whole & (np.abs(mean).max(1) < max_bias)
    for sd, limit in ((rate_sd, _QUIET), (force_sd, _QUIET_FORCE)):
        floor = float(np.quantile(sd[whole], 0.02))
        quiet &= sd <= min(max(_ABOVE_FLOOR * floor, 1e-9), limit)
    begin = np.zeros(len(time) + 1)
    np.add.at(begin, first[quiet], 1)
    np.add.at(begin, last[quiet], -1)
    return np.cumsum(begin)[:-1] > 0


def _mean_covariance(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Covariance (3, 3) of the mean of values (K, 3): by blocks, and no less than of white noise."""
    white = np.diag(values.var(axis=0, ddof=1)) / len(values)
    block = ((time - time[0]) / _BLOCK).astype(int)
    n = int(block[-1])  # whole blocks
    if n < 6:
        return white
    means = np.stack([values[block == i].mean(0) for i in range(n) if (block == i).any()])
    blocks = np.diag(means.var(axis=0, ddof=1)) / len(means)
    return np.maximum(white, blocks)


def levelled(
    force: np.ndarray, *, force_sd: float = 0.1, forward: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Attitude of a sensor at rest: the world's z is up, as the specific force points.

    Parameters
    ----------
    force : (3,)
        Mean specific force at rest, sensor's frame, any unit.
    force_sd : float
        Standard deviation of each component, m/s², the accelerometer's bias included: what the tilt is unsure
        by.
    forward : (3,), optional
        Direction in the sensor's frame whose heading shall be the world's x; by default the sensor's x axis,
        or its y axis where x is nearly vertical.

    Returns
    -------
    rotation : (3, 3)
        Sensor to world.
    covariance : (3, 3)
        Of a small turn in the world, rad²: tilt only, since the heading is a convention.
    """
    size = float(np.linalg.norm(force))
    if not size > 0:
        raise InputError("There is no specific force to level the world by.", found=f"{force}")
    up = np.asarray(force, dtype=float) / size
    choices = [np.asarray(forward, dtype=float)] if forward is not None else []
    for axis in (*choices, *np.eye(3)):
        flat = axis - up * (axis @ up)
        if np.linalg.norm(flat) > 0.2 * np.linalg.norm(axis):
            break
    x = flat / np.linalg.norm(flat)
    rotation = np.stack([x, np.cross(up, x), up])
    tilt = (force_sd / GRAVITY) ** 2
    level = cross_matrix(np.array([0.0, 0.0, 1.0]))
    return rotation, tilt * (level @ level.T)
