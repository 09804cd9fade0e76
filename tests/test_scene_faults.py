"""One regression test for each fault of the tool that scenes replace, through the public ``Scene``.

A fault that a tool of its own mends is tested with that tool:

==================================================  ======================================================
fault                                               test
==================================================  ======================================================
one set of parameters and one model for all         test_each_camera_has_the_lens_of_its_model
a fisheye model read as another runs and is wrong   test_each_camera_has_the_lens_of_its_model
folder-per-camera names                             test_images_in_folders_are_the_same_scene
pickles only; none of NumPy 2                       test_pickles_of_both_numpys_and_tables_are_the_same
paths linear in the translation                     test_paths_curve_between_key_frames
gaps of any length filled                           test_a_long_gap_is_not_filled
undistortion wrong in the corners                   test_dots_in_the_corners_are_exact; test_colmap_cameras.py
not robust                                          test_gross_errors_move_nothing
no test of the sign of the depth                    test_no_point_is_behind_a_camera
no covariance                                       test_errors_are_as_large_as_their_covariances_say
reprojection errors: minimum over the views         test_a_wrong_view_shows_in_its_own_distance
reprojection errors wrong on unsorted rows          test_the_order_of_rows_means_nothing
a single view explodes                              test_single_views_stay_near
error and source dropped                            test_every_point_says_where_it_comes_from
cameras unscaled                                    test_scale_holds_for_cameras_and_cloud_too
a principal-axes turn mirrors the world             test_no_gauge_mirrors_the_world
sub-tracks ignore the gap in frames                 test_track_tools.py
PLY of tracks always raises                         test_scene_files.py
cameras and tracks joined by alphabet               test_cameras_and_tracks_are_joined_by_name
a camera without tracks                             test_a_camera_without_tracks
an individual that one camera did not see           test_an_individual_that_one_camera_did_not_see
no single-view points                               test_no_single_view_at_all
no point at all                                     test_one_view_alone_gives_no_point_and_says_so
one camera of the model for several prefixes        test_one_camera_of_the_model_for_all_prefixes
quadratic time                                      test_work_is_linear_in_the_frames
==================================================  ======================================================
"""

import gc
import pickle
import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation, Slerp

pytest.importorskip("pycolmap")

from acino_fte.data_tools.scene import Scene
from acino_fte.data_tools.scene_folder import write_scene
from acino_fte.data_tools.scene_tracks import SOURCES
from acino_fte.data_tools.simulate_scene import SceneSimulation, random_gauge, simulate_scene

VIEWS, SINGLE, INTERPOLATED = range(len(SOURCES))
SIDE, WAND = "cam0-cam1=0.6", "tracks:wand_a-wand_b=0.5"
SHORT = SceneSimulation(n_frames=161, n_landmarks=200, landmarks_per_image=12, seed=2)
EXACT = replace(
    SHORT,
    key_step=1,
    unregistered=0.0,
    noise_px=0.0,
    centre_noise=0.0,
    turn_noise=0.0,
    landmark_noise=0.0,
    landmark_noise_px=0.0,
)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """A simulated scene and its folder."""
    simulated = simulate_scene(SHORT)
    return simulated, write_scene(simulated, tmp_path_factory.mktemp("scenes") / "rig")


@pytest.fixture(scope="module")
def solved(rig):
    """The scene of that folder, triangulated."""
    return read(rig[1]).triangulate()


def read(folder, scale=SIDE):
    """The scene of a folder, metric and upright."""
    return Scene.from_colmap(folder, fps=30.0).placed(scale=[scale] if scale else [])


def scene_of(simulated):
    """The scene as it would be read, without files."""
    scene = Scene("s", simulated.cameras(), simulated.tracks(), simulated.cloud(), fps=30.0)
    return scene.placed(scale=[SIDE])


def made(path, options, **change):
    simulated = replace(simulate_scene(options), **change)
    return simulated, write_scene(simulated, path)


def true_points(simulated, tracks):
    """True positions (T, 3) of the points of tracks."""
    which = np.array([simulated.individuals.index(name) for name in tracks.individuals])
    return simulated.true_positions[which[tracks.individual], tracks.frame]


