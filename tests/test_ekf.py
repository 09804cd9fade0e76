"""The Kalman baseline: smoother against dense least squares, gate, rows that are left out, accuracy."""

import numpy as np
import pytest
from conftest import FPS, cameras_about, make_sequence, random_motion

from acino_fte import baseline_ekf
from acino_fte.baseline_ekf import (
    GATE,
    Measurement,
    compress,
    constant_acceleration,
    estimate_ekf,
    inside_gate,
    kalman_smoother,
    misfit,
)
from acino_fte.baseline_tri import marker_sd
from acino_fte.initialise import initial_trajectory
from acino_fte.problem import FTEOptions, build_fte
from acino_fte.result import Status
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.solve import solve_fte

N = 30


@pytest.fixture(scope="module")
def recording(lizard):
    """Thirty frames that four cameras saw, with the noise that the species file says, and a start."""
    q = random_motion(lizard.skeleton, 2 * N, 1)[:N]
    sequence = recorded(lizard, q, cameras_about())
    return sequence, q, initial_trajectory(sequence, lizard)


def recorded(kinematics, q, cameras, seed=0):
    """What cameras saw, each marker with its own ``sd_px``."""
    pixels = cameras.project(kinematics.positions(q))
    noise = np.random.default_rng(seed).normal(size=pixels.shape)
    return make_sequence(
        kinematics, q, cameras, pixels=pixels + noise * marker_sd(kinematics.skeleton)[:, None]
    )


def with_pixels(sequence, change):
    """The sequence after ``change`` of a copy of its pixels (N, C, M, 2) and likelihoods (N, C, M)."""
    from dataclasses import replace

    detections = sequence.detections.copy(deep=True)
    change(detections.position.values, detections.likelihood.values)
    return replace(sequence, detections=detections)


# --- the linear smoother -----------------------------------------------------------------------------


def dense_smoother(transition, noise_gain, measurements, mean, covariance):
    """Means (N, D) and covariances (N, D, D) from one least squares problem over x_0 and all w.

    x_n = F x_{n−1} + G w_n with w ~ N(0, 1): every state is A_n u, u = (x_0, w_1, …).
    """
    size, width = noise_gain.shape
    n_frames = len(measurements)
    maps = [np.eye(size, size + (n_frames - 1) * width)]
    for n in range(1, n_frames):
        step = transition @ maps[-1]
        step[:, size + (n - 1) * width : size + n * width] += noise_gain
        maps.append(step)
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    rows, values = [root @ maps[0]], [root @ mean]
    rows.append(np.eye(size + (n_frames - 1) * width)[size:])
    values.append(np.zeros((n_frames - 1) * width))
    for matrix, (h, variance, z) in zip(maps, measurements, strict=True):
        rows.append(h @ matrix / np.sqrt(variance)[:, None])
        values.append(z / np.sqrt(variance))
    orthogonal, triangle = np.linalg.qr(np.concatenate(rows))
    inverse = np.linalg.inv(triangle)
    u = inverse @ (orthogonal.T @ np.concatenate(values))
    roots = [a @ inverse for a in maps]
    return np.array([a @ u for a in maps]), np.array([r @ r.T for r in roots])


def random_measurements(rng, n_frames, size, columns):
    """Zero to nine rows a frame on the first columns of the state."""
    found = []
    for count in rng.integers(0, 10, n_frames):
        matrix = np.zeros((count, size))
        matrix[:, :columns] = rng.normal(size=(count, columns))
        found.append(Measurement(matrix, rng.uniform(0.1, 2.0, count), rng.normal(size=count)))
    return found


