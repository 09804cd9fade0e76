"""Smooth curves through noisy points: against dense algebra, leaving points out, and simulation."""

from math import factorial

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from acino_fte.data_tools.wiener_path import fit_wiener_path, transition

ORDERS = [1, 2, 3]


def kernel(order, first, second, a=0, b=0):
    """Covariance of the a-th derivative at times (N,) with the b-th at times (M,), from rest at 0, density 1.

    ∫ from 0 to min(t, s) of (t−u)^(p−1−a)/(p−1−a)! (s−u)^(p−1−b)/(p−1−b)!, exact by Gauss and Legendre.
    """
    node, weight = np.polynomial.legendre.leggauss(8)
    t, s = np.meshgrid(first, second, indexing="ij")
    half = 0.5 * np.minimum(t, s)[..., None]
    u = half * (node + 1.0)
    i, j = order - 1 - a, order - 1 - b
    values = (t[..., None] - u) ** i / factorial(i) * (s[..., None] - u) ** j / factorial(j)
    return (half * weight * values).sum(-1)


class Dense:
    """The posterior of one piece by dense matrices, of all states (p derivatives) at `asked`.

    The states at the first point are unknown, the constant free and the derivatives about zero with variance
    `extent`; to what follows from them the integrated Wiener process is added. Times count from there.
    """

    def __init__(self, time, points, noise, order, extent, density, asked=None):
        asked, p = time if asked is None else asked, order
        n = len(asked)
        whole = density * kernel(p, time, time) + np.diag(noise)
        inverse, trend = np.linalg.inv(whole), polynomials(p, time)[:, 0]
        self.prior = np.diag([0.0] + [1.0 / extent] * (p - 1))
        known = trend.T @ inverse @ trend + self.prior
        start = np.linalg.solve(known, trend.T @ inverse @ points)
        rest = points - trend @ start
        self.misfit = np.einsum("kd,kl,ld->", rest, inverse, rest) + (start * (self.prior @ start)).sum()
        self.log_size = np.linalg.slogdet(whole)[1] + np.linalg.slogdet(known)[1]
        to = density * np.stack([kernel(p, asked, time, a) for a in range(p)], axis=1).reshape(n * p, -1)
        both = [[kernel(p, asked, asked, a, b) for b in range(p)] for a in range(p)]
        own = density * np.moveaxis(np.array(both), (0, 1), (1, 3)).reshape(n * p, n * p)
        begin = polynomials(p, asked).reshape(n * p, p)
        self.mean = (begin @ start + to @ inverse @ rest).reshape(n, p, -1)
        left = begin - to @ inverse @ trend
        full = own - to @ inverse @ to.T + left @ np.linalg.inv(known) @ left.T
        self.covariance = full.reshape(n, p, n, p).transpose(0, 2, 1, 3)

    def log_evidence(self, axes):
        return -0.5 * (self.misfit + axes * self.log_size)


def polynomials(order, time):
    """How the states at times (N, p, p) follow from the one at 0."""
    return transition(order, time)[0]


def some_points(seed=0, n=9, axes=2):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.integers(1, 6, n)).astype(float)
    points = np.sin(0.3 * time[:, None] + [0.0, 1.0]) * 3 + rng.normal(0, 0.1, (n, axes)) + [5.0, -70.0]
    return time, points, rng.uniform(0.005, 0.03, n)


def extent_of(points, noise):
    """Variance of a derivative where a curve begins: twice the mean square, and a hundred times the noise."""
    return 2.0 * ((points - points.mean(0)) ** 2).sum(1).mean() + 100.0 * noise.mean()


def dense_of(time, points, noise, order, density, asked=None):
    unit = np.median(np.diff(time))
    asked = None if asked is None else (asked - time[0]) / unit
    middle = points.mean(0)
    dense = Dense(
        (time - time[0]) / unit, points - middle, noise, order, extent_of(points, noise), density, asked
    )
    dense.mean[:, 0] += middle
    return dense


def draw(time, order, density, axes, rng, start=0.0):
    """Integrated Wiener paths (K, p, D) at times, from zero derivatives."""
    forward, noise = transition(order, np.diff(time))
    state = np.zeros((len(time), order, axes))
    state[0] = start
    for k, (a, q) in enumerate(zip(forward, noise, strict=True)):
        state[k + 1] = a @ state[k] + np.sqrt(density) * np.linalg.cholesky(q) @ rng.normal(
            size=(order, axes)
        )
    return state


