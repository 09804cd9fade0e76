"""A camera on a pan-tilt head with encoders: its pose in every frame from the counts.

The head's frame has x forward, y left, z up. At zero pan and tilt it is the world's. A positive pan turns the
camera to the left, a positive tilt upwards, so the attitude of the head is R_z(pan) R_y(−tilt): the tilt axis
goes with the pan. K samples of the encoders, N frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from acino_fte.data_tools.camera_motion import CameraMotion, bridged
from acino_fte.data_tools.rotations import rotation_matrix
from acino_fte.data_tools.text_tables import column_numbers, read_text_table
from acino_fte.errors import InputError

FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Head to camera of a camera that looks along the head's x with its top up."""
_MOST_FRAMES, _MOST_COUNTS = 1e9, 1e15
_GAP = 5.0  # median steps of the encoders' samples, across which nothing is interpolated


@dataclass(frozen=True, eq=False)
class PanTiltHead:
    """The geometry of a pan-tilt head.

    Attributes
    ----------
    counts_per_turn : (pan, tilt)
        Counts of a whole turn of each axis, gears included.
    zero : (pan, tilt)
        Counts where the camera looks along the world's x, and level.
    sign : (pan, tilt)
        −1 where counts grow to the right, or downwards.
    head_to_camera : (3, 3)
        How the camera sits on the head: x_camera = head_to_camera @ x_head.
    tilt_axis : (3,)
        Where the tilt axis crosses, from the pan axis, at zero pan, head's frame, m.
    lever : (3,)
        The camera's centre from there, at zero tilt, head's frame, m.
    base_to_world : (3, 3)
        Attitude of the base; by default it stands level.
    """

    counts_per_turn: tuple[float, float]
    zero: tuple[float, float] = (0.0, 0.0)
    sign: tuple[int, int] = (1, 1)
    head_to_camera: np.ndarray = field(default_factory=FORWARD.copy)
    tilt_axis: np.ndarray = field(default_factory=lambda: np.zeros(3))
    lever: np.ndarray = field(default_factory=lambda: np.zeros(3))
    base_to_world: np.ndarray = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        if not all(1 <= c < np.inf for c in self.counts_per_turn):
            raise InputError(
                "The encoders' counts per turn are impossible.",
                key="counts_per_turn",
                expected="two numbers from 1 (a direction is told by the sign)",
                found=f"{self.counts_per_turn}",
            )
        if not (np.isfinite(self.zero).all() and np.isfinite(self.lever).all()):
            raise InputError(
                "The zero of the encoders and the camera's lever are numbers.",
                key="zero, lever",
                expected="counts; m",
                found=f"{self.zero}, {tuple(self.lever)}",
            )
        if any(s not in (1, -1) for s in self.sign):
            raise InputError(
                "The directions of the encoders are impossible.",
                key="sign",
                expected="1 or -1 for pan and for tilt",
                found=f"{self.sign}",
            )

    def angles(self, counts: np.ndarray) -> np.ndarray:
        """Pan and tilt (K, 2), rad, of counts (K, 2); a counter that begins anew after a turn is unrolled."""
        counts = np.asarray(counts, dtype=float)
        angle = (counts - self.zero) * (2.0 * np.pi * np.array(self.sign) / self.counts_per_turn)
        for axis in (0, 1):
            good = np.isfinite(angle[:, axis])
            angle[good, axis] = np.unwrap(angle[good, axis])
        return angle

    def poses(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World to camera (N, 3, 3) and centres (N, 3) from the pan axis, m, of angles (N, 2), rad."""
        pan = rotation_matrix(angles[:, :1] * [0.0, 0.0, 1.0])
        tilt = rotation_matrix(angles[:, 1:] * [0.0, -1.0, 0.0])
        head = self.base_to_world @ pan @ tilt
        centre = (pan @ (self.tilt_axis + tilt @ self.lever)[:, :, None])[:, :, 0] @ self.base_to_world.T
        return self.head_to_camera @ np.swapaxes(head, 1, 2), centre


def motion_from_encoders(
    counts: np.ndarray,
    head: PanTiltHead,
    *,
    time: np.ndarray | None = None,
    frame_time: np.ndarray | None = None,
) -> CameraMotion:
    """Poses of a camera from the counts of its head.

    Parameters
    ----------
    counts : (K, 2)
        Pan and tilt; NaN where they are missing.
    head : PanTiltHead
        Its geometry.
    time, frame_time : (K,), (N,), optional
        Of the samples and of the frames, s, by one clock: the angles are interpolated. Without, the samples
        are those of the frames.

    Returns
    -------
    CameraMotion
        World z up (of a base that stands level), centres in m from the first frame's. The standard deviation
        is that of the encoders' steps. Frames outside the samples or in their gaps are not known.

    Raises
    ------
    InputError
        No frame has counts, or times do not grow or do not fit.
    """
    counts = np.asarray(counts, dtype=float)
    if counts.ndim != 2 or counts.shape[1] != 2:
        raise InputError(
            "The encoders' counts have a wrong shape.", expected="(K, 2)", found=f"{counts.shape}"
        )
    counts = np.where(np.abs(counts) < _MOST_COUNTS, counts, np.nan)
    good = np.isfinite(counts).all(1)
    angles = np.full_like(counts, np.nan)
    angles[good] = head.angles(counts[good])
    if time is not None and frame_time is not None:
        angles = _at_frames(angles, np.asarray(time, dtype=float), np.asarray(frame_time, dtype=float))
    known = np.isfinite(angles).all(1)
    if not known.any():
        raise InputError(
            "No frame has counts of the encoders.",
            expected="counts of pan and tilt in the time of the frames",
            found=f"{int(good.sum())} samples with both",
            remedy="check the clocks: frames and encoders have to share one",
        )
    rotation, centre = head.poses(np.where(known[:, None], angles, 0.0))
    centre = centre - centre[np.argmax(known)]
    rotation, centre = bridged(rotation, centre, known)
    steps = 2.0 * np.pi / np.array(head.counts_per_turn)
    sd = float(np.sqrt((steps**2 / 12.0).sum() / 3.0))  # of a number rounded to steps; over three axes
    lost = int((~known).sum())
    notes = (f"{lost} of {len(known)} frames have no counts of the encoders.",) if lost else ()
    return CameraMotion(
        np.arange(len(known)),
        rotation,
        centre,
        known,
        True,
        np.where(known, sd, np.nan),
        "encoders",
        bool(np.allclose(head.base_to_world[2], [0, 0, 1], atol=1e-9)),
        notes,
        {"pan_deg": np.degrees(angles[:, 0]).tolist(), "tilt_deg": np.degrees(angles[:, 1]).tolist()},
    )


def _at_frames(angles: np.ndarray, time: np.ndarray, frame_time: np.ndarray) -> np.ndarray:
    """Angles (N, 2) at the frames' times, NaN outside the samples (K, 2) and across gaps."""
    if time.shape != (len(angles),):
        raise InputError("Times do not fit the counts.", expected=f"{len(angles)}", found=f"{time.shape}")
    good = np.isfinite(angles).all(1) & np.isfinite(time)
    time, angles = time[good], angles[good]
    if len(time) < 2 or not (np.diff(time) > 0).all():
        raise InputError(
            "The times of the encoders do not grow.",
            key="time",
            expected="two or more, growing",
            found=str(len(time)),
        )
    out = np.stack([np.interp(frame_time, time, angles[:, i]) for i in (0, 1)], axis=1)
    k = np.clip(np.searchsorted(time, frame_time, side="right") - 1, 0, len(time) - 2)
    wide = (time[k + 1] - time[k] > _GAP * np.median(np.diff(time))) & ~np.isin(frame_time, time)
    out[(frame_time < time[0]) | (frame_time > time[-1]) | wide] = np.nan
    return out


def read_encoder_table(path: Path | str) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Counts (K, 2) of pan and tilt from a CSV with columns pan, tilt, and time (s) or frame where it has
    them.

    Returns
    -------
    counts : (K, 2)
    time : (K,) or None
        s.
    frame : (K,) int or None

    Raises
    ------
    InputError
        The file cannot be read, or lacks a column.
    """
    path = Path(path)
    table, _ = read_text_table(path, "counts of the encoders")
    names = {str(name).lower().split("(")[0].strip(): str(name) for name in table.columns}
    if not {"pan", "tilt"} <= set(names):
        raise InputError(
            "The encoders' table lacks columns.",
            file=path,
            expected="pan, tilt (counts), and time (s) or frame",
            found=", ".join(map(str, table.columns))[:200],
        )
    counts = column_numbers(path, table, [names["pan"], names["tilt"]])
    time, frame = (
        column_numbers(path, table, [names[key]])[:, 0] if key in names else None for key in ("time", "frame")
    )
    return counts, time, None if frame is None else _whole_frames(path, frame)


def _whole_frames(path: Path, frame: np.ndarray) -> np.ndarray:
    """Frames (K,) as integers."""
    whole = (np.abs(frame) < _MOST_FRAMES) & (np.round(frame) == frame)
    if not (whole.all() and (np.diff(frame) > 0).all()):
        raise InputError(
            "The frames of the encoders' table do not grow.",
            file=path,
            key="frame",
            expected="whole numbers from 0, each once, in order",
            found=", ".join(f"{value:g}" for value in frame[:5]) + (", …" if len(frame) > 5 else ""),
        )
    return frame.astype(int)
