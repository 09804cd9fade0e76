"""The dots of all cameras of a scene as measurements of points, and how errors of poses move those points.

A *base* is what errs as one: a rig, or a camera by itself. When the base's true pose is turned by φ (in its
own frame) and shifted by δ (in the world), every point seen from it moves rigidly with it,

    Δx = δ + Rᵀ (y × φ),   y = R (x − C):   Δx = G (φ, δ),   G = [Rᵀ[y]×, I],

so the pose's covariance Σ is M = G Σ Gᵀ of the point. Shapes: P dots, T points, B bases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.camera_paths import CameraPath
from acino_fte.data_tools.rotations import cross_matrix
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.data_tools.trajectory_rows import Measurements


@dataclass(frozen=True, eq=False)
class Views:
    """The cameras of a scene in one range of frames.

    Attributes
    ----------
    cameras : CameraArray
        Row n of each is frame `first_frame` + n.
    known : (C, N) bool
        Where the pose is known.
    bases : tuple of CameraPath
        What errs as one.
    base : (C,) int
        Index of each camera's base.
    first_frame : int
    attached : bool
        Whether bases that err apart are cameras of one body.
    """

    cameras: CameraArray
    known: np.ndarray
    bases: tuple[CameraPath, ...]
    base: np.ndarray
    first_frame: int
    attached: bool = False


def make_views(
    lenses: Sequence[Camera],
    paths: Sequence[CameraPath],
    bases: Sequence[CameraPath],
    base: Sequence[int],
    attached: bool = False,
) -> Views:
    """Cameras with their paths, made as long as the longest."""
    first = min(int(path.frame[0]) for path in paths)
    stop = max(int(path.frame[-1]) for path in paths) + 1
    every = np.arange(first, stop)
    cameras, known = [], np.zeros((len(paths), len(every)), dtype=bool)
    for c, (lens, path) in enumerate(zip(lenses, paths, strict=True)):
        row = np.clip(every - path.frame[0], 0, len(path.frame) - 1)
        known[c] = path.known[row] & (every >= path.frame[0]) & (every <= path.frame[-1])
        cameras.append(
            replace(lens, name=path.name, rotation=path.rotation[row], translation=path.translation[row])
        )
    return Views(CameraArray(tuple(cameras)), known, tuple(bases), np.asarray(base), first, attached)


@dataclass(frozen=True, eq=False)
class SceneRows:
    """Dots with a pose and a ray, camera after camera, and the points that they show.

    Attributes
    ----------
    camera, place : (P,) int
        The camera, and the dot's place in its tracks.
    individual, frame : (T,) int
        Of each point, sorted by individual, then frame.
    measured : Measurements
        The dots; their nodes are the points. Variances are one until the noise is known.
    """

    camera: np.ndarray
    place: np.ndarray
    individual: np.ndarray
    frame: np.ndarray
    measured: Measurements

    @property
    def point(self) -> np.ndarray:
        """The point of each dot, (P,)."""
        return self.measured.node

    @property
    def n_points(self) -> int:
        """T."""
        return len(self.frame)

    def of_points(self, chosen: np.ndarray) -> tuple[SceneRows, np.ndarray]:
        """Some of the points, (T,) bool, with their dots, and which dots these are."""
        dots = np.flatnonzero(chosen[self.point])
        number = np.cumsum(chosen) - 1
        measured = self.measured.subset(dots, number[self.point[dots]])
        rows = SceneRows(
            self.camera[dots], self.place[dots], self.individual[chosen], self.frame[chosen], measured
        )
        return rows, dots


def scene_rows(views: Views, tracks: Sequence[Tracks2D], individuals: Sequence[str]) -> SceneRows:
    """Gather the dots of all cameras; individuals are joined by their names.

    Dots in frames without a pose, without a track, or outside of the lens's valid field do not take part.
    """
    number = {name: i for i, name in enumerate(individuals)}
    parts = []
    for c, view in enumerate(tracks):
        owner = np.array([number[label] for label in view.labels] or [-1])
        row = view.frame - views.first_frame
        inside = (row >= 0) & (row < views.known.shape[1]) & (view.track >= 0)
        inside[inside] = views.known[c][row[inside]]
        inside[inside] = np.isfinite(views.cameras[c].undistort(view.xy[inside])[:, 0])
        chosen = np.flatnonzero(inside)
        parts.append((np.full(len(chosen), c), chosen, owner[view.track[chosen]], view.frame[chosen]))
    camera, place, individual, frame = (np.concatenate(part) for part in zip(*parts, strict=True))
    span = views.known.shape[1]
    key, point = np.unique(individual * span + frame - views.first_frame, return_inverse=True)
    xy = np.concatenate([view.xy[part[1]] for view, part in zip(tracks, parts, strict=True)])
    measured = Measurements(views.cameras, point, camera, frame - views.first_frame, xy, np.ones(len(point)))
    return SceneRows(camera, place, key // span, key % span + views.first_frame, measured)


def pose_shift(base: CameraPath, frames: np.ndarray, points: np.ndarray) -> np.ndarray:
    """M (T, 3, 3): covariance of points (T, 3) in frames (T,) from the errors of a base's pose."""
    row, _ = base.rows(frames)
    rotation, sigma = base.rotation[row], base.covariance[row]
    local = np.einsum("nij,nj->ni", rotation, points) + base.translation[row]
    lever = rotation.transpose(0, 2, 1) @ cross_matrix(local)
    turned = lever @ sigma[:, :3, 3:]
    return (
        lever @ sigma[:, :3, :3] @ lever.transpose(0, 2, 1)
        + turned
        + turned.transpose(0, 2, 1)
        + sigma[:, 3:, 3:]
    )
