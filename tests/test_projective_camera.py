"""Cameras with skew, from DLT coefficients and with Vicon's lens."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import look_at
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.calibration import write_cameras
from acino_fte.data_tools.dlt import read_dlt
from acino_fte.data_tools.epipolar import ideal_pixels
from acino_fte.data_tools.projective_camera import (
    ProjectiveCamera,
    ViconRadial,
    dlt_projection,
    projection_matrix,
    triangulate_dlt,
)
from acino_fte.errors import InputError
from acino_fte.triangulate import triangulate

BATS = Path(__file__).resolve().parents[2] / "shared" / "data" / "bats"
needs_bats = pytest.mark.skipif(not BATS.is_dir(), reason="the recording shared/data/bats is absent")
SIZE = (1280, 720)
BARREL = ViconRadial(np.array([642.0, 358.0]), np.array([2.2e-7, 3e-14, 4e-20]))
PINCUSHION = ViconRadial(np.array([642.0, 358.0]), np.array([-1.5e-7, 2e-14, 0.0]))
CLOSED = ViconRadial(np.array([642.0, 358.0]), np.array([-4e-7, 0.0, 0.0]))  # one-to-one up to 913 px
LENSES = [None, BARREL, PINCUSHION, CLOSED]


def camera(skew=7.0, radial=None, place=(3.0, -2.0, 1.5), name="c") -> ProjectiveCamera:
    plain = look_at(name, place, (0.2, 0.1, 0.3), distortion=())
    matrix = plain.matrix + np.array([[0, skew, 0], [0, 0, 0], [0, 0, 0]])
    return ProjectiveCamera(name, matrix, plain.rotation, plain.translation, SIZE, radial)


def trio(radial=None) -> CameraArray:
    places = [(3.0, -2.0, 1.5), (2.0, 3.0, 1.0), (-3.0, 0.5, 2.0)]
    return CameraArray(tuple(camera(4.0 * i, radial, p, f"c{i}") for i, p in enumerate(places)))


def cloud(*shape, seed=0):
    return np.random.default_rng(seed).uniform(-0.6, 0.8, (*shape, 3))


@pytest.mark.parametrize("moving", [False, True])
def test_without_skew_and_lens_it_is_a_pinhole_camera(moving):
    place = np.array([3.0, -2.0, 1.5]) + (np.linspace(0, 1, 5)[:, None] * [0.5, 0.2, 0.1] if moving else 0)
    plain = look_at("c", place, (0.0, 0.0, 0.2), distortion=())
    ours = ProjectiveCamera("c", plain.matrix, plain.rotation, plain.translation, SIZE)
    points = cloud(5, 7)
    pixels = plain.project(points)
    assert ours.moves is moving
    for got, wanted in (
        (ours.project(points), pixels),
        *zip(ours.project_with_jacobian(points), plain.project_with_jacobian(points), strict=True),
        (ours.undistort(pixels), plain.undistort(pixels)),
        (ours.rays(pixels), plain.rays(pixels)),
        (ours.back_project(pixels, 2.0), plain.back_project(pixels, 2.0)),
        (ours.centre, plain.centre),
        (ours.at_frames(slice(1, 3)).centre, plain.at_frames(slice(1, 3)).centre),
        (ours.parameters[:4], plain.parameters[:4]),
    ):
        np.testing.assert_allclose(got, wanted, rtol=1e-10, atol=1e-9)
    assert ours.inside(pixels).tolist() == plain.inside(pixels).tolist()


def test_skew_in_closed_form():
    ours, points = camera(skew=31.0), cloud(40)
    homogeneous = np.column_stack([points, np.ones(40)]) @ projection_matrix(ours).T
    np.testing.assert_allclose(ours.project(points), homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-12)
    behind = 2 * ours.centre - points
    assert np.isnan(ours.project(behind)).all()
    assert np.isnan(ours.project_with_jacobian(behind)[1]).all()


@pytest.mark.parametrize("radial", LENSES)
def test_jacobian_against_finite_differences(radial):
    ours, points, step = camera(radial=radial), cloud(30), 1e-6
    pixels, slope = ours.project_with_jacobian(points)
    np.testing.assert_array_equal(pixels, ours.project(points))
    for i, axis in enumerate(np.eye(3)):
        numeric = (ours.project(points + step * axis) - ours.project(points - step * axis)) / (2 * step)
        np.testing.assert_allclose(slope[..., i], numeric, rtol=1e-6, atol=1e-4)


def test_jacobian_of_a_moving_camera():
    ours = camera(radial=BARREL)
    turns = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.1, 0.05, -0.1], 4)).as_matrix()
    moving = replace(ours, rotation=turns @ ours.rotation, translation=ours.translation @ turns.mT)
    points, step = cloud(4, 6), 1e-6
    slope = moving.project_with_jacobian(points)[1]
    for i, axis in enumerate(np.eye(3)):
        numeric = (moving.project(points + step * axis) - moving.project(points - step * axis)) / (2 * step)
        np.testing.assert_allclose(slope[..., i], numeric, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("radial", LENSES)
def test_there_and_back_again(radial):
    ours, points = camera(radial=radial), cloud(50)
    pixels = ours.project(points)
    depth = ours.to_camera(points)[:, 2]
    np.testing.assert_allclose(ours.back_project(pixels, depth), points, atol=1e-9)
    towards = (points - ours.centre) / np.linalg.norm(points - ours.centre, axis=1, keepdims=True)
    np.testing.assert_allclose(ours.rays(pixels), towards, atol=1e-9)
    assert np.isnan(ours.undistort(np.array([[np.nan, 3.0]]))).all()


@pytest.mark.parametrize("radial", [BARREL, PINCUSHION])
def test_vicon_lens_is_opencv_the_other_way_round(radial):
    """OpenCV's polynomial takes ideal points to measured ones; the same numbers do the reverse here."""
    focal, pixels = 900.0, np.random.default_rng(1).uniform((0, 0), SIZE, (60, 2))
    k1, k2, k3 = radial.coefficients * focal ** np.array([2, 4, 6])
    matrix = np.array([[focal, 0, radial.centre[0]], [0, focal, radial.centre[1]], [0, 0, 1]])
    distortion = np.array([k1, k2, 0, 0, k3])
    local = np.column_stack([(pixels - radial.centre) / focal, np.ones(60)])
    forward = cv2.projectPoints(local, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
    np.testing.assert_allclose(radial.ideal(pixels), forward, atol=1e-9)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    back = cv2.undistortPoints(forward[:, None], matrix, distortion, P=matrix, criteria=criteria)[:, 0]
    np.testing.assert_allclose(radial.measured(forward), back, atol=1e-5)
    np.testing.assert_allclose(radial.measured(forward), pixels, atol=1e-9)


def test_the_lens_ends_where_it_folds():
    assert np.isinf(BARREL.limit)
    assert CLOSED.limit == pytest.approx(np.sqrt(1 / 1.2e-6))
    edge = CLOSED.centre + [CLOSED.limit, 0.0]
    assert (
        np.isfinite(CLOSED.ideal(edge - [0.01, 0])).all() and np.isnan(CLOSED.ideal(edge + [0.01, 0])).all()
    )
    ideal_edge = CLOSED.centre + [CLOSED.ideal_limit, 0.0]
    assert np.isfinite(CLOSED.measured(ideal_edge - [0.01, 0])).all()
    assert np.isnan(CLOSED.measured(ideal_edge + [0.01, 0])).all()
    np.testing.assert_array_equal(CLOSED.measured(CLOSED.centre), CLOSED.centre)
    np.testing.assert_allclose(CLOSED.measured_slope(CLOSED.centre), np.eye(2))
    ours = camera(skew=0.0, radial=CLOSED)
    assert np.tan(ours.valid_angle) * ours.matrix[0, 0] == pytest.approx(CLOSED.ideal_limit)
    far = BARREL.centre + np.array([[0.0, 1e5], [3e4, 3e4]])
    np.testing.assert_allclose(BARREL.ideal(BARREL.measured(far)), far, rtol=1e-9)


@pytest.mark.parametrize("scale", [1.0, -0.37, 120.0])
def test_projection_matrices_are_taken_apart(scale):
    rng = np.random.default_rng(5)
    for _ in range(20):
        matrix = np.array([[rng.uniform(500, 2000), rng.uniform(-30, 30), 640], [0, 1100.0, 350], [0, 0, 1]])
        rotation, translation = Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 3, 3)
        projection = scale * matrix @ np.column_stack([rotation, translation])
        ours = ProjectiveCamera.from_projection("c", projection, SIZE)
        np.testing.assert_allclose(ours.matrix, matrix, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(ours.rotation, rotation, atol=1e-9)
        np.testing.assert_allclose(ours.translation, translation, atol=1e-9)
        centre = cv2.decomposeProjectionMatrix(projection)[2][:, 0]
        np.testing.assert_allclose(ours.centre, centre[:3] / centre[3], atol=1e-8)


def dlt_of(source: Camera, height: float, metres: float) -> np.ndarray:
    """Eleven coefficients with y up from the bottom, in a world of another unit."""
    projection = np.array([[1, 0, 0], [0, -1, height], [0, 0, 1.0]]) @ projection_matrix(source)
    projection[:, :3] *= metres
    return (projection / projection[2, 3]).ravel()[:11]


@pytest.mark.parametrize("metres", [1.0, 1e-3])
def test_dlt_coefficients_there_and_back(metres):
    source, points = camera(skew=3.0), cloud(30)
    coefficients = dlt_of(source, SIZE[1], metres)
    up = np.column_stack([points / metres, np.ones(30)]) @ dlt_projection(coefficients).T
    up = up[:, :2] / up[:, 2:]
    ours = ProjectiveCamera.from_dlt("c", coefficients, SIZE, image_height=SIZE[1], metres=metres)
    np.testing.assert_allclose(ours.matrix, source.matrix, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(ours.centre, source.centre, atol=1e-9)
    np.testing.assert_allclose(
        ours.project(points), np.column_stack([up[:, 0], SIZE[1] - up[:, 1]]), atol=1e-8
    )
    turned = ProjectiveCamera.from_dlt("c", coefficients, SIZE, metres=metres)
    with np.errstate(invalid="ignore"):  # y up and a proper rotation: all of the world is behind the camera
        assert np.isnan(turned.project(points)).all()


@pytest.mark.parametrize(
    "bad, words",
    [
        (np.zeros((3, 4)), "no centre"),
        (np.ones((3, 3)), "shape (3, 3)"),
        (np.full((3, 4), np.nan), "NaN"),
        (np.array([[1.0, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]), "no centre"),
    ],
)
def test_what_is_no_projection_matrix_is_refused(bad, words):
    with pytest.raises(InputError, match=words.replace("(", r"\(").replace(")", r"\)")):
        ProjectiveCamera.from_projection("c", bad, SIZE)


def test_the_checks_of_a_camera_hold():
    good = camera()
    with pytest.raises(InputError, match="rotation is wrong"):
        replace(good, rotation=np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(InputError, match="camera matrix is wrong"):
        replace(good, matrix=-np.eye(3))
    with pytest.raises(InputError, match="NaN or infinity"):
        replace(good, matrix=np.array([[900.0, np.nan, 1], [0, 900, 1], [0, 0, 1]]))
    with pytest.raises(InputError, match="coefficients"):
        ViconRadial(np.zeros(2), np.zeros(2))
    with pytest.raises(ValueError):
        good.matrix[0, 0] = 1.0


@pytest.mark.parametrize("radial", [None, BARREL])
def test_in_an_array_of_cameras(radial):
    cameras = CameraArray((*trio(radial).cameras, look_at("p", (0.0, -4.0, 1.0), (0.0, 0.0, 0.3))))
    points = cloud(6, 3)
    pixels = cameras.project(points)
    np.testing.assert_allclose(triangulate(cameras, pixels).points, points, atol=1e-6)
    by_point = np.moveaxis(pixels, 1, 2)
    np.testing.assert_allclose(triangulate_dlt(cameras, by_point), points, atol=1e-7)


def test_dlt_triangulation_is_the_linear_least_squares_of_dlt_users():
    """Against one system a point, written out with L1 … L11."""
    cameras = trio()
    rng = np.random.default_rng(2)
    pixels = np.moveaxis(cameras.project(cloud(25, 2)), 1, 2) + rng.normal(0, 3, (25, 2, 3, 2))
    pixels[rng.random((25, 2, 3)) < 0.3] = np.nan
    got = triangulate_dlt(cameras, pixels)
    tables = [dlt_of(c, SIZE[1], 1.0) for c in cameras]
    for index in np.ndindex(25, 2):
        left, right = [], []
        for (u, v), c in zip(pixels[index], tables, strict=True):
            if np.isfinite(u):
                v = SIZE[1] - v  # y up, as DLT users have it
                left += [[u * c[8] - c[0], u * c[9] - c[1], u * c[10] - c[2]]]
                left += [[v * c[8] - c[4], v * c[9] - c[5], v * c[10] - c[6]]]
                right += [c[3] - u, c[7] - v]
        if len(right) < 4:
            assert np.isnan(got[index]).all()
        else:
            np.testing.assert_allclose(got[index], np.linalg.lstsq(left, right, rcond=None)[0], atol=1e-9)
    assert np.isnan(got).any() and np.isfinite(got).any()


def test_dlt_triangulation_where_rays_fix_no_point():
    one = camera()
    pixels = one.project(cloud(4))
    assert np.isnan(triangulate_dlt([one, replace(one, name="same")], np.stack([pixels, pixels], 1))).all()
    at_origin = ProjectiveCamera("o", one.matrix, one.rotation, np.zeros(3), SIZE)  # L12 = 0
    other = replace(at_origin, name="b", translation=np.array([-2.0, 0, 0]))
    points = (cloud(4) * [1, 1, 0.2] + [1.0, 0.0, 5.0]) @ one.rotation
    pixels = np.stack([at_origin.project(points), other.project(points)], 1)
    np.testing.assert_allclose(triangulate_dlt([at_origin, other], pixels), points, atol=1e-8)


def test_dlt_triangulation_with_moving_cameras_and_matrices():
    place = np.linspace([-3.0, -2.0, 1.5], [-3.5, -1.0, 1.5], 6)
    moving, fixed = look_at("m", place, (0.0, 0.0, 0.3), distortion=()), camera()
    points = cloud(6)
    pixels = np.stack([moving.project(points[:, None])[:, 0], fixed.project(points)], axis=1)
    np.testing.assert_allclose(triangulate_dlt([moving, fixed], pixels), points, atol=1e-7)
    matrices = np.stack([projection_matrix(c) for c in trio()])
    ideal = np.stack([ideal_pixels(c, c.project(points)) for c in trio()], axis=1)
    np.testing.assert_allclose(triangulate_dlt(matrices, ideal), points, atol=1e-9)


@needs_bats
@pytest.mark.parametrize(
    "name, count, median_px", [("bats_P000-15000", 606, 1.9), ("speaker_P03-1000", 51, 0.1)]
)
def test_bats_as_dltdv_has_them(name, count, median_px):
    cameras = read_dlt(BATS / "2018-08-17_dltCoefs.csv", resolution=(640, 512))
    xy, shipped = (
        np.genfromtxt(BATS / f"{name}_{kind}.csv", delimiter=",", skip_header=1)
        for kind in ("xypts", "xyzpts")
    )
    pixels = xy.reshape(len(xy), -1, 3, 2) * [1, -1] + [0, 512]
    shipped = shipped.reshape(len(shipped), -1, 3)
    points = triangulate_dlt(cameras, pixels)
    known = np.isfinite(shipped).all(-1)
    assert known.sum() == count
    np.testing.assert_array_equal(np.isfinite(points).all(-1), known)
    np.testing.assert_allclose(points[known], shipped[known], atol=1e-5)
    seen = np.stack([camera.project(points) for camera in cameras], axis=-2)  # all in front of the cameras
    distance = np.linalg.norm(seen - pixels, axis=-1)
    assert np.isfinite(seen[known]).all()
    assert np.nanmedian(distance) < median_px
    for camera in cameras:
        assert abs(camera.parameters[4]) < 0.1 and camera.parameters[:2] == pytest.approx(526, abs=3)


def test_a_file_without_words_for_skew_refuses_it(tmp_path):
    """Written without, it would be another camera."""
    with pytest.raises(InputError, match="Camera 'c' cannot be written") as caught:
        write_cameras(tmp_path / "cameras.json", CameraArray((camera(),)))
    assert "ProjectiveCamera" in str(caught.value)
    assert not (tmp_path / "cameras.json").exists()
