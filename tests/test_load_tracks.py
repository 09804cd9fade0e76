"""From a folder with cameras and 2D tracks to a recording, and every message on the way."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from data_tools_synthetic import message
from test_track_files import (
    BATS,
    MOUSE,
    SHARED,
    WAND,
    needs,
    write,
    write_idtracker,
    write_sleap,
    write_trex,
    write_xypts,
)

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.calibration import write_cameras
from acino_fte.data_tools.load_tracks import load_tracks
from acino_fte.data_tools.projective_camera import projection_matrix
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_folder import write_tracks
from acino_fte.data_tools.track_names import cameras_of, same_name
from acino_fte.data_tools.tracks2d import TrackRecording
from acino_fte.errors import InputError

TRACKS = SHARED / "tracks"
SIZE = (640, 512)
N_FRAMES, N_ANIMALS = 12, 4


def rig(*names: str) -> CameraArray:
    """Cameras in a row, 1 m apart, that look along the world's z."""
    matrix = np.array([[500.0, 0, 320], [0, 500, 256], [0, 0, 1]])
    return CameraArray(
        tuple(
            Camera(name, "pinhole", matrix, np.zeros(5), np.eye(3), np.array([-float(i), 0, 0]), SIZE)
            for i, name in enumerate(names)
        )
    )


def scene(path: Path, cameras: CameraArray, ids) -> None:
    entries = [
        {
            "id": camera_id,
            "K": camera.matrix.tolist(),
            "R": camera.rotation.tolist(),
            "t": camera.translation.tolist(),
            "dist_opencv": camera.distortion.tolist(),
            "image_size": list(camera.resolution),
        }
        for camera_id, camera in zip(ids, cameras, strict=True)
    ]
    path.write_text(json.dumps(entries))


def points(seed=0) -> np.ndarray:
    """World points (N, A, 3) in front of the cameras."""
    rng = np.random.default_rng(seed)
    start = rng.uniform([-0.5, -1, 4], [1.5, 1, 6], (N_ANIMALS, 3))
    return start + np.cumsum(rng.normal(0, 0.02, (N_FRAMES, N_ANIMALS, 3)), axis=0)


def seen(cameras: CameraArray, seed=0) -> np.ndarray:
    """Pixels (C, N, A, 2), some missing."""
    pixels = cameras.project(points(seed)).transpose(1, 0, 2, 3)
    hidden = np.random.default_rng(seed + 1).random(pixels.shape[:3]) < 0.1
    return np.where(hidden[..., None], np.nan, pixels)


def table(xy: np.ndarray, seed=0) -> pd.DataFrame:
    """Rows frame, track, animal, x, y in disorder; tracks are numbered anew."""
    rng = np.random.default_rng(seed)
    frame, animal = np.nonzero(np.isfinite(xy).all(-1))
    order = rng.permutation(len(frame))
    frame, animal = frame[order], animal[order]
    number = rng.permutation(100)[:N_ANIMALS]
    x, y = xy[frame, animal].T
    return pd.DataFrame({"frame": frame, "track": number[animal], "animal": animal, "x": x, "y": y})


def write_tables(folder: Path, names, cameras: CameraArray, seed=0) -> list[pd.DataFrame]:
    tables = [table(xy, i) for i, xy in enumerate(seen(cameras, seed))]
    for name, rows in zip(names, tables, strict=True):
        rows.drop(columns="animal").to_csv(folder / f"{name}.csv", index=False)
        rows[["animal"]].to_csv(folder / f"{name}_truth.csv", index=False)
    return tables


def write_folder(folder: Path, names=("cam0", "cam1")) -> list[pd.DataFrame]:
    folder.mkdir(exist_ok=True)
    write_cameras(folder / "cameras.json", rig(*names))
    return write_tables(folder, names, rig(*names))


def same(recording: TrackRecording, tables) -> None:
    for view, rows in zip(recording.views, tables, strict=True):
        np.testing.assert_array_equal(view.frame, rows.frame)
        np.testing.assert_allclose(view.xy, rows[["x", "y"]], atol=1e-9)
        np.testing.assert_array_equal(np.array(view.labels)[view.track], rows.track.astype(str))
        np.testing.assert_array_equal(view.animal, rows.animal)


def edit(path: Path, change) -> None:
    change(pd.read_csv(path)).to_csv(path, index=False)


