"""A simulated rig: cameras, lidars with inertial sensors and encoders, on a clock, with settable faults."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import inf

import numpy as np

from acino_fte.rig.faults import Fault, wall_shift_s
from acino_fte.rig.recorder_clock import Clock, VirtualClock
from acino_fte.rig.rig_file import RigFile
from acino_fte.rig.sources import DeviceGone, Sample, SourceStream

BUFFER_S = 0.5
"""What a simulated device keeps for a reader that is late; older samples are lost, as of real ones."""
_LATENCY_S, _LATEST_S = 3e-4, 3e-3  # on average, at most
_BOOT_NS = 5_000_000_000  # from power-on until it answers


class Timetable:
    """When the samples of one stream are due. Sample k belongs at k periods after the start.

    Parameters
    ----------
    stream : SourceStream
    faults : sequence of Fault
        Those of this stream.
    seed : int
        Of the delays.
    """

    def __init__(self, stream: SourceStream, faults: Sequence[Fault], seed: int) -> None:
        self.stream = stream
        self._period = 1.0 / stream.expected_hz
        self._stalls = [f for f in faults if f.kind == "stall"]
        self._losses = [[f.at_s, f.amount] for f in faults if f.kind == "lost"]  # from when on, how many left
        delays = np.random.default_rng(seed).exponential(_LATENCY_S, 997)
        self._delays = np.minimum(delays, _LATEST_S).tolist()
        self.start_ns = self.k = 0
        self.triggers: deque[int] | None = None  # times, where frames are cut on demand

    def restart(self, now_ns: int) -> None:
        """Sample 0 is due now."""
        self.start_ns, self.k = now_ns, 0

    def nominal_ns(self) -> float:
        """When the next sample was taken; infinity where it waits for a trigger."""
        if self.triggers is not None:
            return self.triggers[0] if self.triggers else inf
        return self.start_ns + round(self.k * self._period * 1e9)

    def due_ns(self) -> float:
        """When the next sample arrives."""
        return self.nominal_ns() + 1e9 * self._delays[self.k % len(self._delays)]

    def next(self) -> None:
        """The sample is taken."""
        self.k += 1
        if self.triggers is not None:
            self.triggers.popleft()

    def skip(self, origin_ns: int | None) -> None:
        """Leave out what the faults swallow."""
        while origin_ns is not None and self.nominal_ns() < inf:
            elapsed = (self.nominal_ns() - origin_ns) * 1e-9 + 1e-9
            if not any(stall.covers(elapsed) for stall in self._stalls) and not self._loses(elapsed):
                return
            self.next()

    def _loses(self, elapsed: float) -> bool:
        """Whether the next sample gets lost; it is counted."""
        for loss in self._losses:
            if loss[0] <= elapsed and loss[1] > 0:
                loss[1] -= 1
                return True
        return False


class SimulatedSource:
    """What simulated devices share: the timetables of their streams, and being unplugged.

    ``delivered`` counts, by stream, what was read since the recording began.
    """

    def __init__(
        self, name: str, streams: tuple[SourceStream, ...], clock: Clock, faults: Sequence[Fault], seed: int
    ) -> None:
        self.name, self.streams, self.clock = name, streams, clock
        self.delivered = {stream.name: 0 for stream in streams}
        self._unplugged = [f for f in faults if f.kind == "unplug" and f.target == name]
        self._tables = [
            Timetable(stream, [f for f in faults if f.hits(stream.name)], seed + i)
            for i, stream in enumerate(streams)
        ]
        self._origin: int | None = None
        self._first: dict[str, int] = {}  # k of the first sample since the device was switched on
        self.powered_ns = 0

    @property
    def gone(self) -> bool:
        """Whether it is unplugged now."""
        elapsed = self.clock.elapsed_s
        return any(fault.covers(elapsed) for fault in self._unplugged)

    def open(self) -> None:
        """Connect. Clock and numbers of the device begin anew."""
        if self.gone:
            raise DeviceGone(f"{self.name} is unplugged")
        now = self.clock.monotonic_ns()
        self.powered_ns = now - _BOOT_NS
        for table in self._tables:
            if not table.start_ns:
                table.restart(now)
            if table.triggers is not None:
                table.triggers.clear()
            while table.triggers is None and table.nominal_ns() < now:
                table.next()
            self._first[table.stream.name] = table.k

    def close(self) -> None:
        """Let go."""

    def describe(self) -> str:
        """What it is."""
        streams = ", ".join(f"{stream.name} at {stream.expected_hz:g} Hz" for stream in self.streams)
        return f"{self.name}: simulated, {streams}"

    def due_ns(self) -> float:
        """When :meth:`read` has something to give, or to raise, by the monotonic clock."""
        self._settle()
        due = min(table.due_ns() for table in self._tables)
        origin = self.clock.origin_ns
        if origin is not None:
            now = self.clock.monotonic_ns()
            starts = [origin + round(f.at_s * 1e9) for f in self._unplugged]
            due = min([due, *(start for start in starts if start >= now)])
        return now if self.gone else due

    def _settle(self) -> None:
        """Begin anew with the recording; leave out what faults swallow, or nobody fetched."""
        if self._origin != self.clock.origin_ns:
            self._origin = self.clock.origin_ns
            for table in self._tables:
                table.restart(self.clock.monotonic_ns() if self._origin is None else self._origin)
                self._first[table.stream.name] = self.delivered[table.stream.name] = 0
        oldest = self.clock.monotonic_ns() - BUFFER_S * 1e9
        for table in self._tables:
            while table.nominal_ns() < oldest:
                table.next()
            table.skip(self.clock.origin_ns)

    def read(self, timeout_s: float) -> Sample | None:
        """The next sample of any stream."""
        due = self.due_ns()
        wait_s = (due - self.clock.monotonic_ns()) * 1e-9
        if wait_s > 0:
            self.clock.wait(min(wait_s, timeout_s))
            if wait_s > timeout_s and not self.gone:
                return None
        if self.gone:
            raise DeviceGone(f"{self.name} is unplugged")
        self._settle()
        table = min(self._tables, key=Timetable.due_ns)
        nominal = table.nominal_ns()
        if nominal == inf or nominal > self.clock.monotonic_ns():
            return None
        number = table.k - self._first[table.stream.name]
        sample = self.sample(table.stream, number, int(nominal) - self.powered_ns)
        table.next()
        self.delivered[table.stream.name] += 1
        return sample

    def sample(self, stream: SourceStream, number: int, device_ns: int) -> Sample:
        """What the device delivers: its number since it was switched on, its time by its own clock."""
        raise NotImplementedError


class SimulatedCounts:
    """Encoders: a lens that stands but for its faults, a head that looks to and fro."""

    def __init__(self, rig: RigFile, clock: Clock, faults: Sequence[Fault]) -> None:
        self._names, self._clock = list(rig.encoders), clock
        self._lens = [f for f in faults if f.kind == "lens"]
        self._moved = {name: round(10 * part.tolerance) + 10 for name, part in rig.encoders.items()}

    def counts(self) -> tuple[int, ...]:
        """The counts now."""
        elapsed = max(self._clock.elapsed_s, 0.0)
        return tuple(self._count(name, elapsed) for name in self._names)

    def _count(self, name: str, elapsed: float) -> int:
        if name in ("zoom", "focus"):
            moved = any(f.target == name and f.covers(elapsed) for f in self._lens)
            return (1200 if name == "zoom" else 800) + moved * self._moved[name]
        return round((100 if name == "pan" else 20) * np.sin(elapsed / 3))


class SimulatedRig:
    """All devices of a rig, simulated.

    Parameters
    ----------
    rig : RigFile
    faults : sequence of Fault
    virtual : bool
        On a clock that goes as fast as the recorder can.
    start_ns : int, optional
        Of the virtual wall clock.
    """

    def __init__(
        self, rig: RigFile, faults: Sequence[Fault] = (), virtual: bool = False, start_ns: int | None = None
    ) -> None:
        from acino_fte.rig.simulated_camera import SimulatedCamera
        from acino_fte.rig.simulated_lidar import SimulatedLidar

        self.faults = tuple(faults)

        def shift(elapsed: float) -> float:
            return wall_shift_s(self.faults, elapsed)

        self.clock: Clock = VirtualClock(start_ns, shift) if virtual else Clock(shift)
        self.sources: list[SimulatedSource] = [
            *(SimulatedCamera(n, part, self.clock, faults) for n, part in rig.cameras.items()),
            *(SimulatedLidar(n, part, self.clock, faults) for n, part in rig.lidars.items()),
        ]
        self.counts = SimulatedCounts(rig, self.clock, faults)
