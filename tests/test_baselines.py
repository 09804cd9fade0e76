"""The baselines without a skeleton, and the function that chooses between all of them."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import cameras_about, make_sequence, random_motion
from scipy.optimize import approx_fprime, least_squares
from scipy.spatial.transform import Rotation

from acino_fte.baseline_sba import Bundle, correct, estimate_sba, left_jacobian, solve_bundle
from acino_fte.baseline_tri import estimate_tri, marker_sd, point_covariance, robust_cost
from acino_fte.cameras import CameraArray
from acino_fte.errors import InputError
from acino_fte.estimate import EstimateOptions
from acino_fte.losses import DEFAULTS, Loss
from acino_fte.methods import BASELINES, estimate
from acino_fte.parameters import PriorWidths
from acino_fte.problem import FTEOptions
from acino_fte.result import Status
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.triangulate import triangulate

N = 40


@pytest.fixture(scope="module")
def gallop(cheetah):
    """A simulated cheetah: 2 px of noise, dropouts, gross errors; frames 7 and 8 are blank."""
    options = SimulationOptions(n_frames=N, radius=6.0, occlusion=False, outliers=0.05, missing=0.2, seed=2)
    sequence = simulation_to_sequence(simulate(cheetah.skeleton, options))
    sequence.detections.likelihood.values[7:9] = 0.0
    return sequence


@pytest.fixture(scope="module")
def clean(lizard):
    """A lizard before four cameras, every marker with the noise that its ``sd_px`` says, no gross errors."""
    q = random_motion(lizard.skeleton, N, 3)
    pixels = cameras_about().project(lizard.positions(q))
    noise = np.random.default_rng(0).normal(size=pixels.shape) * marker_sd(lizard.skeleton)[:, None]
    return make_sequence(lizard, q, cameras_about(), pixels=pixels + noise)


def truth_errors(result):
    return np.linalg.norm(result.positions - result.sequence.truth.values, axis=-1)


def squared_mahalanobis(result):
    error = result.positions - result.sequence.truth.values
    return (error * np.linalg.solve(result.position_covariance, error[..., None])[..., 0]).sum(-1)


# --- triangulation -----------------------------------------------------------------------------------


def test_tri_on_a_gallop(cheetah, gallop):
    result = estimate_tri(gallop, cheetah.skeleton, seconds={"load": 2.0})
    errors = truth_errors(result)
    known = np.isfinite(errors)
    assert (result.method, result.status) == ("tri", Status.CONVERGED)
    assert result.q.shape == result.dq.shape == result.ddq.shape == (N, 0)
    assert set(result.seconds) == {"load", "solve"}
    assert not known[7:9].any()
    assert known[:7].mean() > 0.9
    assert np.median(errors[known]) < 0.02
    assert np.array_equal(np.isfinite(result.position_covariance).all((-1, -2)), known)
    assert len(result.findings) == 1
    assert result.findings[0].startswith(f"{known.sum()} of {known.size} ")


def test_tri_leaves_out_what_one_camera_saw(lizard, clean):
    detections = clean.detections.copy(deep=True)
    detections.likelihood.values[5, 1:, 2] = 0.0
    result = estimate_tri(replace(clean, detections=detections), lizard.skeleton)
    known = np.isfinite(result.positions).all(-1)
    assert known.sum() == known.size - 1
    assert not known[5, 2]
    assert np.isfinite(result.observed[5, 0, 2]).all()
    assert np.isnan(result.reprojected[5, :, 2]).all()


def test_objective_of_tri(lizard, clean):
    """With a squared loss it is half the sum of squares over the standard deviations."""
    result = estimate_tri(clean, lizard.skeleton, FTEOptions(loss=Loss("squared")))
    scaled = result.residuals / marker_sd(lizard.skeleton)[:, None]
    assert result.objective == pytest.approx(0.5 * np.nansum(scaled**2), rel=1e-12)
    assert result.findings == ()


@pytest.mark.parametrize("method", [estimate_tri, estimate_sba])
def test_covariance_is_calibrated(lizard, clean, method):
    distances = squared_mahalanobis(method(clean, lizard.skeleton))
    assert 2.6 < np.mean(distances) < 3.6


def test_point_covariance_of_a_known_point():
    """Two views along the axes: each coordinate by hand."""
    slope = np.zeros((1, 2, 1, 2, 3))
    slope[0, 0, 0] = [[100.0, 0, 0], [0, 100.0, 0]]
    slope[0, 1, 0] = [[200.0, 0, 0], [0, 0, 50.0]]
    weight = np.ones((1, 2, 1, 2))
    weight[0, 1, 0, 0] = 0.25
    found = point_covariance(slope, weight, np.array([2.0]))[0, 0]
    np.testing.assert_allclose(found, np.diag(4.0 / np.array([100**2 + 0.25 * 200**2, 100**2, 50**2])))
    weight[0, 1] = 0.0
    assert np.isnan(point_covariance(slope, weight, np.array([2.0]))).all()


@pytest.mark.parametrize("method", BASELINES)
def test_nothing_to_triangulate(lizard, clean, method):
    alone = clean.detections.copy(deep=True)
    alone.likelihood.values[:, 1:] = 0.0
    with pytest.raises(InputError, match="two cameras"):
        estimate(method, replace(clean, detections=alone), lizard)


# --- bundle adjustment -------------------------------------------------------------------------------


def small_bundle(kinematics, moving=False, poses=True, loss="cauchy", seed=0):
    """A bundle of four frames with gaps and one gross error, and unknowns away from its start."""
    rng = np.random.default_rng(seed)
    q = random_motion(kinematics.skeleton, 4, seed)
    cameras = cameras_about(4, moving)
    pixels = cameras.project(kinematics.positions(q))
    pixels += rng.normal(0, 2.0, pixels.shape)
    pixels[rng.random(pixels.shape[:3]) < 0.15] = np.nan
    pixels[1, 2, 3] += 60.0
    start = np.concatenate([rng.normal(0, 0.01, (4, 3)), rng.normal(0, 0.03, (4, 3))], axis=1)
    start[0] = 0.0
    found = triangulate(correct(cameras, start), pixels, 60.0)
    sd = marker_sd(kinematics.skeleton)
    bundle = Bundle(cameras, pixels, found, sd, Loss(loss), start if poses else None)
    return bundle, rng.normal(0, 2.0, 3 * bundle.n_points + 6 * bundle.n_free) + 10.0


@pytest.mark.parametrize(("moving", "poses"), [(False, False), (False, True), (True, True)])
def test_jacobian_against_finite_differences(lizard, moving, poses):
    bundle, y = small_bundle(lizard, moving, poses)
    step = 1e-5
    numeric = np.stack(
        [
            (bundle.residuals(y + step * e) - bundle.residuals(y - step * e)) / (2 * step)
            for e in np.eye(len(y))
        ],
        axis=1,
    )
    np.testing.assert_allclose(bundle.jacobian(y).toarray(), numeric, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.3, 2.0])
def test_left_jacobian(size):
    rho = size * np.array([0.6, -0.64, 0.48])

    def turned(delta):
        return (Rotation.from_rotvec(rho + delta) * Rotation.from_rotvec(rho).inv()).as_rotvec()

    numeric = np.stack([(turned(1e-5 * e) - turned(-1e-5 * e)) / 2e-5 for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(left_jacobian(rho), numeric, atol=1e-7)


@pytest.mark.parametrize("loss", sorted(DEFAULTS))
def test_loss_as_scipy_takes_it(lizard, loss):
    """2 ρ of z = e² and its slope; priors of the cameras are squared."""
    bundle, y = small_bundle(lizard, loss=loss)
    z = bundle.residuals(y) ** 2
    value, slope, _ = bundle.rho(z)
    n = 6 * bundle.n_free
    np.testing.assert_allclose(value[:-n], 2 * Loss(loss).value(np.sqrt(z[:-n])), rtol=1e-12)
    np.testing.assert_allclose(value[-n:], z[-n:], rtol=1e-12)
    for i in (0, 5, len(z) - 1):
        numeric = approx_fprime(
            z[[i]], lambda v, i=i: bundle.rho(np.concatenate([z[:i], v, z[i + 1 :]]))[0][i]
        )
        assert slope[i] == pytest.approx(numeric[0], rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("loss", ["redescending", "cauchy"])
def test_sba_is_never_worse_than_tri(cheetah, gallop, loss):
    options = FTEOptions(loss=Loss(loss))
    before = estimate_tri(gallop, cheetah.skeleton, options)
    calls = []
    after = estimate_sba(gallop, cheetah.skeleton, options, progress=lambda *a: calls.append(a))
    sd = marker_sd(cheetah.skeleton)
    assert (after.method, after.status) == ("sba", Status.CONVERGED)
    assert after.objective < before.objective
    assert after.objective == pytest.approx(robust_cost(after.reprojected, after.observed, sd, options.loss))
    assert calls[0] == (0, pytest.approx(before.objective))
    assert all(a[1] >= b[1] for a, b in zip(calls[:-1], calls[1:], strict=True))
    assert np.array_equal(np.isfinite(after.positions), np.isfinite(before.positions))
    assert np.nanmedian(truth_errors(after)) < 0.02
    assert after.parameters == {}


def test_sba_against_one_point_at_a_time(lizard, clean):
    """With a squared loss, SciPy's dense solver point by point."""
    result = estimate_sba(clean, lizard.skeleton, FTEOptions(loss=Loss("squared")))
    sd = marker_sd(lizard.skeleton)
    for n, m in ((0, 0), (11, 3), (39, 5)):

        def residuals(point, n=n, m=m):
            seen = clean.cameras.project(point[None, None])[0, :, 0]
            return ((seen - result.observed[n, :, m]) / sd[m]).ravel()

        alone = least_squares(residuals, result.positions[n, m] + 0.01, xtol=1e-12, ftol=1e-12)
        # converged to a hundredth of the standard deviation of a point
        spread = np.sqrt(np.trace(result.position_covariance[n, m]))
        assert np.linalg.norm(alone.x - result.positions[n, m]) < 0.01 * spread


