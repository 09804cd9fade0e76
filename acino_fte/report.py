"""The report of a run: one HTML page with everything inside, that opens without a network.

Whatever comes from files (names, warnings, options) is escaped.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acino_fte.report_page import PAGE, SCRIPT, STYLE, VIEWER
from acino_fte.report_scene import scene
from acino_fte.result import Status

if TYPE_CHECKING:
    from acino_fte.result import FTEResult

_IMAGE_SCALE = 110 / 150  # figures are drawn at 150 dots per inch and shown at 110
_COLOURS = 96  # of a figure in the report, which makes it a third of the size
_REST = 0.5  # a joint at its limit for more than this share of the frames is worth a word


def write_report(result: FTEResult, folder: Path | str) -> Path:
    """Write ``report.html`` into a result folder, with the figures that are in its ``figures``.

    Parameters
    ----------
    result : FTEResult
        In whatever status it is; the colour of the headline says it.
    folder : Path
        An existing folder.

    Returns
    -------
    Path
        The page.
    """
    folder = Path(folder)
    metrics = result.metrics
    data = scene(result)
    sections = [
        _cards(metrics),
        _warnings(metrics),
        "<h2>The trajectory</h2>" + VIEWER.replace("@grid@", f"{data['grid']['step']:g}"),
        _figures(folder / "figures"),
        "<h2>Reprojection error</h2>" + _error_tables(metrics["reprojection_px"]),
        "<h2>The run</h2>" + _run_tables(metrics),
    ]
    fields = {
        "title": escape(f"{metrics['sequence']}: {metrics['species']} in 3D"),
        "style": STYLE,
        "colour": headline_colour(result.status),
        "status": escape(_headline(result.status)),
        "advice": escape(result.status.advice),
        "body": "\n".join(section for section in sections if section),
        "data": _script_json(data),
        "script": SCRIPT,
    }
    path = folder / "report.html"
    path.write_text(_fill(PAGE, fields), encoding="utf-8")
    return path


def headline_colour(status: Status) -> str:
    """``green`` for converged, ``amber`` for acceptable, ``red`` for everything that is no optimum."""
    if status is Status.CONVERGED:
        return "green"
    return "amber" if status.ok else "red"


def _headline(status: Status) -> str:
    words = str(status).replace("_", " ")
    return words.capitalize() if status.ok else f"Not converged: {words}. Not for use as it is"


def _fill(page: str, fields: Mapping[str, str]) -> str:
    """Fill ``@name@`` in one pass, so that nothing filled in is looked at again."""
    parts = page.split("@")
    return "".join(fields.get(part, f"@{part}@") if i % 2 else part for i, part in enumerate(parts))


def _script_json(value: Any) -> str:
    """JSON that can stand in a script element: no ``<``, ``>`` or ``&`` as themselves."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _cards(metrics: dict[str, Any]) -> str:
    error, seconds = metrics["reprojection_px"], metrics["seconds"]
    start, end = metrics["frames"]
    cards = [
        (number(error["median"], "px"), "median reprojection error"),
        (share(error["within_20px"]), "of the observations within 20 px"),
        (share(error["outlier_ratio"], 1), f"outliers, beyond {error['outlier_beyond_sd']:g} sd"),
        (f"{metrics['n_observations']:,}", f"observations; cameras: {metrics['n_cameras']}"),
        (f"{end - start:,}", f"frames, {start}–{end - 1}, at {metrics['fps']:g}/s"),
        (number(metrics["speed_m_s"]["body"], "m/s", 2), "median speed of the body"),
        (number(seconds["total"], "s", 2), f"in all; {number(metrics['realtime_factor'], '×', 2)} real time"),
    ]
    if "truth_mm" in metrics:
        cards.append((number(metrics["truth_mm"]["mpjpe"], "mm", 2), "mean distance to the truth"))
    items = "".join(f'<div class="card"><b>{escape(v)}</b><span>{escape(t)}</span></div>' for v, t in cards)
    return f'<div class="cards">{items}</div>'


def _warnings(metrics: dict[str, Any]) -> str:
    """What the reader of the sequence said, and what the numbers say."""
    found = list(metrics["warnings"])
    behind = metrics["reprojection_px"]["n_behind_camera"]
    if behind:
        found.append(
            f"{behind} observations are of markers that ended up behind the camera that saw them. "
            "Check the calibration, and that every keypoint file belongs to its camera."
        )
    if metrics["n_frames_unobserved"]:
        found.append(
            f"{metrics['n_frames_unobserved']} frames have no observation at all; "
            "there the trajectory is the motion model's alone."
        )
    resting = [name for name, part in metrics["joints_at_limit"].items() if part > _REST]
    if resting:
        found.append(
            f"At their limit in more than {_REST:.0%} of the frames: {', '.join(resting)}. "
            "Check their ranges, the segment lengths, and left and right of the markers."
        )
    if metrics["joints_outside_limits"]:
        found.append(f"Outside their limits: {', '.join(metrics['joints_outside_limits'])}.")
    items = "".join(f"<li>{escape(str(text))}</li>" for text in found)
    return f'<ul class="warnings">{items}</ul>' if items else ""


