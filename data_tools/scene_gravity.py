"""Which way is up in a structure-from-motion model: and how sure that is: from the cameras.

Nothing here depends on the gauge of the model: turned, moved or scaled, it gives the same direction in the
world. Shapes: K key frames of all cameras, Q points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.camera_keys import KeyedCamera

_STRAIGHT = 0.1  # second spread of a path over the first, below which it is straight
_FLAT = 0.25  # third spread over the second, up to which points lie in a plane
_TURNED = (
    0.05  # second moment of the image-right directions, from which cameras have turned about the vertical
)
UPRIGHT = 0.35  # sine of the angle to the horizontal plane from which the image-up direction says the sign
_BLOCKS = 10
TUKEY = 4.685


@dataclass(frozen=True, eq=False)
class Up:
    """A direction, how it was found, and how sure it is.

    Attributes
    ----------
    direction : (3,)
        Unit vector in the model's axes.
    how : str
    sd : float
        Of its tilt, rad (jackknife over blocks of frames, or of the ground); NaN when nothing tells it.
    height : float, optional
        Of the ground along the direction, in units of the model.
    sure : bool
        Whether the images themselves say which end is up.
    notes : tuple of str
    """

    direction: np.ndarray
    how: str
    sd: float
    height: float | None = None
    sure: bool = True
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class KeyPoses:
    """The key frames of all cameras in order of time, then of camera.

    Attributes
    ----------
    camera, frame : (K,) int
    rotation : (K, 3, 3)
        World to camera.
    centre : (K, 3)
    """

    camera: np.ndarray
    frame: np.ndarray
    rotation: np.ndarray
    centre: np.ndarray

    @classmethod
    def of(cls, cameras: Sequence[KeyedCamera]) -> KeyPoses:
        """Those of some cameras."""
        if not cameras:
            raise InputError("The scene has no cameras.", expected="one at least", found="none")
        camera = np.repeat(np.arange(len(cameras)), [len(c.frame) for c in cameras])
        frame = np.concatenate([c.frame for c in cameras])
        order = np.lexsort((camera, frame))
        rotation = np.concatenate([c.rotation for c in cameras])[order]
        return cls(camera[order], frame[order], rotation, np.concatenate([c.centre for c in cameras])[order])

    def at(self, rows: np.ndarray) -> KeyPoses:
        """Some of them."""
        return KeyPoses(self.camera[rows], self.frame[rows], self.rotation[rows], self.centre[rows])

    @property
    def moves(self) -> np.ndarray:
        """Centres less the mean centre of their camera, (K, 3)."""
        n = np.bincount(self.camera)
        mean = np.stack([np.bincount(self.camera, axis) for axis in self.centre.T], axis=-1)
        return self.centre - (mean / np.maximum(n, 1)[:, None])[self.camera]

    @property
    def size(self) -> float:
        """Root mean square distance of the centres from their mean."""
        return float(np.sqrt(((self.centre - self.centre.mean(axis=0)) ** 2).sum(1).mean()))


def up_from_cameras(keys: KeyPoses) -> Up:
    """Up from how the cameras moved and were held. The first of these that the cameras allow:

    1. The normal of the plane that their paths lie in, when they spread in one.
    2. The direction that is level with no camera's image-right direction, when the cameras turned (Brown and
       Lowe 2007, automatic straightening): people and gimbals hold the horizon level.
    3. The mean image-up direction, made perpendicular to a straight path: a guess, of unknown uncertainty.

    The sign is that of the mean image-up direction while it leans at least 20° out of the level; cameras
    that look straight down have none, and up is against their view. A camera that looks straight up cannot
    be told from one that looks down, nor a flight along a wall from one over the ground.
    """
    found = _paths_plane(keys)
    if found is not None:
        return found
    found = _level_horizon(keys)
    return found if found is not None else _image_up(keys)


def up_against_view(keys: KeyPoses) -> Up:
    """Up for cameras that are known to look down: against their mean viewing direction."""

    def direction(part: KeyPoses) -> np.ndarray:
        return -unit(part.rotation[:, 2].mean(axis=0))

    return Up(
        direction(keys), "against the mean viewing direction of the cameras", jackknife(direction, keys)
    )


def _paths_plane(keys: KeyPoses) -> Up | None:
    """Up as the normal of the plane of the paths, or None when they do not spread in a plane."""
    spread = _spreads(keys.moves)
    if not (spread[0] > 1e-6 * max(keys.size, 1e-300) and len(keys.frame) > 3):
        return None
    if spread[1] < _STRAIGHT * spread[0] or spread[2] > _FLAT * spread[1]:
        return None

    def direction(part: KeyPoses) -> np.ndarray:
        return _normal(part.moves)

    normal = direction(keys)
    sign, how, sure, notes = _sign(keys, normal)
    if not sign:
        return None
    sd = jackknife(direction, keys)
    return Up(sign * normal, f"plane of the camera paths, {how}", sd, sure=sure, notes=notes)


def _level_horizon(keys: KeyPoses) -> Up | None:
    """Up as what is perpendicular to all image-right directions, or None when they do not turn enough."""

    def direction(part: KeyPoses) -> np.ndarray:
        right = part.rotation[:, 0]
        return np.linalg.eigh(right.T @ right)[1][:, 0]

    right = keys.rotation[:, 0]
    value = np.linalg.eigvalsh(right.T @ right / len(right))
    if value[1] < _TURNED or value[0] > _FLAT * value[1]:
        return None
    up = direction(keys)
    sign, how, sure, notes = _sign(keys, up)
    if not sign:
        return None
    return Up(
        sign * up, f"level horizon of the cameras, {how}", jackknife(direction, keys), sure=sure, notes=notes
    )


def _image_up(keys: KeyPoses) -> Up:
    """Up as the mean image-up direction, made perpendicular to a straight path."""
    spread = _spreads(keys.moves)
    straight = spread[0] > 1e-6 * max(keys.size, 1e-300) and spread[1] < _STRAIGHT * spread[0]

    def direction(part: KeyPoses) -> np.ndarray:
        up, view = -part.rotation[:, 1].mean(axis=0), -part.rotation[:, 2].mean(axis=0)
        if np.linalg.norm(up) < 0.3:
            up = view if np.linalg.norm(view) > 0.3 else -part.rotation[0, 1]
        if straight:
            path = np.linalg.eigh(part.moves.T @ part.moves)[1][:, 2]
            level = up - (up @ path) * path
            if np.linalg.norm(level) > 0.7 * np.linalg.norm(up):
                up = level
        return unit(up)

    how = "a guess: mean image-up direction" + (", perpendicular to the straight path" if straight else "")
    note = (
        "Up is only what the images' top says: the cameras neither spread in a plane nor turned. Cameras "
        "that look down or are tilted need another source of gravity (a ground plane, accelerometers)."
    )
    return Up(direction(keys), how, float("nan"), sure=False, notes=(note,))


def _sign(keys: KeyPoses, normal: np.ndarray) -> tuple[int, str, bool, tuple[str, ...]]:
    """Which way along a normal is up (+1, −1, or 0: neither), how it is known, whether surely, and notes."""
    up = float(-keys.rotation[:, 1].mean(axis=0) @ normal)
    against = float(-keys.rotation[:, 2].mean(axis=0) @ normal)
    if abs(up) >= UPRIGHT:
        return int(np.sign(up)), "up as the images have it", True, ()
    if abs(against) >= UPRIGHT:
        note = (
            "The cameras are taken to look down. Cameras that look straight up, or at a wall along which "
            "they move, need another source of gravity."
        )
        return int(np.sign(against)), "cameras that look down", False, (note,)
    return 0, "", False, ()


def _spreads(points: np.ndarray) -> np.ndarray:
    """Standard deviations of centred points along their principal axes, falling."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(points.T @ points / max(len(points), 1))[::-1], 0.0))


