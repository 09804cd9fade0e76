"""The command ``acino-fte simulate``: make a recording with known truth."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape

from acino_fte.cli_common import reported_errors, stdout, warn

if TYPE_CHECKING:
    from acino_fte.simulation_options import SimulationOptions


class _CameraModel(StrEnum):
    fisheye = "fisheye"
    pinhole = "pinhole"


class _Layout(StrEnum):
    auto = "auto"
    sides = "sides"
    ring = "ring"


_Fraction = {"min": 0.0, "max": 1.0}
_MOVE, _VIEW, _FAULT, _FLAW = "Motion", "Cameras", "Detector", "Imperfections, to be estimated"


def simulate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The sequence folder to make.")],
    species: Annotated[
        str,
        typer.Option(help="A bundled species, or a species file (.yaml).", rich_help_panel=_MOVE),
    ] = "cheetah",
    motion: Annotated[
        str,
        typer.Option(
            help="gallop, flick, turn (cheetah), walk (human), wander or prior (any species). 'prior' draws "
            "from the prior that 'acino-fte run' estimates with.",
            rich_help_panel=_MOVE,
        ),
    ] = "gallop",
    frames: Annotated[int, typer.Option(min=1, help="Number of frames.", rich_help_panel=_MOVE)] = 120,
    fps: Annotated[float, typer.Option(min=1e-3, help="Frames per second.", rich_help_panel=_MOVE)] = 120.0,
    longest_path: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            help="Metres; a longer run is made as on a treadmill. By default three times the radius.",
            rich_help_panel=_MOVE,
        ),
    ] = None,
    noise_scale: Annotated[
        float,
        typer.Option(
            min=1e-6, help="Process noise of the motion 'prior', as in 'run'.", rich_help_panel=_MOVE
        ),
    ] = 1.0,
    prior_width: Annotated[
        float,
        typer.Option(
            min=1e-6,
            help="Width of the motion 'prior', in half ranges, as in 'run'; 0.25 stays inside the ranges.",
            rich_help_panel=_MOVE,
        ),
    ] = 0.25,
    cameras: Annotated[int, typer.Option(min=1, help="Number of cameras.", rich_help_panel=_VIEW)] = 6,
    layout: Annotated[
        _Layout,
        typer.Option(
            help="Cameras along both sides of the path, in a ring about it, or what suits its length.",
            rich_help_panel=_VIEW,
        ),
    ] = _Layout.auto,
    radius: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            help="Distance of the cameras from the path, m. By default 3.3 body lengths.",
            rich_help_panel=_VIEW,
        ),
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(help="Height of the cameras, m. By default 0.6 body lengths.", rich_help_panel=_VIEW),
    ] = None,
    camera_model: Annotated[
        _CameraModel,
        typer.Option(help="AcinoSet's wide action camera, or one without distortion.", rich_help_panel=_VIEW),
    ] = _CameraModel.fisheye,
    noise_px: Annotated[
        str,
        typer.Option(
            metavar="PX|species",
            help="Standard deviation of u and v, px, at least 0; 'species' takes each marker's sd_px.",
            rich_help_panel=_FAULT,
        ),
    ] = "2",
    missing: Annotated[
        float,
        typer.Option(**_Fraction, help="Fraction not detected, at random.", rich_help_panel=_FAULT),
    ] = 0.1,
    outliers: Annotated[
        float,
        typer.Option(**_Fraction, help="Fraction of the rest that is grossly wrong.", rich_help_panel=_FAULT),
    ] = 0.02,
    swaps: Annotated[
        float,
        typer.Option(
            **_Fraction,
            help="Fraction of images with left and right exchanged, of a limb or of the whole animal.",
            rich_help_panel=_FAULT,
        ),
    ] = 0.0,
    occlusion: Annotated[
        bool,
        typer.Option(help="Markers hidden by the body are guessed, not seen.", rich_help_panel=_FAULT),
    ] = True,
    quantise: Annotated[
        bool,
        typer.Option("--quantise", help="Round to DeepLabCut's grid, 8 k + 4 px.", rich_help_panel=_FAULT),
    ] = False,
    delay_ms: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1e4,
            help="Cameras but the first are triggered late or early, by at most this, ms.",
            rich_help_panel=_FLAW,
        ),
    ] = 0.0,
    moved_mm: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1e5,
            help="Cameras but the first have moved since calibration: standard deviation per axis, mm.",
            rich_help_panel=_FLAW,
        ),
    ] = 0.0,
    moved_deg: Annotated[
        float,
        typer.Option(
            min=0.0, max=45.0, help="The same of their turns, per axis, degrees.", rich_help_panel=_FLAW
        ),
    ] = 0.0,
    proportions: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            help="Standard deviation of the logarithm of each segment group's length; 0.05 is about 5 %.",
            rich_help_panel=_FLAW,
        ),
    ] = 0.0,
    offsets_mm: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1e3,
            help="Markers are found beside their place on the link: standard deviation per axis, mm.",
            rich_help_panel=_FLAW,
        ),
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same recording.")] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier simulation in OUT.")
    ] = False,
) -> None:
    """Make a recording with known truth: a species, a motion, cameras, and a detector with faults.

    Writes a sequence folder that 'acino-fte run' reads: detections, calibration, truth.
    """
    from acino_fte.simulate import simulate as run_simulation
    from acino_fte.simulation_files import check_target, write_simulation
    from acino_fte.simulation_options import SimulationOptions
    from acino_fte.skeleton import load_skeleton

    with reported_errors():
        check_target(out, overwrite=overwrite)
        options = SimulationOptions(
            motion=motion,
            n_frames=frames,
            fps=fps,
            n_cameras=cameras,
            camera_model=camera_model.value,
            layout=layout.value,
            radius=radius,
            height=height,
            longest_path=longest_path,
            noise_px=_parse_noise(noise_px),
            missing=missing,
            outliers=outliers,
            swaps=swaps,
            occlusion=occlusion,
            quantise=quantise,
            delay_ms=delay_ms,
            moved_mm=moved_mm,
            moved_deg=moved_deg,
            proportions=proportions,
            offsets_mm=offsets_mm,
            noise_scale=noise_scale,
            prior_width=prior_width,
            seed=seed,
        )
        simulation = run_simulation(load_skeleton(species), options)
        write_simulation(simulation, out, overwrite=overwrite, command=_command(out, species, options))
        for note in simulation.notes:
            warn(note)
        stdout.print(
            f"[bold]{escape(str(out))}[/]: {frames} frames, {cameras} cameras, "
            f"{len(simulation.skeleton.markers)} markers, truth"
        )


def _parse_noise(text: str) -> float | Literal["species"]:
    """A number of pixels, or ``"species"``."""
    from acino_fte.errors import InputError

    if text == "species":
        return "species"
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise InputError(
            "The noise is neither a number of pixels nor 'species'.",
            key="--noise-px",
            expected="a number from 0, or 'species'",
            found=text,
        )
    return value


def _command(out: Path, species: str, options: SimulationOptions) -> str:
    """The command line that makes the same recording again: everything that is not a default."""
    import shlex
    from dataclasses import fields

    flags = {"n_frames": "frames", "n_cameras": "cameras"}
    parts = ["python", "scripts/simulate.py", str(out), "--species", species]
    for option in fields(options):
        value = getattr(options, option.name)
        if option.name == "occlusion":
            parts += [] if value else ["--no-occlusion"]
        elif option.name == "quantise":
            parts += ["--quantise"] if value else []
        elif option.name in ("motion", "seed") or value != option.default:
            name = flags.get(option.name, option.name.replace("_", "-"))
            parts += [f"--{name}", str(value).removesuffix(".0")]
    return shlex.join(parts)
