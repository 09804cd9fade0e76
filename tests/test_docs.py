"""README and docs do what they say: every command and Python snippet runs, in order.

The two set-up commands install, which a test must not do; ``.ci/run`` does it, and here only what follows
``&&`` runs, in this process (that the script starts as a program is a matter of test_run_cli). The first of
them draws figures; later runs do without, and comparisons of a whole recording take a part, to save time.
``docs/new_species.md``, ``match_tracks.md``, ``moving_cameras.md`` and ``lidar.md`` have tests of their own,
test_…_tutorial.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from test_new_species_tutorial import blocks, execute
from typer.main import get_command

from acino_fte.cli import app
from acino_fte.data_tools.calibration import read_cameras
from acino_fte.data_tools.load import load_sequence
from acino_fte.losses import DEFAULTS
from acino_fte.parameters import FAMILIES
from acino_fte.plots import FIGURES
from acino_fte.result_files import FILES

REPOSITORY = Path(__file__).resolve().parent.parent
EXAMPLE = REPOSITORY / "examples" / "cheetah_gallop"
BIRDS = REPOSITORY / "examples" / "bird_tracks"
WAND = REPOSITORY / "examples" / "wand_rig"
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
SET_UP = [
    "pip install . && python scripts/run_fte.py examples/cheetah_gallop",
    'pip install ".[test]" && pytest',
]
_NOT_HERE = {  # have tests of their own
    *("new_species.md", "match_tracks.md", "moving_cameras.md", "lidar.md", "rig.md", "rig_check.md"),
}
_NO_FIGURES = ("acino-fte run ", "acino-fte match ", "acino-fte scene ")
_KINDS = {"bash", "python", "yaml", "text"}
_OTHERS = {"--check", "--help"}  # of ruff, of every command
_NAMED = re.compile(r"# (?P<file>\S+\.yaml)\n")


def page_id(page: Path) -> str:
    return page.name


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with what the pages take to be there: the examples, and recordings of a user's own."""
    for example in (EXAMPLE, BIRDS, WAND):
        shutil.copytree(example, tmp_path / "examples" / example.name)
    make_acinoset(tmp_path / "2019_03_09")
    recording = tmp_path / "my_recording"
    shutil.copytree(EXAMPLE / "dlc", recording / "dlc")
    shutil.copy(EXAMPLE / "cameras.json", recording)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def make_acinoset(date: Path) -> None:
    """The example's detections and cameras in AcinoSet's layout."""
    run = date / "lily" / "run1"
    (run / "dlc").mkdir(parents=True)
    for path in (EXAMPLE / "dlc").glob("*.csv"):
        shutil.copy(path, run / "dlc" / f"{path.stem}DLC_resnet50.csv")
    cameras = read_cameras(EXAMPLE / "cameras.json")
    scene = {
        "camera_resolution": list(cameras[0].resolution),
        "cameras": [
            {
                "k": camera.matrix.tolist(),
                "d": camera.distortion.reshape(-1, 1).tolist(),
                "r": camera.rotation.tolist(),
                "t": camera.translation.reshape(-1, 1).tolist(),
            }
            for camera in cameras
        ],
    }
    (date / "extrinsic_calib").mkdir()
    (date / "extrinsic_calib" / f"{len(cameras)}_cam_scene_sba.json").write_text(json.dumps(scene))


def follow(page: Path, folder: Path) -> None:
    """Carry out a page: write named YAML files, run commands, run Python in one namespace."""
    names: dict[str, object] = {"__name__": "docs"}
    for language, text in blocks(page.read_text(encoding="utf-8")):
        if language == "yaml" and (match := _NAMED.match(text)):
            (folder / match["file"]).write_text(text, encoding="utf-8")
        elif language == "bash":
            for line in filter(str.strip, text.splitlines()):
                if line == SET_UP[1]:
                    continue  # this is it
                if line == SET_UP[0]:
                    line = line.partition("&& ")[2].replace("python scripts/run_fte.py", "acino-fte run")
                elif line.startswith(_NO_FIGURES):
                    line += " --no-figures"
                elif line.startswith("acino-fte compare ") and "--frames" not in line:
                    line += " --frames 40:52"
                execute(line, folder)
        elif language == "python":
            exec(compile(text, f"{page.name}: {text.splitlines()[0]}", "exec"), names)


