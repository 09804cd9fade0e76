"""Residuals that only this file knows work in both lowerings; the built-in ones have their formulas."""

from dataclasses import replace

import numpy as np
import pyomo.environ as pyo
import pytest
from conftest import FPS, cameras_about, random_motion, random_problem
from test_condensed import assert_close, away, dense, numeric_gradient, numeric_hessian

from acino_fte.condensed import Condensed
from acino_fte.errors import InputError
from acino_fte.explicit import build_explicit
from acino_fte.losses import Loss
from acino_fte.problem import FTEOptions, build_problem
from acino_fte.residuals import Handle, Residual, lower
from acino_fte.terms import Term, measurement_term, point_term

N = 6


def _bone(handles, data, let):
    """Distance of two markers, minus a length."""
    import sympy as sp

    first, second = handles
    squared = let("squared", sum((a - b) ** 2 for a, b in zip(first, second, strict=True)))
    return [sp.sqrt(squared) - data["length"]], []


def _equal(handles, _data, _let):
    return [handles[0] - handles[1]], []


def _slip(handles, data, _let):
    """Velocity of a marker in contact with the ground, and its height."""
    now, before = handles
    return [(a - b) / data["dt"] for a, b in zip(now, before, strict=True)] + [now[2]], []


def _spin(handles, _data, let):
    """Something curved in a velocity and an acceleration."""
    import sympy as sp

    speed, bend, angle = handles
    return [let("energy", speed**2 / 20) + sp.sin(angle) * bend / 50], []


def _lean(handles, data, _let):
    """A marker and a degree of freedom together; defined only in front of a wall."""
    import sympy as sp

    (x, _, z), angle = handles
    return [z * sp.cos(angle) - data["level"]], [x + data["wall"]]


BONE = Residual("bone", (Handle("position"), Handle("position", item=1)), ("length",), ("d",), "m", _bone)
SYMMETRY = Residual("symmetry", (Handle("dof"), Handle("dof", item=1)), (), ("d",), "rad", _equal)
CONTACT = Residual(
    "contact", (Handle("position"), Handle("position", lag=1)), (), ("vx", "vy", "vz", "z"), "m/s", _slip
)
SPIN = Residual("spin", (Handle("velocity"), Handle("acceleration"), Handle("dof")), (), ("s",), "-", _spin)
LEAN = Residual("lean", (Handle("position"), Handle("dof", item=1)), ("level", "wall"), ("h",), "m", _lean)


def own_terms(lizard):
    """One term of every residual above, from the frame each can first be formed at."""
    skeleton = lizard.skeleton
    marker, dof = skeleton.marker, skeleton.dof

    def term(family, residual, items, data, sd, loss, start=0):
        frames = np.arange(start, N)
        columns = np.tile(items, (len(frames), 1))
        return Term(family, residual, frames, columns, data, np.full(len(frames), sd), Loss(loss))

    lengths = np.linspace(0.3, 0.5, N)
    level = {"level": 0.1, "wall": 5.0}
    return {
        "bone": term(
            "bone", BONE, [marker("nose"), marker("l_foot")], {"length": lengths}, 0.02, "redescending"
        ),
        "symmetry": term("symmetry", SYMMETRY, [dof("l_leg.flex"), dof("r_leg.flex")], {}, 0.1, "squared"),
        "contact": term("contact", CONTACT, [marker("r_foot")], {}, 0.05, "cauchy", start=1),
        "spin": term("spin", SPIN, [dof("tail.yaw")], {}, 2.0, "squared", start=2),
        "lean": term("lean", LEAN, [marker("crest"), dof("trunk.pitch")], level, 0.05, "huber"),
    }


NAMES = ("bone", "symmetry", "contact", "spin", "lean")


@pytest.fixture(scope="module")
def base(lizard):
    return random_problem(lizard, n_frames=N, moving=True)


