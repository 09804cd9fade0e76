"""What the whole estimate recovers of simulated recordings: clocks, cameras, proportions and exchanged sides.

Where a camera is can be told no better than the data allow. The Cramér–Rao bound for the cameras (the
inverse of the information about them with the trajectory and all other parameters marginalised) says how
well that is, and the tests ask for 3 mm and 0.05° where it is below that. A gallop past cameras beside its
path is no such recording: all points lie along a line, from which a camera's tilt is hard to tell from a
step up or down.

Pictures and trajectory can turn, move and grow together; errors of the cameras are those that a similarity
of the world does not explain.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from acino_fte.assignments import limb_groups
from acino_fte.condensed import Condensed
from acino_fte.estimate import EstimateOptions, estimate_fte
from acino_fte.imperfections import corrected_cameras
from acino_fte.losses import Loss
from acino_fte.parameters import POSE
from acino_fte.posterior import factorise, posterior
from acino_fte.prediction import corrected_cameras as cameras_of_theta
from acino_fte.problem import Assumptions, FTEOptions, build_fte
from acino_fte.result import Status
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.solve import Minimum

FIT = ("scale", "delay", "extrinsics")
FAULTS = {"delay_ms": 8.0, "moved_mm": 20.0, "moved_deg": 0.2, "proportions": 0.05}
TARGET_DEG, TARGET_MM = 0.05, 3.0


def theta_of(parameters, values):
    """θ (P,) of values by family and name, as results and simulations have them."""
    theta = np.empty(len(parameters))
    for i, p in enumerate(parameters.entries):
        if p.family == "scale":
            theta[i] = np.log(values["segment_scale"][p.owner])
        elif p.family == "offsets":
            theta[i] = values["marker_offset_m"][p.owner]["xyz".index(p.component)]
        elif p.family == "delay":
            theta[i] = values["time_offset_s"][p.owner]
        else:
            pose = values["extrinsics"][p.owner]
            vector = np.array(pose["rotation_rad"])
            angle = np.linalg.norm(vector)
            cayley = vector * (2 * np.tan(angle / 2) / angle if angle else 1.0)
            theta[i] = [*cayley, *pose["translation_m"]][POSE.index(p.component)]
    return theta


def parameter_nees(result, kinematics, options, fit, scored):
    """eᵀ Σ⁻¹ e of the parameters of each family that is scored, and how many they are."""
    noise = np.array(list(result.parameters["noise_px"].values()))
    assumed = Assumptions(pixels=result.observed, sd_px=noise)
    problem = build_fte(result.sequence, kinematics, replace(options, fit=fit), assumed)
    theta = theta_of(problem.parameters, result.parameters)
    covariance = posterior(problem, Minimum(Status.CONVERGED, result.q, 0.0, 0, theta)).theta
    error = theta - theta_of(problem.parameters, result.sequence.truth_parameters)
    found = []
    for places in map(problem.parameters.of_family, scored):
        squared = error[places] @ np.linalg.solve(covariance[np.ix_(places, places)], error[places])
        found.append((float(squared), len(places)))
    return found


# --- poses of cameras --------------------------------------------------------------------------------


def pose_errors(found, true):
    """(C, 6): turn, rad, and shift of the centre, m, of every camera in the world's frame."""
    return np.array(
        [
            np.concatenate(
                [Rotation.from_matrix(f.rotation.T @ t.rotation).as_rotvec(), centre(f) - centre(t)]
            )
            for f, t in zip(found, true, strict=True)
        ]
    )


def centre(camera):
    return -camera.rotation.T @ camera.translation


def similarity_free(true):
    """(6 C, 6 C): takes from pose errors the turn, shift and growth of the world that explain most of them.

    Least squares over the poses, in units of the targets.
    """
    centres = np.array([centre(t) for t in true])
    basis = np.zeros((len(centres), 6, 7))
    for b, x in zip(basis, centres - centres.mean(0), strict=True):
        b[:3, :3] = b[3:, 3:6] = np.eye(3)
        b[3:, :3] = -np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])  # ω × x
        b[3:, 6] = x
    basis = basis.reshape(-1, 7)
    weights = np.tile(np.repeat([1 / np.radians(TARGET_DEG), 1e3 / TARGET_MM], 3), len(centres))
    return np.eye(len(basis)) - basis @ np.linalg.pinv(basis * weights[:, None]) * weights


