"""From a folder to a Sequence, and every message on the way."""

import shutil

import numpy as np
import pandas as pd
import pytest
import yaml
from data_tools_synthetic import (
    LILY,
    MARKERS,
    N_FRAMES,
    cloud,
    message,
    needs_lily,
    pixels,
    ring,
    write_acinoset,
    write_recording,
    write_scene,
)

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.calibration import write_cameras
from acino_fte.data_tools.deeplabcut import write_deeplabcut_csv
from acino_fte.data_tools.load import load_sequence
from acino_fte.data_tools.sequence_file import SequenceFile, read_sequence_file, write_sequence_file
from acino_fte.data_tools.truth import read_truth, write_truth
from acino_fte.skeleton import load_skeleton

GIVEN = {"species": "cheetah", "fps": 120.0}


def edit_table(path, edit):
    frame = pd.read_csv(path, header=[0, 1, 2], index_col=0)
    frame = edit(frame)
    frame.to_csv(path)


def edit_sequence(folder, **changes):
    path = folder / "sequence.yaml"
    data = {**yaml.safe_load(path.read_text()), **changes}
    path.write_text(yaml.safe_dump({k: v for k, v in data.items() if v is not None}, sort_keys=False))
    return folder


def rename(folder, old, new):
    for path in folder.glob("*.csv"):
        path.write_text(path.read_text().replace(f"{old},{old},{old}", f"{new},{new},{new}"))


def test_a_folder_with_a_sequence_file(tmp_path):
    folder = write_recording(tmp_path / "run")
    sequence = load_sequence(folder)
    assert (sequence.name, sequence.species, sequence.fps) == ("run", "cheetah", 120.0)
    assert sequence.markers == MARKERS
    assert sequence.cameras.names == ["cam1", "cam2", "cam3", "cam4"]
    assert sequence.warnings == ()
    assert sequence.detections.position.dims == ("frame", "camera", "marker", "space")
    np.testing.assert_allclose(sequence.detections.position.values, pixels(ring()), atol=5.1e-4)
    assert (sequence.detections.likelihood.values == 0.9).all()
    again = load_sequence(folder / "sequence.yaml")
    assert again.name == "run"
    assert again.detections.identical(sequence.detections)


def test_provenance_is_a_sequence_file_that_reads_the_same(tmp_path):
    sequence = load_sequence(write_recording(tmp_path / "run"), fps=100, frames=(5, 20))
    (tmp_path / "out").mkdir()
    write_sequence_file(tmp_path / "out" / "sequence.yaml", sequence.provenance)
    again = load_sequence(tmp_path / "out")
    assert (again.name, again.fps, list(again.frames)) == ("run", 100.0, list(range(5, 20)))
    assert again.detections.identical(sequence.detections)
    assert again.provenance == sequence.provenance


def test_arguments_override_the_file(tmp_path):
    folder = write_recording(tmp_path / "run", frames=[3, 9])
    assert list(load_sequence(folder).frames) == list(range(3, 9))
    sequence = load_sequence(folder, fps=90, frames=(None, 4), species="cheetah_acinoset")
    assert (sequence.fps, sequence.species, list(sequence.frames)) == (90.0, "cheetah_acinoset", [0, 1, 2, 3])
    assert sequence.provenance["frames"] == [0, 4]


def test_a_subset_of_cameras_in_another_order(tmp_path):
    folder = write_recording(tmp_path, keypoints={"cam3": "cam3.csv", "cam1": "cam1.csv"})
    sequence = load_sequence(folder)
    assert sequence.cameras.names == ["cam3", "cam1"]
    np.testing.assert_allclose(sequence.detections.position.values, pixels(ring())[:, [2, 0]], atol=5.1e-4)


def test_species_file_beside_the_sequence_file(tmp_path):
    folder = write_recording(tmp_path / "run", species="mine.yaml")
    shutil.copy(load_skeleton("cheetah").path, folder / "mine.yaml")
    assert load_sequence(folder).species == str((folder / "mine.yaml").resolve())


def test_sequence_file_round_trip(tmp_path):
    content = SequenceFile(
        name="ü", species="dog", fps=60.0, cameras="c.toml", camera_unit="mm", keypoints={"1": "a.h5"}
    )
    write_sequence_file(tmp_path / "sequence.yaml", content)
    assert read_sequence_file(tmp_path / "sequence.yaml") == content.at(tmp_path.resolve())


