"""What a check finds: gaps, jumps, the account of a stream, requirements and verdicts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Verdict = Literal["pass", "warn", "fail"]
_ORDER: tuple[Verdict, ...] = ("pass", "warn", "fail")
TimeBase = Literal["computer", "device"]
CUT = "the recording was cut short"
DAMAGED = "a file is damaged"
"""What explains a gap besides events."""


def length_text(seconds: float) -> str:
    """A length of time as it is read best: s, or ms."""
    return f"{seconds:.2f} s" if seconds >= 0.1 else f"{1e3 * seconds:.1f} ms"


def worst(verdicts: list[Verdict]) -> Verdict:
    """The worst of some verdicts; ``pass`` of none."""
    return max(verdicts, key=_ORDER.index, default="pass")


@dataclass
class Gap:
    """A stretch of a stream without messages that should be there.

    Attributes
    ----------
    stream : str
    start_ns : int
        When the first missing message was due, by the clock of the check.
    seconds : float
        How long messages are missing: count × period where all were due.
    lost : int
        How many.
    explained : str
        The event of the manifest that tells of it, :data:`CUT` or :data:`DAMAGED`; empty for none.
    """

    stream: str
    start_ns: int
    seconds: float
    lost: int
    explained: str = ""

    @property
    def end_ns(self) -> int:
        """When messages went on."""
        return self.start_ns + round(self.seconds * 1e9)


@dataclass
class ClockJump:
    """A jump of a clock.

    Attributes
    ----------
    clock : str
        ``"wall clock"``, or the stream whose device it is.
    after_ns, time_ns : int
        The last moment before it, and the first one after.
    seconds : float
        By how much, signed.
    explained : str
        The event of the manifest that tells of it; empty for none.
    """

    clock: str
    after_ns: int
    time_ns: int
    seconds: float
    explained: str = ""


@dataclass
class StreamAccount:
    """What is known of one stream.

    Attributes
    ----------
    name, kind : str
    unit : str
        What is counted: messages, samples, frames or packages.
    count : int
    first_ns, last_ns : int, optional
        By the clock of the check; None of an empty stream.
    expected_hz : float, optional
        As the manifest says.
    rate_hz : float
        Of the beat, gaps left out; 0 where there are too few.
    jitter_ms : float
        Robust standard deviation of the steps, less the beat.
    worst_step_ms : float
        The step farthest from the beat, gaps left out.
    lost : int
    gaps : list of Gap
    more_gaps : int
        Those that are counted only.
    duplicates, out_of_order : int
    drift_ppm, drift_sd_ppm : float, optional
        Of the device's clock against the computer's; positive when it is slow.
    delay_ms : float
        Median delay beyond the shortest.
    jumps : list of ClockJump
        Of the device's clock.
    """

    name: str
    kind: str
    unit: str = "messages"
    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    expected_hz: float | None = None
    rate_hz: float = 0.0
    jitter_ms: float = 0.0
    worst_step_ms: float = 0.0
    lost: int = 0
    gaps: list[Gap] = field(default_factory=list)
    more_gaps: int = 0
    duplicates: int = 0
    out_of_order: int = 0
    drift_ppm: float | None = None
    drift_sd_ppm: float | None = None
    delay_ms: float = 0.0
    jumps: list[ClockJump] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """From the first message to the last."""
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def expected(self) -> int:
        """How many there should be, from the first to the last."""
        return self.count - self.duplicates + self.lost

    @property
    def cut(self) -> int:
        """How many are missing at the end because the recording was cut short."""
        return sum(gap.lost for gap in self.gaps if gap.explained == CUT)

    @property
    def lost_share(self) -> float:
        """Of those that should be there."""
        return self.lost / self.expected if self.expected else 0.0

    @property
    def delta_loss(self) -> float:
        """The δ_loss of the WildPose thesis: expected / recorded; 1 without loss."""
        recorded = self.count - self.duplicates
        return self.expected / recorded if recorded else 1.0

    @property
    def longest_whole_s(self) -> float:
        """Length of the longest stretch without a loss, s."""
        if self.first_ns is None or self.last_ns is None or self.more_gaps:
            return 0.0
        edges = [self.first_ns, *(t for gap in self.gaps for t in (gap.start_ns, gap.end_ns)), self.last_ns]
        return max(b - a for a, b in zip(edges[::2], edges[1::2], strict=True)) * 1e-9


@dataclass(frozen=True)
class Warned:
    """What a lidar warned of: text, level (1 a warning, 2 and 3 errors), how often, and from when to when."""

    stream: str
    text: str
    level: int
    count: int
    first_ns: int
    last_ns: int


@dataclass
class CameraAccount:
    """What is known of a camera besides its stamps.

    Attributes
    ----------
    name : str
        The stream.
    n : int
        Messages.
    glitches : list of (time_ns, encoder, counts)
        Counts that jumped: of which encoder, and by how much.
    n_glitches : int
        Also those that are not in the list.
    lens : list of (start_ns, end_ns, encoder, counts)
        When zoom or focus was away from where it stood at the start, and how far.
    exposures : list of (time_ns, before_us, after_us)
        Changes of the exposure time.
    n_exposures : int
    exposure_us : (least, greatest)
    pictures : int
        Pictures that were looked at.
    over, under : float
        Median share of pixels that are white or black, of these.
    dark, bright : int
        Pictures, of these, that are nearly all black or white.
    without_picture : list of int
        Times of messages that have no picture, ns.
    n_without : int
    without_message : int
        Pictures that have no message.
    """

    name: str
    n: int = 0
    glitches: list[tuple[int, int, int]] = field(default_factory=list)
    n_glitches: int = 0
    lens: list[tuple[int, int, int, int]] = field(default_factory=list)
    exposures: list[tuple[int, float, float]] = field(default_factory=list)
    n_exposures: int = 0
    exposure_us: tuple[float, float] | None = None
    pictures: int = 0
    over: float = 0.0
    under: float = 0.0
    dark: int = 0
    bright: int = 0
    without_picture: list[int] = field(default_factory=list)
    n_without: int = 0
    without_message: int = 0


@dataclass(frozen=True)
class Requirement:
    """One line of the verdict: what, of what, the number, the limit, and what to do."""

    name: str
    subject: str
    verdict: Verdict
    found: str
    limit: str
    remedy: str = ""
