"""The condensed lowering: value, gradient and sparse Hessian of the objective over q and θ alone.

With Σ ρ(r_k/σ_k) and r_k a function of marker positions p(q, θ), of q at a few frames and of θ, the chain
rule gives

    gradient  = Σ_k ψ_k/σ_k · ∂r_k,
    Hessian   ≈ Σ_k ω_k/σ_k² · ∂r_kᵀ∂r_k   (Gauss–Newton with IRLS weights ω = ψ/e: positive semidefinite),
    exactly   = Σ_k (ρ''/σ² ∂rᵀ∂r + ψ/σ ∂²r) + Σ_m (∂E/∂p_m)·∂²p_m.

Derivatives for positions are gathered first, per frame and marker, and carried through the kinematics once.
A residual that reaches L frames back fills block diagonals 0…L, and θ a border: the Hessian

    ⎡A  B⎤   A banded (N·Q square, blocks of Q),  B (N·Q, P),  D (P, P)
    ⎣Bᵀ D⎦

is banded with an arrow: cost and memory grow linearly with N. The solver's variables are
x = (q.ravel(), θ/σ_θ): parameters in units of their priors' standard deviations.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np

from acino_fte.compiled_terms import CompiledTerm, Evaluation, Point
from acino_fte.gathering import Gathered, Hessian
from acino_fte.kinematics import Linearised
from acino_fte.problem import FTEProblem


class Condensed:
    """Objective of an :class:`FTEProblem` over x = (q.ravel(), θ/σ_θ), with derivatives for IPOPT.

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
        self.n_parameters = len(problem.parameters)
        n_markers = problem.kinematics.n_markers
        terms = [CompiledTerm(t, problem.dt, problem.n_frames, n_markers) for t in problem.terms]
        self.compiled = [t for t in terms if t.size]
        self.uses_positions = any(s.kind == "position" for t in self.compiled for s in t.slots)
        self._at: np.ndarray | None = None
        self._linear: Linearised | None = None
        self._found: list[Evaluation] = []

    def use_exact(self, exact: bool = True) -> None:
        """Use the exact Hessian from now on, or the Gauss–Newton one again."""
        if self.exact != exact:
            self.exact = exact
            self._at = None

    # --- the solver's variables --------------------------------------------------------------------

    def pack(self, q: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """x of q (N, Q) and θ (P,)."""
        return np.concatenate([q.ravel(), theta / self.problem.parameters.sd])

    def unpack(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """q (N, Q) and θ (P,) of x."""
        count = self.shape[0] * self.shape[1]
        return x[:count].reshape(self.shape), x[count:] * self.problem.parameters.sd

    # --- value -------------------------------------------------------------------------------------

    def objective(self, x: np.ndarray) -> float:
        """Σ ρ(r/σ) at x.

        Derivatives are evaluated along with it: IPOPT asks for them next whenever it accepts the point.
        """
        self._linearise(x)
        return float(sum(found.losses[0].sum() for found in self._found))

    def term_values(self, x: np.ndarray) -> dict[str, float]:
        """The objective by family of terms."""
        self._linearise(x)
        values: dict[str, float] = {}
        for term, found in zip(self.compiled, self._found, strict=True):
            values[term.term.family] = values.get(term.term.family, 0.0) + float(found.losses[0].sum())
        return values

    def evaluated(self) -> Iterator[tuple[CompiledTerm, Evaluation]]:
        """The terms, as they were evaluated last."""
        return zip(self.compiled, self._found, strict=True)

    # --- derivatives -------------------------------------------------------------------------------

    def _linearise(self, x: np.ndarray) -> None:
        """Evaluate kinematics and all residuals with derivatives at x, once."""
        if self._at is not None and np.array_equal(x, self._at):
            return
        self._at = None
        q, theta = self.unpack(x)
        positions = np.empty((0, 0, 3))
        if self.uses_positions:
            self._linear = self.problem.kinematics.linearise(q, self.problem.proportions(theta))
            positions = self._linear.positions
        at = Point(q, theta, positions)
        self._found = [term.evaluate(at, exact=self.exact) for term in self.compiled]
        self._gathered = self._gather()
        self._at = x.copy()

    def _gather(self) -> Gathered:
        """First derivatives of all terms, by position, degree of freedom and parameter."""
        total = Gathered(self.shape, self.problem.kinematics.n_markers, self.n_parameters)
        self._pulls = [t.pull(found) for t, found in zip(self.compiled, self._found, strict=True)]
        for term, found, pull in zip(self.compiled, self._found, self._pulls, strict=True):
            total.add(term, found, pull)
        return total

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """∂objective/∂x."""
        self._linearise(x)
        q, theta = self._gathered.carried(self._linear)
        return np.concatenate([q.ravel(), theta * self.problem.parameters.sd])

    # --- Hessian -----------------------------------------------------------------------------------

    @cached_property
    def _hessian(self) -> Hessian:
        return Hessian(self.problem, self.compiled)

    def hessian_parts(self, x: np.ndarray) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """The Hessian for (q, θ), θ in its own units: A as block diagonals, B (N, Q, P) and D (P, P).

        Item L of A is (N, Q, Q), with block (n, n − L) at index n.
        """
        self._linearise(x)
        pulls = self._gathered.positions
        return self._hessian.evaluate(self._found, self._pulls, self._linear, pulls, exact=self.exact)

    @property
    def structure(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the lower triangle's entries: A by block diagonal, then Bᵀ, then D."""
        return self._hessian.structure

    def hessian(self, x: np.ndarray) -> np.ndarray:
        """Entries of the lower triangle in the order of :attr:`structure`."""
        return self._hessian.entries(*self.hessian_parts(x))
