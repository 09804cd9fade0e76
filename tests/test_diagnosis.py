"""Cameras that are out of step, moved or wrong are named, with their frames; others are not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acino_fte import camera_residuals, diagnosis
from acino_fte.condensed_solve import minimise
from acino_fte.data_tools.load import load_sequence
from acino_fte.initialise import initial_trajectory
from acino_fte.prediction import corrected
from acino_fte.problem import build_fte
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.solve import SolveOptions
from acino_fte.triangulate import triangulate

FOLDER = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "lily_run"
FPS, N = 120.0, 100
BRIEF = SolveOptions(max_iter=20)  # near enough


def recording(skeleton, **options):
    return simulation_to_sequence(simulate(skeleton, SimulationOptions(**{"n_frames": N, **options})))


@pytest.fixture(scope="module")
def gallop(cheetah):
    return recording(cheetah.skeleton, seed=1)


def shifted(sequence, camera, by, start, stop):
    """A camera whose rows start:stop show what it saw ``by`` frames later."""
    detections = sequence.detections.copy(deep=True)
    rows = np.arange(start, stop)
    rows = rows[(rows + by >= 0) & (rows + by < sequence.n_frames)]
    for name in ("position", "likelihood"):
        values = detections[name].values
        values[rows, camera] = values[rows + by, camera].copy()
    return replace(sequence, detections=detections)


def turned(sequence, camera, degrees, axis, start):
    """A camera that was turned about one of its axes, and by how far its picture then is off, px."""
    view, correction = sequence.cameras[camera], np.zeros(6)
    correction[axis] = 2 * np.tan(np.radians(degrees) / 2)
    truth = sequence.truth.values
    off = corrected(view, correction).project(truth) - view.project(truth)
    detections = sequence.detections.copy(deep=True)
    detections.position.values[start:, camera] += off[start:]
    return replace(sequence, detections=detections), np.nanmean(off[start:], axis=(0, 1))


def findings(kinematics, sequence, how="fte", options=BRIEF):
    """What the diagnosis says of a fit by the toolkit, or of triangulated points."""
    skeleton = kinematics.skeleton
    observed = sequence.pixels(skeleton.marker_names, 0.5)
    if how == "fte":
        start = initial_trajectory(sequence, kinematics)
        positions = kinematics.positions(minimise(build_fte(sequence, kinematics), start, options).q)
    else:
        positions = triangulate(sequence.cameras, observed).points
    return say(skeleton, sequence, observed, sequence.cameras.project(positions))


def say(skeleton, sequence, observed, predicted):
    sd = np.array([m.sd_px for m in skeleton.markers])
    names, frames = sequence.cameras.names, sequence.frames
    return diagnosis.camera_findings(observed, predicted, sequence.fps, names, frames, sd)


# --- nothing wrong -------------------------------------------------------------------------------------

CLEAN = [
    {"seed": 1},
    {"seed": 2, "n_cameras": 3, "outliers": 0.06},
    {"seed": 3, "motion": "wander", "noise_px": "species", "swaps": 0.05},
    {"seed": 4, "motion": "wander", "fps": 30.0},
    {"seed": 5, "n_frames": 60, "offsets_mm": 15, "proportions": 0.08},
]


@pytest.mark.parametrize("options", CLEAN, ids=str)
def test_nothing_is_said_of_good_cameras(cheetah, options):
    assert findings(cheetah, recording(cheetah.skeleton, **options)) == []


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_said_of_triangulated_points(cheetah, seed):
    assert findings(cheetah, recording(cheetah.skeleton, seed=seed), "tri") == []


# --- out of step ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", [1, 2, -1])
def test_a_camera_out_of_step_for_a_while(cheetah, gallop, by):
    (found,) = findings(cheetah, shifted(gallop, 2, by, 30, 70))
    assert (found.camera, found.kind, found.throughout) == ("cam3", "delay", False)
    assert abs(found.start - 30) <= 2
    assert abs(found.stop - 70) <= 2
    assert found.value[0] == pytest.approx(by / FPS, abs=0.2 / FPS)
    assert 0 < found.sd[0] < 0.1 / FPS
    text = str(found)
    assert f"in frames {found.start}:{found.stop}" in text
    assert "dropped" in text


@pytest.mark.parametrize("by", [1, 2])
def test_a_camera_out_of_step_throughout(cheetah, gallop, by):
    (found,) = findings(cheetah, shifted(gallop, 2, by, 0, N))
    assert found.throughout
    assert found.value[0] == pytest.approx(by / FPS, abs=0.2 / FPS)
    assert "late" in str(found)
    assert f"{('one frame', '2 frames')[by - 1]} later" in str(found)


def test_less_than_a_frame(cheetah):
    """Cameras triggered up to 8 ms late: the two that are farthest from the median are named, rightly."""
    simulation = simulate(cheetah.skeleton, SimulationOptions(n_frames=N, seed=3, delay_ms=8.0))
    late = simulation.parameters["time_offset_s"]
    median = float(np.median(list(late.values())))
    found = findings(cheetah, simulation_to_sequence(simulation))
    assert {f.kind for f in found} == {"delay"}
    for finding in found:
        assert finding.value[0] == pytest.approx(late[finding.camera] - median, abs=0.003)
    far = {name for name, tau in late.items() if abs(tau - median) > 0.004}
    assert far
    assert far <= {f.camera for f in found}


def test_out_of_step_of_triangulated_points(cheetah, gallop):
    (found,) = findings(cheetah, shifted(gallop, 2, 2, 0, N), "tri")
    assert (found.camera, found.kind, found.throughout) == ("cam3", "delay", True)


# --- moved ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1], ids=["tilted", "panned"])
@pytest.mark.parametrize("how", ["fte", "tri"])
def test_a_camera_that_moved(cheetah, gallop, axis, how):
    """By 1° from frame 60 on; the shift of its picture is found to some pixels."""
    sequence, off = turned(gallop, 4, 1.0, axis, 60)
    (found,) = findings(cheetah, sequence, how)
    assert (found.camera, found.kind, found.throughout) == ("cam5", "moved", False)
    assert abs(found.start - 60) <= 2
    assert found.stop == N
    assert found.value == pytest.approx(tuple(off), abs=5)
    assert "moved: its picture is off by" in str(found)


def test_a_camera_that_is_not_where_it_should_be(cheetah, gallop):
    sequence, off = turned(gallop, 4, 1.0, 0, 0)
    (found,) = findings(cheetah, sequence)
    assert (found.camera, found.kind, found.throughout) == ("cam5", "moved", True)
    assert found.value == pytest.approx(tuple(off), abs=6)
    assert "--fit extrinsics" in str(found)


def test_moved_and_out_of_step(cheetah, gallop):
    """Two faults of one camera at different times, and one of another."""
    sequence, _ = turned(shifted(gallop, 1, 1, 10, 45), 1, 1.0, 0, 60)
    found = findings(cheetah, shifted(sequence, 3, -2, 0, N))
    assert sorted((f.camera, f.kind) for f in found) == [
        ("cam2", "delay"), ("cam2", "moved"), ("cam4", "delay")
    ]  # fmt: skip


# --- wrong ---------------------------------------------------------------------------------------------


def test_a_camera_with_wrong_detections(cheetah, gallop):
    """The keypoints of a third of its frames are of something else."""
    rng = np.random.default_rng(0)
    detections = gallop.detections.copy(deep=True)
    wrong = rng.random((N, 24)) < 0.4
    detections.position.values[:, 4][wrong] += rng.normal(0, 300, (wrong.sum(), 2))
    (found,) = findings(cheetah, replace(gallop, detections=detections))
    assert (found.camera, found.kind) == ("cam5", "outliers")
    assert found.value[0] == pytest.approx(0.4, abs=0.08)
    assert "disagrees with the others in" in str(found)
    assert "%" in str(found)


# --- the parts -----------------------------------------------------------------------------------------


def view(rng, effect, n_frames=40, n_markers=12, noise=2.0, wild=0.1):
    """Residuals of a known effect, with noise that the frames share, and gross errors."""
    frame, marker = (a.ravel() for a in np.mgrid[0:n_frames, 0:n_markers])
    velocity = rng.normal(400, 500, (len(frame), 2))
    residual = velocity * effect[0] + effect[1:] + rng.normal(0, noise, velocity.shape)
    residual += rng.normal(0, 1.0, (n_frames, 2))[frame]
    gross = rng.random(len(frame)) < wild
    residual[gross] += rng.normal(0, 200, (gross.sum(), 2))
    return camera_residuals.View(frame, marker, residual, velocity, np.full(len(frame), noise))


def test_the_regression_finds_an_effect_and_its_error():
    rng = np.random.default_rng(0)
    truth = np.array([0.004, 6.0, -3.0])
    found = [camera_residuals.estimate(view(rng, truth)) for _ in range(60)]
    off = np.array([f.effect for f in found]) - truth
    stated = np.sqrt(np.mean([np.diag(f.covariance) for f in found], axis=0))
    assert np.abs(off.mean(0)).max() < 0.2
    assert np.abs(off[:, 0]).max() < 1e-3
    assert (off.std(0) < 1.2 * stated).all()  # on the safe side
    assert (off.std(0) > 0.4 * stated).all()


def test_what_was_found_is_taken_off():
    rng = np.random.default_rng(1)
    before = view(rng, np.array([0.004, 6.0, -3.0]))
    effect = camera_residuals.estimate(before).effect
    after = before.without(effect, 0, 20)
    assert camera_residuals.estimate(after.between(0, 20)).effect == pytest.approx([0, 0, 0], abs=0.8)
    assert camera_residuals.estimate(after.between(20, 40)).effect[1:] == pytest.approx([6, -3], abs=1)


def test_velocity_over_gaps():
    pixels = np.cumsum(np.full((30, 2, 2), 3.0), axis=0)
    pixels[10, 0] = pixels[12:15, 0] = np.nan
    observed = np.where(np.isfinite(pixels), pixels, 1.0)
    found = camera_residuals.View.of(observed, pixels, 100.0, np.ones(2))
    assert found.velocity == pytest.approx(np.full((len(found), 2), 300.0))
    assert len(found) == 60 - 4 - 2  # no pair of known frames lies about the frames 11 and 15


@pytest.mark.parametrize("n_frames", [1, 2, 3, 8])
def test_short_recordings_and_empty_cameras(cheetah, gallop, n_frames):
    sequence = gallop.select_frames(0, n_frames)
    observed = sequence.pixels(cheetah.skeleton.marker_names, 0.5)
    observed[:, 2] = np.nan
    predicted = sequence.cameras.project(sequence.truth.values)
    assert say(cheetah.skeleton, sequence, observed, predicted) == []


def test_frame_numbers_and_sentences(cheetah, gallop):
    """Frames are those of the recording; the sentences are those of the findings."""
    sequence = gallop.select_frames(20, 90)
    observed = sequence.pixels(cheetah.skeleton.marker_names, 0.5)
    predicted = sequence.cameras.project(sequence.truth.values)
    observed[30:, 1] += [14.0, -9.0]
    (found,) = say(cheetah.skeleton, sequence, observed, predicted)
    assert (found.start, found.stop) == (50, 90)
    assert str(found) == "cam2 moved: its picture is off by (+14, -9) px in frames 50:90."
    sd = np.array([m.sd_px for m in cheetah.skeleton.markers])
    arguments = (sequence.fps, sequence.cameras.names, sequence.frames, sd)
    assert diagnosis.diagnose(observed, predicted, *arguments) == [str(found)]


# --- the real sequence ---------------------------------------------------------------------------------


@pytest.mark.skipif(not FOLDER.is_dir(), reason="the real sequence is not beside the repository")
def test_the_real_sequence(cheetah):
    """Its cameras are out of step by up to 10 ms: with a plain fit, cam2 appears late, cam3 and cam5 early.

    These are the signs of what a fit with delays and poses of the cameras says (against the median camera,
    +7, −6 and −1 ms).
    """
    sequence = load_sequence(FOLDER, species="cheetah", fps=120, frames=(80, 190), likelihood=0.5)
    found = {
        f.camera: f.value[0] for f in findings(cheetah, sequence, options=SolveOptions()) if f.kind == "delay"
    }
    assert 0.002 < found["cam2"] < 0.008
    early = {name: tau for name, tau in found.items() if name != "cam2"}
    assert set(early) <= {"cam3", "cam5"}
    assert all(-0.009 < tau < -0.002 for tau in early.values())
