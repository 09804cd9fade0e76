"""What the frames of a scene need of its cameras, and notes on dots and individuals that come to nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.scene_points import PointFit
from acino_fte.data_tools.scene_rows import SceneRows, Views
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError

_BESIDE = 10  # key frames before the first dot and after the last that a path may need
_MOST_FRAMES = 2_000_000
_AGREE = 0.5  # share of a standing camera's dots that agree with other views
_WILD_PX, _FEW = 8.0, 0.6  # noise, and share of the dots seen by several views that agree, worth a warning


def needed_keys(
    cameras: Sequence[KeyedCamera], tracks: Sequence[Tracks2D]
) -> tuple[tuple[KeyedCamera, ...], tuple[int, int] | None]:
    """The cameras with the key frames that the dots need, and the range of the dots' frames, half-open.

    Raises
    ------
    InputError
        The range is so long that frames cannot be counted one by one, as with time stamps.
    """
    seen = [view.frame for view in tracks if len(view)]
    if not seen:
        return tuple(cameras), None
    first, last = int(min(map(np.min, seen))), int(max(map(np.max, seen)))
    if last - first >= _MOST_FRAMES:
        raise InputError(
            "The frames of the tracks are too far apart.",
            expected=f"consecutive numbers of frames, less than {_MOST_FRAMES} from first to last",
            found=f"frames {first} to {last}",
            remedy="number the frames of tracks and images from the start of the recording",
        )
    kept = []
    for camera in cameras:
        low = max(int(np.searchsorted(camera.frame, first)) - _BESIDE, 0)
        high = int(np.searchsorted(camera.frame, last, side="right")) + _BESIDE
        frame = camera.frame[low:high]
        near = np.abs(frame - np.clip(frame, first, last)) <= _MOST_FRAMES // 10
        if not near.any():
            near[np.argmin(np.abs(frame - first))] = True
        chosen = np.arange(low, low + len(frame))[near]
        covariance = None if camera.covariance is None else camera.covariance[chosen]
        kept.append(
            replace(
                camera,
                frame=camera.frame[chosen],
                rotation=camera.rotation[chosen],
                translation=camera.translation[chosen],
                covariance=covariance,
            )
        )
    return tuple(kept), (first, last + 1)


def after_all_moving(cameras: Sequence[KeyedCamera], rows: SceneRows, fit: PointFit) -> set[str]:
    """Cameras with one image that cannot stand still: their dots do not agree with those of other views."""
    several = np.bincount(rows.point, minlength=rows.n_points)[rows.point] >= 2
    moving = set()
    for c, camera in enumerate(cameras):
        mine = several & (rows.camera == c)
        if len(camera.frame) == 1 and mine.any() and fit.used[mine].mean() < _AGREE:
            moving.add(camera.name)
    return moving


def unused_dots(rows: SceneRows, views: Views, tracks: Sequence[Tracks2D]) -> list[str]:
    """Notes on dots that take no part, by their cause."""
    poseless = bare = 0
    for c, view in enumerate(tracks):
        row = view.frame - views.first_frame
        inside = (row >= 0) & (row < views.known.shape[1])
        known = inside.copy()
        known[inside] = views.known[c][row[inside]]
        poseless += int((~known).sum())
        bare += int((known & (view.track < 0)).sum())
    outside = sum(len(view) for view in tracks) - len(rows.point) - poseless - bare
    notes = []
    if poseless:
        notes.append(
            f"{poseless} dots are not used: the pose of their camera is not known in their frame (before, "
            "after, or far from its key frames)."
        )
    if bare:
        notes.append(f"{bare} dots are not used: they belong to no individual.")
    if outside:
        notes.append(f"{outside} dots are not used: they lie outside of what their lens can see.")
    return notes


def misfits(rows: SceneRows, fit: PointFit) -> list[str]:
    """A note where dots of several views do not agree: cameras and tracks may not belong together."""
    several = np.bincount(rows.point, minlength=rows.n_points)[rows.point] >= 2
    if not several.any():
        return []
    share = float(fit.used[several].mean())
    if fit.noise.px <= _WILD_PX and share >= _FEW:
        return []
    return [
        f"Dots and cameras do not fit: the noise is {fit.noise.px:.1f} px, and {share:.0%} of the dots that "
        "several views have of an individual agree. Check that images and tracks count the same frames, that "
        "the tracks were made on images of the model's size, and the names of cameras and individuals."
    ]


def unseen_individuals(names: Sequence[str], found: np.ndarray) -> list[str]:
    """A note on individuals without a track."""
    there = set(np.unique(found).tolist())
    missing = [name for i, name in enumerate(names) if i not in there]
    if not missing:
        return []
    listed = ", ".join(missing[:10]) + (", …" if len(missing) > 10 else "")
    return [f"No two views see these individuals at one time: {listed}. They have no 3D track."]
