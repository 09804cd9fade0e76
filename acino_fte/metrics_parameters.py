"""Estimated parameters against the true ones of a simulated recording.

Every definition is in ``docs/metrics.md``. A family is a dict of name → number or vector of 3; a name that
one side does not have has its nominal value there (a scale of 1, else 0), which is what it was taken to be.
A name that is nominal on both sides was not estimated (the first camera, for one) and does not count.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from acino_fte.result import FTEResult

_NOMINAL = {"segment_scale": 1.0}
_OUTPUT = {"time_offset_s": ("time_offset_ms", 1e3), "marker_offset_m": ("marker_offset_mm", 1e3)}


def parameter_errors(result: FTEResult) -> dict[str, Any]:
    """Greatest and root mean square error of every family that was estimated and has a truth.

    Returns
    -------
    dict
        Family → {max, rms}: ``time_offset_ms`` (relative to the first camera), ``segment_scale``,
        ``marker_offset_mm`` (length of the difference), ``extrinsics`` → ``position_mm`` and
        ``rotation_deg``, of the camera's pose. Empty without truth.
    """
    truth = getattr(result.sequence, "truth_parameters", None) or {}
    errors: dict[str, Any] = {}
    for family, true in truth.items():
        found = result.parameters.get(family)
        if not (found and isinstance(found, Mapping) and isinstance(true, Mapping)):
            continue
        if family == "extrinsics":
            errors[family] = pose_errors(found, true)
            continue
        difference = _differences(family, found, true)
        if family == "time_offset_s":
            difference = _relative(difference, result.sequence.cameras.names)
        name, factor = _OUTPUT.get(family, (family, 1.0))
        lengths = [factor * float(np.linalg.norm(value)) for value in difference.values()]
        errors[name] = summarise_errors(lengths)
    return errors


def summarise_errors(lengths: list[float]) -> dict[str, float | None]:
    """Greatest and root mean square of non-negative numbers; None without any."""
    if not lengths:
        return {"max": None, "rms": None}
    return {"max": max(lengths), "rms": float(np.sqrt(np.mean(np.square(lengths))))}


def _differences(family: str, found: Mapping[str, Any], true: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Estimated − true value of every name that is not nominal on both sides."""
    nominal = _NOMINAL.get(family, 0.0)
    pairs = {
        name: tuple(np.asarray(side.get(name, nominal), dtype=float) for side in (found, true))
        for name in {**found, **true}
    }
    return {
        name: value - target
        for name, (value, target) in pairs.items()
        if np.any(value != nominal) or np.any(target != nominal)
    }


def _relative(difference: Mapping[str, np.ndarray], cameras: list[str]) -> dict[str, np.ndarray]:
    """Errors of the other cameras' clocks against the first camera's, as only differences are observable."""
    reference = difference.get(cameras[0], np.zeros(()))
    return {name: value - reference for name, value in difference.items() if name != cameras[0]}


def pose_errors(found: Mapping[str, Any], true: Mapping[str, Any]) -> dict[str, Any]:
    """Errors of corrected camera poses: centres in mm, attitudes in degrees.

    A correction (``rotation_rad`` ω, ``translation_m`` τ) acts in the camera's frame,
    ``x' = Exp(ω) x + τ``. With the estimated and the true one (hat: estimated) the attitude is off by the
    angle of ``Exp(ω̂) Exp(ω)ᵀ`` and the centre by the length of ``Exp(ω̂)ᵀ τ̂ − Exp(ω)ᵀ τ``, whatever the
    nominal pose.
    """
    from scipy.spatial.transform import Rotation

    centres, angles = [], []
    for camera in {**found, **true}:
        if not (_any(found.get(camera)) or _any(true.get(camera))):
            continue
        (turn, centre), (true_turn, true_centre) = (_moved(side.get(camera)) for side in (found, true))
        centres.append(1e3 * float(np.linalg.norm(centre - true_centre)))
        angles.append(math.degrees(Rotation.from_matrix(turn @ true_turn.T).magnitude()))
    return {"position_mm": summarise_errors(centres), "rotation_deg": summarise_errors(angles)}


def _any(correction: Mapping[str, Any] | None) -> bool:
    """Whether a correction is one."""
    return any(np.any(np.asarray(part, dtype=float)) for part in (correction or {}).values())


def _moved(correction: Mapping[str, Any] | None) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) of a correction, and minus its shift of the camera's centre (3,), m, camera frame."""
    from scipy.spatial.transform import Rotation

    correction = correction or {}
    turn = Rotation.from_rotvec(correction.get("rotation_rad", np.zeros(3))).as_matrix()
    return turn, turn.T @ np.asarray(correction.get("translation_m", np.zeros(3)), dtype=float)
