"""What the figures of a matching share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from acino_fte.plots_style import GREY

if TYPE_CHECKING:
    from acino_fte.data_tools.track_matching import TrackMatches

NAMED = 25
"""With more animals than this, their numbers are not written."""


def new_track_figure(
    matches: TrackMatches, title: str, width: float, height: float, top: float = 0.7
) -> Figure:
    """Start a figure of a size in inches, with a title; `top` is the height kept for it, in."""
    recording = matches.recording
    figure = Figure(figsize=(width, height))
    figure.subplots_adjust(top=1.0 - top / height)
    last = recording.first_frame + max(recording.n_frames - 1, 0)
    where = (
        f"{recording.name} · {matches.n_groups} animals · {len(recording.views)} cameras · "
        f"frames {recording.first_frame} to {last}"
        + ("" if recording.fps is None else f" · {recording.fps:g} frames/s")
    )
    figure.text(0.1 / width, 1 - 0.09 / height, title, va="top", fontsize=13)
    figure.text(0.1 / width, 1 - 0.33 / height, where, va="top", fontsize=8.5, color=GREY)
    return figure


def legend(figure: Figure, entries: Sequence[tuple[str, dict[str, Any]]], left: float, below: float) -> None:
    """What the marks mean, in a line: (text, properties of a line), from `left`, `below` the top, in."""
    width, height = figure.get_size_inches()
    figure.legend(
        [Line2D([], [], **{"color": GREY, **mark}) for _, mark in entries],
        [text for text, _ in entries],
        loc="upper left",
        bbox_to_anchor=(left / width, 1 - below / height),
        ncols=len(entries),
        borderpad=0,
        borderaxespad=0,
        handlelength=1.5,
        handletextpad=0.5,
        columnspacing=1.6,
        labelcolor=GREY,
    )


def runs(breaks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and stop of the runs of n entries, where `breaks` (n,) says that an entry begins a new one."""
    if not len(breaks):
        return np.empty(0, dtype=int), np.empty(0, dtype=int)
    breaks = breaks.copy()
    breaks[0] = True
    start = np.flatnonzero(breaks)
    return start, np.append(start[1:], len(breaks))
