"""What stamps and error bits of Livox's packages tell: lost datagrams, jumps of the clock, warnings."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

_PAUSE_NS = 60_000_000_000
_MOST_GAPS = 5_000
_OUTLIER_NS = 1_000_000_000
_ERRORS: tuple[tuple[int, int, dict[int, str]], ...] = (
    (0, 3, {1: "the temperature is high or low", 2: "the temperature is extreme", 3: "temperature fault"}),
    (2, 3, {1: "the voltage is high", 2: "the voltage is extreme", 3: "voltage fault"}),
    (4, 3, {1: "motor warning", 2: "motor error", 3: "motor error"}),
    (
        6,
        3,
        {1: "the window is dirty or blocked", 2: "the window is dirty or blocked", 3: "the window is dirty"},
    ),
    (8, 1, {1: "the firmware needs an update"}),
    (10, 1, {1: "the device is near the end of its life"}),
    (11, 1, {1: "fan warning"}),
    (12, 1, {1: "self-heating in the cold"}),
    (30, 3, {1: "the system warns", 2: "the system reports an error", 3: "the system reports an error"}),
)


@dataclass
class StampLog:
    """Stamps of the packages of one stream, and how many are missing between them.

    Attributes
    ----------
    name : str
        Of the stream.
    step : float, optional
        ns between two samples, of the device's type; None where that is not known: it is estimated then.
    held : bool
        Whether the last package taken waits for the next ones.
    n : int
        Packages with sound stamps.
    n_lost : int
        Packages missing between others.
    gaps : list of (first_ns, length_ns, count)
        The first of them: when the missing packages would have begun, for how long, and how many.
    jumped_ns : list of int
        Stamps after jumps of the clock; `jumps` are their sizes, s.
    """

    name: str
    step: float | None = None
    held: bool = False
    n: int = 0
    n_lost: int = 0
    n_gaps: int = 0
    n_outliers: int = 0
    jumps: list[float] = field(default_factory=list)
    jumped_ns: list[int] = field(default_factory=list)
    gaps: list[tuple[int, int, int]] = field(default_factory=list)
    worst: tuple[int, float] = (0, 0.0)
    first_ns: int | None = None
    _estimate: float | None = None
    _last: tuple[int, int] | None = None

    def step_ns(self) -> float:
        """Between two samples, ns; of a lidar that nothing is known of, that of a Tele-15."""
        return self._estimate or self.step or 4_167.0

    def add(self, stamps: np.ndarray, samples: np.ndarray, final: bool = False) -> np.ndarray:
        """Take the stamps (P,) int64 of further packages of so many samples (P,).

        Returns
        -------
        (P,) bool
            False where the stamp is damaged: far from those before and behind, which are near each other.
            A last one that is far from the one before is `held`: it is to be given again with the next ones,
            unless these are the `final` ones.
        """
        n_before = 0 if self._last is None else 1
        if self._last is not None:
            stamps, samples = np.r_[self._last[0], stamps], np.r_[self._last[1], samples]
        keep = _no_outliers(stamps)
        self.n_outliers += int((~keep).sum())
        around = stamps[keep][-2:]
        self.held = not final and len(around) > 1 and abs(int(around[1]) - int(around[0])) > _OUTLIER_NS
        keep[len(keep) - self.held :] = False
        stamps, samples = stamps[keep], samples[keep]
        self.n += int(keep[n_before:].sum())
        if self.first_ns is None and len(stamps):
            self.first_ns = int(stamps[0])
        self._learn(stamps, samples)
        self._count(stamps, samples)
        if len(stamps):
            self._last = int(stamps[-1]), int(samples[-1])
        return keep[n_before:]

    def _learn(self, stamps: np.ndarray, samples: np.ndarray) -> None:
        """Estimate the step where the type of the device does not tell it, or tells it wrong.

        Lost packages lengthen steps; nothing shortens them.
        """
        if self._estimate is not None or len(stamps) < 5:
            return
        median = float(np.median(np.diff(stamps) / samples[:-1]))
        if self.step is None or not 0.75 * self.step <= median:
            near = [known for known in (4_167.0, 5_000.0, 10_000.0) if abs(median - known) < 0.02 * known]
            self._estimate = near[0] if near else median if median > 0 else None
        else:
            self._estimate = self.step

    def _count(self, stamps: np.ndarray, samples: np.ndarray) -> None:
        if len(stamps) < 2:
            return
        gaps = np.diff(stamps)
        nominal = samples[:-1] * self.step_ns()
        jump = (gaps < 0) | (gaps > _PAUSE_NS)
        self.jumps += (gaps[jump] / 1e9).tolist()
        self.jumped_ns += stamps[1:][jump].tolist()
        missing = np.where(jump, 0, np.maximum(np.rint(gaps / nominal) - 1, 0)).astype(np.int64)
        self.n_lost += int(missing.sum())
        self.n_gaps += int((missing > 0).sum())
        begun, length = stamps[:-1] + np.rint(nominal), gaps - np.rint(nominal)
        for i in np.flatnonzero(missing)[: _MOST_GAPS - len(self.gaps)].tolist():
            self.gaps.append((int(begun[i]), int(length[i]), int(missing[i])))
        most = int(missing.argmax())
        if missing[most] > self.worst[0]:
            since = int(stamps[most]) - (self.first_ns or 0)
            self.worst = int(missing[most]), since / 1e9

    def sentences(self) -> list[str]:
        """What is missing, one sentence each."""
        out = []
        if self.n_lost:
            most, when = self.worst
            out.append(
                f"{self.name}: {self.n_lost} datagrams are missing in {self.n_gaps} gaps of the stamps, "
                f"at most {most} at once, {when:.3f} s after the first."
            )
        if self.n_outliers:
            out.append(f"{self.name}: {self.n_outliers} packages with damaged stamps were left out.")
        if self.jumps:
            shown = ", ".join(f"{jump:+.3f}" for jump in self.jumps[:5])
            more = ", …" if len(self.jumps) > 5 else ""
            out.append(f"{self.name}: the clock jumped {len(self.jumps)} times, by {shown}{more} s.")
        return out


def _no_outliers(stamps: np.ndarray) -> np.ndarray:
    """False where one stamp stands alone: its neighbours are near each other and it is far from both."""
    keep = np.ones(len(stamps), dtype=bool)
    if len(stamps) > 2:
        before, behind = np.abs(stamps[1:-1] - stamps[:-2]), np.abs(stamps[2:] - stamps[1:-1])
        around = np.abs(stamps[2:] - stamps[:-2])
        alone = (before > _OUTLIER_NS) & (behind > _OUTLIER_NS) & (around < _OUTLIER_NS)
        keep[1:-1] = ~alone
    return keep


@dataclass
class LidarWarning:
    """What a lidar warned of: text, level (1 warning, 2 and 3 errors), in how many packages, and when, ns."""

    device: int
    text: str
    level: int
    count: int
    first_ns: int
    last_ns: int


class ErrorLog:
    """Warnings of the lidars' error codes, counted in packages."""

    def __init__(self) -> None:
        self._found: dict[tuple[int, str], LidarWarning] = {}

    @property
    def warnings(self) -> tuple[LidarWarning, ...]:
        """All of them, in the order in which they came."""
        return tuple(self._found.values())

    def add(self, device: int, codes: np.ndarray, stamps: np.ndarray) -> None:
        """Take the codes (P,) of packages of a device, and their stamps (P,) int64."""
        if not np.bitwise_or.reduce(codes):
            return
        for shift, mask, texts in _ERRORS:
            values = (codes >> np.uint32(shift)) & np.uint32(mask)
            for value in np.unique(values[values > 0]).tolist():
                mine, key = stamps[values == value], (device, texts[value])
                first, last = int(mine[0]), int(mine[-1])
                found = self._found.setdefault(key, LidarWarning(*key, value, 0, first, last))
                found.count, found.last_ns = found.count + len(mine), last

    def sentences(self) -> list[str]:
        """What the lidars warn of, one sentence each."""
        return [f"lidar{found.device}: {found.text}, in {found.count} packages." for found in self.warnings]
