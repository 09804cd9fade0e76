"""MCAP files, record by record in the order of the file, whole or not.

A record is an operation (u8), a length (u64) and its content (specification: mcap.dev). The readers of the
packages ``mcap`` and ``rosbags`` stop at the first damage, or want the summary at the end; this walk goes on.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

from acino_fte.data_tools.bags_serial import LAYOUTS
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

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _STATISTICS, _DATA_END = (
    *(1, 2, 3, 4, 5, 6, 7),
    *(11, 15),
)
_LAST_OP = 15
_LEAST = {_HEADER: 8, _FOOTER: 20, _SCHEMA: 14, _CHANNEL: 16, _MESSAGE: 22, _CHUNK: 40, _INDEX: 6}
_LEAST |= {8: 32, 9: 32, 10: 32, _STATISTICS: 46, 12: 8, 13: 8, 14: 17, _DATA_END: 4}
_SCAN = 1 << 20
_OP = re.compile(rb"(?=[\x01-\x0f].{4}\0\0\0\0)", re.DOTALL)
_COMPRESSIONS = (b"", b"lz4", b"zstd")


class McapWalk(FileWalk):
    """Walks through one MCAP file."""

    def __init__(self, path: Path, losses: Losses) -> None:
        super().__init__(path, losses)
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._indexed = self._stated = 0
        self._payloads = self._done = False
        self._file_end = path.stat().st_size

    def overview(self) -> bool:
        """Channels and counts from the summary at the end; whether there is a sound one."""
        with self.path.open("rb") as file:
            window = FileWindow(file, self._file_end)
            tail = bytes(window.peek_at(max(self._file_end - 37, 0), 37))
            if len(tail) < 37 or tail[-8:] != MAGIC or tail[0] != _FOOTER:
                return False
            start = int.from_bytes(tail[9:17], "little")
            if not 0 < start < self._file_end:
                return False
            window.seek(start)
            while (found := _head(window)) and found[0] != _FOOTER:
                window.skip(9)
                content = window.take(found[1])
                if found[0] == _STATISTICS:
                    rest = content[46:]
                    for i in range(0, len(rest) - 9, 10):
                        channel, n = struct.unpack_from("<HQ", rest, i)
                        self.counts[channel] = n
                else:
                    self._define(found[0], content)
        return bool(self.channels) or not self.counts

    def messages(self, payloads: bool = True) -> Messages:
        """All whole messages; without `payloads` their data are left empty."""
        if not self.channels:  # the chunk that has them may be damaged
            self.overview()
        self._payloads, self._done = payloads, False
        self._indexed = self._stated = 0
        with self.path.open("rb") as file:
            window = FileWindow(file, self._file_end)
            window.seek(len(MAGIC))
            yield from self._records(window, "byte")
        if not self._done:
            self.losses.note("the file ends without its footer: it was cut")
        self.losses.expected = max(self._indexed, self._stated)

    def _records(self, window: Window, unit: str) -> Messages:
        """Records of the file, or of an unpacked chunk."""
        while not self._done:
            found = _head(window)
            if found is None:
                if not window.peek(1) or not self._resync(window, unit):
                    return
                continue
            op, length = found
            if op == _CHUNK and isinstance(window, FileWindow):
                yield from self._chunk(window, length)
                continue
            start = window.at
            if window.at + 9 + length > window.end and not self._resync(window, unit):
                return
            if window.at != start:
                continue
            window.skip(9)
            needed = op in (_SCHEMA, _CHANNEL, _STATISTICS, _INDEX) or (op == _MESSAGE and self._payloads)
            content = window.take(length if needed else min(length, 22))
            rest = length - len(content)
            if rest and (needed or window.skip(rest) < rest):
                self.losses.note(f"a record at {unit} {start} is cut", int(op == _MESSAGE), window.at - start)
                return
            if op == _MESSAGE:
                yield from self._message(content, f"{unit} {start}")
            elif op == _FOOTER:
                self._done = True
            else:
                self._define(op, content)

    def _message(self, content: bytes, place: str) -> Messages:
        number, _, received, published = struct.unpack_from("<HIQQ", content)
        channel = self.channels.get(number)
        if channel is None:
            self.losses.note(f"the message at {place} is of the unknown channel {number}", 1, len(content))
            return
        self.losses.read += 1
        yield RawMessage(channel, received, content[22:], published)

    def _define(self, op: int, content: bytes) -> None:
        """Take what a record says of others."""
        try:
            if op == _SCHEMA:
                name, at = _text(content, 2)
                encoding, at = _text(content, at)
                definition, _ = _text(content, at)
                self._schemas[struct.unpack_from("<H", content)[0]] = (name, encoding, definition)
            elif op == _CHANNEL:
                number, schema = struct.unpack_from("<HH", content)
                topic, at = _text(content, 4)
                form, _ = _text(content, at)
                name, encoding, definition = self._schemas.get(schema, ("", "", ""))
                version = 1 if form == "ros1" else 2
                layout = LAYOUTS.get(form)
                encoding = "ros2idl" if encoding == "ros2idl" else "ros2msg"
                channel = Channel(topic, type_name(name), definition, encoding, layout, version)
                self.channels.setdefault(number, channel)
            elif op == _STATISTICS:
                self._stated = struct.unpack_from("<Q", content)[0]
            elif op == _INDEX:
                self._indexed += struct.unpack_from("<I", content, 2)[0] // 16
        except (struct.error, ValueError) as error:
            self.losses.note(f"a record of what channels hold is damaged ({error})", 0, len(content))

    def _chunk(self, window: FileWindow, length: int) -> Any:
        """The records of a chunk."""
        start = window.at
        end = start + 9 + length
        fields = chunk_fields(window.peek(9 + 40 + 16)[9:])
        known = end <= self._file_end and (end == self._file_end or _head_at(window, end) is not None)
        if fields is None:
            self.losses.note(f"the chunk at byte {start} has a damaged head")
            window.skip(9)  # what records can be made out are walked as those of the file
            return
        size, checksum, compression, skip, packed = fields
        window.skip(9 + skip)
        data_at = window.at
        if not known and compression == "":
            return  # its records are walked as those of the file
        if known:
            packed = end - data_at
        if compression == "":
            size = packed
        room = min(packed, self._file_end - data_at)
        inner = Unpacked(window, room, compression, size)
        yield from self._records(inner, f"chunk at byte {start}, its byte")
        if inner.problem:
            self.losses.note(f"the chunk at byte {start} is not whole: {inner.problem}", 0, room - inner.used)
        elif checksum and inner.checksum != checksum:
            self.losses.note(
                f"the checksum of the chunk at byte {start} is wrong: its messages may be damaged"
            )
        window.seek(end if known else min(data_at + inner.used, self._file_end))

    def _resync(self, window: Window, unit: str) -> bool:
        """Go to the next record after damage; False at the end of the bytes."""
        start = window.at
        cut = (first := window.peek(1)) and first[0] == _MESSAGE and len(window.peek(9)) == 9
        window.skip(1)
        while True:
            block = window.peek(_SCAN + 64)
            for match in _OP.finditer(block[: _SCAN + 9]):
                if match.start() < _SCAN and self._chained(window, block, match.start()):
                    window.skip(match.start())
                    size = window.at - start
                    self.losses.note(
                        f"{size} bytes from {unit} {start} on are no record", int(bool(cut)), size
                    )
                    return True
            if len(block) < _SCAN + 64:
                window.skip(len(block))
                size = window.at - start
                self.losses.note(
                    f"the bytes end in a record that begins at {unit} {start}", int(bool(cut)), size
                )
                return False
            window.skip(_SCAN)

    def _chained(self, window: Window, block: memoryview, at: int) -> bool:
        """Whether a record begins here, and another one, or the end, comes after it."""
        found = _parse(block[at : at + 64])
        if found is None:
            return False
        op, length = found
        here, end = window.at + at, window.at + at + 9 + length
        if op == _CHUNK and not isinstance(window, FileWindow):
            return False
        if op == _MESSAGE:
            number = int.from_bytes(block[at + 9 : at + 11], "little")
            if number not in self.channels:
                return False
        if end > window.end:
            return op == _CHUNK and chunk_fields(block[at + 9 : at + 64]) is not None
        if end == window.end:
            return True
        if isinstance(window, FileWindow):
            return _parse(window.peek_at(end, 64)) is not None or bytes(window.peek_at(end, 8)) == MAGIC
        ahead = window.peek(at + 9 + length + 64)[end - here + at :]
        return _parse(ahead) is not None


def _parse(data: memoryview) -> tuple[int, int] | None:
    """(op, length) of a record at the start of some bytes, if it can be one."""
    if len(data) < 9:
        return None
    op, length = data[0], int.from_bytes(data[1:9], "little")
    if not 1 <= op <= _LAST_OP or length < _LEAST[op]:
        return None
    if op == _CHUNK and len(data) >= 64 and chunk_fields(data[9:]) is None:
        return None
    if op in (_FOOTER, _DATA_END) and length != _LEAST[op]:
        return None
    return op, length


def _head(window: Window) -> tuple[int, int] | None:
    return _parse(window.peek(64))


def _head_at(window: FileWindow, at: int) -> tuple[int, int] | None:
    return _parse(window.peek_at(at, 64))


def chunk_fields(data: memoryview) -> tuple[int, int, str, int, int] | None:
    """(unpacked bytes, CRC-32, compression, bytes before the records, bytes of the records) of a chunk."""
    if len(data) < 40:
        return None
    size, checksum, n = struct.unpack_from("<QII", data, 16)
    name = bytes(data[32 : 32 + n]) if n <= 4 else None
    if name not in _COMPRESSIONS or len(data) < 40 + n:
        return None
    return size, checksum, name.decode(), 40 + n, struct.unpack_from("<Q", data, 32 + n)[0]


def _text(content: bytes, at: int) -> tuple[str, int]:
    """A text after its length u32, and where it ends."""
    (n,) = struct.unpack_from("<I", content, at)
    if at + 4 + n > len(content):
        raise ValueError("a text reaches beyond its record")
    return content[at + 4 : at + 4 + n].decode("utf-8", "replace"), at + 4 + n
