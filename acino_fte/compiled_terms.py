"""A term ready to be evaluated: values, slopes and Hessians of all its instances at once.

The local variables of an instance are what its residual was lowered to (marker positions, degrees of freedom,
parameters); a position at t + τ adds τ. With r(p̃, …), p̃ = Σ_k w_k(τ) p_k and σ the standard deviation,

    ∂r/∂τ = ∂r/∂p̃ · ∂p̃/∂τ,   ∂²E/∂p_k∂τ = w_k ∂²E/∂p̃∂p̃ ∂p̃/∂τ + ∂w_k/∂τ ∂E/∂p̃

and so on, which is all that a delay asks of a residual (:mod:`acino_fte.delay`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from acino_fte import delay
from acino_fte.errors import InputError
from acino_fte.residuals import Residual, lower, width
from acino_fte.terms import Term

_CHUNK = 2048  # instances evaluated together: a program's intermediate rows stay in the cache


@dataclass(frozen=True, eq=False)
class Point:
    """Where terms are evaluated: q (N, Q), θ (P,) and marker positions (N, M, 3)."""

    q: np.ndarray
    theta: np.ndarray
    positions: np.ndarray


@dataclass(frozen=True, eq=False)
class Node:
    """One frame that a position comes from: ``frames`` (K,), and its place in the stencil of a delay."""

    frames: np.ndarray
    place: int | None
    scatter: csr_array  # (N·M, K): sums values of instances into frames and markers


@dataclass(frozen=True, eq=False)
class Slot:
    """One group of local variables: where its values come from and where its derivatives go.

    Attributes
    ----------
    kind : str
        ``"position"``, ``"dof"`` or ``"parameter"``.
    column : int
        Column of the term's items.
    frames, items : (K,)
    rows : slice
        Of the local variables.
    nodes : tuple of Node
        Of a position: one, or those of its stencil.
    delay : (K,), optional
        Of a position at t + τ: the parameter τ; ``newest`` (K,) is the newest frame of the stencil.
    delay_of : Slot, optional
        Of a parameter τ: the position that it moves in time.
    """

    kind: str
    column: int
    lag: int
    frames: np.ndarray
    items: np.ndarray
    rows: slice
    nodes: tuple[Node, ...] = ()
    delay: np.ndarray | None = None
    newest: np.ndarray | None = None
    delay_of: Slot | None = None

    @cached_property
    def item(self) -> int | None:
        """The item when all instances have the same one."""
        return int(self.items[0]) if len(self.items) and (self.items == self.items[0]).all() else None


@dataclass(frozen=True, eq=False)
class Blend:
    """A delayed position at its current τ: weights and slopes (nodes, K); velocity, acceleration (3, K)."""

    weights: np.ndarray
    slopes: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A term at one point: e = r/σ (c, K), ∂r (c, variables, K), ∂²r (c, pairs, K) and the blends."""

    e: np.ndarray
    slope: np.ndarray
    second: np.ndarray
    blends: dict[int, Blend]
    losses: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class CompiledTerm:
    """A term with its programs compiled, instances that reach before frame 0 dropped.

    Velocities and accelerations of the first frames are free: the jumps of acceleration that need frames
    before the first are made zero by them (see :mod:`acino_fte.explicit`) and leave the problem with them.

    Raises
    ------
    InputError
        A delayed position stands in a residual beside another position or a degree of freedom.
    """

    def __init__(self, term: Term, dt: float, n_frames: int, n_markers: int) -> None:
        lowered = lower(term.residual)
        _check_delay(term.residual)
        term = term.select(term.frames >= term.residual.reach)
        self.term, self.lowered, self.dt = term, lowered, dt
        self.n_components = len(term.residual.components)
        self.n_guards = len(lowered.programs["value"].outputs) - self.n_components
        self.data = [dt, *(term.data[name] for name in term.residual.data)]
        self.sd = term.sd
        self.size = len(term)
        self.n_local = lowered.n_variables
        self.slots: list[Slot] = []
        late: list[tuple[int, np.ndarray, slice, int]] = []
        start = 0
        for source in lowered.inputs:
            rows = slice(start, start + width(source))
            start = rows.stop
            frames, items = term.frames - source.lag, term.items[:, source.item]
            nodes: tuple[Node, ...] = ()
            shift = newest = None
            if source.delay is not None:
                shift, newest = term.items[:, source.delay], delay.stencil(frames, n_frames)
                place = slice(self.n_local + len(late), self.n_local + len(late) + 1)
                late.append((source.delay, shift, place, len(self.slots)))
            if source.kind == "position":
                nodes = tuple(_nodes(frames, newest, items, n_frames, n_markers))
            self.slots.append(
                Slot(source.kind, source.item, source.lag, frames, items, rows, nodes, shift, newest)
            )
        self.slots += [
            Slot("parameter", column, 0, term.frames, shift, place, delay_of=self.slots[owner])
            for column, shift, place, owner in late
        ]
        self.n_variables = self.n_local + len(late)

    @property
    def quadratic(self) -> bool:
        """Whether the term's Hessian is constant."""
        still = all(slot.kind != "position" for slot in self.slots)
        return still and self.lowered.linear and self.term.loss.name == "squared"

    # --- evaluation --------------------------------------------------------------------------------

    def _inputs(self, at: Point, blends: dict[int, Blend]) -> list[np.ndarray | float]:
        """Values of the local variables, then the data; blends are added for the delayed positions."""
        inputs: list[np.ndarray | float] = []
        for i, slot in enumerate(self.slots):
            if slot.rows.start >= self.n_local:
                break
            if slot.delay is not None and slot.newest is not None:
                u = at.theta[slot.delay] / self.dt - (slot.newest - slot.frames)
                w = delay.weights(u)
                points = np.stack([at.positions[node.frames, slot.items] for node in slot.nodes])
                mixed = np.einsum("onk,nka->oak", w, points)
                blends[i] = Blend(w[0], w[1] / self.dt, mixed[1] / self.dt, mixed[2] / self.dt**2)
                inputs += list(mixed[0])
            elif slot.kind == "position":
                inputs += list(np.ascontiguousarray(at.positions[slot.frames, slot.items].T))
            elif slot.kind == "parameter":
                inputs.append(at.theta[slot.items])
            else:
                inputs.append(at.q[slot.frames, slot.items])
        return inputs + self.data

    def _run(self, program: str, inputs: list[np.ndarray | float]) -> np.ndarray:
        """Outputs of a program for all instances, (outputs, K)."""
        function = self.lowered.programs[program].numpy_function
        out = np.empty((len(self.lowered.programs[program].outputs), self.size))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for start in range(0, self.size, _CHUNK):
                part = slice(start, start + _CHUNK)
                function([v[part] if isinstance(v, np.ndarray) else v for v in inputs], out[:, part])
        return out

    def normalised(self, at: Point) -> np.ndarray:
        """e = r/σ (components, K); infinite where a guard is not positive."""
        return self._normalised(self._run("value", self._inputs(at, {})))

    def _normalised(self, out: np.ndarray) -> np.ndarray:
        e = out[: self.n_components] / self.sd
        guards = out[self.n_components : self.n_components + self.n_guards]
        if self.n_guards:
            e[:, (guards <= 0).any(0)] = np.inf
        return e

    def evaluate(self, at: Point, *, exact: bool) -> Evaluation:
        """Residuals with slopes, and with second derivatives when ``exact``."""
        blends: dict[int, Blend] = {}
        out = self._run("curvature" if exact else "slope", self._inputs(at, blends))
        e = self._normalised(out)
        c, n, base = self.n_components, self.n_local, self.n_components + self.n_guards
        local = out[base : base + c * n].reshape(c, n, -1)
        second = out[base + c * n :].reshape(c, -1, self.size) if exact else np.empty((c, 0, self.size))
        if self.n_guards:
            bad = (out[c:base] <= 0).any(0)
            if bad.any():
                local[:, :, bad] = 0.0
        slope = local
        if blends:
            slope = np.empty((c, self.n_variables, self.size))
            slope[:, :n] = local
            for row, (i, blend) in enumerate(blends.items(), start=n):
                np.einsum("cak,ak->ck", local[:, self.slots[i].rows], blend.velocity, out=slope[:, row])
        return Evaluation(e, slope, second, blends, self.term.loss.derivatives(e))

    def pull(self, found: Evaluation) -> np.ndarray:
        """∂E/∂(local variables), (variables, K)."""
        return np.einsum("ck,csk->sk", found.losses[1] / self.sd, found.slope)

    def hessian(self, found: Evaluation, pull: np.ndarray, *, exact: bool) -> np.ndarray:
        """∂²E/∂(local variables)², (variables, variables, K), without the part of :meth:`mixed`."""
        _, psi, bend, weight = found.losses
        scaled = found.slope * ((bend if exact else weight) / self.sd**2)[:, None]
        local = np.einsum("cik,cjk->ijk", scaled, found.slope)
        if not exact:
            return local
        if not self.lowered.linear:
            self._add_second(local, found, psi)
        for row, (i, blend) in enumerate(found.blends.items(), start=self.n_local):
            local[row, row] += (pull[self.slots[i].rows] * blend.acceleration).sum(0)
        return local

    def _add_second(self, local: np.ndarray, found: Evaluation, psi: np.ndarray) -> None:
        """Add Σ_c ψ_c/σ ∂²r_c, carried to the delays: T' S T with T = ∂(program's variables)/∂(all)."""
        n = self.n_local
        bent = np.where(np.isfinite(found.second), (psi / self.sd)[:, None] * found.second, 0.0).sum(0)
        own = np.empty((n, n, self.size))
        rows, columns = np.tril_indices(n)
        own[rows, columns] = own[columns, rows] = bent
        local[:n, :n] += own
        carried = {
            row: np.einsum("iak,ak->ik", own[:, self.slots[i].rows], blend.velocity)
            for row, (i, blend) in enumerate(found.blends.items(), start=n)
        }
        for column, values in carried.items():
            local[:n, column] += values
            local[column, :n] += values
            for row, (i, blend) in enumerate(found.blends.items(), start=n):
                local[row, column] += (values[self.slots[i].rows] * blend.velocity).sum(0)

    def mixed(self, found: Evaluation, slot: Slot, pull: np.ndarray) -> np.ndarray | None:
        """∂w_k/∂τ ∂E/∂p̃ of a delayed position, (nodes, 3, K); None of any other."""
        blend = found.blends.get(self.slots.index(slot))
        return None if blend is None else blend.slopes[:, None] * pull[slot.rows]

    def weight(self, found: Evaluation, slot: Slot, node: Node) -> np.ndarray | float:
        """Share of a node in a position: 1, or the weight in its stencil (K,)."""
        if node.place is None:
            return 1.0
        return found.blends[self.slots.index(slot)].weights[node.place]


def _check_delay(residual: Residual) -> None:
    """At both ends the frames of a stencil depend on the instance: nothing else with a frame goes with it."""
    others = [h for h in residual.handles if h.kind != "parameter"]
    if len(others) > 1 and any(h.delay is not None for h in others):
        raise InputError(
            f"The residual '{residual.name}' has a delayed position beside other positions or joints.",
            expected="a delayed position, and parameters, alone",
            found=", ".join(h.kind + (" (delayed)" if h.delay is not None else "") for h in others),
        )


def _nodes(
    frames: np.ndarray, newest: np.ndarray | None, items: np.ndarray, n_frames: int, n_markers: int
) -> Iterator[Node]:
    """The frames that a position comes from."""
    count = len(frames)
    for place in range(delay.NODES) if newest is not None else (None,):
        at = frames if newest is None else newest - place
        cells = (np.ones(count), (at * n_markers + items, np.arange(count)))
        yield Node(at, place, csr_array(cells, shape=(n_frames * n_markers, count)))
