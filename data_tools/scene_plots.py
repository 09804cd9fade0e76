"""The figures of a scene, each as PNG and as vector PDF: where the tracks and the cameras went, and how well
that is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from acino_fte.data_tools.colours import colours_of
from acino_fte.data_tools.plots_tracks_style import NAMED, legend, runs
from acino_fte.data_tools.scene_page import CAPTIONS
from acino_fte.data_tools.scene_tracks import SOURCES
from acino_fte.plots_style import GREY, STYLE, blank, nothing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from acino_fte.data_tools.scene_drawing import SceneDrawing

DPI = 150
_LATIN = {"axes.unicode_minus": False}  # as in plots_tracks: a second font in a PDF takes twice the time
_WIDTH, _TOP = 9.6, 0.85
_FEW = 7  # individuals or cameras that have a line each
_WILD, _KEPT = (
    0.001,
    1.0,
)  # share of points that may be far off; how far, of the others' extent, they are shown
_WIDTHS = {"-": 0.9, "--": 0.7, ":": 0.6}
_MOST_STEPS = 2500  # columns of a picture over time
_STATES: tuple[tuple[str, str], ...] = (
    ("interpolated", "#CFCFCF"),
    ("1 view", "#E69F00"),
    ("2", "#8CC8EC"),
    ("3", "#0072B2"),
    ("4 or more", "#00304D"),
)
"""How well a point is seen, from worst to best, and its colour; lighter is less."""
_SINGLE, _BETWEEN = SOURCES.index("single"), SOURCES.index("interpolated")


def save_scene_figures(
    drawing: SceneDrawing,
    folder: Path,
    families: list[str] | None = None,
    names: Sequence[str] | None = None,
) -> list[Path]:
    """Draw the figures of a scene into a folder, which is made if need be.

    Parameters
    ----------
    drawing : SceneDrawing
        What to draw.
    folder : Path
        For ``NAME.png`` (150 dots per inch) and ``NAME.pdf``, names as in :data:`FIGURES`.
    families : list of str, optional
        Fonts, the first one first.
    names : sequence of str, optional
        Some of :data:`FIGURES`; by default all.

    Returns
    -------
    list of Path
        The files written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    style: Any = {**dict(matplotlib.rcParamsDefault), **STYLE, **_LATIN}  # whatever the user's settings are
    if families:
        style["font.family"] = families
    with matplotlib.rc_context(style):
        for name in FIGURES if names is None else names:
            figure = FIGURES[name](drawing)
            written += [folder / f"{name}.png", folder / f"{name}.pdf"]
            figure.savefig(
                written[-2], dpi=DPI, metadata={"Software": None}, pil_kwargs={"compress_level": 1}
            )
            figure.savefig(written[-1], metadata={"CreationDate": None, "Producer": None})
    return written


def prepare(folder: Path) -> list[str]:
    """Do what the first figure would wait for: canvases, fonts.

    Parameters
    ----------
    folder : Path
        For what figures need as long as they are drawn.

    Returns
    -------
    list of str
        Fonts that :func:`save_scene_figures` embeds fast.
    """
    import io

    from acino_fte.data_tools.light_font import add_light_font

    families = add_light_font(folder)
    style: Any = {**dict(matplotlib.rcParamsDefault), **STYLE, "font.family": families}
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(1, 1))
        figure.text(0, 0, "m")
        for kind in ("png", "pdf"):
            figure.savefig(io.BytesIO(), format=kind)
    return families


def _begin(drawing: SceneDrawing, title: str, height: float) -> Figure:
    """Start a figure with a title that says what it shows and of which scene."""
    figure = Figure(figsize=(_WIDTH, height))
    n, cameras = len(drawing.individuals), len(drawing.cameras)
    where = f"{drawing.name} · {n} individual{'s' * (n != 1)} · {cameras} camera{'s' * (cameras != 1)}"
    if len(drawing.frame):
        where += f" · frames {drawing.frame.min()} to {drawing.frame.max()}"
    where += "" if np.isnan(drawing.fps) else f" · {drawing.fps:g} frames/s"
    figure.text(0.1 / _WIDTH, 1 - 0.09 / height, title, va="top", fontsize=13)
    figure.text(0.1 / _WIDTH, 1 - 0.33 / height, where, va="top", fontsize=8.5, color=GREY)
    return figure


