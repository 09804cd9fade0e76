"""Pins behind small interfaces: edges of an encoder's lines, PHASE and ENABLE of an H-bridge.

Three backends: the kernel's character device (gpiod 2), gpiozero (also with its mock pins), and a simulator.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from acino_fte.errors import InputError
from acino_fte.rig.quadrature import NO_EDGES, Edges

MARGIN_NS = 1_000_000
"""The kernel hands an edge over up to this much after its stamp; what is newer waits for the next reading."""
_READS = 64  # of the kernel's queue at a time: a line that oscillates must not hold up the loop


class EdgeBatch(NamedTuple):
    """Edges since the last reading.

    Attributes
    ----------
    edges : Edges
        (K,) in the order of their stamps.
    until_ns : int
        No later batch holds an edge before this time.
    lost : int
        Edges that the kernel had to throw away.
    """

    edges: Edges
    until_ns: int
    lost: int = 0


class EdgeInput(Protocol):
    """The lines A, B and perhaps Z of an encoder."""

    levels: tuple[int, int]
    """Of A and B when it was opened."""

    def read(self) -> EdgeBatch:
        """Take what has come; never waits."""

    def close(self) -> None:
        """Give the lines back."""


class PhaseEnable(Protocol):
    """The two inputs of a DRV8801: direction and pulse width."""

    def set(self, forward: bool, duty: float) -> None:
        """Direction, and the share (0–1) of the time in which the motor is driven; 0 brakes."""

    def close(self) -> None:
        """Stop, and give the pins back."""


class SimulatedEdges:
    """Edges from memory."""

    def __init__(
        self, levels: tuple[int, int] = (0, 0), clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.levels = levels
        self._clock = clock
        self._batches: list[Edges] = []

    def push(self, edges: Edges) -> None:
        """Edges that the next reading gives."""
        self._batches.append(edges)

    def read(self) -> EdgeBatch:
        """Take what was pushed."""
        batches, self._batches = [NO_EDGES, *self._batches], []
        return EdgeBatch(Edges(*(np.concatenate(c) for c in zip(*batches, strict=True))), self._clock() + 1)

    def close(self) -> None:
        """Nothing to give back."""


class GpiodEdges:
    """Edges with the kernel's own stamps, by libgpiod 2 (`gpiod`).

    Parameters
    ----------
    chip : str
        ``"gpiochip0"`` or ``"/dev/gpiochip0"``.
    lines : sequence of int
        Offsets of A, B and perhaps Z on that chip.
    """

    def __init__(self, chip: str, lines: Sequence[int]) -> None:
        gpiod = _gpiod()
        path = chip if chip.startswith("/") else f"/dev/{chip}"
        settings = gpiod.LineSettings(
            direction=gpiod.line.Direction.INPUT,
            edge_detection=gpiod.line.Edge.BOTH,
            event_clock=gpiod.line.Clock.MONOTONIC,
        )
        self._names = {offset: place for place, offset in enumerate(lines)}
        try:
            self._request = gpiod.request_lines(
                path, {tuple(lines): settings}, consumer="acino-fte", event_buffer_size=4096
            )
            values = self._request.get_values([lines[0], lines[1]])
        except (OSError, ValueError) as error:
            raise InputError(
                "The lines of an encoder cannot be opened.",
                file=path,
                expected=f"free lines {', '.join(map(str, lines))}",
                found=str(error),
                remedy="see gpioinfo for names and users of lines; the user must be in the group gpio",
            ) from None
        self._rising = gpiod.EdgeEvent.Type.RISING_EDGE
        a, b = (int(value == gpiod.line.Value.ACTIVE) for value in values)
        self.levels = (a, b)
        self._number = 0

    def read(self) -> EdgeBatch:
        """Take what the kernel has queued."""
        until = time.monotonic_ns() - MARGIN_NS
        events: list[Any] = []
        for _ in range(_READS):
            if not self._request.wait_edge_events(0):
                break
            events += self._request.read_edge_events()
        else:
            until = events[-1].timestamp_ns - MARGIN_NS
        if not events:
            return EdgeBatch(NO_EDGES, until)
        lost = events[-1].global_seqno - self._number - len(events)
        self._number = events[-1].global_seqno
        edges = Edges(
            np.array([event.timestamp_ns for event in events], np.int64),
            np.array([self._names[event.line_offset] for event in events], np.int8),
            np.array([event.event_type == self._rising for event in events], np.int8),
        )
        return EdgeBatch(edges, until, max(lost, 0))

    def close(self) -> None:
        """Give the lines back."""
        if self._request:
            self._request.release()


class GpiozeroEdges:
    """Edges by gpiozero's pins, whatever drives them; with its ``MockFactory`` without any hardware.

    Parameters
    ----------
    pins : sequence of int or str
        Names of A, B and perhaps Z, as gpiozero takes them.
    factory : gpiozero pin factory, optional
        By default gpiozero's own choice.
    """

    def __init__(self, pins: Sequence[int | str], factory: Any = None) -> None:
        if factory is None:
            device = _gpiozero().Device
            device.ensure_pin_factory()
            factory = device.pin_factory
        self._factory = factory
        self._events: deque[tuple[int, int, int]] = deque()
        self._pins: list[Any] = []
        self._callbacks: list[Callable[[float, int], None]] = []
        for place, name in enumerate(pins):
            pin = self._factory.pin(name)
            pin.function = "input"
            pin.edges = "both"
            self._callbacks.append(self._callback(place))  # gpiozero itself holds it weakly
            pin.when_changed = self._callbacks[-1]
            self._pins.append(pin)
        self.levels = (int(bool(self._pins[0].state)), int(bool(self._pins[1].state)))

    def _callback(self, line: int) -> Callable[[float, int], None]:
        def changed(ticks: float, state: int) -> None:
            self._events.append((round(ticks * 1e9), line, int(bool(state))))

        return changed

    def read(self) -> EdgeBatch:
        """Take what the callbacks have gathered."""
        until = round(self._factory.ticks() * 1e9) - MARGIN_NS
        events = [self._events.popleft() for _ in range(len(self._events))]
        if not events:
            return EdgeBatch(NO_EDGES, until)
        events.sort(key=lambda event: event[0])
        stamps, line, level = zip(*events, strict=True)
        edges = Edges(np.array(stamps, np.int64), np.array(line, np.int8), np.array(level, np.int8))
        return EdgeBatch(edges, until)

    def close(self) -> None:
        """Give the pins back."""
        for pin in self._pins:
            pin.when_changed = None
            pin.close()


class SimulatedBridge:
    """Remembers what it was told: `(forward, duty)`."""

    def __init__(self) -> None:
        self.told: list[tuple[bool, float]] = []

    def set(self, forward: bool, duty: float) -> None:
        """Remember."""
        self.told.append((forward, duty))

    def close(self) -> None:
        """Stop."""
        self.set(True, 0.0)


class GpiozeroBridge:
    """PHASE and ENABLE by gpiozero's ``PhaseEnableMotor``.

    Parameters
    ----------
    phase, enable : int or str
        Pins; ENABLE needs pulse-width modulation.
    factory : gpiozero pin factory, optional
        By default gpiozero's own choice.
    """

    def __init__(self, phase: int | str, enable: int | str, factory: Any = None) -> None:
        self._motor = _gpiozero().PhaseEnableMotor(phase, enable, pin_factory=factory)

    def set(self, forward: bool, duty: float) -> None:
        """Direction and pulse width."""
        self._motor.value = duty if forward else -duty

    def close(self) -> None:
        """Stop, and give the pins back."""
        self._motor.stop()
        self._motor.close()


def open_edges(text: str) -> EdgeInput:
    """Lines of an encoder from their description: ``gpiochip0 12 13`` (A, B), a third number for the index.

    Raises
    ------
    InputError
        It is not one, or the lines cannot be opened.
    """
    chip, *numbers = text.split() or [""]
    if not chip or len(numbers) not in (2, 3) or not all(number.isdecimal() for number in numbers):
        raise InputError(
            "The lines of an encoder are not understood.",
            expected="a chip and two or three lines: gpiochip0 12 13",
            found=text,
        )
    return GpiodEdges(chip, [int(number) for number in numbers])


def missing_rig_package(what: str, error: ImportError) -> InputError:
    """The error to raise where a package of the extra ``rig`` is not installed."""
    return InputError(
        f"{what} need a package that is not installed.",
        found=str(error),
        remedy='pip install "acino-fte[rig]"',
    )


def _gpiod() -> Any:
    try:
        import gpiod
        import gpiod.line
    except ImportError as error:
        raise missing_rig_package("The lines of encoders", error) from None
    return gpiod


def _gpiozero() -> Any:
    try:
        import gpiozero
    except ImportError as error:
        raise missing_rig_package("Pins", error) from None
    return gpiozero
