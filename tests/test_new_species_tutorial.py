"""The tutorial docs/new_species.md does what it says: its edits and commands are carried out in order."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import acino_fte
from acino_fte.cli_skeleton import app
from acino_fte.skeleton import load_skeleton
from acino_fte.skeleton_check import check_skeleton

REPOSITORY = Path(__file__).resolve().parent.parent
TUTORIAL = REPOSITORY / "docs" / "new_species.md"
_EDIT = re.compile(r"# (?P<file>\S+), under '(?P<key>\w+:)'\n(?P<text>.*)", re.DOTALL)
# the command 'acino-fte' of the interpreter that runs the tests, installed or not
_COMMAND = [sys.executable, "-c", "from acino_fte.cli import main; main()"]


def blocks(text: str) -> list[tuple[str, str]]:
    """(language, text) of the fenced blocks of a page."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def arguments(line: str) -> list[str]:
    """A command line of the tutorial as a list to run with this interpreter."""
    words = shlex.split(line)
    if words[0] == "acino-fte":
        return [*_COMMAND, *words[1:]]
    assert words[0] == "python", line
    assert words[1].startswith("scripts/"), line
    return [sys.executable, str(REPOSITORY / words[1]), *words[2:]]


def execute(line: str, folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(Path(acino_fte.__file__).parent.parent), "COLUMNS": "200"}
    result = subprocess.run(
        arguments(line), cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert result.returncode == 0, f"{line}\n{result.stdout}\n{result.stderr}"
    return result.stdout


def edit(text: str, folder: Path) -> None:
    """Insert a YAML block that says where it belongs."""
    match = _EDIT.match(text)
    if match is None:
        return  # an excerpt that only explains
    path = folder / match["file"]
    before, key, after = path.read_text().partition(f"\n{match['key']}\n")
    assert key, f"{match['file']} has no line {match['key']}"
    path.write_text(before + key + match["text"] + after)


def follow(page: list[tuple[str, str]], folder: Path) -> str:
    """Carry out edits and commands in order; the output of all commands."""
    output = ""
    for language, text in page:
        if language == "yaml":
            edit(text, folder)
        elif language == "bash":
            output += "".join(execute(line, folder) for line in text.splitlines() if line.strip())
    return output


def _needs_a_run(block: tuple[str, str]) -> bool:
    return block[0] == "bash" and re.match(r"acino-fte (simulate|run) ", block[1]) is not None


def test_the_skeleton_part(tmp_path: Path) -> None:
    page = [block for block in blocks(TUTORIAL.read_text()) if not _needs_a_run(block)]
    script = tmp_path / "skeleton"
    script.mkdir()
    output = follow([(kind, text) for kind, text in page if kind != "text"], script)
    skeleton = load_skeleton(script / "fox.yaml")
    assert {"l_ear", "r_ear"} <= set(skeleton.marker_names)
    assert check_skeleton(script / "fox.yaml") == []
    promised = next(text for kind, text in page if kind == "text")
    assert promised.strip() in output
    for name in ("fox.png", "fox_middle.png", "wolf.yaml", "species.schema.json"):
        assert (script / name).stat().st_size > 1000


def test_the_whole_tutorial_ends_with_a_trajectory(tmp_path: Path) -> None:
    follow(blocks(TUTORIAL.read_text()), tmp_path)
    metrics = json.loads((tmp_path / "out" / "fox_fte" / "metrics.json").read_text())
    assert metrics["status"] == "converged"
    assert metrics["species"] == "fox"
    assert metrics["frames"] == [0, 60]
    assert metrics["truth_mm"]["mpjpe"] < 10
    assert (tmp_path / "out" / "fox_fte" / "report.html").is_file()


def test_the_error_shown_is_the_one_that_is_given(tmp_path: Path) -> None:
    shown = next(text for _, text in blocks(TUTORIAL.read_text()) if text.startswith("error "))
    execute("acino-fte skeleton new fox", tmp_path)
    path = tmp_path / "fox.yaml"
    wrist = "noise: 12000}"
    assert wrist in path.read_text()
    path.write_text(path.read_text().replace(wrist, wrist + ", twist: {turn: z, range: [-30, 30]}"))
    result = CliRunner().invoke(app, ["check", str(path)])
    assert result.exit_code == 2
    assert shown.strip() in result.output


@pytest.mark.parametrize("line", ["acino-fte skeleton list", "python scripts/run_fte.py out -o x"])
def test_commands_are_run_by_this_interpreter(line: str) -> None:
    assert arguments(line)[0] == sys.executable
