"""Bare dots joined over two views: pieces hold one animal where one view alone leaves nearly all open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_t

from acino_fte.data_tools.dot_linking import link_dots
from acino_fte.data_tools.dot_pairs import clearer, link_jointly
from acino_fte.data_tools.match_metrics import score_matching
from acino_fte.data_tools.match_options import MatchOptions
from acino_fte.data_tools.pair_candidates import find_pairs
from acino_fte.data_tools.pair_motion import _density
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_matching import match_tracks
from acino_fte.triangulate import triangulate


def _recording(**options):
    return simulate_tracks(TrackSimulation(**{"tracks": "bare", "n_frames": 100, "seed": 5, **options}))


def _joined(recording, noise_px=3.0):
    frames = [view.frame - recording.first_frame for view in recording.views]
    return link_jointly(recording.cameras, frames, [view.xy for view in recording.views], noise_px)


def _right_links(view, piece):
    """Share of the links that are right, and links over the rows of animals."""
    order = np.lexsort((view.frame, piece))
    order = order[piece[order] >= 0]
    linked = np.diff(piece[order]) == 0
    animal = view.animal[order]
    right = linked & (np.diff(animal) == 0) & (animal[1:] >= 0)
    return right.sum() / max(linked.sum(), 1), linked.sum() / (view.animal >= 0).sum()


@pytest.mark.parametrize(
    ("options", "purity", "linked"),
    [
        ({"motion": "jumpy", "n_animals": 20}, 0.98, 0.88),
        ({"motion": "smooth", "n_animals": 15}, 0.98, 0.9),
        ({"motion": "jumpy", "n_animals": 8, "missed": 0.1, "clutter": 0.1}, 0.98, 0.6),
        ({"motion": "jumpy", "n_animals": 8, "rig": "ring", "n_cameras": 3, "moving": True}, 0.98, 0.9),
        ({"motion": "smooth", "n_animals": 8, "rig": "ring", "lens": "fisheye"}, 0.98, 0.9),
    ],
)
def test_links_are_right_and_most_are_made(options, purity, linked):
    recording = _recording(**options)
    for view, piece in zip(recording.views, _joined(recording), strict=True):
        right, made = _right_links(view, piece)
        assert right >= purity
        assert made >= linked


def test_two_views_link_what_one_leaves_open():
    recording = _recording(motion="smooth", n_animals=20)
    view = recording.views[0]
    single, joint = link_dots(view.frame, view.xy), _joined(recording)[0]
    assert _right_links(view, single)[1] < 0.5 < 0.85 < _right_links(view, joint)[1]
    assert clearer(single, joint) is joint and clearer(joint, single) is joint


def test_matching_with_joint_pieces_finds_more_than_with_those_of_one_view():
    recording = _recording(motion="smooth", n_animals=20)
    pieces = _joined(recording)
    views = tuple(
        replace(view, track=piece, labels=tuple(map(str, range(piece.max() + 1))))
        for view, piece in zip(recording.views, pieces, strict=True)
    )
    options = MatchOptions(noise_px=3.0)
    joint = match_tracks(replace(recording, views=views), options)
    score = score_matching(recording, joint.groups).pooled
    assert score.precision > 0.97 and score.recall > 0.9


def test_one_piece_never_has_two_dots_in_a_frame_and_order_of_rows_is_no_matter():
    recording = _recording(motion="jumpy", n_animals=10, clutter=0.1)
    pieces = _joined(recording)
    shuffle = [np.random.default_rng(k).permutation(len(view)) for k, view in enumerate(recording.views)]
    views = tuple(view.at_rows(s) for view, s in zip(recording.views, shuffle, strict=True))
    for view, piece, other, s in zip(
        recording.views, pieces, _joined(replace(recording, views=views)), shuffle, strict=True
    ):
        key = piece[piece >= 0] * 1000 + view.frame[piece >= 0]
        assert len(np.unique(key)) == len(key)
        assert np.mean((other >= 0) == (piece[s] >= 0)) > 0.99


def test_nothing_to_join():
    recording = _recording(n_animals=3)
    empty = [np.empty(0, dtype=int)] * 2
    none = link_jointly(recording.cameras, empty, [np.empty((0, 2))] * 2, 3.0)
    assert [len(piece) for piece in none] == [0, 0]
    one = [np.zeros(5, dtype=int)] * 2
    xy = [np.random.default_rng(k).uniform(0, 700, (5, 2)) for k in range(2)]
    assert all((piece == -1).all() for piece in link_jointly(recording.cameras, one, xy, 3.0))


def test_dots_by_chance_are_not_joined():
    rng = np.random.default_rng(0)
    recording = _recording(n_animals=3)
    frames = [np.repeat(np.arange(60), 12)] * 2
    pieces = link_jointly(recording.cameras, frames, [rng.uniform(0, 1000, (720, 2)) for _ in range(2)], 3.0)
    assert max(float((piece >= 0).mean()) for piece in pieces) < 0.1


def test_pairs_hold_the_animals_at_their_places_within_their_covariance():
    recording = _recording(n_animals=10, noise_px=2.0)
    frames = tuple(view.frame for view in recording.views)
    pairs = find_pairs(recording.cameras, (0, 1), frames, tuple(view.xy for view in recording.views), 2.0)
    animal = [view.animal[pairs.dots[:, side]] for side, view in enumerate(recording.views)]
    real = animal[0] == animal[1]
    truth = recording.truth_3d.set_index(["frame", "animal"]).loc[
        list(zip(pairs.frame[real], animal[0][real], strict=True)), ["x", "y", "z"]
    ]
    miss = pairs.point[real] - truth.to_numpy()
    squared = np.einsum("ki,kij,kj->k", miss, np.linalg.inv(pairs.covariance[real]), miss)
    assert np.mean(squared) == pytest.approx(3.0, rel=0.15)
    possible = sum(
        len(set(recording.views[0].animal[frames[0] == n]) & set(recording.views[1].animal[frames[1] == n]))
        for n in range(100)
    )
    assert real.sum() > 0.99 * possible
    pixels = np.stack([v.xy[pairs.dots[:, s]] for s, v in enumerate(recording.views)], axis=1)[:, :, None]
    solved = triangulate(recording.cameras, pixels[real], threshold_px=np.inf).points[:, 0]
    np.testing.assert_allclose(pairs.point[real], solved, atol=5e-3)  # one step; the noise is 30 mm


def test_density_is_that_of_a_t_distribution():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    scale, miss = root @ root.T + np.eye(3), rng.normal(size=(5, 3))
    expected = multivariate_t(shape=scale, df=8).pdf(miss)
    np.testing.assert_allclose(_density(miss, np.tile(scale, (5, 1, 1))), expected, rtol=1e-3)
