"""What trackers leave in a folder, and which files of a folder may hold tracks at all."""

from __future__ import annotations

import re
from pathlib import Path

from acino_fte.data_tools.tracker_exports import exporter, session_file

TABLES = (".csv", ".tsv", ".h5", ".hdf5", ".npz", ".npy")
NO_TRACKS = re.compile(r".*(_truth|xyzpts|xyzres|xyzci|xyzfilt|offsets)|truth_3d.*", re.IGNORECASE)


def export_files(folder: Path) -> list[Path]:
    """What a tracker left in a folder: the session of idtracker.ai, or TRex's files; else nothing."""
    session = session_file(folder)
    if session is not None:
        return [session]
    for place in (folder, folder / "data"):
        found = sorted(
            p for ending in ("npz", "csv") for p in place.glob(f"*.{ending}") if exporter(p) == "trex"
        )
        if found:
            return [p for p in found if p.suffix == found[-1].suffix]
    return []
