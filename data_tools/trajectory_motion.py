"""How animals move between frames, as a prior of their paths: velocities that remember.

The displacement v_t = x_t − x_(t−1) of every axis is a stationary autoregression of second order,

    v_t = a_1 v_(t−1) + a_2 v_(t−2) + w_t,   w_t ~ N(0, q²),

given by its partial autocorrelations r_1, r_2, so that every pair inside (−1, 1)² is stationary
(Barndorff-Nielsen and Schou 1973):

    a_1 = r_1 (1 − r_2),   a_2 = r_2.

Its corners are the differences that smoothers penalise: r = (0, 0) is a random walk (first difference),
(1, 0) constant velocity (second), (1, −1) constant acceleration (third). The first displacements of a piece
follow their own stationary law (the recursion of Levinson 1947 and Durbin 1960), so the prior needs no
constant; the place of the first frame is free. Shapes: T nodes (frames of all pieces, piece after piece).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

N_LAGS = 3
_FREE = 1e-9  # information about the place of a path's first frame, m⁻²


@dataclass(frozen=True)
class MotionModel:
    """An isotropic prior of displacements.

    Attributes
    ----------
    step : float
        q, standard deviation of what is new in the displacement of a frame, each axis, m.
    memory : (float, float)
        r_1 and r_2, the partial autocorrelations of the displacements.
    tails : float
        ν: the innovations follow Student's law with ν degrees of freedom and scale q; infinite: the normal
        law. Animals that sit and now and then fly have a small ν.
    """

    step: float
    memory: tuple[float, float] = (0.0, 0.0)
    tails: float = np.inf

    @property
    def coefficients(self) -> np.ndarray:
        """Weights on x_t, x_(t−1), … in the innovation of frame k = 0 … 3 of a piece, (4, 4)."""
        r1, r2 = self.memory
        out = np.zeros((N_LAGS + 1, N_LAGS + 1))
        for k, a in enumerate(([], [], [r1], [r1 * (1.0 - r2), r2])):
            velocity = np.array([1.0, *(-value for value in a)])
            if k:
                out[k, : len(velocity)] += velocity
                out[k, 1 : len(velocity) + 1] -= velocity
        return out

    @property
    def variances(self) -> np.ndarray:
        """Variance of the innovation of frames 0 … 3 of a piece, (4,), m²; from frame 3 on it is q²."""
        r1, r2 = self.memory
        second = self.step**2 / (1.0 - r2**2)
        return np.array([1.0 / _FREE, second / (1.0 - r1**2), second, self.step**2])


@dataclass(frozen=True, eq=False)
class Pieces:
    """Paths without a gap, one after the other.

    Attributes
    ----------
    length : (S,) int
        Frames of each piece.
    agility : (S,), optional
        How many times the prior's step the animal of each piece takes; by default all move alike.
    """

    length: np.ndarray
    agility: np.ndarray | None = None

    def take(self, chosen: np.ndarray) -> Pieces:
        """Some of the pieces, as a mask or an index (S,)."""
        return Pieces(self.length[chosen], None if self.agility is None else self.agility[chosen])

    @cached_property
    def start(self) -> np.ndarray:
        """First node of each piece, (S,)."""
        return np.cumsum(self.length) - self.length

    @cached_property
    def n_nodes(self) -> int:
        """T."""
        return int(self.length.sum())

    @cached_property
    def owner(self) -> np.ndarray:
        """Piece of each node, (T,)."""
        return np.repeat(np.arange(len(self.length)), self.length)

    @cached_property
    def age(self) -> np.ndarray:
        """Place of each node in its piece from 0, at most 3, (T,)."""
        return np.minimum(np.arange(self.n_nodes) - self.start[self.owner], N_LAGS)


def innovation_variances(motion: MotionModel, pieces: Pieces) -> np.ndarray:
    """Variance of each node's innovation (T,), m²; that of a piece's first frame is free."""
    variance = motion.variances[pieces.age]
    if pieces.agility is None:
        return variance
    return np.where(pieces.age > 0, pieces.agility[pieces.owner] ** 2, 1.0) * variance


def prior_band(motion: MotionModel, pieces: Pieces, weight: np.ndarray | None = None) -> np.ndarray:
    """The prior's information between frames t + l and t of one axis, (4, T): lag l in row l, column t.

    Parameters
    ----------
    motion : MotionModel
        The prior.
    pieces : Pieces
        Which frames hang together.
    weight : (T,), optional
        Factor on the information of each innovation.
    """
    age, n = pieces.age, pieces.n_nodes
    information = 1.0 / innovation_variances(motion, pieces)
    if weight is not None:
        information = information * weight
    c = motion.coefficients[age]  # (T, 4)
    band = np.zeros((N_LAGS + 1, n))
    for later in range(N_LAGS + 1):
        for lag in range(N_LAGS + 1 - later):  # x_(t−later) with x_(t−later−lag)
            value = information * c[:, later] * c[:, later + lag]
            shift = later + lag
            band[lag, : max(n - shift, 0)] += value[shift:]
    band[0] += information * (age == 0)
    return band


def innovations(motion: MotionModel, pieces: Pieces, x: np.ndarray) -> np.ndarray:
    """w (T, 3) of paths (T, 3); zero for the first frame of a piece."""
    c = motion.coefficients[pieces.age]
    out = c[:, :1] * x
    for lag in range(1, N_LAGS + 1):
        out[lag:] += c[lag:, lag, None] * x[:-lag]
    return out


def tail_weights(motion: MotionModel, pieces: Pieces, squared: np.ndarray) -> np.ndarray:
    """Expected factor on the information of each innovation, given its expected square (T,), m².

    Student's law is a normal law of random precision; this is the expectation of the precision
    (Lange, Little and Taylor 1989): (ν + 3) / (ν + w²/q²). One where a piece begins unless it is small.
    """
    if not np.isfinite(motion.tails):
        return np.ones(len(squared))
    weight = (motion.tails + 3.0) / (motion.tails + squared / innovation_variances(motion, pieces))
    return np.where(pieces.age == N_LAGS, weight, np.where(pieces.age == 0, 1.0, np.minimum(weight, 1.0)))


def log_information(motion: MotionModel, pieces: Pieces) -> float:
    """log det of the prior's information about one axis."""
    return -float(np.log(innovation_variances(motion, pieces)).sum())
