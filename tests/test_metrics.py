import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_result import FPS, make_result, triangulated, with_estimates

from acino_fte.metrics import (
    OUTLIER_SD,
    body_speed,
    joints_outside_limits,
    json_safe,
    realtime_factor,
    result_metrics,
)
from acino_fte.result import Status

FIELDS = (
    ["status", "species", "method", "frames", "fps", "n_cameras", "n_markers", "n_observations"]
    + ["objective", "iterations", "seconds", "realtime_factor", "reprojection_px", "parameters"]
    + ["version", "options"]
)


@pytest.fixture(scope="module")
def result():
    return make_result()


def with_errors(result, values, marker=0, camera=0):
    """A result whose only observations are one marker's in one camera, off by the values in px along u."""
    observed = np.full_like(result.observed, np.nan)
    reprojected = result.reprojected.copy()
    for frame, value in enumerate(values):
        if np.isinf(value):
            observed[frame, camera, marker] = 100.0
            reprojected[frame, camera, marker] = np.nan
        else:
            observed[frame, camera, marker] = reprojected[frame, camera, marker] - [value, 0.0]
    return replace(result, observed=observed, reprojected=reprojected)


def test_fields_and_json(result):
    metrics = result_metrics(result)
    assert [f for f in FIELDS if f not in metrics] == []
    assert set(metrics["seconds"]) == {"load", "initialise", "build", "solve", "total"}
    assert json.loads(json.dumps(metrics, allow_nan=False)) == metrics
    assert metrics["status"] == "converged"
    assert metrics["frames"] == [80, 92]
    assert (metrics["n_cameras"], metrics["n_markers"]) == (3, 24)
    assert metrics["options"]["solve"] == {"max_iter": 200}


def test_reprojection_by_hand(result):
    errors = [3.0, 4.0, 5.0, 8.0, 30.0]
    metrics = result_metrics(with_errors(result, errors))
    found = metrics["reprojection_px"]
    assert metrics["n_observations"] == 5
    assert metrics["n_frames_unobserved"] == 7
    assert found["median"] == pytest.approx(5.0)
    assert found["mean"] == pytest.approx(10.0)
    assert found["rmse"] == pytest.approx(np.sqrt((9 + 16 + 25 + 64 + 900) / 5))
    assert found["std"] == pytest.approx(np.sqrt(found["rmse"] ** 2 - 100.0))
    assert found["p90"] == pytest.approx(8 + 0.6 * 22)
    assert found["within_20px"] == pytest.approx(0.8)
    assert found["per_camera"]["cam1"] == pytest.approx(
        {"median": 5.0, "mean": 10.0, "p90": 21.2, "within_20px": 0.8, "n": 5}
    )
    assert found["per_camera"]["cam2"] == {
        "median": None,
        "mean": None,
        "p90": None,
        "within_20px": None,
        "n": 0,
    }
    assert found["per_marker"][result.skeleton.marker_names[0]]["n"] == 5


def test_outlier_is_beyond_twenty_standard_deviations(result):
    sd = result.skeleton.markers[0].sd_px
    found = result_metrics(with_errors(result, [sd, 19.9 * sd, 20.1 * sd, 100 * sd]))["reprojection_px"]
    assert found["outlier_ratio"] == pytest.approx(0.5)
    assert found["outlier_beyond_sd"] == OUTLIER_SD == 20.0


def test_behind_the_camera_is_an_outlier_not_forgotten(result):
    found = result_metrics(with_errors(result, [3.0, 4.0, 5.0, np.inf]))["reprojection_px"]
    assert found["n_behind_camera"] == 1
    assert found["outlier_ratio"] == pytest.approx(0.25)
    assert found["within_20px"] == pytest.approx(0.75)
    assert found["median"] == pytest.approx(4.5)
    assert found["p90"] is None
    assert found["mean"] == pytest.approx(4.0)
    assert found["per_camera"]["cam1"]["n"] == 4
    mostly = result_metrics(with_errors(result, [3.0, np.inf, np.inf]))["reprojection_px"]
    assert mostly["median"] is None
    assert mostly["outlier_ratio"] == pytest.approx(2 / 3)


