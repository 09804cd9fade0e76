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

The proportions of one individual may be parameters k of the same expressions: a log-scale λ for every
segment group, which multiplies all that is attached to the group's links by s = exp λ, and an offset of
every marker in its link's frame, so that ``p = o_link + R_link·(s·b + offset)``. With λ come the *growths*
∂o/∂λ and ∂p/∂λ, by the chain rule along the links, and

    ∂p/∂offset = R_link,   ∂²p/∂q_j∂λ = ω_j × (∂p/∂λ − ∂c_j/∂λ),   ∂²p/∂q_j∂offset = ω_j × R_link.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.codegen import Program, ProgramBuilder, cached_programs
from acino_fte.skeleton import Skeleton

if TYPE_CHECKING:
    import sympy as sp

PARAMETER_FAMILIES = ("scale", "offsets")
_CHUNK = 256  # frames linearised together: the intermediate rows stay in the processor's cache


@dataclass(frozen=True, eq=False)
class Linearised:
    """Kinematics and their derivatives at q (N, Q) and the parameters k.

    Attributes
    ----------
    positions : (N, M, 3), m
    jacobian : (N, M, 3, Q), ∂p/∂q
    axes : (N, Q, 3)
        ω of each turn, world frame; zero for a slide. The second derivative of a marker for
        two of its degrees of freedom, i before or equal to j, is ``axes[i] × jacobian[…, j]``.
    growth : (N, M, 3, G), ∂p/∂λ for the G segment groups; G is 0 when the scales are no parameters
    point_growth : (N, Q, 3, G), ∂c_j/∂λ of the point that each degree of freedom acts at
    rotations : (N, M, 3, 3) or (N, 0, 3, 3)
        Link to world, of each marker's link: ∂p/∂offset; empty when the offsets are no parameters.
    """

    positions: np.ndarray
    jacobian: np.ndarray
    axes: np.ndarray
    growth: np.ndarray
    point_growth: np.ndarray
    rotations: np.ndarray


