"""What happened during a recording: events that may still last, and one watch over every stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from threading import RLock
from typing import Any

from acino_fte.data_tools.rig_recording import Event, EventKind

STALL_PERIODS, STALL_S = 5.0, 0.3
"""A stream is silent when nothing came for so many periods, and for so long (s)."""
TOGETHER_S = 1.0
"""Losses of one stream within so much of each other are one event, s."""
ENCODERS = "encoders"
"""Stream of events about the counts that come with the images."""


class EventLog:
    """Events in the order in which they began; each can be changed until it is over. For all threads."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._events: list[Event] = []
        self.changed = False

    def add(self, kind: EventKind, time_ns: int, stream: str = "", **more: Any) -> int:
        """Add an event; its number."""
        with self._lock:
            self._events.append(Event(kind, int(time_ns), stream, **more))
            self.changed = True
            return len(self._events) - 1

    def change(self, number: int, **more: Any) -> None:
        """Change what is known of an event."""
        with self._lock:
            self._events[number] = replace(self._events[number], **more)
            self.changed = True

    def get(self, number: int) -> Event:
        """The event of this number."""
        with self._lock:
            return self._events[number]

    def all(self) -> tuple[Event, ...]:
        """All events, by the times at which they began."""
        with self._lock:
            return tuple(sorted(self._events, key=lambda event: event.time_ns))

    def touch(self) -> None:
        """Something else changed that the manifest tells."""
        with self._lock:
            self.changed = True

    def taken(self) -> bool:
        """Whether anything changed since this was last asked."""
        with self._lock:
            changed, self.changed = self.changed, False
            return changed


class BundledEvent:
    """Losses of one stream that come in quick succession, as one event."""

    def __init__(self, log: EventLog, kind: EventKind, stream: str, detail: str) -> None:
        self._log, self._kind, self._stream, self._detail = log, kind, stream, detail
        self._number: int | None = None
        self._end_ns = 0

    def add(self, begin_ns: int, end_ns: int, count: int) -> None:
        """So many more were lost between two times."""
        if self._number is None or begin_ns - self._end_ns > TOGETHER_S * 1e9:
            self._number = self._log.add(self._kind, begin_ns, self._stream, detail=self._detail)
        event = self._log.get(self._number)
        self._end_ns = end_ns
        self._log.change(self._number, count=event.count + count, seconds=(end_ns - event.time_ns) * 1e-9)


