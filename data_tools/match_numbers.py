"""What a matching says of itself in numbers, and what the truth says of it: ``metrics.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.match_metrics import score_matching
from acino_fte.data_tools.match_points import SOURCE_NAMES, SpacePoints, epipolar_residuals, row_errors
from acino_fte.data_tools.match_rows import true_points
from acino_fte.metrics import json_safe

if TYPE_CHECKING:
    from acino_fte.data_tools.track_matching import TrackMatches

_MAD = 1.4826  # median of |x| → standard deviation, of a Gaussian
_SURE = 0.9
MATCHED, NOTHING = "matched", "nothing_matched"


def match_metrics(matches: TrackMatches, points: SpacePoints, method: dict[str, Any]) -> dict[str, Any]:
    """Numbers of a matching, ready for JSON; with truth also under ``truth``.

    Parameters
    ----------
    matches : TrackMatches
        Of either method.
    points : SpacePoints
        Of :func:`~acino_fte.data_tools.match_points.space_points`.
    method : dict
        ``method`` and its options, for the record.

    Returns
    -------
    dict
        status, recording, method, options, n_animals, n_cameras, frames (half-open), fps, cameras (rows,
        tracks, matched rows of each), noise_px, confidence, reprojection_px, epipolar_px, points_3d, warnings
        and truth (None without it).
    """
    recording = matches.recording
    first = recording.first_frame
    return json_safe(
        {
            "status": MATCHED if matches.n_groups else NOTHING,
            "recording": recording.name,
            **method,
            "n_animals": matches.n_groups,
            "n_cameras": len(recording.views),
            "frames": [first, first + recording.n_frames],
            "fps": recording.fps,
            "cameras": _cameras(matches),
            "noise_px": {
                "white": matches.noise.white,
                "slow": matches.noise.slow,
                "total": matches.noise.total,
            },
            "confidence": _confidence(matches),
            "reprojection_px": _reprojection(matches, points),
            "epipolar_px": _epipolar(matches),
            "points_3d": _points(points),
            "warnings": list(recording.warnings),
            "truth": truth_metrics(matches, points),
        }
    )


def _cameras(matches: TrackMatches) -> dict[str, Any]:
    return {
        view.camera: {
            "rows": len(view),
            "rows_without_dot": 0 if view.left_out is None else len(view.left_out),
            "tracks": len(np.unique(view.track[view.track >= 0])),
            "bare_points": int((view.track < 0).sum()),
            "matched": int((group >= 0).sum()),
            "matched_share": float((group >= 0).mean()) if len(view) else None,
            "animals": len(np.unique(group[group >= 0])),
        }
        for view, group in zip(matches.recording.views, matches.groups, strict=True)
    }


def _confidence(matches: TrackMatches) -> dict[str, Any]:
    sure = np.concatenate(matches.confidence)
    sure = sure[np.isfinite(sure)]
    if not len(sure):
        return {"mean": None, "below_0.9": None}
    return {"mean": float(sure.mean()), f"below_{_SURE}": float((sure < _SURE).mean())}


def _reprojection(matches: TrackMatches, points: SpacePoints) -> dict[str, Any]:
    errors = row_errors(matches, points)
    names = matches.recording.cameras.names
    return {
        **_summary(np.concatenate(errors)),
        "per_camera": {name: _summary(e) for name, e in zip(names, errors, strict=True)},
    }


def _summary(errors: np.ndarray) -> dict[str, Any]:
    e = errors[np.isfinite(errors)]
    if not len(e):
        return {"median": None, "mean": None, "rmse": None, "p90": None, "p99": None, "count": 0}
    return {
        "median": np.median(e),
        "mean": e.mean(),
        "rmse": np.sqrt((e**2).mean()),
        "p90": np.quantile(e, 0.9),
        "p99": np.quantile(e, 0.99),
        "count": len(e),
    }


def _epipolar(matches: TrackMatches) -> dict[str, Any]:
    names = matches.recording.cameras.names
    everything, pairs = [], []
    for a, b, distance, _ in epipolar_residuals(matches):
        everything.append(distance)
        pairs.append({"views": [names[a], names[b]], **_signed(distance)})
    joined = np.concatenate(everything) if everything else np.empty(0)
    return {**_signed(joined), "pairs": pairs}


def _signed(distance: np.ndarray) -> dict[str, Any]:
    """Of signed distances: the robust scatter, the bias, and how long the tail is."""
    d = distance[np.isfinite(distance)]
    if not len(d):
        return {"median_abs": None, "sd": None, "bias": None, "p90_abs": None, "count": 0}
    return {
        "median_abs": np.median(np.abs(d)),
        "sd": _MAD * np.median(np.abs(d)),
        "bias": np.median(d),
        "p90_abs": np.quantile(np.abs(d), 0.9),
        "count": len(d),
    }


def _points(points: SpacePoints) -> dict[str, Any]:
    count = np.bincount(points.source, minlength=len(SOURCE_NAMES))
    sd = 1000.0 * np.linalg.norm(points.standard_deviation, axis=1)
    sd = sd[np.isfinite(sd)]
    return {
        "count": len(points),
        "by_source": {name: int(n) for name, n in zip(SOURCE_NAMES, count, strict=True) if n},
        "median_sd_mm": np.median(sd) if len(sd) else None,
    }


def truth_metrics(matches: TrackMatches, points: SpacePoints) -> dict[str, Any] | None:
    """Scores against the true animals; with true positions also the error in space. None without truth."""
    recording = matches.recording
    if not recording.views or any(view.animal is None for view in recording.views):
        return None
    scores = score_matching(recording, matches.groups).as_dict()
    if recording.truth_3d is not None and len(points):
        scores["position_mm"] = _space_errors(matches, points)
    return scores


def _space_errors(matches: TrackMatches, points: SpacePoints) -> dict[str, Any]:
    """Distance of the points in space from the truth, by source.

    ``right_pairs`` are points that two views or more see, all with dots of one animal; NEES is their mean
    squared error in units of their covariance, 3 when that is right (Bar-Shalom, Li and Kirubarajan 2001,
    section 5.4.2). A point without dots belongs to the animal of most dots of its group.
    """
    animal, agree = _animals(matches, points)
    truth = matches.recording.truth_3d
    assert truth is not None
    error = points.position - true_points(truth, points.frame, animal)
    distance = np.where(animal >= 0, 1000.0 * np.linalg.norm(error, axis=1), np.nan)
    right = agree & (points.n_views >= 2) & np.isfinite(distance)
    known = right & np.isfinite(points.covariance).all((1, 2))
    nees = np.empty(0)
    if known.any():
        solved = np.linalg.solve(points.covariance[known], error[known][..., None])[..., 0]
        nees = (error[known] * solved).sum(1)
    return {
        "right_pairs": _summary(distance[right]),
        "nees_over_3": nees.mean() / 3.0 if len(nees) else None,
        "by_source": {
            name: _summary(distance[points.source == k])
            for k, name in enumerate(SOURCE_NAMES)
            if (points.source == k).any()
        },
    }


def _animals(matches: TrackMatches, points: SpacePoints) -> tuple[np.ndarray, np.ndarray]:
    """True animal of every point, (T,), −1 for clutter; whether all its dots are of that one, (T,)."""
    low = np.full(len(points), np.iinfo(np.int64).max)
    high = np.full(len(points), -1)
    votes = []
    for view, group in zip(matches.recording.views, matches.groups, strict=True):
        animal = np.asarray(view.animal)
        place = points.find(group, view.frame)
        use = place >= 0
        np.minimum.at(low, place[use], animal[use])
        np.maximum.at(high, place[use], animal[use])
        real = (group >= 0) & (animal >= 0)
        votes.append(np.stack([group[real], animal[real]], axis=1))
    seen, count = np.unique(np.concatenate(votes), axis=0, return_counts=True)
    most = np.full(matches.n_groups, -1)
    order = np.argsort(count, kind="stable")
    most[seen[order, 0]] = seen[order, 1]
    agree = (low == high) & (high >= 0)
    return np.where(agree, high, most[points.group]), agree


def summary(metrics: dict[str, Any]) -> list[str]:
    """What was found, in lines for a terminal.

    Parameters
    ----------
    metrics : dict
        What ``metrics.json`` holds, with the seconds.
    """
    begin, end = metrics["frames"]
    lines = [f"{metrics['n_animals']} animals in {end - begin} frames of {metrics['n_cameras']} cameras"]
    for name, view in metrics["cameras"].items():
        share = f" ({view['matched_share']:.1%})" if view["rows"] else ""
        lines.append(f"  {name}: {view['matched']} of {view['rows']} rows matched{share}")
    noise, error = metrics["noise_px"]["total"], metrics["reprojection_px"]
    if noise is not None:
        slow = metrics["noise_px"]["slow"]
        lines.append(f"noise {noise:.2f} px" + (f", {slow:.2f} px of it slow" if slow else ""))
    if error["count"]:
        lines.append(f"reprojection {error['median']:.2f} px median, {error['p90']:.2f} px in 90 %")
    lines += _scores(metrics["truth"])
    seconds = metrics["seconds"]
    matching = seconds["total"] - sum(seconds.get(name, 0.0) for name in ("reading", "tables", "figures"))
    lines.append(f"matched in {matching:.2f} s, {seconds['total']:.1f} s in all")
    return lines


def _scores(truth: dict[str, Any] | None) -> list[str]:
    """Lines about the truth."""
    if truth is None:
        return []

    def number(key: str) -> str:
        return "–" if truth[key] is None else f"{truth[key]:.4f}"

    lines = [
        f"truth: pairing accuracy {number('pairing_accuracy')}, recall {number('recall')}, "
        f"UDR {number('udr')} (at most {number('udr_ceiling')}), "
        f"trajectories right {number('trajectories_right')}, identity switches {truth['identity_switches']}"
    ]
    position = truth.get("position_mm", {}).get("right_pairs", {})
    if position.get("count"):
        nees = truth["position_mm"]["nees_over_3"]
        lines.append(
            f"       3D error {position['mean']:.1f} mm mean, {position['median']:.1f} mm median"
            + ("" if nees is None else f", NEES/3 {nees:.2f}")
        )
    return lines
