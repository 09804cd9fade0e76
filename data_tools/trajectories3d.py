"""3D paths of animals from the pixels of all views: the most probable ones, with their uncertainty.

Every group of 2D rows is one animal. Its path x_1 … x_N minimises

    Σ over right rows ‖pixel − π_c(x_f)‖²/σ² + Σ ‖w_f‖²/q²,

where w_f is what is new in the displacement of frame f (:mod:`trajectory_motion`). The prior (q and the
memory of the displacements) has the greatest marginal likelihood of the pixels; all groups share it. A row
is wrong when it lies further from what all other rows of its group predict than the gate; the worst row of a
neighbourhood leaves first. Where rows leave in a crowd, as in a sudden flight, the innovations have heavy
tails instead. Frames that one view sees are held by the prior, short gaps are filled, long
ones split the path. Covariances are those of Laplace's approximation at the most probable path.

Shapes: T path points (sorted by group, then frame), P rows of a view, C cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.trajectory_fit import PathFit, fit_paths
from acino_fte.data_tools.trajectory_motion import MotionModel, Pieces
from acino_fte.data_tools.trajectory_rows import (
    Measurements,
    Nodes,
    ViewRows,
    at_rows,
    gather_rows,
    has_pose,
    make_nodes,
    project_rows,
    take_pieces,
)
from acino_fte.data_tools.trajectory_start import meeting_points
from acino_fte.errors import InputError

SOURCES = ("views", "single", "filled", "extended")
GATE = 36.0


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Smoothed 3D paths. All arrays have one entry for each path point, sorted by group, then frame.

    Attributes
    ----------
    group : (T,) int
        The group of each point.
    frame : (T,) int
        Its frame. A path has every frame from its first to its last, but for long gaps.
    piece : (T,) int
        Points with the same number belong to a path without a gap.
    position : (T, 3)
        World frame, m.
    covariance : (T, 3, 3)
        m².
    source : (T,) int
        Index into :data:`SOURCES`: seen by two views or more, by a single one, by none between first and last
        row, or added at an end.
    n_views : (T,) int
        Views with a right row in this frame.
    reprojection : (T,)
        Root mean square distance of these rows from the path's pixels, px; NaN without rows.
    wrong : tuple of (P,) bool
        For each view: rows that do not belong to the path of their group.
    distance : tuple of (P,)
        For each view: squared distance of each row from what the other rows predict, in units of its
        uncertainty (χ² with two degrees of freedom for right rows); NaN for rows without a path.
    motion : MotionModel
        The prior.
    first_frame : int
        Frame of row 0 of moving cameras.
    """

    group: np.ndarray
    frame: np.ndarray
    piece: np.ndarray
    position: np.ndarray
    covariance: np.ndarray
    source: np.ndarray
    n_views: np.ndarray
    reprojection: np.ndarray
    wrong: tuple[np.ndarray, ...]
    distance: tuple[np.ndarray, ...]
    motion: MotionModel
    first_frame: int = 0

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def standard_deviation(self) -> np.ndarray:
        """Of each coordinate, (T, 3), m."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def find(self, group: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Index of the path point of each (group, frame), −1 where there is none."""
        nodes = Nodes(Pieces(np.zeros(0, dtype=int)), self.group, self.frame)
        return nodes.find(np.asarray(group), np.asarray(frame))

    def predict_pixels(
        self, camera: Camera, group: np.ndarray, frame: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where a camera should see animals.

        Parameters
        ----------
        camera : Camera
            Any camera, of the recording or not.
        group, frame : (P,) int
            The path points asked for.

        Returns
        -------
        tuple of numpy.ndarray
            Pixels (P, 2) and their covariance (P, 2, 2), px², without the noise of a detection; NaN where
            there is no path point, it is behind the camera, or a moving camera has no pose.
        """
        place = self.find(group, frame)
        there = np.flatnonzero((place >= 0) & has_pose(camera, np.asarray(frame) - self.first_frame))
        pixels, covariance = np.full((len(place), 2), np.nan), np.full((len(place), 2, 2), np.nan)
        chosen = place[there]
        view = at_rows(camera, self.frame[chosen] - self.first_frame)
        pixels[there], slope = project_rows(view, self.position[chosen])
        covariance[there] = slope @ self.covariance[chosen] @ slope.transpose(0, 2, 1)
        return pixels, covariance


def smooth_trajectories(
    cameras: CameraArray,
    views: Sequence[ViewRows],
    noise_px: float | Sequence[float],
    *,
    motion: MotionModel | None = None,
    gate: float = GATE,
    max_gap: int = 30,
    extend: int = 0,
    first_frame: int = 0,
    sudden: bool = True,
    alike: bool = True,
) -> Trajectories:
    """The most probable 3D path of every group.

    Parameters
    ----------
    cameras : CameraArray
        Fixed or moving.
    views : sequence of ViewRows
        The rows of each camera and their groups.
    noise_px : float or sequence of float
        Standard deviation of a pixel coordinate, of all views or of each.
    motion : MotionModel, optional
        The prior; by default it is estimated.
    gate : float
        Squared distance, in units of its uncertainty, beyond which a row is wrong.
    max_gap : int
        Longest run of frames without a row that is filled.
    extend : int
        Frames to add before the first and after the last row.
    first_frame : int
        Frame of row 0 of moving cameras.
    sudden : bool
        Whether many wrong rows at once may be a sudden movement, which heavier tails of the innovations can
        explain. Where wrong rows are known to come in crowds, False is faster and safer.
    alike : bool
        Whether all animals are equally agile, or the steps of each are estimated.

    Returns
    -------
    Trajectories
        Paths that no two views ever see together have no points.

    Raises
    ------
    InputError
        The views do not belong to the cameras, or the noise is not positive.
    """
    camera, place, frame, group, xy = gather_rows(views)
    nodes = make_nodes(group, frame, max_gap, extend)
    variance = _variances(cameras, views, noise_px)
    each = np.concatenate([variance[c][place[camera == c]] for c in range(len(views))])
    doubtful = [np.zeros(len(v.frame), dtype=bool) if v.doubtful is None else v.doubtful for v in views]
    wary = np.concatenate([doubtful[c][place[camera == c]] for c in range(len(views))])
    rows = Measurements(cameras, nodes.find(group, frame), camera, frame - first_frame, xy, each, wary)
    points = meeting_points(rows, len(nodes.frame))
    nodes, kept_nodes = take_pieces(nodes, _any(np.isfinite(points[:, 0]), nodes.pieces))
    kept = np.flatnonzero(kept_nodes[rows.node])
    rows = rows.subset(kept, (np.cumsum(kept_nodes) - 1)[rows.node[kept]])
    owner = None if alike else nodes.group[nodes.pieces.start]
    fit = fit_paths(rows, nodes.pieces, points[kept_nodes], motion, gate, sudden, owner)
    return _collect(fit, rows, nodes, views, place[kept], first_frame)


def _any(values: np.ndarray, pieces: Pieces) -> np.ndarray:
    """Whether any node of each piece has a true value, (S,)."""
    return np.logical_or.reduceat(values, pieces.start) if len(pieces.start) else np.zeros(0, dtype=bool)


def _collect(
    fit: PathFit,
    rows: Measurements,
    nodes: Nodes,
    views: Sequence[ViewRows],
    place: np.ndarray,
    first_frame: int,
) -> Trajectories:
    n, pieces = len(nodes.frame), nodes.pieces
    node, camera = rows.node[fit.used], rows.camera[fit.used]
    seen = np.zeros((n, len(views)), dtype=bool)
    seen[node, camera] = True
    n_views = seen.sum(1)
    squared = np.bincount(node, (fit.residual[fit.used] ** 2).sum(1), n)
    with np.errstate(invalid="ignore"):
        reprojection = np.sqrt(squared / np.bincount(node, minlength=n))
    piece = pieces.owner
    source = np.where(n_views >= 2, 0, np.where(n_views == 1, 1, 2))
    occupied = np.bincount(rows.node, minlength=n) > 0
    index = np.arange(n)
    first, last = np.full(len(pieces.length), n), np.full(len(pieces.length), -1)
    np.minimum.at(first, piece[occupied], index[occupied])
    np.maximum.at(last, piece[occupied], index[occupied])
    source[(index < first[piece]) | (index > last[piece])] = 3
    wrong, distance = [], []
    for c, view in enumerate(views):
        mine = rows.camera == c
        wrong.append(np.zeros(len(view.frame), dtype=bool))
        distance.append(np.full(len(view.frame), np.nan))
        wrong[c][place[mine]] = ~fit.used[mine]
        distance[c][place[mine]] = fit.distance[mine]
    return Trajectories(
        nodes.group, nodes.frame, piece, fit.x, fit.covariance, source, n_views, reprojection,
        tuple(wrong), tuple(distance), fit.motion, first_frame,
    )  # fmt: skip


def _variances(
    cameras: CameraArray, views: Sequence[ViewRows], noise_px: float | Sequence[float]
) -> list[np.ndarray]:
    """Pixel variances of the rows of each view."""
    if len(views) != len(cameras):
        raise InputError(
            "The rows and the cameras do not belong together.",
            expected=f"rows of {len(cameras)} views",
            found=f"{len(views)}",
        )
    noise = np.broadcast_to(np.asarray(noise_px, dtype=float), (len(cameras),))
    if not ((noise > 0) & np.isfinite(noise)).all():
        raise InputError("The pixel noise is wrong.", key="noise_px", expected="above 0", found=str(noise_px))
    each = [
        np.full(len(v.frame), sd**2) if v.variance is None else np.asarray(v.variance, dtype=float)
        for v, sd in zip(views, noise, strict=True)
    ]
    if not all((variance > 0).all() for variance in each):
        raise InputError("The variance of a row is wrong.", key="variance", expected="above 0 everywhere")
    return each