@pytest.mark.parametrize("n_frames", [1, 2, 150])
def test_smoother_is_the_dense_least_squares_solution(n_frames):
    """Random dynamics; 150 frames are more than one block of the smoother."""
    rng = np.random.default_rng(n_frames)
    size = 3
    transition = np.eye(size) + 0.2 * rng.normal(size=(size, size)) / np.sqrt(size)
    transition /= max(1.0, np.abs(np.linalg.eigvals(transition)).max())
    gain = rng.normal(size=(size, size))
    measurements = random_measurements(rng, n_frames, size, size)
    mean, covariance = rng.normal(size=size), np.diag([4.0, 1.0, 9.0])
    found = kalman_smoother(
        n_frames, transition, gain @ gain.T, lambda n, *_: measurements[n], mean, covariance
    )
    means, covariances = dense_smoother(transition, gain, measurements, mean, covariance)
    np.testing.assert_allclose(found.mean, means, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.covariance, covariances, rtol=0, atol=1e-9)


def test_smoother_with_the_motion_model():
    """The process noise of constant acceleration is singular: three states, one noise."""
    rng = np.random.default_rng(0)
    noise = np.array([0.3, 0.7])
    transition, process = constant_acceleration(noise)
    measurements = random_measurements(rng, 25, 6, 2)
    measurements[0] = random_measurements(rng, 1, 6, 0)[0]  # a first frame that nothing was seen in
    mean, covariance = rng.normal(size=6), np.diag(rng.uniform(0.5, 2.0, 6))
    found = kalman_smoother(25, transition, process, lambda n, *_: measurements[n], mean, covariance)
    gain = np.tile(np.diag(noise), (3, 1))
    means, covariances = dense_smoother(transition, gain, measurements, mean, covariance)
    np.testing.assert_allclose(found.mean, means, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.covariance, covariances, rtol=0, atol=1e-9)


def test_motion_model_is_backward_euler():
    rng = np.random.default_rng(1)
    dt, noise = 0.01, np.array([3.0, 5.0])
    transition, process = constant_acceleration(noise * dt**2)
    q, dq, ddq, w = rng.normal(size=(4, 2))
    after = transition @ np.concatenate([q, dt * dq, dt**2 * ddq]) + np.tile(dt**2 * w, 3)
    ddq = ddq + w
    dq = dq + dt * ddq
    q = q + dt * dq
    np.testing.assert_allclose(after, np.concatenate([q, dt * dq, dt**2 * ddq]), rtol=1e-13)
    gain = np.tile(np.diag(noise * dt**2), (3, 1))
    np.testing.assert_allclose(process, gain @ gain.T, rtol=1e-13)


def test_compressed_measurement_says_the_same():
    rng = np.random.default_rng(2)
    full = random_measurements(rng, 1, 7, 0)[0]
    matrix = np.zeros((40, 7))
    matrix[:, [1, 4, 6]] = rng.normal(size=(40, 3))
    full = Measurement(matrix, rng.uniform(0.5, 2.0, 40), rng.normal(size=40))
    short = compress(full)
    assert len(short.value) == 3
    for m in (full, short):
        weighted = m.matrix.T / m.variance
        information, pull = weighted @ m.matrix, weighted @ m.value
        if m is full:
            expected = information, pull
    np.testing.assert_allclose(information, expected[0], atol=1e-12)
    np.testing.assert_allclose(pull, expected[1], atol=1e-12)


# --- the gate ----------------------------------------------------------------------------------------


def test_gate_passes_what_its_covariance_says():
    rng = np.random.default_rng(3)
    count, sd = 20000, 1.5
    slope = rng.normal(size=(2, 4))
    root = rng.normal(size=(4, 4))
    covariance = root @ root.T
    residual = rng.normal(size=(count, 4)) @ root.T @ slope.T + sd * rng.normal(size=(count, 2))
    good = inside_gate(np.broadcast_to(slope, (count, 2, 4)), residual, np.full(count, sd), covariance)
    assert good.mean() == pytest.approx(0.99, abs=0.003)
    assert pytest.approx(9.21034, abs=1e-5) == GATE


def test_outlier_leaves_no_trace(lizard, recording):
    """1000 px off, or never detected: the same trajectory and covariance to the last bit."""
    sequence, _, start = recording

    def spoil(position, _):
        position[10, 2, 3] += 1000.0

    def remove(_, likelihood):
        likelihood[10, 2, 3] = 0.0

    spoilt = estimate_ekf(with_pixels(sequence, spoil), lizard, start=start)
    without = estimate_ekf(with_pixels(sequence, remove), lizard, start=start)
    for name in ("q", "dq", "ddq", "positions", "q_sd", "position_covariance"):
        np.testing.assert_array_equal(getattr(spoilt, name), getattr(without, name))
    assert not np.array_equal(spoilt.q, estimate_ekf(sequence, lizard, start=start).q)


