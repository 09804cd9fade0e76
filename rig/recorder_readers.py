"""Reading one device: stamps what comes, watches over it, hands it to its writer, and connects again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from threading import Event as Flag
from threading import Thread
from typing import Any

from acino_fte.data_tools.recording import Picture
from acino_fte.rig.recorder_clock import Clock, Stamper
from acino_fte.rig.recorder_events import BundledEvent, EventLog, LensWatch, Watch
from acino_fte.rig.sources import Counts, DeviceGone, Sample, Source
from acino_fte.rig.writers import SensorWriter, Stamped

RETRY_S = 0.25
"""Between two tries to connect to a device that is gone, s."""
READ_S = 0.1
"""Longest wait of one read, s."""


class Reader:
    """Reads one device, step by step.

    Parameters
    ----------
    source : Source
    writer : SensorWriter
    watches : mapping of str to Watch
        By stream.
    stamper : Stamper
    clock : Clock
    log : EventLog
    connected : bool
        Whether the source is open already.
    counts : Counts, optional
        Of the encoders, for pictures.
    lens : LensWatch, optional
        Of a camera.
    seen : callable, optional
        Called after every picture.
    """

    def __init__(
        self, source: Source, writer: SensorWriter, watches: Mapping[str, Watch], stamper: Stamper,
        clock: Clock, log: EventLog, connected: bool, counts: Counts | None = None,
        lens: LensWatch | None = None, seen: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        self.source, self.writer, self.watches = source, writer, watches
        self._stamper, self._clock, self._log = stamper, clock, log
        self.connected, self._next_try = connected, clock.monotonic_ns()
        self._counts, self.lens, self._seen = counts, lens, seen
        self.dropped = dict.fromkeys(watches, 0)
        self._drops = {
            stream: BundledEvent(log, "dropped", stream, "the recorder could not keep up")
            for stream in watches
        }
        if not connected:
            self._gone("it did not answer")

    def due_ns(self) -> float:
        """When a step has something to do; for sources of a virtual clock."""
        source: Any = self.source
        return source.due_ns() if self.connected else self._next_try

    def step(self, timeout_s: float) -> None:
        """Take at most one sample, or try once to connect."""
        if not self.connected:
            self._connect(timeout_s)
            return
        try:
            sample = self.source.read(timeout_s)
        except DeviceGone as error:
            self._gone(str(error))
            return
        if sample is not None:
            self._take(sample)

    def _connect(self, timeout_s: float) -> None:
        wait_s = (self._next_try - self._clock.monotonic_ns()) * 1e-9
        if wait_s > 0:
            self._clock.wait(min(wait_s, timeout_s))
            if wait_s > timeout_s:
                return
        try:
            self.source.open()
            self.connected = True
        except DeviceGone:
            self._next_try = self._clock.monotonic_ns() + round(RETRY_S * 1e9)

    def _gone(self, why: str) -> None:
        now = self._stamper.log_ns()
        for watch in self.watches.values():
            watch.gone(now, why)
        self.source.close()
        self.connected = False
        self._next_try = self._clock.monotonic_ns() + round(RETRY_S * 1e9)

    def _take(self, sample: Sample) -> None:
        log_ns, wall_ns = self._stamper.stamp()
        self.watches[sample.stream].received_at(log_ns, sample.number, sample.device_ns)
        counts: tuple[int, ...] = ()
        if isinstance(sample.value, Picture):
            counts = self._counts.counts() if self._counts is not None else ()
            if self.lens is not None:
                self.lens.seen(log_ns, counts)
        if not self.writer.put(Stamped(sample, log_ns, wall_ns, counts)):
            self.dropped[sample.stream] += 1
            self._drops[sample.stream].add(log_ns, log_ns, 1)
        if self._seen is not None and isinstance(sample.value, Picture):
            self._seen()


class ReaderThread(Thread):
    """Steps a reader until told to end; errors of a driver are told, and it is tried again."""

    def __init__(self, reader: Reader, ended: Flag, failed: Callable[[str, Exception], None]) -> None:
        super().__init__(name=f"reader of {reader.source.name}", daemon=True)
        self._reader, self._ended, self._failed = reader, ended, failed

    def run(self) -> None:
        """Read."""
        while not self._ended.is_set():
            try:
                self._reader.step(READ_S)
            except Exception as error:  # noqa: BLE001 - of a driver: the others go on
                self._failed(self._reader.source.name, error)
                self._ended.wait(1.0)
