"""The folder that the rig's recorder writes: its manifest, its segments and its events.

::

    NAME/
      manifest.json          this module; written whole, and to the disk, whenever something begins or ends
      rig.yaml               the rig as it was
      messages-0000.mcap     lidar, inertial sensor, camera driver (ROS 2 messages), one file a segment
      cam1-0000.mkv          video of the same segment

Topics are ``/lidar1/points``, ``/lidar1/imu``, ``/cam1/info``. Frame k of a segment's video is message k of
that camera's info in the same segment, and its time in the video is that message's log time since the start.
A message has three stamps: in it the device's; as log time when it was received, by the computer's
*monotonic* clock (start on the wall clock + monotonic time since then: it never jumps); as publish time the
same moment by the *wall* clock, which may jump.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError

FORMAT = "acino-fte/rig-recording/1"
MANIFEST = "manifest.json"
State = Literal["recording", "closed", "recovered"]
EventKind = Literal[
    "started",
    "stopped",
    "stall",  # a sensor was silent: start, length
    "unplugged",  # a device was gone
    "dropped",  # images or messages the recorder itself could not keep up with, counted
    "lost",  # numbers that never came from the device, counted
    "clock_jump",  # the wall clock jumped: seconds is by how much, signed
    "disk_full",  # the reserve was reached: clean stop
    "lens_moved",  # zoom or focus left the tolerance: the calibration is no longer valid
    "lens_back",  # and came back
    "error",
]


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes
    ----------
    kind : str
    time_ns : int
        When it began, ns since 1970 by the monotonic clock (log time).
    stream : str
        The topic, or the camera; empty for the whole rig.
    seconds : float
        How long it took, or by how much a clock jumped.
    count : int
        Of images or messages.
    detail : str
        One sentence.
    """

    kind: EventKind
    time_ns: int
    stream: str = ""
    seconds: float = 0.0
    count: int = 0
    detail: str = ""


@dataclass(frozen=True)
class Segment:
    """One file of a recording.

    Attributes
    ----------
    file : str
        Name in the folder.
    kind : {"messages", "video"}
    index : int
        Of the segment, from 0.
    closed : bool
    first_ns, last_ns : int, optional
        Log times of what it holds.
    counts : dict
        Messages by topic, or frames by camera.
    n_bytes : int
        When it was closed.
    """

    file: str
    kind: Literal["messages", "video"]
    index: int
    closed: bool = False
    first_ns: int | None = None
    last_ns: int | None = None
    counts: dict[str, int] = field(default_factory=dict)
    n_bytes: int = 0


@dataclass(frozen=True)
class RecordedStream:
    """One stream: what was expected, what came, what was written. `name` is the topic, or the camera."""

    name: str
    kind: Literal["lidar", "imu", "image", "image_info"]
    expected_hz: float
    received: int = 0
    written: int = 0
    dropped: int = 0


@dataclass(frozen=True)
class Manifest:
    """What ``manifest.json`` holds. Times are ns since 1970; `started_monotonic_ns` is the computer's own."""

    name: str
    state: State
    started_ns: int
    started_monotonic_ns: int
    ended_ns: int | None = None
    host: str = ""
    program: str = ""
    simulated: bool = False
    streams: tuple[RecordedStream, ...] = ()
    segments: tuple[Segment, ...] = ()
    events: tuple[Event, ...] = ()
    notes: tuple[str, ...] = ()


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a folder, whole and to the disk."""
    content = {"format": FORMAT, **asdict(manifest)}
    write_text_whole(folder / MANIFEST, json.dumps(content, indent=1) + "\n")


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a folder.

    Raises
    ------
    InputError
        There is none, or it is not one.
    """
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            "The recording's manifest cannot be read.",
            file=path,
            found=error.strerror or str(error),
            remedy="name the folder that the recorder wrote, or rescue it with acino-fte rig recover",
        ) from None
    except ValueError as error:
        raise _wrong(path, str(error)) from None
    form = content.pop("format", None) if isinstance(content, dict) else None
    if form != FORMAT:
        if isinstance(form, str) and form.startswith(FORMAT.rpartition("/")[0] + "/"):
            raise InputError(
                "The recording's manifest is of another version.",
                file=path,
                expected=FORMAT,
                found=form,
                remedy="use the version of acino-fte that recorded it, or a newer one",
            )
        raise _wrong(path, "another format")
    try:
        return Manifest(**{key: _value(key, value) for key, value in content.items()})
    except (TypeError, ValueError) as error:
        raise _wrong(path, str(error)) from None


def _value(key: str, value: Any) -> Any:
    parts = {"streams": RecordedStream, "segments": Segment, "events": Event}
    if key in parts:
        return tuple(parts[key](**item) for item in value)
    return tuple(value) if key == "notes" else value


def _wrong(path: Path, found: str) -> InputError:
    return InputError(
        "The recording's manifest is damaged.",
        file=path,
        expected=f'JSON with "format": "{FORMAT}"',
        found=found,
        remedy="acino-fte rig recover makes a new one from the files beside it",
    )