def test_marker_behind_its_camera_is_left_out(lizard, recording):
    """A camera that looks away cannot have seen the animal, whatever its file says."""
    from dataclasses import replace

    from acino_fte.cameras import CameraArray

    sequence, q, start = recording
    turned = [*sequence.cameras]
    about = np.diag([-1.0, 1.0, -1.0])
    turned[1] = replace(
        turned[1], rotation=about @ turned[1].rotation, translation=about @ turned[1].translation
    )
    away = replace(sequence, cameras=CameraArray(tuple(turned)))

    def remove(_, likelihood):
        likelihood[:, 1] = 0.0

    found = estimate_ekf(away, lizard, start=start)
    without = estimate_ekf(with_pixels(away, remove), lizard, start=start)
    np.testing.assert_array_equal(found.q, without.q)
    assert np.isnan(found.reprojected[:, 1]).all()


def test_noise_grows_with_the_misfit():
    rng = np.random.default_rng(4)
    sd = np.array([2.0, 5.0])
    residuals = rng.normal(size=(300, 4, 2, 2)) * sd[:, None]
    residuals[:20] = np.nan
    residuals[20:50] += 500.0
    assert misfit(0.3 * residuals, sd) == 1.0
    assert misfit(4.0 * residuals, sd) == pytest.approx(4.0, rel=0.15)
    assert misfit(np.full((2, 1, 2, 2), np.nan), sd) == 1.0


def test_skeleton_that_does_not_fit(lizard, recording):
    """Detections with four times the noise: nearly all are kept, and the result says so."""
    sequence, q, _ = recording
    pixels = sequence.cameras.project(lizard.positions(q))
    noisy = with_pixels(sequence, lambda position, _: np.copyto(position, pixels + 4.0 * (position - pixels)))
    found = estimate_ekf(noisy, lizard)
    noise = np.array(list(found.parameters["noise_px"].values()))
    np.testing.assert_allclose(noise / marker_sd(lizard.skeleton), 4.0, rtol=0.1)
    assert list(found.parameters["noise_px"]) == lizard.skeleton.marker_names
    assert found.status is Status.CONVERGED
    assert len(found.findings) == 2


def test_lost_animal_is_no_success(lizard, recording, monkeypatch):
    """A start five metres away, with a gate that believes in sd_px: nothing passes."""
    sequence, _, start = recording
    monkeypatch.setattr(baseline_ekf, "misfit", lambda *_: 1.0)
    found = estimate_ekf(sequence, lizard, start=start + 5.0 * np.eye(start.shape[1])[2])
    assert found.status is Status.DIVERGED


# --- the result --------------------------------------------------------------------------------------


def test_result_is_complete(lizard, recording):
    sequence, _, start = recording
    calls = []
    found = estimate_ekf(sequence, lizard, progress=lambda *a: calls.append(a), seconds={"load": 1.5})
    n, m = N, lizard.n_markers
    assert found.method == "ekf"
    assert found.status is Status.CONVERGED
    assert found.iterations == len(calls) == baseline_ekf.PASSES
    assert found.objective == calls[-1][1]
    assert set(found.seconds) == {"load", "initialise", "solve"}
    assert found.options["problem"]["likelihood"] == 0.5
    assert found.q.shape == found.dq.shape == found.ddq.shape == found.q_sd.shape == (n, lizard.n_dofs)
    assert found.position_covariance.shape == (n, m, 3, 3)
    np.testing.assert_allclose(found.positions, lizard.positions(found.q), atol=1e-12)
    np.testing.assert_allclose(found.dq[1:], np.diff(found.q, axis=0) * FPS, atol=1e-9)
    np.testing.assert_allclose(found.ddq[1:], np.diff(found.dq, axis=0) * FPS, atol=1e-7)
    assert found.parameters == {}
    other = solve_fte(build_fte(sequence, lizard), start)
    assert found.objective == pytest.approx(other.objective, rel=0.02)
    assert found.objective >= other.objective


