"""Camera paths from key frames: exactness, honest errors, gaps, misplaced key frames, gauges."""

from dataclasses import replace

import numpy as np
import pytest
from scene_worlds import Motion, keyed, nees, pose_errors, random_similarity, rms
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from acino_fte.data_tools.camera_paths import GAP_STEPS, PoseNoise, camera_path, unroll

TURN, SHIFT = np.radians(0.03), 0.002
NOISE = PoseNoise(TURN, SHIFT)
KEYS = np.arange(0, 401, 8)


def noisy(seed, frame=KEYS, turn=TURN, shift=SHIFT):
    motion = Motion(seed)
    return keyed("c", frame, *motion(frame), turn, shift, np.random.default_rng(seed)), motion


def angle(first, second):
    """Angles (N,) between rotations, rad."""
    return Rotation.from_matrix(first @ second.transpose(0, 2, 1)).magnitude()


def test_exact_through_smooth_motion_without_noise():
    motion = Motion(1)
    path = camera_path(keyed("c", KEYS, *motion(KEYS)), PoseNoise(1e-9, 1e-9))
    rotation, centre = motion(path.frame)
    np.testing.assert_array_equal(path.frame, np.arange(401))
    np.testing.assert_allclose(path.centre[KEYS], centre[KEYS], atol=1e-8)
    assert angle(path.rotation[KEYS], rotation[KEYS]).max() < 1e-7
    middle = slice(24, -24)  # the ends know less
    spline = CubicSpline(KEYS, centre[KEYS])(path.frame)
    turns = RotationSpline(KEYS, Rotation.from_matrix(rotation[KEYS]))(path.frame).as_matrix()
    mine, theirs = (rms((c - centre)[middle]) for c in (path.centre, spline))
    assert mine < theirs < 1e-4  # a quintic is smoother
    assert angle(path.rotation, rotation)[middle].max() < 2e-5 + angle(turns, rotation)[middle].max()
    assert path.known.all() and path.key.sum() == len(KEYS)


def test_rotations_are_rotations_and_poses_fit_together():
    camera, _ = noisy(2)
    path = camera_path(camera, NOISE)
    product = path.rotation @ path.rotation.transpose(0, 2, 1)
    np.testing.assert_allclose(product, np.tile(np.eye(3), (401, 1, 1)), atol=1e-12)
    assert (np.linalg.det(path.rotation) > 0).all()
    assert (np.linalg.eigvalsh(path.covariance) > 0).all()


def test_errors_are_as_large_as_they_say_and_smaller_than_those_of_key_frames():
    scores, shifts, turns = [], [], []
    for seed in range(12):
        camera, motion = noisy(10 + seed)
        path = camera_path(camera, NOISE)
        error = pose_errors(path, *motion(path.frame))
        scores.append(nees(error, path.covariance).mean())
        turns.append(rms(error[KEYS, :3]))
        shifts.append(rms(error[KEYS, 3:]))
    assert 0.7 < np.mean(scores) < 1.4
    assert rms(np.array(shifts)) < 0.95 * SHIFT and rms(np.array(turns)) < 0.95 * TURN


def test_each_half_of_the_pose_is_calibrated_by_itself():
    halves = []
    for seed in range(12):
        camera, motion = noisy(40 + seed, turn=4 * TURN, shift=0.01)
        path = camera_path(camera, PoseNoise(4 * TURN, 0.01))
        error = pose_errors(path, *motion(path.frame))
        halves.append(
            [nees(error[:, s], path.covariance[:, s, s]).mean() for s in (slice(0, 3), slice(3, 6))]
        )
    turn, shift = np.mean(halves, axis=0)
    assert 0.7 < turn < 1.4 and 0.7 < shift < 1.4


