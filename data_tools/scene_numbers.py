"""What a triangulated scene says of itself in numbers, and what the truth says of it: ``metrics.json``."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.scene_tracks import SOURCES, SceneTracks
from acino_fte.metrics import json_safe

if TYPE_CHECKING:
    from acino_fte.data_tools.scene import SceneResult
    from acino_fte.data_tools.scene_truth import SceneTruth

TRIANGULATED, NOTHING = "triangulated", "nothing_triangulated"
_OWN_AXES = "the model's own axes"  # as scene_axes says it
_STEADY = 0.1  # scatter of a distance, of its mean
MOST_PAIRS = 15
"""Distances between individuals are listed when there are no more pairs than this."""


def scene_metrics(
    result: SceneResult, options: dict[str, Any] | None = None, truth: SceneTruth | None = None
) -> dict[str, Any]:
    """Numbers of a scene, ready for JSON.

    Parameters
    ----------
    result : SceneResult
        The tracks, cameras and cloud.
    options : dict, optional
        How it was made, for the record.
    truth : SceneTruth, optional
        True positions, for scoring.

    Returns
    -------
    dict
        status, scene, options, individuals, frames (half-open), fps, n_cameras, unit (of lengths), cameras
        (rows, used rows, key frames of each), n_points (all, by source), points_3d, reprojection_px,
        distances (between individuals), noise_px, rigs, scale, axes, time_offsets, world_from_model,
        warnings, what ``result.numbers`` adds, and with truth truth_mm.
    """
    scene, tracks = result.scene, result.tracks
    seen = [view.frame for view in scene.tracks if len(view)] or [np.zeros(0, dtype=int)]
    frame = np.concatenate([*seen, tracks.frame])
    change = scene.world_from_model
    numbers: dict[str, Any] = {
        "status": TRIANGULATED if len(tracks) else NOTHING,
        "scene": scene.name,
        "options": options or {},
        "individuals": list(tracks.individuals),
        "frames": [int(frame.min()), int(frame.max()) + 1] if len(frame) else [0, 0],
        "fps": scene.fps,
        "n_cameras": len(scene.cameras),
        "unit": "m" if result.numbers.get("scale") else "model units",
        "cameras": _cameras(result),
        "n_points": _counts(tracks),
        "points_3d": _spread(tracks),
        "reprojection_px": _reprojection(result),
        "distances": individual_distances(tracks),
        "noise_px": result.noise_px,
        "rigs": [],
        "scale": None,
        "axes": None,
        "time_offsets": None,
        "world_from_model": {
            "scale": change.scale,
            "rotation": change.rotation,
            "translation": change.translation,
        },
        "warnings": list(scene.warnings),
    }
    numbers |= {key: value for key, value in result.numbers.items() if key != "warnings"}
    numbers["warnings"] += [w for w in result.numbers.get("warnings", ()) if w not in numbers["warnings"]]
    if truth is not None:
        from acino_fte.data_tools.scene_truth import score_scene

        numbers["truth_mm"] = score_scene(result, truth)
    return json_safe(numbers)


def _cameras(result: SceneResult) -> dict[str, Any]:
    """What each camera had to say, and what of it counts."""
    scene, tracks = result.scene, result.tracks
    return {
        camera.name: {
            "rows": len(view),
            "used": int(used.sum()),
            "used_share": float(used.mean()) if len(view) else None,
            "individuals": len(np.unique(view.track[view.track >= 0])),
            "key_frames": len(camera.frame),
            "path_frames": int(path.known.sum()),
            "colmap_camera": camera.model_id,
            "model": camera.lens.model,
        }
        for camera, view, path, used in zip(
            scene.cameras, scene.tracks, result.paths, tracks.used, strict=True
        )
    }


def _counts(tracks: SceneTracks) -> dict[str, int]:
    count = np.bincount(tracks.source, minlength=len(SOURCES))
    return {"all": len(tracks), **{name: int(n) for name, n in zip(SOURCES, count, strict=True)}}


def _spread(tracks: SceneTracks) -> dict[str, Any]:
    """Median standard deviation of a position, all three axes together: of all points and by source."""
    sd = np.linalg.norm(tracks.standard_deviation, axis=1)
    by_source = {name: median(sd[tracks.source == k]) for k, name in enumerate(SOURCES)}
    return {"smooth": tracks.smooth, "median_sd": median(sd), "median_sd_by_source": by_source}


def _reprojection(result: SceneResult) -> dict[str, Any]:
    """Of the dots that count; beside them how far off the others are."""
    tracks = result.tracks
    pairs = list(zip(tracks.distance, tracks.used, strict=True))
    used = [distance[use] for distance, use in pairs]
    rest = np.concatenate([distance[~use] for distance, use in pairs]) if pairs else np.empty(0)
    names = [camera.name for camera in result.scene.cameras]
    return {
        **_summary(np.concatenate(used) if used else np.empty(0)),
        "per_camera": {name: _summary(values) for name, values in zip(names, used, strict=True)},
        "not_used": _summary(rest),
    }


def _summary(errors: np.ndarray) -> dict[str, Any]:
    e = errors[np.isfinite(errors)]
    if not len(e):
        return {"median": None, "mean": None, "rmse": None, "p90": None, "max": None, "count": 0}
    return {
        "median": np.median(e),
        "mean": e.mean(),
        "rmse": np.sqrt((e**2).mean()),
        "p90": np.quantile(e, 0.9),
        "max": e.max(),
        "count": len(e),
    }


def median(values: np.ndarray) -> float | None:
    """The median of what is finite; None without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else None


