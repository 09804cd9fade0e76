"""The camera-motion command as a user meets it: every route, its files, one clear message for faults."""

import json

import numpy as np
import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

pytest.importorskip("cv2")
import cv2
from test_odometry import LENS, pan, panned

from acino_fte.cameras import CameraArray
from acino_fte.cli_motion import camera_motion
from acino_fte.data_tools.calibration import read_cameras, write_cameras
from acino_fte.data_tools.imu_table import read_imu_table
from acino_fte.data_tools.lvx_packets import LvxDevice
from acino_fte.data_tools.lvx_write import write_lvx
from acino_fte.data_tools.recording import ImuSamples, PictureInfo
from acino_fte.data_tools.rotations import rotation_vector

APP = typer.Typer()
APP.command()(camera_motion)
N, FPS = 8, 10.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A tripod's pictures, with keypoints, encoders and an inertial sensor; and its turns."""
    folder = tmp_path_factory.mktemp("recording")
    write_cameras(folder / "cameras.json", CameraArray((LENS,)))
    header = [
        ["scorer"] + ["s"] * 6,
        ["bodyparts"] + ["nose"] * 3 + ["neck"] * 3,
        ["coords"] + ["x", "y", "likelihood"] * 2,
    ]
    rows = [[n, 5, 5, 0.99, 12, 9, 0.99] for n in range(N)]
    pd.DataFrame([*header, *rows]).to_csv(folder / "c.csv", header=False, index=False)
    (folder / "sequence.yaml").write_text(
        "format: acino-fte/sequence/1\nspecies: cheetah\nfps: 10\n"
        "cameras: cameras.json\nkeypoints: {c: c.csv}\n"
    )
    rigs = tmp_path_factory.mktemp("rig")
    pictures, rotation = panned(pan(N))
    (rigs / "images").mkdir()
    for n, picture in enumerate(pictures):
        cv2.imwrite(str(rigs / "images" / f"{n:03}.png"), picture)
    (rigs / "encoders.csv").write_text(
        "frame,pan,tilt\n" + "".join(f"{n},{100 * n},{50 * n}\n" for n in range(N))
    )
    time = np.arange(-3, 1, 0.01)
    rate = np.where(time[:, None] > 0, [0.0, 0.0, 0.5], 0.0) + np.random.default_rng(0).normal(
        0, 1e-3, (len(time), 3)
    )
    table = np.column_stack([time + 3, rate, np.tile([0, 0, 9.80665], (len(time), 1))])
    names = "time (s),gyr_x (rad/s),gyr_y (rad/s),gyr_z (rad/s),acc_x (m/s2),acc_y (m/s2),acc_z (m/s2)"
    np.savetxt(rigs / "imu.csv", table, delimiter=",", header=names, comments="")
    (rigs / "mount.json").write_text(json.dumps([[0, -1, 0], [0, 0, -1], [1, 0, 0]]))
    return folder, rigs, rotation


def run(*arguments):
    return CliRunner(env={"COLUMNS": "200"}).invoke(APP, [str(a) for a in arguments])


def degrees(vector):
    return np.degrees(np.linalg.norm(vector, axis=-1))


def read(out):
    return read_cameras(out / "cameras.json")["c"], json.loads((out / "camera_motion.json").read_text())


