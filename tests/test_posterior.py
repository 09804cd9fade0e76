"""The posterior against dense linear algebra on a small problem."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import FPS, cameras_about, make_sequence, random_motion, random_problem
from test_condensed import dense
from test_global_parameters import fitted

from acino_fte import posterior as module
from acino_fte.arrow import NotPositiveDefinite
from acino_fte.condensed import Condensed
from acino_fte.condensed_solve import minimise
from acino_fte.losses import Loss
from acino_fte.parameters import FAMILIES
from acino_fte.posterior import factorise, posterior
from acino_fte.prior_motion import prior_motion
from acino_fte.problem import Assumptions, FTEOptions, build_fte, build_problem
from acino_fte.result import Status
from acino_fte.solve import Minimum, SolveOptions
from acino_fte.terms import point_term

TIGHT = SolveOptions(tolerance=1e-5, acceptable_tolerance=1e-4)


@pytest.fixture(scope="module", params=[(), ("scale",), ("offsets", "delay"), FAMILIES], ids="+".join)
def solved(request, lizard):
    """A problem, its minimum, and the dense covariance of (q, θ) there."""
    problem, x = fitted(lizard, request.param, Loss("cauchy"), n=5)
    start, theta = Condensed(problem).unpack(x)
    minimum = minimise(problem, start, TIGHT, theta=theta)
    assert minimum.status.ok
    return problem, minimum, covariance(problem, minimum)


def covariance(problem, minimum):
    """Inverse of the dense Hessian, its data's part times the weight, and the bounds' information."""
    weight = posterior(problem, minimum).data_weight
    hessian = np.diag(minimum.multipliers**2)
    for data in (True, False):
        terms = tuple(t for t in problem.terms if (t.family == "meas") == data)
        condensed = Condensed(replace(problem, terms=terms), exact=True)
        hessian += (weight if data else 1.0) * dense(condensed, condensed.pack(minimum.q, minimum.theta))
    unit = np.concatenate([np.ones(minimum.q.size), problem.parameters.sd])
    return np.linalg.inv(hessian) * np.outer(unit, unit)


def close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_states_and_parameters_have_the_dense_covariance(solved):
    problem, minimum, dense_covariance = solved
    found = posterior(problem, minimum)
    assert found.exact
    n, d = minimum.q.shape
    band = dense_covariance[: n * d, : n * d].reshape(n, d, n, d)
    assert len(found.q_blocks) == 4
    for lag, blocks in enumerate(found.q_blocks):
        close(blocks[lag:], np.array([band[f, :, f - lag] for f in range(lag, n)]))
    assert found.cross.shape == (n, d, len(minimum.theta))
    if len(minimum.theta):
        close(found.cross.reshape(n * d, -1), dense_covariance[: n * d, n * d :])
    theta = dense_covariance[n * d :, n * d :]
    assert found.theta.shape == theta.shape
    sd = problem.parameters.sd
    np.testing.assert_allclose(found.theta / np.outer(sd, sd), theta / np.outer(sd, sd), atol=1e-9)
    np.testing.assert_allclose(found.q_sd.ravel(), np.sqrt(np.diag(dense_covariance)[: n * d]), rtol=1e-7)
    np.testing.assert_allclose(found.theta_sd, np.sqrt(np.diag(theta)), rtol=1e-7)


def test_markers_have_the_covariance_carried_by_their_jacobian(solved):
    """The Jacobian of all positions for (q, θ) by finite differences, and the dense product."""
    problem, minimum, dense_covariance = solved
    n, d = minimum.q.shape
    x = np.concatenate([minimum.q.ravel(), minimum.theta])

    def positions(at):
        q, theta = at[: n * d].reshape(n, d), at[n * d :]
        return problem.kinematics.positions(q, problem.proportions(theta)).ravel()

    jacobian = np.empty((n * 18, len(x)))
    for i in range(len(x)):
        step = 1e-6 * np.eye(len(x))[i]
        jacobian[:, i] = (positions(x + step) - positions(x - step)) / 2e-6
    whole = (jacobian @ dense_covariance @ jacobian.T).reshape(n, 6, 3, n, 6, 3)
    expected = np.einsum("nmanmb->nmab", whole)
    found = posterior(problem, minimum).positions
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    assert (np.linalg.eigvalsh(found) > 0).all()


def test_log_determinant_is_that_of_the_objective_for_parameters_in_their_units(solved):
    problem, minimum, _ = solved
    condensed = Condensed(problem, exact=True)
    hessian = dense(condensed, condensed.pack(minimum.q, minimum.theta)) + np.diag(minimum.multipliers**2)
    expected = np.linalg.slogdet(hessian)[1] - 2 * np.log(problem.parameters.sd).sum()
    assert posterior(problem, minimum).log_determinant == pytest.approx(expected, rel=1e-8)


# --- what the standard deviations are worth ----------------------------------------------------------


def drawn(lizard, seed, loss, sd_px=2.0, outliers=0.0):
    """A motion from the prior before three cameras, and its posterior with 2 px assumed."""
    rng = np.random.default_rng(seed)
    q = prior_motion(lizard.skeleton, 40, FPS, seed=seed)
    cameras = cameras_about(n=3)
    pixels = cameras.project(lizard.positions(q))
    pixels = pixels + rng.normal(0, sd_px, pixels.shape)
    wild = rng.random(pixels.shape[:3]) < outliers
    pixels[wild] += rng.normal(0, 100, (wild.sum(), 2))
    options = FTEOptions(loss=Loss(loss), prior_width=0.25)
    sequence = make_sequence(lizard, q, cameras, pixels=pixels)
    problem = build_fte(sequence, lizard, options, Assumptions(sd_px=np.full(6, 2.0)))
    minimum = minimise(problem, q)
    return q, problem, minimum, posterior(problem, minimum)


@pytest.mark.parametrize(
    ("loss", "outliers"), [("squared", 0.0), ("redescending", 0.0), ("redescending", 0.1)]
)
def test_errors_are_as_large_as_their_standard_deviations(lizard, loss, outliers):
    """Over twelve draws from the prior: 1 for the normalised squared error, 0.06 its own uncertainty."""
    states, markers = [], []
    for seed in range(12):
        q, problem, minimum, found = drawn(lizard, seed, loss, outliers=outliers)
        states.append((minimum.q - q) / found.q_sd)
        error = problem.kinematics.positions(minimum.q) - problem.kinematics.positions(q)
        markers.append(np.einsum("nma,nmab,nmb->nm", error, np.linalg.inv(found.positions), error) / 3)
    assert np.sqrt(np.mean(np.square(states))) == pytest.approx(1.0, abs=0.12)
    assert np.mean(markers) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(
    ("loss", "sd_px", "expected"),
    [("squared", 2.0, 1.0), ("squared", 4.0, 0.25), ("geman_mcclure", 2.0, 1.21), ("redescending", 2.0, 1.0)],
)
def test_weight_of_the_data(lizard, loss, sd_px, expected):
    """One for the assumed Gaussian noise and the squared loss, and its inverse variance beyond that."""
    found = [drawn(lizard, seed, loss, sd_px)[3].data_weight for seed in range(4)]
    assert np.mean(found) == pytest.approx(expected, rel=0.05)


def test_a_problem_without_detections_has_no_weight_of_the_data(lizard):
    q = random_motion(lizard.skeleton, 4, 0)
    term = point_term(lizard.positions(q), 0.02, Loss("squared"))
    problem = build_problem(lizard, FPS, np.arange(4), [term], FTEOptions())
    assert posterior(problem, Minimum(Status.CONVERGED, q, 0.0, 0)).data_weight == 1.0


# --- bounds, and what has no inverse -----------------------------------------------------------------


def test_a_joint_at_its_limit_has_the_square_of_its_multiplier(lizard):
    problem, q = random_problem(lizard, n_frames=5, loss=Loss("squared"), outliers=0.0)
    yaw = lizard.skeleton.dof("tail.yaw")
    free = minimise(problem, q, TIGHT)
    upper = problem.upper.copy()
    upper[yaw] = free.q[:, yaw].min() - 0.05  # it pushes against this in every frame
    problem = replace(problem, upper=upper)
    minimum = minimise(problem, q, TIGHT)
    assert minimum.status.ok
    multipliers = minimum.multipliers.reshape(q.shape)
    assert (multipliers[:, yaw] > 10).all()
    gradient = Condensed(problem).gradient(minimum.q.ravel()).reshape(q.shape)
    np.testing.assert_allclose(multipliers[:, yaw], -gradient[:, yaw], rtol=1e-3)
    found = posterior(problem, minimum)
    close(found.q_blocks[0], np.einsum("nanb->nab", covariance(problem, minimum).reshape(5, 9, 5, 9)))
    loose = posterior(problem, replace(minimum, multipliers=None))
    assert (found.q_sd[:, yaw] < 1.0 / multipliers[:, yaw] * (1 + 1e-9)).all()
    assert (found.q_sd[:, yaw] < loose.q_sd[:, yaw]).all()
    others = np.arange(9) != yaw
    assert (found.q_sd[:, others] <= loose.q_sd[:, others] * (1 + 1e-6)).all()
    # where the data say far less than the bound, the multiplier is what is known
    weak = np.zeros((5, 9, 9)) + 1e-6 * np.eye(9)
    factor = factorise(problem, [weak], np.empty((5, 9, 0)), np.empty((0, 0)), minimum.multipliers)
    variance = np.diagonal(factor.selected_inverse().blocks[0], axis1=1, axis2=2)
    np.testing.assert_allclose(variance[:, yaw], 1 / multipliers[:, yaw] ** 2, rtol=1e-6)


def test_a_parameter_at_its_bound_counts_with_its_multiplier(lizard):
    problem, x = fitted(lizard, ("scale",), Loss("squared"), n=4)
    tight = tuple(replace(p, bound=1e-3) for p in problem.parameters.entries)
    problem = replace(problem, parameters=replace(problem.parameters, entries=tight))
    minimum = minimise(problem, Condensed(problem).unpack(x)[0], TIGHT)
    held = minimum.multipliers[minimum.q.size :] / problem.parameters.sd
    assert held.max() > 10
    found = posterior(problem, minimum)
    assert (found.theta_sd <= 1 / held).all()


def test_multipliers_of_joints_in_the_middle_do_not_count(lizard):
    problem, q = random_problem(lizard, n_frames=5, loss=Loss("squared"), outliers=0.0)
    minimum = minimise(problem, q, TIGHT)
    without = posterior(problem, replace(minimum, multipliers=None))
    np.testing.assert_allclose(posterior(problem, minimum).q_sd, without.q_sd, rtol=1e-4)


def test_gauss_newton_where_the_exact_hessian_is_not_positive_definite(lizard):
    """Points that the animal cannot reach, seen from where it is turned away."""
    q = random_motion(lizard.skeleton, 4, 0)
    points = lizard.positions(q)
    points = points.mean(1, keepdims=True) - 3.0 * (points - points.mean(1, keepdims=True))
    term = point_term(points, 0.02, Loss("squared"))
    problem = build_problem(lizard, FPS, np.arange(4), [term], FTEOptions())
    minimum = Minimum(Status.CONVERGED, q, 0.0, 0)
    assert np.linalg.eigvalsh(dense(Condensed(problem, exact=True), q.ravel())).min() < 0
    found = posterior(problem, minimum)
    assert not found.exact
    expected = np.linalg.inv(dense(Condensed(problem), q.ravel())).reshape(4, 9, 4, 9)
    close(found.q_blocks[0], np.einsum("nanb->nab", expected))


def test_a_direction_without_information_has_no_posterior(lizard):
    """One marker of one frame, and no prior."""
    points = np.full((4, 6, 3), np.nan)
    points[0, 0] = 0.0
    options = FTEOptions(prior_width=0)
    problem = build_problem(lizard, FPS, np.arange(4), [point_term(points, 0.02, Loss("squared"))], options)
    with pytest.raises(NotPositiveDefinite):
        posterior(problem, Minimum(Status.CONVERGED, random_motion(lizard.skeleton, 4, 0), 0.0, 0))


def test_nothing_that_is_handed_in_is_changed(solved):
    problem, minimum, _ = solved
    condensed = Condensed(problem)
    parts = condensed.hessian_parts(condensed.pack(minimum.q, minimum.theta))
    copies = [b.copy() for b in parts[0]], parts[1].copy(), parts[2].copy()
    module.factorise(problem, *parts, minimum.multipliers)
    for a, b in zip((*parts[0], *parts[1:]), (*copies[0], *copies[1:]), strict=True):
        assert np.array_equal(a, b)
