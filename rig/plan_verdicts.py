"""Requirements and wishes, one by one: what is needed, what is planned, the margin, and what to change."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from acino_fte.rig.plan import CameraPlan, RigPlan, coarsest_step_cm
from acino_fte.rig.plan_encoders import counts_for_step, turns_the_lens
from acino_fte.rig.plan_optics import depth_of_field_m
from acino_fte.rig.plan_text import at_least, at_most, number, sharp, short
from acino_fte.rig.rig_file import CameraPart

TIGHT = 1.2
"""Margins below this are called tight: data sheets are no better than that."""
_ENOUGH = 1.0 - 1e-9


@dataclass(frozen=True)
class Verdict:
    """One requirement.

    Attributes
    ----------
    key : str
        ``FR1`` … ``FR6``: a requirement of the WildPose thesis, in its order; ``W1`` …: another wish.
    part : str
        Camera or lidar that it is about; empty for the whole rig.
    what, needed, planned : str
    margin : float, optional
        How many times over it is reached; below 1 it is not. None where it cannot be computed.
    verdict : {"pass", "fail", "by test"}
    remark : str
        Where it fails, what to change; else what the verdict rests on.
    """

    key: str
    part: str
    what: str
    needed: str
    planned: str
    margin: float | None
    verdict: Literal["pass", "fail", "by test"]
    remark: str = ""

    @property
    def tight(self) -> bool:
        """Whether it is reached, but only just."""
        return self.verdict == "pass" and self.margin is not None and self.margin < TIGHT


def verdicts(plan: RigPlan) -> tuple[Verdict, ...]:
    """Every requirement of the thesis, then the other wishes, for every camera and lidar of a plan."""
    found = [_without_loss(plan), _footage(plan)]
    found += [_pixels(plan, camera) for camera in plan.cameras]
    found += [_rings(plan, camera) for camera in plan.cameras]
    found += _by_test(plan)
    for camera in plan.cameras:
        found += [_fits(plan, camera), _sharp(plan, camera), _blur(plan, camera)]
    found += list(_lidar_points(plan))
    found += list(_head(plan))
    return tuple(found)


def _verdict(
    key: str, part: str, what: str, needed: str, planned: str, margin: float, remedy: str, ground: str = ""
) -> Verdict:
    """Passed where the margin is 1 or more; then the remark is the ground for it, else the remedy."""
    passed = margin >= _ENOUGH
    return Verdict(
        key, part, what, needed, planned, margin, "pass" if passed else "fail", ground if passed else remedy
    )


def _without_loss(plan: RigPlan) -> Verdict:
    """FR1. The camera can take images that fast, disk and memory can take the bytes, and there is room."""
    rig, row = plan.rig, plan.storage.planned
    minutes = rig.wishes.minutes
    slowest = min(plan.cameras, key=lambda one: one.highest_fps / rig.cameras[one.name].fps)
    camera = rig.cameras[slowest.name]
    length = row.longest_h * 60.0 / minutes
    margins = {
        "images": slowest.highest_fps / camera.fps,
        "disk": 1.0 / row.disk_share if row.disk_share <= 1.0 else length,
        "room": row.hours * 60.0 / minutes,
    }
    size = at_least(row.gb_per_hour * minutes / 60.0 + rig.storage.reserve_gb)
    remedies = {
        "images": _slower(camera, slowest.highest_fps),
        "disk": f"take a disk that writes {at_least(row.mb_s)} MB/s for long, codec: h264, or a lower fps",
        "room": f"empty the disk, or take one of {size} GB",
    }
    return _verdict(
        "FR1",
        "",
        f"{minutes:g} min without loss",
        f"{short(camera.fps)} fps, {short(row.mb_s)} MB/s",
        f"{number(slowest.highest_fps, 3)} fps, {short(rig.storage.write_mb_s)} MB/s",
        min(margins.values()),
        "; ".join(remedies[name] for name, margin in margins.items() if margin < _ENOUGH),
        "computed; confirm it on the rig with acino-fte rig record, then acino-fte rig check",
    )


def _slower(camera: CameraPart, highest: float) -> str:
    """What to change where the camera cannot be that fast."""
    period = 1e6 / camera.fps - camera.frame_overhead_us
    lines = math.floor(period / camera.line_us) if camera.line_us else camera.height
    slower = f"fps to at most {at_most(highest)}"
    changes = [f"exposure_us to at most {at_most(period)}"] if camera.exposure_us > period else []
    changes += [f"height to at most {lines}"] if lines < camera.height else []
    return (
        f"set {' and '.join(changes)}, or {slower}" if changes and min(period, lines) > 0 else f"set {slower}"
    )


def _footage(plan: RigPlan) -> Verdict:
    """FR2. Room on the disk, less the reserve, over the rate of everything that is written."""
    rig, storage = plan.rig, plan.storage
    hours, row = rig.wishes.hours, storage.planned
    size = at_least(row.gb_per_hour * hours + rig.storage.reserve_gb)
    remedy = f"take a disk of {size} GB"
    if storage.most_mbit_s > 0:
        rate = f"{at_most(storage.most_mbit_s)} Mbit/s"
        together = " together" if len(rig.cameras) > 1 else ""
        remedy = f"record with codec: h264 and at most {rate} of video{together}, or {remedy}"
    elif any(camera.codec == "raw" for camera in rig.cameras.values()):
        remedy += ", or less with codec: h264"
    return _verdict(
        "FR2",
        "",
        f"{hours:g} h of footage",
        f"{number(row.gb_per_hour * hours, 3)} GB",
        f"{rig.storage.capacity_gb:g} GB: {number(row.hours, 3)} h",
        row.hours / hours,
        remedy,
    )


def _pixels(plan: RigPlan, camera: CameraPlan) -> Verdict:
    """FR3. f L / (p d)."""
    wishes, part = plan.rig.wishes, plan.rig.cameras[camera.name]
    longest = part.lens.focal_mm[1]
    nearer = longest * wishes.animal_m / (part.pixel_um * 1e-3 * wishes.least_px)
    if camera.least_focal_mm <= longest:
        remedy = f"zoom to at least {at_least(camera.least_focal_mm)} mm"
    else:
        zoomed = f" with {longest:g} mm" if camera.focal_mm < longest else ""
        remedy = (
            f"take a lens of {at_least(camera.least_focal_mm)} mm, or go within {at_most(nearer)} m{zoomed}"
        )
    return _verdict(
        "FR3",
        _only(plan, camera),
        f"{wishes.least_px:g} px at {wishes.distance_m:g} m",
        f"f ≥ {camera.least_focal_mm:.2f} mm",
        f"{camera.focal_mm:.4g} mm: {number(camera.pixels, 3)} px",
        camera.pixels / wishes.least_px,
        remedy,
    )


def _rings(plan: RigPlan, camera: CameraPlan) -> Verdict:
    """FR4. Zoom and focus are known for every image when both rings have an encoder."""
    rig = plan.rig
    zooms = rig.cameras[camera.name].lens.focal_mm[0] < rig.cameras[camera.name].lens.focal_mm[1]
    needed = ("zoom", "focus") if zooms else ("focus",)
    missing = [ring for ring in needed if not any(turns_the_lens(name, ring) for name in rig.encoders)]
    rings = [one for one in plan.encoders if turns_the_lens(one.name)]
    what = "zoom and refocus" if zooms else "refocus"
    if missing:
        names = " and ".join(missing)
        text = f"put encoders on the {names} ring, and {names} under encoders in the rig file"
        return Verdict("FR4", _only(plan, camera), what, "ring encoders", "none", None, "fail", text)
    steps = max(one.step_deg for one in rings)
    loose = max(one.tolerance_deg for one in rings)
    ground = (
        f"every image carries both positions; beyond {loose:.2g}° the recording says that the calibration no "
        "longer holds, and when it does again; calibrate at the zooms that you will use"
    )
    return Verdict(
        "FR4",
        _only(plan, camera),
        what,
        "ring encoders",
        f"{steps:.2g}° a count",
        None,
        "pass",
        ground if zooms else ground.replace("both positions", "its position"),
    )


def _by_test(plan: RigPlan) -> list[Verdict]:
    """FR5 and FR6, which no formula tells."""
    hours = plan.rig.wishes.vibration_h
    return [
        Verdict(
            "FR5",
            "",
            f"{hours:g} h of vibration",
            "calibrated after",
            "not computable",
            None,
            "by test",
            "calibrate, drive, calibrate again, and compare: acino-fte calibrate-lidar",
        ),
        Verdict(
            "FR6",
            "",
            "simplest operation",
            "one person",
            "one command",
            None,
            "by test",
            "acino-fte rig record checks, records and closes by itself; let a beginner try",
        ),
    ]


def _fits(plan: RigPlan, camera: CameraPlan) -> Verdict:
    part = plan.rig.cameras[camera.name]
    most, shortest = camera.most_focal_mm, part.lens.focal_mm[0]
    remedy = f"zoom to at most {at_most(most)} mm" if most >= shortest else "go farther away"
    return _verdict(
        "W1",
        _only(plan, camera),
        "whole animal in view",
        f"{part.width} × {part.height} px",
        f"{number(camera.pixels, 3)} × {number(camera.pixels_high, 3)} px",
        min(part.width / camera.pixels, part.height / camera.pixels_high),
        remedy,
    )


def _sharp(plan: RigPlan, camera: CameraPlan) -> Verdict:
    """The depth of field holds the animal with half its length on either side, whichever way it runs."""
    wishes = plan.rig.wishes
    distance, half = wishes.distance_m, 0.5 * wishes.animal_m
    return _verdict(
        "W2",
        _only(plan, camera),
        f"sharp to {wishes.sharp_px:g} px",
        f"{max(distance - half, 0):.4g}–{distance + half:.4g} m",
        sharp(camera.near_m, camera.far_m),
        max(0.0, min(distance - camera.near_m, camera.far_m - distance) / half),
        _sharper(plan, camera),
    )


def _sharper(plan: RigPlan, camera: CameraPlan) -> str:
    """Focus at the animal; where that is not enough, the aperture that is, from the near limit."""
    wishes, part = plan.rig.wishes, plan.rig.cameras[camera.name]
    distance, half, focal = wishes.distance_m, 0.5 * wishes.animal_m, 1e-3 * camera.focal_mm
    blur = wishes.sharp_px * part.pixel_um
    near, _ = depth_of_field_m(distance, camera.focal_mm, part.lens.f_number, blur)
    if near <= distance - half:
        return f"focus at {distance:g} m"
    hyperfocal = ((distance - half) * (distance - 2 * focal) + distance * focal) / half
    f_number = focal**2 / (blur * 1e-6 * (hyperfocal - focal)) if hyperfocal > focal else math.inf
    if not 0 < f_number < 64:
        return f"zoom out, and focus at {distance:g} m"
    return f"focus at {distance:g} m with f/{at_least(f_number)} or more, or zoom out"


def _blur(plan: RigPlan, camera: CameraPlan) -> Verdict:
    wishes, part = plan.rig.wishes, plan.rig.cameras[camera.name]
    return _verdict(
        "W3",
        _only(plan, camera),
        f"motion blur, {wishes.speed_m_s:g} m/s",
        f"≤ {wishes.blur_px:g} px",
        f"{number(camera.blur_px, 3)} px, {part.exposure_us:g} µs",
        wishes.blur_px / camera.blur_px if camera.blur_px else math.inf,
        f"set exposure_us to at most {at_most(camera.most_exposure_us)}, zoom out, or follow the animal",
        "of a camera that stands still; following the animal leaves less",
    )


def _lidar_points(plan: RigPlan) -> Iterator[Verdict]:
    wishes = plan.rig.wishes
    for lidar in plan.lidars:
        margin = lidar.points / wishes.lidar_points
        frames = math.ceil(1.0 / margin) if margin else 0
        yield _verdict(
            "W4",
            lidar.name if len(plan.lidars) > 1 else "",
            "lidar points on it",
            f"≥ {wishes.lidar_points:g}",
            f"{number(lidar.points, 3)} a frame",
            margin,
            f"go within {at_most(wishes.distance_m * math.sqrt(margin))} m, or put {frames} frames together",
            "if every point comes back",
        )


def _head(plan: RigPlan) -> Iterator[Verdict]:
    wishes = plan.rig.wishes
    step = coarsest_step_cm(plan.rig, wishes.distance_m)
    if math.isnan(step):
        return
    counts = counts_for_step(wishes.pan_cm, wishes.distance_m)
    yield _verdict(
        "W5",
        "",
        "pan and tilt, a step",
        f"≤ {wishes.pan_cm:g} cm",
        f"{number(step, 3)} cm",
        wishes.pan_cm / step,
        f"take encoders of at least {math.ceil(counts)} counts a turn ({math.ceil(counts / 4)} pulses × 4)",
    )


def _only(plan: RigPlan, camera: CameraPlan) -> str:
    """The camera's name where there are several."""
    return camera.name if len(plan.cameras) > 1 else ""
