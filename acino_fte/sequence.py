"""What a recording becomes once it is read: detections, cameras and frame rate, one frozen value."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.cameras import CameraArray
from acino_fte.errors import InputError
from acino_fte.lidar import Lidar

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, eq=False)
class Sequence:
    """A recording of one animal.

    Attributes
    ----------
    name : str
    species : str
        Name of a species, or the path of a species file.
    fps : float
        Frames per second.
    detections : xarray.Dataset
        ``position`` (frame, camera, marker, space = u, v), px, NaN where missing, and ``likelihood``
        (frame, camera, marker). The coordinate ``frame`` counts from the start of the recording. Where the
        detector gave several candidates for a marker also ``candidate_position`` (frame, camera, marker,
        candidate, space), px, NaN where there are fewer, and ``candidate_likelihood`` (frame, camera,
        marker, candidate), 0 where there are fewer; candidate 0 is ``position``.
    cameras : CameraArray
        In the order of the dimension ``camera``; moving cameras have one pose per frame of this range.
    truth : xarray.DataArray, optional
        True marker positions (frame, marker, space = x, y, z), m, when known.
    ground : tuple of float, optional
        The plane that the animal stands on, when it is known: a, b, c, d with a x + b y + c z = d in the
        world frame, m; (a, b, c) is a unit vector that points upwards.
    truth_parameters : dict
        What else is known of a simulated recording: true ``time_offset_s``, ``extrinsics``, ``segment_scale``
        and ``marker_offset_m`` as :attr:`acino_fte.simulate.Simulation.parameters` has them, and ``swapped``,
        a list of [frame, camera, [marker, …]] where left and right are exchanged, with frames counted from
        the start of the recording. Empty when nothing is known.
    lidar : Lidar, optional
        Returns of a lidar that is calibrated to one of the cameras.
    provenance : dict
        The sequence as it was understood, ready to be written as ``sequence.yaml``.
    warnings : tuple of str
        What the reader wants the user to know.
    """

    name: str
    species: str
    fps: float
    detections: xr.Dataset
    cameras: CameraArray
    truth: xr.DataArray | None = None
    ground: tuple[float, float, float, float] | None = None
    truth_parameters: dict[str, Any] = field(default_factory=dict)
    lidar: Lidar | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        found = [str(c) for c in self.detections.camera.values]
        if found != self.cameras.names:
            raise InputError(
                "Cameras and detections do not belong together.",
                expected=f"cameras {', '.join(self.cameras.names)}",
                found=", ".join(found),
            )
        if self.lidar is not None and self.lidar.camera not in found:
            raise InputError(
                "The lidar is calibrated to a camera that the sequence does not have.",
                key="lidar.camera",
                expected=f"one of {', '.join(found)}",
                found=self.lidar.camera,
            )

    @property
    def n_frames(self) -> int:
        """N."""
        return self.detections.sizes["frame"]

    @property
    def frames(self) -> np.ndarray:
        """(N,) frame numbers, counted from the start of the recording."""
        return self.detections.frame.values

    @property
    def markers(self) -> list[str]:
        """Marker names that the detections have."""
        return [str(m) for m in self.detections.marker.values]

    @property
    def duration(self) -> float:
        """Length of the recording, s."""
        return self.n_frames / self.fps

    def pixels(self, markers: list[str], likelihood: float) -> np.ndarray:
        """Detections (N, C, M, 2) px of the given markers with a likelihood above a threshold, else NaN."""
        chosen = self.detections.reindex(marker=markers)
        position = chosen.position.transpose("frame", "camera", "marker", "space").values
        sure = chosen.likelihood.transpose("frame", "camera", "marker").values > likelihood
        return np.where(sure[..., None] & np.isfinite(position).all(-1, keepdims=True), position, np.nan)

    def candidates(self, markers: list[str], likelihood: float) -> np.ndarray | None:
        """Candidates (N, C, M, K, 2) px of the given markers with a likelihood above a threshold, else NaN.

        None when the detections have none. Candidate 0 is what :meth:`pixels` gives.
        """
        if "candidate_position" not in self.detections:
            return None
        chosen = self.detections.reindex(marker=markers)
        dims = ("frame", "camera", "marker", "candidate")
        position = chosen.candidate_position.transpose(*dims, "space").values
        sure = chosen.candidate_likelihood.transpose(*dims).values > likelihood
        return np.where(sure[..., None] & np.isfinite(position).all(-1, keepdims=True), position, np.nan)

    def candidate_likelihood(self, markers: list[str]) -> np.ndarray | None:
        """Likelihoods (N, C, M, K) of the candidates of the given markers; None when there are none."""
        if "candidate_likelihood" not in self.detections:
            return None
        chosen = self.detections.reindex(marker=markers).candidate_likelihood
        return chosen.transpose("frame", "camera", "marker", "candidate").values

    def select_frames(self, start: int | None, stop: int | None) -> Sequence:
        """Frames start ≤ frame < stop, numbered from the start of the recording.

        Raises
        ------
        InputError
            The range is empty or reaches outside the recording.
        """
        first, last = int(self.frames[0]), int(self.frames[-1]) + 1
        start = first if start is None else start
        stop = last if stop is None else stop
        if not first <= start < stop <= last:
            raise InputError(
                f"The frames {start}:{stop} are not in the recording.",
                key="frames",
                expected=f"START:STOP with {first} ≤ START < STOP ≤ {last} (half-open, counted from 0)",
                found=f"{start}:{stop}",
                remedy="choose a range inside, or leave it out to use every frame",
            )
        cut = slice(start - first, stop - first)
        truth = self.truth.isel(frame=cut) if self.truth is not None else None
        return replace(
            self,
            detections=self.detections.isel(frame=cut),
            cameras=self.cameras.at_frames(cut),
            truth=truth,
            provenance={**self.provenance, "frames": [start, stop]},
        )
