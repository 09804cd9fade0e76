"""``acino-fte import-recording``: a recording of a rig becomes a sequence folder."""

from __future__ import annotations

import math
import shlex
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import reported_errors, spinner, stdout, warn
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.import_motion import Encoders
    from acino_fte.data_tools.import_recording import ImportOptions

_INPUT, _RECORDING, _TIME, _OUTPUT = "Input", "Recording", "Time", "Output"


class _Motion(StrEnum):
    imu = "imu"
    encoders = "encoders"
    none = "none"


def import_recording(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING",
            help="A recording with a lidar: LVX or LVX2 (Livox), or a bag of ROS 1 or ROS 2.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Sequence folder to make. [dim]\\[default: NAME][/]", rich_help_panel=_OUTPUT
        ),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Its video, where the pictures are apart.", rich_help_panel=_INPUT),
    ] = None,
    keypoints: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Detections of the pictures (DeepLabCut), a row for every frame.",
            rich_help_panel=_INPUT,
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Calibration of camera and lidar, as scripts/calibrate_lidar.py writes it.",
            rich_help_panel=_INPUT,
        ),
    ] = None,
    species: Annotated[
        str | None, typer.Option(help="Species, or the path of a species file.", rich_help_panel=_INPUT)
    ] = None,
    camera_topic: Annotated[
        str | None, typer.Option(help="Stream of the camera, of several.", rich_help_panel=_RECORDING)
    ] = None,
    lidar_topic: Annotated[
        str | None, typer.Option(help="Stream of the lidar, of several.", rich_help_panel=_RECORDING)
    ] = None,
    imu_topic: Annotated[
        str | None,
        typer.Option(help="Stream of the inertial sensor, of several.", rich_help_panel=_RECORDING),
    ] = None,
    motion: Annotated[
        _Motion | None,
        typer.Option(
            help="What tells how the camera turned: the inertial sensor in the lidar, the encoders of its "
            "head, or nothing (it stood).",
            rich_help_panel=_RECORDING,
            show_default="imu where there is one",
        ),
    ] = None,
    counts_per_turn: Annotated[
        str | None,
        typer.Option(
            metavar="PAN,TILT",
            help="Counts of the encoders in a whole turn; negative where they grow to the right, or down.",
            rich_help_panel=_RECORDING,
        ),
    ] = None,
    encoder_zero: Annotated[
        str | None,
        typer.Option(
            metavar="PAN,TILT",
            help="Counts where the camera looks along the world's x, and level.",
            rich_help_panel=_RECORDING,
            show_default="those of the first frame",
        ),
    ] = None,
    encoders: Annotated[
        str,
        typer.Option(
            metavar="PAN,TILT",
            help="Which of the numbers in the camera's messages they are, from 0.",
            rich_help_panel=_RECORDING,
        ),
    ] = "2,3",
    frames: Annotated[
        str | None,
        typer.Option(
            metavar="START:STOP",
            help="Frames of the video, half-open, from 0; they count from 0 again in the sequence.",
            rich_help_panel=_TIME,
            show_default="all",
        ),
    ] = None,
    pivot: Annotated[
        str | None,
        typer.Option(
            metavar="FRAME=SECONDS|strike|led:X,Y,W,H=SECONDS|knock",
            help="One event that video and lidar both have: a frame of the video and the lidar's time, in "
            "seconds from its first return; the strike of a paw, found by itself in keypoints and returns "
            "(strike:FRAME=SECONDS where you know it roughly); a light that goes on in a region of the "
            "picture; or a knock on the rig.",
            rich_help_panel=_TIME,
        ),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(help="Frames per second of the camera.", rich_help_panel=_TIME)
    ] = None,
    exposed: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Frames that the camera took during the video, where nothing tells which ones it dropped.",
            rich_help_panel=_TIME,
        ),
    ] = None,
    margin_px: Annotated[
        float | None,
        typer.Option(
            help="Keep only lidar returns in the picture and so far beyond its edge.",
            rich_help_panel=_OUTPUT,
            show_default="all returns",
        ),
    ] = None,
    range_sd: Annotated[
        float, typer.Option(help="Standard deviation of the lidar's ranges, m.", rich_help_panel=_OUTPUT)
    ] = 0.02,
    pictures: Annotated[
        bool, typer.Option(help="Put the pictures into the folder as a video.", rich_help_panel=_OUTPUT)
    ] = True,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier import there.", rich_help_panel=_OUTPUT)
    ] = False,
    inspect: Annotated[
        bool, typer.Option("--inspect", help="Only say what the recording holds.", rich_help_panel=_OUTPUT)
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print errors and warnings only.", rich_help_panel=_OUTPUT)
    ] = False,
) -> None:
    """Make a sequence folder of a recording of a camera and a lidar.

    Writes sequence.yaml, cameras.json (a pose per frame where the camera turned),
    dlc/, lidar.npz, lidar_camera.json, imu.csv, the pictures, and import.json, which
    says where everything came from, what was damaged and how it was synchronised.
    Leaves with 0 when the folder is there, 2 when the input is wrong.

    Example: acino-fte import-recording run.bag --keypoints dlc.csv --calibration lidar_camera.json -o run
    """
    with reported_errors():
        if inspect:
            _inspect(recording, quiet)
            return
        from acino_fte.data_tools.import_notes import summary
        from acino_fte.data_tools.import_pivot import pivot_hint
        from acino_fte.data_tools.import_recording import ImportOptions
        from acino_fte.data_tools.import_recording import import_recording as run

        options = ImportOptions(
            video=video,
            keypoints=keypoints,
            calibration=calibration,
            species=species,
            camera_topic=camera_topic,
            lidar_topic=lidar_topic,
            imu_topic=imu_topic,
            frames=_frames(frames),
            pivot=pivot_hint(pivot),
            fps=fps,
            expected=exposed,
            margin_px=margin_px,
            motion=motion.value if motion is not None else None,
            encoders=_encoders(counts_per_turn, encoder_zero, encoders),
            range_sd=range_sd,
            pictures=pictures,
        )
        _check(options)
        target = out or Path(f"{recording.resolve().stem or 'recording'}_sequence")
        command = shlex.join(["acino-fte", *sys.argv[1:]])
        with spinner(quiet) as tell:
            found = run(recording, target, options, overwrite=overwrite, command=command, tell=tell)
    for message in found.warnings:
        warn(message)
    if not quiet:
        for line in summary(found.provenance):
            stdout.print(line, markup=False)
        stdout.print(f"written to {escape(str(found.folder))}")


