"""Writes a simulation as a sequence folder, with its truth and how it was made."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np

from acino_fte.errors import InputError
from acino_fte.simulate import Simulation, is_bundled

PROVENANCE = "simulation.json"
FORMAT = "acino-fte/simulation/1"

_README = """# {name}

A simulated recording: {species}, motion '{motion}', {n_frames} frames at {fps:g} Hz, {n_cameras} cameras.
Made by

    {command}

which makes it again, number for number. All options are in `simulation.json`.

| file | what |
| --- | --- |
| `sequence.yaml` | what belongs together |
| `cameras.json` | calibration: x_camera = rotation * x_world + translation, m |
| `dlc/*.csv` | detections as DeepLabCut writes them, px; an empty cell is a missing detection |
| `truth.csv` | true marker positions, m, world frame, z up, ground at z = 0 |
| `truth_states.csv` | true degrees of freedom, rad and m |
"""
_README_PARAMETERS = (
    "| `truth_parameters.json` | true time offsets of the cameras, corrections of `cameras.json`, "
    "proportions of the animal, displacements of the markers, and left/right swaps |\n"
)


def write_simulation(
    simulation: Simulation, folder: Path | str, *, overwrite: bool = False, command: str | None = None
) -> Path:
    """Write a sequence folder; it appears whole or not at all.

    Parameters
    ----------
    simulation : Simulation
        From :func:`acino_fte.simulate.simulate`.
    folder : Path
        Where; its name becomes the name of the sequence.
    overwrite : bool
        Replace an earlier simulation there. Nothing else is ever replaced.
    command : str, optional
        The command that made it, for the note in the folder.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        The folder exists and is not to be replaced, or cannot be made.
    """
    folder = check_target(folder, overwrite=overwrite)
    with whole_folder(folder) as work:
        _write_files(simulation, work, folder.name, command or "acino_fte.simulate.simulate (from Python)")
    return folder


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder to fill, which takes the name of `folder` at the end; on failure nothing is left.

    Raises
    ------
    InputError
        The folder cannot be made.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    except OSError as error:
        raise InputError(
            "The folder cannot be made.",
            file=folder,
            found=error.strerror or str(error),
            remedy="choose a folder in which you may write",
        ) from None
    try:
        yield work
        work.chmod(0o755)  # mkdtemp makes a private one
        _rename(work, folder)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise


def check_target(folder: Path | str, *, overwrite: bool) -> Path:
    """The absolute path of a target; InputError when something is there that must not be replaced."""
    folder = Path(folder).expanduser().resolve()
    if not folder.exists():
        return folder
    if not folder.is_dir():
        raise InputError("The target is a file, not a folder.", file=folder, remedy="choose another name")
    if not any(folder.iterdir()):
        return folder
    if not (folder / PROVENANCE).is_file():
        raise InputError(
            "The target holds something that is not a simulation; it is left alone.",
            file=folder,
            expected=f"no such folder, an empty one, or an earlier simulation (with {PROVENANCE})",
            remedy="choose another folder",
        )
    if not overwrite:
        raise InputError(
            "There is a simulation already.",
            file=folder,
            remedy="choose another folder, or replace it with --overwrite",
        )
    return folder


def _rename(work: Path, folder: Path) -> None:
    """Give ``work`` the name ``folder``; what is there is kept until then, and put back on failure."""
    if not folder.exists():
        work.rename(folder)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{folder.name}.old-", dir=folder.parent)) / folder.name
    folder.rename(old)
    try:
        work.rename(folder)
    except BaseException:
        old.rename(folder)
        raise
    finally:
        shutil.rmtree(old.parent, ignore_errors=True)


def _write_files(simulation: Simulation, folder: Path, name: str, command: str) -> None:
    from acino_fte.data_tools.calibration import write_cameras
    from acino_fte.data_tools.deeplabcut import write_deeplabcut_csv
    from acino_fte.data_tools.sequence_file import write_sequence_file
    from acino_fte.data_tools.truth import write_truth
    from acino_fte.data_tools.truth_parameters import FILE_NAME, write_truth_parameters

    skeleton, options, detections = simulation.skeleton, simulation.options, simulation.detections
    write_cameras(folder / "cameras.json", simulation.cameras)
    (folder / "dlc").mkdir()
    for c, camera in enumerate(simulation.cameras.names):
        write_deeplabcut_csv(
            folder / "dlc" / f"{camera}.csv",
            skeleton.marker_names,
            detections.position[:, c],
            detections.likelihood[:, c],
            scorer="acino_fte_simulation",
        )
    write_truth(folder / "truth.csv", skeleton.marker_names, simulation.positions)
    _write_states(simulation, folder / "truth_states.csv")
    truths = {"truth": "truth.csv"}
    text = _README.format(name=name, species=skeleton.name, command=command, **asdict(options))
    if options.has_imperfections:
        write_truth_parameters(folder / FILE_NAME, simulation.truth_parameters)
        truths["truth_parameters"] = FILE_NAME
        text += _README_PARAMETERS
    write_sequence_file(
        folder / "sequence.yaml",
        {
            "format": "acino-fte/sequence/1",
            "name": name,
            "species": _species(simulation, folder),
            "fps": float(options.fps),
            "cameras": "cameras.json",
            "keypoints": {camera: f"dlc/{camera}.csv" for camera in simulation.cameras.names},
            **truths,
        },
    )
    (folder / "README.md").write_text(text, encoding="utf-8")
    _write_provenance(simulation, folder / PROVENANCE, command)


def _species(simulation: Simulation, folder: Path) -> str:
    """The species as the sequence file names it; a user's own file is copied into the folder."""
    skeleton = simulation.skeleton
    if skeleton.path is None or is_bundled(skeleton):
        return skeleton.name
    shutil.copyfile(skeleton.path, folder / "species.yaml")
    return "species.yaml"


def _write_states(simulation: Simulation, path: Path) -> None:
    import pandas as pd

    table = pd.DataFrame(simulation.q, columns=simulation.skeleton.dof_names)
    table.insert(0, "frame", np.arange(len(table)))
    table.to_csv(path, index=False, lineterminator="\n", float_format="%.6f")


def _write_provenance(simulation: Simulation, path: Path, command: str) -> None:
    from acino_fte import __version__

    content = {
        "format": FORMAT,
        "version": __version__,
        "command": command,
        "species": simulation.skeleton.name,
        "options": asdict(simulation.options),
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
