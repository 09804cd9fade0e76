"""The synchronisation of an import: the best way that a recording, a video and the user's hints allow."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acino_fte.data_tools.clocks import DeviceClock
from acino_fte.data_tools.import_clocks import device_clocks
from acino_fte.data_tools.import_pictures import Pictures
from acino_fte.data_tools.import_pivot import PIVOTS, PivotHint
from acino_fte.data_tools.import_scan import StreamScan
from acino_fte.data_tools.import_strike import Animal, StrikePivot, strike_pivot
from acino_fte.data_tools.recording import ImuSamples
from acino_fte.data_tools.sync import Stamps, Synchronisation, from_motion, from_pivot, from_stamps
from acino_fte.data_tools.sync_events import Event, image_motion, knock, lag_of, led_step, region_brightness
from acino_fte.data_tools.sync_grid import FrameGrid, frame_grid
from acino_fte.data_tools.sync_match import match_video
from acino_fte.errors import InputError

_LATENCY = 0.5  # frames: standard deviation of the camera's shortest delay, against the lidar's
_LONGEST_LATENCY = 0.15  # s
_SEARCHED_S = 10.0  # of the inertial sensor about the frames, that a match must stand out in
_MOTION_S = 40.0  # of video in which motion is measured
_LEAST_MOTION_S = 1.5
_EVEN = 0.25  # of a period: stamps whose steps vary less are those of a video that counts its frames
_HAND = 0.25  # s: how far a strike may lie from what the user says of it; half a stride and more


@dataclass(frozen=True, eq=False)
class Inputs:
    """What a synchronisation is made of.

    Attributes
    ----------
    lidar, imu, camera : StreamScan, optional
        Of the recording.
    pictures : VideoPictures or MessagePictures, optional
    n_frames : int
        Of the video, the pictures or the keypoints.
    frames : (start, stop)
        That are imported.
    fps : float, optional
        As the user says.
    expected : int, optional
        Frames that the camera exposed while it took the video.
    pivot : PivotHint, optional
    imu_to_camera : (3, 3), optional
        How the inertial sensor sits on the camera.
    animal : Animal, optional
        What shows it in video and lidar.
    """

    lidar: StreamScan
    imu: StreamScan | None
    camera: StreamScan | None
    pictures: Pictures | None
    n_frames: int
    frames: tuple[int, int]
    fps: float | None = None
    expected: int | None = None
    pivot: PivotHint | None = None
    imu_to_camera: np.ndarray | None = None
    animal: Animal | None = None


@dataclass(frozen=True, eq=False)
class Timing:
    """Clocks of the lidar and of the inertial sensor, and the times of the frames.

    Second zero is the lidar's first return. `rows` (N,) are the camera's messages of the frames, where there
    are some.
    """

    sync: Synchronisation
    lidar: DeviceClock
    imu: DeviceClock
    rows: np.ndarray | None = None

    def seconds(
        self, clock: DeviceClock, stamps: np.ndarray, received: np.ndarray | int | None
    ) -> np.ndarray:
        """Stamps (K,) of a sensor as s since second zero."""
        computer = clock.to_computer_ns(stamps, received)
        return (computer - self.sync.origin_ns).astype(float) * 1e-9


def synchronise(inputs: Inputs) -> Timing:
    """Find the times of a video's frames on the lidar's clock.

    Raises
    ------
    InputError
        Nothing tells them; the message says which hint would.
    """
    lidar, imu, notes = device_clocks(inputs.lidar, inputs.imu)
    received = inputs.lidar.received[0] if inputs.lidar.received else None
    origin = int(lidar.to_computer_ns(np.array([inputs.lidar.first_ns]), received)[0])
    timing = Timing(_placeholder(origin), lidar, imu)
    stamped = inputs.camera is not None and bool(inputs.camera.received)
    if stamped:
        sync, rows = _by_stamps(inputs, timing)
    else:
        sync, rows = _by_event(inputs, timing), None
    if not inputs.lidar.spread and inputs.lidar.rate > 0:
        length = 1e3 / inputs.lidar.rate
        notes = (*notes, f"all returns of a message have one stamp, so that each is known to {length:.0f} ms")
        sync = replace(sync, frame_sd_ms=np.hypot(sync.frame_sd_ms, length / np.sqrt(12)))
    return Timing(replace(sync, notes=(*(f"lidar: {note}" for note in notes), *sync.notes)), lidar, imu, rows)


def _placeholder(origin: int) -> Synchronisation:
    nothing = np.zeros(1)
    return Synchronisation(nothing, origin, nothing.astype(np.int64), 1.0, (), nothing, "pivot")


def _by_stamps(inputs: Inputs, timing: Timing) -> tuple[Synchronisation, np.ndarray]:
    """By the camera's stamps, its shortest delay by an event or the rig's motion; the frames' messages."""
    camera = inputs.camera
    if camera is None:
        raise InputError("There is no camera in the recording.")
    stamps = camera.stamps
    video_ns = inputs.pictures.stamps_ns if inputs.pictures is not None else None
    if inputs.n_frames > len(stamps):
        raise InputError(
            "The video has more frames than the camera's messages tell of.",
            key="--video",
            expected=f"{len(stamps)} frames at most, as many as {camera.name} has messages",
            found=f"{inputs.n_frames} frames",
            remedy="check that video and recording belong together",
        )
    match = match_video(inputs.n_frames, video_ns, stamps)
    origin = timing.sync.origin_ns
    sync = from_stamps(stamps, timing.lidar.sd_ms, origin_ns=origin, fps=inputs.fps)
    place, sd = sync.place[match.rows], sync.frame_sd_ms[match.rows]
    if not match.sure:
        share = np.linspace(0, 1, inputs.n_frames)
        lost = len(stamps) - inputs.n_frames
        sd = np.hypot(sd, 1e3 * np.sqrt(lost * share * (1 - share)) / sync.fps)
    sync = replace(
        sync,
        frame_time=sync.frame_time[match.rows],
        place=place - place[0],
        frame_sd_ms=sd,
        notes=(*sync.notes, match.how),
    )
    same = timing.lidar.is_computers and "in the computer's time" in " ".join(sync.notes)
    return _delayed(sync, inputs, timing, same), match.rows