def test_sba_with_moving_camera(lizard):
    q = random_motion(lizard.skeleton, N, 4)
    sequence = make_sequence(lizard, q, cameras_about(N, moving=True), noise_px=1.0)
    result = estimate_sba(sequence, lizard.skeleton, cameras_too=True)
    assert result.status is Status.CONVERGED
    assert np.median(result.errors) < 1.5


def disturbed(sequence, seed=0):
    """The sequence with wrong poses of all cameras but the first, and the corrections that mend them."""
    rng = np.random.default_rng(seed)
    c = len(sequence.cameras)
    wrong = np.concatenate([rng.normal(0, np.radians(0.4), (c, 3)), rng.normal(0, 0.02, (c, 3))], axis=1)
    wrong[0] = 0.0
    mends = np.zeros((c, 6))
    for i, pose in enumerate(wrong[1:], start=1):
        turn = Rotation.from_rotvec(pose[:3])
        mends[i] = np.concatenate([-pose[:3], -turn.inv().apply(pose[3:])])
    return replace(sequence, cameras=correct(sequence.cameras, wrong)), mends


def test_cameras_are_corrected(cheetah, gallop):
    """Poses off by half a degree and 2 cm: the error falls to the noise, the corrections are right."""
    wrong, mends = disturbed(gallop)
    kept = estimate_sba(wrong, cheetah.skeleton)
    found = estimate_sba(wrong, cheetah.skeleton, cameras_too=True)
    reference = estimate_sba(gallop, cheetah.skeleton)
    assert found.status is Status.CONVERGED
    assert np.nanmedian(kept.errors) > 2 * np.nanmedian(reference.errors)
    assert np.nanmedian(found.errors) < 1.1 * np.nanmedian(reference.errors)
    assert found.options["solver"] == {"cameras_too": True}
    poses, spread = (
        np.array([[*p["rotation_rad"], *p["translation_m"]] for p in found.parameters[family].values()])
        for family in ("extrinsics", "extrinsics_sd")
    )
    assert list(found.parameters["extrinsics"]) == gallop.cameras.names
    assert not poses[0].any()
    assert not spread[0].any()
    assert np.abs((poses - mends)[1:] / spread[1:]).max() < 4.0
    assert (spread[1:] < [np.radians(0.5)] * 3 + [0.1] * 3).all()
    again = correct(wrong.cameras, poses).project(found.positions)
    np.testing.assert_allclose(again, found.reprojected, atol=1e-6)


