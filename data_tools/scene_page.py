"""The report of a scene, a page that opens without a network: numbers, tracks in space, figures."""

from __future__ import annotations

from collections.abc import Sequence
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
from acino_fte.data_tools.scene_drawing import thinned
from acino_fte.data_tools.scene_numbers import steady_distances, upright_by
from acino_fte.data_tools.scene_tracks import SOURCES, SceneTracks
from acino_fte.data_tools.scene_viewer import viewer_html
from acino_fte.report_scene import ground_grid

if TYPE_CHECKING:
    from acino_fte.data_tools.camera_keys import KeyedCamera
    from acino_fte.data_tools.camera_paths import CameraPath
    from acino_fte.data_tools.scene import SceneResult

CAPTIONS = {
    "scene": "Tracks and cameras from above and from the side",
    "quality": "How many views see each individual, and how well its place is known",
}
"""The figures of a scene: file name → what it shows."""
_MOST, _MOST_CLOUD, _MOST_POSES = 80_000, 20_000, 2000  # points, points of the cloud, poses of a camera
_STYLES = {SOURCES.index("single"): "--", SOURCES.index("interpolated"): ":"}
_FRUSTUM = 0.25
_STRAYS = 0.002  # share of points at each end that the first view need not show


def write_scene_page(result: SceneResult, metrics: dict[str, Any], folder: Path) -> Path:
    """Write ``report.html`` into the folder of a scene, with the figures that are in its ``figures``.

    Parameters
    ----------
    result : SceneResult
        The tracks, cameras and cloud.
    metrics : dict
        What ``metrics.json`` holds.
    folder : Path
        An existing folder.

    Returns
    -------
    Path
        The page.
    """
    data = viewer_data(result)
    unit = "m" if metrics["scale"] else "units of the model"
    sections = [cards(_numbers(metrics)), warning_list(metrics["warnings"])]
    if len(result.tracks) or data["cameras"]:
        sections.append("<h2>In space</h2>" + viewer_html(f"{data['grid']['step']:g} {unit}", cloud=True))
    sections += [figure_list(CAPTIONS, folder / "figures"), _tables(metrics)]
    return write_page(
        folder / "report.html",
        title=f"{metrics['scene']}: tracks in 3D from {metrics['n_cameras']} cameras",
        status=_headline(metrics),
        advice=_advice(metrics),
        colour=_colour(metrics),
        sections=sections,
        data=data,
    )


def viewer_data(result: SceneResult) -> dict[str, Any]:
    """What the viewer shows.

    Returns
    -------
    dict
        As in :mod:`~acino_fte.data_tools.scene_viewer`: a track is a piece of path with one source, dashed
        where one view sees it and dotted where none does; everything is thinned when there is very much.
    """
    scene, tracks = result.scene, result.tracks
    pairs = [(camera, path) for camera, path in zip(scene.cameras, result.paths, strict=True)]
    seen = [tracks.position, *(path.centre[path.known] for _, path in pairs)]
    position = np.concatenate(seen)
    position = position[np.isfinite(position).all(1)]
    position = position if len(position) else np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    low, high = np.quantile(position, [_STRAYS, 1.0 - _STRAYS], axis=0)
    frames = [tracks.frame, *(path.frame[path.known] for _, path in pairs)]
    frame = tracks.frame if len(tracks) else np.concatenate(frames)
    return {
        "tracks": track_pieces(tracks),
        "colours": hex_colours(len(tracks.individuals)),
        "names": list(tracks.individuals),
        "cameras": [_camera(camera, path) for camera, path in pairs if path.known.any()],
        "cloud": _cloud(result),
        "first": int(frame.min()) if len(frame) else 0,
        "last": int(frame.max()) if len(frame) else 0,
        "fps": scene.fps,
        "grid": ground_grid(np.clip(thinned(position, 5000), low, high)[:, None]),
        "middle": np.round(0.5 * (low + high), 6).tolist(),
        "size": max(float(np.linalg.norm(high - low)), 1e-6),
        "frustum": _frustum(tracks, [path for _, path in pairs], float(np.linalg.norm(high - low))),
    }


def _frustum(tracks: SceneTracks, paths: Sequence[CameraPath], size: float) -> float:
    """How long cameras are drawn: a part of their distance from what they see, and of the scene's size."""
    distances = []
    for path in paths:
        row = tracks.frame - path.frame[0]
        rows = np.flatnonzero((row >= 0) & (row < len(path.frame)))
        rows = rows[path.known[row[rows]]]
        away = np.linalg.norm(tracks.position[rows] - path.centre[row[rows]], axis=1)
        distances += [float(np.median(away))] if len(away) else []
    part = _FRUSTUM * float(np.median(distances)) if distances else np.inf
    return max(min(part, 0.06 * size), 1e-6)


