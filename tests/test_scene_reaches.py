"""What scenes must reach on data that were made elsewhere: a rig of moving cameras with its truth and what
MultiViewTracks makes of it, two models of COLMAP. All numbers are those of the issue.

The rig's tracks count pixels as COLMAP does, from the corner of the first pixel: they are read with
``pixel_origin="corner"``. What the wrong origin costs is tested as well.
"""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scene_worlds import DATA, nees, random_similarity, rms

pytest.importorskip("pycolmap")

from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.colmap import read_colmap
from acino_fte.data_tools.colmap_images import keyed_cameras, parse_image_names
from acino_fte.data_tools.point_cloud import PointCloud
from acino_fte.data_tools.scene import Scene
from acino_fte.data_tools.scene_points import triangulate_points
from acino_fte.data_tools.scene_rows import scene_rows
from acino_fte.data_tools.scene_scale import KnownDistance
from acino_fte.data_tools.scene_tracks import SOURCES
from acino_fte.data_tools.tracks2d import Tracks2D

VIEWS, SINGLE, _ = range(len(SOURCES))
SETS = ("mvt_rig", "mvt_rig_fisheye")
MM = 1000.0


def needs(name):
    return pytest.mark.skipif(not (DATA / name).is_dir(), reason=f"the data set shared/data/{name} is absent")


both = pytest.mark.parametrize("name", [pytest.param(name, marks=needs(name)) for name in SETS])


@cache
def read(name, tracks="tracks", origin="corner"):
    return Scene.from_colmap(DATA / name, tracks, fps=30.0, pixel_origin=origin)


@cache
def solved(name, rig="auto", tracks="tracks", origin="corner"):
    """The set in metres (one side of the rig is known), triangulated."""
    return read(name, tracks, origin).placed(scale=["1-3=0.6"], gravity="cameras").triangulate(rig)


@cache
def gauge(name):
    """Points of the model to the true world: (x / s) @ Rg + c."""
    truth = json.loads((DATA / name / "scene.json").read_text())
    return truth["s"], np.array(truth["Rg"]), np.array(truth["c"])


@cache
def truth(name):
    """True positions (2, N, 3), m, and the number of views of each (2, N)."""
    table = pd.read_csv(DATA / name / "gt_points.csv")
    position = np.full((2, table.frame.max() + 1, 3), np.nan)
    position[table.identity, table.frame] = table[["x", "y", "z"]]
    views = np.zeros(position.shape[:2], dtype=int)
    views[table.identity, table.frame] = table.n_views
    return position, views


def theirs(name):
    """RMSE of wand and position of MultiViewTracks, points of two views or more, mm."""
    metrics = json.loads((DATA / name / "mvt_metrics.json").read_text())
    return MM * metrics["wand_triangulated"]["rmse_m"], MM * metrics["pos_tri_all"]["rmse_m"]


def errors(name, result, tracks):
    """Vectors (T, 3) from the truth, m, with the true gauge, and covariances there."""
    s, turn, shift = gauge(name)
    home = result.scene.world_from_model.inverse()
    who = np.array([int(label) for label in tracks.individuals])[tracks.individual]
    found = home.points(tracks.position) / s @ turn + shift
    covariance = turn.T @ (home.covariance(tracks.covariance) / s**2) @ turn
    return found - truth(name)[0][who, tracks.frame], covariance


def position(name, result, tracks, source=VIEWS):
    """RMSE of the positions, mm."""
    error, _ = errors(name, result, tracks)
    return MM * rms(np.linalg.norm(error[tracks.source == source], axis=1))


def score(name, result, tracks, source=VIEWS):
    """NEES/3."""
    error, covariance = errors(name, result, tracks)
    mine = tracks.source == source
    return nees(error[mine], covariance[mine]).mean()


def wand(result, tracks, single=False):
    """Errors of the wand's length, mm: both ends from two views or more, or one or both from a single one."""
    ends = np.full((2, tracks.frame.max() + 1, 3), np.nan)
    source = np.full(ends.shape[:2], -1)
    ends[tracks.individual, tracks.frame], source[tracks.individual, tracks.frame] = (
        tracks.position,
        tracks.source,
    )
    there = (source == VIEWS).all(0)
    if single:
        there = ((source == VIEWS) | (source == SINGLE)).all(0) & ~there
    return MM * (np.linalg.norm(ends[0] - ends[1], axis=1)[there] - 0.5)


LIMITS = {"mvt_rig": 3.3, "mvt_rig_fisheye": 3.5}


