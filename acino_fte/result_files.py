"""A result on disk: a labelled dataset, tables, metrics, figures and a report, whole or not at all.

The files are written to a temporary folder ``.NAME.tmp-…`` beside the output folder, which takes the output
folder's name at the end. A run that fails or is killed on the way leaves the output folder as it was.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from secrets import token_hex
from typing import TYPE_CHECKING

import numpy as np
import yaml

from acino_fte.errors import InputError
from acino_fte.metrics import json_safe

if TYPE_CHECKING:
    import pandas as pd

    from acino_fte.result import FTEResult

FILES = (
    *("fte.nc", "positions.csv", "states.csv", "depth.csv", "metrics.json"),
    *("sequence.yaml", "figures", "report.html"),
)
"""What a result folder may hold; ``states.csv`` only with a skeleton, ``depth.csv`` only with a lidar."""
_ANOTHER = "choose another output folder with -o"


@dataclass(frozen=True)
class Contents:
    """What an output folder may hold: its name in messages, all files, and those by which it is known."""

    name: str
    files: tuple[str, ...]
    marks: tuple[str, ...]


RESULT = Contents("result", FILES, ("fte.nc", "metrics.json"))


def check_output_folder(
    out: Path | str, *, input_folder: Path | str | None = None, contents: Contents = RESULT
) -> Path:
    """Refuse an output folder before a long run rather than after it.

    Parameters
    ----------
    out : Path
        Where the result shall go. It may be absent, empty, or an earlier result, which will be replaced.
    input_folder : Path, optional
        The sequence (a folder, or a file in it), which is never written to.
    contents : Contents
        What it is going to hold; an earlier one of the same kind may be replaced.

    Returns
    -------
    Path
        The folder with symbolic links resolved.

    Raises
    ------
    InputError
        The folder holds something else, cannot be made, or would touch the input.
    """
    folder = Path(out).expanduser().resolve()
    if input_folder is not None:
        _check_apart(folder, Path(input_folder).expanduser().resolve())
    if folder.exists() and not folder.is_dir():
        raise InputError("The output is a file, not a folder.", file=folder, remedy=_ANOTHER)
    parent = next(p for p in folder.parents if p.exists())
    if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        raise InputError(
            "The output folder cannot be made.",
            file=folder,
            expected=f"a folder at {parent} in which you may write",
            found="a file" if not parent.is_dir() else "no permission to write",
            remedy=_ANOTHER,
        )
    if folder.is_dir():
        _check_ours(folder, contents)
    return folder


def _check_apart(folder: Path, source: Path) -> None:
    """The output may neither be, nor lie in, nor hold the input."""
    source = source.parent if source.is_file() else source
    relation = None
    if folder == source:
        relation = "is the input folder"
    elif source in folder.parents:
        relation = "lies inside the input folder"
    elif folder in source.parents and folder.exists():
        relation = "holds the input folder"
    if relation:
        raise InputError(
            f"The output folder {relation}, which is never written to.",
            file=folder,
            expected=f"a folder apart from {source}",
            remedy=_ANOTHER,
        )


def _check_ours(folder: Path, contents: Contents) -> None:
    """An existing folder may be empty or an earlier result with nothing added to it."""
    entries = sorted(p.name for p in folder.iterdir())
    if not entries:
        return
    foreign = [name for name in entries if name not in contents.files and not name.startswith(".")]
    ours = all((folder / name).is_file() for name in contents.marks)
    if not ours or foreign:
        listed = ", ".join((foreign or entries)[:5]) + (", …" if len(foreign or entries) > 5 else "")
        raise InputError(
            f"The output folder holds files that are not a {contents.name} of this program, "
            "and would be lost."
            if not ours
            else f"The output folder holds an earlier {contents.name} with other files added, "
            "which would be lost.",
            file=folder,
            expected=f"a new or empty folder, or an earlier {contents.name} (which is replaced)",
            found=listed,
            remedy=f"{_ANOTHER}, or move these files away",
        )


def save_result(
    result: FTEResult,
    out: Path | str,
    *,
    figures: bool = True,
    input_folder: Path | str | None = None,
) -> Path:
    """Write a result folder; it is whole or it is not there.

    Parameters
    ----------
    result : FTEResult
        In whatever status it is; the status is in every file that has room for it.
    out : Path
        See :func:`check_output_folder`. An earlier result is replaced once the new one is complete.
    figures : bool
        Whether to draw the figures; without them the report has only tables and the viewer.
    input_folder : Path, optional
        The sequence, which is never written to.

    Returns
    -------
    Path
        The folder: ``fte.nc``, ``positions.csv``, ``states.csv`` (from a method with a skeleton),
        ``metrics.json``, ``sequence.yaml``, ``figures/``, ``report.html``.

    Raises
    ------
    InputError
        The folder may not be written; see :func:`check_output_folder`.
    """
    folder = check_output_folder(out, input_folder=input_folder)
    with written_whole(folder, RESULT) as working:
        write_tables(result, working)
        if figures:
            from acino_fte.plots import save_figures

            save_figures(result, working / "figures")
        from acino_fte.report import write_report

        write_report(result, working)
    return folder


@contextmanager
def written_whole(folder: Path, contents: Contents) -> Iterator[Path]:
    """A working folder beside an output folder that was checked, which takes its name at the end.

    On an exception the output folder stays as it was.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    working = folder.with_name(f".{folder.name}.tmp-{token_hex(4)}")
    working.mkdir()
    try:
        yield working
        if folder.is_dir():  # something may have been put into it while the run lasted
            _check_ours(folder, contents)
        _swap(working, folder)
    finally:
        shutil.rmtree(working, ignore_errors=True)


