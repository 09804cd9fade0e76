"""Returns attached to the skeleton: where they belong, what is rejected, and how time is taken care of."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from acino_fte.association import associate, in_view
from acino_fte.attaching import attach
from acino_fte.cameras import Camera, CameraArray
from acino_fte.depth import BodyReturns, MarkerDepths
from acino_fte.errors import InputError
from acino_fte.lidar import Lidar
from acino_fte.sequence import Sequence
from acino_fte.skeleton import expand
from acino_fte.species_file import SpeciesFile

FPS = 50.0
SURFACE = 0.04
STICKS = {
    "format": "acino-fte/skeleton/1",
    "name": "sticks",
    "links": {
        "body": {"parent": "world", "dofs": {a: {"slide": a} for a in "xyz"}},
    },
    "markers": {
        "head": {"link": "body", "at": [0.5, 0, 0]},
        "tail": {"link": "body", "at": [-0.5, 0, 0]},
        "near": {"link": "body", "at": [0, -0.2, -0.5]},
        "far": {"link": "body", "at": [0, 0.2, -0.5]},
    },
    "draw": [["head", "tail"], ["tail", "near"], ["tail", "far"]],
}
DISTANCE = 20.0


@pytest.fixture(scope="module")
def sticks():
    return expand(SpeciesFile.model_validate(STICKS))


def pose(skeleton, places):
    """Marker positions (N, M, 3) with the root at places (N, 3)."""
    at = np.array([m.at for m in skeleton.markers])
    return np.asarray(places)[:, None] + at


def camera(n=None):
    """At the origin, looking along world y; a pose a frame when asked to, turning about the vertical."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    if n is not None:
        angle = 0.004 * np.arange(n)
        turn = np.array([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in angle])
        rotation = turn @ rotation
    matrix = np.array([[5000.0, 0, 500], [0, 5000, 300], [0, 0, 1]])
    return Camera("cam", "pinhole", matrix, np.zeros(0), rotation, np.zeros(3), (1000, 600))


def sequence(skeleton, lidar, n, cam=None):
    names = [m.name for m in skeleton.markers]
    shape = (n, 1, len(names))
    data = {
        "position": (("frame", "camera", "marker", "space"), np.zeros((*shape, 2))),
        "likelihood": (("frame", "camera", "marker"), np.ones(shape)),
    }
    coords = {"frame": np.arange(n), "camera": ["cam"], "marker": names, "space": ["u", "v"]}
    return Sequence(
        "s", "sticks", FPS, xr.Dataset(data, coords), CameraArray((cam or camera(),)), lidar=lidar
    )


def lidar_of(xyz, time):
    """A lidar whose frame is the camera's."""
    xyz = np.atleast_2d(xyz)
    return Lidar("cam", np.broadcast_to(time, len(xyz)), xyz, np.zeros(len(xyz)), np.eye(3), np.zeros(3))


def before_link(cam, p, q, u, front=SURFACE, frame=None):
    """A return on the ray through a point of a link, that far before it, in the camera's frame."""
    local = cam.to_camera(((1 - u) * p + u * q)[None, None] if not cam.moves else None)
    point = local[0, 0]
    return point * (1 - front / point[2])


def attached(skeleton, xyz, time=0.0, places=((0, DISTANCE, 0),), front_sd=0.1, cam=None):
    positions = pose(skeleton, places)
    lidar = lidar_of(xyz, time)
    local = (cam or camera()).to_camera(positions)
    surface = np.full(len(skeleton.markers), SURFACE)
    return attach(lidar, np.arange(len(positions)), FPS, local, skeleton, surface, front_sd)


