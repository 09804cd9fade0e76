"""Late and moved cameras: interpolation between frames, corrections of a pose, predictions by two routes."""

import numpy as np
import pytest
from conftest import FPS, cameras_about, random_motion
from scipy.spatial.transform import Rotation

from acino_fte import delay
from acino_fte.cameras import CameraArray
from acino_fte.compiled_terms import CompiledTerm, Point
from acino_fte.losses import Loss
from acino_fte.parameters import POSE, Parameters, PriorWidths, cayley_matrix, declare, rotation_vector
from acino_fte.prediction import corrected, corrected_cameras, positions_at, predict, time_offsets
from acino_fte.terms import measurement_term

DT = 1.0 / FPS
N = 7


# --- interpolation -----------------------------------------------------------------------------------


def test_weights_sum_to_one_and_are_one_at_their_nodes():
    u = np.linspace(-3.0, 1.0, 41)
    w = delay.weights(u)
    np.testing.assert_allclose(w[0].sum(0), 1.0, atol=1e-13)
    np.testing.assert_allclose(w[1:].sum(1), 0.0, atol=1e-13)
    np.testing.assert_allclose(delay.weights(np.array([0.0, -1.0, -2.0]))[0], np.eye(3), atol=1e-14)


def test_weights_reproduce_parabolas_and_their_derivatives():
    u = np.linspace(-3.0, 1.0, 41)
    nodes = np.array([0.0, -1.0, -2.0])
    a, b, c = 0.7, -1.3, 0.4
    found = np.einsum("okn,k->on", delay.weights(u), a + b * nodes + c * nodes**2)
    expected = [a + b * u + c * u**2, b + 2 * c * u, np.full_like(u, 2 * c)]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_slopes_of_the_weights_are_their_differences():
    u, step = np.linspace(-2.5, 0.5, 13), 1e-5
    w, up, down = (delay.weights(u + s) for s in (0.0, step, -step))
    np.testing.assert_allclose(w[1:], (up[:2] - down[:2]) / (2 * step), atol=1e-9)


@pytest.mark.parametrize(
    ("n", "newest"), [(3, [2, 2, 2]), (4, [2, 2, 3, 3]), (6, [2, 2, 3, 4, 5, 5])], ids=["3", "4", "6"]
)
def test_stencils_are_centred_and_stay_inside(n, newest):
    assert delay.stencil(np.arange(n), n).tolist() == newest


def test_positions_between_frames():
    """A path of constant acceleration is met exactly: ahead and behind, and at both ends."""
    rng = np.random.default_rng(0)
    p0, v, a = rng.normal(size=(3, 4, 3))

    def path(t):
        return p0 + v * t[:, None, None] + a * t[:, None, None] ** 2

    frames = np.arange(N) * DT
    for late in (0.4 * DT, -1.3 * DT):
        np.testing.assert_allclose(positions_at(path(frames), late, DT), path(frames + late), atol=1e-12)
    np.testing.assert_allclose(positions_at(path(frames), 0.0, DT), path(frames))
    short = path(frames[:2])
    assert positions_at(short, 0.3 * DT, DT) is short  # too few frames for a stencil


def test_a_missing_position_is_missed_by_its_neighbours_only():
    positions = np.zeros((N, 2, 3))
    positions[3, 1] = np.nan
    missing = np.isnan(positions_at(positions, 0.5 * DT, DT)).any(-1)
    assert missing[:, 0].sum() == 0
    assert np.flatnonzero(missing[:, 1]).tolist() == [2, 3, 4]


# --- rotations ---------------------------------------------------------------------------------------


def test_cayley_is_the_rotation_of_its_vector():
    rng = np.random.default_rng(1)
    for size in (1e-9, 1e-3, 0.3, 2.0):
        rho = size * rng.normal(size=3)
        vector = rotation_vector(rho)
        np.testing.assert_allclose(cayley_matrix(rho), Rotation.from_rotvec(vector).as_matrix(), atol=1e-13)
        assert np.linalg.norm(vector) == pytest.approx(2 * np.arctan(np.linalg.norm(rho) / 2), rel=1e-12)
    assert np.array_equal(cayley_matrix(np.zeros(3)), np.eye(3))
    assert np.array_equal(rotation_vector(np.zeros(3)), np.zeros(3))


def test_rotation_vectors_of_many_at_once():
    rho = np.random.default_rng(2).normal(size=(2, 5, 3))
    rho[1, 2] = 0.0
    expected = [[rotation_vector(r) for r in row] for row in rho]
    np.testing.assert_allclose(rotation_vector(rho), expected, atol=1e-14)


