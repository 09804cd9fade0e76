"""The ground: paws stay above it, and a paw that stands on it does not move. Optional, soft terms.

Both need a first trajectory: the ground is fitted to it where the sequence does not state it, and the frames
in which a paw stands are found in it. A wrong plane or a wrongly called stance must not bend the motion,
hence the robust losses. A ground is (a, b, c, d): the plane a x + b y + c z = d in the world frame, m, with
a unit normal (a, b, c) that points upwards.

Shapes: N frames, M markers, K markers that touch the ground ("paws").
"""

from __future__ import annotations

import math
from collections.abc import Sequence as Indices
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from acino_fte.losses import Loss
from acino_fte.problem import FTEProblem
from acino_fte.residuals import AXES, Derived, Handle, Let, Residual
from acino_fte.sequence import Sequence
from acino_fte.terms import Term

if TYPE_CHECKING:
    import sympy as sp

Ground = tuple[float, float, float, float]

GROUND_SD = 0.01  # m: turf gives, and the marker's place on the paw is known no better
STANCE_SD = 0.3  # m/s: a paw's marker rolls over about 2 cm while it stands, in a gallop within 70 ms
_BEND = 0.005  # m, half width of the bend of the ground term

_STEEPEST = math.radians(20.0)
_SLOPE_SD = math.tan(math.radians(2.0))  # of a fitted ground, before it is fitted
_SHARE = 0.2  # a frame's worth as an independent observation: neighbouring frames share their errors
_LOW = 0.2  # quantile of the heights at which the fit begins: most animals stand for more of the time
_CUT = 4.0  # spreads of Tukey's weights beyond which a paw is in the air
_LEAST_SPREAD = 0.005  # of an animal's size
_FAR = 0.1  # of an animal's size: a stated ground so far from where the paws rest is worth a remark
_WORST_SPREAD = 0.15  # of an animal's size: beyond this the lowest paws do not lie in a plane

_HEIGHT = (0.08, 0.14)  # of an animal's size: a stance begins below the first, ends above the second
_SPEED = (0.15, 0.25)  # of the body's speed, likewise
_SPEED_CAP = (1.5, 2.5)  # m/s
_SPEED_FLOOR = (0.3, 0.5)  # sizes per second: when the body rests, paws still seem to move
_SHORTEST = 3  # frames of a stance
_AVERAGE = 5  # frames over which the body's speed is averaged


def _above(handles: list[Any], data: dict[str, sp.Symbol], let: Let) -> Derived:
    import sympy as sp

    height = let("height", sum(data[f"n{a}"] * h for a, h in zip(AXES, handles[0], strict=True)) - data["d"])
    return [(sp.sqrt(height**2 + data["bend"] ** 2) - height) / 2], []


def _velocity(handles: list[Any], data: dict[str, sp.Symbol], _let: Let) -> Derived:
    now, before = handles
    return [(p - q) / data["dt"] for p, q in zip(now, before, strict=True)], []


_HERE = (Path(__file__),)
ABOVE = Residual(
    "above", (Handle("position"),), ("nx", "ny", "nz", "d", "bend"), ("depth",), "m", _above, _HERE
)
STILL = Residual(
    "still", (Handle("position"), Handle("position", 1)), (), ("vx", "vy", "vz"), "m/s", _velocity, _HERE
)


# --- terms ---------------------------------------------------------------------------------------------


def ground_term(
    contacts: Indices[int],
    ground: Ground,
    n_frames: int,
    sd: float = GROUND_SD,
    loss: Loss | None = None,
    bend: float = _BEND,
) -> Term:
    """Paws are not below the ground: (√(h² + ε²) − h)/2 with the height h above it, in every frame.

    That is about −h below the ground and about 0 above it, and smooth; ε is ``bend`` (m). ``sd`` in m. The
    loss is Huber's unless another is given: whoever is below the ground goes up, but a wrong plane does
    not lift the animal.
    """
    frames, which = (a.ravel() for a in np.mgrid[0:n_frames, 0 : len(contacts)])
    markers = np.asarray(contacts, dtype=int)[which]
    data = {"nx": ground[0], "ny": ground[1], "nz": ground[2], "d": ground[3], "bend": bend}
    sigma = np.full(len(frames), float(sd))
    return Term("ground", ABOVE, frames, markers[:, None], data, sigma, loss or Loss("huber"))


def stance_term(
    contacts: Indices[int], standing: np.ndarray, sd: float = STANCE_SD, loss: Loss | None = None
) -> Term:
    """Paws do not move while they stand: velocity (p_n − p_{n−1})/Δt, m/s, where both frames are stance.

    ``standing`` (N, K) bool is what :func:`stance` found, ``sd`` in m/s. The loss is Cauchy's with c = 1.5
    unless another is given: its pull fades where the data say that the paw moves.
    """
    frames, which = np.nonzero(standing[1:] & standing[:-1])
    markers = np.asarray(contacts, dtype=int)[which]
    sigma = np.full(len(frames), float(sd))
    return Term("stance", STILL, frames + 1, markers[:, None], {}, sigma, loss or Loss("cauchy", {"c": 1.5}))


