"""The one screen of driving, as rich renderables."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.text import Text

    from acino_fte.rig.drive_session import AxisStatus, DriveStatus

_BAR = 24
KEYS = (
    "← →  zoom      ↑ ↓  focus      1-5  speed      space  stop      q  quit",
    "h h  home the rings      0 0  zero pan and tilt",
)


def screen(status: DriveStatus, title: str) -> RenderableType:
    """The whole screen."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for heading in ("", "position", "", "motor", ""):
        table.add_column(heading, no_wrap=heading != "")
    for axis in status.axes:
        table.add_row(
            Text(axis.name, style="bold"), _bar(axis), where(axis), _power(axis), Text(said(axis), "yellow")
        )
    lines: list[RenderableType] = [
        Text(title, style="bold"),
        table,
        Text("● " if status.link_good else "○ ", "green" if status.link_good else "red") + Text(status.link),
        Text(f"  joystick: {status.stick}; speed of the keys: {status.speed}"),
        *(Text(f"  {note}", style="yellow") for note in status.notes),
        Text(""),
        *(Text(f"  {line}", style="dim") for line in KEYS),
    ]
    return Group(*lines)


def where(axis: AxisStatus) -> str:
    """Where an axis is, in words: degrees of the head, the share of a ring's travel."""
    reading = axis.reading
    if reading is None or reading.counts is None:
        return "unknown"
    if not axis.driven:
        return f"{math.degrees(reading.angle):+9.2f}°"
    if axis.share is None:
        return f"{reading.counts:+8d} counts"
    return f"{100 * axis.share:5.1f} %  {reading.counts:6d} counts"


def said(axis: AxisStatus) -> str:
    """What the operator must know of an axis."""
    said = [text for text in (axis.trouble, axis.doing) if text]
    reading = axis.reading
    if reading is not None and reading.counts is not None and not axis.doing:
        if axis.driven and not axis.homed:
            said.append("ends unknown, slow: home it (h h)")
        elif not axis.driven and not reading.sure:
            said.append("zero not certain: set it (0 0)")
    if reading is not None and reading.glitches:
        faults = reading.glitches
        said.append(f"{faults.illegal + faults.repeated + faults.bounce} glitches of the encoder")
    return "; ".join(said)


def _bar(axis: AxisStatus) -> Text:
    from rich.text import Text

    if axis.share is None:
        return Text(" " * _BAR)
    place = round(axis.share * (_BAR - 1))
    return Text("─" * place + "●" + "─" * (_BAR - 1 - place), "cyan")


def _power(axis: AxisStatus) -> str:
    if not axis.driven:
        return ""
    if not axis.power:
        return "■ still"
    return f"{'▶' if axis.power > 0 else '◀'} {abs(axis.power):4.0%}"
