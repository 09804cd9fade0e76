"""Plane angles: one number that both cameras of a pair agree on, for every kind of camera."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from conftest import look_at
from hypothesis import given, settings
from hypothesis import strategies as st

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.epipolar import (
    fundamental_matrix,
    ideal_jacobian,
    ideal_pixels,
    sampson_distance,
)
from acino_fte.data_tools.epipolar_angles import plane_angles, rays_of
from acino_fte.data_tools.projective_camera import ProjectiveCamera

TARGET = np.array([0.1, 0.0, 0.3])
N = 30


def camera(kind: str, place, target=TARGET) -> Camera:
    """A camera of a kind, level, that looks at a target."""
    if kind == "moving":
        path = np.asarray(place) + np.linspace(0, 0.6, N)[:, None] * [0.5, -0.3, 0.4]
        return look_at(kind, path, target)
    if kind == "fisheye":
        return look_at(kind, place, target, "fisheye", focal=500.0)
    if kind == "dlt":
        plain = look_at(kind, place, target, distortion=())
        skewed = plain.matrix + np.array([[0, 12.0, 0], [0, 0, 0], [0, 0, 0]])
        projection = skewed @ np.column_stack([plain.rotation, plain.translation])
        return ProjectiveCamera.from_projection(kind, -3 * projection, (1280, 720))
    return look_at(kind, place, target, distortion=() if kind == "pinhole" else None)


KINDS = ("pinhole", "distorted", "fisheye", "dlt", "moving")


def pixels_of(seeing: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels (P, 2) of points (P, 3), point p in frame p."""
    return seeing.project(points[:, None])[:, 0] if seeing.moves else seeing.project(points)


def angles(a: Camera, b: Camera, x_a: np.ndarray, x_b: np.ndarray):
    """Plane angles of dots, dot p in frame p."""
    frames = np.arange(len(x_a)), np.arange(len(x_b))
    rays = rays_of(a, frames[0], x_a), rays_of(b, frames[1], x_b)
    return plane_angles(CameraArray((a, replace(b, name="other"))), 0, 1, frames, rays)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def distance(a: Camera, b: Camera, x_a: np.ndarray, x_b: np.ndarray) -> np.ndarray:
    one, two = angles(a, b, x_a, x_b)
    return wrapped(one.angle - two.angle) / np.hypot(one.slope, two.slope)


