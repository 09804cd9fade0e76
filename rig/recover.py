"""Rescue of damaged recordings: a readable copy of everything that is whole, and an account of the rest.

The original is only read. The copy appears whole at the end, or not at all.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from secrets import token_hex

from acino_fte.data_tools.video import VIDEO_SUFFIXES
from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError, did_you_mean
from acino_fte.rig.recover_files import (
    Settings,
    copy_sound,
    count_of,
    file_kind,
    is_sound,
    rescue_file,
)
from acino_fte.rig.recover_types import Recovery, Salvaged

REPORT = "recovery.json"
_TAIL = "-recovered"
_BAG2 = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")
_OTHERS = (".bag", ".lvx", ".lvx2", ".hdf5", *VIDEO_SUFFIXES)
_NUMBERED = re.compile(r"(.+)_(\d+)\.(db3|mcap)(\.zstd)?")
_EXPECTED = (
    "a bag of ROS 1 or ROS 2, an MCAP, an LVX, eCAL's .hdf5, an MP4 or Matroska video, the folder of a "
    "recorder, or a folder of such files"
)
Tell = Callable[[str], None]


def recover(
    path: Path | str,
    out: Path | str | None = None,
    *,
    like: Path | str | None = None,
    fps: float | None = None,
    tell: Tell | None = None,
) -> Recovery:
    """Make a readable copy of a damaged recording.

    Parameters
    ----------
    path : Path
        A file, the folder of a ROS 2 bag or of the rig's recorder, or a folder of recordings; only read.
    out : Path, optional
        The copy; it must not exist. Default: ``NAME-recovered`` beside the original, or in the working folder
        where nothing can be written there. Without it, nothing is written of a recording that is whole.
    like : Path, optional
        A sound recording of the same devices: an MP4 without its index, an LVX without its head and eCAL's
        recordings without tables take from it what they have lost.
    fps : float, optional
        Frames per second of an MP4 without its index.
    tell : callable, optional
        Called with what is under way.

    Returns
    -------
    Recovery
        What was saved and lost; also written as ``recovery.json`` beside the copy (in it, where it is a
        folder).

    Raises
    ------
    InputError
        It is no recording, nothing of it can be saved, or the copy cannot be written or exists.
    """
    source, settings = Path(path), Settings(Path(like) if like is not None else None, fps)
    said = tell or (lambda _: None)
    kind = _kind(source)
    wanted = Path(out) if out is not None else None
    if wanted is not None:
        _refuse(wanted, source)
    try:
        if kind == "batch":
            return _batch(source, wanted, settings, said)
        said(f"looking at {source.name}")
        return _one(source, wanted, settings, kind, said, _sound(source, settings, kind))
    except OSError as error:
        raise _unwritable(error, source, wanted or source.parent) from error
    except sqlite3.Error as error:
        raise InputError("The copy cannot be written.", file=source, found=str(error)) from error


def _kind(source: Path) -> str:
    """``"file"``, ``"bag2"``, ``"rig"`` or ``"batch"``."""
    if not source.exists():
        near = ""
        with suppress(OSError):
            near = did_you_mean(source.name, (other.name for other in source.parent.iterdir())).lstrip("; ")
        raise InputError(
            "There is no such recording.",
            file=source,
            expected=_EXPECTED,
            found="nothing",
            remedy=near or None,
        )
    if not source.is_dir():
        return "file"
    from acino_fte.rig.recover_folder import looks_recorded

    try:
        names = sorted(file.name for file in source.iterdir())
    except OSError as error:
        raise InputError(
            "The folder cannot be read.", file=source, found=error.strerror or str(error)
        ) from None
    if not names:
        raise InputError("The folder is empty.", file=source, expected=_EXPECTED)
    if looks_recorded(source):
        return "rig"
    bags = [name for name in names if name.endswith(_BAG2)]
    stems = {match[1] if (match := _NUMBERED.fullmatch(name)) else None for name in bags}
    others = any(name.lower().endswith(_OTHERS) for name in names)
    if bags and ("metadata.yaml" in names or (len(stems) == 1 and None not in stems and not others)):
        return "bag2"
    return "batch"


# One recording -------------------------------------------------------------------------------------------


def _one(
    source: Path, out: Path | None, settings: Settings, kind: str, tell: Tell, sound: Salvaged | None
) -> Recovery:
    if sound is not None and out is None:
        return _recovery(source, None, None, sound)
    target = out if out is not None else _place(source)
    _refuse(target, source)
    _room(source, target)
    target.parent.mkdir(parents=True, exist_ok=True)
    working = target.parent / f".{target.name}.writing-{token_hex(4)}"
    working.mkdir()
    try:
        tell(f"rescuing {source.name}")
        if kind == "file":
            return _into_file(source, working, target, settings, sound)
        return _into_folder(source, working, target, settings, kind, sound)
    finally:
        shutil.rmtree(working, ignore_errors=True)


def _sound(source: Path, settings: Settings, kind: str) -> Salvaged | None:
    """What a recording holds that nothing is wrong with; None of another."""
    if kind == "file":
        return is_sound(source, settings)
    found = _salvage_folder(source, None, settings, kind)
    return found if found.whole else None


def _salvage_folder(source: Path, target: Path | None, settings: Settings, kind: str) -> Salvaged:
    if kind == "rig":
        from acino_fte.rig.recover_folder import salvage_recorded

        return salvage_recorded(source, target, settings)
    from acino_fte.rig.recover_bag2 import salvage_bag2

    return salvage_bag2(source, target, settings)


def _into_file(
    source: Path, working: Path, target: Path, settings: Settings, sound: Salvaged | None
) -> Recovery:
    copy = working / _suffixed(target, source).name
    target = target.parent / copy.name
    if sound is not None:
        copy_sound(source, copy, settings)
        found = sound
    else:
        found = rescue_file(source, copy, settings)
        _check(source, copy, found)
    report = target.with_name(f"{target.name}.{REPORT}")
    recovery = _recovery(source, target, report, found)
    _sync(copy)
    _refuse(target, source)
    copy.rename(target)
    write_text_whole(report, _text(recovery))
    return recovery


def _into_folder(
    source: Path, working: Path, target: Path, settings: Settings, kind: str, sound: Salvaged | None
) -> Recovery:
    found = _salvage_folder(source, working, settings, kind)
    if sound is None and not found.saved:
        raise _nothing(source, found.notes)
    recovery = _recovery(source, target, target / REPORT, found)
    (working / REPORT).write_text(_text(recovery), encoding="utf-8")
    for file in filter(Path.is_file, working.iterdir()):
        _sync(file)
    _refuse(target, source)
    working.rename(target)
    return recovery


def _check(source: Path, copy: Path, found: Salvaged) -> None:
    """See that something was saved, and that the usual readers see it too."""
    if not found.saved or not copy.is_file():
        raise _nothing(source, found.notes)
    kind = file_kind(copy)
    if kind in ("ros1", "mcap") and count_of(copy, kind) != found.saved:
        raise InputError(
            "The copy does not read as it should, so it was not kept.",
            file=source,
            expected=f"{found.saved} messages",
            found=f"{count_of(copy, kind)}",
            remedy="please report this, with the file if you can",
        )


def _nothing(source: Path, notes: tuple[str, ...]) -> InputError:
    return InputError(
        "Nothing could be saved.",
        file=source,
        found=" ".join(notes[:3]) or "no whole message",
        remedy="look for another copy: on the recorder's disk, or on the card it was carried with",
    )


def _recovery(source: Path, copy: Path | None, report: Path | None, found: Salvaged) -> Recovery:
    return Recovery(
        source,
        copy,
        report,
        found.form,
        found.whole,
        found.streams,
        found.lost_elsewhere,
        found.bytes_lost,
        found.notes,
    )


def _text(recovery: Recovery) -> str:
    return json.dumps(recovery.content(), indent=1, ensure_ascii=False) + "\n"


def _sync(path: Path) -> None:
    """Have the disk hold a file."""
    with path.open("rb") as file, suppress(OSError):
        os.fsync(file.fileno())


# Where to ------------------------------------------------------------------------------------------------


def _place(source: Path) -> Path:
    """``NAME-recovered`` beside the original, or in the working folder where nothing can be written there."""
    source = source.resolve()
    name = source.name.removesuffix(".zstd") if source.is_file() else source.name
    if source.is_file():
        name = f"{Path(name).stem}{_TAIL}{Path(name).suffix}"
    else:
        name = f"{name}{_TAIL}"
    return (source.parent if _writable(source.parent) else Path.cwd()) / name


def _writable(folder: Path) -> bool:
    """Whether files can be made in a folder."""
    trial = folder / f".acino-fte-{token_hex(4)}"
    try:
        trial.mkdir()
        trial.rmdir()
    except OSError:
        return False
    return True


def _suffixed(target: Path, source: Path) -> Path:
    """The target with the suffix of the original, where it has none."""
    suffix = Path(source.name.removesuffix(".zstd")).suffix
    return target if target.suffix else target.with_name(target.name + suffix)


def _refuse(target: Path, source: Path) -> None:
    """Never write over anything."""
    if target.exists() or target.is_symlink():
        raise InputError(
            "The copy exists already; nothing was written over.",
            file=target,
            remedy="name another with --out, or remove it first",
        )
    if source.is_dir() and source.resolve() in target.resolve().parents:
        raise InputError(
            "The copy would lie inside the original.", file=target, remedy="name another place with --out"
        )


def _room(source: Path, target: Path) -> None:
    """See that the disk has room for a copy."""
    files = [source] if source.is_file() else [f for f in source.iterdir() if f.is_file()]
    needed = sum(file.stat().st_size for file in files)
    folder = next(parent for parent in target.resolve().parents if parent.is_dir())
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise InputError(
            "The disk has no room for the copy.",
            file=folder,
            expected=f"{needed / 1e9:.2f} GB free",
            found=f"{free / 1e9:.2f} GB",
            remedy="name another disk with --out",
        )


def _unwritable(error: OSError, source: Path, place: Path) -> InputError:
    if error.errno == errno.EIO:
        return InputError(
            "The disk itself cannot be read.",
            file=error.filename or source,
            found=error.strerror,
            remedy="copy the file with ddrescue to a sound disk first, and rescue that",
        )
    return InputError(
        "The copy cannot be written; nothing of it was left.",
        file=place,
        found=error.strerror or str(error),
        remedy="free some space, or name another place with --out",
    )


# A folder of recordings ----------------------------------------------------------------------------------


def _batch(source: Path, out: Path | None, settings: Settings, tell: Tell) -> Recovery:
    """Every recording of a folder; the copies come into one new folder, under their own names."""
    found = [path for path in sorted(source.iterdir()) if _is_one(path)]
    if not found:
        names = ", ".join(path.name for path in sorted(source.iterdir())[:5])
        raise InputError("The folder has no recordings.", file=source, expected=_EXPECTED, found=names)
    target = out if out is not None else _place(source)
    parts: list[Recovery] = []
    failed: list[tuple[str, str]] = []
    for path in found:
        kind, name = _kind(path), path.name
        tell(f"looking at {name}")
        try:
            sound = _sound(path, settings, kind)
            if sound is not None and out is None:
                parts.append(_recovery(path, None, None, sound))
            else:
                place = target / (name.removesuffix(".zstd") if path.is_file() else name)
                parts.append(_one(path, place, settings, kind, tell, sound))
        except InputError as error:
            failed.append((path.name, error.found or error.problem))
    if not any(part.whole or part.saved for part in parts):
        with suppress(OSError):
            target.rmdir()
        raise _nothing(source, tuple(f"{name}: {why}." for name, why in failed))
    copied = any(part.copy is not None for part in parts)
    whole = all(part.whole for part in parts) and not failed
    report = target / REPORT if copied else None
    recovery = Recovery(
        source, target if copied else None, report, "folder of recordings", whole, (), parts=tuple(parts),
        failed=tuple(failed),
    )  # fmt: skip
    if report is not None:
        write_text_whole(report, _text(recovery))
    return recovery


def _is_one(path: Path) -> bool:
    """Whether something in a folder is a recording."""
    if path.name.startswith(".") or path.name.endswith(("-wal", "-shm", "-journal")):
        return False
    try:
        if path.is_dir():
            return _kind(path) in ("rig", "bag2")
        file_kind(path)
    except (InputError, OSError):
        return False
    return True