@pytest.mark.parametrize(
    ("changes", "key", "text"),
    [
        ({"format": "other/1"}, "format", "acino-fte/sequence/1"),
        ({"specis": "dog"}, "specis", "did you mean 'species'"),
        ({"cameras": None}, "cameras", "missing"),
        ({"fps": -1}, "fps", "greater than 0"),
        ({"fps": "fast"}, "fps", "number"),
        ({"frames": [9, 3]}, "frames", "start < stop"),
        ({"keypoints": {}}, "keypoints", "at least 1"),
        ({"keypoints": {"cam1": "a.csv", "cam2": "a.csv"}}, "keypoints", "the same file 'a.csv'"),
        ({"camera_unit": "inch"}, "camera_unit", "'mm'"),
        ({"keypoints": {"cam9": "cam1.csv"}}, "keypoints.cam9", "did you mean 'cam"),
    ],
)
def test_faulty_sequence_file(tmp_path, changes, key, text):
    error = message(load_sequence, edit_sequence(write_recording(tmp_path), **changes))
    assert error.file.endswith("sequence.yaml")
    assert error.key == key
    assert text in str(error)
    assert error.remedy


def test_writer_refuses_what_the_reader_would_refuse(tmp_path):
    assert message(write_sequence_file, tmp_path / "s.yaml", {"cameras": "c", "keypoints": {"a": 3}}).key


def test_missing_files(tmp_path):
    assert "does not exist" in str(message(load_sequence, tmp_path / "none"))
    folder = write_recording(tmp_path / "run")
    (folder / "cam2.csv").unlink()
    error = message(load_sequence, folder)
    assert error.file.endswith("cam2.csv")
    (folder / "cameras.json").unlink()
    assert message(load_sequence, folder).file.endswith("cameras.json")


