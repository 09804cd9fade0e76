"""Known distances: how they are written, whom they mean, what the model measures, and the scale of all."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera
from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.scene_distances import MeasuredDistance, between_points, robust_mean
from acino_fte.data_tools.scene_scale import (
    KnownDistance,
    measure_distance,
    parse_distance,
    resolve,
    scene_scale,
)
from acino_fte.data_tools.scene_tracks import SceneTracks
from acino_fte.data_tools.similarity import Similarity
from acino_fte.errors import InputError

MATRIX = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])


def lens(name: str) -> Camera:
    return Camera(name, "pinhole", MATRIX, np.zeros(5), np.eye(3), np.zeros(3), (1280, 720))


def keyed(name: str, frame, rotation, centre, model_id: int = 1) -> KeyedCamera:
    translation = -np.einsum("kij,kj->ki", rotation, centre)
    return KeyedCamera(name, lens(name), model_id, np.asarray(frame), rotation, translation)


def rigid_pair(seed: int, n: int = 200, noise: float = 0.004, turn: float = 0.001) -> list[KeyedCamera]:
    """Two cameras 0.6 m apart on one rig that moves and turns; white noise on every pose."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, n)
    rig = Rotation.from_rotvec(np.stack([0.4 * np.sin(5 * time), 2 * time, 0.3 * time], axis=-1))
    path = np.stack([10 * time, np.sin(6 * time), 0.3 * time], axis=-1)
    cameras = []
    for i, (name, place) in enumerate([("cam_a", [0.0, 0, 0]), ("cam_b", [0.36, 0.48, 0])]):
        rotation = (Rotation.from_rotvec(rng.normal(0, turn, (n, 3))) * rig).as_matrix()
        centre = path + rig.inv().apply(place) + rng.normal(0, noise, (n, 3))
        keep = rng.random(n) > 0.05
        cameras.append(keyed(name, 8 * np.flatnonzero(keep), rotation[keep], centre[keep], 7 + i))
    return cameras


@pytest.mark.parametrize(
    ("text", "kind", "ends", "length", "sd"),
    [
        ("1-3=0.6", "cameras", ("1", "3"), 0.6, 0),
        (" cam_a - cam_b = 60 cm ", "cameras", ("cam_a", "cam_b"), 0.6, 0),
        ("left:right=0.537", "cameras", ("left", "right"), 0.537, 0),
        ("1-3=0.6+-0.002", "cameras", ("1", "3"), 0.6, 0.002),
        ("1-3=600 ± 2 mm", "cameras", ("1", "3"), 0.6, 0.002),
        ("1-3=60cm+/-2mm", "cameras", ("1", "3"), 0.6, 0.002),
        ("1-3=60cm+-0.2", "cameras", ("1", "3"), 0.6, 0.002),
        ("tracks:0-1=5e-1", "individuals", ("0", "1"), 0.5, 0),
        ("tracks:front:back=.5", "individuals", ("front", "back"), 0.5, 0),
        ("tracks:right=0.5", "cameras", ("tracks", "right"), 0.5, 0),
        ("go-pro-1=0.5", "cameras", ("go-pro-1", ""), 0.5, 0),
        ("a=b-c=1", "cameras", ("a=b", "c"), 1.0, 0),
    ],
)
def test_ways_to_write_a_distance(text, kind, ends, length, sd):
    distance = parse_distance(text)
    assert (distance.kind, (distance.first, distance.second)) == (kind, ends)
    np.testing.assert_allclose([distance.length, distance.sd], [length, sd], rtol=1e-12)


@pytest.mark.parametrize(
    "text",
    ["", "1-3", "1-3=", "13=0.6", "=0.6", "1-3=0,6", "1-3=-1", "1-3=0", "1-3=1+-2", "1-3=1 km"],
)
def test_what_is_no_distance_says_so(text):
    with pytest.raises(InputError, match=r"distance"):
        parse_distance(text)


