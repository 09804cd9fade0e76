"""Heads of LVX files: which version, which devices, and where the frames begin, even when they are wrong."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from acino_fte.data_tools.lvx_packets import LAYOUTS, MAGIC, PUBLIC, SIGNATURE, Layout, LvxDevice, Version
from acino_fte.data_tools.lvx_recognise import PackageTest
from acino_fte.data_tools.lvx_walk import Walk
from acino_fte.errors import InputError

_HEAD_BYTES = 40_000  # more than a head of 255 devices and one frame's first packages
_SEARCH_BYTES = 64 << 20
_TRIED_FRAMES = 4
_NAME = b"livox_tech"


@dataclass(frozen=True)
class LvxHead:
    """What the head of a file says, and what was wrong with it.

    Attributes
    ----------
    layout : Layout
    devices : tuple of LvxDevice
        As the head lists them; none where it is unusable.
    start : int
        Where the first frame begins.
    numbers : dict of int to int
        Index of a device by what packages call it (LVX 1: the index itself; LVX2: the lidar's id).
    notes : tuple of str
        What was odd, one sentence each.
    cut : bool
        Whether the file ends within its head.
    """

    layout: Layout
    devices: tuple[LvxDevice, ...]
    start: int
    numbers: dict[int, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    cut: bool = False


def is_lvx(data: bytes) -> bool:
    """Whether a file that begins with these bytes calls itself LVX."""
    return data.startswith(_NAME)


def read_head(file: BinaryIO, path: Path, search: int = _SEARCH_BYTES) -> LvxHead:
    """Read the head of an LVX file; a wrong one is passed over where frames follow it.

    Raises
    ------
    InputError
        The file is no LVX: neither its head nor anything in its first `search` bytes says so.
    """
    file.seek(0)
    data = file.read(_HEAD_BYTES)
    signed = data.startswith(_NAME) or (len(data) > 3 and SIGNATURE.startswith(data))
    number = tuple(data[16:20])
    named = next((layout for layout in LAYOUTS.values() if layout.number == number), None)
    order = sorted(LAYOUTS.values(), key=lambda layout: layout is not named)
    ranked = [(_score(data, layout), layout) for layout in order]
    score, layout = max(ranked, key=lambda pair: pair[0])
    if score == 2 or (score and signed):
        return _head(data, layout, named, signed)
    if signed and named and _readable(data, named):
        return _head(data, named, named, signed)
    if signed and len(data) < PUBLIC.itemsize:
        return LvxHead(LAYOUTS["1.1"], (), len(data), cut=True)
    return _found(file, path, named, signed, data, search)


def _score(data: bytes, layout: Layout) -> int:
    """2 where a frame with a package begins after the head, 1 where one of them does, 0 otherwise."""
    count = _count(data, layout)
    if count is None:
        return 0
    start = layout.data_start(count)
    walk = np.frombuffer(data[start : start + 16].ljust(16, b"\0"), "<u8")
    frame = int(walk[0]) == start and int(walk[1]) >= start + layout.frame_bytes
    return int(frame) + bool(PackageTest(layout).size(data, start + layout.frame_bytes))


def _count(data: bytes, layout: Layout) -> int | None:
    """How many devices the head claims; None where it ends before it says so."""
    stop = layout.data_start(0)
    return data[stop - 1] if len(data) >= stop else None


def _readable(data: bytes, layout: Layout) -> bool:
    """Whether the head of a file without a first frame makes sense: its codes are letters and numbers."""
    count = _count(data, layout)
    if count is None:
        return True
    stop = layout.data_start(count)
    if len(data) < stop:
        return True
    table = np.frombuffer(data, layout.device, count, layout.data_start(0))
    return count > 0 and all(code.isascii() and bytes(code).isalnum() for code in table["code"] if code)


def _head(data: bytes, layout: Layout, named: Layout | None, signed: bool) -> LvxHead:
    notes = []
    public = np.frombuffer(data[: PUBLIC.itemsize].ljust(PUBLIC.itemsize, b"\0"), PUBLIC)[0]
    if not signed:
        notes.append("The head does not begin with 'livox_tech'; the frames are read all the same.")
    elif len(data) >= PUBLIC.itemsize and int(public["magic"]) != MAGIC:
        notes.append(f"The head has the magic number {int(public['magic']):#x}, not {MAGIC:#x}.")
    if named is not layout:
        version = ".".join(str(n) for n in public["version"])
        notes.append(f"The head says version {version}; the frames are those of LVX {layout.version}.")
    count = _count(data, layout)
    start = layout.data_start(count or 0)
    if count is None or len(data) < start:
        return LvxHead(layout, (), len(data), notes=tuple(notes), cut=True)
    devices, numbers = _devices(data, layout, count)
    return LvxHead(layout, devices, start, numbers, tuple(notes))


def _devices(data: bytes, layout: Layout, count: int) -> tuple[tuple[LvxDevice, ...], dict[int, int]]:
    """The devices of the head, and their indices by what packages call them."""
    table = np.frombuffer(data, layout.device, count, layout.data_start(0))
    devices, numbers = [], {}
    for place, row in enumerate(table):
        index = place if layout.version == "2" else int(row["index"])
        numbers[int(row["lidar"]) if layout.version == "2" else index] = index
        roll, pitch, yaw = (float(angle) for angle in np.radians(row["angles"].astype(float)))
        x, y, z = (float(value) for value in row["translation"])
        enabled = bool(row["enabled"]) if layout.version != "1.0" else bool(row["angles"].any())
        code, hub = (bytes(row[name]).decode("ascii", "replace") for name in ("code", "hub"))
        devices.append(LvxDevice(index, code, int(row["type"]), hub, enabled, roll, pitch, yaw, (x, y, z)))
    return tuple(devices), numbers


def _found(
    file: BinaryIO, path: Path, named: Layout | None, signed: bool, data: bytes, search: int
) -> LvxHead:
    """The head of a file whose head is unusable: its version is that of the first frame found."""
    skipped: dict[Version, tuple[int, int]] = {}
    for version, layout in LAYOUTS.items():
        place = Walk(file, PackageTest(layout), 0).find_frame(search)
        if place is not None:
            skipped[version] = _skipped(file, layout, place), place
    if skipped:
        best = min(skipped, key=lambda version: (*skipped[version], LAYOUTS[version] is not named))
        layout = LAYOUTS[best]
        start = Walk(file, PackageTest(layout), 0).find_any()  # packages of a frame without its header
        note = f"The head is unusable; what follows from byte {start} on is LVX {best}."
        return LvxHead(layout, (), start, notes=(note, "The type of the lidar is not known."))
    if signed:
        layout = named or LAYOUTS["1.1"]
        start = min(len(data), layout.data_start(0))
        return LvxHead(layout, (), start, notes=("The head is unusable and no frame was found.",), cut=True)
    raise InputError(
        "The file is no LVX recording.",
        file=path,
        expected="'livox_tech' at its start, or frames of Livox packages",
        found=repr(data[:16])[1:] if data else "an empty file",
        remedy="check the path; bags and videos are read by their own readers",
    )


def _skipped(file: BinaryIO, layout: Layout, place: int) -> int:
    """Bytes of the next frames that make no packages by this layout."""
    walk = Walk(file, PackageTest(layout), place)
    for number, _ in enumerate(walk.frames()):
        if number >= _TRIED_FRAMES:
            break
    return sum(hole.stop - hole.start for hole in walk.holes)


def open_binary(path: Path) -> io.BufferedReader:
    """The file, open for reading.

    Raises
    ------
    InputError
        There is no such file, or it cannot be opened.
    """
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError(
            "There is no such recording.",
            file=path,
            expected="an LVX file",
            found=found,
            remedy="check the path",
        )
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError("The recording cannot be opened.", file=path, found=str(error)) from error
