"""The clocks of a recorder: one that never jumps, and the wall clock, which may.

Log times are the wall clock at the start of a recording plus the monotonic time since then: they rise
whatever is done to the wall clock meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Lock

JUMP_S = 0.1
"""A change of the wall clock against the monotonic one that is told, s; slewing changes less."""
_TOGETHER_NS = 1_000_000  # two clocks read within so much are read at once
_TRIES = 20


class Clock:
    """The computer's clocks.

    ``origin_ns`` is the monotonic time at which the recording began; None before.

    Parameters
    ----------
    shift_s : callable, optional
        How far the wall clock has jumped, s, by the seconds since the beginning: for simulated jumps.
    """

    virtual = False

    def __init__(self, shift_s: Callable[[float], float] | None = None) -> None:
        self.origin_ns: int | None = None
        self._shift_s = shift_s

    def _shift_ns(self) -> int:
        return 0 if self._shift_s is None else round(self._shift_s(self.elapsed_s) * 1e9)

    def monotonic_ns(self) -> int:
        """Time that never jumps, ns."""
        return time.monotonic_ns()

    def wall_ns(self) -> int:
        """Time since 1970, ns."""
        return time.time_ns() + self._shift_ns()

    def wait(self, seconds: float) -> None:
        """Let so much time pass."""
        if seconds > 0:
            time.sleep(seconds)

    def begin(self) -> None:
        """The recording begins now."""
        self.origin_ns = self.monotonic_ns()

    @property
    def elapsed_s(self) -> float:
        """Since the recording began, s; below 0 before."""
        return -1.0 if self.origin_ns is None else (self.monotonic_ns() - self.origin_ns) * 1e-9


class VirtualClock(Clock):
    """A clock that goes only where it is put: a recording takes as long as its data need.

    Parameters
    ----------
    start_ns : int, optional
        Wall clock at its beginning, ns since 1970. By default that of the computer.
    shift_s : callable, optional
        As of :class:`Clock`.
    """

    virtual = True

    def __init__(self, start_ns: int | None = None, shift_s: Callable[[float], float] | None = None) -> None:
        super().__init__(shift_s)
        self._now = 10**12
        self._wall_ns = (time.time_ns() if start_ns is None else start_ns) - self._now

    def monotonic_ns(self) -> int:
        """Time that it was put to, ns."""
        return self._now

    def wall_ns(self) -> int:
        """Time since 1970, ns."""
        return self._now + self._wall_ns + self._shift_ns()

    def wait(self, seconds: float) -> None:
        """Go forward by so much, at once."""
        self._now += max(round(seconds * 1e9), 0)

    def advance_to(self, monotonic_ns: int) -> None:
        """Go forward to a time; never back."""
        self._now = max(self._now, monotonic_ns)


class Stamper:
    """Stamps what is received, and notices where the wall clock jumps.

    Parameters
    ----------
    clock : Clock
    on_jump : callable
        Called with the log time (ns) and the signed size (s) of a jump, from any thread.
    """

    def __init__(self, clock: Clock, on_jump: Callable[[int, float], None]) -> None:
        self._clock, self._on_jump, self._lock = clock, on_jump, Lock()
        monotonic, wall = self._both()
        self.started_monotonic_ns, self.started_ns = monotonic, wall
        self._offset = wall - monotonic

    def _both(self) -> tuple[int, int]:
        """Both clocks, read at once; a thread that is put aside in between reads again."""
        for _ in range(_TRIES):
            before = self._clock.monotonic_ns()
            wall = self._clock.wall_ns()
            if self._clock.monotonic_ns() - before < _TOGETHER_NS:
                break
        return before, wall

    def log_ns(self) -> int:
        """The log time of now."""
        return self.started_ns + self._clock.monotonic_ns() - self.started_monotonic_ns

    def stamp(self) -> tuple[int, int]:
        """Log time and wall time of now, ns since 1970."""
        monotonic, wall = self._both()
        log = self.started_ns + monotonic - self.started_monotonic_ns
        with self._lock:
            change, self._offset = (wall - monotonic) - self._offset, wall - monotonic
        if abs(change) > JUMP_S * 1e9:
            self._on_jump(log, change * 1e-9)
        return log, wall
