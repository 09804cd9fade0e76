"""The Kalman forecast of the thesis "3D Trajectory Reconstruction for Animal Data", for many tracks at once.

Each coordinate has its own filter with position and velocity, one frame a step, metres:

    F = [1 1; 0 1],   H = [1 0],   Q = 100·I,   R = 25,   P₀ = 25·I

A filter runs over the last few frames, corrects where a frame has an estimate, and its forecast is one step
after its last correction. The gains depend only on which frames have an estimate (Bar-Shalom, Li and
Kirubarajan 2001, section 5.2.3), so a forecast is a fixed weighted sum of the estimates. filterpy makes the
gains of each pattern once; everything else is array operations. Shapes: K forecasts, S steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from filterpy.kalman import KalmanFilter

TRANSITION = np.array([[1.0, 1.0], [0.0, 1.0]])
MEASURED = np.array([[1.0, 0.0]])
PROCESS_NOISE = 100.0 * np.eye(2)
MEASUREMENT_NOISE = 25.0 * np.eye(1)
START_COVARIANCE = 25.0 * np.eye(2)
NO_FORECAST = -1.0
"""What the thesis's code puts in every coordinate when there is no forecast, and compares all the same."""


@dataclass(frozen=True)
class Forecasts:
    """Forecasts of K tracks.

    Attributes
    ----------
    points : (K, 3)
        m, world frame; −1 in every coordinate where there is none.
    count : (K,) int
        Frames of the window with an estimate.
    known : (K,) bool
        Whether there is a forecast.
    """

    points: np.ndarray
    count: np.ndarray
    known: np.ndarray


def forecast(values: np.ndarray, first: np.ndarray, min_estimates: int, fixed: bool) -> Forecasts:
    """Forecasts from the estimates in a window.

    Parameters
    ----------
    values : (K, S, 3)
        Estimates in the order in which the filter meets them, m; NaN where a frame has none.
    first : (K, 3)
        The first estimate of the track in the whole recording. The thesis's code starts the filter with this
        as the velocity and zero as the position; so does this.
    min_estimates : int
        A forecast needs this many estimates.
    fixed : bool
        The thesis's code asks for two more when the last frame of the window has an estimate. Here not.
    """
    seen = np.isfinite(values[..., 0])
    count = seen.sum(1)
    enough = count >= min_estimates
    known = enough if fixed else enough & (~seen[:, -1] | (count > min_estimates + 1))
    points = np.full((len(values), 3), NO_FORECAST)
    use = np.flatnonzero(known)
    if len(use):
        patterns, which = np.unique(_codes(seen[use]), return_inverse=True)
        weights = np.stack([forecast_weights(int(code), values.shape[1]) for code in patterns])[which.ravel()]
        points[use] = np.einsum("ks,ksx->kx", weights[:, :-1], np.nan_to_num(values[use]))
        points[use] += weights[:, -1:] * first[use]
    return Forecasts(points, count, known)


def _codes(seen: np.ndarray) -> np.ndarray:
    """One integer for each pattern of seen frames; the first frame is the lowest bit."""
    return seen @ (1 << np.arange(seen.shape[1], dtype=np.int64))


def forecast_weights(code: int, steps: int) -> np.ndarray:
    """Weights (S + 1,) of the estimates and of the starting velocity in the forecast of a pattern.

    Bit s of the pattern says whether step s has an estimate.
    """
    return _filtered(code, steps, steps).weights


@dataclass(frozen=True, eq=False)
class _Filtered:
    """A filter after some steps: covariance, and state (2, S + 1) and forecast (S + 1,) as linear maps."""

    covariance: np.ndarray
    state: np.ndarray
    weights: np.ndarray


@lru_cache(maxsize=100_000)
def _filtered(code: int, step: int, steps: int) -> _Filtered:
    """The filter after the first `step` of `steps` steps of a pattern."""
    if step == 0:
        state = np.zeros((2, steps + 1))
        state[1, -1] = 1.0
        return _Filtered(START_COVARIANCE, state, np.zeros(steps + 1))
    last = step - 1
    before = _filtered(code & ((1 << last) - 1), last, steps)
    kalman = _filter()
    kalman.P = before.covariance
    kalman.predict()
    state, weights = TRANSITION @ before.state, before.weights
    if code >> last & 1:
        kalman.update(0.0)
        state = state - kalman.K @ (MEASURED @ state)
        state[:, last] += kalman.K[:, 0]
        weights = (TRANSITION @ state)[0]
    return _Filtered(kalman.P.copy(), state, weights)


def _filter() -> KalmanFilter:
    """The thesis's filter of one coordinate, before its first step, at rest at zero."""
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=2, dim_z=1)
    kalman.F, kalman.H, kalman.Q = TRANSITION, MEASURED, PROCESS_NOISE
    kalman.R, kalman.P = MEASUREMENT_NOISE, START_COVARIANCE.copy()
    return kalman


class RecentEstimates:
    """The estimates of the last frames of every track, as a run goes on."""

    def __init__(self, n_tracks: int, window: int) -> None:
        self._length = window + 1
        self._points = np.zeros((n_tracks, self._length, 3))
        self._frame = np.full((n_tracks, self._length), np.iinfo(np.int64).min)
        self.first = np.full((n_tracks, 3), np.nan)

    def add(self, tracks: np.ndarray, frame: int, points: np.ndarray) -> None:
        """Keep the estimates (K, 3) of tracks (K,) in a frame."""
        self._points[tracks, frame % self._length] = points
        self._frame[tracks, frame % self._length] = frame
        new = np.isnan(self.first[tracks, 0])
        self.first[tracks[new]] = points[new]

    def before(self, tracks: np.ndarray, frame: int, offsets: np.ndarray) -> np.ndarray:
        """Estimates (K, S, 3) of tracks (K,) in the frames ``frame + offsets``; NaN where there is none."""
        frames = frame + offsets
        slots = frames % self._length
        values = self._points[tracks[:, None], slots]
        return np.where((self._frame[tracks[:, None], slots] == frames)[..., None], values, np.nan)


class AllEstimates:
    """The estimates of a whole run, looked up by track and frame."""

    def __init__(self, tracks: np.ndarray, frames: np.ndarray, points: np.ndarray, n_tracks: int) -> None:
        self._low = int(frames.min(initial=0))
        self._span = int(frames.max(initial=0)) - self._low + 1
        keys = tracks.astype(np.int64) * self._span + (frames - self._low)
        self._keys, rows = np.unique(keys, return_index=True)
        self._points = points[rows]
        self.first = np.full((n_tracks, 3), np.nan)
        track, row = np.unique(self._keys // self._span, return_index=True)
        self.first[track] = self._points[row]

    def around(self, tracks: np.ndarray, frames: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """Estimates (K, S, 3) of tracks (K,) in the frames ``frames + offsets``; NaN where there is none."""
        values = np.full((len(tracks), len(offsets), 3), np.nan)
        place = frames[:, None] - self._low + offsets
        keys = tracks[:, None].astype(np.int64) * self._span + place
        if len(self._keys):
            row = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
            found = (self._keys[row] == keys) & (place >= 0) & (place < self._span)
            values[found] = self._points[row[found]]
        return values
