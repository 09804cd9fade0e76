"""Visual odometry: simulated pictures and points, KITTI, the model, failures; a sensor's mounting."""

import functools
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")

import cv2

from acino_fte.cameras import Camera
from acino_fte.data_tools.camera_motion import CameraMotion, bridged, camera_with_motion
from acino_fte.data_tools.imu import gyro_attitude
from acino_fte.data_tools.imu_camera import Mounting, find_mounting, motion_from_attitude
from acino_fte.data_tools.odometry import OdometryOptions, visual_odometry
from acino_fte.data_tools.odometry_features import keypoint_boxes
from acino_fte.data_tools.odometry_pairs import information_criterion, sampson, step_between, turn_between
from acino_fte.data_tools.recording import ImuSamples
from acino_fte.data_tools.rotations import rotation_matrix, rotation_vector
from acino_fte.errors import InputError

KITTI = Path(__file__).resolve().parents[2] / "shared" / "data" / "kitti_vo"
SIZE, FOCAL = (320, 240), 400.0
K = np.array([[FOCAL, 0, 160.0], [0, FOCAL, 120], [0, 0, 1]])
LENS = Camera("c", "pinhole", K, np.zeros(0), np.eye(3), np.zeros(3), SIZE)
QUICK = OdometryOptions(most_features=500)


def transposed(matrix):
    return np.swapaxes(matrix, -1, -2)


def degrees(a, b):
    return np.degrees(np.linalg.norm(rotation_vector(a @ transposed(b)), axis=-1))


@functools.cache
def texture(seed=0, shape=(600, 1100)):
    """Blobs of many sizes, grey."""
    rng = np.random.default_rng(seed)
    out = np.zeros(shape, np.float32)
    for size in (2, 4, 9, 20):
        layer = cv2.GaussianBlur(rng.normal(0, 1, shape).astype(np.float32), (0, 0), size)
        out += layer / layer.std()
    return np.clip(128 + 30 * out, 0, 255).astype(np.uint8)


def panned(vectors, seed=0):
    """Pictures of a camera that turns by rotation vectors (N, 3) from looking at the middle of a texture."""
    wall = texture(seed)
    far = np.array([[FOCAL, 0, 550.0], [0, FOCAL, 300], [0, 0, 1]])
    rotation = rotation_matrix(np.asarray(vectors, dtype=float))
    warps = [K @ r @ np.linalg.inv(far) for r in rotation]  # the homography K R K⁻¹ of a turn alone
    rng = np.random.default_rng(seed + 1)
    noisy = [
        cv2.warpPerspective(wall, w, SIZE, flags=cv2.INTER_CUBIC) + rng.normal(0, 2, SIZE[::-1])
        for w in warps
    ]
    return [np.clip(p, 0, 255).astype(np.uint8) for p in noisy], rotation


def pan(n=10):
    s = np.linspace(0, 1, n)[:, None]
    return np.hstack([0.08 * np.sin(5 * s), 0.5 * s - 0.2, 0.03 * s])


@pytest.fixture(scope="module")
def panning():
    return panned(pan())


@pytest.fixture(scope="module")
def found(panning):
    return visual_odometry(panning[0], LENS, options=QUICK)


def points(seed=0, n=200, noise=0.5, parallax=True, outliers=0.1):
    """Matches of two pictures, normalised coordinates, with noise in px, and the true turn and step."""
    rng = np.random.default_rng(seed)
    rotation = rotation_matrix(rng.normal(0, 0.05, 3))
    step = rng.normal(0, 1, 3)
    step *= 0.5 / np.linalg.norm(step) * parallax
    place = np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(5, 15, n)])
    moved = place @ rotation.T + step
    a, b = (p[:, :2] / p[:, 2:] + rng.normal(0, noise / FOCAL, (n, 2)) for p in (place, moved))
    wrong = rng.random(n) < outliers
    b[wrong] += rng.uniform(-0.2, 0.2, (wrong.sum(), 2))
    return a, b, rotation, step, wrong