class Worst(NamedTuple):
    """Of the worst camera, free of a similarity of the world."""

    degrees: float
    millimetres: float


def camera_errors(result, simulation) -> Worst:
    """Estimated against true cameras."""
    true = list(simulation.true_cameras)
    found = corrected_cameras(result.sequence.cameras, result.parameters["extrinsics"])
    errors = (similarity_free(true) @ pose_errors(found, true).ravel()).reshape(-1, 6)
    sizes = [np.linalg.norm(errors[:, part], axis=1).max() for part in (slice(3), slice(3, 6))]
    return Worst(float(np.degrees(sizes[0])), 1e3 * float(sizes[1]))


def camera_bound(sequence, kinematics, simulation) -> Worst:
    """Cramér–Rao bound of their root mean square, at the truth and with the true noise."""
    noise = np.full(kinematics.n_markers, float(simulation.options.noise_px))
    options = FTEOptions(fit=FIT, loss=Loss("squared"))
    problem = build_fte(sequence, kinematics, options, Assumptions(sd_px=noise))
    theta = theta_of(problem.parameters, simulation.parameters)
    condensed = Condensed(problem)
    parts = condensed.hessian_parts(condensed.pack(simulation.q, theta))
    sd = problem.parameters.sd
    covariance = factorise(problem, *parts).selected_inverse().corner * np.outer(sd, sd)
    true = list(simulation.true_cameras)
    slopes = np.zeros((6 * len(true), len(theta)))
    for i in problem.parameters.of_family("extrinsics"):
        step = 1e-6 * np.eye(len(theta))[i]
        ahead, behind = (
            cameras_of_theta(sequence.cameras, problem.parameters, theta + s) for s in (step, -step)
        )
        slopes[:, i] = pose_errors(ahead, behind).ravel() / 2e-6
    slopes = similarity_free(true) @ slopes
    variance = np.einsum("ip,pq,iq->i", slopes, covariance, slopes).reshape(-1, 2, 3).sum(-1).max(0)
    return Worst(float(np.degrees(np.sqrt(variance[0]))), 1e3 * float(np.sqrt(variance[1])))


# --- tests -------------------------------------------------------------------------------------------


def test_a_similarity_of_the_world_is_no_error(cheetah):
    true = list(simulate(cheetah.skeleton, SimulationOptions(n_frames=5)).true_cameras)
    turn = Rotation.from_rotvec([1e-5, 2e-5, -3e-5]).as_matrix()
    moved = []
    for camera in true:
        rotation = camera.rotation @ turn.T
        place = 1.00002 * turn @ centre(camera) + [1e-4, -2e-4, 3e-4]
        moved.append(replace(camera, rotation=rotation, translation=-rotation @ place))
    errors = pose_errors(moved, true).ravel()
    assert np.abs(errors).max() > 1e-5
    assert np.abs(similarity_free(true) @ errors).max() < 1e-8


def test_everything_together_before_near_cameras(cheetah):
    """Clocks to 0.3 ms, scales to 1 %, cameras to 3 mm and 0.05°, all unknown, all the faults of a detector.

    Five metres from the animal and with a noise of 1 px the bound is 1.5 mm and 0.02°.
    """
    near = {"motion": "wander", "layout": "ring", "radius": 3.0, "noise_px": 1.0, "n_frames": 200}
    simulation = simulate(cheetah.skeleton, SimulationOptions(**near, **FAULTS))
    sequence = simulation_to_sequence(simulation)
    bound = camera_bound(sequence, cheetah, simulation)
    assert bound.degrees < TARGET_DEG / 2
    assert bound.millimetres < TARGET_MM / 1.5
    result = estimate_fte(sequence, cheetah, EstimateOptions(fit=FIT))
    assert result.status.ok
    assert np.median(list(result.parameters["noise_px"].values())) == pytest.approx(1.0, rel=0.1)
    found = camera_errors(result, simulation)
    assert found.degrees <= TARGET_DEG
    assert found.millimetres <= TARGET_MM
    errors = result.metrics["parameter_errors"]
    assert errors["time_offset_ms"]["max"] <= 0.3
    assert errors["segment_scale"]["max"] <= 0.01


