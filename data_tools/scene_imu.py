"""Which way is up in a structure-from-motion model: from accelerometers of the cameras."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from acino_fte.data_tools.scene_distances import robust_mean
from acino_fte.data_tools.scene_gravity import UPRIGHT, KeyPoses, Up, jackknife, unit
from acino_fte.errors import InputError

Accelerations = dict[str, tuple[np.ndarray, np.ndarray]]
"""Of each camera: frames (A,) and what its accelerometer says in the camera's frame (A, 3)."""


def up_from_accelerations(keys: KeyPoses, names: Sequence[str], accelerations: Accelerations) -> Up:
    """Up from the specific force that accelerometers feel: its mean points up, whatever the cameras do.

    Parameters
    ----------
    keys : KeyPoses
        Of the cameras.
    names : sequence of str
        Of the cameras.
    accelerations : Accelerations
        Any unit; x right, y down, z forward as the camera's frame.

    Raises
    ------
    InputError
        No key frame has a measurement.
    """
    force = np.full((len(keys.frame), 3), np.nan)
    for name, (frame, value) in accelerations.items():
        rows = np.flatnonzero(keys.camera == names.index(name))
        _, here, there = np.intersect1d(keys.frame[rows], frame, return_indices=True)
        force[rows[here]] = np.einsum("kji,kj->ki", keys.rotation[rows[here]], value[there])
    felt = np.flatnonzero(np.isfinite(force).all(-1))
    if not len(felt):
        raise InputError(
            "The accelerations say nothing of the scene's key frames.",
            expected=f"frames such as {', '.join(map(str, keys.frame[:3]))}",
            found="; ".join(f"{n}: {f[0]}–{f[-1]}" for n, (f, _) in accelerations.items()) or "none",
        )
    part = keys.at(felt)
    notes = []
    size = float(np.median(np.linalg.norm(force[felt], axis=1)))
    if not (8.8 < size < 10.8 or 0.9 < size < 1.1):
        notes.append(f"The accelerometers feel {size:.3g} at the median, neither 9.8 m/s² nor 1 g.")
    up = unit(robust_mean(force[felt])[0])
    if up @ -part.rotation[:, 1].mean(axis=0) < -UPRIGHT:
        notes.append(
            "The accelerometers say that the cameras were held upside down: at rest the file has to hold the "
            "specific force, which points up, in the camera's frame (x right, y down, z forward)."
        )
    place = {int(row): i for i, row in enumerate(felt)}

    def direction(some: KeyPoses) -> np.ndarray:
        rows = [place[int(row)] for row in some.frame]
        return unit(robust_mean(force[felt][rows])[0])

    counted = KeyPoses(part.camera, felt, part.rotation, part.centre)
    sd = jackknife(direction, counted, part.frame)
    return Up(
        up,
        f"accelerometers of {len(accelerations)} camera(s), {len(felt)} key frames",
        sd,
        notes=tuple(notes),
    )


def read_accelerations(path: Path | str, names: Sequence[str]) -> Accelerations:
    """Accelerations from a CSV file: columns frame, ax, ay, az, and camera unless there is one camera only.

    Parameters
    ----------
    path : Path
        The file; frames on the camera's own clock, m/s² or g, in the camera's frame.
    names : sequence of str
        Of the cameras of the scene.

    Raises
    ------
    InputError
        The file is missing, has no such columns, or names unknown cameras.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [{(k or "").strip().lower(): v for k, v in row.items()} for row in csv.DictReader(file)]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "The accelerations cannot be read.", file=path, found=str(error), remedy="check the path"
        ) from None
    columns = list(rows[0]) if rows else []
    label = next((key for key in ("camera", "cam") if key in columns), None)
    if not set(columns) >= {"frame", "ax", "ay", "az"} or (label is None and len(names) > 1):
        raise InputError(
            "The accelerations lack columns.",
            file=path,
            expected="camera, frame, ax, ay, az" if len(names) > 1 else "frame, ax, ay, az",
            found=", ".join(columns) or "an empty file",
        )
    of: dict[str, list[list[float]]] = {}
    for i, row in enumerate(rows):
        name = (row[label] or "").strip() if label else names[0]
        if name not in names:
            raise InputError(
                "The accelerations are of an unknown camera.",
                file=path,
                expected=", ".join(names),
                found=repr(name),
            )
        try:
            of.setdefault(name, []).append([float(row[key] or "nan") for key in ("frame", "ax", "ay", "az")])
        except ValueError:
            raise InputError(
                "The accelerations hold something that is no number.", file=path, key=f"line {i + 2}"
            ) from None
    tables = {name: np.array(table) for name, table in of.items()}
    kept = {name: table[np.isfinite(table).all(1)] for name, table in tables.items()}
    return {name: (table[:, 0].astype(int), table[:, 1:]) for name, table in kept.items() if len(table)}
