"""The command ``acino-fte scene``: 3D tracks of animals that moving cameras saw, from a COLMAP model."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

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
from acino_fte.cli_scene_input import SceneOptions, positive, rig_choice, triangulated


class _Origin(StrEnum):
    centre = "centre"
    corner = "corner"


_INPUT, _CAMERAS, _WORLD, _TRACKS, _OUTPUT = "Input", "Cameras", "World", "Tracks", "Output"


def scene(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="A folder with a COLMAP model (sparse/, sparse/0/ or the folder itself; text or binary) and "
            "the 2D tracks of each camera in tracks/ (MultiViewTracks, CSV, TRex, SLEAP, idtracker.ai).",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Result folder. [dim]\\[default: out/NAME][/]", rich_help_panel=_OUTPUT
        ),
    ] = None,
    tracks: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|PATH",
            help="Folder of the 2D tracks, in FOLDER or anywhere.",
            rich_help_panel=_INPUT,
            show_default="tracks",
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH", help="The COLMAP model, where it is not in FOLDER.", rich_help_panel=_INPUT
        ),
    ] = None,
    pattern: Annotated[
        str | None,
        typer.Option(
            help="How image names give camera and frame, as '{camera}/{frame}.png'.",
            rich_help_panel=_INPUT,
            show_default="CAMERA_000123.jpg, CAMERA/000123.png",
        ),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(help="Frames per second of the recording.", rich_help_panel=_INPUT)
    ] = None,
    pixel_origin: Annotated[
        _Origin | None,
        typer.Option(
            help="Do the tracks' pixels count from the centre of the first pixel (OpenCV, most trackers) or "
            "from its corner (COLMAP)?",
            rich_help_panel=_INPUT,
            show_default="centre",
        ),
    ] = None,
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
    dense: Annotated[
        Path | None,
        typer.Option(
            metavar="PLY", help="A dense cloud to show instead of the model's points.", rich_help_panel=_INPUT
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="True positions (frame, individual, x, y, z in m), for scoring only, after alignment.",
            rich_help_panel=_INPUT,
        ),
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option(
            metavar="auto|none|NAME,NAME,…",
            help="Cameras that one body carries: found by themselves, none, or these (apart with semicolons "
            "for several bodies). A rig's path is better than that of each camera.",
            rich_help_panel=_CAMERAS,
            show_default="auto",
        ),
    ] = None,
    max_pose_gap: Annotated[
        str | None,
        typer.Option(
            metavar="FRAMES|SECONDSs",
            help="Longest gap between key frames in which a camera's path is believed: 40, or 1.5s.",
            rich_help_panel=_CAMERAS,
            show_default="from the key frames",
        ),
    ] = None,
    time_offsets: Annotated[
        bool,
        typer.Option("--time-offsets", help="Estimate offsets between the clocks.", rich_help_panel=_CAMERAS),
    ] = False,
    adjust_poses: Annotated[
        bool,
        typer.Option(
            "--adjust-poses",
            help="Move poses that no bundle adjustment left (from GPS, or resection alone) to where the "
            "model's own observations have them.",
            rich_help_panel=_CAMERAS,
        ),
    ] = False,
    scale: Annotated[
        list[str] | None,
        typer.Option(
            metavar="A-B=LENGTH",
            help="A known distance, in m, of two cameras (1-3=0.6, left:right=60cm+-2mm) or of two "
            "individuals (tracks:0-1=0.5). As often as there are some.",
            rich_help_panel=_WORLD,
            show_default=False,
        ),
    ] = None,
    gravity: Annotated[
        str | None,
        typer.Option(
            metavar="cameras|plane|down|none|FILE",
            help="What says where up is: the cameras' paths and images, a plane through the cloud, cameras "
            "that look down, nothing, or a camera's accelerometer in a CSV file.",
            rich_help_panel=_WORLD,
            show_default="cameras",
        ),
    ] = None,
    smooth: Annotated[
        bool,
        typer.Option(
            "--smooth/--no-smooth",
            help="Most probable paths, or points frame by frame.",
            rich_help_panel=_TRACKS,
        ),
    ] = True,
    max_gap: Annotated[
        str | None,
        typer.Option(
            metavar="FRAMES|SECONDSs",
            help="Longest gap of an individual that is filled: 30, or 1s.",
            rich_help_panel=_TRACKS,
            show_default="1s, or 30 without a frame rate",
        ),
    ] = None,
    noise_px: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of a dot's coordinate, px.",
            rich_help_panel=_TRACKS,
            show_default="estimated",
        ),
    ] = None,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMATS",
            help="Beside CSV: some of netcdf (movement), ply, with commas; or 'csv'.",
            rich_help_panel=_OUTPUT,
        ),
    ] = "netcdf,ply",
    figures: Annotated[
        bool, typer.Option(help="Draw figures and the report.", rich_help_panel=_OUTPUT)
    ] = True,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print errors and warnings only.", rich_help_panel=_OUTPUT)
    ] = False,
) -> None:
    """Rebuild 3D tracks of animals in moving cameras from a COLMAP model and 2D tracks.

    Writes tracks_3d.csv (metres, upright, with standard deviations),
    observations.csv, camera_paths.csv, metrics.json, the layouts of movement and
    PLY, figures and a report that turns in the browser. Leaves with 0 when there
    are tracks, 2 when the input is wrong, 1 for anything else (and when nothing
    could be triangulated).

    Example: acino-fte scene recording/ --scale 1-3=0.6 -o out/wand
    """
    with reported_errors(), _uncollected(), ExitStack() as stack:
        target = _target(folder, out)
        kinds = chosen_formats(formats, _known_formats())
        given = SceneOptions(
            tracks=tracks,
            model=model,
            pattern=pattern,
            fps=positive("--fps", fps),
            pixel_origin=None if pixel_origin is None else pixel_origin.value,
            node=node,
            cm_per_pixel=positive("--cm-per-pixel", cm_per_pixel),
            dense=dense,
            rig=rig_choice(rig),
            max_pose_gap=max_pose_gap,
            time_offsets=time_offsets or None,
            adjust_poses=adjust_poses,
            scale=tuple(scale) if scale else None,
            gravity=gravity,
            smooth=smooth,
            max_gap=max_gap,
            noise_px=positive("--noise-px", noise_px),
        ).completed(folder)
        artist: Any = False
        if figures:
            from acino_fte.data_tools.scene_drawing import FigureProcess

            artist = stack.enter_context(FigureProcess())  # imports matplotlib while the scene is read
        clock = Clock()
        show = stack.enter_context(spinner(quiet))

        def tell(step: str) -> None:
            clock.begin(step)
            show(step)

        tell("reading")
        true = _truth(truth)
        result = triangulated(folder, given, tell)
        clock.end()
        from acino_fte.data_tools.scene_files import save_scene

        metrics = save_scene(
            result,
            target,
            options=asdict(given),
            truth=true,
            seconds=clock.seconds,
            formats=kinds,
            figures=artist,
            tell=show,
        )
    for message in metrics["warnings"]:
        warn(message)
    if not quiet:
        from acino_fte.data_tools.scene_numbers import summary

        for line in summary(metrics):
            stdout.print(line, markup=False)
        stdout.print(f"written to {escape(str(target))}")
    if not metrics["n_points"]["all"]:
        stderr.print(
            "[bold yellow]nothing was triangulated[/]: check that tracks and images count the same frames, "
            "and that two cameras see one individual at one time"
        )
        raise typer.Exit(EXIT_OTHER)


@contextmanager
def _uncollected() -> Iterator[None]:
    """No garbage collection meanwhile: it takes a twentieth of the time and finds next to nothing."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _truth(path: Path | None) -> Any:
    if path is None:
        return None
    from acino_fte.data_tools.scene_truth import read_truth

    return read_truth(path)


def _target(folder: Path, out: Path | None) -> Path:
    """The output folder, apart from the input."""
    from acino_fte.data_tools.scene_files import SCENE
    from acino_fte.result_files import check_output_folder

    out = out or Path("out") / (folder.resolve().name or "scene")
    return check_output_folder(out, input_folder=folder if folder.exists() else None, contents=SCENE)


def _known_formats() -> tuple[str, ...]:
    from acino_fte.data_tools.scene_files import FORMATS

    return FORMATS
