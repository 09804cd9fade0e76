"""From derivatives of single residuals to those of the whole: gather, then carry through the kinematics.

Shapes: N frames, M markers, Q degrees of freedom, P parameters of which the first K are kinematic
(G log-scales, then three offsets a marker).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from acino_fte.compiled_terms import CompiledTerm, Evaluation, Node, Slot
from acino_fte.kinematic_curvature import kinematic_curvature
from acino_fte.kinematics import Linearised
from acino_fte.problem import FTEProblem

_FRAMES = 128  # frames whose Jacobians are multiplied together: they stay in the processor's cache


class Gathered:
    """First derivatives for positions (N, M, 3), q (N, Q) and θ (P,)."""

    def __init__(self, shape: tuple[int, int], n_markers: int, n_parameters: int) -> None:
        self.q = np.zeros(shape)
        self.positions = np.zeros((shape[0], n_markers, 3))
        self.theta = np.zeros(n_parameters)

    def add(self, term: CompiledTerm, found: Evaluation, pull: np.ndarray) -> None:
        """Add the pulls (variables, K) of one term."""
        flat, d = self.positions.reshape(-1, 3), self.q.shape[1]
        for slot in term.slots:
            part = pull[slot.rows]
            if slot.kind == "position":
                for node in slot.nodes:
                    flat += node.scatter @ (part * term.weight(found, slot, node)).T
            elif slot.kind == "dof":
                cells = slot.frames * d + slot.items
                self.q += np.bincount(cells, part[0], minlength=self.q.size).reshape(self.q.shape)
            else:
                self.theta += np.bincount(slot.items, part[0], minlength=len(self.theta))

    def carried(self, linear: Linearised | None) -> tuple[np.ndarray, np.ndarray]:
        """∂E/∂q (N, Q) and ∂E/∂θ (P,), with what comes through the kinematics."""
        if linear is None:
            return self.q, self.theta
        n, m = self.positions.shape[:2]
        q = self.q + (self.positions.reshape(n, 1, 3 * m) @ linear.jacobian.reshape(n, 3 * m, -1))[:, 0]
        theta, g = self.theta.copy(), linear.growth.shape[-1]
        if g:
            theta[:g] += self.positions.reshape(-1) @ linear.growth.reshape(-1, g)
        if linear.rotations.shape[1]:
            theta[g : g + 3 * m] += np.einsum("nmab,nma->mb", linear.rotations, self.positions).ravel()
        return q, theta


class Hessian:
    """Second derivatives of a problem: banded A, border B and corner D, and where their entries are."""

    def __init__(self, problem: FTEProblem, compiled: list[CompiledTerm]) -> None:
        self.problem, self.compiled = problem, compiled
        self.shape = (problem.n_frames, len(problem.lower))
        self.n_parameters = len(problem.parameters)
        self.n_markers = problem.kinematics.n_markers

    # --- structure ---------------------------------------------------------------------------------

    @cached_property
    def _patterns(self) -> list[np.ndarray]:
        """Which entries (Q, Q) of block diagonal 0, 1, … any term touches; block 0 lower triangular."""
        d = self.shape[1]
        patterns = [np.zeros((d, d), dtype=bool) for _ in range(1 + self._reach)]
        patterns[0] |= np.eye(d, dtype=bool)
        for term in self.compiled:
            for first in term.slots:
                for second in term.slots:
                    for lag in _lags(first, second):
                        if lag >= 0:
                            patterns[lag] |= self._touched(first, second, self._movers(second))
        patterns[0] = np.tril(patterns[0] | patterns[0].T)
        return patterns

    @cached_property
    def _reach(self) -> int:
        pairs = [lag for t in self.compiled for s in t.slots for o in t.slots for lag in _lags(s, o)]
        return max(pairs, default=0)

    def _touched(self, first: Slot, second: Slot, of_second: np.ndarray) -> np.ndarray:
        """Entries (Q, …) that a pair of slots touches; ``of_second`` (items, …) is what moves the second."""
        movers = self._movers(first)
        together = np.zeros((len(movers), len(of_second)))
        together[first.items, second.items] = 1.0
        return (movers.T @ together @ of_second) > 0

    def _movers(self, slot: Slot) -> np.ndarray:
        """(items, Q) bool: which degrees of freedom move the items of a slot."""
        return (
            self.problem.kinematics.depends if slot.kind == "position" else np.eye(self.shape[1], dtype=bool)
        )

    @cached_property
    def _border(self) -> np.ndarray:
        """(Q, P) bool: entries of B that any term touches."""
        border = np.zeros((self.shape[1], self.n_parameters), dtype=bool)
        k = self.problem.parameters.n_kinematic
        own = np.repeat(np.eye(self.n_markers, dtype=bool), 3, axis=1)
        moved_by = np.concatenate([self.problem.kinematics.grows, own], axis=1)[:, :k]  # (M, K)
        for term in self.compiled:
            parameters = sorted({int(i) for s in term.slots if s.kind == "parameter" for i in s.items})
            positions = [s for s in term.slots if s.kind == "position" and k]
            for slot in (s for s in term.slots if s.kind != "parameter"):
                moving = self._movers(slot)[np.unique(slot.items)].any(0)
                border[np.ix_(moving, parameters)] = True
                for other in positions:
                    border[:, :k] |= self._touched(slot, other, moved_by)
        return border

    @cached_property
    def structure(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the lower triangle's entries: A by block diagonal and frame, then Bᵀ, D."""
        (n, d), p = self.shape, self.n_parameters
        rows, columns = [], []
        for lag, pattern in enumerate(self._patterns):
            r, c = np.nonzero(pattern)
            frames = np.arange(lag, n)[:, None]
            rows.append((frames * d + r).ravel())
            columns.append(((frames - lag) * d + c).ravel())
        j, i = np.nonzero(self._border)
        frames = np.arange(n)[:, None]
        rows.append(np.broadcast_to(n * d + i, (n, len(i))).ravel())
        columns.append((frames * d + j).ravel())
        r, c = np.tril_indices(p)
        return np.concatenate([*rows, n * d + r]), np.concatenate([*columns, n * d + c])

    def entries(self, blocks: list[np.ndarray], border: np.ndarray, corner: np.ndarray) -> np.ndarray:
        """Values for :attr:`structure`, with θ in units of its priors' standard deviations."""
        sd = self.problem.parameters.sd
        values = [b[lag:, p].ravel() for lag, (b, p) in enumerate(zip(blocks, self._patterns, strict=True))]
        values.append((border * sd)[:, self._border].ravel())
        values.append((corner * np.outer(sd, sd))[np.tril_indices(len(sd))])
        return np.concatenate(values)

    # --- values ------------------------------------------------------------------------------------

    def evaluate(
        self,
        found: list[Evaluation],
        pulls: list[np.ndarray],
        linear: Linearised | None,
        position_pull: np.ndarray,
        *,
        exact: bool,
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """A as block diagonals, B (N, Q, P), D (P, P); ``position_pull`` (N, M, 3) is ∂E/∂p."""
        sums = _Sums(self, linear)
        for term, values, pull in zip(self.compiled, found, pulls, strict=True):
            if not term.quadratic:
                sums.add(term, values, pull, exact=exact)
        blocks, border, corner = sums.carried()
        fixed = self._constant(found)
        for block, constant in zip([*blocks, border, corner], fixed, strict=True):
            if constant is not None:
                block += constant
        if exact and linear is not None:
            bent = kinematic_curvature(self.problem.kinematics, linear, position_pull)
            blocks[0] += bent.states
            border[:, :, : bent.mixed.shape[-1]] += bent.mixed
            corner[: len(bent.scales), : len(bent.scales)] += np.diag(bent.scales)
        return blocks, border, corner

    def _constant(self, found: list[Evaluation]) -> list[np.ndarray | None]:
        """Part of A's blocks, B and D that never changes: linear residuals with the squared loss."""
        if not hasattr(self, "_fixed"):
            sums = _Sums(self, None)
            for term, values in zip(self.compiled, found, strict=True):
                if term.quadratic:
                    sums.add(term, values, np.zeros((term.n_variables, term.size)), exact=False)
            self._fixed = [b if b.any() else None for b in (*sums.blocks, sums.border, sums.corner)]
        return self._fixed


class _Sums:
    """Second derivatives being summed, before they are carried through the kinematics."""

    def __init__(self, whole: Hessian, linear: Linearised | None) -> None:
        (n, d), p = whole.shape, whole.n_parameters
        self.whole, self.linear = whole, linear
        self.n_kinematic = whole.problem.parameters.n_kinematic
        self.blocks = [np.zeros((n, d, d)) for _ in range(1 + whole._reach)]
        self.border = np.zeros((n, d, p))
        self.corner = np.zeros((p, p))
        self.inner: dict[int, np.ndarray] = {}  # lag → (N·M, 9): ∂²E/∂p(n)∂p(n − lag) of one marker
        self.outer: dict[tuple[int, ...], np.ndarray] = {}  # places in θ → (N·M, 3, places): ∂²E/∂p∂θ

    def add(self, term: CompiledTerm, found: Evaluation, pull: np.ndarray, *, exact: bool) -> None:
        """Add the Hessian of one term."""
        local = term.hessian(found, pull, exact=exact)
        for first in term.slots:
            for second in term.slots:
                part = local[first.rows, second.rows]
                kinds = (first.kind, second.kind)
                if kinds == ("position", "position") and first.column == second.column:
                    self._positions(term, found, first, second, part)
                elif kinds == ("parameter", "parameter"):
                    _add_at(self.corner, first, second, part[0, 0])
                elif kinds == ("dof", "parameter"):
                    np.add.at(self.border, (first.frames, first.items, second.items), part[0, 0])
                elif kinds == ("dof", "dof") and second.lag >= first.lag:
                    cells = (first.frames, first.items, second.items)
                    np.add.at(self.blocks[second.lag - first.lag], cells, part[0, 0])
                elif "position" in kinds and "parameter" not in kinds:
                    self._general(first, second, part)
        late = [slot for slot in term.slots if slot.kind == "parameter"]
        for slot in term.slots:
            if slot.kind == "position" and late:
                extra = term.mixed(found, slot, pull) if exact else None
                self._position_parameters(term, found, slot, late, local, extra)

    def _positions(
        self, term: CompiledTerm, found: Evaluation, first: Slot, second: Slot, part: np.ndarray
    ) -> None:
        flat = np.ascontiguousarray(part.reshape(9, -1).T)
        for a in first.nodes:
            for b in second.nodes:
                lag = int(a.frames[0] - b.frames[0])
                if lag >= 0:
                    weight = term.weight(found, first, a) * term.weight(found, second, b)
                    total = a.scatter @ (flat * np.reshape(weight, (-1, 1)))
                    self.inner[lag] = self.inner[lag] + total if lag in self.inner else total

    def _position_parameters(
        self,
        term: CompiledTerm,
        found: Evaluation,
        slot: Slot,
        others: list[Slot],
        local: np.ndarray,
        extra: np.ndarray | None,
    ) -> None:
        """Add ∂²E/∂p∂θ of a position and all parameters of a term.

        ``extra`` (nodes, 3, K) is what the weights of a delayed position add in the column of its τ.
        """
        rows = [other.rows.start for other in others]
        stacked = np.ascontiguousarray(np.moveaxis(local[slot.rows][:, rows], -1, 0))  # (K, 3, p)
        late = next((i for i, o in enumerate(others) if o.delay_of is slot), None)
        for place, node in enumerate(slot.nodes):
            values = stacked * np.reshape(term.weight(found, slot, node), (-1, 1, 1))
            if extra is not None and late is not None:
                values[:, :, late] += extra[place].T
            self._outer(node, others, values)

    def _outer(self, node: Node, others: list[Slot], values: np.ndarray) -> None:
        """Add values (K, 3, p) of a node and p parameters to what has been gathered for positions."""
        same: dict[int, int] = {}  # parameters that every instance has, and their columns
        for column, other in enumerate(others):
            if other.item is not None and other.item not in same:
                same[other.item] = column
            else:
                self._spread(node, other, values[:, :, column])
        if same:
            chosen = values if len(same) == len(others) else values[:, :, list(same.values())]
            total = node.scatter @ chosen.reshape(len(chosen), -1)
            self._keep(tuple(same), total)

    def _spread(self, node: Node, other: Slot, values: np.ndarray) -> None:
        """The same for a parameter that differs between instances, values (K, 3)."""
        items, place = np.unique(other.items, return_inverse=True)
        total = np.zeros((node.scatter.shape[0], 3, len(items)))
        cells = node.scatter.tocoo()
        where = (cells.row[:, None], np.arange(3), place[cells.col][:, None])
        np.add.at(total, where, cells.data[:, None] * values[cells.col])
        self._keep(tuple(items.tolist()), total)

    def _keep(self, key: tuple[int, ...], total: np.ndarray) -> None:
        total = total.reshape(-1, 3, len(key))
        self.outer[key] = self.outer[key] + total if key in self.outer else total

    def _general(self, first: Slot, second: Slot, part: np.ndarray) -> None:
        """Two markers, or a marker and a degree of freedom, of one residual: every instance by itself."""
        left, left_theta = self._carrier(first)
        right, right_theta = self._carrier(second)
        if second.lag >= first.lag:
            dense = np.einsum("kai,abk,kbj->kij", left, part, right, optimize=True)
            np.add.at(self.blocks[second.lag - first.lag], first.frames, dense)
        k = self.n_kinematic
        if k:
            cross = np.einsum("kai,abk,kbj->kij", left, part, right_theta, optimize=True)
            np.add.at(self.border[:, :, :k], first.frames, cross)
            self.corner[:k, :k] += np.einsum("kai,abk,kbj->ij", left_theta, part, right_theta, optimize=True)

    def _carrier(self, slot: Slot) -> tuple[np.ndarray, np.ndarray]:
        """∂(local variables of the slot)/∂q, (K, width, Q), and for the kinematic parameters."""
        count, d = len(slot.frames), self.whole.shape[1]
        if slot.kind == "position":
            assert self.linear is not None and len(slot.nodes) == 1
            return self.linear.jacobian[slot.frames, slot.items], self._kinematic(slot)
        unit = np.zeros((count, 1, d))
        unit[np.arange(count), 0, slot.items] = 1.0
        return unit, np.zeros((count, 1, self.n_kinematic))

    def _kinematic(self, slot: Slot) -> np.ndarray:
        """∂p/∂(kinematic parameters) of a position slot, (K, 3, K)."""
        assert self.linear is not None
        g, count = self.linear.growth.shape[-1], len(slot.frames)
        result = np.zeros((count, 3, self.n_kinematic))
        result[:, :, :g] = self.linear.growth[slot.frames, slot.items]
        if self.n_kinematic > g:
            turned = self.linear.rotations[slot.frames, slot.items]
            for axis in range(3):
                result[np.arange(count), :, g + 3 * slot.items + axis] = turned[:, :, axis]
        return result

    # --- through the kinematics --------------------------------------------------------------------

    def carried(self) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """A, B and D with what was gathered for positions carried to q and θ."""
        if self.linear is None or not (self.inner or self.outer):
            return self.blocks, self.border, self.corner
        (n, d), m, k = self.whole.shape, self.whole.n_markers, self.n_kinematic
        curvature = {lag: v.reshape(n, m, 3, 3) for lag, v in self.inner.items()}
        for lag, values in curvature.items():
            self._band(lag, values)
        jacobian = self.linear.jacobian.reshape(n, 3 * m, d).transpose(0, 2, 1)
        for places, values in self.outer.items():
            self.border[:, :, list(places)] += jacobian @ values.reshape(n, 3 * m, -1)
        if k:
            self._scales(curvature)
            self._offsets(curvature)
        return self.blocks, self.border, self.corner

    def _band(self, lag: int, values: np.ndarray) -> None:
        """A[lag] += J(n)ᵀ · H_pp(n, n − lag) · J(n − lag)."""
        assert self.linear is not None
        (n, d), m = self.whole.shape, self.whole.n_markers
        for start in range(lag, n, _FRAMES):
            now = slice(start, min(start + _FRAMES, n))
            ago = slice(now.start - lag, now.stop - lag)
            left = self.linear.jacobian[now].reshape(-1, 3 * m, d)
            right = (values[now] @ self.linear.jacobian[ago]).reshape(-1, 3 * m, d)
            self.blocks[lag][now] += left.transpose(0, 2, 1) @ right

    @staticmethod
    def _applied(curvature: dict[int, np.ndarray], fields: np.ndarray) -> np.ndarray:
        """Σ_n' H_pp(n, n') · fields(n'), fields (N, M, 3, …)."""
        result = np.zeros_like(fields)
        for lag, values in curvature.items():
            if lag == 0:
                result += values @ fields
            else:
                result[lag:] += values[lag:] @ fields[:-lag]
                result[:-lag] += values[lag:].swapaxes(-1, -2) @ fields[lag:]
        return result

    def _scales(self, curvature: dict[int, np.ndarray]) -> None:
        assert self.linear is not None
        growth = self.linear.growth
        n, m, _, g = growth.shape
        if not g:
            return
        d, k = self.whole.shape[1], self.n_kinematic
        applied = self._applied(curvature, growth)
        jacobian = self.linear.jacobian.reshape(n, 3 * m, d)
        self.border[:, :, :g] += jacobian.transpose(0, 2, 1) @ applied.reshape(n, 3 * m, g)
        flat = growth.reshape(-1, g)
        self.corner[:g, :g] += flat.T @ applied.reshape(-1, g)
        for places, values in self.outer.items():
            self._corner(np.arange(g), places, flat.T @ values.reshape(len(flat), -1))
        if k > g:
            turned = (self.linear.rotations.swapaxes(-1, -2) @ applied).sum(0)
            self._corner(np.arange(g, k), tuple(range(g)), turned.reshape(3 * m, g))

    def _offsets(self, curvature: dict[int, np.ndarray]) -> None:
        assert self.linear is not None
        turned = self.linear.rotations
        if not turned.shape[1]:
            return
        n, m = turned.shape[:2]
        d, k, g = self.whole.shape[1], self.n_kinematic, self.linear.growth.shape[-1]
        applied = self._applied(curvature, turned)
        mixed = self.linear.jacobian.swapaxes(-1, -2) @ applied  # (N, M, Q, 3)
        self.border[:, :, g:k] += mixed.transpose(0, 2, 1, 3).reshape(n, d, 3 * m)
        own = (turned.swapaxes(-1, -2) @ applied).sum(0)
        for i in range(m):
            part = slice(g + 3 * i, g + 3 * i + 3)
            self.corner[part, part] += own[i]
        for places, values in self.outer.items():
            cross = (turned.swapaxes(-1, -2) @ values.reshape(n, m, 3, -1)).sum(0)
            self._corner(np.arange(g, k), places, cross.reshape(3 * m, -1))

    def _corner(self, rows: np.ndarray, places: tuple[int, ...], values: np.ndarray) -> None:
        columns = np.array(places)
        self.corner[np.ix_(rows, columns)] += values
        self.corner[np.ix_(columns, rows)] += values.T


def _add_at(matrix: np.ndarray, row: Slot, column: Slot, values: np.ndarray) -> None:
    """Add values (K,) at the items of two slots; in one go where all instances have the same items."""
    if row.item is not None and column.item is not None:
        matrix[row.item, column.item] += values.sum()
    else:
        np.add.at(matrix, (row.items, column.items), values)


def _lags(first: Slot, second: Slot) -> list[int]:
    """Block diagonals that a pair of slots touches (how many frames the second is before the first)."""
    if "parameter" in (first.kind, second.kind):
        return []
    before = [node.frames[0] for node in first.nodes] or [first.frames[0]]
    after = [node.frames[0] for node in second.nodes] or [second.frames[0]]
    return [int(a - b) for a in before for b in after]
