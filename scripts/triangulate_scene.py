"""3D tracks from moving cameras: ``python scripts/triangulate_scene.py FOLDER``, as ``acino-fte scene``."""

import typer

from acino_fte.cli_scene import scene

if __name__ == "__main__":
    typer.run(scene)
