"""The condensed problem solved: Newton steps with the banded factorisation, then IPOPT.

The steps of :mod:`acino_fte.newton` come near the minimum in a third of the time that IPOPT needs; IPOPT,
started there with the multipliers of the bounds, finds that it is a minimum, or goes on to it.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from acino_fte.condensed import Condensed
from acino_fte.newton import Approach, Limits, approach
from acino_fte.problem import FTEProblem
from acino_fte.result import Status
from acino_fte.solve import IPOPT_STATUS, Minimum, Progress, SolveOptions, check_linear_solver

# Relative decrease per iteration below which the exact Hessian takes over. Residuals are large where the
# skeleton does not fit the animal, and Gauss–Newton steps then only crawl to the minimum.
_NEAR = 3e-5
_NEAR_NEWTON = 3e-3  # the same for the Newton steps, which notice a Hessian that is not positive definite
_SLOW = 2  # iterations in a row with little gain: the first ones may be short while the barrier settles
_PATIENCE = 8  # iterations: where the skeleton fits, Gauss–Newton is done by then

_STRATEGY: dict[str, str | float | int] = {
    "mu_strategy": "adaptive",
    "mu_min": 1e-5,  # a joint at its limit costs the objective no more than this
    "bound_push": 1e-2,
    "bound_frac": 1e-2,
    "mumps_mem_percent": 50,  # enough without delayed pivots; IPOPT enlarges it when it is not
    "mumps_pivot_order": 6,  # minimum degree that knows dense rows: parameters stand in every frame
    "mumps_permuting_scaling": 0,  # the Hessian is positive semidefinite and well scaled as it is
    "mumps_scaling": 0,
}
_WARM: dict[str, str | float | int] = {  # where the Newton steps have converged already
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-9,
    "warm_start_bound_frac": 1e-9,
    "warm_start_mult_bound_push": 1e-9,
}


class _Callbacks:
    """What the solvers call: the condensed problem, progress, and the best iterate so far."""

    def __init__(self, condensed: Condensed, progress: Progress | None, enough: float, refine: bool) -> None:
        self.condensed = condensed
        self.refine = refine
        self.progress = progress
        self.enough = enough
        self.stop = False
        self.iterations = 0
        self.before = 0
        self.best = (np.inf, np.empty(0))
        self._last = np.inf
        self._slow = 0

    def objective(self, x: np.ndarray) -> float:
        """Value, remembered when it is the best so far."""
        value = self.condensed.objective(x)
        if value < self.best[0]:
            self.best = (value, x.copy())
        return value

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """∂f/∂x."""
        return self.condensed.gradient(x)

    def hessianstructure(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the lower triangle."""
        return self.condensed.structure

    def hessian(self, x: np.ndarray, _multipliers: np.ndarray, factor: float) -> np.ndarray:
        """Entries of the lower triangle."""
        return factor * self.condensed.hessian(x)

    def intermediate(self, _mode: int, iteration: int, value: float, *_: float) -> bool:
        """After each iteration of IPOPT: report, and stop when asked to."""
        if iteration or not self.before:
            return self.after(self.before + iteration, value, _PATIENCE, _NEAR)
        return not self.stop

    def stepped(self, iteration: int, value: float) -> bool:
        """After each Newton step: the same."""
        self.before = iteration
        return self.after(iteration, value, 0, _NEAR_NEWTON)

    def after(self, iteration: int, value: float, patience: int, near: float) -> bool:
        """Report an iteration; whether to go on."""
        self.iterations = iteration
        if self.progress is not None:
            self.progress(iteration, value)
        gain = (self._last - value) / abs(value) if value else 0.0
        self._last = value
        self._slow = self._slow + 1 if 0 <= gain < self.enough else 0
        if self.refine and iteration - self.before >= patience and 0 <= gain < near:
            self.condensed.use_exact()
        return not (self.stop or self._slow >= _SLOW)


