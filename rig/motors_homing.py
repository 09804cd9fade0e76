"""Homing: find both ends of a ring's travel by driving slowly against the stops."""

from __future__ import annotations

from typing import Literal

from acino_fte.rig.motors import MotorControl

TIMEOUT_S = 60.0
Phase = Literal["to the low end", "to the high end", "back", "done", "failed"]


class Homing:
    """One motor's homing, a step a turn of the loop.

    It drives down until the motor stalls, calls that place -margin (so that 0 is the lower limit), drives up
    until it stalls again, takes the limits from there, and goes back inside. What is not reached in
    `TIMEOUT_S`, or turns the wrong way, has failed; the old limits are then no longer trusted.

    Parameters
    ----------
    motor : MotorControl
    now_ns : int
        By the clock of the loop.
    """

    def __init__(self, motor: MotorControl, now_ns: int) -> None:
        self.phase: Phase = "to the low end"
        self._motor = motor
        self._began_ns = now_ns
        motor.stop()
        motor.update(now_ns)  # a stall from before is not a stop that was met
        motor.limits = None

    @property
    def under_way(self) -> bool:
        """Whether it goes on."""
        return self.phase not in ("done", "failed")

    def step(self, now_ns: int) -> None:
        """Say what the motor is to do now; before its update."""
        motor, settings = self._motor, self._motor.settings
        if not self.under_way:
            return
        counts = motor.encoder.counts
        if (
            now_ns - self._began_ns > TIMEOUT_S * 1e9
            or counts is None
            or motor.fault in ("turns the wrong way", "no counts come")
            or motor.encoder.in_doubt
        ):
            self.cancel()
        elif self.phase == "to the low end":
            if self._arrived(-settings.homing, now_ns):
                motor.encoder.zero(-settings.margin)
                self.phase = "to the high end"
        elif self.phase == "to the high end":
            if self._arrived(settings.homing, now_ns):
                high = counts - settings.margin
                if high <= 2 * settings.margin:
                    self.cancel()
                    return
                motor.limits = (0, high)
                self.phase = "back"
        elif motor.limits is not None and counts > motor.limits[1] - settings.margin:
            motor.command(-settings.homing, now_ns)
        else:
            motor.stop()
            self.phase = "done"

    def cancel(self) -> None:
        """Give up; the motor stops."""
        if self.under_way:
            self._motor.stop()
            self.phase = "failed"
            self._motor.limits = None

    def _arrived(self, power: float, now_ns: int) -> bool:
        """Whether the stop is met; as long as it is not, on with it."""
        if self._motor.fault == "stalled":
            self._motor.command(0.0, now_ns)
            self._motor.update(now_ns)
            return True
        self._motor.command(power, now_ns)
        return False
