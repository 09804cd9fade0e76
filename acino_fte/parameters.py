"""Global parameters of a recording: what is estimated once, beside the trajectory.

===========  ===========================================================  ==========================
family       parameters                                                   prior standard deviation
===========  ===========================================================  ==========================
scale        log-scale λ of every segment group of the species            0.1
offsets      displacement of every marker in its link's frame, m          0.03 m
delay        time offset τ of every camera but the first, s               half a frame
extrinsics   turn ρ and shift d of every camera but the first:            0.5°, 0.1 m
             x_camera = Cayley(ρ)·(R x + t) + d
surface      how far the body's surface lies before every marker, as     see :mod:`depth`
             a lidar beside the camera sees it; always with a lidar
===========  ===========================================================  ==========================

All priors are Gaussian about zero (the species file, and the calibration as given; a surface counts from
what is expected of it) and all parameters are bounded. The first camera stays as it is: it fixes the origin
of time and the frame of the world.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from acino_fte.skeleton import Skeleton

FAMILIES = ("scale", "offsets", "delay", "extrinsics")
KINEMATIC = ("scale", "offsets")
POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
_UNITS = {"scale": "log", "offsets": "m", "delay": "s", "extrinsics": "rad", "surface": "m"}


@dataclass(frozen=True)
class Parameter:
    """One global parameter: family, whose it is, which component; Gaussian prior about zero, and bound.

    ``sd`` and ``bound`` (|value| ≤ bound) are in the parameter's unit: log, m, s or rad. ``origin`` is what
    the value zero stands for.
    """

    family: str
    owner: str
    component: str
    sd: float
    bound: float
    origin: float = 0.0

    @property
    def name(self) -> str:
        """``family.owner`` or ``family.owner.component``."""
        return ".".join(part for part in (self.family, self.owner, self.component) if part)

    @property
    def unit(self) -> str:
        """``"log"``, ``"m"``, ``"s"`` or ``"rad"``."""
        return "m" if self.component.startswith("t") else _UNITS[self.family]


@dataclass(frozen=True)
class PriorWidths:
    """Standard deviations of the priors.

    Attributes
    ----------
    scale : float
        Of a segment's log-scale.
    delay : float
        Of a camera's time offset, frames.
    rotation, translation : float
        Of a camera's turn (rad, per axis) and shift (m, per axis).
    offset : float
        Of a marker's displacement, m per axis.
    size : float
        Of the relative size of the whole set of cameras, when both scales and cameras are estimated:
        pictures cannot tell a larger animal before wider cameras from a smaller one before nearer ones.
    """

    scale: float = 0.1
    delay: float = 0.5
    rotation: float = float(np.radians(0.5))
    translation: float = 0.1
    offset: float = 0.03
    size: float = 0.005


_REACH = 5.0  # bounds, in prior standard deviations
_REACH_SURFACE = 3.0  # beyond that, a return is on something else
_REACH_DELAY = 3.0  # of half a frame: beyond one and a half frames, the stencil extrapolates


@dataclass(frozen=True)
class Parameters:
    """The parameters of one problem, in the order of the vector θ (P,): kinematic ones first."""

    entries: tuple[Parameter, ...] = ()

    def __len__(self) -> int:
        return len(self.entries)

    @cached_property
    def names(self) -> list[str]:
        """Names in the order of θ."""
        return [p.name for p in self.entries]

    @cached_property
    def _places(self) -> dict[tuple[str, str, str], int]:
        return {(p.family, p.owner, p.component): i for i, p in enumerate(self.entries)}

    @cached_property
    def sd(self) -> np.ndarray:
        """(P,) prior standard deviations."""
        return np.array([p.sd for p in self.entries])

    @cached_property
    def bound(self) -> np.ndarray:
        """(P,) bounds of |θ|."""
        return np.array([p.bound for p in self.entries])

    @cached_property
    def families(self) -> tuple[str, ...]:
        """Families that have a parameter."""
        return tuple(dict.fromkeys(p.family for p in self.entries))

    @cached_property
    def n_kinematic(self) -> int:
        """K: how many of them, from the first, are parameters of the kinematics."""
        return sum(p.family in KINEMATIC for p in self.entries)

    def place(self, family: str, owner: str, component: str = "") -> int | None:
        """Index in θ, None when it is no parameter."""
        return self._places.get((family, owner, component))

    def of_family(self, family: str) -> np.ndarray:
        """Indices in θ of a family's parameters."""
        return np.array([i for i, p in enumerate(self.entries) if p.family == family], dtype=int)


