"""A smooth random motion for any species: every joint drifts inside its range, the root along a curve."""

from __future__ import annotations

import math

import numpy as np

from acino_fte.motions import Recipe, Wave, resting_value
from acino_fte.skeleton import Dof, Skeleton

_BAND = (0.2, 1.5)  # Hz, of the movement of the joints
_TERMS = 5
_LARGEST = {"turn": 40.0, "slide": 0.05}  # degrees and metres either side
_FREE = {"turn": 15.0, "slide": 0.05}  # the same, for a joint without a range


def wander_recipe(skeleton: Skeleton, seed: int) -> Recipe:
    """Draw a band-limited random motion.

    Parameters
    ----------
    skeleton : Skeleton
        Of any species.
    seed : int
        The same seed gives the same motion, whatever the number of frames.

    Returns
    -------
    Recipe
        With a rate of one, so that its harmonics are frequencies in Hz (0.2 to 1.5).
    """
    rng = np.random.default_rng([seed, 0x3A])
    rooted = {j for link in skeleton.links if link.parent < 0 for j in link.dofs}
    joints = {
        dof.name: _drift(rng, _middle(dof), _reach(dof))
        for j, dof in enumerate(skeleton.dofs)
        if j not in rooted
    }
    size = body_size(skeleton)
    root = {key: _drift(rng, 0.0, 8.0) for key in ("yaw", "pitch", "roll")}
    root["left"] = _drift(rng, 0.0, 0.2 * size)
    return Recipe(
        name="wander",
        summary="smooth random movement inside the ranges of any species",
        rate=1.0,
        speed=size,
        joints=joints,
        root=root,
        curvature=float(rng.uniform(-0.15, 0.15)) / size,
        grounded=True,
    )


def body_size(skeleton: Skeleton) -> float:
    """Length of the longest chain of links down to a marker, m; a yardstick for distances and speeds."""
    reach: list[float] = []
    for link in skeleton.links:
        before = reach[link.parent] if link.parent >= 0 else 0.0
        reach.append(before + math.hypot(*link.at))
    return max([reach[m.link] + math.hypot(*m.at) for m in skeleton.markers] or [0.0]) or 1.0


def _drift(rng: np.random.Generator, middle: float, reach: float) -> Wave:
    """A sum of cosines in the band whose largest possible excursion is ``reach``."""
    weight = rng.uniform(0.3, 1.0, _TERMS)
    rate = rng.uniform(*_BAND, _TERMS)
    phase = rng.uniform(0.0, 360.0, _TERMS)
    amplitude = reach * weight / weight.sum()
    return Wave(middle, tuple(zip(rate.tolist(), amplitude.tolist(), phase.tolist(), strict=True)))


def _unit(dof: Dof) -> float:
    return math.degrees(1.0) if dof.kind == "turn" else 1.0


def _reach(dof: Dof) -> float:
    """Largest excursion from :func:`_middle`, in degrees or metres."""
    span = dof.upper - dof.lower
    if not math.isfinite(span):
        return _FREE[dof.kind]
    return min(0.4 * span * _unit(dof), _LARGEST[dof.kind])


def _middle(dof: Dof) -> float:
    """A middle that leaves room for the excursion, as near to rest as possible, in degrees or metres."""
    reach = _reach(dof) / _unit(dof)
    rest = resting_value(dof)
    if math.isfinite(dof.upper - dof.lower):
        rest = min(max(rest, dof.lower + 1.1 * reach), dof.upper - 1.1 * reach)
    return rest * _unit(dof)
