"""LVX files: every version and data type there and back, and against bytes put together by hand."""

import struct
from datetime import UTC, datetime

import numpy as np
import pytest
from data_tools_synthetic import message
from lvx_synthetic import CODE, DEVICE, SIZES, START, STEP, chosen, collected, frames, packages, recording
from scipy.spatial.transform import Rotation

from acino_fte.data_tools.lvx import LvxReader
from acino_fte.data_tools.lvx_packets import LAYOUTS, LvxDevice, decode_stamps, encode_stamps
from acino_fte.data_tools.lvx_write import LvxWriter, write_lvx
from acino_fte.data_tools.open_recording import recording_kind
from acino_fte.data_tools.recording import GRAVITY, ImuSamples, LidarReturns
from acino_fte.errors import InputError

TYPES = [("1.1", kind) for kind in (0, 1, 2, 3, 4, 5, 7, 8)] + [("1.0", 0), ("2", 1), ("2", 2), ("2", 3)]


def joined(values, name):
    return np.concatenate([getattr(value, name) for value in values])


def head(version=(1, 1, 0, 0), devices=1, magic=0xAC0EA767, duration=50) -> bytes:
    """The head of an LVX 1.1 file with one Tele-15 a device, by hand."""
    out = b"livox_tech".ljust(16, b"\0") + bytes(version) + struct.pack("<IIB", magic, duration, devices)
    for index in range(devices):
        code = f"3GGDJ6K0010010{index}".encode().ljust(16, b"\0")
        out += code + bytes(16) + struct.pack("<BBB6f", index, 2, 1, 90.0, 0, -30.0, 1, 2, 3)
    return out


def package(kind, stamp, points, device=0, clock=0, version=5, error=0) -> bytes:
    data = struct.pack("<BBBBBIBB", device, version, 1, 1, 0, error, clock, kind)
    data += stamp if isinstance(stamp, bytes) else struct.pack("<Q", stamp)
    return (data + points).ljust(SIZES[kind], b"\0")


def in_frames(start: bytes, *bodies: bytes, wrong=()) -> bytes:
    """Frames of an LVX 1.1 file; those in `wrong` have wrong offsets."""
    out = start
    for index, body in enumerate(bodies):
        at = len(out) + (1000 if index in wrong else 0)
        out += struct.pack("<QQQ", at, at + 24 + len(body), index) + body
    return out


def read(path, data: bytes):
    path.write_bytes(data)
    reader = LvxReader(path)
    return reader, list(reader.records())


# ---------------------------------------------------------------------------------- whole files


@pytest.mark.parametrize(("version", "data_type"), TYPES)
def test_what_is_written_is_read(tmp_path, version, data_type):
    true = frames(version, data_type, n_frames=3, per=3)
    write_lvx(tmp_path / "a.lvx", [DEVICE], true, version=version, data_type=data_type)
    reader = LvxReader(tmp_path / "a.lvx")
    got = collected(reader)
    lidar = [frame["lidar0"] for frame in true]
    kind = LAYOUTS[version].kinds[data_type]
    xyz, want = got["lidar0"]["xyz"], joined(lidar, "xyz")
    if kind.form == "spherical":  # hundredths of a degree, mm
        distance = np.linalg.norm(want, axis=1)
        np.testing.assert_allclose(np.linalg.norm(xyz, axis=1), distance, atol=0.00051)
        assert (np.linalg.norm(xyz - want, axis=1) < distance * np.radians(0.0072) + 0.001).all()
    else:
        np.testing.assert_allclose(xyz, want, atol=1e-5 if version == "1.0" else 0.51 * kind.unit)
    np.testing.assert_array_equal(got["lidar0"]["time_ns"], joined(lidar, "time_ns"))
    np.testing.assert_array_equal(got["lidar0"]["intensity"], joined(lidar, "intensity"))
    tag = joined(lidar, "tag") if kind.tag else np.zeros(len(xyz))
    np.testing.assert_array_equal(got["lidar0"]["tag"], tag)
    sample = (got["lidar0"]["time_ns"] - START) // STEP % kind.samples
    np.testing.assert_array_equal(got["lidar0"]["line"], sample % 6)
    if version != "1.0":
        imu = [frame["imu0"] for frame in true]
        np.testing.assert_array_equal(got["imu0"]["time_ns"], joined(imu, "time_ns"))
        np.testing.assert_allclose(got["imu0"]["rate"], joined(imu, "rate"), rtol=1e-6)
        np.testing.assert_allclose(got["imu0"]["force"], joined(imu, "force"), rtol=1e-6)
    assert reader.version == version and reader.damage.whole and reader.notes == ()
    assert reader.damage.n_read == len(packages((tmp_path / "a.lvx").read_bytes(), version))


