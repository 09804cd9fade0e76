"""Cameras for the matching of 2D tracks, from any of the files that people have.

========================  ====================================================================================
``.json``                 a scene: a list of {id, K, R, t, dist_opencv, image_size}, or {"cameras": that
                          list}; else whatever :func:`~acino_fte.data_tools.calibration.read_cameras` reads
``.toml``                 Anipose's
``.xcp``                  Vicon's, see :mod:`vicon`
``.csv``, ``.txt``        DLT coefficients of DLTdv, easyWand and Argus, see :mod:`dlt`
========================  ====================================================================================

All come out alike: OpenCV's camera frame, world to camera, m, pixel centres at integers, y down from the top.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.calibration import _camera, _validated, _with_file, read_cameras
from acino_fte.data_tools.dlt import Resolution, read_dlt
from acino_fte.data_tools.projective_camera import ProjectiveCamera, ViconRadial
from acino_fte.data_tools.vicon import read_xcp
from acino_fte.errors import InputError, did_you_mean

ENDINGS = (".json", ".toml", ".xcp", ".csv", ".txt")
_KEYS = {
    "matrix": "K",
    "camera matrix": "K",
    "rotation": "R",
    "translation": "t",
    "pose": "R",
    "distortion": "dist_opencv",
    "resolution": "image_size",
}


class _Radial(BaseModel):
    center: Any
    k: Any


class _Entry(BaseModel):
    """One camera of a scene. ``vicon_radial2`` alone says what was not applied to the points."""

    id: str | int
    K: Any
    R: Any
    t: Any
    dist_opencv: Any = ()
    image_size: tuple[int, int]
    vicon_radial2: _Radial | None = None
    apply_vicon_radial2: bool = False


def read_track_cameras(
    path: Path | str,
    *,
    only: Sequence[str | int] | None = None,
    resolution: Resolution | Sequence[Resolution] | None = None,
    image_height: int | None = None,
    profile: Path | str | None = None,
    unit: str = "m",
) -> CameraArray:
    """Read the cameras of a recording of 2D tracks; the ending of the file says of which kind it is.

    Parameters
    ----------
    path : Path
        See the table at the head of this module.
    only : sequence of str or int, optional
        Names of the cameras that are wanted, in the wanted order; of a Vicon file DEVICEID or USERID.
    resolution, image_height, profile
        For DLT coefficients only, see :func:`~acino_fte.data_tools.dlt.read_dlt`.
    unit : {"m", "cm", "mm"}
        Unit of the positions in the file. Vicon's are mm whatever this says.

    Returns
    -------
    CameraArray
        Names: the ids of a scene, with ``cam`` in front of a bare number; DEVICEID for Vicon; ``cam1``,
        ``cam2``, … for DLT columns.

    Raises
    ------
    InputError
        The file is missing, of no known kind, or holds what cannot be a camera's.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError(
            "The camera file does not exist.",
            file=path,
            expected="a file",
            found=found,
            remedy="check the path",
        )
    if ending == ".xcp":
        return read_xcp(path, only)
    if ending in (".csv", ".txt"):
        cameras = read_dlt(path, resolution=resolution, image_height=image_height, profile=profile, unit=unit)
    elif ending == ".json" and (entries := _scene_entries(path)) is not None:
        cameras = _read_scene(path, *entries, unit)
    elif ending in (".json", ".toml"):
        cameras = read_cameras(path, unit=unit)
    else:
        raise InputError(
            "This is no camera file of a known kind.",
            file=path,
            key="ending",
            expected=", ".join(ENDINGS),
            found=ending or "no ending",
            remedy="rename the file if it is one of these; a DLT table is .csv, a scene .json",
        )
    return cameras if only is None else _selected(cameras, only, path)


def _selected(cameras: CameraArray, only: Sequence[str | int], path: Path) -> CameraArray:
    names = [str(name) for name in only]
    for name in names:
        if name not in cameras.names:
            raise InputError(
                f"The file has no camera '{name}'{did_you_mean(name, cameras.names) or '.'}",
                file=path,
                key="only",
                expected=", ".join(cameras.names),
                found=name,
                remedy="choose cameras of the file",
            )
    try:
        return CameraArray(tuple(cameras[name] for name in names))
    except InputError as error:
        raise _with_file(error, path, "only") from None


