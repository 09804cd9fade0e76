"""The tables of a triangulated scene as CSV: tracks in space, dots of every camera, paths of the cameras.

==================  ========================================================================================
tracks_3d           a row for each individual and frame: the answer
points_3d           the same, triangulated frame by frame, before smoothing
observations        a row for each dot of the 2D tracks, camera after camera, in the order of the files
camera_paths        a row for each camera and frame of its path
==================  ========================================================================================

A recording of a few minutes has half a million numbers; :mod:`csv_columns` writes them without pandas.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.csv_columns import csv_bytes, decimals, labels
from acino_fte.data_tools.rotations import rotation_quaternion
from acino_fte.data_tools.scene_tracks import SOURCES

if TYPE_CHECKING:
    from acino_fte.data_tools.scene import SceneResult
    from acino_fte.data_tools.scene_tracks import SceneTracks

_PIXEL, _TURN, _QUATERNION = 4, 6, 9  # decimals of pixels, of degrees, of quaternions
_FEWEST, _DIGITS = 6, 7  # decimals of lengths: micrometres, or these digits of the scene's extent


def tracks_text(tracks: SceneTracks, places: int = _FEWEST) -> bytes:
    """Points of all individuals.

    Returns
    -------
    bytes
        CSV: individual, frame, x, y, z, sd_x, sd_y, sd_z (m), source (one of
        :data:`~acino_fte.data_tools.scene_tracks.SOURCES`), n_views, reprojection_px (median of the used
        views), reprojection_max_px. What is not known is empty.
    """
    sd = tracks.standard_deviation
    return csv_bytes(
        {
            "individual": labels(tracks.individuals, tracks.individual),
            "frame": decimals(tracks.frame, 0),
            **{axis: decimals(tracks.position[:, i], places) for i, axis in enumerate("xyz")},
            **{f"sd_{axis}": decimals(sd[:, i], places) for i, axis in enumerate("xyz")},
            "source": labels(SOURCES, tracks.source),
            "n_views": decimals(tracks.n_views, 0),
            "reprojection_px": decimals(tracks.reprojection_median, _PIXEL),
            "reprojection_max_px": decimals(tracks.reprojection_max, _PIXEL),
        }
    )


def observations_text(result: SceneResult) -> bytes:
    """Every dot of every camera, used or not.

    Returns
    -------
    bytes
        CSV: camera, frame, individual, x, y (px, pixel centres at integers), reprojection_px (distance from
        the projected track; empty where there is none), used (1 or 0). On a common clock these are the dots
        in whole frames of the reference camera.
    """
    tables = []
    for view, distance, used in zip(
        result.scene.tracks, result.tracks.distance, result.tracks.used, strict=True
    ):
        tables.append(
            {
                "camera": labels([view.camera], np.zeros(len(view), dtype=int)),
                "frame": decimals(view.frame, 0),
                "individual": labels((*view.labels, ""), view.track),  # the last is that of bare points, −1
                "x": decimals(view.xy[:, 0], _PIXEL),
                "y": decimals(view.xy[:, 1], _PIXEL),
                "reprojection_px": decimals(distance, _PIXEL),
                "used": decimals(used, 0),
            }
        )
    return csv_bytes(*tables)


def paths_text(result: SceneResult, places: int = _FEWEST) -> bytes:
    """Every camera in every frame of its path.

    Returns
    -------
    bytes
        CSV: camera, frame, x, y, z (centre, m), qw, qx, qy, qz (world to camera, qw ≥ 0), sd_centre_m (root
        mean square of the three axes), sd_rotation_deg (likewise), known (0: too far from a key frame, no
        pose), key (1: from an image of the model).
    """
    tables = []
    for path in result.paths:
        known = np.asarray(path.known, dtype=bool)
        centre = np.where(known[:, None], path.centre, np.nan)
        turn = np.full((len(known), 4), np.nan)
        if known.any():
            turn[known] = rotation_quaternion(path.rotation[known])[:, [3, 0, 1, 2]]
        turn *= np.where(turn[:, :1] < 0, -1.0, 1.0)
        variance = np.where(known[:, None], np.diagonal(path.covariance, axis1=1, axis2=2), np.nan)
        spread = np.sqrt(np.maximum(variance.reshape(-1, 2, 3).mean(2), 0.0))
        tables.append(
            {
                "camera": labels([path.name], np.zeros(len(known), dtype=int)),
                "frame": decimals(path.frame, 0),
                **{axis: decimals(centre[:, i], places) for i, axis in enumerate("xyz")},
                **{f"q{axis}": decimals(turn[:, i], _QUATERNION) for i, axis in enumerate("wxyz")},
                "sd_centre_m": decimals(spread[:, 1], places),
                "sd_rotation_deg": decimals(np.degrees(spread[:, 0]), _TURN),
                "known": decimals(known, 0),
                "key": decimals(path.key, 0),
            }
        )
    return csv_bytes(*tables)


def length_decimals(position: np.ndarray) -> int:
    """Decimals of lengths that keep a micrometre, and seven digits of a scene without scale that is small."""
    finite = position[np.isfinite(position).all(-1)]
    extent = float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0
    if not extent > 0:
        return _FEWEST
    return int(np.clip(_DIGITS - math.ceil(math.log10(extent)), _FEWEST, 15))
