"""The upright frame: the same in every gauge, never mirrored, level, and clear about what it cannot know."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_scene_scale import keyed

from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.scene_axes import AxesEstimate, metric_upright, upright
from acino_fte.data_tools.similarity import Similarity
from acino_fte.errors import InputError

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # image-right is x, image-up is y, view is −z


def looking(heading, pitch, roll=0.0) -> np.ndarray:
    """World to camera, (K, 3, 3): a heading from x, a pitch above the level, a roll."""
    heading, pitch, roll = np.broadcast_arrays(heading, pitch, roll)
    view = np.stack(
        [np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)], axis=-1
    )
    right = np.stack([np.sin(heading), -np.cos(heading), 0 * heading], axis=-1)
    rotation = np.stack([right, np.cross(view, right), view], axis=-2)
    return np.einsum("kij,kjl->kil", Rotation.from_rotvec(np.outer(roll, [0, 0, 1])).as_matrix(), rotation)


def lawnmower(seed: int = 0, n: int = 240) -> list[KeyedCamera]:
    """Two cameras 0.6 m apart that look down from 4 m, over a field of 25 × 10 m."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, n)
    lane = np.abs((6 * time) % 2 - 1)
    path = np.stack([25 * lane, 10 * time, 4 + 0.1 * np.sin(20 * time)], axis=-1)
    cameras = []
    for i in range(2):
        held = Rotation.from_rotvec(rng.normal(0, 0.03, (n, 3))).as_matrix() @ DOWN
        cameras.append(keyed(f"c{i}", np.arange(n) * 8, held, path + [0.6 * i, 0, 0], i))
    return cameras


def walk(seed: int = 0, n: int = 120, turn: float = 1.0, straight: bool = False) -> list[KeyedCamera]:
    """Two cameras that someone carries about, level but for noise, pitched 0.2 down."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, n)
    heading = turn * np.sin(4 * time)
    step = np.stack([np.cos(heading), np.sin(heading), 0 * time], axis=-1)
    path = np.cumsum([[1.0, 0, 0]] * n if straight else step, axis=0) * 0.3
    if not straight:
        path[:, 2] += 3 * np.sin(9 * time)  # up and down the stairs: the paths lie in no plane
    cameras = []
    for i in range(2):
        held = looking(heading + rng.normal(0, 0.02, n), rng.normal(-0.2, 0.02, n), rng.normal(0, 0.02, n))
        place = path + np.stack([-0.5 * i * np.sin(heading), 0.5 * i * np.cos(heading), 0 * time], axis=-1)
        cameras.append(keyed(f"c{i}", np.arange(n), held, place, i))
    return cameras


def ground(seed: int = 0, tilt: float = 0.0) -> np.ndarray:
    """Ground at z = 0 (tilted about x), a bush on it, and points that are wrong."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform([-5, -5, 0], [30, 15, 0], (900, 3)) + rng.normal(0, 0.02, (900, 3))
    flat[:, 2] += np.tan(tilt) * flat[:, 1]
    bush = rng.uniform([0, 0, 0], [3, 3, 2], (200, 3))
    wrong = rng.normal(0, 40, (60, 3))
    return np.concatenate([flat, bush, wrong])


def gauges(count: int = 40):
    rng = np.random.default_rng(99)
    for _ in range(count):
        turn = Rotation.random(random_state=rng).as_matrix()
        yield Similarity(float(np.exp(rng.normal(0, 2))), turn, rng.normal(0, 20, 3))


def tilt_of(axes: AxesEstimate) -> float:
    """Angle between the estimated up and the true z, rad."""
    return float(np.linalg.norm(axes.rotation[:, 2] - [0, 0, 1]))


SCENES = {
    "lawnmower": (lawnmower, "cameras"),
    "walk": (walk, "cameras"),
    "straight": (lambda: walk(straight=True, turn=0.0), "cameras"),
    "down": (lawnmower, "down"),
    "plane": (lawnmower, "plane"),
    "one fixed": (lambda: [keyed("a", [0], looking([0.3], [0.1]), np.array([[1.0, 2, 3]]))], "cameras"),
    "two fixed": (
        lambda: [
            keyed("a", [0], looking([0.3], [0.0]), np.array([[0.0, 0, 1]])),
            keyed("b", [0], looking([1.9], [0.0]), np.array([[4.0, -3, 1]]), 2),
        ],
        "cameras",
    ),
    "round": (
        lambda: [
            keyed("a", np.arange(60), looking(np.arange(60) * np.pi / 30, -0.3), circle(60)),
        ],
        "cameras",
    ),
}


