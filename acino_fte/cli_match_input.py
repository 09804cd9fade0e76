"""From the options of ``acino-fte match`` to a recording of 2D tracks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from acino_fte.data_tools.load_tracks import load_tracks
from acino_fte.data_tools.tracks2d import TrackRecording
from acino_fte.errors import InputError

_SIZE = "--resolution WIDTHxHEIGHT"
_FLAGS = (
    ("read_dlt(path, resolution=(width, height)), px, or profile=the camera profile of Argus", _SIZE),
    ("resolution=(width, height)", _SIZE),
    ("tracks={CAMERA: FILE}", "--tracks CAMERA=FILE"),
    ("tracks=FILES", "--tracks FILE for each"),
    ("tracks=FILE", "--tracks FILE"),
    ("cameras=FILE", "--cameras FILE"),
    ("cm_per_pixel", "--cm-per-pixel"),
)
"""What the readers call their arguments, and what the command does."""


@dataclass(frozen=True)
class TrackInput:
    """What the user said of the recording; as the arguments of :func:`load_tracks`, unread."""

    cameras: Path | None
    tracks: list[str]
    truth: Path | None
    fps: float | None
    resolution: str | None
    camera_unit: str
    node: str | None
    cm_per_pixel: float | None


def read_recording(folder: Path, given: TrackInput) -> TrackRecording:
    """The recording of a folder; errors name the options of the command."""
    try:
        return load_tracks(
            folder,
            cameras=given.cameras,
            tracks=_tracks(given.tracks),
            fps=given.fps,
            truth_3d=given.truth,
            resolution=_resolution(given.resolution),
            camera_unit=given.camera_unit,
            node=given.node,
            cm_per_pixel=given.cm_per_pixel,
        )
    except InputError as error:
        raise _in_flags(error) from None


def _in_flags(error: InputError) -> InputError:
    """The error with the command's options in its remedy."""
    remedy = error.remedy
    for argument, flag in _FLAGS:
        remedy = remedy and remedy.replace(argument, flag)
    return InputError(
        error.problem,
        file=error.file,
        key=error.key,
        expected=error.expected,
        found=error.found,
        remedy=remedy,
    )


def _tracks(given: list[str]) -> list[Path | str] | dict[str, Path | str] | None:
    """Files of tracks, or camera → file."""
    if not given:
        return None
    named = ["=" in text and not Path(text).exists() for text in given]
    if not any(named):
        return [Path(text) for text in given]
    if not all(named):
        raise InputError(
            "Some files of tracks have the name of their camera and some have not.",
            key="--tracks",
            expected="CAMERA=FILE for all, or FILE for all",
            found=", ".join(given),
        )
    pairs = [text.split("=", 1) for text in given]
    names = [name for name, _ in pairs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError("A camera is given two files of tracks.", key="--tracks", found=", ".join(twice))
    return {name: Path(path) for name, path in pairs}


def _resolution(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) == 2 and all(part.strip().isdigit() and int(part) > 0 for part in parts):
        return int(parts[0]), int(parts[1])
    raise InputError(
        "The size of the images cannot be read.",
        key="--resolution",
        expected="WIDTHxHEIGHT in px, such as 1920x1080",
        found=text,
    )
