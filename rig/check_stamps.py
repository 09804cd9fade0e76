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
_AHEAD = 128  # messages of the next block that are looked at with this one, and within which order is mended
_NONE = np.iinfo(np.int64).min
_JUMP_NS = 250_000_000  # a step by which two clocks differ more is a jump, or a message held up
_LONG = 1.5  # periods: a longer step lacks a message
_STALL = 3.5  # periods: a longer step lacks messages, whatever the frame numbers say
_UNEVEN = 0.1  # of a period: stamps that scatter more are smoothed first
_FAR = 64  # messages from which to which the period of scattering stamps is found
_LEVEL = 15, 4000  # messages, least and most, by which the delay before and after a jump is known


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
        _fill_device(columns[0], columns[1])
        n = columns.shape[1]
        if not n:
            return
        stop = n if last else n - _AHEAD
        self.account.count += stop - self._old
        rows = self._in_order(columns, stop)
        device, received, number = columns[:, rows]
        new = rows >= self._old
        self._note_range(device, received, new)
        inside = new[1:] & (rows[1:] < stop)
        if len(inside):
            steps, time = self._steps(device, received, inside)
            self._losses(steps, time, number, inside, _only_received(device, received))
            self._clock(device, received, inside)
        keep = _AHEAD if last else min(2 * _AHEAD, n)
        self._columns = [array("q", column[n - keep :].tobytes()) for column in columns]
        self._old = keep - (n - stop)

    def _in_order(self, columns: np.ndarray, stop: int) -> np.ndarray:
        """Rows without duplicates, those that came out of order put back; both are counted."""
        stamp = np.where(columns[0] == _NONE, columns[1], columns[0])
        same = np.zeros(len(stamp), bool)
        if not _only_received(columns[0], columns[1]) or (columns[2] != _NONE).all():
            same[1:] = (stamp[1:] == stamp[:-1]) & (columns[2][1:] == columns[2][:-1])
        self.account.duplicates += int(same[self._old : stop].sum())
        rows = np.flatnonzero(~same)
        mine = stamp[rows]
        for i in (np.flatnonzero(np.diff(mine) < 0) + 1).tolist():
            ahead = mine[i + 1 : i + 3]
            behind = mine[max(i - _AHEAD, 0) : i]
            if len(ahead) and ahead.max() > mine[i - 1] and (behind < mine[i]).any():
                place = max(i - _AHEAD, 0) + int((behind < mine[i]).nonzero()[0].max()) + 1
                rows[place : i + 1] = np.roll(rows[place : i + 1], 1)
                mine[place : i + 1] = np.roll(mine[place : i + 1], 1)
                self.account.out_of_order += int(self._old <= rows[place] < stop)
        return rows

    def _note_range(self, device: np.ndarray, received: np.ndarray, new: np.ndarray) -> None:
        time = np.where(received == _NONE, device, received)[new]
        time = time[time != _NONE]
        account = self.account
        if len(time):
            low, high = int(time.min()), int(time.max())
            account.first_ns = low if account.first_ns is None else min(account.first_ns, low)
            account.last_ns = high if account.last_ns is None else max(account.last_ns, high)

    def _steps(
        self, device: np.ndarray, received: np.ndarray, inside: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(K - 1,) ns between messages, jumps of clocks taken out; and (K,) when each came."""
        here, came = device != _NONE, received != _NONE
        time = np.where(came, received, device)
        step_d = np.where(here[1:] & here[:-1], np.diff(device), _NONE)
        step_r = np.where(came[1:] & came[:-1], np.diff(received), _NONE)
        step = np.where(step_d == _NONE, step_r, step_d)
        both = (step_d != _NONE) & (step_r != _NONE)
        usual = self._period or float(np.median(step[step > 0])) if (step > 0).any() else 0.0
        for i in np.flatnonzero(both & (np.abs(step_d - step_r) > _JUMP_NS)).tolist():
            by_device, by_computer = int(step_d[i]), int(step_r[i])
            apart = by_device - by_computer
            if abs(_level_shift(device, received, i, abs(apart))) < 0.5 * abs(apart) and by_device > 0:
                continue  # a message was held up on its way
            if self._steady or abs(by_device - usual) > abs(by_computer - usual):
                step[i] = by_computer
            if inside[i]:
                self._jump(not self._steady and step[i] == by_device, int(time[i]), int(time[i + 1]), apart)
        for i in np.flatnonzero(step < 0).tolist():
            if inside[i]:
                moved = int(step[i] - usual)
                self._jump(bool(both[i]), int(time[i]), int(time[i + 1]), -moved if both[i] else moved)
            step[i] = round(usual)
        return step, time

    def _jump(self, computer: bool, after_ns: int, time_ns: int, size_ns: int) -> None:
        """Note a jump, or its size anew; `size_ns`: by how much the device went ahead of the computer."""
        whose = "computer" if computer else self.account.name
        seconds = size_ns * (-1e-9 if computer else 1e-9)
        for known in self.account.jumps:
            near = abs(known.time_ns - time_ns) < max(_JUMP_NS, 3 * self._period)
            if near and abs(known.seconds - seconds) < max(0.1, 0.1 * abs(seconds)):
                known.seconds = seconds
                return
        self.account.jumps.append(ClockJump(whose, after_ns, time_ns, seconds))

    # What is missing -----------------------------------------------------------------

    def _losses(
        self, steps: np.ndarray, time: np.ndarray, number: np.ndarray, inside: np.ndarray, late: bool
    ) -> None:
        """Count what is missing; `late`: stamps are those of reception."""
        counts = np.where((number[1:] != _NONE) & (number[:-1] != _NONE), np.diff(number), 0)
        beat = self._period or float(np.median(steps))
        counted = (counts > 0) & (counts * beat < 3 * steps + 1e9)  # a damaged number counts nothing
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
        if (late or jitter > _UNEVEN * self._period) and not counted.any():
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
        if len(exact) < 0.8 * len(one) and len(steps) > 4 * _FAR:
            passed = np.concatenate([[0.0], np.cumsum(steps / counts)])
            far = float(np.median(passed[_FAR:] - passed[:-_FAR])) / _FAR
            self._period = far if abs(far / period - 1) < 0.1 else self._period

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
        came, rows = received[1:][inside], np.flatnonzero(good)
        for jump in clock.jumps:
            if not len(came) or not came.min() <= jump.received_ns <= came.max():
                continue
            i = int(rows[np.searchsorted(received[rows], jump.received_ns)]) - 1
            shift = _level_shift(device, received, max(i, 0), abs(jump.size_ns))
            if abs(shift + jump.size_ns) > 0.5 * abs(jump.size_ns):
                continue  # messages were held up
            before = received[good][received[good] < jump.received_ns]
            after_ns = int(before.max()) if len(before) else jump.received_ns
            self._jump(jump.kind == "computer" and not self._steady, after_ns, jump.received_ns, jump.size_ns)


def _fill_device(device: np.ndarray, received: np.ndarray) -> None:
    """Give messages without a stamp of the device (K,) one by when they were received."""
    known = np.flatnonzero(device != _NONE)
    missing = np.flatnonzero((device == _NONE) & (received != _NONE))
    if len(known) and len(missing):
        last = known[np.clip(np.searchsorted(known, missing) - 1, 0, None)]
        device[missing] = device[last] + received[missing] - received[last]


def _only_received(device: np.ndarray, received: np.ndarray) -> bool:
    """Whether the times of reception are all there is."""
    return not (device != _NONE).any() or np.array_equal(device, received)


def _level_shift(device: np.ndarray, received: np.ndarray, i: int, size: int) -> float:
    """By how much the least delay differs behind row `i` from that up to it, ns, where it may be by `size`.

    Messages that were held up come with less and less delay again; a clock that goes back tells of itself.
    """
    step_d, step_r = np.diff(device), np.diff(received)
    n = int(np.clip(10 * size / max(float(np.median(np.abs(step_d))), 1.0), *_LEVEL))
    level = (received - device).astype(float)
    back = np.flatnonzero((step_d < -_JUMP_NS) | (step_r < -_JUMP_NS))
    if i in back:
        return float(level[i + 1] - level[i])
    later = back[back > i]
    stop = min(i + 1 + n, int(later[0]) + 1 if len(later) else len(level))
    after, span = level[i + 1 : stop], float(device[stop - 1] - device[i + 1])
    if span < size and after[0] - after.min() > 0.3 * span:
        return 0.0  # held up, and the messages end before the delay did
    return float(after.min() - level[max(i + 1 - n, 0) : i + 1].min())


def _smoothed(steps: np.ndarray, period: float) -> np.ndarray:
    """Steps (K,) of stamps that may be late but hardly early: of their least excess over the beat."""
    excess = np.concatenate([[0.0], np.cumsum(steps / period - 1)])
    padded = np.concatenate([excess, np.full(_AHEAD - 1, np.inf)])
    least = np.lib.stride_tricks.sliding_window_view(padded, _AHEAD).min(axis=1)
    return (np.diff(least) + 1) * period


def _weighted(values: list[tuple[int, float]]) -> float:
    n = sum(k for k, _ in values)
    return sum(k * value for k, value in values) / n if n else 0.0
