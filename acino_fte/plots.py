"""The figures of a run, each as PNG and as vector PDF.

Drawn through matplotlib's object interface on the Agg and PDF canvases: no window, no global state of pyplot.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib

from acino_fte.parameter_table import parameter_tables
from acino_fte.plots_depth import depth_figure
from acino_fte.plots_histograms import camera_figure, error_figure, marker_figure
from acino_fte.plots_joints import joint_figure, motion_figure
from acino_fte.plots_ladder import ladder_figure
from acino_fte.plots_parameters import parameter_figure
from acino_fte.plots_positions import position_figure
from acino_fte.plots_style import STYLE
from acino_fte.plots_trajectory import trajectory_figure
from acino_fte.plots_uncertainty import uncertainty_figure
from acino_fte.plots_views import view_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from acino_fte.result import FTEResult

DPI = 150

FIGURES: dict[str, tuple[str, Callable[[FTEResult], Figure]]] = {
    "trajectory": ("Trajectory as stick figures", trajectory_figure),
    "reprojection_error": ("Reprojection error", error_figure),
    "reprojection_by_camera": ("Reprojection error by camera", camera_figure),
    "reprojection_by_marker": ("Reprojection error by marker", marker_figure),
    "depth": ("Depth measured by the lidar", depth_figure),
    "joint_angles": ("Joint angles and their limits", joint_figure),
    "marker_positions": ("Positions of the markers", position_figure),
    "uncertainty": ("Uncertainty of the markers", uncertainty_figure),
    "body_motion": ("Motion of the body", motion_figure),
    "parameters": ("Estimated parameters", parameter_figure),
    "ladder": ("What each family of parameters is worth in cameras left out", ladder_figure),
    "camera_views": ("The skeleton in the cameras", view_figure),
}
"""File name → what it shows, and the function that draws it."""


def figures_of(result: FTEResult) -> list[str]:
    """Names of the figures that have something to show of a result.

    ``joint_angles`` needs joints, ``uncertainty`` covariances, ``parameters`` estimated parameters,
    ``depth`` a lidar, and ``ladder`` a ladder of cameras left out;
    ``marker_positions`` is for the methods without joints, and for error bands.
    """
    joints, spread = bool(result.q.shape[1]), result.position_covariance is not None
    shown = {"joint_angles": joints, "marker_positions": spread or not joints, "uncertainty": spread}
    shown["parameters"] = bool(parameter_tables(result.parameters))
    shown["depth"] = result.depth is not None
    shown["ladder"] = bool(result.evaluation.get("ladder"))
    return [name for name in FIGURES if shown.get(name, True)]


def save_figures(result: FTEResult, folder: Path | str) -> list[Path]:
    """Draw the figures of a result (:func:`figures_of`) into a folder, which is made if need be.

    Parameters
    ----------
    result : FTEResult
        An unconverged result gets the same figures, marked in red.
    folder : Path
        For ``NAME.png`` (150 dots per inch) and ``NAME.pdf``, names as in :data:`FIGURES`.

    Returns
    -------
    list of Path
        The files written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    style: Any = {**dict(matplotlib.rcParamsDefault), **STYLE}  # whatever the user's own settings are
    with matplotlib.rc_context(style):
        for name in figures_of(result):
            figure = FIGURES[name][1](result)
            written += [folder / f"{name}.png", folder / f"{name}.pdf"]
            figure.savefig(written[-2], dpi=DPI, metadata={"Software": None})
            figure.savefig(written[-1], metadata={"CreationDate": None, "Producer": None})
    return written
