"""Kinematics against independent formulas: 4x4 matrices, finite differences, AcinoSet's rotations."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
import yaml

from acino_fte import models
from acino_fte.codegen import cache_folder, cached_programs
from acino_fte.kinematics import Kinematics, derive_programs, load_kinematics
from acino_fte.observability import random_poses
from acino_fte.skeleton import Skeleton, expand, load_skeleton
from acino_fte.species_file import SpeciesFile

SPECIES = models.species_names()
_PLANE = np.diag([1.0, -1.0, 1.0, 1.0])  # reflection in the plane of symmetry


@pytest.fixture(scope="module", params=SPECIES)
def kinematics(request: pytest.FixtureRequest) -> Kinematics:
    return load_kinematics(load_skeleton(request.param))


def poses(kinematics: Kinematics, n: int = 7) -> np.ndarray:
    return random_poses(kinematics.skeleton, n, seed=3)


def small_skeleton() -> Skeleton:
    """Turns about every axis, a slide after turns, a mirrored limb, a branch."""
    entry = {
        "format": "acino-fte/skeleton/1",
        "name": "small",
        "links": {
            "base": {
                "parent": "world",
                "at": [0.1, 0.2, 0.3],
                "dofs": {
                    "x": {"slide": "x"},
                    "yaw": {"turn": "z"},
                    "roll": {"turn": "x"},
                    "s": {"slide": "y"},
                },
            },
            "l_arm": {
                "parent": "base",
                "at": [0.3, 0.1, -0.2],
                "mirror": "r_arm",
                "dofs": {"a": {"turn": "y"}, "b": {"turn": "x"}, "out": {"slide": "y"}},
            },
        },
        "markers": {
            "top": {"link": "base", "at": [0, 0, 0.2]},
            "l_hand": {"link": "l_arm", "at": [0.1, 0.05, -0.4], "mirror": "r_hand"},
        },
    }
    return expand(SpeciesFile.model_validate(entry))


# --- an implementation of its own: 4x4 matrices from the YAML, twins by reflecting their originals ---


def _motion(entry: dict, value: float) -> np.ndarray:
    result = np.eye(4)
    if "slide" in entry:
        result["xyz".index(entry["slide"]), 3] = value
        return result
    i = "xyz".index(entry["turn"])
    j, k = (i + 1) % 3, (i + 2) % 3
    result[j, j] = result[k, k] = math.cos(value)
    result[k, j], result[j, k] = math.sin(value), -math.sin(value)
    return result


def _shift(at: list[float]) -> np.ndarray:
    result = np.eye(4)
    result[:3, 3] = at
    return result


def homogeneous_positions(path: Path, q: dict[str, float]) -> dict[str, np.ndarray]:
    """Marker positions by name; the file is in metres."""
    species = yaml.safe_load(path.read_text())
    links, markers = species["links"], species["markers"]
    original = {entry["mirror"]: name for name, entry in links.items() if "mirror" in entry}

    def world(name: str) -> np.ndarray:
        if name == "world":
            return np.eye(4)
        entry = links[original.get(name, name)]
        parent, twins = entry["parent"], {left: right for right, left in original.items()}
        if name in original:
            parent = twins.get(parent, parent)
        local = _shift(entry.get("at", [0, 0, 0]))
        for dof, motion in entry.get("dofs", {}).items():
            local = local @ _motion(motion, q[f"{name}.{dof}"])
        return world(parent) @ (_PLANE @ local @ _PLANE if name in original else local)

    positions = {}
    for name, marker in markers.items():
        at = np.array([*marker.get("at", [0, 0, 0]), 1.0])
        positions[name] = (world(marker["link"]) @ at)[:3]
        if "mirror" in marker:
            twins = {left: right for right, left in original.items()}
            link = twins.get(marker["link"], marker["link"])
            positions[marker["mirror"]] = (world(link) @ _PLANE @ at)[:3]
    return positions


def test_positions_equal_homogeneous_transforms(kinematics: Kinematics) -> None:
    skeleton = kinematics.skeleton
    assert skeleton.path is not None
    for q, positions in zip(poses(kinematics), kinematics.positions(poses(kinematics)), strict=True):
        expected = homogeneous_positions(skeleton.path, dict(zip(skeleton.dof_names, q, strict=True)))
        assert expected.keys() == set(skeleton.marker_names)
        for name, position in zip(skeleton.marker_names, positions, strict=True):
            np.testing.assert_allclose(position, expected[name], atol=1e-12)


# --- derivatives ---


def test_jacobian_equals_central_differences(kinematics: Kinematics) -> None:
    q, step = poses(kinematics, 3), 1e-6
    jacobian = kinematics.linearise(q).jacobian
    assert jacobian.shape == (3, kinematics.n_markers, 3, kinematics.n_dofs)
    for j in range(kinematics.n_dofs):
        ahead, behind = q.copy(), q.copy()
        ahead[:, j] += step
        behind[:, j] -= step
        difference = (kinematics.positions(ahead) - kinematics.positions(behind)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., j], difference, atol=2e-9)


def test_positions_of_both_programs_agree(kinematics: Kinematics) -> None:
    q = poses(kinematics)
    np.testing.assert_allclose(kinematics.linearise(q).positions, kinematics.positions(q), atol=1e-14)


def test_second_derivatives_are_axis_cross_jacobian(kinematics: Kinematics) -> None:
    q, step = poses(kinematics, 2), 1e-5
    linear = kinematics.linearise(q)
    jacobian, axes = linear.jacobian, linear.axes
    skeleton = kinematics.skeleton
    for m in {0, kinematics.n_markers // 2, kinematics.n_markers - 1}:
        chain = skeleton.ancestors(skeleton.markers[m].link)
        for place, i in enumerate(chain):
            ahead, behind = q.copy(), q.copy()
            ahead[:, i] += step
            behind[:, i] -= step
            difference = (kinematics.linearise(ahead).jacobian - kinematics.linearise(behind).jacobian)[
                :, m
            ] / (2 * step)
            for j in chain[place:]:
                expected = np.cross(axes[:, i], jacobian[:, m, :, j])
                np.testing.assert_allclose(difference[..., j], expected, atol=1e-7)


def test_depends_is_the_pattern_of_the_jacobian(kinematics: Kinematics) -> None:
    jacobian = kinematics.linearise(poses(kinematics)).jacobian
    moved = np.abs(jacobian).max(axis=(0, 2)) > 1e-12
    assert not (moved & ~kinematics.depends).any()


def test_twists_equal_sympy_differentiation() -> None:
    import sympy as sp

    skeleton = small_skeleton()
    kinematics = Kinematics(skeleton, *(derive_programs(skeleton)[k] for k in ("positions", "twists")))
    q = sp.symbols(f"q_0:{len(skeleton.dofs)}", real=True)
    names = dict(zip(kinematics.position_program.inputs, q, strict=True))
    functions = {"sin": sp.sin, "cos": sp.cos}
    symbolic = sp.Matrix(kinematics.position_program.run(names, functions))
    expected = sp.lambdify([q], symbolic.jacobian(q), "numpy")
    for pose in np.random.default_rng(0).uniform(-2, 2, (5, len(q))):
        jacobian = kinematics.linearise(pose[None]).jacobian
        np.testing.assert_allclose(jacobian[0].reshape(-1, len(q)), expected(pose), atol=1e-13)


# --- AcinoSet ---


def _passive(axis: str, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array(
        {
            "x": [[1, 0, 0], [0, c, s], [0, -s, c]],
            "y": [[c, 0, -s], [0, 1, 0], [s, 0, c]],
            "z": [[c, s, 0], [-s, c, 0], [0, 0, 1]],
        }[axis]
    )


def acinoset_positions(x: np.ndarray) -> dict[str, np.ndarray]:
    """The 24 markers of AcinoSet's cheetah from its 29 states, with its passive rotations."""

    def child(parent: np.ndarray, **angles: float) -> np.ndarray:
        result = parent
        for axis in "yxz":  # R_local = Rz Rx Ry
            if axis in angles:
                result = _passive(axis, angles[axis]) @ result
        return result

    head = child(np.eye(3), x=x[3], y=x[4], z=x[5])
    neck = child(head, x=x[6], y=x[7], z=x[8])
    front = child(neck, y=x[9])
    back = child(front, x=x[10], y=x[11], z=x[12])
    tail0 = child(back, y=x[13], z=x[14])
    tail1 = child(tail0, y=x[15], z=x[16])
    p: dict[str, np.ndarray] = {}

    def put(name: str, origin: np.ndarray, frame: np.ndarray, *offset: float) -> np.ndarray:
        p[name] = origin + frame.T @ np.array(offset)
        return p[name]

    put("l_eye", x[:3], head, 0, 0.03, 0)
    put("r_eye", x[:3], head, 0, -0.03, 0)
    put("nose", x[:3], head, 0.055, 0, -0.055)
    neck_base = put("neck_base", x[:3], neck, -0.28, 0, 0)
    spine = put("spine", neck_base, front, -0.37, 0, 0)
    tail_base = put("tail_base", spine, back, -0.37, 0, 0)
    put("tail1", tail_base, tail0, -0.28, 0, 0)
    put("tail2", p["tail1"], tail1, -0.36, 0, 0)
    limbs = {
        "front": (neck_base, front, "shoulder", (-0.04, -0.10), (-0.24, -0.28, -0.14)),
        "back": (tail_base, back, "hip", (0.12, -0.06), (-0.32, -0.25, -0.22)),
    }
    states = {
        "l_front": (17, 18, 25),
        "r_front": (19, 20, 26),
        "l_back": (21, 22, 27),
        "r_back": (23, 24, 28),
    }
    for limb, indices in states.items():
        side, end = limb.split("_")
        origin, frame, joint, (forward, up), lengths = limbs[end]
        origin = put(f"{side}_{joint}", origin, frame, forward, 0.08 if side == "l" else -0.08, up)
        for name, length, i in zip(("knee", "ankle", "paw"), lengths, indices, strict=True):
            frame = child(frame, y=x[i])
            origin = put(f"{limb}_{name}", origin, frame, 0, 0, length)
    return p