def test_a_pan_is_followed(panning, found):
    true = panning[1] @ panning[1][0].T
    error = degrees(found.rotation, true)
    assert error.max() < 0.03 and found.known.all()
    assert found.numbers["model"] == "rotation" and found.scale_known and not found.levelled
    assert not found.centre.any()
    nees = np.radians(error[1:]) ** 2 / (3 * found.rotation_sd[1:] ** 2)
    assert nees.mean() < 4  # features of rendered pictures err together, so it is more than one


def test_smaller_pictures_of_the_same_view(panning):
    """The camera file is of 640 × 480 px, the pictures are of half that."""
    large = np.diag([2.0, 2.0, 1.0]) @ K
    large[:2, 2] += 0.5  # centres of pixels are at integers
    lens = Camera("c", "pinhole", large, np.zeros(0), np.eye(3), np.zeros(3), (640, 480))
    found = visual_odometry(panning[0][:3], lens, model="rotation", options=QUICK)
    assert degrees(found.rotation, panning[1][:3] @ panning[1][0].T).max() < 0.03
    with pytest.raises(InputError, match="not of this camera"):
        visual_odometry([p[:200] for p in panning[0]], lens, options=QUICK)


def test_deep_colours(panning):
    deep = [np.repeat(p[..., None], 3, axis=2).astype(np.uint16) * 200 for p in panning[0][:3]]
    found = visual_odometry(deep, LENS, model="rotation", options=QUICK)
    assert degrees(found.rotation, panning[1][:3] @ panning[1][0].T).max() < 0.03


def test_uncertainty_of_turns_and_steps():
    """Over many pairs of pictures, errors are as large as their covariance says; outliers are found."""
    turns, steps, ways = [], [], []
    for seed in range(12):
        a, b, rotation, _, wrong = points(seed, parallax=False)
        view = turn_between(a, b, 2 / FOCAL)
        error = rotation_vector(rotation @ view.rotation.T)
        turns.append(error @ np.linalg.solve(view.covariance, error) / 3)
        assert not view.inliers[wrong].all() and view.inliers[~wrong].mean() > 0.95
        a, b, rotation, step, _ = points(seed)
        view = step_between(a, b, 2 / FOCAL)
        error = rotation_vector(rotation @ view.rotation.T)
        steps.append(error @ np.linalg.solve(view.covariance, error) / 3)
        off = np.arccos(np.clip(view.direction @ step / np.linalg.norm(step), -1, 1))
        ways.append(off**2 / (2 * view.direction_sd**2))
    assert 0.6 < np.mean(turns) < 1.5
    assert 0.6 < np.median(steps) / 0.79 < 1.5 and 0.5 < np.median(ways) / 0.69 < 1.5  # medians of χ²/dof
    assert np.sum(np.array(steps) > 6) <= 2  # wrong motions: weak parallax and wild outliers


def test_sampson_against_opencv():
    a, b, rotation, step, _ = points(1)
    x, y, z = step
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    u, v = (np.column_stack([p, np.ones(len(p))]) for p in (a, b))
    expected = [cv2.sampsonDistance(u[i].reshape(3, 1), v[i].reshape(3, 1), essential) for i in range(20)]
    np.testing.assert_allclose(sampson(u, v, rotation, step)[:20] ** 2, expected, rtol=1e-9)


def test_the_criterion_tells_the_models():
    for parallax in (False, True):
        totals = np.zeros(2)
        for seed in range(4):
            a, b, *_ = points(seed, parallax=parallax)
            views = turn_between(a, b, 2 / FOCAL), step_between(a, b, 2 / FOCAL)
            totals += information_criterion(*views, len(a))
        assert (totals[0] < totals[1]) != parallax