def individual_distances(tracks: SceneTracks) -> list[dict[str, Any]]:
    """How far individuals are apart in frames where two views or more see both: the length of a wand.

    Returns
    -------
    list of dict
        individuals (two names), mean, median, sd (m), count; nothing when there are very many pairs.
    """
    n = len(tracks.individuals)
    if n * (n - 1) // 2 > MOST_PAIRS:
        return []
    found = []
    for a, b in combinations(range(n), 2):
        rows, others = common_points(tracks, a, b)
        length = np.linalg.norm(tracks.position[rows] - tracks.position[others], axis=1)
        if len(length):
            names = [tracks.individuals[a], tracks.individuals[b]]
            found.append(
                {
                    "individuals": names,
                    "mean": length.mean(),
                    "median": np.median(length),
                    "sd": length.std(),
                    "count": len(length),
                }
            )
    return found


def common_points(tracks: SceneTracks, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n,), (n,) of two individuals in the frames in which two views or more see both."""
    well = tracks.source == SOURCES.index("views")
    first, second = (np.flatnonzero(well & (tracks.individual == k)) for k in (a, b))
    _, i, j = np.intersect1d(
        tracks.frame[first], tracks.frame[second], assume_unique=True, return_indices=True
    )
    return first[i], second[j]


def summary(metrics: dict[str, Any]) -> list[str]:
    """What was found, in lines for a terminal.

    Parameters
    ----------
    metrics : dict
        What ``metrics.json`` holds, with the seconds.
    """
    begin, end = metrics["frames"]
    points, error = metrics["n_points"], metrics["reprojection_px"]
    lines = [
        f"{_count(len(metrics['individuals']), 'individual')} in {end - begin} frames of "
        f"{_count(metrics['n_cameras'], 'camera')}",
        f"{points['all']} points: {points['views']} of two views or more, {points['single']} of one, "
        f"{points['interpolated']} interpolated",
    ]
    if error["count"]:
        lines.append(
            f"reprojection {error['median']:.2f} px median, {error['p90']:.2f} px in 90 %, "
            f"{error['max']:.1f} px at most" + _left_out(error)
        )
    if metrics["noise_px"] is not None:
        lines.append(f"noise {metrics['noise_px']:.2f} px")
    lines += _world(metrics)
    lines += _clocks(metrics["time_offsets"])
    lines += [
        f"distance {' – '.join(pair['individuals'])}: {_length(pair, metrics['unit'])} "
        f"over {pair['count']} frames"
        for pair in steady_distances(metrics)[:3]
    ]
    lines += _truth(metrics.get("truth_mm"))
    lines.append(f"done in {metrics['seconds']['total']:.2f} s")
    return lines


def upright_by(metrics: dict[str, Any]) -> str | None:
    """What the scene is upright by; None when its axes are those of the model."""
    how = (metrics["axes"] or {}).get("how")
    return None if how in (None, _OWN_AXES) else str(how)


def steady_distances(metrics: dict[str, Any]) -> list[dict[str, Any]]:
    """The distances that stay about the same, as between the ends of a wand."""
    return [pair for pair in metrics["distances"] if pair["sd"] < _STEADY * pair["mean"]]


def _length(pair: dict[str, Any], unit: str) -> str:
    """A distance and its scatter."""
    if unit == "m":
        return f"{pair['mean']:.4f} m ± {1000 * pair['sd']:.1f} mm"
    return f"{pair['mean']:.5g} ± {pair['sd']:.2g} {unit}"


def _count(n: int, word: str) -> str:
    return f"{n} {word}" + ("" if n == 1 else "s")


def _left_out(error: dict[str, Any]) -> str:
    n = error["not_used"]["count"]
    return f"; {_count(n, 'dot')} left out" if n else ""


def _world(metrics: dict[str, Any]) -> list[str]:
    """Lines about rigs, scale and axes."""
    lines = []
    for rig in metrics["rigs"] or []:
        names = rig["cameras"] if isinstance(rig, dict) else rig
        lines.append("rig of " + ", ".join(map(str, names)))
    scale = metrics["scale"]
    if scale:
        sd = scale.get("sd")
        share = "" if not sd else f" ± {100 * sd / scale['factor']:.2g} %"
        lines.append(f"scale {scale['factor']:.5g} m per unit of the model{share}")
    else:
        lines.append("no scale: lengths are in units of the model (give a distance with --scale)")
    how = upright_by(metrics)
    lines.append(f"upright by {how}" if how else "axes as in the model, not upright")
    return lines


def _clocks(offsets: dict[str, Any] | None) -> list[str]:
    """A line about the clocks, when they were asked for."""
    if not offsets:
        return []
    reference = offsets["reference"]
    others = [
        f"{name} {one['offset_frames']:+.2f} ± {one['offset_sd']:.2f}"
        if one["offset_sd"] is not None
        else f"{name} unknown"
        for name, one in offsets["cameras"].items()
        if name != reference
    ]
    return [f"clocks against {reference}, frames: {', '.join(others)}"]


def _truth(truth: dict[str, Any] | None) -> list[str]:
    if not truth:
        return []
    tracks = truth["tracks"]
    lines = [f"truth: {_error(tracks['all'])}; of two views or more {_error(tracks['views'])}"]
    nees = tracks["nees_over_3"]
    lines[0] += "" if nees is None else f", NEES/3 {nees:.2f}"
    pairs = tracks["pair_distance"]
    if pairs["count"]:
        lines.append(f"       distances between individuals: {_error(pairs)}")
    return lines


def _error(scores: dict[str, Any]) -> str:
    return "no points" if not scores["count"] else f"{scores['rmse']:.2f} mm RMSE"
