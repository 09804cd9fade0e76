"""Times of a video's frames on the lidar's clock, against simulated truth."""

import numpy as np
import pytest

from acino_fte.data_tools.sync import Stamps, clock_of, even_losses, from_motion, from_pivot, from_stamps
from acino_fte.data_tools.sync_events import image_motion, knock, lag_of, led_step, region_brightness
from acino_fte.data_tools.sync_grid import Dropped, frame_grid
from acino_fte.data_tools.sync_match import match_video
from acino_fte.errors import InputError

T0 = 1_700_000_000_000_000_000
FPS = 59.94


def kept(rng, n=1500, lost=40):
    """Places of recorded frames; the first and the last are there."""
    gone = rng.choice(np.arange(1, n - 1), lost, replace=False)
    return np.setdiff1d(np.arange(n), gone)


def camera(seed=0, n=1500, lost=40, jitter_ms=3.0, drift=20e-6):
    """Hardware stamps of a camera, received late; true times, s, and places."""
    rng = np.random.default_rng(seed)
    place = kept(rng, n, lost)
    time = place / FPS
    device = 77_000_000_000 + np.rint(time * (1 - drift) * 1e9).astype(np.int64)
    received = T0 + np.rint((time + jitter_ms * 1e-3 * rng.exponential(size=len(time))) * 1e9).astype(
        np.int64
    )
    return Stamps(device, received), time, place


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_the_camera_numbers_its_frames():
    stamps, _, place = camera()
    grid = frame_grid(stamps.device_ns, place + 17)
    assert np.array_equal(grid.place, place)
    assert grid.source == "frame numbers"
    assert 1 / grid.period == pytest.approx(FPS, rel=1e-4)


def test_hardware_stamps_tell_every_dropped_frame():
    stamps, time, place = camera()
    sync = from_stamps(stamps, origin_ns=T0)
    assert np.array_equal(sync.place, place)
    assert sum(run.count for run in sync.dropped) == 40
    assert sync.fps == pytest.approx(FPS, rel=1e-5)
    assert np.abs(sync.frame_time - time).max() * 1e3 < 0.1
    assert sync.method == "stamps"


def test_two_messages_tell_an_offset_only():
    clock, notes = clock_of(Stamps(np.array([5, 105]) * 10**6, T0 + np.array([9, 107]) * 10**6))
    assert clock.to_computer_ns(np.array([200 * 10**6])) == T0 + 202 * 10**6
    assert clock.sd_ms >= 5
    assert "too few" in notes[0]


def test_a_run_of_drops_is_one_entry():
    grid = frame_grid(T0 + np.array([0, 1, 2, 6, 7, 8, 10, 11]) * 10_000_000)
    assert grid.dropped == (Dropped(3, 3), Dropped(6, 1))


def test_frame_numbers_that_do_not_rise_are_not_believed():
    stamps, _, place = camera()
    number = np.where(np.arange(len(place)) < 700, place, place - 650)
    grid = frame_grid(stamps.device_ns, number)
    assert np.array_equal(grid.place, place)
    assert "do not rise" in grid.notes[0]


def test_times_of_reception_are_timed_by_the_beat_below_them():
    """Stamps of 3 ms jitter, as late as 100 ms; 2.7 % of the frames dropped."""
    wrong = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        place = kept(rng)
        late = 0.003 * rng.exponential(size=len(place))
        late += np.where(rng.random(len(place)) < 0.005, 0.1 * rng.exponential(size=len(place)), 0.0)
        stamps = T0 + np.maximum.accumulate(np.rint((place / FPS + late) * 1e9).astype(np.int64))
        sync = from_stamps(Stamps(stamps, stamps), origin_ns=T0)
        right = sync.place == place
        wrong.append(1 - right.mean())
        assert np.abs(sync.frame_time - place / FPS)[right].max() * 1e3 < max(0.3, 5 * sync.sd_ms)
        assert sync.fps == pytest.approx(FPS, rel=1e-4)
        assert any("scatter" in note for note in sync.notes)
    assert np.mean(wrong) < 0.03  # a late frame next to a dropped one cannot be told from its neighbour


