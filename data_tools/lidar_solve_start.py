"""Where camera and lidar may be from each other, from the pairs alone: starts for the least squares.

Two kinds, each from many random handfuls of pairs and held against the median distance of all (Rousseeuw
1984), so that outliers do no harm. First, as if the camera were at the lidar: the focal length from angles
between rays, and the rotation that brings the lidar's rays onto the camera's (Wahba 1965; Kabsch 1976). That
is nearly true of a rig with far targets, where nothing else is certain. Second, the pose for a range of focal
lengths (OpenCV's SQPnP and EPnP): for a camera anywhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from acino_fte.cameras import Camera

N_FOCALS, _NARROWEST, _WIDEST = 14, 40.0, 0.25  # focal lengths to try, in widths of the image
_HANDFULS, _PNP_HANDFULS, _KEPT = 80, 10, 3


def starts(camera: Camera, free_focal: bool, pixel: np.ndarray, xyz: np.ndarray) -> list[Camera]:
    """Cameras to begin with, best first of each kind.

    Parameters
    ----------
    camera : Camera
        Its lens is used as it is, but for the focal length where that is free.
    free_focal : bool
        Whether it is.
    pixel, xyz : (P, 2), (P, 3)
        The pairs.
    """
    rng = np.random.default_rng(5)
    near = _at_the_lidar(camera, free_focal, pixel, xyz, rng)
    anywhere = _anywhere(camera, free_focal, pixel, xyz, rng)
    return _best(near, pixel, xyz) + _best(anywhere, pixel, xyz)


def _best(cameras: list[Camera], pixel: np.ndarray, xyz: np.ndarray) -> list[Camera]:
    """The few with the least median distance."""
    scores = []
    for camera in cameras:
        off = np.linalg.norm(camera.project(xyz) - pixel, axis=1)
        scores.append(float(np.median(np.where(np.isfinite(off), off, 1e9))))
    return [cameras[i] for i in np.argsort(scores)[:_KEPT]]


def _with(camera: Camera, focal: float | None, rotation: np.ndarray, translation: np.ndarray) -> Camera:
    matrix = camera.matrix.copy()
    if focal is not None:
        scale = focal / np.sqrt(matrix[0, 0] * matrix[1, 1])
        matrix[[0, 1], [0, 1]] *= scale
    return replace(camera, matrix=matrix, rotation=rotation, translation=translation)


def _at_the_lidar(
    camera: Camera, free_focal: bool, pixel: np.ndarray, xyz: np.ndarray, rng: np.random.Generator
) -> list[Camera]:
    """Rotations from handfuls of three pairs, the camera at the lidar."""
    rays = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    hands = np.array([rng.choice(len(pixel), 3, replace=False) for _ in range(_HANDFULS)])
    out = []
    for hand in [*hands, np.arange(len(pixel))]:
        focal = None
        if free_focal:
            a, b = np.triu_indices(len(hand), 1)
            angle = np.linalg.norm(rays[hand[a]] - rays[hand[b]], axis=1)
            apart = np.linalg.norm(pixel[hand[a]] - pixel[hand[b]], axis=1)
            focal = float(np.median(apart / np.maximum(angle, 1e-9)))
            focal = float(np.clip(focal, 0.1 * camera.resolution[0], 1e3 * camera.resolution[0]))
        lens = _with(camera, focal, np.eye(3), np.zeros(3))
        directions = lens.directions(pixel[hand])
        if np.isfinite(directions).all():
            out.append(_with(camera, focal, _turn(rays[hand], directions), np.zeros(3)))
    return out


def _turn(rays: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The rotation that brings rays (K, 3) onto directions (K, 3) best."""
    u, _, vt = np.linalg.svd(directions.T @ rays)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _anywhere(
    camera: Camera, free_focal: bool, pixel: np.ndarray, xyz: np.ndarray, rng: np.random.Generator
) -> list[Camera]:
    """Poses by PnP from handfuls of six pairs and from all, for every focal length."""
    import cv2

    width, n = camera.resolution[0], len(pixel)
    focals: list[float | None] = [None]
    if free_focal:
        focals = [float(f) for f in np.geomspace(_WIDEST * width, _NARROWEST * width, N_FOCALS)]
    size = min(n, 6)
    n_hands = _PNP_HANDFULS if free_focal else 6 * _PNP_HANDFULS
    hands = [rng.choice(n, size, replace=False) for _ in range(n_hands)] + [np.arange(n)]
    out = []
    for focal in focals:
        lens = _with(camera, focal, np.eye(3), np.zeros(3))
        ideal = lens.undistort(pixel)
        for hand in hands:
            if not np.isfinite(ideal[hand]).all():
                continue
            for method in (cv2.SOLVEPNP_SQPNP,) if len(hand) < n else (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP):
                pose = _pnp(xyz[hand], ideal[hand], method)
                if pose is not None:
                    out.append(_with(camera, focal, *pose))
    return out


def _pnp(xyz: np.ndarray, ideal: np.ndarray, method: int) -> tuple[np.ndarray, np.ndarray] | None:
    """One pose by OpenCV; None where it finds none."""
    import cv2

    try:
        ok, turn, shift = cv2.solvePnP(xyz.copy(), ideal.copy(), np.eye(3), None, flags=method)
    except cv2.error:
        return None
    if not ok or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    return cv2.Rodrigues(turn)[0], shift.ravel()
