"""Cameras left out: what is fitted to them, that no frame is scored with its own fit, and what is counted."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import FPS, cameras_about, make_sequence, random_motion

from acino_fte.cameras import CameraArray
from acino_fte.errors import InputError
from acino_fte.holdout import HeldOut, check_cameras, fit_camera, hold_out, holdout_metrics, without_camera
from acino_fte.parameters import PriorWidths, declare
from acino_fte.prediction import corrected_cameras, predict, time_offsets
from acino_fte.result import FTEResult, Status
from acino_fte.simulate import SimulationOptions, simulate

N = 40


def wandering(lizard, n=N, seed=0):
    """A motion that crosses the view: what a camera's turn and its shift do then differs."""
    q, t = random_motion(lizard.skeleton, n, seed), np.arange(n) / FPS
    q[:, :3] = np.stack([1.2 * np.sin(5.7 * t), 0.8 * np.cos(8.2 * t), 0.3 * np.sin(12.6 * t)], axis=1)
    return q


def seen(camera, positions, parameters, theta):
    """Pixels (N, M, 2) that a camera sees with some offset and correction."""
    view = CameraArray((camera,))
    moved = corrected_cameras(view, parameters, theta)
    return predict(moved, positions, time_offsets(view, parameters, theta), 1 / FPS)[:, 0]


def noisy(pixels, rng, outliers=0.2):
    pixels = pixels + rng.normal(0, 2.0, pixels.shape)
    wild = rng.random(pixels.shape[:-1]) < outliers
    pixels[wild] += rng.normal(0, 150, (wild.sum(), 2))
    return pixels


# --- the fit of one camera ---------------------------------------------------------------------------


@pytest.mark.parametrize("model", [0, 1], ids=["pinhole", "fisheye"])
def test_a_known_delay_and_correction_are_recovered(lizard, model):
    """2 px of noise and one outlier in five: to their information, and to 0.1 ms, 3 mm and 0.05°."""
    n, camera = 200, cameras_about()[model]
    parameters = declare(("delay", "extrinsics"), None, ["", camera.name], FPS, PriorWidths())
    errors, normalised = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        positions = lizard.positions(wandering(lizard, n, seed))
        truth = 0.7 * rng.normal(size=7) * parameters.sd
        pixels = noisy(seen(camera, positions, parameters, truth), rng)
        found, theta = fit_camera(camera, pixels, positions, FPS, np.full(6, 2.0))
        assert found.names == parameters.names
        errors.append(theta - truth)
        steps = 1e-5 * np.diag(parameters.sd)
        slope = np.stack(
            [
                (
                    seen(camera, positions, parameters, truth + s)
                    - seen(camera, positions, parameters, truth - s)
                ).ravel()
                / 2e-5
                for s in steps
            ],
            axis=1,
        )
        information = 0.8 * slope.T @ slope / 2.0**2 + np.eye(7)  # of the inliers, and the prior
        normalised.append(errors[-1] / parameters.sd / np.sqrt(np.diag(np.linalg.inv(information))))
    late, turn, shift = np.split(np.array(errors), [1, 4], axis=1)
    assert np.abs(late).mean() < 0.1e-3
    assert np.linalg.norm(turn, axis=1).mean() < np.radians(0.05)
    assert np.linalg.norm(shift, axis=1).mean() < 3e-3
    assert np.sqrt(np.mean(np.square(normalised))) == pytest.approx(1.0, abs=0.4)


def test_camera_of_a_gallop(cheetah):
    """The exact motion at the exact times, not interpolated; predictions to a few tenths of a pixel."""
    options = SimulationOptions(n_frames=120, delay_ms=6.0, moved_mm=20.0, moved_deg=0.3, occlusion=False)
    simulation = simulate(cheetah.skeleton, options)
    rng = np.random.default_rng(1)
    for c in (1, 4):
        camera, exact = simulation.cameras[c], simulation.pixels[:, c]
        pixels = noisy(exact, rng)
        parameters, theta = fit_camera(camera, pixels, simulation.positions, 120.0, np.full(24, 2.0))
        view = CameraArray((camera,))
        late = time_offsets(view, parameters, theta)
        assert late[camera.name] == pytest.approx(
            simulation.parameters["time_offset_s"][camera.name], abs=0.3e-3
        )
        moved = corrected_cameras(view, parameters, theta)
        error = np.linalg.norm(predict(moved, simulation.positions, late, 1 / 120)[:, 0] - exact, axis=-1)
        assert np.nanmedian(error) < 0.4
        nominal = np.linalg.norm(camera.project(simulation.positions) - exact, axis=-1)
        assert np.nanmedian(nominal) > 2


