"""The command ``acino-fte rig plan``: what a rig will do, before the trip."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from acino_fte.cli_common import reported_errors, stdout
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.rig.plan import RigPlan
    from acino_fte.rig.plan_tables import Table
    from acino_fte.rig.rig_file import RigFile

_CHANGE = "Other than in the file"
_COLOURS = {"pass": "green", "tight": "yellow", "fail": "bold red", "by test": "cyan"}
_WORDS = {"change": "bold red", "tight": "yellow", "test": "cyan"}


class _Codec(StrEnum):
    h264 = "h264"
    raw = "raw"


class _Returns(StrEnum):
    single = "single"
    dual = "dual"


def _change(text: str, metavar: str | None = None) -> Any:
    return typer.Option(help=text, metavar=metavar, rich_help_panel=_CHANGE, show_default=False)


def plan(
    rig: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RIG]",
            help="A rig.yaml, or its folder. [dim]\\[default: rig.yaml here, else the WildPose rig][/]",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FOLDER", help="Also write tables, JSON and figures there."),
    ] = None,
    init: Annotated[
        bool, typer.Option("--init", help="Write a rig.yaml with comments to start from, and leave.")
    ] = False,
    focal: Annotated[float | None, _change("Focal length, mm.", "MM")] = None,
    distance: Annotated[
        float | None, _change("Of the animal, m; in focus there too, unless --focus is given.", "M")
    ] = None,
    focus: Annotated[float | None, _change("Distance in focus, m.", "M")] = None,
    f_number: Annotated[float | None, _change("Aperture: 4 is f/4.", "N")] = None,
    exposure: Annotated[float | None, _change("Exposure, µs.", "µs")] = None,
    fps: Annotated[float | None, _change("Images a second.", "HZ")] = None,
    codec: Annotated[_Codec | None, _change("Of the video.")] = None,
    bitrate: Annotated[float | None, _change("Of H.264 video, Mbit/s.", "MBIT")] = None,
    returns: Annotated[_Returns | None, _change("Of the lidar.")] = None,
    capacity: Annotated[float | None, _change("Of the disk, GB.", "GB")] = None,
    animal: Annotated[float | None, _change("Length of the animal, m.", "M")] = None,
) -> None:
    """Work out what a rig will do, before the trip.

    Pixels on the animal, fields of view of camera and lidar, sharpness, motion blur,
    lidar points, storage and memory; every requirement with its margin, and what to
    change where one fails. Needs no file: without one it plans the WildPose rig.
    Leaves with 0 when there is a plan, whatever it says, and with 2 when the input is wrong.

    Example: acino-fte rig plan --distance 60 --focal 75 -o plan
    """
    with reported_errors():
        from acino_fte.rig.plan_changes import PlanChanges, changed_rig
        from acino_fte.rig.rig_file import RigFile
        from acino_fte.rig.rig_read import find_rig_file, read_rig

        changes = PlanChanges(
            focal_mm=focal,
            distance_m=distance,
            focus_m=focus,
            f_number=f_number,
            exposure_us=exposure,
            fps=fps,
            codec=codec.value if codec else None,
            bitrate_mbit=bitrate,
            returns=returns.value if returns else None,
            capacity_gb=capacity,
            animal_m=animal,
        )
        if init:
            if out is not None:
                raise InputError(
                    "--init writes a rig file, not a plan.",
                    key="--out",
                    remedy="name the file instead: acino-fte rig plan my_rig.yaml --init",
                )
            _init(rig, changed_rig(RigFile(), changes))
            return
        file = find_rig_file(rig)
        chosen = changed_rig(read_rig(file) if file else RigFile(), changes)
        _plan(chosen, file, out)


def _init(path: Path | None, rig: RigFile) -> None:
    from acino_fte.rig.rig_file import FILE_NAME
    from acino_fte.rig.rig_read import write_rig

    target = path or Path(FILE_NAME)
    if target.is_dir():
        target = target / FILE_NAME
    if target.exists():
        raise InputError(
            "There is a file of that name, which would be lost.",
            file=target,
            remedy="name another one: acino-fte rig plan other.yaml --init",
        )
    write_rig(target, rig)
    stdout.print(
        f"written to {escape(str(target))}; change it, then: acino-fte rig plan {escape(str(target))}"
    )


def _plan(rig: RigFile, file: Path | None, out: Path | None) -> None:
    from acino_fte.rig.plan import plan_rig

    result = plan_rig(rig)
    source = str(file) if file else "the rig of WildPose: there is no rig.yaml here"
    if out is None:
        _show(result, source)
        return
    from acino_fte.result_files import Contents, check_output_folder, written_whole
    from acino_fte.rig.plan_files import FILES, write_plan

    contents = Contents("plan of a rig", FILES, ("plan.json", "plan.md"))
    target = check_output_folder(out, contents=contents)
    if file is not None and file.resolve().parent == target:
        raise InputError(
            "The output folder holds the rig file that is read.",
            file=target,
            remedy="choose another folder with -o",
        )
    _show(result, source)
    try:
        with written_whole(target, contents) as working:
            write_plan(result, working)
    except OSError as error:
        raise InputError(
            "The folder cannot be written; what was there before is still there.",
            file=target,
            found=error.strerror or str(error),
            remedy="free some space, or choose another folder with -o",
        ) from None
    stdout.print(f"written to {escape(str(target))}")


def _show(result: RigPlan, source: str) -> None:
    """One screen: requirements, what to change, what follows, storage."""
    from acino_fte.rig.plan_tables import facts, remarks, settings, short_storage_table, verdict_table
    from acino_fte.rig.plan_verdicts import verdicts

    found = verdicts(result)
    stdout.print(f"[bold]Plan of {escape(result.rig.name)}[/] [dim]({escape(source)})[/]")
    for name in result.rig.cameras:
        stdout.print(settings(result, name), markup=False, style="dim")
    _print_table(verdict_table(found))
    for word, key, text in remarks(found):
        stdout.print(f"[{_WORDS[word]}]{word:<8}[/]{key:<5}{escape(text)}")
    stdout.print()
    lines = facts(result)
    left = max(len(name) for name, _ in lines) + 2
    for name, line in lines:
        stdout.print(f"{name:<{left}}{line}", markup=False)
    _print_table(short_storage_table(result))


def _print_table(table: Table) -> None:
    from rich.table import Table as Grid

    grid = Grid(box=None, pad_edge=False, header_style="bold")
    for head in table.heads:
        grid.add_column(head)
    for row in table.rows:
        colour = _COLOURS.get(row[-1], "")
        last = f"[{colour}]{row[-1]}[/]" if colour else escape(row[-1])
        grid.add_row(*(escape(cell) for cell in row[:-1]), last)
    stdout.print()
    stdout.print(grid, soft_wrap=False)
    stdout.print()