def test_sizes_are_those_of_the_format():
    layout = LAYOUTS["1.1"]
    assert {kind: layout.package(kind).itemsize for kind in layout.kinds} == SIZES
    assert [LAYOUTS[v].device.itemsize for v in ("1.0", "1.1", "2")] == [58, 59, 63]
    assert [LAYOUTS[v].data_start(1) for v in ("1.0", "1.1", "2")] == [83, 88, 92]
    assert [LAYOUTS["2"].package(k, 96).itemsize - 27 for k in (1, 2)] == [96 * 14, 96 * 8]


def test_bytes_put_together_by_hand(tmp_path):
    """Cartesian mm, spherical angles, two returns of one sample, and 1 g at rest."""
    cartesian = (
        struct.pack("<iiiBB", 1500, -250, 90_000, 151, 0x10)
        + bytes(14)
        + struct.pack("<iiiBB", 1, 2, 3, 4, 5)
    )
    spherical = struct.pack("<IHHB", 10_000, 9_000, 9_000, 7) + struct.pack("<IHHB", 4_000, 0, 27_000, 8)
    dual = struct.pack("<HHIBBIBB", 9_000, 18_000, 5_000, 1, 0, 6_000, 2, 16)
    imu = struct.pack("<6f", 0.1, -0.2, 0.3, 0, 0, 1)
    body = package(2, 5_000, cartesian) + package(6, 6_000, imu)
    data = in_frames(head(), body, package(1, 405_032, spherical, device=0), package(5, 821_732, dual))
    reader, records = read(tmp_path / "a.lvx", data)
    assert [(r.stream, r.kind, len(r.value), r.received_ns) for r in records] == [
        ("lidar0", "lidar", 2, None),
        ("imu0", "imu", 1, None),
        ("lidar0", "lidar", 2, None),
        ("lidar0", "lidar", 2, None),
    ]
    first = records[0].value
    np.testing.assert_allclose(first.xyz, [[1.5, -0.25, 90], [0.001, 0.002, 0.003]])
    np.testing.assert_array_equal(first.time_ns, [5_000, 5_000 + 2 * 4_167])
    assert (first.intensity[0], first.tag[0], first.line[1], first.clock) == (151, 0x10, 2, "power_on")
    np.testing.assert_allclose(records[1].value.force, [[0, 0, GRAVITY]])
    np.testing.assert_allclose(records[1].value.rate, [[0.1, -0.2, 0.3]], rtol=1e-6)
    np.testing.assert_allclose(records[2].value.xyz, [[0, 10, 0], [0, 0, 4]], atol=1e-12)
    np.testing.assert_allclose(records[3].value.xyz, [[-5, 0, 0], [-6, 0, 0]], atol=1e-12)
    assert records[3].value.time_ns.tolist() == [821_732] * 2 and records[3].value.tag.tolist() == [0, 16]
    device = reader.devices[0]
    assert (device.code, device.type_name, device.extrinsics_enabled) == ("3GGDJ6K00100100", "Tele-15", True)
    assert device.translation == (1, 2, 3)
    expected = Rotation.from_euler("ZYX", [-30, 0, 90], degrees=True).as_matrix()
    np.testing.assert_allclose(device.rotation, expected, atol=1e-12)


def test_floats_of_version_one(tmp_path):
    """LVX 1.0: frame headers of 32 bytes, positions in m as floats."""
    points = struct.pack("<fffB", 1.25, -2.5, 40.0, 9)
    start = b"livox_tech".ljust(16, b"\0") + bytes((1, 0, 0, 0)) + struct.pack("<IB", 0xAC0EA767, 1)
    start += CODE.encode().ljust(16, b"\0") + bytes(16) + struct.pack("<BB6f", 0, 1, *[0.0] * 6)
    body = package(0, 77, points)
    data = start + struct.pack("<QQQQ", 83, 83 + 32 + len(body), 0, 1) + body
    reader, records = read(tmp_path / "a.lvx", data)
    np.testing.assert_array_equal(records[0].value.xyz, [[1.25, -2.5, 40]])
    assert reader.version == "1.0" and reader.devices[0].type_name == "Mid-40" and reader.damage.whole


