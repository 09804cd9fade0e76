"""Honest evaluation: leave a camera out, estimate without it, and predict what it saw.

For every camera in turn the whole estimate (trajectory, proportions, noise) is made from the others. The
camera left out is then predicted twice:

* *nominal*: with its calibration as given and no time offset;
* *cross-fitted*: with a time offset and a correction of its own, fitted to its detections in one half of the
  frames with the trajectory held fixed, and scored in the other half; then the halves change places (two-fold
  cross-validation in time; Stone 1974). No frame is scored with parameters that it took part in fitting.

Shapes: N frames, M markers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from acino_fte import delay
from acino_fte.cameras import Camera, CameraArray
from acino_fte.compiled_terms import CompiledTerm, Point
from acino_fte.errors import InputError, did_you_mean
from acino_fte.losses import Loss
from acino_fte.parameters import Parameters, PriorWidths, declare
from acino_fte.prediction import corrected_cameras, predict, time_offsets
from acino_fte.result import FTEResult
from acino_fte.sequence import Sequence
from acino_fte.terms import measurement_term

CAMERA_FAMILIES = ("delay", "extrinsics")
_ITERATIONS = 30
_SMALL = 1e-6  # largest step, in prior standard deviations, at which a camera's fit has converged
_HALVINGS = 8


@dataclass(frozen=True, eq=False)
class HeldOut:
    """One camera that was left out.

    Attributes
    ----------
    camera : str
    status : str
        How the estimate without it ended.
    nominal, fitted : (N, M)
        Error of its prediction, px: with the given calibration, and cross-fitted. NaN where it detected
        nothing, ∞ where the estimate has no position, or one behind the camera.
    """

    camera: str
    status: str
    nominal: np.ndarray
    fitted: np.ndarray


def hold_out(
    sequence: Sequence,
    estimate: Callable[[Sequence], FTEResult],
    *,
    likelihood: float = 0.5,
    cameras: list[str] | None = None,
    fit: tuple[str, ...] = CAMERA_FAMILIES,
) -> Iterator[HeldOut]:
    """Leave each of some cameras out (all of them when not named) and predict it.

    Parameters
    ----------
    sequence : Sequence
        The recording, with all cameras.
    estimate : callable
        From a sequence to a result; called once a camera.
    likelihood : float
        Detections of the camera that count.
    cameras : list of str, optional
        Those to leave out.
    fit : tuple of str
        What is cross-fitted of the camera: ``delay``, ``extrinsics``.

    Raises
    ------
    InputError
        There are fewer than three cameras, or no camera of a given name.
    """
    for name in check_cameras(sequence, cameras):
        result = estimate(without_camera(sequence, name))
        yield _score(sequence, name, result, likelihood, fit)


def check_cameras(sequence: Sequence, cameras: list[str] | None) -> list[str]:
    """Cameras that can be left out: those named, or all.

    Raises
    ------
    InputError
        There are fewer than three cameras, or no camera of a given name.
    """
    names = sequence.cameras.names
    if len(names) < 3:
        raise InputError(
            "A camera can only be left out when two others stay.",
            key="--holdout-cameras",
            expected="a recording of three cameras or more",
            found=f"{len(names)}: {', '.join(names)}",
        )
    if cameras is not None and not cameras:
        raise InputError(
            "No camera is named to leave out.",
            key="--holdout-cameras",
            expected=f"'each', or some of {', '.join(names)}",
        )
    for name in names if cameras is None else cameras:
        if name not in names:
            raise InputError(
                f"There is no camera '{name}' to leave out{did_you_mean(name, names)}",
                key="--holdout-cameras",
                expected=f"'each', or some of {', '.join(names)}",
            )
    return names if cameras is None else cameras


def without_camera(sequence: Sequence, name: str) -> Sequence:
    """The sequence without one of its cameras."""
    kept = [n for n in sequence.cameras.names if n != name]
    return replace(
        sequence,
        detections=sequence.detections.sel(camera=kept),
        cameras=CameraArray(tuple(sequence.cameras[n] for n in kept)),
    )


def _score(
    sequence: Sequence, name: str, result: FTEResult, likelihood: float, fit: tuple[str, ...]
) -> HeldOut:
    markers = result.skeleton.marker_names
    camera = sequence.cameras[name]
    pixels = sequence.pixels(markers, likelihood)[:, sequence.cameras.names.index(name)]
    table = {m.name: m.sd_px for m in result.skeleton.markers}
    noise = result.parameters.get("noise_px", table)
    sd = np.array([noise[m] for m in markers])
    nominal = _errors(pixels, camera.project(result.positions))
    fitted = np.full(nominal.shape, np.nan)
    half = sequence.n_frames // 2
    first = np.arange(sequence.n_frames) < half
    for scored, used in ((first, ~first), (~first, first)):
        shown = np.where(used[:, None, None], pixels, np.nan)
        parameters, theta = fit_camera(camera, shown, result.positions, sequence.fps, sd, fit)
        view = CameraArray((camera,))
        offsets = time_offsets(view, parameters, theta)
        moved = corrected_cameras(view, parameters, theta)
        predicted = predict(moved, result.positions, offsets, 1.0 / sequence.fps)[:, 0]
        fitted[scored] = _errors(pixels, predicted)[scored]
    return HeldOut(name, str(result.status), nominal, fitted)


def _errors(pixels: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Distance (N, M), px; NaN where nothing was detected, ∞ where nothing is predicted."""
    error = np.linalg.norm(predicted - pixels, axis=-1)
    seen = np.isfinite(pixels).all(-1)
    return np.where(seen, np.where(np.isfinite(error), error, np.inf), np.nan)


