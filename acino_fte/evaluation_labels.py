"""Hand labels: keypoint tables of single frames, one for each camera, against the markers of a run.

Three kinds of CSV are read: DeepLabCut's hand-made labels (``CollectedData_….csv``: header rows scorer,
bodyparts, coords with x and y, a first cell that names the image), DeepLabCut's tables with a likelihood, and
a plain table with the columns frame, marker, u, v.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acino_fte.errors import InputError, did_you_mean
from acino_fte.evaluation_runs import Run

_PLAIN = ("frame", "marker", "u", "v")
_KINDS = "DeepLabCut's CollectedData_….csv, its CSV with a likelihood, or columns frame, marker, u, v"


@dataclass(frozen=True, eq=False)
class LabelTable:
    """Labels of one camera: K points with frame (K,), name of the keypoint (K), and pixel (K, 2)."""

    path: Path
    frame: np.ndarray
    names: list[str]
    pixel: np.ndarray


def read_labels(path: Path | str) -> LabelTable:
    """Read the labels of one camera; points without both coordinates are left out.

    Raises
    ------
    InputError
        The file is missing, is no such table, or has a cell that is no number.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise InputError("The file of labels does not exist.", file=path, remedy="check the path")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (UnicodeDecodeError, OSError, csv.Error) as error:
        raise InputError(
            "The labels cannot be read as a table.", file=path, expected=_KINDS, found=str(error)
        ) from None
    head = [cell.strip().lower() for cell in rows[0]] if rows else []
    if set(_PLAIN) <= set(head):
        return _plain(path, rows, head)
    if head[:1] != ["scorer"]:
        raise InputError(
            "The file is no table of labels.",
            file=path,
            key="line 1",
            expected=_KINDS,
            found=", ".join(rows[0])[:80] if rows else "nothing",
            remedy="save it with commas between the cells" if rows and ";" in rows[0][0] else None,
        )
    levels = {row[0].strip().lower(): row for row in rows[:4]}
    if "likelihood" in (cell.strip().lower() for cell in levels.get("coords", [])):
        return _detector(path)
    return _collected(path, rows, levels)


def _plain(path: Path, rows: list[list[str]], head: list[str]) -> LabelTable:
    places = [head.index(name) for name in _PLAIN]
    frames, names, pixels = [], [], []
    for number, row in enumerate(rows[1:], 2):
        cells = [row[p].strip() if p < len(row) else "" for p in places]
        if not (cells[2] and cells[3]):
            continue
        frames.append(_number(cells[0], path, f"line {number}, frame"))
        names.append(cells[1])
        pixels.append([_number(c, path, f"line {number}, {n}") for c, n in zip(cells[2:], "uv", strict=True)])
    return _table(path, frames, names, pixels)


def _detector(path: Path) -> LabelTable:
    from acino_fte.data_tools.deeplabcut import read_deeplabcut

    found = read_deeplabcut(path)
    frame, place = np.nonzero(np.isfinite(found.position).all(-1))
    return _table(path, frame, [found.names[k] for k in place], found.position[frame, place])


def _collected(path: Path, rows: list[list[str]], levels: dict[str, list[str]]) -> LabelTable:
    """DeepLabCut's hand labels; the frame is the last number in the name of the image."""
    if not {"bodyparts", "coords"} <= set(levels):
        raise InputError(
            "The table of labels lacks header rows.",
            file=path,
            expected="rows scorer, bodyparts, coords",
            found=", ".join(levels),
        )
    n_head = sum(name in levels for name in ("scorer", "individuals", "bodyparts", "coords"))
    coords = [cell.strip().lower() for cell in levels["coords"]]
    first = next((i for i, cell in enumerate(coords) if cell == "x"), len(coords))
    columns = {
        name: (i, i + 1)
        for i, name in enumerate(cell.strip() for cell in levels["bodyparts"])
        if i >= first and coords[i : i + 2] == ["x", "y"]
    }
    if not columns:
        raise InputError(
            "The table of labels has no columns x, y.",
            file=path,
            key="coords",
            expected="x, y for every body part",
            found=", ".join(dict.fromkeys(coords[1:])),
        )
    frames, names, pixels = [], [], []
    for number, row in enumerate(rows[n_head:], n_head + 1):
        frame = _image_frame([cell for cell in row[:first] if cell.strip()], path, number)
        for name, (i, j) in columns.items():
            cells = [row[k].strip() if k < len(row) else "" for k in (i, j)]
            if all(cell and cell.lower() != "nan" for cell in cells):
                frames.append(frame)
                names.append(name)
                where = f"line {number}, {name}"
                pixels.append([_number(cell, path, where) for cell in cells])
    return _table(path, frames, names, pixels)


