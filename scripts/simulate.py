"""Make a simulated recording with known truth: ``python scripts/simulate.py out/x --motion gallop``."""

import typer

from acino_fte.cli_simulate import simulate

if __name__ == "__main__":
    typer.run(simulate)
