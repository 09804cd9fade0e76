"""Which dot is which animal: 2D tracks of several calibrated cameras matched, and followed in 3D.

>>> from acino_fte.data_tools.load_tracks import load_tracks
>>> matches = match_tracks(load_tracks("recording"))            # doctest: +SKIP
>>> matches.groups[0]      # the animal of every row of the first view, −1 where unknown  # doctest: +SKIP

Tracks decide, not frames: a dot is near many epipolar lines, a track stays near one. In the order of the
work:

0. bare points are joined to pieces of track, within their view (:mod:`dot_linking`) or over all views
   (:mod:`dot_pairs`);
1. every dot's plane angle in every pair of views (:mod:`epipolar_angles`); the noise, from the data
   (:mod:`match_noise`);
2. pieces of tracks that plainly continue one another are stitched within each view (:mod:`track_links`);
3. the evidence between pieces of different views (:mod:`track_evidence`), and how likely a piece has a
partner at
   all (:mod:`track_prior`);
4. groups, one an animal, over all views (:mod:`track_groups`, :mod:`track_reassignment`);
5. pieces that the groups contradict are cut, at encounters (:mod:`track_pieces`) and where another view tells
that
   the animal changed (:mod:`track_changes`), and grouped anew;
6. the groups' 3D paths drop dots that do not belong and claim loose ones (:mod:`track_claims`);
7. the probability of every match (:mod:`match_confidence`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.dot_linking import link_dots
from acino_fte.data_tools.dot_pairs import clearer, link_jointly
from acino_fte.data_tools.epipolar_angles import PlaneAngles, plane_angles, rays_of
from acino_fte.data_tools.match_confidence import Confidence, confidence_of, without_phantoms
from acino_fte.data_tools.match_noise import first_noise, matched_noise
from acino_fte.data_tools.match_options import MatchOptions
from acino_fte.data_tools.track_changes import find_changes
from acino_fte.data_tools.track_claims import claim_loose_dots
from acino_fte.data_tools.track_dots import Dots, Noise
from acino_fte.data_tools.track_evidence import Evidence, animals_in_view, gather_evidence
from acino_fte.data_tools.track_groups import PieceGraph, group_pieces
from acino_fte.data_tools.track_links import link_pieces
from acino_fte.data_tools.track_pieces import PiecedView, cut_at, cut_at_encounters, pieced
from acino_fte.data_tools.track_prior import partner_log_odds
from acino_fte.data_tools.track_reassignment import reassign
from acino_fte.data_tools.tracks2d import BARE, TrackRecording
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.data_tools.trajectories3d import Trajectories

_STITCH = 4.0
_NOISE_CHANGED = 0.04
_FPS = 30.0
_MOST_CUTS, _MOST_NOISE = 4, 4
_LONG, _FAR_SHARE, _FAR_FRAMES = 10, 0.05, 1.0

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class TrackMatches:
    """The animals of a recording. Rows are those of the recording's views.

    Attributes
    ----------
    recording : TrackRecording
    groups : tuple of (P,) int
        For each view: the animal of every row, from 0, in order of their first frames; −1 for none.
    confidence : tuple of (P,)
        For each view: probability that the row's group is right; NaN for none.
    pieces : tuple of (P,) int
        For each view: the piece of track that the row was matched with, −1 for none; a number a piece over
        all views.
    rival, rival_probability : (V,)
        For each piece: the most likely other group (−1: none) and its probability.
    noise : Noise
        Standard deviations of a dot's coordinate, px.
    trajectories : Trajectories, optional
        The 3D paths, when they were followed.
    """

    recording: TrackRecording
    groups: tuple[np.ndarray, ...]
    confidence: tuple[np.ndarray, ...]
    pieces: tuple[np.ndarray, ...]
    rival: np.ndarray
    rival_probability: np.ndarray
    noise: Noise
    trajectories: Trajectories | None = None

    @property
    def n_groups(self) -> int:
        """Number of animals."""
        return max((int(group.max(initial=-1)) for group in self.groups), default=-1) + 1


def match_tracks(
    recording: TrackRecording, options: MatchOptions | None = None, progress: Progress | None = None
) -> TrackMatches:
    """Match the tracks of all views.

    Parameters
    ----------
    recording : TrackRecording
        Two views or more.
    options : MatchOptions, optional
        By default everything is estimated.
    progress : callable, optional
        Called with the name of every step.

    Raises
    ------
    InputError
        There are fewer than two views with dots, or no two cameras stand apart.
    """
    options = options or MatchOptions()
    tell = progress or (lambda step: None)
    matching = _Matching(recording, options)
    if any((track == BARE).any() for track in matching.tracks):
        tell("joining bare points")
        matching.link_bare_points()
    tell("noise")
    matching.estimate_noise(options.noise_px)
    tell("stitching within views")
    matching.stitch()
    tell("matching")
    matching.group()
    for _ in range(_MOST_NOISE):
        if not matching.renew_noise(options.noise_px):
            break
        matching.group()
    for cut in range(_MOST_CUTS):
        doubtful = matching.contradicted()
        if not any(view.any() for view in doubtful):
            break
        tell("cutting tracks that change hands")
        if not matching.cut(doubtful, at_encounters=cut == 0):
            break
        matching.group()
    tell("confidence")
    return matching.result(tell)


class _Matching:
    """A matching under way: the views in pieces, and the groups of the pieces so far."""

    def __init__(self, recording: TrackRecording, options: MatchOptions) -> None:
        _check(recording)
        self.recording, self.options = recording, options
        self.tracks = [v.track if options.tracks else np.full(len(v), BARE) for v in recording.views]
        self.views: list[PiecedView] = self._pieced(self.tracks)
        self.max_gap = max(1, round(options.max_gap_s * (recording.fps or _FPS)))
        self.angles = self._plane_angles()
        self.noise = Noise(1.0)
        self.evidence: dict[tuple[int, int], Evidence] = {}
        self.label, self.prior = np.empty(0, dtype=np.int64), np.empty(0)
        self.graph: PieceGraph | None = None

    def _pieced(self, tracks: list[np.ndarray]) -> list[PiecedView]:
        first = self.recording.first_frame
        return [
            pieced(view.frame - first, track, view.xy)
            for view, track in zip(self.recording.views, tracks, strict=True)
        ]

    def link_bare_points(self) -> None:
        """Bare points to pieces of track: within each view, and over all of them where that joins more."""
        views, first = self.recording.views, self.recording.first_frame
        bare = [np.flatnonzero(track == BARE) for track in self.tracks]
        frames = [view.frame[rows] - first for view, rows in zip(views, bare, strict=True)]
        xys = [view.xy[rows] for view, rows in zip(views, bare, strict=True)]
        single = [link_dots(*dots, self.options.noise_px) for dots in zip(frames, xys, strict=True)]
        self.views = self._pieced(_with_pieces(self.tracks, bare, single))
        self.estimate_noise(self.options.noise_px)
        joint = link_jointly(self.recording.cameras, frames, xys, self.noise.total)
        pieces = [clearer(one, all_) for one, all_ in zip(single, joint, strict=True)]
        self.tracks = _with_pieces(self.tracks, bare, pieces)
        self.views = self._pieced(self.tracks)

    def _plane_angles(self) -> dict[tuple[int, int], tuple[PlaneAngles, PlaneAngles]]:
        cameras = self.recording.cameras
        rays = [rays_of(c, v.frame, v.xy) for c, v in zip(cameras, self.views, strict=True)]
        angles = {}
        for a, b in combinations(range(len(cameras)), 2):
            frames = self.views[a].frame, self.views[b].frame
            found = plane_angles(cameras, a, b, frames, (rays[a], rays[b]))
            if found is not None:
                angles[a, b] = found
        if not angles:
            raise InputError(
                "No two cameras stand apart: their centres are one.",
                found=", ".join(cameras.names),
                remedy="check the translations of the camera file; a point needs two places to be seen from",
            )
        return angles

    @property
    def offsets(self) -> np.ndarray:
        """Number of the first piece of each view, over all views."""
        return np.cumsum([0] + [view.n_pieces for view in self.views])

    def dots(self, pair: tuple[int, int]) -> tuple[Dots, Dots]:
        """The two views of a pair with their plane angles."""
        a, b = (
            Dots(self.views[k].frame, self.views[k].piece, self.views[k].n_pieces, angles)
            for k, angles in zip(pair, self.angles[pair], strict=True)
        )
        return a, b

    def estimate_noise(self, given: float | None) -> None:
        """Noise before matching, unless it is given."""
        if given is not None:
            self.noise = Noise(given)
            return
        diagonal = float(np.median([np.hypot(*camera.resolution) for camera in self.recording.cameras]))
        found = first_noise([self.dots(pair) for pair in self.angles], diagonal)
        if found is not None:
            self.noise = found

    def stitch(self) -> None:
        """Join pieces that plainly continue one another within each view."""
        for k, view in enumerate(self.views):
            if not view.n_pieces:
                continue
            pieces = view.by_piece()
            graph = PieceGraph(
                np.zeros(pieces.n, dtype=np.int64),
                pieces.first,
                pieces.last,
                *link_pieces(pieces, self.noise.total, self.max_gap),
            )
            label = group_pieces(graph, _STITCH)
            joined = np.where(view.piece >= 0, label[view.piece], -1)
            self.views[k] = replace(view, piece=joined, n_pieces=int(label.max()) + 1)

    def group(self) -> None:
        """Gather the evidence and group the pieces of all views."""
        self.evidence = {pair: gather_evidence(*self.dots(pair), self.noise) for pair in self.angles}
        self.graph = self._graph()
        self.label = reassign(self.graph, group_pieces(self.graph))

    def _graph(self) -> PieceGraph:
        offsets = self.offsets
        pieces = [view.by_piece() for view in self.views]
        view = np.repeat(np.arange(len(pieces)), [p.n for p in pieces])
        first, last = np.concatenate([p.first for p in pieces]), np.concatenate([p.last for p in pieces])
        n_dots = np.concatenate([np.diff(p.start) for p in pieces])
        u = np.concatenate([e.a + offsets[a] for (a, _), e in self.evidence.items()])
        v = np.concatenate([e.b + offsets[b] for (_, b), e in self.evidence.items()])
        weight = np.concatenate([e.weight for e in self.evidence.values()])
        price = float(
            np.log(np.mean([animals_in_view(dots) for pair in self.angles for dots in self.dots(pair)]))
        )
        prior = partner_log_odds(n_dots, u, v, weight - price, len(pieces))
        self.prior = prior
        edges = [(u, v, weight + prior[u] + prior[v])]
        for k, p in enumerate(pieces):
            if p.n:
                earlier, later, odds = link_pieces(p, self.noise.total, self.max_gap)
                edges.append((earlier + offsets[k], later + offsets[k], odds))
        joint = (np.concatenate(part) for part in zip(*edges, strict=True))
        return PieceGraph(view, first, last, *joint, price)

    def renew_noise(self, given: float | None) -> bool:
        """Noise of what is matched; whether it is another."""
        if given is not None:
            return False
        offsets, before = self.offsets, self.noise
        partners = [
            self.label[e.a + offsets[a]] == self.label[e.b + offsets[b]]
            for (a, b), e in self.evidence.items()
        ]
        self.noise = matched_noise(list(self.evidence.values()), partners, before)
        change = max(
            abs(np.log(self.noise.total / before.total)),
            abs(self.noise.slow - before.slow) / self.noise.total,
        )
        return change > _NOISE_CHANGED

    def contradicted(self) -> list[np.ndarray]:
        """For each view: pieces that other views of their group contradict, and long ones that match none."""
        offsets = self.offsets
        shared, far = np.zeros(len(self.label)), np.zeros(len(self.label))
        for (a, b), e in self.evidence.items():
            u, v = e.a + offsets[a], e.b + offsets[b]
            joined = self.label[u] == self.label[v]
            for piece in (u[joined], v[joined]):
                shared += np.bincount(piece, weights=e.shared[joined], minlength=len(shared))
                far += np.bincount(piece, weights=(e.shared - e.near)[joined], minlength=len(shared))
        n_dots = np.concatenate([np.diff(view.by_piece().start) for view in self.views])
        doubtful = (far > _FAR_SHARE * shared + _FAR_FRAMES) | ((shared == 0) & (n_dots >= _LONG))
        return [doubtful[offsets[k] : offsets[k + 1]] for k in range(len(self.views))]

    def cut(self, doubtful: list[np.ndarray], at_encounters: bool) -> bool:
        """Cut doubtful pieces; whether any was."""
        before = [view.piece for view in self.views]
        if at_encounters:
            radius = self.options.encounter * self.noise.total
            self.views = [
                cut_at_encounters(view, which, radius)
                for view, which in zip(self.views, doubtful, strict=True)
            ]
        else:
            cuts: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in self.views]
            for pair in self.angles:
                for side, k in enumerate(pair):
                    cuts[k].append(find_changes(self.dots(pair), side, self.noise, doubtful[k]))
            self.views = [
                cut_at(view, *(np.concatenate(part) for part in zip(*cut, strict=True))) if cut else view
                for view, cut in zip(self.views, cuts, strict=True)
            ]
        return any(not np.array_equal(old, new.piece) for old, new in zip(before, self.views, strict=True))

    def result(self, tell: Progress) -> TrackMatches:
        """Confidence, 3D paths and what leaves the function."""
        assert self.graph is not None
        confidence = without_phantoms(confidence_of(self.graph, self.label), self.label, self.prior)
        group = _number_groups(self.graph, self.label, confidence, self.options.min_confidence)
        offsets = self.offsets
        found, sure, pieces = [], [], []
        for k, view in enumerate(self.views):
            piece = np.where(view.piece >= 0, view.piece + offsets[k], -1)
            inverse = np.empty(len(piece), dtype=np.int64)
            inverse[view.order] = np.arange(len(piece))
            pieces.append(piece[inverse])
            found.append(_of_piece(group, pieces[k], -1))
            sure.append(np.where(found[k] >= 0, _of_piece(confidence.probability, pieces[k], np.nan), np.nan))
        of_label = np.full(len(self.label), -1)
        of_label[self.label[group >= 0]] = group[group >= 0]
        rival = np.where(confidence.rival >= 0, of_label[confidence.rival], -1)
        matches = TrackMatches(
            self.recording,
            tuple(found),
            tuple(sure),
            tuple(pieces),
            rival,
            np.where(rival >= 0, confidence.rival_probability, 0.0),
            self.noise,
        )
        if self.options.follow and matches.n_groups:
            tell("3D paths")
            matches = claim_loose_dots(matches, self.max_gap)
        return matches


def _with_pieces(
    tracks: list[np.ndarray], bare: list[np.ndarray], pieces: list[np.ndarray]
) -> list[np.ndarray]:
    """Tracks of every view with pieces of bare points after them."""
    joined = []
    for track, rows, piece in zip(tracks, bare, pieces, strict=True):
        whole = track.copy()
        whole[rows] = np.where(piece >= 0, piece + track.max(initial=BARE) + 1, BARE)
        joined.append(whole)
    return joined


def _of_piece(values: np.ndarray, piece: np.ndarray, otherwise: float) -> np.ndarray:
    """The value of every dot's piece, or another for dots in no piece."""
    return np.append(values, np.asarray(otherwise, dtype=values.dtype))[piece]  # piece −1 is the last


def _number_groups(graph: PieceGraph, label: np.ndarray, confidence: Confidence, least: float) -> np.ndarray:
    """Group of every piece from 0 by first frame; −1 for improbable pieces and for groups of one view."""
    kept = confidence.probability >= least  # False for NaN
    views = np.unique(np.stack([label[kept], graph.view[kept]], axis=1), axis=0)[:, 0]
    several = np.bincount(views, minlength=len(label)) >= 2
    kept &= several[label]
    begin = np.full(len(label), np.iinfo(np.int64).max)
    np.minimum.at(begin, label[kept], graph.first[kept])
    used = np.unique(label[kept])
    number = np.full(len(label), -1)
    number[used[np.argsort(begin[used], kind="stable")]] = np.arange(len(used))
    return np.where(kept, number[label], -1)


def _check(recording: TrackRecording) -> None:
    seeing = [view.camera for view in recording.views if len(view)]
    if len(seeing) < 2:
        raise InputError(
            f"Recording '{recording.name}' cannot be matched: fewer than two cameras have dots.",
            expected="2D tracks of two cameras or more",
            found=", ".join(seeing) or "none",
            remedy="check that each track file belongs to a camera of the camera file",
        )
