"""``acino-fte rig drive``: zoom, focus, pan and tilt on one screen."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import EXIT_OTHER, reported_errors, stdout
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.rig.drive_keys import Keyboard
    from acino_fte.rig.drive_session import DriveSession, DriveStatus
    from acino_fte.rig.joystick import Adc

_STATUS_S = 3.0
_TITLE = "acino-fte rig drive"


def drive(
    rig: Annotated[
        Path | None,
        typer.Argument(
            metavar="RIG",
            help="rig.yaml, or a folder with one.",
            show_default="rig.yaml here, or the usual rig",
        ),
    ] = None,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="A simulated rig: nothing needs to be plugged in.")
    ] = False,
    port: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE",
            help="Serial port of the microcontroller.",
            show_default="the only one on USB",
        ),
    ] = None,
    calibrate_joystick: Annotated[
        bool, typer.Option("--calibrate-joystick", help="Measure middle and ends of the joystick, and leave.")
    ] = False,
    status: Annotated[
        bool, typer.Option("--status", help="Look at everything, move nothing, print it, and leave.")
    ] = False,
) -> None:
    """Drive zoom and focus by joystick or keys, and see pan and tilt.

    The motors stop when the stick or the key is let go, at the end, at Ctrl-C, and
    when the cable is out. Without a joystick the arrow keys drive: a tap is a nudge,
    hold to go on. --status leaves with 1 when the microcontroller does not answer.

    Example: acino-fte rig drive --simulate
    """
    with reported_errors():
        from acino_fte.rig.drive_setup import open_session, open_simulated
        from acino_fte.rig.encoders_store import state_folder
        from acino_fte.rig.rig_file import RigFile
        from acino_fte.rig.rig_read import find_rig_file, read_rig

        if simulate and port:
            raise InputError("A simulated rig has no port.", key="--port", remedy="leave out one of the two")
        folder = state_folder(simulate)
        if calibrate_joystick:
            _calibrate(folder, simulate)
            return
        path = find_rig_file(rig)
        parts = RigFile() if path is None else read_rig(path)
        if port and not Path(port).exists():
            raise InputError(
                "There is no such serial port.",
                key="--port",
                found=port,
                remedy="acino-fte doctor lists the ports; without --port the only one on USB is taken",
            )
        make = open_simulated(parts, folder) if simulate else open_session(parts, folder, port=port)
        if status:
            _look(make, simulate)
        else:
            _drive(make, simulate)


def _drive(session: DriveSession, simulated: bool) -> None:
    """The loop. However it ends, the motors stop."""
    from rich.live import Live

    from acino_fte.rig.drive_keys import Keyboard
    from acino_fte.rig.drive_screen import screen

    title = _TITLE + ("  (simulated)" if simulated else "")
    try:
        with _ends_by_signal(), Keyboard() as keyboard, Live(screen=True, auto_refresh=False) as live:
            try:
                _loop(session, keyboard, lambda state: live.update(screen(state, title), refresh=True))
            finally:
                session.stop()  # before anything is done with the terminal
    except (KeyboardInterrupt, OSError):
        pass  # the usual way to leave; a terminal that was closed
    finally:
        session.close()
    with suppress(OSError):
        stdout.print("The motors are stopped.")


def _loop(session: DriveSession, keyboard: Keyboard, show: Callable[[DriveStatus], None]) -> None:
    """Fifty turns a second, until q."""
    from acino_fte.rig.drive_session import LOOP_S

    turn = 0
    while True:
        began = time.monotonic()
        keys = keyboard.read()
        if "q" in keys or "Q" in keys:
            return
        state = session.step(keys)
        if turn % 5 == 0:
            show(state)
        turn += 1
        time.sleep(max(0.0, LOOP_S - (time.monotonic() - began)))


def _look(session: DriveSession, simulated: bool) -> None:
    """A few turns without a motor, and what they showed."""
    from acino_fte.rig.drive_session import LOOP_S

    end = time.monotonic() + _STATUS_S
    try:
        state = session.look()
        while time.monotonic() < end and not state.link_good:
            time.sleep(LOOP_S)
            state = session.look()
    finally:
        session.close()
    _print_status(state, simulated)
    if not state.link_good:
        raise typer.Exit(EXIT_OTHER)


def _print_status(state: DriveStatus, simulated: bool) -> None:
    from acino_fte.rig.drive_screen import said, where

    stdout.print(f"[bold]{_TITLE} --status{'  (simulated)' if simulated else ''}[/]")
    for axis in state.axes:
        stdout.print(f"  {axis.name:<10}{escape(where(axis).strip())}{escape(_tail(said(axis)))}")
    stdout.print(f"  {'link':<10}{escape(state.link)}")
    stdout.print(f"  {'joystick':<10}{escape(state.stick)}")
    for note in state.notes:
        stdout.print(f"  {'note':<10}{escape(note)}")


def _tail(text: str) -> str:
    return f"  ({text})" if text else ""


def _calibrate(folder: Path, simulated: bool) -> None:
    """Middle and ends of the joystick, guided."""
    from acino_fte.rig.joystick import find_adc, sampled, simulated_sweep
    from acino_fte.rig.joystick_calibration import calibrated, save_calibration

    adc: Adc | None = simulated_sweep() if simulated else find_adc()
    if adc is None:
        raise InputError(
            "No converter for a joystick was found.",
            expected="an industrial I/O device with two channels under /sys/bus/iio/devices",
            remedy="see docs/rig_drive.md for its wiring; without one the arrow keys drive",
        )
    pause = 0.0 if simulated else 0.01
    if not simulated and not sys.stdin.isatty():
        raise InputError("The joystick is calibrated from a terminal, and this is none.")
    try:
        stdout.print("1. Let go of the joystick.")
        _enter(simulated)
        rest = sampled(adc, 100, lambda: time.sleep(pause))
        stdout.print("2. Move it round along all its ends, twice, for five seconds.")
        _enter(simulated)
        moved = sampled(adc, 500, lambda: time.sleep(pause))
    except OSError as error:
        raise InputError("The joystick cannot be read.", found=error.strerror or str(error)) from None
    axes = calibrated(rest, moved)
    path = save_calibration(folder, axes)
    for number, axis in enumerate(axes, 1):
        stdout.print(f"   axis {number}: {axis.low} … {axis.centre} … {axis.high}")
    stdout.print(f"Saved: {escape(str(path))}")


def _enter(simulated: bool) -> None:
    if not simulated:
        typer.prompt("   Press Enter", default="", show_default=False, prompt_suffix=" ")


@contextmanager
def _ends_by_signal() -> Iterator[None]:
    """A terminal that is closed, a polite kill, Ctrl-Z and Ctrl-\\ end the loop as Ctrl-C does."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    names = ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")  # a program that is put aside would drive on
    signals = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = [signal.signal(number, stop) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
