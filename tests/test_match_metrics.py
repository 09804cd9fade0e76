"""Scores of a matching: cases counted by hand, a slow count of the definitions, and triangulated errors."""

import json
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from conftest import cameras_about

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.match_metrics import score_matching
from acino_fte.data_tools.match_rows import triangulate_pairs
from acino_fte.data_tools.tracks2d import TrackRecording, Tracks2D
from acino_fte.errors import InputError


def view(name, frame, animal, xy=None):
    n = len(frame)
    return Tracks2D(
        name,
        np.array(frame, dtype=int),
        np.full(n, -1),
        np.zeros((n, 2)) if xy is None else xy,
        (),
        None if animal is None else np.array(animal, dtype=int),
    )


def recording(*views, cameras=None, truth_3d=None):
    cameras = cameras or CameraArray(tuple(cameras_about(n=4))[: len(views)])
    named = tuple(
        Tracks2D(c.name, v.frame, v.track, v.xy, v.labels, v.animal)
        for c, v in zip(cameras, views, strict=True)
    )
    return TrackRecording("case", cameras, named, truth_3d=truth_3d)


def score(views, *groups):
    return score_matching(recording(*views), [np.array(g, dtype=int) for g in groups])


def test_pairs_by_hand():
    """Frame 0: one wrong pair. Frame 1: one right, one with clutter, one animal that only A sees."""
    a = view("A", [0, 0, 1, 1, 1], [7, 8, 7, 8, 9])
    b = view("B", [0, 0, 1, 1], [8, 7, 7, -1])
    found = score((a, b), [0, 1, 0, 1, 2], [0, 5, 0, 1])
    pair = found.pooled
    assert (pair.accepted, pair.right, pair.possible, pair.rows, pair.shared_rows) == (3, 1, 3, 5, 3)
    assert pair.precision == 1 / 3
    assert pair.recall == 1 / 3
    assert pair.udr == 3 / 5
    assert pair.udr_ceiling == 3 / 5
    assert pair.trajectories == 2  # 9 is never seen by both


def test_frames_are_kept_apart():
    """The same group in different frames is no pair."""
    found = score((view("A", [0, 1], [0, 0]), view("B", [2, 3], [0, 0])), [4, 4], [4, 4])
    assert found.pooled.accepted == 0
    assert np.isnan(found.pooled.precision)
    assert found.pooled.trajectories == 0


def test_a_group_with_two_rows_in_a_frame_makes_every_pair():
    found = score((view("A", [0, 0], [0, 1]), view("B", [0], [0])), [3, 3], [3])
    assert (found.pooled.accepted, found.pooled.right) == (2, 1)


def test_trajectories_by_majority_and_unique():
    """0 right by majority; 1 and 2 share one group; 3 has different groups in the two views; 4 unmatched."""
    frames = np.repeat([0, 1, 2], 5)
    animals = [0, 1, 2, 3, 4] * 3
    views = view("A", frames, animals), view("B", frames, animals)
    in_a = [0, 1, 1, 3, -1, 0, 1, 1, 3, -1, 9, 1, 1, 3, -1]
    in_b = [0, 1, 1, 4, -1, 0, 1, 1, 4, -1, 0, 1, 1, 3, -1]
    pooled = score(views, in_a, in_b).pooled
    assert (pooled.trajectories, pooled.right_trajectories) == (5, 1)
    assert pooled.trajectories_right == 0.2


def test_an_animal_may_miss_in_a_view():
    """Three views; animal 1 is not in C. Each pair and the whole are judged over those that see it."""
    a, b = view("A", [0, 0], [0, 1]), view("B", [0, 0], [0, 1])
    c = view("C", [0], [0])
    found = score((a, b, c), [0, 1], [0, 1], [2])
    assert [(p.first[-1], p.second[-1], p.trajectories, p.right_trajectories) for p in found.pairs] == [
        (p.first[-1], p.second[-1], t, r) for p, t, r in zip(found.pairs, [2, 1, 1], [2, 0, 0], strict=True)
    ]
    assert (found.pooled.trajectories, found.pooled.right_trajectories) == (2, 1)
    assert found.pooled.accepted == 2
    assert found.pooled.possible == 4


def test_switches_pass_over_unmatched_rows_and_unordered_frames():
    a = view("A", [3, 0, 1, 2, 0, 1], [5, 5, 5, 5, 6, 6])
    b = view("B", [0, 1], [5, 5])
    # animal 5 in frames 0..3: 1, none, 1, 2 (one switch); animal 6: 2, 1 (one); in B: 1, 1
    found = score((a, b), [2, 1, -1, 1, 2, 1], [1, 1])
    assert found.identity_switches == 2
    assert found.fragments_per_animal == (2 + 2) / 2


def test_purity_by_hand():
    """Group 0: animals 0, 0, 1 and one clutter (2 of 4); group 1: animal 2 (1 of 1)."""
    a = view("A", [0, 1, 2, 3], [0, 0, 1, -1])
    b = view("B", [0, 1], [2, 2])
    assert score((a, b), [0, 0, 0, 0], [1, -1]).purity == 3 / 5