def track_pieces(tracks: SceneTracks, most: int = _MOST) -> list[dict[str, Any]]:
    """Runs of frames of one individual and one source; a piece begins where the one before it ends."""
    n = len(tracks)
    if not n:
        return []
    every = max(1, -(-n // most))
    joined = (np.diff(tracks.individual) == 0) & (np.diff(tracks.frame) == 1)
    kind = np.maximum(tracks.source[1:], tracks.source[:-1])  # of the step to the next point
    new = np.flatnonzero(~joined | np.r_[False, np.diff(kind) != 0]) + 1  # points at which a step begins anew
    pieces = []
    for start, stop in zip(np.r_[0, new], np.r_[new, n], strict=True):
        before = int(start - 1) if start and joined[start - 1] else int(start)
        rows = np.unique(np.r_[np.arange(before, stop, every), stop - 1])
        step = kind[stop - 2] if len(rows) > 1 else tracks.source[start]
        pieces.append(
            {
                "group": int(tracks.individual[start]),
                "frames": tracks.frame[rows],
                "xyz": tracks.position[rows],
                "style": _STYLES.get(int(step), "-"),
            }
        )
    return pieces


def _camera(camera: KeyedCamera, path: CameraPath) -> dict[str, Any]:
    """A camera with its poses where they are known; one pose when it stands still."""
    known = np.flatnonzero(path.known)
    centre, rotation = path.centre[known], path.rotation[known]
    if np.ptp(centre, axis=0).max() == 0 and np.ptp(rotation, axis=0).max() == 0:
        known, centre, rotation = known[:1], centre[:1], rotation[:1]
    every = max(1, -(-len(known) // _MOST_POSES))
    width, height = camera.lens.resolution
    return {
        "name": camera.name,
        "aspect": round(height / width, 4),
        "frames": path.frame[known][::every],
        "every": every,
        "pose": np.concatenate([centre, rotation.reshape(-1, 9)], axis=1)[::every],
    }


def _cloud(result: SceneResult) -> dict[str, Any] | None:
    """The point cloud, thinned."""
    cloud = result.scene.cloud
    if not len(cloud.xyz):
        return None
    rgb = None if cloud.rgb is None else thinned(cloud.rgb, _MOST_CLOUD)
    return {"xyz": thinned(cloud.xyz, _MOST_CLOUD), "rgb": rgb}


def _colour(metrics: dict[str, Any]) -> str:
    """``green`` for tracks in metres and upright, ``amber`` for others, ``red`` without any."""
    if not metrics["n_points"]["all"]:
        return "red"
    sure = (metrics["axes"] or {}).get("tilt_sd_deg") is not None
    return "green" if metrics["scale"] and upright_by(metrics) and sure else "amber"


def _headline(metrics: dict[str, Any]) -> str:
    points = metrics["n_points"]["all"]
    if not points:
        return "Nothing was triangulated"
    return f"{points:,} points of {len(metrics['individuals'])} individuals"


def _advice(metrics: dict[str, Any]) -> str:
    if not metrics["n_points"]["all"]:
        return "Check that tracks and images have the same frame numbers, and that two cameras see one place."
    upright = "z is up" if upright_by(metrics) else "the axes are those of the model, z need not be up"
    if metrics["scale"]:
        return f"Lengths are in metres; {upright}."
    return f"There is no scale: lengths are in units of the model, not metres; {upright}."


def _numbers(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What the cards say."""
    points, error, scale = metrics["n_points"], metrics["reprojection_px"], metrics["scale"]
    begin, end = metrics["frames"]
    n = points["all"]
    entries = [
        (f"{n:,}", f"points of {len(metrics['individuals'])} individuals"),
        (share(points["views"] / n if n else None), "of them seen by two views or more"),
        (f"{end - begin:,}", f"frames of {metrics['n_cameras']} cameras"),
        (number(error["median"], "px"), "median reprojection error"),
        (number(metrics["noise_px"], "px"), "noise of a dot's coordinate"),
    ]
    if scale:
        sd = scale.get("sd")
        text = "metres per unit of the model" + (f" ± {100 * sd / scale['factor']:.2g} %" if sd else "")
        entries.append((f"{scale['factor']:.5g}", text))
        spread = metrics["points_3d"]["median_sd"]
        spread = None if spread is None else 1000.0 * spread
        entries.append((number(spread, "mm", 1), "median sd of a position"))
    entries += [
        (f"{pair['mean']:.4f} {'m' if scale else ''}".strip(), f"from {' to '.join(pair['individuals'])}")
        for pair in steady_distances(metrics)[:1]
    ]
    truth = metrics.get("truth_mm")
    if truth:
        entries.append((number(truth["tracks"]["all"]["rmse"], "mm", 1), "RMSE to the truth"))
    entries.append((number(metrics["seconds"]["total"], "s", 2), "in all"))
    return entries


def _tables(metrics: dict[str, Any]) -> str:
    head = ("camera", "dots", "used", "share", "key frames", "reprojection, median", "90 %", "largest")
    errors = metrics["reprojection_px"]["per_camera"]
    rows = [
        (
            name,
            f"{c['rows']:,}",
            f"{c['used']:,}",
            share(c["used_share"]),
            f"{c['key_frames']:,}",
            number(errors[name]["median"], "px"),
            number(errors[name]["p90"], "px"),
            number(errors[name]["max"], "px"),
        )
        for name, c in metrics["cameras"].items()
    ]
    seconds = [(name, number(value, "s", 3)) for name, value in metrics["seconds"].items()]
    tables = table(head, rows) + _distances(metrics) + _clocks(metrics) + table(("step", "time"), seconds)
    return f'<h2>Cameras, distances and time</h2><div class="tables">{tables}</div>'


def _clocks(metrics: dict[str, Any]) -> str:
    """Offsets of the clocks; nothing when they were not asked for."""
    offsets = metrics["time_offsets"]
    if not offsets:
        return ""
    head = ("camera", f"offset to {offsets['reference']}", "sd", "drift")
    rows = [
        (
            name,
            number(one["offset_frames"], "frames", 3),
            number(one["offset_sd"], "frames", 3),
            number(one["drift_ppm"], "ppm", 1),
        )
        for name, one in offsets["cameras"].items()
    ]
    return table(head, rows)


def _distances(metrics: dict[str, Any]) -> str:
    """Distances between individuals; nothing without any."""
    unit = "m" if metrics["scale"] else ""
    rows = [
        (
            " – ".join(pair["individuals"]),
            number(pair["mean"], unit, 4),
            number(pair["sd"], unit, 4),
            f"{pair['count']:,}",
        )
        for pair in metrics["distances"]
    ]
    return table(("individuals", "distance, mean", "sd", "frames"), rows) if rows else ""
