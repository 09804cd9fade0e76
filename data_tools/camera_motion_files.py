"""A camera's motion on disk: cameras with a pose per frame, a figure, a note; whole or not at all."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.calibration import write_cameras
from acino_fte.data_tools.camera_motion import Anchor, CameraMotion, camera_with_motion
from acino_fte.metrics import json_safe
from acino_fte.result_files import Contents, written_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMAT = "acino-fte/camera-motion/1"
FILES = ("cameras.json", "camera_motion.png", "camera_motion.json")
MOTION = Contents("camera motion", FILES, ("cameras.json", "camera_motion.json"))


def save_motion(
    cameras: CameraArray,
    name: str,
    motion: CameraMotion,
    folder: Path,
    *,
    fps: float,
    anchor: Anchor | None = None,
    scale: float = 1.0,
    note: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Write the cameras, of which one moves now, with a figure and a note.

    Parameters
    ----------
    cameras : CameraArray
        Of the sequence.
    name : str
        Of the camera that moves.
    motion : CameraMotion
        Of all frames of the recording.
    folder : Path
        Checked by :func:`acino_fte.result_files.check_output_folder` with :data:`MOTION`.
    fps : float
        Frames per second.
    anchor, scale
        See :func:`acino_fte.data_tools.camera_motion.camera_with_motion`.
    note : dict, optional
        What else the note shall hold.

    Returns
    -------
    dict
        The note, as it was written.
    """
    moving = camera_with_motion(cameras[name], motion, anchor=anchor, scale=scale)
    written = CameraArray(tuple(moving if camera.name == name else camera for camera in cameras))
    content = {
        "format": FORMAT,
        "camera": name,
        "from": motion.route,
        "frames": [int(motion.frames[0]), int(motion.frames[-1]) + 1],
        "known": int(motion.known.sum()),
        "unknown_frames": motion.frames[~motion.known],
        "levelled": motion.levelled,
        "scale_known": motion.scale_known or scale != 1.0,
        "m_per_unit": scale,
        "rotation_sd_deg": np.degrees(motion.rotation_sd),
        "notes": list(motion.notes),
        **motion.numbers,
        **(note or {}),
    }
    content = json_safe(content)
    with written_whole(folder, MOTION) as working:
        write_cameras(working / "cameras.json", written)
        motion_figure(motion, name, fps).savefig(working / "camera_motion.png", dpi=130)
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
        (working / "camera_motion.json").write_text(text + "\n", encoding="utf-8")
    return content


def pan_tilt_roll(motion: CameraMotion) -> np.ndarray:
    """Angles (N, 3), degrees: pan to the left and tilt upwards of the optical axis, and roll to the right.

    In a levelled world from its horizon; else from the camera's first frame that is known, taken as level.
    """
    rotation = motion.rotation
    if not motion.levelled:
        level = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # x forward, z up, to camera
        rotation = rotation @ rotation[motion.first_known].T @ level
    right, forward = rotation[:, 0], rotation[:, 2]
    pan = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    tilt = np.arcsin(np.clip(forward[:, 2], -1.0, 1.0))
    roll = np.arctan2(-right[:, 2], -rotation[:, 1, 2])
    return np.degrees(np.stack([pan, tilt, roll], axis=1))


def motion_figure(motion: CameraMotion, name: str, fps: float) -> Figure:
    """Pan, tilt and roll over time with two standard deviations, where they are a bridge, and the way."""
    import matplotlib
    from matplotlib.figure import Figure

    from acino_fte.plots_style import BAND_SD, BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, STYLE

    angles, time = pan_tilt_roll(motion), motion.frames / fps
    moves = bool(np.ptp(motion.centre, axis=0).max() > 0)
    style: Any = STYLE
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(8.5, 6.6 if moves else 5.4), layout="constrained")
        panels = figure.subplots(4 if moves else 3, 1, sharex=True)
        world = "levelled world" if motion.levelled else "from the first frame that is known"
        figure.suptitle(f"Camera {name} from {motion.route} · {world}", x=0.01, ha="left", fontsize=12)
        band = BAND_SD * np.degrees(motion.rotation_sd)
        parts = zip(panels[:3], angles.T, ("Pan (°, to the left)", "Tilt (°, upwards)", "Roll (°)"),
                    (BLUE, ORANGE, GREEN), strict=True)  # fmt: skip
        for axes, angle, label, colour in parts:
            axes.fill_between(time, angle - band, angle + band, color=colour, alpha=0.25, lw=0)
            axes.plot(time, np.where(motion.known, angle, np.nan), color=colour)
            lost = ~motion.known
            if lost.any():
                axes.plot(time[lost], angle[lost], ".", color=RED, ms=3, label="not known: bridged")
            axes.set_ylabel(label)
        if (~motion.known).any():
            panels[0].legend(loc="best")
        if moves:
            for i, colour in enumerate((PURPLE, SKY, GREY)):
                panels[3].plot(time, motion.centre[:, i], color=colour, label="xyz"[i])
            panels[3].set_ylabel("Way (m)" if motion.scale_known else "Way (first step = 1)")
            panels[3].legend(loc="best", ncols=3)
        panels[-1].set_xlabel(f"Time (s); bands are ±{BAND_SD:g} standard deviations")
    return figure


def part_of(motion: CameraMotion, n_frames: int) -> CameraMotion:
    """The motion for exactly so many frames: cut, or held after its end and not known there."""
    have = len(motion)
    rows = np.minimum(np.arange(n_frames), have - 1)
    inside = np.arange(n_frames) < have
    notes = motion.notes
    if have != n_frames:
        notes += (f"The motion has {have} frames and the recording {n_frames}.",)
    return replace(
        motion,
        frames=np.arange(n_frames),
        rotation=motion.rotation[rows],
        centre=motion.centre[rows],
        known=motion.known[rows] & inside,
        rotation_sd=np.where(inside, motion.rotation_sd[rows], np.nan),
        notes=notes,
    )