@both
def test_points_with_the_rig(name):
    """Wand at most 3.3 and 3.5 mm, position at most 7.5 mm."""
    result = solved(name)
    assert [rig.names for rig in result.rigs] == [("i_0_cut", "j_0_cut", "m_0_cut", "n_0_cut")]
    assert rms(wand(result, result.points)) <= LIMITS[name]
    assert position(name, result, result.points) <= 7.5
    assert len(result.points) == (truth(name)[1] >= 2).sum()  # all of them


@both
def test_points_without_the_rig(name):
    """Wand at most as MultiViewTracks has it, position at most 0.93 times that."""
    result = solved(name, "none")
    theirs_wand, theirs_position = theirs(name)
    assert result.rigs == ()
    assert rms(wand(result, result.points)) <= theirs_wand
    assert position(name, result, result.points) <= 0.93 * theirs_position
    assert len(result.points) >= 0.999 * (truth(name)[1] >= 2).sum()


@both
def test_smooth_tracks(name):
    """Wand at most 2.0 mm, position at most 4.5 mm."""
    result = solved(name)
    assert rms(wand(result, result.tracks)) <= 2.0
    assert position(name, result, result.tracks) <= 4.5


@both
def test_single_views(name):
    """Position at most 32 mm, no error of the wand above 0.2 m."""
    result = solved(name)
    assert (result.tracks.source == SINGLE).sum() >= 0.99 * (truth(name)[1] == 1).sum()  # few have no depth
    assert position(name, result, result.tracks, SINGLE) <= 32.0
    assert np.abs(wand(result, result.tracks, single=True)).max() <= 200.0
    assert np.abs(wand(result, result.tracks)).max() <= 200.0


@both
def test_gross_outliers(name):
    """Two in a hundred: smooth wand at most 2.5 mm; points: 95 % within 10 mm, 98 % of them kept."""
    result = solved(name, tracks="tracks_outlier")
    assert rms(wand(result, result.tracks)) <= 2.5
    assert np.percentile(np.abs(wand(result, result.points)), 95) <= 10.0
    assert len(result.points) >= 0.98 * (truth(name)[1] >= 2).sum()
    assert position(name, result, result.points) <= 7.5


@both
@pytest.mark.parametrize("tracks", ["tracks", "tracks_outlier"])
@pytest.mark.parametrize("rig", ["auto", "none"])
def test_errors_are_as_large_as_they_say(name, rig, tracks):
    """NEES/3 from 0.8 to 1.3, with the noise that the data tell.

    Without the rig too, although these cameras bob together between their key frames.
    """
    result = solved(name, rig, tracks)
    assert 0.8 <= score(name, result, result.points) <= 1.3
    assert 0.8 <= score(name, result, result.tracks) <= 1.3
    assert score(name, result, result.tracks, SINGLE) <= 2.0
    assert result.noise_px == pytest.approx(1.0, rel=0.03 if rig == "auto" else 0.1)


@both
def test_the_wrong_pixel_origin_costs_little(name):
    """Half a pixel: a fifth of a millimetre of position, and a larger NEES."""
    right, wrong = solved(name), solved(name, origin="centre")
    for which in ("points", "tracks"):
        good, bad = (position(name, r, getattr(r, which)) for r in (right, wrong))
        assert good < bad < good + 0.25
        assert score(name, right, right.points) < score(name, wrong, wrong.points) < 1.3
    assert position(name, wrong, wrong.tracks) <= 4.5 and rms(wand(wrong, wrong.tracks)) <= 2.0


def shortened(scene, stop):
    """The scene up to a frame."""
    cameras, tracks = [], []
    for camera, view in zip(scene.cameras, scene.tracks, strict=True):
        n = int(np.searchsorted(camera.frame, stop))
        part = {key: getattr(camera, key)[:n] for key in ("frame", "rotation", "translation")}
        covariance = None if camera.covariance is None else camera.covariance[:n]
        cameras.append(replace(camera, covariance=covariance, **part))
        tracks.append(view.at_rows(view.frame < stop))
    return replace(scene, cameras=tuple(cameras), tracks=tuple(tracks))


@needs("mvt_rig")
@pytest.mark.parametrize("rig", ["auto", "none"])
def test_the_gauge_of_the_model_means_nothing(rig):
    """Five random similarities, 0.01 to 100 times the size: the same to a millionth of a metre, no mirror."""
    scene = shortened(read("mvt_rig"), 900)
    known = ["1-3=0.6", "tracks:0-1=0.5"]
    first = scene.placed(scale=known).triangulate(rig)
    assert len(first.tracks) > 1500
    for seed in range(5):
        moved = scene.moved(random_similarity(np.random.default_rng(seed))).placed(scale=known)
        assert np.linalg.det(moved.world_from_model.rotation) == pytest.approx(1.0, abs=1e-9)
        result = moved.triangulate(rig)
        for mine, other in ((result.tracks, first.tracks), (result.points, first.points)):
            np.testing.assert_array_equal(mine.frame, other.frame)
            np.testing.assert_array_equal(mine.source, other.source)
            np.testing.assert_allclose(mine.position, other.position, atol=1e-6)
            np.testing.assert_allclose(mine.covariance, other.covariance, atol=1e-8)
        assert result.noise_px == pytest.approx(first.noise_px, rel=1e-6)


