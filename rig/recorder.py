"""The recorder: reads every device, writes segments, and says what happened.

Each device has a thread that reads and one that writes, with a bounded queue in between. On a virtual clock
one thread reads all devices in the order of time and waits for the writers, so that nothing depends on how
fast the computer is.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event as Flag
from threading import Lock, Thread

from acino_fte.data_tools.rig_recording import (
    Manifest,
    RecordedStream,
    Segment,
    State,
    write_manifest,
)
from acino_fte.errors import InputError
from acino_fte.rig.recorder_clock import Stamper, VirtualClock
from acino_fte.rig.recorder_events import EventLog, LensWatch, Watch
from acino_fte.rig.recorder_readers import Reader, ReaderThread
from acino_fte.rig.recorder_types import Equipment, Status, expected_bytes_per_s, gigabytes
from acino_fte.rig.rig_file import RigFile
from acino_fte.rig.sources import Source, SourceStream, camera_topic
from acino_fte.rig.writers import CameraWriter, Pace, SensorWriter
from acino_fte.rig.writers_segments import OpenSegment

TICK_S, FLUSH_S = 0.1, 0.25
_SYNC_EVERY = 4  # flushes
_QUEUE_S, _QUEUE_BYTES = 4.0, 256e6  # of a queue: whichever is less
_RATE_FROM_S = 10.0  # what was written tells the rate from then on


class Recorder:
    """Records into a folder until it is told to stop, the time is over, or the disk is full.

    Parameters
    ----------
    rig : RigFile
    folder : Path
        It exists, and holds no recording.
    equipment : Equipment
    lidar_every : int, optional
        Cut a frame of the lidar after so many images of the first camera.
    notes : sequence of str
        For the manifest.
    program : str
        Name and version.
    closing : callable, optional
        Called when the recording ends and its files are being closed.
    """

    def __init__(
        self, rig: RigFile, folder: Path, equipment: Equipment, lidar_every: int | None = None,
        notes: Sequence[str] = (), program: str = "acino-fte", closing: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        self._rig, self.folder, self._equipment, self._every = rig, folder, equipment, lidar_every
        self._notes, self._program, self._clock = tuple(notes), program, equipment.clock
        self._on_closing = closing
        self.log = EventLog()
        self.reason = self.unwritten = ""
        self._stop = False  # a plain value: a signal may come while any lock is held
        self._ended, self._lock, self._writing = Flag(), Lock(), Lock()
        self._segments: dict[str, Segment] = {}
        self._open: list[OpenSegment] = []
        self._readers: list[Reader] = []
        self._images = self._next_tick = self._index = 0
        self._triggered_ns = 0
        self._rates: tuple[float, dict[str, int], dict[str, float]] = (0.0, {}, {})

    # Beginning and end ------------------------------------------------------------

    def stop(self, reason: str = "asked to stop") -> None:
        """End the recording in good order; from any thread, or a signal."""
        if not self._stop:
            self.reason = reason
            self._stop = True

    def run(self, seconds: float | None = None, tell: Callable[[Status], None] | None = None) -> Manifest:
        """Record.

        Parameters
        ----------
        seconds : float, optional
            How long; without, until something stops it.
        tell : callable, optional
            Called ten times a second with the status.

        Returns
        -------
        Manifest
            As it was written at the end.
        """
        self._clock.begin()
        self._stamper = Stamper(self._clock, self._jumped)
        self._begin()
        syncer = Thread(target=self._keep_syncing, name="syncer", daemon=True)
        syncer.start()
        try:
            if isinstance(self._clock, VirtualClock):
                self._run_virtual(self._clock, seconds, tell)
            else:
                self._run_real(seconds, tell)
        finally:
            if self._on_closing is not None:
                self._on_closing()
            self._ended.set()
            syncer.join()
            manifest = self._finish()
        return manifest

    def _begin(self) -> None:
        self.log.add("started", self._stamper.started_ns)
        self._watches = {
            stream.name: Watch(
                stream.name,
                self._expected_hz(source, stream),
                self.log,
                self._stamper.started_ns,
                self._on_demand(source, stream),
            )
            for source in self._equipment.sources
            for stream in source.streams
        }
        self._writers = {source.name: self._writer(source) for source in self._equipment.sources}
        self._turn(0)
        for writer in self._writers.values():
            writer.start()
        self._readers = [self._reader(source) for source in self._equipment.sources]
        if self._every:
            self._trigger()
        self._write("recording")

    def _on_demand(self, source: Source, stream: SourceStream) -> bool:
        """Whether the recorder cuts the frames of a stream."""
        return bool(self._every) and stream.kind == "lidar" and hasattr(source, "trigger")

    def _expected_hz(self, source: Source, stream: SourceStream) -> float:
        if self._every and self._on_demand(source, stream):
            return self._first_fps() / self._every
        return stream.expected_hz

    def _writer(self, source: Source) -> SensorWriter:
        def failed(error: Exception) -> None:
            self._failed(source.name, error)

        paced, name = self._clock.virtual, source.name
        camera = self._rig.cameras.get(name)
        if camera is None:
            hz = sum(stream.expected_hz for stream in source.streams)
            return SensorWriter(name, max(round(_QUEUE_S * hz), 16), paced, failed)
        size = camera.width * camera.height * (1 if camera.bits <= 8 else 2)
        frames = int(min(_QUEUE_S * camera.fps, _QUEUE_BYTES / size))
        return CameraWriter(name, camera, self._equipment.codecs[name], max(frames, 8), paced, failed)

    def _reader(self, source: Source) -> Reader:
        cameras, lens, seen = list(self._rig.cameras), None, None
        if cameras and source.name == cameras[0]:
            rings = [
                (i, name, part.tolerance)
                for i, (name, part) in enumerate(self._rig.encoders.items())
                if name in ("zoom", "focus")
            ]
            lens, seen = LensWatch(rings, source.name, self.log), self._seen
        watches = {stream.name: self._watches[stream.name] for stream in source.streams}
        return Reader(
            source, self._writers[source.name], watches, self._stamper, self._clock, self.log,
            source.name in self._equipment.connected, self._equipment.counts, lens, seen,
        )  # fmt: skip

    def _finish(self) -> Manifest:
        """Close everything; the manifest as it stands then."""
        now = self._stamper.log_ns()
        for reader in self._readers:
            for watch in reader.watches.values():
                watch.close(now)
            if reader.lens is not None:
                reader.lens.close(now)
        self._write("recording")
        for writer in self._writers.values():
            writer.finish()
        for segment in self._open:
            if not segment.closed:
                self._closing(segment)
        for reader in self._readers:
            reader.source.close()
        seconds = (now - self._stamper.started_ns) * 1e-9
        self.log.add("stopped", now, seconds=seconds, detail=self.reason or "the time is over")
        return self._write("closed", now)

    def _closing(self, segment: OpenSegment) -> None:
        try:
            segment.close()
        except OSError as error:
            self._failed("", error)

    # Running ----------------------------------------------------------------------

    def _run_virtual(
        self, clock: VirtualClock, seconds: float | None, tell: Callable[[Status], None] | None
    ) -> None:
        start = clock.monotonic_ns()
        end = float("inf") if seconds is None else start + round(seconds * 1e9)
        tick, pace = start, Pace(self._writers.values())
        while not self._stop:
            reader = min(self._readers, key=Reader.due_ns)
            due = reader.due_ns()
            if min(due, tick) >= end:
                clock.advance_to(int(end))
                return
            if tick <= due:
                clock.advance_to(tick)
                self._tick(tell)
                pace.tick()
                tick += round(TICK_S * 1e9)
            else:
                clock.advance_to(int(due) + 1)
                reader.step(0.0)

    def _run_real(self, seconds: float | None, tell: Callable[[Status], None] | None) -> None:
        threads = [ReaderThread(reader, self._ended, self._failed) for reader in self._readers]
        for thread in threads:
            thread.start()
        while not self._stop:
            self._tick(tell)
            left = TICK_S if seconds is None else min(TICK_S, seconds - self._clock.elapsed_s)
            if left <= 0:
                break
            self._clock.wait(left)
        self._ended.set()
        for thread in threads:
            thread.join(timeout=2.0)

    def _tick(self, tell: Callable[[Status], None] | None) -> None:
        """What is looked after ten times a second."""
        log_ns, _ = self._stamper.stamp()
        for watch in self._watches.values():
            watch.check(log_ns)
        index = int((log_ns - self._stamper.started_ns) / (self._rig.storage.segment_s * 1e9))
        if index > self._index:
            self._turn(index)
        free = self._free()
        if free < self._rig.storage.reserve_gb * 1e9:
            self._disk_full(f"{gigabytes(free)} are free: the reserve is reached")
        if self._every and log_ns - self._triggered_ns > 1.5e9 * self._every / self._first_fps():
            self._trigger()  # the camera is silent; the lidar goes on
        if self.log.taken():
            self._write("recording")
        if tell is not None:
            tell(self.status("recording", free))

    def _first_fps(self) -> float:
        return next(iter(self._rig.cameras.values())).fps if self._rig.cameras else 1.0

    def _seen(self) -> None:
        """An image of the first camera came."""
        self._images += 1
        if self._every and self._images % self._every == 0:
            self._trigger()

    def _trigger(self) -> None:
        self._triggered_ns = self._stamper.log_ns()
        for source in self._equipment.sources:
            for stream in source.streams:
                if self._on_demand(source, stream):
                    self._watches[stream.name].asked()
                    source.trigger()

    def _free(self) -> int:
        return self._equipment.free_bytes(self.folder)

    # Segments, faults, manifest ---------------------------------------------------

    def _turn(self, index: int) -> None:
        """Begin a segment; each writer turns to it when its queue gets there."""
        alive = {name for name, writer in self._writers.items() if not writer.broken}
        try:
            segment = OpenSegment(self.folder, index, self._stamper.started_ns, alive, self._tell_segment)
        except OSError as error:
            self._failed("", error)
            return
        self._index = index
        self._open = [*(one for one in self._open if not one.closed), segment]
        for name in alive:
            self._writers[name].turn_to(segment)

    def _tell_segment(self, segment: Segment) -> None:
        """Note a file. One that is about to begin stands in the manifest before it is there."""
        with self._lock:
            self._segments[segment.file] = segment
        self.log.touch()
        if not segment.closed:
            self._write("recording")

    def _keep_syncing(self) -> None:
        n = 0
        while not self._ended.wait(FLUSH_S):
            n += 1
            for segment in list(self._open):
                try:
                    segment.flush()
                    if n % _SYNC_EVERY == 0:
                        segment.sync()
                except OSError as error:
                    self._failed("", error)

    def _jumped(self, log_ns: int, seconds: float) -> None:
        self.log.add(
            "clock_jump", log_ns, seconds=seconds, detail=f"the wall clock jumped by {seconds:+.3f} s"
        )

    def _disk_full(self, detail: str) -> None:
        if not self._stop:
            self.log.add("disk_full", self._stamper.log_ns(), detail=detail)
            self.stop("the disk is full")

    def _failed(self, device: str, error: Exception) -> None:
        """Something cannot be written or read: a full disk ends the recording, else only a sensor ends."""
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            self._disk_full("the disk takes no more")
            return
        said = f"{type(error).__name__}: {error}"
        if not any(event.kind == "error" and event.stream == device for event in self.log.all()):
            self.log.add("error", self._stamper.log_ns(), device, detail=said[:300])
        writers = getattr(self, "_writers", {})
        if isinstance(error, OSError) or all(writer.broken for writer in writers.values()):
            self.stop("the recording cannot be written")

    def _write(self, state: State, ended_ns: int | None = None) -> Manifest:
        """Write the manifest."""
        with self._writing:
            manifest = self.manifest(state, ended_ns)
            try:
                write_manifest(self.folder, manifest)
            except InputError as error:  # the one before is still there
                self.unwritten = f"the manifest cannot be written ({error.found})"
                self.stop(self.unwritten)
        return manifest

    def manifest(self, state: State, ended_ns: int | None = None) -> Manifest:
        """The recording as it is known now."""
        with self._lock:
            segments = tuple(sorted(self._segments.values(), key=lambda s: (s.index, s.kind, s.file)))
        return Manifest(
            self.folder.name, state, self._stamper.started_ns, self._stamper.started_monotonic_ns, ended_ns,
            socket.gethostname(), self._program, self._equipment.simulated, self._streams(), segments,
            self.log.all(), self._notes,
        )  # fmt: skip

    def _streams(self) -> tuple[RecordedStream, ...]:
        found = []
        for reader in self._readers:
            for stream in reader.source.streams:
                name, written = stream.name, reader.writer.written
                hz, received = self._expected_hz(reader.source, stream), self._watches[name].received
                drops = reader.dropped[name]
                found.append(RecordedStream(name, stream.kind, hz, received, written.get(name, 0), drops))
                if stream.kind == "image":
                    topic = camera_topic(name)
                    n = written.get(topic, 0)
                    found.append(RecordedStream(topic, "image_info", hz, received, n, drops))
        return tuple(found)

    def status(self, state: str, free: int | None = None) -> Status:
        """The recording at this moment."""
        elapsed = self._clock.elapsed_s
        written = {name: n for reader in self._readers for name, n in dict(reader.writer.written).items()}
        received = {name: watch.received for name, watch in self._watches.items()}
        before, counts, fps = self._rates
        if elapsed - before >= 1.0:
            fps = {name: (n - counts.get(name, 0)) / (elapsed - before) for name, n in received.items()}
            self._rates = (elapsed, received, fps)
        free = self._free() if free is None else free
        room = free - self._rig.storage.reserve_gb * 1e9
        return Status(
            state, elapsed, fps, written,
            sum(n for reader in self._readers for n in reader.dropped.values()),
            sum(event.count for event in self.log.all() if event.kind == "lost"),
            tuple(name for name, watch in self._watches.items() if watch.silent),
            any(reader.lens is not None and reader.lens.moved for reader in self._readers),
            free, max(room, 0) / self._bytes_per_s(elapsed) / 60,
            max((writer.fill for writer in self._writers.values()), default=0.0),
        )  # fmt: skip

    def _bytes_per_s(self, elapsed: float) -> float:
        """What is written, B/s: as measured, or as expected at the beginning."""
        if elapsed > _RATE_FROM_S:
            size = 0
            for name in list(self._segments):
                with suppress(OSError):
                    size += (self.folder / name).stat().st_size
            if size:
                return size / elapsed
        return expected_bytes_per_s(self._rig)
