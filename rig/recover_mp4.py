"""Rescue of an MP4 without its index (``moov``): its H.264 frames, found by their own bytes.

The index is written last, so a camera that loses its power leaves none. The pictures lie in ``mdat``, one
after the other, as NAL units, each after its length (ISO/IEC 14496-15, section 5.3.3). A new picture begins
with the slice whose first macroblock is number 0 (ITU-T H.264, section 7.4.3). How they were encoded (the
parameter sets) is in the index too: it is taken from a sound video of the same camera, or from the stream
where the encoder repeats it. Times of frames are lost: they are made from the rate.
"""

from __future__ import annotations

import io
import mmap
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from acino_fte.data_tools.video import load_av
from acino_fte.errors import InputError
from acino_fte.rig.recover_types import Salvaged, SavedStream

_SLICE, _KEY, _SEI, _SPS, _PPS, _MARK = 1, 5, 6, 7, 8, 9
_KNOWN = (_SLICE, _KEY, _SEI, _SPS, _PPS, _MARK, 12)
_CODE = b"\0\0\0\1"
_MOST = 1 << 25  # of one NAL unit
_CHAIN = 3  # units in a row that tell a place in the stream
_TRIED = 5  # sound videos beside the damaged one
_CHECKED = 40  # first frames that a parameter set must decode
_REMEDY = (
    "give a sound video of the same camera, recorded with the same settings: --like GOOD.mp4 "
    "(a few seconds of a new recording do)"
)


@dataclass(frozen=True)
class _Parameters:
    """How the pictures are encoded (parameter sets, each after a start code), their rate, and who says so."""

    sets: bytes
    rate: Fraction | None
    origin: str


@dataclass
class _Frame:
    """One picture: places of its NAL units in the file."""

    parts: list[tuple[int, int]]
    key: bool = False


def salvage_mp4(source: Path, target: Path, like: Path | None = None, fps: float | None = None) -> Salvaged:
    """Rebuild an MP4 from its pictures alone.

    Parameters
    ----------
    source : Path
        An MP4 without its index, with pictures in H.264.
    target : Path
        The new MP4.
    like : Path, optional
        A sound video of the same camera; without it those beside `source` are tried.
    fps : float, optional
        Frames per second; without it that of the sound video, or 30.

    Raises
    ------
    InputError
        It cannot be done: the message says what is missing.
    """
    if source.stat().st_size < 16:
        raise InputError("Nothing can be saved.", file=source, found=f"{source.stat().st_size} bytes")
    with source.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        lost: list[int] = []
        frames, sets = _frames(data, lost)
        if not frames:
            raise InputError(
                "The MP4 has no index, and its pictures cannot be found without one.",
                file=source,
                expected="pictures in H.264",
                found="none: another codec, or nothing was written",
                remedy="only H.264 can be rebuilt; HEVC, MJPEG and others need a tool that knows the camera",
            )
        skipped = next((i for i, frame in enumerate(frames) if frame.key), len(frames))
        parameters = _parameters(source, like, data, frames[skipped:], sets)
        rate, said = _rate(fps, parameters)
        kept = frames[skipped:]
        written = _write(data, kept, parameters, rate, target)
    notes = [
        "The index of the MP4 is missing: its pictures were found one by one.",
        f"How they are encoded was taken from {parameters.origin}.",
        said,
    ]
    return _account(written, skipped, lost, rate, notes)


def _account(written: int, skipped: int, lost: list[int], rate: Fraction, notes: list[str]) -> Salvaged:
    """What was saved, at this rate; pictures without the key frame before them are lost."""
    if skipped:
        notes.append(f"{skipped} pictures before the first key frame cannot be shown and were left out.")
    if lost:
        notes.append(f"{sum(lost)} bytes in {len(lost)} places are no pictures (sound, or damage).")
    seconds = (written - 1) / float(rate)
    end = round(seconds * 1e9)
    stream = SavedStream("video0", "h264", written, seconds, 0, end, skipped, skipped / float(rate), True)
    return Salvaged("MP4 video without its index", False, (stream,), 0, sum(lost), tuple(notes))


# The stream ----------------------------------------------------------------------------------------------


def _start(data: mmap.mmap) -> int:
    """Where the pictures begin: behind the head of ``mdat``; the start of the file where none is found."""
    at = 0
    while at + 16 <= len(data):
        size, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        if kind == b"mdat":
            return at + (16 if size == 1 else 8)
        if size < 8 or not kind.isalnum():
            break
        at += size
    found = data.find(b"mdat", 0, 1 << 20)
    return found + 4 if found >= 0 else 0