@pytest.mark.parametrize("order", ORDERS)
def test_steps_are_those_of_the_integrated_process(order):
    """A(h) and Q(h) against the kernel, and two steps against one."""
    forward, noise = transition(order, np.array([0.7, 1.6, 2.3]))
    for a in range(order):
        for b in range(order):
            expected = [kernel(order, np.array([h]), np.array([h]), a, b)[0, 0] for h in (0.7, 1.6, 2.3)]
            np.testing.assert_allclose(noise[:, a, b], expected, rtol=1e-12)
    np.testing.assert_allclose(forward[1] @ forward[0], forward[2], rtol=1e-12)
    np.testing.assert_allclose(forward[1] @ noise[0] @ forward[1].T + noise[1], noise[2], rtol=1e-12)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("density", [1e-4, 0.05, 1.0])
def test_posterior_equals_dense_algebra(order, density):
    time, points, noise = some_points()
    path = fit_wiener_path(time, points, noise, order=order, density=density)
    dense = dense_of(time, points, noise, order, density)
    np.testing.assert_allclose(path.state, dense.mean, rtol=1e-6, atol=1e-6)
    scale = np.sqrt(np.abs(np.einsum("kkii->ki", dense.covariance)))
    for k in range(len(time)):
        unit = np.outer(scale[k], scale[k])
        np.testing.assert_allclose(path.covariance[k] / unit, dense.covariance[k, k] / unit, atol=2e-5)
    for k in range(len(time) - 1):
        unit = np.outer(scale[k + 1], scale[k])
        np.testing.assert_allclose(path.cross[k] / unit, dense.covariance[k + 1, k] / unit, atol=2e-5)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("density", [1e-3, 0.5])