def test_cameras_are_meant_by_name_or_by_colmaps_number():
    cameras = rigid_pair(0, 5)
    for text in ("cam_a-cam_b=1", "7-8=1", "#7:cam_b=1", "@cam_a-8=1"):
        found = resolve(parse_distance(text), cameras)
        assert (found.first, found.second) == ("cam_a", "cam_b")


def test_names_with_dashes_are_told_apart():
    pose = np.eye(3)[None], np.zeros((1, 3))
    names = ("go-pro-1", "go-pro-2", "go", "pro-1-go-pro-2")
    cameras = [keyed(name, [0], *pose, model_id=i + 10) for i, name in enumerate(names)]
    found = resolve(parse_distance("go-pro-1-go-pro-2=1"), cameras[:2])
    assert (found.first, found.second) == names[:2]
    with pytest.raises(InputError, match="ambiguous") as caught:
        resolve(parse_distance("go-pro-1-go-pro-2=1"), cameras)
    assert "go-pro-1 : go-pro-2" in str(caught.value)
    assert resolve(parse_distance("go:pro-1-go-pro-2=1"), cameras).first == "go"


def test_a_name_that_is_unknown_shared_or_twice_the_same():
    pose = np.eye(3)[None], np.zeros((1, 3))
    shared = [keyed(name, [0], *pose, model_id=1) for name in ("left", "right")]
    with pytest.raises(InputError, match=r"'1' means more than one camera[\s\S]*left, right"):
        resolve(parse_distance("1:left=1"), shared)
    with pytest.raises(InputError, match=r"not there[\s\S]*left, right[\s\S]*middle"):
        resolve(parse_distance("left-middle=1"), shared)
    with pytest.raises(InputError, match="itself"):
        resolve(parse_distance("left-left=1"), shared)
    with pytest.raises(InputError, match=r"individuals that are not there[\s\S]*two of 0, 1"):
        resolve(parse_distance("tracks:0-2=1"), shared, ("0", "1"))
    swapped = [keyed("1", [0], *pose, model_id=2), keyed("2", [0], *pose, model_id=1)]
    with pytest.raises(InputError, match="ambiguous"):  # a name that is another camera's number
        resolve(parse_distance("1-2=1"), swapped)
    assert resolve(parse_distance("#1:#2=1"), swapped).first == "2"


def test_the_side_of_a_rig_without_bias_and_with_an_honest_error():
    found = [
        measure_distance(KnownDistance("cameras", "cam_a", "cam_b", 1), rigid_pair(s)) for s in range(60)
    ]
    error = np.array([one.length - 0.6 for one in found])
    z = error / [one.sd for one in found]
    assert all(one.rigid and not one.notes for one in found)
    assert abs(error.mean()) < 3 * error.std() / np.sqrt(60)
    assert 0.6 < (z**2).mean() < 1.7
    assert error.std() < 6e-4  # 4 mm · √2 / √180 = 4.2e-4


def test_noise_across_the_distance_does_not_lengthen_a_rigid_pair():
    errors, naive = [], []
    for seed in range(60):
        cameras = rigid_pair(seed, 150, noise=0.03)
        errors.append(measure_distance(KnownDistance("cameras", "cam_a", "cam_b", 1), cameras).length - 0.6)
        _, a, b = np.intersect1d(cameras[0].frame, cameras[1].frame, return_indices=True)
        naive.append(np.linalg.norm(cameras[0].centre[a] - cameras[1].centre[b], axis=1).mean() - 0.6)
    assert np.mean(naive) > 2e-3  # 2 · 2 · 0.03² / (2 · 0.6) = 3 mm
    assert abs(np.mean(errors)) < min(1e-3, 3 * np.std(errors) / np.sqrt(60))


def test_key_frames_that_went_wrong_do_not_count():
    cameras = rigid_pair(1)
    bad = cameras[0].translation.copy()
    bad[::11] += [3.0, -1, 2]
    broken = keyed("cam_a", cameras[0].frame, cameras[0].rotation, cameras[0].centre, 7)
    object.__setattr__(broken, "translation", bad)
    distance = KnownDistance("cameras", "cam_a", "cam_b", 1)
    clean, found = measure_distance(distance, cameras), measure_distance(distance, [broken, cameras[1]])
    assert abs(found.length - clean.length) < 2 * clean.sd
    assert found.rigid


