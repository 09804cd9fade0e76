"""Triangulation: against per-point least squares and OpenCV, robust, in front of cameras, honest errors."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from data_tools_synthetic import look_at
from scene_worlds import (
    FISHEYE,
    MATRIX,
    PINHOLE,
    disturbed,
    dots,
    exact_path,
    names_of,
    nees,
    own_views,
    ring_paths,
    rms,
    wander,
)
from scipy.optimize import least_squares

from acino_fte.cameras import Camera
from acino_fte.data_tools.rigs import Rig
from acino_fte.data_tools.scene_points import nearest_points, retriangulate, triangulate_points
from acino_fte.data_tools.scene_rows import SceneRows, make_views, scene_rows
from acino_fte.data_tools.tracks2d import Tracks2D

LENSES = {
    "pinhole": replace(PINHOLE, distortion=np.array([-0.12, 0.05, 0.001, -0.0007, 0.01])),
    "fisheye": FISHEYE,
}


def world(n_cameras=4, n_frames=60, n=3, noise=1.0, seed=0, lens=FISHEYE, missed=0.0, turn=0.0, shift=0.0):
    """Views of a ring of cameras without errors, positions (I, N, 3), and dots."""
    rng = np.random.default_rng(seed)
    views = own_views(ring_paths(n_cameras, n_frames, turn, shift), [lens] * n_cameras)
    positions = wander(n_frames, n, seed)
    seen = rng.random((n_cameras, n, n_frames)) >= missed
    return views, positions, dots(views, positions, noise, rng, seen)


def solve(views, positions, tracks, noise_px=None):
    rows = scene_rows(views, tracks, names_of(positions))
    return rows, triangulate_points(rows, views, noise_px)


def truth(rows, positions):
    return positions[rows.individual, rows.frame]


def reference(rows, views, position, t, used):
    """The least-squares point by SciPy, from a start 1 cm off."""
    mine = np.flatnonzero((rows.point == t) & used)
    cameras = [views.cameras[c] for c in rows.camera[mine]]
    poses = [replace(c, rotation=c.rotation[f], translation=c.translation[f]) for c, f in zip(
        cameras, [rows.frame[t] - views.first_frame] * len(mine), strict=True
    )]  # fmt: skip
    seen = rows.measured.xy[mine]

    def misfit(x):
        return (np.stack([pose.project(x[None])[0] for pose in poses]) - seen).ravel()

    return least_squares(misfit, position[t] + 0.01, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=0.01), misfit


@pytest.mark.parametrize("model", LENSES)
def test_points_are_those_of_least_squares(model):
    """To a millionth of a pixel, with two to four views of any lens and a pixel of noise."""
    views, positions, tracks = world(n_frames=25, lens=LENSES[model], missed=0.3)
    rows, fit = solve(views, positions, tracks)
    count = np.bincount(rows.point[fit.used], minlength=rows.n_points)
    for t in np.flatnonzero(np.isfinite(fit.position[:, 0])):
        best, misfit = reference(rows, views, fit.position, t, fit.used)
        moved = misfit(fit.position[t]) - misfit(best.x)
        assert np.abs(moved).max() < 1e-6 if count[t] > 2 else np.abs(moved).max() < 2e-6
    assert {2, 3, 4} <= set(count.tolist())


def test_two_views_without_noise_equal_opencv():
    views, positions, tracks = world(2, noise=0.0, lens=PINHOLE)
    rows, fit = solve(views, positions, tracks)
    np.testing.assert_allclose(fit.position, truth(rows, positions), atol=1e-9)
    first, second = views.cameras
    for t in range(0, rows.n_points, 7):
        f = rows.frame[t]
        projections = [MATRIX @ np.column_stack([c.rotation[f], c.translation[f]]) for c in (first, second)]
        one, two = rows.measured.xy[rows.point == t][..., None]
        found = cv2.triangulatePoints(*projections, one, two).ravel()
        np.testing.assert_allclose(fit.position[t], found[:3] / found[3], atol=1e-8)


@pytest.mark.parametrize("model", LENSES)
def test_exact_without_noise(model):
    views, positions, tracks = world(4, noise=0.0, lens=LENSES[model], missed=0.3)
    rows, fit = solve(views, positions, tracks)
    there = np.isfinite(fit.position[:, 0])
    count = np.bincount(rows.point, minlength=rows.n_points)
    np.testing.assert_array_equal(there, count >= 2)
    np.testing.assert_allclose(fit.position[there], truth(rows, positions)[there], atol=1e-8)
    assert fit.used[count[rows.point] >= 2].all() and not fit.used[count[rows.point] < 2].any()


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
def test_any_number_of_views(n):
    views, positions, tracks = world(n, n_frames=40)
    rows, fit = solve(views, positions, tracks)
    assert np.isfinite(fit.position).all() == (n > 1)
    if n > 1:
        error = fit.position - truth(rows, positions)
        assert rms(error) < 0.01
        assert nees(error, fit.covariance).mean() == pytest.approx(1.0, abs=0.25)
    else:
        assert np.isnan(fit.covariance).all() and not fit.used.any()


def facing(centres, targets, lens=PINHOLE):
    """Views of standing cameras in one frame."""
    paths = []
    for c, (centre, target) in enumerate(zip(centres, targets, strict=True)):
        rotation, _ = look_at(np.array(centre, float), np.array(target, float))
        paths.append(exact_path(f"cam{c}", np.arange(1), rotation[None], np.array(centre, float)[None]))
    return own_views(paths, [lens] * len(paths))


def one_point(views, pixels):
    tracks = [
        Tracks2D(c.name, np.zeros(1, dtype=int), np.zeros(1, dtype=int), np.array([xy], float), ("a0",))
        for c, xy in zip(views.cameras, pixels, strict=True)
    ]
    rows = scene_rows(views, tracks, ["a0"])
    return rows, triangulate_points(rows, views)


def test_rays_that_meet_behind_their_cameras_give_no_point():
    views = facing([[-1, 0, 0], [1, 0, 0]], [[-1, 5, 0], [1, 5, 0]])
    middle = MATRIX[:2, 2]
    _, ahead = one_point(views, [middle + [100, 0], middle - [100, 0]])
    np.testing.assert_allclose(ahead.position, [[0.0, 12.5, 0.0]], atol=0.01)
    _, behind = one_point(views, [middle - [100, 0], middle + [100, 0]])
    assert np.isnan(behind.position).all() and not behind.used.any() and np.isnan(behind.covariance).all()


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_a_point_in_front_of_one_camera_and_behind_the_other_is_none(model):
    views = facing([[0, 0, 0], [0, 1, 0]], [[0, 5, 0], [3, 5, 0]], LENSES[model])
    first, second = (replace(c, rotation=c.rotation[0], translation=c.translation[0]) for c in views.cameras)
    behind_second = np.array([0.02, 0.4, 0.0])
    assert second.to_camera(behind_second)[2] < 0 < first.to_camera(behind_second)[2]
    mirrored = 2 * second.centre - behind_second
    _, fit = one_point(views, [first.project(behind_second[None])[0], second.project(mirrored[None])[0]])
    assert np.isnan(fit.position).all() and not fit.used.any()


def test_parallel_rays_give_no_point():
    views = facing([[-1, 0, 0], [1, 0, 0]], [[-1, 5, 0], [1, 5, 0]])
    middle = MATRIX[:2, 2]
    _, fit = one_point(views, [middle, middle])
    assert np.isnan(fit.position).all() and not fit.used.any()
    same = facing([[0, 0, 0], [0, 0, 0]], [[0, 5, 0], [0.5, 5, 0]])  # one place
    point = np.array([[0.3, 4.0, 0.1]])
    poses = [replace(c, rotation=c.rotation[0], translation=c.translation[0]) for c in same.cameras]
    pixels = [pose.project(point)[0] for pose in poses]
    _, fit = one_point(same, pixels)
    assert np.isnan(fit.position).all()


def spoil(tracks, share, seed=3, only=None):
    rng = np.random.default_rng(seed)
    spoiled, wild = [], []
    for c, view in enumerate(tracks):
        bad = rng.random(len(view)) < (share if only is None or c == only else 0.0)
        angle = rng.uniform(0, 2 * np.pi, len(view))
        off = rng.uniform(20, 150, len(view))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        spoiled.append(replace(view, xy=view.xy + bad[:, None] * off))
        wild.append(bad)
    return spoiled, wild


def test_outliers_are_decided_by_three_and_more_views():
    views, positions, tracks = world(4, n_frames=200)
    clean_rows, clean = solve(views, positions, tracks)
    spoiled, wild = spoil(tracks, 0.04)
    rows, fit = solve(views, positions, spoiled)
    wrong = np.zeros(len(rows.point), dtype=bool)
    for c, bad in enumerate(wild):
        mine = rows.camera == c
        wrong[mine] = bad[rows.place[mine]]
    bad_count = np.bincount(rows.point[wrong], minlength=rows.n_points)
    one = bad_count == 1
    assert one.sum() > 60
    error = np.linalg.norm(fit.position - truth(rows, positions), axis=1)
    assert np.isfinite(error[one]).mean() > 0.98  # decided, not given up
    usual = rms(np.linalg.norm(clean.position - truth(clean_rows, positions), axis=1))
    assert rms(error[one & np.isfinite(error)]) < 1.6 * usual
    decided = one[rows.point] & np.isfinite(error)[rows.point]
    assert fit.used[wrong & decided].mean() < 0.03  # some along the epipolar lines remain
    assert fit.used[~wrong & decided].mean() > 0.98
    untouched = bad_count == 0
    np.testing.assert_allclose(fit.position[untouched], clean.position[untouched], atol=2e-4)
    assert fit.noise.px == pytest.approx(clean.noise.px, rel=0.1)


def test_a_contradiction_of_two_views_is_given_up():
    views, positions, tracks = world(2, n_frames=200)
    spoiled, wild = spoil(tracks, 0.1, only=1)
    rows, fit = solve(views, positions, spoiled)
    bad = np.zeros(rows.n_points, dtype=bool)
    for p in np.flatnonzero(rows.camera == 1):
        bad[rows.point[p]] = wild[1][rows.place[p]]
    position = nearest_points(rows, np.ones(len(rows.point), dtype=bool))
    residual, _ = rows.measured.linearise(position)
    off = np.sqrt(np.bincount(rows.point, np.nan_to_num((residual**2).sum(1), nan=np.inf)))
    across = bad & (off > 8.0)  # the rays do not meet
    assert across.sum() > 30
    assert np.isnan(fit.position[across]).all() and not fit.used[across[rows.point]].any()
    assert np.isfinite(fit.position[~bad]).mean() > 0.99


def test_points_seen_worse_than_others_are_still_points():
    """One individual in ten, four times as noisy: no dot of it stands out."""
    views, positions, tracks = world(6, n_frames=100, n=10)
    rng = np.random.default_rng(5)
    worse = [
        replace(view, xy=view.xy + (view.track == 0)[:, None] * 4.0 * rng.normal(size=view.xy.shape))
        for view in tracks
    ]
    rows, fit = solve(views, positions, worse)
    mine = rows.individual == 0
    assert np.isfinite(fit.position[mine]).all(1).mean() > 0.95 and np.isfinite(fit.position[~mine]).all()
    error = fit.position - truth(rows, positions)
    assert rms(error[mine & np.isfinite(error[:, 0])]) < 8 * rms(error[~mine])


def test_a_noise_that_is_given_decides_what_is_wrong():
    """Ten pixels off is wrong where dots have a pixel of noise, not where they are said to have five."""
    views, positions, tracks = world(4, n_frames=100)
    off = np.where(np.arange(len(tracks[0])) % 5 == 0, 10.0, 0.0)[:, None] * np.array([0.6, 0.8])
    moved = [replace(tracks[0], xy=tracks[0].xy + off), *tracks[1:]]
    rows, strict = solve(views, positions, moved)
    _, lenient = solve(views, positions, moved, 5.0)
    hit = (rows.camera == 0) & (rows.place % 5 == 0)
    assert strict.used[hit].mean() < 0.05 and lenient.used.all()
    assert strict.used[~hit].mean() > 0.99 and lenient.noise.px == 5.0


def test_a_wrong_view_of_three_may_be_any():
    views, positions, tracks = world(3, n_frames=40, noise=0.5)
    for c in range(3):
        shift = np.zeros((len(tracks[c]), 2))
        shift[::10] = [45.0, 60.0]
        moved = [replace(v, xy=v.xy + shift) if k == c else v for k, v in enumerate(tracks)]
        rows, fit = solve(views, positions, moved)
        hit = np.zeros(len(rows.point), dtype=bool)
        mine = rows.camera == c
        hit[mine] = (shift != 0).any(1)[rows.place[mine]]
        points = np.unique(rows.point[hit])
        there = np.isfinite(fit.position[points, 0])
        error = np.linalg.norm(fit.position[points] - truth(rows, positions)[points], axis=1)
        assert there.mean() > 0.8 and (error[there] < 0.02).mean() > 0.9


def test_covariance_equals_monte_carlo_with_cameras_that_err_apart():
    """Pixels and poses drawn anew many times."""
    turn, shift, n = 0.001, 0.004, 600
    rng = np.random.default_rng(0)
    point = np.array([0.2, -0.3, 0.1])
    true = [path for path in ring_paths(3, 1, turn, shift)]
    poses = [(np.tile(p.rotation, (n, 1, 1)), np.tile(p.centre, (n, 1))) for p in true]
    many = [exact_path(p.name, np.arange(n), *pose, turn, shift) for p, pose in zip(true, poses, strict=True)]
    positions = np.tile(point, (1, n, 1))
    tracks = dots(own_views(many), positions, 1.0, rng)
    believed = [disturbed(p, turn * rng.normal(size=(n, 3)), shift * rng.normal(size=(n, 3))) for p in many]
    views = own_views(believed)
    rows = scene_rows(views, tracks, ["a0"])
    fit = triangulate_points(rows, views)
    error = fit.position - point
    there = np.isfinite(error[:, 0])
    assert there.mean() > 0.98
    assert nees(error[there], fit.covariance[there]).mean() == pytest.approx(1.0, abs=0.15)
    found, said = np.cov(error[there].T), fit.covariance[there].mean(0)
    unit = np.sqrt(np.outer(np.diag(said), np.diag(said)))
    np.testing.assert_allclose(found / unit, said / unit, atol=0.2)


def test_covariance_equals_monte_carlo_with_a_rig():
    turn, shift, n = 0.002, 0.004, 600
    rng = np.random.default_rng(1)
    one = ring_paths(1, 1)[0]
    pose = np.tile(one.rotation, (n, 1, 1)), np.tile(one.centre, (n, 1))
    base = exact_path("rig", np.arange(n), *pose, turn, shift)
    offsets = np.array([[0.4, 0.4, 0], [-0.4, 0.4, 0], [-0.4, -0.4, 0], [0.4, -0.4, 0]])
    rig = Rig(("a", "b", "c", "d"), np.tile(np.eye(3), (4, 1, 1)), offsets, None, None, None, 2.0, 0.0, 0.0)

    def views_of(path):
        paths = [rig.sensor_path(path, name) for name in rig.names]
        return make_views([PINHOLE] * 4, paths, [path], [0] * 4)

    point = np.array([0.2, -0.3, 0.1])
    tracks = dots(views_of(base), np.tile(point, (1, n, 1)), 1.0, rng)
    views = views_of(disturbed(base, turn * rng.normal(size=(n, 3)), shift * rng.normal(size=(n, 3))))
    rows = scene_rows(views, tracks, ["a0"])
    fit = triangulate_points(rows, views)
    assert fit.noise.px == pytest.approx(1.0, rel=0.05)  # what is common does not show in residuals
    error = fit.position - point
    assert nees(error, fit.covariance).mean() == pytest.approx(1.0, abs=0.12)
    found, said = np.cov(error.T), fit.covariance.mean(0)
    unit = np.sqrt(np.outer(np.diag(said), np.diag(said)))
    np.testing.assert_allclose(found / unit, said / unit, atol=0.15)


def test_the_same_again_whatever_the_order_of_rows_and_cameras():
    views, positions, tracks = world(5, missed=0.4, turn=0.0005, shift=0.002)
    tracks, _ = spoil(tracks, 0.03)
    rows, fit = solve(views, positions, tracks)
    _, again = solve(views, positions, tracks)
    np.testing.assert_array_equal(fit.position, again.position)
    rng = np.random.default_rng(1)
    shuffled = [view.at_rows(rng.permutation(len(view))) for view in tracks]
    other_rows, other = solve(views, positions, shuffled)
    np.testing.assert_allclose(other.position, fit.position, atol=1e-10)
    for c in range(5):
        place = np.full(len(tracks[c]), False)
        place[rows.place[rows.camera == c]] = fit.used[rows.camera == c]
        moved = np.full(len(tracks[c]), False)
        moved[other_rows.place[other_rows.camera == c]] = other.used[other_rows.camera == c]
        at = {(f, t): u for f, t, u in zip(tracks[c].frame, tracks[c].track, place, strict=True)}
        assert all(at[f, t] == u for f, t, u in zip(shuffled[c].frame, shuffled[c].track, moved, strict=True))
    order = [3, 0, 4, 1, 2]
    paths = [views.bases[c] for c in order]
    turned = own_views(paths, [FISHEYE] * 5)
    _, other = solve(turned, positions, [tracks[c] for c in order])
    np.testing.assert_allclose(other.position, fit.position, atol=1e-6)
    np.testing.assert_allclose(other.covariance, fit.covariance, rtol=1e-4, atol=1e-12)
    assert other.noise.px == pytest.approx(fit.noise.px, rel=1e-6)


@pytest.mark.parametrize("poses", [0.0, 0.002])
def test_triangulated_again_equals_triangulated_anew(poses):
    views, positions, tracks = world(4, n_frames=80, turn=poses / 4, shift=poses)
    rows, fit = solve(views, positions, tracks, 1.0)
    rng = np.random.default_rng(4)
    used = fit.used & (rng.random(len(fit.used)) > 0.2)
    changed = retriangulate(rows, views, fit, used)
    anew_tracks, places = [], []
    for c, view in enumerate(tracks):
        keep = np.zeros(len(view), dtype=bool)
        keep[rows.place[(rows.camera == c) & used]] = True
        anew_tracks.append(view.at_rows(keep))
        places.append(keep)
    anew_rows, anew = solve(views, positions, anew_tracks, 1.0)
    again = {(i, f): t for t, (i, f) in enumerate(zip(anew_rows.individual, anew_rows.frame, strict=True))}
    compared = 0
    for t in range(rows.n_points):
        other = again.get((rows.individual[t], rows.frame[t]))
        if other is None or not np.isfinite(anew.position[other, 0]):
            assert np.isnan(changed.position[t]).all()
            continue
        np.testing.assert_allclose(
            changed.position[t], anew.position[other], atol=2e-6 if poses == 0 else 1e-3
        )
        if poses == 0:
            np.testing.assert_allclose(changed.covariance[t], anew.covariance[other], rtol=1e-6)
        compared += 1
    assert compared > 150
    assert retriangulate(rows, views, fit, fit.used) is fit
    none = retriangulate(rows, views, fit, np.zeros(len(fit.used), dtype=bool))
    assert np.isnan(none.position).all() and not none.used.any()


def test_no_dots_at_all():
    views, positions, tracks = world(3, n_frames=10)
    empty = [view.at_rows(np.zeros(len(view), dtype=bool)) for view in tracks]
    rows, fit = solve(views, positions, empty)
    assert isinstance(rows, SceneRows) and fit.position.shape == (0, 3) and fit.noise.px > 0


def test_dots_without_a_pose_or_a_track_or_outside_of_the_lens_do_not_take_part():
    views, positions, tracks = world(3, n_frames=20)
    known = views.known.copy()
    known[1, 5:9] = False
    views = replace(views, known=known)
    odd = tracks[0]
    track = odd.track.copy()
    track[:4] = -1
    late = replace(odd, track=track, frame=np.where(np.arange(len(odd)) == 10, 99, odd.frame))
    rows = scene_rows(views, [late, *tracks[1:]], names_of(positions))
    places = [rows.place[rows.camera == c] for c in range(3)]
    assert not {0, 1, 2, 3, 10} & set(places[0].tolist()) and len(places[0]) == len(odd) - 5
    assert not set(tracks[1].frame[places[1]].tolist()) & {5, 6, 7, 8}
    strong = Camera(
        "lens", "pinhole", MATRIX, [-0.3, 0.0, 0.0, 0.0, 0.0], np.eye(3), np.zeros(3), (2704, 1520)
    )
    wide = own_views(list(views.bases), [strong] * 3)
    far = replace(tracks[0], xy=tracks[0].xy + np.array([9000.0, 0.0]))
    assert not (scene_rows(wide, [far, *tracks[1:]], names_of(positions)).camera == 0).any()
