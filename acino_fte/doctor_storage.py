"""Disk: how fast, how much is free, and can the cache be written?"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from acino_fte.doctor import ALL, RIG, Finding, Surroundings

_STEP = 4 << 20  # bytes; each step is on the disk before the next
_STEPS, _SECONDS = 16, 0.6  # at most
_MB, _GB = 1e6, 1e9
_RESULT_GB, _SEQUENCE_GB = 0.2, 2.0  # that a run, and an import with pictures, should find


@dataclass(frozen=True)
class RecordingNeeds:
    """What the default rig writes: MB/s with H.264 and with raw pictures, and GB that it needs to begin."""

    h264_mb_s: float
    raw_mb_s: float
    free_gb: float


def recording_needs() -> RecordingNeeds:
    """From the defaults of ``rig.yaml``: one camera, one lidar, one recording, and the reserve."""
    from acino_fte.rig.rig_file import CameraPart, LidarPart, Storage, Wishes

    camera, lidar = CameraPart(), LidarPart()
    h264 = camera.bitrate_mbit / 8.0 + lidar.mb_s
    raw = camera.width * camera.height * camera.bits / 8.0 * camera.fps / _MB + lidar.mb_s
    return RecordingNeeds(h264, raw, Storage().reserve_gb + h264 * 60.0 * Wishes().minutes * _MB / _GB)


def look_at_disk(around: Surroundings) -> Finding:
    """Write a temporary file for half a second; then the speed and the free space."""
    free = shutil.disk_usage(around.path).free / _GB
    details: dict[str, object] = {"path": str(around.path.resolve()), "free_gb": round(free, 3)}
    try:
        speed = write_speed(around.path, free)
    except OSError as error:
        text = f"{around.path.resolve()} cannot be written: {error.strerror or error}"
        return Finding("failed", text, "name a folder of yours with --path, or free some space", ALL, details)
    details["write_mb_s"] = round(speed, 1)
    needs = recording_needs()
    text = f"{free:.1f} GB free, writes {speed:.0f} MB/s"
    if free < _RESULT_GB:
        return Finding("failed", text, "free some space: a run needs some 0.2 GB", ALL, details)
    if free < needs.free_gb:
        minutes = max(0.0, (free - 5.0) * _GB / needs.h264_mb_s / _MB / 60.0)
        remedy = f"free some space: a recording of 10 min takes {needs.free_gb:.0f} GB with its reserve"
        return Finding("failed", f"{text}: {minutes:.0f} min of recording", remedy, RIG, details)
    if speed < 2.0 * needs.h264_mb_s:
        remedy = (
            f"record to a faster disk: camera and lidar write {needs.h264_mb_s:.0f} MB/s, and need twice that"
        )
        return Finding("failed", text, remedy, RIG, details)
    raw = "" if speed > 1.5 * needs.raw_mb_s else f"; not raw pictures at 60 fps ({needs.raw_mb_s:.0f} MB/s)"
    return Finding("ok", f"{text}: records H.264 and lidar{raw}", matters=ALL, details=details)


def write_speed(folder: Path, free_gb: float = float("inf")) -> float:
    """MB/s that reach the disk, fsync included.

    The file has no name where the system can do that, and else is deleted at once: nothing stays behind.
    """
    content = os.urandom(_STEP)  # that no disk can compress
    steps = int(max(1.0, min(_STEPS, free_gb * _GB / 4.0 / _STEP)))
    written, begun = 0, time.perf_counter()
    with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
        for _ in range(steps):
            written += file.write(content)
            os.fsync(file.fileno())
            if time.perf_counter() - begun > _SECONDS:
                break
    return written / _MB / max(time.perf_counter() - begun, 1e-6)


def look_at_cache(around: Surroundings) -> Finding:  # noqa: ARG001 - every check takes it
    """The folder of derived programs: a run writes it once, later ones read it."""
    try:
        from acino_fte.codegen import cache_folder
    except ImportError as error:
        return Finding("note", f"cannot tell: {error}", "see packages, below")
    folder = cache_folder()
    known = len(list(folder.glob("*.json"))) if folder.is_dir() else 0
    details = {"folder": str(folder), "programs": known}
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"acino-fte doctor")
    except OSError as error:
        text = f"{folder} cannot be written: {error.strerror or error}; every run derives its model anew"
        return Finding("failed", text, "set ACINO_FTE_CACHE to a folder of yours", details=details)
    return Finding("ok", f"{folder}, {known} models", details=details)