def space_figure(drawing: SceneDrawing) -> Figure:
    """The tracks from above and from the side, in one scale, with the paths of the cameras and the cloud."""
    title = CAPTIONS["scene"]
    if not len(drawing.frame):
        return blank(_begin(drawing, title, 2.4), "no point was triangulated")
    low, high = _box(drawing)
    size = high - low
    flip = size[1] > size[0]  # the longer side of the ground lies across the page
    across, depth = (1, 0) if flip else (0, 1)
    scale = (_WIDTH - 0.8) / size[across]
    extra = _TOP + 0.62 + 0.5
    scale *= min(1.0, (10.5 - extra) / (scale * (size[depth] + size[2])))
    height = extra + scale * (size[depth] + size[2])
    figure = _begin(drawing, title, height)
    legend(figure, _marks(drawing), 0.1, 0.56)
    lines = track_lines(drawing)
    left, width = 0.65 / _WIDTH, scale * size[across] / _WIDTH
    for other, bottom in ((depth, 0.5 + 0.62 + scale * size[2]), (2, 0.5)):
        box = (left, bottom / height, width, scale * size[other] / height)
        axes = figure.add_axes(box, xlim=(low[across], high[across]), ylim=(low[other], high[other]))
        if flip and other == depth:
            axes.invert_yaxis()  # a view from above, not from below
        _panel(axes, drawing, lines, (across, other))
    return figure


def _box(drawing: SceneDrawing) -> tuple[np.ndarray, np.ndarray]:
    """Limits (3,), (3,) around tracks and cameras; the height is not flatter than a line of text."""
    points = np.concatenate([drawing.position, drawing.pose_centre])
    points = points[np.isfinite(points).all(1)]
    inner, outer = np.quantile(points, [_WILD, 1 - _WILD], axis=0)
    reach = _KEPT * (outer - inner)
    low, high = np.maximum(points.min(0), inner - reach), np.minimum(points.max(0), outer + reach)
    half = 0.54 * np.maximum(high - low, 1e-9)
    half = np.maximum(half, 0.1 * half.max())
    return 0.5 * (low + high) - half, 0.5 * (low + high) + half


def _marks(drawing: SceneDrawing) -> list[tuple[str, dict[str, Any]]]:
    colours = colours_of(len(drawing.individuals))
    marks: list[tuple[str, dict[str, Any]]] = []
    if len(drawing.individuals) <= 6:
        names = zip(drawing.individuals, colours, strict=True)
        marks += [(str(name)[:18], {"color": tuple(c), "lw": 1.6}) for name, c in names]
    marks += [("one view", {"ls": "--", "lw": 0.9}), ("interpolated", {"ls": ":", "lw": 0.9})]
    if len(drawing.pose_centre):
        marks.append(("cameras", {"color": "#9A9A9A", "lw": 0.7}))
    if len(drawing.cloud):
        marks.append(("cloud", {"ls": "", "marker": ".", "ms": 3, "color": "#B9B9B9"}))
    return marks


def track_lines(drawing: SceneDrawing) -> list[tuple[np.ndarray, int, str]]:
    """Pieces of track to draw: positions (n, 3), individual, and ``-``, ``--`` (one view) or ``:`` (none).

    A step is drawn as the worse of its two points; tracks are not joined across missing frames.
    """
    source = drawing.source
    worse = np.maximum(source, np.r_[source[:1], source[:-1]])
    joined = np.r_[False, (np.diff(drawing.individual) == 0) & (np.diff(drawing.frame) == 1)]
    kind = np.where(joined, worse, -1)
    lines = []
    for first, stop in zip(*runs(np.r_[True, np.diff(kind) != 0][: len(kind)]), strict=True):
        if kind[first] >= 0:
            style = {_SINGLE: "--", _BETWEEN: ":"}.get(int(kind[first]), "-")
            lines.append((drawing.position[first - 1 : stop], int(drawing.individual[first]), style))
    return lines


