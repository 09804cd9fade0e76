"""Adjustments on disk: a JSON file that belongs to one run, and the adjusted trajectory as CSV.

The file knows its run by the SHA-256 of the run's ``fte.nc``. It is written whole after every change: to a
temporary file beside it, which then takes its name.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from acino_fte.adjustments import Adjustment, Adjustments
from acino_fte.errors import InputError
from acino_fte.evaluation_runs import Run

FORMAT = "acino-fte/adjustments/1"
_SAME = 1e-6  # m


class _RunEntry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    sequence: str = ""
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class _File(BaseModel):
    """The content of a file of adjustments."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["acino-fte/adjustments/1"]
    run: _RunEntry
    checked: list[int] = Field(default_factory=list)
    adjustments: list[Adjustment] = Field(default_factory=list)


def adjustments_path(run: Run) -> Path:
    """Where the adjustments of a run are by default: beside its folder."""
    folder = run.folder.resolve()
    return folder.with_name(f"{folder.name}.adjustments.json")


def read_adjustments(path: Path | str, runs: list[Run]) -> Adjustments:
    """Read a file of adjustments of one of the runs.

    Raises
    ------
    InputError
        The file is missing, damaged or of another kind, belongs to none of the runs, or has a frame or a
        marker that the run has not.
    """
    path = Path(path).expanduser()
    file = _validated(path)
    run = next((run for run in runs if run.identity == file.run.sha256), None)
    if run is None:
        raise InputError(
            "The adjustments belong to another run.",
            file=path,
            key="run.sha256",
            expected=" or ".join(f"{run.identity[:12]}… ({run.folder})" for run in runs),
            found=f"{file.run.sha256[:12]}… (a run called '{file.run.name}')",
            remedy="give the run they were made on; if that was run again since, its numbers are others, "
            "and the adjustments have to be made anew",
        )
    document = Adjustments(run, checked=set(file.checked))
    frames = {int(frame) for frame in run.frames}
    for entry in file.adjustments:
        if entry.frame not in frames or entry.marker not in run.markers:
            raise _wrong(path, entry, "a frame and a marker of the run", "not in the run")
        if (entry.frame, entry.marker) in document.entries:
            raise _wrong(path, entry, "every marker once in a frame", "twice")
        own = document.before(entry.frame, entry.marker)
        if (own is None) != (entry.before is None) or (
            own is not None
            and entry.before is not None
            and np.abs(np.subtract(own, entry.before)).max() > _SAME
        ):
            raise _wrong(path, entry, f"before = {own}, as the run has it", f"before = {entry.before}")
        document.entries[entry.frame, entry.marker] = entry
    strange = sorted(document.checked - frames)
    if strange:
        raise InputError(
            "The adjustments have a checked frame that the run has not.",
            file=path,
            key="checked",
            expected=f"frames {run.frames[0]} to {run.frames[-1]}",
            found=f"{strange[0]}",
            remedy="take it out of the file",
        )
    return document


def _wrong(path: Path, entry: Adjustment, expected: str, found: str) -> InputError:
    return InputError(
        "An adjustment does not fit the run.",
        file=path,
        key=f"frame {entry.frame}, {entry.marker}",
        expected=expected,
        found=found,
        remedy="take it out of the file; it was edited by hand",
    )


def _validated(path: Path) -> _File:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            "The file of adjustments does not exist.", file=path, remedy="check the path"
        ) from None
    except (ValueError, OSError) as error:
        raise InputError(
            "The file of adjustments cannot be read.",
            file=path,
            expected=f"JSON of the format {FORMAT}",
            found=str(error),
            remedy="give the file that 'acino-fte adjust' wrote",
        ) from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(
            "This is no file of adjustments that this version reads.",
            file=path,
            key="format",
            expected=FORMAT,
            found=repr(data.get("format")) if isinstance(data, dict) else type(data).__name__,
            remedy="give the file that 'acino-fte adjust' wrote",
        )
    try:
        return _File.model_validate(data)
    except ValidationError as error:
        from acino_fte.species_file import validation_message

        place, text = validation_message(error, _File)
        raise InputError(
            f"The file of adjustments has a fault at '{place}': {text}.",
            file=path,
            key=place,
            remedy="mend that key",
        ) from None


def as_text(document: Adjustments) -> str:
    """The file, with an entry a line, in the order of frames."""
    run = document.run
    places = {name: m for m, name in enumerate(run.markers)}
    entries = sorted(document.entries.values(), key=lambda e: (e.frame, places[e.marker]))
    head = {
        "format": FORMAT,
        "run": {"name": run.name, "sequence": run.sequence, "sha256": run.identity},
        "checked": sorted(document.checked),
    }
    lines = [f"  {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}," for key, value in head.items()]
    rows = ",\n".join(
        f"    {json.dumps(entry.model_dump(mode='json'), ensure_ascii=False)}" for entry in entries
    )
    body = f'  "adjustments": [\n{rows}\n  ]' if rows else '  "adjustments": []'
    return "\n".join(["{", *lines, body, "}"]) + "\n"


def positions_csv(document: Adjustments) -> str:
    """The adjusted trajectory: frame, time_s, marker, x, y, z (m, world frame), adjusted (0 or 1), moved_m.

    A marker without a position has empty cells; ``moved_m`` is empty where nothing was adjusted.
    """
    run, positions = document.run, document.positions()
    lines = ["frame,time_s,marker,x,y,z,adjusted,moved_m"]
    for n, frame in enumerate(run.frames):
        for m, marker in enumerate(run.markers):
            xyz = positions[n, m]
            cells = [f"{v:.6f}" for v in xyz] if np.isfinite(xyz).all() else ["", "", ""]
            entry = document.entries.get((int(frame), marker))
            moved = f"{entry.length:.6f}" if entry is not None and entry.before is not None else ""
            quoted = marker if not set(marker) & set('",\n') else '"' + marker.replace('"', '""') + '"'
            lines.append(
                f"{frame},{frame / run.fps:.6f},{quoted},{','.join(cells)},{int(entry is not None)},{moved}"
            )
    return "\n".join(lines) + "\n"
