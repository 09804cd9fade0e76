"""Smooth paths of scenes: honest errors of rigs, free and fixed cameras; single views, gaps, jumps."""

from dataclasses import replace

import numpy as np
import pytest
from scene_worlds import dots, names_of, nees, own_views, ring_paths, rms, wander

from acino_fte.data_tools.scene import Scene
from acino_fte.data_tools.scene_points import triangulate_points
from acino_fte.data_tools.scene_rows import scene_rows
from acino_fte.data_tools.scene_smoothing import smooth_points, sudden_jumps
from acino_fte.data_tools.scene_tracks import SOURCES
from acino_fte.data_tools.simulate_scene import SceneSimulation, simulate_scene

VIEWS, SINGLE, INTERPOLATED = range(len(SOURCES))
SHORT = SceneSimulation(n_frames=451, n_landmarks=60, landmarks_per_image=8, n_animals=2, gauge=False)
KINDS = {
    "rig": SHORT,
    "free": replace(SHORT, formation="free", path="walk", distance=4.0),
    "fixed": replace(
        SHORT, formation="fixed", path="orbit", distance=4.0, unregistered=0.0, key_step=500, n_frames=101
    ),
}
SCENES = {"rig": 3, "free": 3, "fixed": 16}  # fixed cameras err once in a scene


def solved(options):
    """A simulated scene in its true world, triangulated; NEES/3 and errors by source."""
    simulated = simulate_scene(options)
    variance = [np.radians(options.turn_noise) ** 2] * 3 + [options.centre_noise**2] * 3
    cameras = tuple(
        replace(camera, covariance=np.tile(np.diag(variance), (len(camera.frame), 1, 1)))
        for camera in simulated.cameras()
    )
    scene = Scene("s", cameras, simulated.tracks(), simulated.cloud(), fps=30.0)
    result = scene.triangulate()
    who = np.array([simulated.individuals.index(name) for name in result.tracks.individuals])

    def errors(tracks):
        return tracks.position - simulated.true_positions[who[tracks.individual], tracks.frame]

    return result, errors


@pytest.fixture(scope="module")
def answers():
    return {name: [solved(replace(KINDS[name], seed=seed)) for seed in range(SCENES[name])] for name in KINDS}


def score(answers, source, name="tracks"):
    """Mean NEES/3 over several scenes."""
    scores = []
    for result, errors in answers:
        tracks = getattr(result, name)
        mine = tracks.source == source
        scores.append(nees(errors(tracks)[mine], tracks.covariance[mine]).mean())
    return float(np.mean(scores))


@pytest.mark.parametrize("kind", KINDS)
def test_errors_are_as_large_as_they_say(answers, kind):
    assert 0.7 < score(answers[kind], VIEWS, "points") < 1.4
    assert 0.7 < score(answers[kind], VIEWS) < 1.4
    both = [
        [rms(errors(tracks)[tracks.source == VIEWS]) for tracks in (result.tracks, result.points)]
        for result, errors in answers[kind]
    ]
    smooth, single = np.array(both).T
    assert rms(smooth) < rms(single)


@pytest.mark.parametrize("kind", KINDS)
def test_single_views_have_honest_larger_errors(answers, kind):
    assert score(answers[kind], SINGLE) <= 2.0
    for result, _ in answers[kind]:
        sd = result.tracks.standard_deviation
        single, views = (sd[result.tracks.source == source] for source in (SINGLE, VIEWS))
        assert len(single) > 10 and np.median(single.max(1)) > np.median(views.max(1))


def world(n_cameras=3, n_frames=150, n=2, noise=0.7, seed=0, seen=None):
    rng = np.random.default_rng(seed)
    views = own_views(ring_paths(n_cameras, n_frames, 1e-5, 1e-5))
    positions = wander(n_frames, n, seed)
    return views, positions, dots(views, positions, noise, rng, seen)


