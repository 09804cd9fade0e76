"""The skeleton reprojected into every camera beside the detections, in one frame."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import LineCollection

from acino_fte.plots_style import BLUE, GREY, ORANGE, RED, margins, new_figure, nothing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.result import FTEResult

_COLUMNS = 3


def view_figure(result: FTEResult) -> Figure:
    """Detections and reprojections in the best-seen frame of the middle third, cut out around the animal."""
    chosen = best_frame(result)
    names = result.sequence.cameras.names
    columns = min(_COLUMNS, len(names))
    rows = math.ceil(len(names) / columns)
    frame = int(result.sequence.frames[chosen])
    figure = new_figure(
        result,
        f"The skeleton in the cameras, frame {frame}",
        0.8 + 3.1 * columns,
        1.2 + 2.45 * rows,
        top=1.05,
    )
    margins(figure, 0.65, 0.15, 0.5, wspace=0.3, hspace=0.35)
    width, height = figure.get_size_inches()
    legend = (("○ detected", ORANGE), ("● and lines: reprojected", BLUE), ("— error", RED))
    for x, (text, colour) in zip((0.65, 1.55, 3.35), legend, strict=True):
        figure.text(x / width, 1 - 0.6 / height, text, color=colour, fontsize=8.5)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for c, (axes, name) in enumerate(zip(panels, names, strict=False)):
        axes.set_title(name, loc="left")
        _view_panel(axes, result, chosen, c)
        if c % columns == 0:
            axes.set_ylabel("v (px)")
        if c + columns >= len(names):
            axes.set_xlabel("u (px)")
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    return figure


def best_frame(result: FTEResult) -> int:
    """Index of the frame with the most observations in the middle third of the sequence."""
    counts = np.isfinite(result.observed).all(-1).sum(axis=(1, 2))
    third = len(counts) // 3
    return third + int(np.argmax(counts[third : len(counts) - third]))


def _view_panel(axes: Axes, result: FTEResult, n: int, c: int) -> None:
    reprojected, observed = result.reprojected[n, c], result.observed[n, c]
    camera = result.sequence.cameras[c]
    seen = np.isfinite(observed).all(-1)
    inside = camera.inside(reprojected)
    if not (inside.any() or seen.any()):
        nothing(axes, "the animal is outside the image")
        axes.set(xlim=(0, camera.resolution[0]), ylim=(camera.resolution[1], 0), aspect="equal")
        return
    edges = np.array(result.skeleton.edges, dtype=int).reshape(-1, 2)
    lines = reprojected[edges]
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    axes.add_collection(LineCollection(list(lines), colors=BLUE, lw=1.1))
    axes.plot(*reprojected.T, "o", color=BLUE, ms=2.5)
    errors = np.stack([observed, reprojected], axis=1)
    errors = errors[np.isfinite(errors).all(axis=(1, 2))]
    axes.add_collection(LineCollection(list(errors), colors=RED, lw=0.9))
    axes.plot(*observed[seen].T, "o", mfc="none", mec=ORANGE, mew=1.1, ms=5)
    _cut_out(axes, reprojected[inside] if inside.any() else observed[seen], camera.resolution)
    if not seen.any():
        axes.text(
            0.98, 0.03, "nothing detected", transform=axes.transAxes, ha="right", color=GREY, fontsize=8
        )


def _cut_out(axes: Axes, points: np.ndarray, resolution: tuple[int, int]) -> None:
    """Limits around the points in the shape 4:3, v downward; the border of the image is drawn."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * np.maximum(high - low, 20.0) * 1.25 + 5
    half = np.maximum(half, [half[1] * 4 / 3, half[0] * 3 / 4])
    width, height = resolution
    axes.plot([0, width, width, 0, 0], [0, 0, height, height, 0], color=GREY, lw=0.6)
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] + half[1], middle[1] - half[1])
    axes.set_aspect("equal", adjustable="box")
