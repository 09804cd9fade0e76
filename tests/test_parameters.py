"""What is declared of the global parameters, and the terms they bring into a problem."""

import numpy as np
import pytest
from conftest import FPS, cameras_about
from test_global_parameters import fitted

from acino_fte.condensed import Condensed
from acino_fte.errors import InputError
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
from acino_fte.problem import FTEOptions
from acino_fte.residuals import Handle
from acino_fte.terms import measurement_residual, size_terms

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
    assert q.shape == (problem.n_frames, 9) and len(theta) == condensed.n_parameters == 42
    np.testing.assert_allclose(condensed.pack(q, theta), x, rtol=1e-15)
    assert np.abs(theta / problem.parameters.sd).max() < 2
