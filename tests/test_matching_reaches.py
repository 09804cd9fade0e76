"""What the matching must reach on recordings that others published or that it was never tuned on."""

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.load_tracks import load_tracks
from acino_fte.data_tools.match_metrics import MatchScore, score_matching
from acino_fte.data_tools.track_matching import TrackMatches, match_tracks
from acino_fte.data_tools.tracks2d import TrackRecording, Tracks2D

TRACKS = Path(__file__).resolve().parents[2] / "shared" / "data" / "tracks"
STARLINGS = TRACKS / "starlings_AB_true_rig"
pytestmark = pytest.mark.skipif(not TRACKS.is_dir(), reason="the recordings ../shared/data/tracks are absent")


def reached(recording: TrackRecording) -> tuple[TrackMatches, MatchScore]:
    matches = match_tracks(recording)
    assert_consistent(recording, matches.groups)
    return matches, score_matching(recording, matches.groups, errors_3d=False)


def assert_consistent(recording: TrackRecording, groups) -> None:
    """No animal is in two places of one view at once."""
    for view, group in zip(recording.views, groups, strict=True):
        seen = np.stack([view.frame[group >= 0], group[group >= 0]], axis=1)
        assert len(np.unique(seen, axis=0)) == len(seen)


def made(name: str) -> TrackRecording:
    return load_tracks(TRACKS / "synthetic" / name)


@pytest.mark.parametrize(
    "name",
    [
        f"{motion}_n{n}_s{sigma}_clean_seed0"
        for motion in ("code", "text")
        for n, sigma in ((3, 3), (5, 3), (7, 3), (20, 0), (20, 3), (20, 5))
    ],
)
def test_tables_1_and_3_of_the_thesis(name):
    """Every trajectory right, all dots used that can be, the noise known within a tenth."""
    matches, found = reached(made(name))
    assert found.pooled.trajectories_right == 1.0
    assert found.pooled.precision >= 0.999
    assert found.pooled.udr >= found.pooled.udr_ceiling - 0.002
    sigma = float(name.split("_s")[1][0])
    assert matches.noise.total == pytest.approx(sigma, rel=0.1, abs=0.05)


@pytest.mark.parametrize("motion", ["code", "text"])
@pytest.mark.parametrize(
    ("fault", "precision", "recall"), [("frag", 0.999, 0.998), ("hard", 0.998, 0.997), ("swap", 0.995, 0.92)]
)
def test_twenty_animals_with_the_faults_of_trackers(motion, fault, precision, recall):
    _, found = reached(made(f"{motion}_n20_s3_{fault}_seed0"))
    assert found.pooled.precision >= precision
    assert found.pooled.recall >= recall


@pytest.mark.parametrize("motion", ["code", "text"])
def test_a_hundred_animals(motion):
    _, found = reached(made(f"{motion}_n100_s3_hard_seed0"))
    assert found.pooled.precision >= 0.998
    assert found.pooled.recall >= 0.995


@pytest.mark.parametrize(
    "name", ["starlings_A_thesis_rig", "starlings_B_thesis_rig", "starlings_AB_true_rig"]
)
def test_starlings_without_noise(name):
    _, found = reached(load_tracks(TRACKS / name))
    assert found.pooled.precision == 1.0
    assert found.pooled.recall >= 0.999


def barn() -> dict[str, Camera]:
    """All cameras of the barn, as pinholes."""
    return {
        c["id"]: Camera(
            c["id"],
            "pinhole",
            np.array(c["K"]),
            np.zeros(5),
            np.array(c["R"]),
            np.array(c["t"]),
            tuple(c["image_size"]),
        )
        for c in json.loads((STARLINGS / "all_cameras.json").read_text())
    }


def places(n_frames: int | None = None) -> np.ndarray:
    """Where the five starlings are, (N, 5, 3), m; NaN where unknown."""
    truth = pd.read_csv(STARLINGS / "truth_3d.csv")
    x = np.full((int(truth["frame"].max()) + 1, 5, 3), np.nan)
    x[truth["frame"], truth["animal"]] = truth[["x", "y", "z"]]
    return x[:n_frames]


def filmed(cameras: list[Camera], x: np.ndarray, sigma: float, seed: int) -> TrackRecording:
    """Fragments of 20–100 frames, in each view its own."""
    rng = np.random.default_rng(seed)
    views = []
    for camera in cameras:
        exact = camera.project(x)
        seen = exact + rng.normal(0, sigma, exact.shape)
        there = camera.inside(exact) & camera.inside(seen)
        ends = np.cumsum(rng.integers(20, 101, (len(x) // 20 + 1, x.shape[1])), axis=0)
        part = np.stack([np.searchsorted(e, np.arange(len(x)), side="right") for e in ends.T], axis=1)
        frame, animal = np.nonzero(there)
        _, track = np.unique((part + len(ends) * np.arange(x.shape[1]))[there], return_inverse=True)
        n = int(track.max(initial=-1)) + 1
        labels = tuple(map(str, range(n)))
        views.append(Tracks2D(camera.name, frame, rng.permutation(n)[track], seen[there], labels, animal))
    return TrackRecording("barn", CameraArray(tuple(cameras)), tuple(views), 100.0)


def best_views(n: int, x: np.ndarray) -> list[Camera]:
    """The cameras that see most, whatever comes of it."""
    cameras = barn()
    share = {name: camera.inside(camera.project(x)).mean() for name, camera in cameras.items()}
    return [cameras[name] for name in sorted(share, key=lambda name: (-share[name], name))[:n]]


@pytest.mark.parametrize(("sigma", "seed"), [(1.0, 0), (3.0, 1)])
def test_starlings_on_perches_in_fragments(sigma, seed):
    """Two cameras that see several birds in one epipolar plane."""
    cameras = [barn()[name] for name in ("2123022", "2123384")]
    _, found = reached(filmed(cameras, places(3000), sigma, seed))
    assert found.pooled.precision >= 0.99
    assert found.pooled.recall >= 0.99


def test_more_cameras_are_better_than_any_two_of_them():
    """Of 900 frames, three and then four cameras; every pair is scored in its own two views."""
    x = places(900)
    recording = filmed(best_views(4, x), x, 5.0, 7)
    for n in (3, 4):
        views = range(n)
        _, together = reached(taken(recording, views))
        pairs = [reached(taken(recording, pair))[1] for pair in combinations(views, 2)]
        assert together.pooled.precision >= 0.99
        for pair, (a, b) in zip(pairs, combinations(views, 2), strict=True):
            same = next(
                p
                for p in together.pairs
                if (p.first, p.second) == (recording.views[a].camera, recording.views[b].camera)
            )
            assert f1(same) >= f1(pair.pooled) - 1e-3, (a, b)
        assert f1(together.pooled) >= max(f1(pair.pooled) for pair in pairs) - 1e-3


def f1(score) -> float:
    return 2 * score.right / (score.accepted + score.possible)


def taken(recording: TrackRecording, views) -> TrackRecording:
    return replace(
        recording,
        cameras=CameraArray(tuple(recording.cameras[k] for k in views)),
        views=tuple(recording.views[k] for k in views),
    )
