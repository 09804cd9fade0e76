"""Rows of 2D tracks for a scene: from any file to clean rows of one camera.

A scene joins individuals over cameras by their names, so a row without a name is of no use here; and one
individual is in one place at a time. Shapes: P rows.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.track_table import natural_order
from acino_fte.data_tools.tracks2d import BARE, Tracks2D
from acino_fte.errors import InputError

_WHOLE = re.compile(r"[+-]?\d+(\.0*)?")
_NOBODY = ("", "nan", "none", str(BARE))
_LOW, _HIGH, _SOME = -50.0, 100_000.0, 0.05  # px: no noise at the left edge, no image; share of the rows
_SAME = 1e-6  # px


@dataclass(frozen=True, eq=False)
class TrackRows:
    """Rows of one camera as a file has them.

    Attributes
    ----------
    frame : (P,) int
    code : (P,) int
        Index into `names`; −1 where the row has no individual.
    names : tuple of str
        Of the individuals, as :func:`identity` writes them, each once.
    xy : (P, 2)
        Pixels; NaN where there is no dot.
    row : (P,) int
        Row of the file, from 0.
    """

    frame: np.ndarray
    code: np.ndarray
    names: tuple[str, ...]
    xy: np.ndarray
    row: np.ndarray

    def __len__(self) -> int:
        return len(self.frame)

    def at_rows(self, rows: np.ndarray) -> TrackRows:
        """The rows that an index or a mask (P,) picks; the names all stay."""
        return TrackRows(self.frame[rows], self.code[rows], self.names, self.xy[rows], self.row[rows])


def identity(value: Any) -> str:
    """The one name of an individual: 0, 0.0, "0" and "00" are "0"; other text stays, without outer spaces.

    Empty where the value says that there is none: nothing, NaN or −1.
    """
    text = value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    text = text.strip()
    if _WHOLE.fullmatch(text):
        text = str(int(text.partition(".")[0]))
    return "" if text.lower() in _NOBODY else text


def make_rows(
    frame: np.ndarray,
    code: np.ndarray,
    values: Iterable[Any],
    xy: np.ndarray,
    row: np.ndarray | None = None,
) -> TrackRows:
    """Rows whose individuals are places in a list of any values, −1 for none; equal names become one."""
    names = [identity(value) for value in values]
    known = sorted({name for name in names if name}, key=natural_order)
    place = {name: i for i, name in enumerate(known)}
    lookup = np.array([*(place.get(name, BARE) for name in names), BARE], dtype=np.int64)
    return TrackRows(
        np.asarray(frame, dtype=np.int64),
        lookup[np.asarray(code, dtype=np.int64)],
        tuple(known),
        np.ascontiguousarray(xy, dtype=float).reshape(-1, 2),
        np.arange(len(frame)) if row is None else np.asarray(row),
    )


def clean_rows(rows: TrackRows, camera: str, path: Path) -> tuple[TrackRows, list[str]]:
    """Rows with a place and an individual, sorted by individual, then frame, and notes on those left out.

    Rows at exactly (−1, −1) have no place: trackers write that for an individual they did not find.

    Raises
    ------
    InputError
        Coordinates are of no image, or an individual has two places in one frame.
    """
    notes = []
    placed = np.isfinite(rows.xy).all(1) & ~(rows.xy == -1).all(1)
    if (n := len(rows) - int(placed.sum())) > 0:
        notes.append(f"{_rows(n)} of camera '{camera}' have no coordinates: left out.")
    known = rows.code != BARE
    if (n := int((placed & ~known).sum())) > 0:
        notes.append(f"{_rows(n)} of camera '{camera}' have no individual: left out.")
    rows = rows.at_rows(placed & known)
    if not len(rows):
        return rows, notes
    _check_pixels(rows, camera, path)
    order, n_copies = places_in_order(rows, camera, path)
    if n_copies:
        notes.append(f"{_rows(n_copies)} of camera '{camera}' are copies of others: left out.")
    return rows.at_rows(order), notes


def places_in_order(rows: TrackRows, camera: str, path: Path | None) -> tuple[np.ndarray, int]:
    """The order by individual, then frame, without copies of a row, and how many copies there are.

    Raises
    ------
    InputError
        An individual has two places in one frame.
    """
    if not len(rows):
        return np.zeros(0, dtype=np.int64), 0
    key = rows.code * (int(np.ptp(rows.frame)) + 1) + (rows.frame - rows.frame.min())
    order = np.argsort(key, kind="stable")
    if not (np.diff(key[order]) == 0).any():
        return order, 0
    order = np.lexsort((rows.row, rows.xy[:, 1], rows.xy[:, 0], key))
    again = np.diff(key[order]) == 0
    apart = np.abs(np.diff(rows.xy[order], axis=0)).max(1) > _SAME
    _check_places(rows, order, again & apart, camera, path)
    return order[np.append(True, ~again)], int(again.sum())


def joined_tracks(
    parts: Sequence[tuple[str, TrackRows | None, Path | None]],
) -> tuple[tuple[Tracks2D, ...], tuple[str, ...]]:
    """Tracks of all cameras with one list of individuals: a track's number is the same in every camera.

    Parameters
    ----------
    parts : sequence of (camera, rows or None, file)
        Rows with a place, without copies; those without an individual become bare points.

    Returns
    -------
    tuple
        Tracks2D for each part, and the names of the individuals that have a row.
    """
    seen = {
        rows.names[i] for _, rows, _ in parts if rows is not None for i in np.unique(rows.code) if i != BARE
    }
    names = tuple(sorted(seen, key=natural_order))
    place = {name: i for i, name in enumerate(names)}
    views = []
    for camera, rows, path in parts:
        if rows is None:
            rows = make_rows(np.zeros(0), np.zeros(0), (), np.zeros((0, 2)))
        lookup = np.array([*(place.get(name, BARE) for name in rows.names), BARE], dtype=np.int64)
        track = lookup[rows.code]
        order = np.lexsort((rows.frame, track))
        views.append(
            Tracks2D(
                camera=camera,
                frame=rows.frame[order],
                track=track[order],
                xy=rows.xy[order],
                labels=names,
                path=path,
                row=rows.row[order],
            )
        )
    return tuple(views), names


def _check_pixels(rows: TrackRows, camera: str, path: Path) -> None:
    outside = ((rows.xy < _LOW) | (rows.xy > _HIGH)).any(1)
    if outside.mean() <= _SOME:
        return
    low, high = rows.xy.min(0), rows.xy.max(0)
    raise InputError(
        f"The coordinates of camera '{camera}' are no pixels of an image.",
        file=path,
        expected="x to the right and y down from the upper left pixel, px",
        found=f"x from {low[0]:.0f} to {high[0]:.0f}, y from {low[1]:.0f} to {high[1]:.0f}; "
        f"{outside.mean():.0%} of the rows outside",
        remedy="export the tracks in pixels of the video that the model was made of",
    )


def _check_places(
    rows: TrackRows, order: np.ndarray, wrong: np.ndarray, camera: str, path: Path | None
) -> None:
    if not wrong.any():
        return
    at = int(np.argmax(wrong))
    first, second = order[at], order[at + 1]
    places = " and ".join("({:.2f}, {:.2f})".format(*rows.xy[i]) for i in (first, second))
    raise InputError(
        f"Individual '{rows.names[rows.code[first]]}' has two places in frame {rows.frame[first]} of camera "
        f"'{camera}'.",
        file=path,
        key=f"rows {rows.row[first] + 1} and {rows.row[second] + 1} of the data",
        expected="one place for each individual and frame",
        found=f"{places}; {_rows(int(wrong.sum()))} too many in all",
        remedy="give the other animal a name of its own, or remove the wrong rows",
    )


def _rows(n: int) -> str:
    return f"{n} row{'' if n == 1 else 's'}"
