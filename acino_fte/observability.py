"""Which degrees of freedom the markers of a species can observe at all.

With every marker seen from enough views the data fix the marker positions p(q). A direction v of q with
``∂p/∂q · v = 0`` leaves them as they are: no camera can tell movement along it. The null space is taken
at random poses inside the ranges, where it has its general size (single poses, such as a straight arm,
can lose more). Local observability by the rank of the Jacobian: Hermann and Krener 1977, IEEE Trans.
Automatic Control 22:728.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from acino_fte.kinematics import load_kinematics
from acino_fte.skeleton import Skeleton

_POSES = 8
_TOLERANCE = 1e-8


@dataclass(frozen=True)
class Observability:
    """Names of degrees of freedom that the markers cannot observe.

    Attributes
    ----------
    unseen : list of str
        Those that move no marker at all.
    confounded : list of list of str
        Groups that can move together without moving a marker, though each alone does.
    """

    unseen: list[str]
    confounded: list[list[str]]


def observability(skeleton: Skeleton, markers: Iterable[str] | None = None) -> Observability:
    """Find what the markers cannot observe.

    Parameters
    ----------
    skeleton : Skeleton
        The species.
    markers : iterable of str, optional
        The markers that are seen; all by default.
    """
    rows = [skeleton.marker(name) for name in markers] if markers is not None else slice(None)
    q = random_poses(skeleton, _POSES, seed=0)
    jacobian = load_kinematics(skeleton).linearise(q).jacobian
    jacobian = jacobian[:, rows].reshape(_POSES, -1, len(skeleton.dofs))  # (poses, 3 M, Q)
    size = np.linalg.norm(jacobian, axis=(0, 1))
    unseen = size <= _TOLERANCE * max(size.max(), 1e-300)
    seen = np.flatnonzero(~unseen)
    projector = _null_projectors(jacobian[:, :, seen] / size[seen])
    names = skeleton.dof_names
    groups = _blocks(projector > 1e-6)
    return Observability(
        [names[j] for j in np.flatnonzero(unseen)], [[names[seen[i]] for i in group] for group in groups]
    )


def random_poses(skeleton: Skeleton, n: int, seed: int) -> np.ndarray:
    """Poses (n, Q) spread evenly over the ranges; free ones over ±1 rad or m."""
    rng = np.random.default_rng(seed)
    bounded = [math.isfinite(d.upper - d.lower) for d in skeleton.dofs]
    lower = np.array([d.lower if b else -1.0 for d, b in zip(skeleton.dofs, bounded, strict=True)])
    upper = np.array([d.upper if b else 1.0 for d, b in zip(skeleton.dofs, bounded, strict=True)])
    return rng.uniform(lower, upper, (n, len(skeleton.dofs)))


def _null_projectors(jacobian: np.ndarray) -> np.ndarray:
    """Largest absolute entries (Q, Q), over the poses of full rank, of the projector on the null space."""
    n_dofs = jacobian.shape[-1]
    _, values, rows = np.linalg.svd(jacobian, full_matrices=True)
    ranks = (values > _TOLERANCE * values.max(axis=1, keepdims=True)).sum(1)
    general = ranks == ranks.max()
    null = rows[general, ranks.max() :]  # (poses, Q − rank, Q)
    return np.abs(np.swapaxes(null, 1, 2) @ null).max(axis=0) if null.size else np.zeros((n_dofs, n_dofs))


def _blocks(linked: np.ndarray) -> list[list[int]]:
    """Connected groups of a symmetric relation (Q, Q); elements without any relation are left out."""
    groups: list[list[int]] = []
    left = [i for i in range(len(linked)) if linked[i].any()]
    while left:
        group, front = {left[0]}, [left[0]]
        while front:
            near = {int(j) for j in np.flatnonzero(linked[front.pop()])} - group
            group |= near
            front += near
        groups.append(sorted(group))
        left = [i for i in left if i not in group]
    return groups
