"""A camera whose matrix may have skew: from eleven DLT coefficients or any projection matrix, with the radial
correction of Vicon's cameras; and triangulation as DLT users know it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.epipolar import ideal_pixels
from acino_fte.errors import InputError

_TABLE, _REACH, _NEWTON_STEPS = 512, 4.0, 20
_DEGENERATE = 1e-9


@dataclass(frozen=True, eq=False)
class ViconRadial:
    """The lens of a Vicon camera, ``VICON_RADIAL2`` with the model ``Vicon3Parameter``.

    It takes a measured pixel p to the ideal one, the reverse of OpenCV's models:

        ideal = c + (p − c) (1 + k1 r² + k2 r⁴ + k3 r⁶),  r = |p − c| in px

    We found no formula published by Vicon. The direction is that of avialsync
    (github.com/anzalks/avialsync, its reader of Vicon files), which reports that the positions of the other
    cameras meet their ring lights in the video only this way round. It agrees with optics: wide lenses have
    barrel distortion, and their coefficients are positive in files.

    Parameters
    ----------
    centre : (2,)
        c, px.
    coefficients : (3,)
        k1, k2, k3, px⁻², px⁻⁴, px⁻⁶.
    """

    centre: np.ndarray
    coefficients: np.ndarray

    def __post_init__(self) -> None:
        for key, size in (("centre", 2), ("coefficients", 3)):
            value = np.array(getattr(self, key), dtype=float)
            if value.shape != (size,) or not np.isfinite(value).all():
                raise InputError(
                    f"The radial correction has a wrong {key}.",
                    key=key,
                    expected=f"{size} finite numbers",
                    found=f"{value.tolist()}"[:80],
                    remedy="check the calibration file",
                )
            value.setflags(write=False)
            object.__setattr__(self, key, value)

    @cached_property
    def limit(self) -> float:
        """Measured radius up to which the correction is one-to-one, px; infinite for most lenses."""
        k1, k2, k3 = self.coefficients
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
        real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
        return float(np.sqrt(real.min())) if len(real) else np.inf

    @property
    def ideal_limit(self) -> float:
        """The same as an ideal radius, px."""
        return self.limit * float(self._factor(self.limit**2)) if np.isfinite(self.limit) else np.inf

    def ideal(self, pixels: np.ndarray) -> np.ndarray:
        """Ideal pixels (…, 2) of measured pixels (…, 2); NaN beyond the limit."""
        offset = np.asarray(pixels, dtype=float) - self.centre
        squared = (offset**2).sum(-1, keepdims=True)
        return self.centre + offset * np.where(squared <= self.limit**2, self._factor(squared), np.nan)

    def measured(self, pixels: np.ndarray) -> np.ndarray:
        """Measured pixels (…, 2) of ideal pixels (…, 2), by Newton's method; NaN beyond the limit."""
        offset = np.asarray(pixels, dtype=float) - self.centre
        target = np.linalg.norm(offset, axis=-1)
        known, bent = self._radial_table
        radius = np.interp(target, bent, known)
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                missed = target - radius * self._factor(radius**2)
                if not np.nanmax(np.abs(missed), initial=0.0) > 1e-12 * bent[-1]:
                    break
                radius = radius + missed / self._stretch(radius**2)
            good = np.abs(radius * self._factor(radius**2) - target) < 1e-7
            good &= radius <= self.limit
            ratio = np.where(target > 0, radius / np.where(target > 0, target, 1.0), 1.0)
        return self.centre + offset * np.where(good, ratio, np.nan)[..., None]

    def measured_slope(self, measured: np.ndarray) -> np.ndarray:
        """Derivative of the measured pixel for the ideal one, (…, 2, 2), at measured pixels (…, 2).

        The inverse of p I + 2 p' d dᵀ with d the offset from the centre, p the factor and p' its derivative
        for r²: (I − 2 p' d dᵀ / (p + 2 p' r²)) / p (Sherman and Morrison 1950).
        """
        offset = measured - self.centre
        squared = (offset**2).sum(-1)
        factor, stretch = self._factor(squared), self._stretch(squared)
        with np.errstate(invalid="ignore", divide="ignore"):
            along = np.where(
                squared > 0, (stretch - factor) / np.where(squared > 0, squared, 1.0) / stretch, 0.0
            )
        outer = offset[..., :, None] * offset[..., None, :]
        return (np.eye(2) - along[..., None, None] * outer) / factor[..., None, None]

    def _factor(self, squared):
        k1, k2, k3 = self.coefficients
        return 1 + squared * (k1 + squared * (k2 + squared * k3))

    def _stretch(self, squared):
        """Derivative of the ideal radius for the measured one."""
        k1, k2, k3 = self.coefficients
        return 1 + squared * (3 * k1 + squared * (5 * k2 + squared * 7 * k3))

    @cached_property
    def _radial_table(self) -> tuple[np.ndarray, np.ndarray]:
        """Measured and ideal radius, growing both, as far as an image may reach."""
        radius = np.linspace(
            0.0, min(self.limit, _REACH * max(float(np.linalg.norm(self.centre)), 500.0)), _TABLE
        )
        return radius, radius * self._factor(radius**2)


