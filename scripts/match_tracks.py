"""Match 2D tracks over all cameras: ``python scripts/match_tracks.py FOLDER``, as ``acino-fte match``."""

import typer

from acino_fte.cli_match import match

if __name__ == "__main__":
    typer.run(match)
