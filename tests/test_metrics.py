import json
from dataclasses import replace

import numpy as np
import pytest
from synthetic_result import FPS, make_result

from acino_fte.metrics import OUTLIER_SD, joints_outside_limits, json_safe, realtime_factor, result_metrics
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
