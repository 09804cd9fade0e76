"""Which of a camera's frames a video has, when it has fewer than the camera's messages tell of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.sync import Stamps, even_losses

_EVEN = 0.25  # of a period: a video whose steps vary less was stamped by counting (Matroska has whole ms)
_MISS = 0.35  # of a period, at most, between a frame of the video and its message
_CLEAR = 3.0


@dataclass(frozen=True, eq=False)
class VideoFrames:
    """Rows (N,) of the camera's messages that a video has, how they were found, and whether for sure."""

    rows: np.ndarray
    how: str
    sure: bool


def match_video(n_frames: int, video_ns: np.ndarray | None, camera: Stamps) -> VideoFrames:
    """Find the messages of a video's frames.

    As many frames as messages are taken one by one. Fewer frames are found by the times that the video itself
    has for them: the shift of its clock at which all frames fall on messages. A video that was stamped by
    counting its frames tells nothing; its losses are spread evenly.

    Parameters
    ----------
    n_frames : int
        N, of the video.
    video_ns : (N,) int64, optional
        Its own stamps.
    camera : Stamps
        Of the camera's messages, K ≥ N.

    Raises
    ------
    InputError
        The video has more frames than there are messages.
    """
    n_messages = len(camera)
    if n_frames == n_messages:
        return VideoFrames(np.arange(n_frames), "one message for every frame", True)
    evenly = even_losses(n_frames, n_messages)
    lost = n_messages - n_frames
    if video_ns is not None and len(video_ns) == n_frames and n_frames > 2:
        rows = _by_times(video_ns, camera)
        if rows is not None:
            return VideoFrames(rows, f"{lost} messages without a frame, by the times of the video", True)
    how = f"{lost} messages without a frame, spread evenly: δ_loss = {n_messages / n_frames:.5f}"
    return VideoFrames(evenly, how, False)


def _by_times(video_ns: np.ndarray, camera: Stamps) -> np.ndarray | None:
    """Rows at which the frames fall, or None where no shift fits clearly better than all others."""
    video = (video_ns - video_ns[0]).astype(float) * 1e-9
    times = (camera.device_ns - camera.device_ns[0]).astype(float) * 1e-9
    period = float(np.median(np.diff(times)))
    steps = np.diff(video) / max(float(np.median(np.diff(video))), 1e-9)
    if np.abs(steps - 1).max() < _EVEN or period <= 0:
        return None
    found = []
    for start in range(len(times) - len(video) + 1):
        rows = _nearest(times, video + times[start])
        misses = np.abs(times[rows] - times[start] - video)
        if (np.diff(rows) > 0).all():
            found.append((float(np.quantile(misses, 0.99)), start, rows))
    found.sort(key=lambda one: one[0])
    if not found or found[0][0] > _MISS * period:
        return None
    if len(found) > 1 and found[1][0] < max(_CLEAR * found[0][0], 0.5 * period):
        return None
    return found[0][2]


def _nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    right = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return np.where(wanted - times[right - 1] < times[right] - wanted, right - 1, right)