def test_exact_pixels_give_exact_parameters(lizard):
    """But for the pull of the priors."""
    camera, positions = cameras_about()[1], lizard.positions(wandering(lizard))
    parameters = declare(("delay", "extrinsics"), None, ["", camera.name], FPS, PriorWidths())
    truth = parameters.sd * np.array([0.8, -0.5, 0.4, 0.3, 0.5, -0.4, 0.6])
    pixels = seen(camera, positions, parameters, truth)
    _, theta = fit_camera(camera, pixels, positions, FPS, np.full(6, 0.02))
    np.testing.assert_allclose(theta / parameters.sd, truth / parameters.sd, atol=1e-3)


@pytest.mark.parametrize(
    ("families", "n", "expected"),
    [(("delay",), N, 1), (("extrinsics",), N, 6), ((), N, 0), (("delay", "extrinsics"), 2, 6)],
)
def test_only_what_is_asked_for_and_possible_is_fitted(lizard, families, n, expected):
    camera, positions = cameras_about()[0], lizard.positions(wandering(lizard)[:n])
    pixels = noisy(camera.project(positions), np.random.default_rng(0))
    parameters, theta = fit_camera(camera, pixels, positions, FPS, np.full(6, 2.0), families)
    assert len(parameters) == len(theta) == expected


def test_without_detections_nothing_moves(lizard):
    camera, positions = cameras_about()[0], lizard.positions(wandering(lizard))
    parameters, theta = fit_camera(camera, np.full((N, 6, 2), np.nan), positions, FPS, np.full(6, 2.0))
    assert len(theta) == 7
    assert not theta.any()


def test_a_single_detection_moves_little(lizard):
    """Seven parameters and two numbers: the priors decide."""
    camera, positions = cameras_about()[0], lizard.positions(wandering(lizard))
    pixels = np.full((N, 6, 2), np.nan)
    pixels[7, 2] = camera.project(positions)[7, 2] + 4.0
    parameters, theta = fit_camera(camera, pixels, positions, FPS, np.full(6, 2.0))
    assert 0 < np.abs(theta / parameters.sd).max() < 1
    error = seen(camera, positions, parameters, theta)[7, 2] - pixels[7, 2]
    assert np.abs(error).max() < 2


@pytest.mark.parametrize("lost", [0, 2, 20, N - 3, N - 1])
def test_frames_whose_stencil_lacks_a_position_are_left_out(lizard, lost):
    """At both ends a stencil reaches two frames inwards."""
    camera, positions = cameras_about()[0], lizard.positions(wandering(lizard))
    parameters = declare(("delay", "extrinsics"), None, ["", camera.name], FPS, PriorWidths())
    pixels = seen(camera, positions, parameters, 0.5 * parameters.sd)
    pixels += np.random.default_rng(0).normal(0, 2.0, pixels.shape)
    holes = positions.copy()
    holes[lost, 3] = np.nan
    needed = [np.clip(n, 1, N - 2) + np.arange(-1, 2) for n in range(N)]
    cut = pixels.copy()
    cut[[n for n in range(N) if lost in needed[n]], 3] = np.nan
    assert np.isnan(cut[:, 3, 0]).sum() in (2, 3, 4)
    found, expected = (
        fit_camera(camera, p, at, FPS, np.full(6, 2.0))[1] for p, at in ((pixels, holes), (cut, positions))
    )
    assert np.array_equal(found, expected)


# --- leaving out -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(lizard):
    """A lizard before four cameras, of which c2 is late; the true positions."""
    q = wandering(lizard)
    cameras, positions = cameras_about(), lizard.positions(q)
    pixels = noisy(predict(cameras, positions, {"c2": 0.4 / FPS}, 1 / FPS), np.random.default_rng(0), 0.05)
    pixels[np.random.default_rng(1).random(pixels.shape[:3]) < 0.2] = np.nan
    return make_sequence(lizard, q, cameras, pixels=pixels), positions


def estimator(lizard, positions, calls=None, parameters=None):
    """An estimate that knows the positions."""

    def estimate(sequence):
        if calls is not None:
            calls.append(sequence)
        none = np.zeros((len(positions), 9))
        pixels = np.full((len(positions), len(sequence.cameras), 6, 2), np.nan)
        return FTEResult(
            Status.ACCEPTABLE,
            sequence,
            lizard.skeleton,
            none,
            none,
            none,
            positions,
            pixels,
            pixels,
            0.0,
            1,
            "test",
            parameters=parameters or {},
        )

    return estimate


