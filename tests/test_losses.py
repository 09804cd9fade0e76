"""Losses: continuous, smooth, zero at zero; their derivatives; the published constants."""

import casadi
import numpy as np
import pyomo.environ as pyo
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyomo.core.expr import Expr_if

from acino_fte.errors import InputError
from acino_fte.losses import DEFAULTS, Loss

NAMES = sorted(DEFAULTS)
residual = st.floats(-60, 60)


@st.composite
def losses(draw):
    """Any loss with any admissible parameters."""
    name = draw(st.sampled_from(NAMES))
    steps = [draw(st.floats(0.3, 12)) for _ in DEFAULTS[name]]
    return Loss(name, dict(zip(DEFAULTS[name], np.cumsum(steps).tolist(), strict=True)))


def value(loss, e):
    return float(loss.value(np.array([e]))[0])


def derivatives(loss, e):
    return [float(v[0]) for v in loss.derivatives(np.array([e]))]


def kinks(loss):
    """Where the pieces meet."""
    return list(loss.parameters.values()) if loss.name in ("huber", "redescending") else []


@given(losses())
def test_zero_at_zero_with_zero_slope(loss):
    rho, psi, bend, weight = derivatives(loss, 0.0)
    assert (rho, psi) == (0.0, 0.0)
    assert bend == pytest.approx(1.0)
    assert weight == pytest.approx(1.0)


@given(losses())
def test_weight_tends_to_one_at_zero(loss):
    e = 1e-4
    assert derivatives(loss, e)[3] == pytest.approx(1.0, abs=1e-6)
    assert value(loss, e) == pytest.approx(0.5 * e**2, rel=1e-6)


@given(losses())
def test_value_and_slope_do_not_jump_where_pieces_meet(loss):
    for end in kinks(loss):
        below, above = np.nextafter(end, 0), np.nextafter(end, np.inf)
        left, right = derivatives(loss, below), derivatives(loss, above)
        assert right[0] - left[0] == pytest.approx(0, abs=1e-10)
        assert right[1] - left[1] == pytest.approx(0, abs=1e-10)
        assert right[3] - left[3] == pytest.approx(0, abs=1e-10)


@given(losses(), residual, residual)
def test_value_is_even_and_grows_with_the_size(loss, a, b):
    small, large = sorted((abs(a), abs(b)))
    assert value(loss, -small) == value(loss, small)
    assert 0 <= value(loss, small) <= value(loss, large) * (1 + 1e-12)
    assert value(loss, large) <= 0.5 * large**2 * (1 + 1e-12)  # never above the squared loss


@given(losses(), residual)
def test_slope_equals_central_differences(loss, e):
    h = 1e-5
    numeric = (value(loss, e + h) - value(loss, e - h)) / (2 * h)
    assert derivatives(loss, e)[1] == pytest.approx(numeric, abs=3e-5)


@given(losses(), residual)
def test_curvature_equals_central_differences_away_from_the_kinks(loss, e):
    h = 1e-5
    if any(abs(abs(e) - end) < 3 * h for end in kinks(loss)):
        return
    numeric = (derivatives(loss, e + h)[1] - derivatives(loss, e - h)[1]) / (2 * h)
    assert derivatives(loss, e)[2] == pytest.approx(numeric, abs=1e-5)


@given(losses(), residual)
def test_weight_is_slope_over_residual(loss, e):
    _, psi, _, weight = derivatives(loss, e)
    assert weight * e == pytest.approx(psi, abs=1e-12)
    assert 0 <= weight <= 1 + 1e-12


@given(losses())
def test_at_infinity(loss):
    """A point behind a camera: the bound of the loss if it has one, and no pull."""
    assert np.isfinite(value(loss, np.inf)) == loss.bounded
    rho, *rest = derivatives(loss, -np.inf)
    assert rho == value(loss, np.inf)
    assert rest == [0.0, 0.0, 0.0]
    if loss.bounded:
        assert rho == pytest.approx(value(loss, 1e7), rel=1e-9)


