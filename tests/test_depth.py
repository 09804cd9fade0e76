"""Depth terms: derivatives against differences, both lowerings, the joint prior of the surface."""

from dataclasses import replace

import numpy as np
import pyomo.environ as pyo
import pytest
from conftest import cameras_about, make_sequence, random_motion
from test_global_parameters import check_derivatives

from acino_fte.condensed import Condensed
from acino_fte.condensed_solve import minimise
from acino_fte.depth import (
    COMMON,
    LIMB,
    OWN,
    BodyReturns,
    DepthData,
    MarkerDepths,
    expected_surface,
    surface_sd,
    surface_term,
)
from acino_fte.explicit import build_explicit
from acino_fte.explicit_solve import minimise_explicit
from acino_fte.fusion import Fusion
from acino_fte.lidar import Lidar
from acino_fte.losses import Loss
from acino_fte.parameters import Parameters, with_surface
from acino_fte.prediction import corrected_cameras, positions_at
from acino_fte.problem import Assumptions, FTEOptions, build_fte
from acino_fte.skeleton import load_skeleton
from acino_fte.solve import SolveOptions

N = 5
TIGHT = SolveOptions(tolerance=1e-4, acceptable_tolerance=1e-3)


def depths(kinematics, q, camera, kind, seed=3, noise=0.02):
    """Depths of markers, or returns on links, 4 cm before the animal, with noise."""
    rng = np.random.default_rng(seed)
    z = camera.to_camera(kinematics.positions(q))[..., 2]
    if kind == "marker":
        frame, marker = np.nonzero(rng.random(z.shape) < 0.7)
        measured = z[frame, marker] - 0.04 + rng.normal(0, noise, len(frame))
        return MarkerDepths(frame, marker, measured, np.full(len(frame), 0.02), np.ones(len(frame), int))
    count = 30
    frame, start = rng.integers(0, len(q), count), rng.integers(0, 3, count)
    end, u, bulge = start + rng.integers(1, 3, count), rng.random(count), rng.uniform(0.5, 1, count)
    axis = (1 - u) * z[frame, start] + u * z[frame, end]
    measured = axis - 0.04 * bulge + rng.normal(0, noise, count)
    return BodyReturns(frame, start, end, u, bulge, measured, np.full(count, 0.02))


def problem_with_depth(lizard, kind, families=(), moving=False, camera="c0", surface=True):
    q = random_motion(lizard.skeleton, N, 4)
    sequence = make_sequence(lizard, q, cameras_about(N, moving))
    measured = depths(lizard, q, sequence.cameras[camera], kind)
    data = DepthData(camera, measured, surface, Loss("cauchy", {"c": 2.0}))
    options = FTEOptions(loss=Loss("cauchy", {"c": 2.0}), fit=families)
    problem = build_fte(sequence, lizard, options, Assumptions(depth=data))
    theta = np.random.default_rng(7).normal(0, 0.2, len(problem.parameters)) * problem.parameters.sd
    rng = np.random.default_rng(5)
    return problem, Condensed(problem).pack(problem.clip(q + rng.normal(0, 0.02, q.shape), 1e-3), theta)


CASES = [
    ("marker", (), False, "c0", True),
    ("marker", (), False, "c0", False),
    ("marker", ("scale", "extrinsics", "delay"), True, "c1", True),
    ("body", (), True, "c0", True),
    ("body", ("scale", "extrinsics"), False, "c1", True),
]


@pytest.mark.parametrize("case", CASES, ids=lambda c: "-".join(map(str, c)))
def test_derivatives_equal_differences(lizard, case):
    problem, x = problem_with_depth(lizard, *case)
    only = replace(problem, terms=tuple(t for t in problem.terms if t.family in ("depth", "surface")))
    assert {t.family for t in only.terms} == {"depth"} | ({"surface"} if case[-1] else set())
    for one in (problem, only):
        check_derivatives(one, x, directions=6)


@pytest.mark.parametrize("case", CASES, ids=lambda c: "-".join(map(str, c)))
def test_the_explicit_model_has_the_same_objective(lizard, case):
    problem, x = problem_with_depth(lizard, *case)
    condensed = Condensed(problem)
    q, theta = condensed.unpack(x)
    model = build_explicit(problem, q, theta)
    assert pyo.value(model.objective) == pytest.approx(condensed.objective(x), rel=1e-9)
    found = problem.terms[[t.family for t in problem.terms].index("depth")]
    assert len(model.slack_depth) == len(found)


@pytest.mark.parametrize("kind", ["marker", "body"])
def test_both_lowerings_have_the_same_optimum(lizard, kind):
    problem, x = problem_with_depth(lizard, kind)
    q, theta = Condensed(problem).unpack(x)
    condensed = minimise(problem, q, TIGHT, theta=theta)
    explicit = minimise_explicit(problem, q, TIGHT, theta=theta)
    assert condensed.status.ok and explicit.status.ok
    assert explicit.objective == pytest.approx(condensed.objective, rel=1e-6)
    np.testing.assert_allclose(explicit.q, condensed.q, atol=1e-4)


