"""Synchronisation: the times of a video's frames on the clock of the lidar's recording.

Three ways, best first: the stamps of the camera (:func:`from_stamps`); one event that both sensors saw, the
pivot (:func:`from_pivot`); a motion that both saw (:func:`from_motion`). Dropped frames are counted by the
camera's frame numbers or its stamps where there are some. Else they are spread evenly, as in the WildPose
thesis: with δ_loss = expected / recorded frames, frame n is (n - pivot) · δ_loss / fps after the pivot.
N frames in the video.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acino_fte.data_tools.clocks import DeviceClock, fit_clock, offset_clock, same_clock
from acino_fte.data_tools.sync_events import Event, lag_of
from acino_fte.data_tools.sync_grid import Dropped, FrameGrid, dropped_runs, frame_grid
from acino_fte.errors import InputError

_JITTERY_MS = 0.5  # stamps that scatter more are times of reception, whatever they are called
_GUESS_MS = 10.0  # standard deviation of the delay of single messages
_HALF_FRAME = 1 / np.sqrt(12)  # standard deviation of an event known to a frame, frames


@dataclass(frozen=True, eq=False)
class Stamps:
    """Stamps of one stream. K messages.

    Attributes
    ----------
    device_ns : (K,) int64
        By the clock of the sensor.
    received_ns : (K,) int64, optional
        By that of the computer.
    number : (K,) int64, optional
        As the camera counted its frames.
    """

    device_ns: np.ndarray
    received_ns: np.ndarray | None = None
    number: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.device_ns)

    def rows(self, which: np.ndarray) -> Stamps:
        """Those of some messages."""
        received = None if self.received_ns is None else self.received_ns[which]
        number = None if self.number is None else self.number[which]
        return Stamps(self.device_ns[which], received, number)


@dataclass(frozen=True, eq=False)
class Synchronisation:
    """Times of the frames of a video.

    Attributes
    ----------
    frame_time : (N,)
        s, by the computer's clock since `origin_ns`.
    origin_ns : int
        What the computer's clock showed at second zero (0 where there is no clock but the lidar's).
    place : (N,) int64
        Of every frame among all that the camera exposed since the first: gaps are dropped frames.
    fps : float
        Of the camera, by that clock.
    dropped : tuple of Dropped
        Runs of frames that were lost; where they were spread evenly, as they were.
    frame_sd_ms : (N,)
        Standard deviation of every time.
    method : str
        ``"stamps"``, ``"pivot"`` or ``"motion"``.
    notes : tuple of str
    """

    frame_time: np.ndarray
    origin_ns: int
    place: np.ndarray
    fps: float
    dropped: tuple[Dropped, ...]
    frame_sd_ms: np.ndarray
    method: str
    notes: tuple[str, ...] = ()

    @property
    def sd_ms(self) -> float:
        """Root mean square of the standard deviations of all frames, ms."""
        return float(np.sqrt(np.mean(self.frame_sd_ms**2)))

    def select(self, start: int, stop: int) -> Synchronisation:
        """Frames start ≤ n < stop; places count from the first of them."""
        place = self.place[start:stop]
        place = place - place[0]
        return replace(
            self,
            frame_time=self.frame_time[start:stop],
            place=place,
            dropped=dropped_runs(place),
            frame_sd_ms=self.frame_sd_ms[start:stop],
        )

    def sequence_time(self, time: np.ndarray) -> np.ndarray:
        """Times (…) s as a sequence counts them: place(n) / fps at frame n, linear between frames."""
        even = self.place / self.fps
        out = np.interp(time, self.frame_time, even)
        out = np.where(time < self.frame_time[0], even[0] + time - self.frame_time[0], out)
        return np.where(time > self.frame_time[-1], even[-1] + time - self.frame_time[-1], out)


def clock_of(stamps: Stamps) -> tuple[DeviceClock, tuple[str, ...]]:
    """The clock of a sensor, and what is to be known of it.

    Stamps in the computer's own time are kept as they are; a sensor without times of reception has the only
    clock there is.
    """
    if stamps.received_ns is None:
        return same_clock(), ()
    if np.array_equal(stamps.device_ns, stamps.received_ns):
        return same_clock(), ("stamps are times of reception",)
    if len(np.unique(stamps.device_ns)) < 3:
        note = f"{len(stamps)} messages are too few to fit a clock; their delay is a guess"
        return offset_clock(stamps.device_ns, stamps.received_ns, _GUESS_MS), (note,)
    clock = fit_clock(stamps.device_ns, stamps.received_ns)
    notes = tuple(str(jump) for jump in clock.jumps)
    if clock.is_computers:
        return same_clock(), (*notes, "stamps are in the computer's time")
    return clock, notes


def from_stamps(
    camera: Stamps, lidar_sd_ms: float = 0.0, *, origin_ns: int = 0, fps: float | None = None
) -> Synchronisation:
    """Times of frames by the camera's stamps.

    A camera that runs evenly and whose stamps scatter, because they are times of reception, is timed by the
    beat below them: the count of its frames is then its clock, fitted by
    :func:`acino_fte.data_tools.clocks.fit_clock`.

    Parameters
    ----------
    camera : Stamps
        Of every frame of the video.
    lidar_sd_ms : float
        Standard deviation of the lidar's clock against the computer's.
    origin_ns : int
        Computer's time of second zero.
    fps : float, optional
        Of the camera, roughly.
    """
    clock, notes = clock_of(camera)
    computer = clock.to_computer_ns(camera.device_ns, camera.received_ns)
    grid = frame_grid(computer if clock.jumps else camera.device_ns, camera.number, fps)
    sd = clock.sd_ms
    even = grid.jitter_ms < 250 * grid.period
    if even and grid.jitter_ms > _JITTERY_MS:
        counter = np.rint(grid.place * (grid.period * 1e9)).astype(np.int64)
        beat = fit_clock(counter, computer, jumps=False)
        notes = (*notes, f"the stamps scatter by {grid.jitter_ms:.1f} ms; the even beat below them counts")
        computer, sd = beat.to_computer_ns(counter), beat.sd_ms
    time = (computer - origin_ns).astype(float) * 1e-9
    period = np.polyfit(grid.place - grid.place.mean(), time - time.mean(), 1)[0]
    return Synchronisation(
        frame_time=time,
        origin_ns=origin_ns,
        place=grid.place,
        fps=float(1 / period),
        dropped=grid.dropped,
        frame_sd_ms=np.full(len(time), np.hypot(sd, lidar_sd_ms)),
        method="stamps",
        notes=(*notes, *grid.notes, f"dropped frames by the camera's {grid.source}"),
    )


def even_losses(n_frames: int, expected: int) -> np.ndarray:
    """Places (N,) of frames when `expected` were exposed and losses are spread evenly (thesis: δ_loss).

    Raises
    ------
    InputError
        More frames were recorded than exposed.
    """
    if expected < n_frames:
        raise InputError(
            "The video has more frames than the camera took.",
            expected=f"at most {expected} frames",
            found=f"{n_frames} frames",
            remedy="check that video and recording belong together, and the frame rate (--fps)",
        )
    if n_frames < 2:
        return np.zeros(n_frames, dtype=np.int64)
    return np.rint(np.arange(n_frames) * ((expected - 1) / (n_frames - 1))).astype(np.int64)


def from_pivot(
    n_frames: int,
    fps: float,
    pivot: tuple[float, float],
    *,
    pivot_sd_ms: float | None = None,
    expected: int | None = None,
    grid: FrameGrid | None = None,
    origin_ns: int = 0,
) -> Synchronisation:
    """Times of frames from one event whose frame and time are known.

    The standard deviation: that of the event, half a frame evenly distributed and by default the same for the
    time; and, where the losses are spread evenly, √(D s (1 - s)) frames at a share s of the video from the
    pivot, as D losses at random have it.

    Parameters
    ----------
    n_frames : int
        N.
    fps : float
        Of the camera.
    pivot : (frame, time)
        Frame of the video (from 0; a half stands between two), and s since `origin_ns`.
    pivot_sd_ms : float, optional
        Standard deviation of the event.
    expected : int, optional
        Frames that the camera exposed from the first to the last of the video, where no stamps tell which are
        missing.
    grid : FrameGrid, optional
        Places of the frames, where they are known.
    origin_ns : int
        What the computer's clock showed at second zero.

    Raises
    ------
    InputError
        The pivot is not in the video, or more frames were recorded than exposed.
    """
    frame, time = pivot
    if not 0 <= frame <= n_frames - 1:
        raise InputError(
            "The pivot frame is not in the video.",
            key="pivot",
            expected=f"0 to {n_frames - 1}",
            found=f"{frame:g}",
            remedy="count frames of the video from 0",
        )
    notes: tuple[str, ...] = ()
    index = np.arange(n_frames)
    loss = 1.0
    lost_sd = np.zeros(n_frames)
    if grid is not None:
        place, fine = grid.place, grid.place.astype(float)
        notes = (f"dropped frames by the camera's {grid.source}",)
    elif expected is not None and expected != n_frames:
        place = even_losses(n_frames, expected)
        loss = (expected - 1) / (n_frames - 1)
        fine = index * loss
        share = np.abs(index - frame) / (n_frames - 1)
        lost_sd = np.sqrt((expected - n_frames) * share * (1 - share))
        notes = (f"{expected - n_frames} dropped frames spread evenly: δ_loss = {loss:.5f}",)
    else:
        place, fine = index.astype(np.int64), index.astype(float)
    if pivot_sd_ms is None:
        pivot_sd_ms = 1e3 * np.sqrt(2) * _HALF_FRAME / fps
    return Synchronisation(
        frame_time=time + (fine - np.interp(frame, index, fine)) / fps,
        origin_ns=origin_ns,
        place=place,
        fps=float(fps),
        dropped=dropped_runs(place),
        frame_sd_ms=np.hypot(pivot_sd_ms, 1e3 * lost_sd / fps),
        method="pivot",
        notes=notes,
    )


def from_motion(
    motion: np.ndarray,
    fps: float,
    imu_time: np.ndarray,
    imu_motion: np.ndarray,
    *,
    expected: int | None = None,
    grid: FrameGrid | None = None,
    origin_ns: int = 0,
) -> Synchronisation:
    """Times of frames from the turning of the rig, which moves the image and which an inertial sensor feels.

    Parameters
    ----------
    motion : (N - 1,) or (N - 1, D)
        From each frame to the next: as much as the image shifted, or components of its shift.
    fps : float
        Of the camera.
    imu_time, imu_motion : (K,)
        s since `origin_ns`, and what turns the image: the length of the angular velocity, or (K, D) what
        shifts the image by its components.
    expected, grid, origin_ns
        As in :func:`from_pivot`.

    Raises
    ------
    InputError
        The two motions do not tell one time.
    """
    n = len(motion) + 1
    base = from_pivot(n, fps, (0, 0.0), pivot_sd_ms=0.0, expected=expected, grid=grid)
    middle = (base.frame_time[1:] + base.frame_time[:-1]) / 2
    rate = (motion.reshape(n - 1, -1).T / np.diff(base.frame_time)).T
    found: Event = lag_of(middle, rate, imu_time, imu_motion)
    return replace(
        base,
        frame_time=base.frame_time + found.time,
        origin_ns=origin_ns,
        frame_sd_ms=np.hypot(base.frame_sd_ms, 1e3 * found.sd),
        method="motion",
        notes=(*base.notes, f"the match of the motions is {found.contrast:.1f} times the next best"),
    )
