"""All methods behind one function: full trajectory estimation, and the baselines it is held against.

===========  =============================================  =========================================
method       what it does                                   where
===========  =============================================  =========================================
fte          full trajectory estimation                     :mod:`acino_fte.estimate`
tri          triangulates every marker in every frame       :mod:`acino_fte.baseline_tri`
sba          adjusts those points, and cameras if asked     :mod:`acino_fte.baseline_sba`
ekf          Kalman filter and smoother on the skeleton     :mod:`acino_fte.baseline_ekf`
===========  =============================================  =========================================
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from acino_fte.errors import InputError, did_you_mean
from acino_fte.kinematics import Kinematics
from acino_fte.result import FTEResult
from acino_fte.sequence import Sequence

if TYPE_CHECKING:
    from acino_fte.estimate import EstimateOptions

BASELINES = ("tri", "sba", "ekf")
METHODS = ("fte", *BASELINES)


def estimate(
    method: str,
    sequence: Sequence,
    kinematics: Kinematics,
    options: EstimateOptions | None = None,
    *,
    progress: Callable[[int, float], None] | None = None,
    seconds: dict[str, float] | None = None,
) -> FTEResult:
    """Estimate a trajectory by one of :data:`METHODS`.

    Parameters
    ----------
    method : str
        The one.
    sequence : Sequence
        With detections of the skeleton's markers.
    kinematics : Kinematics
        ``tri`` and ``sba`` use no more of it than the markers and their ``sd_px``.
    options : EstimateOptions, optional
        Of the baselines, only ``sba`` estimates parameters: the corrections of the cameras, when ``fit``
        names ``extrinsics``. All use the options of the problem: the likelihood threshold; the loss for
        the cost of ``tri`` and ``sba``; the process noise and the joints' prior for ``ekf``.
    progress : callable, optional
        Called with (iteration, objective); never by ``tri``.
    seconds : dict, optional
        Time spent so far by stage, for the record.

    Raises
    ------
    InputError
        There is no such method, it cannot estimate what ``fit`` names, or the detections do not suffice.
    """
    from acino_fte.estimate import EstimateOptions, estimate_fte

    chosen = options or EstimateOptions()
    if method not in METHODS:
        raise InputError(
            f"There is no method '{method}'{did_you_mean(method, METHODS)}",
            key="method",
            expected=f"one of {', '.join(METHODS)}",
        )
    if method == "fte":
        return estimate_fte(sequence, kinematics, chosen, progress=progress, seconds=seconds)
    _check_fit(method, chosen.fit or ())
    if method == "tri":
        from acino_fte.baseline_tri import estimate_tri

        return estimate_tri(sequence, kinematics.skeleton, chosen.problem, seconds=seconds)
    if method == "sba":
        from acino_fte.baseline_sba import estimate_sba

        return estimate_sba(
            sequence,
            kinematics.skeleton,
            chosen.problem,
            cameras_too="extrinsics" in (chosen.fit or ()),
            progress=progress,
            seconds=seconds,
        )
    from acino_fte.baseline_ekf import estimate_ekf

    return estimate_ekf(sequence, kinematics, chosen.problem, progress=progress, seconds=seconds)


def _check_fit(method: str, fit: tuple[str, ...]) -> None:
    """Raise InputError when a baseline is asked for parameters that it does not have."""
    able = ("extrinsics",) if method == "sba" else ()
    unable = [family for family in fit if family not in able]
    if unable:
        raise InputError(
            f"The method '{method}' does not estimate {', '.join(unable)}.",
            key="fit",
            expected=f"{' or '.join(able)}, or nothing" if able else "nothing",
            remedy="leave it out, or use the method 'fte'",
        )
