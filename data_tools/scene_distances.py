"""Distances that a structure-from-motion model measures, frame by frame, as one number with its uncertainty.

The length of a noisy difference is too large on average: E|d + n| ≈ |d| + tr(P⊥ S)/(2|d|), where S is the
covariance of the noise and P⊥ takes its part across d. That is taken off. Errors of neighbouring frames are
alike, so standard errors come from means over blocks of frames where these say more. Shapes: K frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.camera_keys import KeyedCamera

_TO_SD = 1.4826  # median absolute deviation to standard deviation
_TUKEY = 4.685
_ROUNDS = 30
_TURNS = 0.02  # slow change of an offset's direction above which a pair is not rigid, rad
_VARIES = 0.01  # slow variation of a length that is worth a warning, as a share of it
_ONE_FRAME = 0.01  # relative standard deviation of what was measured in one frame only
_BLOCKS = 20
_COMMON = 0.25  # share of the key frames that have to be common, else places are interpolated
_GAP = 3.0  # median steps between key frames over which places are interpolated
_DOUBTFUL = 0.3  # noise across a difference, as a share of it, from which a frame is not used


@dataclass(frozen=True)
class MeasuredDistance:
    """A distance in units of the model.

    Attributes
    ----------
    length, sd : float
        Mean over the frames and its standard error.
    n : int
        Frames.
    spread : float
        Standard deviation of the single frames about the mean, outliers left out.
    rigid : bool
        Whether the second end kept its place in the first end's frame; False where that is not known.
    notes : tuple of str
        Warnings.
    """

    length: float
    sd: float
    n: int
    spread: float
    rigid: bool = False
    notes: tuple[str, ...] = ()


def between_cameras(first: KeyedCamera, second: KeyedCamera) -> MeasuredDistance:
    """The distance between the centres of two cameras, from the key frames that both have.

    For a rigid pair it is the length of the mean offset in the first camera's frame, which noise in any
    direction hardly lengthens; else the mean length of the difference, less what the noise adds when it is
    the same in all directions. When few key frames are common, the second camera is interpolated between
    its key frames; a camera with one key frame counts as fixed.

    Raises
    ------
    InputError
        No frame has both, or they are in one place.
    """
    names = f"{first.name}–{second.name}"
    offset, notes = _offsets(first, second, names)
    length = np.linalg.norm(offset, axis=1)
    if not np.median(length) > 0:
        raise InputError(f"The cameras {names} are in one place.", expected="a distance above 0", found="0")
    if len(offset) == 1:
        return _one_frame(first, second, float(length[0]), names, notes)
    rigid, middle = _rigid(offset)
    if rigid:
        found, series, weight = _length_of_mean(offset, middle)
    else:
        series = length
        centre, weight = robust_mean(length[:, None])
        found = float(centre[0])
        found -= min(_fast_variance(length), float(np.average((length - found) ** 2, weights=weight))) / found
    sd, spread = _standard_error(series, weight)
    warned = _varying(length, weight, names)
    return MeasuredDistance(found, sd, len(offset), spread, rigid and not warned, (*notes, *warned))


def between_places(first: KeyedCamera, frame: int, second: KeyedCamera, other: int) -> MeasuredDistance:
    """The distance between where a camera was in one key frame and where one was in another.

    Its error comes from the covariances of the poses; without these from how rough the camera's path is, or
    is a guess (1 %).

    Raises
    ------
    InputError
        A frame is no key frame of its camera.
    """
    place, variance = [], []
    for camera, at in ((first, frame), (second, other)):
        row = int(np.argmin(np.abs(camera.frame - at)))
        if camera.frame[row] != at:
            raise InputError(
                f"Camera '{camera.name}' has no key frame {at}.",
                expected=f"one of its {len(camera.frame)} key frames",
                found=f"the nearest is {camera.frame[row]}",
            )
        place.append(camera.centre[row])
        rough = [_fast_variance(axis) for axis in camera.centre.T]
        variance.append(np.mean(rough) if camera.covariance is None else camera.covariance[row, 3:, 3:])
    step = place[1] - place[0]
    length = float(np.linalg.norm(step))
    if not length > 0:
        raise InputError(
            "The two places of a known distance are one.", expected="a distance above 0", found="0"
        )
    unit = step / length
    sd = float(
        np.sqrt(sum(unit @ (one * np.eye(3) if np.ndim(one) == 0 else one) @ unit for one in variance))
    )
    notes: tuple[str, ...] = ()
    if not (np.isfinite(sd) and sd > 0):
        sd = _ONE_FRAME * length
        notes = (f"The error of the distance {first.name}@{frame}–{second.name}@{other} is a guess (1 %).",)
    return MeasuredDistance(length, sd, 1, 0.0, False, notes)


def between_points(
    first: np.ndarray, second: np.ndarray, covariance: np.ndarray, names: str = "two points"
) -> MeasuredDistance:
    """The distance between two moving points.

    Each frame counts by the inverse of its variance along the difference, as the frames beside it point (a
    weight that hangs on a frame's own noise would shorten the mean), plus that of the true length
    where the lengths scatter more than their covariances say (an animal's body is not rigid). What the noise
    adds to each length is taken off; frames of which the noise across is above 0.3 of the length are not
    used while others are there.

    Parameters
    ----------
    first, second : (K, 3)
        In order of time; rows with NaN are left out.
    covariance : (K, 3, 3)
        Of the difference.
    names : str
        For messages.

    Raises
    ------
    InputError
        No frame has both points, or they are in one place.
    """
    step = np.asarray(second, dtype=float) - first
    there = np.isfinite(step).all(-1) & np.isfinite(covariance).all((-2, -1))
    step, covariance = step[there], np.asarray(covariance)[there]
    raw = np.linalg.norm(step, axis=1)
    if not (len(raw) and np.median(raw) > 0):
        raise InputError(
            f"The distance {names} cannot be measured.",
            expected="frames that have both, in two places",
            found=f"{len(raw)} frames with both",
        )
    ok = raw > 0
    step, covariance, raw = step[ok], covariance[ok], raw[ok]
    unit = step / raw[:, None]
    variance = np.einsum("ki,kij,kj->k", unit, covariance, unit)
    across = np.trace(covariance, axis1=1, axis2=2) - variance
    variance = _variance_by_neighbours(step, covariance)
    sure = across < (_DOUBTFUL * np.median(raw)) ** 2
    if not sure.any():
        sure[:] = True
    variance, length = variance[sure], raw[sure] - np.minimum(across / (2 * raw), 0.5 * raw)[sure]
    weight = np.zeros(len(length))
    mean, own = float(np.median(length)), 0.0
    for _ in range(_ROUNDS):
        total = variance + own + 1e-30 * mean**2
        weight = _tukey(np.abs(length - mean) / np.sqrt(total)) / total
        if not weight.any():
            weight = 1 / total
        mean = float(np.average(length, weights=weight))
        own = max(0.0, _spread(length - mean) ** 2 - float(np.median(variance)))
    sd, spread = _standard_error(length, weight)
    notes: list[str] = []
    if len(length) == 1:
        sd = float(np.sqrt(variance[0])) or _ONE_FRAME * mean
    if own > (0.05 * mean) ** 2:
        notes.append(
            f"The distance {names} varies by {100 * spread / mean:.0f} % (standard deviation) about its "
            "mean: the scale is that of the mean."
        )
    return MeasuredDistance(mean, sd, len(length), spread, False, tuple(notes))


def _variance_by_neighbours(step: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Variance (K,) of lengths along the mean direction of the frame before and the frame after.

    To the second order: with the doubt about that direction, and the variance of n⊥²/(2L).
    """
    size = float(np.median(np.linalg.norm(step, axis=1)))
    around = np.concatenate([step[1:2], step, step[-2:-1]]) if len(step) > 1 else np.repeat(step, 3, axis=0)
    unit = around[:-2] + around[2:]
    norm = np.linalg.norm(unit, axis=1, keepdims=True)
    unit = unit / np.where(norm > 0, norm, 1.0)
    part = covariance - np.einsum("kij,kj,kl->kil", covariance, unit, unit)  # S P⊥
    doubt = np.einsum("kij,kji->k", part, part) / size**2
    return np.einsum("ki,kij,kj->k", unit, covariance, unit) + 1.5 * doubt


def robust_mean(values: np.ndarray, rounds: int = _ROUNDS) -> tuple[np.ndarray, np.ndarray]:
    """The mean (D,) of values (K, D) without outliers, and the weights (K,) in 0–1: Tukey's biweight.

    It starts at the medians; distances are in robust standard deviations of the distance. It turns and
    scales with the values, to rounding.
    """
    weight = np.ones(len(values))
    centre = geometric_median(values)
    for _ in range(rounds):
        distance = np.linalg.norm(values - centre, axis=1)
        scale = float(np.median(distance)) * (_TO_SD if values.shape[1] == 1 else 1.0)
        if not scale > 1e-14 * float(np.linalg.norm(centre)):
            break
        weight = _tukey(distance / scale)
        new = np.average(values, axis=0, weights=weight)
        moved = float(np.linalg.norm(new - centre))
        centre = new
        if moved < 1e-13 * scale:
            break
    return centre, weight


def geometric_median(values: np.ndarray, rounds: int = 60) -> np.ndarray:
    """The point (D,) of the least sum of distances to values (K, D): Weiszfeld (1937)."""
    if values.shape[1] == 1:
        return np.median(values, axis=0)
    centre = values.mean(axis=0)
    floor = 1e-6 * float(np.sqrt(((values - centre) ** 2).sum(1).mean()))
    if not floor > 0:
        return centre
    for _ in range(rounds):
        weight = 1 / np.maximum(np.linalg.norm(values - centre, axis=1), floor)
        centre = np.average(values, axis=0, weights=weight)
    return centre


def _offsets(first: KeyedCamera, second: KeyedCamera, names: str) -> tuple[np.ndarray, list[str]]:
    """Offsets (K, 3) from the first to the second camera in the first camera's frame."""
    _, here, there = np.intersect1d(first.frame, second.frame, assume_unique=True, return_indices=True)
    if len(here) >= _COMMON * min(len(first.frame), len(second.frame)):
        step = second.centre[there] - first.centre[here]
        return np.einsum("kij,kj->ki", first.rotation[here], step), []
    if len(first.frame) == 1:  # a fixed camera
        return (second.centre - first.centre[0]) @ first.rotation[0].T, []
    if len(second.frame) == 1:
        return np.einsum("kij,kj->ki", first.rotation, second.centre - first.centre), []
    rows, place = _between_keys(second, first.frame)
    if not len(rows):
        raise InputError(
            f"The distance between the cameras {names} cannot be measured.",
            expected="key frames of both at the same time",
            found=f"frames {first.frame[0]}–{first.frame[-1]} and {second.frame[0]}–{second.frame[-1]}",
            remedy="name a distance between cameras that recorded together",
        )
    note = f"The cameras {names} share few key frames or none: places between key frames are interpolated."
    return np.einsum("kij,kj->ki", first.rotation[rows], place - first.centre[rows]), [note]


def _between_keys(camera: KeyedCamera, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of some frames (K,) lie between key frames that are no gap apart, and the centres there."""
    from scipy.interpolate import CubicSpline

    after = np.clip(np.searchsorted(camera.frame, frame), 1, len(camera.frame) - 1)
    step = np.diff(camera.frame)
    inside = (frame >= camera.frame[0]) & (frame <= camera.frame[-1])
    rows = np.flatnonzero(inside & (step[after - 1] <= _GAP * np.median(step)))
    if len(camera.frame) > 3:
        return rows, CubicSpline(camera.frame, camera.centre)(frame[rows])
    return rows, np.stack([np.interp(frame[rows], camera.frame, axis) for axis in camera.centre.T], axis=-1)


def _one_frame(
    first: KeyedCamera, second: KeyedCamera, length: float, names: str, notes: list[str]
) -> MeasuredDistance:
    """What one frame says; its error comes from the covariances of the poses, or is a guess."""
    sd = 0.0
    if first.covariance is not None and second.covariance is not None:
        here = int(np.flatnonzero(np.isin(first.frame, second.frame))[0]) if len(first.frame) > 1 else 0
        there = int(np.flatnonzero(second.frame == first.frame[here])[0]) if len(second.frame) > 1 else 0
        unit = (second.centre[there] - first.centre[here]) / length
        noise = first.covariance[here, 3:, 3:] + second.covariance[there, 3:, 3:]
        sd = float(np.sqrt(unit @ noise @ unit))
    if not sd > 0:
        sd = _ONE_FRAME * length
        notes = [*notes, f"The distance {names} was measured in one frame: its error is a guess (1 %)."]
    return MeasuredDistance(length, sd, 1, 0.0, False, tuple(notes))


def _rigid(offset: np.ndarray) -> tuple[bool, np.ndarray]:
    """Whether the offsets (K, 3) scatter like noise and do not wander, and their robust mean."""
    middle = robust_mean(offset)[0]
    from_middle = np.linalg.norm(offset - middle, axis=1)
    fast = np.linalg.norm(np.diff(offset, axis=0), axis=1)
    slow = float(np.median(from_middle)) ** 2 - float(np.median(fast)) ** 2 / 2
    size = float(np.linalg.norm(middle))
    return bool(size > 0 and slow < (_TURNS * size) ** 2 and np.median(from_middle) < 0.3 * size), middle


def _length_of_mean(offset: np.ndarray, middle: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Length of the robust mean offset, less its bias; the offsets' parts along it (K,); weights (K,)."""
    unit = middle / np.linalg.norm(middle)
    along = offset @ unit
    across = offset - along[:, None] * unit
    weight = robust_mean(along[:, None])[1] * robust_mean(across)[1]
    if not weight.any():
        weight = np.ones(len(offset))
    length = float(np.linalg.norm(np.average(offset, axis=0, weights=weight)))
    across = across - np.average(across, axis=0, weights=weight)
    square = float(np.average((across**2).sum(1), weights=weight))
    share = float((weight**2).sum() / weight.sum() ** 2)  # variance of the mean over that of one
    return length - square * share / (2 * length), along, weight


def _tukey(z: np.ndarray) -> np.ndarray:
    return np.where(z < _TUKEY, (1 - (z / _TUKEY) ** 2) ** 2, 0.0)


def _spread(residual: np.ndarray) -> float:
    return _TO_SD * float(np.median(np.abs(residual)))


def _fast_variance(series: np.ndarray) -> float:
    """Variance of what changes from each frame to the next, from second differences."""
    if len(series) < 5:
        return np.inf
    return _spread(np.diff(series, 2)) ** 2 / 6


def _standard_error(series: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Standard error of the weighted mean of a series (K,) in order of time, and the spread of one value.

    The greater of that for independent values and that of the means of blocks (batch means).
    """
    mean = float(np.average(series, weights=weight))
    inner = weight > 0
    spread = float(np.sqrt(((series[inner] - mean) ** 2).mean()))
    if inner.sum() < 2:
        return 0.0, spread
    white = np.sqrt((weight**2 * (series - mean) ** 2).sum()) / weight.sum()
    n_blocks = min(_BLOCKS, int(inner.sum()) // 8)
    if n_blocks < 4:
        return float(white * np.sqrt(inner.sum() / (inner.sum() - 1))), spread
    parts = np.array_split(np.flatnonzero(inner), n_blocks)
    of_block = np.array([(weight[part] * (series[part] - mean)).sum() for part in parts])
    batch = np.sqrt((of_block**2).sum() * n_blocks / (n_blocks - 1)) / weight.sum()
    return float(max(white, batch)), spread


def _varying(length: np.ndarray, weight: np.ndarray, names: str) -> list[str]:
    """A warning when a distance that should be constant is not: its slow part is more than noise."""
    inner = weight > 0
    inside = length if inner.mean() < 0.8 else length[inner]
    mean = float(np.mean(inside))
    total, fast = float(np.var(inside)), float(np.mean(np.diff(inside) ** 2)) / 2 if len(inside) > 1 else 0.0
    slow = np.sqrt(max(total - fast, 0.0))
    ratio = fast / total if total > 0 else 1.0  # von Neumann's ratio, 1 for noise, with variance 1/K
    wandering = len(inside) >= 8 and ratio < 1 - 3 / np.sqrt(len(inside)) and slow > _VARIES * mean
    if not wandering and np.sqrt(total) < 0.1 * mean:
        return []
    return [
        f"The distance between the cameras {names} is not constant: it varies by "
        f"{100 * np.sqrt(total) / mean:.2g} % (standard deviation). The scale is that of its mean."
    ]
