"""Attitude from inertial sensors: integration, bias, gravity, and uncertainties that are true."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from acino_fte.data_tools.imu import METHODS, ImuNoise, growth, gyro_attitude, integrate_rates, seconds
from acino_fte.data_tools.imu_filter import gravity_attitude
from acino_fte.data_tools.imu_rest import bias_from_rest, levelled
from acino_fte.data_tools.recording import GRAVITY, ImuSamples
from acino_fte.data_tools.rotations import rotation_matrix, rotation_vector
from acino_fte.errors import InputError
from acino_fte.rig_options import RigOptions
from acino_fte.simulate_rig import simulate_rig

NOISE = ImuNoise(scale_sd=0.0, force_bias_sd=0.05, sway=0.0)  # of `simulated`, whose body sways when asked to


def transposed(matrix):
    return np.swapaxes(matrix, -1, -2)


def angle(a, b):
    """Degrees between rotations."""
    return np.degrees(np.linalg.norm(rotation_vector(a @ transposed(b)), axis=-1))


def coning(time):
    """Attitude of a sensor whose axis swings on a cone as it spins, and its rate: in closed form."""
    spin = rotation_matrix(np.outer(2.0 * time, [0, 0, 1.0]))
    tilt = rotation_matrix(np.outer(0.5 * np.sin(3.0 * time), [0, 1.0, 0]))
    rate = np.einsum("kji,j->ki", tilt, [0, 0, 2.0]) + np.outer(1.5 * np.cos(3.0 * time), [0, 1.0, 0])
    return spin @ tilt, rate


def pan_tilt(time, rest=5.0):
    """A camera that rests, then pans and tilts for good: attitude (z up) and its rate in its own frame."""
    t = np.maximum(time - rest, 0.0)
    ease, slope = 1 - np.exp(-t), np.exp(-t)
    pan, pan_rate = 0.8 * np.sin(0.5 * t) * ease, 0.4 * np.cos(0.5 * t) * ease + 0.8 * np.sin(0.5 * t) * slope
    tilt = 0.3 * np.sin(0.9 * t) * ease
    tilt_rate = 0.27 * np.cos(0.9 * t) * ease + 0.3 * np.sin(0.9 * t) * slope
    on = (time > rest)[:, None]
    turn = rotation_matrix(np.outer(tilt, [0, 1.0, 0]))
    rate = np.einsum("kji,j->ki", turn, [0, 0, 1.0]) * pan_rate[:, None] + np.outer(tilt_rate, [0, 1.0, 0])
    return rotation_matrix(np.outer(pan, [0, 0, 1.0])) @ turn, rate * on


def simulated(seed, duration=65.0, hertz=100.0, noise=NOISE, rest=5.0, sway=0.0):
    """Samples of a sensor with errors as the noise says, and the true attitude."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, duration, 1 / hertz)
    attitude, rate = pan_tilt(time, rest)
    step = 1 / hertz
    bias = rng.normal(0, noise.bias_sd, 3) + np.cumsum(
        rng.normal(0, noise.bias_walk * np.sqrt(step), (len(time), 3)), axis=0
    )
    scale = 1 + rng.normal(0, noise.scale_sd, 3)
    felt = rate * scale + bias + rng.normal(0, noise.rate_density / np.sqrt(step), rate.shape)
    swing = sway * np.cos(7 * time)[:, None] * [1.0, 0.4, 0.2] * (time > rest)[:, None]
    force = np.einsum("kji,kj->ki", attitude, [0, 0, GRAVITY] + swing) + rng.normal(0, noise.force_bias_sd, 3)
    force += rng.normal(0, noise.force_density / np.sqrt(step), rate.shape)
    return ImuSamples(np.round(time * 1e9).astype(np.int64) + 10**15, felt, force), attitude


@pytest.mark.parametrize(("method", "order"), [("first", 1), ("midpoint", 2), ("simpson", 4)])
def test_order_of_convergence(method, order):
    errors = []
    for n in (400, 800):
        time = np.linspace(0, 4, n + 1)
        attitude, rate = coning(time)
        errors.append(angle(integrate_rates(time, rate, start=attitude[0], method=method)[-1], attitude[-1]))
    assert np.log2(errors[0] / errors[1]) > order - 0.25
    assert errors[1] < {"first": 1.0, "midpoint": 5e-3, "simpson": 1e-6}[method]