def test_a_pair_that_is_not_rigid_is_told():
    n = 100
    time = np.linspace(0, 1, n)
    still = np.repeat(np.eye(3)[None], n, axis=0)
    a = keyed("a", range(n), still, np.stack([time, 0 * time, 0 * time], axis=-1))
    b = keyed("b", range(n), still, np.stack([0 * time, 1 + 0.3 * time, 0 * time], axis=-1), 2)
    found = measure_distance(KnownDistance("cameras", "a", "b", 1), [a, b])
    assert "not constant" in found.notes[0]
    assert not found.rigid
    angle = 2 * np.pi * time  # round the first camera at a constant distance: nothing to warn of
    round_it = a.centre + 0.5 * np.stack([np.cos(angle), np.sin(angle), 0 * time], axis=-1)
    found = measure_distance(
        KnownDistance("cameras", "a", "b", 1), [a, keyed("b", range(n), still, round_it, 2)]
    )
    np.testing.assert_allclose(found.length, 0.5, rtol=1e-9)
    assert not (found.rigid or found.notes)


def test_cameras_without_a_common_key_frame():
    n = 20
    still = np.repeat(np.eye(3)[None], n, axis=0)
    x = np.arange(2.0 * n)[:, None] * [0.1, 0, 0]
    a, b = (
        keyed("a", range(0, 40, 2), still, x[::2]),
        keyed("b", range(1, 40, 2), still, x[1::2] + [0, 0, 0.5], 2),
    )
    distance = KnownDistance("cameras", "a", "b", 1)
    for pair in ([a, b], [b, a]):
        found = measure_distance(KnownDistance("cameras", pair[0].name, pair[1].name, 1), pair)
        np.testing.assert_allclose(found.length, 0.5, rtol=1e-9)
        assert "few key frames or none" in found.notes[0]
    fixed = [keyed("a", [3], still[:1], x[:1]), keyed("b", [9], still[:1], x[:1] + [0, 0.7, 0], 2)]
    found = measure_distance(distance, fixed)
    np.testing.assert_allclose([found.length, found.sd], [0.7, 0.007])
    assert "in one frame" in found.notes[0]
    watcher = keyed("b", [7], still[:1], x[:1] + [1.9, 3.0, 0], 2)  # fixed, and the other one walks past it
    found = measure_distance(distance, [a, watcher])
    assert found.n == n
    assert "not constant" in found.notes[0]
    late = keyed("b", range(100, 120), still, x[:n], 2)
    with pytest.raises(InputError, match="at the same time"):
        measure_distance(distance, [a, late])


def test_a_rig_of_which_the_key_frames_lie_between_each_other():
    a, b = rigid_pair(8, 400)
    distance = KnownDistance("cameras", "cam_a", "cam_b", 1)
    pair = [
        keyed("cam_a", a.frame[::2], a.rotation[::2], a.centre[::2]),
        keyed("cam_b", b.frame[1::2], b.rotation[1::2], b.centre[1::2], 2),
    ]
    found = measure_distance(distance, pair)
    assert abs(found.length - 0.6) < 3 * found.sd < 3e-3
    assert found.rigid


