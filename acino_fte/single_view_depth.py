"""How far away an animal is that one camera sees: from its size, and from a lidar where there is one.

A link of length L that is seen under the angle α (in the normalised image) is at the depth L/α at most, and
at less where it is foreshortened: the distance of the animal is a low quantile of L/α over its links,
smoothed over the strides in which it stretches and folds. Returns of a lidar that lie on the drawn skeleton
have one depth in common up to a factor of that; the rest is background.
"""

from __future__ import annotations

import warnings

import numpy as np

from acino_fte.depth import expected_surface
from acino_fte.errors import InputError
from acino_fte.kinematics import Kinematics
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton

_QUANTILE = 0.25  # of L/α over links: those that are not foreshortened
_WINDOW = 0.25  # s: of the depth of the animal, and of the medians of its size
_ON_BODY = 0.04  # m: returns so near to the drawn skeleton are on the animal, as a rule
_ON = tuple(np.log([0.6 / 1.0, 0.35 / 30.0, 0.05 / 30.0]))  # 1/m: on it, behind it, before it
_SIZE_SD = 0.15  # how far from the species' size an animal is, and how wrong a size in the image
_DRIFT = 0.05  # per √s: how the error of the size changes while the animal turns
_TOLERANCE = 0.6  # m: half the depth of an animal and its lean
_FARTHEST = 3000.0  # m: a larger distance means detections that are all at one point
_SIZES = (0.6, 1.6)  # how far from the species' size an animal may be
_STRIDE = 0.3  # s: an animal in a gallop stretches and folds; its size is smoothed over that
_FEW = 5  # values that a line needs
_SHRINK = 0.5  # of the slope, in values of full weight


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
    rough = surface_ratio(frame, depth / size[frame], size, sequence.fps) * size
    near = np.abs(depth - rough[frame]) < _TOLERANCE
    every, width = np.arange(len(size)), _WINDOW * sequence.fps
    if near.any():
        rough += smooth_track(frame[near], (depth - rough[frame])[near], every, width)
        rough = smooth_track(every, rough, every, width / 2)  # without the steps of the path's grid
    return rough + float(np.median(expected_surface(skeleton)))


def smooth_track(place: np.ndarray, values: np.ndarray, at: np.ndarray, width: float) -> np.ndarray:
    """Values (K,) at places (K,) as a smooth curve at others (N,): robust lines through what is near.

    At every place a line is fitted with weights exp(−Δ²/2w²) and Tukey's biweight of the residuals (local
    regression: Cleveland 1979), the weight of the slope shrunk where little is near.
    """
    order = np.argsort(place, kind="stable")
    place, values = place[order], values[order]
    result = np.empty(len(at))
    first, last = np.searchsorted(place, at - 3 * width), np.searchsorted(place, at + 3 * width)
    for n, centre in enumerate(at):
        some = slice(first[n], last[n])
        if last[n] - first[n] < _FEW:  # far from everything: what is nearest
            nearest = np.argsort(np.abs(place - centre), kind="stable")[:_FEW]
            result[n] = np.median(values[nearest])
            continue
        result[n] = _line(place[some] - centre, values[some], width)
    return result


def _line(away: np.ndarray, values: np.ndarray, width: float) -> float:
    """Value at 0 of a robust line through values (K,) that lie `away` (K,)."""
    near = np.exp(-0.5 * (away / width) ** 2)
    weight = near
    height = 0.0
    for _ in range(3):
        moments = [float((weight * away**k).sum()) for k in range(3)]
        ridge = _SHRINK * width**2
        matrix = np.array([[moments[0], moments[1]], [moments[1], moments[2] + ridge]])
        height, slope = np.linalg.solve(matrix, [(weight * values).sum(), (weight * values * away).sum()])
        residual = np.abs(values - height - slope * away)
        scale = 6.0 * np.median(residual) + 1e-9
        weight = near * np.maximum(1.0 - (residual / scale) ** 2, 1e-3) ** 2
    return float(height)


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
    found = np.exp(smooth_track(np.arange(len(found)), np.log(found), np.arange(len(found)), _STRIDE * fps))
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
