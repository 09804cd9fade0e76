"""Tables of the report as HTML: errors, the run, estimated parameters and uncertainty.

Whatever comes from files (names, options) is escaped.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

import numpy as np

from acino_fte.ladder_table import rung_titles
from acino_fte.parameter_table import ParameterTable, parameter_tables

_LEFT_OUT = (("heldout_px", "cross-fitted"), ("heldout_nominal_px", "nominal"))
_ERROR_UNITS = {"time_offset_ms": "ms", "marker_offset_mm": "mm", "position_mm": "mm", "rotation_deg": "°"}


def error_tables(error: Mapping[str, Any]) -> str:
    """Reprojection errors: over everything, by camera, by marker."""
    head = ("", "median (px)", "mean (px)", "p90 (px)", "within 20 px", "n")
    overall = [("median", error["median"]), ("mean", error["mean"]), ("RMSE", error["rmse"])]
    overall += [("standard deviation", error["std"]), ("90th percentile", error["p90"])]
    rows = [(name, number(value, "px", 2)) for name, value in overall]
    rows += [("within 20 px", share(error["within_20px"], 1))]
    if "pck_nose_eye" in error:
        rows += [("within half the nose–eye distance", share(error["pck_nose_eye"], 1))]
    rows += [("observed markers with a position", share(error["coverage"], 1))]
    rows += [(f"beyond {error['outlier_beyond_sd']:g} sd", share(error["outlier_ratio"], 1))]
    rows += [("behind the camera", f"{error['n_behind_camera']:,}")]
    tables = [table("All observations", ("", ""), rows)]
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
        tables.append(table(caption + "; shaded: under half within 20 px", head, lines, bad))
    return f'<div class="tables">{"".join(tables)}</div>'


def heldout_cards(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(number, what it is) of cameras left out; none without."""
    cards = []
    for key, name in _LEFT_OUT:
        if found := metrics.get(key):
            cards.append((number(found["median"], "px"), f"median error in cameras left out, {name}"))
            cards.append((share(found["within_20px"]), f"within 20 px in cameras left out, {name}"))
    return cards


def heldout_section(metrics: Mapping[str, Any]) -> str:
    """Errors in cameras left out, by camera; and the ladder, when it was climbed."""
    if not all(key in metrics for key, _ in _LEFT_OUT):
        return ""
    fitted, nominal = (metrics[key] for key, _ in _LEFT_OUT)
    head = ("", *_heldout_head(("median (px)", "p90 (px)", "within 20 px", "coverage")), "n")
    rows = [
        _heldout_row(name, part, nominal["per_camera"][name]) for name, part in fitted["per_camera"].items()
    ]
    rows.append(_heldout_row("all", fitted, nominal))
    text = (
        "Each camera in turn took no part in the estimate and is then predicted: with a time offset and a "
        "correction of its own, fitted in the other half of the frames (cross-fitted), and as it was "
        "calibrated (nominal)."
    )
    parts = [table("Estimated without the camera; of what it detected", head, rows)]
    if metrics.get("ladder"):
        parts.append(_ladder(metrics["ladder"]))
    return f'<h2>Cameras left out</h2><p>{text}</p><div class="tables">{"".join(parts)}</div>'


def _heldout_head(titles: Iterable[str]) -> list[str]:
    return [f"{name}: {title}" for _, name in _LEFT_OUT for title in titles]


def _heldout_row(name: str, fitted: Mapping[str, Any], nominal: Mapping[str, Any]) -> tuple[str, ...]:
    cells = []
    for part in (fitted, nominal):
        cells += [number(part[key], "", 1) for key in ("median", "p90")]
        cells += [share(part[key]) for key in ("within_20px", "coverage")]
    return name, *cells, f"{fitted['n']:,}"


def _ladder(rungs: list[Mapping[str, Any]]) -> str:
    """A row a rung: what is fitted, the error where it was fitted and in cameras left out."""
    head = (
        "fitted",
        "took part: median (px)",
        "within 20 px",
        *_heldout_head(("median (px)", "within 20 px")),
    )
    rows = []
    for title, rung in zip(rung_titles(rungs), rungs, strict=True):
        parts = [rung["reprojection_px"], *(rung[key] for key, _ in _LEFT_OUT)]
        cells = [c for part in parts for c in (number(part["median"], "", 1), share(part["within_20px"], 1))]
        rows.append((title, *cells))
    return table("What each family of parameters is worth: a row adds one to the row above", head, rows)