def _normal(points: np.ndarray, rounds: int = 30) -> np.ndarray:
    """Normal of the plane through centred points (K, 3); points far off it count less (Tukey)."""
    weight = np.ones(len(points))
    normal = np.zeros(3)
    for _ in range(rounds):
        before, normal = normal, np.linalg.eigh((points * weight[:, None]).T @ points)[1][:, 0]
        if np.linalg.norm(np.cross(before, normal)) < 1e-13 and before.any():
            break
        off = np.abs(points @ normal)
        scale = 1.4826 * float(np.median(off))
        if not scale > 1e-9 * float(np.abs(points).max()):
            break
        weight = np.where(off < TUKEY * scale, (1 - (off / (TUKEY * scale)) ** 2) ** 2, 0.0)
    return normal


def jackknife(
    direction: Callable[[KeyPoses], np.ndarray], keys: KeyPoses, time: np.ndarray | None = None
) -> float:
    """Standard deviation of a direction by leaving out blocks of frames, rad; NaN with too few."""
    _, moment = np.unique(keys.frame if time is None else time, return_inverse=True)
    n = int(moment.max()) + 1
    if n < 3:  # fixed cameras: one left out after the other
        moment = np.unique(keys.camera, return_inverse=True)[1]
        n = int(moment.max()) + 1
    blocks = min(n, _BLOCKS)
    if blocks < 3:
        return float("nan")
    block = moment * blocks // n
    whole = direction(keys)
    square = 0.0
    for i in range(blocks):
        part = direction(keys.at(np.flatnonzero(block != i)))
        square += float(((part * np.sign(part @ whole) - whole) ** 2).sum())
    return float(np.sqrt((blocks - 1) / blocks * square))


def unit(vector: np.ndarray) -> np.ndarray:
    """The vector (3,) at length 1."""
    return vector / np.linalg.norm(vector)
