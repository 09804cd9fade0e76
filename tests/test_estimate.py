"""The whole estimate: its stages, what each option switches, and what it says."""

from dataclasses import replace

import numpy as np
import pytest

from acino_fte.condensed_solve import minimise
from acino_fte.errors import InputError
from acino_fte.estimate import EstimateOptions, estimate_fte
from acino_fte.evaluate import climb, evaluate_holdout, fitted_families
from acino_fte.kinematics import load_kinematics
from acino_fte.parameters import PriorWidths
from acino_fte.problem import FTEOptions, build_fte
from acino_fte.result import Status
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.skeleton import load_skeleton
from acino_fte.solve import SolveOptions, solve_fte

PLAIN = EstimateOptions(fit=(), noise="table", swaps=False, covariance=False)


@pytest.fixture(scope="module")
def kinematics():
    return load_kinematics(load_skeleton("cheetah"))


@pytest.fixture(scope="module")
def sequence(kinematics):
    options = SimulationOptions(n_frames=30, n_cameras=4, delay_ms=6, proportions=0.05, swaps=0.1, seed=3)
    return simulation_to_sequence(simulate(kinematics.skeleton, options))


@pytest.fixture(scope="module")
def result(sequence, kinematics):
    return estimate_fte(sequence, kinematics)


def test_the_default_estimates_what_the_data_tell(result):
    assert result.status is Status.CONVERGED
    fitted = fitted_families(result)
    assert {"delay", "scale"} <= set(fitted)
    assert "offsets" not in fitted
    said = " ".join(result.findings)
    assert "time offsets of the cameras are fitted: all 3 directions are observed" in said
    assert "marker offsets are not fitted: the data tell" in said
    assert "exchanged" in said
    assert result.options["estimate"]["fit"] == "observable"


def test_parameters_and_deviations_go_together(result, sequence):
    assert list(result.parameters["time_offset_s"]) == sequence.cameras.names
    assert result.parameters["time_offset_s"]["cam1"] == result.parameters["time_offset_s_sd"]["cam1"] == 0
    for family in ("time_offset_s", "segment_scale"):
        values, sd = result.parameters[family], result.parameters[f"{family}_sd"]
        truth = sequence.truth_parameters[family]
        assert all(abs(values[k] - truth[k]) < 5 * sd[k] for k in values if sd[k] > 0)
    assert (result.q_sd > 0).all()
    assert np.linalg.eigvalsh(result.position_covariance).min() > 0
    assert set(result.parameters["noise_px"]) == set(result.skeleton.marker_names)


def test_it_is_better_than_the_plain_problem(result, sequence, kinematics):
    plain = estimate_fte(sequence, kinematics, PLAIN)
    assert result.metrics["truth_mm"]["mpjpe"] < 0.8 * plain.metrics["truth_mm"]["mpjpe"]
    assert plain.parameters == {}
    assert plain.position_covariance is None
    assert plain.q_sd is None


def test_the_plain_estimate_is_the_plain_problem(sequence, kinematics):
    from acino_fte.initialise import initial_trajectory

    plain = estimate_fte(sequence, kinematics, PLAIN)
    direct = solve_fte(build_fte(sequence, kinematics), initial_trajectory(sequence, kinematics))
    np.testing.assert_array_equal(plain.q, direct.q)
    assert plain.objective == direct.objective


def test_asked_for_though_not_observed(sequence, kinematics):
    options = EstimateOptions(fit=("offsets",), swaps=False, covariance=False)
    found = estimate_fte(sequence, kinematics, options)
    assert any(f.startswith("fitted because asked for, though the data tell") for f in found.findings)
    assert fitted_families(found) == ("offsets",)


def test_a_parameter_at_its_bound_is_named(sequence, kinematics):
    problem = FTEOptions(widths=replace(PriorWidths(), delay=0.05))
    options = EstimateOptions(problem, fit=("delay",), noise="table", swaps=False, covariance=False)
    found = estimate_fte(sequence, kinematics, options).findings
    assert any(f.startswith("at their bounds") and "delay.cam" in f for f in found)


def test_contact_and_tuning_say_what_they_did(sequence, kinematics):
    options = EstimateOptions(fit=(), swaps=False, contact=True, tune_noise=True)
    found = estimate_fte(sequence, kinematics, options)
    assert found.status.ok
    assert any(f.startswith("ground: ") for f in found.findings)
    assert any(f.startswith("process noise tuned") for f in found.findings)
    assert set(found.parameters["process_noise_factor"]) == set(found.skeleton.dof_names)


def test_running_out_of_iterations_is_said(sequence, kinematics):
    options = replace(PLAIN, solver=SolveOptions(max_iter=2))
    assert estimate_fte(sequence, kinematics, options).status is Status.MAX_ITERATIONS


def test_seconds_by_stage(result):
    assert set(result.seconds) == {"initialise", "build", "solve"}
    assert all(value >= 0 for value in result.seconds.values())


@pytest.mark.parametrize(("key", "value"), [("noise", "guessed"), ("lowering", "condenced")])
def test_wrong_options(key, value):
    with pytest.raises(InputError, match=f"option {key} cannot be '{value}'"):
        EstimateOptions(**{key: value})


def test_a_misspelt_family():
    with pytest.raises(InputError, match="did you mean 'delay'"):
        EstimateOptions(fit=("delays",))


def test_the_ladder_climbs_from_nothing_to_the_result(sequence, kinematics):
    options = EstimateOptions(fit=("delay", "scale"), swaps=False, covariance=False)
    found = estimate_fte(sequence, kinematics, options)
    top = evaluate_holdout(sequence, kinematics, "fte", options, found, ["cam2"])
    rungs = climb(sequence, kinematics, options, found, ["cam2"], top)
    assert [rung["fit"] for rung in rungs] == [[], ["delay"], ["delay", "scale"]]
    assert rungs[-1]["heldout_px"]["median"] == top["heldout_px"]["median"]
    assert rungs[-1]["heldout_px"]["median"] < rungs[0]["heldout_px"]["median"]
    assert all(rung["heldout_px"]["coverage"] == 1.0 for rung in rungs)


def test_warm_starts_keep_the_parameters(sequence, kinematics, result):
    problem = build_fte(sequence, kinematics, FTEOptions(fit=("delay", "scale")))
    first = minimise(problem, result.q)
    again = minimise(problem, first.q, theta=first.theta)
    assert again.objective == pytest.approx(first.objective, rel=1e-6)
    np.testing.assert_allclose(again.theta, first.theta, atol=1e-2 * problem.parameters.sd.max())
