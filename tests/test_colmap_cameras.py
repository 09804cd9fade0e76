"""COLMAP's camera models: against pycolmap number by number, and there and back over whole images."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acino_fte.cameras import Camera
from acino_fte.data_tools.colmap_cameras import camera_from_colmap, colmap_parameters
from acino_fte.data_tools.projective_camera import ProjectiveCamera
from acino_fte.errors import InputError
from acino_fte.projection import CLOSED, COEFFICIENTS

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is the extra 'colmap'")

WIDTH, HEIGHT, FOCAL = 1280, 720, 560.0
# Mild and strong lenses that calibrations give: action cameras, fisheyes, a headset, panoramas
LENSES = {
    "SIMPLE_PINHOLE": [[]],
    "PINHOLE": [[]],
    "SIMPLE_RADIAL": [[-0.05], [-0.25], [0.1]],
    "RADIAL": [[-0.25, 0.06], [0.1, -0.05]],
    "OPENCV": [[-0.25, 0.07, 1e-3, -5e-4], [-0.3, 0.12, 5e-3, 4e-3], [0.1, 0.02, 0.01, 0.01]],
    "FULL_OPENCV": [
        [-0.25, 0.07, 1e-3, -5e-4, -0.01, 0, 0, 0],
        [0.5, 0.1, 1e-3, 1e-3, 0.01, 0.8, 0.2, 0.02],
        [8.0, 5.0, 1e-4, 2e-4, 0.3, 8.5, 8.0, 1.5],
    ],
    "SIMPLE_FISHEYE": [[]],
    "FISHEYE": [[]],
    "SIMPLE_RADIAL_FISHEYE": [[0.02], [-0.1]],
    "RADIAL_FISHEYE": [[0.03, 0.01], [-0.05, -0.02]],
    "OPENCV_FISHEYE": [[0.037, 0.048, -0.038, 0.011], [0.05, -0.01, 0.02, -0.004], [-0.3, 0.02, 0.0, 0.0]],
    "FOV": [[0.3], [0.9], [1.2], [0.0]],
    "THIN_PRISM_FISHEYE": [
        [0.03, 0.01, 1e-3, 2e-3, 2e-3, 1e-3, 1e-3, 2e-3],
        [-0.08, 0.02, 0.01, -8e-3, -4e-3, 1e-3, 0.01, -0.02],
    ],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        [0.03, 0.01, -0.01, 2e-3, 1e-3, -3e-4, 1e-3, 2e-3, 1e-3, 2e-3, 3e-3, -1e-3],
        [0.4, -0.55, 0.35, -0.1, 0.015, -1e-3, -2e-3, 3e-3, 5e-3, -3e-3, 2e-3, 1e-3],
        [-0.1, 0.05, -0.02, 3e-3, 0, 0, 0.02, -0.02, 0.02, 0.01, -0.01, 0.01],
    ],
    "SIMPLE_DIVISION": [[-0.2], [0.1], [0.0]],
    "DIVISION": [[-0.6], [0.3]],
    "EUCM": [[0.6, 1.1], [0.0, 1.0], [1.0, 0.9], [0.5, 1.0], [0.8, 2.0], [0.3, 0.5]],
    "EQUIRECTANGULAR": [[]],
}
CASES = [
    pytest.param(name, lens, id=f"{name}-{i}") for name, all_ in LENSES.items() for i, lens in enumerate(all_)
]
BEYOND = {
    "SIMPLE_DIVISION",
    "DIVISION",
    "EUCM",
}  # we see directions there that COLMAP does not, or not rightly


def colmap_camera(name, lens=(), width=WIDTH, height=HEIGHT):
    camera = pycolmap.Camera.create_from_model_name(1, name, FOCAL, width, height)
    if name != "EQUIRECTANGULAR":
        values = np.array(camera.params)
        for i, at in enumerate(camera.focal_length_idxs()):
            values[at] = FOCAL * (1 + 0.02 * i)
        values[camera.principal_point_idxs()] = [651.3, 349.1]
        values[camera.extra_params_idxs()] = lens
        camera.params = values
    return camera


def row(found, n):
    return np.full(n, np.nan) if found is None else found


def colmap_pixels(camera, directions):
    """pycolmap's pixels, first pixel's centre at (0, 0)."""
    return np.array([row(camera.img_from_cam(d), 2) for d in directions]) - 0.5


def directions_within(angle, seed, n=300):
    """Unit vectors up to an angle from z, evenly over the sphere."""
    rng = np.random.default_rng(seed)
    z = 1 - rng.random(n) * (1 - np.cos(angle))
    turn = rng.uniform(0, 2 * np.pi, n)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1)


def whole_image(camera, n=(49, 28)):
    """Pixels over the whole image with its corners."""
    width, height = camera.resolution
    u, v = np.meshgrid(np.linspace(0, width - 1, n[0]), np.linspace(0, height - 1, n[1]))
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def test_no_model_of_pycolmap_is_forgotten():
    assert set(LENSES) == {name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"}


def test_pycolmap_is_imported_where_it_is_used_only():
    code = "import sys; import acino_fte.data_tools.colmap_cameras; sys.exit('pycolmap' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(("name", "lens"), CASES)
def test_projection_is_that_of_pycolmap(name, lens):
    theirs = colmap_camera(name, lens)
    ours = camera_from_colmap(theirs, "c")
    towards = directions_within(min(0.999 * ours.valid_angle, np.pi), 1)
    points = towards * np.random.default_rng(2).uniform(0.3, 9, (len(towards), 1))
    expected = colmap_pixels(theirs, points)
    pixels = ours.project(points)
    if name in BEYOND:
        front = points[:, 2] > 0
        assert np.isfinite(expected[front]).all()
        points, expected, pixels = points[front], expected[front], pixels[front]
    size = np.maximum(1.0, np.abs(expected) / 1e4)
    assert np.abs((pixels - expected) / size).max() < 1e-8


@pytest.mark.parametrize(("name", "lens"), CASES)
def test_rays_are_those_of_pycolmap_where_these_are_right(name, lens):
    theirs = colmap_camera(name, lens)
    ours = camera_from_colmap(theirs, "c")
    pixels = whole_image(ours, (17, 10))
    expected = np.array([row(theirs.cam_ray_from_img(p + 0.5), 3) for p in pixels])
    seen_again = np.array([row(None if np.isnan(d).any() else theirs.img_from_cam(d), 2) for d in expected])
    right = np.abs(seen_again - 0.5 - pixels).max(axis=1) < 1e-6  # not so beyond 90°, nor of DIVISION
    rays = ours.rays(pixels)
    assert right.any()
    assert np.abs(rays[right] - expected[right]).max() < 1e-8


@pytest.mark.parametrize(("name", "lens"), CASES)
def test_every_pixel_comes_back_or_is_nan(name, lens):
    camera = camera_from_colmap(colmap_camera(name, lens), "c")
    pixels = whole_image(camera)
    rays = camera.rays(pixels)
    known = np.isfinite(rays).all(axis=-1)
    assert known.mean() > 0.2
    assert np.allclose(np.linalg.norm(rays[known], axis=-1), 1.0, rtol=1e-12)
    assert np.abs(camera.project(rays[known]) - pixels[known]).max() < 1e-6
    assert np.isnan(rays[~known]).all()
    ideal = camera.undistort(pixels)
    flat = np.isfinite(ideal).all(axis=-1)
    assert np.array_equal(flat, known & (rays[:, 2] > 0))
    again = camera.project(np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1))
    assert np.abs(again[flat] - pixels[flat]).max() < 1e-6


@pytest.mark.parametrize(("name", "lens"), CASES)
def test_every_direction_within_the_field_comes_back(name, lens):
    camera = camera_from_colmap(colmap_camera(name, lens), "c")
    assert camera.valid_angle > np.radians(40)
    towards = directions_within(0.995 * camera.valid_angle, 3, 1000)
    assert np.abs(camera.rays(camera.project(towards)) - towards).max() < 1e-7


@pytest.mark.parametrize(("name", "lens"), CASES)
def test_derivatives_equal_central_differences(name, lens):
    camera = camera_from_colmap(colmap_camera(name, lens), "c")
    points = 2.0 * directions_within(min(0.9 * camera.valid_angle, 2.6), 4, 60)
    points = np.concatenate([points, [[0.0, 0.0, 2.0], [1e-7, 0.0, 2.0], [0.0, -1e-4, 2.0]]])
    pixels, slope = camera.project_with_jacobian(points)
    assert np.allclose(pixels, camera.project(points), rtol=1e-11)
    numeric = np.empty_like(slope)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        numeric[..., axis] = (camera.project(points + step) - camera.project(points - step)) / 2e-6
    scale = np.maximum(1.0, np.abs(numeric).max(axis=(1, 2), keepdims=True))
    assert np.abs((slope - numeric) / scale).max() < 1e-5


@pytest.mark.parametrize(("name", "lens"), CASES)
def test_the_way_back_to_colmap(name, lens):
    camera = camera_from_colmap(colmap_camera(name, lens), "c")
    written, values = colmap_parameters(camera)
    again = pycolmap.Camera.create_from_model_name(1, written, FOCAL, WIDTH, HEIGHT)
    assert len(again.params) == len(values)
    assert all(type(value) is float for value in values)
    again.params = values
    assert again.verify_params()
    towards = directions_within(min(0.99 * camera.valid_angle, 1.4), 5, 50)
    expected = colmap_pixels(colmap_camera(name, lens), towards)
    assert np.allclose(colmap_pixels(again, towards), expected, rtol=1e-12, atol=1e-9)
    assert np.allclose(camera_from_colmap(again, "c").parameters, camera.parameters, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "lens", "angle"),
    [
        ("DIVISION", [-0.6], 150.0),
        ("EUCM", [0.6, 1.1], 130.0),
        ("EUCM", [0.5, 1.0], 170.0),
        ("EUCM", [0.3, 0.5], 105.0),
        ("EQUIRECTANGULAR", [], 179.9),
    ],
)
def test_behind_the_plane_of_the_image(name, lens, angle):
    camera = camera_from_colmap(colmap_camera(name, lens), "c")
    towards = directions_within(np.radians(angle), 6)
    towards = towards[towards[:, 2] < 0]
    pixels = camera.project(3 * towards)
    assert np.abs(camera.rays(pixels) - towards).max() < 1e-8
    assert np.isnan(camera.undistort(pixels)).all()
    assert np.isnan(camera.back_project(pixels, 1.0)).all()
    if name != "EUCM":  # there pycolmap stops at 90°
        assert np.abs(pixels - colmap_pixels(colmap_camera(name, lens), towards)).max() < 1e-8


@pytest.mark.parametrize(
    ("name", "lens"), [("DIVISION", [0.3]), ("EUCM", [0.6, 1.1]), ("EUCM", [0.2, 1.5]), ("EUCM", [0.0, 1.0])]
)
def test_beyond_the_field_of_a_closed_model_is_nan(name, lens):
    """The angle is that of the formula, and no direction beyond it has a pixel that means another one."""
    camera = camera_from_colmap(colmap_camera(name, lens), "c")
    angle = camera.valid_angle
    near, far = ([np.sin(angle + e), 0.0, np.cos(angle + e)] for e in (-1e-4, 1e-4))
    assert np.isfinite(camera.project(np.array(near))).all()
    assert np.isnan(camera.project(np.array(far))).all()
    assert np.isnan(camera.project_with_jacobian(np.array(far))[1]).all()


@pytest.mark.parametrize(("name", "lens"), [("FOV", [0.9]), ("EUCM", [1.0, 0.9]), ("DIVISION", [2.0])])
def test_pixels_that_no_ray_reaches_are_nan(name, lens):
    camera = camera_from_colmap(colmap_camera(name, lens), "c")
    limit = {"FOV": np.pi / 2 / 0.9, "EUCM": 1 / np.sqrt(0.9), "DIVISION": 1 / np.sqrt(2.0)}[name]
    circle = np.stack([np.cos(np.arange(12.0)), np.sin(np.arange(12.0))], axis=-1) @ camera.matrix[:2, :2]
    for share, known in ((0.999, True), (1.001, False), (3.0, False)):
        rays = camera.rays(camera.matrix[:2, 2] + share * limit * circle)
        assert (np.isfinite(rays) == known).all()


def test_pycolmap_has_the_wrong_sign_for_the_weakest_fov():
    """Below ω = 0.01 COLMAP takes the series of its undistortion for its distortion; we keep the formula."""
    theirs = colmap_camera("FOV", [0.005])
    ours = camera_from_colmap(theirs, "c")
    point = np.array([1.0, 0.5, 1.0])
    r, tangent = np.hypot(1.0, 0.5), 2 * np.tan(0.0025)
    exact = point[:2] * np.arctan(r * tangent) / (r * 0.005)
    assert np.allclose(ours.project(point), ours.matrix[:2, :2] @ exact + ours.matrix[:2, 2], atol=1e-7)
    assert np.abs(ours.project(point) - colmap_pixels(theirs, [point])[0]).max() < 0.02


LARGEST = {
    "pinhole": (0.4, 0.3, 0.02, 0.02, 0.1, 0.4, 0.2, 0.05, 0.01, 0.01, 0.01, 0.01),
    "fisheye": (0.15, 0.1, 0.05, 0.02),
    "thin_prism_fisheye": (0.15, 0.1, 0.03, 0.03, 0.05, 0.02, 0.03, 0.03),
    "rad_tan_thin_prism_fisheye": (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.02, 0.02, 0.02, 0.01, 0.02, 0.01),
    "fov": (1.4,),
    "division": (1.5,),
    "eucm": (1.0, 3.0),
}


@st.composite
def lenses(draw):
    """Cameras with any lens, strong ones too."""
    model = draw(st.sampled_from(list(LARGEST)))
    values = [draw(st.floats(-size, size)) for size in LARGEST[model]]
    if model == "eucm":
        values = [abs(values[0]), 0.1 + abs(values[1])]
    matrix = np.array([[FOCAL, 0, 640.0], [0, FOCAL, 360.0], [0, 0, 1]])
    return Camera("c", model, matrix, values, np.eye(3), np.zeros(3), (WIDTH, HEIGHT))


@settings(max_examples=40)
@given(lenses(), st.integers(0, 1000))
def test_any_lens_within_its_field(camera, seed):
    towards = directions_within(min(0.98 * camera.valid_angle, 2.6), seed, 200)
    pixels = camera.project(towards)
    assert np.isfinite(pixels).all()
    assert np.abs(camera.rays(pixels) - towards).max() < 1e-6


@settings(max_examples=40)
@given(lenses(), st.sampled_from([0.3, 1.0, 3.0]))
def test_any_lens_is_right_or_nan_over_the_whole_image(camera, zoom):
    """Zoomed out, so that most of the image is beyond the fold."""
    matrix = np.diag([zoom * FOCAL, zoom * FOCAL, 1.0])
    matrix[:2, 2] = 640, 360
    camera = Camera("c", camera.model, matrix, camera.distortion, np.eye(3), np.zeros(3), (WIDTH, HEIGHT))
    pixels = whole_image(camera)
    rays = camera.rays(pixels)
    known = np.isfinite(rays).all(axis=-1)
    again, slope = camera.project_with_jacobian(rays[known])
    assert np.abs(again - pixels[known]).max(initial=0.0) < 1e-6
    handed = np.einsum("ni,ni->n", np.cross(slope[:, 0], slope[:, 1]), rays[known])
    assert (handed > 0).all()  # no mirrored image


def test_tangential_terms_that_dominate():
    """The fold of the quadratic terms is a parabola's: the far side of it must not be taken for the near."""
    matrix = np.array([[FOCAL, 0, 640.0], [0, FOCAL, 360.0], [0, 0, 1]])
    lens = [0.0, 0.0, 0.1, 0.0]
    camera = Camera("c", "pinhole", matrix, lens, np.eye(3), np.zeros(3), (WIDTH, HEIGHT))
    pixels = whole_image(camera)
    ideal = camera.undistort(pixels)
    known = np.isfinite(ideal).all(axis=-1)
    assert 0.5 < known.mean() < 1
    a, b = ideal[known].T
    assert ((1 + 0.2 * b) * (1 + 0.6 * b) > (0.2 * a) ** 2).all()  # the determinant, on the axis' side
    assert (1 + 0.2 * b > 0).all()
    for b, found in ((-1.65, -1.65), (-1.70, -1 / 0.3 + 1.70)):  # b' = b + 0.3 b² folds at b = −1/0.6
        seen = camera.project(np.array([0.0, b, 1.0]))
        assert np.allclose(camera.undistort(seen), [0.0, found], atol=1e-7)


