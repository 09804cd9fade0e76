"""Whether a video file ends before its own structure says: FFmpeg reads such files without a word."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO


def is_cut(path: Path | str) -> bool:
    """Whether the outermost parts of an MP4, Matroska or AVI file reach beyond its end; False for others."""
    path = Path(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        if head[:4] == b"\x1a\x45\xdf\xa3":
            return _matroska_end(file) > size
        if head[:4] == b"RIFF":
            return _avi_end(file, size) > size
        if head[4:8] in (b"ftyp", b"styp", b"moov", b"mdat", b"wide", b"free"):
            return _mp4_end(file, size) > size
    return False


def _mp4_end(file: BinaryIO, size: int) -> int:
    """End of the last box: size u32 big-endian, four letters; size 1: 64 bits follow; 0: up to the end."""
    at = 0
    while at < size:
        file.seek(at)
        head = file.read(16).ljust(16, b"\0")
        length = int.from_bytes(head[:4], "big")
        length = int.from_bytes(head[8:], "big") if length == 1 else length
        if length < 8:
            return size
        at += length
    return at


def _matroska_end(file: BinaryIO) -> int:
    """End of the segment; -1 where its size is not known, as in a stream."""
    at = 0
    for _ in range(2):  # the head of EBML, then the segment
        file.seek(at)
        head = file.read(12)
        if len(head) < 5:
            return at + 12
        width = 9 - head[4].bit_length()  # of the size: its leading zeros tell
        value = int.from_bytes(head[4 : 4 + width], "big") & ((1 << 7 * width) - 1)
        if value == (1 << 7 * width) - 1:
            return -1
        at += 4 + width + value
    return at


def _avi_end(file: BinaryIO, size: int) -> int:
    """End of the last RIFF chunk: four letters, size u32 little-endian, padded to even."""
    at = 0
    while at < size:
        file.seek(at)
        head = file.read(8).ljust(8, b"\0")
        length = int.from_bytes(head[4:], "little")
        if head[:4] != b"RIFF" or not length:  # bytes after the last chunk are of no concern
            return size
        at += 8 + length + length % 2
    return at
