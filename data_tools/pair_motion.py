"""How a point in space moves from frame to frame: modes of a velocity that fades, learnt from the data.

In mode m a displacement of a frame is v' = ρ v + N(0, q) on each axis, and of variance s² when nothing is
known of the one before. Places are measured with a covariance each. After a step e, the next one is in the
mode that explains e, or now and then anything (a turn at a wall, a start).
Shapes: K pairs, E links, T pairs of links that follow one another, M modes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.dot_candidates import Links

_LEAST = 1e-8  # m²
_NU = 8.0
_GATE = 25.0  # squared distance over the largest variance, beyond which only a sudden step leads there


@dataclass(frozen=True, eq=False)
class PairMotion:
    """Modes of motion.

    Attributes
    ----------
    share : (M,)
    speed2, change2 : (M,)
        s² and q, m².
    persistence : (M,)
        ρ.
    sudden : float
        Chance that a step has nothing to do with the one before.
    """

    share: np.ndarray
    speed2: np.ndarray
    change2: np.ndarray
    persistence: np.ndarray
    sudden: float


def first_motion(short: float, long: float) -> PairMotion:
    """A first guess from a short and a long displacement, m."""
    speed2 = np.maximum(np.array([short / 1.5, long / 2.2]) ** 2, _LEAST)
    return PairMotion(np.full(2, 0.5), speed2, 0.6 * speed2, np.full(2, 0.6), 0.1)


def _density(miss: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """t density of misses (E, 3) with covariances (E, 3, 3), 1/m³."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 0, 2]
    d, e, f = covariance[:, 1, 1], covariance[:, 1, 2], covariance[:, 2, 2]
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    det = np.maximum(a * ca + b * cb + c * cc, 1e-300)
    x, y, z = miss.T
    squared = (
        ca * x * x
        + (a * f - c * c) * y * y
        + (a * d - b * b) * z * z
        + 2 * (cb * x * y + cc * x * z + (b * c - a * e) * y * z)
    ) / det
    # constant of the t density with 8 degrees of freedom in 3 dimensions, covariance as its scale
    height = 0.06924 / np.sqrt(det)
    return height * (1 + np.maximum(squared, 0.0) / _NU) ** (-(_NU + 3) / 2)


def _first(motion: PairMotion, point: np.ndarray, covariance: np.ndarray, links: Links) -> np.ndarray:
    """(E, M): share of a mode times the density of a link's target from its source alone."""
    miss = point[links.target] - point[links.source]
    noise = covariance[links.target] + covariance[links.source]
    gap = links.gap.astype(float)
    out = np.empty((len(links), len(motion.share)))
    for m, (share, s2, rho) in enumerate(zip(motion.share, motion.speed2, motion.persistence, strict=True)):
        grown = noise + (s2 * gap ** (1 + rho))[:, None, None] * np.eye(3)
        out[:, m] = share * _density(miss, grown)
    return out


def begin_density(motion: PairMotion, point: np.ndarray, covariance: np.ndarray, links: Links) -> np.ndarray:
    """Density (E,), 1/m³, of every link's target from its source alone."""
    return _first(motion, point, covariance, links).sum(1)


def _modes(
    motion: PairMotion,
    point: np.ndarray,
    covariance: np.ndarray,
    links: Links,
    first: np.ndarray,
    second: np.ndarray,
) -> np.ndarray:
    """(T, M + 1): density of the second link's target after the first link, by mode; sudden ones last."""
    by_mode = _first(motion, point, covariance, links)
    begin = by_mode.sum(1)
    mode = by_mode / np.maximum(begin, 1e-300)[:, None]
    i, j, k = links.source[first], links.target[first], links.target[second]
    before, after = links.gap[first].astype(float), links.gap[second].astype(float)
    step = (point[j] - point[i]) * (after / before)[:, None]
    moved = point[k] - point[j]
    ratio = after / before
    trace = np.trace(covariance, axis1=1, axis2=2)
    out = np.zeros((len(first), len(motion.share) + 1))
    for m, (rho, q) in enumerate(zip(motion.persistence, motion.change2, strict=True)):
        miss = moved - rho * step
        w, own = rho * ratio, q * after * (after + before) / 2
        widest = own + trace[k] + (1 + w) ** 2 * trace[j] + w**2 * trace[i]
        near = np.flatnonzero(np.einsum("ti,ti->t", miss, miss) < _GATE * widest)
        w = w[near, None, None]
        noise = covariance[k[near]] + (1 + w) ** 2 * covariance[j[near]] + w**2 * covariance[i[near]]
        noise += own[near, None, None] * np.eye(3)
        out[near, m] = (1 - motion.sudden) * mode[first[near], m] * _density(miss[near], noise)
    out[:, -1] = motion.sudden * begin[second]
    return out


def follow_density(
    motion: PairMotion,
    point: np.ndarray,
    covariance: np.ndarray,
    links: Links,
    first: np.ndarray,
    second: np.ndarray,
) -> np.ndarray:
    """Density (T,), 1/m³, of the second link's target after the first link."""
    return _modes(motion, point, covariance, links, first, second).sum(1)


def learned(
    motion: PairMotion,
    point: np.ndarray,
    covariance: np.ndarray,
    links: Links,
    probability: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
) -> PairMotion:
    """The motion that fits links of given probability, from chains of three pairs without a gap."""
    use = (links.gap[first] == 1) & (links.gap[second] == 1)
    use &= probability[first] * probability[second] > 0.25
    first, second = first[use], second[use]
    if len(first) < 30:
        return motion
    weight = probability[first] * probability[second]
    by_mode = _modes(motion, point, covariance, links, first, second)
    whole = by_mode / np.maximum(by_mode.sum(1, keepdims=True), 1e-300)
    sudden = float((weight * whole[:, -1]).sum() / weight.sum())
    i, j, k = links.source[first], links.target[first], links.target[second]
    v, w = point[j] - point[i], point[k] - point[j]
    trace = np.trace(covariance, axis1=1, axis2=2)
    part = weight[:, None] * whole[:, :-1] + 1e-12
    total = part.sum(0)
    s2 = part.T @ ((v**2).sum(1) - trace[i] - trace[j]) / (3 * total)
    s2 = np.maximum(s2, np.maximum(_LEAST, part.T @ (v**2).sum(1) / (60 * total)))
    cross = part.T @ ((v * w).sum(1) + trace[j]) / (3 * total)
    rho = np.clip(cross / s2, 0.0, 0.98)
    change = np.empty(len(rho))
    for m in range(len(rho)):
        left = ((w - rho[m] * v) ** 2).sum(1)
        noise = trace[k] + (1 + rho[m]) ** 2 * trace[j] + rho[m] ** 2 * trace[i]
        mean = (part[:, m] * left).sum() / (3 * total[m])
        change[m] = max(float((part[:, m] * (left - noise)).sum() / (3 * total[m])), 0.03 * mean, _LEAST)
    share = (total + 5) / (total + 5).sum()
    return PairMotion(share, s2, change, rho, float(np.clip(sudden, 0.01, 0.3)))
