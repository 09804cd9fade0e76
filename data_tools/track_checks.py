"""Do the 2D tracks of a recording fit their images, their cameras and each other?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.checks import same_pose_warnings
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError

_OUTSIDE, _BORDER = 0.05, 0.02  # of the dots, of the image: as for keypoints
_LONG, _SPARSE = 1_000_000, 100  # frames from the first to the last, and for each frame with a dot
_FAR = 0.1  # of the image: noise and clutter at its edge are nothing to warn of


def check_tracks(views: Sequence[Tracks2D], cameras: CameraArray) -> list[str]:
    """Refuse tracks that cannot be matched; warn of what looks wrong.

    Parameters
    ----------
    views : sequence of Tracks2D
        One for each camera.
    cameras : CameraArray
        In the same order.

    Returns
    -------
    list of str
        Warnings: rows without coordinates, cameras without dots or with dots far outside the image, cameras
        with one and the same pose.

    Raises
    ------
    InputError
        More than 5 % of a camera's dots lie clearly outside its image, no two cameras have dots in the same
        frame, or the frames are no numbers of images.
    """
    warnings = []
    for view, camera in zip(views, cameras, strict=True):
        if view.left_out is not None:
            warnings.append(
                f"{len(view.left_out)} rows of camera '{view.camera}' have no coordinates: they are left out."
            )
        if not len(view):
            warnings.append(f"Camera '{view.camera}' has no dots.")
        else:
            warnings += _check_image(view, camera.resolution)
    _check_frames(views)
    return warnings + same_pose_warnings(cameras)


def _check_image(view: Tracks2D, resolution: tuple[int, int]) -> list[str]:
    size = np.array(resolution)
    beyond = (np.maximum(-view.xy, view.xy - size) / size).max(-1)
    outside = beyond > _BORDER
    if outside.mean() > _OUTSIDE:
        low, high = np.percentile(view.xy, [1, 99], axis=0)
        raise InputError(
            f"The dots of camera '{view.camera}' do not fit into its image: they were found in a video of "
            "another size, or belong to another camera.",
            file=view.path,
            key=view.camera,
            expected=f"x and y inside {size[0]}×{size[1]} px, the resolution of the calibration",
            found=f"x from {low[0]:.0f} to {high[0]:.0f}, y from {low[1]:.0f} to {high[1]:.0f}; "
            f"{outside.mean():.0%} outside",
            remedy="use the calibration of that resolution, or scale the dots to the calibrated one",
        )
    far = beyond > _FAR
    if far.any():
        row = int(np.argmax(far))
        x, y = view.xy[row]
        return [
            f"{far.sum()} of {len(view)} dots of camera '{view.camera}' lie far outside its image "
            f"({size[0]}×{size[1]} px), the first in frame {view.frame[row]} at ({x:.0f}, {y:.0f})."
        ]
    return []


def _check_frames(views: Sequence[Tracks2D]) -> None:
    """Some frame has dots in two cameras, and frames count images."""
    seeing = [view for view in views if len(view)]
    frames = [np.unique(view.frame) for view in seeing]
    if len(seeing) >= 2:
        seen, n_cameras = np.unique(np.concatenate(frames), return_counts=True)
        n_frames = int(seen[-1] - seen[0]) + 1
        if n_frames > max(_LONG, _SPARSE * len(seen)):
            raise InputError(
                "The frames are far apart: they are hardly numbers of images.",
                file=seeing[0].path,
                key="frame",
                expected="0, 1, 2, …, an image each",
                found=f"{len(seen)} different frames from {seen[0]} to {seen[-1]}",
                remedy="count images, not time stamps; or mend the row with the last frame",
            )
        if n_cameras.max() >= 2:
            return
    ranges = ", ".join(
        f"{v.camera}: {v.frame.min()} to {v.frame.max()}" if len(v) else f"{v.camera}: none" for v in views
    )
    raise InputError(
        "No two cameras have dots in the same frame: there is nothing to match.",
        file=views[0].path,
        expected="frames counted from one moment in all cameras",
        found=ranges,
        remedy="check which files belong together, and from where their frames are counted",
    )


def frames_of_moving(cameras: CameraArray, views: Sequence[Tracks2D]) -> CameraArray:
    """Cameras with the poses of the frames that have dots, from the first to the last.

    In a file pose n of a moving camera belongs to frame n; where there are exactly as many poses as frames
    with dots, from the first to the last, they belong to those.

    Raises
    ------
    InputError
        A moving camera has too few poses.
    """
    first = min((int(view.frame.min()) for view in views if len(view)), default=0)
    stop = 1 + max((int(view.frame.max()) for view in views if len(view)), default=-1)
    result = []
    for camera in cameras:
        counts = {len(camera.rotation)} if camera.rotation.ndim == 3 else set()
        counts |= {len(camera.translation)} if camera.translation.ndim == 2 else set()
        for n_poses in counts:
            if n_poses != stop - first and n_poses < stop:
                raise InputError(
                    f"The moving camera '{camera.name}' has too few poses.",
                    key=camera.name,
                    expected=f"one for each frame up to the last with a dot, {stop - 1}: {stop}",
                    found=str(n_poses),
                    remedy="write a pose for every frame, or a single one for a fixed camera",
                )
        exact = counts <= {stop - first}
        result.append(camera if exact else camera.at_frames(slice(first, stop)))
    return CameraArray(tuple(result))
