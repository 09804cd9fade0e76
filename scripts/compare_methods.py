"""Compare methods: ``python scripts/compare_methods.py SEQUENCE...``, as ``acino-fte compare``."""

import typer

from acino_fte.cli_compare import compare

if __name__ == "__main__":
    typer.run(compare)
