"""The dots of one view as a pair of views sees them, and how noisy they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.epipolar_angles import PlaneAngles


@dataclass(frozen=True)
class Noise:
    """Standard deviations of d, px: from frame to frame, and of its slow part."""

    white: float
    slow: float = 0.0

    @property
    def total(self) -> float:
        """Both together."""
        return float(np.hypot(self.white, self.slow))


@dataclass(frozen=True, eq=False)
class Dots:
    """The dots of one view of a pair, sorted by frame.

    Attributes
    ----------
    frame : (P,) int
        From 0.
    piece : (P,) int
        Piece of track, from 0 to n_pieces − 1; −1 for a dot that takes no part.
    n_pieces : int
    angles : PlaneAngles
    """

    frame: np.ndarray
    piece: np.ndarray
    n_pieces: int
    angles: PlaneAngles


def usable_rows(dots: Dots) -> np.ndarray:
    """Rows of dots that belong to a piece and have a plane angle."""
    return np.flatnonzero(np.isfinite(dots.angles.angle) & (dots.piece >= 0))


def runs(low: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The numbers low, low + 1 … (count of them) of every entry, one after the other."""
    return np.arange(count.sum()) + np.repeat(low - np.cumsum(count) + count, count)
