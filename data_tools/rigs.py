"""Rigs: cameras that keep their places to each other. Found, tested, and fused into one path.

A rig's frame has the axes of its first camera at the mean of the cameras' centres. Sensor c has the constant
rotation S_c (rig to camera) and the centre o_c in the rig's frame; in key frame k the rig has the pose
(R_k world to rig, C_k), and image (k, c) of the model says

    R_kc ≈ S_c R_k,   C_kc ≈ C_k + R_kᵀ o_c.

Poses and sensors are averaged in turn until they stay (rotations by the chordal mean: Hartley et al. 2013).
What is left over tells how far single images are off; the mean of n of them is √n times better.
Shapes: K key frames of the rig, S sensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.camera_paths import CameraPath, PoseNoise
from acino_fte.data_tools.rotations import cross_matrix, rotation_vector
from acino_fte.errors import InputError

_COMMON = 5  # key frames that two cameras must share
_TURN, _SHIFT = np.radians(1.0), 0.1  # of a rigid pair: spread of its turn, and of its shift per distance
_STRICT = 0.2  # a spread below this part of those needs no other proof
_WHITE = 1.0  # von Neumann's ratio of white noise is 2, of a pair that drifts near 0
_ROUNDS = 20
_NO_LENS = Camera("rig", "pinhole", np.eye(3), np.zeros(0), np.eye(3), np.zeros(3), (1, 1))
_FAR = 6.0  # standard deviations beyond which an image does not count


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras that keep their places.

    Attributes
    ----------
    names : tuple of str
        The S cameras.
    rotation : (S, 3, 3)
        Rig to camera.
    offset : (S, 3)
        Centres of the cameras in the rig's frame.
    keys : KeyedCamera
        The rig's frame in its K key frames, as if it were a camera.
    count : (K,) int
        Images behind each key frame; wrong ones do not count.
    noise : PoseNoise
        Of a single image.
    whiteness : float
        Von Neumann's ratio of the images' deviations: about 2 for a rigid rig, near 0 for one that drifts.
    drift_turn, drift_shift : float
        Largest change of a sensor's place from the first to the last third of the recording: rad, and in
        units of the world.
    """

    names: tuple[str, ...]
    rotation: np.ndarray
    offset: np.ndarray
    keys: KeyedCamera
    count: np.ndarray
    noise: PoseNoise
    whiteness: float
    drift_turn: float
    drift_shift: float

    def sensor_path(self, base: CameraPath, name: str) -> CameraPath:
        """The path of one of the cameras, from the path of the rig's frame."""
        c = self.names.index(name)
        rotation = self.rotation[c] @ base.rotation
        lever = np.einsum("nji,j->ni", base.rotation, self.offset[c])
        centre = base.centre + lever
        change = np.zeros((len(centre), 6, 6))
        change[:, :3, :3] = self.rotation[c]
        change[:, 3:, :3] = base.rotation.transpose(0, 2, 1) @ cross_matrix(self.offset[c])
        change[:, 3:, 3:] = np.eye(3)
        covariance = change @ base.covariance @ change.transpose(0, 2, 1)
        translation = -np.einsum("nij,nj->ni", rotation, centre)
        return CameraPath(name, base.frame, rotation, translation, covariance, base.known, base.key)


def mean_rotation(matrices: np.ndarray) -> np.ndarray:
    """The rotation nearest to a sum of rotations (…, 3, 3)."""
    u, _, vt = np.linalg.svd(matrices)
    sign = np.ones(u.shape[:-1])
    sign[..., 2] = np.linalg.det(u @ vt)
    return (u * sign[..., None, :]) @ vt


def find_rigs(cameras: Sequence[KeyedCamera]) -> list[tuple[str, ...]]:
    """Groups of two cameras or more whose relative poses are constant within their noise.

    Two cameras are rigid when turn and shift between them hardly spread, and what spread there is has no
    memory from one key frame to the next: two drones that keep formation drift.
    """
    group = {camera.name: {camera.name} for camera in cameras}
    for i, first in enumerate(cameras):
        for second in cameras[i + 1 :]:
            if second.name not in group[first.name] and _is_rigid(first, second):
                joined = group[first.name] | group[second.name]
                for name in joined:
                    group[name] = joined
    found = [tuple(camera.name for camera in cameras if camera.name in group[c.name]) for c in cameras]
    return [names for names in dict.fromkeys(found) if len(names) > 1]