def fit_camera(
    camera: Camera,
    pixels: np.ndarray,
    positions: np.ndarray,
    fps: float,
    sd_px: np.ndarray,
    families: tuple[str, ...] = CAMERA_FAMILIES,
    widths: PriorWidths | None = None,
) -> tuple[Parameters, np.ndarray]:
    """Time offset and correction of one camera that sees a known trajectory.

    The reprojection error, with the loss and the priors of the trajectory problem, is minimised by
    Gauss–Newton steps with reweighting, halved until they descend.

    Parameters
    ----------
    camera : Camera
        With its calibration as given.
    pixels : (N, M, 2)
        Its detections, NaN where none.
    positions : (N, M, 3)
        Marker positions, m; NaN where unknown.
    fps : float
        Frames per second, Hz.
    sd_px : (M,)
        Standard deviations of the detections, px.
    families : tuple of str
        Of ``delay``, ``extrinsics``.
    widths : PriorWidths, optional
        Standard deviations of the priors.

    Returns
    -------
    parameters, theta : Parameters, (P,)
    """
    names = ["", camera.name]  # the first of the cameras is the reference, and has no parameters
    known = ("delay", "extrinsics") if len(positions) >= 3 else ("extrinsics",)
    chosen = tuple(f for f in families if f in known)
    parameters = declare(chosen, None, names, fps, widths or PriorWidths())
    theta = np.zeros(len(parameters))
    near = np.isfinite(positions).all(-1)
    if "delay" in chosen:
        newest = delay.stencil(np.arange(len(positions)), len(positions))
        near = near[newest - np.arange(delay.NODES)[:, None]].all(0)
    shown = np.where(near[..., None], pixels, np.nan)
    term = measurement_term(camera, shown, sd_px, Loss("geman_mcclure"), len(positions), parameters)
    if term is None or not len(parameters):
        return parameters, theta
    compiled = CompiledTerm(term, 1.0 / fps, len(positions), positions.shape[1])
    places = np.array(positions)
    places[~np.isfinite(places)] = 0.0  # never looked at
    return parameters, _descend(compiled, parameters, places, theta)


def _descend(
    term: CompiledTerm, parameters: Parameters, positions: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """Minimise over θ with the positions held fixed."""
    slots = [s for s in term.slots if s.kind == "parameter"]
    rows = [s.rows.start for s in slots]
    columns = np.array([s.item for s in slots], dtype=int)

    def value(at: np.ndarray) -> float:
        e = term.normalised(Point(np.empty(0), at, positions))
        return float(term.term.loss.value(e).sum() + 0.5 * ((at / parameters.sd) ** 2).sum())

    best = value(theta)
    for _ in range(_ITERATIONS):
        found = term.evaluate(Point(np.empty(0), theta, positions), exact=False)
        slope = found.slope[:, rows] * parameters.sd[columns][:, None]
        z = (theta / parameters.sd)[columns]
        gradient = np.einsum("ck,cpk->p", found.losses[1] / term.sd, slope) + z
        weighted = slope * (found.losses[3] / term.sd**2)[:, None]
        hessian = np.einsum("cik,cjk->ij", weighted, slope) + np.eye(len(rows))
        step = -np.linalg.solve(hessian, gradient)
        for _ in range(_HALVINGS):
            trial = theta.copy()
            trial[columns] += step * parameters.sd[columns]
            trial = np.clip(trial, -parameters.bound, parameters.bound)
            now = value(trial)
            if now <= best:
                break
            step = 0.5 * step
        else:
            return theta
        theta, best = trial, now
        if np.abs(step).max() < _SMALL:
            break
    return theta


def holdout_metrics(held: list[HeldOut]) -> dict[str, Any]:
    """``heldout_px`` and ``heldout_nominal_px`` of metrics.json, pooled over cameras and by camera."""
    from acino_fte.metrics import NEAR_PX

    def scores(errors: list[np.ndarray]) -> dict[str, Any]:
        seen = np.concatenate([e[~np.isnan(e)] for e in errors])
        there = seen[np.isfinite(seen)]
        if not len(there):
            return {"median": None, "p90": None, "within_20px": None, "coverage": 0.0, "n": len(seen)}
        return {
            "median": float(np.median(there)),
            "p90": float(np.quantile(there, 0.9)),
            "within_20px": float((there <= NEAR_PX).mean()),
            "coverage": len(there) / len(seen),
            "n": len(seen),
        }

    result = {}
    for key, field in (("heldout_px", "fitted"), ("heldout_nominal_px", "nominal")):
        per_camera = {h.camera: {**scores([getattr(h, field)]), "status": h.status} for h in held}
        result[key] = {**scores([getattr(h, field) for h in held]), "per_camera": per_camera}
    return result
