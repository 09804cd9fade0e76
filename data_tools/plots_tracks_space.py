"""The animals in space: from above, from the front and from the side in one scale, and in perspective."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection

from acino_fte.data_tools.colours import colours_of
from acino_fte.data_tools.match_points import SOURCE_NAMES, SpacePoints
from acino_fte.data_tools.plots_tracks_style import NAMED, legend, new_track_figure, runs
from acino_fte.plots_style import GREY, blank
from acino_fte.report_scene import ground_grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.data_tools.track_matching import TrackMatches

_WIDTH, _MARGIN, _GAP, _TOP = 9.6, 0.62, 0.62, 0.9
_MOST = 60_000  # points drawn in a panel
_FLATTEST = 0.3  # of the longest side, so that a panel keeps some height
_WITH_CAMERAS = 1.35  # cameras are shown when they do not stretch the picture more than this
_LONG = 8  # points; what is shorter may lie outside the picture
_WILD, _KEPT = (
    0.001,
    2.0,
)  # share of points that may be far off; how far, of the others' extent, is shown still
_PERSPECTIVE = 0.6  # least width of the perspective view, of that of the view from above
_FILLED = [SOURCE_NAMES.index("filled"), SOURCE_NAMES.index("extended")]
_AZIMUTH, _ELEVATION, _DISTANCE = np.radians(-60.0), np.radians(24.0), 2.6

Lines = list[tuple[np.ndarray, int, str]]


def space_figure(matches: TrackMatches, points: SpacePoints) -> Figure:
    """3D tracks, a colour an animal; solid where a camera sees it, dashed where the path is filled, dotted
    across gaps.
    """
    if not len(points):
        return blank(new_track_figure(matches, "3D tracks", _WIDTH, 2.4), "no animal was matched")
    lines = track_lines(points)
    centres = _camera_centres(matches, points)
    low, high = _box(points, centres)
    size = high - low
    scale = (_WIDTH - _MARGIN - 0.15 - _GAP) / (size[0] + max(size[1], _PERSPECTIVE * size[0]))
    height = _TOP + _GAP + _MARGIN + scale * (size[2] + size[1])
    if height > 10.0:
        scale *= (10.0 - _TOP - _GAP - _MARGIN) / (height - _TOP - _GAP - _MARGIN)
        height = 10.0
    figure = new_track_figure(matches, "3D tracks, a colour for each animal", _WIDTH, height, _TOP)
    marks: list[tuple[str, dict[str, Any]]] = [
        ("seen", {"ls": "-"}),
        ("filled", {"ls": "--"}),
        ("gap", {"ls": ":"}),
    ]
    if centres:
        marks.append(("camera", {"ls": "", "marker": "^", "mfc": "white", "ms": 5}))
    legend(figure, marks, 0.1, 0.56)
    colours = colours_of(matches.n_groups)
    w, d, h = scale * size
    left, upper = _MARGIN, _MARGIN + d + _GAP
    beside = left + w + _GAP
    places = {(0, 2): (left, upper, w, h), (1, 2): (beside, upper, d, h), (0, 1): (left, _MARGIN, w, d)}
    for (i, j), box in places.items():
        axes = figure.add_axes(_fraction(box, height), xlim=(low[i], high[i]), ylim=(low[j], high[j]))
        _flat_panel(axes, lines, colours, centres, (i, j))
    room = (beside, _MARGIN - 0.3, _WIDTH - 0.15 - beside, d + 0.3)
    _solid_panel(figure.add_axes(_fraction(room, height)), lines, colours, points, matches.n_groups)
    return figure


def _fraction(box: tuple[float, float, float, float], height: float) -> tuple[float, float, float, float]:
    return box[0] / _WIDTH, box[1] / height, box[2] / _WIDTH, box[3] / height


def track_lines(points: SpacePoints, most: int = _MOST) -> Lines:
    """Pieces of path to draw: positions (n, 3), group, and ``-``, ``--`` (filled) or ``:`` (across a gap).

    Very many points are thinned to `most`, evenly along each path.
    """
    every = max(1, -(-len(points) // most))
    same = np.r_[False, np.diff(points.group) == 0]
    joined = np.r_[False, np.diff(points.piece) == 0] & same
    filled = np.isin(points.source, _FILLED)
    dashed = joined & (filled | np.r_[False, filled[:-1]])
    kind = np.where(~joined, 0, np.where(dashed, 2, 1))  # of the step to each point from the one before
    lines: Lines = []
    for first, stop in zip(*runs(np.r_[True, np.diff(kind) != 0] | (kind == 0)), strict=True):
        if kind[first] == 0:
            if same[first]:
                lines.append((points.position[first - 1 : first + 1], int(points.group[first]), ":"))
            continue
        along = points.position[first - 1 : stop]
        thin = np.unique(np.r_[np.arange(0, len(along), every), len(along) - 1])
        lines.append((along[thin], int(points.group[first]), "--" if kind[first] == 2 else "-"))
    return lines


def _camera_centres(matches: TrackMatches, points: SpacePoints) -> list[np.ndarray]:
    """Camera centres (1 | N, 3), or none when they are far away."""
    centres = [np.atleast_2d(camera.centre) for camera in matches.recording.cameras]
    (low, high), (all_low, all_high) = _box(points), _box(points, centres)
    return centres if (all_high - all_low).sum() <= _WITH_CAMERAS * (high - low).sum() else []


def _box(points: SpacePoints, centres: Sequence[np.ndarray] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Limits (3,), (3,) around cameras and all tracks that are not short or wild; no side is much shorter."""
    long = np.bincount(points.group)[points.group] >= _LONG
    position = points.position[long] if long.any() else points.position
    inner, outer = np.quantile(position, [_WILD, 1 - _WILD], axis=0)
    reach = _KEPT * (outer - inner)
    low, high = np.maximum(position.min(0), inner - reach), np.minimum(position.max(0), outer + reach)
    for centre in centres:
        low, high = np.minimum(low, centre.min(0)), np.maximum(high, centre.max(0))
    half = 0.53 * np.maximum(high - low, 1e-6)
    half = np.maximum(half, _FLATTEST * half.max())
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def _flat_panel(
    axes: Axes, lines: Lines, colours: np.ndarray, centres: list[np.ndarray], shown: tuple[int, int]
) -> None:
    _draw(axes, [(line[:, list(shown)], group, style) for line, group, style in lines], colours)
    for centre in centres:
        axes.plot(*centre[:1, list(shown)].T, "^", color=GREY, ms=5, mfc="white", clip_on=False, zorder=3)
    axes.set_xlabel(f"{'xyz'[shown[0]]} (m)", labelpad=1)
    axes.set_ylabel(f"{'xyz'[shown[1]]} (m)", labelpad=1)
    box = axes.get_window_extent().width / axes.figure.dpi
    axes.locator_params(axis="x", nbins=int(np.clip(box / 0.55, 2, 9)))
    axes.grid(True, lw=0.3, color="#D5D5D5")
    axes.set_axisbelow(True)


