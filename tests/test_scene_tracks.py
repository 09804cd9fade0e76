"""2D tracks of a scene from every kind of file: joined by name, and every message on the way."""

import pickle
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from data_tools_synthetic import message
from test_track_files import SHARED, grid, needs, write, write_idtracker, write_sleap, write_trex

from acino_fte.data_tools.individual_rows import identity
from acino_fte.data_tools.match_tables import observations_table
from acino_fte.data_tools.mvt_pickles import to_mvt
from acino_fte.data_tools.track_owners import owners
from acino_fte.data_tools.tracks import read_scene_tracks
from acino_fte.data_tools.tracks2d import Tracks2D

RIG = SHARED / "mvt_rig"
NAMES = ("left", "right")
N_FRAMES, WHO = 9, ("0", "1", "2")


def seen(seed: int) -> np.ndarray:
    """Pixels (F, A, 2) of one camera, some missing."""
    xy = grid(N_FRAMES, len(WHO), seed).round(3)
    xy[0, 0] = 10.5, 20.25
    return xy


def long_table(xy: np.ndarray, who=WHO, seed: int = 0) -> pd.DataFrame:
    """Rows in disorder."""
    frame, animal = np.nonzero(np.isfinite(xy).all(-1))
    order = np.random.default_rng(seed).permutation(len(frame))
    frame, animal = frame[order], animal[order]
    x, y = xy[frame, animal].T
    return pd.DataFrame({"frame": frame, "individual": np.array(who)[animal], "x": x, "y": y})


def mvt(xy: np.ndarray, ids=(0, 1, 2), shuffle: bool = False) -> dict:
    """The dictionary that MultiViewTracks reads."""
    result = {"IDENTITIES": np.array(ids), "FRAME_IDX": np.arange(len(xy))}
    for a, number in enumerate(ids):
        frame = np.flatnonzero(np.isfinite(xy[:, a]).all(1))
        if shuffle:
            frame = np.random.default_rng(a).permutation(frame)
        result[str(number)] = {"FRAME_IDX": frame, "X": xy[frame, a, 0], "Y": xy[frame, a, 1]}
    return result


def dump(path: Path, data, protocol=4) -> Path:
    path.write_bytes(pickle.dumps(data, protocol))
    return path


def as_grid(view: Tracks2D, who=WHO, n_frames=N_FRAMES) -> np.ndarray:
    """The pixels of a view (F, A, 2) by the names of its individuals."""
    xy = np.full((n_frames, len(who), 2), np.nan)
    place = np.array([who.index(label) for label in view.labels], dtype=int)
    xy[view.frame, place[view.track]] = view.xy
    return xy


def check(path: Path, expected=None, who=WHO, atol=0.0, **options):
    """Both cameras come back, in the order that was asked for and in the other one."""
    expected = [seen(0), seen(1)] if expected is None else expected
    for order in ((0, 1), (1, 0)):
        result = read_scene_tracks(path, [NAMES[i] for i in order], **options)
        for i, view in zip(order, result.tracks, strict=True):
            assert view.camera == NAMES[i]
            np.testing.assert_allclose(as_grid(view, who, len(expected[i])), expected[i], rtol=0, atol=atol)
            assert (np.diff(view.track * 100_000 + view.frame) > 0).all()
    return result


def both(folder: Path, ending: str = "csv") -> Path:
    for i, name in enumerate(NAMES):
        if ending == "pkl":
            dump(folder / f"tracks_{name}.pkl", mvt(seen(i)))
        else:
            long_table(seen(i)).to_csv(folder / f"{name}.csv", index=False)
    return folder


# ------------------------------------------------------------ faults of MultiViewTracks on tracks


