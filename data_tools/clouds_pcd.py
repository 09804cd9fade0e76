"""PCD files, the point clouds of PCL: ascii, binary and binary_compressed.

The files are read here and not by pypcd4, which refuses a file that is cut and text that is not quite its
own; it writes them, and its LZF unpacks whole bodies. Format: PCL's documentation of PCD v0.7.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from acino_fte.data_tools.clouds_tables import Columns, binary_rows, text_rows
from acino_fte.errors import InputError
from acino_fte.extras import missing_package

_KINDS = {"F": "f", "U": "u", "I": "i"}
_WAYS = ("ascii", "binary", "binary_compressed")
_REMEDY = "export it again as PCD v0.7"
_WORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


@dataclass(frozen=True)
class _Header:
    row: np.dtype
    n: int
    data: str
    start: int


def read_pcd(data: bytes, path: Path) -> Columns:
    """The fields of a PCD file as columns; fields of several numbers as ``name_0``, ``name_1``, ….

    Raises
    ------
    InputError
        The header is none, or says what no PCD can be.
    """
    header = _header(data, path)
    body = data[header.start :]
    if header.data == "ascii":
        return text_rows(body.splitlines(), header.row, header.n)
    if header.data == "binary":
        return binary_rows(body, header.row, header.n)
    return _compressed(body, header, path)


def _header(data: bytes, path: Path) -> _Header:
    """The header; its lines end with DATA."""
    words: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in words:
        stop = data.find(b"\n", at)
        if stop < 0 or at > 65_536:
            raise _broken(path, "the lines VERSION to DATA", "a header without its line DATA")
        line = data[at:stop].decode("ascii", "replace").strip()
        at = stop + 1
        name, *values = line.split() or [""]
        if name in _WORDS:
            words[name] = values
        elif name and not name.startswith("#"):
            raise _broken(path, f"one of {', '.join(_WORDS)}", repr(line[:60]))
    way = "".join(words["DATA"][:1]).lower()
    if way not in _WAYS:
        raise _broken(path, f"DATA {', '.join(_WAYS)}", f"DATA {way or 'without a word'}")
    return _Header(_row(words, path), _points(words, path), way, at)


def _row(words: dict[str, list[str]], path: Path) -> np.dtype:
    """The layout of one point."""
    names, sizes, types = (words.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = words.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        lengths = f"{len(names)} names, {len(sizes)} sizes, {len(types)} types, {len(counts)} counts"
        raise _broken(path, "FIELDS, SIZE, TYPE and COUNT of one length", lengths)
    fields, seen = [], set()
    for place, (name, size, kind, count) in enumerate(zip(names, sizes, types, counts, strict=True)):
        try:
            number, repeats = np.dtype(f"<{_KINDS[kind]}{int(size)}"), int(count)
        except (KeyError, TypeError, ValueError):
            raise _broken(path, "TYPE F, U or I of SIZE 1, 2, 4 or 8", f"{kind} {size} × {count}") from None
        if not 0 < repeats <= 65_536:
            raise _broken(path, "COUNT of at least 1", f"{name}: {count}")
        for i in range(repeats):
            label = name if repeats == 1 else f"{name}_{i}"
            if label in seen or label == "_":
                label = f"{label}#{place}.{i}"
            seen.add(label)
            fields.append((label, number))
    return np.dtype(fields)


def _points(words: dict[str, list[str]], path: Path) -> int:
    try:
        if "POINTS" in words:
            n = int(words["POINTS"][0])
        else:
            n = int(words["WIDTH"][0]) * int(words.get("HEIGHT", ["1"])[0])
    except (KeyError, IndexError, ValueError):
        n = -1
    if n < 0:
        raise _broken(path, "POINTS, or WIDTH and HEIGHT, as whole numbers", str(words.get("POINTS")))
    return n


def _broken(path: Path, expected: str, found: str) -> InputError:
    return InputError(
        "The header of the PCD file cannot be read.",
        file=path,
        expected=expected,
        found=found,
        remedy=_REMEDY,
    )


def _compressed(body: bytes, header: _Header, path: Path) -> Columns:
    """A body packed by LZF, one field after the other; a cut one gives the points whose place it holds."""
    sizes = np.frombuffer(body[:8].ljust(8, b"\0"), "<u4")
    packed, size = body[8 : 8 + int(sizes[0])], header.n * header.row.itemsize
    unpacked = _unpacked(packed, size) if len(packed) == sizes[0] and size == sizes[1] else None
    if unpacked is None:
        unpacked = lzf_prefix(packed, size)
    columns, held, at = {}, {}, 0
    for name in header.row.names or ():
        kind = header.row[name]
        part = unpacked[at : at + header.n * kind.itemsize]
        held[name] = len(part) // kind.itemsize
        columns[name] = np.frombuffer(part, kind, held[name])
        at += header.n * kind.itemsize
    whole = min((held[name] for name in held if name in "xyz"), default=0)
    short = [name for name, rows in held.items() if rows < whole]
    kept = {name: column[:whole] for name, column in columns.items() if name not in short}
    notes = [f"The file is cut: its fields {', '.join(short)} are not whole."] if short and whole else []
    return Columns(kept, header.n - whole, notes)


def _unpacked(packed: bytes, size: int) -> bytes | None:
    """The whole body, or None where it is damaged."""
    unpack = _lzf().decompress
    try:
        out = unpack(packed, size)
    except (ValueError, MemoryError, OSError):
        return None
    return out if out is not None and len(out) == size else None


def _lzf() -> Any:
    try:
        import lzf
    except ImportError as error:
        raise missing_package("Packed PCD files", error) from error
    return lzf


def lzf_prefix(packed: bytes, size: int) -> bytes:
    """Unpack LZF as far as it goes, at most `size` bytes.

    A control byte below 32 is followed by so many + 1 plain bytes; any other is a copy from behind: its upper
    three bits + 2 bytes (7: the next byte is added) from lower five bits · 256 + a byte + 1 back (LibLZF).
    """
    out, at = bytearray(), 0
    while at < len(packed) and len(out) < size:
        control = packed[at]
        at += 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7 and at < len(packed):
            length += packed[at]
            at += 1
        if at >= len(packed):
            break
        back = ((control & 31) << 8) + packed[at] + 1
        at += 1
        if back > len(out):
            break
        for _ in range(length + 2):
            out.append(out[-back])
    return bytes(out[:size])


def write_pcd(file: BinaryIO, columns: dict[str, np.ndarray], way: str) -> None:
    """Write columns as PCD v0.7.

    Raises
    ------
    InputError
        There is no such kind of PCD, or pypcd4 is not installed.
    """
    if way not in _WAYS:
        raise InputError("There is no such kind of PCD file.", expected=", ".join(_WAYS), found=way)
    try:
        from pypcd4 import Encoding, PointCloud
    except ImportError as error:
        raise missing_package("PCD files", error, instead=", or write a PLY file") from error
    fields = tuple(columns)
    types = tuple(column.dtype.type for column in columns.values())
    PointCloud.from_points(tuple(columns.values()), fields, types).save(file, Encoding(way))
