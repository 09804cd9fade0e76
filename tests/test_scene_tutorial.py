"""docs/moving_cameras.md does what it says: commands, Python and numbers, from top to bottom.

Figures of the command are left out, to save time: test_scene_cli draws them. What the page and
docs/scene_formats.md list (files, columns, keys, options, messages) is held against the program.
"""

from __future__ import annotations

import ast
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_match_tutorial import assert_prints
from test_new_species_tutorial import blocks, execute
from typer.main import get_command

pytest.importorskip("pycolmap")

from acino_fte.cli import app
from acino_fte.data_tools.colmap_cameras import _MODELS
from acino_fte.data_tools.scene_axes import WAYS
from acino_fte.data_tools.scene_files import SCENE
from acino_fte.data_tools.scene_settings import SceneSettings, read_scene_settings
from acino_fte.data_tools.scene_tracks import SOURCES
from acino_fte.projection import COEFFICIENTS

REPOSITORY = Path(__file__).resolve().parent.parent
DOCS = REPOSITORY / "docs"
EXAMPLE = REPOSITORY / "examples" / "wand_rig"
PAGE = (DOCS / "moving_cameras.md").read_text(encoding="utf-8")
FORMATS = (DOCS / "scene_formats.md").read_text(encoding="utf-8")
THEORY = (DOCS / "theory.md").read_text(encoding="utf-8")
PICTURES = ("wand_histogram.png", "wand_scene.png")


def follow(text: str, folder: Path) -> tuple[dict[str, str], dict[str, object]]:
    """Carry out a page: what each command printed, and what Python ended with."""
    printed, names = {}, {"__name__": "docs"}
    for language, block in blocks(text):
        if language == "bash":
            for line in filter(str.strip, block.splitlines()):
                drawing = line.startswith("acino-fte scene ") and "--no-figures" not in line
                printed[line] = execute(f"{line} --no-figures" if drawing else line, folder)
        elif language == "python":
            exec(compile(block, f"moving_cameras.md: {block.splitlines()[0]}", "exec"), names)
    return printed, names


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """The folder after the whole page, what its commands printed, and its Python names."""
    folder = tmp_path_factory.mktemp("moving_cameras")
    shutil.copytree(EXAMPLE, folder / "examples" / EXAMPLE.name)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("MPLBACKEND", "Agg")
        printed, names = follow(PAGE, folder)
    return folder, printed, names


def shown(first_words: str) -> str:
    """The block that shows what a command or snippet prints."""
    return next(text for kind, text in blocks(PAGE) if kind == "text" and text.startswith(first_words))


def errors_of(folder: Path, name: str) -> dict[str, dict]:
    return json.loads((folder / "out" / name / "metrics.json").read_text())["truth_mm"]["tracks"]


def test_the_wand_prints_what_the_page_shows(followed):
    _, printed, _ = followed
    assert_prints(next(iter(printed.values())), shown("3 individuals"))


def test_the_wand_is_as_good_as_the_page_says(followed):
    folder, _, names = followed
    promised = dict(re.findall(r"(\w+\.csv): 469 frames, RMSE ([\d.]+) mm", PAGE))
    for file, what in {"points_3d.csv": "frame by frame", "tracks_3d.csv": "smooth"}.items():
        by_table = names["wand_errors"](folder / "out" / "wand" / file)
        rms = float(np.sqrt((by_table**2).mean()))
        assert rms == pytest.approx(float(promised[file]), abs=0.1)
        # the API gives the file's numbers
        np.testing.assert_allclose(np.sort(by_table), np.sort(names["errors"][what]), atol=2e-3)


def test_the_clocks_are_those_of_the_page(followed):
    _, printed, _ = followed
    late = next(text for line, text in printed.items() if line.startswith("acino-fte scene late"))
    line = next(line for line in late.splitlines() if line.startswith("clocks"))
    assert_prints(line, shown("clocks against").strip())


def test_what_rigs_and_adjusted_poses_are_worth(followed, monkeypatch):
    folder, _, _ = followed
    monkeypatch.chdir(folder)
    truth = "examples/wand_rig/truth_3d.csv"
    execute(f"acino-fte scene examples/wand_rig --rig none --truth {truth} --no-figures -o out/apart", folder)
    rows = dict(re.findall(r"^\| (position|wand) \| ([\d.]+) mm \| [\d.]+ mm \|$", PAGE, re.MULTILINE))
    apart = dict(re.findall(r"^\| (position|wand) \| [\d.]+ mm \| ([\d.]+) mm \|$", PAGE, re.MULTILINE))
    for name, promised in (("wand", rows), ("apart", apart)):
        found = errors_of(folder, name)
        assert found["views"]["rmse"] == pytest.approx(float(promised["position"]), abs=0.15)
        assert found["pair_distance"]["rmse"] == pytest.approx(float(promised["wand"]), abs=0.15)
    adjusted, usual = re.search(r"RMSE .*: ([\d.]+) mm in place of ([\d.]+) mm", PAGE).groups()
    assert errors_of(folder, "adjusted")["views"]["rmse"] == pytest.approx(float(adjusted), abs=0.15)
    assert errors_of(folder, "wand")["views"]["rmse"] == pytest.approx(float(usual), abs=0.15)


def test_several_distances_are_as_sure_as_the_page_says(followed):
    folder, _, _ = followed
    one, three = re.search(
        r"gives the scale to ([\d.]+) %, these three together to ([\d.]+) %", PAGE
    ).groups()
    for name, promised in (("wand", one), ("scales", three)):
        scale = json.loads((folder / "out" / name / "metrics.json").read_text())["scale"]
        assert 100 * scale["sd"] / scale["factor"] == pytest.approx(float(promised), abs=0.004)


