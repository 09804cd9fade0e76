"""How well rows of several views were matched, against the true animals.

A matching gives every row of a view a group, −1 for none; rows of one group are claimed to be one animal. A
pair is two rows of different views in the same frame with the same group. It is right when both rows are of
the same animal. Shapes: P rows of one view, A animals, V views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from acino_fte.errors import InputError

from .match_rows import common, compact, counted, triangulate_pairs, true_points
from .tracks2d import TrackRecording, Tracks2D


@dataclass(frozen=True)
class PairScore:
    """Counts for one pair of views, or pooled over pairs, and what follows from them.

    Attributes
    ----------
    first, second : str
        Names of the views; ``"all"`` when pooled.
    accepted : int
        Pairs that the matching makes.
    right : int
        Those of them whose rows are of the same animal; a pair with clutter is wrong.
    possible : int
        Pairs that a perfect matching makes: animals that both views see in a frame, over all frames.
    rows : int
        Rows of the first view, clutter included.
    shared_rows : int
        Rows of the first view whose animal the second view sees in that frame.
    trajectories : int
        Animals that both views see in at least one frame together.
    right_trajectories : int
        Those of them that are right as a whole, see :func:`score_matching`.
    errors_mm : (K,) or None
        Distance of the triangulated right pairs to the true positions; None without truth in 3D.
    """

    first: str
    second: str
    accepted: int
    right: int
    possible: int
    rows: int
    shared_rows: int
    trajectories: int
    right_trajectories: int
    errors_mm: np.ndarray | None = None

    @property
    def precision(self) -> float:
        """Right pairs over accepted pairs; the pairing accuracy of the thesis. NaN without pairs."""
        return _ratio(self.right, self.accepted)

    @property
    def recall(self) -> float:
        """Right pairs over possible pairs."""
        return _ratio(self.right, self.possible)

    @property
    def udr(self) -> float:
        """Used-data ratio: accepted pairs over rows of the first view."""
        return _ratio(self.accepted, self.rows)

    @property
    def udr_ceiling(self) -> float:
        """The used-data ratio of a perfect matching."""
        return _ratio(self.shared_rows, self.rows)

    @property
    def trajectories_right(self) -> float:
        """Share of the trajectories that are right as a whole."""
        return _ratio(self.right_trajectories, self.trajectories)

    def as_dict(self) -> dict[str, Any]:
        """Numbers for JSON; None where a ratio has no denominator."""
        numbers: dict[str, Any] = {
            "pairing_accuracy": _json(self.precision),
            "recall": _json(self.recall),
            "udr": _json(self.udr),
            "udr_ceiling": _json(self.udr_ceiling),
            "trajectories_right": _json(self.trajectories_right),
            "pairs_accepted": self.accepted,
            "pairs_right": self.right,
            "pairs_possible": self.possible,
            "rows_first_view": self.rows,
            "trajectories": self.trajectories,
        }
        if self.errors_mm is not None:
            e = self.errors_mm[np.isfinite(self.errors_mm)]
            numbers["right_pair_error_mm"] = {
                "mean": float(e.mean()) if e.size else None,
                "median": float(np.median(e)) if e.size else None,
                "p95": float(np.quantile(e, 0.95)) if e.size else None,
                "count": int(e.size),
            }
        return numbers


@dataclass(frozen=True)
class MatchScore:
    """A matching of any number of views against the truth; definitions in :func:`score_matching`.

    Attributes
    ----------
    pooled : PairScore
        Counts summed over the pairs of views. Its trajectories are judged over all views at once.
    pairs : tuple of PairScore
        Every pair of views, in the order of the views.
    identity_switches : int
    fragments_per_animal : float
    purity : float
    """

    pooled: PairScore
    pairs: tuple[PairScore, ...]
    identity_switches: int
    fragments_per_animal: float
    purity: float

    def as_dict(self) -> dict[str, Any]:
        """Numbers for JSON: the pooled ones, and under ``pairs`` those of every pair of views."""
        return {
            **self.pooled.as_dict(),
            "identity_switches": self.identity_switches,
            "fragments_per_animal": _json(self.fragments_per_animal),
            "purity": _json(self.purity),
            "pairs": [{"views": [p.first, p.second], **p.as_dict()} for p in self.pairs],
        }


def score_matching(
    recording: TrackRecording, groups: Sequence[np.ndarray], *, errors_3d: bool = True
) -> MatchScore:
    """Score a matching of a recording with known animals.

    Pairs are counted as in the module's docstring. Besides,

    - a *trajectory* is an animal that two views see in at least one common frame. Its majority group in a
      view is the group that most of its matched rows there have (the smallest at a tie). The trajectory is
      right when all views that see the animal agree in it, and no other animal has it in any view;
    - *identity switches* are changes of group along the matched rows of one animal in one view, in the order
      of frames, summed over animals and views. Unmatched rows between are passed over (Bernardin and
      Stiefelhagen 2008, mismatches);
    - *fragments per animal* are the different groups among its matched rows in all views, as a mean over the
      animals with a matched row; 1 is best;
    - *purity* is the share of the matched rows that are of the most frequent animal of their group (Manning,
      Raghavan and Schütze 2008, equation 16.1). Clutter is never the most frequent.

    Parameters
    ----------
    recording : TrackRecording
        All views with their `animal`.
    groups : V arrays (P,) int
        Group of every row of every view; −1 for none.
    errors_3d : bool
        With truth in 3D, triangulate the right pairs and compare.

    Raises
    ------
    InputError
        A view has no truth, or the groups do not have the shape of its rows.
    """
    views = recording.views
    _check(views, groups)
    table = _Table.of(views, groups)
    together = np.zeros((len(views), table.n_animals), dtype=bool)
    majority = np.stack([table.majority(v) for v in range(len(views))])
    pairs = []
    for a, b in combinations(range(len(views)), 2):
        shared = table.seen_by_both(a, b)
        together[a] |= shared
        together[b] |= shared
        errors = _pair_errors(recording, table, a, b) if errors_3d else None
        names = views[a].camera, views[b].camera
        pairs.append(PairScore(*names, *table.counts(a, b), *_right(majority[[a, b]], shared), errors))
    return MatchScore(
        _pooled(pairs, _right(majority, together)),
        tuple(pairs),
        sum(table.switches(v) for v in range(len(views))),
        *table.clusters(),
    )


@dataclass(frozen=True)
class _Table:
    """Compact integers: for every view frame, group and animal from 0, and −1; and the counted keys of each.

    A key is frame · n + value. Counted keys are (sorted unique keys, how often).
    """

    frame: list[np.ndarray]
    group: list[np.ndarray]
    animal: list[np.ndarray]
    n_groups: int
    n_animals: int
    by_group: list[tuple[np.ndarray, np.ndarray]]
    by_both: list[tuple[np.ndarray, np.ndarray]]
    by_animal: list[tuple[np.ndarray, np.ndarray]]

    @classmethod
    def of(cls, views: Sequence[Tracks2D], groups: Sequence[np.ndarray]) -> _Table:
        """Number frames, groups and animals of all views together, and count."""
        frame, _ = compact([view.frame for view in views], signed=True)
        group, n_groups = compact(groups)
        animal, n_animals = compact([np.asarray(view.animal) for view in views])
        by_group, by_both, by_animal = [], [], []
        for f, g, k in zip(frame, group, animal, strict=True):
            matched, real = g >= 0, k >= 0
            both = matched & real
            by_group.append(counted(f[matched] * n_groups + g[matched]))
            by_both.append(counted((f[both] * n_groups + g[both]) * n_animals + k[both]))
            by_animal.append(counted(f[real] * n_animals + k[real]))
        return cls(frame, group, animal, n_groups, n_animals, by_group, by_both, by_animal)

    def counts(self, a: int, b: int) -> tuple[int, int, int, int, int]:
        """Accepted, right and possible pairs, rows of view a, and those whose animal view b sees."""
        place_a, place_b = common(self.by_animal[a][0], self.by_animal[b][0])
        return (
            _product(self.by_group[a], self.by_group[b]),
            _product(self.by_both[a], self.by_both[b]),
            int(np.minimum(self.by_animal[a][1][place_a], self.by_animal[b][1][place_b]).sum()),
            len(self.frame[a]),
            int(self.by_animal[a][1][place_a].sum()),
        )

    def seen_by_both(self, a: int, b: int) -> np.ndarray:
        """(A,) bool: whether both views see the animal in some frame."""
        keys = self.by_animal[a][0]
        seen = np.zeros(self.n_animals, dtype=bool)
        seen[keys[common(keys, self.by_animal[b][0])[0]] % max(self.n_animals, 1)] = True
        return seen

    def majority(self, view: int) -> np.ndarray:
        """(A,) the group that most matched rows of an animal have in a view; −1 when none is matched."""
        group, animal = self.group[view], self.animal[view]
        use = (group >= 0) & (animal >= 0)
        keys, count = counted(animal[use] * self.n_groups + group[use])
        best = np.full(self.n_animals, -1)
        order = np.lexsort((keys, -count))[::-1]  # the most frequent, then the smallest, is written last
        best[keys[order] // max(self.n_groups, 1)] = keys[order] % max(self.n_groups, 1)
        return best

    def switches(self, view: int) -> int:
        """Changes of group along the matched rows of an animal."""
        use = np.flatnonzero((self.group[view] >= 0) & (self.animal[view] >= 0))
        order = use[np.lexsort((self.frame[view][use], self.animal[view][use]))]
        group, animal = self.group[view][order], self.animal[view][order]
        return int(((np.diff(group) != 0) & (np.diff(animal) == 0)).sum())

    def clusters(self) -> tuple[float, float]:
        """Groups per matched animal, and the purity of the groups."""
        group, animal = np.concatenate(self.group), np.concatenate(self.animal)
        use = (group >= 0) & (animal >= 0)
        keys, count = counted(group[use] * self.n_animals + animal[use])
        largest = np.zeros(self.n_groups, dtype=int)
        np.maximum.at(largest, keys // max(self.n_animals, 1), count)
        matched_animals = len(np.unique(keys % max(self.n_animals, 1)))
        return _ratio(len(keys), matched_animals), _ratio(int(largest.sum()), int((group >= 0).sum()))


def _product(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> int:
    place_a, place_b = common(a[0], b[0])
    return int((a[1][place_a] * b[1][place_b]).sum())


def _right(majority: np.ndarray, together: np.ndarray) -> tuple[int, int]:
    """Trajectories, and those right as a whole.

    `majority` is (V, A). `together` is (V, A) or (A,): whether a view sees the animal together with another.
    """
    together = np.broadcast_to(together, majority.shape)
    judged = together.any(0)
    highest = np.where(together, majority, -1).max(0, initial=-1)
    agree = judged & (highest >= 0) & (~together | (majority == highest)).all(0)
    view, animal = np.nonzero(majority >= 0)
    claims = np.unique(np.stack([majority[view, animal], animal], axis=1), axis=0)
    claimed, count = np.unique(claims[:, 0], return_counts=True)
    return int(judged.sum()), int((agree & ~np.isin(highest, claimed[count > 1])).sum())


def _pooled(pairs: list[PairScore], trajectories: tuple[int, int]) -> PairScore:
    names = ("accepted", "right", "possible", "rows", "shared_rows")
    sums = {name: sum(getattr(pair, name) for pair in pairs) for name in names}
    known = [pair.errors_mm for pair in pairs if pair.errors_mm is not None]
    judged, right = trajectories
    return PairScore(
        "all",
        "all",
        **sums,
        trajectories=judged,
        right_trajectories=right,
        errors_mm=np.concatenate(known) if known else None,
    )


def _pair_errors(recording: TrackRecording, table: _Table, a: int, b: int) -> np.ndarray | None:
    """(K,) distance in mm of triangulated right pairs to the truth; NaN where one is missing."""
    truth = recording.truth_3d
    if truth is None:
        return None
    rows = [_first_rows(table, view) for view in (a, b)]
    places = common(*(keys for keys, _ in rows))
    row_a, row_b = (rows[i][1][places[i]] for i in (0, 1))
    points = triangulate_pairs(recording, (a, b), (row_a, row_b))
    view = recording.views[a]
    true = true_points(truth, view.frame[row_a], np.asarray(view.animal)[row_a])
    return 1000.0 * np.linalg.norm(points - true, axis=-1)


def _first_rows(table: _Table, view: int) -> tuple[np.ndarray, np.ndarray]:
    """The keys (frame, group, animal) of a view, sorted, and a row of each."""
    use = np.flatnonzero((table.group[view] >= 0) & (table.animal[view] >= 0))
    frame, group, animal = (column[view][use] for column in (table.frame, table.group, table.animal))
    keys, first = np.unique((frame * table.n_groups + group) * table.n_animals + animal, return_index=True)
    return keys, use[first]


def _check(views: Sequence[Tracks2D], groups: Sequence[np.ndarray]) -> None:
    if len(views) != len(groups):
        raise InputError(
            "The matching and the recording have different numbers of views.",
            expected=f"{len(views)} arrays of groups",
            found=str(len(groups)),
        )
    for view, group in zip(views, groups, strict=True):
        if view.animal is None:
            raise InputError(
                f"View '{view.camera}' has no true animals to score with.",
                file=view.path,
                remedy="put the truth beside the tracks, or do not score",
            )
        if np.shape(group) != (len(view),):
            raise InputError(
                f"The groups of view '{view.camera}' do not belong to its rows.",
                expected=f"({len(view)},)",
                found=str(np.shape(group)),
            )


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _json(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
