"""Terms of the trajectory problem: residuals, and tables of where they apply.

A :class:`Term` says for which frames and items a :class:`~acino_fte.residuals.Residual` holds, with which
data, standard deviation and loss. Both lowerings are generic over terms: adding a depth, contact, symmetry
or bone-length term is writing one more residual and its table, here or in a module of one's own; no solver
is touched (docs/extending.md).

The objective is the negative log-posterior Σ ρ(r/σ): with the squared loss, ½(r/σ)².
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte import projection
from acino_fte.cameras import Camera, CameraArray
from acino_fte.losses import Loss
from acino_fte.parameters import POSE, Parameters
from acino_fte.residuals import AXES, Derived, Handle, Let, Residual
from acino_fte.skeleton import Skeleton

if TYPE_CHECKING:
    import sympy as sp


@dataclass(frozen=True, eq=False)
class Term:
    """A residual applied K times.

    Attributes
    ----------
    family : str
        ``meas``, ``model``, ``prior``, …: the explicit lowering calls its slack ``slack_<family>``.
    residual : Residual
    frames : (K,) int
        Frame of each instance, counted from the first of the problem.
    items : (K, I) int
        Markers, degrees of freedom or parameters that the handles refer to.
    data : dict
        Each name to a number for all instances or an array (K,).
    sd : (K,)
        Standard deviation, in the residual's unit.
    loss : Loss
    label : str, optional
        What the instances have in common beside the family: the camera's name.
    numbers : (K,) int, optional
        Tells instances apart that have frame and items in common, such as returns on one link.
    """

    family: str
    residual: Residual
    frames: np.ndarray
    items: np.ndarray
    data: Mapping[str, float | np.ndarray]
    sd: np.ndarray
    loss: Loss = field(default_factory=lambda: Loss("squared"))
    label: str = ""
    numbers: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, keep: np.ndarray) -> Term:
        """The instances for which ``keep`` (K,) bool is true."""
        data = {k: v[keep] if isinstance(v, np.ndarray) else v for k, v in self.data.items()}
        return replace(
            self,
            frames=self.frames[keep],
            items=self.items[keep],
            data=data,
            sd=self.sd[keep],
            numbers=None if self.numbers is None else self.numbers[keep],
        )


_NONE = Parameters()
POSE_NAMES = tuple(f"r{i}{j}" for i in range(3) for j in range(3)) + ("tx", "ty", "tz")
"""Names of a camera's pose, world to camera, in a residual's data."""


@cache
def measurement_residual(model: str, *, moved: bool = False, delayed: bool = False) -> Residual:
    """Reprojection residual of a marker, px: π(C(ρ)·(R·p + t) + d) − (u, v).

    Items: the marker; the time offset, when ``delayed``, so that p is the position at t + τ; then, when
    ``moved``, the six parameters ρ, d of the camera's correction. C is Cayley's rotation,
    C(ρ) x = x + (ρ × x + ½ ρ × (ρ × x)) / (1 + ρ²/4), which turns by 2 atan(|ρ|/2) about ρ.
    """

    def derive(handles: list[Any], data: dict[str, sp.Symbol], let: Let) -> Derived:
        local = in_camera(handles[0], data, let)
        if moved:
            local = moved_in_camera(local, handles[1:4], handles[4:7], let)
        u, v = projection.project(model, (local[0], local[1], local[2]))
        return [u - data["u"], v - data["v"]], [local[2]]

    data = ("u", "v", *POSE_NAMES, *projection.parameter_names(model))
    sources = (Path(__file__), Path(projection.__file__))
    handles = [Handle("position", delay=1 if delayed else None)]
    if moved:
        handles += [Handle("parameter", item=1 + delayed + k) for k in range(6)]
    name = "-".join([model] + ["moved"] * moved + ["delayed"] * delayed)
    return Residual(name, tuple(handles), data, ("u", "v"), "px", derive, sources)


def in_camera(p: tuple[Any, ...], data: dict[str, sp.Symbol], let: Let) -> list[Any]:
    """R p + t with the camera's pose in the residual's data."""
    return [
        let(f"local_{AXES[i]}", sum(data[f"r{i}{j}"] * p[j] for j in range(3)) + data[f"t{AXES[i]}"])
        for i in range(3)
    ]


def moved_in_camera(local: list[Any], rho: list[Any], shift: list[Any], let: Let) -> list[Any]:
    """A point in the camera's frame after the camera's correction."""

    def cross(a: list[Any], b: list[Any]) -> list[Any]:
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    once = [let(f"once_{a}", e) for a, e in zip(AXES, cross(rho, local), strict=True)]
    twice = [let(f"twice_{a}", e) for a, e in zip(AXES, cross(rho, once), strict=True)]
    size = let("size", 1 + sum(r * r for r in rho) / 4)
    return [let(f"moved_{AXES[i]}", local[i] + (once[i] + twice[i] / 2) / size + shift[i]) for i in range(3)]


def _jump(handles: list[Any], _: dict[str, sp.Symbol], _let: Let) -> Derived:
    now, before = handles
    return [now - before], []


def _from_mean(handles: list[Any], data: dict[str, sp.Symbol], _let: Let) -> Derived:
    return [handles[0] - data["mean"]], []


def _to_point(handles: list[Any], data: dict[str, sp.Symbol], _let: Let) -> Derived:
    return [handles[0][i] - data[f"p{a}"] for i, a in enumerate(AXES)], []


_HERE = (Path(__file__),)
JUMP = Residual(
    "jump", (Handle("acceleration"), Handle("acceleration", 1)), (), ("w",), "m/s² or rad/s²", _jump, _HERE
)
PRIOR = Residual("prior", (Handle("dof"),), ("mean",), ("q",), "m or rad", _from_mean, _HERE)
WIDTH = Residual(
    "width", (Handle("parameter"),), ("mean",), ("theta",), "of the parameter", _from_mean, _HERE
)
POINT = Residual("point", (Handle("position"),), ("px", "py", "pz"), AXES, "m", _to_point, _HERE)


def measurement_term(
    camera: Camera,
    pixels: np.ndarray,
    sd_px: np.ndarray,
    loss: Loss,
    n_frames: int,
    parameters: Parameters = _NONE,
) -> Term | None:
    """Reprojection of every observed marker in one camera; None when it saw nothing.

    ``pixels`` (N, M, 2) are detections, NaN where missing; ``sd_px`` (M,) their standard deviations.
    """
    frames, markers = np.nonzero(np.isfinite(pixels).all(-1))
    if not len(frames):
        return None
    data: dict[str, float | np.ndarray] = {
        "u": pixels[frames, markers, 0],
        "v": pixels[frames, markers, 1],
    }
    data |= pose_data(camera, frames, n_frames)
    names = projection.parameter_names(camera.model)
    data |= dict(zip(names, camera.parameters.tolist(), strict=True))
    delay = parameters.place("delay", camera.name)
    pose = [parameters.place("extrinsics", camera.name, component) for component in POSE]
    moved = pose[0] is not None
    residual = measurement_residual(camera.model, moved=moved, delayed=delay is not None)
    columns = ([delay] if delay is not None else []) + (pose if moved else [])
    items = np.empty((len(frames), 1 + len(columns)), dtype=int)
    items[:, 0], items[:, 1:] = markers, columns
    return Term("meas", residual, frames, items, data, sd_px[markers], loss, camera.name)


def pose_data(camera: Camera, frames: np.ndarray, n_frames: int) -> dict[str, float | np.ndarray]:
    """Numbers for :data:`POSE_NAMES`: of every instance (K,) of a moving camera, one each of a fixed one."""
    rotation, translation = camera.rotation, camera.translation
    if camera.moves:
        rotation = np.moveaxis(np.broadcast_to(rotation, (n_frames, 3, 3))[frames], 0, -1)
        translation = np.moveaxis(np.broadcast_to(translation, (n_frames, 3))[frames], 0, -1)
    data: dict[str, float | np.ndarray] = {f"t{a}": translation[i] for i, a in enumerate(AXES)}
    return data | {f"r{i}{j}": rotation[i, j] for i in range(3) for j in range(3)}


def model_term(skeleton: Skeleton, n_frames: int, fps: float) -> Term:
    """Constant acceleration plus noise: the jump in acceleration at every frame but the first.

    The noise of the species file holds at ``noise_fps``; acceleration is a random walk, so its jump
    over one frame grows with the square root of the frame's length.
    """
    noise = np.array([d.noise for d in skeleton.dofs]) * np.sqrt(skeleton.noise_fps / fps)
    frames, dofs = (a.ravel() for a in np.mgrid[1:n_frames, 0 : len(noise)])
    return Term("model", JUMP, frames, dofs[:, None], {}, noise[dofs])


def prior_term(skeleton: Skeleton, n_frames: int, width: float) -> Term:
    """A weak pull of each limited joint to the middle of its range; σ is ``width`` times half the range.

    It decides what no camera observes (a marker that is never seen), and hardly touches the rest.
    """
    limited = [j for j, d in enumerate(skeleton.dofs) if np.isfinite(d.lower + d.upper)]
    frames, which = (a.ravel() for a in np.mgrid[0:n_frames, 0 : len(limited)])
    dofs = np.array(limited, dtype=int)[which]
    mean = np.array([d.middle for d in skeleton.dofs])[dofs]
    half = np.array([0.5 * (d.upper - d.lower) for d in skeleton.dofs])[dofs]
    return Term("prior", PRIOR, frames, dofs[:, None], {"mean": mean}, width * half)


def parameter_term(parameters: Parameters) -> Term:
    """Gaussian prior of every global parameter but the surface's, which are not independent."""
    items = np.array([i for i, p in enumerate(parameters.entries) if p.family != "surface"], dtype=int)
    frames = np.zeros(len(items), dtype=int)
    return Term("parameter", WIDTH, frames, items[:, None], {"mean": 0.0}, parameters.sd[items])


