"""Which way is up in a structure-from-motion model: from the ground, a plane in its point cloud."""

from __future__ import annotations

import numpy as np

from acino_fte.data_tools.scene_gravity import TUKEY, KeyPoses, Up, up_from_cameras
from acino_fte.errors import InputError

_TILTED = 0.5  # cosine of the angle between the ground's normal and up as the cameras have it
_NEAR = 0.015  # distance to the ground plane of its points, as a share of the distance to the cameras
_BLOCKS = 10


def up_from_plane(keys: KeyPoses, points: np.ndarray) -> Up:
    """Up from the ground: the plane with most points of the cloud that has the cameras on one side.

    RANSAC (Fischler and Bolles 1981), then Tukey-weighted least squares of the distances to the plane.

    Parameters
    ----------
    keys : KeyPoses
        Of the cameras.
    points : (Q, 3)
        The cloud, in the model's axes.

    Raises
    ------
    InputError
        There is no such plane.
    """
    middle = keys.centre.mean(axis=0)
    guess = up_from_cameras(keys)
    points = points[np.isfinite(points).all(-1)]
    far = np.linalg.norm(points - middle, axis=1)
    reach = float(np.median(far)) if len(points) else 0.0
    candidates = points[far < 10 * reach] - middle
    if guess.sure and len(candidates):
        candidates = candidates[candidates @ guess.direction < 0]
    rng = np.random.default_rng(0)
    if len(candidates) > 20000:
        candidates = candidates[np.sort(rng.choice(len(candidates), 20000, replace=False))]
    normal = _ransac_plane(candidates, keys.centre - middle, guess, _NEAR * reach, rng)
    if normal is None:
        raise InputError(
            "The point cloud has no ground plane below the cameras.",
            expected="a plane with a tenth of the points, seen from one side by all cameras",
            found=f"{len(candidates)} points below the cameras",
            remedy="take gravity from the cameras or from accelerometers",
        )
    up, height, inner = _refine_plane(candidates, *normal, _NEAR * reach)
    ground = candidates[inner]
    along = np.argsort(ground @ np.linalg.svd(ground - ground.mean(0), full_matrices=False)[2][0])
    tilts = []
    for block in np.array_split(along, _BLOCKS):
        part = np.delete(ground, block, axis=0)
        tilt = np.linalg.eigh(np.cov(part.T))[1][:, 0]
        tilts.append(tilt * np.sign(tilt @ up) - up)
    sd = float(np.sqrt((_BLOCKS - 1) / _BLOCKS * (np.array(tilts) ** 2).sum()))
    how = f"ground plane of {inner.sum()} of {len(candidates)} points of the cloud"
    notes: tuple[str, ...] = ()
    if not guess.sure and up @ -keys.rotation[:, 1].mean(axis=0) < _TILTED:
        notes = (
            "The ground plane faces the cameras: right for cameras that look down, wrong for a wall before "
            "cameras that look level.",
        )
    return Up(up, how, sd, float(height + middle @ up), notes=notes)


def _ransac_plane(
    points: np.ndarray, centres: np.ndarray, guess: Up, near: float, rng: np.random.Generator
) -> tuple[np.ndarray, float] | None:
    """Normal and height of the plane with most points, or None when it has less than a tenth of them."""
    if len(points) < 10:
        return None
    sample = points[rng.integers(0, len(points), (1000, 3))]
    normal = np.cross(sample[:, 1] - sample[:, 0], sample[:, 2] - sample[:, 0])
    size = np.linalg.norm(normal, axis=1)
    ok = size > 1e-9 * float((points**2).sum(1).mean())
    normal, start = normal[ok] / size[ok, None], sample[ok, 0]
    height = (normal * start).sum(1)
    above = (centres @ normal.T > height).mean(axis=0)
    flip = np.where(above < 0.5, -1.0, 1.0)
    normal, height, above = normal * flip[:, None], height * flip, np.maximum(above, 1 - above)
    allowed = above > 0.95
    if guess.sure:
        allowed &= normal @ guess.direction > _TILTED
    normal, height = normal[allowed], height[allowed]
    if not len(height):
        return None
    some = points[:: max(1, len(points) // 4000)]
    count = (np.abs(some @ normal.T - height) < near).sum(axis=0)
    best = int(np.argmax(count))
    return (normal[best], float(height[best])) if count[best] > 0.1 * len(some) else None


def _refine_plane(
    points: np.ndarray, normal: np.ndarray, height: float, near: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """Normal, height and points (mask) of the plane by weighted total least squares."""
    scale = near / 2
    for i in range(60):
        residual = points @ normal - height
        if i < 20:
            inside = np.abs(residual[np.abs(residual) < 2 * near])
            scale = min(near / 2, max(1.4826 * float(np.median(inside)), 1e-9 * near))
        weight = np.where(np.abs(residual) < TUKEY * scale, (1 - (residual / (TUKEY * scale)) ** 2) ** 2, 0.0)
        centre = np.average(points, axis=0, weights=weight)
        shifted = (points - centre) * np.sqrt(weight)[:, None]
        new = np.linalg.eigh(shifted.T @ shifted)[1][:, 0]
        normal = new * np.sign(new @ normal)
        height = float(centre @ normal)
    return normal, height, np.abs(points @ normal - height) < TUKEY * scale