def test_two_places_of_a_camera():
    cameras = rigid_pair(9)
    a = cameras[0]
    known = resolve(parse_distance(f"7@{a.frame[3]}:cam_a@{a.frame[90]}=4.4"), cameras)
    assert (known.kind, known.first) == ("places", f"cam_a@{a.frame[3]}")
    found = measure_distance(known, cameras)
    np.testing.assert_allclose(found.length, np.linalg.norm(a.centre[90] - a.centre[3]), rtol=1e-12)
    assert 0.5 < found.sd / (0.004 * np.sqrt(2)) < 2
    sure = KeyedCamera(
        "cam_a", a.lens, 7, a.frame, a.rotation, a.translation, np.tile(np.eye(6), (len(a.frame), 1, 1))
    )
    np.testing.assert_allclose(measure_distance(known, [sure]).sd, np.sqrt(2))
    with pytest.raises(InputError, match="one end with a frame"):
        resolve(parse_distance("7@0-8=1"), cameras)
    with pytest.raises(InputError, match=r"no key frame 3[\s\S]*nearest is"):
        measure_distance(resolve(parse_distance("7@3-8@16=1"), cameras), cameras)
    with pytest.raises(InputError, match="not there"):
        resolve(parse_distance("dog@3-8@16=1"), cameras)


