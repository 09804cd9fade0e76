"""Several candidates per marker: all peaks of a network's score maps, not only the highest.

They come from DeepLabCut's ``*_full.pickle`` (what a multi-animal project writes for each video), or from a
long table with one row per candidate, which any detector can write.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.keypoints import Keypoints, check_likelihood
from acino_fte.data_tools.safe_pickle import load_data_pickle
from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

PICKLE_SUFFIXES = (".pickle", ".pkl")
COLUMNS = ("frame", "marker", "candidate", "x", "y", "likelihood")
MAX_CANDIDATES = 5  # of a marker in a frame; what lies beyond is noise of the score map
_MAX_FRAME = 10_000_000
_FRAME = re.compile(r"frame(\d+)")
_FULL = "give the _full.pickle that analyze_videos wrote (not _meta, _assemblies; without use_shelve)"

Peaks = list[tuple[np.ndarray, np.ndarray]]
"""Position (P, 2) px and confidence (P,) of the peaks of each body part in one frame."""


def read_full_pickle(path: Path) -> Keypoints:
    """Read DeepLabCut's ``_full.pickle``: all peaks of every body part.

    Where the file has part affinities they decide together with the confidence which candidate comes first,
    see :func:`support`; the confidences are kept as they are.

    Raises
    ------
    InputError
        The file is no such pickle, or holds anything but data.
    """
    data = load_data_pickle(path.read_bytes(), file=path)
    names, graph = _metadata(data, path)
    frames = {int(m[1]): data[key] for key in data if (m := _FRAME.fullmatch(str(key)))}
    if not frames or max(frames) > _MAX_FRAME:
        raise _fault(path, "frame0, frame1, …", ", ".join(map(str, list(data)[:6])))
    rows = []
    for frame, entry in frames.items():
        if not entry:
            continue
        peaks = _peaks(entry, len(names), path, f"frame{frame}")
        bonus = support(entry.get("costs") or {}, graph, peaks)
        for part, (position, confidence) in enumerate(peaks):
            place = np.broadcast_to([frame, part], (len(position), 2))
            rows.append(np.column_stack([place, position, confidence, confidence * (1 + bonus[part])]))
    table = np.concatenate(rows) if rows else np.empty((0, 6))
    return from_candidates(names, max(frames) + 1, table, path)


def support(costs: dict[Any, Any], graph: list[tuple[int, int]], peaks: Peaks) -> list[np.ndarray]:
    """How well each peak connects to the peaks of its neighbours, from 0 to 1.

    The part affinity of two peaks (Cao et al. 2017, eq. 10) says how well the image between them looks like
    the limb that joins them. A peak's support is the mean over the limbs of its body part of its best
    affinity · confidence of the peak at the other end. Candidates are then put in the order of
    confidence · (1 + support), so that a peak that belongs to the animal may overtake one on the background
    that is up to twice as confident.

    Parameters
    ----------
    costs : dict
        By number of the limb: a dict with ``m1``, the affinities (peaks of one end, peaks of the other).
        Others are ignored, as are affinities of another shape.
    graph : list of (int, int)
        The limbs: pairs of body parts.
    peaks : list of (position, confidence)
        By body part.

    Returns
    -------
    list of (P,)
        By body part.
    """
    sums = [np.zeros(len(confidence)) for _, confidence in peaks]
    limbs = np.zeros(len(peaks))
    for limb, (first, second) in enumerate(graph):
        cost = costs.get(limb)
        if not isinstance(cost, dict) or "m1" not in cost:
            continue
        affinity = np.clip(np.nan_to_num(np.asarray(cost["m1"], dtype=float)), 0.0, 1.0)
        ends = [np.clip(np.nan_to_num(peaks[part][1]), 0.0, 1.0) for part in (first, second)]
        if affinity.size == 0 or affinity.shape != (len(ends[0]), len(ends[1])):
            continue
        sums[first] += (affinity * ends[1]).max(1)
        sums[second] += (affinity * ends[0][:, None]).max(0)
        limbs[[first, second]] += 1
    return [total / max(count, 1) for total, count in zip(sums, limbs, strict=True)]


def is_candidate_table(path: Path) -> bool:
    """Whether a CSV is a table of candidates: its first line names the columns of one."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return {"frame", "marker", "candidate"} <= {c.strip() for c in file.readline().split(",")}


def read_candidate_table(path: Path) -> Keypoints:
    """Read a CSV with the columns frame, marker, candidate, x, y, likelihood, one row per candidate.

    Raises
    ------
    InputError
        A column is missing, a cell is no number, or a candidate comes twice.
    """
    table = _read_table(path)
    frame, candidate = table["frame"].to_numpy(), table["candidate"].to_numpy()
    whole = np.isfinite(frame) & (frame >= 0) & (frame == np.floor(frame)) & (frame <= _MAX_FRAME)
    if not len(table) or not whole.all() or table["marker"].isna().any():
        bad = f"line {2 + int(np.argmin(whole))}" if not whole.all() else None
        raise InputError(
            "The table of candidates has rows without a frame or a marker.",
            file=path,
            key=bad,
            expected="a whole number ≥ 0 under 'frame' and a name under 'marker', in every row",
            found=f"{frame[np.argmin(whole)]:g}" if bad else f"{len(table)} rows",
            remedy="number the frames 0, 1, 2, … from the start of the recording",
        )
    twice = table.duplicated(["frame", "marker", "candidate"]).to_numpy()
    if twice.any():
        first = int(np.argmax(twice))
        raise InputError(
            f"The table gives candidate {candidate[first]:g} of '{table['marker'][first]}' twice in a frame.",
            file=path,
            key=f"line {first + 2}",
            expected="one row per frame, marker and candidate",
            remedy="number the candidates 0, 1, 2, …",
        )
    names = tuple(dict.fromkeys(name.strip() for name in table["marker"]))
    part = table["marker"].str.strip().map({name: i for i, name in enumerate(names)})
    values = table[["x", "y", "likelihood", "likelihood"]].to_numpy(dtype=float)
    rows = np.column_stack([frame, part, values])[np.argsort(candidate, kind="stable")]
    return from_candidates(names, int(frame.max()) + 1, rows, path)


