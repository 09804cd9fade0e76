"""The baseline ``tri``: every marker of every frame triangulated on its own, no skeleton and no motion.

Also what the baselines without a skeleton have in common: which detections count, what a set of points
costs, and how their result is put together. Shapes: N frames, C cameras, M markers.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.losses import Loss
from acino_fte.problem import FTEOptions
from acino_fte.result import FTEResult, Status
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton
from acino_fte.triangulate import Triangulation, check_any, triangulate


def estimate_tri(
    sequence: Sequence,
    skeleton: Skeleton,
    options: FTEOptions | None = None,
    *,
    seconds: dict[str, float] | None = None,
) -> FTEResult:
    """Triangulate every marker in every frame (:mod:`acino_fte.triangulate`).

    Positions are NaN where fewer than two cameras agree. ``objective`` is the sum of the losses of the
    reprojection at the table's ``sd_px`` over all detections of triangulated markers, outliers included.

    Raises
    ------
    InputError
        No marker can be triangulated anywhere.
    """
    options = options or FTEOptions()
    began = time.perf_counter()
    pixels = sequence.pixels(skeleton.marker_names, options.likelihood)
    found = triangulate(sequence.cameras, pixels)
    check_any(found.points, sequence, options.likelihood)
    return points_result(
        "tri",
        sequence,
        skeleton,
        options,
        found.points,
        pixels,
        position_covariance=triangulation_covariance(sequence.cameras, found, marker_sd(skeleton)),
        seconds={**(seconds or {}), "solve": time.perf_counter() - began},
    )


def points_result(
    method: str,
    sequence: Sequence,
    skeleton: Skeleton,
    options: FTEOptions,
    points: np.ndarray,
    pixels: np.ndarray,
    *,
    cameras: CameraArray | None = None,
    objective: float | None = None,
    status: Status = Status.CONVERGED,
    iterations: int = 0,
    **more: Any,
) -> FTEResult:
    """Put the result of a method without a skeleton together: points (N, M, 3) m, pixels (N, C, M, 2).

    ``cameras`` are those to reproject with, when they are not the sequence's own; ``objective`` is the
    robust cost of the points when it is not given.
    """
    known = np.isfinite(points).all(-1)
    reprojected = (cameras or sequence.cameras).project(points)
    if objective is None:
        objective = robust_cost(reprojected, pixels, marker_sd(skeleton), options.loss)
    none = np.empty((sequence.n_frames, 0))
    found = f"{known.sum()} of {known.size} markers were seen by two cameras that agree; the others are NaN."
    return FTEResult(
        status=status,
        sequence=sequence,
        skeleton=skeleton,
        q=none,
        dq=none,
        ddq=none,
        positions=points,
        observed=pixels,
        reprojected=reprojected,
        objective=objective,
        iterations=iterations,
        method=method,
        options={"problem": options.summary()},
        findings=() if known.all() else (found,),
        **more,
    )


def marker_sd(skeleton: Skeleton) -> np.ndarray:
    """(M,) detection noise of the markers, px."""
    return np.array([marker.sd_px for marker in skeleton.markers])


def robust_cost(reprojected: np.ndarray, observed: np.ndarray, sd_px: np.ndarray, loss: Loss) -> float:
    """Σ ρ(|r|/σ) over u and v of all detections (theory, eq. 9); what has no projection is left out."""
    scaled = (reprojected - observed) / sd_px[:, None]
    return float(loss.value(scaled[np.isfinite(scaled)]).sum())


def project_all(cameras: CameraArray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, C, M, 2) of points (N, M, 3) and their derivatives (N, C, M, 2, 3), px/m; NaN behind."""
    found = [camera.project_with_jacobian(points) for camera in cameras]
    return np.stack([f[0] for f in found], axis=1), np.stack([f[1] for f in found], axis=1)


def triangulation_covariance(cameras: CameraArray, found: Triangulation, sd_px: np.ndarray) -> np.ndarray:
    """Covariance (N, M, 3, 3) of triangulated points, m², from the views that agree."""
    _, slope = project_all(cameras, found.points)
    return point_covariance(slope, np.repeat(found.inliers[..., None].astype(float), 2, axis=-1), sd_px)


def point_covariance(slope: np.ndarray, weight: np.ndarray, sd_px: np.ndarray) -> np.ndarray:
    """Covariance (N, M, 3, 3) of points, m²: the inverse of their Gauss–Newton information.

    ``(Σ w JᵀJ/σ²)⁻¹`` over the cameras (Hartley and Zisserman 2004, section 5.2, with weights), J being the
    slope (N, C, M, 2, 3) in px/m and w the weights (N, C, M, 2) of u and v. NaN where the weighted views
    do not determine the point.
    """
    scaled = np.where(weight[..., None] > 0, slope, 0.0) * (np.sqrt(weight) / sd_px[:, None])[..., None]
    rows = np.moveaxis(np.nan_to_num(scaled), 1, 2)  # (N, M, C, 2, 3)
    rows = rows.reshape(*rows.shape[:2], -1, 3)
    information = np.swapaxes(rows, -1, -2) @ rows
    size = np.linalg.eigvalsh(information)
    good = size[..., 0] > 1e-12 * np.maximum(size[..., 2], 1e-300)
    inverse = np.linalg.inv(np.where(good[..., None, None], information, np.eye(3)))
    return np.where(good[..., None, None], inverse, np.nan)
