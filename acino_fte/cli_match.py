"""The command ``acino-fte match``: which dot is which animal, over all views, and their tracks in 3D."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from acino_fte.cli_common import (
    EXIT_OTHER,
    Clock,
    chosen_formats,
    reported_errors,
    spinner,
    stderr,
    stdout,
    warn,
)
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.track_matching import MatchOptions, TrackMatches
    from acino_fte.data_tools.tracks2d import TrackRecording


class _Method(StrEnum):
    tracks = "tracks"
    thesis = "thesis"


class _Unit(StrEnum):
    m = "m"
    cm = "cm"
    mm = "mm"


_INPUT, _MATCHING, _THESIS, _OUTPUT = "Input", "Matching", "The thesis's method", "Output"


def match(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="A folder with the cameras (cameras.json, .toml, .xcp, dltCoefs.csv) and the 2D tracks of "
            "each (cam0.csv, cam1.csv … with frame, track, x, y; DLTdv xypts; TRex, idtracker.ai, SLEAP "
            "exports); or the file with the tracks of all cameras.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Result folder. [dim]\\[default: out/NAME][/]", rich_help_panel=_OUTPUT
        ),
    ] = None,
    cameras: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The camera file.", rich_help_panel=_INPUT)
    ] = None,
    tracks: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE|CAMERA=FILE",
            help="A file of tracks; once for each camera, or once for a file with all of them.",
            rich_help_panel=_INPUT,
            show_default=False,
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="True positions (frame, animal, x, y, z in m, or xyzpts), for scoring only. Truth that lies "
            "beside the tracks (truth_3d.csv, camN_truth.csv) is found without.",
            rich_help_panel=_INPUT,
        ),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(help="Frames per second of the recording.", rich_help_panel=_INPUT)
    ] = None,
    resolution: Annotated[
        str | None,
        typer.Option(
            metavar="WIDTHxHEIGHT",
            help="Size of the images, px: DLT coefficients do not say it.",
            rich_help_panel=_INPUT,
        ),
    ] = None,
    camera_unit: Annotated[
        _Unit, typer.Option(help="Unit of the positions in the camera file.", rich_help_panel=_INPUT)
    ] = _Unit.m,
    node: Annotated[
        str | None,
        typer.Option(
            help="Node of SLEAP's skeleton that stands for the animal.",
            rich_help_panel=_INPUT,
            show_default="mean of all",
        ),
    ] = None,
    cm_per_pixel: Annotated[
        float | None,
        typer.Option(help="TRex's setting, where its files do not say it.", rich_help_panel=_INPUT),
    ] = None,
    method: Annotated[
        _Method,
        typer.Option(
            help="Whole tracks decide (tracks), or the thesis's way, dot by dot, for comparison (thesis).",
            rich_help_panel=_MATCHING,
        ),
    ] = _Method.tracks,
    noise_px: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of a dot's coordinate, px.",
            rich_help_panel=_MATCHING,
            show_default="estimated",
        ),
    ] = None,
    max_gap: Annotated[
        float,
        typer.Option(
            help="Longest gap within a view across which a track is continued, s.", rich_help_panel=_MATCHING
        ),
    ] = 1.0,
    encounter: Annotated[
        float,
        typer.Option(
            help="Animals closer than this in a view, in standard deviations of the noise, may have been "
            "exchanged.",
            rich_help_panel=_MATCHING,
        ),
    ] = 4.0,
    bare: Annotated[
        bool,
        typer.Option(
            "--bare",
            help="Forget the tracks of the files; dots are joined to tracks anew.",
            rich_help_panel=_MATCHING,
        ),
    ] = False,
    follow: Annotated[
        bool,
        typer.Option(
            help="Follow animals in 3D: smooth paths, which drop wrong dots, claim loose ones and fill gaps.",
            rich_help_panel=_MATCHING,
        ),
    ] = True,
    min_confidence: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="Leave out less probable matches.", rich_help_panel=_MATCHING),
    ] = 0.5,
    sets: Annotated[
        int,
        typer.Option(
            min=1,
            max=3,
            help="1: epipolar lines; 2: and the Kalman forecast; 3: and a second run with the future.",
            rich_help_panel=_THESIS,
        ),
    ] = 2,
    gate_m: Annotated[
        float, typer.Option(help="Largest distance to the forecast, m.", rich_help_panel=_THESIS)
    ] = 0.3,
    gate_px: Annotated[
        float,
        typer.Option(help="Largest distance to the lines without a forecast, px.", rich_help_panel=_THESIS),
    ] = 50.0,
    min_estimates: Annotated[
        int, typer.Option(help="Estimates that a forecast needs.", rich_help_panel=_THESIS)
    ] = 5,
    window: Annotated[
        int, typer.Option(help="Frames that the filter looks back.", rich_help_panel=_THESIS)
    ] = 10,
    unchecked: Annotated[
        int,
        typer.Option(min=0, help="First rows of camera 1 that no gate judges.", rich_help_panel=_THESIS),
    ] = 11,
    fixed: Annotated[
        bool, typer.Option("--fixed", help="Mend the faults of its forecast.", rich_help_panel=_THESIS)
    ] = False,
    vote: Annotated[
        bool,
        typer.Option("--vote", help="Let whole tracks vote on their pairs.", rich_help_panel=_THESIS),
    ] = False,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMATS",
            help="Beside CSV: some of netcdf (movement), dltdv (xypts, xyzpts), with commas; or 'csv'.",
            rich_help_panel=_OUTPUT,
        ),
    ] = "netcdf,dltdv",
    figures: Annotated[
        bool, typer.Option(help="Draw figures and the report.", rich_help_panel=_OUTPUT)
    ] = True,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print errors and warnings only.", rich_help_panel=_OUTPUT)
    ] = False,
) -> None:
    """Find out which dot is which animal in all cameras of a FOLDER, and rebuild their 3D tracks.

    Writes observations.csv (the animal of every row of the input),
    tracks_3d.csv, matches.csv, metrics.json, the layouts of movement and
    DLTdv, figures and a report. Leaves with 0 when animals were matched, 2 when
    the input is wrong, 1 for anything else (and when nothing could be matched).

    Example: acino-fte match recording/ --fps 30 -o out/birds
    """
    with reported_errors():
        target = _target(folder, out)
        kinds = chosen_formats(formats, _known_formats())
        clock = Clock()
        with spinner(quiet) as show:

            def tell(step: str) -> None:
                clock.begin(step)
                show(step)

            tell("reading")
            from acino_fte.cli_match_input import TrackInput, read_recording

            if method is _Method.thesis:
                from acino_fte.data_tools.thesis_method import ThesisOptions

                options: Any = ThesisOptions(
                    sets=sets,
                    gate_m=gate_m,
                    gate_px=gate_px,
                    min_estimates=min_estimates,
                    window=window,
                    unchecked=unchecked,
                    fixed=fixed,
                    vote=vote,
                )
            else:
                options = _match_options(noise_px, max_gap, encounter, bare, follow, min_confidence)
            recording = read_recording(
                folder,
                TrackInput(
                    cameras, tracks or [], truth, fps, resolution, camera_unit.value, node, cm_per_pixel
                ),
            )
            for message in recording.warnings:
                warn(message)
            matches = _match(recording, options, bare, tell)
            clock.end()
            from acino_fte.data_tools.match_files import save_matches

            metrics = save_matches(
                matches,
                target,
                method={"method": method.value, "options": asdict(options)},
                seconds=clock.seconds,
                formats=kinds,
                figures=figures,
                tell=show,
            )
        for message in metrics["warnings"][len(recording.warnings) :]:
            warn(message)
        if not quiet:
            from acino_fte.data_tools.match_numbers import summary

            for line in summary(metrics):
                stdout.print(line, markup=False)
            stdout.print(f"written to {escape(str(target))}")
    if not metrics["n_animals"]:
        stderr.print(
            "[bold yellow]nothing was matched[/]: check that the camera file belongs to the tracks, that the "
            "frames of all cameras have one clock, and --noise-px"
        )
        raise typer.Exit(EXIT_OTHER)


def _target(folder: Path, out: Path | None) -> Path:
    """The output folder, apart from the input."""
    from acino_fte.data_tools.match_files import MATCHING
    from acino_fte.result_files import check_output_folder

    name = folder.resolve().stem if folder.is_file() else folder.resolve().name
    out = out or Path("out") / (name or "matching")
    return check_output_folder(out, input_folder=folder if folder.exists() else None, contents=MATCHING)


def _known_formats() -> tuple[str, ...]:
    from acino_fte.data_tools.match_files import FORMATS

    return FORMATS


def _match_options(
    noise_px: float | None,
    max_gap: float,
    encounter: float,
    bare: bool,
    follow: bool,
    min_confidence: float,
) -> MatchOptions:
    from acino_fte.data_tools.track_matching import MatchOptions

    for key, value in (("--noise-px", noise_px), ("--max-gap", max_gap), ("--encounter", encounter)):
        if value is not None and not 0 < value < float("inf"):
            raise InputError("The option is impossible.", key=key, expected="above 0", found=f"{value:g}")
    return MatchOptions(
        noise_px=noise_px,
        max_gap_s=max_gap,
        encounter=encounter,
        tracks=not bare,
        follow=follow,
        min_confidence=min_confidence,
    )


def _match(recording: TrackRecording, options: Any, bare: bool, tell: Callable[[str], None]) -> TrackMatches:
    from acino_fte.data_tools.track_matching import MatchOptions, match_tracks

    if isinstance(options, MatchOptions):
        return match_tracks(recording, options, tell)
    from acino_fte.data_tools.match_methods import thesis_matches

    if not bare:
        return thesis_matches(recording, options, tell)
    views = tuple(view.without_tracks() for view in recording.views)
    return replace(thesis_matches(replace(recording, views=views), options, tell), recording=recording)
