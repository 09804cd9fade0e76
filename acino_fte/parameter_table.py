"""Estimated parameters as tables: one for every family of numbers, with names, units and deviations.

What a result calls ``parameters`` (see :class:`acino_fte.result.FTEResult`) becomes arrays here, for the
dataset, the figure and the report. The families that are known have a title and a unit to be shown in; any
other family of numbers is taken as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Kind:
    """What a family of parameters is: its title and quantity, its variable in a dataset, units and digits.

    ``part`` is the key under a name (the two of ``extrinsics``); ``along`` is what the names are names of.
    A value is ``factor`` times as large in the unit it is shown in.
    """

    title: str
    quantity: str
    variable: str
    unit: str
    shown: str = ""
    factor: float = 1.0
    digits: int = 3
    along: str = "name"
    part: str = ""


_KINDS: dict[str, tuple[Kind, ...]] = {
    "time_offset_s": (
        Kind("Time offset of the camera", "Offset", "time_offset", "s", "ms", 1e3, 2, along="camera"),
    ),
    "segment_scale": (Kind("Scale of the segments", "Factor", "segment_scale", "1", along="group"),),
    "extrinsics": (
        Kind(
            "Rotation of the camera",
            "Angle",
            "extrinsics_rotation",
            unit="rad",
            shown="°",
            factor=math.degrees(1.0),
            along="camera",
            part="rotation_rad",
        ),
        Kind(
            "Shift of the camera",
            "Shift",
            "extrinsics_translation",
            unit="m",
            shown="cm",
            factor=1e2,
            digits=2,
            along="camera",
            part="translation_m",
        ),
    ),
    "marker_offset_m": (
        Kind("Shift of the marker in its link", "Shift", "marker_offset", "m", "mm", 1e3, 1, "keypoints"),
    ),
    "surface_offset_m": (
        Kind("Surface before the marker", "Distance", "surface_offset", "m", "mm", 1e3, 1, "keypoints"),
    ),
    "noise_px": (Kind("Detection noise, sd", "Noise", "noise", "px", "px", 1.0, 2, "keypoints"),),
}
_SUFFIXES = {"_s": "s", "_m": "m", "_px": "px", "_rad": "rad", "_hz": "Hz"}


@dataclass(frozen=True, eq=False)
class ParameterTable:
    """One family of K parameters with D components each (1, or 3 for a vector x, y, z).

    Attributes
    ----------
    family : str
        Its key in ``FTEResult.parameters``.
    kind : Kind
    names : tuple of str
        K names: cameras, segment groups, markers.
    values : (K, D)
        SI units (px for images).
    sd : (K, D) or None
        Standard deviations; NaN where one is not known.
    """

    family: str
    kind: Kind
    names: tuple[str, ...]
    values: np.ndarray
    sd: np.ndarray | None = field(default=None)

    @property
    def shown(self) -> np.ndarray:
        """Values (K, D) in the unit they are shown in."""
        return self.kind.factor * self.values

    @property
    def shown_sd(self) -> np.ndarray:
        """Standard deviations (K, D) in the unit they are shown in; NaN where there are none."""
        return self.kind.factor * (np.full(self.values.shape, np.nan) if self.sd is None else self.sd)


def parameter_tables(parameters: Mapping[str, Any]) -> list[ParameterTable]:
    """Tables of all families of numbers, known ones first; what is not numbers is left out.

    Parameters
    ----------
    parameters : dict
        Family → name → number or vector; family → number; extrinsics: camera → part → vector.
        ``<family>_sd`` has the standard deviations in the same shape.
    """
    order = [*(f for f in _KINDS if f in parameters), *(f for f in parameters if f not in _KINDS)]
    families = [f for f in order if not (f.endswith("_sd") and f.removesuffix("_sd") in parameters)]
    return [table for family in families for table in _tables(parameters, family)]


def _tables(parameters: Mapping[str, Any], family: str) -> Iterator[ParameterTable]:
    found, deviations = parameters[family], parameters.get(f"{family}_sd")
    if not isinstance(found, Mapping):
        found = {"": found}
        deviations = {"": deviations}
    for kind in _KINDS.get(family, (_plain(family),)):
        values = _matrix(found, list(found), kind.part)
        if values is None or not values.size:
            continue
        sd = _matrix(deviations, list(found), kind.part) if isinstance(deviations, Mapping) else None
        sd = sd if sd is not None and sd.shape == values.shape else None
        yield ParameterTable(family, kind, tuple(map(str, found)), values, sd)


def _plain(family: str) -> Kind:
    """What can be said of a family by its name alone."""
    suffix = next((s for s in _SUFFIXES if family.endswith(s)), "")
    unit = _SUFFIXES.get(suffix, "")
    name = family.removesuffix(suffix)
    return Kind(name.replace("_", " ").capitalize(), "Value", name, unit or "1", unit, digits=4)


def _matrix(values: Mapping[str, Any], names: list[str], part: str) -> np.ndarray | None:
    """(K, D) numbers of the names, NaN where one has none; None when they are not numbers of one shape."""
    rows = [values.get(name) for name in names]
    if part:
        rows = [row.get(part) if isinstance(row, Mapping) else None for row in rows]
    try:
        arrays = [None if row is None else np.asarray(row, dtype=float).ravel() for row in rows]
        width = max(len(a) for a in arrays if a is not None)
        return np.stack([np.full(width, np.nan) if a is None else a for a in arrays])
    except (TypeError, ValueError):
        return None
