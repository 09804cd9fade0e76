"""Names of images to cameras and frames, cameras with key frames, and how well their poses are known."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from data_tools_synthetic import message
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera
from acino_fte.data_tools.colmap import ColmapModel, read_colmap
from acino_fte.data_tools.colmap_covariance import (
    mended,
    pose_errors,
    pose_slope,
    residual_noise,
    residuals,
)
from acino_fte.data_tools.colmap_images import ImageFrames, keyed_cameras, parse_image_names
from acino_fte.data_tools.point_cloud import PointCloud
from acino_fte.data_tools.similarity import Similarity

RIGS = [Path(__file__).resolve().parents[2] / "shared" / "data" / n for n in ("mvt_rig", "mvt_rig_fisheye")]
LENSES = {
    "pinhole": ([900.0, 910.0, 640.0, 355.0], [-0.1, 0.02, 1e-3, -5e-4, 0.01]),
    "fisheye": ([700.0, 705.0, 630.0, 365.0], [0.03, -0.01, 0.002, 0.0]),
}

# ---------------------------------------------------------------------------------- names


def read(names, pattern=None) -> list[tuple[str, int]]:
    parsed = parse_image_names(names, pattern)
    return list(zip(parsed.camera, parsed.frame.tolist(), strict=True))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["i_0_cut_000008.jpg", "cam_12.png"], [("i_0_cut", 8), ("cam", 12)]),
        (["cam2/000123.png", "cam10/000123.png"], [("cam2", 123), ("cam10", 123)]),
        (["cam0/frame_000123.png", "cam1/frame_7.png"], [("cam0", 123), ("cam1", 7)]),
        (["cam0/images/12.jpg", "cam1/images/12.jpg"], [("cam0", 12), ("cam1", 12)]),
        (["day/cam0/12.jpg", "day/cam1/12.jpg"], [("cam0", 12), ("cam1", 12)]),
        (["left/GX01_5.jpg", "right/GX02_5.jpg"], [("left", 5), ("right", 5)]),
        (["images/a_1.jpg", "images/b_1.jpg"], [("a", 1), ("b", 1)]),
        (["left/a_1.jpg", "left/b_2.jpg", "right/c_1.jpg"], [("a", 1), ("b", 2), ("c", 1)]),
        (["1/a_1.jpg", "1/b_1.jpg", "2/a_1.jpg"], [("1/a", 1), ("1/b", 1), ("2/a", 1)]),
        (["a_1.jpg", "more/a_2.jpg"], [("a", 1), ("a", 2)]),
        (["PREFIX-000123.jpg", "PREFIX-000124.jpg"], [("PREFIX", 123), ("PREFIX", 124)]),
        (["PREFIX000123.jpg", "IMG_0124.jpg"], [("PREFIX", 123), ("IMG", 124)]),
        (["cam1_000123.jpg"], [("cam1", 123)]),
        (["000123.jpg"], [("camera", 123)]),
        (["north/000123.jpg"], [("north", 123)]),
        (["clip.mp4_0001.jpg"], [("clip.mp4", 1)]),
        (["./a/1", "./b/1"], [("a", 1), ("b", 1)]),
    ],
)
def test_names_without_a_pattern(names, expected):
    assert read(names) == expected


@pytest.mark.parametrize(
    ("pattern", "name", "expected"),
    [
        ("{camera}_{frame}.jpg", "a_b_12.jpg", ("a_b", 12)),
        ("{camera}_{frame}.jpg", "folder/a_12.jpg", ("a", 12)),
        ("{camera}/frame{frame}.png", "cam1/frame12.png", ("cam1", 12)),
        ("*/{camera}/*_{frame}.*", "x/cam1/rgb_3_012.png", ("cam1", 12)),
        ("**/{camera}/{frame}.*", "x/y/cam1/012.png", ("cam1", 12)),
        ("{camera}{frame}.png", "cam12.png", ("cam", 12)),
        ("*{frame}*.png", "a-12-b.png", ("camera", 12)),
        ("GX01{frame}.png", "GX010012.png", ("camera", 12)),
        ("{camera}/{camera}_{frame}.png", "c/c_1.png", ("c", 1)),
        ("{frame}(?).{camera}", "7(x).a+b", ("a+b", 7)),
        (r"re:t(?P<frame>-?\d+)/(?P<camera>\w+)\.png", "t-3/c.png", ("c", -3)),
    ],
)
def test_patterns(pattern, name, expected):
    assert read([name], pattern) == [expected]


def test_names_that_do_not_fit_are_shown():
    error = message(parse_image_names, ["a_1.jpg", *(f"{c}.jpg" for c in "bcdef")])
    assert "5 of 6" in error.problem and error.found == "'b.jpg', 'c.jpg', 'd.jpg', …"
    assert "{camera}_{frame}" in error.remedy
    error = message(
        parse_image_names, ["a_1.jpg", "a-2.jpg", "a_12345678901234567890.jpg"], "{camera}_{frame}.jpg"
    )
    assert "2 of 3" in error.problem and "'a-2.jpg'" in error.found and "{camera}_{frame}.jpg" in error.key
    error = message(parse_image_names, ["c/c_1.png", "c/d_1.png"], "{camera}/{camera}_{frame}.png")
    assert error.found == "'c/d_1.png'"


def test_two_images_of_one_frame_are_named():
    error = message(parse_image_names, ["a_01.jpg", "b_1.jpg", "a_1.jpg"])
    assert "'a_01.jpg' and 'a_1.jpg'" in error.found and "frame 1 of camera 'a'" in error.problem
    message(parse_image_names, ["x/1.jpg", "y/1.jpg"], "*/{frame}.jpg")


@pytest.mark.parametrize("pattern", ["{camera}.jpg", "{cam}_{frame}.jpg", "re:(", r"re:(?P<camera>\d+)", ""])
def test_wrong_patterns(pattern):
    assert f"'{pattern}'" in message(parse_image_names, ["a_1.jpg"], pattern).problem


def test_cameras_come_in_natural_order():
    assert parse_image_names([f"cam{i}_1.jpg" for i in (10, 2, 1)]).cameras == ("cam1", "cam2", "cam10")


# ---------------------------------------------------------------------------------- cameras


def lens(kind="pinhole", change=0.0, size=(1280, 720)) -> Camera:
    (fx, fy, cx, cy), distortion = LENSES[kind]
    matrix = np.array([[fx + change, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Camera("c", kind, matrix, np.array(distortion), np.eye(3), np.zeros(3), size)


def model(
    n_images=8, n_points=60, seed=0, cameras=None, camera_ids=None, names=None, noise_px=0.0
) -> ColmapModel:
    """Cameras that look at a cloud from about 5 away; most points are seen by most."""
    rng = np.random.default_rng(seed)
    cameras = cameras or {1: lens()}
    camera_ids = np.full(n_images, 1) if camera_ids is None else np.asarray(camera_ids)
    rotation = Rotation.from_rotvec(rng.normal(0, 0.3, (n_images, 3))).as_matrix()
    translation = np.array([0, 0, 5.0]) + rng.normal(0, 0.3, (n_images, 3))
    image, point = np.nonzero(rng.random((n_images, n_points)) < 0.8)
    empty = ColmapModel(
        path=Path("model"),
        cameras=cameras,
        image_ids=np.arange(n_images),
        names=tuple(names or (f"cam_{i:04d}.jpg" for i in range(n_images))),
        camera_ids=camera_ids,
        rotation=rotation,
        translation=translation,
        cloud=PointCloud(rng.uniform(-1, 1, (n_points, 3))),
        observed_image=image,
        observed_point=point,
        observed_xy=np.zeros((len(image), 2)),
    )
    seen = -residuals(empty)
    return replace(empty, observed_xy=seen + noise_px * rng.normal(size=seen.shape))


def test_keyed_cameras():
    names = ["b_0002.jpg", "a_0005.jpg", "b_0001.jpg", "a_0001.jpg"]
    m = model(4, cameras={1: lens(), 7: lens("fisheye")}, camera_ids=[7, 1, 7, 1], names=names)
    covariance = np.arange(4 * 36, dtype=float).reshape(4, 6, 6)
    a, b = keyed_cameras(m, parse_image_names(names), covariance)
    assert (a.name, a.model_id, a.lens.name, a.lens.model) == ("a", 1, "a", "pinhole")
    assert (b.name, b.model_id, b.lens.model) == ("b", 7, "fisheye")
    np.testing.assert_array_equal(a.frame, [1, 5])
    np.testing.assert_array_equal(b.frame, [1, 2])
    for camera, rows in ((a, [3, 1]), (b, [2, 0])):
        np.testing.assert_array_equal(camera.rotation, m.rotation[rows])
        np.testing.assert_array_equal(camera.translation, m.translation[rows])
        np.testing.assert_array_equal(camera.covariance, covariance[rows])
    assert all(c.covariance is None for c in keyed_cameras(m, parse_image_names(names)))


def test_one_lens_for_two_prefixes():
    """MultiViewTracks fails here."""
    names = ["a_1.jpg", "a_2.jpg", "b_1.jpg", "b_2.jpg"]
    cameras = keyed_cameras(model(4, names=names), parse_image_names(names))
    assert [(c.name, c.model_id, len(c.frame)) for c in cameras] == [("a", 1, 2), ("b", 1, 2)]


def test_a_lens_for_each_image():
    names = ["a_1.jpg", "a_2.jpg"]
    build = partial(model, 2, camera_ids=[1, 2], names=names)
    frames = parse_image_names(names)
    (camera,) = keyed_cameras(build(cameras={1: lens(), 2: lens(change=1e-5)}), frames)
    assert camera.model_id == 1
    for other in (lens(change=0.1), lens("fisheye"), lens(size=(640, 360))):
        error = message(keyed_cameras, build(cameras={1: lens(), 2: other}), frames)
        assert "'a_1.jpg'" in error.found and "'a_2.jpg'" in error.found and "single_camera" in error.remedy


# ---------------------------------------------------------------------------------- how well poses are known


def moved_pose(m: ColmapModel, error: np.ndarray) -> ColmapModel:
    """The model with its poses changed: turns in the cameras' frames, shifts of the centres (I, 6)."""
    rotation = Rotation.from_rotvec(error[:, :3]).as_matrix() @ m.rotation
    centre = -np.einsum("nji,nj->ni", m.rotation, m.translation) + error[:, 3:]
    return replace(m, rotation=rotation, translation=-np.einsum("nij,nj->ni", rotation, centre))


