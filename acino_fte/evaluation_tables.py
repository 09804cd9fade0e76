r"""The tables of an evaluation as CSV, Markdown and LaTeX: a row for a run, a body part, a marker.

The CSV has all rows with numbers as they are (px, m, shares between 0 and 1). The tables for reading have a
section for each level; text from files is escaped for where it goes.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

from acino_fte.evaluation_statistics import LEVELS, Threshold

_LATEX = {
    "\\": r"\textbackslash{}",
    **{c: f"\\{c}" for c in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "−": "$-$",
    "–": "--",
    "†": r"\textdagger{}",
    "\n": " ",
}
_MARKDOWN = {"|": r"\|", "<": "&lt;", ">": "&gt;", "*": r"\*", "_": r"\_", "`": r"\`", "\n": " "}
_TITLES = {"run": "Runs", "part": "Body parts", "marker": "Markers"}
_HEADS = {"run": "Run", "part": "Body part", "marker": "Marker"}
DAGGER = "†"


@dataclass(frozen=True)
class Column:
    """A column: key in the rows, title, and how a number is shown (factor, digits, sign)."""

    key: str
    title: str
    digits: int = 1
    factor: float = 1.0
    sign: bool = False

    def shown(self, row: dict[str, Any]) -> str:
        """The cell of a row; a dash where it has no number."""
        value = row[self.key]
        if value is None:
            return "–"
        if isinstance(value, int):
            return f"{value}"
        text = f"{self.factor * value:{'+' if self.sign else ''}.{self.digits}f}"
        return text.replace("-", "−")


@dataclass(frozen=True)
class Table:
    """A table: rows by level, how to show them, and what the numbers are."""

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: list[dict[str, Any]]
    notes: tuple[str, ...]
    marked: frozenset[str] = field(default=frozenset())

    def level(self, level: str) -> list[dict[str, Any]]:
        """The rows of a level."""
        return [row for row in self.rows if row["level"] == level]

    def label(self, run: str) -> str:
        """Name of a run, with a dagger when it did not converge."""
        return run + DAGGER if run in self.marked else run


def error_table(rows: list[dict[str, Any]], threshold: Threshold, marked: Iterable[str] = ()) -> Table:
    """Reprojection error of runs."""
    what = sorted({row["of"] for row in rows})
    against = {"labels": "hand labels", "detections": "the detections that the run used"}
    columns = (
        Column("n", "n"),
        Column("mean_u", "mean u (px)", 1, sign=True),
        Column("sd_u", "SD u (px)"),
        Column("mean_v", "mean v (px)", 1, sign=True),
        Column("sd_v", "SD v (px)"),
        Column("mean", "mean abs. (px)"),
        Column("sd", "SD abs. (px)"),
        Column("rmse", "RMSE (px)"),
        Column("outlier_ratio", f"beyond {threshold} (%)", 1, 100.0),
    )
    of = {row["run"]: against[row["of"]] for row in rows}
    notes = [f"Signed u, v: reprojected − labelled. Outlier: an absolute error beyond {threshold}"]
    notes[0] += " of the marker's detections (sd_px of the species)." if threshold.unit == "sd" else "."
    if len(what) == 1:
        notes.append(f"Against {against[what[0]]}.")
    else:
        notes += [f"{run}: against {text}." for run, text in of.items()]
    behind = sum(row["n_behind"] for row in rows if row["level"] == "run")
    if behind:
        notes.append(f"{behind} behind the camera: outliers, left out of means, SD and RMSE.")
    return Table("reprojection", "Reprojection error", columns, rows, tuple(notes), frozenset(marked))


def move_table(rows: list[dict[str, Any]], checked: dict[str, int], marked: Iterable[str] = ()) -> Table:
    """Adjustments by hand. ``checked`` is the number of frames that were marked as checked, by run."""
    columns = (
        Column("n", "positions"),
        Column("n_adjusted", "adjusted"),
        Column("adjusted", "adjusted (%)", 1, 100.0),
        Column("rmse", "RMSE (cm)", 2, 100.0),
        Column("sd", "SD (cm)", 2, 100.0),
        Column("mean", "mean (cm)", 2, 100.0),
        Column("max", "max (cm)", 2, 100.0),
    )
    notes = ["RMSE, SD, mean, max: lengths of the adjustments in 3D, over the positions that were adjusted."]
    for run, n in checked.items():
        which = f"the {n} frames marked as checked" if n else "all frames of the run"
        notes.append(f"{run}: positions of {which}.")
    return Table("adjustments", "Adjustments by hand in 3D", columns, rows, tuple(notes), frozenset(marked))


def depth_table(rows: list[dict[str, Any]], marked: Iterable[str] = ()) -> Table:
    """Depth residuals of runs with a lidar."""
    columns = (
        Column("n", "n"),
        Column("mean", "mean (cm)", 2, 100.0, sign=True),
        Column("median", "median (cm)", 2, 100.0, sign=True),
        Column("sd", "SD (cm)", 2, 100.0),
        Column("rmse", "RMSE (cm)", 2, 100.0),
    )
    notes = ("Depth of the trajectory's surface − depth measured by the lidar, along the camera's axis.",)
    return Table("depth", "Depth residuals", columns, rows, notes, frozenset(marked))


def as_csv(table: Table) -> str:
    """All rows, numbers in full; empty where undefined."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(table.rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table.rows)
    return text.getvalue()


