"""DLT coefficients as DLTdv, easyWand and Argus write them: eleven rows, one column a camera."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.calibration import UNITS, _with_file
from acino_fte.data_tools.projective_camera import ProjectiveCamera
from acino_fte.errors import InputError

_COEFFICIENTS = 11
_KIND = "11 rows (L1 to L11) with one column of numbers a camera, and no header"
_REMEDY = "pass the dltCoefs file that DLTdv, easyWand or Argus wrote"
_HOW = "read_dlt(path, resolution=(width, height)), px, or profile=the camera profile of Argus"
_OFF_CENTRE = 0.2

Resolution = tuple[int, int]


def read_dlt(
    path: Path | str,
    *,
    resolution: Resolution | Sequence[Resolution] | None = None,
    image_height: int | None = None,
    profile: Path | str | None = None,
    unit: str = "m",
) -> CameraArray:
    """Read the cameras of a file of DLT coefficients.

    The coefficients have y up from the bottom of the image. They are turned at the door into y down from the
    top, ``v = height − v_up``; points that go with them must be turned by the same height. Pixels of DLTdv
    count from 1, so this v is that of OpenCV (pixel centres at integers, from 0), while x keeps the 1 of the
    file: over an image the points of such a recording lie one pixel to the right.
    A camera profile of Argus gives sizes only; its distortion belongs to points that are undistorted already.
    The world must be right-handed, as the three programs make it: seen from a mirrored one, all points are
    behind the cameras.

    Parameters
    ----------
    path : Path
        11 rows × C columns, commas (or semicolons, or spaces) between them.
    resolution : (width, height), or one for each camera
        px. The file does not say it.
    image_height : int, optional
        Height, px, instead of that of the resolution or profile.
    profile : Path, optional
        Camera profile of Argus (a line a camera: number, focal length, width, height, cx, cy, …) for sizes.
    unit : {"m", "cm", "mm"}
        Unit of the world of the coefficients.

    Returns
    -------
    CameraArray
        Cameras ``cam1``, ``cam2``, … in the order of the columns, y down, m.

    Raises
    ------
    InputError
        The file is missing or no table of coefficients, or no argument says how large the images are.
    """
    path = Path(path)
    table = _table(path, _KIND, _REMEDY)
    columns = {len(row) for row in table}
    if len(table) != _COEFFICIENTS or len(columns) != 1:
        shape = f"{len(table)} rows of {' or '.join(map(str, sorted(columns))) or 'no'} columns"
        hint = "; transpose the file" if columns == {_COEFFICIENTS} else ""
        raise InputError(
            "This is no file of DLT coefficients.",
            file=path,
            key="rows",
            expected=_KIND,
            found=shape,
            remedy=_REMEDY + hint,
        )
    coefficients = np.array(table).T
    sizes = _sizes(path, len(coefficients), resolution, image_height, profile)
    cameras = []
    for i, (column, size) in enumerate(zip(coefficients, sizes, strict=True)):
        try:
            camera = ProjectiveCamera.from_dlt(
                f"cam{i + 1}", column, size, image_height=size[1], metres=UNITS[unit]
            )
        except InputError as error:
            raise _with_file(error, path, f"column {i + 1}") from None
        cameras.append(camera)
    return CameraArray(tuple(cameras))


def _sizes(
    path: Path,
    n_cameras: int,
    resolution: Resolution | Sequence[Resolution] | None,
    image_height: int | None,
    profile: Path | str | None,
) -> list[Resolution]:
    """Width and height of every camera's images, px."""
    if resolution is not None:
        sizes = np.array(resolution, dtype=float)
        if sizes.shape == (2,):
            sizes = np.tile(sizes, (n_cameras, 1))
    elif profile is not None:
        sizes = _profile_sizes(Path(profile), n_cameras, checked=image_height is None)
    else:
        raise InputError(
            "DLT coefficients do not say how large the images are.",
            file=path,
            key="resolution",
            expected="the width and height of the images, px: y is counted from their bottom",
            found="none" if image_height is None else f"a height of {image_height} px and no width",
            remedy=_HOW,
        )
    if image_height is not None and sizes.ndim == 2:
        sizes[:, 1:2] = image_height
    if sizes.shape != (n_cameras, 2) or not (np.isfinite(sizes).all() and sizes.min() >= 1):
        raise InputError(
            "The resolution does not fit the cameras.",
            file=path,
            key="resolution",
            expected=f"(width, height), px, for all cameras, or one for each of the {n_cameras}",
            found=str(resolution if resolution is not None else sizes.tolist()),
            remedy=_HOW,
        )
    return [(int(width), int(height)) for width, height in sizes]


def _profile_sizes(path: Path, n_cameras: int, checked: bool) -> np.ndarray:
    """(C, 2) sizes of a camera profile of Argus; a height that its principal point denies is refused."""
    kind = "a line a camera: number, focal length, width, height, cx, cy, …"
    table = _table(path, kind, "pass the camera profile that Argus wrote, or resolution=(width, height)")
    if len(table) < n_cameras or any(len(row) < 6 for row in table):
        raise InputError(
            "The camera profile does not fit the cameras.",
            file=path,
            key="lines",
            expected=f"{n_cameras} lines, each with at least 6 numbers ({kind})",
            found=f"{len(table)} lines, the shortest with {min(map(len, table), default=0)} numbers",
            remedy="pass the profile of the same cameras, or resolution=(width, height)",
        )
    for i, row in enumerate(table[:n_cameras]):
        (width, height), (cx, cy) = row[2:4], row[4:6]
        wrong = [abs(c / size - 0.5) > _OFF_CENTRE for c, size in ((cx, width), (cy, height)) if size > 0]
        if checked and any(wrong):
            raise InputError(
                "The camera profile contradicts itself: the principal point is far from the middle.",
                file=path,
                key=f"line {i + 1}",
                expected=f"a principal point near ({width / 2:g}, {height / 2:g})",
                found=f"({cx:g}, {cy:g})",
                remedy="give the true size: resolution=(width, height), or image_height=…",
            )
    return np.array([row[2:4] for row in table[:n_cameras]])


def _table(path: Path, kind: str, remedy: str) -> list[list[float]]:
    """Rows of finite numbers of a text file; empty lines are passed over."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError("The camera file does not exist.", file=path, remedy="check the path") from None
    except UnicodeDecodeError:
        raise InputError(
            "The camera file is no text.", file=path, expected=kind, found="binary data", remedy=remedy
        ) from None
    except OSError as error:
        raise InputError("The camera file cannot be opened.", file=path, found=str(error)) from None
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        cells = [cell for cell in re.split(r"[,;\s]+", line.strip()) if cell]
        row = []
        for cell in cells:
            value = _number(cell)
            if not np.isfinite(value):
                raise InputError(
                    "The camera file has something else than a finite number.",
                    file=path,
                    key=f"line {number}",
                    expected=kind,
                    found=repr(cell[:40]),
                    remedy=remedy,
                )
            row.append(value)
        if row:
            rows.append(row)
    return rows


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
