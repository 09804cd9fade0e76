"""Smoothed 3D paths: the algebra against dense matrices and filterpy, calibration, wrong rows, gaps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_rigs import thesis_rig
from acino_fte.data_tools.trajectories3d import SOURCES, smooth_trajectories
from acino_fte.data_tools.trajectory_estimate import estimate_motion, log_evidence
from acino_fte.data_tools.trajectory_motion import MotionModel, Pieces, innovations, prior_band
from acino_fte.data_tools.trajectory_rows import ViewRows, make_nodes
from acino_fte.data_tools.trajectory_smoother import ChainFactor
from acino_fte.errors import InputError

SYNTHETIC = Path(__file__).resolve().parents[2] / "shared" / "data" / "tracks" / "synthetic"
MOTION = MotionModel(0.3, (0.7, -0.4))


def draw_paths(motion, n_frames, n_paths, rng):
    """Paths (N, G, 3) from the prior, from the origin."""
    a1, a2 = motion.memory[0] * (1 - motion.memory[1]), motion.memory[1]
    v = np.zeros((n_frames + 200, n_paths, 3))
    for t in range(2, len(v)):
        v[t] = a1 * v[t - 1] + a2 * v[t - 2] + motion.step * rng.normal(size=v[t].shape)
    return np.cumsum(v[200:], axis=0)


def dense_information(pieces, motion, information):
    """H as one matrix, from the innovations of unit vectors."""
    n = pieces.n_nodes
    steps = np.stack(
        [innovations(motion, pieces, np.tile(row[:, None], 3))[:, 0] for row in np.eye(n)], axis=1
    )
    first = pieces.age == 0
    variance = motion.variances[pieces.age]
    prior = steps.T @ (steps / variance[:, None]) + np.diag(first / variance)
    full = np.kron(prior, np.eye(3))
    for t in range(n):
        full[3 * t : 3 * t + 3, 3 * t : 3 * t + 3] += information[t]
    return full


def some_information(n, rng, n_rows=2):
    slope = rng.normal(size=(n, 2 * n_rows, 3)) * 2
    return slope.transpose(0, 2, 1) @ slope


def rows_of(recording):
    return [ViewRows(view.frame, view.xy, view.animal) for view in recording.views]


def paths_of(recording):
    table = recording.truth_3d.sort_values(["frame", "animal"])
    return table[["x", "y", "z"]].to_numpy().reshape(table.frame.nunique(), -1, 3)


def scores(result, truth, source=0):
    """Mean error (m), NEES/3 and share within the 95 % ellipsoid of path points of a source."""
    chosen = result.source == source
    error = result.position[chosen] - truth[result.frame[chosen], result.group[chosen]]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(result.covariance[chosen]), error)
    return np.linalg.norm(error, axis=1).mean(), nees.mean() / 3, (nees < chi2.ppf(0.95, 3)).mean()


@pytest.mark.parametrize(
    ("memory", "difference"),
    [((0.0, 0.0), [1, -1, 0, 0]), ((1.0, 0.0), [1, -2, 1, 0]), ((1.0, -1.0), [1, -3, 3, -1])],
)
def test_the_corners_of_the_prior_are_the_differences(memory, difference):
    np.testing.assert_allclose(MotionModel(1.0, memory).coefficients[3], difference, atol=1e-15)


def test_the_prior_is_the_law_of_a_stationary_process():
    pieces = Pieces(np.array([12]))
    band = prior_band(MOTION, pieces)
    full = np.zeros((12, 12))
    for lag in range(4):
        for t in range(12 - lag):
            full[t, t + lag] = full[t + lag, t] = band[lag, t]
    step = np.diff(np.eye(12), axis=0)
    covariance = step @ np.linalg.inv(full) @ step.T  # of displacements
    drawn = np.diff(draw_paths(MOTION, 13, 40_000, np.random.default_rng(0))[..., 0], axis=0)[:11]
    np.testing.assert_allclose(covariance, np.cov(drawn), atol=0.02 * covariance[0, 0])
    np.testing.assert_allclose(np.diag(covariance), covariance[0, 0], rtol=1e-4)


def test_factor_against_dense_algebra():
    rng = np.random.default_rng(1)
    pieces = Pieces(np.array([7, 1, 12, 2, 3]))
    information = some_information(25, rng)
    factor = ChainFactor(information, MOTION, pieces)
    full = dense_information(pieces, MOTION, information)
    inverse = np.linalg.inv(full)
    right = rng.normal(size=(25, 3))
    np.testing.assert_allclose(factor.solve(right).ravel(), inverse @ right.ravel(), rtol=1e-8, atol=1e-10)
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(full)[1], rel=1e-10)
    blocks = [inverse[3 * t : 3 * t + 3, 3 * t : 3 * t + 3] for t in range(25)]
    np.testing.assert_allclose(factor.covariance(), blocks, rtol=1e-8, atol=1e-10)
    prior = dense_information(pieces, MOTION, np.zeros((25, 3, 3)))
    np.testing.assert_allclose(factor.prior_times(right).ravel(), prior @ right.ravel(), atol=1e-9)


def test_variance_of_the_innovations_against_dense_algebra():
    rng = np.random.default_rng(8)
    pieces, motion = Pieces(np.array([9, 2, 6])), replace(MOTION, tails=4.0)
    information, weight = some_information(17, rng), np.ones(17)
    inverse = np.linalg.inv(dense_information(pieces, MOTION, information))
    _, spread = ChainFactor(information, motion, pieces, weight).covariance_and_spread()
    for t in range(17):
        row = np.zeros(17)
        if pieces.age[t] == 3:
            row[t - 3 : t + 1] = motion.coefficients[3][::-1]
        full = np.kron(row, np.eye(3))
        assert spread[t] == pytest.approx(np.trace(full @ inverse @ full.T), abs=1e-10)


@pytest.mark.parametrize("memory", [(0.96, -0.98), (0.999, 0.0), (0.6, 0.2)])
def test_covariance_stays_exact_along_a_chain_that_is_hardly_seen(memory):
    """Without care the recursion multiplies rounding errors by 1e86 here."""
    rng = np.random.default_rng(2)
    pieces = Pieces(np.array([300]))
    seen = (rng.random((300, 1, 1)) < 0.15) * 1e4
    factor = ChainFactor(some_information(300, rng, 1) * seen, MotionModel(0.003, memory), pieces)
    found = factor.covariance()
    for t in (0, 40, 150, 299):
        columns = []
        for axis in range(3):
            unit = np.zeros((300, 3))
            unit[t, axis] = 1.0
            columns.append(factor.solve(unit)[t])
        np.testing.assert_allclose(
            found[t], np.stack(columns, axis=1), rtol=1e-6, atol=1e-9 * np.trace(found[t])
        )


def test_smoother_equals_kalman_filter_and_rts():
    filterpy = pytest.importorskip("filterpy.kalman")
    rng = np.random.default_rng(3)
    n, motion = 60, MotionModel(0.3, (0.7, -0.4))
    truth = draw_paths(motion, n, 1, rng)[:, 0]
    slope = rng.normal(size=(n, 2, 3))  # one view: two linear measurements a frame
    z = np.einsum("nij,nj->ni", slope, truth) + 0.1 * rng.normal(size=(n, 2))
    kalman = filterpy.KalmanFilter(dim_x=9, dim_z=2)  # place, displacement, the one before
    eye, zero = np.eye(3), np.zeros((3, 3))
    a1, a2 = motion.memory[0] * (1 - motion.memory[1]), motion.memory[1]
    kalman.F = np.block([[eye, a1 * eye, a2 * eye], [zero, a1 * eye, a2 * eye], [zero, eye, zero]])
    kick = np.vstack([eye, eye, zero])
    kalman.Q = motion.step**2 * kick @ kick.T
    v0 = motion.variances[1]
    kalman.P = np.block(
        [
            [100.0 * eye, zero, zero],
            [zero, v0 * eye, motion.memory[0] * v0 * eye],
            [zero, motion.memory[0] * v0 * eye, v0 * eye],
        ]
    )
    kalman.R = 0.01 * np.eye(2)
    means, covariances = [], []
    for t in range(n):
        if t:
            kalman.predict()
        kalman.update(z[t][:, None], H=np.hstack([slope[t], np.zeros((2, 6))]))
        means.append(kalman.x[:, 0].copy())
        covariances.append(kalman.P.copy())
    mean, covariance, _, _ = kalman.rts_smoother(np.array(means), np.array(covariances))
    information = slope.transpose(0, 2, 1) @ slope / 0.01
    information[0] += (0.01 - 1e-9) * np.eye(3)  # the filter's knowledge of the first place
    factor = ChainFactor(information, motion, Pieces(np.array([n])))
    x = factor.solve(np.einsum("nij,ni->nj", slope, z) / 0.01)
    np.testing.assert_allclose(x, mean[:, :3], atol=1e-6)
    np.testing.assert_allclose(factor.covariance(), covariance[:, :3, :3], atol=1e-6)


def test_evidence_against_the_dense_gaussian():
    rng = np.random.default_rng(4)
    pieces, slope = Pieces(np.array([9, 5])), rng.normal(size=(14, 3, 3))
    z, x = rng.normal(size=(14, 3)), rng.normal(size=(14, 3))
    gradient = np.einsum("nij,ni->nj", slope, z - np.einsum("nij,nj->ni", slope, x))
    information = slope.transpose(0, 2, 1) @ slope

    def dense(motion):
        prior = np.linalg.inv(dense_information(pieces, motion, np.zeros((14, 3, 3))))
        big = np.zeros((42, 42))
        for t in range(14):
            big[3 * t : 3 * t + 3, 3 * t : 3 * t + 3] = slope[t]
        covariance = big @ prior @ big.T + np.eye(42)
        return -0.5 * (np.linalg.slogdet(covariance)[1] + z.ravel() @ np.linalg.solve(covariance, z.ravel()))

    other = MotionModel(0.8, (-0.2, 0.3))
    found = log_evidence(x, information, gradient, pieces, MOTION) - log_evidence(
        x, information, gradient, pieces, other
    )
    assert found == pytest.approx(dense(MOTION) - dense(other), rel=1e-4)


@pytest.mark.parametrize("motion", [MotionModel(0.05, (0.6, 0.2)), MotionModel(0.01, (0.97, -0.5))])
def test_the_prior_is_found_from_the_data(motion):
    rng = np.random.default_rng(5)
    truth = draw_paths(motion, 100, 15, rng).transpose(1, 0, 2).reshape(-1, 3)
    seen = truth + 0.02 * rng.normal(size=truth.shape)
    information = np.tile(np.eye(3) / 0.02**2, (1500, 1, 1))
    found = estimate_motion(seen, information, np.zeros_like(seen), Pieces(np.full(15, 100)))
    assert found.step == pytest.approx(motion.step, rel=0.1)
    np.testing.assert_allclose(found.memory, motion.memory, atol=0.1)


@pytest.mark.parametrize("memory", [(0.0, 0.0), (0.9, 0.0), (0.95, -0.6)])
def test_uncertainty_is_exact_for_motion_from_the_prior(memory):
    rng = np.random.default_rng(6)
    step = 0.02
    truth = np.array([1.0, 0.0, 4.0]) + draw_paths(MotionModel(step, memory), 60, 40, rng) * 0.3
    truth = truth[:, (np.abs(truth - [1.0, 0.0, 4.0]) < 1.0).all((0, 2))]
    cameras = thesis_rig()
    frame, group = (part.ravel() for part in np.indices(truth.shape[:2]))
    views = []
    for camera in cameras:
        pixels = camera.project(truth)
        pixels = pixels + 3.0 * rng.normal(size=pixels.shape)
        kept = rng.random(len(frame)) < 0.8
        views.append(ViewRows(frame[kept], pixels.reshape(-1, 2)[kept], group[kept]))
    result = smooth_trajectories(cameras, views, 3.0)
    for source, tolerance in ((0, 0.1), (1, 0.15)):
        _, nees, coverage = scores(result, truth, source)
        assert nees == pytest.approx(1.0, abs=tolerance)
        assert coverage == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize(("motion", "gain"), [("jumpy", 0.98), ("smooth", 0.92)])
def test_error_and_calibration_on_the_motions_of_the_thesis(motion, gain):
    recording = simulate_tracks(TrackSimulation(n_animals=20, n_frames=300, motion=motion, seed=11))
    views, truth = rows_of(recording), paths_of(recording)
    result = smooth_trajectories(recording.cameras, views, 3.0)
    free = smooth_trajectories(recording.cameras, views, 3.0, motion=MotionModel(100.0))
    mean, nees, coverage = scores(result, truth)
    assert mean < gain * scores(free, truth)[0]
    assert 0.9 < nees < 1.1 and coverage == pytest.approx(0.95, abs=0.01)
    assert not any(wrong.any() for wrong in result.wrong)
    assert np.nanmean(result.reprojection) == pytest.approx(3.0 * np.sqrt(0.5), rel=0.25)


@pytest.mark.skipif(not SYNTHETIC.is_dir(), reason="the sets ../shared/data/tracks/synthetic are absent")
@pytest.mark.parametrize(("name", "error"), [("code", 0.0130), ("text", 0.0235)])
def test_error_and_calibration_on_the_reference_sets(name, error):
    folder = SYNTHETIC / f"{name}_n20_s3_clean_seed0"
    table = pd.read_csv(folder / "truth_3d.csv").sort_values(["frame", "animal"])
    truth = table[["x", "y", "z"]].to_numpy().reshape(600, 20, 3)
    views = []
    for c in range(2):
        rows = pd.read_csv(folder / f"cam{c}.csv")
        animal = pd.read_csv(folder / f"cam{c}_truth.csv").animal.to_numpy()
        views.append(ViewRows(rows.frame.to_numpy(), rows[["x", "y"]].to_numpy(), animal))
    result = smooth_trajectories(thesis_rig(), views, 3.0)
    mean, nees, coverage = scores(result, truth)
    assert mean < error and 0.95 < nees < 1.05
    assert coverage == pytest.approx(0.95, abs=0.01)


def test_smoothing_beats_single_frames_where_motion_is_slow():
    recording = simulate_tracks(TrackSimulation(n_animals=8, n_frames=150, motion="flock", seed=2))
    views, truth = rows_of(recording), paths_of(recording)
    smooth = smooth_trajectories(recording.cameras, views, 3.0)
    free = smooth_trajectories(recording.cameras, views, 3.0, motion=MotionModel(10.0))
    assert scores(smooth, truth)[0] < 0.6 * scores(free, truth)[0]


@pytest.mark.parametrize("rig", ["thesis", "moving"])
def test_wrong_rows_are_found_and_bend_nothing(rig):
    options = TrackSimulation(n_animals=8, n_frames=150, motion="flock", seed=3)
    if rig == "moving":
        options = replace(options, rig="ring", n_cameras=3, lens="fisheye", moving=True)
    recording = simulate_tracks(options)
    rng, views, bad = np.random.default_rng(0), [], []
    for view in rows_of(recording):
        bad.append(rng.random(len(view.frame)) < 0.03)
        shift = bad[-1][:, None] * rng.uniform(60, 300, view.xy.shape) * rng.choice([-1, 1], view.xy.shape)
        views.append(replace(view, xy=view.xy + shift))
    result = smooth_trajectories(recording.cameras, views, 3.0)
    clean = smooth_trajectories(recording.cameras, rows_of(recording), 3.0, motion=result.motion)
    for flagged, wrong in zip(result.wrong, bad, strict=True):
        np.testing.assert_array_equal(flagged, wrong)
    assert scores(result, paths_of(recording))[0] < 1.05 * scores(clean, paths_of(recording))[0]


def test_a_sudden_flight_is_no_crowd_of_wrong_rows():
    """A bird that sits for minutes and flies for a third of a second: the prior knows sitting only."""
    path = np.tile([[0.7, 0.1, 4.0]], (200, 1))
    path[100:110] += np.linspace(0, 1, 10)[:, None] * [0.6, -0.3, 0.4]
    path[110:] = path[109]
    rng, cameras = np.random.default_rng(9), thesis_rig()
    views = [
        ViewRows(np.arange(200), camera.project(path) + rng.normal(size=(200, 2)), np.zeros(200, dtype=int))
        for camera in cameras
    ]
    views[1].xy[40] += [50.0, -80.0]
    result = smooth_trajectories(cameras, views, 1.0, motion=MotionModel(0.001))
    assert not result.wrong[0].any() and list(np.flatnonzero(result.wrong[1])) == [40]
    error = np.linalg.norm(result.position - path, axis=1)
    assert error[:95].mean() < 0.003 and error.max() < 0.03


def test_distance_is_that_from_the_path_without_the_row():
    recording = simulate_tracks(TrackSimulation(n_animals=1, n_frames=40, motion="flock", seed=4))
    views = rows_of(recording)
    motion = MotionModel(0.02, (0.9, 0.0))
    whole = smooth_trajectories(recording.cameras, views, 3.0, motion=motion)
    for frame in (5, 20, 39):
        row = int(np.flatnonzero(views[0].frame == frame)[0])
        without = replace(views[0], group=np.where(np.arange(40) == row, -1, views[0].group))
        left = smooth_trajectories(recording.cameras, [without, views[1]], 3.0, motion=motion)
        pixel, covariance = left.predict_pixels(recording.cameras[0], np.array([0]), np.array([frame]))
        offset = views[0].xy[row] - pixel[0]
        expected = offset @ np.linalg.solve(covariance[0] + 9.0 * np.eye(2), offset)
        assert whole.distance[0][row] == pytest.approx(expected, rel=0.03)


def test_predicted_pixels_and_their_spread():
    recording = simulate_tracks(TrackSimulation(n_animals=3, n_frames=40, motion="smooth", seed=5))
    result = smooth_trajectories(recording.cameras, rows_of(recording), 3.0)
    camera = recording.cameras[1]
    pixels, covariance = result.predict_pixels(camera, np.array([2, 0, 7, 1]), np.array([10, 39, 10, 400]))
    assert np.isfinite(pixels[:2]).all() and np.isnan(pixels[2:]).all() and np.isnan(covariance[2:]).all()
    at = int(result.find(np.array([2]), np.array([10]))[0])
    rng = np.random.default_rng(0)
    cloud = camera.project(rng.multivariate_normal(result.position[at], result.covariance[at], 50_000))
    np.testing.assert_allclose(pixels[0], camera.project(result.position[at]), rtol=1e-12)
    np.testing.assert_allclose(covariance[0], np.cov(cloud.T), atol=0.04 * np.trace(covariance[0]))


def test_gaps_are_filled_or_split_and_single_views_are_held():
    recording = simulate_tracks(TrackSimulation(n_animals=2, n_frames=120, motion="flock", seed=6))
    views = []
    for c, view in enumerate(rows_of(recording)):
        dark = (view.frame >= 20) & (view.frame < 25) | (view.frame >= 60) & (view.frame < 90)
        alone = (c == 0) & (view.frame >= 100) & (view.frame < 105)
        kept = ~(dark | alone)
        views.append(ViewRows(view.frame[kept], view.xy[kept], view.group[kept]))
    result = smooth_trajectories(recording.cameras, views, 3.0, max_gap=10, extend=2)
    mine = result.group == 1
    by_frame = dict(zip(result.frame[mine], result.source[mine], strict=True))
    assert [SOURCES[by_frame[f]] for f in (19, 20, 24, 25)] == ["views", "filled", "filled", "views"]
    assert [SOURCES[by_frame[f]] for f in (61, 60, 89, 121, -1, -2)] == ["extended"] * 6
    assert not {62, 87, -3, 122} & set(by_frame)
    assert SOURCES[by_frame[102]] == "single" and result.n_views[mine & (result.frame == 102)] == 1
    assert len(np.unique(result.piece[mine])) == 2
    spread = np.trace(result.covariance, axis1=1, axis2=2)
    middle = [float(spread[mine & (result.frame == f)][0]) for f in (15, 102, 22)]
    assert middle == sorted(middle)  # two views, one, none
    truth = paths_of(recording)
    error = result.position - truth[np.clip(result.frame, 0, 119), result.group]
    assert np.linalg.norm(error[result.source == 2], axis=1).max() < 0.1


def test_moving_cameras_may_begin_late():
    recording = simulate_tracks(
        TrackSimulation(n_animals=3, n_frames=60, motion="flock", rig="ring", n_cameras=3, moving=True)
    )
    plain = smooth_trajectories(recording.cameras, rows_of(recording), 3.0)
    late = [replace(view, frame=view.frame + 1000) for view in rows_of(recording)]
    shifted = smooth_trajectories(recording.cameras, late, 3.0, first_frame=1000, extend=1)
    inner = shifted.source < 3
    np.testing.assert_allclose(shifted.position[inner], plain.position, atol=1e-3)
    pixels, _ = shifted.predict_pixels(recording.cameras[0], np.array([0, 0, 0]), np.array([999, 1000, 1060]))
    np.testing.assert_array_equal(np.isfinite(pixels[:, 0]), [False, True, False])


def test_groups_of_one_view_and_rows_without_a_group_have_no_path():
    recording = simulate_tracks(TrackSimulation(n_animals=4, n_frames=30, motion="flock", seed=7))
    first, second = rows_of(recording)
    first = replace(first, group=np.where(first.group == 1, -1, first.group))
    second = replace(second, group=np.where(second.group == 3, -1, second.group) * 10)
    first = replace(first, group=first.group * 10)
    result = smooth_trajectories(recording.cameras, [first, second], 3.0)
    assert set(result.group) == {0, 20}
    assert (
        np.isnan(result.distance[0][first.group < 0]).all()
        and np.isnan(result.distance[0][first.group == 30]).all()
    )
    assert not result.wrong[0][first.group == 30].any()


def test_a_few_frames_leave_the_prior_broad():
    recording = simulate_tracks(TrackSimulation(n_animals=1, n_frames=3, motion="smooth", seed=1))
    for n in (1, 2, 3):
        views = [ViewRows(v.frame[:n], v.xy[:n], v.group[:n]) for v in rows_of(recording)]
        result = smooth_trajectories(recording.cameras, views, 3.0, extend=1)
        assert len(result) == n + 2
        spread = np.trace(result.covariance, axis1=1, axis2=2)
        assert spread[-1] > 1.5 * spread[-2]  # the next frame is hardly known


def test_no_rows_no_paths():
    empty = ViewRows(np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros(0, dtype=int))
    result = smooth_trajectories(thesis_rig(), [empty, empty], 3.0)
    assert len(result) == 0
    assert (result.find(np.array([0]), np.array([0])) == -1).all()


def test_many_batches_give_what_one_gives(monkeypatch):
    recording = simulate_tracks(TrackSimulation(n_animals=12, n_frames=60, missed=0.2, seed=8))
    motion = MotionModel(0.07, (0.6, 0.2))
    whole = smooth_trajectories(recording.cameras, rows_of(recording), 3.0, motion=motion)
    monkeypatch.setattr("acino_fte.data_tools.trajectory_fit._BATCH", 150)
    parts = smooth_trajectories(recording.cameras, rows_of(recording), 3.0, motion=motion)
    np.testing.assert_allclose(parts.position, whole.position, atol=1e-3)
    np.testing.assert_allclose(parts.covariance, whole.covariance, rtol=0.05, atol=1e-6)


def test_pieces_do_not_overlap_when_extended():
    nodes = make_nodes(np.array([0, 0, 0, 1]), np.array([0, 5, 8, 3]), max_gap=2, extend=3)
    assert list(nodes.group) == sorted(nodes.group)
    pairs = list(zip(nodes.group, nodes.frame, strict=True))
    assert len(set(pairs)) == len(pairs)
    assert [f for g, f in pairs if g == 0] == list(range(-3, 12))
    assert list(nodes.find(np.array([0, 1, 1]), np.array([8, 3, 9]))) == [11, pairs.index((1, 3)), -1]


def test_wrong_input():
    recording = simulate_tracks(TrackSimulation(n_animals=1, n_frames=5))
    with pytest.raises(InputError, match="belong together"):
        smooth_trajectories(recording.cameras, rows_of(recording)[:1], 3.0)
    with pytest.raises(InputError, match="noise"):
        smooth_trajectories(recording.cameras, rows_of(recording), 0.0)
