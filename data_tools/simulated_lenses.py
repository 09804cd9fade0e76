"""Lenses of simulated scenes under COLMAP's names, as the project's cameras and as COLMAP's parameters."""

from __future__ import annotations

import numpy as np

from acino_fte.cameras import Camera

_SMALL = np.array([0.003, 0.003, 4.0, 4.0, 0.015, 0.015])  # how lenses of one make differ
_FISHEYE = (0.037, 0.012, -0.008, 0.001)

# COLMAP's name: the project's model, whether there are two focal lengths, coefficients in the camera's order.
SCENE_LENSES: dict[str, tuple[str, bool, tuple[float, ...]]] = {
    "SIMPLE_PINHOLE": ("pinhole", False, ()),
    "PINHOLE": ("pinhole", True, ()),
    "SIMPLE_RADIAL": ("pinhole", False, (-0.11, 0.0, 0.0, 0.0)),
    "RADIAL": ("pinhole", False, (-0.23, 0.067, 0.0, 0.0)),
    "OPENCV": ("pinhole", True, (-0.23, 0.067, 0.0003, -0.0002)),
    "FULL_OPENCV": ("pinhole", True, (-0.2, 0.06, 0.0003, -0.0002, -0.002, 0.03, 0.001, 0.0001)),
    "OPENCV_FISHEYE": ("fisheye", True, _FISHEYE),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", False, (0.037, 0.0, 0.0, 0.0)),
    "RADIAL_FISHEYE": ("fisheye", False, (0.037, 0.012, 0.0, 0.0)),
}
_N_COEFFICIENTS = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2}


def scene_lens(
    name: str, focal: float, resolution: tuple[int, int], draw: np.ndarray
) -> tuple[str, np.ndarray, np.ndarray]:
    """A lens of a make.

    Parameters
    ----------
    name : str
        COLMAP's, a key of :data:`SCENE_LENSES`.
    focal : float
        Of the make, px.
    resolution : tuple of int
        Width and height, px.
    draw : (6,)
        Standard normal numbers: how this lens differs from others of the make.

    Returns
    -------
    model : str
        Of :class:`acino_fte.cameras.Camera`.
    matrix : (3, 3)
        Pixel centres at integers.
    distortion : (0 | 4 | 8,)
    """
    model, two, coefficients = SCENE_LENSES[name]
    step = _SMALL * draw
    fx = focal * (1.0 + step[0])
    fy = fx * (1.002 + step[1] / 3.0) if two else fx
    matrix = np.array([[fx, 0.0, 0.0], [0.0, fy, 0.0], [0.0, 0.0, 1.0]])
    matrix[:2, 2] = 0.5 * np.array(resolution) - 0.5 + step[2:4]
    distortion = np.array(coefficients)
    if distortion.size:
        distortion[:2] *= 1.0 + step[4:]
    return model, matrix, distortion


def colmap_parameters(name: str, lens: Camera) -> np.ndarray:
    """Parameters in COLMAP's order, but pixel centres at integers (COLMAP adds 0.5 to the principal point).

    Parameters
    ----------
    name : str
        COLMAP's, a key of :data:`SCENE_LENSES`.
    lens : Camera
        From :func:`scene_lens`.
    """
    two = SCENE_LENSES[name][1]
    focal = np.diag(lens.matrix)[: 2 if two else 1]
    return np.concatenate([focal, lens.matrix[:2, 2], lens.distortion[: _N_COEFFICIENTS.get(name)]])
