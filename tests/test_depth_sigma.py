"""Standard deviations of lidar depths: by range, beam, speed and spacing, against what really comes back."""

from dataclasses import replace

import numpy as np
import pytest

from acino_fte.attaching import Attached
from acino_fte.data_tools.sequence_file import LidarEntry
from acino_fte.depth_sigma import SHAPE, ReturnVariance, group_variance, return_variance
from acino_fte.errors import InputError
from acino_fte.lidar import Lidar
from acino_fte.rig_lidar import LIVOX_AXES
from acino_fte.rig_options import RigOptions
from acino_fte.rig_rays import ray_capsules
from acino_fte.simulate_rig import simulate_rig

RADIUS, HALF, FPS = 0.04, 0.5, 60.0


def lidar(**given):
    return Lidar("cam", np.zeros(0), np.zeros((0, 3)), np.zeros(0), LIVOX_AXES, np.zeros(3), **given)


def level_link(distance, n=1, moves=(0.0, 0.0, 0.0)):
    """A link across the view (N, 2, 3), camera's frame, that moves so many m/s."""
    ends = np.array([[-HALF, 0.0, distance], [HALF, 0.0, distance]])
    return ends + np.arange(n)[:, None, None] / FPS * np.array(moves)


def returns(depth, side, along=0.5, frame=0):
    """Returns attached to that link."""
    side = np.atleast_1d(np.asarray(side, dtype=float))
    count = len(side)
    bulge = np.sqrt(np.maximum(1 - (side / RADIUS) ** 2, 0.3**2))
    whole = np.full(count, frame), np.zeros(count, dtype=int), np.ones(count, dtype=int)
    return Attached(*whole, np.broadcast_to(along, count), side, bulge * RADIUS, bulge, np.full(count, depth))


def variance(given, local, found, way=0.0):
    return return_variance(
        given, found, local, np.full(2, RADIUS), FPS, np.broadcast_to(way, len(found)), carried=True
    )


def test_the_noise_of_a_range_grows_with_it():
    line = lidar(beam=(0.0, 0.0), range_sd_per_m=2e-4)
    own = [variance(line, level_link(r), returns(r, 0.0)).own[0] for r in (1.0, 50.0, 150.0)]
    np.testing.assert_allclose(own, [0.02**2 + (2e-4 * r) ** 2 for r in (1.0, 50.0, 150.0)], rtol=1e-6)


@pytest.mark.parametrize("distance", [20.0, 50.0, 90.0, 150.0])
def test_a_wide_beam_scatters_as_is_said(distance):
    """Rays anywhere in the beam against the capsule itself: errors of those that meet it, over their σ."""
    rng = np.random.default_rng(1)
    given = lidar(range_sd=1e-6, range_sd_per_m=0.0, beam=np.radians([0.02, 0.12]))
    count = 20_000
    aim = rng.uniform(-0.9 * RADIUS, 0.9 * RADIUS, count) / distance
    meant = rng.standard_normal((count, 2)) * given.beam / 4
    direction = np.stack([meant[:, 0], aim + meant[:, 1], np.ones(count)], axis=1)
    length = np.linalg.norm(direction, axis=1)
    ends = level_link(distance)[0]
    capsule = ends[None, :1] + np.zeros((count, 1, 1)), ends[None, 1:] + np.zeros((count, 1, 1))
    met = ray_capsules(np.zeros((count, 3)), direction / length[:, None], *capsule, np.array([RADIUS]))[:, 0]
    on = np.isfinite(met)
    found = returns(distance, np.abs(aim[on]) * distance)
    error = met[on] / length[on] - (distance - found.bulge * RADIUS)
    z = error / np.sqrt(variance(given, level_link(distance), found).own)
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.3


def test_depths_far_away_are_known_less():
    sd = [np.sqrt(variance(lidar(), level_link(r), returns(r, 0.02)).total[0]) for r in (20.0, 50, 90, 150)]
    assert (np.diff(sd) > 0).all()
    assert sd[-1] > 1.15 * sd[0]


def test_the_beam_counts_across_the_link_and_not_along_it():
    """The Tele-15's beam is six times as high as wide: a level link's round sees its height."""
    upright = level_link(90.0)[..., [1, 0, 2]]
    level = variance(lidar(), level_link(90.0), returns(90.0, 0.03)).own[0]
    assert level > 1.1 * variance(lidar(), upright, returns(90.0, 0.03)).own[0]


