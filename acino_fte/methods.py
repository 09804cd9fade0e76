"""The methods beside full trajectory estimation: one function for all baselines.

===========  =============================================  =========================================
method       what it does                                   where
===========  =============================================  =========================================
tri          triangulates every marker in every frame       :mod:`acino_fte.baseline_tri`
sba          adjusts those points, and cameras if asked     :mod:`acino_fte.baseline_sba`
ekf          Kalman filter and smoother on the skeleton     :mod:`acino_fte.baseline_ekf`
===========  =============================================  =========================================
"""

from __future__ import annotations

from collections.abc import Callable

from acino_fte.errors import InputError, did_you_mean
from acino_fte.kinematics import Kinematics
from acino_fte.problem import FTEOptions
from acino_fte.result import FTEResult
from acino_fte.sequence import Sequence

BASELINES = ("tri", "sba", "ekf")


def estimate(
    method: str,
    sequence: Sequence,
    kinematics: Kinematics,
    options: FTEOptions | None = None,
    *,
    cameras_too: bool = False,
    progress: Callable[[int, float], None] | None = None,
    seconds: dict[str, float] | None = None,
) -> FTEResult:
    """Estimate a trajectory by one of :data:`BASELINES`.

    Parameters
    ----------
    method : str
        The one.
    sequence : Sequence
        With detections of the skeleton's markers.
    kinematics : Kinematics
        ``tri`` and ``sba`` use no more of it than the markers and their ``sd_px``.
    options : FTEOptions, optional
        The likelihood threshold counts for all; the loss for the cost of ``tri`` and ``sba``; the process
        noise and the joints' prior for ``ekf``; the widths of the extrinsics' prior for ``cameras_too``.
    cameras_too : bool
        ``sba`` corrects the poses of the cameras as well.
    progress : callable, optional
        Called with (iteration, objective); never by ``tri``.
    seconds : dict, optional
        Time spent so far by stage, for the record.

    Raises
    ------
    InputError
        There is no such method, it cannot correct cameras, or the detections do not suffice.
    """
    if method not in BASELINES:
        raise InputError(
            f"There is no baseline '{method}'{did_you_mean(method, BASELINES)}",
            key="method",
            expected=f"one of {', '.join(BASELINES)}",
        )
    if cameras_too and method != "sba":
        raise InputError(
            f"The method '{method}' does not correct cameras.", key="cameras_too", remedy="use 'sba' for it"
        )
    if method == "tri":
        from acino_fte.baseline_tri import estimate_tri

        return estimate_tri(sequence, kinematics.skeleton, options, seconds=seconds)
    if method == "sba":
        from acino_fte.baseline_sba import estimate_sba

        return estimate_sba(
            sequence,
            kinematics.skeleton,
            options,
            cameras_too=cameras_too,
            progress=progress,
            seconds=seconds,
        )
    from acino_fte.baseline_ekf import estimate_ekf

    return estimate_ekf(sequence, kinematics, options, progress=progress, seconds=seconds)
