"""Point clouds of a lidar in files of their own: PCD, PLY, KITTI's .bin, NumPy's arrays, tables of text.

Of a cut or damaged file every whole point is read, and what was lost is counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acino_fte.data_tools.clouds_files import read_bin, read_numpy, read_table
from acino_fte.data_tools.clouds_pcd import read_pcd, write_pcd
from acino_fte.data_tools.clouds_ply import read_ply_columns, write_ply_columns
from acino_fte.data_tools.clouds_tables import Columns, read_bytes, written_whole
from acino_fte.errors import InputError

_INTENSITY = ("intensity", "reflectivity", "reflectance", "scalar_intensity", "scalar_reflectivity", "i")
_TIME = ("time", "timestamp", "time_ns", "offset_time", "gps_time", "gpstime", "t", "scalar_gpstime")
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_READERS = {
    ".pcd": read_pcd,
    ".ply": read_ply_columns,
    ".bin": read_bin,
    ".npy": read_numpy,
    ".npz": read_numpy,
    ".csv": read_table,
    ".txt": read_table,
    ".xyz": read_table,
    ".asc": read_table,
}


@dataclass(frozen=True, eq=False)
class LidarCloud:
    """Points of a lidar. K points.

    Attributes
    ----------
    xyz : (K, 3)
        m, frame of the file: usually the lidar's.
    intensity : (K,), optional
        As the file has it: 0–255 of a Livox, 0–1 of KITTI.
    rgb : (K, 3) uint8, optional
    time : (K,), optional
        s. Whole numbers in a file are taken as ns, others as s.
    n_dropped : int
        Points that were left out because their position is not finite.
    n_lost : int
        Points that the file ought to have and does not, or that are damaged.
    notes : tuple of str
        What else is odd, one sentence each.
    """

    xyz: np.ndarray
    intensity: np.ndarray | None = None
    rgb: np.ndarray | None = None
    time: np.ndarray | None = None
    n_dropped: int = 0
    n_lost: int = 0
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.xyz)


def read_cloud(path: Path | str) -> LidarCloud:
    """Read a point cloud; what the file begins with and its ending say how.

    Parameters
    ----------
    path : Path
        ``.pcd`` (ascii, binary, binary_compressed), ``.ply`` (ascii, binary), ``.bin`` (KITTI: float32 x, y,
        z, reflectance), ``.npy``, ``.npz``, or text (``.csv``, ``.txt``, ``.xyz``) with names in line 1.

    Raises
    ------
    InputError
        There is no such file, it is of no known kind, it has no positions, or not one point of it is whole.
    """
    path = Path(path)
    data = read_bytes(path)
    columns = _reader(data, path)(data, path)
    return _cloud(columns, path)


def _reader(data: bytes, path: Path) -> Callable[[bytes, Path], Columns]:
    """Who reads the file: by its first bytes, and where they say nothing, by its ending."""
    if data.startswith((b"ply\n", b"ply\r")):
        return read_ply_columns
    if data.startswith((b"\x93NUMPY", b"PK\x03\x04")):
        return read_numpy
    start = data[:200].lstrip()
    if start.startswith((b"# .PCD", b"VERSION ", b"FIELDS ")):
        return read_pcd
    if path.suffix.lower() in _READERS:
        return _READERS[path.suffix.lower()]
    raise InputError(
        "The file is no point cloud of a known kind.",
        file=path,
        expected=", ".join(_READERS),
        found=repr(data[:16])[1:],
        remedy="name it by its format; recordings (.lvx, .bag) are imported, not read as one cloud",
    )


def _cloud(columns: Columns, path: Path) -> LidarCloud:
    """Columns by their names to a cloud; points without a finite position are left out."""
    values = {name.lower(): column for name, column in columns.values.items()}
    missing = [axis for axis in "xyz" if axis not in values]
    if missing:
        raise InputError(
            "The point cloud has no positions.",
            file=path,
            expected="fields x, y, z",
            found=", ".join(values) or "none",
            remedy="export the positions",
        )
    xyz = np.stack([values[axis].astype(float) for axis in "xyz"], axis=1)
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.any():
        lost = f", {columns.n_lost} of them lost" if columns.n_lost else ""
        raise InputError(
            "The point cloud has no points.",
            file=path,
            expected="points with finite positions",
            found=f"{len(xyz) + columns.n_lost} points{lost}, not one finite",
            remedy="the file is cut or damaged: export it again",
        )
    intensity = next((values[name] for name in _INTENSITY if name in values), None)
    rgb, time = _rgb(values), _time(values)
    return LidarCloud(
        xyz[finite],
        None if intensity is None else intensity.astype(float)[finite],
        None if rgb is None else rgb[finite],
        None if time is None else time[finite],
        n_dropped=int((~finite).sum()),
        n_lost=columns.n_lost,
        notes=tuple(columns.notes),
    )


def _time(values: dict[str, np.ndarray]) -> np.ndarray | None:
    """Times, s: whole numbers and numbers beyond 1e14 are ns."""
    column = next((values[name] for name in _TIME if name in values), None)
    if column is None:
        return None
    ns = column.dtype.kind in "iu" or np.nanmax(np.abs(column), initial=0) > 1e14
    return column.astype(float) * 1e-9 if ns else column.astype(float)


def _rgb(values: dict[str, np.ndarray]) -> np.ndarray | None:
    """Colours (K, 3): three columns, or PCL's one of packed bytes 0xAARRGGBB."""
    for name in ("rgb", "rgba"):
        packed = values.get(name)
        if packed is not None and packed.dtype.itemsize == 4:
            bits = np.ascontiguousarray(packed).view("<u4")
            return np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8)
    for triple in _COLOURS:
        if all(name in values for name in triple):
            rgb = np.stack([values[name] for name in triple], axis=1)
            if rgb.dtype.kind == "f" and np.nanmax(rgb, initial=0) <= 1.0:
                rgb = np.round(255 * np.nan_to_num(rgb))
            elif rgb.dtype.itemsize > 1 and rgb.dtype.kind in "iu" and rgb.max(initial=0) > 255:
                rgb = rgb // 257
            return np.clip(np.nan_to_num(rgb), 0, 255).astype(np.uint8)
    return None


