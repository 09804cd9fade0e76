"""Depth from a lidar: what its returns say of the skeleton, and the terms that they become.

A lidar sees the body's surface, which lies before the joints. With z the third row of a camera's x = R p + t,
s_m the distance of the surface before marker m along the line of sight, and z̃ the depth of the surface at the
marker, the depth residual is (the thesis's e_depth, whose surface is the joint: s = 0)

    d = z(p_m) − s_m − z̃.

When the whole body is asked for, every return on it counts as a distance, along its ray, to a capsule around
the link between two markers a, b. A ray that passes the link's axis at the side g meets a capsule of radius r
at √(r² − g²) = c r before the axis, so

    d = z((1 − u) p_a + u p_b) − c ((1 − u) s_a + u s_b) − z̃,

with 0 ≤ u ≤ 1 and c held as they were when the return was attached. (The distance from the axis less r is no
substitute: with a range noise of the size of r it has no sign, and draws the animal onto its own skin.)

The surface is expected at o_m, the radius of the body's capsules or a limb's usual thickness. An animal may
be hairier or thicker than that everywhere, and each part of it by itself:

    s_m = o_m + κ + δ_m,   κ ~ N(0, σ_κ²),   δ_m ~ N(0, σ_m²).

With κ integrated out, θ = s − o has the covariance D (I + σ_κ² u uᵀ) D, D = diag(σ_m), u_m = 1/σ_m, which is
whitened by (I − β û ûᵀ) D⁻¹ with û = u/|u| and β = 1 − (1 + σ_κ² |u|²)^(−1/2). Independent priors would claim
to know the mean of all surfaces, and with it the depth of the animal, √M times too well.

Which return belongs to what is decided by :mod:`acino_fte.association`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte import terms
from acino_fte.cameras import Camera
from acino_fte.losses import Loss
from acino_fte.parameters import POSE, Parameters
from acino_fte.residuals import AXES, Derived, Handle, Let, Residual
from acino_fte.terms import POSE_NAMES, Term, combination_residual, in_camera, moved_in_camera, pose_data

if TYPE_CHECKING:
    import sympy as sp

    from acino_fte.skeleton import Skeleton

LIMB = 0.03
"""How far the surface lies before a joint of a limb, m."""
COMMON, OWN = 0.01, 0.6
"""Standard deviations of the surface: of all together, m, and of each as a share of what is expected."""
_SOURCES = (Path(__file__), Path(terms.__file__))


@dataclass(frozen=True, eq=False)
class MarkerDepths:
    """Depths of the surface at markers. K measurements, at most one of a marker in a frame.

    Attributes
    ----------
    frame, marker : (K,) int
        Frames are indices into the sequence.
    depth : (K,)
        z of the surface in the camera's frame, m.
    sd : (K,)
        m.
    count : (K,) int
        How many returns are in it.
    """

    frame: np.ndarray
    marker: np.ndarray
    depth: np.ndarray
    sd: np.ndarray
    count: np.ndarray

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, eq=False)
class BodyReturns:
    """Returns on the body, each attached to a link. K returns.

    Attributes
    ----------
    frame : (K,) int
        Index into the sequence.
    start, end : (K,) int
        Markers at the ends of the link.
    along : (K,)
        u: where on the link, 0 at `start` to 1 at `end`.
    bulge : (K,)
        c: how much of the surface's distance lies before the link where the ray passes.
    depth : (K,)
        z of the return in the camera's frame, moved to the time of the frame, m.
    sd : (K,)
        m.
    """

    frame: np.ndarray
    start: np.ndarray
    end: np.ndarray
    along: np.ndarray
    bulge: np.ndarray
    depth: np.ndarray
    sd: np.ndarray

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, eq=False)
class DepthData:
    """What a lidar says of the skeleton, for the problem.

    Attributes
    ----------
    camera : str
        The camera whose frame it is in.
    measured : MarkerDepths or BodyReturns
    surface : bool
        Whether the surface lies before the joints, by distances to be estimated.
    loss : Loss
    """

    camera: str
    measured: MarkerDepths | BodyReturns
    surface: bool = True
    loss: Loss = field(default_factory=lambda: Loss("geman_mcclure"))


def expected_surface(skeleton: Skeleton) -> np.ndarray:
    """Expected distance of the surface before every marker (M,), m.

    The radius of the species' widest capsule that ends there, else :data:`LIMB`.
    """
    mean = np.zeros(len(skeleton.markers))
    for a, b, radius in skeleton.capsules:
        mean[[a, b]] = np.maximum(mean[[a, b]], radius)
    return np.where(mean > 0, mean, LIMB)


def surface_sd(expected: np.ndarray) -> np.ndarray:
    """Prior standard deviation of every marker's surface (M,), m, by itself and with all others."""
    return np.hypot(OWN * expected, COMMON)


def surface_term(parameters: Parameters) -> Term:
    """The joint prior of the surface's parameters."""
    places = parameters.of_family("surface")
    own, count = OWN * _origins(parameters)[places], len(places)
    u = 1 / own
    beta = 1 - 1 / np.sqrt(1 + COMMON**2 * (u @ u))
    whitening = (np.eye(count) - beta * np.outer(u, u) / (u @ u)) / own  # (instances, parameters), 1/m
    data = {f"a{i}": whitening[:, i] for i in range(count)}
    residual = combination_residual(count, "surface", "of its standard deviation")
    items, numbers = np.tile(places, (count, 1)), np.arange(count)
    frames, sd = np.zeros(count, dtype=int), np.ones(count)
    return Term("surface", residual, frames, items, data, sd, numbers=numbers)


