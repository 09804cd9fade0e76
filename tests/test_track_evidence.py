"""Evidence between tracks of two views: sums against loops, weights against exact Bayes factors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from acino_fte.data_tools.epipolar_angles import PlaneAngles
from acino_fte.data_tools.track_evidence import (
    REACH,
    Dots,
    Noise,
    animals_in_view,
    gather_evidence,
    log_chance,
    memories,
    near_dots,
    shared_frames,
)

SLOPE = 1e-3  # rad/px
CHUNK = 64


def dots(frame, piece, angle, slope=SLOPE, along=1.0, n_pieces=None) -> Dots:
    """Dots sorted by frame."""
    frame, piece, angle = np.asarray(frame, dtype=int), np.asarray(piece), np.asarray(angle)
    order = np.argsort(frame, kind="stable")
    slope, along = (np.broadcast_to(x, frame.shape)[order] for x in (slope, along))
    n = int(piece.max(initial=-1)) + 1 if n_pieces is None else n_pieces
    return Dots(frame[order], piece[order], n, PlaneAngles(angle[order].astype(float), slope, along))


def random_pair(seed: int, n_frames=200, n_pieces=12, spread=0.05, wrap=False) -> tuple[Dots, Dots]:
    """Pieces here and there that wander about a few planes, with missing dots, loose dots and NaN."""
    rng = np.random.default_rng(seed)
    views = []
    planes = rng.uniform(-spread, spread, n_pieces)[:, None] + np.cumsum(
        rng.normal(0, 0.5 * SLOPE, (n_pieces, n_frames)), axis=1
    )
    for side in (0, 1):
        there = rng.random(planes.shape) < 0.7
        begin = rng.integers(0, n_frames // 2, n_pieces)
        there &= np.arange(n_frames) >= begin[:, None]
        piece, frame = np.nonzero(there)
        angle = planes[there] + rng.normal(0, 2 * SLOPE, there.sum())
        if wrap:
            angle = (angle + np.pi + np.pi) % (2 * np.pi) - np.pi
        angle[rng.random(len(angle)) < 0.02] = np.nan
        piece = np.where(rng.random(len(piece)) < 0.05, -1, piece)
        slope = SLOPE * rng.uniform(0.5, 3.0, len(piece))
        along = rng.uniform(1.0, 1.02, len(piece)) + 0.01 * side
        views.append(dots(frame, piece, angle, slope, along, n_pieces))
    return views[0], views[1]


def brute_near(a: Dots, b: Dots, reach: float) -> dict[tuple[int, int], float]:
    """Rows of a and b of one frame and plane, one by one."""
    found = {}
    for i in range(len(a.frame)):
        for j in np.flatnonzero(b.frame == a.frame[i]):
            if a.piece[i] < 0 or b.piece[j] < 0:
                continue
            slopes = a.angles.slope[i], b.angles.slope[j]
            turn = a.angles.angle[i] - b.angles.angle[j]
            turn = (turn + np.pi) % (2 * np.pi) - np.pi
            d = turn / np.hypot(*slopes)
            if abs(d) < reach and b.angles.along[j] - a.angles.along[i] > -reach * sum(slopes):
                found[i, int(j)] = d
    return found


@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize("reach", [1.0, 8.0, 60.0])
def test_near_dots_against_a_loop(wrap, reach):
    a, b = random_pair(3, n_frames=100, wrap=wrap)
    found = {}
    for start, stop, i, j, d in near_dots(a, b, reach):
        assert stop - start == CHUNK
        assert ((a.frame[i] >= start) & (a.frame[i] < stop)).all()
        found |= dict(zip(zip(i.tolist(), j.tolist(), strict=True), d, strict=True))
    wanted = brute_near(a, b, reach)
    assert found.keys() == wanted.keys()
    assert len(found) > 20
    np.testing.assert_allclose([found[k] for k in wanted], list(wanted.values()), atol=1e-6)


def test_no_pair_of_dots_comes_twice():
    a, b = random_pair(5, wrap=True)
    pairs = np.concatenate([np.stack([i, j]) for _, _, i, j, _ in near_dots(a, b, 30.0)], axis=1)
    assert np.unique(pairs, axis=1).shape == pairs.shape


def test_views_without_dots_or_common_frames_are_near_nothing():
    a, b = random_pair(1)
    none = dots([], np.zeros(0, dtype=int), [], n_pieces=0)
    later = replace(b, frame=b.frame + 1000)
    for one, two in ((a, none), (none, b), (none, none), (a, later)):
        assert sum(len(i) for _, _, i, _, _ in near_dots(one, two, 10.0)) == 0
        assert len(gather_evidence(one, two, Noise(1.0)).weight) == 0


@pytest.mark.parametrize("noise", [Noise(2.0), Noise(1.5, 1.0)])
def test_sums_against_a_loop(noise):
    """A chunk counts for a pair that is near in a fourth of the frames that both have in it, or more."""
    a, b = random_pair(7)
    near = brute_near(a, b, REACH * noise.total)
    start = int(min(a.frame.min(), b.frame.min()))
    frames = [
        [set(v.frame[(v.piece == k) & np.isfinite(v.angles.angle)]) for k in range(v.n_pieces)]
        for v in (a, b)
    ]
    wanted = {}
    for k in range(a.n_pieces):
        for m in range(b.n_pieces):
            sums = np.zeros(6)
            both = frames[0][k] & frames[1][m]
            for low in range(start, 200, CHUNK):
                d = [
                    x
                    for (i, j), x in near.items()
                    if a.piece[i] == k and b.piece[j] == m and low <= a.frame[i] < low + CHUNK
                ]
                shared = sum(low <= f < low + CHUNK for f in both)
                if d and len(d) >= 0.25 * shared:
                    n, total, squares = len(d), np.sum(d), np.sum(np.square(d))
                    mean = total**2 / n
                    sums += [n, squares, total, mean / (noise.white**2 + n * noise.slow**2), mean, 1]
            if sums[0]:
                wanted[k, m] = (*sums, len(both))
    e = gather_evidence(a, b, noise, weigh=False)
    assert set(zip(e.a.tolist(), e.b.tolist(), strict=True)) == wanted.keys()
    assert len(wanted) > 10
    columns = e.near, e.squares, e.sums, e.between, e.squared_means, e.chunks, e.shared
    np.testing.assert_allclose(
        np.stack(columns, axis=1), [wanted[k, m] for k, m in zip(e.a, e.b, strict=True)]
    )


def test_shared_frames_against_sets():
    a, b = random_pair(9)
    k, m = (x.ravel() for x in np.meshgrid(range(a.n_pieces), range(b.n_pieces)))
    have = [
        [set(v.frame[(v.piece == p) & np.isfinite(v.angles.angle)]) for p in range(v.n_pieces)]
        for v in (a, b)
    ]
    wanted = [len(have[0][p] & have[1][q]) for p, q in zip(k, m, strict=True)]
    np.testing.assert_array_equal(shared_frames(a, b, k, m), wanted)


def test_chance_of_a_uniform_view():
    """Over an even spread of planes the density is one over it: chance = −log(√(2π) σ √2 g / spread)."""
    rng = np.random.default_rng(1)
    frame = np.repeat(np.arange(2000), 10)
    spread = 0.4
    views = [dots(frame, np.tile(np.arange(10), 2000), rng.uniform(0, spread, len(frame))) for _ in (0, 1)]
    wanted = -np.log(np.sqrt(2 * np.pi) * 3.0 * np.sqrt(2) * SLOPE / spread)
    np.testing.assert_allclose(log_chance(*views, 3.0), wanted, atol=0.05)


def test_chance_against_a_count():
    """Where most dots are, a chance neighbour is likelier: counted within a small window about each dot."""
    rng = np.random.default_rng(2)
    frame = np.repeat(np.arange(4000), 4)
    angle = rng.normal(0, 0.1, len(frame))
    b = dots(frame, np.tile(np.arange(4), 4000), angle)
    middle, side = dots(np.arange(300), np.zeros(300, dtype=int), rng.normal(0, 0.01, 300)), None
    side = dots(np.arange(300), np.zeros(300, dtype=int), rng.normal(0.2, 0.01, 300))
    sigma = 2.0
    for a in (middle, side):
        half = 0.01
        share = [(np.abs(angle - t) < half).mean() for t in a.angles.angle]
        density = np.array(share) / (2 * half) * SLOPE * np.sqrt(2)  # 1/px of d
        wanted = np.mean(-np.log(np.sqrt(2 * np.pi) * sigma * density))
        assert log_chance(a, b, sigma)[0] == pytest.approx(wanted, abs=0.1)
    assert log_chance(side, b, sigma)[0] - log_chance(middle, b, sigma)[0] == pytest.approx(2.0, abs=0.2)


def test_number_of_animals_in_view():
    view = dots([0, 0, 0, 5, 5, 9], [0, 1, 2, 0, 1, -1], [0.0, 0.1, 0.2, 0.0, 0.1, 0.3])
    assert animals_in_view(view) == 2.5


@pytest.mark.parametrize("speed", [0.05, 0.2, 1.0, 8.0])
def test_memory_of_steady_motion(speed):
    """A piece that crosses planes at v px a frame has moved by two standard deviations after 2σ/v frames."""
    n, sigma = 600, 2.0
    rng = np.random.default_rng(4)
    angle = (speed * np.arange(n) + rng.normal(0, sigma, n)) * SLOPE
    memory = memories(dots(np.arange(n), np.zeros(n, dtype=int), angle), sigma)[0]
    assert memory == pytest.approx(max(2 * sigma / speed, 1.0), rel=0.25)


def test_memory_of_a_random_walk():
    """After L steps of s px the root of the mean squared change is s √L: L = (2σ/s)²."""
    n, sigma, step = 4000, 2.0, 0.5
    rng = np.random.default_rng(5)
    walk = np.cumsum(rng.normal(0, step, (20, n)), axis=1) + rng.normal(0, sigma, (20, n))
    frame, piece = np.arange(20 * n), np.repeat(np.arange(20), n)  # one after the other
    memory = memories(dots(frame, piece, walk.ravel() * SLOPE), sigma)
    assert np.median(memory) == pytest.approx((2 * sigma / step) ** 2, rel=0.25)


def test_memory_of_a_resting_animal_is_its_whole_piece():
    n, sigma = 500, 2.0
    angle = np.random.default_rng(6).normal(0, sigma, n) * SLOPE
    assert memories(dots(np.arange(n), np.zeros(n, dtype=int), angle), sigma)[0] == n
    assert memories(dots([7], [0], [0.1]), sigma)[0] == 1


def test_memory_does_not_jump_where_angles_wrap():
    """A resting animal on the far side of the pencil: its angles are about ±π."""
    n, sigma = 300, 2.0
    rest = np.random.default_rng(6).normal(0, sigma, n) * SLOPE
    angle = (rest + 2 * np.pi) % (2 * np.pi) - np.pi
    assert np.ptp(angle) > 6
    here = memories(dots(np.arange(n), np.zeros(n, dtype=int), rest), sigma)
    there = memories(dots(np.arange(n), np.zeros(n, dtype=int), angle), sigma)
    np.testing.assert_allclose(there, here)


def test_memory_of_a_flock_is_that_of_its_members_places():
    """All leave a plane at once and stay beside one another: no frame is a new look at a wrong pair."""
    n, sigma = 400, 2.0
    rng = np.random.default_rng(7)
    common = np.cumsum(rng.normal(0, 20.0, n))
    angle = (common + 15.0 * np.arange(6)[:, None] + rng.normal(0, sigma, (6, n))) * SLOPE
    frame, piece = np.tile(np.arange(n), 6), np.repeat(np.arange(6), n)
    assert memories(dots(frame, piece, angle.ravel()), sigma).min() > n / 4


def two_views(moving: bool, noise: Noise, seed: int, n: int = 192) -> tuple[Dots, Dots]:
    """Ten animals in each of two views: pieces 0 go together, all others are elsewhere."""
    rng = np.random.default_rng(seed)
    spread = 0.5
    if moving:  # everyone is anywhere in each frame
        planes = rng.uniform(0, spread, (19, n))
    else:
        planes = np.repeat(rng.uniform(0, spread, (19, 1)), n, axis=1)
    frame, piece = np.tile(np.arange(n), 10), np.repeat(np.arange(10), n)
    shared = planes[0] + np.sqrt(2) * SLOPE * noise.slow * rng.normal()
    views = []
    for mine in (planes[:10], np.vstack([shared[None], planes[10:]])):
        angle = mine + rng.normal(0, noise.white, mine.shape) * SLOPE
        views.append(dots(frame, piece, angle.ravel()))
    return views[0], views[1]


def weight_of_first(pair, noise) -> float:
    e = gather_evidence(*pair, noise)
    return float(e.weight[(e.a == 0) & (e.b == 0)][0])


def differences(pair) -> np.ndarray:
    one, two = (view.angles.angle[view.piece == 0] for view in pair)
    return (one - two) / (np.sqrt(2) * SLOPE)


@pytest.mark.parametrize("seed", range(3))
def test_weight_is_the_exact_bayes_factor_when_every_frame_is_a_look(seed):
    """L = 1: Σ log N(d; 0, σ²) − log p(d), p the even density of the others."""
    noise, n = Noise(2.0), 192
    pair = two_views(True, noise, seed, n)
    d = differences(pair)
    assert np.abs(d).max() < REACH * noise.total
    wanted = (-np.log(np.sqrt(2 * np.pi) * noise.white) - 0.5 * (d / noise.white) ** 2).sum()
    wanted -= n * np.log(np.sqrt(2) * SLOPE / 0.5)
    assert weight_of_first(pair, noise) == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize("noise", [Noise(2.0), Noise(2.0, 1.5)])
def test_weight_is_the_exact_bayes_factor_when_nothing_moves(noise):
    """L = n: the n differences are one draw, whose covariance is σ² I + σ_s² for the pair, and σ² I about
    some place for others."""
    n = 192
    pair = two_views(False, noise, 1, n)
    d = differences(pair)
    together = multivariate_normal(np.zeros(n), noise.white**2 * np.eye(n) + noise.slow**2).logpdf(d)
    chance = log_chance(*pair, noise.total)[0], log_chance(*pair[::-1], noise.total)[0]
    density = np.exp(-np.mean(chance)) / (np.sqrt(2 * np.pi) * noise.total)
    place = np.linspace(-60, 60, 20_001)
    level = -0.5 * ((d.mean() - place) ** 2) * n / noise.white**2
    about = np.log(np.sum(np.exp(level)) * (place[1] - place[0]) * density)
    alone = about - 0.5 * ((d - d.mean()) ** 2).sum() / noise.white**2
    alone -= n * np.log(np.sqrt(2 * np.pi) * noise.white)
    assert weight_of_first(pair, noise) == pytest.approx(together - alone, abs=0.1)


def test_weight_on_average_tells_right_from_wrong():
    """Right pairs are positive, and no wrong pair is, whether animals move or rest."""
    noise = Noise(2.0)
    for moving in (False, True):
        right, wrong = [], []
        for seed in range(5):
            e = gather_evidence(*two_views(moving, noise, seed), noise)
            same = (e.a == 0) & (e.b == 0)
            right.append(float(e.weight[same][0]))
            wrong.append(e.weight[~same].max(initial=-np.inf))
        assert min(right) > 0
        assert np.mean(np.array(wrong) > 0) <= 0.2


def test_frames_beyond_reach_cost_but_for_one_in_fifty():
    noise, n = Noise(2.0), 200
    pair = two_views(True, noise, 1, n)
    whole = weight_of_first(pair, noise)
    angle = pair[0].angles.angle.copy()
    rows = np.flatnonzero(pair[0].piece == 0)
    k = 24
    angle[rows[:k]] += 100 * SLOPE
    moved = replace(pair[0], angles=replace(pair[0].angles, angle=angle))
    d = differences(pair)[:k]
    earned = 0.5 * (k - (d**2).sum() / noise.white**2)  # what the lost frames had to say about the misfit
    loss = 0.5 * REACH**2 * (k - 0.02 * n)
    assert weight_of_first((moved, pair[1]), noise) == pytest.approx(whole - earned - loss, rel=0.02)
