"""Bags of ROS 1 and ROS 2: lidar, inertial samples and pictures, streamed, from whole and damaged files."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from acino_fte.data_tools.bags_ecal import MAGIC as HDF5_MAGIC
from acino_fte.data_tools.bags_ecal import EcalWalk
from acino_fte.data_tools.bags_mcap import MAGIC as MCAP_MAGIC
from acino_fte.data_tools.bags_mcap import McapWalk
from acino_fte.data_tools.bags_ros1 import Ros1Walk
from acino_fte.data_tools.bags_serial import DecodeError, decode, definitions
from acino_fte.data_tools.bags_sqlite import MAGIC as SQLITE_MAGIC
from acino_fte.data_tools.bags_sqlite import SqliteWalk
from acino_fte.data_tools.bags_window import ZSTD, Channel, Losses, RawMessage, decompressor
from acino_fte.data_tools.recording import GRAVITY, Damage, Kind, Record, Stream
from acino_fte.data_tools.ros_messages import IMU_G_LIMIT, force_norm, from_message, kind_of
from acino_fte.errors import InputError

ImuUnit = Literal["auto", "g", "m/s2"]
_NOTHING = 0.05  # an acceleration so short (in any unit) tells nothing of its unit


class BagReader:
    """A bag as a :class:`~acino_fte.data_tools.recording.RecordingReader`.

    Records come in the order of the file. ``received_ns`` is when the recorder got the message; the times in
    the values are the sensor's own: of each point, or of the header.

    Parameters
    ----------
    path : Path
        ROS 1: a ``.bag`` (plain, bz2, lz4). ROS 2: the folder, or one ``.db3`` or ``.mcap`` file of it.
        Messages as ROS 1 writes them, as CDR, or as rosbag2 writes under eCAL; and eCAL's own .hdf5 files.
    imu_unit : {"auto", "g", "m/s2"}
        Of accelerations. ROS wants m/s², Livox writes g. ``"auto"`` tells by the first one of each topic, and
        :attr:`notes` says so.

    Raises
    ------
    InputError
        There is no such bag, it is empty, or it is something else.
    """

    def __init__(self, path: Path | str, imu_unit: ImuUnit = "auto") -> None:
        if imu_unit not in ("auto", "g", "m/s2"):
            raise InputError(
                "The unit is not known.", key="imu_unit", expected="auto, g or m/s2", found=imu_unit
            )
        self.path, self._imu_unit = Path(path), imu_unit
        self._units: dict[str, float] = {}
        self._channels: dict[str, Channel] = {}  # of records of kind "other"
        self._notes: list[str] = []
        self._undecoded: dict[str, tuple[int, str]] = {}
        self._temporary: list[Path] = []
        self._losses: list[Losses] = []
        self._said: int | None = None
        self._finished = False
        self._streams: tuple[Stream, ...] | None = None
        self._files = self._find()

    # What there is ---------------------------------------------------------------

    def _find(self) -> list[Path]:
        if not self.path.exists():
            raise InputError(
                "There is no such bag.", file=self.path, expected="a .bag, .db3, .mcap or folder"
            )
        if self.path.is_dir():
            from acino_fte.data_tools.bags_folder import files_of

            files, self._said, notes = files_of(self.path)
            self._notes += notes
            return files
        if bag_kind(self.path) is None:
            size = self.path.stat().st_size
            raise InputError(
                "The file is no bag.",
                file=self.path,
                expected="a ROS 1 bag, an SQLite file of rosbag2 or an MCAP file",
                found=f"{size} bytes of something else" if size else "an empty file",
            )
        if bag_kind(self.path) != "zstd":
            self._walk(self.path, Losses())  # says so at once where it is of a version that is not read
        return [self.path]

    def _walk(self, path: Path, losses: Losses) -> Ros1Walk | McapWalk | SqliteWalk | EcalWalk | None:
        kind = bag_kind(path)
        if kind == "zstd":
            path = self._unpack(path, losses)
            kind = bag_kind(path)
        if kind == "ros1":
            return Ros1Walk(path, losses)
        if kind == "mcap":
            return McapWalk(path, losses)
        if kind == "sqlite":
            return SqliteWalk(path, losses)
        if kind == "ecal":
            return EcalWalk(path, losses)
        losses.note(f"{path.name} is no bag: its first bytes are lost", 0, path.stat().st_size)
        return None

    def _unpack(self, path: Path, losses: Losses) -> Path:
        """A file that rosbag2 compressed as a whole, unpacked into a temporary folder."""
        folder = Path(tempfile.mkdtemp(prefix="acino-fte-"))
        self._temporary.append(folder)
        target, unpack = folder / path.stem, decompressor("zstd")
        with path.open("rb") as source, target.open("wb") as out:
            while block := source.read(1 << 20):
                try:
                    out.write(unpack.decompress(block))
                except Exception as error:  # noqa: BLE001 - the library's own errors
                    losses.note(f"{path.name}: the compressed data are damaged ({error})")
                    break
        if not unpack.eof:
            losses.note(f"{path.name}: the compressed data end early")
        return target

    @property
    def streams(self) -> tuple[Stream, ...]:
        """Topics, with counts. A file without a sound index is walked through once to find them."""
        if self._streams is None:
            found: dict[tuple[str, str], int] = {}
            for file in self._files:
                walk = self._walk(file, Losses())
                if walk is None:
                    continue
                if walk.overview():
                    for number, channel in walk.channels.items():
                        key = (channel.topic, channel.type)
                        found[key] = found.get(key, 0) + walk.counts.get(number, 0)
                else:
                    for message in walk.messages(payloads=False):
                        key = (message.channel.topic, message.channel.type)
                        found[key] = found.get(key, 0) + 1
            self._streams = tuple(
                Stream(topic, kind_of(name), name, count) for (topic, name), count in found.items()
            )
            self._clean()
        return self._streams

    @property
    def damage(self) -> Damage:
        """What was lost so far; complete once all records were read."""
        parts = [losses.damage() for losses in self._losses]
        all_bad = Losses()
        all_bad.read = sum(part.n_read for part in parts)
        all_bad.lost = sum(part.n_lost for part in parts)
        all_bad.bytes = sum(part.bytes_lost for part in parts)
        all_bad.expected = (self._said or 0) if self._finished else 0
        for part in parts:
            for place in part.places:
                all_bad.note(place)
        return all_bad.damage(self._undecoded)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed, one sentence each; complete once all records were read."""
        return tuple(self._notes)

    # Records ---------------------------------------------------------------------

    def records(
        self, kinds: Collection[Kind] | None = None, streams: Collection[str] | None = None
    ) -> Iterator[Record]:
        """Records in the order of the file; only those of some kinds and topics, where they are named."""
        self._undecoded, self._losses, self._finished = {}, [], False
        for file in self._files:
            losses = Losses()
            self._losses.append(losses)
            walk = self._walk(file, losses)
            if walk is None:
                continue
            for message in walk.messages():
                kind = kind_of(message.channel.type)
                if kinds is not None and kind not in kinds:
                    continue
                if streams is not None and message.channel.topic not in streams:
                    continue
                record = self._record(message, kind)
                if record is not None:
                    yield record
        self._finished = True
        self._clean()

    def _record(self, message: RawMessage, kind: Kind) -> Record | None:
        channel = message.channel
        if kind == "other":
            self._channels[channel.topic] = channel
            return Record(channel.topic, kind, message.received_ns, None, message.data)
        try:
            if channel.layout is None:
                raise DecodeError("the serialisation is not known")
            types = definitions(channel.type, channel.definition, channel.version, channel.encoding)
            fields = decode(message.data, channel.type, types, channel.layout)
            unit = self._unit(channel.topic, fields) if kind == "imu" else 1.0
            with np.errstate(all="ignore"):  # damaged numbers
                value = from_message(channel.type, fields, unit)
        except (DecodeError, ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
            n, why = self._undecoded.get(channel.topic, (0, str(error)))
            self._undecoded[channel.topic] = (n + 1, why)
            return None
        return Record(channel.topic, kind, message.received_ns, value, published_ns=message.published_ns)

    def fields(self, record: Record) -> dict[str, Any]:
        """Fields of a record of kind ``"other"``, decoded by the definition that the bag (or ROS) has of it.

        Returns
        -------
        dict
            As :func:`acino_fte.data_tools.bags_serial.decode` gives them.

        Raises
        ------
        InputError
            There is no definition, or the bytes are not such a message.
        """
        channel = self._channels.get(record.stream)
        try:
            if channel is None or channel.layout is None or record.raw is None:
                raise DecodeError("it was not read as bytes from this bag")
            types = definitions(channel.type, channel.definition, channel.version, channel.encoding)
            return decode(record.raw, channel.type, types, channel.layout)
        except DecodeError as error:
            raise InputError(
                "The message does not decode.", file=self.path, key=record.stream, found=str(error)
            ) from error

    def _unit(self, topic: str, fields: dict[str, Any]) -> float:
        """m/s² of one unit of the accelerations of a topic."""
        if self._imu_unit != "auto":
            return GRAVITY if self._imu_unit == "g" else 1.0
        if topic not in self._units:
            norm = force_norm(fields)
            if not norm > _NOTHING:
                return 1.0
            in_g = norm < IMU_G_LIMIT
            self._units[topic] = GRAVITY if in_g else 1.0
            if in_g:
                self._notes.append(
                    f"{topic}: accelerations are taken to be in g (the first is {norm:.2f} long) and are "
                    f"multiplied by {GRAVITY}; imu_unit='m/s2' takes them as they are"
                )
        return self._units[topic]

    def _clean(self) -> None:
        for folder in self._temporary:
            shutil.rmtree(folder, ignore_errors=True)
        self._temporary = []

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._clean()


def bag_kind(path: Path) -> Literal["ros1", "mcap", "sqlite", "ecal", "zstd"] | None:
    """What kind of a bag a file is, by its first bytes; None of another file."""
    with path.open("rb") as file:
        head = file.read(16)
    if head.startswith(b"#ROSBAG V"):
        return "ros1"
    if head.startswith(MCAP_MAGIC):
        return "mcap"
    if head.startswith(ZSTD):
        return "zstd"
    if head.startswith(HDF5_MAGIC):
        return "ecal"
    return "sqlite" if head == SQLITE_MAGIC else None
