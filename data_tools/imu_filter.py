"""Attitude with gravity's help: an error-state Kalman filter that keeps the tilt from drifting.

The gyroscope carries the attitude; every half second the mean specific force, turned into the world, has to
be gravity pointing up. Its difference corrects the tilt, and what of the gyroscope's bias made it. The
heading has no such help: without a magnetometer it drifts, and its standard deviation says so.

Libraries have such filters (Madgwick's and Mahony's in `ahrs`), but as fixed gains for even steps, without an
uncertainty; here both count, and the filter is forty lines. The error is a small turn in the world, in which
the equations are linear without approximation of the motion (Solà 2017, section 7, with the global error).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.imu import Attitude, ImuNoise, Method, checked_samples, integrate_rates, seconds
from acino_fte.data_tools.imu_rest import Rest, bias_from_rest, levelled
from acino_fte.data_tools.recording import GRAVITY, ImuSamples
from acino_fte.data_tools.rotations import cross_matrix, rotation_matrix
from acino_fte.errors import InputError

_BLOCK = 0.5  # s between corrections
_SURE = 3.0  # standard deviations of noise, above which a force is one of motion
_LASTS = 2.0  # blocks of a push, whose errors are alike
_NEAR = 2  # blocks before and after: what moves now may have moved then
_UP = np.array([0.0, 0.0, 1.0])
_STATES = 9  # turn η in the world, bias of the rates, bias of the forces


@dataclass(frozen=True, eq=False)
class _Blocks:
    """What is summed once: attitudes C (K, 3, 3) from the identity, ∫C dt and ∫C f dt up to each.

    Between the edges (B + 1,) lie the blocks, each with the size of its accelerations (B,), m/s².
    """

    time: np.ndarray
    carried: np.ndarray
    moment: np.ndarray
    impulse: np.ndarray
    edges: np.ndarray
    motion: np.ndarray


def gravity_attitude(
    samples: ImuSamples,
    *,
    rest: Rest | None = None,
    forward: np.ndarray | None = None,
    noise: ImuNoise | None = None,
    method: Method = "simpson",
) -> Attitude:
    """Attitude from rates and forces, levelled by gravity, without a magnetometer.

    Parameters
    ----------
    samples : ImuSamples
        Those with NaN and those with a stamp twice are left out.
    rest : Rest, optional
        As :func:`acino_fte.data_tools.imu_rest.bias_from_rest` finds it, which is tried when it is not given;
        without any rest the filter starts from the first half second with a bias unknown to
        ``noise.bias_sd``.
    forward : (3,), optional
        Direction in the sensor's frame whose first heading is the world's x; by default the sensor's x.
    noise : ImuNoise, optional
        Of the sensor.
    method : {"first", "midpoint", "simpson", "mean"}
        Of the integration; see :func:`acino_fte.data_tools.imu.turns`.

    Returns
    -------
    Attitude
        Sensor to world, z up. The covariance has the tilt's, held by gravity, and the heading's, which grows.
    """
    noise = noise or ImuNoise()
    samples, notes = checked_samples(samples, least=8)
    if rest is None:
        try:
            rest = bias_from_rest(samples)
        except InputError:
            notes += ("The sensor never rests: the bias of its gyroscope is a guess, the heading drifts.",)
    bias = rest.bias if rest is not None else np.zeros(3)
    blocks = _sums(samples, bias, method, noise)
    state = np.zeros((_STATES, _STATES))
    state[3:6, 3:6] = rest.bias_covariance if rest is not None else noise.bias_sd**2 * np.eye(3)
    state[6:, 6:] = noise.force_bias_sd**2 * np.eye(3)
    start, state = _start(samples, rest, blocks, state, forward, noise)
    rotation, covariance, found = _filtered(blocks, start, state, noise, rest)
    return Attitude(blocks.time, int(samples.time_ns[0]), rotation, covariance, bias + found, notes)


def _sums(samples: ImuSamples, bias: np.ndarray, method: Method, noise: ImuNoise) -> _Blocks:
    time = seconds(samples)
    carried = integrate_rates(time, samples.rate - bias, method=method)
    step = np.diff(time)
    force = np.einsum("kij,kj->ki", carried, samples.force)
    moment = np.zeros_like(carried)
    moment[1:] = np.cumsum(0.5 * (carried[1:] + carried[:-1]) * step[:, None, None], axis=0)
    impulse = np.zeros_like(force)
    impulse[1:] = np.cumsum(0.5 * (force[1:] + force[:-1]) * step[:, None], axis=0)
    edges = np.unique(np.searchsorted(time, np.arange(0.0, time[-1] - 0.5 * _BLOCK, _BLOCK)))
    edges = np.append(edges, len(time) - 1)  # the last block is up to half as long again
    motion = _motion_size(time, force, impulse, edges, noise)
    return _Blocks(time, carried, moment, impulse, edges, motion)


def _motion_size(
    time: np.ndarray, force: np.ndarray, impulse: np.ndarray, edges: np.ndarray, noise: ImuNoise
) -> np.ndarray:
    """How large the mean acceleration in each block (B,) may be, m/s², from forces (K, 3) in one frame.

    Two things tell of it: how the force varies about a straight line within a block, and how far the mean of
    a block lies from the middle of its neighbours', each beyond what white noise makes. (Straight lines are
    left to the gyroscope's bias, which tilts gravity steadily.) A push begins and ends, so the largest of the
    blocks about one counts; and ``noise.sway`` is what cannot be seen.
    """
    first, last = edges[:-1], edges[1:]
    mean = (impulse[last] - impulse[first]) / (time[last] - time[first])[:, None]
    apart = np.zeros_like(mean)
    apart[1:-1] = mean[1:-1] - 0.5 * (mean[:-2] + mean[2:])
    most_white = 2.0 * noise.force_density**2 / np.median(np.diff(time))  # variance of a sample
    size = np.empty(len(first))
    for i, (a, b) in enumerate(zip(first, last, strict=True)):
        part, n = force[a : b + 1], b + 1 - a
        white = np.minimum(0.5 * (np.diff(part, axis=0) ** 2).mean(0), most_white)  # von Neumann 1941
        since = time[a : b + 1] - time[a : b + 1].mean()
        line = (since @ part) ** 2 / (since @ since) / n
        varied = part.var(axis=0) - line - white * (1.0 + _SURE * np.sqrt(3.0 / n))
        pushed = apart[i] ** 2 - _SURE**2 * 1.5 * white / n
        size[i] = np.maximum(varied, 0.0).max() + np.maximum(pushed, 0.0).max()
    near = np.pad(size, _NEAR, mode="edge")
    largest = np.lib.stride_tricks.sliding_window_view(near, 2 * _NEAR + 1).max(1)
    return np.sqrt(largest + noise.sway**2)


def _start(
    samples: ImuSamples,
    rest: Rest | None,
    blocks: _Blocks,
    state: np.ndarray,
    forward: np.ndarray | None,
    noise: ImuNoise,
) -> tuple[np.ndarray, np.ndarray]:
    """Attitude at the first sample, levelled at rest or over the first block, and the covariance with it.

    The tilt is wrong by what the accelerometer's bias makes it, and by what the gyroscope's turned the forces
    on the way to their mean, so these errors go together.
    """
    a, b = (rest.start, rest.stop - 1) if rest is not None else (0, int(blocks.edges[1]))
    duration = max(blocks.time[b] - blocks.time[a], 1e-9)
    force = (blocks.impulse[b] - blocks.impulse[a]) / duration  # in the frame of the first sample
    start, _ = levelled(force, forward=forward)
    other = max(rest.force_sd if rest is not None else float(blocks.motion[0]), 1e-4)
    span = slice(a, b + 1)
    flat = np.diag([1.0, 1.0, 0.0])
    later = flat @ start @ _time_mean(blocks.moment[span], blocks.time[span] - blocks.time[a])
    effect = np.hstack([later, _level(start @ (blocks.moment[b] - blocks.moment[a]) / duration)])
    state = state.copy()
    state[:3, 3:] = effect @ state[3:, 3:]
    state[3:, :3] = state[:3, 3:].T
    state[:3, :3] = effect @ state[3:, 3:] @ effect.T + (other / GRAVITY) ** 2 * flat
    return start, state


def _level(turned: np.ndarray) -> np.ndarray:
    """Effect (3, 3) of the bias b of the forces on a tilt that was levelled by them.

    From R f = g z + g z × η + R b, which levelling makes vertical: η = z × R b/g in the plane.
    """
    return cross_matrix(_UP) @ turned / GRAVITY


def _filtered(
    blocks: _Blocks, start: np.ndarray, state: np.ndarray, noise: ImuNoise, rest: Rest | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Attitudes (K, 3, 3), covariances (K, 3, 3) and the last bias (3,), block by block."""
    n = len(blocks.time)
    rotation, covariance = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    rotation[0], covariance[0] = start, state[:3, :3]
    gyro, force_bias = np.zeros(3), np.zeros(3)
    seen = (0, 0) if rest is None else (rest.start, rest.stop)
    for i, (a, b) in enumerate(zip(blocks.edges[:-1], blocks.edges[1:], strict=True)):
        span = slice(a, b + 1)
        world = rotation[a] @ blocks.carried[a].T  # from the frame of the first sample
        moment = blocks.moment[span] - blocks.moment[a]
        back = np.einsum("kji,kjl,l->ki", blocks.carried[span], moment, -gyro)
        rotation[span] = world @ blocks.carried[span] @ rotation_matrix(back)
        turned = world @ moment
        time = blocks.time[span] - blocks.time[a]
        between = _carried_covariance(state, turned, time, noise)
        covariance[span] = between
        state = _propagated(state, turned[-1], time[-1], between[-1], noise)
        known = i == 0 and rest is None or (seen[0] <= a and b < seen[1])  # the start has used these forces
        if not known:
            mean_turn = turned[-1] / time[-1]
            mean = world @ (blocks.impulse[b] - blocks.impulse[a]) / time[-1] - mean_turn @ force_bias
            middle = _time_mean(turned, time)
            mean = rotation_matrix(-middle @ gyro) @ mean  # the sums do not know what was found since
            later = turned[-1] - middle
            state, change = _corrected(state, mean, (mean_turn, later), blocks.motion[i], time[-1], noise)
            rotation[b] = rotation_matrix(change[:3]) @ rotation[b]
            gyro, force_bias = gyro + change[3:6], force_bias + change[6:]
            covariance[b] = state[:3, :3]
    return rotation, covariance, gyro