def _image_frame(cells: list[str], path: Path, number: int) -> int:
    found = re.findall(r"\d+", re.split(r"[\\/]", cells[-1])[-1]) if cells else []
    if not found:
        raise InputError(
            "A row of labels names no frame.",
            file=path,
            key=f"line {number}",
            expected="the name of an image with its frame, as labeled-data/cam1/img0123.png",
            found=repr("/".join(cells)),
            remedy="name the images by their frames, counted from 0 at the start of the recording",
        )
    return int(found[-1])


def _number(text: str, path: Path, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(
            "A cell of the labels is no number.", file=path, key=where, expected="a number", found=repr(text)
        )
    return value


def _table(
    path: Path,
    frames: Sequence[float] | np.ndarray,
    names: list[str],
    pixels: Sequence[Sequence[float]] | np.ndarray,
) -> LabelTable:
    frame = np.asarray(frames, dtype=float)
    if not len(frame):
        raise InputError("The table of labels has no labels.", file=path, expected=_KINDS, found="no points")
    wrong = np.flatnonzero((frame < 0) | (frame != np.floor(frame)))
    if len(wrong):
        raise InputError(
            "A label has no frame.",
            file=path,
            key="frame",
            expected="whole numbers ≥ 0",
            found=f"{frame[wrong[0]]:g}",
        )
    return LabelTable(path, frame.astype(int), names, np.asarray(pixels, dtype=float).reshape(-1, 2))


# --- which labels belong to which run ------------------------------------------------------------------


def labels_of_runs(texts: Sequence[str], runs: Sequence[Run]) -> dict[str, dict[str, Path]]:
    """Files of labels by the name of the run and of the camera.

    Parameters
    ----------
    texts : sequence of str
        ``[RUN:]CAMERA=FILE``, or ``[RUN:]FOLDER`` with files CAMERA.csv, or a folder with a folder of these
        for each run. Without RUN they are of every run, which then must be of one recording.
    runs : sequence of Run
        What the names are names of.

    Raises
    ------
    InputError
        A run, a camera or a file does not exist, or it is not clear which run is meant.
    """
    found: dict[str, dict[str, Path]] = {}
    for text in texts:
        chosen, rest = _prefixed(text, runs)
        camera, equals, file = rest.partition("=")
        folder = Path(rest).expanduser()
        if equals and not folder.exists():
            pieces = {
                run.name: {camera: Path(file).expanduser()} for run in _one_recording(chosen, runs, text)
            }
        else:
            pieces = _from_folder(folder, chosen, runs, text)
        for name, files in pieces.items():
            _check_names(name, files, runs)
            found.setdefault(name, {}).update(files)
    return found


def _prefixed(text: str, runs: Sequence[Run]) -> tuple[list[Run], str]:
    """The runs that a text names before a colon, none without, and the rest of it."""
    for run in sorted(runs, key=lambda r: -len(r.name)):
        if text.startswith(f"{run.name}:"):
            return [run], text[len(run.name) + 1 :]
    before, colon, after = text.partition(":")
    if colon and "=" in after and "=" not in before and len(before) > 1:
        raise InputError(
            f"No run is called '{before}'{did_you_mean(before, [run.name for run in runs])}",
            key="--labels",
            expected=f"one of {', '.join(run.name for run in runs)}",
            found=before,
        )
    return [], text


def _one_recording(chosen: list[Run], runs: Sequence[Run], text: str) -> Sequence[Run]:
    if chosen or len({run.sequence for run in runs}) == 1:
        return chosen or runs
    raise InputError(
        "It is not clear which run these labels are of.",
        key="--labels",
        expected=f"RUN:{text} with RUN one of {', '.join(run.name for run in runs)}",
        found=text,
        remedy="name the run before a colon: the runs are of different recordings",
    )


def _from_folder(
    folder: Path, chosen: list[Run], runs: Sequence[Run], text: str
) -> dict[str, dict[str, Path]]:
    if not folder.is_dir():
        raise InputError(
            "The labels do not exist.",
            file=folder,
            key="--labels",
            expected="CAMERA=FILE, or a folder with files CAMERA.csv",
            found=text,
            remedy="check the path",
        )
    inside = {run.name: folder / run.name for run in chosen or runs if (folder / run.name).is_dir()}
    if not inside:
        inside = {run.name: folder for run in _one_recording(chosen, runs, text)}
    return {name: _camera_files(place, name, runs) for name, place in inside.items()}


def _camera_files(folder: Path, name: str, runs: Sequence[Run]) -> dict[str, Path]:
    run = next(run for run in runs if run.name == name)
    files = {p.stem: p for p in sorted(folder.glob("*.csv"))}
    known = {camera: files[camera] for camera in run.camera_names if camera in files}
    if not known:
        raise InputError(
            f"The folder has no labels for a camera of the run '{name}'.",
            file=folder,
            expected=" or ".join(f"{camera}.csv" for camera in run.camera_names),
            found=", ".join(p.name for p in files.values()) or "no CSV file",
            remedy="name the files as the cameras, or give CAMERA=FILE",
        )
    return known


def _check_names(name: str, files: dict[str, Path], runs: Sequence[Run]) -> None:
    run = next(run for run in runs if run.name == name)
    for camera in files:
        if camera not in run.camera_names:
            raise InputError(
                f"The run '{name}' has no camera '{camera}'{did_you_mean(camera, run.camera_names)}",
                key="--labels",
                expected=f"one of {', '.join(run.camera_names)}",
                found=camera,
            )


def label_pixels(run: Run, files: dict[str, Path]) -> tuple[np.ndarray, list[str]]:
    """Labels (N, C, M, 2) px at the frames of a run, NaN where there is none, and what was left out.

    Raises
    ------
    InputError
        No label of a file is of a frame and a marker of the run.
    """
    from acino_fte.data_tools.matching import match_markers

    pixels = np.full((len(run.frames), len(run.camera_names), len(run.markers), 2), np.nan)
    first, last = int(run.frames[0]), int(run.frames[-1])
    notes = []
    for camera, path in files.items():
        table = read_labels(path)
        match = match_markers(tuple(dict.fromkeys(table.names)), run.skeleton, path)
        marker = np.array([_place(run, match.get(name)) for name in table.names])
        inside = (table.frame >= first) & (table.frame <= last)
        use = inside & (marker >= 0)
        if not use.any():
            raise InputError(
                f"No label is of a frame of the run '{run.name}'.",
                file=path,
                expected=f"frames {first} to {last}, counted from 0 at the start of the recording",
                found=f"frames {table.frame.min()} to {table.frame.max()}",
                remedy="check that the labels are of this recording and that frames are counted from 0",
            )
        pixels[table.frame[use] - first, run.camera_names.index(camera), marker[use]] = table.pixel[use]
        if not inside.all():
            n = int((~inside).sum())
            notes.append(f"{run.name}, {camera}: {n} labels outside the frames of the run are left out")
        unknown = sorted({name for name in table.names if name not in match})
        if unknown:
            notes.append(f"{run.name}, {camera}: not markers of the run: {', '.join(unknown)}")
    return pixels, notes


def _place(run: Run, marker: str | None) -> int:
    return run.markers.index(marker) if marker in run.markers else -1
