"""The explicit lowering: its model, the same optimum as condensed, constraints of one's own."""

import os
import random
import signal
import threading
import time
from dataclasses import replace

import casadi
import numpy as np
import pyomo.environ as pyo
import pytest
from conftest import FPS, random_problem
from pyomo.core.expr import Expr_if

from acino_fte.condensed import Condensed
from acino_fte.condensed_solve import minimise
from acino_fte.errors import InputError
from acino_fte.explicit import build_explicit, read_states
from acino_fte.explicit_solve import ROUTES, PyomoToCasadi, available_route, minimise_explicit, solve_explicit
from acino_fte.initialise import initial_trajectory
from acino_fte.losses import DEFAULTS, Loss
from acino_fte.problem import build_fte
from acino_fte.result import Status
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.solve import SolveOptions, solve_fte

TIGHT = SolveOptions(tolerance=1e-4, acceptable_tolerance=1e-3)


@pytest.fixture(scope="module")
def small(lizard):
    """A problem, its start, and the model at the start."""
    problem, q = random_problem(lizard, n_frames=6, moving=True)
    start = problem.clip(q + np.random.default_rng(0).normal(0, 0.002, q.shape))
    return problem, start, build_explicit(problem, start)


# --- the model ---------------------------------------------------------------------------------------


def test_sets_have_frames_dofs_markers_by_name(small, lizard):
    model = small[2]
    assert list(model.FRAMES) == [20, 21, 22, 23, 24, 25]
    assert list(model.DOFS) == lizard.skeleton.dof_names
    assert list(model.MARKERS) == lizard.skeleton.marker_names
    assert list(model.AXES) == ["x", "y", "z"]


def test_variables_are_indexed_as_the_docstring_says(small):
    problem, start, model = small
    for variable in (model.x, model.dx, model.ddx):
        assert len(variable) == 6 * 9
    assert model.x[22, "tail.yaw"].value == pytest.approx(start[2, 5])
    assert model.position[20, "tail_tip", "z"].value == pytest.approx(
        problem.kinematics.positions(start)[0, 3, 2]
    )
    assert len(model.position) == 6 * 6 * 3
    assert (21, "trunk.x", "w") in model.slack_model
    assert len(model.slack_model) == 5 * 9


def test_only_what_was_observed_has_a_slack(small, lizard):
    problem, _, model = small
    names = lizard.skeleton.marker_names
    expected = {
        (int(problem.frames[f]), names[m], term.label, axis)
        for term in problem.terms
        if term.family == "meas"
        for f, m in zip(term.frames, term.items[:, 0], strict=True)
        for axis in "uv"
    }
    assert set(model.slack_meas) == set(model.residual_meas) == expected
    assert len(expected) == 2 * problem.n_observations < 6 * 6 * 4 * 2


def test_bounds_are_those_of_the_species(small, lizard):
    model = small[2]
    for dof, name in zip(lizard.skeleton.dofs, lizard.skeleton.dof_names, strict=True):
        low, high = model.x[23, name].bounds
        assert (low, high) == ((dof.lower, dof.upper) if np.isfinite(dof.lower) else (None, None))
        assert model.dx[23, name].bounds == (None, None)


def test_the_start_satisfies_every_constraint(small):
    model = small[2]
    for constraint in model.component_data_objects(pyo.Constraint):
        assert pyo.value(constraint.body) == pytest.approx(pyo.value(constraint.upper), abs=1e-6)


def test_backward_euler(small, lizard):
    model = small[2]
    assert len(model.velocity) == len(model.acceleration) == 5 * 9
    x, dx, ddx = (
        np.array([[v[f, d].value for d in model.DOFS] for f in model.FRAMES])
        for v in (model.x, model.dx, model.ddx)
    )
    assert np.allclose(np.diff(x, axis=0) * FPS, dx[1:])
    assert np.allclose(np.diff(dx, axis=0) * FPS, ddx[1:])


