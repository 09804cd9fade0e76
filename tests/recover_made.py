"""Small recordings for the tests and the benchmark of rig recover, and what a cut leaves of each, told by
their layout alone."""

import io
import sqlite3
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
from lvx_synthetic import packages, recording

from acino_fte.data_tools.bags_write import BagWriter

N = 48
START = 1_700_000_000_000_000_000
STEP = 10_000_000
BYTES = "std_msgs/msg/UInt8MultiArray"
_RNG = np.random.default_rng(5)
PAYLOADS = [_RNG.integers(0, 256, _RNG.integers(60, 1200)).astype("u1").tobytes() for _ in range(N)]
BAGS = ("ros1-none", "ros1-bz2", "ros1-lz4", "mcap-none", "mcap-lz4", "mcap-zstd", "db3")
LVXS = ("lvx-1.0", "lvx-1.1", "lvx-2")


def make(folder: Path, form: str) -> tuple[Path, list[tuple[int, int]]]:
    """A recording of 20 to 60 KB; and of each whole thing (message, chunk, package) where it ends and how
    many messages it has."""
    kind, _, how = form.partition("-")
    if kind == "mcap":
        path = folder / f"{form}.mcap"
        return path, make_mcap(path, how)
    if kind == "lvx":
        path = folder / f"{form}.lvx"
        data = recording(path, how, n_frames=8, per=2, share=0.9)
        return path, [(stop, 1) for _, stop, *_ in packages(data, how)]
    path = folder / f"{form}.bag"
    with BagWriter(path, 2 if kind == "db3" else 1, {"": None, "none": None}.get(how, how)) as bag:
        bag._writer.chunk_threshold = 4000
        for n, payload in enumerate(PAYLOADS):
            bag.write_raw(f"/bytes{n % 3}", BYTES, payload, START + n * STEP)
    if kind == "db3":
        (file,) = path.glob("*.db3")
        path = file.rename(folder / "bag.db3")
        return path, ends_db3(path.read_bytes())
    return path, ends_ros1(path)


def ends_ros1(path: Path) -> list[tuple[int, int]]:
    """By the index, as rosbags reads it: of a compressed chunk all messages, where it ends; else each."""
    from rosbags.rosbag1 import Reader

    data, needed = path.read_bytes(), []
    with Reader(path) as reader:
        entries = [entry for index in reader.indexes.values() for entry in index]
        for position, chunk in reader.chunks.items():
            offsets = [entry.offset for entry in entries if entry.chunk_pos == position]
            if data[chunk.datapos : chunk.datapos + 2] in (b"BZ", b"\x04\x22"):
                needed.append((chunk.datapos + chunk.datasize, len(offsets)))
                continue
            for offset in offsets:
                at = chunk.datapos + offset
                while True:
                    (head,) = struct.unpack_from("<I", data, at)
                    (size,) = struct.unpack_from("<I", data, at + 4 + head)
                    message = b"op=\x02" in data[at : at + 4 + head]
                    at += 8 + head + size
                    if message:
                        break
                needed.append((at, 1))
    return needed


def make_mcap(path: Path, compression: str) -> list[tuple[int, int]]:
    """With a chunk every few messages; of an uncompressed chunk each message counts."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    form = CompressionType[compression.upper()]
    out = io.BytesIO()
    writer = Writer(out, chunk_size=4000, compression=form)
    writer.start("ros2")
    schema = writer.register_schema(BYTES, "ros2msg", b"")
    channels = [writer.register_channel(f"/bytes{i}", "cdr", schema, {"k": "v"}) for i in range(3)]
    writer.add_metadata("who", {"name": "test"})
    writer.add_attachment(START, START, "a.txt", "text/plain", b"attached")
    for n, payload in enumerate(PAYLOADS):
        writer.add_message(channels[n % 3], START + n * STEP, payload, START + n * STEP - 777, n)
    writer.finish()
    data = out.getvalue()
    path.write_bytes(data)
    if form is CompressionType.NONE:
        return [(data.index(payload) + len(payload), 1) for payload in PAYLOADS]
    chunks = make_reader(io.BytesIO(data)).get_summary().chunk_indexes
    return [
        (c.chunk_start_offset + c.chunk_length, (c.message_end_time - c.message_start_time) // STEP + 1)
        for c in chunks
    ]


def ends_db3(data: bytes) -> list[tuple[int, int]]:
    """A message needs the page of its row, with its first bytes, and that of its last bytes, whole."""
    size = int.from_bytes(data[16:18], "big")
    needed = []
    for payload in PAYLOADS:
        last = next(i for i in map(data.find, (payload[-12:], payload[-6:])) if i > 0)
        needed.append(((max(data.index(payload[:24]), last) // size + 1) * size, 1))
    return needed


def read_standard(path: Path, form: str) -> list[bytes]:
    """Messages as a reader that others wrote gives them; of an LVX its packages, by its frames."""
    if form.startswith("ros1"):
        from rosbags.highlevel import AnyReader

        with AnyReader([path]) as reader:
            return [bytes(raw) for *_, raw in reader.messages()]
    if form.startswith("mcap"):
        from mcap.reader import SeekingReader

        with path.open("rb") as file:
            return [m.data for _, _, m in SeekingReader(file, validate_crcs=True).iter_messages()]
    if form == "db3":
        with sqlite3.connect(path) as database:
            assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            return [row[0] for row in database.execute("SELECT data FROM messages ORDER BY timestamp")]
    data = path.read_bytes()
    return [data[a:b] for a, b, *_ in packages(data, form.partition("-")[2])]


def cuts(n_bytes: int, step: int = 1) -> list[int]:
    """Lengths after which to cut: 200 places, evenly; every one of `step`."""
    return [round(n_bytes * k / 201) for k in range(1, 201)][::step]


def messages_before(needed: list[tuple[int, int]], length: int) -> int:
    """How many messages a file cut after so many bytes still has whole."""
    return sum(n for end, n in needed if end <= length)


def rises(numbers: list[int]) -> bool:
    """Whether numbers never fall."""
    return all(a <= b for a, b in pairwise(numbers))
