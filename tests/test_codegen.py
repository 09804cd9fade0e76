"""Programs: what is printed, shared and dropped; one text for NumPy, Pyomo and CasADi."""

import math

import casadi
import numpy as np
import pyomo.environ as pyo
import pytest
import sympy as sp
from conftest import cameras_about

from acino_fte.codegen import FUNCTIONS, ProgramBuilder
from acino_fte.projection import parameter_names, programs

X, Y = sp.symbols("x y", real=True)
EXPRESSIONS = {
    "powers": (
        X**2 + X**-1 + X**3 * Y**-2 + (X + Y) ** 4 + X**-4,
        lambda x, y: x**2 + 1 / x + x**3 / y**2 + (x + y) ** 4 + x**-4,
    ),
    "roots": (sp.sqrt(X + Y) + 1 / sp.sqrt(X * Y), lambda x, y: math.sqrt(x + y) + 1 / math.sqrt(x * y)),
    "other powers": (X ** sp.Rational(5, 3) + X**7 + X**Y, lambda x, y: x ** (5 / 3) + x**7 + x**y),
    "fractions": (X * sp.Rational(1, 3) - sp.Rational(2, 7), lambda x, y: x / 3 - 2 / 7),
    "signs": (-X - (-Y) - 3 + sp.Float(-0.25) * X, lambda x, y: -x + y - 3 - 0.25 * x),
    "functions": (
        sp.sin(X) * sp.cos(Y) + sp.tan(X) + sp.atan(Y) + sp.exp(-X) + sp.log(Y),
        lambda x, y: math.sin(x) * math.cos(y) + math.tan(x) + math.atan(y) + math.exp(-x) + math.log(y),
    ),
    "division": (X / Y / (1 + X), lambda x, y: x / y / (1 + x)),
    "input": (X, lambda x, y: x),
    "constant": (sp.Rational(3, 2), lambda x, y: 1.5),
    "zero": (sp.Integer(0), lambda x, y: 0.0),
}


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_every_algebra_gives_the_value_of_the_formula(name):
    expression, formula = EXPRESSIONS[name]
    program = ProgramBuilder([X, Y]).program([expression])
    x, y = np.array([0.7, 1.9]), np.array([1.3, 0.4])
    out = np.empty((1, 2))
    program.numpy_function([x, y], out)
    expected = [formula(*point) for point in zip(x, y, strict=True)]
    assert np.allclose(out[0], expected, rtol=1e-13)
    model = pyo.ConcreteModel()
    model.x, model.y = pyo.Var(initialize=x[0]), pyo.Var(initialize=y[0])
    (result,) = program.run(
        {"x": model.x, "y": model.y}, {f: getattr(pyo, f) for f in FUNCTIONS if hasattr(pyo, f)}
    )
    assert pyo.value(result) == pytest.approx(expected[0], rel=1e-13)
    symbols = [casadi.SX.sym("x"), casadi.SX.sym("y")]
    (result,) = program.run(
        dict(zip("xy", symbols, strict=True)),
        {f: getattr(casadi, f) for f in FUNCTIONS if hasattr(casadi, f)},
    )
    function = casadi.Function("f", symbols, [result])
    assert float(function(x[0], y[0])) == pytest.approx(expected[0], rel=1e-13)


def test_common_parts_are_computed_once():
    shared = sp.sin(X + Y)
    program = ProgramBuilder([X, Y]).program([shared**2 + X, shared * 3, shared])
    assert sum("sin" in text for _, text in program.steps) == 1
    loose = ProgramBuilder([X, Y]).program([shared**2 + X, shared * 3], share=False)
    assert sum("sin" in text for _, text in loose.steps) == 2


def test_what_no_output_needs_is_dropped():
    builder = ProgramBuilder([X, Y])
    builder.let("unused", sp.exp(X))
    used = builder.let("used", sp.log(Y))
    program = builder.program([used + 1])
    assert all("exp" not in text for _, text in program.steps)
    assert program.inputs == ("x", "y")


def test_let_names_an_expression_once():
    builder = ProgramBuilder([X, Y])
    first = builder.let("a", X * Y)
    assert builder.let("b", X * Y) is first
    assert builder.let("c", X) is X
    assert builder.let("d", sp.Integer(3)) == 3
    assert builder.let("e", -Y) == -Y


def test_named_steps_come_before_what_needs_them():
    builder = ProgramBuilder([X, Y])
    a = builder.let("a", X + Y)
    b = builder.let("b", sp.sin(a) * a)
    program = builder.program([b + sp.sin(a), X + Y])
    known = set(program.inputs)
    for name, text in program.steps:
        used = {str(s) for s in sp.sympify(text).free_symbols}
        assert used <= known
        known.add(name)
    assert set(program.outputs) <= known


def test_any_shape_of_arrays():
    program = ProgramBuilder([X, Y]).program([X * Y, sp.Integer(2)])
    x = np.arange(24.0).reshape(2, 3, 4)
    out = np.empty((2, 2, 3, 4))
    program.numpy_function([x, 2.0], out)
    assert np.array_equal(out[0], 2 * x)
    assert (out[1] == 2).all()


@pytest.mark.parametrize("index", [0, 1], ids=["pinhole", "fisheye"])
def test_projection_is_the_same_in_pyomo(index):
    """The explicit lowering runs the very program that NumPy runs."""
    camera = cameras_about()[index]
    point = np.array([0.3, -0.2, 0.4])
    model = pyo.ConcreteModel()
    model.p = pyo.Var("XYZ", initialize=dict(zip("XYZ", camera.to_camera(point), strict=True)))
    values = {a: model.p[a] for a in "XYZ"}
    values |= dict(zip(parameter_names(camera.model), camera.parameters.tolist(), strict=True))
    pixel = programs(camera.model)["project"].run(
        values, {f: getattr(pyo, f) for f in FUNCTIONS if hasattr(pyo, f)}
    )
    assert [pyo.value(v) for v in pixel] == pytest.approx(camera.project(point).tolist(), rel=1e-12)
