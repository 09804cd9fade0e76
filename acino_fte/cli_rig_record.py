"""``acino-fte rig record``: record with a rig, or try it with a simulated one."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from acino_fte.cli_common import EXIT_OTHER, reported_errors, stderr, stdout, warn
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.rig_recording import Manifest
    from acino_fte.rig.recorder_types import Status
    from acino_fte.rig.session import Session

_SIMULATION = "Simulation"
_QUIET_EVENTS = ("started", "stopped")
_MOST_EVENTS = 20
_LINE_EVERY_S = 10.0  # where the output is no terminal


def record(
    rig_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="RIG.YAML",
            help="The rig. [dim]\\[default: rig.yaml here, else the rig of WildPose][/]",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder to make. [dim]\\[default: NAME-DATE-TIME][/]"),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(help="How long.", show_default="until Ctrl-C, or the disk is full"),
    ] = None,
    lidar_every: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Cut a lidar frame after every N images.", show_default="by its own clock"
        ),
    ] = None,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="All devices are simulated.", rich_help_panel=_SIMULATION)
    ] = False,
    fast: Annotated[
        bool,
        typer.Option("--fast", help="As fast as this computer can.", rich_help_panel=_SIMULATION),
    ] = False,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FAULT", rich_help_panel=_SIMULATION,
            help="stall:cam1@10+2, unplug:lidar1@20+3, lost:cam1@30+5 (images), clock@40-5, lens:zoom@50+4, "
            "disk@60: what, at which second, for how long. Can be repeated.",
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors and warnings only.")] = False,
) -> None:  # fmt: skip
    """Record video, lidar, inertial sensor and lens with a rig.

    Ctrl-C once closes the recording in good order; twice leaves at once. What was
    written stays readable even when the power fails (acino-fte rig recover).
    Leaves with 0 when nothing was lost unexplained, 1 otherwise, 2 when it could not begin.

    Example: acino-fte rig record --simulate --minutes 1
    """
    with reported_errors():
        session = _session(rig_file, out, simulate, fast, fault or [], minutes, lidar_every)
        with _signals(session):
            checks = session.preflight()
            for check in checks:
                if not check.passed:
                    warn(f"{check.name}: {check.detail}" + (f"; {check.remedy}" if check.remedy else ""))
                elif not quiet:
                    stdout.print(f"[green]ok[/] {escape(check.name)}: {escape(check.detail)}")
            if not quiet:
                stdout.print(f"recording into {escape(str(session.folder))} – Ctrl-C ends it")
            seconds = minutes * 60 if minutes is not None else 600.0 if fast else None
            line = _Line(quiet)
            manifest = session.record(seconds, line.show)
            line.end()
        _conclude(session, manifest, seconds, quiet)


def _session(
    rig_file: Path | None, out: Path | None, simulate: bool, fast: bool, faults: list[str],
    minutes: float | None, lidar_every: int | None,
) -> Session:  # fmt: skip
    from acino_fte import __version__
    from acino_fte.rig.faults import parse_fault
    from acino_fte.rig.rig_file import RigFile
    from acino_fte.rig.rig_read import find_rig_file, read_rig
    from acino_fte.rig.session import Session, SessionOptions

    if (fast or faults) and not simulate:
        raise InputError(
            "Only a simulated rig can do that.", key="--fast" if fast else "--fault", remedy="add --simulate"
        )
    if minutes is not None and not 0 < minutes < 1e6:
        raise InputError(
            "That is no time to record.", key="--minutes", expected="above 0", found=f"{minutes:g}"
        )
    if lidar_every is not None and lidar_every < 1:
        raise InputError("There are no such images.", key="--lidar-every", expected="1 or more")
    path = find_rig_file(rig_file)
    rig = read_rig(path) if path is not None else RigFile()
    folder = out or Path(f"{rig.name}-{datetime.now():%Y%m%d-%H%M%S}")
    return Session(
        rig, folder,
        SessionOptions(
            simulate, fast, tuple(parse_fault(text, rig) for text in faults), lidar_every,
            f"acino-fte {__version__}",
        ),
    )  # fmt: skip


@contextmanager
def _signals(session: Session) -> Iterator[None]:
    """Ctrl-C, and being told to end: the first time in good order, then at once."""
    asked = 0

    def told(number: int, _: Any) -> None:
        nonlocal asked
        asked += 1
        if session.state in ("idle", "preflight"):
            raise KeyboardInterrupt
        if asked > 1:
            os.write(2, b"\nleft at once; acino-fte rig recover closes what is there\n")
            os._exit(EXIT_OTHER)
        os.write(2, b"\nclosing - Ctrl-C again leaves at once\n")
        session.stop("Ctrl-C" if number == signal.SIGINT else "told to end")

    names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {getattr(signal, name): signal.signal(getattr(signal, name), told) for name in names}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Line:
    """The line that says how it goes: in place on a terminal, else a line every ten seconds."""

    def __init__(self, quiet: bool) -> None:
        self._quiet, self._next, self._live = quiet, 0.0, sys.stdout.isatty()
        self._shown = False

    def show(self, status: Status) -> None:
        if self._quiet:
            return
        if self._live:
            text = status_line(status)[: max(stdout.width - 1, 40)]
            stdout.file.write("\r" + text.ljust(max(stdout.width - 1, 40)))
            stdout.file.flush()
            self._shown = True
        elif status.elapsed_s >= self._next:
            stdout.print(status_line(status), markup=False)
            self._next = status.elapsed_s - status.elapsed_s % _LINE_EVERY_S + _LINE_EVERY_S

    def end(self) -> None:
        if self._shown:
            stdout.file.write("\n")


def status_line(status: Status) -> str:
    """One line: state, time, frames a second of every stream, losses, room on the disk."""
    from acino_fte.rig.recorder_types import gigabytes

    minutes, seconds = divmod(int(status.elapsed_s), 60)
    rates = " ".join(f"{name.strip('/')} {fps:.0f}/s" for name, fps in _rates(status).items())
    parts = [f"{status.state.upper()} {minutes:02d}:{seconds:02d}", rates or "starting"]
    if status.silent:
        parts.append("SILENT: " + ", ".join(name.strip("/") for name in status.silent))
    if status.lens_moved:
        parts.append("LENS MOVED")
    parts.append(f"dropped {status.dropped}, lost {status.lost}")
    left = (
        f"{status.minutes_left / 60:.1f} h"
        if status.minutes_left >= 120
        else f"{status.minutes_left:.0f} min"
    )
    parts.append(f"{gigabytes(status.free_bytes)} free, {left} left")
    return " | ".join(parts)


def _rates(status: Status) -> dict[str, float]:
    return {name: fps for name, fps in status.fps.items() if not name.endswith("/info")}


def _conclude(session: Session, manifest: Manifest, seconds: float | None, quiet: bool) -> None:
    """What happened; the exit code."""
    from acino_fte.rig.recorder_verdict import unexplained

    _tell_events(manifest)
    bad = unexplained(manifest, session.options.faults)
    for sentence in bad:
        stderr.print(f"[bold red]lost:[/] {escape(sentence)}")
    lasted = ((manifest.ended_ns or manifest.started_ns) - manifest.started_ns) * 1e-9
    unwritten = session.recorder.unwritten if session.recorder is not None else ""
    whole = not unwritten and all(segment.closed for segment in manifest.segments)
    if not quiet:
        streams = (stream for stream in manifest.streams if stream.kind != "image_info")
        counts = ", ".join(f"{stream.name.strip('/')} {stream.written}" for stream in streams)
        size = sum(segment.n_bytes for segment in manifest.segments)
        stdout.print(f"{lasted:.1f} s, {size / 1e6:.1f} MB: {counts}", markup=False)
        look = f"look at it: acino-fte rig check {session.folder}"
        stdout.print(f"written to {session.folder}" + (f"; {look}" if whole else ""), markup=False)
    if not whole:
        remedy = f"acino-fte rig recover {session.folder} rescues it"
        warn("; ".join(filter(None, ["not all could be closed", unwritten, remedy])))
    early = any(event.kind in ("disk_full", "error") for event in manifest.events)
    if bad or not whole or (early and seconds is not None and lasted < seconds - 1):
        raise typer.Exit(EXIT_OTHER)


def _tell_events(manifest: Manifest) -> None:
    """The events, one line each."""
    events = [event for event in manifest.events if event.kind not in _QUIET_EVENTS]
    for event in events[:_MOST_EVENTS]:
        at = (event.time_ns - manifest.started_ns) * 1e-9
        more = f" for {event.seconds:.2f} s" if event.seconds > 0 and event.kind != "clock_jump" else ""
        count = f", {event.count} missing" if event.count else ""
        name = f" {event.stream.strip('/')}" if event.stream else ""
        warn(f"at {at:.2f} s: {event.kind.replace('_', ' ')}{name}{more}{count}: {event.detail}")
    if len(events) > _MOST_EVENTS:
        warn(f"and {len(events) - _MOST_EVENTS} more: manifest.json has them all")
