"""The simulated rig: where its lidar hits, how its camera turns, what its IMU feels, and its clocks."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from acino_fte.data_tools.recording import GRAVITY
from acino_fte.data_tools.rotations import rotation_matrix, rotation_vector
from acino_fte.errors import InputError
from acino_fte.occlusion import segment_distance_squared
from acino_fte.rig_lidar import Body, mean_density, scan_directions, to_world
from acino_fte.rig_options import RigOptions
from acino_fte.rig_rays import ray_capsules, ray_level, ray_spheres
from acino_fte.simulate_rig import CAMERA, RigSimulation, rig_to_sequence, simulate_rig

EXACT = RigOptions(n_frames=15, range_noise_m=0.0, background=0.0, distance=50.0, width=852, bushes=20)
SMALL = replace(EXACT, n_frames=5, bushes=5)


@pytest.fixture(scope="module")
def exact() -> RigSimulation:
    """A scan without noise."""
    return simulate_rig(EXACT)


@pytest.fixture(scope="module")
def usual() -> RigSimulation:
    """Half a second at 90 m with all the usual faults."""
    return simulate_rig(RigOptions(n_frames=30, bushes=20))


def world_returns(simulation: RigSimulation) -> np.ndarray:
    """Returns (K, 3) in the world, by the true pose of the camera at the time of each."""
    rotation, translation = simulation.lidar_to_camera
    camera = simulation.returns.xyz @ rotation.T + translation
    turn = simulation.path.rotation(simulation.returns.time)
    return np.einsum("kji,kj->ki", turn, camera) + simulation.path.centre


def link_distances(simulation: RigSimulation, chosen: np.ndarray) -> np.ndarray:
    """Distances (K, E) of chosen returns to all drawn lines, as they are at the time of each, m."""
    points = world_returns(simulation)[chosen, None]
    time = simulation.returns.time[chosen]
    motion = simulation.motion
    positions = motion.kinematics.positions(motion(time), motion.parameters)
    a, b = np.array(simulation.skeleton.edges).T
    return np.sqrt(segment_distance_squared(points, points, positions[:, a], positions[:, b]))


def test_rays_enter_capsules_and_spheres_where_they_must():
    origin, direction = np.array([[0.0, 0.0, 0.0]] * 3), np.array([[0.0, 1.0, 0.0]] * 3)
    start = np.array([[[-1.0, 10.0, 0.03]], [[0.03, 20.0, 0.0]], [[0.2, 10.0, 0.0]]])
    end = np.array([[[1.0, 10.0, 0.03]], [[0.03, 30.0, 0.0]], [[1.2, 10.0, 0.0]]])
    met = ray_capsules(origin, direction, start, end, np.array([0.05]))[:, 0]
    assert met[:2] == pytest.approx([10.0 - 0.04, 20.0 - 0.04], abs=1e-12)  # across; along; beside its end
    assert met[2] == np.inf
    sphere = ray_spheres(origin, direction, np.array([[0.3, 7.0, 0.0]]), np.array([0.5]))[:, 0]
    assert sphere == pytest.approx([6.6] * 3, abs=1e-12)
    down = np.array([[0.0, 0.8, -0.6], [0.0, 1.0, 0.0], [0.0, 0.8, 0.6]])
    assert ray_level(origin + [0, 0, 1.5], down, np.array([0.3] * 3)).tolist() == [2.0, np.inf, np.inf]


def test_rays_enter_random_capsules_first_at_their_surface():
    rng = np.random.default_rng(3)
    n = 300
    start, radius = rng.normal(0, 0.4, (n, 4, 3)) + [0, 20, 0], rng.uniform(0.05, 0.4, 4)
    end = start + rng.normal(0, 0.5, (n, 4, 3))
    origin = rng.normal(0, 0.1, (n, 3))
    direction = rng.normal(0, 0.3, (n, 3)) + [0, 20, 0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    met = ray_capsules(origin, direction, start, end, radius)
    hit = np.isfinite(met)
    assert 0.1 < hit.mean() < 0.9
    point = origin[:, None] + np.where(hit, met, 0.0)[..., None] * direction[:, None]
    assert np.sqrt(segment_distance_squared(point, point, start, end))[hit] == pytest.approx(
        np.broadcast_to(radius, hit.shape)[hit], abs=1e-9
    )
    before = np.where(hit, met - 1e-6, 100.0)[..., None]  # up to there, or all along a ray that misses
    stop = origin[:, None] + before * direction[:, None]
    gap = np.sqrt(segment_distance_squared(origin[:, None] + 0 * stop, stop, start, end))
    assert (gap - radius > -1e-9).all()


def test_returns_lie_on_the_skin_of_the_link_they_are_said_to_hit(exact):
    chosen = np.flatnonzero(exact.returns.on_body)
    assert len(chosen) > 100
    distance = link_distances(exact, chosen)
    own = distance[np.arange(len(chosen)), exact.returns.link[chosen]]
    assert own == pytest.approx(np.full(len(chosen), 0.04), abs=1e-6)
    assert (distance > 0.04 - 1e-6).all()  # in no other capsule
    assert set(exact.returns.link[~exact.returns.on_body]) == {-1}


def test_returns_on_the_solid_body_of_the_species():
    simulation = simulate_rig(replace(SMALL, body="capsules", n_frames=8))
    body = Body.of(simulation.options, simulation.motion)
    chosen = np.flatnonzero(simulation.returns.on_body)
    link = simulation.returns.link[chosen]
    own = link_distances(simulation, chosen)[np.arange(len(chosen)), link]
    assert own == pytest.approx(body.radius[link], abs=1e-6)
    assert {0.04, 0.09, 0.11} == set(body.radius.round(6))


def test_what_is_not_body_is_grass_or_bush_and_never_behind_the_animal(exact):
    points, still = world_returns(exact), ~exact.returns.on_body
    bush = np.linalg.norm(points[:, None] - exact.scenery.centre, axis=2) - exact.scenery.radius
    on_bush = (np.abs(bush) < 0.3 + 1e-6).any(axis=1) | (bush.min(axis=1) < 0)
    low = (points[:, 2] >= 0) & (points[:, 2] < 1.0)
    assert (on_bush | low)[still].all()
    assert 0.04 < np.mean(points[still & ~on_bush, 2]) < 0.06  # an exponential height of 5 cm
    behind = points[still & on_bush, 1]
    assert behind.min() > 5.0 - 2.5 - 1.0


@pytest.mark.parametrize("distance", [50.0, 90.0])
def test_density_is_that_of_the_sensor(distance):
    direction = scan_directions(np.arange(120_000) / 240_000)
    assert np.linalg.norm(direction, axis=1).max() == pytest.approx(1.0, abs=1e-12)
    up = np.degrees(np.arcsin(direction[:, 2]))
    left = np.degrees(np.arctan2(direction[:, 1], direction[:, 0]))
    assert [np.ptp(left), np.ptp(up)] == pytest.approx([14.5, 16.2], abs=0.02)
    at = direction[:, 1:] / direction[:, :1] * distance
    inside = (np.abs(at) < 0.5).all(axis=1).sum()  # a square metre
    assert inside == pytest.approx(0.5 * mean_density(distance), rel=0.08)
    # 240 000 over an ellipse of 14.5° by 16.2°, by hand: 527 a second and m² at 90 m
    assert mean_density(90.0) == pytest.approx(527.2, abs=0.1)


def test_as_many_returns_on_the_body_as_its_outline_has_room_for(exact):
    body = Body.of(exact.options, exact.motion)
    u, v = np.meshgrid(np.arange(0, 852, 3.0), np.arange(0, 453, 3.0))
    area = []
    for n in range(0, 15, 5):
        centre = exact.path.centre[None].repeat(u.size, axis=0)
        camera = exact.true_camera.at_frames(slice(n, n + 1))
        rays = camera.rays(np.stack([u, v], axis=-1).reshape(1, -1, 2))[0]
        a, b = (np.broadcast_to(exact.positions[n, i], (u.size, len(i), 3)) for i in body.pairs.T)
        near = np.linalg.norm(np.cross(exact.positions[n].mean(axis=0) - centre[0], rays), axis=1) < 1.3
        hit = np.isfinite(ray_capsules(centre[near], rays[near], a[near], b[near], body.radius))
        area.append(hit.any(axis=1).sum() * (3.0 / exact.options.focal) ** 2)  # sr
    rate = mean_density(1.0)
    expected = np.mean(area) * rate * exact.options.n_frames / exact.options.fps
    assert exact.returns.on_body.sum() == pytest.approx(expected, rel=0.12)


def test_some_returns_come_from_behind_or_before_the_animal(usual, exact):
    returns = usual.returns
    met = returns.on_body | returns.misled
    assert met.sum() > 50
    assert not (returns.on_body & returns.misled).any()
    pseudo = simulate_rig(RigOptions(lidar="pseudo", n_frames=60)).returns
    assert pseudo.misled.mean() == pytest.approx(0.1, abs=0.02)
    assert not exact.returns.misled.any()
    spoilt = simulate_rig(replace(EXACT, background=0.3))
    same = ~spoilt.returns.misled
    hits = np.isin(exact.returns.time, spoilt.returns.time[same])
    assert np.array_equal(exact.returns.xyz[hits], spoilt.returns.xyz[same])  # nothing else has changed
    share = spoilt.returns.misled.sum() / (spoilt.returns.misled | spoilt.returns.on_body).sum()
    assert share == pytest.approx(0.3, abs=0.12)


def test_ranges_have_the_noise_that_is_asked_for(usual):
    error = np.linalg.norm(usual.returns.xyz, axis=1) - usual.returns.distance
    assert np.std(error) == pytest.approx(0.02, rel=0.03)
    assert abs(np.mean(error)) < 5e-4
    assert usual.lidar.range_sd == 0.02


def test_pseudo_returns_are_on_the_line_of_sight_before_the_marker():
    options = RigOptions(lidar="pseudo", n_frames=20, background=0.0, range_noise_m=0.0, missing=0.5)
    simulation = simulate_rig(options)
    returns, camera = simulation.returns, simulation.lidar.to_camera()
    frame = np.round(returns.time * options.fps).astype(int)
    true = simulation.true_camera.to_camera(simulation.positions)[frame, returns.marker]
    away = np.linalg.norm(true, axis=1, keepdims=True)
    assert camera == pytest.approx(true / away * (away - 0.04), abs=1e-9)
    assert len(np.unique(returns.marker)) > 15


def test_the_camera_projects_as_opencv_and_follows_the_animal(usual):
    camera = usual.true_camera
    assert camera.matrix[0, 0] == pytest.approx(0.150 / 5.5e-6)
    for n in (0, 17):
        vector, _ = cv2.Rodrigues(camera.rotation[n])
        expected, _ = cv2.projectPoints(
            usual.positions[n], vector, camera.translation[n], camera.matrix, np.zeros(5)
        )
        assert usual.pixels[n] == pytest.approx(expected[:, 0], abs=1e-6)
    assert camera.inside(usual.pixels).all()
    assert camera.centre == pytest.approx(np.broadcast_to([0.0, -90.0, 1.5], (30, 3)), abs=1e-9)
    middle = usual.pixels.mean(axis=1)
    assert np.abs(middle - [1023.5, 543.5]).max() < 300
    assert usual.pixels[:, 0, 0].mean() > middle[:, 0].mean()  # it runs to the right
    assert np.nanmedian(usual.detections.position[:, 0] - usual.pixels) == pytest.approx(0.0, abs=0.5)


def test_a_smaller_picture_has_the_same_field_of_view(usual):
    small = simulate_rig(replace(usual.options, width=852, lidar="none"))
    assert small.true_camera.resolution == (852, 453)
    scale = 852 / 2048
    offset = small.pixels - scale * usual.pixels
    assert np.ptp(offset, axis=(0, 1)) == pytest.approx([0.0, 0.0], abs=1e-6)


def test_a_camera_may_be_fixed_or_see_the_animal_come():
    fixed = simulate_rig(RigOptions(pan=False, shake_mrad=0.0, lidar="none", n_frames=90))
    assert not fixed.camera.moves
    assert fixed.camera.inside(fixed.pixels).mean() > 0.95
    coming = simulate_rig(RigOptions(angle=70.0, lidar="none", n_frames=60))
    away = np.linalg.norm(coming.positions.mean(axis=1) - coming.path.centre, axis=1)
    assert away[0] - away[-1] > 10.0
    assert away.mean() == pytest.approx(90.0, abs=1.5)


def turned(imu, bias) -> np.ndarray:
    """Rotation (3, 3) from the last sample's frame to the first one's: mid-point exponentials."""
    rate = imu.rate - bias
    step = 1e-9 * np.diff(imu.time_ns)[:, None]
    total = np.eye(3)
    for part in rotation_matrix(0.5 * (rate[1:] + rate[:-1]) * step):
        total = total @ part
    return total


def attitude(simulation: RigSimulation, time_ns) -> np.ndarray:
    """True rotation (3, 3) of the IMU to the world."""
    turn = simulation.path.rotation(np.array([1e-9 * time_ns]))[0]
    return turn.T @ simulation.lidar_to_camera[0]


def test_the_imu_integrates_to_the_true_rotation():
    still = {"gyro_noise": 0.0, "accel_noise": 0.0, "accel_bias": 0.0}
    simulation = simulate_rig(RigOptions(lidar="none", **still))
    imu = simulation.imu
    bias = imu.rate[:900].mean(axis=0)  # 4.5 s of rest
    assert bias == pytest.approx(np.array(simulation.imu_bias["gyro"]), abs=1e-12)
    assert np.linalg.norm(bias) == pytest.approx(0.01)
    first, last = (attitude(simulation, imu.time_ns[i]) for i in (0, -1))
    error = rotation_vector(first.T @ last @ turned(imu, bias).T)
    assert np.linalg.norm(error) < 3e-5  # rad, of a pan of 0.3
    assert imu.force[:900] @ first.T == pytest.approx(np.tile([0.0, 0.0, GRAVITY], (900, 1)), abs=1e-9)
    assert np.diff(imu.time_ns).tolist() == [5_000_000] * (len(imu) - 1)
    assert imu.time_ns[0] == -6_000_000_000


def test_a_minute_of_gyro_with_noise_stays_within_half_a_degree():
    simulation = simulate_rig(RigOptions(lidar="none", n_frames=3600))
    imu = simulation.imu
    first, last = (attitude(simulation, imu.time_ns[i]) for i in (0, -1))
    error = rotation_vector(first.T @ last @ turned(imu, imu.rate[:1000].mean(axis=0)).T)
    assert np.degrees(np.linalg.norm(error)) < 0.5


def test_the_rate_is_the_derivative_of_the_turn(usual):
    time, step = np.linspace(-0.9, 0.4, 7), 1e-5
    before, after = usual.path.rotation(time - step), usual.path.rotation(time + step)
    expected = rotation_vector(before @ after.swapaxes(1, 2)) / (2 * step)
    assert usual.path.rate(time) == pytest.approx(expected, abs=2e-8)
    rest = usual.path.rotation(np.array([-6.0, -3.0, -1.06]))
    assert np.ptp(rest, axis=0).max() == 0.0
    for edge in (-1.05, -0.05):  # no jump where rest and swing end
        assert usual.path.rate(np.array([edge - 1e-3])) == pytest.approx(
            usual.path.rate(np.array([edge + 1e-3])), abs=5e-3
        )


def test_clocks_stamps_and_drops():
    options = RigOptions(lidar="none", n_frames=400, drops=0.1, jitter_us=0.0, camera_drift_ppm=50.0)
    simulation = simulate_rig(options)
    stamps = simulation.stamps
    ticks = np.diff(stamps.camera_ns) / (1e9 / 60.0)
    assert ticks == pytest.approx(np.full(399, 1.00005), abs=1e-7)
    late = stamps.received_ns - stamps.received_ns[0] - 1e9 * stamps.time
    assert np.std(late) == pytest.approx(1e6, rel=0.2)  # ns: an exponential of 1 ms
    assert (np.diff(stamps.received_ns) >= 0).all()
    assert np.diff(stamps.number).tolist() == [1] * 399
    assert stamps.dropped.mean() == pytest.approx(0.1, abs=0.04)
    assert not stamps.dropped[[0, -1]].any()
    found = np.isfinite(simulation.detections.position).any(axis=(1, 2, 3))
    assert np.array_equal(found, ~stamps.dropped)
    jitter = simulate_rig(replace(options, jitter_us=30.0)).stamps.camera_ns - stamps.camera_ns
    assert np.std(jitter) == pytest.approx(30e3, rel=0.15)


def test_errors_of_calibration_and_synchronisation_are_as_large_as_asked(exact):
    asked = replace(
        SMALL, lidar_turned_mrad=2.0, lidar_moved_mm=30.0, focal_error=0.01, sync_ms=3.0,
        pose_drift_mrad=1.0,
    )  # fmt: skip
    wrong = simulate_rig(asked)
    turn = rotation_vector(wrong.lidar.rotation @ wrong.lidar_to_camera[0].T)
    assert 0.5e-3 < np.linalg.norm(turn) < 8e-3
    assert 0.005 < np.linalg.norm(wrong.lidar.translation - wrong.lidar_to_camera[1]) < 0.12
    assert wrong.lidar.time - wrong.returns.time == pytest.approx(np.full(len(wrong.lidar), 3e-3))
    assert wrong.camera.matrix[0, 0] == pytest.approx(1.01 * wrong.true_camera.matrix[0, 0])
    drift = rotation_vector(wrong.camera.rotation @ wrong.true_camera.rotation.swapaxes(1, 2))
    assert np.linalg.norm(drift[-1]) > np.linalg.norm(drift[0])
    assert wrong.camera.centre == pytest.approx(wrong.true_camera.centre, abs=1e-9)
    assert np.linalg.norm(exact.lidar_to_camera[1]) == pytest.approx(0.15, abs=1e-3)
    assert np.array_equal(exact.lidar.rotation, exact.lidar_to_camera[0])
    assert np.array_equal(exact.camera.rotation, exact.true_camera.rotation)


def test_same_options_same_recording_and_faults_do_not_disturb_each_other():
    exact, again = simulate_rig(SMALL), simulate_rig(SMALL)
    assert np.array_equal(again.returns.xyz, exact.returns.xyz)
    assert np.array_equal(again.imu.rate, exact.imu.rate)
    noisy = simulate_rig(replace(SMALL, range_noise_m=0.02, missing=0.5, gyro_noise=0.0))
    assert np.array_equal(noisy.returns.link, exact.returns.link)
    assert np.array_equal(noisy.returns.intensity, exact.returns.intensity)
    assert np.array_equal(noisy.imu.force, exact.imu.force)
    both = np.isfinite(noisy.detections.position) & np.isfinite(exact.detections.position)
    assert both.sum() > 50
    same = np.isclose(noisy.detections.position, exact.detections.position) | ~both
    assert same.mean() > 0.95  # all but gross errors, which are drawn among what is there
    other = simulate_rig(replace(SMALL, seed=1))
    assert not np.array_equal(other.imu.rate, exact.imu.rate)


def test_the_sequence_has_detections_cameras_lidar_and_truth(usual):
    sequence = rig_to_sequence(usual)
    assert sequence.cameras.names == [CAMERA] == [sequence.lidar.camera]
    assert sequence.cameras[0].moves
    assert sequence.fps == 60.0
    assert sequence.truth.values == pytest.approx(usual.positions)
    missing = ~np.isfinite(sequence.detections.position.values).all(axis=-1)
    assert 0.1 < missing.mean() < 0.2
    assert (sequence.detections.likelihood.values[missing] == 0).all()
    cut = sequence.select_frames(10, 20)
    assert len(cut.cameras[0].rotation) == 10
    assert rig_to_sequence(simulate_rig(RigOptions(lidar="none", n_frames=2))).lidar is None


def test_an_individual_has_its_own_proportions_and_markers():
    simulation = simulate_rig(replace(SMALL, proportions=0.1, offsets_mm=20.0, swaps=0.5, n_frames=8))
    truth = rig_to_sequence(simulation).truth_parameters
    assert len({round(v, 6) for v in truth["segment_scale"].values()}) > 5
    assert truth["swapped"]
    chosen = np.flatnonzero(simulation.returns.on_body)
    own = link_distances(simulation, chosen)[np.arange(len(chosen)), simulation.returns.link[chosen]]
    assert own == pytest.approx(np.full(len(chosen), 0.04), abs=1e-6)  # the body is the animal's own
    on_links = simulation.motion.kinematics.positions(simulation.q, simulation.motion.parameters)
    offset = np.linalg.norm(simulation.positions - on_links, axis=2)
    stated = [np.linalg.norm(truth["marker_offset_m"][m]) for m in simulation.skeleton.marker_names]
    assert offset == pytest.approx(np.tile(stated, (8, 1)), abs=1e-9)


def test_long_runs_are_told_of():
    notes = simulate_rig(RigOptions(lidar="none", n_frames=600)).notes
    assert len(notes) == 1
    assert "treadmill" in notes[0]
    assert simulate_rig(RigOptions(lidar="none", n_frames=30)).notes == []
    narrow = simulate_rig(RigOptions(lidar="none", n_frames=5, focal_mm=900.0))
    assert "in the picture" in narrow.notes[0]


@pytest.mark.parametrize(
    ("key", "value"),
    [("background", 1.5), ("n_frames", 0), ("n_frames", 2.0), ("lidar", "radar"), ("body", "fur"),
     ("noise_px", -1.0), ("distance", float("nan")), ("motion", "prior"), ("drops", 1.0), ("seed", True),
     ("jitter_us", 3000.0)],
)  # fmt: skip
def test_wrong_options_are_named(key, value):
    with pytest.raises(InputError) as error:
        RigOptions(**{key: value})
    assert error.value.key == key


@pytest.mark.parametrize(("species", "motion"), [("human", "walk"), ("dog", "wander")])
def test_other_species(species, motion):
    simulation = simulate_rig(RigOptions(species=species, motion=motion, n_frames=6, distance=60.0, bushes=5))
    assert simulation.returns.on_body.sum() > 10
    assert simulation.true_camera.inside(simulation.pixels).mean() > 0.9


def test_the_lidar_turns_with_the_camera(exact):
    time = np.array([0.1, 0.3])
    ahead = np.tile([1.0, 0.0, 0.0], (2, 1))
    direction, origin = to_world(exact.path, exact.lidar_to_camera, time, ahead)
    forward = exact.path.rotation(time)[:, 2]
    assert np.degrees(np.arccos(np.einsum("ki,ki->k", direction, forward))) == pytest.approx(
        np.degrees([np.hypot(4e-3, 3e-3)] * 2), rel=0.01
    )
    assert np.linalg.norm(origin - exact.path.centre, axis=1) == pytest.approx([0.15, 0.15], abs=1e-3)
