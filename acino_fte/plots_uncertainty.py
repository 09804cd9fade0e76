"""Where the trajectory is sure and where it is not: standard deviation of every marker in every frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.ticker import LogLocator

from acino_fte.metrics_truth import marker_sd, truth_errors, uncertainty_metrics
from acino_fte.plots_style import GREY, TIME_MAP, blank, keys, new_figure, times

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.result import FTEResult

_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 9.5, 1.25, 1.0, 1.15, 0.55  # in
_TICKS = (1.0, 2.0, 5.0)


def uncertainty_figure(result: FTEResult) -> Figure:
    """Standard deviation of the markers along a mean axis, mm, over time, and beside it the error, if known.

    The error is the distance to the truth over √3, so that both panels are of one axis and one scale.
    """
    markers = result.skeleton.marker_names
    height = _TOP + _BOTTOM + 0.19 * len(markers)
    sd = marker_sd(result)
    figure = new_figure(result, "Uncertainty of the markers", _WIDTH, height if sd is not None else 2.0)
    if sd is None or not np.isfinite(sd).any():
        return blank(figure, "no covariances")
    shown = [("Standard deviation claimed", 1e3 * sd)]
    errors = truth_errors(result)
    if errors is not None:
        shown.append(("Error, |estimated − true| / √3", 1e3 * errors / np.sqrt(3.0)))
    low, high = np.nanpercentile(1e3 * sd, (1, 99))
    norm = LogNorm(max(0.8 * low, 1e-3), max(1.25 * high, 2e-3))
    figure.subplots_adjust(_LEFT / _WIDTH, _BOTTOM / height, 1 - _RIGHT / _WIDTH, 1 - _TOP / height, 0.06)
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for i, (axes, (title, values)) in enumerate(zip(panels, shown, strict=True)):
        _map(axes, result, values, norm)
        axes.set_title(title, loc="left")
        axes.set_yticks(*((np.arange(len(markers)), markers) if i == 0 else ([],)))
    place = panels[-1].get_position()
    bar = figure.add_axes((1 - 0.85 / _WIDTH, place.y0, 0.14 / _WIDTH, place.height))
    colours = figure.colorbar(ScalarMappable(norm, TIME_MAP), cax=bar, label="mm", extend="both")
    colours.set_ticks(LogLocator(subs=_TICKS))
    colours.ax.yaxis.set_major_formatter("{x:g}")
    colours.ax.minorticks_off()
    keys(figure, [(_summary(result), GREY), ("blank: no position", GREY)], 0.12, 0.66)
    return figure


def _map(axes: Axes, result: FTEResult, values: np.ndarray, norm: LogNorm) -> None:
    """Values (N, M), mm, as colours: one row a marker, one column a frame."""
    time, half = times(result), 0.5 / result.sequence.fps
    extent = (time[0] - half, time[-1] + half, values.shape[1] - 0.5, -0.5)
    image = np.ma.masked_invalid(values.T)
    axes.imshow(
        image, norm=norm, cmap=colormaps[TIME_MAP], extent=extent, aspect="auto", interpolation="nearest"
    )
    axes.set_xlabel("Time (s)")
    axes.locator_params(axis="x", nbins=5)


def _summary(result: FTEResult) -> str:
    """The numbers of ``metrics.json`` in one line."""
    metrics = uncertainty_metrics(result) or {}
    text = f"median sd {metrics['median_sd_mm']:.1f} mm"
    if metrics.get("nees_per_dim") is not None:
        text += (
            f"; NEES per dimension {metrics['nees_per_dim']:.2f} (1 when the claim is right)"
            f"; {100 * metrics['ellipsoid_coverage_95']:.0f} % of the errors in the 95 % ellipsoid"
        )
    return text
