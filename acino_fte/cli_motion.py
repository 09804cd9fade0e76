"""The command ``acino-fte camera-motion``: a pose per frame of a camera that moved."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from acino_fte.cli_common import reported_errors, spinner, stdout, warn
from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    import numpy as np

    from acino_fte.data_tools.camera_motion import CameraMotion
    from acino_fte.data_tools.camera_motion_input import EncoderCounts
    from acino_fte.data_tools.imu import Attitude
    from acino_fte.data_tools.imu_camera import Mounting
    from acino_fte.data_tools.recording import ImuSamples
    from acino_fte.sequence import Sequence


class _From(StrEnum):
    imu = "imu"
    video = "video"
    encoders = "encoders"


class _Model(StrEnum):
    auto = "auto"
    full = "full"
    rotation = "rotation"


class _Method(StrEnum):
    simpson = "simpson"
    mean = "mean"
    midpoint = "midpoint"
    first = "first"


class _World(StrEnum):
    motion = "motion"
    camera = "camera"


_IMU, _VIDEO, _ENCODERS, _OUTPUT = "Inertial sensor", "Video", "Encoders", "Output"
Path_ = Path | None
Float_ = float | None


def camera_motion(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE",
            help="A recording: a folder with sequence.yaml, or of AcinoSet. Nothing in it is changed.",
            show_default=False,
        ),
    ],
    source: Annotated[_From, typer.Option("--from", help="What tells the motion.", show_default=False)],
    file: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Of the inertial sensor or the encoders: a CSV file or a recording (LVX, bag). Of the "
            "pictures: a video or a folder of images.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path_, typer.Option("--out", "-o", help="Result folder. [dim]\\[default: out/NAME-motion][/]")
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="The camera that moved.", show_default="the only one")
    ] = None,
    start: Annotated[
        float,
        typer.Option(
            help="Time of frame 0, s from the first sample of the sensor or encoders.", min=-1e6, max=1e6
        ),
    ] = 0.0,
    topic: Annotated[
        str | None, typer.Option(help="Stream of a recording.", show_default="the only one of its kind")
    ] = None,
    imu_to_camera: Annotated[
        str,
        typer.Option(
            metavar="auto|same|FILE",
            help="How the sensor sits on the camera: found from the turns that a video shows (auto, needs "
            "--video), axes alike (same), or a JSON file with the 3×3 rotation.",
            rich_help_panel=_IMU,
        ),
    ] = "auto",
    video: Annotated[
        Path_,
        typer.Option(metavar="FILE", help="Video of the camera, for the mounting.", rich_help_panel=_IMU),
    ] = None,
    rate_unit: Annotated[
        str | None, typer.Option(help="rad/s or deg/s, unless the header says it.", rich_help_panel=_IMU)
    ] = None,
    force_unit: Annotated[
        str | None, typer.Option(help="m/s2, g or mg, unless the header says it.", rich_help_panel=_IMU)
    ] = None,
    time_unit: Annotated[
        str | None, typer.Option(help="s, ms, us or ns, unless the header says it.", rich_help_panel=_IMU)
    ] = None,
    sample_rate: Annotated[
        Float_, typer.Option(help="Hz, of a table without times.", min=1e-3, max=1e6, rich_help_panel=_IMU)
    ] = None,
    method: Annotated[
        _Method,
        typer.Option(help="Of integration; mean for sensors that average.", rich_help_panel=_IMU),
    ] = _Method.simpson,
    model: Annotated[
        _Model,
        typer.Option(
            help="A turn and a step (full), a turn alone (rotation: a tripod), or as the pictures say.",
            rich_help_panel=_VIDEO,
        ),
    ] = _Model.auto,
    scale: Annotated[
        Float_,
        typer.Option(
            help="Length of the first step, m; pictures do not tell it.",
            min=1e-6,
            max=1e6,
            rich_help_panel=_VIDEO,
        ),
    ] = None,
    counts: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="PAN TILT", help="Counts of a whole turn.", rich_help_panel=_ENCODERS),
    ] = None,
    zero: Annotated[
        tuple[float, float],
        typer.Option(
            metavar="PAN TILT", help="Counts where the camera looks ahead, level.", rich_help_panel=_ENCODERS
        ),
    ] = (0.0, 0.0),
    sign: Annotated[
        tuple[int, int],
        typer.Option(
            metavar="PAN TILT", help="-1 where counts grow to the right, or down.", rich_help_panel=_ENCODERS
        ),
    ] = (1, 1),
    encoders: Annotated[
        tuple[int, int],
        typer.Option(
            metavar="PAN TILT",
            help="Which numbers of the camera's messages they are, from 0.",
            rich_help_panel=_ENCODERS,
        ),
    ] = (2, 3),
    lever: Annotated[
        tuple[float, float, float],
        typer.Option(
            metavar="X Y Z",
            help="The camera's centre from the axes, m: forward, left, up.",
            rich_help_panel=_ENCODERS,
        ),
    ] = (0.0, 0.0, 0.0),
    world: Annotated[
        _World | None,
        typer.Option(
            help="The motion's own world (z up), or that of the camera's pose in the camera file.",
            show_default="motion where gravity levels it, else camera",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print errors and warnings only.", rich_help_panel=_OUTPUT)
    ] = False,
) -> None:
    """Find how a camera moved, and write cameras with a pose per frame.

    Writes cameras.json (name it as 'cameras' in a sequence.yaml), camera_motion.png
    (pan, tilt and roll over time) and camera_motion.json (what is known how well).
    Leaves with 0 when it is written, 2 when the input is wrong, 1 for anything else.

    Example: acino-fte camera-motion zebra/ --from video --file zebra.mp4 -o out/zebra-motion
    """
    with reported_errors(), spinner(quiet) as tell:
        from acino_fte.data_tools.camera_motion_files import MOTION, part_of, save_motion
        from acino_fte.data_tools.camera_motion_input import encoder_counts, inertial_samples
        from acino_fte.data_tools.load import load_sequence
        from acino_fte.result_files import check_output_folder

        target = out or Path("out") / f"{folder.resolve().name}-motion"
        target = check_output_folder(
            target, input_folder=folder if folder.exists() else None, contents=MOTION
        )
        tell("reading")
        sequence = load_sequence(folder, frames=(None, None))
        name = _camera_name(sequence, camera)
        _check_needs(source, counts, imu_to_camera, video)
        with _about(file):
            if source is _From.video:
                motion = _from_video(sequence, name, file, model.value, tell)
            elif source is _From.encoders:
                read = encoder_counts(file, topic, encoders, sequence.fps, start)
                motion = _from_encoders(sequence, read, (counts or (0, 0), zero, sign, lever), start)
            else:
                units = {"rate_unit": rate_unit, "force_unit": force_unit, "time_unit": time_unit}
                samples, notes = inertial_samples(file, topic, units, sample_rate)
                motion = _from_imu(sequence, name, samples, (imu_to_camera, video), method.value, start, tell)
                motion = replace(motion, notes=notes + motion.notes)
        motion = part_of(motion, sequence.n_frames)
        tell("writing")
        note = save_motion(
            sequence.cameras,
            name,
            motion,
            target,
            fps=sequence.fps,
            anchor=None if world is None else world.value,
            scale=scale or 1.0,
            note={"sequence": sequence.name, "file": file.name},
        )
    _tell_result(note, target, quiet)


@contextmanager
def _about(file: Path) -> Iterator[None]:
    """Errors that name no file are about this one."""
    try:
        yield
    except InputError as error:
        if error.file is not None or error.key is not None and error.key.startswith("--"):
            raise
        parts = {name: getattr(error, name) for name in ("key", "expected", "found", "remedy")}
        raise InputError(error.problem, file=file, **parts) from None


def _tell_result(note: dict[str, Any], target: Path, quiet: bool) -> None:
    for message in note["notes"]:
        warn(message)
    if quiet:
        return
    sd = [value for value in note["rotation_sd_deg"] if value is not None]
    stdout.print(
        f"camera {note['camera']} from {note['from']}: {note['known']} of {note['frames'][1]} frames known"
        + (f", attitude ± {max(sd):.2g}° at most" if sd else ""),
        markup=False,
    )
    stdout.print(
        f"written to {escape(str(target))}; use it as 'cameras: {escape(str(target / 'cameras.json'))}'"
    )


def _camera_name(sequence: Sequence, name: str | None) -> str:
    names = sequence.cameras.names
    if name is None and len(names) == 1:
        return names[0]
    if name not in names:
        raise InputError(
            "Which camera moved is not known."
            if name is None
            else f"There is no such camera{did_you_mean(name, names)}",
            key="--camera",
            expected=f"one of {', '.join(names)}",
            found=name or "none",
        )
    return name


def _check_needs(source: _From, counts: object, imu_to_camera: str, video: Path | None) -> None:
    """What a route cannot do without."""
    if source is _From.encoders and counts is None:
        raise InputError(
            "The encoders' counts per turn are not known.",
            key="--counts",
            expected="counts of a whole turn of pan and of tilt, gears included",
            found="none",
            remedy="give --counts 4096 4096, as the data sheet has it",
        )
    if source is _From.imu and imu_to_camera == "auto" and video is None:
        raise InputError(
            "How the sensor sits on the camera is not known.",
            key="--imu-to-camera",
            expected="a JSON file with a 3×3 rotation, 'same', or a --video that shows turns",
            found="none of them",
        )


def _from_video(
    sequence: Sequence, name: str, file: Path, model: str, tell: Callable[[str], None]
) -> CameraMotion:
    """By the pictures; the animal's own keypoints are masked out."""
    import numpy as np

    from acino_fte.data_tools.odometry import visual_odometry
    from acino_fte.data_tools.odometry_features import keypoint_boxes
    from acino_fte.data_tools.pictures import open_pictures

    pixels = sequence.pixels(sequence.markers, 0.5)[:, sequence.cameras.names.index(name)]
    boxes = keypoint_boxes(pixels)
    with open_pictures(file) as pictures:
        boxes = boxes[np.minimum(np.arange(len(pictures)), len(boxes) - 1)]  # the last one stays
        return visual_odometry(pictures, sequence.cameras[name], model=model, boxes=boxes, tell=tell)


