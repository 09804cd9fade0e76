"""``acino-fte rig recover``: a readable copy of a damaged recording."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import reported_errors, spinner, stdout
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.rig.recover_types import Recovery, SavedStream

_NOTES = 8  # shown; the report has them all


def recover(
    damaged: Annotated[
        Path,
        typer.Argument(
            metavar="DAMAGED",
            help="What does not open any more: a bag (ROS 1, ROS 2), an MCAP, an LVX, eCAL's .hdf5, a video, "
            "the recorder's folder, or a folder of such files.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="COPY", help="The copy. [dim]\\[default: NAME-recovered][/]"),
    ] = None,
    like: Annotated[
        Path | None,
        typer.Option(
            metavar="GOOD",
            help="A sound recording of the same devices, for an MP4 without its index, an LVX without its "
            "head or an .hdf5 without its channels.",
        ),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            metavar="RATE",
            help="Frames per second of an MP4 without its index.",
            show_default="that of GOOD",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
) -> None:
    """Rescue a recording that was cut: a flat battery, a full disk, a pulled cable.

    The original is never touched: everything whole in it goes into a readable copy of
    the same format, and recovery.json says what was saved and what was lost. A sound
    recording is left alone. Leaves with 0 when something readable is there, 2 when
    the file is no recording or nothing could be saved.

    Example: acino-fte rig recover run.bag
    """
    with reported_errors():
        if fps is not None and not (math.isfinite(fps) and 0 < fps < 1e6):
            raise InputError(
                "The value of --fps is impossible.", key="--fps", expected="more than 0", found=f"{fps:g}"
            )
        if like is not None and not like.is_file():
            raise InputError("There is no such sound recording.", file=like, key="--like", expected="a file")
        from acino_fte.rig.recover import recover as run

        with spinner(quiet or as_json) as tell:
            found = run(damaged, out, like=like, fps=fps, tell=tell)
    if as_json:
        stdout.print_json(json.dumps(found.content()))
    elif not quiet:
        _show(found)


def _show(found: Recovery) -> None:
    """The account on the screen."""
    if not found.parts and not found.failed:
        _show_one(found)
        return
    for part in found.parts:
        _show_one(part)
        stdout.print()
    for file, why in found.failed:
        stdout.print(f"[bold red]{escape(file)}[/]: nothing could be saved: {escape(why)}")
    copies = sum(part.copy is not None for part in found.parts)
    sound = sum(part.whole for part in found.parts)
    stdout.print(
        f"[bold]{len(found.parts) + len(found.failed)} recordings[/]: {sound} whole, "
        f"{len(found.parts) - sound} rescued, {len(found.failed)} of which nothing could be saved"
    )
    if copies and found.copy is not None:
        stdout.print(f"copies in {escape(str(found.copy))}")


def _show_one(found: Recovery) -> None:
    state = "[bold green]whole[/]" if found.whole else "[bold yellow]damaged[/]"
    stdout.print(f"[bold]{escape(found.source.name)}[/]: {escape(found.form)}, {state}")
    width = max((len(stream.name) for stream in found.streams), default=0)
    for stream in found.streams:
        stdout.print(f"  {stream.name:<{width}}  {_line(stream)}", markup=False)
    if found.lost_elsewhere:
        what = _count(found.lost_elsewhere, "message is", "messages are")
        stdout.print(f"  {what} lost; of which stream is not known", markup=False)
    if found.notes:
        stdout.print("  what was found:" if not found.whole else "  to know:")
        for note in found.notes[:_NOTES]:
            stdout.print(f"    - {note}", markup=False)
        if len(found.notes) > _NOTES:
            stdout.print(f"    - and {len(found.notes) - _NOTES} more: the report has them")
    if found.whole and found.copy is None:
        stdout.print("Nothing is wrong with it, so no copy was made.")
    elif found.copy is not None:
        units = {_unit(stream) for stream in found.streams}
        unit = units.pop() if len(units) == 1 else "message"
        saved = f"{_count(found.saved, unit, f'{unit}s')}, {_length(found):.1f} s"
        stdout.print(f"[bold green]saved[/] to {escape(str(found.copy))}: {saved}")
        stdout.print(f"report: {escape(str(found.report))}; the original was not touched")


def _line(stream: SavedStream) -> str:
    saved = f"{_count(stream.saved, _unit(stream), f'{_unit(stream)}s')} saved ({stream.seconds:.1f} s)"
    if not stream.lost:
        return f"{saved}, none known to be lost"
    about = "" if stream.exact else "about "
    return f"{saved}, {about}{stream.lost:,} lost ({stream.lost_seconds:.1f} s)"


def _unit(stream: SavedStream) -> str:
    """What a stream is made of."""
    if "/" in stream.name:
        return "message"
    return "package" if stream.type.startswith("livox/") else "frame"


def _length(found: Recovery) -> float:
    return max((stream.seconds for stream in found.streams), default=0.0)


def _count(n: int, one: str, many: str) -> str:
    return f"{n:,} {one if n == 1 else many}"
