"""What a user says of the event that video and lidar share."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from acino_fte.errors import InputError

PIVOTS = "FRAME=SECONDS, strike, strike:FRAME=SECONDS, led:X,Y,W,H=SECONDS or knock"


@dataclass(frozen=True)
class PivotHint:
    """What the user says of one event: a frame, a light's region, a knock, or a paw's strike."""

    kind: Literal["frame", "led", "knock", "strike"]
    frame: float | None = None
    region: tuple[int, int, int, int] = (0, 0, 0, 0)
    seconds: float = 0.0


def pivot_hint(text: str | None) -> PivotHint | None:
    """``FRAME=SECONDS``, ``strike[:FRAME=SECONDS]``, ``led:X,Y,W,H=SECONDS`` or ``knock``.

    Seconds are from the lidar's first return; those of a strike are known roughly.

    Raises
    ------
    InputError
        The text is none of them.
    """
    if text is None:
        return None
    number = r"[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?"
    plain = text.strip().lower()
    if plain == "knock":
        return PivotHint("knock")
    if plain == "strike":
        return PivotHint("strike")
    if match := re.fullmatch(rf"strike:\s*({number})\s*=\s*({number})s?", plain):
        return PivotHint("strike", frame=float(match[1]), seconds=float(match[2]))
    if match := re.fullmatch(rf"({number})\s*=\s*({number})s?", plain):
        return PivotHint("frame", frame=float(match[1]), seconds=float(match[2]))
    if match := re.fullmatch(rf"led:\s*(\d+),(\d+),(\d+),(\d+)\s*=\s*({number})s?", plain):
        x, y, width, height = (int(match[i]) for i in range(1, 5))
        return PivotHint("led", region=(x, y, width, height), seconds=float(match[5]))
    raise InputError("The pivot cannot be read.", key="--pivot", expected=PIVOTS, found=text)
