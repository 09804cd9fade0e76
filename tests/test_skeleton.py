"""Species files: what they mean, and what is said when one is wrong."""

from __future__ import annotations

import math
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from acino_fte import models
from acino_fte.errors import InputError
from acino_fte.skeleton import DEFAULT_NOISE, Skeleton, deformed, expand, load_skeleton
from acino_fte.species_file import FORMAT, SpeciesFile, json_schema, read_species_file

SMALL: dict[str, Any] = {
    "format": FORMAT,
    "name": "small",
    "links": {
        "trunk": {
            "parent": "world",
            "dofs": {"x": {"slide": "x"}, "yaw": {"turn": "z"}, "pitch": {"turn": "y", "range": [-60, 30]}},
        },
        "l_leg": {
            "parent": "trunk",
            "at": [0.1, 0.2, -0.3],
            "mirror": "r_leg",
            "dofs": {
                "swing": {"turn": "y", "range": [-40, 50], "noise": 100, "mirror_noise": 300},
                "splay": {"turn": "x", "range": [-10, 20]},
                "twist": {"turn": "z"},
                "out": {"slide": "y"},
                "down": {"slide": "z"},
            },
        },
        "l_foot": {"parent": "l_leg", "at": [0, 0, -0.5], "mirror": "r_foot"},
    },
    "markers": {
        "nose": {"link": "trunk", "at": [0.4, 0, 0]},
        "l_toe": {
            "link": "l_foot",
            "at": [0.1, 0.01, 0],
            "sd_px": 2,
            "aliases": ["LeftToe"],
            "mirror": "r_toe",
            "mirror_sd_px": 4,
            "mirror_aliases": ["RightToe"],
        },
    },
    "draw": [["nose", "l_toe"], ["l_toe", "r_toe"]],
    "body": [{"between": ["nose", "l_toe"], "radius": 0.05}],
}


def small(**changes: Any) -> dict[str, Any]:
    """The small species with changes at dotted keys (``links__trunk__parent="x"``); None removes."""
    data = deepcopy(SMALL)
    for key, value in changes.items():
        *way, last = key.split("__")
        holder = data
        for part in way:
            holder = holder[part]
        if value is None:
            del holder[last]
        else:
            holder[last] = value
    return data


def build(**changes: Any) -> Skeleton:
    return expand(SpeciesFile.model_validate(small(**changes)))


def write(folder: Path, data: Any, name: str = "small.yaml") -> Path:
    path = folder / name
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data, sort_keys=False))
    return path


# --- what a file means ---


def test_units_become_metres_and_radians() -> None:
    metres = build()
    millimetres = small(units={"length": "mm", "angle": "rad"})
    millimetres["links"]["l_leg"]["at"] = [100, 200, -300]
    millimetres["links"]["l_leg"]["dofs"]["swing"]["range"] = [math.radians(-40), math.radians(50)]
    other = expand(SpeciesFile.model_validate(millimetres))
    assert other.links[1].at == pytest.approx(metres.links[1].at)
    swing = metres.dof("l_leg.swing")
    assert metres.dofs[swing].lower == pytest.approx(math.radians(-40))
    assert other.dofs[swing].lower == pytest.approx(metres.dofs[swing].lower)
    assert metres.dofs[swing].noise == pytest.approx(math.radians(100))
    assert metres.dofs[swing].unit == "rad"


def test_free_and_default_values() -> None:
    dof = build().dofs[0]
    assert (dof.lower, dof.upper, dof.middle) == (-math.inf, math.inf, 0.0)
    assert dof.noise == DEFAULT_NOISE["slide"]
    assert build().dofs[1].noise == DEFAULT_NOISE["turn"]
    assert build().dofs[2].middle == pytest.approx(math.radians(-15))


def test_a_twin_turns_and_slides_the_other_way_where_that_mirrors() -> None:
    skeleton = build()
    signs = {"swing": 1, "splay": -1, "twist": -1, "out": -1, "down": 1}
    for name, sign in signs.items():
        left, right = (skeleton.dofs[skeleton.dof(f"{side}_leg.{name}")] for side in "lr")
        assert right.axis == tuple(sign * v if v else 0.0 for v in left.axis)
        assert (right.lower, right.upper, right.kind) == (left.lower, left.upper, left.kind)


