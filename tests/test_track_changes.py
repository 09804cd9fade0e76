"""Tracks that change hands: cut at encounters, and where another view tells."""

from dataclasses import replace

import numpy as np
import pytest
from test_track_evidence import SLOPE, dots

from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_changes import find_changes
from acino_fte.data_tools.track_evidence import Noise
from acino_fte.data_tools.track_matching import MatchOptions, match_tracks
from acino_fte.data_tools.track_pieces import cut_at, cut_at_encounters, pieced

NOISE = Noise(2.0)
N = 200


def crossing(meet: int, missed=()):
    """Two dots that meet in one frame, 8 px a frame apart before and after, and one far away."""
    frame = np.arange(N)
    away = 8.0 * np.abs(frame - meet)
    paths = np.stack(
        [
            np.column_stack([away, np.full(N, 100.0)]),
            np.column_stack([-away, np.full(N, 100.0)]),
            np.column_stack([frame * 1.0, np.full(N, 900.0)]),
        ]
    )
    there = np.ones((3, N), dtype=bool)
    for who, when in missed:
        there[who, when] = False
    who, when = np.nonzero(there)
    return when, who, paths[there]


def lasting(view):
    """First and last frame and track of every piece."""
    out = []
    for k in range(view.n_pieces):
        rows = np.flatnonzero(view.piece == k)
        out.append((int(view.frame[rows].min()), int(view.frame[rows].max())))
    return sorted(out)


def test_pieces_are_the_tracks_and_bare_points_have_none():
    frame, track = np.array([3, 0, 0, 5, 3]), np.array([7, 7, -1, 4, -1])
    view = pieced(frame, track, np.arange(10.0).reshape(5, 2))
    assert view.frame.tolist() == [0, 0, 3, 3, 5]
    assert view.order.tolist() == [1, 2, 0, 4, 3]
    assert view.piece.tolist() == [1, -1, 1, -1, 0]
    by_piece = view.by_piece()
    assert by_piece.first.tolist() == [5, 0]
    assert by_piece.last.tolist() == [5, 3]


def test_cut_at_an_encounter():
    """Within 20 px, 2·8·|t − 100| < 20: frames 99–101 are in no piece; the third track is whole."""
    view = cut_at_encounters(pieced(*crossing(100)), np.ones(3, dtype=bool), 20.0)
    assert lasting(view) == [(0, 98), (0, 98), (0, N - 1), (102, N - 1), (102, N - 1)]
    assert sorted(view.frame[view.piece < 0].tolist()) == [99, 99, 100, 100, 101, 101]


def test_only_doubtful_pieces_are_cut():
    view = cut_at_encounters(pieced(*crossing(100)), np.array([True, False, False]), 20.0)
    assert lasting(view) == [(0, 98), (0, N - 1), (0, N - 1), (102, N - 1)]
    whole = pieced(*crossing(100))
    assert cut_at_encounters(whole, np.zeros(3, dtype=bool), 20.0) is whole


def test_an_encounter_with_a_dot_that_was_missed():
    """The other animal is not seen for three frames about the meeting, and taken to have been 16 px away."""
    view = cut_at_encounters(
        pieced(*crossing(100, [(1, slice(99, 102))])), np.array([True, False, False]), 20.0
    )
    assert lasting(view) == [(0, 99), (0, N - 1), (0, N - 1), (101, N - 1)]


def test_cut_before_frames():
    view = cut_at(pieced(*crossing(100)), np.array([0, 0, 2]), np.array([50, 120, 7]))
    assert lasting(view) == [(0, 6), (0, 49), (0, N - 1), (7, N - 1), (50, 119), (120, N - 1)]
    assert (view.piece >= 0).all()
    untouched = cut_at(pieced(*crossing(100)), np.zeros(0, dtype=int), np.zeros(0, dtype=int))
    assert lasting(untouched) == [(0, N - 1)] * 3


