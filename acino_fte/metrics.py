"""Numbers that say how good a trajectory is: the fields of ``metrics.json``.

Every definition, with its source, is in ``docs/metrics.md``. Shapes: N frames, C cameras, M markers.

A detection whose marker ends up behind the camera that saw it has no reprojection. It counts as infinitely
far away wherever that has a meaning (median, p90, share within 20 px, share of outliers); the moments
(mean, RMSE, standard deviation) are those of the rest, and ``n_behind_camera`` says how many there are.
A marker that a method gave no position has no error at all; it counts against ``coverage``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.metrics_parameters import parameter_errors
from acino_fte.metrics_truth import quantile, truth_metrics, uncertainty_metrics

if TYPE_CHECKING:
    from acino_fte.result import FTEResult
    from acino_fte.skeleton import Dof

OUTLIER_SD = 20.0
"""An observation is an outlier when its error is beyond this many standard deviations of its marker."""
NEAR_PX = 20.0
"""Radius of ``within_20px``."""
NOSE_EYE_SHARE = 0.5
"""Radius of ``pck_nose_eye`` as a share of the distance from the nose to the eyes in the image."""
LIMIT_TOLERANCE = {"turn": math.radians(0.1), "slide": 1e-3}
"""How near to its limit a degree of freedom is *at* its limit, rad or m."""
_OUTSIDE = 1e-6  # rad, m: beyond the slack that interior-point solvers give a bound


def result_metrics(result: FTEResult) -> dict[str, Any]:
    """The fields of ``metrics.json``, ready for JSON: numbers, texts, lists, None where undefined.

    Parameters
    ----------
    result : FTEResult
        In whatever status it is.

    Returns
    -------
    dict
        As described in ``docs/metrics.md``. ``truth_mm`` and ``parameter_errors`` are there only when the
        sequence carries truth, ``uncertainty`` only when the result carries covariance.
    """
    from acino_fte import __version__

    sequence, skeleton = result.sequence, result.skeleton
    seen = np.isfinite(result.observed).all(-1)
    metrics: dict[str, Any] = {
        "status": str(result.status),
        "advice": result.status.advice,
        "sequence": sequence.name,
        "species": skeleton.name,
        "method": result.method,
        "version": __version__,
        "frames": [int(sequence.frames[0]), int(sequence.frames[-1]) + 1],
        "fps": sequence.fps,
        "n_cameras": len(sequence.cameras),
        "n_markers": len(skeleton.markers),
        "n_observations": int(seen.sum()),
        "n_frames_unobserved": int((~seen.any(axis=(1, 2))).sum()),
        "objective": result.objective,
        "iterations": result.iterations,
        "seconds": seconds_metrics(result.seconds),
        "realtime_factor": realtime_factor(sequence.duration, result.seconds),
        "reprojection_px": reprojection_metrics(result),
        "speed_m_s": speed_metrics(result),
        "joints_at_limit": joints_at_limit(result),
        "joints_outside_limits": joints_outside_limits(result),
        "parameters": result.parameters,
        "findings": list(result.findings),
        "options": result.options,
        "warnings": list(sequence.warnings),
    }
    optional = {
        "depth_m": None if result.depth is None else result.depth.metrics(),
        "truth_mm": truth_metrics(result),
        "uncertainty": uncertainty_metrics(result),
        "parameter_errors": parameter_errors(result) or None,
    }
    metrics |= {name: value for name, value in optional.items() if value is not None}
    metrics |= result.evaluation
    return json_safe(metrics)


def seconds_metrics(seconds: Mapping[str, float]) -> dict[str, float]:
    """Time spent on load, initialise, build and solve, whatever else was timed, and their total, s."""
    spent = {name: float(seconds.get(name, 0.0)) for name in ("load", "initialise", "build", "solve")}
    spent |= {name: float(value) for name, value in seconds.items() if name not in (*spent, "total")}
    return spent | {"total": float(seconds.get("total", sum(spent.values())))}


def realtime_factor(duration: float, seconds: Mapping[str, float]) -> float | None:
    """Duration of the sequence (s) over the time from detections to trajectory; None when not timed."""
    spent = sum(seconds.get(name, 0.0) for name in ("initialise", "build", "solve"))
    return duration / spent if spent > 0 else None


def point_errors(result: FTEResult) -> np.ndarray:
    """(N, C, M) reprojection error, px; ∞ where the marker is behind the camera.

    NaN where nothing was observed, or where the method has no position to compare with.
    """
    seen = np.isfinite(result.observed).all(-1) & np.isfinite(result.positions).all(-1)[:, None]
    return np.where(seen, np.where(np.isfinite(result.errors), result.errors, np.inf), np.nan)


def coverage(result: FTEResult) -> float | None:
    """Share of the markers observed in a frame, by any camera, that have a position; None without any."""
    observed = np.isfinite(result.observed).all(-1).any(axis=1)
    found = np.isfinite(result.positions).all(-1)
    return float(found[observed].mean()) if observed.any() else None


def nose_eye_share(result: FTEResult) -> dict[str, Any]:
    """``pck_nose_eye``: share of the observations nearer than half the nose–eye distance in that image.

    The distance is that between the reprojections of ``nose`` and of the mean of ``l_eye`` and ``r_eye``
    (or of the one there is), px. Observations in images without it do not count.

    Returns
    -------
    dict
        ``{"pck_nose_eye": share}``, None without an observation; empty when the species lacks the markers.
    """
    names = result.skeleton.marker_names
    eyes = [names.index(eye) for eye in ("l_eye", "r_eye") if eye in names]
    if "nose" not in names or not eyes:
        return {}
    pixels = result.reprojected[:, :, eyes]
    there = np.isfinite(pixels).all(-1, keepdims=True)
    count = there.sum(axis=2)
    eye = np.where(there, pixels, 0.0).sum(axis=2) / np.where(count > 0, count, np.nan)
    yardstick = np.linalg.norm(eye - result.reprojected[:, :, names.index("nose")], axis=-1)
    errors = point_errors(result)
    counted = ~np.isnan(errors) & np.isfinite(yardstick)[..., None]
    correct = (errors < NOSE_EYE_SHARE * yardstick[..., None])[counted]
    return {"pck_nose_eye": float(correct.mean()) if correct.size else None}


def reprojection_metrics(result: FTEResult) -> dict[str, Any]:
    """Reprojection error over all observations, by camera and by marker.

    Returns
    -------
    dict
        median, mean, rmse, std, p90 (px), outlier_ratio, within_20px, pck_nose_eye, coverage (shares),
        n_behind_camera, and ``per_camera``, ``per_marker``: name → {median, mean, p90, within_20px, n}.
    """
    errors = point_errors(result)
    sd = np.array([marker.sd_px for marker in result.skeleton.markers])
    everything = errors[~np.isnan(errors)]
    finite = everything[np.isfinite(everything)]
    scaled = (errors / sd)[~np.isnan(errors)]
    short = summarise(everything)
    return {
        "median": short["median"],
        "mean": short["mean"],
        "rmse": float(np.sqrt(np.mean(finite**2))) if finite.size else None,
        "std": float(np.std(finite)) if finite.size else None,
        "p90": short["p90"],
        "outlier_ratio": float(np.mean(scaled > OUTLIER_SD)) if scaled.size else None,
        "outlier_beyond_sd": OUTLIER_SD,
        "within_20px": short["within_20px"],
        **nose_eye_share(result),
        "coverage": coverage(result),
        "n_behind_camera": int(np.isinf(everything).sum()),
        "per_camera": {
            camera.name: summarise(errors[:, c]) for c, camera in enumerate(result.sequence.cameras)
        },
        "per_marker": {
            marker.name: summarise(errors[:, :, m]) for m, marker in enumerate(result.skeleton.markers)
        },
    }


def summarise(errors: np.ndarray) -> dict[str, Any]:
    """Median, mean, p90 (px), within_20px (share) and n of errors; NaN is no observation, ∞ is behind."""
    errors = errors[~np.isnan(errors)]
    finite = errors[np.isfinite(errors)]
    return {
        "median": quantile(errors, 0.5),
        "mean": float(finite.mean()) if finite.size else None,
        "p90": quantile(errors, 0.9),
        "within_20px": float(np.mean(errors <= NEAR_PX)) if errors.size else None,
        "n": int(errors.size),
    }


def speed_metrics(result: FTEResult) -> dict[str, Any]:
    """Median speeds, m/s: of the body (the mean of all markers) and of every marker.

    Speeds are central differences of the positions in time; None for a single frame.
    """
    if len(result.positions) < 2:
        return {"body": None, "per_marker": dict.fromkeys(result.skeleton.marker_names)}
    fps = result.sequence.fps
    markers = speeds(result.positions, fps).T
    return {
        "body": _median(body_speed(result.positions, fps)),
        "per_marker": dict(zip(result.skeleton.marker_names, map(_median, markers), strict=True)),
    }


def _median(values: np.ndarray) -> float | None:
    """Median of the values that are numbers; None without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def body_speed(positions: np.ndarray, fps: float) -> np.ndarray:
    """(N,) speed of the mean of all markers, m/s, of positions (N, M, 3), m; N ≥ 2.

    Where markers are missing, the mean velocity of those that are there; NaN where there are none.
    (A mean of positions would jump whenever a marker comes or goes.)
    """
    velocity = np.gradient(positions, 1.0 / fps, axis=0)
    there = np.isfinite(velocity).all(-1)
    count = np.where(there.any(axis=1), there.sum(axis=1), np.nan)
    total = np.where(there[..., None], velocity, 0.0).sum(axis=1)
    return np.linalg.norm(total / count[:, None], axis=-1)


