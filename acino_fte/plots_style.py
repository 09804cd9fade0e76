"""What all figures share: style, colours, titles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from acino_fte.result import FTEResult

# Okabe and Ito 2008, Color Universal Design: told apart with every kind of colour blindness.
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
GREY, PALE = "#666666", "#E8E8E8"
TIME_MAP = "viridis"  # even in lightness, safe for colour-blind readers

STYLE: dict[str, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titley": 1.0,  # a fixed place; finding one measures every label and doubles the time
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": False,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "pdf.fonttype": 42,  # TrueType, as journals ask; one weight only, because each costs time to embed
    "savefig.facecolor": "white",
    "text.parse_math": False,  # names come from files and may hold a dollar sign
}


def new_figure(result: FTEResult, title: str, width: float, height: float, top: float = 0.62) -> Figure:
    """Start a figure of a size in inches, with a title that says what it shows and of which run.

    ``top`` is the height kept for the title, in; an unfinished run is marked in red.
    """
    figure = Figure(figsize=(width, height))
    figure.subplots_adjust(top=1.0 - top / height)
    frames = result.sequence.frames
    where = (
        f"{result.sequence.name} · {result.skeleton.name} · frames {int(frames[0])}–{int(frames[-1])}"
        f" · {result.sequence.fps:g} frames/s"
    )
    figure.text(0.012, 1 - 0.09 / height, title, va="top", fontsize=13)
    figure.text(0.012, 1 - 0.31 / height, where, va="top", fontsize=8.5, color=GREY)
    if not result.status.ok:
        figure.text(
            0.988,
            1 - 0.09 / height,
            f"NOT CONVERGED: {str(result.status).replace('_', ' ')}",
            va="top",
            ha="right",
            fontsize=11,
            color="white",
            bbox={"facecolor": RED, "edgecolor": "none", "boxstyle": "round,pad=0.3"},
        )
    return figure


def margins(figure: Figure, left: float, right: float, bottom: float, **space: float) -> None:
    """Set margins in inches, and the space between panels (``wspace``, ``hspace``)."""
    width, height = figure.get_size_inches()
    figure.subplots_adjust(left=left / width, right=1 - right / width, bottom=bottom / height, **space)


def nothing(axes: Axes, text: str = "no observations") -> None:
    """Say that a panel has nothing to show."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=GREY)


def times(result: FTEResult) -> np.ndarray:
    """(N,) time from the start of the recording, s."""
    return np.asarray(result.sequence.frames) / result.sequence.fps
