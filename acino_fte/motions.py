"""Motions: from a recipe to the degrees of freedom over time, for any species.

A recipe states each joint as a mean and harmonics of the stride,

    value(t) = mean + Σ_k a_k · cos(2π·k·(rate·t − lag) + φ_k),

and how the root travels: speed, curvature and lean of the path, and waves about it. Every value stays
inside the range of its degree of freedom: a wave that does not fit is moved and shrunk until it does.

Notation: N frames, Q degrees of freedom. Body frame: x forward, y left, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.errors import InputError, did_you_mean
from acino_fte.kinematics import Kinematics
from acino_fte.skeleton import Dof, Skeleton

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

ROOT_MOTIONS = ("forward", "left", "up", "yaw", "pitch", "roll")
_MARGIN = 0.01  # of a range, kept free at both ends
_CLEARANCE = 0.02  # m, of the lowest marker above the ground


@dataclass(frozen=True)
class Wave:
    """A periodic function of the stride.

    Attributes
    ----------
    mean : float
        Degrees for a turn, metres for a slide.
    harmonics : tuple of (k, amplitude, phase)
        Multiple of the stride rate (a fraction is allowed), amplitude in the unit of the mean, phase in
        degrees.
    lag : float
        Delay, in strides.
    """

    mean: float = 0.0
    harmonics: tuple[tuple[float, float, float], ...] = ()
    lag: float = 0.0

    def __call__(self, stride: np.ndarray) -> np.ndarray:
        """Values (N,) at times (N,) counted in strides."""
        value = np.full(np.shape(stride), float(self.mean))
        for k, amplitude, phase in self.harmonics:
            value += amplitude * np.cos(2 * np.pi * k * (stride - self.lag) + math.radians(phase))
        return value

    def delayed(self, lag: float) -> Wave:
        """The same wave, later by ``lag`` strides."""
        return Wave(self.mean, self.harmonics, self.lag + lag)


@dataclass(frozen=True)
class Recipe:
    """A motion, ready to be put on any species that has its joints.

    Attributes
    ----------
    name, summary : str
    rate : float
        Strides per second.
    speed : float
        Along the path, m/s.
    joints : dict of str to Wave
        By ``link.dof``; ``*`` stands for anything, the first pattern that fits a joint is used. Joints
        that no pattern names stay in the middle of their range, or at zero where that is in it.
    root : dict of str to Wave
        Motion of the root about the path: any of :data:`ROOT_MOTIONS`.
    curvature : float
        Of the path, 1/m; positive to the left.
    lean : float
        Roll of the whole body into the curve about the line on the ground below it, degrees.
    needs : tuple of str
        Patterns of which each must name a joint, or the motion does not fit the species.
    grounded : bool
        Put the lowest marker on the ground instead of taking ``root["up"]`` from the recipe.
    """

    name: str
    summary: str
    rate: float
    speed: float
    joints: dict[str, Wave] = field(default_factory=dict)
    root: dict[str, Wave] = field(default_factory=dict)
    curvature: float = 0.0
    lean: float = 0.0
    needs: tuple[str, ...] = ()
    grounded: bool = False

    def wave(self, joint: str) -> Wave | None:
        """The wave of a joint ``link.dof``, or None."""
        return next((w for pattern, w in self.joints.items() if fnmatchcase(joint, pattern)), None)

    def fits(self, skeleton: Skeleton) -> bool:
        """Whether the species has every joint that the motion needs."""
        return not self.missing(skeleton)

    def missing(self, skeleton: Skeleton) -> list[str]:
        """The needed patterns that name no joint of the species."""
        return [p for p in self.needs if not any(fnmatchcase(n, p) for n in skeleton.dof_names)]


def motion_names(skeleton: Skeleton | None = None) -> list[str]:
    """Names of the motions; with a species, of those that fit it."""
    from acino_fte.motion_recipes import RECIPES

    fitting = [r.name for r in RECIPES if skeleton is None or r.fits(skeleton)]
    return [*fitting, "wander"]


def make_motion(
    kinematics: Kinematics,
    motion: str | Recipe,
    n_frames: int,
    fps: float,
    *,
    seed: int = 0,
    longest_path: float = math.inf,
) -> np.ndarray:
    """Degrees of freedom over time.

    Parameters
    ----------
    kinematics : Kinematics
        Of the species; needed to put the animal on the ground.
    motion : str or Recipe
        A name from :func:`motion_names`, or a recipe of your own.
    n_frames : int
        N.
    fps : float
        Hz.
    seed : int
        Of the random motion ``wander``; the others do not depend on it.
    longest_path : float
        Metres. A recording that would travel further is made as on a treadmill: the same movement of
        the joints at a lower speed over the ground.

    Returns
    -------
    (N, Q) in rad and m, within the ranges of the species. The middle of the path is over the origin.

    Raises
    ------
    InputError
        There is no such motion, or it does not fit the species.
    """
    skeleton = kinematics.skeleton
    recipe = motion if isinstance(motion, Recipe) else find_recipe(skeleton, motion, seed)
    _check_fit(recipe, skeleton)
    time = np.arange(n_frames) / fps
    q = np.zeros((n_frames, len(skeleton.dofs)))
    for j, dof in enumerate(skeleton.dofs):
        wave = recipe.wave(dof.name)
        q[:, j] = resting_value(dof) if wave is None else _fitted(wave, recipe.rate * time, dof)
    travel = recipe.speed * n_frames / fps
    speed = recipe.speed * min(1.0, longest_path / travel) if travel > 0 else 0.0
    place_root(skeleton, recipe, time, speed, q)
    if recipe.grounded:
        _put_on_ground(kinematics, recipe, time, q)
    return q


def find_recipe(skeleton: Skeleton, motion: str, seed: int) -> Recipe:
    """The recipe of a motion by name; ``wander`` is drawn for the species."""
    from acino_fte.motion_recipes import RECIPES
    from acino_fte.wander import wander_recipe

    if motion == "wander":
        return wander_recipe(skeleton, seed)
    for recipe in RECIPES:
        if recipe.name == motion:
            return recipe
    raise InputError(
        f"There is no motion '{motion}'{did_you_mean(motion, motion_names())}",
        key="motion",
        expected=f"one of {', '.join(motion_names(skeleton))} (for the species '{skeleton.name}')",
        remedy="'wander' works for every species",
    )


def _check_fit(recipe: Recipe, skeleton: Skeleton) -> None:
    missing = recipe.missing(skeleton)
    if missing:
        raise InputError(
            f"The motion '{recipe.name}' does not fit the species '{skeleton.name}'.",
            key="motion",
            expected=f"joints named {', '.join(missing)}",
            found=f"joints {', '.join(skeleton.dof_names)}",
            remedy=f"choose one of {', '.join(motion_names(skeleton))}",
        )


def resting_value(dof: Dof) -> float:
    """Zero when it is inside the range, else the middle of the range."""
    return 0.0 if dof.lower < 0 < dof.upper else dof.middle


def _fitted(wave: Wave, stride: np.ndarray, dof: Dof) -> np.ndarray:
    """Values of a wave (N,), moved and shrunk about their middle until they fit the range."""
    value = wave(stride)
    return fit_to_range(np.radians(value) if dof.kind == "turn" else value, dof)


def fit_to_range(value: np.ndarray, dof: Dof) -> np.ndarray:
    """Values (N,) shrunk and moved, not clipped, so that they lie in the range with a small margin."""
    if not math.isfinite(dof.upper - dof.lower) or not value.size:
        return np.clip(value, dof.lower, dof.upper)
    margin = _MARGIN * (dof.upper - dof.lower)
    lower, upper = dof.lower + margin, dof.upper - margin
    low, high = float(value.min()), float(value.max())
    middle, scale = 0.5 * (low + high), 1.0
    if high - low > upper - lower:
        scale = (upper - lower) / (high - low)
    half = 0.5 * scale * (high - low)
    return np.clip(middle, lower + half, upper - half) + scale * (value - middle)


def place_root(skeleton: Skeleton, recipe: Recipe, time: np.ndarray, speed: float, q: np.ndarray) -> None:
    """Write the position and orientation of the root, which travels along the path, into q (N, Q)."""
    from scipy.spatial.transform import Rotation

    wave = {key: recipe.root.get(key, Wave())(recipe.rate * time) for key in ROOT_MOTIONS}
    along = speed * (time - 0.5 * (time[0] + time[-1]))
    heading = recipe.curvature * along
    if recipe.curvature:
        path = np.stack([np.sin(heading), 1 - np.cos(heading), 0 * heading], axis=1) / recipe.curvature
    else:
        path = np.stack([along, 0 * along, 0 * along], axis=1)
    lean = np.full(len(time), -math.radians(recipe.lean) * np.sign(recipe.curvature))
    frame = Rotation.from_euler("ZX", np.stack([heading, lean], axis=1))
    offset = np.stack([wave["forward"], wave["left"], wave["up"]], axis=1)
    body = np.radians(np.stack([wave["yaw"], wave["pitch"], wave["roll"]], axis=1))
    _write_root(skeleton, path + frame.apply(offset), frame * Rotation.from_euler("ZYX", body), q)


def _write_root(skeleton: Skeleton, position: np.ndarray, rotation: Rotation, q: np.ndarray) -> None:
    """Express a position (N, 3) and a rotation in the degrees of freedom that the root has."""
    dofs = [(j, skeleton.dofs[j]) for link in skeleton.links if link.parent < 0 for j in link.dofs]
    for j, dof in dofs:
        if dof.kind == "slide":
            q[:, j] = fit_to_range(position @ np.array(dof.axis), dof)
    turns = {("xyz"[int(np.argmax(np.abs(d.axis)))]): j for j, d in dofs if d.kind == "turn"}
    order = "".join(turns) if len(turns) == 3 else "zyx"
    angles = np.unwrap(rotation.as_euler(order.upper()), axis=0)
    for axis, j in turns.items():
        value = angles[:, order.index(axis)] * np.sign(np.sum(skeleton.dofs[j].axis))
        q[:, j] = fit_to_range(value, skeleton.dofs[j])


def _put_on_ground(kinematics: Kinematics, recipe: Recipe, time: np.ndarray, q: np.ndarray) -> None:
    """Raise the root by a smooth function of the stride so that the lowest marker follows the ground."""
    skeleton = kinematics.skeleton
    slides = [
        j
        for link in skeleton.links
        if link.parent < 0
        for j in link.dofs
        if skeleton.dofs[j].kind == "slide" and skeleton.dofs[j].axis[2] != 0
    ]
    if not slides:
        return
    lowest = kinematics.positions(q)[:, :, 2].min(axis=1)
    turn = 2 * np.pi * recipe.rate * time[:, None]
    basis = np.concatenate([np.ones_like(turn), np.cos(2 * turn), np.sin(2 * turn)], axis=1)
    if len(time) < 2 * basis.shape[1] or not recipe.rate:
        basis = basis[:, :1]
    smooth = basis @ np.linalg.lstsq(basis, lowest, rcond=None)[0]
    spare = float(np.min(lowest - smooth))
    j = slides[0]
    lift = (_CLEARANCE - smooth - min(0.0, spare)) * np.sign(skeleton.dofs[j].axis[2])
    q[:, j] = np.clip(q[:, j] + lift, skeleton.dofs[j].lower, skeleton.dofs[j].upper)