def _unit(data: mmap.mmap, at: int) -> int:
    """Bytes of the NAL unit whose length stands here; 0 where there is none."""
    if at + 6 > len(data):
        return 0
    size = int.from_bytes(data[at : at + 4], "big")
    head = data[at + 4]
    kind, priority = head & 31, head >> 5
    if head & 128 or kind not in _KNOWN or not 2 <= size <= _MOST:
        return 0
    if (kind in (_KEY, _SPS, _PPS)) != bool(priority) and kind != _SLICE:
        return 0
    return 4 + size


def _chained(data: mmap.mmap, at: int) -> bool:
    for _ in range(_CHAIN):
        size = _unit(data, at)
        if not size or at + size > len(data):
            return False
        at += size
        if at == len(data):
            return True
    return True


def _units(data: mmap.mmap, lost: list[int]) -> Iterator[tuple[int, int]]:
    """(place, bytes) of all whole NAL units, without their lengths; bytes between them go to `lost`."""
    at = _start(data)
    while at < len(data):
        size = _unit(data, at)
        if size and at + size <= len(data):
            yield at + 4, size - 4
            at += size
            continue
        begin, at = at, _next(data, at + 1)
        lost.append(at - begin)


def _next(data: mmap.mmap, at: int) -> int:
    """The next place where units follow one another; the end of the file without one."""
    while (found := data.find(b"\0", at)) >= 0:  # the length of a unit begins with a zero byte
        if _chained(data, found):
            return found
        at = found + 1
    return len(data)


def _frames(data: mmap.mmap, lost: list[int]) -> tuple[list[_Frame], dict[int, bytes]]:
    """Pictures in the order of the file; and the first parameter sets of each kind in the stream."""
    frames, sets, waiting = list[_Frame](), dict[int, bytes](), list[tuple[int, int]]()
    for at, size in _units(data, lost):
        kind = data[at] & 31
        if kind in (_SPS, _PPS):
            sets.setdefault(kind, data[at : at + size])
        if kind not in (_SLICE, _KEY):
            waiting.append((at, size))
            continue
        if data[at + 1] & 128 or not frames:  # first_mb_in_slice is 0
            frames.append(_Frame(waiting, kind == _KEY))
            waiting = []
        frames[-1].parts += [*waiting, (at, size)]
        waiting = []
    if lost and len(frames) > 1 and _slices(data, frames[-1]) < _slices(data, frames[-2]):
        frames.pop()  # the file ends between the slices of a picture
    return frames, sets


def _slices(data: mmap.mmap, frame: _Frame) -> int:
    return sum(data[at] & 31 in (_SLICE, _KEY) for at, _ in frame.parts)


def _bytes(data: mmap.mmap, frame: _Frame) -> bytes:
    """The picture as a stream of bytes: each NAL unit after a start code (H.264, annex B)."""
    return b"".join(_CODE + data[at : at + size] for at, size in frame.parts)


# How they are encoded ------------------------------------------------------------------------------------


def _parameters(
    source: Path, like: Path | None, data: mmap.mmap, frames: list[_Frame], sets: dict[int, bytes]
) -> _Parameters:
    """The first parameters by which the pictures decode: of the stream, of `like`, of videos beside."""
    if not frames:
        raise InputError("The MP4 has no index and no key frame: nothing of it can be shown.", file=source)
    reference = _of_video(like) if like is not None else None
    if like is not None and reference is None:
        raise InputError(
            "The sound video cannot be used.",
            file=like,
            expected="a video in H.264 that opens",
            remedy=_REMEDY,
        )
    rate = reference.rate if reference is not None else None
    tried = [reference] if reference is not None else []
    if _SPS in sets and _PPS in sets:
        tried.append(_Parameters(_CODE + sets[_SPS] + _CODE + sets[_PPS], rate, "the stream itself"))
    if reference is None:
        tried += _beside(source)
    for parameters in tried:
        if _decodes(data, frames, parameters):
            return parameters
    raise InputError(
        "The MP4 has no index, and how its pictures are encoded is not known.",
        file=source,
        found=f"{len(frames)} pictures in H.264, which "
        + (
            "the parameters of the sound video do not decode"
            if like is not None
            else "no video beside it decodes"
        ),
        remedy=_REMEDY,
    )


