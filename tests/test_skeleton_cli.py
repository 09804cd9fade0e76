"""The command ``acino-fte skeleton`` as its user meets it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import acino_fte
from acino_fte import models
from acino_fte.cli_skeleton import app
from acino_fte.skeleton import load_skeleton
from acino_fte.skeleton_check import check_skeleton
from acino_fte.skeleton_draw import draw_skeleton, middle_pose, neutral_pose, sides


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(arguments))
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def test_list_has_every_species() -> None:
    code, output = run("list")
    assert code == 0
    for name in models.species_names():
        skeleton = load_skeleton(name)
        (row,) = [line.split() for line in output.splitlines() if line.split()[:1] == [name]]
        assert row[1:3] == [str(len(skeleton.dofs)), str(len(skeleton.markers))]


@pytest.mark.parametrize("name", models.species_names())
def test_show_prints_every_link_dof_and_marker(name: str) -> None:
    code, output = run("show", name, "--no-picture")
    assert code == 0
    skeleton = load_skeleton(name)
    for dof in skeleton.dofs:
        assert f" {dof.name.split('.')[1]}: {dof.kind} " in output
    for marker in skeleton.markers:
        assert f"marker {marker.name}, sd {marker.sd_px:g} px" in output
    assert list(Path().iterdir()) == []


def test_show_gives_ranges_in_degrees_and_noise_in_its_unit() -> None:
    _, output = run("show", "cheetah", "--no-picture")
    assert "pitch: turn y, -30° to 30°, noise 516°/s²" in output
    assert "x: slide x, free, noise 4 m/s²" in output
    assert "roll: turn -x" not in output
    _, output = run("show", "dog", "--no-picture")
    assert "abduct: turn -x, -20° to 35°" in output  # the mirrored twin


@pytest.mark.parametrize(("name", "start"), [("a.png", b"\x89PNG"), ("b.pdf", b"%PDF"), ("c.svg", b"<?xml")])
def test_show_writes_a_picture(name: str, start: bytes) -> None:
    assert run("show", "dog", "-o", f"folder/{name}")[0] == 0
    assert Path("folder", name).read_bytes().startswith(start)


def test_show_names_its_picture_and_refuses_other_formats() -> None:
    code, output = run("show", "human", "--pose", "middle")
    assert code == 0
    assert "picture: human_skeleton.png" in output
    assert Path("human_skeleton.png").stat().st_size > 20_000
    code, output = run("show", "human", "-o", "human.docx")
    assert code == 2
    assert ".png, .pdf, .svg" in output


@pytest.mark.parametrize("name", models.species_names())
def test_pictures_name_every_marker_of_the_left_and_middle_and_lose_none(name: str) -> None:
    skeleton = load_skeleton(name)
    figure = draw_skeleton(skeleton, middle_pose(skeleton))
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert sorted(texts) == sorted(skeleton.marker_names)
    for axes in figure.axes[:2]:
        for text in axes.texts:
            (x0, x1), (y0, y1) = sorted(axes.get_xlim()), axes.get_ylim()
            x, y = text.get_position()
            assert x0 <= x <= x1
            assert y0 <= y <= y1


def test_neutral_pose_is_zero_where_the_range_allows() -> None:
    skeleton = load_skeleton("dog")
    pose = dict(zip(skeleton.dof_names, neutral_pose(skeleton), strict=True))
    assert pose["torso.pitch"] == 0
    elbow = skeleton.dofs[skeleton.dof("l_forearm.elbow")]
    assert pose["l_forearm.elbow"] == elbow.upper < 0


def test_sides_come_from_twins() -> None:
    import numpy as np

    skeleton = load_skeleton("cheetah")
    side = dict(zip(skeleton.marker_names, sides(skeleton, np.zeros((24, 3))), strict=True))
    assert (side["l_eye"], side["r_hip"], side["nose"]) == ("left", "right", "middle")


def test_check_of_a_sound_species() -> None:
    code, output = run("check", "cheetah")
    assert code == 0
    assert "cheetah: sound (29 degrees of freedom, 24 markers)" in output


def test_check_of_a_faulty_file_lists_all_faults_and_leaves_with_2() -> None:
    run("new", "fox")
    text = Path("fox.yaml").read_text()
    Path("fox.yaml").write_text(
        text.replace("parent: rump", "parent: rumpp").replace("link: head", "link: haed")
    )
    code, output = run("check", "fox.yaml")
    assert code == 2
    assert "did you mean 'rump'?" in output
    assert "did you mean 'head'?" in output
    assert "fox.yaml: 4 errors" in output


def test_warnings_leave_with_0() -> None:
    run("new", "fox")
    text = Path("fox.yaml").read_text()
    Path("fox.yaml").write_text(text.replace("  - [l_ankle, l_back_paw]\n", ""))
    code, output = run("check", "fox.yaml")
    assert code == 0
    assert "No line leads to l_back_paw, r_back_paw" in output
    assert "fox.yaml: 1 warning (" in output


def test_check_against_keypoints() -> None:
    import numpy as np

    from acino_fte.data_tools.deeplabcut import write_deeplabcut_csv

    names = ["nose", "left_eye", "lure"]
    write_deeplabcut_csv(Path("k.csv"), names, np.ones((2, 3, 2)), np.ones((2, 3)))
    code, output = run("check", "dog", "--keypoints", "k.csv")
    assert code == 0
    assert "keypoint left_eye is marker l_eye" in output
    assert "Keypoint 'lure' is no marker" in output
    code, output = run("check", "dog", "--keypoints", "none.csv")
    assert code == 2
    assert "none.csv" in output


@pytest.mark.parametrize("like", [None, *models.species_names()])
def test_new_files_are_sound(like: str | None) -> None:
    assert run("new", "my_fox2", *(["--like", like] if like else []))[0] == 0
    skeleton = load_skeleton("my_fox2.yaml")
    assert skeleton.name == "my_fox2"
    assert check_skeleton("my_fox2.yaml") == []
    text = Path("my_fox2.yaml").read_text()
    assert text.count("#") > 5
    if like:
        assert f"copy of '{like}'" in text
        assert skeleton.content_hash == load_skeleton(like).content_hash


def test_new_never_overwrites() -> None:
    Path("fox.yaml").write_text("precious")
    code, output = run("new", "fox")
    assert code == 2
    assert "left as it is" in output
    assert Path("fox.yaml").read_text() == "precious"
    assert run("new", "fox", "-o", "sub/other.yaml")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["new", "2fox"], "cannot be the name of a species"),
        (["new", "my fox"], "cannot be the name of a species"),
        (["new", "fox", "--like", "dgo"], "did you mean 'dog'?"),
        (["check", "dgo"], "did you mean 'dog'?"),
        (["show", "dgo"], "did you mean 'dog'?"),
        (["check", "none.yaml"], "does not exist"),
        (["show", "none.yaml"], "does not exist"),
        (["schema", "-o", "."], "cannot be written"),
        (["show", "dog", "--pose", "sitting"], "neutral"),
        (["shwo"], "No such command"),
    ],
)
def test_wrong_arguments_leave_with_2_and_a_message(arguments: list[str], message: str) -> None:
    code, output = run(*arguments)
    assert code == 2
    assert message in output
    assert "Traceback" not in output
    assert list(Path().iterdir()) == []


def test_schema_to_the_terminal_and_to_a_file() -> None:
    code, output = run("schema")
    assert code == 0
    schema = json.loads(output)
    assert schema["title"] == "SpeciesFile"
    assert run("schema", "-o", "s.json")[0] == 0
    assert json.loads(Path("s.json").read_text()) == schema


def test_the_commands_load_nothing_heavy() -> None:
    code = (
        "import sys; import acino_fte.cli_skeleton; "
        "sys.exit(' '.join(m for m in ('numpy', 'sympy', 'pydantic', 'matplotlib') if m in sys.modules))"
    )
    found = str(Path(acino_fte.__file__).parent.parent)  # works for a checkout as for an installed copy
    environment = {**os.environ, "PYTHONPATH": found}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert result.stderr.strip() == ""