def test_narrow_priors_hold_the_cameras(cheetah, gallop):
    wrong, _ = disturbed(gallop)
    narrow = PriorWidths(rotation=1e-7, translation=1e-7)
    found = estimate_sba(wrong, cheetah.skeleton, FTEOptions(widths=narrow), cameras_too=True)
    poses = [[*p["rotation_rad"], *p["translation_m"]] for p in found.parameters["extrinsics"].values()]
    assert np.abs(poses).max() < 1e-5


def test_point_behind_its_camera(lizard, clean):
    """A detection in a camera that looks away enters nothing."""
    turned = [*clean.cameras]
    about = np.diag([-1.0, 1.0, -1.0])
    turned[1] = replace(
        turned[1], rotation=about @ turned[1].rotation, translation=about @ turned[1].translation
    )
    away = replace(clean, cameras=CameraArray(tuple(turned)))
    removed = clean.detections.copy(deep=True)
    removed.likelihood.values[:, 1] = 0.0
    with_it = estimate_sba(away, lizard.skeleton)
    without = estimate_sba(replace(away, detections=removed), lizard.skeleton)
    np.testing.assert_allclose(with_it.positions, without.positions, atol=1e-9)


def test_too_few_steps_are_no_success(lizard, clean, monkeypatch):
    monkeypatch.setattr("acino_fte.baseline_sba._MAX_STEPS", 1)
    assert estimate_sba(clean, lizard.skeleton).status is Status.MAX_ITERATIONS


