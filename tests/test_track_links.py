"""Pieces of tracks continued within one view: birds on perches, birds in flight, rivals, clutter."""

import numpy as np
import pytest

from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_links import ViewPieces, link_pieces
from acino_fte.data_tools.track_pieces import pieced

SIGMA = 2.0


def pieces_of(*parts: tuple[np.ndarray, np.ndarray]) -> ViewPieces:
    """Pieces given as (frames, xy)."""
    lengths = [len(frame) for frame, _ in parts]
    return ViewPieces(
        np.concatenate([frame for frame, _ in parts]),
        np.concatenate([xy for _, xy in parts]),
        np.concatenate([[0], np.cumsum(lengths)]),
    )


def flight(frames, start, velocity, rng, sigma=SIGMA):
    """A straight flight: place at frame 0, px, and velocity, px/frame."""
    frames = np.asarray(frames)
    xy = np.asarray(start) + frames[:, None] * np.asarray(velocity, dtype=float)
    return frames, xy + rng.normal(0, sigma, xy.shape)


def crowd(rng, n=8, length=120):
    """Unbroken flights elsewhere, from which the motion is learnt."""
    return [
        flight(np.arange(length), rng.uniform(2000, 4000, 2), rng.uniform(-6, 6, 2), rng) for _ in range(n)
    ]


def links(parts, max_gap=30, noise=SIGMA):
    earlier, later, weight = link_pieces(pieces_of(*parts), noise, max_gap)
    return dict(zip(zip(earlier.tolist(), later.tolist(), strict=True), weight.tolist(), strict=True))


@pytest.mark.parametrize("gap", [1, 4, 12])
def test_a_flight_goes_on(gap):
    rng = np.random.default_rng(gap)
    first = flight(np.arange(40), (100, 100), (5, 3), rng)
    second = flight(np.arange(39 + gap, 90), (100, 100), (5, 3), rng)
    away = flight(np.arange(39 + gap, 90), (900, 200), (5, 3), rng)
    found = links([first, second, away, *crowd(rng)])
    assert found.keys() == {(0, 1)}
    assert found[0, 1] > 2


@pytest.mark.parametrize("gap", [1, 5, 25])
def test_a_bird_on_its_perch_goes_on(gap):
    rng = np.random.default_rng(gap)
    seats = [(300, 300), (330, 300), (900, 250), (300, 700), (1200, 640)]
    parts = []
    for seat in seats:
        parts.append(flight(np.arange(60), seat, (0, 0), rng))
        parts.append(flight(np.arange(59 + gap, 130), seat, (0, 0), rng))
    found = links(
        [*parts, *(flight(np.arange(130), rng.uniform(1500, 3000, 2), (0, 0), rng) for _ in range(4))]
    )
    assert found.keys() == {(2 * k, 2 * k + 1) for k in range(5)}
    assert min(found.values()) > 2


def test_perched_and_flying_birds_in_one_view_both_get_their_due():
    """A bird leaves its perch just where another sat down in passing: each goes on as it was."""
    rng = np.random.default_rng(3)
    sitting = flight(np.arange(50), (600, 400), (0, 0), rng)
    still_sitting = flight(np.arange(53, 100), (600, 400), (0, 0), rng)
    passing = flight(np.arange(50), (200, 200), (8, 4.2), rng)  # passes (600, 410) at frame 50
    passed = flight(np.arange(53, 100), (200, 200), (8, 4.2), rng)
    others = [flight(np.arange(100), rng.uniform(1500, 3000, 2), (0, 0), rng) for _ in range(4)]
    found = links([sitting, still_sitting, passing, passed, *others, *crowd(rng, 4, 100)])
    assert found.keys() == {(0, 1), (2, 3)}


def test_pieces_at_the_same_time_are_never_linked():
    rng = np.random.default_rng(4)
    found = links([flight(np.arange(40), (100, 100), (5, 3), rng) for _ in range(3)] + crowd(rng))
    assert found == {}


