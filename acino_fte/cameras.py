"""Calibrated cameras: projection, its Jacobian, undistortion and back-projection, in batches.

Conventions: OpenCV camera frame (x right, y down, z forward), pixel centres at integers,
``x_camera = rotation @ x_world + translation``; the centre is ``-rotation.T @ translation``.
Shapes: N frames, C cameras, M markers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from acino_fte.errors import InputError
from acino_fte.projection import COEFFICIENTS, programs

_GRID = 2000
_NEWTON_STEPS = 12
_COUNTS = {"pinhole": (0, 4, 5, 8, 12), "fisheye": (4,)}


@cache
def _compiled(model: str) -> dict[str, Callable[..., None]]:
    return {name: program.numpy_function for name, program in programs(model).items()}


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated camera, fixed or moving.

    Parameters
    ----------
    name : str
    model : str
        ``"pinhole"`` or ``"fisheye"``.
    matrix : (3, 3)
        Camera matrix, px; no skew.
    distortion : (0 | 4 | 5 | 8 | 12,) or (4,) for fisheye
        OpenCV's coefficients in OpenCV's order.
    rotation : (3, 3) or (N, 3, 3)
        World to camera, one for all frames or one a frame.
    translation : (3,) or (N, 3)
        World to camera, m.
    resolution : (width, height)
        px.

    Raises
    ------
    InputError
        A shape is wrong, a number is not finite, the rotation is no rotation, or there is skew.
    """

    name: str
    model: str
    matrix: np.ndarray
    distortion: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    resolution: tuple[int, int]

    def __post_init__(self) -> None:
        for key in ("matrix", "distortion", "rotation", "translation"):
            value = np.array(getattr(self, key), dtype=float)
            if key == "distortion":
                value = value.ravel()
            elif key == "translation" and value.shape[-1:] == (1,):
                value = value[..., 0]
            value.setflags(write=False)
            object.__setattr__(self, key, value)
        _check_camera(self)

    @property
    def moves(self) -> bool:
        """Whether the camera has a pose per frame."""
        return self.rotation.ndim == 3 or self.translation.ndim == 2

    @cached_property
    def parameters(self) -> np.ndarray:
        """fx, fy, cx, cy and the coefficients, as the programs of :mod:`projection` take them."""
        k = self.matrix
        padded = np.zeros(len(COEFFICIENTS[self.model]))
        padded[: len(self.distortion)] = self.distortion
        return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *padded])

    @property
    def centre(self) -> np.ndarray:
        """Position of the camera in the world, (3,) or (N, 3), m."""
        return -np.einsum("...ji,...j->...i", self.rotation, self.translation)

    def at_frames(self, frames: slice | np.ndarray) -> Camera:
        """The camera for a range of frames; a fixed camera is returned as it is."""
        if not self.moves:
            return self
        return replace(
            self,
            rotation=self.rotation[frames] if self.rotation.ndim == 3 else self.rotation,
            translation=self.translation[frames] if self.translation.ndim == 2 else self.translation,
        )

    def displaced(self, turn: np.ndarray, shift: np.ndarray) -> Camera:
        """The camera after a correction in its own frame: x_camera = T (R x + t) + d.

        ``turn`` (3, 3) is the rotation T, ``shift`` (3,) is d, m.
        """
        return replace(self, rotation=turn @ self.rotation, translation=self.translation @ turn.T + shift)

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """World points (N, M, 3) in the camera's frame; for a fixed camera any leading shape will do."""
        if not self.moves:
            return points @ self.rotation.T + self.translation
        rotation = np.broadcast_to(self.rotation, (len(points), 3, 3))
        translation = np.broadcast_to(self.translation, (len(points), 3))
        return np.einsum("nij,nmj->nmi", rotation, points) + translation[:, None]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (…, 2) of world points (…, 3); NaN behind the camera."""
        local = self.to_camera(np.asarray(points, dtype=float))
        return np.moveaxis(self._run("project", local, 2), 0, -1)

    def project_with_jacobian(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (…, 2) and their derivative for the world point (…, 2, 3), px/m."""
        local = self.to_camera(np.asarray(points, dtype=float))
        out = self._run("jacobian", local, 8)
        pixels = np.moveaxis(out[:2], 0, -1)
        slope = np.moveaxis(out[2:].reshape(2, 3, *local.shape[:-1]), (0, 1), (-2, -1))
        rotation = self.rotation[:, None] if self.rotation.ndim == 3 else self.rotation
        return pixels, slope @ rotation

    def _run(self, program: str, local: np.ndarray, n_out: int) -> np.ndarray:
        """Run a program on camera-frame points; points with z ≤ 0 give NaN."""
        x, y, z = np.moveaxis(local, -1, 0)
        z = np.where(z > 0, z, np.nan)
        out = np.empty((n_out, *z.shape))
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            _compiled(self.model)[program]([x, y, z, *self.parameters], out)
        out[:, np.isnan(z)] = np.nan  # results that do not depend on z
        return out

    @cached_property
    def _radial_table(self) -> tuple[np.ndarray, np.ndarray]:
        """Angle from the axis against distorted radius, as far as the radius grows (the valid field)."""
        angle = np.linspace(0.0, np.radians(89.9), _GRID)
        if self.model == "fisheye":
            bent = angle * np.polyval([*self.distortion[::-1], 1.0], angle**2)
        else:
            k = self.parameters[4:]
            r = np.tan(angle)
            with np.errstate(divide="ignore"):
                bent = r * np.polyval([k[4], k[1], k[0], 1], r**2) / np.polyval([k[7], k[6], k[5], 1], r**2)
        folds = np.flatnonzero(~(np.diff(bent) > 0))
        end = folds[0] + 1 if len(folds) else _GRID
        return angle[:end], bent[:end]

    @property
    def valid_angle(self) -> float:
        """Angle from the optical axis up to which the distortion is one-to-one, rad."""
        return float(self._radial_table[0][-1])

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Ideal normalised coordinates (…, 2) of pixels (…, 2); NaN outside the valid field.

        Solves ``distort(a, b) = pixel`` by Newton's method from an inverted radial table.
        """
        fx, fy, cx, cy = self.parameters[:4]
        pixels = np.asarray(pixels, dtype=float)
        target = np.stack([(pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy])
        angle_of, bent = self._radial_table
        radius = np.hypot(target[0], target[1])
        target = np.where(radius < 1.2 * bent[-1], target, np.nan)  # hopelessly far outside
        angle = np.interp(radius, bent, angle_of)
        guess = target * np.tan(angle) / np.where(radius > 0, radius, 1.0)
        distort = _compiled(self.model)["distort"]
        out = np.empty((6, *radius.shape))
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                distort([guess[0], guess[1], *self.parameters], out)
                e0, e1 = target[0] - out[0], target[1] - out[1]
                if not np.nanmax(np.abs(e0) + np.abs(e1), initial=0.0) > 1e-13:
                    break
                determinant = out[2] * out[5] - out[3] * out[4]
                guess = guess + np.stack([out[5] * e0 - out[3] * e1, out[2] * e1 - out[4] * e0]) / determinant
            distort([guess[0], guess[1], *self.parameters], out)
            missed = np.hypot(out[0] - target[0], out[1] - target[1]) * fx
            outside = np.arctan(np.hypot(guess[0], guess[1])) > self.valid_angle + 1e-9
        return np.moveaxis(np.where((missed < 1e-7) & ~outside, guess, np.nan), 0, -1)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions in the world (N, M, 3) of pixels (N, M, 2), from the camera's centre."""
        normalised = self.undistort(pixels)
        local = np.concatenate([normalised, np.ones((*normalised.shape[:-1], 1))], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        if self.rotation.ndim == 3:
            return np.einsum("nji,nmj->nmi", self.rotation, local)
        return local @ self.rotation

    def back_project(self, pixels: np.ndarray, depth: np.ndarray | float) -> np.ndarray:
        """World points (N, M, 3) at a depth (z in the camera's frame, m) behind pixels (N, M, 2)."""
        normalised = self.undistort(pixels)
        depth = np.broadcast_to(depth, normalised.shape[:-1])[..., None]
        local = np.concatenate([normalised * depth, depth], axis=-1)
        if not self.moves:
            return (local - self.translation) @ self.rotation
        rotation = np.broadcast_to(self.rotation, (len(local), 3, 3))
        translation = np.broadcast_to(self.translation, (len(local), 3))
        return np.einsum("nji,nmj->nmi", rotation, local - translation[:, None])

    def inside(self, pixels: np.ndarray) -> np.ndarray:
        """Whether pixels (…, 2) lie in the image; False for NaN."""
        width, height = self.resolution
        u, v = pixels[..., 0], pixels[..., 1]
        return (u >= -0.5) & (v >= -0.5) & (u <= width - 0.5) & (v <= height - 0.5)


def _check_camera(camera: Camera) -> None:
    """Raise InputError when the numbers cannot be those of a camera."""

    def fail(key: str, expected: str, found: str, remedy: str | None = None) -> None:
        raise InputError(
            f"Camera '{camera.name}' cannot be used: its {key} is wrong.",
            key=key,
            expected=expected,
            found=found,
            remedy=remedy or "check the calibration file",
        )

    if camera.model not in COEFFICIENTS:
        fail("model", "'pinhole' or 'fisheye'", repr(camera.model))
    if camera.matrix.shape != (3, 3):
        fail("camera matrix", "shape (3, 3)", f"shape {camera.matrix.shape}")
    if camera.distortion.size not in _COUNTS[camera.model]:
        counts = ", ".join(map(str, _COUNTS[camera.model]))
        fail("distortion", f"{counts} coefficients for a {camera.model} camera", str(camera.distortion.size))
    if camera.rotation.shape[-2:] != (3, 3) or camera.rotation.ndim > 3:
        fail("rotation", "shape (3, 3), or (frames, 3, 3)", f"shape {camera.rotation.shape}")
    if camera.translation.shape[-1:] != (3,) or camera.translation.ndim > 2:
        fail("translation", "shape (3,), or (frames, 3)", f"shape {camera.translation.shape}")
    if camera.moves and camera.rotation.ndim == 3 and camera.translation.ndim == 2:
        n_rotations, n_translations = len(camera.rotation), len(camera.translation)
        if n_rotations != n_translations:
            fail("pose", "as many rotations as translations", f"{n_rotations} and {n_translations}")
    for key in ("matrix", "distortion", "rotation", "translation"):
        if not np.all(np.isfinite(getattr(camera, key))):
            fail(key, "finite numbers", "NaN or infinity")
    gram = camera.rotation @ np.swapaxes(camera.rotation, -1, -2)
    error = float(np.max(np.abs(gram - np.eye(3))))
    if error > 1e-3 or np.any(np.linalg.det(camera.rotation) < 0):
        fail(
            "rotation",
            "an orthonormal matrix with determinant +1 (world to camera)",
            f"|R·Rᵀ − 1| = {error:.2g}, determinant {np.min(np.linalg.det(camera.rotation)):+.3f}",
            "the file may hold a rotation vector, a transposed 4×4 matrix, or a mirrored frame",
        )
    k = camera.matrix
    if not (k[0, 0] > 0 and k[1, 1] > 0):
        fail("camera matrix", "positive focal lengths at [0][0] and [1][1]", f"{k[0, 0]:g} and {k[1, 1]:g}")
    if k[1, 0] != 0 or not np.array_equal(k[2], [0, 0, 1]):
        found = "; ".join(" ".join(f"{v:g}" for v in row) for row in k[1:])
        fail(
            "camera matrix",
            "0 at [1][0] and [0, 0, 1] as its last row",
            f"last rows {found}",
            "the matrix may be transposed or scaled",
        )
    if abs(k[0, 1]) > 1e-6 * k[0, 0]:
        fail("camera matrix", "no skew: [0][1] is 0", f"{k[0, 1]:g}", "calibrate without skew")


@dataclass(frozen=True, eq=False)
class CameraArray(Sequence[Camera]):
    """The cameras of one recording, in one order, found by name."""

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        names = self.names
        if len(set(names)) != len(names):
            raise InputError(
                "Two cameras have one name.", found=", ".join(names), remedy="rename one of them"
            )

    @property
    def names(self) -> list[str]:
        """Names of the cameras."""
        return [camera.name for camera in self.cameras]

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __getitem__(self, key):
        """A camera by index or by name."""
        if isinstance(key, str):
            return self.cameras[self.names.index(key)]
        return self.cameras[key]

    def at_frames(self, frames: slice) -> CameraArray:
        """The cameras for a range of frames."""
        return CameraArray(tuple(camera.at_frames(frames) for camera in self))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, C, M, 2) of world points (N, M, 3); NaN behind a camera."""
        return np.stack([camera.project(points) for camera in self], axis=1)

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Normalised coordinates (N, C, M, 2) of pixels (N, C, M, 2)."""
        return np.stack([camera.undistort(pixels[:, c]) for c, camera in enumerate(self)], axis=1)

    def poses(self, n_frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (N, C, 3, 3) and translations (N, C, 3), world to camera, for every frame (a view)."""
        rotation = [np.broadcast_to(camera.rotation, (n_frames, 3, 3)) for camera in self]
        translation = [np.broadcast_to(camera.translation, (n_frames, 3)) for camera in self]
        return np.stack(rotation, axis=1), np.stack(translation, axis=1)
