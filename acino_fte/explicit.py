"""The explicit lowering: the same problem as a Pyomo model that reads like the thesis.

Variables, indexed by frame number, ``link.dof``, marker and camera name:

    x, dx, ddx[frame, dof]            state and its derivatives
    position[frame, marker, axis]     marker positions, m
    parameter[name]                   global parameters, by name: 'delay.cam2', 'scale.neck', …
    slack_model[frame, dof, 'w']      jump of acceleration
    slack_meas[frame, marker, camera, 'u' | 'v']      reprojection residual, px
    slack_depth[frame, marker, camera, 'd']           depth residual, m
    slack_<family>[…]                 residuals of any other term

Constraints: ``kinematics`` (position = p(x)), ``velocity`` and ``acceleration`` (backward Euler), and
``residual_<family>`` (slack = residual). The objective is Σ ρ(slack/σ). Only what was observed has a slack.
(Joska et al. 2021, eq. 4–9.)

Adding a constraint takes two lines; a paw never below the ground::

    model = build_explicit(problem, start)
    model.ground = pyo.Constraint(model.FRAMES, rule=lambda m, f: m.position[f, "l_front_paw", "z"] >= 0)
    minimum = solve_explicit(model, problem)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyomo.environ as pyo
from pyomo.core.expr import Expr_if

from acino_fte import delay
from acino_fte.codegen import FUNCTIONS
from acino_fte.errors import InputError
from acino_fte.problem import FTEProblem
from acino_fte.residuals import AXES, Handle, input_names, residual_program
from acino_fte.terms import Term

_PYOMO: dict[str, Callable] = {f: getattr(pyo, f) for f in FUNCTIONS if hasattr(pyo, f)}


def build_explicit(
    problem: FTEProblem, start: np.ndarray, theta: np.ndarray | None = None
) -> pyo.ConcreteModel:
    """State a problem as a Pyomo model, initialised at q (N, Q) and θ (P,). Nothing is solved."""
    model = pyo.ConcreteModel("full trajectory estimation")
    skeleton = problem.kinematics.skeleton
    model.FRAMES = pyo.Set(initialize=[int(f) for f in problem.frames], ordered=True)
    model.DOFS = pyo.Set(initialize=skeleton.dof_names, ordered=True)
    model.MARKERS = pyo.Set(initialize=skeleton.marker_names, ordered=True)
    model.AXES = pyo.Set(initialize=AXES, ordered=True)
    point = _Point.at(problem, start, np.zeros(len(problem.parameters)) if theta is None else theta)
    _add_parameters(model, problem, point)
    _add_states(model, problem, point)
    _add_kinematics(model, problem, point)
    model.cost = pyo.Expression(pyo.Any)
    by_family: dict[str, list[Term]] = {}
    for term in problem.terms:
        by_family.setdefault(term.family, []).append(term)
    for family, terms in by_family.items():
        _add_terms(model, problem, family, terms, point)
    model.objective = pyo.Objective(expr=pyo.quicksum(model.cost.values()), sense=pyo.minimize)
    return model


@dataclass(frozen=True)
class _Point:
    """Numbers that the model starts from: states (N, Q), positions (N, M, 3) and parameters (P,)."""

    x: np.ndarray
    dx: np.ndarray
    ddx: np.ndarray
    position: np.ndarray
    theta: np.ndarray

    @classmethod
    def at(cls, problem: FTEProblem, start: np.ndarray, theta: np.ndarray) -> _Point:
        """Derivatives by backward differences; those of the first frames continue what follows."""
        x = problem.clip(start)
        dx = np.diff(x, axis=0, prepend=x[:1]) / problem.dt
        ddx = np.diff(dx, axis=0, prepend=dx[:1]) / problem.dt
        if len(x) > 2:
            ddx[:2] = ddx[2]
            dx[0] = dx[1] - problem.dt * ddx[1]
        return cls(x, dx, ddx, problem.positions(x, theta), theta)

    def residuals(self, problem: FTEProblem, term: Term) -> np.ndarray:
        """Residuals of a term at this point, (components, K)."""
        inputs: list[np.ndarray | float] = []
        for handle in term.residual.handles:
            if handle.kind == "parameter":
                inputs.append(self.theta[term.items[:, handle.item]])
                continue
            if handle.delay is not None:
                frames = term.frames - handle.lag
                newest = delay.stencil(frames, problem.n_frames)
                late = self.theta[term.items[:, handle.delay]] / problem.dt
                weights = delay.weights(late - (newest - frames))[0]
                nodes = self.position[newest - np.arange(delay.NODES)[:, None], term.items[:, handle.item]]
                inputs += list(np.einsum("nk,nka->ak", weights, nodes))
                continue
            source = {"dof": self.x, "velocity": self.dx, "acceleration": self.ddx, "position": self.position}
            value = source[handle.kind][term.frames - handle.lag, term.items[:, handle.item]]
            inputs += list(value.T) if handle.kind == "position" else [value]
        inputs += [problem.dt, *(term.data[name] for name in term.residual.data)]
        out = np.empty((len(term.residual.components), len(term)))
        residual_program(term.residual).numpy_function(inputs, out)
        return out


def _add_parameters(model: pyo.ConcreteModel, problem: FTEProblem, point: _Point) -> None:
    """The global parameters θ, within their bounds."""
    names = problem.parameters.names
    reach = dict(zip(names, problem.parameters.bound.tolist(), strict=True))
    model.PARAMETERS = pyo.Set(initialize=names, ordered=True)
    model.parameter = pyo.Var(
        model.PARAMETERS,
        bounds=lambda m, name: (-reach[name], reach[name]),
        initialize=dict(zip(names, point.theta.tolist(), strict=True)),
    )


def _add_states(model: pyo.ConcreteModel, problem: FTEProblem, point: _Point) -> None:
    """x, dx, ddx and the backward differences between them."""
    frames, dofs, dt = list(model.FRAMES), list(model.DOFS), problem.dt
    finite = [
        (None if np.isinf(lo) else lo, None if np.isinf(up) else up)
        for lo, up in zip(problem.lower, problem.upper, strict=True)
    ]
    bounds = dict(zip(dofs, finite, strict=True))

    def table(values: np.ndarray) -> dict[tuple[int, str], float]:
        return {(f, d): float(values[n, j]) for n, f in enumerate(frames) for j, d in enumerate(dofs)}

    model.x = pyo.Var(model.FRAMES, model.DOFS, bounds=lambda m, f, d: bounds[d], initialize=table(point.x))
    model.dx = pyo.Var(model.FRAMES, model.DOFS, initialize=table(point.dx))
    model.ddx = pyo.Var(model.FRAMES, model.DOFS, initialize=table(point.ddx))

    def backward(lower: pyo.Var, higher: pyo.Var) -> Callable:
        def rule(m: pyo.ConcreteModel, f: int, d: str) -> Any:
            if f == m.FRAMES.first():
                return pyo.Constraint.Skip
            return lower[f, d] == lower[m.FRAMES.prev(f), d] + dt * higher[f, d]

        return rule

    model.velocity = pyo.Constraint(model.FRAMES, model.DOFS, rule=backward(model.x, model.dx))
    model.acceleration = pyo.Constraint(model.FRAMES, model.DOFS, rule=backward(model.dx, model.ddx))


def _add_kinematics(model: pyo.ConcreteModel, problem: FTEProblem, point: _Point) -> None:
    """position = p(x), with every shared sub-expression a named Expression."""
    program = problem.kinematics.position_program
    dofs, markers = list(model.DOFS), list(model.MARKERS)
    model.position = pyo.Var(model.FRAMES, model.MARKERS, model.AXES)
    model.shared = pyo.Expression(pyo.Any)
    model.kinematics = pyo.Constraint(model.FRAMES, model.MARKERS, model.AXES)
    proportions = dict(zip(program.inputs[len(dofs) :], model.parameter.values(), strict=False))
    for n, f in enumerate(model.FRAMES):
        values = {f"q_{j}": model.x[f, d] for j, d in enumerate(dofs)} | proportions
        results = program.run(values, _PYOMO, _Named(model.shared, f))
        for i, result in enumerate(results):
            key = (f, markers[i // 3], AXES[i % 3])
            model.kinematics[key] = model.position[key] == result
            model.position[key].set_value(float(point.position[n].flat[i]))


class _Named:
    """Turns each step of a program into a named Expression of the model."""

    def __init__(self, into: pyo.Expression, *key: Any) -> None:
        self.into, self.key = into, key

    def __call__(self, name: str, value: Any) -> Any:
        if isinstance(value, (int, float)):
            return value
        key = (*self.key, name)
        self.into[key] = value
        return self.into[key]


def _add_terms(
    model: pyo.ConcreteModel, problem: FTEProblem, family: str, terms: list[Term], point: _Point
) -> None:
    """Slacks, their defining constraints and their cost, for all terms of one family."""
    slack = pyo.Var(pyo.Any, dense=False)
    constraint = pyo.Constraint(pyo.Any)
    model.add_component(f"slack_{family}", slack)
    model.add_component(f"residual_{family}", constraint)
    for term in terms:
        if family != "model":  # whose jumps at the first frames settle dx and ddx there
            term = term.select(term.frames >= term.residual.reach)
        program = residual_program(term.residual)
        values_now = point.residuals(problem, term)
        for k, (key, values) in enumerate(_instances(model, problem, term)):
            named = _Named(model.shared, family, *key)
            residuals = program.run(values, _PYOMO, named)
            sd = float(term.sd[k])
            for c, (component, residual) in enumerate(zip(term.residual.components, residuals, strict=True)):
                index = (*key, component)
                if index in constraint:
                    raise InputError(
                        f"Two residuals of the family '{family}' have one index.",
                        found=", ".join(map(str, index)),
                        remedy="give their terms different labels or families",
                    )
                slack[index].set_value(float(values_now[c, k]))
                constraint[index] = slack[index] == residual
                e = slack[index] / sd
                if term.loss.name != "squared":
                    e = abs(e)
                model.cost[(family, *index)] = term.loss.expression(e, _if_else, _PYOMO)


def _if_else(condition: Any, then: Any, otherwise: Any) -> Any:
    return Expr_if(condition, then, otherwise)


def _instances(
    model: pyo.ConcreteModel, problem: FTEProblem, term: Term
) -> Iterator[tuple[tuple, dict[str, Any]]]:
    """Index and input values of every instance of a term."""
    frames = list(model.FRAMES)
    names = input_names(term.residual)
    kinds = {handle.item: handle.kind for handle in term.residual.handles}
    named = [i for i, kind in kinds.items() if kind != "parameter"] or [0]  # what tells instances apart
    sets = {"position": model.MARKERS, "parameter": model.PARAMETERS}
    for k in range(len(term)):
        n, items = int(term.frames[k]), term.items[k]
        inputs: list[Any] = []
        for handle in term.residual.handles:
            if handle.delay is not None:
                inputs += _delayed(model, problem, n - handle.lag, items, handle)
            else:
                inputs += _handle_values(model, handle, frames[n - handle.lag], int(items[handle.item]))
        data = [term.data[name] for name in term.residual.data]
        inputs += [problem.dt, *(float(v[k]) if isinstance(v, np.ndarray) else v for v in data)]
        labels = [sets.get(kinds[i], model.DOFS).at(int(items[i]) + 1) for i in named]
        number = [] if term.numbers is None else [int(term.numbers[k])]
        key = (frames[n], *labels, *([term.label] if term.label else []), *number)
        yield key, dict(zip(names, inputs, strict=True))


def _delayed(
    model: pyo.ConcreteModel, problem: FTEProblem, n: int, items: np.ndarray, handle: Handle
) -> list[Any]:
    """A marker's position at t + τ (:mod:`acino_fte.delay`): an expression a camera, marker and frame."""
    newest = int(delay.stencil(np.array(n), problem.n_frames))
    late = model.PARAMETERS.at(int(items[handle.delay]) + 1)
    marker, frame = model.MARKERS.at(int(items[handle.item]) + 1), model.FRAMES.at(n + 1)
    behind = newest - n
    if (late, behind) not in model.shared:
        u = model.parameter[late] / problem.dt - behind
        weights = delay.programs()["weights"].run({"u": u}, _PYOMO)
        for node, weight in enumerate(weights):
            model.shared[late, behind, node] = weight
        model.shared[late, behind] = u
    frames = [model.FRAMES.at(newest - node + 1) for node in range(delay.NODES)]
    values = []
    for a in AXES:
        nodes = (model.shared[late, behind, i] * model.position[f, marker, a] for i, f in enumerate(frames))
        model.shared[late, frame, marker, a] = pyo.quicksum(nodes)
        values.append(model.shared[late, frame, marker, a])
    return values


def _handle_values(model: pyo.ConcreteModel, handle: Handle, frame: int, item: int) -> list[Any]:
    """The model's variables behind a handle."""
    if handle.kind == "parameter":
        return [model.parameter[model.PARAMETERS.at(item + 1)]]
    if handle.kind == "position":
        marker = model.MARKERS.at(item + 1)
        return [model.position[frame, marker, a] for a in AXES]
    variable = {"dof": model.x, "velocity": model.dx, "acceleration": model.ddx}[handle.kind]
    return [variable[frame, model.DOFS.at(item + 1)]]


def read_states(model: pyo.ConcreteModel) -> np.ndarray:
    """x of a solved model as q (N, Q)."""
    return np.array([[pyo.value(model.x[f, d]) for d in model.DOFS] for f in model.FRAMES])


def read_parameters(model: pyo.ConcreteModel) -> np.ndarray:
    """θ (P,) of a solved model."""
    return np.array([pyo.value(model.parameter[name]) for name in model.PARAMETERS])
