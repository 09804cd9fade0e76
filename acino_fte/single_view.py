"""A start from one view: depth from the size of the animal or from a lidar, heading tried several ways.

A link of length L that is seen under the angle α (in the normalised image) is at the depth L/α at most, and
at less where it is foreshortened: the distance of the animal is a low quantile of L/α over its links. Returns
of a lidar that lie on the drawn skeleton have one depth in common up to a factor of that; the rest is
background. Detections at that depth (the thesis's back-projected pseudo-RGB-D) give position and heading. An
image alone does not tell an animal that turns a little towards the camera from one that turns away, and
hardly one from its mirror image: each heading is fitted on a part of the frames, and the best is kept.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from acino_fte.association import associate
from acino_fte.cameras import Camera
from acino_fte.condensed_solve import minimise
from acino_fte.depth import DepthData, MarkerDepths, depth_terms, expected_surface
from acino_fte.errors import InputError
from acino_fte.initialise import pose_start
from acino_fte.kinematics import Kinematics
from acino_fte.losses import Loss
from acino_fte.parameters import Parameters
from acino_fte.problem import FTEOptions, FTEProblem, build_problem
from acino_fte.result import Status
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton
from acino_fte.solve import Minimum, SolveOptions
from acino_fte.terms import measurement_term

TURNS = (0.0, 0.5, -0.5, np.pi)
"""Headings that are tried, rad from the one that the flat image suggests."""
_QUANTILE = 0.25  # of L/α over links: those that are not foreshortened
_WINDOW = 0.25  # s: the depth of the animal is a median over this to either side
_SPREAD = 0.06  # m, of detections about the skeleton in the start
_FLAT_SD = 0.5  # m, of the depth of a marker that is only known to belong to the animal
_MOST = 40  # frames in a start
_ON_BODY = 0.04  # m: returns so near to the drawn skeleton are on the animal, as a rule
_ON = tuple(np.log([0.6 / 1.0, 0.35 / 30.0, 0.05 / 30.0]))  # 1/m: on it, behind it, before it
_SIZE_SD = 0.15  # how far from the species' size an animal is, and how wrong a size in the image
_DRIFT = 0.05  # per √s: how the error of the size changes while the animal turns
_TOLERANCE = 0.6  # m: half the depth of an animal and its lean
_ENOUGH = 3e-3  # relative decrease of the objective per iteration below which the start is good enough
_LOOK, _ITERATIONS = (
    4,
    12,
)  # Newton steps before headings are compared, and all: a right one is there after six
_BEHIND = 1.2  # a heading whose objective is so many times the least after the look is given up
_FARTHEST = 3000.0  # m: a larger distance means detections that are all at one point
_SIZES = (0.6, 1.6)  # how far from the species' size an animal may be


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


def animal_depth(sequence: Sequence, kinematics: Kinematics, pixels: np.ndarray) -> np.ndarray:
    """Depth of the animal in the first camera (N,), m, from its size and from the lidar where there is one.

    ``pixels`` (N, M, 2) are detections, NaN where missing.
    """
    camera, skeleton = sequence.cameras[0], kinematics.skeleton
    flat = camera.undistort(pixels)
    size = depth_from_size(kinematics, flat, sequence.fps)
    if sequence.lidar is None:
        return size
    frame, depth = _returns_on_skeleton(sequence, skeleton, flat, size)
    if not len(frame):
        return size
    ratio = surface_ratio(frame, depth / size[frame], size, sequence.fps)
    near = np.abs(depth - (ratio * size)[frame]) < _TOLERANCE
    if near.any():
        ratio = _running_median(frame[near], depth[near] / size[frame[near]], len(size), sequence.fps)
    return ratio * size + float(np.median(expected_surface(skeleton)))


def surface_ratio(frame: np.ndarray, ratio: np.ndarray, size: np.ndarray, fps: float) -> np.ndarray:
    """What the animal's depth is to the depth that its size suggests (N,), by dynamic programming.

    Returns on the drawn skeleton (``frame`` (K,), ``ratio`` (K,) of their depth to ``size`` (N,), m) are on
    the animal, or behind it where they have missed a limb, and seldom before it. On a grid of ratios, the
    log-likelihood of the returns about every frame, a broad prior on the size and a slow change from frame to
    frame are added up, and the best path is kept (Viterbi 1967).
    """
    step = 0.5 * _TOLERANCE / float(np.median(size))
    grid = np.arange(*_SIZES, step)
    width = _TOLERANCE / size
    reach = max(1.0, _WINDOW * fps)
    score = np.empty((len(size), len(grid)))
    order = np.argsort(frame, kind="stable")
    frame, ratio = frame[order], ratio[order]
    for n in range(len(size)):
        first, last = np.searchsorted(frame, [n - reach, n + reach])
        values = np.sort(ratio[first:last])
        lower, upper = np.searchsorted(values, grid - width[n]), np.searchsorted(values, grid + width[n])
        within, behind, before = upper - lower, len(values) - upper, lower
        score[n] = within * _ON[0] + behind * _ON[1] + before * _ON[2]
    score /= max(1.0, 2 * reach)  # a return counts in every window that it lies in, and once in all
    score -= 0.5 * (np.log(grid) / _SIZE_SD) ** 2 / len(size)
    change = np.minimum(0.5 * ((grid[:, None] - grid) / (_DRIFT / np.sqrt(fps))) ** 2, 50.0)
    return grid[_best_path(score, change)]


def _best_path(score: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Cells (N,) of the path with the most Σ score (N, G) − Σ change (G, G)."""
    total, origin = score[0], np.zeros(score.shape, dtype=int)
    for n in range(1, len(score)):
        reached = total[:, None] - change
        origin[n] = reached.argmax(axis=0)
        total = reached.max(axis=0) + score[n]
    path = np.empty(len(score), dtype=int)
    path[-1] = total.argmax()
    for n in range(len(score) - 1, 0, -1):
        path[n - 1] = origin[n, path[n]]
    return path


