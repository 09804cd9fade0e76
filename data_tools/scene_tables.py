"""The tables of a triangulated scene as CSV: tracks in space, dots of every camera, paths of the cameras.

==================  ========================================================================================
tracks_3d           a row for each individual and frame: the answer
points_3d           the same, triangulated frame by frame, before smoothing
observations        a row for each dot of the 2D tracks, camera after camera, in the order of the files
camera_paths        a row for each camera and frame of its path
==================  ========================================================================================

A recording of a few minutes has half a million numbers. They are formatted a column at a time, which takes a
third of the time of pandas and does without its import.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.scene_tracks import SOURCES

if TYPE_CHECKING:
    from acino_fte.data_tools.scene import SceneResult
    from acino_fte.data_tools.scene_tracks import SceneTracks

Cells = Sequence[str]
_PIXEL, _TURN, _QUATERNION = 4, 6, 9  # decimals of pixels, of degrees, of quaternions
_FEWEST, _DIGITS = 6, 7  # decimals of lengths: micrometres, or these digits of the scene's extent


def tracks_text(tracks: SceneTracks, decimals: int = _FEWEST) -> str:
    """Points of all individuals.

    Returns
    -------
    str
        CSV: individual, frame, x, y, z, sd_x, sd_y, sd_z (m), source (one of
        :data:`~acino_fte.data_tools.scene_tracks.SOURCES`), n_views, reprojection_px (median of the used
        views), reprojection_max_px. What is not known is empty.
    """
    sd = tracks.standard_deviation
    return csv_text(
        {
            "individual": _labels(tracks.individuals, tracks.individual),
            "frame": _whole(tracks.frame),
            **{axis: _decimal(tracks.position[:, i], decimals) for i, axis in enumerate("xyz")},
            **{f"sd_{axis}": _decimal(sd[:, i], decimals) for i, axis in enumerate("xyz")},
            "source": _labels(SOURCES, tracks.source),
            "n_views": _whole(tracks.n_views),
            "reprojection_px": _decimal(tracks.reprojection_median, _PIXEL),
            "reprojection_max_px": _decimal(tracks.reprojection_max, _PIXEL),
        }
    )


def observations_text(result: SceneResult) -> str:
    """Every dot of every camera, used or not.

    Returns
    -------
    str
        CSV: camera, frame (on the camera's own clock), individual, x, y (px, pixel centres at integers),
        reprojection_px (distance from the projected track; empty where there is none), used (1 or 0).
    """
    tables = []
    for view, distance, used in zip(
        result.scene.tracks, result.tracks.distance, result.tracks.used, strict=True
    ):
        tables.append(
            {
                "camera": [_quoted(view.camera)] * len(view),
                "frame": _whole(view.frame),
                "individual": _labels((*view.labels, ""), view.track),  # the last is that of bare points, −1
                "x": _decimal(view.xy[:, 0], _PIXEL),
                "y": _decimal(view.xy[:, 1], _PIXEL),
                "reprojection_px": _decimal(distance, _PIXEL),
                "used": _whole(used),
            }
        )
    return csv_text(*tables)


def paths_text(result: SceneResult, decimals: int = _FEWEST) -> str:
    """Every camera in every frame of its path.

    Returns
    -------
    str
        CSV: camera, frame, x, y, z (centre, m), qw, qx, qy, qz (world to camera, qw ≥ 0), sd_centre_m (root
        mean square of the three axes), sd_rotation_deg (likewise), known (0: too far from a key frame, no
        pose), key (1: from an image of the model).
    """
    from scipy.spatial.transform import Rotation

    tables = []
    for path in result.paths:
        known = np.asarray(path.known, dtype=bool)
        centre = np.where(known[:, None], path.centre, np.nan)
        turn = np.full((len(known), 4), np.nan)
        if known.any():
            turn[known] = Rotation.from_matrix(path.rotation[known]).as_quat()[:, [3, 0, 1, 2]]
        turn *= np.where(turn[:, :1] < 0, -1.0, 1.0)
        variance = np.where(known[:, None], np.diagonal(path.covariance, axis1=1, axis2=2), np.nan)
        spread = np.sqrt(np.maximum(variance.reshape(-1, 2, 3).mean(2), 0.0))
        tables.append(
            {
                "camera": [_quoted(path.name)] * len(known),
                "frame": _whole(path.frame),
                **{axis: _decimal(centre[:, i], decimals) for i, axis in enumerate("xyz")},
                **{f"q{axis}": _decimal(turn[:, i], _QUATERNION) for i, axis in enumerate("wxyz")},
                "sd_centre_m": _decimal(spread[:, 1], decimals),
                "sd_rotation_deg": _decimal(np.degrees(spread[:, 0]), _TURN),
                "known": _whole(known),
                "key": _whole(path.key),
            }
        )
    return csv_text(*tables)


def length_decimals(position: np.ndarray) -> int:
    """Decimals of lengths that keep a micrometre, and seven digits of a scene without scale that is small."""
    finite = position[np.isfinite(position).all(-1)]
    extent = float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0
    if not extent > 0:
        return _FEWEST
    return int(np.clip(_DIGITS - math.ceil(math.log10(extent)), _FEWEST, 15))


def csv_text(*tables: dict[str, Cells]) -> str:
    """Tables with the same columns, one below the other, under one row of names."""
    lines = [",".join(tables[0])]
    for table in tables:
        lines += map(",".join, zip(*table.values(), strict=True))
    return "\n".join(lines) + "\n"


def _decimal(values: np.ndarray, decimals: int) -> Cells:
    """Numbers with so many decimals; empty where they are missing."""
    shown = (f"%.{decimals}f\n" * len(values)) % tuple(np.asarray(values, dtype=float).tolist())
    return shown.replace("nan", "").replace("-inf", "").replace("inf", "").split("\n")[:-1]


def _whole(values: np.ndarray) -> Cells:
    return list(map(str, np.asarray(values).astype(np.int64).tolist()))


def _labels(names: Sequence[str], index: np.ndarray) -> Cells:
    """The name that each index picks, as CSV has it."""
    return np.array([_quoted(name) for name in names] or [""], dtype=object)[np.asarray(index)].tolist()


def _quoted(name: str) -> str:
    """A name as a cell: in quotation marks where it needs them."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\r\n").writerow([name])  # which is what makes it quote both
    return "" if name == "" else text.getvalue()[:-2]
