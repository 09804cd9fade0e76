"""Points in space of a matching, and how far its dots are from them and from each other's epipolar planes.

A matching whose 3D paths were followed has smooth ones; any other has the points where the rays of the
matched dots meet. Shapes: T points in space, P rows of one view, K pairs of rows, V views.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.epipolar import (
    essential_from_poses,
    ideal_jacobian,
    ideal_pixels,
    sampson_distance,
)
from acino_fte.data_tools.trajectories3d import SOURCES, Trajectories
from acino_fte.data_tools.trajectory_motion import Pieces
from acino_fte.data_tools.trajectory_rows import Nodes, at_rows, has_pose, project_rows
from acino_fte.triangulate import triangulate

if TYPE_CHECKING:
    from acino_fte.data_tools.track_matching import TrackMatches

_MOST = 200_000
TRIANGULATED = len(SOURCES)
SOURCE_NAMES = (*SOURCES, "triangulated")
"""Where a point comes from: :data:`trajectories3d.SOURCES`, or the meeting of rays alone."""


@dataclass(frozen=True, eq=False)
class SpacePoints:
    """Animals in space, sorted by group, then frame.

    Attributes
    ----------
    group, frame : (T,) int
    piece : (T,) int
        Points with the same number belong to a path without a gap.
    position : (T, 3)
        World frame, m.
    covariance : (T, 3, 3)
        m²; NaN where unknown.
    source : (T,) int
        Index into :data:`SOURCE_NAMES`.
    n_views : (T,) int
        Views that saw the animal.
    reprojection : (T,)
        Root mean square distance of its dots from where it projects, px; NaN without dots.
    """

    group: np.ndarray
    frame: np.ndarray
    piece: np.ndarray
    position: np.ndarray
    covariance: np.ndarray
    source: np.ndarray
    n_views: np.ndarray
    reprojection: np.ndarray

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def standard_deviation(self) -> np.ndarray:
        """Of each coordinate, (T, 3), m."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def find(self, group: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Index of the point of each (group, frame), (P,); −1 where there is none."""
        return Nodes(Pieces(np.zeros(0, dtype=int)), self.group, self.frame).find(group, frame)


def space_points(matches: TrackMatches) -> SpacePoints:
    """The 3D paths of a matching, or where the rays of its dots meet when none were followed."""
    paths = matches.trajectories
    if paths is None:
        return _triangulated(matches)
    return _of_paths(paths)


def _of_paths(paths: Trajectories) -> SpacePoints:
    return SpacePoints(
        paths.group,
        paths.frame,
        paths.piece,
        paths.position,
        paths.covariance,
        paths.source,
        paths.n_views,
        paths.reprojection,
    )


def _triangulated(matches: TrackMatches) -> SpacePoints:
    """Each animal in each frame by itself, with the covariance of least squares at the matching's noise."""
    recording = matches.recording
    views, n_views = recording.views, len(recording.views)
    keep = [group >= 0 for group in matches.groups]
    group = np.concatenate([g[k] for g, k in zip(matches.groups, keep, strict=True)])
    frame = np.concatenate([v.frame[k] for v, k in zip(views, keep, strict=True)])
    view = np.repeat(np.arange(n_views), [int(k.sum()) for k in keep])
    pairs, index = np.unique(np.stack([group, frame], axis=1), axis=0, return_inverse=True)
    pixels = np.full((len(pairs), n_views, 2), np.nan)
    pixels[index.ravel(), view] = np.concatenate([v.xy[k] for v, k in zip(views, keep, strict=True)])
    several = np.isfinite(pixels[..., 0]).sum(1) >= 2
    pairs, pixels = pairs[several], pixels[several]
    cameras = tuple(at_rows(camera, pairs[:, 1] - recording.first_frame) for camera in recording.cameras)
    points = np.empty((0, 3))
    if len(pairs):
        points = triangulate(CameraArray(cameras), pixels[:, :, None], threshold_px=np.inf).points[:, 0]
    there = np.isfinite(points).all(-1)
    pairs, pixels, points = pairs[there], pixels[there], points[there]
    cameras = tuple(at_rows(camera, pairs[:, 1] - recording.first_frame) for camera in recording.cameras)
    squared, information = np.zeros(len(points)), np.zeros((len(points), 3, 3))
    for camera, seen in zip(cameras, pixels.transpose(1, 0, 2), strict=True):
        found, slope = project_rows(camera, points)
        used = np.isfinite(seen[:, 0]) & np.isfinite(found).all(-1)
        squared += np.where(used, ((found - seen) ** 2).sum(1), 0.0)
        information += np.where(used[:, None, None], slope.transpose(0, 2, 1) @ slope, 0.0)
    seeing = np.isfinite(pixels[..., 0]).sum(1)
    gap = np.r_[True, (np.diff(pairs[:, 0]) != 0) | (np.diff(pairs[:, 1]) != 1)][: len(pairs)]
    return SpacePoints(
        pairs[:, 0],
        pairs[:, 1],
        np.cumsum(gap) - 1,
        points,
        _inverse(information) * matches.noise.total**2,
        np.full(len(points), TRIANGULATED),
        seeing,
        np.sqrt(squared / np.maximum(seeing, 1)),
    )


