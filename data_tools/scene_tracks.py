"""3D tracks of individuals in a scene of moving cameras, point by point, with where each point comes from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

    from acino_fte.data_tools.similarity import Similarity

SOURCES = ("views", "single", "interpolated")
"""Seen by two views or more; by one, depth from its own path; by none, between others."""


@dataclass(frozen=True, eq=False)
class SceneTracks:
    """Points of all individuals, sorted by individual, then frame. T points, P dots of a view.

    Attributes
    ----------
    individuals : tuple of str
        Names.
    individual : (T,) int
        Index into `individuals`.
    frame : (T,) int
        On the clock of the reference camera.
    position : (T, 3)
        World, m (or the model's units while the scene has no scale).
    covariance : (T, 3, 3)
        Of the position: pixels and poses; not the common error of scale and axes.
    source : (T,) int
        Index into :data:`SOURCES`.
    n_views : (T,) int
        Views whose dot was used.
    reprojection_median, reprojection_max : (T,)
        Of the used dots' distances to the projected point, px; NaN without one.
    distance : tuple of (P,)
        For each camera, the distance of every dot of its tracks to its projected point, px, used or not; NaN
        where there is no point.
    used : tuple of (P,) bool
        For each camera, the dots that count.
    smooth : bool
        Whether these are most probable paths (True) or points triangulated frame by frame.
    """

    individuals: tuple[str, ...]
    individual: np.ndarray
    frame: np.ndarray
    position: np.ndarray
    covariance: np.ndarray
    source: np.ndarray
    n_views: np.ndarray
    reprojection_median: np.ndarray
    reprojection_max: np.ndarray
    distance: tuple[np.ndarray, ...]
    used: tuple[np.ndarray, ...]
    smooth: bool

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def standard_deviation(self) -> np.ndarray:
        """Of each coordinate, (T, 3), m."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def to_table(self) -> pd.DataFrame:
        """A row for each point, with the columns of ``tracks_3d.csv``.

        Two ends of a wand are paired by ``table.set_index(["individual", "frame"])[["x", "y", "z"]]``.

        Returns
        -------
        pandas.DataFrame
            individual, frame, x, y, z, sd_x, sd_y, sd_z (m), source, n_views, reprojection_px,
            reprojection_max_px.
        """
        import pandas as pd

        sd = self.standard_deviation
        return pd.DataFrame(
            {
                "individual": np.array([*self.individuals, ""], dtype=object)[self.individual],
                "frame": self.frame,
                **{axis: self.position[:, i] for i, axis in enumerate("xyz")},
                **{f"sd_{axis}": sd[:, i] for i, axis in enumerate("xyz")},
                "source": np.array(SOURCES, dtype=object)[self.source],
                "n_views": self.n_views,
                "reprojection_px": self.reprojection_median,
                "reprojection_max_px": self.reprojection_max,
            }
        )

    def moved(self, change: Similarity) -> SceneTracks:
        """The same tracks in another world."""
        return replace(
            self,
            position=change.points(self.position),
            covariance=change.covariance(self.covariance),
        )
