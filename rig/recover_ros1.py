"""Rescue of ROS 1 bags: every whole message, byte for byte, into a new bag with an index."""

from __future__ import annotations

import hashlib
import re
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from acino_fte.data_tools.bags_ros1 import Ros1Walk, parse_fields
from acino_fte.data_tools.bags_serial import ROS1
from acino_fte.data_tools.bags_window import Channel, Losses, Messages, RawMessage
from acino_fte.data_tools.ros_messages import DEFINITIONS, type_name
from acino_fte.errors import InputError
from acino_fte.extras import missing_package
from acino_fte.rig.recover_bags import UNKNOWN, by_topic, plausible, salvaged
from acino_fte.rig.recover_types import Noted, Salvaged, Tally

_TYPE = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*")
_OLD = re.compile(rb"#ROSBAG V1\.\d")


class _Ros1(Ros1Walk):
    """A walk that keeps the heads of connections, and goes on where the file's first bytes are lost."""

    def __init__(self, path: Path, losses: Losses) -> None:
        self.heads: dict[int, dict[bytes, bytes]] = {}
        self.compression = ""
        try:
            super().__init__(path, losses)
        except InputError:
            with path.open("rb") as file:
                if _OLD.match(file.read(12)):
                    raise
            losses.note("the first bytes of the bag are damaged")

    def _connection(self, fields: dict[bytes, bytes], data: bytes) -> None:
        """Keep the first head of a connection whose definition can be read: the file has each twice."""
        number, head = int.from_bytes(fields[b"conn"], "little"), parse_fields(data) or {}
        if number not in self.heads or not _sound_head(self.heads[number]):
            if _sound_head(head):
                self.channels.pop(number, None)
            self.heads[number] = head
        super()._connection(fields, data)

    def _message(self, fields: dict[bytes, bytes], data: bytes, place: str) -> Messages:
        """Messages of connections whose heads are lost are kept too, by their numbers."""
        number = int.from_bytes(fields[b"conn"], "little")
        stamp = int.from_bytes(fields[b"time"][:4], "little") * 10**9
        if number not in self.channels and plausible(number, stamp):
            self.losses.note(f"the connection {number} is not told of: its topic and type are lost")
            self.channels[number] = Channel(
                f"/recovered/connection_{number}", UNKNOWN, "", "ros2msg", ROS1, 1
            )
        yield from super()._message(fields, data, place)

    def _chunk(self, window: Any, fields: dict[bytes, bytes], skip: int, length: int) -> Any:
        self.compression = self.compression or fields[b"compression"].decode("latin1")
        return super()._chunk(window, fields, skip, length)


def salvage_ros1(source: Path, target: Path | None) -> Salvaged:
    """Copy every whole message of a ROS 1 bag.

    Parameters
    ----------
    source : Path
        The bag; only read.
    target : Path, optional
        The new bag, with the same compression; without it the messages are only counted.
    """
    losses, tally = Noted(), Tally()
    walk = _Ros1(source, losses)
    indexed = walk.overview()
    said = by_topic(walk) if indexed else None
    for channel in walk.channels.values():
        tally.name(channel.topic, channel.type)
    write = _Ros1Writer(walk, target) if target is not None else None
    try:
        for message in walk.messages(payloads=target is not None):
            tally.add(message.channel.topic, message.channel.type, message.received_ns, losses.n_notes)
            if write is not None:
                write.message(message)
        if write is not None:
            write.close()
    finally:
        if write is not None:
            write.abort()
    return salvaged("ROS 1 bag", losses, tally, said, indexed)


@lru_cache(maxsize=256)
def _digest(definition: str, kind: str) -> str:
    """MD5 sum of a definition as ROS 1 makes it; empty where the definition cannot be read."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    try:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(definition, kind))
        return str(store.generate_msgdef(kind)[1])
    except Exception:  # noqa: BLE001 - whatever a damaged definition makes the parser raise
        return ""


def _sound_head(head: dict[bytes, bytes]) -> bool:
    """Whether the head of a connection names a type, and has its definition and the sum of it."""
    kind = type_name(head.get(b"type", b"").decode("utf-8", "replace"))
    text = head.get(b"message_definition", b"").decode("utf-8", "replace")
    return bool(_TYPE.fullmatch(kind)) and _digest(text, kind) == head.get(b"md5sum", b"*").decode("latin1")


@lru_cache(maxsize=256)
def _standard(kind: str) -> tuple[str, str]:
    """Definition and MD5 sum of a type that ROS 1 or a driver has; those of nothing for others."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    if kind not in store.fielddefs:
        return "", hashlib.md5(b"").hexdigest()  # noqa: S324 - as ROS makes it
    return store.generate_msgdef(kind)


class _Ros1Writer:
    """Writes a bag; its compression is known with the first message."""

    def __init__(self, walk: _Ros1, target: Path) -> None:
        self._walk, self._target = walk, target
        self._writer: Any = None
        self._connections: dict[int, Any] = {}

    def message(self, message: RawMessage) -> None:
        """Write one message as it is."""
        if self._writer is None:
            self._open()
        key = id(message.channel)  # channels may be equal and yet be two
        if key not in self._connections:
            self._connections[key] = self._connection(message)
        self._writer.write(self._connections[key], message.received_ns, message.data)

    def _open(self) -> None:
        try:
            from rosbags.rosbag1 import Writer
        except ImportError as error:
            raise missing_package("Bags", error) from error
        self._writer = Writer(self._target)
        if self._walk.compression in ("bz2", "lz4"):
            self._writer.set_compression(Writer.CompressionFormat[self._walk.compression.upper()])
        self._writer.open()

    def _connection(self, message: RawMessage) -> Any:
        channel = message.channel
        number = next(n for n, known in self._walk.channels.items() if known is channel)
        head = self._walk.heads.get(number, {})
        caller = head.get(b"callerid")
        latching = head.get(b"latching", b"")
        kind = channel.type if _TYPE.fullmatch(channel.type) else UNKNOWN
        text, digest = channel.definition, head.get(b"md5sum", b"*").decode("latin1") or "*"
        if not _sound_head(head):  # other programs refuse a bag whose definitions and sums do not fit
            found = _digest(text, kind) if kind == channel.type else ""
            text, digest = (text, found) if found else _standard(kind)
        options: dict[str, Any] = {
            "msgdef": text,
            "md5sum": digest,
            "callerid": caller.decode("utf-8", "replace") if caller is not None else None,
            "latching": int(latching) if latching.isdigit() else None,
        }
        for connection in self._writer.connections:  # two that say the same of themselves become one
            if (connection.topic, connection.msgtype) == (channel.topic, kind) and (
                connection.ext.callerid,
                connection.ext.latching,
                connection.digest,
            ) == (options["callerid"], options["latching"], options["md5sum"]):
                return connection
        return self._writer.add_connection(channel.topic, kind, **options)

    def close(self) -> None:
        """End the bag with its index."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def abort(self) -> None:
        """Leave a bag that was not ended."""
        if self._writer is not None:
            with suppress(Exception):  # noqa: BLE001 - the file is thrown away
                self._writer.bio.close()
