"""Positions that outlive the program: one small JSON file, written whole, never in the way of the loop."""

from __future__ import annotations

import json
import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError

FORMAT = "acino-fte/rig-positions/1"
FILE_NAME = "positions.json"
MAX_COUNTS = 2**53


@dataclass(frozen=True)
class Stored:
    """An encoder's position.

    Attributes
    ----------
    counts : int
        From its zero.
    at_rest : bool
        False while the shaft was turning: after a loss of power the position is not certain.
    sure : bool
        Whether its zero was certain.
    index_at : int, optional
        Counts at the index pulse.
    limits : tuple of int, optional
        Ends of its travel, as homing found them.
    """

    counts: int
    at_rest: bool
    sure: bool
    index_at: int | None = None
    limits: tuple[int, int] | None = None


def state_folder(simulated: bool = False) -> Path:
    """Where positions and the calibration of the joystick are kept from one day to the next."""
    base = os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA")
    root = Path(base) if base else Path.home() / ".local" / "state"
    return root / "acino-fte" / ("rig-simulated" if simulated else "rig")


class PositionStore:
    """The file of positions. Faults of the file never stop a motor's loop: they are told in `trouble`.

    Parameters
    ----------
    folder : Path
        Where ``positions.json`` is, or will be.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE_NAME
        self.trouble = ""
        self._known = self._read()
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="positions")
        self._pending: Future[None] | None = None
        self._unwritten = False

    def get(self, name: str) -> Stored | None:
        """The stored position of an encoder."""
        return self._known.get(name)

    def put(self, name: str, stored: Stored) -> None:
        """Store a position; returns at once. Limits that it does not carry stay as they were."""
        before = self._known.get(name)
        if stored.limits is None and before is not None:
            stored = Stored(**{**asdict(stored), "limits": before.limits})
        self._known[name] = stored
        self._unwritten = True
        self.write()

    def put_limits(self, name: str, limits: tuple[int, int]) -> None:
        """Store the ends of an encoder's travel."""
        before = self._known.get(name) or Stored(0, True, False)
        self.put(name, Stored(**{**asdict(before), "limits": limits}))

    def write(self) -> None:
        """Begin to write what is not written yet, unless the disk is still busy with the last time."""
        if not self._unwritten or (self._pending and not self._pending.done()):
            return
        self._unwritten = False
        self._pending = self._writer.submit(self._write, self._text())

    def close(self) -> None:
        """Write the last state and wait for the disk."""
        self._writer.shutdown(wait=True)
        if self._unwritten:
            self._write(self._text())

    def _text(self) -> str:
        encoders = {name: asdict(stored) for name, stored in sorted(self._known.items())}
        return json.dumps({"format": FORMAT, "encoders": encoders}, indent=1) + "\n"

    def _write(self, text: str) -> None:
        try:
            write_text_whole(self.path, text)
            self.trouble = ""
        except InputError as error:
            self.trouble = f"positions cannot be stored: {error.found}"

    def _read(self) -> dict[str, Stored]:
        try:
            content = json.loads(self.path.read_text(encoding="utf-8"))
            if content["format"] != FORMAT:
                raise ValueError("another format")
            return {name: _stored(item) for name, item in content["encoders"].items()}
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            self.trouble = f"{self.path} cannot be read: positions are unknown"
            return {}


def _stored(item: dict[str, Any]) -> Stored:
    stored = Stored(**{**item, "limits": tuple(item["limits"]) if item.get("limits") else None})
    numbers = [stored.counts, *([] if stored.index_at is None else [stored.index_at]), *(stored.limits or ())]
    if not all(type(number) is int for number in numbers):
        raise TypeError("counts must be whole numbers")
    if max(map(abs, numbers)) > MAX_COUNTS or not (type(stored.at_rest) is type(stored.sure) is bool):
        raise ValueError("impossible counts, or marks that are neither true nor false")
    if stored.limits is not None and not (len(stored.limits) == 2 and stored.limits[0] < stored.limits[1]):
        raise ValueError("impossible ends of the travel")
    return stored
