"""Visual odometry of one camera: how it turned and moved, from its pictures alone.

Two models: ``full``, a turn and a step between successive pictures, chained by the depths of points that
three pictures share (Nistér, Naroditsky and Bergen 2004; Scaramuzza and Fraundorfer 2011); and ``rotation``,
turns alone against key pictures, of a camera that pans on a tripod. Lengths are in units of the first step:
one camera cannot tell more. A picture that cannot be followed (blur, no texture) becomes a frame that is not
known, and is bridged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.camera_motion import CameraMotion, bridged
from acino_fte.data_tools.odometry_features import (
    Features,
    find_features,
    match_features,
)
from acino_fte.data_tools.odometry_pairs import (
    TwoView,
    information_criterion,
    step_between,
    turn_between,
)
from acino_fte.data_tools.odometry_steps import Depths, carried_depths, step_length
from acino_fte.data_tools.pictures import NumberedPictures, PictureList
from acino_fte.errors import InputError

Model = Literal["auto", "full", "rotation"]
MODELS: tuple[Model, ...] = ("auto", "full", "rotation")
_TESTS = 5  # pairs of pictures that choose the model
_APART = 5  # frames between the two of a pair
_NO_MODEL = 4.0 + 2.0 * np.log(4.0)  # GRIC a match where every match is an outlier


@dataclass(frozen=True)
class OdometryOptions:
    """How pictures are followed.

    Attributes
    ----------
    most_features : int
        A picture.
    longest_side : int
        Of the picture in which features are sought, px.
    ratio : float
        Of Lowe's test.
    threshold_px : float
        Of an inlier while sampling, px of the picture in which features are sought.
    overlap : float
        Share of a key picture's matches at which the next key picture is taken (rotation alone).
    bridge : int
        Frames in a row that may be missing; beyond, what follows is a chain of its own.
    """

    most_features: int = 1500
    longest_side: int = 1000
    ratio: float = 0.8
    threshold_px: float = 1.0
    overlap: float = 0.5
    bridge: int = 10


@dataclass(eq=False)
class _Chain:
    """Frames that hang together: rows, poses in the frame of the first, covariance of each attitude."""

    rows: list[int]
    rotation: list[np.ndarray]
    centre: list[np.ndarray]
    covariance: list[np.ndarray]

    @classmethod
    def begun(cls, row: int) -> _Chain:
        return cls([row], [np.eye(3)], [np.zeros(3)], [np.zeros((3, 3))])

    def add(self, row: int, source: int, view: TwoView, length: float) -> None:
        """A frame seen from the chain's frame number `source` (in the chain)."""
        rotation = view.rotation @ self.rotation[source]
        self.rows.append(row)
        self.rotation.append(rotation)
        self.centre.append(self.centre[source] - length * rotation.T @ view.direction)
        self.covariance.append(view.rotation @ self.covariance[source] @ view.rotation.T + view.covariance)


