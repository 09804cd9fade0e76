"""The command ``acino-fte histograms``: figures and tables of errors and adjustments, for a set of runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import reported_errors, spinner, stdout, warn
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.evaluation_runs import Run
    from acino_fte.evaluation_statistics import Errors, Moves, Threshold

_INPUT, _OUTPUT = "Input", "Output"


def histograms(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Result folders of acino-fte run.", show_default=False),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for tables and figures.", rich_help_panel=_OUTPUT)
    ] = Path("out/histograms"),
    labels: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[RUN:]CAMERA=CSV|FOLDER",
            help="Labels by hand of one camera (DeepLabCut's CollectedData, or columns frame, marker, u, v), "
            "or a folder with CAMERA.csv. As often as needed. Without any, the run's own detections count.",
            rich_help_panel=_INPUT,
            show_default=False,
        ),
    ] = None,
    adjustments: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="JSON",
            help="File of acino-fte adjust; it knows its run. As often as needed.",
            rich_help_panel=_INPUT,
            show_default=False,
        ),
    ] = None,
    threshold_px: Annotated[
        float | None,
        typer.Option(
            help="Errors beyond this many px are outliers.", rich_help_panel=_INPUT, show_default="20"
        ),
    ] = None,
    threshold_sd: Annotated[
        float | None,
        typer.Option(
            help="Or: beyond this many standard deviations of the marker (sd_px of the species).",
            rich_help_panel=_INPUT,
        ),
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw figures.", rich_help_panel=_OUTPUT)] = True,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print errors and warnings only.", rich_help_panel=_OUTPUT)
    ] = False,
) -> None:
    """Compare runs with labels and adjustments by hand: histograms and tables.

    Writes reprojection, adjustments and depth (what there is) as CSV, Markdown and
    LaTeX, a row for a run, a body part and a marker, and figures as PNG and PDF.
    Leaves with 0, and with 2 when the input is wrong.

    Example: acino-fte histograms out/day1 out/day2 --labels day1:cam1=labels.csv
    """
    from acino_fte.evaluation_files import EVALUATION, save_evaluation
    from acino_fte.evaluation_tables import plain
    from acino_fte.result_files import check_output_folder

    with reported_errors(), spinner(quiet) as show:
        for run in runs:
            check_output_folder(out, input_folder=run if run.is_dir() else None, contents=EVALUATION)
        folder = check_output_folder(out, contents=EVALUATION)
        threshold = _threshold(threshold_px, threshold_sd)
        show("reading")
        errors, moves, notes = evaluated(runs, labels or [], adjustments or [])
        show("writing")
        tables = save_evaluation(errors, threshold, moves, notes, folder, figures=figures)
    for e in errors:
        if not e.run.converged:
            warn(f"{e.run.name} did not converge ({e.run.metrics['status']})")
    for note in notes:
        warn(note)
    if not quiet:
        for table in tables:
            for line in plain(table):
                stdout.print(line, markup=False)
        stdout.print(f"written to {escape(str(folder))}")


def evaluated(
    folders: list[Path], labels: list[str], adjustments: list[Path]
) -> tuple[list[Errors], list[Moves], list[str]]:
    """Errors of every run, adjustments of those that have some, and what was left out."""
    from acino_fte.evaluation_labels import label_pixels, labels_of_runs
    from acino_fte.evaluation_runs import open_runs
    from acino_fte.evaluation_statistics import errors_of

    runs = open_runs(folders)
    files = labels_of_runs(labels, runs)
    errors, notes = [], []
    for run in runs:
        pixels = None
        if run.name in files:
            pixels, left_out = label_pixels(run, files[run.name])
            notes += left_out
        elif files:
            notes.append(f"{run.name}: no labels; the detections that the run used count instead")
        errors.append(errors_of(run, pixels))
    moves = _moves(adjustments, runs)
    notes += [
        f"{m.run.name}: {m.n_placed} markers placed by hand, without a length" for m in moves if m.n_placed
    ]
    return errors, moves, notes


def _moves(paths: list[Path], runs: list[Run]) -> list[Moves]:
    """Adjustments in the order of the runs."""
    from acino_fte.adjust_files import read_adjustments

    found: dict[str, Moves] = {}
    for path in paths:
        moves = read_adjustments(path, runs).moves()
        if moves.run.name in found:
            raise InputError(
                "Two files of adjustments belong to one run.",
                file=path,
                key="--adjustments",
                expected="one file for a run",
                found=f"a second one of '{moves.run.name}'",
                remedy="leave one of them out",
            )
        found[moves.run.name] = moves
    return [found[run.name] for run in runs if run.name in found]


def _threshold(pixels: float | None, sd: float | None) -> Threshold:
    from acino_fte.evaluation_statistics import Threshold

    if pixels is not None and sd is not None:
        raise InputError(
            "There are two thresholds for outliers.",
            key="--threshold-px, --threshold-sd",
            expected="one of them",
            found=f"{pixels:g} px and {sd:g} sd",
        )
    return Threshold(sd, "sd") if sd is not None else Threshold(20.0 if pixels is None else pixels)
