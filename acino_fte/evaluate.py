"""Evaluation on cameras left out, for any method, and the ladder: what each family of parameters is worth.

A family that only adds freedom lowers the error in the cameras it was fitted to; one that is physics lowers
it in a camera that took no part. The ladder shows both for a growing set of families.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from acino_fte.estimate import EstimateOptions, estimate_fte
from acino_fte.holdout import CAMERA_FAMILIES, hold_out, holdout_metrics
from acino_fte.kinematics import Kinematics
from acino_fte.methods import estimate
from acino_fte.observable import ORDER
from acino_fte.parameters import FAMILY_KEYS
from acino_fte.result import FTEResult
from acino_fte.sequence import Sequence
from acino_fte.solve import Progress

_KEYS = ("median", "p90", "within_20px", "coverage")


def evaluate_holdout(
    sequence: Sequence,
    kinematics: Kinematics,
    method: str,
    options: EstimateOptions,
    result: FTEResult,
    cameras: list[str] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """``heldout_px`` and ``heldout_nominal_px`` of a method, with the families that its result fitted."""
    fitted = replace(options, fit=fitted_families(result), covariance=False)

    def without(others: Sequence) -> FTEResult:
        return estimate(method, others, kinematics, fitted, progress=progress)

    likelihood = options.problem.likelihood
    held = hold_out(sequence, without, likelihood=likelihood, cameras=cameras, fit=CAMERA_FAMILIES)
    return holdout_metrics(list(held))


def fitted_families(result: FTEResult) -> tuple[str, ...]:
    """Families of parameters that a result has."""
    found = {family for key, family in FAMILY_KEYS.items() if key in result.parameters}
    return tuple(family for family in ORDER if family in found)


def climb(
    sequence: Sequence,
    kinematics: Kinematics,
    options: EstimateOptions,
    result: FTEResult,
    cameras: list[str] | None,
    top: dict[str, Any],
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """The ladder: from no parameters to those of the result, family by family.

    ``top`` is the score of the last rung. Each rung has ``fit``, ``reprojection_px`` {median, within_20px}
    in the cameras that took part, ``heldout_px`` and ``heldout_nominal_px``.
    """
    families = fitted_families(result)
    rungs = []
    for count in range(len(families) + 1):
        fit = families[:count]
        if count == len(families):
            solved, scores = result, top
        else:
            settings = replace(options, fit=fit, covariance=False)
            solved = estimate_fte(sequence, kinematics, settings, progress=progress)
            scores = evaluate_holdout(sequence, kinematics, "fte", settings, solved, cameras, progress)
        error = solved.metrics["reprojection_px"]
        rungs.append(
            {
                "fit": list(fit),
                "reprojection_px": {key: error[key] for key in ("median", "within_20px")},
                **{key: {k: scores[key][k] for k in _KEYS} for key in ("heldout_px", "heldout_nominal_px")},
            }
        )
    return rungs