@dataclass(frozen=True)
class Kinematics:
    """Compiled kinematics of one skeleton. Make it with :func:`load_kinematics`.

    ``families`` says which of ``scale`` and ``offsets`` are parameters, in the order of the vector k.
    """

    skeleton: Skeleton
    position_program: Program
    twist_program: Program
    families: tuple[str, ...] = ()

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

    @property
    def n_groups(self) -> int:
        """G: segment groups whose scale is a parameter."""
        return len(self.skeleton.groups) if "scale" in self.families else 0

    @property
    def n_parameters(self) -> int:
        """Length of k: G log-scales, then three offsets a marker."""
        return self.n_groups + (3 * self.n_markers if "offsets" in self.families else 0)

    @cached_property
    def grows(self) -> np.ndarray:
        """(M, G) bool: which segment groups move which marker."""
        skeleton = self.skeleton
        result = np.zeros((self.n_markers, self.n_groups), dtype=bool)
        if self.n_groups:
            for m, marker in enumerate(skeleton.markers):
                link, at = marker.link, marker.at
                while link >= 0:
                    if any(at):
                        result[m, skeleton.links[link].group] = True
                    link, at = skeleton.links[link].parent, skeleton.links[link].at
        return result

    def with_parameters(self, families: Iterable[str]) -> Kinematics:
        """The same skeleton with some of :data:`PARAMETER_FAMILIES` as parameters."""
        return load_kinematics(self.skeleton, families)

    def _inputs(self, q: np.ndarray, parameters: np.ndarray | None) -> list:
        """Input rows of the programs: q, then the parameters."""
        k = np.zeros(self.n_parameters) if parameters is None else np.asarray(parameters, dtype=float)
        return [*np.ascontiguousarray(np.asarray(q, dtype=float).T), *k.tolist()]

    def positions(self, q: np.ndarray, parameters: np.ndarray | None = None) -> np.ndarray:
        """Marker positions, (N, M, 3) in m, from q (N, Q) and the parameters k (zero when left out)."""
        out = np.empty((3 * self.n_markers, len(q)))
        self._positions(self._inputs(q, parameters), out)
        return np.ascontiguousarray(out.T).reshape(len(q), self.n_markers, 3)

    def linearise(self, q: np.ndarray, parameters: np.ndarray | None = None) -> Linearised:
        """Positions and derivatives at q (N, Q), m and rad, and the parameters k (zero when left out)."""
        q = np.asarray(q, dtype=float)
        n, m, d, g = len(q), self.n_markers, self.n_dofs, self.n_groups
        offsets = m if "offsets" in self.families else 0
        result = Linearised(
            np.empty((n, m, 3)),
            np.empty((n, m, 3, d)),
            np.empty((n, d, 3)),
            np.empty((n, m, 3, g)),
            np.empty((n, d, 3, g)),
            np.empty((n, offsets, 3, 3)),
        )
        for start in range(0, n, _CHUNK):
            part = slice(start, start + _CHUNK)
            self._linearise(q[part], parameters, part, result)
        return result

    def _linearise(
        self, q: np.ndarray, parameters: np.ndarray | None, part: slice, result: Linearised
    ) -> None:
        """:meth:`linearise` for some frames, into their part of the result."""
        n, m, d, g = len(q), self.n_markers, self.n_dofs, self.n_groups
        out = np.empty((len(self.twist_program.outputs), n))
        self._twists(self._inputs(q, parameters), out)
        rows = np.ascontiguousarray(out.T)
        positions, end = rows[:, : 3 * m].reshape(n, m, 3), 3 * m + 6 * d
        result.positions[part] = positions
        omega, moment = rows[:, 3 * m : end].reshape(n, 2, d, 3).transpose(1, 0, 3, 2)  # (N, 3, Q) each
        result.axes[part] = omega.transpose(0, 2, 1)
        self._carry(positions, omega, moment, result.jacobian[part])
        if g:
            result.growth[part] = rows[:, end : end + 3 * m * g].reshape(n, m, 3, g)
            links = rows[:, end + 3 * m * g : end + 3 * g * (m + len(self.skeleton.links))]
            result.point_growth[part] = links.reshape(n, -1, 3, g)[:, self._link_of_dof]
        if result.rotations.shape[1]:
            turned = rows[:, -9 * len(self.skeleton.links) :].reshape(n, -1, 3, 3)
            result.rotations[part] = turned[:, [marker.link for marker in self.skeleton.markers]]

    def _carry(
        self, positions: np.ndarray, omega: np.ndarray, moment: np.ndarray, jacobian: np.ndarray
    ) -> None:
        """Jacobian ω_j × p_m + u_j of every marker for every degree of freedom, in place."""
        n, m, d = len(positions), self.n_markers, self.n_dofs
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
    def _link_of_dof(self) -> list[int]:
        return [
            next(i for i, link in enumerate(self.skeleton.links) if j in link.dofs)
            for j in range(self.n_dofs)
        ]

    @cached_property
    def _mask(self) -> np.ndarray:
        return self.depends[:, None, :].astype(float)


def load_kinematics(skeleton: Skeleton, families: Iterable[str] = ()) -> Kinematics:
    """Kinematics of a skeleton, derived by SymPy the first time and from the cache after that.

    ``families`` names what are parameters: ``scale``, ``offsets``, both or neither.
    """
    wanted = set(families)
    chosen = tuple(family for family in PARAMETER_FAMILIES if family in wanted)
    programs = cached_programs(
        "-".join(("kinematics", *chosen)),
        (Path(__file__), skeleton.content_hash, chosen),
        lambda: derive_programs(skeleton, chosen),
    )
    return Kinematics(skeleton, programs["positions"], programs["twists"], chosen)


