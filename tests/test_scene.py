"""Scenes: reading, placing, moving, triangulating, and what a user may get wrong."""

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scene_worlds import nees, random_similarity, rms

pytest.importorskip("pycolmap")

from acino_fte.data_tools.scene import Scene
from acino_fte.data_tools.scene_folder import write_scene
from acino_fte.data_tools.scene_tables import tracks_text
from acino_fte.data_tools.scene_tracks import SOURCES
from acino_fte.data_tools.similarity import Similarity
from acino_fte.data_tools.simulate_scene import SceneSimulation, simulate_scene
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError

VIEWS, SINGLE, INTERPOLATED = range(len(SOURCES))
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "wand_rig"
SIDE, WAND = "cam0-cam1=0.6", "tracks:wand_a-wand_b=0.5"
RIG = SceneSimulation(n_frames=201, n_landmarks=200, landmarks_per_image=12, seed=4)
KINDS = {
    "rig": RIG,
    "free": replace(RIG, formation="free", path="walk", distance=4.0, n_frames=91),
    "fixed": replace(RIG, formation="fixed", path="orbit", distance=4.0, n_frames=91),
}


@cache
def simulated(kind="rig"):
    return simulate_scene(KINDS[kind])


def bare(kind="rig"):
    """The scene as it would be read, without files, in the model's world."""
    made = simulated(kind)
    return Scene("s", made.cameras(), made.tracks(), made.cloud(), fps=30.0)


@cache
def placed(kind="rig"):
    return bare(kind).placed(scale=[SIDE if kind == "rig" else WAND])


@cache
def solved(kind="rig"):
    return placed(kind).triangulate()


def errors(made, result, tracks):
    """Vectors from the truth, in the true world, m, and covariances there."""
    home = made.gauge.inverse() @ result.scene.world_from_model.inverse()
    who = np.array([made.individuals.index(name) for name in tracks.individuals])[tracks.individual]
    error = home.points(tracks.position) - made.true_positions[who, tracks.frame]
    return error, home.covariance(tracks.covariance)


def assert_same(first, second, atol):
    for key in ("individual", "frame", "source", "n_views"):
        np.testing.assert_array_equal(getattr(first, key), getattr(second, key))
    np.testing.assert_allclose(first.position, second.position, atol=atol)
    np.testing.assert_allclose(first.covariance, second.covariance, atol=atol)
    np.testing.assert_allclose(first.reprojection_max, second.reprojection_max, atol=1e-4)


def test_a_folder_becomes_metric_upright_tracks(tmp_path):
    folder = write_scene(simulated(), tmp_path / "s")
    scene = Scene.from_colmap(folder, fps=30.0)
    assert [c.name for c in scene.cameras] == ["cam0", "cam1", "cam2", "cam3"]
    assert scene.individuals == ("animal_1", "wand_a", "wand_b") and scene.name == "s"
    assert scene.scale is None and scene.axes is None and len(scene.cloud.xyz)
    result = scene.placed(scale=[SIDE]).triangulate()
    error, covariance = errors(simulated(), result, result.tracks)
    views = result.tracks.source == VIEWS
    assert rms(error[views]) < 0.01 and 0.5 < nees(error[views], covariance[views]).mean() < 1.6
    up = result.scene.world_from_model.rotation @ simulated().gauge.rotation @ [0.0, 0.0, 1.0]
    assert up[2] > np.cos(np.radians(6))
    assert result.tracks.smooth and not result.points.smooth
    assert len(result.paths) == 4 and len(result.rigs) == 1
    assert result.noise_px == pytest.approx(1.0, rel=0.1)
    assert {"pose_noise", "rigs", "scale", "axes", "pose_noise_share", "warnings"} <= set(result.numbers)


@pytest.mark.skipif(not EXAMPLE.is_dir(), reason="the example is absent")
def test_the_example():
    scene = Scene.from_colmap(EXAMPLE, fps=30.0).placed(scale=[SIDE])
    tracks = scene.triangulate().tracks
    ends = [
        dict(zip(tracks.frame[mine].tolist(), tracks.position[mine], strict=True))
        for name in ("wand_a", "wand_b")
        for mine in [(tracks.individual == tracks.individuals.index(name)) & (tracks.source == VIEWS)]
    ]
    length = [np.linalg.norm(ends[0][f] - ends[1][f]) for f in ends[0].keys() & ends[1].keys()]
    assert len(length) > 50 and rms(np.array(length) - 0.5) < 0.006


