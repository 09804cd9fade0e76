"""What the simulated rig writes: the sequence folder, LVX, bags, videos, pictures; and the command."""

import json
import shlex

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from acino_fte.data_tools.imu_table import read_imu_table
from acino_fte.data_tools.lidar_camera import read_lidar_camera
from acino_fte.data_tools.load import load_sequence
from acino_fte.data_tools.lvx import LvxReader
from acino_fte.data_tools.recording import GRAVITY
from acino_fte.data_tools.rotations import rotation_vector
from acino_fte.errors import InputError
from acino_fte.rig_files import write_rig_simulation
from acino_fte.rig_options import RigOptions
from acino_fte.rig_pictures import render_pictures, small_camera
from acino_fte.rig_recording import ENCODER_COUNTS, picture_info, raw_imu, raw_returns
from acino_fte.simulate_rig import RigSimulation, rig_to_sequence, simulate_rig

OPTIONS = RigOptions(n_frames=12, drops=0.2, bushes=15, rest_s=0.5, seed=2)
WIDTH = 192


@pytest.fixture(scope="module")
def simulation() -> RigSimulation:
    made = simulate_rig(OPTIONS)
    assert 1 <= made.stamps.dropped.sum() <= 5
    return made


@pytest.fixture(scope="module")
def folder(simulation, tmp_path_factory):
    """A folder with an LVX file and a video."""
    out = tmp_path_factory.mktemp("rig") / "hunt"
    return write_rig_simulation(simulation, out, recording="lvx", video="mkv", picture_width=WIDTH)


@pytest.fixture(scope="module")
def run():
    """Run the command; returns its result."""
    import typer

    from acino_fte.cli_simulate_rig import simulate_rig as command

    app = typer.Typer()
    app.command()(command)
    return lambda *arguments: CliRunner().invoke(app, [str(a) for a in arguments])


def test_the_folder_is_read_back_as_it_is_in_memory(folder, simulation):
    read, made = load_sequence(folder), rig_to_sequence(simulation)
    assert read.name == "hunt"
    assert read.species == "cheetah"
    assert read.cameras[0].matrix == pytest.approx(made.cameras[0].matrix)
    assert read.cameras[0].rotation == pytest.approx(made.cameras[0].rotation, abs=1e-12)
    assert read.truth.values == pytest.approx(made.truth.values, abs=1e-5)
    position = read.detections.position.sel(marker=made.markers).values
    assert position == pytest.approx(made.detections.position.values, abs=1e-3, nan_ok=True)
    assert read.lidar.time == pytest.approx(made.lidar.time, abs=1e-9)
    assert read.lidar.xyz == pytest.approx(made.lidar.xyz, abs=1e-5)
    assert read.lidar.rotation == pytest.approx(made.lidar.rotation, abs=1e-12)
    assert read.lidar.translation == pytest.approx(made.lidar.translation, abs=1e-12)
    assert (read.lidar.range_sd, read.lidar.time_sd) == pytest.approx((0.02, 0.0005))


def test_calibration_imu_frames_and_truth_are_beside_it(folder, simulation):
    calibration = read_lidar_camera(folder / "lidar_camera.json")
    assert calibration.lidar_to_camera[:3, :3] == pytest.approx(simulation.lidar_to_camera[0])
    imu = read_imu_table(folder / "imu.csv")
    assert np.array_equal(imu.time_ns, simulation.imu.time_ns)
    assert imu.rate == pytest.approx(simulation.imu.rate, abs=1e-8)
    assert imu.force == pytest.approx(simulation.imu.force, abs=1e-7)
    frames = pd.read_csv(folder / "frames.csv")
    assert frames.camera_ns.tolist() == simulation.stamps.camera_ns.tolist()
    assert frames.dropped.astype(bool).tolist() == simulation.stamps.dropped.tolist()
    truth = np.load(folder / "truth_lidar.npz", allow_pickle=False)
    assert np.array_equal(truth["on_body"], simulation.returns.on_body)
    rig = json.loads((folder / "truth_rig.json").read_text())
    assert rig["imu_bias"] == simulation.imu_bias
    assert len(rig["camera"]["rotation"]) == 12
    states = pd.read_csv(folder / "truth_states.csv")
    assert states.iloc[:, 1:].to_numpy() == pytest.approx(simulation.q, abs=1e-6)


