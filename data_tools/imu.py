"""Attitude from a gyroscope: rates integrated on the rotations, with the uncertainty that grows on the way.

A gyroscope gives the angular velocity ω in its own frame. The attitude R (sensor to world, x_world = R
x_sensor) follows Ṙ = R [ω]×. Over a step from stamp t_k to t_(k+1), R_(k+1) = R_k exp([φ_k]×): the product
stays a rotation, and turns about several axes at once come out right. Axes integrated one by one, as angles,
do not. K samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from acino_fte.data_tools.recording import ImuSamples
from acino_fte.data_tools.rotations import rotation_matrix
from acino_fte.errors import InputError

Method = Literal["first", "midpoint", "simpson", "mean"]
METHODS: tuple[Method, ...] = ("first", "midpoint", "simpson", "mean")
_UNEVEN = 8.0  # a stencil whose steps differ by more is not interpolated by a cubic
_MOST_RATE, _MOST_FORCE = 1e3, 1e5  # rad/s, m/s²: beyond what any sensor can say
_GAP = 5.0  # median steps from which on a step is a gap


@dataclass(frozen=True)
class ImuNoise:
    """What is known of the errors of an inertial sensor; the numbers are those of a common MEMS sensor.

    Attributes
    ----------
    rate_density : float
        White noise of each rate, rad/s/√Hz.
    bias_sd : float
        Of each rate's bias before it is measured, rad/s.
    bias_walk : float
        Random walk of the bias, rad/s/√s.
    scale_sd : float
        Of the scale factor of each rate: 0.005 is half a percent.
    force_density : float
        White noise of each component of the specific force, m/s²/√Hz.
    force_bias_sd : float
        Of the bias of each component of the specific force, m/s².
    sway : float
        Mean acceleration over half a second of what the sensor sits on, where nothing shows any, m/s². It
        passes for tilt: 0.02 m/s² for 0.1°.
    """

    rate_density: float = 2e-4
    bias_sd: float = 0.01
    bias_walk: float = 2e-6
    scale_sd: float = 0.005
    force_density: float = 2e-3
    force_bias_sd: float = 0.1
    sway: float = 0.02


@dataclass(frozen=True, eq=False)
class Attitude:
    """Attitude of a sensor at its stamps. K samples.

    Attributes
    ----------
    time : (K,)
        s, since the first sample.
    first_ns : int
        Stamp of the first sample, ns, by the clock of the sensor.
    rotation : (K, 3, 3)
        Sensor to world. The world's z points up where gravity was used; its heading is a convention.
    covariance : (K, 3, 3)
        Of a small turn in the world, R_true = exp(η×) R, rad².
    bias : (3,)
        What was taken off the rates, rad/s.
    notes : tuple of str
        What the user should know.
    """

    time: np.ndarray
    first_ns: int
    rotation: np.ndarray
    covariance: np.ndarray
    bias: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def sd(self) -> np.ndarray:
        """(K,) Standard deviation about each axis (root mean square of the three), rad."""
        return np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 3.0)


def checked_samples(samples: ImuSamples, least: int = 2) -> tuple[ImuSamples, tuple[str, ...]]:
    """Samples that can be integrated, and notes: those that no sensor says or with the stamp before left out.

    Raises
    ------
    InputError
        Too few are left, or stamps run backwards.
    """
    time = np.asarray(samples.time_ns, dtype=np.int64)
    with np.errstate(invalid="ignore"):
        good = (np.abs(samples.rate) < _MOST_RATE).all(1) & (np.abs(samples.force) < _MOST_FORCE).all(1)
    rows = np.flatnonzero(good)
    step = np.diff(time[rows])
    if (step < 0).any():
        place = int(rows[1:][step < 0][0])
        raise InputError(
            "The stamps of the inertial samples run backwards.",
            key=f"sample {place}",
            expected="stamps that grow",
            found=f"{int(step[step < 0][0])} ns",
            remedy="repair the clock first (the recording has a jump), or cut the recording there",
        )
    rows = rows[np.append(True, step > 0)] if len(rows) else rows
    if len(rows) < least:
        raise InputError(
            "There are too few inertial samples.", expected=f"{least} or more", found=str(len(rows))
        )
    notes = []
    if len(rows) < len(time):
        left_out = f"{len(time) - len(rows)} of {len(time)} inertial samples left out"
        notes.append(f"{left_out} (no number, an impossible one, or a stamp twice).")
    kept = ImuSamples(
        time[rows], np.asarray(samples.rate)[rows], np.asarray(samples.force)[rows], samples.clock
    )
    gaps = gap_steps(seconds(kept))
    if gaps.any():
        longest = float(np.diff(seconds(kept))[gaps].max())
        notes.append(f"{int(gaps.sum())} gap(s) in the inertial samples, the longest of {longest:.3f} s.")
    return kept, tuple(notes)


def seconds(samples: ImuSamples) -> np.ndarray:
    """(K,) Stamps in s since the first."""
    return np.asarray(samples.time_ns - samples.time_ns[0]) * 1e-9


def gap_steps(time: np.ndarray) -> np.ndarray:
    """(K − 1,) Whether a step between stamps (K,) is a gap: more than five median steps."""
    step = np.diff(time)
    return step > _GAP * np.median(step) if len(step) else np.zeros(0, dtype=bool)


def turns(time: np.ndarray, rate: np.ndarray, method: Method = "simpson") -> np.ndarray:
    """Rotation vectors φ (K − 1, 3) of the steps between stamps, rad, in the sensor's frame.

    ``first``: φ = Δt ω_k, the exponential Euler step; error of the whole O(Δt).
    ``midpoint``: φ = Δt (ω_k + ω_(k+1))/2, O(Δt²) (Hairer, Lubich and Wanner 2006, section IV.7).
    ``simpson``: φ = Δt/6 (ω_k + 4 ω_m + ω_(k+1)) + Δt²/12 ω_k × ω_(k+1), with the rate ω_m in the middle from
    the cubic through four samples: O(Δt⁴). The sum is the Magnus series to fourth order (Blanes, Casas, Oteo
    and Ros 2009, section 5.2; the sign is that of Ṙ = R [ω]×); the cross product corrects for coning (Bortz
    1971).
    ``mean``: of a sensor that averages, each rate is the mean over the step that ends at its stamp:
    φ = α_(k+1) + α_k × α_(k+1)/12 with α_k = Δt ω_k (Savage 1998, part 1, equations 45 and 47 for one sample
    a step). Taken for momentary, such rates give an attitude that is half a step late.

    Parameters
    ----------
    time : (K,)
        s, growing; steps may differ.
    rate : (K, 3)
        rad/s, sensor's frame; momentary, but for ``mean``.
    method : {"first", "midpoint", "simpson", "mean"}
        Which of these.
    """
    step = np.diff(time)[:, None]
    before, after = rate[:-1], rate[1:]
    if method == "first":
        return step * before
    if method == "midpoint":
        return 0.5 * step * (before + after)
    if method == "mean":
        turned = step * after
        turned[1:] += np.cross(turned[:-1], turned[1:]) / 12.0
        return turned
    if method != "simpson":
        raise InputError(
            "This way to integrate is not known.",
            key="method",
            expected=", ".join(METHODS),
            found=str(method),
        )
    middle = _rate_between(time, rate)
    return step / 6.0 * (before + 4.0 * middle + after) + step**2 / 12.0 * np.cross(before, after)


def _rate_between(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Rates (K − 1, 3) in the middle of each step, by the cubic of Lagrange; beside gaps by the mean."""
    mean = 0.5 * (rate[:-1] + rate[1:])
    n = len(time)
    if n < 4:
        return mean
    first = np.clip(np.arange(n - 1) - 1, 0, n - 4)
    rows = first[:, None] + np.arange(4)
    nodes = time[rows]
    middle = 0.5 * (time[:-1] + time[1:])
    out = np.zeros_like(mean)
    for i in range(4):
        weight = np.ones(n - 1)
        for j in range(4):
            if j != i:
                weight *= (middle - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
        out += weight[:, None] * rate[rows[:, i]]
    steps = np.diff(nodes, axis=1)
    even = steps.max(1) < _UNEVEN * steps.min(1)
    return np.where(even[:, None], out, mean)


def integrate_rates(
    time: np.ndarray, rate: np.ndarray, *, start: np.ndarray | None = None, method: Method = "simpson"
) -> np.ndarray:
    """Attitudes (K, 3, 3), sensor to world, from rates: R_(k+1) = R_k exp([φ_k]×).

    Parameters
    ----------
    time : (K,)
        s, growing; steps may differ.
    rate : (K, 3)
        rad/s, sensor's frame, free of bias.
    start : (3, 3), optional
        Attitude at the first stamp; by default the sensor's frame there is the world.
    method : {"first", "midpoint", "simpson", "mean"}
        See :func:`turns`.
    """
    step = rotation_matrix(turns(np.asarray(time, dtype=float), np.asarray(rate, dtype=float), method))
    out = np.empty((len(time), 3, 3))
    now = out[0] = np.eye(3) if start is None else start
    for k in range(len(step)):
        now = out[k + 1] = now @ step[k]
    return out


def growth(
    time: np.ndarray, rotation: np.ndarray, rate: np.ndarray, noise: ImuNoise, bias_covariance: np.ndarray
) -> np.ndarray:
    """Covariance (K, 3, 3) that integration adds to the attitude, rad², for a small turn η in the world.

    The errors of rates enter as η̇ = −R (δb + n): with A(t) = ∫R dτ and P_b the covariance of the bias,

        cov η = A P_b Aᵀ + q_n t 1 + q_b ∫(A(t) − A(τ))(A(t) − A(τ))ᵀ dτ + σ_s² Σ_j v_j v_jᵀ,

    v_j = ∫R e_j ω_j dτ what the scale factor of axis j adds (follows Farrell 2008, section 11.4, kept in the
    world, where the equation has no other term). A gap adds the spread of the rates over it.
    """
    step = np.diff(time)[:, None, None]
    moment = _summed(0.5 * (rotation[1:] + rotation[:-1]) * step)
    elapsed = (time - time[0])[:, None, None]
    out = moment @ bias_covariance @ _t(moment) + noise.rate_density**2 * elapsed * np.eye(3)
    if noise.bias_walk:
        half = 0.5 * (moment[1:] + moment[:-1])
        mean, square = _summed(half * step), _summed(half @ _t(half) * step)
        cross = moment @ _t(mean)
        out = out + noise.bias_walk**2 * (elapsed * (moment @ _t(moment)) - cross - _t(cross) + square)
    if noise.scale_sd:
        turned = rotation * rate[:, None, :]
        scaled = _summed(0.5 * (turned[1:] + turned[:-1]) * step)
        out = out + noise.scale_sd**2 * (scaled @ _t(scaled))
    gaps = gap_steps(time)
    if gaps.any():
        lost = np.append(0.0, np.cumsum(np.where(gaps, 0.25 * np.diff(time) ** 2, 0.0)))
        out = out + lost[:, None, None] * rate.var(axis=0).mean() * np.eye(3)
    return out


def _summed(steps: np.ndarray) -> np.ndarray:
    """Sums (K, 3, 3) up to each stamp of what the steps (K − 1, 3, 3) add, from 0."""
    return np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])