def test_no_observation_at_all(result):
    metrics = result_metrics(replace(result, observed=np.full_like(result.observed, np.nan)))
    assert metrics["n_observations"] == 0
    assert metrics["reprojection_px"]["median"] is None
    assert metrics["reprojection_px"]["rmse"] is None
    json.dumps(metrics, allow_nan=False)


def test_truth_by_hand(result):
    truth = result.sequence.truth.copy(data=result.positions + np.array([0.003, 0.004, 0.0]))
    truth[0] = np.nan
    truth[1, 0] += [0.0, 0.0, 0.012]
    shuffled = truth.isel(marker=slice(None, None, -1))
    sequence = replace(result.sequence, truth=shuffled)
    found = result_metrics(replace(result, sequence=sequence))["truth_mm"]
    n = 11 * 24
    assert found["median"] == pytest.approx(5.0)
    assert found["p95"] == pytest.approx(5.0)
    assert found["mpjpe"] == pytest.approx((5.0 * (n - 1) + 13.0) / n)
    assert "truth_mm" not in result_metrics(make_result(truth=False))


def test_times(result):
    metrics = result_metrics(result)
    assert metrics["seconds"]["total"] == pytest.approx(0.6)
    assert metrics["realtime_factor"] == pytest.approx(12 / FPS / 0.1)
    assert realtime_factor(1.0, {"load": 3.0}) is None


def test_speed_of_uniform_motion(result):
    time = np.arange(12) / FPS
    moving = result.positions[:1] + time[:, None, None] * np.array([3.0, 4.0, 0.0])
    speed = result_metrics(replace(result, positions=moving))["speed_m_s"]
    assert speed["body"] == pytest.approx(5.0)
    assert speed["per_marker"]["spine"] == pytest.approx(5.0)


def test_single_frame():
    metrics = result_metrics(make_result(n_frames=1))
    assert metrics["speed_m_s"]["body"] is None
    assert metrics["frames"] == [80, 81]


def test_limits(result):
    j = result.skeleton.dof("l_back_calf.knee")
    q = result.q.copy()
    q[:3, j] = result.skeleton.dofs[j].lower
    at_limit = replace(result, q=q)
    assert result_metrics(at_limit)["joints_at_limit"] == {"l_back_calf.knee": pytest.approx(0.25)}
    assert joints_outside_limits(at_limit) == []
    q[0, j] -= 1e-3
    assert joints_outside_limits(replace(result, q=q)) == ["l_back_calf.knee"]


def test_unconverged_is_marked(result):
    metrics = result_metrics(replace(result, status=Status.MAX_ITERATIONS, objective=np.nan))
    assert metrics["status"] == "max_iterations"
    assert "--max-iter" in metrics["advice"]
    assert metrics["objective"] is None


def test_json_safe(tmp_path):
    messy = {
        "a": np.float64(np.nan),
        1: (np.int64(2), np.array([1.0, np.inf])),
        "path": tmp_path,
        "status": Status.FAILED,
        "flag": np.bool_(True),
    }
    assert json_safe(messy) == {
        "a": None,
        "1": [2, [1.0, None]],
        "path": str(tmp_path),
        "status": "failed",
        "flag": True,
    }


def test_no_position_is_no_error_but_counts_against_coverage(result):
    positions, reprojected = result.positions.copy(), result.reprojected.copy()
    observed = np.full_like(result.observed, np.nan)
    observed[:4, :2, 0] = reprojected[:4, :2, 0] + [3.0, 4.0]
    positions[0, 0], reprojected[0, :, 0] = np.nan, np.nan
    positions[5, 0] = np.nan  # nobody saw it
    metrics = result_metrics(replace(result, positions=positions, observed=observed, reprojected=reprojected))
    found = metrics["reprojection_px"]
    assert metrics["n_observations"] == 8
    assert found["coverage"] == pytest.approx(0.75)
    assert found["per_camera"]["cam1"]["n"] == 3
    assert found["n_behind_camera"] == 0
    assert found["median"] == pytest.approx(5.0)
    assert result_metrics(result)["reprojection_px"]["coverage"] == 1.0