def _is_rigid(first: KeyedCamera, second: KeyedCamera) -> bool:
    _, a, b = np.intersect1d(first.frame, second.frame, assume_unique=True, return_indices=True)
    if len(a) < _COMMON:
        return False
    turn = second.rotation[b] @ first.rotation[a].transpose(0, 2, 1)
    shift = np.einsum("kij,kj->ki", first.rotation[a], second.centre[b] - first.centre[a])
    turns = rotation_vector(turn @ mean_rotation(turn.sum(0)).T)
    shifts = shift - np.median(shift, axis=0)
    distance = float(np.linalg.norm(np.median(shift, axis=0)))
    spread_turn, spread_shift = (float(np.sqrt(np.median((d**2).sum(1)))) for d in (turns, shifts))
    most_turn, most_shift = _TURN, _SHIFT * distance
    if spread_turn > most_turn or spread_shift > most_shift:
        return False
    if spread_turn < _STRICT * most_turn and spread_shift < _STRICT * most_shift:
        return True
    return min(_von_neumann(turns), _von_neumann(shifts)) > _WHITE


def _von_neumann(series: np.ndarray) -> float:
    """Mean squared difference of neighbours over the variance (von Neumann 1941), of a series (K, 3)."""
    spread = float(((series - series.mean(0)) ** 2).sum())
    return float((np.diff(series, axis=0) ** 2).sum()) / spread if spread > 0 else 2.0


def fuse_rig(cameras: Sequence[KeyedCamera]) -> Rig:
    """Average the key frames of cameras that keep their places into those of one rig.

    Raises
    ------
    InputError
        The cameras share no key frames.
    """
    frames = np.unique(np.concatenate([camera.frame for camera in cameras]))
    rotation = np.zeros((len(frames), len(cameras), 3, 3))
    centre = np.zeros((len(frames), len(cameras), 3))
    seen = np.zeros((len(frames), len(cameras)), dtype=bool)
    for c, camera in enumerate(cameras):
        k = np.searchsorted(frames, camera.frame)
        rotation[k, c], centre[k, c], seen[k, c] = camera.rotation, camera.centre, True
    averaging = _Averaging(rotation, centre, seen, [camera.name for camera in cameras])
    averaging.settle()
    return averaging.rig(frames)


