"""A device's clock fitted to times of reception, against simulated truth."""

import numpy as np
import pytest

from acino_fte.data_tools.clocks import fit_clock, same_clock
from acino_fte.errors import InputError

T0 = 1_700_000_000_123_456_789  # ns since 1970: a float64 has steps of 256 ns there
DRIFT = 50e-6


def messages(seed=0, n=2000, rate=200.0, jumps=(), late=0.01, early=0.0, twice=0.01, jitter_ms=3.0):
    """Stamps of a device, times of reception and true times, in the order of reception."""
    rng = np.random.default_rng(seed)
    elapsed = np.arange(n) * round(1e9 / rate) + rng.integers(0, 1000, n)
    device = elapsed + 5_000_000_000
    for at, size in jumps:
        device[elapsed >= at * 1e9] += round(size * 1e9)
    true = T0 + elapsed + np.rint(DRIFT * elapsed).astype(np.int64)
    delay = rng.exponential(jitter_ms * 1e6, n) + np.where(rng.random(n) < late, rng.exponential(2e8, n), 0.0)
    received = true + delay.astype(np.int64)
    order = np.argsort(received, kind="stable")
    order = np.sort(np.r_[np.arange(n), np.flatnonzero(rng.random(n) < twice)])[:n] if twice else order
    order = order[np.argsort(received[order], kind="stable")]
    received = received - np.where(rng.random(n) < early, 500_000_000, 0)  # a wrong stamp of the computer
    return device[order], received[order], true[order]


def errors_ms(clock, device, received, true):
    return (clock.to_computer_ns(device, received) - true) * 1e-6


def test_drift_and_offset_of_jittered_messages():
    device, received, true = messages()
    clock = fit_clock(device, received)
    assert clock.jumps == ()
    assert clock.drift == pytest.approx(DRIFT, abs=3e-6)
    assert np.abs(errors_ms(clock, device, received, true)).max() < 0.05  # of delays of 3 ms and more
    assert clock.sd_ms < 0.05
    assert clock.delay_ms == pytest.approx(3 * np.log(2), rel=0.1)
    assert clock.n_duplicates > 5


@pytest.mark.parametrize(("n", "rate"), [(60, 10.0), (400, 50.0), (3000, 200.0)])
def test_the_stated_uncertainty_is_that_of_the_errors(n, rate):
    """At the beginning, the middle and the end, over many recordings: squares of error / sd average to 1."""
    squares = []
    for seed in range(60):
        device, received, true = messages(seed, n=n, rate=rate)
        clock = fit_clock(device, received)
        error = errors_ms(clock, device, received, true)[[0, n // 2, -1]]
        squares.append((error / clock.sd_ms) ** 2)
    assert 0.15 < np.mean(squares) < 1.8  # sd_ms is that of the worst place, so less than 1 is expected


def test_wrong_stamps_of_the_computer_do_not_pull_the_line():
    device, received, true = messages(3, early=0.005)
    clock = fit_clock(device, received)
    assert np.abs(errors_ms(clock, device, received, true)).max() < 0.1
    assert clock.n_outliers >= 5


def test_jumps_are_reported_with_time_and_size():
    device, received, true = messages(1, n=4000, jumps=((8, -3.0), (14, 0.05)))
    clock = fit_clock(device, received)
    assert [round(jump.size_ns * 1e-9, 3) for jump in clock.jumps] == [-3.0, 0.05]
    for jump, at in zip(clock.jumps, (8, 14), strict=True):
        assert (jump.received_ns - T0) * 1e-9 == pytest.approx(at, abs=0.03)
    assert [jump.kind for jump in clock.jumps] == ["restart", "device"]
    assert "-3" in str(clock.jumps[0])
    inner = np.abs((true - T0) * 1e-9 - 14) > 0.1  # next to the small jump a message may be of either side
    assert np.abs(errors_ms(clock, device, received, true)[inner]).max() < 0.1


def test_a_power_cycle_shows_times_twice():
    device, received, true = messages(2, n=4000, jumps=((12, -12.0),))
    clock = fit_clock(device, received)
    assert len(clock.pieces) == 2
    assert clock.jumps[0].kind == "restart"
    assert np.abs(errors_ms(clock, device, received, true)).max() < 0.1
    with pytest.raises(InputError, match="received_ns"):
        clock.to_computer_ns(device)


def test_a_counter_that_wraps_is_named():
    device, received, true = messages(4)
    ticks = (device // 1000 + 2**32 - 10_000_000) % 2**32  # µs, 32 bits; wraps 5 s on
    clock = fit_clock(ticks * 1000, received)
    assert [jump.kind for jump in clock.jumps] == ["wrap"]
    assert np.abs(errors_ms(clock, ticks * 1000, received, true)).max() < 0.1


def test_a_step_of_the_computers_clock_is_the_computers():
    device, received, _ = messages(5, late=0, twice=0, jitter_ms=0.3)
    received = received + np.where(np.arange(len(received)) >= 900, 2_000_000_000, 0)
    clock = fit_clock(device, received)
    assert [jump.kind for jump in clock.jumps] == ["computer"]
    assert clock.jumps[0].size_ns * 1e-9 == pytest.approx(-2.0, abs=1e-3)
    assert "computer's clock jumped by +2.000 s" in str(clock.jumps[0])


def test_messages_that_were_held_up_are_no_jump():
    device, received, true = messages(6, late=0)
    held = np.arange(800, 900)
    received[held] = np.maximum(received[held], received[899])  # half a second of messages all at once
    clock = fit_clock(device, received)
    assert clock.jumps == ()
    assert np.abs(errors_ms(clock, device, received, true)).max() < 0.05


def test_nanoseconds_are_kept():
    """Stamps since 1970 without delay or drift come back to the last digit."""
    device = T0 + np.arange(0, 10**10, 100_000_003)
    clock = fit_clock(device, device + 7)
    assert np.array_equal(clock.to_computer_ns(device), device + 7)
    assert clock.to_computer_ns(device[3]) == device[3] + 7
    assert clock.is_computers


def test_the_computers_own_time_is_recognised():
    _, received, true = messages(7)
    assert fit_clock(true, received).is_computers
    device, received, _ = messages(7)
    assert not fit_clock(device, received).is_computers
    assert same_clock().is_computers
    assert np.array_equal(same_clock().to_computer_ns(true), true)


@pytest.mark.parametrize(
    ("device", "received", "message"),
    [
        (np.array([1.0, 2, 3]), np.arange(3), "whole nanoseconds"),
        (np.arange(3), np.arange(4), "do not belong together"),
        (np.zeros(9, dtype=int), np.arange(9), "cannot be fitted"),
        (np.arange(2), np.arange(2), "cannot be fitted"),
    ],
)
def test_what_cannot_be_fitted_is_refused(device, received, message):
    with pytest.raises(InputError, match=message):
        fit_clock(device, received)


def test_a_few_messages_are_enough():
    device, received, true = messages(8, n=5, rate=10, late=0, twice=0)
    clock = fit_clock(device, received)
    assert np.abs(errors_ms(clock, device, received, true)).max() < 15
    assert clock.sd_ms > 0.3
