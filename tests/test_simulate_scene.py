"""Simulated scenes with moving cameras: projections, faults, gauges."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from data_tools_synthetic import message

from acino_fte.cameras import Camera
from acino_fte.data_tools.scene_motions import landmarks, target_path
from acino_fte.data_tools.simulate_scene import SceneSimulation, random_gauge, simulate_scene
from acino_fte.data_tools.simulated_lenses import SCENE_LENSES, colmap_parameters, scene_lens
from acino_fte.data_tools.simulated_views import in_bursts

SHORT = SceneSimulation(n_frames=120, n_landmarks=150, landmarks_per_image=12)
CLEAN = replace(
    SHORT,
    noise_px=0.0,
    missed=0.0,
    centre_noise=0.0,
    turn_noise=0.0,
    landmark_noise=0.0,
    landmark_noise_px=0.0,
)
KINDS = [("survey", "rig"), ("survey", "free"), ("orbit", "rig"), ("orbit", "free"), ("orbit", "fixed")]
KINDS += [("walk", "rig"), ("walk", "free")]


def seen_from(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels (P, 2) of points (P, 3), one for each pose of a camera, with OpenCV."""
    local = np.einsum("pij,pj->pi", camera.rotation, points) + camera.translation
    zero, d = np.zeros(3), camera.distortion
    if camera.model == "fisheye":
        return cv2.fisheye.projectPoints(local[:, None], zero, zero, camera.matrix, d)[0][:, 0]
    return cv2.projectPoints(local, zero, zero, camera.matrix, d)[0][:, 0]


@pytest.mark.parametrize(("path", "formation"), KINDS)
def test_cameras_see_what_they_are_about(path, formation):
    options = replace(CLEAN, path=path, formation=formation, distance=4.0, n_animals=2)
    scene = simulate_scene(options)
    assert (
        [view.camera for view in scene.tracks()]
        == [c.name for c in scene.cameras()]
        == ["cam0", "cam1", "cam2", "cam3"]
    )
    for view, camera in zip(scene.views, scene.true_cameras, strict=True):
        assert len(view) > 0.8 * options.n_frames * len(scene.individuals)
        assert camera.inside(view.xy).all()
        points = scene.true_positions[view.animal, view.frame]
        np.testing.assert_allclose(view.xy, seen_from(camera.at_frames(view.frame), points), atol=1e-8)
    moved = [np.linalg.norm(np.ptp(camera.centre, axis=0)) for camera in scene.true_cameras]
    assert (np.array(moved) > 0.3).all() if formation != "fixed" else max(moved) < 1e-12
    assert all(camera.centre[:, 2].min() > 0.5 for camera in scene.true_cameras)  # above the ground


def test_the_rig_is_rigid_and_square_and_free_cameras_are_not():
    rig, free = (simulate_scene(replace(SHORT, formation=name)).true_poses for name in ("rig", "free"))
    for (rotation, translation), rigid in ((rig, True), (free, False)):
        centre = -np.einsum("cnji,cnj->cni", rotation, translation)
        local = np.einsum("nij,cnj->cni", rotation[0], centre - centre[0])
        spread = np.ptp(local, axis=1).max()
        assert spread < 1e-12 if rigid else spread > 0.05
        if rigid:
            side = np.linalg.norm(centre - np.roll(centre, 1, axis=0), axis=-1)
            np.testing.assert_allclose(side, 0.6, atol=1e-12)


@pytest.mark.parametrize("lens", SCENE_LENSES)
def test_lenses_are_those_of_colmap(lens):
    pycolmap = pytest.importorskip("pycolmap")
    model, matrix, distortion = scene_lens(lens, 1250.0, (2704, 1520), np.linspace(-1, 1, 6))
    camera = Camera("c", model, matrix, distortion, np.eye(3), np.zeros(3), (2704, 1520))
    parameters = colmap_parameters(lens, camera)
    theirs = pycolmap.Camera(model=lens, width=2704, height=1520, params=parameters)
    points = np.random.default_rng(0).uniform([-1, -0.6, 1], [1, 0.6, 2], (50, 3))
    np.testing.assert_allclose(camera.project(points), theirs.img_from_cam(points), atol=1e-8)


def test_each_camera_may_have_its_own_lens_and_all_may_share_one():
    lenses = ("OPENCV", "PINHOLE", "OPENCV_FISHEYE", "RADIAL")
    scene = simulate_scene(replace(SHORT, lens=lenses))
    assert [camera.model_id for camera in scene.cameras()] == [1, 2, 3, 4]
    assert [camera.lens.model for camera in scene.cameras()] == ["pinhole", "pinhole", "fisheye", "pinhole"]
    shared = simulate_scene(replace(SHORT, shared_lens=True)).cameras()
    assert {camera.model_id for camera in shared} == {1}
    for camera in shared[1:]:
        np.testing.assert_array_equal(camera.lens.parameters, shared[0].lens.parameters)


