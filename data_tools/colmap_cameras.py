"""COLMAP's camera models as cameras of the project, and back.

COLMAP has the centre of the first pixel at (0.5, 0.5), we have it at (0, 0): half a pixel is taken off the
principal point on the way in and put back on the way out. The order of the parameters is that of COLMAP's
``Camera.params_info``; each model was checked against pycolmap 4.2.1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    import pycolmap

_HALF_PIXEL = 0.5
# COLMAP's name: our model, whether there is one focal length, how many coefficients ours takes (more than
# COLMAP's: the rest is zero)
_MODELS: dict[str, tuple[str, bool, int]] = {
    "SIMPLE_PINHOLE": ("pinhole", True, 0),
    "PINHOLE": ("pinhole", False, 0),
    "SIMPLE_RADIAL": ("pinhole", True, 4),
    "RADIAL": ("pinhole", True, 4),
    "OPENCV": ("pinhole", False, 4),
    "FULL_OPENCV": ("pinhole", False, 8),
    "SIMPLE_FISHEYE": ("fisheye", True, 4),
    "FISHEYE": ("fisheye", False, 4),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", True, 4),
    "RADIAL_FISHEYE": ("fisheye", True, 4),
    "OPENCV_FISHEYE": ("fisheye", False, 4),
    "FOV": ("fov", False, 1),
    "THIN_PRISM_FISHEYE": ("thin_prism_fisheye", False, 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("rad_tan_thin_prism_fisheye", False, 12),
    "SIMPLE_DIVISION": ("division", True, 1),
    "DIVISION": ("division", False, 1),
    "EUCM": ("eucm", False, 2),
    "EQUIRECTANGULAR": ("equirectangular", False, 0),
}
_WRITTEN = {
    model: name
    for name, (model, single, _) in _MODELS.items()
    if not single and model not in ("pinhole", "fisheye")
} | {"fisheye": "OPENCV_FISHEYE"}


def camera_from_colmap(camera: pycolmap.Camera, name: str) -> Camera:
    """Our camera of a COLMAP camera, at the origin and looking along z.

    Parameters
    ----------
    camera : pycolmap.Camera
        Of any model of pycolmap 4.2.1.
    name : str
        Name of the result.

    Returns
    -------
    Camera
        Pixel centres at integers. A panorama (EQUIRECTANGULAR) has the model ``equirectangular``.

    Raises
    ------
    InputError
        The model is none that we know, or its parameters cannot be a camera's.
    """
    kind = str(camera.model_name)
    if kind not in _MODELS:
        raise InputError(
            f"Camera '{name}' has a COLMAP camera model that this version does not know.",
            key="model",
            expected=", ".join(_MODELS),
            found=kind + did_you_mean(kind, _MODELS),
            remedy="convert the model with COLMAP, by undistorting its images",
        )
    values = np.asarray(camera.params, dtype=float)
    model, single, count = _MODELS[kind]
    expected = len(_parameter_names(camera))
    if len(values) != expected:
        raise InputError(
            f"Camera '{name}' has the wrong number of parameters.",
            key="params",
            expected=f"{expected} for {kind}: {camera.params_info}",
            found=str(len(values)),
            remedy="export the COLMAP model again",
        )
    if model == "equirectangular":
        values = _panorama(*values)
    elif single:
        values = np.concatenate([values[:1], values])
    coefficients = np.zeros(count)
    coefficients[: len(values) - 4] = values[4:]
    return Camera(
        name=name,
        model=model,
        matrix=np.array(
            [
                [values[0], 0.0, values[2] - _HALF_PIXEL],
                [0.0, values[1], values[3] - _HALF_PIXEL],
                [0.0, 0.0, 1.0],
            ]
        ),
        distortion=coefficients,
        rotation=np.eye(3),
        translation=np.zeros(3),
        resolution=(int(camera.width), int(camera.height)),
    )


def colmap_parameters(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's model name and parameters of a camera; the reverse of :func:`camera_from_colmap`.

    The most general COLMAP model of its kind: PINHOLE, OPENCV or FULL_OPENCV for pinhole cameras,
    OPENCV_FISHEYE for fisheyes.

    Raises
    ------
    InputError
        COLMAP has no such camera: a pinhole with thin-prism terms, skew, Vicon's lens, or a cut panorama.
    """
    k = camera.matrix
    start = [k[0, 0], k[1, 1], k[0, 2] + _HALF_PIXEL, k[1, 2] + _HALF_PIXEL]
    if camera.model == "pinhole" and not np.any(camera.distortion[8:]):
        count = len(camera.distortion)
        name, length = {0: ("PINHOLE", 0), 4: ("OPENCV", 4)}.get(count, ("FULL_OPENCV", 8))
        full = np.zeros(max(12, count))
        full[:count] = camera.distortion
        return name, [float(v) for v in (*start, *full[:length])]
    if camera.model == "equirectangular":
        size = [float(v) for v in camera.resolution]
        if not np.allclose(_panorama(*size), start, rtol=1e-9, atol=0):
            raise _not_colmap(
                camera, "a whole panorama, 360° wide and 180° high", "one that is cut or turned"
            )
        return "EQUIRECTANGULAR", size
    if camera.model not in _WRITTEN:
        known = ", ".join(dict.fromkeys(model for model, _, _ in _MODELS.values()))
        found = "thin-prism coefficients (s1 … s4)" if camera.model == "pinhole" else f"'{camera.model}'"
        raise _not_colmap(camera, f"one of {known}; pinhole without thin-prism terms", found)
    return _WRITTEN[camera.model], [float(v) for v in (*start, *camera.distortion)]


def _panorama(width: float, height: float) -> np.ndarray:
    """fx, fy (px/rad) and COLMAP's cx, cy of a whole panorama."""
    return np.array([width / (2 * np.pi), height / np.pi, 0.5 * width, 0.5 * height])


def _parameter_names(camera: pycolmap.Camera) -> list[str]:
    return str(camera.params_info).replace(" ", "").split(",")


def _not_colmap(camera: Camera, expected: str, found: str) -> InputError:
    return InputError(
        f"Camera '{camera.name}' is of no model that COLMAP has.",
        key="model",
        expected=expected,
        found=found,
        remedy="leave this camera out, or undistort its images",
    )