class World:
    """Textured walls at several depths, seen by a camera that moves: pictures with parallax."""

    def __init__(self, n=6):
        s = np.arange(n)
        self.rotation = rotation_matrix(np.column_stack([0.01 * s, 0.015 * s, 0.005 * s]))
        lengths = np.array([0, 0.3, 0.3, 0.45, 0.3, 0.6, 0.3])[:n]
        way = np.column_stack([0.8 + 0.1 * np.sin(s), 0.1 * np.cos(s), 0.5 + 0 * s])
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        self.centre = np.cumsum(lengths[:, None] * way, axis=0)
        self.pictures = [self.seen(n) for n in range(n)]

    def seen(self, n):
        out = np.zeros(SIZE[::-1], np.uint8)
        for i, (depth, left, right) in enumerate([(14, -20, 20), (9, -20, -0.4), (7, 1.2, 20)]):
            wall = texture(10 + i)
            share = 0.016 * depth / 9
            plane = np.array([[share, 0, -550 * share], [0, share, -300 * share], [0, 0, depth]])
            move = self.rotation[n] @ (plane - np.outer(self.centre[n], [0, 0, 1]))
            mask = np.zeros(wall.shape, np.uint8)
            columns = (np.arange(wall.shape[1]) - 550) * share
            mask[:, (columns > left) & (columns < right)] = 255
            warped, over = (cv2.warpPerspective(p, K @ move, SIZE) for p in (wall, mask))
            out[over > 127] = warped[over > 127]
        return out


@pytest.fixture(scope="module")
def world():
    return World()


def test_steps_keep_their_lengths(world):
    motion = visual_odometry(world.pictures, LENS, options=QUICK)
    assert motion.numbers["model"] == "full" and not motion.scale_known
    assert any("scale is not known" in note for note in motion.notes)
    assert degrees(motion.rotation, world.rotation @ world.rotation[0].T).max() < 0.3
    steps, true = np.diff(motion.centre, axis=0), np.diff(world.centre, axis=0)
    size, expected = (np.linalg.norm(s, axis=1) for s in (steps, true))
    np.testing.assert_allclose(size / size[0], expected / expected[0], rtol=0.12)
    assert np.degrees(np.arccos((steps * true).sum(1) / size / expected)).max() < 4


def test_failures_are_bridged_and_said(panning):
    pictures = list(panning[0])
    pictures[3] = np.full_like(pictures[3], 90)  # nothing to see
    pictures[6] = cv2.GaussianBlur(pictures[6], (0, 0), 15)
    motion = visual_odometry(pictures, LENS, model="rotation", options=QUICK)
    np.testing.assert_array_equal(np.flatnonzero(~motion.known), [3, 6])
    assert np.isnan(motion.rotation_sd[[3, 6]]).all() and np.isfinite(motion.rotation).all()
    assert "2 of 10 frames could not be followed" in " ".join(motion.notes)
    error = degrees(motion.rotation, panning[1] @ panning[1][0].T)
    assert error[motion.known].max() < 0.03 and error[~motion.known].max() < 1.0


@pytest.mark.parametrize("model", ["auto", "full", "rotation"])
def test_nothing_to_see_is_no_exception(model):
    motion = visual_odometry([np.zeros((60, 80), np.uint8)] * 4, LENS, model=model)
    assert not motion.known.any() and "4 of 4 frames" in " ".join(motion.notes)
    assert np.isfinite(camera_with_motion(LENS, motion).rotation).all()


def test_a_cut_begins_a_chain_of_its_own(panning):
    other = panned(pan(4), seed=5)[0]
    options = OdometryOptions(most_features=500, bridge=0)
    motion = visual_odometry([*panning[0][:6], *other[:3]], LENS, model="rotation", options=options)
    assert motion.known[:6].all() and not motion.known[6:].any() and len(motion.numbers["chains"]) > 1


def test_an_animal_is_masked_out():
    """A textured animal that keeps to the middle of the picture and fills a third of it."""
    pictures, rotation = panned(pan()[:4], seed=2)
    coat = texture(7)[:150, :200]
    boxes = np.full((4, 4), np.nan)
    for n, picture in enumerate(pictures):
        picture[45:195, 60:260] = coat
        boxes[n] = [55, 40, 265, 200]
    true = rotation @ rotation[0].T
    masked = visual_odometry(pictures, LENS, model="rotation", boxes=boxes, options=QUICK)
    assert degrees(masked.rotation, true).max() < 0.06
    misled = visual_odometry(pictures, LENS, model="rotation", options=QUICK)
    assert degrees(misled.rotation, true).max() > 1


