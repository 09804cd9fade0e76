"""What a camera's model can see, and its inverse: from pixels back to directions.

A lens is one-to-one about its axis only, up to where it folds: there the determinant of its Jacobian is zero.
The field of a model that has no inverse in closed form is star-shaped about the axis here: along every
azimuth it reaches as far as the determinant is positive. Within it Newton's method finds the one solution;
beyond it there is none to trust, and the answer is NaN.

The unknown of these models is their own coordinate of the ideal image, its *chart*: (a, b) = (X, Y)/Z of
``pinhole``, and the equidistant (p, q) = (X, Y) θ/r of the fisheyes, in which a lens is a polynomial and 90°
from the axis is no farther than elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

from acino_fte.projection import COEFFICIENTS, EQUIDISTANT, INTRINSICS, SHORT, programs

_RADII, _SECTORS, _START = 500, 96, 2000
_WIDEST = {False: np.radians(89.9), True: 0.5 * np.pi - 1e-6}  # of a plane chart, of an equidistant one
_NEWTON_STEPS, _DAMPED_STEPS = 6, 60
_EXACT, _CLOSE = 1e-13, 1e-11  # of the distorted normalised coordinates: where to stop, and what will do
_NO_INTRINSICS = np.array([1.0, 1.0, 0.0, 0.0])
_BLOCK = 4096  # values that a program works on at a time: three times faster than 30,000
_SHARP = 1e-6  # of a division lens' fold, where one rounding of the ray moves the pixel by 1e-6 px and more
_LAST, _STEEP = 1e-8, 0.1  # a step from this near, this far from a fold, is exact
_FROM_FOLD = 0.9  # a start at the very fold would have no step to take
_SEAM = 1e-9  # rad; the rounding allowed at the borders of a panorama


@cache
def compiled(model: str) -> dict[str, Callable[..., None]]:
    """The programs of a camera model as functions on arrays."""
    return {name: program.numpy_function for name, program in programs(model).items()}


def run(
    model: str, name: str, columns: tuple[np.ndarray, ...], parameters: np.ndarray, n_out: int
) -> np.ndarray:
    """Results (n_out, …) of a program on columns of one shape, a block that fits the cache at a time."""
    shape = columns[0].shape
    flat = [column.reshape(-1) for column in columns]
    values = parameters.tolist()
    if model == "pinhole" and name != "project" and not any(values[len(INTRINSICS) + SHORT :]):
        name = f"{name}_{SHORT}"
    out = np.empty((n_out, flat[0].size))
    with np.errstate(all="ignore"):
        for i in range(0, flat[0].size, _BLOCK):
            block = slice(i, i + _BLOCK)
            compiled(model)[name]([*(column[block] for column in flat), *values], out[:, block])
    return out.reshape(n_out, *shape)


def seen(model: str, coefficients: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Whether points in the camera's frame (…,) are where the model can see; False for NaN.

    In front of the camera (z > 0), but for three models that see beyond. ``division``: everywhere if k < 0.
    ``eucm``: where the depth is positive and the image has not folded, ``(1 − α) z + α d > 0`` and
    ``α z + (1 − α) d > 0`` with ``d² = β (x² + y²) + z²`` (the derivative of the radius for the angle has the
    sign of the latter; Khomutenko et al. 2016, eq. 12). ``equirectangular``: everywhere but in the centre.
    """
    if model == "equirectangular":
        return np.abs(x) + np.abs(y) + np.abs(z) > 0
    if model == "division" and coefficients[0] < 0:
        return (z > 0) | (np.abs(x) + np.abs(y) > 0)
    if model == "eucm":
        alpha, beta = coefficients
        d = np.sqrt(beta * (x**2 + y**2) + z**2)
        return ((1 - alpha) * z + alpha * d > 0) & (alpha * z + (1 - alpha) * d > 0)
    return z > 0


def closed_angle(model: str, coefficients: np.ndarray) -> float:
    """Angle from the axis up to which a model with an inverse in closed form is one-to-one, rad."""
    if model == "equirectangular":
        return np.pi
    if model == "division":
        k = coefficients[0]
        return np.pi if k < 0 else float(np.arctan2(1.0, 2.0 * np.sqrt(k)))
    if model == "eucm":
        alpha, beta = coefficients
        ratio = min(alpha, 1 - alpha) / max(alpha, 1 - alpha)
        return float(np.pi - np.arctan2(np.sqrt((1 - ratio**2) / beta), ratio))
    return 0.5 * np.pi


