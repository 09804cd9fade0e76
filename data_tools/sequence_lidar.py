"""The lidar of a sequence: returns in an ``.npz``, and the calibration to a camera."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.lidar_camera import read_lidar_camera
from acino_fte.data_tools.sequence_file import LidarEntry
from acino_fte.errors import InputError, did_you_mean
from acino_fte.lidar import Lidar

_ARRAYS = ("time", "xyz", "intensity")
_LENS_PX = 5.0
_DAMAGE = (  # what the readers of zip, of zlib and of NumPy's headers raise
    *(OSError, ValueError, TypeError, EOFError, KeyError, AttributeError, RuntimeError, MemoryError),
    *(SyntaxError, NotImplementedError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)


def read_lidar(entry: LidarEntry, cameras: CameraArray, source: Path) -> tuple[Lidar, list[str]]:
    """Read what the key ``lidar`` of a sequence file names.

    Parameters
    ----------
    entry : LidarEntry
        With absolute paths.
    cameras : CameraArray
        Of the sequence.
    source : Path
        The sequence file, for messages.

    Returns
    -------
    Lidar
        In the order of time.
    list of str
        What the user should know of its calibration.

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
    lidar = Lidar(
        entry.camera,
        arrays["time"][order],
        arrays["xyz"][order],
        arrays["intensity"][order],
        calibration.rotation,
        calibration.translation,
        entry.range_sd,
        1e-3 * entry.time_sd_ms,
        entry.range_sd_per_m,
        np.radians(entry.beam_deg),
    )
    return lidar, _lens_warnings(camera, calibration, Path(entry.calibration).name)


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
    except _DAMAGE as error:
        raise InputError(
            "The lidar's returns cannot be read.",
            file=path,
            key="lidar.returns",
            expected=f"an .npz with the arrays {', '.join(_ARRAYS)}",
            found=f"something else, or a damaged file ({type(error).__name__})",
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
    found = {name: np.asarray(array, dtype=float) for name, array in arrays.items()}
    wrong = sum(int((~np.isfinite(array)).sum()) for array in found.values())
    if wrong:
        raise InputError(
            "The lidar's returns hold numbers that are not finite.",
            file=path,
            key="lidar.returns",
            found=f"{wrong} of them",
            remedy="leave such returns out of the file",
        )
    return found


def _lens_warnings(camera: Camera, solved: Camera, file: str) -> list[str]:
    """What is to be said where the calibration was solved with another lens than the sequence's camera has.

    Pose and lens are solved together: a camera that is nearer with a shorter lens sees nearly the same, and
    the pose of the one is wrong for the other.
    """
    width, height = camera.resolution
    u, v = np.meshgrid(np.linspace(0.1, 0.9, 5) * width, np.linspace(0.1, 0.9, 5) * height)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    at_rest = replace(solved, rotation=np.eye(3), translation=np.zeros(3))
    scale = np.array([width, height]) / np.array(solved.resolution)
    gap = np.linalg.norm(at_rest.project(camera.directions(pixels)) * scale - pixels, axis=1)
    worst = float(np.nanmax(gap)) if np.isfinite(gap).any() else np.inf
    if worst <= _LENS_PX:
        return []
    return [
        f"the lidar was calibrated with another lens than camera '{camera.name}' has: up to {worst:.0f} px "
        f"apart in the picture; use the camera of {file} in cameras.json"
    ]