def _panel(
    axes: Axes, drawing: SceneDrawing, lines: list[tuple[np.ndarray, int, str]], shown: tuple[int, int]
) -> None:
    pick, unit = list(shown), drawing.unit
    if len(drawing.cloud):
        _dots(axes, drawing.cloud[:, pick], "#B9B9B9")
    new = np.r_[True, (np.diff(drawing.pose_camera) != 0) | (np.diff(drawing.pose_frame) != 1)]
    spans = zip(*runs(new[: len(drawing.pose_camera)]), strict=True)
    paths = [drawing.pose_centre[a:b, pick] for a, b in spans]
    axes.plot(*_broken(paths).T, color="#9A9A9A", lw=0.4, zorder=1)
    colours = colours_of(len(drawing.individuals))
    together: dict[tuple[str, int], list[np.ndarray]] = {}
    for line, who, style in lines:
        together.setdefault((style, who), []).append(line[:, pick])
    for (style, who), parts in together.items():
        axes.plot(*_broken(parts).T, style, color=colours[who], lw=_WIDTHS[style], zorder=2)
    _label(axes, f"{'xyz'[shown[0]]} ({unit})", f"{'xyz'[shown[1]]} ({unit})")
    axes.locator_params(axis="y", nbins=max(2, min(7, round(axes.get_window_extent().height / 60))))
    axes.grid(True, lw=0.3, color="#DDDDDD")
    axes.set_axisbelow(True)


def _broken(parts: list[np.ndarray]) -> np.ndarray:
    """Lines (n, 2) as one that is broken between them: much faster to draw than a collection."""
    gap = np.full((1, 2), np.nan)
    return np.concatenate([row for part in parts for row in (part, gap)] or [gap])


def _dots(axes: Axes, points: np.ndarray, colour: str) -> None:
    """Points (n, 2) as very short lines with round ends, for the same reason."""
    end = points + 1e-4 * np.ptp(points, axis=0).max()
    line = np.stack([points, end, np.full_like(points, np.nan)], axis=1).reshape(-1, 2)
    axes.plot(*line.T, color=colour, lw=1.2, solid_capstyle="round", zorder=0)


def quality_figure(drawing: SceneDrawing) -> Figure:
    """How many views see each individual and how well its place is known, over time; reprojection errors."""
    title = CAPTIONS["quality"]
    n = len(drawing.individuals)
    if not len(drawing.frame):
        return blank(_begin(drawing, title, 2.4), "no point was triangulated")
    rows = float(np.clip(0.24 * n, 0.45, 5.0))
    height = _TOP + rows + 0.2 + 2.3 + 0.5
    figure = _begin(drawing, title, height)
    legend(figure, [(text, {"lw": 6, "color": colour}) for text, colour in _STATES], 0.1, 0.56)
    left, right = 0.8 / _WIDTH, 6.6 / _WIDTH
    upper = figure.add_axes((left, 3.0 / height, right - left, rows / height))
    lower = figure.add_axes((left, 0.5 / height, right - left, 2.3 / height), sharex=upper)
    beside = figure.add_axes((7.45 / _WIDTH, 0.5 / height, 2.0 / _WIDTH, (rows + 2.5) / height))
    _states(upper, drawing)
    _spread(lower, drawing)
    _distances(beside, drawing)
    return figure


def _distances(axes: Axes, drawing: SceneDrawing) -> None:
    """How far the dots that count are from the projected tracks, for each camera; of many, all together."""
    n, errors = len(drawing.cameras), drawing.dot_error
    _label(axes, "reprojection error (px)", "share of the dots")
    if not len(errors):
        nothing(axes, "no dot counts")
        return
    edges = np.linspace(0.0, 1.05 * float(np.quantile(errors, 0.995)) + 1e-9, 41)
    if n > _FEW:
        axes.stairs(np.histogram(errors, edges)[0] / len(errors), edges, color=GREY, fill=True)
    else:
        for k, colour in enumerate(colours_of(n)):
            part = errors[drawing.dot_camera == k]
            if len(part):
                count = np.histogram(part, edges)[0] / len(part)
                axes.stairs(count, edges, color=colour, lw=1.0, label=str(drawing.cameras[k])[:18])
        axes.legend(loc="upper right", handlelength=1.2, borderaxespad=0.0)
    axes.set(xlim=(0, edges[-1]), ylim=(0, None))
    axes.locator_params(nbins=5)


