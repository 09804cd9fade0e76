"""Rays of moving cameras to individuals over time, and how far two of them miss each other.

Two rays (centres c_a, c_b; unit directions u_a, u_b) meet when b · (u_a × u_b) = 0 with b = c_b − c_a. That
triple product over |b| is the residual. Its variance is σ_a² |b × u_b|²/b² + σ_b² |b × u_a|²/b² to the first
order, σ being the noise of a direction per axis. Between two frames the ray of a camera is interpolated; its
rate of change is the slope over six frames around, whose noise is independent of that of the interpolated
ray half way between two frames, and nearly so elsewhere (the plain difference would pull estimates of time
to the middle between frames). Shapes: C cameras, P dots of a camera, S samples of a pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from acino_fte.cameras import Camera
    from acino_fte.data_tools.camera_paths import CameraPath
    from acino_fte.data_tools.tracks2d import Tracks2D

WINDOW = np.array([-2, -1, 0, 1, 2, 3])
_SLOPE = (WINDOW - 0.5) / ((WINDOW - 0.5) ** 2).sum()
_BROKEN = 5.0  # times the usual distance to the line over six frames, beyond which a dot is another's
SLOPE_VARIANCE = float((_SLOPE**2).sum())
"""Variance of the slope over six frames, for unit variance of one."""


@dataclass(frozen=True, eq=False)
class TimedRays:
    """The rays of one camera to all individuals, by the camera's own frames.

    Attributes
    ----------
    individual, frame : (P,) int
    centre, direction : (P, 3)
        World; directions of unit length.
    sd : float
        Noise of a direction for one pixel, rad.
    table : (individuals, frames) int
        Row of each individual and frame from `first` on, −1 where there is none.
    first : int
    slope : (P, 6)
        Of centre and direction per frame, half a frame later; NaN where a frame around is missing or wrong.
    """

    individual: np.ndarray
    frame: np.ndarray
    centre: np.ndarray
    direction: np.ndarray
    sd: float
    table: np.ndarray
    first: int
    slope: np.ndarray

    def row(self, individual: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Rows of individuals in frames, −1 where there is none; the two broadcast."""
        place = frame - self.first
        inside = (place >= 0) & (place < self.table.shape[1])
        return np.where(inside, self.table[individual, np.where(inside, place, 0)], -1)


def timed_rays(
    paths: Sequence[CameraPath], tracks: Sequence[Tracks2D], lenses: Sequence[Camera]
) -> tuple[TimedRays, ...]:
    """The rays of all cameras to the individuals that two cameras or more name alike.

    Dots that share frame and individual with another dot of the camera say nothing and are left out, as are
    those without a known pose.
    """
    labels = [label for view in tracks for label in dict.fromkeys(view.labels)]
    shared = sorted({label for label in labels if labels.count(label) > 1})
    return tuple(
        _rays(path, view, lens, shared) for path, view, lens in zip(paths, tracks, lenses, strict=True)
    )


def _rays(path: CameraPath, view: Tracks2D, lens: Camera, shared: Sequence[str]) -> TimedRays:
    place = {label: i for i, label in enumerate(shared)}
    of_track = np.array([*(place.get(label, -1) for label in view.labels), -1], dtype=int)
    individual = of_track[view.track] if len(view) else np.zeros(0, int)
    pose = view.frame - path.frame[0]
    inside = (pose >= 0) & (pose < len(path.frame))
    good = inside & path.known[np.where(inside, pose, 0)] & (individual >= 0) & (view.track >= 0)
    normalised = np.full((len(view), 2), np.nan)
    normalised[good] = lens.undistort(view.xy[good])
    rows = np.flatnonzero(np.isfinite(normalised).all(-1))
    first = int(view.frame[rows].min()) if len(rows) else 0
    width = int(view.frame[rows].max()) - first + 1 if len(rows) else 1
    key = individual[rows] * width + view.frame[rows] - first
    _, one, count = np.unique(key, return_index=True, return_counts=True)
    rows = rows[one[count == 1]]
    local = np.concatenate([normalised[rows], np.ones((len(rows), 1))], axis=1)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    direction = np.einsum("kji,kj->ki", path.rotation[pose[rows]], local)
    centre = path.centre[pose[rows]]
    table = np.full((max(len(shared), 1), width), -1)
    table[individual[rows], view.frame[rows] - first] = np.arange(len(rows))
    slope = _slopes(table, individual[rows], view.frame[rows] - first, np.concatenate([centre, direction], 1))
    sd = 1.0 / float(lens.matrix[0, 0])
    return TimedRays(individual[rows], view.frame[rows], centre, direction, sd, table, first, slope)