def _draw(axes: Axes, lines: Lines, colours: np.ndarray) -> None:
    """Lines (n, 2) in the colours of their groups."""
    fine = float(
        np.clip(1.1 - 0.3 * np.log10(max(sum(len(line) for line, _, _ in lines), 1) / 1500), 0.3, 1.1)
    )
    for style, width in ((":", 0.5 * fine), ("--", 0.8 * fine), ("-", fine)):
        chosen = [(line, colours[group]) for line, group, kind in lines if kind == style]
        if chosen:
            segments, shades = zip(*chosen, strict=True)
            axes.add_collection(
                LineCollection(list(segments), colors=list(shades), lw=width, ls=style, capstyle="butt")
            )


def _solid_panel(axes: Axes, lines: Lines, colours: np.ndarray, points: SpacePoints, n_groups: int) -> None:
    """All tracks in perspective, above a grid on the ground."""
    low, high = _box(points)
    inside = points.position[((points.position >= low) & (points.position <= high)).all(1)]
    view, grid = _Perspective(low, high), ground_grid(inside[:, None])
    floor = min(grid["z"], float(inside[:, 2].min()))
    xs = np.arange(grid["x0"], grid["x1"] + grid["step"] / 2, grid["step"])
    ys = np.arange(grid["y0"], grid["y1"] + grid["step"] / 2, grid["step"])
    mesh = np.array(
        [[(x, ys[0], floor), (x, ys[-1], floor)] for x in xs]
        + [[(xs[0], y, floor), (xs[-1], y, floor)] for y in ys]
    )
    axes.add_collection(LineCollection(list(view(mesh)), colors="#D5D5D5", lw=0.4))
    _draw(axes, [(view(line), group, style) for line, group, style in lines], colours)
    if n_groups <= NAMED:
        _name(axes, view, points, colours)
    drawn = np.concatenate([view(inside), view(mesh).reshape(-1, 2)])
    low, high = drawn.min(0), drawn.max(0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=(), yticks=())
    axes.axis("off")
    axes.text(
        0.0, 0.0, f"grid {grid['step']:g} m", transform=axes.transAxes, va="top", fontsize=8, color=GREY
    )


def _name(axes: Axes, view: _Perspective, points: SpacePoints, colours: np.ndarray) -> None:
    """A ring and the number of each animal where it is first."""
    group, first = np.unique(points.group, return_index=True)
    starts = view(points.position[first])
    axes.scatter(
        starts[:, 0],
        starts[:, 1],
        s=9,
        facecolors="white",
        edgecolors=colours[group],
        linewidths=0.8,
        zorder=3,
    )
    for name, place in zip(group, starts, strict=True):
        axes.annotate(
            str(name),
            place,
            (2.5, 2.5),
            textcoords="offset points",
            fontsize=7,
            zorder=4,
            annotation_clip=True,
        )


class _Perspective:
    """Points in space (…, 3) as seen by an eye above a corner of a box, (…, 2)."""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self.middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        back = np.array(
            [
                np.cos(_AZIMUTH) * np.cos(_ELEVATION),
                np.sin(_AZIMUTH) * np.cos(_ELEVATION),
                np.sin(_ELEVATION),
            ]
        )
        right = np.array([-np.sin(_AZIMUTH), np.cos(_AZIMUTH), 0.0])
        self.axes = np.stack([right, np.cross(back, right), back])
        self.distance = _DISTANCE * size

    def __call__(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.middle) @ self.axes.T
        depth = np.maximum(self.distance - local[..., 2:], 0.05 * self.distance)
        return local[..., :2] * self.distance / depth
