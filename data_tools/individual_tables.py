"""Text tables of 2D tracks for a scene, long or wide, of one camera or of all.

======  ====================================================================================================
long    a row for each dot: frame, individual (or track, id, identity, …), x, y; a column camera when the
        table has all cameras. In ``observations.csv`` of our matching the individual is the group
wide    a row for each frame, a pair of columns for each individual: see :mod:`wide_tracks`
======  ====================================================================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.individual_rows import TrackRows, make_rows
from acino_fte.data_tools.track_table import (
    SYNONYMS,
    _parse,
    frames,
    labels,
    matched_columns,
    numbers,
    read_header,
    row_error,
)
from acino_fte.data_tools.wide_tracks import WideLayout, read_wide_values, wide_layout
from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

_GROUP = "group"  # what the matching of tracks calls an individual


def table_kind(path: Path) -> str | None:
    """ "long", "wide" or None when the table is neither."""
    header = read_header(path)[0]
    found = set(matched_columns(header))
    if {"frame", "x", "y"} <= found:
        return "long"
    return "wide" if wide_layout(path) is not None else None


def names_cameras(path: Path) -> bool:
    """Whether a table of tracks has a column that says the camera."""
    if is_empty(path):
        return False
    return table_kind(path) is not None and "cam" in matched_columns(read_header(path)[0])


def is_empty(path: Path) -> bool:
    """Whether a file holds nothing but white space."""
    if path.stat().st_size > 100:
        return False
    return not path.read_bytes().strip(b" \t\r\n\xef\xbb\xbf")


def read_table_rows(path: Path) -> tuple[dict[str | None, TrackRows], list[str]]:
    """The rows of a table by what its camera column says, or under None without one, and notes.

    Raises
    ------
    InputError
        A column is missing or a value cannot be used.
    """
    layout = None if table_kind(path) == "long" else wide_layout(path)
    return _long(path) if layout is None else _wide(path, layout)


def _long(path: Path) -> tuple[dict[str | None, TrackRows], list[str]]:
    import pandas as pd

    header, separator = read_header(path)
    found = matched_columns(header)
    for name in ("frame", "x", "y"):
        if name not in found:
            raise _no_tracks(path, header)
    table = _parse(path, header, sep=separator, skip_blank_lines=False)
    table = table[table.notna().any(axis=1)]
    frame = frames(table[found["frame"]], path)
    xy = np.stack([numbers(table[found[axis]], found[axis], path) for axis in "xy"], axis=1)
    cams = _cameras(table, found, path)
    column, notes = _who(header, found), []
    if column is None:
        _check_alone(frame, xy, cams, path)
        code, values = np.zeros(len(frame), dtype=np.int64), ["0"]
        if len(frame):
            notes.append(f"{path.name} has no column for the individual: taken as one, called '0'.")
    else:
        code, names = pd.factorize(labels(table[column]))
        values = list(names)
    rows = make_rows(frame, code, values, xy, table.index.to_numpy())
    return _by_camera(rows, cams), notes


def _wide(path: Path, layout: WideLayout) -> tuple[dict[str | None, TrackRows], list[str]]:
    table, xy = read_wide_values(path, layout)
    frame = frames(table.iloc[:, layout.frame], path)
    found = matched_columns(layout.header)
    cams = _cameras(table, found, path)
    which, who = np.nonzero(np.isfinite(xy).any(-1))
    rows = make_rows(frame[which], who, layout.names, xy[which, who], table.index.to_numpy()[which])
    return _by_camera(rows, None if cams is None else (cams[0][which], cams[1])), []


def _who(header: Sequence[str], found: dict[str, str]) -> str | None:
    """The column of the individual."""
    group = next((name for name in header if name.lower() == _GROUP), None)
    if group is not None and "cam" in found:
        return group
    return found.get("track", found.get("animal", group))


def _cameras(table: pd.DataFrame, found: dict[str, str], path: Path) -> tuple[np.ndarray, list[str]] | None:
    """The camera of each row, as a place in a list of names; None without such a column."""
    import pandas as pd

    if "cam" not in found:
        return None
    text = labels(table[found["cam"]])
    if (missing := text.isna()).any():
        row = int(text.index[int(np.argmax(missing))])
        raise row_error(path, found["cam"], row, "the name of a camera", "nothing")
    code, names = pd.factorize(text)
    return code, [str(name) for name in names]


def _by_camera(rows: TrackRows, cams: tuple[np.ndarray, list[str]] | None) -> dict[str | None, TrackRows]:
    if cams is None:
        return {None: rows}
    code, names = cams
    order = np.argsort(code, kind="stable")
    parts = np.split(order, np.searchsorted(code[order], np.arange(1, len(names))))
    return {name: rows.at_rows(part) for name, part in zip(names, parts, strict=True) if len(part)}


def _check_alone(
    frame: np.ndarray, xy: np.ndarray, cams: tuple[np.ndarray, list[str]] | None, path: Path
) -> None:
    """Without a column for the individual there is one dot in a frame."""
    seen = np.isfinite(xy).all(1)
    place = np.stack([frame, np.zeros_like(frame) if cams is None else cams[0]], axis=1)[seen]
    places, n_dots = np.unique(np.column_stack([place, xy[seen]]), axis=0), 0
    if len(places):
        n_dots = int(np.unique(places[:, :2], axis=0, return_counts=True)[1].max())
    if n_dots > 1:
        raise InputError(
            "The table does not say which dot belongs to which individual.",
            file=path,
            key="header",
            expected=f"a column individual ({', '.join(SYNONYMS['track'])})",
            found=f"up to {n_dots} dots in a frame",
            remedy="export the identities with the tracks, or match the tracks of all cameras first",
        )


def _no_tracks(path: Path, header: Sequence[str]) -> InputError:
    return InputError(
        "The table holds no tracks.",
        file=path,
        key="header",
        expected="columns frame, individual, x, y; or frame and a pair A_x, A_y for each individual",
        found=", ".join(header)[:200],
        remedy="rename the columns in the header line",
    )
