"""Rescue of videos: what FFmpeg can still walk through is copied, undecoded, into a file that was closed.

An MP4 without its index goes to :mod:`recover_mp4`.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

from acino_fte.data_tools.video import load_av
from acino_fte.data_tools.video_cut import is_cut
from acino_fte.errors import InputError
from acino_fte.rig.recover_types import Salvaged, SavedStream

FRAGMENTS = "frag_keyframe+empty_moov+default_base_moof"
_FORMS = {"matroska,webm": "matroska", "mov,mp4,m4a,3gp,3g2,mj2": "mp4"}
_WORDS = {"matroska": "Matroska video", "mp4": "MP4 video", "avi": "AVI video", "mpegts": "MPEG-TS video"}
_MOST_PROBLEMS = 20


class NoIndex(Exception):
    """FFmpeg finds no way into the file."""


def salvage_video(source: Path, target: Path | None) -> Salvaged:
    """Copy every whole frame of a video that FFmpeg opens, with its time.

    Parameters
    ----------
    source : Path
        The video; only read.
    target : Path, optional
        The new file, in the same container; without it the frames are only counted.

    Raises
    ------
    NoIndex
        FFmpeg does not open the file.
    """
    av = load_av()
    with source.open("rb") as file:
        try:
            container = av.open(_Part(file, _end(file)))
        except (av.error.FFmpegError, ValueError) as error:
            raise NoIndex(str(error)) from error
        return _salvaged(av, container, source, target)


class _Part:
    """The first bytes of a file, as a file: FFmpeg opens no MP4 that ends in a head of pictures."""

    def __init__(self, file: BinaryIO, end: int) -> None:
        self._file, self._end = file, end
        file.seek(0)

    def read(self, n: int = -1) -> bytes:
        """The next bytes, up to the end of the part."""
        left = max(self._end - self._file.tell(), 0)
        return self._file.read(left if n < 0 else min(n, left))

    def seek(self, at: int, whence: int = 0) -> int:
        """Go to a place."""
        return self._file.seek(self._end + at, 0) if whence == 2 else self._file.seek(at, whence)

    def tell(self) -> int:
        """The place."""
        return self._file.tell()


def _end(file: BinaryIO) -> int:
    """Where the last whole part of an MP4 ends, or its pictures, whole or not; the end of other files."""
    size, at = file.seek(0, 2), 0
    while at < size:
        file.seek(at)
        head = file.read(16)
        kind, length = head[4:8], int.from_bytes(head[:4], "big")
        length = int.from_bytes(head[8:], "big") if length == 1 else length
        if not at and kind not in (b"ftyp", b"styp", b"moov", b"mdat", b"wide", b"free", b"skip"):
            return size
        if length == 0 or (at + length > size and kind == b"mdat"):
            return size
        if length < 8 or at + length > size:
            return at or size
        at += length
    return size


def _salvaged(av: Any, container: Any, source: Path, target: Path | None) -> Salvaged:
    with container:
        if not container.streams.video or container.streams.video[0].codec_context is None:
            raise NoIndex("its head tells of no pictures")
        form = _FORMS.get(container.format.name, container.format.name.split(",")[0])
        notes, damaged = _state(container, source, form)
        if target is None:
            count = _copied(av, container, None, notes)
        else:
            count = _remuxed(av, container, target, form, notes)
        stream = container.streams.video[0]
        streams = (_stream(stream, count),)
        problems = damaged or count.problems or any(s.lost for s in streams)
    return Salvaged(
        _WORDS.get(form, f"{form} video"), not problems, streams, 0, count.bytes_lost, tuple(notes)
    )


def _state(container: Any, source: Path, form: str) -> tuple[list[str], bool]:
    """Notes on a file that was cut or not closed, and whether it was."""
    if is_cut(source):
        return ["The file is cut: it ends before its own structure says."], True
    if form == "matroska" and not container.duration:
        return ["The file was not closed: its length is missing."], True
    return [], False


class _Count:
    """Frames of the video stream on their way."""

    def __init__(self) -> None:
        self.n = self.bytes_lost = self.problems = 0
        self.first: int | None = None
        self.last: int | None = None

    def add(self, stamp: int | None) -> None:
        """Count a frame of this time."""
        if stamp is not None:
            self.first = stamp if self.first is None else min(self.first, stamp)
            self.last = stamp if self.last is None else max(self.last, stamp)
        self.n += 1

    def problem(self, note: str, packet: Any, notes: list[str]) -> None:
        """A frame is lost."""
        self.problems += 1
        self.bytes_lost += packet.size
        if self.problems <= _MOST_PROBLEMS:
            notes.append(note)


def _copied(av: Any, container: Any, out: Any, notes: list[str]) -> _Count:
    """Walk through all packets; hand over the whole ones to `out`, a call."""
    count, video = _Count(), container.streams.video[0]
    packets = container.demux()
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return count
        except (av.error.FFmpegError, ValueError) as error:
            count.problems += 1
            notes.append(f"After frame {count.n - 1} the file cannot be read further ({error}).")
            return count
        if packet.size == 0:
            continue
        if packet.is_corrupt:
            count.problem(
                f"After frame {count.n - 1} a frame of {packet.size} bytes is not whole.", packet, notes
            )
            continue
        pictures = packet.stream.index == video.index
        stamp = packet.pts if packet.pts is not None else packet.dts
        try:
            if out is not None:
                out(packet)
        except av.error.FFmpegError as error:
            if isinstance(error, OSError):  # of the disk
                raise
            count.problem(
                f"After frame {count.n - 1} a frame does not fit the others ({error}).", packet, notes
            )
            continue
        if pictures:
            count.add(stamp)


def _remuxed(av: Any, container: Any, target: Path, form: str, notes: list[str]) -> _Count:
    """Copy the packets of all streams into a new file."""
    base = container.streams.video[0].time_base
    options: dict[str, str] = {}
    if form == "mp4" and base is not None and base.numerator == 1:
        options["video_track_timescale"] = str(base.denominator)
    try:
        with av.open(str(target), "w", format=form, options=options) as out:
            streams = {}
            for stream in container.streams:
                if stream.type in ("video", "audio"):
                    streams[stream.index] = _like(out, stream, form)
                    streams[stream.index].time_base = stream.time_base

            def write(packet: Any) -> None:
                if packet.stream.index in streams:
                    packet.stream = streams[packet.stream.index]
                    out.mux_one(packet)

            return _copied(av, container, write, notes)
    except (av.error.FFmpegError, ValueError) as error:
        raise InputError("The copy of the video cannot be written.", file=target, found=str(error)) from error


def _like(out: Any, stream: Any, form: str) -> Any:
    """A stream of the new file for the packets of one of the old file."""
    codec = stream.codec_context
    if form != "matroska" or codec.name != "rawvideo":
        return out.add_stream_from_template(stream)
    like = out.add_stream("rawvideo", rate=stream.average_rate or stream.guessed_rate or 30)
    like.width, like.height, like.pix_fmt = codec.width, codec.height, codec.pix_fmt  # no template tells it
    return like


def _stream(stream: Any, count: _Count) -> SavedStream:
    base = stream.time_base or Fraction(1, 1000)
    first, last = (round(t * base * 10**9) if t is not None else None for t in (count.first, count.last))
    seconds = (last - first) / 1e9 if first is not None and last is not None else 0.0
    lost = max((stream.frames or 0) - count.n, 0)
    rate = float(stream.average_rate or stream.guessed_rate or 0)
    return SavedStream(
        "video0",
        stream.codec_context.name,
        count.n,
        seconds,
        first,
        last,
        lost,
        lost / rate if rate else 0.0,
        bool(stream.frames),
    )