def _carried_covariance(
    state: np.ndarray, turned: np.ndarray, time: np.ndarray, noise: ImuNoise
) -> np.ndarray:
    """Covariance (B, 3, 3) of the turn within a block: η = η_0 − ∫R dτ δb − ∫R n dτ."""
    cross = -state[:3, 3:6] @ np.swapaxes(turned, 1, 2)
    grown = turned @ state[3:6, 3:6] @ np.swapaxes(turned, 1, 2)
    white = noise.rate_density**2 * time[:, None, None] * np.eye(3)
    return state[:3, :3] + cross + np.swapaxes(cross, 1, 2) + grown + white


def _propagated(
    state: np.ndarray, turned: np.ndarray, time: float, corner: np.ndarray, noise: ImuNoise
) -> np.ndarray:
    """The covariance (9, 9) at the end of a block."""
    step = np.eye(_STATES)
    step[:3, 3:6] = -turned
    state = step @ state @ step.T
    state[:3, :3] = corner
    state[3:6, 3:6] += noise.bias_walk**2 * time * np.eye(3)
    return state


def _time_mean(values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Mean over the time (B,) of values (B, …)."""
    step = np.diff(time).reshape(-1, *[1] * (values.ndim - 1))
    return (0.5 * (values[1:] + values[:-1]) * step).sum(0) / time[-1]


def _corrected(
    state: np.ndarray,
    mean: np.ndarray,
    effects: tuple[np.ndarray, np.ndarray],
    motion: float,
    time: float,
    noise: ImuNoise,
) -> tuple[np.ndarray, np.ndarray]:
    """The Kalman update by the mean force of a block, in the world: mean = g z + g [z]× η̄ + R̄ b + a.

    The mean turn of the block is η̄ = η + (M − M̄) δb from that at its end, M = ∫R dτ; `effects` are R̄, M − M̄.
    Accelerations a of the body are the noise; how large they are is read off the force itself: `motion`, as
    :func:`_motion_size` has it, and how far the length of the mean is from gravity's.
    """
    moved = max(_LASTS * motion**2, (float(np.linalg.norm(mean)) - GRAVITY) ** 2)
    variance = noise.force_density**2 / time + moved
    slope = np.zeros((3, _STATES))
    level = GRAVITY * cross_matrix(_UP)
    slope[:, :3], slope[:, 3:6], slope[:, 6:] = level, level @ effects[1], effects[0]
    innovation = mean - GRAVITY * _UP
    spread = slope @ state @ slope.T + variance * np.eye(3)
    gain = np.linalg.solve(spread, slope @ state).T
    keep = np.eye(_STATES) - gain @ slope
    return keep @ state @ keep.T + variance * gain @ gain.T, gain @ innovation
