"""The small searches against SciPy's."""

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar, rosen

from acino_fte.data_tools.small_search import bounded_minimum, descend


@pytest.mark.parametrize(
    ("value", "low", "high"),
    [
        (lambda x: (x - 1.3) ** 2, -5.0, 5.0),
        (lambda x: np.exp(x) - 3.0 * x, -12.0, 28.0),
        (lambda x: abs(x - 0.2), -1.0, 4.0),
        (lambda x: x, -2.0, 3.0),  # the least at a bound
        (lambda x: -np.exp(-((x + 7.0) ** 2) / 30.0), -12.0, 45.0),
    ],
)
def test_one_number(value, low, high):
    found = bounded_minimum(value, low, high, 1e-4)
    best = minimize_scalar(value, bounds=(low, high), method="bounded", options={"xatol": 1e-6}).x
    assert found == pytest.approx(best, abs=5e-4)


def test_one_number_takes_few_evaluations():
    calls = []
    bounded_minimum(lambda x: calls.append(x) or np.exp(x) - 3.0 * x, -12.0, 28.0, 0.01)
    assert len(calls) < 30


def test_three_numbers():
    matrix = np.array([[2.0, 0.6, 0.1], [0.6, 1.0, -0.3], [0.1, -0.3, 0.7]])
    centre = np.array([0.4, -1.2, 2.0])

    def bowl(x):
        return 0.5 * (x - centre) @ matrix @ (x - centre) + 0.05 * ((x - centre) ** 4).sum()

    np.testing.assert_allclose(descend(bowl, np.zeros(3), flat=1e-6, step=1e-7), centre, atol=1e-5)
    start = np.array([-0.5, 0.8])
    found = descend(rosen, start, flat=1e-5, step=1e-8, most=200)
    np.testing.assert_allclose(found, minimize(rosen, start).x, atol=1e-4)


def test_a_wall_is_not_crossed():
    def walled(x):
        return np.inf if x[0] < 0.5 else float(((x - 0.7) ** 2).sum())

    np.testing.assert_allclose(descend(walled, np.array([3.0, 3.0]), flat=1e-6), 0.7, atol=1e-3)