def circle(n: int) -> np.ndarray:
    angle = np.arange(n) * 2 * np.pi / n
    return np.stack([5 * np.cos(angle), 5 * np.sin(angle), 0 * angle], axis=-1)


@pytest.mark.parametrize("name", SCENES)
def test_any_gauge_gives_the_same_metric_world_and_never_a_mirror(name):
    scene, gravity = SCENES[name]
    cameras, cloud = scene(), ground()
    probe = np.random.default_rng(1).normal(0, 10, (7, 3))
    expected = None
    for gauge in gauges():
        moved = [camera.moved(gauge) for camera in cameras]
        axes = upright(moved, gravity=gravity, cloud=gauge.points(cloud))
        world = metric_upright(axes, 1.0 / gauge.scale)
        np.testing.assert_allclose(np.linalg.det(world.rotation), 1.0, atol=1e-12)
        points = world.points(gauge.points(probe))
        expected = points if expected is None else expected
        np.testing.assert_allclose(points, expected, atol=1e-6)
    between = np.linalg.norm(expected[:, None] - expected[None], axis=-1)
    np.testing.assert_allclose(between, np.linalg.norm(probe[:, None] - probe[None], axis=-1), atol=1e-8)


@pytest.mark.parametrize(
    ("name", "how", "tolerance"),
    [
        ("lawnmower", "plane of the camera paths", 0.02),
        ("walk", "level horizon", 0.01),
        ("straight", "perpendicular to the straight path", 0.01),
        ("two fixed", "level horizon", 1e-9),
        ("plane", "ground plane", 0.002),
        ("round", "plane of the camera paths", 1e-9),
    ],
)
def test_z_is_up(name, how, tolerance):
    scene, gravity = SCENES[name]
    cameras = scene()
    axes = upright(cameras, gravity=gravity, cloud=ground())
    assert how in axes.how
    assert tilt_of(axes) < tolerance
    centres = np.concatenate([camera.centre for camera in cameras]) @ axes.rotation.T + axes.translation
    np.testing.assert_allclose(centres[:, :2].mean(axis=0), 0, atol=1e-9)
    if gravity == "plane":
        np.testing.assert_allclose(centres[:, 2].mean(), 4.0, atol=0.05)
    else:
        np.testing.assert_allclose(centres[:, 2].mean(), 0, atol=1e-9)


def test_x_goes_the_long_way_of_the_path_from_its_start_to_its_end():
    axes = upright(walk(straight=True, turn=0.0))
    np.testing.assert_allclose(axes.rotation[0], [1, 0, 0], atol=0.02)
    back = [
        keyed(c.name, c.frame, c.rotation, c.centre[::-1], c.model_id) for c in walk(straight=True, turn=0.0)
    ]
    np.testing.assert_allclose(upright(back).rotation[0], [-1, 0, 0], atol=0.02)
    assert abs(upright(lawnmower()).rotation[0] @ [1, 0, 0]) > 0.98
    right = upright(SCENES["one fixed"][0]()).rotation[0]  # without a path: the image-right direction
    np.testing.assert_allclose(right, [np.sin(0.3), -np.cos(0.3), 0], atol=1e-9)


def test_the_tilt_is_as_uncertain_as_it_says():
    for scene, gravity in ((walk, "cameras"), (lawnmower, "down")):
        ratio = []
        for seed in range(40):
            axes = upright(scene(seed), gravity=gravity)
            ratio.append((tilt_of(axes) / axes.tilt_sd) ** 2)
        assert 0.5 < np.mean(ratio) < 2.5, gravity
    assert np.isnan(upright(SCENES["one fixed"][0]()).tilt_sd)


def test_what_the_cameras_cannot_know_is_said():
    notes = upright(lawnmower()).notes
    assert "taken to look down" in notes[0]
    assert "another source of gravity" in upright(walk(straight=True, turn=0.0)).notes[0]
    assert not upright(walk()).notes