def test_lvx_holds_every_return_and_sample_in_the_lidars_clock(folder, simulation):
    with LvxReader(folder / "recording" / "rig.lvx") as reader:
        records = list(reader.records())
        assert reader.damage.whole
    lidar = [r.value for r in records if r.kind == "lidar"]
    time, xyz, line = (np.concatenate([getattr(v, k) for v in lidar]) for k in ("time_ns", "xyz", "line"))
    made = raw_returns(simulation)
    assert np.array_equal(time, made.time_ns)
    assert xyz == pytest.approx(made.xyz, abs=0.5001e-3)  # the file counts millimetres
    assert np.array_equal(line, made.line)
    force = np.concatenate([r.value.force for r in records if r.kind == "imu"])
    assert force == pytest.approx(simulation.imu.force, abs=1e-5)
    drift = np.polyfit(simulation.returns.time, 1e-9 * (time - time[0]), 1)[0] - 1.0
    assert drift == pytest.approx(-15e-6, abs=1e-8)


def test_the_video_has_the_recorded_frames_with_their_stamps(folder, simulation):
    video = pytest.importorskip("acino_fte.data_tools.video")
    with video.VideoReader(folder / "recording" / "cam1.mkv") as reader:
        pictures = [record.value for record in reader.records()]
    kept = ~simulation.stamps.dropped
    assert len(pictures) == kept.sum()
    stamps = simulation.stamps.camera_ns[kept] - simulation.stamps.camera_ns[0]
    assert [p.time_ns for p in pictures] == pytest.approx(stamps, abs=0.6e6)  # mkv counts ms
    rows = pd.read_csv(folder / "recording" / "keypoints.csv", header=[0, 1, 2])
    assert len(rows) == kept.sum()
    made = next(render_pictures(simulation, WIDTH))
    assert pictures[0].pixels.shape == made.shape
    assert np.abs(pictures[0].pixels.astype(float) - made).mean() < 12  # what compression leaves


@pytest.mark.parametrize("kind", ["pseudo", "none"])
def test_lvx_of_pseudo_returns_and_of_none(kind, tmp_path):
    simulation = simulate_rig(RigOptions(n_frames=3, rest_s=0.1, lidar=kind))
    out = write_rig_simulation(simulation, tmp_path / "x", recording="lvx")
    with LvxReader(out / "recording" / "rig.lvx") as reader:
        values = [r.value for r in reader.records()]
    lidar = [v for v in values if not hasattr(v, "rate")]
    assert sum(map(len, values)) - sum(map(len, lidar)) == len(simulation.imu)
    if kind == "none":
        assert not lidar
        assert load_sequence(out).lidar is None
    else:
        assert np.concatenate([v.xyz for v in lidar]) == pytest.approx(simulation.returns.xyz, abs=0.5001e-3)
        late = np.concatenate([v.time_ns for v in lidar]) - raw_returns(simulation).time_ns
        assert (late == 0).all()


@pytest.mark.parametrize(("recording", "name"), [("bag1", "rig.bag"), ("bag2", "rig_ros2")])
def test_bags_hold_what_the_rig_saw_in_the_order_of_reception(recording, name, simulation, tmp_path):
    bags = pytest.importorskip("acino_fte.data_tools.bags")
    out = write_rig_simulation(simulation, tmp_path / "x", recording=recording, picture_width=WIDTH)
    with bags.BagReader(out / "recording" / name) as reader:
        records = list(reader.records())
        assert reader.damage.whole
    by_topic = {s: [r for r in records if r.stream == s] for s in {r.stream for r in records}}
    assert set(by_topic) == {"/livox/lidar", "/livox/imu", "/camera/image", "/camera/info"}
    made = raw_returns(simulation)
    time = np.concatenate([r.value.time_ns for r in by_topic["/livox/lidar"]])
    xyz = np.concatenate([r.value.xyz for r in by_topic["/livox/lidar"]])
    assert np.array_equal(time, made.time_ns)
    assert xyz == pytest.approx(made.xyz, abs=1e-4)
    assert len(by_topic["/livox/imu"]) == len(raw_imu(simulation))
    assert np.linalg.norm(by_topic["/livox/imu"][0].value.force) == pytest.approx(GRAVITY, abs=0.2)
    kept = np.flatnonzero(~simulation.stamps.dropped)
    assert [r.value.number for r in by_topic["/camera/info"]] == simulation.stamps.number[kept].tolist()
    received = [r.received_ns for r in records]
    assert received == sorted(received)
    assert [r.received_ns for r in by_topic["/camera/image"]] == simulation.stamps.received_ns[kept].tolist()


def test_encoders_count_pan_and_tilt(simulation):
    counts = np.array([picture_info(simulation, n).encoders[2:] for n in (0, 11)])
    pan, tilt = ((counts - ENCODER_COUNTS / 2) / ENCODER_COUNTS * 2 * np.pi).T
    forward = np.stack([np.sin(pan) * np.cos(tilt), np.cos(pan) * np.cos(tilt), np.sin(tilt)], axis=1)
    assert forward == pytest.approx(simulation.true_camera.rotation[[0, 11], 2], abs=1e-5)