@dataclass(eq=False)
class _Follower:
    """Features of pictures, as they are asked for, and motions between two of them."""

    pictures: NumberedPictures
    camera: Camera
    boxes: np.ndarray | None
    options: OdometryOptions
    threshold: float
    kept: dict[int, Features]

    def features(self, n: int) -> Features:
        if n not in self.kept:
            while len(self.kept) > 8:
                self.kept.pop(next(iter(self.kept)))
            boxes = None if self.boxes is None else self.boxes[n]
            self.kept[n] = find_features(
                self.pictures.at(n).pixels,
                self.camera,
                boxes,
                most=self.options.most_features,
                longest_side=self.options.longest_side,
            )
        found = self.kept.pop(n)
        self.kept[n] = found  # the latest is thrown away last
        return found

    def matches(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        return match_features(self.features(a), self.features(b), self.options.ratio)


def visual_odometry(
    pictures: NumberedPictures | Sequence[Any],
    camera: Camera,
    *,
    model: Model = "auto",
    boxes: np.ndarray | None = None,
    options: OdometryOptions | None = None,
    tell: Callable[[str], None] | None = None,
) -> CameraMotion:
    """Poses of a camera from its pictures.

    Parameters
    ----------
    pictures : NumberedPictures, or a list of arrays
        Anything with ``len()`` and ``.at(n) -> Picture``, or arrays (H, W) or (H, W, 3); as large as the
        camera's, or smaller ones of the same shape.
    camera : Camera
        Its lens.
    model : {"auto", "full", "rotation"}
        ``"auto"``: the one with the smaller sum of Torr's information criterion (GRIC) over five pairs of
        pictures; the note says by how much.
    boxes : (N, 4) or (N, B, 4), optional
        What moves by itself in each picture: left, top, right, bottom, px; see
        :func:`acino_fte.data_tools.odometry_features.keypoint_boxes`.
    options : OdometryOptions, optional
        How pictures are followed.
    tell : callable, optional
        Told what is done.

    Returns
    -------
    CameraMotion
        The world is the camera in the first frame that is known. Never levelled: pictures do not say where up
        is. `scale_known` only of a turn alone.

    Raises
    ------
    InputError
        There are fewer than two pictures, or of another shape than the camera's; the boxes are not one set a
        picture; or the lens is no pinhole or fisheye.
    """
    options = options or OdometryOptions()
    tell = tell or (lambda _: None)
    shown = pictures if hasattr(pictures, "at") else PictureList(pictures)
    follower = _follower(shown, camera, boxes, options)
    notes: list[str] = []
    numbers: dict[str, Any] = {}
    if model == "auto":
        tell("choosing the model")
        model = _chosen(follower, notes, numbers)
    elif model not in MODELS:
        raise InputError("This model of a motion is not known.", expected=", ".join(MODELS), found=str(model))
    numbers["model"] = model
    chains = _turned(follower, tell) if model == "rotation" else _stepped(follower, tell, notes)
    return _joined(chains, len(shown), model, notes, numbers)


def _follower(
    pictures: NumberedPictures, camera: Camera, boxes: np.ndarray | None, options: OdometryOptions
) -> _Follower:
    n = len(pictures)
    if n < 2:
        raise InputError("Too few pictures to follow.", expected="2 or more", found=str(n))
    if camera.model not in ("pinhole", "fisheye"):
        raise InputError(
            f"Pictures of a camera of the model '{camera.model}' cannot be followed.",
            expected="pinhole or fisheye",
        )
    if boxes is not None:
        boxes = np.asarray(boxes, dtype=float)
        if len(boxes) != n or boxes.shape[-1] != 4:
            raise InputError(
                "The boxes do not belong to the pictures.",
                expected=f"({n}, 4): left, top, right, bottom of each picture, px",
                found=f"shape {boxes.shape}",
            )
    size = pictures.at(0).pixels.shape[:2]
    whole = _whole(size, camera)
    shrunk = whole * max(max(size) / options.longest_side, 1.0)
    threshold = options.threshold_px * shrunk / float(camera.matrix[0, 0])
    return _Follower(pictures, camera, boxes, options, threshold, {})


def _whole(size: tuple[int, ...], camera: Camera) -> float:
    """How many pixels of the camera one of a picture (height, width) is across."""
    width, height = camera.resolution
    whole = width / size[1]
    if abs(height - size[0] * whole) > 2.0 * whole:  # codecs take even sizes
        raise InputError(
            "The pictures are not of this camera.",
            expected=f"{width} × {height} px, or smaller ones of the same shape",
            found=f"{size[1]} × {size[0]} px",
            remedy="take the video that belongs to the camera file, neither cut nor turned",
        )
    return whole


def _views(
    follower: _Follower, a: int, b: int, which: Model
) -> tuple[TwoView | None, tuple[np.ndarray, ...]]:
    """The motion from frame a to frame b, and rows and coordinates of the matches."""
    rows, there = follower.matches(a, b)
    x, y = follower.features(a).bearing[rows], follower.features(b).bearing[there]
    view = (turn_between if which == "rotation" else step_between)(x, y, follower.threshold)
    return view, (rows, there, x, y)


def _chosen(follower: _Follower, notes: list[str], numbers: dict[str, Any]) -> Model:
    """The model with the smaller criterion, over pairs some frames apart; one without inliers has lost."""
    n = len(follower.pictures)
    apart = min(_APART, n - 1)
    values = []
    for start in np.unique(np.linspace(0, n - 1 - apart, _TESTS).astype(int)):
        rows, there = follower.matches(start, start + apart)
        x = follower.features(start).bearing[rows]
        y = follower.features(start + apart).bearing[there]
        turn, step = (f(x, y, follower.threshold) for f in (turn_between, step_between))
        if turn is not None or step is not None:
            values.append(np.array(information_criterion(turn, step, len(x))) / len(x))
    if not values:
        notes.append("The pictures do not tell a turn from a step; taken as turns alone.")
        return "rotation"
    means = np.mean([np.where(np.isfinite(v), v, _NO_MODEL) for v in values], axis=0)
    model: Model = "rotation" if means[0] <= means[1] else "full"
    numbers["gric_per_match"] = {"rotation": float(means[0]), "full": float(means[1]), "pairs": len(values)}
    notes.append(
        f"Model '{model}' chosen by the pictures: GRIC a match {means[0]:.2f} of a turn alone, "
        f"{means[1]:.2f} of a turn with a step ({len(values)} pairs of pictures)."
    )
    return model


def _turned(follower: _Follower, tell: Callable[[str], None]) -> list[_Chain]:
    """Chains of turns alone, each frame against its key picture."""
    chains = [_Chain.begun(0)]
    key, most = 0, 0  # place in the chain of the key picture, matches it had at best
    n = len(follower.pictures)
    for row in range(1, n):
        tell(f"picture {row + 1} of {n}")
        chain = chains[-1]
        view, _ = _views(follower, chain.rows[key], row, "rotation")
        found = 0 if view is None else int(view.inliers.sum())
        most = max(most, found)
        last = len(chain.rows) - 1
        if last != key and (view is None or found < follower.options.overlap * most):
            again, _ = _views(follower, chain.rows[last], row, "rotation")
            if again is not None:
                key, view, most = last, again, int(again.inliers.sum())
        if view is not None:
            chain.add(row, key, view, 0.0)
        elif row - chain.rows[-1] > follower.options.bridge:
            chains.append(_Chain.begun(row))
            key, most = 0, 0
    return chains


def _stepped(follower: _Follower, tell: Callable[[str], None], notes: list[str]) -> list[_Chain]:
    """Chains of turns with steps between successive pictures that can be followed."""
    chains = [_Chain.begun(0)]
    depths = Depths.unknown(len(follower.features(0)))
    length = 0.0
    n = len(follower.pictures)
    for row in range(1, n):
        tell(f"picture {row + 1} of {n}")
        chain = chains[-1]
        view, (rows, there, x, y) = _views(follower, chain.rows[-1], row, "full")
        if view is None:
            if row - chain.rows[-1] > follower.options.bridge:
                chains.append(_Chain.begun(row))
                depths, length = Depths.unknown(len(follower.features(row))), 0.0
            continue
        view = _still(view, x, y, follower.threshold) or view
        before = Depths(depths.inverse[rows], depths.variance[rows])
        length = _length(view, x, y, before, length, row, notes)
        moved, variance = carried_depths(view, length, x, y, before)
        chain.add(row, len(chain.rows) - 1, view, length)
        depths = Depths.unknown(len(follower.features(row)))
        depths.inverse[there], depths.variance[there] = moved, variance
    return chains


def _still(view: TwoView, a: np.ndarray, b: np.ndarray, threshold: float) -> TwoView | None:
    """The turn alone where it explains a pair of pictures as well: the camera stood still."""
    turn = turn_between(a, b, threshold)
    if turn is None:
        return None
    alone, step = information_criterion(turn, view, len(a))
    return turn if alone <= step else None


def _length(
    view: TwoView, a: np.ndarray, b: np.ndarray, depths: Depths, last: float, row: int, notes: list[str]
) -> float:
    """Length of the step in units of the first."""
    if not view.direction.any():
        return 0.0
    if last == 0.0 and not np.isfinite(depths.variance).any():
        return 1.0
    found = step_length(view, a, b, depths)
    if found is None or found[0] <= 0 or found[1] > found[0]:
        notes.append(f"The length of the step to frame {row} could not be measured; taken as the one before.")
        return last or 1.0
    return found[0]


def _joined(
    chains: list[_Chain], n: int, model: Model, notes: list[str], numbers: dict[str, Any]
) -> CameraMotion:
    """The longest chain as a motion; what does not hang together with it is not known."""
    chain = max(chains, key=lambda c: len(c.rows))
    rotation = np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
    centre, known, sd = np.zeros((n, 3)), np.zeros(n, dtype=bool), np.full(n, np.nan)
    rows = np.array(chain.rows)
    if len(rows) > 1:
        rotation[rows], centre[rows], known[rows] = chain.rotation, chain.centre, True
        sd[rows] = np.sqrt(np.trace(chain.covariance, axis1=1, axis2=2) / 3.0)
    rotation, centre = bridged(rotation, centre, known)
    lost = np.flatnonzero(~known)
    if len(lost):
        listed = ", ".join(map(str, lost[:8])) + (", …" if len(lost) > 8 else "")
        notes.append(f"{len(lost)} of {n} frames could not be followed (blur or no texture): {listed}.")
    if model == "full":
        notes.append("The scale is not known: lengths are in units of the first step.")
    numbers["chains"] = [[c.rows[0], c.rows[-1], len(c.rows)] for c in chains]
    return CameraMotion(
        np.arange(n), rotation, centre, known, model == "rotation", sd, "video", False, tuple(notes), numbers
    )
