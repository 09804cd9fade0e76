"""Rotation matrices, rotation vectors and quaternions of many frames at once.

SciPy's Rotation does the same; importing it costs more than the work of a whole scene's paths, so the modules
that every scene needs use these few formulas (Rodrigues 1840; Shepperd 1978), and tests hold them to SciPy.
"""

from __future__ import annotations

import numpy as np

_SMALL = 1e-6


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """[v]× (…, 3, 3) of vectors (…, 3): [v]× w = v × w."""
    out = np.zeros((*vector.shape, 3))
    x, y, z = np.moveaxis(vector, -1, 0)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """Rotations (…, 3, 3) of rotation vectors (…, 3), rad: I + sin θ/θ [v]× + (1 − cos θ)/θ² [v]×²."""
    squared = (vector**2).sum(-1)[..., None, None]
    angle = np.sqrt(squared)
    far = angle > _SMALL
    safe = np.where(far, angle, 1.0)
    first = np.where(far, np.sin(safe) / safe, 1.0 - squared / 6.0)
    second = np.where(far, (1.0 - np.cos(safe)) / safe**2, 0.5 - squared / 24.0)
    skew = cross_matrix(vector)
    return np.eye(3) + first * skew + second * (skew @ skew)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Rotation vectors (…, 3), rad, at most π long, of rotations (…, 3, 3), by way of quaternions."""
    quaternion = rotation_quaternion(matrix)
    part = quaternion[..., :3]
    sine = np.linalg.norm(part, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quaternion[..., 3:])
    return part * np.where(sine > _SMALL, angle / np.where(sine > _SMALL, sine, 1.0), 2.0)


def rotation_quaternion(matrix: np.ndarray) -> np.ndarray:
    """Unit quaternions (…, 4), x y z w with w ≥ 0, of rotations (…, 3, 3)."""
    m = np.asarray(matrix, dtype=float)
    diagonal = np.moveaxis(np.diagonal(m, axis1=-2, axis2=-1), -1, 0)
    trace = diagonal.sum(0)
    sums = [(m[..., i, j] + m[..., j, i]) for i, j in ((0, 1), (0, 2), (1, 2))]
    skews = [(m[..., j, i] - m[..., i, j]) for i, j in ((1, 2), (2, 0), (0, 1))]
    rows = np.empty((*m.shape[:-2], 4, 4))  # 4 q qᵀ, and its row with the greatest entry
    for i in range(3):
        rows[..., i, i] = 1.0 + 2.0 * diagonal[i] - trace
        rows[..., i, 3] = rows[..., 3, i] = skews[i]
    rows[..., 3, 3] = 1.0 + trace
    for (i, j), value in zip(((0, 1), (0, 2), (1, 2)), sums, strict=True):
        rows[..., i, j] = rows[..., j, i] = value
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    chosen = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    chosen = chosen * np.where(chosen[..., 3:] < 0, -1.0, 1.0)
    return chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
