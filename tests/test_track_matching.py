"""The whole matching on simulated recordings that it was not tuned on, and on hard edges."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.match_metrics import score_matching
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_matching import MatchOptions, TrackMatches, match_tracks
from acino_fte.data_tools.tracks2d import TrackRecording, Tracks2D
from acino_fte.errors import InputError

HARD = {"tracks": "fragments", "missed": 0.1, "clutter": 0.1}
SWAP = {"swap_px": 10.0, "missed": 0.05}


def simulated(**options) -> TrackRecording:
    return simulate_tracks(TrackSimulation(**{"n_animals": 6, "n_frames": 100, "seed": 11} | options))


def matched(recording: TrackRecording, **options) -> TrackMatches:
    """Matched without a warning, and in itself consistent."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        matches = match_tracks(recording, MatchOptions(**options))
    assert_sound(matches)
    return matches


def assert_sound(matches: TrackMatches) -> None:
    """No animal twice in one frame of a view; confidence just where there is a group; groups in two views."""
    views: list[set[int]] = [set() for _ in range(matches.n_groups)]
    for k, (view, group, sure, piece) in enumerate(
        zip(matches.recording.views, matches.groups, matches.confidence, matches.pieces, strict=True)
    ):
        assert group.shape == sure.shape == piece.shape == view.frame.shape
        seen = np.stack([view.frame[group >= 0], group[group >= 0]], axis=1)
        assert len(np.unique(seen, axis=0)) == len(seen)
        np.testing.assert_array_equal(np.isfinite(sure), group >= 0)
        assert ((sure[group >= 0] >= 0) & (sure[group >= 0] <= 1)).all()
        for g in np.unique(group[group >= 0]):
            views[g].add(k)
    assert all(len(which) >= 2 for which in views)
    assert ((matches.rival_probability >= 0) & (matches.rival_probability <= 1)).all()


def pooled(matches: TrackMatches):
    return score_matching(matches.recording, matches.groups, errors_3d=False).pooled


@pytest.mark.parametrize("motion", ["smooth", "jumpy"])
@pytest.mark.parametrize(
    ("fault", "precision", "recall"),
    [
        ({}, 0.9999, 0.9999),
        ({"tracks": "fragments"}, 0.999, 0.998),
        (HARD, 0.998, 0.997),
        (SWAP, 0.995, 0.92),
    ],
)
def test_twenty_animals_on_fresh_seeds(motion, fault, precision, recall):
    matches = matched(simulated(motion=motion, n_animals=20, n_frames=600, seed=777, **fault))
    found = pooled(matches)
    assert found.precision >= precision
    assert found.recall >= recall
    assert matches.noise.total == pytest.approx(3.0, rel=0.1)


def test_a_hundred_animals_on_a_fresh_seed():
    found = pooled(matched(simulated(motion="smooth", n_animals=100, n_frames=300, seed=778, **HARD)))
    assert found.precision >= 0.998
    assert found.recall >= 0.995


@pytest.mark.parametrize(
    ("n_cameras", "lens", "moving"),
    [
        (3, "distorted", False),
        (3, "fisheye", True),
        (4, "pinhole", True),
        (5, "fisheye", False),
        (8, "distorted", True),
    ],
)
def test_rings_of_cameras(n_cameras, lens, moving):
    found = pooled(
        matched(
            simulated(
                motion="smooth",
                rig="ring",
                n_cameras=n_cameras,
                lens=lens,
                moving=moving,
                n_animals=8,
                **HARD,
            )
        )
    )
    assert found.precision >= 0.998
    assert found.recall >= 0.997


@pytest.mark.parametrize("motion", ["flock", "perched"])
@pytest.mark.parametrize("sigma", [0.5, 3.0, 8.0])
def test_three_views_of_animals_that_keep_together(motion, sigma):
    found = pooled(
        matched(
            simulated(
                motion=motion,
                rig="ring",
                n_cameras=3,
                n_animals=10,
                n_frames=200,
                noise_px=sigma,
                tracks="fragments",
            )
        )
    )
    assert found.precision >= 0.99
    assert found.recall >= 0.98


def test_a_third_view_helps():
    """Short fragments in much noise: three cameras at once find more than they do two by two."""
    recording = simulated(
        rig="ring",
        n_cameras=3,
        n_animals=25,
        n_frames=50,
        noise_px=8.0,
        tracks="fragments",
        piece_frames=(3, 6),
    )
    together = pooled(matched(recording, follow=False))
    right = accepted = 0
    for pair in ((0, 1), (0, 2), (1, 2)):
        two = replace(
            recording,
            cameras=CameraArray(tuple(recording.cameras[k] for k in pair)),
            views=tuple(recording.views[k] for k in pair),
        )
        alone = pooled(matched(two, follow=False))
        right, accepted = right + alone.right, accepted + alone.accepted
    assert together.right > right
    assert together.precision > right / accepted


@settings(max_examples=12)
@given(
    seed=st.integers(0, 10_000),
    n_animals=st.integers(1, 8),
    n_frames=st.integers(1, 60),
    n_cameras=st.integers(2, 4),
    motion=st.sampled_from(["smooth", "perched", "flock"]),
    tracks=st.sampled_from(["whole", "fragments", "bare"]),
    clutter=st.sampled_from([0.0, 0.5]),
    missed=st.sampled_from([0.0, 0.5]),
    sigma=st.sampled_from([0.0, 0.3, 10.0]),
    moving=st.booleans(),
)
def test_any_recording_is_matched_soundly(
    seed, n_animals, n_frames, n_cameras, motion, tracks, clutter, missed, sigma, moving
):
    recording = simulate_tracks(
        TrackSimulation(
            n_animals=n_animals,
            n_frames=n_frames,
            rig="ring",
            n_cameras=n_cameras,
            moving=moving,
            motion=motion,
            tracks=tracks,
            piece_frames=(1, 20),
            clutter=clutter,
            missed=missed,
            noise_px=sigma,
            seed=seed,
        )
    )
    if sum(len(view) > 0 for view in recording.views) < 2:
        return
    matched(recording)


