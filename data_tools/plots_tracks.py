"""The figures of a matching, each as PNG and as vector PDF; for three animals or a thousand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib

from acino_fte.data_tools.plots_tracks_pairs import matrix_figure, residual_figure
from acino_fte.data_tools.plots_tracks_space import space_figure
from acino_fte.data_tools.plots_tracks_time import timeline_figure
from acino_fte.data_tools.plots_tracks_views import overlay_figure
from acino_fte.plots_style import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from acino_fte.data_tools.match_points import SpacePoints
    from acino_fte.data_tools.track_matching import TrackMatches

DPI = 150
LATIN = {"axes.unicode_minus": False}
"""Glyphs beyond Latin 1 are a second font in a PDF, and twice the time; so there are none here."""

FIGURES: dict[str, tuple[str, Callable[[TrackMatches, SpacePoints], Figure]]] = {
    "tracks_3d": ("3D tracks, a colour for each animal", space_figure),
    "camera_views": ("Matched tracks in every camera", overlay_figure),
    "timeline": ("Which camera sees which animal, and when", timeline_figure),
    "epipolar_residuals": ("Distance of matched dots from one epipolar plane", residual_figure),
    "match_matrix": ("How well the tracks of two cameras agree", matrix_figure),
}
"""File name → what it shows, and the function that draws it."""


def save_track_figures(matches: TrackMatches, points: SpacePoints, folder: Path | str) -> list[Path]:
    """Draw the figures of a matching into a folder, which is made if need be.

    Parameters
    ----------
    matches : TrackMatches
        Of either method, also one that matched nothing.
    points : SpacePoints
        Of :func:`~acino_fte.data_tools.match_points.space_points`.
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
    style: Any = {**dict(matplotlib.rcParamsDefault), **STYLE, **LATIN}  # whatever the user's settings are
    with matplotlib.rc_context(style):
        for name, (_, draw) in FIGURES.items():
            figure = draw(matches, points)
            written += [folder / f"{name}.png", folder / f"{name}.pdf"]
            figure.savefig(written[-2], dpi=DPI, metadata={"Software": None})
            figure.savefig(written[-1], metadata={"CreationDate": None, "Producer": None})
    return written
