"""The timeline of a recording: a bar for every stream, with gaps, dropped messages, jumps and events."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from acino_fte.plots_style import BLUE, GREY, ORANGE, PURPLE, RED, SKY, STYLE
from acino_fte.rig.check import Check
from acino_fte.rig.check_types import Gap, StreamAccount

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 110
_LEAST_PX = 1.5  # of a gap, that it is seen
_DROP_S = 0.3  # gaps shorter than this are dropped messages
_WIDTH = 10.5
_KINDS = {"lidar": BLUE, "imu": "#5a8f3c", "image": "#444444", "image_info": "#888888"}
_EVENTS = ("started", "stopped", "lens_back")


def timeline_png(check: Check) -> bytes:
    """The picture as a PNG."""
    style: Any = {**dict(matplotlib.rcParamsDefault), **STYLE}
    with matplotlib.rc_context(style):
        out = BytesIO()
        timeline(check).savefig(out, dpi=DPI, format="png", metadata={"Software": None})
        return out.getvalue()


def timeline(check: Check) -> Figure:
    """Streams against time, s since the recording began."""
    found = check.found
    streams = [stream for stream in found.streams.values() if stream.first_ns is not None]
    rows = len(streams) + 2
    height = 0.34 * rows + 0.85
    figure = Figure(figsize=(_WIDTH, height))
    axes = figure.add_axes((1.55 / _WIDTH, 0.5 / height, 1 - 1.7 / _WIDTH, 0.34 * rows / height))
    figure.text(0.012, 1 - 0.09 / height, found.path.resolve().name, va="top", fontsize=12)
    if found.span is None or not streams:
        axes.text(0.5, 0.5, "nothing was recorded", transform=axes.transAxes, ha="center", color=GREY)
        axes.set(xticks=(), yticks=())
        return figure
    origin, end = found.span
    length = max((end - origin) * 1e-9, 1e-3)
    least = _LEAST_PX / ((_WIDTH - 1.7) * DPI) * length
    for row, stream in enumerate(streams):
        gaps = [*stream.gaps, *_of_messages(check, stream)]
        _bar(axes, stream, gaps, len(streams) - 1 - row, origin, least)
    names = [stream.name for stream in reversed(streams)]
    _events(axes, check, len(streams), origin, length)
    axes.set_yticks(range(len(streams) + 1), [*names, "events"])
    axes.set(xlim=(-0.01 * length, 1.01 * length), ylim=(-0.7, len(streams) + 1.2))
    axes.set_xlabel(f"time since the recording began, s (clock of the {found.base})")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    _legend(figure, check, height)
    return figure


def _of_messages(check: Check, stream: StreamAccount) -> list[Gap]:
    """Gaps of a camera's messages, where its pictures have no times of their own."""
    camera = check.found.streams.get(f"{stream.name.rpartition('/')[0]}/info")
    return camera.gaps if camera is not None and stream.kind == "image" and check.found.kind == "rig" else []


def _bar(axes: Axes, stream: StreamAccount, gaps: list[Gap], y: int, origin: int, least: float) -> None:
    first, last = ((t or 0) - origin for t in (stream.first_ns, stream.last_ns))
    axes.barh(
        y, (last - first) * 1e-9, left=first * 1e-9, height=0.56, color=_KINDS.get(stream.kind, GREY),
        alpha=0.85, lw=0,
    )  # fmt: skip
    for colour, chosen in (
        (ORANGE, [g for g in gaps if g.seconds < _DROP_S]),
        (RED, [g for g in gaps if g.seconds >= _DROP_S]),
    ):
        if chosen:
            begin = np.array([(gap.start_ns - origin) * 1e-9 for gap in chosen])
            width = np.maximum([gap.seconds for gap in chosen], least)
            tall = 0.56 if colour == RED else 0.9
            axes.barh(np.full(len(chosen), y), width, left=begin, height=tall, color=colour, lw=0)
            for gap in chosen:
                if not gap.explained and gap.seconds >= _DROP_S:
                    middle = (gap.start_ns - origin) * 1e-9 + gap.seconds / 2
                    axes.annotate(
                        f"{gap.seconds:.1f} s", (middle, y + 0.32), ha="center", va="bottom", fontsize=7,
                        color=RED, annotation_clip=True,
                    )  # fmt: skip
    jumps = [(jump.time_ns - origin) * 1e-9 for jump in stream.jumps]
    axes.plot(jumps, np.full(len(jumps), y), "D", color=PURPLE, ms=5, mec="white", mew=0.6)


def _events(axes: Axes, check: Check, y: int, origin: int, length: float) -> None:
    """What the recorder noted, and what the wall clock and the cameras did, on a row of their own."""
    found = check.found
    noted = [
        ((event.time_ns - origin) * 1e-9, max(event.seconds, 0.0) if event.kind != "clock_jump" else 0.0,
         event.kind.replace("_", " "))
        for event in (found.manifest.events if found.manifest is not None else ())
        if event.kind not in _EVENTS
    ]  # fmt: skip
    ends, told = [-np.inf, -np.inf, -np.inf], list[tuple[float, str]]()
    for start, seconds, text in sorted(set(noted)):
        axes.barh(y, max(seconds, 0.002 * length), left=start, height=0.3, color=SKY, lw=0)
        level = next((i for i, last in enumerate(ends) if start > last), None)
        if level is None or any(abs(start - t) < 0.01 * length and text == said for t, said in told):
            continue
        told.append((start, text))
        ends[level] = start + length * 0.012 * len(text)
        axes.text(start, y + 0.24 + 0.3 * level, text, fontsize=7, color="#1b4f72", va="bottom")
    for jump in found.wall.jumps:
        axes.plot((jump.time_ns - origin) * 1e-9, y, "D", color=PURPLE, ms=5, mec="white", mew=0.6)
    for camera in found.cameras.values():
        for at, *_ in camera.glitches:
            axes.plot((at - origin) * 1e-9, y - 0.3, "|", color=RED, ms=7)


def _legend(figure: Figure, check: Check, height: float) -> None:
    drawn = [gap for stream in check.found.streams.values() for gap in stream.gaps]
    entries: list[Any] = []
    if any(gap.seconds >= _DROP_S for gap in drawn):
        entries.append(Patch(color=RED, label="gap"))
    if any(gap.seconds < _DROP_S for gap in drawn):
        entries.append(Patch(color=ORANGE, label="dropped"))
    if check.found.wall.jumps or any(stream.jumps for stream in check.found.streams.values()):
        entries.append(Line2D([], [], color=PURPLE, marker="D", ls="", ms=5, label="clock jump"))
    if any(camera.glitches for camera in check.found.cameras.values()):
        entries.append(Line2D([], [], color=RED, marker="|", ls="", ms=7, label="encoder glitch"))
    if entries:
        figure.legend(handles=entries, loc="upper right", ncols=len(entries), bbox_to_anchor=(0.995, 0.995))
    else:
        figure.text(0.985, 1 - 0.12 / height, "no gap, no jump", va="top", ha="right", color=GREY, fontsize=8)
