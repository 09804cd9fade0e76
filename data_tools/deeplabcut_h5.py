"""DeepLabCut's H5: a pandas table as PyTables stores it, read without letting it run its pickles.

pandas stores a frame in one of two layouts. ``table``: one record array; the column names are pickled in
its attributes. ``fixed``: blocks of values; the column names are arrays of levels and codes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.deeplabcut import single_animal
from acino_fte.data_tools.safe_pickle import load_data_pickle
from acino_fte.errors import InputError

_KEY = "df_with_missing"
_NAMES = {
    3: ["scorer", "bodyparts", "coords"],
    4: ["scorer", "individuals", "bodyparts", "coords"],
}
_REMEDY = "save the table as CSV with DeepLabCut and give that"


def read_h5(path: Path) -> tuple[list[tuple[str, str]], np.ndarray, np.ndarray]:
    """Columns (bodypart, coordinate), values (R, columns) and frame numbers (R,) of an H5 table.

    Raises
    ------
    InputError
        The file is not HDF5, holds no table of pandas or several, is packed with a filter that is not
        installed, holds several animals, or holds a pickle that is not data.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            group = _group(file, path)
            kind = _text(group.attrs["pandas_type"])
            if kind == "frame_table":
                names, tuples, values, index = _read_table(group, path)
            elif kind == "frame":
                names, tuples, values, index = _read_fixed(group, path)
            else:
                raise _fault(path, f"a pandas table of the kind {kind!r}")
    except OSError as error:
        raise _fault(path, str(error)) from None
    except (KeyError, IndexError) as error:
        raise _fault(path, f"a part is missing: {error}") from None
    if not np.issubdtype(index.dtype, np.number):
        raise InputError(
            "The rows of the table are not numbered by frame.",
            file=path,
            expected="frame numbers",
            found=repr(_text(index[0])) if len(index) else "no rows",
            remedy="give the table that analyze_videos wrote, not that of labelled images",
        )
    levels = {name: [str(entry[i]) for entry in tuples] for i, name in enumerate(names)}
    return single_animal(levels, path), np.asarray(values, dtype=float), index


def _fault(path: Path, found: str) -> InputError:
    return InputError(
        "The keypoint file cannot be read as a DeepLabCut table.",
        file=path,
        expected="HDF5 with one pandas table, as analyze_videos writes it",
        found=found,
        remedy=_REMEDY,
    )


def _group(file: Any, path: Path) -> Any:
    """The one pandas table of the file."""
    groups = [name for name, item in file.items() if "pandas_type" in item.attrs]
    if _KEY in groups:
        return file[_KEY]
    if len(groups) != 1:
        raise _fault(path, f"{len(groups)} tables among {', '.join(file) or 'nothing'}")
    return file[groups[0]]


def _read_table(group: Any, path: Path) -> tuple[list[str], list[tuple], np.ndarray, np.ndarray]:
    """Level names, column tuples, values and index of the layout ``table``."""
    table = group["table"]
    rows = table[...]
    fields = rows.dtype.names or ()
    if "index" not in fields:
        raise _fault(path, f"a table with the fields {', '.join(fields) or 'none'}")
    tuples: list[tuple] = []
    blocks = []
    for field in fields:
        if field == "index":
            continue
        columns = load_data_pickle(_bytes(table.attrs[f"{field}_kind"]), file=path, key=f"{field}_kind")
        block = rows[field].reshape(len(rows), -1)
        if not isinstance(columns, list) or len(columns) != block.shape[1]:
            raise _fault(path, f"{block.shape[1]} columns in {field}, and other names for them")
        tuples += columns
        blocks.append(block)
    info = load_data_pickle(_bytes(group.attrs["info"]), file=path, key="info")
    names = info.get(1, {}).get("names") if isinstance(info, dict) else None
    values = np.concatenate(blocks, axis=1) if blocks else np.empty((len(rows), 0))
    return _level_names(names, tuples, path), tuples, values, rows["index"]


def _read_fixed(group: Any, path: Path) -> tuple[list[str], list[tuple], np.ndarray, np.ndarray]:
    """Level names, column tuples, values and index of the layout ``fixed``."""
    names: list[Any] | None = None
    tuples: list[tuple] = []
    blocks = []
    for b in range(int(group.attrs["nblocks"])):
        n_levels = int(group.attrs[f"block{b}_items_nlevels"])
        columns = []
        for i in range(n_levels):
            level = _array(group[f"block{b}_items_level{i}"], path)
            codes = group[f"block{b}_items_label{i}"][...]
            columns.append([_text(level[code]) for code in codes])
        stored = group[f"block{b}_values"]
        values = stored[...]
        tuples += list(zip(*columns, strict=True))
        blocks.append(values if stored.attrs.get("transposed", 1) else values.T)
        names = names or [
            _name(group[f"block{b}_items_level{i}"].attrs.get("name"), path) for i in range(n_levels)
        ]
    index = _array(group["axis1"], path)
    values = np.concatenate(blocks, axis=1) if blocks else np.empty((len(index), 0))
    if values.shape != (len(index), len(tuples)):
        raise _fault(path, f"values of shape {values.shape} for {len(index)} rows of {len(tuples)} columns")
    return _level_names(names, tuples, path), tuples, values, index


def _level_names(names: Any, tuples: list[tuple], path: Path) -> list[str]:
    """Names of the header rows; DeepLabCut's own when the file does not say."""
    sizes = {len(entry) if isinstance(entry, tuple) else 1 for entry in tuples}
    size = sizes.pop() if len(sizes) == 1 else 0
    if isinstance(names, (list, tuple)) and len(names) == size and all(isinstance(n, str) for n in names):
        return list(names)
    if size not in _NAMES:
        raise _fault(path, f"columns named {tuples[0]!r}, …" if tuples else "no columns")
    return _NAMES[size]


def _array(dataset: Any, path: Path) -> np.ndarray:
    """An array of pandas' layout ``fixed``; an array of objects is one pickle in a ragged dataset."""
    import h5py

    if h5py.check_vlen_dtype(dataset.dtype) is not None and dataset.shape == (1,):
        return np.asarray(load_data_pickle(bytes(dataset[0]), file=path, key=dataset.name))
    return dataset[...]


def _name(value: Any, path: Path) -> str | None:
    """Name of a level: text, or a pickle (of None) when it has none."""
    text = _text(value) if value is not None else None
    return None if text == "N." else text


def _bytes(value: Any) -> bytes:
    return bytes(value) if isinstance(value, bytes) else str(value).encode("utf-8")


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