def test_method_without_a_skeleton(result):
    sparse = triangulated(result)
    metrics = result_metrics(sparse)
    assert metrics["joints_at_limit"] == {}
    assert metrics["joints_outside_limits"] == []
    assert 0.3 < metrics["reprojection_px"]["coverage"] < 1.0
    assert metrics["reprojection_px"]["n_behind_camera"] == 0
    assert metrics["truth_mm"]["rmse"] == pytest.approx(2 * np.sqrt(3), rel=0.15)
    assert metrics["speed_m_s"]["body"] == pytest.approx(13.0, rel=0.2)
    nowhere = replace(sparse, positions=np.full_like(sparse.positions, np.nan))
    metrics = result_metrics(nowhere)
    assert metrics["reprojection_px"]["coverage"] == 0.0
    assert metrics["reprojection_px"]["median"] is None
    assert metrics["speed_m_s"]["body"] is None
    assert metrics["truth_mm"]["mpjpe"] is None


def test_body_speed_does_not_jump_when_a_marker_goes(result):
    time = np.arange(12) / FPS
    moving = result.positions[:1] + time[:, None, None] * np.array([3.0, 4.0, 0.0])
    moving[4:, :9] = np.nan
    np.testing.assert_allclose(body_speed(moving, FPS), 5.0)
    moving[8:] = np.nan
    assert np.isnan(body_speed(moving, FPS)[9:]).all()


def test_within_half_the_nose_eye_distance(result):
    reprojected = np.full_like(result.reprojected, np.nan)
    nose, left, right = map(result.skeleton.marker, ("nose", "l_eye", "r_eye"))
    reprojected[:2] = 0.0
    reprojected[0, :, left], reprojected[0, :, right] = [20.0, 10.0], [20.0, -10.0]  # yardstick 20 px
    reprojected[1, :, left], reprojected[1, :, right] = [0.0, 40.0], np.nan  # 40 px: the one eye
    reprojected[2, :, nose + 5] = 0.0  # no yardstick
    spot = result.skeleton.marker("spine")
    observed = np.full_like(result.observed, np.nan)
    observed[0, 0, spot], observed[0, 1, spot] = [9.9, 0.0], [10.1, 0.0]
    observed[1, 0, spot], observed[1, 1, spot] = [19.9, 0.0], [20.1, 0.0]
    observed[1, 2, spot] = [1.0, 1.0]
    observed[2, 0, spot] = 0.0
    shown = replace(result, observed=observed, reprojected=reprojected)
    assert result_metrics(shown)["reprojection_px"]["pck_nose_eye"] == pytest.approx(3 / 5)
    eyeless = replace(
        result.skeleton,
        markers=tuple(replace(m, name=m.name.replace("eye", "ear")) for m in result.skeleton.markers),
    )
    assert "pck_nose_eye" not in result_metrics(replace(result, skeleton=eyeless))["reprojection_px"]


def test_uncertainty_by_hand(result):
    covariance = np.broadcast_to(np.diag([4e-6, 1e-6, 1e-6]), (*result.positions.shape, 3)).copy()
    truth = result.sequence.truth.copy(data=result.positions - np.array([0.004, 0.0, 0.001]))
    truth[0, 0] -= [0.0, 0.003, 0.0]
    covariance[1, 0] = np.nan
    covariance[2, 0, 2, 2] = 0.0  # held fast in z
    claimed = replace(result, position_covariance=covariance, sequence=replace(result.sequence, truth=truth))
    found = result_metrics(claimed)["uncertainty"]
    n = 12 * 24 - 2
    assert found["median_sd_mm"] == pytest.approx(np.sqrt(2.0))
    assert found["predicted_rmse_mm"] == pytest.approx(np.sqrt((6.0 * n + 5.0) / (n + 1)))
    assert found["nees_per_dim"] == pytest.approx((5.0 + 9.0 / n) / 3)
    assert found["ellipsoid_coverage_95"] == pytest.approx(1 - 1 / n)
    blind = replace(claimed, sequence=replace(result.sequence, truth=None))
    assert set(result_metrics(blind)["uncertainty"]) == {"median_sd_mm", "predicted_rmse_mm"}
    assert "uncertainty" not in result_metrics(result)


