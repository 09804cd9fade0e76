"""Rows of several views as integers that can be counted, and as points in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.triangulate import triangulate

from .tracks2d import TrackRecording

if TYPE_CHECKING:
    import pandas as pd


def compact(columns: Sequence[np.ndarray], signed: bool = False) -> tuple[list[np.ndarray], int]:
    """Integers of several arrays numbered from 0 together; negative ones become −1 unless `signed`."""
    joined = np.concatenate([np.asarray(column) for column in columns]).astype(np.int64)
    keep = np.ones(len(joined), dtype=bool) if signed else joined >= 0
    numbered, n = np.full(len(joined), -1), 0
    if keep.any():
        low, high = int(joined[keep].min()), int(joined[keep].max())
        if high - low <= 4 * len(joined) + 1000:  # dense: shifting is enough
            numbered[keep], n = joined[keep] - low, high - low + 1
        else:
            values, inverse = np.unique(joined[keep], return_inverse=True)
            numbered[keep], n = inverse, len(values)
    return np.split(numbered, np.cumsum([len(column) for column in columns])[:-1]), n


def counted(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sorted keys without repeats, and how often each occurs."""
    return np.unique(keys, return_counts=True)


def common(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of the common values of two sorted arrays without repeats."""
    if not len(a) or not len(b):
        return np.empty(0, dtype=int), np.empty(0, dtype=int)
    place = np.minimum(np.searchsorted(b, a), len(b) - 1)
    found = np.flatnonzero(b[place] == a)
    return found, place[found]


def true_points(truth: pd.DataFrame, frame: np.ndarray, animal: np.ndarray) -> np.ndarray:
    """Positions (K, 3) of animals in frames; NaN where the truth has none."""
    if not len(truth):
        return np.full((len(frame), 3), np.nan)
    frames, _ = compact([truth["frame"].to_numpy(), frame], signed=True)
    animals, n_animals = compact([truth["animal"].to_numpy(), animal], signed=True)
    keys, row = np.unique(frames[0] * n_animals + animals[0], return_index=True)
    wanted = frames[1] * n_animals + animals[1]
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    points = truth[["x", "y", "z"]].to_numpy(float)[row[place]]
    return np.where((keys[place] == wanted)[:, None], points, np.nan)


def triangulate_pairs(
    recording: TrackRecording, views: tuple[int, int], rows: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Points (K, 3), world frame, m, from K pairs of rows of two views; NaN where the rays do not meet."""
    chosen = [recording.views[v] for v in views]
    pixels = np.stack([view.xy[r] for view, r in zip(chosen, rows, strict=True)], axis=1)[:, :, None]
    poses = chosen[0].frame[rows[0]] - recording.first_frame
    cameras = []
    for v in views:
        camera = list(recording.cameras)[v]
        moved = {"rotation": camera.rotation[poses]} if camera.rotation.ndim == 3 else {}
        if camera.translation.ndim == 2:
            moved["translation"] = camera.translation[poses]
        cameras.append(replace(camera, **moved))
    if not len(poses):
        return np.empty((0, 3))
    return triangulate(CameraArray(tuple(cameras)), pixels, threshold_px=np.inf).points[:, 0]
