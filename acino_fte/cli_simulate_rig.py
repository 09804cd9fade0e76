"""The command ``acino-fte simulate-rig``: one telephoto camera, a lidar and an IMU, with known truth."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from acino_fte.cli_common import reported_errors, spinner, stdout, warn

if TYPE_CHECKING:
    from acino_fte.rig_options import RigOptions


class _Lidar(StrEnum):
    scan = "scan"
    pseudo = "pseudo"
    none = "none"


class _Body(StrEnum):
    links = "links"
    capsules = "capsules"


class _Recording(StrEnum):
    lvx = "lvx"
    bag1 = "bag1"
    bag2 = "bag2"


class _Video(StrEnum):
    mp4 = "mp4"
    mkv = "mkv"


_MOVE, _VIEW, _FAULT = "Motion", "Camera", "Detector"
_LIDAR, _IMU, _FLAW, _FILES = "Lidar", "IMU and clocks", "Errors of what is given", "Files"
_FLAGS = {"n_frames": "frames", "range_noise_m": "range-noise"}
_BESIDE = ("recording", "video", "picture_width")


def _say(text: str, panel: str, *names: str, **limits: Any) -> Any:
    return typer.Option(*names, help=text, rich_help_panel=panel, **limits)


def simulate_rig(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The sequence folder to make.")],
    species: Annotated[str, _say("A bundled species, or a species file (.yaml).", _MOVE)] = "cheetah",
    motion: Annotated[
        str, _say("gallop, flick, turn (cheetah), walk (human) or wander (any species).", _MOVE)
    ] = "gallop",
    frames: Annotated[int, _say("Number of frames.", _MOVE, min=1)] = 120,
    fps: Annotated[float, _say("Frames per second.", _MOVE, min=1e-3)] = 60.0,
    longest_path: Annotated[
        float | None,
        _say(
            "Metres; a longer run is made as on a treadmill. By default 0.6 of the distance, or half of the "
            "view of a camera that is fixed.",
            _MOVE,
            min=1e-6,
        ),
    ] = None,
    distance: Annotated[
        float, _say("From the camera to the middle of the path, m.", _VIEW, min=1.0, max=1e4)
    ] = 90.0,
    angle: Annotated[
        float,
        _say(
            "Degrees: 0 runs across the view, at 90 the animal comes to the camera.",
            _VIEW,
            min=-90.0,
            max=90.0,
        ),
    ] = 0.0,
    height: Annotated[float, _say("Of the camera, m.", _VIEW, min=0.1)] = 1.5,
    width: Annotated[int, _say("Of the picture, px; the field of view stays.", _VIEW, min=16)] = 2048,
    focal_mm: Annotated[float, _say("Of the lens, mm.", _VIEW, min=1e-3)] = 150.0,
    focal_px: Annotated[float | None, _say("Focal length in px, instead.", _VIEW, min=1.0)] = None,
    pan: Annotated[bool, _say("The camera follows the animal, or is fixed.", _VIEW, "--pan/--fixed")] = True,
    follow_deg: Annotated[
        float, _say("Standard deviation of the slow errors of following.", _VIEW, min=0.0)
    ] = 0.1,
    shake_mrad: Annotated[float, _say("Standard deviation of a shake.", _VIEW, min=0.0)] = 0.2,
    noise_px: Annotated[
        str, _say("Standard deviation of u and v, px; 'species' takes each marker's sd_px.", _FAULT)
    ] = "3",
    missing: Annotated[float, _say("Fraction not detected.", _FAULT, min=0.0, max=1.0)] = 0.15,
    outliers: Annotated[float, _say("Fraction of the rest that is wrong.", _FAULT, min=0.0, max=1.0)] = 0.03,
    swaps: Annotated[
        float, _say("Fraction of pictures with left and right exchanged.", _FAULT, min=0.0, max=1.0)
    ] = 0.0,
    occlusion: Annotated[bool, _say("Markers hidden by the body are guessed.", _FAULT)] = False,
    quantise: Annotated[bool, _say("Round to DeepLabCut's grid.", _FAULT, "--quantise")] = False,
    proportions: Annotated[
        float,
        _say("Standard deviation of the logarithm of each segment group's length.", _MOVE, min=0.0, max=1.0),
    ] = 0.0,
    offsets_mm: Annotated[
        float, _say("Markers are found beside their place: standard deviation.", _MOVE, min=0.0, max=1e3)
    ] = 0.0,
    lidar: Annotated[
        _Lidar, _say("A scan; one return at every visible marker and frame; or no lidar.", _LIDAR)
    ] = _Lidar.scan,
    body: Annotated[
        _Body, _say("What it meets: drawn lines with a skin, or the species' solid body.", _LIDAR)
    ] = _Body.links,
    surface_m: Annotated[float, _say("From the links to the skin, m.", _LIDAR, min=1e-4)] = 0.04,
    background: Annotated[
        float,
        _say("Fraction of the body's returns that come from something else.", _LIDAR, min=0.0, max=1.0),
    ] = 0.1,
    range_noise: Annotated[float, _say("Standard deviation of a range, m.", _LIDAR, min=0.0)] = 0.02,
    angle_noise_mrad: Annotated[
        float, _say("Standard deviation of a direction, mrad.", _LIDAR, min=0.0)
    ] = 0.0,
    points_per_second: Annotated[float, _say("Of the lidar.", _LIDAR, min=1.0)] = 240_000.0,
    grass_m: Annotated[float, _say("Mean height of the grass, m.", _LIDAR, min=0.0)] = 0.05,
    bushes: Annotated[int, _say("Bushes behind the path.", _LIDAR, min=0)] = 60,
    lidar_turned_mrad: Annotated[
        float, _say("Error of lidar_to_camera: standard deviation of a turn.", _FLAW, min=0.0)
    ] = 0.0,
    lidar_moved_mm: Annotated[float, _say("The same of a shift.", _FLAW, min=0.0)] = 0.0,
    focal_error: Annotated[
        float, _say("Relative error of the focal length.", _FLAW, min=-0.5, max=1.0)
    ] = 0.0,
    pose_drift_mrad: Annotated[
        float, _say("Drift of the given poses until the last frame.", _FLAW, min=0.0)
    ] = 0.0,
    sync_ms: Annotated[float, _say("The lidar's given times are late by this.", _FLAW)] = 0.0,
    rest_s: Annotated[float, _say("How long the rig rests before it follows.", _IMU, min=0.0)] = 5.0,
    gyro_bias: Annotated[float, _say("Length of the bias, rad/s.", _IMU, min=0.0)] = 0.01,
    gyro_noise: Annotated[float, _say("Of a sample, rad/s.", _IMU, min=0.0)] = 0.0015,
    drops: Annotated[float, _say("Fraction of frames that are lost.", _IMU, min=0.0, max=0.9)] = 0.0,
    jitter_us: Annotated[float, _say("Of the camera's stamps.", _IMU, min=0.0)] = 20.0,
    latency_ms: Annotated[float, _say("Random part of the way to the computer.", _IMU, min=0.0)] = 1.0,
    recording: Annotated[_Recording | None, _say("Also write the recording as a rig would.", _FILES)] = None,
    video: Annotated[_Video | None, _say("Also write the pictures as a video.", _FILES)] = None,
    picture_width: Annotated[int, _say("Of the pictures, px.", _FILES, min=16, max=8192)] = 512,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same recording.")] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier simulation in OUT.")
    ] = False,
) -> None:
    """Make a recording of a rig with known truth: a telephoto camera that pans, a lidar and an IMU.

    Writes a sequence folder that 'acino-fte run' reads, and with --recording and --video the files of a real
    rig, to try 'acino-fte import-recording' on.
    """
    given = dict(locals())
    from acino_fte.cli_simulate import _parse_noise
    from acino_fte.rig_files import write_rig_simulation
    from acino_fte.rig_options import RigOptions
    from acino_fte.simulate_rig import simulate_rig as run_simulation
    from acino_fte.simulation_files import check_target

    with reported_errors(), spinner(False) as tell:
        check_target(out, overwrite=overwrite)
        given |= {key: given.pop(flag.replace("-", "_")) for key, flag in _FLAGS.items()}
        beside = {key: given.pop(key) for key in _BESIDE}
        given = {key: value for key, value in given.items() if key not in ("out", "overwrite")}
        given |= {"noise_px": _parse_noise(noise_px), "lidar": lidar.value, "body": body.value}
        options = RigOptions(**given)
        tell("simulating")
        simulation = run_simulation(options)
        tell("writing")
        write_rig_simulation(
            simulation,
            out,
            recording=recording.value if recording else None,
            video=video.value if video else None,
            picture_width=picture_width,
            overwrite=overwrite,
            command=_command(out, options, beside),
        )
    for note in simulation.notes:
        warn(note)
    returns = f"{len(simulation.lidar)} returns" if simulation.lidar is not None else "no lidar"
    stdout.print(f"[bold]{escape(str(out))}[/]: {frames} frames, {returns}, truth")


def _command(out: Path, options: RigOptions, beside: dict[str, Any]) -> str:
    """The command line that makes the same recording again: everything that is not a default."""
    import shlex
    from dataclasses import fields

    parts = ["python", "scripts/simulate_rig.py", str(out)]
    for option in fields(options):
        value = getattr(options, option.name)
        flag = _FLAGS.get(option.name, option.name.replace("_", "-"))
        if value == option.default and option.name not in ("motion", "seed"):
            continue
        if option.name == "pan":
            parts.append("--fixed")
        elif isinstance(value, bool):
            parts.append(f"--{flag}")
        else:
            parts += [f"--{flag}", str(value).removesuffix(".0")]
    for key, value in beside.items():
        if value is not None and (key, value) != ("picture_width", 512):
            parts += [f"--{key.replace('_', '-')}", str(value)]
    return shlex.join(parts)
