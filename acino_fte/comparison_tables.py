r"""The table of a comparison as CSV, JSON, Markdown, LaTeX and plain text.

Columns that no row has a number for are left out of everything but the CSV, whose columns are always the
same. Text from files (names of sequences) is escaped for where it goes.
"""

from __future__ import annotations

from itertools import groupby
from typing import Any

import pandas as pd

from acino_fte.comparison import COLUMNS, Block, Column, Row

_LATEX = {
    "\\": r"\textbackslash{}",
    **{c: f"\\{c}" for c in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "–": "--",
    "½": r"$\frac{1}{2}$",
    "\n": " ",
}
_MARKDOWN = {"|": r"\|", "<": "&lt;", ">": "&gt;", "*": r"\*", "_": r"\_", "`": r"\`", "\n": " "}


def shown_columns(blocks: list[Block]) -> list[Column]:
    """Columns that some row has a number for."""
    rows = [row for block in blocks for row in block.rows]
    return [column for column in COLUMNS if any(row.numbers.get(column.name) is not None for row in rows)]


def table(blocks: list[Block]) -> pd.DataFrame:
    """One row for a variant on a sequence; columns as in :data:`acino_fte.comparison.COLUMNS`.

    Numbers as they are: px, mm, s, and shares between 0 and 1; empty where undefined.
    """
    lines = [
        {
            "sequence": block.name,
            "method": row.variant.name,
            "status": row.status,
            "n_detections": block.facts.get("n_detections"),
            **row.numbers,
            "note": "; ".join(row.notes),
        }
        for block in blocks
        for row in block.rows
    ]
    return pd.DataFrame(lines).astype({"n_detections": "Int64"})


def as_json(blocks: list[Block], mean: Block | None, options: dict[str, Any]) -> dict[str, Any]:
    """Everything about a comparison: options, every method's metrics by sequence, and the means."""
    from acino_fte import __version__
    from acino_fte.metrics import json_safe

    variants = {row.variant.name: row.variant for block in blocks for row in block.rows}
    found: dict[str, Any] = {
        "version": __version__,
        "options": options,
        "methods": {name: {"title": v.title, "does": v.does} for name, v in variants.items()},
        "sequences": {
            block.name: {
                **block.facts,
                "methods": {
                    row.variant.name: {**row.metrics, "notes": list(row.notes)}
                    if row.metrics
                    else {"status": row.status, "reason": str(row.error or "")}
                    for row in block.rows
                },
            }
            for block in blocks
        },
    }
    if mean is not None:
        found["mean"] = {row.variant.name: {**row.numbers, "notes": list(row.notes)} for row in mean.rows}
    return json_safe(found)


def markdown(blocks: list[Block]) -> str:
    """A table for every block, with what the methods are below."""
    columns = shown_columns(blocks)
    heads = [column.full for column in columns]
    lines = ["# Comparison of methods", ""]
    for block in blocks:
        lines += [f"## {_escaped(block.name, _MARKDOWN)}", "", f"{_escaped(block.about, _MARKDOWN)}.", ""]
        lines.append(f"| method | {' | '.join(heads)} |")
        lines.append(f"|---|{'--:|' * len(columns)}")
        for row in block.rows:
            cells = [column.shown(row.numbers[column.name]) for column in columns]
            if row.refused:
                cells = [_escaped("; ".join(row.notes), _MARKDOWN), *[""] * (len(columns) - 1)]
            lines.append(f"| {' | '.join([_escaped(_starred(row), _MARKDOWN), *cells])} |")
        notes = [f"- * {note}" for note in _footnotes(block)]
        lines += ["", *(_escaped(note, _MARKDOWN) for note in notes), *([""] if notes else [])]
    lines += [f"- **{v.title}** (`{v.name}`): {v.does}" for v in _variants(blocks)]
    return "\n".join(lines) + "\n"


def latex(blocks: list[Block]) -> str:
    r"""One ``tabular`` for ``\input``; it needs the package booktabs and nothing else."""
    columns = shown_columns(blocks)
    last = len(columns) + 1
    lines = [
        r"% Needs \usepackage{booktabs}. Wide: set it in a table* with \footnotesize, or in a sidewaystable.",
        *(f"% {v.title}: {v.does}" for v in _variants(blocks)),
        rf"\begin{{tabular}}{{l{'r' * len(columns)}}}",
        r"\toprule",
        *_latex_heads(columns),
    ]
    for block in blocks:
        if len(blocks) > 1:
            title = f"{block.name}: {block.about}"
            lines += [r"\midrule", rf"\multicolumn{{{last}}}{{l}}{{\itshape {_tex(title)}}} \\"]
        lines.append(r"\midrule")
        lines += [_latex_row(row, columns) for row in block.rows]
    notes = [f"* {block.name}: {note}" for block in blocks for note in _footnotes(block)]
    below = [rf"\multicolumn{{{last}}}{{l}}{{{_tex(note)}}} \\" for note in notes]
    return "\n".join([*lines, r"\bottomrule", *below, r"\end{tabular}"]) + "\n"


def _starred(row: Row) -> str:
    """Title of a row, with a star when a note belongs to it."""
    return f"{row.title} *" if row.notes and not row.refused else row.title


def _footnotes(block: Block) -> list[str]:
    return [f"{row.variant.title}: {note}" for row in block.rows if not row.refused for note in row.notes]


def _latex_heads(columns: list[Column]) -> list[str]:
    """Groups with a rule under each, and titles with units."""
    groups, rules, at = [], [], 2
    for name, members in groupby(columns, key=lambda column: column.group):
        width = len(list(members))
        groups.append(rf"\multicolumn{{{width}}}{{c}}{{{_tex(name)}}}")
        rules.append(rf"\cmidrule(lr){{{at}-{at + width - 1}}}")
        at += width
    heads = " & ".join(_tex(column.head) for column in columns)
    return [rf" & {' & '.join(groups)} \\", " ".join(rules), rf"Method & {heads} \\"]


def _latex_row(row: Row, columns: list[Column]) -> str:
    if row.refused:
        why = _tex(f"refused: {'; '.join(row.notes)}")
        return rf"{_tex(row.variant.title)} & \multicolumn{{{len(columns)}}}{{l}}{{{why}}} \\"
    cells = " & ".join(_tex(column.shown(row.numbers[column.name])) for column in columns)
    return rf"{_tex(_starred(row))} & {cells} \\"


def plain(blocks: list[Block]) -> list[str]:
    """Lines for a terminal: a line a column and a column a method, which fits where a wide table does not."""
    columns = shown_columns(blocks)
    left = max((len(column.head) for column in columns), default=0) + 4
    lines = []
    for block in blocks:
        titles = [row.variant.title for row in block.rows]
        widths = [max(8, len(title)) for title in titles]
        lines += [f"{block.name}: {block.about}", " " * left + _cells(titles, widths)]
        for group, members in groupby(columns, key=lambda column: column.group):
            lines.append(group)
            for column in members:
                values = [column.shown(row.numbers[column.name]) for row in block.rows]
                lines.append(f"  {column.head}".ljust(left) + _cells(values, widths))
        lines += [f"{row.title}: {'; '.join(row.notes)}" for row in block.rows if row.notes]
        lines += [row.title for row in block.rows if row.unconverged and not row.notes]
        lines.append("")
    return lines


def _cells(texts: list[str], widths: list[int]) -> str:
    return "".join(f"  {text:>{width}}" for text, width in zip(texts, widths, strict=True))


def _variants(blocks: list[Block]) -> list[Any]:
    return list(dict.fromkeys(row.variant for block in blocks for row in block.rows))


def _tex(text: str) -> str:
    return _escaped(text, _LATEX)


def _escaped(text: str, table: dict[str, str]) -> str:
    return "".join(table.get(character, character) for character in text)
