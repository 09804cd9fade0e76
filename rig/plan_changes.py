"""What a plan takes other than the rig file has it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Literal

from acino_fte.errors import InputError
from acino_fte.rig.rig_file import RigFile
from acino_fte.rig.rig_read import checked_rig

_FLAGS = {
    **{"focal_mm": "--focal", "distance_m": "--distance", "focus_m": "--focus", "f_number": "--f-number"},
    **{"exposure_us": "--exposure", "fps": "--fps", "codec": "--codec", "bitrate_mbit": "--bitrate"},
    **{"returns": "--returns", "capacity_gb": "--capacity", "animal_m": "--animal"},
}


@dataclass(frozen=True)
class PlanChanges:
    """Values for all cameras and lidars of a rig, named as in the rig file; None leaves what is there.

    A `distance_m` is in focus too, unless `focus_m` says otherwise.
    """

    focal_mm: float | None = None
    distance_m: float | None = None
    focus_m: float | None = None
    f_number: float | None = None
    exposure_us: float | None = None
    fps: float | None = None
    codec: Literal["h264", "raw"] | None = None
    bitrate_mbit: float | None = None
    returns: Literal["single", "dual"] | None = None
    capacity_gb: float | None = None
    animal_m: float | None = None


def changed_rig(rig: RigFile, changes: PlanChanges) -> RigFile:
    """The rig with the changes.

    A new length of the animal keeps the animal's shape: the height grows with it.

    Raises
    ------
    InputError
        A value is impossible, or the lens does not have that focal length.
    """
    _check(rig, changes)
    data = rig.model_dump()
    focus = changes.distance_m if changes.focus_m is None else changes.focus_m
    of_camera = {key: getattr(changes, key) for key in ("exposure_us", "fps", "codec", "bitrate_mbit")}
    of_lens = {"used_mm": changes.focal_mm, "f_number": changes.f_number, "focus_m": focus}
    for camera in data["cameras"].values():
        _put(camera, of_camera)
        _put(camera["lens"], of_lens)
    for lidar in data["lidars"].values():
        _put(lidar, {"returns": changes.returns})
    _put(data["storage"], {"capacity_gb": changes.capacity_gb})
    _put(data["wishes"], {"distance_m": changes.distance_m})
    if changes.animal_m is not None:
        data["wishes"]["animal_height_m"] *= changes.animal_m / data["wishes"]["animal_m"]
        data["wishes"]["animal_m"] = changes.animal_m
    return checked_rig(data)


def _put(data: dict[str, Any], values: dict[str, Any]) -> None:
    data.update({key: value for key, value in values.items() if value is not None})


def _check(rig: RigFile, changes: PlanChanges) -> None:
    """Name the option rather than the key of the file."""
    for field in fields(changes):
        value, flag = getattr(changes, field.name), _FLAGS[field.name]
        if isinstance(value, int | float) and not (math.isfinite(value) and 0 < value < 1e12):
            raise InputError(
                f"The value of {flag} is impossible.", key=flag, expected="more than 0", found=f"{value:g}"
            )
    focal = changes.focal_mm
    for name, camera in rig.cameras.items():
        low, high = camera.lens.focal_mm
        if focal is not None and not low <= focal <= high:
            raise InputError(
                f"The lens of {name} does not have this focal length.",
                key="--focal",
                expected=f"from {low:g} to {high:g} mm",
                found=f"{focal:g} mm",
                remedy="for another lens write a rig file (acino-fte rig plan --init) and change focal_mm",
            )