def test_fault_tracks_and_cameras_are_joined_by_name_and_not_by_their_alphabetical_order(tmp_path):
    dump(tmp_path / "a_right.pkl", mvt(seen(1)))
    dump(tmp_path / "b_left.pkl", mvt(seen(0)))
    check(tmp_path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("core", [b"numpy.core", b"numpy._core"])
@pytest.mark.parametrize("protocol", [0, 2, 3, 4, 5])
def test_fault_pickles_of_numpy_1_and_2_load(tmp_path, core, protocol):
    for i, name in enumerate(NAMES):
        data = pickle.dumps(mvt(seen(i)), protocol)
        if protocol < 4:  # names are lines of text
            data = data.replace(b"cnumpy._core.", b"c" + core + b".")
            assert (b"c" + core + b".multiarray") in data
        elif core == b"numpy.core":
            old, new = b"numpy._core.multiarray", b"numpy.core.multiarray"
            framed = data[:2] + data[11:]  # without the frame, whose length would be wrong
            data = framed.replace(bytes([len(old)]) + old, bytes([len(new)]) + new)
            data = data.replace(b"\x13numpy._core.numeric", b"\x12numpy.core.numeric")
            assert b"numpy._core" not in data
        (tmp_path / f"tracks_{name}.pkl").write_bytes(data)
    check(tmp_path)


def test_fault_rows_in_disorder(tmp_path):
    for i, name in enumerate(NAMES):
        dump(tmp_path / f"tracks_{name}.pkl", mvt(seen(i), shuffle=True))
    check(tmp_path)


def test_fault_a_camera_without_tracks(tmp_path):
    both(tmp_path, "pkl")
    result = read_scene_tracks(tmp_path, ["left", "top", "right"])
    assert [len(view) > 0 for view in result.tracks] == [True, False, True]
    top = result.tracks[1]
    assert (top.camera, top.xy.shape, top.labels) == ("top", (0, 2), WHO)
    assert result.notes == ("No tracks for top.",)


def test_fault_an_individual_unseen_by_one_camera(tmp_path):
    dump(tmp_path / "left.pkl", mvt(seen(0)))
    two = mvt(seen(1)[:, :2], ids=(0, 1))
    two["IDENTITIES"] = np.array([0, 1, 2])  # listed, never seen
    dump(tmp_path / "right.pkl", two)
    left, right = (result := read_scene_tracks(tmp_path, NAMES)).tracks
    assert left.labels == right.labels == WHO
    assert set(left.track) == {0, 1, 2}
    assert set(right.track) == {0, 1}
    assert result.notes == ("Seen by one camera only: 2.",)
    two["2"] = {"FRAME_IDX": np.zeros(0, int), "X": np.zeros(0), "Y": np.zeros(0)}
    dump(tmp_path / "right.pkl", two)
    assert set(read_scene_tracks(tmp_path, NAMES).tracks[1].track) == {0, 1}


def test_a_pickle_that_would_run_code_is_refused_and_runs_nothing(tmp_path):
    both(tmp_path, "pkl")
    ran = tmp_path / "ran"
    (tmp_path / "tracks_left.pkl").write_bytes(f"cos\nsystem\n(Vtouch {ran}\ntR.".encode())
    error = message(read_scene_tracks, tmp_path, NAMES)
    assert "could run code" in error.problem
    assert error.file.endswith("tracks_left.pkl")
    assert not ran.exists()


@pytest.mark.parametrize(
    ("part", "broken"),
    [(b"latin1", b"nolat1"), (b"X\x01\0\0\0bq", b"X\x01\0\0\0,q"), (b"i8", b"??"), (b"bs.", b"b")],
)
def test_broken_pickles_are_one_clear_message(tmp_path, part, broken):
    """What NumPy ends with depends on where: LookupError, SyntaxError, TypeError, EOFError."""
    whole = pickle.dumps({"IDENTITIES": np.arange(2)}, 2)
    assert part in whole
    (tmp_path / "left.pkl").write_bytes(whole.replace(part, broken))
    error = message(read_scene_tracks, tmp_path, NAMES)
    assert "broken" in error.problem
    assert error.file.endswith("left.pkl")


@needs(RIG)
@pytest.mark.parametrize("name", ["tracks", "tracks_outlier"])
def test_the_pickles_of_multiviewtracks(name):
    cameras = ["n_0_cut", "i_0_cut", "j_0_cut", "m_0_cut"]
    result = read_scene_tracks(RIG / name, cameras)
    assert result.notes == ()
    truth = pd.read_csv(RIG / "gt_points.csv")
    frames = pd.concat([pd.DataFrame({"f": v.frame, "i": v.track}) for v in result.tracks])
    seen_by = frames.value_counts().reindex(pd.MultiIndex.from_frame(truth.iloc[:, :2]), fill_value=0)
    np.testing.assert_array_equal(seen_by.to_numpy(), truth["n_views"])
    for view, camera in zip(result.tracks, cameras, strict=True):
        assert view.labels == ("0", "1")
        assert view.path.name == f"tracks_{camera}.pkl"


# ------------------------------------------------------------ kinds of files


def test_long_tables(tmp_path):
    result = check(both(tmp_path))
    assert result.notes == ()
    view = result.tracks[0]
    np.testing.assert_array_equal(long_table(seen(1)).frame.to_numpy()[view.row], view.frame)


@pytest.mark.parametrize(
    "names",
    [
        ["frame_idx", "id", "x", "y"],
        ["FRAME_IDX", "IDENTITY", "X", "Y"],
        ["frame_number", "track", "u", "v"],
        ["frame", "trackid", "x_px", "y_px"],
    ],
)
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_other_names_of_columns(tmp_path, names, separator):
    for i, name in enumerate(NAMES):
        table = long_table(seen(i)).set_axis(names, axis=1).assign(other="n/a")
        table.to_csv(tmp_path / f"{name}.csv", index=False, sep=separator)
    check(tmp_path)


@pytest.mark.parametrize("name", ["camera", "cam", "view"])
def test_one_table_with_a_column_for_the_camera(tmp_path, name):
    parts = [long_table(seen(i)).assign(**{name: camera}) for i, camera in enumerate(NAMES)]
    table = pd.concat(parts).sample(frac=1, random_state=0)
    table.to_csv(tmp_path / "all.csv", index=False)
    check(tmp_path / "all.csv")
    view = check(tmp_path).tracks[0]  # the only one in its folder
    np.testing.assert_array_equal(table.x.to_numpy()[view.row], view.xy[:, 0])


WIDE = {
    "after_": lambda who, axis: f"{who}_{axis}",
    "after.": lambda who, axis: f"{who}.{axis}",
    "before_": lambda who, axis: f"{axis}_{who}",
    "number": lambda who, axis: f"{axis.upper()}{who}",
}


@pytest.mark.parametrize("style", WIDE)
def test_wide_tables(tmp_path, style):
    for i, name in enumerate(NAMES):
        columns = {WIDE[style](w, "xy"[k]): seen(i)[:, a, k] for a, w in enumerate(WHO) for k in (1, 0)}
        table = pd.DataFrame({"time": 0.04, "Frame": np.arange(N_FRAMES), **columns, "0_likelihood": 0.9})
        table.sample(frac=1, random_state=0).to_csv(tmp_path / f"{name}.csv", index=False)
    assert check(tmp_path).notes == ()


@pytest.mark.parametrize("kind", ["pandas", "pandas, no name", "merged", "three lines"])
def test_wide_tables_with_two_header_lines(tmp_path, kind):
    for i, name in enumerate(NAMES):
        columns = pd.MultiIndex.from_product([WHO, ["x", "y"]], names=["individual", "coords"])
        table = pd.DataFrame(seen(i).reshape(N_FRAMES, -1), columns=columns)
        table.index.name = "frame" if kind == "pandas" else None
        path = tmp_path / f"{name}.csv"
        if kind.startswith("pandas"):
            table.to_csv(path)
            continue
        rows = table.to_csv(header=False)
        head = "individual,0,,1,,2,\nframe,x,y,x,y,x,y\n"
        if kind == "three lines":
            head = "scorer,me,me,me,me,me,me\nbodyparts,0,0,1,1,2,2\ncoords,x,y,x,y,x,y\n"
        write(path, head + rows)
    assert check(tmp_path).notes == ()


def test_a_wide_table_with_frames_that_skip_and_a_camera_column(tmp_path):
    text = "frame,camera,A_x,A_y\n8,left,1,2\n3,left,3,4\n3,right,5,6\n"
    left, right = read_scene_tracks(write(tmp_path / "t.csv", text), NAMES).tracks
    assert left.frame.tolist() == [3, 8]
    assert left.xy.tolist() == [[3, 4], [1, 2]]
    assert left.row.tolist() == [1, 0]
    assert right.xy.tolist() == [[5, 6]]
    write(tmp_path / "t.csv", text.replace("A_x,A_y", "x1,y1"))
    assert read_scene_tracks(tmp_path / "t.csv", NAMES).tracks[0].frame.tolist() == [3, 8]


@pytest.mark.parametrize("layout", ["folders", "prefix"])
@pytest.mark.parametrize("ending", ["npz", "csv"])
def test_individuals_of_trex(tmp_path, layout, ending):
    for i, name in enumerate(NAMES):
        folder = tmp_path / name
        folder.mkdir()
        for path in write_trex(folder, seen(i), 0.05, ending=ending):
            if layout == "prefix":
                path.rename(tmp_path / f"{name}_{path.name}")
        if layout == "prefix":
            folder.rmdir()
    said = None if ending == "npz" else 0.05
    check(tmp_path, who=("id0", "id1", "id2"), atol=1e-9, cm_per_pixel=said)
    if ending == "csv":
        assert message(read_scene_tracks, tmp_path, NAMES).key == "cm_per_pixel"


@pytest.mark.parametrize("kind", ["npy", "h5", "csv"])
def test_trajectories_of_idtracker(tmp_path, kind):
    for i, name in enumerate(NAMES):
        path = write_idtracker(tmp_path / name, seen(i), kind=kind)
        path.rename(tmp_path / f"{name}.{kind}")
        (tmp_path / name).rmdir()
    who = ("1", "2", "3") if kind == "csv" else ("ann", "bob", "cat")
    check(tmp_path, who=who, atol=1e-3 if kind == "csv" else 0)


@pytest.mark.parametrize("ending", ["analysis.h5", "csv"])
def test_analyses_of_sleap(tmp_path, ending):
    for i, name in enumerate(NAMES):
        both_nodes = np.stack([seen(i), seen(i) + 4], axis=2)
        write_sleap(tmp_path / f"{name}.{ending}", both_nodes)
    who = ("bird_0", "bird_1", "bird_2")
    check(tmp_path, who=who, node="head", atol=1e-9)
    check(tmp_path, [seen(0) + 2, seen(1) + 2], who=who, atol=1e-9)


def test_the_observations_of_our_own_matching_feed_a_scene(tmp_path):
    """Their individual is the group, not the track; rows without a group are left out, and counted."""

    class Matches:
        class recording:
            views = tuple(
                Tracks2D(name, np.array([0, 1, 1]), np.array([0, 0, 1]), xy, ("17", "18"))
                for name, xy in zip(NAMES, np.arange(12.0).reshape(2, 3, 2), strict=True)
            )

        groups = (np.array([4, 4, -1]), np.array([2, 4, 2]))
        confidence = (np.ones(3), np.ones(3))

    observations_table(Matches).to_csv(tmp_path / "observations.csv", index=False)
    write(tmp_path / "tracks_3d.csv", "group,frame,x,y,z\n4,0,1,2,3\n")
    write(tmp_path / "matches.csv", "group,camera,track\n4,left,17\n")
    for path in (tmp_path, tmp_path / "observations.csv"):
        result = read_scene_tracks(path, NAMES)
        left, right = result.tracks
        assert left.labels == ("2", "4")
        assert left.track.tolist() == [1, 1]
        assert right.track.tolist() == [0, 0, 1]
        assert right.frame.tolist() == [0, 1, 1]
        assert "1 row of camera 'left' have no individual: left out." in result.notes


@pytest.mark.parametrize("style", ["subtracks", "pooled", "numbers as keys", "lists", "python 2"])
def test_other_layouts_of_pickles(tmp_path, style):
    for i, name in enumerate(NAMES):
        data = mvt(seen(i))
        if style == "subtracks":
            del data["FRAME_IDX"]
            for who in WHO:
                data[who] = [
                    {k: v[part] for k, v in data[who].items()} for part in (slice(0, 2), slice(2, 99))
                ]
        elif style == "pooled":
            parts = {who: data[who] for who in WHO}
            data = {k: np.concatenate([p[k] for p in parts.values()]) for k in ("FRAME_IDX", "X", "Y")}
            data["IDENTITY"] = np.repeat([0.0, 1.0, 2.0], [len(p["X"]) for p in parts.values()])
        elif style == "numbers as keys":
            data = {int(k) if k in WHO else k: v for k, v in data.items()}
        elif style == "lists":
            data = {k: v if k in WHO else list(v) for k, v in data.items()}
            data |= {who: {k: v.tolist() for k, v in data[who].items()} | {"SPINE": []} for who in WHO}
        dump(tmp_path / f"{name}.pkl", data, 0 if style == "python 2" else 4)
    check(tmp_path)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ([1, 2], "list"),
        ({}, "empty"),
        ({"IDENTITIES": np.array([3])}, "3 and none"),
        ({"IDENTITIES": [0], "0": {"X": [1.0], "Y": [1.0]}}, "X, Y"),
        ({"IDENTITIES": [0], "0": [1.0, 2.0]}, "float"),
        ({"IDENTITIES": [0], "0": {"FRAME_IDX": [0, 1], "X": [1.0], "Y": [1.0]}}, "2 FRAME_IDX, 1 X"),
        ({"IDENTITIES": [0], "0": {"FRAME_IDX": [0.5], "X": [1.0], "Y": [1.0]}}, "0.5"),
        ({"IDENTITIES": [0], "0": {"FRAME_IDX": [-1], "X": [1.0], "Y": [1.0]}}, "-1"),
        ({"IDENTITIES": [0], "0": {"FRAME_IDX": [0], "X": ["a"], "Y": [1.0]}}, "a"),
        ({"IDENTITIES": [0], "0": {"FRAME_IDX": [0], "X": [1], "Y": [1], "Z": [1]}}, "Z"),
        ({"IDENTITY": [0, 1], "FRAME_IDX": [0], "X": [1.0], "Y": [1.0]}, "2 IDENTITY"),
    ],
)
def test_pickles_of_something_else(tmp_path, data, said):
    error = message(read_scene_tracks, dump(tmp_path / "left.pkl", data), NAMES)
    assert said in error.found
    assert error.file.endswith("left.pkl")


