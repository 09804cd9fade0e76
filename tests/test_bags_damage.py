"""Bags that were cut or damaged: every whole message is read, lost ones are counted, nothing is raised."""

import bz2
import gc
import hashlib
import io
import shutil
import sqlite3
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from acino_fte.data_tools.bags import BagReader
from acino_fte.data_tools.bags_write import BagWriter
from acino_fte.data_tools.recording import ImuSamples

pytest.importorskip("rosbags")
mcap_writer = pytest.importorskip("mcap.writer")

ROSBAG1 = Path(__file__).resolve().parents[2] / "shared" / "data" / "rosbag1"
N = 60
START = 1_700_000_000_000_000_000
RNG = np.random.default_rng(5)
BYTES = "std_msgs/msg/UInt8MultiArray"
PAYLOADS = [RNG.integers(0, 256, RNG.integers(60, 3000)).astype("u1").tobytes() for _ in range(N)]
CUTS = [k / 200 for k in range(1, 200)]
FORMS = ["ros1-none", "ros1-bz2", "ros1-lz4", "mcap-none", "mcap-lz4", "mcap-zstd", "db3"]


def make(folder: Path, form: str) -> tuple[Path, list[tuple[int, int]]]:
    """A bag of N messages; and of each chunk (or message) where it ends and how many messages it ends."""
    kind, _, compression = form.partition("-")
    path = folder / f"{form}.bag"
    if kind == "mcap":
        return path, make_mcap(path, compression)
    with BagWriter(
        path, 2 if kind == "db3" else 1, {"": None, "none": None}.get(compression, compression)
    ) as bag:
        bag._writer.chunk_threshold = 9000
        for n, payload in enumerate(PAYLOADS):
            bag.write_raw(f"/bytes{n % 3}", BYTES, payload, START + n)
    if kind == "db3":
        (file,) = path.glob("*.db3")
        path = file.rename(folder / "db3.db3")
        return path, ends_db3(path.read_bytes())
    return path, ends_ros1(path)


def ends_ros1(path: Path) -> list[tuple[int, int]]:
    """(bytes that the file needs, messages) by the index, as rosbags reads it."""
    from rosbags.rosbag1 import Reader

    needed = []
    with Reader(path) as reader:
        data = path.read_bytes()
        entries = [entry for index in reader.indexes.values() for entry in index]
        for position, chunk in reader.chunks.items():
            packed = data[chunk.datapos : chunk.datapos + chunk.datasize]
            plain, there = chunk.decompressor(packed), given(packed)
            ends = []
            for entry in (e for e in entries if e.chunk_pos == position):
                at = entry.offset
                while True:
                    (head,) = struct.unpack_from("<I", plain, at)
                    (size,) = struct.unpack_from("<I", plain, at + 4 + head)
                    message = b"op=\x02" in plain[at : at + 4 + head]
                    at += 8 + head + size
                    if message:
                        break
                ends.append(at)
            needed += [(chunk.datapos + int(np.searchsorted(there, end)), 1) for end in ends]
    return needed


def given(packed: bytes) -> np.ndarray:
    """How many bytes the decompressor gives of the first 0, 1, 2, … packed bytes."""
    if packed.startswith(b"BZh"):
        unpack = bz2.BZ2Decompressor()
    elif packed.startswith(b"\x04\x22\x4d\x18"):
        import lz4.frame

        unpack = lz4.frame.LZ4FrameDecompressor()
    else:
        return np.arange(len(packed) + 1)
    return np.cumsum([0, *(len(unpack.decompress(packed[i : i + 1])) for i in range(len(packed)))])


