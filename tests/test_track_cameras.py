"""Reading cameras for the matching of 2D tracks: every kind of file, and every way to get it wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import look_at
from scipy.spatial.transform import Rotation

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.calibration import write_cameras
from acino_fte.data_tools.dlt import read_dlt
from acino_fte.data_tools.projective_camera import ProjectiveCamera, projection_matrix
from acino_fte.data_tools.track_cameras import read_track_cameras
from acino_fte.data_tools.vicon import read_xcp
from acino_fte.errors import InputError

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SIZE = (640, 512)
RADIAL = {"center": [641.0, 359.0], "k": [2e-7, 1e-14, 0.0]}


def two():
    places = [(3.0, -2.0, 1.5), (2.0, 3.0, 1.0)]
    return CameraArray(
        tuple(look_at(f"cam{i}", p, (0.0, 0.0, 0.2), distortion=()) for i, p in enumerate(places))
    )


def points(n=20):
    return np.random.default_rng(0).uniform(-0.5, 0.5, (n, 3))


def entry(index=0, **changes) -> dict:
    camera = two()[index]
    content = {
        "id": str(index),
        "K": camera.matrix.tolist(),
        "R": camera.rotation.tolist(),
        "t": camera.translation.tolist(),
        "dist_opencv": [0.0] * 5,
        "image_size": list(camera.resolution),
        "model": "anything",
    }
    content.update(changes)
    return {key: value for key, value in content.items() if value is not ...}


def write(path, content) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def refused(read, *words) -> InputError:
    """The one error, which names the file and has a remedy."""
    with pytest.raises(InputError) as caught:
        read()
    error = caught.value
    assert error.file and error.problem.endswith((".", "?"))
    for word in words:
        assert word in str(error), f"{word!r} is not in:\n{error}"
    return error


# scenes


@pytest.mark.parametrize("wrap", [lambda e: e, lambda e: {"cameras": e, "note": "x"}])
def test_scene(tmp_path, wrap):
    path = write(
        tmp_path / "cameras.json", wrap([entry(0), entry(1, id="left", dist_opencv=[0.1, 0, 0, 0, 0])])
    )
    cameras = read_track_cameras(path)
    assert cameras.names == ["cam0", "left"]
    wanted = two()
    for got, exact in zip(cameras, wanted, strict=True):
        np.testing.assert_allclose(got.matrix, exact.matrix)
        np.testing.assert_allclose(got.rotation, exact.rotation)
        np.testing.assert_allclose(got.translation, exact.translation)
        assert got.resolution == (1280, 720)
    assert cameras["left"].distortion.tolist() == [0.1, 0, 0, 0, 0]
    assert read_track_cameras(path, only=["left", "cam0"]).names == ["left", "cam0"]
    millimetres = read_track_cameras(path, unit="mm")
    np.testing.assert_allclose(millimetres["cam0"].translation, wanted[0].translation / 1000)


def test_scene_ids_may_be_numbers_and_distortion_may_be_absent(tmp_path):
    path = write(tmp_path / "c.json", [entry(0, id=7, dist_opencv=...), entry(1, id="2123022")])
    assert read_track_cameras(path).names == ["cam7", "cam2123022"]


def test_vicon_lens_of_a_scene_is_used_only_when_told(tmp_path):
    entries = [entry(0, vicon_radial2=RADIAL), entry(1, vicon_radial2=RADIAL, apply_vicon_radial2=True)]
    plain, bent = read_track_cameras(write(tmp_path / "c.json", entries))
    exact = two()
    np.testing.assert_allclose(plain.project(points()), exact[0].project(points()))
    assert isinstance(bent, ProjectiveCamera)
    assert np.abs(bent.project(points()) - exact[1].project(points())).max() > 0.1
    np.testing.assert_allclose(
        bent.undistort(bent.project(points())), exact[1].undistort(exact[1].project(points()))
    )


def test_scene_with_skew(tmp_path):
    matrix = two()[0].matrix + np.array([[0, 5.0, 0], [0, 0, 0], [0, 0, 0]])
    camera = read_track_cameras(write(tmp_path / "c.json", [entry(0, K=matrix.tolist())]))[0]
    np.testing.assert_allclose(camera.matrix, matrix)
    np.testing.assert_allclose(camera.project(points())[:, 1], two()[0].project(points())[:, 1])


SCENE_FAULTS = [
    ("[", ["cannot be read"]),
    ([], ["no camera"]),
    ([3], ["fault"]),
    ([entry(K=...)], ["0.K"]),
    ([entry(image_size=...)], ["0.image_size"]),
    ([entry(id=...)], ["0.id"]),
    ([entry(), entry(1, id="0")], ["one name"]),
    ([entry(K="wide")], ["0.K", "no array of numbers"]),
    ([entry(K=[[1, 0], [0, 1]])], ["0.K", "shape (3, 3)"]),
    ([entry(K=[[0, 0, 1], [0, 0, 1], [0, 0, 1]])], ["0.K", "focal"]),
    ([entry(t=[0.0, float("nan"), 1.0])], ["0.t", "NaN"]),
    ([entry(t=[0.0, 1.0])], ["0.t", "shape (3,)"]),
    ([entry(R=[[1, 0, 0], [0, 1, 0], [0, 0, 2]])], ["0.R", "orthonormal"]),
    ([entry(dist_opencv=[0.1, 0.2])], ["0.dist_opencv", "coefficients"]),
    ([entry(image_size=[0, 720])], ["0.image_size", "0×720"]),
    ([entry(apply_vicon_radial2=True)], ["0.vicon_radial2", "nothing"]),
    ([entry(apply_vicon_radial2=True, vicon_radial2={"center": [1, 2], "k": "x"})], ["0.vicon_radial2"]),
    (
        [entry(apply_vicon_radial2=True, vicon_radial2={"center": [1], "k": [1, 2, 3]})],
        ["0.centre", "2 finite"],
    ),
    (
        [entry(apply_vicon_radial2=True, vicon_radial2=RADIAL, dist_opencv=[0.1] * 5)],
        ["0.dist_opencv", "zeros"],
    ),
    ({"cameras": [entry(), entry(1, R=...)]}, ["cameras.1.R"]),
    ({"frames": 3}, ["no camera file of a known kind"]),
]


@pytest.mark.parametrize("content, words", SCENE_FAULTS)
def test_faults_of_a_scene(tmp_path, content, words):
    path = write(tmp_path / "cameras.json", content)
    refused(lambda: read_track_cameras(path), str(path), *words)


def test_other_camera_files_are_read_as_ever(tmp_path):
    path = tmp_path / "cameras.json"
    write_cameras(path, two())
    assert read_track_cameras(path).names == ["cam0", "cam1"]
    toml = '[cam_0]\nname = "A"\nsize = [640, 480]\nmatrix = [[600.0, 0, 320], [0, 600.0, 240], [0, 0, 1]]\n'
    toml += (
        "distortions = [0.0, 0.0, 0.0, 0.0, 0.0]\nrotation = [0.1, 0.2, 0.3]\ntranslation = [1.0, 2.0, 3.0]\n"
    )
    assert read_track_cameras(write(tmp_path / "calibration.toml", toml)).names == ["A"]


def test_no_file_no_kind_no_such_camera(tmp_path):
    refused(lambda: read_track_cameras(tmp_path / "cameras.json"), "does not exist")
    refused(lambda: read_track_cameras(tmp_path), "a folder")
    refused(lambda: read_track_cameras(write(tmp_path / "cameras.mat", "x")), "ending", ".mat", ".xcp")
    scene = write(tmp_path / "c.json", [entry(0), entry(1)])
    refused(lambda: read_track_cameras(scene, only=["cam2"]), "cam2", "cam0, cam1")
    refused(lambda: read_track_cameras(scene, only=["cam1", "cam1"]), "one name")


# DLT


def dlt_table(height=SIZE[1]) -> np.ndarray:
    """(11, 2) coefficients of the two cameras, y up."""
    columns = []
    for camera in two():
        matrix = np.array([[1, 0, 0], [0, -1, height], [0, 0, 1.0]]) @ projection_matrix(camera)
        columns.append((matrix / matrix[2, 3]).ravel()[:11])
    return np.array(columns).T


def dlt_text(table=None, between=",") -> str:
    rows = dlt_table() if table is None else table
    return "\n".join(between.join(repr(float(v)) for v in row) for row in rows) + "\n"


@pytest.mark.parametrize("between", [",", ";", "\t", " , "])
def test_dlt(tmp_path, between):
    path = write(tmp_path / "dltCoefs.csv", "\ufeff" + dlt_text(between=between) + "\n")
    cameras = read_track_cameras(path, resolution=SIZE)
    assert cameras.names == ["cam1", "cam2"]
    for got, exact in zip(cameras, two(), strict=True):
        assert got.resolution == SIZE
        np.testing.assert_allclose(got.project(points()), exact.project(points()), atol=1e-6)


def test_dlt_sizes(tmp_path):
    path = write(tmp_path / "dlt.csv", dlt_text())
    one = read_dlt(path, resolution=[(640, 512), (320, 240)])
    assert [c.resolution for c in one] == [(640, 512), (320, 240)]
    up = SIZE[1] - one[0].project(points())[:, 1]
    np.testing.assert_allclose(
        read_dlt(path, resolution=SIZE, image_height=700)[0].project(points())[:, 1], 700 - up
    )
    profile = write(tmp_path / "profile.txt", "1 526 640 512 320 256 1 -0.3 0.1 0 0 0\n" * 2)
    assert [c.resolution for c in read_track_cameras(path, profile=profile)] == [SIZE, SIZE]
    centimetres = read_dlt(path, resolution=SIZE, unit="cm")
    np.testing.assert_allclose(centimetres[0].centre, two()[0].centre / 100, atol=1e-9)


TABLE = dlt_table()
DLT_FAULTS = [
    (dlt_text(TABLE[:10]), {}, ["10 rows of 2 columns", "11 rows"]),
    (dlt_text(TABLE.T), {}, ["2 rows of 11 columns", "transpose"]),
    (dlt_text().replace("\n", ",1\n", 1), {}, ["2 or 3 columns"]),
    ("", {}, ["0 rows"]),
    ("cam1,cam2\n" + dlt_text(), {}, ["line 1", "'cam1'"]),
    (dlt_text(TABLE * np.nan), {}, ["line 1", "'nan'"]),
    (dlt_text(np.zeros((11, 2))), {}, ["column 1", "no centre"]),
    (dlt_text(), {"resolution": None}, ["read_dlt(path, resolution=(width, height))", "found:    none"]),
    (dlt_text(), {"resolution": None, "image_height": 512}, ["no width"]),
    (dlt_text(), {"resolution": (640, 0)}, ["resolution", "(640, 0)"]),
    (dlt_text(), {"resolution": [(640, 512)] * 3}, ["each of the 2"]),
    (dlt_text(), {"resolution": 640}, ["resolution"]),
]


@pytest.mark.parametrize("content, options, words", DLT_FAULTS)
def test_faults_of_dlt_coefficients(tmp_path, content, options, words):
    path = write(tmp_path / "dltCoefs.csv", content)
    refused(lambda: read_track_cameras(path, **{"resolution": SIZE, **options}), str(path), *words)


@pytest.mark.parametrize(
    "content, words",
    [
        ("1 526 640 512 320 256\n", ["2 lines"]),
        ("1 526 640\n2 526 640\n", ["at least 6 numbers"]),
        ("1 526 640 320 320 256\n" * 2, ["contradicts itself", "(320, 256)", "image_height"]),
        ("1 f 640 320 320 256\n" * 2, ["line 1", "'f'"]),
    ],
)
def test_faults_of_a_camera_profile(tmp_path, content, words):
    path = write(tmp_path / "dlt.csv", dlt_text())
    profile = write(tmp_path / "profile.txt", content)
    refused(lambda: read_dlt(path, profile=profile), str(profile), *words)


def test_the_height_of_a_wrong_profile_can_be_mended(tmp_path):
    path = write(tmp_path / "dlt.csv", dlt_text())
    profile = write(tmp_path / "profile.txt", "1 526 640 320 320 256\n" * 2)
    assert read_dlt(path, profile=profile, image_height=512)[1].resolution == SIZE
    refused(lambda: read_dlt(path, profile=tmp_path / "none.txt"), "does not exist")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x81")
    refused(lambda: read_dlt(tmp_path / "binary.csv", resolution=SIZE), "no text")


# Vicon

SENSOR = {"DEVICEID": "2118670", "USERID": "5", "SENSOR_SIZE": "1280 720", "PIXEL_ASPECT_RATIO": "1"}


def frame(index=0, **changes) -> dict:
    camera = two()[index]
    text = {
        "FRAME": "0",
        "FOCAL_LENGTH": repr(camera.matrix[0, 0].item()),
        "ORIENTATION": " ".join(map(repr, Rotation.from_matrix(camera.rotation).as_quat().tolist())),
        "POSITION": " ".join(map(repr, (camera.centre * 1000).tolist())),
        "PRINCIPAL_POINT": "640 360",
        "VICON_RADIAL2": "Vicon3Parameter 641.0 359.0 2e-07 1e-14 0",
    }
    text.update(changes)
    return {key: value for key, value in text.items() if value is not ...}


def xcp_text(*cameras, head="") -> str:
    """A file of (sensor attributes, key frames) of each camera."""
    text = '<?xml version="1.0" encoding="UTF-8" standalone="no" ?>\n' + head + '<Cameras VERSION="2.0">\n'
    for sensor, frames in cameras:
        attributes = " ".join(f'{k}="{v}"' for k, v in {**SENSOR, **sensor}.items() if v is not ...)
        inside = "".join("<KeyFrame " + " ".join(f'{k}="{v}"' for k, v in f.items()) + "/>" for f in frames)
        text += f'<Camera {attributes}><ThresholdGrid DATA="r 1"/><KeyFrames>{inside}</KeyFrames></Camera>\n'
    return text + "</Cameras>\n"


TWO = [({}, [frame(0)]), ({"DEVICEID": "77", "USERID": "4"}, [frame(1)])]


def test_xcp(tmp_path):
    path = write(tmp_path / "rig.xcp", xcp_text(*TWO))
    cameras = read_track_cameras(path)
    assert cameras.names == ["2118670", "77"]
    for got, exact in zip(cameras, two(), strict=True):
        np.testing.assert_allclose(got.rotation, exact.rotation, atol=1e-12)
        np.testing.assert_allclose(got.centre, exact.centre, atol=1e-12)
        assert got.resolution == (1280, 720) and got.matrix[1, 1] == got.matrix[0, 0] == 900
        ideal = (points() @ exact.rotation.T + exact.translation) @ got.matrix.T
        ideal = ideal[:, :2] / ideal[:, 2:]
        measured = got.project(points())
        offset = measured - [641.0, 359.0]
        squared = (offset**2).sum(1, keepdims=True)
        np.testing.assert_allclose(offset * (1 + 2e-7 * squared + 1e-14 * squared**2) + [641.0, 359.0], ideal)


def test_xcp_cameras_by_device_or_user(tmp_path):
    path = write(tmp_path / "rig.xcp", xcp_text(*TWO))
    assert read_track_cameras(path, only=["77", 2118670]).names == ["77", "2118670"]
    assert read_xcp(path, only=[4]).names == ["77"]
    refused(lambda: read_xcp(path, only=["9"]), "no camera '9'", "2118670, 77")


def test_xcp_takes_the_latest_key_frame_and_passes_over_what_is_not_calibrated(tmp_path):
    frames = [frame(1, FRAME="300"), frame(0, FRAME="20")]
    path = write(
        tmp_path / "rig.xcp", xcp_text(({}, frames), ({"DEVICEID": "77"}, []), ({"DEVICEID": "78"}, [{}]))
    )
    cameras = read_xcp(path)
    assert cameras.names == ["2118670"]
    np.testing.assert_allclose(cameras[0].centre, two()[1].centre, atol=1e-9)
    refused(lambda: read_xcp(path, only=["77"]), "'77' is not calibrated")


def test_xcp_lenses(tmp_path):
    cameras = [
        ({"DEVICEID": "1"}, [frame(VICON_RADIAL2=...)]),
        ({"DEVICEID": "2"}, [frame(VICON_RADIAL2="Vicon3Parameter 640 360 0 0 0")]),
        ({"DEVICEID": "3"}, [frame(VICON_RADIAL2=..., VICON_RADIAL="2e-07 1e-14")]),
        ({"DEVICEID": "4", "PIXEL_ASPECT_RATIO": "0.9"}, [frame()]),
    ]
    one, two_, three, four = read_xcp(write(tmp_path / "rig.xcp", xcp_text(*cameras)))
    assert one.radial is None and two_.radial is None
    assert three.radial.centre.tolist() == [640, 360] and three.radial.coefficients.tolist() == [
        2e-7,
        1e-14,
        0,
    ]
    assert four.matrix[1, 1] == pytest.approx(1000)


XCP_FAULTS = [
    ("<Cameras>", ["no XML"]),
    ("plain text", ["no XML"]),
    (xcp_text(), ["no calibrated camera", "no Camera element"]),
    (xcp_text(({}, [])), ["no calibrated camera"]),
    (
        xcp_text(*TWO, head='<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/hostname">]>\n'),
        ["document type", "refused"],
    ),
    (xcp_text(({"DEVICEID": ...}, [frame()])), ["Camera 1: DEVICEID", "lacks"]),
    (xcp_text(*TWO[:1], *TWO[:1]), ["one name"]),
    (xcp_text(({"SENSOR_SIZE": ...}, [frame()])), ["Camera 2118670: SENSOR_SIZE", "lacks"]),
    (xcp_text(({"SENSOR_SIZE": "1280"}, [frame()])), ["SENSOR_SIZE", "2 finite numbers"]),
    (xcp_text(({"SENSOR_SIZE": "0 0"}, [frame()])), ["positive"]),
    (xcp_text(({"SKEW": "0.3"}, [frame()])), ["SKEW"]),
    (xcp_text(({}, [frame(FOCAL_LENGTH=...)])), ["FOCAL_LENGTH", "lacks"]),
    (xcp_text(({}, [frame(FOCAL_LENGTH="-3")])), ["FOCAL_LENGTH", "positive"]),
    (xcp_text(({}, [frame(FOCAL_LENGTH="wide")])), ["FOCAL_LENGTH", "'wide'"]),
    (xcp_text(({}, [frame(PRINCIPAL_POINT="640")])), ["PRINCIPAL_POINT"]),
    (xcp_text(({}, [frame(POSITION="1 2 nan")])), ["POSITION", "finite"]),
    (xcp_text(({}, [frame(ORIENTATION="0 0 0 0.5")])), ["ORIENTATION", "unit quaternion"]),
    (xcp_text(({}, [frame(VICON_RADIAL2="Other 1 2 3 4 5")])), ["VICON_RADIAL2", "Vicon3Parameter"]),
    (xcp_text(({}, [frame(VICON_RADIAL2="Vicon3Parameter 1 2 3")])), ["VICON_RADIAL2", "5 finite"]),
    (xcp_text(({}, [frame(FRAME="last")])), ["FRAME"]),
]


@pytest.mark.parametrize("content, words", XCP_FAULTS)
def test_faults_of_a_vicon_file(tmp_path, content, words):
    path = write(tmp_path / "rig.xcp", content)
    refused(lambda: read_track_cameras(path), str(path), *words)


def test_a_vicon_file_of_another_encoding(tmp_path):
    (tmp_path / "rig.xcp").write_bytes(xcp_text(*TWO).encode("utf-16"))
    refused(lambda: read_xcp(tmp_path / "rig.xcp"), "UTF-8")


# the recordings


@pytest.mark.skipif(not (DATA / "starlings_vicon").is_dir(), reason="the recording starlings_vicon is absent")
def test_starlings():
    rig = read_track_cameras(DATA / "starlings_vicon" / "cameras_starling.xcp")
    scene = read_track_cameras(DATA / "tracks" / "starlings_AB_true_rig" / "all_cameras.json")
    assert len(rig) == len(scene) == 36
    for got, exact in zip(rig, scene, strict=True):
        assert f"cam{got.name}" == exact.name and got.resolution == exact.resolution
        for key in ("matrix", "rotation", "translation"):
            np.testing.assert_allclose(getattr(got, key), getattr(exact, key), atol=1e-8)
    for bird, (fewest, most) in {"ST01a": (9, 11), "ST02b": (8, 10), "ST03a": (6, 8)}.items():
        table = np.genfromtxt(DATA / "starlings_vicon" / f"{bird}.vsk.csv", delimiter=",", skip_header=1)[
            ::20
        ]
        path = table[:, 8:11] / 1000
        views = sum(camera.inside(camera.project(path)).astype(int) for camera in rig)
        assert fewest <= np.median(views[np.isfinite(path).all(1)]) <= most


@pytest.mark.skipif(not (DATA / "bats").is_dir(), reason="the recording bats is absent")
def test_bats():
    path, profile = DATA / "bats" / "2018-08-17_dltCoefs.csv", DATA / "bats" / "camera_profile.txt"
    refused(lambda: read_track_cameras(path), "resolution=(width, height)")
    refused(lambda: read_track_cameras(path, profile=profile), "contradicts itself")  # says 320 of 512 px
    cameras = read_track_cameras(path, profile=profile, image_height=512)
    assert cameras.names == ["cam1", "cam2", "cam3"] and {c.resolution for c in cameras} == {(640, 512)}


@pytest.mark.skipif(not (DATA / "tracks").is_dir(), reason="the recordings tracks are absent")
@pytest.mark.parametrize("name", ["synthetic/code_n3_s3_clean_seed0", "starlings_A_thesis_rig"])
def test_scenes_of_the_recordings(name):
    cameras = read_track_cameras(DATA / "tracks" / name / "cameras.json")
    assert len(cameras) == 2
    if name.startswith("synthetic"):
        assert cameras.names == ["cam0", "cam1"]
        np.testing.assert_allclose(cameras["cam1"].translation, [-2, 0, 0])