@pytest.mark.parametrize("name", ["EQUIRECTANGULAR", "DIVISION", "EUCM", "FOV", "THIN_PRISM_FISHEYE"])
def test_moving_cameras_of_every_kind(name):
    from scipy.spatial.transform import Rotation

    fixed = camera_from_colmap(colmap_camera(name, LENSES[name][0]), "c")
    rng = np.random.default_rng(7)
    rotation = Rotation.from_rotvec(rng.normal(0, 1, (40, 3))).as_matrix()
    translation = rng.normal(0, 1, (40, 3))
    moving = Camera("c", fixed.model, fixed.matrix, fixed.distortion, rotation, translation, fixed.resolution)
    local = directions_within(min(0.9 * fixed.valid_angle, 2.5), 8, 40) * rng.uniform(1, 9, (40, 1))
    world = np.einsum("nji,nj->ni", rotation, local - translation)[:, None]
    pixels, slope = moving.project_with_jacobian(world)
    expected, local_slope = fixed.project_with_jacobian(local)
    assert np.allclose(pixels[:, 0], expected, atol=1e-8)
    assert np.allclose(slope[:, 0], local_slope @ rotation, rtol=1e-8, atol=1e-7)
    way = world - moving.centre[:, None]
    assert np.allclose(moving.rays(pixels), way / np.linalg.norm(way, axis=-1, keepdims=True), atol=1e-8)