def test_a_folder_of_tables(tmp_path):
    tables = write_folder(tmp_path / "birds")
    xyz = points()
    frame, animal = np.indices(xyz.shape[:2]).reshape(2, -1)
    truth = pd.DataFrame(
        {"frame": frame, "animal": animal, **dict(zip("xyz", xyz.reshape(-1, 3).T, strict=True))}
    )
    truth.to_csv(tmp_path / "birds" / "truth_3d.csv", index=False)
    recording = load_tracks(tmp_path / "birds", fps=30)
    same(recording, tables)
    assert recording.name == "birds"
    assert recording.fps == 30
    assert recording.cameras.names == ["cam0", "cam1"]
    assert (recording.first_frame, recording.n_frames) == (0, N_FRAMES)
    assert recording.warnings == ()
    shutil.copy(
        tmp_path / "birds" / "cam0.csv", tmp_path / "birds" / "cam0_old.csv"
    )  # cam0.csv says it better
    assert load_tracks(tmp_path / "birds").views[0].path.name == "cam0.csv"
    pd.testing.assert_frame_equal(recording.truth_3d, truth)


@pytest.mark.parametrize("ids", [["0", "1"], [0, 1], ["cam0", "cam1"], ["cam_00", "Camera 1"]])
def test_files_and_cameras_are_joined_by_name_and_not_by_order(tmp_path, ids):
    tables = write_folder(tmp_path)
    scene(tmp_path / "cameras.json", rig("a", "b"), ids)
    same(load_tracks(tmp_path), tables)
    turned = rig("a", "b")
    scene(tmp_path / "cameras.json", CameraArray((turned[1], turned[0])), ids[::-1])
    recording = load_tracks(tmp_path)
    same(recording, tables[::-1])
    assert recording.cameras[0].translation[0] == -1


def test_names_of_cameras():
    assert {same_name(n) for n in ("cam1", "K1", "Cam_01", "camera 1", "1", "view1", "CAM-1")} == {"1"}
    assert same_name(" Side ") == "side"
    assert cameras_of("birds_cam1_tracks", ["cam0", "cam1"]) == ["cam1"]
    assert cameras_of("GX_left-2", ["left", "right"]) == ["left"]
    assert cameras_of("trial_1", ["cam0", "cam1"]) == []
    assert cameras_of("cam1_of_cam0", ["cam0", "cam1"]) == ["cam0", "cam1"]
    assert cameras_of("cam11", ["cam1", "cam2"]) == []
    assert cameras_of("2121113", ["cam2121113", "cam2121156"]) == ["cam2121113"]
    assert cameras_of("topmost", ["top", "side"]) == []


def test_one_table_for_all_cameras(tmp_path):
    tables = write_folder(tmp_path)
    rows = pd.concat([t.assign(cam=f"cam{i}") for i, t in enumerate(tables)]).sample(frac=1, random_state=0)
    for path in tmp_path.glob("cam?*.csv"):
        path.unlink()
    rows.to_csv(tmp_path / "points_2d.csv", index=False)
    expected = [rows[rows.cam == name] for name in ("cam0", "cam1")]
    recording = load_tracks(tmp_path)
    same(recording, expected)
    np.testing.assert_array_equal(
        np.sort(np.concatenate([view.row for view in recording.views])), np.arange(len(rows))
    )
    np.testing.assert_array_equal(rows.iloc[recording.views[1].row].cam, "cam1")
    same(load_tracks(tmp_path / "points_2d.csv"), expected)


def test_numbers_that_name_no_camera_are_places(tmp_path):
    tables = write_folder(tmp_path)
    for path in tmp_path.glob("cam?*.csv"):
        path.unlink()
    pd.concat([t.assign(cam=i) for i, t in enumerate(tables)]).to_csv(tmp_path / "p.csv", index=False)
    write_cameras(tmp_path / "cameras.json", rig("left", "right"))
    recording = load_tracks(tmp_path)
    same(recording, tables)
    assert "taken as their places" in recording.warnings[0]
    write_cameras(tmp_path / "cameras.json", rig("cam1", "cam2"))
    error = message(load_tracks, tmp_path)
    assert "cam1, cam2" in error.expected
    assert error.found == "0, 1"


