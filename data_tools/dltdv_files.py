"""Points digitised with DLTdv (Hedrick 2008): ``…xypts`` and ``…xyzpts``, as ``.csv`` and, sparse, ``.tsv``.

Layouts, from the sources of DLTdv 5 to 8 (github.com/tlhedrick/dltdv; ``sparseSave.m`` for the sparse form):

- ``xypts.csv``: a row for each frame and columns ``pt{n}_cam{k}_X, pt{n}_cam{k}_Y``, n and k from 1, all
  cameras of a point together; NaN where a point was not digitised.
- ``xypts.tsv``: a line of title, a line with the numbers of rows, columns and entries of that same table,
  then a line ``row column value`` for each entry, both counted from 1; what has no line was not digitised.
- ``xyzpts``: the same with columns ``pt{n}_X, pt{n}_Y, pt{n}_Z``.

Pixels count from the bottom left corner, y up. Here y is measured from the top, as everywhere else in the
project: v = image height − y, for the points and for the DLT coefficients alike. DLTdv counts frames from 1,
here the first row is frame 0.

Hedrick, T. L. (2008). Software techniques for two- and three-dimensional kinematic measurements of
biological and biomimetic systems. Bioinspiration & Biomimetics 3, 034001.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.track_files import tracks_from_grid
from acino_fte.data_tools.track_table import read_header, read_wide
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

_PIXEL = re.compile(r"pt(\d+)_cam(\d+)_([xy])", re.IGNORECASE)
_SPACE = re.compile(r"pt(\d+)_([xyz])", re.IGNORECASE)
_LARGEST = 10**9
_REMEDY = "save the points again with DLTdv"


def is_xypts(path: Path) -> bool:
    """Whether a file is a table of DLTdv's pixel coordinates, by its name or its header."""
    if re.search(r"xypts\.[ct]sv$", path.name, re.IGNORECASE):
        return True
    try:
        return _PIXEL.fullmatch(read_header(path)[0][0]) is not None
    except InputError:
        return False


def read_xypts(path: Path | str, image_height: Sequence[float]) -> tuple[Tracks2D, ...]:
    """Read digitised points as 2D tracks, y from the top.

    Parameters
    ----------
    path : Path
        ``…xypts.csv`` or ``.tsv``.
    image_height : sequence of float
        Of every camera in the file, in order, px.

    Returns
    -------
    tuple of Tracks2D
        One for each camera, called ``cam1``, ``cam2``, …; the tracks are ``pt1``, ``pt2``, …. A point is one
        and the same animal in all cameras, so its number is also the true animal.

    Raises
    ------
    InputError
        The file is no such table, or it has another number of cameras.
    """
    path = Path(path)
    height = np.asarray(image_height, dtype=float)
    if _is_sparse(path):
        table = _read_sparse(path, 2 * len(height))
        xy = table.reshape(len(table), -1, len(height), 2)
    else:
        xy = _read_named(path, _PIXEL, "pt1_cam1_X, pt1_cam1_Y, pt1_cam2_X, …")
    if xy.shape[2] != len(height):
        raise InputError(
            "The digitised points are of another number of cameras.",
            file=path,
            expected=f"{len(height)} cameras, as many as the camera file has",
            found=f"cam1 to cam{xy.shape[2]}",
            remedy="name the DLT coefficients that belong to this file",
        )
    numbers = np.arange(1, xy.shape[1] + 1)
    return tuple(
        tracks_from_grid(
            f"cam{k + 1}",
            np.stack([xy[:, :, k, 0], height[k] - xy[:, :, k, 1]], axis=-1),
            [f"pt{n}" for n in numbers],
            path=path,
            animal=numbers,
        )
        for k in range(xy.shape[2])
    )


def read_xyzpts(path: Path | str) -> pd.DataFrame:
    """Read DLTdv's reconstructed points as true positions.

    Parameters
    ----------
    path : Path
        ``…xyzpts.csv`` or ``.tsv``, in the unit of the calibration: m.

    Returns
    -------
    pandas.DataFrame
        Columns frame (from 0), animal (the number of the point, from 1), x, y, z.

    Raises
    ------
    InputError
        The file is no such table.
    """
    import pandas as pd

    path = Path(path)
    if _is_sparse(path):
        table = _read_sparse(path, 3)
        xyz = table.reshape(len(table), -1, 3)
    else:
        xyz = _read_named(path, _SPACE, "pt1_X, pt1_Y, pt1_Z, pt2_X, …")
    frame, point = np.nonzero(np.isfinite(xyz).all(-1))
    x, y, z = xyz[frame, point].T
    return pd.DataFrame({"frame": frame, "animal": point + 1, "x": x, "y": y, "z": z})


def _is_sparse(path: Path) -> bool:
    return path.suffix.lower() == ".tsv"


def _read_named(path: Path, pattern: re.Pattern[str], layout: str) -> np.ndarray:
    """A dense table as (F, …, axes), with a dimension for each number in the names of the columns."""
    names, values = read_wide(path)
    places = []
    for name in names:
        match = pattern.fullmatch(name)
        if match is None or "0" in match.groups():
            raise InputError(
                "This is no table of points digitised with DLTdv.",
                file=path,
                key="header",
                expected=layout,
                found=f"a column '{name}'",
                remedy=_REMEDY,
            )
        *numbers, axis = match.groups()
        places.append((*(int(n) - 1 for n in numbers), "xyz".index(axis.lower())))
    shape = tuple(max(numbers) + 1 for numbers in zip(*places, strict=True))
    if not math.prod(shape) == len(places) == len(set(places)):
        raise InputError(
            "The table of digitised points is not complete.",
            file=path,
            key="header",
            expected=f"{math.prod(shape)} columns: {layout}",
            found=f"{len(places)} columns, {len(set(places))} of them different",
            remedy=_REMEDY,
        )
    dense = np.full((len(values), *shape), np.nan)
    dense[:, *np.array(places).T] = values
    return dense


def _read_sparse(path: Path, per_point: int) -> np.ndarray:
    """A sparse table as (F, columns), NaN where it has no entry."""

    def fail(expected: str, found: str) -> InputError:
        return InputError(
            "This is no sparse table of points digitised with DLTdv.",
            file=path,
            expected=expected,
            found=found,
            remedy=_REMEDY,
        )

    read_header(path)  # it exists and is text
    try:
        with path.open(encoding="utf-8-sig") as file:
            file.readline()
            size = [int(value) for value in file.readline().split()]
            lines = file.readlines()
        entries = np.loadtxt(lines, ndmin=2) if lines else np.empty((0, 3))
    except (ValueError, UnicodeDecodeError) as error:
        raise fail("numbers: row, column, value", str(error)) from None
    if len(size) != 3 or entries.shape[1] != 3 or len(entries) != size[2]:
        raise fail("its size in the second line, then row, column, value", f"{size}, {len(entries)} entries")
    if size[1] % per_point or not 0 < size[1] <= _LARGEST or not 0 <= size[0] <= _LARGEST // size[1]:
        raise fail(f"{per_point} columns for each point, {_LARGEST:.0e} values", f"{size[0]}×{size[1]}")
    row, column = (entries[:, :2] - 1).T
    inside = (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
    if not (inside & np.isfinite(entries[:, 2])).all():
        raise fail(f"finite values in {size[0]}×{size[1]}", "others")
    dense = np.full(size[:2], np.nan)
    dense[row.astype(int), column.astype(int)] = entries[:, 2]
    return dense
