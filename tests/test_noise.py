"""Measurement noise from the data: the scale of contaminated samples, and of simulated recordings."""

import math

import numpy as np
import pytest
from conftest import FPS, cameras_about, make_sequence, random_motion

from acino_fte.condensed_solve import minimise
from acino_fte.initialise import initial_trajectory
from acino_fte.noise import PRIOR_COUNT, estimate_noise, robust_scale
from acino_fte.posterior import posterior
from acino_fte.prior_motion import prior_motion
from acino_fte.problem import Assumptions, FTEOptions, build_fte
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence

# --- the scale of a sample ---------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.01, 1.0, 30.0])
def test_scale_of_gaussian_samples(sigma):
    sample = np.random.default_rng(0).normal(0, sigma, (50, 2, 1000))
    assert robust_scale(sample) == pytest.approx(sigma, rel=0.01)


def test_scale_of_small_samples_is_hardly_biased_and_nearly_as_precise_as_their_standard_deviation():
    rng = np.random.default_rng(1)
    found = [robust_scale(rng.normal(size=100)) for _ in range(400)]
    assert np.mean(found) == pytest.approx(1.0, abs=0.02)
    assert np.std(found) < 1.4 / math.sqrt(2 * 100)


@pytest.mark.parametrize("far", [20.0, 500.0])
def test_gross_errors_hardly_disturb_it(far):
    rng = np.random.default_rng(2)
    for share, tolerance in ((0.05, 0.06), (0.2, 0.12)):
        sample = rng.normal(size=100_000)
        wild = rng.random(len(sample)) < share
        sample[wild] = rng.normal(0, far, wild.sum())
        assert robust_scale(sample) == pytest.approx(1.0, rel=tolerance)
        assert robust_scale(sample) > 0.99
        assert np.std(sample) > 4


def test_what_is_missing_does_not_count():
    sample = np.random.default_rng(3).normal(size=1000)
    holes = np.concatenate([sample, np.full(500, np.nan), np.full(3, np.inf)])
    assert robust_scale(holes) == robust_scale(sample)
    assert math.isnan(robust_scale(np.full(4, np.nan)))
    assert math.isnan(robust_scale(np.empty((0, 2))))
    assert robust_scale(np.zeros(10)) == 0.0


# --- recordings --------------------------------------------------------------------------------------


def test_noise_of_a_gallop(cheetah):
    """Two pixels for every marker; the table says two to five. Outliers and gaps as usual."""
    options = SimulationOptions(n_frames=100, noise_px=2.0, occlusion=False, seed=1)
    sequence = simulation_to_sequence(simulate(cheetah.skeleton, options))
    problem = build_fte(sequence, cheetah)
    minimum = minimise(problem, initial_trajectory(sequence, cheetah))
    table = np.array([m.sd_px for m in cheetah.skeleton.markers])
    found = estimate_noise(problem, minimum, posterior(problem, minimum), table)
    assert table.min() < 1.9 and table.max() > 5
    np.testing.assert_allclose(found, 2.0, rtol=0.08)
    assert np.median(found) == pytest.approx(2.0, rel=0.04)


def fits(lizard, seed, noise_scale, n_cameras):
    """A motion from the prior, fitted with it, and the noise with leverage and without."""
    q = prior_motion(lizard.skeleton, 60, FPS, seed=seed, noise_scale=noise_scale)
    sequence = make_sequence(lizard, q, cameras_about(n=n_cameras), noise_px=2.0, seed=seed)
    table = np.full(6, 2.0)
    options = FTEOptions(noise_scale=noise_scale, prior_width=0.25)
    problem = build_fte(sequence, lizard, options, Assumptions(sd_px=table))
    minimum = minimise(problem, q)
    return [estimate_noise(problem, minimum, p, table) for p in (posterior(problem, minimum), None)]


def test_leverage_makes_up_for_a_fit_that_follows_the_noise(lizard):
    found = np.array([fits(lizard, seed, 10.0, 2) for seed in range(4)])
    with_leverage, without = found.mean(axis=(0, 2))
    assert without < 1.8
    assert with_leverage == pytest.approx(2.0, rel=0.05)


def test_a_marker_that_was_not_seen_keeps_the_table(lizard):
    q = random_motion(lizard.skeleton, 10, 0)
    cameras = cameras_about()
    pixels = cameras.project(lizard.positions(q))
    pixels += np.random.default_rng(0).normal(0, 1.0, pixels.shape)
    pixels[:, :, 2] = np.nan
    pixels[1:, :, 3] = np.nan  # once
    sequence = make_sequence(lizard, q, cameras, pixels=pixels)
    problem = build_fte(sequence, lizard)
    table = np.array([m.sd_px for m in lizard.skeleton.markers])
    before = table.copy()
    found = estimate_noise(problem, minimise(problem, q), None, table)
    assert np.array_equal(table, before)
    assert found[2] == table[2]
    assert table[3] > found[3] > 0.5 * table[3]  # eight numbers against twenty
    assert (found[[0, 1, 4, 5]] < 0.75 * table[[0, 1, 4, 5]]).all()


def test_the_table_counts_like_some_observations(lizard):
    """In the logarithm: with a table ten times as large, the estimate moves by the table's share."""
    q = random_motion(lizard.skeleton, 10, 0)
    sequence = make_sequence(lizard, q, cameras_about(), noise_px=1.0)
    problem = build_fte(sequence, lizard, None, Assumptions(sd_px=np.ones(6)))
    minimum = minimise(problem, q)
    low, high = (estimate_noise(problem, minimum, None, np.full(6, t)) for t in (1.0, 10.0))
    count = 10 * 4 * 2
    np.testing.assert_allclose(high / low, 10 ** (PRIOR_COUNT / (PRIOR_COUNT + count)), rtol=1e-12)
