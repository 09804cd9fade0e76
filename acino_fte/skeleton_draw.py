"""A picture of a species: the skeleton from the side, from above or in front, and in 3D, with names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.errors import InputError
from acino_fte.kinematics import load_kinematics
from acino_fte.skeleton import Skeleton

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".pdf", ".svg")
# Okabe and Ito 2008: told apart with every kind of colour vision
_COLOURS = {"left": "#0072B2", "right": "#D55E00", "middle": "#333333"}


def neutral_pose(skeleton: Skeleton) -> np.ndarray:
    """Zero in every degree of freedom, or the nearest value in its range, (Q,)."""
    return np.array([min(max(0.0, d.lower), d.upper) for d in skeleton.dofs])


def middle_pose(skeleton: Skeleton) -> np.ndarray:
    """The middle of every range, zero where there is none, (Q,)."""
    return np.array([d.middle for d in skeleton.dofs])


@dataclass(frozen=True)
class _Names:
    """Where the names of the markers of one side of the body go.

    ``margins`` are −1 for left or below, 1 for right or above: columns beside the drawing, or with
    ``rows`` slanting names below and above it. ``gap`` is the least distance between two names and
    ``room`` the width of the margin, both as a fraction of the drawing's size.
    """

    side: tuple[str, ...]
    margins: tuple[int, ...]
    rows: bool
    gap: float
    room: float


@dataclass(frozen=True)
class _View:
    """One flat view: the body axes drawn across and up, and the names in it."""

    title: str
    across: int
    up: int
    near: str
    names: tuple[_Names, ...]


_AXIS = ("x forward (m)", "y left (m)", "z up (m)")
_LONG = (
    _View(
        "from the left",
        0,
        2,
        "left",
        (_Names(("left",), (-1, 1), False, 0.06, 0.3), _Names(("middle",), (1,), True, 0.045, 0.22)),
    ),
    _View("from above", 0, 1, "right", (_Names(("right",), (-1,), True, 0.05, 0.3),)),
)
_TALL = (
    _View("from the left", 0, 2, "left", (_Names(("left", "middle"), (-1, 1), False, 0.03, 0.2),)),
    _View("from behind", 1, 2, "right", (_Names(("right",), (1,), False, 0.03, 0.22),)),
)


def draw_skeleton(skeleton: Skeleton, pose: np.ndarray | None = None) -> Figure:
    """Draw a species.

    Parameters
    ----------
    skeleton : Skeleton
        The species.
    pose : (Q,), optional
        By default :func:`neutral_pose`.

    Returns
    -------
    matplotlib.figure.Figure
        Made without pyplot, so nothing has to be closed.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    q = neutral_pose(skeleton) if pose is None else pose
    points = load_kinematics(skeleton).positions(q[None])[0]  # (M, 3)
    length, _, height = np.ptp(points, axis=0)
    long = length >= height
    figure = Figure(figsize=(13.0, 10.0 if long else 9.0))
    figure.suptitle(
        f"{skeleton.name}: {len(skeleton.dofs)} degrees of freedom, {len(skeleton.markers)} markers",
        fontsize=15,
        x=0.06,
        ha="left",
    )
    frame = {"left": 0.06, "right": 0.97, "top": 0.9, "bottom": 0.07, "wspace": 0.16, "hspace": 0.2}
    if long:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.15, 1.0), width_ratios=(1.1, 1.0), **frame)
        slots, views = (grid[0, :], grid[1, 0], grid[1, 1]), _LONG
    else:
        grid = figure.add_gridspec(1, 3, width_ratios=(1.0, 0.9, 0.7), **frame)
        slots, views = (grid[0, 0], grid[0, 1], grid[0, 2]), _TALL
    for slot, view in zip(slots[:2], views, strict=True):
        _flat_view(figure.add_subplot(slot), skeleton, points, view)
    _space_view(figure.add_subplot(slots[2], projection="3d"), skeleton, points)
    handles = [Line2D([], [], color=colour, lw=3, label=side) for side, colour in _COLOURS.items()]
    figure.legend(handles=handles, loc="upper right", ncols=3, fontsize=10, frameon=False)
    return figure


