"""Stamps under rough reception: what is late is not lost, what is lost is found, in blocks or at once."""

import numpy as np
import pytest

from acino_fte.rig.check_camera import glitches
from acino_fte.rig.check_stamps import StampCheck
from acino_fte.rig.check_types import StreamAccount
from acino_fte.rig.check_wall import WallClock, wall_account

T0 = 1_750_000_000_000_000_000
LATE = 5_000_000_000


def messages(seed=0, rate=60.0, n=3000, jitter_ms=3.0, late=0.002, drift=30e-6):
    """Stamps of a device and times of reception: exponential delays, some held up with all behind them."""
    rng = np.random.default_rng(seed)
    since = np.arange(n) * round(1e9 / rate)
    delay = rng.exponential(jitter_ms * 1e6, n) + np.where(rng.random(n) < late, rng.exponential(3e8, n), 0.0)
    received = T0 + since + np.rint(drift * since).astype(np.int64) + delay.astype(np.int64)
    return since + LATE, np.maximum.accumulate(received)


def account(device, received, number=None, steady=True, block=1 << 16, expected_hz=None):
    found = StreamAccount("stream", "imu", expected_hz=expected_hz)
    check = StampCheck(found, steady, block)
    for i in range(len(received)):
        check.add(
            None if device is None else int(device[i]),
            int(received[i]),
            None if number is None else int(number[i]),
        )
    check.finish()
    return found


def without(rows, *arrays):
    return [np.delete(array, rows) for array in arrays]


@pytest.mark.parametrize("rate", [10.0, 200.0])
@pytest.mark.parametrize("late", [0.0, 0.01])
def test_late_messages_are_neither_lost_nor_jumps(rate, late):
    for seed in range(3):
        found = account(*messages(seed, rate, late=late))
        assert (found.lost, found.jumps, found.out_of_order, found.duplicates) == (0, [], 0, 0)
        assert found.rate_hz == pytest.approx(rate, rel=1e-6)
        assert found.drift_ppm == pytest.approx(30, abs=max(6 * found.drift_sd_ppm, 3))


@pytest.mark.parametrize("block", [300, 1 << 16])
def test_losses_and_a_restart_are_found_in_blocks_as_in_one_piece(block):
    """Two drops, a stall, an unplugging that starts the clock anew, a duplicate, two swapped messages."""
    device, received = messages(1, late=0.001)
    gone = np.r_[500, 900:903, 1200:1320, 2000:2180]
    device[2180:] -= device[2180] - 7_000_000
    device, received = without(gone, device, received)
    device, received = np.insert(device, 100, device[100]), np.insert(received, 100, received[100])
    device[[299, 300]] = device[[300, 299]]
    found = account(device, received, block=block)
    assert [gap.lost for gap in found.gaps] == [1, 3, 120, 180]
    assert [gap.seconds for gap in found.gaps[2:]] == pytest.approx([2.0, 3.0], abs=0.03)
    assert (found.gaps[2].start_ns - T0) * 1e-9 == pytest.approx(20.0, abs=0.02)
    assert (found.duplicates, found.out_of_order, found.count) == (1, 1, len(device))
    (jump,) = found.jumps
    assert jump.seconds == pytest.approx(-(LATE * 1e-9 + 2180 / 60 - 0.007), abs=0.01)
    assert (jump.time_ns - T0) * 1e-9 == pytest.approx(2180 / 60, abs=0.02)
    assert found.drift_ppm == pytest.approx(30, abs=max(6 * found.drift_sd_ppm, 5))


@pytest.mark.parametrize("jitter_ms", [0.2, 3.0, 8.0])
def test_drops_by_times_of_reception_alone(jitter_ms):
    """Half a period of jitter, and messages held up for many periods."""
    _, received = messages(2, jitter_ms=jitter_ms)
    (received,) = without([500, 501, 1200], received)
    for device in (None, received):
        found = account(device, received, steady=False)
        assert [gap.lost for gap in found.gaps] == [2, 1]
        assert found.rate_hz == pytest.approx(60, rel=2e-3)


