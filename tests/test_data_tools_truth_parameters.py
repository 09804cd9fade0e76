"""True parameters beside a recording: read back as written, and one clear message for a faulty file."""

import json

import pytest

from acino_fte.data_tools.load import load_sequence
from acino_fte.data_tools.sequence_file import read_sequence_file, write_sequence_file
from acino_fte.data_tools.truth_parameters import FORMAT, read_truth_parameters, write_truth_parameters
from acino_fte.errors import InputError
from acino_fte.simulate import SimulationOptions, simulate
from acino_fte.simulation_files import write_simulation
from acino_fte.skeleton import load_skeleton

CAMERAS = ["cam1", "cam2"]
TRUTH = {
    "time_offset_s": {"cam1": 0.0, "cam2": -0.0123456789012345},
    "extrinsics": {"cam2": {"rotation_rad": [0.01, 0.0, -1e-17], "translation_m": [0.1, 0.2, 0.3]}},
    "segment_scale": {"tail": 1.05},
    "marker_offset_m": {"nose": [0.01, -0.02, 0.0]},
    "swapped": [[3, "cam2", ["l_eye", "r_eye"]], [4, "cam1", ["l_hip"]]],
}


@pytest.fixture(scope="module")
def cheetah():
    return load_skeleton("cheetah")


def test_every_digit_comes_back(cheetah, tmp_path):
    path = tmp_path / "t.json"
    write_truth_parameters(path, TRUTH)
    assert read_truth_parameters(path, cheetah, CAMERAS, 9) == TRUTH
    assert len(path.read_text().splitlines()) < 25  # readable: a line each
    assert max(map(len, path.read_text().splitlines())) < 120


@pytest.mark.parametrize("truth", [{}, {"swapped": []}, {"segment_scale": {}}])
def test_what_is_not_known_is_not_there(cheetah, tmp_path, truth):
    write_truth_parameters(tmp_path / "t.json", truth)
    assert read_truth_parameters(tmp_path / "t.json", cheetah, CAMERAS, 9) == truth


def test_only_what_the_recording_and_the_species_have(cheetah, tmp_path):
    path = tmp_path / "t.json"
    truth = {
        **TRUTH,
        "segment_scale": {"tail": 1.05, "wing": 2.0},
        "marker_offset_m": {"beak": [0.0, 0.0, 0.1]},
        "swapped": [*TRUTH["swapped"], [3, "cam2", ["l_wing"]]],
    }
    write_truth_parameters(path, truth)
    assert read_truth_parameters(path, cheetah, ["cam2"], 4) == {
        "time_offset_s": {"cam2": TRUTH["time_offset_s"]["cam2"]},
        "extrinsics": TRUTH["extrinsics"],
        "segment_scale": {"tail": 1.05},
        "marker_offset_m": {},
        "swapped": [TRUTH["swapped"][0]],
    }


@pytest.mark.parametrize(
    ("content", "problem", "key"),
    [
        ("{", "cannot be read", None),
        ("\xff", "cannot be read", None),
        ("[]", "in a format that this version reads", "format"),
        ({"format": "acino-fte/truth-parameters/9"}, "in a format that this version reads", "format"),
        ({"time_offset": {}}, "time_offset_s", "time_offset"),
        ({"time_offset_s": {"cam1": "late"}}, "fault at 'time_offset_s.cam1'", "time_offset_s.cam1"),
        ({"time_offset_s": {"cam1": float("nan")}}, "fault at", "time_offset_s.cam1"),
        ({"time_offset_s": {"left": 0.1}}, "about other cameras", "time_offset_s"),
        ({"extrinsics": {"cam1": {"rotation_rad": [0, 0, 0]}}}, "fault at", "extrinsics.cam1.translation_m"),
        ({"segment_scale": {"tail": -1}}, "fault at", "segment_scale.tail"),
        ({"marker_offset_m": {"nose": [0, 0]}}, "fault at", "marker_offset_m.nose.2"),
        ({"swapped": [[-1, "cam1", []]]}, "fault at", "swapped.0.0"),
        ({"swapped": [[1, "cam1", "nose"]]}, "fault at", "swapped.0.2"),
    ],
)
def test_a_faulty_file_is_one_message(cheetah, tmp_path, content, problem, key):
    path = tmp_path / "t.json"
    if isinstance(content, dict):
        content = json.dumps({"format": FORMAT, **content})
    path.write_text(content, encoding="latin-1")
    with pytest.raises(InputError, match=problem) as error:
        read_truth_parameters(path, cheetah, CAMERAS, 9)
    assert error.value.file == str(path)
    assert error.value.key == key
    assert error.value.remedy


def test_the_sequence_file_names_it(cheetah, tmp_path):
    options = SimulationOptions(n_frames=6, n_cameras=3, delay_ms=3.0)
    folder = write_simulation(simulate(cheetah, options), tmp_path / "run")
    file = read_sequence_file(folder / "sequence.yaml")
    assert file.truth_parameters == str(folder / "truth_parameters.json")
    sequence = load_sequence(folder)
    write_sequence_file(tmp_path / "sequence.yaml", sequence.provenance)  # as a result folder keeps it
    assert load_sequence(tmp_path / "sequence.yaml").truth_parameters == sequence.truth_parameters
    (folder / "truth_parameters.json").unlink()
    with pytest.raises(InputError, match="does not exist") as error:
        load_sequence(folder)
    assert "truth_parameters" in str(error.value.remedy)
