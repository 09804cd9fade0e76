"""What single-camera trackers write: TRex, idtracker.ai and SLEAP, one dot for each individual and frame.

Pixels of all three have y from the top. Layouts, by their own documentation and sources:

- **TRex** (trex.run/docs/formats.html): a file for each individual, ``VIDEO_id0.npz`` or ``.csv``, with
  ``frame`` and, for several points of the body, ``X#wcentroid``, ``Y#wcentroid`` and the like; ``missing`` is
  1 where the individual was not found, and values that are not known are infinite. Positions are in cm:
  pixels are cm / cm_per_pixel.
- **idtracker.ai** (idtracker.ai, "Trajectory files", and ``convert``/``trajectories`` of its sources):
  ``trajectories`` (F, A, 2) px, NaN where missing, in ``.npy`` (a pickled dictionary), in ``.h5``, or in a
  CSV with columns time (or seconds), x1, y1, x2, y2, …
- **SLEAP** (docs of ``sleap-convert --format analysis``): HDF5 with ``tracks`` (A, 2, nodes, F),
  ``node_names`` and ``track_names``; or CSV with track, frame_idx and ``NODE.x``, ``NODE.y``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.safe_pickle import load_data_pickle
from acino_fte.data_tools.track_files import tracks_from_columns, tracks_from_grid
from acino_fte.data_tools.track_table import frames, numbers, read_all, read_header, read_wide
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError, did_you_mean

_TREX_POINTS = ("#wcentroid", "#centroid", "#pcentroid", "", "#head")
_TREX_OTHERS = re.compile(r"_(posture|heatmap|tracklet_images|visual_field|statistics|recognition)", re.I)
_IDTRACKER_NAMES = ("trajectories", "validated", "without_gaps", "with_gaps", "trajectories_wo_gaps")
_BROKEN = (RuntimeError, ValueError, TypeError, AttributeError, MemoryError)  # as readers of cut files end
_IDTRACKER_XY = re.compile(r"([xy])(\d+)", re.I)


def exporter(path: Path) -> str | None:
    """Which tracker wrote a file: "trex", "idtracker" or "sleap"; None when it is of none of them."""
    ending = path.suffix.lower()
    if ending == ".npz":
        return None if _TREX_OTHERS.search(path.stem) else "trex"
    if ending == ".npy":
        return "idtracker"
    try:
        if ending in (".h5", ".hdf5"):
            with _hdf5(path) as file:
                return "sleap" if "node_names" in file else "idtracker" if "trajectories" in file else None
        if ending in (".csv", ".tsv", ".txt"):
            return _csv_exporter(read_header(path)[0])
    except InputError:
        return None
    return None


def _csv_exporter(header: Sequence[str]) -> str | None:
    lower = {name.lower() for name in header}
    if any(re.fullmatch(r"x#\w+", name) for name in lower) or {"frame", "x", "y", "missing"} <= lower:
        return "trex"
    if {"x1", "y1"} <= lower and not {"x", "y"} <= lower:
        return "idtracker"
    return "sleap" if "frame_idx" in lower and any(name.endswith(".x") for name in lower) else None


def session_file(folder: Path) -> Path | None:
    """The trajectories in a session folder of idtracker.ai; None when there are none."""
    places = (folder / "trajectories", folder)
    for place, name in ((p, n) for p in places for n in _IDTRACKER_NAMES):
        for file in (f"{name}.h5", f"{name}.npy", f"{name}_csv/trajectories.csv"):
            if (place / file).is_file():
                return place / file
    return None


def read_trex(
    paths: Sequence[Path | str],
    camera: str,
    *,
    cm_per_pixel: float | None = None,
    point: str | None = None,
) -> Tracks2D:
    """Read the individuals that TRex found in the video of one camera.

    Parameters
    ----------
    paths : sequence of Path
        A file for each individual, ``.npz`` or ``.csv``. A track is called as the end of its file's name:
        ``id0``.
    camera : str
        Name of the camera.
    cm_per_pixel : float, optional
        TRex's setting of that name at the export; 1 when the positions are pixels already. By default what
        the files say.
    point : str, optional
        Which point of the body: ``wcentroid``, ``centroid``, ``pcentroid`` or ``head``; by default the first
        of these that the file has.

    Returns
    -------
    Tracks2D
        Without the rows that are missing or interpolated.

    Raises
    ------
    InputError
        A column is missing, or nothing says how large a pixel is.
    """
    parts = [_trex_individual(Path(path), cm_per_pixel, point) for path in paths]
    names = _different([re.sub(r"^.*_(?=[^_]*$)", "", Path(path).stem) for path in paths], paths)
    return tracks_from_columns(
        camera,
        np.concatenate([frame for frame, _ in parts]),
        np.repeat(np.array(names, dtype=object), [len(frame) for frame, _ in parts]),
        np.concatenate([xy for _, xy in parts]),
        path=Path(paths[0]),
    )


def read_idtracker(path: Path | str, camera: str) -> Tracks2D:
    """Read trajectories of idtracker.ai: ``.npy``, ``.h5``, or the CSV of its export.

    The tracks are called as the user labelled the identities, else 1, 2, …. A pickle is read so that it
    cannot run code.

    Raises
    ------
    InputError
        The file holds no trajectories of F frames, A animals and 2 coordinates.
    """
    path = Path(path)
    names: Any = None
    if path.suffix.lower() == ".npy":
        xy, names = _idtracker_pickle(path)
    elif path.suffix.lower() in (".h5", ".hdf5"):
        with _hdf5(path) as file:
            if "trajectories" not in file:
                raise _no_trajectories(path, ", ".join(file) or "nothing")
            xy = file["trajectories"][()]
            names = file.attrs.get("identities_labels", file.get("identities_labels"))
            names = None if names is None else [_text(name) for name in names]
    else:
        xy = _idtracker_table(path)
    xy = np.asarray(xy)
    if xy.ndim != 3 or xy.shape[2] != 2 or not np.issubdtype(xy.dtype, np.number):
        raise _no_trajectories(path, f"an array {xy.shape} of {xy.dtype}")
    if names is None or len(names) != xy.shape[1]:
        names = range(1, xy.shape[1] + 1)
    return tracks_from_grid(camera, xy, [str(name) for name in names], path=path)


def read_sleap(path: Path | str, camera: str, *, node: str | None = None) -> Tracks2D:
    """Read an analysis file of SLEAP, HDF5 or CSV.

    Parameters
    ----------
    path : Path
        The file of one video.
    camera : str
        Name of the camera.
    node : str, optional
        The node that stands for the animal; by default the mean of the nodes that were found, which moves
        when a node is lost: a node that is always found is better.

    Raises
    ------
    InputError
        The file is no analysis file, or it has no such node.
    """
    path = Path(path)
    if path.suffix.lower() not in (".h5", ".hdf5"):
        return _sleap_table(path, camera, node)
    with _hdf5(path) as file:
        for key in ("tracks", "node_names"):
            if key not in file:
                raise _no_sleap(path, f"no '{key}' among {', '.join(file) or 'nothing'}")
        tracks = file["tracks"][()]
        nodes = [_text(name) for name in file["node_names"][()]]
        names = [_text(name) for name in file["track_names"][()]] if "track_names" in file else []
    if tracks.ndim != 4 or tracks.shape[1] != 2 or tracks.shape[2] != len(nodes):
        raise _no_sleap(path, f"tracks {tracks.shape} and {len(nodes)} nodes")
    if len(names) != len(tracks):
        names = [f"track_{i}" for i in range(len(tracks))]
    xy = _one_node(tracks.transpose(3, 0, 2, 1), nodes, node, path)
    return tracks_from_grid(camera, xy, names, path=path)


def _trex_individual(
    path: Path, cm_per_pixel: float | None, point: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """Frames (P,) and pixels (P, 2) of one file, without what is missing."""
    import pandas as pd

    columns = _npz_columns(path) if path.suffix.lower() == ".npz" else _csv_columns(path)
    choice = _TREX_POINTS if point is None else (f"#{point}", *([""] if point == "head" else []))
    at = next((c for c in choice if {f"X{c}", f"Y{c}"} <= set(columns)), None)
    if at is None or "frame" not in columns:
        wanted = "frame" if at is not None else " or ".join(f"X{c}" for c in choice)
        raise InputError(
            "This is no individual that TRex exported.",
            file=path,
            expected=f"{wanted} (and Y)",
            found=", ".join(columns)[:200],
            remedy="export the position and the frame with TRex (output_fields)",
        )
    if cm_per_pixel is None and "cm_per_pixel" in columns:
        cm_per_pixel = float(np.ravel(columns["cm_per_pixel"])[0])
    if cm_per_pixel is None or not (np.isfinite(cm_per_pixel) and cm_per_pixel > 0):
        raise InputError(
            "How large a pixel of TRex's export is cannot be told: its positions are in cm.",
            file=path,
            key="cm_per_pixel",
            expected="> 0",
            found="nothing" if cm_per_pixel is None else f"{cm_per_pixel:g}",
            remedy="give cm_per_pixel as it was set in TRex; 1 if the positions are pixels already",
        )
    frame = frames(pd.Series(np.ravel(columns["frame"])), path)
    xy = np.stack([np.ravel(columns[f"{axis}{at}"]) for axis in "XY"], axis=1).astype(float) / cm_per_pixel
    if len(frame) != len(xy):
        raise InputError(
            "The columns of TRex's export differ in length.",
            file=path,
            expected=f"{len(frame)} rows, as many as frame has",
            found=f"{len(xy)}",
        )
    known = np.isfinite(xy).all(1)
    if "missing" in columns:
        known &= np.ravel(columns["missing"]) == 0
    return frame[known], xy[known]


def _npz_columns(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz``; pickled ones are passed over."""
    import zipfile
    import zlib

    if not path.is_file():
        raise InputError("The file does not exist.", file=path, remedy="check the path")
    columns = {}
    try:
        with np.load(path, allow_pickle=False) as file:
            for name in file.files:
                if name in ("frame", "missing", "cm_per_pixel") or re.fullmatch(r"[XY](#\w+)?", name):
                    columns[name] = file[name]
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error, *_BROKEN) as error:
        raise InputError(
            "The file cannot be read as NumPy arrays.",
            file=path,
            expected=".npz as TRex writes it, of numbers only",
            found=str(error),
            remedy="export the tracks again",
        ) from None
    return columns