@pytest.mark.parametrize("u", [0.0, 0.25, 0.8])
def test_a_return_before_a_link_is_attached_to_it(sticks, u):
    head, tail = pose(sticks, [[0, DISTANCE, 0]])[0, :2]
    found = attached(sticks, before_link(camera(), head, tail, u))
    assert len(found) == 1
    assert (found.start[0], found.end[0]) == (0, 1)
    assert found.along[0] == pytest.approx(u, abs=1e-9)
    assert found.side[0] == pytest.approx(0.0, abs=1e-9)
    assert found.front[0] == pytest.approx(SURFACE, abs=1e-9)
    assert found.bulge[0] == 1.0


def test_a_round_body_is_thinner_beside_its_axis(sticks):
    """At the side g a capsule of radius r lies √(r² − g²) before its axis."""
    side = 0.024
    inside = camera().to_camera(np.array([[[0.2, DISTANCE, side]]]))[0, 0]
    found = attached(sticks, inside * (1 - 0.032 / inside[2]))
    assert found.side[0] == pytest.approx(side, rel=0.01)
    assert found.bulge[0] == pytest.approx(0.8, rel=0.01)


@pytest.mark.parametrize(
    "xyz",
    [
        (0.2, 0.0, DISTANCE + 3.0),  # a bush behind, in line with the body
        (0.2, 0.0, DISTANCE - 2.0),  # grass before it
        (0.2, 0.2, DISTANCE - SURFACE),  # at its depth, beside it
        (0.2, 0.0, -DISTANCE),  # behind the camera
    ],
    ids=["behind", "before", "beside", "back"],
)
def test_what_is_not_on_the_body_is_rejected(sticks, xyz):
    assert len(attached(sticks, np.array(xyz))) == 0


def test_the_near_leg_hides_the_far_one(sticks):
    """Both legs are in line, 28 cm apart at this point: half-way between, the near one is the likelier."""
    positions = pose(sticks, [[0, DISTANCE, 0]])[0]
    for front, leg in ((SURFACE, 2), (-0.11, 2), (-0.28 + SURFACE, 3)):
        row = before_link(camera(), positions[1], positions[2], 0.7, front)
        found = attached(sticks, row, front_sd=0.1)
        assert (found.start[0], found.end[0]) == (1, leg), front


def test_a_moving_animal_is_met_where_it_was(sticks):
    """7 m/s towards the camera, and a return half way between two frames."""
    places = [[0.0, DISTANCE, 0], [0.0, DISTANCE - 0.14, 0]]
    head, tail = pose(sticks, [[0, DISTANCE - 0.07, 0]])[0, :2]
    at_half = before_link(camera(), head, tail, 0.5)
    found = attached(sticks, at_half, 0.49 / FPS, places, front_sd=0.02)
    assert len(found) == 1
    assert found.frame[0] == 0
    assert found.depth[0] == pytest.approx(DISTANCE - SURFACE, abs=3e-3)  # moved to the frame's time


def test_a_camera_that_pans_takes_its_lidar_along(sticks):
    cam, n = camera(3), 3
    positions = pose(sticks, [[0.0, DISTANCE, 0]] * n)
    local = cam.to_camera(positions)
    rows = [0.5 * (local[k, 0] + local[k, 1]) * (1 - SURFACE / DISTANCE) for k in range(n)]
    lidar = lidar_of(np.array(rows), np.arange(n) / FPS)
    found = associate(
        sequence(sticks, lidar, n, cam), sticks, positions, np.full(4, SURFACE), how="body", front_sd=0.05
    ).measured
    assert isinstance(found, BodyReturns)
    assert list(found.frame) == [0, 1, 2]
    np.testing.assert_allclose(found.along, 0.5, atol=1e-6)


