"""Calibration from pairs: derivatives, noise, uncertainty, choice of the lens, advice, faults."""

from dataclasses import replace

import numpy as np
import pytest
from data_tools_synthetic import message

from acino_fte.cameras import Camera
from acino_fte.data_tools.lidar_pairs import LidarPairs
from acino_fte.data_tools.lidar_solve import solve_lidar_camera
from acino_fte.data_tools.lidar_solve_fit import at, polished
from acino_fte.data_tools.lidar_solve_holdout import left_out
from acino_fte.data_tools.lidar_solve_model import (
    LENS,
    POSE,
    PickNoise,
    Priors,
    moved,
    pick_covariance,
    projection,
    values,
)
from acino_fte.data_tools.lidar_solve_simulate import RESOLUTION, simulated_picks
from acino_fte.data_tools.rotations import rotation_matrix, rotation_vector

LIMIT = 1.2


def rmse(camera: Camera, pairs: LidarPairs) -> float:
    return float(np.sqrt(np.mean(((camera.project(pairs.xyz) - pairs.pixel) ** 2).sum(axis=1))))


# ---------------------------------------------------------------------------------- derivatives


def test_derivatives_against_finite_differences():
    picks = simulated_picks(10.0, "scene", 8, 3, distortion=(-0.2, 0.05))
    camera, xyz, names = picks.camera, picks.pairs.xyz, POSE + LENS
    _, slope, for_point = projection(camera, xyz, names)
    for i, name in enumerate(names):
        h = 1e-3 if name in ("cx", "cy") else 1e-6
        ahead, back = (
            moved(camera, names, sign * h * np.eye(len(names))[i]).project(xyz) for sign in (1, -1)
        )
        np.testing.assert_allclose(slope[:, :, i], (ahead - back) / (2 * h), rtol=1e-5, atol=1e-4)
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        numeric = (camera.project(xyz + step) - camera.project(xyz - step)) / 2e-6
        np.testing.assert_allclose(for_point[:, :, k], numeric, rtol=1e-5, atol=1e-4)


def test_a_step_changes_what_it_says():
    camera = simulated_picks(10.0, "scene", 8, 3).camera
    step = np.arange(1, 13) * 0.01
    now, then = values(camera), values(moved(camera, POSE + LENS, step))
    for name, change in zip(POSE + LENS, step, strict=True):
        if not name.startswith("rotation"):
            assert then[name] - now[name] == pytest.approx(change)


def test_noise_of_both_picks_in_the_image():
    """The covariance of pick minus projection is that of many simulated picks."""
    noise = PickNoise(1.5, 0.05, 0.002)
    picks = simulated_picks(5.0, "scene", 6, 1, noise=replace(noise, pixel=1e-9, range=0, lateral=0))
    xyz, rng = picks.pairs.xyz[0], np.random.default_rng(0)
    ray = xyz / np.linalg.norm(xyz)
    across = rng.normal(0, 0.002 * np.linalg.norm(xyz), (20_000, 3))
    across -= (across @ ray)[:, None] * ray
    returns = xyz + rng.normal(0, 0.05, (20_000, 1)) * ray + across
    off = picks.camera.project(returns) + rng.normal(0, 1.5, (20_000, 2))
    _, _, for_point = projection(picks.camera, xyz[None], POSE)
    expected = pick_covariance(for_point, xyz[None], noise)[0]
    np.testing.assert_allclose(np.cov(off.T), expected, rtol=0.05, atol=0.05 * expected.max())


def test_a_camera_anywhere_needs_no_guess():
    """A rig is expected, but the lidar may stand 30 m away and be turned at will."""
    picks = simulated_picks(20.0, "scene", 24, 4)
    turn, shift = rotation_matrix(np.array([1.5, -2.0, 0.7])), np.array([20.0, -15.0, 12.0])
    pairs = LidarPairs(picks.pairs.pixel, picks.pairs.xyz @ turn.T + shift)
    found = solve_lidar_camera(pairs, RESOLUTION)
    assert found.rmse_px < 2
    assert np.linalg.norm(found.camera.centre - (turn @ picks.camera.centre + shift)) < 0.5
    assert any("from the lidar" in text for text in found.messages)


