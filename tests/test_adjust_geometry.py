"""Moving points by their images: against closed forms, OpenCV and SciPy, with every lens and pose."""

import cv2
import numpy as np
import pytest
from conftest import look_at
from scipy.optimize import least_squares

from acino_fte.adjust_geometry import (
    NEAREST,
    Sight,
    at_distance,
    moved_along_ray,
    moved_in_image,
    still,
    triangulated,
)

POINT = np.array([0.3, -0.2, 0.4])
SHIFT = np.array([0.02, -0.01, 0.015])
IDEAL = (0.0, 0.0, 0.0, 0.0, 0.0)
CAMERAS = [
    look_at("ideal", [3.0, 0.5, 1.0], [0, 0, 0], distortion=IDEAL),
    look_at("pinhole", [-2.0, 2.5, 0.7], [0, 0, 0]),
    look_at("fisheye", [0.5, -3.0, 1.4], [0, 0, 0], "fisheye"),
    still(look_at("moving", np.linspace([2.0, 2.0, 1.0], [3.0, 1.0, 1.5], 5), [0, 0, 0]), 3),
]


def pixel_of(camera, point):
    return camera.project(point[None])[0]


def test_in_the_plane_parallel_to_the_image_a_pixel_is_z_over_f():
    camera = CAMERAS[0]
    z = camera.to_camera(POINT[None])[0, 2]
    step = np.array([12.0, -7.5])
    moved = moved_in_image(Sight(camera, pixel_of(camera, POINT) + step), POINT)
    focal = np.diag(camera.matrix)[:2]
    right, down = camera.rotation[:2]
    expected = POINT + z / focal[0] * step[0] * right + z / focal[1] * step[1] * down
    np.testing.assert_allclose(moved, expected, atol=1e-12)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.name)
def test_a_drag_ends_at_the_pixel_and_keeps_the_depth(camera):
    wanted = pixel_of(camera, POINT + SHIFT) + [31.0, -18.0]
    moved = moved_in_image(Sight(camera, wanted, SHIFT), POINT)
    np.testing.assert_allclose(pixel_of(camera, moved + SHIFT), wanted, atol=1e-6)
    depth = camera.to_camera(np.stack([POINT + SHIFT, moved + SHIFT]))[:, 2]
    assert depth[0] == pytest.approx(depth[1], abs=1e-9)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.name)
def test_along_its_ray_a_point_keeps_its_pixel(camera):
    sight = Sight(camera, pixel_of(camera, POINT + SHIFT), SHIFT)
    moved = moved_along_ray(sight, POINT, 1.1)
    np.testing.assert_allclose(pixel_of(camera, moved + SHIFT), sight.pixel, atol=1e-6)
    before, after = (np.linalg.norm(p + SHIFT - camera.centre) for p in (POINT, moved))
    assert after == pytest.approx(1.1 * before)
    same = at_distance(sight, after)
    np.testing.assert_allclose(same, moved, atol=1e-6)
    nearest = moved_along_ray(sight, POINT, -5.0)
    assert np.linalg.norm(nearest + SHIFT - camera.centre) == pytest.approx(NEAREST)


def test_exact_pixels_of_several_views_give_the_point():
    start = POINT + [0.3, 0.2, -0.4]
    for n in (2, 3, 4):
        sights = [Sight(c, pixel_of(c, POINT + SHIFT), SHIFT) for c in CAMERAS[:n]]
        np.testing.assert_allclose(triangulated(sights, start), POINT, atol=1e-7)


def test_two_ideal_views_agree_with_opencv():
    pair = [CAMERAS[0], look_at("other", [-1.0, 2.8, 0.9], [0, 0, 0], distortion=IDEAL)]
    pixels = [pixel_of(c, POINT) for c in pair]
    projections = [c.matrix @ np.column_stack([c.rotation, c.translation]) for c in pair]
    homogeneous = cv2.triangulatePoints(*projections, *(p[:, None] for p in pixels))[:, 0]
    found = triangulated([Sight(c, p) for c, p in zip(pair, pixels, strict=True)], POINT + 0.1)
    np.testing.assert_allclose(found, homogeneous[:3] / homogeneous[3], atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_pixels_that_disagree_give_the_least_squares_of_scipy(seed):
    rng = np.random.default_rng(seed)
    pixels = [pixel_of(c, POINT) + rng.normal(0, 12.0, 2) for c in CAMERAS]
    found = triangulated([Sight(c, p) for c, p in zip(CAMERAS, pixels, strict=True)], POINT)

    def residuals(x):
        return np.concatenate([pixel_of(c, x) - p for c, p in zip(CAMERAS, pixels, strict=True)])

    best = least_squares(residuals, POINT, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert np.sum(residuals(found) ** 2) <= 2 * best.cost * (1 + 1e-9)
    np.testing.assert_allclose(found, best.x, atol=1e-6)


def test_what_cannot_be_is_none():
    camera = CAMERAS[0]
    sight = Sight(camera, pixel_of(camera, POINT))
    assert triangulated([sight, sight], POINT) is None  # one ray twice
    fisheye = CAMERAS[2]
    assert moved_in_image(Sight(fisheye, np.array([1e5, 1e5])), POINT) is None  # no such direction
    assert at_distance(Sight(fisheye, np.array([1e5, 1e5])), 3.0) is None


def test_a_camera_that_moves_has_one_pose_in_a_frame():
    moving = look_at("moving", np.linspace([2.0, 2.0, 1.0], [3.0, 1.0, 1.5], 5), [0, 0, 0])
    points = np.tile(POINT, (5, 1, 1))
    for n in range(5):
        np.testing.assert_allclose(pixel_of(still(moving, n), POINT), moving.project(points)[n, 0])
    assert still(CAMERAS[0], 3) is CAMERAS[0]