def smooth(views, positions, tracks, max_gap=20):
    rows = scene_rows(views, tracks, names_of(positions))
    fit = triangulate_points(rows, views)
    return rows, fit, smooth_points(rows, views, fit, max_gap)


def all_seen(n_cameras=3, n_frames=150, n=2):
    return np.ones((n_cameras, n, n_frames), dtype=bool)


def test_an_individual_that_one_camera_alone_sees_has_no_points():
    seen = all_seen()
    seen[1:, 1] = False
    views, positions, tracks = world(seen=seen)
    rows, _, paths = smooth(views, positions, tracks)
    assert set(paths.individual.tolist()) == {0}
    assert not paths.used[rows.individual[rows.point] == 1].any()


def test_nor_one_that_two_cameras_see_at_different_times():
    seen = all_seen()
    seen[0, 1, 75:], seen[1, 1, :75], seen[2, 1] = False, False, False
    views, positions, tracks = world(seen=seen)
    _, _, paths = smooth(views, positions, tracks)
    assert set(paths.individual.tolist()) == {0}


def test_gaps_are_filled_up_to_the_longest_and_not_beyond():
    seen = all_seen()
    seen[:, 0, 40:60], seen[:, 1, 40:61] = False, False
    views, positions, tracks = world(seen=seen)
    _, _, paths = smooth(views, positions, tracks, max_gap=20)
    short, long = (set(paths.frame[paths.individual == i].tolist()) for i in (0, 1))
    assert set(range(150)) == short and long == set(range(150)) - set(range(40, 61))
    inside = (paths.individual == 0) & (paths.frame >= 40) & (paths.frame < 60)
    assert (paths.source[inside] == INTERPOLATED).all()
    assert (paths.source[~inside] == VIEWS).all()
    error = paths.position[inside] - positions[0, 40:60]
    assert rms(error) < 0.3 and nees(error, paths.covariance[inside]).mean() < 4.0
    spread = np.trace(paths.covariance, axis1=1, axis2=2)
    assert spread[inside].max() > 20 * np.median(spread)
    assert np.argmax(spread[inside]) in range(6, 14)  # least is known in the middle


def test_nothing_before_the_first_dot_or_after_the_last():
    seen = all_seen()
    seen[:, 0, :30], seen[:, 0, 120:] = False, False
    views, positions, tracks = world(seen=seen)
    _, _, paths = smooth(views, positions, tracks)
    frames = paths.frame[paths.individual == 0]
    assert frames[0] == 30 and frames[-1] == 119


def test_single_view_stretches_stay_near_and_say_so():
    seen = all_seen(n_frames=300)
    seen[1:, 0, 100:115] = False
    views, positions, tracks = world(n_frames=300, seen=seen)
    rows, _, paths = smooth(views, positions, tracks)
    inside = (paths.individual == 0) & (paths.frame >= 100) & (paths.frame < 115)
    assert (paths.source[inside] == SINGLE).all() and (paths.source[~inside] == VIEWS).all()
    error = paths.position[inside] - positions[0, 100:115]
    assert rms(error) < 0.1 and nees(error, paths.covariance[inside]).mean() < 3.0
    t = np.flatnonzero(inside)[7]  # unsure along the ray, not across it
    ray = paths.position[t] - views.cameras[0].centre[107]
    ray /= np.linalg.norm(ray)
    along = ray @ paths.covariance[t] @ ray
    across = 0.5 * (np.trace(paths.covariance[t]) - along)
    assert along > 3 * across and np.sqrt(across) < 0.005


