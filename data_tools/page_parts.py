"""Pieces of the reports of matchings and scenes: one HTML page with everything inside, that opens without a
network. Whatever comes from files (names, warnings) is escaped.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.scene_viewer import SCRIPT
from acino_fte.report_page import PAGE, STYLE

_TYPES = {"f": "f4", "i": "i4", "u": "u1"}


def write_page(
    path: Path,
    *,
    title: str,
    status: str,
    advice: str,
    colour: str,
    sections: Iterable[str],
    data: Mapping[str, Any],
) -> Path:
    """Write a report.

    Parameters
    ----------
    path : Path
        The file.
    title, status, advice : str
        Of the header; plain text.
    colour : {"green", "amber", "red"}
        Of the header.
    sections : iterable of str
        HTML; empty ones are left out.
    data : mapping
        What the viewer shows; see :mod:`~acino_fte.data_tools.scene_viewer`.
    """
    fields = {
        "title": escape(title),
        "style": STYLE,
        "colour": colour,
        "status": escape(status),
        "advice": escape(advice),
        "body": "\n".join(section for section in sections if section),
        "data": script_json(data),
        "script": SCRIPT,
    }
    parts = PAGE.split("@")
    page = "".join(fields.get(part, f"@{part}@") if i % 2 else part for i, part in enumerate(parts))
    path.write_text(page, encoding="utf-8")
    return path


def script_json(value: Any) -> str:
    """JSON that can stand in a script element: no ``<``, ``>`` or ``&`` as themselves.

    Arrays are packed: floats as float32, signed integers as int32, others as bytes, in base64. That is half
    the size of numbers as text, and takes a hundredth of the time.
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"), default=_packed)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _packed(array: Any) -> dict[str, str]:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in _TYPES:
        raise TypeError(f"{type(array).__name__} has no place in a page")
    kind = _TYPES[array.dtype.kind]
    content = np.ascontiguousarray(array, dtype=f"<{kind}").tobytes()
    return {"packed": base64.b64encode(content).decode("ascii"), "type": kind}


def cards(entries: Iterable[tuple[str, str]]) -> str:
    """Numbers in large letters: (number, what it is)."""
    items = "".join(f'<div class="card"><b>{escape(v)}</b><span>{escape(t)}</span></div>' for v, t in entries)
    return f'<div class="cards">{items}</div>'


def warning_list(warnings: Iterable[str]) -> str:
    """A list of warnings; nothing without any."""
    items = "".join(f"<li>{escape(text)}</li>" for text in warnings)
    return f'<ul class="warnings">{items}</ul>' if items else ""


def figure_list(captions: Mapping[str, str], folder: Path) -> str:
    """The figures that are there, embedded; the PDF beside the page is linked.

    Parameters
    ----------
    captions : mapping of str to str
        File name (without its ending) → what it shows.
    folder : Path
        With the images.
    """
    shown = []
    for name, caption in captions.items():
        path = folder / f"{name}.png"
        if path.is_file():
            image = base64.b64encode(path.read_bytes()).decode("ascii")
            shown.append(
                f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{image}">'
                f'<figcaption>{escape(caption)} (<a href="figures/{name}.pdf">PDF</a>)</figcaption></figure>'
            )
    return "<h2>Figures</h2>" + "\n".join(shown) if shown else ""


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of texts."""
    top = "".join(f"<th>{escape(text)}</th>" for text in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(v)}</td>" for v in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def number(value: float | None, unit: str = "", digits: int = 2) -> str:
    """A number with its unit; a dash for none."""
    return "–" if value is None else f"{value:.{digits}f} {unit}".strip()


def share(value: float | None, digits: int = 1) -> str:
    """A share in per cent; a dash for none."""
    return "–" if value is None else f"{value:.{digits}%}"
