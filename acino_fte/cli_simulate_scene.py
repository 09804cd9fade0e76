"""The command ``acino-fte simulate-scene``: moving cameras, tracks and a COLMAP model with known truth."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import reported_errors, stdout

if TYPE_CHECKING:
    from acino_fte.data_tools.simulate_scene import SceneSimulation


class _Path(StrEnum):
    survey = "survey"
    orbit = "orbit"
    walk = "walk"


class _Formation(StrEnum):
    rig = "rig"
    free = "free"
    fixed = "fixed"


class _Layout(StrEnum):
    prefix = "prefix"
    folder = "folder"


_Fraction = {"min": 0.0, "max": 1.0}
_VIEW, _MODEL, _TRACK = "Cameras", "Structure from motion", "Individuals and their tracks"


def simulate_scene(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The scene folder to make.")],
    frames: Annotated[int, typer.Option(min=1, help="Frames of every camera.", rich_help_panel=_VIEW)] = 600,
    fps: Annotated[float, typer.Option(min=1e-3, help="Frames per second.", rich_help_panel=_VIEW)] = 30.0,
    path: Annotated[
        _Path,
        typer.Option(
            help="Back and forth over a field, looking down; around something; or along with it.",
            rich_help_panel=_VIEW,
        ),
    ] = _Path.survey,
    formation: Annotated[
        _Formation,
        typer.Option(help="One rigid body, each carried on its own, or tripods.", rich_help_panel=_VIEW),
    ] = _Formation.rig,
    cameras: Annotated[int, typer.Option(min=1, help="Number of cameras.", rich_help_panel=_VIEW)] = 4,
    distance: Annotated[
        float, typer.Option(min=1e-3, help="From what they look at, m.", rich_help_panel=_VIEW)
    ] = 2.7,
    lane: Annotated[
        float, typer.Option(min=0.1, help="Length of a survey's lanes, m.", rich_help_panel=_VIEW)
    ] = 4.0,
    rig_side: Annotated[
        float, typer.Option(min=1e-3, help="Between neighbours in the rig, m.", rich_help_panel=_VIEW)
    ] = 0.6,
    lens: Annotated[
        str,
        typer.Option(
            metavar="MODEL[,MODEL…]",
            help="COLMAP's camera model, one for all cameras or one for each: OPENCV, OPENCV_FISHEYE, …",
            rich_help_panel=_VIEW,
        ),
    ] = "OPENCV",
    shared_lens: Annotated[
        bool,
        typer.Option("--shared-lens", help="One camera of the model for all images.", rich_help_panel=_VIEW),
    ] = False,
    clock_offset: Annotated[
        str,
        typer.Option(
            metavar="FRAMES,…", help="How late each camera's frame 0 is; empty: 0.", rich_help_panel=_VIEW
        ),
    ] = "",
    clock_drift: Annotated[
        str,
        typer.Option(
            metavar="RATE,…", help="How fast each clock gains, frames per frame.", rich_help_panel=_VIEW
        ),
    ] = "",
    key_step: Annotated[
        int, typer.Option(min=1, help="Every so many frames are in the model.", rich_help_panel=_MODEL)
    ] = 8,
    unregistered: Annotated[
        float,
        typer.Option(**_Fraction, help="Share of key frames that it misses.", rich_help_panel=_MODEL),
    ] = 0.03,
    centre_noise_mm: Annotated[
        float,
        typer.Option(min=0.0, help="Error of a pose's centre, each axis, mm.", rich_help_panel=_MODEL),
    ] = 2.0,
    turn_noise: Annotated[
        float,
        typer.Option(min=0.0, help="Error of a pose's turn, each axis, degrees.", rich_help_panel=_MODEL),
    ] = 0.03,
    resection: Annotated[
        bool,
        typer.Option(
            "--resection",
            help="Errors of the poses come from the noise of the landmarks instead.",
            rich_help_panel=_MODEL,
        ),
    ] = False,
    landmarks: Annotated[int, typer.Option(min=0, help="Points of the model.", rich_help_panel=_MODEL)] = 600,
    gauge: Annotated[
        bool,
        typer.Option(help="The model's world is turned, moved and scaled at random.", rich_help_panel=_MODEL),
    ] = True,
    layout: Annotated[
        _Layout,
        typer.Option(help="Images cam0_000008.jpg, or cam0/000008.jpg.", rich_help_panel=_MODEL),
    ] = _Layout.prefix,
    wand: Annotated[
        float, typer.Option(min=0.0, help="Length of a tracked stick, m; 0: none.", rich_help_panel=_TRACK)
    ] = 0.5,
    animals: Annotated[int, typer.Option(min=0, help="Number of animals.", rich_help_panel=_TRACK)] = 1,
    noise_px: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation of x and y, px.", rich_help_panel=_TRACK)
    ] = 1.0,
    missed: Annotated[
        float, typer.Option(**_Fraction, help="Share that is missed, in bursts.", rich_help_panel=_TRACK)
    ] = 0.3,
    outliers: Annotated[
        float, typer.Option(**_Fraction, help="Share that is 20–150 px off.", rich_help_panel=_TRACK)
    ] = 0.0,
    swaps: Annotated[
        int,
        typer.Option(
            min=0, help="Times that two exchange their names, in each camera.", rich_help_panel=_TRACK
        ),
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same scene.")] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier simulation in OUT.")
    ] = False,
) -> None:
    """Make a scene with known truth: moving cameras, a COLMAP model of them, 2D tracks of individuals.

    Writes a folder that 'acino-fte scene' reads: sparse/, tracks/, scene.yaml, truth.
    """
    from acino_fte.data_tools.scene_folder import write_scene
    from acino_fte.data_tools.simulate_scene import SceneSimulation
    from acino_fte.data_tools.simulate_scene import simulate_scene as run_simulation
    from acino_fte.simulation_files import check_target

    with reported_errors():
        check_target(out, overwrite=overwrite)
        options = SceneSimulation(
            n_frames=frames,
            fps=fps,
            path=path.value,
            formation=formation.value,
            n_cameras=cameras,
            distance=distance,
            lane=lane,
            rig_side=rig_side,
            lens=tuple(lens.split(",")) if "," in lens else lens,
            shared_lens=shared_lens,
            key_step=key_step,
            unregistered=unregistered,
            centre_noise=centre_noise_mm / 1000.0,
            turn_noise=turn_noise,
            resection=resection,
            n_landmarks=landmarks,
            wand=wand or None,
            n_animals=animals,
            noise_px=noise_px,
            missed=missed,
            outliers=outliers,
            swaps=swaps,
            clock_offset=_numbers(clock_offset, "--clock-offset"),
            clock_drift=_numbers(clock_drift, "--clock-drift"),
            gauge=gauge,
            seed=seed,
        )
        scene = run_simulation(options)
        command = _command(out, options, layout.value)
        write_scene(scene, out, layout=layout.value, overwrite=overwrite, command=command)
        stdout.print(
            f"[bold]{escape(str(out))}[/]: {frames} frames, {cameras} cameras, "
            f"{len(scene.individuals)} individuals, {len(scene.structure.landmarks)} landmarks, truth"
        )


def _numbers(text: str, key: str) -> tuple[float, ...]:
    """Numbers between commas."""
    from acino_fte.errors import InputError

    if not text.strip():
        return ()
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise InputError(
            "This is no list of numbers.",
            key=key,
            expected="a number for each camera, as 0,2.5,-1",
            found=text,
        ) from None


def _command(out: Path, options: SceneSimulation, layout: str) -> str:
    """The command line that makes the same scene again: everything that is not a default."""
    import shlex
    from dataclasses import fields

    flags = {"n_frames": "frames", "n_cameras": "cameras", "n_landmarks": "landmarks", "n_animals": "animals"}
    parts = ["acino-fte", "simulate-scene", str(out)]
    for option in fields(options):
        value = getattr(options, option.name)
        name = flags.get(option.name, option.name.replace("_", "-"))
        if value == option.default and option.name != "seed":
            continue
        if isinstance(value, bool):
            parts += [f"--{name}" if value else f"--no-{name}"]
        elif option.name == "centre_noise":
            parts += ["--centre-noise-mm", f"{1000 * value:g}"]
        elif isinstance(value, tuple):
            parts += [f"--{name}", ",".join(str(v).removesuffix(".0") for v in value)]
        else:
            parts += [f"--{name}", str(0 if value is None else value).removesuffix(".0")]
    return shlex.join(parts + (["--layout", layout] if layout != "prefix" else []))