def nees(error: np.ndarray, covariance: np.ndarray) -> float:
    """Mean of eᵀ C⁻¹ e over its six freedoms; 1 where the covariance is right."""
    return float(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)) / 6)


@pytest.mark.parametrize("kind", LENSES)
def test_derivatives_for_the_pose(kind):
    m = model(cameras={1: lens(kind)})
    i = m.observed_image
    camera = replace(m.cameras[1], rotation=m.rotation[i], translation=m.translation[i])
    slope = pose_slope(camera, m.cloud.xyz[m.observed_point])
    step = 1e-6
    for j in range(6):
        change = np.zeros((len(m.names), 6))
        change[:, j] = step
        up, down = residuals(moved_pose(m, change)), residuals(moved_pose(m, -change))
        np.testing.assert_allclose(slope[:, :, j], (down - up) / (2 * step), rtol=1e-6, atol=1e-4)


def adjusted(m: ColmapModel) -> ColmapModel:
    """Each pose where SciPy finds the least squares of its residuals, with the points as they are."""

    def cost(errors: np.ndarray) -> np.ndarray:
        return residuals(moved_pose(m, errors.reshape(-1, 6))).ravel()

    def slope(errors: np.ndarray) -> np.ndarray:
        at = moved_pose(m, errors.reshape(-1, 6))
        base, out = residuals(at), np.zeros((len(m.observed_image), 2, len(m.names), 6))
        for j in range(6):
            change = np.zeros((len(m.names), 6))
            change[:, j] = 1e-6
            out[np.arange(len(base)), :, m.observed_image, j] = (
                residuals(moved_pose(at, change)) - base
            ) / 1e-6
        return out.reshape(base.size, -1)

    return moved_pose(
        m, least_squares(cost, np.zeros(6 * len(m.names)), slope, method="trf").x.reshape(-1, 6)
    )


