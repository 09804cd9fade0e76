"""From SymPy expressions to code: straight-line programs, run on arrays or on any other algebra.

A :class:`Program` is a list of assignments ``name = expression`` in terms of its inputs and of earlier
names. It is derived once by SymPy (common sub-expressions shared) and kept on disk as plain text, so
that everyday runs do not import SymPy at all. The same text runs on NumPy arrays for the condensed
lowering and on Pyomo expressions for the explicit one: there is no second copy of a formula.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from types import CodeType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import sympy as sp

FUNCTIONS = ("sin", "cos", "tan", "sqrt", "atan", "atan2", "exp", "log")
_NUMPY = {"atan": np.arctan, "atan2": np.arctan2}
_FORMAT = 2


@dataclass(frozen=True)
class Program:
    """A straight-line program.

    Attributes
    ----------
    inputs : tuple of str
        Names the caller gives.
    steps : tuple of (str, str)
        Assignments in order: name and expression.
    outputs : tuple of str
        Names or constants of the results, in order.
    """

    inputs: tuple[str, ...]
    steps: tuple[tuple[str, str], ...]
    outputs: tuple[str, ...]

    @cached_property
    def numpy_function(self) -> Callable[..., None]:
        """The program as a function ``f(a, out)`` on arrays, compiled once.

        Input i is read from ``a[i]`` and result i is written to ``out[i]``; both index the leading
        axis, so rows may be arrays of any one shape. Constants are written too.
        """
        lines = ["def program(_in, _out):"]
        used = {token for _, text in self.steps for token in _names(text)} | set(self.outputs)
        lines += [f" {name}=_in[{i}]" for i, name in enumerate(self.inputs) if name in used]
        lines += [f" {name}={text}" for name, text in self.steps]
        lines += [f" _out[{i}]={name}" for i, name in enumerate(self.outputs)]
        namespace: dict[str, Any] = {f: _NUMPY.get(f, getattr(np, f, None)) for f in FUNCTIONS}
        exec(compile("\n".join(lines) + "\n", "<acino_fte program>", "exec"), namespace)
        return namespace["program"]

    @cached_property
    def compiled_steps(self) -> list[tuple[str, CodeType]]:
        """The assignments as code objects, for :meth:`run`."""
        return [(name, compile(text, f"<{name}>", "eval")) for name, text in self.steps]

    def run(
        self,
        values: Mapping[str, Any],
        functions: Mapping[str, Callable],
        wrap: Callable[[str, Any], Any] = lambda _, value: value,
    ) -> list[Any]:
        """Run on any algebra that has operators and the given functions; ``wrap`` sees each step."""
        space: dict[str, Any] = {**functions, **values}
        for name, code in self.compiled_steps:
            space[name] = wrap(name, eval(code, {"__builtins__": {}}, space))
        return [space[o] if o in space else float(o) for o in self.outputs]


def _names(text: str) -> set[str]:
    return {token for token in "".join(c if c.isalnum() or c == "_" else " " for c in text).split()}


class ProgramBuilder:
    """Collects assignments while a derivation goes along.

    ``let`` names an expression and gives back its symbol, so that what follows is derived in terms of
    the symbol (the chain rule) instead of the expanded expression.
    """

    def __init__(self, inputs: Iterable[sp.Symbol]) -> None:
        self.inputs = [str(s) for s in inputs]
        self._steps: list[tuple[sp.Symbol, sp.Expr]] = []
        self._known: dict[sp.Expr, sp.Expr] = {}

    def let(self, name: str, expression: sp.Expr) -> sp.Expr:
        """Name an expression; numbers, plain symbols and known expressions are passed through."""
        import sympy as sp

        expression = sp.sympify(expression)
        if expression.is_Atom or (-expression).is_Atom:
            return expression
        if expression in self._known:
            return self._known[expression]
        symbol = sp.Symbol(name, real=True)
        self._steps.append((symbol, expression))
        self._known[expression] = symbol
        return symbol

    def program(self, outputs: Sequence[sp.Expr], *, share: bool = True) -> Program:
        """Finish: share common sub-expressions, drop what no output needs, print as Python."""
        import sympy as sp

        printer = _printer()
        steps, final = list(self._steps), list(outputs)
        if share:
            symbols, expressions = [s for s, _ in steps], [e for _, e in steps]
            shared, reduced = sp.cse(expressions + final, symbols=sp.numbered_symbols("t_"), order="none")
            named = list(zip(symbols, reduced[: len(symbols)], strict=True))
            steps, final = _in_order(shared + named), reduced[len(symbols) :]
        text: list[tuple[str, str]] = []
        results = []
        for i, output in enumerate(final):
            if output.is_Number:
                results.append(repr(float(output)))
            elif output.is_Symbol:
                results.append(str(output))
            else:
                results.append(f"o_{i}")
                steps.append((sp.Symbol(f"o_{i}"), output))
        needed = set(results)
        for symbol, expression in reversed(steps):
            if str(symbol) in needed:
                needed |= {str(s) for s in expression.free_symbols}
                text.append((str(symbol), printer.doprint(expression)))
        return Program(tuple(self.inputs), tuple(reversed(text)), tuple(results))


def _in_order(steps: list[tuple[sp.Symbol, sp.Expr]]) -> list[tuple[sp.Symbol, sp.Expr]]:
    """Sort assignments so that each comes after what it needs."""
    define = dict(steps)
    placed: set[sp.Symbol] = set()
    result: list[tuple[sp.Symbol, sp.Expr]] = []
    for root in define:
        stack = [root]
        while stack:
            symbol = stack[-1]
            waiting = [s for s in define[symbol].free_symbols if s in define and s not in placed]
            if symbol not in placed and waiting:
                stack += sorted(waiting, key=str)
                continue
            stack.pop()
            if symbol not in placed:
                placed.add(symbol)
                result.append((symbol, define[symbol]))
    return result


def _printer() -> Any:
    from sympy.printing.pycode import PythonCodePrinter

    class Printer(PythonCodePrinter):
        """Bare function names and powers by multiplication."""

        def _print_Pow(self, expr: sp.Pow, rational: bool = False) -> str:
            base = self.parenthesize(expr.base, 80)
            if expr.exp.is_Integer and 2 <= int(expr.exp) <= 4:
                return "(" + "*".join([base] * int(expr.exp)) + ")"
            if expr.exp == -1:
                return f"(1.0/{base})"
            if expr.exp.is_Integer and -4 <= int(expr.exp) <= -2:
                return "(1.0/(" + "*".join([base] * -int(expr.exp)) + "))"
            if 2 * expr.exp == 1:
                return f"sqrt({self._print(expr.base)})"
            if 2 * expr.exp == -1:
                return f"(1.0/sqrt({self._print(expr.base)}))"
            return f"{base}**({self._print(expr.exp)})"

        def _print_Rational(self, expr: sp.Rational) -> str:
            return repr(float(expr))

        def _print_Integer(self, expr: sp.Integer) -> str:
            return f"{int(expr)}.0" if int(expr) >= 0 else f"({int(expr)}.0)"

        def _print_Float(self, expr: sp.Float) -> str:
            return repr(float(expr)) if expr >= 0 else f"({float(expr)!r})"

    return Printer({"fully_qualified_modules": False, "standard": "python3"})


def cache_folder() -> Path:
    """Where derived programs are kept: ``$ACINO_FTE_CACHE``, else the user's cache folder."""
    if folder := os.environ.get("ACINO_FTE_CACHE"):
        return Path(folder)
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path.home() / ".cache") / "acino_fte"


