"""A recording of animals without markers from a folder: the cameras, and the 2D tracks of each.

``load_tracks(folder)`` finds the camera file and the tracks; both can be named instead. Cameras and tracks
are joined by name, never by their order: ``cam0.csv`` belongs to the camera "cam0", or to that with the id
"0". ``docs/track_formats.md`` lists what a folder may hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.track_files import (
    read_joint_table,
    read_track_table,
    read_true_animals,
    read_truth_3d,
)
from acino_fte.data_tools.track_names import cameras_of, join_by_place, looks_like_camera
from acino_fte.data_tools.tracks2d import TrackRecording

_TRUTH_3D = "truth_3d.csv"


def load_tracks(
    path: Path | str,
    *,
    cameras: CameraArray | Path | str | None = None,
    tracks: Path | str | Sequence[Path | str] | Mapping[str, Path | str] | None = None,
    fps: float | None = None,
) -> TrackRecording:
    """Read the cameras and the 2D tracks of a recording.

    Parameters
    ----------
    path : Path
        The folder.
    cameras : CameraArray or Path, optional
        The cameras or their file; by default the one camera file in the folder.
    tracks : Path, sequence of Path or mapping, optional
        One file with the tracks of all cameras, or one file for each camera, joined by name or given as
        camera → file; by default what the folder holds.
    fps : float, optional
        Frames per second, > 0.

    Returns
    -------
    TrackRecording

    Raises
    ------
    InputError
        A file is missing, cannot be read, or does not fit the others; the message names it and the remedy.
    """
    folder = Path(path)
    if not isinstance(cameras, CameraArray):
        from acino_fte.data_tools.track_cameras import read_track_cameras

        rig = read_track_cameras(folder / "cameras.json" if cameras is None else cameras)
    else:
        rig = cameras
    views = []
    joint = folder / "points_2d.csv"
    if joint.exists():
        found = read_joint_table(joint)
        places = join_by_place(found, len(rig)) or {}
        by_camera = {rig.names[i]: found[name] for name, i in places.items()}
        views = [replace(by_camera[name], camera=name) for name in rig.names]
    else:
        files = {
            c: p
            for p in sorted(folder.glob("cam*.csv"))
            for c in cameras_of(p.stem, rig.names)
            if looks_like_camera(p.stem)
        }
        for name in rig.names:
            view = read_track_table(files[name], name)
            truth = files[name].with_name(files[name].stem + "_truth.csv")
            if truth.exists():
                n = len(view) + (0 if view.left_out is None else len(view.left_out))
                view = replace(view, animal=read_true_animals(truth, n)[view.row])
            views.append(view)
    truth = folder / _TRUTH_3D
    return TrackRecording(
        name=folder.resolve().name,
        cameras=rig,
        views=tuple(views),
        fps=fps,
        truth_3d=read_truth_3d(truth) if truth.exists() else None,
    )
