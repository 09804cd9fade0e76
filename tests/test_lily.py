"""The real sequence: a cheetah at 13 m/s before six cameras, against the numbers the toolkit must reach."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

from acino_fte.cli import app
from acino_fte.data_tools.load import load_sequence
from acino_fte.initialise import initial_trajectory
from acino_fte.kinematics import load_kinematics
from acino_fte.problem import build_fte
from acino_fte.skeleton import load_skeleton
from acino_fte.solve import SolveOptions, minimise

FOLDER = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "lily_run"

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason="the real sequence is not beside the repository (../shared/data/lily_run)"
)


def run(out, *arguments):
    """The command as a user gives it; the result folder and its metrics."""
    result = CliRunner().invoke(
        app,
        [
            "run",
            str(FOLDER),
            "--species",
            "cheetah",
            "--fps",
            "120",
            "-o",
            str(out),
            "--no-figures",
            *arguments,
        ],
    )
    assert result.exit_code == 0, result.output
    return xr.load_dataset(out / "fte.nc"), json.loads((out / "metrics.json").read_text())


def inside_every_range(dataset):
    q = dataset.q
    return bool(((q >= dataset.dof_lower - 1e-9) & (q <= dataset.dof_upper + 1e-9)).all())


@pytest.fixture(scope="module")
def stride(tmp_path_factory):
    """Frames 80–189, in which the animal is in the common view of the cameras."""
    return run(tmp_path_factory.mktemp("lily") / "stride", "--frames", "80:190", "--likelihood", "0.5")


def test_reprojection(stride):
    dataset, metrics = stride
    assert metrics["status"] == "converged"
    assert (metrics["frames"], metrics["n_cameras"], metrics["n_markers"]) == ([80, 190], 6, 24)
    error = metrics["reprojection_px"]
    assert error["median"] <= 11.8
    assert error["within_20px"] >= 0.76
    assert dataset.sizes["keypoints"] == 24


def test_speed_of_the_spine(stride):
    spine = stride[0].position.sel(keypoints="spine").squeeze("individuals")
    speed = np.linalg.norm(np.gradient(spine.values, spine.time.values, axis=0), axis=1)
    assert 12 <= np.median(speed) <= 15


def test_no_joint_outside_its_range(stride):
    assert inside_every_range(stride[0])


def test_all_frames(tmp_path):
    """Many of the early and late frames have few views or none."""
    dataset, metrics = run(tmp_path / "all")
    assert metrics["status"] == "converged"
    assert metrics["frames"] == [0, 219]
    assert np.isfinite(dataset.position).all()
    assert inside_every_range(dataset)


def test_both_lowerings():
    """The explicit and the condensed problem have one minimum when they are started alike.

    Started as a run is, they may end in different local minima of this problem, which is not convex (the
    loss redescends): their barriers take different paths. Therefore both start from the condensed optimum,
    moved by a seeded random vector of standard deviation 0.01 (rad and m), and go to a tight tolerance. (30
    of the 110 frames: the explicit model takes a second a frame.)
    """
    pytest.importorskip("casadi")
    from acino_fte.explicit_solve import minimise_explicit

    kinematics = load_kinematics(load_skeleton("cheetah"))
    sequence = load_sequence(FOLDER, species="cheetah", fps=120, frames=(110, 140), likelihood=0.5)
    problem = build_fte(sequence, kinematics)
    optimum = minimise(problem, initial_trajectory(sequence, kinematics)).q
    begin = problem.clip(optimum + np.random.default_rng(0).normal(0, 0.01, optimum.shape))
    options = SolveOptions(tolerance=1e-3, acceptable_tolerance=1e-2)
    condensed = minimise(problem, begin, options)
    explicit = minimise_explicit(problem, begin, options)
    assert condensed.status.ok
    assert explicit.status.ok
    assert explicit.objective == pytest.approx(condensed.objective, rel=1e-6)
    apart = kinematics.positions(explicit.q) - kinematics.positions(condensed.q)
    assert np.linalg.norm(apart, axis=-1).max() < 5e-4