@pytest.mark.parametrize("name", NAMES)
def test_own_term_condensed(lizard, base, name):
    problem = replace(base[0], terms=(own_terms(lizard)[name],))
    x = away(base[1])
    exact, plain = Condensed(problem, exact=True), Condensed(problem)
    assert exact.objective(x) > 0
    assert_close(plain.gradient(x), numeric_gradient(plain, x), 1e-6)
    assert_close(dense(exact, x), numeric_hessian(exact, x), 1e-5)
    eigenvalues = np.linalg.eigvalsh(dense(plain, x))
    assert eigenvalues.min() >= -1e-9 * eigenvalues.max()


def test_all_terms_together_condensed(lizard, base):
    problem = base[0].with_terms(*own_terms(lizard).values())
    condensed, x = Condensed(problem, exact=True), away(base[1], size=0.003)
    assert_close(condensed.gradient(x), numeric_gradient(condensed, x), 1e-6)
    assert_close(dense(condensed, x), numeric_hessian(condensed, x), 1e-5)
    rows, columns = condensed.structure
    assert len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == len(rows)


@pytest.mark.parametrize("name", [*NAMES, "all"])
def test_both_lowerings_have_the_same_objective(lizard, base, name):
    own = own_terms(lizard)
    problem = base[0].with_terms(*(own.values() if name == "all" else [own[name]]))
    q = problem.clip(away(base[1]).reshape(base[1].shape))
    model = build_explicit(problem, q)
    assert pyo.value(model.objective) == pytest.approx(Condensed(problem).objective(q.ravel()), rel=1e-9)
    for constraint in model.component_data_objects(pyo.Constraint):
        assert abs(pyo.value(constraint.body) - pyo.value(constraint.upper)) < 1e-6  # the start is consistent


def test_explicit_indices_name_what_each_column_means(lizard, base):
    model = build_explicit(base[0].with_terms(*own_terms(lizard).values()), base[1])
    first = int(base[0].frames[0])
    assert (first, "nose", "l_foot", "d") in model.slack_bone
    assert (first, "l_leg.flex", "r_leg.flex", "d") in model.slack_symmetry
    assert (first + 1, "r_foot", "vx") in model.slack_contact
    assert (first, "crest", "trunk.pitch", "h") in model.slack_lean
    assert len(model.slack_contact) == 4 * (N - 1)


@pytest.mark.parametrize("name", ["contact", "spin"])
def test_instances_that_reach_before_the_first_frame_are_left_out(lizard, base, name):
    """Of both lowerings: there is no frame −1 (and no wrapping round to the last one)."""
    term = own_terms(lizard)[name]
    early = replace(
        term,
        frames=np.arange(N),
        items=np.tile(term.items[:1], (N, 1)),
        sd=np.full(N, term.sd[0]),
    )
    x = away(base[1])
    right, more = base[0].with_terms(term), base[0].with_terms(early)
    assert Condensed(more).objective(x) == Condensed(right).objective(x)
    q = problem_clip(right, x)
    assert pyo.value(build_explicit(more, q).objective) == pytest.approx(
        pyo.value(build_explicit(right, q).objective), rel=1e-12
    )


def problem_clip(problem, x):
    return problem.clip(x.reshape(problem.n_frames, -1))


def test_two_residuals_with_one_name_in_the_explicit_model(lizard, base):
    term = own_terms(lizard)["bone"]
    with pytest.raises(InputError, match="Two residuals of the family 'bone' have one index") as error:
        build_explicit(base[0].with_terms(term, term), base[1])
    assert "label" in str(error.value)
    model = build_explicit(base[0].with_terms(term, replace(term, label="again")), base[1])
    assert len(model.slack_bone) == 2 * N


def test_a_guard_takes_the_instance_out_of_reach(lizard, base):
    term = own_terms(lizard)["lean"]
    blocked = replace(term, data={**term.data, "wall": -5.0}, loss=Loss("redescending"))
    condensed, x = Condensed(replace(base[0], terms=(blocked,))), base[1].ravel()
    assert condensed.objective(x) == pytest.approx(N * 40.5)
    assert not condensed.gradient(x).any()