def _inspect(recording: Path, quiet: bool) -> None:
    from acino_fte.data_tools.import_scan import inspection, scan_recording

    with spinner(quiet) as tell:
        scan = scan_recording(recording, tell)
    for line in inspection(scan):
        stdout.print(line, markup=False)


def _frames(text: str | None) -> tuple[int | None, int | None]:
    """START:STOP, either of which may be left out."""
    if text is None:
        return None, None
    start, colon, stop = text.partition(":")
    try:
        if not colon:
            raise ValueError(text)
        return int(start) if start else None, int(stop) if stop else None
    except ValueError:
        raise InputError(
            "The range of frames cannot be read.",
            key="--frames",
            expected="START:STOP, as 80:190",
            found=text,
        ) from None


def _encoders(turns: str | None, zero: str | None, places: str) -> Encoders | None:
    """What the encoders count, where it is given."""
    from acino_fte.data_tools.import_motion import Encoders

    if turns is None:
        return None
    pan, tilt = _pair("--counts-per-turn", turns)
    if not pan or not tilt:
        raise InputError("A turn has counts.", key="--counts-per-turn", expected="other than 0", found=turns)
    which = _pair("--encoders", places)
    if any(place < 0 or place != int(place) for place in which):
        raise InputError("There are no such encoders.", key="--encoders", expected="2,3", found=places)
    return Encoders(
        (pan, tilt), None if zero is None else _pair("--encoder-zero", zero), (int(which[0]), int(which[1]))
    )


def _pair(key: str, text: str) -> tuple[float, float]:
    """Two numbers with a comma between them."""
    try:
        first, second = (float(part) for part in text.split(","))
        if not (math.isfinite(first) and math.isfinite(second)):
            raise ValueError(text)
    except ValueError:
        raise InputError(
            "Two numbers are expected, for pan and tilt.", key=key, expected="as 4000,4000", found=text
        ) from None
    return first, second


def _check(options: ImportOptions) -> None:
    """Numbers that cannot be."""
    checks = (
        ("--fps", options.fps, "more than 0", lambda v: v > 0),
        ("--exposed", options.expected, "2 or more", lambda v: v >= 2),
        ("--margin-px", options.margin_px, "0 or more", lambda v: v >= 0),
        ("--range-sd", options.range_sd, "more than 0", lambda v: v > 0),
    )
    for key, value, expected, right in checks:
        if value is not None and not (math.isfinite(value) and right(value)):
            raise InputError(
                f"The value of {key} is impossible.", key=key, expected=expected, found=f"{value:g}"
            )
