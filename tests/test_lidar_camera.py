"""Files of a camera calibrated to a lidar: the own, those of others, pairs of picks; and the command."""

import json
from pathlib import Path

import numpy as np
import pytest
from data_tools_synthetic import message
from scipy.spatial.transform import Rotation
from typer import Typer
from typer.testing import CliRunner

from acino_fte.cameras import Camera
from acino_fte.cli_calibrate import calibrate_lidar
from acino_fte.data_tools.lidar_camera import LidarCamera, read_lidar_camera, write_lidar_camera
from acino_fte.data_tools.lidar_intrinsics import read_intrinsics
from acino_fte.data_tools.lidar_pairs import LidarPairs, joined, read_lidar_pairs, write_lidar_pairs
from acino_fte.data_tools.lidar_solve_simulate import RESOLUTION, simulated_picks
from acino_fte.errors import InputError

KITTI = Path(__file__).resolve().parents[2] / "shared" / "data" / "lidar_rgb_kitti"
needs_kitti = pytest.mark.skipif(not KITTI.is_dir(), reason="shared/data/lidar_rgb_kitti is absent")
FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
ROTATION = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix() @ FORWARD
TRANSLATION = np.array([0.1, -0.3, 0.2])
MATRIX = np.array([[900.0, 0, 640.5], [0, 905.0, 360.25], [0, 0, 1]])
LENS = Camera("left", "pinhole", MATRIX, [-0.2, 0.07, 0.003, 0.0003, 0], np.eye(3), np.zeros(3), (1280, 720))
OST = """image_width: 1280
image_height: 720
camera_name: left
camera_matrix: {rows: 3, cols: 3, data: [900.0, 0, 640.5, 0, 905.0, 360.25, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.07, 0.003, 0.0003, 0]}
"""


def posed() -> Camera:
    return Camera("left", "pinhole", MATRIX, LENS.distortion, ROTATION, TRANSLATION, (1280, 720))