def test_panorama():
    camera = camera_from_colmap(colmap_camera("EQUIRECTANGULAR", width=2000, height=1000), "c")
    points = np.array(
        [[0, 0, 1.0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 0], [np.nan, 0, 1], [0, np.nan, 1]]
    )
    pixels = camera.project(points)
    assert np.allclose(pixels[:3], [[999.5, 499.5], [1499.5, 499.5], [499.5, 499.5]])
    assert pixels[3, 1] == pytest.approx(999.5)
    assert np.isnan(pixels[4:]).all()
    left, right = camera.project(np.array([[-1e-3, 0.2, -1.0], [1e-3, 0.2, -1.0]]))
    assert camera.inside(np.stack([left, right])).all()
    assert right[0] - left[0] > 1990
    assert np.abs(camera.pixel_difference(right, left)).max() < 1
    assert np.isnan(camera.rays(np.array([[2010.0, 500.0], [500.0, 1010.0], [np.nan, 1.0]]))).all()
    corners = np.array([[-0.5, -0.5], [1999.5, 999.5]])
    assert np.isfinite(camera.rays(corners)).all()


def test_differences_of_other_cameras_are_plain():
    camera = camera_from_colmap(colmap_camera("FOV", [0.9]), "c")
    assert camera.pixel_difference(np.array([1270.0, 5]), np.array([3.0, 9])).tolist() == [1267, -4]


