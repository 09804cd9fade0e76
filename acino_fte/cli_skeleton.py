"""The command ``acino-fte skeleton``: look at, check and start species files."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import EXIT_INPUT, reported_errors, stdout

if TYPE_CHECKING:
    from acino_fte.skeleton_check import Finding

app = typer.Typer(
    help="Species: list, show, check and start skeleton files.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_show_locals=False,
)

_Species = Annotated[
    str, typer.Argument(metavar="SPECIES|FILE", help="A bundled species by name, or a species file (.yaml).")
]


class Pose(StrEnum):
    """Pose of the picture."""

    neutral = "neutral"
    middle = "middle"


@app.command("list")
def list_species() -> None:
    """List the species that come with the toolkit."""
    from textwrap import shorten

    from rich.table import Table

    from acino_fte.models import species_names
    from acino_fte.skeleton import load_skeleton

    with reported_errors():
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("species", no_wrap=True)
        table.add_column("DOFs", justify="right")
        table.add_column("markers", justify="right")
        table.add_column("source")
        for name in species_names():
            skeleton = load_skeleton(name)
            counts = (str(len(skeleton.dofs)), str(len(skeleton.markers)))
            table.add_row(name, *counts, escape(shorten(skeleton.source, 150, placeholder=" ...")))
        stdout.print(table, soft_wrap=False)


@app.command()
def check(
    species: _Species,
    keypoints: Annotated[
        Path | None,
        typer.Option("--keypoints", metavar="FILE", help="A DeepLabCut CSV or H5 whose names should fit."),
    ] = None,
) -> None:
    """Check a species file: typos, loops, clashes, unused links, degrees of freedom that nothing observes.

    Leaves with exit code 2 when there are errors, 0 when there are none (warnings allowed).
    """
    from acino_fte.skeleton import load_skeleton
    from acino_fte.skeleton_check import check_skeleton, match_keypoints

    with reported_errors():
        findings = check_skeleton(species, keypoints)
        errors = sum(finding.severity == "error" for finding in findings)
        if keypoints is not None and not errors:
            for name, marker in match_keypoints(load_skeleton(species), keypoints).matched.items():
                stdout.print(f"keypoint {escape(name)} is marker {escape(marker)}")
        for finding in findings:
            _print_finding(finding)
        if errors:
            stdout.print(f"[bold red]{escape(species)}: {_counted(findings)}[/]")
            raise typer.Exit(EXIT_INPUT)
        skeleton = load_skeleton(species)
        verdict = f"{_counted(findings)}" if findings else "sound"
        stdout.print(
            f"[bold green]{escape(species)}: {verdict}[/] "
            f"({len(skeleton.dofs)} degrees of freedom, {len(skeleton.markers)} markers)"
        )


def _print_finding(finding: Finding) -> None:
    colour = "red" if finding.severity == "error" else "yellow"
    stdout.print(f"[bold {colour}]{finding.severity}[/] {escape(finding.where)}")
    stdout.print(f"  {escape(finding.message)}")
    if finding.remedy:
        stdout.print(f"  [dim]remedy: {escape(finding.remedy)}[/]")


def _counted(findings: list[Finding]) -> str:
    parts = []
    for severity in ("error", "warning"):
        count = sum(finding.severity == severity for finding in findings)
        if count:
            parts.append(f"{count} {severity}{'s' if count > 1 else ''}")
    return ", ".join(parts)


@app.command()
def show(
    species: _Species,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="PICTURE",
            help="Where the picture goes (.png, .pdf or .svg); by default SPECIES_skeleton.png here.",
        ),
    ] = None,
    picture: Annotated[bool, typer.Option("--picture/--no-picture", help="Write a picture.")] = True,
    pose: Annotated[
        Pose, typer.Option(help="neutral: all angles zero; middle: the middle of every range.")
    ] = Pose.neutral,
) -> None:
    """Print the tree of links, degrees of freedom and markers, and write a picture."""
    from acino_fte.skeleton import load_skeleton
    from acino_fte.skeleton_show import skeleton_tree

    with reported_errors():
        skeleton = load_skeleton(species)
        stdout.print(skeleton_tree(skeleton))
        if skeleton.source:
            stdout.print(f"source: {escape(skeleton.source.strip())}")
        if picture:
            from acino_fte.skeleton_draw import middle_pose, neutral_pose, save_skeleton_picture

            path = output or Path(f"{skeleton.name}_skeleton.png")
            values = neutral_pose(skeleton) if pose is Pose.neutral else middle_pose(skeleton)
            save_skeleton_picture(skeleton, path, values)
            stdout.print(f"picture: {escape(str(path))}")


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="Name of the species, such as red_fox.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE", help="Where it goes; by default NAME.yaml here."),
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(
            "--like", metavar="SPECIES|FILE", help="Copy this species instead of the small starter."
        ),
    ] = None,
) -> None:
    """Write a commented species file of a quadruped to start from. Never overwrites a file."""
    from acino_fte.species_starter import write_starter

    with reported_errors():
        path = output or Path(f"{name}.yaml")
        write_starter(name, path, like)
        stdout.print(f"wrote {escape(str(path))}")
        stdout.print(f"next: edit it, then acino-fte skeleton check {escape(str(path))}")


@app.command()
def schema(
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE", help="Write it there instead of printing it."),
    ] = None,
) -> None:
    """Print the JSON Schema of species files, for completion and checks in an editor."""
    import json

    from acino_fte.errors import InputError
    from acino_fte.species_file import json_schema

    with reported_errors():
        text = json.dumps(json_schema(), indent=2, ensure_ascii=False)
        if output is None:
            typer.echo(text)
            return
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            output.write_text(text + "\n", encoding="utf-8")
        except OSError as error:
            raise InputError("The schema cannot be written.", file=output, found=error.strerror) from None
        stdout.print(f"wrote {escape(str(output))}")
