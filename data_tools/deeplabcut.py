"""Keypoint files of one animal: DeepLabCut's CSV and H5, tables of candidates; CSV out."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.deeplabcut_candidates import (
    PICKLE_SUFFIXES,
    is_candidate_table,
    read_candidate_table,
    read_full_pickle,
)
from acino_fte.data_tools.keypoints import COORDINATES, Keypoints, from_table
from acino_fte.errors import InputError

H5_SUFFIXES = (".h5", ".hdf5", ".hdf")
LEVELS = ("scorer", "individuals", "bodyparts", "coords")
_NOT_A_TABLE = "give the CSV or H5 file that DeepLabCut's analyze_videos wrote"


def read_deeplabcut(path: Path | str) -> Keypoints:
    """Read a keypoint file; the ending of its name says of which kind it is.

    A DeepLabCut table (.csv, .h5), DeepLabCut's ``_full.pickle``, or a CSV of candidates (see
    :mod:`acino_fte.data_tools.deeplabcut_candidates`).

    Returns
    -------
    Keypoints
        Frames without a row are NaN; the order of the rows does not matter.

    Raises
    ------
    InputError
        The file is missing, is no such table, has several animals, has no likelihood, or has a cell that
        is no number.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("The keypoint file does not exist.", file=path, remedy="check the path")
    if path.stat().st_size == 0:
        raise InputError("The keypoint file is empty.", file=path, found="0 bytes", remedy=_NOT_A_TABLE)
    if path.suffix.lower() in H5_SUFFIXES:
        from acino_fte.data_tools.deeplabcut_h5 import read_h5

        return from_table(*read_h5(path), path)
    if path.suffix.lower() in PICKLE_SUFFIXES:
        return read_full_pickle(path)
    if path.suffix.lower() == ".csv" and is_candidate_table(path):
        return read_candidate_table(path)
    if path.suffix.lower() == ".csv":
        return from_table(*_read_csv(path), path)
    raise InputError(
        "The keypoint file is of a kind that cannot be read.",
        file=path,
        expected=f".csv or {', '.join((*H5_SUFFIXES, *PICKLE_SUFFIXES))}",
        found=path.suffix or "no ending",
        remedy=_NOT_A_TABLE,
    )


def single_animal(levels: dict[str, list[str]], path: Path) -> list[tuple[str, str]]:
    """(bodypart, coordinate) of each column; refuses a table of several animals.

    Parameters
    ----------
    levels : dict
        Header rows by name (``scorer``, perhaps ``individuals``, ``bodyparts``, ``coords``), each with one
        entry per column.
    path : Path
        For error messages.
    """
    for level in ("individuals", "scorer"):
        found = list(dict.fromkeys(levels.get(level, [])))
        if len(found) > 1:
            what = "animals" if level == "individuals" else "scorers"
            raise InputError(
                f"The table has several {what}; one is wanted.",
                file=path,
                key=level,
                expected="one name",
                found=", ".join(found),
                remedy="write one file per animal and run each by itself"
                if level == "individuals"
                else "keep the columns of one scorer",
            )
    for level in ("bodyparts", "coords"):
        if level not in levels:
            raise InputError(
                f"The table has no header row '{level}': it is not DeepLabCut's.",
                file=path,
                expected="header rows scorer, bodyparts, coords",
                found=", ".join(levels) or "none",
                remedy=_NOT_A_TABLE,
            )
    coordinates = [c.strip().lower() for c in levels["coords"]]
    return list(zip((b.strip() for b in levels["bodyparts"]), coordinates, strict=True))


