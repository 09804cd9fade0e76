"""A triangulated scene on disk: every number arrives in every layout, and a folder is whole or absent."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from conftest import look_at
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from acino_fte.data_tools import scene_drawing
from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.camera_paths import CameraPath
from acino_fte.data_tools.colours import colours_of
from acino_fte.data_tools.csv_columns import csv_bytes, decimals, labels
from acino_fte.data_tools.point_cloud import PointCloud, read_ply
from acino_fte.data_tools.scene_drawing import FigureProcess
from acino_fte.data_tools.scene_drawing import scene_drawing as drawing_of
from acino_fte.data_tools.scene_files import SCENE, save_scene
from acino_fte.data_tools.scene_layouts import write_movement
from acino_fte.data_tools.scene_numbers import scene_metrics, summary
from acino_fte.data_tools.scene_tables import length_decimals, tracks_text
from acino_fte.data_tools.scene_tracks import SOURCES, SceneTracks
from acino_fte.data_tools.scene_truth import read_truth
from acino_fte.data_tools.similarity import Similarity
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError
from acino_fte.result_files import check_output_folder

SD = 0.01
COLUMNS = [
    "individual", "frame", "x", "y", "z", "sd_x", "sd_y", "sd_z",
    "source", "n_views", "reprojection_px", "reprojection_max_px",
]  # fmt: skip


def scene_result(n_frames=90, n_cameras=2, n_individuals=2, fps=30.0, scale=True, seed=0, names=None):
    """What a scene's triangulation gives: cameras in a row that move above individuals on spirals.

    The tracks are the truth plus noise with a standard deviation of 10 mm; each individual has a gap, points
    of one view and interpolated ones.
    """
    rng = np.random.default_rng(seed)
    names = tuple(names or (f"bird {k}" for k in range(n_individuals)))
    frames = 100 + np.arange(n_frames)
    phase = np.linspace(0, 6, n_frames)
    truth = np.stack(
        [
            np.stack([2.0 * phase + k, 2.0 * np.cos(phase + k), 1.0 + 0.2 * np.sin(3 * phase)], axis=1)
            for k in range(len(names))
        ]
    )
    cameras, paths = [], []
    for c in range(n_cameras):
        place = np.stack([2.0 * phase, np.full(n_frames, -6.0 - c), np.full(n_frames, 5.0)], axis=1)
        lens = look_at(f"cam {c}", place, truth[0])
        cameras.append(moving(lens, c, frames))
        paths.append(path_of(lens, frames))
    tracks = tracks_of(truth, names, frames, n_cameras, rng)
    views, distance, used = dots_of(cameras, names, frames, rng)
    tracks = replace(tracks, distance=distance, used=used)
    scene = SimpleNamespace(
        cameras=tuple(cameras),
        tracks=views,
        cloud=PointCloud(
            rng.uniform(-5, 15, (500, 3)), rng.integers(0, 256, (500, 3)).astype(np.uint8), rng.random(500)
        ),
        world_from_model=Similarity(2.5, Rotation.from_euler("z", 20, degrees=True).as_matrix(), np.ones(3)),
        fps=fps,
        name="meadow",
        warnings=("a warning of the reader",),
    )
    numbers = {"scale": {"factor": 2.5, "sd": 0.01}} if scale else {}
    numbers["axes"] = {"how": "cameras", "tilt_sd_deg": 0.5}
    return SimpleNamespace(
        scene=scene,
        tracks=tracks,
        points=replace(tracks, smooth=False, position=tracks.position + 0.001),
        paths=tuple(paths),
        rigs=(),
        noise_px=1.25,
        numbers=numbers,
        truth=truth,
    )


def moving(lens, c, frames):
    return KeyedCamera(lens.name, lens, c + 1, frames[::8], lens.rotation[::8], lens.translation[::8])


def path_of(lens, frames):
    """Every frame, with a gap of ten that is not known."""
    known, key = np.ones(len(frames), dtype=bool), np.zeros(len(frames), dtype=bool)
    known[20:30] = False
    key[::8] = True
    covariance = np.zeros((len(frames), 6, 6))
    covariance[:, range(3), range(3)], covariance[:, range(3, 6), range(3, 6)] = 1e-6, 4e-6
    return CameraPath(lens.name, frames, lens.rotation, lens.translation, covariance, known, key & known)


def tracks_of(truth, names, frames, n_cameras, rng):
    n, n_frames = len(names), len(frames)
    kept = np.ones((n, n_frames), dtype=bool)
    kept[:, 50:55] = False
    source = np.zeros((n, n_frames), dtype=int)
    source[:, 10:20], source[:, 60:64] = SOURCES.index("single"), SOURCES.index("interpolated")
    individual, index = np.nonzero(kept)
    source = source[kept]
    n_views = np.where(source == 0, n_cameras, np.where(source == 1, 1, 0))
    n_points = len(source)
    covariance = np.broadcast_to(SD**2 * np.eye(3), (n_points, 3, 3)).copy()
    error = rng.rayleigh(1.0, n_points)
    error[n_views == 0] = np.nan
    return SceneTracks(
        names, individual, frames[index], truth[kept] + rng.normal(0, SD, (n_points, 3)), covariance,
        source, n_views, error, 1.5 * error, (), (), True,
    )  # fmt: skip


def dots_of(cameras, names, frames, rng):
    """Dots of each camera, in any order; the last camera has none."""
    views, distance, used = [], [], []
    for c, camera in enumerate(cameras):
        n = 0 if c == len(cameras) - 1 else len(names) * len(frames)
        order = rng.permutation(n)
        track, frame = np.divmod(order, len(frames)) if n else (order, order)
        views.append(Tracks2D(camera.name, frame + frames[0], track, rng.uniform(0, 700, (n, 2)), names))
        distance.append(np.where(rng.random(n) < 0.05, np.nan, rng.rayleigh(1.0, n)))
        used.append(np.isfinite(distance[-1]) & (rng.random(n) < 0.97))
    return tuple(views), tuple(distance), tuple(used)


@pytest.fixture(scope="module")
def result():
    """Two birds, three cameras."""
    return scene_result(n_cameras=3)


@pytest.fixture(scope="module")
def saved(result, tmp_path_factory):
    """The folder of that result, and its numbers."""
    folder = tmp_path_factory.mktemp("scenes") / "meadow"
    metrics = save_scene(result, folder, options={"rig": "auto"}, seconds={"reading": 0.5})
    return folder, metrics


def read(path):
    return pd.read_csv(path, keep_default_na=False, na_values=[""])


class NoFigures(FigureProcess):
    """Draws nothing; the page is written all the same."""

    def __enter__(self):
        return self

    def draw(self, drawing, folder):
        folder.mkdir()


def nobody(result):
    """The result without any point."""
    none = np.zeros(0, dtype=int)
    tracks = replace(
        result.tracks,
        individual=none, frame=none, source=none, n_views=none, position=np.empty((0, 3)),
        covariance=np.empty((0, 3, 3)), reprojection_median=np.empty(0), reprojection_max=np.empty(0),
        distance=tuple(np.full(len(d), np.nan) for d in result.tracks.distance),
        used=tuple(np.zeros(len(u), dtype=bool) for u in result.tracks.used),
    )  # fmt: skip
    return SimpleNamespace(**{**vars(result), "tracks": tracks, "points": tracks})


# --- tables ------------------------------------------------------------------------------------------


def test_the_folder_has_everything_and_nothing_else(saved):
    folder, _ = saved
    assert {p.name for p in folder.iterdir()} == set(SCENE.files)
    assert {p.name for p in folder.parent.iterdir()} == {"meadow"}  # no temporary folder is left


@pytest.mark.parametrize("name", ["tracks", "points"])
def test_tracks_have_every_point(saved, result, name):
    table, tracks = read(saved[0] / f"{name}_3d.csv"), getattr(result, name)
    assert list(table.columns) == COLUMNS
    assert [tracks.individuals.index(who) for who in table.individual] == tracks.individual.tolist()
    assert [SOURCES.index(source) for source in table.source] == tracks.source.tolist()
    np.testing.assert_array_equal(table.frame, tracks.frame)
    np.testing.assert_array_equal(table.n_views, tracks.n_views)
    np.testing.assert_allclose(table[["x", "y", "z"]], tracks.position, atol=6e-7)
    np.testing.assert_allclose(table[["sd_x", "sd_y", "sd_z"]], SD, atol=6e-7)
    np.testing.assert_allclose(table.reprojection_px, tracks.reprojection_median, atol=6e-5)
    assert table.reprojection_max_px.isna().sum() == (tracks.n_views == 0).sum() > 0


def test_without_smoothing_there_is_one_table_of_points(result, tmp_path):
    plain = SimpleNamespace(**{**vars(result), "tracks": replace(result.tracks, smooth=False)})
    save_scene(plain, tmp_path / "out", formats=(), figures=False)
    tables = {"tracks_3d.csv", "observations.csv", "camera_paths.csv", "metrics.json"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == tables


def test_observations_keep_every_row_of_the_files(saved, result):
    table = read(saved[0] / "observations.csv")
    assert len(table) == sum(map(len, result.scene.tracks))
    for view, distance, used in zip(
        result.scene.tracks, result.tracks.distance, result.tracks.used, strict=True
    ):
        mine = table[table.camera == view.camera]
        np.testing.assert_array_equal(mine.frame, view.frame)
        assert list(mine.individual) == [view.labels[k] for k in view.track]
        np.testing.assert_allclose(mine[["x", "y"]], view.xy, atol=6e-5)
        np.testing.assert_allclose(mine.reprojection_px, distance, atol=6e-5)
        np.testing.assert_array_equal(mine.used.astype(bool), used)


def test_bare_points_have_no_individual(result, tmp_path):
    first = replace(result.scene.tracks[0], track=np.full(len(result.scene.tracks[0]), -1))
    scene = SimpleNamespace(**{**vars(result.scene), "tracks": (first, *result.scene.tracks[1:])})
    bare = SimpleNamespace(**{**vars(result), "scene": scene})
    save_scene(bare, tmp_path / "out", formats=(), figures=False)
    table = read(tmp_path / "out" / "observations.csv")
    assert table.individual[table.camera == first.camera].isna().all()
    assert table.individual[table.camera != first.camera].notna().all()


def test_camera_paths_give_the_cameras_back(saved, result):
    table = read(saved[0] / "camera_paths.csv")
    assert len(table) == sum(len(path.frame) for path in result.paths)
    for path in result.paths:
        mine = table[table.camera == path.name]
        np.testing.assert_array_equal(mine.known.astype(bool), path.known)
        np.testing.assert_array_equal(mine.key.astype(bool), path.key)
        there = mine[path.known]
        rotation = Rotation.from_quat(there[["qx", "qy", "qz", "qw"]]).as_matrix()
        np.testing.assert_allclose(rotation, path.rotation[path.known], atol=1e-8)
        np.testing.assert_allclose(there[["x", "y", "z"]], path.centre[path.known], atol=6e-7)
        assert (there.qw >= 0).all()
        np.testing.assert_allclose(there.sd_centre_m, 0.002, atol=1e-6)
        np.testing.assert_allclose(there.sd_rotation_deg, np.degrees(0.001), atol=1e-6)
        assert mine[~path.known].drop(columns=["camera", "frame", "known", "key"]).isna().all().all()


def test_names_are_what_they_were(tmp_path):
    names = ('Ann, "the first"', "nan", "Zoë\nB", "")
    result = scene_result(names=names)
    save_scene(result, tmp_path / "out", formats=("netcdf", "ply"), figures=False)
    for name in ("tracks_3d", "observations"):
        table = pd.read_csv(tmp_path / "out" / f"{name}.csv", keep_default_na=False)
        assert set(table.individual) == set(names)
        assert table.x.dtype == float


def test_small_scenes_keep_their_digits():
    position = np.array([[0.0, 0.0, 0.0], [0.004, 0.001, 0.002]])
    assert length_decimals(position) >= 9
    assert length_decimals(1e6 * position) == length_decimals(np.empty((0, 3))) == 6
    result = scene_result(n_frames=70, scale=False)
    small = replace(result.tracks, position=1e-5 * result.tracks.position)
    text = tracks_text(small, length_decimals(small.position))
    rows = [line.split(",") for line in text.decode().splitlines()[1:]]
    found = np.array([[float(cell) for cell in row[2:5]] for row in rows])
    np.testing.assert_allclose(found, small.position, atol=1e-6 * np.ptp(small.position))


def one_column(cells):
    return csv_bytes({"a": cells}).decode().split("\n")[1:-1]


@pytest.mark.parametrize("places", [0, 1, 3, 6, 9])
def test_numbers_are_what_formatting_makes_of_them(places):
    rng = np.random.default_rng(3)
    values = rng.normal(size=4000) * 10.0 ** rng.integers(-8, 6, 4000)
    values[:6] = 0.0, 1.0, -1.0, 9.9999999, 123456.0, -0.5 * 10.0**-places
    found = one_column(decimals(values, places))
    for text, value in zip(found, values, strict=True):
        assert abs(float(text) - value) <= 0.5000001 * 10.0**-places + 1e-15 * abs(value)
        assert len(text.partition(".")[2]) == places
        assert text == f"{float(text):.{places}f}"


def test_numbers_that_are_none_and_very_large_ones():
    assert one_column(decimals(np.array([np.nan, np.inf, -np.inf, 2.0]), 2)) == ["", "", "", "2.00"]
    assert one_column(decimals(np.array([1e15, -2.5, np.nan]), 3))[1:] == ["-2.500", ""]
    assert float(one_column(decimals(np.array([1e15]), 3))[0]) == 1e15
    assert one_column(decimals(np.array([True, False]), 0)) == ["1", "0"]
    assert one_column(decimals(np.array([-12, 7, 0]), 0)) == ["-12", "7", "0"]
    assert one_column(decimals(np.empty(0), 3)) == one_column(labels([], np.empty(0, dtype=int))) == []


# --- layouts of other programs -----------------------------------------------------------------------


def as_movement(tracks, fps):
    """The dataset of the movement package, by xarray."""
    first, n = tracks.frame.min(), int(np.ptp(tracks.frame)) + 1
    arrays = {}
    for name, values in (("position", tracks.position), ("position_sd", tracks.standard_deviation)):
        dense = np.full((n, 3, 1, len(tracks.individuals)), np.nan, np.float32)
        for value, frame, who in zip(values, tracks.frame, tracks.individual, strict=True):
            dense[frame - first, :, 0, who] = value
        arrays[name] = (("time", "space", "keypoints", "individuals"), dense)
    frames = np.arange(first, first + n)
    return xr.Dataset(
        arrays,
        {
            "time": frames if fps is None else frames / fps,
            "space": ["x", "y", "z"],
            "keypoints": ["centroid"],
            "individuals": list(tracks.individuals),
        },
    )


@pytest.mark.parametrize("fps", [None, 30.0])
def test_netcdf_opens_as_movement_keeps_poses(result, tmp_path, fps):
    write_movement(result.tracks, tmp_path / "tracks.nc", fps)
    with xr.open_dataset(tmp_path / "tracks.nc", engine="h5netcdf") as dataset:
        expected = as_movement(result.tracks, fps)
        xr.testing.assert_equal(dataset[["position", "position_sd"]].load(), expected)
        assert dataset.position.dtype == np.float32
        assert dataset.confidence.dims == ("time", "keypoints", "individuals")
        assert dataset.attrs["ds_type"] == "poses"
        assert dataset.attrs["time_unit"] == ("frames" if fps is None else "seconds")
        assert dataset.attrs.get("fps") == fps
        assert dataset.attrs["frame_offset"] == 100
        there = dataset.source.values >= 0
        np.testing.assert_array_equal(there, np.isfinite(dataset.position.values[:, 0]))
        assert there.sum() == len(result.tracks)


def test_large_netcdf_is_packed(result, tmp_path, monkeypatch):
    write_movement(result.tracks, tmp_path / "plain.nc", 30.0)
    monkeypatch.setattr("acino_fte.data_tools.scene_layouts._SMALL", 10)
    write_movement(result.tracks, tmp_path / "packed.nc", 30.0)
    with (
        xr.open_dataset(tmp_path / "plain.nc", engine="h5netcdf") as plain,
        xr.open_dataset(tmp_path / "packed.nc", engine="h5netcdf") as packed,
    ):
        xr.testing.assert_identical(plain.load(), packed.load())
        assert packed.position.encoding["zlib"]


def test_ply_has_a_colour_for_each_individual(saved, result):
    vertices = PlyData.read(saved[0] / "tracks_3d.ply")["vertex"].data
    tracks = result.tracks
    np.testing.assert_allclose(np.stack([vertices[a] for a in "xyz"], 1), tracks.position, atol=1e-5)
    np.testing.assert_array_equal(vertices["individual"], tracks.individual)
    np.testing.assert_array_equal(vertices["frame"], tracks.frame)
    rgb = np.stack([vertices[c] for c in ("red", "green", "blue")], 1)
    np.testing.assert_array_equal(rgb, np.round(255 * colours_of(2))[tracks.individual])


def test_the_cloud_is_written_as_it_is(saved, result):
    cloud = read_ply(saved[0] / "cloud.ply")
    np.testing.assert_allclose(cloud.xyz, result.scene.cloud.xyz, atol=1e-5)
    np.testing.assert_array_equal(cloud.rgb, result.scene.cloud.rgb)


# --- numbers -----------------------------------------------------------------------------------------


def test_metrics_count_what_is_there(saved, result):
    folder, metrics = saved
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    tracks = result.tracks
    assert metrics["status"] == "triangulated"
    assert metrics["options"] == {"rig": "auto"}
    assert metrics["frames"] == [100, 190]
    assert metrics["n_points"]["all"] == len(tracks)
    for k, name in enumerate(SOURCES):
        assert metrics["n_points"][name] == (tracks.source == k).sum() > 0
    used = np.concatenate([d[u] for d, u in zip(tracks.distance, tracks.used, strict=True)])
    assert metrics["reprojection_px"]["median"] == pytest.approx(np.median(used))
    assert metrics["reprojection_px"]["max"] == pytest.approx(used.max())
    assert metrics["reprojection_px"]["count"] == len(used)
    assert list(metrics["cameras"]) == ["cam 0", "cam 1", "cam 2"]
    assert metrics["cameras"]["cam 2"]["rows"] == 0
    assert metrics["reprojection_px"]["per_camera"]["cam 2"]["median"] is None
    assert metrics["warnings"] == ["a warning of the reader"]
    assert metrics["world_from_model"]["scale"] == 2.5
    assert metrics["seconds"]["total"] >= metrics["seconds"]["reading"] == 0.5
    assert np.linalg.det(metrics["world_from_model"]["rotation"]) == pytest.approx(1.0)


def test_distances_between_individuals_need_both(result):
    pair = scene_metrics(result)["distances"][0]
    both = [f for f in range(100, 190) if not (150 <= f < 155 or 110 <= f < 120 or 160 <= f < 164)]
    assert pair["individuals"] == ["bird 0", "bird 1"]
    assert pair["count"] == len(both)
    length = np.linalg.norm(result.truth[0] - result.truth[1], axis=1)[np.array(both) - 100]
    assert pair["mean"] == pytest.approx(length.mean(), abs=SD)


def test_summary_tells_of_distances_that_are_steady():
    pairs = [
        {"individuals": ["a", "b"], "mean": 0.5, "sd": 0.002, "count": 7},
        {"individuals": ["a", "c"], "mean": 0.5, "sd": 0.2, "count": 8},
    ]
    said = "\n".join(
        summary({**scene_metrics(scene_result(n_frames=80)), "distances": pairs, "seconds": {"total": 1.0}})
    )
    assert "distance a – b: 0.5000 m ± 2.0 mm over 7 frames" in said
    assert "a – c" not in said


def test_summary_says_what_users_ask(saved):
    said = "\n".join(summary(saved[1]))
    for part in ("2 individuals in 90 frames of 3 cameras", "reprojection", "noise 1.25 px", "scale 2.5 m"):
        assert part in said
    assert "0.4 %" in said  # of the scale
    assert "upright by cameras" in said


def test_without_scale_no_metres_are_claimed(tmp_path):
    metrics = save_scene(scene_result(scale=False), tmp_path / "out", figures=NoFigures())
    said = "\n".join(summary(metrics))
    assert "no scale" in said and " m " not in said and "mm" not in said
    assert metrics["unit"] == "model units"
    assert "not metres" in (tmp_path / "out" / "report.html").read_text()
    with xr.open_dataset(tmp_path / "out" / "tracks_3d.nc", engine="h5netcdf") as dataset:
        assert dataset.attrs["space_unit"] == "model units"


def test_nothing_triangulated_is_saved_and_said(result, tmp_path):
    metrics = save_scene(nobody(result), tmp_path / "out", figures=NoFigures())
    assert metrics["status"] == "nothing_triangulated"
    assert metrics["reprojection_px"]["count"] == 0
    assert len(read(tmp_path / "out" / "tracks_3d.csv")) == 0
    assert len(read(tmp_path / "out" / "observations.csv")) == sum(map(len, result.scene.tracks))
    assert "Nothing was triangulated" in (tmp_path / "out" / "report.html").read_text()
    assert summary(metrics)


# --- truth -------------------------------------------------------------------------------------------


def truth_file(result, path, change=None, name="individual"):
    """The truth in a world of its own."""
    change = change or Similarity(
        1.0, Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix(), np.ones(3)
    )
    rows = [
        (frame, who, *point)
        for who, path_of in zip(result.tracks.individuals, result.truth, strict=True)
        for frame, point in zip(range(100, 100 + path_of.shape[0]), change.points(path_of), strict=True)
    ]
    table = pd.DataFrame(rows, columns=["frame", name, *"xyz"]).sample(frac=1.0, random_state=0)
    table.to_csv(path, index=False)
    return path


def test_the_truth_may_lie_anywhere(result, tmp_path):
    truth = read_truth(truth_file(result, tmp_path / "truth.csv", name="identity"))
    scores = scene_metrics(result, truth=truth)["truth_mm"]
    assert scores["alignment"] == "rigid"
    assert scores["scale"] == pytest.approx(1.0, abs=2e-3)
    assert scores["tracks"]["all"]["count"] == len(result.tracks)
    assert scores["tracks"]["all"]["rmse"] == pytest.approx(1000 * SD * np.sqrt(3), rel=0.15)
    assert scores["tracks"]["nees_over_3"] == pytest.approx(1.0, abs=0.25)
    assert scores["tracks"]["pair_distance"]["rmse"] == pytest.approx(1000 * SD * np.sqrt(2), rel=0.3)


def test_the_scale_of_the_truth_shows_errors_of_ours(result, tmp_path):
    far = Similarity(1.02, np.eye(3), np.zeros(3))
    truth = read_truth(truth_file(result, tmp_path / "truth.csv", far))
    rigid = scene_metrics(result, truth=truth)["truth_mm"]
    assert rigid["scale"] == pytest.approx(1.02, abs=2e-3)
    assert rigid["tracks"]["views"]["rmse"] > 40.0
    loose = SimpleNamespace(**{**vars(result), "numbers": {"scale": None}})
    free = scene_metrics(loose, truth=truth)["truth_mm"]
    assert free["alignment"] == "similarity"
    assert free["tracks"]["views"]["rmse"] < 25.0


def test_wild_points_do_not_turn_the_truth(result, tmp_path):
    truth = read_truth(truth_file(result, tmp_path / "truth.csv"))
    position = result.tracks.position.copy()
    position[::30] += 5.0
    wild = SimpleNamespace(**{**vars(result), "tracks": replace(result.tracks, position=position)})
    scores = scene_metrics(wild, truth=truth)["truth_mm"]["tracks"]
    assert scores["views"]["median"] < 25.0
    assert scores["views"]["rmse"] > 500.0


def test_another_s_truth_is_refused(result, tmp_path):
    table = pd.read_csv(truth_file(result, tmp_path / "truth.csv"))
    table.assign(individual="somebody").to_csv(tmp_path / "other.csv", index=False)
    with pytest.raises(InputError, match="bird 0"):
        scene_metrics(result, truth=read_truth(tmp_path / "other.csv"))


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("frame,x,y,z\n1,2,3,4\n", "individual"),
        ("frame,individual,x,y,z\n1.5,a,1,2,3\n", "row 2"),
        ("", "cannot be read"),
    ],
)
def test_truth_that_is_none_is_refused(tmp_path, content, word):
    (tmp_path / "truth.csv").write_text(content)
    with pytest.raises(InputError, match=word):
        read_truth(tmp_path / "truth.csv")


# --- whole or absent ---------------------------------------------------------------------------------


def test_a_failure_leaves_the_folder_as_it_was(result, tmp_path, monkeypatch):
    out = tmp_path / "out"
    save_scene(result, out, formats=(), figures=False)
    before = {p.name: p.read_bytes() for p in out.iterdir()}

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("acino_fte.data_tools.scene_files.paths_text", full)
    with pytest.raises(InputError, match="No space left"):
        save_scene(scene_result(seed=5), out, figures=False)
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before
    assert {p.name for p in tmp_path.iterdir()} == {"out"}


def test_an_earlier_scene_is_replaced_and_foreign_files_are_not(result, tmp_path):
    out = tmp_path / "out"
    save_scene(result, out, figures=False)
    save_scene(result, check_output_folder(out, contents=SCENE), formats=(), figures=False)
    assert not (out / "tracks_3d.nc").exists()
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="notes.txt"):
        check_output_folder(out, contents=SCENE)


# --- the process that draws --------------------------------------------------------------------------


def gone(artist):
    """Whether its process has ended and was waited for."""
    return artist._process is None or artist._process.returncode is not None


def test_a_process_draws(result, tmp_path):
    with FigureProcess() as artist:
        artist.draw(drawing_of(result), tmp_path / "figures")
        artist.wait()
        assert artist._process.returncode == 0
    assert {p.name for p in (tmp_path / "figures").iterdir()} == {
        f"{name}.{kind}" for name in ("scene", "quality") for kind in ("png", "pdf")
    }


@pytest.mark.parametrize("fault", ["dies", "is not there", "hangs", "is none"])
def test_figures_are_drawn_here_when_the_process_fails(result, tmp_path, monkeypatch, fault):
    drawn = []
    monkeypatch.setattr("acino_fte.data_tools.scene_plots.save_scene_figures", lambda *a: drawn.append(a))
    if fault == "dies":
        monkeypatch.setattr(scene_drawing, "_CHILD", "raise SystemExit(3)")
    elif fault == "hangs":
        monkeypatch.setattr(scene_drawing, "_CHILD", "import time; time.sleep(60)")
        monkeypatch.setattr(scene_drawing, "_PATIENCE", 0.1)
    elif fault == "is none":
        monkeypatch.setattr(scene_drawing.sys, "executable", None)
    else:
        monkeypatch.setattr(scene_drawing.sys, "executable", str(tmp_path / "no-python"))
    drawing = drawing_of(result)
    with FigureProcess() as artist:
        artist.draw(drawing, tmp_path / "figures")
        artist.wait()
    assert drawn == [(drawing, tmp_path / "figures")]
    assert gone(artist)


def test_a_process_that_is_not_needed_any_more_ends(result, tmp_path, monkeypatch):
    monkeypatch.setattr(scene_drawing, "_CHILD", "import time; time.sleep(60)")
    with FigureProcess() as idle:
        pass
    assert gone(idle)
    assert not Path(idle._folder.name).exists()
    with pytest.raises(InputError), FigureProcess() as busy:
        busy.draw(drawing_of(result), tmp_path / "figures")
        raise InputError("something else went wrong")
    assert gone(busy)
    assert not (tmp_path / "figures").exists()


def test_a_process_without_a_parent_ends_by_itself(result):
    with FigureProcess() as artist:
        process = artist._process
        process.stdin.close()
        assert process.wait(timeout=60) == 0


def test_errors_of_the_figures_are_not_lost(result, tmp_path, monkeypatch):
    def wrong(*_):
        raise ValueError("wrong")

    monkeypatch.setattr(scene_drawing, "_CHILD", "raise SystemExit(3)")
    monkeypatch.setattr("acino_fte.data_tools.scene_plots.save_scene_figures", wrong)
    with pytest.raises(ValueError, match="wrong"):
        save_scene(result, tmp_path / "out")
    assert not (tmp_path / "out").exists()