def scene_of(folder):
    """A model without tracks."""
    model = read_colmap(folder)
    cameras = keyed_cameras(model, parse_image_names(model.names))
    nothing = np.zeros(0, dtype=int)
    tracks = [Tracks2D(c.name, nothing, nothing, np.zeros((0, 2)), ()) for c in cameras]
    return Scene(folder.name, cameras, tuple(tracks), model.cloud)


@needs("kitti_vo")
def test_text_and_binary_are_the_same_scene():
    text, binary = (read_colmap(DATA / "kitti_vo" / f"colmap_{kind}") for kind in ("txt", "bin"))
    assert text.names == binary.names
    for key in ("image_ids", "camera_ids", "observed_image", "observed_point"):
        np.testing.assert_array_equal(getattr(text, key), getattr(binary, key))
    for key in ("rotation", "translation", "observed_xy"):
        np.testing.assert_allclose(getattr(text, key), getattr(binary, key), atol=1e-9)
    np.testing.assert_allclose(text.cloud.xyz, binary.cloud.xyz, atol=1e-9)
    for number, camera in text.cameras.items():
        np.testing.assert_allclose(camera.matrix, binary.cameras[number].matrix)


@needs("kitti_vo")
@pytest.mark.parametrize("frames", [(0, 19), (3, 16), (0, 10)])
def test_the_distance_of_left_and_right_follows_from_the_way(frames):
    """0.537 m to 2 %, from how far the left camera came, as its satellite receiver has it."""
    poses = np.loadtxt(DATA / "kitti_vo" / "poses.txt").reshape(-1, 3, 4)
    first, last = frames
    way = float(np.linalg.norm(poses[last, :, 3] - poses[first, :, 3]))
    known = KnownDistance("places", f"cam_left@{first}", f"cam_left@{last}", way)
    scene = scene_of(DATA / "kitti_vo" / "colmap_bin").placed(scale=[known], gravity="none")
    left, right = scene.cameras
    assert (left.name, right.name) == ("cam_left", "cam_right")
    _, a, b = np.intersect1d(left.frame, right.frame, return_indices=True)
    distance = np.linalg.norm(left.centre[a] - right.centre[b], axis=1)
    assert np.median(distance) == pytest.approx(0.537, rel=0.02)
    assert np.linalg.norm(left.centre[last] - left.centre[first]) == pytest.approx(way, rel=0.01)


@needs("colmap_lund_door")
def test_model_points_are_found_again_from_their_observations():
    """Every image is a camera, every point an individual of one frame: within 1e-3 of the extent."""
    model = read_colmap(DATA / "colmap_lund_door")
    names = [str(p) for p in range(len(model.cloud.xyz))]
    zero = np.zeros(1, dtype=int)
    cameras, tracks = [], []
    for i, image in enumerate(model.names):
        pose = model.rotation[i : i + 1], model.translation[i : i + 1]
        cameras.append(KeyedCamera(image, model.cameras[model.camera_ids[i]], 1, zero, *pose))
        mine = model.observed_image == i
        xy, frame = model.observed_xy[mine], np.zeros(int(mine.sum()), dtype=int)
        tracks.append(Tracks2D(image, frame, model.observed_point[mine], xy, tuple(names)))
    scene = Scene("door", tuple(cameras), tuple(tracks), PointCloud(model.cloud.xyz, None, None))
    views = scene.camera_paths("none").views
    still = tuple(replace(path, covariance=np.zeros_like(path.covariance)) for path in views.bases)
    views = replace(views, bases=still)
    rows = scene_rows(views, tracks, names)
    fit = triangulate_points(rows, views, noise_px=1.0)  # the median point has 0.2 px, the model keeps 4 px
    extent = float(np.linalg.norm(np.ptp(model.cloud.xyz, axis=0)))
    distance = np.linalg.norm(fit.position - model.cloud.xyz[rows.individual], axis=1)
    assert rows.n_points == len(names) and np.isfinite(distance).all()
    assert rms(distance) <= 1e-3 * extent
    assert np.percentile(distance, 99.9) <= 1e-4 * extent and np.median(distance) <= 1e-5 * extent