def test_lowered_variables(lizard):
    assert lower(SPIN).inputs == (Handle("dof"), Handle("dof", 1), Handle("dof", 2))
    assert lower(CONTACT).inputs == (Handle("position"), Handle("position", 1))
    assert [lower(r).linear for r in (BONE, SYMMETRY, CONTACT, SPIN, LEAN)] == [
        False,
        True,
        True,
        False,
        False,
    ]
    assert [r.reach for r in (BONE, SYMMETRY, CONTACT, SPIN, LEAN)] == [0, 0, 1, 2, 0]


def test_select_keeps_frames_items_and_data_together(lizard):
    term = own_terms(lizard)["bone"]
    kept = term.select(term.frames > 3)
    assert kept.frames.tolist() == [4, 5]
    assert kept.data["length"].tolist() == term.data["length"][4:].tolist()
    assert len(kept) == len(kept.items) == len(kept.sd) == 2


def test_measurement_term_holds_the_observed_points_only(lizard):
    camera = cameras_about(3)[0]
    pixels = np.full((3, 6, 2), np.nan)
    sd = np.arange(1.0, 7.0)
    assert measurement_term(camera, pixels, sd, Loss(), 3) is None
    pixels[1, 4] = 100, 200
    pixels[2, 0, 0] = 5  # half a detection is none
    term = measurement_term(camera, pixels, sd, Loss(), 3)
    assert (term.frames.tolist(), term.items.tolist(), term.sd.tolist()) == ([1], [[4]], [5.0])
    assert (term.data["u"].tolist(), term.data["v"].tolist()) == ([100.0], [200.0])
    assert term.label == "c0"


def test_process_noise_follows_the_frame_rate(lizard):
    """Acceleration is a random walk: half the rate, √2 the jump per frame."""
    points = np.full((5, 6, 3), np.nan)
    points[0, 0] = 0
    sd = []
    for fps in (FPS, FPS / 2):
        terms = [point_term(points, 0.1, Loss())]
        problem = build_problem(lizard, fps, np.arange(5), terms, FTEOptions(noise_scale=3.0))
        sd.append(next(t.sd for t in problem.terms if t.family == "model"))
    noise = np.array([d.noise for d in lizard.skeleton.dofs])
    assert np.allclose(sd[0][: len(noise)], 3.0 * noise)
    assert np.allclose(sd[1], np.sqrt(2) * sd[0])


def test_prior_may_be_left_out(lizard):
    points = np.zeros((2, 6, 3))
    problem = build_problem(
        lizard, FPS, np.arange(2), [point_term(points, 0.1, Loss())], FTEOptions(prior_width=0)
    )
    assert [t.family for t in problem.terms] == ["point"]  # two frames have no jump of acceleration


def test_point_term_is_the_distance(lizard):
    q = random_motion(lizard.skeleton, 2, 0)
    points = lizard.positions(q) + [0.3, 0.0, -0.4]
    points[0, 1:] = np.nan
    problem = replace(
        build_problem(lizard, FPS, np.arange(2), [], FTEOptions()),
        terms=(point_term(points, 0.1, Loss("squared")),),
    )
    assert Condensed(problem).objective(q.ravel()) == pytest.approx(7 * 0.5 * (0.5 / 0.1) ** 2)


@pytest.mark.parametrize(
    ("name", "value"),
    [("likelihood", 1.5), ("likelihood", -0.1), ("noise_scale", 0.0), ("prior_width", -1.0)],
)
def test_wrong_options_of_the_problem(name, value):
    with pytest.raises(InputError, match=name):
        FTEOptions(**{name: value})
    with pytest.raises(InputError, match=name):
        FTEOptions(**{name: float("nan")})
