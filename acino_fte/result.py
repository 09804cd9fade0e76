"""What a run leaves behind: the trajectory, how it was found, and whether to trust it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

    from acino_fte.fusion import DepthResiduals
    from acino_fte.sequence import Sequence
    from acino_fte.skeleton import Skeleton


class Status(StrEnum):
    """How a solve ended."""

    CONVERGED = "converged"
    ACCEPTABLE = "acceptable"
    MAX_ITERATIONS = "max_iterations"
    MAX_TIME = "max_time"
    INTERRUPTED = "interrupted"
    DIVERGED = "diverged"
    FAILED = "failed"

    @property
    def ok(self) -> bool:
        """Whether the trajectory is an optimum."""
        return self in (Status.CONVERGED, Status.ACCEPTABLE)

    @property
    def advice(self) -> str:
        """What the status means and what to change."""
        return _ADVICE[self]


_ADVICE = {
    Status.CONVERGED: "The solver converged.",
    Status.ACCEPTABLE: "The solver could not reach the tolerance but stayed within the acceptable one; "
    "the trajectory can be used. Loosen --tol to be told 'converged'.",
    Status.MAX_ITERATIONS: "The solver ran out of iterations; what is saved is its best iterate. "
    "Raise --max-iter, or look for cameras that do not fit the rest in the per-camera errors.",
    Status.MAX_TIME: "The solver ran out of time; what is saved is its best iterate. Raise --max-seconds.",
    Status.INTERRUPTED: "The run was interrupted; what is saved is the best iterate so far. "
    "Run it again to completion before using it.",
    Status.DIVERGED: "The solver diverged or could not restore feasibility. Check the calibration and the "
    "frame rate; '--loss cauchy' is more forgiving of a bad start.",
    Status.FAILED: "The solver stopped with an error of its own. Run with --verbose to see its log, and "
    "check the detections for cameras or frames that make no sense.",
}


@dataclass(frozen=True, eq=False)
class FTEResult:
    """A solved trajectory. Shapes: N frames, C cameras, M markers, Q degrees of freedom.

    Attributes
    ----------
    status : Status
    sequence : Sequence
    skeleton : Skeleton
    q, dq, ddq : (N, Q)
        Degrees of freedom (m, rad), and their first and second backward differences in time; (N, 0) from
        a method without a skeleton (``tri``, ``sba``).
    positions : (N, M, 3)
        Marker positions, world frame, m; NaN where a method has none.
    observed : (N, C, M, 2)
        Detections that entered the problem, px; NaN elsewhere.
    reprojected : (N, C, M, 2)
        Positions projected into every camera, px; NaN behind a camera.
    objective : float
        Value of the objective at the trajectory (a negative log-posterior up to a constant).
    iterations : int
    method : str
        ``"fte-condensed"``, ``"fte-explicit"``, ``"tri"``, ``"sba"`` or ``"ekf"``.
    seconds : dict
        Time spent: load, initialise, build, solve.
    options : dict
        Options of the problem and of the solver, as they were used.
    parameters : dict
        What was estimated beside the trajectory: family (``time_offset_s``, ``segment_scale``,
        ``extrinsics``, ``marker_offset_m``, ``noise_px``, …) → name → value; ``<family>_sd`` beside it.
    q_sd : (N, Q), optional
        Posterior standard deviations of the degrees of freedom, m and rad.
    position_covariance : (N, M, 3, 3), optional
        Posterior covariance of every marker, m².
    findings : tuple of str
        What the estimate noticed about the recording: swapped sides, cameras that moved or are out of
        step, parameters that could not be observed. One sentence each.
    depth : DepthResiduals, optional
        Measured and predicted depths, with a lidar.
    evaluation : dict
        Fields for ``metrics.json`` from an evaluation on cameras left out (:mod:`acino_fte.holdout`).
    """

    status: Status
    sequence: Sequence
    skeleton: Skeleton
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    positions: np.ndarray
    observed: np.ndarray
    reprojected: np.ndarray
    objective: float
    iterations: int
    method: str
    seconds: dict[str, float] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    q_sd: np.ndarray | None = None
    position_covariance: np.ndarray | None = None
    findings: tuple[str, ...] = ()
    depth: DepthResiduals | None = None
    evaluation: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def residuals(self) -> np.ndarray:
        """(N, C, M, 2) reprojected − observed, px; NaN where nothing was observed."""
        return self.reprojected - self.observed

    @cached_property
    def errors(self) -> np.ndarray:
        """(N, C, M) reprojection error: length of the residual, px."""
        return np.linalg.norm(self.residuals, axis=-1)

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """The fields of ``metrics.json`` (see :mod:`acino_fte.metrics`)."""
        from acino_fte.metrics import result_metrics

        return result_metrics(self)

    def to_dataset(self) -> xr.Dataset:
        """Everything as one labelled dataset, in the layout of the movement package."""
        from acino_fte.result_dataset import to_dataset

        return to_dataset(self)
