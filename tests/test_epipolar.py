"""Two-view geometry of every kind of camera, against OpenCV, closed forms and finite differences."""

from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest
from conftest import look_at
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera
from acino_fte.data_tools.epipolar import (
    epipolar_lines,
    essential_matrix,
    fundamental_matrix,
    ideal_jacobian,
    ideal_pixels,
    sampson_distance,
    symmetric_distance,
)
from acino_fte.data_tools.projective_camera import ProjectiveCamera, ViconRadial, projection_matrix

TARGET = (0.1, 0.0, 0.3)


def kinds() -> dict[str, Camera]:
    """One camera of every kind, around a target."""
    pinhole = look_at("pinhole", (3.0, -2.0, 1.5), TARGET, "pinhole")
    fisheye = look_at("fisheye", (2.0, 3.0, 1.0), TARGET, "fisheye", focal=500.0)
    plain = look_at("dlt", (-3.0, 0.5, 2.0), TARGET, distortion=())
    skewed = plain.matrix + np.array([[0, 12.0, 0], [0, 0, 0], [0, 0, 0]])
    dlt = ProjectiveCamera.from_projection(
        "dlt", -3 * skewed @ np.column_stack([plain.rotation, plain.translation]), (1280, 720)
    )
    plain = look_at("vicon", (-1.0, -3.5, 1.2), TARGET, distortion=())
    lens = ViconRadial(np.array([640.0, 360.0]), np.array([2e-7, 1e-14, 0.0]))
    vicon = ProjectiveCamera("vicon", plain.matrix, plain.rotation, plain.translation, (1280, 720), lens)
    return {c.name: c for c in (pinhole, fisheye, dlt, vicon)}


KINDS = kinds()
PAIRS = list(combinations(KINDS, 2))


def cloud(*shape, seed=0):
    return np.random.default_rng(seed).uniform(-0.7, 0.8, (*shape, 3)) + TARGET


def ideal(camera, points):
    return ideal_pixels(camera, camera.project(points))


def pair():
    """Two cameras without distortion, their F, and points that do not match."""
    a, b = (look_at(n, p, TARGET, distortion=()) for n, p in (("a", (3.0, -2, 1.5)), ("b", (2.0, 3, 1))))
    rng = np.random.default_rng(3)
    x_a, x_b = (rng.uniform((0, 0), (1280, 720), (50, 2)) for _ in range(2))
    return a, b, fundamental_matrix(a, b), x_a, x_b


@pytest.mark.parametrize("names", PAIRS)
def test_every_kind_of_camera_meets_its_lines(names):
    a, b = (KINDS[name] for name in names)
    f, points = fundamental_matrix(a, b), cloud(40)
    x_a, x_b = ideal(a, points), ideal(b, points)
    assert np.abs(sampson_distance(f, x_a, x_b)).max() < 1e-7
    assert symmetric_distance(f, x_a, x_b).max() < 1e-7
    moved = x_b + np.random.default_rng(1).normal(0, 20, x_b.shape)
    assert np.median(symmetric_distance(f, x_a, moved)) > 3
    assert np.linalg.svd(f)[1][2] < 1e-12 * np.linalg.svd(f)[1][0]
    np.testing.assert_allclose(
        np.abs(sampson_distance(f, x_a, moved)),
        np.abs(sampson_distance(fundamental_matrix(b, a), moved, x_a)),
        rtol=1e-9,
        atol=1e-9,
    )


@pytest.mark.parametrize("names", PAIRS)
def test_against_projection_matrices_in_closed_form(names):
    """F = [e']× P' P⁺ (Hartley & Zisserman 2004, eq. 9.1), up to its scale."""
    a, b = (KINDS[name] for name in names)
    p_a, p_b = projection_matrix(a), projection_matrix(b)
    epipole = p_b @ np.append(a.centre, 1.0)
    cross = np.cross(np.eye(3), epipole)  # rows e_i × e', the transpose of [e']×
    wanted = cross.T @ p_b @ np.linalg.pinv(p_a)
    got = fundamental_matrix(a, b)
    wanted *= np.sum(got * wanted) / np.sum(wanted**2)
    scale = np.linalg.inv(b.matrix).T, np.linalg.inv(a.matrix)
    np.testing.assert_allclose(
        np.linalg.solve(scale[0], got) @ a.matrix, np.linalg.solve(scale[0], wanted) @ a.matrix, atol=1e-9
    )