def closed_directions(model: str, parameters: np.ndarray, bent: np.ndarray) -> np.ndarray:
    """Unit directions (3, K) in the camera's frame of distorted coordinates (2, K); NaN outside the field."""
    a, b = bent
    coefficients = parameters[len(INTRINSICS) :]
    out = run(model, "direction", (a, b), parameters, 3)
    with np.errstate(all="ignore"):
        if model == "equirectangular":
            inside = (np.abs(a) <= np.pi + _SEAM) & (np.abs(b) <= 0.5 * np.pi + _SEAM)
        elif model == "division":
            inside = coefficients[0] * (a**2 + b**2) < 1 - _SHARP
        elif model == "fov":
            inside = np.hypot(a, b) * abs(coefficients[0]) < 0.5 * np.pi
        else:
            inside = np.isfinite(out[2])
        out /= np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    return np.where(inside, out, np.nan)


@dataclass(frozen=True, eq=False)
class Field:
    """The valid field of a lens without a closed inverse, in its chart.

    Attributes
    ----------
    turn, limit : (J,)
        Azimuths, rising from −π to π, and how far the field reaches there; one of each if the lens is radial.
    start_bent, start_angle : (I,)
        Distorted radius, rising, and angle from the axis of the radial part of the lens, where Newton begins.
    reach : float
        Largest distorted radius in the field.
    """

    model: str
    coefficients: np.ndarray
    turn: np.ndarray
    limit: np.ndarray
    start_bent: np.ndarray
    start_angle: np.ndarray
    reach: float

    @property
    def angle(self) -> float:
        """Angle from the axis up to which the lens is one-to-one at every azimuth, rad."""
        return float(_angle(self.model, self.limit.min()))

    def contains(self, chart: np.ndarray) -> np.ndarray:
        """Whether chart coordinates (2, K) are in the field."""
        radius = np.sqrt(chart[0] ** 2 + chart[1] ** 2)
        inside = radius <= self.limit.min()
        if len(self.limit) > 1 and not inside.all():
            rest = np.flatnonzero(~inside)
            turn = np.arctan2(chart[1, rest], chart[0, rest])
            inside[rest] = radius[rest] <= np.interp(turn, self.turn, self.limit)
        return inside

    def solve(self, bent: np.ndarray) -> np.ndarray:
        """Chart coordinates (2, K) of distorted ones (2, K); NaN outside the field."""
        radius = np.sqrt(bent[0] ** 2 + bent[1] ** 2)
        angle = np.interp(radius, self.start_bent, self.start_angle)
        start = bent * (_radius(self.model, angle) / np.where(radius > 0, radius, 1.0))
        near = radius <= self.reach  # False for NaN
        bent = np.where(near, bent, np.nan)
        with np.errstate(all="ignore"):
            guess, good = self._newton(start, bent)
            again = np.flatnonzero(near & ~good)
            if len(again):
                guess[:, again], good[again] = self._damped(start[:, again], bent[:, again])
        return np.where(good, guess, np.nan)

    def _newton(self, guess: np.ndarray, bent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Newton's steps for all; which of them (K,) have met their target in the field."""
        weight = _weight(bent)
        for step in range(_NEWTON_STEPS + 1):
            out = _bend(self.model, guess, self.coefficients)
            error = bent - out[:2]
            missed = np.maximum(np.abs(error[0]), np.abs(error[1])) * weight
            determinant = out[2] * out[5] - out[3] * out[4]
            worst = np.nanmax(missed, initial=0.0)
            if step == _NEWTON_STEPS or not worst > _EXACT:
                break
            guess = guess + _newton_step(out, error, determinant)
            if worst < _LAST and np.nanmin(determinant, initial=1.0) > _STEEP:
                missed = missed**2  # of this last step; NaN stays
                break
        return guess, (missed < _CLOSE) & (determinant > 0) & self.contains(guess)

    def _damped(self, guess: np.ndarray, bent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for the stubborn: a step that leaves the field or misses by more is shortened."""
        guess = np.where(self.contains(guess), _FROM_FOLD * guess, 0.0)
        scale, weight = np.ones(guess.shape[1]), _weight(bent)
        out = _bend(self.model, guess, self.coefficients)
        missed = np.hypot(*(bent - out[:2])) * weight
        for _ in range(_DAMPED_STEPS):
            determinant = out[2] * out[5] - out[3] * out[4]
            trial = guess + scale * _newton_step(out, bent - out[:2], determinant)
            bent_trial = _bend(self.model, trial, self.coefficients)
            missed_trial = np.hypot(*(bent - bent_trial[:2])) * weight
            better = (missed_trial < missed) & self.contains(trial)
            guess = np.where(better, trial, guess)
            out = np.where(better, bent_trial, out)
            missed = np.where(better, missed_trial, missed)
            scale = np.where(better, np.minimum(1.0, 2.0 * scale), 0.25 * scale)
            if not np.any((missed > _EXACT) & (scale > 1e-9)):
                break
        determinant = out[2] * out[5] - out[3] * out[4]
        return guess, (missed < _CLOSE) & (determinant > 0)


def _weight(bent: np.ndarray) -> np.ndarray:
    """By which misses (K,) count: far outside any image, by their share."""
    return 1.0 / np.maximum(1.0, 0.1 * np.maximum(np.abs(bent[0]), np.abs(bent[1])))


def normalised(model: str, chart: np.ndarray) -> np.ndarray:
    """Normalised coordinates (a, b) = (X, Y)/Z of chart coordinates, both (2, K)."""
    if model not in EQUIDISTANT:
        return chart
    theta = np.hypot(chart[0], chart[1])
    return chart * (np.tan(theta) / np.where(theta > 0, theta, 1.0) + (theta == 0))


@lru_cache(maxsize=512)
def field(model: str, coefficients: tuple[float, ...]) -> Field:
    """The valid field of a lens; made once for each set of coefficients."""
    k = np.array(coefficients)
    radial = np.array([0.0 if name[0] in "ps" else c for name, c in zip(COEFFICIENTS[model], k, strict=True)])
    along = _first_folds(model, radial, np.zeros(1))
    angle = np.linspace(0.0, _angle(model, along[0]), _START)
    radius = np.minimum(_radius(model, angle), along[0])
    bent = _bend(model, np.stack([radius, np.zeros_like(radius)]), radial)[0]
    if np.array_equal(radial, k):
        return Field(model, k, np.zeros(1), along, bent, angle, float(bent[-1]))
    turn = np.linspace(-np.pi, np.pi, _SECTORS + 1)
    limit = _first_folds(model, k, turn)
    rim = _bend(model, limit * np.stack([np.cos(turn), np.sin(turn)]), k)[:2]
    return Field(model, k, turn, limit, bent, angle, 1.01 * float(np.max(np.hypot(rim[0], rim[1]))))


def _first_folds(model: str, k: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Chart radius (J,) up to which the determinant is positive along azimuths (J,): sampled, then halved."""

    def positive(radius: np.ndarray, turn: np.ndarray) -> np.ndarray:
        out = _bend(model, np.stack(np.broadcast_arrays(radius * np.cos(turn), radius * np.sin(turn))), k)
        with np.errstate(all="ignore"):
            return out[2] * out[5] - out[3] * out[4] > 0

    widest = min(_WIDEST[model in EQUIDISTANT], _pole(model, k))
    radii = _radius(model, np.linspace(0.0, widest, _RADII))
    good = positive(radii, turn[:, None])
    ends = ~good.all(axis=1)
    first = np.where(ends, np.argmin(good, axis=1), _RADII - 1)
    low, high = radii[np.maximum(first - 1, 0)], radii[first]
    for _ in range(50):
        middle = 0.5 * (low + high)
        inside = positive(middle, turn)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return np.where(ends, low, radii[-1])


def _pole(model: str, k: np.ndarray) -> float:
    """Angle from the axis where the denominator of a pinhole lens, 1 + k4 r² + k5 r⁴ + k6 r⁶, is zero; or ∞.

    Beyond it a zero of the numerator nearby could hide the fold between two samples.
    """
    if model != "pinhole" or not k[5:8].any():
        return np.inf
    roots = np.roots([1.0, *k[5:8]])  # of 1/r²: no division by a coefficient near zero
    inverse = roots[(np.abs(roots.imag) <= 1e-6 * np.abs(roots)) & (roots.real > 0)].real
    return float(np.arctan(1.0 / np.sqrt(inverse.max()))) * (1 - 1e-9) if len(inverse) else np.inf


def _bend(model: str, chart: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Distorted coordinates and their slopes, (6, …), of chart coordinates (2, …)."""
    return run(model, "bend", (chart[0], chart[1]), np.concatenate([_NO_INTRINSICS, coefficients]), 6)


def _newton_step(out: np.ndarray, error: np.ndarray, determinant: np.ndarray) -> np.ndarray:
    return (
        np.stack([out[5] * error[0] - out[3] * error[1], out[2] * error[1] - out[4] * error[0]]) / determinant
    )


def _angle(model: str, radius: np.ndarray | float) -> np.ndarray:
    """Angle from the axis of a chart radius."""
    return np.asarray(radius if model in EQUIDISTANT else np.arctan(radius))


def _radius(model: str, angle: np.ndarray) -> np.ndarray:
    """Chart radius of an angle from the axis."""
    return angle if model in EQUIDISTANT else np.tan(angle)
