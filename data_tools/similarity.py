"""Similarities between worlds, x' = scale · rotation @ x + translation: points, cameras, covariances."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from acino_fte.errors import InputError


@dataclass(frozen=True, eq=False)
class Similarity:
    """A proper similarity from one world to another; never a mirror.

    Parameters
    ----------
    scale : float
        Above 0.
    rotation : (3, 3)
        Proper (determinant +1).
    translation : (3,)
        In units of the target.

    Raises
    ------
    InputError
        The scale is not positive, a number is not finite, or the rotation is not proper.
    """

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=float)
        translation = np.array(self.translation, dtype=float)
        finite = np.isfinite(rotation).all() and np.isfinite(translation).all()
        if not (finite and np.isfinite(self.scale) and self.scale > 0):
            raise InputError("The similarity is impossible.", expected="finite numbers, a scale above 0")
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if error > 1e-9 or np.linalg.det(rotation) < 0:
            raise InputError(
                "The similarity would bend or mirror the world.",
                expected="an orthonormal matrix with determinant +1",
                found=f"|R·Rᵀ − 1| = {error:.2g}, determinant {np.linalg.det(rotation):+.3f}",
            )
        for key, value in (("rotation", rotation), ("translation", translation)):
            value.setflags(write=False)
            object.__setattr__(self, key, value)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (…, 3) in the target world."""
        return self.scale * (np.asarray(points, dtype=float) @ self.rotation.T) + self.translation

    def covariance(self, covariance: np.ndarray) -> np.ndarray:
        """Covariances (…, 3, 3) of points in the target world."""
        return self.scale**2 * (self.rotation @ covariance @ self.rotation.T)

    def poses(self, rotation: np.ndarray, translation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses (…, 3, 3), (…, 3), world to camera, of the same cameras in the target world.

        The camera's own frame is scaled with the world: x_camera' = scale · x_camera.
        """
        turned = rotation @ self.rotation.T
        return turned, self.scale * translation - turned @ self.translation

    def pose_covariance(self, covariance: np.ndarray) -> np.ndarray:
        """Covariances (…, 6, 6) of poses: turn (camera frame, rad), shift of the centre (world)."""
        change = np.eye(6)
        change[3:, 3:] = self.scale * self.rotation
        return change @ covariance @ change.T

    def inverse(self) -> Similarity:
        """The way back."""
        return Similarity(
            1.0 / self.scale, self.rotation.T, -(self.rotation.T @ self.translation) / self.scale
        )

    def __matmul__(self, first: Similarity) -> Similarity:
        """This after `first`."""
        return Similarity(
            self.scale * first.scale, self.rotation @ first.rotation, self.points(first.translation)
        )


def align_similarity(source: np.ndarray, target: np.ndarray, with_scale: bool = True) -> Similarity:
    """The similarity of least squares that takes points to points: Umeyama (1991), never a mirror.

    Parameters
    ----------
    source, target : (N, 3)
        The same points in both worlds; rows with NaN in either are left out.
    with_scale : bool
        Whether the scale is free; else it is 1.

    Raises
    ------
    InputError
        Fewer than three points, or all of them on one line: the rotation is not determined.
    """
    source, target = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    if source.shape != target.shape or source.shape[1:] != (3,):
        raise InputError(
            "The points to be aligned do not belong together.",
            expected="two arrays of shape (N, 3)",
            found=f"{source.shape} and {target.shape}",
        )
    both = np.isfinite(source).all(1) & np.isfinite(target).all(1)
    source, target = source[both], target[both]
    if len(source) < 3:
        raise InputError("An alignment needs points.", expected="three or more", found=f"{len(source)}")
    middle, goal = source.mean(axis=0), target.mean(axis=0)
    left, value, right = np.linalg.svd((target - goal).T @ (source - middle) / len(source))
    if not value[1] > 1e-12 * value[0]:
        raise InputError("The points lie on one line: the rotation about it is not determined.")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = (left * sign) @ right
    scale = float((value * sign).sum() / ((source - middle) ** 2).sum(1).mean()) if with_scale else 1.0
    return Similarity(scale, rotation, goal - scale * rotation @ middle)
