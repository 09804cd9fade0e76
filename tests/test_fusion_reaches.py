"""Camera and lidar on simulated recordings: what the toolkit promises at 90 m and at 50 m.

3 px, 15 % of the detections missing, 3 % gross outliers, 10 % of the returns on the animal from something
else, a surface 4 cm before the joints: the defaults of the simulated rig.
"""

from functools import cache

import numpy as np
import pytest

from acino_fte.estimate import EstimateOptions, estimate_fte
from acino_fte.kinematics import load_kinematics
from acino_fte.rig_options import RigOptions
from acino_fte.simulate_rig import rig_to_sequence, simulate_rig

PLACES = {"90 m": {"distance": 90.0, "width": 2048}, "50 m": {"distance": 50.0, "width": 852}}


@cache
def recording(place, n_frames=120):
    simulation = simulate_rig(RigOptions(seed=5, n_frames=n_frames, **PLACES[place]))
    return rig_to_sequence(simulation), simulation


def fused(place, how, n_frames=120):
    sequence, simulation = recording(place, n_frames)
    options = EstimateOptions(association=how, covariance=how == "marker")
    result = estimate_fte(sequence, load_kinematics(simulation.skeleton), options)
    assert result.status.ok
    return result, 1e3 * np.linalg.norm(result.positions - simulation.positions, axis=-1)


@pytest.mark.parametrize("place", PLACES)
def test_joints_are_within_centimetres_and_the_nearest_return_is_worse(place):
    result, errors = fused(place, "marker")
    assert errors.mean() <= 25.0
    assert np.quantile(errors, 0.95) <= 50.0
    depth = result.metrics["depth_m"]
    assert depth["median"] < 0.03 and depth["outlier_ratio"] < 0.05
    nees = result.metrics["uncertainty"]["nees_per_dim"]
    assert 0.5 < nees < 1.5  # joints of one recording share one error along the line of sight
    _, nearest = fused(place, "nearest")
    assert nearest.mean() > 1.5 * errors.mean()


def test_all_returns_on_the_body_do_as_well():
    result, errors = fused("50 m", "body", 60)
    assert errors.mean() <= 25.0
    assert np.quantile(errors, 0.95) <= 50.0
    assert result.depth.association == "body"


def test_an_animal_that_runs_at_the_camera_is_found_too():
    """85° from the image plane: its length is all in depth, and each stride changes its size in the image."""
    simulation = simulate_rig(RigOptions(seed=5, n_frames=90, angle=85.0))
    kinematics = load_kinematics(simulation.skeleton)
    result = estimate_fte(rig_to_sequence(simulation), kinematics, EstimateOptions(covariance=False))
    errors = 1e3 * np.linalg.norm(result.positions - simulation.positions, axis=-1)
    assert errors.mean() <= 40.0
    assert np.quantile(errors, 0.95) <= 100.0
