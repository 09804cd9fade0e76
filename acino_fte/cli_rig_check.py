"""``acino-fte rig check``: whether a recording will do, before the animal is gone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import EXIT_OTHER, reported_errors, spinner, stdout

if TYPE_CHECKING:
    from acino_fte.result_files import Contents
    from acino_fte.rig.check import Check

_COLOURS = {"pass": "green", "warn": "yellow", "fail": "red"}
_MARKS = {"pass": "ok", "warn": "!", "fail": "✗"}


def check(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING",
            help="A folder of the rig's recorder, LVX, a bag of ROS 1 or ROS 2, eCAL, or a video.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FOLDER", help="Also write check.html, timeline.png and check.json there."
        ),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write what was found as JSON.")
    ] = None,
    every_frame: Annotated[
        bool, typer.Option("--every-frame", help="Decode every picture of a video. Takes minutes.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier check there.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print only what is wrong.")] = False,
) -> None:
    """Say whether a recording will do: losses, clocks, sensors, pictures.

    Of a folder that the rig's recorder wrote it is also told whether what the
    recorder noted is what the data show. Nothing in the recording is changed.
    Leaves with 0 when it passes, with or without warnings; 1 when it fails, 2 when
    there is no recording.

    Example: acino-fte rig check cheetah-20260801-091500 -o checked
    """
    with reported_errors():
        folder = _target(out, recording, overwrite)
        from acino_fte.rig.check import check_recording

        with spinner(quiet) as tell:
            found = check_recording(recording, tell, every_frame=every_frame)
            if json_file is not None:
                from acino_fte.data_tools.whole_text import write_text_whole
                from acino_fte.rig.check_report import json_text

                write_text_whole(json_file, json_text(found))
            if folder is not None:
                tell("drawing")
                _write(found, folder)
    _show(found, quiet)
    for path in (json_file, folder):
        if path is not None and not quiet:
            stdout.print(f"written to {escape(str(path))}")
    raise typer.Exit(EXIT_OTHER if found.verdict == "fail" else 0)


def _target(out: Path | None, recording: Path, overwrite: bool) -> Path | None:
    """The checked output folder."""
    if out is None:
        return None
    from acino_fte.errors import InputError
    from acino_fte.result_files import check_output_folder

    apart = recording if recording.is_dir() else None
    folder = check_output_folder(out, input_folder=apart, contents=_contents())
    if folder.is_dir() and any(folder.iterdir()) and not overwrite:
        raise InputError(
            "There is a check already.",
            file=folder,
            remedy="choose another folder, or replace it with --overwrite",
        )
    return folder


def _contents() -> Contents:
    from acino_fte.result_files import Contents

    return Contents("check", ("check.json", "check.html", "timeline.png"), ("check.json",))


def _write(found: Check, folder: Path) -> None:
    from acino_fte.result_files import written_whole
    from acino_fte.rig.check_report import write_files

    with written_whole(folder, _contents()) as working:
        write_files(found, working)


def _show(found: Check, quiet: bool) -> None:
    """The screen: verdict, streams, what is wrong and what to do about it."""
    from acino_fte.rig.check_report import STREAM_HEAD, stream_row, summary

    bad = [one for one in found.requirements if one.verdict != "pass"]
    if not quiet:
        from rich.table import Table

        grid = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
        for i, name in enumerate(STREAM_HEAD):
            grid.add_column(name, justify="right" if i else "left", no_wrap=True)
        for stream in found.found.streams.values():
            grid.add_row(*(escape(text) for text in stream_row(stream)))
        stdout.print(grid)
        stdout.print()
    bad.sort(key=lambda one: one.verdict != "fail")
    for i, one in enumerate(bad):
        colour = _COLOURS[one.verdict]
        stdout.print(
            f"[bold {colour}]{_MARKS[one.verdict]} {escape(one.name)}[/] {escape(one.subject)}: "
            f"{escape(one.found)} [dim](limit: {escape(one.limit)})[/]"
        )
        again = i + 1 < len(bad) and bad[i + 1].remedy == one.remedy
        if one.remedy and not again:
            stdout.print(f"    {escape(one.remedy)}")
    wrong = {one.name for one in bad}
    good = list(dict.fromkeys(one.name for one in found.requirements if one.name not in wrong))
    if good and not quiet:
        stdout.print(f"[green]{_MARKS['pass']}[/] [dim]{escape(', '.join(good))}[/]")
    if not quiet or bad:
        stdout.print(f"[bold {_COLOURS[found.verdict]}]{escape(summary(found))}[/]")