def test_essential_matrix_against_opencv():
    a, b, *_ = pair()
    essential = essential_matrix(a, b)
    np.testing.assert_allclose(np.linalg.svd(essential)[1], [1, 1, 0], atol=1e-12)
    first, second, shift = cv2.decomposeEssentialMat(essential)
    relative = b.rotation @ a.rotation.T
    assert min(np.abs(first - relative).max(), np.abs(second - relative).max()) < 1e-9
    baseline = b.translation - relative @ a.translation
    assert abs(shift[:, 0] @ baseline) == pytest.approx(np.linalg.norm(baseline))


@pytest.mark.parametrize("name", ["pinhole", "fisheye"])
def test_ideal_pixels_against_opencv(name):
    camera = KINDS[name]
    pixels = camera.project(cloud(30))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    if name == "fisheye":
        wanted = cv2.fisheye.undistortPoints(
            pixels[:, None], camera.matrix, camera.distortion, P=camera.matrix, criteria=criteria
        )
    else:
        wanted = cv2.undistortPoints(
            pixels[:, None], camera.matrix, camera.distortion, P=camera.matrix, criteria=criteria
        )
    np.testing.assert_allclose(ideal_pixels(camera, pixels), wanted.reshape(-1, 2), atol=1e-5)


def test_lines_against_opencv():
    _, _, f, x_a, x_b = pair()
    wanted = cv2.computeCorrespondEpilines(x_a[:, None], 1, f)[:, 0]
    np.testing.assert_allclose(epipolar_lines(f, x_a), wanted, atol=1e-6)
    wanted = cv2.computeCorrespondEpilines(x_b[:, None], 2, f)[:, 0]
    np.testing.assert_allclose(epipolar_lines(f.T, x_b), wanted, atol=1e-6)


def test_the_dot_product_with_a_line_is_a_distance():
    """Along its normal, a line is as far as the dot product says; the lines of a meet in the epipole."""
    a, b, f, x_a, x_b = pair()
    lines = epipolar_lines(f, x_a)
    distance = (lines[:, :2] * x_b).sum(1) + lines[:, 2]
    foot = x_b - distance[:, None] * lines[:, :2]
    np.testing.assert_allclose((lines[:, :2] * foot).sum(1) + lines[:, 2], 0, atol=1e-9)
    epipole = b.project(a.centre[None])[0]  # NaN when behind b: then the point on the other side
    epipole = b.project(2 * b.centre - a.centre[None])[0] if np.isnan(epipole).any() else epipole
    np.testing.assert_allclose(lines[:, :2] @ epipole + lines[:, 2], 0, atol=1e-7)
    assert np.isnan(epipolar_lines(np.zeros((3, 3)), x_a)).all()


def test_distances_against_opencv_and_the_book():
    _, _, f, x_a, x_b = pair()
    squared = [
        cv2.sampsonDistance(np.append(p, 1.0), np.append(q, 1.0), f) for p, q in zip(x_a, x_b, strict=True)
    ]
    np.testing.assert_allclose(sampson_distance(f, x_a, x_b) ** 2, squared, rtol=1e-9)
    in_b, in_a = epipolar_lines(f, x_a), epipolar_lines(f.T, x_b)
    d_b, d_a = (in_b[:, :2] * x_b).sum(1) + in_b[:, 2], (in_a[:, :2] * x_a).sum(1) + in_a[:, 2]
    np.testing.assert_allclose(symmetric_distance(f, x_a, x_b), np.hypot(d_a, d_b), rtol=1e-9)
    np.testing.assert_array_equal(np.sign(sampson_distance(f, x_a, x_b)), np.sign(d_b))


def test_sampson_distance_is_the_distance_to_the_nearest_match_to_first_order():
    a, b, f, *_ = pair()
    points = cloud(30)
    rng = np.random.default_rng(7)
    x_a, x_b = (c.project(points) + rng.normal(0, 0.5, (30, 2)) for c in (a, b))
    near_a, near_b = cv2.correctMatches(f, x_a[None], x_b[None])
    exact = np.sqrt(((near_a[0] - x_a) ** 2).sum(1) + ((near_b[0] - x_b) ** 2).sum(1))
    np.testing.assert_allclose(np.abs(sampson_distance(f, x_a, x_b)), exact, rtol=2e-2, atol=1e-3)


