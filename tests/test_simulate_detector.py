"""The simulated detector: every fault occurs as often, and as large, as its option says."""

import numpy as np
import pytest

from acino_fte.cameras import CameraArray
from acino_fte.detector import twin_limbs
from acino_fte.occlusion import hidden_by_body, segment_distance_squared
from acino_fte.simulate import SimulationOptions, simulate
from acino_fte.skeleton import load_skeleton

CLEAN = {"missing": 0.0, "outliers": 0.0, "occlusion": False, "n_frames": 200}


def _simulate(species="cheetah", **options):
    return simulate(load_skeleton(species), SimulationOptions(**{**CLEAN, **options}))


def _error(simulation):
    return simulation.detections.position - simulation.pixels


def test_without_faults_detections_are_the_projections():
    simulation = _simulate(noise_px=0.0)
    inside = simulation.detections.in_image
    assert inside.mean() > 0.95
    assert np.allclose(_error(simulation)[inside], 0.0)
    assert np.all(np.isnan(simulation.detections.position[~inside]))


@pytest.mark.parametrize("sd", [0.5, 2.0, 7.0])
def test_noise_has_its_standard_deviation(sd):
    error = _error(_simulate(noise_px=sd))
    assert np.nanstd(error) == pytest.approx(sd, rel=0.01)
    assert abs(np.nanmean(error)) < 0.02 * sd


def test_noise_of_the_species_is_that_of_each_marker():
    simulation = _simulate(noise_px="species")
    found = np.nanstd(_error(simulation), axis=(0, 1, 3))
    assert np.allclose(found, [m.sd_px for m in simulation.skeleton.markers], rtol=0.08)


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.3, 1.0])
def test_missing_fraction(fraction):
    simulation = _simulate(missing=fraction)
    d = simulation.detections
    assert np.mean(d.missing[d.in_image]) == pytest.approx(fraction, abs=0.01)
    assert np.array_equal(np.isnan(d.position[..., 0]), d.missing | ~d.in_image)


@pytest.mark.parametrize("fraction", [0.05, 0.5])
def test_outliers_are_a_fraction_of_the_rest_and_gross(fraction):
    simulation = _simulate(missing=0.3, outliers=fraction)
    d = simulation.detections
    assert not np.any(d.outlier & d.missing)
    assert np.mean(d.outlier[d.in_image & ~d.missing]) == pytest.approx(fraction, abs=0.01)
    error = np.linalg.norm(_error(simulation), axis=-1)
    assert np.nanmedian(error[d.outlier]) > 50
    assert np.nanmax(error[~d.outlier]) < 12  # six standard deviations


def test_outliers_stay_in_the_image():
    simulation = _simulate(outliers=1.0, noise_px=0.0)
    d = simulation.detections
    for c, camera in enumerate(simulation.cameras):
        seen = np.isfinite(d.position[:, c, :, 0])
        assert np.all(camera.inside(d.position[:, c])[seen])


def test_half_of_the_outliers_sit_on_another_marker():
    simulation = _simulate(outliers=0.2, noise_px=0.0)
    d = simulation.detections
    gap = np.linalg.norm(d.position[:, :, :, None] - simulation.pixels[:, :, None], axis=-1).min(axis=-1)
    assert np.mean(gap[d.outlier] < 1e-9) == pytest.approx(0.5, abs=0.03)


def test_swaps_exchange_twins_at_their_rate():
    simulation = _simulate(swaps=0.3, noise_px=0.0)
    d = simulation.detections
    assert np.mean(d.swapped.any(axis=2)) == pytest.approx(0.3, abs=0.04)
    limbs = twin_limbs(simulation.skeleton)
    for left, right in (pair for limb in limbs for pair in limb):
        both = d.swapped[..., left] & d.swapped[..., right]
        assert both.any()
        assert np.allclose(d.position[..., left, :][both], simulation.pixels[..., right, :][both])
    for limb in limbs:  # all of it or none
        members = [i for pair in limb for i in pair]
        complete = d.in_image[..., members].all(-1)
        assert np.all(np.ptp(d.swapped[..., members][complete].astype(int), axis=-1) == 0)
    whole = d.swapped[..., [i for limb in limbs for pair in limb for i in pair]].all(axis=-1)
    assert np.mean(whole) == pytest.approx(0.15, abs=0.04)


def test_limbs_of_the_cheetah():
    skeleton = load_skeleton("cheetah")
    sizes = sorted(len(limb) for limb in twin_limbs(skeleton))
    assert sizes == [1, 4, 4]  # eyes, forelimb, hind limb
    names = [skeleton.marker_names[i] for limb in twin_limbs(skeleton) for i, _ in limb]
    assert all(n.startswith("l_") for n in names)


def test_quantised_to_the_grid_of_deeplabcut():
    simulation = _simulate(quantise=True, outliers=0.1)
    position = simulation.detections.position
    position = position[np.isfinite(position)]
    assert np.array_equal(np.mod(position, 8.0), np.full(position.shape, 4.0))
    plain = _simulate(outliers=0.1).detections.position
    assert np.nanmax(np.abs(simulation.detections.position - plain)) <= 4.0