def write_cloud(path: Path | str, cloud: LidarCloud, *, encoding: str = "binary") -> None:
    """Write a point cloud as PCD or PLY, by the ending; the file appears whole or not at all.

    Parameters
    ----------
    path : Path
        ``.pcd`` or ``.ply``; it is replaced.
    cloud : LidarCloud
        Anything with `xyz` (K, 3), and `intensity`, `rgb`, `time` if it has them.
    encoding : {"binary", "ascii", "binary_compressed"}
        The last one for PCD only. Positions and intensities are float32, times float64.

    Raises
    ------
    InputError
        Another ending or encoding, lengths that differ, or a place that cannot be written.
    """
    path = Path(path)
    columns = _columns(cloud)
    suffix = path.suffix.lower()
    allowed = ("binary", "ascii", "binary_compressed") if suffix == ".pcd" else ("binary", "ascii")
    if suffix not in (".pcd", ".ply") or encoding not in allowed:
        raise InputError(
            "Point clouds cannot be written so.",
            file=path,
            expected=".pcd (binary, ascii, binary_compressed) or .ply (binary, ascii)",
            found=f"'{suffix}', {encoding}",
            remedy="choose another ending or encoding",
        )
    with written_whole(path) as file:
        if suffix == ".ply":
            write_ply_columns(file, columns, encoding == "ascii")
        else:
            write_pcd(file, _packed(columns), encoding)


def _columns(cloud: LidarCloud) -> dict[str, np.ndarray]:
    xyz = np.asarray(cloud.xyz)
    columns = {axis: xyz[:, i].astype("<f4") for i, axis in enumerate("xyz")}
    for name, kind in (("intensity", "<f4"), ("time", "<f8")):
        values = getattr(cloud, name, None)
        if values is not None:
            columns[name] = np.asarray(values).astype(kind)
    rgb = getattr(cloud, "rgb", None)
    if rgb is not None:
        columns |= {name: np.asarray(rgb)[:, i].astype("u1") for i, name in enumerate(_COLOURS[0])}
    lengths = {name: column.shape for name, column in columns.items()}
    if set(lengths.values()) != {(len(xyz),)}:
        raise InputError("The columns of the cloud differ in length.", found=str(lengths))
    return columns


def _packed(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Colours as PCL has them: one uint32 0xAARRGGBB."""
    out = {name: column for name, column in columns.items() if name not in _COLOURS[0]}
    if "red" in columns:
        red, green, blue = (columns[name].astype("<u4") for name in _COLOURS[0])
        out["rgba"] = np.uint32(0xFF000000) | red << 16 | green << 8 | blue
    return out


def read_returns(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Positions (K, 3), m, and intensities (K,) of a point cloud; zeros where it has none.

    Raises
    ------
    InputError
        As :func:`read_cloud` does.
    """
    cloud = read_cloud(path)
    return cloud.xyz, np.zeros(len(cloud)) if cloud.intensity is None else cloud.intensity
