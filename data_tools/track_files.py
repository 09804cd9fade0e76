"""2D tracks in tables: one row per dot, for one camera or for all of them, and the truth beside them.

The columns are frame, track, x, y, for several cameras also cam; animal is the true identity. Other columns
are passed over. Names of columns are matched without regard to case, and a few synonyms are known
(:data:`~acino_fte.data_tools.track_table.SYNONYMS`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.track_table import (
    animals,
    frames,
    labels,
    matched_columns,
    natural_order,
    numbers,
    read_header,
    read_table,
    row_error,
)
from acino_fte.data_tools.tracks2d import BARE, Tracks2D
from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd


def read_track_table(path: Path | str, camera: str) -> Tracks2D:
    """Read the table of one camera.

    Parameters
    ----------
    path : Path
        Text with a header line, separated by commas, semicolons or tabs. Columns frame, x, y and, for dots
        that a tracker joined, track; an empty track or −1 is a bare point. Without a track column, animal
        is both the track and the truth.
    camera : str
        Name of the camera.

    Returns
    -------
    Tracks2D
        One dot per row that has coordinates; the others are in ``left_out``.

    Raises
    ------
    InputError
        A column is missing, a value is no number, a frame no whole number, or a track has two rows in one
        frame.
    """
    path = Path(path)
    table = read_table(path, required=("frame", "x", "y"), optional=("track", "animal"))
    return _tracks(table, camera, path)


def read_joint_table(path: Path | str) -> dict[str, Tracks2D]:
    """Read one table with the dots of all cameras: :func:`read_track_table` with a column cam.

    Returns
    -------
    dict
        Tracks2D by what the column cam has, as text, in the order of first appearance. The index of rows is
        that of the whole file.
    """
    import pandas as pd

    path = Path(path)
    table = read_table(path, required=("frame", "cam", "x", "y"), optional=("track", "animal"))
    names = labels(table["cam"])
    if (missing := names.isna()).any():
        raise row_error(path, "cam", int(np.argmax(missing)), "the name of a camera", "nothing")
    rows, codes = np.arange(len(table)), pd.factorize(names)[0]
    return {
        str(name): _tracks(table[codes == i], str(name), path, rows[codes == i])
        for i, name in enumerate(names.unique())
    }


def has_camera_column(path: Path) -> bool:
    """Whether the header of a table names a column for the camera, besides x and y."""
    try:
        found = set(matched_columns(read_header(path)[0]))
    except InputError:
        return False
    return {"cam", "x", "y"} <= found


def read_true_animals(path: Path | str, n_rows: int, rows: np.ndarray | None = None) -> np.ndarray:
    """Read the true animal of every row of a track table.

    Parameters
    ----------
    path : Path
        Table with a column animal; −1 or nothing is clutter. Rows are those of the track table.
    n_rows : int
        Rows of the track table.
    rows : (P,) int, optional
        The rows that are wanted; by default all.

    Returns
    -------
    (P,) int

    Raises
    ------
    InputError
        The number of rows is another, or an animal is no whole number.
    """
    path = Path(path)
    column = read_table(path, required=("animal",))["animal"]
    if column.iloc[n_rows:].isna().all():
        column = column.iloc[:n_rows]  # blank lines at the end
    animal = animals(column, path)
    if len(animal) != n_rows:
        raise InputError(
            "The truth does not belong to the tracks: its rows are those of the track file, one for one.",
            file=path,
            expected=f"{n_rows} rows",
            found=f"{len(animal)} rows",
            remedy="write both files again from one source, or move the truth away: it is for scoring only",
        )
    return animal if rows is None else animal[rows]


def read_truth_3d(path: Path | str) -> pd.DataFrame:
    """Read true positions: columns frame, animal (or oid), x, y, z (m).

    Returns
    -------
    pandas.DataFrame
        frame and animal as int, x, y, z as float; rows without a position are left out.

    Raises
    ------
    InputError
        As for :func:`read_track_table`, or an animal has two positions in one frame.
    """
    import pandas as pd

    path = Path(path)
    table = read_table(path, required=("frame", "animal", "x", "y", "z"))
    frame, animal = frames(table["frame"], path), animals(table["animal"], path)
    xyz = np.stack([numbers(table[axis], axis, path) for axis in "xyz"], axis=1)
    truth = pd.DataFrame({"frame": frame, "animal": animal, **dict(zip("xyz", xyz.T, strict=True))})
    truth = truth[np.isfinite(xyz).all(1)].reset_index(drop=True)
    if (twice := truth.duplicated(["frame", "animal"])).any():
        first = truth[twice].iloc[0]
        raise InputError(
            f"Animal {first.animal:.0f} has two true positions in frame {first.frame:.0f}.",
            file=path,
            expected="one row for each animal and frame",
            remedy="remove one of the two rows",
        )
    return truth


def tracks_from_columns(
    camera: str,
    frame: np.ndarray,
    label: Any,
    xy: np.ndarray,
    *,
    path: Path,
    animal: np.ndarray | None = None,
    row: np.ndarray | None = None,
) -> Tracks2D:
    """Dots and tracks of one camera from columns that were read from any kind of file.

    Parameters
    ----------
    camera : str
        Its name.
    frame : (P,) int
        Frames of the recording.
    label : (P,) array or pandas.Series
        Names or numbers of the tracks; missing, empty and −1 are bare points.
    xy : (P, 2)
        Pixels, y from the top; NaN where there is no dot.
    path : Path
        For messages.
    animal : (P,) int, optional
        The true animals.
    row : (P,) int, optional
        Rows of the file, for messages and for the writer; by default 0, 1, ….

    Raises
    ------
    InputError
        Two dots of one track are in the same frame.
    """
    import pandas as pd

    row = np.arange(len(frame)) if row is None else np.asarray(row)
    label = labels(pd.Series(label).reset_index(drop=True))
    seen = np.isfinite(xy).all(1)
    left_out = None
    if not seen.all():
        left_out = pd.DataFrame({"row": row[~seen], "frame": frame[~seen], "track": label[~seen].to_numpy()})
    codes, names = pd.factorize(label[seen], sort=False)
    order = sorted(range(len(names)), key=lambda i: natural_order(names[i]))
    rank = np.empty(len(order) + 1, dtype=np.int64)
    rank[order] = np.arange(len(order))
    rank[-1] = BARE  # factorize marks what is missing with −1
    view = Tracks2D(
        camera=camera,
        frame=np.asarray(frame)[seen],
        track=rank[codes],
        xy=np.ascontiguousarray(xy[seen], dtype=float),
        labels=tuple(str(names[i]) for i in order),
        animal=None if animal is None else animal[seen],
        path=path,
        row=row[seen],
        left_out=left_out,
    )
    _check_single(view)
    return view


def tracks_from_grid(
    camera: str,
    xy: np.ndarray,
    names: Sequence[str],
    *,
    path: Path,
    animal: np.ndarray | None = None,
    first_frame: int = 0,
) -> Tracks2D:
    """Dots and tracks of one camera from positions on a grid of frames and animals.

    Parameters
    ----------
    camera : str
        Its name.
    xy : (F, A, 2)
        Pixels, y from the top; not finite where there is no dot.
    names : sequence of str
        Of the A tracks.
    path : Path
        For messages.
    animal : (A,) int, optional
        The true animals.
    first_frame : int
        Frame of the first row.
    """
    frame, place = np.nonzero(np.isfinite(xy).all(-1))
    return Tracks2D(
        camera=camera,
        frame=frame + first_frame,
        track=place,
        xy=np.ascontiguousarray(xy[frame, place], dtype=float),
        labels=tuple(str(name) for name in names),
        animal=None if animal is None else np.asarray(animal)[place],
        path=path,
    )


def _tracks(table: pd.DataFrame, camera: str, path: Path, row: np.ndarray | None = None) -> Tracks2D:
    """The dots of one camera out of a table."""
    animal = animals(table["animal"], path) if "animal" in table else None
    if "track" in table:
        label = table["track"]
    elif animal is not None:
        label = table["animal"]
    else:
        label = np.full(len(table), np.nan)
    return tracks_from_columns(
        camera,
        frames(table["frame"], path),
        label,
        np.stack([numbers(table["x"], "x", path), numbers(table["y"], "y", path)], axis=1),
        path=path,
        animal=animal,
        row=row,
    )


def _check_single(view: Tracks2D) -> None:
    """A track is in one place at a time."""
    joined = np.flatnonzero(view.track != BARE)
    if not len(joined):
        return
    track, frame = view.track[joined], view.frame[joined]
    key = track * (int(frame.max()) + 1) + frame
    order = np.argsort(key, kind="stable")
    again = np.flatnonzero(np.diff(key[order]) == 0)
    if len(again):
        first, second = joined[order[again[0]]], joined[order[again[0] + 1]]
        raise InputError(
            f"Track '{view.labels[view.track[first]]}' of camera '{view.camera}' has two dots in frame "
            f"{view.frame[first]}.",
            file=view.path,
            key=f"rows {view.row[first] + 1} and {view.row[second] + 1} after the header",
            expected="one row for each track and frame",
            found=f"{len(again)} row{'' if len(again) == 1 else 's'} too many",
            remedy="give the animals tracks of their own, or leave the track empty for single dots",
        )
