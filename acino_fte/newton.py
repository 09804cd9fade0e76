"""Projected Newton steps with the banded factorisation: the quick way to the neighbourhood of a minimum.

A problem min f(x), l ≤ x ≤ u, whose Hessian is block-banded with an arrow (:mod:`acino_fte.arrow`). Variables
that stand at a bound, and whose gradient pushes against it, are held; the others take a Newton step, and the
path along it is bent at the bounds (Bertsekas 1982, *Projected Newton methods for optimization problems with
simple constraints*):

    F = {i : not held},   s_F = −H_FF⁻¹ g_F,   x(α) = clip(x + α s, l, u),

with the first α that lowers f by σ·gᵀ(x − x(α)), of 1 and then minima of parabolas through what was tried.
A general sparse solver has to find this structure again in every iteration, and IPOPT has to bend its path
around the bounds from far away; from where these steps end, it has little or nothing left to do. A singular
H, of a motion that the data do not hold everywhere, is damped (Levenberg 1944).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from acino_fte.arrow import ArrowFactor, NotPositiveDefinite
from acino_fte.condensed import Condensed

_DECREASE = 1e-4  # σ of Armijo's rule
_TRIALS = 12
_SHORTER = (0.1, 0.5)  # times the length, at least and at most, after a trial that does not lower enough
_DAMPINGS = (1e-9, 1e-6, 1e-3)  # of a singular Hessian, relative to the mean of its diagonal


@dataclass(frozen=True, eq=False)
class Approach:
    """Where the steps ended: x, f(x), their number, and whether x meets the tolerance."""

    x: np.ndarray
    value: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Limits:
    """When to stop.

    Attributes
    ----------
    max_iter : int
    tolerance : float
        Largest entry of the gradient of what is not held.
    max_seconds : float
    """

    max_iter: int
    tolerance: float
    max_seconds: float = np.inf


def approach(
    condensed: Condensed,
    start: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    limits: Limits,
    after: Callable[[int, float], bool] | None = None,
) -> Approach:
    """Newton steps from `start` (K,) while they lower the objective.

    Parameters
    ----------
    condensed : Condensed
        Its variables are x.
    start : (K,)
        Where to begin.
    lower, upper : (K,)
        Bounds.
    limits : Limits
        When to stop.
    after : callable, optional
        Called with (iteration, objective) at the start and after each step; False ends it.

    Returns
    -------
    Approach
    """
    began = time.perf_counter()
    x = np.clip(start, lower, upper)
    value = condensed.objective(x)
    if after is not None and not after(0, value):
        return Approach(x, value, 0, False)
    for iteration in range(limits.max_iter + 1):
        gradient = condensed.gradient(x)
        held = (x <= lower) & (gradient > 0) | (x >= upper) & (gradient < 0)
        if np.abs(np.where(held, 0.0, gradient)).max(initial=0.0) <= limits.tolerance:
            return Approach(x, value, iteration, True)
        late = time.perf_counter() - began > limits.max_seconds
        if late or iteration == limits.max_iter:
            break
        found = _step(condensed, x, value, gradient, held, (lower, upper))
        if found is None:
            break
        x, value = found
        if after is not None and not after(iteration + 1, value):
            return Approach(x, value, iteration + 1, False)
    return Approach(x, value, iteration, False)


def _step(
    condensed: Condensed,
    x: np.ndarray,
    value: float,
    gradient: np.ndarray,
    held: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, float] | None:
    """The next x and its objective; None where no step lowers it."""
    step = _downhill(condensed, x, gradient, held)
    if step is None:
        return None
    length = 1.0
    for _ in range(_TRIALS):
        there = np.clip(x + length * step, *bounds)
        lowered, promised = condensed.objective(there), float(gradient @ (x - there))
        if value - lowered >= _DECREASE * promised > 0:
            return there, lowered
        bend = lowered - value + promised  # of the parabola through both values, with the slope here
        length *= min(max(0.5 * promised / bend, _SHORTER[0]), _SHORTER[1]) if bend > 0 else _SHORTER[1]
    return None


def _downhill(
    condensed: Condensed, x: np.ndarray, gradient: np.ndarray, held: np.ndarray
) -> np.ndarray | None:
    """A Newton step; where the exact Hessian bends down, Gauss–Newton's, damped where that is singular."""
    exact = condensed.exact
    try:
        return newton_step(condensed, x, gradient, held)
    except NotPositiveDefinite:
        condensed.use_exact(False)
    try:
        for damping in (0.0, *_DAMPINGS) if exact else _DAMPINGS:
            try:
                return newton_step(condensed, x, gradient, held, damping)
            except NotPositiveDefinite:
                continue
    finally:
        condensed.use_exact(exact)
    return None


def newton_step(
    condensed: Condensed, x: np.ndarray, gradient: np.ndarray, held: np.ndarray, damping: float = 0.0
) -> np.ndarray:
    """−(H + δ μ I)⁻¹ g (K,) over the variables that are not `held` (K,); zero for those that are.

    δ is the `damping`, and μ the mean of the diagonal of H.

    Raises
    ------
    NotPositiveDefinite
        The matrix is not, over those variables.
    """
    n, size = condensed.shape
    sd = condensed.problem.parameters.sd
    blocks, arrow, corner = condensed.hessian_parts(x)
    free = ~held
    state, rest = free[: n * size].reshape(n, size), free[n * size :]
    if damping:
        shift = damping * float(np.einsum("nii->", blocks[0])) / (n * size)
        blocks = [blocks[0] + shift * np.eye(size), *blocks[1:]]
        corner = corner + np.diag(shift / sd**2)
    if held.any():
        blocks = [_held_block(block, state, lag) for lag, block in enumerate(blocks)]
        arrow = arrow * state[:, :, None] * rest
        corner = corner * np.outer(rest, rest) + np.diag(np.where(rest, 0.0, 1.0))
    free_gradient = np.where(held, 0.0, gradient)
    factor = ArrowFactor(blocks, arrow, corner)
    dq, dtheta = factor.solve(free_gradient[: n * size].reshape(n, size), free_gradient[n * size :] / sd)
    return -np.concatenate([dq.ravel(), dtheta / sd])


def _held_block(block: np.ndarray, free: np.ndarray, lag: int) -> np.ndarray:
    """Rows and columns of what is held become those of the identity. `block` (N, Q, Q), `free` (N, Q)."""
    n = len(block)
    out = block.copy()
    out[lag:] *= free[lag:, :, None] & free[: n - lag, None, :]
    if lag == 0:
        frame, dof = np.nonzero(~free)
        out[frame, dof, dof] = 1.0
    return out