@dataclass(frozen=True, eq=False)
class ProjectiveCamera(Camera):
    """A pinhole camera whose matrix may have skew, with or without Vicon's radial correction.

    It takes the place of a :class:`~acino_fte.cameras.Camera` wherever cameras are matched or triangulated:
    ``u = (fx x + s y) / z + cx, v = fy y / z + cy`` in the camera's frame, and then the lens.

    Parameters
    ----------
    name : str
    matrix : (3, 3)
        Camera matrix, px; the skew s at [0][1].
    rotation, translation
        World to camera, m, as in ``Camera``.
    resolution : (width, height)
        px.
    radial : ViconRadial, optional

    Raises
    ------
    InputError
        As ``Camera`` does; skew is allowed.
    """

    model: str = field(default="projective", init=False)
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0), init=False)
    radial: ViconRadial | None = None

    def __post_init__(self) -> None:
        """Check everything but the skew, by the checks of a pinhole camera."""
        matrix = np.array(self.matrix, dtype=float)
        plain = matrix.copy()
        if matrix.shape == (3, 3) and np.isfinite(matrix).all():
            plain[0, 1] = 0.0
        checked = Camera(
            self.name, "pinhole", plain, self.distortion, self.rotation, self.translation, self.resolution
        )
        matrix.setflags(write=False)
        for key in ("distortion", "rotation", "translation"):
            object.__setattr__(self, key, getattr(checked, key))
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def from_projection(
        cls, name: str, projection: np.ndarray, resolution: tuple[int, int]
    ) -> ProjectiveCamera:
        """The camera of a projection matrix (3, 4) of any scale: pixels (y down) of world points, m.

        The left 3×3 block is split into camera matrix and rotation by RQ (Hartley & Zisserman 2004, section
        6.2.4). Its sign is taken so that the rotation is proper: then the camera looks along its z when world
        and image are not mirrored against each other.
        """
        from scipy.linalg import rq

        projection = np.asarray(projection, dtype=float)
        if projection.shape != (3, 4) or not np.isfinite(projection).all():
            raise InputError(
                f"Camera '{name}' cannot be used: its projection matrix is wrong.",
                expected="3×4 finite numbers",
                found=f"shape {projection.shape}" if projection.shape != (3, 4) else "NaN or infinity",
                remedy="check the calibration file",
            )
        left = projection[:, :3]
        scale = np.linalg.norm(left[2])
        determinant = float(np.linalg.det(left / np.where(scale > 0, scale, 1.0)))
        if scale == 0 or abs(determinant) < 1e-12 * np.abs(left / scale).max() ** 2:
            raise InputError(
                f"Camera '{name}' cannot be used: its projection matrix has no centre.",
                expected="a left 3×3 block of full rank (a finite camera)",
                found=f"determinant {determinant:.2g}",
                remedy="calibrate with control points that do not lie in a plane",
            )
        upper, rotation = rq(left * np.sign(determinant))
        sign = np.diag(np.sign(np.diag(upper)))
        upper, rotation = upper @ sign, sign @ rotation
        translation = np.linalg.solve(upper, projection[:, 3] * np.sign(determinant))
        return cls(name, upper / upper[2, 2], rotation, translation, resolution)

    @classmethod
    def from_dlt(
        cls,
        name: str,
        coefficients: np.ndarray,
        resolution: tuple[int, int],
        *,
        image_height: float | None = None,
        metres: float = 1.0,
    ) -> ProjectiveCamera:
        """The camera of eleven DLT coefficients.

        ``u = (L1 X + L2 Y + L3 Z + L4) / w, v = (L5 X + L6 Y + L7 Z + L8) / w, w = L9 X + L10 Y + L11 Z + 1``
        (Abdel-Aziz & Karara 1971).

        Parameters
        ----------
        name : str
            Name of the camera.
        coefficients : (11,)
            L1 … L11.
        resolution : (width, height)
            px.
        image_height : float, optional
            Height of the image, px, when the coefficients have y up from the bottom, as those of DLTdv,
            easyWand and Argus do (Hedrick 2008): the camera gets ``v = image_height − v_up``. None: y is
            down already.
        metres : float
            Length of the unit of the coefficients' world, m.
        """
        projection = dlt_projection(coefficients)
        if image_height is not None:
            projection = np.array([[1, 0, 0], [0, -1, image_height], [0, 0, 1.0]]) @ projection
        projection[:, :3] /= metres
        return cls.from_projection(name, projection, resolution)

    @cached_property
    def parameters(self) -> np.ndarray:
        """fx, fy, cx, cy, skew, and with a radial correction its centre and coefficients."""
        k = self.matrix
        radial = () if self.radial is None else (*self.radial.centre, *self.radial.coefficients)
        return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], k[0, 1], *radial])

    @property
    def valid_angle(self) -> float:
        """Angle from the optical axis up to which the lens is one-to-one, rad."""
        if self.radial is None or not np.isfinite(self.radial.limit):
            return float(np.radians(89.9))
        return float(np.arctan(self.radial.ideal_limit / self.matrix[0, 0]))

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Ideal normalised coordinates (…, 2) of pixels (…, 2); NaN outside the valid field."""
        ideal = np.asarray(pixels, dtype=float) if self.radial is None else self.radial.ideal(pixels)
        fx, fy, cx, cy, skew = self.parameters[:5]
        b = (ideal[..., 1] - cy) / fy
        a = (ideal[..., 0] - cx - skew * b) / fx
        return np.stack([a + 0 * b, b + 0 * a], axis=-1)  # half a pixel is none

    def _run(self, program: str, local: np.ndarray, n_out: int) -> np.ndarray:
        """Pixels, and for "jacobian" their slopes, of camera-frame points (…, 3); NaN for z ≤ 0."""
        z = np.where(local[..., 2] > 0, local[..., 2], np.nan)
        normalised = local[..., :2] / z[..., None]
        linear = self.matrix[:2, :2]
        pixels = normalised @ linear.T + self.matrix[:2, 2]
        if self.radial is not None:
            pixels = self.radial.measured(pixels)
        out = np.empty((n_out, *z.shape))
        out[:2] = np.moveaxis(pixels, -1, 0)
        if program == "jacobian":
            lens = np.eye(2) if self.radial is None else self.radial.measured_slope(pixels)
            perspective = np.zeros((*z.shape, 2, 3))
            perspective[..., :2] = np.eye(2)
            perspective[..., 2] = -normalised
            slope = lens @ linear @ (perspective / z[..., None, None])
            out[2:] = np.moveaxis(slope, (-2, -1), (0, 1)).reshape(6, *z.shape)
        return out


def dlt_projection(coefficients: np.ndarray) -> np.ndarray:
    """Projection matrix (3, 4) of DLT coefficients (11,), with L12 = 1."""
    return np.append(np.asarray(coefficients, dtype=float), 1.0).reshape(3, 4)


def projection_matrix(camera: Camera) -> np.ndarray:
    """K [R | t] of a camera, (3, 4) or (N, 3, 4): ideal homogeneous pixels of world points, m."""
    shape = np.broadcast_shapes(camera.rotation.shape[:-2], camera.translation.shape[:-1])
    pose = np.empty((*shape, 3, 4))
    pose[..., :3], pose[..., 3] = camera.rotation, camera.translation
    return camera.matrix @ pose


def triangulate_dlt(views: Sequence[Camera] | np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Triangulate as DLTdv does: linear least squares in the world coordinates.

    Every view gives the rows ``(u L9 − L1, u L10 − L2, u L11 − L3) X = L4 − u`` and the like for v; all are
    solved together, unweighted, with L12 = 1 (Abdel-Aziz & Karara 1971; Hedrick 2008). It repeats what DLT
    users have to the last digits; :func:`acino_fte.triangulate.triangulate` is robust and least in pixels.

    Parameters
    ----------
    views : cameras, or projection matrices (…, C, 3, 4)
        With cameras, pixels are made ideal first. Matrices with a frame (or another) dimension in front
        broadcast against those of the pixels.
    pixels : (…, C, 2)
        Measured pixels of the views; NaN where missing.

    Returns
    -------
    (…, 3)
        World, m; NaN with fewer than two views, or when the rays do not fix a point.
    """
    pixels = np.asarray(pixels, dtype=float)
    if isinstance(views, np.ndarray):
        projection = views
    else:
        pixels = np.stack(
            [ideal_pixels(camera, pixels[..., c, :]) for c, camera in enumerate(views)], axis=-2
        )
        matrices = [projection_matrix(camera) for camera in views]
        shape = np.broadcast_shapes(*(m.shape for m in matrices))
        projection = np.stack([np.broadcast_to(m, shape) for m in matrices], axis=-3)
    last = projection[..., 2:, 3:]
    size = np.linalg.norm(projection[..., 2:, :], axis=-1, keepdims=True)
    projection = projection / np.where(np.abs(last) > _DEGENERATE * size, last, size)
    rows = pixels[..., None] * projection[..., 2:, :] - projection[..., :2, :]  # (…, C, 2, 4)
    seen = np.isfinite(pixels).all(-1)
    rows = np.where(seen[..., None, None], rows, 0.0)
    rows = rows.reshape(*rows.shape[:-3], -1, 4)
    u, s, vt = np.linalg.svd(rows[..., :3], full_matrices=False)
    fixed = (seen.sum(-1) >= 2) & (s[..., 2] > _DEGENERATE * s[..., 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = -(np.swapaxes(u, -1, -2) @ rows[..., 3:])[..., 0] / s
        points = (np.swapaxes(vt, -1, -2) @ weight[..., None])[..., 0]
    return np.where(fixed[..., None], points, np.nan)
