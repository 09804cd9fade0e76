"""The newest counts of all encoders, from the program that drives the rig to the one that records.

Only one program can hold the serial port and the pins. It writes the counts into a small file, in place,
every turn of its loop; whoever wants them reads it: one record with a stamp and a checksum, so that a record
that is just being written, or that of a program which has ended, is not taken for the truth.
"""

from __future__ import annotations

import os
import struct
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from acino_fte.rig.encoders_store import state_folder

FILE_NAME = "counts.bin"
FRESH_NS = 500_000_000
"""Counts older than this are unknown: nothing drives the rig."""
MAX_ENCODERS = 16
_RECORD = struct.Struct(f"<8sqI{MAX_ENCODERS}q")  # magic, stamp (monotonic ns), how many, counts
_MAGIC = b"acfteC01"


class CountsWriter:
    """Writes the record. A disk that refuses never stops a motor's loop: `trouble` says so.

    Parameters
    ----------
    folder : Path
        Where ``counts.bin`` is, or will be.
    """

    def __init__(self, folder: Path) -> None:
        self.trouble = ""
        self._fd = -1
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._fd = os.open(folder / FILE_NAME, os.O_RDWR | os.O_CREAT, 0o644)
            _hold(self._fd)
        except BlockingIOError:
            self.trouble = "another program drives this rig"
            os.close(self._fd)
            self._fd = -1
        except OSError as error:
            self.trouble = f"a recording gets no counts: {error.strerror}"

    def write(self, counts: Sequence[int], now_ns: int) -> None:
        """Counts from now on, in the order of ``encoders:`` of ``rig.yaml``."""
        if self._fd < 0:
            return
        padded = [*counts[:MAX_ENCODERS], *[0] * (MAX_ENCODERS - len(counts))]
        record = _RECORD.pack(_MAGIC, now_ns, min(len(counts), MAX_ENCODERS), *padded)
        try:
            os.pwrite(self._fd, record + struct.pack("<I", zlib.crc32(record)), 0)
        except OSError as error:
            self.trouble = f"a recording gets no counts: {error.strerror}"

    def close(self) -> None:
        """Say that nothing is known any more."""
        if self._fd >= 0:
            with suppress(OSError):
                os.ftruncate(self._fd, 0)
            os.close(self._fd)
        self._fd = -1


class SharedCounts:
    """Reads the record: the driver ``encoders`` of a recorder (:class:`acino_fte.rig.sources.Counts`).

    Parameters
    ----------
    name : str
        Of the driver; not used.
    encoders : mapping
        ``encoders:`` of ``rig.yaml``: how many counts there must be.
    folder : Path, optional
        By default that of ``acino-fte rig drive``.
    clock : callable
        Monotonic time in ns, the same as the writer's.
    """

    def __init__(
        self,
        name: str,
        encoders: Mapping[str, Any],
        *,
        folder: Path | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._path = (folder or state_folder()) / FILE_NAME
        self._n, self._clock = len(encoders), clock

    def counts(self) -> tuple[int, ...]:
        """The newest counts; empty when nothing drives the rig, or another rig is driven."""
        for _ in range(3):  # one attempt may meet a record that is being written
            try:
                data = self._path.read_bytes()
            except OSError:
                return ()
            record, check = data[: _RECORD.size], data[_RECORD.size :]
            if len(check) == 4 and struct.unpack("<I", check)[0] == zlib.crc32(record):
                magic, stamp, n, *counts = _RECORD.unpack(record)
                fresh = abs(self._clock() - stamp) <= FRESH_NS
                return tuple(counts[:n]) if magic == _MAGIC and n == self._n and fresh else ()
        return ()


def _hold(fd: int) -> None:
    """Let no other program write; BlockingIOError when one does. Not known to Windows."""
    with suppress(ImportError):
        import fcntl

        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
