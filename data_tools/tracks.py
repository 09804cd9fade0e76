"""2D tracks of individuals for a scene: one file for each camera, or one table for all.

Cameras and tracks are joined by name, individuals over cameras by their label. ``docs/scene_formats.md`` says
what the files may hold.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from acino_fte.data_tools.individual_rows import TrackRows, clean_rows, joined_tracks, make_rows
from acino_fte.data_tools.individual_tables import is_empty, names_cameras, read_table_rows, table_kind
from acino_fte.data_tools.mvt_pickles import read_mvt_pickle
from acino_fte.data_tools.track_owners import owner, owners, some
from acino_fte.data_tools.track_table import matched_columns, read_header
from acino_fte.data_tools.tracker_exports import exporter, read_idtracker, read_sleap, read_trex
from acino_fte.data_tools.tracker_folders import NO_TRACKS, TABLES, export_files
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError

PixelOrigin = Literal["centre", "corner"]
_PICKLES, _TEXT = (".pkl", ".pickle"), (".csv", ".tsv", ".txt")
_MATCHES = "observations.csv"
_DEEPEST = 4  # folders in folders


@dataclass(frozen=True, eq=False)
class SceneTrackFiles:
    """What the files of tracks say.

    Attributes
    ----------
    tracks : tuple of Tracks2D
        One for each camera, in the order of the cameras that were asked for. All have the same `labels`, the
        individuals, so that a track's number means the same in every camera. Rows are sorted by track, then
        frame; `row` has their places in the file.
    notes : tuple of str
        What was left out, and what looks wrong.
    """

    tracks: tuple[Tracks2D, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Options:
    node: str | None
    cm_per_pixel: float | None


def read_scene_tracks(
    path: Path | str,
    camera_names: Sequence[str],
    *,
    node: str | None = None,
    cm_per_pixel: float | None = None,
    pixel_origin: PixelOrigin = "centre",
    other_cameras: Sequence[str] = (),
) -> SceneTrackFiles:
    """Read the 2D tracks of all cameras of a scene.

    Parameters
    ----------
    path : Path
        A folder with a file for each camera (pickles of MultiViewTracks, CSV long or wide, exports of TRex,
        SLEAP and idtracker.ai) or with one table for all; or such a file.
    camera_names : sequence of str
        The cameras.
    node : str, optional
        The node of SLEAP's files that stands for the animal; by default the mean of all.
    cm_per_pixel : float, optional
        TRex's setting of that name, where its files do not say it.
    pixel_origin : {"centre", "corner"}
        Which point of the upper left pixel is (0, 0) in the files.
    other_cameras : sequence of str
        Cameras that are not wanted: their files are passed over.

    Returns
    -------
    SceneTrackFiles
        Cameras without tracks have no rows; that is a note.

    Raises
    ------
    InputError
        A file fits no camera or several, a camera has two files, no camera has tracks, a value cannot be
        used, or an individual has two places in one frame.
    """
    path, cameras, options = Path(path), [*camera_names, *other_cameras], _Options(node, cm_per_pixel)
    if pixel_origin not in ("centre", "corner"):
        raise InputError(
            "The origin of the pixels is not known.",
            key="pixel_origin",
            expected="centre or corner (of the upper left pixel)",
            found=repr(pixel_origin),
        )
    files, joint = _files(path, cameras)
    notes: list[str] = []
    parts = {name: _camera_rows(paths, name, options, notes) for name, paths in files.items()}
    if joint is not None:
        by_camera, said = read_table_rows(joint)
        notes += said
        files = {}
        for name, rows in by_camera.items():
            camera = owner(str(name), cameras, joint, map(str, by_camera))
            if camera in files:
                raise _two_files(camera, joint, map(str, by_camera))
            files[camera], parts[camera] = [joint], rows
    entries: list[tuple[str, TrackRows | None, Path | None]] = []
    for name in camera_names:
        if name not in parts:
            entries.append((name, None, None))
            continue
        rows, said = clean_rows(parts[name], name, files[name][0])
        notes += said
        entries.append((name, rows, files[name][0]))
    views, individuals = joined_tracks(entries)
    _check_any(views, files, path)
    notes += _what_is_missing(views, individuals)
    if pixel_origin == "corner":
        views = tuple(replace(view, xy=view.xy - 0.5) for view in views)
    return SceneTrackFiles(views, tuple(notes))


def _files(path: Path, cameras: Sequence[str]) -> tuple[dict[str, list[Path]], Path | None]:
    """The files of each camera, or the one table for all."""
    if not path.exists():
        raise InputError(
            "There are no such tracks.",
            file=path,
            expected="a folder with the tracks of each camera, or one table for all",
            found="nothing",
            remedy="check the path",
        )
    if path.is_file():
        if path.suffix.lower() in _TEXT and names_cameras(path):
            return {}, path
        return {owner(path.stem, cameras, path, [path.name]): [path]}, None
    here = _candidates(path, cameras, "")
    fitting = [file for said, file in here.items() if len(owners(said, cameras)) == 1]
    tables = [file for file in here.values() if file.suffix.lower() in _TEXT]
    joint = [file for file in tables if file.name == _MATCHES and names_cameras(file)]
    if not fitting:
        joint = joint or [file for file in tables if names_cameras(file)]
    if len(joint) == 1:
        return {}, joint[0]
    files: dict[str, list[Path]] = {}
    for said, file in here.items():
        if not owners(said, cameras) and not _has_tracks(file):
            continue
        camera = owner(said, cameras, path, (p.name for p in here.values()))
        files.setdefault(camera, []).append(file)
    if not files:
        raise _nothing(path, cameras)
    return files, None


def _candidates(folder: Path, cameras: Sequence[str], above: str) -> dict[str, Path]:
    """Files and export folders that may hold tracks, by what says their camera."""
    found: dict[str, Path] = {}
    for item in sorted(folder.iterdir()):
        if item.name.startswith("."):
            continue
        if item.is_dir():
            if export_files(item):
                found[above + item.name] = item
            elif above.count("/") < _DEEPEST and (
                owners(above + item.name, cameras)
                or any(name.startswith(f"{above}{item.name}/") for name in cameras)
            ):
                found |= _candidates(item, cameras, f"{above}{item.name}/")
        elif item.suffix.lower() in (*TABLES, *_PICKLES) and not NO_TRACKS.fullmatch(item.stem):
            said = above + item.stem
            found[f"{said}{item.suffix}" if said in found else said] = item
    return found


def _has_tracks(path: Path) -> bool:
    """Whether a file is meant to hold 2D tracks, by its kind and its header."""
    if path.is_dir() or path.suffix.lower() in _PICKLES:
        return True
    if path.suffix.lower() not in _TEXT:
        return exporter(path) is not None
    if is_empty(path) or "z" in matched_columns(read_header(path)[0]):
        return False
    return table_kind(path) is not None or exporter(path) is not None


def _camera_rows(paths: list[Path], camera: str, options: _Options, notes: list[str]) -> TrackRows:
    """The rows of one camera from its file, or from the files that TRex wrote for it."""
    if len(paths) == 1 and paths[0].is_dir():
        paths = export_files(paths[0])
    path = paths[0]
    if len(paths) == 1 and path.suffix.lower() in _PICKLES:
        return _nobody(path, notes) if is_empty(path) else read_mvt_pickle(path)
    if all(_is_trex(file) for file in paths):
        return _from_export(read_trex(paths, camera, cm_per_pixel=options.cm_per_pixel), notes)
    if len(paths) > 1:
        raise _two_files(camera, path.parent, (file.name for file in paths))
    if path.suffix.lower() in _TEXT:
        if is_empty(path):
            return _nobody(path, notes)
        kind = None if _is_long_sleap(path) else table_kind(path)
        if kind is not None:
            return _one_camera(path, camera, notes)
    made_by = exporter(path)
    if made_by == "sleap":
        return _from_export(read_sleap(path, camera, node=options.node), notes)
    if made_by == "idtracker":
        return _from_export(read_idtracker(path, camera), notes)
    if path.suffix.lower() in _TEXT:
        return _one_camera(path, camera, notes)  # says what is missing
    raise InputError(
        "The file is of no tracker that is known.",
        file=path,
        expected="MultiViewTracks (.pkl), TRex (.npz), idtracker.ai (.npy, .h5), SLEAP (analysis .h5) or CSV",
        found=path.name,
        remedy="write the tracks as CSV: frame, individual, x, y",
    )


def _is_trex(path: Path) -> bool:
    if path.suffix.lower() in _PICKLES or exporter(path) != "trex":
        return False
    return path.suffix.lower() == ".npz" or "track" not in matched_columns(read_header(path)[0])


def _is_long_sleap(path: Path) -> bool:
    """SLEAP's CSV has a column for the track, and nodes where a wide table has individuals."""
    return exporter(path) == "sleap" and "track" in matched_columns(read_header(path)[0])