class Watch:
    """Watches one stream: silence, loss by the device's numbers and clock, numbers that come twice.

    A silence begins when the first sample that did not come was due, one period after the last one, and ends
    when one comes. Both are known to a period.

    Parameters
    ----------
    stream : str
    expected_hz : float
    log : EventLog
    started_ns : int
        Log time at which the stream is expected to begin.
    on_demand : bool
        Samples are asked for (:meth:`asked`): their times tell nothing of losses, how many came does.
    """

    def __init__(
        self, stream: str, expected_hz: float, log: EventLog, started_ns: int, on_demand: bool = False
    ) -> None:
        self._on_demand = on_demand
        self._owing = self._owed = self._told = 0  # samples that were asked for: now, at the last, told lost
        self.stream, self._log, self._lock = stream, log, RLock()
        self._period_ns = 1e9 / expected_hz
        self._limit_ns = max(STALL_PERIODS * self._period_ns, STALL_S * 1e9)
        self._last_ns = started_ns - round(self._period_ns)
        self._number: int | None = None
        self._device_ns: int | None = None
        self._silence: int | None = None  # the event that lasts
        self.received = 0
        self._lost = BundledEvent(log, "lost", stream, "the device's own numbers or times have gaps")
        self._twice = BundledEvent(log, "lost", stream, "numbers came twice; nothing is missing")

    def asked(self) -> None:
        """A sample was asked for."""
        with self._lock:
            self._owing += 1

    def received_at(self, log_ns: int, number: int | None, device_ns: int) -> None:
        """A sample came."""
        with self._lock:
            self.received += 1
            gap = log_ns - self._last_ns
            if self._silence is None and gap > self._limit_ns:
                self._begin("stall")
            if self._silence is not None:
                self._end(log_ns, self._missing(number, device_ns, by_time=True))
                self._owing = self._owed
            elif (missing := self._deficit() if self._on_demand else self._missing(number, device_ns)) > 0:
                end = log_ns - round(self._on_demand * self._period_ns)  # noticed a sample later
                self._lost.add(end - round(missing * self._period_ns), end, missing)
            elif missing < 0:
                self._twice.add(log_ns, log_ns, 0)
            self._last_ns, self._number, self._device_ns = log_ns, number, device_ns

    def _deficit(self) -> int:
        """Samples that were asked for and did not come; one that is late once is not missing."""
        before, self._owing = self._owed, self._owing - 1
        self._owed = self._owing
        new = min(before, self._owed) - self._told
        self._told += max(new, 0)
        return max(new, 0)

    def _missing(self, number: int | None, device_ns: int, by_time: bool = False) -> int:
        """Samples between the last one and this; -1 where its number came before."""
        if self._device_ns is None or device_ns < self._device_ns:
            return 0  # the first, or the device began anew
        between = round((device_ns - self._device_ns) / self._period_ns) - 1
        if number is None or self._number is None:
            return max(between, 0) if device_ns > self._device_ns else -1
        counted = number - self._number - 1
        return max(counted, between, 0) if by_time else counted if number >= self._number else 0

    def check(self, now_ns: int) -> None:
        """Notice a silence while it lasts."""
        with self._lock:
            if self._silence is None and now_ns - self._last_ns > self._limit_ns + self._period_ns:
                self._begin("stall")

    def gone(self, now_ns: int, detail: str) -> None:
        """The device is gone; its stream begins anew."""
        with self._lock:
            if self._silence is None:
                self._begin("unplugged", detail, now_ns)
            else:
                self._log.change(self._silence, kind="unplugged", detail=detail)
            self._number = self._device_ns = None

    def _begin(self, kind: EventKind, detail: str = "nothing came", now_ns: int | None = None) -> None:
        begin = self._last_ns + round(self._period_ns)
        begin = begin if now_ns is None else min(begin, now_ns)
        self._silence = self._log.add(kind, begin, self.stream, detail=f"{detail}; it still lasts")

    def _end(self, now_ns: int, missing: int) -> None:
        if self._silence is None:
            return
        event = self._log.get(self._silence)
        seconds = max(now_ns - event.time_ns, 0) * 1e-9
        if event.kind == "unplugged" or self._device_ns is None:
            missing = max(round((now_ns - self._last_ns) / self._period_ns) - 1, 0)
        detail = event.detail.removesuffix("; it still lasts")
        if event.kind == "stall" and not missing:
            detail = "late, but nothing is missing"
        self._log.change(self._silence, seconds=seconds, count=missing, detail=detail)
        self._silence = None

    def close(self, now_ns: int) -> None:
        """The recording ends: so does a silence that lasts."""
        with self._lock:
            if self._silence is not None:
                event = self._log.get(self._silence)
                seconds = max(now_ns - event.time_ns, 0) * 1e-9
                missing = round(seconds * 1e9 / self._period_ns)
                detail = event.detail.replace("it still lasts", "until the end")
                self._log.change(self._silence, seconds=seconds, count=missing, detail=detail)
                self._silence = None

    @property
    def silent(self) -> bool:
        """Whether nothing comes at the moment."""
        return self._silence is not None


class LensWatch:
    """Watches zoom and focus: within the tolerance of where they were when the recording began?

    Parameters
    ----------
    rings : sequence of (int, str, float)
        Place of each in the counts, its name, its tolerance in counts.
    camera : str
        Whose lens it is.
    """

    def __init__(self, rings: Sequence[tuple[int, str, float]], camera: str, log: EventLog) -> None:
        self._rings, self._camera, self._log = list(rings), camera, log
        self._home: dict[str, int] = {}
        self._away: dict[str, int] = {}
        self._unknown: int | None = None

    def seen(self, log_ns: int, counts: Sequence[int]) -> None:
        """Counts that came with an image; none where nothing is known of the encoders."""
        if self._home and not counts and self._unknown is None:
            detail = "nothing tells where the lens is; it still lasts"
            self._unknown = self._log.add("stall", log_ns, ENCODERS, detail=detail)
        elif counts and self._unknown is not None:
            self._known(log_ns)
        for place, name, tolerance in self._rings:
            if place >= len(counts):
                continue
            off = counts[place] - self._home.setdefault(name, counts[place])
            if abs(off) > tolerance and name not in self._away:
                self._away[name] = self._log.add(
                    "lens_moved", log_ns, self._camera,
                    detail=f"{name} is {off:+d} counts off: the calibration does not hold until it is back",
                )  # fmt: skip
            elif abs(off) <= tolerance and name in self._away:
                self._end(name, log_ns)
                self._log.add(
                    "lens_back", log_ns, self._camera, detail=f"{name} is back within its tolerance"
                )

    def _known(self, log_ns: int) -> None:
        if self._unknown is not None:
            seconds = (log_ns - self._log.get(self._unknown).time_ns) * 1e-9
            self._log.change(self._unknown, seconds=seconds, detail="nothing told where the lens is")
            self._unknown = None

    def _end(self, name: str, log_ns: int) -> None:
        number = self._away.pop(name)
        self._log.change(number, seconds=(log_ns - self._log.get(number).time_ns) * 1e-9)

    def close(self, now_ns: int) -> None:
        """The recording ends."""
        self._known(now_ns)
        for name in list(self._away):
            self._end(name, now_ns)

    @property
    def moved(self) -> bool:
        """Whether the calibration does not hold at the moment, or nothing is known of it."""
        return bool(self._away) or self._unknown is not None
