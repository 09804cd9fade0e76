"""How a camera moved, frame by frame, whatever told it: inertial sensor, pictures, encoders. N frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.rotations import rotation_matrix, rotation_vector
from acino_fte.errors import InputError

Anchor = Literal["motion", "camera"]


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Poses of one camera in the frames of a recording.

    Attributes
    ----------
    frames : (N,) int
        Consecutive.
    rotation : (N, 3, 3)
        World to camera; finite in every frame: where it is not known, a bridge between the known ones.
    centre : (N, 3)
        Position of the camera in the world, from where it was at first: m when the scale is known, else in
        units of the first step. Zeros where only the rotation is known.
    known : (N,) bool
        False where the pose is a bridge or a guess.
    scale_known : bool
        Whether `centre` is in m; true of a camera that turns about its own centre.
    rotation_sd : (N,)
        Standard deviation of the attitude about an axis, rad; NaN where it is not known.
    route : str
        What told the motion.
    levelled : bool
        Whether the world's z points up; else the world is the camera's first frame that is known.
    notes : tuple of str
        What the user should know.
    numbers : dict
        What else the route found, ready for JSON.
    """

    frames: np.ndarray
    rotation: np.ndarray
    centre: np.ndarray
    known: np.ndarray
    scale_known: bool
    rotation_sd: np.ndarray
    route: str = ""
    levelled: bool = False
    notes: tuple[str, ...] = ()
    numbers: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def first_known(self) -> int:
        """Row of the first frame that is known; 0 without any."""
        return int(np.argmax(self.known))

    @property
    def turned(self) -> np.ndarray:
        """(N, 3) Rotation vectors from the first known frame to each, rad, in that camera's frame.

        The angles go on beyond half a turn, as a curve without jumps.
        """
        relative = self.rotation[self.first_known] @ np.swapaxes(self.rotation, 1, 2)
        vector = rotation_vector(relative)
        for n in range(1, len(vector)):
            size = np.linalg.norm(vector[n])
            if size > 1e-9:
                turns = np.round((vector[n - 1] @ vector[n] / size - size) / (2 * np.pi))
                vector[n] *= 1.0 + turns * 2 * np.pi / size
        return vector


def camera_with_motion(
    camera: Camera, motion: CameraMotion, *, anchor: Anchor | None = None, scale: float = 1.0
) -> Camera:
    """The camera with a pose per frame, as the trajectory problem takes it.

    Parameters
    ----------
    camera : Camera
        Its lens, and (anchored to it) its pose in the first frame that is known.
    motion : CameraMotion
        Of all frames of the recording.
    anchor : {"motion", "camera"}, optional
        ``"motion"``: the world is the motion's own, its origin where the camera was at first. ``"camera"``:
        the world is that of the camera's pose, which the motion carries on. By default a levelled motion
        brings its own world, another is carried on from the camera's.
    scale : float
        m for a unit of the motion's centres.

    Returns
    -------
    Camera
        x_camera = R_n x_world + t_n with t_n = −R_n c_n.
    """
    anchor = anchor or ("motion" if motion.levelled else "camera")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(
            "The scale is impossible.", key="scale", expected="m per unit, > 0", found=f"{scale:g}"
        )
    rotation, centre = motion.rotation, scale * motion.centre
    if anchor == "camera":
        row = motion.first_known
        fixed = camera.at_frames(np.array([row])) if camera.moves else camera
        base = fixed.rotation.reshape(-1, 3, 3)[0]
        place = -base.T @ fixed.translation.reshape(-1, 3)[0]
        to_base = rotation[row].T @ base  # from the camera's world to the motion's
        centre = place + (centre - centre[row]) @ to_base
        rotation = rotation @ to_base
    translation = -np.einsum("nij,nj->ni", rotation, centre)
    return replace(camera, rotation=rotation, translation=translation)


def bridged(rotation: np.ndarray, centre: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) and centres (N, 3), filled evenly between known frames and held outside of them."""
    rotation, centre = rotation.copy(), centre.copy()
    rows = np.flatnonzero(known)
    if not len(rows):
        return np.broadcast_to(np.eye(3), rotation.shape).copy(), np.zeros_like(centre)
    for n in np.flatnonzero(~known):
        after = int(np.searchsorted(rows, n))
        if after == 0 or after == len(rows):
            source = rows[min(after, len(rows) - 1)]
            rotation[n], centre[n] = rotation[source], centre[source]
            continue
        a, b = rows[after - 1], rows[after]
        share = (n - a) / (b - a)
        turn = rotation_vector(rotation[b] @ rotation[a].T)
        rotation[n] = rotation_matrix(share * turn) @ rotation[a]
        centre[n] = (1 - share) * centre[a] + share * centre[b]
    return rotation, centre
