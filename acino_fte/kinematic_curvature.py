"""Second derivatives of marker positions, summed with the pull on every marker.

With f_m = ∂E/∂p_m and i acting before or with j on the chain of a marker (:mod:`acino_fte.kinematics`),

    Σ_m f_m · ∂²p_m/∂q_i∂q_j      = ω_i · Σ_m ∂p_m/∂q_j × f_m
    Σ_m f_m · ∂²p_m/∂q_j∂λ        = ω_j · Σ_m (∂p_m/∂λ − ∂c_j/∂λ) × f_m
    Σ_m f_m · ∂²p_m/∂q_j∂offset_m = ω_j · (R_m × f_m)          (column by column)
    Σ_m f_m · ∂²p_m/∂λ²           = Σ_m f_m · ∂p_m/∂λ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.kinematics import Kinematics, Linearised


@dataclass(frozen=True, eq=False)
class Curvature:
    """``states`` (N, Q, Q), ``mixed`` (N, Q, K) with the K kinematic parameters, ``scales`` (G,) diagonal."""

    states: np.ndarray
    mixed: np.ndarray
    scales: np.ndarray


def kinematic_curvature(kinematics: Kinematics, linear: Linearised, pull: np.ndarray) -> Curvature:
    """Curvature that the kinematics add to the Hessian; ``pull`` (N, M, 3) is ∂E/∂p."""
    axes, jacobian = linear.axes, linear.jacobian
    torque = _cross_sum(jacobian, pull[..., None]).sum(1)  # (N, 3, Q)
    full = (axes @ torque) * kinematics.before
    states = full + np.swapaxes(full * ~np.eye(len(kinematics.before), dtype=bool), 1, 2)
    n, m = pull.shape[:2]
    scales = np.einsum("nma,nmag->g", pull, linear.growth)
    mixed = [np.zeros((n, len(kinematics.before), 0))]
    depends = kinematics.depends.astype(float)  # (M, Q)
    if linear.growth.shape[-1]:
        turned = _cross_sum(linear.growth, pull[..., None])  # (N, M, 3, G)
        below = np.einsum("mj,nmag->njag", depends, turned, optimize=True)
        force = np.einsum("mj,nma->nja", depends, pull)
        below -= np.cross(linear.point_growth, force[..., None], axis=2)
        mixed.append(np.einsum("nja,njag->njg", axes, below))
    if linear.rotations.shape[1]:
        turned = _cross_sum(linear.rotations, pull[..., None])  # (N, M, 3, 3)
        each = np.einsum("nja,nmab->njmb", axes, turned, optimize=True) * depends.T[None, :, :, None]
        mixed.append(each.reshape(n, -1, 3 * m))
    return Curvature(states, np.concatenate(mixed, axis=2), scales)


def _cross_sum(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b along the third axis, (N, M, 3, …)."""
    return np.stack(
        [a[:, :, i] * b[:, :, j] - a[:, :, j] * b[:, :, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=2
    )