def declare(
    families: Iterable[str], skeleton: Skeleton | None, cameras: list[str], fps: float, widths: PriorWidths
) -> Parameters:
    """The parameters of some families, for a skeleton (None: of cameras only) and cameras by name."""
    chosen = check_families(families)
    entries: list[Parameter] = []
    if "scale" in chosen and skeleton is not None:
        entries += [Parameter("scale", g, "", widths.scale, _REACH * widths.scale) for g in skeleton.groups]
    if "offsets" in chosen and skeleton is not None:
        entries += [
            Parameter("offsets", marker, axis, widths.offset, _REACH * widths.offset)
            for marker in skeleton.marker_names
            for axis in "xyz"
        ]
    if "delay" in chosen:
        sd = widths.delay / fps
        entries += [Parameter("delay", camera, "", sd, _REACH_DELAY * sd) for camera in cameras[1:]]
    if "extrinsics" in chosen:
        for camera in cameras[1:]:
            for component in POSE:
                sd = widths.rotation if component.startswith("r") else widths.translation
                entries.append(Parameter("extrinsics", camera, component, sd, _REACH * sd))
    return Parameters(tuple(entries))


def with_surface(
    parameters: Parameters, markers: list[str], expected: np.ndarray, sd: np.ndarray
) -> Parameters:
    """The same with a distance of the surface for each marker: expected, and standard deviation (M,), m."""
    entries = [
        Parameter("surface", marker, "", float(s), _REACH_SURFACE * float(s), float(m))
        for marker, m, s in zip(markers, expected, sd, strict=True)
    ]
    return Parameters((*parameters.entries, *entries))


def check_families(families: Iterable[str]) -> tuple[str, ...]:
    """Families in their order, none twice.

    Raises
    ------
    InputError
        A name is none of :data:`FAMILIES`.
    """
    names = list(families)
    for name in names:
        if name not in FAMILIES:
            raise InputError(
                f"There is no family of parameters '{name}'{did_you_mean(name, FAMILIES)}",
                key="fit",
                expected=f"some of {', '.join(FAMILIES)}",
                found=", ".join(names),
            )
    return tuple(f for f in FAMILIES if f in names)


def rotation_vector(cayley: np.ndarray) -> np.ndarray:
    """Rotation vector (…, 3), rad, of the Cayley vector ρ = 2 tan(φ/2)·axis that the problem uses."""
    size = np.linalg.norm(cayley, axis=-1, keepdims=True)
    return cayley * np.where(size > 0, 2 * np.arctan(size / 2) / np.where(size > 0, size, 1.0), 1.0)


def cayley_matrix(rho: np.ndarray) -> np.ndarray:
    """Rotation matrix of a Cayley vector ρ (3,): I + ([ρ]× + ½[ρ]×²)/(1 + ρ²/4)."""
    x, y, z = rho
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + (skew + 0.5 * skew @ skew) / (1 + 0.25 * float(rho @ rho))


def describe(
    parameters: Parameters, theta: np.ndarray, sd: np.ndarray | None, reference: str | None = None
) -> dict[str, Any]:
    """Values, and standard deviations under ``<family>_sd``, as a result has them.

    Scales are factors, with the standard deviation s·sd(λ). The ``reference`` camera is listed with zeros.
    """
    result: dict[str, Any] = {}
    for name, family in FAMILY_KEYS.items():
        if family not in parameters.families:
            continue
        zero = _ZEROS.get(family) if reference else None
        first = {} if zero is None else {str(reference): zero}
        result[name] = {**first, **_table(parameters, family, theta, absolute=True)}
        if family == "scale":
            result[name] = {group: math.exp(value) for group, value in result[name].items()}
        elif family == "extrinsics":
            result[name] = {
                camera: {**pose, "rotation_rad": rotation_vector(np.array(pose["rotation_rad"])).tolist()}
                for camera, pose in result[name].items()
            }
        if sd is not None:
            result[f"{name}_sd"] = {**first, **_table(parameters, family, sd)}
            if family == "scale":
                result[f"{name}_sd"] = {g: result[name][g] * v for g, v in result[f"{name}_sd"].items()}
    return result


def _table(
    parameters: Parameters, family: str, values: np.ndarray, *, absolute: bool = False
) -> dict[str, Any]:
    """Values of a family by owner: a number, three of them, or a pose."""
    table: dict[str, Any] = {}
    for parameter, value in zip(parameters.entries, values.tolist(), strict=True):
        if parameter.family != family:
            continue
        value += parameter.origin if absolute else 0.0
        if family == "offsets":
            table.setdefault(parameter.owner, []).append(value)
        elif family == "extrinsics":
            pose = table.setdefault(parameter.owner, {"rotation_rad": [], "translation_m": []})
            pose["translation_m" if parameter.component.startswith("t") else "rotation_rad"].append(value)
        else:
            table[parameter.owner] = value
    return table


FAMILY_KEYS = {
    "segment_scale": "scale",
    "marker_offset_m": "offsets",
    "time_offset_s": "delay",
    "extrinsics": "extrinsics",
    "surface_offset_m": "surface",
}
_ZEROS: dict[str, Any] = {
    "delay": 0.0,
    "extrinsics": {"rotation_rad": [0.0, 0.0, 0.0], "translation_m": [0.0, 0.0, 0.0]},
}