def test_files_named_by_hand(tmp_path):
    tables = write_folder(tmp_path, ("cam0", "cam1", "cam2"))
    two = load_tracks(tmp_path, tracks=[tmp_path / "cam2.csv", tmp_path / "cam0.csv"])
    same(two, [tables[0], tables[2]])
    assert two.warnings == ("No tracks for cam1: left out.",)
    mapped = load_tracks(tmp_path, tracks={"cam1": tmp_path / "cam2.csv", "cam0": tmp_path / "cam0.csv"})
    same(mapped, [tables[0], tables[2]])
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.move(tmp_path / "cameras.json", elsewhere / "rig.json")
    same(load_tracks(tmp_path, cameras=elsewhere / "rig.json"), tables)
    same(load_tracks(tmp_path, cameras=rig("cam0", "cam1", "cam2")), tables)
    assert "cam9" in message(load_tracks, tmp_path, cameras=rig("cam0", "cam1"), tracks={"cam9": "a"}).found
    (elsewhere / "cam1").mkdir()
    shutil.copy(tmp_path / "cam1.csv", elsewhere / "cam1" / "tracks.csv")
    given = [tmp_path / "cam0.csv", elsewhere / "cam1" / "tracks.csv"]
    assert load_tracks(tmp_path, cameras=rig("cam0", "cam1"), tracks=given).views[1].path == given[1]


def test_left_out_rows_and_silent_cameras_are_told(tmp_path):
    write_folder(tmp_path, ("cam0", "cam1", "cam2"))
    edit(tmp_path / "cam1.csv", lambda t: t.assign(x=t.x.where(t.frame != 3)))
    edit(tmp_path / "cam2.csv", lambda t: t.iloc[:0])
    edit(tmp_path / "cam2_truth.csv", lambda t: t.iloc[:0])
    recording = load_tracks(tmp_path)
    n = len(recording.views[1].left_out)
    assert n > 0
    assert recording.warnings == (
        f"{n} rows of camera 'cam1' have no coordinates: they are left out.",
        "Camera 'cam2' has no dots.",
    )
    view = recording.views[1]
    rows = pd.read_csv(tmp_path / "cam1.csv").assign(animal=pd.read_csv(tmp_path / "cam1_truth.csv").animal)
    assert not (view.frame == 3).any()
    np.testing.assert_array_equal(view.animal, rows.animal[view.row])
    np.testing.assert_array_equal(np.sort([*view.row, *view.left_out.row]), np.arange(len(rows)))


# -------------------------------------------------------------------------------------------- other trackers


def test_a_folder_of_dltdv(tmp_path):
    cameras = rig("a", "b", "c")
    up = seen(cameras).transpose(1, 2, 0, 3) * [1, -1] + [0, SIZE[1]]
    write_xypts(tmp_path / "flight1xypts.csv", up)
    flip = np.array([[1, 0, 0], [0, -1, SIZE[1]], [0, 0, 1.0]])
    turn = np.eye(4)
    turn[2, 3] = 2.0  # the world's origin off the cameras' plane, or the last coefficient is not 1
    coefficients = [flip @ projection_matrix(camera) @ turn for camera in cameras]
    coefficients = np.stack([(p / p[2, 3]).ravel()[:11] for p in coefficients], axis=1)
    np.savetxt(tmp_path / "flight_dltCoefs.csv", coefficients, delimiter=",", fmt="%.15g")
    assert message(load_tracks, tmp_path).key == "resolution"
    recording = load_tracks(tmp_path, resolution=SIZE)
    assert recording.cameras.names == ["cam1", "cam2", "cam3"]
    offset = np.array([0, 0, 2.0])
    for view, camera in zip(recording.views, recording.cameras, strict=True):
        pixels = camera.project(points() - offset)[view.frame, view.animal - 1]
        np.testing.assert_allclose(view.xy, pixels, atol=2e-5)
    write_xypts(tmp_path / "flight2xypts.tsv", up)
    error = message(load_tracks, tmp_path, resolution=SIZE)
    assert error.found == "flight1xypts.csv, flight2xypts.tsv"
    sparse = load_tracks(tmp_path, resolution=SIZE, tracks=tmp_path / "flight2xypts.tsv")
    for a, b in zip(recording.views, sparse.views, strict=True):
        np.testing.assert_allclose(a.xy, b.xy, atol=1e-6)


