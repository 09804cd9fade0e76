"""The rows of all views that belong to groups, as measurements of the nodes of paths.

Shapes: P rows of all views, view after view; T nodes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.trajectory_motion import Pieces


@dataclass(frozen=True, eq=False)
class ViewRows:
    """The rows of one view.

    Attributes
    ----------
    frame : (P,) int
        Frame of the recording.
    xy : (P, 2)
        Pixels.
    group : (P,) int
        The group (animal) of each row, −1 for none.
    variance : (P,), optional
        Of each pixel coordinate, px²; by default that of the view's noise.
    doubtful : (P,) bool, optional
        Rows that look wrong. They do not count at first.
    """

    frame: np.ndarray
    xy: np.ndarray
    group: np.ndarray
    variance: np.ndarray | None = None
    doubtful: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Nodes:
    """The frames of all paths: which hang together (S pieces), and the group and frame of each node (T,)."""

    pieces: Pieces
    group: np.ndarray
    frame: np.ndarray

    def find(self, group: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Node of each (group, frame), −1 where there is none. Nodes are sorted by group, then frame."""
        if not len(self.frame):
            return np.full(len(frame), -1)
        base = min(self.frame.min(), np.min(frame, initial=0))
        span = max(self.frame.max(), np.max(frame, initial=0)) - base + 1
        keys = self.group * span + (self.frame - base)
        wanted = group * span + (frame - base)
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where((keys[place] == wanted) & (group >= 0), place, -1)


