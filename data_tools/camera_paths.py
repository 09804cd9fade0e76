"""Where a moving camera is in every frame, from its key frames: splines with their uncertainty.

Centres and rotations of the key frames are noisy points on smooth curves. Centres follow
:mod:`wiener_path` with p = 3, or with p = 2 where key frames are too far apart for the motion. Rotations are
unrolled into a curve of three angles, ρ_(k+1) = ρ_k + log(R_(k+1) R_kᵀ), which is smoothed like a centre and
rolled up again from the key frames on both sides. Nothing is made up before the first key frame, after the
last one, or across long gaps. Shapes: K key frames, N frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.rotations import rotation_matrix, rotation_vector
from acino_fte.data_tools.wiener_path import WienerPath, fit_wiener_path

if TYPE_CHECKING:
    from acino_fte.data_tools.camera_keys import KeyedCamera
    from acino_fte.data_tools.similarity import Similarity

GAP_STEPS = 6.0
"""A gap in the key frames is too long from so many of their median steps on."""
_LEAST_TURN, _LEAST_SHIFT = 1e-7, 1e-8  # rad; share of the path's extent. Nothing is surer
_FORESEEN, _MEDIAN = (
    2.5,
    0.79,
)  # how far off key frames may be from what others predict, in the median of χ²/3
_SUSPECT, _MISPLACED = 10.0, 50.0  # squared distance of a key frame from where the others have it, as usual
_ROUNDS = 5  # of looking for misplaced key frames


@dataclass(frozen=True, eq=False)
class PoseNoise:
    """How far key frames are off: standard deviations of each turn (rad) and each coordinate of a centre.

    `shape` (6, 6) tells how turns and shifts, both in the camera's frame, hang together: their covariance in
    units of these standard deviations. A camera that errs along a wall also turns, and sees it where it is.
    """

    turn: np.ndarray | float
    shift: np.ndarray | float
    shape: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Poses of a camera, or of a rig's frame, in consecutive frames.

    Attributes
    ----------
    name : str
    frame : (N,) int
        Consecutive.
    rotation : (N, 3, 3)
        World to camera. Where the pose is not known, the nearest known one.
    translation : (N, 3)
        World to camera, m.
    covariance : (N, 6, 6)
        Turn (rad, in the camera's frame: R_true = exp(turn×) R) and shift of the centre (m, world).
    known : (N,) bool
        False in long gaps.
    key : (N,) bool
        Frames with a key frame that was used.
    """

    name: str
    frame: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    covariance: np.ndarray
    known: np.ndarray
    key: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """Positions, (N, 3)."""
        return -np.einsum("nji,nj->ni", self.rotation, self.translation)

    def rows(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row of each frame (P,), 0 where there is none, and whether the pose is known there (P,)."""
        row = np.asarray(frames) - self.frame[0]
        inside = (row >= 0) & (row < len(self.frame))
        row = np.where(inside, row, 0)
        return row, inside & self.known[row]

    def camera(self, lens: Camera) -> Camera:
        """A moving camera with this path; its row 0 is the path's first frame."""
        return replace(lens, name=self.name, rotation=self.rotation, translation=self.translation)

    def moved(self, change: Similarity) -> CameraPath:
        """The same path in another world."""
        rotation, translation = change.poses(self.rotation, self.translation)
        covariance = change.pose_covariance(self.covariance)
        return replace(self, rotation=rotation, translation=translation, covariance=covariance)


def camera_path(
    camera: KeyedCamera,
    noise: PoseNoise,
    *,
    max_gap: float | None = None,
    frames: tuple[int, int] | None = None,
) -> CameraPath:
    """The path of a camera through its key frames.

    Parameters
    ----------
    camera : KeyedCamera
        Its key frames. With a single one it is taken to stand still.
    noise : PoseNoise
        Of the key frames, each a number or one a key frame.
    max_gap : float, optional
        Frames between key frames beyond which nothing is invented; by default :data:`GAP_STEPS` median
        steps.
    frames : (first, last + 1), optional
        Of a camera that stands still; others have a path from the first to the last key frame.

    Returns
    -------
    CameraPath
        The path. Key frames far from where the others predict them are left out.
    """
    turn = np.broadcast_to(np.maximum(noise.turn, _LEAST_TURN) ** 2, (len(camera.frame),))
    least = _LEAST_SHIFT * float(np.linalg.norm(np.ptp(camera.centre, axis=0)))
    shift = np.broadcast_to(np.maximum(noise.shift, max(least, 1e-15)) ** 2, (len(camera.frame),))
    if len(camera.frame) == 1:
        return _standing(camera, float(turn[0]), float(shift[0]), noise.shape, frames)
    if max_gap is None:
        max_gap = GAP_STEPS * float(np.median(np.diff(camera.frame)))
    keys = np.arange(len(camera.frame))
    for _ in range(_ROUNDS):
        time, rotation = camera.frame[keys], camera.rotation[keys]
        place, unrolled = camera.centre[keys], unroll(rotation)
        centres = _curve(time, place, shift[keys], max_gap)
        turns = _curve(time, unrolled, turn[keys], max_gap)
        wrong = _misplaced(centres, place, shift[keys]) | _misplaced(turns, unrolled, turn[keys], rotation)
        if not wrong.any():
            break
        keys = keys[~wrong]
    frame = np.arange(time[0], time[-1] + 1)
    centre, centre_variance = centres.at(frame)
    angles, turn_variance = turns.at(frame)
    known = np.isfinite(centre_variance)
    nearest = _nearest_known(known)
    centre, angles = centre[nearest], angles[nearest]
    matrix = roll(rotation, time, unrolled, frame[nearest], angles)
    covariance = _covariance(
        turn_variance[nearest], centre_variance[nearest], np.isin(frame, time), noise.shape
    )
    covariance = _shift_in_world(covariance, matrix)
    translation = -np.einsum("nij,nj->ni", matrix, centre)
    return CameraPath(camera.name, frame, matrix, translation, covariance, known, np.isin(frame, time))


def _curve(time: np.ndarray, points: np.ndarray, noise: np.ndarray, max_gap: float) -> WienerPath:
    """The smooth curve; a rougher one where that does not foresee key frames, too far apart as they are."""
    for order in (3, 2):
        path = fit_wiener_path(time, points, noise, order=order, max_gap=max_gap)
        if np.median(path.deleted_distance(points, noise)) < _FORESEEN * _MEDIAN:
            break
    return path


def _covariance(turn: np.ndarray, shift: np.ndarray, key: np.ndarray, shape: np.ndarray | None) -> np.ndarray:
    """Covariances (N, 6, 6) in the camera's frame from the variances (N,) of turns and shifts.

    As much as key frames have of each hangs together as the errors of the key frames do; what is added
    between them, where the path is a guess, does not.
    """
    out = np.zeros((len(turn), 6, 6))
    axis = np.arange(3)
    parts = [np.minimum(each, np.median(each[key])) for each in (turn, shift)]
    out[:, axis, axis] = (turn - parts[0])[:, None]
    out[:, axis + 3, axis + 3] = (shift - parts[1])[:, None]
    sd = np.sqrt(np.repeat(np.stack(parts, axis=1), 3, axis=1))
    return out + sd[:, :, None] * (np.eye(6) if shape is None else shape) * sd[:, None, :]


def _shift_in_world(covariance: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Covariances (N, 6, 6) with the shift turned from the camera's frame to the world's."""
    change = np.zeros((len(rotation), 6, 6))
    change[:, :3, :3], change[:, 3:, 3:] = np.eye(3), rotation.transpose(0, 2, 1)
    return change @ covariance @ change.transpose(0, 2, 1)


def unroll(rotation: np.ndarray) -> np.ndarray:
    """Rotations (K, 3, 3) of key frames rolled out into a curve of three angles, (K, 3), rad, from 0."""
    steps = rotation_vector(rotation[1:] @ rotation[:-1].transpose(0, 2, 1))
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def roll(
    rotation: np.ndarray, time: np.ndarray, unrolled: np.ndarray, frame: np.ndarray, angles: np.ndarray
) -> np.ndarray:
    """Rotations (N, 3, 3) of frames whose angles (N, 3) lie on the curve of the key frames' (K, 3).

    From the key frame before, exp(ρ(t) − ρ_k) R_k, and from the one after. The two differ by what turns about
    other axes on the way do to each other, and are blended by a smooth step.
    """
    k = np.clip(np.searchsorted(time, frame, side="right") - 1, 0, len(time) - 2)
    before = rotation_matrix(angles - unrolled[k]) @ rotation[k]
    after = rotation_matrix(angles - unrolled[k + 1]) @ rotation[k + 1]
    way = np.clip((frame - time[k]) / (time[k + 1] - time[k]), 0.0, 1.0)
    share = way**2 * (3.0 - 2.0 * way)
    apart = rotation_vector(after @ before.transpose(0, 2, 1))
    return rotation_matrix(share[:, None] * apart) @ before


def _misplaced(
    path: WienerPath, points: np.ndarray, noise: np.ndarray, rotation: np.ndarray | None = None
) -> np.ndarray:
    """Key frames (K,) far from where the others predict them; of angles with the rotations they stand for.

    A misplaced key frame makes the curve so rough that nothing seems far from it. So key frames further off
    than their neighbours, and than is usual, are held against the curve through the others alone. Where that
    is rough as well, the camera moved suddenly.
    """
    wrong = np.zeros(len(points), dtype=bool)
    distance = path.deleted_distance(points, noise)
    beside = np.maximum(np.append(distance[1:], 0.0), np.append(0.0, distance[:-1]))
    suspect = (distance >= beside) & (distance > _SUSPECT * float(np.median(distance)))
    which, rest = np.flatnonzero(suspect), np.flatnonzero(~suspect)
    if not len(which) or len(rest) < 4:
        return wrong
    others = points[rest] if rotation is None else unroll(rotation[rest])
    curve = fit_wiener_path(path.time[rest], others, noise[rest])
    mean, variance = curve.at(path.time[which])
    off = points[which] - mean
    before = np.maximum(np.searchsorted(rest, which) - 1, 0)
    if rotation is not None:
        expected = rotation_matrix(np.nan_to_num(mean - others[before])) @ rotation[rest[before]]
        found = rotation_vector(rotation[which] @ expected.transpose(0, 2, 1))
        off = np.where(np.isfinite(mean), found, np.nan)
    left = curve.deleted_distance(others, noise[rest])
    usual = float(np.median(left))
    wrong[which] = (off**2).mean(1) > _MISPLACED * max(usual, 1.0) * (variance + noise[which])
    wrong[which] &= np.maximum(left[before], left[np.minimum(before + 1, len(rest) - 1)]) < _SUSPECT * usual
    return wrong


def _nearest_known(known: np.ndarray) -> np.ndarray:
    """Index of the nearest known frame of each frame, (N,)."""
    index = np.flatnonzero(known)
    place = np.searchsorted(index, np.arange(len(known)))
    before, after = index[np.maximum(place - 1, 0)], index[np.minimum(place, len(index) - 1)]
    every = np.arange(len(known))
    return np.where(np.abs(every - before) <= np.abs(after - every), before, after)


def _standing(
    camera: KeyedCamera,
    turn: float,
    shift: float,
    shape: np.ndarray | None,
    frames: tuple[int, int] | None,
) -> CameraPath:
    first, stop = frames or (int(camera.frame[0]), int(camera.frame[0]) + 1)
    frame = np.arange(min(first, camera.frame[0]), max(stop, camera.frame[0] + 1))
    n = len(frame)
    one = np.ones(1, dtype=bool)
    covariance = _covariance(np.array([turn]), np.array([shift]), one, shape)
    covariance = np.broadcast_to(_shift_in_world(covariance, camera.rotation), (n, 6, 6)).copy()
    return CameraPath(
        camera.name,
        frame,
        np.broadcast_to(camera.rotation[0], (n, 3, 3)).copy(),
        np.broadcast_to(camera.translation[0], (n, 3)).copy(),
        covariance,
        np.ones(n, dtype=bool),
        frame == camera.frame[0],
    )
