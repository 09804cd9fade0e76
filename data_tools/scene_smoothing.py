"""Most probable paths of the individuals of a scene, from all dots: those of several views and of one alone.

:mod:`trajectories3d` finds the paths for poses that are right. Errors of poses change slowly, over many
frames, so that smoothing does not average them out: a path follows them as a point would. With the smoothed
covariance S of pixels alone, A_g what base g knows of the point in its own frame, and Ā_g the mean of that
over the neighbouring frames, a shift of what base g sees moves the path by

    K_g = S A_g + (I − S Σ A_g) (Σ Ā_g)⁻¹ Ā_g

(the frame's own part, and that of its neighbours). So the covariance is S + κ Σ_g K_g M_g K_gᵀ + (1 − κ) M̄
(:mod:`scene_noise`), and S + M for one rig. Shapes: T nodes of paths, P dots, B bases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.scene_noise import SceneNoise, sum_of_each
from acino_fte.data_tools.scene_points import PointFit
from acino_fte.data_tools.scene_rows import SceneRows, Views, pose_shift
from acino_fte.data_tools.trajectories3d import Trajectories, smooth_trajectories
from acino_fte.data_tools.trajectory_rows import ViewRows

_AROUND, _FIRM = 15, 1e-9  # frames on both sides that count as neighbours; keeps their sum invertible
_JUMP, _JUMP_ROUNDS, _NEIGHBOURS = 8.0, 3, 8  # medians; rounds; frames from the dot before to that after
_DEEPEST = 0.1  # of its distance, how uncertain a point may be that less than two views see
_BRIDGE = 10  # a path goes on across gaps of so many times the longest gap that is filled


@dataclass(frozen=True, eq=False)
class PathPoints:
    """Points of smooth paths, sorted by individual, then frame.

    Attributes
    ----------
    individual, frame : (T,) int
    position : (T, 3)
    covariance : (T, 3, 3)
    source : (T,) int
        Index into :data:`scene_tracks.SOURCES`.
    used : (P,) bool
        Dots that belong to the paths.
    """

    individual: np.ndarray
    frame: np.ndarray
    position: np.ndarray
    covariance: np.ndarray
    source: np.ndarray
    used: np.ndarray


def smooth_points(rows: SceneRows, views: Views, fit: PointFit, max_gap: int) -> PathPoints:
    """Smooth paths through all dots.

    Parameters
    ----------
    rows : SceneRows
        The dots.
    views : Views
        Their cameras.
    fit : PointFit
        The points triangulated frame by frame; dots that two others contradict there do not take part.
    max_gap : int
        Frames without any dot that are filled.

    Returns
    -------
    PathPoints
        Individuals that no two views ever see have none, nor has what one view alone sees for so long that
        its depth is anyone's guess.
    """
    decided = np.bincount(rows.point[fit.used], minlength=rows.n_points)[rows.point] > 0
    chosen = np.flatnonzero(fit.used | ~decided)
    variance, doubtful = _row_variances(rows, views, fit), sudden_jumps(rows) & ~fit.used
    parts = [chosen[rows.camera[chosen] == c] for c in range(len(views.cameras))]
    paths = smooth_trajectories(
        views.cameras,
        [
            ViewRows(rows.frame[p], rows.measured.xy[k], rows.individual[p], variance[k], doubtful[k])
            for k, p in ((k, rows.point[k]) for k in parts)
        ],
        fit.noise.px,
        max_gap=_BRIDGE * max_gap,
        first_frame=views.first_frame,
        sudden=False,
        alike=False,
    )
    used = np.zeros(len(rows.point), dtype=bool)
    for k, wrong, distance in zip(parts, paths.wrong, paths.distance, strict=True):
        used[k] = ~wrong & np.isfinite(distance)
    node = paths.find(rows.individual, rows.frame)[rows.point]
    used &= node >= 0
    covariance = _with_poses(rows, views, fit.noise, paths, node, used, variance)
    keep = ~_too_long(paths, max_gap) & ~_unknown_depth(paths, covariance, views)
    return PathPoints(
        paths.group[keep], paths.frame[keep], paths.position[keep], covariance[keep], paths.source[keep], used
    )


def sudden_jumps(rows: SceneRows) -> np.ndarray:
    """Dots (P,) that lie beside the line from the one before to the one after, in their own view.

    Several times as far as such dots usually do in that track. Where nothing else sees the individual, a
    wrong dot may take the path with it, and right ones seem wrong.
    """
    track = rows.individual[rows.point] * (rows.camera.max(initial=0) + 1) + rows.camera
    order = np.lexsort((rows.frame[rows.point], track))
    wrong = np.zeros(len(order), dtype=bool)
    for _ in range(_JUMP_ROUNDS):
        rest = order[~wrong[order]]
        beside = _beside(track[rest], rows.frame[rows.point[rest]], rows.measured.xy[rest])
        peak = beside >= np.maximum(np.append(beside[1:], 0.0), np.append(0.0, beside[:-1]))
        wrong[rest[peak & (beside > _JUMP)]] = True
    return wrong


def _beside(track: np.ndarray, frame: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """How far each dot lies from the line between its neighbours, in medians of its track; 0 without two."""
    out = np.zeros(len(track))
    if len(track) < 3:
        return out
    near = (track[2:] == track[:-2]) & (frame[2:] - frame[:-2] <= _NEIGHBOURS)
    share = ((frame[1:-1] - frame[:-2]) / np.maximum(frame[2:] - frame[:-2], 1))[:, None]
    off = np.linalg.norm(xy[1:-1] - (1 - share) * xy[:-2] - share * xy[2:], axis=1)
    off, owner = off[near], track[1:-1][near]
    order = np.lexsort((off, owner))
    _, start, count = np.unique(owner[order], return_index=True, return_counts=True)
    usual = dict(zip(owner[order][start].tolist(), off[order][start + count // 2].tolist(), strict=True))
    scale = np.array([usual[name] for name in owner.tolist()])
    out[1:-1][near] = off / np.maximum(scale, 1e-9)
    return out


def _row_variances(rows: SceneRows, views: Views, fit: PointFit) -> np.ndarray:
    """Variance of each dot's coordinates (P,), px²: its own, and of bases that err apart that of the pose."""
    variance = np.full(len(rows.point), fit.noise.px**2)
    if len(views.bases) == 1:
        return variance
    typical = np.full(len(rows.point), np.nan)
    position = fit.position[rows.point]
    there = np.isfinite(position[:, 0])
    _, slope = rows.measured.linearise(fit.position)
    for b, path in enumerate(views.bases):
        mine = there & (views.base[rows.camera] == b)
        moves = pose_shift(path, rows.frame[rows.point[mine]], position[mine])
        spread = slope[mine] @ moves @ slope[mine].transpose(0, 2, 1)
        typical[mine] = 0.5 * np.trace(spread, axis1=1, axis2=2)
    known = np.isfinite(typical)
    if known.any():
        typical[~known] = np.median(typical[known])
        variance += fit.noise.own * typical
    return variance


