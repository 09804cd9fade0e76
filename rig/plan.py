"""What a rig will do, worked out before the trip: pixels, fields, sharpness, returns, storage, verdicts."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any

from acino_fte.errors import InputError
from acino_fte.rig.plan_encoders import step_cm, step_deg, turns_the_view
from acino_fte.rig.plan_lidar import Overlap, field_overlap, points_on_target, points_per_steradian
from acino_fte.rig.plan_optics import (
    depth_of_field_m,
    field_of_view_deg,
    focal_for_pixels,
    frame_time_us,
    highest_fps,
    hyperfocal_m,
    motion_blur_px,
    pixels_on_target,
)
from acino_fte.rig.plan_storage import StoragePlan, plan_storage
from acino_fte.rig.rig_file import CameraPart, LidarPart, RigFile, Wishes

FORMAT = "acino-fte/rig-plan/1"
DISTANCES = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0)
"""Rows of the table of distances, in wished distances."""


@dataclass(frozen=True)
class CameraPlan:
    """What one camera sees of the animal at the wished distance.

    Attributes
    ----------
    name : str
    focal_mm : float
    pixels, pixels_high : float
        On the length and on the height of the animal.
    least_focal_mm, most_focal_mm : float
        For the wished pixels; and with which the animal just fits the picture.
    field_deg, field_m : tuple of float
        Width and height of what is in the picture, degrees, and m at that distance.
    hyperfocal_m, near_m, far_m : float
        Sharpness at the set focus; `far_m` may be infinite.
    blur_px : float
        By motion across the picture while the shutter is open, of a camera that stands still.
    most_exposure_us : float
        With which that blur is as large as is wished at most; infinite for an animal that stands.
    frame_time_us, highest_fps : float
        Of the readout; and images a second with the set exposure.
    """

    name: str
    focal_mm: float
    pixels: float
    pixels_high: float
    least_focal_mm: float
    most_focal_mm: float
    field_deg: tuple[float, float]
    field_m: tuple[float, float]
    hyperfocal_m: float
    near_m: float
    far_m: float
    blur_px: float
    most_exposure_us: float
    frame_time_us: float
    highest_fps: float


@dataclass(frozen=True)
class LidarPlan:
    """What one lidar returns from the animal at the wished distance.

    `points` are those of a frame on the animal, `spacing_cm` is the mean distance between neighbours there,
    `field_m` width and height of the lidar's field, m.
    """

    name: str
    points: float
    spacing_cm: float
    field_m: tuple[float, float]


@dataclass(frozen=True)
class EncoderPlan:
    """One encoder: angle of a count (degrees); cm of it at the wished distance, None for rings of a lens."""

    name: str
    counts_per_turn: float
    step_deg: float
    step_cm: float | None
    tolerance_deg: float


@dataclass(frozen=True)
class DistanceRow:
    """What one camera, all lidars and the coarsest axis of the head give at a distance.

    Attributes
    ----------
    camera : str
    distance_m : float
    pixels : tuple of float
        On the animal's length, for each focal length of the plan's `focal_mm`.
    least_focal_mm : float
        For the wished pixels.
    width_m, height_m : float
        Of what is in the picture, with the set focal length, as all that follows.
    near_m, far_m : float
        Sharp from and to when focused there.
    blur_px : float
    lidar_points : float
        On the animal, of all lidars in a frame of each.
    pan_cm : float
        NaN without encoders on pan and tilt.
    """

    camera: str
    distance_m: float
    pixels: tuple[float, ...]
    least_focal_mm: float
    width_m: float
    height_m: float
    near_m: float
    far_m: float
    blur_px: float
    lidar_points: float
    pan_cm: float


@dataclass(frozen=True)
class RigPlan:
    """A rig and all that follows from it. `focal_mm` are the focal lengths of the table of distances."""

    rig: RigFile
    cameras: tuple[CameraPlan, ...]
    lidars: tuple[LidarPlan, ...]
    overlaps: tuple[Overlap, ...]
    encoders: tuple[EncoderPlan, ...]
    storage: StoragePlan
    focal_mm: dict[str, tuple[float, ...]]
    distances: tuple[DistanceRow, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; what is infinite or unknown is None."""
        parts = {
            key: _plain(getattr(self, key))
            for key in ("cameras", "lidars", "overlaps", "encoders", "storage", "focal_mm", "distances")
        }
        return {"format": FORMAT, "rig": self.rig.model_dump(mode="json"), **parts}


def plan_rig(rig: RigFile) -> RigPlan:
    """Work out what a rig will do.

    Raises
    ------
    InputError
        The rig has no camera.
    """
    if not rig.cameras:
        raise InputError(
            "A rig without a camera cannot be planned.",
            key="cameras",
            expected="one camera or more",
            found="none",
            remedy="leave the key out for the default camera",
        )
    wishes = rig.wishes
    focal = {name: _focal_lengths(camera, wishes) for name, camera in rig.cameras.items()}
    return RigPlan(
        rig=rig,
        cameras=tuple(_camera(name, camera, wishes) for name, camera in rig.cameras.items()),
        lidars=tuple(_lidar(name, lidar, wishes) for name, lidar in rig.lidars.items()),
        overlaps=tuple(
            field_overlap(camera, lidar, (c, one))
            for c, camera in rig.cameras.items()
            for one, lidar in rig.lidars.items()
        ),
        encoders=tuple(_encoder(name, rig) for name in rig.encoders),
        storage=plan_storage(rig),
        focal_mm=focal,
        distances=tuple(
            _row(name, wishes.distance_m * times, rig, focal[name])
            for name in rig.cameras
            for times in DISTANCES
        ),
    )


