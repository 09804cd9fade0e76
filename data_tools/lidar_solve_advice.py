"""What is to be said of a calibration: above all, whether focal length and depth are apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.lidar_solve_fit import Fit, inverse
from acino_fte.data_tools.lidar_solve_model import PickNoise

UNSURE = 0.02
"""Relative standard deviation of a focal length, from the pairs alone, that is too much."""
_RATIO = 5.0


@dataclass(frozen=True)
class FocalDepth:
    """How focal length and depth hang together.

    Attributes
    ----------
    alone : float
        Relative standard deviation of the focal length from the pairs alone.
    with_depth : float
        The same if it were known how far the camera is along its axis.
    known : float
        The same with all that was known before the pairs.
    determined : bool
    """

    alone: float
    with_depth: float
    known: float
    determined: bool

    @property
    def ratio(self) -> float:
        """How many times surer the focal length would be with the depth known."""
        return self.alone / self.with_depth


def focal_and_depth(fit: Fit) -> FocalDepth:
    """Whether the pairs fix focal length and depth apart."""
    if "log_f" not in fit.names:
        return FocalDepth(0.0, 0.0, 0.0, True)
    i, z = fit.names.index("log_f"), fit.names.index("translation_z")
    weight = fit.priors.terms(fit.camera, fit.names)[1]
    weak = np.array(
        [1e-3 if name.startswith("translation") else w for name, w in zip(fit.names, weight, strict=True)]
    )
    weak[i] = 0.0
    bare = fit.information - np.diag(weight**2) + np.diag(weak**2)
    keep = np.arange(len(fit.names)) != z
    alone = float(np.sqrt(inverse(bare)[i, i]))
    held = float(np.sqrt(inverse(bare[np.ix_(keep, keep)])[keep[:i].sum(), keep[:i].sum()]))
    known = float(np.sqrt(fit.covariance[i, i]))
    return FocalDepth(alone, held, known, alone < UNSURE or alone < _RATIO * held)


def advice(fit: Fit, ambiguity: FocalDepth, xyz: np.ndarray, noise: PickNoise) -> tuple[str, ...]:
    """Sentences for the user."""
    out = []
    if not ambiguity.determined:
        distance = np.linalg.norm(xyz, axis=1)
        out.append(
            f"These pairs cannot fix focal length and depth apart: the focal length is known to "
            f"{_percent(ambiguity.alone)} from them, and would be to {_percent(ambiguity.with_depth)} if the "
            f"depth were known ({ambiguity.ratio:.0f} times surer). All of them are {distance.min():.1f} to "
            f"{distance.max():.1f} m away and nearly face the camera. The calibration holds at "
            f"these distances; at others it may not. Tilt the board by 30° and more, add a second distance "
            f"at the same zoom, or give the focal length of the lens."
        )
    return tuple(out)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 1 else "no better than a factor of 2"
