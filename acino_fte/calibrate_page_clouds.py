"""Point clouds of files, as the calibration page and its pairs need them: points and intensities."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from acino_fte.errors import InputError

MOST_RETURNS = 2_000_000
"""Returns of a recording that are taken; a Livox Tele-15 makes as many in 8 s."""
_RECORDINGS = (".lvx", ".lvx2", ".bag", ".db3", ".mcap")


def read_cloud(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Points and intensities of a file.

    Parameters
    ----------
    path : Path
        What :func:`acino_fte.data_tools.clouds.read_cloud` reads (PCD, PLY, KITTI's ``.bin``, NumPy's arrays,
        tables), or a recording (LVX, ROS bag, MCAP), whose returns are taken together from its beginning: of
        a rig that stands still for some seconds.

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
    if path.is_dir() or path.suffix.lower() in _RECORDINGS:
        return _recording(path)
    from acino_fte.data_tools import clouds

    cloud = clouds.read_cloud(path)
    return cloud.xyz, np.zeros(len(cloud)) if cloud.intensity is None else cloud.intensity


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
            if count >= MOST_RETURNS:
                break
    if not count:
        raise InputError(
            "The recording has no returns of a lidar.",
            file=path,
            expected="a stream of point clouds",
            found="none",
            remedy="check that it is the recording with the lidar",
        )
    xyz = np.concatenate([part.xyz for part in parts]).astype(float)
    return xyz, np.concatenate([part.intensity for part in parts]).astype(float)
