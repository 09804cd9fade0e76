import json
import os
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
import yaml
from synthetic_result import make_result, triangulated, with_estimates

from acino_fte import result_files
from acino_fte.errors import InputError
from acino_fte.result import Status
from acino_fte.result_dataset import to_dataset
from acino_fte.result_files import check_output_folder, save_result


@pytest.fixture(scope="module")
def result():
    return make_result()


def names(folder):
    return sorted(p.name for p in Path(folder).iterdir())


def test_dataset_layout(result):
    ds = to_dataset(result)
    assert ds.position.dims == ("time", "space", "keypoints", "individuals")
    assert ds.confidence.dims == ("time", "keypoints", "individuals")
    assert ds.residual.dims == ("time", "camera", "keypoints", "pixel")
    assert ds.q.dims == ds.dq.dims == ds.ddq.dims == ("time", "dof")
    np.testing.assert_array_equal(
        ds.position.sel(keypoints="spine", individuals="id_0").values,
        result.positions[:, result.skeleton.marker("spine")],
    )
    np.testing.assert_array_equal(ds.frame.values, np.arange(80, 92))
    np.testing.assert_allclose(ds.time.values, np.arange(80, 92) / 120.0)
    assert ds.attrs["fps"] == 120.0
    assert ds.attrs["status"] == "converged"
    assert ds.attrs["source_software"] == "acino_fte"
    assert list(ds.dof_unit.values[:4]) == ["m", "m", "m", "rad"]


def test_confidence_is_the_mean_of_the_detections_used(result):
    observed = np.full_like(result.observed, np.nan)
    observed[0, :2, 0] = 1.0
    detections = result.sequence.detections.copy(deep=True)
    detections.likelihood[0, :, 0] = [0.6, 0.8, 1.0]
    ds = to_dataset(
        replace(result, observed=observed, sequence=replace(result.sequence, detections=detections))
    )
    assert ds.confidence.values[0, 0, 0] == pytest.approx(0.7)
    assert ds.n_views.values[0, 0, 0] == 2
    assert np.isnan(ds.confidence.values[1, 0, 0])


def test_saved_files(result, tmp_path):
    out = save_result(result, tmp_path / "deep" / "run", figures=False)
    assert names(out) == sorted(set(result_files.FILES) - {"figures", "depth.csv"})
    with xr.open_dataset(out / "fte.nc") as ds:
        xr.testing.assert_identical(ds.load(), to_dataset(result))
        assert ds.time.dtype == float
    positions = pd.read_csv(out / "positions.csv")
    assert list(positions.columns) == ["frame", "time_s", "marker", "x", "y", "z"]
    spine = positions[positions.marker == "spine"]
    np.testing.assert_allclose(
        spine[["x", "y", "z"]], result.positions[:, result.skeleton.marker("spine")], atol=1e-6
    )
    states = pd.read_csv(out / "states.csv")
    assert list(states.columns) == ["frame", "time_s", *result.skeleton.dof_names]
    np.testing.assert_allclose(states[result.skeleton.dof_names], result.q, atol=1e-8)
    assert json.loads((out / "metrics.json").read_text()) == result.metrics
    assert yaml.safe_load((out / "sequence.yaml").read_text()) == result.sequence.provenance
    assert names(tmp_path / "deep") == ["run"]
    assert stat.S_IMODE(out.stat().st_mode) == stat.S_IMODE((tmp_path / "deep").stat().st_mode)


def test_unconverged_is_marked_everywhere(tmp_path):
    bad = make_result(status=Status.INTERRUPTED)
    out = save_result(bad, tmp_path / "run", figures=False)
    with xr.open_dataset(out / "fte.nc") as ds:
        assert ds.attrs["status"] == "interrupted"
        assert ds.attrs["converged"] == 0
    assert json.loads((out / "metrics.json").read_text())["status"] == "interrupted"
    assert "interrupted" in (out / "report.html").read_text().lower()


def test_replaces_an_earlier_result_and_an_empty_folder(result, tmp_path):
    out = tmp_path / "run"
    out.mkdir()
    save_result(result, out, figures=False)
    save_result(replace(result, objective=7.0), out, figures=False)
    assert json.loads((out / "metrics.json").read_text())["objective"] == 7.0
    assert names(tmp_path) == ["run"]


def test_follows_a_symbolic_link(result, tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    save_result(result, tmp_path / "link", figures=False)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "fte.nc").is_file()


@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_failure_leaves_no_trace(result, tmp_path, monkeypatch, earlier, error):
    out = tmp_path / "run"
    if earlier:
        save_result(result, out, figures=False)
    before = {p.name: p.read_bytes() for p in out.iterdir()} if earlier else None

    def fail(result, folder):
        folder.mkdir()
        (folder / "half.png").write_text("half")
        raise error("no ink")

    monkeypatch.setattr("acino_fte.plots.save_figures", fail)
    with pytest.raises(error):
        save_result(replace(result, objective=7.0), out)
    assert names(tmp_path) == (["run"] if earlier else [])
    if earlier:
        assert {p.name: p.read_bytes() for p in out.iterdir()} == before


def test_failed_rename_puts_the_old_result_back(result, tmp_path, monkeypatch):
    out = save_result(result, tmp_path / "run", figures=False)
    rename = Path.rename

    def fail(self, target):
        if ".tmp-" in self.name:
            raise OSError("disk on fire")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(OSError, match="disk on fire"):
        save_result(replace(result, objective=7.0), out, figures=False)
    assert names(tmp_path) == ["run"]
    assert json.loads((out / "metrics.json").read_text())["objective"] == 123.5