def test_every_camera_is_left_out_once(lizard, recording):
    sequence, positions = recording
    calls = []
    held = list(hold_out(sequence, estimator(lizard, positions, calls)))
    assert [h.camera for h in held] == ["c0", "c1", "c2", "c3"]
    assert [h.status for h in held] == ["acceptable"] * 4
    for name, given in zip(sequence.cameras.names, calls, strict=True):
        assert name not in given.cameras.names
        assert given.cameras.names == [str(c) for c in given.detections.camera.values]
        assert len(given.cameras) == 3
    one = list(hold_out(sequence, estimator(lizard, positions, calls), cameras=["c3", "c1"]))
    assert [h.camera for h in one] == ["c3", "c1"]
    assert len(calls) == 6


def test_errors_are_those_of_the_predictions(lizard, recording):
    sequence, positions = recording
    observed = sequence.pixels(lizard.skeleton.marker_names, 0.5)
    for c, held in enumerate(hold_out(sequence, estimator(lizard, positions))):
        error = np.linalg.norm(sequence.cameras[c].project(positions) - observed[:, c], axis=-1)
        np.testing.assert_allclose(held.nominal, error, atol=1e-12)
        assert np.array_equal(np.isnan(held.fitted), np.isnan(error))
        late = held.camera == "c2"
        assert np.nanmedian(held.fitted) < 3
        assert (np.nanmedian(held.nominal) > 3) == late