def placed(recording: TrackRecording) -> np.ndarray:
    """The pixels of a recording whose tracks are in the order of the animals, (C, N, A, 2)."""
    xy = np.full((len(recording.views), N_FRAMES, N_ANIMALS, 2), np.nan)
    for c, view in enumerate(recording.views):
        xy[c, view.frame, view.track] = view.xy
    return xy


def test_folders_of_trackers(tmp_path):
    cameras = rig("left", "right")
    xy = seen(cameras)
    labels = [f"fish{a}" for a in range(N_ANIMALS)]
    for c, name in enumerate(cameras.names):
        (tmp_path / "trex" / name / "data").mkdir(parents=True)
        write_trex(tmp_path / "trex" / name / "data", xy[c], 0.02, ending="npz")
        write_idtracker(
            tmp_path / "idtracker" / f"session_{name}" / "trajectories", xy[c], kind="npy", labels=labels
        )
        (tmp_path / "sleap").mkdir(exist_ok=True)
        write_sleap(tmp_path / "sleap" / f"{name}.analysis.h5", xy[c][:, :, None], ("body",))
        (tmp_path / "flat").mkdir(exist_ok=True)
        for path in (tmp_path / "trex" / name / "data").iterdir():
            shutil.copy(path, tmp_path / "flat" / f"{name}_{path.name}")
    for kind in ("trex", "idtracker", "sleap", "flat"):
        write_cameras(tmp_path / kind / "cameras.json", cameras)
        recording = load_tracks(tmp_path / kind)
        assert recording.cameras.names == ["left", "right"]
        np.testing.assert_allclose(placed(recording), xy, atol=1e-9)
    given = [tmp_path / "idtracker" / "session_right", tmp_path / "sleap" / "left.analysis.h5"]
    mixed = load_tracks(tmp_path, cameras=cameras, tracks=given)
    np.testing.assert_allclose(placed(mixed), xy, atol=1e-9)
    assert "node" in message(load_tracks, tmp_path / "sleap", node="tail").problem
    (tmp_path / "sleap" / "left.npz").write_text("")
    assert "more than one file" in message(load_tracks, tmp_path / "sleap").problem


def test_moving_cameras_have_the_poses_of_the_frames_with_dots(tmp_path):
    write_folder(tmp_path)
    for name in ("cam0", "cam1"):
        edit(tmp_path / f"{name}.csv", lambda t: t.assign(frame=t.frame + 5))
    still = rig("cam0", "cam1")

    def moving(n_poses):
        shift = np.arange(n_poses)[:, None] * [0.01, 0, 0]
        return CameraArray((still[0], replace(still[1], translation=still[1].translation + shift)))

    whole = load_tracks(tmp_path, cameras=moving(30))  # pose n is that of frame n
    assert whole.first_frame == 5
    np.testing.assert_allclose(whole.cameras[1].translation[:, 0], -1 + 0.01 * np.arange(5, 5 + N_FRAMES))
    exact = load_tracks(tmp_path, cameras=moving(N_FRAMES))
    np.testing.assert_allclose(exact.cameras[1].translation[:, 0], -1 + 0.01 * np.arange(N_FRAMES))
    error = message(load_tracks, tmp_path, cameras=moving(N_FRAMES + 2))
    assert "too few poses" in error.problem
    assert error.found == str(N_FRAMES + 2)


@pytest.mark.parametrize("kind", [{"lens": "fisheye"}, {"rig": "ring", "n_cameras": 3, "moving": True}, {}])
def test_a_simulation_is_read_as_it_was_written(tmp_path, kind):
    options = TrackSimulation(n_animals=5, n_frames=40, tracks="fragments", missed=0.1, clutter=0.1, **kind)
    simulated = simulate_tracks(options)
    write_tracks(simulated, tmp_path / "flock")
    recording = load_tracks(tmp_path / "flock", fps=simulated.fps)
    assert recording.cameras.names == simulated.cameras.names
    assert recording.first_frame == simulated.first_frame
    for a, b in zip(simulated.cameras, recording.cameras, strict=True):
        np.testing.assert_array_equal(a.rotation, b.rotation)
        np.testing.assert_array_equal(a.translation, b.translation)
    for a, b in zip(simulated.views, recording.views, strict=True):
        np.testing.assert_array_equal(a.frame, b.frame)
        np.testing.assert_array_equal(a.animal, b.animal)
        np.testing.assert_allclose(a.xy, b.xy, atol=1e-4)
        assert [a.labels[t] for t in a.track] == [b.labels[t] for t in b.track]
    np.testing.assert_allclose(recording.truth_3d, simulated.truth_3d, atol=1e-6)


