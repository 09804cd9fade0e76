"""Pairs left out: how well the others foresee them, and whether the lens needs more parameters for it."""

from __future__ import annotations

import numpy as np

from acino_fte.data_tools.lidar_solve_fit import OUTLIER, Fit, polished
from acino_fte.data_tools.lidar_solve_model import PickNoise, pick_covariance, projection

LENSES = (("log_aspect",), ("k1",), ("k1", "k2"), ("log_aspect", "k1"), ("log_aspect", "k1", "k2"))
"""What may be added to focal length and principal point, the simplest first."""
_SURE = 3.0  # standard errors by which the pairs that were left out must be foreseen better


def left_out(fit: Fit) -> np.ndarray:
    """Residual (P, 2) of each pair under the fit to all others, px, to first order.

    The deleted residual of least squares, (1 − H_ii)⁻¹ r_i, with H the hat matrix (Cook and Weisberg 1982,
    section 2.2.1); of a pair without weight the residual itself.
    """
    white = fit.white
    weight = (fit.weight / fit.scale**2)[:, None, None]
    hat = weight * (white @ fit.covariance @ white.transpose(0, 2, 1))
    deleted = np.linalg.solve(np.eye(2) * (1.0 + 1e-9) - hat, fit.error[..., None])
    known = np.isfinite(fit.residual).all(axis=1) & (np.abs(fit.whiten).sum(axis=(1, 2)) > 0)
    out = fit.residual.copy()
    out[known] = np.linalg.solve(fit.whiten[known], deleted[known])[..., 0]
    return out


def left_out_squared(fit: Fit) -> np.ndarray:
    """Squared distances (P,) of the pairs that were left out, in units of the assumed noise."""
    white = np.einsum("pij,pj->pi", fit.whiten, np.nan_to_num(left_out(fit)))
    return (white**2).sum(axis=1)


def choose_lens(fit: Fit, pixel: np.ndarray, xyz: np.ndarray, noise: PickNoise) -> Fit:
    """The fit with the parameters of the lens that pairs left out support; the given one, if none.

    A lens with more parameters is taken where it foresees left-out pairs better by three standard errors, and
    by more than a simpler one does.
    """
    base = fit.names
    while True:
        best, gain = fit, 0.0
        for more in LENSES:
            names = base + more
            if not set(names) > set(fit.names) or len(names) > len(
                pixel
            ):  # two numbers a parameter, at least
                continue
            trial = polished(fit.camera, names, pixel, xyz, noise, fit.priors, fit.scale)
            limit = OUTLIER * fit.scale**2
            better = np.minimum(left_out_squared(fit), limit) - np.minimum(left_out_squared(trial), limit)
            better /= fit.scale**2
            sure = better.sum() - _SURE * np.sqrt(len(better)) * better.std(ddof=1)
            if sure > 0 and better.sum() > gain + 2.0 * (len(names) - len(best.names)):
                best, gain = trial, better.sum()
        if best is fit:
            return fit
        fit = best


def expected_rmse(fit: Fit, xyz: np.ndarray, noise: PickNoise) -> tuple[float, float]:
    """What errors to expect of new picks on points (K, 3): of the true camera, and of the one in the fit, px.

    The second is from the covariance of the fit: at the true camera and with the true noise it is the
    Cramér-Rao bound of what can be reached with these pairs, to first order.
    """
    _, slope, for_point = projection(fit.camera, xyz, fit.names)
    floor = np.trace(pick_covariance(for_point, xyz, noise), axis1=1, axis2=2)
    added = np.einsum("pij,jk,pik->p", slope, fit.covariance, slope)
    return float(np.sqrt(floor.mean())), float(np.sqrt((floor + added).mean()))
