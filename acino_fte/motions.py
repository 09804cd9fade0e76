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
from functools import cached_property

import numpy as np

from acino_fte.errors import InputError, did_you_mean
from acino_fte.kinematics import Kinematics
from acino_fte.skeleton import Dof, Skeleton

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


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion put on an animal: its degrees of freedom as a continuous function of time.

    The frames of the recording decide how the waves are fitted to the ranges of the joints, where the middle
    of the path is, and how high the root. At any other time it is the same movement, not a new one.

    Attributes
    ----------
    kinematics : Kinematics
    recipe : Recipe
    time : (N,)
        Of the frames, s.
    speed : float
        Over the ground, m/s.
    parameters : (K,), optional
        Of the kinematics: the proportions of the animal.
    """

    kinematics: Kinematics
    recipe: Recipe
    time: np.ndarray
    speed: float
    parameters: np.ndarray | None = None

    @cached_property
    def at_frames(self) -> np.ndarray:
        """(N, Q) degrees of freedom at the frames, rad and m, within the ranges of the species."""
        return self._lifted(self._pose(self._raw_frames, len(self.time)), self.time)

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """(T, Q) degrees of freedom at times (T,), s; rad and m."""
        raw = self._raw(time)
        for j in _root_turns(self.kinematics.skeleton).values():  # on the branch that the frames are on
            near = np.interp(time, self.time, self._raw_frames[j])
            raw[j] += 2 * np.pi * np.round((near - raw[j]) / (2 * np.pi))
        return self._lifted(self._pose(raw, len(time)), time)

    @cached_property
    def _raw_frames(self) -> dict[int, np.ndarray]:
        return self._raw(self.time)

    def _raw(self, time: np.ndarray) -> dict[int, np.ndarray]:
        """Values (T,) of the degrees of freedom that move, by index, whatever their ranges; rad and m."""
        stride, values = self.recipe.rate * time, {}
        for j, dof in enumerate(self.kinematics.skeleton.dofs):
            wave = self.recipe.wave(dof.name)
            if wave is not None:
                values[j] = np.radians(wave(stride)) if dof.kind == "turn" else wave(stride)
        along = self.speed * (time - 0.5 * (self.time[0] + self.time[-1]))
        return values | root_values(self.kinematics.skeleton, self.recipe, stride, along)

    def _pose(self, raw: dict[int, np.ndarray], n_times: int) -> np.ndarray:
        """(T, Q): values put into their ranges as at the frames; what does not move is at rest."""
        dofs = self.kinematics.skeleton.dofs
        q = np.empty((n_times, len(dofs)))
        for j, dof in enumerate(dofs):
            q[:, j] = fit_to_range(raw[j], dof, self._raw_frames[j]) if j in raw else resting_value(dof)
        return q

    def _lifted(self, q: np.ndarray, time: np.ndarray) -> np.ndarray:
        """The root of q (T, Q) raised so that the lowest marker follows the ground, if the recipe says so."""
        skeleton = self.kinematics.skeleton
        upright = [j for j in root_dofs(skeleton, "slide") if skeleton.dofs[j].axis[2] != 0]
        if self.recipe.grounded and upright:
            dof = skeleton.dofs[upright[0]]
            weight, spare = self._ground
            smooth = self._ground_basis(time) @ weight
            lift = (_CLEARANCE - smooth - min(0.0, spare)) * np.sign(dof.axis[2])
            q[:, upright[0]] = np.clip(q[:, upright[0]] + lift, dof.lower, dof.upper)
        return q

    @cached_property
    def _ground(self) -> tuple[np.ndarray, float]:
        """Height of the lowest marker as a smooth function of the stride, and its deepest dip below that."""
        q = self._pose(self._raw_frames, len(self.time))
        lowest = self.kinematics.positions(q, self.parameters)[:, :, 2].min(axis=1)
        basis = self._ground_basis(self.time)
        weight = np.linalg.lstsq(basis, lowest, rcond=None)[0]
        return weight, float(np.min(lowest - basis @ weight))

    def _ground_basis(self, time: np.ndarray) -> np.ndarray:
        turn = 2 * np.pi * self.recipe.rate * time[:, None]
        basis = np.concatenate([np.ones_like(turn), np.cos(2 * turn), np.sin(2 * turn)], axis=1)
        enough = len(self.time) >= 2 * basis.shape[1] and self.recipe.rate
        return basis if enough else basis[:, :1]


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
    return plan_motion(kinematics, motion, n_frames, fps, seed=seed, longest_path=longest_path).at_frames


def plan_motion(
    kinematics: Kinematics,
    motion: str | Recipe,
    n_frames: int,
    fps: float,
    *,
    seed: int = 0,
    longest_path: float = math.inf,
    parameters: np.ndarray | None = None,
) -> Motion:
    """The motion of :func:`make_motion` as a function of time, of an animal with parameters (K,)."""
    recipe = motion if isinstance(motion, Recipe) else find_recipe(kinematics.skeleton, motion, seed)
    _check_fit(recipe, kinematics.skeleton)
    travel = recipe.speed * n_frames / fps
    speed = recipe.speed * min(1.0, longest_path / travel) if travel > 0 else 0.0
    return Motion(kinematics, recipe, np.arange(n_frames) / fps, speed, parameters)


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


def fit_to_range(value: np.ndarray, dof: Dof, like: np.ndarray | None = None) -> np.ndarray:
    """Values (N,) shrunk and moved, not clipped, so that they lie in the range with a small margin.

    With ``like`` (T,) they are shrunk and moved as those would have to be.
    """
    like = value if like is None else like
    if not math.isfinite(dof.upper - dof.lower) or not like.size:
        return np.clip(value, dof.lower, dof.upper)
    margin = _MARGIN * (dof.upper - dof.lower)
    lower, upper = dof.lower + margin, dof.upper - margin
    low, high = float(like.min()), float(like.max())
    middle, scale = 0.5 * (low + high), 1.0
    if high - low > upper - lower:
        scale = (upper - lower) / (high - low)
    half = 0.5 * scale * (high - low)
    return np.clip(middle, lower + half, upper - half) + scale * (value - middle)


def root_dofs(skeleton: Skeleton, kind: str) -> list[int]:
    """Indices of the slides or turns of the root."""
    dofs = [j for link in skeleton.links if link.parent < 0 for j in link.dofs]
    return [j for j in dofs if skeleton.dofs[j].kind == kind]


def _root_turns(skeleton: Skeleton) -> dict[str, int]:
    """Index of the root's turn about each axis, in the order of rotation."""
    dofs = skeleton.dofs
    return {"xyz"[int(np.argmax(np.abs(dofs[j].axis)))]: j for j in root_dofs(skeleton, "turn")}


