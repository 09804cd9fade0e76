"""Tables of numbers as text (CSV, TSV, blanks) of sensors: names in the first line, comments, a cut end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

_COMMENTS = ("//", "#")
_MARKS = (",", ";", "\t")
_MISSING = ["", "nan", "na"]


def read_text_table(path: Path, what: str) -> tuple[pd.DataFrame, list[str]]:
    """Cells of a table as text, and the lines that are comments (from ``//`` or ``#``).

    Parameters
    ----------
    path : Path
        Columns apart by commas, semicolons, tabs or blanks; UTF-8.
    what : str
        What it holds, in the plural, for messages: ``"inertial samples"``.

    Raises
    ------
    InputError
        The file cannot be read, is empty, or has a column twice.
    """
    import pandas as pd

    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(
            f"The {what} cannot be read.", file=path, found=str(error), remedy="check the path"
        ) from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"The {what} cannot be read.",
            file=path,
            expected="a table as text, in UTF-8",
            found=str(error),
            remedy="save the table as CSV in UTF-8",
        ) from None
    comments = [line for line in lines if line.startswith(_COMMENTS)]
    rows = [line for line in lines if line.strip() and not line.startswith(_COMMENTS)]
    mark = next((m for m in _MARKS if rows and m in rows[0]), None)
    cells = [[c.strip() for c in (row.split(mark) if mark else row.split())] for row in rows]
    if len(cells) < 2:
        raise InputError(
            f"The table of {what} is empty.",
            file=path,
            expected="a line of names and a line for each sample",
            found=f"{len(cells)} line(s)",
        )
    names = [c for c in cells[0] if c]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError("A column is there twice.", file=path, key=", ".join(twice))
    width = len(names)
    body = [row[:width] + [""] * (width - len(row)) for row in cells[1:]]  # a last line may be cut
    return pd.DataFrame(body, columns=names), comments


def column_numbers(path: Path, table: pd.DataFrame, names: Sequence[str]) -> np.ndarray:
    """Columns (K, …) as numbers; empty cells are NaN.

    Raises
    ------
    InputError
        A cell holds something else; in the last line, which may be cut, it is NaN.
    """
    import pandas as pd

    out = np.empty((len(table), len(names)))
    for i, name in enumerate(names):
        text = table[name]
        values = pd.to_numeric(text, errors="coerce")
        wrong = np.flatnonzero(values.isna() & ~text.str.lower().isin(_MISSING))
        if len(wrong) and wrong[0] != len(table) - 1:
            raise InputError(
                "The table holds something that is no number.",
                file=path,
                key=f"{name}, sample {wrong[0]}",
                expected="a number, or nothing",
                found=repr(text.iloc[wrong[0]]),
            )
        out[:, i] = values
    return out
