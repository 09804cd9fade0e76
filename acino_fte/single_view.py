"""A start from one view: the animal's depth, and its heading tried several ways.

Detections at the depth of the animal (:mod:`acino_fte.single_view_depth`), which are the thesis's
back-projected pseudo-RGB-D, give position and heading. An image alone does not tell an animal that turns a
little towards the camera from one that turns away, and hardly one from its mirror image: each heading is
fitted on a part of the frames, and the best is kept.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from acino_fte.association import associate
from acino_fte.cameras import Camera
from acino_fte.condensed_solve import minimise
from acino_fte.depth import DepthData, MarkerDepths, depth_terms, expected_surface
from acino_fte.initialise import pose_start
from acino_fte.kinematics import Kinematics
from acino_fte.losses import Loss
from acino_fte.parameters import Parameters
from acino_fte.problem import FTEOptions, FTEProblem, build_problem
from acino_fte.result import Status
from acino_fte.sequence import Sequence
from acino_fte.single_view_depth import animal_depth
from acino_fte.solve import Minimum, SolveOptions
from acino_fte.terms import measurement_term

TURNS = (0.0, 0.5, -0.5, np.pi)
"""Headings that are tried, rad from the one that the flat image suggests."""
_SPREAD = 0.06  # m, of detections about the skeleton in the start
_FLAT_SD = 1.0  # m, of the depth of a marker that is only known to belong to the animal
_START_SD = 0.5  # m, of the depth of a skeleton that returns are associated to
_MOST = 40  # frames in a start
_ENOUGH = 3e-3  # relative decrease of the objective per iteration below which the start is good enough
_LOOK, _ITERATIONS = 4, 12  # Newton steps before headings are compared, and all: a right one needs six
_BEHIND = 1.2  # a heading whose objective is so many times the least after the look is given up


def single_view_trajectory(sequence: Sequence, kinematics: Kinematics, options: FTEOptions) -> np.ndarray:
    """Degrees of freedom to start from, (N, Q), of a sequence with one camera.

    Raises
    ------
    InputError
        No frame has two markers that a link joins.
    """
    stride = max(1, -(-sequence.n_frames // _MOST)) if sequence.n_frames > 8 else 1
    stride = min(stride, 4)
    part = _thinned(sequence, stride)
    pixels = part.pixels(kinematics.skeleton.marker_names, options.likelihood)[:, 0]
    camera = part.cameras[0]
    depth = animal_depth(part, kinematics, pixels)
    points = camera.back_project(np.nan_to_num(pixels), depth[:, None])
    points = np.where(np.isfinite(pixels).all(-1)[..., None], points, np.nan)
    q = _best_heading(
        [
            (_problem(part, kinematics, options, pixels, depth, start), start)
            for start in (pose_start(kinematics, points, turn) for turn in TURNS)
        ]
    )
    if stride > 1:
        q = CubicSpline(np.arange(0, sequence.n_frames, stride), q, axis=0)(np.arange(sequence.n_frames))
    dofs = kinematics.skeleton.dofs
    return np.clip(q, [d.lower for d in dofs], [d.upper for d in dofs])


def _best_heading(starts: list[tuple[FTEProblem, np.ndarray]]) -> np.ndarray:
    """The best of the fits (N, Q) from several headings; those that fall behind are not finished."""
    first = [_fit(problem, start, _LOOK) for problem, start in starts]
    limit = _BEHIND * min(found.objective for found in first)
    better = [
        _fit(problem, found.q, _ITERATIONS - _LOOK)
        for (problem, _), found in zip(starts, first, strict=True)
        if found.objective <= limit
    ]
    return min(better, key=lambda found: found.objective).q


def _thinned(sequence: Sequence, stride: int) -> Sequence:
    """Every so-many-th frame, as a sequence of a lower frame rate."""
    if stride == 1:
        return sequence
    some = slice(None, None, stride)
    frames = sequence.detections.isel(frame=some)
    numbered = frames.assign_coords(frame=np.arange(frames.sizes["frame"]))
    lidar = sequence.lidar
    if lidar is not None:
        lidar = replace(lidar, time=lidar.time - float(sequence.frames[0]) / sequence.fps)
    return replace(
        sequence,
        detections=numbered,
        cameras=sequence.cameras.at_frames(some),
        fps=sequence.fps / stride,
        lidar=lidar,
        truth=None,
    )


def _problem(
    sequence: Sequence,
    kinematics: Kinematics,
    options: FTEOptions,
    pixels: np.ndarray,
    depth: np.ndarray,
    start: np.ndarray,
) -> FTEProblem:
    """The problem of a rough fit of image and depth; returns are associated at a start (N, Q)."""
    camera, skeleton = sequence.cameras[0], kinematics.skeleton
    focal = float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
    spread = np.full(len(skeleton.markers), _SPREAD * focal / float(np.median(depth)))
    term = measurement_term(camera, pixels, spread, Loss("cauchy", {"c": 2.0}), sequence.n_frames)
    assert term is not None
    terms = [term, *_depth_terms(sequence, kinematics, camera, pixels, depth, start)]
    return build_problem(kinematics, sequence.fps, sequence.frames, terms, options)


def _fit(problem: FTEProblem, start: np.ndarray, iterations: int) -> Minimum:
    """A rough fit from a start (N, Q)."""
    settings = SolveOptions(max_iter=iterations, tolerance=1.0, acceptable_tolerance=10.0)
    found = minimise(problem, start, settings, enough=_ENOUGH)
    if found.status is Status.INTERRUPTED:
        raise KeyboardInterrupt  # a start that was cut off is nothing to keep
    return found


def _depth_terms(
    sequence: Sequence,
    kinematics: Kinematics,
    camera: Camera,
    pixels: np.ndarray,
    depth: np.ndarray,
    start: np.ndarray,
) -> list:
    """What is known of the depth: that of the animal, and of markers with returns about them."""
    frame, marker = np.nonzero(np.isfinite(pixels).all(-1))
    sd = np.full(len(frame), _FLAT_SD)
    flat = MarkerDepths(frame, marker, depth[frame], sd, np.ones(len(frame), dtype=int))
    if sequence.lidar is None:
        return []
    surface = expected_surface(kinematics.skeleton)
    found = associate(sequence, kinematics.skeleton, kinematics.positions(start), surface, front_sd=_START_SD)
    data = [DepthData(camera.name, flat, surface=False, loss=Loss("squared"))]
    terms = depth_terms(data[0], camera, sequence.n_frames, Parameters())
    if found is not None and isinstance(found.measured, MarkerDepths) and len(found.measured):
        near = found.measured
        moved = replace(near, depth=near.depth + surface[near.marker], sd=np.hypot(near.sd, _SPREAD))
        terms += depth_terms(
            DepthData(camera.name, moved, surface=False, loss=Loss("cauchy", {"c": 2.0})),
            camera,
            sequence.n_frames,
            Parameters(),
        )
    return terms
