"""The explicit lowering with global parameters: the objective and the optimum of the condensed one."""

import casadi
import numpy as np
import pyomo.environ as pyo
import pytest
from conftest import FPS, cameras_about, make_sequence, random_motion
from test_global_parameters import fitted, mixed_term, tied_term

from acino_fte.condensed import Condensed
from acino_fte.condensed_solve import minimise
from acino_fte.explicit import build_explicit, read_parameters, read_states
from acino_fte.explicit_solve import PyomoToCasadi, minimise_explicit
from acino_fte.losses import Loss
from acino_fte.parameters import FAMILIES, cayley_matrix
from acino_fte.prediction import corrected, predict
from acino_fte.problem import FTEOptions, build_fte
from acino_fte.result import Status
from acino_fte.solve import SolveOptions

TIGHT = SolveOptions(tolerance=1e-4, acceptable_tolerance=1e-3)


def both(problem, x):
    """The explicit model at a point, and the condensed objective there."""
    condensed = Condensed(problem)
    q, theta = condensed.unpack(x)
    q = problem.clip(q)
    return build_explicit(problem, q, theta), condensed.objective(condensed.pack(q, theta)), q, theta


def violation(model):
    """Largest violation of a constraint; by CasADi, which evaluates a named expression once."""
    walk = PyomoToCasadi()
    constraints = list(model.component_data_objects(pyo.Constraint))
    bodies = casadi.vertcat(*[walk(c.body) for c in constraints])
    symbols = casadi.vertcat(*[walk.symbols[key] for key in walk.variables])
    found = casadi.Function("bodies", [symbols], [bodies])([v.value for v in walk.variables.values()])
    return np.abs(np.array(found).ravel() - [pyo.value(c.upper) for c in constraints]).max()


@pytest.mark.parametrize("moving", [False, True], ids=["fixed", "moving"])
@pytest.mark.parametrize(
    "families", [("scale",), ("offsets",), ("delay",), ("extrinsics",), FAMILIES], ids="+".join
)
def test_objective_equals_the_condensed_one_everywhere(lizard, families, moving):
    problem, x = fitted(lizard, families, moving=moving, n=4)
    rng = np.random.default_rng(1)
    for size in (0.0, 0.5):
        model, value, q, theta = both(problem, x + size * rng.normal(0, 0.3, x.shape))
        assert pyo.value(model.objective) == pytest.approx(value, rel=1e-9)
        np.testing.assert_allclose(read_states(model), q, atol=1e-15)
        np.testing.assert_allclose(read_parameters(model), theta, atol=1e-15)
        assert violation(model) < 1e-6  # a consistent start


def test_own_terms_of_parameters_have_the_same_objective(lizard):
    problem, x = fitted(lizard, FAMILIES)
    terms = tied_term(problem, 22, "cauchy"), mixed_term(problem, [1, 9, 30])
    model, value, _, _ = both(problem.with_terms(*terms), x)
    assert pyo.value(model.objective) == pytest.approx(value, rel=1e-9)


def test_parameters_by_name_within_their_bounds(lizard):
    problem, x = fitted(lizard, FAMILIES, n=3)
    model, _, _, theta = both(problem, x)
    parameters = problem.parameters
    assert list(model.PARAMETERS) == parameters.names
    for p, value in zip(parameters.entries, theta, strict=True):
        assert model.parameter[p.name].bounds == (-p.bound, p.bound)
        assert model.parameter[p.name].value == pytest.approx(value)
    assert len(model.slack_parameter) == len(parameters)
    assert len(model.slack_size) == 1


def test_parameters_start_at_zero(lizard):
    problem, x = fitted(lizard, ("delay",), n=3)
    q, _ = Condensed(problem).unpack(x)
    assert not read_parameters(build_explicit(problem, q)).any()


@pytest.fixture(scope="module")
def imperfect(lizard):
    """Seven frames of a longer lizard before cameras of which two are late and one has moved."""
    kinematics = lizard.with_parameters(["scale"])
    q = random_motion(lizard.skeleton, 7, 6)
    cameras = cameras_about()
    true = list(cameras)
    true[1] = corrected(true[1], np.array([0.004, -0.003, 0.002, 0.02, -0.01, 0.03]))
    offsets = {"c1": 0.3 / FPS, "c3": -0.4 / FPS}
    pixels = predict(tuple(true), kinematics.positions(q, np.array([0.05, -0.08, 0.06])), offsets, 1 / FPS)
    pixels += np.random.default_rng(0).normal(0, 1.0, pixels.shape)
    return make_sequence(lizard, q, cameras, pixels=pixels), q


@pytest.mark.parametrize("families", [("scale", "delay"), FAMILIES], ids="+".join)
def test_same_optimum_as_condensed(lizard, imperfect, families):
    sequence, q = imperfect
    problem = build_fte(sequence, lizard, FTEOptions(loss=Loss("cauchy"), fit=families))
    start = problem.clip(q + np.random.default_rng(4).normal(0, 0.002, q.shape))
    condensed, explicit = minimise(problem, start, TIGHT), minimise_explicit(problem, start, TIGHT)
    assert condensed.status is explicit.status is Status.CONVERGED
    assert explicit.objective == pytest.approx(condensed.objective, rel=1e-6)
    sd = problem.parameters.sd
    np.testing.assert_allclose(explicit.theta / sd, condensed.theta / sd, atol=2e-2)
    places = [problem.kinematics.positions(m.q, problem.proportions(m.theta)) for m in (condensed, explicit)]
    assert np.linalg.norm(places[0] - places[1], axis=-1).max() < 5e-4
    assert np.abs(condensed.theta).max() > 0
    assert (np.abs(explicit.theta) <= problem.parameters.bound).all()


def test_start_of_the_parameters_is_taken(lizard, imperfect):
    """At the optimum there is nothing left to do."""
    sequence, q = imperfect
    problem = build_fte(sequence, lizard, FTEOptions(fit=("scale", "delay")))
    first = minimise(problem, q, TIGHT)
    again = minimise(problem, first.q, TIGHT, theta=first.theta)
    zero = minimise(problem, first.q, SolveOptions(max_iter=0))
    assert again.objective == pytest.approx(first.objective, rel=1e-6)
    assert zero.objective > first.objective + 10
    model = build_explicit(problem, first.q, first.theta)
    assert pyo.value(model.objective) == pytest.approx(first.objective, rel=1e-6)


def test_the_corrections_of_the_two_routes_turn_alike():
    """Cayley's rotation as a matrix is what the residual does to a point, written out here."""
    rng = np.random.default_rng(0)
    rho, x = rng.normal(0, 0.5, (2, 3))
    once = np.cross(rho, x)
    expected = x + (once + 0.5 * np.cross(rho, once)) / (1 + 0.25 * rho @ rho)
    np.testing.assert_allclose(cayley_matrix(rho) @ x, expected, atol=1e-14)