def derive_programs(skeleton: Skeleton, families: tuple[str, ...] = ()) -> dict[str, Program]:
    """Derive the programs ``positions`` (three outputs a marker) and ``twists``.

    The outputs of ``twists`` are the positions, all ω, all u; then, where they are parameters, the growths
    of markers and links and the rotations of the links (module docstring).
    """
    import sympy as sp

    q = sp.symbols(f"q_0:{len(skeleton.dofs)}", real=True)
    proportions = _Proportions.of(skeleton, families)
    builder = ProgramBuilder([*q, *proportions.symbols])
    frames = _derive_frames(skeleton, builder, q, proportions)
    positions: list[sp.Expr] = []
    growth: list[sp.Expr] = []
    for i, marker in enumerate(skeleton.markers):
        rotation, origin = frames.links[marker.link]
        group = skeleton.links[marker.link].group
        arm = _let(builder, f"b{i}", rotation * proportions.scaled(marker.at, group, builder))
        p = origin + arm
        if proportions.offsets:
            p += rotation * sp.Matrix(proportions.offsets[3 * i : 3 * i + 3])
        positions += [builder.let(f"p{i}_{a}", p[a]) for a in range(3)]
        growth += list(_grown(frames.growth[marker.link], arm, group)) if proportions.scales else []
    omega, moment = [], []
    for j, dof in enumerate(skeleton.dofs):
        turns = dof.kind == "turn"
        omega += list(frames.axes[j] if turns else sp.zeros(3, 1))
        moment += list(-frames.axes[j].cross(frames.points[j]) if turns else frames.axes[j])
    if proportions.scales:
        growth += [e for g in frames.growth for e in g]
    turned = [e for rotation, _ in frames.links for e in rotation] if proportions.offsets else []
    return {
        "positions": builder.program(positions),
        "twists": builder.program(positions + omega + moment + growth + turned),
    }


@dataclass
class _Proportions:
    """Symbols of the parameters: log-scales, and offsets flat over markers; empty when they are none."""

    scales: tuple[sp.Symbol, ...]
    offsets: tuple[sp.Symbol, ...]

    @classmethod
    def of(cls, skeleton: Skeleton, families: tuple[str, ...]) -> _Proportions:
        import sympy as sp

        scales = [sp.Symbol(f"lambda_{g}", real=True) for g in range(len(skeleton.groups))]
        offsets = [
            sp.Symbol(f"offset_{i}{a}", real=True) for i in range(len(skeleton.markers)) for a in "xyz"
        ]
        return cls(
            tuple(scales) if "scale" in families else (), tuple(offsets) if "offsets" in families else ()
        )

    @property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        return self.scales + self.offsets

    def scaled(self, at: tuple[float, float, float], group: int, builder: ProgramBuilder) -> sp.Matrix:
        """A place on a link of a group, times the group's scale."""
        import sympy as sp

        place = sp.Matrix([_exact(v) for v in at])
        if not self.scales or group < 0:
            return place
        return place * builder.let(f"s_{group}g", sp.exp(self.scales[group]))


@dataclass
class _Frames:
    """Symbols of the frames: per link (rotation, origin) and growth of the origin (3, G); per DOF its world
    axis and a point on it."""

    links: list[tuple[sp.Matrix, sp.Matrix]]
    growth: list[sp.Matrix]
    axes: dict[int, sp.Matrix]
    points: dict[int, sp.Matrix]


def _grown(growth: sp.Matrix, arm: sp.Matrix, group: int) -> sp.Matrix:
    """Growth at the end of an arm: ∂(s·R·b)/∂λ = s·R·b for the arm's own group."""
    result = growth.copy()
    if group >= 0:
        result[:, group] += arm
    return result


def _derive_frames(
    skeleton: Skeleton, builder: ProgramBuilder, q: tuple[sp.Symbol, ...], proportions: _Proportions
) -> _Frames:
    import sympy as sp

    frames = _Frames([], [], {}, {})
    still = sp.zeros(3, len(proportions.scales))
    for i, link in enumerate(skeleton.links):
        world = (sp.eye(3), sp.zeros(3, 1))
        rotation, origin = frames.links[link.parent] if link.parent >= 0 else world
        group = skeleton.links[link.parent].group if link.parent >= 0 else -1
        arm = _let(builder, f"a{i}", rotation * proportions.scaled(link.at, group, builder))
        origin = _let(builder, f"o{i}", origin + arm)
        growth = frames.growth[link.parent] if link.parent >= 0 else still
        if proportions.scales:
            growth = _let(builder, f"g{i}", _grown(growth, arm, group))
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
        frames.growth.append(growth)
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