def _from_encoders(
    sequence: Sequence, read: EncoderCounts, head: tuple[Any, ...], start: float
) -> CameraMotion:
    import numpy as np

    from acino_fte.data_tools.pan_tilt import PanTiltHead, motion_from_encoders

    counts, time, frame = read.counts, read.time, read.frame
    turn, zero, sign, lever = head
    geometry = PanTiltHead(turn, zero, sign, lever=np.array(lever))
    n = sequence.n_frames
    frame_time = None
    if frame is not None:
        counts, time = np.full((n, 2), np.nan), None
        inside = (frame >= 0) & (frame < n)
        counts[frame[inside]] = read.counts[inside]
    elif time is not None:
        frame_time = np.min(time[np.isfinite(time)], initial=np.inf) + start + np.arange(n) / sequence.fps
    motion = motion_from_encoders(counts, geometry, time=time, frame_time=frame_time)
    return replace(motion, notes=read.notes + motion.notes)


def _from_imu(
    sequence: Sequence,
    name: str,
    samples: ImuSamples,
    mount: tuple[str, Path | None],
    method: str,
    start: float,
    tell: Callable[[str], None],
) -> CameraMotion:
    """By the inertial sensor, levelled by gravity; its first heading is where the camera looks."""
    import numpy as np

    from acino_fte.data_tools.imu_camera import motion_from_attitude
    from acino_fte.data_tools.imu_filter import gravity_attitude

    frames = np.arange(sequence.n_frames) / sequence.fps
    stamps = samples.time_ns[0] + np.round((frames + start) * 1e9).astype(np.int64)
    tell("integrating")
    attitude = gravity_attitude(samples, method=method)
    mounting = _mounting(sequence, name, attitude, stamps, mount, tell)
    forward = mounting.imu_to_camera.T @ [0.0, 0.0, 1.0]
    attitude = gravity_attitude(samples, method=method, forward=forward)
    return motion_from_attitude(attitude, stamps, mounting)


