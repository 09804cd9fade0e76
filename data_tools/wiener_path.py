"""Smooth curves through noisy points at a few times: the most probable path, and how sure it is anywhere.

Every axis of the curve is an integrated Wiener process of order p: its p-th derivative is white noise of
density q (for p = 2 the most probable curve is a cubic smoothing spline, for p = 3 a quintic one; Wahba
1978). The state s = (x, ẋ, …) at the times t_k is a Markov chain,

    s_(k+1) = A(h) s_k + w,   A_ij = h^(j−i) / (j−i)!,   w ~ N(0, q Q(h)),
    Q_ij = h^(a+b+1) / ((a+b+1) a! b!)  with a = p−1−i, b = p−1−j,   h = t_(k+1) − t_k,

so all states have a block-tridiagonal precision matrix, and between two times the curve depends on the states
at both ends only. q has the greatest marginal likelihood of the points. Shapes: K points, p derivatives,
F times asked for. The time unit is the median step; the noise of a point is the same in all axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from acino_fte.data_tools.small_search import bounded_minimum

_SEARCH = (-12.0, 45.0)  # log of q over the noise's variance


@dataclass(frozen=True, eq=False)
class WienerPath:
    """The posterior of a curve at the times of its points.

    Attributes
    ----------
    time : (K,)
        Times of the points, rising.
    unit : float
        Time unit of the states.
    state : (K, p, D)
        Means of the D axes and their derivatives, per time unit.
    covariance : (K, p, p)
        Of the state of each axis; the axes are independent and alike.
    cross : (K − 1, p, p)
        Covariance of the state k + 1 with the state k.
    density : float
        q, per time unit.
    joined : (K − 1,) bool
        Whether the curve goes on from k to k + 1.
    """

    time: np.ndarray
    unit: float
    state: np.ndarray
    covariance: np.ndarray
    cross: np.ndarray
    density: float
    joined: np.ndarray

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means (F, D) and variances of each axis (F,); NaN outside and across gaps that are not joined."""
        time = np.asarray(time, dtype=float)
        if len(self.time) == 1:
            there = time == self.time[0]
            mean = np.where(there[:, None], self.state[0, 0], np.nan)
            return mean, np.where(there, self.covariance[0, 0, 0], np.nan)
        k = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 2)
        before, after = (time - self.time[k]) / self.unit, (self.time[k + 1] - time) / self.unit
        order = self.state.shape[1]
        first, noise_1 = transition(order, before)
        second, noise_2 = transition(order, after)
        with np.errstate(invalid="ignore"):
            total = second @ noise_1 @ second.transpose(0, 2, 1) + noise_2
            gain = noise_1 @ np.linalg.solve(total, second).transpose(0, 2, 1)
        rest = first - gain @ second @ first
        mean = (rest @ self.state[k] + gain @ self.state[k + 1])[:, 0]
        r, g = rest[:, :1], gain[:, :1]
        mixed = g @ self.cross[k] @ r.transpose(0, 2, 1)
        spread = r @ self.covariance[k] @ r.transpose(0, 2, 1) + g @ self.covariance[k + 1] @ g.transpose(
            0, 2, 1
        )
        left = noise_1 - gain @ second @ noise_1
        variance = (spread + 2 * mixed)[:, 0, 0] + self.density * left[:, 0, 0]
        outside = (before < 0) | (after < 0) | (~self.joined[k] & (before > 0) & (after > 0))
        return np.where(outside[:, None], np.nan, mean), np.where(outside, np.nan, np.maximum(variance, 0.0))

    def deleted_distance(self, points: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Squared distance (K,) of each point from what the others predict, in units of its variance.

        The mean over the axes of (y − m)² / (r − S), with posterior mean m and variance S and noise r
        (deletion formula of least squares; Cook and Weisberg 1982).
        """
        left = np.maximum(noise - self.covariance[:, 0, 0], 1e-9 * noise)
        missed = ((points - self.state[:, 0]) ** 2).mean(1)
        return missed / left


def fit_wiener_path(
    time: np.ndarray,
    points: np.ndarray,
    noise: np.ndarray,
    *,
    order: int = 3,
    max_gap: float = np.inf,
    density: float | None = None,
) -> WienerPath:
    """The most probable curve through noisy points.

    Parameters
    ----------
    time : (K,)
        Rising, each once.
    points : (K, D)
        Where the curve was seen.
    noise : (K,)
        Variance of each coordinate of each point, above 0.
    order : int
        p. Taken lower where there are few points.
    max_gap : float
        The curve is cut between points that are further apart in time.
    density : float, optional
        q; by default it is estimated.

    Returns
    -------
    WienerPath
        The curve.
    """
    time = np.asarray(time, dtype=float)
    gaps = np.diff(time)
    unit = float(np.median(gaps)) if len(gaps) else 1.0
    order = max(1, min(order, len(time) - 1))
    joined = gaps <= max_gap
    middle = points.mean(0)
    chain = _Chain(gaps / unit, joined, points - middle, np.asarray(noise, dtype=float), order)
    q = chain.best_density() if density is None else density
    state, covariance, cross = chain.posterior(q)
    state[:, 0] += middle
    return WienerPath(time, unit, state, covariance, cross, q, joined)


def transition(order: int, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A(h) and Q(h) of steps (N,), both (N, p, p)."""
    forward, noise = np.zeros((2, len(step), order, order))
    for i in range(order):
        for j in range(order):
            a, b = order - 1 - i, order - 1 - j
            noise[:, i, j] = step ** (a + b + 1) / ((a + b + 1) * factorial(a) * factorial(b))
            if j >= i:
                forward[:, i, j] = step ** (j - i) / factorial(j - i)
    return forward, noise


class _Chain:
    """The block-tridiagonal system of all states."""

    def __init__(
        self, step: np.ndarray, joined: np.ndarray, points: np.ndarray, noise: np.ndarray, order: int
    ) -> None:
        self._points, self._noise, self._order = points, noise, order
        forward, spread = transition(order, np.where(joined, step, 1.0))
        inverse = np.linalg.inv(spread) * joined[:, None, None]
        back = forward.transpose(0, 2, 1) @ inverse
        self._own = np.zeros((len(points), order, order))  # precision of the prior for q = 1
        self._own[1:] += inverse
        self._own[:-1] += back @ forward
        self._below = -back.transpose(0, 2, 1)
        self._log_spread = float(np.linalg.slogdet(spread[joined])[1].sum())
        self._n_joined = int(joined.sum())
        # where a piece begins its derivatives are nearly free: the whole extent of the curve in a time unit
        extent = 2.0 * float((points**2).sum(1).mean()) + 100.0 * float(noise.mean())
        begins = np.concatenate([[True], ~joined])
        self._free = np.zeros((len(points), order))
        self._free[begins, 1:] = 1.0 / extent

    def best_density(self) -> float:
        """q of greatest marginal likelihood, within wide bounds."""
        if not self._n_joined:
            return float(np.median(self._noise))
        base = float(np.log(np.median(self._noise)))

        def value(x: float) -> float:
            return -self._log_evidence(float(np.exp(base + x))) / len(self._points)

        return float(np.exp(base + bounded_minimum(value, *_SEARCH, 0.01)))

    def _blocks(self, q: float) -> tuple[np.ndarray, np.ndarray]:
        own = self._own / q
        diagonal = np.arange(self._order)
        own[:, diagonal, diagonal] += self._free
        own[:, 0, 0] += 1.0 / self._noise
        return own, self._below / q

    def _solve(self, q: float) -> tuple[np.ndarray, np.ndarray]:
        """Cholesky factor in LAPACK's bands, and the mean state (K, p, D)."""
        own, below = self._blocks(q)
        p, n = self._order, self._own.shape[0] * self._order
        band = np.zeros((2 * p, n))
        for j in range(p):
            for i in range(j, p):
                band[i - j, j::p] = own[:, i, j]
            for i in range(p):
                band[p + i - j, j : n - p : p] = below[:, i, j]
        factor = cholesky_banded(band, lower=True)
        right = np.zeros((n, self._points.shape[1]))
        right[::p] = self._points / self._noise[:, None]
        return factor, cho_solve_banded((factor, True), right).reshape(-1, p, right.shape[1])

    def _log_evidence(self, q: float) -> float:
        factor, state = self._solve(q)
        pull = self._points / self._noise[:, None]
        missed = float((self._points * pull).sum() - (pull * state[:, 0]).sum())
        prior = -self._log_spread - self._n_joined * self._order * np.log(q)
        return -0.5 * (missed + self._points.shape[1] * (2 * np.log(factor[0]).sum() - prior))

    def posterior(self, q: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (K, p, D), covariances (K, p, p) and those of neighbours (K − 1, p, p)."""
        _, state = self._solve(q)
        own, below = self._blocks(q)
        n = len(own)
        pivot, gain = own.copy(), np.empty_like(below)
        for k in range(1, n):
            gain[k - 1] = below[k - 1] @ np.linalg.inv(pivot[k - 1])
            pivot[k] -= gain[k - 1] @ below[k - 1].T
        covariance = np.linalg.inv(pivot)
        cross = np.empty_like(below)
        for k in range(n - 2, -1, -1):
            cross[k] = -covariance[k + 1] @ gain[k]
            covariance[k] -= gain[k].T @ cross[k]
        return state, covariance, cross