def test_a_twin_has_its_own_noise_and_names() -> None:
    skeleton = build()
    assert skeleton.dofs[skeleton.dof("r_leg.swing")].noise == pytest.approx(math.radians(300))
    assert (
        skeleton.dofs[skeleton.dof("r_leg.splay")].noise == skeleton.dofs[skeleton.dof("l_leg.splay")].noise
    )
    toe = skeleton.markers[skeleton.marker("r_toe")]
    assert (toe.sd_px, toe.aliases, toe.at) == (4, ("RightToe",), (0.1, -0.01, 0))
    assert skeleton.links[toe.link].name == "r_foot"
    assert skeleton.links[skeleton.links[toe.link].parent].name == "r_leg"
    assert skeleton.twins == (("l_toe", "r_toe"),)


def test_lines_and_body_are_mirrored_once() -> None:
    skeleton = build()
    names = skeleton.marker_names
    assert [(names[a], names[b]) for a, b in skeleton.edges] == [
        ("nose", "l_toe"),
        ("nose", "r_toe"),
        ("l_toe", "r_toe"),
    ]
    assert [(names[a], names[b], r) for a, b, r in skeleton.capsules] == [
        ("nose", "l_toe", 0.05),
        ("nose", "r_toe", 0.05),
    ]


def test_a_link_may_hang_on_a_twin() -> None:
    data = small()
    data["links"]["patch"] = {"parent": "r_foot", "dofs": {"a": {"turn": "y"}}}
    data["markers"]["scar"] = {"link": "patch", "at": [0, 0, -0.1]}
    skeleton = expand(SpeciesFile.model_validate(data))
    names = [skeleton.dof_names[j] for j in skeleton.ancestors(skeleton.markers[-1].link)]
    assert names == [*(f"trunk.{d}" for d in ("x", "yaw", "pitch")), *SMALL_RIGHT, "patch.a"]


SMALL_RIGHT = [f"r_leg.{d}" for d in ("swing", "splay", "twist", "out", "down")]


def test_links_may_be_declared_in_any_order() -> None:
    data = small()
    data["links"] = dict(reversed(data["links"].items()))
    skeleton = expand(SpeciesFile.model_validate(data))
    assert all(link.parent < i for i, link in enumerate(skeleton.links))


def test_order_of_the_state() -> None:
    names = build().dof_names
    assert names[:4] == ["trunk.x", "trunk.yaw", "trunk.pitch", "l_leg.swing"]
    skeleton = build(order=names[::-1])
    assert skeleton.dof_names == names[::-1]
    assert skeleton.links[0].dofs == tuple(skeleton.dof(f"trunk.{d}") for d in ("x", "yaw", "pitch"))


def test_keypoint_names_match_by_name_and_alias() -> None:
    matched = build().match_keypoints(["Nose", "left toe", "RIGHTTOE", "l-toe", "tail"])
    assert matched == {"Nose": "nose", "left toe": "l_toe", "RIGHTTOE": "r_toe", "l-toe": "l_toe"}


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(InputError, match="no marker 'l_tow'; did you mean 'l_toe'"):
        build().marker("l_tow")
    with pytest.raises(InputError, match=r"no degree of freedom 'trunk.jaw'; did you mean 'trunk.yaw'"):
        build().dof("trunk.jaw")


def test_the_content_hash_follows_the_geometry_only() -> None:
    assert build().content_hash == build(name="other", markers__nose__sd_px=9).content_hash
    assert build().content_hash != build(markers__nose__at=[0.41, 0, 0]).content_hash


def standing(skeleton: Skeleton) -> np.ndarray:
    """(M, 3) marker positions at zero, m: every frame is turned alike there."""
    origins: list[np.ndarray] = []
    for link in skeleton.links:
        origins.append(np.array(link.at) + (origins[link.parent] if link.parent >= 0 else 0.0))
    return np.array([origins[m.link] + np.array(m.at) for m in skeleton.markers])


def group_of(skeleton: Skeleton) -> dict[str, str | None]:
    """Segment group of each link."""
    return {link.name: skeleton.groups[link.group] if link.group >= 0 else None for link in skeleton.links}


