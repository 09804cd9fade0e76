"""The command acino-fte rig plan, its files, and its page of documentation."""

import csv
import json
import re
from contextlib import chdir
from pathlib import Path

import pytest
from rig_commands import execute
from test_new_species_tutorial import blocks
from typer.testing import CliRunner

from acino_fte.cli_rig import app
from acino_fte.rig.plan import plan_rig
from acino_fte.rig.plan_changes import PlanChanges, changed_rig
from acino_fte.rig.plan_files import FILES, plan_json
from acino_fte.rig.plan_tables import plan_markdown, verdict_table
from acino_fte.rig.plan_text import at_least, at_most, number
from acino_fte.rig.plan_verdicts import verdicts
from acino_fte.rig.rig_file import CameraPart, RigFile
from acino_fte.rig.rig_read import read_rig, write_rig

PAGE = Path(__file__).resolve().parent.parent / "docs" / "rig_plan.md"


def run(folder, *arguments, code=0):
    with chdir(folder):
        done = CliRunner(env={"COLUMNS": "120"}).invoke(app, ["plan", *map(str, arguments)])
    assert done.exit_code == code, f"{done.output}\n{done.exception!r}"
    return done.output


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The folder in which every command of the page was run, and what each printed."""
    folder = tmp_path_factory.mktemp("page")
    kinds = blocks(PAGE.read_text(encoding="utf-8"))
    assert {kind for kind, _ in kinds} == {"bash"}
    lines = [line for _, text in kinds for line in text.splitlines() if line.strip()]
    return folder, {line: execute(line, folder) for line in lines}


def test_the_page_shows_every_figure_that_its_commands_print(page):
    _, printed = page
    first = printed["acino-fte rig plan"]
    text = " ".join(PAGE.read_text(encoding="utf-8").split())
    for figure in (
        "409 px",
        "18.33 mm",
        "4.3° × 2.29°",
        "44.3 mm",
        "5885.6 µs",
        "133.7",
        "2.1 h",
        "25.6",
        "5.45 px",
    ):
        assert figure in first, figure
        assert figure in text, figure
    assert "366" in first
    assert re.search(r"FR2 .*fail", printed["acino-fte rig plan --codec raw"])
    assert re.search(r"FR1 .*pass", printed["acino-fte rig plan --codec raw"])
    assert "60 m" in printed["acino-fte rig plan --distance 60 --focal 75"]


def test_the_folder_holds_what_the_page_says(page):
    folder, _ = page
    out = folder / "plan"
    assert {path.name for path in out.iterdir()} == set(FILES)
    figures = {path.name: path.read_bytes() for path in (out / "figures").iterdir()}
    assert {name: data[:4] for name, data in figures.items()} == {"cam1.png": b"\x89PNG", "cam1.pdf": b"%PDF"}
    assert read_rig(out).cameras["cam1"].lens.used_mm == 75
    data = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    assert data["cameras"][0]["pixels"] == pytest.approx(409.0909 / 2)
    assert RigFile.model_validate(data["rig"]) == read_rig(out)
    by_key = {one["key"]: one for one in data["requirements"]}
    assert (by_key["FR3"]["verdict"], by_key["W3"]["verdict"], data["passed"]) == ("pass", "fail", False)
    with (out / "storage.csv").open() as file:
        rows = {(row["video"], row["lidar"]): row for row in csv.DictReader(file)}
    assert float(rows["raw", "none"]["fills_h"]) == pytest.approx(2.0777, abs=1e-4)
    with (out / "pixels.csv").open() as file:
        pixels = {
            (float(r["distance_m"]), float(r["focal_mm"])): float(r["pixels"]) for r in csv.DictReader(file)
        }
    assert pixels[100.0, 150.0] == pytest.approx(409.0909, abs=1e-4)
    assert read_rig(folder / "rig.yaml") == RigFile()


def test_a_plan_is_replaced_by_a_plan_and_nothing_else_is(page, tmp_path, monkeypatch):
    folder, _ = page
    monkeypatch.setattr("acino_fte.rig.plan_figure.save_plan_figures", lambda plan, out: out.mkdir())
    before = (folder / "plan" / "plan.json").read_text(encoding="utf-8")
    run(folder, "--focal", "20", "-o", "plan")
    assert (folder / "plan" / "plan.json").read_text(encoding="utf-8") != before

    def full(plan, out):
        raise OSError(28, "No space left on device")

    before = (folder / "plan" / "plan.json").read_text(encoding="utf-8")
    monkeypatch.setattr("acino_fte.rig.plan_figure.save_plan_figures", full)
    assert "No space left" in run(folder, "-o", "plan", code=2)
    assert (folder / "plan" / "plan.json").read_text(encoding="utf-8") == before
    assert sorted(path.name for path in folder.iterdir()) == ["plan", "rig.yaml"]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "diary.txt").write_text("cheetah!")
    said = run(tmp_path, "-o", "mine", code=2)
    assert "diary.txt" in said
    assert "Requirement" not in said
    assert "holds the rig file" in run(folder, "plan", "-o", "plan", code=2)


def test_it_works_without_any_file_and_with_the_one_that_is_there(tmp_path):
    assert "there is no rig.yaml here" in run(tmp_path)
    assert list(tmp_path.iterdir()) == []
    write_rig(tmp_path / "rig.yaml", RigFile(name="[dawn]", cameras={"eye": CameraPart(fps=30)}))
    said = run(tmp_path)
    assert "[dawn]" in said
    assert "eye" in said
    assert "30 fps" in said


def test_init_writes_a_file_once(tmp_path):
    assert "acino-fte rig plan my.yaml" in run(tmp_path, "my.yaml", "--init", "--focal", "50")
    assert read_rig(tmp_path / "my.yaml").cameras["cam1"].lens.used_mm == 50
    before = (tmp_path / "my.yaml").read_bytes()
    assert "would be lost" in run(tmp_path, "my.yaml", "--init", code=2)
    assert (tmp_path / "my.yaml").read_bytes() == before
    assert "--init writes a rig file" in run(tmp_path, "--init", "-o", "plan", code=2)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["none.yaml"], "does not exist"),
        (["empty"], "holds no rig.yaml"),
        (["video.mp4"], "not text"),
        (["typo.yaml"], "did you mean 'cameras'?"),
        (["--focal", "300"], "from 5 to 150 mm"),
        (["--distance", "0"], "--distance is impossible"),
        (["--fps", "nan"], "--fps is impossible"),
        (["--codec", "h265"], "h265"),
        (["--fokal", "50"], "--fokal"),
    ],
)
def test_a_mistake_is_named_in_one_message(tmp_path, arguments, said):
    (tmp_path / "empty").mkdir()
    (tmp_path / "video.mp4").write_bytes(bytes(range(256)))
    (tmp_path / "typo.yaml").write_text("format: acino-fte/rig/1\ncamera: {}\n")
    printed = run(tmp_path, *arguments, code=2)
    assert said in printed
    assert "Traceback" not in printed


def test_infinite_and_unknown_numbers_are_null():
    rig = changed_rig(RigFile(), PlanChanges(focal_mm=5, focus_m=50))
    data = json.loads(json.dumps(plan_json(plan_rig(rig)), allow_nan=False))
    assert data["cameras"][0]["far_m"] is None
    assert "∞" in plan_markdown(plan_rig(rig))


def test_text_of_a_file_is_escaped_in_markdown():
    assert r"a\|b\*" in plan_markdown(plan_rig(RigFile(name="a|b*")))


def test_a_narrow_pass_says_so_and_rounding_never_turns_a_verdict():
    tight = changed_rig(RigFile(), PlanChanges(distance_m=105))
    table = verdict_table(verdicts(plan_rig(tight)))
    assert next(row for row in table.rows if row[0] == "W4")[-1] == "tight"
    close = changed_rig(RigFile(), PlanChanges(focal_mm=18.3))
    row = next(row for row in verdict_table(verdicts(plan_rig(close))).rows if row[0] == "FR3")
    assert (row[-2], row[-1]) == ("× 0.9982", "fail")
    assert (at_least(18.3333), at_most(18.3333), at_least(0.5), at_most(1234)) == (
        "18.4",
        "18.3",
        "0.5",
        "1230",
    )
    assert (number(14545.4, 3), number(0.0123, 2), number(float("inf"), 3)) == ("14500", "0.012", "∞")
