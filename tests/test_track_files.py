"""Every kind of file with 2D tracks: what is written is read again, and every message."""

import csv
import pickle
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from data_tools_synthetic import message

from acino_fte.data_tools.dltdv_files import is_xypts, read_xypts, read_xyzpts
from acino_fte.data_tools.track_files import (
    has_camera_column,
    read_joint_table,
    read_track_table,
    read_true_animals,
    read_truth_3d,
)
from acino_fte.data_tools.tracker_exports import exporter, read_idtracker, read_sleap, read_trex, session_file
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
BATS, WAND, MOUSE = SHARED / "bats", SHARED / "bats_wand", SHARED / "sleap_mouse"


def needs(folder: Path):
    return pytest.mark.skipif(not folder.is_dir(), reason=f"shared/data/{folder.name} is absent")


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def read(tmp_path: Path, text: str) -> Tracks2D:
    return read_track_table(write(tmp_path / "cam0.csv", text), "cam0")


def grid(n_frames=6, n_animals=3, seed=0) -> np.ndarray:
    """Positions (F, A, 2), some missing."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 600, (n_frames, n_animals, 2))
    xy[rng.random((n_frames, n_animals)) < 0.3] = np.nan
    return xy


def as_grid(view: Tracks2D, shape) -> np.ndarray:
    xy = np.full(shape, np.nan)
    xy[view.frame, view.track] = view.xy
    return xy


# ---------------------------------------------------------------------------------- tables


def test_a_table_is_read_in_the_order_of_its_rows(tmp_path):
    view = read(tmp_path, "frame,track,x,y\n3,10,1.5,2.5\n0,9,3,4\n3,9,5,6\n")
    assert view.frame.tolist() == [3, 0, 3]
    assert view.labels == ("9", "10")  # in the order of their numbers
    assert [view.labels[t] for t in view.track] == ["10", "9", "9"]
    assert view.xy.tolist() == [[1.5, 2.5], [3, 4], [5, 6]]
    assert view.row.tolist() == [0, 1, 2]
    assert view.left_out is None
    assert view.animal is None
    view = read(tmp_path, "frame,track,x,y\n0,id10,1,2\n0,id2,3,4\n0,9007199254740993,5,6\n")
    assert view.labels == ("9007199254740993", "id2", "id10")
    view = read(tmp_path, "frame,track,x,y\n0,9007199254740993,1,2\n0,9007199254740992,3,4\n0,-1,5,6\n")
    assert view.labels == ("9007199254740992", "9007199254740993")


@pytest.mark.parametrize(
    "header", ["frame_number;ID;col_index;row_index", "Frame;Identity;X;Y", '"frame"; individual ;u;v']
)
def test_names_of_columns_have_synonyms_and_no_case(tmp_path, header):
    text = f"{header}\n0;bee;1;2\n1;ant;3;4\n"
    for separator in ";,\t":
        view = read(tmp_path, text.replace(";", separator))
        assert view.labels == ("ant", "bee")
        assert view.xy.tolist() == [[1, 2], [3, 4]]


def test_a_name_goes_before_its_synonyms_and_other_columns_are_passed_over(tmp_path):
    view = read(tmp_path, "note,id,frame,row,x,y,track,column\nred,7,0,50,1,2,3,60\n,8,1,51,1,2,3,61\n")
    assert view.labels == ("3",)
    assert view.xy.tolist() == [[1, 2], [1, 2]]


@pytest.mark.parametrize("track", ["", "-1", "nan", " "])
def test_dots_without_a_track_are_bare(tmp_path, track):
    view = read(tmp_path, f"frame,track,x,y\n0,{track},1,2\n0,{track},3,4\n0,5,5,6\n")
    assert view.track.tolist() == [-1, -1, 0]
    assert view.labels == ("5",)


def test_a_table_without_tracks_has_bare_points(tmp_path):
    view = read(tmp_path, "frame,x,y\n0,1,2\n0,3,4\n")
    assert view.track.tolist() == [-1, -1]
    assert view.labels == ()


def test_the_animal_is_the_track_unless_there_is_one(tmp_path):
    view = read(tmp_path, "frame,animal,x,y\n0,4,1,2\n0,-1,3,4\n1,4,5,6\n")
    assert view.labels == ("4",)
    assert view.track.tolist() == [0, -1, 0]
    assert view.animal.tolist() == [4, -1, 4]
    view = read(tmp_path, "frame,animal,track,x,y\n0,4,a,1,2\n1,4,b,5,6\n")
    assert view.labels == ("a", "b")
    assert view.animal.tolist() == [4, 4]


def test_rows_without_coordinates_are_left_out_and_remembered(tmp_path):
    view = read(tmp_path, "frame,track,x,y\n0,1,1,2\n1,1,,\n2,1,NaN,3\n3,2,5,6\n")
    assert view.frame.tolist() == [0, 3]
    assert view.row.tolist() == [0, 3]
    assert view.left_out.to_dict("list") == {"row": [1, 2], "frame": [1, 2], "track": ["1", "1"]}


def test_blank_lines_windows_ends_and_a_byte_order_mark(tmp_path):
    path = tmp_path / "cam0.csv"
    path.write_bytes("\ufeffframe,track,x,y\r\n0,1,1,2\r\n\r\n1,1,3,4\r\n\r\n".encode())
    view = read_track_table(path, "cam0")
    assert view.frame.tolist() == [0, 1]
    assert view.row.tolist() == [0, 1]


def test_a_header_without_rows_is_a_camera_that_sees_nothing(tmp_path):
    view = read(tmp_path, "frame,track,x,y\n")
    assert len(view) == 0
    assert view.labels == ()


def test_one_table_for_all_cameras(tmp_path):
    path = write(tmp_path / "points.csv", "frame,cam,animal,x,y\n0,1,7,1,2\n0,0,7,3,4\n1,1,8,5,6\n")
    assert has_camera_column(path)
    views = read_joint_table(path)
    assert list(views) == ["1", "0"]
    assert views["1"].row.tolist() == [0, 2]
    assert views["0"].row.tolist() == [1]
    assert views["1"].animal.tolist() == [7, 8]
    assert not has_camera_column(write(tmp_path / "cam0.csv", "frame,x,y\n"))
    error = message(read_joint_table, write(path, "frame,cam,x,y\n0,a,1,2\n0,,1,2\n"))
    assert "row 2" in error.key


def test_the_same_dots_as_bare_points_and_picked(tmp_path):
    view = read(tmp_path, "frame,track,animal,x,y\n0,1,5,1,2\n1,1,5,3,4\n1,2,6,5,6\n")
    bare = view.without_tracks()
    assert bare.track.tolist() == [-1, -1, -1]
    assert bare.row.tolist() == [0, 1, 2]
    picked = view.at_rows(view.frame == 1)
    assert picked.row.tolist() == [1, 2]
    assert picked.xy.tolist() == [[3, 4], [5, 6]]
    assert picked.animal.tolist() == [5, 6]


FAULTS = {
    "no column x": ("frame,track,ex,y\n0,1,2,3\n", "'x'", "frame, track, ex, y"),
    "a near name": ("fraem,track,x,y\n0,1,2,3\n", "did you mean 'fraem'", ""),
    "no header": ("0,1,2,3\n1,1,2,3\n", "no column 'frame'", "write a header line"),
    "text": ("frame,track,x,y\n0,1,2,3\n1,1,far,3\n", "column 'x'", "row 2 after the header (line 3)"),
    "text after a blank line": ("frame,track,x,y\n\n0,1,2,3\n1,1,2,low\n", "column 'y'", "(line 4)"),
    "half a frame": ("frame,track,x,y\n0.5,1,2,3\n", "column 'frame'", "0.5"),
    "no frame": ("frame,track,x,y\n,1,2,3\n", "column 'frame'", "nothing"),
    "a frame before 0": ("frame,track,x,y\n-3,1,2,3\n", "column 'frame'", "-3"),
    "an endless frame": ("frame,track,x,y\n1e300,1,2,3\n", "column 'frame'", "1e+300"),
    "infinity": ("frame,track,x,y\n0,1,2,3\n1,1,inf,3\n", "column 'x'", "row 2"),
    "twice": ("frame,track,x,y\n0,7,1,2\n1,7,1,2\n0,7,3,4\n", "Track '7' of camera 'cam0'", "rows 1 and 3"),
    "half an animal": ("frame,animal,x,y\n0,0.5,1,2\n", "column 'animal'", "0.5"),
    "too many fields": ("frame,track,x,y\n0,1,2,3\n1,1,2,3,4\n", "do not fit its header", "4 fields"),
    "too many at once": ("frame,track,x,y\n0,1,2,3,9\n1,1,2,3,4\n", "do not fit its header", "4 fields"),
    "nothing": ("", "empty", "frame,track,x,y"),
    "a picture": ("\x89PNG\0\0\0", "no text", "image"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_a_table_is_named(tmp_path, fault):
    text, problem, rest = FAULTS[fault]
    error = message(read, tmp_path, text)
    assert problem in error.problem
    assert rest in str(error)
    assert error.file == str(tmp_path / "cam0.csv")


def test_files_that_are_no_tables(tmp_path):
    assert "does not exist" in message(read_track_table, tmp_path / "no.csv", "c").problem
    assert "folder" in message(read_track_table, tmp_path, "c").problem
    (tmp_path / "a.csv").write_bytes(bytes(range(256)))
    assert "no text" in message(read_track_table, tmp_path / "a.csv", "c").problem


def test_true_animals_belong_to_rows(tmp_path):
    path = write(tmp_path / "cam0_truth.csv", "animal\n3\n\n-1\n")
    assert read_true_animals(path, 3).tolist() == [3, -1, -1]
    assert read_true_animals(path, 3, np.array([0, 2])).tolist() == [3, -1]
    error = message(read_true_animals, path, 4)
    assert (error.expected, error.found) == ("4 rows", "3 rows")
    assert read_true_animals(write(path, "animal\n3\n4\n\n\n"), 2).tolist() == [3, 4]


def test_true_positions(tmp_path):
    path = write(tmp_path / "truth_3d.csv", "frame,oid,x,y,z\n2,1,0.5,1,2\n3,1,,,\n2,0,1,1,1\n")
    truth = read_truth_3d(path)
    assert truth.to_dict("list") == {
        "frame": [2, 2],
        "animal": [1, 0],
        "x": [0.5, 1],
        "y": [1, 1],
        "z": [2, 1],
    }
    write(path, "frame,oid,x,y,z\n2,1,0,0,0\n2,1,1,1,1\n")
    assert "Animal 1 has two true positions in frame 2" in message(read_truth_3d, path).problem
    assert "'z'" in message(read_truth_3d, write(path, "frame,animal,x,y\n")).problem


# ---------------------------------------------------------------------------------- DLTdv


def write_xypts(path: Path, xy: np.ndarray) -> Path:
    """(F, points, cameras, 2), y up, as DLTdv 5 to 8 write it."""
    flat = xy.reshape(len(xy), -1)
    if path.suffix == ".tsv":
        row, column = np.nonzero(np.isfinite(flat))
        lines = [f"{i + 1}\t{j + 1}\t{flat[i, j]:.6f}" for i, j in zip(row, column, strict=True)]
        head = ["DLTdv8 sparse data", f"{flat.shape[0]}\t{flat.shape[1]}\t{len(row)}"]
        return write(path, "\n".join([*head, *lines]) + "\n")
    names = [
        f"pt{n + 1}_cam{k + 1}_{axis}"
        for n in range(xy.shape[1])
        for k in range(xy.shape[2])
        for axis in "XY"
    ]
    pd.DataFrame(flat, columns=names).to_csv(path, index=False, float_format="%.6f", na_rep="NaN")
    return path


@pytest.mark.parametrize("name", ["flightxypts.csv", "flightxypts.tsv"])
def test_digitised_points_come_back_with_y_from_the_top(tmp_path, name):
    rng = np.random.default_rng(1)
    xy = rng.uniform(1, 500, (7, 4, 2, 2)).round(6)
    xy[rng.random((7, 4, 2)) < 0.4] = np.nan
    path = write_xypts(tmp_path / name, xy)
    assert is_xypts(path)
    views = read_xypts(path, [512, 600])
    assert [view.camera for view in views] == ["cam1", "cam2"]
    for k, (view, height) in enumerate(zip(views, (512, 600), strict=True)):
        assert view.labels == ("pt1", "pt2", "pt3", "pt4")
        expected = xy[:, :, k] * [1, -1] + [0, height]
        np.testing.assert_allclose(as_grid(view, (7, 4, 2)), expected, atol=1e-9)
        np.testing.assert_array_equal(view.animal, view.track + 1)


@pytest.mark.parametrize("name", ["flightxyzpts.csv", "flightxyzpts.tsv"])
def test_reconstructed_points_are_truth(tmp_path, name):
    xyz = np.random.default_rng(2).normal(size=(5, 3, 3)).round(6)
    xyz[2:4, 1] = np.nan
    flat = xyz.reshape(5, -1)
    if name.endswith("csv"):
        columns = [f"pt{n + 1}_{axis}" for n in range(3) for axis in "XYZ"]
        pd.DataFrame(flat, columns=columns).to_csv(tmp_path / name, index=False, na_rep="NaN")
    else:
        write_xypts(tmp_path / name, flat[:, None, None])
    truth = read_xyzpts(tmp_path / name)
    assert len(truth) == 13
    got = np.full((5, 3, 3), np.nan)
    got[truth.frame, truth.animal - 1] = truth[["x", "y", "z"]]
    np.testing.assert_allclose(got, xyz, atol=1e-9)


def test_faults_of_digitised_points(tmp_path):
    xy = np.ones((3, 2, 2, 2))
    path = write_xypts(tmp_path / "axypts.csv", xy)
    error = message(read_xypts, path, [512] * 3)
    assert "3 cameras" in error.expected
    assert "cam1 to cam2" in error.found
    text = path.read_text()
    error = message(read_xypts, write(path, text.replace("pt2_cam2_Y", "pt2_cam3_Y")), [512] * 2)
    assert "not complete" in error.problem
    error = message(read_xypts, write(path, text.replace("pt2_cam2_Y", "head")), [512] * 2)
    assert "'head'" in error.found
    error = message(read_xypts, write(path, text.replace("1.000000\n", "one\n", 1)), [512] * 2)
    assert "pt2_cam2_Y" in error.problem
    sparse = write_xypts(tmp_path / "axypts.tsv", xy)
    text = sparse.read_text()
    assert "columns" in message(read_xypts, sparse, [512] * 3).expected
    assert message(read_xypts, write(sparse, text[:-12]), [512] * 2)
    assert message(read_xypts, write(sparse, text.replace("3\t8\t1.0", "4\t8\t1.0")), [512] * 2)
    assert message(read_xypts, write(sparse, "title\n"), [512] * 2)
    assert "does not exist" in message(read_xypts, tmp_path / "bxypts.tsv", [512]).problem


@needs(BATS)
def test_bats_are_read_as_they_are():
    views = read_xypts(BATS / "bats_P000-15000_xypts.csv", [512] * 3)
    truth = read_xyzpts(BATS / "bats_P000-15000_xyzpts.csv")
    raw = pd.read_csv(BATS / "bats_P000-15000_xypts.csv")
    assert len(truth) == 606
    assert truth.animal.max() == 15
    assert len(views[1]) == raw.filter(regex="cam2_X").notna().to_numpy().sum()
    first = views[0]
    assert first.xy[0].tolist() == [raw.pt1_cam1_X[0], 512 - raw.pt1_cam1_Y[0]]


@needs(WAND)
def test_bare_detections_of_all_cameras():
    path = WAND / "P00_97000_detections.csv"
    views = read_joint_table(path)
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(views) == ["K1", "K2", "K3"]
    assert sum(len(view) for view in views.values()) == len(rows) == 1110
    for name, view in views.items():
        assert (view.track == -1).all()
        assert all(rows[i]["camera_id"] == name for i in view.row)
        assert view.xy[5].tolist() == [float(rows[view.row[5]][key]) for key in ("col_index", "row_index")]


# ---------------------------------------------------------------------------------- TRex


def write_trex(folder: Path, xy: np.ndarray, cm_per_pixel: float, *, ending: str, said: bool = True) -> list:
    """A file an individual, from its first frame to its last; what is missing is infinite."""
    paths = []
    for a in range(xy.shape[1]):
        seen = np.flatnonzero(np.isfinite(xy[:, a]).all(1))
        frame = np.arange(seen[0], seen[-1] + 1)
        at = xy[frame, a] * cm_per_pixel
        missing = ~np.isfinite(at).all(1)
        at[missing] = np.inf
        columns = {"frame": frame, "X#wcentroid": at[:, 0], "Y#wcentroid": at[:, 1]}
        columns |= {"X": at[:, 0] + 3, "Y": at[:, 1], "missing": missing.astype(float)}
        path = folder / f"video_id{a}.{ending}"
        if ending == "npz":
            np.savez(path, **columns, **({"cm_per_pixel": cm_per_pixel} if said else {}))
        else:
            pd.DataFrame(columns).rename(columns={"X": "X (cm)", "Y": "Y (cm)"}).to_csv(path, index=False)
        paths.append(path)
    return paths


@pytest.mark.parametrize("ending", ["npz", "csv"])
def test_individuals_of_trex_come_back(tmp_path, ending):
    xy = grid(20, 3)
    paths = write_trex(tmp_path, xy, 0.05, ending=ending)
    assert {exporter(path) for path in paths} == {"trex"}
    given = None if ending == "npz" else 0.05
    view = read_trex(paths, "cam0", cm_per_pixel=given)
    assert view.labels == ("id0", "id1", "id2")
    np.testing.assert_allclose(as_grid(view, xy.shape), xy, atol=1e-9)
    head = read_trex(paths, "cam0", cm_per_pixel=given, point="head")
    np.testing.assert_allclose(head.xy - view.xy, np.broadcast_to([60, 0], view.xy.shape), atol=1e-9)


def test_interpolated_positions_of_trex_are_no_dots(tmp_path):
    np.savez(tmp_path / "v_id0.npz", frame=[4, 5, 6], X=[1.0, 2, 3], Y=[1.0, 2, 3], missing=[0.0, 1, 0])
    assert read_trex([tmp_path / "v_id0.npz"], "c", cm_per_pixel=1).frame.tolist() == [4, 6]


def test_faults_of_trex(tmp_path):
    paths = write_trex(tmp_path, grid(), 0.05, ending="npz", said=False)
    error = message(read_trex, paths, "c")
    assert error.key == "cm_per_pixel"
    assert message(read_trex, paths, "c", cm_per_pixel=-1).found == "-1"
    assert "X#pcentroid" in message(read_trex, paths, "c", cm_per_pixel=1, point="pcentroid").expected
    np.savez(tmp_path / "v_id0.npz", X=[1.0], Y=[1.0])
    assert "frame" in message(read_trex, [tmp_path / "v_id0.npz"], "c", cm_per_pixel=1).expected
    np.savez(tmp_path / "v_id0.npz", frame=[1, 2], X=[1.0], Y=[1.0])
    assert "length" in message(read_trex, [tmp_path / "v_id0.npz"], "c", cm_per_pixel=1).problem
    write(tmp_path / "v_id1.npz", "no archive")
    assert "NumPy" in message(read_trex, [tmp_path / "v_id1.npz"], "c").problem
    np.savez(tmp_path / "v_id2.npz", frame=np.array([print], dtype=object), X=[1.0], Y=[1.0])
    assert "numbers only" in message(read_trex, [tmp_path / "v_id2.npz"], "c").expected
    assert exporter(tmp_path / "video_posture_id0.npz") is None


# ---------------------------------------------------------------------------------- idtracker.ai


def write_idtracker(folder: Path, xy: np.ndarray, *, kind: str, labels=("ann", "bob", "cat")) -> Path:
    """As idtracker.ai 6 writes it, with some of its other entries."""
    folder.mkdir(parents=True, exist_ok=True)
    data = {"trajectories": xy, "frames_per_second": 50, "version": "6.0", "video_paths": ["a.mp4"]}
    data |= {"identities_labels": list(labels), "areas": {"mean": np.ones(3)}, "setup_points": {}}
    path = folder / f"trajectories.{kind}"
    if kind == "npy":
        np.save(path, data)
    elif kind == "h5":
        with h5py.File(path, "w") as file:
            file.create_dataset("trajectories", data=xy, compression="gzip")
            file.attrs["identities_labels"] = list(labels)
            file.create_group("areas").create_dataset("mean", data=np.ones(3))
    else:
        header = ",".join(["time", *(f"{axis}{i + 1}" for i in range(xy.shape[1]) for axis in "xy")])
        table = np.column_stack([np.arange(len(xy)) / 50, xy.reshape(len(xy), -1)])
        np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.3f")
    return path


@pytest.mark.parametrize("kind", ["npy", "h5", "csv"])
def test_trajectories_of_idtracker_come_back(tmp_path, kind):
    xy = grid()
    path = write_idtracker(tmp_path / "session_a" / "trajectories", xy, kind=kind)
    assert exporter(path) == "idtracker"
    view = read_idtracker(path, "cam0")
    assert view.labels == (("1", "2", "3") if kind == "csv" else ("ann", "bob", "cat"))
    np.testing.assert_allclose(as_grid(view, xy.shape), xy, atol=1e-3 if kind == "csv" else 0)
    if kind != "csv":
        assert session_file(tmp_path / "session_a") == path
    assert session_file(tmp_path) is None


def test_the_csv_of_a_session_is_found(tmp_path):
    folder = tmp_path / "session_a" / "trajectories" / "trajectories_csv"
    path = write_idtracker(folder, grid(), kind="csv")
    assert session_file(tmp_path / "session_a") == path


def test_a_bare_array_is_read(tmp_path):
    xy = grid()
    np.save(tmp_path / "cam0.npy", xy)
    np.testing.assert_array_equal(as_grid(read_idtracker(tmp_path / "cam0.npy", "c"), xy.shape), xy)


class Evil:
    def __reduce__(self):
        return (Path.touch, (Path("ran"),))


def test_faults_of_idtracker(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "t.npy"
    np.save(path, {"trajectories": Evil()})
    assert "could run code" in message(read_idtracker, path, "c").problem
    assert not (tmp_path / "ran").exists()
    np.save(path, {"positions": 1})
    assert "positions" in message(read_idtracker, path, "c").found
    np.save(path, np.zeros((3, 2)))
    assert "(3, 2)" in message(read_idtracker, path, "c").found
    path.write_bytes(pickle.dumps({"trajectories": 1}))
    assert message(read_idtracker, path, "c")
    assert "does not exist" in message(read_idtracker, tmp_path / "no.npy", "c").problem
    table = write(tmp_path / "t.csv", "time,x1,x2\n0,1,2\n")
    assert "x1, x2" in message(read_idtracker, table, "c").found
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["other"] = 1
    assert message(read_idtracker, tmp_path / "t.h5", "c").found == "other"
    write(tmp_path / "u.h5", "text")
    assert "HDF5" in message(read_idtracker, tmp_path / "u.h5", "c").problem


# ---------------------------------------------------------------------------------- SLEAP


def write_sleap(path: Path, xy: np.ndarray, nodes=("head", "tail")) -> Path:
    """(F, A, nodes, 2) as an analysis file."""
    if path.suffix == ".csv":
        rows = [
            {"track": f"bird_{a}", "frame_idx": f, "instance.score": 0.9}
            | {f"{n}.{axis}": xy[f, a, i, k] for i, n in enumerate(nodes) for k, axis in enumerate("xy")}
            | {f"{n}.score": 0.5 for n in nodes}
            for f in range(xy.shape[0])
            for a in range(xy.shape[1])
            if np.isfinite(xy[f, a]).any()
        ]
        pd.DataFrame(rows).to_csv(path, index=False)
        return path
    with h5py.File(path, "w") as file:
        file["tracks"] = xy.transpose(1, 3, 2, 0)
        file["node_names"] = np.array(nodes, dtype="S")
        file["track_names"] = np.array([f"bird_{a}" for a in range(xy.shape[1])], dtype="S")
    return path


@pytest.mark.parametrize("name", ["side.analysis.h5", "side.csv"])
def test_an_analysis_of_sleap_comes_back(tmp_path, name):
    xy = np.random.default_rng(3).uniform(0, 600, (8, 3, 2, 2))
    xy[2:5, 1] = np.nan
    xy[6, 2, 1] = np.nan  # only the head was found
    path = write_sleap(tmp_path / name, xy)
    assert exporter(path) == "sleap"
    view = read_sleap(path, "side")
    assert view.labels == ("bird_0", "bird_1", "bird_2")
    mean = (xy[:, :, 0] + xy[:, :, 1]) / 2
    mean[6, 2] = xy[6, 2, 0]
    np.testing.assert_allclose(as_grid(view, mean.shape), mean, atol=1e-9)
    head = read_sleap(path, "side", node="head")
    np.testing.assert_allclose(as_grid(head, mean.shape), xy[:, :, 0], atol=1e-9)
    error = message(read_sleap, path, "side", node="haed")
    assert "did you mean 'head'" in error.problem
    assert error.expected == "head, tail"


def test_faults_of_sleap(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["node_names"] = np.array(["a"], dtype="S")
    assert "no 'tracks'" in message(read_sleap, tmp_path / "a.h5", "c").found
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["node_names"] = np.array(["a"], dtype="S")
        file["tracks"] = np.zeros((5, 1, 2, 3))
    assert "(5, 1, 2, 3)" in message(read_sleap, tmp_path / "b.h5", "c").found
    assert message(read_sleap, write(tmp_path / "c.csv", "frame_idx,a.x,a.y\n0,1,2\n"), "c")
    assert message(read_sleap, write(tmp_path / "c.csv", "frame,track\n0,1\n"), "c")


@needs(MOUSE)
def test_a_mouse_is_where_its_nose_is():
    path = MOUSE / "side.analysis.h5"
    view = read_sleap(path, "side", node="Nose")
    with h5py.File(path) as file:
        expected = file["tracks"][0, :, 0].T
    np.testing.assert_array_equal(view.xy, expected[np.isfinite(expected).all(1)])
    assert view.labels == ("track_0",)


# ---------------------------------------------------------------------------------- files that were cut


def readers(folder: Path) -> list:
    xy, poses = grid(), np.random.default_rng(4).uniform(0, 600, (6, 3, 2, 2))
    long = "frame,track,x,y\n" + "".join(f"{i},{i % 3},{2.5 * i},{3 * i}\n" for i in range(9))
    return [
        (write(folder / "long.csv", long), lambda path: read_track_table(path, "c")),
        (write_xypts(folder / "axypts.csv", poses), lambda path: read_xypts(path, [512] * 2)),
        (write_xypts(folder / "axypts.tsv", poses), lambda path: read_xypts(path, [512] * 2)),
        (write_trex(folder, xy, 0.05, ending="npz")[0], lambda path: read_trex([path], "c")),
        (write_idtracker(folder, xy, kind="npy"), lambda path: read_idtracker(path, "c")),
        (write_idtracker(folder, xy, kind="h5"), lambda path: read_idtracker(path, "c")),
        (write_idtracker(folder, xy, kind="csv"), lambda path: read_idtracker(path, "c")),
        (write_sleap(folder / "s.h5", poses), lambda path: read_sleap(path, "c")),
    ]


@pytest.mark.parametrize("which", range(8))
def test_spoilt_files_are_read_or_refused_and_nothing_else(tmp_path, which):
    path, reader = readers(tmp_path)[which]
    whole, refused = path.read_bytes(), 0
    rng = np.random.default_rng(5)
    for i in range(60):
        spoilt = bytearray(whole)
        at = int(rng.integers(len(whole)))
        if i % 3 == 0 or path.suffix == ".npy":  # NumPy does not check a pickled dtype byte by byte
            spoilt = spoilt[:at]
        elif i % 3 == 1:
            spoilt[at] = int(rng.integers(256))
        else:
            spoilt[at:at] = [b",", b"\n", b"99999999999999999999", b"\0", b'"'][i % 5]
        path.write_bytes(spoilt)
        try:
            reader(path)
        except InputError:
            refused += 1
        exporter(path)
    assert refused > 10


def test_impossible_sizes_are_refused_at_once(tmp_path):
    path = write(tmp_path / "t.csv", "time,x1,y99999999999\n0,1,2\n")
    assert message(read_idtracker, path, "c")
    path = write(tmp_path / "axypts.csv", "pt1_cam1_X,pt99999999999_cam1_Y\n1,2\n")
    assert message(read_xypts, path, [512])
    path = write(tmp_path / "axypts.tsv", "title\n999999999999\t4\t0\n")
    assert message(read_xypts, path, [512])
