"""Calibrated cameras from files: the project's own, AcinoSet's scenes, and TOML as Anipose writes it."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from acino_fte.cameras import Camera, CameraArray
from acino_fte.errors import InputError
from acino_fte.species_file import validation_message

FORMAT = "acino-fte/cameras/1"
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_KINDS = f"'format: {FORMAT}', an AcinoSet scene (camera_resolution, cameras), or TOML as Anipose writes it"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class CameraEntry(_Strict):
    """One camera of the project's own file."""

    name: str = Field(min_length=1)
    model: Literal["pinhole", "fisheye"]
    resolution: tuple[int, int] = Field(description="width and height, px")
    matrix: list = Field(description="3×3 camera matrix, px")
    distortion: list = Field(description="OpenCV's coefficients in OpenCV's order")
    rotation: list = Field(description="world to camera, 3×3 or one 3×3 per frame")
    translation: list = Field(description="world to camera, m, 3 or 3 per frame")


class CamerasFile(_Strict):
    """The project's own camera file, ``cameras.json``."""

    format: Literal["acino-fte/cameras/1"]
    cameras: list[CameraEntry] = Field(min_length=1)


class _SceneCamera(BaseModel):
    name: str | None = None
    k: Any
    d: Any
    r: Any
    t: Any


class _Scene(BaseModel):
    """AcinoSet's scene: fisheye cameras in the order of their numbers, all of one resolution."""

    camera_resolution: tuple[int, int]
    cameras: list[_SceneCamera] = Field(min_length=1)


class _TomlCamera(BaseModel):
    name: str | None = None
    size: tuple[float, float]
    matrix: Any
    distortions: Any
    rotation: Any
    translation: Any
    fisheye: bool = False


def read_cameras(path: Path | str, *, unit: str = "m") -> CameraArray:
    """Read a camera file: the project's JSON, an AcinoSet scene (JSON), or Anipose's TOML.

    Parameters
    ----------
    path : Path
        The file; its ending .toml or another says which of them.
    unit : {"m", "cm", "mm"}
        Unit of the translations in the file. Anipose's is that of the calibration board, often mm.

    Returns
    -------
    CameraArray
        World to camera, m. Cameras of an AcinoSet scene without names are called ``cam1``, ``cam2``, ….

    Raises
    ------
    InputError
        The file is missing or of no known kind, a key is missing, or a number cannot be a camera's.
    """
    path = Path(path)
    data = _parse(path)
    if isinstance(data, dict) and path.suffix.lower() == ".toml":
        cameras = _from_toml(data, path)
    elif isinstance(data, dict) and "format" in data:
        cameras = _from_own(data, path)
    elif isinstance(data, dict) and "cameras" in data:
        cameras = _from_scene(data, path)
    else:
        keys = ", ".join(map(str, data)) if isinstance(data, dict) else type(data).__name__
        raise InputError(
            "This is no camera file of a known kind.",
            file=path,
            expected=_KINDS,
            found=keys[:200] or "nothing",
            remedy="check the path; one camera's intrinsics alone are not enough",
        )
    try:
        return CameraArray(tuple(_camera(key, values, unit, path) for key, values in cameras.items()))
    except InputError as error:
        raise error if error.file else _with_file(error, path, "cameras") from None


def _parse(path: Path) -> Any:
    try:
        text = path.read_text(encoding="utf-8")
        return tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
    except FileNotFoundError:
        raise InputError("The camera file does not exist.", file=path, remedy="check the path") from None
    except (json.JSONDecodeError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            "The camera file cannot be read.",
            file=path,
            expected=_KINDS,
            found=str(error),
            remedy="write the file again; it was cut, or edited by hand",
        ) from None
    except OSError as error:
        raise InputError("The camera file cannot be opened.", file=path, found=str(error)) from None


def _validated(model: type[BaseModel], data: Any, path: Path, within: str = "") -> Any:
    try:
        return model.model_validate(data)
    except ValidationError as error:
        place, text = validation_message(error, model)
        place = ".".join(part for part in (within, place) if part)
        raise InputError(
            f"The camera file has a fault at '{place}': {text}.",
            file=path,
            key=place,
            remedy="mend that key, or write the calibration again",
        ) from None


def _from_own(data: dict, path: Path) -> dict[str, dict[str, Any]]:
    """Camera arguments by place in the project's own file."""
    if data["format"] != FORMAT:
        raise InputError(
            "The camera file has a format that this version does not read.",
            file=path,
            key="format",
            expected=FORMAT,
            found=repr(data["format"]),
            remedy=f'write "format": "{FORMAT}", or leave it out in an AcinoSet scene',
        )
    file = _validated(CamerasFile, data, path)
    return {f"cameras.{i}": entry.model_dump() for i, entry in enumerate(file.cameras)}


