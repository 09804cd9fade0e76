"""The figure of a plan: what is reached at which distance and with which focal length."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from acino_fte.plots_style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, STYLE, margins, nothing
from acino_fte.rig.plan import CameraPlan, RigPlan, animal_points
from acino_fte.rig.plan_optics import depth_of_field_m, motion_blur_px, pixels_on_target
from acino_fte.rig.plan_tables import settings
from acino_fte.rig.plan_text import hours, number, percent
from acino_fte.rig.plan_verdicts import verdicts

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 150
_WIDTH, _HEIGHT = 12.0, 7.6  # in
_LEVELS = (5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)


def plan_figure(plan: RigPlan, camera: str) -> Figure:
    """Six panels about one camera of a plan.

    Pixels on the animal, fields of view, depth of field, motion blur, lidar points, hours on the disk. What
    is planned is a black mark, what is wished a red line.
    """
    one = next(item for item in plan.cameras if item.name == camera)
    figure = Figure(figsize=(_WIDTH, _HEIGHT))
    figure.subplots_adjust(top=1.0 - 0.95 / _HEIGHT)
    margins(figure, 0.62, 0.25, 0.5, wspace=0.36, hspace=0.38)
    figure.text(0.012, 1 - 0.09 / _HEIGHT, f"Plan of {plan.rig.name}", va="top", fontsize=13)
    figure.text(0.012, 1 - 0.33 / _HEIGHT, settings(plan, camera), va="top", fontsize=8.5, color=GREY)
    _result(figure, plan)
    panels = figure.subplots(2, 3).ravel()
    draw = (_pixels, _fields, _depth, _blur, _points, _hours)
    for axes, panel in zip(panels, draw, strict=True):
        panel(axes, plan, one)
    return figure


def save_plan_figures(plan: RigPlan, folder: Path) -> None:
    """Draw NAME.png (150 dots per inch) and NAME.pdf of every camera into a folder."""
    folder.mkdir(exist_ok=True)
    style: Any = {**dict(matplotlib.rcParamsDefault), **STYLE}  # whatever the user's own settings are
    with matplotlib.rc_context(style):
        for name in plan.rig.cameras:
            figure = plan_figure(plan, name)
            figure.savefig(folder / f"{name}.png", dpi=DPI, metadata={"Software": None})
            figure.savefig(folder / f"{name}.pdf", metadata={"CreationDate": None, "Producer": None})


def _result(figure: Figure, plan: RigPlan) -> None:
    """At the right of the title: what fails, or that nothing does."""
    failed = [f"{one.key} {one.what}" for one in verdicts(plan) if one.verdict == "fail"]
    text = "fails: " + "; ".join(failed[:2]) if failed else "everything that can be computed passes"
    text += f" and {len(failed) - 2} more" if len(failed) > 2 else ""
    figure.text(
        0.988,
        1 - 0.1 / _HEIGHT,
        text,
        va="top",
        ha="right",
        fontsize=10,
        color="white",
        bbox={"facecolor": RED if failed else GREEN, "edgecolor": "none", "boxstyle": "round,pad=0.3"},
    )


def _pixels(axes: Axes, plan: RigPlan, one: CameraPlan) -> None:
    part, wishes = plan.rig.cameras[one.name], plan.rig.wishes
    low, high = _lens_range(part.lens.focal_mm)
    distance = np.geomspace(0.1, 3.0, 60) * wishes.distance_m
    focal = np.geomspace(low, high, 60)
    axes.set(xlim=(distance[0], distance[-1]), ylim=(low, high), xlabel="Distance (m)")
    axes.set_ylabel("Focal length (mm)")
    _logarithmic(axes, "x")
    _logarithmic(axes, "y")
    grid = pixels_on_target(wishes.animal_m, 1.0, 1.0, part.pixel_um) * focal[:, None] / distance
    axes.contourf(distance, focal, grid, levels=[0, wishes.least_px], colors=[RED], alpha=0.12)
    most = distance * one.most_focal_mm / wishes.distance_m
    axes.fill_between(distance, np.minimum(most, high), high, color="#C8C8C8", lw=0)
    if most[0] < 0.6 * high:
        axes.text(distance[1], 0.93 * high, "too large", va="top", fontsize=7.5, color="#333333")
    largest = one.pixels * one.most_focal_mm / one.focal_mm
    shown = [
        level for level in _LEVELS if level < 0.8 * largest and abs(np.log(level / wishes.least_px)) > 0.1
    ]
    lines = axes.contour(distance, focal, grid, levels=shown, colors=BLUE, linewidths=0.7)
    axes.clabel(lines, fmt="%g px", fontsize=7)
    wish = axes.contour(distance, focal, grid, levels=[wishes.least_px], colors=RED, linewidths=1.6)
    axes.clabel(wish, fmt=f"{wishes.least_px:g} px wished", fontsize=7.5)
    axes.plot(wishes.distance_m, one.focal_mm, "ko", ms=6, clip_on=False, zorder=5)
    axes.annotate(
        f"{one.pixels:.0f} px",
        (wishes.distance_m, one.focal_mm),
        xytext=(6, -10 if one.focal_mm > 0.8 * high else 4),
        textcoords="offset points",
        fontsize=8.5,
    )
    axes.set_title(f"Pixels on the animal ({wishes.animal_m:g} m)", loc="left")


def _lens_range(focal_mm: tuple[float, float]) -> tuple[float, float]:
    """Focal lengths of an axis: those of the lens, and more about a fixed one."""
    low, high = focal_mm
    return (low, high) if high > 1.5 * low else (0.5 * low, 2.0 * high)


def _fields(axes: Axes, plan: RigPlan, one: CameraPlan) -> None:
    """Rectangles of the camera at some focal lengths and the ellipses of the lidars, in m at the distance."""
    wishes, part = plan.rig.wishes, plan.rig.cameras[one.name]
    width, height = one.field_m
    reach = [0.5 * width, 0.5 * height]
    for lidar in plan.lidars:
        axes.add_patch(Ellipse((0, 0), *lidar.field_m, facecolor=SKY, alpha=0.25, lw=0))
        axes.add_patch(Ellipse((0, 0), *lidar.field_m, fill=False, edgecolor=SKY, lw=1.2))
        axes.text(0, 0.5 * lidar.field_m[1], lidar.name, ha="center", va="bottom", fontsize=8, color=BLUE)
        reach = [max(old, 0.5 * new) for old, new in zip(reach, lidar.field_m, strict=True)]
    low, high = part.lens.focal_mm
    for both in [both for both in plan.overlaps if both.camera == one.name][:1]:
        for focal, colour in ((both.focal_wide_mm, ORANGE), (both.focal_whole_mm, PURPLE)):
            if not low <= focal <= high:
                continue
            times = one.focal_mm / focal
            size = (width * times, height * times)
            corner = (-0.5 * size[0], -0.5 * size[1])
            axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=colour, lw=1, ls="--"))
            wide = colour == ORANGE  # its upper side meets the ellipse: named beside it, the other above
            (x, y), side = ((-corner[0], 0.0), "center") if wide else ((corner[0], -corner[1]), "bottom")
            axes.text(x, y, f" {focal:.3g} mm", va=side, fontsize=8, color=colour)
            size = (1.8 * size[0], size[1]) if wide else size
            reach = [max(old, 0.5 * new) for old, new in zip(reach, size, strict=True)]
    axes.add_patch(Rectangle((-0.5 * width, -0.5 * height), width, height, fill=False, edgecolor="k", lw=1.4))
    axes.annotate(
        f"{one.focal_mm:g} mm",
        (-0.5 * width, -0.5 * height),
        xytext=(0, -3),
        textcoords="offset points",
        va="top",
        fontsize=8,
    )
    animal = (wishes.animal_m, wishes.animal_height_m)
    axes.add_patch(Rectangle((-0.5 * animal[0], -0.5 * animal[1]), *animal, facecolor="k", lw=0))
    _equal(axes, 1.1 * reach[0], 1.15 * reach[1])
    axes.set(xlabel=f"m at {wishes.distance_m:g} m (the animal is black)")
    seen = [both for both in plan.overlaps if both.camera == one.name]
    share = f": {percent(seen[0].of_lidar)} of the lidar's field" if seen else ""
    axes.set_title(f"In the picture{share}", loc="left")


def _equal(axes: Axes, half_width: float, half_height: float) -> None:
    """Equal scales, with at least so much in view on every side."""
    box = axes.get_position()
    width, height = box.width * _WIDTH, box.height * _HEIGHT
    half = max(half_width / width, half_height / height)
    axes.set(xlim=(-half * width, half * width), ylim=(-half * height, half * height))


def _depth(axes: Axes, plan: RigPlan, one: CameraPlan) -> None:
    """What is sharp at the set focus, for every focal length."""
    wishes, lens = plan.rig.wishes, plan.rig.cameras[one.name].lens
    blur = wishes.sharp_px * plan.rig.cameras[one.name].pixel_um
    low, high = (
        lens.focal_mm if lens.focal_mm[0] < lens.focal_mm[1] else (0.5 * one.focal_mm, 2 * one.focal_mm)
    )
    focal = np.geomspace(low, high, 300)
    limits = np.array([depth_of_field_m(lens.focus_m, f, lens.f_number, blur) for f in focal])
    top = 10.0 * max(wishes.distance_m, lens.focus_m)
    axes.fill_between(focal, limits[:, 0], np.minimum(limits[:, 1], top), color=GREEN, alpha=0.25, lw=0)
    axes.axhline(lens.focus_m, color=GREEN, lw=0.8)
    axes.axhline(wishes.distance_m, color=RED, lw=1.2, ls="--")
    axes.text(low, wishes.distance_m, " the animal", va="bottom", fontsize=8, color=RED)
    axes.text(low, lens.focus_m, f" focus at {lens.focus_m:g} m", va="top", fontsize=8, color="#00664a")
    near, far = one.near_m, min(one.far_m, top)
    axes.plot([one.focal_mm] * 2, [near, far], "k-", lw=2.5, solid_capstyle="butt", clip_on=False)
    axes.set(ylim=(min(0.3 * wishes.distance_m, 0.7 * near), top), xlim=(low, high))
    _logarithmic(axes, "x")
    _logarithmic(axes, "y")
    axes.set(xlabel="Focal length (mm)", ylabel="Distance (m)")
    upto = f"{number(one.far_m, 3)} m" if np.isfinite(one.far_m) else "∞"
    axes.set_title(f"Sharp: {number(near, 3)} m to {upto} (f/{lens.f_number:g})", loc="left")


def _blur(axes: Axes, plan: RigPlan, one: CameraPlan) -> None:
    wishes, part = plan.rig.wishes, plan.rig.cameras[one.name]
    if not wishes.speed_m_s:
        nothing(axes, "an animal that stands")
        return
    exposure = np.geomspace(min(50.0, 0.5 * part.exposure_us), max(1e6 / part.fps, part.exposure_us), 50)
    for times, colour in ((0.3, PURPLE), (1.0, "k"), (2.0, BLUE)):
        distance = wishes.distance_m * times
        values = [
            motion_blur_px(wishes.speed_m_s, t, distance, one.focal_mm, part.pixel_um) for t in exposure
        ]
        axes.plot(exposure, values, color=colour)
        axes.text(exposure[-1], values[-1], f" {distance:g} m", va="center", fontsize=8, color=colour)
    axes.axhline(wishes.blur_px, color=RED, lw=1.2, ls="--")
    axes.text(
        exposure[0], wishes.blur_px, f" {wishes.blur_px:g} px wished", va="bottom", fontsize=8, color=RED
    )
    axes.plot(part.exposure_us, one.blur_px, "ko", ms=6)
    _logarithmic(axes, "x")
    _logarithmic(axes, "y")
    axes.set(xlim=(exposure[0], exposure[-1]), xlabel="Exposure (µs)", ylabel="Motion blur (px)")
    axes.set_title(f"Motion blur at {wishes.speed_m_s:g} m/s across, {one.focal_mm:g} mm", loc="left")


def _points(axes: Axes, plan: RigPlan, one: CameraPlan) -> None:
    wishes = plan.rig.wishes
    axes.set_title("Lidar points on the animal, a frame", loc="left")
    if not plan.lidars:
        nothing(axes, "no lidar")
        return
    distance = np.geomspace(0.1, 3.0, 60) * wishes.distance_m
    for name, colour in zip(plan.rig.lidars, (BLUE, ORANGE, GREEN, PURPLE) * len(plan.lidars), strict=False):
        values = [animal_points(plan.rig.lidars[name], wishes, d) for d in distance]
        axes.plot(distance, values, color=colour)
        axes.text(distance[0], values[0], f" {name}", va="bottom", fontsize=8, color=colour)
    axes.axhline(wishes.lidar_points, color=RED, lw=1.2, ls="--")
    axes.text(
        distance[0],
        wishes.lidar_points,
        f" {wishes.lidar_points:g} wished",
        va="bottom",
        fontsize=8,
        color=RED,
    )
    for lidar in plan.lidars:
        axes.plot(wishes.distance_m, lidar.points, "ko", ms=6)
        axes.annotate(
            number(lidar.points, 3),
            (wishes.distance_m, lidar.points),
            xytext=(6, 4),
            textcoords="offset points",
        )
    _logarithmic(axes, "x")
    _logarithmic(axes, "y")
    axes.set(xlim=(distance[0], distance[-1]), xlabel="Distance (m)", ylabel="Points")


def _hours(axes: Axes, plan: RigPlan, one: CameraPlan) -> None:
    wishes, rows = plan.rig.wishes, [*plan.storage.rows, plan.storage.planned]
    places = np.arange(len(rows)) + np.array([0.0] * (len(rows) - 1) + [0.4])
    for place, row in zip(places, rows, strict=True):
        axes.barh(place, row.hours, color=GREEN if row.enough else RED, alpha=0.55, height=0.7)
        axes.text(row.hours, place, f" {hours(row.hours)}", va="center", fontsize=8)
    names = {"raw": "raw", "h264": "H.264", "none": "", "single": " + lidar", "dual": " + lidar, dual"}
    labels = [names[row.video] + names[row.lidar] if row.video in names else row.video for row in rows]
    axes.set_yticks(places, labels)
    axes.axvline(wishes.hours, color=RED, lw=1.2, ls="--")
    axes.set_ylim(places[-1] + 0.6, -0.9)
    axes.text(wishes.hours, -0.5, f" {wishes.hours:g} h wished", va="center", fontsize=8, color=RED)
    axes.tick_params(axis="y", length=0)
    _logarithmic(axes, "x")
    lengths = [row.hours for row in rows if row.hours > 0] or [1.0]
    axes.set_xlim(0.3 * min(*lengths, wishes.hours), 3.0 * max(*lengths, wishes.hours))
    axes.set_xlabel("Footage (h)")
    axes.set_title(f"On a disk of {plan.rig.storage.capacity_gb:g} GB", loc="left")


def _logarithmic(axes: Axes, axis: str) -> None:
    """A logarithmic axis with plain numbers at 1, 2 and 5."""
    getattr(axes, f"set_{axis}scale")("log")
    one = getattr(axes, f"{axis}axis")
    low, high = getattr(axes, f"get_{axis}lim")()
    one.set_major_locator(LogLocator(subs=(1.0,) if high > 2000 * low else (1.0, 2.0, 5.0)))
    one.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    one.set_minor_locator(NullLocator())