@pytest.mark.parametrize("size", [40.0, 300.0])
def test_a_gross_error_in_a_single_view_at_the_end_does_not_take_the_path_away(size):
    """One camera alone sees the last frames, and one of its dots is far off."""
    seen = all_seen(n_frames=200)
    seen[1:, 0, 185:] = False
    views, positions, tracks = world(n_frames=200, seen=seen)
    first = tracks[0]
    for frame in (190, 193, 197):
        bad = (first.frame == frame) & (first.track == 0)
        assert bad.sum() == 1
        moved = first.xy + bad[:, None] * size * np.array([0.8, -0.6])
        rows, _, paths = smooth(views, positions, [replace(first, xy=moved), *tracks[1:]])
        mine = (paths.individual == 0) & (paths.frame >= 185)
        error = np.linalg.norm(paths.position[mine] - positions[0, paths.frame[mine]], axis=1)
        assert error.max() < 0.25
        spoiled = rows.place[(rows.camera == 0)]
        used = np.zeros(len(first), dtype=bool)
        used[spoiled] = paths.used[rows.camera == 0]
        assert not used[bad].any()
        right = (first.frame >= 185) & (first.frame < 199) & (first.track == 0) & ~bad
        assert used[right].mean() > 0.7


def test_gross_errors_everywhere_are_left_out():
    views, positions, tracks = world(n_frames=200)
    rng = np.random.default_rng(1)
    spoiled, wild = [], []
    for view in tracks:
        bad = rng.random(len(view)) < 0.03
        spoiled.append(replace(view, xy=view.xy + bad[:, None] * rng.uniform(30, 150, (len(view), 2))))
        wild.append(bad)
    rows, _, paths = smooth(views, positions, spoiled)
    _, _, clean = smooth(views, positions, tracks)
    bad = np.concatenate([wild[c][rows.place[rows.camera == c]] for c in range(3)])
    assert paths.used[bad].mean() < 0.05 and paths.used[~bad].mean() > 0.98
    error = rms(paths.position - positions[paths.individual, paths.frame])
    assert error < 1.2 * rms(clean.position - positions[clean.individual, clean.frame])


def rows_with(change, n_frames=120):
    """Rows of one camera and one individual on a smooth path, with dots moved as {frame: px}."""
    views, positions, tracks = world(2, n_frames, 1, noise=0.5)
    view = tracks[0]
    xy = view.xy.copy()
    for frame, off in change.items():
        xy[view.frame == frame] += off
    rows = scene_rows(views, [replace(view, xy=xy), tracks[1]], ["a0"])
    return rows, rows.frame[rows.point][rows.camera == 0], rows.camera == 0


def test_sudden_jumps_are_found():
    rows, frame, mine = rows_with({20: [40, 0], 60: [0, -90], 61: [0, 60], 100: [25, 25]})
    found = set(frame[sudden_jumps(rows)[mine]].tolist())
    assert {20, 60, 100} <= found <= {20, 60, 61, 100}
    assert not sudden_jumps(rows)[~mine].any()


def test_smooth_tracks_have_no_sudden_jumps():
    for seed in range(5):
        views, positions, tracks = world(seed=seed, n_frames=300)
        rows = scene_rows(views, tracks, names_of(positions))
        assert sudden_jumps(rows).mean() < 0.002


def test_jumps_in_short_and_empty_tracks():
    rows, *_ = rows_with({}, n_frames=2)
    assert not sudden_jumps(rows).any()
    views, positions, tracks = world(2, 10, 1)
    empty = [view.at_rows(np.zeros(len(view), dtype=bool)) for view in tracks]
    assert len(sudden_jumps(scene_rows(views, empty, ["a0"]))) == 0


def test_the_order_of_rows_means_nothing():
    seen = np.random.default_rng(0).random((3, 2, 150)) > 0.3
    views, positions, tracks = world(seen=seen)
    rng = np.random.default_rng(1)
    _, _, paths = smooth(views, positions, tracks)
    _, _, other = smooth(views, positions, [view.at_rows(rng.permutation(len(view))) for view in tracks])
    np.testing.assert_array_equal(other.frame, paths.frame)
    np.testing.assert_array_equal(other.source, paths.source)
    np.testing.assert_allclose(other.position, paths.position, atol=1e-7)
