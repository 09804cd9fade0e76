"""The work behind the calibration page: picks, their file, and the solution of the moment. No browser."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.calibrate_page_files import read_picks, save_picks
from acino_fte.calibrate_page_input import Placement, check_placements
from acino_fte.calibrate_page_model import Pair, PickBook, Picks, as_lidar_pairs
from acino_fte.data_tools.lidar_pairs import LidarPairs
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.lidar_solve import Calibration

Solve = Callable[[LidarPairs], "Calibration"]
Save = Callable[["Calibration"], object]
ENOUGH = 6
"""Pairs in use from which the page solves by itself."""
_OVERLAY_POINTS = 40_000


class Work:
    """One calibration under way.

    Parameters
    ----------
    placements : sequence of Placement
    path : Path
        File of the pairs, written after every change; what it holds is gone on with.
    solve : callable
        Takes the pairs, gives a calibration, or raises InputError.
    save : callable
        Writes a calibration and its report.

    Raises
    ------
    InputError
        The images do not fit together, or the pairs cannot be read.
    """

    def __init__(self, placements: Sequence[Placement], path: Path, solve: Solve, save: Save) -> None:
        check_placements(placements)
        self.placements = {one.name: one for one in placements}
        self.path = path
        self.book = PickBook(tuple(self.placements), read_picks(path, tuple(self.placements)), self._changed)
        self.n_found = len(self.book.pairs)
        """Pairs that an earlier session left."""
        self.solution: Calibration | None = None
        self.problem: str = ""
        """Why there is no solution."""
        self.version = 0
        """Grows with every solution: addresses of overlays carry it."""
        self.saved = False
        self.solving = False
        """Whether a solution is under way."""
        self._changed_at = 0.0
        self._solve, self._save = solve, save
        self._solved: tuple[Pair, ...] | None = None
        self._failed: tuple[Pair, ...] | None = None

    def _changed(self, picks: Picks) -> None:
        save_picks(self.path, picks)
        self.saved = False
        self._changed_at = time.monotonic()

    @property
    def quiet(self) -> float:
        """Seconds since the last change."""
        return time.monotonic() - self._changed_at

    # -- solving ---------------------------------------------------------------------------------------
    @property
    def n_used(self) -> int:
        """Pairs that are not dropped."""
        return sum(pair.used for pair in self.book.pairs)

    @property
    def due(self) -> bool:
        """Whether the pairs changed since they were last solved, and are enough."""
        pairs = self.book.pairs
        return self.n_used >= ENOUGH and pairs not in (self._solved, self._failed)

    @property
    def current(self) -> Calibration | None:
        """The solution, if it is of the pairs as they are."""
        return self.solution if self._solved == self.book.pairs else None

    def solve(self) -> None:
        """Solve the pairs as they are; what went wrong is in `problem`. May run in a thread."""
        pairs = self.book.pairs
        try:
            solution = self._solve(as_lidar_pairs(pairs))
        except InputError as error:
            self.solution, self.problem, self._failed, self._solved = None, str(error), pairs, None
            self.version += 1
            return
        self.solution, self.problem, self._solved, self._failed = solution, "", pairs, None
        self.version += 1

    def save(self) -> object:
        """Write the calibration of the pairs as they are, and its report.

        Raises
        ------
        InputError
            There is none, or it cannot be written.
        """
        if self.current is None and self.n_used >= ENOUGH:
            self.solve()
        if self.current is None:
            reason = self.problem or f"{self.n_used} pairs in use"
            raise InputError(
                "There is no calibration to save yet.",
                expected=f"{ENOUGH} or more pairs that agree",
                found=reason,
                remedy=f"pick more; the picks themselves are in {self.path} already",
            )
        written = self._save(self.current)
        self.saved = True
        return written

    def residuals(self) -> np.ndarray | None:
        """Projection minus pick (P, 2), px, by the last solution: at once, also of pairs it does not know."""
        if self.solution is None or not self.book.pairs:
            return None
        pairs = self.book.lidar_pairs()
        return self.solution.camera.project(pairs.xyz) - pairs.pixel

    # -- what is shown ---------------------------------------------------------------------------------
    def rows(self) -> list[dict[str, Any]]:
        """One row of the table for every pair."""
        solution, live = self.current, self.residuals()
        rows = []
        for number, pair in enumerate(self.book.pairs, start=1):
            assert pair.pixel is not None and pair.xyz is not None
            row: dict[str, Any] = {
                "number": number,
                "image": pair.image,
                "pixel": "{:.1f}, {:.1f}".format(*pair.pixel),
                "xyz": "{:.2f}, {:.2f}, {:.2f}".format(*pair.xyz),
                "range": float(np.linalg.norm(pair.xyz)),
                "used": pair.used,
                "label": pair.label,
                "error": None if live is None else _finite(np.linalg.norm(live[number - 1])),
                "left_out": None,
                "outlier": False,
            }
            if solution is not None:
                row["left_out"] = _finite(np.linalg.norm(solution.left_out[number - 1]))
                row["outlier"] = bool(solution.outlier[number - 1])
            rows.append(row)
        return rows

    def image_marks(self, image: str, chosen: int | None = None) -> list[dict[str, Any]]:
        """Picks in an image, and where the solution has their points."""
        live, marks = self.residuals(), []
        for number, pair in self._of(image):
            if pair.pixel is None:
                continue
            mark = _mark(number, pair, chosen) | {"u": pair.pixel[0], "v": pair.pixel[1], "projected": None}
            if live is not None and pair.complete:
                there = np.array(pair.pixel) + live[number - 1]
                mark["projected"] = there.tolist() if np.isfinite(there).all() else None
            marks.append(mark)
        return marks

    def cloud_marks(self, image: str, chosen: int | None = None) -> list[dict[str, Any]]:
        """Picks in the cloud of an image."""
        return [
            _mark(number, pair, chosen) | dict(zip("xyz", pair.xyz, strict=True))
            for number, pair in self._of(image)
            if pair.xyz is not None
        ]

    def _of(self, image: str) -> list[tuple[int, Pair]]:
        pairs = [(n, pair) for n, pair in enumerate(self.book.pairs, start=1) if pair.image == image]
        half = self.book.half(image)
        return pairs if half is None else [*pairs, (len(self.book.pairs) + 1, half)]

    def overlay(self, image: str) -> tuple[bytes, float, float]:
        """The cloud of an image, projected by the solution.

        Returns
        -------
        packed : bytes
            Pixels (K, 2), then ranges (K,), float32; those inside the image, farthest first.
        near, far : float
            Ranges (m) between which most points are.
        """
        solution, one = self.solution, self.placements[image]
        if solution is None:
            return b"", 0.0, 1.0
        xyz = one.xyz[:: -(-len(one.xyz) // _OVERLAY_POINTS)]
        pixel, distance = solution.camera.project(xyz), np.linalg.norm(xyz, axis=1)
        width, height = one.resolution
        with np.errstate(invalid="ignore"):
            inside = ((pixel > -0.5) & (pixel < [width - 0.5, height - 0.5])).all(axis=1)
        if not inside.any():
            return b"", 0.0, 1.0
        pixel, distance = pixel[inside], distance[inside]
        order = np.argsort(-distance)
        near, far = np.percentile(distance, [5, 95])
        return _floats(pixel[order]) + _floats(distance[order]), float(near), float(far)


def _mark(number: int, pair: Pair, chosen: int | None) -> dict[str, Any]:
    state = "open" if not pair.complete else "used" if pair.used else "dropped"
    return {"text": str(number), "state": state, "chosen": number == chosen}


def _finite(value: np.floating | float) -> float | None:
    return round(float(value), 2) if np.isfinite(value) else None


def _floats(values: np.ndarray) -> bytes:
    return values.astype("<f4").tobytes()
