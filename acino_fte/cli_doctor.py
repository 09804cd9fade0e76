"""The command ``acino-fte doctor``: does this computer have what is needed?"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import EXIT_OTHER, reported_errors, stdout
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acino_fte.doctor import Finding


class _Purpose(StrEnum):
    run = "run"
    lidar = "lidar"
    rig = "rig"


def doctor(
    purpose: Annotated[
        _Purpose,
        typer.Option(
            "--for",
            help="What must work: run (trajectories from 2D keypoints), lidar (camera and lidar, pages in "
            "the browser), rig (recording in the field).",
        ),
    ] = _Purpose.run,
    path: Annotated[
        Path,
        typer.Option(
            metavar="FOLDER",
            help="Where recordings or results go: its disk is tried with a temporary file of at most 67 MB.",
            show_default="the current folder",
        ),
    ] = Path(),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """Look whether this computer has what is needed, and say what to do where it has not.

    Takes a few seconds, and changes nothing. Leaves with 0 when all that matters works, 1 otherwise.

    Example: acino-fte doctor --for rig --path /media/recordings
    """
    with reported_errors():
        if not path.is_dir():
            found = "a file" if path.exists() else "nothing there"
            raise InputError(
                "The disk of this folder cannot be tried.",
                file=path,
                key="--path",
                expected="a folder",
                found=found,
            )
        from acino_fte.doctor import as_json as content_of
        from acino_fte.doctor import examine, ready

        if as_json:
            import json

            findings = list(examine(path))
            typer.echo(json.dumps(content_of(findings, purpose.value), indent=1))
        else:
            findings = _show(examine(path), purpose.value)
        if not ready(findings)[purpose.value]:
            raise typer.Exit(EXIT_OTHER)


_STYLES = {"ok": "green", "note": "yellow", "FAIL": "bold red", "--": "dim"}


def _show(coming: Iterator[Finding], purpose: str) -> list[Finding]:
    """One line a finding, its remedy below it, and the verdict; returns the findings."""
    from acino_fte.doctor import PURPOSES, all_checks, ready

    width = max(len(check.title) for check in all_checks())
    findings = []
    for f in coming:
        findings.append(f)
        mark = _mark(f, purpose)
        stdout.print(f"[{_STYLES[mark]}]{mark:<5}[/]{f.title:<{width}}  {escape(f.found)}")
        if f.remedy and (f.state == "failed" or mark == "note"):
            stdout.print(f"     {'':<{width}}  [dim]>[/] {escape(f.remedy)}")
    able = ready(findings)
    stdout.print("\n" + ", ".join(f"{name}: {'ready' if able[name] else 'not ready'}" for name in PURPOSES))
    if not able[purpose]:
        wrong = ", ".join(f.title for f in findings if f.stops(purpose))
        stdout.print(f"[bold red]not ready for {purpose}:[/] {escape(wrong)}")
    return findings


def _mark(finding: Finding, purpose: str) -> str:
    """The first word of a line; -- where the purpose can do without."""
    if finding.state == "failed":
        return "FAIL" if finding.stops(purpose) else "--"
    return finding.state if finding.state == "ok" or finding.concerns(purpose) else "--"
