"""The species that come with the toolkit, one YAML file each."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path


def species_names() -> list[str]:
    """Names of the bundled species, sorted."""
    return sorted(f.name.removesuffix(".yaml") for f in files(__name__).iterdir() if f.name.endswith(".yaml"))


def species_path(name: str) -> Path:
    """Path of a bundled species file; the file is not checked to exist."""
    with as_file(files(__name__) / f"{name}.yaml") as path:
        return path
