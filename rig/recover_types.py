"""What a rescue finds: streams with what was saved and lost of them, and how that is counted."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.bags_window import Losses

FORMAT = "acino-fte/recovery/1"
_INTERVALS = 4096  # of a stream that its usual one is told by


@dataclass(frozen=True)
class SavedStream:
    """One stream of a damaged recording.

    Attributes
    ----------
    name, type : str
        Topic and message type; ``lidar0`` and its kind of packages; the video and its codec.
    saved : int
        Messages, packages or frames in the copy.
    seconds : float
        From the first to the last of them.
    first_ns, last_ns : int, optional
        Their times, ns: when they were received, or by the file's own clock.
    lost : int
        How many are known to be missing.
    lost_seconds : float
        How long these would have been.
    exact : bool
        Whether `lost` was counted (by an index, or by numbers); otherwise the usual interval of the stream
        and the time that is missing tell it.
    """

    name: str
    type: str
    saved: int
    seconds: float = 0.0
    first_ns: int | None = None
    last_ns: int | None = None
    lost: int = 0
    lost_seconds: float = 0.0
    exact: bool = False


@dataclass(frozen=True)
class Salvaged:
    """What one file gave.

    Attributes
    ----------
    form : str
        What the file is, in words.
    whole : bool
        Whether nothing was wrong with it.
    streams : tuple of SavedStream
    lost_elsewhere : int
        Messages that are known to be missing, of which stream is not known.
    bytes_lost : int
        That could not be used.
    notes : tuple of str
        What was wrong and what was done, one sentence each.
    topics : dict
        Of ROS 2: by topic what metadata.yaml says of it.
    """

    form: str
    whole: bool
    streams: tuple[SavedStream, ...]
    lost_elsewhere: int = 0
    bytes_lost: int = 0
    notes: tuple[str, ...] = ()
    topics: dict[str, dict[str, str]] = field(default_factory=dict)

    @property
    def saved(self) -> int:
        """Messages of all streams."""
        return sum(stream.saved for stream in self.streams)


@dataclass(frozen=True)
class Recovery:
    """What became of a damaged recording.

    Attributes
    ----------
    source : Path
        Was not touched.
    copy : Path, optional
        The readable copy; None where nothing was wrong and no copy was asked for.
    report : Path, optional
        ``recovery.json`` of the copy.
    form : str
        What the recording is, in words.
    whole : bool
        Whether nothing was wrong with it.
    streams : tuple of SavedStream
    lost_elsewhere : int
        Messages that are known to be missing, of which stream is not known.
    bytes_lost : int
    notes : tuple of str
        One sentence each.
    parts : tuple of Recovery
        Of a folder of recordings: each of them.
    failed : tuple of (str, str)
        Of such a folder: files of which nothing could be saved, and why.
    """

    source: Path
    copy: Path | None
    report: Path | None
    form: str
    whole: bool
    streams: tuple[SavedStream, ...]
    lost_elsewhere: int = 0
    bytes_lost: int = 0
    notes: tuple[str, ...] = ()
    parts: tuple[Recovery, ...] = ()
    failed: tuple[tuple[str, str], ...] = ()

    @property
    def saved(self) -> int:
        """Messages in the copy."""
        return sum(stream.saved for stream in self.streams) + sum(part.saved for part in self.parts)

    @property
    def lost(self) -> int:
        """Messages that are known to be missing."""
        own = sum(stream.lost for stream in self.streams) + self.lost_elsewhere
        return own + sum(part.lost for part in self.parts)

    def content(self) -> dict[str, Any]:
        """As ``recovery.json`` and ``--json`` have it."""
        return {
            "format": FORMAT,
            "source": str(self.source),
            "copy": str(self.copy) if self.copy is not None else None,
            "form": self.form,
            "whole": self.whole,
            "saved": self.saved,
            "lost": self.lost,
            "lost_elsewhere": self.lost_elsewhere,
            "bytes_lost": self.bytes_lost,
            "streams": [asdict(stream) for stream in self.streams],
            "notes": list(self.notes),
            "parts": [part.content() for part in self.parts],
            "failed": [{"file": file, "why": why} for file, why in self.failed],
        }


class Noted(Losses):
    """Losses that also count the places: a stream then knows that there was one since its last message."""

    def __init__(self) -> None:
        super().__init__()
        self.n_notes = 0

    def note(self, place: str, lost: int = 0, size: int = 0) -> None:
        """Something is lost."""
        super().note(place, lost, size)
        self.n_notes += 1


@dataclass
class _Count:
    type: str
    saved: int = 0
    first: int | None = None
    last: int | None = None
    before: int = 0
    mark: int = 0
    intervals: list[int] = field(default_factory=list)
    gaps: list[int] = field(default_factory=list)

    def usual(self) -> float:
        """ns from one message to the next; NaN where that is not known."""
        steps = [step for step in self.intervals if step > 0]
        return float(np.median(steps)) if len(steps) > 2 else math.nan


class Tally:
    """Counts the messages of each stream, and how much time is missing where the file is damaged."""

    def __init__(self) -> None:
        self._counts: dict[str, _Count] = {}

    def name(self, name: str, kind: str) -> None:
        """There is such a stream."""
        self._counts.setdefault(name, _Count(kind))

    def add(self, name: str, kind: str, stamp_ns: int, mark: int = 0) -> None:
        """Count a message.

        Parameters
        ----------
        name, kind : str
            Of its stream.
        stamp_ns : int
            Its time.
        mark : int
            How many damaged places were met so far: a new one lies between this message and the last one.
        """
        count = self._counts.get(name)
        if count is None:
            count = self._counts[name] = _Count(kind, mark=0)
        if count.saved:
            step = stamp_ns - count.before
            if mark != count.mark:
                count.gaps.append(step)
            elif len(count.intervals) < _INTERVALS:
                count.intervals.append(step)
        count.first = stamp_ns if count.first is None else min(count.first, stamp_ns)
        count.last = stamp_ns if count.last is None else max(count.last, stamp_ns)
        count.before, count.mark = stamp_ns, mark
        count.saved += 1

    def streams(self, said: Mapping[str, int] | None = None) -> tuple[SavedStream, ...]:
        """All streams; `said`: how many messages of each there were, where something sound tells it."""
        out = []
        for name, count in self._counts.items():
            usual = count.usual()
            exact = said is not None and name in said
            lost, seconds = 0, 0.0
            if exact and said is not None:
                lost = max(said[name] - count.saved, 0)
                seconds = lost * usual / 1e9 if usual > 0 else 0.0
            elif usual > 0:
                steps = [max(round(gap / usual) - 1, 0) for gap in count.gaps]
                lost, seconds = sum(steps), sum(steps) * usual / 1e9
            length = (
                (count.last - count.first) / 1e9 if count.last is not None and count.first is not None else 0
            )
            out.append(
                SavedStream(
                    name,
                    count.type,
                    count.saved,
                    float(length),
                    count.first,
                    count.last,
                    lost,
                    seconds,
                    exact,
                )
            )
        return tuple(out)


def merged(parts: Iterable[SavedStream]) -> tuple[SavedStream, ...]:
    """Streams of several files, those of one name as one."""
    by_name: dict[str, list[SavedStream]] = {}
    for part in parts:
        by_name.setdefault(part.name, []).append(part)
    return tuple(_sum(same) for same in by_name.values())


def _sum(same: list[SavedStream]) -> SavedStream:
    firsts = [s.first_ns for s in same if s.first_ns is not None]
    lasts = [s.last_ns for s in same if s.last_ns is not None]
    return SavedStream(
        same[0].name,
        next((s.type for s in same if s.type), ""),
        sum(s.saved for s in same),
        (max(lasts) - min(firsts)) / 1e9 if firsts and lasts else 0.0,
        min(firsts, default=None),
        max(lasts, default=None),
        sum(s.lost for s in same),
        sum(s.lost_seconds for s in same),
        all(s.exact for s in same),
    )


def elsewhere(losses: Losses, streams: Iterable[SavedStream]) -> int:
    """Messages that a walk knows to be missing and no stream counts."""
    return max(losses.damage().n_lost - sum(stream.lost for stream in streams), 0)
