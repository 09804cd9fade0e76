"""Pairs of dots that the thesis's method may take: epipolar lines, the two-way check, and where the pair is.

See :mod:`thesis_method` for the rules. Shapes: A and B dots of the two views in a frame, K pairs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from acino_fte.cameras import Camera

from .epipolar import fundamental_matrix, ideal_pixels
from .tracks2d import TrackRecording


@dataclass(frozen=True, eq=False)
class Candidates:
    """Pairs that pass the two-way check, sorted by frame, row of the first view, and distance.

    Attributes
    ----------
    to_line : (K, 2)
        Distance of the dot in each view to the line of the other, px.
    track : (K,) int
        Track of the second view; −1 for a bare point.
    unchecked : (K,) bool
        The row is one of those that no gate judges.
    """

    first: np.ndarray
    second: np.ndarray
    frame: np.ndarray
    to_line: np.ndarray
    track: np.ndarray
    points: np.ndarray
    unchecked: np.ndarray

    def accept(self, passes: np.ndarray, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Of candidates start…stop with `passes`, the indices of those that are paired.

        A row takes its first candidate that passes, unless one with z ≤ 0 comes before.
        """
        front = self.points[start:stop, 2] > 0.0
        deciding = np.flatnonzero(~front | passes)
        rows = self.first[start:stop][deciding]
        leading = np.ones(len(rows), dtype=bool)
        leading[1:] = rows[1:] != rows[:-1]
        chosen = deciding[leading]
        return start + chosen[front[chosen]]


def find_candidates(recording: TrackRecording, views: tuple[int, int], unchecked: int) -> Candidates:
    """All pairs of two views that pass the two-way check, triangulated."""
    cameras = [list(recording.cameras)[v] for v in views]
    dots = [recording.views[v] for v in views]
    pixels = [ideal_pixels(camera, dot.xy) for camera, dot in zip(cameras, dots, strict=True)]
    f_matrix = fundamental_matrix(*cameras)
    parts = []
    for number, rows in _shared_frames(*(dot.frame for dot in dots)):
        f = f_matrix if f_matrix.ndim == 2 else f_matrix[number - recording.first_frame]
        found = _two_way(f, pixels[0][rows[0]], pixels[1][rows[1]])
        if found is not None:
            first, second, to_line = found
            parts.append((rows[0][first], rows[1][second], np.full(len(first), number), to_line))
    empty = (np.empty(0, int), np.empty(0, int), np.empty(0, int), np.empty((0, 2)))
    first, second, frame, to_line = (np.concatenate(column) for column in zip(empty, *parts, strict=True))
    poses = frame - recording.first_frame
    points = _triangulate(cameras, poses, (pixels[0][first], pixels[1][second]))
    free = np.zeros(len(dots[0]), dtype=bool)
    free[np.argsort(dots[0].frame, kind="stable")[:unchecked]] = True
    return Candidates(first, second, frame, to_line, dots[1].track[second], points, free[first])


def _shared_frames(
    frame_a: np.ndarray, frame_b: np.ndarray
) -> Iterator[tuple[int, tuple[np.ndarray, np.ndarray]]]:
    """Frames that both views have rows in, and those rows."""
    orders = [np.argsort(frame, kind="stable") for frame in (frame_a, frame_b)]
    ordered = [frame_a[orders[0]], frame_b[orders[1]]]
    frames = np.intersect1d(frame_a, frame_b)
    bounds = [[np.searchsorted(o, frames, side) for side in ("left", "right")] for o in ordered]
    for k, frame in enumerate(frames.tolist()):
        yield (
            frame,
            (
                orders[0][bounds[0][0][k] : bounds[0][1][k]],
                orders[1][bounds[1][0][k] : bounds[1][1][k]],
            ),
        )


def _two_way(f: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Pairs of dots (A, 2) and (B, 2) that pass the two-way check, by row of a and then by distance.

    Returns their indices in a and in b, and the distances in each image, (K, 2), px.
    """
    seen_a, seen_b = np.flatnonzero(np.isfinite(a[:, 0])), np.flatnonzero(np.isfinite(b[:, 0]))
    if not len(seen_a) or not len(seen_b) or np.isnan(f).any():
        return None
    lines_in_b = _homogeneous(a[seen_a]) @ f.T
    lines_in_a = _homogeneous(b[seen_b]) @ f
    error = np.abs(_homogeneous(b[seen_b]) @ lines_in_b.T)  # (B, A)
    in_b = error / np.hypot(lines_in_b[:, 0], lines_in_b[:, 1])
    nearest = in_b.argmin(1)
    each = np.arange(len(seen_b))
    in_a = error[each, nearest] / np.hypot(lines_in_a[:, 0], lines_in_a[:, 1])
    order = np.lexsort((in_a, nearest))
    to_line = np.stack([in_a, in_b[each, nearest]], axis=1)
    return seen_a[nearest[order]], seen_b[order], to_line[order]


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _triangulate(
    cameras: list[Camera], poses: np.ndarray, pixels: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Points (K, 3), world frame, m, by the linear method (Hartley & Zisserman 2004, section 12.2)."""
    equations = np.empty((len(poses), 4, 4))
    for c, (camera, pixel) in enumerate(zip(cameras, pixels, strict=True)):
        rotation = camera.rotation[poses] if camera.rotation.ndim == 3 else camera.rotation
        translation = camera.translation[poses] if camera.translation.ndim == 2 else camera.translation
        pose = np.empty((len(poses), 3, 4))
        pose[..., :3], pose[..., 3] = rotation, translation
        projection = camera.matrix @ pose
        equations[:, 2 * c : 2 * c + 2] = pixel[..., None] * projection[:, 2:] - projection[:, :2]
    homogeneous = np.linalg.svd(equations)[2][:, -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return homogeneous[:, :3] / homogeneous[:, 3:]
