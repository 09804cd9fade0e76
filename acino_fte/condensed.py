"""The condensed lowering: value, gradient and sparse Hessian of the objective over q alone.

With Σ ρ(r_k/σ_k) and r_k a function of marker positions p(q) and of q at a few frames, the chain rule gives

    gradient  = Σ_k ψ_k/σ_k · ∂r_k/∂q,
    Hessian   ≈ Σ_k ω_k/σ_k² · ∂r_kᵀ∂r_k   (Gauss–Newton with IRLS weights ω = ψ/e: positive semidefinite),
    exactly   = Σ_k (ρ''/σ² ∂rᵀ∂r + ψ/σ ∂²r) + Σ_m (∂E/∂p_m)·∂²p_m.

Derivatives for positions are gathered first, per frame and marker, and carried through the kinematics once.
A residual that reaches L frames back fills block diagonals 0…L, so the Hessian is banded (N·Q square,
block size Q): cost and memory grow linearly with N.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from acino_fte.problem import FTEProblem
from acino_fte.residuals import lower
from acino_fte.terms import Term

_CHUNK = 2048  # instances evaluated together: a program's intermediate rows stay in the cache
_FRAMES = 128  # frames whose Jacobians are multiplied together, for the same reason


@dataclass(frozen=True)
class _Slot:
    """One variable group of a term: where its values come from and where its derivatives go."""

    kind: str
    lag: int
    frames: np.ndarray
    items: np.ndarray
    rows: slice  # of the term's local variables


class _CompiledTerm:
    """A term ready to be evaluated: programs compiled, instances that reach before frame 0 dropped.

    Velocities and accelerations of the first frames are free: the jumps of acceleration that need frames
    before the first are made zero by them (see :mod:`acino_fte.explicit`) and leave the problem with them.
    """

    def __init__(self, term: Term, dt: float) -> None:
        lowered = lower(term.residual)
        term = term.select(term.frames >= term.residual.reach)
        self.term, self.lowered = term, lowered
        self.n_components = len(term.residual.components)
        self.n_guards = len(lowered.programs["value"].outputs) - self.n_components
        frames, items = term.frames, term.items
        self.data = [dt, *(term.data[name] for name in term.residual.data)]
        self.sd = term.sd
        self.size = len(term)
        self.slots: list[_Slot] = []
        start = 0
        for kind, lag, item in lowered.inputs:
            width = 3 if kind == "position" else 1
            rows = slice(start, start + width)
            self.slots.append(_Slot(kind, lag, frames - lag, items[:, item], rows))
            start += width

    @property
    def quadratic(self) -> bool:
        """Whether the term's Hessian is constant."""
        only_q = all(slot.kind == "dof" for slot in self.slots)
        return only_q and self.lowered.linear and self.term.loss.name == "squared"

    def run(self, program: str, q: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Outputs of a program for all instances, (outputs, K)."""
        inputs: list[np.ndarray | float] = []
        for slot in self.slots:
            if slot.kind == "position":
                inputs += list(np.ascontiguousarray(positions[slot.frames, slot.items].T))
            else:
                inputs.append(q[slot.frames, slot.items])
        inputs += self.data
        function = self.lowered.programs[program].numpy_function
        out = np.empty((len(self.lowered.programs[program].outputs), self.size))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for start in range(0, self.size, _CHUNK):
                part = slice(start, start + _CHUNK)
                function([v[part] if isinstance(v, np.ndarray) else v for v in inputs], out[:, part])
        return out

    def normalised(self, out: np.ndarray) -> np.ndarray:
        """e = r/σ (components, K); infinite where a guard is not positive."""
        e = out[: self.n_components] / self.sd
        guards = out[self.n_components : self.n_components + self.n_guards]
        if self.n_guards:
            e[:, (guards <= 0).any(0)] = np.inf
        return e


@dataclass
class _Gathered:
    """Derivatives collected over terms, for positions and for q."""

    position_gradient: np.ndarray  # (N, M, 3)
    q_gradient: np.ndarray  # (N, Q)


class Condensed:
    """Objective of an :class:`FTEProblem` over x = q.ravel(), with derivatives for IPOPT.

    Parameters
    ----------
    problem : FTEProblem
    exact : bool
        Use the exact Hessian instead of the Gauss–Newton one, which is positive semidefinite.
    """

    def __init__(self, problem: FTEProblem, *, exact: bool = False) -> None:
        self.problem = problem
        self.exact = exact
        self.shape = (problem.n_frames, len(problem.lower))
        self.compiled = [_CompiledTerm(t, problem.dt) for t in problem.terms]
        self.compiled = [t for t in self.compiled if t.size]
        self.uses_positions = any(s.kind == "position" for t in self.compiled for s in t.slots)
        self._at: np.ndarray | None = None
        self._linear: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._slopes: list[np.ndarray] = []

    def use_exact(self) -> None:
        """Use the exact Hessian from now on."""
        if not self.exact:
            self.exact = True
            self._at = None

    # --- value -------------------------------------------------------------------------------------

    def objective(self, x: np.ndarray) -> float:
        """Σ ρ(r/σ) at x (N·Q,).

        Derivatives are evaluated along with it: IPOPT asks for them next whenever it accepts the point.
        """
        self._linearise(x)
        return float(sum(losses[0].sum() for losses in self._losses))

    def term_values(self, x: np.ndarray) -> dict[str, float]:
        """The objective by family of terms."""
        q = x.reshape(self.shape)
        positions = self.problem.kinematics.positions(q) if self.uses_positions else np.empty(0)
        values: dict[str, float] = {}
        for term in self.compiled:
            e = term.normalised(term.run("value", q, positions))
            family = term.term.family
            values[family] = values.get(family, 0.0) + float(term.term.loss.value(e).sum())
        return values

    # --- derivatives -------------------------------------------------------------------------------

    def _linearise(self, x: np.ndarray) -> None:
        """Evaluate kinematics and all residuals with derivatives at x, once."""
        if self._at is not None and np.array_equal(x, self._at):
            return
        self._at = None
        q = x.reshape(self.shape)
        if self.uses_positions:
            self._linear = self.problem.kinematics.linearise(q)
        positions = self._linear[0] if self._linear is not None else np.empty(0)
        program = "curvature" if self.exact else "slope"
        self._slopes = [term.run(program, q, positions) for term in self.compiled]
        self._losses = [
            term.term.loss.derivatives(term.normalised(out))
            for term, out in zip(self.compiled, self._slopes, strict=True)
        ]
        self._gathered = self._gather()
        self._at = x.copy()

    def _gather(self) -> _Gathered:
        n, d = self.shape
        m = self.problem.kinematics.n_markers
        total = _Gathered(np.zeros((n * m, 3)), np.zeros(n * d))
        for term, out, (_, psi, _, _) in zip(self.compiled, self._slopes, self._losses, strict=True):
            pull = psi / term.sd  # (c, K)
            slope = self._slope(term, out)
            local = np.einsum("ck,csk->sk", pull, slope)
            for slot in term.slots:
                if slot.kind == "position":
                    at = slot.frames * m + slot.items
                    for a, row in enumerate(local[slot.rows]):
                        total.position_gradient[:, a] += np.bincount(at, row, minlength=n * m)
                else:
                    at = slot.frames * d + slot.items
                    total.q_gradient += np.bincount(at, local[slot.rows][0], minlength=n * d)
        total.position_gradient = total.position_gradient.reshape(n, m, 3)
        total.q_gradient = total.q_gradient.reshape(n, d)
        return total

    @staticmethod
    def _slope(term: _CompiledTerm, out: np.ndarray) -> np.ndarray:
        """∂r/∂(local variables), (components, variables, K); zero where a guard fails."""
        base = term.n_components + term.n_guards
        n = term.lowered.n_variables
        slope = out[base : base + term.n_components * n].reshape(term.n_components, n, -1)
        if term.n_guards:
            bad = (out[term.n_components : base] <= 0).any(0)
            if bad.any():
                slope[:, :, bad] = 0.0
        return slope

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """∂objective/∂x, (N·Q,)."""
        self._linearise(x)
        gradient = self._gathered.q_gradient
        if self._linear is not None:
            n, m = self.shape[0], self.problem.kinematics.n_markers
            pull = self._gathered.position_gradient.reshape(n, 1, 3 * m)
            gradient = gradient + (pull @ self._linear[1].reshape(n, 3 * m, -1))[:, 0]
        return gradient.ravel()

    # --- Hessian -----------------------------------------------------------------------------------

    @cached_property
    def _patterns(self) -> list[np.ndarray]:
        """Which entries (Q, Q) of block diagonal 0, 1, … any term touches; block 0 lower triangular."""
        d = self.shape[1]
        depends = self.problem.kinematics.depends
        lags = 1 + max((s.lag - t.lag for c in self.compiled for s in c.slots for t in c.slots), default=0)
        patterns = [np.zeros((d, d), dtype=bool) for _ in range(lags)]
        patterns[0] |= np.eye(d, dtype=bool)
        for term in self.compiled:
            for first in term.slots:
                for second in term.slots:
                    if second.lag < first.lag:
                        continue
                    met = np.zeros((first.items.max() + 1, second.items.max() + 1), dtype=bool)
                    met[first.items, second.items] = True
                    for row, column in np.argwhere(met):
                        patterns[second.lag - first.lag] |= np.outer(
                            depends[row] if first.kind == "position" else np.arange(d) == row,
                            depends[column] if second.kind == "position" else np.arange(d) == column,
                        )
        patterns[0] = np.tril(patterns[0] | patterns[0].T)
        return patterns

    @cached_property
    def structure(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the lower triangle's entries, grouped by block diagonal, then frame."""
        n, d = self.shape
        rows, columns = [], []
        for lag, pattern in enumerate(self._patterns):
            r, c = np.nonzero(pattern)
            frames = np.arange(lag, n)[:, None]
            rows.append((frames * d + r).ravel())
            columns.append(((frames - lag) * d + c).ravel())
        return np.concatenate(rows), np.concatenate(columns)

    @cached_property
    def _varying_lags(self) -> int:
        """Block diagonals 0 … this − 1 change with x; those beyond are constant."""
        changing = [t for t in self.compiled if not t.quadratic]
        return 1 + max((s.lag - t.lag for c in changing for s in c.slots for t in c.slots), default=0)

    def hessian_blocks(self, x: np.ndarray) -> list[np.ndarray]:
        """Block diagonals of the Hessian: item L is (N, Q, Q), block (n, n − L) at index n."""
        self._linearise(x)
        blocks = [b.copy() for b in self._constant_blocks[: self._varying_lags]]
        n, d = self.shape
        m = self.problem.kinematics.n_markers
        inner = np.zeros((n * m, 3, 3))
        coupled = False
        for term, out, losses in zip(self.compiled, self._slopes, self._losses, strict=True):
            if term.quadratic:
                continue
            local = self._local_hessian(term, out, losses)
            if len(term.slots) == 1 and term.slots[0].kind == "position":
                at = term.slots[0].frames * m + term.slots[0].items
                for a in range(3):
                    for b in range(a + 1):
                        inner[:, a, b] += np.bincount(at, local[a, b], minlength=n * m)
                coupled = True
            else:
                self._add_local(blocks, term, local)
        if coupled and self._linear is not None:
            for a in range(3):
                for b in range(a):
                    inner[:, b, a] = inner[:, a, b]
            curvature = inner.reshape(n, m, 3, 3)
            for start in range(0, n, _FRAMES):
                part = slice(start, start + _FRAMES)
                jacobian = self._linear[1][part]
                flat = jacobian.reshape(-1, 3 * m, d)
                carried = (curvature[part] @ jacobian).reshape(-1, 3 * m, d)
                blocks[0][part] += flat.transpose(0, 2, 1) @ carried
        if self.exact and self._linear is not None:
            blocks[0] += self._kinematic_curvature()
        return [*blocks, *self._constant_blocks[self._varying_lags :]]

    def _local_hessian(self, term: _CompiledTerm, out: np.ndarray, losses: tuple) -> np.ndarray:
        """Hessian of the term for its local variables, (variables, variables, K)."""
        _, psi, bend, weight = losses
        slope = self._slope(term, out)
        scale = (bend if self.exact else weight) / term.sd**2
        local = np.einsum("ck,cik,cjk->ijk", scale, slope, slope, optimize=True)
        if self.exact and not term.lowered.linear:
            count = term.lowered.n_variables
            start = term.n_components + term.n_guards + term.n_components * count
            second = out[start:].reshape(term.n_components, -1, term.size)
            pull = np.where(np.isfinite(second), psi[:, None] / term.sd * second, 0.0).sum(0)
            for place, (i, j) in enumerate(zip(*np.tril_indices(count), strict=True)):
                local[i, j] += pull[place]
                if i != j:
                    local[j, i] += pull[place]
        return local

    def _kinematic_curvature(self) -> np.ndarray:
        """Σ_m (∂E/∂p_m)·∂²p_m/∂q_i∂q_j = ω_i · Σ_m (∂p_m/∂q_j × ∂E/∂p_m) for i not after j on a chain."""
        assert self._linear is not None
        _, jacobian, omega = self._linear
        pull = self._gathered.position_gradient[..., None]  # (N, M, 3, 1)
        torque = np.stack(
            [
                (jacobian[:, :, b] * pull[:, :, c] - jacobian[:, :, c] * pull[:, :, b]).sum(1)
                for b, c in ((1, 2), (2, 0), (0, 1))
            ],
            axis=1,
        )  # (N, 3, Q)
        before = self.problem.kinematics.before
        full = (omega @ torque) * before
        return full + np.swapaxes(full * ~np.eye(len(before), dtype=bool), 1, 2)

    def _add_local(self, blocks: list[np.ndarray], term: _CompiledTerm, local: np.ndarray) -> None:
        """Add a local Hessian to the block diagonals, slot pair by slot pair."""
        d = self.shape[1]
        for first in term.slots:
            for second in term.slots:
                if second.lag < first.lag:
                    continue
                part = local[first.rows, second.rows]
                block = blocks[second.lag - first.lag].reshape(-1)
                base = first.frames * d * d
                if first.kind == "dof" and second.kind == "dof":
                    np.add.at(block, base + first.items * d + second.items, part[0, 0])
                    continue
                left, right = self._carrier(first), self._carrier(second)
                dense = np.einsum("kai,abk,kbj->kij", left, part, right, optimize=True)
                np.add.at(block.reshape(-1, d, d), first.frames, dense)

    def _carrier(self, slot: _Slot) -> np.ndarray:
        """∂(local variables of the slot)/∂q, (K, width, Q)."""
        if slot.kind == "position":
            assert self._linear is not None
            return self._linear[1][slot.frames, slot.items]
        unit = np.zeros((len(slot.frames), 1, self.shape[1]))
        unit[np.arange(len(slot.frames)), 0, slot.items] = 1.0
        return unit

    @cached_property
    def _constant_blocks(self) -> list[np.ndarray]:
        """Part of the Hessian that never changes: linear residuals with the squared loss."""
        n, d = self.shape
        blocks = [np.zeros((n, d, d)) for _ in self._patterns]
        for term, out, losses in zip(self.compiled, self._slopes, self._losses, strict=True):
            if term.quadratic:
                self._add_local(blocks, term, self._local_hessian(term, out, losses))
        return blocks

    def hessian(self, x: np.ndarray) -> np.ndarray:
        """Entries of the lower triangle in the order of :attr:`structure`."""
        return np.concatenate(
            [
                b[lag:, p].ravel()
                for lag, (b, p) in enumerate(zip(self.hessian_blocks(x), self._patterns, strict=True))
            ]
        )
