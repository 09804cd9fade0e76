"""Process noise by maximum evidence: against exact algebra where the problem is linear, and known truths."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import FPS, cameras_about, make_sequence, random_problem
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal
from test_condensed import away, dense

from acino_fte.condensed import Condensed
from acino_fte.condensed_solve import minimise
from acino_fte.losses import DEFAULTS, Loss
from acino_fte.posterior import posterior
from acino_fte.prior_motion import prior_motion, prior_precision, process_noise
from acino_fte.problem import Assumptions, FTEOptions, build_fte, build_problem
from acino_fte.residuals import Handle, Residual
from acino_fte.result import Status
from acino_fte.terms import Term
from acino_fte.tune import WIDTH, evidence, jump_moments, tune, with_data_weight

N, SPREAD = 60, 0.25  # frames, and width of the joints' prior
OPTIONS = FTEOptions(prior_width=SPREAD)
SEEN = Residual("seen", (Handle("dof"),), ("z",), ("q",), "rad", lambda h, d, _: ([h[0] - d["z"]], []))


# --- a linear problem: every degree of freedom is measured -------------------------------------------


class Linear:
    """A motion from the prior with known factor, each q measured with Gaussian noise."""

    def __init__(self, lizard, true=1.0, sd=0.01, seed=1):
        self.lizard, self.sd = lizard, sd
        self.dofs = lizard.skeleton.dofs
        self.limited = [j for j, d in enumerate(self.dofs) if np.isfinite(d.lower + d.upper)]
        q = prior_motion(lizard.skeleton, N, FPS, seed=seed, noise_scale=true, prior_width=SPREAD)
        self.z = q + np.random.default_rng(seed).normal(0, sd, q.shape)
        frames, dofs = (a.ravel() for a in np.mgrid[0:N, 0 : len(self.dofs)])
        data = {"z": self.z.ravel()}
        self.term = Term("seen", SEEN, frames, dofs[:, None], data, np.full(len(frames), sd))

    def fit(self, factors):
        problem = build_problem(
            self.lizard, FPS, np.arange(N), [self.term], OPTIONS, noise_factors=np.asarray(factors)
        )
        minimum = minimise(problem, self.z)
        return problem, minimum, posterior(problem, minimum)

    def exact(self, j, factor):
        """Log-density of what was measured of a joint with a range."""
        dof = self.dofs[j]
        noise = factor * process_noise(self.lizard.skeleton, dof, FPS)
        bands = prior_precision(dof, N, noise, FPS, SPREAD)
        upper = sum(np.diag(bands[3 - k, k:], k) for k in range(4))
        covariance = np.linalg.inv(upper + np.triu(upper, 1).T) + self.sd**2 * np.eye(N)
        return multivariate_normal(np.full(N, dof.middle), covariance).logpdf(self.z[:, j])


@pytest.mark.parametrize("sd", [0.003, 0.03])
def test_evidence_is_exact_where_the_problem_is_linear(lizard, sd):
    """Differences between process noises, against the density of the measurements."""
    linear = Linear(lizard, sd=sd)
    factors = np.ones(9)
    factors[linear.limited] = np.exp(np.random.default_rng(2).normal(0, 0.7, len(linear.limited)))
    found = evidence(*linear.fit(factors)) - evidence(*linear.fit(np.ones(9)))
    expected = sum(linear.exact(j, factors[j]) - linear.exact(j, 1.0) for j in linear.limited)
    assert abs(expected) > 1
    assert found == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("true", [0.3, 1.0, 3.0])
def test_tuning_ends_at_the_largest_evidence(lizard, true):
    linear = Linear(lizard, true)
    tuned = tune(*linear.fit(np.ones(9)), linear.fit)
    gain = best = 0.0
    for j in linear.limited:

        def cost(log, j=j):
            return 0.5 * (log / WIDTH) ** 2 - linear.exact(j, np.exp(log))

        optimum = minimize_scalar(cost, bounds=(-4, 4), method="bounded")
        gain += cost(0.0) - cost(np.log(tuned.factors[j]))
        best += cost(0.0) - optimum.fun
    assert best - 1.0 < gain < best + 1e-6
    assert tuned.gained >= gain - 1e-6  # the free degrees of freedom add theirs
    assert "process noise tuned" in tuned.finding


def test_result_of_tuning_is_a_fit_with_its_factors(lizard):
    linear = Linear(lizard, 3.0)
    start = linear.fit(np.ones(9))
    tuned = tune(*start, linear.fit)
    base, found = (next(t for t in p.terms if t.family == "model") for p in (start[0], tuned.problem))
    np.testing.assert_allclose(found.sd, base.sd * tuned.factors[base.items[:, 0]], rtol=1e-12)
    again = linear.fit(tuned.factors)
    np.testing.assert_allclose(tuned.minimum.q, again[1].q, atol=1e-5)
    np.testing.assert_allclose(tuned.posterior.q_sd, again[2].q_sd, rtol=1e-4)


@pytest.mark.parametrize("true", [0.3, 3.0])
def test_factor_of_the_truth_is_recovered(lizard, true):
    """The mean over all degrees of freedom, and most of them."""
    linear = Linear(lizard, true, sd=0.003, seed=5)
    ratio = tune(*linear.fit(np.ones(9)), linear.fit).factors / true
    assert np.exp(np.mean(np.log(ratio))) == pytest.approx(1.0, rel=0.2)
    assert np.quantile(np.abs(np.log(ratio)), 0.75) < np.log(1.3)


def test_tuning_stops_when_there_is_nothing_to_gain(lizard):
    linear = Linear(lizard, 1.0, sd=0.003)
    first = tune(*linear.fit(np.ones(9)), linear.fit)
    again = tune(*linear.fit(first.factors), lambda f: linear.fit(first.factors * f))
    assert 0 <= again.gained < 1.5
    np.testing.assert_allclose(again.factors, 1.0, rtol=0.15)


def test_a_fit_that_fails_ends_the_tuning(lizard):
    linear = Linear(lizard, 3.0)
    start = linear.fit(np.ones(9))

    def refit(factors):
        problem, minimum, _ = linear.fit(factors)
        return problem, replace(minimum, status=Status.FAILED), None

    tuned = tune(*start, refit)
    assert tuned.minimum is start[1] and tuned.posterior is start[2]
    assert np.array_equal(tuned.factors, np.ones(9))
    assert tuned.gained == 0.0


def test_nothing_to_tune_in_a_few_frames(lizard):
    problem, q = random_problem(lizard, n_frames=4)
    minimum = minimise(problem, q)
    tuned = tune(problem, minimum, posterior(problem, minimum), lambda _: pytest.fail("was fitted"))
    assert tuned.minimum is minimum
    assert np.array_equal(tuned.factors, np.ones(9))


# --- its parts ---------------------------------------------------------------------------------------


def test_moments_of_the_jumps_are_those_of_the_dense_covariance(lizard):
    problem, q = random_problem(lizard, n_frames=7, loss=Loss("squared"), outliers=0.0)
    minimum = minimise(problem, q)
    spread = posterior(problem, minimum)
    jumps, variance = jump_moments(problem, minimum, spread)
    np.testing.assert_allclose(jumps, np.diff(minimum.q, n=3, axis=0) * FPS**2, rtol=1e-9)
    hessian = np.diag(minimum.multipliers**2)
    for data in (True, False):
        terms = tuple(t for t in problem.terms if (t.family == "meas") == data)
        part = Condensed(replace(problem, terms=terms), exact=True)
        hessian += (spread.data_weight if data else 1.0) * dense(part, minimum.q.ravel())
    matrix = FPS**2 * np.diff(np.eye(7 * 9).reshape(7, 9, -1), n=3, axis=0)  # (N − 3, Q, N·Q)
    expected = np.einsum("njk,kl,njl->nj", matrix, np.linalg.inv(hessian), matrix)
    np.testing.assert_allclose(variance, expected, rtol=1e-5)
    sd = next(t.sd for t in problem.terms if t.family == "model")[:9]
    assert (variance < sd**2).all()  # data only narrow


@pytest.mark.parametrize("loss", sorted(DEFAULTS))
@pytest.mark.parametrize("weight", [0.3, 1.4])
def test_weight_of_the_data_multiplies_their_losses(lizard, loss, weight):
    problem, q = random_problem(lizard, loss=Loss(loss))
    x = away(q)
    before = Condensed(problem).term_values(x)
    after = Condensed(with_data_weight(problem, weight)).term_values(x)
    assert after.pop("meas") == pytest.approx(weight * before.pop("meas"), rel=1e-12)
    assert after == before


# --- pictures ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("true", [0.3, 3.0])
def test_tuning_on_pictures_with_outliers(lizard, true):
    """A motion of more or less agility than the species says, before four cameras."""
    rng = np.random.default_rng(0)
    q = prior_motion(lizard.skeleton, 100, FPS, seed=0, noise_scale=true, prior_width=SPREAD)
    cameras = cameras_about(radius=8.0)
    pixels = cameras.project(lizard.positions(q))
    pixels = pixels + rng.normal(0, 0.3, pixels.shape)
    wild = rng.random(pixels.shape[:3]) < 0.1
    pixels[wild] += rng.normal(0, 100, (wild.sum(), 2))
    sequence = make_sequence(lizard, q, cameras, pixels=pixels)

    def fit(factors):
        assumptions = Assumptions(sd_px=np.full(6, 0.3), noise_factors=factors)
        problem = build_fte(sequence, lizard, OPTIONS, assumptions)
        minimum = minimise(problem, q)
        return problem, minimum, posterior(problem, minimum)

    tuned = tune(*fit(np.ones(9)), fit)
    assert tuned.gained > 50
    assert tuned.minimum.status.ok
    ratio = tuned.factors / true
    assert np.exp(np.mean(np.log(ratio))) == pytest.approx(1.0, rel=0.2)
    assert np.median(np.abs(np.log(ratio))) < np.log(1.3)