def test_noisy_key_frames_count_less():
    """Half of the key frames ten times as noisy, and said to be: the path keeps to the others."""
    said, blind, scores = [], [], []
    for seed in range(6):
        rng, motion = np.random.default_rng(seed), Motion(seed)
        rotation, centre = motion(KEYS)
        factor = np.where(np.arange(len(KEYS)) % 2 == 0, 1.0, 10.0)
        rotation = (
            Rotation.from_rotvec(TURN * factor[:, None] * rng.normal(size=(51, 3))).as_matrix() @ rotation
        )
        centre = centre + SHIFT * factor[:, None] * rng.normal(size=(51, 3))
        camera = keyed("c", KEYS, rotation, centre)
        path = camera_path(camera, PoseNoise(TURN * factor, SHIFT * factor))
        error = pose_errors(path, *motion(path.frame))
        scores.append(nees(error, path.covariance).mean())
        said.append(rms(error[:, 3:]))
        other = camera_path(camera, PoseNoise(7 * TURN, 7 * SHIFT))
        blind.append(rms(pose_errors(other, *motion(other.frame))[:, 3:]))
    assert rms(np.array(said)) < 0.8 * rms(np.array(blind))
    assert 0.5 < np.mean(scores) < 1.4


def test_unknown_in_long_gaps_and_not_before_or_after():
    camera, motion = noisy(3, frame=KEYS[(KEYS < 160) | (KEYS > 260)])
    path = camera_path(camera, NOISE, max_gap=60)
    assert path.frame[0] == 0 and path.frame[-1] == 400
    assert not path.known[153:264].any() and path.known[:153].all() and path.known[264:].all()
    assert np.isfinite(path.rotation).all() and np.isfinite(path.covariance).all()
    np.testing.assert_array_equal(path.rotation[180], path.rotation[152])  # nearest known one
    np.testing.assert_array_equal(path.rotation[250], path.rotation[264])
    row, known = path.rows(np.array([-1, 0, 200, 400, 401]))
    np.testing.assert_array_equal(known, [False, True, False, True, False])
    np.testing.assert_array_equal(row, [0, 0, 200, 400, 0])
    assert not camera_path(camera, NOISE).known[200]  # more than GAP_STEPS steps
    joined = camera_path(camera, NOISE, max_gap=200)
    assert joined.known.all()
    assert joined.covariance[208, 3, 3] > 20 * joined.covariance[100, 3, 3]
    error = pose_errors(joined, *motion(joined.frame))
    assert (np.abs(error[153:264]) < 5 * np.sqrt(np.einsum("nii->ni", joined.covariance[153:264]))).all()
    assert GAP_STEPS * 8 < 108


def test_one_image_is_a_camera_that_stands():
    rotation, centre = Motion(4)(np.array([17]))
    camera = keyed("c", np.array([17]), rotation, centre)
    path = camera_path(camera, NOISE, frames=(5, 30))
    np.testing.assert_array_equal(path.frame, np.arange(5, 30))
    assert path.known.all() and path.key.sum() == 1
    np.testing.assert_allclose(path.centre, np.tile(centre, (25, 1)), atol=1e-12)
    np.testing.assert_allclose(path.rotation, np.tile(rotation, (25, 1, 1)))
    np.testing.assert_allclose(path.covariance[3], np.diag([TURN**2] * 3 + [SHIFT**2] * 3), atol=1e-15)
    assert len(camera_path(camera, NOISE).frame) == 1
    late = camera_path(camera, NOISE, frames=(20, 30))  # tracks begin after the image
    assert {17, 20, 29} <= set(late.frame.tolist())


def test_two_and_three_key_frames():
    motion = Motion(5)
    for frame in ([0, 8], [0, 8, 16], [0, 3, 16]):
        frame = np.array(frame)
        camera = keyed("c", frame, *motion(frame), TURN, SHIFT, np.random.default_rng(0))
        path = camera_path(camera, NOISE)
        error = pose_errors(path, *motion(path.frame))
        assert path.known.all() and np.isfinite(path.covariance).all()
        assert (np.abs(error[frame]) < 6 * np.array([TURN] * 3 + [SHIFT] * 3)).all()
        assert rms(error[:, 3:]) < 0.02


