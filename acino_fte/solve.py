"""Solving: one set of options for both lowerings, and an honest status."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from acino_fte.errors import InputError
from acino_fte.parameters import describe
from acino_fte.prediction import corrected_cameras, predict, time_offsets
from acino_fte.problem import FTEProblem
from acino_fte.result import FTEResult, Status

Progress = Callable[[int, float], None]

IPOPT_STATUS = {  # IPOPT's return codes (IpReturnCodes_inc.h)
    0: Status.CONVERGED,
    1: Status.ACCEPTABLE,
    2: Status.DIVERGED,
    3: Status.ACCEPTABLE,  # search direction too small: no further progress at this precision
    4: Status.DIVERGED,
    5: Status.INTERRUPTED,
    -1: Status.MAX_ITERATIONS,
    -2: Status.DIVERGED,
    -4: Status.MAX_TIME,
    -5: Status.MAX_TIME,
}


HESSIANS = ("auto", "gauss-newton", "exact")
# IPOPT knows ma97 too, but crashes when that library is missing
LINEAR_SOLVERS = ("mumps", "ma27", "ma57", "ma77", "ma86", "pardiso")


@dataclass(frozen=True)
class SolveOptions:
    """Options of the solver, the same for both lowerings.

    Attributes
    ----------
    max_iter : int
        Most iterations.
    tolerance : float
        Converged when no entry of the gradient of the Lagrangian exceeds this (1/rad, 1/m).
    acceptable_tolerance : float
        Acceptable when that holds for ten iterations without reaching ``tolerance``.
    max_seconds : float
        Most wall-clock time.
    print_level : int
        IPOPT's own log, 0 (silent) to 12.
    linear_solver : str
        ``mumps``, or another that the installed IPOPT has.
    hessian : str
        ``auto`` (Gauss–Newton far from the minimum, exact near it), ``gauss-newton`` or ``exact``.
    """

    max_iter: int = 500
    tolerance: float = 0.1
    acceptable_tolerance: float = 1.0
    max_seconds: float = 3600.0
    print_level: int = 0
    linear_solver: str = "mumps"
    hessian: str = "auto"

    def __post_init__(self) -> None:
        for name, good, expected in (
            ("max_iter", self.max_iter >= 0, "0 or more"),
            ("tolerance", 0 < self.tolerance < np.inf, "a number above 0 (--tol)"),
            ("acceptable_tolerance", self.acceptable_tolerance > 0, "a number above 0"),
            ("max_seconds", self.max_seconds > 0, "more than 0 seconds"),
            ("print_level", 0 <= self.print_level <= 12, "0 to 12"),
            ("linear_solver", self.linear_solver in LINEAR_SOLVERS, f"one of {', '.join(LINEAR_SOLVERS)}"),
            ("hessian", self.hessian in HESSIANS, f"one of {', '.join(HESSIANS)}"),
        ):
            if not good:
                raise InputError(
                    f"The solver option {name} cannot be {getattr(self, name)!r}.",
                    key=name,
                    expected=expected,
                    remedy="see --help",
                )

    def ipopt(self) -> dict[str, str | float | int]:
        """The options in IPOPT's words."""
        return {
            "max_iter": self.max_iter,
            "tol": float(self.tolerance),
            "dual_inf_tol": float(self.tolerance),
            "acceptable_tol": float(self.acceptable_tolerance),
            "acceptable_dual_inf_tol": float(self.acceptable_tolerance),
            "acceptable_iter": 10,
            "max_wall_time": float(self.max_seconds),
            "print_level": self.print_level,
            "sb": "yes",
            "linear_solver": self.linear_solver,
            "nlp_scaling_method": "none",
        }

    def summary(self) -> dict[str, Any]:
        """The options as plain values for the record."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where a solve ended: status, q (N, Q), objective, iterations, θ (P,), multipliers of the bounds.

    ``multipliers`` (N·Q + P,) is what the bounds hold back, for the solver's variables
    (:mod:`acino_fte.condensed`): positive where a joint or a parameter is at its limit.
    """

    status: Status
    q: np.ndarray
    objective: float
    iterations: int
    theta: np.ndarray = field(default_factory=lambda: np.empty(0))
    multipliers: np.ndarray | None = None


