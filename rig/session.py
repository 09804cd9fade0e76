"""One session of recording: idle, preflight, recording, closing, idle.

Preflight asks what can be asked before it counts: does every device answer, is there a fast disk with room,
is the rig free, does the clock make sense. What can be lived with is a warning, and the recording goes on;
what cannot ends the session before anything is written.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import gettempdir
from typing import Literal

from acino_fte.data_tools.rig_recording import Manifest
from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError
from acino_fte.rig.faults import Fault, disk_is_full
from acino_fte.rig.lock import RigLock, lock_path
from acino_fte.rig.recorder import Recorder
from acino_fte.rig.recorder_clock import Clock
from acino_fte.rig.recorder_types import Equipment, Status, expected_bytes_per_s, gigabytes
from acino_fte.rig.rig_file import FILE_NAME, RigFile
from acino_fte.rig.rig_read import rig_text
from acino_fte.rig.simulated import SimulatedRig
from acino_fte.rig.sources import DeviceGone, Source, real_counts, real_sources
from acino_fte.rig.writers_messages import prepare
from acino_fte.rig.writers_video import LOSSLESS, RAW, SOFTWARE, choose_codec

State = Literal["idle", "preflight", "recording", "closing"]
_NEXT: dict[State, tuple[State, ...]] = {
    "idle": ("preflight",),
    "preflight": ("recording", "idle"),
    "recording": ("closing",),
    "closing": ("idle",),
}
_ANSWER_S = 2.0  # within which an open device delivers
_PROBE_BYTES = 8 << 20
_FAST = 1.5  # times what the rig writes, the disk must take
_LEAST_MINUTES = 1.0
_EARLIEST = 1_704_067_200  # 2024-01-01: before it, the clock of the computer was never set


@dataclass(frozen=True)
class Check:
    """One check before a recording: passed, or what is wrong and what to do. `fatal`: nothing is recorded."""

    name: str
    passed: bool
    detail: str
    remedy: str = ""
    fatal: bool = False


@dataclass(frozen=True)
class SessionOptions:
    """How to record.

    Attributes
    ----------
    simulate : bool
        All devices are simulated, whatever ``rig.yaml`` names.
    fast : bool
        On a virtual clock, as fast as the computer can.
    faults : tuple of Fault
        Of the simulated rig.
    lidar_every : int, optional
        Cut a frame of the lidar after so many images of the first camera.
    program : str
        Name and version, for the manifest.
    probe : bool
        Try how fast the disk is.
    """

    simulate: bool = False
    fast: bool = False
    faults: tuple[Fault, ...] = ()
    lidar_every: int | None = None
    program: str = "acino-fte"
    probe: bool = True


class Session:
    """Records once into a folder.

    Parameters
    ----------
    rig : RigFile
    folder : Path
        To be made; it may exist where it is empty.
    options : SessionOptions, optional

    Raises
    ------
    InputError
        A device has no driver, or the folder is not empty.
    """

    def __init__(self, rig: RigFile, folder: Path | str, options: SessionOptions | None = None) -> None:
        self.rig, self.folder = rig, Path(folder)
        self.options = options or SessionOptions()
        self.state: State = "idle"
        self.checks: tuple[Check, ...] = ()
        self.equipment = self._equip()
        self.recorder: Recorder | None = None
        self._stack = ExitStack()
        self._notes: list[str] = []
        self._asked_to_stop = ""
        if not rig.cameras and not rig.lidars:
            raise InputError("The rig has neither a camera nor a lidar.", key="cameras, lidars")
        if self.options.lidar_every and not (
            rig.cameras and any(hasattr(source, "trigger") for source in self.equipment.sources)
        ):
            raise InputError(
                "Frames of the lidar cannot be cut by images.",
                key="--lidar-every",
                expected="a camera, and a lidar whose driver can",
                remedy="leave it out: the lidar's own clock cuts them",
            )
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise InputError(
                "There is something already.",
                file=self.folder,
                expected="a new folder",
                remedy="choose another one with --out; a recording is never written over",
            )

    def _equip(self) -> Equipment:
        if not self.options.simulate:
            sources = real_sources(self.rig)
            return Equipment(sources, Clock(), real_counts(self.rig))
        rig = SimulatedRig(self.rig, self.options.faults, self.options.fast)

        def free(folder: Path) -> int:
            full = disk_is_full(self.options.faults, rig.clock.elapsed_s)
            return 0 if full else shutil.disk_usage(folder).free

        return Equipment(rig.sources, rig.clock, rig.counts, free_bytes=free, simulated=True)

    def _to(self, state: State) -> None:
        if state not in _NEXT[self.state]:
            raise RuntimeError(f"a session that is {self.state} cannot become {state}")
        self.state = state

    # Preflight --------------------------------------------------------------------

    def preflight(self) -> tuple[Check, ...]:
        """Look before the leap. The devices stay open and the rig locked until the recording ends.

        Returns
        -------
        tuple of Check

        Raises
        ------
        InputError
            A check failed that is fatal; the message names all of them.
        """
        self._to("preflight")
        try:
            prepare()
            if not self.folder.exists():
                self._stack.callback(self._remove_empty)
            checks = [*self._room(), self._lock()]
            checks += [*self._devices(), *self._encoders(), self._clock_set(), *self._codecs()]
        except BaseException:
            self._abandon()
            raise
        self.checks = tuple(checks)
        fatal = [check for check in checks if check.fatal and not check.passed]
        if fatal:
            self._abandon()
            raise InputError(
                "The recording cannot begin.",
                file=self.folder,
                found="; ".join(f"{check.name}: {check.detail}" for check in fatal),
                remedy="; ".join(check.remedy for check in fatal if check.remedy) or None,
            )
        self._notes += [f"{check.name}: {check.detail}" for check in checks]
        return self.checks

    def _abandon(self) -> None:
        for source in self.equipment.sources:
            if source.name in self.equipment.connected:
                source.close()
        self._stack.close()
        self._to("idle")

    def _remove_empty(self) -> None:
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _lock(self) -> Check:
        """Of the rig; simulated ones are as many as there are places to record to."""
        where = f" {self.folder.resolve().parent}" if self.equipment.simulated else ""
        path = lock_path(Path(gettempdir()), self.rig.name + where)
        lock = self._stack.enter_context(RigLock(path, self.folder))
        return Check("lock", not lock.taken_over, lock.taken_over or f"the rig {self.rig.name} is free")

    def _room(self) -> list[Check]:
        """Room on the disk, and how fast it is."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            free = self.equipment.free_bytes(self.folder)
            speed = _disk_speed(self.folder) if self.options.probe and free > 4 * _PROBE_BYTES else None
        except OSError as error:
            raise InputError(
                "The recording cannot be written here.",
                file=self.folder,
                found=error.strerror or str(error),
                remedy="choose another place with --out",
            ) from None
        need = expected_bytes_per_s(self.rig)
        room = free - self.rig.storage.reserve_gb * 1e9
        minutes = max(room, 0.0) / need / 60
        checks = [
            Check(
                "disk", minutes >= _LEAST_MINUTES,
                f"{gigabytes(free)} are free, {self.rig.storage.reserve_gb:g} GB of them are kept: "
                f"room for {int(minutes)} min",
                "free some space, or choose another disk with --out", fatal=True,
            )
        ]  # fmt: skip
        if speed is not None:
            detail = f"it takes {speed / 1e6:.0f} MB/s, the rig writes {need / 1e6:.1f} MB/s"
            remedy = "use a faster disk: images may be dropped"
            checks.append(Check("disk speed", speed >= _FAST * need, detail, remedy))
        return checks

    def _devices(self) -> list[Check]:
        """Does every device answer, and deliver?"""
        checks = []
        for source in self.equipment.sources:
            try:
                source.open()
                silent = self._silent(source)
            except DeviceGone as error:
                text = "the others are recorded; it is tried again all the time"
                checks.append(Check(source.name, False, f"does not answer ({error})", text))
                continue
            except Exception as error:  # noqa: BLE001 - of a driver: the others are recorded
                with suppress(Exception):
                    source.close()
                detail = f"its driver fails ({type(error).__name__}: {error})"
                checks.append(Check(source.name, False, detail, "the others are recorded"))
                continue
            self.equipment.connected.add(source.name)
            detail = source.describe() if not silent else f"answers, but nothing comes on {', '.join(silent)}"
            checks.append(Check(source.name, not silent, detail, "look at its cable and its settings"))
        if not self.equipment.connected:
            text = "switch the devices on and look at the cables"
            checks.append(Check("devices", False, "none of them answers", text, fatal=True))
        return checks

    def _silent(self, source: Source) -> list[str]:
        """Streams of a source that deliver nothing in time."""
        waiting = {stream.name for stream in source.streams}
        clock = self.equipment.clock
        end = clock.monotonic_ns() + round(_ANSWER_S * 1e9)
        while waiting and clock.monotonic_ns() < end:
            sample = source.read(0.1)
            if sample is not None:
                waiting.discard(sample.stream)
        return sorted(waiting)

    def _encoders(self) -> list[Check]:
        """Is there anything that reads them?"""
        if not self.rig.encoders or not self.rig.cameras:
            return []
        names = ", ".join(self.rig.encoders)
        if self.equipment.counts is not None and self.equipment.counts.counts():
            return [Check("encoders", True, names)]
        remedy = "run acino-fte rig drive in another window"
        return [Check("encoders", False, f"nothing reads {names}: images carry no counts", remedy)]

    def _clock_set(self) -> Check:
        now = self.equipment.clock.wall_ns() * 1e-9
        text = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(now))
        remedy = "set it, or wait for the network or GPS; times between sensors are right in any case"
        return Check("clock", now > _EARLIEST, f"it is {text}", remedy)

    def _codecs(self) -> list[Check]:
        checks = []
        for name, camera in self.rig.cameras.items():
            codec = self.equipment.codecs[name] = choose_codec(camera)
            kind = {
                SOFTWARE: " (on the processor)",
                RAW: " (every pixel kept)",
                LOSSLESS: " (every pixel kept)",
            }.get(codec, " (hardware)")
            checks.append(Check(f"video of {name}", True, codec + kind))
        return checks

    # Recording --------------------------------------------------------------------

    def record(self, seconds: float | None = None, tell: Callable[[Status], None] | None = None) -> Manifest:
        """Record, after a preflight.

        Parameters
        ----------
        seconds : float, optional
            How long; without, until :meth:`stop`.
        tell : callable, optional
            Called ten times a second with the status.
        """
        self._to("recording")
        with self._stack:
            write_text_whole(self.folder / FILE_NAME, rig_text(self.rig))
            recorder = self.recorder = Recorder(
                self.rig, self.folder, self.equipment, self.options.lidar_every, self._notes,
                self.options.program, self._closing,
            )  # fmt: skip
            if self._asked_to_stop:
                recorder.stop(self._asked_to_stop)
            manifest = recorder.run(seconds, tell)
        self._to("idle")
        return manifest

    def _closing(self) -> None:
        self._to("closing")

    def stop(self, reason: str = "asked to stop") -> None:
        """End the recording in good order; from any thread, or a signal."""
        self._asked_to_stop = reason
        if self.recorder is not None:
            self.recorder.stop(reason)


def _disk_speed(folder: Path) -> float:
    """How fast the disk takes a few megabytes, B/s."""
    path = folder / ".speed"
    block = os.urandom(1 << 20)
    try:
        with path.open("wb", buffering=0) as file:
            begun = time.perf_counter()
            for _ in range(_PROBE_BYTES >> 20):
                file.write(block)
            os.fsync(file.fileno())
            return _PROBE_BYTES / max(time.perf_counter() - begun, 1e-6)
    finally:
        path.unlink(missing_ok=True)
