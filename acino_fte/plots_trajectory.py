"""The trajectory as stick figures over time: in three dimensions, from the side and from above.

All three panels are in the frame of travel: along the direction of travel, to its left, and up, with equal
scales. The 3D panel is a parallel projection (no foreshortening with distance, so lengths compare). Markers
without a position are left out, and so are the lines to them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import ListedColormap, Normalize

from acino_fte.plots_style import BAND_SD, GREY, TIME_MAP, blank, new_figure, times

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.result import FTEResult

_POSES = 14  # stick figures drawn
_WIDTH = 10.0
_LEFT, _RIGHT, _GAP = 0.75, 0.95, 0.62  # in
_AZIMUTH, _ELEVATION = np.radians(10.0), np.radians(24.0)
_COLOURS = ListedColormap(colormaps[TIME_MAP](np.linspace(0.0, 0.9, 256)))  # the last tenth is too pale


def trajectory_figure(result: FTEResult) -> Figure:
    """Skeletons at about 14 instants, coloured by time, equal scales on all axes, metres.

    From the side and above with the markers' error ellipses (2 standard deviations) where they are known.
    """
    if not np.isfinite(result.positions).all(-1).any():
        return blank(new_figure(result, "Trajectory", _WIDTH, 2.0), "no positions")
    chosen = pose_frames(len(result.positions))
    along, local = travel_frame(result.positions)
    norm = Normalize(*times(result)[[0, -1]])
    colours = _COLOURS(norm(times(result)[chosen]))
    grid = ground_grid(local)
    solid, segments, shades = view(local), *sticks(result, local, chosen, colours)
    floor = np.concatenate([segments[..., :2], np.full_like(segments[..., :1], grid[2][0])], axis=-1)
    boxes = [_box(np.concatenate([solid.reshape(-1, 2), view(_corners(grid)).reshape(-1, 2)]))]
    boxes += [_box(local[..., [0, vertical]].reshape(-1, 2)) for vertical in (2, 1)]
    figure, panels = _layout(result, boxes)
    _draw_grid(panels[0], grid)
    panels[0].add_collection(LineCollection(list(view(floor)), colors="#C4C4C4", lw=0.6))
    panels[0].add_collection(LineCollection(list(view(segments)), colors=shades, lw=1.1))
    for axes, vertical in zip(panels[1:], (2, 1), strict=True):
        axes.add_collection(LineCollection(list(segments[..., [0, vertical]]), colors=shades, lw=1.0))
        if result.position_covariance is not None:
            spread = _turned(result.position_covariance[chosen], along)
            _draw_ellipses(axes, local[chosen], spread, vertical, colours)
        centre = body_centre(local)
        axes.plot(centre[:, 0], centre[:, vertical], color=GREY, lw=0.7, ls=":")
        axes.grid(True, lw=0.3, color="#CCCCCC")
        axes.set_axisbelow(True)
    panels[1].set_ylabel("Height (m)")
    shaded = "" if result.position_covariance is None else f"; shaded: {BAND_SD:g} sd of the markers"
    panels[1].set_title(f"From the side{shaded}", loc="left", pad=3)
    panels[2].set_ylabel("To the left (m)")
    panels[2].set_title("From above; dotted: mean of the markers", loc="left", pad=3)
    heading = np.degrees(np.arctan2(along[1], along[0]))
    panels[2].set_xlabel(
        f"Along the direction of travel (m), which is {heading:.0f}° from world x".replace("-", "−")
    )
    low, high = panels[2].get_position().y0, panels[1].get_position().y1
    bar = figure.add_axes((1 - 0.72 / _WIDTH, low, 0.14 / _WIDTH, high - low))
    figure.colorbar(ScalarMappable(norm, _COLOURS), cax=bar, label="Time (s)")
    return figure


def _layout(result: FTEResult, boxes: list[tuple[np.ndarray, np.ndarray]]) -> tuple[Figure, list[Axes]]:
    """A figure with one panel of equal scales for each box (low, high), one below the other."""
    inner = _WIDTH - _LEFT - _RIGHT
    scales = [min(inner / (high - low)[0], 3.6 / (high - low)[1]) for low, high in boxes]
    scales[1] = scales[2] = min(scales[1:])
    heights = [scale * (high - low)[1] for scale, (low, high) in zip(scales, boxes, strict=True)]
    total = 0.62 + sum(heights) + 2 * _GAP + 0.6
    figure = new_figure(result, "Trajectory", _WIDTH, total)
    top = total - 0.62
    panels: list[Axes] = []
    for height, scale, (low, high) in zip(heights, scales, boxes, strict=True):
        width = scale * (high - low)[0]
        place = (_LEFT + (inner - width if not panels else 0) / 2, top - height, width, height)
        axes = figure.add_axes(tuple(v / (_WIDTH, total)[i % 2] for i, v in enumerate(place)))
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        panels.append(axes)
        top -= height + _GAP
    panels[0].set_axis_off()
    return figure, panels


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around points, with a margin."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    margin = 0.015 * float((high - low).max()) + 0.02
    return low - margin, high + margin


def pose_frames(n_frames: int, poses: int = _POSES) -> np.ndarray:
    """Indices of ``poses`` frames spread evenly, with the first and the last."""
    return np.unique(np.linspace(0, n_frames - 1, min(poses, n_frames)).round().astype(int))


def travel_frame(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Direction of travel (3,), horizontal, and positions (N, M, 3) along it, to its left, and up, m.

    The direction is the displacement of the body; of a body that hardly moves, its longer horizontal axis.
    """
    centre = body_centre(positions)
    path = centre[np.isfinite(centre).all(-1)]
    shift = (path[-1] - path[0])[:2]
    spread = (positions - centre[:, None])[..., :2].reshape(-1, 2)
    spread = spread[np.isfinite(spread).all(-1)]
    if np.linalg.norm(shift) < 2 * spread.std():
        shift = np.linalg.svd(spread - spread.mean(0), full_matrices=False)[2][0]
        shift = shift if shift[0] > 0 else -shift
    along = np.array([*(shift / max(np.linalg.norm(shift), 1e-12)), 0.0])
    local = positions @ travel_axes(along).T
    start = body_centre(local)
    local[..., :2] -= start[np.isfinite(start).all(-1)][0, :2]
    return along, local


