"""Moving a point by its image: in the plane parallel to the image, along its ray, from several views.

A late camera sees a marker where it is τ later. The marker's way from the frame to there, ``shift`` (m),
is taken as known: the camera sees x + shift. Everything here is for one point in one frame; a camera has one
pose (see :meth:`acino_fte.cameras.Camera.at_frames`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from acino_fte.cameras import Camera

NEAREST = 0.01
"""m: no point is brought nearer to a camera than that."""
_STEPS = 30
_CONVERGED = 1e-12


@dataclass(frozen=True, eq=False)
class Sight:
    """Where a point is wanted in one view.

    Attributes
    ----------
    camera : Camera
        With one pose.
    pixel : (2,)
        px.
    shift : (3,)
        m: the camera sees the point there, relative to where it is in the frame.
    """

    camera: Camera
    pixel: np.ndarray
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))


def still(camera: Camera, frame: int) -> Camera:
    """A camera with the one pose that it has in a frame (row of its poses)."""
    if not camera.moves:
        return camera
    rotation, translation = camera.rotation, camera.translation
    return replace(
        camera,
        rotation=rotation[frame] if rotation.ndim == 3 else rotation,
        translation=translation[frame] if translation.ndim == 2 else translation,
    )


def moved_in_image(sight: Sight, point: np.ndarray) -> np.ndarray | None:
    """The point (3,) that a pixel shows, at the depth of a point: in the plane parallel to the image.

    With the pixel's direction d and the point's z in the camera's frame: d z / d_z. Where the plane cannot be
    reached (the point or the pixel is 90° or more from the axis) the distance from the camera is kept.
    None where the lens has no direction for the pixel.
    """
    camera = sight.camera
    local = camera.to_camera((point + sight.shift)[None])[0]
    direction = camera.directions(np.asarray(sight.pixel, dtype=float)[None])[0]
    if not np.isfinite(direction).all():
        return None
    length = float(np.linalg.norm(local))
    if local[2] > 0 and direction[2] > 1e-3:
        length = local[2] / direction[2]
    return _from_camera(camera, direction * max(length, NEAREST)) - sight.shift


def moved_along_ray(sight: Sight, point: np.ndarray, factor: float) -> np.ndarray:
    """The point (3,) at ``factor`` times its distance from the camera: c + factor · (x − c)."""
    centre = sight.camera.centre
    ray = point + sight.shift - centre
    length = float(np.linalg.norm(ray))
    return centre + ray * max(factor, NEAREST / max(length, NEAREST)) - sight.shift


def at_distance(sight: Sight, distance: float) -> np.ndarray | None:
    """The point (3,) behind a pixel at a distance (m) from the camera; None where there is no direction."""
    direction = sight.camera.directions(np.asarray(sight.pixel, dtype=float)[None])[0]
    if not np.isfinite(direction).all():
        return None
    return _from_camera(sight.camera, direction * max(distance, NEAREST)) - sight.shift


def triangulated(sights: Sequence[Sight], start: np.ndarray) -> np.ndarray | None:
    """The point (3,) with the least sum of squared reprojection errors in two or more views.

    Gauss-Newton with Levenberg's damping, from the point nearest to all rays (Hartley and Zisserman 2004,
    section 12.3; their geometric error) and from ``start``; the better end is taken. None where the rays are
    parallel, or the point would be behind a camera.
    """
    rays = [sight.camera.rays(np.asarray(sight.pixel, dtype=float)[None, None])[0, 0] for sight in sights]
    if not np.isfinite(rays).all():
        return None
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for sight, ray in zip(sights, rays, strict=True):
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        right += across @ (sight.camera.centre - sight.shift)
    if np.linalg.cond(normal) > 1e10:
        return None
    ends = [_refined(sights, begin) for begin in (np.linalg.solve(normal, right), np.asarray(start, float))]
    found = [(cost, end) for cost, end in ends if np.isfinite(cost)]
    return min(found, key=lambda pair: pair[0])[1] if found else None


def _refined(sights: Sequence[Sight], point: np.ndarray) -> tuple[float, np.ndarray]:
    """Cost (px²) and point after minimising; ∞ when a camera cannot see the start."""
    damping = 1e-3
    residual, slope = _linear(sights, point)
    cost = float(residual @ residual)
    for _ in range(_STEPS if np.isfinite(cost) else 0):
        square = slope.T @ slope
        step = np.linalg.lstsq(square + damping * np.diag(np.diag(square)), -slope.T @ residual, rcond=None)[
            0
        ]
        tried = point + step
        residual_there, slope_there = _linear(sights, tried)
        there = float(residual_there @ residual_there)
        if not there <= cost:  # also where it is NaN
            damping *= 10.0
            continue
        gain, point, cost = cost - there, tried, there
        residual, slope, damping = residual_there, slope_there, damping / 10.0
        if gain <= _CONVERGED * (1.0 + cost):
            break
    return (cost if np.isfinite(cost) else np.inf), point


def _linear(sights: Sequence[Sight], point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (2V,) px and their derivative (2V, 3) px/m."""
    residual, slope = [], []
    for sight in sights:
        pixel, jacobian = sight.camera.project_with_jacobian((point + sight.shift)[None])
        residual.append(sight.camera.pixel_difference(pixel[0], sight.pixel))
        slope.append(jacobian[0])
    return np.concatenate(residual), np.concatenate(slope)


def _from_camera(camera: Camera, local: np.ndarray) -> np.ndarray:
    return (local - camera.translation) @ camera.rotation
