"""Which plane through two camera centres a dot lies in: one number a dot that both cameras agree on.

All planes that hold the baseline of two cameras form a pencil; a point in space lies on one half plane of it,
and both cameras see it there, whatever their lenses (Pollefeys, Koch and Van Gool 1999, *A simple and
efficient rectification method for general motion*, use the same angle to rectify images). With a ray d (unit,
world) and an orthonormal frame (e, e1, e2) whose e runs along the baseline,

    θ = atan2(d·e2, d·e1),        ∂θ/∂d = (e2 (d·e1) − e1 (d·e2)) / ((d·e1)² + (d·e2)²)

and the distance of two dots, θ_a − θ_b over the root of the sum of their squared slopes g = |∂θ/∂pixel|, is
to first order the Sampson distance in pixels of the raw images: its standard deviation is that of the pixels,
near an epipole and in a fisheye too. So a pair of cameras needs two numbers a dot, not a matrix product a
pair of dots, and the dots near a plane are found by sorting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.cameras import Camera, CameraArray

_LEAST_BASELINE = 1e-9  # of the coordinates (georeferenced ones are large), or 1 nm
_NEAR_EPIPOLE = 20.0  # times the median slope: there an angle says next to nothing


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of P dots of one camera.

    Attributes
    ----------
    direction : (P, 3)
        Unit, world; NaN where the lens cannot have seen the dot.
    slope : (P, 3, 2)
        Change of the direction with the pixel, 1/px.
    """

    direction: np.ndarray
    slope: np.ndarray


def rays_of(camera: Camera, frame: np.ndarray, xy: np.ndarray) -> Rays:
    """Rays of dots.

    Parameters
    ----------
    camera : Camera
        Fixed or moving.
    frame : (P,) int
        Row of the camera's poses; not looked at when the camera does not move.
    xy : (P, 2)
        Pixels.
    """
    if camera.moves:
        posed = camera.at_frames(frame)
        direction = posed.rays(xy[:, None])[:, 0]
        _, jacobian = posed.project_with_jacobian((posed.centre + direction)[:, None])
        jacobian = jacobian[:, 0]
    else:
        direction = camera.rays(xy)
        _, jacobian = camera.project_with_jacobian(camera.centre + direction)
    gram = jacobian @ jacobian.swapaxes(1, 2)
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    adjugate = np.empty_like(gram)
    adjugate[:, 0, 0], adjugate[:, 1, 1] = gram[:, 1, 1], gram[:, 0, 0]
    adjugate[:, 0, 1] = adjugate[:, 1, 0] = -gram[:, 0, 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = jacobian.swapaxes(1, 2) @ adjugate / determinant[:, None, None]
    return Rays(direction, slope)


@dataclass(frozen=True, eq=False)
class PlaneAngles:
    """Where the P dots of one camera lie in the pencil of planes of a pair.

    Attributes
    ----------
    angle : (P,)
        θ, rad, in (−π, π]; NaN for a dot without a ray or beside the epipole.
    slope : (P,)
        g = |∂θ/∂pixel|, rad/px.
    along : (P,)
        Angle of the ray from the baseline (from camera a to camera b), rad. The rays of two dots meet in
        front of both cameras when it is larger at b than at a.
    """

    angle: np.ndarray
    slope: np.ndarray
    along: np.ndarray


def plane_angles(
    cameras: CameraArray, a: int, b: int, frames: tuple[np.ndarray, np.ndarray], rays: tuple[Rays, Rays]
) -> tuple[PlaneAngles, PlaneAngles] | None:
    """Plane angles of the dots of cameras a and b; None when the two centres are one.

    Parameters
    ----------
    cameras : CameraArray
        Of the recording.
    a, b : int
        Which two.
    frames : pair of (P,) int
        Rows of the poses, for the dots of a and of b.
    rays : pair of Rays
        Of the same dots.
    """
    basis = _basis(cameras[a], cameras[b])
    if basis is None:
        return None
    return _angles(basis, frames[0], rays[0]), _angles(basis, frames[1], rays[1])


def _basis(a: Camera, b: Camera) -> np.ndarray | None:
    """(N or 1, 3, 3): rows e (baseline), e1 (where the cameras look), e2; NaN where the centres are one."""
    base = np.atleast_2d(b.centre - a.centre)
    length = np.linalg.norm(base, axis=1, keepdims=True)
    scale = _LEAST_BASELINE * max(float(np.abs(a.centre).max()), 1.0)
    if not (length > scale).any():
        return None
    e = base / np.where(length > scale, length, np.nan)
    gaze = np.atleast_2d(a.rotation[..., 2, :] + b.rotation[..., 2, :])
    tilted = gaze - e * (gaze * e).sum(1, keepdims=True)
    size = np.linalg.norm(tilted, axis=1, keepdims=True)
    other = np.eye(3)[
        np.argmin(np.abs(e), axis=1)
    ]  # the cameras look along the baseline: any direction will do
    other = other - e * (other * e).sum(1, keepdims=True)
    e1 = np.where(size > 1e-3, tilted, other)
    e1 = e1 / np.linalg.norm(e1, axis=1, keepdims=True)
    return np.stack(np.broadcast_arrays(e, e1, np.cross(e, e1)), axis=1)


def _angles(basis: np.ndarray, frame: np.ndarray, rays: Rays) -> PlaneAngles:
    if len(basis) == 1:
        local = rays.direction @ basis[0].T
        e1, e2 = basis[0, 1], basis[0, 2]
    else:
        chosen = basis[frame]
        local = np.einsum("pij,pj->pi", chosen, rays.direction)
        e1, e2 = chosen[:, 1], chosen[:, 2]
    x, y = local[:, 1], local[:, 2]
    square = x**2 + y**2
    with np.errstate(invalid="ignore", divide="ignore"):
        change = (e2 * x[:, None] - e1 * y[:, None]) / square[:, None]
        slope = np.sqrt((np.einsum("pi,pij->pj", change, rays.slope) ** 2).sum(1))
        angle = np.arctan2(y, x)
        known = np.isfinite(slope) & np.isfinite(angle)
        typical = np.median(slope[known]) if known.any() else 1.0
        known &= slope < _NEAR_EPIPOLE * typical
    return PlaneAngles(np.where(known, angle, np.nan), slope, np.arccos(np.clip(local[:, 0], -1.0, 1.0)))