def test_a_depth_is_measured_along_the_cameras_axis(lizard):
    """One measurement that is wrong by 10 cm: its residual is −10 cm, whatever the camera's direction."""
    q = random_motion(lizard.skeleton, N, 4)
    sequence = make_sequence(lizard, q, cameras_about(N, True))
    for camera in sequence.cameras:
        z = camera.to_camera(lizard.positions(q))[2, 1, 2]
        one = MarkerDepths(np.array([2]), np.array([1]), np.array([z + 0.1]), np.ones(1), np.ones(1, int))
        data = DepthData(camera.name, one, surface=False, loss=Loss("squared"))
        problem = build_fte(sequence, lizard, FTEOptions(), Assumptions(depth=data))
        condensed = Condensed(problem)
        condensed.objective(condensed.pack(q, np.zeros(0)))
        (found,) = [f for t, f in condensed.evaluated() if t.term.family == "depth"]
        assert found.e[0, 0] == pytest.approx(-0.1, abs=1e-9)


def test_the_surface_shortens_the_depth(lizard):
    """The origin of the surface and its parameter both lie between marker and measurement."""
    problem, _ = problem_with_depth(lizard, "marker")
    q = random_motion(lizard.skeleton, N, 4)
    condensed = Condensed(problem)
    values = []
    for shift in (0.0, 0.01):
        condensed.objective(condensed.pack(q, np.full(6, shift)))
        (found,) = [f for t, f in condensed.evaluated() if t.term.family == "depth"]
        values.append(found.e[0] * 0.02)
    assert np.median(values[0]) == pytest.approx(0.04 - LIMB, abs=0.01)
    np.testing.assert_allclose(values[1], values[0] - 0.01, atol=1e-12)


def test_the_surfaces_prior_has_one_common_part():
    expected = np.array([0.03, 0.03, 0.11, 0.05])
    parameters = with_surface(Parameters(), list("abcd"), expected, surface_sd(expected))
    term = surface_term(parameters)
    whitening = np.stack([term.data[f"a{i}"] for i in range(4)], axis=1)
    covariance = np.diag((OWN * expected) ** 2) + COMMON**2
    np.testing.assert_allclose(np.linalg.inv(whitening.T @ whitening), covariance, rtol=1e-10)
    np.testing.assert_allclose(parameters.sd, np.sqrt(np.diag(covariance)))


def test_independent_surfaces_would_claim_to_know_their_mean():
    """24 limbs: their mean is known to 1.07 cm, and not to 4 mm."""
    own, mean = (OWN * LIMB) ** 2, np.full(24, 1 / 24)
    covariance = own * np.eye(24) + COMMON**2
    assert np.sqrt(mean @ covariance @ mean) == pytest.approx(0.01065, abs=1e-5)
    assert np.sqrt(mean @ np.diag(np.diag(covariance)) @ mean) == pytest.approx(0.0042, abs=1e-5)


def test_the_expected_surface_is_the_widest_capsules_radius():
    skeleton = load_skeleton("cheetah")
    expected = dict(zip(skeleton.marker_names, expected_surface(skeleton), strict=True))
    assert expected["spine"] == pytest.approx(0.11)  # of the two capsules that meet there
    assert expected["tail_base"] == pytest.approx(0.09)
    assert expected["l_front_paw"] == LIMB


def test_no_depths_make_no_terms(lizard):
    q = random_motion(lizard.skeleton, N, 4)
    sequence = make_sequence(lizard, q, cameras_about(N))
    none = MarkerDepths(*(np.zeros(0, int),) * 2, np.zeros(0), np.zeros(0), np.zeros(0, int))
    problem = build_fte(sequence, lizard, FTEOptions(), Assumptions(depth=DepthData("c0", none)))
    assert "depth" not in {t.family for t in problem.terms}
    result = minimise(problem, q)
    assert result.status.ok


def test_a_corrected_and_late_camera_takes_its_lidar_along(lizard):
    """What is reported is the residual of the problem, whatever of the camera has been estimated."""
    q = random_motion(lizard.skeleton, 12, 4)
    sequence = make_sequence(lizard, q, cameras_about(12))
    families = FTEOptions(fit=("extrinsics", "delay"))
    parameters = build_fte(sequence, lizard, families).parameters
    theta = np.zeros(len(parameters))
    theta[parameters.place("extrinsics", "c1", "tz")] = 0.2
    theta[parameters.place("delay", "c1")] = 0.4 / sequence.fps
    (camera,) = [c for c in corrected_cameras(sequence.cameras, parameters, theta) if c.name == "c1"]
    z = camera.to_camera(positions_at(lizard.positions(q), 0.4 / sequence.fps, 1 / sequence.fps))
    seen = z - 0.03 * np.array([0.0, 0, 1])
    xyz, time = seen[:, :3].reshape(-1, 3), np.repeat(np.arange(12), 3) / sequence.fps
    lidar = Lidar("c1", time, xyz, np.zeros(36), np.eye(3), np.zeros(3))
    fusion = Fusion(replace(sequence, lidar=lidar), lizard.skeleton, "marker", np.zeros((12, 4, 6, 2)))
    fusion.surface[:] = 0.03
    fusion.look(lizard.positions(q), (parameters, theta))
    found = fusion.residuals(lizard.positions(q), (parameters, theta))
    assert len(found.residual) >= 12
    assert np.abs(found.residual).max() < 0.01
