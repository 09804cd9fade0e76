"""Clocks of cameras: found from moving individuals, with honest errors, or reported as not observable."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera
from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.camera_paths import CameraPath
from acino_fte.data_tools.time_offsets import (
    TimeOffsets,
    estimate_time_offsets,
    keys_on_one_clock,
    own_time,
    path_on_reference_clock,
    tracks_on_reference_clock,
)
from acino_fte.data_tools.tracks2d import Tracks2D
from acino_fte.errors import InputError

MATRIX = np.array([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]])
DISTORTION = np.array([-0.1, 0.02, 0, 0])
SIZE = (1920, 1080)
DOWN = np.diag([1.0, -1, -1])


def curve(time, seed: int, size: float, speed: float) -> np.ndarray:
    """A smooth wandering (N, 3) of about a size; fastest part turns with `speed` rad a frame."""
    rng = np.random.default_rng(seed)
    rate = speed * rng.uniform(0.2, 1.0, (4, 3))
    phase, height = rng.uniform(0, 2 * np.pi, (4, 3)), rng.normal(0, size / 2, (4, 3))
    return (height * np.sin(np.asarray(time)[:, None, None] * rate + phase)).sum(1)


def record(
    offset,
    drift=0.0,
    n: int = 1500,
    seed: int = 0,
    noise_px: float = 1.0,
    missing: float = 0.1,
    swapped: float = 0.02,
    speed: float = 0.08,
    flight: float = 0.5,
):
    """A rig that flies and looks down from 4 m, and two individuals; every camera has a clock of its own.

    Frame f of camera c is taken at f + offset_c + drift_c (f − n // 2).
    """
    rng = np.random.default_rng(seed)
    drift = np.broadcast_to(drift, len(offset))
    corners = np.array([[-1.0, -1, 0], [1, 1, 0], [-1, 1, 0], [1, -1, 0]])
    paths, tracks, lenses = [], [], []
    for c, late in enumerate(offset):
        frame = np.arange(n)
        time = frame + late + drift[c] * (frame - n // 2)
        turn = Rotation.from_rotvec(0.1 * flight * curve(time, 1, 1.0, 0.02))
        rotation = turn.as_matrix() @ DOWN
        middle = flight * curve(time, 2, 1.0, 0.01) + [0, 0, 4.0]
        centre = middle + 0.8 * np.einsum("nji,j->ni", rotation, corners[c])
        translation = -np.einsum("nij,nj->ni", rotation, centre)
        lens = Camera(f"c{c}", "pinhole", MATRIX, DISTORTION, rotation, translation, SIZE)
        points = [curve(time, 10 + i, 0.5, speed) * [1, 1, 0.4] + [0.5 * i, 0, 0.3] for i in range(2)]
        xy = lens.project(np.stack(points, axis=1)) + rng.normal(0, noise_px, (n, 2, 2))
        wrong = rng.random(n) < swapped
        xy[wrong] = xy[wrong, ::-1]
        seen = rng.random((n, 2)) > missing
        rows, who = np.nonzero(seen)
        order = rng.permutation(len(rows))  # in any order
        rows, who = rows[order], who[order]
        labels = ("front", "back") if c % 2 else ("back", "front")
        track = who if c % 2 else 1 - who
        tracks.append(Tracks2D(f"c{c}", rows, track, xy[rows, who], labels))
        known = np.ones(n, bool)
        paths.append(CameraPath(f"c{c}", frame, rotation, translation, np.zeros((n, 6, 6)), known, known))
        lenses.append(lens)
    return paths, tracks, lenses


def test_offsets_of_a_part_of_a_frame():
    offset = np.array([0.0, 12.37, -41.52, 3.0])
    found = estimate_time_offsets(*record(offset), reference="c0", drift=False)
    assert not found.notes
    assert found.observable.all()
    np.testing.assert_allclose(found.offset, offset, atol=0.02)
    assert (found.offset_sd[1:] < 0.01).all()
    assert found.offset_sd[0] == 0
    np.testing.assert_array_equal(found.drift, 0)


def test_offsets_and_drifts_with_honest_errors():
    """Squared errors over variances average 1; two individuals, 2 % wrong identities, 10 % missing."""
    z = []
    for seed in range(10):
        rng = np.random.default_rng(100 + seed)
        offset, drift = rng.uniform(-20, 20, 3), rng.uniform(-4e-4, 4e-4, 3)
        offset[0] = drift[0] = 0.0
        found = estimate_time_offsets(*record(offset, drift, 1500, seed), max_offset=45)
        middle = found.offset + found.drift * (750 - found.middle)
        np.testing.assert_allclose(middle, offset, atol=0.03)
        np.testing.assert_allclose(found.drift, drift, atol=6e-5)
        z += [(middle - offset)[1:] / found.offset_sd[1:], (found.drift - drift)[1:] / found.drift_sd[1:]]
    assert 0.6 < np.mean(np.square(z)) < 1.5


def test_the_reference_is_a_choice():
    offset = np.array([0.0, 7.25, -3.5])
    scene = record(offset, n=600)
    found = estimate_time_offsets(*scene, reference="c2", drift=False)
    np.testing.assert_allclose(found.offset, offset - offset[2], atol=0.05)
    assert found.reference == "c2"
    assert estimate_time_offsets(*scene).reference == "c0"
    with pytest.raises(InputError, match="did you mean 'c1'"):
        estimate_time_offsets(*scene, reference="c1x")


@pytest.mark.parametrize("swapped", [0.0, 0.02])
def test_what_does_not_move_tells_no_time(swapped):
    found = estimate_time_offsets(*record([0.0, 5.3], n=500, speed=0.0, flight=0.0, swapped=swapped))
    assert not found.observable.all()
    assert np.isinf(found.offset_sd).sum() == 1
    assert "move enough" in found.notes[-1]
    np.testing.assert_array_equal(found.offset, 0)


def test_a_camera_that_shares_no_individual_is_reported_and_the_others_are_found():
    paths, tracks, lenses = record([0.0, 4.4, 2.0], n=500)
    tracks[2] = Tracks2D("c2", tracks[2].frame, tracks[2].track, tracks[2].xy, ("fox", "hare"))
    found = estimate_time_offsets(paths, tracks, lenses, reference="c0", drift=False)
    np.testing.assert_allclose(found.offset[:2], [0, 4.4], atol=0.03)
    np.testing.assert_array_equal(found.observable, [True, True, False])
    assert "clock of camera c2 is not known" in found.notes[0]


def test_an_offset_out_of_reach_and_a_motion_that_repeats_are_told():
    found = estimate_time_offsets(*record([0.0, 60.0], n=500), reference="c0", max_offset=20)
    assert found.notes or found.offset_sd[1] > 0.1
    paths, tracks, lenses = record([0.0, 3.0], n=1000, flight=0.0, swapped=0.0)
    angle = 2 * np.pi * np.arange(1100) / 40  # the same again every 40 frames
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    for c, late in enumerate([0, 3]):
        xy = lenses[c].project(points[late : 1000 + late, None])[:, 0]
        tracks[c] = Tracks2D(f"c{c}", np.arange(1000), np.zeros(1000, int), xy, ("one",))
    found = estimate_time_offsets(paths, tracks, lenses, reference="c0", drift=False)
    assert "40 frames from the best one is almost as good" in found.notes[0]


def test_nothing_moves_and_there_is_no_noise():
    found = estimate_time_offsets(*record([0.0, 5.0], n=200, speed=0, flight=0, noise_px=0, swapped=0))
    np.testing.assert_array_equal(found.observable, [True, False])


def test_no_rows_at_all():
    paths, tracks, lenses = record([0.0, 1.0], n=50)
    empty = [view.at_rows(np.zeros(0, int)) for view in tracks]
    found = estimate_time_offsets(paths, empty, lenses)
    assert found.observable.sum() == 1
    with pytest.raises(InputError, match="belong together"):
        estimate_time_offsets(paths, tracks[::-1], lenses)
    with pytest.raises(InputError, match="range of offsets"):
        estimate_time_offsets(paths, tracks, lenses, max_offset=0)


def test_times_go_there_and_back():
    clocks = TimeOffsets(
        names=("a", "b"),
        reference="a",
        offset=np.array([0, 5.25]),
        drift=np.array([0, 1e-3]),
        offset_sd=np.zeros(2),
        drift_sd=np.zeros(2),
        middle=100.0,
        n=np.zeros(2, int),
    )
    frame = np.arange(0, 200, 7)
    time = clocks.reference_time("b", frame)
    np.testing.assert_allclose(time, frame + 5.25 + 1e-3 * (frame - 100))
    np.testing.assert_allclose(clocks.own_time("b", time), frame, atol=1e-10)


def test_dots_and_poses_on_the_reference_clock_are_those_of_that_time():
    """A camera and a dot of which all motion is uniform, so that interpolation is exact."""
    n, offset, drift, middle = 60, 7.3, 1e-3, 30.0
    frame = np.arange(n) + 5
    time = frame + offset + drift * (frame - middle)

    def pose(t):
        return Rotation.from_rotvec(np.outer(t, [0.01, 0.02, -0.005])).as_matrix(), np.outer(t, [0.1, 0, 0.2])

    rotation, centre = pose(time)
    known = np.arange(n) != 20
    covariance = np.repeat(np.eye(6)[None], n, axis=0)
    translation = -np.einsum("nij,nj->ni", rotation, centre)
    path = CameraPath("a", frame, rotation, translation, covariance, known, known)
    xy = np.stack([3 * time, 100 - time], axis=-1)
    seen = (frame != 40) & (frame != 41)
    order = np.random.default_rng(0).permutation(np.flatnonzero(seen))
    tracks = Tracks2D("a", frame[order], np.zeros(len(order), int), xy[order], ("one",), animal=order % 3)
    found = tracks_on_reference_clock(tracks, offset, drift, middle)
    moved = path_on_reference_clock(path, offset, drift, middle)
    np.testing.assert_allclose(found.xy, np.stack([3 * found.frame, 100 - found.frame], -1), atol=1e-9)
    own = own_time(found.frame, offset, drift, middle)
    gap = (own > 39) & (own < 42)
    assert not gap.any()
    assert len(found) == n - 1 - 3  # one for each step between frames that both have the dot
    assert (np.diff(found.frame) > 0).all()
    np.testing.assert_array_equal(found.animal, (found.row >= 0) * (order[found.row] % 3))
    expected, place = pose(moved.frame)
    np.testing.assert_allclose(moved.rotation, expected, atol=1e-12)
    np.testing.assert_allclose(moved.centre, place, atol=1e-9)
    inside = own_time(moved.frame, offset, drift, middle)
    np.testing.assert_array_equal(moved.known, (inside < 24) | (inside > 26))
    assert tracks.frame.dtype == found.frame.dtype
    np.testing.assert_array_equal(tracks.xy, xy[order])  # the input stays


def test_key_frames_on_one_clock_are_common_and_of_their_time():
    def pose(t):
        return Rotation.from_rotvec(np.outer(t, [0.01, 0.02, -0.005])).as_matrix(), np.outer(t, [0.1, 0, 0.2])

    lens = Camera("a", "pinhole", MATRIX, DISTORTION, np.eye(3), np.zeros(3), SIZE)
    shifts = [(0.0, 0.0, 50.0), (-12.4, 1e-3, 50.0)]
    cameras, paths = [], []
    for name, (offset, drift, middle) in zip("ab", shifts, strict=True):
        frame = np.arange(100)
        rotation, centre = pose(frame + offset + drift * (frame - middle))
        translation = -np.einsum("nij,nj->ni", rotation, centre)
        known = (frame < 40) | (frame > 47)
        covariance = np.broadcast_to(np.eye(6), (100, 6, 6))
        paths.append(CameraPath(name, frame, rotation, translation, covariance, known, frame % 8 == 0))
        keys = frame[::8]
        cameras.append(KeyedCamera(name, lens, 1, keys, rotation[keys], translation[keys]))
    moved = keys_on_one_clock(cameras, paths, shifts)
    assert (moved[0].frame % 8 == 0).all()
    assert len(np.intersect1d(moved[0].frame, moved[1].frame)) >= 9
    assert 40 not in moved[0].frame  # where the path is not known
    for camera in moved:
        rotation, centre = pose(camera.frame)
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-12)
        np.testing.assert_allclose(camera.centre, centre, atol=1e-9)
    one = replace(
        cameras[1], frame=np.array([3]), rotation=rotation[:1], translation=cameras[1].translation[:1]
    )
    assert keys_on_one_clock([one], paths[1:], [(2.6, 0.0, 0.0)])[0].frame.tolist() == [6]


def test_a_whole_offset_only_renames_the_frames():
    paths, tracks, _ = record([0.0, 1.0], n=40, missing=0.3)
    view = tracks[1]
    track = np.where(np.arange(len(view)) % 5, view.track, -1)  # some bare points
    doubled = np.concatenate([np.arange(len(view)), [3, 3]])
    view = Tracks2D("c1", view.frame[doubled], track[doubled], view.xy[doubled], view.labels)
    found, path = tracks_on_reference_clock(view, -4.0), path_on_reference_clock(paths[1], -4.0)
    order = np.lexsort((view.row, view.track, view.frame))
    back = np.lexsort((found.row, found.track, found.frame))
    np.testing.assert_array_equal(found.frame[back] + 4, view.frame[order])
    np.testing.assert_array_equal(found.track[back], view.track[order])
    np.testing.assert_array_equal(found.xy[back], view.xy[order])
    np.testing.assert_array_equal(path.frame, paths[1].frame - 4)
    np.testing.assert_allclose(path.translation, paths[1].translation, atol=1e-12)
    np.testing.assert_allclose(path.rotation, paths[1].rotation, atol=1e-14)


def test_clocks_that_were_set_right_leave_nothing():
    offset = np.array([0.0, 8.4, -5.7])
    paths, tracks, lenses = record(offset, n=800, swapped=0.0)
    clocks = estimate_time_offsets(paths, tracks, lenses, reference="c0", drift=False)
    shifts = list(zip(clocks.offset, clocks.drift, strict=True))
    views = [tracks_on_reference_clock(view, *shift) for view, shift in zip(tracks, shifts, strict=True)]
    ways = [path_on_reference_clock(path, *shift) for path, shift in zip(paths, shifts, strict=True)]
    again = estimate_time_offsets(ways, views, lenses, reference="c0", drift=False)
    np.testing.assert_allclose(again.offset, 0, atol=0.02)
