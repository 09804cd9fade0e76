"""Solving: the minimum by a second route, options, and every way in which a solve can end."""

import os
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest
from conftest import FPS, cameras_about, make_sequence, random_motion, random_problem
from scipy.optimize import least_squares

from acino_fte.condensed import Condensed
from acino_fte.condensed_solve import minimise
from acino_fte.errors import InputError
from acino_fte.initialise import initial_trajectory
from acino_fte.losses import DEFAULTS, Loss
from acino_fte.problem import FTEOptions, build_fte
from acino_fte.residuals import Handle, Residual
from acino_fte.result import Status
from acino_fte.solve import SolveOptions, solve_fte
from acino_fte.terms import Term

TIGHT = SolveOptions(tolerance=1e-5, acceptable_tolerance=1e-4)


@pytest.fixture(scope="module")
def recording(lizard):
    """Eight frames that four cameras saw, the problem, and a start."""
    q = random_motion(lizard.skeleton, 40, 1)[:8]
    sequence = make_sequence(lizard, q, cameras_about(), noise_px=2.0)
    return sequence, build_fte(sequence, lizard), initial_trajectory(sequence, lizard)


def far(problem, q, size=0.3):
    return problem.clip(q + np.random.default_rng(0).normal(0, size, q.shape))


# --- the minimum -------------------------------------------------------------------------------------


def test_minimum_equals_scipy_least_squares(lizard, recording):
    """Residuals written out anew; bounded trust-region least squares instead of IPOPT."""
    sequence, _, start = recording
    problem = build_fte(sequence, lizard, FTEOptions(loss=Loss("squared")))
    skeleton = lizard.skeleton
    noise = np.array([d.noise for d in skeleton.dofs])
    limited = [j for j, d in enumerate(skeleton.dofs) if np.isfinite(d.lower)]
    middle = np.array([skeleton.dofs[j].middle for j in limited])
    width = np.array([skeleton.dofs[j].upper - skeleton.dofs[j].lower for j in limited])
    pixels = sequence.detections.position.values
    sd = np.array([m.sd_px for m in skeleton.markers])

    def residuals(x):
        q = x.reshape(start.shape)
        seen = sequence.cameras.project(lizard.positions(q))
        jump = np.diff(q, n=3, axis=0) * FPS**2 / noise
        prior = (q[:, limited] - middle) / width
        return np.concatenate([((seen - pixels) / sd[:, None]).ravel(), jump.ravel(), prior.ravel()])

    bounds = (np.tile(problem.lower, len(start)), np.tile(problem.upper, len(start)))
    other = least_squares(residuals, start.ravel(), bounds=bounds, xtol=1e-13, ftol=1e-13, gtol=1e-10)
    mine = minimise(problem, start, TIGHT)
    assert mine.status is Status.CONVERGED
    assert mine.objective == pytest.approx(other.cost, rel=1e-7)
    distance = lizard.positions(mine.q) - lizard.positions(other.x.reshape(start.shape))
    assert np.abs(distance).max() < 1e-5


@pytest.mark.parametrize("loss", sorted(DEFAULTS))
def test_every_kind_of_hessian_ends_in_one_minimum(lizard, loss):
    problem, q = random_problem(lizard, loss=Loss(loss), seed=2, outliers=0.05)
    start = problem.clip(q + np.random.default_rng(1).normal(0, 0.002, q.shape))
    found = [minimise(problem, start, replace(TIGHT, hessian=h)) for h in ("auto", "gauss-newton", "exact")]
    for minimum in found:
        assert minimum.status.ok
        assert minimum.objective == pytest.approx(found[0].objective, rel=1e-6)
        assert np.abs(minimum.q - found[0].q).max() < 1e-2


def test_minimum_is_one(lizard, recording):
    """No small step within the bounds lowers the objective."""
    problem, start = recording[1:]
    minimum = minimise(problem, start, TIGHT)
    condensed = Condensed(problem)
    gradient = condensed.gradient(minimum.q.ravel()).reshape(minimum.q.shape)
    inside = (minimum.q > problem.lower + 1e-3) & (minimum.q < problem.upper - 1e-3)
    assert np.abs(gradient[inside]).max() < 1e-2
    rng = np.random.default_rng(0)
    for _ in range(20):
        near = problem.clip(minimum.q + rng.normal(0, 1e-3, minimum.q.shape))
        assert condensed.objective(near.ravel()) >= minimum.objective - 1e-6


