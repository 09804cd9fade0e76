"""Stamps of one stream: rate, jitter, losses, duplicates, order and clocks, in constant memory.

Messages are taken in blocks. What is missing is told by the camera's frame numbers where there are some, and
by the steps between stamps; a jump of a clock is no loss, nor is a message that was held up on its way.
"""

from __future__ import annotations

from array import array

import numpy as np

from acino_fte.data_tools.clocks import fit_clock
from acino_fte.errors import InputError
from acino_fte.rig.check_types import ClockJump, Gap, StreamAccount

BLOCK = 1 << 16
MOST_GAPS = 5_000
_AHEAD = 24  # messages of the next block that are looked at with this one, and within which order is mended
_NONE = np.iinfo(np.int64).min
_JUMP_NS = 250_000_000  # a step by which two clocks differ more is a jump, or a message held up
_LONG = 1.5  # periods: a longer step lacks a message
_STALL = 3.5  # periods: a longer step lacks messages, whatever the frame numbers say
_UNEVEN = 0.1  # of a period: stamps that scatter more are smoothed first


class StampCheck:
    """Takes the stamps of one stream.

    Parameters
    ----------
    account : StreamAccount
        Is filled in.
    steady : bool
        Whether times of reception are of a clock that never jumps.
    block : int
        Messages that are looked at together.
    """

    def __init__(self, account: StreamAccount, steady: bool, block: int = BLOCK) -> None:
        self.account, self._steady, self._block = account, steady, block
        self._columns = [array("q") for _ in range(3)]
        self._old = 0  # how many of the block belong to the one before
        self._period = 1e9 / account.expected_hz if account.expected_hz else 0.0
        self._known = bool(self._period)
        self._jitter: list[tuple[int, float]] = []
        self._drifts: list[tuple[float, float]] = []
        self._delays: list[tuple[int, float]] = []

    def add(self, device: int | None, received: int | None = None, number: int | None = None) -> None:
        """Take one message; a stamp that is not there is None."""
        for column, value in zip(self._columns, (device, received, number), strict=True):
            column.append(_NONE if value is None else value)
        if len(self._columns[0]) >= self._block + _AHEAD:
            self._digest(last=False)

    def finish(self) -> None:
        """Nothing more comes."""
        self._digest(last=True)
        account = self.account
        account.rate_hz = 1e9 / self._period if self._period and account.count > 2 else 0.0
        account.jitter_ms = _weighted(self._jitter) * 1e-6
        account.delay_ms = _weighted(self._delays)
        if self._drifts:
            drift, sd = np.array(self._drifts).T
            weight = 1 / np.maximum(sd, 1e-12) ** 2
            account.drift_ppm = 1e6 * float((drift * weight).sum() / weight.sum())
            account.drift_sd_ppm = 1e6 * float(weight.sum() ** -0.5)

    # A block -----------------------------------------------------------------------

    def _digest(self, last: bool) -> None:
        columns = np.array([np.frombuffer(column, np.int64) for column in self._columns])
        n = columns.shape[1]
        if not n:
            return
        stop = n if last else n - _AHEAD
        self.account.count += stop - self._old
        rows = self._in_order(columns)
        device, received, number = columns[:, rows]
        new = rows >= self._old
        self._note_range(device, received, new)
        steps, time = self._steps(device, received)
        if len(steps):
            inside = new[1:] & (rows[1:] < stop)
            self._losses(steps, time, number, inside)
            self._clock(device, received, inside)
        keep = _AHEAD if last else min(2 * _AHEAD, n)
        self._columns = [array("q", column[n - keep :].tobytes()) for column in columns]
        self._old = keep - (n - stop)

    def _in_order(self, columns: np.ndarray) -> np.ndarray:
        """Rows without duplicates, those that came out of order put back; both are counted."""
        stamp = np.where(columns[0] == _NONE, columns[1], columns[0])
        same = np.zeros(len(stamp), bool)
        same[1:] = (stamp[1:] == stamp[:-1]) & (columns[2][1:] == columns[2][:-1])
        self.account.duplicates += int(same[self._old :].sum())
        rows = np.flatnonzero(~same)
        mine = stamp[rows]
        for i in (np.flatnonzero(np.diff(mine) < 0) + 1).tolist():
            ahead = mine[i + 1 : i + 3]
            behind = mine[max(i - _AHEAD, 0) : i]
            if len(ahead) and ahead.max() > mine[i - 1] and (behind < mine[i]).any():
                place = max(i - _AHEAD, 0) + int((behind < mine[i]).nonzero()[0].max()) + 1
                rows[place : i + 1] = np.roll(rows[place : i + 1], 1)
                mine[place : i + 1] = np.roll(mine[place : i + 1], 1)
                self.account.out_of_order += int(rows[place] >= self._old)
        return rows

    def _note_range(self, device: np.ndarray, received: np.ndarray, new: np.ndarray) -> None:
        time = np.where(received == _NONE, device, received)[new]
        time = time[time != _NONE]
        account = self.account
        if len(time):
            low, high = int(time.min()), int(time.max())
            account.first_ns = low if account.first_ns is None else min(account.first_ns, low)
            account.last_ns = high if account.last_ns is None else max(account.last_ns, high)

    def _steps(self, device: np.ndarray, received: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K - 1,) ns between messages, jumps of clocks taken out; and (K,) when each came."""
        here, came = device != _NONE, received != _NONE
        time = np.where(came, received, device)
        step_d = np.where(here[1:] & here[:-1], np.diff(device), _NONE)
        step_r = np.where(came[1:] & came[:-1], np.diff(received), _NONE)
        step = np.where(step_d == _NONE, step_r, step_d)
        both = (step_d != _NONE) & (step_r != _NONE)
        for i in np.flatnonzero(both & (np.abs(step_d - step_r) > _JUMP_NS)).tolist():
            step[i] = self._after_jump(device, received, i, int(step_d[i]), int(step_r[i]))
        for i in np.flatnonzero(step < 0).tolist():
            whose = "computer" if both[i] else self.account.name
            seconds = float(step[i] - self._period) * 1e-9
            self.account.jumps.append(ClockJump(whose, int(time[i]), int(time[i + 1]), seconds))
        step[step < 0] = round(self._period)
        return step, time

    def _after_jump(self, device: np.ndarray, received: np.ndarray, i: int, step_d: int, step_r: int) -> int:
        """The true step where the two clocks disagree."""
        level = (received - device).astype(float)
        good = (received != _NONE) & (device != _NONE)
        before = level[max(i - 9, 0) : i + 1][good[max(i - 9, 0) : i + 1]]
        after = level[i + 1 : i + 11][good[i + 1 : i + 11]]
        if len(after) and abs(after.min() - before.min()) < _JUMP_NS and step_d > 0:
            return step_d  # one was held up on its way
        if self._steady:
            return step_r
        positive = [step for step in (step_d, step_r) if step > 0]
        return min(positive, default=round(self._period))

    # What is missing -----------------------------------------------------------------

    def _losses(self, steps: np.ndarray, time: np.ndarray, number: np.ndarray, inside: np.ndarray) -> None:
        counts = np.where((number[1:] != _NONE) & (number[:-1] != _NONE), np.diff(number), 0)
        counted = (counts > 0) & (counts * self._period < 3 * steps + 1e9)  # a damaged number counts nothing
        self._find_period(steps[inside], np.where(counted, counts, 1)[inside])
        if not self._period:
            return
        error = np.abs(steps / np.where(counted, counts, 1) - self._period)
        usual = inside & (error < 0.5 * self._period)
        jitter = 1.4826 * float(np.median(error[usual])) if usual.any() else 0.0
        self._jitter.append((int(usual.sum()), jitter))
        far = inside & (steps < _LONG * self._period)
        self.account.worst_step_ms = max(
            self.account.worst_step_ms, float(np.abs(steps - self._period)[far].max(initial=0.0)) * 1e-6
        )
        even = steps
        if jitter > _UNEVEN * self._period and not counted.any():
            even = _smoothed(steps, self._period)
        by_time = np.where(even > _LONG * self._period, np.rint(even / self._period) - 1, 0).astype(np.int64)
        long = steps > max(_STALL * self._period, 6 * jitter)
        lost = np.where(counted, np.where(long, np.maximum(counts - 1, by_time), counts - 1), by_time)
        for i in np.flatnonzero(inside & (lost > 0)).tolist():
            self._gap(int(time[i] + self._period), float(lost[i] * self._period), int(lost[i]), even[i])

    def _gap(self, start: int, length: float, lost: int, step: float) -> None:
        account = self.account
        account.lost += lost
        if len(account.gaps) < MOST_GAPS:
            missing = step - self._period
            seconds = missing if abs(missing - length) < 0.75 * self._period else max(missing, length)
            account.gaps.append(Gap(account.name, start, float(max(seconds, 0.0)) * 1e-9, lost))
        else:
            account.more_gaps += 1

    def _find_period(self, steps: np.ndarray, counts: np.ndarray) -> None:
        """The beat, ns: of the first block, near what the manifest says where most steps are near it."""
        positive = steps > 0
        if self._jitter or positive.sum() < 3:
            return
        one = steps[positive] / counts[positive]
        middle = float(np.median(one))
        if self._known and np.mean(np.abs(one - self._period) < 0.3 * self._period) > 0.5:
            middle = self._period
        near = one[np.abs(one - middle) < 0.25 * middle]
        period = float(near.mean()) if len(near) else middle
        exact = one[np.abs(one - period) < 0.05 * period]
        self._period = float(exact.mean()) if len(exact) > 0.5 * len(one) else period

    # Clocks --------------------------------------------------------------------------

    def _clock(self, device: np.ndarray, received: np.ndarray, inside: np.ndarray) -> None:
        good = (device != _NONE) & (received != _NONE)
        if good.sum() < 10 or np.array_equal(device[good], received[good]):
            return
        try:
            clock = fit_clock(device[good], received[good])
        except InputError:
            return
        self._drifts.append((clock.drift, clock.drift_sd))
        self._delays.append((int(good.sum()), clock.delay_ms))
        came = received[1:][inside]
        for jump in clock.jumps:
            if not len(came) or not came.min() <= jump.received_ns <= came.max():
                continue
            before = received[good][received[good] < jump.received_ns]
            after_ns = int(before.max()) if len(before) else jump.received_ns
            whose = "computer" if jump.kind == "computer" and not self._steady else self.account.name
            seconds = jump.size_ns * (-1e-9 if whose == "computer" else 1e-9)
            self.account.jumps.append(ClockJump(whose, after_ns, jump.received_ns, seconds))


def _smoothed(steps: np.ndarray, period: float) -> np.ndarray:
    """Steps (K,) of stamps that may be late but hardly early: of their least excess over the beat."""
    excess = np.concatenate([[0.0], np.cumsum(steps / period - 1)])
    padded = np.concatenate([excess, np.full(_AHEAD - 1, np.inf)])
    least = np.lib.stride_tricks.sliding_window_view(padded, _AHEAD).min(axis=1)
    return (np.diff(least) + 1) * period


def _weighted(values: list[tuple[int, float]]) -> float:
    n = sum(k for k, _ in values)
    return sum(k * value for k, value in values) / n if n else 0.0