def test_acinoset_cheetah_equals_the_published_formulas() -> None:
    kinematics = load_kinematics(load_skeleton("cheetah_acinoset"))
    states = np.random.default_rng(1).uniform(-3, 3, (20, 29))
    for state, positions in zip(states, kinematics.positions(states), strict=True):
        expected = acinoset_positions(state)
        assert expected.keys() == set(kinematics.skeleton.marker_names)
        for name, position in zip(kinematics.skeleton.marker_names, positions, strict=True):
            np.testing.assert_allclose(position, expected[name], atol=1e-12, rtol=0, err_msg=name)


# --- mirror symmetry ---


def test_equal_angles_on_both_sides_mirror_the_markers(kinematics: Kinematics) -> None:
    skeleton = kinematics.skeleton
    twins = _dof_twins(skeleton)
    q = poses(kinematics)
    for j in skeleton_root(skeleton):
        q[:, j] = 0.0
    for j, dof in enumerate(skeleton.dofs):
        if j not in twins and (dof.kind, int(np.argmax(np.abs(dof.axis)))) in {
            ("turn", 0),
            ("turn", 2),
            ("slide", 1),
        }:
            q[:, j] = 0.0  # the trunk stays in the plane of symmetry
    for left, right in twins.items():
        q[:, right] = q[:, left]
    positions = kinematics.positions(q)
    assert skeleton.twins
    for left, right in skeleton.twins:
        image = positions[:, skeleton.marker(left)] * [1, -1, 1]
        np.testing.assert_allclose(positions[:, skeleton.marker(right)], image, atol=1e-13)


