"""What recordings of a rig hold, whatever file they come from: lidar returns, inertial samples, pictures.

A reader walks through a file once and yields records in the order of the file, in constant memory. Of a cut
or damaged file it yields every whole record before and after the damage, and counts what was lost.
Times are int64 nanoseconds: ``time_ns`` by the clock of the sensor, ``received_ns`` by that of the computer.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

Kind = Literal["lidar", "imu", "image", "image_info", "other"]
KINDS: tuple[Kind, ...] = ("lidar", "imu", "image", "image_info", "other")
Clock = Literal["power_on", "ptp", "gps", "pps", "unix", "unknown"]
GRAVITY = 9.80665
"""Standard gravity, m/s²: what Livox and others call 1 g."""


@dataclass(frozen=True, eq=False)
class LidarReturns:
    """Returns of a lidar: of one message, one package or one frame. K returns.

    Attributes
    ----------
    time_ns : (K,) int64
        Of every return.
    xyz : (K, 3)
        m, frame of the lidar. Points without a return are left out.
    intensity : (K,)
        Reflectivity, 0–255 (Livox: up to 150 diffuse, above retroreflecting).
    tag, line : (K,) uint8
        Livox's tag (noise, number of the return) and line of the scan; zeros where there are none.
    clock : str
        Which clock `time_ns` is of.
    """

    time_ns: np.ndarray
    xyz: np.ndarray
    intensity: np.ndarray
    tag: np.ndarray
    line: np.ndarray
    clock: Clock = "unknown"

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Samples of an inertial sensor. K samples.

    Attributes
    ----------
    time_ns : (K,) int64
    rate : (K, 3)
        Angular velocity, rad/s, frame of the sensor.
    force : (K, 3)
        Specific force, m/s², frame of the sensor: at rest it points up and is 9.81 long.
    clock : str
    """

    time_ns: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    clock: Clock = "unknown"

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True, eq=False)
class Picture:
    """One image.

    Attributes
    ----------
    time_ns : int
        By the clock of the camera, or of its container.
    pixels : (H, W) or (H, W, 3)
        uint8 (uint16 of a deep grey image); colours as red, green, blue.
    number : int, optional
        Of the frame as the camera counted it: a gap tells of dropped frames.
    """

    time_ns: int
    pixels: np.ndarray
    number: int | None = None


@dataclass(frozen=True, eq=False)
class PictureInfo:
    """What a camera's driver says of one image (Ximea's XiImageInfo).

    Attributes
    ----------
    time_ns : int
        By the clock of the camera.
    number : int
        Of the frame as the camera counted it.
    exposure_us : float
    gain_db : float
    encoders : tuple of int
        Counts of the rig's encoders (zoom, focus, pan, tilt as the rig has them); empty without.
    """

    time_ns: int
    number: int
    exposure_us: float
    gain_db: float
    encoders: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Record:
    """One record of a stream. `value` is None where the kind is ``"other"``: `raw` has its bytes then.

    `published_ns` is a second stamp of the computer, where the file has one: the publish time of MCAP.
    """

    stream: str
    kind: Kind
    received_ns: int | None
    value: LidarReturns | ImuSamples | Picture | PictureInfo | None
    raw: bytes | None = None
    published_ns: int | None = None


@dataclass(frozen=True)
class Stream:
    """One stream of a recording: name (a topic, or ``lidar0``), kind, message type, and count if known."""

    name: str
    kind: Kind
    type: str
    count: int | None = None


@dataclass(frozen=True)
class Damage:
    """What a reader could not read.

    Attributes
    ----------
    n_read : int
        Whole records (messages, packages) that were read.
    n_lost : int
        Records that are known to be lost; those in bytes that nothing is known of are not counted.
    bytes_lost : int
        Bytes that were skipped.
    places : tuple of str
        Where and why, one sentence each.
    """

    n_read: int = 0
    n_lost: int = 0
    bytes_lost: int = 0
    places: tuple[str, ...] = ()

    @property
    def whole(self) -> bool:
        """Whether nothing is known to be lost."""
        return not (self.n_lost or self.bytes_lost or self.places)


class RecordingReader(Protocol):
    """What every reader offers: a context manager over one file or folder."""

    @property
    def streams(self) -> tuple[Stream, ...]:
        """The streams of the recording."""

    @property
    def damage(self) -> Damage:
        """What was lost so far; complete once all records were read."""

    def records(
        self, kinds: Collection[Kind] | None = None, streams: Collection[str] | None = None
    ) -> Iterator[Record]:
        """Records in the order of the file; only those of some kinds and streams, where they are named."""

    def __enter__(self) -> Any: ...

    def __exit__(self, *_: object) -> None: ...