# ---------------------------------------------------------------------------------- uncertainty


def test_the_covariance_is_that_of_the_errors():
    """Normalised squared errors of nine parameters over several recordings average to about one."""
    errors = []
    for seed in range(6):
        picks = simulated_picks(25.0, "scene", 40, seed)
        found = solve_lidar_camera(picks.pairs, RESOLUTION, fit=("f", "c"), rig_m=0.5)
        true, best = values(picks.camera), values(found.camera)
        off = [true[name] - best[name] for name in found.lidar_camera.parameters[3:]]
        error = np.r_[rotation_vector(picks.camera.rotation @ found.camera.rotation.T), off]
        errors.append(error @ np.linalg.solve(found.lidar_camera.covariance, error) / 9)
        assert 0.5 < np.sqrt(np.diag(found.lidar_camera.covariance) / np.diag(found.bound)).mean() < 2
    assert 0.5 < np.mean(errors) < 1.6


def test_left_out_residuals_are_those_of_fits_without_the_pair():
    picks = simulated_picks(5.0, "scene", 14, 2)
    pixel, xyz, noise = picks.pairs.pixel, picks.pairs.xyz, PickNoise()
    priors = Priors({}, {"translation_x": 0.5, "translation_y": 0.5, "translation_z": 0.5})
    names = (*POSE, "log_f")
    fit = polished(picks.camera, names, pixel, xyz, noise, priors, 20.0)  # far from any outlier
    quick = left_out(fit)
    for i in (0, 5, 9):
        rest = np.arange(14) != i
        other = polished(picks.camera, names, pixel[rest], xyz[rest], noise, priors, 20.0)
        exact = at(other.camera, names, pixel, xyz, noise, priors).residual[i]
        assert np.linalg.norm(quick[i] - exact) < 0.1 * np.linalg.norm(exact) + 0.05


# --------------------------------------------------------------------------------- lens, advice


def test_distortion_only_where_left_out_pairs_support_it():
    for seed in (1,):
        straight, bent = (
            solve_lidar_camera(simulated_picks(5.0, "scene", 40, seed, distortion=k).pairs, RESOLUTION)
            for k in ((0.0, 0.0), (-0.25, 0.08))
        )
        assert straight.fitted == ("f", "c") and not straight.camera.distortion.any()
        picks = simulated_picks(5.0, "scene", 40, seed, distortion=(-0.25, 0.08))
        assert "distortion" in bent.fitted and bent.camera.distortion[0] == pytest.approx(-0.25, abs=0.05)
        assert rmse(bent.camera, picks.held_out) <= LIMIT * rmse(picks.camera, picks.held_out)


def facing(depths, tilt=0.0, n=24) -> tuple[Camera, LidarPairs]:
    """Picks on boards at depths that face the camera, or are tilted about a vertical axis."""
    rng = np.random.default_rng(0)
    camera = simulated_picks(20.0, "scene", 4, 0).camera
    pixel = np.array(RESOLUTION) * rng.uniform(0.1, 0.9, (n, 2))
    depth = np.resize(depths, n) * (1 + tilt * (pixel[:, 0] / RESOLUTION[0] - 0.5))
    xyz = camera.back_project(pixel[None], depth[None])[0]
    return camera, LidarPairs(pixel + rng.normal(0, 0.9, (n, 2)), xyz)


