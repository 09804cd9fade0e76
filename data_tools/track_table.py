"""Columns of text tables of dots: found by name, read fast, checked value by value.

A message about a value counts rows as the file does: after the header, from 1, and as lines.
"""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.tracks2d import BARE, CLUTTER
from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    import pandas as pd

SYNONYMS: dict[str, tuple[str, ...]] = {
    "frame": ("frame_number", "frame_idx", "frame_index", "frameid", "frame_id", "framenumber"),
    "track": ("track_id", "trackid", "id", "identity", "individual", "particle"),
    "x": ("u", "px_x", "x_px", "col_index", "col", "column"),
    "y": ("v", "px_y", "y_px", "row_index", "row"),
    "cam": ("camera", "camera_id", "cam_id", "view"),
    "animal": ("oid", "object_id", "true_id"),
    "z": (),
}
_SEPARATORS = ",;\t"
_LAST_FRAME = 2**31


def read_table(path: Path, *, required: Sequence[str], optional: Sequence[str] = ()) -> pd.DataFrame:
    """The wanted columns under their own names; the index is the row of the file, from 0."""
    header, separator = read_header(path)
    found = matched_columns(header)
    for name in required:
        if name not in found:
            raise _missing_column(path, name, header)
    columns = {found[name]: name for name in (*required, *optional) if name in found}
    table = _parse(path, header, sep=separator, skip_blank_lines=False)
    table = table[list(columns)].rename(columns=columns)
    filled = np.flatnonzero(table.notna().any(axis=1))
    if len(required) > 1:
        table = table.iloc[filled]  # blank lines are no dots
    return table


def read_all(path: Path) -> pd.DataFrame:
    """All columns of a table as they are."""
    header, separator = read_header(path)
    return _parse(path, header, sep=separator)


def read_wide(path: Path, *, infinite: bool = False) -> tuple[list[str], np.ndarray]:
    """All columns of a table of numbers: their names and (F, columns), NaN where a cell is empty.

    With ``infinite``, infinite values are allowed.
    """
    header, table = read_header(path)[0], read_all(path)
    columns = [numbers(table.iloc[:, i], name, path, infinite) for i, name in enumerate(header)]
    return header, np.stack(columns, axis=1)


def _parse(path: Path, header: Sequence[str], **options: Any) -> pd.DataFrame:
    import pandas as pd

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            return pd.read_csv(
                path,
                names=[f"{name}.{i}" if name in header[:i] else name for i, name in enumerate(header)],
                header=0,
                index_col=False,
                encoding="utf-8-sig",
                low_memory=False,
                **options,
            )
    except (pd.errors.ParserError, pd.errors.ParserWarning, UnicodeDecodeError, ValueError) as error:
        raise InputError(
            "The table cannot be read: its rows do not fit its header.",
            file=path,
            expected=f"{len(header)} fields in every row",
            found=str(error).splitlines()[0],
            remedy="write the file again; it was cut, or edited by hand",
        ) from None


def read_header(path: Path) -> tuple[list[str], str]:
    """The names of the columns and what separates them."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            line = file.readline(100_000)
    except FileNotFoundError:
        raise InputError("The table does not exist.", file=path, remedy="check the path") from None
    except IsADirectoryError:
        raise InputError("This is a folder; a table was expected.", file=path, remedy="name a file") from None
    except UnicodeDecodeError:
        raise _no_text(path) from None
    except OSError as error:
        raise InputError("The table cannot be opened.", file=path, found=str(error)) from None
    if "\0" in line:
        raise _no_text(path)
    if not line.strip():
        raise InputError(
            "The table is empty.",
            file=path,
            expected="a header line: frame,track,x,y",
            remedy="check the path",
        )
    separator = max(_SEPARATORS, key=line.count)
    return [name.strip() for name in next(csv.reader([line], delimiter=separator))], separator


def _no_text(path: Path) -> InputError:
    return InputError(
        "This is no text: a table of tracks is CSV.",
        file=path,
        expected="a header line: frame,track,x,y",
        found="binary data, perhaps an image or a video",
        remedy="export the tracks as CSV",
    )


def matched_columns(header: Sequence[str]) -> dict[str, str]:
    """Our name → the column of the file; a column's own name goes before its synonyms."""
    lower = {name.lower(): name for name in reversed(header)}
    result = {}
    for ours, synonyms in SYNONYMS.items():
        theirs = next((lower[name] for name in (ours, *synonyms) if name in lower), None)
        if theirs is not None:
            result[ours] = theirs
    return result


