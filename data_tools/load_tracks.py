"""A recording of animals without markers from a folder: the cameras, and the 2D tracks of each.

``load_tracks(folder)`` finds the camera file and the tracks; both can be named instead. Cameras and tracks
are joined by name, never by their order. ``docs/track_formats.md`` says what a folder may hold.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.dltdv_files import is_xypts, read_xypts, read_xyzpts
from acino_fte.data_tools.track_cameras import read_track_cameras
from acino_fte.data_tools.track_checks import check_tracks, frames_of_moving
from acino_fte.data_tools.track_files import (
    has_camera_column,
    read_joint_table,
    read_track_table,
    read_true_animals,
    read_truth_3d,
)
from acino_fte.data_tools.track_names import cameras_of, counted, looks_like_camera, same_name
from acino_fte.data_tools.tracker_exports import (
    exporter,
    read_idtracker,
    read_sleap,
    read_trex,
)
from acino_fte.data_tools.tracker_folders import NO_TRACKS, TABLES, export_files
from acino_fte.data_tools.tracks2d import TrackRecording, Tracks2D
from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

_CAMERA_FILES = ("cameras.json", "cameras.toml", "calibration.toml")
_DLT = re.compile(r".*dlt.*coef.*\.(csv|txt)", re.IGNORECASE)
_TRUTH_3D, _TRUTH = "truth_3d.csv", "_truth"

Given = Path | str | Sequence[Path | str] | Mapping[str, Path | str]


@dataclass(frozen=True)
class _Options:
    node: str | None
    cm_per_pixel: float | None


def load_tracks(
    path: Path | str,
    *,
    cameras: CameraArray | Path | str | None = None,
    tracks: Given | None = None,
    fps: float | None = None,
    truth_3d: Path | str | None = None,
    resolution: tuple[int, int] | None = None,
    camera_unit: str = "m",
    node: str | None = None,
    cm_per_pixel: float | None = None,
) -> TrackRecording:
    """Read the cameras and the 2D tracks of a recording.

    Parameters
    ----------
    path : Path
        The folder, or a file with the tracks of all cameras in the folder.
    cameras : CameraArray or Path, optional
        The cameras or their file; by default the one camera file in the folder.
    tracks : Path, sequence of Path or mapping, optional
        One file with the tracks of all cameras; or one file (or export folder) for each camera, joined by
        name or given as camera → file. Cameras without a file are left out then. By default what the folder
        holds, for every camera.
    fps : float, optional
        Frames per second.
    truth_3d : Path, optional
        True positions, for scoring: a table with frame, animal, x, y, z (m), or DLTdv's ``…xyzpts``; by
        default ``truth_3d.csv`` of the folder, when it is there.
    resolution : (width, height), optional
        Of the images, px; DLT coefficients do not say it.
    camera_unit : {"m", "cm", "mm"}
        Unit of the positions in the camera file.
    node : str, optional
        The node of SLEAP's files that stands for the animal; by default the mean of all.
    cm_per_pixel : float, optional
        TRex's setting of that name, where its files do not say it.

    Returns
    -------
    TrackRecording
        Its cameras in the order of their file.

    Raises
    ------
    InputError
        A file is missing, cannot be read, or does not fit the others; the message names it and the remedy.
    """
    folder, tracks = _folder(Path(path), tracks)
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise InputError("The frame rate is impossible.", key="fps", expected="> 0", found=f"{fps:g}")
    used: list[Path] = []
    if isinstance(cameras, CameraArray):
        rig = cameras
    else:
        file = _camera_file(folder) if cameras is None else Path(cameras)
        rig = read_track_cameras(file, resolution=resolution, unit=camera_unit)
        used.append(file)
    _at_least_two(rig, used[0] if used else folder)
    given = _find(folder, rig, used) if tracks is None else tracks
    views, notes = _views(given, rig, _Options(node, cm_per_pixel))
    missing = [name for name in rig.names if name not in views]
    if missing:
        notes.append(f"No tracks for {_some(missing)}: left out.")
        rig = CameraArray(tuple(camera for camera in rig if camera.name in views))
        _at_least_two(rig, folder)
    ordered = tuple(views[name] for name in rig.names)
    notes += check_tracks(ordered, rig)
    return TrackRecording(
        name=folder.resolve().name,
        cameras=frames_of_moving(rig, ordered),
        views=ordered,
        fps=fps,
        truth_3d=_truth_3d(folder, truth_3d),
        warnings=tuple(notes),
    )


def _folder(path: Path, tracks: Given | None) -> tuple[Path, Given | None]:
    if path.is_dir():
        return path, tracks
    if path.is_file() and tracks is None:
        return path.parent, path
    found = "a file" if path.exists() else "nothing"
    raise InputError(
        "There is no such recording.",
        file=path,
        expected="a folder with a camera file and the tracks of each camera",
        found=found,
        remedy="check the path",
    )


def _camera_file(folder: Path) -> Path:
    """The one camera file of a folder; a usual name goes before a kind of file."""
    usual = [folder / name for name in _CAMERA_FILES if (folder / name).is_file()]
    if usual:
        return usual[0]
    others = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".xcp" or _DLT.fullmatch(p.name))
    if len(others) == 1:
        return others[0]
    raise InputError(
        "Which file has the cameras is not clear." if others else "The folder has no camera file.",
        file=folder,
        expected=f"{', '.join(_CAMERA_FILES)}, one .xcp of Vicon, or one dltCoefs.csv of DLTdv",
        found=_some([p.name for p in others or sorted(folder.iterdir())]),
        remedy="name it: cameras=FILE",
    )


def _at_least_two(rig: CameraArray, file: Path) -> None:
    if len(rig) < 2:
        raise InputError(
            "There is only one camera: tracks are matched between two or more.",
            file=file,
            expected="two or more cameras",
            found=", ".join(rig.names) or "none",
            remedy="add the other cameras",
        )


def _find(folder: Path, rig: CameraArray, used: Sequence[Path]) -> Given:
    """What holds the tracks: one file for all cameras, or those of each camera."""
    here = [p for p in sorted(folder.iterdir()) if not p.name.startswith(".") and p not in used]
    files = [p for p in here if p.suffix.lower() in TABLES and not NO_TRACKS.fullmatch(p.stem)]
    files = [p for p in files if not _DLT.fullmatch(p.name)]
    digitised = [p for p in files if is_xypts(p)]
    if digitised:
        return _only(digitised, folder)
    named = [
        p
        for p in (*files, *filter(export_files, filter(Path.is_dir, here)))
        if len(cameras_of(_stem(p), rig.names)) == 1
    ]
    strangers = [p for p in files if p not in named and looks_like_camera(_stem(p))]
    if named or strangers:
        seen = {cameras_of(_stem(p), rig.names)[0] for p in named}
        if strangers or seen != set(rig.names):
            raise _no_fit(folder, [p.name for p in (*named, *strangers)], rig)
        exact = [p for p in named if same_name(_stem(p)) in map(same_name, rig.names)]
        settled = {cameras_of(_stem(p), rig.names)[0] for p in exact}
        return exact + [p for p in named if cameras_of(_stem(p), rig.names)[0] not in settled]
    joint = [p for p in files if p.suffix.lower() in (".csv", ".tsv") and has_camera_column(p)]
    if joint:
        return _only(joint, folder)
    raise InputError(
        "The folder holds no tracks that belong to its cameras.",
        file=folder,
        expected=f"{rig.names[0]}.csv and so on, for {_some(rig.names)}; or one table with a column cam",
        found=_some([p.name for p in here]),
        remedy="rename the files after their cameras, or name them: tracks=FILES",
    )


def _views(given: Given, rig: CameraArray, options: _Options) -> tuple[dict[str, Tracks2D], list[str]]:
    """The views by the name of their camera, and notes."""
    if isinstance(given, str | Path):
        given = [given]
    if isinstance(given, Mapping):
        for name in given:
            if name not in rig.names:
                raise _no_fit(None, [str(n) for n in given], rig)
        return {name: _read_view([Path(p)], name, options) for name, p in given.items()}, []
    paths = [Path(p) for p in given]
    if len(paths) == 1:
        if is_xypts(paths[0]):
            return _digitised(paths[0], rig), []
        if paths[0].suffix.lower() in (".csv", ".tsv", ".txt") and has_camera_column(paths[0]):
            return _joint(paths[0], rig)
    by_camera: dict[str, list[Path]] = {}
    for path in paths:
        if not path.exists():
            raise InputError("The file of tracks does not exist.", file=path, remedy="check the path")
        owner = cameras_of(_stem(path), rig.names) or cameras_of(path.parent.name, rig.names)
        if len(owner) != 1:
            raise _no_fit(path.parent, [p.name for p in paths], rig)
        by_camera.setdefault(owner[0], []).append(path)
    return {name: _read_view(files, name, options) for name, files in by_camera.items()}, []


def _digitised(path: Path, rig: CameraArray) -> dict[str, Tracks2D]:
    views = read_xypts(path, [camera.resolution[1] for camera in rig])
    return _by_name({view.camera: view for view in views}, rig, path)


def _joint(path: Path, rig: CameraArray) -> tuple[dict[str, Tracks2D], list[str]]:
    views = read_joint_table(path)
    known = {same_name(name) for name in rig.names}
    if not counted(views, len(rig)) or known & set(views):
        return _by_name(views, rig, path), []
    note = (
        f"The cameras in {path.name} are called {_some(list(views))}, and none in the camera file is: "
        f"taken as their places in it ({_some(rig.names)})."
    )
    placed = {rig.names[int(place)]: view for place, view in views.items()}
    return {name: replace(view, camera=name) for name, view in placed.items()}, [note]


def _by_name(views: Mapping[str, Tracks2D], rig: CameraArray, path: Path) -> dict[str, Tracks2D]:
    owners = {name: cameras_of(name, rig.names) for name in views}
    joined = {
        owner[0]: replace(views[name], camera=owner[0]) for name, owner in owners.items() if len(owner) == 1
    }
    if len(joined) != len(views):
        raise _no_fit(path, list(views), rig)
    return joined


def _read_view(paths: Sequence[Path], camera: str, options: _Options) -> Tracks2D:
    """The dots of one camera, from a table, an export or a folder with one."""
    if len(paths) == 1 and paths[0].is_dir():
        paths = export_files(paths[0]) or paths
    kinds = {exporter(path) for path in paths}
    if kinds == {"trex"}:
        return read_trex(paths, camera, cm_per_pixel=options.cm_per_pixel)
    if len(paths) > 1:
        raise InputError(
            f"Camera '{camera}' has more than one file.",
            file=paths[0],
            expected="one file for each camera",
            found=_some([path.name for path in paths]),
            remedy="name the files: tracks=FILES",
        )
    path = paths[0]
    if kinds == {"sleap"}:
        return read_sleap(path, camera, node=options.node)
    if kinds == {"idtracker"}:
        return read_idtracker(path, camera)
    if path.suffix.lower() in (".h5", ".hdf5", ".npz", ".npy"):
        raise InputError(
            "The file is of no tracker that is known.",
            file=path,
            expected="TRex (.npz), idtracker.ai (.npy, .h5) or SLEAP (analysis .h5)",
            found=path.name,
            remedy="write the tracks as CSV: frame, track, x, y",
        )
    view = read_track_table(path, camera)
    truth = path.with_name(f"{path.stem}{_TRUTH}{path.suffix}")
    if not truth.is_file():
        return view
    n_rows = len(view) + (0 if view.left_out is None else len(view.left_out))
    return replace(view, animal=read_true_animals(truth, n_rows, view.row))


def _stem(path: Path) -> str:
    """The name up to its first point; of a folder the whole."""
    return path.name if path.is_dir() else path.name.partition(".")[0]


def _only(paths: Sequence[Path], folder: Path) -> Path:
    if len(paths) == 1:
        return paths[0]
    raise InputError(
        "Which file has the tracks is not clear.",
        file=folder,
        expected="one file with the tracks of all cameras",
        found=_some([path.name for path in paths]),
        remedy="name it: tracks=FILE",
    )


def _truth_3d(folder: Path, given: Path | str | None) -> pd.DataFrame | None:
    path = folder / _TRUTH_3D if given is None else Path(given)
    if given is None and not path.is_file():
        return None
    return read_xyzpts(path) if re.search(r"xyzpts\.[ct]sv$", path.name, re.I) else read_truth_3d(path)


def _no_fit(file: Path | None, found: Sequence[str], rig: CameraArray) -> InputError:
    return InputError(
        "The tracks and the cameras do not fit: they are joined by name.",
        file=file,
        expected=f"one for each camera: {_some(rig.names)}",
        found=_some(found),
        remedy="rename the files (or the column cam) after the cameras, or name the files that are meant: "
        "tracks=FILES, or tracks={CAMERA: FILE}",
    )


def _some(names: Sequence[str]) -> str:
    """Names for a message, the first dozen of them."""
    more = f", … ({len(names)})" if len(names) > 12 else ""
    return (", ".join(names[:12]) + more) or "nothing"