def depth_from_size(kinematics: Kinematics, flat: np.ndarray, fps: float) -> np.ndarray:
    """Depth (N,), m, of an animal of the species' size; ``flat`` (N, M, 2) are normalised image points.

    Raises
    ------
    InputError
        No frame shows both ends of a link.
    """
    skeleton = kinematics.skeleton
    links, lengths = _rigid_links(kinematics)
    seen = np.linalg.norm(flat[:, links[:, 0]] - flat[:, links[:, 1]], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(seen > 0, lengths / seen, np.nan)
    frame, link = np.nonzero(np.isfinite(depth))
    if not len(frame):
        raise InputError(
            "No frame shows both ends of a link: one camera cannot tell how far away the animal is.",
            key="keypoints",
            expected=f"markers of '{skeleton.name}' that a link joins, in the same frame",
            remedy="lower --likelihood, or choose frames in which more of the animal is detected",
        )
    found = _running_median(frame, depth[frame, link], len(flat), fps, _QUANTILE)
    if np.median(found) > _FARTHEST:
        raise InputError(
            "The animal is too small in the image to say anything of it.",
            key="keypoints",
            expected=f"a '{skeleton.name}' within {_FARTHEST:.0f} m of the camera",
            found=f"one as small as at {np.median(found):.3g} m",
            remedy="check that the detections are in pixels, and not all at one point",
        )
    return found


def _rigid_links(kinematics: Kinematics) -> tuple[np.ndarray, np.ndarray]:
    """Marker pairs (E, 2) whose distance no joint changes, and their lengths (E,), m."""
    skeleton = kinematics.skeleton
    rng = np.random.default_rng(0)
    lower = np.array([d.lower if np.isfinite(d.lower + d.upper) else -1.0 for d in skeleton.dofs])
    upper = np.array([d.upper if np.isfinite(d.lower + d.upper) else 1.0 for d in skeleton.dofs])
    points = kinematics.positions(rng.uniform(lower, upper, (6, len(lower))))
    a, b = np.triu_indices(points.shape[1], 1)
    lengths = np.linalg.norm(points[:, a] - points[:, b], axis=-1)
    mean = lengths.mean(axis=0)
    rigid = (np.ptp(lengths, axis=0) < 1e-9) & (mean > 0.25 * np.median(mean[mean > 0]))
    return np.stack([a, b], axis=1)[rigid], mean[rigid]


def _returns_on_skeleton(
    sequence: Sequence, skeleton: Skeleton, flat: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Frames (K,) and depths (K,), m, of returns on links, in the image, whose both ends are detected."""
    lidar = sequence.lidar
    assert lidar is not None
    place = lidar.time * sequence.fps - sequence.frames[0]
    local = lidar.to_camera()
    keep = (place >= -0.5) & (place < len(flat) - 0.5) & (local[:, 2] > 0)
    frame, local = np.clip(np.rint(place[keep]).astype(int), 0, len(flat) - 1), local[keep]
    likely = (local[:, 2] > _SIZES[0] * size[frame]) & (local[:, 2] < _SIZES[1] * size[frame])
    frame, local = frame[likely], local[likely]
    seen = local[:, :2] / local[:, 2:]
    margin = (_ON_BODY / size)[:, None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames without any detection
        lower, upper = np.nanmin(flat, axis=1) - margin, np.nanmax(flat, axis=1) + margin
    boxed = ((seen >= lower[frame]) & (seen <= upper[frame])).all(-1)
    frame, local, seen = frame[boxed], local[boxed], seen[boxed]
    links = np.array(skeleton.edges).reshape(-1, 2)
    nearest = np.full(len(frame), np.inf)
    for a, b in links:
        start, end = flat[frame, a], flat[frame, b]
        way = end - start
        with np.errstate(invalid="ignore", divide="ignore"):
            u = np.clip(((seen - start) * way).sum(-1) / (way**2).sum(-1), 0.0, 1.0)
        gap = np.linalg.norm(seen - start - u[:, None] * way, axis=-1) * size[frame]
        nearest = np.fmin(nearest, gap)
    on_body = nearest < _ON_BODY
    return frame[on_body], local[on_body, 2]


def _running_median(
    frame: np.ndarray, values: np.ndarray, n_frames: int, fps: float, quantile: float = 0.5
) -> np.ndarray:
    """A quantile of the values about every frame (n_frames,); frames without any are interpolated."""
    order = np.argsort(frame, kind="stable")
    frame, values = frame[order], values[order]
    reach = max(1.0, _WINDOW * fps)
    result = np.full(n_frames, np.nan)
    every = np.arange(n_frames)
    first, last = np.searchsorted(frame, every - reach), np.searchsorted(frame, every + reach, side="right")
    for n in every[last > first]:
        result[n] = np.quantile(values[first[n] : last[n]], quantile)
    known = np.isfinite(result)
    return np.interp(every, every[known], result[known])


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
    found = associate(sequence, kinematics.skeleton, kinematics.positions(start), surface, front_sd=_FLAT_SD)
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
