"""What is to be said of a calibration: above all, whether focal length and depth are apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.lidar_solve_fit import Fit, inverse
from acino_fte.data_tools.lidar_solve_model import PickNoise

UNSURE = 0.02
"""Relative standard deviation of a focal length, from the pairs alone, that is too much."""
_RATIO = 5.0
_COARSE, _APART = 3.0, 2.5  # times the assumed noise; m


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
        Whether they are apart, or the focal length was told.
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
    weak = np.where([name.startswith("translation") for name in fit.names], 1e-3, weight)
    weak[i] = 0.0
    bare = fit.information - np.diag(weight**2) + np.diag(weak**2)
    keep = np.arange(len(fit.names)) != z
    alone = float(np.sqrt(inverse(bare)[i, i]))
    held = float(np.sqrt(inverse(bare[np.ix_(keep, keep)])[keep[:i].sum(), keep[:i].sum()]))
    known = float(np.sqrt(fit.covariance[i, i]))
    told = "log_f" in fit.priors.sd and known < UNSURE
    return FocalDepth(alone, held, known, told or alone < UNSURE or alone < _RATIO * held)


def advice(
    fit: Fit, ambiguity: FocalDepth, xyz: np.ndarray, noise: PickNoise, rows: np.ndarray
) -> tuple[str, ...]:
    """Sentences for the user. `rows` (P,) are the numbers of the pairs, from 0."""
    out = []
    if not ambiguity.determined:
        out.append(_no_focal_length(fit, ambiguity, xyz))
    wrong = np.flatnonzero(fit.weight == 0)
    if len(wrong):
        length = np.linalg.norm(fit.residual, axis=1)
        order = wrong[np.argsort(-np.nan_to_num(length[wrong], nan=np.inf))]
        listed = ", ".join(f"{rows[i] + 1} ({length[i]:.0f} px)" for i in order[:8])
        one = len(wrong) == 1
        out.append(
            f"{len(wrong)} of {len(rows)} pairs {'does' if one else 'do'} not fit the others and "
            f"{'does' if one else 'do'} not count: {listed}{', …' if len(wrong) > 8 else ''}. Look at "
            f"{'it' if one else 'them'}: often a return from beside an edge was picked."
        )
    if fit.scale > _COARSE:
        out.append(
            f"The picks are {fit.scale:.1f} times less exact than {noise.pixel:g} px in the image and "
            f"{100 * noise.range:g} cm along the ray. Usual causes: returns too sparse at the places picked, "
            f"an image that is not sharp, or a zoom that changed between images."
        )
    away = float(np.linalg.norm(fit.camera.centre))
    if away > _APART:
        out.append(
            f"The camera comes out {away:.1f} m from the lidar. If both are on one rig, say so (rig_m), or "
            f"check that pixels and points belong together."
        )
    if not fit.converged:
        out.append("The least squares did not settle; more pairs, better spread, will help.")
    return tuple(out)


def _no_focal_length(fit: Fit, ambiguity: FocalDepth, xyz: np.ndarray) -> str:
    """What to say where focal length and depth are not apart."""
    depth = fit.camera.to_camera(xyz[fit.weight > 0])[:, 2]
    where = f"{depth.min():.1f} to {depth.max():.1f} m deep"
    return (
        f"These pairs cannot fix focal length and depth apart: from them alone the focal length is known to "
        f"{_percent(ambiguity.alone)}; with the depth known it would be to {_percent(ambiguity.with_depth)} "
        f"({ambiguity.ratio:.0f} times surer). With the camera near the lidar it is to "
        f"{_percent(ambiguity.known)}. All pairs are {where}: there the calibration holds, elsewhere it may "
        f"not. Tilt the board by 30° and more, add a second distance at the same zoom, or give the focal "
        f"length of the lens."
    )


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 1 else "no better than a factor of 2"