def make_mcap(path: Path, compression: str) -> list[tuple[int, int]]:
    form = mcap_writer.CompressionType[compression.upper()]
    out = io.BytesIO()
    writer = mcap_writer.Writer(out, chunk_size=9000, compression=form)
    writer.start("ros2")
    schema = writer.register_schema(BYTES, "ros2msg", b"")
    channels = [writer.register_channel(f"/bytes{i}", "cdr", schema) for i in range(3)]
    for n, payload in enumerate(PAYLOADS):
        writer.add_message(channels[n % 3], START + n, payload, START + n)
    writer.finish()
    path.write_bytes(out.getvalue())
    from mcap.reader import make_reader

    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
        data, needed = path.read_bytes(), []
        for chunk in chunks:
            count = chunk.message_end_time - chunk.message_start_time + 1
            end = chunk.chunk_start_offset + chunk.chunk_length
            if form is mcap_writer.CompressionType.NONE:
                ends = [data.index(p) + len(p) for p in PAYLOADS]
                needed += [(e, 1) for e in ends if chunk.chunk_start_offset < e <= end]
            else:
                needed.append((end, count))
    return needed


def ends_db3(data: bytes) -> list[tuple[int, int]]:
    """A message needs the page of its row, with its first bytes, and that of its last bytes, whole."""
    size = int.from_bytes(data[16:18], "big")
    needed = []
    for payload in PAYLOADS:
        places = [
            data.index(payload[:24]),
            next(i for i in map(data.find, (payload[-12:], payload[-6:])) if i > 0),
        ]
        needed.append((max(place // size + 1 for place in places) * size, 1))
    return needed


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp("damaged")
    return {form: make(folder, form) for form in FORMS}


def read(path: Path) -> tuple[list[bytes], BagReader]:
    with BagReader(path) as reader:
        return [record.raw for record in reader.records()], reader


@pytest.mark.parametrize("form", FORMS)
def test_cut_at_every_200th(bags, form, tmp_path):
    """All whole messages before the cut, in their order; of a cut chunk what its decompressor gives."""
    path, needed = bags[form]
    data = path.read_bytes()
    cut = tmp_path / path.name
    missing = []
    for fraction in CUTS:
        size = int(fraction * len(data))
        cut.write_bytes(data[:size])
        found, reader = read(cut)
        whole = sum(n for end, n in needed if end <= size)
        if len(found) < whole:
            missing.append((fraction, len(found), whole))
        if form == "db3":  # the first rows move to a later page when their table gets its second leaf
            there = [p for p, (end, _) in zip(PAYLOADS, needed, strict=True) if end <= size]
            assert found == there
        assert form == "db3" or found == PAYLOADS[: len(found)]
        assert reader.damage.n_read == len(found)
        assert not reader.damage.whole or len(found) == N
    assert not missing
    assert read(path)[0] == PAYLOADS and read(path)[1].damage.whole


@pytest.mark.parametrize("form", FORMS)
def test_streams_of_cut_bags(bags, form, tmp_path):
    path, _ = bags[form]
    data = path.read_bytes()
    (tmp_path / path.name).write_bytes(data[: len(data) * 2 // 3])
    found, reader = read(tmp_path / path.name)
    assert sum(stream.count for stream in reader.streams) == len(found) > N // 2
    assert sorted(s.name for s in reader.streams) == ["/bytes0", "/bytes1", "/bytes2"]
    assert {s.type for s in reader.streams} == {BYTES}


@pytest.mark.parametrize("form", FORMS)
def test_a_hole_costs_what_lies_in_it(bags, form, tmp_path):
    """Zeros, 0xFF or nothing in place of 200 bytes: messages before and after are read."""
    path, _ = bags[form]
    data = path.read_bytes()
    rng = np.random.default_rng(7)
    chunk = 3 if form.endswith(("none", "db3")) else 15  # messages of one chunk, of which some may be lost
    most = chunk + (12 if form == "db3" else 0)  # a page of rows
    for i in range(30):
        at = int(rng.integers(len(data) // 20, len(data) - len(data) // 20))
        hole = (bytes(200), b"\xff" * 200, b"")[i % 3]
        if form == "db3" and not hole:
            continue  # every page after it is elsewhere: nothing can be found
        (tmp_path / path.name).write_bytes(data[:at] + hole + data[at + 200 :])
        found, reader = read(tmp_path / path.name)
        sound = [payload for payload in found if payload in PAYLOADS]
        assert sound == sorted(sound, key=PAYLOADS.index)
        assert len(sound) >= N - most, (form, i, at, len(sound), reader.damage)


@pytest.mark.parametrize("form", FORMS)
def test_no_damage_raises(bags, form, tmp_path):
    """Forty files with wrong bytes anywhere, also in lengths and heads."""
    path, _ = bags[form]
    rng = np.random.default_rng(11)
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    for i in range(40):
        data = whole.copy()
        places = rng.integers(16, len(data), 1 + i % 20)
        if i % 2:
            places[: len(places) // 2] = rng.integers(16, 4500, len(places) // 2)
        data[places] = rng.integers(0, 256, len(places))
        (tmp_path / path.name).write_bytes(data.tobytes())
        _, reader = read(tmp_path / path.name)
        assert reader.damage.n_read <= N


def test_lost_messages_are_counted_where_the_index_tells(bags, tmp_path):
    path, _ = bags["ros1-none"]
    data = bytearray(path.read_bytes())
    at = data.index(PAYLOADS[40]) - 30  # the head of this message
    data[at : at + 24] = bytes(24)
    (tmp_path / "a.bag").write_bytes(data)
    found, reader = read(tmp_path / "a.bag")
    assert found == PAYLOADS[:40] + PAYLOADS[41:]
    assert reader.damage.n_lost == 1 and reader.damage.bytes_lost > 0
    assert f"byte {at - 8}" in " ".join(reader.damage.places) or reader.damage.places


@pytest.mark.parametrize("form", ["ros1-none", "ros1-bz2", "ros1-lz4"])
def test_a_recorder_that_was_killed(bags, form, tmp_path):
    """ROS 1 writes the lengths of a chunk, and where the index is, only when it closes them."""
    path, _ = bags[form]
    data = bytearray(path.read_bytes())
    last = data.rindex(b"compression=")  # its head holds the size, its length follows
    at = data.index(b"size=", last) + 5
    end = at + 8 + int.from_bytes(data[at + 4 : at + 8], "little")
    data[at : at + 8] = bytes(8)
    place = data.index(b"index_pos=") + 10
    data[place : place + 8] = bytes(8)
    (tmp_path / "a.bag.active").write_bytes(data[:end])
    found, reader = read(tmp_path / "a.bag.active")
    assert found == PAYLOADS and "no whole index" in reader.damage.places[0]


def test_a_wrong_checksum_is_said(bags, tmp_path):
    path, _ = bags["mcap-none"]
    data = bytearray(path.read_bytes())
    data[data.index(PAYLOADS[40]) + 30] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    found, reader = read(tmp_path / "a.mcap")
    assert len(found) == N and "checksum" in " ".join(reader.damage.places)


@pytest.mark.parametrize("message_size", [40, 6000])
def test_a_log_that_was_left_over_is_read_and_left_alone(tmp_path, message_size):
    """rosbag2's resilient storage writes ahead; a killed recorder leaves the log beside the database."""
    file = tmp_path / "live" / "a_0.db3"
    file.parent.mkdir()
    payloads = [RNG.integers(0, 256, message_size).astype("u1").tobytes() for _ in range(40)]
    live = sqlite3.connect(file)
    live.execute("PRAGMA journal_mode=WAL")
    live.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
    )
    live.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
        "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
    )
    live.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    live.execute("INSERT INTO topics VALUES(1, '/bytes', ?, 'cdr')", (BYTES,))
    for n, payload in enumerate(payloads):
        live.execute("INSERT INTO messages VALUES(NULL, 1, ?, ?)", (START + n, payload))
        live.commit()
        if n == 15:
            live.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    live.execute("INSERT INTO messages VALUES(NULL, 1, 1, x'00')")  # not committed
    left = tmp_path / "left"
    shutil.copytree(file.parent, left)
    live.close()
    (left / "a_0.db3-shm").unlink()
    before = {f.name: hashlib.md5(f.read_bytes()).hexdigest() for f in left.iterdir()}
    found, reader = read(left)
    assert found == payloads and reader.damage.n_read == 40 and reader.damage.n_lost == 0
    assert [s.count for s in reader.streams] == [40]
    assert "metadata.yaml is missing" in reader.notes[0]
    assert before == {f.name: hashlib.md5(f.read_bytes()).hexdigest() for f in left.iterdir()}
    log = left / "a_0.db3-wal"
    log.write_bytes(log.read_bytes()[:-3000])
    found, _ = read(left)
    assert 16 <= len(found) <= 40 and found == payloads[: len(found)]


def test_folders_without_metadata_and_with_several_files(bags, tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    for n in (10, 9):
        shutil.copy(bags["db3"][0], folder / f"bag_{n}.db3")
    found, reader = read(folder)
    assert found == PAYLOADS * 2 and reader.damage.whole
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  message_count: 200\n  relative_file_paths: [bag_9.db3, bag_10.db3]\n"
    )
    found, reader = read(folder)
    assert len(found) == 2 * N and reader.damage.n_lost == 200 - 2 * N
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    assert read(folder)[0] == PAYLOADS * 2
    (folder / "bag_9.db3").write_bytes(b"x" * 4000)
    found, reader = read(folder)
    assert found == PAYLOADS and "bag_9.db3" in reader.damage.places[0]


def test_a_file_compressed_as_a_whole(bags, tmp_path):
    import zstandard

    folder = tmp_path / "bag"
    folder.mkdir()
    packed = zstandard.compress(bags["db3"][0].read_bytes())
    (folder / "bag_0.db3.zstd").write_bytes(packed)
    found, reader = read(folder)
    assert found == PAYLOADS and reader.damage.whole and reader._temporary == []
    (folder / "bag_0.db3.zstd").write_bytes(packed[: len(packed) * 4 // 5])
    found, reader = read(folder)
    assert found == PAYLOADS[: len(found)] and len(found) < N and not reader.damage.whole


@pytest.mark.skipif(not ROSBAG1.is_dir(), reason="the sample bags are not here")
@pytest.mark.parametrize("name", ["example", "example-lz4", "example-bz2"])
def test_real_bags_that_were_cut(name, tmp_path):
    data = (ROSBAG1 / f"{name}.bag").read_bytes()
    needed = ends_ros1(ROSBAG1 / f"{name}.bag") if name == "example" else None
    last = 0
    for k in (9, 77, 131, 197):
        size = len(data) * k // 200
        (tmp_path / "a.bag").write_bytes(data[:size])
        with BagReader(tmp_path / "a.bag") as reader:
            n = sum(1 for _ in reader.records())
        assert n >= last and (needed is None or n == sum(end <= size for end, _ in needed))
        last = n
    assert last > 7500


@pytest.mark.parametrize(
    ("version", "storage", "compression"),
    [
        (1, "sqlite3", None),
        (1, "sqlite3", "lz4"),
        (2, "mcap", None),
        (2, "mcap", "zstd"),
        (2, "sqlite3", None),
    ],
)
def test_memory_does_not_grow_with_the_bag(tmp_path, version, storage, compression):
    """16 MB of messages in chunks of 1 MB, of ROS 1 without an index: few chunks are ever held."""
    sample = ImuSamples(np.array([START]), np.zeros((1, 3)), np.full((1, 3), 9.0))
    path, noise = tmp_path / "bag", RNG.integers(0, 256, 400_000).astype("u1").tobytes()
    with BagWriter(path, version, compression, storage) as bag:
        for n in range(40):
            bag.write_raw("/bytes", BYTES, noise, START + n)
            bag.write("/imu", sample, START + n)
    if version == 1:
        path.write_bytes(path.read_bytes()[:-5000])
    gc.collect()
    gc.disable()  # what is held in circles would stay
    tracemalloc.start()
    try:
        with BagReader(path) as reader:
            for _ in reader.records():
                pass
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        gc.enable()
    assert reader.damage.n_read >= 76 and peak < 8e6
