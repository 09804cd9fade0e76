"""Calibrated cameras: projection, its Jacobian, undistortion and back-projection, in batches.

Conventions: OpenCV camera frame (x right, y down, z forward), pixel centres at integers,
``x_camera = rotation @ x_world + translation``; the centre is ``-rotation.T @ translation``.
Shapes: N frames, C cameras, M markers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from acino_fte import camera_field
from acino_fte.errors import InputError
from acino_fte.projection import CLOSED, COEFFICIENTS, INTRINSICS

_COUNTS = {model: (len(names),) for model, names in COEFFICIENTS.items()} | {"pinhole": (0, 4, 5, 8, 12)}


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated camera, fixed or moving.

    Parameters
    ----------
    name : str
    model : str
        ``"pinhole"``, ``"fisheye"``, or another of :data:`acino_fte.projection.COEFFICIENTS`.
    matrix : (3, 3)
        Camera matrix, px; no skew. Of a panorama (``equirectangular``): px/rad.
    distortion : (K,)
        Coefficients in the order of :data:`acino_fte.projection.COEFFICIENTS`, OpenCV's: all of them, but
        0, 4, 5, 8 or 12 for pinhole.
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

    @cached_property
    def centre(self) -> np.ndarray:
        """Position of the camera in the world, (3,) or (N, 3), m."""
        centre = -np.einsum("...ji,...j->...i", self.rotation, self.translation)
        centre.setflags(write=False)
        return centre

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
        """Pixels (…, 2) of world points (…, 3); NaN where it cannot see: behind it, for most models."""
        local = self.to_camera(np.asarray(points, dtype=float))
        return np.moveaxis(self._run("project", local, 2), 0, -1)

    def project_with_jacobian(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (…, 2) and their derivative for the world point (…, 2, 3), px/m."""
        local = self.to_camera(np.asarray(points, dtype=float))
        out = self._run("jacobian", local, 8)
        slope = out[2:].reshape(2, 3, *local.shape[:-1])
        if self.rotation.ndim == 3:
            turn = np.ascontiguousarray(self.rotation.transpose(1, 2, 0))[
                ..., None
            ]  # vectors over the frames
            world = np.empty_like(slope)
            for i in range(2):
                for k in range(3):
                    world[i, k] = (
                        slope[i, 0] * turn[0, k] + slope[i, 1] * turn[1, k] + slope[i, 2] * turn[2, k]
                    )
        else:
            world = (self.rotation.T @ slope.reshape(2, 3, -1)).reshape(slope.shape)
        return np.moveaxis(out[:2], 0, -1), np.moveaxis(world, (0, 1), (-2, -1))

    def _run(self, program: str, local: np.ndarray, n_out: int) -> np.ndarray:
        """Run a program on camera-frame points (…, 3); those that the camera cannot see give NaN."""
        x, y, z = np.ascontiguousarray(np.moveaxis(local, -1, 0))
        out = camera_field.run(self.model, program, (x, y, z), self.parameters, n_out)
        seen = camera_field.seen(self.model, self.parameters[len(INTRINSICS) :], x, y, z)
        if not seen.all():
            out[:, ~seen] = np.nan
        return out

    @property
    def _field(self) -> camera_field.Field:
        """The valid field of a lens whose inverse is no formula."""
        return camera_field.field(self.model, tuple(self.parameters[len(INTRINSICS) :].tolist()))

    @property
    def valid_angle(self) -> float:
        """Angle from the optical axis up to which the distortion is one-to-one, rad."""
        if self.model in CLOSED:
            return camera_field.closed_angle(self.model, self.parameters[len(INTRINSICS) :])
        return self._field.angle

    def _distorted(self, pixels: np.ndarray) -> np.ndarray:
        """Distorted normalised coordinates (2, K) of pixels (…, 2)."""
        fx, fy, cx, cy = self.parameters[:4]
        u, v = np.asarray(pixels, dtype=float).reshape(-1, 2).T
        return np.stack([(u - cx) / fx, (v - cy) / fy])

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Ideal normalised coordinates (…, 2), X/Z and Y/Z, of pixels (…, 2).

        NaN outside the valid field, and 90° or more from the axis, where only :meth:`directions` reach.
        """
        if self.model in CLOSED:
            x, y, z = np.moveaxis(self.directions(pixels), -1, 0)
            z = np.where(z > 0, z, np.nan)
            return np.stack([x / z, y / z], axis=-1)
        chart = self._field.solve(self._distorted(pixels))
        return camera_field.normalised(self.model, chart).T.reshape(np.shape(pixels))

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (…, 3) in the camera's frame of pixels (…, 2); NaN outside the valid field."""
        if self.model in CLOSED:
            local = camera_field.closed_directions(self.model, self.parameters, self._distorted(pixels))
            return local.T.reshape(*np.shape(pixels)[:-1], 3)
        a, b = np.moveaxis(self.undistort(pixels), -1, 0)
        z = 1.0 / np.sqrt(a**2 + b**2 + 1.0)
        return np.stack([a * z, b * z, z], axis=-1)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions in the world (N, M, 3) of pixels (N, M, 2), from the camera's centre."""
        local = self.directions(pixels)
        if self.rotation.ndim == 3:
            return np.einsum("nji,nmj->nmi", self.rotation, local)
        return local @ self.rotation

    def pixel_difference(self, pixels: np.ndarray, from_pixels: np.ndarray) -> np.ndarray:
        """``pixels − from_pixels`` (…, 2), px; across the seam of a panorama the short way round."""
        difference = np.subtract(pixels, from_pixels)
        if self.model == "equirectangular":
            around = 2.0 * np.pi * self.matrix[0, 0]
            difference[..., 0] -= around * np.round(difference[..., 0] / around)
        return difference

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
        fail("model", " or ".join(map(repr, COEFFICIENTS)), repr(camera.model))
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
    error, determinant = _no_rotation(camera.rotation)
    if error > 1e-3 or determinant < 0:
        fail(
            "rotation",
            "an orthonormal matrix with determinant +1 (world to camera)",
            f"|R·Rᵀ − 1| = {error:.2g}, determinant {determinant:+.3f}",
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
    values = dict(zip(COEFFICIENTS[camera.model], camera.distortion.tolist(), strict=False))
    if camera.model == "fov" and not abs(values["omega"]) < np.pi:
        fail("distortion", "ω of a fov camera between −π and π, rad", f"{values['omega']:g}")
    if camera.model == "eucm" and not (0 <= values["alpha"] <= 1 and values["beta"] > 0):
        found = f"α = {values['alpha']:g}, β = {values['beta']:g}"
        fail("distortion", "0 ≤ α ≤ 1 and β > 0 of an eucm camera", found)


def _no_rotation(rotation: np.ndarray) -> tuple[float, float]:
    """Largest |R·Rᵀ − 1| and least determinant of rotations (…, 3, 3); of many, by vectors over them all."""
    if rotation.ndim == 2:
        gram = rotation @ rotation.T
        return float(np.max(np.abs(gram - np.eye(3)))), float(np.linalg.det(rotation))
    r = np.ascontiguousarray(np.moveaxis(rotation.reshape(-1, 3, 3), 0, -1))
    if r.shape[-1] == 0:
        return 0.0, 1.0
    error = 0.0
    for i in range(3):
        for j in range(i, 3):
            dot = r[i, 0] * r[j, 0] + r[i, 1] * r[j, 1] + r[i, 2] * r[j, 2]
            error = max(error, float(np.max(np.abs(dot - (i == j)))))
    determinant = (
        r[0, 0] * (r[1, 1] * r[2, 2] - r[1, 2] * r[2, 1])
        + r[0, 1] * (r[1, 2] * r[2, 0] - r[1, 0] * r[2, 2])
        + r[0, 2] * (r[1, 0] * r[2, 1] - r[1, 1] * r[2, 0])
    )
    return error, float(np.min(determinant))


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
