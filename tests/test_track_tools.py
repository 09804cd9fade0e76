"""Tools for tracks: there and back, cuts and filled gaps against plain loops, input that stays as it was."""

from dataclasses import fields, replace

import numpy as np
import pandas as pd
import pytest
from data_tools_synthetic import message

from acino_fte.data_tools.mvt_pickles import from_mvt, to_mvt
from acino_fte.data_tools.scene_tracks import SceneTracks
from acino_fte.data_tools.track_gaps import find_pieces, interpolate_points
from acino_fte.data_tools.track_tools import (
    concatenate,
    interpolate_tracks,
    join_subtracks,
    pooled_table,
    shift_frames,
    split_scene_tracks,
    split_tracks,
    take_frames,
    tracks_from_table,
)
from acino_fte.data_tools.tracks2d import Tracks2D

LABELS = ("0", "7", "ann")


def random_tracks(seed=0, n_frames=60, camera="left", bare=True) -> Tracks2D:
    """Walks with gaps and jumps, rows in disorder, some bare points."""
    rng = np.random.default_rng(seed)
    frame, track = np.nonzero(rng.random((n_frames, len(LABELS))) < 0.6)
    step = rng.normal(0, 3, (n_frames, len(LABELS), 2))
    step[rng.random(step.shape[:2]) < 0.05] += 60
    xy = (500 + np.cumsum(step, axis=0))[frame, track]
    if bare:
        track = np.where(rng.random(len(track)) < 0.1, -1, track)
    order = rng.permutation(len(frame))
    left_out = pd.DataFrame({"row": [900, 901], "frame": [3, 40], "track": ["0", "7"]})
    return Tracks2D(
        camera,
        frame[order] + 5,
        track[order],
        xy[order],
        LABELS,
        animal=np.where(track[order] == 1, 4, 2),
        row=np.arange(len(frame))[::-1],
        left_out=left_out,
    )


def snapshot(tracks: Tracks2D) -> dict:
    return {f.name: getattr(tracks, f.name) for f in fields(tracks)}


def frozen(tracks: Tracks2D) -> Tracks2D:
    """The same tracks in arrays that cannot be written to."""
    for name in ("frame", "track", "xy", "animal", "row"):
        getattr(tracks, name).flags.writeable = False
    return tracks


def dots(tracks: Tracks2D) -> set:
    names = (*tracks.labels, None)
    return {(f, names[t], *p) for f, t, p in zip(tracks.frame, tracks.track, tracks.xy.tolist(), strict=True)}


def pieces_by_loop(track, frame, xy, max_distance, max_gap) -> np.ndarray:
    piece = np.zeros(len(track), dtype=int)
    for who in set(track) - {-1}:
        rows = sorted(np.flatnonzero(track == who), key=lambda i: frame[i])
        for before, at in zip(rows, rows[1:], strict=False):
            step = frame[at] - frame[before]
            far = max_distance is not None and np.hypot(*(xy[at] - xy[before])) / step > max_distance
            late = max_gap is not None and step > max_gap + 1
            piece[at] = piece[before] + bool(far or late)
    return piece


# ------------------------------------------------------------ faults of MultiViewTracks


TOOLS = {
    "pooled_table": lambda t: pooled_table([t]),
    "to_mvt": to_mvt,
    "concatenate": lambda t: concatenate([take_frames(t, stop=20), take_frames(t, 20)]),
    "take_frames": lambda t: take_frames(t, 10, 30),
    "shift_frames": lambda t: shift_frames(t, 7),
    "split_tracks": lambda t: split_tracks(t, max_distance_px=9, max_gap=2),
    "interpolate_tracks": lambda t: interpolate_tracks(t, 3),
}


@pytest.mark.parametrize("tool", TOOLS)
def test_fault_tools_change_what_they_are_given(tool):
    tracks, same = frozen(random_tracks()), random_tracks()
    result = TOOLS[tool](tracks)
    for name, value in snapshot(same).items():
        if isinstance(value, pd.DataFrame):
            pd.testing.assert_frame_equal(getattr(tracks, name), value)
        else:
            np.testing.assert_array_equal(getattr(tracks, name), value)
    if isinstance(result, dict):  # and nothing that is done to the result reaches them
        for entry in result.values():
            for array in entry.values() if isinstance(entry, dict) else [entry]:
                array += 1
        assert dots(tracks) == dots(same)
    if isinstance(result, pd.DataFrame):
        result[["frame", "x", "y"]] += 1
        assert dots(tracks) == dots(same)


