"""Faults and likely mistakes that ``check_skeleton`` finds, and what the markers can observe."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml

from acino_fte import models
from acino_fte.data_tools.deeplabcut import write_deeplabcut_csv
from acino_fte.errors import InputError
from acino_fte.observability import observability
from acino_fte.skeleton import expand, load_skeleton
from acino_fte.skeleton_check import Finding, check_skeleton, match_keypoints
from acino_fte.species_file import FORMAT, SpeciesFile

_ROOT = {
    "x": {"slide": "x"},
    "y": {"slide": "y"},
    "z": {"slide": "z"},
    "yaw": {"turn": "z"},
    "pitch": {"turn": "y"},
    "roll": {"turn": "x"},
}
SOUND: dict[str, Any] = {
    "format": FORMAT,
    "name": "sound",
    "links": {
        "trunk": {"parent": "world", "dofs": _ROOT},
        "l_leg": {
            "parent": "trunk",
            "at": [0, 0.1, -0.1],
            "mirror": "r_leg",
            "dofs": {"hip": {"turn": "y", "range": [-60, 60]}},
        },
    },
    "markers": {
        "nose": {"link": "trunk", "at": [0.4, 0, 0]},
        "back": {"link": "trunk", "at": [-0.1, 0, 0.1]},
        "l_hip": {"link": "l_leg", "mirror": "r_hip"},
        "l_foot": {"link": "l_leg", "at": [0, 0, -0.5], "mirror": "r_foot"},
    },
    "draw": [["nose", "back"], ["back", "l_hip"], ["l_hip", "l_foot"]],
}


@pytest.fixture
def check(tmp_path: Path) -> Any:
    def run(change: Any = None) -> list[Finding]:
        data = deepcopy(SOUND)
        if change:
            change(data)
        path = tmp_path / "mine.yaml"
        path.write_text(yaml.safe_dump(data, sort_keys=False))
        return check_skeleton(path)

    return run


def test_sound_files_have_no_findings(check: Any) -> None:
    assert check() == []


@pytest.mark.parametrize("name", models.species_names())
def test_bundled_species_are_sound(name: str) -> None:
    assert check_skeleton(name) == []


def test_all_faults_are_collected(check: Any) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["links"]["trunk"]["dof"] = {}
        data["markers"]["nose"]["sdpx"] = 3
        data["links"]["l_leg"]["parent"] = "trunc"
        data["links"]["l_leg"]["mirror"] = "trunk"
        data["links"]["a"] = {"parent": "b"}
        data["links"]["b"] = {"parent": "a"}
        data["markers"]["back"]["link"] = "trunkk"
        data["draw"].append(["nos", "back"])

    findings = check(spoil)
    assert {f.severity for f in findings} == {"error"}
    assert {f.where for f in findings} == {
        "links.trunk.dof",
        "markers.nose.sdpx",
        "links.l_leg.parent",
        "links.l_leg.mirror",
        "links.a",
        "markers.back.link",
        "draw[3]",
    }
    assert all(f.remedy for f in findings)
    assert sum("did you mean" in f.message for f in findings) == 5


def test_faults_that_leave_nothing_to_check_further(check: Any, tmp_path: Path) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["links"]["l_leg"]["at"] = ["far", 0, 0]
        data["markers"]["nose"]["link"] = 3

    assert {f.where for f in check(spoil)} == {"links.l_leg.at.0", "markers.nose.link"}
    (tmp_path / "broken.yaml").write_text("format: [")
    (finding,) = check_skeleton(tmp_path / "broken.yaml")
    assert finding.severity == "error"
    assert "not valid YAML" in finding.message
    with pytest.raises(InputError, match="does not exist"):
        check_skeleton(tmp_path / "none.yaml")


def _only(findings: list[Finding], severity: str, where: str, text: str) -> None:
    assert [(f.severity, f.where) for f in findings] == [(severity, where)], findings
    assert text in findings[0].message


def test_unused_links(check: Any) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["links"]["tail"] = {"parent": "trunk", "dofs": {"yaw": {"turn": "z", "range": [-9, 9]}}}

    _only(check(spoil), "error", "links.tail", "unused")


def test_unused_links_without_freedom_are_a_warning(check: Any) -> None:
    _only(
        check(lambda d: d["links"].update(tail={"parent": "trunk"})),
        "warning",
        "links.tail",
        "carries no marker",
    )


def test_degrees_of_freedom_that_no_marker_sees(check: Any) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["links"]["l_leg"]["dofs"]["twist"] = {"turn": "z", "range": [-30, 30]}

    findings = check(spoil)  # both markers of the leg lie on the axis of its last turn
    assert [(f.severity, f.where) for f in findings] == [
        ("error", "links.l_leg.dofs.twist"),
        ("error", "links.r_leg.dofs.twist"),
    ]
    assert "can never tell" in findings[0].message


def test_degrees_of_freedom_that_hide_each_other(check: Any) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["links"]["trunk"]["dofs"] = {**_ROOT, "yaw2": {"turn": "z"}, "spin": {"turn": "z"}}
        data["links"]["l_leg"]["dofs"]["hip2"] = {"turn": "y", "range": [-60, 60]}

    confounded = {f.where: f.message for f in check(spoil) if "apart" in f.message}
    assert set(confounded) == {"links.trunk.dofs.yaw", "links.l_leg.dofs.hip", "links.r_leg.dofs.hip"}
    assert "l_leg.hip, l_leg.hip2 apart" in confounded["links.l_leg.dofs.hip"]
    turns = ", ".join(f"trunk.{d}" for d in ("yaw", "pitch", "roll", "yaw2", "spin"))
    assert f"{turns} apart" in confounded["links.trunk.dofs.yaw"]  # five turns, and space has three


def test_a_chain_with_one_marker_at_its_end() -> None:
    """Three turns in one plane move one point: two directions are seen, one is not, at every pose."""
    links = {"a": {"parent": "world", "dofs": {"q": {"turn": "y"}}}}
    for parent, name in ("ab", "bc"):
        links[name] = {"parent": parent, "at": [0, 0, -1], "dofs": {"q": {"turn": "y"}}}
    data = {
        "format": FORMAT,
        "name": "chain",
        "links": links,
        "markers": {"end": {"link": "c", "at": [0, 0, -1]}},
    }
    skeleton = expand(SpeciesFile.model_validate(data))
    found = observability(skeleton)
    assert found.unseen == []
    assert found.confounded == [["a.q", "b.q", "c.q"]]


def test_roots_that_cannot_move(check: Any) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["links"]["trunk"]["dofs"] = {"x": {"slide": "x"}, "pitch": {"turn": "y"}}

    messages = [f.message for f in check(spoil)]
    assert any("cannot move along y, z" in m for m in messages)
    assert any("cannot turn round" in m for m in messages)

    def limit(data: dict[str, Any]) -> None:
        data["links"]["trunk"]["dofs"] = {**_ROOT, "yaw": {"turn": "z", "range": [-90, 90]}}

    _only(check(limit), "warning", "links.trunk.dofs.yaw.range", "cannot face every way")


def test_two_roots(check: Any) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["links"]["ball"] = {"parent": "world", "dofs": {"x": {"slide": "x"}}}
        data["markers"]["ball"] = {"link": "ball", "at": [0, 0, 0.1]}
        data["draw"].append(["ball", "nose"])

    assert "links.ball.parent" in [f.where for f in check(spoil)]


def test_one_sided_parts_and_coincident_twins(check: Any) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["markers"]["l_knee"] = {"link": "l_leg", "at": [0, 0.01, -0.2]}
        data["markers"]["l_ear"] = {"link": "trunk", "at": [0.3, 0, 0.2], "mirror": "r_ear"}
        data["draw"] += [["l_knee", "l_foot"], ["l_ear", "nose"]]

    findings = check(spoil)
    assert [f.where for f in findings] == ["markers.l_knee", "markers.l_ear.at", "markers.r_ear.at"]
    assert "has no twin itself" in findings[0].message
    assert "start at the same point" in findings[1].message


@pytest.mark.parametrize(
    ("limits", "text"), [([-0.5, 0.5], "less than two degrees"), ([-300, 300], "more than a whole turn")]
)
def test_ranges_in_the_wrong_unit(check: Any, limits: list[float], text: str) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["links"]["l_leg"]["dofs"]["hip"]["range"] = limits

    _only(check(spoil), "warning", "links.l_leg.dofs.hip.range", text)


def test_sizes_in_the_wrong_unit(check: Any) -> None:
    findings = check(lambda d: d["markers"]["nose"].update(at=[400, 0, 0]))
    _only(findings, "warning", "units.length", "400 m")


def test_markers_on_no_line(check: Any) -> None:
    _only(check(lambda d: d["draw"].pop()), "warning", "draw", "l_foot, r_foot")


# --- keypoint files ---


def _table(folder: Path, names: list[str]) -> Path:
    import numpy as np

    path = folder / "keypoints.csv"
    write_deeplabcut_csv(path, names, np.ones((2, len(names), 2)), np.ones((2, len(names))))
    return path


DLC_HUMAN = [
    "ankle1",
    "knee1",
    "hip1",
    "hip2",
    "knee2",
    "ankle2",
    "wrist1",
    "elbow1",
    "shoulder1",
    "shoulder2",
    "elbow2",
    "wrist2",
    "chin",
    "forehead",
]
BODY_25 = [
    "Nose",
    "Neck",
    "RShoulder",
    "RElbow",
    "RWrist",
    "LShoulder",
    "LElbow",
    "LWrist",
    "MidHip",
    "RHip",
    "RKnee",
    "RAnkle",
    "LHip",
    "LKnee",
    "LAnkle",
    "REye",
    "LEye",
    "REar",
    "LEar",
    "LBigToe",
    "LSmallToe",
    "LHeel",
    "RBigToe",
    "RSmallToe",
    "RHeel",
]
BODY_25B = [n for n in BODY_25 if n not in ("Neck", "MidHip")] + ["UpperNeck", "HeadTop"]
SUPERANIMAL = [
    "nose",
    "right_eye",
    "left_eye",
    "neck_base",
    "neck_end",
    "back_base",
    "back_middle",
    "back_end",
    "tail_base",
    "tail_end",
    "front_left_thai",
    "front_left_knee",
    "front_left_paw",
    "front_right_thai",
    "front_right_knee",
    "front_right_paw",
    "back_left_paw",
    "back_left_thai",
    "back_right_thai",
    "back_left_knee",
    "back_right_knee",
    "back_right_paw",
]
AP_10K = [
    "left_eye",
    "right_eye",
    "nose",
    "neck",
    "root_of_tail",
    "left_shoulder",
    "left_elbow",
    "left_front_paw",
    "right_shoulder",
    "right_elbow",
    "right_front_paw",
    "left_hip",
    "left_knee",
    "left_back_paw",
    "right_hip",
    "right_knee",
    "right_back_paw",
]


@pytest.mark.parametrize(
    ("species", "names"),
    [
        ("human", DLC_HUMAN),
        ("human", BODY_25),
        ("human", BODY_25B),
        ("dog", SUPERANIMAL),
        ("dog", AP_10K),
        ("cheetah", [n for n in AP_10K if n != "neck"]),
    ],
)
def test_every_name_of_the_usual_detectors_is_one_marker(species: str, names: list[str]) -> None:
    matched = load_skeleton(species).match_keypoints(names)
    assert list(matched) == names
    assert len(set(matched.values())) == len(names)


def test_sides_of_the_14_joint_human() -> None:
    matched = load_skeleton("human").match_keypoints(DLC_HUMAN)
    assert {matched[n][:2] for n in DLC_HUMAN if n.endswith("1")} == {"r_"}
    assert {matched[n][:2] for n in DLC_HUMAN if n.endswith("2")} == {"l_"}


def test_keypoints_are_matched_and_the_rest_is_named(tmp_path: Path) -> None:
    match = match_keypoints(load_skeleton("human"), _table(tmp_path, [*DLC_HUMAN, "Noze"]))
    assert match.matched["forehead"] == "head_top"
    messages = [f.message for f in match.findings]
    assert any("'Noze' is no marker; did you mean 'nose'" in m for m in messages)
    assert any(m.startswith("Markers without a keypoint: nose") for m in messages)
    assert any("'l_foot.point'" in m for m in messages)
    assert any("head.yaw, head.pitch, head.roll apart" in m for m in messages)
    assert {f.severity for f in match.findings} == {"warning"}


def test_keypoints_that_clash_or_do_not_fit(tmp_path: Path) -> None:
    clash = check_skeleton("human", _table(tmp_path, ["nose", "RKnee", "right_knee"]))
    assert clash[0].severity == "error"
    assert "all mean marker 'r_knee'" in clash[0].message
    none = check_skeleton("human", _table(tmp_path, ["lure"]))
    assert "None of the 1 keypoints" in none[0].message
    with pytest.raises(InputError):
        check_skeleton("human", tmp_path / "none.csv")