def body_centre(positions: np.ndarray) -> np.ndarray:
    """(N, 3) mean of the markers that have a position in a frame; NaN where none has."""
    there = np.isfinite(positions).all(-1)
    count = np.where(there.any(axis=1), there.sum(axis=1), np.nan)
    return np.where(there[..., None], positions, 0.0).sum(axis=1) / count[:, None]


def travel_axes(along: np.ndarray) -> np.ndarray:
    """Rows: the direction of travel, to its left, and up, in the world frame (3, 3)."""
    return np.array([along, [-along[1], along[0], 0.0], [0.0, 0.0, 1.0]])


def _turned(covariance: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Covariances (…, 3, 3) in the frame of travel."""
    frame = travel_axes(along)
    return frame @ covariance @ frame.T


def _draw_ellipses(
    axes: Axes, points: np.ndarray, covariance: np.ndarray, vertical: int, colours: np.ndarray
) -> None:
    """Error ellipses of points (P, M, 3) in the plane of ``along`` and a second axis."""
    plane = np.array([0, vertical])
    flat = covariance[..., plane[:, None], plane]
    known = np.isfinite(flat).all((-2, -1)) & np.isfinite(points).all(-1)
    variances, directions = np.linalg.eigh(flat[known])
    diameters = 2 * BAND_SD * np.sqrt(np.maximum(variances, 0.0))
    axes.add_collection(
        EllipseCollection(
            diameters[:, 1],
            diameters[:, 0],
            np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1])),
            units="xy",
            offsets=points[known][:, plane],
            offset_transform=axes.transData,
            facecolors=np.broadcast_to(colours[:, None], (*known.shape, 4))[known],
            alpha=0.18,
            lw=0,
        )
    )


def sticks(
    result: FTEResult, points: np.ndarray, chosen: np.ndarray, colours: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Segments (S, 2, D) of the skeleton's edges in the chosen frames, and their colours (S, 4).

    Edges to a marker without a position are left out.
    """
    edges = np.array(result.skeleton.edges, dtype=int).reshape(-1, 2)
    segments = points[chosen][:, edges].reshape(-1, 2, points.shape[-1])
    whole = np.isfinite(segments).all((-2, -1))
    return segments[whole], np.repeat(colours, len(edges), axis=0)[whole]


def view(local: np.ndarray) -> np.ndarray:
    """Parallel projection (…, 2) of points (…, 3) in the frame of travel, seen from the right and above."""
    along, left, up = np.moveaxis(local, -1, 0)
    across = along * np.cos(_AZIMUTH) + left * np.sin(_AZIMUTH)
    depth = left * np.cos(_AZIMUTH) - along * np.sin(_AZIMUTH)
    return np.stack([across, up * np.cos(_ELEVATION) + depth * np.sin(_ELEVATION)], axis=-1)


def _place(point: tuple[float, float, float]) -> tuple[float, float]:
    x, y = view(np.array(point))
    return float(x), float(y)


def ground_grid(local: np.ndarray) -> list[np.ndarray]:
    """Values of the grid lines along, to the left, and up (the first is the ground), m."""
    low, high = np.nanmin(local.reshape(-1, 3), axis=0), np.nanmax(local.reshape(-1, 3), axis=0)
    length = max(high[0] - low[0], high[1] - low[1])
    step = next((s for s in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0) if length / s <= 14), length / 10)
    lines = [np.arange(np.floor(low[i] / step), np.ceil(high[i] / step) + 1) * step for i in (0, 1)]
    rise = min(step, 0.5)
    ground = 0.0 if abs(low[2]) < 0.3 else np.floor(low[2] / rise) * rise
    return [*lines, np.arange(ground, max(high[2], ground + rise) + 1e-9, rise)]