def markdown(table: Table) -> str:
    """A section for every level."""
    lines = [f"# {table.title}", "", *(_escaped(note, _MARKDOWN) + "  " for note in table.notes)]
    if table.marked:
        lines.append(f"{DAGGER} did not converge.  ")
    for level in LEVELS:
        rows = table.level(level)
        if not rows:
            continue
        heads = [_HEADS["run"]] + ([_HEADS[level]] if level != "run" else [])
        lines += ["", f"## {_TITLES[level]}", ""]
        lines.append(f"| {' | '.join([*heads, *(c.title for c in table.columns)])} |")
        lines.append("|" + "---|" * len(heads) + "--:|" * len(table.columns))
        for row in rows:
            names = [table.label(row["run"])] + ([row["name"]] if level != "run" else [])
            cells = [_escaped(name, _MARKDOWN) for name in names] + [c.shown(row) for c in table.columns]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def latex(table: Table, level: str) -> str:
    r"""One ``tabular`` of a level for ``\input``; it needs the package booktabs and nothing else."""
    columns = table.columns
    width = len(columns) + 1
    heads = " & ".join(_tex(column.title) for column in columns)
    lines = [
        rf"% {_comment(table.title)}. Needs \usepackage{{booktabs}}.",
        *(f"% {_comment(note)}" for note in table.notes),
        rf"\begin{{tabular}}{{l{'r' * len(columns)}}}",
        r"\toprule",
        rf"{_HEADS[level]} & {heads} \\",
    ]
    if level == "run":
        lines.append(r"\midrule")
    for run, rows in groupby(table.level(level), key=lambda row: row["run"]):
        if level != "run":
            title = _tex(table.label(run))
            lines += [r"\midrule", rf"\multicolumn{{{width}}}{{l}}{{\itshape {title}}} \\"]
        for row in rows:
            name = table.label(run) if level == "run" else row["name"]
            cells = " & ".join(_tex(column.shown(row)) for column in columns)
            lines.append(rf"{_tex(name)} & {cells} \\")
    below = [rf"\multicolumn{{{width}}}{{l}}{{{_tex(DAGGER)} did not converge}} \\"] if table.marked else []
    return "\n".join([*lines, r"\bottomrule", *below, r"\end{tabular}"]) + "\n"


def plain(table: Table) -> list[str]:
    """The rows of whole runs, for a terminal."""
    rows = table.level("run")
    names = [table.label(row["run"]) for row in rows]
    left = max(len(c.title) for c in table.columns) + 2
    lines = [table.title, " " * left + "".join(f"  {name:>{max(8, len(name))}}" for name in names)]
    for column in table.columns:
        cells = (f"  {column.shown(row):>{max(8, len(n))}}" for row, n in zip(rows, names, strict=True))
        lines.append(column.title.ljust(left) + "".join(cells))
    return lines


def _tex(text: str) -> str:
    return _escaped(text, _LATEX)


def _comment(text: str) -> str:
    return text.replace("\n", " ")


def _escaped(text: str, table: dict[str, str]) -> str:
    return "".join(table.get(character, character) for character in text)
