"""The tutorial docs/new_species.md does what it says: its edits and commands are carried out in order."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

import pytest
from typer.testing import CliRunner

import acino_fte
from acino_fte.cli import app
from acino_fte.skeleton import load_skeleton
from acino_fte.skeleton_check import check_skeleton

REPOSITORY = Path(__file__).resolve().parent.parent
TUTORIAL = REPOSITORY / "docs" / "new_species.md"
_EDIT = re.compile(r"# (?P<file>\S+), under '(?P<key>\w+:)'\n(?P<text>.*)", re.DOTALL)


def blocks(text: str) -> list[tuple[str, str]]:
    """(language, text) of the fenced blocks of a page."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def arguments(line: str) -> list[str]:
    """A command line that starts a script of the repository, for the interpreter that runs the tests."""
    words = shlex.split(line)
    assert words[0] == "python", line
    assert words[1].startswith("scripts/"), line
    return [sys.executable, str(REPOSITORY / words[1]), *words[2:]]


def execute(line: str, folder: Path) -> str:
    """What a command line prints. ``acino-fte`` runs in this process: a new one only takes time to import.

    (That it starts as a program is a matter of test_run_cli.)
    """
    if line.startswith("acino-fte "):
        with chdir(folder):
            done = CliRunner(env={"COLUMNS": "200"}).invoke(app, shlex.split(line)[1:])
        assert done.exit_code == 0, f"{line}\n{done.output}\n{done.exception!r}"
        return done.stdout
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
            for line in filter(str.strip, text.splitlines()):
                quick = " --no-figures" if line.startswith("acino-fte run ") else ""  # test_docs draws them
                output += execute(line + quick, folder)
    return output


@pytest.fixture(scope="module")
def tutorial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder in which the whole page was carried out, and what its commands printed."""
    folder = tmp_path_factory.mktemp("tutorial")
    return folder, follow(blocks(TUTORIAL.read_text()), folder)


def test_the_skeleton_part(tutorial: tuple[Path, str]) -> None:
    folder, output = tutorial
    skeleton = load_skeleton(folder / "fox.yaml")
    assert {"l_ear", "r_ear"} <= set(skeleton.marker_names)
    assert check_skeleton(folder / "fox.yaml") == []
    promised = next(text for kind, text in blocks(TUTORIAL.read_text()) if kind == "text")
    assert promised.strip() in output
    for name in ("fox.png", "fox_middle.png", "wolf.yaml", "species.schema.json"):
        assert (folder / name).stat().st_size > 1000


def test_the_whole_tutorial_ends_with_a_trajectory(tutorial: tuple[Path, str]) -> None:
    folder, _ = tutorial
    metrics = json.loads((folder / "out" / "fox_fte" / "metrics.json").read_text())
    assert metrics["status"] == "converged"
    assert metrics["species"] == "fox"
    assert metrics["frames"] == [0, 60]
    assert metrics["truth_mm"]["mpjpe"] < 10
    assert (folder / "out" / "fox_fte" / "report.html").is_file()


def test_the_error_shown_is_the_one_that_is_given(tmp_path: Path) -> None:
    shown = next(text for _, text in blocks(TUTORIAL.read_text()) if text.startswith("error "))
    execute("acino-fte skeleton new fox", tmp_path)
    path = tmp_path / "fox.yaml"
    wrist = "noise: 12000}"
    assert wrist in path.read_text()
    path.write_text(path.read_text().replace(wrist, wrist + ", twist: {turn: z, range: [-30, 30]}"))
    result = CliRunner().invoke(app, ["skeleton", "check", str(path)])
    assert result.exit_code == 2
    assert shown.strip() in result.output


def test_scripts_are_run_by_this_interpreter() -> None:
    script = str(REPOSITORY / "scripts" / "run_fte.py")
    assert arguments("python scripts/run_fte.py out -o x") == [sys.executable, script, "out", "-o", "x"]


def test_a_command_that_fails_is_noticed(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="missing"):
        execute("acino-fte skeleton check missing.yaml", tmp_path)