def test_likelihood_means_something():
    simulation = _simulate(missing=0.2, outliers=0.1, occlusion=True, n_frames=400)
    d = simulation.detections
    good = d.in_image & ~d.missing & ~d.outlier & ~d.occluded
    assert np.all((d.likelihood >= 0) & (d.likelihood <= 1))
    assert np.mean(d.likelihood[good] > 0.5) > 0.99
    assert np.mean(d.likelihood[d.outlier] > 0.5) == pytest.approx(0.58, abs=0.04)
    assert np.mean(d.likelihood[d.missing] > 0.5) < 0.01
    guessed = d.occluded & ~d.missing
    assert np.mean(d.likelihood[guessed] > 0.5) == pytest.approx(0.11, abs=0.04)
    found = np.isfinite(d.position[..., 0])
    right = [
        np.mean(good[found & (d.likelihood >= low) & (d.likelihood < low + 0.2)])
        for low in np.arange(0, 1, 0.2)
    ]
    assert np.all(np.diff(right) > 0), right  # the surer, the more often right


def test_each_fault_has_its_own_stream():
    plain, noisy = _simulate(missing=0.2), _simulate(missing=0.2, outliers=0.2, swaps=0.1, noise_px=5.0)
    sure = plain.detections.in_image.all(axis=2)  # a swap can move a marker out of the image
    assert sure.mean() > 0.9
    assert np.array_equal(plain.detections.missing[sure], noisy.detections.missing[sure])
    kept = ~noisy.detections.outlier & ~noisy.detections.swapped
    assert np.allclose(
        2.5 * _error(plain)[kept & sure[..., None]], _error(noisy)[kept & sure[..., None]], equal_nan=True
    )


def test_occluded_markers_are_guessed():
    simulation = _simulate(occlusion=True, occlusion_px=20.0, noise_px=0.0)
    d = simulation.detections
    assert 0.02 < d.occluded.mean() < 0.3
    assert np.nanstd(_error(simulation)[d.occluded]) == pytest.approx(20.0, rel=0.03)
    assert np.nanmax(np.abs(_error(simulation)[~d.occluded])) < 1e-9


@pytest.mark.parametrize("species", ["cheetah", "human"])
def test_occlusion_agrees_with_marching_along_the_ray(species):
    simulation = simulate(load_skeleton(species), SimulationOptions(motion="wander", n_frames=3))
    skeleton, positions, cameras = simulation.skeleton, simulation.positions, simulation.cameras
    hidden = hidden_by_body(skeleton, positions, cameras)
    step = np.linspace(0, 1, 4001)[:, None]
    checked = 0
    for n in range(3):
        for c, camera in enumerate(cameras):
            for m in range(len(skeleton.markers)):
                ray = camera.centre + step * (positions[n, m] - camera.centre)
                depth = [_depth(ray, positions[n], capsule) for capsule in skeleton.capsules]
                inside = [d[-1] > 0 for d in depth]
                reach = max((d.max() for d, i in zip(depth, inside, strict=True) if not i), default=-1.0)
                if abs(reach) > 2e-3:  # a grazing ray may be missed between two steps
                    assert hidden[n, c, m] == (reach > 0), (n, c, skeleton.marker_names[m])
                    checked += 1
    assert checked > 300
    assert hidden.any()
    assert not hidden.all()


def _depth(points, pose, capsule):
    """Depth of points (K, 3) inside a capsule, m; negative outside."""
    a, b, radius = capsule
    axis = pose[b] - pose[a]
    t = np.clip((points - pose[a]) @ axis / (axis @ axis), 0, 1)
    return radius - np.linalg.norm(points - pose[a] - t[:, None] * axis, axis=1)


def test_the_far_hip_is_hidden_and_the_near_one_is_not():
    simulation = _simulate(occlusion=True, layout="sides")
    skeleton = simulation.skeleton
    left = [c for c, camera in enumerate(simulation.cameras) if camera.centre[1] > 0]
    middle = CameraArray(tuple(simulation.cameras[c] for c in left))
    hidden = hidden_by_body(skeleton, simulation.positions, middle)
    assert hidden[..., skeleton.marker("r_hip")].mean() > hidden[..., skeleton.marker("l_hip")].mean() + 0.3


def test_segment_distance_against_sampling():
    rng = np.random.default_rng(0)
    p0, p1, q0, q1 = rng.normal(size=(4, 50, 3))
    s = np.linspace(0, 1, 301)[:, None, None]
    on_p, on_q = p0 + s * (p1 - p0), q0 + s * (q1 - q0)
    best = np.min([np.min(np.sum((on_p - q) ** 2, axis=-1), axis=0) for q in on_q], axis=0)
    found = segment_distance_squared(p0, p1, q0, q1)
    assert np.all(found <= best + 1e-12)
    assert np.allclose(np.sqrt(found), np.sqrt(best), atol=2e-2)
    assert np.allclose(segment_distance_squared(p0, p0, q0, q0), np.sum((p0 - q0) ** 2, axis=-1))
    assert np.allclose(segment_distance_squared(p0, p1, p0 + 1, p1 + 1), _parallel(p0, p1))


def _parallel(p0, p1):
    """Squared distance between a segment and itself moved by (1, 1, 1)."""
    d = p1 - p0
    s = np.linspace(-1, 1, 20001)[:, None, None]  # difference of the two parameters
    return np.min(np.sum((s * d + 1) ** 2, axis=-1), axis=0)