@needs(SHARED / "sleap_mouse")
def test_files_of_a_real_recording_that_are_no_tracks_are_passed_over():
    result = read_scene_tracks(SHARED / "sleap_mouse", ["top", "side", "mid", "back"], node="Nose")
    assert [view.path.name for view in result.tracks] == [
        f"{view.camera}.analysis.h5" for view in result.tracks
    ]
    assert all(map(len, result.tracks))


# ------------------------------------------------------------ names of cameras


@pytest.mark.parametrize(
    ("name", "cameras", "expected"),
    [
        ("i_0_cut", ["i_0_cut", "j_0_cut"], ["i_0_cut"]),
        ("tracks_i_0_cut", ["i_0_cut", "j_0_cut"], ["i_0_cut"]),
        ("tracks-I-0-CUT (2)", ["i_0_cut", "j_0_cut"], ["i_0_cut"]),
        ("tracks_cam11", ["cam1", "cam11"], ["cam11"]),
        ("tracks_cam1", ["cam11", "cam1"], ["cam1"]),
        ("tracks_cam12", ["cam1", "cam11"], []),
        ("tracks_left_top", ["top", "left", "left_top"], ["left_top"]),
        ("left_top_top", ["top", "left_top"], ["top", "left_top"]),
        ("left_to_right", ["left", "right"], ["left", "right"]),
        ("bright", ["left", "right"], []),
        ("Camera 1", ["cam0", "cam1"], ["cam1"]),
        ("tracks_1", ["0", "1"], ["1"]),
        ("1/tracks", ["0", "1"], ["1"]),
        ("cam0_trial_1", ["0", "1"], ["0"]),
        ("rig1_left", ["rig1/left", "rig2/left"], ["rig1/left"]),
        ("GX01.MP4", ["GX01.MP4", "gx01_mp4"], ["GX01.MP4"]),
        ("x", [], []),
    ],
)
def test_names_of_files_and_cameras(name, cameras, expected):
    assert sorted(owners(name, cameras)) == sorted(expected)