def cached_programs(
    name: str, sources: Iterable[Any], derive: Callable[[], dict[str, Program]]
) -> dict[str, Program]:
    """Programs from the cache, or derived and put there.

    Parameters
    ----------
    name : str
        Readable part of the file name.
    sources : iterable
        All that the derivation depends on: paths are hashed by content, the rest by ``repr``.
    derive : callable
        Makes the programs (imports SymPy).
    """
    digest = sha256(f"format {_FORMAT}".encode())
    for source in (Path(__file__), *sources):
        digest.update(source.read_bytes() if isinstance(source, Path) else repr(source).encode())
    path = cache_folder() / f"{name}-{digest.hexdigest()[:24]}.json"
    programs = _read(path)
    if not programs:
        programs = derive()
        _write(path, programs)
    return programs


def _read(path: Path) -> dict[str, Program] | None:
    try:
        data = json.loads(path.read_text())
        return {
            key: Program(
                tuple(p["inputs"]), tuple((str(n), str(t)) for n, t in p["steps"]), tuple(p["outputs"])
            )
            for key, p in data.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None  # absent, or cut off: derive again


def _write(path: Path, programs: dict[str, Program]) -> None:
    """Write whole or not at all; a cache that cannot be written only costs time."""
    data = {k: {"inputs": p.inputs, "steps": p.steps, "outputs": p.outputs} for k, p in programs.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False) as file:
            json.dump(data, file)
        Path(file.name).replace(path)
    except OSError:
        return
