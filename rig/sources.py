"""Devices of a rig behind one small interface, and the names of their drivers.

A driver is a :class:`Source`. It is found by the name that ``device:`` has in ``rig.yaml``: in
:data:`DRIVERS`, or among the entry points ``acino_fte.rig.devices`` of what is installed. What the driver of
a certain device must deliver is in ``docs/rig_devices.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from acino_fte.data_tools.recording import ImuSamples, LidarReturns, Picture, PictureInfo
from acino_fte.errors import InputError, did_you_mean
from acino_fte.rig.rig_file import CameraPart, LidarPart, RigFile

ENTRY_POINTS = "acino_fte.rig.devices"
SIMULATED, ENCODERS = "simulated", "encoders"
PLANNED = ("ximea", "livox")
"""Devices whose drivers are described, not written."""


class DeviceGone(Exception):  # noqa: N818 - what happened, not a mistake
    """The device does not answer: unplugged, without power, or not there yet."""


@dataclass(frozen=True)
class SourceStream:
    """One stream of a source: the topic or the camera, what it carries, and how often, Hz."""

    name: str
    kind: Literal["lidar", "imu", "image"]
    expected_hz: float


@dataclass(frozen=True, eq=False)
class Sample:
    """One thing that a device delivered.

    Attributes
    ----------
    stream : str
        Name of its :class:`SourceStream`.
    value : Picture, LidarReturns or ImuSamples
        Of inertial samples one.
    device_ns : int
        When it began, by the clock of the device.
    number : int, optional
        As the device counts; cameras do.
    info : PictureInfo, optional
        Of a picture. The recorder adds the counts of the encoders.
    """

    stream: str
    value: Picture | LidarReturns | ImuSamples
    device_ns: int
    number: int | None = None
    info: PictureInfo | None = None


class Source(Protocol):
    """What a driver offers. It is used by one thread at a time, but for `trigger`."""

    @property
    def name(self) -> str:
        """The device's name in ``rig.yaml``."""

    @property
    def streams(self) -> tuple[SourceStream, ...]:
        """What it delivers; known before it is opened."""

    def open(self) -> None:
        """Connect, set up and start. Also after :meth:`close`.

        Raises
        ------
        DeviceGone
            It does not answer.
        """

    def close(self) -> None:
        """Stop and let go. Also where it was never opened, or is gone."""

    def read(self, timeout_s: float) -> Sample | None:
        """The next sample, in the order of the device; None where none came in time.

        Raises
        ------
        DeviceGone
            It is gone. The recorder closes it, and opens it again from time to time.
        """

    def describe(self) -> str:
        """Model, serial number, firmware and settings, in one line."""


class Triggered(Source, Protocol):
    """A lidar whose frames can be cut on demand."""

    def trigger(self) -> None:
        """Deliver what was gathered since the last call as a frame. Called from any thread."""


class Counts(Protocol):
    """What reads the rig's encoders."""

    def counts(self) -> tuple[int, ...]:
        """The newest counts, in the order of ``encoders:`` of ``rig.yaml``, without waiting."""


Driver = Callable[[str, Any], Any]
DRIVERS: dict[str, Driver] = {}
"""Drivers by name: called with the device's name and its part of ``rig.yaml``, they give a :class:`Source`.

The one of the name ``encoders`` gives a :class:`Counts`.
"""


def register_driver(device: str, driver: Driver) -> None:
    """Make a driver known under the name that ``device:`` of ``rig.yaml`` gives."""
    DRIVERS[device] = driver


def find_driver(device: str, key: str) -> Driver:
    """The driver of this name.

    Parameters
    ----------
    device : str
        The name.
    key : str
        Where in ``rig.yaml`` it is named, for the message.

    Raises
    ------
    InputError
        There is none.
    """
    from importlib.metadata import entry_points

    if device in DRIVERS:
        return DRIVERS[device]
    others = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
    if device in others:
        return others[device].load()
    known = sorted({SIMULATED, *DRIVERS, *others})
    if device in PLANNED:
        remedy = f"write one as docs/rig_devices.md says, or try with --simulate; group {ENTRY_POINTS}"
        raise InputError("This device has no driver here.", key=key, found=device, remedy=remedy)
    raise InputError(
        "There is no driver of this name.",
        key=key,
        expected=", ".join(known) + did_you_mean(device, [*known, *PLANNED]),
        found=device,
        remedy="docs/rig_devices.md says how a driver is written and made known; --simulate needs none",
    )


def real_sources(rig: RigFile) -> list[Source]:
    """A source for every camera and lidar of a rig, by its driver.

    Raises
    ------
    InputError
        A driver is not known, or the rig is a simulated one.
    """
    parts: Sequence[tuple[str, str, CameraPart | LidarPart]] = [
        *(("cameras", name, camera) for name, camera in rig.cameras.items()),
        *(("lidars", name, lidar) for name, lidar in rig.lidars.items()),
    ]
    found = []
    for where, name, part in parts:
        key = f"{where}.{name}.device"
        if part.device == SIMULATED:
            raise InputError(
                "This device is simulated: nothing real would be recorded.",
                key=key,
                found=SIMULATED,
                remedy="add --simulate to try, or name the driver of the real device",
            )
        found.append(find_driver(part.device, key)(name, part))
    return found


def real_counts(rig: RigFile) -> Counts | None:
    """What reads the encoders of a rig: the driver ``encoders``, else what ``acino-fte rig drive`` shares."""
    from importlib.metadata import entry_points

    from acino_fte.rig.encoders_shared import SharedCounts

    if not rig.encoders:
        return None
    if ENCODERS in DRIVERS:
        return DRIVERS[ENCODERS](ENCODERS, rig.encoders)
    found = [point for point in entry_points(group=ENTRY_POINTS) if point.name == ENCODERS]
    driver = found[0].load() if found else SharedCounts
    return driver(ENCODERS, rig.encoders)


def camera_topic(camera: str) -> str:
    """Topic of what a camera's driver says of its images."""
    return f"/{camera}/info"


def lidar_topic(lidar: str) -> str:
    """Topic of a lidar's frames."""
    return f"/{lidar}/points"


def imu_topic(lidar: str) -> str:
    """Topic of the inertial sensor in a lidar."""
    return f"/{lidar}/imu"
