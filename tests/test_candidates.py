"""Several candidates per marker: DeepLabCut's full pickle, tables, and the way to a Sequence."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from data_tools_synthetic import MARKERS, N_FRAMES, message, pixels, ring, write_recording

from acino_fte.data_tools.deeplabcut import read_deeplabcut
from acino_fte.data_tools.deeplabcut_candidates import MAX_CANDIDATES, from_candidates, support
from acino_fte.data_tools.load import load_sequence
from acino_fte.data_tools.safe_pickle import load_data_pickle

NAMES = ["nose", "l_eye", "tail_base"]


def peaks(*parts: list[tuple[float, float, float]], costs: Any = None) -> dict[str, Any]:
    """One frame as DeepLabCut stores it, from (x, y, confidence) of each peak of each body part."""
    arrays = [np.array(part, dtype=np.float32).reshape(-1, 3) for part in parts]
    return {
        "coordinates": ([a[:, :2] for a in arrays],),
        "confidence": [a[:, 2:] for a in arrays],
        "costs": costs,
    }


def full(
    *frames: dict[str, Any], names: list[str] = NAMES, graph: Any = None, width: int = 4
) -> dict[str, Any]:
    metadata = {
        "nms radius": 5.0,
        "PAFgraph": graph if graph is not None else [[0, 1], [1, 2]],
        "PAFinds": np.arange(2),
        "all_joints": [[i] for i in range(len(names))],
        "all_joints_names": names,
        "nframes": len(frames),
    }
    return {"metadata": metadata, **{f"frame{i:0{width}}": frame for i, frame in enumerate(frames)}}


def write_pickle(path: Path, data: Any) -> Path:
    path.write_bytes(pickle.dumps(data, pickle.HIGHEST_PROTOCOL))
    return path


def write_table(path: Path, *rows: str, header: str = "frame,marker,candidate,x,y,likelihood") -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


# --- DeepLabCut's full pickle ---


def test_peaks_are_sorted_by_confidence(tmp_path: Path) -> None:
    data = full(
        peaks([(10, 20, 0.4), (30, 40, 0.9)], [(1, 2, 0.5)], []),
        peaks([(50, 60, 0.7)], [], [(7, 8, 0.2), (9, 9, 0.1)]),
    )
    read = read_deeplabcut(write_pickle(tmp_path / "cam1_full.pickle", data))
    assert (read.names, read.n_frames, read.depth) == (tuple(NAMES), 2, 2)
    assert read.candidate_position is not None and read.candidate_likelihood is not None
    np.testing.assert_array_equal(read.candidate_position[0, 0], [[30, 40], [10, 20]])
    np.testing.assert_array_equal(read.candidate_position[0, 1], [[1, 2], [np.nan, np.nan]])
    np.testing.assert_allclose(read.candidate_likelihood[0], [[0.9, 0.4], [0.5, 0], [0, 0]], atol=1e-7)
    np.testing.assert_array_equal(read.position, read.candidate_position[:, :, 0])
    np.testing.assert_array_equal(read.likelihood, read.candidate_likelihood[:, :, 0])
    assert np.isnan(read.position[0, 2]).all()


def test_frames_may_be_missing_and_peaks_may_mean_nothing(tmp_path: Path) -> None:
    data = full(
        {},
        peaks([(0, 0, 0.9), (3, 4, 0.1)], [(np.nan, 2, 0.5), (5, 6, -1)], [(1, 1, 0.3), (2, 2, np.nan)]),
        peaks([], [], []),
    )
    del data["frame0000"]
    read = read_deeplabcut(write_pickle(tmp_path / "a.pickle", data))
    assert read.n_frames == 3
    np.testing.assert_array_equal(read.position[1], [[3, 4], [np.nan, np.nan], [1, 1]])
    assert np.isnan(read.position[[0, 2]]).all() and not read.likelihood[[0, 2]].any()
    assert read.candidate_position is None  # never a second one


def test_only_the_best_are_kept(tmp_path: Path) -> None:
    many = [(10.0 + i, 5.0, 0.05 * (i + 1)) for i in range(MAX_CANDIDATES + 4)]
    read = read_deeplabcut(write_pickle(tmp_path / "a.pkl", full(peaks(many, [], []))))
    assert read.depth == MAX_CANDIDATES
    np.testing.assert_array_equal(read.candidates[0][0, 0, :, 0], 10 + np.arange(MAX_CANDIDATES + 3, 3, -1))


AFFINITY = {"m1": np.array([[0.0], [0.9]], dtype=np.float32), "distance": np.array([[9.0], [40.0]])}
EDGE = [(1, 1, 0.6), (2, 2, 0.5)]


def test_affinities_put_the_connected_peak_first(tmp_path: Path) -> None:
    entry = peaks(EDGE, [(5, 5, 0.9)], [], costs={0: AFFINITY})
    read = read_deeplabcut(write_pickle(tmp_path / "a.pickle", full(entry)))
    np.testing.assert_array_equal(read.candidates[0][0, 0], [[2, 2], [1, 1]])
    np.testing.assert_allclose(read.candidates[1][0, 0], [0.5, 0.6], atol=1e-7)  # as the detector gave them


def test_the_support_of_a_peak() -> None:
    arrays = [
        (np.zeros((2, 2)), np.array([0.6, 0.5])),
        (np.ones((1, 2)), np.array([0.9])),
        (np.ones((0, 2)), np.ones(0)),
    ]
    limbs = [(0, 1), (0, 1), (1, 2)]
    costs = {0: AFFINITY, 1: {"m1": np.array([[np.nan], [-0.3]])}, 2: {"m1": np.ones((1, 0))}}
    nose, eye, tail = support(costs, limbs, arrays)
    np.testing.assert_allclose(nose, [0, 0.9 * 0.9 / 2])
    np.testing.assert_allclose(eye, [0.9 * 0.5 / 2])
    assert len(tail) == 0
    unusable = {0: {"m1": np.ones((3, 3))}, 1: {"distance": np.ones((2, 1))}, 7: AFFINITY}
    assert not np.concatenate(support(unusable, limbs, arrays)).any()


@pytest.mark.parametrize("graph", [[], [[0, 9]], [[0, 1, 2]], ["ab"], [[0.5, 1]], None])
def test_a_graph_that_says_nothing_is_not_used(graph: Any, tmp_path: Path) -> None:
    data = full(peaks(EDGE, [(5, 5, 0.9)], [], costs={0: AFFINITY}))
    data["metadata"]["PAFgraph"] = graph
    read = read_deeplabcut(write_pickle(tmp_path / "a.pickle", data))
    np.testing.assert_array_equal(read.position[0, 0], [1, 1])


def ruamel(monkeypatch: pytest.MonkeyPatch) -> dict[str, type]:
    """Classes that pickle under the names of ruamel.yaml's, with the state that those carry."""
    made: dict[str, type] = {}
    for module, name, base in (
        ("ruamel.yaml.comments", "CommentedSeq", list),
        ("ruamel.yaml.comments", "LineCol", object),
        ("ruamel.yaml.scalarfloat", "ScalarFloat", float),
        ("ruamel.yaml.scalarint", "ScalarInt", int),
        ("ruamel.yaml.main", "YAML", object),
    ):
        made[name] = type(name, (base,), {"__module__": module})
        if module not in sys.modules:
            monkeypatch.setitem(sys.modules, module, ModuleType(module))
        monkeypatch.setattr(sys.modules[module], name, made[name], raising=False)
    for package in ("ruamel", "ruamel.yaml"):
        if package not in sys.modules:
            monkeypatch.setitem(sys.modules, package, ModuleType(package))
    return made


