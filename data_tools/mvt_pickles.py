"""Tracks in the layout of MultiViewTracks: dictionaries of arrays, pickled, one file for each camera.

============  ============================================================================================
tracks        ``IDENTITIES`` (whole numbers), ``FRAME_IDX`` (all frames), and under each identity as text a
              dictionary with ``FRAME_IDX``, ``X`` and ``Y`` of equal length
sub-tracks    the same, with a list of such dictionaries under each identity and no ``FRAME_IDX``
pooled        ``IDENTITY``, ``FRAME_IDX``, ``X`` and ``Y`` of equal length, a row for each dot
============  ============================================================================================

Other entries are passed over. Files of NumPy 1 and 2 are read alike, and so that they cannot run code.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.individual_rows import TrackRows, identity, make_rows
from acino_fte.data_tools.safe_pickle import load_data_pickle
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError

_ALL, _POOLED, _FRAME, _X, _Y, _Z = "IDENTITIES", "IDENTITY", "FRAME_IDX", "X", "Y", "Z"
_LAST_FRAME = 2**31


def read_mvt_pickle(path: Path | str) -> TrackRows:
    """Read the pickle of one camera.

    Raises
    ------
    InputError
        The pickle holds something else than data, it is broken, or it is in no layout of MultiViewTracks.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError("The file cannot be opened.", file=path, found=str(error)) from None
    return rows_from_mvt(load_data_pickle(data, file=path), path)


def rows_from_mvt(data: Any, path: Path | str = "tracks") -> TrackRows:
    """Rows from a dictionary of MultiViewTracks: tracks, sub-tracks or pooled."""
    path = Path(path)
    if not isinstance(data, Mapping):
        raise _no_mvt(path, type(data).__name__)
    data = {key.decode("latin1") if isinstance(key, bytes) else key: value for key, value in data.items()}
    if _POOLED in data:
        frame, xy = _dots(data, path, _POOLED)
        values, code = np.unique(np.ravel(np.asarray(data[_POOLED])), return_inverse=True)
        if len(code) != len(frame):
            raise _lengths(path, _POOLED, f"{len(code)} {_POOLED}, {len(frame)} {_FRAME}")
        return make_rows(frame, code, values, xy)
    names = _identities(data, path)
    pieces, codes = [], []
    for i, name in enumerate(names):
        value = names[name]
        for piece in value if isinstance(value, list | tuple) else [value]:
            pieces.append(_dots(piece, path, name))
            codes.append(np.full(len(pieces[-1][0]), i))
    if not pieces:
        return make_rows(np.zeros(0), np.zeros(0), (), np.zeros((0, 2)))
    frame = np.concatenate([frame for frame, _ in pieces])
    return make_rows(frame, np.concatenate(codes), names, np.concatenate([xy for _, xy in pieces]))


def to_mvt(tracks: Tracks2D) -> dict[str, Any]:
    """The dots of one camera as a dictionary of MultiViewTracks; the frames of each identity rise.

    Labels that are whole numbers become the identities; if any label is none, all are numbered 0, 1, …, in
    their order. Labels without a dot and bare points are left out. The arrays are new.
    """
    order = np.lexsort((tracks.frame, tracks.track))
    order = order[tracks.track[order] >= 0]
    used, start = np.unique(tracks.track[order], return_index=True)
    labels = [identity(tracks.labels[i]) for i in used]
    whole = all(label.lstrip("-").isdigit() for label in labels)
    numbers = [int(label) if whole else i for i, label in enumerate(labels)]
    result: dict[str, Any] = {
        _ALL: np.array(numbers, dtype=np.int64),
        _FRAME: np.unique(tracks.frame[order]).astype(np.int64),
    }
    for number, rows in zip(numbers, np.split(order, start[1:]), strict=False):
        x, y = tracks.xy[rows].T
        result[str(number)] = {_FRAME: tracks.frame[rows].astype(np.int64), _X: x.copy(), _Y: y.copy()}
    return result


