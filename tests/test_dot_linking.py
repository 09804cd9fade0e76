"""Bare dots joined to tracklets: pure whatever the motion, long where nothing is ambiguous, calibrated."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from acino_fte.data_tools.dot_beliefs import Weights, first_messages, propagate
from acino_fte.data_tools.dot_candidates import Links, measure_displacements
from acino_fte.data_tools.dot_linking import link_dots
from acino_fte.data_tools.dot_motion import Motion, begun, log_density, step, updated
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks


def _simulated(**options):
    view = simulate_tracks(TrackSimulation(tracks="bare", **options)).views[0]
    return view.frame, view.xy, view.animal


def _purity(piece, animal):
    """Share of the joined dots that are of the animal that most dots of their piece are of."""
    joined = piece >= 0
    count = np.zeros((piece.max() + 1, animal.max() + 2), dtype=int)
    np.add.at(count, (piece[joined], animal[joined] + 1), 1)
    return count.max(1).sum() / joined.sum()


@pytest.mark.parametrize(
    ("options", "purity", "length"),
    [
        ({"motion": "jumpy", "n_animals": 3}, 0.999, 20),
        ({"motion": "jumpy", "n_animals": 10, "missed": 0.05, "clutter": 0.05}, 0.99, 2.5),
        ({"motion": "perched", "n_animals": 10, "noise_px": 1.0, "missed": 0.05, "clutter": 0.05}, 0.999, 5),
        ({"motion": "perched", "n_animals": 10, "noise_px": 4.0}, 0.995, 10),
    ],
)
def test_pieces_hold_one_animal(options, purity, length):
    frame, xy, animal = _simulated(**{"n_frames": 200, "seed": 3, **options})
    piece = link_dots(frame, xy)
    assert (piece >= 0).sum() / (piece.max() + 1) > length
    assert _purity(piece, animal) >= purity


def test_steps_longer_than_the_space_between_dots_are_left_open():
    frame, xy, _ = _simulated(motion="smooth", n_animals=80, n_frames=14, seed=3)
    assert (link_dots(frame, xy) >= 0).mean() < 0.05


def test_neighbours_that_noise_cannot_tell_apart_are_left_open():
    rng = np.random.default_rng(0)
    frame = np.repeat(np.arange(200), 2)
    place = np.tile([[100.0, 100.0], [104.0, 100.0]], (200, 1))
    animal = np.tile([0, 1], 200)
    near = link_dots(frame, place + rng.normal(0, 5.0, place.shape))
    apart = link_dots(frame, place + rng.normal(0, 0.5, place.shape))
    assert (near >= 0).mean() < 0.2 or _purity(near, animal) > 0.95
    assert (apart >= 0).mean() > 0.99 and _purity(apart, animal) == 1.0


def test_a_missed_frame_is_bridged_and_a_long_gap_is_not():
    frame = np.array([*range(80), *range(81, 160), *range(190, 260)])
    xy = np.column_stack([10.0 + 3.0 * frame, 50.0 + 0.0 * frame])
    xy += np.random.default_rng(1).normal(0, 0.1, xy.shape)
    piece = link_dots(frame, xy, sure=0.9)
    assert len(np.unique(piece[frame < 160])) == 1
    assert piece[0] >= 0 and piece[frame == 190] != piece[0]


def test_a_crossing_at_speed_is_followed_straight():
    t = np.arange(60)
    a = np.column_stack([10.0 * t, 5.0 * t])
    b = np.column_stack([10.0 * t, 295.0 - 5.0 * t])
    xy = np.stack([a, b], axis=1).reshape(-1, 2) + np.random.default_rng(2).normal(0, 0.5, (120, 2))
    animal = np.tile([0, 1], 60)
    piece = link_dots(np.repeat(t, 2), xy)
    assert _purity(piece, animal) == 1.0
    assert (piece >= 0).mean() > 0.95


def test_order_of_rows_does_not_matter_and_pieces_are_numbered_by_frame():
    frame, xy, _ = _simulated(n_animals=5, n_frames=100)
    piece = link_dots(frame, xy)
    shuffle = np.random.default_rng(0).permutation(len(frame))
    again = link_dots(frame[shuffle], xy[shuffle])
    pairs = {(a, b) for a, b in zip(piece[shuffle], again, strict=True)}
    assert len(pairs) == len(np.unique(piece))
    first = [frame[piece == k].min() for k in range(piece.max() + 1)]
    assert first == sorted(first)
    twice = np.column_stack([piece, frame])[piece >= 0]
    assert len(np.unique(twice, axis=0)) == len(twice)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_dots_join_nothing(n):
    assert (link_dots(np.arange(n), np.zeros((n, 2))) >= -1).all()
    assert len(link_dots(np.zeros(n, dtype=int), np.zeros((n, 2)))) == n


def test_clutter_alone_joins_almost_nothing():
    rng = np.random.default_rng(5)
    frame = np.repeat(np.arange(60), 10)
    piece = link_dots(frame, rng.uniform(0, 1000, (600, 2)))
    assert (piece >= 0).mean() < 0.02


def test_displacements_of_dots_denser_than_their_steps():
    rng = np.random.default_rng(0)
    n_frames, n_dots, spread = 60, 200, 20.0
    xy = rng.uniform(0, 500, (n_dots, 2)) + np.cumsum(rng.normal(0, spread, (n_frames, n_dots, 2)), axis=0)
    xy = xy % 500
    moved = measure_displacements(np.repeat(np.arange(n_frames), n_dots), xy.reshape(-1, 2))
    assert moved is not None
    assert moved.quantile(0.5) == pytest.approx(spread * np.sqrt(2 * np.log(2)), rel=0.25)  # Rayleigh


def _exchange():
    """Two dots before, two after: all four links and their densities."""
    links = Links(np.array([0, 0, 1, 1]), np.array([2, 3, 2, 3]), np.ones(4, dtype=int), np.zeros(4))
    begin = np.array([0.5, 0.2, 0.1, 0.3])
    none = np.empty(0, dtype=int)
    return links, Weights(none, none, np.empty(0), begin, np.full(4, 1e-6), np.full(4, 1e-6))


def test_beliefs_about_two_that_may_have_changed_places_are_exact():
    links, weights = _exchange()
    messages = first_messages(links, weights)
    for _ in range(20):
        messages = propagate(links, weights, messages)
    straight, crossed = (
        np.prod([weights.begin[2 * i + j] for i, j in enumerate(p)]) for p in permutations(range(2))
    )
    expected = straight / (straight + crossed)
    off = 1 - expected
    np.testing.assert_allclose(messages.probability, [expected, off, off, expected], atol=1e-4)


def test_beliefs_along_a_chain_are_those_of_enumeration():
    """One dot, two candidates, one dot after: no loop of links that exclude each other twice."""
    links = Links(np.array([0, 0, 1]), np.array([1, 2, 3]), np.ones(3, dtype=int), np.zeros(4))
    first, second = links.pairs()
    weights = Weights(
        first, second, np.array([0.4]), np.array([0.1, 0.3, 0.02]), np.full(4, 0.05), np.full(4, 0.2)
    )
    messages = first_messages(links, weights)
    for _ in range(10):
        messages = propagate(links, weights, messages)
    total, on = 0.0, np.zeros(3)
    for taken in range(8):
        a, b, c = (bool(taken >> k & 1) for k in range(3))
        if a and b:
            continue
        weight = (0.1 if a else 0.3 if b else 0.2) * 0.2 * 0.2  # dot 0; the ends of 2 and 3
        weight *= (0.4 if a else 0.02) if c else 0.2  # dot 1
        weight *= 0.05 * (1 if a else 0.05) * (1 if b else 0.05) * (1 if c else 0.05)  # births
        total += weight
        on += weight * np.array([a, b, c])
    np.testing.assert_allclose(messages.probability, on / total, rtol=1e-6)


def test_filter_is_a_kalman_filter():
    rho, s2, r = 0.8, 4.0, 1.5
    motion = Motion(np.ones(1), np.array([s2]), np.array([rho]), np.array([r]), np.ones(1))
    z = np.array([[0.0, 1.0], [2.0, 0.5], [4.5, 0.0], [6.0, -2.0]])
    states = begun(z[:1], motion)
    mean = np.array([z[0], [0.0, 0.0]])
    covariance = np.diag([r, s2])
    f = np.array([[1.0, rho], [0.0, rho]])
    noise = s2 * (1 - rho**2) * np.ones((2, 2))
    for dot in z[1:]:
        states, squared = updated(step(states, motion), dot[None], motion)
        mean, covariance = f @ mean, f @ covariance @ f.T + noise
        variance = covariance[0, 0] + r
        miss = dot - mean[0]
        assert squared[0, 0] == pytest.approx(miss @ miss / variance)
        gain = covariance[:, :1] / variance
        mean, covariance = mean + gain * miss, covariance - gain @ covariance[:1]
        np.testing.assert_allclose(states.place[0, 0], mean[0])
        np.testing.assert_allclose(states.velocity[0, 0], mean[1])
        found = [states.pp[0, 0], states.pv[0, 0], states.vv[0, 0]]
        np.testing.assert_allclose(found, [covariance[0, 0], covariance[0, 1], covariance[1, 1]])


def test_density_of_a_miss_sums_to_one():
    motion = Motion(np.ones(1), np.array([4.0]), np.array([0.5]), np.array([1.0]), np.array([1.3]))
    state = step(begun(np.zeros((1, 2)), motion), motion)
    radius = np.linspace(0, 400, 200_001)
    xy = np.column_stack([radius, 0 * radius])
    logs = np.concatenate([log_density(state, xy[k : k + 1], motion)[0][0] for k in range(0, len(xy), 100)])
    assert np.trapezoid(2 * np.pi * radius[::100] * np.exp(logs), radius[::100]) == pytest.approx(1, abs=0.01)
