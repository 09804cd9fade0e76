"""Cameras of which the pose is known in some frames, as structure from motion gives them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.similarity import Similarity


@dataclass(frozen=True, eq=False)
class KeyedCamera:
    """A camera of the recording and its key frames.

    Attributes
    ----------
    name : str
        What joins it with its tracks.
    lens : Camera
        Its model; the pose in it means nothing.
    model_id : int
        Camera of the structure-from-motion model; several cameras may share one.
    frame : (K,) int
        Key frames, rising, each once, on the camera's own clock.
    rotation : (K, 3, 3)
        World to camera.
    translation : (K, 3)
        World to camera, in units of the world.
    covariance : (K, 6, 6), optional
        Of each pose: turn (rad, in the camera's frame: R_true = exp(turn×) R), shift of the centre (world).
    """

    name: str
    lens: Camera
    model_id: int
    frame: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    covariance: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not len(self.frame) or (np.diff(self.frame) <= 0).any():
            raise InputError(
                f"The key frames of camera '{self.name}' are wrong.",
                expected="one at least, rising, each once",
                found=f"{len(self.frame)} frames",
            )

    @property
    def centre(self) -> np.ndarray:
        """Position of the camera in its key frames, (K, 3)."""
        return -np.einsum("kji,kj->ki", self.rotation, self.translation)

    def moved(self, change: Similarity) -> KeyedCamera:
        """The same camera in another world."""
        rotation, translation = change.poses(self.rotation, self.translation)
        covariance = None if self.covariance is None else change.pose_covariance(self.covariance)
        return replace(self, rotation=rotation, translation=translation, covariance=covariance)