def wand(seed: int, n: int = 400, length: float = 0.5, sway: float = 0.0):
    """Two ends of a wand that turns, their covariances (deep in z), and the truth."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 20, n)
    middle = np.stack([time, np.cos(time), 5 + np.sin(0.3 * time)], axis=-1)
    arm = np.stack([np.cos(time), np.sin(time), 0.5 * np.cos(0.7 * time)], axis=-1)
    arm *= ((length + sway * np.sin(3 * time)) / 2 / np.linalg.norm(arm, axis=1))[:, None]
    sd = np.array([0.003, 0.003, 0.02]) * rng.uniform(0.5, 2, (n, 1))
    covariance = np.zeros((n, 3, 3))
    covariance[:, range(3), range(3)] = sd**2
    ends = [middle + side * arm + rng.normal(size=(n, 3)) * sd for side in (1, -1)]
    return ends, covariance


def test_the_length_of_a_wand_without_bias_and_with_an_honest_error():
    error, z, naive = [], [], []
    for seed in range(60):
        (first, second), covariance = wand(seed)
        first[::25] += 0.5  # 4 % are somewhere else
        found = between_points(first, second, 2 * covariance)
        error.append(found.length - 0.5)
        z.append(error[-1] / found.sd)
        naive.append(np.median(np.linalg.norm(first - second, axis=1)) - 0.5)
    assert np.mean(naive) > 3e-4
    assert abs(np.mean(error)) < 2.5e-4  # uncorrected weights 1.3e-3
    assert 0.6 < np.mean(np.square(z)) < 1.8


def test_errors_that_hang_together_make_the_mean_less_certain():
    (first, second), covariance = wand(3)
    rng = np.random.default_rng(0)
    slow = np.repeat(rng.normal(0, 0.01, (20, 1)), 20, axis=0)
    unit = (first - second) / np.linalg.norm(first - second, axis=1, keepdims=True)
    plain = between_points(first, second, 2 * covariance)
    found = between_points(first + slow * unit, second, 2 * covariance)
    assert found.sd > 2 * plain.sd
    assert 0.5 < found.sd / (0.01 / np.sqrt(20)) < 2


def test_a_body_that_stretches_is_told_and_averaged():
    (first, second), covariance = wand(4, sway=0.1)  # a sine of sd 0.1 · 0.71 / 0.5 = 14 %
    found = between_points(first, second, 2 * covariance, "nose–tail")
    assert "nose–tail varies by 14 %" in found.notes[0]
    assert abs(found.length - 0.5) < 0.02
    (first, second), covariance = wand(5)
    first[:100] = np.nan
    assert between_points(first, second, covariance).n <= 300
    with pytest.raises(InputError, match="cannot be measured"):
        between_points(first[:100], second[:100], covariance[:100])


def scene_tracks(ends, covariance) -> SceneTracks:
    n = len(covariance)
    nothing = np.full(2 * n, np.nan)
    source = np.zeros(2 * n, int)
    source[5] = 1
    return SceneTracks(
        individuals=("front", "back"),
        individual=np.repeat([0, 1], n),
        frame=np.tile(np.arange(n), 2),
        position=np.concatenate(ends),
        covariance=np.tile(covariance, (2, 1, 1)),
        source=source,
        n_views=np.full(2 * n, 2),
        reprojection_median=nothing,
        reprojection_max=nothing,
        distance=(),
        used=(),
        smooth=False,
    )


def test_cameras_and_wand_give_one_scale_in_any_gauge():
    cameras, tracks = rigid_pair(5), scene_tracks(*wand(5))
    known = [parse_distance("cam_a-cam_b=0.6"), parse_distance("tracks:front-back=0.5+-0.001")]
    rng = np.random.default_rng(1)
    found = []
    for _ in range(20):
        gauge = Similarity(
            float(np.exp(rng.normal(0, 2))),
            Rotation.random(random_state=rng).as_matrix(),
            rng.normal(0, 9, 3),
        )
        moved, points = [camera.moved(gauge) for camera in cameras], tracks.moved(gauge)
        resolved = [resolve(one, moved, points.individuals) for one in known]
        estimate = scene_scale([(one, measure_distance(one, moved, points)) for one in resolved])
        found.append([estimate.factor * gauge.scale, estimate.relative_sd, estimate.chi2, *estimate.residual])
        assert estimate.measured[1].n <= 399  # a single-view point does not count
    np.testing.assert_allclose(found, np.broadcast_to(found[0], np.shape(found)), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(np.array(found)[:, 0], found[0][0], rtol=1e-9)
    assert abs(found[0][0] - 1) < 3 * found[0][1]


def measured(length: float, sd: float = 0.0) -> MeasuredDistance:
    return MeasuredDistance(length, sd, 10, sd)


def test_the_scale_is_the_weighted_mean_of_the_logarithms():
    known = [KnownDistance("cameras", "a", "b", 2.0, 0.02), KnownDistance("cameras", "a", "c", 3.0, 0.09)]
    estimate = scene_scale([(known[0], measured(1.0)), (known[1], measured(1.55))])
    log, weight = np.log([2.0, 3 / 1.55]), 1 / np.array([0.01, 0.03]) ** 2
    np.testing.assert_allclose(np.log(estimate.factor), (weight * log).sum() / weight.sum(), rtol=1e-12)
    np.testing.assert_allclose(estimate.relative_sd, weight.sum() ** -0.5, rtol=1e-9)
    np.testing.assert_allclose(estimate.residual, [2 - estimate.factor, 3 - 1.55 * estimate.factor])
    assert not estimate.notes
    one = scene_scale([(known[0], measured(1.0, 0.01))])
    np.testing.assert_allclose([one.factor, one.relative_sd], [2.0, np.sqrt(2e-4)])


def test_distances_that_do_not_agree_are_told_and_widen_the_error():
    pairs = ("ab", "ac", "bc", "ad")
    known = [KnownDistance("cameras", *pair, 1.0, 0.001) for pair in pairs]
    lengths = [measured(1.0), measured(1.0), measured(1.05), measured(1.0)]
    estimate = scene_scale(list(zip(known, lengths, strict=True)))
    assert "b–c says a scale 4.8 % smaller" in estimate.notes[-1]
    assert estimate.relative_sd > 0.005
    two = scene_scale([(known[0], lengths[0]), (known[2], lengths[2])])
    assert "a–b and b–c do not agree" in two.notes[-1]
    with pytest.raises(InputError, match="needs a known distance"):
        scene_scale([])


def test_the_robust_mean_turns_with_its_values_and_ignores_outliers():
    rng = np.random.default_rng(2)
    values = rng.normal(size=(300, 3)) * [1, 2, 0.5] + [10, 0, 5]
    values[::6] += 40
    turn = Rotation.random(random_state=3).as_matrix()
    mean, weight = robust_mean(values)
    np.testing.assert_allclose(robust_mean(3 * values @ turn.T)[0], 3 * turn @ mean, rtol=1e-9)
    np.testing.assert_allclose(mean, [10, 0, 5], atol=0.4)
    assert not weight[::6].any()
    np.testing.assert_allclose(robust_mean(np.ones((4, 3)))[0], 1)