def from_mvt(data: Mapping[str, Any], camera: str) -> Tracks2D:
    """The dots of one camera from a dictionary of MultiViewTracks; rows without coordinates are left out.

    Parameters
    ----------
    data : mapping
        Tracks, sub-tracks or pooled.
    camera : str
        Its name.
    """
    rows = rows_from_mvt(data)
    rows = rows.at_rows(np.isfinite(rows.xy).all(1))
    return Tracks2D(camera, rows.frame, rows.code, rows.xy, rows.names)


def _identities(data: Mapping[Any, Any], path: Path) -> dict[str, Any]:
    """What belongs to each identity, by its name; identities without an entry were not seen."""
    entries = {identity(key): value for key, value in data.items() if key not in (_ALL, _FRAME)}
    if _ALL not in data:
        raise _no_mvt(path, ", ".join(map(str, data))[:200] or "an empty dictionary")
    try:
        listed = [identity(value) for value in np.ravel(np.asarray(data[_ALL]))]
    except ValueError:
        raise _no_mvt(path, f"{_ALL} is a list of lists") from None
    found = {
        name: value
        for name, value in entries.items()
        if name in listed or (isinstance(value, Mapping) and _FRAME in value)
    }
    if listed and not found:
        raise _no_mvt(path, f"{_ALL} {', '.join(listed)[:80]} and none of them in the file")
    return found


def _dots(piece: Any, path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Frames (P,) and pixels (P, 2) of one identity or piece."""
    if not isinstance(piece, Mapping) or not {_FRAME, _X, _Y} <= set(piece):
        found = ", ".join(map(str, piece)) if isinstance(piece, Mapping) else type(piece).__name__
        raise _no_mvt(path, f"under '{name}': {found[:200]}")
    if _Z in piece:
        raise InputError(
            "These are 3D tracks; pixels of one camera were expected.",
            file=path,
            key=name,
            expected=f"{_FRAME}, {_X}, {_Y}",
            found=", ".join(map(str, piece))[:200],
            remedy="pass the tracks that were found in the videos",
        )
    columns = []
    for key in (_FRAME, _X, _Y):
        try:
            columns.append(np.asarray(piece[key], dtype=float).ravel())
        except (TypeError, ValueError):
            raise InputError(
                f"'{key}' of identity '{name}' is no array of numbers.",
                file=path,
                key=f"{name}/{key}",
                expected="numbers",
                found=repr(piece[key])[:100],
                remedy="export the tracks again",
            ) from None
    if len({len(column) for column in columns}) != 1:
        found = ", ".join(f"{len(c)} {key}" for key, c in zip((_FRAME, _X, _Y), columns, strict=True))
        raise _lengths(path, name, found)
    frame, xy = columns[0], np.stack(columns[1:], axis=1)
    with np.errstate(invalid="ignore"):
        wrong = ~((frame >= 0) & (frame == np.round(frame)) & (frame < _LAST_FRAME))
    if wrong.any():
        raise InputError(
            f"A frame of identity '{name}' cannot be used.",
            file=path,
            key=f"{name}/{_FRAME}[{int(np.argmax(wrong))}]",
            expected="a whole number from 0",
            found=f"{frame[np.argmax(wrong)]:g}",
            remedy="count images from 0, not seconds",
        )
    xy[~np.isfinite(xy).all(1)] = np.nan
    return frame.astype(np.int64), xy


def _lengths(path: Path, name: str, found: str) -> InputError:
    return InputError(
        "Frames and coordinates differ in length.",
        file=path,
        key=name,
        expected=f"a frame for each {_X} and {_Y}",
        found=found,
        remedy="export the tracks again",
    )


def _no_mvt(path: Path, found: str) -> InputError:
    return InputError(
        "The pickle holds no tracks of MultiViewTracks.",
        file=path,
        expected=f"{_ALL}, and under each of them as text {_FRAME}, {_X}, {_Y}; or {_POOLED}, {_FRAME}, "
        f"{_X}, {_Y}",
        found=found,
        remedy="write the tracks as CSV: frame, individual, x, y",
    )