def _scene_entries(path: Path) -> tuple[list[Any], str] | None:
    """The list of a scene and its place in the file; None when this is another file, or cannot be read."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError, OSError, RecursionError):
        return None
    if isinstance(data, list):
        return data, ""
    entries = data.get("cameras") if isinstance(data, dict) and "format" not in data else None
    if not isinstance(entries, list):
        return None
    ours = any(isinstance(e, dict) and {"K", "R", "t"} & set(e) for e in entries)
    return (entries, "cameras.") if ours else None


def _read_scene(path: Path, entries: list, prefix: str, unit: str) -> CameraArray:
    if not entries:
        raise InputError(
            "The scene has no camera.",
            file=path,
            expected="a list of {id, K, R, t, dist_opencv, image_size}",
            found="an empty list",
            remedy="check the path",
        )
    cameras = [_scene_camera(entry, f"{prefix}{i}", unit, path) for i, entry in enumerate(entries)]
    try:
        return CameraArray(tuple(cameras))
    except InputError as error:
        raise _with_file(error, path, f"{prefix}id") from None


def _scene_camera(data: Any, place: str, unit: str, path: Path) -> Camera:
    entry = _validated(_Entry, data, path, place)
    name = str(entry.id)
    values = {
        "name": f"cam{name}" if name.isdigit() else name,
        "model": "pinhole",
        "matrix": entry.K,
        "distortion": entry.dist_opencv,
        "rotation": entry.R,
        "translation": entry.t,
        "resolution": entry.image_size,
    }
    skew = _skew(entry.K)
    if skew:
        values["matrix"] = [[*entry.K[0][:1], 0.0, *entry.K[0][2:]], *entry.K[1:]]
    try:
        camera = _camera(place, values, unit, path)
        radial = None
        if entry.apply_vicon_radial2:
            radial = _scene_radial(entry, place)
        if skew or radial is not None:
            return _projective(camera, skew, radial, place)
    except InputError as error:
        key = (error.key or "").rpartition(".")[2]
        raise _with_file(error, path, f"{place}.{_KEYS.get(key, key)}") from None
    return camera


def _skew(matrix: Any) -> float:
    """Skew of a camera matrix in a file; 0 for what is none, which the checks of the camera then refuse."""
    try:
        value = np.asarray(matrix, dtype=float)
    except (TypeError, ValueError):
        return 0.0
    return float(value[0, 1]) if value.shape == (3, 3) and np.isfinite(value).all() else 0.0


def _scene_radial(entry: _Entry, place: str) -> ViconRadial:
    if entry.vicon_radial2 is None:
        raise InputError(
            "The radial correction is to be applied, and there is none.",
            key=f"{place}.vicon_radial2",
            expected="{center: [cx, cy], k: [k1, k2, k3]} beside apply_vicon_radial2: true",
            found="nothing",
            remedy="add it, or remove apply_vicon_radial2",
        )
    try:
        return ViconRadial(entry.vicon_radial2.center, entry.vicon_radial2.k)
    except (TypeError, ValueError):
        raise InputError(
            "The radial correction is no array of numbers.",
            key=f"{place}.vicon_radial2",
            expected="{center: [cx, cy], k: [k1, k2, k3]}",
            found=repr(entry.vicon_radial2)[:80],
            remedy="write the calibration again",
        ) from None


def _projective(camera: Camera, skew: float, radial: ViconRadial | None, place: str) -> ProjectiveCamera:
    """The camera with skew, with Vicon's lens; neither goes with OpenCV's distortion."""
    if camera.distortion.any():
        raise InputError(
            "OpenCV's distortion does not go with skew or with Vicon's radial correction.",
            key=f"{place}.dist_opencv",
            expected="zeros beside a skew at K[0][1] or apply_vicon_radial2: true",
            found=str(camera.distortion.tolist()),
            remedy="set one of them to zero",
        )
    matrix = camera.matrix.copy()
    matrix[0, 1] = skew
    return ProjectiveCamera(
        camera.name, matrix, camera.rotation, camera.translation, camera.resolution, radial
    )
