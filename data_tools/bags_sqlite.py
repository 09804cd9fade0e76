"""rosbag2's SQLite files (.db3), whole or not.

A sound file is read by SQLite, message by message. From the first damage on, and where a write-ahead log was
left over, its pages are read one by one: each leaf of a table holds whole rows, whose long contents go on in
a chain of overflow pages (SQLite, "Database File Format", sections 1.5, 1.6, 2.1 and 4). Nothing is written:
SQLite itself would merge the log into the file.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, BinaryIO

from acino_fte.data_tools.bags_serial import LAYOUTS
from acino_fte.data_tools.bags_window import (
    ZSTD,
    Channel,
    FileWalk,
    Losses,
    Messages,
    RawMessage,
    decompressor,
)
from acino_fte.data_tools.ros_messages import type_name

MAGIC = b"SQLite format 3\0"
BROKEN = (sqlite3.Error, ValueError, OverflowError)  # what a damaged database makes SQLite's module raise
_LEAF = 13
_FIRST_PAGES = 64  # hold topics and definitions, as these are written first
_INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}


class SqliteWalk(FileWalk):
    """Walks through one .db3 file."""

    def __init__(self, path: Path, losses: Losses) -> None:
        super().__init__(path, losses)
        self._log = path.with_name(path.name + "-wal")
        self._last = 0  # number of the last row that SQLite gave

    def _connect(self) -> sqlite3.Connection:
        """Read only, and immutable: nothing is locked, made or merged."""
        uri = self.path.resolve().as_uri() + "?mode=ro&immutable=1"
        connection = sqlite3.connect(uri, uri=True)
        connection.text_factory = lambda raw: raw.decode("utf-8", "replace")
        return connection

    def _logged(self) -> bool:
        return self._log.is_file() and self._log.stat().st_size > 32

    def overview(self) -> bool:
        """Topics and counts as SQLite reads them; whether it does."""
        if self._logged() or self.path.stat().st_size < self._size_said():
            return False
        try:
            with closing(self._connect()) as connection:
                self._topics(connection)
                rows = connection.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id")
                self.counts = dict(rows.fetchall())
        except BROKEN:
            return False
        return True

    def _topics(self, connection: sqlite3.Connection) -> None:
        known = {row[1] for row in connection.execute("PRAGMA table_info(message_definitions)")}
        texts = {}
        if {"topic_type", "encoding", "encoded_message_definition"} <= known:
            select = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            texts = {row[0]: (row[1], row[2]) for row in connection.execute(select)}
        for row in connection.execute("SELECT id, name, type, serialization_format FROM topics"):
            self._topic(row[0], row[1:4], texts)

    def _topic(self, number: int, strings: Any, texts: dict[str, Any]) -> None:
        """A row of the table of topics: name, type, serialisation."""
        name, kind, form = (value if isinstance(value, str) else "" for value in strings)
        encoding, definition = texts.get(kind, ("", ""))
        encoding = "ros2idl" if encoding == "ros2idl" else "ros2msg"
        channel = Channel(name, type_name(kind), definition or "", encoding, LAYOUTS.get(form), 2)
        self.channels[number] = channel

    def messages(self, payloads: bool = True) -> Messages:
        """All whole messages; without `payloads` their data are left empty."""
        self._last = 0
        if not self._logged() and self.path.stat().st_size >= self._size_said():
            try:
                with closing(self._connect()) as connection:
                    self._topics(connection)
                    what = "data" if payloads else "x''"
                    select = f"SELECT id, topic_id, timestamp, {what} FROM messages ORDER BY id"  # noqa: S608
                    for number, topic, stamp, data in connection.execute(select):
                        if not isinstance(number, int) or number <= self._last:
                            raise ValueError("its rows are out of order")
                        yield from self._message(topic, stamp, data)
                        self._last = number
                return
            except BROKEN as error:
                self.losses.note(
                    f"SQLite stops after row {self._last} ({error}); its pages are read one by one"
                )
        yield from self._pages()

    def _size_said(self) -> int:
        with self.path.open("rb") as file:
            head = file.read(100)
        return page_size(head) * int.from_bytes(head[28:32], "big")

    def _message(self, topic: Any, stamp: Any, data: Any) -> Messages:
        channel = self.channels.get(topic)
        if channel is None or not isinstance(stamp, int) or not isinstance(data, bytes):
            self.losses.note(f"a message is of the unknown topic {topic}", 1)
            return
        self.losses.read += 1
        if data[:4] == ZSTD:
            data = _unpacked(data)
        yield RawMessage(channel, stamp, data)

    def _pages(self) -> Messages:
        """Messages of all leaves after the row that SQLite gave last."""
        with self.path.open("rb") as file:
            head = file.read(100)
            size = page_size(head)
            if len(head) < 100 or not size:
                self.losses.note("the head of the database is damaged")
                return
            pages = Pages(file, size, size - head[20], self._log)
            try:
                self._find_topics(pages)
                last = self._last
                leaves = ((pages.first_row(page), page) for page in range(1, pages.count + 1))
                for _, page in sorted(leaf for leaf in leaves if leaf[0] is not None):
                    for number, row in pages.rows(page, self.losses):
                        if is_message(row) and number > last:
                            yield from self._message(row[1], row[2], row[3])
                missing = pages.said - pages.count
                if missing > 0:
                    self.losses.note(f"{missing} pages are cut off", 0, missing * size)
            finally:
                pages.close()

    def _find_topics(self, pages: Pages) -> None:
        """Topics and definitions: rows of texts, before the messages in the file."""
        texts: dict[str, tuple[str, str]] = {}
        topics: list[tuple[int, list[str]]] = []
        quiet = Losses()
        for page in range(1, pages.count + 1):
            for number, row in pages.rows(page, quiet):
                if is_message(row):
                    continue
                strings = [value for value in row[1:5] if isinstance(value, str)]
                if len(row) >= 4 and row[0] is None and len(strings) >= 3:
                    if strings[1] in ("ros2msg", "ros2idl"):
                        texts[strings[0]] = (strings[1], strings[2])
                    elif strings[2] in ("cdr", "custom") or "/" in strings[1]:
                        topics.append((number, strings[:3]))
            if topics and page > _FIRST_PAGES:
                break
        for number, strings in topics:
            if number not in self.channels:
                self._topic(number, strings, texts)


class Pages:
    """Pages of a database, those of its write-ahead log in place of its own.

    Parameters
    ----------
    file : file
        Of the database.
    size : int
        Of a page, bytes.
    usable : int
        Of these in use.
    log : Path
        The write-ahead log; it may be missing.
    """

    def __init__(self, file: BinaryIO, size: int, usable: int, log: Path) -> None:
        self._file, self.size, self.usable = file, size, usable
        self._log = log.open("rb") if log.is_file() else None
        self._logged: dict[int, int] = {}
        file.seek(0, 2)
        self._own = file.tell() // size
        self.said = int.from_bytes(self._read(file, 28, 4), "big") or self._own
        if self._log is not None:
            self._read_log(self._log)
        self.count = max([self._own, *self._logged])

    def close(self) -> None:
        """Close the log."""
        if self._log is not None:
            self._log.close()

    @staticmethod
    def _read(file: BinaryIO, at: int, n: int) -> bytes:
        file.seek(at)
        return file.read(n)

    def _read_log(self, log: BinaryIO) -> None:
        """Frames up to the last that ends a transaction, as far as their checksums hold (section 4.2)."""
        head = self._read(log, 0, 32)
        if len(head) < 32 or head[:3] != b"\x37\x7f\x06" or int.from_bytes(head[8:12], "big") != self.size:
            return
        order = ">" if head[3] & 1 else "<"
        sums = _checksum(head[:24], (0, 0), order)
        if sums != struct.unpack(">II", head[24:]):
            return
        pending: dict[int, int] = {}
        while len(frame := log.read(24 + self.size)) == 24 + self.size:
            sums = _checksum(frame[24:], _checksum(frame[:8], sums, order), order)
            if frame[8:16] != head[16:24] or sums != struct.unpack(">II", frame[16:24]):
                return
            page, pages = struct.unpack(">II", frame[:8])
            pending[page] = log.tell() - self.size
            if pages:
                self._logged |= pending
                self.said = pages
                pending = {}

    def page(self, number: int) -> bytes:
        """One page, from 1; fewer bytes where the file is cut."""
        if number in self._logged and self._log is not None:
            return self._read(self._log, self._logged[number], self.size)
        return self._read(self._file, (number - 1) * self.size, self.size)

    def first_row(self, number: int) -> int | None:
        """Number of the first row of a leaf of a table; None of another page."""
        page = self.page(number)
        at = 100 if number == 1 else 0
        if len(page) < self.size or page[at] != _LEAF or page[at + 3 : at + 5] == b"\0\0":
            return None
        try:
            (pointer,) = struct.unpack_from(">H", page, at + 8)
            return _varint(page, _varint(page, pointer)[1])[0]
        except (IndexError, ValueError):
            return 0

    def rows(self, number: int, losses: Losses) -> Iterator[tuple[int, list[Any]]]:
        """Rows (number, values) of a leaf of a table; none of another page."""
        page = self.page(number)
        at = 100 if number == 1 else 0
        if len(page) < self.size or page[at] != _LEAF:
            return
        (cells,) = struct.unpack_from(">H", page, at + 3)
        if at + 8 + 2 * cells > self.size:
            return
        for pointer in struct.unpack_from(f">{cells}H", page, at + 8):
            try:
                yield self._row(page, pointer)
            except (IndexError, ValueError, struct.error) as error:
                losses.note(f"a row in page {number} is not whole ({error})", 1)

    def _row(self, page: bytes, at: int) -> tuple[int, list[Any]]:
        length, at = _varint(page, at)
        number, at = _varint(page, at)
        most = self.usable - 35
        if length <= most:
            content = page[at : at + length]
        else:
            least = (self.usable - 12) * 32 // 255 - 23
            local = least + (length - least) % (self.usable - 4)
            local = local if local <= most else least
            parts = [page[at : at + local]]
            (next_page,) = struct.unpack_from(">I", page, at + local)
            parts += self._overflow(next_page, length - local)
            content = b"".join(parts)
        if len(content) != length:
            raise ValueError(f"{length} bytes, {len(content)} of them there")
        return number, _values(content)

    def _overflow(self, page: int, left: int) -> Iterator[bytes]:
        """The rest of a long content, page after page."""
        while left > 0:
            raw = self.page(page) if 1 < page <= self.count + 1 else b""
            if len(raw) < min(left + 4, self.usable):
                raise ValueError(f"{left} bytes of it are missing")
            part = raw[4 : min(4 + left, self.usable)]
            yield part
            left -= len(part)
            (page,) = struct.unpack_from(">I", raw)


def page_size(head: bytes) -> int:
    """Bytes of a page, by the head of the database; 0 where it says nothing that can be."""
    size = int.from_bytes(head[16:18], "big")
    size = 65536 if size == 1 else size
    return size if 512 <= size <= 65536 and size & (size - 1) == 0 and head[:16] == MAGIC else 0


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for i in range(9):
        byte = data[at + i]
        if i == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 127
        if byte < 128:
            return value, at + i + 1
    raise ValueError("a number is too long")


def _values(content: bytes) -> list[Any]:
    """Values of a row: their types stand before them (section 2.1)."""
    end, at = _varint(content, 0)
    types = []
    while at < end:
        code, at = _varint(content, at)
        types.append(code)
    at, values = end, list[Any]()
    for code in types:
        if code in _INTEGERS:
            n = _INTEGERS[code]
            values.append(int.from_bytes(content[at : at + n], "big", signed=True))
        elif code >= 12:
            n = (code - 12) // 2
            raw = content[at : at + n]
            values.append(raw.decode("utf-8", "replace") if code % 2 else raw)
        else:
            n = 8 if code == 7 else 0
            values.append({8: 0, 9: 1}.get(code))
        at += n
    if at > len(content):
        raise ValueError("its values reach beyond it")
    return values


def _checksum(data: bytes, sums: tuple[int, int], order: str) -> tuple[int, int]:
    a, b = sums
    for x, y in struct.iter_unpack(order + "II", data):
        a = (a + x + b) & 0xFFFFFFFF
        b = (b + y + a) & 0xFFFFFFFF
    return a, b


def is_message(row: list[Any]) -> bool:
    """Whether a row is of the table of messages: id, topic, stamp, data."""
    return (
        len(row) == 4
        and row[0] is None
        and isinstance(row[1], int)
        and isinstance(row[2], int)
        and isinstance(row[3], bytes)
    )


def _unpacked(data: bytes) -> bytes:
    """A message that rosbag2 compressed by itself; as it is where it does not unpack."""
    unpack = decompressor("zstd")
    try:
        return unpack.decompress(data)
    except Exception:  # noqa: BLE001 - the library's own errors
        return data
