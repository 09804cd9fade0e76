"""The upright frame of a scene of moving cameras: z up, its origin among the cameras, x along their path.

A structure-from-motion model comes in any gauge. The frame here is made from the cameras themselves, so the
same recording has the same coordinates in every gauge, and it is never mirrored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.scene_gravity import KeyPoses, Up, up_against_view, up_from_cameras
from acino_fte.data_tools.scene_ground import up_from_plane
from acino_fte.data_tools.scene_imu import read_accelerations, up_from_accelerations
from acino_fte.data_tools.similarity import Similarity
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.camera_keys import KeyedCamera

WAYS = ("cameras", "plane", "down", "none")
"""Where gravity may come from, besides a file of accelerations."""

_GROUND, _FACING = 30, 0.87  # points of a ground; cosine of the angle between its normal and the view
_ROUND = 0.95  # second spread of the path over the first, from which it has no main direction
_SOME_WAY = 0.05  # a shift from start to end that counts, as a share of the path's spread


@dataclass(frozen=True, eq=False)
class AxesEstimate:
    """The upright axes, in units of the model: x_upright = rotation @ x_model + translation.

    Attributes
    ----------
    rotation : (3, 3)
        Proper.
    translation : (3,)
    how : str
        Where up comes from.
    tilt_sd : float
        Standard deviation of the tilt, rad; NaN when nothing tells it. It does not know what all frames
        share, as a camera that is mounted askew.
    notes : tuple of str
        What may be wrong with it.
    """

    rotation: np.ndarray
    translation: np.ndarray
    how: str
    tilt_sd: float
    notes: tuple[str, ...] = ()


def upright(
    cameras: Sequence[KeyedCamera], *, gravity: Path | str = "cameras", cloud: object | None = None
) -> AxesEstimate:
    """The upright frame of a scene.

    z points up. The origin is the mean centre of all key frames; with "plane" it is the foot of that on the
    ground. x is the main level direction of the camera paths, from their start to their end; of cameras
    without a path the level part of the image-right direction of the first camera.

    Parameters
    ----------
    cameras : sequence of KeyedCamera
        Of the scene.
    gravity : str or Path
        "cameras": from their paths and how they were held (:func:`scene_gravity.up_from_cameras`);
        "plane": a ground plane of the cloud; "down": the cameras look down; "none": the model's own axes; or
        a CSV file of accelerations (:func:`scene_imu.read_accelerations`).
    cloud : (Q, 3) or object with `xyz`, optional
        Points of the model, for "plane".

    Raises
    ------
    InputError
        The way is unknown, or what it needs is not there.
    """
    keys = KeyPoses.of(cameras)
    if str(gravity) == "none":
        return AxesEstimate(np.eye(3), np.zeros(3), "the model's own axes", float("nan"))
    up = _up(keys, cameras, gravity, cloud)
    z = up.direction
    middle = keys.centre.mean(axis=0)
    x = _level_direction(keys, z)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    shift = -rotation @ middle
    if up.height is not None:
        shift[2] = -up.height
    return AxesEstimate(rotation, shift, up.how, up.sd, up.notes)


def metric_upright(axes: AxesEstimate, factor: float = 1.0) -> Similarity:
    """The similarity from the model to the metric, upright world.

    Parameters
    ----------
    axes : AxesEstimate
        From :func:`upright`.
    factor : float
        Metres per unit of the model (:func:`scene_scale.scene_scale`).
    """
    return Similarity(factor, axes.rotation, factor * axes.translation)


def _over_ground(keys: KeyPoses, guess: Up, cloud: object | None) -> Up:
    """Of a straight path, which tells nothing: up from the ground that cameras look down on, or the guess."""
    points = np.zeros((0, 3)) if cloud is None else np.asarray(getattr(cloud, "xyz", cloud), dtype=float)
    if len(points) < _GROUND:
        return guess
    try:
        plane = up_from_plane(keys, points)
    except InputError:
        return guess
    view = keys.rotation[:, 2].mean(axis=0)
    if -(plane.direction @ view) < _FACING * np.linalg.norm(view):
        return guess
    note = (
        "The path is straight, and the cameras face a plane of the cloud: they are taken to look down on the "
        "ground. Cameras before a wall need another source of gravity."
    )
    return replace(plane, how=f"cameras that look down on a {plane.how}", height=None, notes=(note,))


def _up(keys: KeyPoses, cameras: Sequence[KeyedCamera], gravity: Path | str, cloud: object | None) -> Up:
    if str(gravity) == "cameras":
        up = up_from_cameras(keys)
        return up if np.isfinite(up.sd) else _over_ground(keys, up, cloud)
    if str(gravity) == "down":
        return up_against_view(keys)
    if str(gravity) == "plane":
        points = (
            np.asarray(getattr(cloud, "xyz", cloud), dtype=float) if cloud is not None else np.zeros((0, 3))
        )
        if not len(points):
            raise InputError(
                "Gravity from a plane needs a point cloud.",
                expected="a model with points, or a PLY file",
                found="no points",
                remedy="take gravity from the cameras",
            )
        return up_from_plane(keys, points)
    if not Path(gravity).is_file():
        raise InputError(
            "Where gravity is to come from is unknown.",
            key="gravity",
            expected=f"{', '.join(WAYS)}, or a CSV file of accelerations",
            found=repr(str(gravity)),
        )
    names = [camera.name for camera in cameras]
    return up_from_accelerations(keys, names, read_accelerations(gravity, names))


def _level_direction(keys: KeyPoses, z: np.ndarray) -> np.ndarray:
    """The main level direction of the cameras' centres with its sign; perpendicular to z."""
    level = keys.centre - keys.centre.mean(axis=0)
    level = level - np.outer(level @ z, z)
    value, axes = np.linalg.eigh(level.T @ level / len(level))
    held = _held_direction(keys, z)
    size = max(float(np.linalg.norm(level, axis=1).max()), float(np.abs(keys.centre).max()) * 1e-9)
    spread = np.sqrt(np.maximum(value, 0.0))
    if not spread[2] > 1e-6 * size or spread[1] > _ROUND * spread[2]:
        return held
    along = level @ axes[:, 2]
    n = max(1, len(along) // 10)
    way = float(along[-n:].mean() - along[:n].mean())
    if abs(way) < _SOME_WAY * spread[2]:
        order = np.arange(len(along)) - (len(along) - 1) / 2
        way = float(order @ along) / len(along) / len(along)
        if abs(way) < 0.1 * _SOME_WAY * spread[2]:
            way = float(axes[:, 2] @ held)
    return axes[:, 2] * (1.0 if way >= 0 else -1.0)


def _held_direction(keys: KeyPoses, z: np.ndarray) -> np.ndarray:
    """Image-right of the first camera's first key frame as far as it is level; if it is not, its view."""
    first = int(np.flatnonzero(keys.camera == keys.camera.min())[0])
    right, _, view = keys.rotation[first]
    level = right - (right @ z) * z
    return level if np.linalg.norm(level) > 0.5 else view - (view @ z) * z