def test_bounds_hold_and_bind(lizard, recording):
    sequence, problem, start = recording
    upper = problem.upper.copy()
    yaw = lizard.skeleton.dof("tail.yaw")
    free = minimise(problem, start, TIGHT)
    upper[yaw] = np.median(free.q[:, yaw])
    bound = minimise(replace(problem, upper=upper), start, TIGHT)
    assert bound.status.ok
    assert (bound.q <= upper).all()
    assert bound.q[:, yaw].max() == pytest.approx(upper[yaw], abs=1e-4)
    assert bound.objective > free.objective


def test_start_outside_the_bounds(lizard, recording):
    problem, start = recording[1:]
    outside = start.copy()
    outside[:, lizard.skeleton.dof("trunk.pitch")] = 7.0
    minimum = minimise(problem, outside, TIGHT)
    assert minimum.status.ok
    assert (minimum.q >= problem.lower).all()
    assert (minimum.q <= problem.upper).all()


def test_same_input_same_result(recording):
    problem, start = recording[1:]
    first, second = minimise(problem, start), minimise(problem, start)
    assert np.array_equal(first.q, second.q)
    assert first.iterations == second.iterations


# --- the result --------------------------------------------------------------------------------------


def test_result_of_a_converged_solve(lizard, recording):
    sequence, problem, start = recording
    calls, seconds = [], {"load": 1.0, "initialise": 0.5, "build": 0.1}
    result = solve_fte(problem, start, progress=lambda *a: calls.append(a), seconds=seconds)
    assert result.status is Status.CONVERGED
    assert result.method == "fte-condensed"
    assert [c[0] for c in calls] == list(range(result.iterations + 1))
    assert calls[-1][1] == pytest.approx(result.objective, rel=1e-9)
    assert result.objective == pytest.approx(Condensed(problem).objective(result.q.ravel()), rel=1e-9)
    assert np.allclose(result.positions, lizard.positions(result.q))
    assert np.allclose(result.reprojected, sequence.cameras.project(result.positions))
    assert np.allclose(result.dq[1:], np.diff(result.q, axis=0) * FPS)
    assert np.allclose(result.ddq[2:], np.diff(result.q, n=2, axis=0) * FPS**2)
    assert set(result.seconds) == {"load", "initialise", "build", "solve"}
    assert seconds == {"load": 1.0, "initialise": 0.5, "build": 0.1}  # not written to
    assert result.options["solver"]["hessian"] == "auto"
    assert result.options["problem"]["loss"]["name"] == "geman_mcclure"
    assert result.metrics["status"] == "converged"
    assert np.median(result.errors) < 4


def test_problem_without_a_sequence(lizard):
    problem, q = random_problem(lizard, n_frames=1)
    with pytest.raises(InputError, match="holds no sequence"):
        solve_fte(problem, q)


def test_an_unknown_lowering(recording):
    with pytest.raises(InputError, match="no lowering 'implicit'") as error:
        solve_fte(recording[1], recording[2], lowering="implicit")
    assert "'condensed' or 'explicit'" in error.value.expected


# --- how a solve can end -----------------------------------------------------------------------------


def test_out_of_iterations_gives_the_best_iterate(recording):
    _, problem, start = recording
    at = far(problem, start)
    result = solve_fte(problem, at, SolveOptions(max_iter=1))
    assert result.status is Status.MAX_ITERATIONS
    assert result.iterations == 1
    assert not result.status.ok
    assert "--max-iter" in result.status.advice
    assert result.objective <= Condensed(problem).objective(at.ravel())
    assert result.objective == pytest.approx(Condensed(problem).objective(result.q.ravel()))
    assert result.metrics["status"] == "max_iterations"