def skeleton_root(skeleton: Skeleton) -> set[int]:
    return {j for link in skeleton.links if link.parent < 0 for j in link.dofs}


def _dof_twins(skeleton: Skeleton) -> dict[int, int]:
    markers = {m.name: m for m in skeleton.markers}
    pairs: dict[int, int] = {}
    for left, right in skeleton.twins:
        a, b = skeleton.ancestors(markers[left].link), skeleton.ancestors(markers[right].link)
        pairs |= {i: j for i, j in zip(a, b, strict=True) if i != j}
    return pairs


# --- the program on other algebras ---


def test_program_gives_the_same_numbers_on_floats_and_pyomo(kinematics: Kinematics) -> None:
    import pyomo.environ as pyo

    program = kinematics.position_program
    q = poses(kinematics, 1)[0]
    expected = kinematics.positions(q[None]).ravel()
    floats = program.run(
        dict(zip(program.inputs, q.tolist(), strict=True)), {"sin": math.sin, "cos": math.cos}
    )
    np.testing.assert_allclose(floats, expected, atol=1e-13)

    model = pyo.ConcreteModel()
    model.q = pyo.Var(range(len(q)), initialize=dict(enumerate(q.tolist())))
    variables = {name: model.q[i] for i, name in enumerate(program.inputs)}
    outputs = program.run(variables, {"sin": pyo.sin, "cos": pyo.cos})
    np.testing.assert_allclose([pyo.value(o) for o in outputs], expected, atol=1e-13)


