"""Rescue of LVX files (1.0, 1.1, LVX2): every whole package, byte for byte, in frames with right offsets."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from acino_fte.data_tools.lvx_head import LvxHead, open_binary, read_head
from acino_fte.data_tools.lvx_packets import DEVICE_NAMES, MAGIC, PUBLIC, SIGNATURE, decode_stamps
from acino_fte.data_tools.lvx_recognise import PackageTest
from acino_fte.data_tools.lvx_walk import RawFrame, Walk
from acino_fte.errors import InputError
from acino_fte.rig.recover_types import Salvaged, Tally

_PEEK_FRAMES = 4
_FRAME_MS = 50  # what recording programs write
_TYPES = ((4_167, 2), (10_000, 1), (5_000, 9))  # ns between samples, and the device taken for such a lidar
_SHOWN = 20


def salvage_lvx(source: Path, target: Path | None, like: Path | None = None) -> Salvaged:
    """Copy every whole package of an LVX file under a right head, in frames with right offsets and numbers.

    Parameters
    ----------
    source : Path
        The file; only read.
    target : Path, optional
        The new file; without it the packages are only counted.
    like : Path, optional
        A sound file of the same lidars: their entries in its head are taken where those here are lost.
    """
    with open_binary(source) as file:
        head = read_head(file, source)
        test = _test(file, head)
        walk = Walk(file, test, head.start)
        copy = _Copy(head, test)
        if target is None:
            for frame in walk.frames():
                copy.count(frame, len(walk.holes))
        else:
            _write(walk, copy, target, source, like)
    notes = [*head.notes, *copy.notes]
    if head.cut:
        notes.append("The file ends within its head.")
    if walk.n_wrong_offsets:
        notes.append(f"{walk.n_wrong_offsets} frames had wrong offsets.")
    for hole in walk.holes[:_SHOWN]:
        notes.append(f"{hole.stop - hole.start} bytes from byte {hole.start} on are lost: {hole.why}.")
    if len(walk.holes) > _SHOWN:
        notes.append(f"{len(walk.holes) - _SHOWN} more damaged places.")
    unknown = test.devices != (head.numbers or None)
    if unknown:
        notes.append("The packages are of devices that the head does not name.")
    streams = copy.tally.streams()
    at_ends = sum(hole.n_lost or 0 for hole in walk.holes)
    bytes_lost = sum(hole.stop - hole.start for hole in walk.holes)
    wrong = head.notes or head.cut or walk.holes or walk.n_wrong_offsets or unknown
    form = f"LVX{'2' if head.layout.version == '2' else ' ' + head.layout.version}"
    return Salvaged(form, not wrong, streams, at_ends, bytes_lost, tuple(notes))


def _test(file: BinaryIO, head: LvxHead) -> PackageTest:
    """What recognises the packages: by the devices of the head, unless the first packages are of others."""
    test = PackageTest(head.layout, head.numbers or None)
    for number, frame in enumerate(Walk(file, test, head.start).frames()):
        if frame.packages or number >= _PEEK_FRAMES:
            return test
    return PackageTest(head.layout) if head.numbers and not head.cut else test


@dataclass
class _Copy:
    """Packages on their way, counted."""

    head: LvxHead
    test: PackageTest
    tally: Tally = field(default_factory=Tally)
    kinds: dict[int, set[int]] = field(default_factory=dict)
    steps: dict[int, list[float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _before: dict[int, int] = field(default_factory=dict)

    def count(self, frame: RawFrame, mark: int) -> None:
        """Count the packages of a frame; `mark`: damaged places so far."""
        layout, groups = self.head.layout, dict[tuple[int, int, int], list[bytes]]()
        clock_at = 6 if layout.version == "2" else 9
        for device, kind, package in frame.packages:
            groups.setdefault((device, kind, package[clock_at]), []).append(package)
        for (device, kind, code), packages in groups.items():
            heads = np.frombuffer(b"".join(p[: self.test.header] for p in packages), layout.header)
            clock = layout.clocks.get(code, "unknown")
            stamps = decode_stamps(heads["stamp"], clock, layout.version)
            imu = kind == layout.imu_kind
            self.kinds.setdefault(device, set()).add(kind)
            index = self.head.numbers.get(device, device)
            name = f"{'imu' if imu else 'lidar'}{index}"
            for stamp in stamps.tolist():
                self.tally.add(name, layout.kinds[kind].name, stamp, mark)
            if not imu and len(stamps) > 1 and len(self.steps.setdefault(device, [])) < 1_000:
                self.steps[device] += (np.diff(stamps) / self.test.samples(packages[0])).tolist()

    def type_of(self, device: int) -> int:
        """The type of a lidar that no head names, by the time between its samples."""
        steps = self.steps.get(device)
        step = float(np.median(steps)) if steps else 4_167.0
        return min(_TYPES, key=lambda known: abs(known[0] - step))[1]


def _write(walk: Walk, copy: _Copy, target: Path, source: Path, like: Path | None) -> None:
    """The frames first, behind room for a head of all devices that turn up; then the head."""
    devices = _devices_of(walk, source, copy)
    layout = copy.head.layout
    with target.open("w+b") as out:
        out.seek(layout.data_start(len(devices)))
        number = 0
        for frame in walk.frames():
            copy.count(frame, len(walk.holes))
            if not frame.packages:
                continue
            at = out.tell()
            body = b"".join(package for *_, package in frame.packages)
            numbers = [at, at + layout.frame_bytes + len(body), number]
            if layout.version == "1.0":
                numbers.append(len(frame.packages))
            out.write(np.array(numbers, "<u8").tobytes() + body)
            number += 1
        out.seek(0)
        out.write(_file_head(copy, devices, source, like))


def _devices_of(walk: Walk, source: Path, copy: _Copy) -> list[int]:
    """What packages call the devices, those of the head first; read ahead where the head lacks some."""
    known = list(copy.head.numbers)
    if known and copy.test.devices:
        return known  # no others are recognised
    found = dict.fromkeys(known)
    with open_binary(source) as file:
        for frame in Walk(file, copy.test, copy.head.start).frames():
            found.update(dict.fromkeys(device for device, *_ in frame.packages))
    return list(found)[:255]


def _file_head(copy: _Copy, devices: list[int], source: Path, like: Path | None) -> bytes:
    """Public and private head, and the devices: as they were, as the sound file has them, or made anew."""
    layout = copy.head.layout
    public = np.zeros((), PUBLIC)
    public["signature"], public["version"], public["magic"] = SIGNATURE, layout.number, MAGIC
    private = np.zeros((), layout.private)
    private["devices"] = len(devices)
    if "duration" in (layout.private.names or ()):
        private["duration"] = _FRAME_MS
    rows, key = dict[int, np.void](), "lidar" if layout.version == "2" else "index"
    sources = [(source, copy.head)] if copy.head.numbers else []
    if like is not None:
        with open_binary(like) as file:
            other = read_head(file, like)
        if other.layout is not layout:
            raise InputError(
                "The sound file is of another version.",
                file=like,
                expected=f"LVX {layout.version}",
                found=f"LVX {other.layout.version}",
            )
        sources.append((like, other))
    for path, head in sources:
        data = path.open("rb").read(head.start)
        for row in np.frombuffer(data, layout.device, len(head.devices), layout.data_start(0)):
            rows.setdefault(int(row[key]), row)
        if "duration" in (layout.private.names or ()) and head is sources[0][1]:
            private["duration"] = np.frombuffer(data, layout.private, 1, PUBLIC.itemsize)[0]["duration"]
    table = np.zeros(len(devices), layout.device)
    for place, device in enumerate(devices):
        if device in rows:
            table[place] = rows[device]
            continue
        table[place][key] = device
        table[place]["type"] = kind = copy.type_of(device)
        if layout.version == "2":
            table[place]["lidar_type"] = 8
        copy.notes.append(
            f"The head no longer names lidar {device}: by the time between its samples it is taken for a "
            f"{DEVICE_NAMES[kind]}; its serial number is lost."
        )
    return public.tobytes() + private.tobytes() + table.tobytes()
