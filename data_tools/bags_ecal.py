"""eCAL's recordings (.hdf5, format 5) of ROS 2 messages.

One data set of bytes for each message, named by its number; at the end one table for each channel: time of
receipt (µs), number, clock, time of sending (µs), sender. A recording that was cut has no tables, and what
belongs to which channel is not known then.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from acino_fte.data_tools.bags_serial import CUSTOM
from acino_fte.data_tools.bags_window import Channel, FileWalk, Losses, Messages, RawMessage
from acino_fte.errors import InputError

MAGIC = b"\x89HDF\r\n\x1a\n"
_REMEDY = "a recording that was cut has to be restored first; another HDF5 file is no recording"


class EcalWalk(FileWalk):
    """Walks through one .hdf5 file of eCAL, in the order of its messages' numbers.

    Raises
    ------
    InputError
        The file is no HDF5 that can be opened, or none of eCAL.
    """

    def __init__(self, path: Path, losses: Losses) -> None:
        super().__init__(path, losses)
        self._tables: list[np.ndarray] = []
        with self._open() as file:
            names = self._names(file)
            for number, name in enumerate(names):
                table = self._table(file, name)
                if table is None:
                    losses.note(f"the table of the channel {name} is missing")
                    continue
                rows, kind = table
                self.channels[number] = Channel(topic_of(name), type_of(kind), "", "ros2msg", CUSTOM, 2)
                self.counts[number] = len(rows)
                self._tables.append(np.column_stack([rows[:, :2], np.full(len(rows), number)]))

    def _open(self) -> Any:
        import h5py

        try:
            return h5py.File(self.path, "r")
        except (OSError, ValueError) as error:
            raise InputError(
                "The HDF5 file cannot be opened.", file=self.path, found=str(error), remedy=_REMEDY
            ) from error

    def _names(self, file: Any) -> list[str]:
        version, channels = text_of(file.attrs.get("Version", "")), text_of(file.attrs.get("Channels", ""))
        if not version.startswith("5"):
            raise InputError(
                "The HDF5 file is no recording that can be read.",
                file=self.path,
                expected="a recording of eCAL, format 5",
                found=f"format '{version}'" if version else "no format of eCAL",
                remedy=_REMEDY,
            )
        return [name for name in channels.split(",") if name]

    @staticmethod
    def _table(file: Any, name: str) -> tuple[np.ndarray, str] | None:
        for key in (name, quote(name, safe=""), unquote(name)):
            data = file.get(key)
            if data is not None and getattr(data, "ndim", 0) == 2 and data.shape[1] >= 2:
                return np.asarray(data[:, :2], np.int64), text_of(data.attrs.get("Channel Type", ""))
        return None

    def overview(self) -> bool:
        """Whether there are tables; they were read when the file was opened."""
        return bool(self.channels)

    def messages(self, payloads: bool = True) -> Messages:
        """All messages that the tables tell of; without `payloads` their data are left empty."""
        rows = np.concatenate(self._tables) if self._tables else np.zeros((0, 3), np.int64)
        with self._open() as file:
            for received, number, channel in rows[np.argsort(rows[:, 1], kind="stable")]:
                try:
                    data = file[str(number)][()].tobytes() if payloads else b""
                except (KeyError, OSError, AttributeError) as error:
                    self.losses.note(f"the message {number} cannot be read ({error})", 1)
                    continue
                self.losses.read += 1
                yield RawMessage(self.channels[int(channel)], int(received) * 1000, data)
            known = {int(number) for number in rows[:, 1]}
            stray = sum(1 for name in file if name.isdigit() and int(name) not in known)
            if stray:
                self.losses.note(f"{stray} messages are in no table: the recording was cut", stray)


def text_of(value: Any) -> str:
    """An attribute of HDF5 as text."""
    if isinstance(value, np.ndarray):
        value = value.tobytes() if value.dtype.kind in "SV" else value.ravel()[0] if value.size else ""
    return (value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)).rstrip("\0")


def topic_of(name: str) -> str:
    """``/livox/imu`` of ``rt/livox/imu``, ROS 2's name of a topic on the wire."""
    name = unquote(name)
    return name[2:] if name.startswith("rt/") else name


def type_of(name: str) -> str:
    """``package/msg/Type`` of ``package::msg::dds_::Type_`` and its like."""
    parts = [part for part in re.split(r"::|/", name) if part and part != "dds_"]
    return "/".join(parts).removesuffix("_")
