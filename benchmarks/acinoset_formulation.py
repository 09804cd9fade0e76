"""The trajectory problem in the formulation that AcinoSet published, for comparison of cost only.

What makes it heavy is kept: each marker's chain multiplied out by SymPy and lambdified by itself without
common sub-expressions, a pose variable and a slack for every marker, camera and frame whether observed or
not, and the redescending loss blended from its pieces by logistic steps. The kinematics, cameras, data and
noise are those of the condensed problem it is compared with.
"""

from __future__ import annotations

import numpy as np
import pyomo.environ as pyo
import sympy as sp

from acino_fte.kinematics import turn_matrix
from acino_fte.problem import FTEProblem
from acino_fte.projection import project
from acino_fte.skeleton import Skeleton

AXES = ("x", "y", "z")
_FUNCTIONS = {name: getattr(pyo, name) for name in ("sin", "cos", "tan", "sqrt", "atan")}
_A, _B, _C = 3.0, 10.0, 20.0


def multiplied_out(skeleton: Skeleton) -> tuple[list[sp.Symbol], list[sp.Matrix]]:
    """Marker positions as single expressions of q, every rotation written out along its chain."""
    q = list(sp.symbols(f"q0:{len(skeleton.dofs)}", real=True))
    frames: list[tuple[sp.Matrix, sp.Matrix]] = []
    for link in skeleton.links:
        rotation, origin = frames[link.parent] if link.parent >= 0 else (sp.eye(3), sp.zeros(3, 1))
        origin = origin + rotation * sp.Matrix(link.at)
        for j in link.dofs:
            dof = skeleton.dofs[j]
            axis = sp.Matrix([sp.Integer(int(a)) for a in dof.axis])
            if dof.kind == "slide":
                origin = origin + rotation * axis * q[j]
            else:
                rotation = rotation * turn_matrix(axis, q[j])
        frames.append((rotation, origin))
    return q, [frames[m.link][1] + frames[m.link][0] * sp.Matrix(m.at) for m in skeleton.markers]


def blended_loss(error):  # noqa: ANN001, ANN201
    """The pieces of the redescending loss, switched by logistic steps (not zero at zero: −0.214)."""
    e = abs(error)

    def step(at: float):  # noqa: ANN202
        return 1 / (1 + pyo.exp(-(e - at)))

    linear = _A * e - _A**2 / 2
    bend = _A * _B - _A**2 / 2 + _A * (_C - _B) / 2 * (1 - ((_C - e) / (_C - _B)) ** 2)
    top = _A * _B - _A**2 / 2 + _A * (_C - _B) / 2
    return (
        (1 - step(_A)) / 2 * e**2
        + (step(_A) - step(_B)) * linear
        + (step(_B) - step(_C)) * bend
        + step(_C) * top
    )


def build(problem: FTEProblem, start: np.ndarray) -> pyo.ConcreteModel:
    """The Pyomo model at q (N, Q)."""
    sequence = problem.sequence
    skeleton = problem.kinematics.skeleton
    pixels = sequence.pixels(skeleton.marker_names, problem.options.likelihood)
    q, positions = multiplied_out(skeleton)
    chains = [[sp.lambdify(q, p[a], modules=[_FUNCTIONS]) for a in range(3)] for p in positions]
    n, c, m, _ = pixels.shape
    model = pyo.ConcreteModel("AcinoSet formulation")
    model.FRAMES, model.DOFS = pyo.RangeSet(0, n - 1), pyo.Set(initialize=skeleton.dof_names, ordered=True)
    start = problem.clip(start)
    bounds = {
        d: (None if np.isinf(lo) else lo, None if np.isinf(up) else up)
        for d, lo, up in zip(skeleton.dof_names, problem.lower, problem.upper, strict=True)
    }
    column = {d: j for j, d in enumerate(skeleton.dof_names)}
    model.x = pyo.Var(
        model.FRAMES,
        model.DOFS,
        bounds=lambda _, f, d: bounds[d],
        initialize=lambda _, f, d: float(start[f, column[d]]),
    )
    model.dx = pyo.Var(model.FRAMES, model.DOFS, initialize=0.0)
    model.ddx = pyo.Var(model.FRAMES, model.DOFS, initialize=0.0)
    _add_dynamics(model, problem)
    points = problem.kinematics.positions(start)
    model.poses = pyo.Var(
        model.FRAMES, range(m), range(3), initialize=lambda _, f, k, a: float(points[f, k, a])
    )
    model.pose = pyo.Constraint(
        model.FRAMES,
        range(m),
        range(3),
        rule=lambda o, f, k, a: chains[k][a](*(o.x[f, d] for d in o.DOFS)) == o.poses[f, k, a],
    )
    _add_measurements(model, problem, pixels)
    return model


