"""Solving the explicit model with whatever IPOPT the machine has.

In this order: an ``ipopt`` executable through Pyomo; PyNumero with cyipopt, when its ASL library is
installed; else a walk over the Pyomo expressions into CasADi, whose wheel brings IPOPT and MUMPS.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyomo.environ as pyo
from pyomo.core.expr import numeric_expr as ne
from pyomo.core.expr import relational_expr as re

from acino_fte.errors import InputError
from acino_fte.explicit import build_explicit, read_parameters, read_states
from acino_fte.problem import FTEProblem
from acino_fte.result import Status
from acino_fte.solve import IPOPT_STATUS, Minimum, Progress, SolveOptions, check_linear_solver

ROUTES = ("ipopt", "pynumero", "casadi")
_NAMES = {
    "Solve_Succeeded": 0,
    "Solved_To_Acceptable_Level": 1,
    "Infeasible_Problem_Detected": 2,
    "Search_Direction_Becomes_Too_Small": 3,
    "Diverging_Iterates": 4,
    "User_Requested_Stop": 5,
    "Maximum_Iterations_Exceeded": -1,
    "Restoration_Failed": -2,
    "Maximum_CpuTime_Exceeded": -4,
    "Maximum_WallTime_Exceeded": -5,
}


def minimise_explicit(
    problem: FTEProblem,
    start: np.ndarray,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
    route: str | None = None,
    theta: np.ndarray | None = None,
) -> Minimum:
    """Build the explicit model at q (N, Q) and θ (P,) and solve it; ``route`` overrides the solver."""
    model = build_explicit(problem, start, theta)
    return solve_explicit(model, problem, options, progress, route)


def solve_explicit(
    model: pyo.ConcreteModel,
    problem: FTEProblem,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
    route: str | None = None,
) -> Minimum:
    """Solve an explicit model, with whatever was added to it; its variables keep the solution."""
    options = options or SolveOptions()
    route = route or available_route()
    if route == "casadi":
        status, iterations = _solve_casadi(model, options, progress)
    elif route in ROUTES:
        status, iterations = _solve_pyomo(model, options, route)
    else:
        raise InputError(f"There is no solve route '{route}'.", expected=", ".join(ROUTES))
    check_linear_solver(status, iterations, options)
    q = np.clip(read_states(model), problem.lower, problem.upper)
    theta = np.clip(read_parameters(model), -problem.parameters.bound, problem.parameters.bound)
    return Minimum(status, q, float(pyo.value(model.objective)), iterations, theta)


def available_route() -> str:
    """The first route that works on this machine."""
    if pyo.SolverFactory("ipopt").available(exception_flag=False):
        return "ipopt"
    from pyomo.contrib.pynumero.asl import AmplInterface

    return "pynumero" if AmplInterface.available() else "casadi"


def _solve_pyomo(model: pyo.ConcreteModel, options: SolveOptions, route: str) -> tuple[Status, int]:
    solver = pyo.SolverFactory("ipopt" if route == "ipopt" else "cyipopt")
    for name, value in options.ipopt().items():
        solver.options[name] = value
    outcome = solver.solve(model, tee=options.print_level > 0, load_solutions=True)
    condition = outcome.solver.termination_condition
    status = {
        pyo.TerminationCondition.optimal: Status.CONVERGED,
        pyo.TerminationCondition.maxIterations: Status.MAX_ITERATIONS,
        pyo.TerminationCondition.maxTimeLimit: Status.MAX_TIME,
        pyo.TerminationCondition.infeasible: Status.DIVERGED,
    }.get(condition, Status.FAILED)
    return status, int(getattr(outcome.solver, "iterations", 0) or 0)


def _solve_casadi(
    model: pyo.ConcreteModel, options: SolveOptions, progress: Progress | None
) -> tuple[Status, int]:
    import casadi as ca

    walk = PyomoToCasadi()
    constraints = list(model.component_data_objects(pyo.Constraint, active=True))
    bodies = [walk(c.body) for c in constraints]
    objective = walk(next(model.component_data_objects(pyo.Objective, active=True)).expr)
    variables = list(walk.variables.values())
    x = ca.vertcat(*[walk.symbols[id(v)] for v in variables])
    settings: dict[str, Any] = {f"ipopt.{k}": v for k, v in options.ipopt().items()}
    settings |= {"print_time": False, "ipopt.hessian_approximation": "exact"}
    solver = ca.nlpsol("fte", "ipopt", {"x": x, "f": objective, "g": ca.vertcat(*bodies)}, settings)
    with _watch_interrupt() as interrupted:
        solution = solver(
            x0=[_or(v.value, 0.0) for v in variables],
            lbx=[_or(v.lb, -np.inf) for v in variables],
            ubx=[_or(v.ub, np.inf) for v in variables],
            lbg=[_or(pyo.value(c.lower), -np.inf) for c in constraints],
            ubg=[_or(pyo.value(c.upper), np.inf) for c in constraints],
        )
    for variable, value in zip(variables, np.array(solution["x"]).ravel(), strict=True):
        variable.set_value(float(value), skip_validation=True)
    stats = solver.stats()
    code = _NAMES.get(stats["return_status"], -199)
    iterations = int(stats.get("iter_count", 0)) if code in IPOPT_STATUS else 0  # unset when it never ran
    if progress is not None:
        progress(iterations, float(solution["f"]))
    status = Status.INTERRUPTED if interrupted else IPOPT_STATUS.get(code, Status.FAILED)
    return status, iterations


@contextmanager
def _watch_interrupt() -> Iterator[list[int]]:
    """Remember Ctrl-C: CasADi ends the solve on the KeyboardInterrupt, but tells it as an error of IPOPT."""
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield seen
        return

    def stop(number: int, _frame: object) -> None:
        seen.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield seen
    finally:
        signal.signal(signal.SIGINT, before)


def _or(value: float | None, other: float) -> float:
    return other if value is None else float(value)


class PyomoToCasadi:
    """Translates Pyomo expressions to CasADi's scalar graph.

    Named Expressions are translated once and shared; ``Expr_if`` becomes CasADi's conditional. The walk
    keeps its own stack, so that long sums do not exhaust Python's, and calls CasADi's elementary
    operations directly, which skips the overload resolution of its operators (nine tenths of the time).
    """

    def __init__(self) -> None:
        import casadi as ca

        self._ca = ca
        self.variables: dict[int, Any] = {}
        self.symbols: dict[int, Any] = {}
        self._named: dict[int, Any] = {}
        self._constants: dict[float, Any] = {}
        self._binary = {
            ne.ProductExpression: ca.OP_MUL,
            ne.DivisionExpression: ca.OP_DIV,
            ne.PowExpression: ca.OP_POW,
        }
        self._unary = {
            name: getattr(ca, f"OP_{name.upper()}")
            for name in (
                "sin",
                "cos",
                "tan",
                "asin",
                "acos",
                "atan",
                "sinh",
                "cosh",
                "tanh",
                "exp",
                "log",
                "sqrt",
            )
        }

    def __call__(self, expression: Any) -> Any:
        """CasADi expression of a Pyomo expression, variable or number."""
        stack: list[tuple[Any, list[Any]]] = []
        value, node = None, expression
        while True:
            if node is not None:
                value = self._leaf(node)
                if value is None:
                    stack.append((node, []))
                    node = node.args[0]
                    continue
                node = None
            if not stack:
                return value
            parent, done = stack[-1]
            done.append(value)
            if len(done) < parent.nargs():
                node = parent.args[len(done)]
                continue
            stack.pop()
            value = self._combine(parent, done)

    def _constant(self, value: float) -> Any:
        if value not in self._constants:
            self._constants[value] = self._ca.SX(value)
        return self._constants[value]

    def _leaf(self, node: Any) -> Any:
        """Symbol of a number, parameter, variable or known named expression; None when it has parts."""
        if isinstance(node, (int, float, np.number)):
            return self._constant(float(node))
        if id(node) in self._named:
            return self._named[id(node)]
        if node.is_expression_type():
            return None
        if node.is_variable_type() and not node.is_fixed():
            if id(node) not in self.symbols:
                self.symbols[id(node)] = self._ca.SX.sym(f"v{len(self.symbols)}")
                self.variables[id(node)] = node
            return self.symbols[id(node)]
        return self._constant(float(pyo.value(node)))

    def _combine(self, node: Any, parts: list[Any]) -> Any:
        """CasADi node for a Pyomo node whose parts are translated."""
        ca = self._ca
        if node.is_named_expression_type():
            self._named[id(node)] = parts[0]
            return parts[0]
        for kind, operation in self._binary.items():
            if isinstance(node, kind):
                return ca.SX.binary(operation, parts[0], parts[1])
        if isinstance(node, ne.SumExpression):
            return self._sum(parts)
        if isinstance(node, ne.NegationExpression):
            return ca.SX.unary(ca.OP_NEG, parts[0])
        if isinstance(node, ne.AbsExpression):
            return ca.SX.unary(ca.OP_FABS, parts[0])
        if isinstance(node, ne.UnaryFunctionExpression) and node.getname() in self._unary:
            return ca.SX.unary(self._unary[node.getname()], parts[0])
        if isinstance(node, ne.Expr_ifExpression):
            otherwise = ca.SX.unary(ca.OP_NOT, parts[0])
            return ca.SX.binary(
                ca.OP_ADD,
                ca.SX.binary(ca.OP_IF_ELSE_ZERO, parts[0], parts[1]),
                ca.SX.binary(ca.OP_IF_ELSE_ZERO, otherwise, parts[2]),
            )
        if isinstance(node, re.InequalityExpression):
            return ca.SX.binary(ca.OP_LT if node.strict else ca.OP_LE, parts[0], parts[1])
        raise InputError(
            f"The expression '{type(node).__name__}' cannot be sent to CasADi.",
            remedy="write the constraint with arithmetic, elementary functions and Expr_if, or install an "
            "'ipopt' executable",
        )

    def _sum(self, parts: list[Any]) -> Any:
        """Sum as a balanced tree: its derivative graph stays shallow."""
        while len(parts) > 1:
            paired = [
                self._ca.SX.binary(self._ca.OP_ADD, a, b)
                for a, b in zip(parts[::2], parts[1::2], strict=False)
            ]
            parts = paired + ([parts[-1]] if len(parts) % 2 else [])
        return parts[0]