@pytest.mark.parametrize("moving", [False, True], ids=["fixed", "moving"])
def test_a_corrected_camera_turns_and_shifts_points_in_its_frame(moving):
    camera = cameras_about(N, moving)[0]
    assert camera.moves == moving
    rng = np.random.default_rng(3)
    correction = np.concatenate([rng.normal(0, 0.1, 3), rng.normal(0, 0.2, 3)])
    points = rng.normal(0, 0.5, (N, 4, 3))
    turn = Rotation.from_rotvec(rotation_vector(correction[:3]))
    expected = turn.apply(camera.to_camera(points).reshape(-1, 3)).reshape(N, 4, 3) + correction[3:]
    np.testing.assert_allclose(corrected(camera, correction).to_camera(points), expected, atol=1e-12)


def test_corrections_and_offsets_are_found_by_camera():
    cameras = cameras_about()
    parameters = declare(("delay", "extrinsics"), None, cameras.names, FPS, PriorWidths())
    theta = np.arange(1.0, 1.0 + len(parameters)) * 1e-3
    assert time_offsets(cameras, parameters, theta) == {"c0": 0.0, "c1": 1e-3, "c2": 2e-3, "c3": 3e-3}
    moved = corrected_cameras(cameras, parameters, theta)
    assert moved[0] is cameras[0]
    second = corrected(cameras[2], theta[[parameters.place("extrinsics", "c2", c) for c in POSE]])
    np.testing.assert_array_equal(moved[2].rotation, second.rotation)
    np.testing.assert_array_equal(moved[2].translation, second.translation)
    none = corrected_cameras(cameras, Parameters(), np.empty(0))
    assert all(a is b for a, b in zip(none, cameras, strict=True))
    assert set(time_offsets(cameras, Parameters(), np.empty(0)).values()) == {0.0}


# --- predictions -------------------------------------------------------------------------------------


@pytest.mark.parametrize("families", [(), ("delay",), ("extrinsics",), ("delay", "extrinsics")], ids="+".join)
@pytest.mark.parametrize("moving", [False, True], ids=["fixed", "moving"])
def test_predictions_are_the_residuals_of_the_problem(lizard, families, moving):
    """Pinhole and fisheye cameras in turn: the program of the measurement term, and plain projection."""
    cameras = cameras_about(N, moving)
    cameras = (
        CameraArray((*cameras[1:], cameras[0])) if moving else cameras
    )  # let one that moves be corrected
    parameters = declare(families, None, cameras.names, FPS, PriorWidths())
    rng = np.random.default_rng(5)
    theta = rng.normal(size=len(parameters)) * parameters.sd
    positions = lizard.positions(random_motion(lizard.skeleton, N, 3))
    found = predict(
        corrected_cameras(cameras, parameters, theta),
        positions,
        time_offsets(cameras, parameters, theta),
        DT,
    )
    assert found.shape == (N, 4, 6, 2)
    pixels = rng.uniform(0, 1000, (N, 6, 2))
    sd = np.arange(1.0, 7.0)
    for c, camera in enumerate(cameras):
        term = measurement_term(camera, pixels, sd, Loss(), N, parameters)
        compiled = CompiledTerm(term, DT, N, 6)
        e = compiled.normalised(Point(np.empty(0), theta, positions))
        observed = np.stack([term.data["u"], term.data["v"]])
        second = (e * term.sd + observed).T.reshape(N, 6, 2)
        np.testing.assert_allclose(found[:, c], second, rtol=0, atol=1e-8)


def test_late_predictions_are_those_of_the_later_animal():
    """Against the projection of the exact path, not of interpolated frames."""
    cameras = cameras_about()
    start, speed = np.array([-0.2, 0.1, 0.0]), np.array([4.0, -1.0, 0.5])

    def path(t):
        return (start + t[:, None] * speed)[:, None]

    times, offsets = np.arange(N) * DT, {"c1": 0.004, "c3": -0.003}
    found = predict(cameras, path(times), offsets, DT)
    for c, camera in enumerate(cameras):
        expected = camera.project(path(times + offsets.get(camera.name, 0.0)))
        np.testing.assert_allclose(found[:, c], expected, atol=1e-8)


def test_points_behind_a_corrected_camera_are_not_predicted():
    cameras = cameras_about()
    around = CameraArray((corrected(cameras[0], np.array([0.0, 0, 0, 0, 0, -10.0])), *cameras[1:]))
    seen = np.isfinite(predict(around, np.zeros((3, 1, 3)), {}, DT)).all(-1)
    assert not seen[:, 0].any()
    assert seen[:, 1:].all()