def test_files_in_folders_called_as_the_cameras(tmp_path):
    for i, name in enumerate(NAMES):
        (tmp_path / "rig" / name).mkdir(parents=True)
        dump(tmp_path / "rig" / name / "tracks.pkl", mvt(seen(i)))
    check(tmp_path / "rig")
    result = read_scene_tracks(tmp_path, ["rig/right", "rig/left"])
    np.testing.assert_array_equal(as_grid(result.tracks[1]), seen(0))


def test_a_file_that_fits_no_camera(tmp_path):
    both(tmp_path)
    for name in ("third.csv", "third.pkl"):
        path = tmp_path / name
        dump(path, mvt(seen(0))) if name.endswith("pkl") else write(path, "frame,id,x,y\n0,0,1,2\n")
        error = message(read_scene_tracks, tmp_path, NAMES)
        assert "'third' belongs to no camera" in error.problem
        assert error.found == f"left.csv, right.csv, {name}"
        assert "left, right" in error.expected
        with_it = read_scene_tracks(tmp_path, NAMES, other_cameras=["third"])
        assert [view.camera for view in with_it.tracks] == list(NAMES)
        path.unlink()
    write(tmp_path / "notes.csv", "date,weather\n1,fine\n")  # no tracks: none of our business
    write(tmp_path / "points.csv", "frame,id,x,y,z\n0,0,1,2,3\n")  # in space
    np.savez(tmp_path / "x_posture.npz", a=np.ones(3))
    write(tmp_path / "left_truth.csv", "animal\n1\n")
    write(tmp_path / "README.md", "tracks")
    check(tmp_path)