def minimise(
    problem: FTEProblem,
    start: np.ndarray,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
    enough: float = 0.0,
    theta: np.ndarray | None = None,
) -> Minimum:
    """Minimise a problem from q (N, Q) and θ (P,), zero when left out, by its condensed lowering.

    Ctrl-C ends it with the best iterate so far and the status ``interrupted``. ``enough`` stops it early,
    ``acceptable``, once two iterations in a row lower the objective by less than this fraction: for a start,
    not for a result.
    """
    options = options or SolveOptions()
    condensed = Condensed(problem, exact=options.hessian == "exact")
    callbacks = _Callbacks(condensed, progress, enough, refine=options.hessian == "auto" and not enough)
    x0 = condensed.pack(problem.clip(start), np.zeros(condensed.n_parameters) if theta is None else theta)
    lower, upper = bounds(problem)
    began = time.perf_counter()
    with _stop_on_interrupt(callbacks):
        limits = Limits(options.max_iter, options.tolerance, options.max_seconds)
        near = approach(condensed, x0, lower, upper, limits, callbacks.stepped)
        if enough or callbacks.stop:
            return _as_start(callbacks, near, (lower, upper))
        left = replace(
            options,
            max_iter=options.max_iter - near.iterations,
            max_seconds=max(options.max_seconds - (time.perf_counter() - began), 1e-3),
        )
        status, x, info = _with_ipopt(callbacks, near, left, (lower, upper))
    value = float(info["obj_val"])
    if not status.ok and callbacks.best[0] < np.inf:
        value, x = callbacks.best
    q, found = condensed.unpack(np.clip(x, lower, upper))
    multipliers = info["mult_x_L"] + info["mult_x_U"]
    return Minimum(status, q, value, callbacks.iterations, found, multipliers)


def _as_start(callbacks: _Callbacks, near: Approach, bound: tuple[np.ndarray, np.ndarray]) -> Minimum:
    """A start for something else, or all that there was time for."""
    status = Status.CONVERGED if near.converged else Status.ACCEPTABLE
    if callbacks.stop:
        status = Status.INTERRUPTED
    q, theta = callbacks.condensed.unpack(near.x)
    below, above = _held_back(callbacks.condensed, near.x, bound)
    return Minimum(status, q, near.value, near.iterations, theta, below + above)


def _held_back(
    condensed: Condensed, x: np.ndarray, bound: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers of the lower and upper bounds: the gradient that each holds back."""
    gradient = condensed.gradient(x)
    return (
        np.where(x <= bound[0], np.maximum(gradient, 0.0), 0.0),
        np.where(x >= bound[1], np.maximum(-gradient, 0.0), 0.0),
    )


def _with_ipopt(
    callbacks: _Callbacks, near: Approach, options: SolveOptions, bound: tuple[np.ndarray, np.ndarray]
) -> tuple[Status, np.ndarray, dict[str, Any]]:
    """Go on with IPOPT from where the Newton steps ended; status, x and what IPOPT says."""
    import cyipopt

    lower, upper = bound
    callbacks.best = (near.value, near.x)
    solver = cyipopt.Problem(n=near.x.size, m=0, problem_obj=callbacks, lb=lower, ub=upper)
    settings = {**options.ipopt(), **_STRATEGY}
    multipliers = {}
    if near.converged:
        settings |= _WARM
        multipliers = dict(zip(("zl", "zu"), _held_back(callbacks.condensed, near.x, bound), strict=True))
    for name, value in settings.items():
        solver.add_option(name, value)
    x, info = solver.solve(near.x, **multipliers)
    status = IPOPT_STATUS.get(info["status"], Status.FAILED)
    if status is Status.INTERRUPTED and not callbacks.stop:
        status = Status.ACCEPTABLE  # near enough to its minimum
    check_linear_solver(status, callbacks.iterations - near.iterations, options)
    return status, x, info


def bounds(problem: FTEProblem) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the solver's variables (:mod:`acino_fte.condensed`), ±1e20 for none."""
    beyond = problem.parameters.bound / problem.parameters.sd
    lower = np.where(np.isfinite(problem.lower), problem.lower, -1e20)
    upper = np.where(np.isfinite(problem.upper), problem.upper, 1e20)
    n = problem.n_frames
    return np.concatenate([np.tile(lower, n), -beyond]), np.concatenate([np.tile(upper, n), beyond])


@contextmanager
def _stop_on_interrupt(callbacks: _Callbacks) -> Iterator[None]:
    """Let the first Ctrl-C end the solve in good order instead of tearing through IPOPT."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: object) -> None:
        callbacks.stop = True

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