def test_a_view_without_pieces_is_left_alone():
    view = pieced(np.arange(5), np.full(5, -1), np.zeros((5, 2)))
    assert view.n_pieces == 0
    assert cut_at_encounters(view, np.zeros(0, dtype=bool), 20.0).n_pieces == 0
    assert cut_at(view, np.zeros(0, dtype=int), np.zeros(0, dtype=int)).n_pieces == 0


def exchanged(change: int, gap: int = 0, seed: int = 0, n: int = N):
    """Four animals; the tracks 0 and 1 of the first view change hands, the second view's do not."""
    rng = np.random.default_rng(seed)
    planes = rng.uniform(0, 0.4, 4)[:, None] + np.cumsum(rng.normal(0, 4 * SLOPE, (4, n)), axis=1)
    planes[:, 0] = [0.0, 0.1, 0.2, 0.3]
    views = []
    for side in (0, 1):
        frame, piece = np.tile(np.arange(n), 4), np.repeat(np.arange(4), n)
        angle = (planes + rng.normal(0, NOISE.white * SLOPE, planes.shape)).ravel()
        if side == 0:
            piece = np.where((frame >= change) & (piece < 2), 1 - piece, piece)
            keep = (piece > 1) | (frame < change) | (frame >= change + gap)
            frame, piece, angle = frame[keep], piece[keep], angle[keep]
        views.append(dots(frame, piece, angle))
    return views[0], views[1]


@pytest.mark.parametrize("gap", [0, 10])
@pytest.mark.parametrize("seed", range(4))
def test_an_exchange_is_found_where_it_was(seed, gap):
    pair = exchanged(90, gap, seed)
    piece, frame = find_changes(pair, 0, NOISE, np.ones(4, dtype=bool))
    assert sorted(piece.tolist()) == [0, 1]
    assert (np.abs(frame - (90 + gap)) <= 2).all()
    piece, frame = find_changes(pair[::-1], 1, NOISE, np.ones(4, dtype=bool))  # the view may be the second
    assert sorted(piece.tolist()) == [0, 1]


def test_seen_from_the_other_view_its_tracks_change_too():
    """Nothing tells which of the two views is wrong: both sides are cut at one time."""
    piece, frame = find_changes(exchanged(90), 1, NOISE, np.ones(4, dtype=bool))
    assert sorted(piece.tolist()) == [0, 1]
    assert (np.abs(frame - 90) <= 2).all()


def test_tracks_that_keep_their_animal_are_not_cut():
    for seed in range(5):
        piece, _ = find_changes(exchanged(0, 0, seed), 0, NOISE, np.ones(4, dtype=bool))
        assert len(piece) == 0


def test_only_doubtful_pieces_are_looked_at():
    piece, _ = find_changes(exchanged(90), 0, NOISE, np.array([False, True, True, True]))
    assert piece.tolist() == [1]


def test_a_visit_of_one_frame_is_no_change():
    """It brings less than two changes cost."""
    a, b = exchanged(0)
    piece = np.where((a.frame == 90) & (a.piece < 2), 1 - a.piece, a.piece)
    found, _ = find_changes((replace(a, piece=piece), b), 0, NOISE, np.ones(4, dtype=bool))
    assert len(found) == 0


@pytest.mark.parametrize("motion", ["smooth", "jumpy"])
def test_a_recording_with_exchanges(motion):
    """Pieces that were matched hold one animal each, nearly always."""
    recording = simulate_tracks(
        TrackSimulation(motion=motion, n_animals=15, n_frames=400, swap_px=10.0, missed=0.05, seed=51)
    )
    matches = match_tracks(recording, MatchOptions(follow=False))
    pure = total = 0
    for view, piece, group in zip(recording.views, matches.pieces, matches.groups, strict=True):
        for k in np.unique(piece[group >= 0]):
            _, count = np.unique(view.animal[piece == k], return_counts=True)
            pure, total = pure + count.max(), total + count.sum()
    assert pure >= 0.985 * total
