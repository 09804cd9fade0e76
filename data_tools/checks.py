"""Checks of a recording as a whole: lengths, emptiness, image size, poses of moving cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.keypoints import Keypoints
from acino_fte.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

_SHORTER = 0.05  # cameras started and stopped by hand differ by a few frames, not by a twentieth
_FEW = 2
_OUTSIDE = 0.05
_BORDER = 0.02  # networks place hidden points a little outside the image


def check_lengths(keypoints: Mapping[str, Keypoints]) -> list[str]:
    """Warn of keypoint files that end a little early; refuse those that end much earlier.

    Videos of one recording often differ by a frame or two at their end, and those frames are simply not
    seen. A larger difference means that a video was cut or belongs to another recording, and then frame n
    of one is not frame n of the other.

    Raises
    ------
    InputError
        A file is shorter than the longest by more than 5 % (and more than two frames).
    """
    lengths = {camera: table.n_frames for camera, table in keypoints.items()}
    longest, shortest = max(lengths.values()), min(lengths.values())
    if longest == shortest:
        return []
    listed = ", ".join(f"{camera}: {n}" for camera, n in lengths.items())
    if longest - shortest > max(_FEW, _SHORTER * longest):
        camera = min(lengths, key=lambda c: lengths[c])
        raise InputError(
            "The cameras' keypoints differ in length: frame n of one is hardly frame n of another.",
            file=keypoints[camera].path,
            key=camera,
            expected=f"about {longest} frames",
            found=f"frames per camera {listed}",
            remedy="analyse videos cut to the same start and stop, or leave this camera out in sequence.yaml",
        )
    return [
        f"The cameras' keypoints differ in length ({listed}). Frames are counted from the start of each; "
        "the missing ones at the end are taken as not seen."
    ]


def check_poses(cameras: CameraArray, n_frames: int, path: str) -> None:
    """A moving camera has one pose per frame of the recording.

    Raises
    ------
    InputError
        It has more or fewer.
    """
    for camera in cameras:
        for key, value, ndim in (("rotation", camera.rotation, 3), ("translation", camera.translation, 2)):
            if value.ndim == ndim and len(value) != n_frames:
                raise InputError(
                    f"The moving camera '{camera.name}' has not one {key} for each frame.",
                    file=path,
                    key=f"{camera.name}.{key}",
                    expected=f"{n_frames}, as many as its keypoints have frames",
                    found=f"{len(value)}",
                    remedy="write a pose for every frame, or a single one for a fixed camera",
                )


def same_pose_warnings(cameras: CameraArray) -> list[str]:
    """Warn of fixed cameras with one and the same pose: an entry of the calibration was copied."""
    return [
        f"Cameras '{a.name}' and '{b.name}' have the very same position and orientation: one of them may be "
        "a copy of the other in the camera file."
        for a, b in combinations((camera for camera in cameras if not camera.moves), 2)
        if np.array_equal(a.rotation, b.rotation) and np.array_equal(a.translation, b.translation)
    ]


def check_detections(
    detections: xr.Dataset, cameras: CameraArray, paths: Sequence[str | Path], likelihood: float
) -> list[str]:
    """Refuse detections that are empty or do not fit their images; warn of cameras that see nothing.

    Parameters
    ----------
    detections : xarray.Dataset
        As in :class:`~acino_fte.sequence.Sequence`.
    cameras : CameraArray
        In the same order.
    paths : sequence of Path
        The keypoint files in the same order, for the messages.
    likelihood : float
        Detections above it count.

    Raises
    ------
    InputError
        Every detection is NaN, or more than 5 % of a camera's confident detections lie clearly outside its
        image: they were made in a video of another size.
    """
    position = detections.position.values
    sure = (detections.likelihood.values > likelihood) & np.isfinite(position).all(-1)
    if not np.isfinite(position).any():
        raise InputError(
            "There is not one detection: every coordinate is missing.",
            file=paths[0],
            found=f"NaN everywhere in {len(paths)} keypoint files",
            remedy="analyse the videos again, or check that the columns are not empty",
        )
    warnings = []
    for c, camera in enumerate(cameras):
        points = position[:, c][sure[:, c]]
        if len(points) == 0:
            warnings.append(
                f"Camera '{camera.name}' has no detection with a likelihood above {likelihood:g}."
            )
            continue
        _check_image_size(points, camera.name, camera.resolution, paths[c])
    return warnings


def _check_image_size(points: np.ndarray, camera: str, resolution: tuple[int, int], path: str | Path) -> None:
    size = np.array(resolution)
    border = _BORDER * size
    outside = ((points < -border) | (points > size + border)).any(-1)
    if outside.mean() > _OUTSIDE:
        low, high = np.percentile(points, [1, 99], axis=0)
        raise InputError(
            f"The detections of camera '{camera}' do not fit into its image: they were made in a video of "
            "another size.",
            file=path,
            key=camera,
            expected=f"u and v inside {size[0]}×{size[1]} px, the resolution of the calibration",
            found=f"u from {low[0]:.0f} to {high[0]:.0f}, v from {low[1]:.0f} to {high[1]:.0f}; "
            f"{outside.mean():.0%} outside",
            remedy="use the calibration of that resolution, or scale the detections to the calibrated one",
        )
