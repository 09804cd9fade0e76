"""An evaluation on disk: tables, numbers and figures in one folder, whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from acino_fte.errors import InputError
from acino_fte.evaluation_statistics import (
    LEVELS,
    Errors,
    Moves,
    Threshold,
    depth_rows,
    error_rows,
    move_rows,
)
from acino_fte.evaluation_tables import Table, as_csv, depth_table, error_table, latex, markdown, move_table
from acino_fte.metrics import json_safe
from acino_fte.result_files import Contents, written_whole

_TABLES = ("reprojection", "adjustments", "depth")
_ENDINGS = (".csv", ".md", ".tex", "_parts.tex", "_markers.tex")
EVALUATION = Contents(
    "comparison of runs",
    ("evaluation.json", "figures", *(name + ending for name in _TABLES for ending in _ENDINGS)),
    ("evaluation.json", "reprojection.csv"),
)
"""What the folder of an evaluation holds."""


def evaluation_tables(errors: Sequence[Errors], threshold: Threshold, moves: Sequence[Moves]) -> list[Table]:
    """The tables there is something for."""
    runs = [e.run for e in errors]
    loose = {run.name for run in runs if not run.converged}
    tables = [error_table([row for e in errors for row in error_rows(e, threshold)], threshold, loose)]
    if moves:
        checked = {m.run.name: int(m.looked_at.any(axis=1).sum()) if m.checked else 0 for m in moves}
        rows = [row for m in moves for row in move_rows(m)]
        tables.append(move_table(rows, checked, loose & set(checked)))
    deep = [run for run in runs if run.has_depth]
    if deep:
        tables.append(
            depth_table([row for run in deep for row in depth_rows(run)], loose & {run.name for run in deep})
        )
    return tables


def save_evaluation(
    errors: Sequence[Errors],
    threshold: Threshold,
    moves: Sequence[Moves],
    notes: Sequence[str],
    folder: Path,
    *,
    figures: bool = True,
) -> list[Table]:
    """Write an evaluation into a folder that :func:`acino_fte.result_files.check_output_folder` has passed.

    Parameters
    ----------
    errors : sequence of Errors
        One a run.
    threshold : Threshold
        For outliers.
    moves : sequence of Moves
        Of the runs that were adjusted.
    notes : sequence of str
        What was left out, for the record.
    folder : Path
        An earlier evaluation there is replaced.
    figures : bool
        Whether to draw.

    Returns
    -------
    list of Table

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    tables = evaluation_tables(errors, threshold, moves)
    record = _record(errors, threshold, tables, notes)
    try:
        with written_whole(folder, EVALUATION) as working:
            for table in tables:
                _write_table(table, working)
            text = json.dumps(json_safe(record), indent=2, ensure_ascii=False, allow_nan=False)
            (working / "evaluation.json").write_text(text + "\n", encoding="utf-8")
            if figures:
                from acino_fte.evaluation_figures import save_evaluation_figures

                deep = [e.run for e in errors if e.run.depth_residual is not None]
                save_evaluation_figures(errors, threshold, moves, deep, working / "figures")
    except OSError as error:
        raise InputError(
            "The evaluation cannot be written.",
            file=folder,
            found=error.strerror or str(error),
            remedy="free some space or choose another folder with -o, and run again",
        ) from None
    return tables


def _write_table(table: Table, folder: Path) -> None:
    (folder / f"{table.name}.csv").write_text(as_csv(table), encoding="utf-8")
    (folder / f"{table.name}.md").write_text(markdown(table), encoding="utf-8")
    for level, ending in zip(LEVELS, ("", "_parts", "_markers"), strict=True):
        if table.level(level):
            (folder / f"{table.name}{ending}.tex").write_text(latex(table, level), encoding="utf-8")


def _record(
    errors: Sequence[Errors], threshold: Threshold, tables: Sequence[Table], notes: Sequence[str]
) -> dict[str, Any]:
    from acino_fte import __version__

    return {
        "version": __version__,
        "threshold": {"value": threshold.value, "unit": threshold.unit},
        "runs": {
            e.run.name: {
                "folder": str(e.run.folder.resolve()),
                "identity": e.run.identity,
                "sequence": e.run.sequence,
                "method": e.run.metrics.get("method"),
                "status": e.run.metrics.get("status"),
                "compared_with": e.of,
                "n_without_position": e.n_missing,
            }
            for e in errors
        },
        "tables": {table.name: table.rows for table in tables},
        "notes": list(notes),
    }