@pytest.mark.parametrize("names", PAIRS)
def test_noise_of_measured_pixels_stays_what_it_is(names):
    """At a match the signed distance has a slope of length one for the four measured coordinates."""
    a, b = (KINDS[name] for name in names)
    f, points, step = fundamental_matrix(a, b), cloud(20), 1e-4
    measured = [a.project(points), b.project(points)]
    jacobians = [ideal_jacobian(c, m) for c, m in zip((a, b), measured, strict=True)]
    slope = np.empty((20, 4))
    for i in range(4):
        moved = []
        for sign in (1, -1):
            views = [m.copy() for m in measured]
            views[i // 2][:, i % 2] += sign * step
            x = [ideal_pixels(c, v) for c, v in zip((a, b), views, strict=True)]
            moved.append(sampson_distance(f, *x, *jacobians))
        slope[:, i] = (moved[0] - moved[1]) / (2 * step)
    np.testing.assert_allclose(np.linalg.norm(slope, axis=1), 1.0, rtol=1e-5)


@pytest.mark.parametrize("name", KINDS)
def test_ideal_jacobian_against_finite_differences(name):
    camera, step = KINDS[name], 1e-4
    pixels = camera.project(cloud(25))
    got = ideal_jacobian(camera, pixels)
    for i, axis in enumerate(np.eye(2)):
        numeric = (
            ideal_pixels(camera, pixels + step * axis) - ideal_pixels(camera, pixels - step * axis)
        ) / (2 * step)
        np.testing.assert_allclose(got[..., i], numeric, rtol=1e-5, atol=1e-6)


def moving(camera: Camera, n: int) -> Camera:
    turns = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.15, -0.1, 0.05], n)).as_matrix()
    shift = np.linspace([0, 0, 0], [0.3, -0.1, 0.2], n)
    return replace(
        camera, rotation=turns @ camera.rotation, translation=camera.translation @ turns.mT + shift
    )


@pytest.mark.parametrize("names", [("pinhole", "fisheye"), ("dlt", "vicon"), ("vicon", "pinhole")])
def test_moving_cameras(names):
    a, b = (KINDS[name] for name in names)
    n, points = 6, cloud(6, 9)
    for first, second in ((moving(a, n), b), (a, moving(b, n)), (moving(a, n), moving(b, n))):
        f = fundamental_matrix(first, second)
        assert f.shape == (n, 3, 3)
        x_a, x_b = ideal(first, points), ideal(second, points)
        assert np.nanmax(np.abs(sampson_distance(f[:, None], x_a, x_b))) < 1e-7
        for frame in range(n):
            alone = [c if not c.moves else replace_pose(c, frame) for c in (first, second)]
            np.testing.assert_allclose(f[frame], fundamental_matrix(*alone), rtol=1e-9, atol=1e-14)
    jacobian = ideal_jacobian(moving(a, n), moving(a, n).project(points))
    assert jacobian.shape == (n, 9, 2, 2)


def replace_pose(camera: Camera, frame: int) -> Camera:
    return replace(camera, rotation=camera.rotation[frame], translation=camera.translation[frame])


def test_only_the_place_moves():
    a, b, *_ = pair()
    path = a.translation + np.linspace([0, 0, 0], [0.2, 0.1, 0.4], 5)
    sliding = replace(a, translation=path)
    assert essential_matrix(sliding, b).shape == (5, 3, 3)
    points = cloud(5, 4)
    distance = sampson_distance(
        fundamental_matrix(sliding, b)[:, None], sliding.project(points), b.project(points)
    )
    assert np.abs(distance).max() < 1e-8


def test_tables_of_all_pairs_of_points():
    _, _, f, x_a, x_b = pair()
    table = sampson_distance(f, x_a[:, None], x_b[None])
    assert table.shape == (50, 50)
    np.testing.assert_allclose(np.diag(table), sampson_distance(f, x_a, x_b), rtol=1e-12)
    assert table[3, 11] == pytest.approx(sampson_distance(f, x_a[3], x_b[11]))
    assert epipolar_lines(f, x_a.reshape(5, 10, 2)).shape == (5, 10, 3)


def test_missing_points_and_coinciding_centres():
    a, b, f, x_a, x_b = pair()
    x_a = x_a.copy()
    x_a[4] = np.nan
    for distance in (sampson_distance(f, x_a, x_b), symmetric_distance(f, x_a, x_b)):
        assert np.flatnonzero(np.isnan(distance)).tolist() == [4]
    turn = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    turned = replace(a, rotation=turn @ a.rotation, translation=turn @ a.translation)
    for other in (a, turned):
        f = fundamental_matrix(a, other)
        assert np.isnan(f).all() and np.isnan(sampson_distance(f, x_a, x_b)).all()
    path = np.stack([a.translation, a.translation + [0.5, 0, 0]])
    apart = np.isfinite(fundamental_matrix(a, replace(a, translation=path))).all((1, 2))
    assert apart.tolist() == [False, True]