def test_noise_is_what_was_asked_for():
    options = replace(SHORT, n_frames=1600, unregistered=0.1, n_landmarks=300)
    scene = simulate_scene(options)
    turns, shifts = [], []
    for true, keyed in zip(scene.true_cameras, scene.structure.cameras, strict=True):
        there = true.at_frames(keyed.frame)
        turn = keyed.rotation @ np.swapaxes(there.rotation, 1, 2)
        turns.append([cv2.Rodrigues(r)[0][:, 0] for r in turn])
        shifts.append(keyed.centre - there.centre)
        assert keyed.frame[0] == 0 and keyed.frame[-1] == 1592 and (keyed.frame % 8 == 0).all()
    count = sum(len(camera.frame) for camera in scene.structure.cameras)
    assert count == pytest.approx(0.9 * 800, rel=0.06)
    assert np.degrees(np.concatenate(turns).std()) == pytest.approx(0.03, rel=0.05)
    assert np.concatenate(shifts).std() == pytest.approx(0.002, rel=0.05)
    error = np.concatenate(
        [
            view.xy - seen_from(camera.at_frames(view.frame), scene.true_positions[view.animal, view.frame])
            for view, camera in zip(scene.views, scene.true_cameras, strict=True)
        ]
    )
    assert error.std() == pytest.approx(1.0, rel=0.05)
    assert len(error) == pytest.approx(0.7 * 4 * 3 * 1600, rel=0.1)


def test_misses_come_in_bursts():
    mask = in_bursts(0.3, 8.0, (20_000, 3), np.random.default_rng(0))
    assert mask.mean() == pytest.approx(0.3, abs=0.03)
    begins = (mask[1:] & ~mask[:-1]).sum()
    assert mask.sum() / begins == pytest.approx(8.0, rel=0.1)
    assert not in_bursts(0.0, 8.0, (5, 2), np.random.default_rng(0)).any()
    assert in_bursts(1.0, 8.0, (5, 2), np.random.default_rng(0)).all()


def test_gross_errors_and_exchanged_names_are_known():
    scene = simulate_scene(replace(SHORT, outliers=0.05, swaps=3, noise_px=0.0))
    plain = simulate_scene(replace(SHORT, noise_px=0.0))
    wrong = 0
    for view, wild, other in zip(scene.views, scene.outlier, plain.views, strict=True):
        np.testing.assert_array_equal(view.frame, other.frame)
        off = np.linalg.norm(view.xy - other.xy, axis=1)
        np.testing.assert_array_equal(off > 1e-9, wild)
        assert off[wild].min() >= 20 and off.max() <= 150
        exchanged = view.track != view.animal
        assert 0 < exchanged.sum() <= 3 * 2 * 15
        pair = set(zip(view.frame, view.track, strict=True))
        assert len(pair) == len(view)  # a name is there once a frame
        wrong += wild.sum()
    assert wrong == pytest.approx(0.05 * sum(map(len, scene.views)), rel=0.3)