def named(name, params, info="fx, fy, cx, cy"):
    return SimpleNamespace(model_name=name, params=params, params_info=info, width=WIDTH, height=HEIGHT)


def test_a_model_of_the_future():
    with pytest.raises(InputError, match="does not know") as error:
        camera_from_colmap(named("DOUBLE_SPHERE", [1.0]), "gate")
    assert "gate" in error.value.problem
    assert all(name in error.value.expected for name in LENSES)
    assert "DOUBLE_SPHERE" in error.value.found


def test_parameters_that_cannot_be():
    with pytest.raises(InputError, match="wrong number of parameters") as error:
        camera_from_colmap(named("PINHOLE", [1.0, 2.0]), "gate")
    assert error.value.expected.startswith("4 for PINHOLE: fx")
    assert error.value.found == "2"
    with pytest.raises(InputError, match="gate"):
        camera_from_colmap(named("PINHOLE", [-500.0, 500, 640, 360]), "gate")
    with pytest.raises(InputError, match="gate"):
        camera_from_colmap(named("PINHOLE", [500.0, np.nan, 640, 360]), "gate")


@pytest.mark.parametrize(
    ("model", "lens", "expected"),
    [
        ("fov", [3.2], "ω"),
        ("eucm", [1.2, 1.0], "α"),
        ("eucm", [0.5, 0.0], "β"),
        ("division", [], "1 coefficients"),
        ("equirectangular", [0.1], "0 coefficients"),
    ],
)
def test_lenses_that_cannot_be(model, lens, expected):
    with pytest.raises(InputError, match="Camera 'gate' cannot be used") as error:
        Camera("gate", model, np.diag([500.0, 500, 1]), lens, np.eye(3), np.zeros(3), (WIDTH, HEIGHT))
    assert error.value.key == "distortion"
    assert expected in error.value.expected