def errors(simulated, result, tracks):
    """Vectors (T, 3) from the truth to points, in the true world, m."""
    home = simulated.gauge.inverse() @ result.scene.world_from_model.inverse()
    return home.points(tracks.position) - true_points(simulated, tracks)


def distances(simulated, result, tracks, source=VIEWS):
    return np.linalg.norm(errors(simulated, result, tracks)[tracks.source == source], axis=1)


def nees(simulated, result, tracks, source):
    """Squared errors in units of their covariances, mean over points and axes; 1 when these are right."""
    home = simulated.gauge.inverse() @ result.scene.world_from_model.inverse()
    mine = tracks.source == source
    error, covariance = errors(simulated, result, tracks)[mine], home.covariance(tracks.covariance[mine])
    return float((error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(1).mean() / 3)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def assert_same(first, second, atol=1e-9):
    """Two answers, point by point."""
    assert first.individuals == second.individuals
    np.testing.assert_array_equal(first.individual, second.individual)
    np.testing.assert_array_equal(first.frame, second.frame)
    np.testing.assert_array_equal(first.source, second.source)
    np.testing.assert_allclose(first.position, second.position, atol=atol)


def edit_tracks(folder, change):
    """Rewrite the tables of tracks: change(name, table) gives the new table, or None for no file."""
    for path in sorted((folder / "tracks").glob("*.csv")):
        table = change(path.stem, pd.read_csv(path))
        path.unlink()
        if table is not None:
            table.to_csv(path, index=False)


def test_each_camera_has_the_lens_of_its_model(tmp_path):
    lenses = ("OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL", "PINHOLE")
    simulated, folder = made(tmp_path / "s", replace(EXACT, lens=lenses))
    result = read(folder).triangulate(smooth=False)
    assert distances(simulated, result, result.points).max() < 1e-5  # tables have 0.001 px
    for used, distance in zip(result.points.used, result.points.distance, strict=True):
        assert used.any() and np.nanmax(distance) < 0.01


def test_images_in_folders_are_the_same_scene(rig, solved, tmp_path):
    folder = write_scene(rig[0], tmp_path / "s", layout="folder")
    assert_same(read(folder).triangulate().tracks, solved.tracks)


def mvt_pickle(table, numpy_one):
    """Tracks as MultiViewTracks pickles them: identities and frames, and a table for each identity."""
    content = {"IDENTITIES": np.unique(table.individual), "FRAME_IDX": np.unique(table.frame.to_numpy())}
    for number, rows in table.groupby("individual"):
        content[str(number)] = {
            "FRAME_IDX": rows.frame.to_numpy(),
            "X": rows.x.to_numpy(),
            "Y": rows.y.to_numpy(),
        }
    dumped = pickle.dumps(content, protocol=2)
    old, new = b"cnumpy.core.", b"cnumpy._core."
    assert (old in dumped) or (new in dumped)
    return dumped.replace(new, old) if numpy_one else dumped.replace(old, new)


@pytest.mark.parametrize("numpy_one", [True, False])
def test_pickles_of_both_numpys_and_tables_are_the_same(rig, solved, tmp_path, numpy_one):
    simulated, _ = rig
    folder = write_scene(simulated, tmp_path / "s")
    for path in sorted((folder / "tracks").glob("*.csv")):
        table = pd.read_csv(path)
        table["individual"] = [simulated.individuals.index(name) for name in table.individual]
        path.with_name(f"tracks_{path.stem}.pkl").write_bytes(mvt_pickle(table, numpy_one))
        path.unlink()
    tracks = read(folder).triangulate().tracks
    assert sorted(tracks.individuals) == ["0", "1", "2"]
    found = {
        (tracks.individuals[i], f): x
        for i, f, x in zip(tracks.individual, tracks.frame, tracks.position, strict=True)
    }
    other = solved.tracks
    for i, f, x in zip(other.individual, other.frame, other.position, strict=True):
        number = str(simulated.individuals.index(other.individuals[i]))
        np.testing.assert_allclose(found[number, f], x, atol=1e-5)


def test_paths_curve_between_key_frames(tmp_path):
    """Against poses of which the translation is linear and the turn spherical between key frames."""
    simulated, folder = made(tmp_path / "s", replace(EXACT, path="orbit", distance=4.0, key_step=8))
    result = read(folder).triangulate(smooth=False)
    home = simulated.gauge.inverse() @ result.scene.world_from_model.inverse()
    for path, true, keyed in zip(
        result.paths, simulated.true_cameras, simulated.structure.cameras, strict=True
    ):
        inside = path.known & (path.frame >= 8) & (path.frame <= keyed.frame[-1] - 8)
        frame = path.frame[inside]
        mine = np.linalg.norm(home.points(path.centre[inside]) - true.centre[frame], axis=1)
        turn = Slerp(keyed.frame, Rotation.from_matrix(keyed.rotation))(frame).as_matrix()
        shift = np.stack([np.interp(frame, keyed.frame, axis) for axis in keyed.translation.T], axis=1)
        centre = -np.einsum("kji,kj->ki", turn, shift)
        linear = np.linalg.norm(centre - true.centre[frame], axis=1)
        assert inside.sum() > 100 and mine.max() < 1e-3 < linear.max()
        assert rms(mine) < 0.1 * rms(linear)


def test_a_long_gap_is_not_filled(tmp_path):
    """A camera without a key frame for 80 frames has no pose there, and its dots make no points."""
    simulated = simulate_scene(replace(SHORT, formation="free", n_frames=241, missed=0.0))
    structure = simulated.structure
    cameras = list(structure.cameras)
    keep = (cameras[3].frame <= 80) | (cameras[3].frame >= 160)
    gap = cameras[3].frame[~keep]
    cameras[3] = replace(
        cameras[3],
        frame=cameras[3].frame[keep],
        rotation=cameras[3].rotation[keep],
        translation=cameras[3].translation[keep],
    )
    seen = ~((structure.camera == 3) & np.isin(structure.frame, gap))
    structure = replace(
        structure,
        cameras=tuple(cameras),
        **{key: getattr(structure, key)[seen] for key in ("camera", "frame", "landmark", "xy")},
    )
    folder = write_scene(replace(simulated, structure=structure), tmp_path / "s")
    result = read(folder, WAND).triangulate(max_pose_gap=24)
    path = next(path for path in result.paths if path.name == "cam3")
    inside = (path.frame > 80) & (path.frame < 160)
    assert not path.known[inside].any() and path.known[~inside].mean() > 0.95
    others = [path for path in result.paths if path.name != "cam3"]
    assert all(path.known.mean() > 0.95 for path in others)
    dots = next(view for view in result.scene.tracks if view.camera == "cam3").frame
    for tracks in (result.points, result.tracks):
        used = tracks.used[3]
        assert not used[(dots > 80) & (dots < 160)].any()
        assert used[(dots < 80) | (dots > 160)].mean() > 0.9
    few = write_scene(replace(simulated, structure=structure), tmp_path / "t")

    def thin(name, table):
        if name == "cam3":
            return table
        return table[(table.frame < 70) | (table.frame > 170)] if name == "cam0" else None

    edit_tracks(few, thin)
    tracks = read(few, None).triangulate(max_pose_gap=24, max_gap=24).tracks
    assert not ((tracks.frame > 80) & (tracks.frame < 160)).any()
    assert (tracks.frame < 70).any() and (tracks.frame > 170).any()


def test_one_view_alone_gives_no_point_and_says_so(rig, tmp_path):
    folder = write_scene(rig[0], tmp_path / "s")
    edit_tracks(folder, lambda name, table: table if name == "cam3" else None)
    result = read(folder).triangulate()
    assert len(result.tracks) == len(result.points) == 0
    assert any("No two views" in text for text in result.numbers["warnings"])


def test_dots_in_the_corners_are_exact(tmp_path):
    """Without noise points are where they were, and dots near the corners as exact as others."""
    simulated, folder = made(tmp_path / "s", replace(EXACT, roam=4.0, n_animals=4))
    result = read(folder).triangulate(smooth=False)
    assert distances(simulated, result, result.points).max() < 1e-5
    width, height = SHORT.resolution
    for view, used, distance in zip(
        result.scene.tracks, result.points.used, result.points.distance, strict=True
    ):
        radius = np.hypot(*(view.xy - 0.5 * np.array([width, height])).T) / np.hypot(width / 2, height / 2)
        far = used & (radius > 0.8)
        assert far.any() and distance[far].max() < 0.01


def test_gross_errors_move_nothing(tmp_path):
    options = replace(SHORT, outliers=0.03, n_frames=401)
    simulated, folder = made(tmp_path / "s", options)
    result = read(folder).triangulate()
    plain = simulate_scene(replace(options, outliers=0.0))
    clean = read(write_scene(plain, tmp_path / "t")).triangulate()
    assert rms(distances(simulated, result, result.tracks)) < 1.3 * rms(distances(plain, clean, clean.tracks))
    hit = [used[wild] for used, wild in zip(result.tracks.used, sorted_wild(simulated, result), strict=True)]
    kept = [
        used[~wild] for used, wild in zip(result.tracks.used, sorted_wild(simulated, result), strict=True)
    ]
    assert np.concatenate(hit).mean() < 0.1 and np.concatenate(kept).mean() > 0.95


def sorted_wild(simulated, result):
    """Which dots of the scene's own tracks are grossly wrong."""
    masks = []
    for mine, wild, read in zip(simulated.views, simulated.outlier, result.scene.tracks, strict=True):
        bad = {(f, mine.labels[t]) for f, t in zip(mine.frame[wild], mine.track[wild], strict=True)}
        masks.append(
            np.array([(f, read.labels[t]) in bad for f, t in zip(read.frame, read.track, strict=True)])
        )
    return masks


def test_no_point_is_behind_a_camera(tmp_path):
    """Two cameras whose dots are exchanged: their rays meet behind them."""
    simulated, folder = made(tmp_path / "s", replace(SHORT, n_cameras=2, missed=0.0))
    tables = {p.stem: pd.read_csv(p) for p in (folder / "tracks").glob("*.csv")}
    edit_tracks(folder, lambda name, _: tables[{"cam0": "cam1", "cam1": "cam0"}[name]])
    result = read(folder).triangulate(smooth=False)
    for path, view, used in zip(result.paths, result.scene.tracks, result.points.used, strict=True):
        key = {
            (i, f): x
            for i, f, x in zip(
                result.points.individual, result.points.frame, result.points.position, strict=True
            )
        }
        for f, t in zip(view.frame[used], view.track[used], strict=True):
            x = key[result.points.individuals.index(view.labels[t]), f]
            n = int(np.searchsorted(path.frame, f))
            assert (path.rotation[n] @ x + path.translation[n])[2] > 0


def test_errors_are_as_large_as_their_covariances_say(tmp_path):
    simulated, folder = made(tmp_path / "s", replace(SHORT, n_frames=601, n_animals=3))
    result = read(folder).triangulate()
    for tracks in (result.points, result.tracks):
        assert (np.linalg.eigvalsh(tracks.covariance) > 0).all()
        assert 0.7 < nees(simulated, result, tracks, VIEWS) < 1.4


def test_a_wrong_view_shows_in_its_own_distance(tmp_path):
    simulated, folder = made(tmp_path / "s", replace(SHORT, missed=0.0))

    def spoil(name, table):
        if name == "cam2":
            table.loc[(table.frame == 60) & (table.individual == "animal_1"), ["x", "y"]] += [60.0, 40.0]
        return table

    edit_tracks(folder, spoil)
    result = read(folder).triangulate()
    view = result.scene.tracks[2]
    row = (view.frame == 60) & (np.array(view.labels)[view.track] == "animal_1")
    for tracks in (result.points, result.tracks):
        assert tracks.distance[2][row] == pytest.approx(np.hypot(60, 40), abs=8.0)
        assert not tracks.used[2][row].any()
        for used, distance in zip(tracks.used, tracks.distance, strict=True):
            assert np.nanmedian(distance[used]) < 4.0
        known = np.isfinite(tracks.reprojection_max)
        assert (tracks.reprojection_max[known] >= tracks.reprojection_median[known]).all()


def test_the_order_of_rows_means_nothing(rig, solved, tmp_path):
    folder = write_scene(rig[0], tmp_path / "s")
    edit_tracks(folder, lambda name, table: table.sample(frac=1.0, random_state=0))
    again = read(folder).triangulate().tracks
    assert_same(again, solved.tracks)
    np.testing.assert_allclose(again.reprojection_max, solved.tracks.reprojection_max, atol=1e-6)


def test_single_views_stay_near(tmp_path):
    """Cameras that look sideways, in a world that is not upright, and often one of them alone."""
    options = replace(SHORT, path="orbit", distance=4.0, n_frames=601, missed=0.55)
    simulated, folder = made(tmp_path / "s", options)
    result = read(folder).triangulate()
    single = distances(simulated, result, result.tracks, SINGLE)
    views = distances(simulated, result, result.tracks)
    assert len(single) > 100
    assert single.max() < 1.0 and rms(single) < 0.15
    assert rms(views) < rms(single)
    assert 0.5 < nees(simulated, result, result.tracks, SINGLE) < 1.6


def test_every_point_says_where_it_comes_from(solved):
    tracks = solved.tracks
    assert {*np.unique(tracks.source)} >= {VIEWS, SINGLE}
    assert (tracks.n_views[tracks.source == VIEWS] >= 2).all()
    assert (tracks.n_views[tracks.source == SINGLE] == 1).all()
    assert (tracks.n_views[tracks.source == INTERPOLATED] == 0).all()
    seen = tracks.source != INTERPOLATED
    assert np.isfinite(tracks.reprojection_median[seen]).all() and np.isfinite(tracks.position).all()
    assert np.isfinite(tracks.covariance).all()
    points = {*zip(tracks.individual, tracks.frame, strict=True)}
    assert len(points) == len(tracks)  # one point for an individual in a frame
    dots = sum(int(used.sum()) for used in tracks.used)
    assert dots == tracks.n_views.sum()


def test_scale_holds_for_cameras_and_cloud_too(rig, solved):
    simulated, _ = rig
    scene = solved.scene
    true_scale = 1.0 / simulated.gauge.scale
    assert scene.world_from_model.scale == pytest.approx(true_scale, rel=3e-3)
    first, second = scene.cameras[0], scene.cameras[1]
    _, a, b = np.intersect1d(first.frame, second.frame, return_indices=True)
    side = np.linalg.norm(first.centre[a] - second.centre[b], axis=1)
    assert side.mean() == pytest.approx(0.6, rel=3e-3)
    paths = [path.centre for path in solved.paths[:2]]
    assert np.linalg.norm(paths[0] - paths[1], axis=1).mean() == pytest.approx(0.6, rel=3e-3)
    extent = np.linalg.norm(scene.cloud.xyz - scene.cloud.xyz.mean(0), axis=1).mean()
    true = simulated.structure.true_landmarks
    assert extent == pytest.approx(np.linalg.norm(true - true.mean(0), axis=1).mean(), rel=3e-3)
    ends = [
        solved.tracks.position[solved.tracks.individual == solved.tracks.individuals.index(n)]
        for n in ("wand_a", "wand_b")
    ]
    if len(ends[0]) == len(ends[1]):
        assert np.median(np.linalg.norm(ends[0] - ends[1], axis=1)) == pytest.approx(0.5, rel=0.01)


def test_no_gauge_mirrors_the_world():
    """Eight gauges: the same metric, upright answer, never its mirror image."""
    simulated = simulate_scene(replace(SHORT, n_frames=81, n_animals=2, wand=None))
    answers = []
    for seed in range(8):
        turned = simulated.regauged(random_gauge(seed))
        result = scene_of(turned).triangulate()
        assert np.linalg.det(result.scene.world_from_model.rotation) == pytest.approx(1.0)
        true = true_points(turned, result.tracks)
        a, b = (x - x.mean(0) for x in (true, result.tracks.position))
        assert np.linalg.det(a.T @ b) > 0
        answers.append(result.tracks)
    for answer in answers[1:]:
        assert_same(answer, answers[0], atol=1e-6)


def test_cameras_and_tracks_are_joined_by_name(tmp_path):
    """Names and files of which the alphabets disagree."""
    simulated = simulate_scene(replace(SHORT, n_cameras=3))
    names = {"cam0": "north", "cam1": "east", "cam2": "south"}
    structure = replace(
        simulated.structure,
        cameras=tuple(replace(c, name=names[c.name]) for c in simulated.structure.cameras),
    )
    views = tuple(replace(view, camera=names[view.camera]) for view in simulated.views)
    folder = write_scene(replace(simulated, structure=structure, views=views), tmp_path / "s")
    for first, name in (("a", "south"), ("b", "north"), ("c", "east")):
        (folder / "tracks" / f"{name}.csv").rename(folder / "tracks" / f"{first}_{name}.csv")
    result = read(folder, "north-east=0.6").triangulate()
    assert [camera.name for camera in result.scene.cameras] == [view.camera for view in result.scene.tracks]
    assert rms(distances(simulated, result, result.tracks)) < 0.02
    assert np.nanmedian(result.tracks.reprojection_median) < 3.0


def test_a_camera_without_tracks(rig, tmp_path):
    simulated, _ = rig
    folder = write_scene(simulated, tmp_path / "s")
    edit_tracks(folder, lambda name, table: None if name == "cam1" else table)
    scene = read(folder)
    assert [len(view) > 0 for view in scene.tracks] == [True, False, True, True]
    assert any("cam1" in text for text in scene.warnings)
    result = scene.triangulate()
    assert len(result.paths) == 4 and rms(distances(simulated, result, result.tracks)) < 0.02


def test_an_individual_that_one_camera_did_not_see(rig, tmp_path):
    simulated, _ = rig
    folder = write_scene(simulated, tmp_path / "s")
    edit_tracks(folder, lambda name, table: table[table.individual != "wand_b"] if name == "cam3" else table)
    result = read(folder).triangulate()
    assert result.tracks.individuals == ("animal_1", "wand_a", "wand_b")
    mine = result.tracks.individual == 2
    assert result.tracks.n_views[mine].max() == 3
    assert rms(distances(simulated, result, result.tracks)) < 0.02


def test_no_single_view_at_all(tmp_path):
    simulated, folder = made(tmp_path / "s", replace(SHORT, missed=0.0))
    result = read(folder).triangulate()
    assert not (result.tracks.source == SINGLE).any()
    assert rms(distances(simulated, result, result.tracks)) < 0.01


def test_one_camera_of_the_model_for_all_prefixes(tmp_path):
    simulated, folder = made(tmp_path / "s", replace(SHORT, shared_lens=True))
    assert (folder / "sparse" / "cameras.txt").read_text().strip().splitlines()[-1].startswith("1 OPENCV")
    result = read(folder).triangulate()
    assert [camera.model_id for camera in result.scene.cameras] == [1, 1, 1, 1]
    assert rms(distances(simulated, result, result.tracks)) < 0.02


def test_work_is_linear_in_the_frames():
    """Four times the frames: hardly more calls, and four times the memory."""
    calls, peaks = [], []
    for n_frames in (120, 480):
        simulated = simulate_scene(replace(SHORT, n_frames=n_frames, n_landmarks=50, landmarks_per_image=4))
        scene = scene_of(simulated)
        scene.triangulate()
        counted = [0]

        def count(_, event, __, counted=counted):
            counted[0] += event == "call"

        gc.collect()
        sys.setprofile(count)
        try:
            scene.triangulate()
        finally:
            sys.setprofile(None)
        tracemalloc.start()
        scene.triangulate()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        calls.append(counted[0])
    assert calls[1] < 4.5 * calls[0]
    assert peaks[1] < 4.8 * peaks[0]