def _states(axes: Axes, drawing: SceneDrawing) -> None:
    """A row for each individual, coloured by the views that see it; white where there is no point."""
    n, first = len(drawing.individuals), int(drawing.frame.min())
    n_frames = int(drawing.frame.max()) - first + 1
    every = max(1, -(-n_frames // _MOST_STEPS))
    state = np.where(drawing.source == _BETWEEN, 0, np.clip(drawing.n_views, 1, len(_STATES) - 1))
    picture = np.full((n, -(-n_frames // every)), np.nan)
    picture[drawing.individual, (drawing.frame - first) // every] = state
    axes.imshow(
        picture,
        cmap=ListedColormap([colour for _, colour in _STATES]),
        vmin=-0.5,
        vmax=len(_STATES) - 0.5,
        aspect="auto",
        interpolation="nearest",
        extent=(first - 0.5, first + every * picture.shape[1] - 0.5, n - 0.5, -0.5),
    )
    axes.set(xlim=(first - 0.5, first + n_frames - 0.5), ylim=(n - 0.5, -0.5))
    if n <= NAMED:
        axes.set_yticks(range(n), [str(name)[:14] for name in drawing.individuals])
    else:
        axes.set_ylabel("individual")
    axes.tick_params(axis="both", length=0, labelbottom=False)
    axes.spines[["left", "bottom"]].set_visible(False)


def _spread(axes: Axes, drawing: SceneDrawing) -> None:
    """Standard deviation of the positions: a line for each individual, or the range of many."""
    metric = drawing.unit == "m"
    sd = np.linalg.norm(drawing.sd, axis=1) * (1000.0 if metric else 1.0)
    if not np.isfinite(sd).any():
        nothing(axes, "no standard deviations")
        return
    if len(drawing.individuals) <= _FEW:
        for k, colour in enumerate(colours_of(len(drawing.individuals))):
            rows = np.flatnonzero(drawing.individual == k)
            gap = np.flatnonzero(np.diff(drawing.frame[rows]) > 1) + 1
            frame = np.insert(drawing.frame[rows].astype(float), gap, np.nan)
            axes.plot(frame, np.insert(sd[rows], gap, np.nan), color=colour, lw=0.6)
    else:
        low, middle, high, frame = _quantiles(drawing.frame, sd)
        axes.fill_between(frame, low, high, color="#BBD9EC", lw=0, label="80 % of the individuals")
        axes.plot(frame, middle, color="#0072B2", lw=0.9, label="median")
        axes.legend(loc="upper right", ncols=2)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    _label(axes, "frame", "sd of the position (mm)" if metric else "sd of the position (units)")
    axes.grid(True, lw=0.3, color="#DDDDDD")


def _label(axes: Axes, x: str, y: str) -> None:
    """Name the axes at a fixed distance from them, in."""
    box = axes.get_window_extent()
    width, height = box.width / axes.figure.dpi, box.height / axes.figure.dpi
    axes.text(0.5, -0.3 / height, x, transform=axes.transAxes, ha="center", va="top")
    axes.text(-0.5 / width, 0.5, y, transform=axes.transAxes, ha="right", va="center", rotation=90)


def _quantiles(frame: np.ndarray, sd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """10 %, median and 90 % of all individuals in at most 400 spans of time, and the middle of each."""
    first, last = int(frame.min()), int(frame.max())
    edges = np.linspace(first, last + 1, min(400, last - first + 1) + 1)
    span = np.clip(np.searchsorted(edges, frame, "right") - 1, 0, len(edges) - 2)
    table = np.full((3, len(edges) - 1), np.nan)
    order = np.argsort(span, kind="stable")
    for a, b in zip(*runs(np.r_[True, np.diff(span[order]) != 0]), strict=True):
        values = sd[order[a:b]]
        values = values[np.isfinite(values)]
        if len(values):
            table[:, span[order[a]]] = np.quantile(values, [0.1, 0.5, 0.9])
    return table[0], table[1], table[2], 0.5 * (edges[:-1] + edges[1:])


FIGURES: dict[str, Callable[[SceneDrawing], Figure]] = {
    "scene": space_figure,
    "quality": quality_figure,
}
"""File name → the function that draws it; what it shows is in ``scene_page.CAPTIONS``."""