def test_cameras_that_colmap_has_not():
    matrix = np.array([[500.0, 0, 640], [0, 500, 360], [0, 0, 1]])
    pose = (np.eye(3), np.zeros(3), (WIDTH, HEIGHT))
    prism = Camera("gate", "pinhole", matrix, [0.0] * 8 + [1e-3, 0, 0, 0], *pose)
    cut = Camera("gate", "equirectangular", matrix, [], *pose)
    skewed = ProjectiveCamera("gate", matrix, *pose)
    for camera, found in ((prism, "thin-prism"), (cut, "cut or turned"), (skewed, "'projective'")):
        with pytest.raises(InputError, match="'gate' is of no model that COLMAP has") as error:
            colmap_parameters(camera)
        assert found in error.value.found
    assert colmap_parameters(Camera("gate", "pinhole", matrix, [0.1, 0, 0, 0, 0.2], *pose)) == (
        "FULL_OPENCV",
        [500, 500, 640.5, 360.5, 0.1, 0, 0, 0, 0.2, 0, 0, 0],
    )
    assert (
        colmap_parameters(Camera("gate", "pinhole", matrix, [0.1] * 8 + [0.0] * 4, *pose))[0] == "FULL_OPENCV"
    )


def test_models_with_a_formula_back_and_without():
    assert set(CLOSED) | set(LARGEST) == set(COEFFICIENTS)