def test_by_the_video(recording, tmp_path):
    folder, rig, rotation = recording
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    result = run(folder, "--from", "video", "--file", rig / "images", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    camera, note = read(tmp_path / "out")
    assert camera.rotation.shape == (N, 3, 3) and note["known"] == N and note["model"] == "rotation"
    apart = camera.rotation @ np.swapaxes(rotation @ rotation[0].T, 1, 2)
    assert degrees(rotation_vector(apart)).max() < 0.05
    assert (tmp_path / "out" / "camera_motion.png").stat().st_size > 10_000
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def test_by_the_encoders(recording, tmp_path):
    folder, rig, _ = recording
    arguments = ("--file", rig / "encoders.csv", "--counts", 4096, 4096, "-o", tmp_path / "out", "-q")
    result = run(folder, "--from", "encoders", *arguments)
    assert result.exit_code == 0, result.output
    camera, note = read(tmp_path / "out")
    assert note["levelled"] and camera.rotation[7][2] @ [0, 0, 1] == pytest.approx(
        np.sin(350 / 4096 * 2 * np.pi)
    )
    again = run(folder, "--from", "encoders", *arguments)  # an earlier result is replaced
    assert again.exit_code == 0


def test_by_the_inertial_sensor(recording, tmp_path):
    folder, rig, _ = recording
    given = "--file", rig / "imu.csv", "--imu-to-camera", rig / "mount.json", "--start", 3
    result = run(folder, "--from", "imu", *given, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    camera, note = read(tmp_path / "out")
    forward = camera.rotation[:, 2]
    heading = np.degrees(np.arctan2(forward[:, 1], forward[:, 0]))
    np.testing.assert_allclose(heading, np.degrees(0.05 * np.arange(N)), atol=0.3)
    np.testing.assert_allclose(forward[:, 2], 0, atol=0.01)
    assert note["levelled"] and note["known"] == N


@pytest.fixture(scope="module")
def bag(recording):
    """A ROS 1 bag with the samples of the table, and messages of a camera that dropped its frame 4."""
    pytest.importorskip("rosbags")
    from acino_fte.data_tools.bags_write import BagWriter

    _, rig, _ = recording
    table = read_imu_table(rig / "imu.csv")
    path = rig / "a recording ü.bag"
    with BagWriter(path, version=1) as writer:
        for k, stamp in enumerate(table.time_ns.tolist()):
            one = ImuSamples(table.time_ns[k : k + 1] + 10**9, table.rate[k : k + 1], table.force[k : k + 1])
            writer.write("/livox/imu", one, stamp + 10**9)
        for n in (0, 1, 2, 3, 5, 6, 7):
            stamp = round((4 + n / FPS) * 1e9)
            info = PictureInfo(stamp, 70 + n, 900.0, 6.0, (0, 0, 100 * n, 50 * n))
            writer.write("/camera/info", info, stamp)
    return path


def test_a_recording_in_place_of_a_table(recording, bag, tmp_path):
    """Of the same samples and counts the same poses, by a bag and by the lidar's own file."""
    folder, rig, _ = recording
    given = "--imu-to-camera", rig / "mount.json", "--start", 3
    lvx = tmp_path / "no suffix"
    samples = read_imu_table(rig / "imu.csv")
    write_lvx(lvx, [LvxDevice(0, "3GGDSIM00100091", 2)], [{"imu0": samples}])
    cameras = []
    for name, file in (("csv", rig / "imu.csv"), ("bag", bag), ("lvx", lvx)):
        result = run(folder, "--from", "imu", "--file", file, *given, "-o", tmp_path / name)
        assert result.exit_code == 0, result.output
        cameras.append(read(tmp_path / name)[0].rotation)
    np.testing.assert_allclose(cameras[1], cameras[0], atol=1e-9)
    np.testing.assert_allclose(cameras[2], cameras[0], atol=1e-5)  # the file has single precision
    counts = "--counts", 4096, 4096
    for name, file in (("table", rig / "encoders.csv"), ("messages", bag)):
        result = run(folder, "--from", "encoders", "--file", file, *counts, "-o", tmp_path / name)
        assert result.exit_code == 0, result.output
    (table, _), (messages, note) = read(tmp_path / "table"), read(tmp_path / "messages")
    assert note["known"] == N - 1 and note["unknown_frames"] == [4]  # it was dropped: bridged
    rows = np.delete(np.arange(N), 4)
    np.testing.assert_allclose(messages.rotation[rows], table.rotation[rows], atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--from", "imu", "--imu-to-camera", "same", "--topic", "/livox/imus"), "did you mean '/livox/imu'"),
        (("--from", "encoders", "--counts", "4", "4", "--encoders", "3", "4"), "4 numbers in the first"),
        (("--from", "encoders", "--counts", "4", "4", "--encoders", "-1", "3"), "no such encoders"),
        (("--from", "video"), "The video cannot be read"),
    ],
)
def test_faults_of_a_recording(recording, bag, tmp_path, arguments, word):
    result = run(recording[0], *arguments, "--file", bag, "-o", tmp_path / "out")
    assert result.exit_code == 2 and word in result.output, result.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--from", "encoders", "--file", "encoders.csv"), "--counts"),
        (("--from", "imu", "--file", "imu.csv"), "--imu-to-camera"),
        (("--from", "imu", "--file", "imu.csv", "--imu-to-camera", "no.json"), "mounting of the sensor"),
        (("--from", "video", "--file", "no.mp4"), "no such pictures"),
        (("--from", "video", "--file", "images", "--camera", "d"), "no such camera"),
        (
            ("--from", "imu", "--file", "imu.csv", "--imu-to-camera", "same", "--start", "99"),
            "while the inertial sensor",
        ),
    ],
)
def test_one_message_and_nothing_written(recording, tmp_path, monkeypatch, arguments, word):
    folder, rig, _ = recording
    monkeypatch.chdir(rig)
    result = run(folder, *arguments, "-o", tmp_path / "out")
    assert result.exit_code == 2 and word in result.output and "Traceback" not in result.output
    assert not (tmp_path / "out").exists()