def _one_camera(path: Path, camera: str, notes: list[str]) -> TrackRows:
    by_camera, said = read_table_rows(path)
    notes += said
    if not by_camera:
        return make_rows(np.zeros(0), np.zeros(0), (), np.zeros((0, 2)))
    if len(by_camera) > 1 or not all(name is None or owners(name, [camera]) for name in by_camera):
        raise InputError(
            f"The file is called as camera '{camera}', but its rows say another.",
            file=path,
            expected=f"rows of {camera}",
            found=some(map(str, by_camera)),
            remedy="pass the one table that has all cameras by its own path",
        )
    return next(iter(by_camera.values()))


def _from_export(tracks: Tracks2D, notes: list[str]) -> TrackRows:
    if tracks.left_out is not None:
        notes.append(
            f"{len(tracks.left_out)} rows of camera '{tracks.camera}' have no coordinates: left out."
        )
    return make_rows(tracks.frame, tracks.track, tracks.labels, tracks.xy, tracks.row)


def _nobody(path: Path, notes: list[str]) -> TrackRows:
    notes.append(f"{path.name} is empty.")
    return make_rows(np.zeros(0), np.zeros(0), (), np.zeros((0, 2)))


def _check_any(views: Sequence[Tracks2D], files: dict[str, list[Path]], path: Path) -> None:
    if any(map(len, views)):
        return
    raise InputError(
        "No camera has tracks.",
        file=path,
        expected=f"tracks of {some(view.camera for view in views)}",
        found=f"files of {some(files)} without a row that can be used" if files else "no file",
        remedy="check that the tracks were exported, and of which cameras",
    )