def test_boxes_of_keypoints():
    pixels = np.full((3, 2, 2), np.nan)
    pixels[1] = [[100, 50], [140, 70]]
    np.testing.assert_allclose(keypoint_boxes(pixels, 0.25), [[90, 40, 150, 80]] * 3)
    assert np.isnan(keypoint_boxes(np.full((2, 3, 2), np.nan))).all()


def test_faults(panning):
    with pytest.raises(InputError, match="few pictures"):
        visual_odometry(panning[0][:1], LENS)
    with pytest.raises(InputError, match="boxes"):
        visual_odometry(panning[0], LENS, boxes=np.zeros((2, 4)))
    with pytest.raises(InputError, match="model"):
        visual_odometry(panning[0], LENS, model="affine")


def test_a_motion_carries_on_from_the_cameras_pose(found):
    base = rotation_matrix(np.array([0.4, -1.0, 0.3]))
    camera = Camera("c", "pinhole", K, np.zeros(0), base, np.array([1.0, 2, 3]), SIZE)
    moving = camera_with_motion(camera, found)
    np.testing.assert_allclose(moving.rotation[0], base, atol=1e-12)
    np.testing.assert_allclose(moving.centre, np.tile(camera.centre, (10, 1)), atol=1e-9)
    np.testing.assert_allclose(moving.rotation @ base.T, found.rotation, atol=1e-9)
    with pytest.raises(InputError, match="scale"):
        camera_with_motion(camera, found, scale=0.0)


def test_scaled_steps_in_the_cameras_world():
    base = rotation_matrix(np.array([0.0, 0, 0.5 * np.pi]))
    camera = Camera("c", "pinhole", K, np.zeros(0), base, -base @ [5.0, 0, 0], SIZE)
    motion = CameraMotion(
        np.arange(2),
        np.stack([np.eye(3)] * 2),
        np.array([[0, 0, 0], [1.0, 0, 0]]),
        np.ones(2, bool),
        False,
        np.zeros(2),
    )
    moving = camera_with_motion(camera, motion, scale=2.0)
    np.testing.assert_allclose(moving.centre, [[5, 0, 0], [5, -2, 0]], atol=1e-12)


def test_bridges():
    rotation = rotation_matrix(np.outer([0, 9, 9, 0.3, 9], [0, 0, 1.0]))
    centre = np.outer([0, 9, 9, 3, 9], [1.0, 0, 0])
    filled, places = bridged(rotation, centre, np.array([1, 0, 0, 1, 0], bool))
    np.testing.assert_allclose(rotation_vector(filled)[:, 2], [0, 0.1, 0.2, 0.3, 0.3], atol=1e-12)
    np.testing.assert_allclose(places[:, 0], [0, 1, 2, 3, 3])


def shaken(n=120, fps=60.0):
    """A hand-held pan and tilt: true attitude of the camera in its frames, and samples of a sensor on it."""
    mounting = rotation_matrix(np.array([1.1, -0.4, 1.9]))

    def vector(t):
        return np.stack([0.2 * np.sin(2 * t), 0.3 * np.sin(1.3 * t + 1), 0.05 * np.sin(3 * t)], axis=-1)

    time = np.arange(-0.5, n / fps + 0.5, 0.005)
    half = 1e-5
    before, after = (transposed(rotation_matrix(vector(time + h))) @ mounting for h in (-half, half))
    rate = rotation_vector(transposed(before) @ after) / (2 * half)
    samples = ImuSamples(
        np.round((time + 0.5) * 1e9).astype(np.int64), rate, np.tile([0, 0, 9.8], (len(time), 1))
    )
    frames = np.arange(n) / fps
    return mounting, samples, rotation_matrix(vector(frames)), frames


