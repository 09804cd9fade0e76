"""Rigs: found, told from formations, fused to the statistical bound, robust, and honest about drift."""

from dataclasses import replace

import numpy as np
import pytest
from scene_worlds import Motion, disturbed, exact_path, keyed, pose_errors, random_similarity, rms
from scipy.spatial.transform import Rotation

from acino_fte.data_tools.rigs import Rig, find_rigs, fuse_rig, mean_rotation
from acino_fte.data_tools.rotations import cross_matrix
from acino_fte.data_tools.scene_paths import scene_paths
from acino_fte.errors import InputError

TURN, SHIFT = np.radians(0.03), 0.002
KEYS = np.arange(0, 2000, 8)
OFFSETS = np.array([[0.3, 0.3, 0.0], [-0.3, 0.3, 0.0], [-0.3, -0.3, 0.05], [0.3, -0.3, 0.0]])
TURNS = Rotation.from_rotvec(np.radians([[2.0, -3, 1], [0, 4, 90], [-5, 0, 2], [1, 1, 170]])).as_matrix()


def sensors(n=4):
    """Rotations and offsets as a rig gives them: axes of the first camera, middle of the centres."""
    turns = TURNS[:n] @ TURNS[0].T
    return turns, (OFFSETS[:n] - OFFSETS[:n].mean(0)) @ TURNS[0].T


def rig_cameras(
    seed=0, n=4, frame=KEYS, turn=TURN, shift=SHIFT, missing=0.0, bend=None, name="c", motion=None
):
    """Key frames of a rig's cameras; `bend(c, frames)` gives turns (K, 3) and shifts (K, 3) of a sensor."""
    rng, (rotation, centre) = np.random.default_rng(seed), (motion or Motion(seed))(frame)
    cameras = []
    for c, (sensor, offset) in enumerate(zip(*sensors(n), strict=True)):
        turned, lever = np.zeros((len(frame), 3)), np.tile(offset, (len(frame), 1))
        if bend is not None:
            extra = bend(c, frame)
            turned, lever = turned + extra[0], lever + extra[1]
        r = Rotation.from_rotvec(turned).as_matrix() @ sensor @ rotation
        there = rng.random(len(frame)) >= missing
        place = centre + np.einsum("kji,kj->ki", rotation, lever)
        cameras.append(keyed(f"{name}{c}", frame[there], r[there], place[there], turn, shift, rng))
    return cameras


def rig_truth(rig, seed=0, motion=None):
    return (motion or Motion(seed))(rig.keys.frame)


def turn_errors(found, true):
    """Angles (N, 3) from true to found rotations."""
    return Rotation.from_matrix(found @ np.swapaxes(true, -1, -2)).as_rotvec()


def test_sensors_and_poses_are_as_good_as_the_statistics_allow():
    """Bounds: noise over √K for sensors; for poses over √C, the turn's lever being that of the offsets."""
    sensor, offset, turn, shift = [], [], [], []
    true_turns, true_offsets = sensors()
    for seed in range(8):
        rig = fuse_rig(rig_cameras(seed))
        sensor.append(turn_errors(rig.rotation[1:], true_turns[1:]))
        offset.append(rig.offset - true_offsets)
        rotation, centre = rig_truth(rig, seed)
        turn.append(turn_errors(rig.keys.rotation, rotation))
        shift.append(rig.keys.centre - centre)
    k = np.sqrt(len(KEYS))
    assert rms(np.array(sensor)) < 1.25 * np.sqrt(2) * TURN / k  # of each against the first
    # poses are in the axes of the first camera, whose own error is common to all
    assert rms(np.array(turn)) < 1.1 * TURN / 2
    assert rms(np.array(shift)) < 1.1 * SHIFT / 2
    assert rms(np.array(offset)) < 1.3 * (SHIFT + 0.42 * TURN) / k


@pytest.mark.parametrize("missing", [0.0, 0.3, 0.6])
def test_the_noise_of_an_image_is_found(missing):
    found = [fuse_rig(rig_cameras(seed, missing=missing)).noise for seed in range(4)]
    assert np.mean([float(n.turn) for n in found]) == pytest.approx(TURN, rel=0.1)
    assert np.mean([float(n.shift) for n in found]) == pytest.approx(SHIFT, rel=0.1)