class _Averaging:
    """Rig poses and sensors, averaged in turn."""

    def __init__(self, rotation: np.ndarray, centre: np.ndarray, seen: np.ndarray, names: list[str]) -> None:
        self._rotation, self._centre, self._names = rotation, centre, names
        self._seen, self._used = seen, seen.copy()
        self._sure = np.ones(len(seen), dtype=bool)
        self._sensor, self._offset = self._start()

    def _start(self) -> tuple[np.ndarray, np.ndarray]:
        """Sensors as the key frames that each shares with one that is placed already have them."""
        n = len(self._names)
        sensor, offset = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        placed = [0]
        while len(placed) < n:
            shared = self._seen.T.astype(int) @ self._seen
            left = [c for c in range(n) if c not in placed]
            a, b = max(((a, b) for a in placed for b in left), key=lambda pair: shared[pair])
            both = self._seen[:, a] & self._seen[:, b]
            if not both.any():
                raise InputError(
                    "These cameras cannot be a rig: they share no key frames.",
                    expected="images of the same frames",
                    found=f"{self._names[a]} and {self._names[b]}",
                    remedy="name the cameras of the rig, or leave rigs alone (--rig none)",
                )
            turn = mean_rotation(
                (self._rotation[both, b] @ self._rotation[both, a].transpose(0, 2, 1)).sum(0)
            )
            step = self._centre[both, b] - self._centre[both, a]
            sensor[b] = turn @ sensor[a]
            in_rig = np.einsum("ji,kjl,kl->ki", sensor[a], self._rotation[both, a], step)
            offset[b] = offset[a] + np.median(in_rig, axis=0)
            placed.append(b)
        return sensor, offset - offset.mean(0)

    def settle(self) -> None:
        """Average until nothing moves; images that are far off leave."""
        for number in range(_ROUNDS):
            self._place_rig()
            before = self._sensor, self._offset
            self._place_sensors()
            left = number > 0 and self._drop()
            moved = np.abs(self._sensor - before[0]).max()
            stepped = np.abs(self._offset - before[1]).max() / max(np.abs(self._offset).max(), 1e-12)
            if number > 2 and not left and moved < 1e-12 and stepped < 1e-12:
                break
        self._place_rig()

    def _place_rig(self) -> None:
        each = np.where(self._used[..., None, None], self._sensor.transpose(0, 2, 1) @ self._rotation, 0.0)
        self._rig = mean_rotation(each.sum(1))
        lever = np.einsum("kji,cj->kci", self._rig, self._offset)
        total = np.where(self._used[..., None], self._centre - lever, 0.0).sum(1)
        self._rig_centre = total / self._used.sum(1)[:, None]

    def _place_sensors(self) -> None:
        used = self._used & self._sure[:, None]
        used = np.where(used.any(0), used, self._used)
        each = self._rotation @ self._rig.transpose(0, 2, 1)[:, None]
        self._sensor = mean_rotation(np.where(used[..., None, None], each, 0.0).sum(0))
        step = np.einsum("kij,kcj->kci", self._rig, self._centre - self._rig_centre[:, None])
        offset = np.where(used[..., None], step, 0.0).sum(0) / used.sum(0)[:, None]
        gauge, shift = self._sensor[0].T, offset.mean(0)
        self._sensor, self._offset = self._sensor @ gauge, (offset - shift) @ self._sensor[0].T

    def _deviations(self) -> tuple[np.ndarray, np.ndarray]:
        """Turns and shifts (K, S, 3) of the images from the rig's; zero where there is no image."""
        ideal = self._sensor @ self._rig[:, None]
        turn = np.zeros(self._centre.shape)
        off = self._rotation[self._seen] @ ideal[self._seen].transpose(0, 2, 1)
        turn[self._seen] = rotation_vector(off)
        lever = np.einsum("kji,cj->kci", self._rig, self._offset)
        shift = np.where(self._seen[..., None], self._centre - self._rig_centre[:, None] - lever, 0.0)
        return turn, shift

    def _far(self) -> np.ndarray:
        """How far images are off (K, S), squared, against what is usual beside others; 1 is the limit."""
        several = self._used & (self._used.sum(1) > 1)[:, None]
        far = np.zeros(self._seen.shape)
        for deviation in self._deviations():
            squared = (deviation**2).sum(2)
            typical = float(np.median(squared[several])) if several.any() else np.inf
            far = np.maximum(far, squared / (_FAR**2 * max(typical, 1e-24)))
        return far

    def _drop(self) -> bool:
        """Let the worst image of each key frame go if it is far off, and others come back; whether any did.

        A wrong image takes the key frame with it, so that the right ones seem wrong: one goes at a time. Of
        two that contradict each other none goes, but their key frame is not sure.
        """
        far, count = self._far(), self._used.sum(1)[:, None]
        worst = far >= np.where(self._used, far, 0.0).max(1)[:, None]
        used = np.where((far > 1.0) & worst & (count > 2), False, self._used) | (self._seen & (far <= 1.0))
        sure = np.asarray(~(used & (far > 1.0)).any(1))
        changed = bool((used != self._used).any() or (sure != self._sure).any())
        self._used, self._sure = used, sure
        return changed

    def rig(self, frames: np.ndarray) -> Rig:
        """The result, with what the deviations tell."""
        turn, shift = self._deviations()
        sure = self._sure if self._sure.any() else ~self._sure
        self._used, count = self._used & sure[:, None], self._used.sum(1)[sure]
        used = self._used
        free = max(float(used.sum() - len(count)), 1.0)  # of each coordinate
        noise = PoseNoise(*(float(np.sqrt((d[used] ** 2).sum() / (3.0 * free))) for d in (turn, shift)))
        ratios = [
            _von_neumann(d[used[:, c], c]) for d in (turn, shift) for c in range(len(self._names))
            if used[:, c].sum() > _COMMON
        ]  # fmt: skip
        place = self._rig[sure]
        translation = -np.einsum("kij,kj->ki", place, self._rig_centre[sure])
        keys = KeyedCamera("rig", _NO_LENS, -1, frames[sure], place, translation)
        return Rig(
            tuple(self._names), self._sensor, self._offset, keys, count, noise,
            float(np.median(ratios)) if ratios else 2.0, self._drift(turn), self._drift(shift),
        )  # fmt: skip

    def _drift(self, deviation: np.ndarray) -> float:
        """Largest change of a sensor from the first to the last third of its images."""
        changes = [0.0]
        for c in range(len(self._names)):
            mine = deviation[self._used[:, c], c]
            third = len(mine) // 3
            if third:
                changes.append(float(np.linalg.norm(mine[-third:].mean(0) - mine[:third].mean(0))))
        return max(changes)