def test_what_is_no_recording(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    error = message(load_sequence, tmp_path)
    assert "notes.txt" in error.found
    assert "sequence.yaml" in error.remedy
    assert "a folder or a sequence file" in str(message(load_sequence, tmp_path / "notes.txt"))


def test_species_and_frame_rate_are_never_guessed(tmp_path):
    folder = write_recording(tmp_path, species=None, fps=None)
    assert "--species" in message(load_sequence, folder).remedy
    assert "--fps" in message(load_sequence, folder, species="cheetah").remedy
    for fps in (0.0, -5.0, float("nan")):
        error = message(load_sequence, folder, species="cheetah", fps=fps)
        assert error.key == "fps"
    assert "did you mean 'cheetah'" in str(message(load_sequence, folder, species="cheeta", fps=1))


@pytest.mark.parametrize("frames", [(0, N_FRAMES + 1), (5, 5), (-1, 4), (N_FRAMES, None)])
def test_frames_outside(tmp_path, frames):
    error = message(load_sequence, write_recording(tmp_path), frames=frames)
    assert error.key == "frames"
    assert str(N_FRAMES) in error.expected


def test_frames_without_a_detection(tmp_path):
    folder = write_recording(tmp_path)
    for path in folder.glob("*.csv"):
        edit_table(path, lambda frame: frame[frame.index > 9])
    assert "Nothing was detected" in str(message(load_sequence, folder, frames=(0, 10)))
    assert load_sequence(folder).n_frames == N_FRAMES


def test_keypoints_that_the_species_lacks_are_left_out_with_a_warning(tmp_path):
    folder = write_recording(tmp_path)
    rename(folder, "nose", "lure")
    rename(folder, "tail_base", "tail_bass")
    sequence = load_sequence(folder)
    assert "nose" not in sequence.markers
    assert len(sequence.markers) == len(MARKERS) - 2
    left, free = sequence.warnings
    assert "'lure'" in left
    assert "'tail_bass'; did you mean 'tail_base'?" in left
    assert "nose, tail_base" in free or "tail_base, nose" in free


def test_a_marker_that_one_file_lacks(tmp_path):
    folder = write_recording(tmp_path)
    text = (folder / "cam2.csv").read_text().replace("nose,nose,nose", "x1,x1,x1")
    (folder / "cam2.csv").write_text(text)
    sequence = load_sequence(folder)
    nose = sequence.detections.position.sel(marker="nose")
    assert np.isnan(nose.sel(camera="cam2")).all()
    assert np.isfinite(nose.sel(camera="cam1")).all()
    assert any("'cam2' lacks nose" in w for w in sequence.warnings)


def test_a_species_that_most_keypoints_do_not_belong_to(tmp_path):
    warnings = load_sequence(write_recording(tmp_path), species="human").warnings
    assert any("is it the right one?" in w for w in warnings)
    assert not any("did you mean" in w for w in warnings)


def test_no_marker_at_all_lists_near_misses(tmp_path):
    folder = write_recording(tmp_path, names=[f"{m}xx" for m in MARKERS])
    error = message(load_sequence, folder)
    assert error.file.endswith("cam1.csv")
    assert "'nosexx'; did you mean 'nose'?" in error.found
    assert "aliases" in error.remedy


def test_two_keypoints_for_one_marker(tmp_path):
    names = ["NOSE" if m == "tail1" else m for m in MARKERS]
    error = message(load_sequence, write_recording(tmp_path, names=names))
    assert "'nose'" in error.found
    assert "'NOSE'" in error.found


def test_a_video_that_ends_a_little_early_is_filled_up(tmp_path):
    folder = write_recording(tmp_path)
    edit_table(folder / "cam3.csv", lambda frame: frame.iloc[:-2])
    sequence = load_sequence(folder)
    assert np.isnan(sequence.detections.position.values[-2:, 2]).all()
    assert any("cam3: 38" in w for w in sequence.warnings)


def test_a_video_that_ends_much_earlier_is_refused(tmp_path):
    folder = write_recording(tmp_path)
    edit_table(folder / "cam3.csv", lambda frame: frame.iloc[:-5])
    error = message(load_sequence, folder)
    assert error.file.endswith("cam3.csv")
    assert "cam3: 35" in error.found
    assert "same start" in error.remedy


def test_nan_everywhere(tmp_path):
    folder = write_recording(tmp_path)
    for path in folder.glob("*.csv"):
        edit_table(path, lambda frame: frame * np.nan)
    assert "not one detection" in str(message(load_sequence, folder))


def test_a_camera_that_sees_nothing(tmp_path):
    folder = write_recording(tmp_path)
    edit_table(folder / "cam2.csv", lambda frame: frame * np.nan)
    assert load_sequence(folder).warnings == ("Camera 'cam2' has no detection with a likelihood above 0.5.",)


def test_detections_of_another_resolution(tmp_path):
    folder = write_recording(tmp_path)
    columns = pd.IndexSlice[:, :, ["x", "y"]]

    def double(frame):
        frame.loc[:, columns] *= 2
        return frame

    edit_table(folder / "cam2.csv", double)
    error = message(load_sequence, folder)
    assert error.file.endswith("cam2.csv")
    assert "1920×1080" in error.expected
    assert "outside" in error.found
    assert "'cam2'" in error.problem


def test_moving_cameras_need_a_pose_per_frame(tmp_path):
    folder = write_recording(tmp_path)
    still = list(ring())
    for n, works in ((N_FRAMES, True), (N_FRAMES - 1, False)):
        moving = Camera(
            "cam2",
            still[1].model,
            still[1].matrix,
            still[1].distortion,
            np.repeat(still[1].rotation[None], n, 0),
            np.repeat(still[1].translation[None], n, 0),
            still[1].resolution,
        )
        write_cameras(folder / "cameras.json", CameraArray((still[0], moving, *still[2:])))
        if works:
            sequence = load_sequence(folder, frames=(3, 9))
            assert sequence.cameras["cam2"].rotation.shape == (6, 3, 3)
            assert sequence.warnings == ()
        else:
            error = message(load_sequence, folder)
            assert error.key == "cam2.rotation"
            assert error.file.endswith("cameras.json")


def test_truth(tmp_path):
    folder = write_recording(tmp_path, truth="truth.csv")
    points = cloud()
    points[4, 2] = np.nan
    write_truth(folder / "truth.csv", MARKERS, points, decimals=6)
    sequence = load_sequence(folder, frames=(2, 8))
    assert sequence.truth.dims == ("frame", "marker", "space")
    assert list(sequence.truth.frame) == list(range(2, 8))
    np.testing.assert_allclose(sequence.truth.values, points[2:8], atol=5.1e-7)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("frame,marker,x,y\n0,nose,1,2\n", "lacks a column"),
        ("frame,marker,x,y,z\n0,nose,1,2,oops\n", "cannot be read"),
        ("", "cannot be read"),
        ("frame,marker,x,y,z\n0,ear,1,2,3\n", "no row for a marker"),
        ("frame,marker,x,y,z\n99,nose,1,2,3\n", "no row for a marker"),
        ("frame,marker,x,y,z\n0,nose,1,2,3\n0,nose,1,2,3\n", "twice in frame 0"),
    ],
)
def test_faulty_truth(tmp_path, text, problem):
    (tmp_path / "truth.csv").write_text(text)
    error = message(read_truth, tmp_path / "truth.csv", load_skeleton("cheetah"), 9)
    assert problem in error.problem
    assert error.file.endswith("truth.csv")
    assert "does not exist" in str(message(read_truth, tmp_path / "t.csv", load_skeleton("cheetah"), 9))