# --- the cache ---


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("ACINO_FTE_CACHE", str(folder))
    return folder


def test_cached_programs_equal_derived_ones(cache: Path) -> None:
    skeleton = small_skeleton()
    first = load_kinematics(skeleton)
    assert len(list(cache.glob("kinematics-*.json"))) == 1
    second = load_kinematics(skeleton)
    assert first.position_program == second.position_program
    assert first.twist_program == second.twist_program


def test_cached_programs_are_not_derived_again(cache: Path) -> None:
    programs = derive_programs(small_skeleton())
    cached_programs("test", ["key"], lambda: programs)

    def never() -> dict:
        raise AssertionError("derived though it is in the cache")

    assert cached_programs("test", ["key"], never) == programs
    with pytest.raises(AssertionError):
        cached_programs("test", ["another key"], never)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Kinematics, Path]:
    """A small skeleton's kinematics, and the only file of the cache that they were put in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ACINO_FTE_CACHE", str(tmp_path_factory.mktemp("whole")))
        kinematics = load_kinematics(small_skeleton())
        (file,) = cache_folder().glob("*.json")
    return kinematics, file


@pytest.mark.parametrize("damage", ["", "{", "[1, 2]", '{"positions": 3}', '{"positions": {"inputs": []}}'])
def test_a_damaged_cache_file_is_derived_again(
    cache: Path, whole: tuple[Kinematics, Path], damage: str
) -> None:
    kinematics, complete = whole
    text = complete.read_text()
    cache.mkdir(exist_ok=True)
    file = cache / complete.name
    file.write_text(damage or text[: len(text) // 2])
    again = load_kinematics(small_skeleton())
    assert again.twist_program == kinematics.twist_program
    assert list(cache.iterdir()) == [file]
    assert file.read_text() == text


def test_a_cache_that_cannot_be_written_only_costs_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("ACINO_FTE_CACHE", str(tmp_path / "file" / "cache"))
    assert load_kinematics(small_skeleton()).n_markers == 3
    if os.name == "posix":
        folder = tmp_path / "locked"
        folder.mkdir(mode=0o500)
        monkeypatch.setenv("ACINO_FTE_CACHE", str(folder))
        assert load_kinematics(small_skeleton()).n_markers == 3


def test_other_dimensions_are_another_cache_entry(cache: Path) -> None:
    skeletons = [load_skeleton("cheetah"), load_skeleton("cheetah_acinoset")]
    assert len({s.content_hash for s in skeletons}) == 2


# --- sizes ---


def test_species_have_the_published_sizes() -> None:
    sizes = {name: (len(load_skeleton(name).dofs), len(load_skeleton(name).markers)) for name in SPECIES}
    assert sizes["cheetah"] == sizes["cheetah_acinoset"] == (29, 24)
    assert 28 <= sizes["human"][0] <= 34


def test_no_frames_give_empty_arrays(kinematics: Kinematics) -> None:
    empty = np.empty((0, kinematics.n_dofs))
    assert kinematics.positions(empty).shape == (0, kinematics.n_markers, 3)
    assert kinematics.linearise(empty).jacobian.shape == (0, kinematics.n_markers, 3, kinematics.n_dofs)