def errors(found: ColmapModel, true: ColmapModel) -> np.ndarray:
    """What takes the found poses to the true ones, (I, 6)."""
    turn = Rotation.from_matrix(true.rotation @ found.rotation.swapaxes(1, 2)).as_rotvec()
    centre = [-np.einsum("nji,nj->ni", m.rotation, m.translation) for m in (true, found)]
    return np.concatenate([turn, centre[0] - centre[1]], axis=1)


@pytest.mark.parametrize("kind", LENSES)
def test_poses_that_were_adjusted(kind):
    """Against the truth: poses of least residuals err as their covariance says."""
    true = model(60, 15, seed=3, cameras={1: lens(kind)}, noise_px=0.7)
    found = adjusted(true)
    result = pose_errors(found)
    assert result.adjusted and mended(found, result) is found
    # the points are exact here, but counted as estimated: 3 freedoms each too many
    counted = 2 * len(true.observed_xy) - 6 * 60
    exact = result.noise_px * np.sqrt((counted - 3 * 15 + 7) / counted)
    assert exact == pytest.approx(0.7, rel=0.06)
    assert nees(errors(found, true), result.covariance * (0.7 / result.noise_px) ** 2) == pytest.approx(
        1, rel=0.15
    )
    assert 0.8 < nees(errors(found, true), result.covariance) < 1.3


