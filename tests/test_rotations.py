"""Rotation matrices, vectors and quaternions against SciPy, small angles and half turns included."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from acino_fte.data_tools.rotations import (
    cross_matrix,
    rotation_matrix,
    rotation_quaternion,
    rotation_vector,
)

RNG = np.random.default_rng(1)
AXES = RNG.normal(size=(40, 3))
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-6, 1e-3, 0.5, 2.0, 3.1, np.pi - 1e-7])
def test_vectors_and_matrices_are_those_of_scipy(angle):
    vectors = angle * AXES
    matrices = rotation_matrix(vectors)
    np.testing.assert_allclose(matrices, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotation_vector(matrices), vectors, atol=1e-13 + 1e-8 * (angle > 3))


def test_half_turns_keep_their_axis():
    matrices = Rotation.from_rotvec(np.pi * AXES).as_matrix()
    vectors = rotation_vector(matrices)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), np.pi, atol=1e-12)
    np.testing.assert_allclose(np.abs((vectors * AXES).sum(1)), np.pi, atol=1e-7)


def test_quaternions_are_those_of_scipy_with_w_from_zero():
    matrices = Rotation.random(200, random_state=3).as_matrix().reshape(20, 10, 3, 3)
    found = rotation_quaternion(matrices)
    expected = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat().reshape(20, 10, 4)
    assert (found[..., 3] >= 0).all()
    np.testing.assert_allclose(found, expected * np.sign(expected[..., 3:]), atol=1e-12)


def test_a_cross_matrix_makes_the_cross_product():
    a, b = RNG.normal(size=(2, 5, 3))
    np.testing.assert_allclose((cross_matrix(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)
