"""Point clouds, and PLY files in and out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.similarity import Similarity

_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_RESERVED = ("x", "y", "z", "red", "green", "blue")


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of a scene. Q points.

    Attributes
    ----------
    xyz : (Q, 3)
        World.
    rgb : (Q, 3) uint8, optional
        Colours.
    error : (Q,), optional
        Mean reprojection error of each point, px; NaN where the model does not say it.
    n_dropped : int
        Rows of the file that were left out because their position is not finite.
    """

    xyz: np.ndarray
    rgb: np.ndarray | None = None
    error: np.ndarray | None = None
    n_dropped: int = 0

    def __len__(self) -> int:
        return len(self.xyz)

    def moved(self, change: Similarity) -> PointCloud:
        """The same points in another world."""
        return replace(self, xyz=change.points(self.xyz))


def read_ply(path: Path | str) -> PointCloud:
    """Read the vertices of a PLY file, ascii or binary; a mesh gives its corners.

    Parameters
    ----------
    path : Path
        As COLMAP, MeshLab, CloudCompare, Open3D or :func:`write_ply` write it.

    Returns
    -------
    PointCloud
        Colours, when the file has them; normals and other properties are not read.

    Raises
    ------
    InputError
        There is no such file, it is no PLY, it is broken, or it has no vertices.
    """
    path = Path(path)
    vertices = _vertices(path)
    names = vertices.dtype.names or ()
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise InputError(
            "The vertices have no positions.",
            file=path,
            expected="properties x, y, z",
            found=", ".join(names) or "none",
        )
    try:
        xyz = np.stack([vertices[axis].astype(float) for axis in "xyz"], axis=1)
    except (TypeError, ValueError) as error:
        raise InputError(
            "The positions are not numbers.", file=path, expected="one number each", found=str(error)
        ) from error
    rgb = _colours(vertices, names)
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.any():
        raise InputError(
            "The point cloud is empty.",
            file=path,
            expected="vertices with finite positions",
            found=f"{len(xyz)} vertices, none of them finite",
            remedy="export the points themselves, not only faces or lines",
        )
    return PointCloud(xyz[finite], None if rgb is None else rgb[finite], n_dropped=int((~finite).sum()))


def _vertices(path: Path) -> np.ndarray:
    """The table of vertices, structured."""
    from plyfile import PlyData, PlyParseError

    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError("There is no such point cloud.", file=path, expected="a PLY file", found=found)
    try:
        elements = {element.name: element for element in PlyData.read(path).elements}
    except (PlyParseError, ValueError, OSError, MemoryError, EOFError, UnicodeDecodeError) as error:
        raise InputError(
            "The file cannot be read as PLY.",
            file=path,
            expected="a whole PLY file, ascii or binary",
            found=str(error) or type(error).__name__,
            remedy="export it again, or check the name",
        ) from error
    if "vertex" not in elements:
        raise InputError(
            "The file has no vertices.",
            file=path,
            expected="an element 'vertex'",
            found=", ".join(elements) or "nothing",
            remedy="export the points themselves",
        )
    return elements["vertex"].data


def _colours(vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray | None:
    """Colours (Q, 3) uint8; colours that are fractions of 1 are scaled."""
    for triple in _COLOURS:
        if all(name in names for name in triple):
            rgb = np.stack([vertices[name] for name in triple], axis=1)
            if rgb.dtype.kind == "f":
                rgb = np.round(255 * np.nan_to_num(rgb))
            elif rgb.dtype.itemsize > 1 and rgb.max(initial=0) > 255:
                rgb = rgb // 257
            return np.clip(rgb, 0, 255).astype(np.uint8)
    return None


def write_ply(
    path: Path | str,
    xyz: np.ndarray,
    rgb: np.ndarray | None = None,
    extra: Mapping[str, np.ndarray] | None = None,
    edges: np.ndarray | None = None,
) -> None:
    """Write points as binary PLY (little-endian): float positions, uchar colours.

    Parameters
    ----------
    path : Path
        The file; it is replaced.
    xyz : (Q, 3)
        Positions.
    rgb : (Q, 3) uint8, optional
        Colours.
    extra : mapping of str to (Q,), optional
        Further properties of each point: floats are written as float, integers as int.
    edges : (E, 2) int, optional
        Lines between points, as element ``edge`` with ``vertex1`` and ``vertex2``.

    Raises
    ------
    InputError
        The shapes do not fit, a name is taken, or the file cannot be written.
    """
    from plyfile import PlyData, PlyElement

    columns = _columns(np.asarray(xyz), rgb, extra or {})
    elements = [PlyElement.describe(_table(columns), "vertex")]
    if edges is not None:
        edges = np.asarray(edges).reshape(-1, 2)
        if len(edges) and (edges.min() < 0 or edges.max() >= len(xyz)):
            raise InputError(
                "The edges do not fit the points.",
                file=path,
                expected=f"indices from 0 to {len(xyz) - 1}",
                found=f"{edges.min()} to {edges.max()}",
            )
        ends = {"vertex1": edges[:, 0].astype("<i4"), "vertex2": edges[:, 1].astype("<i4")}
        elements.append(PlyElement.describe(_table(ends), "edge"))
    try:
        PlyData(elements, text=False, byte_order="<").write(str(path))
    except OSError as error:
        raise InputError("The file cannot be written.", file=path, found=str(error)) from error


def _columns(
    xyz: np.ndarray, rgb: np.ndarray | None, extra: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The properties of the vertices, in the types of the file."""
    n = len(xyz)
    columns = {axis: xyz[:, i].astype("<f4") for i, axis in enumerate("xyz")}
    if rgb is not None:
        rgb = np.asarray(rgb)
        _same_length("rgb", rgb.shape, (n, 3))
        columns.update({name: rgb[:, i].astype("u1") for i, name in enumerate(_COLOURS[0])})
    for name, values in extra.items():
        values = np.asarray(values)
        _same_length(name, values.shape, (n,))
        if name in _RESERVED or not name.isidentifier():
            raise InputError(f"A property of a PLY file cannot be called '{name}'.", remedy="rename it")
        columns[name] = values.astype("<i4" if values.dtype.kind in "iub" else "<f4")
    return columns


def _same_length(name: str, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        raise InputError(
            f"'{name}' does not fit the points.", expected=f"shape {expected}", found=f"shape {found}"
        )


def _table(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """One structured array of columns of one length."""
    length = len(next(iter(columns.values())))
    table = np.empty(length, dtype=[(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return table
