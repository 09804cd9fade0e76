"""The check that keypoint files belong to their cameras."""

from dataclasses import replace
from itertools import combinations
from time import perf_counter

import numpy as np
import pytest
import xarray as xr
from data_tools_synthetic import LILY, cloud, needs_lily, pixels, ring, write_recording
from scipy.spatial.transform import Rotation

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.load import load_sequence
from acino_fte.data_tools.pairing import check_pairing


def dataset(position):
    return xr.Dataset(
        {
            "position": (("frame", "camera", "marker", "space"), position),
            "likelihood": (("frame", "camera", "marker"), np.where(np.isfinite(position[..., 0]), 0.9, 0.0)),
        }
    )


def swapped(detections, a, b):
    order = list(range(detections.sizes["camera"]))
    order[a], order[b] = b, a
    return detections.isel(camera=order)


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
@pytest.mark.parametrize("n_cameras", [2, 3, 4, 6, 8])
def test_swapped_files_are_named(n_cameras, model):
    cameras = ring(n_cameras, model)
    detections = dataset(pixels(cameras, noise=4.0))
    assert check_pairing(detections, cameras) == []
    for a, b in list(combinations(range(n_cameras), 2))[::4]:
        (warning,) = check_pairing(swapped(detections, a, b), cameras)
        assert f"'cam{a + 1}' and 'cam{b + 1}' look swapped" in warning


def test_gross_outliers_and_missing_points_do_no_harm():
    cameras = ring(6)
    rng = np.random.default_rng(5)
    position = pixels(cameras, noise=3.0)
    wild = rng.random(position.shape[:-1]) < 0.15
    position[wild] = rng.uniform(0, 1000, (wild.sum(), 2))
    position[rng.random(position.shape[:-1]) < 0.4] = np.nan
    assert check_pairing(dataset(position), cameras) == []
    assert "'cam2' and 'cam5'" in check_pairing(swapped(dataset(position), 1, 4), cameras)[0]


def test_three_files_in_a_circle():
    cameras = ring(5)
    (warning,) = check_pairing(dataset(pixels(cameras)).isel(camera=[1, 3, 2, 0, 4]), cameras)
    assert "'cam1' the file given to 'cam4'" in warning
    assert "'cam2' the file given to 'cam1'" in warning
    assert "'cam4' the file given to 'cam2'" in warning


def test_a_camera_that_was_knocked_is_named():
    cameras = ring(5)
    detections = dataset(pixels(cameras))
    turn = Rotation.from_rotvec([0.06, 0.0, 0.0]).as_matrix()
    knocked = replace(
        cameras[2], rotation=turn @ cameras[2].rotation, translation=turn @ cameras[2].translation
    )
    bent = CameraArray((*cameras[:2], knocked, *cameras[3:]))
    (warning,) = check_pairing(detections, bent)
    assert warning.startswith("Camera 'cam3' does not fit the others")
    assert "the other cameras agree to 1 px" in warning or "agree to 2 px" in warning


def test_moving_cameras():
    still = ring(4)
    n = len(cloud())
    drift = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.0, 0.15, 0.02], n)).as_matrix()
    shift = np.linspace([0, 0, 0], [0.5, 0, 0.2], n)
    moving = [
        replace(c, rotation=drift @ c.rotation, translation=drift @ c.translation + shift) for c in still[:3]
    ]
    cameras = CameraArray((*moving, still[3]))
    detections = dataset(pixels(cameras))
    assert check_pairing(detections, cameras) == []
    assert "'cam1' and 'cam3'" in check_pairing(swapped(detections, 0, 2), cameras)[0]
    assert "'cam2' and 'cam4'" in check_pairing(swapped(detections, 1, 3), cameras)[0]


def test_one_camera_or_no_shared_point():
    cameras = ring(2)
    position = pixels(cameras)
    assert check_pairing(dataset(position[:, :1]), CameraArray(cameras[:1])) == []
    position[:20, 0] = np.nan
    position[20:, 1] = np.nan
    assert "could not be checked" in check_pairing(dataset(position), cameras)[0]


def test_cameras_with_the_very_same_pose(tmp_path):
    from acino_fte.data_tools.calibration import write_cameras

    folder = write_recording(tmp_path, n_cameras=4)
    cameras = ring(4)
    copy = replace(cameras[3], rotation=cameras[0].rotation, translation=cameras[0].translation)
    write_cameras(folder / "cameras.json", CameraArray((*cameras[:3], copy)))
    warnings = load_sequence(folder).warnings
    assert any("'cam1' and 'cam4' have the very same position" in w for w in warnings)


def test_the_warning_reaches_the_sequence(tmp_path):
    keypoints = {"cam1": "cam1.csv", "cam2": "cam4.csv", "cam3": "cam3.csv", "cam4": "cam2.csv"}
    (warning,) = load_sequence(write_recording(tmp_path, keypoints=keypoints)).warnings
    assert "'cam2' and 'cam4' look swapped" in warning


@needs_lily
def test_lily_is_paired_rightly_and_exchanges_are_seen():
    sequence = load_sequence(LILY, species="cheetah", fps=120)
    start = perf_counter()
    assert check_pairing(sequence.detections, sequence.cameras) == []
    assert perf_counter() - start < 0.15
    for a, b in [(0, 1), (0, 2), (1, 2), (1, 3), (2, 5), (3, 4), (4, 5)]:  # among them the least visible
        (warning,) = check_pairing(swapped(sequence.detections, a, b), sequence.cameras)
        assert f"'cam{a + 1}' and 'cam{b + 1}' look swapped" in warning


@needs_lily
def test_lily_with_fewer_cameras():
    sequence = load_sequence(LILY, species="cheetah", fps=120)
    for chosen in combinations(range(6), 3):
        cameras = CameraArray(tuple(sequence.cameras[c] for c in chosen))
        assert check_pairing(sequence.detections.isel(camera=list(chosen)), cameras) == []
