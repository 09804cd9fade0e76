"""Depth measured by a lidar against the trajectory: over time, and how the residuals are spread."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acino_fte.plots_style import BLUE, GREY, ORANGE, PALE, blank, keys, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.fusion import DepthResiduals
    from acino_fte.result import FTEResult

_WIDTH, _HEIGHT = 9.5, 4.2  # in
_SHOWN = 4.0  # standard deviations of the bulk, to either side of the histogram


def depth_figure(result: FTEResult) -> Figure:
    """Left: depth of the animal and what the lidar measured, m; right: predicted − measured, cm."""
    depth = result.depth
    figure = new_figure(result, "Depth measured by the lidar", _WIDTH, _HEIGHT if depth is not None else 2.0)
    if depth is None or not len(depth.frame):
        return blank(figure, "no return of a lidar is on the animal")
    figure.subplots_adjust(0.08, 0.13, 0.98, 0.74, 0.22)
    over_time, spread = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
    _over_time(over_time, result, depth)
    _spread(spread, depth)
    numbers = depth.metrics()
    keys(
        figure,
        [
            ("band: nearest to farthest marker", GREY),
            (f"measured ({numbers['n']}, of {numbers['n_returns']} returns)", BLUE),
            ("dashed: ± standard deviation", ORANGE),
            (f"RMSE {100 * numbers['rmse']:.1f} cm, median {100 * numbers['median']:.1f} cm", GREY),
        ],
        0.12,
        0.66,
    )
    return figure


def _over_time(axes: Axes, result: FTEResult, depth: DepthResiduals) -> None:
    camera = result.sequence.cameras[depth.camera]
    z = camera.to_camera(result.positions)[..., 2]
    time = np.asarray(result.sequence.frames) / result.sequence.fps
    axes.fill_between(time, z.min(axis=1), z.max(axis=1), color=PALE, lw=0)
    axes.plot(time[depth.frame], depth.measured, ".", color=BLUE, ms=3)
    axes.set_xlabel("Time (s)")
    axes.set_ylabel("Depth before the camera (m)")
    low, high = z.min(), z.max()
    axes.set_ylim(low - 0.35 * (high - low) - 0.1, high + 0.35 * (high - low) + 0.1)


def _spread(axes: Axes, depth: DepthResiduals) -> None:
    residual = 100 * depth.residual
    width = _SHOWN * 1.4826 * max(float(np.median(np.abs(residual))), 0.1)
    inside = np.abs(residual) <= width
    axes.hist(residual[inside], bins=41, range=(-width, width), color=BLUE)
    axes.axvline(0.0, color=GREY, lw=0.8)
    for side in (-1, 1):
        axes.axvline(side * 100 * float(np.median(depth.sd)), color=ORANGE, lw=0.8, ls="--")
    axes.set_xlabel("Predicted − measured (cm)")
    axes.set_ylabel("Measurements")
    if not inside.all():
        axes.set_title(f"{int((~inside).sum())} beyond ±{width:.0f} cm", loc="right", fontsize=8)
