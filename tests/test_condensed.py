"""The condensed lowering: derivatives against finite differences, sparsity, points behind a camera."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import FPS, cameras_about, look_at, random_motion, random_problem

from acino_fte.condensed import Condensed
from acino_fte.losses import DEFAULTS, Loss
from acino_fte.problem import FTEOptions, build_problem
from acino_fte.terms import measurement_term, point_term

STEP = 1e-6


def numeric_gradient(condensed, x):
    gradient = np.empty_like(x)
    for i in range(len(x)):
        up, down = x.copy(), x.copy()
        up[i] += STEP
        down[i] -= STEP
        gradient[i] = (condensed.objective(up) - condensed.objective(down)) / (2 * STEP)
    return gradient


def numeric_hessian(condensed, x):
    rows = []
    for i in range(len(x)):
        up, down = x.copy(), x.copy()
        up[i] += STEP
        down[i] -= STEP
        rows.append((condensed.gradient(up) - condensed.gradient(down)) / (2 * STEP))
    return np.array(rows)


def dense(condensed, x):
    """The Hessian as a full matrix from its sparse lower triangle."""
    rows, columns = condensed.structure
    lower = np.zeros((len(x), len(x)))
    lower[rows, columns] = condensed.hessian(x)
    return lower + np.tril(lower, -1).T


def away(q, seed=5, size=0.03):
    """A point off the truth, so that no residual is zero."""
    return (q + np.random.default_rng(seed).normal(0, size, q.shape)).ravel()


def measured(problem):
    """The problem with its measurements alone: nothing larger hides their derivatives."""
    return replace(problem, terms=tuple(t for t in problem.terms if t.family == "meas"))


def assert_close(found, expected, tolerance):
    assert np.abs(found - expected).max() <= tolerance * np.abs(expected).max()


@pytest.mark.parametrize("moving", [False, True], ids=["fixed", "moving"])
@pytest.mark.parametrize("loss", sorted(DEFAULTS))
def test_gradient_equals_central_differences(lizard, loss, moving):
    problem, q = random_problem(lizard, loss=Loss(loss), moving=moving, seed=len(loss))
    x = away(q)
    for condensed in (Condensed(problem), Condensed(measured(problem))):
        assert_close(condensed.gradient(x), numeric_gradient(condensed, x), 1e-6)


@pytest.mark.parametrize("moving", [False, True], ids=["fixed", "moving"])
@pytest.mark.parametrize("loss", sorted(DEFAULTS))
def test_exact_hessian_equals_differences_of_the_gradient(lizard, loss, moving):
    problem, q = random_problem(lizard, n_frames=4, loss=Loss(loss), moving=moving, seed=len(loss))
    x = away(q)  # four frames: all that a jump of acceleration holds together
    for condensed in (Condensed(problem, exact=True), Condensed(measured(problem), exact=True)):
        assert_close(dense(condensed, x), numeric_hessian(condensed, x), 1e-5)


def test_exact_hessian_of_the_cheetah(cheetah):
    """Long chains: second derivatives of markers for degrees of freedom far apart."""
    q = random_motion(cheetah.skeleton, 1, 2)
    points = cheetah.positions(q) + np.random.default_rng(1).normal(0, 0.1, (1, 24, 3))
    problem = build_problem(
        cheetah, FPS, np.arange(1), [point_term(points, 0.05, Loss("cauchy"))], FTEOptions()
    )
    condensed, x = Condensed(problem, exact=True), away(q)
    assert_close(condensed.gradient(x), numeric_gradient(condensed, x), 1e-6)
    assert_close(dense(condensed, x), numeric_hessian(condensed, x), 1e-5)


@pytest.mark.parametrize("loss", sorted(DEFAULTS))
def test_gauss_newton_is_positive_semidefinite(lizard, loss):
    problem, q = random_problem(lizard, loss=Loss(loss), moving=True, outliers=0.5)
    condensed, x = Condensed(problem), away(q, size=0.3)
    eigenvalues = np.linalg.eigvalsh(dense(condensed, x))
    assert eigenvalues.min() >= -1e-9 * eigenvalues.max()


def test_gauss_newton_equals_exact_where_residuals_vanish(lizard):
    problem, q = random_problem(lizard, loss=Loss("squared"), noise_px=0.0, outliers=0.0)
    problem, x = measured(problem), q.ravel()
    assert Condensed(problem).objective(x) < 1e-12
    assert_close(dense(Condensed(problem), x), dense(Condensed(problem, exact=True), x), 1e-9)


def test_use_exact_switches_the_hessian_only(lizard):
    problem, q = random_problem(lizard)
    condensed, x = Condensed(problem), away(q)
    gradient, value, first = condensed.gradient(x), condensed.objective(x), condensed.hessian(x)
    condensed.use_exact()
    assert_close(condensed.gradient(x), gradient, 1e-12)
    assert condensed.objective(x) == pytest.approx(value, rel=1e-12)
    second = condensed.hessian(x)
    assert not np.allclose(first, second)
    assert np.allclose(second, Condensed(problem, exact=True).hessian(x))


def test_structure_is_a_lower_band_without_duplicates(lizard):
    problem, _ = random_problem(lizard, n_frames=9)
    rows, columns = Condensed(problem).structure
    d = lizard.n_dofs
    assert (columns <= rows).all()
    assert len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == len(rows)
    assert (rows // d - columns // d).max() == 3  # the jump of acceleration reaches three frames back
    assert set(range(9 * d)) <= {int(r) for r, c in zip(rows, columns, strict=True) if r == c}


def test_structure_holds_every_entry_that_is_not_zero(lizard):
    problem, q = random_problem(lizard, n_frames=5)
    condensed, x = Condensed(problem, exact=True), away(q, size=0.001)
    rows, columns = condensed.structure
    inside = np.zeros((len(x), len(x)), dtype=bool)
    inside[rows, columns] = inside[columns, rows] = True
    numeric = numeric_hessian(condensed, x)
    assert np.abs(numeric[~inside]).max() < 1e-6 * np.abs(numeric).max()


def test_entries_grow_linearly_with_the_frames(lizard):
    """The pattern of a frame does not depend on how many there are: time and memory are O(N)."""
    size = {}
    patterns = []
    for n in (8, 16, 32):
        condensed = Condensed(random_problem(lizard, n_frames=n)[0])
        size[n] = len(condensed.structure[0])
        patterns.append(condensed._hessian._patterns)
    assert size[32] - size[16] == 2 * (size[16] - size[8])
    for other in patterns[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(patterns[0], other, strict=True))


def test_objective_is_the_sum_of_its_families(lizard):
    problem, q = random_problem(lizard)
    condensed, x = Condensed(problem), away(q)
    values = condensed.term_values(x)
    assert set(values) == {"meas", "model", "prior"}
    assert sum(values.values()) == pytest.approx(condensed.objective(x), rel=1e-12)


def test_objective_written_out_by_hand(lizard):
    """Reprojection, jumps of acceleration and prior, as the module docstring of the problem says."""
    problem, q = random_problem(lizard, n_frames=5, loss=Loss("squared"), moving=True)
    x = away(q)
    values = Condensed(problem).term_values(x)
    now = x.reshape(q.shape)
    jump = np.diff(now, n=3, axis=0) * FPS**2
    noise = np.array([d.noise for d in lizard.skeleton.dofs])
    assert values["model"] == pytest.approx(0.5 * ((jump / noise) ** 2).sum(), rel=1e-9)
    limited = [(j, d) for j, d in enumerate(lizard.skeleton.dofs) if np.isfinite(d.lower)]
    prior = sum((((now[:, j] - d.middle) / (d.upper - d.lower)) ** 2).sum() for j, d in limited)
    assert values["prior"] == pytest.approx(0.5 * prior, rel=1e-9)  # twice half the range is the range
    projected = cameras_about(5, moving=True).project(lizard.positions(now))
    total = 0.0
    for term in problem.terms:
        if term.family == "meas":
            seen = projected[term.frames, int(term.label[1:]), term.items[:, 0]]
            detected = np.stack([term.data["u"], term.data["v"]], axis=1)
            total += 0.5 * (((seen - detected) / term.sd[:, None]) ** 2).sum()
    assert values["meas"] == pytest.approx(total, rel=1e-9)


def behind(lizard, loss):
    """A camera that has the animal behind it, and one that sees it."""
    q = random_motion(lizard.skeleton, 1, 0)
    pixels = np.full((1, 6, 2), 300.0)
    sd = np.full(6, 3.0)
    back = look_at("back", [3.0, 0.0, 0.5], [6.0, 0.0, 0.5])
    front = look_at("front", [3.0, 1.0, 0.5], [0.0, 0.0, 0.0], "fisheye")
    terms = [measurement_term(c, pixels, sd, loss, 1) for c in (back, front)]
    return build_problem(lizard, FPS, np.arange(1), terms, FTEOptions(loss=loss)), q


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("name", ["redescending", "geman_mcclure"])
def test_points_behind_a_camera_cost_the_bound_and_do_not_pull(lizard, name, exact):
    problem, q = behind(lizard, Loss(name))
    condensed, x = Condensed(problem, exact=exact), q.ravel()
    alone = Condensed(replace(problem, terms=problem.terms[1:]), exact=exact)
    bound = float(Loss(name).value(np.array([np.inf]))[0])
    assert condensed.objective(x) == pytest.approx(alone.objective(x) + 6 * 2 * bound)
    assert np.allclose(condensed.gradient(x), alone.gradient(x), rtol=0, atol=1e-9)
    assert np.allclose(dense(condensed, x), dense(alone, x), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", ["squared", "huber", "cauchy"])
def test_points_behind_a_camera_are_out_of_reach_of_unbounded_losses(lizard, name):
    problem, q = behind(lizard, Loss(name))
    condensed = Condensed(problem, exact=True)
    assert condensed.objective(q.ravel()) == np.inf  # a line search turns back
    assert np.isfinite(condensed.gradient(q.ravel())).all()
    assert np.isfinite(condensed.hessian(q.ravel())).all()


@pytest.mark.parametrize("n_frames", [1, 2, 3, 4])
def test_very_short_problems(lizard, n_frames):
    problem, q = random_problem(lizard, n_frames=n_frames)
    condensed, x = Condensed(problem, exact=True), away(q)
    assert_close(condensed.gradient(x), numeric_gradient(condensed, x), 1e-6)
    assert_close(dense(condensed, x), numeric_hessian(condensed, x), 1e-5)