def animal_points(lidar: LidarPart, wishes: Wishes, distance_m: float) -> float:
    """Points of a lidar frame on the animal: of its length × height, the share that its body covers."""
    area = wishes.animal_m * wishes.animal_height_m * wishes.animal_fill
    return points_on_target(area, distance_m, lidar.points, lidar.fov_deg)


def coarsest_step_cm(rig: RigFile, distance_m: float) -> float:
    """Largest step of the encoders of the head at a distance, cm; NaN where there are none."""
    counts = [part.counts_per_turn for name, part in rig.encoders.items() if turns_the_view(name)]
    return step_cm(min(counts), distance_m) if counts else math.nan


def _camera(name: str, camera: CameraPart, wishes: Wishes) -> CameraPlan:
    lens, pitch, distance = camera.lens, camera.pixel_um, wishes.distance_m
    focal = lens.used_mm
    sides = (camera.width, camera.height)
    animal = (wishes.animal_m, wishes.animal_height_m)
    near, far = depth_of_field_m(lens.focus_m, focal, lens.f_number, wishes.sharp_px * pitch)
    blur = motion_blur_px(wishes.speed_m_s, camera.exposure_us, distance, focal, pitch)
    readout = camera.frame_overhead_us, camera.line_us
    return CameraPlan(
        name=name,
        focal_mm=focal,
        pixels=pixels_on_target(animal[0], distance, focal, pitch),
        pixels_high=pixels_on_target(animal[1], distance, focal, pitch),
        least_focal_mm=focal_for_pixels(wishes.least_px, animal[0], distance, pitch),
        most_focal_mm=min(
            focal_for_pixels(n, size, distance, pitch) for n, size in zip(sides, animal, strict=True)
        ),
        field_deg=(
            field_of_view_deg(sides[0], pitch, focal),
            field_of_view_deg(sides[1], pitch, focal),
        ),
        field_m=_field_m(camera, distance),
        hyperfocal_m=hyperfocal_m(focal, lens.f_number, wishes.sharp_px * pitch),
        near_m=near,
        far_m=far,
        blur_px=blur,
        most_exposure_us=camera.exposure_us * wishes.blur_px / blur if blur else math.inf,
        frame_time_us=frame_time_us(camera.height, *readout),
        highest_fps=highest_fps(camera.height, *readout, exposure_us=camera.exposure_us),
    )


def _field_m(camera: CameraPart, distance_m: float) -> tuple[float, float]:
    scale = camera.pixel_um * 1e-3 / camera.lens.used_mm * distance_m
    return camera.width * scale, camera.height * scale


def _lidar(name: str, lidar: LidarPart, wishes: Wishes) -> LidarPlan:
    distance = wishes.distance_m
    density = points_per_steradian(lidar.points, lidar.fov_deg) / distance**2
    sizes = [2.0 * distance * math.tan(math.radians(0.5 * angle)) for angle in lidar.fov_deg]
    return LidarPlan(
        name=name,
        points=animal_points(lidar, wishes, distance),
        spacing_cm=100.0 / math.sqrt(density),
        field_m=(sizes[0], sizes[1]),
    )


def _encoder(name: str, rig: RigFile) -> EncoderPlan:
    part = rig.encoders[name]
    return EncoderPlan(
        name=name,
        counts_per_turn=part.counts_per_turn,
        step_deg=step_deg(part.counts_per_turn),
        step_cm=step_cm(part.counts_per_turn, rig.wishes.distance_m) if turns_the_view(name) else None,
        tolerance_deg=part.tolerance * step_deg(part.counts_per_turn),
    )


def _focal_lengths(camera: CameraPart, wishes: Wishes) -> tuple[float, ...]:
    """Focal lengths worth a column: the lens's ends, that of the recording, that of the wished pixels."""
    low, high = camera.lens.focal_mm
    least = focal_for_pixels(wishes.least_px, wishes.animal_m, wishes.distance_m, camera.pixel_um)
    between = [round(math.sqrt(low * high), 1), round(math.sqrt(max(low, least) * high), 1)]
    chosen = {low, high, camera.lens.used_mm, *between, least}
    return tuple(sorted(focal for focal in chosen if low <= focal <= high))


def _row(name: str, distance_m: float, rig: RigFile, focal_mm: tuple[float, ...]) -> DistanceRow:
    camera, wishes = rig.cameras[name], rig.wishes
    lens, pitch = camera.lens, camera.pixel_um
    width, height = _field_m(camera, distance_m)
    near, far = depth_of_field_m(distance_m, lens.used_mm, lens.f_number, wishes.sharp_px * pitch)
    return DistanceRow(
        camera=name,
        distance_m=distance_m,
        pixels=tuple(pixels_on_target(wishes.animal_m, distance_m, focal, pitch) for focal in focal_mm),
        least_focal_mm=focal_for_pixels(wishes.least_px, wishes.animal_m, distance_m, pitch),
        width_m=width,
        height_m=height,
        near_m=near,
        far_m=far,
        blur_px=motion_blur_px(wishes.speed_m_s, camera.exposure_us, distance_m, lens.used_mm, pitch),
        lidar_points=sum(animal_points(lidar, wishes, distance_m) for lidar in rig.lidars.values()),
        pan_cm=coarsest_step_cm(rig, distance_m),
    )


def _plain(value: Any) -> Any:
    """Dictionaries, lists, text and finite numbers."""
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
