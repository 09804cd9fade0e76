"""The start: headings, missing markers, missing frames, too few views, very short sequences."""

import numpy as np
import pytest
from conftest import cameras_about, make_sequence, random_motion

from acino_fte.errors import InputError
from acino_fte.initialise import initial_trajectory, pose_start
from acino_fte.problem import FTEOptions, build_fte
from acino_fte.result import Status
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.solve import solve_fte
from acino_fte.triangulate import triangulate

HEADINGS = (-180.0, -135.0, -90.0, -30.0, 0.0, 45.0, 90.0, 150.0, 179.0, 180.0, 540.0)


def apart(kinematics, q, truth):
    """Distances of the markers from the truth, (N, M), m."""
    return np.linalg.norm(kinematics.positions(q) - truth, axis=-1)


def turned(kinematics, q, degrees):
    """The motion with another heading."""
    root = next(i for i, n in enumerate(kinematics.skeleton.dof_names) if n.endswith(".yaw"))
    q = q.copy()
    q[:, root] += np.radians(degrees)
    return q


@pytest.mark.parametrize("degrees", HEADINGS)
def test_heading_of_the_pose_start(lizard, degrees):
    q = turned(lizard, random_motion(lizard.skeleton, 6, 0) * 0.3, degrees)
    start = pose_start(lizard, lizard.positions(q))
    yaw = lizard.skeleton.dof("trunk.yaw")
    error = (start[:, yaw] - q[:, yaw] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(error).max() < np.radians(15)
    assert np.abs(np.diff(start[:, yaw])).max() < 0.5  # no jump from −180° to 180°


@pytest.mark.parametrize("degrees", HEADINGS)
def test_any_heading_ends_at_the_truth(lizard, degrees):
    q = turned(lizard, random_motion(lizard.skeleton, 5, 1), degrees)
    sequence = make_sequence(lizard, q, cameras_about())
    start = initial_trajectory(sequence, lizard)
    assert np.median(apart(lizard, start, sequence.truth.values)) < 0.05
    result = solve_fte(build_fte(sequence, lizard), start)
    assert result.status is Status.CONVERGED
    assert apart(lizard, result.q, sequence.truth.values).max() < 0.03


@pytest.mark.parametrize("degrees", (0.0, 100.0, 180.0))
def test_any_heading_of_a_cheetah(cheetah, degrees):
    q = turned(cheetah, random_motion(cheetah.skeleton, 4, 2) * 0.4, degrees)
    q = np.clip(q, [d.lower for d in cheetah.skeleton.dofs], [d.upper for d in cheetah.skeleton.dofs])
    sequence = make_sequence(cheetah, q, cameras_about(radius=6.0), fps=120.0)
    result = solve_fte(build_fte(sequence, cheetah), initial_trajectory(sequence, cheetah))
    assert result.status.ok
    assert np.median(apart(cheetah, result.q, sequence.truth.values)) < 0.02


def test_a_turn_through_the_whole_circle(lizard):
    """Headings are unwrapped: the start has no jump."""
    q = random_motion(lizard.skeleton, 30, 3) * 0.3
    q[:, lizard.skeleton.dof("trunk.yaw")] = np.linspace(0, 4 * np.pi, 30)
    start = pose_start(lizard, lizard.positions(q))
    turn = np.diff(start[:, lizard.skeleton.dof("trunk.yaw")])
    assert np.abs(turn - 4 * np.pi / 29).max() < 0.3


@pytest.fixture
def seen(lizard):
    """A motion of forty frames, its cameras and clean views."""
    q = random_motion(lizard.skeleton, 40, 4)
    cameras = cameras_about()
    return q, cameras, cameras.project(lizard.positions(q))


def solved(lizard, q, cameras, pixels):
    sequence = make_sequence(lizard, q, cameras, pixels=pixels)
    start = initial_trajectory(sequence, lizard)
    assert start.shape == q.shape
    assert np.isfinite(start).all()
    skeleton = lizard.skeleton
    assert (start >= [d.lower for d in skeleton.dofs]).all()
    assert (start <= [d.upper for d in skeleton.dofs]).all()
    result = solve_fte(build_fte(sequence, lizard), start)
    assert result.status is Status.CONVERGED
    return start, apart(lizard, result.q, sequence.truth.values)


def test_clean_views(lizard, seen):
    start, error = solved(lizard, *seen)
    assert apart(lizard, start, lizard.positions(seen[0])).max() < 0.1
    assert error.max() < 0.005


def test_a_marker_that_is_never_seen(lizard, seen):
    q, cameras, pixels = seen
    foot = lizard.skeleton.marker("l_foot")
    pixels[:, :, foot] = np.nan
    start, error = solved(lizard, q, cameras, pixels)
    others = np.arange(6) != foot
    assert error[:, others].max() < 0.01
    flex = lizard.skeleton.dof("l_leg.flex")
    assert np.abs(start[:, flex]).max() < 0.05  # nothing but the prior: the middle of its range


def test_a_marker_that_the_detections_do_not_have(lizard, seen):
    q, cameras, pixels = seen
    sequence = make_sequence(lizard, q, cameras, pixels=pixels)
    from dataclasses import replace

    fewer = replace(sequence, detections=sequence.detections.drop_sel(marker=["r_foot"]))
    result = solve_fte(build_fte(fewer, lizard), initial_trajectory(fewer, lizard))
    assert result.status.ok
    foot = lizard.skeleton.marker("r_foot")
    assert np.isnan(result.observed[:, :, foot]).all()
    assert apart(lizard, result.q, sequence.truth.values)[:, np.arange(6) != foot].max() < 0.01


@pytest.mark.parametrize("gap", [slice(0, 6), slice(12, 20), slice(34, 40)], ids=["begin", "middle", "end"])
def test_frames_without_any_observation(lizard, seen, gap):
    q, cameras, pixels = seen
    pixels[gap] = np.nan
    _, error = solved(lizard, q, cameras, pixels)
    rest = np.ones(40, dtype=bool)
    rest[gap] = False
    assert error[rest].max() < 0.01
    assert error[gap].max() < 0.3  # carried on by the motion model


def test_fewer_than_two_views_of_some_markers(lizard, seen):
    """They cannot be triangulated, but what one camera sees still counts in the solve."""
    q, cameras, pixels = seen
    tip = lizard.skeleton.marker("tail_tip")
    pixels[:, 1:, tip] = np.nan
    points = triangulate(cameras, pixels).points
    assert np.isnan(points[:, tip]).all()
    _, error = solved(lizard, q, cameras, pixels)
    assert error.max() < 0.01


def test_only_a_few_frames_can_be_triangulated(lizard, seen):
    """Two views in two frames that the coarse grid misses; one view elsewhere."""
    q, cameras, pixels = seen
    keep = pixels[[10, 11]].copy()
    pixels[:, 1:] = np.nan
    pixels[[10, 11]] = keep
    start, _ = solved(lizard, q, cameras, pixels)
    assert np.median(apart(lizard, start, lizard.positions(q))[10]) < 0.1


def test_nothing_can_be_triangulated(lizard, seen):
    q, cameras, pixels = seen
    pixels[:, 1:] = np.nan
    sequence = make_sequence(lizard, q, cameras, pixels=pixels)
    with pytest.raises(InputError, match="seen by two cameras at once") as error:
        initial_trajectory(sequence, lizard)
    assert "c0, c1, c2, c3" in error.value.expected
    assert "--likelihood" in error.value.remedy


def test_likelihood_too_high(lizard, seen):
    q, cameras, pixels = seen
    sequence = make_sequence(lizard, q, cameras, pixels=pixels)
    with pytest.raises(InputError, match="seen by two cameras"):
        initial_trajectory(sequence, lizard, FTEOptions(likelihood=0.96))
    with pytest.raises(InputError, match="likelihood above 0.96") as error:
        build_fte(sequence, lizard, FTEOptions(likelihood=0.96))
    assert error.value.key == "likelihood"


@pytest.mark.parametrize("n_frames", [1, 2, 3, 4, 8, 23, 24, 25, 26])
def test_short_sequences_end_to_end(lizard, n_frames):
    q = random_motion(lizard.skeleton, 40, 5)[:n_frames]
    cameras = cameras_about()
    start, error = solved(lizard, q, cameras, cameras.project(lizard.positions(q)))
    assert np.median(apart(lizard, start, lizard.positions(q))) < 0.08
    assert error.max() < 0.02


@pytest.mark.parametrize("n_frames", [1, 2, 3, 4, 8])
def test_short_sequences_of_a_cheetah(cheetah, n_frames):
    simulation = simulate(
        cheetah.skeleton, SimulationOptions(n_frames=n_frames, missing=0.0, occlusion=False)
    )
    sequence = simulation_to_sequence(simulation)
    result = solve_fte(build_fte(sequence, cheetah), initial_trajectory(sequence, cheetah))
    assert result.status.ok
    assert result.q.shape == result.dq.shape == result.ddq.shape == (n_frames, 29)
    assert np.median(apart(cheetah, result.q, sequence.truth.values)) < 0.02
    assert result.metrics["truth_mm"]["mpjpe"] < 30


def test_moving_cameras(lizard):
    q = random_motion(lizard.skeleton, 30, 6)
    cameras = cameras_about(30, moving=True)
    _, error = solved(lizard, q, cameras, cameras.project(lizard.positions(q)))
    assert error.max() < 0.01


def test_outliers_do_not_pull_the_start(lizard, seen):
    q, cameras, pixels = seen
    rng = np.random.default_rng(0)
    wild = rng.random(pixels.shape[:3]) < 0.1
    pixels[wild] += rng.normal(0, 150, (wild.sum(), 2))
    _, error = solved(lizard, q, cameras, pixels)
    assert np.percentile(error, 95) < 0.01