def root_values(
    skeleton: Skeleton, recipe: Recipe, stride: np.ndarray, along: np.ndarray
) -> dict[int, np.ndarray]:
    """Position and orientation of the root, in the degrees of freedom that it has.

    ``stride`` (T,) is the time in strides, ``along`` (T,) the way from the middle of the path, m. Returns the
    values (T,), m and rad, by the index of the degree of freedom.
    """
    from scipy.spatial.transform import Rotation

    wave = {key: recipe.root.get(key, Wave())(stride) for key in ROOT_MOTIONS}
    heading = recipe.curvature * along
    if recipe.curvature:
        path = np.stack([np.sin(heading), 1 - np.cos(heading), 0 * heading], axis=1) / recipe.curvature
    else:
        path = np.stack([along, 0 * along, 0 * along], axis=1)
    lean = np.full(len(along), -math.radians(recipe.lean) * np.sign(recipe.curvature))
    frame = Rotation.from_euler("ZX", np.stack([heading, lean], axis=1))
    offset = np.stack([wave["forward"], wave["left"], wave["up"]], axis=1)
    body = np.radians(np.stack([wave["yaw"], wave["pitch"], wave["roll"]], axis=1))
    position, rotation = path + frame.apply(offset), frame * Rotation.from_euler("ZYX", body)
    dofs, turns = skeleton.dofs, _root_turns(skeleton)
    order = "".join(turns) if len(turns) == 3 else "zyx"
    angles = np.unwrap(rotation.as_euler(order.upper()), axis=0)
    values = {j: position @ np.array(dofs[j].axis) for j in root_dofs(skeleton, "slide")}
    return values | {
        j: angles[:, order.index(axis)] * np.sign(np.sum(dofs[j].axis)) for axis, j in turns.items()
    }
