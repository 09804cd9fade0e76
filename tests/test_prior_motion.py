"""Motions drawn from the prior: they have its distribution, which is the one the estimator assumes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from acino_fte.errors import InputError
from acino_fte.kinematics import load_kinematics
from acino_fte.models import species_names
from acino_fte.prior_motion import prior_motion, prior_precision, process_noise
from acino_fte.problem import FTEOptions, build_problem
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.skeleton import load_skeleton
from acino_fte.terms import model_term, prior_term

FPS, WIDTH, SCALE = 90.0, 0.25, 0.7
N = 30


ARM = """
format: acino-fte/skeleton/1
name: arm
links: {arm: {parent: world, at: [0, 0, 1], dofs: {swing: {turn: y, range: [20, 60]}}}}
markers: {tip: {link: arm, at: [0, 0, -0.5]}}
"""


@pytest.fixture(scope="module")
def cheetah():
    return load_skeleton("cheetah")


@pytest.fixture(scope="module")
def draws(cheetah):
    """(200, N, Q) draws."""
    options = {"noise_scale": SCALE, "prior_width": WIDTH}
    return np.stack([prior_motion(cheetah, N, FPS, seed=s, **options) for s in range(200)])


def _limited(skeleton):
    return [j for j, d in enumerate(skeleton.dofs) if np.isfinite(d.lower + d.upper)]


def _dense(bands):
    n = bands.shape[1]
    upper = sum(np.diag(bands[3 - k, k:], k) for k in range(min(4, n)))
    return upper + np.triu(upper, 1).T


def _quadratic(skeleton, q):
    """(…, Q): Σ (w/σ)² + Σ ((q − mean)/(κh))² of trajectories (…, N, Q), by the definitions in terms.py."""
    fps, n = FPS, q.shape[-2]
    sd_w = model_term(skeleton, 2, fps).sd * SCALE
    w = np.diff(q, 3, axis=-2) * fps**2
    total = np.sum((w / sd_w) ** 2, axis=-2)
    term = prior_term(skeleton, n, WIDTH)
    j = term.items[: len(_limited(skeleton)), 0]
    mean, sd = (np.asarray(v)[: len(j)] for v in (term.data["mean"], term.sd))
    total[..., j] += np.sum(((q[..., j] - mean) / sd) ** 2, axis=-2)
    return total


def test_the_precision_is_that_of_the_terms(cheetah):
    rng = np.random.default_rng(0)
    q = rng.normal(size=(N, len(cheetah.dofs)))
    expected = _quadratic(cheetah, q)
    for j, dof in enumerate(cheetah.dofs):
        bands = prior_precision(dof, N, SCALE * process_noise(cheetah, dof, FPS), FPS, WIDTH)
        x = q[:, j] - dof.middle
        assert x @ _dense(bands) @ x == pytest.approx(expected[j], rel=1e-9)


def test_the_estimator_has_the_same_prior(cheetah, draws):
    """The objective of a problem without data is half the quadratic form."""
    from acino_fte.condensed import Condensed

    options = FTEOptions(noise_scale=SCALE, prior_width=WIDTH)
    problem = build_problem(load_kinematics(cheetah), FPS, np.arange(N), [], options)
    value = Condensed(problem).objective(draws[0].ravel())
    assert value == pytest.approx(0.5 * _quadratic(cheetah, draws[0]).sum(), rel=1e-6)


def test_the_quadratic_form_has_its_chi_square_distribution(cheetah, draws):
    form = _quadratic(cheetah, draws)
    for j in range(len(cheetah.dofs)):
        freedom = N if j in _limited(cheetah) else N - 3  # the free ones have no second sum
        assert form[:, j].mean() == pytest.approx(freedom, rel=5 * np.sqrt(2 / (freedom * 200)))
        assert kstest(form[:, j], chi2(freedom).cdf).pvalue > 1e-4, cheetah.dofs[j].name
    together = form.sum()
    assert together / (200 * (N * 25 + (N - 3) * 4)) == pytest.approx(1.0, abs=0.01)


def test_the_covariance_over_time_is_the_inverse_of_the_precision(tmp_path):
    path, n, count = tmp_path / "arm.yaml", 12, 2000
    path.write_text(ARM)
    arm = load_skeleton(path)
    options = {"noise_scale": SCALE, "prior_width": WIDTH}
    x = np.stack([prior_motion(arm, n, FPS, seed=s, **options)[:, 0] for s in range(count)])
    x -= arm.dofs[0].middle
    bands = prior_precision(arm.dofs[0], n, SCALE * process_noise(arm, arm.dofs[0], FPS), FPS, WIDTH)
    white = np.linalg.cholesky(_dense(bands)).T @ x.T
    assert np.allclose(white @ white.T / count, np.eye(n), atol=0.12)


def test_degrees_of_freedom_are_independent(cheetah, draws):
    middle = draws[:, N // 2, _limited(cheetah)]
    correlation = np.corrcoef(middle.T) - np.eye(middle.shape[1])
    assert np.abs(correlation).max() < 0.35  # 200 draws


def test_in_range_near_the_origin_and_above_the_ground():
    for species in species_names():
        skeleton = load_skeleton(species)
        for seed in range(4):
            q = prior_motion(skeleton, 120, 120.0, seed=seed)
            for j in _limited(skeleton):
                assert skeleton.dofs[j].lower < q[:, j].min()
                assert q[:, j].max() < skeleton.dofs[j].upper
            positions = load_kinematics(skeleton).positions(q)
            assert positions[..., 2].min() == pytest.approx(0.02)
            assert np.abs(positions).max() < 6.0


def test_seeds_and_lengths(cheetah):
    first = prior_motion(cheetah, 50, FPS, seed=3)
    assert np.array_equal(first, prior_motion(cheetah, 50, FPS, seed=3))
    assert not np.allclose(first, prior_motion(cheetah, 50, FPS, seed=4))
    for n in (1, 2, 3, 4, 5):
        assert np.all(np.isfinite(prior_motion(cheetah, n, FPS)))


@pytest.mark.parametrize("key", ["noise_scale", "prior_width"])
def test_a_prior_without_width_cannot_be_drawn_from(cheetah, key):
    with pytest.raises(InputError, match=key):
        prior_motion(cheetah, 10, FPS, **{key: 0.0})


def test_a_simulation_of_the_prior(cheetah):
    options = SimulationOptions(motion="prior", n_frames=60, noise_scale=0.5, prior_width=0.2, seed=2)
    simulation = simulate(cheetah, options)
    expected = prior_motion(cheetah, 60, 120.0, seed=2, noise_scale=0.5, prior_width=0.2)
    assert np.array_equal(simulation.q, expected)
    assert not any("treadmill" in note for note in simulation.notes)
    assert simulation.detections.in_image.mean() > 0.9
    assert simulation_to_sequence(simulation).name == "cheetah_prior"
    grown = simulate(cheetah, replace(options, proportions=0.1, offsets_mm=5.0, moved_mm=10.0))
    assert np.array_equal(grown.q, expected)
    with pytest.raises(InputError, match="no camera can be late"):
        replace(options, delay_ms=1.0)