def _slopes(table: np.ndarray, individual: np.ndarray, place: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Slope (P, 6) per frame at half a frame after each dot; none where a dot is off the line by far."""
    wide = np.pad(table, ((0, 0), (2, 3)), constant_values=-1)
    rows = np.stack([wide[individual, place + step + 2] for step in WINDOW], axis=-1)  # (P, 6)
    whole = np.flatnonzero((rows >= 0).all(-1))
    out = np.full_like(values, np.nan)
    around = values[rows[whole]]  # (·, 6 frames, 6)
    slope = np.einsum("f,pfd->pd", _SLOPE, around)
    off = around - around.mean(1, keepdims=True) - (WINDOW - 0.5)[:, None] * slope[:, None]
    size = np.sqrt((off[..., 3:] ** 2).sum((1, 2)))
    straight = size <= _BROKEN * np.median(size) if len(size) else np.zeros(0, bool)
    out[whole[straight]] = slope[straight]
    return out


def misses(a: TimedRays, b: TimedRays, rows_a: np.ndarray, rows_b: np.ndarray) -> np.ndarray:
    """How far rays miss each other, in standard deviations for one pixel of noise; any common shape."""
    step = b.centre[rows_b] - a.centre[rows_a]
    residual, variance = _miss(step, a.direction[rows_a], b.direction[rows_b], a.sd, b.sd)[:2]
    return residual / np.sqrt(variance)


def _miss(
    step: np.ndarray, u: np.ndarray, v: np.ndarray, sd_u: float, sd_v: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residual, its variance, and the part of the variance from the second ray."""
    length = np.sqrt(np.einsum("...i,...i->...", step, step))
    unit = step / np.where(length > 0, length, 1.0)[..., None]
    along_u, along_v = np.einsum("...i,...i->...", unit, u), np.einsum("...i,...i->...", unit, v)
    second = sd_v**2 * (1 - along_u**2)  # |b × u|² for unit vectors
    variance = sd_u**2 * (1 - along_v**2) + second
    residual = _triple(unit, u, v)
    variance = np.where(length > 0, np.maximum(variance, 0.0), np.inf)
    return residual, variance + 1e-30, second


def _triple(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """a · (b × c), by components, which is faster than NumPy's cross product."""
    x = b[..., 1] * c[..., 2] - b[..., 2] * c[..., 1]
    y = b[..., 2] * c[..., 0] - b[..., 0] * c[..., 2]
    z = b[..., 0] * c[..., 1] - b[..., 1] * c[..., 0]
    return a[..., 0] * x + a[..., 1] * y + a[..., 2] * z


@dataclass(frozen=True, eq=False)
class PairMisses:
    """How far the rays of a pair of cameras miss each other at given clocks. S samples.

    Attributes
    ----------
    z : (S,)
        Misses in standard deviations for one pixel.
    rate : (S,)
        Their change per frame of the second camera's own time.
    noise : (S,)
        Variance of the rate by pixel noise alone.
    frame_a : (S,)
    own_b : (S,)
        When, on the two cameras' own clocks.
    """

    z: np.ndarray
    rate: np.ndarray
    noise: np.ndarray
    frame_a: np.ndarray
    own_b: np.ndarray


def pair_misses(a: TimedRays, b: TimedRays, rows_a: np.ndarray, own_b: np.ndarray) -> PairMisses:
    """Misses of the rays `rows_a` (S,) of a and the rays of b at its own times `own_b` (S,).

    Only samples of which b has the individual in the frames before and after, and around.
    """
    before = np.floor(own_b).astype(int)
    individual = a.individual[rows_a]
    row, after = b.row(individual, before), b.row(individual, before + 1)
    there = (row >= 0) & (after >= 0)
    there[there] = np.isfinite(b.slope[row[there], 0])
    rows_a, own_b, row, after = rows_a[there], own_b[there], row[there], after[there]
    part = (own_b - np.floor(own_b))[:, None]
    centre = (1 - part) * b.centre[row] + part * b.centre[after]
    v = (1 - part) * b.direction[row] + part * b.direction[after]
    shrink = (1 - part[:, 0]) ** 2 + part[:, 0] ** 2  # of the noise, by interpolation
    step, u = centre - a.centre[rows_a], a.direction[rows_a]
    residual, variance, second = _miss(step, u, v, a.sd, b.sd)
    variance = variance - (1 - shrink) * second
    length = np.linalg.norm(step, axis=1)
    length = np.where(length > 0, length, 1.0)
    slope, turn = b.slope[row, :3], b.slope[row, 3:]
    rate = (_triple(slope, u, v) + _triple(step, u, turn)) / length
    rate -= residual * np.einsum("si,si->s", step, slope) / length**2
    sd = np.sqrt(variance)
    return PairMisses(residual / sd, rate / sd, SLOPE_VARIANCE * second / variance, a.frame[rows_a], own_b)
