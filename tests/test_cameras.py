"""Cameras against OpenCV, against finite differences, and there and back again."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import FISHEYE, PINHOLE, cameras_about, look_at
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera, CameraArray
from acino_fte.errors import InputError

WIDTH, HEIGHT = 1280, 720
COUNTS = [("pinhole", 0), ("pinhole", 4), ("pinhole", 5), ("pinhole", 8), ("pinhole", 12), ("fisheye", 4)]
# Sizes of coefficients that calibrations give: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4
LARGEST = (0.3, 0.1, 2e-3, 2e-3, 0.03, 0.2, 0.05, 0.01, 3e-3, 1e-3, 3e-3, 1e-3)


def unit(scale):
    return st.floats(-scale, scale)


@st.composite
def cameras(draw, kinds=tuple(COUNTS)):
    """Fixed cameras with realistic numbers."""
    model, count = draw(st.sampled_from(kinds))
    if model == "fisheye":
        distortion = [draw(unit(s)) for s in (0.08, 0.05, 0.04, 0.015)]
    else:
        distortion = [draw(unit(s)) for s in LARGEST[:count]]
    focal = draw(st.floats(700, 1800))
    matrix = [
        [focal, 0, 640 + draw(unit(60))],
        [0, focal * draw(st.floats(0.95, 1.05)), 360 + draw(unit(60))],
        [0, 0, 1],
    ]
    vector = np.array([draw(unit(2.0)) for _ in range(3)])
    rotation = cv2.Rodrigues(vector)[0]
    translation = np.array([draw(unit(3.0)) for _ in range(3)])
    return Camera("c", model, np.array(matrix), np.array(distortion), rotation, translation, (WIDTH, HEIGHT))


seeds = st.integers(0, 10_000)


def points_in_view(camera, seed, n=20):
    """World points in front of the camera, (1, n, 3), that project into the image within the valid field."""
    rng = np.random.default_rng(seed)
    reach = 0.9 * min(np.tan(min(camera.valid_angle, 1.2)), 1.0)
    radius, turn = reach * np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
    depth = rng.uniform(0.5, 12, n)
    local = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.ones(n)], axis=1) * depth[:, None]
    world = ((local - camera.translation) @ camera.rotation)[None]
    return world[:, camera.inside(camera.project(world))[0]]


def opencv_project(camera, world):
    # not cv2.Rodrigues, which takes rotations below a microradian for none at all
    vector = Rotation.from_matrix(camera.rotation).as_rotvec().reshape(3, 1)
    points = np.ascontiguousarray(world.reshape(-1, 1, 3))
    if camera.model == "fisheye":
        pixels, _ = cv2.fisheye.projectPoints(
            points, vector, camera.translation, camera.matrix, camera.distortion
        )
    else:
        distortion = camera.distortion if camera.distortion.size else None
        pixels, _ = cv2.projectPoints(points, vector, camera.translation, camera.matrix, distortion)
    return pixels.reshape(-1, 2)


@given(cameras(), seeds)
def test_projection_equals_opencv(camera, seed):
    world = points_in_view(camera, seed)
    if world.size:
        assert np.abs(camera.project(world)[0] - opencv_project(camera, world)).max() < 1e-9


@pytest.mark.parametrize(("model", "count"), COUNTS)
def test_every_number_of_coefficients_equals_opencv(model, count):
    distortion = np.array(FISHEYE if model == "fisheye" else LARGEST[:count])
    camera = look_at("c", [1.0, -4.0, 2.0], [0.0, 0.5, 0.3], model, distortion)
    world = np.random.default_rng(0).uniform(-1.5, 1.5, (1, 200, 3))
    assert np.abs(camera.project(world)[0] - opencv_project(camera, world)).max() < 1e-9


@given(cameras(), seeds)
def test_jacobian_equals_central_differences(camera, seed):
    world = points_in_view(camera, seed, 6)
    pixels, jacobian = camera.project_with_jacobian(world)
    assert np.allclose(pixels, camera.project(world), rtol=1e-12)
    assert jacobian.shape == (*world.shape[:-1], 2, 3)
    h = 1e-6
    for axis in range(3):
        step = h * np.eye(3)[axis]
        numeric = (camera.project(world + step) - camera.project(world - step)) / (2 * h)
        assert np.allclose(jacobian[..., axis], numeric, rtol=1e-5, atol=1e-3)


@given(cameras(), seeds)
def test_undistort_inverts_the_distortion(camera, seed):
    world = points_in_view(camera, seed)
    pixels = camera.project(world)
    ideal = camera.undistort(pixels)
    again = camera.back_project(pixels, 2.5)
    assert np.isfinite(ideal).all()
    assert np.abs(camera.project(again) - pixels).max(initial=0.0) < 1e-8
    local = camera.to_camera(world)
    assert np.allclose(ideal, local[..., :2] / local[..., 2:], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("model", "count"), COUNTS)
def test_undistort_equals_opencv(model, count):
    distortion = np.array(FISHEYE if model == "fisheye" else LARGEST[:count])
    camera = look_at("c", [1.0, -4.0, 2.0], [0.0, 0.5, 0.3], model, distortion)
    u, v = np.meshgrid(np.linspace(100, 1180, 13), np.linspace(60, 660, 9))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    if model == "fisheye":
        expected = cv2.fisheye.undistortPoints(
            pixels[:, None], camera.matrix, camera.distortion, criteria=criteria
        )
    else:
        distortion = camera.distortion if camera.distortion.size else None
        expected = cv2.undistortPoints(pixels[:, None], camera.matrix, distortion, criteria=criteria)
    assert np.abs(camera.undistort(pixels) - expected.reshape(-1, 2)).max() < 1e-9


@given(cameras(), seeds)
def test_rays_point_at_what_was_seen(camera, seed):
    world = points_in_view(camera, seed)
    rays = camera.rays(camera.project(world))
    way = world - camera.centre
    assert np.allclose(np.linalg.norm(rays, axis=-1), 1.0)
    assert np.allclose(rays, way / np.linalg.norm(way, axis=-1, keepdims=True), atol=1e-8)


@given(cameras(), seeds)
def test_back_projection_at_the_true_depth(camera, seed):
    world = points_in_view(camera, seed)
    depth = camera.to_camera(world)[..., 2]
    assert np.allclose(camera.back_project(camera.project(world), depth), world, atol=1e-6)


@given(cameras())
def test_points_behind_the_camera_are_nan(camera):
    local = np.array([[0.1, 0.1, -2.0], [0.0, 0.0, -1e-3], [0.3, 0.1, 2.0], [np.nan, 0.0, 1.0]])
    world = ((local - camera.translation) @ camera.rotation)[None]
    pixels, jacobian = camera.project_with_jacobian(world)
    assert np.isnan(pixels[0, [0, 1, 3]]).all()
    assert np.isnan(jacobian[0, [0, 1, 3]]).all()
    assert np.isfinite(pixels[0, 2]).all()
    assert np.isfinite(jacobian[0, 2]).all()


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_in_front_but_exactly_on_the_plane_of_the_camera(model):
    camera = Camera(
        "c", model, np.diag([900.0, 900, 1]), np.zeros(4), np.eye(3), np.zeros(3), (WIDTH, HEIGHT)
    )
    assert np.isnan(camera.project(np.array([[[1.0, 2.0, 0.0]]]))).all()
    assert np.isnan(camera.project_with_jacobian(np.array([[[0.0, 0.0, -1.0]]]))[1]).all()


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_the_optical_axis(model):
    camera = look_at("c", [0.0, -4.0, 1.0], [0.0, 0.0, 1.0], model)
    pixels, jacobian = camera.project_with_jacobian(np.array([[[0.0, 0.0, 1.0]]]))
    assert np.allclose(pixels, camera.matrix[:2, 2])
    assert np.allclose(jacobian[0, 0], [[225, 0, 0], [0, 0, -227.25]], atol=1e-6)
    assert np.allclose(camera.undistort(pixels), 0)


@pytest.mark.parametrize(
    ("model", "distortion"),
    [("pinhole", [-0.5, 0.0, 0.0, 0.0]), ("fisheye", [-0.3, 0.0, 0.0, 0.0])],
)
def test_beyond_the_valid_field_is_nan(model, distortion):
    """Strong barrel distortion folds the image over: beyond the fold no ray belongs to a pixel."""
    camera = look_at("c", [0.0, -4.0, 1.0], [0.0, 0.0, 1.0], model, distortion)
    assert camera.valid_angle < np.radians(70)
    edge = np.hypot(*(camera.matrix[:2, 2]))
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    far = camera.matrix[:2, 2] + 2 * edge * circle
    assert np.isnan(camera.undistort(far)).all()
    near = camera.matrix[:2, 2] + 0.2 * edge * circle
    ideal = camera.undistort(near)
    assert np.isfinite(ideal).all()
    assert (np.arctan(np.hypot(ideal[:, 0], ideal[:, 1])) < camera.valid_angle).all()


@pytest.mark.parametrize("tiny", [5e-324, -5e-324, 1e-200, 1e-12])
def test_coefficients_next_to_nothing(tiny):
    plain = look_at("c", [0.0, -4.0, 1.0], [0.0, 0.0, 1.0], distortion=np.array(LARGEST[:5]))
    for at in (5, 6, 7, 11):
        lens = np.array([*LARGEST[:5], *[0.0] * 7])
        lens[at] = tiny
        camera = replace(plain, distortion=lens)
        assert camera.valid_angle == pytest.approx(plain.valid_angle, rel=1e-6)
        assert np.allclose(
            camera.undistort(np.array([100.0, 50.0])), plain.undistort(np.array([100.0, 50.0]))
        )


def test_the_field_ends_before_the_pole_of_a_rational_lens():
    """Numerator and denominator change sign side by side: a fold too narrow to be sampled."""
    for numerator, denominator in ((-0.25, -0.2501), (-0.2501, -0.25)):
        lens = [numerator, 0, 0, 0, 0, denominator, 0, 0]
        camera = look_at("c", [0.0, -4.0, 1.0], [0.0, 0.0, 1.0], distortion=np.array(lens))
        assert np.tan(camera.valid_angle) <= 2.0


def test_nan_pixels_stay_nan():
    camera = look_at("c", [0.0, -4.0, 1.0], [0.0, 0.0, 1.0], "fisheye")
    pixels = np.array([[[np.nan, np.nan], [500.0, 300.0], [500.0, np.nan]]])
    for result in (camera.undistort(pixels), camera.rays(pixels), camera.back_project(pixels, 2.0)):
        assert np.isnan(result[0, [0, 2]]).all(axis=-1).all()
        assert np.isfinite(result[0, 1]).all()
    assert np.isnan(camera.undistort(np.full((2, 3, 2), np.nan))).all()
    assert camera.inside(pixels).tolist() == [[False, True, False]]


def test_the_image_ends_half_a_pixel_beyond_the_outer_pixel_centres():
    camera = cameras_about()[0]
    corner = np.array([[-0.5, -0.5], [1279.5, 719.5], [-0.51, 3], [1279.51, 3], [3, 719.51]])
    assert camera.inside(corner).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("what", ["both", "rotation", "translation"])
@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_a_moving_camera_is_a_fixed_camera_in_every_frame(model, what):
    n = 5
    path = np.array([3.0, -2.0, 1.0]) + np.linspace(0, 1, n)[:, None] * [0.5, 0.3, -0.2]
    moving = look_at("c", path, [0.0, 0.0, 0.2], model)
    if what == "rotation":
        moving = replace(moving, translation=moving.translation[2])
    if what == "translation":
        moving = replace(moving, rotation=moving.rotation[2])
    world = np.random.default_rng(1).uniform(-0.8, 0.8, (n, 7, 3))
    world[2, 0] += 50 * (moving.centre[2] - world[2, 0])  # behind it
    pixels, jacobian = moving.project_with_jacobian(world)
    assert moving.moves
    assert np.isnan(pixels[2, 0]).all()
    for f in range(n):
        fixed = replace(
            moving,
            rotation=moving.rotation[f] if moving.rotation.ndim == 3 else moving.rotation,
            translation=moving.translation[f] if moving.translation.ndim == 2 else moving.translation,
        )
        assert not fixed.moves
        seen, slope = fixed.project_with_jacobian(world[f : f + 1])
        same = {"rtol": 1e-12, "atol": 1e-9, "equal_nan": True}
        assert np.allclose(pixels[f], seen[0], **same)
        assert np.allclose(jacobian[f], slope[0], **same)
        assert np.allclose(moving.rays(pixels)[f], fixed.rays(seen)[0], **same)
        assert np.allclose(moving.back_project(pixels, 3.0)[f], fixed.back_project(seen, 3.0)[0], **same)
        assert np.allclose(moving.centre[f], fixed.centre)
    cut = moving.at_frames(slice(1, 4))
    assert np.allclose(cut.project(world[1:4]), pixels[1:4], equal_nan=True)


def test_many_poses_are_as_one_by_one():
    """More than one block of the programs, and a pose for each point."""
    n = 10_000
    rng = np.random.default_rng(5)
    rotation = Rotation.from_rotvec(rng.normal(0, 1, (n, 3))).as_matrix()
    local = np.concatenate([rng.uniform(-0.6, 0.6, (n, 2)), np.ones((n, 1))], axis=1)
    local *= rng.uniform(1, 9, (n, 1))
    fixed = Camera("c", "pinhole", matrix(), PINHOLE, np.eye(3), np.zeros(3), (WIDTH, HEIGHT))
    translation = rng.normal(0, 1, (n, 3))
    moving = replace(fixed, rotation=rotation, translation=translation)
    world = np.einsum("nji,nj->ni", rotation, local - translation)
    pixels, jacobian = moving.project_with_jacobian(world[:, None])
    for start in range(0, n, 1999):
        part = slice(start, start + 50)
        expected, slope = fixed.project_with_jacobian(local[part])
        assert np.allclose(pixels[part, 0], expected, rtol=1e-11, atol=1e-8)
        assert np.allclose(jacobian[part, 0], slope @ rotation[part], rtol=1e-9, atol=1e-7)
    way = world - moving.centre
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    assert np.allclose(moving.rays(pixels)[:, 0], way, atol=1e-9)
    assert np.array_equal(moving.at_frames(np.array([7, 3])).centre, moving.centre[[7, 3]])


@pytest.mark.parametrize("fault", ["mirrored", "scaled"])
def test_one_bad_rotation_among_many(fault):
    rotation = np.stack([np.eye(3)] * 1000)
    rotation[617] = SWAPPED if fault == "mirrored" else 1.002 * np.eye(3)
    with pytest.raises(InputError, match="its rotation is wrong"):
        replace(cameras_about()[0], rotation=rotation)


def test_a_camera_without_frames():
    camera = replace(cameras_about()[0], rotation=np.zeros((0, 3, 3)), translation=np.zeros((0, 3)))
    pixels, jacobian = camera.project_with_jacobian(np.zeros((0, 4, 3)))
    assert (pixels.shape, jacobian.shape) == ((0, 4, 2), (0, 4, 2, 3))
    assert camera.rays(pixels).shape == (0, 4, 3)


def test_fixed_cameras_are_the_same_at_all_frames():
    camera = cameras_about()[0]
    assert camera.at_frames(slice(0, 2)) is camera


def test_camera_array():
    array = cameras_about(4, moving=True)
    world = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 6, 3))
    pixels = array.project(world)
    assert pixels.shape == (4, 4, 6, 2)
    for c, camera in enumerate(array):
        assert np.array_equal(pixels[:, c], camera.project(world))
        assert np.array_equal(array.undistort(pixels)[:, c], camera.undistort(pixels[:, c]))
    rotation, translation = array.poses(4)
    assert (rotation.shape, translation.shape) == ((4, 4, 3, 3), (4, 4, 3))
    assert np.array_equal(rotation[:, 0], array[0].rotation)
    assert np.array_equal(translation[3, 1], array["c1"].translation)
    assert array.at_frames(slice(1, 3))["c0"].rotation.shape == (2, 3, 3)
    assert len(array) == 4


def test_cameras_cannot_be_changed():
    camera = cameras_about()[0]
    for values in (camera.rotation[0], camera.centre):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 2.0


def test_two_cameras_with_one_name():
    camera = cameras_about()[0]
    with pytest.raises(InputError, match="Two cameras have one name") as error:
        CameraArray((camera, camera))
    assert "c0, c0" in str(error.value)


def matrix(**changes):
    k = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
    for key, value in changes.items():
        k[int(key[1]), int(key[2])] = value
    return k


SWAPPED = np.eye(3)[[1, 0, 2]]
FAULTS = {
    "model": ({"model": "omni"}, "model", "'pinhole' or 'fisheye'", "'omni'"),
    "matrix shape": ({"matrix": np.eye(4)}, "camera matrix", "shape (3, 3)", "shape (4, 4)"),
    "coefficients": ({"distortion": np.zeros(3)}, "distortion", "0, 4, 5, 8, 12", "3"),
    "fisheye": ({"model": "fisheye", "distortion": np.zeros(5)}, "distortion", "4 coefficients", "5"),
    "rotation vector": ({"rotation": np.zeros(3)}, "rotation", "shape (3, 3)", "shape (3,)"),
    "rotations": ({"rotation": np.zeros((2, 2, 3, 3))}, "rotation", "(frames, 3, 3)", "(2, 2, 3, 3)"),
    "translation": ({"translation": np.zeros(4)}, "translation", "shape (3,)", "shape (4,)"),
    "poses": (
        {"rotation": np.stack([np.eye(3)] * 3), "translation": np.zeros((2, 3))},
        "pose",
        "as many rotations as translations",
        "3 and 2",
    ),
    "nan": ({"translation": [np.nan, 0, 0]}, "translation", "finite numbers", "NaN"),
    "infinite": ({"matrix": matrix(_00=np.inf)}, "matrix", "finite numbers", "infinity"),
    "nan distortion": ({"distortion": [np.nan] * 4}, "distortion", "finite numbers", "NaN"),
    "nan rotation": ({"rotation": np.full((3, 3), np.nan)}, "rotation", "finite numbers", "NaN"),
    "scaled": ({"rotation": 1.01 * np.eye(3)}, "rotation", "orthonormal", "determinant +1.030"),
    "mirrored": ({"rotation": SWAPPED}, "rotation", "determinant +1", "determinant -1.000"),
    "focal": ({"matrix": matrix(_00=-900)}, "camera matrix", "positive focal lengths", "-900 and 900"),
    "zero focal": ({"matrix": matrix(_11=0)}, "camera matrix", "positive focal lengths", "900 and 0"),
    "skew": ({"matrix": matrix(_01=5)}, "camera matrix", "no skew", "5"),
    "transposed": ({"matrix": matrix().T}, "camera matrix", "[0, 0, 1] as its last row", "640 360 1"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_cannot_be_a_camera(fault):
    changes, key, expected, found = FAULTS[fault]
    good = {
        "name": "gate",
        "model": "pinhole",
        "matrix": matrix(),
        "distortion": np.array(PINHOLE),
        "rotation": np.eye(3),
        "translation": np.zeros(3),
        "resolution": (WIDTH, HEIGHT),
    }
    Camera(**good)
    with pytest.raises(InputError) as error:
        Camera(**{**good, **changes})
    assert "Camera 'gate' cannot be used" in error.value.problem
    assert error.value.key == key
    assert expected in error.value.expected
    assert found in error.value.found
    assert error.value.remedy


def test_column_translations_are_taken():
    camera = cameras_about()[0]
    assert replace(camera, translation=camera.translation[:, None]).translation.shape == (3,)
    assert replace(camera, distortion=camera.distortion[None]).distortion.shape == (5,)


@settings(max_examples=20)
@given(cameras(kinds=(("fisheye", 4),)), seeds)
def test_projection_of_a_wide_fisheye(camera, seed):
    """Far from the axis, where the image circle ends, as long as the radius still grows."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, min(camera.valid_angle, np.radians(88)) - 0.02, 30)
    turn = rng.uniform(0, 2 * np.pi, 30)
    local = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    world = ((3.0 * local - camera.translation) @ camera.rotation)[None]
    pixels = camera.project(world)
    assert np.abs(pixels[0] - opencv_project(camera, world)).max() < 1e-8
    assert np.allclose(camera.rays(pixels)[0], local @ camera.rotation, atol=1e-7)
