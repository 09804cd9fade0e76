"""Rescue of a folder of the rig's recorder: every segment, and a manifest made again from what they hold."""

from __future__ import annotations

import json
import os
import re
import shutil
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import gettempdir

from acino_fte.data_tools.rig_reader import is_rig_folder
from acino_fte.data_tools.rig_recording import (
    MANIFEST,
    Event,
    Manifest,
    RecordedStream,
    Segment,
    read_manifest,
    write_manifest,
)
from acino_fte.data_tools.ros_messages import kind_of
from acino_fte.errors import InputError
from acino_fte.rig.recover_files import Settings, copy_sound, is_sound, rescue_file, salvage_file
from acino_fte.rig.recover_types import Salvaged, SavedStream, merged

_MESSAGES = re.compile(r"messages-(\d+)\.mcap")
_VIDEO = re.compile(r"(.+)-(\d+)\.(mkv|mp4|avi)")
_INFO = "/info"
_FEW = 3  # messages by which streams may end apart


@dataclass
class _Part:
    """One file of the recording: of which segment, and what was saved of it."""

    name: str
    camera: str  # empty for messages
    index: int
    found: Salvaged
    n_bytes: int = 0


@dataclass
class _Folder:
    """What goes on during a rescue."""

    source: Path
    before: Manifest | None = None
    parts: list[_Part] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    whole: bool = True

    def wrong(self, note: str) -> None:
        """Something is not as it should be."""
        self.notes.append(note)
        self.whole = False


def looks_recorded(path: Path) -> bool:
    """Whether a folder is the recorder's, its manifest or its messages being there or not."""
    if is_rig_folder(path):
        return True
    names = [file.name for file in path.iterdir()]
    return MANIFEST in names and any(_VIDEO.fullmatch(name) for name in names)


def salvage_recorded(source: Path, target: Path | None, settings: Settings) -> Salvaged:
    """Rescue the folder of a recorder that was stopped by force, or by a loss of power.

    Whole files are copied as they are; damaged ones are rescued; what else lies there is copied too.

    Parameters
    ----------
    source : Path
        The folder; only read.
    target : Path, optional
        The new folder, which is there; without it only count.
    settings : Settings
        What the user said.
    """
    folder = _Folder(source)
    try:
        folder.before = read_manifest(source)
    except InputError as error:
        folder.wrong(f"{error.problem} It was made again from the files beside it.")
    if folder.before is not None and folder.before.state == "recording":
        folder.wrong("The recording was not closed: its recorder was stopped by force, or lost its power.")
        if (process := _recorder(source)) is not None:
            folder.notes.append(
                f"Its recorder still runs (process {process}): stop it with Ctrl-C, and rescue again."
            )
    for path in sorted(source.iterdir()):
        _file(folder, path, target, settings)
    _missing(folder)
    streams = _streams(folder)
    if target is not None and folder.parts:
        write_manifest(target, _manifest(folder, streams))
    counted = sum(s.lost for s in streams) - sum(s.lost for part in folder.parts for s in part.found.streams)
    losts = max(sum(part.found.lost_elsewhere for part in folder.parts) - counted, 0)
    return Salvaged(
        "rig recording",
        folder.whole,
        streams,
        losts,
        sum(part.found.bytes_lost for part in folder.parts),
        tuple(folder.notes),
    )


def _recorder(source: Path) -> int | None:
    """The process that records into a folder, by the lock of the rig beside it."""
    places = (source.resolve().parent, Path(gettempdir()))
    for lock in (lock for place in places for lock in place.glob("acino-fte-rig-*.lock")):
        with suppress(OSError, ValueError, KeyError, TypeError):
            content = json.loads(lock.read_text("utf-8"))
            if Path(content["recording"]) == source.resolve():
                os.kill(int(content["pid"]), 0)  # an OSError where there is no such process
                return int(content["pid"])
    return None


def _file(folder: _Folder, path: Path, target: Path | None, settings: Settings) -> None:
    """Rescue one file of the folder, or copy it."""
    place = target / path.name if target is not None else None
    messages, video = _MESSAGES.fullmatch(path.name), _VIDEO.fullmatch(path.name)
    if path.is_dir() and place is not None and not path.name.startswith("."):
        shutil.copytree(path, place)
    if not path.is_file() or path.name == MANIFEST:
        return
    if not messages and not video:
        if place is not None and not path.name.startswith("."):
            shutil.copyfile(path, place)
        return
    sound, found = None, None
    try:
        sound = is_sound(path, settings)
        if sound is not None and place is not None:
            copy_sound(path, place, settings)
        found = sound or _rescued(path, place, settings)
    except InputError as error:
        folder.wrong(f"{path.name}: nothing can be saved ({error.problem})")
    if found is None or (sound is None and not found.saved):
        if place is not None:
            place.unlink(missing_ok=True)
        if found is not None:
            folder.wrong(f"{path.name}: it holds nothing that is whole.")
        return
    if sound is None:
        folder.whole = False
    folder.notes += [f"{path.name}: {note}" for note in found.notes]
    camera = video[1] if video else ""
    index = int(video[2] if video else messages[1] if messages else 0)
    size = (place or path).stat().st_size
    folder.parts.append(_Part(path.name, camera, index, found, size))


def _rescued(path: Path, place: Path | None, settings: Settings) -> Salvaged:
    """What a damaged segment gives; without a place only counted."""
    return rescue_file(path, place, settings) if place else salvage_file(path, None, settings)


