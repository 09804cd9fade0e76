"""``import-recording``: recordings of a small rig that pans, in real formats, become sequence folders."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

pytest.importorskip("rosbags")
pytest.importorskip("av")

from acino_fte import cli_import
from acino_fte.cameras import Camera
from acino_fte.data_tools.bags_write import BagWriter
from acino_fte.data_tools.calibration import read_cameras
from acino_fte.data_tools.deeplabcut import read_deeplabcut, write_deeplabcut_csv
from acino_fte.data_tools.import_clocks import device_clocks
from acino_fte.data_tools.import_lidar import in_view
from acino_fte.data_tools.import_pivot import pivot_hint
from acino_fte.data_tools.import_recording import ImportOptions, import_recording
from acino_fte.data_tools.import_scan import StreamScan
from acino_fte.data_tools.import_sync import Inputs, synchronise
from acino_fte.data_tools.lidar_camera import LidarCamera, write_lidar_camera
from acino_fte.data_tools.load import load_sequence
from acino_fte.data_tools.lvx_packets import LvxDevice
from acino_fte.data_tools.lvx_write import write_lvx
from acino_fte.data_tools.recording import ImuSamples, LidarReturns, Picture, PictureInfo
from acino_fte.data_tools.rotations import rotation_matrix
from acino_fte.data_tools.sequence_file import read_sequence_file
from acino_fte.data_tools.video import write_video
from acino_fte.errors import InputError

FPS, N = 60.0, 120
FOCAL = 400.0
UNIX = 1_750_000_000_000_000_000
CAMERA_NS, LIDAR_NS = 40_000_000_000, 910_000_000_000  # what the sensors' clocks show at time 0
LATE_CAMERA, LATE_LIDAR = 0.009, 0.002  # s, that every message is late at least
LIDAR_TO_CAMERA = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
LOST = (20, 21, 70, 111)  # frames that the camera dropped
KEPT = np.setdiff1d(np.arange(N), LOST)
WIDTH, HEIGHT = 160, 96


def turn(t):
    """Yaw and pitch of the rig (K, 2), rad: unlike itself at any other time."""
    yaw = 0.05 * np.sin(2 * np.pi * 0.9 * t) + 0.035 * np.sin(2 * np.pi * 1.7 * t + 1.0 + t**2 / 3)
    pitch = 0.02 * np.sin(2 * np.pi * 1.3 * t + 0.4) + 0.015 * np.sin(2 * np.pi * 2.3 * t + t**2 / 2)
    still = np.clip((t + 1.0) / 1.0, 0, 1)
    still = still**2 * (3 - 2 * still)  # it rests until a second before frame 0
    return still[:, None] * np.column_stack([yaw, pitch])


def attitude(t):
    """Lidar to world (K, 3, 3): yaw about the world's z, then pitch about the lidar's y."""
    yaw, pitch = turn(t).T
    nothing = np.zeros_like(yaw)
    about_z = rotation_matrix(np.column_stack([nothing, nothing, yaw]))
    return about_z @ rotation_matrix(np.column_stack([nothing, pitch, nothing]))


def encoders(n):
    """Zoom, focus, pan and tilt of a head of 40 000 counts a turn; tilt counts downwards."""
    yaw, pitch = turn(np.array([n / FPS]))[0]
    return 7, 8, round(1000 + yaw / (2 * np.pi) * 40_000), round(2000 + pitch / (2 * np.pi) * 40_000)


def inertial():
    """Samples at 200 Hz from 4 s before frame 0, as (t, rate, force)."""
    rng = np.random.default_rng(5)
    t = np.arange(-4.0, N / FPS + 0.5, 0.005)
    step = 1e-4
    relative = np.swapaxes(attitude(t - step), 1, 2) @ attitude(t + step)
    rate = np.stack([relative[:, 2, 1], relative[:, 0, 2], relative[:, 1, 0]], axis=1) / (2 * step)
    force = np.swapaxes(attitude(t), 1, 2) @ np.array([0, 0, 9.80665])
    return t, rate + 1e-3 * rng.normal(size=rate.shape), force + 0.01 * rng.normal(size=force.shape)


def returns():
    """Every 4 ms: 10 m away, distance telling the time, in the picture or 40° beside it."""
    t = np.arange(-0.3, N / FPS + 0.3, 0.004)
    xyz = np.column_stack([10 + 5 * (t + 0.3), np.where(np.arange(len(t)) % 3 == 0, 8.0, 0.1), 0 * t])
    return t, xyz


def pictures():
    """What the camera shows of a wall, at the frames that were recorded."""
    rng = np.random.default_rng(2)
    wall = rng.integers(0, 255, (60, 90)).astype(np.uint8)
    wall = np.kron(wall, np.ones((5, 5), dtype=np.uint8))
    import cv2

    wall = cv2.GaussianBlur(wall, (0, 0), 1.5)
    yaw, pitch = (FOCAL * turn(KEPT / FPS)).T
    for u, v in zip(145 - yaw, 102 + pitch, strict=True):
        yield cv2.getRectSubPix(
            wall, (WIDTH, HEIGHT), (float(u) + WIDTH / 2 - 0.5, float(v) + HEIGHT / 2 - 0.5)
        )


def lidar_messages():
    """Tenths of a second: (t of the last return, returns in the lidar's clock)."""
    t, xyz = returns()
    for part in np.array_split(np.arange(len(t)), round((t[-1] - t[0]) / 0.1)):
        zero = np.zeros(len(part), dtype=np.uint8)
        stamps = LIDAR_NS + np.rint(t[part] * 1e9).astype(np.int64)
        yield t[part[-1]], LidarReturns(stamps, xyz[part], zero + 40.0, zero, zero, "power_on")


def write_bag(path, camera=True, version=1):
    rng = np.random.default_rng(3)

    def at(t, late):
        return UNIX + round((t + late + 1e-3 * rng.exponential()) * 1e9)

    entries = [(at(t, LATE_LIDAR), "/livox/lidar", value) for t, value in lidar_messages()]
    for t, rate, force in zip(*inertial(), strict=True):
        stamp = np.array([LIDAR_NS + round(t * 1e9)])
        entries.append((at(t, LATE_LIDAR), "/livox/imu", ImuSamples(stamp, rate[None], force[None])))
    if camera:
        for n, pixels in zip(KEPT.tolist(), pictures(), strict=True):
            stamp, received = CAMERA_NS + round(n / FPS * 1e9), at(n / FPS, LATE_CAMERA)
            entries.append((received, "/camera/image", Picture(stamp, pixels, 500 + n)))
            entries.append((received, "/camera/info", PictureInfo(stamp, 500 + n, 900.0, 6.0, encoders(n))))
    with BagWriter(path, version=version) as writer:
        for received, topic, value in sorted(entries, key=lambda entry: entry[0]):
            writer.write(topic, value, received)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """rig.bag, lidar.lvx, cam.mkv, keypoints.csv, lidar_camera.json; tests must leave them as they are."""
    folder = tmp_path_factory.mktemp("rig")
    write_bag(folder / "rig.bag")
    t, rate, force = inertial()
    samples = ImuSamples(LIDAR_NS + np.rint(t * 1e9).astype(np.int64), rate, force, "power_on")
    frames = [{"imu0": samples}, *({"lidar0": value} for _, value in lidar_messages())]
    write_lvx(folder / "lidar.lvx", [LvxDevice(0, "3GGDJ6K00100101", 2)], frames)
    stamps = np.rint(KEPT / FPS * 1e9).astype(np.int64)
    write_video(folder / "cam.mkv", pictures(), FPS, stamps_ns=stamps, codec="ffv1")
    write_video(folder / "even.mkv", pictures(), FPS, codec="ffv1")
    matrix = [[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]]
    camera = Camera("cam1", "pinhole", matrix, [], LIDAR_TO_CAMERA, np.zeros(3), (WIDTH, HEIGHT))
    write_lidar_camera(folder / "lidar_camera.json", LidarCamera(camera))
    keypoints = np.repeat(KEPT[:, None], 2, axis=1)[:, None] * np.array([0.5, 0.25]) + 3.0
    write_deeplabcut_csv(folder / "keypoints.csv", ["nose"], keypoints, np.full((len(KEPT), 1), 0.9))
    return folder


def options(rig, **more):
    return ImportOptions(
        **{
            "keypoints": rig / "keypoints.csv",
            "calibration": rig / "lidar_camera.json",
            "species": "cheetah",
            "pictures": False,
            **more,
        }
    )


def lidar_of(folder):
    with np.load(folder / "lidar.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def time_errors_ms(folder, first_frame=0):
    """Of the lidar's returns, whose distance tells when they were."""
    found = lidar_of(folder)
    true = (found["xyz"][:, 0].astype(float) - 10) / 5 - 0.3 - first_frame / FPS
    return 1e3 * (found["time"] - true)


@pytest.fixture(scope="module")
def imported(rig, tmp_path_factory):
    """The bag with everything in it, imported."""
    return import_recording(
        rig / "rig.bag", tmp_path_factory.mktemp("out") / "run", options(rig, pictures=True), command="test"
    )


# --- what works -----------------------------------------------------------------------------------------


def test_a_bag_becomes_a_sequence(imported):
    folder = imported.folder
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "sequence.yaml", "cameras.json", "dlc", "lidar.npz", "lidar_camera.json", "imu.csv", "cam1.mp4",
        "import.json",
    }  # fmt: skip
    assert {path.name for path in folder.parent.iterdir()} == {"run"}  # no temporary folder is left
    sequence = load_sequence(folder)
    assert sequence.n_frames == N
    assert sequence.fps == pytest.approx(FPS, rel=1e-3)
    assert sequence.lidar is not None
    assert sequence.lidar.time_sd == pytest.approx(
        1e-3 * imported.provenance["synchronisation"]["sd_ms"], abs=1e-6
    )
    seen = np.isfinite(sequence.detections.position.values).all(axis=(1, 2, 3))
    assert np.array_equal(np.flatnonzero(~seen), LOST)
    u = sequence.detections.position.values[seen][:, 0, 0, 0]
    assert u == pytest.approx(KEPT * 0.5 + 3)


def test_the_lidars_time_is_that_of_the_frames(imported):
    """The camera's messages are 7 ms later than the lidar's, which the motion of the rig tells."""
    sync = imported.provenance["synchronisation"]
    assert sync["method"] == "stamps"
    assert sync["sd_ms"] < 2.5
    error = time_errors_ms(imported.folder)
    assert np.abs(error).max() < max(3.0, 4 * sync["sd_ms"])
    assert any("delay by the motion" in note for note in sync["notes"])


def test_drops_and_provenance(imported):
    content = json.loads((imported.folder / "import.json").read_text())
    assert content["format"] == "acino-fte/import/1"
    assert content["command"] == "test"
    assert content["frames"]["dropped"] == [[20, 2], [68, 1], [108, 1]]
    assert content["frames"]["n_dropped"] == 4
    assert content["frames"]["place"] == KEPT.tolist()
    assert content["damage"]["n_lost"] == 0
    assert {s["name"] for s in content["streams"]} == {
        "/livox/lidar",
        "/livox/imu",
        "/camera/image",
        "/camera/info",
    }
    assert content["lidar"]["read"] == len(returns()[0])


def test_the_video_shows_frame_for_frame_what_the_sequence_has(imported):
    from acino_fte.data_tools.video import VideoReader

    with VideoReader(imported.folder / "cam1.mp4") as video:
        assert len(video) == N
        held, before = video.at(20).pixels.astype(float), video.at(19).pixels.astype(float)
        assert np.abs(held - before).mean() < 2  # dropped: shown once more
        assert np.abs(video.at(22).pixels - before).mean() > 4


def test_the_camera_turns_with_the_rig(imported):
    """Against the truth, up to the heading, which nothing tells."""
    camera = read_cameras(imported.folder / "cameras.json")[0]
    assert camera.rotation.shape == (N, 3, 3)
    true = LIDAR_TO_CAMERA @ np.swapaxes(attitude(np.arange(N) / FPS), 1, 2)
    offset = np.swapaxes(camera.rotation, 1, 2) @ true  # true world to found world, a turn about z
    heading = offset[0]
    error = np.degrees(np.arccos(np.clip((np.trace(offset @ heading.T, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert error.max() < 0.5
    assert np.degrees(np.arccos(np.clip(heading[2, 2], -1, 1))) < 0.5
    assert imported.provenance["motion"]["route"] == "imu"


def test_encoders_tell_how_the_camera_turned(rig, tmp_path):
    result = command(
        rig / "rig.bag", "-o", tmp_path / "run", "--calibration", rig / "lidar_camera.json", "--no-pictures",
        "--motion", "encoders", "--counts-per-turn", "40000,-40000", "--encoder-zero", "1000,2000",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "by the encoders" in result.output
    camera = read_cameras(tmp_path / "run" / "cameras.json")[0]
    true = LIDAR_TO_CAMERA @ np.swapaxes(attitude(np.arange(N) / FPS), 1, 2)
    trace = np.trace(np.swapaxes(camera.rotation, 1, 2) @ true, axis1=1, axis2=2)
    error = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    assert error[KEPT].max() < 0.01
    assert error.max() < 0.1  # dropped frames are bridged
    refused(
        command(
            rig / "rig.bag", "-o", tmp_path / "no", "--calibration", rig / "lidar_camera.json",
            "--motion", "encoders",
        ),
        "--counts-per-turn",
    )  # fmt: skip


def test_the_inertial_samples_are_in_the_clock_of_the_frames(imported):
    table = pd.read_csv(imported.folder / "imu.csv")
    assert list(table.columns) == [
        "time (s)", "gyr_x (rad/s)", "gyr_y (rad/s)", "gyr_z (rad/s)",
        "acc_x (m/s2)", "acc_y (m/s2)", "acc_z (m/s2)",
    ]  # fmt: skip
    t, rate, _ = inertial()
    assert table["time (s)"].to_numpy() == pytest.approx(t, abs=3e-3)
    assert table["gyr_z (rad/s)"].to_numpy() == pytest.approx(rate[:, 2], abs=1e-6)
    assert np.median(np.linalg.norm(table.iloc[:, 4:], axis=1)) == pytest.approx(9.81, abs=0.05)


def test_frames_count_from_zero_again(rig, tmp_path):
    found = import_recording(rig / "rig.bag", tmp_path / "part", options(rig, frames=(30, 90)))
    first = int(KEPT[30])
    assert found.provenance["frames"]["source"] == [30, 90]
    assert found.provenance["frames"]["n_frames"] == KEPT[89] - first + 1
    points = read_deeplabcut(found.folder / "dlc" / "cam1.csv")
    assert points.position[0, 0] == pytest.approx([first * 0.5 + 3, first * 0.25 + 3])
    time = lidar_of(found.folder)["time"]
    assert time.min() == pytest.approx(-2 / FPS, abs=0.01)
    assert time.max() == pytest.approx((KEPT[89] - first + 2) / FPS, abs=0.01)
    assert np.abs(time_errors_ms(found.folder, first)).max() < 4


def test_lvx_and_a_video_by_the_motion_of_the_rig(rig, tmp_path):
    """No clock in common, no hint: what the image does is what the gyroscope felt."""
    found = import_recording(rig / "lidar.lvx", tmp_path / "run", options(rig, video=rig / "cam.mkv"))
    sync = found.provenance["synchronisation"]
    assert sync["method"] == "motion"
    assert np.abs(time_errors_ms(found.folder)).max() < max(4 * sync["sd_ms"], 3.0)
    assert found.provenance["frames"]["place"] == KEPT.tolist()  # by the stamps of the video


def test_lvx_and_a_video_by_a_pivot(rig, tmp_path):
    """Frame 60 of the video is place 62 (1.033 s); the lidar began 0.3 s before frame 0."""
    seconds = KEPT[60] / FPS + 0.3
    hint = pivot_hint(f"60={seconds:.4f}")
    chosen = options(rig, video=rig / "even.mkv", pivot=hint, expected=N, motion="none", fps=FPS)
    found = import_recording(rig / "lidar.lvx", tmp_path / "run", chosen)
    sync = found.provenance["synchronisation"]
    assert sync["method"] == "pivot"
    assert any("δ_loss" in note for note in sync["notes"])
    near = lidar_of(found.folder)
    near = np.abs(near["time"] - KEPT[60] / FPS) < 0.05
    assert np.abs(time_errors_ms(found.folder)[near]).max() < 1.5e3 / FPS
    assert np.abs(time_errors_ms(found.folder)).max() < 3e3 / FPS
    camera = read_cameras(found.folder / "cameras.json")[0]
    assert not camera.moves
    assert camera.rotation @ [0, 0, 1] == pytest.approx([0, -1, 0], abs=0.02)  # gravity


def test_returns_out_of_view_are_left_out(rig, tmp_path):
    found = import_recording(rig / "rig.bag", tmp_path / "run", options(rig, margin_px=20.0))
    kept = lidar_of(found.folder)
    assert kept["xyz"][:, 1].max() == pytest.approx(0.1)
    assert found.provenance["lidar"]["kept"] < found.provenance["lidar"]["in_time"]


def test_view_and_margin_against_the_projection():
    camera = Camera(
        "c", "pinhole", [[100, 0, 50], [0, 100, 40], [0, 0, 1]], [], np.eye(3), np.zeros(3), (101, 81)
    )
    x = np.array([-0.52, -0.5, 0.0, 0.5, 0.52, 0.0])
    z = np.array([1.0, 1, 1, 1, 1, -1])
    points = np.column_stack([x, 0 * x, z])
    assert in_view(camera, points, 0.0).tolist() == [False, True, True, True, False, False]
    assert in_view(camera, points, 2.0).tolist() == [True] * 5 + [False]


class Shown:
    """Pictures in memory."""

    def __init__(self, frames):
        self.all, self.stamps_ns, self.fps = frames, None, FPS

    def __len__(self):
        return len(self.all)

    def frames(self, start, stop):
        return iter(self.all[start:stop])


def stream(kind, stamps):
    found = StreamScan(kind, kind, "", device=stamps.tolist(), first_ns=int(stamps[0]), spread=True)
    found.n_values = len(stamps)
    return found


def test_a_light_is_found_in_its_region():
    frames = [np.full((40, 60), 90, dtype=np.uint8) for _ in range(50)]
    for picture in frames[31:]:
        picture[10:14, 20:24] = 240
    lidar = stream("lidar", LIDAR_NS + np.arange(40) * 100_000_000)
    inputs = Inputs(lidar, None, None, Shown(frames), 50, (0, 50), pivot=pivot_hint("led:19,9,6,6=2.25"))
    sync = synchronise(inputs).sync
    assert sync.frame_time[31] == pytest.approx(2.25 + 0.5 / FPS)
    assert sync.sd_ms == pytest.approx(1e3 / FPS / np.sqrt(6), rel=1e-3)


def test_a_knock_is_found_in_pictures_and_accelerations():
    rng = np.random.default_rng(0)
    frames = list(pictures())[:60]
    still = frames[0]
    frames = [np.roll(still, 4, axis=0) if n == 35 else still for n in range(60)]  # the picture jolts
    stamps = LIDAR_NS + np.arange(800) * 5_000_000
    force = np.array([0, 0, 9.81]) + 0.02 * rng.normal(size=(800, 3))
    force[500:506, 0] += [6, -5, 4, -3, 2, -1]
    imu = stream("imu", stamps)
    imu.imu = [ImuSamples(stamps, 0 * force, force)]
    lidar = stream("lidar", LIDAR_NS + np.arange(40) * 100_000_000)
    inputs = Inputs(lidar, imu, None, Shown(frames), 60, (0, 60), pivot=pivot_hint("knock"))
    sync = synchronise(inputs).sync
    assert sync.frame_time[35] == pytest.approx(2.4975 + 0.5 / FPS, abs=1e-6)  # between frames, and samples
    assert sync.method == "pivot"


# --- the command ----------------------------------------------------------------------------------------


def command(*arguments):
    app = typer.Typer()
    app.command()(cli_import.import_recording)
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, [str(a) for a in arguments])


def refused(result, *words):
    assert result.exit_code == 2, result.output
    assert result.output.count("error:") == 1
    assert "Traceback" not in result.output
    for word in words:
        assert word in result.output


def test_the_command_says_what_it_did(rig, tmp_path):
    out = tmp_path / "run"
    arguments = (
        rig / "rig.bag", "-o", out, "--calibration", rig / "lidar_camera.json", "--frames", "0:60",
        "--no-pictures", "--motion", "none", "--species", "cheetah",
    )  # fmt: skip
    result = command(*arguments)
    assert result.exit_code == 0, result.output
    for text in ("/livox/imu", "200.0 per second", "damage: none", "synchronised by", "±", "lidar returns"):
        assert text in result.output
    assert "dlc/cam1.csv" in result.output  # what is to be done next: there are no keypoints
    assert read_sequence_file(out / "sequence.yaml").keypoints == {"cam1": str(out / "dlc" / "cam1.csv")}
    before = (out / "import.json").read_bytes()
    refused(command(*arguments), "There is an import already", "--overwrite")
    assert (out / "import.json").read_bytes() == before
    assert command(*arguments, "--overwrite", "-q").exit_code == 0


def test_inspect_lists_streams(rig, tmp_path):
    result = command(rig / "rig.bag", "--inspect")
    assert result.exit_code == 0, result.output
    for text in ("/livox/lidar", "/camera/info", "lidar", "imu", "damage: none"):
        assert text in result.output
    lvx = command(rig / "lidar.lvx", "--inspect")
    assert "lidar0" in lvx.output
    assert "imu0" in lvx.output


def test_a_cut_recording_is_imported_as_far_as_it_goes(rig, tmp_path):
    whole = (rig / "lidar.lvx").read_bytes()
    (tmp_path / "cut.lvx").write_bytes(whole[: int(0.97 * len(whole))])
    hint = pivot_hint("10=0.5")
    chosen = options(rig, video=rig / "cam.mkv", pivot=hint, motion="none")
    found = import_recording(tmp_path / "cut.lvx", tmp_path / "run", chosen)
    assert found.provenance["damage"]["places"] or found.provenance["damage"]["bytes_lost"]
    assert found.provenance["lidar"]["kept"] > 100


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"calibration": None}, ("--calibration",)),
        ({"calibration": "nothing.json"}, ("nothing.json",)),
        ({"keypoints": "nothing.csv"}, ("nothing.csv",)),
        ({"video": "nothing.mp4"}, ("nothing.mp4",)),
        ({"frames": "100:9000"}, ("--frames", "116")),
        ({"frames": "ten"}, ("--frames", "80:190")),
        ({"pivot": "soon"}, ("--pivot", "FRAME=SECONDS")),
        ({"pivot": "9999=1.0"}, ("--pivot", "0 to 115")),
        ({"fps": "-3"}, ("--fps",)),
        ({"lidar-topic": "/livox/ladar"}, ("--lidar-topic", "did you mean '/livox/lidar'")),
        ({"camera-topic": "/webcam"}, ("--camera-topic",)),
        ({"species": "unicorn"}, ("unicorn",)),
    ],
)
def test_wrong_input_is_one_message(rig, tmp_path, monkeypatch, change, words):
    monkeypatch.chdir(tmp_path)
    given = {
        "calibration": rig / "lidar_camera.json",
        "keypoints": rig / "keypoints.csv",
        "frames": None,
    } | change
    arguments = [f"--{key}={value}" for key, value in given.items() if value is not None]
    refused(command(rig / "rig.bag", "-o", "run", "--no-pictures", *arguments), *words)
    assert list(tmp_path.iterdir()) == []


def test_files_that_do_not_belong_together(rig, tmp_path):
    write_deeplabcut_csv(tmp_path / "short.csv", ["nose"], np.ones((100, 1, 2)), np.ones((100, 1)))
    with pytest.raises(InputError, match="another number of frames"):
        import_recording(rig / "rig.bag", tmp_path / "a", options(rig, keypoints=tmp_path / "short.csv"))
    with pytest.raises(InputError, match="no lidar"):
        import_recording(rig / "cam.mkv", tmp_path / "a", options(rig))
    with pytest.raises(InputError, match="no frames"):
        import_recording(rig / "lidar.lvx", tmp_path / "a", options(rig, keypoints=None))
    with pytest.raises(InputError, match="frame rate is not known"):
        import_recording(rig / "lidar.lvx", tmp_path / "a", options(rig))
    with pytest.raises(InputError, match="Nothing tells when"):
        import_recording(rig / "lidar.lvx", tmp_path / "a", options(rig, fps=60.0))
    assert {path.name for path in tmp_path.iterdir()} == {"short.csv"}


def test_a_folder_of_something_else_is_left_alone(rig, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="would be lost"):
        import_recording(rig / "rig.bag", tmp_path, options(rig), overwrite=True)
    assert Path(tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("text", "kind", "seconds"),
    [("12=3.5", "frame", 3.5), ("led:1,2,3,4=5s", "led", 5.0), ("Knock", "knock", 0.0)],
)
def test_pivots_are_read(text, kind, seconds):
    hint = pivot_hint(text)
    assert (hint.kind, hint.seconds) == (kind, seconds)


# --- clocks ---------------------------------------------------------------------------------------------


def stamped(kind, at, late, drift=0.0, seed=0):
    """Messages at s since frame 0, by a clock that drifts, received later by `late` + 1 ms on average."""
    rng = np.random.default_rng([seed, len(kind)])
    found = stream(kind, LIDAR_NS + np.rint((1 + drift) * at * 1e9).astype(np.int64))
    found.received = (UNIX + np.rint((at + late + 1e-3 * rng.exponential(size=len(at))) * 1e9)).tolist()
    return found


def test_the_inertial_sensor_makes_the_lidars_clock_surer():
    """Their clock is one: two seconds of ten messages of the lidar, and of two hundred of the other."""
    probe = LIDAR_NS + np.arange(0, 2_000_000_000, 100_000_000)
    errors, stated = [], []
    for seed in range(8):
        lidar = stamped("lidar", np.arange(0.1, 2, 0.1), LATE_LIDAR, -15e-6, seed)
        imu = stamped("imu", np.arange(-4, 2, 0.005), LATE_LIDAR, -15e-6, seed)
        row = []
        for other in (None, imu):
            clock, _, _ = device_clocks(lidar, other)
            true = UNIX + round(1e9 * LATE_LIDAR) + (probe - LIDAR_NS) * (1 + 15e-6)
            row.append(np.sqrt(np.mean((1e-6 * (clock.to_computer_ns(probe) - true)) ** 2)))
        errors.append(row)
        stated.append(clock.sd_ms)
    alone, both = np.sqrt(np.mean(np.square(errors), axis=0))
    assert both < alone / 20
    assert both < 2 * np.mean(stated) < 0.02


def test_clocks_of_two_devices_stay_apart():
    """Their stamps overlap by chance; what they show at one time differs by two seconds."""
    lidar = stamped("lidar", np.arange(0.1, 20, 0.1), LATE_LIDAR)
    imu = stamped("imu", np.arange(0, 20, 0.005), LATE_LIDAR)
    imu.device = [one + 2_000_000_000 for one in imu.device]
    clock, other, _ = device_clocks(lidar, imu)
    at = np.array([LIDAR_NS + 5_000_000_000])
    assert (clock.to_computer_ns(at) - other.to_computer_ns(at))[0] == pytest.approx(2e9, rel=1e-3)