def _from_scene(data: dict, path: Path) -> dict[str, dict[str, Any]]:
    """Camera arguments by place in an AcinoSet scene."""
    scene = _validated(_Scene, data, path)
    return {
        f"cameras.{i}": {
            "name": entry.name or f"cam{i + 1}",
            "model": "fisheye",
            "resolution": scene.camera_resolution,
            "matrix": entry.k,
            "distortion": entry.d,
            "rotation": entry.r,
            "translation": entry.t,
        }
        for i, entry in enumerate(scene.cameras)
    }


def _from_toml(data: dict, path: Path) -> dict[str, dict[str, Any]]:
    """Camera arguments by section; sections without a camera matrix (metadata) are passed over."""
    sections = {key: value for key, value in data.items() if isinstance(value, dict) and "matrix" in value}
    if not sections:
        raise InputError(
            "The TOML file has no camera.",
            file=path,
            expected="sections such as [cam_0] with name, size, matrix, distortions, rotation, translation",
            found=", ".join(data) or "nothing",
            remedy="check the path",
        )
    result = {}
    for key, section in sections.items():
        entry = _validated(_TomlCamera, section, path, key)
        result[key] = {
            "name": entry.name or key,
            "model": "fisheye" if entry.fisheye else "pinhole",
            "resolution": (round(entry.size[0]), round(entry.size[1])),
            "matrix": entry.matrix,
            "distortion": entry.distortions,
            "rotation": entry.rotation,
            "translation": entry.translation,
        }
    return result


def _camera(key: str, values: dict[str, Any], unit: str, path: Path) -> Camera:
    """A checked camera; faults name the file and the place in it."""
    from scipy.spatial.transform import Rotation

    arrays = {}
    for name in ("matrix", "distortion", "rotation", "translation"):
        try:
            arrays[name] = np.asarray(values[name], dtype=float)
        except (TypeError, ValueError):
            raise InputError(
                f"Camera '{values['name']}' cannot be used: its {name} is no array of numbers.",
                file=path,
                key=f"{key}.{name}",
                expected="numbers in rows of equal length",
                found=repr(values[name])[:80],
                remedy="write the calibration again",
            ) from None
    if arrays["rotation"].shape == (3,) and np.isfinite(arrays["rotation"]).all():
        arrays["rotation"] = Rotation.from_rotvec(arrays["rotation"]).as_matrix()
    arrays["translation"] = arrays["translation"] * UNITS[unit]
    width, height = values["resolution"]
    if min(width, height) < 1:
        raise InputError(
            f"Camera '{values['name']}' has an impossible resolution.",
            file=path,
            key=f"{key}.resolution",
            expected="width and height in px",
            found=f"{width}×{height}",
            remedy="write the resolution of the images that it was calibrated with",
        )
    try:
        return Camera(
            name=values["name"], model=values["model"], resolution=(int(width), int(height)), **arrays
        )
    except InputError as error:
        raise _with_file(error, path, f"{key}.{error.key}") from None


def _with_file(error: InputError, path: Path, key: str) -> InputError:
    return InputError(
        error.problem, file=path, key=key, expected=error.expected, found=error.found, remedy=error.remedy
    )


def write_cameras(path: Path | str, cameras: CameraArray) -> None:
    """Write cameras as the project's own JSON file; numbers keep every digit.

    Raises
    ------
    InputError
        A camera is of a kind that the file has no words for: skew (DLT), Vicon's lens, or a model that only
        COLMAP knows.
    """
    for camera in cameras:
        if type(camera) is not Camera or camera.model not in ("pinhole", "fisheye"):
            plain = type(camera) is Camera
            raise InputError(
                f"Camera '{camera.name}' cannot be written as '{FORMAT}'.",
                file=path,
                expected="pinhole and fisheye cameras of OpenCV's kind",
                found=f"the model '{camera.model}'"
                if plain
                else f"a {type(camera).__name__}, which may have skew or another lens",
                remedy="keep its own file (COLMAP's model, DLT coefficients, .xcp)",
            )
    entries = [
        {
            "name": camera.name,
            "model": camera.model,
            "resolution": list(camera.resolution),
            "matrix": camera.matrix.tolist(),
            "distortion": camera.distortion.tolist(),
            "rotation": camera.rotation.tolist(),
            "translation": camera.translation.tolist(),
        }
        for camera in cameras
    ]
    text = json.dumps({"format": FORMAT, "cameras": entries}, indent=1, ensure_ascii=False)
    Path(path).write_text(text + "\n", encoding="utf-8")
