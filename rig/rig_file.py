"""``rig.yaml``: what a rig is made of, and what a recording with it is to reach.

The same file plans a recording, drives the devices and records: the defaults are the rig of WildPose, a Ximea
MQ022CG-CM with a 5–150 mm zoom lens and a Livox Tele-15 on a computer with a disk of 1 TB.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

FORMAT = "acino-fte/rig/1"
FILE_NAME = "rig.yaml"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Lens(_Part):
    """A lens, fixed or zoom."""

    focal_mm: tuple[float, float] = Field(
        default=(5.0, 150.0), description="shortest and longest focal length"
    )
    used_mm: float = Field(default=150.0, gt=0, description="focal length of the recording")
    f_number: float = Field(default=4.0, gt=0, description="aperture of the recording")
    focus_m: float = Field(default=90.0, gt=0, description="distance that is in focus")


class CameraPart(_Part):
    """A camera with its lens and its video."""

    device: str = Field(default="simulated", description="driver: simulated, or the name of a real one")
    width: int = Field(default=2048, gt=0, description="px")
    height: int = Field(default=1088, gt=0, description="px")
    pixel_um: float = Field(default=5.5, gt=0, description="from pixel to pixel, µm")
    fps: float = Field(default=60.0, gt=0, description="images a second")
    bits: int = Field(default=8, gt=0, description="of a raw pixel")
    exposure_us: float = Field(default=1000.0, gt=0, description="µs")
    frame_overhead_us: float = Field(default=37.6, ge=0, description="frame time = this + line_us × lines")
    line_us: float = Field(default=5.375, ge=0, description="µs")
    codec: Literal["h264", "raw"] = Field(default="h264", description="h264 or raw")
    bitrate_mbit: float = Field(default=20.0, gt=0, description="of the video, Mbit/s")
    lens: Lens = Lens()


class LidarPart(_Part):
    """A lidar with the inertial sensor in it."""

    device: str = Field(default="simulated", description="driver: simulated, or the name of a real one")
    rate_hz: float = Field(default=10.0, gt=0, description="frames a second")
    points: int = Field(default=24_000, gt=0, description="points in a frame")
    returns: Literal["single", "dual"] = Field(default="single", description="single or dual")
    fov_deg: tuple[float, float] = Field(default=(14.5, 16.2), description="horizontal, vertical")
    mb_s: float = Field(default=3.4, gt=0, description="MB/s in LVX, single returns; twice that with dual")
    imu_hz: float = Field(default=200.0, ge=0, description="0 for none")


class EncoderPart(_Part):
    """An incremental encoder on a ring of the lens or an axis of the head."""

    counts_per_turn: float = Field(gt=0, description="counts of the decoder (×4) in a turn of the shaft")
    tolerance: float = Field(
        default=20.0, ge=0, description="counts within which the calibration stays valid"
    )
    motor: int = Field(default=0, ge=0, le=9, description="its motor's number at the microcontroller, or 0")
    gpio: str = Field(default="", description="its chip and lines A, B (, index): gpiochip0 12 13")


def _encoders() -> dict[str, EncoderPart]:
    return {
        "zoom": EncoderPart(counts_per_turn=4741.44, motor=1),
        "focus": EncoderPart(counts_per_turn=4741.44, motor=2),
        "pan": EncoderPart(counts_per_turn=4000.0),
        "tilt": EncoderPart(counts_per_turn=4000.0),
    }


class Storage(_Part):
    """Disk and memory of the computer."""

    capacity_gb: float = Field(default=1000.0, gt=0, description="GB of 10⁹ bytes")
    write_mb_s: float = Field(default=1000.0, gt=0, description="MB/s that the disk can take for long")
    ram_gb: float = Field(default=32.0, gt=0, description="memory, GB")
    buffer_share: float = Field(
        default=0.5, gt=0, le=1, description="of the memory that may hold what waits for the disk"
    )
    reserve_gb: float = Field(default=5.0, ge=0, description="GB that a recording leaves free")
    segment_s: float = Field(default=60.0, gt=0, description="length of a file of a recording, s")


class Wishes(_Part):
    """What is to be reached; the defaults are the requirements of the WildPose thesis."""

    animal_m: float = Field(default=1.5, gt=0, description="length of the animal")
    animal_height_m: float = Field(default=0.8, gt=0, description="height of the animal")
    animal_fill: float = Field(
        default=0.5, gt=0, le=1, description="share of length × height that its body covers"
    )
    distance_m: float = Field(default=100.0, gt=0, description="of the animal")
    least_px: float = Field(default=50.0, gt=0, description="on the animal at that distance")
    speed_m_s: float = Field(default=20.0, ge=0, description="of the animal across the picture")
    blur_px: float = Field(default=2.0, gt=0, description="largest motion blur")
    sharp_px: float = Field(
        default=2.0, gt=0, description="largest blur of what is out of focus (circle of confusion)"
    )
    hours: float = Field(default=10.0, gt=0, description="of footage on the disk")
    minutes: float = Field(default=10.0, gt=0, description="of one recording without loss")
    vibration_h: float = Field(default=12.0, gt=0, description="hours on rough roads that the rig stands")
    pan_cm: float = Field(default=20.0, gt=0, description="largest step of pan and tilt, at that distance")
    lidar_points: float = Field(
        default=20.0, gt=0, description="least returns on the animal in a lidar frame"
    )


class RigFile(_Part):
    """The content of a ``rig.yaml``."""

    format: Literal["acino-fte/rig/1"] = "acino-fte/rig/1"
    name: str = "rig"
    cameras: dict[str, CameraPart] = Field(default_factory=lambda: {"cam1": CameraPart()})
    lidars: dict[str, LidarPart] = Field(default_factory=lambda: {"lidar1": LidarPart()})
    encoders: dict[str, EncoderPart] = Field(
        default_factory=_encoders,
        description="in the order in which camera messages carry their counts",
    )
    storage: Storage = Storage()
    wishes: Wishes = Wishes()