def test_bundle_stays_where_it_is_at_its_minimum(lizard):
    bundle, _ = small_bundle(lizard, loss="squared")
    first = solve_bundle(bundle, enough=1e-12)
    gradient = bundle.jacobian(first.x).T @ bundle.residuals(first.x)
    assert np.abs(gradient).max() < 1e-2


# --- the choice --------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", BASELINES)
def test_estimate(lizard, clean, method):
    calls = []
    result = estimate(
        method,
        clean,
        lizard,
        EstimateOptions(FTEOptions(likelihood=0.3)),
        progress=lambda *a: calls.append(a),
        seconds={"load": 1},
    )
    assert result.method == method
    assert result.status.ok
    assert result.options["problem"]["likelihood"] == 0.3
    assert result.seconds["load"] == 1
    assert result.positions.shape == (N, lizard.n_markers, 3)
    assert bool(calls) is (method != "tri")
    assert truth_errors(result).mean() < 0.02


def test_estimate_refuses(lizard, clean):
    with pytest.raises(InputError, match="did you mean 'sba'"):
        estimate("sbaa", clean, lizard)
    for method, fit in (("tri", "extrinsics"), ("ekf", "delay"), ("sba", "scale")):
        with pytest.raises(InputError, match=f"does not estimate {fit}"):
            estimate(method, clean, lizard, EstimateOptions(fit=(fit,)))
    moved = EstimateOptions(fit=("extrinsics",))
    assert estimate("sba", clean, lizard, moved).parameters["extrinsics"]