@pytest.mark.parametrize(("kind", "step"), [(1, 10_000), (2, 4_167), (3, 4_167), (6, 10_000), (7, 4_167)])
def test_step_by_type_of_device(tmp_path, kind, step):
    true = LidarReturns(
        START + step * np.arange(300), np.ones((300, 3)), np.ones(300), *np.zeros((2, 300), "u1")
    )
    write_lvx(tmp_path / "a.lvx", [LvxDevice(0, CODE, kind)], [{"lidar0": true}])
    np.testing.assert_array_equal(collected(LvxReader(tmp_path / "a.lvx"))["lidar0"]["time_ns"], true.time_ns)


def test_step_of_an_unknown_device_is_estimated(tmp_path):
    true = LidarReturns(
        START + 5_000 * np.arange(960), np.ones((960, 3)), np.ones(960), *np.zeros((2, 960), "u1")
    )
    write_lvx(tmp_path / "a.lvx", [LvxDevice(0, CODE, 77)], [{"lidar0": true}], sample_ns=5_000)
    reader = LvxReader(tmp_path / "a.lvx")
    np.testing.assert_array_equal(collected(reader)["lidar0"]["time_ns"], true.time_ns)
    assert reader.damage.whole


def test_streams_devices_and_choice(tmp_path):
    """Two lidars in one file; only what is asked for is given."""
    true = frames(n_frames=3, per=2)
    both = [frame | {"lidar1": frame["lidar0"], "imu1": frame["imu0"]} for frame in true]
    write_lvx(tmp_path / "a.lvx", [DEVICE, LvxDevice(1, "B", 7)], both)
    reader = LvxReader(tmp_path / "a.lvx")
    assert [(s.name, s.kind, s.type) for s in reader.streams] == [
        ("lidar0", "lidar", "livox/cartesian"),
        ("lidar1", "lidar", "livox/cartesian"),
        ("imu0", "imu", "livox/imu"),
        ("imu1", "imu", "livox/imu"),
    ]
    assert [d.type_name for d in reader.devices] == ["Tele-15", "Avia"]
    with reader as opened:
        assert {r.stream for r in opened.records(kinds={"imu"})} == {"imu0", "imu1"}
        assert [r.stream for r in opened.records(streams={"lidar1"})] == ["lidar1"] * 3
        assert len(list(opened.records(kinds={"image"}))) == 0
    assert reader.damage.whole and reader.damage.n_read == 2 * (6 + 3)
    again = collected(reader)
    np.testing.assert_array_equal(again["lidar1"]["xyz"], again["lidar0"]["xyz"])


# ---------------------------------------------------------------------------------- clocks


@pytest.mark.parametrize(
    ("clock", "named"), [("ptp", "ptp"), ("gps", "gps"), ("pps", "pps"), ("unix", "ptp")]
)
def test_clocks(tmp_path, clock, named):
    true = frames(n_frames=3, per=2, clock=clock, start=1_700_000_000_000_000_000)
    write_lvx(tmp_path / "a.lvx", [DEVICE], true)
    record = next(LvxReader(tmp_path / "a.lvx").records())
    offset = record.value.time_ns - true[0]["lidar0"].time_ns
    assert record.value.clock == named
    assert np.abs(offset % 1_000_000_000 if clock == "pps" else offset).max() < (
        1_000 if clock == "gps" else 1
    )