def test_fault_splitting_ignores_the_frame_gap():
    """An animal at 5 px a frame that was lost for 9 frames did not jump; but it was away for long."""
    frame = np.array([0, 1, 2, 12, 13])
    tracks = Tracks2D("a", frame, np.zeros(5, int), np.stack([5.0 * frame, 0 * frame], 1), ("0",))
    assert split_tracks(tracks, max_distance_px=6)[0].labels == ("0",)
    cut, parent = split_tracks(tracks, max_distance_px=6, max_gap=8)
    assert cut.labels == ("0", "0~1")
    assert cut.track.tolist() == [0, 0, 0, 1, 1]
    assert parent.tolist() == [0, 0]
    assert split_tracks(tracks, max_distance_px=6, max_gap=9)[0].labels == ("0",)


def test_fault_interpolation_fills_gaps_of_any_length():
    frame = np.array([0, 3, 10])
    tracks = Tracks2D("a", frame, np.zeros(3, int), np.stack([1.0 * frame, 2.0 * frame], 1), ("0",))
    for max_gap, n in ((0, 0), (1, 0), (2, 2), (5, 2), (6, 8)):
        more, filled = interpolate_tracks(tracks, max_gap)
        assert filled.sum() == n
        np.testing.assert_allclose(more.xy, np.stack([more.frame, 2 * more.frame], 1))


def test_fault_rows_in_disorder_are_cut_and_filled_in_order_of_time():
    tracks = random_tracks()
    order = np.lexsort((tracks.frame, tracks.track))
    for tool in (
        lambda t: split_tracks(t, max_distance_px=9, max_gap=2)[0],
        lambda t: interpolate_tracks(t, 3)[0],
    ):
        assert dots(tool(tracks)) == dots(tool(tracks.at_rows(order)))


# ------------------------------------------------------------ there and back


def test_tracks_become_a_long_table_and_come_back():
    views = (random_tracks(0), random_tracks(1, camera="right"))
    table = pooled_table(views)
    assert list(table) == ["camera", "individual", "frame", "x", "y"]
    assert table.individual.isna().sum() == sum((view.track == -1).sum() for view in views) > 0
    np.testing.assert_array_equal(table.frame, np.concatenate([view.frame for view in views]))
    left, right, top = tracks_from_table(table, ["left", "right", "top"])
    assert len(top) == 0
    for view, back in zip(views, (left, right), strict=True):
        assert back.labels == LABELS
        assert dots(back) == dots(view)
        np.testing.assert_array_equal(table.x.to_numpy()[back.row], back.xy[:, 0])
    assert len(pooled_table([])) == len(pooled_table([top])) == 0
    assert tracks_from_table(pooled_table([top]), ["top"])[0].labels == ()


def test_tables_from_elsewhere():
    table = pd.DataFrame(
        {
            "x": [1.0, 2, 2, np.nan],
            "y": 0.0,
            "frame": [0.0, 1, 1, 2],
            "camera": 3,
            "individual": [1.0, 2, 2, 2],
        }
    )
    (view,) = tracks_from_table(table, ["3"])
    assert view.labels == ("1", "2")
    assert view.frame.tolist() == [0, 1]  # a copy and a row without coordinates are left out
    assert "not known" in message(tracks_from_table, table, ["4"]).problem
    assert "individual" in message(tracks_from_table, table.drop(columns="individual"), ["3"]).problem
    assert message(tracks_from_table, table.assign(frame=[0, 1, 1.5, 2]), ["3"]).found == "1.5"
    assert message(tracks_from_table, table.assign(frame="a"), ["3"]).found == "a"
    error = message(
        tracks_from_table, table.assign(frame=[1, 1, 0, 0], individual=1, x=1.0 * table.index), ["3"]
    )
    assert "Individual '1' has two places in frame 0" in error.problem


