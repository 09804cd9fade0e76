"""docs/lidar.md does what it says: commands, Python and numbers, from top to bottom.

Figures and reports are left out, to save time: the tests of each command draw them. Numbers of a run may
differ by a share; what the page says of their order may not.
"""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_new_species_tutorial import blocks, execute

pytest.importorskip("rosbags")
pytest.importorskip("av")
pytest.importorskip("cv2")

from acino_fte.association import ASSOCIATIONS
from acino_fte.data_tools.sequence_file import LidarEntry

REPOSITORY = Path(__file__).resolve().parent.parent
DOCS = REPOSITORY / "docs"
PAGE = (DOCS / "lidar.md").read_text(encoding="utf-8")
FORMATS = (DOCS / "sequence_format.md").read_text(encoding="utf-8")
METRICS = (DOCS / "metrics.md").read_text(encoding="utf-8")
_PLAIN = {"run": "--no-figures", "histograms": "--no-figures", "calibrate-lidar": "--no-report"}
_NO_SPREAD = ("run hunt", "--association body")  # whose standard deviations nothing here looks at
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """The folder after the whole page, what its commands printed, and its Python names."""
    folder = tmp_path_factory.mktemp("lidar")
    printed, names = {}, {"__name__": "docs"}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("MPLBACKEND", "Agg")
        for language, block in blocks(PAGE):
            if language == "bash":
                for line in filter(str.strip, block.splitlines()):
                    plain = _PLAIN.get(line.split()[1], "")
                    if any(words in line for words in _NO_SPREAD):
                        plain += " --no-covariance"
                    printed[line] = execute(f"{line} {plain}", folder)
            elif language == "python":
                exec(compile(block, f"lidar.md: {block.splitlines()[0]}", "exec"), names)
    return folder, printed, names


def printed_by(printed: dict[str, str], words: str) -> str:
    return next(text for line, text in printed.items() if words in line)


def assert_shown(printed: str, first_words: str) -> None:
    """The lines of a block are among those printed: the same words, nearly the same numbers."""
    shown = next(text for kind, text in blocks(PAGE) if kind == "text" and text.startswith(first_words))
    lines = {_NUMBER.sub("#", line.strip()): line for line in printed.splitlines()}
    for line in shown.splitlines():
        if line.startswith("report "):
            continue  # left out here
        theirs = lines[_NUMBER.sub("#", line.strip())]
        numbers = [[float(n) for n in _NUMBER.findall(text)] for text in (line, theirs)]
        np.testing.assert_allclose(*numbers, rtol=0.03, atol=0.05, err_msg=f"{line}\n{theirs}")


def metrics_of(folder: Path, name: str) -> dict:
    return json.loads((folder / "out" / name / "metrics.json").read_text())


def test_the_commands_print_what_the_page_shows(followed):
    _, printed, _ = followed
    assert_shown(printed_by(printed, "calibrate-lidar"), "30 of 30")
    assert_shown(printed_by(printed, "--inspect"), "stream ")
    assert_shown(printed_by(printed, "rig.bag --video"), "damage: none")
    assert_shown(printed_by(printed, "run hunt"), "hunt: cheetah")


def test_the_import_gives_what_a_run_needs(followed):
    folder, _, _ = followed
    metrics = metrics_of(folder, "hunt")
    assert metrics["status"] == "converged"
    assert metrics["depth_m"]["n"] > 200
    assert metrics["depth_m"]["median"] < 0.03
    assert abs(metrics["depth_m"]["bias"]) < 0.02
    first = pd.read_csv(folder / "hunt" / "imu.csv").iloc[0, 0]
    start = float(re.search(r"--start ([\d.]+)", PAGE).group(1))
    assert first == pytest.approx(-start, abs=1e-3)


def test_errors_are_as_the_page_says(followed):
    folder, _, _ = followed
    rows = dict(re.findall(r"^\| `(\w+)` \| (\d+) mm \| \d+ mm \|$", PAGE, re.MULTILINE))
    assert set(rows) == set(ASSOCIATIONS)
    names = {"marker": "field", "body": "field_body", "nearest": "field_nearest", "none": "field_alone"}
    found = {how: metrics_of(folder, name)["truth_mm"]["mpjpe"] for how, name in names.items()}
    for how, promised in rows.items():
        assert found[how] == pytest.approx(float(promised), rel=0.3), how
    assert 2 * found["marker"] < found["nearest"] < found["none"]
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    assert re.search(r"(\d+) mm on average; without the lidar to (\d+) mm", readme).groups() == (
        rows["marker"],
        rows["none"],
    )
    pixels = [metrics_of(folder, name)["reprojection_px"]["median"] for name in names.values()]
    assert max(pixels) < 1.1 * min(pixels)  # pictures do not show it
    assert any("species' segment lengths" in f for f in metrics_of(folder, "field_alone")["findings"])


def test_depth_csv_and_its_metrics_are_explained(followed):
    folder, _, _ = followed
    table = pd.read_csv(folder / "out" / "field" / "depth.csv")
    row = next(line for line in FORMATS.splitlines() if line.startswith("| `depth.csv`"))
    assert [column for column in table if f"`{column}`" not in row] == []
    metrics = metrics_of(folder, "field")
    section = METRICS.partition("## Depth")[2].partition("\n## ")[0]
    assert [key for key in metrics["depth_m"] if f"`{key}`" not in section] == []
    d = table["predicted"] - table["measured"]
    assert np.sqrt((d**2).mean()) == pytest.approx(metrics["depth_m"]["rmse"], rel=1e-3)
    assert "surface_offset_m" in metrics["parameters"]
    assert "`surface_offset_m`" in PAGE
    assert "`surface_offset_m`" in METRICS


def test_the_picture_is_that_of_the_page(followed):
    from matplotlib.image import imread

    folder, _, _ = followed
    made, kept = imread(folder / "lidar_result.png"), imread(DOCS / "images" / "lidar_result.png")
    assert made.shape == kept.shape
    assert np.abs(made - kept).mean() < 0.03


def test_the_tables_of_the_last_step_are_there(followed):
    folder, _, _ = followed
    assert {"reprojection.tex", "depth.tex", "evaluation.json"} <= {
        path.name for path in (folder / "out" / "paper").iterdir()
    }
    assert (folder / "out" / "hunt.adjustments.csv").stat().st_size > 0


def test_every_key_of_a_lidar_is_explained():
    section = FORMATS.partition("## A lidar")[2].partition("\n## ")[0]
    assert [key for key in LidarEntry.model_fields if f"| `{key}` |" not in section] == []


def test_the_messages_are_those_of_the_program():
    section = PAGE.partition("## When something is wrong")[2].partition("\n## ")[0]
    messages = [m for m in re.findall(r"^\| (.+?) \| .+ \|$", section, re.MULTILINE) if m != "message"]
    assert len(messages) > 20
    known = program_texts()
    assert [message for message in messages if message not in known] == []


def program_texts() -> str:
    """All texts of the modules that have to do with it, a line each; … stands for what is put in."""
    texts = []
    patterns = ("data_tools/import_*", "data_tools/sync*", "data_tools/imu*", "data_tools/lidar_*")
    patterns += ("data_tools/sequence_lidar*", "acino_fte/fusion*", "acino_fte/single_view*")
    patterns += ("acino_fte/cli_motion*", "acino_fte/adjust_files*", "acino_fte/evaluation_runs*")
    for file in (f for pattern in patterns for f in REPOSITORY.glob(f"{pattern}.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values]
                texts.append("".join(parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return "\n".join(" ".join(text.split()) for text in texts)
