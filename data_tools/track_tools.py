"""Tools for 2D tracks: tables and back, parts of them, sub-tracks, short gaps filled.

Nothing changes its input: every function gives new tracks. A gap is the number of frames without a dot
between two dots of one track: 0 for neighbouring frames. Shapes: P rows of a camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.individual_rows import TrackRows, joined_tracks, make_rows, places_in_order
from acino_fte.data_tools.track_gaps import find_pieces, interpolate_points, name_pieces
from acino_fte.data_tools.track_table import natural_order
from acino_fte.data_tools.tracks2d import BARE, CLUTTER, Tracks2D
from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    import pandas as pd

    from acino_fte.data_tools.scene_tracks import SceneTracks

COLUMNS = ("camera", "individual", "frame", "x", "y")


def pooled_table(tracks: Sequence[Tracks2D]) -> pd.DataFrame:
    """All dots of all cameras in one long table, camera after camera, in the order of their rows.

    Returns
    -------
    pandas.DataFrame
        camera, individual (text; missing for a bare point), frame, x, y (px).
    """
    import pandas as pd

    parts = []
    for view in tracks:
        names = np.array([*view.labels, None], dtype=object)  # the last for bare points, track −1
        x, y = view.xy.T
        columns = (np.full(len(view), view.camera, dtype=object), names[view.track], view.frame.copy(), x, y)
        parts.append(pd.DataFrame(dict(zip(COLUMNS, columns, strict=True))))
    if not parts:
        return pd.DataFrame({name: [] for name in COLUMNS})
    return pd.concat(parts, ignore_index=True)


def tracks_from_table(table: pd.DataFrame, camera_names: Sequence[str]) -> tuple[Tracks2D, ...]:
    """The tracks of each camera from a long table, as :func:`pooled_table` makes it.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns camera, individual, frame, x, y; others are passed over. Rows without an individual become
        bare points, rows without coordinates and copies of other rows are left out.
    camera_names : sequence of str
        The cameras; one without rows has no dots.

    Returns
    -------
    tuple of Tracks2D
        In the order of the cameras, sorted by track, then frame; `labels` are the same in all, and `row` is
        the row of the table.

    Raises
    ------
    InputError
        A column is missing, a camera is unknown, a frame is no whole number, or an individual has two places
        in one frame.
    """
    import pandas as pd

    for name in COLUMNS:
        if name not in table:
            raise InputError(
                f"The table has no column '{name}'{did_you_mean(name, map(str, table)) or '.'}",
                expected=", ".join(COLUMNS),
                found=", ".join(map(str, table)),
            )
    if unknown := sorted(set(table["camera"].astype(str)) - set(camera_names)):
        raise InputError(
            "The table has cameras that are not known.",
            expected=", ".join(camera_names),
            found=", ".join(unknown),
            remedy="name them among the cameras, or take their rows out",
        )
    frame, xy = _whole(table["frame"]), table[["x", "y"]].to_numpy(dtype=float)
    code, names = pd.factorize(table["individual"])
    rows = make_rows(frame, code, names, xy)
    camera = table["camera"].astype(str).to_numpy()
    placed = np.isfinite(xy).all(1)
    parts: list[tuple[str, TrackRows | None, Path | None]] = []
    for name in camera_names:
        part = rows.at_rows(np.flatnonzero(placed & (camera == name)))
        named = part.at_rows(part.code != BARE)
        order, _ = places_in_order(named, name, None)
        keep = np.concatenate([np.flatnonzero(part.code != BARE)[order], np.flatnonzero(part.code == BARE)])
        parts.append((name, part.at_rows(keep), None))
    return joined_tracks(parts)[0]


def concatenate(parts: Sequence[Tracks2D]) -> Tracks2D:
    """The dots of one camera from several parts, such as one for each file of a cut video.

    Tracks with the same label are one. Parts of one file keep its rows, else rows are counted anew.

    Raises
    ------
    InputError
        There is no part, the parts are of different cameras, or an individual is twice in a frame.
    """
    cameras = {part.camera for part in parts}
    if len(cameras) != 1:
        raise InputError(
            "Only tracks of one camera can be put one after another.",
            expected="parts of one camera",
            found=", ".join(sorted(cameras)) or "no part",
        )
    labels = tuple(sorted({label for part in parts for label in part.labels}, key=natural_order))
    place = {label: i for i, label in enumerate(labels)}
    track = [np.array([*(place[label] for label in p.labels), BARE])[p.track] for p in parts]
    path = parts[0].path if len({part.path for part in parts}) == 1 else None
    frame = np.concatenate([part.frame for part in parts])
    animals = [part.animal for part in parts if part.animal is not None]
    result = Tracks2D(
        camera=parts[0].camera,
        frame=frame,
        track=np.concatenate(track),
        xy=np.concatenate([part.xy for part in parts]),
        labels=labels,
        animal=np.concatenate(animals) if len(animals) == len(parts) else None,
        path=path,
        row=np.arange(len(frame)) if path is None else np.concatenate([part.row for part in parts]),
        left_out=_all_left_out(parts),
    )
    _check_single(result)
    return result


def take_frames(tracks: Tracks2D, start: int | None = None, stop: int | None = None) -> Tracks2D:
    """The dots of the frames from `start` up to, but not including, `stop`; the labels all stay."""

    def inside(frame: np.ndarray) -> np.ndarray:
        low = np.full(len(frame), True) if start is None else frame >= start
        return low if stop is None else low & (frame < stop)

    left = tracks.left_out
    if left is not None:
        left = left[inside(left["frame"].to_numpy())]
    return replace(tracks.at_rows(inside(tracks.frame)), left_out=left)


def shift_frames(tracks: Tracks2D, offset: int) -> Tracks2D:
    """The same dots `offset` frames later."""
    if offset != int(offset):
        raise InputError(
            "Frames are shifted by whole numbers.", key="offset", expected="…, −1, 0, 1, …", found=f"{offset}"
        )
    left = tracks.left_out
    if left is not None:
        left = left.assign(frame=left["frame"] + int(offset))
    return replace(tracks, frame=tracks.frame + int(offset), left_out=left)


def split_tracks(
    tracks: Tracks2D, *, max_distance_px: float | None = None, max_gap: int | None = None
) -> tuple[Tracks2D, np.ndarray]:
    """Sub-tracks: every track cut where it jumps or where it is lost for long.

    The rule is that of :func:`~acino_fte.data_tools.track_gaps.find_pieces`. The first piece keeps the label,
    the others are called ``0~1``, ``0~2``, …. Each camera is cut on its own: pieces of two cameras are not
    the same pieces of time, and must not be joined by their labels. :func:`join_subtracks` undoes it.

    Parameters
    ----------
    tracks : Tracks2D
        Of one camera.
    max_distance_px : float, optional
        px for each frame.
    max_gap : int, optional
        Frames without a dot.

    Returns
    -------
    tuple
        Tracks2D with the dots in their order, and for each of its labels the index of the track it was cut
        from, (S,) int.
    """
    piece = find_pieces(tracks.track, tracks.frame, tracks.xy, max_distance=max_distance_px, max_gap=max_gap)
    track, labels, parent = name_pieces(tracks.track, piece, tracks.labels)
    return replace(tracks, track=track, labels=labels), parent


def join_subtracks(tracks: Tracks2D, parent: np.ndarray, labels: Sequence[str]) -> Tracks2D:
    """Tracks from sub-tracks: what :func:`split_tracks` gave, and the labels before it."""
    lookup = np.append(np.asarray(parent, dtype=np.int64), BARE)
    return replace(tracks, track=lookup[tracks.track], labels=tuple(labels))


def split_scene_tracks(
    tracks: SceneTracks, *, max_distance: float | None = None, max_gap: int | None = None
) -> tuple[SceneTracks, np.ndarray]:
    """3D sub-tracks: :func:`split_tracks` in space, `max_distance` in m for each frame.

    Returns
    -------
    tuple
        SceneTracks whose individuals are the pieces, and the index of the individual that each is of.
    """
    piece = find_pieces(
        tracks.individual, tracks.frame, tracks.position, max_distance=max_distance, max_gap=max_gap
    )
    individual, names, parent = name_pieces(tracks.individual, piece, tracks.individuals)
    return replace(tracks, individual=individual, individuals=names), parent


def interpolate_tracks(tracks: Tracks2D, max_gap: int) -> tuple[Tracks2D, np.ndarray]:
    """Tracks with short gaps filled by straight lines in the image.

    Parameters
    ----------
    tracks : Tracks2D
        Of one camera.
    max_gap : int
        Frames without a dot; longer gaps stay.

    Returns
    -------
    tuple
        Tracks2D, sorted by track, then frame, and which of its dots were filled in, (P',) bool. These have
        the row −1, and the true animal of both neighbours or none. Bare points stay.
    """
    track, frame, xy, source = interpolate_points(tracks.track, tracks.frame, tracks.xy, max_gap)
    filled = source < 0
    animal = tracks.animal
    if animal is not None:
        known = np.flatnonzero(~filled)
        after = np.searchsorted(known, np.arange(len(source)))
        left = animal[source[known[np.maximum(after - filled, 0)]]]
        right = animal[source[known[after]]]
        animal = np.where(left == right, left, CLUTTER)
    row = np.where(filled, -1, np.append(tracks.row, -1)[source])
    return replace(tracks, frame=frame, track=track, xy=xy, animal=animal, row=row), filled


def _whole(column: pd.Series) -> np.ndarray:
    try:
        values = column.to_numpy(dtype=float)
    except (TypeError, ValueError):
        values = np.full(len(column), np.nan)
    if (wrong := ~(values == np.round(values))).any():
        at = int(np.argmax(wrong))
        raise InputError(
            "A frame is no whole number.",
            key=f"row {at}, column frame",
            expected="a whole number",
            found=str(column.iloc[at]),
        )
    return values.astype(np.int64)


def _all_left_out(parts: Sequence[Tracks2D]) -> pd.DataFrame | None:
    tables = [part.left_out for part in parts if part.left_out is not None]
    if not tables:
        return None
    import pandas as pd

    return pd.concat(tables, ignore_index=True)


def _check_single(tracks: Tracks2D) -> None:
    """An individual is in one place at a time."""
    joined = np.flatnonzero(tracks.track != BARE)
    order = joined[np.lexsort((tracks.frame[joined], tracks.track[joined]))]
    again = (np.diff(tracks.track[order]) == 0) & (np.diff(tracks.frame[order]) == 0)
    if again.any():
        at = order[int(np.argmax(again))]
        raise InputError(
            f"Individual '{tracks.labels[tracks.track[at]]}' of camera '{tracks.camera}' is twice in frame "
            f"{tracks.frame[at]}.",
            expected="parts that do not overlap in time",
            found=f"{int(again.sum())} dots too many",
            remedy="shift the frames of a part (shift_frames), or take some (take_frames)",
        )