def run_tables(metrics: Mapping[str, Any]) -> str:
    """Result, times, joints at their limits, options."""
    facts = [(key, metrics[key]) for key in ("status", "method", "version", "iterations", "n_markers")]
    facts.append(("objective", number(metrics["objective"], "", 4)))
    facts += [(f"truth: {key}", number(v, "mm", 2)) for key, v in metrics.get("truth_mm", {}).items()]
    times = [(key, number(value, "s", 3)) for key, value in metrics["seconds"].items()]
    limits = [(name, share(part)) for name, part in metrics["joints_at_limit"].items()]
    tables = [table("Result", ("", ""), facts), table("Time", ("", ""), times)]
    if limits:
        tables.append(table("At a limit, share of the frames", ("", ""), limits))
    options = list(flat(metrics["options"]))
    if options:
        tables.append(table("Options", ("", ""), options))
    return f'<div class="tables">{"".join(tables)}</div>'


def parameter_section(
    parameters: Mapping[str, Any], errors: Mapping[str, Any], usual_px: Mapping[str, float]
) -> str:
    """Estimated parameters ± their standard deviations, and their errors where the truth is known.

    ``usual_px`` is the species' detection noise by marker, to stand beside the estimated one.
    """
    tables = parameter_tables(parameters)
    parts = [_parameters(one, usual_px) for one in tables]
    shown = {one.family for one in tables} | {f"{one.family}_sd" for one in tables}
    rest = list(flat({key: value for key, value in parameters.items() if key not in shown}))
    if rest:
        parts.append(table("Other parameters", ("", ""), rest))
    if errors:
        rows = []
        for name, error in _error_rows(errors):
            digits = 4 if name == "segment_scale" else 2
            values = (number(error[key], _ERROR_UNITS.get(name.split(": ")[-1], ""), digits) for key in error)
            rows.append((name, *values))
        parts.append(table("Errors against the truth", ("", "greatest", "RMS"), rows))
    return _section("Estimated parameters", parts)


def _parameters(one: ParameterTable, usual_px: Mapping[str, float]) -> str:
    """One family: a row a name; vectors have a column for every component."""
    unit = f" ({one.kind.shown})" if one.kind.shown else ""
    width = one.values.shape[1]
    known = bool(np.isfinite(one.shown_sd).any())
    head: tuple[str, ...] = (
        ("", "value") if width == 1 else ("", *("xyz" if width == 3 else map(str, range(width))))
    )
    rows = [
        (name, *(_with_sd(v, s, one.kind.digits, known) for v, s in zip(values, deviations, strict=True)))
        for name, values, deviations in zip(one.names, one.shown, one.shown_sd, strict=True)
    ]
    if one.family == "noise_px":
        head += ("in the species file",)
        rows = [(*row, number(usual_px.get(row[0]), "", one.kind.digits)) for row in rows]
    return table(f"{one.kind.title}{unit}{', ± sd' if known else ''}", head, rows)


def _with_sd(value: float, sd: float, digits: int, known: bool) -> str:
    """``5.40 ± 0.40``; without the second part where it is not known."""
    text = number(float(value) if np.isfinite(value) else None, "", digits).replace("-", "−")
    return text if not (known and np.isfinite(sd)) else f"{text} ± {sd:.{digits}f}"


def _error_rows(errors: Mapping[str, Any]) -> Iterable[tuple[str, Mapping[str, Any]]]:
    """Families and their errors; ``extrinsics`` has two."""
    for family, error in errors.items():
        if "max" in error:
            yield family, error
        else:
            yield from ((f"{family}: {part}", value) for part, value in error.items())


def uncertainty_section(uncertainty: Mapping[str, Any], truth: Mapping[str, Any]) -> str:
    """What the covariances say, and beside it what the truth says, where that is known."""
    if not uncertainty:
        return ""
    rows = [
        ("median standard deviation of a marker, along a mean axis", uncertainty["median_sd_mm"], "mm"),
        ("expected distance of the markers to the truth (RMS)", uncertainty["predicted_rmse_mm"], "mm"),
        ("found distance of the markers to the truth (RMS)", truth.get("rmse"), "mm"),
        ("NEES per dimension: 1 when the claim is right, more when too sure", "nees_per_dim", ""),
    ]
    shown = [
        (text, number(uncertainty.get(value) if isinstance(value, str) else value, unit, 2))
        for text, value, unit in rows
    ]
    inside = uncertainty.get("ellipsoid_coverage_95")
    shown.append(("errors inside the 95 % ellipsoid", share(inside, 1)))
    return _section("Uncertainty", [table("", ("", ""), [row for row in shown if row[1] != "–"])])


def _section(title: str, parts: list[str]) -> str:
    return f'<h2>{escape(title)}</h2><div class="tables">{"".join(parts)}</div>' if parts else ""


def flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, str]]:
    """Nested options as rows ``solve.max_iter``, value."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def table(caption: str, head: Iterable[str], rows: Iterable[Iterable[Any]], bad: Iterable[str] = ()) -> str:
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
