"""Commands of the rig's pages, run in this process. The program is built once, not anew for every command."""

from __future__ import annotations

import shlex
from contextlib import chdir
from functools import cache
from pathlib import Path

from click.testing import CliRunner
from typer.main import get_command

from acino_fte.cli import app

program = cache(lambda: get_command(app))


def execute(line: str, folder: Path, code: int = 0) -> str:
    """What ``acino-fte …`` prints in a folder."""
    name, *words = shlex.split(line)
    assert name == "acino-fte"
    with chdir(folder):
        done = CliRunner(env={"COLUMNS": "200"}).invoke(program(), words)
    assert done.exit_code == code, f"{line}\n{done.output}\n{done.exception!r}"
    return done.output
