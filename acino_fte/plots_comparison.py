"""The figure of a comparison: a row a method, a panel a quantity."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from acino_fte.comparison import Block
from acino_fte.plots import DPI
from acino_fte.plots_style import BLUE, GREEN, GREY, ORANGE, PALE, RED, STYLE, keys, margins

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ROW, _TOP, _FOOT, _PANEL, _LEFT = 0.36, 1.05, 0.55, 2.1, 1.35  # in
_IN_SAMPLE = ("o", BLUE, "● cameras that took part", "reprojection_median_px", "within_20px")
_FITTED = ("D", GREEN, "◆ left out, cross-fitted", "heldout_median_px", "heldout_within_20px")
_NOMINAL = ("s", ORANGE, "■ left out, nominal", "heldout_nominal_median_px", "heldout_nominal_within_20px")


def comparison_figure(blocks: list[Block], mean: Block | None = None) -> Figure:
    """Median error, share within 20 px, coverage, error against the truth and time, by method.

    Several sequences are small pale marks, and their mean is a large one. The names of methods that refused
    the input or did not converge say so in red.
    """
    top = mean or blocks[0]
    series = [s for s in (_IN_SAMPLE, _FITTED, _NOMINAL) if _any(blocks, s[3])]
    panels: list[tuple[str, str, list[tuple[str, str, str]]]] = [
        ("Reprojection error", "Median error (px)", [(s[0], s[1], s[3]) for s in series]),
        ("Within 20 px", "Of those with a position (%)", [(s[0], s[1], s[4]) for s in series]),
        ("Coverage", "With a position (%)", _coverage(blocks)),
        ("Error against the truth", "Mean distance (mm)", [("o", BLUE, "truth_mpjpe_mm")]),
        ("Time for the estimate", "Time (s)", [("o", BLUE, "seconds")]),
    ]
    panels = [panel for panel in panels if _any(blocks, panel[2][0][2])]
    width = _LEFT + _PANEL * len(panels) + 0.2
    height = _TOP + _FOOT + _ROW * len(top.rows)
    figure = Figure(figsize=(width, height))
    figure.subplots_adjust(top=1.0 - _TOP / height)
    margins(figure, _LEFT, 0.2, _FOOT, wspace=0.16)
    figure.text(0.012, 1 - 0.09 / height, "Comparison of methods", va="top", fontsize=13)
    subtitle = f"{top.name} · {top.about}" if mean is None else f"{top.name}: {_names(blocks)}"
    figure.text(0.012, 1 - 0.31 / height, subtitle, va="top", fontsize=8.5, color=GREY)
    entries = [(s[2], s[1]) for s in series]
    keys(figure, entries + ([("small marks: one sequence", GREY)] if mean else []), 0.12, 0.68)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for one, (title, label, marks) in zip(axes, panels, strict=True):
        _panel(one, blocks, mean, marks)
        one.set_title(title, loc="left")
        one.set_xlabel(label)
    _scales(axes, [title for title, _, _ in panels])
    _name_rows(axes[0], top)
    for one in axes[1:]:
        one.tick_params(axis="y", labelleft=False, length=0)
    return figure


def _any(blocks: list[Block], name: str) -> bool:
    return any(row.numbers.get(name) is not None for block in blocks for row in block.rows)


def _coverage(blocks: list[Block]) -> list[tuple[str, str, str]]:
    """In the cameras that took part, and in those left out."""
    series = ((_IN_SAMPLE, ""), (_FITTED, "heldout_"), (_NOMINAL, "heldout_nominal_"))
    marks = [(s[0], s[1], f"{prefix}coverage") for s, prefix in series]
    return [mark for mark in marks if _any(blocks, mark[2])]


def _names(blocks: list[Block]) -> str:
    names = [block.name for block in blocks]
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def _panel(axes: Axes, blocks: list[Block], mean: Block | None, marks: list[tuple[str, str, str]]) -> None:
    """Marks of one quantity: (marker, colour, column), side by side in the row of a method."""
    count = len((mean or blocks[0]).rows)
    for row in range(0, count, 2):
        axes.axhspan(row - 0.5, row + 0.5, color=PALE, alpha=0.4, lw=0)
    shifts = np.linspace(-0.22, 0.22, len(marks)) if len(marks) > 1 else [0.0]
    for (marker, colour, name), shift in zip(marks, shifts, strict=True):
        rows = np.arange(count) + shift
        for block in blocks:
            small = mean is not None
            axes.plot(
                _values(block, name),
                rows,
                marker,
                color=colour,
                ms=3 if small else 5.5,
                alpha=0.4 if small else 1,
            )
        if mean is not None:
            axes.plot(_values(mean, name), rows, marker, color=colour, ms=6)
    axes.set_ylim(count - 0.4, -0.6)


def _values(block: Block, name: str) -> np.ndarray:
    """Values of a column, NaN where undefined; shares in percent."""
    factor = 100.0 if name.endswith(("within_20px", "coverage")) else 1.0
    values = [row.numbers.get(name) for row in block.rows]
    return np.array([np.nan if value is None else factor * value for value in values])


def _scales(axes: Any, titles: list[str]) -> None:
    """Errors from zero, shares up to 100 %, times on a logarithmic axis."""
    for one, title in zip(axes, titles, strict=True):
        one.margins(x=0.09)
        if title.startswith("Time"):
            _logarithmic(one)
        elif title in ("Within 20 px", "Coverage"):
            low = min(one.dataLim.x0, 95.0)
            one.set_xlim(low - 0.07 * (100.0 - low), 100.0 + 0.07 * (100.0 - low))
        else:
            one.set_xlim(left=0.0)


def _logarithmic(axes: Axes) -> None:
    """A logarithmic axis with plain numbers at powers of ten, and at 2 and 5 where those are few."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    steps = (1.0,) if high > 100 * low else (1.0, 2.0, 5.0)
    axes.xaxis.set_major_locator(LogLocator(subs=steps))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _name_rows(axes: Axes, block: Block) -> None:
    """Names of the methods at the left; red when the solver did not converge or the input was refused."""
    axes.set_yticks(range(len(block.rows)), [row.title for row in block.rows])
    for label, row in zip(axes.get_yticklabels(), block.rows, strict=True):
        if row.refused or row.unconverged:
            label.set_color(RED)
    axes.tick_params(axis="y", length=0)


def save_comparison_figure(blocks: list[Block], mean: Block | None, folder: Path) -> None:
    """Draw ``comparison.png`` (150 dots per inch) and ``comparison.pdf`` into an existing folder."""
    style: Any = {**dict(matplotlib.rcParamsDefault), **STYLE}  # whatever the user's own settings are
    with matplotlib.rc_context(style):
        figure = comparison_figure(blocks, mean)
        figure.savefig(folder / "comparison.png", dpi=DPI, metadata={"Software": None})
        figure.savefig(folder / "comparison.pdf", metadata={"CreationDate": None, "Producer": None})
