"""A start for the solver: triangulate, find the heading, then one smooth inverse-kinematics solve.

One view has nothing to triangulate: see :mod:`acino_fte.single_view`. A start with all joints at zero ends in
bad local minima; this one does not (see docs/theory.md).
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from acino_fte.condensed_solve import minimise
from acino_fte.kinematics import Kinematics
from acino_fte.losses import Loss
from acino_fte.problem import FTEOptions, build_problem
from acino_fte.result import Status
from acino_fte.sequence import Sequence
from acino_fte.solve import SolveOptions
from acino_fte.terms import point_term
from acino_fte.triangulate import check_any, triangulate

_POINT_SD = 0.06  # m, spread of triangulated markers about the skeleton: segment lengths are generic
_ENOUGH = 3e-3  # relative decrease of the objective per iteration below which the start is good enough
_COARSE = 3  # the start is solved on every third frame and interpolated: it only has to be near


def initial_trajectory(
    sequence: Sequence, kinematics: Kinematics, options: FTEOptions | None = None
) -> np.ndarray:
    """Degrees of freedom to start from, (N, Q), within their bounds.

    Raises
    ------
    InputError
        No marker can be triangulated anywhere.
    """
    options = options or FTEOptions()
    if len(sequence.cameras) == 1:
        from acino_fte.single_view import single_view_trajectory

        return single_view_trajectory(sequence, kinematics, options)
    pixels = sequence.pixels(kinematics.skeleton.marker_names, options.likelihood)
    for stride in (_COARSE, 1) if sequence.n_frames >= 8 * _COARSE else (1,):
        some = slice(None, None, stride)
        cameras = sequence.cameras.at_frames(some)
        points = triangulate(cameras, pixels[some]).points
        if np.isfinite(points).any():
            break
    check_any(points, sequence, options.likelihood)
    q = smooth_inverse_kinematics(kinematics, points, sequence.fps / stride, sequence.frames[some], options)
    if stride > 1:
        q = CubicSpline(np.arange(0, sequence.n_frames, stride), q, axis=0)(np.arange(sequence.n_frames))
    dofs = kinematics.skeleton.dofs
    return np.clip(q, [d.lower for d in dofs], [d.upper for d in dofs])


def smooth_inverse_kinematics(
    kinematics: Kinematics, points: np.ndarray, fps: float, frames: np.ndarray, options: FTEOptions
) -> np.ndarray:
    """Fit q (N, Q) to marker positions (N, M, 3), m, NaN where unknown, under the motion model."""
    term = point_term(points, _POINT_SD, Loss("cauchy", {"c": 2.0}))
    problem = build_problem(kinematics, fps, frames, [term], options)
    settings = SolveOptions(max_iter=60, tolerance=1.0, acceptable_tolerance=10.0)
    minimum = minimise(problem, pose_start(kinematics, points), settings, enough=_ENOUGH)
    if minimum.status is Status.INTERRUPTED:
        raise KeyboardInterrupt  # a start that was cut off is nothing to keep
    return minimum.q


def pose_start(kinematics: Kinematics, points: np.ndarray, turn: float = 0.0) -> np.ndarray:
    """Mid-range joint angles; root position and heading from the data, (N, Q).

    ``turn`` is added to the heading, rad; the animal stays where it is.

    Per frame, the markers of the mid-range pose are turned about the vertical and moved onto the
    triangulated ones: with both centred, the angle that minimises the squared distance is
    ``atan2(Σ x y' − y x', Σ x x' + y y')`` (the planar Procrustes problem). Two rounds of reweighting
    make it robust; frames without an answer are interpolated.
    """
    skeleton = kinematics.skeleton
    middle = np.array([d.middle for d in skeleton.dofs])
    shape = kinematics.positions(middle[None])[0]  # (M, 3)
    root = _root_dofs(kinematics)
    weight = np.isfinite(points).all(-1).astype(float)
    known = np.nan_to_num(points)
    angle = np.full(len(points), np.nan)
    for _ in range(3):
        total = weight.sum(1, keepdims=True)
        usable = total[:, 0] > 0
        scale = np.maximum(total, 1e-12)[..., None]
        body = shape - (weight[..., None] * shape).sum(1, keepdims=True) / scale
        seen = known - (weight[..., None] * known).sum(1, keepdims=True) / scale
        cross = (weight * (body[..., 0] * seen[..., 1] - body[..., 1] * seen[..., 0])).sum(1)
        dot = (weight * (body[..., 0] * seen[..., 0] + body[..., 1] * seen[..., 1])).sum(1)
        strength = np.hypot(cross, dot)
        angle = np.where(usable & (strength > 1e-3), np.arctan2(cross, dot), np.nan)
        turned = _turn(body, np.nan_to_num(angle))
        distance2 = ((turned - seen) ** 2).sum(-1)
        weight = np.isfinite(points).all(-1) / (1.0 + distance2 / 0.15**2)
    angle = _fill(np.unwrap(_fill(angle))) + turn
    turned = _turn(np.broadcast_to(shape, points.shape), angle)
    offset = (weight[..., None] * (known - turned)).sum(1) / np.maximum(weight.sum(1), 1e-12)[:, None]
    offset = _fill(np.where(weight.sum(1)[:, None] > 1e-6, offset, np.nan))
    q = np.repeat(middle[None], len(points), axis=0)
    for axis, dof in enumerate(root[:3]):
        if dof is not None:
            origin = _turn(np.broadcast_to(np.zeros((1, 3)), (len(points), 1, 3)), angle)[:, 0]
            q[:, dof] += offset[:, axis] + origin[:, axis]
    if root[3] is not None:
        q[:, root[3]] += angle
    return q


def _root_dofs(kinematics: Kinematics) -> list[int | None]:
    """The root link's slides along x, y, z and its turn about the vertical."""
    skeleton = kinematics.skeleton
    found: list[int | None] = [None, None, None, None]
    for link in skeleton.links:
        if link.parent < 0:
            for j in link.dofs:
                dof = skeleton.dofs[j]
                axis = int(np.argmax(np.abs(dof.axis)))
                if dof.kind == "slide":
                    found[axis] = j
                elif axis == 2:
                    found[3] = j
            break
    return found


def _turn(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Turn points (N, M, 3) about the vertical by one angle a frame."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.stack(
        [c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1], points[..., 2]],
        axis=-1,
    )


def _fill(values: np.ndarray) -> np.ndarray:
    """Replace NaN along time by linear interpolation (constant beyond the ends)."""
    flat = values.reshape(len(values), -1).copy()
    time = np.arange(len(values))
    for column in flat.T:
        known = np.isfinite(column)
        if known.any():
            column[:] = np.interp(time, time[known], column[known])
        else:
            column[:] = 0.0
    return flat.reshape(values.shape)