def from_candidates(names: tuple[str, ...], n_frames: int, rows: np.ndarray, path: Path) -> Keypoints:
    """Sort candidates into :class:`Keypoints`.

    Parameters
    ----------
    names : tuple of str
        The K body parts.
    n_frames : int
        N.
    rows : (R, 6)
        Frame, body part, u, v (px), likelihood, and the score that puts the candidates of a body part in
        order; of equal scores the first row wins. Rows that mean "nothing found" are dropped: NaN, (0, 0), a
        negative likelihood.
    path : Path
        For error messages.

    Returns
    -------
    Keypoints
        At most ``MAX_CANDIDATES`` per body part and frame; no candidates if there is never a second one.
    """
    check_likelihood(rows[:, 4], path)
    found = np.isfinite(rows).all(1) & (rows[:, 2:4] != 0).any(1) & (rows[:, 4] >= 0)
    rows = rows[found]
    rows = rows[np.lexsort((-rows[:, 5], rows[:, 1], rows[:, 0]))]
    place = (rows[:, 0] * len(names) + rows[:, 1]).astype(np.int64)
    _, start, counts = np.unique(place, return_index=True, return_counts=True)
    rank = np.arange(len(rows)) - np.repeat(start, counts)
    depth = int(min(counts.max(initial=1), MAX_CANDIDATES))
    shape = (n_frames, len(names), depth)
    position, likelihood = np.full((*shape, 2), np.nan), np.zeros(shape)
    kept = rank < depth
    at = (*np.divmod(place[kept], len(names)), rank[kept])
    position[at], likelihood[at] = rows[kept, 2:4], rows[kept, 4]
    several = {"candidate_position": position, "candidate_likelihood": likelihood} if depth > 1 else {}
    return Keypoints(names, position[:, :, 0].copy(), likelihood[:, :, 0].copy(), path, **several)


def _metadata(data: Any, path: Path) -> tuple[tuple[str, ...], list[tuple[int, int]]]:
    """Names of the body parts, and the limbs as pairs of them."""
    metadata = data.get("metadata") if isinstance(data, dict) else None
    names = metadata.get("all_joints_names") if isinstance(metadata, dict) else None
    if not isinstance(metadata, dict) or not names or not all(isinstance(n, str) for n in names):
        found = ", ".join(map(str, list(data)[:6])) if isinstance(data, dict) else type(data).__name__
        raise _fault(path, "metadata with all_joints_names, then one entry per frame", found)
    if len(set(names)) < len(names):
        raise _fault(path, "each body part once", ", ".join(names))
    return tuple(name.strip() for name in names), list(_limbs(metadata.get("PAFgraph"), len(names)))


def _limbs(graph: Any, n_parts: int) -> Iterator[tuple[int, int]]:
    """The limbs of a PAF graph; none if it is no such list, for nothing then says which costs are whose."""
    pairs = np.asarray(graph if graph is not None else [], dtype=object)
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        return
    if all(isinstance(i, (int, np.integer)) and 0 <= i < n_parts for i in pairs.ravel()):
        yield from ((int(a), int(b)) for a, b in pairs)


def _peaks(entry: Any, n_parts: int, path: Path, key: str) -> Peaks:
    try:
        peaks = [
            (np.asarray(xy, dtype=float).reshape(-1, 2), np.asarray(confidence, dtype=float).reshape(-1))
            for xy, confidence in zip(entry["coordinates"][0], entry["confidence"], strict=True)
        ]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise _fault(path, "coordinates and confidence of every body part", str(error), key) from None
    lengths = [(len(position), len(confidence)) for position, confidence in peaks]
    if len(peaks) != n_parts or any(a != b for a, b in lengths):
        raise _fault(path, f"as many positions as confidences for {n_parts} body parts", str(lengths), key)
    return peaks


def _fault(path: Path, expected: str, found: str, key: str | None = None) -> InputError:
    return InputError(
        "The pickle does not hold DeepLabCut's detections.",
        file=path,
        key=key,
        expected=expected,
        found=found[:200] or "nothing",
        remedy=_FULL,
    )


def _read_table(path: Path) -> pd.DataFrame:
    import pandas as pd

    expected = f"CSV with the columns {', '.join(COLUMNS)}"
    numbers = {c: float for c in COLUMNS if c != "marker"}
    try:
        table = pd.read_csv(path, dtype={"marker": str, **numbers}, skipinitialspace=True)
    except (ValueError, OSError) as error:  # pandas' ParserError and EmptyDataError are ValueErrors
        raise InputError(
            "The table of candidates cannot be read.",
            file=path,
            expected=expected,
            found=str(error),
            remedy="leave the cell empty where nothing was found",
        ) from None
    if not set(COLUMNS) <= set(table.columns):
        raise InputError(
            "The table of candidates lacks a column.",
            file=path,
            expected=expected,
            found=", ".join(map(str, table.columns)),
            remedy="name the columns in its first line",
        )
    return table
