"""What triangulating a scene gives, and the tracks put together from points and dots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.camera_paths import CameraPath
from acino_fte.data_tools.rigs import Rig
from acino_fte.data_tools.scene_points import PointFit
from acino_fte.data_tools.scene_rows import SceneRows
from acino_fte.data_tools.scene_smoothing import PathPoints
from acino_fte.data_tools.scene_tracks import SceneTracks
from acino_fte.data_tools.tracks2d import Tracks2D

if TYPE_CHECKING:
    from acino_fte.data_tools.scene import Scene


@dataclass(frozen=True, eq=False)
class SceneResult:
    """3D tracks of a scene and what they rest on.

    Attributes
    ----------
    scene : Scene
        The scene, in the world of the tracks.
    tracks : SceneTracks
        The answer.
    points : SceneTracks
        Triangulated frame by frame, not smoothed: only what two views or more saw.
    paths : tuple of CameraPath
        One for each camera of the scene.
    rigs : tuple of Rig
        Cameras that were treated as one.
    noise_px : float
        Standard deviation of a dot's coordinate.
    numbers : dict
        For ``metrics.json``.
    """

    scene: Scene
    tracks: SceneTracks
    points: SceneTracks
    paths: tuple[CameraPath, ...]
    rigs: tuple[Rig, ...]
    noise_px: float
    numbers: dict[str, Any] = field(default_factory=dict)


def single_frames(
    rows: SceneRows, fit: PointFit, views: Sequence[Tracks2D], names: Sequence[str]
) -> SceneTracks:
    """The points that two views or more saw, as tracks."""
    there = np.flatnonzero(np.isfinite(fit.position[:, 0]))
    place = np.full(rows.n_points, -1)
    place[there] = np.arange(len(there))
    return _tracks(
        rows, place[rows.point], fit.used, views, names, smooth=False,
        individual=rows.individual[there], frame=rows.frame[there], position=fit.position[there],
        covariance=fit.covariance[there], source=np.zeros(len(there), dtype=int),
    )  # fmt: skip


def smooth_tracks(
    rows: SceneRows, paths: PathPoints, views: Sequence[Tracks2D], names: Sequence[str]
) -> SceneTracks:
    """The points of smooth paths, as tracks."""
    place = place_of(rows, paths.individual, paths.frame)[rows.point]
    return _tracks(
        rows, place, paths.used, views, names, smooth=True,
        individual=paths.individual, frame=paths.frame, position=paths.position,
        covariance=paths.covariance, source=paths.source,
    )  # fmt: skip


def with_single_views(points: SceneTracks, smooth: SceneTracks) -> SceneTracks:
    """The points of `points`, and what only `smooth` has: seen by one view, or by none in short gaps."""
    span = int(max(points.frame.max(initial=0), smooth.frame.max(initial=0))) + 2
    low = int(min(points.frame.min(initial=0), smooth.frame.min(initial=0)))
    key = points.individual * (span - low) + points.frame - low
    other = smooth.individual * (span - low) + smooth.frame - low
    extra = np.flatnonzero((smooth.source > 0) & ~np.isin(other, key))
    order = np.argsort(np.concatenate([key, other[extra]]), kind="stable")

    def both(name: str) -> np.ndarray:
        return np.concatenate([getattr(points, name), getattr(smooth, name)[extra]])[order]

    names = ("individual", "frame", "position", "covariance", "source", "n_views")
    fields = {name: both(name) for name in (*names, "reprojection_median", "reprojection_max")}
    pairs = zip(points.distance, smooth.distance, strict=True)
    distance = tuple(np.where(np.isfinite(a), a, b) for a, b in pairs)
    alone = [np.isfinite(b) & ~np.isfinite(a) for a, b in zip(points.distance, smooth.distance, strict=True)]
    used = tuple(u | (v & w) for u, v, w in zip(points.used, smooth.used, alone, strict=True))
    return SceneTracks(points.individuals, distance=distance, used=used, smooth=False, **fields)


def place_of(rows: SceneRows, individual: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Index of each point of the rows among others, sorted by individual, then frame; −1 for none."""
    if not len(frame):
        return np.full(rows.n_points, -1)
    low = min(int(frame.min()), int(rows.frame.min(initial=0)))
    span = max(int(frame.max()), int(rows.frame.max(initial=0))) - low + 1
    keys, wanted = individual * span + frame - low, rows.individual * span + rows.frame - low
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[place] == wanted, place, -1)


def _tracks(
    rows: SceneRows,
    place: np.ndarray,
    used: np.ndarray,
    views: Sequence[Tracks2D],
    names: Sequence[str],
    *,
    smooth: bool,
    **fields: np.ndarray,
) -> SceneTracks:
    """Tracks with the distances of all dots; `place` (P,) is the point of each dot, −1 for none."""
    n = len(fields["frame"])
    there = np.flatnonzero(place >= 0)
    residual, _ = rows.measured.subset(there, place[there]).linearise(fields["position"])
    error = np.full(len(place), np.nan)
    error[there] = np.linalg.norm(residual, axis=1)
    used = used & np.isfinite(error)
    distance, counts = [], []
    for c, view in enumerate(views):
        mine = rows.camera == c
        distance.append(np.full(len(view), np.nan))
        counts.append(np.zeros(len(view), dtype=bool))
        distance[c][rows.place[mine]] = error[mine]
        counts[c][rows.place[mine]] = used[mine]
    median, most, count = _medians(error[used], place[used], n)
    return SceneTracks(
        tuple(names), n_views=count, reprojection_median=median, reprojection_max=most,
        distance=tuple(distance), used=tuple(counts), smooth=smooth, **fields,
    )  # fmt: skip


def _medians(values: np.ndarray, index: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Median, greatest and number of the values of each index (n,)."""
    order = np.lexsort((values, index))
    values, count = values[order], np.bincount(index, minlength=n)
    start = np.cumsum(count) - count
    median, most = np.full(n, np.nan), np.full(n, np.nan)
    some = count > 0
    first, number = start[some], count[some]
    median[some] = 0.5 * (values[first + (number - 1) // 2] + values[first + number // 2])
    most[some] = values[first + number - 1]
    return median, most, count
