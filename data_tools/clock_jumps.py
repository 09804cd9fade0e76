"""Where one of two clocks jumped: stretches of messages whose least delays lie on one line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_WINDOW = 15  # messages on either side
_RANK = 2  # the third least of them: two that are too early do not matter
LEAST_JUMP_NS = 2e6
"""Smaller jumps count as wander, ns."""
_SIGMAS = 8.0
_DRIFT = 1e-4  # of two clocks, at worst
_STALL_NS = (
    5e9  # a stretch shorter than this between two that agree is no jump and back, but messages held up
)


@dataclass(frozen=True, eq=False)
class Piece:
    """Messages of one stretch: their rows, rising."""

    rows: np.ndarray


def find_pieces(device: np.ndarray, received: np.ndarray, jumps: bool = True) -> tuple[list[Piece], int]:
    """Stretches between jumps, and how many messages belong to none.

    Parameters
    ----------
    device, received : (K,) int64
        Stamps by either clock, in the order of the recording.
    jumps : bool
        Whether to look for jumps; else there is one stretch.
    """
    level = ((received - received[0]) - (device - device[0])).astype(float)
    time = (received - received[0]).astype(float)
    scale = _noise(level)
    parts = _parts(device, level, time, scale) if jumps else [np.arange(len(device))]
    pieces, n_out = [], len(device) - sum(map(len, parts))
    for rows in parts:
        good = _not_early(level[rows], time[rows], scale)
        n_out += int((~good).sum())
        pieces.append(Piece(rows[good]))
    return pieces, n_out


def _parts(device: np.ndarray, level: np.ndarray, time: np.ndarray, scale: float) -> list[np.ndarray]:
    """Rows of every stretch between jumps."""
    edges = [0, *_restarts(device), len(device)]
    bounds = set(edges)
    for start, stop in zip(edges, edges[1:], strict=False):
        bounds.update(start + c for c in _jumps(level[start:stop], time[start:stop], scale))
    edges = sorted(bounds)
    return _joined([np.arange(a, b) for a, b in zip(edges, edges[1:], strict=False)], level, time, scale)


def _noise(level: np.ndarray) -> float:
    """Robust standard deviation of the step of low levels, ns."""
    window = _window(len(level))
    if window < 3:
        return 0.0
    step = _steps(level, window)
    return 1.4826 * float(np.median(np.abs(step - np.median(step))))


def _window(n: int) -> int:
    return min(_WINDOW, n // 3)


def _rank(window: int) -> int:
    return min(_RANK, max(window // 5, 0))


def _steps(level: np.ndarray, window: int) -> np.ndarray:
    """(K - 2 W + 1,) low level of the W messages from i + W on, less that of the W before."""
    views = np.lib.stride_tricks.sliding_window_view(level, window)
    low = np.partition(views, _rank(window), axis=1)[:, _rank(window)]
    return low[window:] - low[:-window]


def _restarts(device: np.ndarray) -> list[int]:
    """Where the device's clock went back, and stayed behind what it had shown."""
    step = np.diff(device)
    usual = float(np.median(np.abs(step))) if len(step) else 0.0
    cuts = []
    for i in np.flatnonzero(step < -max(3 * usual, 1e6)) + 1:
        after = device[i : i + _WINDOW]
        sure = len(after) == _WINDOW or (len(after) >= 2 and -step[i - 1] > _STALL_NS)
        if sure and after.max() < device[i - 1]:  # messages out of order are none
            cuts.append(int(i))
    return cuts


def _jumps(level: np.ndarray, time: np.ndarray, scale: float) -> list[int]:
    """First messages after a jump, within one stretch."""
    window = _window(len(level))
    if window < 3:
        return []
    step = _steps(level, window)
    middle = (window - 1) // 2
    apart = time[window + middle : window + middle + len(step)] - time[middle : middle + len(step)]
    size = np.abs(step) / (max(_SIGMAS * scale, LEAST_JUMP_NS) + _DRIFT * np.maximum(apart, 0.0))
    cuts = []
    while len(size) and size.max() > 1:
        i = int(size.argmax())
        cuts.append(_place(level, i, window))
        size[max(i - window + 1, 0) : i + window] = 0.0
    return sorted(set(cuts))


def _place(level: np.ndarray, i: int, window: int) -> int:
    """The first message after the jump that lies between rows i and i + 2 W: where two levels fit best."""
    rows = level[i : i + 2 * window]
    rank = _rank(window)
    before = np.partition(rows[:window], rank)[rank]
    after = np.partition(rows[window:], rank)[rank]

    def cost(values: np.ndarray, low: float) -> np.ndarray:
        above = values - low
        most = abs(after - before)  # beyond it a delay says no more
        return np.minimum(np.where(above < 0, -20 * above, above), 20 * most)

    left = np.concatenate([[0.0], np.cumsum(cost(rows, before))])
    right = cost(rows, after)
    right = np.concatenate([[0.0], np.cumsum(right)])
    return i + int(np.argmin(left + right[-1] - right))


def _joined(parts: list[np.ndarray], level: np.ndarray, time: np.ndarray, scale: float) -> list[np.ndarray]:
    """Join stretches that agree over a short one, whose messages were held up."""
    limit = max(_SIGMAS * scale, LEAST_JUMP_NS)

    def agree(a: np.ndarray, b: np.ndarray) -> bool:
        near_a, near_b = a[-_WINDOW:], b[:_WINDOW]
        gap = abs(time[near_b].mean() - time[near_a].mean())
        low_a = np.partition(level[near_a], _rank(len(near_a)))[_rank(len(near_a))]
        low_b = np.partition(level[near_b], _rank(len(near_b)))[_rank(len(near_b))]
        return bool(abs(low_a - low_b) < limit + _DRIFT * gap)

    out = [parts[0]]
    i = 1
    while i < len(parts):
        begun = time[parts[i][0]]
        for j in range(i, len(parts)):
            if j > i and time[parts[j][0]] - begun > _STALL_NS:
                i, out = i + 1, [*out, parts[i]]
                break
            if agree(out[-1], parts[j]):
                out[-1] = np.concatenate([out[-1], parts[j]])
                i = j + 1
                break
        else:
            i, out = i + 1, [*out, parts[i]]
    return [part for part in out if len(part) > 1] or [np.concatenate(parts)]


def _not_early(level: np.ndarray, time: np.ndarray, scale: float) -> np.ndarray:
    """(K,) which messages came no earlier than the least delays about them allow."""
    n_blocks = min(len(level) // 4, max(60, len(level) // 10))
    if n_blocks < 5:
        return np.ones(len(level), dtype=bool)
    blocks = np.array_split(np.arange(len(level)), n_blocks)
    least = np.array([level[b].min() for b in blocks])
    at = np.array([time[b].mean() for b in blocks])
    half = 6
    middle = np.array([np.median(least[max(0, i - half) : i + half + 1]) for i in range(n_blocks)])
    spread = 1.4826 * float(np.median(np.abs(least - middle)))
    ends = _DRIFT * (np.ptp(time) / n_blocks) * (half + 1)
    limit = max(8 * spread, 0.5 * scale, 1e3) + ends
    return level >= np.interp(time, at, middle) - limit
