"""Walk through an LVX file from package to package, and find the way again after damage.

Nothing in a frame's header is needed to read its packages, and recording programs write wrong offsets
there. So a header is only a mark between packages. Where neither a package nor a header stands, the walk
searches the next place from where packages follow one another again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from struct import Struct
from typing import BinaryIO

import numpy as np

from acino_fte.data_tools.lvx_recognise import PackageTest

_BLOCK = 4 << 20
_LOOK = 16_384  # more than three packages and three headers
_BEHIND = 2_048  # the last package stays in reach
_MOST = 4_096  # packages handed over at once, where no frame ends them
_THREE = Struct("<QQQ")
_LONGEST_FRAME = 1 << 28


@dataclass
class RawFrame:
    """Packages between two headers of frames, as (device, data type, bytes)."""

    at: int = 0
    packages: list[tuple[int, int, bytes]] = field(default_factory=list)


@dataclass(frozen=True)
class Hole:
    """Bytes [start, stop) of the file that could not be read, and about how many packages they held.

    `n_lost` is None in the middle of a file, where the stamps on both sides tell it.
    """

    start: int
    stop: int
    why: str
    n_lost: int | None = None


class Walk:
    """One walk through a file.

    Parameters
    ----------
    file : binary file
    test : PackageTest
    start : int
        Where the first frame begins, or is thought to begin.
    """

    def __init__(self, file: BinaryIO, test: PackageTest, start: int) -> None:
        self.holes: list[Hole] = []
        self.n_frames = 0
        self.n_wrong_offsets = 0
        self._file, self._test, self._start = file, test, start
        self._skip = test.layout.frame_bytes
        self._data, self._base, self._ended = b"", start, False
        self._shifts = [0]  # by how much offsets in headers differ from places in the file
        self._index: int | None = None
        self._frame_end = start
        self._tail = -1  # where the last package ends
        self._head = -1  # where the last header ends
        self._index_before: int | None = None
        self._last: dict[tuple[int, int], bytes] = {}
        self._before: tuple[tuple[int, int], bytes | None] = (0, 0), None  # what the last package replaced
        self._bytes = self._count = 0

    def frames(self) -> Iterator[RawFrame]:
        """The packages, frame by frame; holes are noted on the way."""
        self._file.seek(self._start)
        frame, pos = RawFrame(self._start), self._start
        size_of, device_of, kind_of = self._test.size, self._test.device, self._test.kind
        while True:
            self._reach(pos)
            data, at = self._data, pos - self._base
            if at >= len(data):
                break
            if self._strong(at):
                header = True
            else:
                size = size_of(data, at)
                if size and at + size <= len(data):
                    if len(frame.packages) >= _MOST:
                        yield frame
                        frame = RawFrame(pos)
                    package = data[at : at + size]
                    device, kind = device_of(package), kind_of(package)
                    frame.packages.append((device, kind, package))
                    key = device, kind
                    self._before, self._last[key] = (key, self._last.get(key)), package
                    self._bytes, self._count = self._bytes + size, self._count + 1
                    pos += size
                    self._tail = pos
                    continue
                header = self._weak(at)
            if header:
                if frame.packages:
                    yield frame
                frame = RawFrame(pos)
                self._enter(at, pos)
                pos += self._skip
                continue
            pos = self._over_hole(frame, pos)
        if frame.packages:
            yield frame
        if pos < self._frame_end and not (self.holes and self.holes[-1].n_lost is not None):
            lost = self._about(self._frame_end - pos)
            self.holes.append(Hole(pos, pos, "the file ends within a frame", lost))

    def find_any(self) -> int:
        """Where the first frame or package begins."""
        self._file.seek(self._start)
        return self._resync(self._start)

    def find_frame(self, limit: int) -> int | None:
        """Where the first frame with packages begins, within so many bytes of the start."""
        pos = self._start
        self._file.seek(pos)
        while pos < self._start + limit:
            pos = self._resync(pos, self._start + limit)
            at = pos - self._base
            if at >= len(self._data):
                return None
            if self._header(at) and self._chain(at + self._skip, 2, None):
                return pos
            pos += 1
        return None

    # ------------------------------------------------------------------------------ the window

    def _reach(self, pos: int) -> None:
        """Have enough bytes of the file from `pos` on."""
        at = pos - self._base
        if self._ended or len(self._data) - at >= _LOOK:
            return
        more = self._file.read(_BLOCK)
        self._ended = len(more) < _BLOCK
        kept = max(at - _BEHIND, 0)
        self._data, self._base = self._data[kept:] + more, self._base + kept

    # ------------------------------------------------------------------------------ headers

    def _three(self, at: int) -> tuple[int, int, int] | None:
        if at + self._skip > len(self._data):
            return None
        return _THREE.unpack_from(self._data, at)

    def _strong(self, at: int) -> bool:
        """Whether a header stands here that knows its own place."""
        three = self._three(at)
        if three is None or three[0] - self._base - at not in self._shifts:
            return False
        return self._is_long(three)

    def _weak(self, at: int) -> bool:
        """Whether a header stands here whose offsets are wrong or moved: its number and what follows tell."""
        three = self._three(at)
        if three is None:
            return False
        if not self._mark(three, self._index):
            return False
        first = self._index is None
        sure = not first and three[2] == self._index + 1 and self._is_long(three)  # type: ignore[operator]
        return self._chain(at + self._skip, 3 if first else 2, three[2], crumbs=sure, header=True)

    def _mark(self, three: tuple[int, int, int], before: int | None) -> bool:
        """Whether numbers may be those of a header: its index is the next, or its length may be one."""
        long, index = self._is_long(three), three[2]
        if before is None:
            return long and index < 10_000_000
        step = index - before
        return step == 1 or (long and (0 < step <= 10_000 or index == 0))  # 0: another recording begins

    def _is_long(self, three: tuple[int, int, int]) -> bool:
        """Whether offsets make a frame that is neither shorter than its header nor endless."""
        return self._skip <= three[1] - three[0] <= _LONGEST_FRAME

    def _header(self, at: int) -> bool:
        return self._strong(at) or self._weak(at)

    def _enter(self, at: int, pos: int) -> None:
        """Take note of the header at `at`."""
        current, following, index = _THREE.unpack_from(self._data, at)
        shift = current - pos
        if shift:
            self.n_wrong_offsets += 1
        if shift not in self._shifts:
            self._shifts = [0, *self._shifts[1:][-2:], shift]
        long = self._is_long((current, following, index))
        self._frame_end = pos + (following - current if long else 0)
        self._index_before, self._index = self._index, index
        self._head = pos + self._skip
        self.n_frames += 1

    # ------------------------------------------------------------------------------ damage

    def _chain(
        self, at: int, links: int, index: int | None, crumbs: bool = True, header: bool = False
    ) -> bool:
        """Whether so many packages follow one another from here on in frame `index`, or the file ends first.

        Without `crumbs` it may not end with a few bytes that could be anything. Behind a doubtful `header`
        there is a package, not another doubtful header.
        """
        data = self._data
        for link in range(links):
            if at >= len(data) or at + self._test.header > len(data):
                return self._ended and (crumbs or at == len(data))
            size = self._test.size(data, at)
            if not size:
                three = self._three(at)
                if three is None or index is None or (header and not link):
                    return self._strong(at)
                return self._strong(at) or self._mark(three, index)
            at += size
        return True

    def _confirmed(self, at: int) -> bool:
        """Whether the walk can go on from here."""
        if self._header(at):
            return True
        data = self._data
        size = self._test.size(data, at)
        if not size or at + size > len(data):
            return False
        before = self._last.get((self._test.device(data, at), self._test.kind(data, at)))
        if before is not None and self._test.follows(before, data, at):
            return True
        return self._chain(at + size, 2, self._index, crumbs=False)

    def _resync(self, pos: int, limit: int | None = None) -> int:
        """The next place from `pos` on where the walk can go on; without any the end of the file, or a place
        behind `limit`.
        """
        while True:
            self._reach(pos)
            start = pos - self._base
            stop = len(self._data) if self._ended else len(self._data) - _LOOK // 2
            places = np.union1d(self._test.candidates(self._data, start, stop), self._marks(start, stop))
            for at in places.tolist():
                if self._confirmed(at):
                    return self._base + at
            pos = self._base + stop
            if self._ended or (limit is not None and pos >= limit):
                return pos

    def _marks(self, start: int, stop: int) -> np.ndarray:
        """Places in [start, stop) where a header may stand."""
        stop = min(stop, len(self._data) - self._skip + 1)
        if stop <= start:
            return np.zeros(0, dtype=np.int64)
        current, following, index = (
            np.ndarray((stop - start,), "<u8", self._data, start + offset, (1,)) for offset in (0, 8, 16)
        )
        length = following - current  # unsigned: backwards is very long
        fits = (length >= np.uint64(self._skip)) & (length <= np.uint64(_LONGEST_FRAME))
        if self._index is None:
            fits &= index < 10_000_000
        else:
            step = index - np.uint64(self._index)
            fits = (fits & (((step > 0) & (step <= 10_000)) | (index == 0))) | (step == 1)
        return np.flatnonzero(fits) + start

    def _over_hole(self, frame: RawFrame, pos: int) -> int:
        """Note what cannot be read from `pos` on; where the walk goes on."""
        start, why = pos, self._why(pos)
        last = frame.packages[-1][2] if frame.packages and self._tail == pos else b""
        if last:
            stop, damaged = self._within(pos, last)
        else:
            stop, damaged = self._resync(pos - self._skip + 1 if self._head == pos else pos + 1), False
        if stop < pos and not last:  # bytes are missing in the header before
            start, self._index = pos - self._skip, self._index_before
        if damaged:
            frame.packages.pop()
            start -= len(last)
            self._bytes, self._count = self._bytes - len(last), self._count - 1
            why = "the data are damaged"
        at_end = stop - self._base >= len(self._data)
        lost = None
        if at_end:
            known = start < self._frame_end or stop - start >= self._skip  # else: a header is cut
            lost = self._about(max(stop, self._frame_end) - start) if known else 0
        elif not self._count:
            lost = self._about(stop - start)
        self.holes.append(Hole(start, stop, why, lost))
        self._frame_end = 0  # bytes may have come or gone
        return stop

    def _within(self, pos: int, last: bytes) -> tuple[int, bool]:
        """Where the walk can go on, and whether the package before `pos` is damaged.

        Where bytes are missing it reaches too far, so the search begins within it.
        """
        key, before = self._before
        if before is None:
            del self._last[key]
        else:
            self._last[key] = before
        stop = self._resync(pos - len(last) + 1)
        plausible = self._test.plausible(last)
        at = stop - self._base
        if plausible and stop < pos and not self._strong(at) and self._weak(at):
            stop = self._resync(pos + 1)  # a damaged header may seem to begin too early
        damaged = stop < pos or not plausible
        if not damaged:
            self._last[key] = last
        return stop, damaged

    def _about(self, n_bytes: int) -> int:
        """About how many packages so many bytes hold: at least one."""
        mean = self._bytes / self._count if self._count else self._test.header + 1_344
        return max(1, round(n_bytes / mean))

    def _why(self, pos: int) -> str:
        """What is wrong here, in a few words."""
        data, at = self._data, pos - self._base
        if self._test.size(data, at) or (self._ended and at + self._test.header > len(data)):
            return "the file ends within a package"
        if not self._test.second and at + self._test.header <= len(data):
            version, changed = data[at + 1], bytearray(data[at : at + self._test.header])
            changed[1] = 5
            if version != 5 and any(changed[5:]) and self._test.size(bytes(changed), 0):
                return f"a package of version {version}; only version 5 is known"
        return "neither a package nor a frame begins here"