@given(losses(), st.lists(residual, min_size=1, max_size=8))
def test_arrays_are_evaluated_entry_by_entry(loss, entries):
    e = np.array(entries)
    together = loss.derivatives(e.reshape(1, -1, 1))
    for one, all_ in zip(zip(*(derivatives(loss, x) for x in entries), strict=True), together, strict=True):
        assert all_.shape == (1, len(e), 1)
        assert np.array_equal(all_.ravel(), one)
    assert np.allclose(loss.value(e), together[0].ravel(), rtol=1e-12, atol=0)


@given(losses(), st.floats(0, 60))
def test_pyomo_expression_has_the_same_value(loss, e):
    variable = pyo.Var(initialize=e)
    variable.construct()
    expression = loss.expression(variable, Expr_if, {"log": pyo.log})
    assert pyo.value(expression) == pytest.approx(value(loss, e), rel=1e-12, abs=1e-15)


@given(losses(), st.floats(0, 60))
def test_casadi_expression_has_the_same_value(loss, e):
    symbol = casadi.SX.sym("e")
    function = casadi.Function(
        "rho", [symbol], [loss.expression(symbol, casadi.if_else, {"log": casadi.log})]
    )
    assert float(function(e)) == pytest.approx(value(loss, e), rel=1e-12, abs=1e-15)


def test_redescending_equals_the_thesis():
    """With (a, b, c) = (3, 10, 20): ab − a²/2 at b plus a(c − b)/2 makes 40.5 from c on."""
    loss = Loss()
    assert (loss.name, loss.parameters) == ("redescending", {"a": 3.0, "b": 10.0, "c": 20.0})
    table = {0: 0, 1: 0.5, 3: 4.5, 4: 7.5, 10: 25.5, 15: 25.5 + 15 * 0.75, 20: 40.5, 21: 40.5, 1e6: 40.5}
    for e, rho in table.items():
        assert value(loss, e) == pytest.approx(rho, rel=1e-14)
    assert [derivatives(loss, e)[1] for e in (1, 3, 7, 10, 15, 20, 30)] == pytest.approx(
        [1, 3, 3, 3, 1.5, 0, 0]
    )
    assert derivatives(loss, -7.0)[1] == pytest.approx(-3)


def test_other_losses_equal_their_formulas():
    e = np.linspace(0, 30, 61)
    assert np.allclose(Loss("squared").value(e), e**2 / 2)
    assert np.allclose(Loss("cauchy", {"c": 2.0}).value(e), 2 * np.log1p(e**2 / 4))
    assert np.allclose(Loss("geman_mcclure", {"c": 5.0}).value(e), e**2 / 2 / (1 + e**2 / 25))
    huber = np.where(e <= 1.5, e**2 / 2, 1.5 * e - 1.125)
    assert np.allclose(Loss("huber", {"a": 1.5}).value(e), huber)
    assert value(Loss("geman_mcclure"), np.inf) == pytest.approx(12.5)


def test_an_unknown_loss():
    with pytest.raises(InputError, match="There is no loss 'hubber'; did you mean 'huber'") as error:
        Loss("hubber")
    assert "cauchy" in str(error.value)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("huber", {"b": 1.0}),
        ("huber", {"a": 0.0}),
        ("huber", {"a": -1.0}),
        ("huber", {"a": float("nan")}),
        ("cauchy", {"c": float("inf")}),
        ("squared", {"a": 1.0}),
        ("redescending", {"a": 12.0}),
        ("redescending", {"b": 20.0}),
        ("redescending", {"c": 5.0}),
    ],
)
def test_wrong_parameters(name, parameters):
    with pytest.raises(InputError, match=f"parameters of the loss '{name}' are wrong") as error:
        Loss(name, parameters)
    assert str(parameters) in str(error.value)
    assert "positive and rising" in str(error.value)
