"""Make a simulated recording with known truth: ``python scripts/simulate.py out/x --motion gallop``."""

import sys
from pathlib import Path

import typer

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # a checkout that is not installed

from acino_fte.cli_simulate import simulate

if __name__ == "__main__":
    typer.run(simulate)
