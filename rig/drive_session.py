"""Driving: a turn of the loop takes what encoders, stick and keys say, and drives the motors."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from acino_fte.rig.encoders import Encoder, LineCounts, Reading, ReportedCounts
from acino_fte.rig.encoders_shared import CountsWriter
from acino_fte.rig.encoders_store import PositionStore
from acino_fte.rig.joystick import Joystick
from acino_fte.rig.motors import LinkOutput, MotorControl
from acino_fte.rig.motors_homing import Homing
from acino_fte.rig.serial_frames import Count, Throttle
from acino_fte.rig.serial_link import SerialLink

LOOP_S = 0.02
SPEEDS = (0.1, 0.25, 0.5, 0.75, 1.0)
"""Power of the keys 1–5."""
_KEYS = {"right": (0, 1), "left": (0, -1), "up": (1, 1), "down": (1, -1)}  # driven axis, direction
_AGAIN_NS = 2_000_000_000  # within which h and 0 are to be pressed a second time


@dataclass
class Axis:
    """One axis of the rig.

    Attributes
    ----------
    name : str
        ``"zoom"``.
    encoder : Encoder
    motor : MotorControl, optional
        Only rings have one.
    output, report : LinkOutput, ReportedCounts, optional
        Its motor and its counts at the microcontroller.
    trouble : str
        Why it cannot be read.
    """

    name: str
    encoder: Encoder | None
    motor: MotorControl | None = None
    output: LinkOutput | None = None
    report: ReportedCounts | None = None
    homing: Homing | None = field(default=None, init=False)
    trouble: str = ""


@dataclass(frozen=True)
class AxisStatus:
    """What the screen says of an axis; `share` is the place between the ends of the travel, 0 … 1."""

    name: str
    reading: Reading | None
    driven: bool
    power: float
    homed: bool
    share: float | None
    doing: str
    trouble: str


@dataclass(frozen=True)
class DriveStatus:
    """What the screen says."""

    axes: tuple[AxisStatus, ...]
    link: str
    link_good: bool
    stick: str
    speed: int
    notes: tuple[str, ...]


class DriveSession:
    """The rig while it is driven.

    Parameters
    ----------
    axes : sequence of Axis
        The stick's two channels and the arrow keys drive the first two that have a motor.
    link : SerialLink
        To the microcontroller.
    joystick : Joystick, optional
        Without one the keys do.
    store : PositionStore, optional
        Where positions outlive the program.
    shared : CountsWriter, optional
        Where a recorder finds the counts.
    clock : callable
        Monotonic time in ns.
    """

    def __init__(
        self,
        axes: Sequence[Axis],
        link: SerialLink,
        *,
        joystick: Joystick | None = None,
        store: PositionStore | None = None,
        shared: CountsWriter | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.axes, self.link, self.joystick = tuple(axes), link, joystick
        self.driven = tuple(axis for axis in axes if axis.motor is not None)
        self._store, self._shared, self._clock = store, shared, clock
        self._interruptions = 0
        self._asked: tuple[str, int] | None = None
        self._stick_moved = [False] * len(self.driven)
        self._note = ""
        self.speed = 3

    def step(self, keys: Sequence[str] = ()) -> DriveStatus:
        """One turn of the loop; at least every 20 ms.

        Parameters
        ----------
        keys : sequence of str
            Pressed since the last turn, see :mod:`acino_fte.rig.drive_keys`.
        """
        now = self._clock()
        self._read(now)
        self._obey(keys, now)
        self._drive(now)
        if self._store:
            self._store.write()
        return self.status(now)

    def look(self) -> DriveStatus:
        """A turn that reads everything, moves nothing and says nothing to the microcontroller."""
        now = self._clock()
        self._read(now)
        if self.joystick:
            self.joystick.read(now)
        return self.status(now)

    def stop(self) -> None:
        """All motors, at once."""
        for axis in self.driven:
            if axis.homing:
                axis.homing.cancel()
            if axis.motor:
                axis.motor.stop()
        self._send()

    def close(self, wait: Callable[[float], None] = time.sleep) -> None:
        """Stop the motors, store the positions where they came to rest, close the line."""
        began = self._clock()
        try:
            self.stop()
            for _ in range(5):  # a command may be lost; the last counts may be on their way
                wait(LOOP_S)
                self._read(self._clock())
                self.stop()
        finally:
            for axis in self.axes:
                if axis.encoder is not None:
                    axis.encoder.save_last(began)
            self.link.close()
            if self._shared:
                self._shared.close()
            if self._store:
                self._store.close()

    def status(self, now_ns: int) -> DriveStatus:
        """What the screen says."""
        link, good = self._link_text(now_ns)
        notes = [self._note, *(part.trouble for part in (self._store, self._shared) if part)]
        stick = "none: arrow keys drive"
        if self.joystick:
            stick = self.joystick.trouble or "ready"
        axes = tuple(_axis_status(axis) for axis in self.axes)
        return DriveStatus(axes, link, good, stick, self.speed, tuple(note for note in notes if note))

    def _read(self, now_ns: int) -> None:
        """All positions."""
        self._listen(now_ns)
        for axis in self.axes:
            if axis.encoder is not None:
                axis.encoder.poll(now_ns)
                if isinstance(axis.encoder.source, LineCounts):
                    axis.trouble = axis.encoder.source.trouble
                    if axis.trouble:
                        axis.encoder.interrupted(restarted=True)
        encoders = [axis.encoder for axis in self.axes]
        if self._shared and not any(part and (part.in_doubt or part.counts is None) for part in encoders):
            self._shared.write([(part.counts or 0) if part else 0 for part in encoders], now_ns)

    def _listen(self, now_ns: int) -> None:
        """Reports of the microcontroller; whether it was gone."""
        by_number = {axis.output.motor: axis for axis in self.driven if axis.output}
        for message in self.link.poll(now_ns):
            if isinstance(message, Count) and message.motor in by_number:
                axis = by_number[message.motor]
                if axis.report is not None and axis.encoder is not None:
                    axis.report.put(message.count, now_ns)
                    if axis.report.restarted:
                        axis.report.restarted = False
                        axis.encoder.interrupted(restarted=True)
                        self._note = "the microcontroller started again: home the rings (h h)"
        if self.link.interruptions != self._interruptions:
            self._interruptions = self.link.interruptions
            self._interrupted()

    def _interrupted(self) -> None:
        """The cable was out: nothing moves again before the operator let go."""
        self.stop()
        for axis in self.driven:
            if axis.report is not None and axis.encoder is not None:
                axis.report.forget()
                axis.encoder.interrupted()
        if self.joystick:
            self.joystick.disarm()

    def _obey(self, keys: Sequence[str], now_ns: int) -> None:
        """Wishes of the stick and the keys. What nobody says again ends with the motor's dead-man."""
        wanted = self.joystick.read(now_ns) if self.joystick else None
        for k, power in enumerate((wanted or ())[: len(self.driven)]):
            if power or self._stick_moved[k]:
                self._wish(k, power, now_ns)
            self._stick_moved[k] = bool(power)
        for key in keys:
            self._press(key, now_ns)

    def _press(self, key: str, now_ns: int) -> None:
        asked, self._asked = self._asked, None
        if any(axis.homing and axis.homing.under_way for axis in self.driven):
            self._note = "homing was stopped: home again (h h), until then the motors are slow"
            self.stop()
        elif key in _KEYS:
            place, sign = _KEYS[key]
            if place < len(self.driven):
                self._wish(place, sign * SPEEDS[self.speed - 1], now_ns)
        elif key in "12345":
            self.speed = int(key)
        elif key in "h0":
            if asked and asked[0] == key and now_ns - asked[1] <= _AGAIN_NS:
                self._home(now_ns) if key == "h" else self._zero()
            else:
                what = (
                    "drive zoom and focus to their ends" if key == "h" else "call this place zero (pan, tilt)"
                )
                self._asked, self._note = (key, now_ns), f"press {key} again to {what}"
        else:
            self._note = "stopped"
            self.stop()

    def _wish(self, place: int, power: float, now_ns: int) -> None:
        axis = self.driven[place]
        if axis.homing and axis.homing.under_way:
            axis.homing.cancel()
            self._note = "homing was stopped: home again (h h), until then the motors are slow"
        if axis.motor:
            axis.motor.command(power, now_ns)

    def _home(self, now_ns: int) -> None:
        if not self.link.ready:
            self._note = "without the microcontroller there is no homing"
            return
        self._note = "homing; any key stops it"
        for axis in self.driven:
            if axis.motor:
                axis.homing = Homing(axis.motor, now_ns)

    def _zero(self) -> None:
        self._note = "pan and tilt are zero here"
        for axis in self.axes:
            if axis.motor is None and axis.encoder is not None:
                axis.encoder.zero()

    def _drive(self, now_ns: int) -> None:
        for axis in self.driven:
            if axis.motor is None:
                continue
            if not self.link.ready:
                axis.motor.stop()
                continue
            if axis.homing and axis.homing.under_way:
                axis.homing.step(now_ns)
                if axis.homing.phase == "done":
                    self._homed(axis)
            axis.motor.update(now_ns)
        self._send()

    def _homed(self, axis: Axis) -> None:
        self._note = f"{axis.name} knows its ends"
        if self._store and axis.motor and axis.motor.limits:
            self._store.put_limits(axis.name, axis.motor.limits)

    def _send(self) -> None:
        """The speed of every motor, every turn: silence is what stops them if this program dies."""
        for axis in self.driven:
            if axis.output and self.link.ready:
                self.link.send(Throttle(axis.output.motor, axis.output.speed))

    def _link_text(self, now_ns: int) -> tuple[str, bool]:
        link = self.link
        if not link.connected:
            return f"not connected: {link.trouble}; it goes on by itself when it is", False
        if link.foreign:
            return "what comes is not understood: is this the microcontroller? (--port)", False
        if not link.ready:
            return "listening to the microcontroller", False
        if link.heard_ns is None or now_ns - link.heard_ns > 1_000_000_000:
            return "the microcontroller says nothing: no positions", False
        counts = link.counts
        lost = f", {counts.lost + counts.refused} damaged or lost" if counts.lost + counts.refused else ""
        return f"connected, {link.protocol} lines{lost}", True


def _axis_status(axis: Axis) -> AxisStatus:
    reading = axis.encoder.reading() if axis.encoder else None
    motor, share = axis.motor, None
    if motor and motor.homed and motor.limits and reading and reading.counts is not None:
        low, high = motor.limits
        share = min(max((reading.counts - low) / (high - low), 0.0), 1.0)
    doing = axis.homing.phase if axis.homing and axis.homing.under_way else ""
    return AxisStatus(
        axis.name,
        reading,
        motor is not None,
        motor.power if motor else 0.0,
        bool(motor and motor.homed),
        share,
        f"homing, {doing}" if doing else "",
        (motor.fault if motor else "") or axis.trouble,
    )