def contact_terms(
    problem: FTEProblem, positions: np.ndarray, sequence: Sequence
) -> tuple[list[Term], list[str]]:
    """The terms of the ground for a problem, and what was found on the way, one sentence each.

    ``positions`` (N, M, 3), m, are those of a first solution. A fitted ground is as uncertain as the
    heights of the paws on it, and the terms know. No terms when the species does not say which markers
    touch the ground, or no plane fits them.
    """
    contacts = problem.kinematics.skeleton.contacts
    if not contacts:
        return [], ["ground: the species does not say which markers touch it (contacts); it is not used"]
    size = animal_size(positions)
    if sequence.ground is not None:
        ground, spread, source = sequence.ground, 0.0, "as the sequence states it"
        resting = _median(heights(positions[:, list(contacts)], ground), _slowness(positions, contacts))
        if abs(resting) > _FAR * size:
            source += f" (slow paws are {100 * abs(resting):.0f} cm {'above' if resting > 0 else 'below'} it)"
    else:
        fitted = _fit(positions, contacts)
        ground, spread = fitted.plane, fitted.spread
        if spread > _WORST_SPREAD * size:
            return [], [f"ground: no plane fits the lowest paws (residual {1e3 * spread:.0f} mm); not used"]
        tilt = math.degrees(math.acos(min(1.0, ground[2])))
        source = f"fitted plane, tilt {tilt:.1f}°, residual {1e3 * spread:.0f} mm"
        if fitted.share < 0.9:
            source += f" (on it are {fitted.share:.0%} of the slow paws)"
    standing = stance(positions, contacts, ground, problem.fps, slack=2 * spread)
    sd = math.hypot(GROUND_SD, spread)
    terms = [ground_term(contacts, ground, problem.n_frames, sd), stance_term(contacts, standing)]
    below = float(np.mean(heights(positions[:, list(contacts)], ground) < -2 * sd))
    found = f"ground: {source}; stance in {standing.mean():.0%} of the paw-frames"
    found += f", {below:.0%} were more than {2e3 * sd:.0f} mm below it" if below >= 0.005 else ""
    return [term for term in terms if len(term)], [found]


# --- the plane -----------------------------------------------------------------------------------------


def heights(points: np.ndarray, ground: Ground) -> np.ndarray:
    """Signed heights (…) of points (…, 3) above the ground, m."""
    return points @ np.array(ground[:3]) - ground[3]


def animal_size(positions: np.ndarray) -> float:
    """Root mean square distance of the markers (N, M, 3) from their centre, m: about 0.5 for a cheetah."""
    squared = ((positions - _mean(positions)[:, None]) ** 2).sum(-1, keepdims=True)
    return float(np.sqrt(np.nanmedian(_mean(squared))))


def fit_ground(positions: np.ndarray, contacts: Indices[int]) -> Ground:
    """The plane on which the lowest paws of a trajectory (N, M, 3) lie: a robust lower envelope.

    Paws count that are slow against the body. The fit of heights, z = z₀ + s·(x, y), begins at their lower
    quintile (quantile regression; Koenker and Bassett 1978) and continues with Tukey's weights, whose
    scale comes from the paws below the plane: those above it may be in the air. A Gaussian prior holds the
    slope s near zero with 2°. It decides what the paws do not show: the tilt across the track of an animal
    that runs along a line, all of it when it stays in one place. A slope beyond 20° is not believed and
    the plane is then horizontal.

    Raises
    ------
    ValueError
        No paw has a position.
    """
    return _fit(positions, contacts).plane


@dataclass(frozen=True)
class _Fit:
    """A fitted plane, the spread of the paws on it about it, m, and their share of the slow paws."""

    plane: Ground
    spread: float
    share: float


def _fit(positions: np.ndarray, contacts: Indices[int]) -> _Fit:
    paws = positions[:, list(contacts)].reshape(-1, 3)
    known = np.isfinite(paws).all(-1)
    if not known.any():
        raise ValueError("no paw has a position to fit the ground to")
    points, slow = paws[known], _slowness(positions, contacts).ravel()[known]
    least = _LEAST_SPREAD * animal_size(positions)
    centre = np.average(points[:, :2], axis=0, weights=slow)
    across, z = points[:, :2] - centre, points[:, 2]
    found = _envelope(across, z, slow, least, _SLOPE_SD)
    if math.hypot(*found[0][1:]) > math.tan(_STEEPEST):
        found = _envelope(across, z, slow, least, 1e-9)
    (height, *slope), spread = found
    on_it = np.abs(z - height - across @ slope) < _CUT * spread
    normal = np.array([-slope[0], -slope[1], 1.0]) / math.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    d = float(normal @ [*centre, height])
    return _Fit(
        (float(normal[0]), float(normal[1]), float(normal[2]), d), spread, float(slow @ on_it / slow.sum())
    )


