"""Lidar returns of a sequence, from a recording into an archive, a message at a time."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.open_recording import open_recording
from acino_fte.data_tools.recording import LidarReturns

_COLUMNS: dict[str, tuple[str, int]] = {"time": ("<f8", 1), "xyz": ("<f4", 3), "intensity": ("<f4", 1)}
_BLOCK = 1 << 20


class ReturnsWriter:
    """Write ``lidar.npz`` (time (K,) s, xyz (K, 3) m, intensity (K,)) without holding it: a context manager.

    Columns go to temporary files, and into the archive at the end.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.n = path, 0
        self._files: dict[str, Any] = {}

    def __enter__(self) -> ReturnsWriter:
        for name in _COLUMNS:
            self._files[name] = TemporaryFile(dir=self.path.parent)  # noqa: SIM115 - closed in __exit__
        return self

    def add(self, **columns: np.ndarray) -> None:
        """Append returns: time, xyz and intensity."""
        self.n += len(columns["time"])
        for name, (kind, _) in _COLUMNS.items():
            self._files[name].write(np.ascontiguousarray(columns[name], dtype=kind).tobytes())

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._pack()
        finally:
            for file in self._files.values():
                file.close()

    def _pack(self) -> None:
        with zipfile.ZipFile(self.path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, (kind, width) in _COLUMNS.items():
                shape = (self.n,) if width == 1 else (self.n, width)
                head = {"descr": kind, "fortran_order": False, "shape": shape}
                with archive.open(f"{name}.npy", "w", force_zip64=True) as out:
                    np.lib.format.write_array_header_1_0(out, head)
                    self._files[name].seek(0)
                    while block := self._files[name].read(_BLOCK):
                        out.write(block)


def write_returns(
    recording: Path,
    stream: str,
    target: Path,
    to_time: Callable[[np.ndarray, int | None], tuple[np.ndarray, np.ndarray]],
    camera: Camera,
    margin_px: float | None,
    tell: Callable[[str], None],
) -> dict[str, int]:
    """Write the returns of a sequence.

    Parameters
    ----------
    recording, stream : Path, str
        Where they are.
    target : Path
        The archive.
    to_time : callable
        From stamps (K,) and the time of reception to sequence times (K,), s, and which of them to keep.
    camera : Camera
        In the lidar's frame.
    margin_px : float, optional
        Keep only returns within the picture and this margin, px.
    tell : callable
        Is told how far it is.

    Returns
    -------
    dict
        ``kept``, ``in_time`` and ``read``: numbers of returns.
    """
    counts = {"read": 0, "in_time": 0, "kept": 0}
    with ReturnsWriter(target) as writer:
        for returns, received in lidar_messages(recording, stream):
            counts["read"] += len(returns)
            time, keep = to_time(returns.time_ns, received)
            keep &= np.isfinite(returns.xyz).all(axis=1)
            counts["in_time"] += int(keep.sum())
            if margin_px is not None and keep.any():
                keep[keep] = in_view(camera, returns.xyz[keep], margin_px)
            if keep.any():
                writer.add(time=time[keep], xyz=returns.xyz[keep], intensity=returns.intensity[keep])
                tell(f"lidar: {writer.n} returns")
        counts["kept"] = writer.n
    return counts


def lidar_messages(recording: Path, stream: str) -> Iterator[tuple[LidarReturns, int | None]]:
    """The messages of a lidar with the times at which they were received."""
    with open_recording(recording) as reader:
        for record in reader.records(kinds=["lidar"], streams=[stream]):
            if isinstance(record.value, LidarReturns) and len(record.value):
                yield record.value, record.received_ns


def in_view(camera: Camera, xyz: np.ndarray, margin_px: float) -> np.ndarray:
    """(K,) which points (K, 3) in the lidar's frame are in the picture or as near to it, px."""
    pixels = camera.project(np.asarray(xyz, dtype=float))
    width, height = camera.resolution
    with np.errstate(invalid="ignore"):
        inside = (pixels >= -margin_px - 0.5) & (pixels <= np.array([width, height]) - 0.5 + margin_px)
    return np.asarray(inside.all(axis=1))