def test_two_files_for_one_camera(tmp_path):
    both(tmp_path)
    dump(tmp_path / "left.pkl", mvt(seen(0)))
    error = message(read_scene_tracks, tmp_path, NAMES)
    assert error.problem == "Camera 'left' has tracks twice."
    assert error.found == "left.csv, left.pkl"
    (tmp_path / "left.pkl").rename(tmp_path / "left_and_right.pkl")
    assert "may belong to left or right" in message(read_scene_tracks, tmp_path, NAMES).problem


def test_a_column_that_names_no_camera(tmp_path):
    text = "frame,camera,id,x,y\n0,left,0,1,2\n0,{},0,1,2\n"
    error = message(read_scene_tracks, write(tmp_path / "t.csv", text.format("top")), NAMES)
    assert "'top' belongs to no camera" in error.problem
    assert error.found == "left, top"
    error = message(read_scene_tracks, write(tmp_path / "t.csv", text.format("LEFT")), NAMES)
    assert error.problem == "Camera 'left' has tracks twice."
    error = message(read_scene_tracks, write(tmp_path / "t.csv", text.format("")), NAMES)
    assert "line 3" in error.key
    folder = tmp_path / "t"
    folder.mkdir()
    write(folder / "left.csv", text.format("right"))
    assert "its rows say another" in message(read_scene_tracks, folder, NAMES).problem