@pytest.mark.parametrize("wrong", [[25], [10, 24, 39], [5, 9, 21, 30, 41]])
@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("what", ["turn", "shift"])
def test_misplaced_key_frames_are_left_out(what, wrong, size):
    """By ten centimetres or metres, some degrees or upside down; one in fifty or one in ten."""
    camera, motion = noisy(6)
    clean = camera_path(camera, NOISE)
    rotation, centre = camera.rotation.copy(), camera.centre
    if what == "turn":
        turn = Rotation.from_rotvec(min(size, 3.0) * np.array([0.7, -0.6, 0.4])).as_matrix()
        rotation[wrong] = turn @ rotation[wrong]
    else:
        centre[wrong] += size * np.array([0.7, -0.6, 0.4])
    path = camera_path(keyed("c", KEYS, rotation, centre), NOISE)
    assert not path.key[KEYS[wrong]].any() and path.key.sum() == len(KEYS) - len(wrong)
    error = pose_errors(path, *motion(path.frame))
    assert rms(error[:, 3:]) < 1.5 * rms(pose_errors(clean, *motion(path.frame))[:, 3:]) + 1e-4
    assert nees(error, path.covariance).mean() < 1.8


def test_right_key_frames_stay():
    for seed in range(8):
        camera, _ = noisy(60 + seed)
        assert camera_path(camera, NOISE).key.sum() == len(KEYS)
    jerky = Motion(70)(KEYS)
    jerky[1][KEYS >= 200] += np.outer(KEYS[KEYS >= 200] - 200, [0.02, 0.0, 0.0])  # starts at once
    rng = np.random.default_rng(0)
    assert camera_path(keyed("c", KEYS, *jerky, TURN, SHIFT, rng), NOISE).key.sum() >= len(KEYS) - 1


def test_a_camera_that_turns_round_several_times():
    frame = np.arange(0, 601, 8)
    every = np.arange(601)

    def pose(f):
        around = Rotation.from_rotvec(np.outer(2 * np.pi * 4.3 * f / 600, [0.0, 0.0, 1.0]))
        tilt = Rotation.from_rotvec(np.outer(0.4 + 0.2 * np.sin(f / 70), [1.0, 0.0, 0.0]))
        return (tilt * around).as_matrix(), np.stack([np.cos(f / 90), np.sin(f / 90), 0.1 * f / 60], axis=1)

    path = camera_path(keyed("c", frame, *pose(frame)), PoseNoise(1e-8, 1e-8))
    rotation, centre = pose(every)
    middle = slice(16, -16)
    assert angle(path.rotation, rotation)[middle].max() < 2e-3  # a step turns by 20 degrees
    assert np.linalg.norm(path.centre - centre, axis=1)[middle].max() < 1e-4
    scores = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        noisy_path = camera_path(
            keyed("c", frame, *pose(frame), 5 * TURN, SHIFT, rng), PoseNoise(5 * TURN, SHIFT)
        )
        scores.append(nees(pose_errors(noisy_path, rotation, centre), noisy_path.covariance).mean())
    assert 0.7 < np.mean(scores) < 1.4


def test_unrolled_angles_do_not_jump():
    turned = Rotation.from_rotvec(np.outer(np.linspace(0, 9 * np.pi, 60), [0.0, 0.0, 1.0]))
    angles = unroll(turned.as_matrix())
    assert angles[0] == pytest.approx(0.0)
    np.testing.assert_allclose(angles[:, 2], np.linspace(0, 9 * np.pi, 60), atol=1e-9)


def test_the_path_moves_with_the_world():
    rng = np.random.default_rng(8)
    camera, _ = noisy(8)
    path = camera_path(camera, NOISE)
    for _ in range(5):
        change = random_similarity(rng)
        other = camera_path(camera.moved(change), PoseNoise(TURN, SHIFT * change.scale))
        same = path.moved(change)
        np.testing.assert_allclose(other.rotation, same.rotation, atol=1e-8)
        np.testing.assert_allclose(other.centre, same.centre, atol=1e-7 * change.scale)
        np.testing.assert_allclose(
            np.einsum("nii->ni", other.covariance), np.einsum("nii->ni", same.covariance), rtol=1e-5
        )
        np.testing.assert_array_equal(other.key, path.key)


def test_frames_may_begin_anywhere():
    camera, _ = noisy(9)
    path, late = camera_path(camera, NOISE), camera_path(replace(camera, frame=camera.frame + 100_000), NOISE)
    np.testing.assert_allclose(late.centre, path.centre, atol=1e-9)
    np.testing.assert_array_equal(late.frame, path.frame + 100_000)
