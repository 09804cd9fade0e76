"""How well the poses of a model are known, from the residuals of its own observations.

With the points held fixed, a pose is estimated from its image's observations alone. Its covariance is
σ² (Σ JᵀJ)⁻¹, J the derivatives of the reprojections for the pose and σ² the variance of a residual (Triggs
et al. 2000, "Bundle adjustment - a modern synthesis", section 9). This is the error that changes from image to
image; the slow drift of a whole reconstruction is not in it. I images, K observations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.colmap import ColmapModel
from acino_fte.data_tools.trajectory_rows import at_rows, project_rows

MIN_OBSERVATIONS = 5
_CHUNK = 50_000
_MAD_TO_SD = 1.4826
_GROSS = 4.0  # residuals beyond this many standard deviations count nothing
_IMAGE_FREEDOMS, _POINT_FREEDOMS, _GAUGE_FREEDOMS = 6, 3, 7
_SINGULAR = 1e-13


def residuals(model: ColmapModel) -> np.ndarray:
    """Measured less predicted pixels of the observations, (K, 2); NaN where a camera cannot see its point."""
    out = np.empty((len(model.observed_xy), 2))
    for rows, camera, points in _parts(model):
        out[rows] = model.observed_xy[rows] - camera.project(points[:, None])[:, 0]
    return out


def residual_noise(model: ColmapModel, residual: np.ndarray | None = None) -> float:
    """Standard deviation of an observed coordinate, px, from the residuals (K, 2) of the model.

    Robust (median), and enlarged by what the estimated poses (6 each) and points (3 each), less the 7 of the
    gauge, took out of the residuals. NaN where they took out all.
    """
    residual = residuals(model) if residual is None else residual
    good = np.isfinite(residual).all(axis=1)
    n = 2 * int(good.sum())
    n_images = len(np.unique(model.observed_image[good]))
    n_points = len(np.unique(model.observed_point[good]))
    taken = _IMAGE_FREEDOMS * n_images + _POINT_FREEDOMS * n_points - _GAUGE_FREEDOMS
    if n == 0 or n <= taken:
        return float("nan")
    spread = _MAD_TO_SD * float(np.median(np.abs(residual[good])))
    return spread * float(np.sqrt(n / (n - max(taken, 0))))


def pose_covariances(model: ColmapModel, min_observations: int = MIN_OBSERVATIONS) -> np.ndarray:
    """Covariance of the pose of each image, (I, 6, 6).

    Parameters
    ----------
    model : ColmapModel
    min_observations : int
        Images with fewer have a NaN matrix, as have those whose observations do not fix the pose.

    Returns
    -------
    (I, 6, 6)
        Turn (rad, in the camera's frame: R_true = exp(turn×) R), then shift of the centre (world, in the
        model's units), as :class:`~acino_fte.data_tools.camera_keys.KeyedCamera` has it.
    """
    n_images = len(model.names)
    residual = residuals(model)
    sigma = residual_noise(model, residual)
    normal, count = np.zeros((n_images, 6, 6)), np.zeros(n_images, dtype=int)
    for rows, camera, points in _parts(model):
        image = model.observed_image[rows]
        slope = pose_slope(camera, points)
        good = (np.linalg.norm(residual[rows], axis=1) <= _GROSS * sigma) & np.isfinite(slope).all((1, 2))
        slope, image = slope[good], image[good]
        if not len(image):
            continue
        starts = np.flatnonzero(np.concatenate([[True], image[1:] != image[:-1]]))
        normal[image[starts]] += np.add.reduceat(slope.swapaxes(1, 2) @ slope, starts)
        count += np.bincount(image, minlength=n_images)
    return _inverses(normal, count >= min_observations) * sigma**2


def pose_slope(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Derivatives (P, 2, 6) of the pixels of points (P, 3) for the pose: turn, then shift of the centre.

    The camera has one pose for each point. A turn δ moves the point x in the camera's frame by δ × x, a
    shift s of the centre by −R s; with the slope a of a pixel for x, a · (δ × x) = δ · (x × a).
    """
    _, world = project_rows(camera, points)
    local = camera.to_camera(points[:, None])
    in_camera = world @ np.swapaxes(camera.rotation, -1, -2)
    return np.concatenate([np.cross(local, in_camera), -world], axis=2)


def _parts(model: ColmapModel) -> Iterator[tuple[np.ndarray, Camera, np.ndarray]]:
    """Observations in parts of one lens, by image: their rows, the camera at each, the points (P, 3)."""
    camera_ids = model.camera_ids[model.observed_image]
    order = np.lexsort((model.observed_image, camera_ids))
    starts = np.flatnonzero(np.diff(camera_ids[order])) + 1
    for of_camera in np.split(order, starts):
        for begin in range(0, len(of_camera), _CHUNK):
            rows = of_camera[begin : begin + _CHUNK]
            image = model.observed_image[rows]
            yield rows, _camera_at(model, image), model.cloud.xyz[model.observed_point[rows]]


def _camera_at(model: ColmapModel, image: np.ndarray) -> Camera:
    """The camera of some images, which is one, with the pose of each."""
    lens = model.cameras[int(model.camera_ids[image[0]])]
    return at_rows(replace(lens, rotation=model.rotation, translation=model.translation), image)


def _inverses(normal: np.ndarray, enough: np.ndarray) -> np.ndarray:
    """Inverses (I, 6, 6) where there are enough observations and these fix the pose; NaN elsewhere."""
    out = np.full(normal.shape, np.nan)
    size = np.sqrt(np.diagonal(normal, axis1=1, axis2=2))
    kept = np.flatnonzero(enough & (size > 0).all(axis=1))
    scale = size[kept][:, :, None] * size[kept][:, None]
    values, vectors = np.linalg.eigh(normal[kept] / scale)
    fixed = values[:, 0] > _SINGULAR * values[:, -1]
    kept, scale, values, vectors = kept[fixed], scale[fixed], values[fixed], vectors[fixed]
    out[kept] = (vectors / values[:, None]) @ vectors.swapaxes(1, 2) / scale
    return out