def test_covariance_is_calibrated(lizard):
    """Squared Mahalanobis distance of the true positions: three on average."""
    distances = []
    for seed in range(4):
        q = random_motion(lizard.skeleton, 2 * N, seed)[:N]
        found = estimate_ekf(recorded(lizard, q, cameras_about(), seed), lizard)
        error = found.positions - lizard.positions(q)
        distances.append(
            (error * np.linalg.solve(found.position_covariance, error[..., None])[..., 0]).sum(-1)
        )
        assert np.abs(found.q - q).max() < 6 * found.q_sd.max()
    assert 2.0 < np.mean(distances) < 4.0


def test_frame_without_detection_is_bridged(lizard, recording):
    sequence, q, _ = recording

    def blind(_, likelihood):
        likelihood[12:16] = 0.0
        likelihood[:2] = 0.0

    found = estimate_ekf(with_pixels(sequence, blind), lizard)
    error = np.linalg.norm(found.positions - lizard.positions(q), axis=-1)
    assert np.isfinite(found.q).all()
    assert np.isnan(found.observed[13]).all()
    assert error[12:16].max() < 0.1
    sd = found.q_sd.mean(1)
    assert sd[13] > 1.3 * sd[8]
    assert sd[0] > 1.3 * sd[8]


def test_ranges_are_kept(lizard, recording):
    """A tail that was filmed beyond its range ends at its limit."""
    _, q, _ = recording
    limit = lizard.skeleton.dofs[5].upper
    beyond = q.copy()
    beyond[:, 5] = limit + 0.3
    found = estimate_ekf(recorded(lizard, beyond, cameras_about()), lizard)
    lower = [d.lower for d in lizard.skeleton.dofs]
    upper = [d.upper for d in lizard.skeleton.dofs]
    assert ((found.q >= lower) & (found.q <= upper)).all()
    assert (found.q[:, 5] == limit).mean() > 0.8


def test_moving_camera(lizard):
    q = random_motion(lizard.skeleton, 2 * N, 5)[:N]
    found = estimate_ekf(recorded(lizard, q, cameras_about(N, moving=True)), lizard)
    error = np.linalg.norm(found.positions - lizard.positions(q), axis=-1)
    assert error.mean() < 0.01


@pytest.mark.parametrize("n_frames", [1, 2, 4])
def test_few_frames(lizard, n_frames):
    q = random_motion(lizard.skeleton, 2 * N, 1)[:n_frames]
    found = estimate_ekf(recorded(lizard, q, cameras_about()), lizard)
    assert found.q.shape == found.ddq.shape == q.shape
    assert np.linalg.norm(found.positions - lizard.positions(q), axis=-1).mean() < 0.05


def test_without_prior_and_with_other_noise(lizard, recording):
    sequence, q, start = recording
    found = estimate_ekf(sequence, lizard, FTEOptions(prior_width=0.0, noise_scale=3.0), start=start)
    usual = estimate_ekf(sequence, lizard, start=start)
    assert found.q_sd.mean() > usual.q_sd.mean()
    assert np.abs(found.q - q).mean() < 0.05


def test_accuracy_beside_the_trajectory_problem(cheetah):
    """A simulated gallop with dropouts and gross errors: within twice the error of the full problem."""
    options = SimulationOptions(n_frames=48, radius=6.0, occlusion=False, outliers=0.05, missing=0.2, seed=3)
    sequence = simulation_to_sequence(simulate(cheetah.skeleton, options))
    start = initial_trajectory(sequence, cheetah)
    errors = [
        np.linalg.norm(result.positions - sequence.truth.values, axis=-1).mean()
        for result in (
            estimate_ekf(sequence, cheetah, start=start),
            solve_fte(build_fte(sequence, cheetah), start),
        )
    ]
    assert errors[0] < 0.010
    assert errors[0] < 2.0 * errors[1]
