"""The arrow factorisation against dense linear algebra."""

import numpy as np
import pytest

from acino_fte.arrow import ArrowFactor, NotPositiveDefinite

SHAPES = [  # N, Q, L, P
    (7, 3, 2, 4),
    (6, 3, 3, 2),
    (8, 2, 3, 5),
    (5, 4, 1, 0),
    (4, 3, 0, 2),
    (3, 2, 0, 0),
    (1, 3, 3, 2),
    (2, 3, 3, 1),
    (3, 2, 5, 2),
    (9, 1, 2, 1),
]


def random_arrow(shape, seed=0):
    """Blocks, arrow and corner of a random positive definite H, and H itself."""
    n, size, reach, p = shape
    rng = np.random.default_rng(seed)
    dense = np.zeros((n * size + p, n * size + p))
    for frame in range(n):  # what least squares make: rows that touch frames n − L … n and the parameters
        columns = np.r_[max(0, frame - reach) * size : (frame + 1) * size, n * size : n * size + p]
        rows = rng.normal(size=(2 * size + p, len(columns)))
        dense[np.ix_(columns, columns)] += rows.T @ rows
    dense += 0.1 * np.eye(len(dense))
    band = dense[: n * size, : n * size].reshape(n, size, n, size)
    blocks = [np.full((n, size, size), np.nan) for _ in range(reach + 1)]  # NaN where nothing is read
    for lag in range(min(reach, n - 1) + 1):
        for frame in range(lag, n):
            blocks[lag][frame] = band[frame, :, frame - lag]
    return blocks, dense[: n * size, n * size :].reshape(n, size, p), dense[n * size :, n * size :], dense


@pytest.mark.parametrize("shape", SHAPES)
def test_inverse_blocks_are_those_of_the_dense_inverse(shape):
    n, size, reach, p = shape
    blocks, arrow, corner, dense = random_arrow(shape)
    found = ArrowFactor(blocks, arrow, corner).selected_inverse()
    inverse = np.linalg.inv(dense)
    band = inverse[: n * size, : n * size].reshape(n, size, n, size)
    assert len(found.blocks) == reach + 1
    for lag, block in enumerate(found.blocks):
        wanted = [band[f, :, f - lag] if f >= lag else np.zeros((size, size)) for f in range(n)]
        np.testing.assert_allclose(block, wanted, atol=1e-10)
    np.testing.assert_allclose(found.cross, inverse[: n * size, n * size :].reshape(n, size, p), atol=1e-10)
    np.testing.assert_allclose(found.corner, inverse[n * size :, n * size :], atol=1e-10)


@pytest.mark.parametrize("shape", SHAPES)
def test_determinant_and_schur_complement(shape):
    n, size, _, _ = shape
    blocks, arrow, corner, dense = random_arrow(shape, seed=1)
    factor = ArrowFactor(blocks, arrow, corner)
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-10)
    a, b = dense[: n * size, : n * size], dense[: n * size, n * size :]
    np.testing.assert_allclose(factor.schur, corner - b.T @ np.linalg.solve(a, b), atol=1e-9)


@pytest.mark.parametrize("columns", [(), (1,), (3,)])
@pytest.mark.parametrize("shape", SHAPES)
def test_solution_is_the_dense_one(shape, columns):
    n, size, _, p = shape
    blocks, arrow, corner, dense = random_arrow(shape, seed=2)
    rng = np.random.default_rng(3)
    state, theta = rng.normal(size=(n, size, *columns)), rng.normal(size=(p, *columns))
    q, parameters = ArrowFactor(blocks, arrow, corner).solve(state, theta)
    wanted = np.linalg.solve(dense, np.concatenate([state.reshape(n * size, *columns), theta]))
    assert q.shape == state.shape and parameters.shape == theta.shape
    np.testing.assert_allclose(q.reshape(n * size, *columns), wanted[: n * size], atol=1e-10)
    np.testing.assert_allclose(parameters, wanted[n * size :], atol=1e-10)


def test_only_lower_triangles_are_read_and_nothing_is_written():
    blocks, arrow, corner, _ = random_arrow((7, 3, 2, 4))
    before = [b.copy() for b in blocks], arrow.copy(), corner.copy()
    whole = ArrowFactor(blocks, arrow, corner).log_determinant
    np.testing.assert_array_equal(blocks, before[0])
    np.testing.assert_array_equal(arrow, before[1])
    np.testing.assert_array_equal(corner, before[2])
    half = ArrowFactor([np.tril(blocks[0]), *blocks[1:]], arrow, np.tril(corner)).log_determinant
    assert half == whole


@pytest.mark.parametrize("fault", ["band", "corner", "nan", "inf"])
def test_no_factor_of_a_matrix_that_is_not_positive_definite(fault):
    blocks, arrow, corner, _ = random_arrow((7, 3, 2, 4))
    message = "not positive definite at frame 5|not finite"
    if fault == "band":
        blocks[0][5] -= 1e3 * np.eye(3)
    elif fault == "corner":
        corner[2, 2] = 0.0
        message = "the parameters"
    else:
        blocks[0][5, 1, 0] = float(fault)
    with pytest.raises(NotPositiveDefinite, match=message):
        ArrowFactor(blocks, arrow, corner)