def _swap(new: Path, folder: Path) -> None:
    """Give ``new`` the name ``folder``; the old folder is kept until then, and put back on failure."""
    if not folder.exists():
        new.rename(folder)
        return
    old = folder.with_name(f".{folder.name}.old-{token_hex(4)}")
    folder.rename(old)
    try:
        new.rename(folder)
    except BaseException:
        old.rename(folder)
        raise
    shutil.rmtree(old, ignore_errors=True)


def write_tables(result: FTEResult, folder: Path) -> None:
    """Write everything but figures and report into an existing folder."""
    from acino_fte.result_dataset import to_dataset

    dataset = to_dataset(result)
    packed = {"zlib": True, "complevel": 1}
    encoding = {str(name): packed for name, v in dataset.data_vars.items() if v.dtype.kind == "f"}
    dataset.to_netcdf(folder / "fte.nc", engine="h5netcdf", encoding=encoding)
    _write_positions(result, folder / "positions.csv")
    if result.q.shape[1]:
        _write_states(result, folder / "states.csv")
    if result.depth is not None:
        depth_table(result).to_csv(folder / "depth.csv", index=False, float_format="%.6f")
    text = json.dumps(result.metrics, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "metrics.json").write_text(text + "\n", encoding="utf-8")
    provenance = yaml.safe_dump(
        json_safe(result.sequence.provenance), sort_keys=False, allow_unicode=True, width=100
    )
    (folder / "sequence.yaml").write_text(provenance, encoding="utf-8")


def _write_positions(result: FTEResult, path: Path) -> None:
    """One row for a marker in a frame: see :func:`positions_table`."""
    positions_table(result).to_csv(path, index=False, float_format="%.6f")


def positions_table(result: FTEResult) -> pd.DataFrame:
    """Columns frame, time_s, marker, x, y, z (m, world frame); with covariance also sd_x, sd_y, sd_z (m).

    A marker that has no position has a row with empty cells.
    """
    import pandas as pd

    frames = np.asarray(result.sequence.frames)
    n_frames, n_markers = result.positions.shape[:2]
    columns = {
        "frame": np.repeat(frames, n_markers),
        "time_s": np.repeat(frames / result.sequence.fps, n_markers),
        "marker": np.tile(result.skeleton.marker_names, n_frames),
        **{axis: result.positions[..., i].ravel() for i, axis in enumerate("xyz")},
    }
    if result.position_covariance is not None:
        variance = np.diagonal(result.position_covariance, axis1=-2, axis2=-1)
        sd = np.sqrt(np.maximum(variance, 0.0))
        columns |= {f"sd_{axis}": sd[..., i].ravel() for i, axis in enumerate("xyz")}
    return pd.DataFrame(columns)


def depth_table(result: FTEResult) -> pd.DataFrame:
    """Columns frame, time_s, marker, measured, predicted, sd (m, along the camera's axis) and returns."""
    import pandas as pd

    depth = result.depth
    assert depth is not None
    frames = np.asarray(result.sequence.frames)[depth.frame]
    return pd.DataFrame(
        {
            "frame": frames,
            "time_s": frames / result.sequence.fps,
            "marker": np.array(result.skeleton.marker_names)[depth.marker],
            "measured": depth.measured,
            "predicted": depth.predicted,
            "sd": depth.sd,
            "returns": depth.count,
        }
    )


def _write_states(result: FTEResult, path: Path) -> None:
    """Columns frame, time_s and every degree of freedom (m, rad), one row for a frame."""
    import pandas as pd

    frames = np.asarray(result.sequence.frames)
    table = pd.DataFrame(result.q, columns=result.skeleton.dof_names)
    table.insert(0, "frame", frames)
    table.insert(1, "time_s", frames / result.sequence.fps)
    table.to_csv(path, index=False, float_format="%.9g")