def test_uneven_stamps_lose_little():
    time = np.linspace(0, 4, 801)
    time[1:-1] += np.random.default_rng(0).uniform(-0.3, 0.3, 799) * time[1]
    attitude, rate = coning(time)
    assert angle(integrate_rates(time, rate, start=attitude[0])[-1], attitude[-1]) < 1e-5


def test_rates_that_are_means():
    time = np.linspace(0, 4, 401)
    fine = np.linspace(0, 4, 40 * 400 + 1)
    attitude, rate = coning(fine)
    total = cumulative_trapezoid(rate, fine, axis=0, initial=0)[::40]
    mean = np.vstack([rate[:1], np.diff(total, axis=0) / 0.01])
    start, end = attitude[0], attitude[::40]
    errors = {m: angle(integrate_rates(time, mean, start=start, method=m), end).max() for m in METHODS}
    assert errors["mean"] < 0.005 < 0.3 < errors["simpson"]  # half a step late: 0.01 s/2 at 2.5 rad/s is 0.7°


def test_the_thesis_integrates_axes_apart():
    """Its eq. 4.19 multiplies turns by ∫ω_x, ∫ω_y, ∫ω_z, with a zero in R_y where a one belongs."""
    time = np.linspace(0, 4, 401)
    pan, tilt = np.radians(100) * np.sin(np.pi * time / 4) ** 2, np.radians(45) * np.sin(np.pi * time / 8)
    true = rotation_matrix(np.outer(pan, [0, 0, 1.0])) @ rotation_matrix(np.outer(tilt, [0, 1.0, 0]))
    rate = rotation_vector(transposed(true[:-1]) @ true[1:]) / 0.01  # held over each step: "first" is exact
    rate = np.vstack([rate, rate[-1:]])
    x, y, z = (cumulative_trapezoid(rate[:, i], time, initial=0) for i in range(3))
    turn_z, turn_x = rotation_matrix(np.outer(z, [0, 0, 1.0])), rotation_matrix(np.outer(x, [1.0, 0, 0]))
    turn_y = rotation_matrix(np.outer(y, [0, 1.0, 0]))
    mended = angle(turn_z @ turn_y @ turn_x, true).max()
    turn_y[:, 1, 1] = 0.0
    printed = turn_z @ turn_y @ turn_x
    assert np.abs(np.linalg.det(printed)).max() < 1e-12  # no rotation at all
    ours = {"first": angle(integrate_rates(time, rate, method="first"), true).max()}
    slopes = (
        np.radians(25) * np.pi * np.sin(np.pi * time / 2),
        np.radians(45 / 8) * np.pi * np.cos(np.pi * time / 8),
    )
    level = np.einsum("kji,j->ki", rotation_matrix(np.outer(tilt, [0, 1.0, 0])), [0, 0, 1.0])
    smooth = time, level * slopes[0][:, None] + np.outer(slopes[1], [0, 1.0, 0])
    assert 24 < mended < 28 and ours["first"] < 1e-6
    assert angle(integrate_rates(*smooth), true).max() < 1e-4


def test_bias_from_rest_and_a_minute_after():
    rig = ImuNoise(rate_density=0.0015 / np.sqrt(200), bias_walk=0.0, scale_sd=0.0)  # the simulated rig's
    worst = []
    for seed in range(4):
        samples, attitude = simulated(seed, hertz=200.0, noise=rig)
        rest = bias_from_rest(samples)
        time = seconds(samples)
        assert 4.0 < rest.duration < 5.5 and time[rest.start] < 0.5
        found = gyro_attitude(
            samples, bias=rest.bias, bias_covariance=rest.bias_covariance, start=attitude[0]
        )
        worst.append(angle(found.rotation, attitude).max())
        assert gyro_attitude(samples, start=attitude[0]).notes
    assert max(worst) <= 0.5  # the reach: bias from 5 s of rest, 60 s after
    assert angle(gyro_attitude(samples, start=attitude[0]).rotation, attitude).max() > 5


