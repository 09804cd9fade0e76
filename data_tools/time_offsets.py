"""Offsets and drifts between the clocks of cameras, from the individuals that they see moving.

Frame f of camera c happens at f + offset_c + drift_c (f − middle) on the clock of the reference camera. When
the clocks are right, the rays of two cameras to one individual meet. First every pair of cameras is searched
over whole offsets; then all offsets and drifts together minimise the distances between corresponding rays
(robust Gauss–Newton). Standard errors are those of an M-estimator with errors that hang together in time
(sandwich over blocks of frames). Shapes: C cameras, N frames, P dots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from acino_fte.data_tools.clock_fit import fit_clocks
from acino_fte.data_tools.clock_search import search_pairs
from acino_fte.data_tools.timed_rays import timed_rays
from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from acino_fte.cameras import Camera
    from acino_fte.data_tools.camera_keys import KeyedCamera
    from acino_fte.data_tools.camera_paths import CameraPath
    from acino_fte.data_tools.tracks2d import Tracks2D


@dataclass(frozen=True, eq=False)
class TimeOffsets:
    """The clocks of the cameras against that of the reference.

    Attributes
    ----------
    names : tuple of str
    reference : str
    offset, drift : (C,)
        Frames, and frames per frame (1e-6 is 1 ppm); 0 for the reference and where nothing tells them.
    offset_sd, drift_sd : (C,)
        Standard deviations; 0 for the reference, infinite where nothing tells them.
    middle : float
        Frame about which clocks drift.
    n : (C,) int
        Pairs of rays that a camera took part in.
    notes : tuple of str
        Warnings.
    """

    names: tuple[str, ...]
    reference: str
    offset: np.ndarray
    drift: np.ndarray
    offset_sd: np.ndarray
    drift_sd: np.ndarray
    middle: float
    n: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def observable(self) -> np.ndarray:
        """Cameras whose clock is known, (C,) bool."""
        return np.isfinite(self.offset_sd)

    def reference_time(self, camera: str, frame: np.ndarray) -> np.ndarray:
        """Times on the reference's clock, frames, of frames of a camera."""
        c = self.names.index(camera)
        return np.asarray(frame) + self.offset[c] + self.drift[c] * (np.asarray(frame) - self.middle)

    def own_time(self, camera: str, time: np.ndarray) -> np.ndarray:
        """Times on a camera's own clock, frames, of times on the reference's clock."""
        c = self.names.index(camera)
        return own_time(time, float(self.offset[c]), float(self.drift[c]), self.middle)


def own_time(time: np.ndarray, offset: float, drift: float = 0.0, middle: float = 0.0) -> np.ndarray:
    """Times on the own clock of a camera, frames, of times on the reference's clock."""
    return middle + (np.asarray(time) - middle - offset) / (1 + drift)


def estimate_time_offsets(
    paths: Sequence[CameraPath],
    tracks: Sequence[Tracks2D],
    lenses: Sequence[Camera],
    *,
    reference: str | None = None,
    max_offset: int = 90,
    drift: bool = True,
) -> TimeOffsets:
    """The clocks of cameras that were not synchronised.

    Individuals have to move as two cameras or more see it, and are joined by their names. Cameras may move
    or not.

    Parameters
    ----------
    paths : sequence of CameraPath
        Poses of the cameras on their own clocks.
    tracks : sequence of Tracks2D
        Of the cameras, in the same order, on their own clocks.
    lenses : sequence of Camera
        In the same order.
    reference : str, optional
        The camera whose clock counts; by default the first that sees an individual of another.
    max_offset : int
        Greatest offset between two cameras that is looked for, frames.
    drift : bool
        Whether clocks may run at different rates.

    Returns
    -------
    TimeOffsets
        With infinite standard deviations for clocks that the recording does not tell.

    Raises
    ------
    InputError
        The reference is unknown, the cameras do not belong together, or the range is impossible.
    """
    names = _checked(paths, tracks, lenses, max_offset)
    if reference is not None and reference not in names:
        raise InputError(
            f"The reference camera '{reference}' is not there{did_you_mean(reference, names)}.",
            expected=", ".join(names),
        )
    rays = timed_rays(paths, tracks, lenses)
    frames = np.concatenate([one.frame for one in rays])
    middle = float(np.floor((frames.min() + frames.max()) / 2)) if len(frames) else 0.0
    pairs = search_pairs(rays, max_offset, middle, drift)
    first = min((min(pair.a, pair.b) for pair in pairs), default=0)
    origin = first if reference is None else names.index(reference)
    fit = fit_clocks(rays, pairs, origin, middle, drift)
    notes = [
        *(f"Cameras {names[p.a]} and {names[p.b]}: {note}" for p in pairs for note in p.notes),
        *(f"The clock of camera {names[c]} is not known: {why}." for c, why in fit.unknown.items()),
    ]
    return TimeOffsets(
        names=names,
        reference=names[origin],
        offset=fit.offset,
        drift=fit.drift,
        offset_sd=fit.offset_sd,
        drift_sd=fit.drift_sd,
        middle=middle,
        n=fit.n,
        notes=tuple(notes),
    )