def test_a_link_makes_a_group_of_its_own_and_its_twin_shares_it() -> None:
    skeleton = build()
    assert skeleton.groups == ("trunk", "l_leg", "l_foot")
    sides = {"l_leg": "l_leg", "r_leg": "l_leg", "l_foot": "l_foot", "r_foot": "l_foot"}
    assert group_of(skeleton) == {"trunk": "trunk", **sides}


def test_a_declared_group_holds_twins_too() -> None:
    for named in (["l_leg", "l_foot"], ["r_leg", "l_foot", "r_foot"]):
        skeleton = build(groups={"limbs": named})
        assert skeleton.groups == ("trunk", "limbs")
        assert set(group_of(skeleton).values()) == {"trunk", "limbs"}
    assert build(groups={"l_leg": ["l_leg", "l_foot"]}).groups == ("trunk", "l_leg")


def test_a_link_that_nothing_is_attached_to_has_no_group() -> None:
    skeleton = build(markers__l_toe__at=[0, 0, 0], markers__nose__at=[0, 0, 0], links__l_leg__at=[0, 0, 0])
    assert skeleton.groups == ("l_leg",)
    assert group_of(skeleton)["trunk"] is None
    assert group_of(skeleton)["r_foot"] is None


def test_another_individual_has_other_lengths() -> None:
    skeleton = build(groups={"limbs": ["l_leg", "l_foot"]})
    longer = deformed(skeleton, {"limbs": 1.2}, {"nose": [0.01, 0, -0.02]})
    at = {link.name: link.at for link in longer.links}
    assert at["l_leg"] == (0.1, 0.2, -0.3)  # on the trunk
    assert at["l_foot"] == at["r_foot"] == pytest.approx((0, 0, -0.6))
    assert longer.markers[longer.marker("r_toe")].at == pytest.approx((0.12, -0.012, 0))
    assert longer.markers[longer.marker("nose")].at == pytest.approx((0.41, 0, -0.02))
    assert longer.content_hash != skeleton.content_hash
    assert deformed(skeleton, {"limbs": 1.0}) == skeleton
    feet = [standing(s)[s.marker("l_toe")] for s in (skeleton, longer)]
    np.testing.assert_allclose(feet, [[0.2, 0.21, -0.8], [0.22, 0.212, -0.9]], atol=1e-12)


def test_another_individual_of_names_that_do_not_exist() -> None:
    with pytest.raises(InputError, match="no segment group 'trunc'; did you mean 'trunk'"):
        deformed(build(), {"trunc": 1.1})
    with pytest.raises(InputError, match="no marker 'nosy'; did you mean 'nose'"):
        deformed(build(), offsets={"nosy": [0, 0, 0]})


def test_contacts_come_with_their_twins() -> None:
    assert build().contacts == ()
    for named in (["l_toe"], ["r_toe"], ["r_toe", "l_toe"]):
        skeleton = build(contacts=named)
        assert [skeleton.marker_names[i] for i in skeleton.contacts] == ["l_toe", "r_toe"]
    assert build(contacts=["l_toe"]).content_hash == build().content_hash


# --- what is said when a file contradicts itself ---