@cache
def combination_residual(count: int, name: str, unit: str) -> Residual:
    """A linear combination of parameters, Σ a_i θ_i."""

    def derive(handles: list[Any], data: dict[str, sp.Symbol], _let: Let) -> Derived:
        return [sum(data[f"a{i}"] * handle for i, handle in enumerate(handles))], []

    handles = tuple(Handle("parameter", item=i) for i in range(count))
    data = tuple(f"a{i}" for i in range(count))
    return Residual(f"{name}-{count}", handles, data, (name,), unit, derive, _HERE)


def size_terms(parameters: Parameters, cameras: CameraArray, sd: float) -> list[Term]:
    """Hold the size of the set of cameras, the one direction of a similarity that no image shows.

    A shift d in a camera's frame moves its centre c by −Rᵀd, to first order, and the set grows by
    Σ (c − c̄)·(−Rᵀd) / Σ |c − c̄|². Moving cameras count with their first pose.
    """
    poses = [(np.reshape(c.rotation, (-1, 3, 3))[0], np.reshape(c.centre, (-1, 3))[0]) for c in cameras]
    centres = np.array([centre for _, centre in poses])
    spread = centres - centres.mean(axis=0)
    total = float((spread**2).sum())
    places, weights = [], []
    for camera, (rotation, _), arm in zip(cameras, poses, spread, strict=True):
        place = parameters.place("extrinsics", camera.name, "tx")
        if place is not None and total > 0:
            places += [place, place + 1, place + 2]
            weights += (-(rotation @ arm) / total).tolist()
    if not places:
        return []
    data = {f"a{i}": w for i, w in enumerate(weights)}
    frame, items = np.zeros(1, dtype=int), np.array([places])
    return [Term("size", combination_residual(len(places), "size", "1"), frame, items, data, np.array([sd]))]


def point_term(points: np.ndarray, sd: float | np.ndarray, loss: Loss) -> Term:
    """Distance of markers to given points (N, M, 3), m, NaN where unknown: inverse kinematics."""
    frames, markers = np.nonzero(np.isfinite(points).all(-1))
    at = points[frames, markers]
    data = {"px": at[:, 0], "py": at[:, 1], "pz": at[:, 2]}
    sigma = np.broadcast_to(sd, points.shape[:2])[frames, markers]
    return Term("point", POINT, frames, markers[:, None], data, sigma, loss)