@pytest.mark.parametrize("loss", sorted(DEFAULTS))
def test_objective_equals_the_condensed_one_everywhere(lizard, loss):
    problem, q = random_problem(lizard, n_frames=5, loss=Loss(loss), seed=3)
    for size in (0.0, 0.01, 0.3):
        at = problem.clip(q + np.random.default_rng(1).normal(0, size, q.shape))
        model = build_explicit(problem, at)
        assert pyo.value(model.objective) == pytest.approx(
            Condensed(problem).objective(at.ravel()), rel=1e-9, abs=1e-9
        )
        assert np.allclose(read_states(model), at)


@pytest.mark.parametrize("n_frames", [1, 2, 3])
def test_very_short_models(lizard, n_frames):
    problem, q = random_problem(lizard, n_frames=n_frames)
    minimum = minimise_explicit(problem, q, TIGHT)
    assert minimum.status is Status.CONVERGED
    assert minimum.objective == pytest.approx(minimise(problem, q, TIGHT).objective, rel=1e-6, abs=1e-6)


def test_shared_subexpressions_are_named_once(small):
    """A cosine that ten markers need stands in the model once a frame."""
    problem, _, model = small
    n_steps = len(problem.kinematics.position_program.steps)
    kinematic = [k for k in model.shared if k[0] == 20]
    assert 0 < len(kinematic) <= n_steps


def test_model_can_be_written_for_any_solver(small, tmp_path):
    file = tmp_path / "model.nl"
    small[2].write(str(file))
    assert file.stat().st_size > 1000


# --- the same optimum --------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", sorted(DEFAULTS))
def test_same_optimum_as_condensed_on_a_small_animal(lizard, loss):
    problem, q = random_problem(lizard, n_frames=6, loss=Loss(loss), seed=2, outliers=0.05)
    start = q + np.random.default_rng(4).normal(0, 0.002, q.shape)
    condensed, explicit = minimise(problem, start, TIGHT), minimise_explicit(problem, start, TIGHT)
    assert condensed.status is explicit.status is Status.CONVERGED
    assert explicit.objective == pytest.approx(condensed.objective, rel=1e-6)
    distance = lizard.positions(explicit.q) - lizard.positions(condensed.q)
    assert np.linalg.norm(distance, axis=-1).max() < 5e-4


@pytest.fixture(scope="module")
def gallop(cheetah):
    """Twelve simulated frames of a cheetah before four cameras, and a start."""
    options = SimulationOptions(n_frames=12, n_cameras=4, outliers=0.03, missing=0.15, seed=3)
    sequence = simulation_to_sequence(simulate(cheetah.skeleton, options))
    return build_fte(sequence, cheetah), initial_trajectory(sequence, cheetah)


def test_same_optimum_as_condensed_on_a_cheetah(gallop):
    problem, start = gallop
    condensed = solve_fte(problem, start, TIGHT)
    explicit = solve_fte(problem, start, TIGHT, lowering="explicit")
    assert condensed.status is explicit.status is Status.CONVERGED
    assert explicit.method == "fte-explicit"
    assert explicit.objective == pytest.approx(condensed.objective, rel=1e-6)
    assert np.linalg.norm(explicit.positions - condensed.positions, axis=-1).max() < 5e-4


# --- constraints of one's own ------------------------------------------------------------------------


def test_a_paw_never_below_the_ground(lizard):
    """The two lines of the module docstring."""
    problem, q = random_problem(lizard, n_frames=6, loss=Loss("squared"), outliers=0.0)
    free = build_explicit(problem, q)
    without = solve_explicit(free, problem, TIGHT)
    height = np.array([pyo.value(free.position[f, "l_foot", "z"]) for f in free.FRAMES])
    floor = float(np.median(height))

    model = build_explicit(problem, q)
    model.ground = pyo.Constraint(model.FRAMES, rule=lambda m, f: m.position[f, "l_foot", "z"] >= floor)
    minimum = solve_explicit(model, problem, TIGHT)

    assert minimum.status is Status.CONVERGED
    after = lizard.positions(minimum.q)[:, lizard.skeleton.marker("l_foot"), 2]
    assert height.min() < floor - 0.002
    assert after.min() >= floor - 1e-5
    assert after.min() == pytest.approx(floor, abs=1e-3)  # the constraint is active
    assert minimum.objective > without.objective
    assert pyo.value(model.objective) == minimum.objective