def test_refuses_a_folder_with_something_else(result, tmp_path):
    out = tmp_path / "thesis"
    out.mkdir()
    (out / "chapter1.tex").write_text("years of work")
    with pytest.raises(InputError, match="chapter1.tex") as caught:
        save_result(result, out)
    assert "-o" in str(caught.value.remedy)
    assert names(out) == ["chapter1.tex"]


def test_refuses_an_earlier_result_with_files_added(result, tmp_path):
    out = save_result(result, tmp_path / "run", figures=False)
    (out / "notes.txt").write_text("stride 3 is the good one")
    with pytest.raises(InputError, match="notes.txt"):
        check_output_folder(out)


def test_refuses_a_file_and_a_parent_that_is_a_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        check_output_folder(tmp_path / "file")
    with pytest.raises(InputError, match="cannot be made"):
        check_output_folder(tmp_path / "file" / "run")


def test_refuses_a_parent_without_permission(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(InputError, match="no permission"):
        check_output_folder(tmp_path / "run")


def test_never_touches_the_input(tmp_path):
    source = tmp_path / "data" / "sequence"
    source.mkdir(parents=True)
    (source / "sequence.yaml").write_text("")
    with pytest.raises(InputError, match="is the input folder"):
        check_output_folder(source, input_folder=source)
    with pytest.raises(InputError, match="lies inside"):
        check_output_folder(source / "out", input_folder=source)
    with pytest.raises(InputError, match="lies inside"):
        check_output_folder(source / "out", input_folder=source / "sequence.yaml")
    with pytest.raises(InputError, match="holds the input"):
        check_output_folder(tmp_path / "data", input_folder=source)
    assert check_output_folder(tmp_path / "out", input_folder=source) == (tmp_path / "out").resolve()


def test_uncertainty_and_parameters_are_read_back(result, tmp_path):
    estimated = with_estimates(result)
    out = save_result(estimated, tmp_path / "run", figures=False)
    covariance = estimated.position_covariance
    with xr.open_dataset(out / "fte.nc") as ds:
        xr.testing.assert_identical(ds.load(), to_dataset(estimated))
    assert ds.position_sd.dims == ds.position.dims
    spine = result.skeleton.marker("spine")
    np.testing.assert_allclose(
        ds.position_sd.sel(keypoints="spine", space="y").values[:, 0], np.sqrt(covariance[:, spine, 1, 1])
    )
    np.testing.assert_array_equal(
        ds.position_covariance.sel(keypoints="spine", space="x", space_other="z").values[:, 0],
        covariance[:, spine, 0, 2],
    )
    np.testing.assert_array_equal(ds.q_sd.values, estimated.q_sd)
    assert float(ds.time_offset.sel(camera="cam2")) == 0.0054
    assert float(ds.time_offset_sd.sel(camera="cam2")) == 0.0004
    assert ds.time_offset.attrs["units"] == "s"
    for group, scale in estimated.parameters["segment_scale"].items():
        assert float(ds.segment_scale.sel(group=group)) == scale
    assert list(ds.extrinsics_rotation.sel(camera="cam3").values) == [0.001, -0.002, 0.0005]
    assert list(ds.extrinsics_translation_sd.sel(camera="cam3").values) == [0.004, 0.006, 0.003]
    assert np.isnan(ds.extrinsics_rotation.sel(camera="cam1")).all()
    assert (
        list(ds.marker_offset.sel(keypoints="nose").values) == estimated.parameters["marker_offset_m"]["nose"]
    )
    assert np.isfinite(ds.noise).all()
    assert json.loads(ds.attrs["parameters"]) == estimated.parameters
    assert json.loads(ds.attrs["findings"]) == list(estimated.findings)
    table = pd.read_csv(out / "positions.csv")
    assert list(table.columns)[-3:] == ["sd_x", "sd_y", "sd_z"]
    np.testing.assert_allclose(
        table[table.marker == "spine"].sd_z, np.sqrt(covariance[:, spine, 2, 2]), atol=1e-6
    )
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["parameters"] == estimated.parameters
    assert metrics["findings"] == list(estimated.findings)


def test_parameters_of_any_shape(result):
    odd = {"gravity": 9.81, "drift_s": {"a": 1.0, "b": None}, "q": {"cam1": 1.0}, "mode": {"x": "text"}}
    ds = to_dataset(replace(result, parameters=odd))
    assert float(ds.gravity) == 9.81
    assert float(ds.drift.sel(drift_name="a")) == 1.0
    assert ds.drift.attrs["units"] == "s"
    assert ds.q.dims == ("time", "dof")
    assert json.loads(ds.attrs["parameters"]) == odd


def test_method_without_a_skeleton(result, tmp_path):
    sparse = triangulated(result)
    out = save_result(sparse, tmp_path / "run", figures=False)
    assert not (out / "states.csv").exists()
    with xr.open_dataset(out / "fte.nc") as ds:
        assert "q" not in ds and "dof" not in ds.dims
        assert 0 < np.isnan(ds.position).mean() < 0.7
    table = pd.read_csv(out / "positions.csv")
    np.testing.assert_array_equal(table.x.isna(), np.isnan(sparse.positions[..., 0]).ravel())
    assert check_output_folder(out) == out
