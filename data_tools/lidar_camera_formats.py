"""Calibrations of a camera to a lidar as other programs write them.

A transform goes one of two ways, and matrices do not tell which. Where the format or the name of a key says
it, it is taken from there; elsewhere it must be said, and the error tells what either way would mean.
"""

from __future__ import annotations

import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.lidar_camera import FORMAT, LidarCamera, own_lidar_camera
from acino_fte.data_tools.lidar_intrinsics import parsed, read_intrinsics
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.lidar_camera import Direction

_LIDAR, _CAMERA = r"(?:lidar|livox|velodyne|velo|lid|pcl|pointcloud|os|laser)", r"(?:camera|cam|rgb|image)"
_FORWARD = re.compile(
    rf"{_LIDAR}\d*_?(?:to|2)_?{_CAMERA}|(?:^|_)t_{_CAMERA}\d*_{_LIDAR}|{_CAMERA}_from_{_LIDAR}"
)
_BACKWARD = re.compile(
    rf"{_CAMERA}\d*_?(?:to|2)_?{_LIDAR}|(?:^|_)t_{_LIDAR}\d*_{_CAMERA}|{_LIDAR}_from_{_CAMERA}"
)
_KINDS = (
    f"'format: {FORMAT}', KITTI's calib.txt, .npz with R and T, or a 4×4 matrix in JSON, YAML, text or .npy"
)
_TOLERANCE = 1e-3


def read_any(
    path: Path,
    direction: Direction | None,
    camera: Camera | Path | str | None,
    points: np.ndarray | None,
    resolution: tuple[int, int] | None = None,
    view: str = "P2",
) -> LidarCamera:
    """The calibration in a file; see :func:`acino_fte.data_tools.lidar_camera.read_lidar_camera`."""
    if direction not in (None, "lidar_to_camera", "camera_to_lidar"):
        raise InputError(
            "This is no direction.", key="direction", expected="lidar_to_camera or camera_to_lidar",
            found=repr(direction),
        )  # fmt: skip
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError("There is no such calibration.", file=path, found=found, remedy="check the path")
    suffix = path.suffix.lower()
    if suffix in (".npz", ".npy"):
        named, matrix = _from_numpy(path)
    else:
        data = parsed(path) if suffix in (".json", ".yaml", ".yml") else _text(path)
        if isinstance(data, dict) and str(data.get("format", "")).startswith("acino-fte/lidar-camera"):
            return _own(data, path, direction)
        if isinstance(data, dict) and view in data and any(key.startswith("Tr") for key in data):
            return _kitti(data, path, direction, resolution, view)
        named, matrix = _from_data(data, path)
    lens = read_intrinsics(camera) if isinstance(camera, Path | str) else camera
    way = _way(path, named, direction, matrix, lens, points)
    if lens is None:
        raise InputError(
            "The file has a transform, but no intrinsics.",
            file=path,
            key="camera",
            expected="the camera's intrinsics beside it",
            remedy="give them, as ROS' ost.yaml or the project's cameras.json",
        )
    if way == "camera_to_lidar":
        matrix = _inverted(matrix)
    return LidarCamera(
        replace(lens, rotation=matrix[:3, :3], translation=matrix[:3, 3]), note=f"from {path.name}"
    )


def _own(data: dict[str, Any], path: Path, direction: Direction | None) -> LidarCamera:
    found = own_lidar_camera(data, path)
    _agree(path, "lidar_to_camera", direction)
    return found


def _agree(path: Path, named: str | None, direction: str | None) -> None:
    if named and direction and named != direction:
        raise InputError(
            "The file says that its transform goes the other way.",
            file=path,
            key="direction",
            expected=f"{named}, as the file says, or nothing",
            found=direction,
            remedy="leave the direction out; if the file names its transform wrongly, rename the key in it",
        )


def _way(
    path: Path,
    named: Direction | None,
    direction: Direction | None,
    matrix: np.ndarray,
    lens: Camera | None,
    points: np.ndarray | None,
) -> Direction:
    """Which way the transform goes; never guessed."""
    _agree(path, named, direction)
    way = named or direction
    if way is None:
        raise InputError(
            "The file does not say which way its transform goes.",
            file=path,
            key="direction",
            expected="lidar_to_camera (x_camera = R x_lidar + t), or camera_to_lidar",
            found=_evidence(matrix, lens, points),
            remedy="say the direction; who made the file knows it",
        )
    return way