def test_a_late_lidar_counts_as_far_as_the_animal_moves():
    late = lidar(time_sd=0.005)
    coming = variance(late, level_link(50.0, 3, (0, 0, -10.0)), returns(50.0, 0.0, frame=1))
    assert coming.common[0] == pytest.approx((0.005 * 10) ** 2 + SHAPE**2, rel=0.02)
    still = variance(late, level_link(50.0, 3), returns(50.0, 0.0, frame=1))
    assert still.common[0] == pytest.approx(SHAPE**2)
    rising = variance(late, level_link(50.0, 3, (0, 4.0, 0)), returns(50.0, 0.03, frame=1))
    assert rising.common[0] > 1.3 * SHAPE**2  # the ray passes the round elsewhere
    alone = variance(late, level_link(50.0), returns(50.0, 0.0))
    assert alone.common[0] == pytest.approx(SHAPE**2)  # one frame has no speed


def test_an_error_of_place_is_never_more_than_the_body_is_thick():
    """A pose, a beam or a delay that misses the link altogether: bounded by the round body."""
    lost = lidar(time_sd=1.0, beam=(0.1, 0.1))
    found = variance(lost, level_link(50.0, 3, (0, 9.0, 0)), returns(50.0, [0.0, 0.03, 0.06], frame=1))
    assert (np.sqrt(found.total - 0.02**2 - 0.005**2 - SHAPE**2) < 0.7 * RADIUS).all()


def test_returns_nearer_to_a_marker_and_denser_ones_tell_more():
    ways = np.array([0.0, 0.02, 0.05, 0.15])
    totals = variance(lidar(), level_link(50.0), returns(50.0, np.zeros(4)), ways).total
    assert (np.diff(totals) > 0).all()

    def mean_of(count, links):
        one = ReturnVariance(np.full(count, 4e-4), np.full(count, 1e-4), np.full(count, 1e-4))
        weight, place = np.ones(count), np.zeros(count, dtype=int)
        return group_variance(one, weight, place, np.arange(count) % links, 1)[0]

    assert mean_of(1, 1) == pytest.approx(6e-4)
    assert mean_of(4, 1) == pytest.approx(4e-4 / 4 + 1e-4 + 1e-4)  # the range averages out
    assert mean_of(4, 2) == pytest.approx(4e-4 / 4 + 1e-4 / 2 + 1e-4)  # two links err on their own


def test_a_sequence_file_and_a_lidar_have_the_same_defaults():
    entry = LidarEntry(camera="a", returns="b", calibration="c")
    np.testing.assert_allclose(lidar().beam, np.radians(entry.beam_deg))
    assert (lidar().range_sd, lidar().range_sd_per_m) == (entry.range_sd, entry.range_sd_per_m)
    for beam in ((0.1,), (-0.1, 0.1), 0.1):
        with pytest.raises(InputError, match="beam is not usable"):
            lidar(beam=beam)


def test_a_simulated_beam_has_its_width_and_ranges_their_noise():
    options = RigOptions(n_frames=2, distance=90.0, bushes=0, background=0.0, range_noise_m=0.0)
    plain = simulate_rig(options)
    wide = simulate_rig(replace(options, beam_width_deg=0.02, beam_height_deg=0.12, range_noise_per_m=1e-3))
    np.testing.assert_allclose(wide.lidar.beam, np.radians([0.02, 0.12]))
    assert plain.lidar.beam.max() == 0 and wide.lidar.range_sd_per_m == 1e-3
    error = np.linalg.norm(wide.lidar.xyz, axis=1) - wide.returns.distance
    assert np.std(error / wide.returns.distance) == pytest.approx(1e-3, rel=0.05)
    assert np.abs(np.linalg.norm(plain.lidar.xyz, axis=1) - plain.returns.distance).max() < 1e-9
    hit = [set(s.returns.time[s.returns.on_body].tolist()) for s in (plain, wide)]
    assert len(hit[0] & hit[1]) < 0.9 * len(hit[0] | hit[1])  # at the edges others meet the animal