def test_distances_of_cameras_and_of_individuals_give_the_same_scale():
    factors = [bare().placed(scale=[known]).scale for known in (SIDE, WAND)]
    for estimate in factors:
        true = 1.0 / simulated().gauge.scale
        assert estimate.factor == pytest.approx(true, rel=3e-3)
        assert abs(estimate.factor / true - 1.0) < 4 * estimate.sd / true + 1e-4
    both = bare().placed(scale=[SIDE, WAND]).scale
    low, high = sorted(one.factor for one in factors)
    assert low <= both.factor <= high and both.sd <= max(one.sd for one in factors)


def test_without_a_distance_lengths_stay_those_of_the_model():
    scene = bare().placed()
    assert scene.scale is None and scene.world_from_model.scale == pytest.approx(1.0)
    assert scene.axes is not None


def test_moved_moves_all_alike():
    change = random_similarity(np.random.default_rng(0), 1.0)
    scene, other = bare(), bare().moved(change)
    np.testing.assert_allclose(other.cloud.xyz, change.points(scene.cloud.xyz), rtol=1e-10)
    for camera, moved in zip(scene.cameras, other.cameras, strict=True):
        np.testing.assert_allclose(moved.centre, change.points(camera.centre), atol=1e-9 * change.scale)
    assert other.world_from_model.scale == pytest.approx(change.scale)
    point = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(other.world_from_model.points(point), change.points(point))
    back = other.moved(change.inverse())
    np.testing.assert_allclose(back.cloud.xyz, scene.cloud.xyz, atol=1e-9)
    np.testing.assert_allclose(back.world_from_model.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(scene.cloud.xyz, bare().cloud.xyz)  # nothing is changed in place
    first, second = scene.triangulate().tracks.moved(change), other.triangulate().tracks
    np.testing.assert_allclose(second.position, first.position, atol=1e-6 * change.scale)
    np.testing.assert_allclose(second.covariance, first.covariance, atol=1e-6 * change.scale**2)


@pytest.mark.parametrize("kind", KINDS)
def test_the_gauge_of_the_model_means_nothing(kind):
    """Random similarities, 0.01 to 100 units per unit."""
    known = SIDE if kind == "rig" else WAND
    first = solved(kind)
    for seed in range(5 if kind == "rig" else 3):
        change = random_similarity(np.random.default_rng(100 + seed))
        scene = bare(kind).moved(change).placed(scale=[known])
        turn = scene.world_from_model.rotation
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(turn) == pytest.approx(1.0)
        result = scene.triangulate()
        assert_same(result.tracks, first.tracks, 1e-6)
        assert_same(result.points, first.points, 1e-6)
        assert result.noise_px == pytest.approx(first.noise_px, rel=1e-6)
        np.testing.assert_allclose(scene.cloud.xyz, first.scene.cloud.xyz, atol=1e-6)
        for path, other in zip(result.paths, first.paths, strict=True):
            np.testing.assert_allclose(path.centre, other.centre, atol=1e-6)
            np.testing.assert_allclose(path.rotation, other.rotation, atol=1e-6)


def test_not_smoothed_with_the_single_views_of_the_paths():
    smooth, single = solved(), placed().triangulate(smooth=False)
    assert not single.tracks.smooth
    views = single.tracks.source == VIEWS
    three = (single.tracks, single.points, smooth.tracks)
    keys = [list(zip(tracks.individual, tracks.frame, strict=True)) for tracks in three]
    assert [key for key, mine in zip(keys[0], views, strict=True) if mine] == keys[1]
    np.testing.assert_array_equal(single.tracks.position[views], single.points.position)
    np.testing.assert_array_equal(single.points.position, smooth.points.position)
    assert (single.tracks.source == SINGLE).sum() > 20
    place = {key: i for i, key in enumerate(keys[2])}
    for i in np.flatnonzero(~views):
        np.testing.assert_array_equal(single.tracks.position[i], smooth.tracks.position[place[keys[0][i]]])
    assert keys[0] == sorted(set(keys[0]))
    for used, distance in zip(single.tracks.used, single.tracks.distance, strict=True):
        assert np.isfinite(distance[used]).all()
    assert sum(int(used.sum()) for used in single.tracks.used) == single.tracks.n_views.sum()


def test_points_count_their_views_and_distances():
    result = solved()
    for tracks in (result.tracks, result.points):
        count = np.zeros(len(tracks), dtype=int)
        most = np.zeros(len(tracks))
        key = {(i, f): n for n, (i, f) in enumerate(zip(tracks.individual, tracks.frame, strict=True))}
        names = [view.labels for view in result.scene.tracks]
        for view, labels, used, distance in zip(
            result.scene.tracks, names, tracks.used, tracks.distance, strict=True
        ):
            for p in np.flatnonzero(used):
                n = key[tracks.individuals.index(labels[view.track[p]]), view.frame[p]]
                count[n] += 1
                most[n] = max(most[n], distance[p])
        np.testing.assert_array_equal(tracks.n_views, count)
        seen = count > 0
        np.testing.assert_allclose(tracks.reprojection_max[seen], most[seen])
        assert np.isnan(tracks.reprojection_max[~seen]).all()


def test_no_two_views():
    scene = bare()
    alone = [v if v.camera == "cam2" else v.at_rows(np.zeros(len(v), dtype=bool)) for v in scene.tracks]
    result = replace(scene, tracks=tuple(alone)).triangulate()
    assert len(result.tracks) == len(result.points) == 0 and result.noise_px > 0
    assert any("No two views" in note for note in result.numbers["warnings"])
    assert result.tracks.position.shape == (0, 3) and result.tracks.covariance.shape == (0, 3, 3)
    with pytest.raises(InputError):
        replace(scene, tracks=tuple(alone)).placed(scale=[WAND])


def test_no_tracks_at_all():
    scene = bare()
    nothing = tuple(v.at_rows(np.zeros(len(v), dtype=bool)) for v in scene.tracks)
    for empty in (nothing, tuple(replace(view, labels=()) for view in nothing)):
        result = replace(scene, tracks=empty).placed(scale=[SIDE]).triangulate()
        assert len(result.tracks) == 0 and len(result.paths) == 4
        assert len(replace(scene, tracks=empty).triangulate(smooth=False).tracks) == 0


def test_one_individual_of_several_that_one_view_sees():
    scene = bare()
    tracks = []
    for view in scene.tracks:
        mine = np.array(view.labels)[view.track] == "animal_1"
        tracks.append(view if view.camera == "cam0" else view.at_rows(~mine))
    result = replace(scene, tracks=tuple(tracks)).triangulate()
    found = {result.tracks.individuals[i] for i in np.unique(result.tracks.individual)}
    assert found == {"wand_a", "wand_b"}
    assert any("animal_1" in note for note in result.numbers["warnings"])


def test_a_noise_that_is_given():
    one, three = (placed().triangulate(noise_px=px) for px in (1.0, 3.0))
    assert (one.noise_px, three.noise_px) == (1.0, 3.0)
    assert np.median(three.points.standard_deviation) > 1.4 * np.median(one.points.standard_deviation)


def test_longest_gap():
    short, long = (placed().triangulate(max_gap=gap).tracks for gap in (0, 40))
    assert not (short.source == INTERPOLATED).any()
    assert (long.source == INTERPOLATED).any()
    assert len(short) < len(long)


def test_rigs_by_name():
    scene = placed()
    auto, named = solved(), scene.triangulate([["cam0", "cam1", "cam2", "cam3"]])
    assert_same(auto.tracks, named.tracks, 1e-12)
    half = scene.triangulate("cam0,cam1;cam2,cam3")
    assert [rig.names for rig in half.rigs] == [("cam0", "cam1"), ("cam2", "cam3")]
    assert scene.triangulate("none").rigs == ()
    for wrong in ("cam0,cam9", "cam0", "all", [["cam0", "cam0"]]):
        with pytest.raises(InputError, match="rig"):
            scene.triangulate(wrong)


def test_the_rig_makes_points_better():
    errors_of = {}
    for rig in ("auto", "none"):
        result = solved() if rig == "auto" else placed().triangulate(rig)
        for name in ("points", "tracks"):
            tracks = getattr(result, name)
            error, _ = errors(simulated(), result, tracks)
            errors_of[rig, name] = rms(error[tracks.source == VIEWS])
    assert errors_of["auto", "points"] < 0.85 * errors_of["none", "points"]
    assert errors_of["auto", "tracks"] < errors_of["none", "tracks"]
    assert errors_of["auto", "tracks"] < errors_of["auto", "points"]


def test_nothing_is_changed_in_place_and_the_same_comes_again():
    scene = placed()
    before = [view.xy.copy() for view in scene.tracks], [c.translation.copy() for c in scene.cameras]
    first, second = solved(), scene.triangulate()
    np.testing.assert_array_equal(first.tracks.position, second.tracks.position)
    np.testing.assert_array_equal(first.tracks.covariance, second.tracks.covariance)
    for xy, view in zip(before[0], scene.tracks, strict=True):
        np.testing.assert_array_equal(xy, view.xy)
    for translation, camera in zip(before[1], scene.cameras, strict=True):
        np.testing.assert_array_equal(translation, camera.translation)


def test_steps_are_told():
    told = []
    placed().triangulate(tell=told.append)
    assert {"camera paths", "triangulation", "smoothing"} <= set(told)


def test_tracks_and_cameras_belong_together():
    scene = bare()
    with pytest.raises(InputError, match="do not belong together"):
        replace(scene, tracks=scene.tracks[::-1])
    with pytest.raises(InputError, match="do not belong together"):
        replace(scene, tracks=scene.tracks[:2])
    nothing = np.zeros(0, dtype=int)
    strange = Tracks2D("other", nothing, nothing, np.zeros((0, 2)), ())
    with pytest.raises(InputError, match="other"):
        replace(scene, tracks=(*scene.tracks[:3], strange))


def test_folders_that_are_not_as_they_should_be(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        Scene.from_colmap(tmp_path / "nowhere")
    folder = write_scene(simulated(), tmp_path / "s")
    with pytest.raises(InputError, match="no tracks"):
        Scene.from_colmap(folder, "no_such_tracks")
    with pytest.raises(InputError, match="wand"):
        Scene.from_colmap(folder).placed(scale=["tracks:wand_a-wand_z=0.5"])
    with pytest.raises(InputError):
        Scene.from_colmap(folder).placed(scale=["cam0-cam7=1"])
    moved = shutil.move(folder / "sparse", tmp_path / "model")
    with pytest.raises(InputError):
        Scene.from_colmap(folder)
    elsewhere = Scene.from_colmap(folder, folder / "tracks", model=moved)
    assert len(elsewhere.cameras) == 4


def test_a_mirror_is_no_world():
    with pytest.raises(InputError, match="mirror"):
        bare().moved(Similarity(1.0, np.diag([1.0, 1.0, -1.0])))


def test_the_wrong_pixel_origin_shifts_all_dots(tmp_path):
    folder = write_scene(simulated(), tmp_path / "s")
    centre, corner = (Scene.from_colmap(folder, pixel_origin=origin) for origin in ("centre", "corner"))
    for a, b in zip(centre.tracks, corner.tracks, strict=True):
        np.testing.assert_allclose(a.xy - b.xy, 0.5)


def test_a_table_has_what_the_file_has(tmp_path):
    tracks = solved().tracks
    table = tracks.to_table()
    file = tmp_path / "tracks_3d.csv"
    file.write_bytes(tracks_text(tracks))
    written = pd.read_csv(file)
    assert list(table.columns) == list(written.columns)
    assert table["individual"].tolist() == written["individual"].astype(str).tolist()
    assert table["source"].tolist() == written["source"].tolist()
    np.testing.assert_allclose(table[["x", "y", "z"]], written[["x", "y", "z"]], atol=1e-5)
