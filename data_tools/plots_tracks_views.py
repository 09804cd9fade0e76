"""Matched tracks in every camera's image: dots in the colour of their animal, and its 3D path projected."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb

from acino_fte.data_tools.colours import colours_of
from acino_fte.data_tools.match_points import SpacePoints, predicted_pixels
from acino_fte.data_tools.plots_tracks_style import NAMED, legend, new_track_figure, runs
from acino_fte.plots_style import BLUE, margins, nothing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.data_tools.track_matching import TrackMatches

_MOST_DOTS, _MOST_PATH = 8_000, 25_000  # drawn in a view: dots of every n-th frame; points of paths, or none
_UNMATCHED = "#A8A8A8"
_TONES = 40
_CUT = 0.5  # the image is cut out around the dots when they fill less than this of its sides


def overlay_figure(matches: TrackMatches, points: SpacePoints) -> Figure:
    """One panel a camera: matched dots coloured by animal, unmatched ones grey, 3D paths as thin lines."""
    recording = matches.recording
    names = recording.cameras.names
    columns = min(2 if len(names) <= 4 else 3 if len(names) <= 9 else 4, len(names))
    rows = math.ceil(len(names) / columns)
    limits = [_limits(matches, k) for k in range(len(names))]
    shape = float(np.median([abs((top - bottom) / (right - left)) for left, right, bottom, top in limits]))
    panel = min((10.4 - 0.8) / columns - 0.55, 5.2)
    width = 0.75 + columns * (panel + 0.55)
    height = 0.95 + rows * (panel * min(shape, 1.4) + 0.55) + 0.1
    figure = new_track_figure(matches, "Matched tracks in every camera", width, height, 0.95)
    legend(figure, _marks(matches, points), 0.1, 0.56)
    margins(figure, 0.7, 0.15, 0.5, wspace=0.55 / panel, hspace=0.55 / (panel * min(shape, 1.4)))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    colours = colours_of(matches.n_groups)
    for k, (axes, name) in enumerate(zip(panels, names, strict=False)):
        group = matches.groups[k]
        share = f"{(group >= 0).mean():.1%} of {len(group)} dots" if len(group) else "no dots"
        axes.set_title(f"{name}: {share}", loc="left")
        _panel(axes, matches, points, k, colours)
        left, right, bottom, top = limits[k]
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        if k % columns == 0:
            axes.set_ylabel("v (px)")
        if k + columns >= len(names):
            axes.set_xlabel("u (px)")
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    return figure


def _every(matches: TrackMatches) -> int:
    """Of which frames dots are drawn."""
    return max(1, -(-max(len(view) for view in matches.recording.views) // _MOST_DOTS))


def _marks(matches: TrackMatches, points: SpacePoints) -> list[tuple[str, dict[str, Any]]]:
    every = _every(matches)
    dots = "" if every == 1 else f" (of one frame in {every})"
    marks: list[tuple[str, dict[str, Any]]] = [
        (f"matched, a colour for each animal{dots}", {"ls": "", "marker": ".", "color": BLUE}),
        ("not matched", {"ls": "", "marker": ".", "color": _UNMATCHED}),
    ]
    if len(points) <= _MOST_PATH:
        marks.append(("3D path", {"lw": 0.6, "color": tuple(0.65 * np.array(to_rgb(BLUE)))}))
    return marks


def _limits(matches: TrackMatches, k: int) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of what is shown of a view: the image, or the part of it that has dots."""
    width, height = matches.recording.cameras[k].resolution
    xy = matches.recording.views[k].xy
    whole = -0.5, width - 0.5, height - 0.5, -0.5
    if not len(xy):
        return whole
    low, high = np.quantile(xy, [0.001, 0.999], axis=0)
    margin = 0.05 * np.maximum(high - low, 10.0)
    low, high = low - margin, high + margin
    if (high - low > _CUT * np.array([width, height])).any():
        return whole
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    half = np.maximum(half, half[::-1] * np.array([width / height, height / width]))  # the image's shape
    return middle[0] - half[0], middle[0] + half[0], middle[1] + half[1], middle[1] - half[1]


def _panel(axes: Axes, matches: TrackMatches, points: SpacePoints, k: int, colours: np.ndarray) -> None:
    view, group = matches.recording.views[k], matches.groups[k]
    if not len(view):
        nothing(axes, "no dots")
        return
    every = _every(matches)
    some = view.frame % every == 0 if every > 1 else np.ones(len(view), dtype=bool)
    size = float(np.clip(3.2 - 1.1 * math.log10(max(some.sum(), 1) / 500), 1.0, 3.2))
    shade = np.round(_TONES * colours).astype(int) @ [1, 1000, 1000**2]  # many animals share a few tones
    tones = np.where(group >= 0, shade[group] if len(shade) else -1, -1)
    for tone in np.unique(tones[some]):
        mine = some & (tones == tone)
        colour = colours[group[mine][0]] if tone >= 0 else _UNMATCHED
        axes.plot(*view.xy[mine].T, ".", color=colour, ms=size, mew=0, zorder=2 if tone >= 0 else 1)
    pixels = predicted_pixels(matches, points, k)
    if len(points) <= _MOST_PATH:
        lines, shades = _paths(points, pixels, colours)
        axes.add_collection(LineCollection(lines, colors=shades, lw=0.4, zorder=1.5))
    if matches.n_groups <= NAMED:
        _names(axes, view.xy, group)


def _paths(
    points: SpacePoints, pixels: np.ndarray, colours: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Projected paths as lines, and their colours, darker than those of the dots."""
    known = np.isfinite(pixels).all(1)
    new = np.r_[True, np.diff(points.piece) != 0] if len(points) else np.empty(0, dtype=bool)
    new |= ~known | np.r_[False, ~known[:-1]][: len(points)]
    lines, shades = [], []
    for first, stop in zip(*runs(new), strict=True):
        if known[first] and stop - first > 1:
            lines.append(pixels[first:stop])
            shades.append(0.65 * colours[points.group[first]])
    return lines, shades


def _names(axes: Axes, xy: np.ndarray, group: np.ndarray) -> None:
    """The number of each animal at its first dot."""
    for g in np.unique(group[group >= 0]):
        row = np.flatnonzero(group == g)[0]
        axes.annotate(
            str(g), xy[row], (2, 2), textcoords="offset points", fontsize=7, zorder=4, annotation_clip=True
        )
