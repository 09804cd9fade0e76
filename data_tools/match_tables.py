"""A matching as tables: rows, pieces of track, points in space, and the layouts of other programs.

==================  ========================================================================================
observations        a row for each row of the input, camera after camera, in the order of the files
tracks_3d           a row for each animal and frame
matches             a row for each piece of track that was given to an animal
movement            the dataset of the ``movement`` package (neuroinformatics-unit): position (time, space,
                    keypoints, individuals) and confidence (time, keypoints, individuals)
xypts, xyzpts       DLTdv's tables of digitised points (Hedrick 2008), see :mod:`dltdv_files`
==================  ========================================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from acino_fte.data_tools.match_points import SOURCE_NAMES, SpacePoints

if TYPE_CHECKING:
    import xarray as xr

    from acino_fte.data_tools.track_matching import TrackMatches
    from acino_fte.data_tools.tracks2d import Tracks2D

MOST_CELLS = 50_000_000
"""Dense tables of other programs with more cells than this are not made."""


def observations_table(matches: TrackMatches) -> pd.DataFrame:
    """One row for each row of the input, in its order, camera after camera.

    Returns
    -------
    pandas.DataFrame
        group (empty when unmatched), confidence, camera, frame, track (empty for a bare point), x, y (px, y
        from the top; empty for a row without a dot).
    """
    parts = []
    for view, group, sure in zip(matches.recording.views, matches.groups, matches.confidence, strict=True):
        part = pd.DataFrame(
            {
                "row": view.row,
                "group": _or_empty(group),
                "confidence": np.where(group >= 0, sure, np.nan),
                "camera": view.camera,
                "frame": view.frame,
                "track": _labels(view),
                "x": view.xy[:, 0],
                "y": view.xy[:, 1],
            }
        )
        if view.left_out is not None and len(view.left_out):
            empty = view.left_out.assign(camera=view.camera)[["row", "camera", "frame", "track"]]
            part = pd.concat([part, empty.reindex(columns=part.columns).astype({"group": "Int64"})])
        parts.append(part.sort_values("row", kind="stable"))
    return pd.concat(parts, ignore_index=True).drop(columns="row")


def _labels(view: Tracks2D) -> np.ndarray:
    """The label of every row as the file has it; empty for a bare point."""
    names = np.array([*view.labels, ""], dtype=object)  # the last for bare points, track −1
    return names[view.track]


def tracks_table(points: SpacePoints) -> pd.DataFrame:
    """group, frame, x, y, z, sd_x, sd_y, sd_z (m, world), source, n_views, reprojection_px of every point."""
    sd = points.standard_deviation
    return pd.DataFrame(
        {
            "group": points.group,
            "frame": points.frame,
            **{axis: points.position[:, i] for i, axis in enumerate("xyz")},
            **{f"sd_{axis}": sd[:, i] for i, axis in enumerate("xyz")},
            "source": pd.Categorical.from_codes(points.source, categories=list(SOURCE_NAMES)),
            "n_views": points.n_views,
            "reprojection_px": points.reprojection,
        }
    )


def matches_table(matches: TrackMatches) -> pd.DataFrame:
    """One row for each piece of track and the animal that it was given to.

    A piece is what was matched as one; a track that changes hands has several. Dots that an animal claimed
    one by one, or that were left in another piece, have rows of their own.

    Returns
    -------
    pandas.DataFrame
        group, camera, track, piece, first, last (frames, both included), n_dots, confidence (mean of the
        dots), rival_group (the most likely other one; empty for none), rival_probability; sorted by group,
        camera and first frame.
    """
    parts = []
    for k, view in enumerate(matches.recording.views):
        group, piece = matches.groups[k], matches.pieces[k]
        part = pd.DataFrame(
            {
                "group": group,
                "piece": piece,
                "track": view.track,
                "frame": view.frame,
                "sure": matches.confidence[k],
            }
        )[group >= 0]
        grouped = part.groupby(["group", "piece", "track"], sort=False)
        table = grouped.agg(
            first=("frame", "min"),
            last=("frame", "max"),
            n_dots=("frame", "size"),
            confidence=("sure", "mean"),
        ).reset_index()
        table.insert(1, "camera", view.camera)
        table["view"] = k
        names = np.array([*view.labels, ""], dtype=object)
        table["track"] = names[table["track"].to_numpy(int)] if len(table) else table["track"].astype(object)
        parts.append(table)
    table = pd.concat(parts, ignore_index=True).sort_values(["group", "view", "first"], kind="stable")
    rival, probability = _rivals(matches, table["piece"].to_numpy(int))
    table["rival_group"], table["rival_probability"] = rival, probability
    columns = ["group", "camera", "track", "piece", "first", "last", "n_dots", "confidence"]
    return table[[*columns, "rival_group", "rival_probability"]].reset_index(drop=True)


def _rivals(matches: TrackMatches, piece: np.ndarray) -> tuple[Any, np.ndarray]:
    rival, probability = np.full(len(piece), -1), np.full(len(piece), np.nan)
    known = (piece >= 0) & (piece < len(matches.rival))
    rival[known] = matches.rival[piece[known]]
    probability[known] = matches.rival_probability[piece[known]]
    return _or_empty(rival), np.where(rival >= 0, probability, np.nan)


def _or_empty(numbers: np.ndarray) -> Any:
    """Integers that are empty where they are negative."""
    return pd.arrays.IntegerArray(numbers.astype(np.int64), numbers < 0)


def movement_dataset(matches: TrackMatches, points: SpacePoints) -> xr.Dataset:
    """The animals in space as the ``movement`` package keeps poses.

    Returns
    -------
    xarray.Dataset
        ``position`` (time, space, keypoints, individuals), m; ``confidence`` (time, keypoints, individuals),
        the mean of the animal's matched dots in the frame; ``position_sd`` like position. One keypoint,
        ``centroid``. Time is in seconds when the frame rate is known (frame / fps), else in frames.
    """
    import xarray as xr

    recording = matches.recording
    names, index = np.unique(points.group, return_inverse=True)
    first = int(points.frame.min()) if len(points) else 0
    n_frames = int(points.frame.max()) - first + 1 if len(points) else 0
    shape = n_frames, 3, 1, len(names)
    position, spread = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    position[points.frame - first, :, 0, index] = points.position
    spread[points.frame - first, :, 0, index] = points.standard_deviation
    confidence = np.full((n_frames, 1, len(names)), np.nan, np.float32)
    confidence[points.frame - first, 0, index] = _confidence(matches, points)
    frames = np.arange(first, first + n_frames)
    attributes: dict[str, Any] = {
        "time_unit": "frames" if recording.fps is None else "seconds",
        "source_software": "acino_fte",
        "ds_type": "poses",
        "frame_offset": first,
        "space_unit": "m",
    }
    if recording.fps is not None:
        attributes["fps"] = float(recording.fps)
    full = ("time", "space", "keypoints", "individuals")
    return xr.Dataset(
        {
            "position": (full, position),
            "confidence": (("time", "keypoints", "individuals"), confidence),
            "position_sd": (full, spread),
        },
        coords={
            "time": frames if recording.fps is None else frames / recording.fps,
            "space": ["x", "y", "z"],
            "keypoints": ["centroid"],
            "individuals": [f"animal_{name}" for name in names],
        },
        attrs=attributes,
    )


def _confidence(matches: TrackMatches, points: SpacePoints) -> np.ndarray:
    """Mean confidence of the dots of every point, (T,); NaN for none."""
    total, count = np.zeros(len(points)), np.zeros(len(points))
    for view, group, sure in zip(matches.recording.views, matches.groups, matches.confidence, strict=True):
        place = points.find(group, view.frame)
        use = (place >= 0) & np.isfinite(sure)
        total += np.bincount(place[use], weights=sure[use], minlength=len(points))
        count += np.bincount(place[use], minlength=len(points))
    return total / np.where(count > 0, count, np.nan)


def dltdv_xypts(matches: TrackMatches) -> pd.DataFrame:
    """Matched dots as DLTdv's ``xypts``: a row a frame from 0, point n is group n − 1, y from the bottom."""
    recording = matches.recording
    start, n_frames = dltdv_frames(matches)
    views = recording.views
    dense = np.full((n_frames, matches.n_groups, len(views), 2), np.nan)
    for k, (view, group) in enumerate(zip(views, matches.groups, strict=True)):
        use = group >= 0
        height = recording.cameras[k].resolution[1]
        pixels = np.stack([view.xy[use, 0], height - view.xy[use, 1]], axis=1)
        dense[view.frame[use] - start, group[use], k] = pixels
    names = [
        f"pt{n + 1}_cam{k + 1}_{axis}"
        for n in range(matches.n_groups)
        for k in range(len(views))
        for axis in "XY"
    ]
    return pd.DataFrame(dense.reshape(n_frames, len(names)), columns=names)


def dltdv_xyzpts(matches: TrackMatches, points: SpacePoints) -> pd.DataFrame:
    """Points in space as DLTdv's ``xyzpts``, m; rows and numbers as in :func:`dltdv_xypts`."""
    start, n_frames = dltdv_frames(matches)
    dense = np.full((n_frames, matches.n_groups, 3), np.nan)
    inside = (points.frame >= start) & (points.frame < start + n_frames)
    dense[points.frame[inside] - start, points.group[inside]] = points.position[inside]
    names = [f"pt{n + 1}_{axis}" for n in range(matches.n_groups) for axis in "XYZ"]
    return pd.DataFrame(dense.reshape(n_frames, len(names)), columns=names)


def dltdv_frames(matches: TrackMatches) -> tuple[int, int]:
    """The frame of the first row of DLTdv's tables (0, unless frames are negative), and their rows."""
    recording = matches.recording
    start = min(0, recording.first_frame)
    return start, recording.first_frame + recording.n_frames - start


def fits_dense(matches: TrackMatches) -> bool:
    """Whether the dense tables of other programs have a reasonable size."""
    return dltdv_frames(matches)[1] * max(matches.n_groups, 1) * 2 * len(matches.groups) <= MOST_CELLS