def _slowness(positions: np.ndarray, contacts: Indices[int]) -> np.ndarray:
    """Weights (N, K) of the paws: near 1 when one is slow against the body, whatever its height."""
    if len(positions) < 3:
        return np.ones((len(positions), len(contacts)))
    paws = np.linalg.norm(np.gradient(positions[:, list(contacts)], axis=0), axis=-1)
    body = np.nanmedian(np.linalg.norm(np.diff(_body(positions, contacts), axis=0), axis=-1))
    ratio = np.nan_to_num(paws / max(float(body), 1e-12), nan=10.0)
    return 1.0 / (1.0 + (ratio / 0.3) ** 4) + 1e-9


def _body(positions: np.ndarray, contacts: Indices[int]) -> np.ndarray:
    """Where the body is (N, 3), m: the mean of the markers that do not touch the ground."""
    rest = [m for m in range(positions.shape[1]) if m not in set(contacts)]
    return _mean(positions[:, rest or list(contacts)])


def _mean(points: np.ndarray) -> np.ndarray:
    """Mean (N, …) of the known points (N, M, …) of every frame, NaN where there are none."""
    known = np.isfinite(points).all(-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(known, points, 0.0).sum(1) / known.sum(1)


def _envelope(
    across: np.ndarray, z: np.ndarray, worth: np.ndarray, least: float, slope_sd: float
) -> tuple[np.ndarray, float]:
    """Height and slopes (3,) of the plane under points (K, 2), z (K,), and the spread about it, m."""
    design = np.column_stack([np.ones(len(z)), across])
    order = np.argsort(z)
    reached = np.cumsum(worth[order]) / worth.sum()
    plane = np.array([z[order[np.searchsorted(reached, _LOW)]], 0.0, 0.0])
    for step in range(60):
        residual = z - design @ plane
        spread = max(least, _spread(residual, worth))
        if step < 30:
            pinball = np.where(residual > 0, _LOW, 1 - _LOW) / np.maximum(np.abs(residual), least)
            weights = worth * pinball * spread
        else:
            weights = worth * np.clip(1 - (residual / (_CUT * spread)) ** 2, 0.0, None) ** 2
            if weights.sum() < 1e-6:
                break
        normal = (design * weights[:, None]).T @ design * (_SHARE / spread**2)
        normal += np.diag([0.0, slope_sd**-2, slope_sd**-2])
        plane = np.linalg.solve(normal, design.T @ (weights * z) * (_SHARE / spread**2))
    return plane, spread


def _spread(residual: np.ndarray, worth: np.ndarray) -> float:
    """Standard deviation (m) by the weighted median size of the residuals below the plane.

    At least so much that half of all paws lie within two of it: the few lowest are not the ground.
    """
    size = np.abs(residual)
    return max(1.4826 * _median(size[residual < 0], worth[residual < 0]), 0.5 * _median(size, worth))


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    """Weighted median of values and weights of one shape, 0 of nothing."""
    if not len(values):
        return 0.0
    values, weights = values.ravel(), weights.ravel()
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(reached, 0.5 * reached[-1])]])


# --- stance --------------------------------------------------------------------------------------------


def stance(
    positions: np.ndarray, contacts: Indices[int], ground: Ground, fps: float, slack: float = 0.0
) -> np.ndarray:
    """Where a paw stands in a trajectory (N, M, 3): low and slow, (N, K) bool.

    A stance is a run of 3 frames or more in which the paw is within 14 % of the animal's size of the ground
    and slower along it than 25 % of the body's speed and 2.5 m/s, and in at least one frame within 8 %,
    15 % and 1.5 m/s. ``slack`` (m) is added to the heights: how uncertain the ground is. (The speeds leave
    room for the errors of a first trajectory, and the caps for a gallop, whose tenth they are.)
    """
    paws = positions[:, list(contacts)]
    if len(positions) < _SHORTEST:
        return np.zeros(paws.shape[:2], dtype=bool)
    normal = np.array(ground[:3])
    height = np.abs(heights(paws, ground)) - slack

    def along(path: np.ndarray) -> np.ndarray:
        velocity = np.gradient(path, axis=0) * fps
        return np.linalg.norm(velocity - (velocity @ normal)[..., None] * normal, axis=-1)

    size = animal_size(positions)
    body = ndimage.uniform_filter1d(along(_body(positions, contacts)), _AVERAGE, mode="nearest")[:, None]
    with np.errstate(invalid="ignore"):
        speed = along(paws)
        begun, lasting = (
            (height < _HEIGHT[i] * size)
            & (speed < np.clip(_SPEED[i] * body, _SPEED_FLOOR[i] * size, _SPEED_CAP[i]))
            for i in (0, 1)
        )
    return np.stack([_runs(lasting[:, k], begun[:, k]) for k in range(paws.shape[1])], axis=1)


def _runs(lasting: np.ndarray, begun: np.ndarray) -> np.ndarray:
    """Runs of ``lasting`` (N,) that are long enough and somewhere ``begun``."""
    labels, count = ndimage.label(lasting)
    runs = np.arange(1, count + 1)
    length = ndimage.sum_labels(lasting, labels, runs)
    certain = ndimage.sum_labels(begun, labels, runs)
    return np.isin(labels, runs[(length >= _SHORTEST) & (certain >= 1)])
