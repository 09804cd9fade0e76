"""Offsets and drifts of all clocks together: robust Gauss–Newton on the misses of corresponding rays.

Parameters of each camera but the reference: its offset at the middle of the recording, and the shift by
drift until its end, both in frames. Shapes: C cameras, Q parameters, S samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.clock_search import PairOffset
from acino_fte.data_tools.timed_rays import TimedRays, pair_misses

_SAMPLES = 8000  # of a pair
_ROUNDS = 20
_COARSE = 4  # every fourth sample until the steps are small
_DONE = 2e-4  # frames; samples come and go with every change of a clock
_TUKEY = 4.685
_BLOCKS = 60
_SIGNAL = 2.0  # squared rate of change against what noise makes of it, from which a clock is told
_FEWEST = 30


@dataclass(frozen=True, eq=False)
class ClockFit:
    """Clocks and their standard deviations, each (C,); cameras whose clock is unknown, and why."""

    offset: np.ndarray
    drift: np.ndarray
    offset_sd: np.ndarray
    drift_sd: np.ndarray
    n: np.ndarray
    unknown: dict[int, str]


@dataclass(frozen=True, eq=False)
class _Equations:
    """All samples at one set of clocks.

    z (S,): misses in robust standard deviations of their pair; rate (S,): their change per frame; noise (S,):
    the variance of the rate by noise; design (S, Q): change of the second camera's time with the parameters;
    pair (S,); time (S,).
    """

    z: np.ndarray
    rate: np.ndarray
    noise: np.ndarray
    design: np.ndarray
    pair: np.ndarray
    time: np.ndarray


def fit_clocks(
    rays: Sequence[TimedRays], pairs: Sequence[PairOffset], origin: int, middle: float, drift: bool
) -> ClockFit:
    """The clocks of all cameras that the pairs join with the reference.

    A clock counts as told when the rays change with time at least twice as much (squared) as pixel noise
    makes them seem to.
    """
    n_cameras = len(rays)
    frames = np.concatenate([one.frame for one in rays])
    half = max(float(np.abs(frames - middle).max()), 1.0) if len(frames) else 1.0
    start = np.zeros((n_cameras, 2))
    unknown: dict[int, str] = {}
    used = list(pairs)
    while True:
        joined = _spread_out(start, used, origin, half)
        for camera in set(range(n_cameras)) - joined - set(unknown):
            unknown[camera] = "no camera with a known clock sees its individuals"
        active = [pair for pair in used if pair.a in joined and pair.b in joined]
        free = sorted(joined - {origin})
        clocks = start.copy()
        clocks[list(unknown)] = 0.0
        if not free:
            break
        clocks, equations = _minimise(rays, active, clocks, free, middle, half, drift)
        silent = _silent(equations, active, free)
        if not silent:
            return _finish(equations, clocks, free, active, origin, unknown, half, drift)
        for camera in silent:
            unknown[camera] = "neither it nor the individuals move enough as it sees them"
        used = [pair for pair in used if not {pair.a, pair.b} & set(silent)]
    sd = np.where(np.arange(n_cameras) == origin, 0.0, np.inf)
    nothing = np.zeros(n_cameras)
    return ClockFit(nothing, nothing, sd, sd if drift else nothing, nothing.astype(int), unknown)


def _spread_out(start: np.ndarray, pairs: Sequence[PairOffset], origin: int, half: float) -> set[int]:
    """Fill the clocks (C, 2) from the reference on, over the clearest pairs; who was reached."""
    joined = {origin}
    start[origin] = 0.0
    while True:
        edges = [pair for pair in pairs if (pair.a in joined) != (pair.b in joined)]
        if not edges:
            return joined
        best = max(edges, key=lambda pair: pair.contrast * np.sqrt(pair.n))
        change = np.array([best.offset, best.drift * half])  # clock of a less that of b
        if best.a in joined:
            start[best.b] = start[best.a] - change
            joined.add(best.b)
        else:
            start[best.a] = start[best.b] + change
            joined.add(best.a)


def _equations(
    rays: Sequence[TimedRays],
    pairs: Sequence[PairOffset],
    clocks: np.ndarray,
    free: Sequence[int],
    middle: float,
    half: float,
    drift: bool,
    thin: int = 1,
) -> _Equations:
    column = {camera: i for i, camera in enumerate(free)}
    n_each = 2 if drift else 1
    parts = []
    for index, pair in enumerate(pairs):
        a, b = rays[pair.a], rays[pair.b]
        rows = np.flatnonzero(np.isin(a.individual, np.unique(b.individual)))
        rows = rows[:: thin * max(1, len(rows) // _SAMPLES)]
        time = a.frame[rows] + clocks[pair.a, 0] + clocks[pair.a, 1] * (a.frame[rows] - middle) / half
        run = 1 + clocks[pair.b, 1] / half
        own = middle + (time - middle - clocks[pair.b, 0]) / run
        found = pair_misses(a, b, rows, own)
        design = np.zeros((len(found.z), n_each * len(free)))
        for camera, sign, frame in ((pair.a, 1.0, found.frame_a), (pair.b, -1.0, found.own_b)):
            if camera in column:
                design[:, n_each * column[camera]] = sign / run
                if drift:
                    design[:, n_each * column[camera] + 1] = sign / run * (frame - middle) / half
        scale = 1.4826 * float(np.median(np.abs(found.z))) if len(found.z) else 1.0
        scale = max(scale, 1e-6)
        parts.append(
            (
                found.z / scale,
                found.rate / scale,
                found.noise,
                design,
                np.full(len(found.z), index),
                found.frame_a,
            )
        )
    z, rate, noise, design, which, time = (np.concatenate(values) for values in zip(*parts, strict=True))
    return _Equations(z, rate, noise, design, which, time)


def _minimise(
    rays: Sequence[TimedRays],
    pairs: Sequence[PairOffset],
    clocks: np.ndarray,
    free: Sequence[int],
    middle: float,
    half: float,
    drift: bool,
) -> tuple[np.ndarray, _Equations]:
    """Gauss–Newton with Tukey's weights; steps of two frames at most."""
    clocks = clocks.copy()
    if not drift:
        clocks[:, 1] = 0.0
    thin = _COARSE if min(len(one.frame) for one in rays) > 1000 else 1
    for _ in range(_ROUNDS):
        equations = _equations(rays, pairs, clocks, free, middle, half, drift, thin)
        weight = np.where(np.abs(equations.z) < _TUKEY, (1 - (equations.z / _TUKEY) ** 2) ** 2, 0.0)
        gradient = equations.rate[:, None] * equations.design
        normal = (gradient * weight[:, None]).T @ gradient
        normal[np.diag_indices_from(normal)] += 1e-9 * float(np.trace(normal)) + 1e-12
        step = -np.linalg.solve(normal, gradient.T @ (weight * equations.z))
        step = np.clip(step, -2.0, 2.0)
        clocks[list(free), : 2 if drift else 1] += step.reshape(len(free), -1)
        if thin == 1 and np.abs(step).max() < _DONE:
            break
        if np.abs(step).max() < 0.02:
            thin = 1
    return clocks, _equations(rays, pairs, clocks, free, middle, half, drift)


