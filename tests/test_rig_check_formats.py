"""Checks of what other recorders wrote: LVX, bags, eCAL, videos; whole, faulty and damaged."""

import numpy as np
import pytest

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
pytest.importorskip("av")

from rig_check_folders import IMU, INFO, POINTS, START, Faults, picture, rig_messages

from acino_fte.data_tools.bags_write import BagWriter
from acino_fte.data_tools.lvx_packets import LvxDevice
from acino_fte.data_tools.lvx_write import LvxWriter
from acino_fte.data_tools.recording import ImuSamples, LidarReturns, Picture
from acino_fte.data_tools.video import write_video
from acino_fte.rig.check import check_recording

STEP = 4167
BEGIN = 1_000_000_000


def write_bag(path, faults=None, seconds=8.0, **options):
    """What a rig without this recorder leaves: received by the wall clock, pictures inside."""
    with BagWriter(path, **options) as writer:
        for topic, _, value, wall in rig_messages(faults or Faults(), seconds):
            writer.write(topic, value, wall)
            if topic == INFO and value.number % 3 == 0:
                writer.write("/cam1/image", Picture(value.time_ns, picture(value.number)), wall, form="raw")
    return path


def write_lvx(path, version="1.1", n_frames=20, silent=(), **options):
    """Frames of 20 ms of a Tele-15 without a sky, and its inertial sensor at 200 Hz."""
    n = 4800
    with LvxWriter(path, [LvxDevice(0, "3GGDJ6K00100101", 2)], version=version, **options) as writer:
        for i in range(n_frames):
            time = BEGIN + (i * n + np.arange(n)) * STEP
            xyz = np.column_stack([np.full(n, 20.0), np.linspace(-1, 1, n), np.ones(n)])
            zeros = np.zeros(n, np.uint8)
            frame = {"lidar0": LidarReturns(time, xyz, np.full(n, 20.0), zeros, zeros, "power_on")}
            times = BEGIN + i * 20_000_000 + np.arange(4) * 5_000_000
            if i not in silent:
                force = np.tile([0.0, 0.0, 9.8], (4, 1))
                frame["imu0"] = ImuSamples(times, np.zeros((4, 3)), force, "power_on")
            writer.write(frame)
    return path


def verdicts(check):
    return {(one.name, one.subject): one.verdict for one in check.requirements}


FAULTS = Faults(
    stalls={INFO: (2.0, 1.0)},
    wall_jumps=((5.0, 5.0),),
    lost_frames=(20,),
    twice={IMU: 300},
    drift={IMU: -40e-6},
)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.bag", {"version": 1, "compression": "lz4"}),
        ("ros2", {"version": 2}),
        ("mcap", {"version": 2, "storage": "mcap"}),
    ],
)
def test_faults_in_a_bag(tmp_path, name, options):
    check = check_recording(write_bag(tmp_path / name, FAULTS, **options))
    streams = check.found.streams
    found = [(gap.lost, round(gap.seconds, 2)) for gap in streams[INFO].gaps]
    assert found == [(1, 0.03), (30, 1.0)]
    assert (streams[INFO].gaps[1].start_ns - START) * 1e-9 == pytest.approx(2.0, abs=0.04)
    assert streams[IMU].lost == streams[POINTS].lost == 0 and streams[IMU].duplicates == 1
    assert streams[IMU].drift_ppm == pytest.approx(-40, abs=5 * streams[IMU].drift_sd_ppm)
    for stream in (streams[IMU], streams[POINTS]):
        (jump,) = stream.jumps
        assert (jump.clock, round(jump.seconds, 2)) == ("computer", 5.0)
        assert (jump.time_ns - START) * 1e-9 == pytest.approx(10.0, abs=0.1)  # by the clock that jumped
    clocks = [one for one in check.requirements if one.name == "clock jumps"]
    assert [(one.subject, one.found) for one in clocks] == [("the computer's clock", "+5.000 s (1 in all)")]
    assert check.unexplained == () and check.verdict == "fail"


