"""Adjust a trajectory by hand in the browser: ``python scripts/adjust.py RUN``, as ``acino-fte adjust``."""

import typer

from acino_fte.cli_adjust import adjust

if __name__ == "__main__":
    typer.run(adjust)
