"""A rig's parts put together for driving: real ones by its ``rig.yaml``, or simulated ones."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from acino_fte.errors import InputError
from acino_fte.rig.drive_session import Axis, DriveSession
from acino_fte.rig.encoders import Encoder, LineCounts, ReportedCounts
from acino_fte.rig.encoders_shared import CountsWriter
from acino_fte.rig.encoders_store import PositionStore
from acino_fte.rig.gpio import EdgeBatch, open_edges
from acino_fte.rig.joystick import Axis as StickAxis
from acino_fte.rig.joystick import Joystick, find_adc
from acino_fte.rig.joystick_calibration import load_calibration
from acino_fte.rig.motors import LinkOutput, MotorControl
from acino_fte.rig.motors_simulated import SimulatedGearmotor
from acino_fte.rig.quadrature import A, B, Edges
from acino_fte.rig.rig_file import EncoderPart, RigFile
from acino_fte.rig.serial_link import SerialLink, open_port
from acino_fte.rig.serial_link_simulated import SimulatedController, SimulatedPort

_USUAL = {"zoom": 1, "focus": 2}
_TRAVEL = {1: (-2600.0, 6900.0), 2: (-4100.0, 5400.0)}  # of the simulated rings
Clock = Callable[[], int]


def open_session(
    rig: RigFile, folder: Path, *, port: str | None = None, clock: Clock = time.monotonic_ns
) -> DriveSession:
    """The real rig.

    What is missing (a converter for the joystick, pins of the head) is told on the screen and stops nothing;
    a microcontroller that is not plugged in is waited for.

    Parameters
    ----------
    rig : RigFile
        Its encoders say their motors and pins.
    folder : Path
        Of positions and calibration, see :func:`state_folder`.
    port : str, optional
        Of the microcontroller; by default the only one on USB.
    clock : callable
        Monotonic time in ns.

    Raises
    ------
    InputError
        The calibration of the joystick is damaged, or a motor's number is there twice.
    """
    numbers = motor_numbers(rig)
    joystick = _joystick(folder)
    store = PositionStore(folder)
    axes = [
        _ring(name, part, numbers[name], store) if name in numbers else _head(name, part, store)
        for name, part in rig.encoders.items()
    ]
    link = SerialLink(partial(open_port, port), tuple(numbers.values()))
    return DriveSession(axes, link, joystick=joystick, store=store, shared=CountsWriter(folder), clock=clock)


def open_simulated(
    rig: RigFile, folder: Path, *, clock: Clock = time.monotonic_ns, framed: bool = True
) -> DriveSession:
    """A simulated rig: gearmotors between stops behind a microcontroller, a head that is turned by hand."""
    numbers = motor_numbers(rig)
    motors = {k: SimulatedGearmotor(0.0, _TRAVEL.get(k, (-5000.0, 5000.0))) for k in numbers.values()}
    port = SimulatedPort(SimulatedController(motors, clock, framed=framed))
    store = PositionStore(folder)
    axes = []
    for name, part in rig.encoders.items():
        if name in numbers:
            axes.append(_ring(name, part, numbers[name], store))
        else:
            source = LineCounts(SimulatedHead(part.counts_per_turn, clock, 0.5 if name == "pan" else 0.1))
            axes.append(Axis(name, Encoder(name, source, part.counts_per_turn, store=store)))
    return DriveSession(
        axes, SerialLink(port.open, tuple(motors)), store=store, shared=CountsWriter(folder), clock=clock
    )


def motor_numbers(rig: RigFile) -> dict[str, int]:
    """Numbers of the motors by the names of their encoders; zoom is 1 and focus 2 where none is said.

    Raises
    ------
    InputError
        Two have the same.
    """
    said = {name: part.motor for name, part in rig.encoders.items() if part.motor}
    numbers = said or {name: number for name, number in _USUAL.items() if name in rig.encoders}
    if len(set(numbers.values())) < len(numbers):
        raise InputError(
            "Two encoders have the same motor.",
            key="encoders",
            found=", ".join(f"{name}: motor {number}" for name, number in numbers.items()),
            remedy="give every motor its own number in rig.yaml",
        )
    return numbers


class SimulatedHead:
    """Lines of an encoder that a hand turns slowly to and fro.

    Parameters
    ----------
    counts_per_turn : float
    clock : callable
        Time in ns.
    swing : float
        rad to either side.
    """

    levels = (0, 0)

    def __init__(self, counts_per_turn: float, clock: Clock, swing: float) -> None:
        self._clock, self._began = clock, clock()
        self._size = swing * counts_per_turn / (2 * np.pi)
        self._counts, self._read_ns = 0, clock()

    def read(self) -> EdgeBatch:
        """Edges since the last reading."""
        now = self._clock()
        goal = round(self._size * np.sin((now - self._began) * 1e-9 * 0.4))
        way = np.arange(self._counts, goal + np.sign(goal - self._counts), np.sign(goal - self._counts) or 1)
        phase = way & 3
        b = (phase >> 1).astype(np.int8)
        a = ((phase & 1) ^ b).astype(np.int8)
        line = np.where(np.diff(a) != 0, A, B).astype(np.int8)
        level = np.where(line == A, a[1:], b[1:]).astype(np.int8)
        when = np.linspace(self._read_ns, now - 1, len(line) + 1)[1:].astype(np.int64)
        self._counts, self._read_ns = goal, now
        return EdgeBatch(Edges(when, line, level), now)

    def close(self) -> None:
        """Nothing to give back."""


def _ring(name: str, part: EncoderPart, number: int, store: PositionStore) -> Axis:
    report, output = ReportedCounts(), LinkOutput(number)
    encoder = Encoder(name, report, part.counts_per_turn, store=store, self_locking=True)
    stored = store.get(name)
    motor = MotorControl(encoder, output, limits=stored.limits if stored else None)
    return Axis(name, encoder, motor, output, report)


def _head(name: str, part: EncoderPart, store: PositionStore) -> Axis:
    if not part.gpio:
        return Axis(name, None, trouble=f"not connected (rig.yaml: encoders.{name}.gpio)")
    try:
        source = LineCounts(open_edges(part.gpio))
    except InputError as error:
        return Axis(name, None, trouble=f"{error.problem} {error.found or ''}".strip())
    return Axis(name, Encoder(name, source, part.counts_per_turn, store=store))


def _joystick(folder: Path) -> Joystick | None:
    """The joystick, if there is a converter and it was calibrated."""
    calibration = load_calibration(folder)
    adc = find_adc()
    if calibration is None or adc is None:
        return None
    return Joystick(adc, [StickAxis(axis) for axis in calibration])
