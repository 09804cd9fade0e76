"""Numbers of a plan as text."""

from __future__ import annotations

import math


def number(value: float, digits: int) -> str:
    """So many digits, never as a power of ten; ∞ for infinite ones."""
    if not math.isfinite(value):
        return "∞" if value > 0 else "—"
    if value == 0:
        return "0"
    places = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, places):.{max(places, 0)}f}"


def short(value: float, digits: int = 3) -> str:
    """At most so many digits, without zeros at the end of a fraction."""
    text = number(value, digits)
    return text.rstrip("0").rstrip(".") if "." in text else text


def hours(value: float) -> str:
    """Hours, or minutes below one."""
    return f"{number(value, 2 if value < 10 else 3)} h" if value >= 1.0 else f"{number(60 * value, 2)} min"


def seconds(value: float) -> str:
    """Seconds, or minutes and hours where they are many."""
    if value < 180:
        return f"{number(value, 3)} s"
    return f"{number(value / 60, 3)} min" if value < 10_800 else hours(value / 3600)


def percent(share: float) -> str:
    """A share in percent; only the whole is 100 %."""
    if share > 1 - 1e-9:
        return "100 %"
    return f"{min(100 * share, 99.9):.3g} %"


def sharp(near_m: float, far_m: float) -> str:
    """From … to …, with ∞."""
    return f"{number(near_m, 3)}–{number(far_m, 3)} m" if math.isfinite(far_m) else f"{number(near_m, 3)} m–∞"


def at_least(value: float) -> str:
    """Three digits, rounded up, for what must not be less."""
    return _rounded(value, up=True)


def at_most(value: float) -> str:
    """Three digits, rounded down, for what must not be more."""
    return _rounded(value, up=False)


def _rounded(value: float, up: bool) -> str:
    if not math.isfinite(value) or value == 0:
        return f"{value:g}"
    step = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
    steps = value / step
    if abs(steps - round(steps)) > 1e-6:  # else it has three digits already
        steps = math.ceil(steps) if up else math.floor(steps)
    return f"{round(steps) * step:.10g}"
