"""A plan as text: rows of tables for the screen, Markdown and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

from acino_fte.rig.plan import RigPlan
from acino_fte.rig.plan_storage import StorageRow
from acino_fte.rig.plan_text import hours, number, percent, seconds, sharp, short
from acino_fte.rig.plan_verdicts import Verdict, verdicts

_NAMES = {"raw": "raw", "h264": "H.264", "none": "none", "single": "single", "dual": "dual"}
_MARKDOWN = {"|": r"\|", "<": "&lt;", ">": "&gt;", "*": r"\*", "_": r"\_", "`": r"\`", "\n": " "}


@dataclass(frozen=True)
class Table:
    """A title, the heads of the columns and rows of text."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """The table in Markdown, with its title as a heading."""
        lines = [self.heads, tuple("---" for _ in self.heads), *self.rows]
        body = "\n".join("| " + " | ".join(_escaped(cell) for cell in line) + " |" for line in lines)
        return f"## {self.title}\n\n{body}\n"


def verdict_table(found: Sequence[Verdict]) -> Table:
    """Requirements and wishes with margin and verdict."""
    several = any(one.part for one in found)
    heads = ("", *(("of",) if several else ()), "requirement", "needed", "planned", "margin", "verdict")
    rows = tuple(
        (
            *((one.key, one.part) if several else (one.key,)),
            one.what,
            one.needed,
            one.planned,
            "" if one.margin is None else f"× {number(one.margin, 2 if abs(one.margin - 1) > 0.06 else 4)}",
            "tight" if one.tight else one.verdict,
        )
        for one in found
    )
    return Table("Requirements and wishes", heads, rows)


def remarks(found: Sequence[Verdict]) -> list[tuple[str, str, str]]:
    """What to change where something fails, what is tight, what a test must tell: (word, key, sentence)."""
    chosen = [("change", one, one.remark) for one in found if one.verdict == "fail"]
    chosen += [("tight", one, "passes, with less than a fifth to spare") for one in found if one.tight]
    chosen += [("test", one, one.remark) for one in found if one.verdict == "by test"]
    return [
        (word, one.key, f"{one.what}{f' ({one.part})' if one.part else ''}: {text}")
        for word, one, text in chosen
    ]


def storage_table(plan: RigPlan) -> Table:
    """What every way to record takes."""
    wishes = plan.rig.wishes
    heads = (
        *("video", "lidar returns", "Mbit/s", "MB/s", "GB/h", "disk full in", "footage", "one recording"),
        *("disk busy", "memory bridges", f"memory for {wishes.minutes:g} min", f"{wishes.hours:g} h"),
    )
    rows = [*plan.storage.rows, plan.storage.planned]
    return Table("Storage and memory", heads, tuple(_storage_row(row) for row in rows))


def short_storage_table(plan: RigPlan) -> Table:
    """The same for the screen."""
    full = storage_table(plan)
    chosen = [full.heads.index(head) for head in ("video", "lidar returns", "MB/s", "disk full in")]
    chosen += [full.heads.index("footage"), full.heads.index("memory bridges"), len(full.heads) - 1]
    rows = tuple(tuple(row[i] for i in chosen) for row in full.rows)
    return Table(full.title, tuple(full.heads[i] for i in chosen), rows)


def _storage_row(row: StorageRow) -> tuple[str, ...]:
    return (
        _NAMES.get(row.video, row.video),
        _NAMES.get(row.lidar, row.lidar),
        short(row.mbit_s, 4),
        short(row.mb_s, 4),
        number(row.gb_per_hour, 3),
        hours(row.fills_h),
        hours(row.hours),
        hours(row.longest_h),
        f"{number(100 * row.disk_share, 2)} %",
        seconds(row.stall_s),
        f"{number(row.memory_gb, 2)} GB",
        "pass" if row.enough else "fail",
    )


def distance_table(plan: RigPlan, camera: str) -> Table:
    """What one camera, the lidars and the head give at several distances."""
    wishes, focal = plan.rig.wishes, plan.focal_mm[camera]
    lens = plan.rig.cameras[camera].lens
    heads = (
        "distance",
        *(f"px at {one:.4g} mm" for one in focal),
        f"{wishes.least_px:g} px from",
        f"picture at {lens.used_mm:g} mm",
        "sharp when focused there",
        "motion blur",
        "lidar points",
        "a step of the head",
    )
    rows = tuple(
        (
            f"{row.distance_m:.4g} m",
            *(number(pixels, 3) for pixels in row.pixels),
            f"{number(row.least_focal_mm, 4)} mm",
            f"{number(row.width_m, 3)} × {number(row.height_m, 3)} m",
            sharp(row.near_m, row.far_m),
            f"{number(row.blur_px, 3)} px",
            number(row.lidar_points, 3) if plan.lidars else "—",
            "—" if math.isnan(row.pan_cm) else f"{number(row.pan_cm, 3)} cm",
        )
        for row in plan.distances
        if row.camera == camera
    )
    return Table(f"Distances, {camera}", heads, rows)


def encoder_table(plan: RigPlan) -> Table:
    """Steps of the encoders."""
    distance = plan.rig.wishes.distance_m
    rows = tuple(
        (
            one.name,
            f"{one.counts_per_turn:.10g}",
            f"{number(one.step_deg, 2)}°",
            "—" if one.step_cm is None else f"{number(one.step_cm, 3)} cm",
            f"{number(one.tolerance_deg, 2)}°" if one.step_cm is None else "—",
        )
        for one in plan.encoders
    )
    heads = ("encoder", "counts a turn", "a count", f"a count at {distance:g} m", "calibration holds within")
    return Table("Encoders", heads, rows)


def facts(plan: RigPlan) -> list[tuple[str, str]]:
    """What it is about, and a line about fields of view, sharpness, frame rate, returns, memory, encoders."""
    rig, distance, storage = plan.rig, plan.rig.wishes.distance_m, plan.storage
    lines: list[tuple[str, str]] = []
    for one in plan.cameras:
        (wide, high), (width, height), lens = one.field_deg, one.field_m, rig.cameras[one.name].lens
        size = f"{number(width, 3)} × {number(height, 3)} m at {distance:g} m"
        focused = f"focused at {lens.focus_m:g} m, f/{lens.f_number:g}"
        lines += [
            (one.name, f"{wide:.3g}° × {high:.3g}° with {one.focal_mm:g} mm: {size}"),
            ("", f"sharp {sharp(one.near_m, one.far_m)}, {focused}; hyperfocal {one.hyperfocal_m:.4g} m"),
            ("", f"{one.frame_time_us:.5g} µs an image: at most {one.highest_fps:.4g} images/s"),
        ]
    for lidar in plan.lidars:
        field = f"{number(lidar.field_m[0], 3)} × {number(lidar.field_m[1], 3)} m at {distance:g} m"
        lines.append((lidar.name, f"field {field}; points {lidar.spacing_cm:.2g} cm apart there"))
    for both in plan.overlaps:
        inside, seen = percent(both.of_picture), percent(both.of_lidar)
        wide_mm, whole_mm = f"{both.focal_wide_mm:.3g} mm", f"{both.focal_whole_mm:.3g} mm"
        lines += [
            (
                f"{both.camera}, {both.lidar}",
                f"{inside} of the picture has lidar; it shows {seen} of its field",
            ),
            ("", f"as wide as that field at {wide_mm}, all of it up to {whole_mm}"),
        ]
    held = f"{storage.buffer_gb:g} GB hold {seconds(storage.buffer_s)} of raw images"
    lines.append(("memory", f"{number(storage.image_mb, 3)} MB an image; {held}"))
    for coder in plan.encoders:
        if coder.step_cm is not None:
            step = f"{number(coder.step_cm, 3)} cm at {distance:g} m"
            lines.append((coder.name, f"{coder.step_deg:.2g}° a count: {step}"))
    return lines


def settings(plan: RigPlan, camera: str) -> str:
    """One line: what was planned with."""
    rig, part = plan.rig, plan.rig.cameras[camera]
    video = f"H.264 {part.bitrate_mbit:g} Mbit/s" if part.codec == "h264" else f"raw {part.bits} bit"
    return (
        f"{camera}: {part.width} × {part.height} px, {part.fps:g} fps, {part.exposure_us:g} µs, {video}, "
        f"{part.lens.used_mm:g} mm f/{part.lens.f_number:g} · animal {rig.wishes.animal_m:g} × "
        f"{rig.wishes.animal_height_m:g} m at {rig.wishes.distance_m:g} m"
    )


def plan_markdown(plan: RigPlan) -> str:
    """The whole plan as a page of Markdown; the figures are in ``figures/``."""
    found = verdicts(plan)
    parts = [f"# Plan of {_escaped(plan.rig.name)}\n"]
    parts.append("\n".join(f"- {_escaped(settings(plan, name))}" for name in plan.rig.cameras) + "\n")
    parts.append(verdict_table(found).markdown())
    notes = [f"**{word}** {key} {_escaped(text)}" for word, key, text in remarks(found)]
    grounds = [one for one in found if one.verdict == "pass" and one.remark]
    notes += [f"{one.key} {_escaped(f'{one.what}: {one.remark}')}" for one in grounds]
    parts.append("\n".join(f"- {note}" for note in notes) + "\n")
    lines = [f"{name}: {line}" if name else line for name, line in facts(plan)]
    parts.append("## What follows\n\n" + "\n".join(f"- {_escaped(line)}" for line in lines) + "\n")
    parts.append(storage_table(plan).markdown())
    for name in plan.rig.cameras:
        parts.append(distance_table(plan, name).markdown())
        parts.append(f"![Plan of {name}](figures/{name}.png)\n")
    if plan.encoders:
        parts.append(encoder_table(plan).markdown())
    return "\n".join(parts)


def csv_tables(plan: RigPlan) -> dict[str, str]:
    """The tables as CSV by file name: numbers as they are, empty where unknown or infinite."""
    requirements = [
        (one.key, one.part, one.what, one.needed, one.planned, one.margin, one.verdict, one.remark)
        for one in verdicts(plan)
    ]
    heads = ("key", "part", "what", "needed", "planned", "margin", "verdict", "remark")
    rows = [*plan.storage.rows, plan.storage.planned]
    names = (
        *("video", "lidar", "mbit_s", "mb_s", "gb_per_hour", "fills_h", "hours", "longest_h", "stall_s"),
        *("memory_gb", "disk_share", "enough"),
    )
    pixels = [
        (row.camera, row.distance_m, focal, count)
        for row in plan.distances
        for focal, count in zip(plan.focal_mm[row.camera], row.pixels, strict=True)
    ]
    of_distance = (
        *("camera", "distance_m", "least_focal_mm", "width_m", "height_m", "near_m", "far_m", "blur_px"),
        *("lidar_points", "pan_cm"),
    )
    return {
        "requirements.csv": _csv(heads, requirements),
        "storage.csv": _csv(names, [tuple(getattr(row, name) for name in names) for row in rows]),
        "pixels.csv": _csv(("camera", "distance_m", "focal_mm", "pixels"), pixels),
        "distances.csv": _csv(
            of_distance, [tuple(getattr(row, name) for name in of_distance) for row in plan.distances]
        ),
    }


def _csv(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows([[_cell(value) for value in row] for row in rows])
    return text.getvalue()


def _cell(value: object) -> object:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.10g}" if math.isfinite(value) else ""
    return "" if value is None else value


def _escaped(text: str) -> str:
    return "".join(_MARKDOWN.get(c, c) for c in text)
