"""A triangulated scene on disk: tables, layouts of other programs, numbers and figures; whole or absent."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acino_fte.data_tools.scene_drawing import FigureProcess, scene_drawing
from acino_fte.data_tools.scene_numbers import scene_metrics
from acino_fte.data_tools.scene_tables import length_decimals, observations_text, paths_text, tracks_text
from acino_fte.errors import InputError
from acino_fte.result_files import Contents, written_whole

if TYPE_CHECKING:
    from acino_fte.data_tools.scene import SceneResult
    from acino_fte.data_tools.scene_truth import SceneTruth

SCENE = Contents(
    "scene",
    (
        "tracks_3d.csv",
        "points_3d.csv",
        "observations.csv",
        "camera_paths.csv",
        "tracks_3d.nc",
        "tracks_3d.ply",
        "cloud.ply",
        "metrics.json",
        "figures",
        "report.html",
    ),
    ("tracks_3d.csv", "camera_paths.csv", "metrics.json"),
)
"""What the folder of a scene holds."""

FORMATS = ("netcdf", "ply")
"""What is written beside the CSV tables."""

Tell = Callable[[str], None]


def save_scene(
    result: SceneResult,
    folder: Path,
    *,
    options: dict[str, Any] | None = None,
    truth: SceneTruth | None = None,
    seconds: dict[str, float] | None = None,
    formats: tuple[str, ...] = FORMATS,
    figures: FigureProcess | bool = True,
    tell: Tell | None = None,
) -> dict[str, Any]:
    """Write a scene into a folder that :func:`acino_fte.result_files.check_output_folder` has passed.

    Parameters
    ----------
    result : SceneResult
        Of :meth:`Scene.triangulate <acino_fte.data_tools.scene.Scene.triangulate>`, also without any point.
    folder : Path
        An earlier scene there is replaced.
    options : dict, optional
        How it was made, for the record.
    truth : SceneTruth, optional
        True positions, for scoring.
    seconds : dict, optional
        Time of the steps so far, s; the writing is added to it.
    formats : tuple of str
        Some of :data:`FORMATS`.
    figures : bool or FigureProcess
        Whether to draw figures and the report; a process that was started before draws sooner.
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
    clock = _Steps(dict(seconds or {}))
    try:
        with ExitStack() as stack:
            working = stack.enter_context(written_whole(folder, SCENE))
            artist = figures if isinstance(figures, FigureProcess) else None
            if figures is True:
                artist = stack.enter_context(FigureProcess())
            if artist is not None:
                artist.draw(scene_drawing(result), working / "figures")
            tell("tables")
            metrics = scene_metrics(result, options, truth)
            _write_tables(result, working, formats, metrics["warnings"])
            clock.end("tables")
            if artist is not None:
                tell("figures")
                artist.wait()
                clock.end("figures")
            metrics["seconds"] = clock.rounded()
            if artist is not None:
                from acino_fte.data_tools.scene_page import write_scene_page

                write_scene_page(result, metrics, working)
            text = json.dumps(metrics, indent=2, ensure_ascii=False, allow_nan=False)
            (working / "metrics.json").write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(
            "The scene cannot be written.",
            file=folder,
            found=error.strerror or str(error),
            remedy="free some space or choose another folder with -o, and run again",
        ) from None
    return metrics


class _Steps:
    """Seconds of the steps of writing, after those that are given."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self._seconds, self._begun = seconds, time.perf_counter()

    def end(self, name: str) -> None:
        """The step under way ends, and the next begins."""
        now = time.perf_counter()
        self._seconds[name], self._begun = now - self._begun, now

    def rounded(self) -> dict[str, float]:
        """All steps and their total."""
        total = {"total": sum(self._seconds.values())}
        return {name: round(value, 4) for name, value in (self._seconds | total).items()}


def _write_tables(result: SceneResult, folder: Path, formats: tuple[str, ...], warnings: list[str]) -> None:
    tracks = result.tracks
    places = length_decimals(tracks.position)
    texts = {"tracks_3d": tracks_text(tracks, places)}
    if tracks.smooth:
        texts["points_3d"] = tracks_text(result.points, places)
    texts["observations"] = observations_text(result)
    texts["camera_paths"] = paths_text(result, places)
    for name, text in texts.items():
        (folder / f"{name}.csv").write_bytes(text)
    if formats:
        _write_layouts(result, folder, formats, warnings)


def _write_layouts(result: SceneResult, folder: Path, formats: tuple[str, ...], warnings: list[str]) -> None:
    from acino_fte.data_tools.scene_layouts import (
        fits_dense,
        write_cloud_ply,
        write_movement,
        write_tracks_ply,
    )

    if "netcdf" in formats:
        if fits_dense(result.tracks):
            metric = bool(result.numbers.get("scale"))
            write_movement(result.tracks, folder / "tracks_3d.nc", result.scene.fps, metric)
        else:
            warnings.append("The recording is too long and has too many individuals for netCDF.")
    if "ply" in formats:
        write_tracks_ply(result.tracks, folder / "tracks_3d.ply")
        if len(result.scene.cloud.xyz):
            write_cloud_ply(result.scene.cloud, folder / "cloud.ply")
