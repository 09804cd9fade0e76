"""Tracks and cloud of a scene for other programs: netCDF as ``movement`` keeps poses, PLY for 3D viewers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.colours import colours_of
from acino_fte.data_tools.point_cloud import write_ply

if TYPE_CHECKING:
    from acino_fte.data_tools.point_cloud import PointCloud
    from acino_fte.data_tools.scene_tracks import SceneTracks

MOST_CELLS = 50_000_000
"""A dense table with more cells than this is not made."""
_SMALL = 1_000_000
"""Variables with more values than this are compressed, which takes longer than all else."""
_FULL = ("time", "space", "keypoints", "individuals")


def fits_dense(tracks: SceneTracks) -> bool:
    """Whether tracks, with a cell for each individual and frame, have a reasonable size."""
    return 3 * _n_frames(tracks) * max(len(tracks.individuals), 1) <= MOST_CELLS


def _n_frames(tracks: SceneTracks) -> int:
    return int(tracks.frame.max()) - int(tracks.frame.min()) + 1 if len(tracks) else 0


def write_movement(
    tracks: SceneTracks, path: Path, fps: float | None, metric: bool = True, attributes: Any = ()
) -> None:
    """Write tracks as netCDF, in the layout of the ``movement`` package (neuroinformatics-unit).

    ``position`` (time, space, keypoints, individuals), m; ``position_sd`` like it; ``confidence`` (time,
    keypoints, individuals), NaN, for a triangulated point has none; ``n_views`` and ``source`` like it (−1
    without a point). One keypoint, ``centroid``. Time is in seconds when the frame rate is known (frame /
    fps), else in frames. Written without xarray, whose import takes longer than all of it.

    Parameters
    ----------
    tracks : SceneTracks
        The points.
    path : Path
        The file to write.
    fps : float, optional
        Frames per second.
    metric : bool
        Whether positions are in metres, or in units of a model without scale.
    attributes : mapping, optional
        More attributes of the dataset.
    """
    import h5netcdf
    import h5py

    first, n = int(tracks.frame.min()) if len(tracks) else 0, _n_frames(tracks)
    frames = np.arange(first, first + n)
    names = np.array(tracks.individuals, dtype=object)
    with h5netcdf.File(path, "w") as file:
        file.dimensions = {"time": n, "space": 3, "keypoints": 1, "individuals": len(names)}
        time = frames if fps is None else frames / fps
        file.create_variable("time", ("time",), time.dtype, data=time)
        words = {"space": list("xyz"), "keypoints": ["centroid"], "individuals": names}
        for key, values in words.items():
            file.create_variable(key, (key,), h5py.string_dtype(), data=np.array(values, dtype=object))
        for key, (dims, values) in _variables(tracks, first, n).items():
            packed: dict[str, Any] = {}
            if values.size > _SMALL:
                packed |= {"compression": "gzip", "compression_opts": 1}
            if values.dtype.kind == "f":
                packed["fillvalue"] = np.float32(np.nan)
            file.create_variable(key, dims, values.dtype, data=values, **packed)
        file.variables["source"].attrs["meaning"] = "0: two views or more, 1: one view, 2: interpolated"
        file.attrs.update(
            {
                "time_unit": "frames" if fps is None else "seconds",
                "source_software": "acino_fte",
                "ds_type": "poses",
                "frame_offset": first,
                "space_unit": "m" if metric else "model units",
                **({} if fps is None else {"fps": float(fps)}),
                **dict(attributes),
            }
        )


def _variables(tracks: SceneTracks, first: int, n: int) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Dimensions and values of each variable."""
    n_individuals = len(tracks.individuals)
    place = tracks.frame - first, slice(None), 0, tracks.individual
    flat = tracks.frame - first, 0, tracks.individual
    position, spread = (np.full((n, 3, 1, n_individuals), np.nan, np.float32) for _ in range(2))
    position[place], spread[place] = tracks.position, tracks.standard_deviation
    n_views, source = (np.full((n, 1, n_individuals), -1, np.int16) for _ in range(2))
    n_views[flat], source[flat] = tracks.n_views, tracks.source
    single = ("time", "keypoints", "individuals")
    return {
        "position": (_FULL, position),
        "confidence": (single, np.full((n, 1, n_individuals), np.nan, np.float32)),
        "position_sd": (_FULL, spread),
        "n_views": (single, n_views),
        "source": (single, source),
    }


def write_tracks_ply(tracks: SceneTracks, path: Path) -> None:
    """Write the points of all individuals as binary PLY: a colour for each individual, and its number, the
    frame, the source (an index into :data:`~acino_fte.data_tools.scene_tracks.SOURCES`) and the views.
    """
    colour = np.round(255 * colours_of(len(tracks.individuals))).astype(np.uint8)
    write_ply(
        path,
        tracks.position,
        colour[tracks.individual] if len(tracks) else np.empty((0, 3), np.uint8),
        {
            "individual": tracks.individual,
            "frame": tracks.frame,
            "source": tracks.source,
            "n_views": tracks.n_views,
        },
    )


def write_cloud_ply(cloud: PointCloud, path: Path) -> None:
    """Write the point cloud as binary PLY, with its colours and errors (px) where it has them."""
    write_ply(path, cloud.xyz, cloud.rgb, None if cloud.error is None else {"error": cloud.error})