def test_cameras_that_look_up_a_little_are_not_turned_over():
    n = 60
    heading = np.linspace(0, 3, n)
    for pitch in (-1.1, -0.5, 0.5, 1.1):
        level = keyed("a", np.arange(n), looking(heading, pitch), circle(n))
        assert tilt_of(upright([level])) < 1e-6


def test_a_tilted_ground_below_cameras_that_fly_level():
    axes = upright(lawnmower(), gravity="plane", cloud=ground(tilt=0.1))
    np.testing.assert_allclose(axes.rotation[2], [0, -np.sin(0.1), np.cos(0.1)], atol=3e-3)
    assert axes.tilt_sd < 0.003


def test_no_cloud_no_plane_and_unknown_ways():
    with pytest.raises(InputError, match="needs a point cloud"):
        upright(lawnmower(), gravity="plane")
    scattered = np.random.default_rng(0).normal(0, 30, (500, 3))
    with pytest.raises(InputError, match="no ground plane"):
        upright(lawnmower(), gravity="plane", cloud=scattered)
    with pytest.raises(InputError, match="cameras, plane, down, none"):
        upright(lawnmower(), gravity="gravity.csv")
    axes = upright(lawnmower(), gravity="none")
    np.testing.assert_array_equal(axes.rotation, np.eye(3))


def write_forces(path, cameras, unit=9.81, motion=1.0, seed=0, label=True):
    """What accelerometers in the cameras feel: up at rest, and the camera's own accelerations."""
    rng = np.random.default_rng(seed)
    lines = ["camera,frame,ax,ay,az" if label else "frame,ax,ay,az"]
    for camera in cameras:
        force = np.array([0, 0, unit]) + rng.normal(0, motion, (len(camera.frame), 3)) * unit / 9.81
        force[::17] *= -3  # knocks
        local = np.einsum("kij,kj->ki", camera.rotation, force)
        for frame, value in zip(camera.frame, local, strict=True):
            row = [str(frame), *(f"{v:.6f}" for v in value)]
            lines.append(",".join([camera.name, *row] if label else row))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("unit", [9.81, 1.0])
def test_accelerometers_say_up_in_any_gauge(tmp_path, unit):
    cameras = lawnmower()
    path = write_forces(tmp_path / "imu.csv", cameras, unit)
    axes = [upright([c.moved(g) for c in cameras], gravity=path) for g in (Similarity(), *gauges(5))]
    assert tilt_of(axes[0]) < 4 * axes[0].tilt_sd < 0.05
    assert not axes[0].notes
    for one, gauge in zip(axes[1:], gauges(5), strict=True):
        np.testing.assert_allclose(one.rotation @ gauge.rotation, axes[0].rotation, atol=1e-8)


def test_accelerations_of_the_wrong_unit_sign_or_camera_are_told(tmp_path):
    cameras = walk()
    assert "neither 9.8" in upright(cameras, gravity=write_forces(tmp_path / "a.csv", cameras, 5)).notes[0]
    turned = upright(cameras, gravity=write_forces(tmp_path / "b.csv", cameras, -9.81))
    assert "upside down" in turned.notes[-1]
    one = write_forces(tmp_path / "c.csv", cameras[:1], label=False)
    assert upright(cameras[:1], gravity=one).how.startswith("accelerometers of 1")
    with pytest.raises(InputError, match="lack columns"):
        upright(cameras, gravity=one)
    strangers = [keyed("other", c.frame, c.rotation, c.centre) for c in cameras[:1]]
    with pytest.raises(InputError, match=r"unknown camera[\s\S]*c0, c1[\s\S]*other"):
        upright(cameras, gravity=write_forces(tmp_path / "d.csv", strangers))
    late = [keyed("c0", c.frame + 10_000, c.rotation, c.centre) for c in cameras[:1]]
    with pytest.raises(InputError, match="nothing of the scene's key frames"):
        upright(cameras, gravity=write_forces(tmp_path / "e.csv", late))
    (tmp_path / "f.csv").write_text("camera,frame,ax,ay,az\nc0,0,1,2,much\n")
    with pytest.raises(InputError, match=r"no number[\s\S]*line 2"):
        upright(cameras, gravity=tmp_path / "f.csv")