def save_skeleton_picture(skeleton: Skeleton, path: Path, pose: np.ndarray | None = None) -> None:
    """Draw a species into a file; the ending of its name says which format (.png, .pdf, .svg).

    Raises
    ------
    InputError
        The ending is unknown or the file cannot be written.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            "The picture has no format that is known.",
            file=path,
            expected=f"a name that ends in {', '.join(FORMATS)}",
            found=path.suffix or "no ending",
        )
    figure = draw_skeleton(skeleton, pose)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise InputError("The picture cannot be written.", file=path, found=error.strerror) from None


def sides(skeleton: Skeleton, points: np.ndarray) -> list[str]:
    """``left``, ``right`` or ``middle`` for each marker: by its twin, else by its place."""
    side = {}
    for left, right in skeleton.twins:
        side[left], side[right] = "left", "right"
    slack = 0.02 * max(np.ptp(points, axis=0).max(), 1e-9)
    for marker, y in zip(skeleton.markers, points[:, 1], strict=True):
        if marker.name not in side:
            side[marker.name] = "middle" if abs(y) <= slack else "left" if y > 0 else "right"
    return [side[m.name] for m in skeleton.markers]


def _edge_colour(a: str, b: str) -> str:
    if a == b:
        return _COLOURS[a]
    pair = {a, b}
    return _COLOURS["middle"] if pair == {"left", "right"} else _COLOURS[next(iter(pair - {"middle"}))]


def _flat_view(axes: Axes, skeleton: Skeleton, points: np.ndarray, view: _View) -> None:
    side = sides(skeleton, points)
    flat = points[:, [view.across, view.up]]
    order = {name: 3 if name == view.near else 2 if name == "middle" else 1 for name in _COLOURS}
    for a, b in skeleton.edges:
        layer = max(order[side[a]], order[side[b]])
        axes.plot(*flat[[a, b]].T, color=_edge_colour(side[a], side[b]), lw=2.2, zorder=layer, alpha=0.85)
    for i, name in enumerate(side):
        axes.plot(*flat[i], "o", ms=5, color=_COLOURS[name], mec="white", mew=0.6, zorder=4 + order[name])
    axes.set_aspect("equal")
    axes.set_title(view.title, loc="left", fontsize=12)
    axes.set_xlabel(_AXIS[view.across])
    axes.set_ylabel(_AXIS[view.up])
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)
    for spine in ("top", "right"):
        axes.spines[spine].set_visible(False)
    if view.across == 1:
        axes.invert_xaxis()  # seen from behind, the left of the body is on the left
    limits = _limits(flat, view, axes.xaxis_inverted())
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])
    colours = [_COLOURS[s] for s in side]
    for names in view.names:
        named = [i for i, s in enumerate(side) if s in names.side]
        _label(axes, [m.name for m in skeleton.markers], flat, named, colours, names)


def _limits(flat: np.ndarray, view: _View, inverted: bool) -> np.ndarray:
    """Limits of both axes, (2, 2): the drawing and the margins that its names need."""
    low, high = flat.min(0), flat.max(0)
    size = (high - low).max() or 1.0
    centre, half = 0.5 * (low + high), 0.5 * np.maximum(high - low, 0.2 * size)
    limits = np.stack([centre - half, centre + half], axis=1)
    margin = np.full((2, 2), 0.05 * size)
    for names in view.names:
        for side in names.margins:
            margin[int(names.rows), (side + 1) // 2] = (0.08 + names.room) * size
    limits += margin * np.array([-1.0, 1.0])
    if inverted:
        limits[0] = 2 * centre[0] - limits[0]
    return limits


def _label(
    axes: Axes, text: list[str], flat: np.ndarray, named: list[int], colours: list[str], names: _Names
) -> None:
    """Names in the margins, each with a line to its marker; none on top of another."""
    along, beside = (0, 1) if names.rows else (1, 0)
    low, high = flat.min(0), flat.max(0)
    size = (high - low).max() or 1.0
    shift = 0.5 * max(high[beside] - low[beside], 0.2 * size) + 0.08 * size
    sign = -1.0 if axes.xaxis_inverted() and not names.rows else 1.0
    shares = _share(flat, named, along, beside, len(names.margins))
    for margin, members in zip(names.margins, shares, strict=True):
        places = _spread(flat[members, along], low[along], high[along], names.gap * size)
        for place, i in zip(places, members, strict=True):
            at = [0.0, 0.0]
            at[along], at[beside] = place, 0.5 * (low[beside] + high[beside]) + sign * margin * shift
            axes.annotate(
                text[i],
                (flat[i, 0], flat[i, 1]),
                (at[0], at[1]),
                fontsize=9.5,
                color=colours[i],
                ha="right" if margin < 0 else "left",
                va="center",
                rotation=50 if names.rows else 0,
                rotation_mode="anchor",
                arrowprops={"arrowstyle": "-", "color": "0.7", "lw": 0.6, "shrinkA": 1, "shrinkB": 3},
                zorder=3,
            )


def _share(flat: np.ndarray, named: list[int], along: int, beside: int, n: int) -> list[list[int]]:
    """Deal the named markers to one or two margins by their place; when they stand in line, in turn."""
    ordered = sorted(named, key=lambda i: flat[i, along])
    if n == 1 or not named:
        return [ordered, []][:n]
    across = flat[named, beside]
    middle = 0.5 * (across.min() + across.max())
    if np.ptp(across) > 0.2 * np.ptp(flat, axis=0).max():
        return [
            [i for i in ordered if flat[i, beside] < middle],
            [i for i in ordered if flat[i, beside] >= middle],
        ]
    rank = {i: place for place, i in enumerate(ordered)}
    dealt = sorted(named, key=lambda i: (np.sign(round(flat[i, beside] - np.median(across), 3)), rank[i] % 2))
    first = set(dealt[: len(dealt) // 2])
    return [[i for i in ordered if i in first], [i for i in ordered if i not in first]]


def _spread(values: np.ndarray, low: float, high: float, gap: float) -> list[float]:
    """Places for labels near sorted values (n,), with room between them, inside low … high if it fits."""
    if len(values) == 0:
        return []
    if high <= low:
        low, high = low - 0.5, high + 0.5
    gap = min((high - low) / max(len(values) - 1, 1), gap)
    places = np.sort(values).astype(float)
    for _ in range(200):
        short = gap - np.diff(places)
        if (short <= 1e-9).all():
            break
        push = np.maximum(short, 0.0) / 2
        places[:-1] -= push
        places[1:] += push
        places = np.clip(places, low, high)
    return places.tolist()


def _space_view(axes: Any, skeleton: Skeleton, points: np.ndarray) -> None:
    """The skeleton in perspective."""
    from matplotlib.ticker import MaxNLocator

    side = sides(skeleton, points)
    for a, b in skeleton.edges:
        axes.plot(*points[[a, b]].T, color=_edge_colour(side[a], side[b]), lw=2, clip_on=False)
    axes.scatter(*points.T, c=[_COLOURS[s] for s in side], s=12, depthshade=False, clip_on=False)
    low, high = points.min(0), points.max(0)
    size = np.maximum(high - low, 0.3 * (high - low).max())
    centre = 0.5 * (low + high)
    axes.set(
        xlim=(centre[0] - 0.55 * size[0], centre[0] + 0.55 * size[0]),
        ylim=(centre[1] - 0.55 * size[1], centre[1] + 0.55 * size[1]),
        zlim=(low[2], low[2] + 1.1 * size[2]),
    )
    long = np.argmax(size) == 0
    axes.set_box_aspect(size / size.max(), zoom=1.1 if long else 1.5)
    axes.view_init(elev=18, azim=-50 if long else -35)
    axes.set_title("in 3D", loc="left", fontsize=12)
    for name, axis, part in zip(_AXIS, (axes.xaxis, axes.yaxis, axes.zaxis), size / size.max(), strict=True):
        axis.set_label_text(name, fontsize=9)
        axis.set_tick_params(labelsize=7)
        axis.set_major_locator(MaxNLocator(5 if part > 0.6 else 2))
