"""What structure from motion finds in a simulated scene: key frames' poses with errors, landmarks.

Shapes: N frames, C cameras, L landmarks, O observations of landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera
from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.scene_motions import Signal, landmarks
from acino_fte.data_tools.simulated_views import in_bursts, in_view

if TYPE_CHECKING:
    from acino_fte.data_tools.simulate_scene import SceneSimulation

_CHUNK = 100  # images looked at together
_FEWEST = 8  # landmarks of an image whose pose comes from them


@dataclass(frozen=True, eq=False)
class SceneStructure:
    """Poses of key frames and landmarks, in the true world (z up, m).

    Attributes
    ----------
    cameras : tuple of KeyedCamera
        With errors in their poses.
    landmarks : (L, 3)
        With errors.
    true_landmarks : (L, 3)
    rgb : (L, 3) uint8
    error : (L,)
        Mean reprojection error, px.
    camera : (O,)
        Which camera saw a landmark.
    frame : (O,)
        In which of its frames.
    landmark : (O,)
        Index into `landmarks`. Observations are sorted by camera and frame; a landmark has two or more.
    xy : (O, 2)
        Where in the image, px, pixel centres at integers.
    """

    cameras: tuple[KeyedCamera, ...]
    landmarks: np.ndarray
    true_landmarks: np.ndarray
    rgb: np.ndarray
    error: np.ndarray
    camera: np.ndarray
    frame: np.ndarray
    landmark: np.ndarray
    xy: np.ndarray


def simulate_structure(
    options: SceneSimulation, cameras: tuple[Camera, ...], target: Signal, rng: np.random.Generator
) -> SceneStructure:
    """Simulate what structure from motion finds.

    Parameters
    ----------
    options : SceneSimulation
        What to simulate.
    cameras : tuple of Camera
        With a true pose for each frame.
    target : callable
        What they follow.
    rng : numpy.random.Generator
        Source of all that is random.
    """
    seconds = options.n_frames / options.fps
    spread = 1.3 * options.distance
    points = landmarks(options.path, target, options.n_landmarks, seconds, spread, options.relief, rng)
    keys = [_key_frames(options, rng) for _ in cameras]
    seen = [_observations(options, c, points, key, rng) for c, key in zip(cameras, keys, strict=True)]
    poses = []
    for c, (camera, key) in enumerate(zip(cameras, keys, strict=True)):
        frame, landmark, noise = seen[c]
        if options.resection:
            key, error = _resected(camera, key, frame, points[landmark], noise)
            seen[c] = tuple(a[np.isin(frame, key)] for a in seen[c])  # type: ignore[assignment]
        else:
            sd = [np.radians(options.turn_noise)] * 3 + [options.centre_noise] * 3
            error = np.array(sd) * rng.normal(size=(len(key), 6))
        poses.append(_keyed(options, c, camera, key, error))
    which = np.repeat(np.arange(len(cameras)), [len(frame) for frame, _, _ in seen])
    frame, landmark, noise = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    return _assembled(options, cameras, tuple(poses), points, (which, frame, landmark, noise), rng)


def _key_frames(options: SceneSimulation, rng: np.random.Generator) -> np.ndarray:
    """Registered key frames; the first and the last always, so that the paths have their ends."""
    frames = np.arange(0, options.n_frames, options.key_step)
    lost = in_bursts(options.unregistered, 2.0, (len(frames), 1), rng)[:, 0]
    lost[[0, -1]] = False
    return frames[~lost]


def _observations(
    options: SceneSimulation, camera: Camera, points: np.ndarray, key: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frame, landmark and pixel noise (O, 2) of what one camera sees, a random choice in each image."""
    found: list[np.ndarray] = []
    for start in range(0, len(key), _CHUNK):
        frames = key[start : start + _CHUNK]
        there = camera.at_frames(frames)
        local = points @ np.swapaxes(there.rotation, 1, 2) + there.translation[:, None]
        visible = in_view(camera, local)
        lot = np.full(visible.shape, 2.0)
        lot[visible] = rng.random(np.count_nonzero(visible))
        last = min(options.landmarks_per_image, len(points)) - 1
        drawn = lot <= np.partition(lot, last, axis=1)[:, [last]] if last >= 0 else visible & False
        image, landmark = np.nonzero(visible & drawn)
        found.append(np.stack([frames[image], landmark]))
    frame, landmark = np.concatenate(found, axis=1)
    return frame, landmark, options.landmark_noise_px * rng.normal(size=(len(frame), 2))


