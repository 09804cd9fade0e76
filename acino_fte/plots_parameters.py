"""What was estimated beside the trajectory: a panel for every family of parameters, with error bars."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acino_fte.parameter_table import ParameterTable, parameter_tables
from acino_fte.plots_style import BAND_SD, BLUE, GREEN, GREY, ORANGE, PALE, RED, blank, keys, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.result import FTEResult

_WIDTH, _LEFT, _RIGHT, _GAP = 10.0, 1.2, 0.2, 1.15  # in
_ROW = {1: 0.19, 3: 0.30}  # height of a row with one value, or with x, y, z, in
_HEAD, _FOOT, _TOP, _KEY = 0.36, 0.55, 0.62, 0.3  # in
_AXES = ((BLUE, "x"), (ORANGE, "y"), (GREEN, "z"))
_NOMINAL = {"segment_scale": 1.0, "noise_px": None}


def parameter_figure(result: FTEResult) -> Figure:
    """Estimated parameters ± 2 standard deviations; true values, when known, as red crosses."""
    tables = parameter_tables(result.parameters)
    if not tables:
        empty = new_figure(result, "Estimated parameters", _WIDTH, 2.0)
        return blank(empty, "only the trajectory was estimated")
    columns = _columns(tables)
    height = _TOP + _KEY + max(sum(map(_height, column)) for column in columns) + 0.05
    figure = new_figure(result, "Estimated parameters", _WIDTH, height, top=_TOP)
    known = {(t.family, t.kind.part): t for t in parameter_tables(_true_parameters(result))}
    _keys(figure, tables, bool(known))
    width = (_WIDTH - _LEFT - _RIGHT - (len(columns) - 1) * (_GAP + 0.1)) / len(columns)
    for i, column in enumerate(columns):
        left = _LEFT + i * (width + _GAP + 0.1)
        top = height - _TOP - _KEY
        for table in column:
            tall = _height(table) - _HEAD - _FOOT
            top -= _HEAD + tall
            place = (left / _WIDTH, top / height, width / _WIDTH, tall / height)
            _panel(figure.add_axes(place), result, table, known.get((table.family, table.kind.part)))
            top -= _FOOT
    return figure


def _true_parameters(result: FTEResult) -> dict:
    """The true parameters of a simulated recording, empty for any other."""
    return getattr(result.sequence, "truth_parameters", None) or {}


def _height(table: ParameterTable) -> float:
    """Height of a panel with its title and labels, in."""
    return _HEAD + _FOOT + _ROW[3 if table.values.shape[1] > 1 else 1] * max(2, len(table.names))


def _columns(tables: list[ParameterTable]) -> list[list[ParameterTable]]:
    """Panels in two columns of about the same height; the tallest ones are placed first."""
    columns: list[list[ParameterTable]] = [[] for _ in range(min(2, len(tables)))]
    for table in sorted(tables, key=_height, reverse=True):
        min(columns, key=lambda column: sum(map(_height, column))).append(table)
    return [sorted(column, key=tables.index) for column in columns]


def _keys(figure: Figure, tables: list[ParameterTable], truth: bool) -> None:
    """What the marks mean, under the title."""
    entries = [(f"bars: ± {BAND_SD:g} sd", GREY)]
    if any(table.values.shape[1] == 3 for table in tables):
        entries += [(f"● {axis}", colour) for colour, axis in _AXES]
    if any(table.family == "noise_px" for table in tables):
        entries.append(("○ as the species has it", GREY))
    entries += [("× true", RED)] if truth else []
    keys(figure, entries, 0.12, _TOP + 0.06)


def _panel(axes: Axes, result: FTEResult, table: ParameterTable, truth: ParameterTable | None) -> None:
    """Values with error bars, one row a name, vectors as three marks side by side."""
    values, sd = table.shown, table.shown_sd
    n_names, width = values.shape
    rows = np.arange(n_names)
    for row in range(0, n_names, 2):
        axes.axhspan(row - 0.5, row + 0.5, color=PALE, alpha=0.4, lw=0)
    for d, shift in enumerate(np.linspace(-0.26, 0.26, width) if width > 1 else [0.0]):
        colour = _AXES[d % 3][0]
        reach = np.where(np.isfinite(sd[:, d]), BAND_SD * sd[:, d], 0.0)
        axes.hlines(rows + shift, values[:, d] - reach, values[:, d] + reach, color=colour, lw=1.1)
        axes.plot(values[:, d], rows + shift, "o", color=colour, ms=3.5)
        if truth is not None and truth.values.shape[1] == width:
            _crosses(axes, table, truth.shown[:, d], truth.names, shift)
    nominal = _NOMINAL.get(table.family, 0.0)
    if nominal is not None:
        axes.axvline(nominal * table.kind.factor, color=GREY, lw=0.7, zorder=0)
    if table.family == "noise_px":
        usual = {marker.name: marker.sd_px for marker in result.skeleton.markers}
        axes.plot([usual.get(name, np.nan) for name in table.names], rows, "o", mfc="none", mec=GREY, ms=4.5)
        axes.set_xlim(left=0.0)
    axes.set_yticks(rows, table.names)
    axes.set_ylim(n_names - 0.4, -0.6)
    axes.set_title(table.kind.title, loc="left")
    unit = f" ({table.kind.shown})" if table.kind.shown else ""
    axes.set_xlabel(f"{table.kind.quantity}{unit}")


def _crosses(
    axes: Axes, table: ParameterTable, true: np.ndarray, names: tuple[str, ...], shift: float
) -> None:
    """True values (K,) at the rows of their names."""
    value = dict(zip(names, true, strict=True))
    places = [(value[name], row + shift) for row, name in enumerate(table.names) if name in value]
    if places:
        axes.plot(*np.transpose(places), "x", color=RED, ms=4.5, mew=1.1)
