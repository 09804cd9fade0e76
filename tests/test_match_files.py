"""A matching on disk: every row of the input accounted for, and layouts that other programs read."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
import pytest
import xarray as xr

from acino_fte.data_tools.dltdv_files import read_xypts, read_xyzpts
from acino_fte.data_tools.epipolar import fundamental_matrix
from acino_fte.data_tools.load_tracks import load_tracks
from acino_fte.data_tools.match_files import MATCHING, save_matches
from acino_fte.data_tools.match_methods import thesis_matches
from acino_fte.data_tools.match_numbers import match_metrics
from acino_fte.data_tools.match_points import (
    SOURCE_NAMES,
    epipolar_residuals,
    matched_pairs,
    predicted_pixels,
    row_errors,
    sampson_of_rows,
    space_points,
)
from acino_fte.data_tools.match_tables import (
    matches_table,
    movement_dataset,
    observations_table,
    tracks_table,
)
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_evidence import Noise
from acino_fte.data_tools.track_folder import write_tracks
from acino_fte.data_tools.track_matching import MatchOptions, TrackMatches, match_tracks
from acino_fte.data_tools.tracks2d import BARE
from acino_fte.errors import InputError


def true_matches(recording, noise=1.0):
    """The true animals as the matching, without paths."""
    offset, pieces = 0, []
    for view in recording.views:
        pieces.append(np.where(view.track >= 0, view.track + offset, -1))
        offset += len(view.labels)
    return TrackMatches(
        recording,
        tuple(np.asarray(view.animal).astype(np.int64) for view in recording.views),
        tuple(np.where(np.asarray(view.animal) >= 0, 0.9, np.nan) for view in recording.views),
        tuple(pieces),
        np.full(offset, -1),
        np.zeros(offset),
        Noise(noise),
    )


@pytest.fixture(scope="module")
def recording():
    """Fragments with gaps and clutter from two cameras."""
    options = TrackSimulation(
        n_animals=4, n_frames=150, tracks="fragments", missed=0.08, clutter=0.08, noise_px=2.0, seed=3
    )
    return simulate_tracks(options)


@pytest.fixture(scope="module")
def matches(recording):
    return match_tracks(recording)


@pytest.fixture(scope="module")
def saved(matches, tmp_path_factory):
    folder = tmp_path_factory.mktemp("out") / "matched"
    return folder, save_matches(matches, folder, figures=False)


# --- rows of the input -------------------------------------------------------------------------------


def test_observations_have_every_row_in_its_order(matches, saved):
    table = pd.read_csv(saved[0] / "observations.csv")
    assert list(table) == ["group", "confidence", "camera", "frame", "track", "x", "y"]
    start = 0
    for view, group in zip(matches.recording.views, matches.groups, strict=True):
        part = table[start : start + len(view)]
        start += len(view)
        assert (part.camera == view.camera).all()
        np.testing.assert_array_equal(part.frame, view.frame)
        np.testing.assert_allclose(part[["x", "y"]], view.xy)
        np.testing.assert_array_equal(part.group.fillna(-1), group)
        assert (part.confidence.isna() == part.group.isna()).all()
        np.testing.assert_array_equal(part.track.astype(str), np.array(view.labels, dtype=object)[view.track])
    assert start == len(table)
    assert table.group.isna().any()


def test_rows_without_a_dot_and_in_any_order_stay_where_they_were(recording, tmp_path):
    folder = write_tracks(recording, tmp_path / "r")
    rng = np.random.default_rng(0)
    given = {}
    for n in range(2):
        path, truth = folder / f"cam{n}.csv", folder / f"cam{n}_truth.csv"
        order = rng.permutation(len(pd.read_csv(path)))
        table = pd.read_csv(path).iloc[order].reset_index(drop=True)
        table.loc[[0, 7, len(table) - 1], ["x", "y"]] = np.nan
        table.to_csv(path, index=False)
        pd.read_csv(truth).iloc[order].to_csv(truth, index=False)
        given[n] = table
    matches = match_tracks(load_tracks(folder))
    table = observations_table(matches)
    expected = pd.concat(given.values(), ignore_index=True)
    np.testing.assert_array_equal(table.frame.astype(int), expected.frame)
    np.testing.assert_allclose(table[["x", "y"]].astype(float), expected[["x", "y"]], equal_nan=True)
    assert list(table.track.astype(str)) == list(expected.track.astype(str))
    empty = table.x.isna()
    assert empty.sum() == 6
    assert table.group[empty].isna().all()
    assert table.group[~empty].notna().mean() > 0.8
    cameras = [camera for camera, part in zip(matches.recording.cameras.names, given.values(), strict=True)
               for _ in range(len(part))]  # fmt: skip
    assert list(table.camera) == cameras


def test_matches_add_up_to_the_matched_rows(matches):
    table = matches_table(matches)
    for k, view in enumerate(matches.recording.views):
        mine = table[table.camera == view.camera]
        for group in range(matches.n_groups):
            rows = matches.groups[k] == group
            assert mine.n_dots[mine.group == group].sum() == rows.sum()
            assert mine["first"][mine.group == group].min() == view.frame[rows].min()
            assert mine["last"][mine.group == group].max() == view.frame[rows].max()
    assert (table.n_dots <= table["last"] - table["first"] + 1).all()
    assert table.group.is_monotonic_increasing
    assert (table.rival_group.isna() == table.rival_probability.isna()).all()
    assert set(table.track) <= {label for view in matches.recording.views for label in view.labels}


def test_rivals_belong_to_their_piece(recording):
    matches = true_matches(recording)
    rival, chance = np.full(len(matches.rival), -1), np.zeros(len(matches.rival))
    rival[5], chance[5] = 2, 0.25
    table = matches_table(replace(matches, rival=rival, rival_probability=chance))
    assert set(table.rival_group[table.piece == 5]) == {2}
    assert set(table.rival_probability[table.piece == 5]) == {0.25}
    assert table.rival_group[table.piece != 5].isna().all()


def test_bare_points_have_no_track(recording):
    bare = replace(recording, views=tuple(view.without_tracks() for view in recording.views))
    table = observations_table(true_matches(bare))
    assert (table.track == "").all()
    assert (matches_table(true_matches(bare)).track == "").all()
    assert (matches_table(true_matches(bare)).piece == BARE).all()


# --- points in space ---------------------------------------------------------------------------------


def test_tracks_are_the_paths(matches, saved):
    table = pd.read_csv(saved[0] / "tracks_3d.csv")
    paths = matches.trajectories
    np.testing.assert_array_equal(table.group, paths.group)
    np.testing.assert_array_equal(table.frame, paths.frame)
    np.testing.assert_allclose(table[["x", "y", "z"]], paths.position, atol=1e-6)
    np.testing.assert_allclose(table[["sd_x", "sd_y", "sd_z"]], paths.standard_deviation, atol=1e-6)
    assert set(table.source) <= set(SOURCE_NAMES)
    assert {"views", "single"} <= set(table.source)
    np.testing.assert_array_equal(table.n_views, paths.n_views)


@pytest.mark.parametrize("moving", [False, True])
def test_without_noise_rays_meet_at_the_truth(moving):
    options = TrackSimulation(
        n_animals=3, n_frames=30, rig="ring", n_cameras=3, moving=moving, lens="distorted", noise_px=0.0
    )
    recording = simulate_tracks(options)
    matches = true_matches(recording, noise=1.0)
    points = space_points(matches)
    truth = recording.truth_3d.set_index(["animal", "frame"])
    expected = truth.loc[list(zip(points.group, points.frame, strict=True)), ["x", "y", "z"]].to_numpy()
    assert len(points) > 80
    np.testing.assert_allclose(points.position, expected, atol=1e-6)
    assert {SOURCE_NAMES[s] for s in np.unique(points.source)} == {"triangulated"}
    assert max(np.nanmax(e) for e in row_errors(matches, points)) < 1e-3
    assert max(np.abs(matched).max() for _, _, matched, _ in epipolar_residuals(matches)) < 1e-3
    some = points.find(np.array([0, 1, 99, -1]), np.array([5, 10_000, 5, 5]))
    assert some[1:].tolist() == [-1, -1, -1]
    assert (points.group[some[0]], points.frame[some[0]]) == (0, 5)


def test_covariance_of_rays_that_meet_is_calibrated():
    recording = simulate_tracks(TrackSimulation(n_animals=10, n_frames=100, noise_px=2.0, seed=1))
    matches = true_matches(recording, noise=2.0)
    points = space_points(matches)
    found = match_metrics(matches, points, {"method": "tracks", "options": {}})["truth"]
    assert 0.9 < found["position_mm"]["nees_over_3"] < 1.1
    assert found["position_mm"]["right_pairs"]["count"] == len(points)
    assert found["pairing_accuracy"] == found["recall"] == 1.0


def test_predicted_pixels_are_those_of_opencv(matches):
    points = space_points(matches)
    for k, camera in enumerate(matches.recording.cameras):
        turn, _ = cv2.Rodrigues(camera.rotation)
        expected, _ = cv2.projectPoints(
            points.position, turn, camera.translation, camera.matrix, camera.distortion
        )
        np.testing.assert_allclose(predicted_pixels(matches, points, k), expected[:, 0], atol=1e-6)


# --- epipolar residuals ------------------------------------------------------------------------------


def test_residuals_are_those_of_opencv(matches):
    a, b = matched_pairs(matches, 0, 1)
    views, cameras = matches.recording.views, matches.recording.cameras
    assert len(a) > 300
    np.testing.assert_array_equal(views[0].frame[a], views[1].frame[b])
    np.testing.assert_array_equal(matches.groups[0][a], matches.groups[1][b])
    assert (matches.groups[0][a] >= 0).all()
    f = fundamental_matrix(cameras[0], cameras[1])
    ours = sampson_of_rows(matches, (0, 1), a[:50], b[:50])
    for value, i, j in zip(ours, a, b, strict=False):
        first, second = np.append(views[0].xy[i], 1.0), np.append(views[1].xy[j], 1.0)
        assert value**2 == pytest.approx(cv2.sampsonDistance(first, second, f), rel=1e-5)


def test_residuals_scatter_as_the_noise_and_chance_does_not(recording):
    matches = true_matches(recording)
    (_, _, matched, chance), *rest = epipolar_residuals(matches)
    assert not rest
    assert matched.std() == pytest.approx(2.0, rel=0.1)
    assert np.median(np.abs(chance)) > 20 * np.median(np.abs(matched))


# --- other programs ----------------------------------------------------------------------------------


def test_dltdv_reads_what_is_written(matches, saved):
    height = [camera.resolution[1] for camera in matches.recording.cameras]
    for view, group, read in zip(
        matches.recording.views, matches.groups, read_xypts(saved[0] / "xypts.csv", height), strict=True
    ):
        use = group >= 0
        mine = pd.DataFrame(
            {"g": group[use], "f": view.frame[use], "x": view.xy[use, 0], "y": view.xy[use, 1]}
        )
        other = pd.DataFrame({"g": read.animal - 1, "f": read.frame, "x": read.xy[:, 0], "y": read.xy[:, 1]})
        mine, other = (t.sort_values(["g", "f"], ignore_index=True) for t in (mine, other))
        pd.testing.assert_frame_equal(mine, other, check_dtype=False, rtol=0, atol=6e-4)
    points = space_points(matches)
    xyz = read_xyzpts(saved[0] / "xyzpts.csv").sort_values(["animal", "frame"])
    np.testing.assert_array_equal(xyz.animal - 1, points.group)
    np.testing.assert_array_equal(xyz.frame, points.frame)
    np.testing.assert_allclose(xyz[["x", "y", "z"]], points.position, atol=1e-6)


def test_movement_layout(matches, saved):
    points = space_points(matches)
    with xr.open_dataset(saved[0] / "tracks_3d.nc", engine="h5netcdf") as data:
        assert data.position.dims == ("time", "space", "keypoints", "individuals")
        assert data.confidence.dims == ("time", "keypoints", "individuals")
        assert list(data.space.values) == ["x", "y", "z"]
        assert list(data.keypoints.values) == ["centroid"]
        assert list(data.individuals.values) == [f"animal_{g}" for g in range(matches.n_groups)]
        assert data.attrs["ds_type"] == "poses"
        assert data.attrs["time_unit"] == "seconds"
        assert data.attrs["fps"] == matches.recording.fps
        assert data.attrs["source_software"] == "acino_fte"
        first = data.attrs["frame_offset"]
        np.testing.assert_allclose(data.time[[0, 1]] * matches.recording.fps, [first, first + 1])
        for i in (0, len(points) // 2, len(points) - 1):
            there = data.position.isel(time=points.frame[i] - first, individuals=points.group[i], keypoints=0)
            np.testing.assert_allclose(there, points.position[i], rtol=1e-5)
        assert int(data.position.notnull().all("space").sum()) == len(points)
        seen = points.n_views > 0
        assert int(data.confidence.notnull().sum()) == seen.sum()


def test_movement_without_frame_rate_counts_frames(recording):
    matches = true_matches(replace(recording, fps=None))
    data = movement_dataset(matches, space_points(matches))
    assert data.attrs["time_unit"] == "frames"
    assert "fps" not in data.attrs
    assert data.time.dtype.kind == "i"
    assert float(data.confidence.max()) == pytest.approx(0.9)


# --- numbers and the folder --------------------------------------------------------------------------


def test_metrics(matches, saved):
    metrics = json.loads((saved[0] / "metrics.json").read_text())
    assert metrics == saved[1]
    assert metrics["status"] == "matched"
    assert metrics["n_animals"] == matches.n_groups
    assert metrics["noise_px"]["total"] == pytest.approx(2.0, rel=0.15)
    assert metrics["epipolar_px"]["sd"] == pytest.approx(2.0, rel=0.15)
    for view, group in zip(matches.recording.views, matches.groups, strict=True):
        found = metrics["cameras"][view.camera]
        assert found["rows"] == len(view)
        assert found["matched"] == (group >= 0).sum()
    errors = np.concatenate(row_errors(matches, space_points(matches)))
    assert metrics["reprojection_px"]["median"] == pytest.approx(np.nanmedian(errors))
    assert metrics["reprojection_px"]["count"] == sum((g >= 0).sum() for g in matches.groups)
    assert metrics["truth"]["pairing_accuracy"] > 0.99
    assert 0.8 < metrics["truth"]["position_mm"]["nees_over_3"] < 1.2
    assert metrics["seconds"]["total"] >= metrics["seconds"]["tables"] > 0


def test_error_in_space_counts_wrong_rows_apart(recording):
    matches = true_matches(recording)
    groups = [group.copy() for group in matches.groups]
    swapped = recording.views[1].frame < 40
    groups[1][swapped & (matches.groups[1] == 0)] = 1
    groups[1][swapped & (matches.groups[1] == 1)] = 0
    wrong = replace(matches, groups=tuple(groups))
    right, found = (
        match_metrics(m, space_points(m), {"method": "tracks", "options": {}})["truth"]
        for m in (matches, wrong)
    )
    assert right["pairing_accuracy"] == 1.0 > found["pairing_accuracy"]
    assert found["position_mm"]["right_pairs"]["count"] < right["position_mm"]["right_pairs"]["count"]
    assert found["position_mm"]["right_pairs"]["p99"] == pytest.approx(
        right["position_mm"]["right_pairs"]["p99"], rel=0.3
    )


def test_no_truth_no_scores(recording):
    blind = replace(recording, views=tuple(replace(view, animal=None) for view in recording.views))
    matches = match_tracks(blind, MatchOptions(follow=False))
    metrics = match_metrics(matches, space_points(matches), {"method": "tracks", "options": {}})
    assert metrics["truth"] is None


def test_nothing_matched_is_written_all_the_same(recording, tmp_path):
    none = true_matches(recording)
    none = replace(none, groups=tuple(np.full(len(v), -1) for v in recording.views))
    metrics = save_matches(none, tmp_path / "out", figures=False)
    assert metrics["status"] == "nothing_matched"
    assert metrics["reprojection_px"]["median"] is None
    assert pd.read_csv(tmp_path / "out" / "observations.csv").group.isna().all()
    assert len(pd.read_csv(tmp_path / "out" / "tracks_3d.csv")) == 0
    assert len(pd.read_csv(tmp_path / "out" / "matches.csv")) == 0


def test_thesis_pairs_are_groups(recording):
    matches = thesis_matches(recording)
    assert matches.n_groups >= 4
    for group in range(matches.n_groups):
        assert all((g == group).any() for g in matches.groups)
    begin = [min(v.frame[g == k].min() for v, g in zip(recording.views, matches.groups, strict=True))
             for k in range(matches.n_groups)]  # fmt: skip
    assert begin == sorted(begin)
    metrics = match_metrics(matches, space_points(matches), {"method": "thesis", "options": {}})
    assert metrics["noise_px"]["total"] is None
    assert set(metrics["points_3d"]["by_source"]) == {"triangulated"}
    assert metrics["truth"]["pairing_accuracy"] > 0.8


def test_the_folder_is_whole_or_absent(matches, saved, tmp_path, monkeypatch):
    made = {p.name for p in saved[0].iterdir()}
    assert made == set(MATCHING.files) - {"figures", "report.html"}

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("acino_fte.data_tools.match_tables.dltdv_xypts", full)
    with pytest.raises(InputError, match="cannot be written"):
        save_matches(matches, tmp_path / "out", figures=False)
    assert list(tmp_path.iterdir()) == []


def test_formats_can_be_left_out(matches, tmp_path):
    save_matches(matches, tmp_path / "out", figures=False, formats=())
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "observations.csv",
        "tracks_3d.csv",
        "matches.csv",
        "metrics.json",
    }


def test_negative_frames_begin_dltdvs_tables(recording, tmp_path):
    views = tuple(replace(view, frame=view.frame - 20) for view in recording.views)
    truth = recording.truth_3d.assign(frame=recording.truth_3d.frame - 20)
    matches = true_matches(replace(recording, views=views, truth_3d=truth))
    save_matches(matches, tmp_path / "out", figures=False)
    read = read_xypts(tmp_path / "out" / "xypts.csv", [c.resolution[1] for c in recording.cameras])
    assert read[0].frame.min() == 0
    assert len(tracks_table(space_points(matches))) == len(read_xyzpts(tmp_path / "out" / "xyzpts.csv"))
