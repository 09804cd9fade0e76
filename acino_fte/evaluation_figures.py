"""Figures of an evaluation: histograms of runs side by side on shared axes, and a row a marker.

Histograms are shares of the observations of a run, so that runs of different length compare; n is in every
panel. The dashed line is the RMSE. What lies beyond an axis is counted in the panel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from acino_fte.evaluation_statistics import Errors, Moves, Threshold, rms
from acino_fte.evaluation_tables import DAGGER
from acino_fte.plots import DPI
from acino_fte.plots_style import BLUE, GREEN, GREY, ORANGE, PALE, RED, STYLE, margins, nothing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from acino_fte.evaluation_runs import Run

ABREAST = 5
"""Runs in one figure; more of them are drawn in further figures."""
_BINS = 48
_FARTHEST = 4.0  # times the 97th percentile that an axis is stretched for an RMSE
_PANEL, _LEFT, _TOP, _SHORT_TOP, _FOOT = 2.15, 0.75, 0.95, 0.78, 0.5  # in


def save_evaluation_figures(
    errors: Sequence[Errors],
    threshold: Threshold,
    moves: Sequence[Moves],
    depths: Sequence[Run],
    folder: Path,
) -> list[Path]:
    """Draw what there is into a folder, as PNG and vector PDF.

    Parameters
    ----------
    errors : sequence of Errors
        One a run.
    threshold : Threshold
        For outliers.
    moves : sequence of Moves
        Of the runs that were adjusted; may be empty.
    depths : sequence of Run
        Runs with depth residuals; may be empty.
    folder : Path
        It is made.
    """
    folder.mkdir()
    drawn: list[tuple[str, Figure]] = []
    style: Any = {**dict(matplotlib.rcParamsDefault), **STYLE}
    with matplotlib.rc_context(style):
        drawn += _paged("reprojection_histograms", errors, lambda e: error_histograms(e, errors, threshold))
        drawn += _paged("reprojection_markers", errors, lambda e: error_markers(e, errors))
        drawn += _paged("adjustment_histograms", moves, lambda m: move_histograms(m, moves))
        drawn += _paged("adjustment_markers", moves, lambda m: move_markers(m, moves))
        drawn += _paged("depth_histograms", depths, lambda d: depth_histograms(d, depths))
        written = []
        for name, figure in drawn:
            written += [folder / f"{name}.png", folder / f"{name}.pdf"]
            figure.savefig(written[-2], dpi=DPI, metadata={"Software": None})
            figure.savefig(written[-1], metadata={"CreationDate": None, "Producer": None})
    return written


def _paged(name: str, items: Sequence, draw: Callable[[Sequence], Figure]) -> Iterator[tuple[str, Figure]]:
    for page, start in enumerate(range(0, len(items), ABREAST), 1):
        yield name if page == 1 else f"{name}_{page}", draw(items[start : start + ABREAST])


def error_histograms(errors: Sequence[Errors], every: Sequence[Errors], threshold: Threshold) -> Figure:
    """Signed u and v, and absolute reprojection error; a column a run, on axes that all of them share."""
    figure, panels = _grid([e.run for e in errors], 3, "Reprojection error", 1.45, _of(errors))
    lengths = [e.length[np.isfinite(e.length)] for e in every]
    reach = _reach(lengths, 10.0)
    rows = (("u (px)", BLUE), ("v (px)", ORANGE), ("absolute (px)", GREEN))
    for column, e in enumerate(errors):
        known = e.residual[np.isfinite(e.residual).all(-1)]
        for row, (label, colour) in enumerate(rows):
            axes = panels[row, column]
            values = known[:, row] if row < 2 else np.linalg.norm(known, axis=-1)
            _histogram(axes, values, (-reach if row < 2 else 0.0, reach), colour)
            axes.set_xlabel(label)
            if values.size:
                _rmse(axes, values, signed=row < 2)
                _note(
                    axes,
                    _signed_lines(values, reach) if row < 2 else _absolute_lines(e, values, reach, threshold),
                )
    _share_heights(panels)
    return figure


def _signed_lines(values: np.ndarray, reach: float) -> list[str]:
    return [f"mean {values.mean():+.1f}".replace("-", "−"), f"SD {values.std():.1f}", *_beyond(values, reach)]


def _absolute_lines(e: Errors, values: np.ndarray, reach: float, threshold: Threshold) -> list[str]:
    known = ~np.isnan(e.length)
    outliers = (e.length > threshold.pixels(e.run))[known].mean()
    return [
        f"n {int(known.sum()):,}",
        f"RMSE {rms(values):.1f}, SD {values.std():.1f}",
        f"{outliers:.1%} > {threshold}",
        *_beyond(values, reach),
    ]


def _beyond(values: np.ndarray, reach: float) -> list[str]:
    share = float(np.mean(np.abs(values) > reach))
    return [f"{share:.1%} off axis"] if share > 0 else []


def error_markers(errors: Sequence[Errors], every: Sequence[Errors]) -> Figure:
    """Mean absolute error ± SD (line) and RMSE (diamond) of every marker; a column a run."""
    runs = [e.run for e in errors]
    figure, panels = _marker_grid(runs, "Reprojection error by marker", _of(errors))
    found = {id(e): _marker_errors(e) for e in every}
    rmses = np.concatenate([[rms(v) or 0.0 for v in groups] for groups in found.values()])
    reach = 1.25 * max(1.0, float(rmses.max(initial=0.0)))
    for axes, e in zip(panels, errors, strict=True):
        for row, values in enumerate(found[id(e)]):
            if values.size:
                low, high = values.mean() - values.std(), values.mean() + values.std()
                axes.plot(
                    [max(low, 0), high], [row, row], color=BLUE, lw=2.2, solid_capstyle="butt", alpha=0.45
                )
                axes.plot(values.mean(), row, "o", color=BLUE, ms=3.4)
                axes.plot(rms(values), row, "D", color=RED, ms=3.4)
            axes.text(
                1.01, row, f"{values.size:,}", transform=axes.get_yaxis_transform(), va="center", fontsize=7
            )
        axes.set_xlim(0, reach)
        axes.set_xlabel("Error (px)")
    _key(figure, [("● mean", BLUE), ("▬ ± SD", BLUE), ("◆ RMSE", RED), ("right: n", GREY)])
    return figure


def _marker_errors(e: Errors) -> list[np.ndarray]:
    groups = (e.length[:, :, m].ravel() for m in range(len(e.run.markers)))
    return [values[np.isfinite(values)] for values in groups]


def move_histograms(moves: Sequence[Moves], every: Sequence[Moves]) -> Figure:
    """Lengths of the adjustments in 3D; a column a run."""
    figure, panels = _grid([m.run for m in moves], 1, "Adjustments by hand in 3D", 1.75, "adjusted positions")
    lengths = [100.0 * m.length[np.isfinite(m.length)] for m in every]
    reach = _reach(lengths, 1.0)
    for axes, m in zip(panels[0], moves, strict=True):
        values = 100.0 * m.length[np.isfinite(m.length)]
        _histogram(axes, values, (0.0, reach), GREEN, "nothing adjusted")
        axes.set_xlabel("Length (cm)")
        looked = int(m.looked_at.sum())
        lines = [f"n {values.size:,} of {looked:,}"]
        if looked:
            lines.append(f"{np.isfinite(m.length)[m.looked_at].mean():.1%} adjusted")
        if values.size:
            _rmse(axes, values, signed=False)
            lines += [f"RMSE {rms(values):.1f}, SD {values.std():.1f}", *_beyond(values, reach)]
        _note(axes, lines)
    _share_heights(panels)
    return figure


def move_markers(moves: Sequence[Moves], every: Sequence[Moves]) -> Figure:
    """RMSE (bar) and SD (line) of the adjustments, and the share adjusted, of every marker."""
    figure, panels = _marker_grid([m.run for m in moves], "Adjustments by marker", "adjusted positions")
    grouped = {id(m): [_finite(100.0 * m.length[:, k]) for k in range(len(m.run.markers))] for m in every}
    reach = 1.15 * max([1.0] + [(rms(v) or 0.0) for groups in grouped.values() for v in groups])
    for axes, m in zip(panels, moves, strict=True):
        for row, values in enumerate(grouped[id(m)]):
            if values.size:
                axes.barh(row, rms(values), height=0.55, color=GREEN, alpha=0.75)
                axes.plot([0, values.std()], [row, row], color="black", lw=1.2)
            looked = m.looked_at[:, row]
            share = float(np.isfinite(m.length[looked, row]).mean()) if looked.any() else 0.0
            axes.text(
                1.01, row, f"{share:.0%}", transform=axes.get_yaxis_transform(), va="center", fontsize=7
            )
        axes.set_xlim(0, reach)
        axes.set_xlabel("Length (cm)")
    _key(figure, [("■ RMSE", GREEN), ("━ SD", "black"), ("right: share adjusted", GREY)])
    return figure


def depth_histograms(runs: Sequence[Run], every: Sequence[Run]) -> Figure:
    """Signed depth residuals; a column a run."""
    figure, panels = _grid(list(runs), 1, "Depth residuals", 1.75, "markers with a depth")
    reach = _reach([100.0 * np.abs(_depths(run)) for run in every], 1.0)
    for axes, run in zip(panels[0], runs, strict=True):
        values = 100.0 * _depths(run)
        _histogram(axes, values, (-reach, reach), BLUE)
        axes.set_xlabel("Trajectory − lidar (cm)")
        if values.size:
            _rmse(axes, values, signed=True)
            spread = f"RMSE {rms(values):.1f}, SD {values.std():.1f}"
            mean = f"mean {values.mean():+.1f}".replace("-", "−")
            _note(axes, [f"n {values.size:,}", mean, spread, *_beyond(values, reach)])
    _share_heights(panels)
    return figure


def _depths(run: Run) -> np.ndarray:
    return np.empty(0) if run.depth_residual is None else _finite(run.depth_residual)


# --- parts ---------------------------------------------------------------------------------------------


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _of(errors: Sequence[Errors]) -> str:
    kinds = {e.of for e in errors}
    return "reprojected − labelled" if kinds == {"labels"} else "reprojected − " + " or ".join(sorted(kinds))


def _reach(groups: Sequence[np.ndarray], step: float) -> float:
    """How far the axes go: to the 97th percentile of the worst run, and its RMSE when that is near enough."""
    known = [np.abs(g) for g in groups if g.size]
    if not known:
        return step
    most = max(float(np.percentile(g, 97)) for g in known)
    size = 1.1 * max(rms(g) or 0.0 for g in known)
    most = max(most, size) if size < _FARTHEST * most else most
    return step * max(1.0, float(np.ceil(most / step)))


def _title(run: Run) -> str:
    name = run.name if len(run.name) <= 24 else f"{run.name[:11]}…{run.name[-12:]}"
    return name if run.converged else name + DAGGER


def _headed(
    runs: Sequence[Run], title: str, under: str, width: float, height: float, top: float = _TOP
) -> Figure:
    figure = Figure(figsize=(width, height))
    figure.subplots_adjust(top=1.0 - top / height)
    figure.text(0.012, 1 - 0.09 / height, title, va="top", fontsize=13)
    if any(not run.converged for run in runs):
        under += f" · {DAGGER} did not converge"
    figure.text(0.012, 1 - 0.33 / height, under, va="top", fontsize=8.5, color=GREY)
    return figure


def _grid(runs: list[Run], rows: int, title: str, tall: float, under: str) -> tuple[Figure, np.ndarray]:
    """Panels (rows, runs); a column a run, with its name on top."""
    width = max(4.4, _LEFT + 0.15 + _PANEL * len(runs))
    height = _SHORT_TOP + _FOOT + tall * rows + 0.42 * (rows - 1)
    figure = _headed(runs, title, f"{under} · dashed: RMSE", width, height, _SHORT_TOP)
    margins(figure, _LEFT, 0.15, _FOOT, wspace=0.12, hspace=0.42 / tall)
    panels = figure.subplots(rows, len(runs), squeeze=False)
    for column, run in enumerate(runs):
        panels[0, column].set_title(_title(run), loc="left")
        for axes in panels[:, column]:
            axes.tick_params(axis="y", labelleft=column == 0)
    for axes in panels[:, 0]:
        axes.set_ylabel("Share (%)")
    return figure, panels


def _marker_grid(runs: list[Run], title: str, under: str) -> tuple[Figure, np.ndarray]:
    """Panels (runs,) with a row for every marker, and the markers' names on the left.

    Runs with other markers than the first get names of their own.
    """
    n = max(len(run.markers) for run in runs)
    own = [i == 0 or run.markers != runs[0].markers for i, run in enumerate(runs)]
    width = max(4.4, 1.25 + 0.4 + _PANEL * len(runs) + 1.1 * sum(own[1:]))
    height = _TOP + _FOOT + 0.215 * n
    figure = _headed(runs, title, under, width, height)
    margins(figure, 1.25, 0.4, _FOOT, wspace=0.28 + 0.5 * any(own[1:]))
    panels = figure.subplots(1, len(runs), squeeze=False)[0]
    for axes, run, named in zip(panels, runs, own, strict=True):
        for row in range(0, len(run.markers), 2):
            axes.axhspan(row - 0.5, row + 0.5, color=PALE, alpha=0.4, lw=0)
        axes.set_yticks(range(len(run.markers)), run.markers if named else [])
        axes.tick_params(axis="y", length=0)
        axes.set_ylim(len(run.markers) - 0.4, -0.6)
        axes.set_title(_title(run), loc="left")
    return figure, panels


def _histogram(
    axes: Axes, values: np.ndarray, span: tuple[float, float], colour: str, empty: str = "no observations"
) -> None:
    axes.set_xlim(span)
    if not values.size:
        nothing(axes, empty)
        return
    counts, edges = np.histogram(values, bins=_BINS, range=span)
    axes.stairs(100.0 * counts / values.size, edges, fill=True, color=colour, alpha=0.8)
    if span[0] < 0:
        axes.axvline(0, color=GREY, lw=0.7)


def _rmse(axes: Axes, values: np.ndarray, *, signed: bool) -> None:
    """Dashed lines at the RMSE; an arrow at the edge where it lies beyond the axis."""
    size, reach = rms(values) or 0.0, axes.get_xlim()[1]
    for side in (-1.0, 1.0) if signed else (1.0,):
        if size <= reach:
            axes.axvline(side * size, color=RED, lw=1, ls="--")
        else:
            axes.plot(side * 0.985 * reach, 0.12, ">" if side > 0 else "<", color=RED, ms=5,
                      transform=axes.get_xaxis_transform())  # fmt: skip


def _note(axes: Axes, lines: Sequence[str]) -> None:
    axes.text(
        0.99, 0.98, "\n".join(lines), transform=axes.transAxes, ha="right", va="top", fontsize=7,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.9, "pad": 1.0},
    )  # fmt: skip


def _share_heights(panels: np.ndarray) -> None:
    """One height for the panels of a row, with room above for the numbers."""
    for row in panels:
        top = max(axes.dataLim.ymax if np.isfinite(axes.dataLim.ymax) else 1.0 for axes in row)
        for axes in row:
            axes.set_ylim(0, 1.3 * max(top, 1.0))


def _key(figure: Figure, entries: Sequence[tuple[str, str]]) -> None:
    width, height = figure.get_size_inches()
    left = 0.12
    for text, colour in entries:
        figure.text(left / width, 1 - 0.62 / height, text, color=colour, fontsize=8.5)
        left += 0.3 + 0.07 * len(text)