def test_a_fixed_variable_stays(lizard):
    problem, q = random_problem(lizard, n_frames=4)
    model = build_explicit(problem, q)
    model.x[22, "tail.yaw"].fix(0.123)
    minimum = solve_explicit(model, problem, TIGHT)
    assert minimum.q[2, 5] == 0.123


def test_an_infeasible_constraint_is_not_called_converged(lizard):
    problem, q = random_problem(lizard, n_frames=2)
    model = build_explicit(problem, q)
    model.never = pyo.Constraint(expr=model.x[20, "trunk.pitch"] >= 3.0)  # its range ends at 60°
    minimum = solve_explicit(model, problem, replace(TIGHT, max_iter=200))
    assert not minimum.status.ok


def test_out_of_iterations_and_progress(lizard):
    problem, q = random_problem(lizard, n_frames=4)
    calls = []
    far = q + np.random.default_rng(0).normal(0, 0.2, q.shape)
    minimum = minimise_explicit(problem, far, SolveOptions(max_iter=1), lambda *a: calls.append(a))
    assert minimum.status is Status.MAX_ITERATIONS
    assert minimum.iterations == 1
    assert calls


def test_interrupt_is_an_interrupt(lizard, monkeypatch):
    """Ctrl-C in the middle of CasADi's solve, which by itself reports it as a failure."""
    problem, q = random_problem(lizard, n_frames=30, seed=5)
    model = build_explicit(problem, problem.clip(q + np.random.default_rng(0).normal(0, 0.5, q.shape)))
    original = casadi.nlpsol

    def nlpsol(*arguments):
        solver = original(*arguments)
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
        return solver

    monkeypatch.setattr(casadi, "nlpsol", nlpsol)
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # should it come too late
    try:
        endless = SolveOptions(max_iter=1_000_000, tolerance=1e-15, acceptable_tolerance=1e-15)
        minimum = solve_explicit(model, problem, endless, route="casadi")
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, handler)
    assert minimum.status is Status.INTERRUPTED
    assert np.isfinite(minimum.q).all()


def test_an_unknown_route(lizard):
    problem, q = random_problem(lizard, n_frames=1)
    with pytest.raises(InputError, match="There is no solve route 'guess'") as error:
        minimise_explicit(problem, q, route="guess")
    assert "casadi" in str(error.value)
    assert available_route() in ROUTES


# --- the walk to CasADi ------------------------------------------------------------------------------


def through_casadi(expression, variables):
    """Value of a Pyomo expression after the walk, at the variables' values."""
    walk = PyomoToCasadi()
    translated = walk(expression)
    used = [v for v in variables if id(v) in walk.symbols]
    function = casadi.Function("f", [walk.symbols[id(v)] for v in used], [translated])
    return float(function.call([v.value for v in used])[0])


@pytest.fixture
def scratch():
    model = pyo.ConcreteModel()
    model.v = pyo.Var(range(4), initialize=lambda _, i: (0.7, -1.3, 2.1, 0.4)[i])
    model.p = pyo.Param(mutable=True, initialize=1.7)
    model.k = pyo.Param(initialize=-0.6)
    model.fixed = pyo.Var(initialize=0.9)
    model.fixed.fix()
    model.e = pyo.Expression(pyo.Any)
    return model