def test_nothing_is_found_in_a_clean_bag(tmp_path):
    check = check_recording(write_bag(tmp_path / "a.bag", seconds=4.0))
    assert check.verdict == "pass", [one for one in check.requirements if one.verdict != "pass"]
    assert check.found.cameras[INFO].pictures == 8  # two a second


def test_a_cut_bag(tmp_path):
    path = write_bag(tmp_path / "a.bag", seconds=3.0)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    check = check_recording(path)
    assert verdicts(check)["readable", "the files"] in ("warn", "fail")
    assert check.found.streams[IMU].count > 50 and check.found.streams[IMU].lost == 0


@pytest.mark.parametrize("version", ["1.0", "1.1", "2"])
def test_lost_datagrams_and_warnings_of_a_lidar(tmp_path, version):
    def error(device, package):
        return 2 << 30 if package in (300, 301) else 1 << 6 if package == 500 else 0

    options = {} if version == "2" else {"error": error}
    path = write_lvx(
        tmp_path / "a.lvx", version, silent=(10, 11), drop=lambda d, n: 200 <= n < 205 or n == 700, **options
    )
    check = check_recording(path)
    lidar, imu = check.found.streams["lidar0"], check.found.streams["imu0"]
    package = (100 if version == "1.0" else 96) * STEP
    assert [(gap.lost, gap.start_ns, round(gap.seconds * 1e9)) for gap in lidar.gaps] == [
        (5, BEGIN + 200 * package, 5 * package),
        (1, BEGIN + 700 * package, package),
    ]
    assert [(gap.lost, gap.start_ns - BEGIN, gap.seconds) for gap in imu.gaps] == [
        (8, 200_000_000, pytest.approx(0.04))
    ]
    assert check.found.base == "device" and check.found.damage.whole
    health = [(one.verdict, one.found) for one in check.requirements if one.name == "health"]
    assert len(health) == (0 if version == "2" else 2)  # LVX2 has no codes
    if version != "2":
        assert health[0][0] == "fail" and "error, in 2 packages from 0.12 s" in health[0][1].replace(
            "0.13", "0.12"
        )
        assert health[1][0] == "warn" and "window" in health[1][1]


def test_nothing_is_found_in_a_clean_lvx(tmp_path):
    check = check_recording(write_lvx(tmp_path / "a.lvx"))
    assert check.verdict == "pass", [one for one in check.requirements if one.verdict != "pass"]
    assert check.found.streams["lidar0"].count == 1000 and check.found.streams["imu0"].count == 80
    assert verdicts(check)["health", "lidar0"] == "pass"


def test_a_damaged_lvx(tmp_path):
    path = write_lvx(tmp_path / "a.lvx")
    data = bytearray(path.read_bytes())
    data[500_000:503_000] = bytes(3_000)
    path.write_bytes(data)
    check = check_recording(path)
    assert verdicts(check)["readable", "the files"] == "warn"
    assert 2 <= check.found.streams["lidar0"].lost <= 4
    assert not any("datagrams" in place for place in check.found.damage.places)  # they are counted once


@pytest.mark.parametrize("every", [False, True])
def test_a_video_with_a_gap(tmp_path, every):
    path = tmp_path / "a.mkv"
    stamps = [round((i + (30 if i >= 40 else 0)) * 1e9 / 30) for i in range(90)]
    write_video(path, (picture(i) for i in range(90)), 30.0, stamps, "ffv1")
    check = check_recording(path, every_frame=every)
    (gap,) = check.found.streams["video0"].gaps
    assert (gap.lost, gap.seconds) == (30, pytest.approx(1.0, abs=2e-3))
    assert gap.start_ns * 1e-9 == pytest.approx(40 / 30, abs=2e-3)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    check = check_recording(path, every_frame=every)
    assert verdicts(check)["readable", "the files"] == "warn"
    assert 40 < check.found.streams["video0"].count < 90


def test_recordings_of_ecal(tmp_path):
    """rosbag2 under eCAL writes a layout of its own."""
    path = write_bag(tmp_path / "ecal", FAULTS, seconds=4.0, version=2, serialization="custom")
    check = check_recording(path)
    assert [gap.lost for gap in check.found.streams[INFO].gaps] == [1, 30]
