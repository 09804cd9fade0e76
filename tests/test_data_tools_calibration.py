"""Camera files: three kinds in, one out, and what is wrong with them."""

import json

import numpy as np
import pytest
from data_tools_synthetic import LILY, message, needs_lily, ring, write_scene
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.calibration import read_cameras, write_cameras


def same(a, b, tolerance=0.0):
    assert a.names == b.names
    for one, other in zip(a, b, strict=True):
        assert (one.model, one.resolution) == (other.model, other.resolution)
        for key in ("matrix", "distortion", "rotation", "translation"):
            np.testing.assert_allclose(getattr(one, key), getattr(other, key), rtol=0, atol=tolerance)


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_own_file_round_trip(tmp_path, model):
    cameras = ring(3, model)
    write_cameras(tmp_path / "cameras.json", cameras)
    same(read_cameras(tmp_path / "cameras.json"), cameras)


def test_own_file_round_trip_of_moving_cameras(tmp_path):
    still = ring(2)[0]
    rotation = Rotation.from_rotvec(np.linspace([0, 0, 0], [0, 0.4, 0.1], 5)).as_matrix() @ still.rotation
    translation = np.linspace([0, 0, 1], [1, 0, 1.0], 5)
    moving = Camera("m", "pinhole", still.matrix, [], rotation, translation, (640, 480))
    write_cameras(tmp_path / "c.json", CameraArray((moving,)))
    read = read_cameras(tmp_path / "c.json")
    assert read[0].moves
    same(read, CameraArray((moving,)))


def test_scene_names_cameras_by_position_or_by_name(tmp_path):
    path = tmp_path / "s.json"
    write_scene(path, ring(3))
    same(read_cameras(path), ring(3))
    scene = json.loads(path.read_text())
    scene["cameras"][1]["name"] = "left"
    path.write_text(json.dumps(scene))
    assert read_cameras(path).names == ["cam1", "left", "cam3"]


@needs_lily
def test_scene_of_lily():
    cameras = read_cameras(LILY / "extrinsic_calib" / "6_cam_scene_sba.json")
    assert cameras.names == [f"cam{i}" for i in range(1, 7)]
    assert all(c.model == "fisheye" and c.resolution == (2704, 1520) for c in cameras)


def anipose(cameras, scale=1.0):
    text = ""
    for i, c in enumerate(cameras):
        vector = Rotation.from_matrix(c.rotation).as_rotvec().tolist()
        fisheye = str(c.model == "fisheye").lower()
        text += (
            f"[cam_{i}]\nname = '{c.name}'\nsize = [1920, 1080]\nmatrix = {c.matrix.tolist()}\n"
            f"distortions = {c.distortion.tolist()}\nrotation = {vector}\n"
            f"translation = {(c.translation * scale).tolist()}\nfisheye = {fisheye}\n\n"
        )
    return text + "[metadata]\nadjusted = false\nerror = 0.4\n"


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_anipose_toml(tmp_path, model):
    cameras = ring(3, model)
    (tmp_path / "c.toml").write_text(anipose(cameras, 1000.0))
    same(read_cameras(tmp_path / "c.toml", unit="mm"), cameras, 1e-12)


def change(tmp_path, edit, own=False):
    path = tmp_path / "scene.json"
    if own:
        write_cameras(path, ring(3))
    else:
        write_scene(path, ring(3))
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))
    return message(read_cameras, path)


def put(*keys, value):
    def edit(data):
        for key in keys[:-1]:
            data = data[key]
        data[keys[-1]] = value

    return edit


def remove(*keys):
    def edit(data):
        for key in keys[:-1]:
            data = data[key]
        del data[keys[-1]]

    return edit


MIRROR = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]
FAULTS = {
    "not orthonormal": (False, put("cameras", 1, "r", 0, 0, value=2.0), "cameras.1.rotation", "orthonormal"),
    "mirrored": (False, put("cameras", 1, "r", value=MIRROR), "cameras.1.rotation", "determinant"),
    "rotation shape": (False, put("cameras", 0, "r", value=[[1, 0], [0, 1]]), "cameras.0.rotation", "(3, 3)"),
    "NaN": (False, put("cameras", 2, "t", 0, value=[float("nan")]), "cameras.2.translation", "finite"),
    "text": (False, put("cameras", 2, "t", 0, value="a"), "cameras.2.translation", "numbers"),
    "ragged": (False, put("cameras", 2, "k", value=[[1, 2], [3]]), "cameras.2.matrix", "equal length"),
    "no focal length": (False, put("cameras", 0, "k", 0, 0, value=0), "cameras.0.camera matrix", "positive"),
    "skew": (False, put("cameras", 0, "k", 0, 1, value=9.0), "cameras.0.camera matrix", "skew"),
    "5 for fisheye": (False, put("cameras", 0, "d", value=[0] * 5), "cameras.0.distortion", "4 coefficients"),
    "missing key": (False, remove("cameras", 1, "d"), "cameras.1.d", "missing"),
    "no resolution": (False, remove("camera_resolution"), "camera_resolution", "missing"),
    "zero resolution": (False, put("camera_resolution", value=[0, 9]), "cameras.0.resolution", "px"),
    "no cameras": (False, put("cameras", value=[]), "cameras", "at least 1"),
    "same name": (False, put("cameras", 1, "name", value="cam1"), "cameras", "one name"),
    "unknown key": (True, put("cameras", 1, "modle", value="x"), "cameras.1.modle", "did you mean 'model'"),
    "unknown model": (True, put("cameras", 1, "model", value="fish"), "cameras.1.model", "pinhole"),
    "other format": (True, put("format", value="x/2"), "format", "acino-fte/cameras/1"),
    "one camera": (False, remove("cameras"), None, "camera_resolution"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faulty_json(tmp_path, case):
    own, edit, key, text = FAULTS[case]
    error = change(tmp_path, edit, own)
    assert error.file.endswith("scene.json")
    assert error.key == key
    assert text in str(error)
    assert error.remedy


def test_unreadable_files(tmp_path):
    assert "does not exist" in str(message(read_cameras, tmp_path / "none.json"))
    for name, text in (("a.json", "{"), ("a.toml", "= 3")):
        (tmp_path / name).write_text(text)
        error = message(read_cameras, tmp_path / name)
        assert error.file.endswith(name)
        assert "line" in error.found
    (tmp_path / "b.json").write_text("[1]")
    assert "no camera file" in str(message(read_cameras, tmp_path / "b.json"))
    (tmp_path / "b.toml").write_text("[metadata]\na = 1\n")
    assert "has no camera" in str(message(read_cameras, tmp_path / "b.toml"))
    (tmp_path / "c.toml").write_text(anipose(ring(2)).replace("distortions", "distortion"))
    assert message(read_cameras, tmp_path / "c.toml").key == "cam_0.distortions"