def _delayed(sync: Synchronisation, inputs: Inputs, timing: Timing, same: bool) -> Synchronisation:
    """Take the camera's constant delay off, as an event or the motion tells it; else state it as unknown."""
    if inputs.pivot is not None and inputs.pivot.kind == "strike":
        strike = _strike(inputs, timing, sync.frame_time, (-_LONGEST_LATENCY, _LONGEST_LATENCY))
        sync = replace(sync, notes=(*sync.notes, strike.note))
        return _shifted(sync, strike.lag, 1e3 * strike.sd, "the strike of a paw")
    if inputs.pivot is not None:
        pivot, sd_ms = _pivot_of(inputs, timing, sync.fps)
        at = float(np.interp(pivot[0], np.arange(inputs.n_frames), sync.frame_time))
        return _shifted(sync, pivot[1] - at, sd_ms, "the pivot")
    if same:
        return sync
    found = _latency_by_motion(sync, inputs, timing)
    unknown = 1e3 * _LATENCY / sync.fps
    if found is not None and 1e3 * found.sd < unknown:
        return _shifted(sync, found.time, 1e3 * found.sd, "the motion of the rig")
    note = f"the camera's shortest delay is not known: ± {unknown:.1f} ms; --pivot would tell it"
    return replace(sync, frame_sd_ms=np.hypot(sync.frame_sd_ms, unknown), notes=(*sync.notes, note))


def _shifted(sync: Synchronisation, shift: float, sd_ms: float, by: str) -> Synchronisation:
    return replace(
        sync,
        frame_time=sync.frame_time + shift,
        frame_sd_ms=np.hypot(sync.frame_sd_ms, sd_ms),
        notes=(*sync.notes, f"the camera's delay by {by}: {-1e3 * shift:+.1f} ms ± {sd_ms:.1f} ms"),
    )


def _latency_by_motion(sync: Synchronisation, inputs: Inputs, timing: Timing) -> Event | None:
    """How late the frames' times are, by comparing the images' motion with the inertial sensor's."""
    if inputs.imu is None or inputs.pictures is None:
        return None
    start, stop = _motion_frames(inputs, sync.fps)
    if (stop - start) / sync.fps < _LEAST_MOTION_S:
        return None
    time = sync.frame_time[start:stop]
    motion = image_motion(inputs.pictures.frames(start, stop))
    imu_time, rate = _imu_motion(inputs, inputs.imu, timing)
    near = (imu_time > time[0] - _SEARCHED_S) & (imu_time < time[-1] + _SEARCHED_S)
    if near.sum() < 50 or len(motion) != len(time) - 1:
        return None
    try:
        middle = (time[1:] + time[:-1]) / 2
        found = lag_of(middle, motion / np.diff(time)[:, None], imu_time[near], rate[near])
    except InputError:
        return None
    return found if abs(found.time) < _LONGEST_LATENCY else None


