"""Frames of a video and messages of its camera: by order, and by time where something is lost."""

import numpy as np
import pytest

from acino_fte.data_tools.rig_pairs import pair_frames

START = 1_785_000_000_000_000_000
MS = 1_000_000


def frames_of(logs):
    """Times of frames as the recorder writes them, ns."""
    out = []
    for log in logs:
        out.append(max(round((log - START) * 1e-6), out[-1] + 1 if out else 0))
    return np.array(out) * MS


@pytest.fixture(scope="module")
def logs():
    """170 Hz; some frames were held up and came together, 0.1 ms apart."""
    times = START + 3 * MS + np.arange(400) * 1e9 / 170 + np.random.default_rng(3).exponential(3e5, 400)
    for first, n in ((20, 3), (150, 12), (300, 5)):
        times[first : first + n] = times[first + n] - 1e5 * np.arange(n, 0, -1)
    return times.astype(np.int64)


@pytest.mark.parametrize("known", [START, START + 400_000, None])
@pytest.mark.parametrize("frames, messages", [(400, 400), (400, 390), (371, 400), (1, 400), (400, 1)])
def test_both_are_cut_somewhere(logs, known, frames, messages):
    """`known` is out by up to half a ms where the manifest was made again."""
    n = min(frames, messages)
    found = pair_frames(frames_of(logs)[:frames], logs[:messages], known)
    assert found.tolist() == [*range(n), *[-1] * (messages - n)]


@pytest.mark.parametrize("known", [START, None])
def test_what_is_missing_is_told_by_time(logs, known):
    """A chunk of messages, a frame of a bunch and one that stands alone."""
    no_frame, no_message = {21, 200, 399}, {*range(60, 75)}
    rows, kept = ([k for k in range(400) if k not in none] for none in (no_message, no_frame))
    found = pair_frames(frames_of(logs)[kept], logs[rows], known)
    assert [kept[f] if f >= 0 else -1 for f in found] == [-1 if k in no_frame else k for k in rows]


def test_nothing_at_all(logs):
    assert pair_frames(np.zeros(0, np.int64), logs[:3], START).tolist() == [-1, -1, -1]
    assert pair_frames(frames_of(logs), np.zeros(0, np.int64), None).tolist() == []