def _with_poses(
    rows: SceneRows,
    views: Views,
    noise: SceneNoise,
    paths: Trajectories,
    node: np.ndarray,
    used: np.ndarray,
    variance: np.ndarray,
) -> np.ndarray:
    """Covariances (T, 3, 3) of the paths with the errors of the poses."""
    moves = np.stack([pose_shift(path, paths.frame, paths.position) for path in views.bases])
    if len(moves) == 1:
        return paths.covariance + moves[0]
    n, n_bases = len(paths), len(moves)
    chosen = np.flatnonzero(used)
    measured = rows.measured.subset(chosen, node[chosen])
    _, slope = measured.linearise(paths.position)
    good = np.isfinite(slope).all((1, 2))
    slope, chosen = slope[good], chosen[good]
    base = views.base[rows.camera[chosen]]
    squares = slope.transpose(0, 2, 1) @ slope / variance[chosen, None, None]
    own = sum_of_each(squares, base * n + node[chosen], n_bases * n).reshape(n_bases, n, 3, 3)
    white = noise.px**2 / float(np.mean(variance[chosen])) if len(chosen) else 1.0
    total = white * paths.covariance
    around = np.stack([_moving_mean(each, paths.piece) for each in own])
    level = np.trace(around.sum(0), axis1=1, axis2=2)[:, None, None] * np.eye(3)
    whole = np.linalg.inv(around.sum(0) + _FIRM * level + 1e-300 * np.eye(3))
    beside = np.eye(3) - paths.covariance @ own.sum(0)
    for b in range(n_bases):
        gain = paths.covariance @ own[b] + beside @ whole @ around[b]
        total = total + noise.own * gain @ moves[b] @ gain.transpose(0, 2, 1)
    seen = np.trace(around, axis1=2, axis2=3) > 0
    mean = (seen[..., None, None] * moves).sum(0) / np.maximum(seen.sum(0), 1)[:, None, None]
    return total + noise.common * mean


def _moving_mean(values: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """Mean of values (T, 3, 3) over the neighbouring nodes of the same piece."""
    n = len(values)
    total = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(values, axis=0)])
    index = np.arange(n)
    begin = np.searchsorted(piece, piece, side="left")
    end = np.searchsorted(piece, piece, side="right")
    low, high = np.maximum(index - _AROUND, begin), np.minimum(index + _AROUND + 1, end)
    return (total[high] - total[low]) / (high - low)[:, None, None]


def _unknown_depth(paths: Trajectories, covariance: np.ndarray, views: Views) -> np.ndarray:
    """Nodes (T,) that less than two views see, of which too little of the depth is known."""
    few = np.flatnonzero(paths.source > 0)
    row = paths.frame[few] - views.first_frame
    near = np.full(len(few), np.inf)
    for camera, known in zip(views.cameras, views.known, strict=True):
        distance = np.linalg.norm(paths.position[few] - camera.centre[row], axis=1)
        near = np.where(known[row], np.minimum(near, distance), near)
    out = np.zeros(len(paths), dtype=bool)
    out[few] = np.sqrt(np.linalg.eigvalsh(covariance[few])[:, 2]) > _DEEPEST * near
    return out


def _too_long(paths: Trajectories, max_gap: int) -> np.ndarray:
    """Nodes (T,) in runs without a dot that are longer than what is filled."""
    empty = paths.source >= 2
    index = np.flatnonzero(empty)
    run = np.cumsum(np.diff(index, prepend=-2) > 1)
    breaks = np.zeros(len(empty), dtype=bool)
    if len(index):
        same = np.diff(paths.piece[index], prepend=paths.piece[index[0]]) == 0
        run = run + np.cumsum(~same)
        breaks[index] = np.bincount(run)[run] > max_gap
    return breaks
