"""The report of a run: one HTML page with everything inside, that opens without a network.

Whatever comes from files (names, warnings, findings) is escaped. The tables are in
:mod:`acino_fte.report_tables`.
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
from acino_fte.report_tables import (
    error_tables,
    heldout_cards,
    heldout_section,
    number,
    parameter_section,
    run_tables,
    share,
    uncertainty_section,
)
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
    usual_px = {marker.name: marker.sd_px for marker in result.skeleton.markers}
    sections = [
        _cards(metrics),
        _findings(metrics["findings"]),
        _warnings(metrics),
        "<h2>The trajectory</h2>" + VIEWER.replace("@grid@", f"{data['grid']['step']:g}"),
        _figures(folder / "figures"),
        "<h2>Reprojection error</h2>" + error_tables(metrics["reprojection_px"]),
        heldout_section(metrics),
        parameter_section(result.parameters, metrics.get("parameter_errors", {}), usual_px),
        uncertainty_section(metrics.get("uncertainty", {}), metrics.get("truth_mm", {})),
        "<h2>The run</h2>" + run_tables(metrics),
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
    if "uncertainty" in metrics:
        cards.append((number(metrics["uncertainty"]["median_sd_mm"], "mm"), "median sd of a marker"))
    if (error["coverage"] or 0.0) < 1.0:
        cards.append((share(error["coverage"]), "of the observed markers have a position"))
    if "truth_mm" in metrics:
        cards.append((number(metrics["truth_mm"]["mpjpe"], "mm", 2), "mean distance to the truth"))
    cards += heldout_cards(metrics)
    items = "".join(f'<div class="card"><b>{escape(v)}</b><span>{escape(t)}</span></div>' for v, t in cards)
    return f'<div class="cards">{items}</div>'


def _findings(findings: Iterable[str]) -> str:
    """What the estimate noticed about the recording."""
    items = "".join(f"<li>{escape(str(text))}</li>" for text in findings)
    return f'<h2>What the estimate found</h2><ul class="findings">{items}</ul>' if items else ""


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
