"""Recordings of any kind: what a file is, is told by its content."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from acino_fte.data_tools.bags import BagReader, bag_kind
from acino_fte.data_tools.recording import RecordingReader
from acino_fte.data_tools.rig_reader import is_rig_folder
from acino_fte.errors import InputError, did_you_mean

_EXPECTED = (
    "LVX or LVX2, a ROS 1 bag, a ROS 2 bag (folder, .db3, .mcap), eCAL's .hdf5, a video or the folder of the "
    "rig's recorder"
)
_SUFFIXES = (".lvx", ".lvx2", ".bag", ".db3", ".mcap", ".mp4", ".mkv", ".avi", ".mov")
_LVX = b"livox_tech"
_LVX_NUMBER = bytes.fromhex("67a70eac")
_SEARCH = 4 << 20  # bytes in which frames without a head have to begin
RecordingKind = Literal["lvx", "bag", "video", "rig"]


def open_recording(path: Path | str) -> RecordingReader:
    """Open a recording: LVX 1.0, 1.1 and LVX2, bags of ROS 1 and ROS 2, videos, the recorder's folders.

    Parameters
    ----------
    path : Path
        A file, or the folder of a ROS 2 bag or of the recorder. Its content tells what it is, not its name.

    Returns
    -------
    RecordingReader

    Raises
    ------
    InputError
        There is no such file, or it is none of these.
    """
    path = Path(path)
    kind = recording_kind(path)
    if kind == "lvx":
        from acino_fte.data_tools.lvx import LvxReader

        return LvxReader(path)
    if kind == "bag":
        return BagReader(path)
    if kind == "rig":
        from acino_fte.data_tools.rig_reader import RigReader

        return RigReader(path)
    from acino_fte.data_tools.video import VideoReader

    return VideoReader(path)


def recording_kind(path: Path | str) -> RecordingKind:
    """What a recording is.

    Raises
    ------
    InputError
        It is none that can be read.
    """
    path = Path(path)
    try:
        return _kind(path)
    except OSError as error:
        raise InputError(
            "The recording cannot be opened.",
            file=path,
            expected=_EXPECTED,
            found=error.strerror or str(error),
            remedy="check that you may read it",
        ) from error


def _kind(path: Path) -> RecordingKind:
    """What a recording is; an OSError where it cannot be read."""
    if path.is_dir():
        return _folder_kind(path)
    if not path.is_file():
        raise InputError(
            "There is no such recording.", file=path, expected=_EXPECTED, found="nothing", remedy=_near(path)
        )
    with path.open("rb") as file:
        head = file.read(4096)
    if not head:
        raise InputError(
            "The recording is empty.",
            file=path,
            expected=_EXPECTED,
            found="0 bytes",
            remedy="copy it again: the recorder wrote nothing, or the copy failed",
        )
    if head.startswith(_LVX) or head[16:24].endswith(_LVX_NUMBER) or path.suffix.lower() in (".lvx", ".lvx2"):
        return "lvx"
    if bag_kind(path) is not None:
        return "bag"
    if is_video(head):
        return "video"
    if _known(head) is None and _has_frames(path):
        return "lvx"
    raise InputError(
        "The file is no recording that can be read.",
        file=path,
        expected=_EXPECTED,
        found=_known(head) or f"unknown bytes: {head[:8].hex(' ')}",
        remedy=_near(path),
    )


def _folder_kind(path: Path) -> RecordingKind:
    names = sorted(f.name for f in path.iterdir())
    if is_rig_folder(path):
        return "rig"
    if "metadata.yaml" in names or any(
        n.endswith((".db3", ".mcap", ".db3.zstd", ".mcap.zstd")) for n in names
    ):
        return "bag"
    inside = [n for n in names if n.lower().endswith(_SUFFIXES)]
    raise InputError(
        "The folder is no recording." if names else "The folder is empty.",
        file=path,
        expected="the folder of a ROS 2 bag or of the rig's recorder, or a file",
        found=", ".join(names[:5]) + (", …" if len(names) > 5 else "") if names else "an empty folder",
        remedy=f"name the recording itself: {inside[0]}" if inside else None,
    )


def is_video(head: bytes) -> bool:
    """Whether the first bytes are those of a container of videos."""
    return (
        head[4:8] in (b"ftyp", b"styp", b"moov", b"mdat", b"wide", b"free", b"skip")
        or head.startswith((b"\x1a\x45\xdf\xa3", b"OggS", b"FLV", b"\x00\x00\x01\xba", b"\x00\x00\x01\xb3"))
        or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")
        or head.startswith(b"\x30\x26\xb2\x75\x8e\x66\xcf\x11")  # ASF, WMV
        or (len(head) > 376 and head[0] == head[188] == head[376] == 0x47)  # transport stream
        or (len(head) > 388 and head[4] == head[196] == head[388] == 0x47)  # of AVCHD
    )


def _has_frames(path: Path) -> bool:
    """Whether frames of a lidar follow in a file whose head is lost."""
    from acino_fte.data_tools.lvx_head import open_binary, read_head

    with open_binary(path) as file:
        try:
            read_head(file, path, _SEARCH)
        except InputError:
            return False
    return True


def _known(head: bytes) -> str | None:
    """What some first bytes are that are surely no recording, in words; None of others."""
    for start, name in (
        (b"\x89PNG", "a PNG image"),
        (b"\xff\xd8\xff", "a JPEG image"),
        (b"PK\x03\x04", "a ZIP archive"),
        (b"\x1f\x8b", "a gzip archive"),
        (b"ply", "a PLY point cloud"),
        (b"# .PCD", "a PCD point cloud"),
        (b"%PDF", "a PDF"),
    ):
        if head.startswith(start):
            return name
    if not head.strip(b"\0"):
        return "nothing but zeros: the recorder did not finish, or the disk lost it"
    if b"\0" not in head:
        try:
            text = head.decode("utf-8", "strict" if len(head) < 4096 else "ignore")
            return f"text: {text.split(chr(10))[0][:40]!r}"
        except UnicodeDecodeError:
            pass
    return None


def _near(path: Path) -> str | None:
    """A recording of a similar name beside it."""
    if not path.parent.is_dir():
        return f"the folder {path.parent} is not there either"
    others = [f.name for f in path.parent.iterdir() if f.suffix.lower() in _SUFFIXES and f.name != path.name]
    near = did_you_mean(path.name, others)
    return near.lstrip("; ") or None