def _checked(
    paths: Sequence[CameraPath], tracks: Sequence[Tracks2D], lenses: Sequence[Camera], max_offset: int
) -> tuple[str, ...]:
    names, views = tuple(path.name for path in paths), tuple(view.camera for view in tracks)
    if names != views or len(lenses) != len(names):
        raise InputError(
            "Camera paths, tracks and lenses do not belong together.",
            expected=f"tracks and lenses of {', '.join(names)}",
            found=f"tracks of {', '.join(views)}; {len(lenses)} lenses",
        )
    if len(names) < 2:
        raise InputError("Time offsets are between cameras.", expected="two cameras or more", found="one")
    if not max_offset >= 1:
        raise InputError(
            "The range of offsets is impossible.", expected="1 frame or more", found=f"{max_offset:g}"
        )
    return names


def keys_on_one_clock(
    cameras: Sequence[KeyedCamera],
    paths: Sequence[CameraPath],
    shifts: Sequence[tuple[float, float, float]],
) -> tuple[KeyedCamera, ...]:
    """Cameras with key frames that all have in common, on the reference's clock.

    Key frames of clocks that differ by parts of a frame never fall together, and rigs are told by common key
    frames. So all paths are read off at the same frames, as far apart as the densest key frames.

    Parameters
    ----------
    cameras : sequence of KeyedCamera
        On their own clocks.
    paths : sequence of CameraPath
        Of the same cameras, on their own clocks.
    shifts : sequence of (offset, drift, middle)
        As in :class:`TimeOffsets`, for each camera.
    """
    steps = [float(np.median(np.diff(camera.frame))) for camera in cameras if len(camera.frame) > 1]
    step = max(1, round(min(steps))) if steps else 1
    moved = []
    for camera, path, shift in zip(cameras, paths, shifts, strict=True):
        here = path_on_reference_clock(path, *shift)
        own = own_time(here.frame, *shift)
        place = np.clip(np.searchsorted(camera.frame, own), 1, max(len(camera.frame) - 1, 1))
        beside = camera.frame[np.stack([place - 1, np.minimum(place, len(camera.frame) - 1)])]
        near = np.abs(beside - own).min(0) <= 0.5 * step
        chosen = np.flatnonzero(here.known & near & (here.frame % step == 0))
        if len(camera.frame) == 1 or not len(chosen):
            frame = np.round(camera.frame + shift[0] + shift[1] * (camera.frame - shift[2])).astype(int)
            moved.append(replace(camera, frame=frame[:1], **_first_key(camera)))
            continue
        moved.append(
            replace(
                camera,
                frame=here.frame[chosen],
                rotation=here.rotation[chosen],
                translation=here.translation[chosen],
                covariance=here.covariance[chosen],
            )
        )
    return tuple(moved)


def _first_key(camera: KeyedCamera) -> dict[str, Any]:
    covariance = None if camera.covariance is None else camera.covariance[:1]
    return {
        "rotation": camera.rotation[:1],
        "translation": camera.translation[:1],
        "covariance": covariance,
    }


def _nodes(first: int, last: int, offset: float, drift: float, middle: float) -> tuple[np.ndarray, ...]:
    """Frames (M,) of the reference within a range of own frames, own frame before each, and the rest."""
    ends = np.array([first, last]) + offset + drift * (np.array([first, last]) - middle)
    frame = np.arange(int(np.ceil(ends[0] - 1e-9)), int(np.floor(ends[1] + 1e-9)) + 1)
    own = own_time(frame, offset, drift, middle)
    before = np.floor(own + 1e-9).astype(int)
    part = np.clip(own - before, 0.0, 1.0)
    return frame, before, np.where(part < 1e-8, 0.0, part)


