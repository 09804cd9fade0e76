"""The pivot of an import by the animal: what the video's keypoints and the lidar's returns both show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.import_lidar import lidar_messages
from acino_fte.data_tools.keypoints import Keypoints
from acino_fte.data_tools.sync_animal import AnimalLag, Glimpses, animal_lag
from acino_fte.data_tools.sync_outline import Outline, outline_of
from acino_fte.data_tools.sync_strike import Strike, paws_of, strikes_of
from acino_fte.errors import InputError

ToSeconds = Callable[[np.ndarray, int | None], np.ndarray]
_FEWEST_MARKERS = 3
_MARGIN = 0.1  # of the picture's size, in which returns beside it still count


@dataclass(frozen=True, eq=False)
class Animal:
    """What shows the animal: a recording's lidar in a calibrated camera, and its keypoints in the video."""

    recording: Path
    stream: str
    lens: Camera
    keypoints: Keypoints | None


@dataclass(frozen=True)
class StrikePivot:
    """A frame of the video (in parts), the lidar's time of it, the lag of all frames, its sd (s), a note."""

    frame: float
    time: float
    lag: float
    sd: float
    note: str


def strike_pivot(
    animal: Animal,
    to_seconds: ToSeconds,
    frame_time: np.ndarray,
    frames: tuple[int, int],
    lags: tuple[float, float] | None,
    near: float | None = None,
) -> StrikePivot:
    """Find the strike of a paw in video and lidar.

    Parameters
    ----------
    animal : Animal
        What shows it.
    to_seconds : callable
        From stamps (K,) and the time of reception of a message of the lidar to s.
    frame_time : (N,)
        Of all frames of the video, s; the lag is what is missing.
    frames : (start, stop)
        That are looked at.
    lags : (least, most), optional
        Of the lag, s; by default all at which the lidar has half of the frames.
    near : float, optional
        Frame near which the strike is; by default the most sudden one.

    Raises
    ------
    InputError
        There are no keypoints, the lidar does not show the animal, or it fits at several times.
    """
    start, stop = frames
    outline = _outline(animal, frame_time, start, stop)
    span = None if lags is None else (outline.time[0] + lags[0] - 0.1, outline.time[-1] + lags[1] + 0.1)
    glimpses = glimpses_of(animal, to_seconds, span)
    if not len(glimpses.time):
        raise InputError(
            "No lidar return lies in the picture during the video.",
            key="--pivot",
            expected="returns of the animal",
            found="none",
            remedy="check calibration and recording, and the seconds of --pivot strike:FRAME=SECONDS",
        )
    if lags is None:
        half = 0.5 * (outline.time[-1] - outline.time[0])
        lags = (
            float(glimpses.time[0] - outline.time[0] - half),
            float(glimpses.time[-1] - outline.time[-1] + half),
        )
    found = animal_lag(outline, glimpses, lags)
    return _pivot(animal, outline, frame_time, start, found, near)


def _outline(animal: Animal, frame_time: np.ndarray, start: int, stop: int) -> Outline:
    """The animal's outline over some frames."""
    points = animal.keypoints
    if points is None:
        raise InputError(
            "There are no keypoints, which show the strike of a paw.",
            key="--pivot",
            expected="keypoints of the video (--keypoints)",
            found="none",
            remedy="give --keypoints, or the event by hand: --pivot FRAME=SECONDS",
        )
    seen = np.isfinite(points.position[start:stop]).all(axis=-1)
    often = int((seen.mean(axis=0) >= 0.2).sum())
    if often < _FEWEST_MARKERS or stop - start < 12:
        raise InputError(
            "The keypoints show too little of the animal to tell when its paws strike.",
            file=points.path,
            key="--pivot",
            expected=f"{_FEWEST_MARKERS} keypoints in a fifth of the frames, and 12 frames",
            found=f"{often} keypoints, {stop - start} frames",
            remedy="choose other --frames, or give the event by hand: --pivot FRAME=SECONDS",
        )
    return outline_of(frame_time[start:stop], points.position[start:stop], points.likelihood[start:stop])


def glimpses_of(animal: Animal, to_seconds: ToSeconds, span: tuple[float, float] | None) -> Glimpses:
    """The lidar's returns in the picture, or near it, in a span of time (s)."""
    size = np.array(animal.lens.resolution, dtype=float)
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for returns, received in lidar_messages(animal.recording, animal.stream):
        time = to_seconds(returns.time_ns, received)
        if span is not None and (time[-1] < span[0] - 1.0 or time[0] > span[1] + 1.0):
            continue
        xyz = np.asarray(returns.xyz, dtype=float)
        pixel = animal.lens.project(xyz)
        with np.errstate(invalid="ignore"):
            keep = ((pixel > -_MARGIN * size) & (pixel < (1 + _MARGIN) * size)).all(axis=1)
        if span is not None:
            keep &= (time >= span[0]) & (time <= span[1])
        parts.append((time[keep], pixel[keep], animal.lens.to_camera(xyz[keep])[:, 2]))
    if not parts:
        return Glimpses(np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    time, pixel, depth = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.argsort(time, kind="stable")
    return Glimpses(time[order], pixel[order], depth[order])


def _pivot(
    animal: Animal,
    outline: Outline,
    frame_time: np.ndarray,
    start: int,
    found: AnimalLag,
    near: float | None,
) -> StrikePivot:
    """The strike that stands for the lag, and what is said of it."""
    names = animal.keypoints.names if animal.keypoints is not None else ()
    strikes = strikes_of(outline, paws_of(names, outline))
    if near is not None:
        strikes.sort(key=lambda one: abs(start + one.frame - near))
    frame, what = 0.5 * (len(outline.time) - 1), "no paw strikes; the motion of the whole animal"
    if strikes:
        best: Strike = strikes[0]
        frame, what = best.frame, f"{names[best.marker]} strikes"
    frame += start
    time = float(np.interp(frame, np.arange(len(frame_time)), frame_time)) + found.lag
    clear = "" if np.isinf(found.sigmas) else f", {found.sigmas:.1f} sigma better than any other time"
    sd = float(np.hypot(found.sd, np.sqrt(np.mean(found.parts**2))))
    note = (
        f"{what}: frame {frame:.1f} is at {time:.4f} s of the lidar, ± {1e3 * sd:.1f} ms, by "
        f"{found.n_returns} returns on the animal{clear}"
    )
    if found.parts.any():
        apart = ", ".join(f"{1e3 * one:+.0f}" for one in found.parts)
        note += f"; its quarters are {apart} ms beside it: frames are missing (--exposed tells how many)"
    return StrikePivot(frame, time, found.lag, sd, note)
