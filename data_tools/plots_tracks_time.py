"""Which camera sees which animal, and when."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection

from acino_fte.data_tools.colours import colours_of
from acino_fte.data_tools.match_points import SpacePoints
from acino_fte.data_tools.plots_tracks_style import legend, new_track_figure, runs
from acino_fte.plots_style import blank, margins

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.data_tools.track_matching import TrackMatches

_WIDTH, _TALLEST = 9.0, 10.0
_BRIDGED = 1 / 800  # of the recording: gaps too short to be seen are drawn over
_PATH = "#E3E3E3"


def timeline_figure(matches: TrackMatches, points: SpacePoints) -> Figure:
    """A row for each animal, a bar for each camera that sees it; grey behind them where it has a 3D path."""
    n, recording = matches.n_groups, matches.recording
    title = "Which camera sees which animal, and when"
    if not n:
        return blank(new_track_figure(matches, title, _WIDTH, 2.4), "no animal was matched")
    n_views = len(recording.views)
    row = np.clip(0.075 * n_views + 0.09, 0.12, 0.5)
    height = float(np.clip(1.55 + n * row, 2.6, _TALLEST))
    figure = new_track_figure(matches, title, _WIDTH, height, 0.95)
    margins(figure, 0.65, 0.2, 0.5)
    axes = figure.add_subplot()
    unit = 72.0 * (height - 1.45) / n  # points a row
    bridged = max(1, round(_BRIDGED * recording.n_frames))
    paths = _bars(points.group, points.frame, bridged)
    _draw(axes, paths, 0.0, _PATH, 0.86 * unit)
    colours = colours_of(n_views)
    for k, (view, group) in enumerate(zip(recording.views, matches.groups, strict=True)):
        use = group >= 0
        order = np.lexsort((view.frame[use], group[use]))
        bars = _bars(group[use][order], view.frame[use][order], bridged)
        offset = ((k + 0.5) / n_views - 0.5) * 0.8
        _draw(axes, bars, offset, colours[k], max(0.62 * unit / n_views, 0.25))
    last = recording.first_frame + recording.n_frames
    axes.set(
        xlim=(recording.first_frame - 0.5, last - 0.5), ylim=(n - 0.5, -0.5), xlabel="frame", ylabel="animal"
    )
    if n <= 40:
        axes.set_yticks(range(n), [str(g) for g in range(n)], fontsize=8 if n <= 25 else 6)
    axes.tick_params(axis="y", length=0 if n <= 40 else 3)
    shown = list(zip(recording.cameras.names, colours, strict=True))[:10]
    marks: list[tuple[str, dict[str, Any]]] = [(name, {"lw": 4, "color": tuple(c)}) for name, c in shown]
    legend(figure, [*marks, ("3D path", {"lw": 6, "color": _PATH})], 0.1, 0.56)
    return figure


def _bars(group: np.ndarray, frame: np.ndarray, bridged: int) -> np.ndarray:
    """Runs of frames (n, 3): group, first and last frame, of rows sorted by group, then frame."""
    if not len(group):
        return np.empty((0, 3))
    new = np.r_[True, (np.diff(group) != 0) | (np.diff(frame) > 1 + bridged)]
    first, stop = runs(new)
    return np.stack([group[first], frame[first], frame[stop - 1]], axis=1)


def _draw(axes: Axes, bars: np.ndarray, offset: float, colour: Any, width: float) -> None:
    y = bars[:, 0] + offset
    ends = np.stack(
        [np.stack([bars[:, 1] - 0.5, y], axis=1), np.stack([bars[:, 2] + 0.5, y], axis=1)], axis=1
    )
    axes.add_collection(LineCollection(list(ends), colors=[colour], lw=width, capstyle="butt"))
