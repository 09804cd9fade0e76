"""The lidar of a sequence: returns in an ``.npz``, and the calibration to a camera."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.lidar_camera import read_lidar_camera
from acino_fte.data_tools.sequence_file import LidarEntry
from acino_fte.errors import InputError, did_you_mean
from acino_fte.lidar import Lidar

_ARRAYS = ("time", "xyz", "intensity")


def read_lidar(entry: LidarEntry, cameras: CameraArray, source: Path) -> Lidar:
    """Read what the key ``lidar`` of a sequence file names.

    Parameters
    ----------
    entry : LidarEntry
        With absolute paths.
    cameras : CameraArray
        Of the sequence.
    source : Path
        The sequence file, for messages.

    Raises
    ------
    InputError
        The camera is none of the sequence's, a file is missing or is no such file, or a number is not finite.
    """
    if entry.camera not in cameras.names:
        raise InputError(
            f"The lidar belongs to a camera that the sequence does not have"
            f"{did_you_mean(entry.camera, cameras.names)}",
            file=source,
            key="lidar.camera",
            expected=f"one of {', '.join(cameras.names)}",
            found=entry.camera,
            remedy="use the name of a camera that has keypoints",
        )
    camera = cameras[entry.camera]
    calibration = read_lidar_camera(entry.calibration, entry.direction, camera=camera).camera
    arrays = read_returns(Path(entry.returns))
    order = np.argsort(arrays["time"], kind="stable")
    return Lidar(
        entry.camera,
        arrays["time"][order],
        arrays["xyz"][order],
        arrays["intensity"][order],
        calibration.rotation,
        calibration.translation,
        entry.range_sd,
        1e-3 * entry.time_sd_ms,
    )


def read_returns(path: Path) -> dict[str, np.ndarray]:
    """Arrays ``time`` (K,), ``xyz`` (K, 3) and ``intensity`` (K,) of a file; zeros where it has no intensity.

    Raises
    ------
    InputError
        The file is missing, is no ``.npz``, or has not these arrays.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name in _ARRAYS}
    except FileNotFoundError:
        raise InputError(
            "The lidar's returns are not there.", file=path, key="lidar.returns", remedy="check the path"
        ) from None
    except (OSError, ValueError, zipfile.BadZipFile, EOFError, AttributeError):
        raise InputError(
            "The lidar's returns cannot be read.",
            file=path,
            key="lidar.returns",
            expected=f"an .npz with the arrays {', '.join(_ARRAYS)}",
            found="something else, or a damaged file",
            remedy="make it again with 'acino-fte import-recording'",
        ) from None
    count = len(arrays["time"]) if "time" in arrays and arrays["time"].ndim == 1 else -1
    arrays.setdefault("intensity", np.zeros(max(count, 0)))
    right = count >= 0 and arrays.get("xyz", np.empty(0)).shape == (count, 3)
    numeric = all(a.dtype.kind in "fiu" for a in arrays.values())
    if not (right and numeric and arrays["intensity"].shape == (count,)):
        raise InputError(
            "The arrays of the lidar's returns do not belong together.",
            file=path,
            key="lidar.returns",
            expected="time (K,), xyz (K, 3) and intensity (K,), numbers",
            found=", ".join(f"{n} {a.shape} {a.dtype}" for n, a in sorted(arrays.items())) or "none of them",
            remedy="make it again with 'acino-fte import-recording'",
        )
    return {name: np.asarray(array, dtype=float) for name, array in arrays.items()}