def test_tracks_become_dictionaries_of_multiviewtracks_and_come_back():
    tracks = random_tracks(bare=False)
    tracks = replace(tracks, labels=("0", "7", "12"))
    data = to_mvt(tracks)
    assert list(data) == ["IDENTITIES", "FRAME_IDX", "0", "7", "12"]
    assert data["IDENTITIES"].tolist() == [0, 7, 12]
    np.testing.assert_array_equal(data["FRAME_IDX"], np.unique(tracks.frame))
    assert all((np.diff(data[who]["FRAME_IDX"]) > 0).all() for who in ("0", "7", "12"))
    assert dots(from_mvt(data, "left")) == dots(tracks)
    pooled = {k: np.concatenate([data[who][k] for who in ("0", "7", "12")]) for k in ("FRAME_IDX", "X", "Y")}
    pooled["IDENTITY"] = np.repeat([0, 7, 12], [len(data[who]["X"]) for who in ("0", "7", "12")])
    assert dots(from_mvt(pooled, "left")) == dots(tracks)
    named = to_mvt(random_tracks())
    assert named["IDENTITIES"].tolist() == [0, 1, 2]  # MultiViewTracks knows numbers only
    assert sum(len(named[str(i)]["X"]) for i in range(3)) == (random_tracks().track >= 0).sum()
    empty = to_mvt(tracks.at_rows(np.zeros(0, int)))
    assert (len(empty["IDENTITIES"]), len(empty["FRAME_IDX"])) == (0, 0)
    assert len(from_mvt(empty, "left")) == 0


# ------------------------------------------------------------ sub-tracks


@pytest.mark.parametrize(("max_distance", "max_gap"), [(9, 2), (None, 1), (12, None), (0, 0), (None, None)])
def test_pieces_are_those_of_a_plain_loop(max_distance, max_gap):
    tracks = random_tracks(3)
    arrays = tracks.track, tracks.frame, tracks.xy
    piece = find_pieces(*arrays, max_distance=max_distance, max_gap=max_gap)
    np.testing.assert_array_equal(piece, pieces_by_loop(*arrays, max_distance, max_gap))
    cut, parent = split_tracks(tracks, max_distance_px=max_distance, max_gap=max_gap)
    np.testing.assert_array_equal(cut.frame, tracks.frame)
    np.testing.assert_array_equal(np.append(parent, -1)[cut.track], tracks.track)
    joined = cut.track >= 0
    labels = [f"{LABELS[t]}~{p}".removesuffix("~0") for t, p in zip(tracks.track, piece, strict=True)]
    assert [cut.labels[t] for t in cut.track[joined]] == [x for x, j in zip(labels, joined, strict=True) if j]
    assert len(set(cut.labels)) == len(cut.labels) == len(parent)
    assert dots(join_subtracks(cut, parent, LABELS)) == dots(tracks)


def test_names_of_sub_tracks_are_never_those_of_others():
    frame = np.array([0, 9, 18, 0])
    tracks = Tracks2D("a", frame, np.array([0, 0, 0, 1]), np.zeros((4, 2)), ("0", "0~1"))
    cut, parent = split_tracks(tracks, max_gap=1)
    assert cut.labels == ("0", "0~2", "0~3", "0~1")
    assert parent.tolist() == [0, 0, 0, 1]
    again, _ = split_tracks(cut, max_gap=1)
    assert again.labels == cut.labels


def test_tracks_in_space_are_cut_by_the_same_rule():
    n = 6
    tracks = SceneTracks(
        individuals=("a", "b"),
        individual=np.array([0, 0, 0, 1, 1, 1]),
        frame=np.array([0, 1, 5, 0, 1, 2]),
        position=np.array([[0, 0, 0], [1, 0, 0], [5, 0, 0], [0, 0, 0], [0, 0, 9], [0, 0, 10]], dtype=float),
        covariance=np.tile(np.eye(3), (n, 1, 1)),
        source=np.zeros(n, int),
        n_views=np.full(n, 2),
        reprojection_median=np.zeros(n),
        reprojection_max=np.zeros(n),
        distance=(np.zeros(3),),
        used=(np.ones(3, bool),),
        smooth=False,
    )
    cut, parent = split_scene_tracks(tracks, max_distance=2.0)
    assert cut.individuals == ("a", "b", "b~1")
    assert cut.individual.tolist() == [0, 0, 0, 1, 2, 2]
    assert parent.tolist() == [0, 1, 1]
    assert split_scene_tracks(tracks, max_gap=2)[0].individuals == ("a", "a~1", "b")
    assert tracks.individuals == ("a", "b")


# ------------------------------------------------------------ gaps