def test_beyond_the_longest_gap_nothing_is_linked():
    rng = np.random.default_rng(5)
    parts = [
        flight(np.arange(40), (100, 100), (0, 0), rng),
        flight(np.arange(60, 90), (100, 100), (0, 0), rng),
    ]
    assert links([*parts, *crowd(rng)], max_gap=21).keys() == {(0, 1)}
    assert links([*parts, *crowd(rng)], max_gap=20) == {}


def test_rivals_at_one_time_leave_a_link_open():
    """Two pieces begin at the same distance from where one ended: neither is a link; one alone is."""
    rng = np.random.default_rng(6)
    one = flight(np.arange(40), (100, 100), (5, 0), rng, 0.0)
    up, down = (flight(np.arange(42, 90), (100, 100 + s), (5, 0), rng, 0.0) for s in (6, -6))
    others = crowd(rng)
    assert (0, 1) in links([one, up, *others])
    found = links([one, up, down, *others])
    assert found.get((0, 1), 0.0) < 1
    assert found.get((0, 2), 0.0) < 1


def test_rivals_after_one_another_do_not_exclude_each_other():
    rng = np.random.default_rng(7)
    a, b, c = (flight(np.arange(*span), (100, 100), (5, 0), rng) for span in ((0, 30), (32, 50), (52, 90)))
    found = links([a, b, c, *crowd(rng)])
    assert {(0, 1), (1, 2)} <= found.keys()


@pytest.mark.parametrize("motion", ["smooth", "jumpy", "perched"])
@pytest.mark.parametrize("fault", ["fragments", "hard"])
def test_links_of_simulated_fragments_are_right(motion, fault):
    """Links with odds above e⁴, which are acted upon, are right but for one in fifty, and many."""
    right = wrong = possible = 0
    for seed in (31, 32):
        options = {"tracks": "fragments", "motion": motion, "n_animals": 10, "n_frames": 400, "seed": seed}
        if fault == "hard":
            options |= {"missed": 0.1, "clutter": 0.1}
        for view in simulate_tracks(TrackSimulation(**options)).views:
            pieces = pieced(view.frame, view.track, view.xy)
            animal = np.full(pieces.n_pieces, -1)
            animal[pieces.piece] = view.animal[pieces.order]
            earlier, later, weight = link_pieces(pieces.by_piece(), 3.0, 30)
            sure = weight > 4.0
            same = (animal[earlier] == animal[later]) & (animal[earlier] >= 0)
            right += int((same & sure).sum())
            wrong += int((~same & sure).sum())
            possible += int(np.count_nonzero(animal >= 0)) - 10
    assert wrong <= 0.02 * right + 1
    assert right > 0.15 * possible


def test_odds_of_links_are_honest():
    """Of links with odds p, about the share p is right."""
    weight, right = [], []
    for seed in range(41, 47):
        view = simulate_tracks(
            TrackSimulation(
                tracks="fragments", n_animals=40, n_frames=300, missed=0.1, clutter=0.2, seed=seed
            )
        ).views[0]
        pieces = pieced(view.frame, view.track, view.xy)
        animal = np.full(pieces.n_pieces, -1)
        animal[pieces.piece] = view.animal[pieces.order]
        earlier, later, odds = link_pieces(pieces.by_piece(), 3.0, 30)
        weight.append(odds)
        right.append((animal[earlier] == animal[later]) & (animal[earlier] >= 0))
    weight, right = np.concatenate(weight), np.concatenate(right)
    told = 1 / (1 + np.exp(-weight))
    assert len(weight) > 300
    assert abs(told.mean() - right.mean()) < 0.15


@pytest.mark.parametrize("parts", [1, 2])
def test_too_little_to_learn_from(parts):
    rng = np.random.default_rng(8)
    some = [(np.array([9 * k]), rng.uniform(0, 1000, (1, 2))) for k in range(parts)]
    earlier, later, weight = link_pieces(pieces_of(*some), SIGMA, 30)
    assert len(earlier) == len(later) == len(weight)
    assert np.isfinite(weight).all()
