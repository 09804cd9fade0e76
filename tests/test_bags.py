"""Bags in and out: every format and serialisation, against rosbags; what is no bag is said."""

import io
import shutil
import struct
import sys
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

from acino_fte.data_tools import bags_serial
from acino_fte.data_tools.bags import BagReader
from acino_fte.data_tools.bags_serial import CDR, CUSTOM, ROS1, DecodeError, decode, definitions, encode
from acino_fte.data_tools.bags_write import BagWriter
from acino_fte.data_tools.open_recording import open_recording, recording_kind
from acino_fte.data_tools.recording import GRAVITY, ImuSamples, LidarReturns, Picture, PictureInfo
from acino_fte.data_tools.ros_clouds import cloud_from_message
from acino_fte.data_tools.ros_images import picture_from_compressed, picture_from_image
from acino_fte.data_tools.ros_messages import clock_of, to_message
from acino_fte.errors import InputError

pytest.importorskip("rosbags")
cv2 = pytest.importorskip("cv2")

ROSBAG1 = Path(__file__).resolve().parents[2] / "shared" / "data" / "rosbag1"
START = 1_700_000_000_123_456_789
RECEIVED = START + 7_000_000
K = 2400
RNG = np.random.default_rng(1)
RETURNS = LidarReturns(
    START + np.arange(K) * 4167,
    RNG.normal(0, 20, (K, 3)).astype("f4").astype(float),
    RNG.integers(0, 256, K).astype(float),
    RNG.integers(0, 64, K).astype(np.uint8),
    (np.arange(K) % 6).astype(np.uint8),
    "unix",
)
IMU = ImuSamples(
    np.array([START, START + 5_000_000]), RNG.normal(size=(2, 3)), np.array([[0.1, 0.2, 9.7], [0, 0, 9.9]])
)
COLOUR = Picture(START, RNG.integers(0, 256, (20, 31, 3)).astype(np.uint8))
GREY = Picture(START + 1, RNG.integers(0, 256, (20, 31)).astype(np.uint8))
DEEP = Picture(START + 2, RNG.integers(0, 65536, (20, 31)).astype(np.uint16))
INFO = PictureInfo(START // 1000 * 1000, 17, 2000.0, 3.5, (5, -6, 7, 8))
FORMS = {
    "ros1": {"version": 1},
    "ros1-bz2": {"version": 1, "compression": "bz2"},
    "ros1-lz4": {"version": 1, "compression": "lz4"},
    "db3": {"version": 2},
    "db3-zstd": {"version": 2, "compression": "zstd"},
    "db3-ecal": {"version": 2, "serialization": "custom"},
    "mcap": {"version": 2, "storage": "mcap"},
    "mcap-zstd": {"version": 2, "storage": "mcap", "compression": "zstd"},
    "mcap-ecal": {"version": 2, "storage": "mcap", "serialization": "custom"},
}


def write_all(path: Path, **options) -> Path:
    with BagWriter(path, **options) as bag:
        for n in range(2):
            at = RECEIVED + n * 10**8
            bag.write("/lidar", RETURNS, at, "livox_frame")
            bag.write("/cloud", RETURNS, at, "livox_frame", "pointcloud2")
            bag.write("/imu", IMU, at)
            bag.write("/livox/imu", IMU, at, "livox_frame", "g")
            bag.write("/png", COLOUR, at)
            bag.write("/jpeg", COLOUR, at, form="jpeg")
            for name, picture in (("rgb", COLOUR), ("grey", GREY), ("deep", DEEP)):
                bag.write(f"/raw/{name}", picture, at, form="raw")
            bag.write("/info", INFO, at)
    return path


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    return {name: write_all(folder / f"{name}.bag", **options) for name, options in FORMS.items()}


@pytest.mark.parametrize("name", FORMS)
def test_what_was_written_is_read(bags, name):
    with open_recording(bags[name]) as reader:
        assert isinstance(reader, BagReader)
        streams = {stream.name: stream for stream in reader.streams}
        assert {s.name: s.kind for s in reader.streams} == {
            **dict.fromkeys(("/lidar", "/cloud"), "lidar"),
            **dict.fromkeys(("/imu", "/livox/imu"), "imu"),
            **dict.fromkeys(("/png", "/jpeg", "/raw/rgb", "/raw/grey", "/raw/deep"), "image"),
            "/info": "image_info",
        }
        assert streams["/lidar"].count == 2 and streams["/imu"].count == 4
        records = list(reader.records())
        assert reader.damage.whole and reader.damage.n_read == len(records) == 24
        assert len(reader.notes) == 1 and "/livox/imu" in reader.notes[0] and " g " in reader.notes[0]
    of = {topic: [r for r in records if r.stream == topic] for topic in streams}
    assert [r.received_ns for r in of["/lidar"]] == [RECEIVED, RECEIVED + 10**8]
    for topic, slack in (("/lidar", 0), ("/cloud", 128)):  # a float64 of ns since 1970 has steps of 256
        value = of[topic][1].value
        assert np.abs(value.time_ns - RETURNS.time_ns).max() <= slack and value.clock == "unix"
        for field in ("xyz", "intensity", "tag", "line"):
            np.testing.assert_array_equal(getattr(value, field), getattr(RETURNS, field))
    for topic in ("/imu", "/livox/imu"):
        values = [r.value for r in of[topic][:2]]
        np.testing.assert_array_equal(np.concatenate([v.time_ns for v in values]), IMU.time_ns)
        np.testing.assert_allclose(np.concatenate([v.force for v in values]), IMU.force, rtol=1e-14)
        np.testing.assert_array_equal(np.concatenate([v.rate for v in values]), IMU.rate)
    for topic, picture in (("/png", COLOUR), ("/raw/rgb", COLOUR), ("/raw/grey", GREY), ("/raw/deep", DEEP)):
        value = of[topic][0].value
        np.testing.assert_array_equal(value.pixels, picture.pixels)
        assert value.pixels.dtype == picture.pixels.dtype and value.time_ns == picture.time_ns
    assert of["/jpeg"][0].value.pixels.shape == (20, 31, 3)
    assert of["/info"][0].value == INFO or vars(of["/info"][0].value) == vars(INFO)


def test_only_some_kinds_and_streams(bags):
    with BagReader(bags["mcap"]) as reader:
        assert {r.stream for r in reader.records(kinds={"imu"})} == {"/imu", "/livox/imu"}
        assert {r.stream for r in reader.records(streams=["/png"])} == {"/png"}
        assert not list(reader.records(kinds={"lidar"}, streams=["/png"]))
        assert reader.damage.n_read == 24 and reader.damage.whole


@pytest.mark.parametrize("name", ["ros1-lz4", "db3", "mcap-zstd"])
def test_rosbags_reads_the_same(bags, name):
    """The writer's bytes, and the sizes and sums that the drivers' messages have."""
    from rosbags.highlevel import AnyReader

    sizes, sums = {}, {}
    if name != "ros1-lz4":  # rosbags takes a folder for a bag of ROS 1 by its suffix
        shutil.copytree(bags[name], bags[name].with_suffix(""))
    with AnyReader([bags[name] if name == "ros1-lz4" else bags[name].with_suffix("")]) as other:
        for connection, received, raw in other.messages():
            message = other.deserialize(raw, connection.msgtype)
            sizes[connection.topic], sums[connection.topic] = len(raw), connection.digest
            if connection.topic == "/lidar":
                assert [p.offset_time for p in message.points] == list(RETURNS.time_ns - START)
                np.testing.assert_array_equal([p.z for p in message.points], RETURNS.xyz[:, 2])
            elif connection.topic == "/info":
                assert message.acq_nframe == 17 and message.encoders == "17,5,-6,7,8"
            elif connection.topic == "/livox/imu":
                assert abs(message.linear_acceleration.z * GRAVITY - 9.8) < 0.11
            assert received in (RECEIVED, RECEIVED + 10**8)
    expected = (45_647, 323) if name == "ros1-lz4" else (48_047, 324)
    assert (sizes["/lidar"], sizes["/livox/imu"]) == expected
    if name == "ros1-lz4":
        assert sums["/lidar"] == "e4d6829bdfe657cb6c21a746c86b21a6"
        assert sums["/info"] == "e87723ced958aa24658ff9a0eedcf625"


@pytest.mark.parametrize("version", [1, 2])
def test_any_message_is_decoded_as_rosbags_does(version):
    """Nested messages of varying size, arrays, texts and numbers of every width, packed and aligned."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    text = (
        "string name\nuint8 a\nfloat64 b\nint16[3] c\nThing[] things\nPair[] pairs\nstring[] words\nuint8 z\n"
        + "=" * 80 + "\nMSG: x_msgs/Thing\nuint8 k\nstring label\nint64 n\n"
        + "=" * 80 + "\nMSG: x_msgs/Pair\nuint32 p\nuint8 q\n"
    )  # fmt: skip
    name, types = "x_msgs/msg/Whole", get_types_from_msg(text, "x_msgs/msg/Whole")
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    store.register(types)
    layout = ROS1 if version == 1 else CDR
    pairs = np.array([(1, 2), (3, 4), (5, 6)], [("p", "u4"), ("q", "u1")])
    things = [{"k": i, "label": "x" * i, "n": -i} for i in range(4)]
    value = {"name": "Löwe", "a": 7, "b": -0.5, "c": [1, -2, 3], "things": things, "pairs": pairs}
    value |= {"words": ["", "ab"], "z": 9}
    raw = encode(value, name, definitions(name, text, version), layout)
    other = (store.deserialize_ros1 if version == 1 else store.deserialize_cdr)(raw, name)
    assert [p.q for p in other.pairs] == [2, 4, 6] and [t.n for t in other.things] == [0, -1, -2, -3]
    back = bytes((store.serialize_ros1 if version == 1 else store.serialize_cdr)(other, name))
    for bytes_ in (raw, back):
        read = decode(bytes_, name, definitions(name, text, version), layout)
        assert read["things"] == things and read["words"] == value["words"] and read["name"] == "Löwe"
        np.testing.assert_array_equal(read["pairs"]["p"], pairs["p"])
        np.testing.assert_array_equal(read["c"], value["c"])
        assert (read["a"], read["b"], read["z"]) == (7, -0.5, 9)
    with pytest.raises(DecodeError):
        decode(raw[:-9], name, definitions(name, text, version), layout)
    with pytest.raises(DecodeError, match="left over"):
        decode(raw + bytes(20), name, definitions(name, text, version), layout)


def test_messages_of_ecal_have_counts_of_eight_bytes_and_no_gaps():
    """As a real recording has them: i32 seconds, u32 nanoseconds, u64 length, text, value."""
    types = definitions("a_msgs/msg/A", "std_msgs/Header header\nfloat64 value", 2)
    raw = struct.pack("<iIQ3sd", 12, 34, 3, b"abc", 0.25)
    assert decode(raw, "a_msgs/msg/A", types, CUSTOM) == {
        "header": {"stamp": {"sec": 12, "nanosec": 34}, "frame_id": "abc"},
        "value": 0.25,
    }
    assert encode(decode(raw, "a_msgs/msg/A", types, CUSTOM), "a_msgs/msg/A", types, CUSTOM) == raw


def test_big_endian_cdr():
    types = definitions("a_msgs/msg/B", "uint16 a\nfloat64[] b", 2)
    raw = b"\0\0\0\0" + struct.pack(">HxxIdd", 258, 2, 1.5, -2.5)
    read = decode(raw, "a_msgs/msg/B", types, CDR)
    assert read["a"] == 258 and read["b"].tolist() == [1.5, -2.5]


def cloud(dtype: np.dtype, points: np.ndarray, **more) -> dict:
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    fields = [
        {"name": n, "offset": o, "datatype": codes[d.str[1:]], "count": 1}
        for n, (d, o) in dtype.fields.items()
    ]
    data = np.frombuffer(points.tobytes(), np.uint8)
    message = {"height": 1, "width": len(points), "fields": fields, "is_bigendian": 0, "data": data}
    return {**message, "point_step": dtype.itemsize, "row_step": dtype.itemsize * len(points), **more}


@pytest.mark.parametrize("order", "<>")
def test_point_clouds_of_any_layout(order):
    form = {
        "names": ["ring", "y", "x", "z", "t", "intensity"],
        "formats": [order + code for code in ("u2", "f8", "f4", "f4", "u4", "u1")],
        "offsets": [0, 5, 13, 17, 24, 33],
        "itemsize": 40,
    }
    dtype = np.dtype(form)
    points = np.zeros(6, dtype)
    for axis, start in zip("xyz", (1, 10, 20), strict=True):
        points[axis] = np.arange(6) + start
    points["t"], points["ring"], points["intensity"] = np.arange(6) * 1000, [1, 2, 3, 4, 5, 700], 9
    points["x"][1] = np.nan
    for axis in "xyz":
        points[axis][2] = 0.0
    read = cloud_from_message(cloud(dtype, points, is_bigendian=order == ">"), START, clock_of)
    np.testing.assert_array_equal(read.xyz[:, 0], [1, 4, 5, 6])
    np.testing.assert_array_equal(read.time_ns - START, [0, 3000, 4000, 5000])
    np.testing.assert_array_equal(read.line, [1, 4, 5, 255])
    rows = np.zeros((2, 140), np.uint8)  # two rows of three points, with bytes between the rows
    rows[:, :120] = np.frombuffer(points.tobytes(), np.uint8).reshape(2, 120)
    more = {"height": 2, "width": 3, "row_step": 140, "data": rows.ravel(), "is_bigendian": order == ">"}
    again = cloud_from_message(cloud(dtype, points, **more), START, clock_of)
    np.testing.assert_array_equal(again.xyz, read.xyz)
    with pytest.raises(ValueError, match="only 100 bytes"):
        cloud_from_message(cloud(dtype, points, data=rows.ravel()[:100]), START, clock_of)


@pytest.mark.parametrize(
    ("code", "values", "stamp"),
    [
        ("f8", START + np.arange(5) * 10_000, START),  # livox_ros_driver2: ns
        ("f8", (START + np.arange(5) * 10_000) / 1e9, START),  # s since 1970
        ("f4", np.arange(5) * 10e-6, START),  # s since the stamp
        ("u4", np.arange(5) * 10_000, START),  # ns since the stamp
        ("f8", 5_000_000_000 + np.arange(5) * 10_000, 5_000_000_000),  # ns since power-on
        ("f8", 5 + np.arange(5) * 1e-5, 5_000_000_000),  # s since power-on
    ],
)
def test_times_of_points_in_any_unit(code, values, stamp):
    dtype = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("timestamp", code)])
    points = np.ones(5, dtype)
    points["timestamp"] = values
    read = cloud_from_message(cloud(dtype, points), stamp, clock_of)
    np.testing.assert_allclose(read.time_ns - stamp, np.arange(5) * 10_000, atol=300)


def test_livox_18_byte_points_have_the_time_of_the_header(bags):
    dtype = np.dtype(
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("tag", "u1"), ("line", "u1")]
    )
    points = np.ones(3, dtype)
    points["tag"], points["line"] = [16, 32, 0], [0, 1, 5]
    read = cloud_from_message(cloud(dtype, points), START, clock_of)
    assert dtype.itemsize == 18 and read.tag.tolist() == [16, 32, 0] and read.line.tolist() == [0, 1, 5]
    assert set(read.time_ns) == {START}


def test_raw_images_of_every_encoding():
    colour = COLOUR.pixels
    head = {"height": 20, "width": 31, "is_bigendian": 0}

    def read(encoding, pixels, **more):
        data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
        step = {"step": len(data) // 20}
        return picture_from_image({**head, **step, "encoding": encoding, "data": data, **more})

    np.testing.assert_array_equal(read("bgr8", colour[..., ::-1]), colour)
    alpha = np.concatenate([colour, colour[..., :1]], axis=2)
    np.testing.assert_array_equal(read("rgba8", alpha), colour)
    np.testing.assert_array_equal(read("bgra8", alpha[..., [2, 1, 0, 3]]), colour)
    np.testing.assert_array_equal(read("mono16", DEEP.pixels.astype(">u2"), is_bigendian=1), DEEP.pixels)
    padded = np.pad(GREY.pixels, ((0, 0), (0, 5)))
    np.testing.assert_array_equal(read("mono8", padded), GREY.pixels)
    for bad, match in (("mono8", "rows"), ("yuv422", "not known"), ("bayer_xxxx8", "not known")):
        with pytest.raises(ValueError, match=match):
            read(bad, GREY.pixels, step=40 if bad == "mono8" else 31)
    for data in (b"", b"no image at all"):
        with pytest.raises(ValueError, match="not an image"):
            picture_from_compressed({"format": "jpeg", "data": np.frombuffer(data, np.uint8)})


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_give_the_colours_they_were_made_of(pattern):
    colours = {"r": 200, "g": 90, "b": 30}
    tile = np.array([[colours[pattern[0]], colours[pattern[1]]], [colours[pattern[2]], colours[pattern[3]]]])
    mosaic = np.tile(tile, (10, 12)).astype(np.uint8)
    message = {"height": 20, "width": 24, "step": 24, "is_bigendian": 0, "encoding": f"bayer_{pattern}8"}
    pixels = picture_from_image({**message, "data": mosaic.ravel()})
    assert (pixels[4:-4, 4:-4] == [200, 90, 30]).all()


def test_units_of_accelerations(bags):
    def forces(unit, topic):
        with BagReader(bags["ros1"], imu_unit=unit) as reader:
            return np.concatenate([r.value.force for r in reader.records(streams=[topic])])[:2]

    np.testing.assert_allclose(forces("g", "/livox/imu"), IMU.force)
    np.testing.assert_allclose(forces("m/s2", "/livox/imu"), IMU.force / GRAVITY)
    np.testing.assert_allclose(forces("g", "/imu"), IMU.force * GRAVITY)
    with pytest.raises(InputError, match="imu_unit"):
        BagReader(bags["ros1"], imu_unit="ft")


def test_other_types_come_as_bytes_and_what_does_not_decode_is_counted(tmp_path):
    with BagWriter(tmp_path / "x.bag", 1) as bag:
        for n in range(4):
            bag.write_raw("/words", "std_msgs/msg/String", struct.pack("<I", 2) + b"ab", RECEIVED + n)
            bag.write("/imu", IMU, RECEIVED + n)
        bag.write_raw("/imu", "sensor_msgs/msg/Imu", bytes(17), RECEIVED)
    with BagReader(tmp_path / "x.bag") as reader:
        records = list(reader.records())
        assert [r.raw for r in records if r.kind == "other"] == [struct.pack("<I", 2) + b"ab"] * 4
        assert sum(r.kind == "imu" for r in records) == 8
        assert reader.damage.n_lost == 1 and reader.damage.n_read == 12
        assert any("/imu: 1 message does not decode" in place for place in reader.damage.places)


def test_other_types_decode_when_asked(tmp_path):
    joints = {"header": {"stamp": {"sec": 5, "nanosec": 6}, "frame_id": "rig"}, "name": ["pan", "tilt"]}
    joints |= {"position": np.array([0.5, -0.25]), "velocity": np.zeros(0), "effort": np.zeros(0)}
    name = "sensor_msgs/msg/JointState"
    with BagWriter(tmp_path / "x", 2, serialization="custom") as bag:
        bag.write_raw("/pan", name, encode(joints, name, definitions(name, "", 2), CUSTOM), RECEIVED)
        bag.write("/imu", IMU, RECEIVED)
    with BagReader(tmp_path / "x") as reader:
        other, inertial, _ = reader.records()
        assert reader.fields(other)["position"].tolist() == [0.5, -0.25]
        assert reader.fields(other)["name"] == ["pan", "tilt"]
        with pytest.raises(InputError, match="does not decode"):
            reader.fields(inertial)


def test_a_missing_package_names_the_remedy(bags, tmp_path, monkeypatch):
    for module in ("rosbags", "rosbags.typesys", "cv2", "lz4.frame"):
        monkeypatch.setitem(sys.modules, module, None)
    bags_serial._standard.cache_clear()
    bags_serial.definitions.cache_clear()
    for path, kinds in ((bags["ros1"], {"imu"}), (bags["ros1-lz4"], {"other"})):
        with pytest.raises(InputError, match=r"acino-fte\[lidar\]"), BagReader(path) as reader:
            list(reader.records(kinds=kinds))
    with pytest.raises(InputError, match=r"acino-fte\[lidar\]"):
        picture_from_compressed({"format": "jpeg", "data": np.zeros(9, np.uint8)})


def test_recordings_of_ecal(tmp_path):
    """As format 5 has it: a data set for each message, tables at the end; and one that was cut."""
    h5py = pytest.importorskip("h5py")
    name, types = "sensor_msgs/msg/Imu", definitions("sensor_msgs/msg/Imu", "", 2)
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for n in range(6):
            message = to_message(ImuSamples(IMU.time_ns[:1] + n, IMU.rate[:1], IMU.force[:1]), "")[1]
            file[str(n)] = np.frombuffer(encode(message, name, types, CUSTOM), np.uint8)
        file.attrs["Version"] = np.bytes_("5.0")
    with pytest.raises(InputError, match="no recording"):
        with h5py.File(tmp_path / "other.h5", "w") as file:
            file["x"] = [1]
        open_recording(tmp_path / "other.h5")
    with open_recording(tmp_path / "a.hdf5") as cut:
        assert not list(cut.records()) and cut.damage.n_lost == 6
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file.attrs["Channels"] = np.bytes_("rt/imu/a,rt/imu/b")
        for channel, numbers in (("rt/imu/a", [0, 2, 4]), ("rt/imu/b", [1, 3, 5])):
            rows = [[RECEIVED // 1000 + n, n, n, RECEIVED // 1000, 7] for n in numbers]
            table = file.create_dataset(quote(channel, safe=""), data=np.array(rows, np.int64))
            table.attrs["Channel Type"] = np.bytes_("sensor_msgs::msg::dds_::Imu_")
        del file["3"]
    with open_recording(tmp_path / "a.hdf5") as reader:
        assert [(s.name, s.kind, s.count) for s in reader.streams] == [
            ("/imu/a", "imu", 3),
            ("/imu/b", "imu", 3),
        ]
        records = list(reader.records())
        assert [int(r.value.time_ns[0] - START) for r in records] == [0, 1, 2, 4, 5]
        assert records[1].received_ns == (RECEIVED // 1000 + 1) * 1000
        assert reader.damage.n_lost == 1 and reader.damage.n_read == 5


def test_lz4_chunks_of_mcap(tmp_path):
    from mcap.writer import CompressionType, Writer

    types = definitions("sensor_msgs/msg/Imu", "", 2)
    with BagWriter(tmp_path / "a", 2, storage="mcap") as bag:
        bag.write("/imu", IMU, RECEIVED)
    with BagReader(tmp_path / "a") as reader:
        before = [r.value for r in reader.records()]
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.LZ4)
    writer.start("ros2")
    schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", b"")
    channel = writer.register_channel("/imu", "cdr", schema)
    for i, value in enumerate(before):
        writer.add_message(
            channel, RECEIVED, encode(to_message(value, "")[1], "sensor_msgs/msg/Imu", types, CDR), i
        )
    writer.finish()
    (tmp_path / "b.mcap").write_bytes(out.getvalue())
    with BagReader(tmp_path / "b.mcap") as reader:
        for record, value in zip(reader.records(), before, strict=True):
            np.testing.assert_array_equal(record.value.force, value.force)
        assert reader.damage.whole


def test_what_is_no_recording_is_said(tmp_path, bags):
    (tmp_path / "empty.bag").write_bytes(b"")
    (tmp_path / "text.bag").write_text("a shopping list\nmilk\n")
    (tmp_path / "zeros.bag").write_bytes(bytes(5000))
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V1.2\n" + bytes(100))
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    (tmp_path / "folder").mkdir()
    cases = {
        "empty.bag": "0 bytes",
        "text.bag": "text: 'a shopping list'",
        "zeros.bag": "nothing but zeros",
        "picture.png": "a PNG image",
        "folder": "an empty folder",
        "emty.bag": "did you mean 'empty.bag'",
    }
    for name, words in cases.items():
        with pytest.raises(InputError, match="recording|folder") as error:
            open_recording(tmp_path / name)
        assert words in str(error.value) and name in str(error.value)
    with pytest.raises(InputError, match="version"):
        open_recording(tmp_path / "old.bag")
    (tmp_path / "folder" / "x.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(InputError, match=r"x\.bag"):
        open_recording(tmp_path / "folder")
    with pytest.raises(InputError, match="no bag"):
        BagReader(tmp_path / "text.bag")


def test_content_tells_not_the_name(tmp_path, bags):
    (tmp_path / "a.mp4").write_bytes(bags["ros1"].read_bytes())
    assert recording_kind(tmp_path / "a.mp4") == "bag"
    write = (
        pytest.importorskip("av")
        and __import__("acino_fte.data_tools.video_write", fromlist=["x"]).write_video
    )
    for name in ("v.mp4", "v.mkv", "v.avi"):
        write(tmp_path / name, [COLOUR.pixels] * 3, 30)
        (tmp_path / name).rename(tmp_path / f"{name}.bag")
        assert recording_kind(tmp_path / f"{name}.bag") == "video"


def test_a_failed_bag_leaves_nothing(tmp_path):
    for version in (1, 2):
        with pytest.raises(RuntimeError), BagWriter(tmp_path / "a.bag", version) as bag:
            bag.write("/imu", IMU, RECEIVED)
            raise RuntimeError
    assert not list(tmp_path.iterdir())
    (tmp_path / "a.bag").write_text("mine")
    with pytest.raises(InputError, match="exists"):
        BagWriter(tmp_path / "a.bag")
    with pytest.raises(InputError, match="cannot be written"):
        BagWriter(tmp_path / "b.bag", 1, "zstd")
    assert (tmp_path / "a.bag").read_text() == "mine"


@pytest.mark.skipif(not ROSBAG1.is_dir(), reason="the sample bags are not here")
@pytest.mark.parametrize(
    ("name", "count"),
    [
        *(("example", 8647), ("example-bz2", 8647), ("example-lz4", 8647)),
        *(("example-unsorted-chunks", 3), ("no-messages", 0)),
    ],
)
def test_real_bags(name, count):
    with BagReader(ROSBAG1 / f"{name}.bag") as reader:
        assert sum(stream.count for stream in reader.streams) == count
        assert sum(1 for _ in reader.records()) == count == reader.damage.n_read and reader.damage.whole


def test_a_recording_that_may_not_be_read(tmp_path, monkeypatch):
    path = tmp_path / "a.bag"
    path.write_bytes(b"#ROSBAG V2.0\n")

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.open", refuse)
    with pytest.raises(InputError, match="cannot be opened") as error:
        open_recording(path)
    assert error.value.file == str(path)