@pytest.mark.parametrize("max_gap", [0, 1, 2, 100])
def test_filled_gaps_are_those_of_numpy_track_by_track(max_gap):
    tracks = random_tracks(4)
    more, filled = interpolate_tracks(tracks, max_gap)
    assert dots(more.at_rows(~filled)) == dots(tracks)
    assert (more.row[filled] == -1).all()
    np.testing.assert_array_equal(np.sort(more.row[~filled]), np.sort(tracks.row))
    assert not (more.track[filled] == -1).any()
    for who in range(len(LABELS)):
        mine = tracks.at_rows(tracks.track == who)
        order = np.argsort(mine.frame)
        known, xy = mine.frame[order], mine.xy[order]
        short = np.concatenate(
            [np.arange(a + 1, b) for a, b in zip(known, known[1:], strict=False) if b - a - 1 <= max_gap]
        )
        rows = filled & (more.track == who)
        np.testing.assert_array_equal(more.frame[rows], short)
        for k in range(2):
            np.testing.assert_allclose(more.xy[rows, k], np.interp(short, known, xy[:, k]), rtol=1e-12)


def test_the_true_animal_of_a_filled_dot_is_that_of_both_neighbours():
    animal = np.array([3, 3, 5])
    tracks = Tracks2D("a", np.array([0, 2, 4]), np.zeros(3, int), np.zeros((3, 2)), ("0",), animal=animal)
    assert interpolate_tracks(tracks, 1)[0].animal.tolist() == [3, 3, 3, -1, 5]


def test_points_in_space_are_filled_alike():
    who, frame = np.array([1, 0, 0]), np.array([4, 3, 0])
    who, frame, xyz, source = interpolate_points(who, frame, np.array([[9.0, 9, 9], [3, 6, 9], [0, 0, 0]]), 2)
    assert who.tolist() == [0, 0, 0, 0, 1]
    assert frame.tolist() == [0, 1, 2, 3, 4]
    assert source.tolist() == [2, -1, -1, 1, 0]
    np.testing.assert_allclose(xyz[:4], np.outer(frame[:4], [1, 2, 3]))


@pytest.mark.parametrize("limits", [{"max_gap": -1}, {"max_distance_px": -0.1}, {"max_distance_px": np.nan}])
def test_impossible_limits(limits):
    assert "impossible" in message(split_tracks, random_tracks(), **limits).problem


def test_nothing_stays_nothing():
    nothing = random_tracks().at_rows(np.zeros(0, int))
    assert len(split_tracks(nothing, max_gap=1)[0]) == 0
    assert len(interpolate_tracks(nothing, 1)[0]) == 0
    assert len(concatenate([nothing, nothing])) == 0


# ------------------------------------------------------------ parts


def test_frames_are_taken_half_open_and_put_together_again():
    tracks = random_tracks()
    parts = [take_frames(tracks, stop=20), take_frames(tracks, 20, 41), take_frames(tracks, 41)]
    assert parts[1].frame.min() >= 20
    assert parts[1].frame.max() <= 40
    assert parts[1].left_out.frame.tolist() == [40]
    whole = concatenate(parts)
    assert dots(whole) == dots(tracks)
    assert whole.labels == LABELS
    assert whole.left_out.row.tolist() == [900, 901]
    np.testing.assert_array_equal(np.sort(whole.row), np.sort(tracks.row))
    np.testing.assert_array_equal(np.sort(whole.animal), np.sort(tracks.animal))


def test_parts_are_joined_by_the_names_of_their_tracks(tmp_path):
    one = Tracks2D("a", np.array([0, 0]), np.array([0, 1]), np.ones((2, 2)), ("10", "2"), path=tmp_path / "1")
    two = Tracks2D("a", np.array([0, 0]), np.array([0, -1]), np.ones((2, 2)), ("10",), path=tmp_path / "2")
    whole = concatenate([one, shift_frames(two, 100)])
    assert whole.labels == ("2", "10")
    assert whole.track.tolist() == [1, 0, 1, -1]
    assert whole.frame.tolist() == [0, 0, 100, 100]
    assert whole.row.tolist() == [0, 1, 2, 3]
    assert whole.path is None
    error = message(concatenate, [one, two])
    assert "Individual '10' of camera 'a' is twice in frame 0" in error.problem
    assert "one camera" in message(concatenate, [one, replace(two, camera="b")]).problem
    assert "one camera" in message(concatenate, []).problem


def test_frames_are_shifted_by_whole_numbers():
    tracks = random_tracks()
    later = shift_frames(tracks, -5)
    np.testing.assert_array_equal(later.frame, tracks.frame - 5)
    assert later.left_out.frame.tolist() == [-2, 35]
    assert "whole numbers" in message(shift_frames, tracks, 0.5).problem
