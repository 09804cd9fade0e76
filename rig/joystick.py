"""A joystick of potentiometers behind an analogue-to-digital converter.

A raw number becomes -1 … 1 by the calibration of its axis, then zero within the dead band, then the curve
``(1 - expo) x + expo x³``: fine around the middle, all of it at the end. A median of three takes out single
wrong readings, a low-pass the trembling of a hand; letting go is not delayed by either filter for more than
one reading. A number far outside what was calibrated is a broken wire: it counts as the middle.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Protocol

from acino_fte.errors import InputError
from acino_fte.rig.gpio import missing_rig_package
from acino_fte.rig.joystick_calibration import AxisCalibration

BEYOND = 0.15
"""Of half the travel; further outside the calibrated ends a wire is broken."""


class Adc(Protocol):
    """A converter with a channel for every axis."""

    def read(self) -> tuple[int, ...]:
        """Raw numbers of all channels; OSError when it cannot be read."""


class SimulatedAdc:
    """Raw numbers from memory.

    Parameters
    ----------
    raw : sequence of int
        Of every channel; may be changed at any time.
    """

    def __init__(self, raw: Sequence[int] = (512, 512)) -> None:
        self.raw = list(raw)

    def read(self) -> tuple[int, ...]:
        """What was set."""
        return tuple(self.raw)


class IioAdc:
    """A converter that the kernel drives (industrial I/O): ``in_voltage0_raw``, ``in_voltage1_raw``.

    Parameters
    ----------
    folder : Path
        Its folder under ``/sys/bus/iio/devices``.
    channels : tuple of int
        Of the axes.
    """

    def __init__(self, folder: Path, channels: tuple[int, ...] = (0, 1)) -> None:
        self._paths = [folder / f"in_voltage{channel}_raw" for channel in channels]

    def read(self) -> tuple[int, ...]:
        """All channels, one after the other."""
        try:
            return tuple(int(path.read_text()) for path in self._paths)
        except ValueError as error:
            raise OSError(f"not a number: {error}") from None


class GpiozeroAdc:
    """A MCP3008 by gpiozero.

    Parameters
    ----------
    channels : tuple of int
        Of the axes.
    """

    def __init__(self, channels: tuple[int, ...] = (0, 1)) -> None:
        try:
            from gpiozero import MCP3008
        except ImportError as error:
            raise missing_rig_package("Converters", error) from None
        self._channels = [MCP3008(channel) for channel in channels]

    def read(self) -> tuple[int, ...]:
        """All channels, one after the other."""
        return tuple(channel.raw_value for channel in self._channels)


def find_adc(devices: Path = Path("/sys/bus/iio/devices")) -> IioAdc | None:
    """The first converter of this computer that has two channels; None without one."""
    for folder in sorted(devices.glob("iio:device*")) if devices.is_dir() else []:
        if all((folder / f"in_voltage{channel}_raw").is_file() for channel in (0, 1)):
            return IioAdc(folder)
    return None


@dataclass(frozen=True)
class Response:
    """How an axis answers.

    Attributes
    ----------
    dead_band : float
        Share of half the travel around the middle that counts as the middle.
    expo : float
        0 for a straight line, 1 for a cube.
    smooth_s : float
        Time constant of the low-pass.
    """

    dead_band: float = 0.08
    expo: float = 0.6
    smooth_s: float = 0.04

    def __post_init__(self) -> None:
        if not (0 <= self.dead_band < 1 and 0 <= self.expo <= 1 and 0 <= self.smooth_s <= 1):
            raise InputError(
                "The response of a joystick is impossible.",
                expected="dead band 0 … 1, expo 0 … 1, smoothing 0 … 1 s",
                found=f"{self.dead_band:g}, {self.expo:g}, {self.smooth_s:g} s",
            )

    def __call__(self, value: float) -> float:
        """Answer of -1 … 1 to a deflection; without a step at the edge of the dead band."""
        size = (abs(value) - self.dead_band) / (1 - self.dead_band)
        if size <= 0:
            return 0.0
        size = min(size, 1.0)
        return math.copysign((1 - self.expo) * size + self.expo * size**3, value)


class Axis:
    """One axis: raw numbers become what the operator wants.

    Parameters
    ----------
    calibration : AxisCalibration
    response : Response
    """

    def __init__(self, calibration: AxisCalibration, response: Response | None = None) -> None:
        self.calibration = calibration
        self.response = response or Response()
        self.broken, self.at_rest = False, False
        self._raw: deque[int] = deque(maxlen=3)
        self._smooth, self._when = 0.0, None

    _when: int | None

    def update(self, raw: int, now_ns: int) -> float:
        """What the operator wants now, -1 … 1.

        Parameters
        ----------
        raw : int
            From the converter.
        now_ns : int
            By the clock of the loop.
        """
        self._raw.append(raw)
        deflection = self.calibration.deflection(median(self._raw))
        self.broken = not -1 - BEYOND <= deflection <= 1 + BEYOND
        wanted = 0.0 if self.broken else self.response(deflection)
        self.at_rest = not self.broken and wanted == 0.0
        passed = 0.0 if self._when is None else (now_ns - self._when) * 1e-9
        self._when = now_ns
        if wanted == 0.0 or wanted * self._smooth < 0:  # let go, or turned round: at once
            self._smooth = 0.0
        if wanted:
            share = 1.0 if self.response.smooth_s == 0 else 1 - math.exp(-passed / self.response.smooth_s)
            self._smooth += (wanted - self._smooth) * share
        return self._smooth


class Joystick:
    """All axes of a joystick.

    Parameters
    ----------
    adc : Adc
        Its converter.
    axes : sequence of Axis
        In the order of the channels.
    """

    def __init__(self, adc: Adc, axes: Sequence[Axis]) -> None:
        self._adc, self._axes = adc, tuple(axes)
        self.trouble = ""
        self._armed = False

    def read(self, now_ns: int) -> tuple[float, ...] | None:
        """What the operator wants of every axis, -1 … 1; None when the converter cannot be read.

        Nothing is wanted before the stick was in the middle once, so that a stick that is held over, or a
        wrong calibration, does not start a motor.
        """
        try:
            raw = self._adc.read()
        except OSError as error:
            self.trouble = f"the joystick cannot be read: {error.strerror or error}"
            self._armed = False
            return None
        wanted = tuple(axis.update(value, now_ns) for axis, value in zip(self._axes, raw, strict=False))
        broken = [str(k + 1) for k, axis in enumerate(self._axes) if axis.broken]
        self.trouble = f"a wire of joystick axis {' and '.join(broken)} is broken" if broken else ""
        if broken:
            self._armed = False
        elif all(axis.at_rest for axis in self._axes):
            self._armed = True
        elif not self._armed:
            self.trouble = "let go of the joystick once"
        return wanted if self._armed else (0.0,) * len(wanted)

    def disarm(self) -> None:
        """Want nothing until the stick was in the middle: after an interruption."""
        self._armed = False


def sampled(adc: Adc, n: int, wait: Callable[[], None]) -> list[tuple[int, ...]]:
    """Readings for a calibration.

    Parameters
    ----------
    adc : Adc
        The converter.
    n : int
        How many.
    wait : callable
        Between two of them.
    """
    readings = []
    for _ in range(n):
        readings.append(adc.read())
        wait()
    return readings


def simulated_sweep() -> Adc:
    """A converter whose stick rests for 100 readings, and then is moved round along all its ends."""

    class Sweep:
        def __init__(self) -> None:
            self.n = 0

        def read(self) -> tuple[int, ...]:
            self.n += 1
            out, turn = (0.0 if self.n <= 100 else 450.0), self.n * 0.05
            return round(510 + out * math.cos(turn)), round(505 + out * math.sin(turn))

    return Sweep()