@pytest.mark.parametrize("page", [p for p in PAGES if p.name not in _NOT_HERE], ids=page_id)
def test_a_page_runs_from_top_to_bottom(page: Path, folder: Path) -> None:
    follow(page, folder)
    if page.name == "README.md":
        result = folder / "out" / "cheetah_gallop"
        assert set(FILES) - {"depth.csv"} == {path.name for path in result.iterdir()}
        drawn = {f"{name}.{kind}" for name in set(FIGURES) - {"depth", "ladder"} for kind in ("png", "pdf")}
        assert drawn == {path.name for path in (result / "figures").iterdir()}
        metrics = json.loads((result / "metrics.json").read_text())
        assert metrics["status"] == "converged"
        assert metrics["truth_mm"]["mpjpe"] <= 4.0
        assert metrics["joints_outside_limits"] == []


def test_the_two_set_up_commands_are_the_only_ones() -> None:
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    lines = [line for _, block in blocks(text) for line in block.splitlines()]
    assert [line for line in lines if re.search(r"\b(pip|conda|apt|brew|uv)\b", line)] == SET_UP


@pytest.mark.parametrize("page", [*PAGES, REPOSITORY / "CHANGELOG.md"], ids=page_id)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if not target.startswith(("http:", "https:", "#")):
            assert (page.parent / target.partition("#")[0]).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_every_block_says_what_it_is(page: Path) -> None:
    kinds = [kind for kind, _ in blocks(page.read_text(encoding="utf-8"))]
    assert set(kinds) <= _KINDS, kinds


def test_the_readme_lists_what_a_result_folder_holds() -> None:
    for page in (REPOSITORY / "README.md", REPOSITORY / "docs" / "sequence_format.md"):
        text = page.read_text(encoding="utf-8")
        for name in FILES:
            assert f"`{name}`" in text or f"`{name}/`" in text, f"{page.name} does not mention {name}"


def test_the_theory_names_every_loss() -> None:
    text = (REPOSITORY / "docs" / "theory.md").read_text(encoding="utf-8")
    assert [name for name in DEFAULTS if name != "redescending" and f"`{name}`" not in text] == []


def test_the_theory_names_every_family_of_parameters() -> None:
    text = (REPOSITORY / "docs" / "theory.md").read_text(encoding="utf-8")
    assert [name for name in FAMILIES if f"| `{name}` |" not in text] == []


@pytest.mark.parametrize("page", [*PAGES, REPOSITORY / "CHANGELOG.md"], ids=page_id)
def test_options_exist(page: Path) -> None:
    known, commands = set(_OTHERS), [get_command(app)]
    while commands:
        command = commands.pop()
        commands += getattr(command, "commands", {}).values()
        for parameter in command.params:
            known.update(parameter.opts, parameter.secondary_opts)
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", page.read_text(encoding="utf-8")))
    assert named - known == set()


def test_the_equations_of_the_theory_are_numbered_in_order() -> None:
    text = (REPOSITORY / "docs" / "theory.md").read_text(encoding="utf-8")
    numbers = [int(n) for n in re.findall(r"\\tag\{(\d+)\}", text)]
    assert numbers == list(range(1, len(numbers) + 1))


def test_pictures_are_small_and_are_used() -> None:
    pictures = list((REPOSITORY / "docs" / "images").iterdir())
    assert pictures
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for picture in pictures:
        assert picture.stat().st_size <= 300_000
        assert picture.name in text


def test_a_folder_of_acinoset_reads_as_its_example(folder: Path) -> None:
    """The stand-in for a user's recording is one: the same detections, by another way."""
    ours = load_sequence(EXAMPLE)
    theirs = load_sequence(folder / "2019_03_09" / "lily" / "run1", species="cheetah", fps=120)
    assert ours.detections.equals(theirs.detections)