@pytest.mark.parametrize("kind", LENSES)
@pytest.mark.parametrize("gross", [0.0, 0.03])
def test_poses_from_elsewhere(kind, gross):
    """Poses that no adjustment left: their error is found from the steps that would mend them."""
    rng = np.random.default_rng(5)
    true = model(300, 25, seed=4, cameras={1: lens(kind)}, noise_px=0.5)
    sizes = np.array([2e-3, 8e-3])
    found = moved_pose(true, rng.normal(0, np.repeat(sizes, 3), (300, 6)))
    wild = rng.random(len(found.observed_xy)) < gross
    found.observed_xy[wild] += rng.normal(0, 60, (wild.sum(), 2))
    result = pose_errors(found)
    assert not result.adjusted
    sd = np.sqrt(np.diagonal(result.covariance[0]))
    np.testing.assert_allclose(sd, np.repeat(sizes, 3), rtol=0.12)
    assert 0.8 < nees(errors(found, true), result.covariance) < 1.3
    assert result.noise_px == pytest.approx(0.5, rel=0.15)
    better = errors(mended(found, result), true)
    assert nees(better, result.after_step) == pytest.approx(1.0, abs=0.25)
    assert (better.std(0) < 0.8 * errors(found, true).std(0)).all()


def test_a_few_gross_poses_do_not_spoil_the_others():
    rng = np.random.default_rng(6)
    true = model(300, 25, seed=4, noise_px=0.5)
    error = rng.normal(0, np.repeat([2e-3, 8e-3], 3), (300, 6))
    error[7::30] *= 4.5
    result = pose_errors(moved_pose(true, error))
    sd = np.sqrt(np.diagonal(result.covariance[0]))
    np.testing.assert_allclose(sd, np.repeat([2e-3, 8e-3], 3), rtol=0.15)


