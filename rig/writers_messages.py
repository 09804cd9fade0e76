"""Messages of a segment: an MCAP file of ROS 2 messages, in chunks so small that little is lost in a crash.

Chunks are not compressed: of a damaged chunk every whole message can be read.
"""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

from acino_fte.data_tools.bags_serial import CDR, definitions, encode
from acino_fte.data_tools.recording import ImuSamples, LidarReturns, PictureInfo
from acino_fte.data_tools.ros_messages import DEFINITIONS, XIMEA_TYPE, to_message
from acino_fte.rig.writers import missing_package

CHUNK_BYTES = 8192
"""A chunk ends with the message that exceeds this; and four times a second, see `flush`."""
_LIBRARY = "acino-fte"
_TYPES = ("livox_ros_driver/msg/CustomMsg", "sensor_msgs/msg/Imu", XIMEA_TYPE)


@lru_cache(maxsize=16)
def _definition(name: str) -> bytes:
    """The definition of a message type with those of all types in it, as MCAP's ``ros2msg`` wants it."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise missing_package("Recordings", error) from error
    store = get_typestore(Stores.ROS2_HUMBLE)
    for known, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, known))
    text, _ = store.generate_msgdef(name, ros_version=2)
    return text.encode()


def prepare() -> None:
    """Load what writing needs, before it counts.

    Raises
    ------
    InputError
        A package is not installed.
    """
    try:
        import mcap.writer  # noqa: F401
    except ImportError as error:
        raise missing_package("Recordings", error) from error
    for name in _TYPES:
        _definition(name)
        definitions(name, "", 2)


class MessageFile:
    """One MCAP file, written by several threads.

    Log times are monotonic, publish times are those of the wall clock.
    """

    def __init__(self, path: Path) -> None:
        try:
            from mcap.writer import CompressionType, Writer
        except ImportError as error:
            raise missing_package("Recordings", error) from error
        self.path, self._lock = path, Lock()
        self._file = path.open("xb")
        self._writer: Any = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library=_LIBRARY)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self.counts: dict[str, int] = {}
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._closed = False

    def write(
        self,
        topic: str,
        value: LidarReturns | ImuSamples | PictureInfo,
        log_ns: int,
        wall_ns: int,
        frame: str,
    ) -> None:
        """Write one message."""
        name, message = to_message(value, frame)
        data = encode(message, name, definitions(name, "", 2), CDR)
        with self._lock:
            channel = self._channels.get(topic)
            if channel is None:
                channel = self._channels[topic] = self._channel(topic, name)
            n = self.counts[topic] = self.counts.get(topic, 0) + 1
            self._writer.add_message(channel, log_ns, data, wall_ns, n - 1)
            self.first_ns = log_ns if self.first_ns is None else min(self.first_ns, log_ns)
            self.last_ns = log_ns if self.last_ns is None else max(self.last_ns, log_ns)

    def _channel(self, topic: str, name: str) -> int:
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "ros2msg", _definition(name))
        return self._writer.register_channel(topic, "cdr", self._schemas[name])

    def flush(self) -> None:
        """End the chunk under way and hand it to the operating system."""
        with self._lock:
            if not self._closed:
                if hasattr(self._writer, "flush"):  # older versions of mcap have none
                    self._writer.flush()
                self._file.flush()

    def sync(self) -> None:
        """Have the disk hold what the operating system was given."""
        with self._lock:
            if self._closed:
                return
            self._file.flush()
            own = os.dup(self._file.fileno())
        try:
            os.fsync(own)
        finally:
            os.close(own)

    def close(self) -> None:
        """Write the summary and close; on the disk afterwards."""
        with self._lock:
            if not self._closed:
                self._closed = True
                try:
                    self._writer.finish()
                    self._file.flush()
                    os.fsync(self._file.fileno())
                finally:
                    self._file.close()
