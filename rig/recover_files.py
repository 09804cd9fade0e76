"""Rescue of one file: what it is, whether anything is wrong with it, and a readable copy."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from acino_fte.data_tools.bags import bag_kind
from acino_fte.data_tools.bags_window import Losses, decompressor
from acino_fte.data_tools.open_recording import is_video, recording_kind
from acino_fte.data_tools.video import VIDEO_SUFFIXES
from acino_fte.errors import InputError
from acino_fte.rig.recover_types import Salvaged

FileKind = Literal["ros1", "mcap", "sqlite", "ecal", "zstd", "lvx", "video"]
_BY_SUFFIX: dict[str, FileKind] = {
    ".bag": "ros1",
    ".mcap": "mcap",
    ".db3": "sqlite",
    ".hdf5": "ecal",
    ".lvx": "lvx",
    ".lvx2": "lvx",
    **dict.fromkeys(VIDEO_SUFFIXES, "video"),
}


@dataclass(frozen=True)
class Settings:
    """What the user may say: a sound recording of the same devices, and the frame rate of a video."""

    like: Path | None = None
    fps: float | None = None


def file_kind(path: Path) -> FileKind:
    """What a file is, by its content; by its name where its first bytes are lost.

    Raises
    ------
    InputError
        It is no recording.
    """
    try:
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        raise InputError(
            "The recording cannot be opened.",
            file=path,
            found=error.strerror or str(error),
            remedy="check that you may read it",
        ) from None
    bag = bag_kind(path)
    if bag is not None:
        return bag
    named = _BY_SUFFIX.get(path.suffix.lower())
    if named == "lvx":
        return named
    if is_video(head):
        return "video"
    try:
        kind = recording_kind(path)
    except InputError:
        damaged = head[:4] == bytes(4) or b"\0" in head  # text and pictures are no recordings
        if named is None or not damaged or not any(_any_bytes(path)):
            raise
        return named
    return "lvx" if kind == "lvx" else "video"


def _any_bytes(path: Path) -> Iterator[bool]:
    """Whether blocks of a file hold anything but zeros."""
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            yield bool(block.strip(b"\0"))


def salvage_file(path: Path, target: Path | None, settings: Settings) -> Salvaged:
    """Rescue one file into `target`; without it only count what it holds.

    Raises
    ------
    InputError
        It is no recording, or cannot be read at all.
    """
    kind = file_kind(path)
    if kind == "zstd":
        with unpacked(path, target.parent if target else None) as (inner, problem):
            try:
                found = salvage_file(inner, target, settings)
            except InputError as error:
                raise InputError(
                    "Nothing can be saved of the compressed file.", file=path, found=problem or error.problem
                ) from None
            problems = (problem,) if problem else ()
            return replace(found, whole=found.whole and not problem, notes=(*problems, *found.notes))
    if kind == "ros1":
        from acino_fte.rig.recover_ros1 import salvage_ros1

        return salvage_ros1(path, target)
    if kind == "mcap":
        from acino_fte.rig.recover_mcap import salvage_mcap

        return salvage_mcap(path, target)
    if kind == "sqlite":
        from acino_fte.rig.recover_sqlite import salvage_sqlite

        return salvage_sqlite(path, target)
    if kind == "ecal":
        from acino_fte.rig.recover_ecal import salvage_ecal

        return salvage_ecal(path, target, settings.like)
    if kind == "lvx":
        from acino_fte.rig.recover_lvx import salvage_lvx

        return salvage_lvx(path, target, settings.like)
    return _video(path, target, settings)


def _video(path: Path, target: Path | None, settings: Settings) -> Salvaged:
    from acino_fte.rig.recover_mp4 import salvage_mp4
    from acino_fte.rig.recover_video import NoIndex, salvage_video

    try:
        return salvage_video(path, target)
    except NoIndex as error:
        if path.suffix.lower() not in (".mp4", ".mov", ".m4v") or target is None:
            raise InputError(
                "Nothing can be saved of this video: its head is lost.", file=path, found=str(error)
            ) from None
        return salvage_mp4(path, target, settings.like, settings.fps)


def rescue_file(path: Path, target: Path, settings: Settings) -> Salvaged:
    """Rescue a file that :func:`is_sound` did not find sound."""
    found = salvage_file(path, target, settings)
    if not found.whole:
        return found
    note = "Every message is there, but the usual readers do not open the file: its index is damaged."
    return replace(found, whole=False, notes=(*found.notes, note))


def is_sound(path: Path, settings: Settings) -> Salvaged | None:
    """What a file holds that nothing is wrong with, also for the usual readers; None of a damaged one."""
    kind = file_kind(path)
    if kind == "zstd":
        with unpacked(path, None) as (inner, problem):
            try:
                return None if problem else is_sound(inner, settings)
            except InputError:
                return None
    if not _seems_sound(path, kind):
        return None
    try:
        found = salvage_file(path, None, settings)
    except InputError:
        return None
    return found if found.whole and _opens(path, kind, found.saved) else None


def _opens(path: Path, kind: FileKind, saved: int) -> bool:
    """Whether the usual readers open a file, and see so many messages."""
    if kind == "sqlite":
        from acino_fte.rig.recover_sqlite import sqlite_is_sound

        return sqlite_is_sound(path)
    return kind not in ("ros1", "mcap") or count_of(path, kind) == saved


def _seems_sound(path: Path, kind: FileKind) -> bool:
    """False where a look at the end of the file tells that it was cut."""
    if kind == "ecal":
        from acino_fte.rig.recover_ecal import ecal_is_whole

        return ecal_is_whole(path)
    walks = {"ros1": "bags_ros1.Ros1Walk", "mcap": "bags_mcap.McapWalk", "sqlite": "bags_sqlite.SqliteWalk"}
    if kind not in walks:
        return True
    from importlib import import_module

    module, _, name = walks[kind].partition(".")
    walk: Any = getattr(import_module(f"acino_fte.data_tools.{module}"), name)
    try:
        return bool(walk(path, Losses()).overview())
    except InputError:
        return False


def count_of(path: Path, kind: FileKind) -> int:
    """Messages of a ROS 1 bag or an MCAP file as ``rosbags`` and ``mcap`` read it; -1 where not."""
    try:
        if kind == "ros1":
            from rosbags.rosbag1 import Reader

            with Reader(path) as reader:
                return int(reader.message_count)
        from mcap.reader import make_reader

        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
            return int(summary.statistics.message_count) if summary and summary.statistics else -1
    except Exception:  # noqa: BLE001 - whatever a damaged file makes other people's readers raise
        return -1


@contextmanager
def unpacked(path: Path, room: Path | None) -> Iterator[tuple[Path, str]]:
    """A file that rosbag2 compressed as a whole, unpacked as far as it goes; and what was wrong with it."""
    with tempfile.TemporaryDirectory(prefix=".acino-fte-", dir=room) as folder:
        target, unpack, problem = Path(folder) / path.stem, decompressor("zstd"), ""
        with path.open("rb") as source, target.open("wb") as out:
            while not problem and (block := source.read(1 << 20)):
                try:
                    out.write(unpack.decompress(block))
                except Exception as error:  # noqa: BLE001 - the library's own errors
                    problem = f"The compressed data are damaged ({error})."
        if not problem and not unpack.eof:
            problem = "The compressed data end early."
        yield target, problem


def copy_sound(path: Path, target: Path, settings: Settings) -> None:
    """Copy the bytes of a sound file; one that is compressed as a whole is unpacked."""
    if file_kind(path) == "zstd":
        salvage_file(path, target, settings)
    else:
        shutil.copyfile(path, target)