def test_lists_and_numbers_of_the_configuration_are_read_without_its_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as context:
        kinds = ruamel(context)
        edge = kinds["CommentedSeq"]([kinds["ScalarInt"](0), kinds["ScalarInt"](1)])
        edge.comment = kinds["LineCol"]()  # type: ignore[attr-defined]
        edge.comment.line = 7  # type: ignore[attr-defined]
        data = full(peaks(EDGE, [(5, 5, 0.9)], [], costs={0: AFFINITY}), graph=kinds["CommentedSeq"]([edge]))
        data["metadata"]["nms radius"] = kinds["ScalarFloat"](5.0)
        path = write_pickle(tmp_path / "a.pickle", data)
        loader = write_pickle(tmp_path / "b.pickle", {"metadata": kinds["YAML"]()})
    np.testing.assert_array_equal(read_deeplabcut(path).position[0, 0], [2, 2])
    loaded = load_data_pickle(path.read_bytes(), file=path)["metadata"]
    assert (loaded["PAFgraph"], loaded["nms radius"]) == ([[0, 1]], 5.0)
    assert "ruamel.yaml.main.YAML" in message(read_deeplabcut, loader).found


class _Bomb:
    def __reduce__(self) -> tuple[Any, ...]:
        return eval, ("1/0",)


def test_pickles_that_are_not_detections(tmp_path: Path) -> None:
    good = peaks([(1, 1, 0.5)], [(2, 2, 0.5)], [(3, 3, 0.5)])
    path = tmp_path / "a_full.pickle"
    for data, said in (
        ([1, 2], "list"),
        ({"data": {}}, "data"),
        ({"metadata": {"all_joints_names": []}}, "metadata"),
        (full(), "metadata"),
        (full(good, names=["nose", "nose", "tail"]), "nose, nose"),
        (full(good, names=["nose", "tail"]), "(1, 1)"),
        (full({"coordinates": ([],)}), "confidence"),
        (full({**good, "confidence": [np.ones(2)] * 3}), "(1, 2)"),
        (full({**good, "coordinates": ([np.ones(3)] * 3,)}), "cannot reshape"),
    ):
        error = message(read_deeplabcut, write_pickle(path, data))
        assert "does not hold DeepLabCut's detections" in error.problem
        assert said in str(error.found) and "_full.pickle" in str(error.remedy)
    error = message(read_deeplabcut, write_pickle(path, full(good, {**good, "costs": _Bomb()})))
    assert "could run code" in error.problem and "eval" in str(error.found)
    path.write_bytes(b"SQLite format 3\0")  # a shelf
    assert "broken" in message(read_deeplabcut, path).problem
    percent = full(peaks([(1, 1, 50)], [(2, 2, 0.5)], []))
    assert "no probabilities" in message(read_deeplabcut, write_pickle(path, percent)).problem