def test_the_curve_between_points_equals_dense_algebra(order, density):
    time, points, noise = some_points(1)
    path = fit_wiener_path(time, points, noise, order=order, density=density)
    asked = np.concatenate([time, np.linspace(time[0], time[-1], 37)])
    dense = dense_of(time, points, noise, order, density, asked)
    mean, variance = path.at(asked)
    np.testing.assert_allclose(mean, dense.mean[:, 0], atol=1e-7)
    expected = np.einsum("kkii->ki", dense.covariance)[:, 0]
    np.testing.assert_allclose(variance, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
def test_the_density_has_the_greatest_dense_evidence(order):
    time, points, noise = some_points(2, n=14)
    found = fit_wiener_path(time, points, noise, order=order).density

    def cost(x):
        return -dense_of(time, points, noise, order, np.exp(x)).log_evidence(2)

    best = minimize_scalar(cost, bounds=(np.log(found) - 4, np.log(found) + 4), method="bounded")
    assert np.log(found) == pytest.approx(best.x, abs=0.05)
    assert cost(np.log(found)) <= best.fun + 1e-3


@pytest.mark.parametrize("order", ORDERS)
def test_deleted_distance_is_that_of_points_really_left_out(order):
    """The prior of the derivatives at the start depends on all points; it is broad enough not to matter."""
    time, points, noise = some_points(3, n=10)
    density = 0.4
    path = fit_wiener_path(time, points, noise, order=order, density=density)
    found = path.deleted_distance(points, noise)
    unit = np.median(np.diff(time))
    scaled, extent = (time - time[0]) / unit, extent_of(points, noise)
    for k in range(1, len(time) - 1):  # the first carries the start of the process
        rest = np.arange(len(time)) != k
        dense = Dense(
            scaled[rest], (points - points.mean(0))[rest], noise[rest], order, extent, density, scaled
        )
        missed = points[k] - points.mean(0) - dense.mean[k, 0]
        expected = (missed**2).mean() / (noise[k] + dense.covariance[k, k, 0, 0])
        assert found[k] == pytest.approx(expected, rel=1e-5)


def test_a_gap_cuts_the_curve_and_its_sides_know_nothing_of_each_other():
    time, points, noise = some_points(4, n=12)
    time[6:] += 100.0
    path = fit_wiener_path(time, points, noise, max_gap=20.0, density=0.3)
    assert path.joined.sum() == 10 and not path.joined[5]
    asked = np.linspace(time[0] - 5, time[-1] + 5, 500)
    mean, variance = path.at(asked)
    inside = ((asked >= time[0]) & (asked <= time[5])) | ((asked >= time[6]) & (asked <= time[-1]))
    np.testing.assert_array_equal(np.isfinite(variance), inside)
    np.testing.assert_array_equal(np.isfinite(mean).all(1), inside)
    unit = np.median(np.diff(time))
    for part in (slice(0, 6), slice(6, 12)):  # the middle and the extent are common
        alone = Dense(
            (time[part] - time[part][0]) / unit,
            points[part] - points.mean(0),
            noise[part],
            3,
            extent_of(points, noise),
            0.3,
        )
        alone.mean[:, 0] += points.mean(0)
        np.testing.assert_allclose(path.state[part], alone.mean, rtol=1e-6, atol=1e-6)
        expected = np.einsum("kkij->kij", alone.covariance)
        np.testing.assert_allclose(path.covariance[part], expected, rtol=1e-5, atol=1e-9)
    assert np.isfinite(path.at(time)[0]).all()  # the ends of the gap themselves are known


def test_one_two_and_three_points():
    one = fit_wiener_path(np.array([4.0]), np.array([[1.0, 2.0]]), np.array([0.09]))
    mean, variance = one.at(np.array([3.0, 4.0, 5.0]))
    np.testing.assert_allclose(mean, [[np.nan] * 2, [1.0, 2.0], [np.nan] * 2])
    np.testing.assert_allclose(variance, [np.nan, 0.09, np.nan])
    two = fit_wiener_path(np.array([0.0, 10.0]), np.array([[0.0], [5.0]]), np.array([1e-4, 1e-4]))
    mean, variance = two.at(np.array([0.0, 5.0, 10.0, 11.0]))
    np.testing.assert_allclose(mean[:3, 0], [0.0, 2.5, 5.0], atol=1e-3)
    assert (variance[:3] > 0).all() and np.isnan(mean[3]).all() and variance[1] > variance[0]
    time = np.array([0.0, 4.0, 9.0])
    three = fit_wiener_path(time, time[:, None] ** 2 / 10, np.full(3, 1e-6))
    mean, variance = three.at(time)
    np.testing.assert_allclose(mean[:, 0], time**2 / 10, atol=0.01)
    assert np.isfinite(three.covariance).all() and (variance > 0).all()


@pytest.mark.parametrize(("order", "density"), [(1, 0.05), (2, 0.02), (3, 1e-3)])
def test_the_density_of_simulated_paths_is_found(order, density):
    rng = np.random.default_rng(5)
    time = np.arange(200.0)
    ratios = []
    for _ in range(6):
        true = draw(time, order, density, 3, rng)[:, 0]
        path = fit_wiener_path(
            time, true + 0.3 * rng.normal(size=true.shape), np.full(200, 0.09), order=order
        )
        ratios.append(path.density / density)
    assert min(ratios) > 0.5 and max(ratios) < 2.0
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize("order", ORDERS)
def test_errors_of_simulated_paths_are_as_large_as_they_say(order):
    rng = np.random.default_rng(6)
    time = np.arange(0.0, 121.0)
    keys = np.flatnonzero(rng.random(121) < 0.3)
    scores = []
    for _ in range(25):
        true = draw(time, order, 0.1, 3, rng, start=0.2)[:, 0]
        noise = rng.uniform(0.01, 0.2, len(keys))
        seen = true[keys] + np.sqrt(noise)[:, None] * rng.normal(size=(len(keys), 3))
        path = fit_wiener_path(time[keys], seen, noise, order=order)
        mean, variance = path.at(time)
        there = np.isfinite(variance)
        scores.append(((mean - true)[there] ** 2 / variance[there, None]).mean())
    assert np.mean(scores) == pytest.approx(1.0, abs=0.12)


def test_turning_and_scaling_the_points_turns_and_scales_the_curve():
    rng = np.random.default_rng(7)
    time, _, noise = some_points(7, n=15)
    points = np.cumsum(rng.normal(size=(15, 3)), axis=0)
    path = fit_wiener_path(time, points, noise)
    turn, scale, shift = Rotation.random(random_state=1).as_matrix(), 250.0, np.array([1e4, -300.0, 7.0])
    moved = fit_wiener_path(time, scale * points @ turn.T + shift, scale**2 * noise)
    assert moved.density == pytest.approx(scale**2 * path.density, rel=1e-6)
    asked = np.linspace(time[0], time[-1], 50)
    (a, b), (mean, variance) = moved.at(asked), path.at(asked)
    np.testing.assert_allclose(a, scale * mean @ turn.T + shift, rtol=0, atol=1e-6 * scale)
    np.testing.assert_allclose(b, scale**2 * variance, rtol=1e-6)
    late = fit_wiener_path(30.0 * time - 1000.0, points, noise)
    np.testing.assert_allclose(late.at(30.0 * asked - 1000.0)[0], mean, atol=1e-6)


def test_a_polynomial_without_noise_goes_through():
    """Cubics to numerical accuracy: the curve of p = 3 is a quintic spline."""
    time = np.arange(0.0, 80.0, 8.0)

    def cubic(t):
        return np.stack([1 + 0.1 * t, 2e-3 * t**2, 1e-5 * t**3 - 0.02 * t], axis=1)

    path = fit_wiener_path(time, cubic(time), np.full(len(time), 1e-12))
    asked = np.arange(0.0, 72.1, 0.5)
    np.testing.assert_allclose(path.at(asked)[0], cubic(asked), atol=2e-3)
