"""The camera models as SymPy expressions, the single source of every projection in the toolkit.

``pinhole`` is OpenCV's model with 0, 4, 5, 8 or 12 coefficients (k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4) and
``fisheye`` its equidistant one (k1 k2 k3 k4). The others are those of COLMAP that OpenCV does not have. With
``a = X/Z, b = Y/Z, r² = a² + b²`` in the camera's frame (x right, y down, z forward):

    pinhole:  s = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
              a' = a s + 2 p1 a b + p2 (r² + 2a²) + s1 r² + s2 r⁴
              b' = b s + p1 (r² + 2b²) + 2 p2 a b + s3 r² + s4 r⁴
    fisheye:  θ = atan r,  (p, q) = (a, b) θ / r,  (a', b') = (p, q) (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)
    thin_prism_fisheye:  p, q, θ as in fisheye
              a' = p (1 + k1 θ² + … + k4 θ⁸) + 2 p1 p q + p2 (θ² + 2p²) + sx1 θ²
              b' = q (1 + k1 θ² + … + k4 θ⁸) + p1 (θ² + 2q²) + 2 p2 p q + sy1 θ²
    rad_tan_thin_prism_fisheye:  (g, h) = (p, q) (1 + k0 θ² + … + k5 θ¹²),  n² = g² + h²
              a' = g + p0 (n² + 2g²) + 2 p1 g h + s0 n² + s1 n⁴
              b' = h + 2 p0 g h + p1 (n² + 2h²) + s2 n² + s3 n⁴
    fov:      (a', b') = (a, b) atan(2 r tan(ω/2)) / (r ω)
    division: (a, b) = (a', b') / (1 + k r'²), so (a', b') = 2 (X, Y) / (Z + √(Z² − 4 k (X² + Y²)))
    eucm:     (a', b') = (X, Y) / (α √(β (X² + Y²) + Z²) + (1 − α) Z)
    equirectangular:  a' = atan2(X, Z), the azimuth,  b' = atan2(Y, √(X² + Z²)), the elevation downwards
    all:      u = fx a' + cx,  v = fy b' + cy

(OpenCV documentation, modules calib3d and calib3d_fisheye; Kannala and Brandt 2006, eq. 6; Weng et al. 1992;
Project Aria's documentation, Fisheye624; Devernay and Faugeras 2001, eq. 13; Fitzgibbon 2001, section 2;
Khomutenko et al. 2016, eq. 9. Which coefficient goes where was checked against pycolmap number by number.)

The last three see beyond 90° from the axis: ``division`` with k < 0, ``eucm`` with 0 < α < 1, and
``equirectangular`` everywhere. They and ``fov`` have an inverse in closed form, :func:`direction`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from acino_fte.codegen import Program, ProgramBuilder, cached_programs

if TYPE_CHECKING:
    import sympy as sp

PINHOLE_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
FISHEYE_COEFFICIENTS = ("k1", "k2", "k3", "k4")
COEFFICIENTS = {
    "pinhole": PINHOLE_COEFFICIENTS,
    "fisheye": FISHEYE_COEFFICIENTS,
    "thin_prism_fisheye": ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "rad_tan_thin_prism_fisheye": ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
    "fov": ("omega",),
    "division": ("k",),
    "eucm": ("alpha", "beta"),
    "equirectangular": (),
}
INTRINSICS = ("fx", "fy", "cx", "cy")
CLOSED = ("fov", "division", "eucm", "equirectangular")  # models with :func:`direction`; others have `bend`
EQUIDISTANT = ("fisheye", "thin_prism_fisheye", "rad_tan_thin_prism_fisheye")  # they bend (p, q), not (a, b)
SHORT = 5  # coefficients of the usual pinhole lens, k1 k2 p1 p2 k3
_TINY = 1e-18  # added to r² so that θ/r and the like have their limit, one, on the optical axis


def parameter_names(model: str) -> tuple[str, ...]:
    """Names of the parameters of a camera model, in the order every program takes them."""
    return (*INTRINSICS, *COEFFICIENTS[model])


def parameter_symbols(model: str) -> tuple[sp.Symbol, ...]:
    """The same as SymPy symbols."""
    import sympy as sp

    return tuple(sp.Symbol(name, real=True) for name in parameter_names(model))


def _coefficients(model: str) -> dict[str, sp.Symbol]:
    return dict(zip(COEFFICIENTS[model], parameter_symbols(model)[4:], strict=True))


def bend(
    model: str,
    a: sp.Expr,
    b: sp.Expr,
    square: sp.Expr | None = None,
    lens: dict[str, sp.Expr] | None = None,
) -> tuple[sp.Expr, sp.Expr]:
    """Distorted (a', b') of (a, b), or of (p, q) for a model of :data:`EQUIDISTANT`.

    ``square`` is a² + b², or θ²; it may be given where it is known already. ``lens`` has other values for the
    coefficients, such as zeros.
    """
    k = lens or _coefficients(model)
    r2 = a**2 + b**2 if square is None else square
    if model == "pinhole":
        up = 1 + r2 * (k["k1"] + r2 * (k["k2"] + r2 * k["k3"]))
        down = 1 + r2 * (k["k4"] + r2 * (k["k5"] + r2 * k["k6"]))
        u = a * up / down + 2 * k["p1"] * a * b + k["p2"] * (r2 + 2 * a**2) + r2 * (k["s1"] + r2 * k["s2"])
        v = b * up / down + k["p1"] * (r2 + 2 * b**2) + 2 * k["p2"] * a * b + r2 * (k["s3"] + r2 * k["s4"])
        return u, v
    if model == "rad_tan_thin_prism_fisheye":
        scale = _polynomial(r2, [k[f"k{i}"] for i in range(6)])
        g, h = a * scale, b * scale
        n2 = r2 * scale**2
        u = g + k["p0"] * (n2 + 2 * g**2) + 2 * k["p1"] * g * h + n2 * (k["s0"] + n2 * k["s1"])
        v = h + 2 * k["p0"] * g * h + k["p1"] * (n2 + 2 * h**2) + n2 * (k["s2"] + n2 * k["s3"])
        return u, v
    scale = _polynomial(r2, [k[f"k{i}"] for i in range(1, 5)])
    if model == "fisheye":
        return a * scale, b * scale
    u = a * scale + 2 * k["p1"] * a * b + k["p2"] * (r2 + 2 * a**2) + k["sx1"] * r2
    v = b * scale + k["p1"] * (r2 + 2 * b**2) + 2 * k["p2"] * a * b + k["sy1"] * r2
    return u, v


def _polynomial(x: sp.Expr, coefficients: list[sp.Symbol]) -> sp.Expr:
    """1 + c0 x + c1 x² + …, nested."""
    result: sp.Expr | int = 0
    for c in reversed(coefficients):
        result = x * (c + result)
    return 1 + result


def distort(model: str, point: tuple[sp.Expr, sp.Expr, sp.Expr]) -> tuple[sp.Expr, sp.Expr]:
    """Distorted normalised coordinates (a', b') of a point in the camera's frame."""
    import sympy as sp

    x, y, z = point
    k = _coefficients(model)
    if model == "equirectangular":
        return sp.atan2(x, z), sp.atan2(y, sp.sqrt(x**2 + z**2))
    if model == "division":
        scale = 2 / (z + sp.sqrt(z**2 - 4 * k["k"] * (x**2 + y**2)))
        return x * scale, y * scale
    if model == "eucm":
        alpha = k["alpha"]
        depth = alpha * sp.sqrt(k["beta"] * (x**2 + y**2) + z**2) + (1 - alpha) * z
        return x / depth, y / depth
    a, b = x / z, y / z
    if model == "pinhole":
        return bend(model, a, b)
    r = sp.sqrt(a**2 + b**2 + sp.Float(_TINY))
    if model == "fov":
        omega = sp.sqrt(k["omega"] ** 2 + sp.Float(_TINY))
        scale = sp.atan(2 * r * sp.tan(omega / 2)) / (r * omega)
        return a * scale, b * scale
    theta = sp.atan(r)
    return bend(model, a * theta / r, b * theta / r, theta**2)


