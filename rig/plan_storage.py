"""Formulas of what a recording writes: rates, hours on the disk, seconds in memory.

MB and GB are 10⁶ and 10⁹ bytes, as makers of disks count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from acino_fte.rig.rig_file import CameraPart, LidarPart, RigFile, Storage

Codec = Literal["h264", "raw"]
Returns = Literal["none", "single", "dual"]
LVX_BYTES = {"single": 1363 / 96, "dual": 1363 / 48}
"""Bytes of a point in LVX: packages of 1363 bytes with 96 points, or 48 with two returns (types 2, 4)."""


@dataclass(frozen=True)
class StorageRow:
    """One way to record.

    Attributes
    ----------
    video : str
        ``raw``, ``h264``, or ``as planned``.
    lidar : str
        ``none``, ``single``, ``dual``, or ``as planned``.
    mb_s : float
        All that is written, MB/s.
    fills_h : float
        Hours until an empty disk is full.
    hours : float
        Hours of footage: less the reserve.
    longest_h : float
        The longest single recording: less, where the disk is too slow and memory fills up.
    stall_s : float
        Seconds for which memory holds what comes while the disk takes nothing.
    memory_gb : float
        Memory that a recording of the wished length needs, beyond what the disk takes meanwhile.
    disk_share : float
        Of what the disk can write.
    enough : bool
        Whether there are the wished hours of footage.
    """

    video: str
    lidar: str
    mb_s: float
    fills_h: float
    hours: float
    longest_h: float
    stall_s: float
    memory_gb: float
    disk_share: float
    enough: bool

    @property
    def mbit_s(self) -> float:
        """All that is written, Mbit/s."""
        return 8.0 * self.mb_s

    @property
    def gb_per_hour(self) -> float:
        """GB in an hour."""
        return 3.6 * self.mb_s


@dataclass(frozen=True)
class StoragePlan:
    """All ways to record, and the one of the plan.

    Attributes
    ----------
    planned : StorageRow
    rows : tuple of StorageRow
        Raw and H.264, each without lidar, with single and with dual returns.
    image_mb : float
        Memory of one image of every camera, MB.
    buffer_gb : float
        Memory for what waits.
    buffer_s : float
        Seconds of raw images that fit into it: so long may encoder and disk stand still.
    most_mbit_s : float
        Of all videos together with which the wished hours just fit; negative where nothing does.
    """

    planned: StorageRow
    rows: tuple[StorageRow, ...]
    image_mb: float
    buffer_gb: float
    buffer_s: float
    most_mbit_s: float


def image_mb(camera: CameraPart) -> float:
    """Size of a raw image, MB: width × height × bits / 8; pixels of 10 and 12 bits are packed."""
    return camera.width * camera.height * camera.bits / 8e6


def video_mb_s(camera: CameraPart, codec: Codec | None = None) -> float:
    """What a camera's video takes, MB/s: raw images, or the bit rate of the H.264 encoder."""
    if (codec or camera.codec) == "raw":
        return image_mb(camera) * camera.fps
    return camera.bitrate_mbit / 8.0


def lidar_mb_s(lidar: LidarPart, returns: Returns | None = None) -> float:
    """What a lidar takes, MB/s: twice as much with two returns of every point."""
    return lidar.mb_s * {"none": 0.0, "single": 1.0, "dual": 2.0}[returns or lidar.returns]


def lvx_mb_s(points_per_second: float, returns: Literal["single", "dual"] = "single") -> float:
    """What a lidar's points take in an LVX file, MB/s: 3.4 for 240 000 points a second, 6.8 with two returns.

    Size of packages from "LVX Specifications" (Livox 2019). As ROS 2 messages (CustomMsg, 20 bytes) a point
    takes 1.4 times as much before it is compressed.
    """
    return 1e-6 * points_per_second * LVX_BYTES[returns]


def plan_storage(rig: RigFile) -> StoragePlan:
    """Work out every way to record with a rig."""
    cameras, lidars = rig.cameras.values(), rig.lidars.values()
    every: tuple[Returns, ...] = ("none", "single", "dual") if rig.lidars else ("none",)
    codecs: tuple[Codec, ...] = ("raw", "h264")
    rows = tuple(
        storage_row(
            sum(video_mb_s(c, codec) for c in cameras) + sum(lidar_mb_s(one, returns) for one in lidars),
            rig,
            codec,
            returns,
        )
        for codec in codecs
        for returns in every
    )
    of_lidars = sum(lidar_mb_s(one) for one in lidars)
    planned = storage_row(sum(video_mb_s(c) for c in cameras) + of_lidars, rig, "as planned", "as planned")
    buffer = rig.storage.ram_gb * rig.storage.buffer_share
    raw = sum(video_mb_s(c, "raw") for c in cameras)
    return StoragePlan(
        planned=planned,
        rows=rows,
        image_mb=sum(image_mb(c) for c in cameras),
        buffer_gb=buffer,
        buffer_s=buffer * 1e3 / raw if raw else math.inf,
        most_mbit_s=8.0 * (_room_gb(rig.storage) * 1e3 / (rig.wishes.hours * 3600.0) - of_lidars),
    )


def storage_row(mb_s: float, rig: RigFile, video: str = "", lidar: str = "") -> StorageRow:
    """What a rate (MB/s) means for disk and memory of a rig.

    Hours are room / rate. Memory takes what the disk cannot: (rate − disk) × time, until it is full.
    """
    storage, wishes = rig.storage, rig.wishes
    buffer = storage.ram_gb * storage.buffer_share
    hours = _room_gb(storage) / (3.6 * mb_s)
    excess = max(0.0, mb_s - storage.write_mb_s)
    full_h = buffer / (3.6 * excess) if excess else math.inf
    return StorageRow(
        video=video,
        lidar=lidar,
        mb_s=mb_s,
        fills_h=storage.capacity_gb / (3.6 * mb_s),
        hours=hours,
        longest_h=min(hours, full_h),
        stall_s=buffer * 1e3 / mb_s,
        memory_gb=excess * wishes.minutes * 0.06,
        disk_share=mb_s / storage.write_mb_s,
        enough=hours >= wishes.hours,
    )


def _room_gb(storage: Storage) -> float:
    """What recordings may fill, GB."""
    return max(0.0, storage.capacity_gb - storage.reserve_gb)