def _missing_column(path: Path, name: str, header: Sequence[str]) -> InputError:
    listed = ", ".join(header)[:200]
    numbers = all(natural_order(cell)[0] == 0 for cell in header)
    near = did_you_mean(name, (cell for cell in header if len(cell) > 1))
    return InputError(
        f"The table has no column '{name}'{near or '.'}",
        file=path,
        key="header",
        expected=", ".join((name, *SYNONYMS[name])),
        found=listed,
        remedy="write a header line" if numbers else "rename the column in the header line",
    )


def numbers(column: pd.Series, name: str, path: Path, infinite: bool = False) -> np.ndarray:
    """A column of numbers; NaN where it is empty."""
    import pandas as pd

    if not pd.api.types.is_numeric_dtype(column):
        values = pd.to_numeric(column.astype(object).map(_stripped), errors="coerce")
        wrong = np.flatnonzero(values.isna() & column.notna())
        wrong = wrong[[str(column.iloc[i]).strip().lower() not in ("", "nan") for i in wrong]]
        if len(wrong):
            i = int(wrong[0])
            raise row_error(path, name, int(column.index[i]), "a number", repr(column.iloc[i]))
        column = values
    result = column.to_numpy(dtype=float)
    if not infinite and (beyond := np.isinf(result)).any():
        i = int(np.argmax(beyond))
        raise row_error(path, name, int(column.index[i]), "a finite number, or nothing", str(result[i]))
    return result


def _stripped(value: Any) -> Any:
    return value.strip() if isinstance(value, str) else value


def frames(column: pd.Series, path: Path, name: str = "frame") -> np.ndarray:
    """A column of frames: whole numbers from 0."""
    values = numbers(column, name, path)
    with np.errstate(invalid="ignore"):
        wrong = ~((values >= 0) & (values == np.round(values)) & (values < _LAST_FRAME))
    if wrong.any():
        i = int(np.argmax(wrong))
        raise row_error(
            path,
            name,
            int(column.index[i]),
            "a whole number from 0",
            "nothing" if np.isnan(values[i]) else f"{values[i]:g}",
        )
    return values.astype(np.int64)


def animals(column: pd.Series, path: Path) -> np.ndarray:
    """A column of true animals: whole numbers; −1 where it is empty."""
    values = numbers(column, "animal", path)
    values = np.where(np.isnan(values), CLUTTER, values)
    wrong = values != np.round(values)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise row_error(path, "animal", int(column.index[i]), "a whole number", f"{values[i]:g}")
    return values.astype(np.int64)


def row_error(path: Path, column: str, row: int, expected: str, found: str) -> InputError:
    """The error for one value; rows of the file count from 0."""
    return InputError(
        f"A value in column '{column}' cannot be used.",
        file=path,
        key=f"row {row + 1} after the header (line {row + 2})",
        expected=expected,
        found=found,
        remedy="mend that row, or export the tracks again",
    )


def labels(column: pd.Series) -> pd.Series:
    """A column as text: whole numbers without a point, missing where it is empty or −1."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(column):
        values = column.to_numpy()
        bare = np.isnan(values) | np.isinf(values) | (values == BARE)
        known, place = np.unique(values[~bare], return_inverse=True)
        text = np.array([str(int(v)) if v == round(v) else repr(float(v)) for v in known], dtype=object)
        result = np.full(len(values), None, dtype=object)
        result[~bare] = text[place]
        return pd.Series(result, index=column.index, dtype=object)
    text = column.astype(object).where(column.notna(), None)
    cleaned = text.map(lambda value: None if value is None else str(value).strip())
    return cleaned.where(~cleaned.isin(["", str(BARE)]), None)


def natural_order(name: str) -> tuple[int, float, str]:
    """Sorts numbers by their value, before names; and id2 before id10."""
    try:
        return (0, float(name), name)
    except ValueError:
        return (1, 0.0, re.sub(r"\d+", lambda number: number[0].zfill(12), name))
