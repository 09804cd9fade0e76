"""A result as one labelled dataset: trajectory, detections, standard deviations, estimated parameters."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from acino_fte.metrics import json_safe
from acino_fte.parameter_table import ParameterTable, parameter_tables

if TYPE_CHECKING:
    from acino_fte.result import FTEResult

_KEYPOINTS = ("time", "keypoints", "individuals")
_PIXELS = ("time", "camera", "keypoints", "pixel")
Variables = dict[str, tuple[Any, ...]]


def to_dataset(result: FTEResult) -> xr.Dataset:
    """Everything as one labelled dataset, in the layout of the movement package.

    Parameters
    ----------
    result : FTEResult
        In whatever status it is, of whatever method.

    Returns
    -------
    xarray.Dataset
        ``position`` (time, space, keypoints, individuals), m, world frame, NaN where there is none;
        ``confidence`` (time, keypoints, individuals), mean likelihood of the detections used, NaN where
        there was none; ``n_views`` likewise, how many there were; ``detection`` and ``residual`` =
        reprojected − detected (time, camera, keypoints, pixel), px. Coordinates ``time`` (s, from the start
        of the recording) and ``frame`` along it. The attributes carry status, fps, method, version, units,
        options, and the findings and parameters as JSON.

        With a skeleton: ``q``, ``dq``, ``ddq`` (time, dof), m and rad as the coordinate ``dof_unit`` says.
        With uncertainty: ``position_sd`` like ``position``; ``position_covariance`` (time, space,
        space_other, keypoints, individuals), m²; ``q_sd`` (time, dof). With estimated parameters:
        ``time_offset`` (camera), s; ``segment_scale`` (group); ``extrinsics_rotation``, rad, and
        ``extrinsics_translation``, m (camera, space); ``marker_offset`` (keypoints, space), m; ``noise``
        (keypoints), px; each with its ``…_sd`` where that is known.

    References
    ----------
    The movement package, https://movement.neuroinformatics.dev: its dataset of poses.
    """
    seen = np.isfinite(result.observed).all(-1)
    confidence = _confidence(result, seen)[..., None]
    variables: Variables = {
        "position": (_SPACE, _spatial(result.positions), _note("position, world frame", "m")),
        "confidence": (_KEYPOINTS, confidence, _note("mean likelihood of the detections used", "1")),
        "n_views": (_KEYPOINTS, seen.sum(axis=1)[..., None], _note("cameras that saw the marker", "1")),
        "detection": (_PIXELS, result.observed, _note("detections that entered the problem", "px")),
        "residual": (_PIXELS, result.residuals, _note("reprojected minus detected", "px")),
    }
    coordinates = _coordinates(result)
    if result.q.shape[1]:
        variables |= _states(result)
        coordinates |= _dof_coordinates(result)
    if result.position_covariance is not None:
        variables |= _deviations(result.position_covariance)
        coordinates["space_other"] = ["x", "y", "z"]
    for table in parameter_tables(result.parameters):
        _add_parameters(table, variables, coordinates, result)
    return xr.Dataset(variables, coordinates, _attributes(result))


_SPACE = ("time", "space", "keypoints", "individuals")


def _note(text: str, units: str) -> dict[str, str]:
    return {"long_name": text, "units": units}


def _spatial(values: np.ndarray) -> np.ndarray:
    """(N, M, 3) in the order of the dimensions of ``position``: (N, 3, M, 1)."""
    return values.transpose(0, 2, 1)[..., None]


def _states(result: FTEResult) -> Variables:
    dims = ("time", "dof")
    states: Variables = {
        "q": (dims, result.q, _note("degrees of freedom", "see dof_unit")),
        "dq": (dims, result.dq, _note("first time derivative of q", "see dof_unit, per s")),
        "ddq": (dims, result.ddq, _note("second time derivative of q", "see dof_unit, per s^2")),
    }
    if result.q_sd is not None:
        states["q_sd"] = (dims, result.q_sd, _note("standard deviation of q", "see dof_unit"))
    return states


def _deviations(covariance: np.ndarray) -> Variables:
    """Standard deviations along the axes, and covariances, of positions: (N, M, 3, 3), m²."""
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    whole = covariance.transpose(0, 2, 3, 1)[..., None]
    dims = (*_SPACE[:2], "space_other", *_SPACE[2:])
    return {
        "position_sd": (_SPACE, _spatial(sd), _note("standard deviation of position along the axis", "m")),
        "position_covariance": (dims, whole, _note("covariance of position", "m^2")),
    }


def _add_parameters(
    table: ParameterTable, variables: Variables, coordinates: dict[str, Any], result: FTEResult
) -> None:
    """Add a family of parameters, along the cameras, segment groups or markers where it is theirs."""
    kind, width = table.kind, table.values.shape[1]
    if kind.variable in variables or kind.variable in coordinates:
        return  # the attribute 'parameters' has it
    labels: dict[str, list[str]] = {
        "camera": result.sequence.cameras.names,
        "group": list(result.skeleton.groups),
        "keypoints": result.skeleton.marker_names,
    }
    fitting = [dim for dim, names in labels.items() if set(table.names) <= set(names)]
    dim = kind.along if kind.along in fitting else (fitting or [f"{kind.variable}_name"])[0]
    names = labels.get(dim, list(table.names))
    dims: tuple[str, ...] = () if table.names == ("",) else (dim,)
    if dims:
        coordinates.setdefault(dim, names)
    if width > 1:
        dims += ("space",) if width == 3 else (f"{kind.variable}_component",)
    for suffix, text, values in (("", "", table.values), ("_sd", ", standard deviation", table.sd)):
        if values is not None:
            whole = _along(table, values, names) if dim in dims else values[0]
            whole = whole[..., 0] if width == 1 else whole
            variables[kind.variable + suffix] = (dims, whole, _note(kind.title + text, kind.unit))


def _along(table: ParameterTable, values: np.ndarray, names: list[str]) -> np.ndarray:
    """Values (K, D) along all the names, NaN for those that have none."""
    out = np.full((len(names), values.shape[1]), np.nan)
    out[[names.index(name) for name in table.names]] = values
    return out


def _confidence(result: FTEResult, seen: np.ndarray) -> np.ndarray:
    """(N, M) mean likelihood of the detections that entered the problem; NaN without one."""
    detections = result.sequence.detections.reindex(marker=result.skeleton.marker_names)
    likelihood = detections.likelihood.transpose("frame", "camera", "marker").values
    n_views = seen.sum(axis=1)
    total = np.where(seen, likelihood, 0.0).sum(axis=1)
    return np.where(n_views > 0, total / np.maximum(n_views, 1), np.nan)


def _coordinates(result: FTEResult) -> dict[str, Any]:
    frames = np.asarray(result.sequence.frames)
    return {
        "time": ("time", frames / result.sequence.fps, _note("time from the start of the recording", "s")),
        "frame": ("time", frames, {"long_name": "frame, counted from 0 at the start of the recording"}),
        "space": ["x", "y", "z"],
        "keypoints": result.skeleton.marker_names,
        "individuals": ["id_0"],
        "camera": result.sequence.cameras.names,
        "pixel": ["u", "v"],
    }


def _dof_coordinates(result: FTEResult) -> dict[str, Any]:
    dofs = result.skeleton.dofs
    return {
        "dof": result.skeleton.dof_names,
        "dof_unit": ("dof", [dof.unit for dof in dofs]),
        "dof_lower": ("dof", [dof.lower for dof in dofs], _note("lower limit", "see dof_unit")),
        "dof_upper": ("dof", [dof.upper for dof in dofs], _note("upper limit", "see dof_unit")),
    }


def _attributes(result: FTEResult) -> dict[str, Any]:
    """Attributes that netCDF can hold: texts and numbers."""
    from acino_fte import __version__

    return {
        "ds_type": "poses",
        "source_software": "acino_fte",
        "version": __version__,
        "status": str(result.status),
        "converged": int(result.status.ok),
        "advice": result.status.advice,
        "sequence": result.sequence.name,
        "species": result.skeleton.name,
        "method": result.method,
        "fps": float(result.sequence.fps),
        "time_unit": "seconds",
        "units": "m, rad, s, px",
        "objective": float(result.objective),
        "iterations": int(result.iterations),
        "options": json.dumps(json_safe(result.options)),
        "parameters": json.dumps(json_safe(result.parameters)),
        "findings": json.dumps(json_safe(result.findings), ensure_ascii=False),
    }