def test_no_frame_is_scored_with_parameters_it_took_part_in_fitting(lizard, recording):
    """Moving a detection moves its own error and those of the other half, not those of its own half."""
    sequence, positions = recording
    (before,) = hold_out(sequence, estimator(lizard, positions), cameras=["c2"])
    for frame in (3, N // 2 - 1, N // 2, N - 2):
        detections = sequence.detections.copy(deep=True)
        marker = int(np.flatnonzero(np.isfinite(before.nominal[frame]))[0])
        detections.position[frame, 2, marker] += 5.0
        (after,) = hold_out(
            replace(sequence, detections=detections), estimator(lizard, positions), cameras=["c2"]
        )
        half = (np.arange(N) < N // 2) == (frame < N // 2)
        changed = before.fitted != after.fitted
        changed &= np.isfinite(before.fitted)
        assert np.argwhere(changed & half[:, None]).tolist() == [[frame, marker]]
        assert changed[~half].any()
        assert np.argwhere((before.nominal != after.nominal) & np.isfinite(before.nominal)).tolist() == [
            [frame, marker]
        ]


def test_a_half_without_detections_leaves_the_other_as_it_is(lizard, recording):
    sequence, positions = recording
    detections = sequence.detections.copy(deep=True)
    detections.position[N // 2 :, 2] = np.nan
    (held,) = hold_out(replace(sequence, detections=detections), estimator(lizard, positions), cameras=["c2"])
    np.testing.assert_allclose(held.fitted[: N // 2], held.nominal[: N // 2], atol=1e-12)
    assert np.isnan(held.fitted[N // 2 :]).all()


def test_what_is_fitted_can_be_chosen(lizard, recording):
    sequence, positions = recording
    late, moved = (
        next(hold_out(sequence, estimator(lizard, positions), cameras=["c2"], fit=(family,)))
        for family in ("delay", "extrinsics")
    )
    assert np.nanmedian(late.fitted) < np.nanmedian(moved.fitted) <= np.nanmedian(late.nominal) + 0.5


def test_estimated_noise_is_used_where_there_is_one(lizard, recording):
    """With a marker's noise unbounded, its detections do not take part."""
    sequence, positions = recording
    detections = sequence.detections.copy(deep=True)
    names = lizard.skeleton.marker_names
    detections.position[:, 2, 0] += 10.0  # small enough for the loss to believe
    wrong = replace(sequence, detections=detections)
    noise = dict.fromkeys(names, 2.0)
    found = []
    for sd in (2.0, 1e6):
        estimate = estimator(lizard, positions, parameters={"noise_px": {**noise, names[0]: sd}})
        found.append(next(hold_out(wrong, estimate, cameras=["c2"])).fitted[:, 1:])
    assert np.nanmedian(found[1]) < np.nanmedian(found[0])


def test_likelihood_decides_which_detections_count(lizard, recording):
    sequence, positions = recording
    (held,) = hold_out(sequence, estimator(lizard, positions), likelihood=0.99, cameras=["c0"])
    assert np.isnan(held.nominal).all() and np.isnan(held.fitted).all()


@pytest.mark.parametrize("n", [1, 2, 3])
def test_very_short_recordings(lizard, n):
    q = wandering(lizard)[:n]
    sequence = make_sequence(lizard, q, cameras_about())
    (held,) = hold_out(sequence, estimator(lizard, lizard.positions(q)), cameras=["c1"])
    assert held.fitted.shape == (n, 6)
    assert np.isfinite(held.fitted).all()


# --- what is counted ---------------------------------------------------------------------------------


def test_missing_predictions_are_counted_as_not_covered(lizard, recording):
    sequence, positions = recording
    holes = positions.copy()
    holes[10:15, 2] = np.nan
    (held,) = hold_out(sequence, estimator(lizard, holes), cameras=["c0"])
    detected = np.isfinite(sequence.pixels(lizard.skeleton.marker_names, 0.5)[:, 0]).all(-1)
    assert np.array_equal(np.isnan(held.nominal), ~detected)
    assert np.array_equal(np.isinf(held.nominal), np.isnan(holes).any(-1) & detected)
    assert np.isinf(held.fitted[10:15, 2][detected[10:15, 2]]).all()
    for key, errors in (("heldout_nominal_px", held.nominal), ("heldout_px", held.fitted)):
        scores = holdout_metrics([held])[key]
        lost = np.isinf(errors).sum()
        assert scores["n"] == detected.sum()
        assert scores["coverage"] == pytest.approx(1 - lost / detected.sum())
        assert scores["coverage"] < 1
        assert np.isfinite(scores["median"])


def test_scores_by_hand():
    nominal = np.array([[1.0, 3.0, np.nan], [30.0, np.inf, 2.0]])
    first = HeldOut("a", "converged", nominal, nominal / 2)
    second = HeldOut("b", "converged", np.full((2, 3), 10.0), np.full((2, 3), np.inf))
    found = holdout_metrics([first, second])
    own = found["heldout_nominal_px"]["per_camera"]["a"]
    assert own == {
        "median": 2.5,
        "p90": pytest.approx(np.quantile([1, 2, 3, 30], 0.9)),
        "within_20px": 0.75,
        "coverage": 0.8,
        "n": 5,
        "status": "converged",
    }
    pooled = found["heldout_nominal_px"]
    assert (pooled["n"], pooled["median"], pooled["coverage"]) == (11, 10.0, pytest.approx(10 / 11))
    assert found["heldout_px"]["n"] == 11
    assert found["heldout_px"]["median"] == pytest.approx(1.25)
    lost = found["heldout_px"]["per_camera"]["b"]
    assert (lost["median"], lost["p90"], lost["within_20px"], lost["coverage"], lost["n"]) == (
        None,
        None,
        None,
        0,
        6,
    )


def test_a_camera_that_detected_nothing_has_no_scores():
    nothing = HeldOut("a", "converged", np.full((2, 3), np.nan), np.full((2, 3), np.nan))
    assert holdout_metrics([nothing])["heldout_px"]["n"] == 0
    assert holdout_metrics([nothing])["heldout_px"]["median"] is None


# --- what cannot be left out -------------------------------------------------------------------------


def test_two_cameras_must_stay(lizard):
    q = wandering(lizard)[:3]
    sequence = make_sequence(lizard, q, cameras_about(n=2))
    with pytest.raises(InputError, match="only be left out when two others stay") as error:
        next(hold_out(sequence, estimator(lizard, lizard.positions(q))))
    assert "2: c0, c1" in str(error.value)


def test_unknown_cameras_are_named_before_anything_is_estimated(lizard, recording):
    sequence, positions = recording
    calls = []
    with pytest.raises(InputError, match="no camera 'c9' to leave out") as error:
        list(hold_out(sequence, estimator(lizard, positions, calls), cameras=["c0", "c9"]))
    assert "c0, c1, c2, c3" in str(error.value)
    assert not calls
    with pytest.raises(InputError, match="No camera is named"):
        check_cameras(sequence, [])
    assert check_cameras(sequence, None) == ["c0", "c1", "c2", "c3"]


def test_the_sequence_without_a_camera(recording):
    sequence, _ = recording
    rest = without_camera(sequence, "c1")
    assert rest.cameras.names == ["c0", "c2", "c3"]
    np.testing.assert_array_equal(
        rest.detections.position.values, sequence.detections.position.values[:, [0, 2, 3]]
    )
    assert sequence.cameras.names == ["c0", "c1", "c2", "c3"]
    assert rest.fps == sequence.fps
