"""How far away a path is that one view alone sees.

Pixels fix the direction of each frame to within an angle. At a distance s what this leaves open is as wide as
s, and a path twice as far has four times the room. The most probable point of the joint density does not know
of that: it shrinks such a path into the camera, where the least motion explains all pixels. So what pixels
leave open across the rays is integrated out. With the information λ = f²/(σ² s²) of a row across its ray and
the spectrum P(ω) of the prior's information, each of the two directions adds

    ½ W(λ),   W(λ) = mean over ω of log (λ + P(ω)),   −dW/d log s = 2 H(λ),   H(λ) = mean of λ / (λ + P(ω)),

to what is minimised (the determinant of Laplace's approximation, in the limit of long paths: Whittle 1953).
H is how much of a frame's own row is left in the smoothed path. Shapes: T nodes, P rows, K lone rows.
"""

from __future__ import annotations

import numpy as np

from acino_fte.data_tools.trajectory_motion import N_LAGS, MotionModel, Pieces
from acino_fte.data_tools.trajectory_rows import Measurements

_FREQUENCIES, _GRID = 512, 160
_RANGE = (-14.0, 14.0)  # of log λ q²


class LoneRows:
    """The rows that count and are alone in their node.

    Parameters
    ----------
    measurements : Measurements
        All rows.
    used : (P,) bool
        Rows that count.
    pieces : Pieces
        Which nodes hang together.
    motion : MotionModel
        The prior.
    """

    def __init__(
        self, measurements: Measurements, used: np.ndarray, pieces: Pieces, motion: MotionModel
    ) -> None:
        count = np.bincount(measurements.node[used], minlength=pieces.n_nodes)
        self._rows = np.flatnonzero(used & (count[measurements.node] == 1))
        self.node = measurements.node[self._rows]
        self._centre = measurements.centres()[self._rows]
        self._variance = measurements.variance[self._rows]
        self._log_q2 = np.full(len(self.node), 2.0 * np.log(motion.step))
        if pieces.agility is not None:
            self._log_q2 += 2.0 * np.log(pieces.agility[pieces.owner[self.node]])
        self._grid, self._open, self._kept = open_volume(motion)

    def cost(self, slope: np.ndarray) -> np.ndarray:
        """What the room across the rays costs, (K,), in units of χ²: 2 W(λ) for slopes (P, 2, 3)."""
        return 2.0 * np.interp(self._level(slope), self._grid, self._open)

    def push(self, x: np.ndarray, slope: np.ndarray, information: np.ndarray, gradient: np.ndarray) -> None:
        """Add the pull away from the cameras at x (T, 3) to information (T, 3, 3) and gradient (T, 3)."""
        offset = x[self.node] - self._centre
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
        away = offset / distance[:, None]
        kept = 2.0 * np.interp(self._level(slope), self._grid, self._kept)
        gradient[self.node] += (kept / distance)[:, None] * away
        information[self.node] += (kept / distance**2)[:, None, None] * away[:, :, None] * away[:, None]

    def _level(self, slope: np.ndarray) -> np.ndarray:
        """log λ q² of the rows, (K,)."""
        square = (slope[self._rows] ** 2).sum((1, 2))
        with np.errstate(invalid="ignore", divide="ignore"):
            level = np.log(0.5 * square / self._variance) + self._log_q2
        return np.nan_to_num(level, nan=_RANGE[1], posinf=_RANGE[1], neginf=_RANGE[0])


def open_volume(motion: MotionModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A grid of log λ q² with W(λ) less log q⁻², and H(λ), on it."""
    grid = np.linspace(*_RANGE, _GRID)
    turns = np.exp(-1j * np.linspace(0.0, np.pi, _FREQUENCIES))
    weights = motion.coefficients[N_LAGS]
    spectrum = np.abs(sum(weight * turns**lag for lag, weight in enumerate(weights))) ** 2
    total = np.exp(grid)[:, None] + spectrum
    return grid, np.log(total).mean(1), (np.exp(grid)[:, None] / total).mean(1)