def test_a_clock_that_is_late_sees_what_was():
    offset, drift = (0.0, 4.0, -2.0, 0.0), (0.0, 0.0, 0.0, 0.5)
    late = simulate_scene(replace(CLEAN, clock_offset=offset, clock_drift=drift))
    sharp = simulate_scene(CLEAN)
    for c, step in ((1, lambda f: f + 4), (2, lambda f: f - 2), (3, lambda f: f + f // 2)):
        own = np.arange(10, 60, 2)
        moment = step(own)
        mine, theirs = late.true_cameras[c], sharp.true_cameras[c]
        np.testing.assert_allclose(mine.centre[own], theirs.centre[moment], atol=1e-9)
        rows = {
            (f, a): xy
            for f, a, xy in zip(late.views[c].frame, late.views[c].animal, late.views[c].xy, strict=True)
        }
        pixels = theirs.at_frames(moment).project(sharp.true_positions[0, moment][:, None])[:, 0]
        found = np.array([rows.get((f, 0), (np.nan, np.nan)) for f in own])
        assert np.isfinite(found).all(axis=1).mean() > 0.5
        np.testing.assert_allclose(found[np.isfinite(found)], pixels[np.isfinite(found)], atol=1e-8)
    np.testing.assert_array_equal(late.true_positions, sharp.true_positions)


def test_the_model_lives_in_a_world_of_its_own():
    scene = simulate_scene(CLEAN)
    back = scene.gauge.inverse()
    assert scene.gauge.scale != 1.0
    for keyed, true in zip(scene.cameras(), scene.true_cameras, strict=True):
        again = keyed.moved(back)
        np.testing.assert_allclose(again.centre, true.centre[keyed.frame], atol=1e-9)
        np.testing.assert_allclose(again.rotation, true.rotation[keyed.frame], atol=1e-12)
    np.testing.assert_allclose(back.points(scene.cloud().xyz), scene.structure.true_landmarks, atol=1e-9)
    other = simulate_scene(replace(CLEAN, gauge_seed=5))
    assert other.gauge.scale != scene.gauge.scale
    np.testing.assert_array_equal(other.views[0].xy, scene.views[0].xy)
    assert simulate_scene(replace(CLEAN, gauge=False)).gauge.scale == 1.0
    moved = scene.regauged(random_gauge(9))
    np.testing.assert_allclose(
        moved.gauge.inverse().points(moved.cloud().xyz), back.points(scene.cloud().xyz)
    )


def test_landmarks_project_where_they_were_seen():
    scene = simulate_scene(CLEAN)
    s = scene.structure
    assert np.bincount(s.landmark).min() >= 2
    np.testing.assert_allclose(s.error, 0.0, atol=1e-9)
    per_image = np.unique(np.stack([s.camera, s.frame]), axis=1, return_counts=True)[1]
    assert per_image.max() <= CLEAN.landmarks_per_image
    for c, keyed in enumerate(scene.cameras()):  # in the model's own world
        own = s.camera == c
        k = np.searchsorted(keyed.frame, s.frame[own])
        there = replace(keyed.lens, rotation=keyed.rotation[k], translation=keyed.translation[k])
        np.testing.assert_allclose(seen_from(there, scene.cloud().xyz[s.landmark[own]]), s.xy[own], atol=1e-7)


def test_poses_from_landmarks_err_as_much_as_landmarks_do():
    """Against OpenCV's resection of the same noisy pixels."""
    options = replace(SHORT, resection=True, lens="PINHOLE", landmark_noise=0.0, landmarks_per_image=40)
    scene = simulate_scene(options)
    s = scene.structure
    keyed, true = s.cameras[0], scene.true_cameras[0]
    compared = 0
    for k, frame in enumerate(keyed.frame):
        rows = (s.camera == 0) & (s.frame == frame)
        if rows.sum() < 39:  # landmarks that only one image saw counted for the pose, but are not kept
            continue
        start = cv2.Rodrigues(true.rotation[frame])[0], true.translation[frame].copy()
        points, pixels = s.true_landmarks[s.landmark[rows]], s.xy[rows]
        _, turn, shift = cv2.solvePnP(points, pixels, true.matrix, None, *start, useExtrinsicGuess=True)
        centre = -cv2.Rodrigues(turn)[0].T @ shift.ravel()
        error = keyed.centre[k] - true.centre[frame]
        assert np.linalg.norm(keyed.centre[k] - centre) < 0.2 * np.linalg.norm(error) + 1e-4
        compared += 1
    assert compared > 3


def test_the_same_seed_gives_the_same_scene_and_faults_leave_the_paths_alone():
    one, two, other = (simulate_scene(replace(SHORT, seed=seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.cloud().xyz, two.cloud().xyz)
    np.testing.assert_array_equal(one.views[2].xy, two.views[2].xy)
    assert not np.array_equal(one.true_positions, other.true_positions)
    faulty = simulate_scene(replace(SHORT, seed=1, outliers=0.1, key_step=4, noise_px=3.0))
    np.testing.assert_array_equal(one.true_positions, faulty.true_positions)
    np.testing.assert_array_equal(one.true_cameras[3].rotation, faulty.true_cameras[3].rotation)


def test_the_wand_has_its_length_and_individuals_their_names():
    scene = simulate_scene(replace(SHORT, wand=0.7, n_animals=2))
    assert scene.individuals == ("wand_a", "wand_b", "animal_1", "animal_2")
    length = np.linalg.norm(scene.true_positions[0] - scene.true_positions[1], axis=-1)
    np.testing.assert_allclose(length, 0.7, atol=1e-12)
    step = np.linalg.norm(np.diff(scene.true_positions, n=2, axis=1), axis=-1)
    assert step.max() * 30**2 < 30.0  # m/s², smooth
    assert simulate_scene(replace(SHORT, wand=None)).individuals == ("animal_1",)


def test_a_survey_goes_back_and_forth():
    target = target_path("survey", 25.0, np.random.default_rng(0))
    points = target(np.linspace(0, 200, 4001))
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(step, 0.8 * 0.05, rtol=1e-3)  # half circles join the lanes
    assert points[:, 1].max() > 8 and -1.1 < points[:, 0].min() < points[:, 0].max() < 26.1
    low = landmarks("survey", target, 500, 20.0, 3.0, 0.15, np.random.default_rng(1))
    high = landmarks("orbit", target, 500, 20.0, 3.0, 0.15, np.random.default_rng(1))
    assert low[:, 2].max() < 1.2 < high[:, 2].max()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"path": "swim"}, "survey, orbit, walk"),
        ({"formation": "fixed"}, "path 'orbit'"),
        ({"lens": "GOPRO"}, "OPENCV_FISHEYE"),
        ({"lens": ("OPENCV", "PINHOLE")}, "one for each"),
        ({"lens": ("OPENCV", "PINHOLE", "OPENCV", "OPENCV"), "shared_lens": True}, "share"),
        ({"n_frames": 0}, "n_frames"),
        ({"noise_px": float("nan")}, "noise_px"),
        ({"missed": 1.5}, "between 0 and 1"),
        ({"clock_offset": (1.0,)}, "for each camera"),
        ({"wand": None, "n_animals": 0}, "n_animals"),
        ({"wand": None, "swaps": 1}, "two individuals"),
    ],
)
def test_impossible_options_are_refused(change, said):
    assert said in str(message(replace, SHORT, **change))
