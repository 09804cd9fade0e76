"""Rescue of files damaged in other ways than by a cut: heads, middles, journals, missing tables."""

import hashlib
import shutil
import sqlite3
import struct

import numpy as np
import pytest
from lvx_synthetic import CODE, collected, packages, recording
from recover_made import BYTES, PAYLOADS, START, STEP, make, read_standard

from acino_fte.data_tools.bags import BagReader
from acino_fte.data_tools.bags_serial import CUSTOM, definitions, encode
from acino_fte.data_tools.bags_write import BagWriter
from acino_fte.data_tools.lvx import LvxReader
from acino_fte.data_tools.recording import ImuSamples, PictureInfo
from acino_fte.data_tools.ros_messages import XIMEA_TYPE, to_message
from acino_fte.errors import InputError
from acino_fte.rig.recover import recover

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
RNG = np.random.default_rng(7)


def state(folder):
    """Names, contents and times of all files."""
    return {
        str(file): (hashlib.sha256(file.read_bytes()).hexdigest(), file.stat().st_mtime_ns)
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


# Bags and MCAP -------------------------------------------------------------------------------------------


def test_what_mcap_keeps_of_a_message_and_of_a_channel(tmp_path):
    """Stamps, sequence, schema, metadata, attachment; an unknown type byte for byte; a hole in the middle."""
    from mcap.reader import make_reader

    path, _ = make(tmp_path, "mcap-none")
    data = bytearray(path.read_bytes())
    at = data.index(PAYLOADS[20])
    data[at - 31 : at + 20] = bytes(51)  # the head of message 20, in the middle of a chunk
    path.write_bytes(data)
    found = recover(path)
    assert found.copy == tmp_path / "mcap-none-recovered.mcap" and not found.whole
    with found.copy.open("rb") as file:
        reader = make_reader(file)
        messages = list(reader.iter_messages())
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        assert [m.metadata for m in reader.iter_metadata()] == [{"name": "test"}]
        assert [a.data for a in reader.iter_attachments()] == [b"attached"]
    numbers = [message.sequence for *_, message in messages]
    assert numbers == [n for n in range(len(PAYLOADS)) if n != 20]
    for schema, channel, message in messages:
        n = message.sequence
        assert message.data == PAYLOADS[n] and channel.topic == f"/bytes{n % 3}"
        assert (message.log_time, message.publish_time) == (START + n * STEP, START + n * STEP - 777)
        assert (schema.name, schema.encoding, channel.metadata) == (BYTES, "ros2msg", {"k": "v"})
    assert summary.statistics.message_count == found.saved == len(messages)
    lost = {stream.name: stream.lost for stream in found.streams}
    assert lost == {"/bytes0": 0, "/bytes1": 0, "/bytes2": 1} and found.lost == 1
    assert all(stream.exact for stream in found.streams)  # the summary at the end tells


@pytest.mark.parametrize("form", ["ros1-none", "mcap-none"])
def test_the_first_bytes_are_lost(form, tmp_path):
    """A torn first block: the name tells what it is."""
    path, _ = make(tmp_path, form)
    data = path.read_bytes()
    path.write_bytes(bytes(8) + data[8:])
    found = recover(path)
    assert read_standard(found.copy, form) == PAYLOADS and not found.whole


def test_lost_messages_are_told_by_time_where_no_index_tells_them(tmp_path):
    """A hole and a cut: the usual interval of each stream tells how many, and how long."""
    path, _ = make(tmp_path, "mcap-none")
    data = bytearray(path.read_bytes())
    first, last = data.index(PAYLOADS[15]) - 31, data.index(PAYLOADS[26])
    data[first:last] = RNG.integers(0, 256, last - first).astype("u1").tobytes()
    path.write_bytes(data[: data.index(PAYLOADS[40]) + 30])
    found = recover(path)
    saved = {PAYLOADS.index(p) for p in read_standard(found.copy, "mcap-none")}
    assert set(range(14)) <= saved and set(range(28, 40)) <= saved and not saved & set(range(16, 26))
    for n, stream in enumerate(sorted(found.streams, key=lambda s: s.name)):
        missing = [k for k in range(40) if k % 3 == n and k not in saved]
        assert stream.lost == len(missing) and not stream.exact
        assert stream.lost_seconds == pytest.approx(len(missing) * 3 * STEP / 1e9)
    assert found.lost >= sum(s.lost for s in found.streams)


@pytest.mark.parametrize("form", ["ros1-lz4", "mcap-zstd", "db3"])
def test_messages_whose_topic_is_lost_are_kept(form, tmp_path):
    """The one place that names topics is damaged, and the file is cut: the bytes are kept, by number."""
    path, _ = make(tmp_path, form)
    data = bytearray(path.read_bytes())
    if form == "db3":
        data[3 * 4096 : 4 * 4096] = bytes(4096)  # the table of topics
    if form == "mcap-zstd":
        data[200:4000] = bytes(3800)
    if form == "ros1-lz4":  # the first chunk has the connections
        first = data.index(b"compression=lz4")
        data[first + 40 : first + 2500] = bytes(2460)
    path.write_bytes(data if form == "db3" else data[: len(data) * 3 // 5])
    found = recover(path)
    saved = read_standard(found.copy, form)
    assert len(saved) > 15 and saved == [p for p in PAYLOADS if p in set(saved)]
    names = {stream.name for stream in found.streams if stream.saved}
    assert names and all(name.startswith("/recovered/") for name in names)
    assert any("topic and type are lost" in n or "name and type are lost" in n for n in found.notes)


def test_a_page_that_no_message_needs(tmp_path):
    """Other programs refuse such a file: it is damaged too, though all messages can be read."""
    path, _ = make(tmp_path, "db3")
    data = bytearray(path.read_bytes())
    data[6 * 4096 : 7 * 4096] = bytes(4096)  # of the index of times
    path.write_bytes(data)
    found = recover(path)
    assert not found.whole and found.saved == len(PAYLOADS) and found.lost == 0
    assert read_standard(found.copy, "db3") == PAYLOADS


def test_a_damaged_definition_does_not_make_the_copy_unreadable(tmp_path):
    """Other programs refuse a bag whose definitions and their sums do not fit: they are made anew."""
    path, _ = make(tmp_path, "ros1-none")
    data = bytearray(path.read_bytes())
    at = 0
    while (at := data.find(b"layout        # specification", at + 1)) >= 0 or at == 0:
        data[at : at + 4] = b"\x00\xffz{"
    while (at := data.find(b"MultiArrayLayout layout", at + 1)) >= 0:
        data[at : at + 6] = b"\x00\xffz{}}"
    path.write_bytes(data[:-3000])
    found = recover(path)
    assert read_standard(found.copy, "ros1") == PAYLOADS[: found.saved] and found.saved > 40


def test_a_real_type_reads_on(tmp_path):
    """A cut bag of ROS 1 with messages that the readers know: its copy is imported as any other."""
    sample = ImuSamples(np.array([START]), np.zeros((1, 3)), np.full((1, 3), 5.0))
    with BagWriter(tmp_path / "a.bag") as bag:
        for n in range(30):
            bag.write("/livox/imu", sample, START + n * STEP)
    (tmp_path / "b.bag").write_bytes((tmp_path / "a.bag").read_bytes()[:-4000])
    found = recover(tmp_path / "b.bag", tmp_path / "c.bag")
    with BagReader(found.copy) as reader:
        records = list(reader.records())
        assert reader.damage.whole and len(records) == found.saved > 10
        assert [stream.kind for stream in reader.streams] == ["imu"]


# SQLite --------------------------------------------------------------------------------------------------


def test_a_folder_of_ros_2_without_its_metadata(tmp_path):
    """Missing metadata.yaml, one file sound, one cut: a folder that rosbags opens, its counts right."""
    from rosbags.highlevel import AnyReader

    path, _ = make(tmp_path, "db3")
    folder = tmp_path / "bag"
    folder.mkdir()
    shutil.copy(path, folder / "bag_0.db3")
    data = path.read_bytes()
    (folder / "bag_1.db3").write_bytes(data[: len(data) * 2 // 3])
    before = state(folder)
    found = recover(folder)
    assert state(folder) == before
    assert found.copy == tmp_path / "bag-recovered" and (found.copy / "recovery.json").is_file()
    with AnyReader([found.copy]) as reader:
        read = [bytes(raw) for *_, raw in reader.messages()]
        assert reader.message_count == found.saved == len(read) > len(PAYLOADS)
        assert {c.topic: c.msgtype for c in reader.connections} == {f"/bytes{i}": BYTES for i in range(3)}
    assert set(read) == set(PAYLOADS)
    assert any("metadata.yaml is missing" in note for note in found.notes)
    again = recover(found.copy)
    assert again.whole and again.copy is None and again.saved == found.saved


def test_torn_pages_in_the_middle(tmp_path):
    """Pages of zeros and of noise: every message on other pages is saved, the lost ones are counted."""
    path, _ = make(tmp_path, "db3")
    data = bytearray(path.read_bytes())
    size = int.from_bytes(data[16:18], "big")
    torn = [data.index(PAYLOADS[20][:24]) // size, data.index(PAYLOADS[30][:24]) // size]
    data[torn[0] * size : (torn[0] + 1) * size] = bytes(size)
    data[torn[1] * size : (torn[1] + 1) * size] = RNG.integers(0, 256, size).astype("u1").tobytes()
    whole = {payload for payload in PAYLOADS if payload in bytes(data)}
    path.write_bytes(data)
    found = recover(path)
    read = read_standard(found.copy, "db3")
    assert read == sorted(read, key=PAYLOADS.index) and set(read) == whole
    assert found.saved == len(whole) and found.lost == len(PAYLOADS) - len(whole) >= 2


@pytest.mark.parametrize("how", ["wal", "journal"])
def test_a_log_or_a_journal_beside_it(how, tmp_path):
    """What SQLite left beside the file after a loss of power is used on a copy; the original stays."""
    live, left = tmp_path / "live", tmp_path / "left"
    live.mkdir()
    file = live / "a_0.db3"
    with sqlite3.connect(file) as database:
        database.execute("PRAGMA page_size=1024")
        database.execute("PRAGMA journal_mode=" + ("WAL" if how == "wal" else "DELETE"))
        database.execute("PRAGMA cache_size=4")  # pages are written before the transaction ends
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
            "offered_qos_profiles TEXT)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.execute("INSERT INTO topics VALUES(7, '/bytes', ?, 'cdr', '- history: 1')", (BYTES,))
        insert = "INSERT INTO messages(topic_id, timestamp, data) VALUES(7, ?, ?)"
        database.executemany(insert, [(START + n, p) for n, p in enumerate(PAYLOADS[:30])])
        database.commit()
        database.executemany(insert, [(START + n, p) for n, p in enumerate(PAYLOADS[30:], 30)])
        shutil.copytree(live, left)  # the power goes here
        database.rollback()
    database.close()
    assert (left / f"a_0.db3-{how}").stat().st_size > 1000
    before = state(left)
    found = recover(left)
    assert state(left) == before
    (copy,) = found.copy.glob("*.db3*")
    assert read_standard(copy, "db3") == PAYLOADS[:30] and found.saved == 30 and not found.whole
    with sqlite3.connect(copy) as database:
        assert database.execute("SELECT id, offered_qos_profiles FROM topics").fetchall() == [
            (7, "- history: 1")
        ]
    assert any(("log" if how == "wal" else "journal") in note for note in found.notes)


def test_a_bag_that_was_compressed_as_a_whole(tmp_path):
    import zstandard

    path, _ = make(tmp_path, "db3")
    packed = tmp_path / "a_0.db3.zstd"
    data = path.read_bytes()
    pack, blocks = zstandard.ZstdCompressor().compressobj(), b""
    for at in range(0, len(data), 4096):
        blocks += pack.compress(data[at : at + 4096]) + pack.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    packed.write_bytes(blocks + pack.flush())
    assert recover(packed).whole and recover(packed, tmp_path / "plain").copy.read_bytes()[:6] == b"SQLite"
    packed.write_bytes(blocks[: len(blocks) // 2])
    found = recover(packed)
    assert found.copy == tmp_path / "a_0-recovered.db3"
    read = read_standard(found.copy, "db3")
    assert read == PAYLOADS[: len(read)] and 5 < len(read) < len(PAYLOADS)


# LVX -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["1.0", "1.1", "2"])
@pytest.mark.parametrize("how", ["head", "offsets", "name"])
def test_lvx_with_a_bad_head_or_broken_offsets(version, how, tmp_path):
    path, good = tmp_path / "bad.lvx", tmp_path / "good.lvx"
    data = bytearray(recording(good, version, n_frames=4, per=2, share=0.9))
    every = packages(bytes(data), version)
    at = every[0][0] - (32 if version == "1.0" else 24)
    if how == "head":
        data[:at] = RNG.integers(0, 256, at).astype("u1").tobytes()
    elif how == "name":
        data[:24] = bytes(24)
    else:
        second = next(b for (_, a, *_), (b, *_) in zip(every, every[1:], strict=False) if b != a)
        struct.pack_into("<QQ", data, second - (32 if version == "1.0" else 24), 999, 12)
    path.write_bytes(data)
    found = recover(path)
    assert not found.whole and found.saved == len(every)
    copied = found.copy.read_bytes()
    assert copied[:10] == b"livox_tech"
    assert [copied[a:b] for a, b, *_ in packages(copied, version)] == [data[a:b] for a, b, *_ in every]
    reader = LvxReader(found.copy)
    values = collected(reader)
    assert reader.damage.whole and not reader.notes and reader.version == version
    for stream, columns in collected(LvxReader(good)).items():
        np.testing.assert_array_equal(values[stream]["time_ns"], columns["time_ns"])
    assert recover(found.copy).whole
    codes = [device.code for device in reader.devices]
    assert codes == ([""] if how == "head" else [CODE])
    if how == "head":
        like = recover(path, tmp_path / "named.lvx", like=good)
        assert LvxReader(like.copy).devices == LvxReader(good).devices


# eCAL ----------------------------------------------------------------------------------------------------


def ecal(path, tables=True, n=40):
    """A recording with an inertial sensor, a camera and a channel of no known type."""
    import h5py

    kinds = [
        ("rt/imu", "sensor_msgs/msg/Imu", "sensor_msgs::msg::dds_::Imu_"),
        ("rt/cam/info", XIMEA_TYPE, "ximea_ros_cam::msg::dds_::XiImageInfo_"),
        ("rt/strange", "", "strange::msg::dds_::Thing_"),
    ]
    rows = {name: [] for name, *_ in kinds}
    sent = []
    with h5py.File(path, "w") as file:
        for k in range(n):
            topic, name, _ = kinds[k % 3]
            stamp = START + k * 1_000_000
            if topic == "rt/imu":
                value = ImuSamples(np.array([stamp]), np.zeros((1, 3)), np.full((1, 3), float(k)))
                data = encode(to_message(value, "livox_frame")[1], name, definitions(name, "", 2), CUSTOM)
            elif name:
                message = to_message(PictureInfo(stamp, k, 1000.0, 2.0, (1, 2)), "cam")[1]
                data = encode(message, name, definitions(name, "", 2), CUSTOM)
            else:
                data = bytes([k, 255, 3]) * 5
            file[str(k)] = np.frombuffer(data, np.uint8)
            rows[topic].append([stamp // 1000 + 50, k, k, stamp // 1000, 1])
            sent.append(bytes(data))
        if tables:
            file.attrs["Version"] = np.bytes_("5.0")
            file.attrs["Channels"] = np.bytes_(",".join(rows))
            for topic, _, kind in kinds:
                table = file.create_dataset(topic.replace("/", "%2F"), data=np.array(rows[topic], np.int64))
                table.attrs["Channel Name"] = np.bytes_(topic)
                table.attrs["Channel Type"] = np.bytes_(kind)
    return sent


def test_ecal_without_tables(tmp_path):
    """Messages find their channels by their content; a sound recording names them; others are kept raw."""
    good, bad = tmp_path / "good.hdf5", tmp_path / "bad.hdf5"
    ecal(good)
    sent = ecal(bad, tables=False)
    found = recover(bad)
    names = {stream.name: stream.saved for stream in found.streams}
    assert names == {
        "/recovered/Imu/livox_frame": 14,
        "/recovered/XiImageInfo/cam": 13,
        "/recovered/unknown": 13,
    }
    with BagReader(found.copy) as reader:
        records = list(reader.records())
        assert reader.damage.whole
    assert [r.value.time_ns[0] for r in records if r.kind == "imu"] == [
        START + k * 1_000_000 for k in range(0, 40, 3)
    ]
    assert [r.raw for r in records if r.kind == "other"] == sent[2::3]
    named = recover(bad, tmp_path / "named.hdf5", like=good)
    assert {"/imu": 14, "/cam/info": 13}.items() <= {s.name: s.saved for s in named.streams}.items()
    assert recover(named.copy).whole and recover(good).whole
    with pytest.raises(InputError, match="sound recording cannot be used"):
        recover(bad, tmp_path / "other.hdf5", like=bad)


def test_ecal_that_hdf5_does_not_open(tmp_path):
    """Cut in its middle: the messages whose bytes are there are found by the heads of their data sets."""
    bad = tmp_path / "bad.hdf5"
    sent = ecal(bad, tables=False)
    data = bad.read_bytes()
    length = data.index(sent[30]) + 3
    bad.write_bytes(data[:length])
    whole = [k for k, message in enumerate(sent) if 0 <= data.find(message) <= length - len(message)]
    found = recover(bad)
    assert found.saved >= 0.9 * len(whole) > 20
    with BagReader(found.copy) as reader:
        assert sum(1 for _ in reader.records()) == found.saved and reader.damage.whole


def test_what_is_no_recording(tmp_path):
    for name, content in (("a.txt", b"hello, field"), ("b.bag", b"text only"), ("c.mcap", bytes(100))):
        (tmp_path / name).write_bytes(content)
        before = sorted(tmp_path.iterdir())
        with pytest.raises(InputError):
            recover(tmp_path / name)
        assert sorted(tmp_path.iterdir()) == before
