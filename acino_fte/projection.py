"""The camera models as SymPy expressions, the single source of every projection in the toolkit.

``pinhole`` is OpenCV's model with 0, 4, 5, 8 or 12 coefficients (k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4) and
``fisheye`` its equidistant one (k1 k2 k3 k4). With ``a = X/Z, b = Y/Z, r² = a² + b²`` in the camera's frame
(x right, y down, z forward):

    pinhole:  s = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
              a' = a s + 2 p1 a b + p2 (r² + 2a²) + s1 r² + s2 r⁴
              b' = b s + p1 (r² + 2b²) + 2 p2 a b + s3 r² + s4 r⁴
    fisheye:  θ = atan r,  θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸),  (a', b') = (a, b) θ_d / r
    both:     u = fx a' + cx,  v = fy b' + cy

(OpenCV documentation, modules calib3d and calib3d_fisheye; Kannala and Brandt 2006, eq. 6.)
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from acino_fte.codegen import Program, ProgramBuilder, cached_programs

if TYPE_CHECKING:
    import sympy as sp

PINHOLE_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
FISHEYE_COEFFICIENTS = ("k1", "k2", "k3", "k4")
COEFFICIENTS = {"pinhole": PINHOLE_COEFFICIENTS, "fisheye": FISHEYE_COEFFICIENTS}
INTRINSICS = ("fx", "fy", "cx", "cy")
_TINY = 1e-18  # added to r² so that θ_d/r has its limit, one, on the optical axis


def parameter_names(model: str) -> tuple[str, ...]:
    """Names of the parameters of a camera model, in the order every program takes them."""
    return (*INTRINSICS, *COEFFICIENTS[model])


def parameter_symbols(model: str) -> tuple[sp.Symbol, ...]:
    """The same as SymPy symbols."""
    import sympy as sp

    return tuple(sp.Symbol(name, real=True) for name in parameter_names(model))


def distort(model: str, a: sp.Expr, b: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """Distorted normalised coordinates (a', b') of (a, b)."""
    import sympy as sp

    p = {name: symbol for name, symbol in zip(parameter_names(model), parameter_symbols(model), strict=True)}
    if model == "fisheye":
        r = sp.sqrt(a**2 + b**2 + sp.Float(_TINY))
        theta = sp.Symbol("theta", real=True)
        t2 = theta**2
        bent = theta * (1 + t2 * (p["k1"] + t2 * (p["k2"] + t2 * (p["k3"] + t2 * p["k4"]))))
        scale = bent.subs(theta, sp.atan(r)) / r
        return a * scale, b * scale
    r2 = a**2 + b**2
    up = 1 + r2 * (p["k1"] + r2 * (p["k2"] + r2 * p["k3"]))
    down = 1 + r2 * (p["k4"] + r2 * (p["k5"] + r2 * p["k6"]))
    u = a * up / down + 2 * p["p1"] * a * b + p["p2"] * (r2 + 2 * a**2) + r2 * (p["s1"] + r2 * p["s2"])
    v = b * up / down + p["p1"] * (r2 + 2 * b**2) + 2 * p["p2"] * a * b + r2 * (p["s3"] + r2 * p["s4"])
    return u, v


def project(model: str, point: tuple[sp.Expr, sp.Expr, sp.Expr]) -> tuple[sp.Expr, sp.Expr]:
    """Pixel (u, v) of a point in the camera's frame."""
    fx, fy, cx, cy = parameter_symbols(model)[:4]
    x, y, z = point
    a, b = distort(model, x / z, y / z)
    return fx * a + cx, fy * b + cy


def programs(model: str) -> dict[str, Program]:
    """Programs of a camera model, from the cache when it has them.

    ``project``: (X, Y, Z, parameters) → u, v.  ``jacobian``: the same, then ∂u/∂X, ∂u/∂Y, ∂u/∂Z, ∂v/∂X, ….
    ``distort``: (a, b, parameters) → a', b', ∂a'/∂a, ∂a'/∂b, ∂b'/∂a, ∂b'/∂b.
    """
    return cached_programs(f"camera-{model}", (Path(__file__), model), lambda: _derive(model))


def _derive(model: str) -> dict[str, Program]:
    import sympy as sp

    point = sp.symbols("X Y Z", real=True)
    uv = project(model, point)
    first = [sp.diff(e, s) for e in uv for s in point]
    ab = sp.symbols("a b", real=True)
    bent = distort(model, *ab)
    slope = [sp.diff(e, s) for e in bent for s in ab]
    parameters = parameter_symbols(model)
    return {
        "project": ProgramBuilder([*point, *parameters]).program(list(uv)),
        "jacobian": ProgramBuilder([*point, *parameters]).program([*uv, *first]),
        "distort": ProgramBuilder([*ab, *parameters]).program([*bent, *slope]),
    }