def test_rows_in_any_order_and_frames_from_any_number():
    """The result belongs to the rows, not to their order or to where the frames begin."""
    recording = simulated(**HARD)
    first = matched(recording)
    rng = np.random.default_rng(1)
    order = [rng.permutation(len(view)) for view in recording.views]
    shuffled = replace(
        recording,
        views=tuple(
            replace(view.at_rows(o), frame=view.frame[o] + 80_000)
            for view, o in zip(recording.views, order, strict=True)
        ),
    )
    second = matched(shuffled)
    for a, b, o in zip(first.groups, second.groups, order, strict=True):
        assert (a[o] == b).mean() > 0.999


def test_negative_frames_and_long_gaps():
    recording = simulated()
    for shift in (lambda f: f - 500, lambda f: np.where(f > 50, f + 50_000, f)):
        views = tuple(replace(view, frame=shift(view.frame)) for view in recording.views)
        assert pooled(matched(replace(recording, views=views))).recall > 0.99


def test_what_one_view_alone_sees_stays_alone():
    """Animal 3 is hidden from the second camera."""
    recording = simulated()
    views = (recording.views[0], recording.views[1].at_rows(recording.views[1].animal != 3))
    matches = matched(replace(recording, views=views))
    assert (matches.groups[0][recording.views[0].animal == 3] < 0).all()
    assert pooled(matches).precision == 1.0


def test_views_that_never_see_together():
    recording = simulated()
    views = tuple(v.at_rows((v.frame < 50) == bool(k)) for k, v in enumerate(recording.views))
    assert matched(replace(recording, views=views)).n_groups == 0


@pytest.mark.parametrize("which", [(0,), (1,), (0, 1), (0, 1, 2)])
def test_views_of_bare_points(which):
    recording = simulated(rig="ring", n_cameras=3)
    views = tuple(v.without_tracks() if k in which else v for k, v in enumerate(recording.views))
    found = pooled(matched(replace(recording, views=views)))
    if len(which) == 1:
        assert found.precision > 0.99


def test_a_view_without_dots_and_one_with_a_single_dot():
    recording = simulated(rig="ring", n_cameras=3)
    for n in (0, 1):
        views = (*recording.views[:2], recording.views[2].at_rows(np.arange(n)))
        assert pooled(matched(replace(recording, views=views))).recall > 0.99


@pytest.mark.parametrize("n_frames", [1, 2, 5])
def test_very_short_recordings(n_frames):
    found = pooled(matched(simulated(n_frames=n_frames, n_animals=4)))
    assert not found.accepted or found.precision >= 0.75


def test_two_cameras_in_one_place_beside_a_third():
    """They say nothing about each other; the third joins them."""
    recording = simulated(rig="ring", n_cameras=2)
    a, b = recording.cameras
    turned = replace(a, name="again")
    views = (*recording.views, replace(recording.views[0], camera="again"))
    both = replace(recording, cameras=CameraArray((a, b, turned)), views=views)
    assert pooled(matched(both)).recall > 0.99


def test_the_same_dots_tracked_twice():
    """Every animal has two tracks in each view: which goes with which is a toss-up; nothing else is wrong."""
    recording = simulated()
    views = tuple(
        Tracks2D(
            v.camera,
            np.tile(v.frame, 2),
            np.concatenate([v.track, v.track + len(v.labels)]),
            np.tile(v.xy, (2, 1)),
            v.labels + tuple(f"{label}b" for label in v.labels),
            np.tile(v.animal, 2),
        )
        for v in recording.views
    )
    found = pooled(matched(replace(recording, views=views)))
    assert found.right == found.accepted


def test_given_noise_is_kept_and_wrong_options_are_refused():
    recording = simulated()
    assert matched(recording, noise_px=2.5).noise.total == pytest.approx(2.5, rel=1e-3)
    for wrong in (
        {"noise_px": 0.0},
        {"noise_px": -1.0},
        {"noise_px": np.nan},
        {"max_gap_s": -1.0},
        {"min_confidence": 2.0},
    ):
        with pytest.raises(InputError, match=next(iter(wrong))):
            match_tracks(recording, MatchOptions(**wrong))


def test_least_confidence():
    recording = simulated(
        n_animals=40, noise_px=8.0, tracks="fragments", piece_frames=(2, 5), clutter=0.3, n_frames=30
    )
    least = [pooled(matched(recording, min_confidence=c, follow=False)) for c in (0.0, 0.5, 0.99)]
    assert least[0].accepted >= least[1].accepted >= least[2].accepted
    assert least[2].precision >= least[0].precision


def test_progress_tells_every_step():
    steps: list[str] = []
    match_tracks(simulated(), progress=steps.append)
    assert steps[0] == "noise"
    assert len(steps) >= 4
    assert all(steps)


def test_cameras_in_one_place_are_refused():
    recording = simulated()
    a, b = recording.cameras
    same = replace(b, rotation=a.rotation, translation=a.translation)
    with pytest.raises(InputError, match="stand apart"):
        match_tracks(replace(recording, cameras=CameraArray((a, same))))
    empty = tuple(v.at_rows(np.arange(0 if k else len(v))) for k, v in enumerate(recording.views))
    with pytest.raises(InputError, match="fewer than two"):
        match_tracks(replace(recording, views=empty))
