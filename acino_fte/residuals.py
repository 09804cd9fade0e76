"""Residuals: formulas declared once as SymPy expressions, and what both lowerings make of them.

A :class:`Residual` speaks of *handles* (a marker's position, a degree of freedom, its velocity or
acceleration, now or some frames ago; a global parameter) and of named data. The explicit lowering takes it
as declared (:func:`residual_program`); the condensed one takes it with velocities and accelerations replaced
by backward differences of q, and with first and second derivatives (:func:`lower`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acino_fte.codegen import Program, ProgramBuilder, cached_programs

if TYPE_CHECKING:
    import sympy as sp

Let = Callable[[str, Any], Any]
Derived = tuple[list["sp.Expr"], list["sp.Expr"]]

AXES = ("x", "y", "z")
_STENCIL = {"dof": (1,), "velocity": (1, -1), "acceleration": (1, -2, 1)}


@dataclass(frozen=True)
class Handle:
    """What a residual depends on.

    Attributes
    ----------
    kind : str
        ``"position"`` (a marker, three numbers, m), ``"dof"`` (q), ``"velocity"`` or ``"acceleration"``
        (its backward differences in time), or ``"parameter"`` (one of the global parameters θ).
    lag : int
        How many frames ago.
    item : int
        Which column of the term's ``items`` says which marker, degree of freedom or parameter is meant.
    delay : int, optional
        For a position at t + τ: which column of ``items`` says which parameter τ is
        (:mod:`acino_fte.delay`).
    """

    kind: str
    lag: int = 0
    item: int = 0
    delay: int | None = None


@dataclass(frozen=True)
class Residual:
    """A formula r(handles, data), declared once.

    Attributes
    ----------
    name : str
    handles : tuple of Handle
    data : tuple of str
        Names of the numbers that each instance brings; ``dt`` (s) is always there.
    components : tuple of str
        Names of the residual's components.
    unit : str
        Unit of the residual and of its standard deviation.
    derive : callable
        ``derive(handles, data, let) → (components, guards)``: SymPy expressions. ``handles`` has a
        3-tuple of symbols for a position and a symbol for the rest. ``let(name, expression)`` names an
        intermediate result; derivatives then follow the chain rule over such names instead of growing
        by expansion. Where a guard is not positive the residual is infinite (a point behind the camera).
    sources : tuple of Path
        Files that the formula depends on, for the cache; without them it is derived anew each time.
    """

    name: str
    handles: tuple[Handle, ...]
    data: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    derive: Callable[[list[Any], dict[str, sp.Symbol], Let], Derived]
    sources: tuple[Path, ...] = ()

    def __hash__(self) -> int:
        return hash((self.name, self.handles, self.data))

    @property
    def reach(self) -> int:
        """How many frames back the formula needs q."""
        return max(source.lag for handle in self.handles for source, _ in _stencil(handle))


@dataclass(frozen=True)
class Lowered:
    """A residual in terms of positions, q and parameters alone, as programs.

    ``inputs`` lists the local variables in order, as handles of the kinds ``position``, ``dof`` and
    ``parameter``, a position counting three. ``programs`` are ``value`` (components, guards), ``slope``
    (components, guards, then ∂component/∂variable) and ``curvature`` (the same, then the second derivatives
    for variable pairs i ≥ j).
    """

    inputs: tuple[Handle, ...]
    n_variables: int
    linear: bool
    programs: dict[str, Program]


def _symbols(residual: Residual) -> tuple[list[Any], dict[str, sp.Symbol], list[sp.Symbol]]:
    """Symbols for the handles, by name for the data, and all of them flat in the order of the inputs."""
    import sympy as sp

    handles: list[Any] = []
    for i, handle in enumerate(residual.handles):
        if handle.kind == "position":
            handles.append(tuple(sp.Symbol(f"h{i}_{a}", real=True) for a in AXES))
        else:
            handles.append(sp.Symbol(f"h{i}", real=True))
    data = {name: sp.Symbol(name, real=True) for name in ("dt", *residual.data)}
    flat = [s for h in handles for s in (h if isinstance(h, tuple) else (h,))]
    return handles, data, flat


def residual_program(residual: Residual) -> Program:
    """The residual as declared: (handles, dt, data) → components. For the explicit lowering."""

    def derive() -> dict[str, Program]:
        handles, data, flat = _symbols(residual)
        builder = ProgramBuilder([*flat, *data.values()])
        components, _ = residual.derive(handles, data, builder.let)
        return {"declared": builder.program(components)}

    return _cached(residual, "declared", derive)["declared"]


def _cached(residual: Residual, what: str, derive: Callable[[], dict[str, Program]]) -> dict[str, Program]:
    if not residual.sources:
        return derive()
    sources = (Path(__file__), *residual.sources, residual.handles, residual.data, what)
    return cached_programs(f"residual-{residual.name}", sources, derive)


def input_names(residual: Residual) -> list[str]:
    """Names of the inputs of :func:`residual_program`, in order."""
    names: list[str] = []
    for i, handle in enumerate(residual.handles):
        names += [f"h{i}_{a}" for a in AXES] if handle.kind == "position" else [f"h{i}"]
    return [*names, "dt", *residual.data]


@cache
def lower(residual: Residual) -> Lowered:
    """Eliminate velocities and accelerations: v_n = (q_n − q_{n−1})/Δt, a_n = (v_n − v_{n−1})/Δt."""
    inputs = tuple(dict.fromkeys(i for handle in residual.handles for i, _ in _stencil(handle)))
    programs = _cached(residual, "lowered", lambda: _derive_lowered(residual, inputs))
    n = sum(width(source) for source in inputs)
    slopes = programs["slope"].outputs[len(programs["value"].outputs) :]
    moving = _depends_on(programs["slope"], slopes, {f"y{i}" for i in range(n)})
    return Lowered(inputs, n, not moving, programs)


def width(handle: Handle) -> int:
    """How many numbers a handle stands for."""
    return 3 if handle.kind == "position" else 1


def _stencil(handle: Handle) -> list[tuple[Handle, int]]:
    """The variables behind a handle, with their weights (to be divided by Δt, Δt² for derivatives)."""
    if handle.kind in ("position", "parameter"):
        return [(handle, 1)]
    return [(Handle("dof", handle.lag + k, handle.item), w) for k, w in enumerate(_STENCIL[handle.kind])]


def _depends_on(program: Program, outputs: tuple[str, ...], names: set[str]) -> bool:
    tainted = set(names)
    for name, text in program.steps:
        tokens = set("".join(c if c.isalnum() or c == "_" else " " for c in text).split())
        if tokens & tainted:
            tainted.add(name)
    return bool(tainted & set(outputs))


def _derive_lowered(residual: Residual, inputs: tuple[Handle, ...]) -> dict[str, Program]:
    import sympy as sp

    handles, data, _ = _symbols(residual)
    n = sum(width(source) for source in inputs)
    y = list(sp.symbols(f"y0:{n}", real=True))
    place: dict[Handle, list[sp.Symbol]] = {}
    used = 0
    for source in inputs:
        place[source] = y[used : used + width(source)]
        used += width(source)
    values: list[Any] = []
    for handle in residual.handles:
        stencil = _stencil(handle)
        if handle.kind == "position":
            values.append(tuple(place[stencil[0][0]]))
        else:
            total = sum(w * place[source][0] for source, w in stencil)
            values.append(total / data["dt"] ** (len(stencil) - 1))
    chain = _Chain([*y, *data.values()], y)
    components, guards = residual.derive(values, data, chain.let)
    base = [*components, *guards]
    first = [d for c in components for d in chain.first(c)]
    second = [d for c in components for d in chain.second(c)]
    builder = chain.builder
    return {
        "value": builder.program(base),
        "slope": builder.program(base + first),
        "curvature": builder.program(base + first + second),
    }


class _Chain:
    """Forward differentiation over named intermediate results.

    With s = g(a, b, …) of earlier names:  ∂s/∂y_i = Σ_a g_a ∂a/∂y_i  and
    ∂²s/∂y_i∂y_j = Σ_ab g_ab ∂a/∂y_i ∂b/∂y_j + Σ_a g_a ∂²a/∂y_i∂y_j.
    """

    def __init__(self, arguments: list[sp.Symbol], variables: list[sp.Symbol]) -> None:
        import sympy as sp

        self.builder = ProgramBuilder(arguments)
        n = len(variables)
        self.pairs = [(i, j) for i in range(n) for j in range(i + 1)]
        self._first = {y: [sp.Integer(int(i == k)) for i in range(n)] for k, y in enumerate(variables)}
        self._second: dict[sp.Symbol, list[sp.Expr]] = {
            y: [sp.Integer(0)] * len(self.pairs) for y in variables
        }

    def let(self, name: str, expression: sp.Expr) -> sp.Expr:
        """Name an intermediate result and keep its derivatives."""
        symbol = self.builder.let(name, expression)
        if symbol.is_Symbol and symbol not in self._first:
            self._first[symbol] = [
                self.builder.let(f"{name}_d{i}", d) for i, d in enumerate(self.first(expression))
            ]
            self._second[symbol] = [
                self.builder.let(f"{name}_dd{i}", d) for i, d in enumerate(self.second(expression))
            ]
        return symbol

    def _moving(self, expression: sp.Expr) -> list[sp.Symbol]:
        return sorted((s for s in expression.free_symbols if s in self._first), key=str)

    def first(self, expression: sp.Expr) -> list[sp.Expr]:
        """∂expression/∂y_i for every variable."""
        import sympy as sp

        inner = self._moving(expression)
        outer = [sp.diff(expression, a) for a in inner]
        count = len(next(iter(self._first.values()), []))
        return [
            sp.Add(*(g * self._first[a][i] for g, a in zip(outer, inner, strict=True))) for i in range(count)
        ]

    def second(self, expression: sp.Expr) -> list[sp.Expr]:
        """∂²expression/∂y_i∂y_j for every pair i ≥ j."""
        import sympy as sp

        inner = self._moving(expression)
        result = []
        slopes = {a: sp.diff(expression, a) for a in inner}
        bends = {(a, b): sp.diff(slopes[a], b) for a in inner for b in inner}
        for place, (i, j) in enumerate(self.pairs):
            bent = [g * self._first[a][i] * self._first[b][j] for (a, b), g in bends.items()]
            carried = [slopes[a] * self._second[a][place] for a in inner]
            result.append(sp.Add(*bent, *carried))
        return result