def test_the_uncertainty_of_stamps_is_that_of_their_errors():
    squares = []
    for seed in range(40):
        stamps, time, _ = camera(seed, n=300, lost=8)
        sync = from_stamps(stamps, origin_ns=T0)
        squares.append(rms((sync.frame_time - time)[[0, 145, -1]] * 1e3 / sync.sd_ms) ** 2)
    assert 0.15 < np.mean(squares) < 1.8


def test_a_pivot_and_the_thesis_formula():
    """Frame n is (n - pivot) · δ_loss / fps after the pivot."""
    sync = from_pivot(901, 60.0, (300, 12.5), expected=1001)
    loss = 1000 / 900
    assert sync.frame_time == pytest.approx(12.5 + (np.arange(901) - 300) * loss / 60)
    assert sync.frame_time[300] == 12.5
    assert sync.place[-1] == 1000
    assert "δ_loss" in sync.notes[0]


def test_the_uncertainty_of_evenly_spread_losses():
    """Squares of error / sd average to 1, over random losses and readings of the pivot."""
    squares = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        place = kept(rng, 1000, 60)
        time = place / FPS
        pivot = int(rng.integers(0, len(place)))
        read = time[pivot] + rng.uniform(-0.5, 0.5) / FPS + rng.uniform(-0.5, 0.5) / FPS
        sync = from_pivot(len(place), FPS, (pivot, read), expected=1000)
        squares.append(np.mean(((sync.frame_time - time) * 1e3 / sync.frame_sd_ms) ** 2))
    assert 0.75 < np.mean(squares) < 1.3


def test_a_drop_map_is_better_than_losses_spread_evenly():
    rng = np.random.default_rng(4)
    place = kept(rng, 2000, 150)
    time, pivot = place / FPS, 200
    stamps = T0 + np.rint(time * 1e9).astype(np.int64)
    even = from_pivot(len(place), FPS, (pivot, time[pivot]), expected=2000)
    mapped = from_pivot(len(place), FPS, (pivot, time[pivot]), grid=frame_grid(stamps))
    assert np.array_equal(mapped.place, place)
    assert rms(mapped.frame_time - time) < 1e-3 / FPS
    assert rms(even.frame_time - time) > 1 / FPS
    assert mapped.sd_ms < even.sd_ms


def test_a_selection_counts_from_its_first_frame():
    stamps, time, place = camera()
    sync = from_stamps(stamps, origin_ns=T0).select(100, 220)
    assert len(sync.frame_time) == 120
    assert np.array_equal(sync.place, place[100:220] - place[100])
    even = sync.sequence_time(sync.frame_time)
    assert even == pytest.approx(sync.place / sync.fps)
    outside = sync.sequence_time(np.array([time[100] - 0.5, time[219] + 0.5]))
    assert outside == pytest.approx([-0.5, sync.place[-1] / sync.fps + 0.5], abs=1e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: from_pivot(10, 60, (10, 0.0)), "not in the video"),
        (lambda: even_losses(10, 9), "more frames than the camera took"),
        (lambda: frame_grid(np.full(9, T0)), "tell no time"),
        (lambda: frame_grid(np.array([T0])), "tell no time"),
        (lambda: match_video(11, None, Stamps(np.arange(10))), "more frames"),
        (lambda: led_step(np.ones(60)), "No light"),
        (lambda: led_step(np.ones(2)), "too few"),
        (lambda: knock(np.arange(100.0), np.sin(np.arange(100.0))), "No knock"),
        (lambda: region_brightness([np.zeros((4, 4))], (9, 0, 2, 2)), "outside the images"),
    ],
)
def test_what_cannot_be_synchronised_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


# --- a video with fewer frames than messages ------------------------------------------------------------


def test_frames_of_a_video_are_found_by_its_own_times():
    stamps, time, _ = camera(jitter_ms=0, lost=30)
    rng = np.random.default_rng(1)
    rows = np.sort(rng.choice(len(stamps), len(stamps) - 25, replace=False))
    video = np.rint((time[rows] - time[rows[0]]) * 1e3).astype(np.int64) * 1_000_000  # to 1 ms, as Matroska
    found = match_video(len(rows), video, stamps)
    assert np.array_equal(found.rows, rows)
    assert found.sure