def test_two_cameras_make_a_rig_and_its_noise():
    found = [fuse_rig(rig_cameras(seed, n=2)).noise for seed in range(4)]
    assert np.mean([float(n.turn) for n in found]) == pytest.approx(TURN, rel=0.1)
    assert np.mean([float(n.shift) for n in found]) == pytest.approx(SHIFT, rel=0.1)


def test_exact_without_noise():
    rig = fuse_rig(rig_cameras(turn=0.0, shift=0.0, missing=0.2))
    np.testing.assert_allclose(rig.rotation, sensors()[0], atol=1e-8)
    np.testing.assert_allclose(rig.offset, sensors()[1], atol=1e-9)
    rotation, centre = rig_truth(rig)
    np.testing.assert_allclose(rig.keys.rotation, rotation, atol=1e-8)
    np.testing.assert_allclose(rig.keys.centre, centre, atol=1e-8)
    assert float(rig.noise.turn) < 1e-7 and float(rig.noise.shift) < 1e-8


def test_images_that_are_missing():
    """Every frame of any camera is a key frame of the rig, with as many images as there are."""
    cameras = rig_cameras(missing=0.4)
    rig = fuse_rig(cameras)
    frames, count = np.unique(np.concatenate([c.frame for c in cameras]), return_counts=True)
    np.testing.assert_array_equal(rig.keys.frame, frames)
    np.testing.assert_array_equal(rig.count, count)
    rotation, centre = rig_truth(rig)
    error = rig.keys.centre - centre
    for n in (1, 2, 3, 4):  # the error of the lever grows as the images are not balanced
        assert rms(error[count == n]) == pytest.approx(SHIFT / np.sqrt(n), rel=0.35)


def test_a_rig_is_found_whatever_the_order_and_the_world():
    cameras = rig_cameras(missing=0.1)
    assert find_rigs(cameras) == [("c0", "c1", "c2", "c3")]
    assert find_rigs(cameras[::-1]) == [("c3", "c2", "c1", "c0")]
    rng = np.random.default_rng(0)
    for _ in range(4):
        change = random_similarity(rng)
        moved = [camera.moved(change) for camera in cameras]
        assert find_rigs(moved) == [("c0", "c1", "c2", "c3")]
        rig, other = fuse_rig(cameras), fuse_rig(moved)
        np.testing.assert_allclose(other.rotation, rig.rotation, atol=1e-7)
        np.testing.assert_allclose(other.offset, change.scale * rig.offset, atol=1e-6 * change.scale)
        assert float(other.noise.shift) == pytest.approx(change.scale * float(rig.noise.shift), rel=1e-6)
        assert float(other.noise.turn) == pytest.approx(float(rig.noise.turn), rel=1e-6)


@pytest.mark.parametrize(("metres", "degrees"), [(0.03, 0.5), (0.05, 1.5), (0.2, 3.0)])
def test_cameras_that_keep_formation_are_no_rig(metres, degrees):
    """Each drifts slowly and on its own about its place in the formation."""
    sway = [Motion(200 + c, sway=metres, turn=np.radians(degrees)) for c in range(4)]

    def bend(c, frame):
        rotation, centre = sway[c](frame)
        centre = centre - frame[:, None] / 30.0 * [0.5, 0.1, 0.0]
        return Rotation.from_matrix(rotation).as_rotvec(), centre

    cameras = rig_cameras(bend=bend)
    assert find_rigs(cameras) == []
    assert find_rigs(cameras[:2]) == []


def test_cameras_on_their_own_are_no_rig():
    assert find_rigs([keyed(f"c{s}", KEYS, *Motion(s)(KEYS)) for s in range(4)]) == []


def test_two_rigs_and_a_lone_camera():
    first, second = rig_cameras(1, n=2, name="a"), rig_cameras(2, n=3, name="b")
    lone = keyed("z", KEYS, *Motion(77)(KEYS), TURN, SHIFT, np.random.default_rng(0))
    mixed = [second[0], first[0], lone, second[1], first[1], second[2]]
    assert sorted(find_rigs(mixed)) == [("a0", "a1"), ("b0", "b1", "b2")]
    made = scene_paths(mixed)
    assert {rig.names for rig in made.rigs} == {("a0", "a1"), ("b0", "b1", "b2")}
    assert [path.name for path in made.paths] == [camera.name for camera in mixed]
    base = {camera.name: b for camera, b in zip(mixed, made.views.base.tolist(), strict=True)}
    assert base["a0"] == base["a1"] and base["b0"] == base["b1"] == base["b2"]
    assert len({base["a0"], base["b0"], base["z"]}) == 3 == len(made.views.bases)


