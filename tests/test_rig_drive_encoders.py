"""Encoders: counts, angle, velocity, the zero, and positions that outlive the program."""

import json

import numpy as np
import pytest

from acino_fte.rig.encoders import REST_NS, Encoder, LineCounts, ReportedCounts
from acino_fte.rig.encoders_store import PositionStore
from acino_fte.rig.gpio import SimulatedEdges
from acino_fte.rig.quadrature import Edges, Z, edges_of

MS = 1_000_000


def reported(name="zoom", store=None, **rest):
    source = ReportedCounts()
    return source, Encoder(name, source, 4741.44, store=store, **rest)


def test_counts_angle_and_velocity_of_lines():
    lines = SimulatedEdges(clock=lambda: 10**9)
    encoder = Encoder("pan", LineCounts(lines), 4000.0)
    assert encoder.poll(0).counts == 0
    for step in range(10):
        position = np.arange(1, 51) + 50 * step
        edges, _ = edges_of(position, step * 10 * MS + np.arange(1, 51) * 100_000, before=50 * step)
        lines.push(edges)
        reading = encoder.poll((step + 1) * 10 * MS)
    assert reading.counts == 500
    assert reading.angle == pytest.approx(np.pi / 4)
    assert reading.velocity == pytest.approx(5000.0)
    assert encoder.poll(REST_NS).velocity < 5000
    assert encoder.poll(2 * REST_NS).velocity == 0
    assert not reading.glitches


def test_nothing_is_known_before_the_first_report():
    source, encoder = reported()
    assert encoder.poll(0).counts is None
    encoder.zero()
    assert np.isnan(encoder.poll(1).angle)
    source.counts = 77
    encoder.poll(2)
    encoder.zero(1000)
    source.counts = 78
    assert encoder.poll(3).counts == 1001
    assert encoder.sure


def test_a_position_outlives_the_program(tmp_path):
    store = PositionStore(tmp_path)
    source, encoder = reported(store=store)
    source.counts = 10
    encoder.poll(0)
    encoder.zero()
    source.counts = 1210
    encoder.poll(100 * MS)
    encoder.poll(100 * MS + REST_NS)
    store.put_limits("zoom", (0, 9000))
    store.close()
    store = PositionStore(tmp_path)
    assert store.get("zoom").limits == (0, 9000)
    source, encoder = reported(store=store, self_locking=True)
    source.counts = 0  # the microcontroller began again
    assert encoder.poll(0).counts == 1200
    assert encoder.sure
    _, head = reported(store=store)
    head.source.counts = 0
    head.poll(0)
    assert not head.sure  # a head may have been turned meanwhile


def test_a_position_that_was_stored_while_moving_is_not_sure(tmp_path):
    store = PositionStore(tmp_path)
    source, encoder = reported(store=store)
    source.counts = 0
    encoder.poll(0)
    encoder.zero()
    source.counts = 500
    encoder.poll(10 * MS)
    store.close()  # the power goes
    again = PositionStore(tmp_path)
    source, encoder = reported(store=again, self_locking=True)
    source.counts = 0
    encoder.poll(0)
    assert (encoder.counts, encoder.sure) == (500, False)


def test_a_counter_that_begins_again_does_not_move_the_shaft():
    source, encoder = reported()
    source.counts = 3000
    encoder.poll(0)
    encoder.zero(3000)
    encoder.interrupted()
    source.counts = 3004  # only the cable was out
    encoder.poll(1)
    assert (encoder.counts, encoder.sure) == (3004, True)
    encoder.interrupted()
    source.counts = 4100  # and the motor ran on until its dead-man
    encoder.poll(2)
    assert (encoder.counts, encoder.sure) == (4100, True)
    for before, after in ((4100, 2), (300, 0), (300, 9000)):  # it had no power
        source.counts = before
        encoder.poll(3)
        encoder.zero(before)
        encoder.interrupted()
        source.counts = after
        encoder.poll(4)
        assert (encoder.counts, encoder.sure) == (before, False)


def test_the_index_finds_the_angle_again_and_counts_what_was_lost(tmp_path):
    lines = SimulatedEdges(clock=lambda: 10**9)
    store = PositionStore(tmp_path)
    encoder = Encoder("pan", LineCounts(lines), 4000.0, store=store)

    def turn(start, stop, index, now):
        position = np.arange(start + 1, stop + 1)
        edges, _ = edges_of(position, now - len(position) + np.arange(len(position)), before=start)
        if index is not None:
            pulse = Edges(edges.time_ns[position == index], np.array([Z]), np.array([1]))
            edges = Edges(*(np.concatenate(pair) for pair in zip(edges, pulse, strict=True)))
        lines.push(edges)
        return encoder.poll(now)

    encoder.poll(0)
    encoder.zero()
    turn(0, 300, 100, 10 * MS)
    turn(300, 4200, 4096, 20 * MS)  # four counts were lost on the way
    assert encoder.missed == 4
    assert encoder.counts == 4204
    encoder.save(at_rest=True)
    store.close()
    lines = SimulatedEdges(clock=lambda: 10**9)
    encoder = Encoder("pan", LineCounts(lines), 4000.0, store=PositionStore(tmp_path))
    encoder.poll(0)
    assert not encoder.sure
    turn(0, 60, 50, 30 * MS)  # the head was turned by hand without power: the index is where it was
    assert encoder.sure
    assert encoder.counts % 4000 == 110


def test_an_index_without_a_zero_makes_nothing_sure(tmp_path):
    store = PositionStore(tmp_path)
    lines = SimulatedEdges(clock=lambda: 10**9)
    encoder = Encoder("pan", LineCounts(lines), 4000.0, store=store)
    encoder.poll(0)
    for k in (1, 2):
        lines.push(Edges(np.array([k]), np.array([Z], np.int8), np.array([1], np.int8)))
        encoder.source.index_position = None
        encoder.poll(k)
    assert not encoder.sure
    encoder.save(at_rest=True)
    store.close()
    assert store.get("pan").index_at is None


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "x"}', None])
def test_a_damaged_file_of_positions_is_told_and_stops_nothing(tmp_path, text):
    if text is None:
        content = {"format": "acino-fte/rig-positions/1", "encoders": {"zoom": {"counts": "7"}}}
        text = json.dumps(content)
    (tmp_path / "positions.json").write_text(text)
    store = PositionStore(tmp_path)
    assert "cannot be read" in store.trouble
    assert store.get("zoom") is None
    store.close()


def test_a_folder_that_cannot_be_written_is_told_and_stops_nothing(tmp_path):
    (tmp_path / "file").write_text("")
    store = PositionStore(tmp_path / "file")
    source, encoder = reported(store=store)
    source.counts = 1
    encoder.poll(0)
    encoder.zero()
    store.close()
    assert "cannot be stored" in store.trouble