def make_nodes(group: np.ndarray, frame: np.ndarray, max_gap: int, extend: int) -> Nodes:
    """Nodes from the first to the last row of each group, split where more than `max_gap` frames are empty.

    `extend` frames are added at both ends of each piece, as far as there is room.
    """
    if not len(group):
        return Nodes(Pieces(np.zeros(0, dtype=int)), np.zeros(0, dtype=int), np.zeros(0, dtype=int))
    order = np.lexsort((frame, group))
    group, frame = group[order], frame[order]
    same = group[1:] == group[:-1]
    gap = np.diff(frame)
    begin = np.concatenate([[True], ~same | (gap > max_gap + 1)])
    first, last = frame[begin], frame[np.concatenate([begin[1:], [True]])]
    owner = group[begin]
    neighbours = owner[1:] == owner[:-1]
    room = np.where(neighbours, (first[1:] - last[:-1] - 1) // 2, extend)
    room = np.minimum(room, extend)
    first = first - np.concatenate([[extend], room])
    last = last + np.concatenate([room, [extend]])
    pieces = Pieces(last - first + 1)
    within = np.arange(pieces.n_nodes) - np.repeat(pieces.start, pieces.length)
    return Nodes(pieces, np.repeat(owner, pieces.length), np.repeat(first, pieces.length) + within)


def take_pieces(nodes: Nodes, chosen: np.ndarray) -> tuple[Nodes, np.ndarray]:
    """Some of the pieces, given as (S,) bool, and which nodes these are, (T,) bool."""
    kept = np.repeat(chosen, nodes.pieces.length)
    return Nodes(nodes.pieces.take(chosen), nodes.group[kept], nodes.frame[kept]), kept


class Measurements:
    """All rows that belong to a node.

    Parameters
    ----------
    cameras : CameraArray
        Fixed or moving.
    node : (P,) int
        Node of each row.
    camera : (P,) int
        View of each row, rising.
    frame : (P,) int
        Row of the poses of moving cameras.
    xy : (P, 2)
        Pixels.
    variance : (P,)
        Of each pixel coordinate, px².
    doubtful : (P,) bool, optional
        Rows that do not count at first.
    """

    def __init__(
        self,
        cameras: CameraArray,
        node: np.ndarray,
        camera: np.ndarray,
        frame: np.ndarray,
        xy: np.ndarray,
        variance: np.ndarray,
        doubtful: np.ndarray | None = None,
    ) -> None:
        self.doubtful = np.zeros(len(node), dtype=bool) if doubtful is None else doubtful
        self.node, self.camera, self.xy, self.variance = node, camera, xy, variance
        self._cameras, self._frame = cameras, frame
        bounds = np.searchsorted(camera, np.arange(len(cameras) + 1))
        self._parts = [
            (slice(a, b), at_rows(c, frame[a:b]))
            for c, a, b in zip(cameras, bounds[:-1], bounds[1:], strict=True)
            if b > a
        ]

    def __len__(self) -> int:
        return len(self.node)

    def subset(self, rows: np.ndarray, node: np.ndarray) -> Measurements:
        """Some of the rows, with the nodes (K,) they have now."""
        return Measurements(
            self._cameras,
            node,
            self.camera[rows],
            self._frame[rows],
            self.xy[rows],
            self.variance[rows],
            self.doubtful[rows],
        )

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions (P, 3) of the rows in the world."""
        origin, direction = np.empty((2, len(self.node), 3))
        for at, camera in self._parts:
            origin[at] = camera.centre
            direction[at] = camera.rays(self.xy[at][:, None])[:, 0]
        return origin, direction

    def centres(self) -> np.ndarray:
        """Where the camera of each row is, (P, 3)."""
        out = np.empty((len(self.node), 3))
        for at, camera in self._parts:
            out[at] = camera.centre
        return out

    def linearise(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (P, 2), measured less predicted, and derivatives of the predictions (P, 2, 3)."""
        residual, slope = np.empty((len(self.node), 2)), np.empty((len(self.node), 2, 3))
        for at, camera in self._parts:
            pixels, slope[at] = project_rows(camera, x[self.node[at]])
            residual[at] = camera.pixel_difference(self.xy[at], pixels)
        return residual, slope

    def information(
        self, residual: np.ndarray, slope: np.ndarray, weight: np.ndarray, n_nodes: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Σ w JᵀJ/σ² (T, 3, 3) and Σ w Jᵀr/σ² (T, 3). Rows that are not finite count nothing."""
        good = np.isfinite(residual).all(-1) & np.isfinite(slope).all((-1, -2))
        if not good.all():
            slope, residual = (
                np.where(good[:, None, None], slope, 0.0),
                np.where(good[:, None], residual, 0.0),
            )
        factor = np.where(good, weight / self.variance, 0.0)
        joint = np.concatenate([slope, residual[..., None]], axis=2)  # [J r], (P, 2, 4)
        first, second = joint.transpose(1, 2, 0)
        total = np.empty((3, 4, n_nodes))
        for i in range(3):
            for j in range(i, 4):
                each = factor * (first[i] * first[j] + second[i] * second[j])
                total[i, j] = np.bincount(self.node, each, n_nodes)
                if j < 3:
                    total[j, i] = total[i, j]
        return np.ascontiguousarray(total[:, :3].transpose(2, 0, 1)), total[:, 3].T.copy()

    def parts(self) -> Iterator[tuple[slice, Camera]]:
        """The rows of each view and its camera at them."""
        yield from self._parts


def at_rows(camera: Camera, frame: np.ndarray) -> Camera:
    """The camera with one pose for each row; a fixed camera as it is."""
    if not camera.moves:
        return camera
    rotation = camera.rotation if camera.rotation.ndim == 2 else camera.rotation[frame]
    translation = camera.translation if camera.translation.ndim == 1 else camera.translation[frame]
    return replace(camera, rotation=rotation, translation=translation)


def has_pose(camera: Camera, frame: np.ndarray) -> np.ndarray:
    """Whether the camera has a pose at each row of its poses, (P,) bool; a fixed camera has one always."""
    lengths = [len(camera.rotation)] if camera.rotation.ndim == 3 else []
    lengths += [len(camera.translation)] if camera.translation.ndim == 2 else []
    return (frame >= 0) & (frame < min(lengths)) if lengths else np.ones(len(frame), dtype=bool)


def project_rows(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (P, 2) and derivatives (P, 2, 3) of points (P, 3), at one pose each if the camera moves."""
    if not camera.moves:
        return camera.project_with_jacobian(points)
    pixels, slope = camera.project_with_jacobian(points[:, None])
    return pixels[:, 0], slope[:, 0]


def gather_rows(
    views: Sequence[ViewRows],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Camera, place in its view, frame, group and pixels of all rows that have a group and a place."""
    chosen = [np.flatnonzero((v.group >= 0) & np.isfinite(v.xy).all(-1)) for v in views]
    camera = np.repeat(np.arange(len(views)), [len(rows) for rows in chosen])
    frame, group, xy = (
        np.concatenate([np.asarray(getattr(v, key))[rows] for v, rows in zip(views, chosen, strict=True)])
        for key in ("frame", "group", "xy")
    )
    return camera, np.concatenate(chosen), frame, group, xy
