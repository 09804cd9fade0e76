"""Incremental encoders decoded: levels or edges of two lines A and B become counts, four to a period.

Forward is A before B: the levels (A, B) go 00, 10, 11, 01 and round again, one count a step, so that the
count and the levels always agree modulo 4. Whole arrays are decoded at once; a stream in chunks keeps its
state between them and gives the same numbers.

Contact bounce and spikes on *one* line need no filter: the counts up and down cancel. What cannot be decoded
is a change of both lines at once. It is two counts in an unknown direction; they are taken in the direction
of the last step, since a shaft that turns too fast to be followed does not turn round in between, and counted
as ``illegal``. A filter (`min_pulse_ns`) is for lines that disturb each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from acino_fte.errors import InputError

A, B, Z = 0, 1, 2
_STEP = np.array([0, 1, 2, -1], np.int64)  # difference of phases, modulo 4 → counts; 2 is illegal


class Edges(NamedTuple):
    """Changes of lines, in the order of their times.

    Attributes
    ----------
    time_ns : (K,) int64
        By any clock that never jumps.
    line : (K,) int8
        0 for A, 1 for B, 2 for the index Z.
    level : (K,) int8
        After the change: 0 or 1.
    """

    time_ns: np.ndarray
    line: np.ndarray
    level: np.ndarray


NO_EDGES = Edges(np.empty(0, np.int64), np.empty(0, np.int8), np.empty(0, np.int8))


class Positions(NamedTuple):
    """What edges amount to.

    Attributes
    ----------
    time_ns : (M,) int64
        Of every change, M ≤ K: edges of one moment are one change.
    position : (M,) int64
        Counts after it.
    index_ns, index_position : (I,) int64
        When the index line rose, and the counts there.
    """

    time_ns: np.ndarray
    position: np.ndarray
    index_ns: np.ndarray
    index_position: np.ndarray


@dataclass(frozen=True)
class Glitches:
    """Faults of the lines, counted since the beginning.

    Attributes
    ----------
    illegal : int
        Both lines changed at once: two counts of unknown direction, the position may be off by four.
    repeated : int
        An edge to the level that the line had already: an edge before it was lost.
    bounce : int
        Pulses shorter than the filter's `min_pulse_ns`, left out.
    """

    illegal: int = 0
    repeated: int = 0
    bounce: int = 0

    def __add__(self, other: Glitches) -> Glitches:
        return Glitches(
            self.illegal + other.illegal, self.repeated + other.repeated, self.bounce + other.bounce
        )

    def __bool__(self) -> bool:
        return self != Glitches()


class EdgeDecoder:
    """Edges in chunks → counts.

    Parameters
    ----------
    levels : (int, int)
        Of A and B before the first edge.
    min_pulse_ns : int
        Filter: an edge counts if its line then stays as it is for this long. 0 for none. It must be well
        below a quarter of the shortest period; positions come later by this much.
    position : int
        Counts at the beginning.
    """

    def __init__(self, levels: tuple[int, int] = (0, 0), *, min_pulse_ns: int = 0, position: int = 0) -> None:
        if min_pulse_ns < 0:
            raise InputError("The filter is impossible.", expected="0 ns or more", found=f"{min_pulse_ns}")
        self.position = position
        self.direction = 0
        self.glitches = Glitches()
        self._min_pulse = min_pulse_ns
        self._levels = [int(levels[0]), int(levels[1])]
        self._raw = list(self._levels)
        self._held = NO_EDGES

    def feed(self, edges: Edges, until_ns: int | None = None) -> Positions:
        """Positions that are certain now.

        Parameters
        ----------
        edges : Edges
            (K,) of this chunk.
        until_ns : int, optional
            No later chunk holds an edge before this time. By default the newest edge's time, so that an edge
            waits for the next one: edges of one moment belong together.
        """
        held = Edges(*(np.concatenate(pair) for pair in zip(self._held, edges, strict=True)))
        if not len(held.time_ns):
            return _nothing()
        order = np.argsort(held.time_ns, kind="stable")
        held = Edges(held.time_ns[order], held.line[order], held.level[order])
        until = int(held.time_ns[-1]) if until_ns is None else until_ns
        n = int(np.searchsorted(held.time_ns, until - max(self._min_pulse, 1), side="right"))
        settled = self._settled(held)
        self._held = Edges(*(column[n:] for column in held))
        return self._decode(Edges(*(column[:n] for column in held)), settled[:n])

    def flush(self) -> Positions:
        """Positions of the edges that were still waiting: nothing more comes."""
        if not len(self._held.time_ns):
            return _nothing()
        return self.feed(NO_EDGES, int(self._held.time_ns[-1]) + self._min_pulse + 1)

    def _settled(self, edges: Edges) -> np.ndarray:
        """(K,) bool: the line keeps its level for the filter's time."""
        settled = np.ones(len(edges.time_ns), bool)
        if self._min_pulse:
            for line in (A, B):
                own = np.flatnonzero(edges.line == line)
                settled[own[:-1]] = np.diff(edges.time_ns[own]) >= self._min_pulse
        return settled

    def _decode(self, edges: Edges, settled: np.ndarray) -> Positions:
        index = edges.time_ns[(edges.line == Z) & (edges.level == 1)]
        counted = edges.line != Z
        repeated = self._repeated(edges)
        keep = counted & settled
        time, line, level = (column[keep] for column in edges)
        before = self.position
        time, phase, first = self._phases(time, line, level)
        step, illegal = self._steps(phase, first)
        position = before + np.cumsum(step)
        if len(position):
            self.position = int(position[-1])
        self.glitches += Glitches(illegal, repeated, int(np.count_nonzero(counted & ~settled)))
        at = np.searchsorted(time, index, side="right")
        return Positions(time, position, index, np.concatenate([[before], position])[at].astype(np.int64))

    def _repeated(self, edges: Edges) -> int:
        """How many edges lead to the level that their line has, before the filter."""
        n = 0
        for line in (A, B):
            level = edges.level[edges.line == line]
            if len(level):
                n += int(level[0] == self._raw[line]) + int(np.count_nonzero(level[1:] == level[:-1]))
                self._raw[line] = int(level[-1])
        return n

    def _phases(
        self, time: np.ndarray, line: np.ndarray, level: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Times (M,) and phases (M,) 0–3 after every moment, and the phase before."""
        a0, b0 = self._levels
        first = 2 * b0 + (a0 ^ b0)
        if not len(time):
            return time, np.empty(0, np.int64), first
        a, b = _filled(line == A, level, a0), _filled(line == B, level, b0)
        self._levels = [int(a[-1]), int(b[-1])]
        ends = np.append(time[1:] != time[:-1], True)
        return time[ends], (2 * b + (a ^ b))[ends].astype(np.int64), first

    def _steps(self, phase: np.ndarray, first: int) -> tuple[np.ndarray, int]:
        """Counts (M,) of every change, and how many of them were illegal."""
        step = _STEP[np.diff(phase, prepend=first) & 3]
        illegal = step == 2
        moves = np.flatnonzero(~illegal & (step != 0))
        if illegal.any():
            last = np.searchsorted(moves, np.flatnonzero(illegal)) - 1
            known = np.append(step[moves], self.direction or 1)  # -1, none before: the last, appended
            step[illegal] *= known[last]
        if len(moves):
            self.direction = int(step[moves[-1]])
        return step, int(np.count_nonzero(illegal))


class SampleDecoder:
    """Levels sampled at an even rate, in chunks → counts.

    Parameters
    ----------
    min_samples : int
        Filter: a level counts if it stays for this many samples; 1 for no filter.
    position : int
        Counts at the first sample.
    """

    def __init__(self, *, min_samples: int = 1, position: int = 0) -> None:
        if min_samples < 1:
            raise InputError("The filter is impossible.", expected="1 sample or more", found=f"{min_samples}")
        self._min = 0 if min_samples == 1 else min_samples
        self._start = position
        self._last: tuple[int, int] | None = None
        self._n = 0
        self._decoder = EdgeDecoder()

    @property
    def position(self) -> int:
        """Counts so far."""
        return self._decoder.position if self._last else self._start

    @property
    def glitches(self) -> Glitches:
        """Faults so far."""
        return self._decoder.glitches

    def feed(self, a: np.ndarray, b: np.ndarray) -> Positions:
        """Changes among these samples; their times are numbers of samples since the beginning.

        Parameters
        ----------
        a, b : (N,) bool or int
            Levels of the two lines.
        """
        a, b = _levels(a), _levels(b)
        if len(a) != len(b):
            raise InputError(
                "The two lines of an encoder are not equally long.",
                expected="as many samples of A as of B",
                found=f"{len(a)} and {len(b)}",
            )
        if not len(a):
            return _nothing()
        if self._last is None:
            self._last = int(a[0]), int(b[0])
            self._decoder = EdgeDecoder(self._last, min_pulse_ns=self._min, position=self._start)
        changes = [
            np.flatnonzero(np.diff(level, prepend=np.int8(last)))
            for level, last in zip((a, b), self._last, strict=True)
        ]
        edges = Edges(
            np.concatenate(changes).astype(np.int64) + self._n,
            np.repeat(np.array([A, B], np.int8), [len(rows) for rows in changes]),
            np.concatenate([a[changes[0]], b[changes[1]]]),
        )
        self._last = int(a[-1]), int(b[-1])
        self._n += len(a)
        return self._decoder.feed(edges, self._n)

    def flush(self) -> Positions:
        """Changes that were still waiting for the filter: nothing more comes."""
        return self._decoder.flush()


def decode_edges(
    edges: Edges, levels: tuple[int, int] = (0, 0), *, min_pulse_ns: int = 0
) -> tuple[Positions, Glitches]:
    """All edges at once; see :class:`EdgeDecoder`."""
    decoder = EdgeDecoder(levels, min_pulse_ns=min_pulse_ns)
    first, rest = decoder.feed(edges), decoder.flush()
    return Positions(*(np.concatenate(pair) for pair in zip(first, rest, strict=True))), decoder.glitches


def decode_samples(a: np.ndarray, b: np.ndarray, *, min_samples: int = 1) -> tuple[np.ndarray, Glitches]:
    """Counts (N,) int64 at every sample, 0 at the first, and the faults; see :class:`SampleDecoder`."""
    decoder = SampleDecoder(min_samples=min_samples)
    first, rest = decoder.feed(a, b), decoder.flush()
    position = np.concatenate([[0], first.position, rest.position])
    time = np.concatenate([first.time_ns, rest.time_ns])
    return position[np.searchsorted(time, np.arange(len(a)), side="right")], decoder.glitches


def edges_of(position: np.ndarray, time_ns: np.ndarray, before: int = 0) -> tuple[Edges, tuple[int, int]]:
    """Edges of a shaft that goes through these counts, and the levels before: what an encoder would give.

    Parameters
    ----------
    position : (K,) int
        Counts, each one more or one less than the one before.
    time_ns : (K,) int64
        When they are reached.
    before : int
        Counts before the first.
    """
    position = np.asarray(position, np.int64)
    phase = np.concatenate([[before], position]) & 3
    b = (phase >> 1).astype(np.int8)
    a = ((phase & 1) ^ b).astype(np.int8)
    line = np.where(a[1:] != a[:-1], A, B).astype(np.int8)
    level = np.where(line == A, a[1:], b[1:])
    return Edges(np.asarray(time_ns, np.int64), line, level.astype(np.int8)), (int(a[0]), int(b[0]))


def index_error(position: int, reference: int, counts_per_turn: float) -> int:
    """Counts by which a position at the index pulse is off, to the nearest turn.

    Parameters
    ----------
    position, reference : int
        Counts at this pulse, and at the one that is taken as right.
    counts_per_turn : float
        Of the decoder.
    """
    turns = round((position - reference) / counts_per_turn)
    return position - reference - round(turns * counts_per_turn)


def angle(counts: np.ndarray | float, counts_per_turn: float, zero: float = 0.0) -> np.ndarray | float:
    """Angle in rad since the zero, not wrapped: 2π (counts - zero) / counts per turn."""
    return 2 * np.pi * (counts - zero) / counts_per_turn


def _filled(own: np.ndarray, level: np.ndarray, before: int) -> np.ndarray:
    """(K,) level of one line after every edge of either."""
    last = np.maximum.accumulate(np.where(own, np.arange(len(own)), -1))
    return np.where(last >= 0, level[last], before).astype(np.int8)


def _levels(values: np.ndarray) -> np.ndarray:
    return (np.asarray(values) != 0).astype(np.int8)


def _nothing() -> Positions:
    return Positions(*(np.empty(0, np.int64) for _ in range(4)))
