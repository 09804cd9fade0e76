"""A matching on disk: tables, layouts of other programs, numbers and figures; a folder whole or absent."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acino_fte.data_tools import match_tables
from acino_fte.data_tools.match_numbers import match_metrics
from acino_fte.data_tools.match_points import SpacePoints, space_points
from acino_fte.errors import InputError
from acino_fte.result_files import Contents, written_whole

if TYPE_CHECKING:
    import pandas as pd

    from acino_fte.data_tools.track_matching import TrackMatches

MATCHING = Contents(
    "matching",
    (
        "observations.csv",
        "tracks_3d.csv",
        "matches.csv",
        "tracks_3d.nc",
        "xypts.csv",
        "xyzpts.csv",
        "metrics.json",
        "figures",
        "report.html",
    ),
    ("observations.csv", "metrics.json"),
)
"""What the folder of a matching holds."""

FORMATS = ("netcdf", "dltdv")
"""What is written beside the CSV tables."""

Tell = Callable[[str], None]


def save_matches(
    matches: TrackMatches,
    folder: Path,
    *,
    method: dict[str, Any] | None = None,
    seconds: dict[str, float] | None = None,
    formats: tuple[str, ...] = FORMATS,
    figures: bool = True,
    tell: Tell | None = None,
) -> dict[str, Any]:
    """Write a matching into a folder that :func:`acino_fte.result_files.check_output_folder` has passed.

    Parameters
    ----------
    matches : TrackMatches
        Of either method.
    folder : Path
        An earlier matching there is replaced.
    method : dict, optional
        ``method`` and ``options``, for the record.
    seconds : dict, optional
        Time of the steps so far, s; the writing is added to it.
    formats : tuple of str
        Some of :data:`FORMATS`.
    figures : bool
        Whether to draw figures and the report.
    tell : callable, optional
        Called with the name of every step.

    Returns
    -------
    dict
        What ``metrics.json`` holds.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    tell = tell or (lambda step: None)
    seconds = dict(seconds or {})
    begun = time.perf_counter()
    try:
        with written_whole(folder, MATCHING) as working:
            tell("tables")
            points = space_points(matches)
            metrics = match_metrics(matches, points, method or {"method": "tracks", "options": {}})
            _write_tables(matches, points, working, formats, metrics["warnings"])
            seconds["tables"] = time.perf_counter() - begun
            if figures:
                tell("figures")
                _draw(matches, points, working)
            seconds["figures"] = time.perf_counter() - begun - seconds["tables"]
            seconds["total"] = sum(seconds.values())
            metrics["seconds"] = {name: round(value, 4) for name, value in seconds.items()}
            if figures:
                _report(matches, points, metrics, working)
            text = json.dumps(metrics, indent=2, ensure_ascii=False, allow_nan=False)
            (working / "metrics.json").write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(
            "The matching cannot be written.",
            file=folder,
            found=error.strerror or str(error),
            remedy="free some space or choose another folder with -o, and run again",
        ) from None
    return metrics


def _write_tables(
    matches: TrackMatches, points: SpacePoints, folder: Path, formats: tuple[str, ...], warnings: list[str]
) -> None:
    observations = match_tables.observations_table(matches)
    observations["confidence"] = observations["confidence"].round(4)
    _write_csv(observations, folder / "observations.csv")
    tracks = match_tables.tracks_table(points).round({"reprojection_px": 3})
    _write_csv(tracks.round(6), folder / "tracks_3d.csv")
    _write_csv(match_tables.matches_table(matches).round(4), folder / "matches.csv")
    if not match_tables.fits_dense(matches):
        if formats:
            warnings.append(
                "The recording is too long and has too many animals for netCDF and DLTdv's tables."
            )
        return
    if "netcdf" in formats:
        dataset = match_tables.movement_dataset(matches, points)
        packed = {"zlib": True, "complevel": 1}
        encoding = {str(name): packed for name in dataset.data_vars if dataset[name].size}
        dataset.to_netcdf(folder / "tracks_3d.nc", engine="h5netcdf", encoding=encoding)
    if "dltdv" in formats and matches.n_groups:
        tables = {
            "xypts": match_tables.dltdv_xypts(matches),
            "xyzpts": match_tables.dltdv_xyzpts(matches, points),
        }
        for name, table in tables.items():
            _write_csv(table.round(3 if name == "xypts" else 6), folder / f"{name}.csv", missing="NaN")


def _write_csv(table: pd.DataFrame, path: Path, missing: str = "") -> None:
    """Write a table of numbers that are rounded already: formatting each takes ten times as long."""
    table.to_csv(path, index=False, lineterminator="\n", na_rep=missing)


def _draw(matches: TrackMatches, points: SpacePoints, folder: Path) -> None:
    from acino_fte.data_tools.plots_tracks import save_track_figures

    save_track_figures(matches, points, folder / "figures")


def _report(matches: TrackMatches, points: SpacePoints, metrics: dict[str, Any], folder: Path) -> None:
    from acino_fte.data_tools.match_page import write_match_page

    write_match_page(matches, points, metrics, folder)
