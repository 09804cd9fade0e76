"""The ladder: what each family of parameters is worth in cameras that took part, and in those left out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.ladder_table import rung_titles
from acino_fte.plots_style import BLUE, GREEN, ORANGE, blank, keys, margins, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.result import FTEResult

_SERIES = (
    ("reprojection_px", "o", BLUE, "● cameras that took part"),
    ("heldout_px", "D", GREEN, "◆ left out, cross-fitted"),
    ("heldout_nominal_px", "s", ORANGE, "■ left out, nominal"),
)


def ladder_figure(result: FTEResult) -> Figure:
    """Median error (px) and share within 20 px by rung: nothing fitted, then family by family."""
    rungs = result.evaluation.get("ladder", [])
    figure = new_figure(result, "What each family of parameters is worth", 8.6, 3.6, top=1.05)
    if not rungs:
        return blank(figure, "no ladder was climbed (--holdout-cameras each --ladder)")
    margins(figure, 0.65, 0.25, 0.75, wspace=0.22)
    keys(figure, [(text, colour) for _, _, colour, text in _SERIES], 0.12, 0.66)
    panels = figure.subplots(1, 2)
    for axes, key, factor, label in (
        (panels[0], "median", 1.0, "Median error (px)"),
        (panels[1], "within_20px", 100.0, "Within 20 px (%)"),
    ):
        for series in _SERIES:
            _line(axes, rungs, series, key, factor)
        titles = [
            "\n".join(title.rsplit(" ", 1)) for title in rung_titles(rungs)
        ]  # five fit beside each other
        axes.set_xticks(range(len(rungs)), titles)
        axes.set_xlim(-0.35, len(rungs) - 0.65)
        axes.set_ylabel(label)
    panels[0].set_ylim(0.0, 1.12 * max(panels[0].dataLim.y1, 1.0))
    low = min(panels[1].dataLim.y0, 90.0)
    panels[1].set_ylim(low - 0.12 * (100.0 - low), 100.0)
    figure.text(
        0.5, 0.03, "Fitted beside the trajectory, one family after the other", ha="center", fontsize=9
    )
    return figure


def _line(axes: Axes, rungs: list[dict[str, Any]], series: tuple[str, ...], key: str, factor: float) -> None:
    """One measure over the rungs; a gap where it is undefined."""
    field, marker, colour, _ = series
    found = [rung[field][key] for rung in rungs]
    values = np.array([np.nan if value is None else factor * value for value in found])
    axes.plot(values, f"{marker}-", color=colour, ms=4.5)