def tracks_on_reference_clock(
    tracks: Tracks2D, offset: float, drift: float = 0.0, middle: float = 0.0
) -> Tracks2D:
    """Tracks of a camera in the whole frames of the reference's clock.

    Dots are interpolated linearly between consecutive frames of their track; nothing is made up across gaps.
    Bare points, and dots that share frame and track with another, belong to no line and are kept at whole
    offsets only. Each new dot has the row and the animal of the nearer one.

    Parameters
    ----------
    tracks : Tracks2D
        On the camera's own clock.
    offset, drift, middle : float
        As in :class:`TimeOffsets`.
    """
    if not len(tracks):
        return tracks
    frame, before, part = _nodes(int(tracks.frame.min()), int(tracks.frame.max()), offset, drift, middle)
    first, width = int(tracks.frame.min()), int(np.ptp(tracks.frame)) + 2
    key = (tracks.track.astype(np.int64) + 1) * width + tracks.frame - first
    order = np.argsort(key, kind="stable")
    new_first, new_last, where, rest = [], [], [], []
    whole = part == 0.0
    lines = np.unique(tracks.track)
    for line in lines[lines >= 0]:
        rows = order[(key[order] // width) == line + 1]
        alone = np.bincount(tracks.frame[rows] - first, minlength=width) == 1
        row = np.full(width + 1, -1)
        row[tracks.frame[rows] - first] = rows
        row[:-1][~alone] = -1
        here, there = row[before - first], row[np.minimum(before - first + 1, width)]
        there = np.where(whole, here, there)
        ok = (here >= 0) & (there >= 0)
        new_first.append(here[ok])
        new_last.append(there[ok])
        where.append(frame[ok])
        rest.append(part[ok])
    kept = _loose_at_whole(tracks, frame[whole], before[whole])
    here, there = np.concatenate([*new_first, kept[0]]), np.concatenate([*new_last, kept[0]])
    at, weight = np.concatenate([*where, kept[1]]), np.concatenate([*rest, np.zeros(len(kept[1]))])
    xy = (1 - weight)[:, None] * tracks.xy[here] + weight[:, None] * tracks.xy[there]
    moved = tracks.at_rows(np.where(weight < 0.5, here, there))
    moved = replace(moved, frame=at, track=tracks.track[here], xy=xy)
    return moved.at_rows(np.lexsort((moved.track, moved.frame)))


def _loose_at_whole(tracks: Tracks2D, frame: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of bare points and of doubled dots in own frames that fall on a frame, and that frame."""
    key = tracks.track.astype(np.int64) * (int(tracks.frame.max()) + 1) + tracks.frame
    _, index, count = np.unique(key, return_inverse=True, return_counts=True)
    loose = np.flatnonzero((tracks.track < 0) | (count[index] > 1))
    place = np.searchsorted(own, tracks.frame[loose])
    found = place < len(own)
    found[found] = own[place[found]] == tracks.frame[loose][found]
    return loose[found], frame[place[found]]


def path_on_reference_clock(
    path: CameraPath, offset: float, drift: float = 0.0, middle: float = 0.0
) -> CameraPath:
    """A camera's path in the whole frames of the reference's clock.

    Between consecutive frames centres go straight, and rotations on the great arc.

    Parameters
    ----------
    path : CameraPath
        On the camera's own clock.
    offset, drift, middle : float
        As in :class:`TimeOffsets`.

    Raises
    ------
    InputError
        No whole frame of the reference falls on the path.
    """
    first, last = int(path.frame[0]), int(path.frame[-1])
    frame, before, part = _nodes(first, last, offset, drift, middle)
    if not len(frame):
        raise InputError(
            f"The path of camera '{path.name}' has no whole frame on the reference's clock.",
            expected="two frames or more",
            found=f"frames {first}–{last}",
        )
    here = before - first
    there = np.minimum(here + (part > 0), len(path.frame) - 1)
    step = Rotation.from_matrix(path.rotation[there] @ np.swapaxes(path.rotation[here], 1, 2)).as_rotvec()
    rotation = Rotation.from_rotvec(part[:, None] * step).as_matrix() @ path.rotation[here]
    weight = part[:, None]
    centre = (1 - weight) * path.centre[here] + weight * path.centre[there]
    weight = part[:, None, None]
    nearer = np.where(part < 0.5, here, there)
    return replace(
        path,
        frame=frame,
        rotation=rotation,
        translation=-np.einsum("nij,nj->ni", rotation, centre),
        covariance=(1 - weight) * path.covariance[here] + weight * path.covariance[there],
        known=path.known[here] & path.known[there],
        key=path.key[nearer],
    )
