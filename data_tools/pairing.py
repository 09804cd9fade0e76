"""Do the keypoint files belong to the cameras they are paired with?

Two cameras that see the same point see it on corresponding epipolar lines. For every pair of cameras the
median Sampson distance (Hartley & Zisserman 2004, eq. 11.9) of their shared points is the price of the
pair; files given to the wrong cameras make it many times the detection noise.

Two limits, as shares of the image diagonal. Real detections that are rightly paired (a running cheetah,
six cameras with a few milliseconds of clock error, 2704×1520) have prices of 3 to 8 px, 0.1 to 0.25 % of
the diagonal; exchanging two files of that recording raises those of the cameras concerned to 20 to 115 px.
Other pairings are tried when a camera's median price is above 0.5 %, or twice that of the best camera:
cameras side by side, or all at one height around an animal that runs, see a swap as little as 4 px. A
pairing that halves the price of the pairs it touches is named. Above 1 % a camera that no other pairing
explains is named: its calibration or its clock may be wrong.

What it cannot see: an error along the epipolar lines, such as a few frames of delay in cameras that all
look across the path of the animal.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from itertools import combinations, permutations
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.epipolar import essential_from_poses, sampson_distance

if TYPE_CHECKING:
    import xarray as xr

SUSPICIOUS, WRONG = 0.005, 0.01
_LEAST_PX = (5.0, 10.0)
_UNEVEN, _UNEVEN_LEAST_PX = 2.0, 3.0
_EXPLAINED = 0.5
_POINTS, _POINTS_SEARCH = 4000, 1000
_FEWEST = 20
_MOST_PERMUTED = 6


def check_pairing(detections: xr.Dataset, cameras: CameraArray, likelihood: float = 0.5) -> list[str]:
    """Warn of keypoint files that do not fit the geometry of the cameras they are paired with.

    Parameters
    ----------
    detections : xarray.Dataset
        As in :class:`~acino_fte.sequence.Sequence`.
    cameras : CameraArray
        In the same order; they may move.
    likelihood : float
        Detections above it are used.

    Returns
    -------
    list of str
        Empty when everything fits.
    """
    if len(cameras) < 2:
        return []
    position, surety = detections.position.values, detections.likelihood.values
    pixels = np.where(surety[..., None] > likelihood, position, np.nan)
    prices = _Prices(cameras, pixels, _POINTS)
    n = len(cameras)
    table = np.full((n, n), np.nan)
    for a, b in combinations(range(n), 2):
        table[a, b] = table[b, a] = prices(a, a, b, b)
    if not np.isfinite(table).any():
        return [
            "Whether the keypoint files belong to their cameras could not be checked: no two cameras share "
            f"{_FEWEST} detections with a likelihood above {likelihood:g}."
        ]
    known = [row[np.isfinite(row)] for row in table]
    score = np.array([np.median(row) if len(row) else 0.0 for row in known])
    best = min(value for value, row in zip(score, known, strict=True) if len(row))
    diagonal = float(np.median([np.hypot(*camera.resolution) for camera in cameras]))
    suspicious, wrong = np.maximum(np.array([SUSPICIOUS, WRONG]) * diagonal, _LEAST_PX)
    if score.max() <= min(suspicious, max(_UNEVEN * best, _UNEVEN_LEAST_PX)):
        return []
    exchange = _best_exchange(cameras, pixels, score)
    if exchange is not None:
        return [_exchange_warning(exchange, cameras.names)]
    if score.max() <= wrong:
        return []
    return [_misfit_warning(table, score, wrong, cameras.names)]


class _Prices:
    """Median Sampson distance of two cameras, each with some file, px; NaN when they share few points.

    Parameters
    ----------
    cameras : CameraArray
    pixels : (N, C, M, 2)
        Confident detections of file c, px.
    n_points : int
        Frames are skipped evenly so that about this many points of each file remain.
    """

    def __init__(self, cameras: CameraArray, pixels: np.ndarray, n_points: int) -> None:
        n_frames = len(pixels)
        used = np.isfinite(pixels[..., 0]).any((1, 2)).nonzero()[0]
        step = max(1, len(used) * pixels.shape[2] // n_points)
        frames = used[::step]
        self._cameras = cameras
        self._pixels = pixels[frames]
        moving = any(camera.moves for camera in cameras)
        rotation, translation = cameras.poses(n_frames if moving else 1)
        self._rotation = rotation[frames] if moving else rotation
        self._translation = translation[frames] if moving else translation
        self._rays = cache(self._undistorted)
        self._essential = cache(self._essential_matrix)

    def _undistorted(self, camera: int, file: int) -> np.ndarray:
        """(N, M, 2) normalised coordinates of a file seen through a camera."""
        return self._cameras[camera].undistort(self._pixels[:, file])

    def _essential_matrix(self, a: int, b: int) -> np.ndarray:
        """(N or 1, 3, 3) with x_b · E x_a = 0; NaN where the two centres coincide."""
        return essential_from_poses(
            self._rotation[:, a], self._translation[:, a], self._rotation[:, b], self._translation[:, b]
        )

    def __call__(self, a: int, file_a: int, b: int, file_b: int) -> float:
        """Price of cameras a and b with the given files."""
        essential = self._essential(a, b)[:, None]
        distance = np.abs(sampson_distance(essential, self._rays(a, file_a), self._rays(b, file_b)))
        distance = distance[np.isfinite(distance)]
        if len(distance) < _FEWEST:
            return float("nan")
        focal = 0.5 * (self._cameras[a].matrix[0, 0] + self._cameras[b].matrix[0, 0])
        return float(np.median(distance) * focal)


def _best_exchange(cameras: CameraArray, pixels: np.ndarray, score: np.ndarray) -> list[int] | None:
    """The file of each camera in the pairing that explains the misfit, or None.

    Every order of the files of the worst cameras (at most six) is tried. Of those that come within a
    tenth of the best, the one that moves the fewest files wins.
    """
    n = len(cameras)
    worst = sorted(np.argsort(-score)[:_MOST_PERMUTED].tolist())
    prices = _Prices(cameras, pixels, _POINTS_SEARCH)
    price = cache(prices.__call__)
    orders = []
    for order in permutations(worst):
        files = list(range(n))
        for camera, file in zip(worst, order, strict=True):
            files[camera] = file
        orders.append(files)
    pairs = [pair for pair in combinations(range(n), 2) if pair[0] in worst or pair[1] in worst]

    def costs(files: list[int], which: Iterable[tuple[int, int]]) -> np.ndarray:
        return np.array([price(a, files[a], b, files[b]) for a, b in which])

    total = np.array([_mean(costs(files, pairs)) for files in orders])
    near = [files for files, cost in zip(orders, total, strict=True) if cost <= 1.1 * np.nanmin(total)]
    best = min(near, key=lambda files: sum(c != f for c, f in enumerate(files)))
    moved = {c for c, file in enumerate(best) if c != file}
    touched = [pair for pair in pairs if moved & set(pair)]
    if not touched or _mean(costs(best, touched)) > _EXPLAINED * _mean(costs(list(range(n)), touched)):
        return None
    return best


def _mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _exchange_warning(files: list[int], names: list[str]) -> str:
    moved = [c for c, file in enumerate(files) if c != file]
    if len(moved) == 2:
        a, b = (names[c] for c in moved)
        return (
            f"The keypoint files of cameras '{a}' and '{b}' look swapped: exchanging them would make the "
            "views agree. Check which file belongs to which camera."
        )
    wanted = ", ".join(f"'{names[c]}' the file given to '{names[files[c]]}'" for c in moved)
    return (
        "The keypoint files look mixed up: the views would agree if cameras got other files, "
        f"{wanted}. Check which file belongs to which camera."
    )


def _misfit_warning(table: np.ndarray, score: np.ndarray, wrong: float, names: list[str]) -> str:
    """Name the camera whose pairs are worst, and say whether the others agree among themselves."""
    camera = int(np.argmax(score))
    rest = np.delete(np.delete(table, camera, 0), camera, 1)
    known = rest[np.isfinite(rest)]
    others = f"; the other cameras agree to {np.median(known):.0f} px" if len(known) else ""
    return (
        f"Camera '{names[camera]}' does not fit the others: its points lie {score[camera]:.0f} px from "
        f"their epipolar lines (more than {wrong:.0f} px is no noise){others}. Its keypoint file may belong "
        "to another camera or recording, it may have moved since it was calibrated, or its frames may "
        "not be those of the others."
    )