def _evidence(matrix: np.ndarray, lens: Camera | None, points: np.ndarray | None) -> str:
    """What either way would do to the points of the cloud."""
    if points is None or not len(points):
        return "a rotation and a translation; with points of the cloud, this message would compare both ways"
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
    parts = []
    for way, each in (("lidar_to_camera", matrix), ("camera_to_lidar", _inverted(matrix))):
        local = points @ each[:3, :3].T + each[:3, 3]
        front = int((local[:, 2] > 0).sum())
        text = f"as {way}, {front} of {len(points)} points lie in front of the camera"
        if lens is not None:
            posed = replace(lens, rotation=each[:3, :3], translation=each[:3, 3])
            text += f" and {int(posed.inside(posed.project(points)).sum())} in the image"
        parts.append(text)
    return "; ".join(parts)


def _inverted(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a rigid transform (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = matrix[:3, :3].T
    out[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return out


def _from_numpy(path: Path) -> tuple[Direction | None, np.ndarray]:
    """The transform in a .npz or .npy, without pickles."""
    try:
        loaded = np.load(path, allow_pickle=False)
        data = {"": loaded} if isinstance(loaded, np.ndarray) else {key: loaded[key] for key in loaded.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise InputError(
            "The file cannot be read as NumPy's.",
            file=path,
            expected="arrays of numbers",
            found=str(error)[:200],
            remedy="save the arrays themselves; objects (pickles) are not read, they could run code",
        ) from None
    return _from_data(data.get("", data) if "" in data else data, path)


def _from_data(data: Any, path: Path) -> tuple[Direction | None, np.ndarray]:
    """The transform in parsed content, and the direction that its names tell."""
    if not isinstance(data, dict):
        return None, _matrix(data, path, "")
    if "camera_matrix" in data and "image_width" in data:
        raise InputError(
            "The file has a camera's intrinsics, but not where the lidar is.",
            file=path,
            expected=_KINDS,
            remedy="give it as the camera of a transform, or calibrate from pairs with it",
        )
    ways: dict[str, Direction] = {}
    for key in data:
        name = str(key).lower().replace("-", "_")
        if _FORWARD.search(name):
            ways[str(key)] = "lidar_to_camera"
        elif _BACKWARD.search(name):
            ways[str(key)] = "camera_to_lidar"
    named = set(ways.values())
    if len(named) > 1:
        raise InputError(
            "The file has transforms in both directions.", file=path, found=", ".join(ways),
            remedy="keep one of them in a file of its own",
        )  # fmt: skip
    way = named.pop() if named else None
    chosen = {key: data[key] for key in ways} or data
    if len(chosen) == 1:
        return way, _matrix(next(iter(chosen.values())), path, str(next(iter(chosen))))
    return way, _from_parts(chosen, path)


def _from_parts(data: dict, path: Path) -> np.ndarray:
    """A transform from its rotation and translation, or from a matrix by a usual name."""
    by_name = {str(key).lower().replace("-", "_"): value for key, value in data.items()}
    for name in ("matrix", "transform", "extrinsic", "extrinsics", "transformation_matrix", "t"):
        if name in by_name and np.size(by_name[name]) in (12, 16):
            return _matrix(by_name[name], path, name)
    turns = [
        name for name in by_name if name in ("r", "rot", "rotation") or name.startswith(("r_", "rotation"))
    ]
    shifts = [
        name for name in by_name if name in ("t", "trans", "translation") or name.startswith(("t_", "trans"))
    ]
    if len(turns) == 1 and len(shifts) == 1:
        return _matrix({"rotation": by_name[turns[0]], "translation": by_name[shifts[0]]}, path, "")
    raise InputError(
        "This is no calibration of a camera to a lidar of a known kind.",
        file=path,
        expected=_KINDS,
        found=", ".join(map(str, data))[:200],
        remedy="check the path",
    )


def _matrix(value: Any, path: Path, key: str) -> np.ndarray:
    """A rigid transform (4, 4) from a 4×4, a 3×4, or rotation and translation."""
    if isinstance(value, dict):
        lower = {str(k).lower(): v for k, v in value.items()}
        turn, shift = lower.get("rotation", lower.get("r")), lower.get("translation", lower.get("t"))
        turn, shift = _array(turn, path, f"{key}.rotation"), _array(shift, path, f"{key}.translation")
        if turn.size != 9 or shift.size != 3:
            found = f"{turn.size} and {shift.size} numbers"
            raise InputError(
                "The transform is not whole.", file=path, key=key or None,
                expected="a 3×3 rotation and a translation of 3", found=found,
            )  # fmt: skip
        array = np.c_[turn.reshape(3, 3), shift.reshape(3)]
    else:
        array = _array(value, path, key)
    if array.size not in (12, 16):
        raise InputError(
            "The file has no transform.", file=path, key=key or None, expected="4×4 or 3×4 numbers",
            found=f"{array.size} numbers",
        )  # fmt: skip
    out = np.eye(4)
    out[: array.size // 4] = array.reshape(-1, 4)
    turn = out[:3, :3]
    off = float(np.abs(turn @ turn.T - np.eye(3)).max())
    if not np.array_equal(out[3], [0, 0, 0, 1]) or not off < _TOLERANCE or np.linalg.det(turn) < 0:
        raise InputError(
            "The matrix is no rigid transform.",
            file=path,
            key=key or None,
            expected="a rotation, a translation in the last column, and 0 0 0 1 as the last row",
            found=f"|R·Rᵀ − 1| = {off:.2g}, determinant {np.linalg.det(turn):+.2f}, last row {out[3]}",
            remedy="a matrix stored column by column must be transposed; one with a scale is none of these",
        )
    return out


def _array(value: Any, path: Path, key: str) -> np.ndarray:
    try:
        array = np.array(value, dtype=float)
        if value is None or not np.isfinite(array).all():
            raise ValueError("missing, or not finite")
        return array
    except (TypeError, ValueError) as error:
        raise InputError(
            "The transform holds something else than numbers.", file=path, key=key or None,
            expected="finite numbers", found=str(error)[:100],
        ) from None  # fmt: skip


def _text(path: Path) -> Any:
    """Numbers of a text file: by key, where its lines are ``key: numbers``, else all in rows."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("The file cannot be read.", file=path, expected=_KINDS, found=str(error)) from None
    lines = [line.split("#")[0].strip() for line in lines]
    lines = [line for line in lines if line]
    keyed = [re.match(r"([A-Za-z_]\w*)\s*[:=]\s*(.*)", line) for line in lines]
    try:
        if lines and all(keyed):
            return {m[1]: _row(m[2]) for m in keyed if m and m[1] != "calib_time"}
        return [_row(line) for line in lines]
    except ValueError as error:
        raise InputError(
            "The text holds something else than numbers.", file=path, expected=_KINDS, found=str(error)
        ) from None


def _row(text: str) -> list[float]:
    return [float(v) for v in re.split(r"[\s,;]+", text.strip("[] ;,")) if v]


def _kitti(
    data: dict[str, Any],
    path: Path,
    direction: Direction | None,
    resolution: tuple[int, int] | None,
    view: str,
) -> LidarCamera:
    """KITTI's calib.txt: pixel ~ P R0_rect Tr_velo_to_cam X (Geiger et al. 2013, eq. 8).

    With P = K [1 | b] the camera of this view is at R = R0 R_tr, t = R0 t_tr + b. In the files of the
    odometry benchmark, which are rectified already, the last transform is called Tr.
    """
    _agree(path, "lidar_to_camera", direction)
    name = next((key for key in ("Tr_velo_to_cam", "Tr_velo_cam", "Tr") if key in data), None)
    if name is None:
        raise InputError(
            "The file has no transform of the lidar.", file=path, expected="Tr_velo_to_cam",
            found=", ".join(data),
        )  # fmt: skip
    projection, lidar = _sized(data, view, 12, path).reshape(3, 4), _sized(data, name, 12, path).reshape(3, 4)
    rectify = next((key for key in ("R0_rect", "R_rect") if key in data), None)
    level = _sized(data, rectify, 9, path).reshape(3, 3) if rectify else np.eye(3)
    if resolution is None:
        raise InputError(
            "KITTI's file does not say the size of the images.",
            file=path,
            key="resolution",
            expected="width and height, px",
            remedy="give the resolution of the image; sequences differ by a few pixels",
        )
    matrix = projection[:, :3]
    shift = level @ lidar[:, 3] + np.linalg.solve(matrix, projection[:, 3])
    size = (int(resolution[0]), int(resolution[1]))
    try:
        camera = Camera(view, "pinhole", matrix, np.zeros(0), level @ lidar[:, :3], shift, size)
    except InputError as error:
        raise InputError(
            error.problem, file=path, key=error.key, expected=error.expected, found=error.found,
            remedy=error.remedy,
        ) from None  # fmt: skip
    return LidarCamera(camera, note=f"from {path.name}, {view}")


def _sized(data: dict[str, Any], key: str, size: int, path: Path) -> np.ndarray:
    array = _array(data[key], path, key)
    if array.size != size:
        raise InputError(
            f"'{key}' is not whole.", file=path, key=key, expected=f"{size} numbers", found=str(array.size)
        )
    return array
