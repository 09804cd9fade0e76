"""Minima of functions of one and of a few numbers.

SciPy has better ones for harder functions. Those of this project's priors are smooth, have a single minimum
and at most three arguments, and importing SciPy's takes as long as all the searches of a scene together.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_GOLDEN = 0.5 * (3.0 - np.sqrt(5.0))


def bounded_minimum(value: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Where a function is least between two bounds, to within the tolerance (Brent 1973, chapter 5).

    Parameters
    ----------
    value : callable
        The function.
    low, high : float
        The bounds.
    tolerance : float
        Of the argument.
    """
    x = second = third = low + _GOLDEN * (high - low)
    at_x = at_second = at_third = value(x)
    step = before = 0.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        if abs(x - middle) + 0.5 * (high - low) <= 2.0 * tolerance:
            break
        p, q = _parabola(x, second, third, at_x, at_second, at_third)
        inside = q * (low - x) < p < q * (high - x)
        if abs(before) > tolerance and inside and abs(p) < abs(0.5 * q * before):
            before, step = step, p / q
            if min(x + step - low, high - x - step) < 2.0 * tolerance:
                step = tolerance if x < middle else -tolerance
        else:
            before = (low if x >= middle else high) - x
            step = _GOLDEN * before
        trial = x + (step if abs(step) >= tolerance else np.copysign(tolerance, step))
        at_trial = value(trial)
        if at_trial <= at_x:
            low, high = (low, x) if trial < x else (x, high)
            third, second, x = second, x, trial
            at_third, at_second, at_x = at_second, at_x, at_trial
        else:
            low, high = (trial, high) if trial < x else (low, trial)
            if at_trial <= at_second or second == x:
                third, second, at_third, at_second = second, trial, at_second, at_trial
            elif at_trial <= at_third or third in (x, second):
                third, at_third = trial, at_trial
    return x


def _parabola(
    x: float, second: float, third: float, at_x: float, at_second: float, at_third: float
) -> tuple[float, float]:
    """Step p/q, q > 0, to the lowest point of the parabola through three points."""
    r = (x - second) * (at_x - at_third)
    q = (x - third) * (at_x - at_second)
    p, q = (x - third) * q - (x - second) * r, 2.0 * (q - r)
    return (-p, q) if q > 0 else (p, -q)


def descend(
    value: Callable[[np.ndarray], float],
    start: np.ndarray,
    *,
    flat: float,
    step: float = 1e-4,
    most: int = 25,
) -> np.ndarray:
    """Where a smooth function is least, by the method of Broyden, Fletcher, Goldfarb and Shanno (1970).

    Parameters
    ----------
    value : callable
        The function of (D,). It may be infinite.
    start : (D,)
        Where to begin; the function is finite there, and its curvature about one.
    flat : float
        Largest component of the gradient at which the search ends.
    step : float
        Of the forward differences that give the gradient.
    most : int
        Steps.
    """

    def gradient(x: np.ndarray, at_x: float) -> np.ndarray:
        return np.array([(value(x + shift) - at_x) / step for shift in step * np.eye(len(x))])

    x, at_x = np.array(start, dtype=float), value(start)
    slope = gradient(x, at_x)
    inverse, fresh = np.eye(len(x)), True
    for _ in range(most):
        if not np.isfinite(slope).all() or np.abs(slope).max() <= flat:
            break
        direction = -inverse @ slope
        moved, at_moved = _downhill(value, x, direction, at_x, float(direction @ slope))
        if moved is None and fresh:
            break
        if moved is None:  # the curvatures mislead: begin again with none
            inverse, fresh = np.eye(len(x)), True
            continue
        x, at_x = x + moved, at_moved
        new = gradient(x, at_x)
        turned, slope = new - slope, new
        bend = float(moved @ turned)
        if bend > 1e-12:
            if fresh:
                inverse = bend / float(turned @ turned) * np.eye(len(x))
            swap = np.eye(len(x)) - np.outer(moved, turned) / bend
            inverse, fresh = swap @ inverse @ swap.T + np.outer(moved, moved) / bend, False
    return x


def _downhill(
    value: Callable[[np.ndarray], float], x: np.ndarray, direction: np.ndarray, at_x: float, slope: float
) -> tuple[np.ndarray | None, float]:
    """A step along a direction that is lower enough, and the value there; None where there is none."""
    longest = float(np.abs(direction).max())
    length = min(1.0, 2.0 / longest) if longest > 0 else 0.0
    while slope < 0 and length * longest > 1e-6:
        found = value(x + length * direction)
        if found <= at_x + 1e-4 * length * slope:
            return length * direction, found
        bent = 2.0 * (found - at_x - length * slope)
        best = -slope * length**2 / bent if np.isfinite(bent) and bent > 0 else 0.0
        length = float(np.clip(best, 0.1 * length, 0.5 * length))
    return None, at_x