def test_dates_of_gps(tmp_path):
    """Year, month, day, hour and microseconds, against the calendar of Python; over a leap day too."""
    for date in [(2024, 2, 29, 23, 59, 59), (2022, 1, 1, 0, 0, 0), (2031, 12, 31, 12, 1, 7)]:
        seconds = int(datetime(*date, tzinfo=UTC).timestamp())
        micros = (date[4] * 60 + date[5]) * 1_000_000 + 250
        stamp = struct.pack("<BBBBI", date[0] - 2000, *date[1:4], micros)
        packed = np.frombuffer(stamp, "<u8")
        time = seconds * 10**9 + 250_000
        assert decode_stamps(packed, "gps", "1.1")[0] == time
        assert encode_stamps(np.array([time]), "gps", "1.1")[0] == packed[0]
        body = package(2, stamp, struct.pack("<iii", 1, 1, 1), clock=3)
        _, records = read(tmp_path / "a.lvx", in_frames(head(), body))
        assert (records[0].value.time_ns[0], records[0].value.clock) == (time, "gps")


def test_pulses_count_on_over_the_second(tmp_path):
    stamps = 999_000_000 + 400_032 * np.arange(8)
    bodies = [package(2, int(stamp % 10**9), struct.pack("<iii", 1, 1, 1), clock=4) for stamp in stamps]
    imu = [package(6, int((stamps[i] + 5) % 10**9), bytes(24), clock=4) for i in (0, 7)]
    reader, records = read(
        tmp_path / "a.lvx", in_frames(head(), *bodies[:3], bodies[3] + imu[0], *bodies[4:], imu[1])
    )
    lidar = [int(r.value.time_ns[0]) for r in records if r.kind == "lidar"]
    np.testing.assert_array_equal(lidar, stamps)
    assert [int(r.value.time_ns[0]) for r in records if r.kind == "imu"] == [stamps[0] + 5, stamps[7] + 5]


# ---------------------------------------------------------------------------------- traps


def test_the_duration_of_frames_is_not_believed(tmp_path):
    """The header says 50 ms, or nothing: the times are those of the stamps."""
    data = recording(tmp_path / "a.lvx")
    first = collected(LvxReader(tmp_path / "a.lvx"))["lidar0"]["time_ns"]
    (tmp_path / "a.lvx").write_bytes(data[:24] + struct.pack("<I", 0) + data[28:])
    np.testing.assert_array_equal(collected(LvxReader(tmp_path / "a.lvx"))["lidar0"]["time_ns"], first)


@pytest.mark.parametrize("wrong", [(2,), (0,), (1, 2, 3), range(6)])
def test_wrong_offsets(tmp_path, wrong):
    bodies = [package(2, START + i * 400_032, struct.pack("<iii", 1, 1, i)) for i in range(6)]
    reader, records = read(tmp_path / "a.lvx", in_frames(head(), *bodies, wrong=wrong))
    assert [int(1000 * r.value.xyz[0, 2] + 0.5) for r in records] == list(range(6))
    assert reader.damage.whole and f"{len(wrong)} frames have wrong offsets" in reader.notes[0]