def _inverse(matrices: np.ndarray) -> np.ndarray:
    """Inverses (T, 3, 3); NaN for singular ones."""
    good = np.linalg.cond(matrices) < 1e12 if len(matrices) else np.zeros(0, dtype=bool)
    inverse = np.full(matrices.shape, np.nan)
    inverse[good] = np.linalg.inv(matrices[good])
    return inverse


def predicted_pixels(matches: TrackMatches, points: SpacePoints, view: int) -> np.ndarray:
    """Where the points are in a view, (T, 2) px; NaN behind the camera, or where it has no pose."""
    camera = matches.recording.cameras[view]
    frame = points.frame - matches.recording.first_frame
    pixels = np.full((len(points), 2), np.nan)
    posed = np.flatnonzero(has_pose(camera, frame))
    if len(posed):
        pixels[posed] = project_rows(at_rows(camera, frame[posed]), points.position[posed])[0]
    return pixels


def row_errors(matches: TrackMatches, points: SpacePoints) -> list[np.ndarray]:
    """Distance of every matched row from where its animal projects, (P,) px a view; NaN for the others."""
    errors = []
    for k, (view, group) in enumerate(zip(matches.recording.views, matches.groups, strict=True)):
        place = points.find(group, view.frame)
        pixels = predicted_pixels(matches, points, k)
        error = np.full(len(view), np.nan)
        there = place >= 0
        error[there] = np.linalg.norm(view.xy[there] - pixels[place[there]], axis=1)
        errors.append(error)
    return errors


def matched_pairs(matches: TrackMatches, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of two views with one animal in one frame, (K,) and (K,)."""
    rows, keys = [], []
    lows = [int(v.frame.min()) for v in matches.recording.views if len(v)]
    highs = [int(v.frame.max()) for v in matches.recording.views if len(v)]
    low, span = min(lows, default=0), max(highs, default=0) - min(lows, default=0) + 1
    for k in (a, b):
        view, group = matches.recording.views[k], matches.groups[k]
        use = np.flatnonzero(group >= 0)
        key, first = np.unique(group[use] * span + view.frame[use] - low, return_index=True)
        rows.append(use[first])
        keys.append(key)
    _, in_a, in_b = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
    return rows[0][in_a], rows[1][in_b]


def epipolar_residuals(matches: TrackMatches) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
    """Signed Sampson distances of matched pairs, and of pairs by chance, for every pair of views.

    Yields
    ------
    a, b : int
        The views.
    matched : (K,)
        px; of right pairs the scatter is the noise of one coordinate. Of very many pairs every n-th frame.
    chance : (L,)
        px; every matched row of a with a matched row of b of another animal in that frame.
    """
    views = matches.recording.views
    for a, b in combinations(range(len(views)), 2):
        row_a, row_b = matched_pairs(matches, a, b)
        if not len(row_a):
            continue
        order = _some_frames(views[a].frame[row_a])
        row_a, row_b = row_a[order], row_b[order]
        frame = views[a].frame[row_a]
        start = np.searchsorted(frame, frame)
        count = np.searchsorted(frame, frame, side="right") - start
        place = np.arange(len(frame)) - start
        other = start + (place + 1 + place % np.maximum(count - 1, 1)) % count
        several = (count > 1) & (other != np.arange(len(frame)))
        distance = sampson_of_rows(matches, (a, b), row_a, row_b)
        yield a, b, distance, sampson_of_rows(matches, (a, b), row_a[several], row_b[other[several]])


def _some_frames(frame: np.ndarray) -> np.ndarray:
    """Order by frame; of many pairs every n-th frame, whole."""
    order = np.argsort(frame, kind="stable")
    every = -(-len(frame) // _MOST)
    if every < 2:
        return order
    _, number = np.unique(frame[order], return_inverse=True)
    return order[number % every == 0]


def sampson_of_rows(
    matches: TrackMatches, views: tuple[int, int], row_a: np.ndarray, row_b: np.ndarray
) -> np.ndarray:
    """Signed Sampson distances (K,) of rows of two views, each two of one frame, px."""
    recording = matches.recording
    pose = recording.views[views[0]].frame[row_a] - recording.first_frame
    pixels, jacobians, poses, inverses = [], [], [], []
    for k, rows in zip(views, (row_a, row_b), strict=True):
        camera = recording.cameras[k]
        used, place = np.unique(rows, return_inverse=True)
        still, xy = _still(camera), recording.views[k].xy[used]
        pixels.append(ideal_pixels(still, xy)[place])
        jacobians.append(ideal_jacobian(still, xy)[place])
        posed = at_rows(camera, pose)
        poses += [posed.rotation, posed.translation]
        inverses.append(np.linalg.inv(camera.matrix))
    essential = essential_from_poses(poses[0], poses[1], poses[2], poses[3])
    fundamental = inverses[1].T @ essential @ inverses[0]
    return sampson_distance(fundamental, *pixels, *jacobians)


def _still(camera: Camera) -> Camera:
    """The camera at the origin: its lens alone."""
    if not camera.moves:
        return camera
    return replace(camera, rotation=np.eye(3), translation=np.zeros(3))