def test_returns_of_a_marker_become_one_depth_at_it(sticks):
    """A link that leans away: a return half-way along is carried to the marker by the pose."""
    positions = pose(sticks, [[0.0, DISTANCE, 0]])
    positions[0, 0, 1] += 0.5  # the head is half a metre farther away than the tail
    cam = camera()
    rows = [before_link(cam, positions[0, 0], positions[0, 1], u) for u in (0.1, 0.2, 0.3)]
    lidar = lidar_of(np.array(rows), 0.0)
    data = associate(sequence(sticks, lidar, 1), sticks, positions, np.full(4, SURFACE))
    found = data.measured
    assert isinstance(found, MarkerDepths)
    assert list(found.marker) == [0] and list(found.count) == [3]
    assert found.depth[0] == pytest.approx(DISTANCE + 0.5 - SURFACE, abs=2e-3)
    alone = associate(
        sequence(sticks, lidar_of(rows[0], 0.0), 1), sticks, positions, np.full(4, SURFACE)
    ).measured
    assert alone.sd[0] < associate(
        sequence(sticks, lidar_of(rows[2], 0.0), 1), sticks, positions, np.full(4, SURFACE)
    ).measured.sd[0]  # farther away along the link, less is known  # fmt: skip


def test_the_nearest_return_in_the_image_may_be_a_bush(sticks):
    """The thesis's way takes whatever is nearest; the robust way takes nothing."""
    positions = pose(sticks, [[0.0, DISTANCE, 0]])
    bush = np.array([[0.5, 0.0, DISTANCE]]) * (DISTANCE + 5) / DISTANCE
    given = sequence(sticks, lidar_of(bush, 0.0), 1)
    nearest = associate(given, sticks, positions, np.full(4, SURFACE), how="nearest").measured
    assert len(nearest) == 4
    np.testing.assert_allclose(nearest.depth, DISTANCE + 5)
    assert len(associate(given, sticks, positions, np.full(4, SURFACE)).measured) == 0


def test_no_lidar_says_nothing(sticks):
    positions = pose(sticks, [[0.0, DISTANCE, 0]])
    assert associate(sequence(sticks, None, 1), sticks, positions, np.full(4, SURFACE)) is None
    empty = lidar_of(np.zeros((0, 3)), np.zeros(0))
    assert len(associate(sequence(sticks, empty, 1), sticks, positions, np.full(4, SURFACE)).measured) == 0
    assert (
        len(
            associate(sequence(sticks, empty, 1), sticks, positions, np.full(4, SURFACE), how="body").measured
        )
        == 0
    )
    nearest = associate(sequence(sticks, empty, 1), sticks, positions, np.full(4, SURFACE), how="nearest")
    assert len(nearest.measured) == 0
    with pytest.raises(InputError, match="There is no way 'closest'"):
        associate(sequence(sticks, empty, 1), sticks, positions, np.full(4, SURFACE), how="closest")


def test_only_returns_before_the_picture_are_kept(sticks):
    """The picture is 1000 px wide: ±5.7°, with a tenth of its width to either side ±6.9°."""
    angles = np.radians([0.0, 5.0, 6.5, 7.5, 20.0])
    xyz = DISTANCE * np.stack([np.tan(angles), 0 * angles, np.ones(5)], axis=1)
    kept = in_view(sequence(sticks, lidar_of(np.concatenate([xyz, -xyz]), 0.0), 1)).lidar
    np.testing.assert_allclose(kept.xyz, xyz[:3])


def test_returns_outside_the_sequence_are_left_out(sticks):
    head, tail = pose(sticks, [[0, DISTANCE, 0]])[0, :2]
    row = before_link(camera(), head, tail, 0.5)
    for time, count in ((-1.0, 0), (-0.4 / FPS, 1), (1.4 / FPS, 1), (1.6 / FPS, 0)):
        found = attached(sticks, row, time, [[0, DISTANCE, 0]] * 2)
        assert len(found) == count, time


def test_a_lidar_holds_finite_numbers_of_one_length():
    with pytest.raises(InputError, match="not usable"):
        lidar_of(np.array([[np.nan, 0, 1]]), 0.0)
    whole = lidar_of(np.ones((4, 3)), np.arange(4.0))
    assert len(whole.between(1.0, 3.0)) == 2
    with pytest.raises(InputError, match="not usable"):
        replace(whole, intensity=np.zeros(3))