def speeds(positions: np.ndarray, fps: float) -> np.ndarray:
    """Speeds (N, …), m/s, of positions (N, …, 3), m, by central differences; N ≥ 2."""
    return np.linalg.norm(np.gradient(positions, 1.0 / fps, axis=0), axis=-1)


def _dof_values(result: FTEResult) -> list[tuple[Dof, np.ndarray]]:
    """Degrees of freedom with their values over time (N,); none of a method without a skeleton."""
    if not result.q.shape[1]:
        return []
    return list(zip(result.skeleton.dofs, result.q.T, strict=True))


def joints_at_limit(result: FTEResult) -> dict[str, float]:
    """Share of the frames in which a degree of freedom is at its limit, for those that ever are."""
    shares = {}
    for dof, values in _dof_values(result):
        near = LIMIT_TOLERANCE[dof.kind]
        share = float(np.mean((values <= dof.lower + near) | (values >= dof.upper - near)))
        if share > 0:
            shares[dof.name] = share
    return shares


def joints_outside_limits(result: FTEResult) -> list[str]:
    """Names of the degrees of freedom that leave their range by more than 1e-6 rad or m."""
    return [
        dof.name
        for dof, values in _dof_values(result)
        if np.any((values < dof.lower - _OUTSIDE) | (values > dof.upper + _OUTSIDE))
    ]


def json_safe(value: Any) -> Any:
    """The value as JSON has it: no NaN or infinity (None), no NumPy, no paths, keys as text."""
    if hasattr(value, "model_dump"):
        value = value.model_dump()
    if isinstance(value, Enum):
        value = value.value
    if value is None or isinstance(value, bool | str):
        return value if not isinstance(value, str) else str(value)
    if isinstance(value, Mapping):
        return {str(json_safe(key)): json_safe(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return json_safe(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [json_safe(item) for item in value]
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value)
