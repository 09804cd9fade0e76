"""What the readers of bags share: bytes read forward in constant memory, unpacked, and losses counted."""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from acino_fte.data_tools.bags_serial import Layout
from acino_fte.data_tools.recording import Damage
from acino_fte.extras import missing_package

ZSTD = b"\x28\xb5\x2f\xfd"
"""The first bytes of data that zstd compressed."""
_BLOCK = 1 << 18
_MOST_READ = 1 << 22  # a damaged length may ask for more than there is
_PLACES = 20


@dataclass(frozen=True)
class Channel:
    """What the messages of one topic and type are.

    Attributes
    ----------
    topic, type : str
        The type as ``package/msg/Type``.
    definition, encoding : str
        Of the type: its text, and ``ros2msg`` or ``ros2idl``.
    layout : Layout, optional
        Of the bytes; None where it is none that is known.
    version : int
        Of ROS, whose standard types hold.
    """

    topic: str
    type: str
    definition: str
    encoding: str
    layout: Layout | None
    version: int


@dataclass(frozen=True)
class RawMessage:
    """One message as it stands in the bag."""

    channel: Channel
    received_ns: int
    data: bytes
    published_ns: int | None = None


class Losses:
    """Counts what a walk through a file reads and loses."""

    def __init__(self) -> None:
        self.read = self.lost = self.bytes = 0
        self.expected = 0
        self.places: list[str] = []
        self._more = 0

    def note(self, place: str, lost: int = 0, size: int = 0) -> None:
        """Something is lost."""
        self.lost += lost
        self.bytes += size
        if len(self.places) < _PLACES:
            self.places.append(place)
        else:
            self._more += 1

    def damage(self, undecoded: dict[str, tuple[int, str]] | None = None) -> Damage:
        """The sum; `undecoded`: of each topic how many messages did not decode, and why the first did not."""
        more = (f"and {self._more} more places",) if self._more else ()
        bad = tuple(
            f"{topic}: {n} message{'s do' if n > 1 else ' does'} not decode; {why}"
            for topic, (n, why) in (undecoded or {}).items()
        )
        n_bad = sum(n for n, _ in (undecoded or {}).values())
        lost = max(self.lost, self.expected - self.read) + n_bad
        return Damage(self.read - n_bad, lost, self.bytes, (*self.places, *more, *bad))


class Window:
    """Bytes from a source that is read forward.

    Parameters
    ----------
    end : int
        Where the bytes end, as far as that is known: no record may reach beyond it.
    """

    def __init__(self, end: int) -> None:
        self.end = end
        self._buffer, self._start = b"", 0  # the buffer, and what of it is used
        self.at = 0

    def _read(self, n: int) -> bytes:
        """Up to so many bytes of the source; none at its end."""
        raise NotImplementedError

    def peek(self, n: int) -> memoryview:
        """The next bytes, `n` of them or up to the end."""
        left = len(self._buffer) - self._start
        if left < n:
            parts = [self._buffer[self._start :]]
            while left < n:
                more = self._read(max(n - left, _BLOCK))
                if not more:
                    break
                parts.append(more)
                left += len(more)
            self._buffer, self._start = b"".join(parts), 0
        return memoryview(self._buffer)[self._start : self._start + n]

    def skip(self, n: int) -> int:
        """Pass over `n` bytes; returns how many there were."""
        left = n
        while left:
            step = len(self.peek(min(left, _BLOCK)))
            if not step:
                break
            step = min(step, left)
            self._start += step
            self.at += step
            left -= step
        return n - left

    def take(self, n: int) -> bytes:
        """The next bytes, and pass over them."""
        data = bytes(self.peek(n))
        self._start += len(data)
        self.at += len(data)
        return data


