"""Projected Newton steps: the step by a dense second route, bounds, and how the steps end."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import cameras_about, make_sequence, random_motion, unlimited

from acino_fte import newton
from acino_fte.arrow import NotPositiveDefinite
from acino_fte.condensed import Condensed
from acino_fte.condensed_solve import bounds, minimise
from acino_fte.initialise import initial_trajectory
from acino_fte.newton import Limits, approach, newton_step
from acino_fte.problem import FTEOptions, build_fte
from acino_fte.solve import SolveOptions

FREELY = Limits(60, 1e-4)


@pytest.fixture(scope="module")
def recording(lizard):
    """Problem with scales to estimate, and a start: eight frames that four cameras saw."""
    q = random_motion(lizard.skeleton, 40, 1)[:8]
    sequence = make_sequence(lizard, q, cameras_about(), noise_px=2.0)
    return build_fte(sequence, lizard, FTEOptions(fit=("scale",))), initial_trajectory(sequence, lizard)


def condensed_at(recording, **changes):
    problem, start = recording
    problem = replace(problem, **changes)
    condensed = Condensed(problem)
    return condensed, condensed.pack(start, np.zeros(condensed.n_parameters)), bounds(problem)


def narrowed(recording):
    """The same with a bound that cuts through the trajectory."""
    problem, start = recording
    upper = problem.upper.copy()
    yaw = problem.kinematics.skeleton.dof("tail.yaw")
    upper[yaw] = np.median(start[:, yaw])
    return condensed_at(recording, upper=upper)


def dense(condensed, x):
    """The Hessian as one matrix, from the entries that IPOPT gets."""
    rows, columns = condensed.structure
    matrix = np.zeros((x.size, x.size))
    np.add.at(matrix, (rows, columns), condensed.hessian(x))
    return matrix + np.tril(matrix, -1).T


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_the_step_is_that_of_the_dense_system_over_what_is_free(recording, share):
    condensed, x, _ = condensed_at(recording)
    gradient = condensed.gradient(x)
    held = np.random.default_rng(3).random(x.size) < share
    step = newton_step(condensed, x, gradient, held)
    free = ~held
    expected = np.zeros(x.size)
    expected[free] = -np.linalg.solve(dense(condensed, x)[np.ix_(free, free)], gradient[free])
    np.testing.assert_allclose(step, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("limited", [False, True])
def test_ends_where_the_conditions_of_a_minimum_hold(recording, limited):
    condensed, x, (lower, upper) = narrowed(recording) if limited else condensed_at(recording)
    found = approach(condensed, x, lower, upper, FREELY)
    assert found.converged
    gradient = condensed.gradient(found.x)
    below, above = found.x <= lower, found.x >= upper
    assert (below | above).any() == limited
    assert np.abs(gradient[~(below | above)]).max() <= FREELY.tolerance
    assert (gradient[below] >= 0).all()
    assert (gradient[above] <= 0).all()


def test_every_step_lowers_the_objective_and_is_reported(recording):
    condensed, x, (lower, upper) = narrowed(recording)
    told = []
    found = approach(condensed, x, lower, upper, FREELY, lambda i, value: told.append((i, value)) or True)
    numbers, values = zip(*told, strict=True)
    assert numbers == tuple(range(found.iterations + 1))
    assert (np.diff(values) < 0).all()
    assert values[-1] == found.value


def test_stops_when_told_to_and_after_its_iterations(recording):
    condensed, x, bound = condensed_at(recording)
    told = approach(condensed, x, *bound, FREELY, lambda i, _: i < 2)
    assert (told.iterations, told.converged) == (2, False)
    short = approach(condensed, x, *bound, Limits(1, 1e-6))
    assert (short.iterations, short.converged) == (1, False)
    none = approach(condensed, x, *bound, Limits(60, 1e-6, max_seconds=0.0))
    assert (none.iterations, none.converged) == (0, False)


def test_gauss_newton_steps_where_the_exact_hessian_bends_down(recording, monkeypatch):
    """The exact Hessian is used again in the next step."""
    condensed, x, bound = condensed_at(recording)
    condensed.use_exact()
    used, original = [], newton.newton_step

    def step(condensed, *arguments):
        used.append(condensed.exact)
        if condensed.exact:
            raise NotPositiveDefinite("bends down")
        return original(condensed, *arguments)

    monkeypatch.setattr(newton, "newton_step", step)
    found = approach(condensed, x, *bound, Limits(2, 1e-9))
    assert found.iterations == 2
    assert used == [True, False, True, False]
    assert condensed.exact


def test_a_singular_hessian_is_damped(lizard, recording):
    """Two frames seen of eight: three modes of the motion are free, and steps lead down nevertheless."""
    problem, start = recording
    sequence = problem.sequence
    unseen = np.isin(sequence.frames, [3, 4], invert=True)
    pixels = sequence.detections.position.values.copy()
    pixels[unseen] = np.nan
    few = make_sequence(lizard, start, sequence.cameras, pixels=pixels)
    condensed = Condensed(unlimited(build_fte(few, lizard, FTEOptions(fit=()))))
    x = condensed.pack(start + 0.05, np.zeros(0))
    held = np.zeros(x.size, dtype=bool)
    with pytest.raises(NotPositiveDefinite):
        newton_step(condensed, x, condensed.gradient(x), held)
    far = np.full(x.size, 1e20)
    found = approach(condensed, x, -far, far, Limits(30, 1e-3))
    assert found.converged
    assert found.value < 0.1 * condensed.objective(x)


def test_no_way_down_is_no_error(recording, monkeypatch):
    condensed, x, bound = condensed_at(recording)
    monkeypatch.setattr(newton, "newton_step", lambda _, x, gradient, held: gradient)
    found = approach(condensed, x, *bound, FREELY)
    assert (found.iterations, found.converged) == (0, False)
    np.testing.assert_array_equal(found.x, np.clip(x, *bound))


def test_the_minimum_is_that_of_ipopt_alone(recording, monkeypatch):
    problem, start = recording
    tight = SolveOptions(tolerance=1e-6, acceptable_tolerance=1e-5)
    mine = minimise(unlimited(problem), start, tight)
    monkeypatch.setattr(newton, "newton_step", lambda _, x, gradient, held: gradient)  # leads nowhere
    other = minimise(unlimited(problem), start, tight)
    assert other.objective == pytest.approx(mine.objective, rel=1e-9)
    np.testing.assert_allclose(mine.q, other.q, atol=1e-6)
    np.testing.assert_allclose(mine.theta, other.theta, atol=1e-6)
    assert mine.iterations < other.iterations


def test_what_bounds_hold_back_is_in_the_multipliers(recording):
    problem, start = recording
    upper = problem.upper.copy()
    yaw = problem.kinematics.skeleton.dof("tail.yaw")
    upper[yaw] = np.median(start[:, yaw])
    problem = replace(problem, upper=upper)
    for enough in (0.0, 1e-9):  # a result, and a start
        minimum = minimise(problem, start, SolveOptions(tolerance=1e-6), enough=enough)
        gradient = Condensed(problem).gradient(Condensed(problem).pack(minimum.q, minimum.theta))
        multipliers = minimum.multipliers[: start.size].reshape(start.shape)[:, yaw]
        pushed = -gradient[: start.size].reshape(start.shape)[:, yaw]
        assert (multipliers > 1.0).any()
        np.testing.assert_allclose(multipliers, np.maximum(pushed, 0), atol=0.05)
