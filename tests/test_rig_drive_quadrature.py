"""Quadrature decoded: exact with bounce, in chunks as at once, faults counted."""

import numpy as np
import pytest

from acino_fte.errors import InputError
from acino_fte.rig.quadrature import (
    NO_EDGES,
    A,
    B,
    EdgeDecoder,
    Edges,
    Glitches,
    SampleDecoder,
    Z,
    angle,
    decode_edges,
    decode_samples,
    edges_of,
    index_error,
)

N = 1_000_000
STEP_NS = 10_000


@pytest.fixture(scope="module")
def walk():
    """10^6 random steps of a shaft: runs in either direction, and trembling on the spot."""
    rng = np.random.default_rng(7)
    runs = rng.geometric(0.02, N // 20)
    direction = np.repeat(rng.choice([-1, 1], len(runs)), runs)[:N]
    tremble = rng.random(N) < 0.1
    steps = np.where(tremble, rng.choice([-1, 1], N), direction)
    time = np.cumsum(rng.integers(STEP_NS, 2 * STEP_NS, N))
    return np.cumsum(steps), time


def bounced(position, time, seed=1, share=0.3, within=STEP_NS // 4):
    """The edges of a walk with contact bounce: up to three more pulses after the edge, on the same line."""
    rng = np.random.default_rng(seed)
    edges, levels = edges_of(position, time)
    pulses = np.where(rng.random(len(time)) < share, rng.integers(1, 4, len(time)), 0)
    times = 1 + 2 * pulses  # edges for every real one: an odd number
    source = np.repeat(np.arange(len(time)), times)
    place = np.arange(len(source)) - np.repeat(np.cumsum(times) - times, times)
    level = edges.level[source] ^ (place & 1).astype(np.int8)
    return Edges(edges.time_ns[source] + place * (within // 8), edges.line[source], level), levels, pulses


def test_a_million_random_steps_with_bounce_are_exact(walk):
    position, time = walk
    assert np.count_nonzero(np.diff(np.sign(np.diff(position)))) > 10_000  # the direction changes
    edges, levels, pulses = bounced(position, time)
    assert len(edges.time_ns) > 1.5 * N
    raw, glitches = decode_edges(edges, levels)
    assert raw.position[-1] == position[-1]
    settled = np.cumsum(1 + 2 * pulses) - 1  # the last edge of every burst
    np.testing.assert_array_equal(raw.position[settled], position)
    assert glitches == Glitches()

    filtered, glitches = decode_edges(edges, levels, min_pulse_ns=STEP_NS // 3)
    np.testing.assert_array_equal(filtered.position, position)
    assert glitches == Glitches(bounce=int(2 * pulses.sum()))


def test_chunks_give_what_the_whole_array_gives(walk):
    position, time = walk[0][:200_000], walk[1][:200_000]
    edges, levels, _ = bounced(position, time)
    for min_pulse in (0, STEP_NS // 3):
        whole, glitches = decode_edges(edges, levels, min_pulse_ns=min_pulse)
        decoder = EdgeDecoder(levels, min_pulse_ns=min_pulse)
        cuts = np.sort(np.random.default_rng(3).integers(0, len(edges.time_ns), 500))
        parts = [
            decoder.feed(Edges(*(column[i:j] for column in edges)))
            for i, j in zip([0, *cuts], [*cuts, len(edges.time_ns)], strict=True)
        ]
        parts.append(decoder.flush())
        for name in whole._fields:
            together = np.concatenate([getattr(part, name) for part in parts])
            np.testing.assert_array_equal(together, getattr(whole, name), err_msg=name)
        assert decoder.glitches == glitches
        assert decoder.position == whole.position[-1]


def test_sampled_levels_with_bounce_and_in_chunks(walk):
    position = walk[0][:100_000]
    rng = np.random.default_rng(5)
    held = np.repeat(np.concatenate([[0], position]), 6) & 3
    b = held >> 1
    a = (held & 1) ^ b
    both = np.stack([a, b])
    change = 6 * (1 + np.arange(len(position)))
    line = np.where(a[change] != a[change - 1], 0, 1)
    bouncing = rng.random(len(position)) < 0.5
    both[line[bouncing], change[bouncing] + 1] ^= 1  # one sample back at the old level
    counts, glitches = decode_samples(both[0], both[1])
    np.testing.assert_array_equal(counts[5::6][1:], position)
    assert glitches == Glitches()
    filtered, glitches = decode_samples(both[0], both[1], min_samples=2)
    np.testing.assert_array_equal(filtered[5::6][1:], position)
    assert set(np.diff(filtered)) <= {-1, 0, 1}
    assert glitches == Glitches(bounce=2 * int(bouncing.sum()))
    decoder = SampleDecoder(min_samples=2)
    for part in np.array_split(np.arange(both.shape[1]), 301):
        decoder.feed(both[0, part], both[1, part])
    decoder.flush()
    assert (decoder.position, decoder.glitches) == (position[-1], glitches)


def test_direction_changes_at_every_phase():
    position = np.array([1, 2, 1, 0, -1, 0, 1, 2, 3, 2, 3, 4, 5, 4, 3, 2, 1, 0, -1, -2, -3, -4, -5, -4])
    edges, levels = edges_of(position, 1000 * np.arange(len(position)))
    found, glitches = decode_edges(edges, levels)
    np.testing.assert_array_equal(found.position, position)
    assert not glitches


def test_forward_is_a_before_b():
    edges = Edges(np.array([1, 2]), np.array([A, B], np.int8), np.array([1, 1], np.int8))
    assert decode_edges(edges)[0].position.tolist() == [1, 2]


def test_both_lines_at_once_are_counted_and_follow_the_direction():
    """At 1.3 times the rate of sampling that would do, the shaft is still followed, and the fault is told."""
    for sign in (1, -1):
        position = sign * np.array([0, 1, 2, 4, 5, 7, 8, 9])
        b = (position & 3) >> 1
        a = (position & 1) ^ b
        counts, glitches = decode_samples(a, b)
        np.testing.assert_array_equal(counts, position)
        assert glitches == Glitches(illegal=2)
    same_moment = Edges(np.array([5, 5]), np.array([A, B], np.int8), np.array([1, 1], np.int8))
    decoder = EdgeDecoder()
    decoder.feed(Edges(*(column[:1] for column in same_moment)))  # the moment is cut in two
    decoder.feed(Edges(*(column[1:] for column in same_moment)))
    decoder.flush()
    assert decoder.glitches == Glitches(illegal=1)
    assert abs(decoder.position) == 2


def test_a_lost_edge_is_counted():
    position = np.arange(1, 41)
    edges, levels = edges_of(position, 1000 * position)
    kept = np.delete(np.arange(40), 20)
    _, glitches = decode_edges(Edges(*(column[kept] for column in edges)), levels)
    assert glitches.repeated == 1


def test_a_spike_while_the_other_line_changes_is_filtered():
    """Both lines would change at once, against the direction: without the filter the count is off."""
    time = np.array([0, 100_000, 200_000, 200_000, 200_400, 300_000])
    line = np.array([A, B, A, B, B, B], np.int8)
    level = np.array([1, 1, 0, 0, 1, 0], np.int8)
    edges = Edges(time, line, level)
    found, glitches = decode_edges(edges, min_pulse_ns=2000)
    assert found.position.tolist() == [1, 2, 3, 3, 4]
    assert glitches == Glitches(bounce=1)
    assert decode_edges(edges)[1].illegal == 1


def test_the_index_gives_lost_counts_and_the_angle():
    position = np.concatenate([np.arange(1, 4001), np.arange(3999, -1, -1)])
    time = 1000 * np.arange(1, len(position) + 1)
    edges, levels = edges_of(position, time)
    at = time[position == 100] + 1
    index = Edges(at, np.full(2, Z, np.int8), np.ones(2, np.int8))
    mixed = Edges(*(np.concatenate(pair) for pair in zip(edges, index, strict=True)))
    found, _ = decode_edges(mixed, levels)
    assert found.index_position.tolist() == [100, 100]
    assert index_error(100 + 3 * 4000, 100, 4000) == 0
    assert index_error(100 - 4000 - 4, 100, 4000) == -4
    assert angle(1000, 4000.0) == pytest.approx(np.pi / 2)
    assert angle(1.0, 4000.0) == pytest.approx(np.deg2rad(0.09))  # as the issue says


def test_nothing_and_impossible_input():
    assert decode_edges(NO_EDGES)[0].position.tolist() == []
    counts, glitches = decode_samples(np.empty(0), np.empty(0))
    assert counts.tolist() == [] and not glitches
    with pytest.raises(InputError, match="not equally long"):
        decode_samples(np.zeros(3), np.zeros(4))
    with pytest.raises(InputError, match="filter"):
        EdgeDecoder(min_pulse_ns=-1)
    with pytest.raises(InputError, match="filter"):
        SampleDecoder(min_samples=0)