# ------------------------------------------------------------ individuals


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (0, "0"),
        (0.0, "0"),
        ("0.0", "0"),
        (" 00 ", "0"),
        (np.int64(12), "12"),
        (np.float32(3), "3"),
        (b"7", "7"),
        ("0.1", "0.1"),
        ("0~1", "0~1"),
        ("Ann", "Ann"),
        (-1, ""),
        (float("nan"), ""),
        (None, ""),
    ],
)
def test_the_name_of_an_individual(value, expected):
    assert identity(value) == expected


def test_individuals_are_joined_over_cameras_whatever_kind_of_number_names_them(tmp_path):
    write(tmp_path / "left.csv", "frame,id,x,y\n0,0,1,2\n0,1.0,3,4\n0,ann,5,6\n")
    write(tmp_path / "right.csv", "frame,id,x,y\n0,1,1,2\n0,,9,9\n0,0.0,3,4\n")
    dump(tmp_path / "top.pkl", {"IDENTITIES": np.array([1.0]), "1.0": {"FRAME_IDX": [0], "X": [1], "Y": [2]}})
    result = read_scene_tracks(tmp_path, [*NAMES, "top"])
    assert {view.labels for view in result.tracks} == {("0", "1", "ann")}
    assert [view.track.tolist() for view in result.tracks] == [[0, 1, 2], [0, 1], [1]]
    assert result.notes == (
        "1 row of camera 'right' have no individual: left out.",
        "Seen by one camera only: ann.",
    )