def test_a_video_stamped_by_counting_gets_its_losses_spread():
    stamps, *_ = camera(lost=0)
    n = 1450
    found = match_video(n, np.arange(n) * 16_683_350, stamps)
    assert not found.sure
    assert (found.rows[0], found.rows[-1]) == (0, 1499)
    assert f"{1500 / 1450:.5f}" in found.how
    assert match_video(1500, None, stamps).sure


# --- events and motions ---------------------------------------------------------------------------------


def test_a_light_that_goes_on():
    rng = np.random.default_rng(0)
    pictures = [rng.integers(90, 110, (24, 32, 3)).astype(np.uint8) for _ in range(60)]
    for picture in pictures[37:]:
        picture[4:8, 20:24] = 250
    event = led_step(region_brightness(pictures, (19, 3, 6, 6)))
    assert event.time == 36.5
    assert event.sd == pytest.approx(1 / np.sqrt(12))


def test_a_knock_on_the_rig():
    rng = np.random.default_rng(0)
    time = np.arange(1200) / 200.0
    force = np.array([0, 0, 9.81]) + 0.05 * rng.normal(size=(1200, 3))
    ring = np.exp(-np.arange(20) / 5) * np.cos(np.arange(20) * 2.0)
    force[700:720, 2] += 12 * ring
    event = knock(time, force)
    assert abs(event.time - 3.4975) <= 0.0026  # between samples 699 and 700


def turning(rng, time):
    """The amount by which a hand-held rig turns: bursts at random."""
    kernel = np.hanning(80) / np.hanning(80).sum()
    return np.abs(np.convolve(rng.normal(size=len(time)), kernel, "same"))


def test_the_lag_between_two_motions_and_its_uncertainty():
    scores, sds = [], []
    time = np.arange(0, 14, 0.005)
    frame = np.arange(0, 8, 1 / 60)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        rate = turning(rng, time)
        lag = rng.uniform(0.5, 5.5)
        imu = rate + 0.1 * rate.std() * rng.normal(size=len(time))
        image = 40 * (np.interp(frame + lag, time, rate) + 0.3 * rate.std() * rng.normal(size=len(frame)))
        try:
            found = lag_of(frame, image, time, imu)
        except InputError:
            continue  # two bursts alike: refused rather than guessed
        scores.append((found.time - lag) / found.sd)
        sds.append(found.sd)
    assert len(scores) >= 27
    assert 0.6 < rms(scores) < 1.5
    assert np.median(sds) < 0.002  # s, of frames 17 ms apart


def test_motions_that_have_nothing_to_do_with_each_other_are_refused():
    time = np.arange(0, 14, 0.01)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        with pytest.raises(InputError, match="do not tell when"):
            lag_of(time[:800], turning(rng, time[:800]), time, turning(rng, time))


def test_pictures_that_turn_with_the_rig():
    """Images of a wall whose shifts follow the gyroscope's rate, three seconds of them."""
    rng = np.random.default_rng(2)
    time = np.arange(0, 6, 0.005)
    rate = turning(rng, time)
    travel = np.concatenate([[0.0], np.cumsum(rate[:-1]) * 0.005]) * 900 / rate.max() * 0.12
    lag, fps = 1.7, 60.0
    frame = np.arange(0, 3, 1 / fps)
    wall = rng.integers(0, 255, (96, 700)).astype(np.uint8)
    wall = np.repeat(np.repeat(wall[::4, ::4], 4, axis=0), 4, axis=1)
    starts = np.rint(np.interp(frame + lag, time, travel)).astype(int)
    motion = image_motion(wall[:, start : start + 128] for start in starts)
    assert np.abs(np.median(motion[:, 1])) < 0.1
    sync = from_motion(-motion[:, 0], fps, time, rate)
    assert sync.method == "motion"
    assert sync.frame_time[0] == pytest.approx(lag, abs=max(4 * sync.sd_ms * 1e-3, 0.004))
    assert sync.sd_ms < 10