def _beside(source: Path) -> list[_Parameters]:
    """Parameters of sound videos in the same folder."""
    out: list[_Parameters] = []
    for path in sorted(source.parent.glob("*")):
        if path.suffix.lower() in (".mp4", ".mov", ".m4v") and path != source and path.is_file():
            found = _of_video(path)
            if found is not None:
                out.append(found)
        if len(out) >= _TRIED:
            break
    return out


def _of_video(path: Path) -> _Parameters | None:
    av = load_av()
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            extradata = bytes(stream.codec_context.extradata or b"")
            if stream.codec_context.name != "h264" or extradata[:1] != b"\x01":
                return None
            return _Parameters(_sets(extradata), stream.average_rate or stream.guessed_rate, path.name)
    except (av.error.FFmpegError, ValueError, OSError, IndexError):
        return None


def _sets(extradata: bytes) -> bytes:
    """Parameter sets, each after a start code, of a codec's private data (ISO/IEC 14496-15, 5.3.3.1)."""
    out, at = b"", 5
    for mask in (31, 255):
        count = extradata[at] & mask
        at += 1
        for _ in range(count):
            size = int.from_bytes(extradata[at : at + 2], "big")
            out += _CODE + extradata[at + 2 : at + 2 + size]
            at += 2 + size
    return out


def _decoder(parameters: _Parameters) -> Any:
    codec = load_av().CodecContext.create("h264", "r")
    codec.extradata = parameters.sets
    return codec


def _decodes(data: mmap.mmap, frames: list[_Frame], parameters: _Parameters) -> bool:
    """Whether the first pictures decode."""
    av, codec, n = load_av(), _decoder(parameters), min(len(frames), _CHECKED)
    good = 0
    try:
        for frame in frames[:n]:
            good += sum(not f.is_corrupt for f in codec.decode(av.Packet(_bytes(data, frame))))
        good += sum(not f.is_corrupt for f in codec.decode(None))
    except (av.error.FFmpegError, ValueError):
        pass
    return good >= max(1, n // 2)


def _rate(fps: float | None, parameters: _Parameters) -> tuple[Fraction, str]:
    if fps is not None:
        return Fraction(fps).limit_denominator(
            1_000_000
        ), f"Times of the frames: {fps:g} a second, as was said."
    if parameters.rate:
        rate = Fraction(parameters.rate)
        return rate, f"Times of the frames are lost; they are {float(rate):.4g} a second, as in that video."
    return Fraction(30), "Times of the frames are lost; 30 a second was assumed: --fps says what it was."


# The copy ------------------------------------------------------------------------------------------------


def _shown(data: mmap.mmap, frames: list[_Frame], parameters: _Parameters) -> list[int] | None:
    """The place of every picture in the order they are shown; None where it is the order of the file.

    The decoder tells: it hands out pictures in that order, with the number they came in with.
    """
    av, codec = load_av(), _decoder(parameters)
    order: list[int] = []
    for number, frame in enumerate(frames):
        packet = av.Packet(_bytes(data, frame))
        packet.pts = packet.dts = number
        try:
            order += [f.pts for f in codec.decode(packet) if f.pts is not None]
        except (av.error.FFmpegError, ValueError):
            continue
        if number == _CHECKED and not codec.has_b_frames:
            return None
    with suppress(av.error.FFmpegError, ValueError):
        order += [f.pts for f in codec.decode(None) if f.pts is not None]
    if order == sorted(order):
        return None
    missing = sorted(set(range(len(frames))) - set(order))
    places = [0] * len(frames)
    for place, number in enumerate([*order, *missing]):
        places[number] = place
    return places


def _write(
    data: mmap.mmap, frames: list[_Frame], parameters: _Parameters, rate: Fraction, target: Path
) -> int:
    """Put the pictures into a new MP4, at the rate; returns how many."""
    av, places = load_av(), _shown(data, frames, parameters)
    late = max((n - place for n, place in enumerate(places)), default=0) if places else 0
    start = io.BytesIO(parameters.sets + _bytes(data, frames[0]))
    with av.open(start, format="h264") as raw, av.open(str(target), "w", format="mp4") as out:
        stream = out.add_stream_from_template(raw.streams.video[0])
        stream.time_base = 1 / rate
        for number, frame in enumerate(frames):
            packet = av.Packet(_bytes(data, frame))
            packet.stream = stream
            packet.time_base = 1 / rate
            packet.dts = number - late
            packet.pts = places[number] if places else number
            packet.is_keyframe = frame.key
            out.mux_one(packet)
    return len(frames)