def depth_terms(data: DepthData, camera: Camera, n_frames: int, parameters: Parameters) -> list[Term]:
    """The terms of some depth data; none when it is empty.

    ``parameters`` have the surface's family where ``data.surface``; a camera that is itself estimated takes
    its lidar along.
    """
    if not len(data.measured):
        return []
    if isinstance(data.measured, MarkerDepths):
        return [_marker_term(data, data.measured, camera, n_frames, parameters)]
    return [_body_term(data, data.measured, camera, n_frames, parameters)]


def _marker_term(
    data: DepthData, found: MarkerDepths, camera: Camera, n_frames: int, parameters: Parameters
) -> Term:
    pose, late = _camera_places(camera, parameters)
    surface = parameters.of_family("surface") if data.surface else np.empty(0, dtype=int)
    columns = ([late] if late is not None else []) + pose
    items = np.empty((len(found), 1 + len(columns) + (1 if len(surface) else 0)), dtype=int)
    items[:, 0], items[:, 1 : 1 + len(columns)] = found.marker, columns
    origin = np.zeros(len(found))
    if len(surface):
        items[:, -1] = surface[found.marker]
        origin = _origins(parameters)[items[:, -1]]
    values = {"depth": found.depth, "origin": origin, **pose_data(camera, found.frame, n_frames)}
    residual = depth_residual(moved=bool(pose), delayed=late is not None, surface=len(surface) > 0)
    return Term("depth", residual, found.frame, items, values, found.sd, data.loss, camera.name)


def _body_term(
    data: DepthData, found: BodyReturns, camera: Camera, n_frames: int, parameters: Parameters
) -> Term:
    pose, _ = _camera_places(camera, parameters)
    surface = parameters.of_family("surface")
    items = np.empty((len(found), 4 + len(pose)), dtype=int)
    items[:, 0], items[:, 1] = found.start, found.end
    items[:, 2], items[:, 3] = surface[found.start], surface[found.end]
    items[:, 4:] = pose
    origins, u = _origins(parameters), found.along
    values = {
        "along": u,
        "bulge": found.bulge,
        "origin": (1 - u) * origins[items[:, 2]] + u * origins[items[:, 3]],
        "depth": found.depth,
        **pose_data(camera, found.frame, n_frames),
    }
    numbers = np.arange(len(found))
    residual = body_residual(moved=bool(pose))
    return Term("depth", residual, found.frame, items, values, found.sd, data.loss, camera.name, numbers)


def _camera_places(camera: Camera, parameters: Parameters) -> tuple[list[int], int | None]:
    """Places in θ of a camera's correction (empty when it has none) and of its time offset."""
    pose = [parameters.place("extrinsics", camera.name, component) for component in POSE]
    return [p for p in pose if p is not None], parameters.place("delay", camera.name)


def _origins(parameters: Parameters) -> np.ndarray:
    return np.array([p.origin for p in parameters.entries])


@cache
def depth_residual(*, moved: bool = False, delayed: bool = False, surface: bool = True) -> Residual:
    """z(p) − (origin + s) − depth, m.

    Items: the marker; the time offset, when ``delayed``; the six parameters of the camera's correction, when
    ``moved``; the marker's surface, when ``surface``.
    """

    def derive(handles: list[Any], data: dict[str, sp.Symbol], let: Let) -> Derived:
        local = in_camera(handles[0], data, let)
        if moved:
            local = moved_in_camera(local, handles[1:4], handles[4:7], let)
        return [local[2] - data["origin"] - (handles[-1] if surface else 0) - data["depth"]], []

    count = 1 + delayed
    handles = [Handle("position", delay=1 if delayed else None)]
    handles += [Handle("parameter", item=count + k) for k in range(6 * moved + surface)]
    name = "-".join(["depth"] + ["moved"] * moved + ["delayed"] * delayed + ["surface"] * surface)
    data = ("depth", "origin", *POSE_NAMES)
    return Residual(name, tuple(handles), data, ("d",), "m", derive, _SOURCES)


@cache
def body_residual(*, moved: bool = False) -> Residual:
    """Distance of a return to the capsule around a link, m: z(u) − c (origin + (1 − u) s_a + u s_b) − depth.

    Items: the two markers, their two surfaces, then the camera's correction, when ``moved``.
    """

    def derive(handles: list[Any], data: dict[str, sp.Symbol], let: Let) -> Derived:
        u = data["along"]
        on_link = tuple(
            let(f"link_{a}", (1 - u) * p + u * q)
            for a, p, q in zip(AXES, handles[0], handles[1], strict=True)
        )
        local = in_camera(on_link, data, let)
        if moved:
            local = moved_in_camera(local, handles[4:7], handles[7:10], let)
        surface = data["origin"] + (1 - u) * handles[2] + u * handles[3]
        return [local[2] - data["bulge"] * surface - data["depth"]], []

    handles = [Handle("position", item=0), Handle("position", item=1)]
    handles += [Handle("parameter", item=2 + k) for k in range(2 + 6 * moved)]
    name = "body-moved" if moved else "body"
    data = ("along", "bulge", "origin", "depth", *POSE_NAMES)
    return Residual(name, tuple(handles), data, ("d",), "m", derive, _SOURCES)
