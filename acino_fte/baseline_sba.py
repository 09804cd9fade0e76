"""The baseline ``sba``: sparse bundle adjustment of points, and of camera poses when asked to.

Every triangulated marker is moved to the minimum of the robust reprojection cost of the trajectory problem
(the first sum of theory's eq. 9) with no skeleton and no motion. With ``cameras_too`` every camera but the
first is corrected as well,

    x_camera = Exp(ρ)·(R·x + t) + d,   ρ ~ N(0, (0.5°)²),  d ~ N(0, (0.1 m)²)

(the widths are options); the first camera holds the world in place, and the priors hold its scale, which no
image tells.

The least squares problem goes to SciPy's trust-region reflective method (Branch, Coleman and Li 1999) with a
sparse Jacobian and LSMR (Fong and Saunders 2011). Every point and every camera is scaled by the Cholesky
factor of its covariance with all else fixed: the unknowns are then in standard deviations and the normal
matrix is near the identity, so that LSMR needs few steps (the block-Jacobi preconditioner of Agarwal et al.
2010, Bundle adjustment in the large).

Shapes: N frames, C cameras, M markers, K points, O observations, P = 3 K + 6 (C − 1) or 3 K unknowns.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from acino_fte.baseline_tri import (
    marker_sd,
    point_covariance,
    points_result,
    project_all,
    triangulation_covariance,
)
from acino_fte.cameras import CameraArray
from acino_fte.losses import Loss
from acino_fte.parameters import PriorWidths
from acino_fte.problem import FTEOptions
from acino_fte.result import FTEResult, Status
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton
from acino_fte.triangulate import Triangulation, check_any, triangulate

_WIDE = 60.0  # px: views agree within three times the usual distance while the cameras are not corrected
_MAX_STEPS = 200
_ORIGIN = 10.0  # the unknowns at the start: SciPy's first trust region is as long as they are
_BEHIND = 1e3  # residual, in standard deviations, of a marker that a step took behind a camera


def estimate_sba(
    sequence: Sequence,
    skeleton: Skeleton,
    options: FTEOptions | None = None,
    *,
    cameras_too: bool = False,
    progress: Callable[[int, float], None] | None = None,
    seconds: dict[str, float] | None = None,
) -> FTEResult:
    """Adjust the points of :func:`acino_fte.baseline_tri.estimate_tri`, and the cameras when asked to.

    ``objective`` is the minimum: robust reprojection cost, plus ½ Σ (correction/sd)² with ``cameras_too``.
    Then ``reprojected`` is through the corrected cameras, and ``parameters["extrinsics"]`` has the
    corrections, ``{camera: {"rotation_rad": ρ, "translation_m": d}}``, with ``extrinsics_sd`` beside it.
    The covariance of the positions is for the cameras as they are in the end.

    Raises
    ------
    InputError
        No marker can be triangulated anywhere.
    """
    options = options or FTEOptions()
    began = time.perf_counter()
    pixels = sequence.pixels(skeleton.marker_names, options.likelihood)
    sd = marker_sd(skeleton)
    cameras, poses = sequence.cameras, np.zeros((len(sequence.cameras), 6))
    if cameras_too:  # once with every view that is near, so that the right ones agree afterwards
        near = triangulate(cameras, pixels, _WIDE)
        rough = Bundle(cameras, pixels, near, sd, Loss("cauchy"), poses, options.widths)
        check_any(rough.known_points, sequence, options.likelihood)
        poses = rough.unpack(solve_bundle(rough, enough=1e-3).x)[1]
    start = triangulate(correct(cameras, poses), pixels)
    bundle = Bundle(cameras, pixels, start, sd, options.loss, poses if cameras_too else None, options.widths)
    check_any(bundle.known_points, sequence, options.likelihood)
    initialised = time.perf_counter()
    solution = solve_bundle(bundle, progress)
    points, poses = bundle.unpack(solution.x)
    spent = {"initialise": initialised - began, "solve": time.perf_counter() - initialised}
    result = points_result(
        "sba",
        sequence,
        skeleton,
        options,
        points,
        pixels,
        cameras=correct(cameras, poses),
        objective=float(solution.cost),
        status=Status.CONVERGED if solution.status > 0 else Status.MAX_ITERATIONS,
        iterations=int(solution.nfev),
        position_covariance=bundle.covariance(solution.x),
        parameters=_extrinsics(bundle, solution.x) if cameras_too else {},
        seconds={**(seconds or {}), **spent},
    )
    return replace(result, options={**result.options, "solver": {"cameras_too": cameras_too}})


def correct(cameras: CameraArray, poses: np.ndarray) -> CameraArray:
    """Cameras with corrections (C, 6) of their poses: rotation vector ρ, rad, and translation d, m."""
    turns = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    return CameraArray(
        tuple(
            camera.displaced(turn, pose[3:]) if pose.any() else camera
            for camera, turn, pose in zip(cameras, turns, poses, strict=True)
        )
    )


def left_jacobian(rotation: np.ndarray) -> np.ndarray:
    """J (3, 3) with Exp(ρ + δ) = Exp(J·δ)·Exp(ρ) to first order, of a rotation vector ρ (3,).

    I + (1 − cos φ)/φ²·[ρ]× + (φ − sin φ)/φ³·[ρ]×², φ = |ρ| (Solà, Deray and Atchuthan 2018, eq. 145).
    """
    angle, cross = float(np.linalg.norm(rotation)), skew(rotation)
    if angle < 1e-6:
        return np.eye(3) + 0.5 * cross
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.eye(3) + first * cross + second * cross @ cross


def skew(v: np.ndarray) -> np.ndarray:
    """Matrices (…, 3, 3) of the cross products with v (…, 3)."""
    result = np.zeros((*v.shape, 3))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[..., c, b], result[..., b, c] = v[..., a], -v[..., a]
    return result


@dataclass(eq=False)
class Bundle:
    """The least squares problem: residuals in standard deviations and their sparse Jacobian.

    The unknowns y are scaled and shifted: points are ``start + L·(y − y_0)``, ``L·Lᵀ`` their covariance at
    the start, a camera's correction is ``poses + S·(y − y_0)`` likewise.

    Attributes
    ----------
    cameras : CameraArray
    pixels : (N, C, M, 2)
    start : Triangulation
        K of its points are known; views that they are behind of are left out.
    sd_px : (M,)
    loss : Loss
        Of the reprojection; the priors of the corrections are squared.
    poses : (C, 6), optional
        Corrections to start from; None keeps the cameras.
    widths : PriorWidths
        Of the corrections.
    """

    cameras: CameraArray
    pixels: np.ndarray
    start: Triangulation
    sd_px: np.ndarray
    loss: Loss
    poses: np.ndarray | None = None
    widths: PriorWidths = field(default_factory=PriorWidths)

    def __post_init__(self) -> None:
        self.pose_prior = np.repeat([self.widths.rotation, self.widths.translation], 3)
        cameras = correct(self.cameras, self._first_poses)
        seen, slope = project_all(cameras, self.start.points)
        covariance = triangulation_covariance(cameras, self.start, self.sd_px)
        self.known = np.isfinite(covariance).all((-1, -2))  # (N, M)
        self.factor = np.linalg.cholesky(covariance[self.known])  # (K, 3, 3)
        usable = np.isfinite(self.pixels - seen).all(-1) & self.known[:, None]
        self.frame, self.camera, self.marker = np.nonzero(usable)  # (O,) each
        number = np.full(self.known.shape, -1)
        number[self.known] = np.arange(self.known.sum())
        self.point = number[self.frame, self.marker]
        self.sd = self.sd_px[self.marker]
        self.n_points, self.n_free = int(self.known.sum()), 0 if self.poses is None else len(self.cameras) - 1
        self.scale = np.zeros((self.n_free, 6, 6))
        self._last: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None
        if self.n_free:
            self.scale = self._camera_scale(cameras, slope)

    @property
    def known_points(self) -> np.ndarray:
        """(N, M, 3) points to start from, NaN where none."""
        return np.where(self.known[..., None], self.start.points, np.nan)

    @property
    def _first_poses(self) -> np.ndarray:
        return np.zeros((len(self.cameras), 6)) if self.poses is None else self.poses

    def _camera_scale(self, cameras: CameraArray, slope: np.ndarray) -> np.ndarray:
        """Cholesky factors (C − 1, 6, 6) of the cameras' covariances with all else fixed."""
        rows = self._camera_rows(cameras, self.start.points, slope, self._first_poses)
        rows /= self.sd[:, None, None]
        scale = []
        for c in range(1, len(self.cameras)):
            part = rows[(self.camera == c) & self.start.inliers[self.frame, self.camera, self.marker]]
            information = np.einsum("oai,oaj->ij", part, part) + np.diag(self.pose_prior**-2)
            scale.append(np.linalg.cholesky(np.linalg.inv(information)))
        return np.array(scale)

    def unpack(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, M, 3), NaN where none, and corrections (C, 6) of the unknowns y (P,)."""
        points, y = self.known_points, y - _ORIGIN
        steps = y[: 3 * self.n_points].reshape(-1, 3)
        points[self.known] += np.einsum("kij,kj->ki", self.factor, steps)
        poses = self._first_poses.copy()
        if self.n_free:
            steps = y[3 * self.n_points :].reshape(-1, 6)
            poses[1:] += np.einsum("cij,cj->ci", self.scale, steps)
        return points, poses

    def _evaluate(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """y, residuals (O, 2), their slopes for world points (O, 2, 3) and for corrections (O, 2, 6 or 0).

        All are over the standard deviation of the detection, and remembered for the Jacobian.
        """
        if self._last is not None and np.array_equal(self._last[0], y):
            return self._last
        points, poses = self.unpack(y)
        cameras = correct(self.cameras, poses)
        seen, slope = project_all(cameras, points)
        at = (self.frame, self.camera, self.marker)
        residual = (seen[at] - self.pixels[at]) / self.sd[:, None]
        by_camera = np.empty((len(self.sd), 2, 0))
        if self.n_free:
            by_camera = np.nan_to_num(self._camera_rows(cameras, points, slope, poses))
            by_camera /= self.sd[:, None, None]
        by_point = np.nan_to_num(slope[at]) / self.sd[:, None, None]
        residual = np.where(np.isfinite(residual), residual, _BEHIND)
        self._last = (y.copy(), residual, by_point, by_camera)
        return self._last

    def _camera_rows(
        self, cameras: CameraArray, points: np.ndarray, slope: np.ndarray, poses: np.ndarray
    ) -> np.ndarray:
        """∂(u, v)/∂(ρ, d) of every observation, (O, 2, 6), px/rad and px/m.

        With x = Exp(ρ)·y + d: ∂x/∂d = 1 and ∂x/∂ρ = −[x − d]× J(ρ), J the left Jacobian.
        """
        result = np.empty((len(self.frame), 2, 6))
        for c, camera in enumerate(cameras):
            mine = self.camera == c
            frame, marker = self.frame[mine], self.marker[mine]
            rotation = np.broadcast_to(camera.rotation, (len(points), 3, 3))[frame]
            local = camera.to_camera(points)[frame, marker]
            by_local = slope[frame, c, marker] @ np.swapaxes(rotation, -1, -2)
            result[mine, :, :3] = by_local @ -skew(local - poses[c, 3:]) @ left_jacobian(poses[c, :3])
            result[mine, :, 3:] = by_local
        return result

    def residuals(self, y: np.ndarray) -> np.ndarray:
        """(2 O + 6 (C − 1),) reprojection residuals, then corrections, over their standard deviations."""
        _, residual, _, _ = self._evaluate(y)
        if not self.n_free:
            return residual.ravel()
        return np.concatenate([residual.ravel(), (self.unpack(y)[1][1:] / self.pose_prior).ravel()])

    @cached_property
    def _pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the Jacobian's entries: points, cameras, priors."""
        o = len(self.sd)
        row = np.arange(2 * o).reshape(o, 2, 1)
        column = 3 * self.point[:, None, None] + np.arange(3)
        rows, columns = [np.broadcast_to(row, (o, 2, 3))], [np.broadcast_to(column, (o, 2, 3))]
        if self.n_free:
            free = self.camera > 0
            column = 3 * self.n_points + 6 * (self.camera[free, None, None] - 1) + np.arange(6)
            rows.append(np.broadcast_to(row[free], (free.sum(), 2, 6)))
            columns.append(np.broadcast_to(column, (free.sum(), 2, 6)))
            block = np.arange(6 * self.n_free).reshape(-1, 6, 1)
            rows.append(np.broadcast_to(2 * o + block, (self.n_free, 6, 6)))
            columns.append(np.broadcast_to(3 * self.n_points + np.swapaxes(block, 1, 2), (self.n_free, 6, 6)))
        return np.concatenate([r.ravel() for r in rows]), np.concatenate([c.ravel() for c in columns])

    def jacobian(self, y: np.ndarray) -> csr_array:
        """∂residuals/∂y, sparse."""
        _, _, by_point, by_camera = self._evaluate(y)
        entries = [by_point @ self.factor[self.point]]
        if self.n_free:
            free = self.camera > 0
            entries.append(by_camera[free] @ self.scale[self.camera[free] - 1])
            entries.append(self.scale / self.pose_prior[:, None])
        shape = (2 * len(self.sd) + 6 * self.n_free, 3 * self.n_points + 6 * self.n_free)
        return csr_array((np.concatenate([e.ravel() for e in entries]), self._pattern), shape=shape)

    def rho(self, z: np.ndarray) -> np.ndarray:
        """The loss as SciPy wants it, of z = e²: 2 ρ and its two derivatives for z, (3, rows).

        The first derivative is the weight ψ/e. The second is given as zero: SciPy's normal matrix is then
        that of iteratively reweighted least squares (theory, eq. 14), which stays positive definite where
        the loss bends down.
        """
        value, _, _, weight = self.loss.derivatives(np.sqrt(z))
        if self.n_free:
            value[-6 * self.n_free :], weight[-6 * self.n_free :] = 0.5 * z[-6 * self.n_free :], 1.0
        return np.stack([2.0 * value, weight, np.zeros_like(z)])

    def covariance(self, y: np.ndarray) -> np.ndarray:
        """Covariance (N, M, 3, 3) of the points, m², with IRLS weights and the cameras fixed."""
        points, poses = self.unpack(y)
        _, slope = project_all(correct(self.cameras, poses), points)
        weight = np.zeros(self.pixels.shape)
        residual = self._evaluate(y)[1]
        weight[self.frame, self.camera, self.marker] = self.loss.derivatives(residual)[3]
        return point_covariance(slope, weight, self.sd_px)

    def pose_sd(self, y: np.ndarray) -> np.ndarray:
        """(C, 6) posterior standard deviations of the corrections, rad and m; zero for the first camera."""
        weight = np.sqrt(self.rho(self.residuals(y) ** 2)[1])
        weighted = self.jacobian(y).multiply(weight[:, None]).tocsc()
        normal = weighted.T @ weighted
        normal.setdiag(normal.diagonal() + 1e-9)  # points whose every view is an outlier
        n, size = 3 * self.n_points, 6 * self.n_free
        unit = np.zeros((n + size, size))
        unit[n:] = np.eye(size)
        inverse = splu(normal.tocsc(), permc_spec="NATURAL").solve(unit)[n:]
        sd = np.zeros((len(self.cameras), 6))
        for i in range(self.n_free):
            block = inverse[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
            sd[i + 1] = np.sqrt(np.diag(self.scale[i] @ block @ self.scale[i].T))
        return sd


def solve_bundle(
    bundle: Bundle, progress: Callable[[int, float], None] | None = None, enough: float = 1e-6
) -> OptimizeResult:
    """Minimise a bundle from its start, until a step lowers the cost by less than a fraction ``enough``."""
    steps = 0

    def jacobian(y: np.ndarray) -> csr_array:
        nonlocal steps
        if progress is not None:
            progress(steps, 0.5 * float(bundle.rho(bundle.residuals(y) ** 2)[0].sum()))
        steps += 1
        return bundle.jacobian(y)

    return least_squares(
        bundle.residuals,
        np.full(3 * bundle.n_points + 6 * bundle.n_free, _ORIGIN),
        jacobian,
        method="trf",
        loss=bundle.rho,
        tr_solver="lsmr",
        gtol=1e-3,
        ftol=enough,
        xtol=1e-9,
        max_nfev=_MAX_STEPS,
    )


def _extrinsics(bundle: Bundle, y: np.ndarray) -> dict[str, Any]:
    """Corrections and their standard deviations, by camera."""
    families = {"extrinsics": bundle.unpack(y)[1], "extrinsics_sd": bundle.pose_sd(y)}
    return {
        family: {
            camera.name: {"rotation_rad": pose[:3].tolist(), "translation_m": pose[3:].tolist()}
            for camera, pose in zip(bundle.cameras, values, strict=True)
        }
        for family, values in families.items()
    }