def transform() -> np.ndarray:
    return np.block([[ROTATION, TRANSLATION[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


# ------------------------------------------------------------------------------------- own file


def test_what_is_written_is_read(tmp_path):
    names = ("rotation_x", "cx")
    one = LidarCamera(posed(), np.diag([1e-6, 4.0]), names, 1.25, 20, "2026-01-02T03:04:05+00:00", "a note")
    write_lidar_camera(tmp_path / "c.json", one)
    read = read_lidar_camera(tmp_path / "c.json")
    for key in ("matrix", "distortion", "rotation", "translation"):
        np.testing.assert_array_equal(getattr(read.camera, key), getattr(one.camera, key))
    np.testing.assert_array_equal(read.covariance, one.covariance)
    assert (read.parameters, read.rmse_px, read.n_pairs, read.date, read.note) == (
        names, 1.25, 20, one.date, "a note",
    )  # fmt: skip
    assert read.sd("cx") == 2.0 and np.isnan(read.sd("cy")) and read.name == "left"
    np.testing.assert_array_equal(read.lidar_to_camera, transform())
    assert [p.name for p in tmp_path.iterdir()] == ["c.json"]


def test_faults_of_the_own_file(tmp_path):
    path = tmp_path / "c.json"
    write_lidar_camera(path, LidarCamera(posed()))
    good = json.loads(path.read_text())
    faults = {
        "camera_matrix": [[1, 2], [3]],
        "lidar_to_camera": {"rotation": np.ones((3, 3)).tolist(), "translation": [0, 0, 0]},
        "resolution": [0],
        "covariance": [[1.0]],
        "surprise": 1,
        "name": "",
    }
    for key, value in faults.items():
        path.write_text(json.dumps(good | {key: value}))
        assert message(read_lidar_camera, path).file == str(path)
    path.write_text(json.dumps(good)[:200])
    message(read_lidar_camera, path)
    path.write_text(json.dumps(good))
    assert "other way" in message(read_lidar_camera, path, "camera_to_lidar").problem
    assert "no such" in message(read_lidar_camera, tmp_path / "none.json").problem
    panorama = Camera("p", "equirectangular", MATRIX, [], ROTATION, TRANSLATION, (1280, 720))
    message(write_lidar_camera, tmp_path / "d.json", LidarCamera(panorama))
    assert not (tmp_path / "d.json").exists()


# ---------------------------------------------------------------------------------- other files


def stored(path: Path, kind: str, matrix: np.ndarray, name: str) -> Path:
    """A transform in a file of a kind; under a name, where the kind has names and one is given."""
    path = path / f"t.{kind}"
    if kind == "npz":
        np.savez(path, **({name: matrix} if name else {"R": matrix[:3, :3], "T": matrix[None, :3, 3]}))
    elif kind == "npy":
        np.save(path, matrix)
    elif kind == "txt":
        np.savetxt(path, matrix[:3], fmt="%.17g")
    elif name:
        path.write_text(json.dumps({name: matrix.tolist()}))
    else:
        path.write_text(
            json.dumps({"rotation": matrix[:3, :3].tolist(), "translation": matrix[:3, 3].tolist()})
        )
    return path


@pytest.mark.parametrize("kind", ["npz", "npy", "txt", "json", "yaml"])
@pytest.mark.parametrize("direction", ["lidar_to_camera", "camera_to_lidar"])
def test_a_direction_is_asked_for_where_the_file_does_not_say_it(tmp_path, kind, direction):
    matrix = transform() if direction == "lidar_to_camera" else np.linalg.inv(transform())
    path = stored(tmp_path, kind, matrix, "")
    error = message(read_lidar_camera, path, camera=LENS)
    assert error.key == "direction" and "which way" in error.problem
    read = read_lidar_camera(path, direction, camera=LENS)
    np.testing.assert_allclose(read.lidar_to_camera, transform(), atol=1e-12)


@pytest.mark.parametrize("kind", ["npz", "json", "yaml"])
@pytest.mark.parametrize(
    ("name", "forward"),
    [
        *(("lidar_to_camera", True), ("T_cam_lidar", True), ("velo_to_cam", True), ("livox2cam", True)),
        *(("camera_to_lidar", False), ("T_lidar_cam", False), ("cam0_to_velo", False)),
    ],
)
def test_a_name_tells_the_direction(tmp_path, kind, name, forward):
    path = stored(tmp_path, kind, transform() if forward else np.linalg.inv(transform()), name)
    read = read_lidar_camera(path, camera=LENS)
    np.testing.assert_allclose(read.lidar_to_camera, transform(), atol=1e-12)
    wrong = "camera_to_lidar" if forward else "lidar_to_camera"
    assert "other way" in message(read_lidar_camera, path, wrong, camera=LENS).problem


def test_points_are_evidence_not_a_decision(tmp_path):
    points = posed().back_project(np.array([[[200.0, 100.0], [900.0, 600.0]]]), np.array([[5.0, 9.0]]))[0]
    error = message(read_lidar_camera, stored(tmp_path, "npy", transform(), ""), camera=LENS, points=points)
    assert "as lidar_to_camera, 2 of 2 points lie in front of the camera and 2 in the image" in error.found


def test_transforms_that_are_none(tmp_path):
    scaled, mirrored = transform(), transform()
    scaled[:3, :3] *= 2
    mirrored[:3, 0] *= -1
    for bad in (scaled, mirrored, transform().T, np.full((4, 4), np.nan), np.eye(3)):
        np.save(tmp_path / "t.npy", bad)
        message(read_lidar_camera, tmp_path / "t.npy", "lidar_to_camera", camera=LENS)
    np.savez(tmp_path / "t.npz", R=np.array([{"a": 1}], dtype=object))  # a pickle, which could run code
    assert "NumPy" in message(read_lidar_camera, tmp_path / "t.npz", "lidar_to_camera", camera=LENS).problem
    path = stored(tmp_path, "json", transform(), "lidar_to_camera")
    assert message(read_lidar_camera, path).key == "camera"
    message(read_lidar_camera, path, "sideways", camera=LENS)
    both = {"lidar_to_camera": transform().tolist(), "camera_to_lidar": transform().tolist()}
    path.write_text(json.dumps(both))
    assert "both directions" in message(read_lidar_camera, path, camera=LENS).problem
    for text in ("", "hello", "1 2 3", "P2: a b", "{", "[1, {}]"):
        (tmp_path / "t.txt").write_text(text)
        message(read_lidar_camera, tmp_path / "t.txt", "lidar_to_camera", camera=LENS)


def test_intrinsics_as_ros_writes_them(tmp_path):
    path = tmp_path / "ost.yaml"
    path.write_text(OST)
    read = read_intrinsics(path)
    np.testing.assert_array_equal(read.matrix, MATRIX)
    np.testing.assert_array_equal(read.distortion, LENS.distortion)
    assert read.resolution == (1280, 720) and read.name == "left"
    assert "intrinsics, but not" in message(read_lidar_camera, path, "lidar_to_camera").problem
    for old, new in (
        ("plumb_bob", "magic"),
        ("-0.2, 0.07, 0.003, ", ""),
        ("image_height: 720", ""),
        ("900.0", "x"),
    ):
        path.write_text(OST.replace(old, new))
        message(read_intrinsics, path)
    path.write_text("!!python/object/apply:os.system ['true']")
    message(read_intrinsics, path)
    own = tmp_path / "c.json"
    write_lidar_camera(own, LidarCamera(posed()))
    np.testing.assert_array_equal(read_intrinsics(own).rotation, np.eye(3))


@needs_kitti
def test_kitti_projects_as_opencv_does():
    """pixel ~ P2 R0_rect Tr_velo_to_cam X, to 1e-6 px over the whole cloud."""
    import cv2

    cloud = np.fromfile(KITTI / "velodyne.bin", np.float32).reshape(-1, 4)[:, :3].astype(float)
    lines = (line.split(":") for line in (KITTI / "calib.txt").read_text().splitlines() if ":" in line)
    given = {name: np.array(numbers.split(), dtype=float) for name, numbers in lines}
    camera = read_lidar_camera(KITTI / "calib.txt", resolution=(1242, 375)).camera
    found = camera.project(cloud)
    inside = camera.inside(found)
    assert inside.sum() > 15_000
    level = np.hstack([given["R0_rect"].reshape(3, 3), np.zeros((3, 1))])
    velo = np.vstack([given["Tr_velo_to_cam"].reshape(3, 4), [0, 0, 0, 1]])
    local = cv2.transform(cloud[inside][:, None], (level @ velo))
    homogeneous = cv2.transform(local, given["P2"].reshape(3, 4))
    direct = cv2.convertPointsFromHomogeneous(homogeneous)[:, 0]
    np.testing.assert_allclose(found[inside], direct, rtol=0, atol=1e-6)
    u, _, vt = np.linalg.svd(camera.rotation)  # the file's seven digits, made a rotation as OpenCV takes it
    turn = u @ vt
    exact = Camera("P2", "pinhole", camera.matrix, [], turn, camera.translation, camera.resolution)
    arguments = (cv2.Rodrigues(turn)[0], np.array(camera.translation), np.array(camera.matrix), None)
    expected = cv2.projectPoints(cloud[inside], *arguments)[0][:, 0]
    np.testing.assert_allclose(exact.project(cloud)[inside], expected, rtol=0, atol=1e-6)
    assert message(read_lidar_camera, KITTI / "calib.txt").key == "resolution"
    left = read_lidar_camera(KITTI / "calib.txt", resolution=(1242, 375), view="P0").camera
    assert np.linalg.norm(left.centre - camera.centre) == pytest.approx(0.06, abs=0.005)  # colour beside grey


# ---------------------------------------------------------------------------------------- pairs


def some_pairs(n=5) -> LidarPairs:
    rng = np.random.default_rng(0)
    labels = ("corner, upper", *("",) * (n - 1))
    return LidarPairs(
        rng.uniform(0, 700, (n, 2)), rng.normal(8, 1, (n, 3)), "a.png", np.arange(n) != 2, labels
    )


@pytest.mark.parametrize("suffix", ["csv", "json"])
def test_pairs_that_are_written_are_read(tmp_path, suffix):
    pairs = some_pairs()
    write_lidar_pairs(tmp_path / f"p.{suffix}", pairs)
    read = read_lidar_pairs(tmp_path / f"p.{suffix}")
    for key in ("pixel", "xyz", "used"):
        np.testing.assert_array_equal(getattr(read, key), getattr(pairs, key))
    assert read.image == pairs.image and read.label == pairs.label and read.n_used == 4
    assert [p.name for p in tmp_path.iterdir()] == [f"p.{suffix}"]
    both = joined([pairs, LidarPairs(pairs.pixel + 1, pairs.xyz, "b.png")])
    assert both.images == ("a.png", "b.png") and both.take(both.used_mask).n_used == 9


def test_pairs_as_people_write_them(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("# by hand\nU, V, X, Y, Z, use\n1,2,3,4,5,\n\n6,7,8,9,10,no\n")
    read = read_lidar_pairs(path)
    np.testing.assert_array_equal(read.pixel, [[1, 2], [6, 7]])
    assert read.used_mask.tolist() == [True, False] and read.image == ("", "")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("", "u"),
        ("u,v,x,y\n1,2,3,4\n", "z"),
        ("u,v,x,y,z\n1,2,3,4,nan\n", "pair 1.z"),
        ("u,v,x,y,z\n1,2,3,4,5\n1,2,,4,5\n", "pair 2.x"),
        ("u,v,x,y,z\n1,2,3,4,5\n6,7,8,9,0,1\n", "pair 2"),
        ("u,v,x,y,z\n1,2,0,0,0\n", "pair 1"),
        ("u,v,x,y,z\n1,2,3,4,5\n1,2,3,4,5\n", "pair 2"),
        ("u,v,x,y,z,use\n1,2,3,4,5,maybe\n", "pair 1.use"),
        ('{"format": "acino-fte/lidar-pairs/1", "pairs": [{"u": 1}]}', "pairs.0.v"),
        ('{"format": "other"}', None),
        ('{"format', None),
    ],
)
def test_pairs_that_cannot_be_read(tmp_path, text, key):
    (tmp_path / "p.csv").write_text(text)
    error = message(read_lidar_pairs, tmp_path / "p.csv")
    assert error.file and error.key == key


def test_pairs_that_do_not_fit_together():
    for bad in ((np.zeros((2, 2)), np.ones((3, 3))), (np.zeros((2, 3)), np.ones((2, 3)))):
        with pytest.raises(InputError):
            LidarPairs(*bad)
    assert len(LidarPairs([], [])) == 0


# -------------------------------------------------------------------------------------- command


def test_the_command_calibrates_and_reports(tmp_path):
    """From a file of pairs, without a page: calibration, tables and figures; bad input leaves with 2."""
    app = Typer()
    app.command()(calibrate_lidar)
    picks = simulated_picks(25.0, "scene", 16, 2)
    write_lidar_pairs(tmp_path / "picks.csv", picks.pairs)
    out = tmp_path / "out" / "cal.json"
    arguments = ["--pairs", str(tmp_path / "picks.csv"), "-o", str(out), "--resolution"]
    done = CliRunner().invoke(app, [*arguments, "2048x1088"])
    assert done.exit_code == 0, done.output
    read = read_lidar_camera(out)
    assert read.n_pairs == 16 and read.rmse_px < 2 and read.camera.resolution == RESOLUTION
    report = out.with_name("cal_report")
    assert {p.name for p in report.iterdir()} == {
        *("errors.csv", "errors.md", "errors.tex", "pairs.csv", "calibrations.json", "figures"),
    }
    for name in ("errors", "residuals_picks_placement_0"):
        assert (report / "figures" / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
        assert (report / "figures" / f"{name}.pdf").read_bytes()[:4] == b"%PDF"
    assert (
        "| picks |" in (report / "errors.md").read_text()
        and r"\toprule" in (report / "errors.tex").read_text()
    )
    for wrong in (["0x3"], ["2048x1088", "--focal", "long"], ["2048x1088", "--fit", "zoom"], ["800x600"]):
        assert CliRunner().invoke(app, [*arguments, *wrong]).exit_code == 2
    kept = (tmp_path / "picks.csv").read_bytes()
    for place in ("picks.csv", ".", "picks.csv/cal.json"):  # over the pairs, a folder, within a file
        done = CliRunner().invoke(
            app, [*arguments, "2048x1088", "--fit", "f", "--no-report", "-o", str(tmp_path / place)]
        )
        assert done.exit_code == 2 and (tmp_path / "picks.csv").read_bytes() == kept, place
    assert CliRunner().invoke(app, []).exit_code == 2
