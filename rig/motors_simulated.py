"""A simulated gearmotor with its encoder, between two stops."""

from __future__ import annotations

import math

FULL_SPEED = 7902.0
"""Counts a second at full power: 100 turns a minute of 4741.44 counts."""
_DRIVEN_S, _BRAKED_S = 0.05, 0.015
_FRICTION = 0.05


class SimulatedGearmotor:
    """First order: the speed goes to power × full speed in 50 ms, to zero in 15 ms when it brakes.

    Parameters
    ----------
    position : float
        Counts at the beginning.
    stops : (float, float)
        Where the ring cannot go on, in counts.
    full_speed : float
        Counts a second; negative for a motor whose wires are swapped.
    """

    def __init__(
        self,
        position: float = 0.0,
        stops: tuple[float, float] = (-math.inf, math.inf),
        full_speed: float = FULL_SPEED,
    ) -> None:
        self.position, self.stops, self.full_speed = position, stops, full_speed
        self.power, self.speed = 0.0, 0.0
        self.jammed = False
        self._zero = 0

    @property
    def counts(self) -> int:
        """Of the encoder, since the counter was set to zero."""
        return math.floor(self.position) - self._zero

    def reset(self) -> None:
        """Set the counter to zero."""
        self._zero = math.floor(self.position)

    def set(self, power: float) -> None:
        """Power from now on."""
        self.power = power

    def advance(self, seconds: float) -> None:
        """Let time pass; exact for a constant power."""
        if self.jammed:
            self.speed = 0.0
            return
        goal = 0.0 if abs(self.power) < _FRICTION else self.power * self.full_speed
        tau = _DRIVEN_S if goal else _BRAKED_S
        kept = math.exp(-seconds / tau)
        self.position += goal * seconds + (self.speed - goal) * tau * (1 - kept)
        self.speed = goal + (self.speed - goal) * kept
        low, high = self.stops
        if not low < self.position < high:
            self.position = min(max(self.position, low), high)
            self.speed = 0.0
