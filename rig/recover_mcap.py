"""Rescue of MCAP files: every whole message with its stamps and channel, into a new file with an index."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from acino_fte.data_tools.bags_mcap import MAGIC, McapWalk, chunk_fields
from acino_fte.data_tools.bags_window import Channel, Losses, Messages, RawMessage
from acino_fte.extras import missing_package
from acino_fte.rig.recover_bags import by_topic, plausible, salvaged
from acino_fte.rig.recover_types import Noted, Salvaged, Tally

_SCHEMA, _CHANNEL, _ATTACHMENT, _METADATA, _DATA_END, _FOOTER = 3, 4, 9, 12, 15, 2
_HEAD = 9  # bytes of a record before its content
_STAMPS = 22  # bytes of a message before its data


class _Mcap(McapWalk):
    """A walk that keeps schemas, channels and messages as they stand in the file."""

    def __init__(self, path: Path, losses: Losses) -> None:
        super().__init__(path, losses)
        self.schema_bytes: dict[int, bytes] = {}
        self.channel_bytes: dict[int, bytes] = {}
        self.compression: str | None = None
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                losses.note("the first bytes of the file are damaged")

    def _define(self, op: int, content: bytes) -> None:
        super()._define(op, content)
        kept = {_SCHEMA: self.schema_bytes, _CHANNEL: self.channel_bytes}.get(op)
        if kept is not None:
            kept.setdefault(int.from_bytes(content[:2], "little"), content)

    def _message(self, content: bytes, place: str) -> Messages:
        """The message with its number, stamps and channel before its data.

        Messages of channels whose records are lost are kept too, by their numbers.
        """
        number, stamp = int.from_bytes(content[:2], "little"), int.from_bytes(content[6:14], "little")
        if number not in self.channels and plausible(number, stamp):
            self.losses.note(f"the channel {number} is not told of: its topic and type are lost")
            self.channels[number] = Channel(f"/recovered/channel_{number}", "", "", "ros2msg", None, 2)
        for message in super()._message(content, place):
            yield RawMessage(message.channel, message.received_ns, content)

    def _chunk(self, window: Any, length: int) -> Any:
        fields = chunk_fields(window.peek(_HEAD + 64)[_HEAD:])
        if self.compression is None and fields is not None:
            self.compression = fields[2]
        return super()._chunk(window, length)


def salvage_mcap(source: Path, target: Path | None) -> Salvaged:
    """Copy every whole message of an MCAP file, with its stamps, sequence number, schema and channel.

    Parameters
    ----------
    source : Path
        The file; only read.
    target : Path, optional
        The new file, with the same compression; without it the messages are only counted.
    """
    losses, tally = Noted(), Tally()
    walk = _Mcap(source, losses)
    indexed = walk.overview()
    said = by_topic(walk) if indexed and walk.counts else None
    for channel in walk.channels.values():
        tally.name(channel.topic, channel.type)
    if target is None:
        for message in walk.messages(payloads=False):
            tally.add(message.channel.topic, message.channel.type, message.received_ns, losses.n_notes)
    else:
        with target.open("wb") as file:
            write = _McapWriter(walk, file, _profile(source))
            for message in walk.messages():
                tally.add(message.channel.topic, message.channel.type, message.received_ns, losses.n_notes)
                write.message(message)
            write.close(_extras(source))
    topics = {channel.topic: _topic(walk, number) for number, channel in walk.channels.items()}
    found = salvaged("MCAP file", losses, tally, said, indexed)
    return replace(found, topics=topics)


def _load_mcap() -> Any:
    try:
        import mcap.data_stream
        import mcap.exceptions
        import mcap.records
        import mcap.writer
    except ImportError as error:
        raise missing_package("MCAP files", error) from error
    return mcap


class _McapWriter:
    """Writes an MCAP file; its compression is known with the first message."""

    def __init__(self, walk: _Mcap, file: Any, profile: str) -> None:
        self._walk, self._file, self._profile = walk, file, profile
        self._mcap = _load_mcap()
        self._writer: Any = None
        self._channels: dict[int, int] = {}
        self._schemas: dict[int, int] = {}

    def _open(self) -> Any:
        if self._writer is None:
            form = (self._walk.compression or "none").upper()
            self._writer = self._mcap.writer.Writer(
                self._file, compression=self._mcap.writer.CompressionType[form]
            )
            self._writer.start(self._profile, "acino-fte rig recover")
        return self._writer

    def message(self, message: RawMessage) -> None:
        """Write one message as it is."""
        writer, content = self._open(), message.data
        number = int.from_bytes(content[:2], "little")
        if number not in self._channels:
            self._channels[number] = self._channel(writer, number)
        writer.add_message(
            self._channels[number],
            log_time=message.received_ns,
            data=content[_STAMPS:],
            publish_time=int.from_bytes(content[14:22], "little"),
            sequence=int.from_bytes(content[2:6], "little"),
        )

    def _channel(self, writer: Any, number: int) -> int:
        channel = _record(self._mcap, "Channel", self._walk.channel_bytes.get(number, b""))
        if channel is None:  # lost, or damaged
            known = self._walk.channels[number]
            return int(writer.register_channel(known.topic, known.layout.name if known.layout else "", 0))
        schema = self._schema(writer, channel.schema_id)
        return int(
            writer.register_channel(channel.topic, channel.message_encoding, schema, dict(channel.metadata))
        )

    def _schema(self, writer: Any, number: int) -> int:
        """Number of a schema in the copy; 0 where it is lost."""
        if number not in self._schemas:
            schema = _record(self._mcap, "Schema", self._walk.schema_bytes.get(number, b""))
            if schema is None:
                return 0
            self._schemas[number] = writer.register_schema(schema.name, schema.encoding, schema.data)
        return self._schemas[number]

    def close(self, extras: Iterator[Callable[[Any], None]]) -> None:
        """Write what else the file had, and the index."""
        writer = self._open()
        for extra in extras:
            extra(writer)
        writer.finish()


def _record(mcap: Any, kind: str, content: bytes) -> Any | None:
    """A record of the package ``mcap`` from its bytes; None where they are none."""
    stream = mcap.data_stream.ReadDataStream(io.BytesIO(content))
    try:
        return getattr(mcap.records, kind).read(stream)
    except (ValueError, KeyError, IndexError, OverflowError, struct.error, mcap.exceptions.McapError):
        return None


def _topic(walk: _Mcap, number: int) -> dict[str, str]:
    """What metadata.yaml of ROS 2 says of a topic."""
    channel = walk.channels[number]
    out = {"name": channel.topic, "type": channel.type, "serialization_format": "cdr"}
    record = _record(_load_mcap(), "Channel", walk.channel_bytes.get(number, b""))
    if record is not None:
        out["serialization_format"] = record.message_encoding
        out["offered_qos_profiles"] = record.metadata.get("offered_qos_profiles", "")
        out["type_description_hash"] = record.metadata.get("topic_type_hash", "")
    return out


def _outer(source: Path) -> Iterator[tuple[int, Any, int]]:
    """(op, file, bytes) of records outside of chunks, up to the first damage; the file stands at each."""
    size = source.stat().st_size
    with source.open("rb") as file:
        at = len(MAGIC)
        while True:
            file.seek(at)
            head = file.read(_HEAD)
            length = int.from_bytes(head[1:], "little")
            if len(head) < _HEAD or not 1 <= head[0] <= 0x0F or at + _HEAD + length > size:
                return
            if head[0] in (_DATA_END, _FOOTER):
                return
            yield head[0], file, length
            at += _HEAD + length


def _profile(source: Path) -> str:
    """The profile that the file's head names, such as ``ros2``."""
    for op, file, length in _outer(source):
        content = file.read(length) if op == 1 else b""
        n = int.from_bytes(content[:4], "little")
        return content[4 : 4 + n].decode("utf-8", "replace")
    return ""


def _extras(source: Path) -> Iterator[Callable[[Any], None]]:
    """Attachments and metadata, as calls of a writer."""
    mcap = _load_mcap()
    for op, file, length in _outer(source):
        if op not in (_ATTACHMENT, _METADATA):
            continue
        record = _record(mcap, "Attachment" if op == _ATTACHMENT else "Metadata", file.read(length))
        if record is not None:
            yield partial(_add_attachment if op == _ATTACHMENT else _add_metadata, record)


def _add_attachment(record: Any, writer: Any) -> None:
    writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)


def _add_metadata(record: Any, writer: Any) -> None:
    writer.add_metadata(record.name, record.metadata)
