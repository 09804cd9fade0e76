"""Rigs to simulate recordings of animals without markers: the thesis's pair, and n cameras about a box.

Shapes: N frames.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.track_motions import Box

Lens = Literal["pinhole", "distorted", "fisheye"]
LENSES: tuple[Lens, ...] = ("pinhole", "distorted", "fisheye")

RESOLUTION = (1920, 1080)
FOCAL = 1230.0
_MATRIX = ((FOCAL, 0.0, 960.0), (0.0, FOCAL, 540.0), (0.0, 0.0, 1.0))
_DISTORTION: dict[Lens, tuple[float, ...]] = {
    "pinhole": (0.0,) * 5,
    "distorted": (-0.22, 0.09, 0.0006, -0.0004, -0.015),
    "fisheye": (0.037, 0.048, -0.038, 0.011),
}
_SPACING = np.radians(40.0)  # between neighbours; a full circle from nine cameras on
_SWAY = (np.radians(1.5), 0.05)  # of a camera in a hand: rad and m


def thesis_rig(lens: Lens = "pinhole") -> CameraArray:
    """Two action cameras 2 m apart, each turned in by 10°.

    The first camera is at the origin; the second is 2 m to its own right of it, as in the thesis's set.
    """
    cameras = []
    for c, (angle, shift) in enumerate(((-10.0, 0.0), (10.0, -2.0))):
        rotation = Rotation.from_euler("y", angle, degrees=True).as_matrix()
        cameras.append(_camera(f"cam{c}", lens, rotation, np.array([shift, 0.0, 0.0])))
    return CameraArray(tuple(cameras))


def ring_rig(
    n_cameras: int, box: Box, lens: Lens, rng: np.random.Generator, n_moving_frames: int | None = None
) -> CameraArray:
    """Cameras on an arc about a box, neighbours about 40° apart, at unequal heights and distances, z up.

    Parameters
    ----------
    n_cameras : int
        They are called ``cam0``, ``cam1``, …
    box : tuple
        Lowest and highest (x, y, z), m. It fills most of every image.
    lens : str
        One of :data:`LENSES`.
    rng : numpy.random.Generator
        Source of all that is random.
    n_moving_frames : int, optional
        Frames of cameras that sway as in a hand; fixed cameras when absent.
    """
    low, high = np.array(box, dtype=float)
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    distance = radius / np.sin(np.arctan(0.5 * RESOLUTION[1] / FOCAL))
    spacing = min(_SPACING, 2 * np.pi / n_cameras)
    cameras = []
    for c in range(n_cameras):
        azimuth = spacing * (c + rng.uniform(-0.15, 0.15))
        elevation = rng.uniform(-0.05, 0.45)
        reach = distance * rng.uniform(0.85, 1.1)
        out = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        place = centre + reach * np.array(out)
        rotation = _looking(centre + 0.1 * radius * rng.normal(size=3) - place)
        translation = -rotation @ place
        if n_moving_frames is not None:
            rotation, translation = _swaying(rotation, translation, n_moving_frames, rng)
        cameras.append(_camera(f"cam{c}", lens, rotation, translation))
    return CameraArray(tuple(cameras))


def _camera(name: str, lens: Lens, rotation: np.ndarray, translation: np.ndarray) -> Camera:
    model = "fisheye" if lens == "fisheye" else "pinhole"
    return Camera(
        name, model, np.array(_MATRIX), np.array(_DISTORTION[lens]), rotation, translation, RESOLUTION
    )


def _looking(forward: np.ndarray) -> np.ndarray:
    """World to camera of a level camera, z up."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _swaying(
    rotation: np.ndarray, translation: np.ndarray, n_frames: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 3, 3) and (N, 3): random walks pulled back to the middle, smooth over about ten frames."""
    steps = rng.normal(size=(n_frames + 60, 6))
    walk = np.apply_along_axis(np.convolve, 0, steps, np.hanning(32), "valid")[:n_frames]
    walk /= np.linalg.norm(np.hanning(32))
    turn = Rotation.from_rotvec(_SWAY[0] * walk[:, :3]).as_matrix()
    return turn @ rotation, np.einsum("nij,j->ni", turn, translation) + _SWAY[1] * walk[:, 3:]
