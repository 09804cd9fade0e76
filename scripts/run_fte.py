"""Estimate the 3D trajectory of an animal: ``python scripts/run_fte.py SEQUENCE``, as ``acino-fte run``."""

import typer

from acino_fte.cli_run import run

if __name__ == "__main__":
    typer.run(run)