def test_a_board_that_faces_the_camera_cannot_tell_focal_length_from_depth():
    camera, pairs = facing([20.0])
    found = solve_lidar_camera(pairs, RESOLUTION)
    assert not found.determined
    (text,) = [m for m in found.messages if "focal length and depth apart" in m]
    assert "times surer" in text and "Tilt the board" in text and "second distance" in text
    assert found.lidar_camera.sd("log_f") > 0.005 and found.rmse_px < 2
    for depths, tilt in (([20.0], 0.5), ([20.0, 40.0], 0.0)):
        other = solve_lidar_camera(facing(depths, tilt)[1], RESOLUTION)
        assert other.determined and other.lidar_camera.sd("log_f") < 0.02
    f = camera.matrix[0, 0]
    held = solve_lidar_camera(pairs, RESOLUTION, focal_px=float(f))
    assert held.determined and held.focal_px == pytest.approx(f) and "f" not in held.fitted
    told = solve_lidar_camera(pairs, RESOLUTION, focal_px=(float(f), 0.002 * f))
    assert told.determined and told.focal_px == pytest.approx(f, rel=0.006)


def test_pairs_that_make_no_calibration():
    picks = simulated_picks(10.0, "scene", 20, 0).pairs
    assert "too few" in message(solve_lidar_camera, picks.take(np.arange(4)), RESOLUTION).problem
    dropped = picks.using(np.arange(20) < 4)
    assert "too few" in message(solve_lidar_camera, dropped, RESOLUTION).problem
    line = LidarPairs(picks.pixel, np.array([10.0, 0, 0]) + np.linspace(0, 1, 20)[:, None] * [0.1, 1, 0.2])
    assert "one line" in message(solve_lidar_camera, line, RESOLUTION).problem
    assert "outside" in message(solve_lidar_camera, picks, (300, 200)).problem
    message(solve_lidar_camera, picks, (0, 200))
    message(solve_lidar_camera, picks, RESOLUTION, None, ("zoom",))
    lens = Camera("c", "fisheye", np.diag([900.0, 900, 1]), np.zeros(4), np.eye(3), np.zeros(3), (1280, 720))
    assert "another size" in message(solve_lidar_camera, picks, RESOLUTION, lens).problem
    wide = replace(lens, resolution=RESOLUTION)
    assert "distortion" in message(solve_lidar_camera, picks, RESOLUTION, wide, ("distortion",)).problem


def test_pairs_that_do_not_belong_together_are_refused():
    """Nothing is written of a calibration that fits nothing, or that has most places behind the camera."""
    rng = np.random.default_rng(0)
    pixel = rng.uniform(0, np.array(RESOLUTION) - 1, (20, 2))
    error = message(solve_lidar_camera, LidarPairs(pixel, rng.uniform(-50, 50, (20, 3))), RESOLUTION)
    assert "No pose was found" in error.problem and "px off" in error.found


def test_a_point_beside_the_camera_counts_as_not_seen():
    """Its covariance has no inverse; the pair is lost, not the calibration."""
    xyz = np.array([[1.0, 2.0, 5.0], [1.0, 0.5, 1e-14]])
    camera = Camera("c", "pinhole", np.diag([900.0, 900, 1]), np.zeros(5), np.eye(3), np.zeros(3), RESOLUTION)
    fit = at(camera, POSE, np.zeros((2, 2)), xyz, PickNoise(), Priors({}, {}))
    assert np.isfinite(fit.residual).all(axis=1).tolist() == [True, False]
    assert np.isfinite(fit.information).all() and fit.squared[1] > 1e5


def test_without_outliers_it_is_least_squares():
    """As sure as the noise lets it be: no weight is lost on pairs that are only a little off."""
    picks = simulated_picks(5.0, "scene", 14, 2)
    found = solve_lidar_camera(picks.pairs, RESOLUTION)
    names, noise = (*POSE, "log_f", "cx", "cy"), PickNoise()
    fit = polished(picks.camera, names, picks.pairs.pixel, picks.pairs.xyz, noise, Priors({}, {}), 1.0)
    assert (fit.weight == 1).all() and not found.outlier.any()
