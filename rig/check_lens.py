"""How far zoom and focus may be turned before the calibration is no longer valid, as ``rig.yaml`` says."""

from __future__ import annotations

from pathlib import Path

from acino_fte.errors import InputError
from acino_fte.rig.rig_file import FILE_NAME, RigFile

_RINGS = ("zoom", "focus")


def lens_tolerances(folder: Path) -> list[tuple[int, str, float]]:
    """Place among the counts, name and tolerance, counts, of zoom and focus.

    Those of the standard rig where the folder has no ``rig.yaml``, or a damaged one.
    """
    rig = RigFile()
    if (folder / FILE_NAME).is_file():
        from acino_fte.rig.rig_read import read_rig

        try:
            rig = read_rig(folder / FILE_NAME)
        except InputError:
            rig = RigFile()
    return [
        (i, name, part.tolerance) for i, (name, part) in enumerate(rig.encoders.items()) if name in _RINGS
    ]