def direction(model: str, a: sp.Expr, b: sp.Expr) -> tuple[sp.Expr, sp.Expr, sp.Expr]:
    """Direction in the camera's frame, of any length, of distorted (a', b'), for a model of :data:`CLOSED`.

    Where the field of the model ends is the caller's to know.
    """
    import sympy as sp

    k = _coefficients(model)
    if model == "equirectangular":
        return sp.cos(b) * sp.sin(a), sp.sin(b), sp.cos(b) * sp.cos(a)
    if model == "division":
        return a, b, 1 + k["k"] * (a**2 + b**2)
    if model == "eucm":
        alpha, r2 = k["alpha"], k["beta"] * (a**2 + b**2)
        root = sp.sqrt(1 - (2 * alpha - 1) * r2)
        return a, b, (1 - alpha**2 * r2) / (alpha * root + 1 - alpha)
    omega = sp.sqrt(k["omega"] ** 2 + sp.Float(_TINY))
    r = sp.sqrt(a**2 + b**2 + sp.Float(_TINY))
    scale = sp.sin(r * omega) / (2 * r * sp.tan(omega / 2))
    return a * scale, b * scale, sp.cos(r * omega)


def project(model: str, point: tuple[sp.Expr, sp.Expr, sp.Expr]) -> tuple[sp.Expr, sp.Expr]:
    """Pixel (u, v) of a point in the camera's frame."""
    fx, fy, cx, cy = parameter_symbols(model)[:4]
    a, b = distort(model, point)
    return fx * a + cx, fy * b + cy