# -------------------------------------------------------------------------------------------- faults


def remove(name):
    return lambda folder: (folder / name).unlink()


def rows(name, change):
    return lambda folder: edit(folder / name, change)


def one_camera(folder):
    write_cameras(folder / "cameras.json", rig("cam0"))
    (folder / "cam1.csv").unlink()


def wrong_names(folder):
    write_cameras(folder / "cameras.json", rig("left", "right"))


def other_files(folder):
    for path in folder.glob("cam?*.csv"):
        path.rename(path.with_name(path.name.replace("cam", "trial_")))


def joint_tables(folder):
    for path in folder.glob("cam?*.csv"):
        path.unlink()
    for name in ("a.csv", "b.csv"):
        write(folder / name, "frame,cam,x,y\n0,cam0,1,2\n0,cam1,1,2\n")


def two_dlts(folder):
    (folder / "cameras.json").unlink()
    write(folder / "a_dltCoefs.csv", "")
    write(folder / "b_dltCoefs.csv", "")


FAULTS = {
    "a camera without a file": (remove("cam1.csv"), "joined by name", "cam0, cam1", "cam0.csv"),
    "a file without a camera": (
        lambda folder: shutil.copy(folder / "cam0.csv", folder / "cam7.csv"),
        "joined by name",
        "cam0, cam1",
        "cam0.csv, cam1.csv, cam7.csv",
    ),
    "other names": (wrong_names, "joined by name", "left, right", "cam0.csv, cam1.csv"),
    "files of nobody": (other_files, "no tracks that belong", "column cam", "trial_0.csv"),
    "two tables": (joint_tables, "not clear", "one file", "a.csv, b.csv"),
    "no cameras": (remove("cameras.json"), "no camera file", "cameras.json", "cam0.csv"),
    "two kinds of cameras": (two_dlts, "not clear", "dltCoefs", "a_dltCoefs.csv, b_dltCoefs.csv"),
    "one camera": (one_camera, "only one camera", "two or more", "cam0"),
    "truth of another file": (
        rows("cam0_truth.csv", lambda t: t.iloc[1:]),
        "The truth does not belong",
        "rows",
        "rows",
    ),
    "another video": (
        rows("cam1.csv", lambda t: t.assign(x=3 * t.x)),
        "'cam1' do not fit into its image",
        "640×512",
        "outside",
    ),
    "frames of another clock": (
        rows("cam1.csv", lambda t: t.assign(frame=t.frame + 100)),
        "No two cameras",
        "one moment",
        "cam0: 0 to 11, cam1: 100 to 111",
    ),
    "time stamps": (
        rows("cam1.csv", lambda t: t.assign(frame=t.frame * 1_000_000)),
        "hardly numbers of images",
        "0, 1, 2",
        "to 11000000",
    ),
    "one camera with dots": (
        lambda folder: [edit(folder / f"cam1{e}.csv", lambda t: t.iloc[:0]) for e in ("", "_truth")],
        "No two cameras",
        "one moment",
        "cam1: none",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_a_folder_is_named(tmp_path, fault):
    write_folder(tmp_path)
    load_tracks(tmp_path)
    spoil, problem, expected, found = FAULTS[fault]
    spoil(tmp_path)
    error = message(load_tracks, tmp_path)
    assert problem in error.problem
    assert expected in error.expected
    assert found in error.found


def test_arguments_that_name_nothing(tmp_path):
    write_folder(tmp_path)
    assert "no such recording" in message(load_tracks, tmp_path / "nothing").problem
    assert message(load_tracks, tmp_path / "cam0.csv", tracks=[tmp_path / "cam1.csv"]).found == "a file"
    assert message(load_tracks, tmp_path, fps=0).key == "fps"
    assert message(load_tracks, tmp_path, fps=float("nan")).key == "fps"
    assert "does not exist" in message(load_tracks, tmp_path, cameras=tmp_path / "no.json").problem
    assert "does not exist" in message(load_tracks, tmp_path, tracks=[tmp_path / "cam9.csv"]).problem
    assert "does not exist" in message(load_tracks, tmp_path, truth_3d=tmp_path / "t.csv").problem
    assert "only one camera" in message(load_tracks, tmp_path, tracks=tmp_path / "cam0.csv").problem
    (tmp_path / "empty").mkdir()
    assert message(load_tracks, tmp_path / "empty").found == "nothing"
    with pytest.raises(InputError, match="no camera file"):
        load_tracks(tmp_path / "empty")


def test_files_of_the_wrong_kind(tmp_path):
    write_folder(tmp_path)
    (tmp_path / "cam0.csv").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    assert "no text" in message(load_tracks, tmp_path).problem
    (tmp_path / "cam0.csv").unlink()
    (tmp_path / "cam0.csv").mkdir()
    assert message(load_tracks, tmp_path)
    given = {"cam0": tmp_path / "cam0.csv", "cam1": tmp_path / "cam1.csv"}
    assert "folder" in message(load_tracks, tmp_path, tracks=given).problem
    (tmp_path / "cam0.csv").rmdir()
    write(tmp_path / "cam0.h5", "text")
    assert "no tracker" in message(load_tracks, tmp_path).problem


def test_dots_far_outside_are_told(tmp_path):
    write_folder(tmp_path)
    edit(tmp_path / "cam0.csv", lambda t: t.assign(y=t.y.where(t.index != 0, 5000)))
    warning = load_tracks(tmp_path).warnings[0]
    assert "1 of" in warning
    assert "5000)" in warning


# -------------------------------------------------------------------------------------------- real recordings


@needs(TRACKS)
def test_the_synthetic_sets():
    recording = load_tracks(TRACKS / "synthetic" / "code_n20_s3_hard_seed0", fps=30)
    assert recording.cameras.names == ["cam0", "cam1"]
    assert [len(view) for view in recording.views] == [11875, 11712]
    assert recording.n_frames == 600
    assert recording.warnings == ()
    raw = pd.read_csv(recording.views[0].path)
    np.testing.assert_array_equal(raw[["x", "y"]], recording.views[0].xy)
    assert 0.05 < (recording.views[0].animal == -1).mean() < 0.15
    assert set(recording.truth_3d.animal) == set(range(20))


@needs(TRACKS)
@pytest.mark.parametrize(
    ("name", "n_rows", "first", "truth"),
    [
        ("starlings_AB_true_rig", [27052, 27052], 0, True),
        ("starlings_A_thesis_rig", [9546, 10495], 2500, False),
        ("starlings_B_thesis_rig", [17506, 17506], 81500, True),
        ("thesis_synthetic", [4200, 4200], 0, False),
    ],
)
def test_one_table_of_the_starlings(name, n_rows, first, truth):
    recording = load_tracks(TRACKS / name)
    assert [len(view) for view in recording.views] == n_rows
    assert recording.first_frame == first
    assert (recording.truth_3d is not None) == truth
    for view in recording.views:
        np.testing.assert_array_equal(np.array(view.labels, dtype=int)[view.track], view.animal)


@needs(BATS)
def test_bats_are_where_their_cameras_see_them():
    recording = load_tracks(
        BATS,
        tracks=BATS / "bats_P000-15000_xypts.csv",
        truth_3d=BATS / "bats_P000-15000_xyzpts.csv",
        resolution=SIZE,
        fps=25,
    )
    truth = recording.truth_3d.set_index(["frame", "animal"])
    for view, camera in zip(recording.views, recording.cameras, strict=True):
        where = truth.reindex(list(zip(view.frame, view.animal, strict=True))).to_numpy()
        miss = np.linalg.norm(camera.project(where[:, None])[:, 0] - view.xy, axis=1)
        assert np.nanmedian(miss) < 3  # px; the other way up it would be a hundred
    assert "bats_P000-15000_xypts.csv" in message(load_tracks, BATS, resolution=SIZE).found


@needs(WAND)
def test_detections_are_joined_with_the_columns_of_the_coefficients():
    recording = load_tracks(WAND, tracks=WAND / "P00_97000_detections.csv", resolution=SIZE)
    assert [len(view) for view in recording.views] == [340, 341, 429]
    assert all((view.track == -1).all() for view in recording.views)


@needs(MOUSE)
def test_a_mouse_in_four_cameras():
    recording = load_tracks(MOUSE, camera_unit="mm", node="Nose")
    assert recording.cameras.names == ["back", "mid", "side", "top"]
    assert [view.path.name for view in recording.views] == [
        f"{n}.analysis.h5" for n in recording.cameras.names
    ]