def _what_is_missing(views: Sequence[Tracks2D], individuals: Sequence[str]) -> list[str]:
    """Notes on cameras without tracks and individuals that one camera sees."""
    notes = []
    empty = [view.camera for view in views if not len(view)]
    if empty:
        notes.append(f"No tracks for {some(empty)}.")
    n_views = np.zeros(len(individuals), dtype=int)
    for view in views:
        n_views[np.unique(view.track)] += 1
    lone = [name for name, n in zip(individuals, n_views, strict=True) if n == 1]
    if len(lone) == len(individuals) and len(views) > 1:
        notes.append(
            "No individual is seen by two cameras: individuals are joined by their names, which are "
            + "; ".join(
                f"{some(view.labels[i] for i in np.unique(view.track))} in {view.camera}"
                for view in views
                if len(view)
            )
            + "."
        )
    elif lone:
        notes.append(f"Seen by one camera only: {some(lone)}.")
    return notes


def _two_files(camera: str, file: Path, found: Iterable[str]) -> InputError:
    return InputError(
        f"Camera '{camera}' has tracks twice.",
        file=file,
        expected="one file for each camera",
        found=some(found),
        remedy="move one of them away, or name the camera in full",
    )


def _nothing(path: Path, cameras: Sequence[str]) -> InputError:
    return InputError(
        "The folder holds no tracks.",
        file=path,
        expected=f"{cameras[0] if cameras else 'camera'}.pkl or .csv and so on, for {some(cameras)}; "
        "or one table with a column camera",
        found=some(sorted(item.name for item in path.iterdir())),
        remedy="export the tracks, or pass the folder that has them",
    )
