"""PLY files of lidars: whole ones by plyfile, of cut ones the vertices that are whole."""

from __future__ import annotations

import io
from pathlib import Path
from typing import BinaryIO

import numpy as np

from acino_fte.data_tools.clouds_tables import Columns, binary_rows, text_rows
from acino_fte.errors import InputError

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply_columns(data: bytes, path: Path) -> Columns:
    """The properties of the vertices as columns.

    Raises
    ------
    InputError
        The header is none, or there are no vertices.
    """
    from plyfile import PlyData, PlyParseError

    try:
        elements = {element.name: element for element in PlyData.read(io.BytesIO(data)).elements}
        table = elements["vertex"].data
    except (PlyParseError, KeyError, ValueError, OSError, MemoryError, EOFError, IndexError) as error:
        return _cut(data, path, str(error) or type(error).__name__)
    names = [name for name in table.dtype.names or () if table.dtype[name].kind in "fiu"]
    return Columns({name: np.asarray(table[name]) for name in names})


def _cut(data: bytes, path: Path, why: str) -> Columns:
    """The whole vertices of a file that is cut or damaged."""
    head, mark, body = data.partition(b"end_header")
    ending = body[:2] if body[:2] == b"\r\n" else body[:1]
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    order = next((_ORDERS.get(words[1]) for words in lines if len(words) > 1 and words[0] == "format"), None)
    row, n = _vertices(lines, order or "<")
    if not mark or lines[0] != ["ply"] or order is None or row is None:
        raise InputError(
            "The file cannot be read as PLY.",
            file=path,
            expected="a PLY file with vertices, ascii or binary",
            found=why,
            remedy="export it again: the points themselves, not only faces",
        )
    body = body[len(ending) :]
    if ["format", "ascii"] in [words[:2] for words in lines]:
        return text_rows(body.splitlines(), row, n)
    return binary_rows(body, row, n)


def _vertices(lines: list[list[str]], order: str) -> tuple[np.dtype | None, int]:
    """Layout and number of the vertices, if they are the first element and of plain numbers."""
    fields: list[tuple[str, str]] = []
    n = -1
    for words in lines:
        if words[:1] == ["element"]:
            if n >= 0:
                break
            if len(words) != 3 or words[1] != "vertex" or not words[2].isdecimal():
                return None, 0
            n = int(words[2])
        elif words[:1] == ["property"] and n >= 0:
            if len(words) != 3 or words[1] not in _TYPES or words[2] in dict(fields):
                return None, 0
            fields.append((words[2], order + _TYPES[words[1]]))
    return (np.dtype(fields), n) if fields else (None, 0)


def write_ply_columns(file: BinaryIO, columns: dict[str, np.ndarray], text: bool) -> None:
    """Write columns as the vertices of a PLY file, in their own types."""
    from plyfile import PlyData, PlyElement

    kinds = [(name, column.dtype.str) for name, column in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), kinds)
    for name, column in columns.items():
        table[name] = column
    PlyData([PlyElement.describe(table, "vertex")], text=text, byte_order="<").write(file)
