"""The clock of a device against that of the computer which received its messages.

Model: received = offset + (1 + drift) · device + delay, with delay ≥ 0 and a heavy tail. The line is the one
below all points that is nearest to them in the sum of distances: the linear programme of Moon, Skelly and
Towsley (1999, "Estimation and removal of clock skew from network delay measurements"), which is the maximum
of the likelihood of exponential delays. Its solution is an edge of the lower convex hull (Zhang, Liu and Xia
2002). Where the device's clock jumps, the line has several pieces with an offset each and one drift, the
crystal's.

What no stamps can tell is the shortest delay: it counts as zero. Times are int64 nanoseconds throughout;
only differences from the origin of a piece become floats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from acino_fte.data_tools.clock_jumps import LEAST_JUMP_NS, Piece, find_pieces
from acino_fte.errors import InputError

JumpKind = Literal["restart", "wrap", "device", "computer"]
_MEAN, _SD, _SLOPE_SD = 1.8, 1.4, 3.5
"""Mean and standard deviation of the line's error at the middle, and that of its rise over half the length,
in units of (mean delay / number of points): by simulation of exponential delays at even times."""
_MAX_DRIFT = 2e-3
_HELD_UP = 30.0  # mean delays: messages that came later may belong to the stretch before
_COUNTERS = {2**32: "32-bit counter", 2**31: "31-bit counter"}
_TICKS_NS = (1, 10, 100, 1000, 1_000_000)


@dataclass(frozen=True)
class Jump:
    """A jump of one of the two clocks.

    Attributes
    ----------
    received_ns : int
        When, by the computer's clock: of the first message after it.
    size_ns : int
        By how much the device's clock went ahead of the computer's; negative when it fell behind, as one
        that starts again from zero.
    kind : str
        ``"restart"`` (the device's clock went back), ``"wrap"`` (by the range of a counter), ``"device"``
        (another jump of the device's clock), ``"computer"`` (the device went on evenly, the computer jumped).
    """

    received_ns: int
    size_ns: int
    kind: JumpKind

    def __str__(self) -> str:
        whose = "computer's clock" if self.kind == "computer" else "device's clock"
        size = -self.size_ns if self.kind == "computer" else self.size_ns
        return f"the {whose} jumped by {size * 1e-9:+.3f} s ({self.kind})"


@dataclass(frozen=True)
class ClockPiece:
    """One stretch without a jump: computer = base + (device - origin) · (1 + drift).

    Attributes
    ----------
    device_ns, received_ns : tuple of int
        First and last stamp by either clock.
    origin_ns, base_ns : int
        The origin by the device's clock, and what the computer's showed then.
    n : int
        Messages that it was fitted to.
    sd_ms : float
        Standard deviation of the computer's time, at worst in this stretch.
    """

    device_ns: tuple[int, int]
    received_ns: tuple[int, int]
    origin_ns: int
    base_ns: int
    n: int
    sd_ms: float

    def at(self, device_ns: np.ndarray, drift: float) -> np.ndarray:
        """Computer's time (…) int64 of stamps of the device."""
        since = device_ns - self.origin_ns
        return self.base_ns + since + np.rint(drift * since.astype(float)).astype(np.int64)


@dataclass(frozen=True)
class DeviceClock:
    """A device's clock as :func:`fit_clock` found it.

    Attributes
    ----------
    drift, drift_sd : float
        Relative: 1e-6 is one part in a million, positive when the device's clock is slow.
    pieces : tuple of ClockPiece
        In the order in which they were received; one where there was no jump.
    jumps : tuple of Jump
        Between the pieces.
    delay_ms : float
        Median delay beyond the shortest.
    n_duplicates, n_outliers : int
        Messages that were left out: a stamp that was there already; received too early for the others, or
        while all were held up.
    """

    drift: float
    drift_sd: float
    pieces: tuple[ClockPiece, ...]
    jumps: tuple[Jump, ...] = ()
    delay_ms: float = 0.0
    n_duplicates: int = 0
    n_outliers: int = 0

    @property
    def sd_ms(self) -> float:
        """Standard deviation of a time, ms, at worst; that of the shortest delay is not in it."""
        return max(piece.sd_ms for piece in self.pieces)

    @property
    def is_computers(self) -> bool:
        """Whether the device's stamps are in the computer's own time: less than 1 s before their reception,
        without jumps or drift."""
        offset = self.pieces[0].base_ns - self.pieces[0].origin_ns
        even = abs(self.drift) < 2e-6 + 4 * self.drift_sd
        return len(self.pieces) == 1 and even and -1_000_000 <= offset < 1_000_000_000

    def to_computer_ns(
        self, device_ns: np.ndarray | int, received_ns: np.ndarray | int | None = None
    ) -> np.ndarray:
        """Computer's times (…), int64 ns, of stamps of the device (…).

        Parameters
        ----------
        device_ns : (…) int64
            Stamps of the device.
        received_ns : (…) or scalar int64, optional
            When the messages came. It tells the pieces apart where a clock that restarted shows a time twice.

        Raises
        ------
        InputError
            A stamp lies in two pieces and `received_ns` is not given; or a stamp is no integer.
        """
        device = _integers(device_ns, "device_ns")
        if len(self.pieces) == 1:
            return self.pieces[0].at(device, self.drift)
        received = None if received_ns is None else _integers(received_ns, "received_ns")
        which = self._piece_of(device, received)
        out = np.empty_like(device)
        for i, piece in enumerate(self.pieces):
            mine = which == i
            out[mine] = piece.at(device[mine], self.drift)
        return out

    def _piece_of(self, device: np.ndarray, received: np.ndarray | None) -> np.ndarray:
        """The piece that has a stamp, or the nearest; of several, that with the shortest delay."""
        first = np.array([piece.device_ns[0] for piece in self.pieces])
        last = np.array([piece.device_ns[1] for piece in self.pieces])
        beyond = np.maximum(np.maximum(first - device[..., None], device[..., None] - last), 0)
        several = (beyond == 0).sum(-1) > 1
        if not several.any():
            return beyond.argmin(-1)
        if received is None:
            raise InputError(
                "The device's clock showed these times twice.",
                key="device_ns",
                expected="stamps of one stretch between jumps, or when each message was received",
                found="; ".join(map(str, self.jumps)),
                remedy="give received_ns as well",
            )
        times = np.stack([piece.at(device, self.drift) for piece in self.pieces], axis=-1)
        delay = (received[..., None] - times).astype(float)
        early = delay < -max(3e6 * self.sd_ms, 1e6)
        delay = np.where(early, 1e18 - delay, delay)
        return np.where(several, np.where(beyond == 0, delay, np.inf).argmin(-1), beyond.argmin(-1))


def same_clock() -> DeviceClock:
    """The clock of a device that shows the computer's time, or of one that is the only clock there is."""
    piece = ClockPiece((0, 0), (0, 0), 0, 0, 0, 0.0)
    return DeviceClock(0.0, 0.0, (piece,))


def offset_clock(device_ns: np.ndarray, received_ns: np.ndarray, sd_ms: float) -> DeviceClock:
    """A clock without drift, of too few messages (K,) to fit one: the shortest delay counts as zero."""
    device, received = _integers(device_ns, "device_ns"), _integers(received_ns, "received_ns")
    i = int((received - device).argmin())
    stretch = (int(device.min()), int(device.max())), (int(received.min()), int(received.max()))
    piece = ClockPiece(*stretch, int(device[i]), int(received[i]), len(device), sd_ms)
    return DeviceClock(0.0, 0.0, (piece,))


def fit_clock(device_ns: np.ndarray, received_ns: np.ndarray, *, jumps: bool = True) -> DeviceClock:
    """Fit a device's stamps to the times at which its messages were received.

    Parameters
    ----------
    device_ns, received_ns : (K,) int64
        Of every message, in the order of the recording. K ≥ 3.
    jumps : bool
        Whether the clock can jump. One that counts events cannot.

    Raises
    ------
    InputError
        There are fewer than three messages with stamps of their own, the stamps are no integers, or the
        device's clock stands still.
    """
    device, received = _integers(device_ns, "device_ns"), _integers(received_ns, "received_ns")
    if device.ndim != 1 or device.shape != received.shape:
        raise InputError(
            "Stamps of the device and times of reception do not belong together.",
            expected="one of each for every message",
            found=f"shapes {device.shape} and {received.shape}",
        )
    fresh = np.ones(len(device), dtype=bool)
    fresh[1:] = device[1:] != device[:-1]
    if fresh.sum() < 3:
        raise InputError(
            "The device's clock cannot be fitted.",
            key="device_ns",
            expected="three or more messages with stamps of their own",
            found=f"{int(fresh.sum())} of {len(device)} messages",
            remedy="use the times of reception",
        )
    rows = np.flatnonzero(fresh)
    pieces, n_late = find_pieces(device[rows], received[rows], jumps)
    while True:
        drift, drift_sd, lines, delay = _fit_lines(device[rows], received[rows], pieces)
        found = _jumps(lines, drift, device[rows], received[rows], pieces)
        small = [i for i, jump in enumerate(found) if abs(jump.size_ns) < _least_jump(lines[i : i + 2])]
        if not small:
            break
        i = small[0]
        pieces[i : i + 2] = [Piece(np.concatenate([pieces[i].rows, pieces[i + 1].rows]))]
    return DeviceClock(
        drift=drift,
        drift_sd=drift_sd,
        pieces=lines,
        jumps=found,
        delay_ms=float(np.median(delay)) * 1e-6,
        n_duplicates=int((~fresh).sum()),
        n_outliers=n_late,
    )


def _integers(values: np.ndarray | int | Sequence[int], key: str) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind not in "iu":
        raise InputError(
            "Times must be whole nanoseconds.",
            key=key,
            expected="64-bit integers",
            found=str(array.dtype),
            remedy="a float has no room for nanoseconds since 1970",
        )
    return array.astype(np.int64)


@dataclass(frozen=True, eq=False)
class _Points:
    """Messages of one piece, from its first: x (K,) device's time, y (K,) received less device's, ns."""

    rows: np.ndarray
    origin: int
    base: int
    x: np.ndarray
    y: np.ndarray

    @property
    def half(self) -> float:
        """Half the length, ns."""
        return max(float(np.ptp(self.x)) / 2, 1.0)


def _points(device: np.ndarray, received: np.ndarray, piece: Piece) -> _Points:
    origin, base = device[piece.rows[0]], received[piece.rows[0]]
    x = device[piece.rows] - origin
    y = (received[piece.rows] - base) - x
    return _Points(piece.rows, int(origin), int(base), x.astype(float), y.astype(float))


def _fit_lines(
    device: np.ndarray, received: np.ndarray, pieces: Sequence[Piece]
) -> tuple[float, float, tuple[ClockPiece, ...], np.ndarray]:
    """Drift, its standard deviation, the pieces, and all delays beyond the shortest (K,), ns."""
    points = [_points(device, received, piece) for piece in pieces]
    drift = _drift([(one.x, one.y) for one in points])
    residuals, means = [], []
    for one in points:
        above = one.y - drift * one.x
        residuals.append(above - above.min())
        means.append(_mean_delay(residuals[-1]))
    drift_sd = _SLOPE_SD / sum(len(one.x) * one.half / mean for one, mean in zip(points, means, strict=True))
    lines = []
    for one, residual, mean in zip(points, residuals, means, strict=True):
        n = len(one.x)
        low = float((one.y - drift * one.x).min()) - (_MEAN * mean / n if n > 10 else 0.0)
        terms = mean * _SD / n, _wander(residual, mean), drift_sd * one.half
        mine, came = device[one.rows[residual <= _HELD_UP * mean]], received[one.rows]
        lines.append(
            ClockPiece(
                device_ns=(int(mine.min()), int(mine.max())),
                received_ns=(int(came[0]), int(came[-1])),
                origin_ns=one.origin,
                base_ns=one.base + round(low),
                n=n,
                sd_ms=float(np.linalg.norm(terms)) * 1e-6,
            )
        )
    return drift, drift_sd, tuple(lines), np.concatenate(residuals)


def _drift(points: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """The drift b that minimises Σ_pieces n (mean(y - b x) - min(y - b x)), which is convex in b."""
    from scipy.optimize import minimize_scalar

    hulls = [_lower_hull(x, y) for x, y in points]
    means = [(len(x), float(x.mean()), float(y.mean())) for x, y in points]

    def cost(b: float) -> float:
        total = 0.0
        for (x, y), (n, mean_x, mean_y) in zip(hulls, means, strict=True):
            total += n * (mean_y - b * mean_x - float((y - b * x).min()))
        return total

    slopes = np.unique(
        np.concatenate([np.diff(y) / np.diff(x) for x, y in hulls if len(x) > 1] or [np.zeros(1)])
    )
    slopes = slopes[np.abs(slopes) <= _MAX_DRIFT]
    if len(slopes) == 0:
        return float(minimize_scalar(cost, bounds=(-_MAX_DRIFT, _MAX_DRIFT), method="bounded").x)
    low, high = 0, len(slopes) - 1  # the minimum of a convex, piecewise linear function is at a corner
    while high - low > 2:
        third = (high - low) // 3
        a, b = low + third, high - third
        if cost(slopes[a]) <= cost(slopes[b]):
            high = b
        else:
            low = a
    return float(min(slopes[low : high + 1], key=cost))


def _lower_hull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the lower convex hull of points, by rising x (Andrew 1979)."""
    order = np.lexsort((y, x))
    hull: list[tuple[float, float]] = []
    last = None
    for px, py in zip(x[order].tolist(), y[order].tolist(), strict=True):
        if px == last:
            continue
        last = px
        while len(hull) > 1:
            (ax, ay), (bx, by) = hull[-2], hull[-1]
            if (by - ay) * (px - bx) < (py - by) * (bx - ax):
                break
            hull.pop()
        hull.append((px, py))
    xs, ys = zip(*hull, strict=True)
    return np.array(xs), np.array(ys)


def _mean_delay(residual: np.ndarray) -> float:
    """Mean of the exponential that the smallest delays are of, ns: its rate is their density at zero."""
    n = len(residual)
    k = min(n - 1, max(n // 10, 10))
    return max(float(np.partition(residual, k)[k]) * n / max(k - 1, 1), 1.0)


def _wander(residual: np.ndarray, mean: float) -> float:
    """How far the least delays of stretches of time lie apart, beyond what chance makes of them, ns."""
    n_blocks = min(len(residual) // 5, 40)
    if n_blocks < 4:
        return 0.0
    least = np.array([block.min() for block in np.array_split(residual, n_blocks)])
    spread = 1.4826 * float(np.median(np.abs(least - np.median(least))))
    return float(np.sqrt(max(spread**2 - (mean * n_blocks / len(residual)) ** 2, 0.0)))


def _jumps(
    pieces: Sequence[ClockPiece],
    drift: float,
    device: np.ndarray,
    received: np.ndarray,
    parts: Sequence[Piece],
) -> tuple[Jump, ...]:
    out = []
    step = float(np.median(np.abs(np.diff(device))))
    for before, after, a, b in zip(pieces, pieces[1:], parts, parts[1:], strict=False):
        predicted = int(before.at(np.array(after.origin_ns), drift))
        size = round((predicted - after.base_ns) / (1 + drift))
        d_device = int(device[b.rows[0]]) - int(device[a.rows[-1]])
        d_received = int(received[b.rows[0]]) - int(received[a.rows[-1]])
        out.append(Jump(int(received[b.rows[0]]), size, _kind(size, d_device, d_received, step)))
    return tuple(out)


def _least_jump(lines: Sequence[ClockPiece]) -> float:
    """What a jump between two pieces must exceed, ns."""
    return max(LEAST_JUMP_NS, 3e6 * float(np.hypot(lines[0].sd_ms, lines[1].sd_ms)))


def _kind(size: int, d_device: int, d_received: int, step: float) -> JumpKind:
    for counts in _COUNTERS:
        for tick in _TICKS_NS:
            if abs(size + counts * tick) < min(0.01 * counts * tick, 0.1e9):
                return "wrap"
    if d_device < 0:
        return "restart"
    if abs(d_device - step) < 0.5 * step and abs(d_received - step) > abs(d_device - step):
        return "computer"
    return "device"