@pytest.mark.parametrize("version", ["1.0", "1.1", "2"])
@pytest.mark.parametrize("how", ["magic", "zeros", "noise", "half"])
def test_a_bad_head_with_good_frames(tmp_path, version, how):
    """As livox_ros_driver writes it from a wrong place of its buffer; nothing of the frames is lost."""
    path = tmp_path / "a.lvx"
    data = recording(path, version)
    true = collected(LvxReader(path))
    start = packages(data, version)[0][0] - (32 if version == "1.0" else 24)
    bad = {"zeros": bytes(start), "noise": np.random.default_rng(3).bytes(start)}.get(how)
    if how == "magic":
        bad = data[:20] + bytes(4) + data[24:start]
    elif how == "half":
        bad = data[start // 2 : start] + data[: start - start // 2]
    path.write_bytes(bad + data[start:])
    reader = LvxReader(path)
    got = collected(reader)
    for stream, columns in true.items():
        for name in columns if how == "magic" or stream == "imu0" else ("time_ns", "xyz", "intensity", "tag"):
            np.testing.assert_array_equal(got[stream][name], columns[name])
    assert reader.version == version and reader.damage.whole and reader.notes
    assert ("magic" in reader.notes[0]) == (how == "magic")
    assert reader.devices[0].type == (2 if how == "magic" else None)
    nameless = path.rename(tmp_path / "a recording.bin")
    assert recording_kind(nameless) == "lvx"


def test_frames_of_another_version_than_the_head_says(tmp_path):
    path = tmp_path / "a.lvx"
    data = recording(path)
    path.write_bytes(data[:16] + bytes((9, 9, 0, 0)) + data[20:])
    reader = LvxReader(path)
    assert reader.version == "1.1" and "9.9.0.0" in reader.notes[0] and reader.devices[0].code == CODE
    assert collected(reader)["lidar0"]["xyz"].shape[1] == 3


def test_packages_of_another_version_are_refused_and_counted(tmp_path):
    point = struct.pack("<iii", 1, 1, 1)
    bodies = [package(2, i * 400_032, point, version=6 if i == 3 else 5) for i in range(8)]
    reader, records = read(tmp_path / "a.lvx", in_frames(head(), b"".join(bodies[:5]), b"".join(bodies[5:])))
    assert reader.damage.n_read == 7 and reader.damage.n_lost == 1 and reader.damage.bytes_lost == 1363
    assert "version 6; only version 5" in reader.damage.places[0]


def test_lost_datagrams_are_counted_by_their_stamps(tmp_path):
    """Three in a row, and two alone; nothing else is lost."""
    lost = {7, 8, 9, 15, 22}
    write_lvx(tmp_path / "a.lvx", [DEVICE], frames(n_frames=6, per=5), drop=lambda _, number: number in lost)
    reader = LvxReader(tmp_path / "a.lvx")
    got = collected(reader)["lidar0"]["time_ns"]
    assert (reader.damage.n_lost, reader.damage.bytes_lost, reader.damage.n_read) == (5, 0, 30 - 5 + 6)
    assert reader.damage.places == (
        "lidar0: 5 datagrams are missing in 3 gaps of the stamps, "
        "at most 3 at once, 0.002 s after the first.",
    )
    times = np.concatenate([frame["lidar0"].time_ns for frame in frames(n_frames=6, per=5)])
    kept = ~np.isin((times - START) // (96 * STEP), list(lost))
    np.testing.assert_array_equal(got, times[kept])


def test_stamps_that_jump(tmp_path):
    """One package with a stamp of its own is damaged; a clock that is set goes on, and is reported."""
    stamps = START + 400_032 * np.arange(30)
    stamps[7] += 5_000_000_000_000
    stamps[[14, 28]] += 800_000_000_000  # the last of a frame, the last but one
    stamps[19:] += 90_000_000_000  # from the last of a frame on
    bodies = [package(2, int(stamp), struct.pack("<iii", 1, 1, 1)) for stamp in stamps]
    reader, records = read(
        tmp_path / "a.lvx", in_frames(head(), *(b"".join(bodies[i : i + 5]) for i in range(0, 30, 5)))
    )
    got = np.concatenate([r.value.time_ns for r in records])
    np.testing.assert_array_equal(got, np.delete(stamps, [7, 14, 28]))
    assert reader.damage.n_read == 27 and reader.damage.n_lost == 3
    assert any("jumped 1 times, by +90.000 s" in place for place in reader.damage.places)


def test_error_bits_are_reported(tmp_path):
    """Of packages of returns and of inertial samples alike: numbers 3 and 5 there are of both."""
    codes = {3: 1 << 4, 5: (2 << 30) | (1 << 9), 6: 2 << 30}
    write_lvx(tmp_path / "a.lvx", [DEVICE], frames(), error=lambda _, number: codes.get(number, 1 << 13))
    reader = LvxReader(tmp_path / "a.lvx")
    collected(reader)
    assert set(reader.notes) == {
        "lidar0: motor warning, in 2 packages.",
        "lidar0: the system reports an error, in 3 packages.",
    }
    assert reader.damage.whole


def test_a_return_beyond_sight_is_left_out(tmp_path):
    points = struct.pack("<iiiBB", 1, 1, 1, 0, 0) + struct.pack("<iiiBB", 2**30, 0, 0, 0, 0)
    reader, records = read(tmp_path / "a.lvx", in_frames(head(), package(2, 1, points)))
    assert len(records[0].value) == 1 and "beyond 2000 m" in reader.damage.places[0]


def test_devices_that_the_head_does_not_name(tmp_path):
    bodies = [package(2, i * 400_032, struct.pack("<iii", 1, 1, 1), device=4) for i in range(6)]
    reader, records = read(tmp_path / "a.lvx", in_frames(head(), *bodies))
    assert {r.stream for r in records} == {"lidar4"} and "does not name" in reader.notes[0]


# ---------------------------------------------------------------------------------- writing


def test_what_cannot_be_written(tmp_path):
    path = tmp_path / "a.lvx"
    value = frames(n_frames=1)[0]["lidar0"]
    twice = chosen(value, np.repeat(np.arange(len(value)), 2))
    wrong = [
        ({"lidar0": twice}, "Several returns"),
        ({"lidar3": value}, "no device"),
        ({"imu0": value}, "no device"),
    ]
    wrong.append(({"lidar0": chosen(value, np.arange(len(value))[::-1])}, "back in time"))
    for frame, text in wrong:
        with pytest.raises(InputError, match=text):
            write_lvx(path, [DEVICE], [{"lidar0": value}, frame] if text == "no device" else [frame])
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="no such data type"):
        LvxWriter(path, [DEVICE], data_type=6)
    with pytest.raises(InputError, match="cannot be written"):
        LvxWriter(tmp_path / "nowhere" / "a.lvx", [DEVICE])
    far = LidarReturns(np.array([0]), np.full((1, 3), 400.0), np.ones(1), *np.zeros((2, 1), "u1"))
    with pytest.raises(InputError, match="too far"):
        write_lvx(path, [DEVICE], [{"lidar0": far}], version="2", data_type=2)


def test_frames_are_cut_anywhere(tmp_path):
    """Frames of any number of returns make the same packages as one frame."""
    value = frames(n_frames=1, per=12)[0]["lidar0"]
    write_lvx(tmp_path / "one.lvx", [DEVICE], [{"lidar0": value}])
    parts = np.split(np.arange(len(value)), [1, 50, 51, 333, 700])
    write_lvx(tmp_path / "many.lvx", [DEVICE], [{"lidar0": chosen(value, part)} for part in parts])
    one, many = (collected(LvxReader(tmp_path / name))["lidar0"] for name in ("one.lvx", "many.lvx"))
    for name in one:
        np.testing.assert_array_equal(one[name], many[name])


def test_an_empty_second_is_written_and_a_pause_is_not(tmp_path):
    """No returns for 50 ms: the lidar went on. Nothing for a minute: it was off."""
    times = START + STEP * np.r_[0:96, 12_000:12_096]
    value = LidarReturns(times, np.ones((192, 3)), np.ones(192), *np.zeros((2, 192), "u1"))
    later = LidarReturns(
        times + 61_000_000_000, *(getattr(value, n) for n in ("xyz", "intensity", "tag", "line"))
    )
    write_lvx(tmp_path / "a.lvx", [DEVICE], [{"lidar0": value}, {"lidar0": later}])
    reader = LvxReader(tmp_path / "a.lvx")
    got = collected(reader)["lidar0"]["time_ns"]
    np.testing.assert_array_equal(got, np.r_[times, times + 61_000_000_000])
    assert reader.damage.n_read == 252 and reader.damage.n_lost == 0


def test_no_recording_at_all(tmp_path):
    assert message(LvxReader, tmp_path / "none.lvx").found == "nothing"
    assert message(LvxReader, tmp_path).found == "a folder"
    for content in (b"", b"#ROSBAG V2.0\n", bytes(5000), b"ply\nformat ascii 1.0\n", bytes(range(256)) * 100):
        (tmp_path / "a.lvx").write_bytes(content)
        fault = message(LvxReader, tmp_path / "a.lvx")
        assert "no LVX" in fault.problem and fault.file == str(tmp_path / "a.lvx")


def test_samples_of_a_device_without_returns(tmp_path):
    """An inertial sensor alone; and a file of nothing but its head."""
    samples = ImuSamples(START + 5_000_000 * np.arange(4), np.zeros((4, 3)), np.full((4, 3), 1.0), "power_on")
    write_lvx(tmp_path / "a.lvx", [DEVICE], [{"imu0": samples}])
    assert list(collected(LvxReader(tmp_path / "a.lvx"))) == ["imu0"]
    write_lvx(tmp_path / "b.lvx", [DEVICE], [])
    reader = LvxReader(tmp_path / "b.lvx")
    assert list(reader.records()) == [] and reader.damage.whole and reader.devices == (DEVICE,)