def test_clocks_and_proportions_of_a_gallop(cheetah):
    """2 px noise, cameras as calibrated."""
    options = SimulationOptions(n_frames=200, delay_ms=8.0, proportions=0.05)
    sequence = simulation_to_sequence(simulate(cheetah.skeleton, options))
    result = estimate_fte(sequence, cheetah, EstimateOptions(fit=("scale", "delay")))
    assert result.status.ok
    errors = result.metrics["parameter_errors"]
    assert errors["time_offset_ms"]["max"] <= 0.3
    assert errors["segment_scale"]["max"] <= 0.01


def test_everything_together_of_a_gallop(cheetah):
    """Clocks and scales as well as with known cameras; the cameras as well as the estimate says of itself.

    3 mm are beyond what the pictures tell: the bound is three times as much. Errors over covariance follow χ²
    with 30 degrees of freedom a recording.
    """
    nees, count = 0.0, 0
    for seed in (0, 1):
        options = SimulationOptions(n_frames=200, seed=seed, **FAULTS)
        simulation = simulate(cheetah.skeleton, options)
        sequence = simulation_to_sequence(simulation)
        bound = camera_bound(sequence, cheetah, simulation)
        assert bound.millimetres > 2 * TARGET_MM
        result = estimate_fte(sequence, cheetah, EstimateOptions(fit=FIT))
        assert result.status.ok
        errors = result.metrics["parameter_errors"]
        assert errors["time_offset_ms"]["max"] <= 0.3
        assert errors["segment_scale"]["max"] <= 0.01
        assert np.median(list(result.parameters["noise_px"].values())) == pytest.approx(2.0, rel=0.1)
        found = camera_errors(result, simulation)
        assert found.millimetres < 2.5 * bound.millimetres
        assert found.degrees < 2.5 * bound.degrees
        ((squared, dimensions),) = parameter_nees(result, cheetah, FTEOptions(), FIT, FIT[-1:])
        nees, count = nees + squared, count + dimensions
    assert count == 60
    assert chi2.ppf(0.001, count) < nees < chi2.ppf(0.999, count), nees / count


@pytest.mark.parametrize("seed", [0, 1])
def test_exchanged_sides(cheetah, seed):
    """A tenth of the images with left and right exchanged: found, and as good as without (to a tenth).

    A swap can be told when a pair of the limb that is detected is more than three standard deviations apart:
    the noise of the species is not known to be less.
    """
    skeleton = cheetah.skeleton
    options = SimulationOptions(seed=seed, swaps=0.1)
    simulation = simulate(skeleton, options)
    sequence = simulation_to_sequence(simulation)
    clean = simulation_to_sequence(simulate(skeleton, replace(options, swaps=0.0)))
    result, without = (estimate_fte(s, cheetah, EstimateOptions(fit=())) for s in (sequence, clean))
    swapped, told, flagged = exchanged(simulation, sequence, result)
    assert swapped.sum() > 50
    assert flagged[swapped & told].mean() >= 0.95
    assert flagged[swapped].mean() >= 0.8
    assert flagged[told & ~swapped].mean() <= 0.005
    assert any("left and right exchanged" in finding for finding in result.findings)
    assert result.metrics["truth_mm"]["mpjpe"] <= 1.1 * without.metrics["truth_mm"]["mpjpe"]


def exchanged(simulation, sequence, result):
    """(N, C, limbs) bool each: was exchanged, can be told, and was found to be exchanged."""
    skeleton = simulation.skeleton
    raw = sequence.pixels(skeleton.marker_names, FTEOptions().likelihood)
    seen = np.isfinite(raw[..., 0])
    changed = ~np.isclose(raw, result.observed, equal_nan=True).all(-1)
    was, told, flagged = [], [], []
    for _, pairs in limb_groups(skeleton):
        left, right = pairs.T
        apart = np.linalg.norm(simulation.pixels[:, :, left] - simulation.pixels[:, :, right], axis=-1)
        sd = np.array([max(skeleton.markers[a].sd_px, skeleton.markers[b].sd_px) for a, b in pairs])
        was.append((simulation.detections.swapped & seen)[..., pairs.ravel()].any(axis=-1))
        told.append(((apart > 3 * sd) & (seen[..., left] | seen[..., right])).any(axis=-1))
        flagged.append(changed[..., pairs.ravel()].any(axis=-1))
    return tuple(np.stack(part, axis=-1) for part in (was, told, flagged))