def test_the_pictures_are_those_of_the_page(followed):
    from matplotlib.image import imread

    folder, _, _ = followed
    for name in PICTURES:
        made, kept = imread(folder / name), imread(DOCS / "images" / name)
        assert made.shape == kept.shape
        assert np.abs(made - kept).mean() < 0.02, name


def test_every_file_and_column_is_listed(followed):
    folder, _, _ = followed
    for page in (PAGE, FORMATS):
        assert [n for n in SCENE.files if f"`{n}`" not in page and f"`{n}/`" not in page] == []
    assert [source for source in SOURCES if f"`{source}`" not in FORMATS or f"`{source}`" not in PAGE] == []
    for name in ("tracks_3d", "observations", "camera_paths"):
        _, _, section = FORMATS.partition(f"### `{name}.csv`")
        section = section.partition("\n### ")[0]
        columns = pd.read_csv(folder / "out" / "wand" / f"{name}.csv", nrows=1).columns
        assert [column for column in columns if f"`{column}`" not in section] == []


def test_every_number_of_the_metrics_is_explained(followed):
    folder, _, _ = followed
    text = (DOCS / "metrics.md").read_text(encoding="utf-8")
    section = text.partition("# Scenes of moving cameras")[2].partition("\n# ")[0]

    def keys(value: object) -> set[str]:
        if isinstance(value, list):
            return set().union(*map(keys, value))
        if not isinstance(value, dict):
            return set()
        own = {key for key in value if not re.fullmatch(r"cam\d", key)}
        return own.union(*(keys(v) for k, v in value.items() if k not in ("options", "seconds")))

    for name in ("wand", "late"):
        metrics = json.loads((folder / "out" / name / "metrics.json").read_text())
        assert [key for key in sorted(keys(metrics)) if f"`{key}`" not in section] == []


def test_the_scene_file_is_explained_and_can_be_read(tmp_path):
    keys = SceneSettings.__dataclass_fields__
    assert [key for key in keys if f"| `{key}` |" not in FORMATS] == []
    examples = [text for page in (PAGE, FORMATS) for kind, text in blocks(page) if kind == "yaml"]
    assert len(examples) == 2
    for text in examples:
        (tmp_path / "scene.yaml").write_text(text)
        read = read_scene_settings(tmp_path)
        assert read.pattern == "{camera}_{frame}.jpg"
        assert read.scale
    assert read.rig == (("cam0", "cam1", "cam2", "cam3"),)


def test_every_option_is_explained():
    command = get_command(app).commands["scene"]
    options = {name for parameter in command.params for name in parameter.opts if name.startswith("--")}
    usual = {"--out", "--quiet", "--figures", "--smooth"}
    assert [name for name in sorted(options - usual) if f"{name}" not in PAGE + FORMATS] == []
    assert [way for way in WAYS if f"| `{way}`" not in PAGE] == []


def test_every_lens_is_explained():
    assert [name for name in _MODELS if not re.search(rf"\b{name}\b", FORMATS)] == []
    lenses = [f"`{name}`" for name in COEFFICIENTS]
    assert [name for name in lenses if name not in FORMATS] == []
    escaped = THEORY.replace("\\_", "_")
    assert [name for name in COEFFICIENTS if f"{name}:" not in escaped] == []


def program_texts() -> str:
    """All texts in the program, a line each; … stands for what is put in."""
    texts = []
    files = [*(REPOSITORY / "data_tools").glob("*.py"), *(REPOSITORY / "acino_fte").glob("cli*.py")]
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                texts.append(
                    "".join(str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values)
                )
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return "\n".join(" ".join(text.split()) for text in texts)


def test_the_messages_are_those_of_the_program():
    section = PAGE.partition("## When something is wrong")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (.+?) \| .+ \|$", section, re.MULTILINE)
    messages = [row for row in rows if row not in ("warning", "error")]
    assert len(messages) > 40
    known = program_texts()
    assert [message for message in messages if message not in known] == []


def test_the_table_of_names_is_right():
    from acino_fte.data_tools.colmap_images import parse_image_names

    section = PAGE.partition("## Names of images")[2].partition("\n## ")[0]
    examples = re.findall(r"^\| `(\S*\{frame\}\S*|re:\S+)` \| `(\S+)` \|$", section, re.MULTILINE)
    assert len(examples) == 4
    for pattern, name in examples:
        found = parse_image_names([name], pattern)
        assert found.camera == ("left",)
        assert found.frame.tolist() == [123]
    for names in (
        ["left_000123.jpg", "left_000124.jpg", "right_000123.jpg"],
        ["left/000123.png", "right/000123.png"],
    ):
        assert parse_image_names(names).cameras == ("left", "right")
    assert parse_image_names(["day1/left_000123.png", "day2/left_000123.png"]).cameras[0] != "left"


def test_the_table_of_distances_is_right():
    from acino_fte.data_tools.scene_scale import parse_distance

    section = PAGE.partition("## Scale")[2].partition("\n## ")[0]
    written = re.findall(r"`([^`\s]+=[^`\s]+)`", section)
    assert len(written) >= 8
    kinds = {text: parse_distance(text) for text in written}
    assert {distance.kind for distance in kinds.values()} >= {"cameras", "individuals"}
    assert kinds["left:right=60cm+-2mm"].length == pytest.approx(0.6)
    assert kinds["left:right=60cm+-2mm"].sd == pytest.approx(0.002)


def test_the_example_is_small():
    assert sum(path.stat().st_size for path in EXAMPLE.rglob("*") if path.is_file()) < 1_000_000
