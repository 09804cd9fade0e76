"""Point clouds in other files: KITTI's .bin, NumPy's .npy and .npz, and tables of text."""

from __future__ import annotations

import io
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.clouds_tables import Columns, binary_rows, text_rows
from acino_fte.errors import InputError

_ORDER = ("x", "y", "z", "intensity")
_FAR_M = 100_000.0
_SPLIT = re.compile(rb"[,;\t]")


def read_bin(data: bytes, path: Path) -> Columns:
    """KITTI's scans: four float32 a point, x, y, z and reflectance (nuScenes' .pcd.bin: five, with the ring).

    Raises
    ------
    InputError
        The numbers are no points.
    """
    names = (*_ORDER, "ring") if path.name.endswith(".pcd.bin") else _ORDER
    row = np.dtype([(name, "<f4") for name in names])
    columns = binary_rows(data, row, -(-len(data) // row.itemsize))
    xyz = np.stack([columns.values[axis] for axis in "xyz"], axis=1)
    far = (np.abs(xyz[np.isfinite(xyz).all(1)]) > _FAR_M).any(1)
    if not len(xyz) or far.mean() > 0.01 or np.isnan(xyz).any(1).mean() > 0.5:
        raise InputError(
            "The file is no scan of KITTI's kind.",
            file=path,
            expected=f"{len(names)} float32 a point: {', '.join(names)}",
            found=f"{len(data)} bytes that make no positions",
            remedy="name the file by its format (.pcd, .ply, .npy, .csv)",
        )
    return columns


def read_numpy(data: bytes, path: Path) -> Columns:
    """An array (K, 3) or (K, 4): x, y, z, intensity; or a structured one; or an .npz of named arrays.

    An .npz has ``xyz`` or ``points`` (K, 3), and may have ``intensity``, ``time``, ``rgb`` and others.
    Nothing in it is ever run: pickled objects are refused.
    """
    try:
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
        arrays = {name: loaded[name] for name in loaded.files} if hasattr(loaded, "files") else {"": loaded}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error, KeyError, SyntaxError) as error:
        cut = _cut_array(data)
        if cut is None:
            raise _no_points(path, str(error)) from error
        rows, lost = cut
        columns = _of_array("", rows, path)
        columns.n_lost = lost
        return columns
    if "" in arrays:
        return _of_array("", arrays[""], path)
    return _of_arrays(arrays, path)


def _cut_array(data: bytes) -> tuple[np.ndarray, int] | None:
    """The whole rows of an .npy that is cut, and how many are missing."""
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read: Any = getattr(np.lib.format, f"read_array_header_{version[0]}_0")
        shape, by_column, kind = read(file)
    except (ValueError, OSError, AttributeError, EOFError, SyntaxError):
        return None
    if by_column or kind.hasobject or len(shape) not in (1, 2) or not kind.itemsize:
        return None
    width = int(np.prod(shape[1:]))
    rows = (len(data) - file.tell()) // max(kind.itemsize * width, 1)
    if not 0 < rows < shape[0]:
        return None
    values = np.frombuffer(data, kind, rows * width, file.tell())
    return values.reshape(rows, *shape[1:]), int(shape[0] - rows)


def _of_arrays(arrays: dict[str, np.ndarray], path: Path) -> Columns:
    lower = {name.lower(): array for name, array in arrays.items()}
    key = next((name for name in ("xyz", "points", "cloud") if name in lower), None)
    if key is None and set("xyz") <= set(lower):
        columns = Columns({})
    elif key is None:
        raise _no_points(path, f"arrays {', '.join(arrays) or 'none'}")
    else:
        columns = _of_array(key, lower[key], path)
    n = len(columns) if key else len(np.atleast_1d(lower["x"]))
    for name, array in lower.items():
        if name == key or array.dtype.kind not in "fiu":
            continue
        if name in ("rgb", "colors", "colours") and array.shape == (n, 3):
            columns.values |= dict(zip(("red", "green", "blue"), array.T, strict=True))
        elif array.shape == (n,):
            columns.values[name] = array
        elif name in ("intensity", "time", "x", "y", "z"):
            raise _no_points(path, f"'{name}' of the shape {array.shape} beside {n} points")
    return columns


def _of_array(name: str, array: np.ndarray, path: Path) -> Columns:
    if array.dtype.names:
        return Columns({field: array[field].ravel() for field in array.dtype.names})
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "fiu":
        what = f"'{name}': " if name else ""
        raise _no_points(path, f"{what}shape {array.shape}, {array.dtype}")
    return Columns({_ORDER[i]: array[:, i] for i in range(min(4, array.shape[1]))})


def _no_points(path: Path, found: str) -> InputError:
    return InputError(
        "The arrays are no point cloud.",
        file=path,
        expected="numbers (K, 3) or (K, 4): x, y, z, intensity; in an .npz 'xyz' (K, 3) and 'intensity' (K,)",
        found=found,
        remedy="save plain arrays of numbers",
    )


def read_table(data: bytes, path: Path) -> Columns:
    """A table of text with names in its first line: x, y, z and others; or of plain numbers in that order.

    Raises
    ------
    InputError
        The first line names no x, y, z and is no row of numbers.
    """
    lines = [line for line in data.replace(b"\r\n", b"\n").splitlines() if line.strip()]
    if b"\0" in data[:4096] or not lines:
        raise _no_table(path, repr(data[:24])[1:])
    lines[0] = lines[0].lstrip(b"\xef\xbb\xbf#/ ")
    if _SPLIT.search(lines[0]):
        lines = [_SPLIT.sub(b" ", _joined(line)) for line in lines]
    first = lines[0].split()
    names = [name.decode("utf-8", "replace").strip("\"'").lower() for name in first]
    names = [name.split("[")[0].strip() or f"column{i}" for i, name in enumerate(names)]
    if set("xyz") <= set(names):
        unique = [name if name not in names[:i] else f"{name}#{i}" for i, name in enumerate(names)]
        return _typed(lines[1:], unique)
    if len(first) >= 3 and _numbers(first):
        columns = _typed(lines, [_ORDER[i] if i < 4 else f"column{i}" for i in range(len(first))])
        columns.notes.append("The table has no names; its columns were taken as x, y, z, intensity.")
        return columns
    raise _no_table(path, lines[0][:60].decode("utf-8", "replace"))


def _joined(line: bytes) -> bytes:
    """A line of separated cells without blanks within them; an empty cell is NaN."""
    cells = [re.sub(rb"\s+", b"_", cell.strip()) or b"nan" for cell in _SPLIT.split(line)]
    return b",".join(cells)


def _typed(lines: list[bytes], names: list[str]) -> Columns:
    """Columns of whole numbers as int64, others as float."""
    sample = [cells for cells in (line.split() for line in lines[:100]) if len(cells) == len(names)]
    whole = [all(cells[i].lstrip(b"+-").isdigit() for cells in sample) for i in range(len(names))]
    kinds = ["<i8" if whole[i] and sample and name not in "xyz" else "<f8" for i, name in enumerate(names)]
    return text_rows(lines, np.dtype(list(zip(names, kinds, strict=True))))


def _numbers(cells: list[bytes]) -> bool:
    try:
        return bool(np.isfinite([float(cell) for cell in cells[:3]]).all())
    except ValueError:
        return False


def _no_table(path: Path, found: str) -> InputError:
    return InputError(
        "The file is no table of points.",
        file=path,
        expected="a first line with the names x, y, z, and intensity if there is one",
        found=found,
        remedy="write the names into the first line, or name the file by its format",
    )
