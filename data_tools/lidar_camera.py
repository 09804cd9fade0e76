"""A camera calibrated to a lidar, and its file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from acino_fte.cameras import Camera
from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError

FORMAT = "acino-fte/lidar-camera/1"
Direction = Literal["lidar_to_camera", "camera_to_lidar"]


@dataclass(frozen=True, eq=False)
class LidarCamera:
    """A camera and where the lidar is from it.

    Attributes
    ----------
    camera : Camera
        Its world is the frame of the lidar: `rotation` and `translation` are lidar to camera, and
        ``camera.project(xyz)`` gives the pixels of returns (…, 3), m.
    covariance : (D, D), optional
        Of `parameters`.
    parameters : tuple of str
        What the covariance is of: ``rotation_x``, … (rad, in the camera's frame, R_true = exp(ω×) R),
        ``translation_x``, … (m), ``log_f`` (relative), ``log_aspect`` (of fx/fy), ``cx``, ``cy`` (px),
        ``k1``, ``k2``.
    rmse_px : float
        Root mean square of the distances in the image (px) between picks and projections, outliers left out.
    n_pairs : int
        Pairs behind it; 0 where it comes from another program.
    date : str
        ISO 8601; empty where it is not known.
    note : str
        Where it comes from, and what is to be known when it is used.
    """

    camera: Camera
    covariance: np.ndarray | None = None
    parameters: tuple[str, ...] = ()
    rmse_px: float = float("nan")
    n_pairs: int = 0
    date: str = ""
    note: str = ""

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self.camera.name

    @property
    def lidar_to_camera(self) -> np.ndarray:
        """The transform as one matrix (4, 4)."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.camera.rotation, self.camera.translation
        return out

    def project(self, xyz: np.ndarray) -> np.ndarray:
        """Pixels (…, 2) of points (…, 3) in the lidar's frame, m; NaN behind the camera."""
        return self.camera.project(xyz)

    def sd(self, parameter: str) -> float:
        """Standard deviation of a parameter; NaN where it is not known."""
        if self.covariance is None or parameter not in self.parameters:
            return float("nan")
        i = self.parameters.index(parameter)
        return float(np.sqrt(self.covariance[i, i]))


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _Transform(_Strict):
    rotation: list[list[float]]
    translation: list[float] = Field(min_length=3, max_length=3)


class LidarCameraFile(_Strict):
    """The project's own file."""

    format: Literal["acino-fte/lidar-camera/1"]
    name: str = Field(min_length=1)
    model: Literal["pinhole", "fisheye"]
    resolution: tuple[int, int]
    camera_matrix: list[list[float]]
    distortion: list[float]
    lidar_to_camera: _Transform
    parameters: list[str] = []
    covariance: list[list[float]] | None = None
    rmse_px: float | None = None
    n_pairs: int = 0
    date: str = ""
    note: str = ""


def write_lidar_camera(path: Path | str, calibration: LidarCamera) -> None:
    """Write a calibration as the project's own JSON, whole or not at all; every digit kept.

    Raises
    ------
    InputError
        The lens is neither a pinhole nor a fisheye, the camera moves, or the file cannot be written.
    """
    camera = calibration.camera
    if type(camera) is not Camera or camera.model not in ("pinhole", "fisheye") or camera.moves:
        raise InputError(
            "This camera cannot be written as a calibration to a lidar.",
            file=path,
            expected="a pinhole or fisheye camera that is fixed to the lidar",
            found=f"'{camera.model}'" + (", with a pose per frame" if camera.moves else ""),
        )
    known = calibration.covariance is not None
    data = {
        "format": FORMAT,
        "name": camera.name,
        "model": camera.model,
        "resolution": list(camera.resolution),
        "camera_matrix": camera.matrix.tolist(),
        "distortion": camera.distortion.tolist(),
        "lidar_to_camera": {
            "rotation": camera.rotation.tolist(),
            "translation": camera.translation.tolist(),
        },
        "parameters": list(calibration.parameters),
        "covariance": np.asarray(calibration.covariance).tolist() if known else None,
        "rmse_px": float(calibration.rmse_px) if np.isfinite(calibration.rmse_px) else None,
        "n_pairs": int(calibration.n_pairs),
        "date": calibration.date,
        "note": calibration.note,
    }
    write_text_whole(Path(path), json.dumps(data, indent=1, ensure_ascii=False) + "\n")


def own_lidar_camera(data: dict[str, Any], path: Path) -> LidarCamera:
    """The calibration in the content of the project's own file.

    Raises
    ------
    InputError
        A key is missing or unknown, or its value cannot be a camera's.
    """
    try:
        file = LidarCameraFile.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise InputError(
            f"The calibration has a fault at '{place}': {first['msg']}.",
            file=path,
            key=place,
            remedy="mend that key, or write the calibration again",
        ) from None
    try:
        camera = Camera(
            file.name,
            file.model,
            np.array(file.camera_matrix),
            np.array(file.distortion),
            np.array(file.lidar_to_camera.rotation),
            np.array(file.lidar_to_camera.translation),
            file.resolution,
        )
        covariance = None if file.covariance is None else np.array(file.covariance, dtype=float)
    except (ValueError, InputError) as error:
        if isinstance(error, InputError):
            raise InputError(
                error.problem, file=path, key=error.key, expected=error.expected, found=error.found,
                remedy=error.remedy,
            ) from None  # fmt: skip
        raise InputError(
            "A matrix of the calibration has rows of different length.",
            file=path,
            remedy="write the calibration again",
        ) from None
    size = len(file.parameters)
    if covariance is not None and covariance.shape != (size, size):
        raise InputError(
            "The covariance does not fit its parameters.",
            file=path,
            key="covariance",
            expected=f"{size} × {size}",
            found=" × ".join(map(str, covariance.shape)),
        )
    rmse = float("nan") if file.rmse_px is None else file.rmse_px
    return LidarCamera(camera, covariance, tuple(file.parameters), rmse, file.n_pairs, file.date, file.note)


def read_lidar_camera(
    path: Path | str,
    direction: Direction | None = None,
    *,
    camera: Camera | Path | str | None = None,
    points: np.ndarray | None = None,
    resolution: tuple[int, int] | None = None,
    view: str = "P2",
) -> LidarCamera:
    """Read a calibration of a camera to a lidar: the project's JSON, or what other programs write.

    Parameters
    ----------
    path : Path
        The project's JSON; KITTI's ``calib.txt``; ``.npz`` with R and T; a 4×4 matrix in JSON, text or
        ``.npy``.
    direction : {"lidar_to_camera", "camera_to_lidar"}, optional
        Which way a transform goes whose file does not say so. It is never guessed.
    camera : Camera or Path, optional
        The intrinsics (or a file with them, such as ROS' ``ost.yaml``), where the file has none.
    points : (K, 3), optional
        Points of the cloud, m: where the direction is not known, the message tells for each of the two how
        many of them it would bring into the image.
    resolution : (width, height), optional
        px; KITTI's file does not have it.
    view : str
        Which of KITTI's cameras, ``P0`` to ``P3``; ``P2`` is the left one in colour.

    Raises
    ------
    InputError
        The file is missing, broken or of no known kind; it has no intrinsics and none were given; or the
        direction is not known.
    """
    from acino_fte.data_tools.lidar_camera_formats import read_any

    return read_any(Path(path), direction, camera, points, resolution, view)