# --- tables of candidates ---


def test_a_table_of_candidates(tmp_path: Path) -> None:
    rows = [
        "2,nose,0,1,2,0.3",
        "2,nose,1,3,4,0.8",
        "0,tail_base,4,5,6,0.5",
        "2,tail_base,0,,,",
        "2, nose ,7,9,9,0.3",
    ]
    read = read_deeplabcut(write_table(tmp_path / "cam1.csv", *rows))
    assert (read.names, read.n_frames, read.depth) == (("nose", "tail_base"), 3, 3)
    position, likelihood = read.candidates
    np.testing.assert_array_equal(position[2, 0], [[3, 4], [1, 2], [9, 9]])
    np.testing.assert_array_equal(likelihood[2, 0], [0.8, 0.3, 0.3])
    np.testing.assert_array_equal(read.position[0], [[np.nan, np.nan], [5, 6]])
    assert np.isnan(position[2, 1]).all()


TABLE_FAULTS = [
    ([], "", "without a frame or a marker", "0 rows"),
    (["0.5,nose,0,1,1,1"], "", "without a frame or a marker", "0.5"),
    (["0,nose,0,1,1,1", "-1,nose,0,1,1,1"], "", "without a frame or a marker", "-1"),
    (["0,,0,1,1,1"], "", "without a frame or a marker", "1 rows"),
    (["0,nose,0,1,1,1", "0,nose,0,2,2,1"], "", "candidate 0 of 'nose' twice", ""),
    (["0,nose,0,left,1,1"], "", "cannot be read", "left"),
    (["0,nose,0,1,1,97"], "", "no probabilities", "97"),
    (["0,nose,0,1,1"], "frame,marker,candidate,x,y", "lacks a column", "candidate, x, y"),
]


@pytest.mark.parametrize(("rows", "header", "problem", "found"), TABLE_FAULTS)
def test_faults_of_a_table(rows: list[str], header: str, problem: str, found: str, tmp_path: Path) -> None:
    kwargs = {"header": header} if header else {}
    error = message(read_deeplabcut, write_table(tmp_path / "cam1.csv", *rows, **kwargs))
    assert problem in error.problem and found in str(error.found)


def test_no_candidates_at_all() -> None:
    read = from_candidates(("a", "b"), 4, np.empty((0, 6)), Path("x"))
    assert read.position.shape == (4, 2, 2) and np.isnan(read.position).all()


# --- into a sequence ---


def write_candidates(folder: Path) -> np.ndarray:
    """A recording whose second camera has a worse copy of every detection; the points (N, C, M, 2) of all."""
    write_recording(folder)
    points = pixels(ring())
    rows = [
        f"{n},{marker},{k},{x + 40 * k:.3f},{y - 25 * k:.3f},{0.8 - 0.5 * k}"
        for n in range(N_FRAMES)
        for marker, (x, y) in zip(MARKERS, points[n, 1], strict=True)
        for k in (1, 0)
    ]
    write_table(folder / "cam2.csv", *rows)
    return points


def test_a_sequence_carries_its_candidates(tmp_path: Path) -> None:
    points = write_candidates(tmp_path / "run")
    sequence = load_sequence(tmp_path / "run")
    detections = sequence.detections
    assert detections.candidate_position.dims == ("frame", "camera", "marker", "candidate", "space")
    assert detections.candidate_likelihood.dims == ("frame", "camera", "marker", "candidate")
    np.testing.assert_array_equal(detections.candidate_position[..., 0, :], detections.position)
    np.testing.assert_array_equal(detections.candidate_likelihood[..., 0], detections.likelihood)
    found = sequence.candidates(MARKERS, 0.2)
    assert found is not None and found.shape == (*points.shape[:3], 2, 2)
    np.testing.assert_array_equal(found[..., 0, :], sequence.pixels(MARKERS, 0.2))
    np.testing.assert_allclose(found[:, 1, :, 1], points[:, 1] + [40, -25], atol=1e-3)
    assert np.isnan(found[:, [0, 2, 3], :, 1]).all()
    unsure = sequence.candidates(["nose", "no_such_marker"], 0.5)
    assert unsure is not None and np.isnan(unsure[:, :, :, 1]).all() and np.isnan(unsure[:, :, 1]).all()
    part = sequence.select_frames(3, 8).candidates(MARKERS, 0.2)
    np.testing.assert_array_equal(part, found[3:8])


def test_a_sequence_without_candidates(tmp_path: Path) -> None:
    sequence = load_sequence(write_recording(tmp_path / "run"))
    assert set(sequence.detections.data_vars) == {"position", "likelihood"}
    assert sequence.candidates(MARKERS, 0.5) is None
