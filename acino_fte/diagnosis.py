"""Which cameras do not fit the others, and in which frames: out of step, moved, or wrong. For every method.

Per camera and time window, a regression of the residuals gives a delay and a shift of the image
(:mod:`acino_fte.camera_residuals`). A finding needs both a size that matters and four standard errors.
Windows that agree become one finding, whose ends are the stretch of frames that it explains best (the
greatest sum of gains in log-likelihood; Kadane's algorithm). The finding that explains most is taken off,
and the rest is searched again. Only differences between cameras in time mean anything: delays count from the
median camera.

Shapes: N frames, C cameras, M markers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from collections.abc import Sequence as Names
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from acino_fte.camera_residuals import PARTS, Estimate, View, clustered, estimate, regress

_WINDOW = (0.2, 15, 30)  # s, and least and most frames
_MOST_WINDOWS = 200  # of one camera: they grow in a longer recording
_CALM = 5  # windows over which the clock is the median: one window's cameras may differ by chance
_FRAMES_LATE = 0.25  # frames, least delay worth a word
_SHIFT_PX = 5.0  # px, least shift worth a word, and
_SHIFT_SD = 2.0  # standard deviations of a detection
_SIGMAS = 4.0  # standard errors of a finding
_UNEXPLAINED = 0.1  # of what both kinds explain together, that a finding must add to the other
_FAR = 10.0  # standard deviations: the detection is wrong
_WRONG = (0.15, 3.0)  # share of wrong detections worth a word, and its ratio to that of the others
_FEW = 40  # detections that are too few for that
_TOLL = 1.0  # gain in log-likelihood that a frame needs to belong to a finding
_THROUGHOUT = 0.75  # of a camera's frames
_MOST = 8  # findings of one camera


@dataclass(frozen=True)
class CameraFinding:
    """What is wrong with a camera, and when.

    Attributes
    ----------
    camera : str
    kind : str
        ``"delay"``, ``"moved"`` or ``"outliers"``.
    start, stop : int
        Frame numbers, half-open.
    value : tuple of float
        The delay (s; positive: its pictures show a later moment), the shift of the image (du, dv) in px, or
        the share of wrong detections.
    sd : tuple of float
        Standard errors of the values.
    fps : float
        Frames per second.
    throughout : bool
        Whether it holds in nearly all frames in which the camera saw anything.
    """

    camera: str
    kind: str
    start: int
    stop: int
    value: tuple[float, ...]
    sd: tuple[float, ...]
    fps: float
    throughout: bool

    def __str__(self) -> str:
        """One sentence."""
        when = "throughout" if self.throughout else f"in frames {self.start}:{self.stop}"
        if self.kind == "delay":
            return self._delay(when)
        if self.kind == "outliers":
            return (
                f"{self.camera} disagrees with the others in {self.value[0]:.0%} of its detections: "
                "are its keypoints of this camera, this recording and this animal?"
            )
        text = f"its picture is off by ({self.value[0]:+.0f}, {self.value[1]:+.0f}) px {when}"
        if self.throughout:
            return (
                f"{self.camera} is not where its calibration says: {text}; calibrate it again, or estimate "
                "its pose (--fit extrinsics)."
            )
        return f"{self.camera} moved: {text}."

    def _delay(self, when: str) -> str:
        tau, frames = self.value[0], self.value[0] * self.fps
        text = (
            f"{self.camera} is out of step by {1e3 * tau:+.1f} ± {1e3 * self.sd[0]:.1f} ms {when} "
            f"({abs(frames):.1f} frames {'late' if tau > 0 else 'early'})"
        )
        whole = round(frames)
        if not whole or abs(frames - whole) >= _FRAMES_LATE:
            return text + ("; estimate its delay (--fit delay)." if self.throughout else ".")
        count = "one frame" if abs(whole) == 1 else f"{abs(whole)} frames"
        if not self.throughout:
            return f"{text}: perhaps {'it' if whole > 0 else 'every other camera'} dropped {count}."
        way = "later" if whole > 0 else "earlier"
        return f"{text}: a whole number? Give its keypoints frame numbers {count} {way}, or --fit delay."


def diagnose(
    observed: np.ndarray,
    predicted: np.ndarray,
    fps: float,
    cameras: Names[str],
    frames: np.ndarray,
    sd_px: np.ndarray,
) -> list[str]:
    """The findings of :func:`camera_findings`, which takes the same arguments, as sentences."""
    return [str(f) for f in camera_findings(observed, predicted, fps, cameras, frames, sd_px)]


def camera_findings(
    observed: np.ndarray,
    predicted: np.ndarray,
    fps: float,
    cameras: Names[str],
    frames: np.ndarray,
    sd_px: np.ndarray,
) -> list[CameraFinding]:
    """Cameras that are out of step, moved, or disagree with the others.

    Parameters
    ----------
    observed, predicted : (N, C, M, 2)
        Detections that entered the estimate and what it predicts for them, with everything that was
        corrected; px, NaN where there is none.
    fps : float
        Frames per second.
    cameras : sequence of str
        Names.
    frames : (N,) int
        Frame numbers.
    sd_px : (M,)
        Standard deviations of the markers' detections, px.
    """
    frames = np.asarray(frames)
    views = [View.of(observed[:, c], predicted[:, c], fps, sd_px) for c in range(len(cameras))]
    windows = list(_windows(len(frames), fps))
    estimates = [[estimate(view.between(*window)) for window in windows] for view in views]
    clocks = np.array([_clock([e[w] for e in estimates]) for w in range(len(windows))])
    clocks = ndimage.median_filter(clocks, _CALM, mode="nearest")
    findings: list[CameraFinding] = []
    for c, name in enumerate(cameras):
        taken = {kind: np.zeros(len(frames), dtype=bool) for kind in PARTS}
        for _ in range(_MOST):
            best = _Search(views[c], windows, estimates[c], clocks, fps, taken).best
            if best is None:
                break
            findings.append(best.finding(name, frames, views[c], fps))
            taken[best.kind][best.start : best.stop] = True
            views[c] = views[c].without(best.effect, best.start, best.stop)
            for w, (start, stop) in enumerate(windows):
                if start < best.stop and stop > best.start:
                    estimates[c][w] = estimate(views[c].between(start, stop))
    return findings + _outliers(views, fps, cameras, frames)


def _windows(n: int, fps: float) -> Iterator[tuple[int, int]]:
    """Ranges of rows, half overlapping."""
    length = int(np.clip(round(_WINDOW[0] * fps), *_WINDOW[1:]))
    length = min(n, max(length, 2 * n // _MOST_WINDOWS))
    count = max(1, round((n - length) / max(1, length // 2)) + 1)
    for start in np.unique(np.linspace(0, n - length, count).round().astype(int)):
        yield int(start), int(start) + length


def _clock(estimates: list[Estimate | None]) -> float:
    """τ of the median camera, s: what three cameras or more agree on is nobody's delay."""
    known = [(e.effect[0], e.covariance[0, 0]) for e in estimates if e is not None]
    if len(known) < 3:
        return 0.0
    tau, variance = np.array(known).T
    order = np.argsort(tau)
    reached = np.cumsum(1 / np.maximum(variance[order], 1e-12))
    return float(tau[order[np.searchsorted(reached, 0.5 * reached[-1])]])


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A possible finding: its rows, the effect (3,) that it takes, standard errors, and what it gains."""

    kind: str
    start: int
    stop: int
    effect: np.ndarray
    sd: np.ndarray
    gain: float

    def finding(self, camera: str, frames: np.ndarray, view: View, fps: float) -> CameraFinding:
        """It with names and numbers."""
        part = PARTS[self.kind]
        seen = np.unique(view.frame)
        share = np.mean((seen >= self.start) & (seen < self.stop))
        ends = int(frames[self.start]), int(frames[self.stop - 1]) + 1
        value, sd = tuple(self.effect[part].tolist()), tuple(self.sd[part].tolist())
        return CameraFinding(camera, self.kind, *ends, value, sd, fps, bool(share >= _THROUGHOUT))


@dataclass(frozen=True, eq=False)
class _Search:
    """Findings in the residuals of one camera. ``taken`` (N,) bool: rows that have one of a kind."""

    view: View
    windows: list[tuple[int, int]]
    estimates: list[Estimate | None]
    clocks: np.ndarray
    fps: float
    taken: dict[str, np.ndarray]

    @property
    def best(self) -> _Candidate | None:
        """The finding that explains most, None when there is none."""
        candidates = [c for kind in PARTS for c in self._candidates(kind)]
        return max(candidates, key=lambda c: c.gain, default=None)

    @cached_property
    def _least(self) -> dict[str, float]:
        """Least size of an effect that is worth a word, s and px."""
        typical = float(np.median(self.view.sd)) if len(self.view) else 0.0
        return {"delay": _FRAMES_LATE / self.fps, "moved": max(_SHIFT_PX, _SHIFT_SD * typical)}

    def _own(self, kind: str, effect: np.ndarray, clock: float) -> np.ndarray:
        """The part of an effect (3,) that a kind of finding takes: a delay counts from the clock."""
        own = np.zeros(3)
        own[PARTS[kind]] = effect[PARTS[kind]]
        return own - np.array([clock, 0.0, 0.0]) if kind == "delay" else own

    def _state(self, kind: str, found: Estimate | None, clock: float) -> np.ndarray | None:
        """The direction of a certain effect, zeros where there certainly is none, None where unknown."""
        if found is None:
            return None
        part = PARTS[kind]
        value, covariance = self._own(kind, found.effect, clock)[part], found.covariance[part, part]
        size, least = float(np.linalg.norm(value)), self._least[kind]
        sigmas = math.sqrt(max(0.0, float(value @ np.linalg.pinv(covariance) @ value)))
        if size > least and sigmas > _SIGMAS:
            return value / size
        error = math.sqrt(max(0.0, float(np.trace(covariance))))
        return np.zeros(len(value)) if size < least and 2 * error < least else None

    def _groups(self, kind: str) -> Iterator[list[int]]:
        """All windows; then those that agree, with those between them that cannot tell."""
        yield list(range(len(self.windows)))
        groups: list[list[int]] = []
        direction: np.ndarray | None = None
        for w, found in enumerate(self.estimates):
            state = self._state(kind, found, self.clocks[w])
            if state is None:
                continue
            if not state.any():
                direction = None
            elif direction is not None and state @ direction > 0.5:
                groups[-1] = list(range(groups[-1][0], w + 1))
            else:
                groups.append([w])
                direction = state
        yield from groups

    def _candidates(self, kind: str) -> Iterator[_Candidate]:
        """Findings of a kind, each on the stretch of frames that it explains best."""
        margin = self.windows[0][1] - self.windows[0][0]
        for group in self._groups(kind):
            clock = float(np.median(self.clocks[group]))
            start, stop = self.windows[group[0]][0], self.windows[group[-1]][1]
            limits = max(0, start - margin), min(len(self.taken[kind]), stop + margin)
            found = estimate(self.view.between(start, stop))
            for _ in range(2):
                if found is not None:
                    start, stop = self._stretch(kind, found.effect, clock, *limits)
                    found = estimate(self.view.between(start, stop))
            state = self._state(kind, found, clock)
            if found is None or state is None or not state.any() or self.taken[kind][start:stop].any():
                continue
            part, own = self.view.between(start, stop), self._own(kind, found.effect, clock)
            other, *_ = regress(part, PARTS["moved" if kind == "delay" else "delay"])
            both = float(part.gain(found.effect, np.zeros(3)).sum())
            if float(part.gain(found.effect, other).sum()) > _UNEXPLAINED * both:
                alone, *_ = regress(part, PARTS[kind])
                gain = float(part.gain(alone, np.zeros(3)).sum())
                yield _Candidate(kind, start, stop, own, np.sqrt(np.diag(found.covariance)), gain)

    def _stretch(self, kind: str, effect: np.ndarray, clock: float, first: int, last: int) -> tuple[int, int]:
        """Rows start:stop between two with the greatest sum of gains."""
        view = self.view.between(first, last)
        gain = view.gain(effect, effect - self._own(kind, effect, clock))
        seen = np.bincount(view.frame - first, minlength=last - first) > 0
        total = np.bincount(view.frame - first, gain, minlength=last - first) - _TOLL * seen
        sums = np.concatenate([[0.0], np.cumsum(total)])
        stop = max(1, int(np.argmax(sums - np.minimum.accumulate(sums))))
        return first + int(np.argmin(sums[:stop])), first + stop


def _outliers(views: list[View], fps: float, cameras: Names[str], frames: np.ndarray) -> list[CameraFinding]:
    """Cameras with far more wrong detections than the others have."""
    shares, errors = np.full(len(views), np.nan), np.zeros(len(views))
    for c, view in enumerate(views):
        if len(view) >= _FEW:
            wrong = np.linalg.norm(view.residual, axis=-1) > _FAR * view.sd
            shares[c] = wrong.mean()
            spread = clustered((wrong - shares[c])[:, None], view.frame)
            errors[c] = math.sqrt(float(spread[0, 0])) / len(wrong)
    findings = []
    for c, name in enumerate(cameras):
        others = np.delete(shares, c)
        usual = float(np.nanmedian(others)) if np.isfinite(others).any() else math.nan
        least = max(_WRONG[0], _WRONG[1] * usual, usual + _SIGMAS * errors[c])
        if shares[c] > least:
            ends = int(frames[0]), int(frames[-1]) + 1
            value, sd = (float(shares[c]),), (float(errors[c]),)
            findings.append(CameraFinding(name, "outliers", *ends, value, sd, fps, True))
    return findings