def check_linear_solver(status: Status, iterations: int, options: SolveOptions) -> None:
    """Raise InputError when IPOPT never began because it has no such linear solver."""
    if status is Status.FAILED and not iterations and options.linear_solver != "mumps":
        raise InputError(
            f"IPOPT could not load the linear solver '{options.linear_solver}'.",
            key="linear_solver",
            remedy="use 'mumps', which comes with IPOPT, or install that solver's library",
        )


def solve_fte(
    problem: FTEProblem,
    start: np.ndarray,
    options: SolveOptions | None = None,
    *,
    lowering: str = "condensed",
    progress: Progress | None = None,
    seconds: dict[str, float] | None = None,
) -> FTEResult:
    """Solve a trajectory problem and put the result together.

    Parameters
    ----------
    problem : FTEProblem
        From :func:`acino_fte.problem.build_fte`.
    start : (N, Q)
        From :func:`acino_fte.initialise.initial_trajectory`.
    options : SolveOptions, optional
        The defaults suit almost everything.
    lowering : str
        ``"condensed"`` or ``"explicit"``.
    progress : callable, optional
        Called with (iteration, objective).
    seconds : dict, optional
        Time spent so far by stage, for the record.

    Raises
    ------
    InputError
        An unknown lowering, or a problem that was not built from a sequence.
    """
    if problem.sequence is None:
        raise InputError("The problem holds no sequence.", remedy="make it with build_fte")
    options = options or SolveOptions()
    began = time.perf_counter()
    if lowering == "condensed":
        from acino_fte.condensed_solve import minimise

        minimum = minimise(problem, start, options, progress)
    elif lowering == "explicit":
        from acino_fte.explicit_solve import minimise_explicit

        minimum = minimise_explicit(problem, start, options, progress)
    else:
        raise InputError(
            f"There is no lowering '{lowering}'.", key="lowering", expected="'condensed' or 'explicit'"
        )
    velocity, acceleration = rates(minimum.q, problem.dt)
    return FTEResult(
        status=minimum.status,
        sequence=problem.sequence,
        skeleton=problem.kinematics.skeleton,
        q=minimum.q,
        dq=velocity,
        ddq=acceleration,
        positions=problem.positions(minimum.q, minimum.theta),
        observed=problem.sequence.pixels(
            problem.kinematics.skeleton.marker_names, problem.options.likelihood
        ),
        reprojected=predicted_pixels(problem, minimum),
        objective=minimum.objective,
        iterations=minimum.iterations,
        method=f"fte-{lowering}",
        seconds={**(seconds or {}), "solve": time.perf_counter() - began},
        options={"problem": problem.options.summary(), "solver": options.summary()},
        parameters=describe(problem.parameters, minimum.theta, None, problem.sequence.cameras.names[0]),
    )


def predicted_pixels(problem: FTEProblem, minimum: Minimum) -> np.ndarray:
    """Pixels (N, C, M, 2) that the cameras of a problem's sequence should see, NaN behind them."""
    assert problem.sequence is not None
    cameras = corrected_cameras(problem.sequence.cameras, problem.parameters, minimum.theta)
    late = time_offsets(cameras, problem.parameters, minimum.theta)
    return predict(cameras, problem.positions(minimum.q, minimum.theta), late, problem.dt)


def rates(q: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """First and second backward differences in time of q (N, Q)."""
    velocity = _rate(q, dt)
    return velocity, _rate(velocity, dt)


def _rate(values: np.ndarray, dt: float) -> np.ndarray:
    """Backward difference in time (N, Q); the first row repeats the second."""
    if len(values) < 2:
        return np.zeros_like(values)
    rate = np.diff(values, axis=0) / dt
    return np.concatenate([rate[:1], rate])