def _silent(equations: _Equations, pairs: Sequence[PairOffset], free: Sequence[int]) -> list[int]:
    """Cameras of which no pair says anything about time."""
    loud: set[int] = set()
    for index, pair in enumerate(pairs):
        rows = (equations.pair == index) & (np.abs(equations.z) < _TUKEY)
        if rows.sum() < _FEWEST:
            continue
        if (equations.rate[rows] ** 2).sum() > _SIGNAL * equations.noise[rows].sum():
            loud |= {pair.a, pair.b}
    return [camera for camera in free if camera not in loud]


def _finish(
    equations: _Equations,
    clocks: np.ndarray,
    free: Sequence[int],
    pairs: Sequence[PairOffset],
    origin: int,
    unknown: dict[int, str],
    half: float,
    drift: bool,
) -> ClockFit:
    """Standard deviations by the sandwich over blocks of time."""
    ratio = np.where(np.abs(equations.z) < _TUKEY, equations.z / _TUKEY, 1.0)
    psi = equations.z * (1 - ratio**2) ** 2
    slope = (1 - ratio**2) * (1 - 5 * ratio**2)
    signal = slope * (equations.rate**2 - equations.noise)
    curvature = (equations.design * signal[:, None]).T @ equations.design
    score = equations.design * (psi * equations.rate)[:, None]
    block = ((equations.time - equations.time.min()) * _BLOCKS / (np.ptp(equations.time) + 1)).astype(int)
    blocks = np.stack([np.bincount(block, column) for column in score.T], axis=-1)
    filled = int((np.bincount(block) > 0).sum())
    meat = blocks.T @ blocks * filled / max(filled - 1, 1)
    inverse = np.linalg.pinv(curvature)
    variance = np.diagonal(inverse @ meat @ inverse)
    sd = np.full((len(clocks), 2), np.inf)
    sd[origin] = 0.0
    n_each = 2 if drift else 1
    sd[list(free), :n_each] = np.sqrt(variance).reshape(len(free), n_each)
    if not drift:
        sd[:, 1] = 0.0
    n = np.zeros(len(clocks), int)
    for index, pair in enumerate(pairs):
        n[[pair.a, pair.b]] += int((equations.pair == index).sum())
    return ClockFit(clocks[:, 0], clocks[:, 1] / half, sd[:, 0], sd[:, 1] / half, n, unknown)
