"""2D tracks of animals without markers, as one camera sees them, and a recording of several such cameras.

A row is one dot in one frame. Dots that a tracker joined over time share a track; a dot that nothing joined
is a bare point (track −1). Shapes: P rows of one camera, N frames, C cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from acino_fte.cameras import CameraArray

BARE, CLUTTER = -1, -1


@dataclass(frozen=True, eq=False)
class Tracks2D:
    """The rows of one camera, in the order of the file.

    Attributes
    ----------
    camera : str
        Name of the camera.
    frame : (P,) int
        Frame of the recording, from 0 or not, in any order.
    track : (P,) int
        Index into `labels`; −1 for a bare point.
    xy : (P, 2)
        Pixels, y from the top, pixel centres at integers. Finite: missing dots have no row.
    labels : tuple of str
        Names of the tracks as the file has them.
    animal : (P,) int, optional
        The true animal, −1 for clutter; used for scoring only.
    path : Path, optional
        The file, for messages.
    row : (P,) int
        Row of the file that the dot comes from, from 0; by default 0, 1, …. Rows of a file that holds all
        cameras are counted over all of them.
    left_out : pandas.DataFrame, optional
        Rows of the file without a dot (no coordinates): columns row, frame, track (the label, or empty).
    """

    camera: str
    frame: np.ndarray
    track: np.ndarray
    xy: np.ndarray
    labels: tuple[str, ...]
    animal: np.ndarray | None = None
    path: Path | None = None
    row: np.ndarray = field(default=None)  # type: ignore[arg-type]
    left_out: pd.DataFrame | None = None

    def __post_init__(self) -> None:
        if self.row is None:
            object.__setattr__(self, "row", np.arange(len(self.frame)))

    def __len__(self) -> int:
        return len(self.frame)

    def without_tracks(self) -> Tracks2D:
        """The same dots as bare points."""
        return replace(self, track=np.full(len(self), BARE), labels=())

    def at_rows(self, rows: np.ndarray) -> Tracks2D:
        """The dots that an index or a mask (P,) picks; the labels all stay."""
        return replace(
            self,
            frame=self.frame[rows],
            track=self.track[rows],
            xy=self.xy[rows],
            animal=None if self.animal is None else self.animal[rows],
            row=self.row[rows],
        )


@dataclass(frozen=True, eq=False)
class TrackRecording:
    """The 2D tracks of all cameras of a recording.

    Attributes
    ----------
    name : str
    cameras : CameraArray
        Fixed or moving, in the order of `views`. The pose of a moving camera at row n is that of frame
        ``first_frame + n``.
    views : tuple of Tracks2D
        One for each camera.
    fps : float, optional
        Frames per second, where it is known.
    truth_3d : pandas.DataFrame, optional
        Columns frame, animal, x, y, z (m); used for scoring only.
    warnings : tuple of str
        What the reader noticed.
    """

    name: str
    cameras: CameraArray
    views: tuple[Tracks2D, ...]
    fps: float | None = None
    truth_3d: pd.DataFrame | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = [view.camera for view in self.views]
        if names != self.cameras.names:
            raise InputError(
                "The tracks and the cameras do not belong together.",
                expected=f"tracks of {', '.join(self.cameras.names)}",
                found=", ".join(names),
            )

    @property
    def first_frame(self) -> int:
        """The first frame that any camera has a row in; 0 when there is none."""
        return min((int(view.frame.min()) for view in self.views if len(view)), default=0)

    @property
    def n_frames(self) -> int:
        """N, from the first frame with a row to the last."""
        last = max((int(view.frame.max()) for view in self.views if len(view)), default=-1)
        return last + 1 - self.first_frame if last >= 0 else 0
