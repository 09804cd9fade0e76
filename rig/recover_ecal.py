"""Rescue of eCAL's recordings (.hdf5) that were not closed: the messages are there, their channels are not.

A recording that was cut has a data set of bytes for each message, but no tables. Which channel a message was
of is told by its content: by which type of ROS its bytes are, to the last one, and by the name of its frame.
Where HDF5 itself cannot find the data sets any more, they are searched by the heads that it writes for them
("HDF5 File Format Specification", version 1 object headers, message 8: data layout).
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from acino_fte.data_tools.bags_ecal import EcalWalk, text_of, topic_of, type_of
from acino_fte.data_tools.bags_serial import CUSTOM, DecodeError, decode, definitions
from acino_fte.data_tools.ros_messages import LIVOX_PACKAGES, XIMEA_TYPE
from acino_fte.errors import InputError
from acino_fte.rig.recover_bags import sentence
from acino_fte.rig.recover_types import Noted, Salvaged, Tally, elsewhere

_LAYOUT = re.compile(rb"\x08\0\x18\0.\0\0\0\x03\x01(.{8})(.{8})", re.DOTALL)
_SCAN = 1 << 24
_MOST = 1 << 31
_END_AT = 40  # of the address of the end of the file, in a superblock of version 0
_TYPES = (
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    XIMEA_TYPE,
    *(f"{package}/msg/CustomMsg" for package in LIVOX_PACKAGES[:1]),
)
_UNKNOWN = "rt/recovered/unknown"


@dataclass
class _Found:
    """A channel that was made out, and the rows of its table."""

    name: str
    type: str
    description: bytes = b""
    rows: list[tuple[int, ...]] = field(default_factory=list)


def ecal_is_whole(source: Path) -> bool:
    """Whether HDF5 opens the file and all tables are there."""
    losses = Noted()
    try:
        walk = EcalWalk(source, losses)
        for _ in walk.messages(payloads=False):
            pass
    except (InputError, OSError, RuntimeError, ValueError, KeyError):
        return False
    return losses.damage().whole and walk.overview()


def salvage_ecal(source: Path, target: Path | None, like: Path | None = None) -> Salvaged:
    """Copy every message that can be found into a recording of eCAL with tables of channels.

    Parameters
    ----------
    source : Path
        The recording; only read.
    target : Path, optional
        The new file; without it the messages are only counted, as the tables tell of them.
    like : Path, optional
        A sound recording of the same channels: their names and types are taken from it.
    """
    if target is None:
        return _inspected(source)
    losses, tally, notes = Noted(), Tally(), list[str]()
    known, sorter = _tables(source), _Sorter(like)
    with _open(target, "w") as out:
        with _entries(source, notes, losses, target.parent) as entries:
            numbers = _copied(entries, out, known, sorter, tally, losses)
        every = {id(channel): channel for channel, *_ in known.values()}
        _close(out, [channel for channel in (*every.values(), *sorter.found) if channel.rows])
    notes += sorter.sentences()
    if numbers and (span := max(numbers) - min(numbers) + 1) < 10 * len(numbers) + 1000:
        losses.lost += span - len(numbers)
    streams = tally.streams()
    damage = losses.damage()
    return Salvaged(
        "eCAL recording (HDF5)",
        False,
        streams,
        elsewhere(losses, streams),
        damage.bytes_lost,
        (*notes, *(sentence(place) for place in damage.places)),
    )


def _copied(
    entries: Iterator[tuple[int, bytes]],
    out: Any,
    known: dict[int, tuple[_Found, int, int]],
    sorter: _Sorter,
    tally: Tally,
    losses: Noted,
) -> set[int]:
    """Write every message, and put it into the table of its channel; returns their numbers."""
    numbers = set[int]()
    for number, data in entries:
        if number in numbers:
            losses.note(f"there are two messages {number}", 1)
            continue
        row = known.get(number)
        channel = row[0] if row else sorter.channel(data)
        stamp = row[1] if row else sorter.stamp_us(data)
        sent = row[2] if row else stamp
        out.create_dataset(str(number), data=np.frombuffer(data, np.uint8))
        channel.rows.append((stamp, number, len(channel.rows), sent, 0))
        tally.add(topic_of(channel.name), type_of(channel.type), stamp * 1000, losses.n_notes)
        losses.read += 1
        numbers.add(number)
    return numbers


def _inspected(source: Path) -> Salvaged:
    losses, tally = Noted(), Tally()
    walk = EcalWalk(source, losses)
    for message in walk.messages(payloads=False):
        tally.add(message.channel.topic, message.channel.type, message.received_ns, losses.n_notes)
    return Salvaged("eCAL recording (HDF5)", losses.damage().whole, tally.streams(), losses.lost)


def _open(path: Path, mode: str) -> Any:
    import h5py

    return h5py.File(path, mode)


def _close(out: Any, channels: list[_Found]) -> None:
    """Write the tables, as eCAL does when it closes a recording."""
    for channel in channels:
        while quote(channel.name, safe="") in out or sum(c.name == channel.name for c in channels) > 1:
            channel.name += "_"
    out.attrs["Version"] = np.bytes_("5.0")
    out.attrs["Channels"] = np.bytes_(",".join(channel.name for channel in channels))
    for channel in channels:
        table = out.create_dataset(quote(channel.name, safe=""), data=np.array(channel.rows, np.int64))
        table.attrs["Channel Name"] = np.bytes_(channel.name)
        table.attrs["Channel Type"] = np.bytes_(channel.type)
        table.attrs["Channel Description"] = (
            np.void(channel.description) if channel.description else np.bytes_("")
        )


# Messages ------------------------------------------------------------------------------------------------


@contextmanager
def _entries(
    source: Path, notes: list[str], losses: Noted, room: Path
) -> Iterator[Iterator[tuple[int, bytes]]]:
    """(number, bytes) of all messages: by HDF5 where it finds them, else by the heads of the data sets."""
    with tempfile.TemporaryDirectory(prefix=".acino-fte-", dir=room) as folder:
        file = _opened(source, Path(folder))
        found = _scanned(source)
        names = _names(file) if file is not None else []
        if file is not None and len(names) >= len(found):
            try:
                yield _by_name(file, names, losses)
            finally:
                file.close()
            return
        if file is not None:
            file.close()
        notes.append(
            "HDF5 does not find the messages any more: they were searched in the file, and their numbers are "
            "those of their order."
        )
        yield _by_place(source, found, losses)


def _opened(source: Path, folder: Path) -> Any | None:
    """The file as HDF5 opens it; one that ends early is filled up with zeros, on a copy."""
    try:
        return _open(source, "r")
    except (OSError, ValueError, RuntimeError):
        pass
    with source.open("rb") as file:
        head = file.read(_END_AT + 8)
    end = int.from_bytes(head[_END_AT:], "little")
    if len(head) < _END_AT + 8 or head[8] != 0 or not source.stat().st_size < end < _MOST:
        return None
    copy = folder / source.name
    shutil.copyfile(source, copy)
    with copy.open("r+b") as file:
        file.truncate(end)
    try:
        return _open(copy, "r")
    except (OSError, ValueError, RuntimeError):
        return None


def _names(file: Any) -> list[int]:
    try:
        return sorted(int(name) for name in file if name.isdigit())
    except (OSError, RuntimeError, ValueError, KeyError):
        return []


def _by_name(file: Any, names: list[int], losses: Noted) -> Iterator[tuple[int, bytes]]:
    for number in names:
        try:
            data = file[str(number)][()].tobytes()
        except (KeyError, OSError, RuntimeError, AttributeError, ValueError) as error:
            losses.note(f"the message {number} cannot be read ({error})", 1)
            continue
        yield number, data


def _scanned(source: Path) -> list[tuple[int, int]]:
    """(place, bytes) of data sets whose heads stand in the file, in the order of the heads."""
    out, base, size = [], 0, source.stat().st_size
    with source.open("rb") as file:
        tail = b""
        while block := file.read(_SCAN):
            data = tail + block
            for match in _LAYOUT.finditer(data):
                at, n = (int.from_bytes(part, "little") for part in match.groups())
                if 0 < at < size and 0 < n < _MOST:
                    out.append((at, n))
            base, tail = base + len(block), data[-25:]
    return list(dict.fromkeys(out))


def _by_place(source: Path, found: list[tuple[int, int]], losses: Noted) -> Iterator[tuple[int, bytes]]:
    with source.open("rb") as file:
        for number, (at, n) in enumerate(found):
            file.seek(at)
            data = file.read(n)
            if len(data) < n:
                losses.note(f"a message at byte {at} is cut", 1, len(data))
                continue
            yield number, data


# Channels ------------------------------------------------------------------------------------------------


def _tables(source: Path) -> dict[int, tuple[_Found, int, int]]:
    """What tables there still are: channel, time of receipt and of sending (µs) by number."""
    out: dict[int, tuple[_Found, int, int]] = {}
    try:
        with _open(source, "r") as file:
            for key in file:
                data = file[key]
                if key.isdigit() or getattr(data, "ndim", 0) != 2 or data.shape[1] < 5:
                    continue
                name = text_of(data.attrs.get("Channel Name", "")) or key
                found = _Found(name, text_of(data.attrs.get("Channel Type", "")), _description(data))
                out |= {int(row[1]): (found, int(row[0]), int(row[3])) for row in data[()]}
    except (OSError, RuntimeError, ValueError, KeyError):
        pass
    return out


def _description(data: Any) -> bytes:
    value = data.attrs.get("Channel Description", b"")
    return (
        value.tobytes()
        if hasattr(value, "tobytes")
        else value
        if isinstance(value, bytes)
        else str(value).encode()
    )


class _Sorter:
    """Tells the channel of a message by its content."""

    def __init__(self, like: Path | None) -> None:
        self.found: list[_Found] = []
        self._by_key: dict[tuple[str, str], _Found] = {}
        self._last = 0
        self._named = _channels_of(like) if like is not None else {}
        self._types = [*dict.fromkeys([*(kind for kind, _ in self._named), *_TYPES])]

    def channel(self, data: bytes) -> _Found:
        """Its channel."""
        name, frame, _ = self._decoded(data)
        key = (name, frame)
        if key not in self._by_key:
            self._by_key[key] = found = self._named.get(key) or self._new(name, frame)
            self.found.append(found)
        return self._by_key[key]

    def stamp_us(self, data: bytes) -> int:
        """The time of the message's header, µs; that of the message before where it has none."""
        stamp = self._decoded(data)[2]
        self._last = stamp // 1000 if stamp is not None else self._last
        return self._last

    def _new(self, name: str, frame: str) -> _Found:
        if not name:
            return _Found(_UNKNOWN, "")
        package, _, short = name.partition("/msg/")
        tail = f"/{frame}" if frame else ""
        topic = re.sub(r"[^A-Za-z0-9_/]", "_", f"rt/recovered/{short}{tail}")
        return _Found(topic, f"{package}::msg::dds_::{short}_")

    def _decoded(self, data: bytes) -> tuple[str, str, int | None]:
        """Type, frame and stamp (ns) of a message; empty where it is of none that is known."""
        for name in self._types:
            try:
                fields = decode(data, name, definitions(name, "", 2), CUSTOM)
                head = fields["header"]
                stamp = int(head["stamp"]["sec"]) * 10**9 + int(head["stamp"]["nanosec"])
                if stamp < 0 or not head["frame_id"].isprintable():
                    continue
            except (DecodeError, KeyError, TypeError, ValueError):
                continue
            self._types.remove(name)  # most often the next one is of the same
            self._types.insert(0, name)
            return name, head["frame_id"], stamp
        return "", "", None

    def sentences(self) -> list[str]:
        """What was made out; nothing where the tables told all."""
        if not self.found:
            return []
        out = []
        for found in self.found:
            n = len(found.rows)
            if found.name == _UNKNOWN:
                out.append(
                    f"{n} messages are of no known type: they are kept as they are in {topic_of(found.name)}."
                )
            elif found in self._named.values():
                out.append(f"{topic_of(found.name)}: its {n} messages were told by their content.")
            else:
                out.append(
                    f"{topic_of(found.name)}: the channel's own name is lost; its {n} messages were told by "
                    "their content, and a sound recording given with --like would name it."
                )
        out.append(
            "Times of receipt are lost with the tables: those of the messages' own headers stand for them."
        )
        return out


def _channels_of(like: Path) -> dict[tuple[str, str], _Found]:
    """Channels of a sound recording by type and frame."""
    out: dict[tuple[str, str], _Found] = {}
    if not ecal_is_whole(like):
        raise InputError(
            "The sound recording cannot be used.", file=like, expected="a recording of eCAL with its tables"
        )
    with _open(like, "r") as file:
        for key in file:
            data = file[key]
            if key.isdigit() or getattr(data, "ndim", 0) != 2 or not len(data):
                continue
            kind = text_of(data.attrs.get("Channel Type", ""))
            name = text_of(data.attrs.get("Channel Name", "")) or key
            frame = ""
            try:
                raw = file[str(int(data[0, 1]))][()].tobytes()
                frame = decode(raw, type_of(kind), definitions(type_of(kind), "", 2), CUSTOM)["header"][
                    "frame_id"
                ]
            except (DecodeError, KeyError, TypeError, OSError):
                continue
            out[type_of(kind), frame] = _Found(_topic_name(name), kind, _description(data))
    return out


def _topic_name(name: str) -> str:
    from urllib.parse import unquote

    return unquote(name)
