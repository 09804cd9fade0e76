"""Losses of a normalised residual e = r/σ: squared, and robust ones that bound the pull of an outlier.

Each loss is declared piecewise as SymPy expressions of |e| and its parameters; value ρ, slope ψ = dρ/de,
curvature dψ/de and IRLS weight ψ/e are derived. All behave like e²/2 at zero, so the sum of losses is a
negative log-likelihood for inliers with standard deviation σ.

==============  ==========================================================================================
squared         e²/2
huber           e²/2 to a, then a·e − a²/2                                          (Huber 1964)
cauchy          c²/2 · log(1 + e²/c²)
geman_mcclure   e²/2 / (1 + e²/c²)                                                  (Geman, McClure 1987)
redescending    e²/2 to a; a·e − a²/2 to b; ab − a²/2 + a(c−b)/2·(1 − ((c−e)/(c−b))²) to c; then constant
                (Hampel 1974; the exact C¹ form, not a blend of its pieces)
==============  ==========================================================================================
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.codegen import Program, ProgramBuilder, cached_programs
from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    import sympy as sp

DEFAULTS: dict[str, dict[str, float]] = {
    "squared": {},
    "huber": {"a": 3.0},
    "cauchy": {"c": 3.0},
    "geman_mcclure": {"c": 5.0},
    "redescending": {"a": 3.0, "b": 10.0, "c": 20.0},
}


def _pieces(name: str, e: sp.Expr, p: dict[str, sp.Symbol]) -> list[tuple[str | None, sp.Expr]]:
    """Pieces of a loss: (parameter that is its upper end, or None for no end; expression)."""
    import sympy as sp

    if name == "huber":
        return [("a", e**2 / 2), (None, p["a"] * e - p["a"] ** 2 / 2)]
    if name == "cauchy":
        return [(None, p["c"] ** 2 / 2 * sp.log(1 + e**2 / p["c"] ** 2))]
    if name == "geman_mcclure":
        return [(None, e**2 / 2 / (1 + e**2 / p["c"] ** 2))]
    if name == "redescending":
        a, b, c = p["a"], p["b"], p["c"]
        top = a * b - a**2 / 2
        bend = a * (c - b) / 2
        return [
            ("a", e**2 / 2),
            ("b", a * e - a**2 / 2),
            ("c", top + bend * (1 - ((c - e) / (c - b)) ** 2)),
            (None, top + bend),
        ]
    return [(None, e**2 / 2)]


def _derive(name: str) -> dict[str, Program]:
    import sympy as sp

    e = sp.Symbol("e", nonnegative=True)
    parameters = {k: sp.Symbol(k, positive=True) for k in DEFAULTS[name]}
    programs = {}
    for i, (end, rho) in enumerate(_pieces(name, e, parameters)):
        psi = sp.diff(rho, e)
        outputs = [rho, psi, sp.diff(psi, e), sp.simplify(psi / e)]
        for kind, chosen in (("value", outputs[:1]), ("all", outputs)):
            builder = ProgramBuilder([e, *parameters.values()])
            programs[f"{i}:{end or ''}:{kind}"] = builder.program(chosen)
    return programs


@cache
def _programs(name: str) -> dict[str, list[tuple[str, Program]]]:
    """Per kind (``value`` or ``all``): the pieces in order, each with the parameter that ends it."""
    found = cached_programs(f"loss-{name}", (Path(__file__), name), lambda: _derive(name))
    result: dict[str, list[tuple[str, Program]]] = {"value": [], "all": []}
    for key, program in sorted(found.items()):
        _, end, kind = key.split(":")
        result[kind].append((end, program))
    return result


@dataclass(frozen=True)
class Loss:
    """A loss with its parameters (in units of σ).

    Parameters
    ----------
    name : str
        One of :data:`DEFAULTS`.
    parameters : dict, optional
        Overrides of the default parameters.
    """

    name: str = "redescending"
    parameters: dict[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if self.name not in DEFAULTS:
            raise InputError(
                f"There is no loss '{self.name}'{did_you_mean(self.name, DEFAULTS)}",
                expected=f"one of {', '.join(DEFAULTS)}",
            )
        unknown = set(self.parameters) - set(DEFAULTS[self.name])
        values = {**DEFAULTS[self.name], **self.parameters}
        ordered = list(values.values())
        if unknown or not all(0 < v < np.inf for v in ordered) or ordered != sorted(set(ordered)):
            raise InputError(
                f"The parameters of the loss '{self.name}' are wrong.",
                expected=f"positive and rising: {', '.join(DEFAULTS[self.name]) or 'none'}",
                found=str(self.parameters),
            )
        object.__setattr__(self, "parameters", values)

    @property
    def bounded(self) -> bool:
        """Whether the loss has a largest value."""
        return self.name in ("redescending", "geman_mcclure")

    @cached_property
    def _value_pieces(self) -> list[tuple[float, Callable[..., None]]]:
        return self._compile("value")

    @cached_property
    def _all_pieces(self) -> list[tuple[float, Callable[..., None]]]:
        return self._compile("all")

    def _compile(self, kind: str) -> list[tuple[float, Callable[..., None]]]:
        return [
            (self.parameters[end] if end else np.inf, program.numpy_function)
            for end, program in _programs(self.name)[kind]
        ]

    def _evaluate(
        self, pieces: list[tuple[float, Callable[..., None]]], e: np.ndarray, rows: int
    ) -> np.ndarray:
        e = np.abs(np.asarray(e, dtype=float))
        arguments = list(self.parameters.values())
        out = np.empty((rows, *e.shape))
        pieces[0][1]([e, *arguments], out)
        for (start, _), (_, function) in zip(pieces[:-1], pieces[1:], strict=True):
            beyond = e > start  # few points lie beyond the first piece: evaluate only those
            if beyond.any():
                part = np.empty((rows, int(beyond.sum())))
                function([e[beyond], *arguments], part)
                out[:, beyond] = part
        return out

    def value(self, e: np.ndarray) -> np.ndarray:
        """ρ(e), any shape; infinite residuals give the bound of the loss."""
        with np.errstate(invalid="ignore", over="ignore"):
            rho = self._evaluate(self._value_pieces, e, 1)[0]
        far = np.isinf(e)
        if far.any():
            rho[far] = self.value(np.array([1e9]))[0] if self.bounded else np.inf
        return rho

    def derivatives(self, e: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """ρ, ψ (with the sign of e), dψ/de and the weight ψ/e, each of the shape of e.

        Infinite residuals have zero slope, curvature and weight.
        """
        e = np.asarray(e, dtype=float)
        far = np.isinf(e)
        with np.errstate(invalid="ignore", over="ignore"):
            rho, psi, bend, weight = self._evaluate(self._all_pieces, e, 4)
        psi = np.copysign(psi, e)
        if far.any():
            rho[far] = self.value(e[far])
            psi[far] = bend[far] = weight[far] = 0.0
        return rho, psi, bend, weight

    def expression(
        self, e: Any, if_else: Callable[[Any, Any, Any], Any], functions: dict[str, Callable]
    ) -> Any:
        """ρ(e) in another algebra; ``if_else(condition, then, otherwise)`` joins the pieces, e ≥ 0."""
        pieces = _programs(self.name)["value"]
        values = [p.run({"e": e, **self.parameters}, functions)[0] for _, p in pieces]
        result = values[-1]
        for (end, _), value in reversed(list(zip(pieces[:-1], values[:-1], strict=True))):
            result = if_else(e <= self.parameters[end], value, result)
        return result