FAULTS = [
    ({"links__l_leg__parent": "trunc"}, "links.l_leg.parent", "hangs on 'trunc'.*did you mean 'trunk'"),
    ({"links__trunk__parent": "l_foot"}, "links.trunk", "form a loop"),
    ({"links__l_leg__parent": "l_leg"}, "links.l_leg", "form a loop"),
    ({"links__l_leg__mirror": "trunk"}, "links.l_leg.mirror", "Two links would be called 'trunk'"),
    ({"links__l_foot__mirror": "r_leg"}, "links.l_foot.mirror", "Two links would be called 'r_leg'"),
    ({"links__l_leg__mirror": "l_leg"}, "links.l_leg.mirror", "Two links would be called 'l_leg'"),
    ({"markers__l_toe__mirror": "nose"}, "markers.l_toe.mirror", "Two markers would be called 'nose'"),
    ({"markers__nose__link": "trunkk"}, "markers.nose.link", "sits on link 'trunkk'.*did you mean 'trunk'"),
    ({"draw": [["nose", "l_tow"]]}, r"draw[0]", "'l_tow' is no marker; did you mean 'l_toe'"),
    ({"draw": [["nose", "nose"]]}, r"draw[0]", "'nose' is paired with itself"),
    ({"body": [{"between": ["nos", "l_toe"], "radius": 1}]}, r"body[0].between", "'nos' is no marker"),
    ({"groups": {"legs": ["l_legg"]}}, "groups.legs", "'l_legg' is no link; did you mean 'l_leg'"),
    ({"groups": {"a": ["l_leg"], "b": ["l_leg"]}}, "groups.b", "'l_leg' is in the groups 'a' and 'b'"),
    ({"groups": {"a": ["l_leg"], "b": ["r_leg"]}}, "groups.b", "'r_leg' is in the groups 'a' and 'b'"),
    ({"groups": {"trunk": ["l_leg"]}}, "groups.trunk", "named like a link that is not in it"),
    ({"groups": {"r_foot": ["l_leg"]}}, "groups.r_foot", "named like a link that is not in it"),
    ({"contacts": ["l_toe", "l_tow"]}, "contacts", "'l_tow' is no marker; did you mean 'l_toe'"),
    ({"order": ["trunk.x"]}, "order", "must name every degree of freedom once"),
    ({"order": ["trunk.zaw"]}, "order", "names 'trunk.zaw'.*did you mean 'trunk.yaw'"),
    ({"order": ["trunk.x", "trunk.x"]}, "order", "names 'trunk.x' twice"),
    ({"markers__nose__aliases": ["left_toe"]}, "markers.l_toe.aliases", "means both marker"),
    ({"markers__nose__aliases": ["R Toe"]}, "markers.nose.aliases", "means both marker"),
]


@pytest.mark.parametrize(("changes", "key", "message"), FAULTS)
def test_contradictions_are_named(changes: dict[str, Any], key: str, message: str, tmp_path: Path) -> None:
    path = write(tmp_path, small(**changes))
    with pytest.raises(InputError, match=message) as caught:
        load_skeleton(path)
    assert caught.value.key == key
    assert caught.value.file == str(path)
    assert caught.value.remedy


def test_the_first_fault_tells_how_many_more_there_are(tmp_path: Path) -> None:
    path = write(tmp_path, small(markers__nose__link="trunkk", draw=[["a", "b"]]))
    with pytest.raises(InputError, match="skeleton check .*small.yaml' lists this fault and 2 more"):
        load_skeleton(path)


# --- what is said when a file does not follow the schema ---

SCHEMA_FAULTS = [
    ({"links__trunk__dof": {}}, "links.trunk.dof", "unknown key 'dof'; did you mean 'dofs'"),
    ({"links__trunk__dofs__yaw__rang": [0, 1]}, "links.trunk.dofs.yaw.rang", "did you mean 'range'"),
    ({"markers__nose__sdpx": 3}, "markers.nose.sdpx", "did you mean 'sd_px'"),
    ({"unit": {}}, "unit", "did you mean 'units'.*known: .*noise_fps"),
    ({"body": [{"between": ["a", "b"], "radious": 1, "radius": 1}]}, "body.0.radious", "mean 'radius'"),
    ({"links__trunk__parent": None}, "links.trunk.parent", "this key is missing"),
    ({"name": "my dog"}, "name", "'my dog' is no name"),
    ({"links__2leg": {"parent": "trunk"}}, "links.2leg", "'2leg' is no name"),
    ({"links__world": {"parent": "trunk"}}, "links", "'world' is the fixed frame"),
    ({"links__trunk__dofs__yaw": {"turn": "z", "slide": "x"}}, "links.trunk.dofs.yaw", "exactly one of"),
    ({"links__trunk__dofs__yaw": {}}, "links.trunk.dofs.yaw", "exactly one of"),
    ({"links__trunk__dofs__yaw": {"turn": "w"}}, "links.trunk.dofs.yaw.turn", "'x', 'y' or 'z', found 'w'"),
    ({"links__trunk__dofs__yaw__range": [30, -30]}, "links.trunk.dofs.yaw", "must rise"),
    ({"links__trunk__dofs__yaw__range": [30]}, "links.trunk.dofs.yaw.range", "at least 2 items"),
    ({"links__trunk__dofs__yaw__noise": 0}, "links.trunk.dofs.yaw.noise", "greater than 0, found 0"),
    ({"links__trunk__at": [0, "far", 0]}, "links.trunk.at.1", "valid number.*found 'far'"),
    ({"links__trunk__at": [0, float("nan"), 0]}, "links.trunk.at.1", "finite number"),
    ({"units": {"length": "inch"}}, "units.length", "'m', 'cm' or 'mm', found 'inch'"),
    ({"links": {}}, "links", "at least 1 item"),
    ({"draw": [["nose"]]}, "draw.0", "at least 2 items"),
    ({"groups": {"legs": []}}, "groups.legs", "at least 1 item"),
    ({"contact": ["nose"]}, "contact", "did you mean 'contacts'"),
]