def test_cameras_that_never_share_frames():
    cameras = rig_cameras(n=2)
    apart = [cameras[0], replace(cameras[1], frame=cameras[1].frame + 3)]
    assert find_rigs(apart) == []
    with pytest.raises(InputError, match="share no key frames"):
        fuse_rig(apart)
    with pytest.raises(InputError):
        scene_paths(apart, rig=[["c0", "c1"]])
    # joined through a third
    first, second, third, _ = rig_cameras(shift=0.0, turn=0.0)
    early, late = KEYS < 1000, KEYS >= 1000

    def cut(camera, keep):
        return replace(
            camera,
            frame=camera.frame[keep],
            rotation=camera.rotation[keep],
            translation=camera.translation[keep],
            covariance=None,
        )

    chain = [cut(first, early), second, cut(third, late)]
    assert find_rigs(chain) == [("c0", "c1", "c2")]
    rig = fuse_rig(chain)
    np.testing.assert_allclose(rig.offset, sensors(3)[1], atol=1e-7)


def test_rig_names():
    cameras = rig_cameras()
    assert scene_paths(cameras, rig="c0,c1;c2,c3").rigs[1].names == ("c2", "c3")
    assert scene_paths(cameras, rig=[("c3", "c1")]).rigs[0].names == ("c3", "c1")
    assert scene_paths(cameras, rig="none").rigs == ()
    for wrong in ("c0,x9", "c0", "c0,c0", "c0,c1;c1,c2"):
        with pytest.raises(InputError, match="rig"):
            scene_paths(cameras, rig=wrong)


def test_a_slow_bend_is_reported():
    def bend(c, frame):
        share = (frame / frame[-1])[:, None] * (c == 2)
        return np.radians(0.25) * share * [0.0, 1.0, 0.0], 0.02 * share * [1.0, 0.0, 0.0]

    rig, straight = fuse_rig(rig_cameras(bend=bend)), fuse_rig(rig_cameras())
    # two thirds of the whole from third to third; a part of it goes into the rig's own pose
    assert 0.4 * np.radians(0.25) < rig.drift_turn < 0.7 * np.radians(0.25)
    assert 0.4 * 0.02 < rig.drift_shift < 0.7 * 0.02
    assert straight.drift_turn < TURN and straight.drift_shift < SHIFT
    assert straight.whiteness == pytest.approx(2.0, abs=0.25) and rig.whiteness < straight.whiteness
    assert any("not rigid" in note for note in scene_paths(rig_cameras(bend=bend), rig="c0,c1,c2,c3").notes)
    assert not any("not rigid" in note for note in scene_paths(rig_cameras()).notes)


def spoiled(cameras, share=0.03):
    """The same with some images anywhere, and which they are."""
    rng, out, wrong = np.random.default_rng(0), [], []
    for camera in cameras:
        bad = rng.random(len(camera.frame)) < share
        rotation, centre = camera.rotation.copy(), camera.centre
        rotation[bad] = Rotation.random(int(bad.sum()), random_state=rng).as_matrix() @ rotation[bad]
        centre[bad] += rng.normal(0, 2.0, (int(bad.sum()), 3))
        out.append(keyed(camera.name, camera.frame, rotation, centre))
        wrong.append(bad)
    return out, np.array(wrong).T


