"""Coordinates of the markers over time, with standard deviations and truth where these are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acino_fte.metrics_truth import true_positions
from acino_fte.plots_style import (
    BAND_SD,
    BLUE,
    GREY,
    ORANGE,
    PALE,
    blank,
    error_band,
    keys,
    margins,
    new_figure,
    nothing,
    times,
)
from acino_fte.plots_trajectory import travel_axes, travel_frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.result import FTEResult
    from acino_fte.skeleton import Skeleton

_WIDTH, _ROW, _LEAST = 10.0, 0.78, 0.1  # in, in, m
_COLUMNS = ("Along the direction of travel (m)", "To its left (m)", "Height (m)")
_DEGREES = 3, 9  # least and greatest degree of the path


def position_figure(result: FTEResult) -> Figure:
    """Every marker along the direction of travel, to its left, and up, m; one row for a pair of twins.

    The first two are relative to a smooth path of the animal, see :func:`smooth_path`.
    """
    rows = marker_rows(result.skeleton)
    figure = new_figure(result, "Positions of the markers", _WIDTH, 1.45 + _ROW * len(rows), top=1.0)
    if not np.isfinite(result.positions).all(-1).any():
        return blank(figure, "no positions")
    _keys(figure, result)
    margins(figure, 1.55, 0.15, 0.5, wspace=0.22, hspace=0.22)
    panels = figure.subplots(len(rows), 3, squeeze=False)  # sharing axes is slow
    along, _ = travel_frame(result.positions)
    frame = travel_axes(along)
    path = smooth_path(times(result), result.positions) @ frame.T
    path[:, 2] = 0.0
    local = result.positions @ frame.T - path[:, None]
    true = true_positions(result)
    truth = None if true is None else true @ frame.T - path[:, None]
    sd = None
    if result.position_covariance is not None:
        turned = frame @ result.position_covariance @ frame.T
        sd = np.sqrt(np.maximum(np.diagonal(turned, axis1=-2, axis2=-1), 0.0))
    for (name, markers), line in zip(rows, panels, strict=True):
        for axis, axes in enumerate(line):
            _panel(axes, result, markers, axis, local, sd, truth)
        line[0].set_ylabel(name, rotation=0, ha="right", va="center")
        line[0].yaxis.set_label_coords(-0.22, 0.5)
    for axes, title in zip(panels[0], _COLUMNS, strict=True):
        axes.set_title(title, loc="left")
    for axes in panels[:-1].ravel():
        axes.tick_params(axis="x", labelbottom=False)
    for axes in panels[-1]:
        axes.set_xlabel("Time (s)")
    return figure


def _keys(figure: Figure, result: FTEResult) -> None:
    """What the colours mean, under the title."""
    entries = [("— left, or single", BLUE), ("— right", ORANGE)]
    if result.position_covariance is not None:
        entries.append((f"band: ± {BAND_SD:g} sd", BLUE))
    if result.sequence.truth is not None:
        entries.append(("··· truth", "black"))
    entries.append(("along and to the left: relative to a smooth path of the animal", GREY))
    keys(figure, entries, 0.12, 0.66)


def _panel(
    axes: Axes,
    result: FTEResult,
    markers: list[int],
    axis: int,
    local: np.ndarray,
    sd: np.ndarray | None,
    truth: np.ndarray | None,
) -> None:
    """One coordinate (0, 1, 2) of one or two markers, of positions, deviations and truth (N, M, 3), m."""
    time = times(result)
    axes.grid(True, lw=0.3, color=PALE)
    for marker, colour in zip(markers, (BLUE, ORANGE), strict=False):
        values = local[:, marker, axis]
        lone = np.isfinite(values).sum() < 3
        axes.plot(time, values, color=colour, marker="." if lone else None)
        if truth is not None:
            axes.plot(time, truth[:, marker, axis], color="black", lw=0.9, ls=":", zorder=1.5)
    if not np.isfinite(local[:, markers, axis]).any():
        nothing(axes, "no positions")
        return
    low, high = axes.get_ylim()
    middle, half = 0.5 * (low + high), 0.5 * max(high - low, _LEAST)
    axes.set_ylim(middle - half, middle + half)
    axes.locator_params(axis="x", nbins=5)
    axes.locator_params(axis="y", nbins=3)
    if sd is not None:
        for marker, colour in zip(markers, (BLUE, ORANGE), strict=False):
            error_band(axes, time, local[:, marker, axis], sd[:, marker, axis], colour)


def marker_rows(skeleton: Skeleton) -> list[tuple[str, list[int]]]:
    """Name and markers of every row: single markers, and twins (left, right) together."""
    twin = dict(skeleton.twins)
    rights = set(twin.values())
    rows = []
    for i, name in enumerate(skeleton.marker_names):
        if name in twin:
            plain = "_".join(part for part in name.split("_") if part not in ("l", "left")) or name
            rows.append((plain.replace("_", " "), [i, skeleton.marker(twin[name])]))
        elif name not in rights:
            rows.append((name.replace("_", " "), [i]))
    return rows


def smooth_path(time: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """(N, 3) path of the animal, m: a polynomial in time (N,), s, fitted to all markers (N, M, 3) there are.

    Unlike the mean of the markers in a frame, it does not jump when one comes or goes. Its degree is 3 plus
    the duration in seconds, too low to follow a stride.
    """
    there = np.isfinite(positions).all(-1)
    n, m = np.nonzero(there)
    least, most = _DEGREES
    degree = min(least + round(time[-1] - time[0]), most, len(np.unique(n)) - 1)
    scaled = 2 * (time - time[0]) / max(time[-1] - time[0], 1e-9) - 1
    basis = np.polynomial.legendre.legvander(scaled, degree)
    coefficients = np.linalg.lstsq(basis[n], positions[n, m], rcond=None)[0]
    return basis @ coefficients