def test_cameras_that_share_no_individual(tmp_path):
    write(tmp_path / "left.csv", "frame,id,x,y\n0,a,1,2\n0,b,1,2\n")
    write(tmp_path / "right.csv", "frame,id,x,y\n0,c,1,2\n")
    note = read_scene_tracks(tmp_path, NAMES).notes[-1]
    assert note.startswith("No individual is seen by two cameras")
    assert "a, b in left; c in right" in note


def test_a_table_without_a_column_for_the_individual(tmp_path):
    write(tmp_path / "left.csv", "frame,x,y\n3,1,2\n4,3,4\n")
    result = read_scene_tracks(tmp_path, ["left"])
    assert result.tracks[0].labels == ("0",)
    assert "taken as one" in result.notes[0]
    write(tmp_path / "left.csv", "frame,x,y\n3,1,2\n3,3,4\n3,,\n")
    error = message(read_scene_tracks, tmp_path, ["left"])
    assert "which individual" in error.problem
    assert "2 dots" in error.found


# ------------------------------------------------------------ values


def test_copies_of_a_row_are_left_out(tmp_path):
    for i, name in enumerate(NAMES):
        table = long_table(seen(i))
        pd.concat([table, table.iloc[:3], table.iloc[:1]]).to_csv(tmp_path / f"{name}.csv", index=False)
    assert check(tmp_path).notes == tuple(
        f"4 rows of camera '{name}' are copies of others: left out." for name in NAMES[::-1]
    )


def test_two_places_in_one_frame(tmp_path):
    write(tmp_path / "left.csv", "frame,id,x,y\n5,0,1,2\n5,7,1,2\n4,7,1,1\n5,7,3,4\n4,7,1,1\n4,7,9,9\n")
    error = message(read_scene_tracks, tmp_path, ["left"])
    assert error.problem == "Individual '7' has two places in frame 4 of camera 'left'."
    assert error.found == "(1.00, 1.00) and (9.00, 9.00); 2 rows too many in all"
    assert error.key == "rows 5 and 6 of the data"
    assert error.file.endswith("left.csv")
    assert "name of its own" in error.remedy


def test_rows_without_coordinates_are_left_out_and_counted(tmp_path):
    write(tmp_path / "left.csv", "frame,id,x,y\n0,0,1,2\n1,0,,\n2,0,nan,2\n3,0,-1,-1\n\n4,0,-1,5\n")
    data = {"FRAME_IDX": [0, 1, 2], "X": [np.nan, np.inf, 1], "Y": [1.0, 1.0, 1]}
    dump(tmp_path / "right.pkl", {"IDENTITIES": [0], "0": data})
    write(tmp_path / "top.csv", "frame,0_x,0_y,1_x,1_y\n0,1,2,,\n1,1,,3,4\n")
    result = read_scene_tracks(tmp_path, [*NAMES, "top"])
    assert [view.frame.tolist() for view in result.tracks] == [[0, 4], [2], [0, 1]]
    assert result.notes[:3] == (
        "3 rows of camera 'left' have no coordinates: left out.",
        "2 rows of camera 'right' have no coordinates: left out.",
        "1 row of camera 'top' have no coordinates: left out.",
    )


