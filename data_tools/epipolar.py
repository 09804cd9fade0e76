"""Two-view geometry of calibrated cameras: fundamental matrices, epipolar lines, distances, in batches.

Everything is in ideal pixels: where the lens without its distortion would have put the point, by the same
camera matrix. Straight lines are straight there, so fisheye, distorted, DLT and Vicon cameras are all alike.
A measured pixel is made ideal once, by :func:`ideal_pixels`.

Arrays broadcast as NumPy's do, with the matrix (…, 3, 3) counted as one element and a point (…, 2) as one:
``sampson_distance(F, a[:, None], b[None])`` is the table of every point of a against every point of b, and a
matrix a frame (N, 3, 3) takes its points (N, M, 2) as ``F[:, None]``.

Formulas: Hartley & Zisserman 2004, *Multiple View Geometry*, 2nd edition.
"""

from __future__ import annotations

import numpy as np

from acino_fte.cameras import Camera

_COINCIDENT = 1e-9


def essential_matrix(a: Camera, b: Camera) -> np.ndarray:
    """Essential matrix of two cameras, each fixed or moving.

    ``x_b · E x_a = 0`` for the normalised coordinates of a point in both (Hartley & Zisserman 2004, eq. 9.11
    and 9.12: E = [t]× R, here with |t| = 1).

    Returns
    -------
    (3, 3), or (N, 3, 3) when a camera moves
        NaN where the two centres coincide: such a pair has no epipolar lines.
    """
    return essential_from_poses(a.rotation, a.translation, b.rotation, b.translation)


