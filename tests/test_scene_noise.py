"""Noise of dots and errors of poses: told apart by residuals, and what the formulas make of them."""

from dataclasses import replace

import numpy as np
import pytest
from scene_worlds import PINHOLE, dots, names_of, own_views, ring_paths, wander
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from acino_fte.data_tools.camera_paths import CameraPath
from acino_fte.data_tools.rigs import Rig
from acino_fte.data_tools.scene_noise import (
    PointInformation,
    SceneNoise,
    determinant_3x3,
    inverse_3x3,
    median_of_chi2,
    sum_of_each,
)
from acino_fte.data_tools.scene_points import triangulate_points
from acino_fte.data_tools.scene_rows import make_views, pose_shift, scene_rows

TURN, SHIFT, STEP = np.radians(0.05), 0.003, 10


def erring(path, factor, rng):
    """The path as structure from motion has it: errors between key frames every tenth frame, white in these.

    Its covariances are those of its errors, times the square of `factor`.
    """
    n = len(path.frame)
    keys = rng.normal(size=(n // STEP + 2, 6)) * ([TURN] * 3 + [SHIFT] * 3)
    share = (path.frame % STEP / STEP)[:, None]
    error = (1 - share) * keys[path.frame // STEP] + share * keys[path.frame // STEP + 1]
    variance = (1 - share) ** 2 + share**2
    turned = Rotation.from_rotvec(-error[:, :3]).as_matrix() @ path.rotation
    centre = path.centre - error[:, 3:]
    covariance = np.diag([TURN**2] * 3 + [SHIFT**2] * 3) * (factor**2 * variance)[:, :, None]
    return replace(
        path, rotation=turned, translation=-np.einsum("nij,nj->ni", turned, centre), covariance=covariance
    )


def found_noise(views, tracks, n, given=None):
    rows = scene_rows(views, tracks, [f"a{i}" for i in range(n)])
    return triangulate_points(rows, views, given).noise


def free_cameras(seed, factor, noise, n_frames=600, n=3, seen=None):
    """Cameras that err apart: the views as they are believed to be, and dots of the truth."""
    rng = np.random.default_rng(seed)
    true = ring_paths(4, n_frames)
    believed = [erring(path, factor, rng) for path in true]
    tracks = dots(own_views(true), wander(n_frames, n, seed), noise, rng, seen)
    return own_views(believed), tracks


@pytest.mark.parametrize(
    ("factor", "own", "near"), [(0.5, 4.0, 0.27), (0.7, 2.0, 0.12), (1.0, 1.0, 0.05), (2.0, 0.25, 0.22)]
)
def test_noise_of_dots_and_share_of_pose_errors_with_cameras_that_err_apart(factor, own, near):
    """Poses said to be half to twice as uncertain as they are.

    Groups of points differ twofold in what poses do to them: that leaves some freedom, which the law of κ
    about 1 takes. What both noises make together is right.
    """
    found = [found_noise(*free_cameras(seed, factor, 1.0), 3) for seed in range(4)]
    assert np.mean([noise.px for noise in found]) == pytest.approx(1.0, rel=near)
    assert 0.45 * own < np.mean([noise.own for noise in found]) < 1.6 * own
    assert all(noise.common == 0.0 for noise in found)  # nothing says that these cameras hang together
    level = 0.32 / 0.25 * factor**2  # px², of the middle group, found once
    total = [noise.px**2 + noise.own * level for noise in found]
    assert np.mean(total) == pytest.approx(1.0 + 1.28, rel=0.08)


@pytest.mark.parametrize("px", [0.3, 3.0])
def test_any_noise_of_dots(px):
    found = [found_noise(*free_cameras(seed, 1.0, px), 3).px for seed in range(3)]
    assert np.mean(found) == pytest.approx(px, rel=0.07 if px > 1 else 0.2)


def rig_of(n_frames, seed, px, seen=None, n=3):
    """A rig of four cameras that errs as one."""
    rng = np.random.default_rng(seed)
    middle = ring_paths(1, n_frames)[0]
    turns = Rotation.from_rotvec(0.05 * rng.normal(size=(4, 3))).as_matrix()
    offsets = np.array([[0.4, 0.4, 0], [-0.4, 0.4, 0], [-0.4, -0.4, 0], [0.4, -0.4, 0]])
    rig = Rig(("c0", "c1", "c2", "c3"), turns, offsets, None, None, None, 2.0, 0.0, 0.0)
    said = erring(middle, 1.0, rng)

    def views(base):
        paths = [rig.sensor_path(base, name) for name in rig.names]
        return make_views([PINHOLE] * 4, paths, [base], [0] * 4)

    tracks = dots(views(middle), wander(n_frames, n, seed), px, rng, seen)
    return views(said), tracks


@pytest.mark.parametrize("px", [0.2, 1.0, 4.0])
def test_noise_of_dots_with_a_rig(px):
    found = [found_noise(*rig_of(400, seed, px), 3) for seed in range(3)]
    assert np.mean([noise.px for noise in found]) == pytest.approx(px, rel=0.05)
    assert all(noise.own == 1.0 and noise.common == 0.0 for noise in found)


def test_missing_dots_and_gross_errors_change_little():
    seen = np.random.default_rng(1).random((4, 3, 600)) > 0.4
    views, tracks = rig_of(600, 2, 1.0, seen)
    rng = np.random.default_rng(2)
    spoiled = []
    for view in tracks:
        off = (rng.random(len(view)) < 0.05)[:, None] * rng.normal(0, 80.0, (len(view), 2))
        spoiled.append(replace(view, xy=view.xy + off))
    assert found_noise(views, spoiled, 3).px == pytest.approx(1.0, rel=0.06)


def test_a_noise_that_is_given_stays():
    views, tracks = free_cameras(1, 1.0, 1.0)
    assert found_noise(views, tracks, 3, given=1.7).px == pytest.approx(1.7)
    assert found_noise(*rig_of(100, 1, 1.0), 3, given=0.4).px == pytest.approx(0.4)


def test_two_views_alone():
    """One degree of freedom a point is enough."""
    seen = np.zeros((4, 3, 600), dtype=bool)
    seen[:2] = True
    found = [found_noise(*rig_of(600, seed, 1.0, seen), 3).px for seed in range(3)]
    assert np.mean(found) == pytest.approx(1.0, rel=0.05)


def test_nothing_to_tell_from():
    """No point has two views: a pixel, or what is given."""
    seen = np.zeros((4, 3, 50), dtype=bool)
    seen[0] = True
    views, tracks = free_cameras(1, 1.0, 1.0, 50, seen=seen)
    assert found_noise(views, tracks, 3).px == 1.0
    assert found_noise(views, tracks, 3, given=0.5).px == 0.5


def test_the_scene_decides_what_is_common():
    assert SceneNoise(1.0).own == 1.0 and SceneNoise(1.0).common == 0.0
    views, tracks = free_cameras(3, 2.0, 1.0)
    noise = found_noise(replace(views, attached=True), tracks, 3)
    assert noise.common == pytest.approx(max(1.0 - noise.own, 0.0)) and noise.common > 0.5


def dense(rows, views, position, used, noise, t):
    """Position and covariance of point t by the full covariance of its pixels, 2C × 2C."""
    mine = np.flatnonzero((rows.point == t) & used)
    residual, slope = rows.measured.linearise(position)
    j, r = slope[mine].reshape(-1, 3), residual[mine].ravel()
    base = np.repeat(views.base[rows.camera[mine]], 2)
    whole = noise.px**2 * np.eye(len(r))
    moves = [pose_shift(path, rows.frame[t : t + 1], position[t : t + 1])[0] for path in views.bases]
    for b in np.unique(base):
        part = np.where((base == b)[:, None], j, 0.0)
        whole += noise.own * part @ moves[b] @ part.T
    inverse = np.linalg.inv(whole)
    covariance = np.linalg.inv(j.T @ inverse @ j)
    common = np.mean([moves[b] for b in np.unique(base)], axis=0)
    return position[t] + covariance @ j.T @ inverse @ r, covariance + noise.common * common


@pytest.mark.parametrize("grouping", [[0, 1, 2, 3], [0, 0, 1, 2], [0, 0, 1, 1], [0, 0, 0, 0]])
@pytest.mark.parametrize("noise", [SceneNoise(0.7), SceneNoise(1.3, 3.0), SceneNoise(1.0, 0.4, 0.6)])
def test_woodbury_equals_the_dense_covariance(grouping, noise):
    if len(set(grouping)) == 1 and noise.own != 1.0:
        pytest.skip("errors of a rig alone are what they are")
    views, tracks = free_cameras(4, 1.0, 1.0, 12)
    bases: list[CameraPath] = [views.bases[grouping.index(g)] for g in range(max(grouping) + 1)]
    views = replace(views, bases=tuple(bases), base=np.array(grouping))
    seen = np.random.default_rng(0).random(sum(map(len, tracks))) > 0.25
    rows = scene_rows(views, tracks, names_of(range(3)))
    position = triangulate_points(rows, views).position
    found, covariance = PointInformation(rows, views, position, seen).solve(noise)
    checked = 0
    for t in np.flatnonzero(np.bincount(rows.point[seen], minlength=rows.n_points) >= 2):
        expected, spread = dense(rows, views, position, seen, noise, t)
        np.testing.assert_allclose(found[t], expected, atol=1e-10)
        np.testing.assert_allclose(covariance[t], spread, rtol=1e-7, atol=1e-14)
        checked += 1
    assert checked > 25


def test_shift_of_a_point_follows_the_pose():
    """M against finite differences: a pose turned and shifted, with what it sees."""
    path = ring_paths(1, 5)[0]
    root = 1e-3 * np.random.default_rng(0).normal(size=(6, 6))
    path = replace(path, covariance=np.tile(root @ root.T, (5, 1, 1)))
    point = np.array([0.3, -0.4, 0.2])
    moves = np.zeros((3, 6))
    local = path.rotation[2] @ point + path.translation[2]
    for k, step in enumerate(1e-6 * np.eye(6)):
        turned = Rotation.from_rotvec(step[:3]).as_matrix() @ path.rotation[2]
        moves[:, k] = (turned.T @ local + path.centre[2] + step[3:] - point) / 1e-6
    found = pose_shift(path, np.array([2]), point[None])[0]
    np.testing.assert_allclose(found, moves @ path.covariance[2] @ moves.T, rtol=1e-4, atol=1e-12)


def test_small_inverses_and_sums():
    rng = np.random.default_rng(0)
    matrices = rng.normal(size=(500, 3, 3)) * 10.0 ** rng.uniform(-6, 6, (500, 1, 1))
    np.testing.assert_allclose(determinant_3x3(matrices), np.linalg.det(matrices), rtol=1e-8)
    product = inverse_3x3(matrices) @ matrices
    condition = np.linalg.cond(matrices)
    assert (np.abs(product - np.eye(3)).max((1, 2)) < 1e-14 * condition**2).all()
    np.testing.assert_allclose(inverse_3x3(matrices[:4, None]), np.linalg.inv(matrices[:4, None]), rtol=1e-7)
    values, index = rng.normal(size=(30, 2, 3)), rng.integers(0, 7, 30)
    expected = np.zeros((8, 2, 3))
    np.add.at(expected, index, values)
    np.testing.assert_allclose(sum_of_each(values, index, 8), expected, atol=1e-14)
    freedom = np.array([1, 3, 5, 9, 13])
    np.testing.assert_allclose(median_of_chi2(freedom), chi2.median(freedom) / freedom, rtol=0.04)
