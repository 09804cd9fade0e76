"""Which frame of a segment's video belongs to which message of its camera.

The recorder writes both at once: frame k is message k, and its time in the video is the log time of the
message since the start of the recording, ms, but never that of the frame before. Frames that came together
are pushed on by that. Where something of either file is lost, the times tell what.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_MS = 1_000_000
_CLOSE = 0.6 * _MS, 1.6 * _MS  # the start is known exactly; to half a ms
_NEAR = 0.45  # of a period: videos that others wrote


def pair_frames(stamps: np.ndarray, logs: np.ndarray, started_ns: int | None) -> np.ndarray:
    """The frames of messages.

    Parameters
    ----------
    stamps : (N,) int64
        Times of the frames in the video, ns, rising.
    logs : (K,) int64
        Log times of the messages, ns.
    started_ns : int, optional
        Log time of the start of the recording, where it is known.

    Returns
    -------
    (K,) int64
        For every message its frame, rising; -1 for none. Of all ways to pair them the one that pairs most.
    """
    if not len(stamps) or not len(logs):
        return np.full(len(logs), -1)
    starts = [int(logs[0] - stamps[0]), int(logs[-1] - stamps[-1])]
    if started_ns is not None:
        starts.insert(0, started_ns)
    longer = stamps if len(stamps) > len(logs) else logs
    period = float(np.median(np.diff(longer))) if len(longer) > 1 else 1e9
    best = np.full(len(logs), -1)
    for limit in (*_CLOSE, max(_NEAR * period, _CLOSE[-1])):
        for start in starts:
            found = _in_order(stamps.tolist(), (logs - start).tolist(), limit)
            if (found >= 0).sum() > (best >= 0).sum():
                best = found
        if (best >= 0).sum() == min(len(stamps), len(logs)):
            break
    return best


def _in_order(stamps: Sequence[int], times: Sequence[int], limit: float) -> np.ndarray:
    """Walk through frames and messages (K times, ns) together; what lies farther apart lacks the other."""
    found = np.full(len(times), -1)
    frame, before = 0, -_MS
    for k, time in enumerate(times):
        due = max(time, before + _MS)
        while frame < len(stamps) and stamps[frame] < due - limit:
            before = stamps[frame]
            due = max(time, before + _MS)
            frame += 1
        if frame < len(stamps) and stamps[frame] <= due + limit:
            found[k], before = frame, stamps[frame]
            frame += 1
        else:
            before = due
    return found