def test_mounting_and_offset_from_turns():
    """Pictures that err by 0.03° and a clock that is 37 ms off; errors as large as they say."""
    mounting, samples, rotation, frames = shaken()
    attitude = gyro_attitude(samples, bias=np.zeros(3))
    ratios = []
    for seed in range(4):
        jitter = rotation_matrix(np.random.default_rng(seed).normal(0, 5e-4, (len(frames), 3)))
        n = len(frames)
        motion = CameraMotion(
            np.arange(n), jitter @ rotation, np.zeros((n, 3)), np.ones(n, bool), True, np.full(n, 5e-4)
        )
        found = find_mounting(attitude, motion, np.round((frames + 0.5 - 0.037) * 1e9).astype(np.int64))
        error = rotation_vector(mounting @ found.imu_to_camera.T)
        assert np.degrees(np.linalg.norm(error)) < 0.3 and abs(found.offset - 0.037) < 2e-3
        ratios.append(error @ np.linalg.solve(found.covariance, error) / 3)
        ratios.append((found.offset - 0.037) ** 2 / found.offset_sd**2)
    assert 0.2 < np.mean(ratios) < 2.0


def test_one_axis_does_not_tell_the_mounting():
    mounting, samples, rotation, frames = shaken()
    n = len(frames)
    turned = rotation_matrix(np.outer(np.sin(2 * frames), [0, 1.0, 0]))
    time = samples.time_ns * 1e-9 - 0.5
    rate = np.outer(2 * np.cos(2 * time), [0, -1.0, 0]) @ mounting
    one = ImuSamples(samples.time_ns, rate, samples.force)
    motion = CameraMotion(np.arange(n), turned, np.zeros((n, 3)), np.ones(n, bool), True, np.zeros(n))
    with pytest.raises(InputError, match="two axes"):
        find_mounting(
            gyro_attitude(one, bias=np.zeros(3)), motion, np.round((frames + 0.5) * 1e9).astype(np.int64)
        )


def test_poses_from_the_attitude_of_a_sensor():
    mounting, samples, rotation, frames = shaken()
    start = rotation_matrix(np.array([0.1, 0.2, 0.3]))  # some world
    attitude = gyro_attitude(samples, bias=np.zeros(3), start=start)
    stamps = np.round((frames + 0.5 - 0.02) * 1e9).astype(np.int64)
    motion = motion_from_attitude(attitude, stamps, Mounting(mounting, np.zeros((3, 3)), offset=0.02))
    relative, true = (r @ r[0].T for r in (motion.rotation, rotation))
    assert degrees(relative, true).max() < 0.01 and motion.known.all() and motion.levelled
    late = motion_from_attitude(attitude, stamps + 10**9, Mounting(mounting, np.zeros((3, 3))))
    assert not late.known[-1] and late.known[0] and "outside" in late.notes[-1]
    with pytest.raises(InputError, match="while the inertial sensor ran"):
        motion_from_attitude(attitude, stamps + 10**12, Mounting(mounting, np.zeros((3, 3))))


@pytest.mark.skipif(not KITTI.is_dir(), reason="the excerpt of KITTI (kitti_vo) is not here")
def test_kitti():
    matrix = np.loadtxt(KITTI / "calib.txt")[0].reshape(3, 4)[:, :3]
    poses = np.loadtxt(KITTI / "poses.txt").reshape(-1, 3, 4)[:20]
    pictures = [cv2.imread(str(f), cv2.IMREAD_GRAYSCALE) for f in sorted((KITTI / "image_l").glob("*.png"))]
    lens = Camera("left", "pinhole", matrix, np.zeros(0), np.eye(3), np.zeros(3), pictures[0].shape[::-1])
    motion = visual_odometry(
        pictures, lens, model="full", options=OdometryOptions(longest_side=640, most_features=700)
    )
    true = transposed(poses[:, :, :3])
    turns, expected = (r[1:] @ transposed(r[:-1]) for r in (motion.rotation, true))
    assert np.median(degrees(turns, expected)) <= 0.15
    steps = np.einsum("nij,nj->ni", motion.rotation[:-1], np.diff(motion.centre, axis=0))
    way = np.einsum("nij,nj->ni", true[:-1], np.diff(poses[:, :, 3], axis=0))
    size, length = np.linalg.norm(steps, axis=1), np.linalg.norm(way, axis=1)
    assert np.median(np.degrees(np.arccos((steps * way).sum(1) / size / length))) <= 1.5
    np.testing.assert_allclose(size / size[0], length / length[0], rtol=0.03)  # one scale throughout
    assert motion.known.all()
