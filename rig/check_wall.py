"""The computer's wall clock against its monotonic one: jumps, and how fast it is slewed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from acino_fte.rig.check_types import ClockJump

_WALL_NS = 20_000_000  # steps that are told
_NEAR_NS, _SAME_S = 500_000_000, 0.1  # jumps of two streams that are one


class WallClock:
    """The computer's wall clock against its monotonic one, by the messages of one stream.

    A step counts as a jump when the message after it agrees.
    """

    def __init__(self) -> None:
        self.jumps: list[ClockJump] = []
        self.n = 0
        self._last: tuple[int, int] | None = None
        self._first: tuple[int, int] | None = None
        self._maybe: tuple[int, int, int] | None = None

    def add(self, monotonic_ns: int, wall_ns: int) -> None:
        """Take one message, in the order of the stream."""
        self.n += 1
        offset = wall_ns - monotonic_ns
        if self._last is None:
            self._first = self._last = monotonic_ns, offset
            return
        time, before = self._last
        if abs(offset - before) <= _WALL_NS:
            self._last, self._maybe = (max(monotonic_ns, time), offset), None
        elif self._maybe is None or abs(offset - self._maybe[2]) > _WALL_NS:
            self._maybe = time, monotonic_ns, offset
        else:
            after, at, _ = self._maybe
            self.jumps.append(ClockJump("wall clock", after, at, (offset - before) * 1e-9))
            self._last, self._maybe = (max(monotonic_ns, at), offset), None

    @property
    def seconds(self) -> float:
        """From the first message to the last."""
        return (self._last[0] - self._first[0]) * 1e-9 if self._first and self._last else 0.0

    @property
    def slew_ppm(self) -> float | None:
        """How much faster than the monotonic clock it ran between jumps; None of less than a second."""
        if self._first is None or self._last is None or self.seconds < 1.0:
            return None
        moved = self._last[1] - self._first[1] - sum(jump.seconds for jump in self.jumps) * 1e9
        return 1e-3 * moved / self.seconds


@dataclass
class WallAccount:
    """The wall clock by all streams: messages with both stamps, jumps, and its slew by the longest stream."""

    n: int = 0
    jumps: list[ClockJump] = field(default_factory=list)
    slew_ppm: float | None = None


def wall_account(clocks: Iterable[WallClock]) -> WallAccount:
    """Put together what streams show. A jump lies between the last message before it and the first after."""
    known = sorted(clocks, key=lambda clock: -clock.seconds)
    found: list[ClockJump] = []
    for jump in sorted((jump for clock in known for jump in clock.jumps), key=lambda jump: jump.after_ns):
        for one in found:
            together = jump.after_ns < one.time_ns + _NEAR_NS and one.after_ns < jump.time_ns + _NEAR_NS
            if together and abs(one.seconds - jump.seconds) < _SAME_S:
                one.time_ns = min(one.time_ns, jump.time_ns)
                one.after_ns = min(max(one.after_ns, jump.after_ns), one.time_ns)
                break
        else:
            found.append(jump)
    slew = known[0].slew_ppm if known else None
    return WallAccount(sum(clock.n for clock in known), found, slew)
