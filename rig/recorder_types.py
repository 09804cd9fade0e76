"""What a recorder works with, and what it says of itself."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from acino_fte.rig.recorder_clock import Clock
from acino_fte.rig.rig_file import RigFile
from acino_fte.rig.sources import Counts, Source


@dataclass(frozen=True)
class Status:
    """A recording at one moment: what the line on the screen says.

    `fps` (what comes) and `written` are by stream, `waiting` is how full the fullest queue is, 0 to 1, and
    `minutes_left` until the disk is full.
    """

    state: str
    elapsed_s: float
    fps: dict[str, float]
    written: dict[str, int]
    dropped: int
    lost: int
    silent: tuple[str, ...]
    lens_moved: bool
    free_bytes: int
    minutes_left: float
    waiting: float


@dataclass
class Equipment:
    """What a recorder works with.

    Attributes
    ----------
    sources : list of Source
    clock : Clock
    counts : Counts, optional
    codecs : dict
        Encoder of every camera, of :func:`acino_fte.rig.writers_video.choose_codec`.
    connected : set of str
        Devices that are open already.
    free_bytes : callable
        Free space, by folder.
    simulated : bool
    """

    sources: Sequence[Source]
    clock: Clock
    counts: Counts | None = None
    codecs: dict[str, str] = field(default_factory=dict)
    connected: set[str] = field(default_factory=set)
    free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free
    simulated: bool = False


def expected_bytes_per_s(rig: RigFile) -> float:
    """What a rig writes, B/s, by its own file: a point of the lidar is 20 bytes, an inertial message 400."""
    cameras = sum(
        c.bitrate_mbit * 1e6 / 8 if c.codec == "h264" else c.width * c.height * c.fps * (1 + (c.bits > 8))
        for c in rig.cameras.values()
    )
    lidars = sum(
        20 * part.points * part.rate_hz * (1 + (part.returns == "dual")) + 400 * part.imu_hz
        for part in rig.lidars.values()
    )
    return max(cameras + lidars, 1.0)


def gigabytes(n_bytes: float) -> str:
    """A size in words: ``1.5 GB``, ``20 MB``."""
    return f"{n_bytes / 1e9:.1f} GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.0f} MB"