def slow_counts(views, groups):
    """Pairs accepted, right and possible, row by row."""
    accepted = right = possible = 0
    for i, j in combinations(range(len(views)), 2):
        for p in range(len(views[i])):
            for q in range(len(views[j])):
                if views[i].frame[p] != views[j].frame[q]:
                    continue
                same = views[i].animal[p] == views[j].animal[q] >= 0
                possible += same
                if groups[i][p] == groups[j][q] >= 0:
                    accepted += 1
                    right += same
    return accepted, right, possible


@pytest.mark.parametrize("wide", [False, True], ids=["dense numbers", "sparse numbers"])
def test_equals_a_slow_count(wide):
    rng = np.random.default_rng(3)
    views, groups = [], []
    for name in "ABC":
        frame, animal = np.divmod(rng.permutation(12 * 6), 6)
        keep = rng.random(72) < 0.8
        animal = np.where(rng.random(72) < 0.1, -1, animal)
        group = np.where(rng.random(72) < 0.2, -1, rng.integers(0, 9, 72))
        if wide:
            group = np.where(group >= 0, group * 10**12 + 17, -1)
            animal = np.where(animal >= 0, animal * 10**9, -1)
        views.append(view(name, frame[keep] - 5, animal[keep]))
        groups.append(group[keep])
    pooled = score(views, *groups).pooled
    assert (pooled.accepted, pooled.right, pooled.possible) == slow_counts(views, groups)


def world(n_frames=40, n_animals=3, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.8, 0.8, (n_frames, n_animals, 3))
    frame, animal = (g.ravel() for g in np.mgrid[:n_frames, :n_animals])
    table = pd.DataFrame(
        {"frame": frame, "animal": animal, **dict(zip("xyz", points.reshape(-1, 3).T, strict=True))}
    )
    return points, frame, animal, table


def test_errors_of_right_pairs():
    """Exact pixels give exact points; a shift of the truth is found again; wrong pairs do not count."""
    points, frame, animal, table = world()
    cameras = CameraArray(tuple(cameras_about(n=4))[:2])
    pixels = cameras.project(points)
    views = [view(c.name, frame, animal, pixels[:, i].reshape(-1, 2)) for i, c in enumerate(cameras)]
    group = animal.copy()
    wrong = group.copy()
    wrong[:3] = [1, 0, 2]
    table["x"] += 0.005
    table = table[table["frame"] != 7].sample(frac=1, random_state=0)
    found = score_matching(recording(*views, cameras=cameras, truth_3d=table), [group, wrong])
    assert found.pooled.errors_mm.shape == (118,)
    assert np.isnan(found.pooled.errors_mm).sum() == 3
    numbers = found.as_dict()["right_pair_error_mm"]
    assert numbers["count"] == 115
    assert numbers["mean"] == pytest.approx(5.0, abs=1e-3)
    without = score_matching(
        recording(*views, cameras=cameras, truth_3d=table), [group, wrong], errors_3d=False
    )
    assert without.pooled.errors_mm is None


def test_pairs_of_moving_cameras_take_the_pose_of_their_frame():
    from dataclasses import replace

    points, frame, animal, _ = world(n_frames=6)
    still = tuple(cameras_about(n=4))[:2]
    moving = tuple(
        replace(c, translation=c.translation + 0.1 * np.arange(6)[:, None] * [1.0, 0.5, 0.2]) for c in still
    )
    cameras = CameraArray(moving)
    pixels = cameras.project(points)
    views = [view(c.name, frame + 50, animal, pixels[:, i].reshape(-1, 2)) for i, c in enumerate(cameras)]
    rows = np.array([17, 0, 5, 11])
    got = triangulate_pairs(recording(*views, cameras=cameras), (0, 1), (rows, rows))
    assert np.abs(got - points.reshape(-1, 3)[rows]).max() < 1e-6


def test_as_dict_is_json_even_when_nothing_is_matched():
    views = view("A", [0], [0]), view("B", [0], [-1])
    numbers = json.loads(json.dumps(score(views, [-1], [-1]).as_dict(), allow_nan=False))
    assert numbers["pairing_accuracy"] is None
    assert numbers["udr"] == 0.0
    assert numbers["purity"] is None
    assert numbers["pairs"][0]["views"] == [c.name for c in list(cameras_about(n=4))[:2]]


def test_empty_views():
    empty = view("A", [], []), view("B", [], [])
    found = score(empty, [], [])
    assert found.pooled.rows == 0
    json.dumps(found.as_dict(), allow_nan=False)


@pytest.mark.parametrize(
    ("animal", "groups", "message"),
    [
        (None, [[0], [0]], "no true animals"),
        ([0], [[0, 1], [0]], "do not belong to its rows"),
        ([0], [[0]], "different numbers of views"),
    ],
)
def test_input_that_cannot_be_scored(animal, groups, message):
    with pytest.raises(InputError, match=message):
        score((view("A", [0], animal), view("B", [0], animal)), *groups)
