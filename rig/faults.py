"""Faults that a simulated rig can be given, each at a set time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from acino_fte.errors import InputError, did_you_mean
from acino_fte.rig.rig_file import RigFile

Kind = Literal["stall", "unplug", "lost", "clock", "disk", "lens"]
SYNTAX = "stall:cam1@10+2, unplug:lidar1@20+3, lost:cam1@30+5, clock@40-5, lens:zoom@50+4 or disk@60"
_PATTERN = re.compile(r"(\w+)(?::([\w/]+))?@(\d+(?:\.\d+)?)([+-]\d+(?:\.\d+)?)?")
_KINDS = ("stall", "unplug", "lost", "clock", "disk", "lens")


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes
    ----------
    kind : str
        ``stall``: no data, the device counts on. ``unplug``: the device is gone, and starts anew after.
        ``lost``: samples get lost on the way. ``clock``: the wall clock jumps. ``disk``: it is full from
        then on. ``lens``: a ring is turned, and turned back.
    target : str
        A device, a stream of it (``lidar1/imu``), an encoder; empty for the whole rig.
    at_s : float
        Since the recording began.
    amount : float
        s of a stall, unplugging, jump (signed) or turned lens; samples that are lost.
    """

    kind: Kind
    target: str
    at_s: float
    amount: float

    def covers(self, elapsed_s: float) -> bool:
        """Whether it lasts at a time."""
        return self.at_s <= elapsed_s < self.at_s + self.amount

    def hits(self, stream: str) -> bool:
        """Whether its target is this stream (``cam1``, ``/lidar1/imu``), or the device it is of."""
        return stream.strip("/") == self.target or stream.strip("/").partition("/")[0] == self.target


def parse_fault(text: str, rig: RigFile) -> Fault:
    """Read a fault, such as ``stall:cam1@10+2``.

    Raises
    ------
    InputError
        It cannot be read, or the rig has no such part.
    """
    match = _PATTERN.fullmatch(text.strip())
    kind = match[1] if match else text.partition(":")[0].partition("@")[0]
    if match is None or kind not in _KINDS:
        hint = did_you_mean(kind, _KINDS) if kind not in _KINDS else ""
        raise _wrong("The fault cannot be read.", text, f"as {SYNTAX}{hint}")
    target, at, amount = match[2] or "", float(match[3]), match[4]
    known = _targets(rig)[kind]
    if known and target not in known:
        raise _wrong(f"{kind}: which one?", text, " or ".join(known) + did_you_mean(target, known))
    if not known and target:
        raise _wrong(f"{kind} is of the whole rig.", text, f"{kind}@{match[3]}")
    if (amount is None) != (kind == "disk"):
        raise _wrong(
            "The fault's amount is missing." if amount is None else "A disk stays full.", text, SYNTAX
        )
    size = float(amount or 0.0)
    if kind not in ("clock", "disk") and size <= 0:
        raise _wrong("A fault lasts longer than that.", text, "+ and seconds, or how many are lost")
    if kind == "lost" and size != int(size):
        raise _wrong("Samples are lost whole.", text, "lost:cam1@30+5")
    return Fault(kind, target, at, size)  # type: ignore[arg-type]


def _targets(rig: RigFile) -> dict[str, list[str]]:
    """What each kind of fault can hit; nothing where it is of the whole rig."""
    devices = [*rig.cameras, *rig.lidars]
    imus = [f"{name}/imu" for name, part in rig.lidars.items() if part.imu_hz > 0]
    streams = [*devices, *(f"{name}/points" for name in rig.lidars), *imus]
    rings = [name for name in rig.encoders if name in ("zoom", "focus")]
    return {"stall": streams, "lost": streams, "unplug": devices, "lens": rings, "clock": [], "disk": []}


def _wrong(problem: str, found: str, expected: str) -> InputError:
    return InputError(problem, key="--fault", expected=expected, found=found)


def disk_is_full(faults: Sequence[Fault], elapsed_s: float) -> bool:
    """Whether the disk is full by then."""
    return any(fault.kind == "disk" and fault.at_s <= elapsed_s for fault in faults)


def wall_shift_s(faults: Sequence[Fault], elapsed_s: float) -> float:
    """How far the wall clock has jumped by then, s."""
    return sum(fault.amount for fault in faults if fault.kind == "clock" and fault.at_s <= elapsed_s)
