"""One view: how far away the animal is, which way it faces, and what is said without a lidar."""

import numpy as np
import pytest

from acino_fte.errors import InputError
from acino_fte.estimate import EstimateOptions, estimate_fte
from acino_fte.initialise import initial_trajectory
from acino_fte.kinematics import load_kinematics
from acino_fte.problem import FTEOptions
from acino_fte.rig_options import RigOptions
from acino_fte.simulate_rig import rig_to_sequence, simulate_rig
from acino_fte.single_view_depth import animal_depth, depth_from_size, smooth_track, surface_ratio


def recording(**options):
    """A short simulated recording: its sequence, kinematics and truth."""
    simulation = simulate_rig(RigOptions(**{"n_frames": 30, **options}))
    return rig_to_sequence(simulation), load_kinematics(simulation.skeleton), simulation


def true_depth(simulation):
    return simulation.true_camera.to_camera(simulation.positions)[..., 2].mean(axis=1)


def pixels_of(sequence, kinematics):
    return sequence.pixels(kinematics.skeleton.marker_names, 0.5)[:, 0]


@pytest.mark.parametrize("angle", [0.0, 40.0])
def test_the_size_tells_the_depth_to_a_tenth(angle):
    sequence, kinematics, simulation = recording(lidar="none", angle=angle)
    flat = sequence.cameras[0].undistort(pixels_of(sequence, kinematics))
    found = depth_from_size(kinematics, flat, sequence.fps)
    np.testing.assert_allclose(found, true_depth(simulation), rtol=0.1)


@pytest.mark.parametrize("options", [{}, {"background": 0.4, "seed": 2}, {"n_frames": 10}], ids=str)
def test_the_lidar_tells_the_depth_to_a_body(options):
    """Bushes behind thin legs are more than the returns on the animal."""
    sequence, kinematics, simulation = recording(**options)
    found = animal_depth(sequence, kinematics, pixels_of(sequence, kinematics))
    np.testing.assert_allclose(found, true_depth(simulation), atol=0.5)


def test_an_animal_that_runs_at_the_camera_has_a_steady_depth():
    """Its size is told by little, and changes with every stride."""
    sequence, kinematics, simulation = recording(angle=85.0, n_frames=120)
    found = animal_depth(sequence, kinematics, pixels_of(sequence, kinematics))
    error = found - true_depth(simulation)
    assert np.abs(error).max() < 0.7
    assert error.std() < 0.3


def test_a_smooth_track_keeps_lines_and_drops_what_is_wild():
    rng = np.random.default_rng(0)
    place = np.sort(rng.uniform(0, 100, 300))
    values = 3.0 + 0.1 * place
    at = np.linspace(0, 100, 21)
    np.testing.assert_allclose(smooth_track(place, values, at, 5.0), 3.0 + 0.1 * at, atol=0.05)
    values[::6] += 40.0
    np.testing.assert_allclose(smooth_track(place, values, at, 5.0), 3.0 + 0.1 * at, atol=0.1)
    far = smooth_track(place[:3], values[1:4], np.array([1e4]), 5.0)  # nothing near: the nearest
    np.testing.assert_allclose(far, np.median(values[1:4]))


def test_the_path_among_returns_is_the_slow_one_in_front():
    """20 returns on an animal whose size is 4 % off and drifts, 60 on a hedge behind it, a few before it."""
    rng = np.random.default_rng(0)
    size = np.full(50, 90.0)
    ratio = np.linspace(1.03, 1.05, 50)
    frame = rng.integers(0, 50, 20)
    animal = ratio[frame] + rng.normal(0, 0.03, 20) / 90
    hedge_frame, grass_frame = rng.integers(0, 50, 60), rng.integers(0, 50, 3)
    hedge, grass = 1.13 + rng.uniform(0, 0.1, 60), np.full(3, 0.98)
    found = surface_ratio(
        np.concatenate([frame, hedge_frame, grass_frame]), np.concatenate([animal, hedge, grass]), size, 50.0
    )
    np.testing.assert_allclose(found, ratio, atol=0.012)


@pytest.mark.parametrize("angle", [-40.0, 0.0, 40.0])
def test_the_start_faces_the_right_way(angle):
    """With a lidar the yaw of the start is right to 15°, towards the camera or away from it."""
    sequence, kinematics, simulation = recording(angle=angle, distance=50.0)
    q = initial_trajectory(sequence, kinematics, FTEOptions())
    nose, tail = (kinematics.skeleton.marker(name) for name in ("neck_base", "tail_base"))

    def headings(positions):
        way = positions[:, nose, :2] - positions[:, tail, :2]
        return np.arctan2(way[:, 1], way[:, 0])

    gap = headings(kinematics.positions(q)) - headings(simulation.positions)
    assert np.median(np.abs(np.degrees(np.angle(np.exp(1j * gap))))) < 15.0


def test_without_a_lidar_the_size_is_the_species():
    """It still works, and says what its scale rests on; the image is fitted as well as with one."""
    sequence, kinematics, simulation = recording(lidar="none", distance=40.0, occlusion=False)
    result = estimate_fte(sequence, kinematics, EstimateOptions(covariance=False))
    assert result.status.ok
    assert any("one camera and no lidar" in finding for finding in result.findings)
    assert "segment_scale" not in result.parameters  # no image shows the size of the animal
    assert result.metrics["reprojection_px"]["median"] < 4.0
    assert "depth_m" not in result.metrics
    error = np.linalg.norm(result.positions - simulation.positions, axis=-1)
    assert error.mean() < 0.01 * 40.0


def test_nothing_to_measure_is_an_error():
    sequence, kinematics, _ = recording(n_frames=4, lidar="none")
    nothing = sequence.detections.assign(likelihood=0 * sequence.detections.likelihood)
    from dataclasses import replace

    with pytest.raises(InputError, match="No frame shows both ends of a link"):
        initial_trajectory(replace(sequence, detections=nothing), kinematics, FTEOptions())
