"""How a dot moves in the image: in modes, each a velocity that fades and a jitter, learnt from the dots.

In mode m the displacement of a frame is v' = ρ v + N(0, s²(1 − ρ²)) on each axis, and the dot is seen
with jitter of variance R (noise of the detector included). A bird on a perch has a small s, one in flight
a large one. The place of the next dot is predicted by a Kalman filter for each mode; the odds of the
modes follow from how well each predicted so far (a multiple-model filter; Bar-Shalom, Li & Kirubarajan
2001, section 11.6). A mode whose prediction fails badly begins anew at the dot.
Shapes: E states, M modes, G gaps.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

_TAIL = 6.0  # degrees of freedom of the t distribution of a miss
_SWITCH = 0.03  # chance that the mode is another one after a frame
_LOST = 25.0
_LEAST = 1e-4  # px²


@dataclass(frozen=True, eq=False)
class Motion:
    """Modes of motion, (M,) each.

    Attributes
    ----------
    share : (M,)
        How frequent the modes are.
    speed2 : (M,)
        s², variance of a frame's displacement on one axis, px².
    persistence : (M,)
        ρ.
    jitter2 : (M,)
        R, px².
    stretch : (M,)
        Variance of a miss over what the filter says.
    """

    share: np.ndarray
    speed2: np.ndarray
    persistence: np.ndarray
    jitter2: np.ndarray
    stretch: np.ndarray


@dataclass(frozen=True, eq=False)
class States:
    """Filtered states, one a mode; both axes have one covariance.

    Attributes
    ----------
    place, velocity : (E, M, 2)
        px, px/frame.
    pp, pv, vv : (E, M)
        Covariance of place and velocity on one axis.
    odds : (E, M)
        Probability of each mode.
    """

    place: np.ndarray
    velocity: np.ndarray
    pp: np.ndarray
    pv: np.ndarray
    vv: np.ndarray
    odds: np.ndarray

    def __getitem__(self, which: np.ndarray) -> States:
        return States(*(getattr(self, f.name)[which] for f in fields(self)))

    def put(self, which: np.ndarray, other: States) -> None:
        """Write other states in the places `which`."""
        for f in fields(self):
            getattr(self, f.name)[which] = getattr(other, f.name)


def begun(xy: np.ndarray, motion: Motion) -> States:
    """States of dots (E, 2) that nothing is known of but their place."""
    shape = len(xy), len(motion.share)

    def of(value: np.ndarray) -> np.ndarray:
        return np.broadcast_to(value, shape)

    place = np.broadcast_to(xy[:, None], (*shape, 2))
    return States(
        place, np.zeros((*shape, 2)), of(motion.jitter2), np.zeros(shape), of(motion.speed2), of(motion.share)
    )


def step(states: States, motion: Motion) -> States:
    """The states a frame later."""
    rho = motion.persistence
    velocity = rho[:, None] * states.velocity
    vv = rho**2 * states.vv + motion.speed2 * (1 - rho**2)
    pp = states.pp + 2 * rho * states.pv + vv
    odds = (1 - _SWITCH) * states.odds + _SWITCH * motion.share
    return States(states.place + velocity, velocity, pp, rho * states.pv + vv, vv, odds)


def log_density(states: States, xy: np.ndarray, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Log-density (E, M), 1/px², of a dot (E, 2) in each mode, and its squared distance over the variance."""
    variance = motion.stretch * (states.pp + motion.jitter2)
    squared = ((xy[:, None] - states.place) ** 2).sum(2) / variance
    return -np.log(2 * np.pi * variance) - (_TAIL + 2) / 2 * np.log1p(squared / _TAIL), squared


def density(states: States, xy: np.ndarray, motion: Motion) -> np.ndarray:
    """Density (E,), 1/px², of a dot (E, 2) whatever the mode."""
    logs, _ = log_density(states, xy, motion)
    return (states.odds * np.exp(logs)).sum(1)


def density_at(states: States, which: np.ndarray, xy: np.ndarray, motion: Motion) -> np.ndarray:
    """As :func:`density`, of dots (T, 2) after the states `which` (T,)."""
    variance = motion.stretch * (states.pp + motion.jitter2)
    height = states.odds / (2 * np.pi * variance)
    narrow = 1.0 / (_TAIL * variance)
    total = np.zeros(len(which))
    for m in range(len(motion.share)):
        miss = xy - states.place[:, m][which]
        squared = np.einsum("tk,tk->t", miss, miss)
        base = 1.0 + squared * narrow[:, m][which]
        base *= base
        total += height[:, m][which] / (base * base)  # to the power (_TAIL + 2) / 2 = 4
    return total


