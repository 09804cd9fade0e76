"""Errors and adjustments of runs: ``python scripts/plot_histograms.py RUN``, as ``acino-fte histograms``."""

import typer

from acino_fte.cli_histograms import histograms

if __name__ == "__main__":
    typer.run(histograms)
