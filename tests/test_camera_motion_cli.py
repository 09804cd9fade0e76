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


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--from", "encoders", "--file", "encoders.csv"), "--counts"),
        (("--from", "imu", "--file", "imu.csv"), "--imu-to-camera"),
        (("--from", "imu", "--file", "imu.csv", "--imu-to-camera", "no.json"), "mounting of the sensor"),
        (("--from", "video", "--file", "no.mp4"), "does not exist"),
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
