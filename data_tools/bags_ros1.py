"""ROS 1 bags (version 2.0), record by record in the order of the file, whole or not.

A record is a head (fields ``name=value``) and data, each after its length. Chunks hold messages and the
connections they are of; an uncompressed chunk is but more records, and is walked as such. The index is used
for counts only: ``rosbags`` needs it, holds an entry for each message and refuses a bag without one, so the
walk is made here.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

from acino_fte.data_tools.bags_serial import ROS1
from acino_fte.data_tools.bags_window import (
    Channel,
    FileWalk,
    FileWindow,
    Losses,
    Messages,
    RawMessage,
    Unpacked,
    Window,
)
from acino_fte.data_tools.ros_messages import type_name
from acino_fte.errors import InputError

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _HEAD, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_NEEDED = {
    _MESSAGE: {b"conn": 4, b"time": 8},
    _HEAD: {b"index_pos": 8},
    _INDEX: {b"conn": 4, b"count": 4},
    _CHUNK: {b"compression": 0, b"size": 4},
    _CHUNK_INFO: {b"chunk_pos": 8, b"count": 4},
    _CONNECTION: {b"conn": 4, b"topic": 0},
}
_MOST_HEAD = 1 << 16
_BACK = 512  # bytes before the field `op` in which its head begins
_MOST_CHUNK = 1 << 31
_SCAN = 1 << 20
_OP = re.compile(rb"\x04\0\0\0op=[\x02-\x07]", re.DOTALL)


class Ros1Walk(FileWalk):
    """Walks through one ROS 1 bag.

    Raises
    ------
    InputError
        The bag is of another version, or encrypted.
    """

    def __init__(self, path: Path, losses: Losses) -> None:
        super().__init__(path, losses)
        self._index_counts = self._info_counts = 0
        self._payloads = True
        self._file_end = path.stat().st_size
        with path.open("rb") as file:
            magic = file.read(len(MAGIC))
        if magic != MAGIC:
            raise InputError(
                "The bag is of a version that is not read.",
                file=path,
                expected="#ROSBAG V2.0",
                found=magic.decode("latin1").strip(),
                remedy="convert it with `rosbag fix` of ROS 1",
            )

    def overview(self) -> bool:
        """Connections and counts from the index; whether there is a sound one."""
        self.counts.clear()
        with self.path.open("rb") as file:
            window = FileWindow(file, self._file_end)
            window.seek(len(MAGIC))
            head = parse_head(window.peek(_BACK))
            if head is None or head[0] != _HEAD:
                return False
            if head[1].get(b"encryptor"):
                raise InputError("The bag is encrypted.", file=self.path, remedy="decrypt it with ROS 1")
            at = struct.unpack("<Q", head[1][b"index_pos"])[0]
            if not len(MAGIC) < at <= self._file_end:
                return False
            window.seek(at)
            while window.at < self._file_end:
                found = self._head(window)
                if found is None or found[0] not in (_CONNECTION, _CHUNK_INFO):
                    return False
                op, fields, skip, length = found
                window.skip(skip)
                data = window.take(length)
                if op == _CONNECTION:
                    self._connection(fields, data)
                else:
                    for i in range(0, len(data) - 7, 8):
                        conn, n = struct.unpack_from("<II", data, i)
                        self.counts[conn] = self.counts.get(conn, 0) + n
        return set(self.counts) <= set(self.channels)

    def _connections_at_end(self) -> None:
        """Connections of an index that is not where the head says."""
        with self.path.open("rb") as file:
            file.seek(max(self._file_end - _SCAN, len(MAGIC)))
            data = memoryview(file.read())
        for match in _OP.finditer(data):
            for at in range(match.start() - 4, max(match.start() - _BACK, -1), -1):
                found = (
                    parse_head(data[at : at + 2 * _BACK]) if data[match.end() - 1] == _CONNECTION else None
                )
                if found and found[0] == _CONNECTION and at + found[2] + found[3] <= len(data):
                    self._connection(found[1], bytes(data[at + found[2] : at + found[2] + found[3]]))
                    break

    def messages(self, payloads: bool = True) -> Messages:
        """All whole messages; without `payloads` their data are left empty."""
        self._payloads = payloads
        indexed = self.overview()  # the chunk that has the connections may be damaged
        if not indexed:
            self._connections_at_end()
        self._index_counts = self._info_counts = 0
        with self.path.open("rb") as file:
            window = FileWindow(file, self._file_end)
            window.seek(len(MAGIC))
            yield from self._records(window, "byte")
        if not indexed:
            self.losses.note("the bag has no whole index: it was cut, damaged or not closed")
        self.losses.expected = max(self._index_counts, self._info_counts)

    def _records(self, window: Window, unit: str) -> Messages:
        """Records of the file, or of an unpacked chunk."""
        chunk_end = None  # of the uncompressed chunk that the window stands in
        while True:
            if chunk_end is not None and window.at >= chunk_end:
                chunk_end = None
            found = self._head(window, chunk_end)
            if found is None:
                if not window.peek(1):
                    return
                if not self._resync(window, unit):
                    return
                continue
            op, fields, skip, length = found
            if op == _CHUNK and not isinstance(window, Unpacked):
                chunk_end = yield from self._chunk(window, fields, skip, length)
                continue
            start = window.at
            window.skip(skip)
            needed = op in (_CONNECTION, _CHUNK_INFO) or (op == _MESSAGE and self._payloads)
            data = window.take(length) if needed else b""
            if (len(data) if needed else window.skip(length)) < length:
                self.losses.note(f"a record at {unit} {start} is cut", int(op == _MESSAGE), window.at - start)
                return
            if op == _MESSAGE:
                yield from self._message(fields, data, f"{unit} {start}")
            elif op == _CONNECTION:
                self._connection(fields, data)
            elif op == _INDEX:
                self._index_counts += struct.unpack("<I", fields[b"count"])[0]
            elif op == _CHUNK_INFO:
                self._info_counts += sum(struct.unpack_from("<I", data, i)[0] for i in range(4, len(data), 8))

    def _message(self, fields: dict[bytes, bytes], data: bytes, place: str) -> Messages:
        conn = struct.unpack("<I", fields[b"conn"])[0]
        channel = self.channels.get(conn)
        if channel is None:
            self.losses.note(f"the message at {place} is of the unknown connection {conn}", 1, len(data))
            return
        seconds, rest = struct.unpack("<II", fields[b"time"])
        self.losses.read += 1
        yield RawMessage(channel, seconds * 10**9 + rest, data)

    def _connection(self, fields: dict[bytes, bytes], data: bytes) -> None:
        more = parse_fields(data) or {}
        conn = struct.unpack("<I", fields[b"conn"])[0]
        topic = (fields[b"topic"] or more.get(b"topic", b"")).decode("utf-8", "replace")
        definition = more.get(b"message_definition", b"").decode("utf-8", "replace")
        kind = type_name(more.get(b"type", b"").decode("utf-8", "replace"))
        self.channels.setdefault(conn, Channel(topic, kind, definition, "ros2msg", ROS1, 1))

    def _chunk(self, window: Any, fields: dict[bytes, bytes], skip: int, length: int) -> Any:
        """Walk into a chunk. Of an uncompressed one the end is returned: its records are the file's."""
        compression = fields[b"compression"].decode("latin1")
        start = window.at
        window.skip(skip)
        data_at = window.at
        end = data_at + length
        known = end <= self._file_end and (
            end == self._file_end or parse_head(window.peek_at(end, _MOST_HEAD)) is not None
        )
        if compression in ("", "none"):
            return end if known else None
        try:
            size = struct.unpack("<I", fields[b"size"])[0]
            room = min(length, self._file_end - data_at)
            if not length and not known:  # a recorder that is killed has not come back to write the lengths
                room, size = self._file_end - data_at, _MOST_CHUNK
            inner = Unpacked(window, room, compression, size)
        except ValueError as error:
            self.losses.note(f"the chunk at byte {start} is not read: {error}", 0, length)
            window.seek(min(end, self._file_end))
            return None
        yield from self._records(inner, f"chunk at byte {start}, its byte")
        if inner.problem:
            self.losses.note(f"the chunk at byte {start} is not whole: {inner.problem}", 0, room - inner.used)
        window.seek(end if known else min(data_at + inner.used, self._file_end))
        return None

    def _head(
        self, window: Window, chunk_end: int | None = None
    ) -> tuple[int, dict[bytes, bytes], int, int] | None:
        """(op, fields, bytes up to the data, bytes of data) of the record here; None where there is none."""
        first = window.peek(256)
        if len(first) < 8:
            return None
        size = int.from_bytes(first[:4], "little")
        if size > _MOST_HEAD:
            return None
        parsed = parse_head(first if size + 8 <= len(first) else window.peek(size + 8))
        if parsed is None:
            return None
        op, fields, skip, length = parsed
        end = window.at + skip + length
        if op != _CHUNK and end > (window.end if chunk_end is None else chunk_end):
            return None
        return op, fields, skip, length

    def _resync(self, window: Window, unit: str) -> bool:
        """Go to the next record after damage; False at the end of the bytes."""
        start, cut = window.at, False
        first = window.peek(_BACK)
        cut = (parsed := parse_head(first)) is not None and parsed[0] == _MESSAGE
        window.skip(1)
        while True:
            block = window.peek(_SCAN + _BACK)
            for match in _OP.finditer(block):
                for at in range(match.start() - 4, max(match.start() - _BACK, -1), -1):
                    if int.from_bytes(block[at : at + 4], "little") > _BACK:
                        continue
                    found = parse_head(block[at : at + 2 * _BACK])
                    if found and self._fits(found, window.at + at, window):
                        window.skip(at)
                        self.losses.note(
                            f"{window.at - start} bytes from {unit} {start} on are no record",
                            int(cut),
                            window.at - start,
                        )
                        return True
            if len(block) < _SCAN + _BACK:
                window.skip(len(block))
                self.losses.note(
                    f"the bytes end in a record that begins at {unit} {start}", int(cut), window.at - start
                )
                return False
            window.skip(_SCAN)

    def _fits(self, head: tuple[int, Any, int, int], at: int, window: Window) -> bool:
        op, fields, skip, length = head
        if op == _CHUNK:
            return not isinstance(window, Unpacked)
        known = op != _MESSAGE or struct.unpack("<I", fields[b"conn"])[0] in self.channels
        return known and at + skip + length <= window.end


def parse_fields(data: bytes | memoryview) -> dict[bytes, bytes] | None:
    """Fields of a head: each a length u32, then ``name=value``. None where they do not fill it exactly."""
    data = bytes(data)
    fields, at = {}, 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        end = at + 4 + size
        name, sep, value = data[at + 4 : end].partition(b"=")
        if end > len(data) or not sep or not name:
            return None
        fields[name] = value
        at = end
    return fields


def parse_head(data: memoryview) -> tuple[int, dict[bytes, bytes], int, int] | None:
    """(op, fields, bytes up to the data, bytes of data) of a record at the start of some bytes."""
    if len(data) < 8:
        return None
    size = int.from_bytes(data[:4], "little")
    if size + 8 > len(data) or size > _MOST_HEAD:
        return None
    fields = parse_fields(data[4 : 4 + size])
    if fields is None or len(fields.get(b"op", b"")) != 1:
        return None
    op = fields[b"op"][0]
    needed = _NEEDED.get(op)
    if needed is None:
        return None
    for name, width in needed.items():
        if name not in fields or (width and len(fields[name]) != width):
            return None
    return op, fields, size + 8, int.from_bytes(data[4 + size : 8 + size], "little")
