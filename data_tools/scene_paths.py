"""The paths of all cameras of a scene: rigs are found and fused, other cameras stand alone."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.camera_paths import CameraPath, PoseNoise, camera_path
from acino_fte.data_tools.rigs import Rig, find_rigs, fuse_rig, mean_rotation
from acino_fte.data_tools.scene_rows import Views, make_views
from acino_fte.errors import InputError

RigChoice = str | Sequence[Sequence[str]]
_TURN_PX, _DISTANCE = 1.0, 100.0  # of poses that nothing is known of: pixels, and shift as a part of distance
_STILL = 3.0  # spread of a camera's key frames in standard deviations of an axis, below which it stands still
_STANDS = "Camera '{}' has one image with a pose: it is taken to stand still."
_MOVES = (
    "Camera '{}' has one image with a pose, and its dots show that it moved: it counts in that frame only. "
    "Register more of its images."
)
_LONG_DRIFT = 3.0  # a sensor's drift in standard deviations of an image's pose that is worth a word


@dataclass(frozen=True, eq=False)
class ScenePaths:
    """Paths of the C cameras.

    Attributes
    ----------
    paths : tuple of CameraPath
        One for each camera.
    rigs : tuple of Rig
    views : Views
        The cameras with their paths.
    noise : dict of str to PoseNoise
        Of a key frame of each camera.
    notes : tuple of str
        What a user should know.
    """

    paths: tuple[CameraPath, ...]
    rigs: tuple[Rig, ...]
    views: Views
    noise: dict[str, PoseNoise]
    notes: tuple[str, ...]


def scene_paths(
    cameras: Sequence[KeyedCamera],
    *,
    rig: RigChoice = "auto",
    declared: Sequence[tuple[str, ...]] = (),
    max_gap: float | None = None,
    frames: tuple[int, int] | None = None,
    not_standing: Collection[str] = (),
) -> ScenePaths:
    """The paths of all cameras.

    Parameters
    ----------
    cameras : sequence of KeyedCamera
        Of the scene.
    rig : "auto", "none", or sequence of sequences of names
        Which cameras keep their places to each other.
    declared : sequence of tuple of str
        Rigs for "auto", besides those that are found.
    max_gap : float, optional
        Frames between key frames beyond which nothing is invented.
    frames : (first, last + 1), optional
        Of cameras that stand still, known from one image.
    not_standing : collection of str
        Cameras with one image that do move: their pose is known in that frame only.

    Raises
    ------
    InputError
        A rig names cameras that are not there, or cameras that cannot be one.
    """
    moving = [camera for camera in cameras if len(_standing(camera, pose_noise(camera))[0].frame) > 1]
    found = _Gathered({camera.name: camera for camera in cameras}, max_gap)
    for names in _chosen(rig, moving if rig == "auto" else cameras, declared):
        found.add_rig(names)
    extent = _extent(cameras)
    for camera in cameras:
        if camera.name not in found.paths:
            stands = camera.name not in not_standing
            found.add_alone(camera, extent, frames if stands else None, stands)
    alone = [camera for camera in moving if all(camera.name not in one.names for one in found.rigs)]
    attached = len(found.bases) > 1 and bool(find_rigs(alone))
    ordered = tuple(found.paths[camera.name] for camera in cameras)
    base = [found.base[camera.name] for camera in cameras]
    views = make_views([camera.lens for camera in cameras], ordered, found.bases, base, attached)
    return ScenePaths(ordered, tuple(found.rigs), views, found.noise, tuple(found.notes))


class _Gathered:
    """Paths by the name of their camera, and what errs as one."""

    def __init__(self, cameras: dict[str, KeyedCamera], max_gap: float | None) -> None:
        self._cameras, self._max_gap = cameras, max_gap
        self.rigs: list[Rig] = []
        self.paths: dict[str, CameraPath] = {}
        self.noise: dict[str, PoseNoise] = {}
        self.bases: list[CameraPath] = []
        self.base: dict[str, int] = {}
        self.notes: list[str] = []

    def add_rig(self, names: Sequence[str]) -> None:
        """Cameras that keep their places, with one path."""
        rig = fuse_rig([self._cameras[name] for name in names])
        share = 1.0 / np.sqrt(rig.count)
        noise = PoseNoise(rig.noise.turn * share, rig.noise.shift * share)
        middle = camera_path(rig.keys, noise, max_gap=self._max_gap)
        for name in rig.names:
            path = rig.sensor_path(middle, name)
            own = path.key & np.isin(path.frame, self._cameras[name].frame)
            self.paths[name], self.noise[name] = replace(path, key=own), rig.noise
            self.base[name] = len(self.bases)
        self.bases.append(middle)
        self.rigs.append(rig)
        self.notes += _drift_notes(rig)

    def add_alone(
        self, camera: KeyedCamera, extent: float, frames: tuple[int, int] | None, stands: bool
    ) -> None:
        """A camera by itself."""
        name, single = camera.name, len(camera.frame) == 1
        camera, self.noise[name] = _standing(camera, pose_noise(camera, extent))
        self.paths[name] = camera_path(camera, self.noise[name], max_gap=self._max_gap, frames=frames)
        self.base[name] = len(self.bases)
        self.bases.append(self.paths[name])
        if single:
            self.notes.append((_STANDS if stands else _MOVES).format(name))


def _extent(cameras: Sequence[KeyedCamera]) -> float:
    """How far the cameras are from each other, or move: root mean square from their middle."""
    centres = np.concatenate([camera.centre for camera in cameras])
    return float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))


def _standing(camera: KeyedCamera, noise: PoseNoise) -> tuple[KeyedCamera, PoseNoise]:
    """A camera whose key frames all have one pose, within their errors, as one with a single key frame."""
    if len(camera.frame) == 1:
        return camera, noise
    centre, rotation = camera.centre.mean(0), mean_rotation(camera.rotation.sum(0))
    spread = float(np.sqrt(((camera.centre - centre) ** 2).sum(1).mean()))
    turn = np.trace(camera.rotation @ rotation.T, axis1=1, axis2=2)
    angle = np.arccos(np.clip(0.5 * (turn - 1.0), -1.0, 1.0))
    if spread > _STILL * noise.shift or float(np.sqrt((angle**2).mean())) > _STILL * noise.turn:
        return camera, noise
    one = KeyedCamera(
        camera.name,
        camera.lens,
        camera.model_id,
        camera.frame[:1],
        rotation[None],
        -(rotation @ centre)[None],
    )
    share = 1.0 / np.sqrt(len(camera.frame))
    return one, PoseNoise(noise.turn * share, noise.shift * share, noise.shape)


def pose_noise(camera: KeyedCamera, extent: float = 0.0) -> PoseNoise:
    """How far the key frames of a camera are off, from their covariances.

    One number for all key frames, the median: what observations in a single image say of its own pose is
    itself noisy. Without covariances a pixel's angle, and a hundredth of the way between key frames, or of
    the extent of all cameras.

    Parameters
    ----------
    camera : KeyedCamera
        With or without covariances.
    extent : float
        Of all cameras, for one that has a single key frame.
    """
    if camera.covariance is not None:
        known = np.isfinite(camera.covariance).all((1, 2))
        covariance = camera.covariance[known]
        variances = np.einsum("kii->ki", covariance)
        turn, shift = np.sqrt(variances[:, :3].mean(1)), np.sqrt(variances[:, 3:].mean(1))
        if known.any() and (turn > 0).all() and (shift > 0).all():
            to_camera = np.tile(np.eye(6), (len(covariance), 1, 1))
            to_camera[:, 3:, 3:] = camera.rotation[known]
            unit = np.repeat(np.stack([turn, shift], axis=1), 3, axis=1)
            shape = to_camera @ covariance @ to_camera.transpose(0, 2, 1) / (unit[:, :, None] * unit[:, None])
            return PoseNoise(float(np.median(turn)), float(np.median(shift)), shape.mean(0))
    steps = np.linalg.norm(np.diff(camera.centre, axis=0), axis=1)
    way = float(np.median(steps)) if len(steps) else extent
    return PoseNoise(_TURN_PX / camera.lens.matrix[0, 0], max(way / _DISTANCE, 1e-12))


def _chosen(
    rig: RigChoice, cameras: Sequence[KeyedCamera], declared: Sequence[tuple[str, ...]]
) -> list[tuple[str, ...]]:
    """The names of each rig."""
    if isinstance(rig, str):
        if rig == "none":
            return []
        if rig == "auto":
            known = {name for group in declared for name in group}
            return [*declared, *find_rigs([camera for camera in cameras if camera.name not in known])]
        rig = [[name.strip() for name in group.split(",")] for group in rig.split(";")]
    names = [camera.name for camera in cameras]
    given = [tuple(group) for group in rig]
    flat = [name for group in given for name in group]
    strangers = [name for name in flat if name not in names]
    if strangers or len(set(flat)) != len(flat) or any(len(group) < 2 for group in given):
        raise InputError(
            "The rig cannot be made.",
            key="rig",
            expected=f"auto, none, or two or more of {', '.join(names)}, each once",
            found=", ".join(strangers or flat),
        )
    return given


def _drift_notes(rig: Rig) -> list[str]:
    third = max(len(rig.count) // 3, 1)  # a drift is the greatest difference of two means of so many images
    worth = _LONG_DRIFT * max(1.0, 2.0 * float(np.sqrt(2.0 / third)))
    turn, shift = float(np.max(rig.noise.turn)), float(np.max(rig.noise.shift))
    if rig.drift_turn < worth * turn and rig.drift_shift < worth * shift:
        return []
    return [
        f"The rig of {', '.join(rig.names)} is not rigid: one turned by {np.degrees(rig.drift_turn):.2g}°"
        f" and moved by {rig.drift_shift:.2g} units between the first and the last third of its images."
    ]