def on_a_rig(seed, **options):
    """Samples of the simulated rig's sensor, its true attitude, and where in its frame the camera looks."""
    simulation = simulate_rig(RigOptions(lidar="none", bushes=0, seed=seed, **options))
    turned = transposed(simulation.path.rotation(simulation.imu.time_ns * 1e-9))
    mount = simulation.lidar_to_camera[0]
    return simulation.imu, turned @ mount, mount[2]


@pytest.mark.parametrize("seed", range(4))
def test_a_minute_of_a_panning_camera(seed):
    """The issue's reach on the simulated rig: by the rates alone, and levelled by a biased accelerometer."""
    samples, truth, forward = on_a_rig(seed, n_frames=120, fps=2.0, distance=20.0)
    rest = bias_from_rest(samples)
    assert 4.5 < rest.duration < 5.1
    alone = gyro_attitude(samples, bias=rest.bias, bias_covariance=rest.bias_covariance, start=truth[0])
    helped = gravity_attitude(samples, forward=forward)
    apart = truth[0] @ helped.rotation[0].T
    heading = np.arctan2(apart[1, 0] - apart[0, 1], apart[0, 0] + apart[1, 1])
    assert samples.time_ns[-1] > 59e9
    assert angle(alone.rotation, truth).max() <= 0.5
    turn = rotation_matrix(np.array([0.0, 0.0, heading]))  # the heading of the world is a convention
    assert angle(turn @ helped.rotation, truth).max() <= 0.5


@pytest.mark.parametrize("seed", range(3))
def test_a_swing_is_no_tilt(seed):
    """A sensor beside the axis of the pan is pushed by 0.1 m/s², which is 0.6° of tilt to a filter."""
    samples, truth, forward = on_a_rig(seed)
    found = gravity_attitude(samples, forward=forward).rotation
    turned, true = transposed(found) @ found[0], transposed(truth) @ truth[0]
    assert angle(turned, true).max() < 0.25


def test_bias_covariance_is_true():
    """Over many rests the error of the bias is as large as it says, also of noise that wanders."""
    rng = np.random.default_rng(5)
    time_ns = (np.arange(500) * 1e7).astype(np.int64)
    up = np.tile([0, 0, GRAVITY], (500, 1))
    for smooth in (1, 8):
        ratios = []
        for _ in range(60):
            white = rng.normal(0, 2e-3, (3, 499 + smooth))
            noise = np.stack([np.convolve(w, np.ones(smooth) / smooth, "valid") for w in white], 1)
            rest = bias_from_rest(ImuSamples(time_ns, noise + 0.01, up))
            ratios.append((rest.bias - 0.01) ** 2 / np.diag(rest.bias_covariance))
        assert 0.6 < np.mean(ratios) < 1.4


def test_no_rest_is_said():
    samples, _ = simulated(1, rest=0.0, duration=10)
    with pytest.raises(InputError, match="never rests"):
        bias_from_rest(samples)
    assert any("never rests" in note for note in gravity_attitude(samples).notes)


def test_levelled():
    force = rotation_matrix(np.array([0.3, -0.2, 0.1])).T @ [0, 0, 9.7]
    rotation, covariance = levelled(force, forward=np.array([0.0, 0, 1]), force_sd=0.1)
    np.testing.assert_allclose(rotation @ force, [0, 0, 9.7], atol=1e-12)
    assert (rotation @ [0, 0, 1.0])[1] == pytest.approx(0, abs=1e-12) and np.linalg.det(rotation) > 0
    assert covariance[2, 2] == 0 and np.sqrt(covariance[0, 0]) == pytest.approx(0.1 / GRAVITY)
    with pytest.raises(InputError):
        levelled(np.zeros(3))


def nees(found, truth, rows, axes=slice(None)):
    turn = rotation_vector(truth[rows] @ transposed(found.rotation[rows]))[:, axes]
    parts = found.covariance[rows][:, axes, axes]
    return np.mean([e @ np.linalg.solve(c, e) / len(e) for e, c in zip(turn, parts, strict=True)])