def _csv_columns(path: Path) -> dict[str, np.ndarray]:
    """The columns of TRex's CSV; a unit behind a name, as in ``X (cm)``, is left off."""
    names, values = read_wide(path, infinite=True)
    return {re.sub(r"\s*\(.*\)$", "", name): values[:, i] for i, name in enumerate(names)}


def _different(names: list[str], paths: Sequence[Path | str]) -> list[str]:
    """Names of tracks: whole names of files where their ends are not different."""
    return names if len(set(names)) == len(names) else [Path(path).stem for path in paths]


def _idtracker_pickle(path: Path) -> tuple[Any, Any]:
    """Trajectories and labels of a pickled dictionary inside ``.npy``, or a bare array."""
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0
            if version != (1, 0):
                read = np.lib.format.read_array_header_2_0
            _, _, kind = read(file)
            if not kind.hasobject:
                return np.load(path, allow_pickle=False), None
            data = load_data_pickle(file.read(), file=path)
    except FileNotFoundError:
        raise InputError("The file does not exist.", file=path, remedy="check the path") from None
    except (OSError, EOFError, *_BROKEN) as error:
        raise _no_trajectories(path, str(error)) from None
    data = data.item() if isinstance(data, np.ndarray) and data.shape == () else data
    if not isinstance(data, dict) or "trajectories" not in data:
        found = ", ".join(map(str, data)) if isinstance(data, dict) else type(data).__name__
        raise _no_trajectories(path, found[:200])
    return data["trajectories"], data.get("identities_labels")


