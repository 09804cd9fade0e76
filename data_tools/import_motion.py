"""Poses of the camera in a sequence: from the inertial sensor, or a camera that stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.recording import ImuSamples
from acino_fte.errors import InputError

_FORWARD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # level, looks along the world's y


@dataclass(frozen=True, eq=False)
class Poses:
    """The camera with its poses, what told them, and what is to be known of them."""

    camera: Camera
    route: str
    notes: tuple[str, ...] = ()


def posed_camera(
    lens: Camera, imu: ImuSamples | None, frame_time: np.ndarray, motion: str | None, time_sd: float
) -> Poses:
    """A camera with a pose for every frame of the sequence; its world has z up and the camera at its origin.

    Parameters
    ----------
    lens : Camera
        In the lidar's frame, which is that of the inertial sensor.
    imu : ImuSamples, optional
        Stamps in ns of the clock of `frame_time`.
    frame_time : (N,)
        Of all frames of the sequence, s.
    motion : {"imu", "none"}, optional
        By default the inertial sensor, where there is one.
    time_sd : float
        Standard deviation of the synchronisation, s.

    Raises
    ------
    InputError
        The inertial sensor was asked for and there is none.
    """
    if motion == "imu" and imu is None:
        raise InputError(
            "There is no inertial sensor in the recording to tell how the camera turned.",
            key="--motion",
            expected="messages of an inertial sensor",
            found="none",
            remedy="use --motion none for a camera that stands",
        )
    if motion == "none" or imu is None:
        return _standing(lens, imu)
    from acino_fte.data_tools.camera_motion import camera_with_motion
    from acino_fte.data_tools.imu_camera import Mounting, motion_from_attitude
    from acino_fte.data_tools.imu_filter import gravity_attitude

    mounting = Mounting(lens.rotation, np.zeros((3, 3)), offset_sd=time_sd)
    attitude = gravity_attitude(imu, forward=lens.rotation[2])
    stamps = np.rint(frame_time * 1e9).astype(np.int64)
    found = motion_from_attitude(attitude, stamps, mounting)
    sd = float(np.degrees(np.nanmax(found.rotation_sd)))
    notes = (*found.notes, f"the camera's attitude is known to {sd:.2f}° at worst")
    return Poses(camera_with_motion(lens, found, anchor="motion"), "imu", notes)


@dataclass(frozen=True)
class Encoders:
    """What the encoders of a pan-tilt head count.

    Attributes
    ----------
    counts_per_turn : (pan, tilt)
        Of a whole turn, gears included; negative where counts grow to the right, or downwards.
    zero : (pan, tilt), optional
        Counts where the camera looks along the world's x, and level; by default those of the first frame.
    places : (pan, tilt)
        Which numbers of a message they are, from 0.
    """

    counts_per_turn: tuple[float, float]
    zero: tuple[float, float] | None = None
    places: tuple[int, int] = (2, 3)


def encoder_camera(
    lens: Camera, counts: Sequence[tuple[int, ...]], place: np.ndarray, encoders: Encoders | None
) -> Poses:
    """A camera on a pan-tilt head, with a pose for every frame of the sequence.

    Parameters
    ----------
    lens : Camera
        Its lens.
    counts : sequence of (numbers of the encoders), R of them
        Of every recorded frame.
    place : (R,) int
        Their frames of the sequence; dropped frames between them are bridged.
    encoders : Encoders, optional
        What they count; it must be there.

    Raises
    ------
    InputError
        There are no counts, or what they count is not known.
    """
    from acino_fte.data_tools.camera_motion import camera_with_motion
    from acino_fte.data_tools.pan_tilt import PanTiltHead, motion_from_encoders

    if encoders is None:
        raise InputError(
            "What the encoders count is not known.",
            key="--counts-per-turn",
            expected="counts of a whole turn of pan and of tilt",
            found="nothing",
            remedy="give --counts-per-turn PAN,TILT; negative where counts grow to the right, or downwards",
        )
    pan, tilt = encoders.places
    rows = [values for values in counts if len(values) > max(pan, tilt)]
    if not rows or len(rows) < len(place):
        raise InputError(
            "The camera's messages have no such encoders.",
            key="--encoders",
            expected=f"numbers {pan} and {tilt} (from 0) in the message of every frame",
            found=f"{len(rows)} of {len(place)} messages have them",
        )
    values = np.array([(row[pan], row[tilt]) for row in rows], dtype=float)
    zero = encoders.zero or (float(values[0, 0]), float(values[0, 1]))
    turns = encoders.counts_per_turn
    head = PanTiltHead(
        counts_per_turn=(abs(turns[0]), abs(turns[1])),
        zero=zero,
        sign=(1 if turns[0] > 0 else -1, 1 if turns[1] > 0 else -1),
    )
    frames = np.arange(int(place[-1]) + 1, dtype=float)
    found = motion_from_encoders(values, head, time=place.astype(float), frame_time=frames)
    level = () if encoders.zero else ("the camera is taken to be level in the first frame",)
    posed = camera_with_motion(lens, found, anchor="motion")
    return Poses(posed, "encoders", (*found.notes, *level))


def _standing(lens: Camera, imu: ImuSamples | None) -> Poses:
    """A camera that stands: upright by gravity where it was felt, else taken to be level."""
    rotation, notes = _FORWARD, ("the camera is taken to stand, and to be level",)
    if imu is not None and len(imu):
        force = np.nanmedian(imu.force, axis=0)
        size = float(np.linalg.norm(force))
        if 5 < size < 15:
            up = lens.rotation @ force / size
            right = np.cross(np.array([0.0, 0.0, 1.0]), up)
            if np.linalg.norm(right) > 1e-3:
                right /= np.linalg.norm(right)
                rotation = np.column_stack([right, np.cross(up, right), up])
                notes = ("the camera is taken to stand; gravity tells what is up",)
    return Poses(replace(lens, rotation=rotation, translation=np.zeros(3)), "none", notes)
