"""What all figures share: style, colours, titles."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from acino_fte.result import FTEResult

# Okabe and Ito 2008, Color Universal Design: told apart with every kind of colour blindness.
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
GREY, PALE = "#666666", "#E8E8E8"
BAND_SD = 2.0
"""Half width of error bands and bars, and half axes of error ellipses, in standard deviations."""
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


def keys(figure: Figure, entries: Iterable[tuple[str, str]], left: float, below: float) -> None:
    """Write what the colours mean in one line: (text, colour), from ``left``, ``below`` the top, in."""
    width, height = figure.get_size_inches()
    for text, colour in entries:
        figure.text(left / width, 1 - below / height, text, color=colour, fontsize=8.5)
        left += 0.28 + 0.07 * len(text)


def blank(figure: Figure, text: str) -> Figure:
    """The figure with nothing in it but a reason."""
    nothing(figure.add_subplot(frameon=False, xticks=(), yticks=()), text)
    return figure


def error_band(axes: Axes, x: np.ndarray, values: np.ndarray, sd: np.ndarray, colour: str) -> None:
    """Shade ± 2 standard deviations about values (N,); the limits of the axes stay as they are."""
    limits = axes.get_xlim(), axes.get_ylim()
    low, high = values - BAND_SD * sd, values + BAND_SD * sd
    axes.fill_between(x, low, high, color=colour, alpha=0.22, lw=0)
    axes.set(xlim=limits[0], ylim=limits[1])


def times(result: FTEResult) -> np.ndarray:
    """(N,) time from the start of the recording, s."""
    return np.asarray(result.sequence.frames) / result.sequence.fps