def _add_dynamics(model: pyo.ConcreteModel, problem: FTEProblem) -> None:
    dt = problem.dt
    skeleton = problem.kinematics.skeleton
    noise = {d.name: d.noise * np.sqrt(skeleton.noise_fps / problem.fps) for d in skeleton.dofs}
    model.slack_model = pyo.Var(model.FRAMES, model.DOFS, initialize=0.0)

    def rule(what: str):  # noqa: ANN202
        def equation(o, f, d):  # noqa: ANN001, ANN202
            if f == 0:
                return pyo.Constraint.Skip
            if what == "x":
                return o.x[f, d] == o.x[f - 1, d] + dt * o.dx[f, d]
            if what == "dx":
                return o.dx[f, d] == o.dx[f - 1, d] + dt * o.ddx[f, d]
            return o.ddx[f, d] == o.ddx[f - 1, d] + o.slack_model[f, d]

        return equation

    for what in ("x", "dx", "ddx"):
        model.add_component(
            f"backward_euler_{what}", pyo.Constraint(model.FRAMES, model.DOFS, rule=rule(what))
        )
    model.model_cost = pyo.Expression(
        expr=pyo.quicksum((model.slack_model[f, d] / noise[d]) ** 2 for f in model.FRAMES for d in model.DOFS)
    )


def _add_measurements(model: pyo.ConcreteModel, problem: FTEProblem, pixels: np.ndarray) -> None:
    n, c, m, _ = pixels.shape
    local = sp.symbols("X Y Z", real=True)
    cameras = []
    for camera in problem.sequence.cameras:
        values = dict(zip(_names(camera.model), camera.parameters.tolist(), strict=True))
        world = sp.Matrix(sp.symbols("px py pz", real=True))
        point = sp.Matrix(camera.rotation) * world + sp.Matrix(camera.translation)
        uv = [
            e.subs(values).subs(dict(zip(local, point, strict=True)), simultaneous=True)
            for e in project(camera.model, local)
        ]
        cameras.append([sp.lambdify(list(world), e, modules=[_FUNCTIONS]) for e in uv])
    keys = [(f, k, i, w) for f in range(n) for i in range(c) for k in range(m) for w in range(2)]
    seen = np.isfinite(pixels)
    model.slack_meas = pyo.Var(keys, initialize=0.0)
    model.measurement = pyo.Constraint(
        keys,
        rule=lambda o, f, k, i, w: (
            cameras[i][w](*(o.poses[f, k, a] for a in range(3)))
            - (float(pixels[f, i, k, w]) if seen[f, i, k, w] else 0.0)
            - o.slack_meas[f, k, i, w]
            == 0
        ),
    )
    sd = [marker.sd_px for marker in problem.kinematics.skeleton.markers]
    weight = {(f, k, i, w): (1 / sd[k] if seen[f, i, k, w] else 0.0) for f, k, i, w in keys}
    cost = pyo.quicksum(blended_loss(weight[key] * model.slack_meas[key]) for key in keys)
    model.objective = pyo.Objective(expr=model.model_cost + cost)


def _names(model: str) -> list[sp.Symbol]:
    from acino_fte.projection import parameter_symbols

    return list(parameter_symbols(model))
