"""An individual's proportions in the kinematics: against the deformed species, and finite differences."""

import numpy as np
import pytest
from conftest import random_motion

from acino_fte.kinematics import load_kinematics
from acino_fte.skeleton import deformed

STEP = 1e-6
FAMILIES = [("scale",), ("offsets",), ("scale", "offsets")]


@pytest.fixture(scope="module", params=["lizard", "cheetah"])
def plain(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module", params=FAMILIES, ids="+".join)
def fitted(request, plain):
    """Kinematics with parameters, q (5, Q) and k off zero."""
    kinematics = plain.with_parameters(request.param)
    rng = np.random.default_rng(4)
    scales = rng.normal(0, 0.2, kinematics.n_groups)
    offsets = rng.normal(0, 0.05, kinematics.n_parameters - kinematics.n_groups)
    return kinematics, random_motion(plain.skeleton, 5, 2), np.concatenate([scales, offsets])


def by_name(kinematics, k):
    """Factors of the segment groups and offsets of the markers, as :func:`deformed` takes them."""
    skeleton, g = kinematics.skeleton, kinematics.n_groups
    scales = dict(zip(skeleton.groups, np.exp(k[:g]), strict=False))
    offsets = dict(zip(skeleton.marker_names, k[g:].reshape(-1, 3), strict=False)) if len(k) > g else {}
    return scales, offsets


def difference(function, k, i):
    """∂function/∂k_i, by central differences."""
    step = STEP * np.eye(len(k))[i]
    return (function(k + step) - function(k - step)) / (2 * STEP)


def test_positions_are_those_of_the_deformed_species(fitted):
    kinematics, q, k = fitted
    individual = load_kinematics(deformed(kinematics.skeleton, *by_name(kinematics, k)))
    np.testing.assert_allclose(kinematics.positions(q, k), individual.positions(q), rtol=0, atol=1e-12)


def test_linearise_has_the_jacobian_of_the_deformed_species(fitted):
    kinematics, q, k = fitted
    linear = kinematics.linearise(q, k)
    individual = load_kinematics(deformed(kinematics.skeleton, *by_name(kinematics, k))).linearise(q)
    np.testing.assert_allclose(linear.positions, individual.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(linear.jacobian, individual.jacobian, rtol=0, atol=1e-12)
    np.testing.assert_allclose(linear.axes, individual.axes, rtol=0, atol=1e-12)


def test_parameters_at_zero_are_the_species(fitted, plain):
    kinematics, q, k = fitted
    np.testing.assert_allclose(kinematics.positions(q), plain.positions(q), rtol=0, atol=1e-13)
    assert np.array_equal(kinematics.positions(q), kinematics.positions(q, np.zeros_like(k)))
    np.testing.assert_allclose(
        kinematics.linearise(q).jacobian, plain.linearise(q).jacobian, rtol=0, atol=1e-13
    )


def test_growth_and_rotations_are_the_slopes_of_the_positions(fitted):
    kinematics, q, k = fitted
    linear, g = kinematics.linearise(q, k), kinematics.n_groups
    assert linear.growth.shape == (*linear.positions.shape, g)
    for i in range(g):
        found = difference(lambda at: kinematics.positions(q, at), k, i)
        np.testing.assert_allclose(linear.growth[..., i], found, rtol=0, atol=1e-8)
    if "offsets" not in kinematics.families:
        assert linear.rotations.shape[1] == 0
        return
    for i in range(len(k) - g):
        found = difference(lambda at: kinematics.positions(q, at), k, g + i)
        expected = np.zeros_like(found)
        expected[:, i // 3] = linear.rotations[:, i // 3, :, i % 3]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


def test_rotations_are_rotations_and_do_not_depend_on_proportions(fitted):
    kinematics, q, k = fitted
    turned = kinematics.linearise(q, k).rotations
    np.testing.assert_allclose(
        turned @ turned.swapaxes(-1, -2), np.broadcast_to(np.eye(3), turned.shape), atol=1e-12
    )
    np.testing.assert_allclose(turned, kinematics.linearise(q).rotations, atol=1e-14)
    if turned.shape[1]:
        np.testing.assert_allclose(np.linalg.det(turned), 1.0, atol=1e-12)


def test_second_derivatives_of_states_and_proportions(fitted):
    """∂²p/∂q_j∂λ = ω_j × (∂p/∂λ − ∂c_j/∂λ) and ∂²p/∂q_j∂offset = ω_j × R, for what j moves."""
    kinematics, q, k = fitted
    linear, g = kinematics.linearise(q, k), kinematics.n_groups
    depends = kinematics.depends.astype(float)
    for i in range(len(k)):
        found = difference(lambda at: kinematics.linearise(q, at).jacobian, k, i)  # (N, M, 3, Q)
        if i < g:
            arm = linear.growth[..., i][:, :, None] - linear.point_growth[..., i][:, None]  # (N, M, Q, 3)
        else:
            marker, axis = divmod(i - g, 3)
            arm = np.zeros((*found.shape[:2], found.shape[3], 3))
            arm[:, marker] = linear.rotations[:, marker, None, :, axis]
        expected = np.cross(linear.axes[:, None], arm) * depends[..., None]
        np.testing.assert_allclose(found, expected.swapaxes(-1, -2), rtol=0, atol=1e-8)


def test_second_derivative_of_one_scale_is_the_growth(fitted):
    """Positions are linear in every exp λ: ∂²p/∂λ_g∂λ_h is ∂p/∂λ_g for g = h and zero otherwise."""
    kinematics, q, k = fitted
    linear, g = kinematics.linearise(q, k), kinematics.n_groups
    for i in range(g):
        found = difference(lambda at: kinematics.linearise(q, at).growth, k, i)
        expected = np.zeros_like(found)
        expected[..., i] = linear.growth[..., i]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


def test_which_groups_move_which_marker(fitted):
    kinematics, q, k = fitted
    moved = np.abs(kinematics.linearise(q, k).growth).max(axis=(0, 2)) > 1e-12
    assert kinematics.grows.shape == (kinematics.n_markers, kinematics.n_groups)
    assert np.array_equal(moved, kinematics.grows)


def test_groups_of_the_lizard_by_hand(lizard):
    kinematics = lizard.with_parameters(["scale"])
    skeleton, grows = kinematics.skeleton, kinematics.grows
    assert skeleton.groups == ("trunk", "tail", "l_leg")
    by_marker = {
        m: [skeleton.groups[g] for g in np.flatnonzero(row)]
        for m, row in zip(skeleton.marker_names, grows, strict=True)
    }
    assert by_marker == {
        "nose": ["trunk"],
        "crest": ["trunk"],
        "tail_mid": ["trunk", "tail"],
        "tail_tip": ["trunk", "tail"],
        "l_foot": ["trunk", "l_leg"],
        "r_foot": ["trunk", "l_leg"],
    }


def test_doubling_every_group_doubles_the_animal(plain):
    """About the origin of its root, which carries no length."""
    kinematics = plain.with_parameters(["scale"])
    q = random_motion(plain.skeleton, 3, 1)
    free = [j for j, d in enumerate(plain.skeleton.dofs) if d.kind == "slide"]
    twice = q.copy()
    twice[:, free] *= 2
    k = np.full(kinematics.n_groups, np.log(2.0))
    np.testing.assert_allclose(kinematics.positions(twice, k), 2 * plain.positions(q), atol=1e-12)


def test_families_are_taken_in_one_order_and_once(lizard):
    kinematics = load_kinematics(lizard.skeleton, ["offsets", "scale", "offsets"])
    assert kinematics.families == ("scale", "offsets")
    assert kinematics.n_parameters == 3 + 3 * 6
    assert lizard.n_parameters == lizard.n_groups == 0
    assert lizard.grows.shape == (6, 0)


def test_many_frames_at_once_are_those_one_by_one(lizard):
    """More frames than are linearised together."""
    kinematics = lizard.with_parameters(["scale", "offsets"])
    q = random_motion(lizard.skeleton, 600, 0)
    k = np.random.default_rng(0).normal(0, 0.1, kinematics.n_parameters)
    linear = kinematics.linearise(q, k)
    for n in (0, 255, 256, 599):
        one = kinematics.linearise(q[n : n + 1], k)
        for name in ("positions", "jacobian", "axes", "growth", "point_growth", "rotations"):
            np.testing.assert_allclose(getattr(linear, name)[n], getattr(one, name)[0], rtol=0, atol=1e-13)
