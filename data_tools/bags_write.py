"""Writing bags of ROS 1 and ROS 2: for simulated recordings and for tests."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Literal

from acino_fte.data_tools.bags_serial import CDR, CUSTOM, ROS1, definitions, encode
from acino_fte.data_tools.recording import ImuSamples, LidarReturns, Picture, PictureInfo
from acino_fte.data_tools.ros_messages import DEFINITIONS, to_message
from acino_fte.errors import InputError
from acino_fte.extras import missing_package

_COMPRESSIONS = {1: (None, "bz2", "lz4"), 2: (None, "zstd")}


class BagWriter:
    """Write a bag, message by message: a context manager. The bag appears whole at the end, or not at all.

    Parameters
    ----------
    path : Path
        ROS 1: the ``.bag`` file. ROS 2: the folder. It must not exist yet.
    version : {1, 2}
        Of ROS.
    compression : str, optional
        ROS 1: ``"bz2"`` or ``"lz4"``. ROS 2: ``"zstd"``: of chunks (mcap) or of messages (sqlite3).
    storage : {"sqlite3", "mcap"}
        Of ROS 2.
    serialization : {"cdr", "custom"}
        Of ROS 2. ``"custom"`` is what rosbag2 writes under eCAL.

    Raises
    ------
    InputError
        The path exists, or an option does not fit the version.
    """

    def __init__(
        self,
        path: Path | str,
        version: int = 1,
        compression: str | None = None,
        storage: Literal["sqlite3", "mcap"] = "sqlite3",
        serialization: Literal["cdr", "custom"] = "cdr",
    ) -> None:
        self.path, self.version = Path(path), version
        if version not in _COMPRESSIONS or compression not in _COMPRESSIONS[version]:
            expected = ", ".join(str(c) for c in _COMPRESSIONS.get(version, ("version 1 or 2",)))
            found = f"version {version}, {compression}"
            raise InputError("This bag cannot be written.", file=path, expected=expected, found=found)
        if self.path.exists():
            raise InputError("The bag exists already.", file=path, remedy="remove it, or choose another name")
        self._layout = ROS1 if version == 1 else CUSTOM if serialization == "custom" else CDR
        self._folder = self.path.with_name(f".{self.path.name}.writing")
        shutil.rmtree(self._folder, ignore_errors=True)
        self._options = (compression, storage)
        self._connections: dict[tuple[str, str], Any] = {}
        self._counts: dict[str, int] = {}

    def __enter__(self) -> BagWriter:
        self._folder.mkdir(parents=True)
        self._writer = self._open(self._folder / self.path.name, *self._options)
        return self

    def _open(self, path: Path, compression: str | None, storage: str) -> Any:
        try:
            from rosbags import rosbag1, rosbag2
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as error:
            raise missing_package("Bags", error) from error
        self._store = get_typestore(Stores.ROS1_NOETIC if self.version == 1 else Stores.ROS2_HUMBLE)
        for name, text in DEFINITIONS.items():
            self._store.register(get_types_from_msg(text, name))
        writer: Any
        if self.version == 1:
            writer = rosbag1.Writer(path)
            if compression:
                writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        else:
            plugin = rosbag2.StoragePlugin[storage.upper()]
            writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
            if compression:
                mode = "STORAGE" if storage == "mcap" else "MESSAGE"
                writer.set_compression(
                    rosbag2.CompressionMode[mode], rosbag2.CompressionFormat[compression.upper()]
                )
        writer.open()
        return writer

    def write(
        self,
        topic: str,
        value: LidarReturns | ImuSamples | Picture | PictureInfo,
        received_ns: int,
        frame_id: str = "",
        form: str = "",
    ) -> None:
        """Write one record.

        Parameters
        ----------
        topic : str
            Such as ``/livox/lidar``. All its records are of one type.
        value : LidarReturns, ImuSamples, Picture or PictureInfo
            Several inertial samples become a message each.
        received_ns : int
            When the computer received it, ns since 1970.
        frame_id : str
            Name of the sensor's frame.
        form : str
            Lidar: ``"custom"`` (Livox, default) or ``"pointcloud2"``. Picture: ``"png"`` (default),
            ``"jpeg"`` or ``"raw"``. Inertial: ``"m/s2"`` (default) or ``"g"``, as Livox writes.
        """
        if isinstance(value, ImuSamples) and len(value) != 1:
            for i in range(len(value)):
                one = slice(i, i + 1)
                sample = ImuSamples(value.time_ns[one], value.rate[one], value.force[one], value.clock)
                self.write(topic, sample, received_ns, frame_id, form)
            return
        number = self._counts.get(topic, 0)
        name, message = to_message(value, frame_id, form, number)
        types = definitions(name, "", self.version)
        self.write_raw(topic, name, encode(message, name, types, self._layout), received_ns)

    def write_raw(self, topic: str, name: str, data: bytes, received_ns: int) -> None:
        """Write the bytes of a message of the type `name`, ``package/msg/Type``."""
        key = (topic, name)
        if key not in self._connections:
            more = {} if self.version == 1 else {"serialization_format": self._layout.name}
            self._connections[key] = self._writer.add_connection(topic, name, typestore=self._store, **more)
        self._writer.write(self._connections[key], int(received_ns), data)
        self._counts[topic] = self._counts.get(topic, 0) + 1

    def __exit__(self, failed: Any, *_: object) -> None:
        try:
            if failed is None:
                self._writer.close()
                (self._folder / self.path.name).replace(self.path)
            elif self.version == 2:
                self._writer.abort()
            else:
                self._writer.bio.close()
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)