def test_misplaced_images_do_not_matter():
    clean = rig_cameras(5)
    cameras, wrong = spoiled(clean)
    assert find_rigs(cameras) == [("c0", "c1", "c2", "c3")]
    rig, other = fuse_rig(clean), fuse_rig(cameras)
    rotation, centre = rig_truth(other, 5)
    assert rms(other.offset - sensors()[1]) < 2 * rms(rig.offset - sensors()[1]) + 1e-4
    there = np.isin(rig.keys.frame, other.keys.frame)
    good = rms(rig.keys.centre[there] - centre), rms(turn_errors(rig.keys.rotation[there], rotation))
    assert rms(other.keys.centre - centre) < 1.1 * good[0]
    assert rms(turn_errors(other.keys.rotation, rotation)) < 1.1 * good[1]
    assert float(other.noise.shift) == pytest.approx(SHIFT, rel=0.1)
    assert float(other.noise.turn) == pytest.approx(TURN, rel=0.1)
    decided = wrong.sum(1) < 2
    assert there[decided].all()
    count = dict(zip(other.keys.frame.tolist(), other.count.tolist(), strict=True))
    assert all(count[f] == 4 - n for f, n in zip(KEYS[decided], wrong.sum(1)[decided], strict=True))


def test_two_images_that_contradict_each_other_are_no_key_frame():
    cameras, wrong = spoiled(rig_cameras(6, n=2))
    rig = fuse_rig(cameras)
    np.testing.assert_array_equal(np.isin(KEYS, rig.keys.frame), ~wrong.any(1))
    assert float(rig.noise.shift) == pytest.approx(SHIFT, rel=0.15)
    np.testing.assert_allclose(rig.offset, sensors(2)[1], atol=1e-3)


def test_fused_poses_halve_the_error_of_the_cameras():
    """The issue's claim: four cameras of a rig are twice as sure as one."""
    alone, together = [], []
    for seed in range(4):
        cameras = rig_cameras(seed, frame=np.arange(0, 800, 8))
        for choice, out in (("none", alone), ("auto", together)):
            made = scene_paths(cameras, rig=choice)
            rotation, centre = Motion(seed)(made.paths[0].frame)
            place = centre + np.einsum("kji,j->ki", rotation, sensors()[1][0])
            error = pose_errors(made.paths[0], sensors()[0][0] @ rotation, place)
            out.append(rms(error[:, 3:]) / SHIFT)
    assert rms(np.array(together)) < 0.65 * rms(np.array(alone))


def test_covariance_of_a_sensor_equals_monte_carlo():
    """The rig's frame is disturbed as its covariance says; the camera moves with it."""
    n, rng = 20_000, np.random.default_rng(0)
    rotation, centre = Motion(3)(np.array([40]))
    base = exact_path("rig", np.zeros(1, dtype=int), rotation, centre, 0.02, 0.01)
    root = 0.01 * rng.normal(size=(6, 6))
    covariance = root @ root.T
    base = replace(base, covariance=covariance[None])
    turns, offsets = sensors()
    rig = Rig(("a", "b", "c", "d"), turns, 3 * offsets, None, None, None, 2.0, 0.0, 0.0)
    path = rig.sensor_path(base, "c")
    draws = rng.multivariate_normal(np.zeros(6), covariance, n)
    many = replace(
        base,
        frame=np.zeros(n, dtype=int),
        rotation=np.tile(base.rotation, (n, 1, 1)),
        translation=np.tile(base.translation, (n, 1)),
        covariance=np.tile(base.covariance, (n, 1, 1)),
    )
    true = rig.sensor_path(disturbed(many, draws[:, :3], draws[:, 3:]), "c")
    errors = pose_errors(rig.sensor_path(many, "c"), true.rotation, true.centre)
    expected = path.covariance[0]
    unit = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(errors.T) / unit, expected / unit, atol=0.04)
    np.testing.assert_allclose(path.rotation[0], turns[2] @ rotation[0])
    np.testing.assert_allclose(path.centre[0], centre[0] + rotation[0].T @ (3 * offsets[2]))


def test_mean_rotation_and_cross_matrix():
    rng = np.random.default_rng(1)
    turns = Rotation.random(40, random_state=rng)
    near = Rotation.from_rotvec(0.1 * rng.normal(size=(40, 3))) * turns[0]
    np.testing.assert_allclose(mean_rotation(near.as_matrix().sum(0)), near.mean().as_matrix(), atol=1e-12)
    flipped = mean_rotation(-turns.as_matrix())
    np.testing.assert_allclose(np.linalg.det(flipped), 1.0)
    v, w = rng.normal(size=(2, 5, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", cross_matrix(v), w), np.cross(v, w), atol=1e-15)
