"""How well the poses of a model are known, from the residuals of its own observations.

With the points held fixed, a pose is estimated from the observations of its image alone. Its covariance is
σ² (Σ JᵀJ)⁻¹, J the derivatives of the reprojections for the pose and σ² the variance of a residual (Triggs et
al. 2000, "Bundle adjustment - a modern synthesis", section 9). This is the error that changes from image to
image; the slow drift of a whole reconstruction is not in it.

That holds for poses at the minimum of their residuals, where bundle adjustment leaves them; steps of Gauss
and Newton, δ = (Σ JᵀJ)⁻¹ Σ Jᵀr, are small there. Where they are larger than chance makes them (a robust loss,
rounded files), the covariance grows by as much. Poses from elsewhere (another sensor, a filter) are far from
the minimum, and the steps themselves say how wrong they are: δ ~ N(0, D + σ² (Σ JᵀJ)⁻¹), with one variance of
turns and one of shifts in D for all images. With D as prior, the most probable step mends such poses.

Shapes: I images, K observations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

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
_NO_NOISE = 1e-16  # px²; residuals are those of a simulation without noise
_MEDIAN_CHI2_6 = 5.348
_ADJUSTED = 4.0  # steps that take more than this, against chance: the poses are not adjusted
_MOST_IMAGES, _EM_STEPS, _EM_TOLERANCE = 1000, 100, 1e-3


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
    finite = residual[np.isfinite(residual).all(axis=1)]
    n, taken = finite.size, _freedoms(model, residual)
    if n == 0 or n <= taken:
        return float("nan")
    return _MAD_TO_SD * float(np.median(np.abs(finite))) * float(np.sqrt(n / (n - taken)))


def _freedoms(model: ColmapModel, residual: np.ndarray) -> int:
    """What the poses and points with residuals are free to take out of them, less the gauge."""
    good = np.isfinite(residual).all(axis=1)
    n_images = len(np.unique(model.observed_image[good]))
    n_points = len(np.unique(model.observed_point[good]))
    return max(_IMAGE_FREEDOMS * n_images + _POINT_FREEDOMS * n_points - _GAUGE_FREEDOMS, 0)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """What the residuals of a model say of its poses.

    Attributes
    ----------
    covariance : (I, 6, 6)
        Turn (rad, in the camera's frame: R_true = exp(turn×) R), then shift of the centre (world, in the
        model's units), as :class:`~acino_fte.data_tools.camera_keys.KeyedCamera` has it. NaN where the
        observations do not fix the pose.
    noise_px : float
        Standard deviation of an observed coordinate; NaN where the residuals do not say it.
    adjusted : bool
        Whether the poses are at the minimum of their residuals.
    step : (I, 6)
        The most probable error of each pose; 0 for poses that are adjusted, and where it is not known.
    after_step : (I, 6, 6)
        Covariance of the poses with the step taken.
    """

    covariance: np.ndarray
    noise_px: float
    adjusted: bool
    step: np.ndarray
    after_step: np.ndarray


def pose_errors(model: ColmapModel, min_observations: int = MIN_OBSERVATIONS) -> PoseErrors:
    """How wrong the poses of a model are.

    Parameters
    ----------
    model : ColmapModel
        With its observations.
    min_observations : int
        Images with fewer have a NaN matrix.

    Returns
    -------
    PoseErrors
    """
    residual = residuals(model)
    sigma = residual_noise(model, residual)
    normal, pull, count, rest = _normal_equations(model, residual, _GROSS * sigma)
    inverse = _inverses(normal, count >= min_observations)
    fixed = np.isfinite(inverse).all(axis=(1, 2))
    taken = np.einsum("ni,nij,nj->n", pull[fixed], inverse[fixed], pull[fixed])  # of Σ r² by each step
    freedoms = 2 * count.sum() - _freedoms(model, residual)
    if not fixed.any() or not freedoms > 0:
        return _as_adjusted(inverse * np.nan, sigma)
    after = (rest - taken.sum()) / freedoms
    if after < _NO_NOISE:
        return _as_adjusted(inverse * sigma**2, sigma)
    ratio = float(np.median(taken)) / (_MEDIAN_CHI2_6 * after)
    if ratio < _ADJUSTED:
        return _as_adjusted(inverse * sigma**2 * max(1.0, ratio), sigma)
    information, pull = normal[fixed] / after, pull[fixed] / after
    variances = np.repeat(_common_variances(information, pull), 3)
    covariance, left, step = (
        np.full(normal.shape, np.nan),
        np.full(normal.shape, np.nan),
        np.zeros((len(fixed), 6)),
    )
    covariance[fixed] = np.diag(variances)
    left[fixed] = np.linalg.inv(information + np.diag(1.0 / variances))
    step[fixed] = np.einsum("nij,nj->ni", left[fixed], pull)
    return PoseErrors(covariance, float(np.sqrt(after)), False, step, left)


def _as_adjusted(covariance: np.ndarray, noise_px: float) -> PoseErrors:
    return PoseErrors(covariance, noise_px, True, np.zeros(covariance.shape[:2]), covariance)


def mended(model: ColmapModel, errors: PoseErrors) -> ColmapModel:
    """The model with the steps of its poses taken; an adjusted one as it is."""
    from scipy.spatial.transform import Rotation

    if errors.adjusted:
        return model
    rotation = Rotation.from_rotvec(errors.step[:, :3]).as_matrix() @ model.rotation
    centre = errors.step[:, 3:] - np.einsum("nji,nj->ni", model.rotation, model.translation)
    return replace(model, rotation=rotation, translation=-np.einsum("nij,nj->ni", rotation, centre))


def _normal_equations(
    model: ColmapModel, residual: np.ndarray, largest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Σ JᵀJ (I, 6, 6), Σ Jᵀr (I, 6), observations (I,) and Σ r², of residuals up to `largest`."""
    n_images = len(model.names)
    normal, pull = np.zeros((n_images, 6, 6)), np.zeros((n_images, 6))
    count, squares = np.zeros(n_images, dtype=int), 0.0
    for rows, camera, points in _parts(model):
        image, r = model.observed_image[rows], residual[rows]
        slope = pose_slope(camera, points)
        good = (np.linalg.norm(r, axis=1) <= largest) & np.isfinite(slope).all(axis=(1, 2))
        slope, image, r = slope[good], image[good], r[good]
        if not len(image):
            continue
        starts = np.flatnonzero(np.concatenate([[True], image[1:] != image[:-1]]))
        turned = slope.swapaxes(1, 2)
        normal[image[starts]] += np.add.reduceat(turned @ slope, starts)
        pull[image[starts]] += np.add.reduceat((turned @ r[:, :, None])[..., 0], starts)
        count += np.bincount(image, minlength=n_images)
        squares += float(np.sum(r**2))
    return normal, pull, count, squares


def _common_variances(information: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Variances (2,) of turns and shifts that make the steps of all images most probable.

    Expectation maximisation: with D = diag(variances), the error of a pose is N(P b, P), P = (D⁻¹ + A)⁻¹,
    with A (I, 6, 6) and b (I, 6) the normal equations over σ². Images beyond a thousand are skipped evenly.
    """
    every = -(-len(pull) // _MOST_IMAGES)
    information, pull = information[::every], pull[::every]
    inverse = _inverses(information, np.ones(len(pull), dtype=bool))
    step = np.einsum("nij,nj->ni", inverse, pull)
    variances = np.mean(step.reshape(-1, 2, 3) ** 2, axis=(0, 2))
    for _ in range(_EM_STEPS):
        posterior = np.linalg.inv(information + np.diag(np.repeat(1.0 / variances, 3)))
        mean = np.einsum("nij,nj->ni", posterior, pull)
        second = mean**2 + np.diagonal(posterior, axis1=1, axis2=2)
        before, variances = variances, np.mean(second.reshape(-1, 2, 3), axis=(0, 2))
        if np.all(np.abs(variances - before) < _EM_TOLERANCE * before):
            break
    return variances


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
