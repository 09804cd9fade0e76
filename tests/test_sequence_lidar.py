"""The key ``lidar`` of a sequence file: read back, run, and every way that it can be wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from acino_fte.cli import app
from acino_fte.data_tools.load import load_sequence
from acino_fte.data_tools.sequence_lidar import read_returns
from acino_fte.errors import InputError
from acino_fte.rig_files import write_rig_simulation
from acino_fte.rig_options import RigOptions
from acino_fte.simulate_rig import rig_to_sequence, simulate_rig


@pytest.fixture(scope="module")
def simulation():
    return simulate_rig(RigOptions(n_frames=12, distance=50.0, width=852))


@pytest.fixture
def folder(simulation, tmp_path):
    return write_rig_simulation(simulation, tmp_path / "rig")


def test_a_sequence_with_a_lidar_is_read_as_it_was_written(simulation, folder):
    read, meant = load_sequence(folder), rig_to_sequence(simulation)
    for key in ("time", "xyz", "rotation", "translation"):
        np.testing.assert_allclose(getattr(read.lidar, key), getattr(meant.lidar, key), atol=1e-6)
    assert read.lidar.camera == "cam1"
    assert read.lidar.range_sd == pytest.approx(meant.lidar.range_sd)
    assert read.lidar.time_sd == pytest.approx(meant.lidar.time_sd)
    assert read.lidar.range_sd_per_m == meant.lidar.range_sd_per_m
    np.testing.assert_allclose(read.lidar.beam, meant.lidar.beam)
    assert Path(read.provenance["lidar"]["returns"]).is_absolute()


def test_a_run_writes_what_the_lidar_says(folder, tmp_path):
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["run", str(folder), "-o", str(out), "--no-figures"])
    assert done.exit_code == 0, done.output
    assert "depth:" in done.output
    lines = (out / "depth.csv").read_text().splitlines()
    assert lines[0] == "frame,time_s,marker,measured,predicted,sd,returns"
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["depth_m"]["n"] == len(lines) - 1 > 10
    assert set(metrics["parameters"]["surface_offset_m"]) == set(metrics["parameters"]["noise_px"])
    assert (out / "sequence.yaml").read_text().count("lidar")


def test_a_run_may_leave_the_lidar_out(folder, tmp_path):
    out = tmp_path / "out"
    done = CliRunner().invoke(
        app, ["run", str(folder), "-o", str(out), "--no-figures", "--association", "none"]
    )
    assert done.exit_code == 0, done.output
    assert not (out / "depth.csv").exists()
    assert "the lidar is not used" in done.output


def test_ways_to_use_the_lidar_are_compared(folder, tmp_path):
    """With a lidar, the thesis's nearest return stands beside the default; without one it is refused."""
    out = tmp_path / "out"
    given = ["compare", str(folder), "--methods", "fte,fte-nearest", "-o", str(out)]
    done = CliRunner().invoke(app, given)
    assert done.exit_code == 0, done.output
    rows = (out / "comparison.csv").read_text().splitlines()
    assert len(rows) == 3 and "fte-nearest" in rows[2]
    edited(folder, "lidar:\n", "lidar: null\nold:\n")
    text = (folder / "sequence.yaml").read_text()
    (folder / "sequence.yaml").write_text(text[: text.index("lidar: null")])
    done = CliRunner().invoke(app, [*given[:2], "--methods", "fte-nearest", "-o", str(tmp_path / "none")])
    assert done.exit_code == 2
    assert "no lidar" in done.output


def edited(folder, old, new):
    path = folder / "sequence.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def broken_arrays(folder, **arrays):
    np.savez(folder / "lidar.npz", **arrays)


def as_array(path):
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def flipped(path):
    """Damage in the middle of the compressed stream of the largest array."""
    whole = bytearray(path.read_bytes())
    for i in range(len(whole) // 2, len(whole) // 2 + 64):
        whole[i] ^= 0xFF
    path.write_bytes(whole)


FAULTS = {
    "camera": (lambda f: edited(f, "camera: cam1", "camera: cam2"), "lidar.camera"),
    "key": (lambda f: edited(f, "range_sd", "range_ds"), "range_ds"),
    "range": (lambda f: edited(f, "range_sd: 0.02", "range_sd: -1"), "range_sd"),
    "growth": (lambda f: edited(f, "range_sd_per_m: 0.0", "range_sd_per_m: 2"), "range_sd_per_m"),
    "beam": (lambda f: edited(f, "beam_deg:\n  - 0.0", "beam_deg:\n  - -0.1"), "beam_deg"),
    "gone": (lambda f: (f / "lidar.npz").unlink(), "lidar.returns"),
    "text": (lambda f: (f / "lidar.npz").write_text("x,y,z"), "lidar.returns"),
    "empty": (lambda f: (f / "lidar.npz").write_bytes(b""), "lidar.returns"),
    "cut": (lambda f: (f / "lidar.npz").write_bytes((f / "lidar.npz").read_bytes()[:900]), "lidar.returns"),
    "array": (lambda f: as_array(f / "lidar.npz"), "lidar.returns"),
    "flipped": (lambda f: flipped(f / "lidar.npz"), "lidar.returns"),
    "arrays": (lambda f: broken_arrays(f, time=np.zeros(3)), "time (3,)"),
    "shape": (lambda f: broken_arrays(f, time=np.zeros(3), xyz=np.zeros((2, 3))), "xyz (2, 3)"),
    "kind": (lambda f: broken_arrays(f, time=np.array(["a"]), xyz=np.zeros((1, 3))), "<U1"),
    "pickle": (
        lambda f: broken_arrays(f, time=np.array([None], dtype=object), xyz=np.zeros((1, 3))),
        "lidar.returns",
    ),
    "nan": (lambda f: broken_arrays(f, time=np.zeros(1), xyz=np.full((1, 3), np.nan)), "not finite"),
    "calibration": (lambda f: (f / "lidar_camera.json").unlink(), "lidar_camera.json"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_message(folder, fault, tmp_path):
    spoil, said = FAULTS[fault]
    spoil(folder)
    with pytest.raises(InputError) as caught:
        load_sequence(folder)
    assert said in str(caught.value)
    if fault == "camera":
        done = CliRunner().invoke(app, ["run", str(folder), "-o", str(tmp_path / "out")])
        assert done.exit_code == 2
        assert not (tmp_path / "out").exists()


def test_a_calibration_with_another_lens_is_told(folder):
    path = folder / "lidar_camera.json"
    calibration = json.loads(path.read_text())
    assert not load_sequence(folder).warnings
    calibration["camera_matrix"][0][0] *= 1.05
    path.write_text(json.dumps(calibration))
    (said,) = load_sequence(folder).warnings
    assert "another lens" in said


def test_returns_without_intensity_are_read(tmp_path):
    np.savez(tmp_path / "a.npz", time=np.zeros(2), xyz=np.ones((2, 3), dtype=np.float32))
    arrays = read_returns(tmp_path / "a.npz")
    np.testing.assert_array_equal(arrays["intensity"], 0)
    assert arrays["xyz"].dtype == float