@pytest.mark.parametrize(
    ("text", "key", "found"),
    [
        ("frame,id,x,y\n0,0,1,2\n0.5,0,1,2\n", "line 3", "0.5"),
        ("frame,id,x,y\n-3,0,1,2\n", "line 2", "-3"),
        ("frame,id,x,y\n,0,1,2\n", "line 2", "nothing"),
        ("frame,id,x,y\n0,0,1,2\n1,0,one,2\n", "line 3", "one"),
        ("frame,id,x,y\n0,0,1,inf\n", "line 2", "inf"),
        ("frame,0_x,0_y\n0,1,2\n1,1,two\n", "line 3", "two"),
        ("frame,0_x,0_y,1_x\n0,1,2,3\n", "header", "only x"),
        ("frame,0_x,0_y,0_x\n0,1,2,3\n", "header", "x twice"),
        ("frame,id,pos\n0,0,1\n", "header", "frame, id, pos"),
        ("frame,id,x,y\n0,0,1,2,3\n", None, "Length"),
    ],
)
def test_values_that_cannot_be_used(tmp_path, text, key, found):
    error = message(read_scene_tracks, write(tmp_path / "left.csv", text), NAMES)
    assert error.file.endswith("left.csv")
    assert found in error.found
    if key:
        assert key in error.key


def test_coordinates_of_no_image(tmp_path):
    for y in (-400.0, 3e6):
        write(tmp_path / "left.csv", f"frame,id,x,y\n0,0,1,2\n1,0,3,{y}\n")
        error = message(read_scene_tracks, tmp_path, NAMES)
        assert "no pixels" in error.problem
        assert f"{y:.0f}" in error.found
    rows = "".join(f"{i},0,3,4\n" for i in range(2, 40))  # a single wild dot is the triangulation's to judge
    write(tmp_path / "left.csv", "frame,id,x,y\n0,0,1,2\n1,0,3,-400\n" + rows)
    assert len(read_scene_tracks(tmp_path, NAMES).tracks[0]) == 40


def test_empty_files_are_cameras_without_tracks(tmp_path):
    both(tmp_path)
    for name, text in (("a.csv", ""), ("b.csv", "frame,id,x,y\n"), ("c.pkl", ""), ("d.csv", "\ufeff\n")):
        write(tmp_path / name, text)
    dump(tmp_path / "e.pkl", {"IDENTITIES": np.zeros(0, int), "FRAME_IDX": np.zeros(0, int)})
    result = read_scene_tracks(tmp_path, ["a", "b", "c", "d", "e", *NAMES])
    assert [len(view) > 0 for view in result.tracks] == [False] * 5 + [True] * 2
    assert result.notes == (
        "a.csv is empty.",
        "c.pkl is empty.",
        "d.csv is empty.",
        "No tracks for a, b, c, d, e.",
    )


def test_no_tracks_at_all(tmp_path):
    assert "no such tracks" in message(read_scene_tracks, tmp_path / "none", NAMES).problem
    error = message(read_scene_tracks, tmp_path, NAMES)
    assert (error.problem, error.found) == ("The folder holds no tracks.", "nothing")
    write(tmp_path / "left.csv", "frame,id,x,y\n0,0,,\n")
    error = message(read_scene_tracks, tmp_path, NAMES)
    assert error.problem == "No camera has tracks."
    assert "left" in error.found
    (tmp_path / "left.csv").rename(tmp_path / "left.npz")
    assert error.file != message(read_scene_tracks, tmp_path, NAMES).file  # says which file cannot be read


def test_one_file_of_one_camera(tmp_path):
    path = dump(tmp_path / "tracks_left.pkl", mvt(seen(0)))
    result = read_scene_tracks(path, ["right", "left"])
    assert [len(view) > 0 for view in result.tracks] == [False, True]
    path = path.rename(tmp_path / "tracks.pkl")
    assert "belongs to no camera" in message(read_scene_tracks, path, NAMES).problem


def test_the_origin_of_the_pixels(tmp_path):
    check(both(tmp_path), [seen(0) - 0.5, seen(1) - 0.5], atol=1e-12, pixel_origin="corner")
    assert message(read_scene_tracks, tmp_path, NAMES, pixel_origin="top").key == "pixel_origin"


def test_what_is_written_for_multiviewtracks_comes_back(tmp_path):
    for view in read_scene_tracks(both(tmp_path, "pkl"), NAMES).tracks:
        dump(tmp_path / f"tracks_{view.camera}.pkl", to_mvt(view))
    check(tmp_path)
