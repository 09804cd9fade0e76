"""What a 2D keypoint file holds, whichever tool wrote it, and the checks that all of them share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acino_fte.errors import InputError

COORDINATES = ("x", "y", "likelihood")
_MAX_LIKELIHOOD = 2.0  # heat maps overshoot 1 a little; percentages overshoot it a lot
_MAX_GAP = 100_000


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The keypoints of one camera and one animal.

    Attributes
    ----------
    names : tuple of str
        The K body parts, in the order of the file.
    position : (N, K, 2)
        u, v in px, NaN where missing. Row n is frame n of the recording.
    likelihood : (N, K)
        The detector's confidence, 0 where missing.
    path : Path
        The file they come from.
    candidate_position : (N, K, J, 2), optional
        Where the file has several candidates for a body part: the J best, the first is `position`; NaN
        where there are fewer.
    candidate_likelihood : (N, K, J), optional
        Their likelihoods, 0 where there are fewer.
    """

    names: tuple[str, ...]
    position: np.ndarray
    likelihood: np.ndarray
    path: Path
    candidate_position: np.ndarray | None = None
    candidate_likelihood: np.ndarray | None = None

    @property
    def n_frames(self) -> int:
        """N."""
        return len(self.position)

    @property
    def depth(self) -> int:
        """J; 1 without candidates."""
        return 1 if self.candidate_position is None else self.candidate_position.shape[2]

    @property
    def candidates(self) -> tuple[np.ndarray, np.ndarray]:
        """Position (N, K, J, 2) and likelihood (N, K, J) of all candidates, J = 1 without any."""
        if self.candidate_position is None or self.candidate_likelihood is None:
            return self.position[:, :, None], self.likelihood[:, :, None]
        return self.candidate_position, self.candidate_likelihood

    @property
    def x(self) -> np.ndarray:
        """(N, K) px."""
        return self.position[..., 0]

    @property
    def y(self) -> np.ndarray:
        """(N, K) px."""
        return self.position[..., 1]


def from_table(
    columns: Sequence[tuple[str, str]], values: np.ndarray, index: np.ndarray, path: Path
) -> Keypoints:
    """Sort the columns and rows of a table into :class:`Keypoints`.

    Rows are put in the order of their frame numbers and frames without a row become NaN. So do points
    that tools write for "nothing found": (0, 0) and a negative likelihood.

    Parameters
    ----------
    columns : sequence of (bodypart, coordinate)
        One pair per column of `values`.
    values : (R, K * 3)
        Numbers of the table; NaN where a cell is empty.
    index : (R,)
        Frame number of each row, counted from the start of the recording.
    path : Path
        For error messages.

    Raises
    ------
    InputError
        A body part lacks a coordinate or comes twice, a frame comes twice, a frame number is not a whole
        number, the likelihoods are not probabilities, or the table is empty.
    """
    names = tuple(dict.fromkeys(bodypart for bodypart, _ in columns))
    _check_columns(columns, names, path)
    frame = _frame_numbers(index, path)
    place = {column: i for i, column in enumerate(columns)}
    order = np.array([place[name, coordinate] for name in names for coordinate in COORDINATES])
    full = np.full((frame.max() + 1, len(names), 3), np.nan)
    full[frame] = values[:, order].reshape(len(values), len(names), 3)
    position, likelihood = full[..., :2], full[..., 2]
    check_likelihood(likelihood, path)
    missing = ~np.isfinite(full).all(-1) | (position == 0).all(-1) | (likelihood < 0)
    return Keypoints(
        names, np.where(missing[..., None], np.nan, position), np.where(missing, 0.0, likelihood), path
    )


def check_likelihood(likelihood: np.ndarray, path: Path) -> None:
    """Likelihoods are probabilities, NaN where missing.

    Raises
    ------
    InputError
        Some are far above 1.
    """
    highest = float(np.nanmax(likelihood, initial=0.0))
    if highest > _MAX_LIKELIHOOD:
        raise InputError(
            "The likelihoods are no probabilities.",
            file=path,
            key="likelihood",
            expected="numbers from 0 to 1",
            found=f"up to {highest:g}",
            remedy="divide them by 100 if they are percentages; check that the columns are not shifted",
        )


def _check_columns(columns: Sequence[tuple[str, str]], names: tuple[str, ...], path: Path) -> None:
    """Every body part has x, y and likelihood, once."""
    if not columns:
        raise InputError("The table has no columns.", file=path, remedy="export the keypoints again")
    coordinates = list(dict.fromkeys(coordinate for _, coordinate in columns))
    if "likelihood" not in coordinates and {"x", "y"} <= set(coordinates):
        spatial = "z" in coordinates
        raise InputError(
            "The table is a 3D result, not 2D keypoints."
            if spatial
            else "The table has no likelihood: it looks like hand-made labels, not like a network's output.",
            file=path,
            key="coords",
            expected="x, y, likelihood for every body part",
            found=", ".join(coordinates),
            remedy="give the 2D files of the single cameras"
            if spatial
            else "give the table that analyze_videos wrote, or add likelihood columns with 1 in them",
        )
    seen: set[tuple[str, str]] = set()
    for column in columns:
        if column in seen:
            raise InputError(
                f"The body part '{column[0]}' comes twice.",
                file=path,
                key=f"{column[0]}.{column[1]}",
                expected="one x, one y and one likelihood for every body part",
                remedy="rename or remove one of them",
            )
        seen.add(column)
    for name in names:
        lacking = [c for c in COORDINATES if (name, c) not in seen]
        if lacking:
            raise InputError(
                f"The body part '{name}' lacks {', '.join(lacking)}.",
                file=path,
                key=name,
                expected="x, y, likelihood for every body part",
                found=", ".join(c for n, c in columns if n == name),
                remedy="export the keypoints again; the table may have been cut",
            )


def _frame_numbers(index: np.ndarray, path: Path) -> np.ndarray:
    """(R,) whole frame numbers, each once."""
    if len(index) == 0:
        raise InputError(
            "The table has a header but no rows.",
            file=path,
            expected="one row per frame",
            found="0 rows",
            remedy="analyse the video again: the file was cut, or the video was empty",
        )
    frame = np.asarray(index, dtype=float)
    whole = np.isfinite(frame) & (frame >= 0) & (frame == np.floor(frame))
    if not whole.all():
        raise InputError(
            "The first column does not count frames.",
            file=path,
            key=f"row {int(np.argmin(whole))} of the data",
            expected="a whole number ≥ 0 in every row",
            found=f"{frame[np.argmin(whole)]:g}",
            remedy="number the rows 0, 1, 2, … from the start of the recording",
        )
    frames = frame.astype(np.int64)
    unique, counts = np.unique(frames, return_counts=True)
    if len(unique) < len(frames):
        raise InputError(
            f"Frame {unique[counts > 1][0]} has two rows.",
            file=path,
            key="first column",
            expected="each frame once",
            found=f"{int((counts > 1).sum())} of {len(unique)} frames more than once",
            remedy="remove the extra rows; two tables may have been joined",
        )
    if frames.max() >= 10 * len(frames) + _MAX_GAP:
        raise InputError(
            "The frame numbers leave too many gaps to be frame numbers.",
            file=path,
            key="first column",
            expected="0, 1, 2, …",
            found=f"{len(frames)} rows up to number {frames.max()}",
            remedy="number the rows by frame; the column may hold time stamps",
        )
    return frames