def test_no_iteration_at_all(recording):
    _, problem, start = recording
    minimum = minimise(problem, far(problem, start), SolveOptions(max_iter=0))
    assert minimum.status is Status.MAX_ITERATIONS
    assert np.isfinite(minimum.q).all()


def test_out_of_time(recording):
    _, problem, start = recording
    minimum = minimise(problem, far(problem, start), SolveOptions(max_seconds=1e-6))
    assert minimum.status is Status.MAX_TIME
    assert np.isfinite(minimum.q).all()


def test_interrupt_gives_the_best_iterate(recording):
    """Ctrl-C, sent after the second iteration."""
    _, problem, start = recording
    handler = signal.getsignal(signal.SIGINT)

    def progress(iteration, _value):
        if iteration == 2:
            os.kill(os.getpid(), signal.SIGINT)

    at = far(problem, start)
    result = solve_fte(problem, at, TIGHT, progress=progress)
    assert result.status is Status.INTERRUPTED
    assert 2 <= result.iterations <= 3
    assert result.objective < Condensed(problem).objective(at.ravel())
    assert result.objective == pytest.approx(Condensed(problem).objective(result.q.ravel()))
    assert signal.getsignal(signal.SIGINT) is handler


def test_an_interrupt_is_told_from_good_enough(recording):
    _, problem, start = recording
    at = far(problem, start)
    stopped = minimise(problem, at, progress=lambda *_: os.kill(os.getpid(), signal.SIGINT), enough=1e-9)
    assert stopped.status is Status.INTERRUPTED
    assert minimise(problem, at, enough=0.5).status is Status.ACCEPTABLE


def test_solve_in_a_thread(recording):
    """Signals belong to the main thread; elsewhere a solve just runs."""
    _, problem, start = recording
    found = []
    thread = threading.Thread(target=lambda: found.append(minimise(problem, start)))
    thread.start()
    thread.join()
    assert found[0].status is Status.CONVERGED


def test_enough_stops_early(recording):
    _, problem, start = recording
    at = far(problem, start, 0.05)
    assert minimise(problem, at, TIGHT, enough=0.2).iterations < minimise(problem, at, TIGHT).iterations


def test_numbers_that_are_none_end_as_failed(lizard, recording):
    """A term of one's own that gives NaN."""
    _, problem, start = recording
    broken = Residual(
        "broken",
        (Handle("dof"),),
        ("level",),
        ("r",),
        "m",
        lambda h, data, _let: ([h[0] - data["level"]], []),
    )
    term = Term("own", broken, np.array([0]), np.array([[0]]), {"level": np.array([np.nan])}, np.array([1.0]))
    minimum = minimise(problem.with_terms(term), start)
    assert minimum.status is Status.FAILED
    assert np.isfinite(minimum.q).all()


def test_every_status_says_what_to_do():
    for status in Status:
        assert len(status.advice) > 15
        assert status.advice.endswith(".")
    assert [s for s in Status if s.ok] == [Status.CONVERGED, Status.ACCEPTABLE]


# --- options -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_iter", -1),
        ("tolerance", 0.0),
        ("tolerance", float("nan")),
        ("max_seconds", 0.0),
        ("print_level", 13),
        ("print_level", -1),
        ("linear_solver", "mumsp"),
        ("hessian", "newton"),
    ],
)
def test_wrong_options(name, value):
    with pytest.raises(InputError, match=f"{name} cannot be") as error:
        SolveOptions(**{name: value})
    assert error.value.key == name


def test_a_linear_solver_that_is_not_installed(recording):
    """The wheel of IPOPT has MUMPS and can load HSL's solvers, which are not on this machine."""
    _, problem, start = recording
    with pytest.raises(InputError, match="could not load the linear solver 'ma57'"):
        minimise(problem, start, SolveOptions(linear_solver="ma57"))


def test_options_reach_ipopt():
    words = SolveOptions(max_iter=7, tolerance=0.5, max_seconds=9, print_level=3).ipopt()
    assert (words["max_iter"], words["tol"], words["max_wall_time"], words["print_level"]) == (7, 0.5, 9.0, 3)
    assert words["linear_solver"] == "mumps"
