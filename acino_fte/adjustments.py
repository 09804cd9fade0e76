"""Adjustments of a trajectory by hand: which marker, in which frame, from where to where; undo and redo."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from acino_fte.evaluation_runs import Run
from acino_fte.evaluation_statistics import Moves

_TOGETHER = 1.0  # s: turns of the wheel within it are one step to undo
Vector = tuple[float, float, float]


class Adjustment(BaseModel):
    """One marker in one frame.

    ``before`` is the run's position (m, world frame), None where it has none; ``after`` the one by hand;
    ``view`` the camera in whose image it was moved last; ``pins`` the pixels by hand, by camera, that the
    position was triangulated from; ``time`` of the change, UTC.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    frame: int = Field(ge=0)
    marker: str
    before: Vector | None
    after: Vector
    view: str
    time: datetime
    pins: dict[str, tuple[float, float]] = Field(default_factory=dict)

    @property
    def length(self) -> float:
        """|after − before|, m; NaN where there was no position before."""
        if self.before is None:
            return float("nan")
        return float(np.linalg.norm(np.subtract(self.after, self.before)))


Key = tuple[int, str]
_Step = tuple[Key | int, Adjustment | bool | None, Adjustment | bool | None]  # what, before, after


@dataclass
class Adjustments:
    """The adjustments of one run, with undo and redo.

    Attributes
    ----------
    run : Run
    entries : dict
        Adjustment by frame and marker.
    checked : set of int
        Frames that were marked as checked.
    """

    run: Run
    entries: dict[Key, Adjustment] = field(default_factory=dict)
    checked: set[int] = field(default_factory=set)
    _done: list[_Step] = field(default_factory=list)
    _undone: list[_Step] = field(default_factory=list)
    _rolling: bool = False  # the last step is turns of the wheel, and may go on

    def before(self, frame: int, marker: str) -> Vector | None:
        """The run's own position, m; None where it has none."""
        position = self.run.positions[self._row(frame), self.run.markers.index(marker)]
        return vector(position) if np.isfinite(position).all() else None

    def change(
        self,
        frame: int,
        marker: str,
        after: np.ndarray,
        view: str,
        pins: dict[str, tuple[float, float]] | None = None,
        *,
        together: bool = False,
    ) -> Adjustment:
        """Put a marker somewhere else.

        Parameters
        ----------
        frame : int
            Counted from the start of the recording.
        marker : str
            Its name.
        after : (3,)
            m, world frame.
        view : str
            Camera in whose image it was moved.
        pins : dict, optional
            Pixels by hand, by camera, that hold from now on.
        together : bool
            One step to undo with the change just before, when that was a moment ago, of the same marker in
            the same view, and to be undone together likewise (turns of a wheel).
        """
        now = datetime.now(UTC)
        frame = int(frame)
        entry = Adjustment(
            frame=frame,
            marker=marker,
            before=self.before(frame, marker),
            after=vector(after),
            view=view,
            time=now,
            pins=pins or {},
        )
        key = (frame, marker)
        if together and self._goes_on(key, entry):
            begun = self._done.pop()[1]
            self._set(key, entry)
            self._done.append((key, begun, entry))
        else:
            self._do(key, self.entries.get(key), entry)
        self._rolling = together
        return entry

    def _goes_on(self, key: Key, entry: Adjustment) -> bool:
        """Whether the last step is a turn of the wheel that this one goes on with."""
        what, _, last = self._done[-1] if self._done else (None, None, None)
        if not (self._rolling and what == key and isinstance(last, Adjustment) and last.view == entry.view):
            return False
        return (entry.time - last.time).total_seconds() < _TOGETHER

    def reset(self, frame: int, marker: str) -> bool:
        """Put a marker back to where the run has it; whether it was elsewhere."""
        key = (frame, marker)
        if key not in self.entries:
            return False
        self._do(key, self.entries[key], None)
        return True

    def check(self, frame: int) -> bool:
        """Mark a frame as checked, or take the mark away; whether it has one now."""
        frame = int(frame)
        now = frame not in self.checked
        self._do(frame, not now, now)
        return now

    def undo(self) -> int | None:
        """Take the last change back; its frame, or None when there is none."""
        return self._go(self._done, self._undone, 1)

    def redo(self) -> int | None:
        """Make the change again that was taken back last; its frame, or None when there is none."""
        return self._go(self._undone, self._done, 2)

    @property
    def can_undo(self) -> bool:
        """Whether there is something to take back."""
        return bool(self._done)

    @property
    def can_redo(self) -> bool:
        """Whether there is something to make again."""
        return bool(self._undone)

    def positions(self) -> np.ndarray:
        """(N, M, 3) the run's positions with the adjustments, m."""
        result = self.run.positions.copy()
        for (frame, marker), entry in self.entries.items():
            result[self._row(frame), self.run.markers.index(marker)] = entry.after
        return result

    def moves(self) -> Moves:
        """Lengths of the adjustments, for an evaluation."""
        length = np.full(self.run.positions.shape[:2], np.nan)
        for (frame, marker), entry in self.entries.items():
            length[self._row(frame), self.run.markers.index(marker)] = entry.length
        rows = [self._row(frame) for frame in self.checked | {frame for frame, _ in self.entries}]
        looked_at = np.isfinite(self.run.positions).all(-1)
        if self.checked:
            looked_at[[n for n in range(len(looked_at)) if n not in rows]] = False
        placed = sum(entry.before is None for entry in self.entries.values())
        return Moves(self.run, length, looked_at, placed, bool(self.checked))

    def _row(self, frame: int) -> int:
        return frame - int(self.run.frames[0])

    def _do(self, what: Key | int, before: Any, after: Any) -> None:
        self._set(what, after)
        self._done.append((what, before, after))
        self._undone.clear()
        self._rolling = False

    def _go(self, source: list[_Step], target: list[_Step], side: int) -> int | None:
        if not source:
            return None
        self._rolling = False
        step = source.pop()
        target.append(step)
        self._set(step[0], step[side])
        return step[0] if isinstance(step[0], int) else step[0][0]

    def _set(self, what: Key | int, value: Any) -> None:
        if isinstance(what, int):
            (self.checked.add if value else self.checked.discard)(what)
        elif value is None:
            self.entries.pop(what, None)
        else:
            self.entries[what] = value


def vector(values: np.ndarray) -> Vector:
    """Three numbers as JSON has them."""
    x, y, z = (float(v) for v in values)
    return x, y, z