class FileWindow(Window):
    """A :class:`Window` over a file, which can also go elsewhere."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        super().__init__(size)
        self._file = file

    def _read(self, n: int) -> bytes:
        return self._file.read(min(n, _MOST_READ))

    def seek(self, at: int) -> None:
        """Go to a place."""
        ahead = at - self.at
        if 0 <= ahead <= len(self._buffer) - self._start:
            self._start += ahead
        else:
            self._file.seek(at)
            self._buffer, self._start = b"", 0
        self.at = at

    def peek_at(self, at: int, n: int) -> memoryview:
        """Bytes elsewhere in the file."""
        here = at - self.at + self._start
        if here >= 0 and here + n <= len(self._buffer):
            return memoryview(self._buffer)[here : here + n]
        before = self._file.tell()
        self._file.seek(at)
        data = self._file.read(n)
        self._file.seek(before)
        return memoryview(data)


class Unpacked(Window):
    """The bytes of a compressed chunk, unpacked on demand.

    Parameters
    ----------
    outer : Window
        Stands at the compressed bytes.
    size : int
        Of the compressed bytes.
    compression : str
        ``bz2``, ``lz4``, ``zstd`` or none.
    end : int
        Bytes when unpacked, as the chunk says.

    Attributes
    ----------
    problem : str
        Why the bytes end early; empty where they do not.
    used : int
        Compressed bytes that were used.
    checksum : int
        CRC-32 of the bytes unpacked so far.
    """

    def __init__(self, outer: Window, size: int, compression: str, end: int) -> None:
        super().__init__(end)
        self._outer, self._left, self._unpack = outer, size, decompressor(compression)
        self.problem, self.used, self.checksum, self._given = "", 0, 0, 0

    def _read(self, n: int) -> bytes:
        while not self.problem and self._given < self.end and not self._unpack.eof:
            packed = self._outer.take(min(self._left, _BLOCK))
            if not packed:
                self.problem = f"it ends after {self._given} of {self.end} bytes"
                return b""
            self._left -= len(packed)
            self.used += len(packed)
            try:
                data = self._unpack.decompress(packed)
            except Exception as error:  # noqa: BLE001 - each library has errors of its own
                self.problem = f"its {self._unpack.name} data are damaged ({error})"
                return b""
            if self._unpack.eof:
                self.used -= len(self._unpack.unused_data)
            self._given += len(data)
            self.checksum = zlib.crc32(data, self.checksum)
            if data:
                return data
        return b""


class _Plain:
    name, eof, unused_data = "plain", False, b""

    def decompress(self, data: bytes) -> bytes:
        return data


class _Named:
    """A decompressor and its name; small steps, so that of damaged data the sound part is given."""

    def __init__(self, name: str, inner: Any) -> None:
        self.name, self._inner = name, inner
        self._failed: Exception | None = None
        self._rest = b""  # what was not given to it

    @property
    def eof(self) -> bool:
        return bool(self._inner.eof)

    @property
    def unused_data(self) -> bytes:
        return (self._inner.unused_data or b"") + self._rest

    def decompress(self, data: bytes) -> bytes:
        if self._failed is not None:
            raise self._failed
        parts = []
        for at in range(0, len(data), _STEP):
            try:
                parts.append(self._inner.decompress(data[at : at + _STEP]))
            except Exception as error:  # each library has errors of its own
                if not parts:
                    raise
                self._failed = error
                break
            if self._inner.eof:
                self._rest = data[at + _STEP :]
                break
        return b"".join(parts)


_STEP = 1 << 16


def decompressor(name: str) -> Any:
    """An object with ``decompress``, ``eof`` and ``unused_data``.

    Raises
    ------
    ValueError
        The name is not known.
    """
    if name in ("", "none"):
        return _Plain()
    try:
        if name == "bz2":
            return _Named(name, bz2.BZ2Decompressor())
        if name == "lz4":
            import lz4.frame

            return _Named(name, lz4.frame.LZ4FrameDecompressor())
        if name == "zstd":
            import zstandard

            return _Named(name, zstandard.ZstdDecompressor().decompressobj())
    except ImportError as error:
        raise missing_package("Compressed bags", error) from error
    raise ValueError(f"the compression '{name}' is not known")


Messages = Iterator[RawMessage]


class FileWalk:
    """What walks through one file of a bag.

    Parameters
    ----------
    path : Path
    losses : Losses
        Counts what is read and lost.

    Attributes
    ----------
    channels : dict of int to Channel
        Those that were met so far, by their numbers in the file.
    counts : dict of int to int
        Messages by channel, as the file's own index says.
    """

    def __init__(self, path: Path, losses: Losses) -> None:
        self.path, self.losses = path, losses
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}
