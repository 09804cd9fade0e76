"""Numbers of an evaluation: reprojection error, hand adjustments in 3D, depth; by run, body part and marker.

With residuals r = (u, v), reprojected − labelled, and errors e = |r|, px:

    RMSE = √(mean e²),   SD = √(mean (e − mean e)²),   outlier ratio = share of e beyond a threshold.

Adjustments are lengths d = |after − before|, m, over the positions that were adjusted; the percentage is of
all positions that were looked at. Shapes: N frames, C cameras, M markers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from acino_fte.errors import InputError
from acino_fte.evaluation_runs import Run

LEVELS = ("run", "part", "marker")
"""A row of a table is of a whole run, of the markers of one body part, or of one marker."""


@dataclass(frozen=True)
class Threshold:
    """Beyond it an error is an outlier: in px, or in standard deviations of the marker's detections.

    The standard deviations are ``sd_px`` of the species file: they do not depend on the run.
    """

    value: float
    unit: str = "px"

    def __str__(self) -> str:
        return f"{self.value:g} {self.unit}"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.value) and self.value > 0):
            raise InputError(
                "The threshold for outliers is impossible.",
                key=f"--threshold-{self.unit}",
                expected="a number more than 0",
                found=f"{self.value:g}",
            )

    def pixels(self, run: Run) -> np.ndarray:
        """(M,) px."""
        if self.unit == "px":
            return np.full(len(run.markers), self.value)
        sd = {marker.name: marker.sd_px for marker in run.skeleton.markers}
        return np.array([self.value * sd[name] for name in run.markers])


@dataclass(frozen=True, eq=False)
class Errors:
    """Residuals of one run against labels, or against its own detections.

    Attributes
    ----------
    run : Run
    residual : (N, C, M, 2)
        Reprojected − labelled, px; NaN where there is none.
    behind : (N, C, M) bool
        Labelled, but behind the camera.
    n_missing : int
        Labelled, but the run has no position.
    of : str
        ``"labels"`` or ``"detections"``.
    """

    run: Run
    residual: np.ndarray
    behind: np.ndarray
    n_missing: int
    of: str

    @property
    def length(self) -> np.ndarray:
        """(N, C, M) px; ∞ behind a camera, NaN where there is nothing to compare."""
        return np.where(self.behind, np.inf, np.linalg.norm(self.residual, axis=-1))


def errors_of(run: Run, labels: np.ndarray | None) -> Errors:
    """Errors of a run against labels (N, C, M, 2) px; against its own detections without any."""
    seen = np.isfinite(run.detection if labels is None else labels).all(-1)
    residual = run.residual if labels is None else run.reprojected() - labels
    placed = np.isfinite(run.positions).all(-1)[:, None]
    behind = seen & placed & ~np.isfinite(residual).all(-1)
    return Errors(
        run, residual, behind, int((seen & ~placed).sum()), "detections" if labels is None else "labels"
    )


@dataclass(frozen=True, eq=False)
class Moves:
    """Adjustments of one run by hand.

    Attributes
    ----------
    run : Run
    length : (N, M)
        |after − before|, m; NaN where nothing was adjusted.
    looked_at : (N, M) bool
        Positions that count: of the frames that were marked as checked, or of all when none was.
    n_placed : int
        Positions given by hand where the run had none; they have no length.
    checked : bool
        Whether frames were marked as checked.
    """

    run: Run
    length: np.ndarray
    looked_at: np.ndarray
    n_placed: int
    checked: bool


def parts_of(run: Run) -> dict[str, list[int]]:
    """Markers (indices) by body part: the segment group of the link they are fixed to."""
    skeleton = run.skeleton
    parts: dict[str, list[int]] = {}
    for m, name in enumerate(run.markers):
        link = skeleton.links[skeleton.markers[skeleton.marker(name)].link]
        part = skeleton.groups[link.group] if link.group >= 0 else link.name
        parts.setdefault(part.replace("_", " "), []).append(m)
    return parts


def rows_of(run: Run) -> Iterator[tuple[str, str, list[int]]]:
    """Level, name and markers (indices) of every row of a run."""
    yield "run", "all", list(range(len(run.markers)))
    for name, members in parts_of(run).items():
        yield "part", name, members
    for m, name in enumerate(run.markers):
        yield "marker", name, [m]


def error_rows(errors: Errors, threshold: Threshold) -> list[dict[str, Any]]:
    """Statistics of the reprojection error: a dict for every row; None where undefined."""
    limits = threshold.pixels(errors.run)
    beyond = errors.length > limits
    return [
        {
            **_about(errors.run, level, name),
            "of": errors.of,
            **_error_statistics(errors.residual[:, :, members], errors.length[:, :, members]),
            "outlier_ratio": _share(beyond[:, :, members], ~np.isnan(errors.length[:, :, members])),
        }
        for level, name, members in rows_of(errors.run)
    ]


def _about(run: Run, level: str, name: str) -> dict[str, Any]:
    return {"run": run.name, "level": level, "name": name}


def _error_statistics(residual: np.ndarray, length: np.ndarray) -> dict[str, Any]:
    signed = residual[np.isfinite(residual).all(-1)]
    absolute = np.linalg.norm(signed, axis=-1)
    everything = length[~np.isnan(length)]
    return {
        "n": int(everything.size),
        "mean_u": _of(np.mean, signed[:, 0]),
        "sd_u": _of(np.std, signed[:, 0]),
        "mean_v": _of(np.mean, signed[:, 1]),
        "sd_v": _of(np.std, signed[:, 1]),
        "mean": _of(np.mean, absolute),
        "sd": _of(np.std, absolute),
        "rmse": rms(absolute),
        "median": _of(_median, everything),
        "n_behind": int(np.isinf(everything).sum()),
    }


def move_rows(moves: Moves) -> list[dict[str, Any]]:
    """Statistics of the adjustments: a dict for every row; lengths in m, None where undefined."""
    rows = []
    for level, name, members in rows_of(moves.run):
        length = moves.length[:, members]
        moved = length[np.isfinite(length)]
        rows.append(
            {
                **_about(moves.run, level, name),
                "n": int(moves.looked_at[:, members].sum()),
                "n_adjusted": int(moved.size),
                "adjusted": _share(np.isfinite(length), moves.looked_at[:, members]),
                "rmse": rms(moved),
                "sd": _of(np.std, moved),
                "mean": _of(np.mean, moved),
                "max": _of(np.max, moved),
            }
        )
    return rows


def depth_rows(run: Run) -> list[dict[str, Any]]:
    """Statistics of the depth residuals of a run with a lidar, m: a dict for every row.

    Of a run that wrote no residuals one by one, the numbers of its ``metrics.json`` for the whole run.
    """
    if run.depth_residual is None:
        known = run.metrics.get("depth_m") or {}
        whole = {"n": known.get("n", 0), "mean": known.get("bias"), "median": None}
        return [{**_about(run, "run", "all"), **whole, "sd": known.get("std"), "rmse": known.get("rmse")}]
    rows = []
    for level, name, members in rows_of(run):
        values = run.depth_residual[:, members]
        values = values[np.isfinite(values)]
        rows.append(
            {
                **_about(run, level, name),
                "n": int(values.size),
                "mean": _of(np.mean, values),
                "median": _of(_median, values),
                "sd": _of(np.std, values),
                "rmse": rms(values),
            }
        )
    return rows


def rms(values: np.ndarray) -> float | None:
    """Root mean square; None of nothing."""
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def _of(statistic: Any, values: np.ndarray) -> float | None:
    if not values.size:
        return None
    value = float(statistic(values))
    return value if np.isfinite(value) else None


def _median(values: np.ndarray) -> float:
    """Median of values that may be ∞ (Hyndman and Fan 1996, definition 1: no mean of two of them)."""
    return (
        float(np.sort(values)[(values.size - 1) // 2]) if np.isinf(values).any() else float(np.median(values))
    )


def _share(chosen: np.ndarray, of: np.ndarray) -> float | None:
    return float((chosen & of).sum() / of.sum()) if of.any() else None
