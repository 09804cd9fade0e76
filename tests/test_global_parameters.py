"""Global parameters in the problem: what is declared, and derivatives of every combination of families."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from conftest import FPS, cameras_about, make_sequence, random_motion
from test_condensed import STEP, assert_close, dense, measured
from test_terms import N, own_terms

from acino_fte.condensed import Condensed
from acino_fte.errors import InputError
from acino_fte.losses import DEFAULTS, Loss
from acino_fte.parameters import (
    FAMILIES,
    POSE,
    PriorWidths,
    check_families,
    declare,
    describe,
    rotation_vector,
)
from acino_fte.prediction import corrected_cameras
from acino_fte.problem import FTEOptions, build_fte
from acino_fte.residuals import Handle, Residual
from acino_fte.terms import Term, measurement_residual, size_terms

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


# --- declarations ------------------------------------------------------------------------------------

CAMERAS = ["left", "right", "top"]


def test_what_is_declared(lizard):
    widths = PriorWidths(scale=0.2, delay=0.25, rotation=0.01, translation=0.3, offset=0.02)
    parameters = declare(reversed(FAMILIES), lizard.skeleton, CAMERAS, 200.0, widths)
    assert parameters.families == FAMILIES
    assert len(parameters) == 3 + 18 + 2 + 12 == len(parameters.names)
    assert parameters.n_kinematic == 21
    assert parameters.names[:3] == ["scale.trunk", "scale.tail", "scale.l_leg"]
    assert parameters.names[3:6] == [f"offsets.nose.{a}" for a in "xyz"]
    assert parameters.names[21:24] == ["delay.right", "delay.top", "extrinsics.right.rx"]
    by_name = dict(zip(parameters.names, parameters.entries, strict=True))
    expected = {
        "scale.tail": ("log", 0.2, 1.0),
        "offsets.nose.z": ("m", 0.02, 0.1),
        "delay.top": ("s", 0.25 / 200, 0.75 / 200),
        "extrinsics.right.rz": ("rad", 0.01, 0.05),
        "extrinsics.right.tx": ("m", 0.3, 1.5),
    }
    for name, (unit, sd, bound) in expected.items():
        found = by_name[name]
        assert (found.unit, found.sd, found.bound) == (unit, pytest.approx(sd), pytest.approx(bound))
    assert np.array_equal(parameters.of_family("delay"), [21, 22])
    assert parameters.of_family("extrinsics").tolist() == list(range(23, 35))
    assert parameters.of_family("gait").size == 0


def test_places_are_those_of_the_names(lizard):
    parameters = declare(FAMILIES, lizard.skeleton, CAMERAS, 100.0, PriorWidths())
    for i, p in enumerate(parameters.entries):
        assert parameters.place(p.family, p.owner, p.component) == i
    assert parameters.place("delay", "left") is None  # the first camera is the reference
    assert parameters.place("extrinsics", "left", "rx") is None
    assert parameters.place("scale", "wing") is None


def test_only_what_was_asked_for_is_declared(lizard):
    assert len(declare((), lizard.skeleton, CAMERAS, 100.0, PriorWidths())) == 0
    for families in (("delay",), ("scale", "extrinsics")):
        assert declare(families, lizard.skeleton, CAMERAS, 100.0, PriorWidths()).families == families
    assert len(declare(("delay", "extrinsics"), lizard.skeleton, ["only"], 100.0, PriorWidths())) == 0


def test_families_are_checked():
    assert check_families(["delay", "scale", "delay"]) == ("scale", "delay")
    with pytest.raises(InputError, match="no family of parameters 'delays'") as error:
        check_families(["scale", "delays"])
    assert "delay" in str(error.value)
    assert error.value.key == "fit"
    with pytest.raises(InputError, match="'gait'"):
        FTEOptions(fit=("gait",))


def test_description_by_name(lizard):
    parameters = declare(FAMILIES, lizard.skeleton, CAMERAS, 100.0, PriorWidths())
    theta = np.linspace(-0.02, 0.03, len(parameters))
    sd = np.linspace(0.001, 0.002, len(parameters))
    found = describe(parameters, theta, sd)

    def at(*key):
        return parameters.place(*key)

    families = ("segment_scale", "marker_offset_m", "time_offset_s", "extrinsics")
    assert set(found) == {*families, *(f"{f}_sd" for f in families)}
    tail = np.exp(theta[at("scale", "tail")])
    assert found["segment_scale"]["tail"] == pytest.approx(tail)
    assert found["segment_scale_sd"]["tail"] == pytest.approx(tail * sd[at("scale", "tail")])
    crest = [at("offsets", "crest", a) for a in "xyz"]
    assert found["marker_offset_m"]["crest"] == theta[crest].tolist()
    assert found["marker_offset_m_sd"]["crest"] == sd[crest].tolist()
    assert found["time_offset_s"]["top"] == theta[at("delay", "top")]
    pose = theta[[at("extrinsics", "top", c) for c in POSE]]
    assert found["extrinsics"]["top"]["rotation_rad"] == pytest.approx(rotation_vector(pose[:3]))
    assert found["extrinsics"]["top"]["translation_m"] == pose[3:].tolist()
    assert (
        found["extrinsics_sd"]["top"]["rotation_rad"]
        == sd[[at("extrinsics", "top", c) for c in POSE[:3]]].tolist()
    )
    assert set(describe(parameters, theta, None)) == set(families)
    assert describe(declare((), lizard.skeleton, CAMERAS, 100.0, PriorWidths()), np.empty(0), None) == {}


def test_no_delays_in_a_recording_shorter_than_their_stencil(lizard):
    for n, expected in ((2, ("scale",)), (3, ("scale", "delay"))):
        problem, x = fitted(lizard, ("scale", "delay"), n=n)
        assert problem.parameters.families == expected
        assert np.isfinite(Condensed(problem).objective(x))


# --- terms -------------------------------------------------------------------------------------------


def test_measurement_residuals_have_the_handles_they_need():
    plain = measurement_residual("fisheye")
    assert plain.handles == (Handle("position"),)
    late = measurement_residual("fisheye", delayed=True)
    assert late.handles == (Handle("position", delay=1),)
    both = measurement_residual("pinhole", moved=True, delayed=True)
    assert both.handles == (Handle("position", delay=1), *(Handle("parameter", item=i) for i in range(2, 8)))
    assert len({r.name for r in (plain, late, both)}) == 3
    assert measurement_residual("fisheye", delayed=True) is late


def test_parameters_at_zero_leave_the_objective_as_it_is(lizard):
    problem, x = fitted(lizard, FAMILIES)
    plain, at = fitted(lizard, ())
    zero = np.concatenate([x[: at.size], np.zeros(len(x) - at.size)])
    assert Condensed(problem).objective(zero) == pytest.approx(
        Condensed(plain).objective(zero[: at.size]), rel=1e-12
    )


def test_priors_of_the_parameters_are_gaussian(lizard):
    problem, x = fitted(lizard, FAMILIES)
    z = x[-len(problem.parameters) :]
    values = Condensed(problem).term_values(x)
    assert values["parameter"] == pytest.approx(0.5 * (z**2).sum(), rel=1e-12)


@pytest.mark.parametrize("moving", [False, True], ids=["fixed", "moving"])
def test_size_of_a_set_of_cameras(lizard, moving):
    """The term is the relative growth of the set: one for shifts that scale it about the first camera, zero
    for what moves or turns it as a whole about that camera."""
    cameras = cameras_about(3, moving)
    parameters = declare(("extrinsics",), None, cameras.names, FPS, PriorWidths())
    (term,) = size_terms(parameters, cameras, 0.005)
    weights = np.array([term.data[name] for name in term.residual.data])
    assert term.sd.tolist() == [0.005]

    def first_pose(camera):
        return np.reshape(camera.rotation, (-1, 3, 3))[0], np.reshape(camera.centre, (-1, 3))[0]

    def theta_of(move, step):
        """θ that moves the centre c of every camera but the first to c + step · move(c)."""
        theta = np.zeros(len(parameters))
        for camera in cameras[1:]:
            rotation, centre = first_pose(camera)
            place = parameters.place("extrinsics", camera.name, "tx")
            theta[place : place + 3] = -rotation @ (step * move(centre))
        return theta

    origin, step = first_pose(cameras[0])[1], 1e-4
    centres = np.array([first_pose(c)[1] for c in cameras])
    theta = theta_of(lambda c: c - origin, step)
    moved = np.array([first_pose(c)[1] for c in corrected_cameras(cameras, parameters, theta)])
    np.testing.assert_allclose(moved, centres + step * (centres - origin), atol=1e-12)
    size = np.linalg.norm(moved - moved.mean(0)) / np.linalg.norm(centres - centres.mean(0)) - 1
    assert weights @ theta[term.items[0]] == pytest.approx(step, rel=1e-9)
    assert size == pytest.approx(step, rel=1e-9)
    axis = np.array([0.3, -0.5, 0.8])
    turned = theta_of(lambda c: np.cross(axis, c - origin), 1.0)
    assert weights @ turned[term.items[0]] == pytest.approx(0.0, abs=1e-12)
    rng = np.random.default_rng(1)
    for _ in range(3):  # and of any shifts: the slope of the size
        theta = step * rng.normal(size=len(parameters))
        theta[[parameters.place("extrinsics", c.name, a) for c in cameras[1:] for a in POSE[:3]]] = 0.0
        up, down = (
            np.array([first_pose(c)[1] for c in corrected_cameras(cameras, parameters, s * theta)])
            for s in (1, -1)
        )
        spread = [np.linalg.norm(a - a.mean(0)) for a in (up, down, centres)]
        assert weights @ theta[term.items[0]] == pytest.approx(
            (spread[0] - spread[1]) / (2 * spread[2]), rel=1e-6
        )


def test_size_is_held_only_when_scales_are_estimated_too(lizard):
    for families, held in ((("scale", "extrinsics"), True), (("extrinsics",), False), (("scale",), False)):
        problem, _ = fitted(lizard, families, n=2)
        assert ("size" in {t.family for t in problem.terms}) == held
    one = cameras_about(n=1)
    assert size_terms(declare(("extrinsics",), None, one.names, FPS, PriorWidths()), one, 0.1) == []


def test_kinematic_parameters_of_a_problem_come_first(lizard):
    problem, x = fitted(lizard, ("delay", "offsets"))
    _, theta = Condensed(problem).unpack(x)
    assert problem.kinematics.families == ("offsets",)
    assert np.array_equal(problem.proportions(theta), theta[:18])
    assert fitted(lizard, ("delay",))[0].proportions(theta) is None


def test_pack_and_unpack(lizard):
    problem, x = fitted(lizard, FAMILIES)
    condensed = Condensed(problem)
    q, theta = condensed.unpack(x)
    assert q.shape == (N, 9) and len(theta) == condensed.n_parameters == 42
    np.testing.assert_allclose(condensed.pack(q, theta), x, rtol=1e-15)
    assert np.abs(theta / problem.parameters.sd).max() < 2
