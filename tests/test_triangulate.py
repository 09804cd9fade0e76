"""Triangulation against OpenCV and closed forms; outliers, missing views, moving cameras."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import cameras_about, look_at

from acino_fte.cameras import CameraArray
from acino_fte.triangulate import triangulate

ROOM = 0.8


def points_in_room(n_frames, n_markers, seed=0):
    return np.random.default_rng(seed).uniform(-ROOM, ROOM, (n_frames, n_markers, 3))


def test_exact_views_give_the_exact_points():
    points, cameras = points_in_room(7, 5), cameras_about()
    found = triangulate(cameras, cameras.project(points))
    assert np.abs(found.points - points).max() < 1e-7
    assert found.inliers.all()
    assert found.inliers.shape == (7, 4, 5)
    assert found.errors.max() < 1e-4


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_two_views_equal_opencv(model):
    """Exact views, where every method agrees."""
    cameras = CameraArray(
        (
            look_at("left", [2.5, -2.0, 1.0], [0.0, 0.0, 0.0], model),
            look_at("right", [2.0, 2.5, 0.5], [0.0, 0.0, 0.0], model),
        )
    )
    points = points_in_room(1, 12)
    pixels = cameras.project(points)
    ideal = cameras.undistort(pixels)[0]
    matrices = [np.c_[c.rotation, c.translation] for c in cameras]
    homogeneous = cv2.triangulatePoints(matrices[0], matrices[1], ideal[0].T, ideal[1].T)
    expected = (homogeneous[:3] / homogeneous[3]).T
    assert np.allclose(triangulate(cameras, pixels).points[0], expected, atol=1e-6)


def test_noise_gives_the_least_squares_point():
    """With small noise the point is near the minimum of the squared reprojection error."""
    from scipy.optimize import least_squares

    cameras = cameras_about()
    points = points_in_room(1, 10)
    pixels = cameras.project(points) + np.random.default_rng(1).normal(0, 0.5, (1, 4, 10, 2))
    found = triangulate(cameras, pixels)
    for m in range(10):
        best = least_squares(
            lambda p, m=m: (cameras.project(p[None, None])[0, :, 0] - pixels[0, :, m]).ravel(), points[0, m]
        )
        assert np.linalg.norm(found.points[0, m] - best.x) < 1e-3
    assert 0.1 < np.median(found.errors) < 1.5


@pytest.mark.parametrize("bad", range(4))
def test_a_gross_outlier_in_one_of_four_views(bad):
    points, cameras = points_in_room(3, 8), cameras_about()
    pixels = cameras.project(points) + np.random.default_rng(2).normal(0, 0.5, (3, 4, 8, 2))
    pixels[:, bad] += np.random.default_rng(3).choice([-1, 1], (3, 8, 2)) * 120.0
    found = triangulate(cameras, pixels)
    assert np.linalg.norm(found.points - points, axis=-1).max() < 0.02
    assert not found.inliers[:, bad].any()
    assert found.inliers[:, [c for c in range(4) if c != bad]].all()


def test_two_outliers_among_eight_views():
    points, cameras = points_in_room(2, 6), cameras_about(n=8)
    pixels = cameras.project(points)
    pixels[:, 1] += 200
    pixels[:, 6] -= [90, 300]
    assert np.abs(triangulate(cameras, pixels).points - points).max() < 1e-3


def test_many_cameras():
    points, cameras = points_in_room(2, 3), cameras_about(n=14)
    pixels = cameras.project(points)
    pixels[0, :12, 0] = np.nan  # the last two alone
    assert np.abs(triangulate(cameras, pixels).points - points).max() < 1e-6


def test_fewer_than_two_views_are_nan():
    points, cameras = points_in_room(3, 4), cameras_about()
    pixels = cameras.project(points)
    pixels[1, 1:, 2] = np.nan  # one view
    pixels[2, :, 3] = np.nan  # none
    pixels[0, 0, 0, 1] = np.nan  # half a view is none
    found = triangulate(cameras, pixels)
    assert np.isnan(found.points[1, 2]).all()
    assert np.isnan(found.points[2, 3]).all()
    assert np.isnan(found.errors[[1, 2], [2, 3]]).all()
    assert not found.inliers[1, :, 2].any()
    assert not found.inliers[0, 0, 0]
    known = np.isfinite(found.points).all(-1)
    assert known.sum() == 10
    assert np.abs(found.points[known] - points[known]).max() < 1e-6


def test_two_views_that_disagree_are_nan():
    points, cameras = points_in_room(1, 2), cameras_about(n=2)
    pixels = cameras.project(points)
    pixels[0, 1, 0] += [0, 250]  # 250 px across the epipolar line
    found = triangulate(cameras, pixels)
    assert np.isnan(found.points[0, 0]).all()
    assert np.abs(found.points[0, 1] - points[0, 1]).max() < 1e-6


def test_the_threshold_decides():
    points, cameras = points_in_room(1, 1), cameras_about(n=3)
    pixels = cameras.project(points)
    pixels[0, 0, 0] += [12, 0]
    assert triangulate(cameras, pixels, threshold_px=40).inliers.all()
    assert not triangulate(cameras, pixels, threshold_px=4).inliers[0, 0, 0]


def test_nothing_seen_at_all():
    cameras = cameras_about()
    found = triangulate(cameras, np.full((2, 4, 3, 2), np.nan))
    assert np.isnan(found.points).all()
    assert not found.inliers.any()


def test_a_single_camera():
    cameras = cameras_about(n=1)
    assert np.isnan(triangulate(cameras, cameras.project(points_in_room(2, 3))).points).all()


def test_parallel_rays_are_no_point():
    """Two cameras at one place see nothing of the depth."""
    first = look_at("a", [3.0, 0.0, 0.5], [0.0, 0.0, 0.0])
    cameras = CameraArray((first, replace(first, name="b")))
    assert np.isnan(triangulate(cameras, cameras.project(points_in_room(1, 5))).points).all()


def test_points_behind_every_camera_are_not_found():
    """Rays that meet behind the cameras: the views of a mirrored calibration."""
    cameras = CameraArray(
        (look_at("a", [3.0, -1.0, 0.5], [6.0, -2.0, 0.5]), look_at("b", [3.0, 1.0, 0.5], [6.0, 2.0, 0.5]))
    )
    pixels = np.array([[[[640.0, 360.0]], [[640.0, 360.0]]]])
    assert np.isnan(triangulate(cameras, pixels).points).all()


def test_moving_cameras():
    points = points_in_room(9, 4)
    cameras = cameras_about(9, moving=True)
    pixels = cameras.project(points)
    pixels[4, 3, 1] += 300
    pixels[5, 1:, 2] = np.nan
    found = triangulate(cameras, pixels)
    expected = np.isfinite(found.points).all(-1)
    assert expected.sum() == 35
    assert np.abs(found.points[expected] - points[expected]).max() < 1e-6
    still = triangulate(cameras.at_frames(slice(0, 1)), pixels[:1])
    assert np.allclose(still.points, found.points[:1])


def test_more_points_than_a_chunk():
    points, cameras = points_in_room(700, 8), cameras_about(n=3)
    found = triangulate(cameras, cameras.project(points))
    assert np.abs(found.points - points).max() < 1e-6
