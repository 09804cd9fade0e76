"""The report of a matching, a page that opens without a network: numbers, tracks in space, figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.colours import hex_colours
from acino_fte.data_tools.page_parts import (
    cards,
    figure_list,
    number,
    share,
    table,
    warning_list,
    write_page,
)
from acino_fte.data_tools.plots_tracks import FIGURES
from acino_fte.data_tools.scene_viewer import viewer_html
from acino_fte.report_scene import ground_grid

if TYPE_CHECKING:
    from acino_fte.cameras import Camera
    from acino_fte.data_tools.match_points import SpacePoints
    from acino_fte.data_tools.track_matching import TrackMatches

_MOST = 80_000  # points in the viewer
_RIGHT = 0.99  # pairing accuracy from which the headline is green


def write_match_page(
    matches: TrackMatches, points: SpacePoints, metrics: dict[str, Any], folder: Path
) -> Path:
    """Write ``report.html`` into the folder of a matching, with the figures that are in its ``figures``.

    Parameters
    ----------
    matches : TrackMatches
        Of either method.
    points : SpacePoints
        Its points in space.
    metrics : dict
        What ``metrics.json`` holds.
    folder : Path
        An existing folder.

    Returns
    -------
    Path
        The page.
    """
    data = viewer_data(matches, points)
    sections = [cards(_numbers(metrics)), warning_list(metrics["warnings"])]
    if len(points):
        sections.append("<h2>In space</h2>" + viewer_html(f"{data['grid']['step']:g} m"))
    captions = {name: caption for name, (caption, _) in FIGURES.items()}
    sections += [figure_list(captions, folder / "figures"), _tables(metrics)]
    return write_page(
        folder / "report.html",
        title=f"{metrics['recording']}: animals matched over {metrics['n_cameras']} cameras",
        status=_headline(metrics),
        advice=_advice(metrics),
        colour=_colour(metrics),
        sections=sections,
        data=data,
    )


def viewer_data(matches: TrackMatches, points: SpacePoints) -> dict[str, Any]:
    """What the viewer shows.

    Returns
    -------
    dict
        As in :mod:`~acino_fte.data_tools.scene_viewer`: a track is a piece of path, thinned when there are
        very many points; cameras are where they are first.
    """
    recording = matches.recording
    every = max(1, -(-len(points) // _MOST))
    tracks = []
    ends = np.flatnonzero(np.diff(points.piece) != 0) + 1 if len(points) else np.empty(0, dtype=int)
    for start, stop in zip(np.r_[0, ends], np.r_[ends, len(points)], strict=True):
        thin = np.unique(np.r_[np.arange(start, stop, every), max(stop - 1, start)])[: stop - start]
        if not len(thin):
            continue
        tracks.append(
            {
                "group": int(points.group[start]),
                "frames": points.frame[thin],
                "xyz": points.position[thin],
                "style": "-",
            }
        )
    position = points.position if len(points) else np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    low, high = np.quantile(position, [0.002, 0.998], axis=0)
    inside = position[((position >= low) & (position <= high)).all(1)]
    inside = inside if len(inside) else position
    return {
        "tracks": tracks,
        "colours": hex_colours(matches.n_groups),
        "names": None,
        "cameras": [_camera(camera) for camera in recording.cameras],
        "cloud": None,
        "first": recording.first_frame,
        "last": recording.first_frame + max(recording.n_frames - 1, 0),
        "fps": recording.fps,
        "grid": ground_grid(inside[:, None]),
        "middle": np.round(0.5 * (low + high), 4).tolist(),
        "size": max(float(np.linalg.norm(high - low)), 1e-3),
    }


def _camera(camera: Camera) -> dict[str, Any]:
    """A camera where it is first."""
    rotation = camera.rotation.reshape(-1, 3, 3)[0]
    pose = np.concatenate([np.atleast_2d(camera.centre)[0], rotation.ravel()])
    width, height = camera.resolution
    return {
        "name": camera.name,
        "aspect": round(height / width, 4),
        "frames": np.zeros(1, dtype=int),
        "pose": pose[None],
    }


def _headline(metrics: dict[str, Any]) -> str:
    return f"{metrics['n_animals']} animals matched" if metrics["n_animals"] else "Nothing was matched"


def _colour(metrics: dict[str, Any]) -> str:
    if not metrics["n_animals"]:
        return "red"
    right = (metrics["truth"] or {}).get("pairing_accuracy")
    return "green" if right is None or right >= _RIGHT else "amber"


def _advice(metrics: dict[str, Any]) -> str:
    if metrics["n_animals"]:
        return f"Method: {metrics['method']}."
    return (
        "Check that the camera file belongs to the tracks, and that the frames of all cameras have one clock."
    )


def _numbers(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What the cards say."""
    cameras = metrics["cameras"].values()
    rows, matched = sum(c["rows"] for c in cameras), sum(c["matched"] for c in cameras)
    begin, end = metrics["frames"]
    entries = [
        (str(metrics["n_animals"]), "animals"),
        (share(matched / rows if rows else None), f"of {rows:,} dots matched"),
        (f"{end - begin:,}", f"frames of {metrics['n_cameras']} cameras"),
        (number(metrics["noise_px"]["total"], "px"), "noise of a dot's coordinate"),
        (number(metrics["reprojection_px"]["median"], "px"), "median reprojection error"),
        (number(metrics["points_3d"]["median_sd_mm"], "mm", 1), "median sd of a position"),
        (number(metrics["seconds"]["total"], "s", 1), "in all"),
    ]
    truth = metrics["truth"]
    if truth is not None:
        entries += [
            (share(truth["pairing_accuracy"], 2), "pairing accuracy (truth)"),
            (share(truth["recall"], 2), "recall (truth)"),
            (str(truth["identity_switches"]), "identity switches (truth)"),
        ]
        error = truth.get("position_mm", {}).get("right_pairs", {})
        if error.get("count"):
            entries.append((number(error["mean"], "mm", 1), "mean distance to the truth"))
    return entries


def _tables(metrics: dict[str, Any]) -> str:
    head = ("camera", "dots", "tracks", "matched", "share", "animals", "reprojection, median", "90 %")
    errors = metrics["reprojection_px"]["per_camera"]
    rows = [
        (
            name,
            f"{c['rows']:,}",
            f"{c['tracks']:,}",
            f"{c['matched']:,}",
            share(c["matched_share"]),
            str(c["animals"]),
            number(errors[name]["median"], "px"),
            number(errors[name]["p90"], "px"),
        )
        for name, c in metrics["cameras"].items()
    ]
    seconds = [(name, number(value, "s", 3)) for name, value in metrics["seconds"].items()]
    tables = table(head, rows) + table(("step", "time"), seconds)
    return f'<h2>Cameras and time</h2><div class="tables">{tables}</div>'
