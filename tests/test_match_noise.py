"""Noise estimated from the tracks themselves, over recordings simulated with a known noise."""

from dataclasses import replace

import numpy as np
import pytest
from test_track_evidence import SLOPE, dots

from acino_fte.data_tools.match_noise import first_noise, matched_noise
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_evidence import Noise, gather_evidence
from acino_fte.data_tools.track_matching import MatchOptions, match_tracks

LEAST = 0.05  # px; below that nobody minds


def estimate(**options) -> Noise:
    recording = simulate_tracks(TrackSimulation(**options))
    return match_tracks(recording, MatchOptions(follow=False)).noise


def close(found: Noise, sigma: float) -> bool:
    return abs(found.total - sigma) <= max(0.1 * sigma, LEAST)


@pytest.mark.parametrize("sigma", [0.0, 0.5, 1.0, 3.0, 5.0, 8.0])
@pytest.mark.parametrize(
    "fault", ["whole", "fragments", "hard", "swaps", "perched", "flock", "ring", "ring with swaps"]
)
def test_within_ten_per_cent(sigma, fault):
    faults = {
        "whole": {},
        "fragments": {"tracks": "fragments"},
        "hard": {"tracks": "fragments", "missed": 0.1, "clutter": 0.1},
        "swaps": {"swap_px": 10.0, "missed": 0.05},
        "perched": {"motion": "perched", "n_animals": 8},
        "flock": {"motion": "flock", "n_animals": 8},
        "ring": {"rig": "ring", "n_cameras": 3, "lens": "distorted", "motion": "smooth"},
        "ring with swaps": {"rig": "ring", "n_cameras": 3, "swap_px": 20.0, "missed": 0.05},
    }
    options = {"n_animals": 12, "n_frames": 300, "seed": 101} | faults[fault]
    found = estimate(noise_px=sigma, **options)
    assert close(found, sigma), found


@pytest.mark.parametrize("n_cameras", [4, 6])
@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_many_cameras_that_move(n_cameras, lens):
    found = estimate(
        n_animals=6,
        n_frames=150,
        rig="ring",
        n_cameras=n_cameras,
        lens=lens,
        moving=True,
        noise_px=2.0,
        seed=7,
    )
    assert close(found, 2.0), found


def test_tracks_too_short_for_a_window():
    found = estimate(n_animals=6, n_frames=200, tracks="fragments", piece_frames=(3, 7), seed=5)
    assert close(found, 3.0), found


def views(noise: Noise, n=2000, n_animals=5, seed=1):
    """Animals that wander from plane to plane; d has a slow part that lasts for a piece."""
    rng = np.random.default_rng(seed)
    plane = rng.uniform(0, 1.0, n_animals)[:, None] + np.cumsum(
        rng.normal(0, 3 * SLOPE, (n_animals, n)), axis=1
    )
    slow = np.repeat(rng.normal(0, noise.slow, (n_animals, -(-n // 64))), 64, axis=1)[:, :n]
    frame, piece = np.tile(np.arange(n), n_animals), np.repeat(np.arange(n_animals), n)
    out = []
    for shift in (0.0, np.sqrt(2) * slow):
        angle = plane + (rng.normal(0, noise.white, plane.shape) + shift) * SLOPE
        out.append(dots(frame, piece, angle.ravel()))
    return out[0], out[1]


@pytest.mark.parametrize("noise", [Noise(2.0), Noise(2.0, 1.0), Noise(1.0, 3.0)])
def test_white_and_slow_noise_of_what_is_matched(noise):
    pair = views(noise)
    e = gather_evidence(*pair, Noise(noise.total), weigh=False)
    found = matched_noise([e], [e.a == e.b], Noise(9.0))
    assert found.white == pytest.approx(noise.white, rel=0.05)
    assert found.slow == pytest.approx(noise.slow, abs=0.15 * noise.total)


def test_noise_that_is_white_has_no_slow_part():
    slow = []
    for seed in range(8):
        pair = views(Noise(2.0), n=640, seed=seed)
        e = gather_evidence(*pair, Noise(2.0), weigh=False)
        slow.append(matched_noise([e], [e.a == e.b], Noise(2.0)).slow)
    assert max(slow) < 0.05 * 2.0  # no calibration is perfect


def test_nothing_matched_keeps_what_was_known():
    pair = views(Noise(2.0), n=64)
    e = gather_evidence(*pair, Noise(2.0), weigh=False)
    before = Noise(7.0, 1.0)
    assert matched_noise([e], [np.zeros(len(e.a), dtype=bool)], before) is before


def test_first_noise_without_pieces_in_common():
    a, b = views(Noise(2.0), n=64)
    assert first_noise([(a, replace(b, frame=b.frame + 5000))], 2000.0) is None


def test_first_noise_before_anything_is_matched():
    for sigma in (0.5, 2.0, 8.0):
        found = first_noise([views(Noise(sigma))], 2000.0)
        assert found is not None
        assert found.total == pytest.approx(sigma, rel=0.25)