def test_growth_of_the_covariance():
    """Errors of 40 sensors over their covariance: one on the average, at every time."""
    noise = ImuNoise(bias_sd=1e-3, bias_walk=1e-4, scale_sd=0.01, rate_density=1e-3)
    rows, values = np.array([200, 600, 1499]), []
    for seed in range(40):
        samples, truth = simulated(seed, duration=15, noise=noise, rest=1.0)
        found = gyro_attitude(
            samples,
            bias=np.zeros(3),
            bias_covariance=noise.bias_sd**2 * np.eye(3),
            start=truth[0],
            noise=noise,
        )
        values.append([nees(found, truth, rows[i : i + 1]) for i in range(3)])
    assert ((np.mean(values, 0) > 0.7) & (np.mean(values, 0) < 1.35)).all()


def test_growth_without_errors_is_nothing():
    time = np.linspace(0, 1, 11)
    attitude, rate = coning(time)
    clean = ImuNoise(rate_density=0, bias_walk=0, scale_sd=0)
    np.testing.assert_allclose(growth(time, attitude, rate, clean, np.zeros((3, 3))), 0, atol=1e-18)


def test_gravity_holds_the_tilt_and_says_how_well():
    """Without rest, with a bias of 0.6°/s: the tilt stays, the heading drifts, and both say by how much."""
    both, tilt = [], []
    rows = np.array([500, 1000, 1999])
    for seed in range(12):
        samples, truth = simulated(seed, duration=20, rest=0.0)
        found = gravity_attitude(samples, noise=NOISE)
        apart = truth[0] @ transposed(found.rotation[0])
        turn = rotation_matrix(np.array([0, 0, np.arctan2(apart[1, 0], apart[0, 0])]))
        truth = transposed(turn) @ truth  # the heading of the world is a convention
        both.append([nees(found, truth, rows), nees(found, truth, rows, slice(0, 2))])
        up = np.degrees(np.arccos(np.clip((found.rotation[:, 2] * truth[:, 2]).sum(1), -1, 1)))
        tilt.append(up[500:].max())
    assert max(tilt) < 0.5
    # a little too careful: the noise of a block is read off the axis of the force that varies most
    assert ((np.mean(both, 0) > 0.45) & (np.mean(both, 0) < 1.35)).all()
    sd = np.sqrt(found.covariance[-1].diagonal())
    assert sd[2] > 2 * sd[:2].max()  # the heading is the unsure one


def test_swaying_does_not_mislead():
    samples, truth = simulated(3, sway=1.5, duration=40)
    found = gravity_attitude(samples, noise=NOISE)
    up = np.degrees(np.arccos(np.clip((found.rotation[:, 2] * truth[:, 2]).sum(1), -1, 1)))
    assert up.max() < 0.6


def test_damaged_samples():
    samples, truth = simulated(2, duration=10)
    time, rate, force = samples.time_ns.copy(), samples.rate.copy(), samples.force.copy()
    rate[700], force[701, 1] = np.nan, np.nan
    time[800] = time[799]
    found = gyro_attitude(ImuSamples(time, rate, force), bias=bias_from_rest(samples).bias, start=truth[0])
    keep = np.delete(np.arange(1000), [700, 701, 800])
    assert angle(found.rotation, truth[keep]).max() < 0.2 and "3 of 1000" in found.notes[0]
    time[500] = time[400]
    with pytest.raises(InputError, match="backwards"):
        gyro_attitude(ImuSamples(time, rate, force))
    with pytest.raises(InputError, match="too few"):
        gyro_attitude(ImuSamples(time[:1], rate[:1], force[:1]))
    with pytest.raises(InputError, match="way to integrate"):
        integrate_rates(np.arange(5.0), np.zeros((5, 3)), method="euler")


def test_a_gap_widens_the_covariance():
    samples, truth = simulated(2, duration=20)
    keep = np.r_[0:1200, 1280:2000]
    cut = ImuSamples(samples.time_ns[keep], samples.rate[keep], samples.force[keep])
    found = gyro_attitude(cut, bias=bias_from_rest(cut).bias, start=truth[0])
    assert any("gap" in note for note in found.notes)
    assert found.sd[1201] > 5 * found.sd[1199]
    assert angle(found.rotation[-1], truth[-1]) < 3 * np.degrees(found.sd[-1] * np.sqrt(3))


def test_against_scipy():
    steps = Rotation.random(20, random_state=1)
    np.testing.assert_allclose(
        rotation_matrix(steps.as_rotvec()) @ np.ones(3), steps.apply(np.ones(3)), atol=1e-12
    )