def _idtracker_table(path: Path) -> np.ndarray:
    names, values = read_wide(path)
    places = {name.lower(): i for i, name in enumerate(names)}
    found = [m for name in places if (m := _IDTRACKER_XY.fullmatch(name))]
    n = max((int(m[2]) for m in found), default=0)
    wanted = [f"{axis}{i}" for i in range(1, min(n, len(names)) + 1) for axis in "xy"]
    if not wanted or len(wanted) != 2 * n or not set(wanted) <= set(places):
        raise _no_trajectories(path, ", ".join(names)[:200])
    return values[:, [places[name] for name in wanted]].reshape(len(values), n, 2)


def _sleap_table(path: Path, camera: str, node: str | None) -> Tracks2D:
    header = read_header(path)[0]
    nodes = [name[:-2] for name in header if name.endswith(".x") and f"{name[:-2]}.y" in header]
    if not nodes:
        raise _no_sleap(path, ", ".join(header)[:200])
    table = read_all(path)
    for key in ("track", "frame_idx"):
        if key not in table:
            raise _no_sleap(path, ", ".join(header)[:200])
    columns = [numbers(table[f"{name}.{axis}"], f"{name}.{axis}", path) for name in nodes for axis in "xy"]
    xy = np.stack(columns, axis=1).reshape(len(table), len(nodes), 2)
    frame = frames(table["frame_idx"], path, "frame_idx")
    return tracks_from_columns(camera, frame, table["track"], _one_node(xy, nodes, node, path), path=path)


def _one_node(xy: np.ndarray, nodes: Sequence[str], node: str | None, path: Path) -> np.ndarray:
    """(…, 2) from (…, nodes, 2): one node, or the mean of those that were found."""
    if node is not None:
        if node not in nodes:
            raise InputError(
                f"SLEAP's file has no node '{node}'{did_you_mean(node, nodes) or '.'}",
                file=path,
                key="node",
                expected=", ".join(nodes),
                found=node,
            )
        return xy[..., nodes.index(node), :]
    seen = np.isfinite(xy).all(-1)
    total = np.where(seen[..., None], xy, 0.0).sum(-2)
    with np.errstate(invalid="ignore"):
        return total / np.where(seen.any(-1), seen.sum(-1), np.nan)[..., None]


@contextmanager
def _hdf5(path: Path) -> Iterator[Any]:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, KeyError, *_BROKEN) as error:
        raise InputError(
            "The file cannot be read as HDF5.",
            file=path,
            found=str(error)[:200],
            remedy="check the path, or export the tracks again",
        ) from None


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _no_trajectories(path: Path, found: str) -> InputError:
    return InputError(
        "The file holds no trajectories of idtracker.ai.",
        file=path,
        expected="trajectories of shape (frames, animals, 2), or columns x1, y1, x2, y2, …",
        found=found,
        remedy="pass trajectories.npy, trajectories.h5 or trajectories.csv of the session",
    )


def _no_sleap(path: Path, found: str) -> InputError:
    return InputError(
        "The file is no analysis of SLEAP.",
        file=path,
        expected="tracks (A, 2, nodes, F) and node_names, or columns track, frame_idx, NODE.x, NODE.y",
        found=found,
        remedy="export it again: sleap-convert --format analysis",
    )
