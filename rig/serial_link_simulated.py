"""A simulated microcontroller: what its firmware must do, and a port that leads to it.

Its rules are those of the page on firmware in docs/rig_drive.md: an own dead-man, counts fifty times a
second, nothing but whole and valid messages obeyed.
"""

from __future__ import annotations

from collections.abc import Callable

from acino_fte.rig.motors import DEAD_MAN_S
from acino_fte.rig.motors_simulated import SimulatedGearmotor
from acino_fte.rig.serial_frames import (
    MAX_SPEED,
    Count,
    FramedLines,
    Message,
    PlainLines,
    Reset,
    Throttle,
    Turns,
)

REPORT_NS = 20_000_000
_TICK_NS = 5_000_000
_COUNTS_PER_TURN = 4741.44


class SimulatedController:
    """The firmware and its motors.

    Parameters
    ----------
    motors : dict
        By their number.
    clock : callable
        Time in ns.
    framed : bool
        Which protocol it speaks.
    """

    def __init__(
        self, motors: dict[int, SimulatedGearmotor], clock: Callable[[], int], *, framed: bool = True
    ) -> None:
        kind = FramedLines if framed else PlainLines
        self.motors, self.lines = motors, kind("device", tuple(motors))
        self.commands: list[tuple[int, Message]] = []
        self._clock = clock
        self._now = self._reported = clock()
        self._commanded = dict.fromkeys(motors, self._now)
        self._out = bytearray()

    def receive(self, data: bytes) -> None:
        """Bytes from the computer."""
        self.advance()
        for message in self.lines.feed(data, self._now):
            self.commands.append((self._now, message))
            if isinstance(message, Throttle):
                self.motors[message.motor].set(message.speed / MAX_SPEED)
                self._commanded[message.motor] = self._now
            elif isinstance(message, Reset):
                for motor in self.motors.values():
                    motor.set(0.0)
                    motor.reset()

    def advance(self) -> None:
        """Let the time pass that has passed."""
        end = self._clock()
        while self._now < end:
            step = min(_TICK_NS, end - self._now)
            self._now += step
            for number, motor in self.motors.items():
                if self._now - self._commanded[number] >= DEAD_MAN_S * 1e9:
                    motor.set(0.0)
                motor.advance(step * 1e-9)
            if self._now - self._reported >= REPORT_NS:
                self._reported = self._now
                self._report()

    def transmit(self) -> bytes:
        """Bytes to the computer."""
        self.advance()
        data = bytes(self._out)
        self._out.clear()
        return data

    def _report(self) -> None:
        if len(self._out) > 4096:  # nobody reads
            return
        for number, motor in self.motors.items():
            self._out += self.lines.encode(Count(number, motor.counts))
            self._out += self.lines.encode(Turns(number, motor.counts / _COUNTS_PER_TURN))


class SimulatedPort:
    """A port that leads to a simulated microcontroller; `plugged` is its cable."""

    def __init__(self, controller: SimulatedController) -> None:
        self.controller = controller
        self.plugged = True

    def open(self) -> SimulatedPort:
        """The port, if the cable is in."""
        self._check()
        self.controller.transmit()  # what was said while nobody listened
        return self

    def read(self) -> bytes:
        """What has come."""
        self._check()
        return self.controller.transmit()

    def write(self, data: bytes) -> None:
        """Send."""
        self._check()
        self.controller.receive(data)

    def close(self) -> None:
        """Nothing to close."""

    def _check(self) -> None:
        if not self.plugged:
            raise OSError("the cable is out")
