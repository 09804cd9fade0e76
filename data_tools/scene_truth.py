"""True positions of individuals in a scene, and how far its tracks are from them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.individual_rows import identity
from acino_fte.data_tools.scene_tracks import SOURCES, SceneTracks
from acino_fte.data_tools.similarity import Similarity, align_similarity
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.scene import SceneResult

_NAMES = ("individual", "identity", "animal", "id")
_FAR, _FITS = 5.0, 4  # medians from which on a point does not count in the next fit; fits


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """True positions. Rows are in any order, each individual once in a frame.

    Attributes
    ----------
    individual : (P,) str
    frame : (P,) int
    position : (P, 3)
        m, in a world of its own.
    """

    individual: np.ndarray
    frame: np.ndarray
    position: np.ndarray

    def of(self, tracks: SceneTracks) -> np.ndarray:
        """The true position of every point of tracks, (T, 3); NaN where it is not known."""
        found = np.full((len(tracks), 3), np.nan)
        for k, name in enumerate(tracks.individuals):
            mine = np.flatnonzero(self.individual == name)
            mine = mine[np.argsort(self.frame[mine], kind="stable")]
            rows = np.flatnonzero(tracks.individual == k)
            if not len(mine) or not len(rows):
                continue
            place = np.minimum(np.searchsorted(self.frame[mine], tracks.frame[rows]), len(mine) - 1)
            there = self.frame[mine[place]] == tracks.frame[rows]
            found[rows[there]] = self.position[mine[place[there]]]
        return found


def read_truth(path: Path) -> SceneTruth:
    """Read true positions.

    Parameters
    ----------
    path : Path
        CSV with the columns frame, individual (or identity, animal, id) and x, y, z (m).

    Raises
    ------
    InputError
        The file cannot be read, a column is missing, or a row is not a frame and three numbers.
    """
    import pandas as pd

    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False, skipinitialspace=True)
    except (OSError, ValueError, UnicodeError) as error:
        raise InputError(
            "The true positions cannot be read.", file=path, expected="a CSV table", found=str(error)
        ) from None
    names = {str(column).strip().lower(): column for column in table.columns}
    name = next((names[word] for word in _NAMES if word in names), None)
    if name is None or any(word not in names for word in ("frame", "x", "y", "z")):
        raise InputError(
            "The true positions lack columns.",
            file=path,
            expected="frame, individual (or identity), x, y, z",
            found=", ".join(map(str, table.columns)),
        )
    frame = pd.to_numeric(table[names["frame"]], errors="coerce").to_numpy(float)
    position = np.stack(
        [pd.to_numeric(table[names[axis]], errors="coerce").to_numpy(float) for axis in "xyz"], axis=1
    )
    if not (np.isfinite(frame) & (frame == np.round(frame))).all():
        row = int(np.flatnonzero(~(frame == np.round(frame)))[0])
        raise InputError("A frame is not a whole number.", file=path, found=f"row {row + 2}")
    individual = np.array([identity(text) for text in table[name]], dtype=object)
    known = np.isfinite(position).all(1)
    return SceneTruth(individual[known], frame[known].astype(np.int64), position[known])


def score_scene(result: SceneResult, truth: SceneTruth) -> dict[str, Any]:
    """Distances of the tracks, and of the points before smoothing, from the truth, mm.

    The truth has a world of its own, so a rigid motion takes the tracks there (a similarity when they have no
    scale), fitted to the points that two views or more see. The errors are what remains.

    Returns
    -------
    dict
        alignment (``rigid`` or ``similarity``), scale (factor from the tracks to the truth that fits best),
        and for ``tracks`` and ``points``: all, views, single, interpolated (count, rmse, mean, median, p95),
        pair_distance (of distances between individuals; needs no alignment) and nees_over_3 (points of two
        views or more; 1 when the covariances are right: Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2).
    """
    tracks = result.tracks
    metric = bool(result.numbers.get("scale"))
    target = truth.of(tracks)
    known = np.isfinite(target).all(1) & np.isfinite(tracks.position).all(1)
    fitted = known & (tracks.source == SOURCES.index("views"))
    fitted = fitted if fitted.sum() >= 3 else known
    if fitted.sum() < 3:
        raise InputError(
            "The true positions and the tracks have nothing in common.",
            key="--truth",
            expected=f"frames and individuals of the tracks ({', '.join(tracks.individuals[:5])})",
            found=f"{int(fitted.sum())} common points",
        )
    free = _aligned(tracks.position[fitted], target[fitted], with_scale=True)
    change = _aligned(tracks.position[fitted], target[fitted], with_scale=False) if metric else free
    scores = {"alignment": "rigid" if metric else "similarity", "scale": free.scale}
    for name, points in (("tracks", tracks), ("points", result.points)):
        scores[name] = _scores(points, truth.of(points), change)
    return scores


def _scores(tracks: SceneTracks, target: np.ndarray, change: Similarity) -> dict[str, Any]:
    error = change.points(tracks.position) - target
    distance = 1000.0 * np.linalg.norm(error, axis=1)
    views = tracks.source == SOURCES.index("views")
    sure = views & np.isfinite(distance) & np.isfinite(tracks.covariance).all((1, 2))
    nees = None
    if sure.any():
        solved = np.linalg.solve(change.covariance(tracks.covariance[sure]), error[sure][..., None])[..., 0]
        nees = float((error[sure] * solved).sum(1).mean() / 3.0)
    return {
        "all": _summary(distance),
        **{name: _summary(distance[tracks.source == k]) for k, name in enumerate(SOURCES)},
        "pair_distance": _summary(_pair_errors(tracks, target, change.scale)),
        "nees_over_3": nees,
    }


def _pair_errors(tracks: SceneTracks, target: np.ndarray, scale: float) -> np.ndarray:
    """By how much the distances between individuals are wrong, mm, of points of two views or more."""
    from acino_fte.data_tools.scene_numbers import MOST_PAIRS, common_points

    n = len(tracks.individuals)
    pairs = list(combinations(range(n), 2)) if n * (n - 1) // 2 <= MOST_PAIRS else []
    errors = []
    for a, b in pairs:
        i, j = common_points(tracks, a, b)
        length = scale * np.linalg.norm(tracks.position[i] - tracks.position[j], axis=1)
        errors.append(np.abs(length - np.linalg.norm(target[i] - target[j], axis=1)))
    return 1000.0 * np.concatenate(errors) if errors else np.empty(0)


def _summary(distance: np.ndarray) -> dict[str, Any]:
    d = distance[np.isfinite(distance)]
    if not len(d):
        return {"count": 0, "rmse": None, "mean": None, "median": None, "p95": None}
    return {
        "count": len(d),
        "rmse": float(np.sqrt((d**2).mean())),
        "mean": float(d.mean()),
        "median": float(np.median(d)),
        "p95": float(np.quantile(d, 0.95)),
    }


def _aligned(points: np.ndarray, target: np.ndarray, with_scale: bool) -> Similarity:
    """What takes points (n, 3) nearest to a target; what is far off after a fit is not part of the next."""
    use = np.ones(len(points), dtype=bool)
    for _ in range(_FITS):
        change = align_similarity(points[use], target[use], with_scale)
        distance = np.linalg.norm(change.points(points) - target, axis=1)
        use = distance <= _FAR * np.median(distance) + 1e-12
    return change