def essential_from_poses(
    rotation_a: np.ndarray, translation_a: np.ndarray, rotation_b: np.ndarray, translation_b: np.ndarray
) -> np.ndarray:
    """The same of poses: rotations (…, 3, 3) and translations (…, 3), world to camera, m."""
    relative = rotation_b @ np.swapaxes(rotation_a, -1, -2)
    shift = translation_b - (relative @ translation_a[..., None])[..., 0]
    length = np.linalg.norm(shift, axis=-1, keepdims=True)
    x, y, z = np.moveaxis(shift / np.where(length > _COINCIDENT, length, np.nan), -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    return cross.reshape(*shift.shape[:-1], 3, 3) @ relative


def fundamental_matrix(a: Camera, b: Camera) -> np.ndarray:
    """Fundamental matrix of two cameras, each fixed or moving, in ideal pixels.

    ``x_b · F x_a = 0`` (Hartley & Zisserman 2004, eq. 9.12: F = K_b⁻ᵀ E K_a⁻¹). F of (b, a) is the transpose.

    Returns
    -------
    (3, 3), or (N, 3, 3) when a camera moves
        NaN where the two centres coincide.
    """
    return np.linalg.inv(b.matrix).T @ essential_matrix(a, b) @ np.linalg.inv(a.matrix)


def ideal_pixels(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Ideal pixels (…, 2) of measured pixels (…, 2); NaN outside the valid field of the lens."""
    normalised = camera.undistort(pixels)
    return normalised @ camera.matrix[:2, :2].T + camera.matrix[:2, 2]


def ideal_jacobian(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """How an ideal pixel moves with the measured one, (…, 2, 2), at measured pixels (N, M, 2).

    The identity for a camera without distortion. Towards the edge of a wide lens one measured pixel is
    several ideal ones, and so is its noise. Any shape (…, 2) will do for a fixed camera. NaN outside the
    valid field.
    """
    _, slope = camera.project_with_jacobian(camera.back_project(pixels, 1.0))
    rotation = camera.rotation[:, None] if camera.rotation.ndim == 3 else camera.rotation
    local = (
        slope @ np.swapaxes(rotation, -1, -2)[..., :2]
    )  # measured pixel for normalised coordinates, at z = 1
    (p, q), (r, s) = np.moveaxis(local, (-2, -1), (0, 1))
    adjugate = np.stack([np.stack([s, -q], axis=-1), np.stack([-r, p], axis=-1)], axis=-2)
    return camera.matrix[:2, :2] @ (adjugate / (p * s - q * r)[..., None, None])


def epipolar_lines(fundamental: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Lines (…, 3) in image b of points (…, 2) of image a; with Fᵀ, lines in image a of points of image b.

    A line (l, m, n) has l² + m² = 1, so ``l x + m y + n`` is the signed distance of (x, y) from it, px
    (Hartley & Zisserman 2004, section 9.2: l' = F x). NaN for the epipole itself.
    """
    line = np.stack(_times(fundamental, points), axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return line / np.hypot(line[..., :1], line[..., 1:2])


def sampson_distance(
    fundamental: np.ndarray,
    points_a: np.ndarray,
    points_b: np.ndarray,
    jacobian_a: np.ndarray | None = None,
    jacobian_b: np.ndarray | None = None,
) -> np.ndarray:
    """Signed Sampson distance (…) of points (…, 2) of image a and (…, 2) of image b, px.

    To first order the distance, in the four coordinates together, to the nearest pair of pixels that fits the
    cameras; its square is eq. 11.9 of Hartley & Zisserman 2004. Of a right pair whose coordinates have
    independent noise σ it is noise σ. The sign is that of x_b · F x_a. NaN for missing points.

    Parameters
    ----------
    fundamental : (…, 3, 3)
        In ideal pixels; of (a, b).
    points_a, points_b : (…, 2)
        Ideal pixels.
    jacobian_a, jacobian_b : (…, 2, 2), optional
        Of :func:`ideal_jacobian`. With them the distance, and σ, are in measured pixels.
    """
    error, normal_a, normal_b = _residual(fundamental, points_a, points_b)
    squared = _squared_length(normal_a, jacobian_a) + _squared_length(normal_b, jacobian_b)
    with np.errstate(invalid="ignore", divide="ignore"):
        return error / np.sqrt(squared)


def symmetric_distance(fundamental: np.ndarray, points_a: np.ndarray, points_b: np.ndarray) -> np.ndarray:
    """Symmetric epipolar distance (…) of points (…, 2) of image a and (…, 2) of image b, px, not negative.

    Each point's distance from the line of the other; of the two, the root of the sum of their squares. Its
    square is eq. 11.10 of Hartley & Zisserman 2004. NaN for missing points.
    """
    error, normal_a, normal_b = _residual(fundamental, points_a, points_b)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.abs(error) * np.sqrt(1 / _squared_length(normal_a) + 1 / _squared_length(normal_b))


_Normal = tuple[np.ndarray, np.ndarray]


def _residual(
    fundamental: np.ndarray, points_a: np.ndarray, points_b: np.ndarray
) -> tuple[np.ndarray, _Normal, _Normal]:
    """x_b · F x_a, and its derivatives for x_a and x_b: normals of the lines in image a and in image b."""
    fundamental, points_b = np.asarray(fundamental, dtype=float), np.asarray(points_b, dtype=float)
    in_b = _times(fundamental, points_a)
    in_a = _times(np.swapaxes(fundamental, -1, -2), points_b)
    error = points_b[..., 0] * in_b[0] + points_b[..., 1] * in_b[1] + in_b[2]
    return error, in_a[:2], in_b[:2]


def _squared_length(normal: _Normal, jacobian: np.ndarray | None = None) -> np.ndarray:
    """Squared length of a normal, carried back to measured pixels by a Jacobian (…, 2, 2) if there is one."""
    x, y = normal
    if jacobian is not None:
        j = jacobian
        x, y = j[..., 0, 0] * x + j[..., 1, 0] * y, j[..., 0, 1] * x + j[..., 1, 1] * y
    return x**2 + y**2


def _times(matrix: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The three rows of ``matrix @ (x, y, 1)``, element by element, so that tables are made in one pass."""
    f, p = np.asarray(matrix, dtype=float), np.asarray(points, dtype=float)
    x, y = p[..., 0], p[..., 1]
    rows = [f[..., i, 0] * x + f[..., i, 1] * y + f[..., i, 2] for i in range(3)]
    return rows[0], rows[1], rows[2]
