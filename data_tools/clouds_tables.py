"""Rows of points in files, binary or text: the whole ones are read, the damaged ones counted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import BinaryIO

import numpy as np

from acino_fte.errors import InputError


@dataclass
class Columns:
    """Columns of a table by name, all of one length, and what was lost on the way."""

    values: dict[str, np.ndarray]
    n_lost: int = 0
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(next(iter(self.values.values()), ()))


def binary_rows(body: bytes, row: np.dtype, n: int) -> Columns:
    """The first `n` rows of a binary body; those that it does not hold are lost."""
    whole = min(n, len(body) // row.itemsize)
    table = np.frombuffer(body, row, whole)
    return Columns({name: table[name] for name in row.names or ()}, n - whole)


def text_rows(lines: list[bytes], row: np.dtype, n: int | None = None) -> Columns:
    """Rows of numbers in text, split at blanks; lines that are no such row are lost.

    Parameters
    ----------
    lines : list of bytes
        What the file has.
    row : dtype
        Structured, a field a column.
    n : int, optional
        How many rows there ought to be.
    """
    names = row.names or ()
    rows = [line.split() for line in lines if line.strip()]
    good = [cells for cells in rows if len(cells) == len(names)][:n]
    try:
        columns = _converted(good, row)
    except (ValueError, OverflowError):
        good = [cells for cells in good if _is_row(cells, row)]
        columns = _converted(good, row)
    return Columns(columns, (len(rows) if n is None else n) - len(good))


def _converted(rows: list[list[bytes]], row: np.dtype) -> dict[str, np.ndarray]:
    cells = np.array(rows, dtype="S32").reshape(len(rows), len(row.names or ()))
    with np.errstate(over="ignore"):
        return {name: cells[:, i].astype(row[name]) for i, name in enumerate(row.names or ())}


def _is_row(cells: list[bytes], row: np.dtype) -> bool:
    try:
        _converted([cells], row)
    except (ValueError, OverflowError):
        return False
    return True


def read_bytes(path: Path) -> bytes:
    """A whole file.

    Raises
    ------
    InputError
        There is no such file, it is empty, or it cannot be read.
    """
    if not path.is_file():
        raise InputError(
            "There is no such point cloud.",
            file=path,
            expected="a file",
            found="a folder" if path.is_dir() else "nothing",
            remedy="check the path",
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError("The point cloud cannot be opened.", file=path, found=str(error)) from error
    if not data:
        raise InputError(
            "The point cloud is empty.",
            file=path,
            expected="points",
            found="0 bytes",
            remedy="export it again",
        )
    return data


@contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """A file to write that appears at its place only when all went well.

    Raises
    ------
    InputError
        It cannot be written.
    """
    part: Path | None = None
    try:
        with NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            part = Path(file.name)
            yield file  # type: ignore[misc]
        part.chmod(0o644)
        part.replace(path)
    except OSError as error:
        raise InputError("The file cannot be written.", file=path, found=str(error)) from error
    finally:
        if part is not None:
            part.unlink(missing_ok=True)