def _mounting(
    sequence: Sequence,
    name: str,
    attitude: Attitude,
    stamps: np.ndarray,
    mount: tuple[str, Path | None],
    tell: Callable[[str], None],
) -> Mounting:
    import numpy as np

    from acino_fte.data_tools.imu_camera import Mounting, find_mounting

    said, video = mount
    if said == "same":
        return Mounting(np.eye(3), np.zeros((3, 3)))
    if said == "auto" and video is not None:
        with _about(video):
            seen = _from_video(sequence, name, video, "auto", tell)
        n = min(len(seen), len(stamps))
        from acino_fte.data_tools.camera_motion_files import part_of

        return find_mounting(attitude, part_of(seen, n), stamps[:n])
    return Mounting(_rotation_file(Path(said)), np.zeros((3, 3)))


def _rotation_file(path: Path) -> np.ndarray:
    """A 3×3 rotation from a JSON file: the bare rows, or under 'imu_to_camera'."""
    import numpy as np

    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        matrix = np.asarray(data["imu_to_camera"] if isinstance(data, dict) else data, dtype=float)
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "The mounting of the sensor cannot be read.",
            file=path,
            key="--imu-to-camera",
            expected="auto, same, or a JSON file with 3×3 numbers (or {'imu_to_camera': 3×3})",
            found=str(error),
        ) from None
    if (
        matrix.shape != (3, 3)
        or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3)
        or np.linalg.det(matrix) < 0
    ):
        raise InputError(
            "The mounting of the sensor is no rotation.",
            file=path,
            key="--imu-to-camera",
            expected="3×3, rows of length 1 at right angles, right-handed",
            found=str(matrix.tolist())[:200],
        )
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt
