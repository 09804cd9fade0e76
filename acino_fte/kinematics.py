"""Forward kinematics: marker positions and their derivatives from the degrees of freedom.

Notation used in every shape below: N frames, M markers, Q degrees of freedom.

A link hangs on its parent at ``a`` and moves through its degrees of freedom in order,

    R_link = R_parent · T_1(q_1) · T_2(q_2) · …,   o_link = o_parent + R_parent·a + slides,

and a marker at ``b`` in its link's frame is ``p = o_link + R_link·b`` (world frame, metres). Slides act
along the axes as turned so far. SymPy derives the frames link by link (a link's rotation and origin
become symbols before the next link is derived) and the Jacobian by the chain rule over the same links:

    ∂p/∂q_j = R_before · (dT/dq · Tᵀ) · R_beforeᵀ · (p − c_j) = ω_j × p + u_j,   u_j = −ω_j × c_j,

with ω_j the axis of a turn in the world and c_j a point on it; for a slide ω_j = 0 and u_j is its axis.
SymPy forms ``dT/dq·Tᵀ``, which is the constant skew matrix of the axis, and emits the twist (ω_j, u_j) of
every degree of freedom; multiplying all twists with all markers is then one batched matrix product.
(Murray, Li, Sastry 1994, A Mathematical Introduction to Robotic Manipulation, eq. 3.54: the columns of
the spatial manipulator Jacobian are these twists.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.codegen import Program, ProgramBuilder, cached_programs
from acino_fte.skeleton import Skeleton

if TYPE_CHECKING:
    import sympy as sp

_CHUNK = 256  # frames linearised together: the intermediate rows stay in the processor's cache


@dataclass(frozen=True)
class Kinematics:
    """Compiled kinematics of one skeleton. Make it with :func:`load_kinematics`."""

    skeleton: Skeleton
    position_program: Program
    twist_program: Program

    @property
    def n_dofs(self) -> int:
        """Q."""
        return len(self.skeleton.dofs)

    @property
    def n_markers(self) -> int:
        """M."""
        return len(self.skeleton.markers)

    @cached_property
    def _positions(self) -> Callable[..., None]:
        return self.position_program.numpy_function

    @cached_property
    def _twists(self) -> Callable[..., None]:
        return self.twist_program.numpy_function

    @cached_property
    def depends(self) -> np.ndarray:
        """(M, Q) bool: which degrees of freedom move which marker."""
        result = np.zeros((self.n_markers, self.n_dofs), dtype=bool)
        for m, marker in enumerate(self.skeleton.markers):
            result[m, self.skeleton.ancestors(marker.link)] = True
        return result

    @cached_property
    def before(self) -> np.ndarray:
        """(Q, Q) bool: whether i acts on a chain at or before j (where second derivatives live)."""
        result = np.eye(self.n_dofs, dtype=bool)
        for link in range(len(self.skeleton.links)):
            chain = self.skeleton.ancestors(link)
            for place, i in enumerate(chain):
                result[i, chain[place:]] = True
        return result

    def positions(self, q: np.ndarray) -> np.ndarray:
        """Marker positions, (N, M, 3) in m, from q (N, Q)."""
        q = np.asarray(q, dtype=float)
        out = np.empty((3 * self.n_markers, len(q)))
        self._positions(np.ascontiguousarray(q.T), out)
        return np.ascontiguousarray(out.T).reshape(len(q), self.n_markers, 3)

    def linearise(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions, Jacobian and axes of rotation.

        Parameters
        ----------
        q : (N, Q)
            Degrees of freedom, m and rad.

        Returns
        -------
        positions : (N, M, 3), m
        jacobian : (N, M, 3, Q), ∂p/∂q
        axes : (N, Q, 3)
            ω of each turn, world frame; zero for a slide. The second derivative of a marker for
            two of its degrees of freedom, i before or equal to j, is ``axes[i] × jacobian[…, j]``.
        """
        q = np.asarray(q, dtype=float)
        n, m, d = len(q), self.n_markers, self.n_dofs
        positions, jacobian = np.empty((n, m, 3)), np.empty((n, m, 3, d))
        axes = np.empty((n, d, 3))
        for start in range(0, n, _CHUNK):
            part = slice(start, start + _CHUNK)
            self._linearise(q[part], positions[part], jacobian[part], axes[part])
        return positions, jacobian, axes

    def _linearise(
        self, q: np.ndarray, positions: np.ndarray, jacobian: np.ndarray, axes: np.ndarray
    ) -> None:
        """:meth:`linearise` for some frames, into the given arrays."""
        n, m, d = len(q), self.n_markers, self.n_dofs
        out = np.empty((3 * m + 6 * d, n))
        self._twists(np.ascontiguousarray(q.T), out)
        rows = np.ascontiguousarray(out.T)
        positions[...] = rows[:, : 3 * m].reshape(n, m, 3)
        omega, moment = rows[:, 3 * m :].reshape(n, 2, d, 3).transpose(1, 0, 3, 2)  # (N, 3, Q) each
        axes[...] = omega.transpose(0, 2, 1)
        homogeneous = np.ones((n, m, 4))
        homogeneous[:, :, :3] = positions
        matrix = np.zeros((n, 4, 3, d))  # [p; 1] ↦ ω × p + u, for every degree of freedom
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            matrix[:, c, a] = omega[:, b]
            matrix[:, b, a] = -omega[:, c]
        matrix[:, 3] = moment
        np.matmul(homogeneous, matrix.reshape(n, 4, 3 * d), out=jacobian.reshape(n, m, 3 * d))
        jacobian *= self._mask

    @cached_property
    def _mask(self) -> np.ndarray:
        return self.depends[:, None, :].astype(float)


def load_kinematics(skeleton: Skeleton) -> Kinematics:
    """Kinematics of a skeleton, derived by SymPy the first time and from the cache after that."""
    programs = cached_programs(
        "kinematics", (Path(__file__), skeleton.content_hash), lambda: derive_programs(skeleton)
    )
    return Kinematics(skeleton, programs["positions"], programs["twists"])


def derive_programs(skeleton: Skeleton) -> dict[str, Program]:
    """Derive the programs ``positions`` (three outputs a marker) and ``twists``.

    The outputs of ``twists`` are the positions, then all ω, then all u (module docstring).
    """
    import sympy as sp

    q = sp.symbols(f"q_0:{len(skeleton.dofs)}", real=True)
    builder = ProgramBuilder(q)
    frames = _derive_frames(skeleton, builder, q)
    positions: list[sp.Expr] = []
    for i, marker in enumerate(skeleton.markers):
        rotation, origin = frames.links[marker.link]
        p = origin + rotation * sp.Matrix([_exact(v) for v in marker.at])
        positions += [builder.let(f"p{i}_{a}", p[a]) for a in range(3)]
    omega, moment = [], []
    for j, dof in enumerate(skeleton.dofs):
        turns = dof.kind == "turn"
        omega += list(frames.axes[j] if turns else sp.zeros(3, 1))
        moment += list(-frames.axes[j].cross(frames.points[j]) if turns else frames.axes[j])
    return {
        "positions": builder.program(positions),
        "twists": builder.program(positions + omega + moment),
    }


@dataclass
class _Frames:
    """Symbols of the frames: per link (rotation, origin); per DOF its world axis and a point on it."""

    links: list[tuple[sp.Matrix, sp.Matrix]]
    axes: dict[int, sp.Matrix]
    points: dict[int, sp.Matrix]


def _derive_frames(skeleton: Skeleton, builder: ProgramBuilder, q: tuple[sp.Symbol, ...]) -> _Frames:
    import sympy as sp

    frames = _Frames([], {}, {})
    for i, link in enumerate(skeleton.links):
        world = (sp.eye(3), sp.zeros(3, 1))
        rotation, origin = frames.links[link.parent] if link.parent >= 0 else world
        origin = _let(builder, f"o{i}", origin + rotation * sp.Matrix([_exact(v) for v in link.at]))
        for step, j in enumerate(link.dofs):
            dof = skeleton.dofs[j]
            axis = sp.Matrix([sp.Integer(int(v)) for v in dof.axis])
            frames.points[j] = origin
            if dof.kind == "slide":
                frames.axes[j] = rotation * axis
                origin = _let(builder, f"o{i}_{step}", origin + frames.axes[j] * q[j])
            else:
                turn = turn_matrix(axis, q[j])
                frames.axes[j] = rotation * turn_axis(turn, q[j])
                cosine, sine = builder.let(f"c_{j}", sp.cos(q[j])), builder.let(f"s_{j}", sp.sin(q[j]))
                turn = turn.subs({sp.cos(q[j]): cosine, sp.sin(q[j]): sine})
                rotation = _let(builder, f"R{i}_{step}", rotation * turn)
        frames.links.append((rotation, origin))
    return frames


def turn_matrix(axis: sp.Matrix, angle: sp.Expr) -> sp.Matrix:
    """Active rotation about a unit axis (Rodrigues): I + sin·[a]× + (1 − cos)·[a]×²."""
    import sympy as sp

    skew = sp.Matrix([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix = sp.eye(3) + sp.sin(angle) * skew + (1 - sp.cos(angle)) * skew * skew
    return matrix.applyfunc(sp.expand)


def turn_axis(turn: sp.Matrix, angle: sp.Expr) -> sp.Matrix:
    """Axis of a turn, read off the skew matrix ``dT/dq · Tᵀ`` (module docstring)."""
    import sympy as sp

    skew = (turn.diff(angle) * turn.T).applyfunc(sp.trigsimp)
    return sp.Matrix([skew[2, 1], skew[0, 2], skew[1, 0]])


def _let(builder: ProgramBuilder, name: str, matrix: sp.Matrix) -> sp.Matrix:
    rows, columns = matrix.shape
    return matrix.__class__(
        rows,
        columns,
        lambda r, c: builder.let(f"{name}_{r}{c}" if columns > 1 else f"{name}_{r}", matrix[r, c]),
    )


def _exact(value: float) -> sp.Expr:
    import sympy as sp

    return sp.Float(value) if value else sp.Integer(0)