def test_right_covariances_pass_their_own_test():
    found = result_metrics(with_estimates(make_result(n_frames=60)))
    assert found["uncertainty"]["nees_per_dim"] == pytest.approx(1.0, abs=0.06)
    assert found["uncertainty"]["ellipsoid_coverage_95"] == pytest.approx(0.95, abs=0.02)
    assert found["uncertainty"]["predicted_rmse_mm"] == pytest.approx(found["truth_mm"]["rmse"], rel=0.1)
    assert found["findings"][0].startswith("cam2")


def with_true_parameters(result, **truth):
    """The sequence of a result, with true parameters as a simulation gives them."""
    sequence = replace(result.sequence)
    object.__setattr__(sequence, "truth_parameters", truth)
    return replace(result, sequence=sequence)


def test_parameter_errors_by_hand(result):
    found = {
        "time_offset_s": {"cam1": 0.001, "cam2": 0.005},
        "segment_scale": {"neck": 1.04, "head": 1.0},
        "marker_offset_m": {"nose": [0.003, 0.004, 0.0]},
        "noise_px": {"nose": 2.0},
    }
    truth = {
        "time_offset_s": {"cam1": 0.0, "cam2": 0.005, "cam3": -0.001},
        "segment_scale": {"neck": 1.01, "tail": 0.96},
        "marker_offset_m": {},
        "extrinsics": {"cam2": {"rotation_rad": [0.1, 0, 0], "translation_m": [0, 0, 0]}},
        "swapped": ["cam3"],
    }
    fitted = with_true_parameters(replace(result, parameters=found), **truth)
    errors = result_metrics(fitted)["parameter_errors"]
    assert set(errors) == {"time_offset_ms", "segment_scale", "marker_offset_mm"}
    assert errors["time_offset_ms"] == pytest.approx({"max": 1.0, "rms": np.sqrt(0.5)})
    assert errors["segment_scale"] == pytest.approx({"max": 0.04, "rms": np.sqrt((9e-4 + 16e-4) / 2)})
    assert errors["marker_offset_mm"] == pytest.approx({"max": 5.0, "rms": 5.0})
    assert "parameter_errors" not in result_metrics(result)


def test_extrinsics_errors_are_those_of_the_pose(result):
    rng = np.random.default_rng(4)
    sides, poses = [], []
    camera = result.sequence.cameras["cam2"]
    for _ in range(2):
        turn, shift = rng.normal(0, 0.4, 3), rng.normal(0, 0.3, 3)
        sides.append(
            {"cam1": {"rotation_rad": [0, 0, 0]}, "cam2": {"rotation_rad": turn, "translation_m": shift}}
        )
        matrix = Rotation.from_rotvec(turn).as_matrix()
        rotation, translation = matrix @ camera.rotation, matrix @ camera.translation + shift
        poses.append((rotation, -rotation.T @ translation))
    angle = np.degrees(Rotation.from_matrix(poses[0][0] @ poses[1][0].T).magnitude())
    distance = 1e3 * np.linalg.norm(poses[0][1] - poses[1][1])
    fitted = replace(result, parameters={"extrinsics": sides[0]})
    errors = result_metrics(with_true_parameters(fitted, extrinsics=sides[1]))["parameter_errors"]
    assert errors["extrinsics"]["rotation_deg"] == pytest.approx({"max": angle, "rms": angle})
    assert errors["extrinsics"]["position_mm"] == pytest.approx({"max": distance, "rms": distance})
