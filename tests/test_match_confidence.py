"""Confidence: of small groupings, worked out by hand; and of recordings in which some matches are wrong."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from acino_fte.data_tools.match_confidence import confidence_of
from acino_fte.data_tools.track_groups import PieceGraph


def whole(view, edges) -> PieceGraph:
    u, v = (np.array([pair[side] for pair in edges], dtype=int) for side in (0, 1))
    n = len(view)
    weight = np.array(list(edges.values()), dtype=float)
    return PieceGraph(np.array(view), np.zeros(n, dtype=int), np.full(n, 9), u, v, weight)


def test_two_by_two():
    """Piece 0 of view 0 with 2 of view 1 (5), 1 with 3 (4); crosswise 3 and 1.

    Piece 0 may be alone (e^−5 against the present), or change places with 1, so that 0–3 and 1–2 are joined:
    3 + 1 against 5 + 4.
    """
    g = whole([0, 0, 1, 1], {(0, 2): 5.0, (1, 3): 4.0, (0, 3): 3.0, (1, 2): 1.0})
    found = confidence_of(g, np.array([0, 1, 0, 1]))
    exchange = np.exp(3.0 + 1.0 - 5.0 - 4.0)
    own = np.array([5.0, 4.0, 5.0, 4.0])
    np.testing.assert_allclose(found.probability, 1 / (1 + np.exp(-own) + exchange))
    np.testing.assert_allclose(found.log_odds, own)
    np.testing.assert_array_equal(found.rival, [1, 0, 1, 0])
    np.testing.assert_allclose(found.rival_probability, exchange * found.probability)


def test_two_by_two_without_exchange():
    """1–2 speaks against itself: were 0 to take 3, piece 1 would be alone."""
    g = whole([0, 0, 1, 1], {(0, 2): 5.0, (1, 3): 4.0, (0, 3): 3.0, (1, 2): -6.0})
    found = confidence_of(g, np.array([0, 1, 0, 1]))
    against = np.exp(-5.0) + np.exp(3.0 + 0.0 - 5.0 - 4.0)
    assert found.probability[0] == pytest.approx(1 / (1 + against))


def test_a_coin_toss_is_a_half():
    g = whole([0, 0, 1, 1], {(0, 2): 50.0, (1, 3): 50.0, (0, 3): 50.0, (1, 2): 50.0})
    found = confidence_of(g, np.array([0, 1, 0, 1]))
    np.testing.assert_allclose(found.probability, 0.5)
    np.testing.assert_allclose(found.rival_probability, 0.5)


def test_three_by_three():
    """The alternatives of one piece are to be alone and to change places with each of the other two."""
    table = np.array([[6.0, 2.0, -1.0], [1.0, 5.0, 4.0], [0.5, 3.0, 7.0]])
    g = whole([0] * 3 + [1] * 3, {(i, 3 + j): table[i, j] for i in range(3) for j in range(3)})
    found = confidence_of(g, np.array([0, 1, 2, 0, 1, 2]))
    own = np.diag(table)
    for i in range(3):
        others = [j for j in range(3) if j != i]
        gain = [table[i, j] + max(table[j, i], 0.0) - own[i] - own[j] for j in others]
        assert found.probability[i] == pytest.approx(1 / (1 + np.exp(-own[i]) + np.exp(gain).sum()))
        assert found.rival[i] == others[int(np.argmax(gain))]


def test_three_views_add_up():
    """A group of three: each piece stands on its two edges."""
    g = whole([0, 1, 2], {(0, 1): 2.0, (1, 2): 3.0, (0, 2): -0.5})
    found = confidence_of(g, np.zeros(3, dtype=int))
    np.testing.assert_allclose(found.log_odds, [1.5, 5.0, 2.5])
    np.testing.assert_allclose(found.probability, 1 / (1 + np.exp(-found.log_odds)))
    assert (found.rival == -1).all()
    assert (found.rival_probability == 0).all()


def test_a_lonely_piece_has_no_confidence():
    g = whole([0, 1, 1], {(0, 1): 4.0, (0, 2): 1.0})
    found = confidence_of(g, np.array([0, 0, 1]))
    assert np.isnan(found.probability[2])
    assert found.probability[0] == pytest.approx(1 / (1 + np.exp(-4.0) + np.exp(1.0 - 4.0)))
    empty = confidence_of(whole([0, 1], {}), np.arange(2))
    assert np.isnan(empty.probability).all()


def test_sure_matches_do_not_overflow():
    g = whole([0, 1, 1], {(0, 1): 5000.0, (0, 2): -5000.0})
    found = confidence_of(g, np.array([0, 0, 1]))
    assert found.probability[0] == 1.0


def bench():
    """The benchmark's module, which knows what is right and draws the curve."""
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "bench_tracks.py"
    spec = importlib.util.spec_from_file_location("bench_tracks", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_reliability_by_hand():
    tracks = bench()
    told = np.array([0.55, 0.55, 0.95, 0.96, 0.9999, 1.0])
    curve = tracks.reliability(told, np.array([True, False, True, True, True, False]))
    np.testing.assert_array_equal(curve.count[curve.count > 0], [2, 2, 2])
    np.testing.assert_allclose(curve.right[curve.count > 0], [0.5, 1.0, 0.5])
    assert curve.error == pytest.approx((2 * 0.05 + 2 * 0.045 + 2 * 0.49995) / 6)


def test_probabilities_that_are_told_come_true(tmp_path):
    """Recordings hard enough to have errors: within 3 % on average, 5 % in every bin that matters."""
    tracks = bench()
    rows = []
    for name, frames in (
        ("40 animals, 8 px, pieces of 2–6", 40),
        ("100 animals, clutter", 30),
        ("flock", 100),
        ("three views, 8 px", 30),
        ("four views, much clutter", 40),
        ("exchanges", 200),
    ):
        rows.append(tracks.collect(tracks.HARD[name] | {"n_frames": frames}, range(60, 61)))
    told, right = (np.concatenate(x) for x in zip(*rows, strict=True))
    assert np.count_nonzero(~right) > 50
    curve = tracks.reliability(told, right)
    assert curve.error <= 0.03
    filled = curve.count >= 0.05 * len(told)
    np.testing.assert_allclose(curve.told[filled], curve.right[filled], atol=0.05)
    tracks.draw_reliability({"all": curve}, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1000