@pytest.mark.parametrize(("changes", "key", "message"), SCHEMA_FAULTS)
def test_departures_from_the_schema_are_named(
    changes: dict[str, Any], key: str, message: str, tmp_path: Path
) -> None:
    path = write(tmp_path, small(**changes))
    with pytest.raises(InputError, match=message) as caught:
        read_species_file(path)
    assert caught.value.key == key
    assert "acino-fte skeleton" in str(caught.value.remedy)


FILE_FAULTS = [
    ("", "holds no mapping", "nothing"),
    ("- a\n- b\n", "holds no mapping", "list"),
    ("name: dog\n", "not a species file of a format", "None"),
    ("format: acino-fte/skeleton/9\n", "not a species file of a format", "skeleton/9"),
    ("format: [\n", "not valid YAML", ""),
    ("a: 1\na: 2\n", "not valid YAML", "key 'a' is given twice"),
    ("? [a]\n: 1\n", "not valid YAML", "plain word"),
    ("a: !!python/object/apply:os.system [ls]\n", "not valid YAML", "constructor"),
    ("a: " + "[" * 3000, "not valid YAML", ""),
]


@pytest.mark.parametrize(("text", "message", "found"), FILE_FAULTS)
def test_files_that_are_no_species_files(text: str, message: str, found: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message) as caught:
        load_skeleton(write(tmp_path, text))
    assert found in str(caught.value.found)


def test_names_that_yaml_reads_as_something_else(tmp_path: Path) -> None:
    text = yaml.safe_dump(small(), sort_keys=False).replace("trunk:\n    parent", "on:\n    parent")
    with pytest.raises(InputError, match="put it in quotes"):
        load_skeleton(write(tmp_path, text))


def test_missing_files_and_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        load_skeleton(tmp_path / "none.yaml")
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(InputError, match="this is a folder"):
        load_skeleton(tmp_path / "folder.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not text"):
        load_skeleton(tmp_path / "binary.yaml")


def test_unknown_species_suggest_the_nearest() -> None:
    with pytest.raises(InputError, match="no species 'chetah'; did you mean 'cheetah'") as caught:
        load_skeleton("chetah")
    assert "skeleton list" in str(caught.value.remedy)


def test_a_bundled_name_wins_over_a_file_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path, small(), "dog")
    assert load_skeleton("dog").name == "dog"
    write(tmp_path, small(), "mine")
    assert load_skeleton("mine").name == "small"
    assert load_skeleton(Path("dog")).name == "dog"
    assert load_skeleton("./dog").name == "small"


# --- the schema, and the bundled files ---


def test_json_schema_accepts_what_the_reader_accepts() -> None:
    schema = json_schema()
    assert schema["$schema"].startswith("https://json-schema.org/")
    assert schema["required"] == ["format", "name", "links", "markers"]
    assert schema["additionalProperties"] is False
    assert set(schema["properties"]) == set(SpeciesFile.model_fields)


@pytest.mark.parametrize("name", models.species_names())
def test_bundled_files_are_complete(name: str) -> None:
    skeleton = load_skeleton(name)
    assert skeleton.name == name
    assert skeleton.source
    assert skeleton.path is not None
    assert max(map(len, skeleton.path.read_text().splitlines())) <= 112
    file = read_species_file(skeleton.path)
    assert all(dof.noise for link in file.links.values() for dof in link.dofs.values())
    assert (file.units.length, file.units.angle) == ("m", "deg")
    assert len(skeleton.twins) >= 9
    assert len(skeleton.groups) < len(skeleton.links)
    contacts = {skeleton.marker_names[i] for i in skeleton.contacts}
    assert contacts and all(m.endswith(("paw", "heel", "toe")) for m in contacts)
    assert skeleton.marker_names[int(np.argmin(standing(skeleton)[:, 2]))] in contacts