def updated(states: States, xy: np.ndarray, motion: Motion) -> tuple[States, np.ndarray]:
    """Predicted states after a dot (E, 2) was seen, and the squared distances (E, M) over their variance."""
    logs, squared = log_density(states, xy, motion)
    odds = states.odds * np.exp(logs - logs.max(1, keepdims=True))
    odds = odds / odds.sum(1, keepdims=True)
    variance = states.pp + motion.jitter2
    miss = xy[:, None] - states.place
    gain_p, gain_v = states.pp / variance, states.pv / variance
    new = States(
        states.place + gain_p[..., None] * miss,
        states.velocity + gain_v[..., None] * miss,
        states.pp * (1 - gain_p),
        states.pv * (1 - gain_p),
        states.vv - gain_v * states.pv,
        odds,
    )
    row, mode = np.nonzero(squared > _LOST)
    if len(row):
        new.place[row, mode], new.velocity[row, mode] = xy[row], 0.0
        new.pp[row, mode], new.pv[row, mode] = motion.jitter2[mode], 0.0
        new.vv[row, mode] = motion.speed2[mode]
    return new, squared


def first_motion(slow: float, fast: float, noise: float | None) -> Motion:
    """A first guess from a short and a long displacement (px, standard deviations on an axis)."""
    total = np.array([slow, fast]) ** 2
    least = _LEAST if noise is None else noise**2
    jitter = np.maximum(total / 4, least)
    ones = np.ones(2)
    return Motion(ones / 2, np.maximum(total / 2, _LEAST), 0.5 * ones, jitter, ones)


def learn_motion(
    before: Motion,
    moved: np.ndarray,
    chain: np.ndarray,
    weight: np.ndarray,
    mode: np.ndarray,
    squared: np.ndarray,
    noise: float | None,
) -> Motion:
    """The modes that fit links best.

    With the covariances c₀, c₁, c₂ of displacements no, one and two frames apart: c₀ = s² + 2R,
    c₁ = ρ s² − R, c₂ = ρ² s². So R² + 2 (c₁ + c₂) R + c₁² − c₀ c₂ = 0.

    Parameters
    ----------
    before : Motion
        The motion so far.
    moved : (E, 2)
        Displacement of every link, px/frame.
    chain : (H, 3) int
        Links that follow one another without a gap.
    weight : (E,)
        Probability of the links.
    mode : (E, M)
        Probability of the modes.
    squared : (E, M)
        Squared distance of each link's target from the prediction over its variance.
    noise : float, optional
        Least jitter, px.
    """
    least = _LEAST if noise is None else noise**2
    by_mode = weight[:, None] * mode + 1e-12
    share = (by_mode.sum(0) + 1) / (by_mode.sum() + len(before.share))
    tail = (_TAIL + 2) / (_TAIL + squared)
    stretch = before.stretch * ((by_mode * tail * squared).sum(0) + 10) / (2 * by_mode.sum(0) + 10)
    new = replace(before, share=share, stretch=np.clip(stretch, 0.3, 10.0))
    if not len(chain):
        return new
    joint = weight[chain].prod(1)[:, None] * mode[chain].prod(1)
    heavy = joint.sum(0)
    a, b, c = (moved[chain[:, k]] for k in range(3))
    robust = (joint * tail[chain[:, 2]], joint * tail[chain].min(1))
    c0 = (robust[1] * ((a**2 + b**2 + c**2).sum(1)[:, None] / 6)).sum(0) / (robust[1].sum(0) + 1e-12)
    c1 = (robust[1] * (((a * b) + (b * c)).sum(1)[:, None] / 4)).sum(0) / (robust[1].sum(0) + 1e-12)
    c2 = (robust[1] * ((a * c).sum(1)[:, None] / 2)).sum(0) / (robust[1].sum(0) + 1e-12)
    jitter = -(c1 + c2) + np.sqrt(np.maximum((c1 + c2) ** 2 - c1**2 + c0 * np.maximum(c2, 0), 0))
    jitter = np.clip(jitter, np.maximum(least, 0.01 * c0), np.maximum(c0 / 2, least))
    speed = np.maximum(c0 - 2 * jitter, 0.001 * c0 + _LEAST)
    rho = np.clip((c1 + jitter) / speed, 0.0, 0.995)
    enough = heavy > 8
    return replace(
        new,
        speed2=np.where(enough, speed, before.speed2),
        persistence=np.where(enough, rho, before.persistence),
        jitter2=np.where(enough, jitter, before.jitter2),
    )
