"""A recording of a rig with known truth: ``python scripts/simulate_rig.py out/rig``."""

import typer

from acino_fte.cli_simulate_rig import simulate_rig

if __name__ == "__main__":
    typer.run(simulate_rig)