def test_frame_numbers_count_more_than_stamps():
    device, received = messages(3, n=400)
    number = np.arange(400) + 65_000
    device, received, number = without([50, 51, 300], device, received, number)
    found = account(device, received, number)
    assert [gap.lost for gap in found.gaps] == [2, 1]
    number[200:] -= number[200]  # the counter begins again: the stamps tell
    assert account(device, received, number).lost == 3
    number[100] += 10**6  # one damaged number
    assert account(device, received, number).lost == 3


def test_a_camera_that_does_not_count_while_it_is_silent():
    device, received = messages(4, n=600, late=0)
    device[300:] += 2_000_000_000
    received[300:] += 2_000_000_000
    found = account(device, received, np.arange(600))
    assert [(gap.lost, round(gap.seconds, 3)) for gap in found.gaps] == [(120, 2.0)]


def test_the_clock_of_the_computer_jumps_there_and_back():
    device, received = messages(5, rate=200.0, late=0)
    received[1000:] += 5_000_000_000
    received[1400:] -= 5_000_000_000
    found = account(device, received, steady=False)
    assert found.lost == 0
    assert [(jump.clock, round(jump.seconds, 1)) for jump in found.jumps] == [
        ("computer", 5.0), ("computer", -5.0)
    ]  # fmt: skip


def test_times_of_reception_that_go_back_are_a_jump_of_the_computer():
    _, received = messages(7, late=0)
    received[800:] -= 5_000_000_000
    found = account(received, received, steady=False)
    assert [(jump.clock, round(jump.seconds, 2)) for jump in found.jumps] == [
        ("computer", pytest.approx(-5.0, abs=0.02))
    ]  # fmt: skip
    assert found.lost == 0


def test_messages_without_a_stamp_of_the_device():
    device, received = messages(6, rate=10.0, n=200, late=0)
    check = StampCheck(found := StreamAccount("lidar", "lidar"), True)
    for i in range(200):
        check.add(None if i in (0, 60, 61, 199) else int(device[i]), int(received[i]))
    check.finish()
    assert (found.count, found.lost, found.jumps, found.duplicates) == (200, 0, [], 0)


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_hardly_any_messages(n):
    device, received = messages(n=10)
    found = account(device[:n], received[:n])
    assert (found.count, found.lost, found.delta_loss) == (n, 0, 1.0)


def test_a_jump_lies_between_what_all_streams_show():
    clocks = [WallClock(), WallClock()]
    for clock, period in zip(clocks, (100_000_000, 7_000_000), strict=True):
        for time in range(0, 10_000_000_000, period):
            clock.add(T0 + time, T0 + time + (5_000_000_000 if time >= 4_003_000_000 else 0) + time // 20_000)
    (jump,) = (wall := wall_account(clocks)).jumps
    assert 0 <= jump.time_ns - T0 - 4_003_000_000 < 7_000_000 and jump.seconds == pytest.approx(5.0, abs=1e-3)
    assert jump.after_ns < T0 + 4_003_000_000 and wall.slew_ppm == pytest.approx(50, abs=1)
    single = WallClock()
    for i in range(100):
        single.add(T0 + i * 10**7, T0 + i * 10**7 + (5_000_000_000 if i == 50 else 0))
    assert wall_account([single]).jumps == []  # one wrong stamp


def test_encoder_glitches_are_no_motion():
    """A motor that starts at once, a hand that wobbles and noise are none; spikes and leaps are."""
    rng = np.random.default_rng(0)
    time = np.arange(600)
    motor = np.clip(time - 100, 0, 100) * 131.0
    hand = np.rint(30 * np.sin(time / 4) + rng.normal(0, 2, 600))
    spike = np.zeros(600)
    spike[200], spike[300:303] = 64, -500
    leap = np.where(time >= 400, 5000.0, 0.0)
    counts = np.column_stack([motor, hand, spike, leap])
    assert np.argwhere(glitches(np.diff(counts, axis=0))).tolist() == [[199, 2], [299, 2], [399, 3]]
