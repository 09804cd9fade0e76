"""An encoder as the rig uses it: counts, angle, velocity, a zero, and a position that outlives the program.

An incremental encoder knows nothing of the time when it had no power. The position is stored whenever the
shaft comes to rest, and marked as moving when it starts; a position that was stored at rest is taken up again
as *sure* if the shaft cannot turn without its motor, otherwise as the last one known.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol

from acino_fte.rig.encoders_store import PositionStore, Stored
from acino_fte.rig.gpio import EdgeInput
from acino_fte.rig.quadrature import EdgeDecoder, Glitches, angle, index_error

WINDOW_NS = 100_000_000
"""Of the velocity."""
REST_NS = 500_000_000
"""Without a count for this long, the shaft is at rest."""
RUN_ON, FROM_ZERO = 1500, 5
"""A counter that went on through an interruption is within the first of where it was: the motor ran on until
its dead-man. One within the second of 0 has started again, unless it was there before."""
_NEAR, _FASTEST, _RUNS_S = 500, 20_000.0, 0.25
"""Counts, and counts a second, by which reports can differ; a motor without commands has stopped after the
third."""
_PAUSE_S, _MOVED = 0.1, 20
"""A counter that comes back from so long a silence within FROM_ZERO of 0, and from further away than the
second, has started again: a microcontroller needs that long to start."""


class CountSource(Protocol):
    """What counts: an own decoder, or a microcontroller."""

    def poll(self) -> int | None:
        """Raw counts now; None as long as nothing is known. Never waits."""

    @property
    def glitches(self) -> Glitches:
        """Faults so far."""

    @property
    def index_position(self) -> int | None:
        """Raw counts at the last pulse of the index, None without one."""

    @property
    def heard_ns(self) -> int | None:
        """When it last said something; None for one that always knows, or has said nothing yet."""


class LineCounts:
    """Counts of an encoder on two or three pins.

    Parameters
    ----------
    lines : EdgeInput
        See :mod:`acino_fte.rig.gpio`.
    min_pulse_ns : int
        Filter of the decoder, see :class:`acino_fte.rig.quadrature.EdgeDecoder`.
    """

    heard_ns = None

    def __init__(self, lines: EdgeInput, *, min_pulse_ns: int = 0) -> None:
        self._lines = lines
        self._decoder = EdgeDecoder(lines.levels, min_pulse_ns=min_pulse_ns)
        self.index_position: int | None = None
        self.lost = 0
        self.trouble = ""

    def poll(self) -> int | None:
        """Counts now; None, and `trouble` says why, where the lines cannot be read any more."""
        try:
            batch = self._lines.read()
        except OSError as error:  # as of a chip on USB that was pulled; the rings are driven on
            self.trouble = f"its lines cannot be read: {error.strerror or error}"
            return None
        self.trouble = ""
        self.lost += batch.lost
        found = self._decoder.feed(batch.edges, batch.until_ns)
        if len(found.index_position):
            self.index_position = int(found.index_position[-1])
        return self._decoder.position

    @property
    def glitches(self) -> Glitches:
        """Faults of the lines; edges that the kernel lost count as such."""
        return self._decoder.glitches + Glitches(repeated=self.lost)

    def close(self) -> None:
        """Give the lines back."""
        self._lines.close()


class ReportedCounts:
    """Counts that a microcontroller reports; whoever reads its messages puts them here.

    A report that the motor cannot have reached is left out and counted as a glitch. If the next one agrees
    with it, the counter has started again (`restarted`), as after a loss of power.
    """

    index_position = None

    def __init__(self) -> None:
        self.counts: int | None = None
        self.glitches = Glitches()
        self.restarted = False
        self.heard_ns: int | None = None
        self._odd: int | None = None

    def poll(self) -> int | None:
        """The last report."""
        return self.counts

    def put(self, counts: int, now_ns: int) -> None:
        """A report.

        Parameters
        ----------
        counts : int
            As the microcontroller said.
        now_ns : int
            By the clock of the loop.
        """
        passed = 0.0 if self.heard_ns is None else max(now_ns - self.heard_ns, 0) * 1e-9
        near = _NEAR + _FASTEST * min(passed, _RUNS_S)
        if self.counts is not None and self._is_odd(counts, near, passed):
            if self._odd is None or abs(counts - self._odd) > near:
                self._odd = counts
                self.glitches += Glitches(illegal=1)
                return
            self.restarted = True
        self.counts, self.heard_ns, self._odd = counts, now_ns, None

    def _is_odd(self, counts: int, near: float, passed_s: float) -> bool:
        """Whether the motor cannot have gone there, or the counter looks as if it began again."""
        moved = abs(counts - (self.counts or 0))
        if self._odd is not None and abs(counts - self._odd) < moved:
            return True
        return moved > near or (passed_s > _PAUSE_S and abs(counts) <= FROM_ZERO and moved > _MOVED)

    def forget(self) -> None:
        """The microcontroller is gone: nothing is known until it reports again."""
        self.counts, self._odd, self.restarted, self.heard_ns = None, None, False, None


@dataclass(frozen=True)
class Reading:
    """An encoder at a moment.

    Attributes
    ----------
    counts : int, optional
        From the zero; None as long as nothing is known.
    angle : float
        rad from the zero, not wrapped; NaN without counts.
    velocity : float
        Counts a second, over the last tenth.
    sure : bool
        Whether the zero is certain: it was set, found by homing or by the index since the last doubt.
    glitches : Glitches
        Faults of the lines.
    """

    counts: int | None
    angle: float
    velocity: float
    sure: bool
    glitches: Glitches


class Encoder:
    """One encoder.

    Parameters
    ----------
    name : str
        ``"zoom"``.
    source : CountSource
        What counts.
    counts_per_turn : float
        Of the decoder (×4).
    store : PositionStore, optional
        Where its position outlives the program.
    self_locking : bool
        Whether the shaft stays where it is without power: rings behind a gearbox do, a head does not.
    """

    def __init__(
        self,
        name: str,
        source: CountSource,
        counts_per_turn: float,
        *,
        store: PositionStore | None = None,
        self_locking: bool = False,
    ) -> None:
        self.name, self.source, self.counts_per_turn = name, source, counts_per_turn
        self.sure, self.missed = False, 0
        self._store = store
        stored = store.get(name) if store else None
        self._last_known = stored.counts if stored else 0
        self._index_at = stored.index_at if stored else None
        self._zero_known = self._index_at is not None
        self._sure_at_start = bool(stored and stored.at_rest and stored.sure and self_locking)
        self._offset: int | None = None
        self._index_seen: int | None = None
        self._doubt, self._restarted = False, False
        self._heard_before: int | None = None
        self._history: deque[tuple[int, int]] = deque()
        self._moved_ns, self._resting = 0, True

    def poll(self, now_ns: int) -> Reading:
        """Read the source.

        Parameters
        ----------
        now_ns : int
            By the clock of the program (monotonic).
        """
        raw = self.source.poll()
        if raw is None or self._is_old():
            return self.reading()
        if self._offset is None:
            self._offset = self._last_known - raw
            self.sure = self._sure_at_start
        elif self._doubt:
            self._take_up(raw)
        self._doubt = self._restarted = False
        self._use_index()
        self._remember(raw + self._offset, now_ns)
        return self.reading()

    @property
    def counts(self) -> int | None:
        """From the zero; None as long as nothing is known."""
        return self._history[-1][1] if self._history else None

    @property
    def velocity(self) -> float:
        """Counts a second over the last tenth."""
        if len(self._history) < 2:
            return 0.0
        (first, start), (last, end) = self._history[0], self._history[-1]
        return (end - start) * 1e9 / (last - first) if last > first else 0.0

    def reading(self) -> Reading:
        """The last reading."""
        counts = self.counts
        turned = float("nan") if counts is None else float(angle(counts, self.counts_per_turn))
        return Reading(counts, turned, self.velocity, self.certain, self.source.glitches)

    @property
    def in_doubt(self) -> bool:
        """Whether the source was gone and has not said since where the shaft is."""
        return self._doubt

    @property
    def certain(self) -> bool:
        """Whether both the zero and the counts hold."""
        return self.sure and not self._doubt

    def zero(self, counts: int = 0) -> None:
        """From now on, where the shaft stands is called this."""
        if self._offset is None or self.counts is None:
            return
        shift = counts - self.counts
        self._offset += shift
        self._history = deque((when, value + shift) for when, value in self._history)
        if self._index_at is not None:
            self._index_at += shift
        self.sure = self._zero_known = True
        self.save(at_rest=self._resting)

    def interrupted(self, *, restarted: bool = False) -> None:
        """The source was gone, as a microcontroller that was unplugged: its counter may start from 0.

        Parameters
        ----------
        restarted : bool
            It is known to have started again.
        """
        self._doubt, self._restarted = True, self._restarted or restarted
        self._heard_before = self.source.heard_ns

    def _is_old(self) -> bool:
        """Whether the source has said nothing since it was interrupted."""
        heard = self.source.heard_ns
        return self._doubt and not self._restarted and heard is not None and heard == self._heard_before

    def save(self, *, at_rest: bool) -> None:
        """Store the position."""
        if self._store and self.counts is not None:
            index = self._index_at if self._zero_known else None
            self._store.put(self.name, Stored(self.counts, at_rest, self.sure, index))

    def save_last(self, since_ns: int) -> None:
        """Store the position for good: at rest only where the source told where the shaft came to rest.

        Parameters
        ----------
        since_ns : int
            When the motor was told to stop.
        """
        heard = self.source.heard_ns
        told = self._resting or heard is None or heard > since_ns
        self.save(at_rest=told and not self._doubt)

    def _take_up(self, raw: int) -> None:
        """After an interruption: the counter went on, or began again where the shaft stood."""
        if self._offset is None or self.counts is None:
            return
        before = self.counts - self._offset
        started_again = abs(raw) <= FROM_ZERO < abs(before)
        if self._restarted or started_again or abs(raw - before) > RUN_ON:
            self._offset, self.sure = self.counts - raw, False

    def _use_index(self) -> None:
        """The index pulse, where there is one, corrects lost counts; the first one gives the angle again."""
        at = self.source.index_position
        if at is None or at == self._index_seen or self._offset is None:
            return
        self._index_seen = at
        if self._index_at is None:
            self._index_at = at + self._offset
            return
        error = index_error(at + self._offset, self._index_at, self.counts_per_turn)
        if self.sure:
            self.missed += abs(error)
        self._offset -= error
        self.sure = self._zero_known

    def _remember(self, counts: int, now_ns: int) -> None:
        moved = bool(self._history) and counts != self._history[-1][1]
        self._history.append((now_ns, counts))
        while len(self._history) > 2 and self._history[1][0] <= now_ns - WINDOW_NS:
            self._history.popleft()
        if moved:
            self._moved_ns = now_ns
            if self._resting:
                self._resting = False
                self.save(at_rest=False)
        elif not self._resting and now_ns - self._moved_ns >= REST_NS:
            self._resting = True
            self.save(at_rest=True)