def places(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Where two cameras stand: in any directions from the target, 2–4 m away."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(2, 3)) * [1, 1, 0.4]
    out *= (rng.uniform(2.0, 4.0, 2) / np.linalg.norm(out, axis=1))[:, None]
    return TARGET + out[0], TARGET + out[1]


def cloud(seed: int, size: float = 0.5) -> np.ndarray:
    return TARGET + np.random.default_rng(seed).uniform(-size, size, (N, 3))


@pytest.mark.parametrize(("first", "second"), [(a, b) for a in KINDS for b in KINDS if a <= b])
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_one_point_has_one_angle_in_both_views(first, second, seed):
    place_a, place_b = places(seed)
    a, b, points = camera(first, place_a), camera(second, place_b), cloud(seed + 1)
    one, two = angles(a, b, pixels_of(a, points), pixels_of(b, points))
    known = np.isfinite(one.angle) & np.isfinite(two.angle)
    miss = wrapped(one.angle - two.angle)[known]
    np.testing.assert_allclose(miss / np.hypot(one.slope, two.slope)[known], 0, atol=1e-5)  # px
    assert (two.along > one.along)[known].all()  # the rays meet in front of both
    assert known.sum() > 0.5 * N


@pytest.mark.parametrize(("first", "second"), list(combinations(KINDS, 2)))
def test_slopes_against_finite_differences(first, second):
    a, b = (camera(kind, place) for kind, place in zip((first, second), places(3), strict=True))
    points = cloud(5)
    x_a, x_b = pixels_of(a, points), pixels_of(b, points)
    found, step = angles(a, b, x_a, x_b), 1e-4
    for side in (0, 1):
        change = []
        for axis in np.eye(2):
            up, down = [x_a, x_b], [x_a, x_b]
            up[side], down[side] = up[side] + step * axis, down[side] - step * axis
            ends = [angles(a, b, *x)[side].angle for x in (up, down)]
            change.append(wrapped(ends[0] - ends[1]) / (2 * step))
        np.testing.assert_allclose(found[side].slope, np.hypot(*change), rtol=1e-5)


@pytest.mark.parametrize("kind", [k for k in KINDS if k != "moving"])
def test_difference_is_the_signed_sampson_distance_to_first_order(kind):
    """With noise ε both agree up to ε²: a tenth of the noise, a hundredth of the difference."""
    a, b = (camera(kind, place) for place in places(11))
    points, rng = cloud(12), np.random.default_rng(13)
    noise = rng.normal(size=(2, N, 2))
    f = fundamental_matrix(a, b)
    off = []
    for scale in (1.0, 0.1):
        x_a, x_b = (pixels_of(c, points) + scale * e for c, e in zip((a, b), noise, strict=True))
        sampson = sampson_distance(
            f, ideal_pixels(a, x_a), ideal_pixels(b, x_b), ideal_jacobian(a, x_a), ideal_jacobian(b, x_b)
        )
        d = distance(a, b, x_a, x_b)
        sign = np.sign((d * sampson).sum())
        off.append(np.abs(d - sign * sampson).max())
        assert np.abs(d).max() > 0.5 * scale
    assert off[0] < 0.05
    assert off[1] < 0.03 * off[0]


@pytest.mark.parametrize("kind", KINDS)
def test_standard_deviation_is_that_of_the_pixels(kind):
    a, b = (camera(kind, place) for place in places(21))
    rng, sigma = np.random.default_rng(22), 0.7
    d = []
    for seed in range(200):
        points = cloud(seed)
        d.append(distance(a, b, *(pixels_of(c, points) + rng.normal(0, sigma, (N, 2)) for c in (a, b))))
    d = np.concatenate(d)
    assert np.nanstd(d) == pytest.approx(sigma, rel=0.03)
    assert abs(np.nanmean(d)) < 0.03


def test_cameras_that_face_each_other_see_all_angles():
    """Each has the other in its image; dots around the epipole go around the pencil, ±π included."""
    a = look_at("a", (2.0, 0.05, 0.3), TARGET, distortion=())
    b = look_at("b", (-2.0, -0.05, 0.35), TARGET, distortion=())
    turn = np.linspace(-np.pi, np.pi, N)
    points = TARGET + 0.4 * np.column_stack([np.zeros(N), np.cos(turn), np.sin(turn)])
    one, two = angles(a, b, a.project(points), b.project(points))
    np.testing.assert_allclose(wrapped(one.angle - two.angle), 0, atol=1e-9)
    assert np.ptp(one.angle) > 6.0
    assert (two.along > one.along).all()


def test_an_epipole_has_no_angle():
    a = look_at("a", (2.0, 0.0, 0.3), TARGET, distortion=())
    b = look_at("b", (-2.0, 0.1, 0.35), TARGET, distortion=())
    points = np.vstack([cloud(1), b.centre, 0.999 * b.centre + 0.001 * a.centre])
    x_a = a.project(points)
    one, _ = angles(a, b, x_a, b.project(cloud(1)))
    assert np.isnan(one.angle[-2:]).all()
    assert np.isfinite(one.angle[:N]).mean() > 0.9


def test_dots_that_a_lens_cannot_have_seen_have_no_angle():
    a, b = (camera("fisheye", place) for place in places(31))
    pixels = a.project(cloud(1))
    pixels[3] = (90_000.0, 0.0)
    one, _ = angles(a, b, pixels, b.project(cloud(1)))
    assert np.isnan(one.angle[3])
    assert np.isfinite(np.delete(one.angle, 3)).all()


def test_rays_that_part_do_not_meet():
    """Of two rays in one plane that meet behind a camera, the angle from the baseline is smaller at b."""
    a = look_at("a", (-1.0, -3.0, 0.3), (-1.0, 0.0, 0.3), distortion=())
    b = look_at("b", (1.0, -3.0, 0.3), (1.0, 0.0, 0.3), distortion=())
    parting = np.array([[200.0, 360.0]]), np.array([[1100.0, 360.0]])
    meeting = parting[::-1]
    one, two = angles(a, b, *parting)
    assert two.along < one.along
    one, two = angles(a, b, *meeting)
    assert two.along > one.along


def test_two_cameras_in_one_place_have_no_planes():
    a = look_at("a", (2.0, 0.0, 0.3), TARGET)
    turned = look_at("b", (2.0, 0.0, 0.3), TARGET + 0.3)
    x = pixels_of(a, cloud(1))
    assert angles(a, turned, x, x) is None


def test_frames_in_which_a_moving_camera_is_in_the_place_of_the_other_have_no_angle():
    a = camera("distorted", (3.0, -2.0, 1.5))
    path = np.tile([2.0, 3.0, 1.0], (N, 1))
    path[4] = a.centre
    b = look_at("b", path, TARGET)
    points = cloud(1)
    one, two = angles(a, b, pixels_of(a, points), pixels_of(b, points))
    assert np.flatnonzero(np.isnan(one.angle)).tolist() == [4]
    assert np.flatnonzero(np.isnan(two.angle)).tolist() == [4]


def test_the_world_may_lie_anywhere():
    """Rigs of which the origin is far away, as in national grids: two cameras half a metre apart."""
    far = np.array([500_000.0, 5_000_000.0, 120.0])
    a, b = (camera("pinhole", place) for place in ((0.0, -3.0, 0.3), (0.5, -3.0, 0.3)))
    moved = [replace(c, translation=c.translation - c.rotation @ far) for c in (a, b)]
    points = cloud(1)
    here = distance(a, b, a.project(points), b.project(points) + (0, 2.0))
    there = distance(*moved, a.project(points), b.project(points) + (0, 2.0))
    np.testing.assert_allclose(there, here, atol=1e-3)
