"""Places cameras about the path of an animal, as a field set-up would."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from acino_fte.cameras import Camera, CameraArray

CameraModel = Literal["fisheye", "pinhole"]
Layout = Literal["auto", "sides", "ring"]

RESOLUTION = (2704, 1520)
# The action cameras of AcinoSet (Joska et al. 2021): focal length, principal point, fisheye coefficients.
_MATRIX = ((1240.0, 0.0, 1345.0), (0.0, 1240.0, 773.0), (0.0, 0.0, 1.0))
_FISHEYE = (0.037, 0.048, -0.038, 0.011)
_DISTANCE = 3.3  # body lengths from the path; 7 m for a cheetah with its tail
_HEIGHT = 0.6  # body lengths above the ground


def camera_ring(
    positions: np.ndarray,
    n_cameras: int = 6,
    *,
    radius: float | None = None,
    height: float | None = None,
    model: CameraModel = "fisheye",
    layout: Layout = "auto",
) -> CameraArray:
    """Cameras that look at the path of an animal.

    Parameters
    ----------
    positions : (N, M, 3)
        Marker positions, m, world frame.
    n_cameras : int
        They are called ``cam1``, ``cam2``, …
    radius : float, optional
        Distance of the cameras from the line of the path (``sides``) or from the end of the path
        (``ring``), m; by default 3.3 body lengths.
    height : float, optional
        Above the ground, m; by default 0.6 body lengths.
    model : str
        ``"fisheye"``, the wide action cameras of AcinoSet, or ``"pinhole"`` without distortion.
    layout : str
        ``"sides"``: half of them on each side along the path; ``"ring"``: on a circle about it;
        ``"auto"``: a ring for a path shorter than the distance of the cameras, else the sides.

    Returns
    -------
    CameraArray
        Fixed cameras, world to camera, OpenCV axes.
    """
    middle = np.median(positions, axis=1)  # (N, 3)
    radius = radius if radius is not None else default_radius(positions)
    height = height if height is not None else _HEIGHT / _DISTANCE * default_radius(positions)
    centre = 0.5 * (middle.min(axis=0) + middle.max(axis=0))
    heading = _heading(middle)
    along = (middle - centre)[:, :2] @ heading
    length = float(np.ptp(along))
    if layout == "auto":
        layout = "ring" if length < radius else "sides"
    places = _sides(n_cameras, radius, length) if layout == "sides" else _ring(n_cameras, radius, length)
    cameras = []
    for i, (forward, left) in enumerate(places):
        place = centre.copy()
        place[:2] += forward * heading + left * np.array([-heading[1], heading[0]])
        place[2] = height
        target = centre.copy()
        if layout == "sides":
            target[:2] += 0.4 * forward * heading  # between straight across and the middle of the path
        cameras.append(_look_at(f"cam{i + 1}", place, target, model))
    return CameraArray(tuple(cameras))


def default_radius(positions: np.ndarray) -> float:
    """A sensible distance of cameras from an animal with marker positions (N, M, 3): 3.3 body lengths, m."""
    spread = np.linalg.norm(positions - np.median(positions, axis=1, keepdims=True), axis=-1)
    return _DISTANCE * max(2.0 * float(np.median(np.max(spread, axis=1))), 1e-3)


def _heading(middle: np.ndarray) -> np.ndarray:
    """Unit vector (2,) from the start of the path to its end; x when it goes nowhere."""
    way = (middle[-1] - middle[0])[:2]
    distance = float(np.hypot(*way))
    return way / distance if distance > 1e-6 else np.array([1.0, 0.0])


def _sides(n_cameras: int, radius: float, length: float) -> list[tuple[float, float]]:
    """Places (forward, left): odd ones on the left, even ones on the right, spread along the path."""
    distance = max(radius, 0.35 * length)
    places = []
    for i in range(n_cameras):
        count = (n_cameras + 1) // 2 if i % 2 == 0 else n_cameras // 2
        span = max(0.6 * length, 0.8 * distance) if count > 1 else 0.0
        forward = span * (i // 2 / (count - 1) - 0.5) if count > 1 else 0.0
        places.append((forward, distance if i % 2 == 0 else -distance))
    return places


def _ring(n_cameras: int, radius: float, length: float) -> list[tuple[float, float]]:
    """Places (forward, left) on a circle that has the path inside, the first one a little off its line."""
    distance = radius + 0.5 * length
    angle = 2 * np.pi * (np.arange(n_cameras) + 0.37) / n_cameras
    return [(distance * math.cos(a), distance * math.sin(a)) for a in angle]


def _look_at(name: str, place: np.ndarray, target: np.ndarray, model: CameraModel) -> Camera:
    """A camera at a place, level, with the target in the middle of its image."""
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:  # straight up or down
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    distortion = np.array(_FISHEYE) if model == "fisheye" else np.zeros(0)
    return Camera(name, model, np.array(_MATRIX), distortion, rotation, -rotation @ place, RESOLUTION)