def _resected(
    camera: Camera, key: np.ndarray, frame: np.ndarray, points: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Images that have enough landmarks, and the errors (K, 6) that their noise makes in a linear resection.

    Turn in the camera's frame (rad) and shift of the centre: d x_camera = turn × x_camera − R · shift.
    """
    there = camera.at_frames(frame)
    slope = there.project_with_jacobian(points[:, None])[1][:, 0]  # for the world point, (O, 2, 3)
    local = there.to_camera(points[:, None])[:, 0]
    by_turn = np.cross(local[:, None], np.einsum("oij,okj->oik", slope, there.rotation))
    jacobian = np.concatenate([by_turn, -slope], axis=-1)
    image = np.searchsorted(key, frame)
    normal, right = np.zeros((len(key), 6, 6)), np.zeros((len(key), 6))
    np.add.at(normal, image, np.einsum("oia,oib->oab", jacobian, jacobian))
    np.add.at(right, image, np.einsum("oia,oi->oa", jacobian, noise))
    enough = np.bincount(image, minlength=len(key)) >= _FEWEST
    return key[enough], np.linalg.solve(normal[enough], right[enough][..., None])[..., 0]


def _keyed(
    options: SceneSimulation, number: int, camera: Camera, key: np.ndarray, error: np.ndarray
) -> KeyedCamera:
    """A camera with errors (K, 6) in its poses: turn in the camera's frame (rad), shift of the centre."""
    there = camera.at_frames(key)
    rotation = Rotation.from_rotvec(error[:, :3]).as_matrix() @ there.rotation
    centre = there.centre + error[:, 3:]
    lens = replace(camera, rotation=np.eye(3), translation=np.zeros(3))
    model_id = 1 if options.shared_lens else number + 1
    return KeyedCamera(camera.name, lens, model_id, key, rotation, -np.einsum("kij,kj->ki", rotation, centre))


def _assembled(
    options: SceneSimulation,
    cameras: tuple[Camera, ...],
    poses: tuple[KeyedCamera, ...],
    points: np.ndarray,
    seen: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> SceneStructure:
    """Landmarks that two images or more see, and what sees them."""
    which, frame, landmark, noise = seen
    kept = np.bincount(landmark, minlength=len(points)) >= 2
    rows = kept[landmark]
    which, frame, noise = which[rows], frame[rows], noise[rows]
    landmark = (np.cumsum(kept) - 1)[landmark[rows]]
    true = points[kept]
    found = true + options.landmark_noise * rng.normal(size=true.shape)
    xy, missed = np.empty((len(frame), 2)), np.empty(len(frame))
    for c, (camera, keyed) in enumerate(zip(cameras, poses, strict=True)):
        own = which == c
        xy[own] = camera.at_frames(frame[own]).project(true[landmark[own]][:, None])[:, 0] + noise[own]
        k = np.searchsorted(keyed.frame, frame[own])
        local = np.einsum("oij,oj->oi", keyed.rotation[k], found[landmark[own]]) + keyed.translation[k]
        missed[own] = np.linalg.norm(keyed.lens.project(local) - xy[own], axis=-1)
    error = np.bincount(landmark, missed, len(true)) / np.bincount(landmark, minlength=len(true))
    grey = rng.integers(60, 200, len(true))
    green = np.clip(grey * [[0.7], [1.0], [0.5]], 0, 255).T
    return SceneStructure(poses, found, true, green.astype(np.uint8), error, which, frame, landmark, xy)