def _figures(folder: Path) -> str:
    """The figures that are there, embedded; the PDF beside the page is linked."""
    from acino_fte.plots import FIGURES

    shown = []
    for name, (caption, _) in FIGURES.items():
        path = folder / f"{name}.png"
        if path.is_file():
            image = base64.b64encode(_shrink(path)).decode("ascii")
            shown.append(
                f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{image}">'
                f'<figcaption>{escape(caption)} (<a href="figures/{name}.pdf">PDF</a>)</figcaption></figure>'
            )
    return "<h2>Figures</h2>" + "\n".join(shown) if shown else ""


def _shrink(path: Path) -> bytes:
    """The image at 110 dots per inch with a palette, as PNG."""
    from PIL import Image

    with Image.open(path) as image:
        size = (round(image.width * _IMAGE_SCALE), round(image.height * _IMAGE_SCALE))
        small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    buffer = BytesIO()
    small.quantize(_COLOURS, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=False)
    return buffer.getvalue()


def _error_tables(error: dict[str, Any]) -> str:
    head = ("", "median (px)", "mean (px)", "p90 (px)", "within 20 px", "n")
    overall = [("median", error["median"]), ("mean", error["mean"]), ("RMSE", error["rmse"])]
    overall += [("standard deviation", error["std"]), ("90th percentile", error["p90"])]
    rows = [(name, number(value, "px", 2)) for name, value in overall]
    rows += [("within 20 px", share(error["within_20px"], 1))]
    rows += [(f"beyond {error['outlier_beyond_sd']:g} sd", share(error["outlier_ratio"], 1))]
    rows += [("behind the camera", f"{error['n_behind_camera']:,}")]
    tables = [_table("All observations", ("", ""), rows)]
    for key, caption in (("per_camera", "By camera"), ("per_marker", "By marker")):
        lines = [
            (
                name,
                *(number(part[k], "", 1) for k in ("median", "mean", "p90")),
                share(part["within_20px"]),
                f"{part['n']:,}",
            )
            for name, part in error[key].items()
        ]
        bad = {name for name, part in error[key].items() if (part["within_20px"] or 0.0) < 0.5}
        tables.append(_table(caption + "; shaded: under half within 20 px", head, lines, bad))
    return f'<div class="tables">{"".join(tables)}</div>'


def _run_tables(metrics: dict[str, Any]) -> str:
    facts = [(key, metrics[key]) for key in ("status", "method", "version", "iterations", "n_markers")]
    facts.append(("objective", number(metrics["objective"], "", 4)))
    facts += [(f"truth: {key}", number(v, "mm", 2)) for key, v in metrics.get("truth_mm", {}).items()]
    times = [(key, number(value, "s", 3)) for key, value in metrics["seconds"].items()]
    limits = [(name, share(part)) for name, part in metrics["joints_at_limit"].items()]
    tables = [_table("Result", ("", ""), facts), _table("Time", ("", ""), times)]
    if limits:
        tables.append(_table("At a limit, share of the frames", ("", ""), limits))
    for key, caption in (("parameters", "Estimated parameters"), ("options", "Options")):
        rows = list(_flat(metrics[key]))
        if rows:
            tables.append(_table(caption, ("", ""), rows))
    return f'<div class="tables">{"".join(tables)}</div>'


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, str]]:
    """Nested options as rows ``solve.max_iter``, value."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _table(caption: str, head: Iterable[str], rows: Iterable[Iterable[Any]], bad: Iterable[str] = ()) -> str:
    """An HTML table; rows whose first cell is in ``bad`` are shaded."""
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    start = f"<thead><tr>{titles}</tr></thead>" if any(head) else ""
    marked = set(bad)
    lines = []
    for first, *rest in rows:
        cells = "".join(_cell(str(cell), first in marked) for cell in rest)
        lines.append(f"<tr><td>{escape(str(first))}</td>{cells}</tr>")
    return f"<table><caption>{escape(caption)}</caption>{start}<tbody>{''.join(lines)}</tbody></table>"


def _cell(text: str, bad: bool) -> str:
    kind = ' class="bad"' if bad else ' class="text"' if len(text) > 24 else ""
    return f"<td{kind}>{escape(text)}</td>"


def number(value: float | None, unit: str, digits: int = 1) -> str:
    """``12.3 px``; a dash when undefined."""
    return "–" if value is None else f"{value:,.{digits}f} {unit}".rstrip()


def share(value: float | None, digits: int = 0) -> str:
    """``76 %``; a dash when undefined."""
    return "–" if value is None else f"{100 * value:.{digits}f} %"
