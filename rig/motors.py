"""A motor on a ring of the lens: from what the operator wants to what the motor gets.

Between the two stand, in this order: the dead-man (no command for `dead_man_s`: stop), faults, the ends of
the travel, and a ramp. A stop is never ramped. Power is -1 … 1, positive where counts grow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol

from acino_fte.rig.encoders import Encoder
from acino_fte.rig.gpio import PhaseEnable
from acino_fte.rig.serial_frames import MAX_SPEED

DEAD_MAN_S = 0.12
"""Of either side of the line. With the loop's period and the motor's own stopping it stays below 0.2 s."""
Fault = Literal["", "stalled", "turns the wrong way", "no counts come"]


class MotorOutput(Protocol):
    """What drives a motor."""

    def set(self, power: float) -> None:
        """Power from now on, -1 … 1; 0 brakes."""


class HBridge:
    """A DRV8801 on two pins, PHASE and ENABLE. Before it turns round it brakes."""

    def __init__(self, pins: PhaseEnable) -> None:
        self._pins = pins
        self._forward = True

    def set(self, power: float) -> None:
        """Power from now on."""
        power = possible(power)
        forward = power > 0 if power else self._forward
        if forward != self._forward:
            self._pins.set(self._forward, 0.0)
            self._forward = forward
        self._pins.set(forward, abs(power))

    def close(self) -> None:
        """Brake, and give the pins back."""
        self.set(0.0)
        self._pins.close()


class LinkOutput:
    """A motor behind the microcontroller: keeps the speed that the next command carries."""

    def __init__(self, motor: int) -> None:
        self.motor = motor
        self.speed = 0

    def set(self, power: float) -> None:
        """Power from now on."""
        self.speed = round(possible(power) * MAX_SPEED)


def possible(power: float) -> float:
    """The power within -1 … 1; what is no number is 0, and never the full power that ``min`` makes of it."""
    return max(-1.0, min(1.0, power)) if math.isfinite(power) else 0.0


@dataclass(frozen=True)
class MotorSettings:
    """How a motor is driven.

    Attributes
    ----------
    dead_man_s : float
        Without a command for this long it stops.
    ramp_s : float
        From standing to full power.
    slow_zone : float
        Counts before an end of the travel in which it slows down.
    creep : float
        Least power that still moves it.
    unhomed : float
        Greatest power as long as the ends of the travel are not known.
    homing : float
        Power towards the ends.
    margin : int
        Counts that stay between the ends and the stops that homing met.
    stall_s, stall_counts : float
        It is stalled if it moves less than this in this time, at more than `creep`.
    reversed_counts : float
        It turns the wrong way if it moves this much against its power in the same time.
    silent_s : float
        It stops if it has power and the microcontroller has reported nothing for this long.
    """

    dead_man_s: float = DEAD_MAN_S
    ramp_s: float = 0.25
    slow_zone: float = 2000.0
    creep: float = 0.08
    unhomed: float = 0.3
    homing: float = 0.25
    margin: int = 100
    stall_s: float = 0.3
    stall_counts: float = 5.0
    reversed_counts: float = 50.0
    silent_s: float = 0.2


class MotorControl:
    """One motor with its encoder.

    Parameters
    ----------
    encoder : Encoder
        Polled by whoever runs the loop, before :meth:`update`.
    output : MotorOutput
        The bridge, or the line to the microcontroller.
    settings : MotorSettings
    limits : (int, int), optional
        Ends of the travel in counts. Without, or when the encoder's zero is not sure, it is driven slowly.
    """

    def __init__(
        self,
        encoder: Encoder,
        output: MotorOutput,
        settings: MotorSettings | None = None,
        limits: tuple[int, int] | None = None,
    ) -> None:
        self.encoder, self.output = encoder, output
        self.settings = settings or MotorSettings()
        self.limits = limits
        self.power = 0.0
        self.fault: Fault = ""
        self._wish, self._wish_ns = 0.0, -(10**18)
        self._blocked = 0
        self._updated_ns: int | None = None
        self._watched: tuple[int, int, int] | None = None
        self._powered_ns: int | None = None

    @property
    def homed(self) -> bool:
        """Whether the ends of the travel are known and hold."""
        return self.limits is not None and self.encoder.certain

    def command(self, power: float, now_ns: int) -> None:
        """What the operator wants, to be said again before `dead_man_s` is over.

        Parameters
        ----------
        power : float
            -1 … 1.
        now_ns : int
            By the clock of the loop (monotonic).
        """
        self._wish, self._wish_ns = possible(power), now_ns

    def stop(self) -> None:
        """At once."""
        self._wish = 0.0
        self._set(0.0)

    def alive(self, now_ns: int) -> bool:
        """Whether a command came recently enough; never by a clock that went back."""
        return 0 <= now_ns - self._wish_ns < self.settings.dead_man_s * 1e9

    def update(self, now_ns: int) -> float:
        """Drive the motor, at least every 20 ms.

        Returns
        -------
        float
            The power that it got.
        """
        wish = self._wish if self.alive(now_ns) else 0.0
        passed = 0.0 if self._updated_ns is None else (now_ns - self._updated_ns) * 1e-9
        self._updated_ns = now_ns
        if not 0 <= passed <= self.settings.dead_man_s:  # the loop hung: what it drives has stopped meanwhile
            self.power, self._watched, passed = 0.0, None, 0.0
        self._listen(now_ns)
        self._watch(now_ns)
        if wish == 0.0 or self.fault:
            self._release(wish)
        target = 0.0 if self._is_blocked(wish) else self._limited(wish)
        self._set(self._ramped(target, passed))
        return self.power

    def _release(self, wish: float) -> None:
        """A fault ends when the operator lets go or turns round; the wrong way only by letting go."""
        if wish == 0.0 or (self.fault == "stalled" and wish * self._blocked < 0):
            self.fault, self._blocked = "", 0

    def _is_blocked(self, wish: float) -> bool:
        return bool(self.fault) and wish != 0.0

    def _limited(self, wish: float) -> float:
        """The wish within the ends of the travel; slower before them."""
        counts = self.encoder.counts
        if self.limits is None or not self.homed or counts is None:
            return max(-self.settings.unhomed, min(self.settings.unhomed, wish))
        left = self.limits[1] - counts if wish > 0 else counts - self.limits[0]
        if left <= 0:
            return 0.0
        most = max(left / self.settings.slow_zone, self.settings.creep)
        return max(-most, min(most, wish))

    def _ramped(self, target: float, passed_s: float) -> float:
        """The next power: quicker only by the ramp, slower or braking at once."""
        power = self.power if self.power * target > 0 else 0.0
        if abs(target) <= abs(power):
            return target
        most = abs(power) + passed_s / self.settings.ramp_s
        return max(-most, min(most, target))

    def _listen(self, now_ns: int) -> None:
        """Whether counts come while it has power: without them nothing says where it is."""
        if not self.power:
            self._powered_ns = None
            return
        if self._powered_ns is None:
            self._powered_ns = now_ns
        heard = self.encoder.source.heard_ns
        if heard is not None and now_ns - max(heard, self._powered_ns) >= self.settings.silent_s * 1e9:
            self.encoder.interrupted()
            self._fail("no counts come", 0)

    def _watch(self, now_ns: int) -> None:
        """Whether it moves, and the right way, while it has power."""
        counts, sign = self.encoder.counts or 0, (self.power > 0) - (self.power < 0)
        if abs(self.power) < self.settings.creep:
            self._watched = None
            return
        if self._watched is None or self._watched[2] != sign:
            self._watched = now_ns, counts, sign
            return
        since, start, _ = self._watched
        moved = (counts - start) * sign
        if moved <= -self.settings.reversed_counts:
            self._fail("turns the wrong way", sign)
        elif self.fault:
            return
        elif now_ns - since >= self.settings.stall_s * 1e9:
            self._watched = now_ns, counts, sign
            if moved < self.settings.stall_counts:
                self._fail("stalled", sign)

    def _fail(self, fault: Fault, sign: int) -> None:
        self.fault, self._blocked, self._watched = fault, sign, None

    def _set(self, power: float) -> None:
        self.power = power
        self.output.set(power)