def random_expression(model, rng, depth):
    """An expression of every kind of node that the walk knows, defined everywhere."""
    leaves = [*model.v.values(), model.p, model.k, model.fixed, 2.5, -1, 0.0]
    if depth == 0:
        return rng.choice(leaves)
    part = lambda: random_expression(model, rng, depth - 1)  # noqa: E731
    unary = [
        pyo.sin,
        pyo.cos,
        pyo.atan,
        pyo.tanh,
        lambda a: pyo.exp(pyo.sin(a)),
        lambda a: pyo.sqrt(1 + a * a),
    ]
    kind = rng.randrange(10)
    if kind == 0:
        return part() + part() - part()
    if kind == 1:
        return part() * part()
    if kind == 2:
        return part() / (2 + part() ** 2)
    if kind == 3:
        return -part()
    if kind == 4:
        return abs(part() + 0 * model.v[0])
    if kind == 5:
        first, second = part() + 0 * model.v[1], part()
        return Expr_if(first <= second, part(), part())
    if kind == 6:
        inner = part()
        key = len(model.e)  # only now: the inner parts have named theirs
        model.e[key] = inner
        return model.e[key] * model.e[key] + part()
    if kind == 7:
        return pyo.quicksum(part() * rng.uniform(-1, 1) for _ in range(5))
    if kind == 8:
        return Expr_if(part() + 0 * model.v[2] < 0.3, part(), pyo.log(1.5 + part() ** 2))
    return rng.choice(unary)(part())


@pytest.mark.parametrize("seed", range(40))
def test_walk_gives_the_same_value(scratch, seed):
    rng = random.Random(seed)
    expression = random_expression(scratch, rng, 4)
    expected = pyo.value(expression)
    assert through_casadi(expression, scratch.v.values()) == pytest.approx(expected, rel=1e-10, abs=1e-12)


def test_walk_knows_every_elementary_function(scratch):
    x = scratch.v[3]
    names = ["sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt"]
    for name in names:
        expression = getattr(pyo, name)(x)
        assert through_casadi(expression, [x]) == pytest.approx(pyo.value(expression), rel=1e-12), name
    for expression in (x**-2, x**0.5, x**scratch.p, 2**x, abs(-x), x / scratch.p, scratch.p * x, 3 - x):
        assert through_casadi(expression, [x]) == pytest.approx(pyo.value(expression), rel=1e-12)


def test_walk_of_parameters_numbers_and_fixed_variables(scratch):
    model = scratch
    nonvariable = (model.p + 1) ** 2 / model.p - abs(model.p) + pyo.sin(model.p)
    assert through_casadi(nonvariable, []) == pytest.approx(pyo.value(nonvariable))
    assert through_casadi(3.5, []) == 3.5
    assert through_casadi(model.p, []) == 1.7
    assert through_casadi(model.k, []) == -0.6
    assert through_casadi(model.fixed, []) == 0.9
    assert through_casadi(model.v[2], [model.v[2]]) == 2.1


def test_walk_takes_one_branch_only(scratch):
    """The branch not taken may be undefined there."""
    x = scratch.v[1]  # −1.3
    expression = Expr_if(x > 0, pyo.sqrt(pyo.sqrt(x * x)) * 7, -x)
    assert through_casadi(expression, [x]) == pytest.approx(1.3)


def test_walk_shares_named_expressions(scratch):
    """Squaring a named expression forty times over must not double the work forty times."""
    node = scratch.v[0] * 0.5
    for i in range(40):
        scratch.e[i] = node + 1e-3
        node = scratch.e[i] * scratch.e[i] - scratch.e[i] * 0.2
    began = time.perf_counter()
    walk = PyomoToCasadi()
    translated = walk(node)
    assert time.perf_counter() - began < 1.0
    assert casadi.Function("f", list(walk.symbols.values()), [translated]).n_nodes() < 400


def test_walk_of_a_long_chain_does_not_exhaust_the_stack(scratch):
    node = scratch.v[0]
    for _ in range(5000):
        node = pyo.sin(node) * 1.01
    assert np.isfinite(through_casadi(node, [scratch.v[0]]))


def test_walk_names_what_it_cannot_translate(scratch):
    with pytest.raises(InputError, match="cannot be sent to CasADi") as error:
        PyomoToCasadi()(pyo.ceil(scratch.v[0]))
    assert "'ipopt' executable" in str(error.value)