def _missing(folder: _Folder) -> None:
    """Compare with what the manifest says."""
    there = {part.name: part for part in folder.parts}
    for segment in folder.before.segments if folder.before is not None else ():
        part, said = there.get(segment.file), sum(segment.counts.values())
        if part is None and not (folder.source / segment.file).is_file():
            folder.wrong(f"{segment.file} is not there; it held {said or 'an unknown number of'} messages.")
        elif part is not None and segment.closed and part.found.saved < said:
            folder.wrong(
                f"{segment.file} held {said} messages when it was closed; {part.found.saved} are left."
            )
    if folder.before is not None:
        for part in folder.parts:
            if part.name not in {segment.file for segment in folder.before.segments}:
                folder.wrong(f"{part.name} is not in the manifest.")


def _streams(folder: _Folder) -> tuple[SavedStream, ...]:
    """Streams of all segments, with what the manifest knows to be missing; a video is named by its camera."""
    found = {
        stream.name: stream
        for stream in merged(
            replace(stream, name=part.camera) if part.camera else stream
            for part in folder.parts
            for stream in part.found.streams
        )
    }
    before = folder.before
    if before is None:
        return tuple(found.values())
    ends = [s.last_ns + (before.started_ns if _is_video(s) else 0) for s in found.values() if s.last_ns]
    for known in before.streams:
        one = found.get(known.name, SavedStream(known.name, "", 0))
        if known.name in found or known.written:
            found[known.name] = _compared(one, known, before, max(ends, default=before.started_ns))
    return tuple(found.values())


def _compared(one: SavedStream, known: RecordedStream, before: Manifest, end_ns: int) -> SavedStream:
    """A stream with what is missing of what the manifest says was written, or at an end that was cut off."""
    hz = known.expected_hz
    counted = sum(segment.counts.get(one.name, 0) for segment in before.segments)
    missing, exact = max(known.written, counted) - one.saved, before.state != "recording"
    last = (one.last_ns or 0) + (before.started_ns if _is_video(one) else 0)
    silent = [e for e in before.events if e.kind in ("stall", "unplugged", "error") and e.time_ns >= last]
    behind = round((end_ns - last) * 1e-9 * hz) - 1 if one.saved and hz else 0
    if before.state == "recording" and not silent and behind > max(_FEW, missing):
        missing = behind
    if missing <= one.lost:
        return one
    return replace(one, lost=missing, lost_seconds=missing / hz if hz else 0.0, exact=exact)


def _is_video(stream: SavedStream) -> bool:
    """Whether times are of a video: since the start of the recording. Topics have a slash."""
    return "/" not in stream.name


# The manifest --------------------------------------------------------------------------------------------


def _manifest(folder: _Folder, streams: tuple[SavedStream, ...]) -> Manifest:
    """A manifest that says what the copy holds."""
    before = folder.before
    started = before.started_ns if before is not None else _started(folder)
    segments = tuple(
        _segment(part, started) for part in sorted(folder.parts, key=lambda p: (p.index, p.name))
    )
    last = max((s.last_ns for s in segments if s.last_ns is not None), default=None)
    event = Event(
        "stopped",
        last if last is not None else started,
        detail="The recording ended here without being closed; acino-fte rig recover made this copy.",
    )
    closed = before is not None and before.state != "recording"
    return Manifest(
        name=before.name if before is not None else folder.source.resolve().name,
        state="recovered",
        started_ns=started,
        started_monotonic_ns=before.started_monotonic_ns if before is not None else 0,
        ended_ns=before.ended_ns if before is not None and closed else last,
        host=before.host if before is not None else "",
        program=before.program if before is not None else "",
        simulated=before.simulated if before is not None else False,
        streams=_recorded(before, streams),
        segments=segments,
        events=(*(before.events if before is not None else ()), *(() if closed else (event,))),
        notes=(*(before.notes if before is not None else ()), *folder.notes),
    )


def _segment(part: _Part, started: int) -> Segment:
    """What a file of the copy holds; the times of a video count from the start of the recording."""
    firsts = [s.first_ns for s in part.found.streams if s.first_ns is not None]
    lasts = [s.last_ns for s in part.found.streams if s.last_ns is not None]
    shift = started if part.camera else 0
    return Segment(
        part.name,
        "video" if part.camera else "messages",
        part.index,
        True,
        min(firsts) + shift if firsts else None,
        max(lasts) + shift if lasts else None,
        {part.camera or stream.name: stream.saved for stream in part.found.streams},
        part.n_bytes,
    )


def _started(folder: _Folder) -> int:
    """When the recording began, by its first messages and by the time of the first frame of a video."""
    first = {s.name: s for part in reversed(folder.parts) if not part.camera for s in part.found.streams}
    for part in folder.parts:
        info = first.get(f"/{part.camera}{_INFO}")
        video = part.found.streams[0].first_ns if part.camera else None
        same = part.index == min(p.index for p in folder.parts)
        if info is not None and info.first_ns is not None and video is not None and same:
            return info.first_ns - video
    return min((s.first_ns for s in first.values() if s.first_ns is not None), default=0)


def _recorded(before: Manifest | None, streams: tuple[SavedStream, ...]) -> tuple[RecordedStream, ...]:
    """Streams of the manifest: what was expected as it was, what was written as it is in the copy."""
    saved = {stream.name: stream for stream in streams}
    known = {stream.name: stream for stream in (before.streams if before is not None else ())}
    out = []
    for name in dict.fromkeys([*known, *saved]):
        n = saved[name].saved if name in saved else 0
        old = known.get(name)
        if old is not None:
            out.append(replace(old, received=max(old.received, n), written=n))
        else:
            out.append(_unknown(saved[name]))
    return tuple(out)


def _unknown(stream: SavedStream) -> RecordedStream:
    kind = "image" if _is_video(stream) else kind_of(stream.type)
    rate = (stream.saved - 1) / stream.seconds if stream.seconds > 0 else 0.0
    known = kind if kind != "other" else "image_info"
    return RecordedStream(stream.name, known, round(rate, 3), stream.saved, stream.saved)