def test_acinoset_folder(tmp_path):
    run = write_acinoset(tmp_path)
    sequence = load_sequence(run, **GIVEN)
    assert sequence.name == "run1"
    assert sequence.warnings == ()
    np.testing.assert_allclose(sequence.detections.position.values, pixels(ring()), atol=5.1e-4)
    assert sequence.provenance["cameras"].endswith("4_cam_scene_sba.json")
    assert "--fps" in message(load_sequence, run, species="cheetah").remedy


def test_acinoset_prefers_the_nearest_calibration_and_the_fitting_one(tmp_path):
    run = write_acinoset(tmp_path)
    write_scene(tmp_path / "lily" / "extrinsic_calib" / "4_cam_scene_sba.json", ring())
    write_scene(tmp_path / "lily" / "extrinsic_calib" / "6_cam_scene_sba.json", ring(6))
    assert "lily/extrinsic_calib/4_cam" in load_sequence(run, **GIVEN).provenance["cameras"].replace(
        "\\", "/"
    )
    (tmp_path / "lily" / "extrinsic_calib" / "4_cam_scene_sba.json").rename(
        tmp_path / "lily" / "extrinsic_calib" / "5_cam_scene_sba.json"
    )
    assert "several calibrations" in str(message(load_sequence, run, **GIVEN))


def test_acinoset_without_calibration(tmp_path):
    run = write_acinoset(tmp_path)
    shutil.rmtree(tmp_path / "extrinsic_calib")
    error = message(load_sequence, run, **GIVEN)
    assert "extrinsic_calib" in error.expected
    assert "sequence.yaml" in error.remedy


@pytest.mark.parametrize(("n_files", "n_cameras"), [(3, 4), (4, 3)])
def test_acinoset_scene_with_another_number_of_cameras(tmp_path, n_files, n_cameras):
    error = message(load_sequence, write_acinoset(tmp_path, n_files, n_cameras), **GIVEN)
    assert f"has {n_cameras} cameras, but there are keypoint files of {n_files}" in error.problem
    assert "cam1DLC_net.csv" in error.expected
    assert "sequence.yaml" in error.remedy


def test_acinoset_files_are_paired_by_name(tmp_path):
    run = write_acinoset(tmp_path)
    (run / "dlc" / "cam2DLC_net.csv").rename(run / "dlc" / "cam5DLC_net.csv")
    assert "no camera 'cam5'" in str(message(load_sequence, run, **GIVEN))


def test_acinoset_with_two_files_for_a_camera(tmp_path):
    run = write_acinoset(tmp_path)
    shutil.copy(run / "dlc" / "cam2DLC_net.csv", run / "dlc" / "cam2DLC_net_filtered.csv")
    assert "cam2DLC_net_filtered.csv" in message(load_sequence, run, **GIVEN).found
    (run / "dlc" / "cam2DLC_net.h5").write_text("not hdf5, but H5 goes first")
    assert message(load_sequence, run, **GIVEN).file.endswith("cam2DLC_net.h5")


def test_nothing_is_written_to_the_input(tmp_path):
    run = write_acinoset(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    load_sequence(run, **GIVEN)
    assert sorted(tmp_path.rglob("*")) == before


@needs_lily
def test_lily():
    sequence = load_sequence(LILY, **GIVEN, frames=(80, 190))
    assert sequence.detections.sizes == {"frame": 110, "camera": 6, "marker": 24, "space": 2}
    assert sequence.cameras.names == [f"cam{i}" for i in range(1, 7)]
    assert len(sequence.warnings) == 1
    assert "'lure'" in sequence.warnings[0]


@needs_lily
def test_lily_with_a_mix_of_h5_and_csv(tmp_path):
    shutil.copytree(LILY / "dlc", tmp_path / "dlc")
    shutil.copytree(LILY / "extrinsic_calib", tmp_path / "extrinsic_calib")
    for path in (LILY / "dlc_h5").glob("*.h5"):
        shutil.copy(path, tmp_path / "dlc")
    mixed = load_sequence(tmp_path, **GIVEN)
    assert mixed.provenance["keypoints"]["cam1"].endswith(".h5")
    assert mixed.detections.identical(load_sequence(LILY, **GIVEN).detections)


def test_a_dlc_file_of_many_frames_is_read_fast(tmp_path):
    from time import perf_counter

    from acino_fte.data_tools.deeplabcut import read_deeplabcut

    position = np.random.default_rng(0).uniform(0, 1000, (5000, 24, 2))
    write_deeplabcut_csv(tmp_path / "a.csv", MARKERS, position, np.ones((5000, 24)))
    start = perf_counter()
    read_deeplabcut(tmp_path / "a.csv")
    assert perf_counter() - start < 2.0
