"""Formulas of incremental encoders: counts of a turn, and what a count is at a range."""

from __future__ import annotations

import math

_PAN = ("pan", "tilt")
_RING = ("zoom", "focus")


def counts_per_turn(pulses: float, *, times: float = 4.0, gear: float = 1.0) -> float:
    """Counts of the decoder in a turn of the shaft: pulses × edges of a pulse × gear.

    Quadrature has four edges a pulse (×4). An encoder of 1000 pulses has 4000 counts. One with 48 counts
    (12 pulses × 4) on a motor with a gear of 98.78 : 1 has 4741.44 in a turn of the output shaft.
    """
    return pulses * times * gear


def step_deg(counts: float) -> float:
    """Angle of one count, degrees."""
    return 360.0 / counts


def step_cm(counts: float, range_m: float) -> float:
    """Way of the optical axis at a range (m) in one count, cm: r tan(2π / counts).

    4000 counts are 0.09°, or 14 cm at 90 m. With up to four counts a turn it is infinite.
    """
    if counts <= 4.0:
        return math.inf
    return 100.0 * range_m * math.tan(2.0 * math.pi / counts)


def counts_for_step(cm: float, range_m: float) -> float:
    """Counts of a turn with which one count is so many cm at a range (m)."""
    return 2.0 * math.pi / math.atan(1e-2 * cm / range_m)


def turns_the_view(name: str) -> bool:
    """Whether an encoder of this name sits on an axis of the head."""
    return name.lower().startswith(_PAN)


def turns_the_lens(name: str, ring: str = "") -> bool:
    """Whether an encoder of this name sits on a ring of a lens: on this one, or on any."""
    return name.lower().startswith(ring or _RING)