def _motion_frames(inputs: Inputs, fps: float) -> tuple[int, int]:
    """Frames about those that are imported, as many as motion is measured in."""
    start, stop = inputs.frames
    missing = max(round(_MOTION_S * fps) - (stop - start), 0)
    first = max(start - missing // 2, 0)
    return first, min(first + max(round(_MOTION_S * fps), 2), inputs.n_frames)


def _imu_motion(inputs: Inputs, imu: StreamScan, timing: Timing) -> tuple[np.ndarray, np.ndarray]:
    """Times (K,), s since second zero, and how fast (K, 2) the turn shifts the image: -ω_y, ω_x, rad/s."""
    samples = imu.samples()
    time = timing.seconds(timing.imu, samples.time_ns, per_sample(imu, samples))
    order = np.argsort(time, kind="stable")
    keep = order[np.append(True, np.diff(time[order]) > 0)]
    turn = np.eye(3) if inputs.imu_to_camera is None else inputs.imu_to_camera
    rate = samples.rate[keep] @ turn.T
    return time[keep], np.column_stack([-rate[:, 1], rate[:, 0]])


def per_sample(imu: StreamScan, samples: ImuSamples) -> np.ndarray | None:
    """Times of reception of every sample."""
    if len(imu.received) != len(imu.imu):
        return None
    return np.repeat(np.array(imu.received, dtype=np.int64), [len(one) for one in imu.imu])


def _by_event(inputs: Inputs, timing: Timing) -> Synchronisation:
    """Without stamps of the camera on the computer's clock: by the pivot, or by the motion of the rig."""
    own = inputs.camera.stamps if inputs.camera is not None else None
    grid, fps = _own_grid(inputs, own)
    expected = None if grid is not None else inputs.expected
    if grid is not None:
        fps = inputs.fps or 1 / grid.period
    origin = timing.sync.origin_ns
    notes: tuple[str, ...] = ()
    if inputs.pivot is not None and inputs.pivot.kind == "strike":
        base = from_pivot(inputs.n_frames, fps, (0, 0.0), pivot_sd_ms=0.0, expected=expected, grid=grid)
        strike = _strike(inputs, timing, base.frame_time, None)
        pivot, sd_ms, notes = (strike.frame, strike.time), 1e3 * strike.sd, (strike.note,)
    elif inputs.pivot is not None:
        pivot, sd_ms = _pivot_of(inputs, timing, fps)
    if inputs.pivot is not None:
        found = from_pivot(
            inputs.n_frames, fps, pivot, pivot_sd_ms=sd_ms, expected=expected, grid=grid, origin_ns=origin
        )
        return replace(found, notes=(*notes, *found.notes))
    if inputs.pictures is None or inputs.imu is None:
        raise _nothing_tells(inputs)
    start, stop = _motion_frames(inputs, fps)
    part = image_motion(inputs.pictures.frames(start, stop))
    imu_time, rate = _imu_motion(inputs, inputs.imu, timing)
    if (start, start + len(part)) == (0, inputs.n_frames - 1):
        return from_motion(part, fps, imu_time, rate, expected=expected, grid=grid, origin_ns=origin)
    base = from_pivot(inputs.n_frames, fps, (0, 0.0), pivot_sd_ms=0.0, expected=expected, grid=grid)
    time = base.frame_time[start : start + len(part) + 1]
    found = lag_of((time[1:] + time[:-1]) / 2, part / np.diff(time)[:, None], imu_time, rate)
    note = f"the match of the motions is {found.contrast:.1f} times the next best"
    return replace(
        base,
        frame_time=base.frame_time + found.time,
        origin_ns=origin,
        frame_sd_ms=np.hypot(base.frame_sd_ms, 1e3 * found.sd),
        method="motion",
        notes=(*base.notes, note),
    )


def _nothing_tells(inputs: Inputs) -> InputError:
    """That there is neither a stamp, nor an event, nor a motion."""
    missing = "no pictures" if inputs.pictures is None else "no inertial sensor in the recording"
    return InputError(
        "Nothing tells when the frames were taken.",
        key="--pivot",
        expected="stamps of the camera in the recording, or one event: " + PIVOTS,
        found=missing,
        remedy="with keypoints of a running animal: --pivot strike. Or find an event that video and "
        "lidar both show, and give its frame and the lidar's time (seconds from its first return): "
        "--pivot 120=3.45",
    )


def _strike(
    inputs: Inputs, timing: Timing, frame_time: np.ndarray, lags: tuple[float, float] | None
) -> StrikePivot:
    """The strike of a paw; where the user says roughly when it was, about that."""
    hint = inputs.pivot
    if inputs.animal is None or hint is None:
        raise InputError("There is nothing that shows a paw's strike.", key="--pivot", expected=PIVOTS)

    def to_seconds(stamps: np.ndarray, received: int | None) -> np.ndarray:
        return timing.seconds(timing.lidar, stamps, received)

    if hint.frame is not None:
        _check_pivot_frame(hint.frame, inputs.n_frames)
        if lags is None:
            at = hint.seconds - float(np.interp(hint.frame, np.arange(inputs.n_frames), frame_time))
            lags = (at - _HAND, at + _HAND)
    period = float(np.median(np.diff(frame_time)))
    frames = _motion_frames(inputs, 1 / period)
    return strike_pivot(inputs.animal, to_seconds, frame_time, frames, lags, hint.frame)


def _check_pivot_frame(frame: float, n_frames: int) -> None:
    if not 0 <= frame <= n_frames - 1:
        raise InputError(
            "The pivot frame is not in the video.",
            key="--pivot",
            expected=f"0 to {n_frames - 1}",
            found=f"{frame:g}",
            remedy="count frames of the video from 0",
        )


def _own_grid(inputs: Inputs, own: Stamps | None) -> tuple[FrameGrid | None, float]:
    """The frames' places by stamps of the video's own clock, where it has one; and the frame rate."""
    stamps = own.device_ns if own is not None else None
    number = own.number if own is not None else None
    if stamps is None and inputs.pictures is not None:
        stamps = inputs.pictures.stamps_ns
    if stamps is not None and len(stamps) == inputs.n_frames and inputs.n_frames > 2:
        steps = np.diff(stamps) / max(float(np.median(np.diff(stamps))), 1.0)
        if np.abs(steps - 1).max() > _EVEN or number is not None:
            grid = frame_grid(stamps, number, inputs.fps)
            return grid, inputs.fps or 1 / grid.period
    fps = inputs.fps or (inputs.pictures.fps if inputs.pictures is not None else None)
    if not fps:
        raise InputError(
            "The frame rate is not known.",
            key="--fps",
            expected="frames per second of the camera",
            found="neither stamps nor a video that states it",
            remedy="give --fps",
        )
    return None, float(fps)


def _pivot_of(inputs: Inputs, timing: Timing, fps: float) -> tuple[tuple[float, float], float]:
    """Frame and time of the pivot, and its standard deviation, ms."""
    hint = inputs.pivot
    if hint is None:
        raise InputError("There is no pivot.", key="--pivot", expected=PIVOTS)
    half_frame = 1e3 / np.sqrt(12) / fps
    if hint.kind == "frame":
        frame = hint.frame or 0.0
        _check_pivot_frame(frame, inputs.n_frames)
        return (frame, hint.seconds), float(np.sqrt(2) * half_frame)
    if inputs.pictures is None:
        raise InputError(
            "There are no pictures in which to find the event.", key="--pivot", remedy="give --video"
        )
    if hint.kind == "led":
        event = led_step(region_brightness(inputs.pictures.frames(0, inputs.n_frames), hint.region))
        return (event.time, hint.seconds), float(np.sqrt(2) * half_frame)
    if inputs.imu is None:
        raise InputError("There is no inertial sensor that felt the knock.", key="--pivot", found="knock")
    samples = inputs.imu.samples()
    time = timing.seconds(timing.imu, samples.time_ns, per_sample(inputs.imu, samples))
    felt = knock(time, samples.force)
    motion = np.linalg.norm(image_motion(inputs.pictures.frames(0, inputs.n_frames)), axis=1)
    shown = knock((np.arange(len(motion)) + 1.0) / fps, motion)  # so that it lies within the first step
    return (shown.time * fps, felt.time), float(np.hypot(1e3 * felt.sd, half_frame))
