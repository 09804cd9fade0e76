"""Global parameters in the problem: derivatives of every combination, and with residuals of one's own."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from conftest import cameras_about, make_sequence, random_motion
from test_condensed import STEP, assert_close, dense, measured
from test_terms import N, own_terms

from acino_fte.condensed import Condensed
from acino_fte.errors import InputError
from acino_fte.losses import DEFAULTS, Loss
from acino_fte.parameters import (
    FAMILIES,
)
from acino_fte.problem import FTEOptions, build_fte
from acino_fte.residuals import Handle, Residual
from acino_fte.terms import Term

COMBINATIONS = [c for size in (1, 2, 3, 4) for c in combinations(FAMILIES, size)]


def fitted(lizard, families, loss=None, moving=False, seed=0, n=N):
    """A problem with some families of parameters, and a point (q, θ) off its minimum."""
    rng = np.random.default_rng(seed)
    q = random_motion(lizard.skeleton, n, seed)
    cameras = cameras_about(n, moving)
    pixels = cameras.project(lizard.positions(q))
    pixels += rng.normal(0, 3.0, pixels.shape)
    wild = rng.random(pixels.shape[:3]) < 0.1
    pixels[wild] += rng.normal(0, 80, (wild.sum(), 2))
    pixels[rng.random(pixels.shape[:3]) < 0.2] = np.nan
    sequence = make_sequence(lizard, q, cameras, pixels=pixels)
    problem = build_fte(sequence, lizard, FTEOptions(loss=loss or Loss(), fit=families))
    theta = 0.3 * problem.parameters.sd * rng.normal(size=len(problem.parameters))
    return problem, Condensed(problem).pack(q + rng.normal(0, 0.02, q.shape), theta)


def assembled(condensed, x):
    """The Hessian as a full matrix from its parts."""
    blocks, border, corner = condensed.hessian_parts(x)
    (n, d), sd = condensed.shape, condensed.problem.parameters.sd
    whole = np.zeros((len(x), len(x)))
    for lag, block in enumerate(blocks):
        for f in range(lag, n):
            place = np.ix_(range(f * d, f * d + d), range((f - lag) * d, (f - lag) * d + d))
            whole[place] = block[f]
            whole[place[1].T, place[0].T] = block[f].T
    whole[: n * d, n * d :] = (border * sd).reshape(n * d, -1)
    whole[n * d :, : n * d] = whole[: n * d, n * d :].T
    whole[n * d :, n * d :] = corner * np.outer(sd, sd)
    return whole


def differences(condensed, x, directions):
    """Slopes and Hessian times vectors, by central differences from the same evaluations."""
    slopes, products = [], []
    for direction in STEP * directions:
        values = [(condensed.objective(at), condensed.gradient(at)) for at in (x + direction, x - direction)]
        slope, product = ((a - b) / (2 * STEP) for a, b in zip(*values, strict=True))
        slopes.append(slope)
        products.append(product)
    return np.array(slopes), np.array(products)


def check_derivatives(problem, x, directions=None):
    """Gradient, exact Hessian, and both Hessians' sparse entries against their parts.

    Along every variable, or along some random directions, each of which shows any wrong entry.
    """
    exact, plain = Condensed(problem, exact=True), Condensed(problem)
    along = (
        np.eye(len(x)) if directions is None else np.random.default_rng(0).normal(size=(directions, len(x)))
    )
    slopes, products = differences(plain, x, along)
    assert_close(along @ exact.gradient(x), slopes, 1e-6)
    assert_close(along @ dense(exact, x), products, 1e-5)
    for condensed in (exact, plain):
        whole = assembled(condensed, x)
        assert np.abs(dense(condensed, x) - whole).max() <= 1e-12 * np.abs(whole).max()
    eigenvalues = np.linalg.eigvalsh(dense(plain, x))
    assert eigenvalues.min() >= -1e-9 * eigenvalues.max()


def check_structure(condensed, x):
    rows, columns = condensed.structure
    assert (columns <= rows).all()
    assert len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == len(rows)
    assert rows.max() == len(x) - 1
    assert len(condensed.hessian(x)) == len(rows)


# --- derivatives -------------------------------------------------------------------------------------


@pytest.mark.parametrize("families", COMBINATIONS, ids="+".join)
def test_derivatives_of_every_combination(lizard, families):
    problem, x = fitted(lizard, families, seed=len(families), n=4)
    assert problem.parameters.families == tuple(f for f in FAMILIES if f in families)
    check_derivatives(measured(problem), x, None if len(families) in (1, 4) else 4)
    check_structure(Condensed(problem), x)


@pytest.mark.parametrize("loss", sorted(set(DEFAULTS) - {Loss().name}))
def test_derivatives_of_every_loss_with_moving_cameras(lizard, loss):
    problem, x = fitted(lizard, FAMILIES, Loss(loss), moving=True, n=4)
    check_derivatives(measured(problem), x, 4)


def test_derivatives_of_the_whole_problem(lizard):
    """Motion model and priors too, whose own constant part is kept between evaluations."""
    problem, x = fitted(lizard, FAMILIES)
    condensed = Condensed(problem)
    assert set(condensed.term_values(x)) == {"meas", "model", "prior", "parameter", "size"}
    own = replace(problem, terms=tuple(t for t in problem.terms if t.family != "meas"))
    check_derivatives(own, x)
    check_derivatives(problem, x, 4)
    check_structure(condensed, x)


# --- with residuals of one's own ---------------------------------------------------------------------


def _tied(handles, _data, _let):
    """A degree of freedom with a bias that is a parameter: linear in both."""
    return [handles[0] - 2.0 * handles[1]], []


def _mixed(handles, data, let):
    """A marker, a velocity and two parameters, curved in all of them."""
    (x, y, z), speed, first, second = handles
    product = let("product", x * first + y * second * z)
    return [product * speed + first * second - data["level"], z * first**2 + speed**2 / 50], []


def _twist(handles, data, _let):
    """One marker now and before, in different ways."""
    now, before = handles
    return [now[0] * before[1] - data["half"] * now[2] * before[0]], []


TWIST = Residual("twist", (Handle("position"), Handle("position", 1)), ("half",), ("a",), "m²", _twist)
TIED = Residual("tied", (Handle("dof"), Handle("parameter", item=1)), (), ("d",), "rad", _tied)
MIXED = Residual(
    "mixed",
    (
        Handle("position"),
        Handle("velocity", item=1),
        Handle("parameter", item=2),
        Handle("parameter", item=3),
    ),
    ("level",),
    ("a", "b"),
    "m",
    _mixed,
)


def tied_term(problem, parameter, loss="squared"):
    """Every frame of one joint, and a parameter."""
    items = np.tile([problem.kinematics.skeleton.dof("tail.yaw"), parameter], (N, 1))
    return Term("tied", TIED, np.arange(N), items, {}, np.full(N, 0.05), Loss(loss))


def mixed_term(problem, parameters):
    """Several markers and joints at once; the parameters of each instance differ."""
    frames, which = (a.ravel() for a in np.mgrid[1:N, 0:3])
    skeleton = problem.kinematics.skeleton
    markers = np.array([skeleton.marker(m) for m in ("nose", "tail_tip", "r_foot")])[which]
    dofs = np.array([skeleton.dof(d) for d in ("tail.yaw", "trunk.pitch", "l_leg.flex")])[which]
    first, second = np.array(parameters)[which], np.array(parameters)[(which + 1) % 3]
    items = np.stack([markers, dofs, first, second], axis=1)
    sd = np.full(len(frames), 0.1)
    return Term("mixed", MIXED, frames, items, {"level": 0.02}, sd, Loss("cauchy"))


@pytest.mark.parametrize("name", ["bone", "symmetry", "contact", "spin", "lean"])
@pytest.mark.parametrize("families", [("scale",), ("offsets",), FAMILIES], ids="+".join)
def test_own_terms_with_proportions(lizard, name, families):
    """Two markers of one residual, a marker now and before, and a marker with a degree of freedom."""
    problem, x = fitted(lizard, families, seed=2)
    alone = replace(problem, terms=(own_terms(lizard)[name],))
    assert Condensed(alone).objective(x) > 0
    check_derivatives(alone, x)
    check_structure(Condensed(alone), x)


@pytest.mark.parametrize("families", [("scale",), ("offsets",), FAMILIES], ids="+".join)
def test_a_marker_now_and_before_in_different_ways(lizard, families):
    problem, x = fitted(lizard, families, seed=4)
    frames, markers = (a.ravel() for a in np.mgrid[1:N, 0:6])
    sd = np.full(len(frames), 0.01)
    term = Term("twist", TWIST, frames, markers[:, None], {"half": 0.5}, sd, Loss("cauchy"))
    check_derivatives(replace(problem, terms=(term,)), x)


@pytest.mark.parametrize("loss", ["squared", "cauchy"])
def test_a_degree_of_freedom_tied_to_a_parameter(lizard, loss):
    """Linear with the squared loss: its part of the border is constant, and there."""
    problem, x = fitted(lizard, FAMILIES)
    alone = replace(problem, terms=(tied_term(problem, problem.parameters.place("delay", "c2"), loss),))
    check_derivatives(alone, x)


@pytest.mark.parametrize("which", ["proportions", "cameras"])
def test_a_marker_a_velocity_and_two_parameters(lizard, which):
    problem, x = fitted(lizard, FAMILIES)
    chosen = {"proportions": [0, 2, 10], "cameras": [-1, -8, -20]}[which]
    places = [range(len(problem.parameters))[i] for i in chosen]
    alone = replace(problem, terms=(mixed_term(problem, places),))
    check_derivatives(alone, x)
    check_structure(Condensed(alone), x)


def test_one_parameter_in_two_places_of_a_residual(lizard):
    problem, x = fitted(lizard, FAMILIES)
    place = problem.parameters.place("extrinsics", "c1", "tx")
    alone = replace(problem, terms=(mixed_term(problem, [place] * 3),))
    check_derivatives(alone, x)


def test_everything_at_once(lizard):
    problem, x = fitted(lizard, FAMILIES, seed=3)
    terms = [*own_terms(lizard).values(), tied_term(problem, 1), mixed_term(problem, [0, 10, 30])]
    problem = problem.with_terms(*terms)
    check_derivatives(problem, x)
    check_structure(Condensed(problem), x)


def test_a_delayed_position_stands_alone(lizard):
    """Beside parameters; the frames of its stencil are those of the other only away from the ends."""
    problem, x = fitted(lizard, ("delay",))
    late = Residual(
        "late",
        (Handle("position", delay=1), Handle("dof", item=2)),
        (),
        ("d",),
        "m",
        lambda h, *_: ([h[1]], []),
    )
    term = Term("late", late, np.zeros(1, int), np.array([[0, 0, 0]]), {}, np.ones(1))
    with pytest.raises(InputError, match="delayed position beside") as error:
        Condensed(problem.with_terms(term))
    assert "position (delayed), dof" in str(error.value)