def test_poses_that_are_a_little_off_their_minimum():
    """As a robust loss or a rounded file leaves them: the covariance grows by as much."""
    rng = np.random.default_rng(7)
    true = adjusted(model(60, 25, seed=4, noise_px=0.5))
    small = pose_errors(true)
    half = np.linalg.cholesky(small.covariance)
    off = pose_errors(moved_pose(true, np.einsum("nij,nj->ni", half, rng.normal(0, 1.6, (60, 6)))))
    assert small.adjusted and off.adjusted
    growth = np.trace(off.covariance, axis1=1, axis2=2) / np.trace(small.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(growth / (off.noise_px / small.noise_px) ** 2, 1.6**2, rtol=0.25)


def test_noise_counts_freedoms_and_not_outliers():
    rng = np.random.default_rng(2)
    m = model(40, 200, noise_px=0.8)
    wild = rng.random(len(m.observed_xy)) < 0.03
    m.observed_xy[wild] += rng.normal(0, 50, (wild.sum(), 2))
    n = 2 * len(m.observed_xy)
    expected = 0.8 * np.sqrt(n / (n - 6 * 40 - 3 * 200 + 7))
    assert residual_noise(m) == pytest.approx(expected, rel=0.05)


def test_covariances_move_with_the_world():
    """A similarity of the model is one of the covariances, and no pixel changes."""
    m = adjusted(model(5, 40, noise_px=0.5))
    change = Similarity(2.5, Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix(), np.array([3.0, -2.0, 7.0]))
    rotation, translation = change.poses(m.rotation, m.translation)
    other = replace(m, rotation=rotation, translation=translation, cloud=m.cloud.moved(change))
    expected = change.pose_covariance(pose_errors(m).covariance)
    scale = np.sqrt(np.einsum("nii->ni", expected))
    got = pose_errors(other).covariance / scale[:, :, None] / scale[:, None]
    np.testing.assert_allclose(got, expected / scale[:, :, None] / scale[:, None], rtol=0, atol=1e-7)


def test_images_whose_observations_do_not_fix_the_pose():
    m = model(20, 30, noise_px=0.5)
    few = (m.observed_image == 3) & (np.cumsum(m.observed_image == 3) > 4)
    line = m.observed_image == 6  # all observations of one point
    point = np.where(line, m.observed_point[line][0], m.observed_point)
    xy = np.where(line[:, None], m.observed_xy[line][0], m.observed_xy)
    m = replace(m, observed_point=point, observed_xy=xy)
    m = replace(m, **{k: getattr(m, k)[~few] for k in ("observed_image", "observed_point", "observed_xy")})
    known = np.isfinite(pose_errors(m).covariance).all(axis=(1, 2))
    np.testing.assert_array_equal(np.flatnonzero(~known), [3, 6])
    values = np.linalg.eigvalsh(pose_errors(m).covariance[known])
    assert (values > 0).all()


def test_models_without_observations():
    m = model(4)
    none = {key: getattr(m, key)[:0] for key in ("observed_image", "observed_point", "observed_xy")}
    result = pose_errors(replace(m, **none))
    assert result.covariance.shape == (4, 6, 6) and np.isnan(result.covariance).all()
    assert np.isnan(result.noise_px)
    scarce = {key: getattr(m, key)[:20] for key in none}  # fewer numbers than freedoms
    assert np.isnan(pose_errors(replace(m, **scarce)).covariance).all()


def test_models_without_noise():
    """The residuals are what floating point leaves."""
    m = model()
    result = pose_errors(m)
    assert result.adjusted and result.noise_px < 1e-9
    assert (np.diagonal(result.covariance, axis1=1, axis2=2) < 1e-20).all()
    exact = replace(m, observed_xy=m.observed_xy - residuals(m))
    assert np.isfinite(pose_errors(exact).covariance).all()


@pytest.mark.parametrize("folder", RIGS, ids=lambda p: p.name)
def test_rigs_of_mvt_know_their_noise(folder):
    """2 mm and 0.03° on each axis were put on the poses."""
    pytest.importorskip("pycolmap")
    if not folder.is_dir():
        pytest.skip(f"shared/data/{folder.name} is absent")
    m = read_colmap(folder)
    frames = parse_image_names(m.names)
    truth = true_poses(m, frames, folder)
    result = pose_errors(m)
    scale = json.loads((folder / "scene.json").read_text())["s"]
    sd = np.sqrt(np.diagonal(result.covariance[0]))
    np.testing.assert_allclose(np.degrees(sd[:3]), 0.03, rtol=0.1)
    np.testing.assert_allclose(sd[3:] / scale, 0.002, rtol=0.1)
    assert 0.9 < nees(errors(m, truth), result.covariance) < 1.15
    better = errors(mended(m, result), truth)
    assert 0.85 < nees(better, result.after_step) < 1.15
    assert (better.std(0) < 0.72 * errors(m, truth).std(0)).all()


def true_poses(m: ColmapModel, frames: ImageFrames, folder: Path) -> ColmapModel:
    """The model with the true poses, in its own gauge."""
    scene = json.loads((folder / "scene.json").read_text())
    rig = pd.read_csv(folder / "gt_rig.csv").set_index("frame").loc[frames.frame]
    sensor = pd.read_csv(folder / "gt_sensors.csv").set_index("name").loc[list(frames.camera)]
    quaternion, centre = ["qx", "qy", "qz", "qw"], ["cx", "cy", "cz"]
    turned, within = Rotation.from_quat(rig[quaternion].values), Rotation.from_quat(sensor[quaternion].values)
    gauge = np.array(scene["Rg"])
    place = rig[centre].values + turned.inv().apply(sensor[centre].values)
    place = scene["s"] * (place - np.array(scene["c"])) @ gauge.T
    rotation = (within * turned).as_matrix() @ gauge.T
    return replace(m, rotation=rotation, translation=-np.einsum("nij,nj->ni", rotation, place))
