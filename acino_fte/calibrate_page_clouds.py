"""Point clouds of files, as the calibration page and its pairs need them: points and intensities."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from acino_fte.calibrate_page_input import MOST_POINTS
from acino_fte.errors import InputError

_KITTI = 16  # bytes a point: x, y, z, reflectance, float32


def read_cloud(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Points and intensities of a file.

    Parameters
    ----------
    path : Path
        PCD, PLY, KITTI's ``.bin``, ``.npz`` with the arrays ``xyz`` and ``intensity``, ``.npy`` (K, 3 or 4),
        or a recording (LVX, ROS bag, MCAP), whose returns are taken together from its beginning: a rig that
        stands still for some seconds.

    Returns
    -------
    xyz : (K, 3)
        m, frame of the lidar.
    intensity : (K,)
        0 where the file has none.

    Raises
    ------
    InputError
        The file cannot be read, or holds no points.
    """
    path = Path(path)
    if not path.exists():
        raise InputError("There is no such point cloud.", file=path, remedy="check the path")
    suffix = path.suffix.lower()
    if suffix == ".bin":
        xyz, intensity = _kitti(path)
    elif suffix in (".npz", ".npy"):
        xyz, intensity = _numpy(path)
    elif suffix in (".pcd", ".ply"):
        from acino_fte.data_tools.clouds import read_returns

        xyz, intensity = read_returns(path)
    else:
        xyz, intensity = _recording(path)
    if not len(xyz):
        raise InputError("There are no points in it.", file=path, expected="returns of a lidar", found="none")
    return xyz, intensity


def _kitti(path: Path) -> tuple[np.ndarray, np.ndarray]:
    content = path.read_bytes()
    if len(content) % _KITTI:
        raise InputError(
            "This is no cloud of KITTI's kind.",
            file=path,
            expected="4 numbers of 4 bytes a point: x, y, z, reflectance",
            found=f"{len(content)} bytes, no multiple of {_KITTI}",
        )
    table = np.frombuffer(content, "<f4").reshape(-1, 4).astype(float)
    return table[:, :3], table[:, 3]


def _numpy(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        content = np.load(path, allow_pickle=False)
        if path.suffix.lower() == ".npz":
            xyz = np.asarray(content["xyz"], dtype=float)
            intensity = content["intensity"] if "intensity" in content else np.zeros(len(xyz))
        else:
            xyz = np.asarray(content[:, :3], dtype=float)
            intensity = content[:, 3] if content.shape[1] > 3 else np.zeros(len(xyz))
        return xyz.reshape(-1, 3), np.asarray(intensity, dtype=float).reshape(len(xyz))
    except (OSError, ValueError, KeyError, IndexError, EOFError) as error:
        raise InputError(
            "The arrays cannot be read as a point cloud.",
            file=path,
            expected="arrays xyz (K, 3) and intensity (K,), or one array (K, 3 or 4)",
            found=f"{type(error).__name__}: {error}",
        ) from error


def _recording(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Returns of a recording, from its beginning, as many as the page shows."""
    from acino_fte.data_tools.open_recording import open_recording
    from acino_fte.data_tools.recording import LidarReturns

    parts: list[LidarReturns] = []
    count = 0
    with open_recording(path) as reader:
        for record in reader.records(kinds=("lidar",)):
            if isinstance(record.value, LidarReturns):
                parts.append(record.value)
                count += len(record.value)
            if count >= MOST_POINTS:
                break
    if not parts:
        return np.zeros((0, 3)), np.zeros(0)
    return (
        np.concatenate([part.xyz for part in parts]).astype(float),
        np.concatenate([part.intensity for part in parts]).astype(float),
    )