def _corners(grid: list[np.ndarray]) -> np.ndarray:
    """Corners of the grid, room for the numbers beside it, and the top of the post."""
    (a0, a1), (b0, b1), (c0, c1) = ((g[0], g[-1]) for g in grid)
    room = 0.035 * (a1 - a0)
    ground = [(a, b, c0) for a in (a0 - room, a1 + room) for b in (b0 - 3 * room, b1)]
    return np.array([*ground, (a0, b1, c1)])


def _draw_grid(axes: Axes, grid: list[np.ndarray]) -> None:
    along, left, up = grid
    ground = up[0]
    lines = [[(a, left[0], ground), (a, left[-1], ground)] for a in along]
    lines += [[(along[0], b, ground), (along[-1], b, ground)] for b in left]
    axes.add_collection(LineCollection(list(view(np.array(lines))), colors="#DDDDDD", lw=0.6))
    post = view(np.array([[along[0], left[-1], ground], [along[0], left[-1], up[-1]]]))
    axes.plot(*post.T, color=GREY, lw=0.8)
    labels = [((a, left[0], ground), f"{a:g}", "center", "top") for a in np.round(along[:-1], 6)]
    labels += [((along[-1], b, ground), f" {b:g}", "left", "center") for b in np.round(left[1:], 6)]
    labels += [((along[0], left[-1], c), f"{c:.2g} – ", "right", "center") for c in up]
    for place, text, horizontal, vertical in labels:
        axes.annotate(
            text.replace("-", "−"),
            _place(place),
            xytext=(0, -2 if vertical == "top" else 0),
            textcoords="offset points",
            ha=horizontal,
            va=vertical,
            fontsize=7.5,
            color=GREY,
        )
    tip = _place((along[0], left[-1], up[-1]))
    axes.annotate("height (m)", tip, xytext=(4, 0), textcoords="offset points", fontsize=8, color=GREY)
    side = _place((along[-1], left[-1], ground))
    axes.annotate("left (m)", side, xytext=(4, 9), textcoords="offset points", fontsize=8, color=GREY)
    front = _place((0.5 * (along[0] + along[-1]), left[0], ground))
    turn = np.degrees(np.arctan2(-np.sin(_AZIMUTH) * np.sin(_ELEVATION), np.cos(_AZIMUTH)))
    axes.annotate(
        "along the direction of travel (m)",
        front,
        xytext=(0, -16),
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize=8,
        color=GREY,
        rotation=turn,
    )