def _read_csv(path: Path) -> tuple[list[tuple[str, str]], np.ndarray, np.ndarray]:
    """Columns, values (R, columns) and frame numbers (R,) of a CSV."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(
            "The keypoint file cannot be read as text.",
            file=path,
            expected="CSV in UTF-8",
            found=str(error),
            remedy=_NOT_A_TABLE,
        ) from None
    lines = text.splitlines()
    levels: dict[str, list[str]] = {}
    for row in csv.reader(lines[: len(LEVELS)]):
        label = row[0].strip().lower() if row else ""
        if label not in LEVELS or label in levels:
            break
        levels[label] = row[1:]
    if not levels:
        raise InputError(
            "The file is not a DeepLabCut table.",
            file=path,
            key="line 1",
            expected="'scorer' in the first cell, then rows 'bodyparts' and 'coords'",
            found=repr(lines[0][:60]) if lines else "no text",
            remedy="save it with commas between the cells" if lines and ";" in lines[0] else _NOT_A_TABLE,
        )
    width = 1 + max(len(row) for row in levels.values())
    body = [(number, line) for number, line in enumerate(lines[len(levels) :], len(levels) + 1) if line]
    _check_widths(levels, body, width, path)
    columns = single_animal(levels, path)
    return columns, *_numbers(body, columns, path)


def _check_widths(levels: dict[str, list[str]], body: list[tuple[int, str]], width: int, path: Path) -> None:
    """Every line has as many cells as the header: a file cut while it was written has not."""
    rows = [(i + 1, len(row) + 1) for i, row in enumerate(levels.values())]
    rows += [(number, line.count(",") + 1) for number, line in body]
    for number, cells in rows:
        if cells != width:
            raise InputError(
                "A line of the table has another number of cells than its header.",
                file=path,
                key=f"line {number}",
                expected=f"{width} cells",
                found=f"{cells}",
                remedy="write the file again; it was cut, or edited by hand",
            )


def _numbers(
    body: list[tuple[int, str]], columns: list[tuple[str, str]], path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Values (R, columns) and first column (R,) of the lines of numbers."""
    import pandas as pd

    if not body:
        return np.empty((0, len(columns))), np.empty(0)
    text = "\n".join(line for _, line in body)
    try:
        table = pd.read_csv(io.StringIO(text), header=None, dtype=float, skipinitialspace=True).to_numpy()
    except ValueError:
        cells = pd.read_csv(io.StringIO(text), header=None, dtype=str, skipinitialspace=True)
        numbers = cells.apply(pd.to_numeric, errors="coerce")
        bad = np.argwhere((numbers.isna() & cells.notna()).to_numpy())
        row, column = bad[0] if len(bad) else (0, 0)
        if column:
            where, remedy = ".".join(columns[column - 1]), "leave the cell empty where nothing was found"
        else:
            where, remedy = (
                "the first column",
                "number the rows by frame: a table of labelled images has none",
            )
        raise InputError(
            "A cell of the table is no number.",
            file=path,
            key=f"line {body[row][0]}, {where}",
            expected="a number",
            found=repr(str(cells.iloc[row, column])),
            remedy=remedy,
        ) from None
    return table[:, 1:], table[:, 0]


def write_deeplabcut_csv(
    path: Path | str,
    names: Sequence[str],
    position: np.ndarray,
    likelihood: np.ndarray,
    *,
    scorer: str = "acino_fte",
    decimals: int = 3,
) -> None:
    """Write keypoints of one camera as DeepLabCut does.

    Parameters
    ----------
    path : Path
        The CSV to write.
    names : sequence of str
        The K body parts.
    position : (N, K, 2)
        u, v in px; NaN becomes an empty cell.
    likelihood : (N, K)
        From 0 to 1.
    scorer : str
        Name of the network in the header.
    decimals : int
        Digits after the point.
    """
    position, likelihood = np.asarray(position, dtype=float), np.asarray(likelihood, dtype=float)
    shape = (len(position), len(names))
    if position.shape != (*shape, 2) or likelihood.shape != shape:
        raise InputError(
            "Names, positions and likelihoods do not fit each other.",
            file=path,
            expected=f"position (N, {len(names)}, 2) and likelihood (N, {len(names)})",
            found=f"{position.shape} and {likelihood.shape}",
        )
    values = np.concatenate([position, likelihood[..., None]], axis=-1).reshape(len(position), -1)
    header: list[list[Any]] = [
        ["scorer"] + [scorer] * values.shape[1],
        ["bodyparts", *(name for name in names for _ in COORDINATES)],
        ["coords", *(COORDINATES * len(names))],
    ]
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows(header)
        for frame, row in enumerate(values.round(decimals).tolist()):
            writer.writerow([frame, *("" if cell != cell else f"{cell:.{decimals}f}" for cell in row)])
