"""Intrinsics of one camera from a file: ROS' camera_info (``ost.yaml``), or the project's own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.errors import InputError

ROS_MODELS = {
    "plumb_bob": ("pinhole", (0, 4, 5)),
    "rational_polynomial": ("pinhole", (8, 12)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
}
"""Distortion models of ROS (REP 104; image_geometry) and how many coefficients they have."""
_EXPECTED = (
    "ROS' camera_info (image_width, camera_matrix, distortion_coefficients), or the project's own JSON"
)


def read_intrinsics(path: Path | str) -> Camera:
    """Read the intrinsics of one camera: ROS' ``ost.yaml``, ``cameras.json`` of one, or a calibration.

    Returns
    -------
    Camera
        At the origin, whatever pose the file has: only its lens is of use.

    Raises
    ------
    InputError
        The file is missing, broken or of no known kind, or it has several cameras.
    """
    path = Path(path)
    data = parsed(path)
    if isinstance(data, dict) and "camera_matrix" in data and "image_width" in data:
        return _camera_info(data, path)
    if isinstance(data, dict) and str(data.get("format", "")).startswith("acino-fte/lidar-camera"):
        from acino_fte.data_tools.lidar_camera import own_lidar_camera

        return at_origin(own_lidar_camera(data, path).camera)
    if isinstance(data, dict) and "cameras" in data:
        from acino_fte.data_tools.calibration import read_cameras

        cameras = read_cameras(path)
        if len(cameras) != 1:
            raise InputError(
                "The file has several cameras.",
                file=path,
                expected="one",
                found=", ".join(cameras.names),
                remedy="write the one that was calibrated to the lidar into a file of its own",
            )
        return at_origin(cameras.cameras[0])
    raise InputError(
        "This is no file of a camera's intrinsics of a known kind.",
        file=path,
        expected=_EXPECTED,
        found=", ".join(map(str, data))[:200] if isinstance(data, dict) else type(data).__name__,
        remedy="check the path",
    )


def at_origin(camera: Camera) -> Camera:
    """The camera's lens alone."""
    pose = (np.eye(3), np.zeros(3))
    return Camera(camera.name, camera.model, camera.matrix, camera.distortion, *pose, camera.resolution)


def parsed(path: Path) -> Any:
    """The content of a JSON or YAML file; only plain data is ever made of it."""
    import yaml

    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError("The file does not exist.", file=path, remedy="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("The file cannot be read.", file=path, found=str(error)) from None
    try:
        if path.suffix.lower() == ".json" or text.lstrip()[:1] in ("{", "["):
            return json.loads(text)
        return yaml.safe_load(text)
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise InputError(
            "The file cannot be read as JSON or YAML.",
            file=path,
            expected=_EXPECTED,
            found=" ".join(str(error).split())[:200],
            remedy="write it again; it was cut, or edited by hand",
        ) from None


def _camera_info(data: dict[str, Any], path: Path) -> Camera:
    """The camera of ROS' camera_calibration, of images that are not rectified."""
    ros = str(data.get("distortion_model", "plumb_bob"))
    if ros not in ROS_MODELS:
        raise InputError(
            "The distortion model is not known.",
            file=path,
            key="distortion_model",
            expected=", ".join(ROS_MODELS),
            found=ros,
        )
    model, counts = ROS_MODELS[ros]
    matrix = _numbers(data, "camera_matrix", path)
    distortion = _numbers(data, "distortion_coefficients", path)
    if matrix.size != 9 or distortion.size not in counts:
        key = "camera_matrix" if matrix.size != 9 else "distortion_coefficients"
        raise InputError(
            f"'{key}' has the wrong size.",
            file=path,
            key=f"{key}.data",
            expected="9 numbers" if key == "camera_matrix" else " or ".join(map(str, counts)) + " numbers",
            found=str(matrix.size if key == "camera_matrix" else distortion.size),
        )
    try:
        size = (int(data["image_width"]), int(data["image_height"]))
    except (KeyError, TypeError, ValueError):
        raise InputError(
            "The size of the images is not known.",
            file=path,
            key="image_width, image_height",
            expected="px",
            found=f"{data.get('image_width')!r}, {data.get('image_height')!r}",
        ) from None
    name = str(data.get("camera_name") or "cam1")
    try:
        return Camera(name, model, matrix.reshape(3, 3), distortion, np.eye(3), np.zeros(3), size)
    except InputError as error:
        raise InputError(
            error.problem, file=path, key=error.key, expected=error.expected, found=error.found,
            remedy=error.remedy,
        ) from None  # fmt: skip


def _numbers(data: dict[str, Any], key: str, path: Path) -> np.ndarray:
    value = data.get(key)
    if isinstance(value, dict):
        value = value.get("data")
    try:
        return np.array(value, dtype=float).ravel()
    except (TypeError, ValueError):
        raise InputError(
            f"'{key}' holds no numbers.", file=path, key=key, expected="numbers", found=repr(value)[:80]
        ) from None
