"""Similarities: points, poses and covariances move together, and two worlds are aligned without a mirror."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera
from acino_fte.data_tools.similarity import Similarity, align_similarity
from acino_fte.errors import InputError

MATRIX = np.array([[900.0, 0, 640], [0, 910, 360], [0, 0, 1]])


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    return Similarity(float(np.exp(rng.normal())), turn, rng.normal(0, 5, 3))


def matrix(change: Similarity) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = change.scale * change.rotation, change.translation
    return out


def test_points_the_way_back_and_one_after_the_other():
    first, second = random_similarity(0), random_similarity(1)
    points = np.random.default_rng(2).normal(size=(4, 5, 3))
    homogeneous = np.concatenate([points, np.ones((4, 5, 1))], axis=-1)
    expected = homogeneous @ (matrix(second) @ matrix(first)).T
    np.testing.assert_allclose((second @ first).points(points), expected[..., :3], rtol=1e-12)
    np.testing.assert_allclose(first.inverse().points(first.points(points)), points, rtol=1e-11, atol=1e-12)


def test_a_camera_that_moves_with_its_world_sees_the_same():
    rng = np.random.default_rng(3)
    change = random_similarity(4)
    rotation = Rotation.random(6, random_state=rng).as_matrix()
    translation = rng.normal(size=(6, 3)) + [0, 0, 20]
    points = rng.normal(size=(6, 8, 3))
    before = Camera("a", "pinhole", MATRIX, np.zeros(5), rotation, translation, (1280, 720))
    moved = Camera("a", "pinhole", MATRIX, np.zeros(5), *change.poses(rotation, translation), (1280, 720))
    np.testing.assert_allclose(moved.project(change.points(points)), before.project(points), rtol=1e-10)
    np.testing.assert_allclose(moved.centre, change.points(before.centre), rtol=1e-10, atol=1e-10)


def test_covariances_are_those_of_moved_samples():
    change = random_similarity(5)
    root = np.random.default_rng(6).normal(size=(3, 3))
    samples = root @ np.random.default_rng(7).normal(size=(3, 40))
    moved = change.points(samples.T).T
    np.testing.assert_allclose(change.covariance(np.cov(samples)), np.cov(moved), rtol=1e-9)
    pose = np.zeros((6, 6))
    pose[:3, :3], pose[3:, 3:] = 0.1 * np.eye(3), np.cov(samples)
    np.testing.assert_allclose(change.pose_covariance(pose)[3:, 3:], np.cov(moved), rtol=1e-9)
    np.testing.assert_allclose(change.pose_covariance(pose)[:3, :3], pose[:3, :3])


@pytest.mark.parametrize(
    "wrong",
    [
        {"scale": 0.0},
        {"scale": np.nan},
        {"rotation": np.diag([1.0, 1, -1])},
        {"rotation": 2 * np.eye(3)},
        {"translation": np.array([0, np.inf, 0])},
    ],
)
def test_what_is_no_similarity_is_refused(wrong):
    with pytest.raises(InputError, match="similarity"):
        Similarity(**wrong)


@pytest.mark.parametrize("flat", [False, True])
def test_alignment_finds_the_exact_similarity(flat):
    for seed in range(20):
        change = random_similarity(seed)
        points = np.random.default_rng(seed).normal(size=(10, 3)) * [1, 1, not flat]
        points[3] = np.nan
        found = align_similarity(points, change.points(points))
        np.testing.assert_allclose(matrix(found), matrix(change), atol=1e-11)


@pytest.mark.parametrize("with_scale", [True, False])
def test_alignment_of_noisy_points_is_the_least_squares_by_another_route(with_scale):
    rng = np.random.default_rng(8)
    change = random_similarity(9)
    source = rng.normal(size=(12, 3))
    target = change.points(source) + rng.normal(0, 0.3, (12, 3))
    found = align_similarity(source, target, with_scale)

    def residual(p):
        turned = Rotation.from_rotvec(p[:3]).apply(source)
        return (np.exp(p[6] * with_scale) * turned + p[3:6] - target).ravel()

    start = np.concatenate([Rotation.from_matrix(change.rotation).as_rotvec(), change.translation, [0]])
    best = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-12)
    np.testing.assert_allclose(((found.points(source) - target) ** 2).sum(), 2 * best.cost, rtol=1e-10)
    np.testing.assert_allclose(found.rotation, Rotation.from_rotvec(best.x[:3]).as_matrix(), atol=1e-6)
    assert (found.scale == 1.0) is not with_scale


def test_alignment_of_mirrored_points_is_still_proper():
    points = np.random.default_rng(10).normal(size=(9, 3))
    found = align_similarity(points, points * [1, 1, -1])
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1.0)


def test_too_few_points_or_a_line_do_not_say_a_rotation():
    line = np.outer(np.arange(5.0), [1, 2, 3])
    with pytest.raises(InputError, match="one line"):
        align_similarity(line, line)
    with pytest.raises(InputError, match="three or more"):
        align_similarity(line[:2], line[:2])
    with pytest.raises(InputError, match="belong together"):
        align_similarity(line, line[:4])