def test_the_landscape_pans_by_the_homography_of_the_rotation(simulation):
    cv2 = pytest.importorskip("cv2")
    pictures = list(render_pictures(simulation, 384))
    camera = small_camera(simulation.true_camera, 384)
    k, (first, last) = camera.matrix, camera.rotation[[0, 11]]
    warp = k @ last @ first.T @ np.linalg.inv(k)
    size = pictures[0].shape[1::-1]
    moved = cv2.warpPerspective(pictures[0], warp, size).astype(float)
    there = cv2.warpPerspective(np.full(size[::-1], 255, np.uint8), warp, size) > 254
    animal = np.zeros_like(there)
    for n, matrix in ((0, warp), (11, np.eye(3))):
        dots = camera.at_frames(slice(n, n + 1)).project(simulation.positions[n : n + 1])[0]
        dots = cv2.perspectiveTransform(dots[None], matrix)[0]
        low, high = (dots.min(axis=0) - 15).astype(int), (dots.max(axis=0) + 15).astype(int)
        animal[low[1] : high[1], low[0] : high[0]] = True
    chosen = there & ~animal
    assert chosen.mean() > 0.3
    error = np.abs(moved - pictures[11])[chosen].mean()
    unmoved = np.abs(pictures[0].astype(float) - pictures[11])[chosen].mean()
    assert error < 0.25 * unmoved


def test_odometry_finds_the_pan_in_the_pictures(simulation):
    pytest.importorskip("cv2")
    from acino_fte.data_tools.odometry import visual_odometry
    from acino_fte.data_tools.odometry_features import keypoint_boxes

    camera, frames = small_camera(simulation.true_camera, 384), np.array([0, 5, 11])
    pictures = [p for n, p in enumerate(render_pictures(simulation, 384)) if n in frames]
    boxes = keypoint_boxes(camera.project(simulation.positions)[frames])
    found = visual_odometry(pictures, camera.at_frames(slice(0, 1)), model="rotation", boxes=boxes)
    turn = found.rotation[-1] @ found.rotation[0].T
    true = camera.rotation[11] @ camera.rotation[0].T
    assert np.degrees(np.linalg.norm(rotation_vector(true))) > 1.0
    assert np.degrees(np.linalg.norm(rotation_vector(turn @ true.T))) < 0.01


def test_the_animal_is_drawn_where_the_detector_sees_it(simulation):
    small = small_camera(simulation.true_camera, 384)
    picture = next(render_pictures(simulation, 384)).astype(float)
    dots = small.at_frames(slice(0, 1)).project(simulation.positions[:1])[0]
    full = simulation.pixels[0]
    assert dots + 0.5 == pytest.approx((full + 0.5) * 384 / 2048, abs=1e-6)  # centres at integers
    u, v = np.round(dots).astype(int).T
    warm = picture[..., 0] - picture[..., 2]  # red before blue: a coat, not leaves
    assert np.median(warm[v, u]) > np.median(warm) + 30


def test_the_command_writes_a_folder_and_says_how_to_make_it_again(run, tmp_path):
    arguments = ["--frames", 4, "--lidar", "pseudo", "--fixed", "--noise-px", "species"]
    arguments += ["--range-noise", 0.03, "--rest-s", 0.2, "--width", 852]
    result = run(tmp_path / "a", *arguments)
    assert result.exit_code == 0, result.output
    made = json.loads((tmp_path / "a" / "simulation.json").read_text())
    assert made["options"]["range_noise_m"] == 0.03
    assert made["options"]["pan"] is False
    parts = shlex.split(made["command"])
    assert parts[:2] == ["python", "scripts/simulate_rig.py"]
    assert run(tmp_path / "b", *parts[3:]).exit_code == 0
    for file in ("lidar.npz", "imu.csv", "dlc/cam1.csv", "cameras.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_wrong_input_is_told_and_nothing_is_written(run, simulation, tmp_path):
    result = run(tmp_path / "x", "--species", "cheeta", "--frames", 2)
    assert result.exit_code == 2
    assert "did you mean 'cheetah'" in result.output
    assert run(tmp_path / "x", "--noise-px", "much").exit_code == 2
    assert run(tmp_path / "x", "--picture-width", 1_000_000).exit_code == 2
    assert run(tmp_path / "x", "--motion", "fly", "--frames", 2).exit_code == 2
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").write_text("keep")
    with pytest.raises(InputError, match="left alone"):
        write_rig_simulation(simulation, mine, overwrite=True)
    result = run(tmp_path / "x", "--points-per-second", 100_000, "--frames", 2, "--recording", "lvx")
    assert result.exit_code == 2
    assert "record a bag" in result.output
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine"]