def programs(model: str) -> dict[str, Program]:
    """Programs of a camera model, from the cache when it has them.

    ``project``: (X, Y, Z, parameters) → u, v.  ``jacobian``: the same, then ∂u/∂X, ∂u/∂Y, ∂u/∂Z, ∂v/∂X, ….
    ``direction``, for models of :data:`CLOSED`: (a', b', parameters) → X, Y, Z of any length.
    ``bend``, for the others: (a, b, parameters) → a', b', ∂a'/∂a, ∂a'/∂b, ∂b'/∂a, ∂b'/∂b, with p, q in the
    place of a, b for those of :data:`EQUIDISTANT`.  ``jacobian_5`` and ``bend_5``, for pinhole: the same with
    half the work, for lenses whose coefficients beyond the first :data:`SHORT` are zero.
    """
    return cached_programs(f"camera-{model}", (Path(__file__), model), lambda: _derive(model))


def _derive(model: str) -> dict[str, Program]:
    import sympy as sp

    point, ab = sp.symbols("X Y Z", real=True), sp.symbols("a b", real=True)
    of_point = [*point, *parameter_symbols(model)]
    of_image = [*ab, *parameter_symbols(model)]
    uv = list(project(model, point))
    result = {"project": ProgramBuilder(of_point).program(uv)}
    if model in CLOSED:
        first = [sp.diff(e, s) for e in uv for s in point]
        result["jacobian"] = ProgramBuilder(of_point).program([*uv, *first])
        result["direction"] = ProgramBuilder(of_image).program(list(direction(model, *ab)))
        return result
    full = _coefficients(model)
    lenses = {"": full}
    if model == "pinhole":
        lenses[f"_{SHORT}"] = {n: k if i < SHORT else sp.S.Zero for i, (n, k) in enumerate(full.items())}
    for ending, lens in lenses.items():
        builder = ProgramBuilder(of_point)
        result[f"jacobian{ending}"] = builder.program(_chained(model, builder, point, lens))
        builder = ProgramBuilder(of_image)
        bent, slope = _bent_with_slopes(builder, ab, partial(bend, model, lens=lens))
        result[f"bend{ending}"] = builder.program([*bent, *slope])
    return result


def _bent_with_slopes(
    builder: ProgramBuilder,
    ab: tuple[sp.Expr, sp.Expr],
    bent_of: Callable[..., tuple[sp.Expr, sp.Expr]],
    square: sp.Expr | None = None,
) -> tuple[tuple[sp.Expr, sp.Expr], list[sp.Expr]]:
    """:func:`bend` and ∂a'/∂a, ∂a'/∂b, ∂b'/∂a, ∂b'/∂b, by the chain rule over a² + b²."""
    import sympy as sp

    square = builder.let("square", ab[0] ** 2 + ab[1] ** 2 if square is None else square)
    bent = bent_of(*ab, square)
    outward = [builder.let(f"outward_{i}", sp.diff(e, square)) for i, e in enumerate(bent)]
    slope = [sp.diff(e, s) + 2 * s * o for e, o in zip(bent, outward, strict=True) for s in ab]
    return bent, slope


def _chained(
    model: str, builder: ProgramBuilder, point: tuple[sp.Symbol, ...], lens: dict[str, sp.Expr]
) -> list[sp.Expr]:
    """Pixel, and its derivatives for X, Y, Z, by the chain rule over (a, b) and (p, q)."""
    import sympy as sp

    fx, fy, cx, cy = parameter_symbols(model)[:4]
    inverse = builder.let("inverse", 1 / point[2])
    a, b = builder.let("a", point[0] * inverse), builder.let("b", point[1] * inverse)
    bent_of = partial(bend, model, lens=lens)
    if model not in EQUIDISTANT:
        bent, slope = _bent_with_slopes(builder, (a, b), bent_of)
        through = sp.Matrix(2, 2, slope)
    else:
        r2 = builder.let("r2", a**2 + b**2 + sp.Float(_TINY))
        theta = builder.let("theta", sp.atan(sp.sqrt(r2)))
        ratio = builder.let("ratio", theta / sp.sqrt(r2))
        p, q = builder.let("p", a * ratio), builder.let("q", b * ratio)
        growth = builder.let("growth", (1 / (1 + r2) - ratio) / r2)  # ∂ratio/∂a = a growth
        bent, slope = _bent_with_slopes(builder, (p, q), bent_of, theta**2)
        cross = builder.let("cross", a * b * growth)
        chart = sp.Matrix([[ratio + a**2 * growth, cross], [cross, ratio + b**2 * growth]])
        through = sp.Matrix(2, 2, slope) * chart
    first = []
    for row, focal in enumerate((fx, fy)):
        dx = builder.let(f"d{row}_x", focal * through[row, 0] * inverse)
        dy = builder.let(f"d{row}_y", focal * through[row, 1] * inverse)
        first += [dx, dy, -(a * dx + b * dy)]
    return [fx * bent[0] + cx, fy * bent[1] + cy, *first]