def _t(matrix: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrix, -1, -2)


def gyro_attitude(
    samples: ImuSamples,
    *,
    bias: np.ndarray | None = None,
    bias_covariance: np.ndarray | None = None,
    start: np.ndarray | None = None,
    start_covariance: np.ndarray | None = None,
    noise: ImuNoise | None = None,
    method: Method = "simpson",
) -> Attitude:
    """Attitude from the rates alone.

    Parameters
    ----------
    samples : ImuSamples
        Those with NaN and those with a stamp twice are left out.
    bias, bias_covariance : (3,), (3, 3), optional
        Of the rates, rad/s, as :func:`acino_fte.data_tools.imu_rest.bias_from_rest` finds them; by default
        none is taken off and the noise says how large it may be.
    start, start_covariance : (3, 3), optional
        Attitude at the first sample and its covariance, as :func:`acino_fte.data_tools.imu_rest.levelled`
        gives them; by default the sensor's frame there is the world.
    noise : ImuNoise, optional
        Of the sensor; it makes the covariance.
    method : {"first", "midpoint", "simpson", "mean"}
        See :func:`turns`.
    """
    noise = noise or ImuNoise()
    samples, notes = checked_samples(samples)
    time = seconds(samples)
    if bias is None:
        bias, bias_covariance = np.zeros(3), noise.bias_sd**2 * np.eye(3)
        notes += ("The bias of the gyroscope is not known; the attitude drifts.",)
    if bias_covariance is None:
        bias_covariance = np.zeros((3, 3))
    rate = samples.rate - bias
    rotation = integrate_rates(time, rate, start=start, method=method)
    covariance = growth(time, rotation, rate, noise, bias_covariance)
    if start_covariance is not None:
        covariance = covariance + start_covariance
    return Attitude(time, int(samples.time_ns[0]), rotation, covariance, np.asarray(bias), notes)
