"""Which frames of an evenly running camera a recording has, by its frame numbers or its stamps.

The grid of a camera counts every frame that it exposed, from the first recorded one on. Dropped frames are
gaps of the grid. N frames were recorded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.errors import InputError

_FIRST = 240  # frames from which the period is found; then twice as many, and again
_SPAN = 0.2  # of the rough frame rate: how far the true one may lie from it
_FINE = 5  # trials within the width of the peak
_EVEN = 0.25  # of a period: stamps that keep to the grid


@dataclass(frozen=True)
class Dropped:
    """A run of frames that were lost: `count` of them before the recorded frame `before`."""

    before: int
    count: int


@dataclass(frozen=True, eq=False)
class FrameGrid:
    """Places of the recorded frames among all that the camera exposed.

    Attributes
    ----------
    place : (N,) int64
        Rising, from 0.
    period : float
        s, by the clock of the stamps.
    jitter_ms : float
        Robust standard deviation of the stamps about an even beat.
    source : str
        ``"frame numbers"`` or ``"stamps"``.
    notes : tuple of str
    """

    place: np.ndarray
    period: float
    jitter_ms: float
    source: str
    notes: tuple[str, ...] = ()

    @property
    def dropped(self) -> tuple[Dropped, ...]:
        """Runs of lost frames."""
        return dropped_runs(self.place)


def dropped_runs(place: np.ndarray) -> tuple[Dropped, ...]:
    """Runs of lost frames, from the places (N,) of the recorded ones."""
    lost = np.diff(place) - 1
    return tuple(Dropped(int(i) + 1, int(lost[i])) for i in np.flatnonzero(lost > 0))


def frame_grid(
    stamps_ns: np.ndarray, numbers: np.ndarray | None = None, fps: float | None = None
) -> FrameGrid:
    """The grid of a camera from its stamps, and from its frame numbers where it counts frames.

    Stamps may be late by many periods, as times of reception are, but hardly early. What the stamps from a
    frame on have in excess of an even beat is at least what was dropped before it, and the least of them is
    about that.

    Parameters
    ----------
    stamps_ns : (N,) int64
        Of every recorded frame, in order.
    numbers : (N,) int64, optional
        As the camera counted.
    fps : float, optional
        Of the camera, roughly, where most frames may be missing.

    Raises
    ------
    InputError
        There are fewer than three frames, or the stamps do not rise.
    """
    n = len(stamps_ns)
    time = (stamps_ns - stamps_ns[0]).astype(float) * 1e-9 if n else np.zeros(0)
    if n < 3 or not time[-1] > 0:
        raise InputError(
            "The stamps of the camera tell no time.",
            expected="three frames or more, with stamps that rise",
            found=f"{n} frames over {time[-1] if n else 0:g} s",
            remedy="choose the frame and the time of one event by hand: --pivot FRAME=SECONDS",
        )
    notes = []
    if numbers is not None:
        steps = np.diff(np.asarray(numbers, dtype=np.int64))
        if (steps > 0).all():
            place = np.concatenate([[0], np.cumsum(steps)])
            return _with_period(place, time, "frame numbers", ())
        notes.append("the camera's frame numbers do not rise; the stamps were used instead")
    rough = 1.0 / fps if fps else float(np.median(np.diff(time)[np.diff(time) > 0]))
    return _with_period(_places(time, _period(time, rough)), time, "stamps", tuple(notes))


def _period(time: np.ndarray, rough: float) -> float:
    """The period whose beat the stamps keep best: the peak of |Σ exp(2πi t / period)| near a rough one, s.

    It is found on the first frames, and then ever more closely on twice as many. Neither drops nor late
    stamps move it.
    """
    n, width = min(_FIRST, len(time)), _SPAN / rough
    frequency = 1.0 / rough
    while True:
        span = max(time[n - 1] - time[0], rough)
        tried = np.arange(frequency - width, frequency + width, 1 / (_FINE * span))
        tried = tried[tried > 0]
        frequency = float(tried[_beat(time[:n], tried).argmax()])
        if n == len(time):
            fine = frequency + np.linspace(-1, 1, 41) / (_FINE * span)
            return 1.0 / float(fine[_beat(time, fine).argmax()])
        width = 1.0 / span
        n = min(2 * n, len(time))


def _beat(time: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    return np.array([abs(np.exp(2j * np.pi * f * time).sum()) for f in frequency])


def _places(time: np.ndarray, period: float) -> np.ndarray:
    """(N,) places: index, and what was dropped before, the least excess over the beat from there on."""
    index = np.arange(len(time))
    excess = time / period - index
    least = np.minimum.accumulate(excess[::-1])[::-1]
    phase = float(np.angle(np.exp(2j * np.pi * least).sum())) / (2 * np.pi)
    lost = np.maximum.accumulate(np.rint(least - phase)).astype(np.int64)
    return index + lost - lost[0]


def _slope(place: np.ndarray, time: np.ndarray) -> float:
    """s per place; stamps that are late are left out."""
    keep = np.ones(len(time), dtype=bool)
    slope = 1.0
    for _ in range(4):
        slope, offset = np.polyfit(place[keep], time[keep], 1)
        error = time - offset - slope * place
        middle = np.median(error)
        spread = 1.4826 * float(np.median(np.abs(error - middle)))
        keep = np.abs(error - middle) <= 3 * spread + 1e-9
    return float(slope)


def _with_period(place: np.ndarray, time: np.ndarray, source: str, notes: tuple[str, ...]) -> FrameGrid:
    period = _slope(place, time)
    error = time - period * place
    jitter = 1.4826 * float(np.median(np.abs(error - np.median(error))))
    if jitter > _EVEN * period:
        notes = (*notes, f"the frames keep no even beat: {1e3 * jitter:.1f} ms about {1e3 * period:.2f} ms")
    return FrameGrid(place.astype(np.int64), period, 1e3 * jitter, source, notes)
