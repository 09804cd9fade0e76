"""Joint angles against their limits, and the motion of the body as a whole."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.metrics import NEAR_PX, body_speed, point_errors
from acino_fte.plots_style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    blank,
    error_band,
    margins,
    new_figure,
    nothing,
    times,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.result import FTEResult
    from acino_fte.skeleton import Skeleton

_COLUMNS = 4


def joint_figure(result: FTEResult) -> Figure:
    """Every joint angle over time, degrees, ± 2 standard deviations where they are known.

    Beyond its limits shaded; left and right in one panel.
    """
    if not result.q.shape[1]:
        empty = new_figure(result, "Joint angles and their limits", 10.0, 2.0)
        return blank(empty, "this method has no joints")
    groups = joint_groups(result.skeleton)
    rows = max(1, math.ceil(len(groups) / _COLUMNS))
    figure = new_figure(result, "Joint angles and their limits", 10.0, 1.4 + 1.35 * rows, top=1.05)
    margins(figure, 0.62, 0.15, 0.5, wspace=0.25, hspace=0.42)
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()  # sharing axes is slow
    height = float(figure.get_size_inches()[1])
    keys: tuple[tuple[float, str, str], ...] = (
        (0.62, "— left, or single", BLUE),
        (1.9, "— right", ORANGE),
        (2.65, "grey: outside the limits", GREY),
    )
    if result.q_sd is not None:
        keys += ((4.4, "band: ± 2 sd", BLUE),)
    for x, text, colour in keys:
        figure.text(x / 10, 1 - 0.7 / height, text, color=colour, fontsize=8.5)
    for axes, group in zip(panels, groups, strict=False):
        _joint_panel(axes, result, group)
    for axes in panels[len(groups) :]:
        axes.set_visible(False)
    for i, axes in enumerate(panels[: len(groups)]):
        if i % _COLUMNS == 0:
            axes.set_ylabel("Angle (°)")
            axes.yaxis.set_label_coords(-0.2, 0.5)
        if i + _COLUMNS >= len(groups):
            axes.set_xlabel("Time (s)")
        else:
            axes.tick_params(axis="x", labelbottom=False)
    return figure


def _joint_panel(axes: Axes, result: FTEResult, group: list[int]) -> None:
    dofs = [result.skeleton.dofs[j] for j in group]
    values = np.degrees(result.q[:, group])
    for column, colour in zip(values.T, (BLUE, ORANGE), strict=False):
        axes.plot(times(result), column, color=colour, marker="." if len(column) == 1 else None)
    axes.locator_params(axis="x", nbins=4)
    axes.set_title(_panel_title([dof.name for dof in dofs]), fontsize=8.5, loc="left", pad=3)
    lower, upper = np.degrees(dofs[0].lower), np.degrees(dofs[0].upper)
    if math.isfinite(lower) and math.isfinite(upper):
        _show_limits(axes, values, lower, upper)
    else:
        _at_least(axes, 20.0)
    if result.q_sd is not None:
        deviations = np.degrees(result.q_sd[:, group])
        for column, sd, colour in zip(values.T, deviations.T, (BLUE, ORANGE), strict=False):
            error_band(axes, times(result), column, sd, colour)


def _show_limits(axes: Axes, values: np.ndarray, lower: float, upper: float) -> None:
    """Shade what is beyond the limits, degrees, and put the ticks between them."""
    room = 0.08 * (upper - lower)
    bottom, top = min(lower, values.min()) - room, max(upper, values.max()) + room
    for start, stop in ((bottom, lower), (upper, top)):
        axes.axhspan(start, stop, color="#D0D0D0", lw=0)
    axes.set_ylim(bottom, top)
    step = next(s for s in (10, 15, 30, 45, 60, 90, 180, 360, 720) if (upper - lower) / s <= 4.01 or s == 720)
    axes.set_yticks(np.arange(math.ceil(lower / step - 1e-9) * step, upper + 1e-9, step))


def joint_groups(skeleton: Skeleton) -> list[list[int]]:
    """Indices of the turning degrees of freedom, in the order of the links; left and right together."""
    names = {link.name: i for i, link in enumerate(skeleton.links)}
    marker = {m.name: m for m in skeleton.markers}
    twin = {marker[left].link: marker[right].link for left, right in skeleton.twins}
    twin |= {i: names[other] for name, i in names.items() if (other := _other_side(name)) in names}
    done: set[int] = set()
    groups = []
    for i, link in enumerate(skeleton.links):
        other_dofs = skeleton.links[twin[i]].dofs if twin.get(i, i) != i else ()
        for place, j in enumerate(link.dofs):
            if skeleton.dofs[j].kind != "turn" or j in done:
                continue
            group = [j]
            if len(other_dofs) == len(link.dofs):
                a, b = skeleton.dofs[j], skeleton.dofs[other_dofs[place]]
                group += [other_dofs[place]] if (a.lower, a.upper) == (b.lower, b.upper) else []
            groups.append(group)
            done.update(group)
    return groups


def _other_side(name: str) -> str:
    """``r_front_calf`` for ``l_front_calf``; the name itself when it names no left side."""
    return "_".join({"l": "r", "left": "right"}.get(part, part) for part in name.split("_"))


def _panel_title(names: list[str]) -> str:
    """``front calf · knee`` for the twins ``l_front_calf.knee`` and ``r_front_calf.knee``."""
    link, _, dof = names[0].partition(".")
    if len(names) > 1:
        sided = [p for p in link.split("_") if p not in ("l", "left")]
        link = "_".join(sided) or link
    return f"{link} · {dof}".replace("_", " ")


def motion_figure(result: FTEResult) -> Figure:
    """Translation of the root and speed of the body over time, and how many observations there were."""
    dofs = result.skeleton.dofs if result.q.shape[1] else ()
    slides = [j for j, dof in enumerate(dofs) if dof.kind == "slide"]
    n_panels = len(slides) + 3
    columns = min(3, n_panels)
    rows = math.ceil(n_panels / columns)
    figure = new_figure(result, "Motion of the body", 9.5, 1.35 + 1.75 * rows, top=0.85)
    margins(figure, 0.65, 0.15, 0.5, wspace=0.33, hspace=0.5)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    time = times(result)
    mark = "." if len(time) == 1 else None
    for axes, j in zip(panels, slides, strict=False):
        axes.plot(time, result.q[:, j], color=BLUE, marker=mark)
        axes.set_title(result.skeleton.dofs[j].name.replace(".", " · "), loc="left")
        axes.set_ylabel("Position (m)")
        _at_least(axes, 0.2)
        if result.q_sd is not None:
            error_band(axes, time, result.q[:, j], result.q_sd[:, j], BLUE)
    _speed_panel(panels[len(slides)], result)
    counts = np.isfinite(result.observed).all(-1).sum(axis=(1, 2))
    axes = panels[len(slides) + 1]
    axes.plot(time, counts, color=GREEN, marker=mark, drawstyle="steps-mid")
    axes.set_title("Observations in a frame", loc="left")
    axes.set_ylabel("Markers × cameras")
    axes.set_ylim(0, max(1, 1.1 * counts.max()))
    _error_panel(panels[len(slides) + 2], result)
    for axes in panels[:n_panels]:
        axes.set_xlabel("Time (s)")
        axes.grid(True, lw=0.3, color=PALE)
    for axes in panels[n_panels:]:
        axes.set_visible(False)
    return figure


def _speed_panel(axes: Axes, result: FTEResult) -> None:
    axes.set_title("Speed of the mean of all markers", loc="left")
    axes.set_ylabel("Speed (m/s)")
    if len(result.positions) < 2:
        nothing(axes, "one frame has no speed")
        return
    speed = body_speed(result.positions, result.sequence.fps)
    if not np.isfinite(speed).any():
        nothing(axes, "no positions")
        return
    middle = np.nanmedian(speed)
    axes.plot(times(result), speed, color=BLUE)
    axes.axhline(middle, color=RED, lw=1, ls="--")
    axes.set_ylim(0, 1.15 * max(np.nanmax(speed), 1e-3))
    axes.text(
        0.99,
        0.04,
        f"median {middle:.2f} m/s",
        transform=axes.transAxes,
        ha="right",
        color=RED,
        fontsize=8,
    )


def _error_panel(axes: Axes, result: FTEResult) -> None:
    """Median reprojection error of every frame that has observations."""
    errors = point_errors(result).reshape(len(result.positions), -1)
    seen = ~np.isnan(errors).all(axis=1)
    axes.set_title("Median reprojection error in a frame", loc="left")
    axes.set_ylabel("Error (px)")
    if not seen.any():
        nothing(axes)
        return
    medians = np.full(len(errors), np.nan)
    medians[seen] = np.nanmedian(errors[seen], axis=1)
    medians[np.isinf(medians)] = np.nan
    axes.plot(times(result), medians, color=PURPLE, marker="." if seen.sum() < 3 else None)
    axes.axhline(NEAR_PX, color=RED, lw=1, ls="--")
    axes.set_ylim(0, max(1.15 * NEAR_PX, 1.1 * np.nanmax(medians, initial=0.0)))


def _at_least(axes: Axes, span: float) -> None:
    """Keep an axis from magnifying a motion smaller than ``span``."""
    low, high = axes.get_ylim()
    if high - low < span:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * span, middle + 0.5 * span)
