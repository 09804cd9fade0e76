"""Wide tables of 2D tracks: a row for each frame, a pair of columns for each individual.

The pairs are found by their names: ``A_x, A_y``, ``A.x, A.y``, ``x_A, y_A``, or ``x1, y1`` with numbers. Or
two header lines say the individual and the coordinate, as pandas writes columns of two levels::

    individual,A,A,B,B
    frame,x,y,x,y

More lines above them, and columns of anything else, are passed over.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.individual_rows import identity
from acino_fte.data_tools.track_table import SYNONYMS, _parse, matched_columns, numbers, read_header
from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

_AFTER = re.compile(r"(?P<who>.+?)[._ :/-](?P<axis>[xy])", re.IGNORECASE)
_BEFORE = re.compile(r"(?P<axis>[xy])[._ :/-](?P<who>.+)", re.IGNORECASE)
_NUMBER = re.compile(r"(?P<axis>[xy])(?P<who>\d+)", re.IGNORECASE)
_INDEX_NAMES = ("", "coords", "coord", "coordinate", "space", "frame", *SYNONYMS["frame"])
_MOST_LINES = 4


@dataclass(frozen=True)
class WideLayout:
    """Where a wide table has what.

    Attributes
    ----------
    header : tuple of str
        A name for every column.
    n_lines : int
        Header lines.
    frame : int
        Column of the frame.
    names : tuple of str
        Individuals.
    columns : tuple of (int, int)
        Columns of their x and y.
    """

    header: tuple[str, ...]
    n_lines: int
    frame: int
    names: tuple[str, ...]
    columns: tuple[tuple[int, int], ...]


def wide_layout(path: Path) -> WideLayout | None:
    """How the columns of a wide table are to be read; None when it is no wide table.

    Raises
    ------
    InputError
        An individual has only one of x and y, or has them twice.
    """
    header, separator = read_header(path)
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = [line[:1_000_000] for line in islice(file, _MOST_LINES + 1)]
    cells = [[cell.strip() for cell in line] for line in csv.reader(lines, delimiter=separator)]
    return _two_lines(cells, path) or _one_line(header, path)


def read_wide_values(path: Path, layout: WideLayout) -> tuple[pd.DataFrame, np.ndarray]:
    """The table without blank rows, its index the row of the file from 0, and its pixels (F, A, 2)."""
    separator = read_header(path)[1]
    header = list(layout.header)
    table = _parse(path, header, sep=separator, skip_blank_lines=False, skiprows=layout.n_lines - 1)
    table = table[table.notna().any(axis=1)]
    pairs = [
        np.stack([numbers(table.iloc[:, i], header[i], path) for i in columns], axis=1)
        for columns in layout.columns
    ]
    return table, np.stack(pairs, axis=1)


def _one_line(header: Sequence[str], path: Path) -> WideLayout | None:
    frame = matched_columns(header).get("frame")
    found = [_pair(name) for name in header]
    if frame is None or not any(found):
        return None
    return _layout(header, 1, header.index(frame), found, path)


def _two_lines(cells: Sequence[Sequence[str]], path: Path) -> WideLayout | None:
    """The layout when the second line, or one soon after it, has nothing but names of coordinates."""
    for n, line in enumerate(cells[1:_MOST_LINES], 1):
        axes = [cell.lower() for cell in line]
        if axes[:1] and axes[0] in _INDEX_NAMES and {"x", "y"} <= set(axes[1:]):
            above = list(cells[n - 1]) + [""] * (len(line) - len(cells[n - 1]))
            for i in range(2, len(above)):
                above[i] = above[i] or above[i - 1]  # merged cells are written once
            found = [(above[i], axis) if i and axis in ("x", "y") else None for i, axis in enumerate(axes)]
            header = [f"{above[i]}.{axis}" if i else "frame" for i, axis in enumerate(axes)]
            n_lines = n + 1
            after = cells[n_lines] if len(cells) > n_lines else []
            if after and not any(after[1:]) and not _is_number(after[0]):
                n_lines += 1  # pandas names the index in a line of its own
            return _layout(header, n_lines, 0, found, path)
    return None


def _pair(name: str) -> tuple[str, str] | None:
    """The individual and the axis that a column's name says."""
    for pattern in (_NUMBER, _AFTER, _BEFORE):
        match = pattern.fullmatch(name.strip())
        if match:
            return match["who"], match["axis"].lower()
    return None


def _layout(
    header: Sequence[str],
    n_lines: int,
    frame: int,
    found: Sequence[tuple[str, str] | None],
    path: Path,
) -> WideLayout:
    columns: dict[str, dict[str, int]] = {}
    for i, pair in enumerate(found):
        if pair is None:
            continue
        axes = columns.setdefault(identity(pair[0]), {})
        if pair[1] in axes:
            raise _wrong_pair(path, pair[0], f"{pair[1]} twice: columns {axes[pair[1]] + 1} and {i + 1}")
        axes[pair[1]] = i
    for who, axes in columns.items():
        if set(axes) != {"x", "y"}:
            raise _wrong_pair(path, who, f"only {', '.join(axes)}")
    places = tuple((axes["x"], axes["y"]) for axes in columns.values())
    return WideLayout(tuple(header), n_lines, frame, tuple(columns), places)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _wrong_pair(path: Path, who: str, found: str) -> InputError:
    return InputError(
        f"Individual '{who}' does not have a pair of columns.",
        file=path,
        key="header",
        expected="one column for x and one for y",
        found=found,
        remedy="name the columns A_x, A_y, B_x, B_y, …",
    )
