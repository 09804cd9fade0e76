"""Simulated recordings of animals without markers: motions, rigs, faults, and their folder."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
import pytest

from acino_fte.cameras import Camera
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_folder import write_tracks
from acino_fte.data_tools.track_motions import BOXES, MOTIONS, animal_paths
from acino_fte.errors import InputError

RING = TrackSimulation(n_animals=6, n_frames=80, motion="smooth", rig="ring", n_cameras=4)


def truth_at(recording, view):
    """True positions (P, 3) of the rows of a view."""
    table = recording.truth_3d.sort_values(["frame", "animal"])
    paths = table[["x", "y", "z"]].to_numpy().reshape(table.frame.nunique(), -1, 3)
    return paths[view.frame, view.animal]


def steps(motion, n_animals=60, fps=30.0, n_frames=600):
    paths = animal_paths(motion, n_animals, n_frames, fps, BOXES[motion], np.random.default_rng(1))
    return paths, np.diff(paths, axis=0)


def correlation(step, lag):
    return float(np.mean((step[lag:] * step[:-lag]).mean((0, 1)) / step.var((0, 1))))


@pytest.mark.parametrize("motion", MOTIONS)
def test_animals_stay_where_they_live(motion):
    paths, step = steps(motion)
    low, high = np.array(BOXES[motion])
    margin = {"jumpy": 0.17, "perched": 0.4}.get(motion, 1e-9)  # a step; the arch of a flight
    assert (paths > low - margin).all() and (paths < high + margin).all()
    assert np.isfinite(paths).all() and np.abs(step).max() < 0.5


@pytest.mark.parametrize(
    ("motion", "mean", "middle", "one", "five"),
    [("smooth", 9.47, 9.61, 0.754, -0.22), ("jumpy", 4.55, 4.66, 0.583, 0.15)],
)
def test_motions_of_the_thesis(motion, mean, middle, one, five):
    """Against statistics of the reference sets (text_n100, code_n100), measured once."""
    _, step = steps(motion)
    speed = np.linalg.norm(step, axis=-1) * 30
    assert speed.mean() == pytest.approx(mean, rel=0.02)
    assert np.median(speed) == pytest.approx(middle, rel=0.02)
    assert correlation(step, 1) == pytest.approx(one, abs=0.03)
    assert correlation(step, 5) == pytest.approx(five, abs=0.06)


@pytest.mark.parametrize("motion", ["smooth", "jumpy"])
def test_speed_does_not_depend_on_the_frame_rate(motion):
    slow, fast = (np.linalg.norm(steps(motion, fps=fps)[1], axis=-1) * fps for fps in (30.0, 120.0))
    assert np.median(fast) == pytest.approx(np.median(slow), rel=0.05)


def test_perched_birds_sit_and_now_and_then_fly():
    paths, step = steps("perched")
    speed = np.linalg.norm(step, axis=-1) * 30
    assert 0.8 < (speed < 0.1).mean() < 0.99
    assert speed.max() > 2.0
    heights = np.round(paths[0, :, 1:], 1)
    assert len(np.unique(heights, axis=0)) <= 9  # three perches along x


def test_a_flock_moves_together():
    _, step = steps("flock", n_animals=10)
    own = step - step.mean(axis=1, keepdims=True)
    assert np.linalg.norm(own, axis=-1).mean() < 0.3 * np.linalg.norm(step, axis=-1).mean()


@pytest.mark.parametrize("rig", ["thesis", "ring"])
@pytest.mark.parametrize("lens", ["pinhole", "distorted", "fisheye"])
def test_rows_are_projections_with_the_noise_asked_for(rig, lens):
    options = replace(
        RING, rig=rig, lens=lens, n_cameras=4 if rig == "ring" else 2, noise_px=2.0, n_frames=200
    )
    recording = simulate_tracks(options)
    for camera, view in zip(recording.cameras, recording.views, strict=True):
        points = truth_at(recording, view)
        rvec = cv2.Rodrigues(camera.rotation)[0]
        if lens == "fisheye":
            arguments = (points[:, None], rvec, camera.translation, camera.matrix, camera.distortion)
            pixels = cv2.fisheye.projectPoints(*arguments)[0][:, 0]
        else:
            pixels = cv2.projectPoints(points, rvec, camera.translation, camera.matrix, camera.distortion)[0][
                :, 0
            ]
        error = view.xy - pixels
        assert error.std() == pytest.approx(2.0, rel=0.06)
        assert abs(error.mean()) < 0.3
        assert camera.inside(view.xy).all()
        assert len(view) > 0.9 * options.n_animals * options.n_frames  # the rig sees what it is about


def test_moving_cameras_sway_and_see():
    recording = simulate_tracks(replace(RING, moving=True, noise_px=0.0))
    for camera, view in zip(recording.cameras, recording.views, strict=True):
        assert camera.rotation.shape == (80, 3, 3)
        centre = camera.centre
        assert 0.02 < np.linalg.norm(centre - centre[0], axis=1).max() < 0.5
        table = recording.truth_3d.sort_values(["frame", "animal"])
        exact = camera.project(table[["x", "y", "z"]].to_numpy().reshape(80, 6, 3))
        np.testing.assert_allclose(view.xy, exact[view.frame, view.animal], atol=1e-9)


def test_animals_outside_an_image_have_no_row():
    box = ((-3.0, -0.5, 3.0), (5.0, 0.5, 4.0))  # wider than the images
    recording = simulate_tracks(TrackSimulation(n_animals=20, n_frames=300, box=box, noise_px=0.0))
    for camera, view in zip(recording.cameras, recording.views, strict=True):
        table = recording.truth_3d
        inside = camera.inside(camera.project(table[["x", "y", "z"]].to_numpy()))
        assert len(view) == inside.sum() < len(table)
        assert {*zip(view.frame, view.animal, strict=True)} == {
            *zip(table.frame[inside], table.animal[inside], strict=True)
        }


def test_the_same_seed_gives_the_same_recording():
    options = replace(RING, tracks="fragments", missed=0.1, clutter=0.1)
    first, again, other = (simulate_tracks(replace(options, seed=seed)) for seed in (3, 3, 4))
    for a, b, c in zip(first.views, again.views, other.views, strict=True):
        np.testing.assert_array_equal(a.xy, b.xy)
        np.testing.assert_array_equal(a.track, b.track)
        assert len(a) != len(c) or not np.array_equal(a.xy, c.xy)


def test_faults_leave_the_motion_alone():
    plain, faulty = (
        simulate_tracks(RING),
        simulate_tracks(replace(RING, tracks="bare", clutter=0.3, noise_px=0.0)),
    )
    pd.testing.assert_frame_equal(plain.truth_3d, faulty.truth_3d)
    np.testing.assert_array_equal(plain.cameras[2].rotation, faulty.cameras[2].rotation)


def test_whole_tracks_are_one_animal_each_under_another_name():
    recording = simulate_tracks(TrackSimulation(n_animals=20, n_frames=100))
    assert len(recording.views) == 2
    for view in recording.views:
        animal = {t: set(view.animal[view.track == t]) for t in range(20)}
        assert all(len(found) == 1 for found in animal.values())
        assert [next(iter(animal[t])) for t in range(20)] != list(range(20))
        assert view.labels == tuple(map(str, range(20)))
        assert (np.diff(view.frame) >= 0).all()


def test_fragments_are_pieces_of_one_animal_cut_differently_in_each_view():
    options = TrackSimulation(n_animals=60, tracks="fragments", piece_frames=(20, 100))
    begins = []
    for view in simulate_tracks(options).views:
        frames = pd.DataFrame({"t": view.track, "f": view.frame, "a": view.animal}).groupby("t")
        assert (frames.a.nunique() == 1).all()
        span = frames.f.max() - frames.f.min() + 1
        assert span.max() <= 100
        inner = ((frames.f.max() < 599) & (frames.f.min() < 300)).to_numpy()
        assert span[inner].min() >= 20 and span[inner].mean() == pytest.approx(60, abs=3)
        begins.append({*zip(frames.a.first(), frames.f.min(), strict=True)})
    assert len(begins[0] & begins[1]) < 0.3 * len(begins[0])


def test_missed_rows_and_clutter_have_the_share_asked_for():
    clean = simulate_tracks(TrackSimulation(n_animals=20))
    dirty = simulate_tracks(TrackSimulation(n_animals=20, missed=0.1, clutter=0.2))
    for a, b in zip(clean.views, dirty.views, strict=True):
        false = b.animal < 0
        assert (~false).sum() == pytest.approx(0.9 * len(a), rel=0.01)
        assert false.sum() == pytest.approx(0.2 * (~false).sum(), rel=0.001)
        lengths = np.bincount(b.track[false])
        assert set(lengths[lengths > 0]) == {1, 2, 3}
        assert not set(b.track[false]) & set(b.track[~false])
        first = pd.DataFrame({"t": b.track[false], "f": b.frame[false]}).groupby("t").f
        assert (first.max() - first.min() == first.size() - 1).all()  # of neighbouring frames
        assert dirty.cameras[0].inside(b.xy).all()


def test_identities_are_exchanged_only_at_encounters():
    options = TrackSimulation(n_animals=20, n_frames=300, swap_px=10.0, swap_chance=1.0)
    never = simulate_tracks(replace(options, swap_chance=0.0))
    assert all(len(set(zip(v.track, v.animal, strict=True))) == 20 for v in never.views)
    distances = []
    for view in simulate_tracks(options).views:
        animal, xy = np.full((300, 20), -1), np.full((300, 20, 2), np.nan)
        animal[view.frame, view.track] = view.animal
        xy[view.frame, view.animal] = view.xy
        changed = (animal[1:] != animal[:-1]) & (animal[1:] >= 0) & (animal[:-1] >= 0)
        for frame, track in np.argwhere(changed):
            before, after = animal[frame : frame + 2, track]
            distances.append(np.linalg.norm(xy[frame + 1, before] - xy[frame + 1, after]))
    assert len(distances) > 100
    assert np.nanpercentile(distances, 95) < 10.0  # three at once may exchange in a ring


def test_bare_points_have_no_track():
    for view in simulate_tracks(replace(RING, tracks="bare", clutter=0.1)).views:
        assert (view.track == -1).all() and view.labels == ()
        assert (view.animal == -1).any()


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"motion": "swim"}, "motion"),
        ({"n_animals": 0}, "n_animals"),
        ({"noise_px": -1.0}, "noise_px"),
        ({"missed": 1.5}, "missed"),
        ({"piece_frames": (30, 20)}, "piece_frames"),
        ({"moving": True}, "rig"),
        ({"swap_px": 10.0, "tracks": "fragments"}, "swap_px"),
        ({"box": ((0, 0, 0), (1, 0, 1))}, "box"),
    ],
)
def test_options_that_cannot_be(change, key):
    with pytest.raises(InputError) as caught:
        TrackSimulation(**change)
    assert caught.value.key == key


def test_the_folder_holds_what_was_simulated(tmp_path):
    recording = simulate_tracks(TrackSimulation(n_animals=5, n_frames=40, clutter=0.1))
    folder = write_tracks(recording, tmp_path / "birds")
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "cameras.json",
        "cam0.csv",
        "cam0_truth.csv",
        "cam1.csv",
        "cam1_truth.csv",
        "truth_3d.csv",
    }
    for n, view in enumerate(recording.views):
        table = pd.read_csv(folder / f"cam{n}.csv")
        assert list(table) == ["frame", "track", "x", "y"]
        np.testing.assert_array_equal(table.frame, view.frame)
        np.testing.assert_array_equal(table.track, [int(view.labels[t]) for t in view.track])
        np.testing.assert_allclose(table[["x", "y"]], view.xy, atol=5.1e-5)
        np.testing.assert_array_equal(pd.read_csv(folder / f"cam{n}_truth.csv").animal, view.animal)
    entries = json.loads((folder / "cameras.json").read_text())
    for entry, camera in zip(entries, recording.cameras, strict=True):
        read = Camera(
            "c",
            "pinhole",
            entry["K"],
            entry["dist_opencv"],
            entry["R"],
            entry["t"],
            tuple(entry["image_size"]),
        )
        points = recording.truth_3d[["x", "y", "z"]].to_numpy()
        np.testing.assert_array_equal(read.project(points), camera.project(points))
    truth = pd.read_csv(folder / "truth_3d.csv")
    np.testing.assert_allclose(truth, recording.truth_3d, atol=5.1e-7)


def test_bare_points_and_moving_cameras_in_a_folder(tmp_path):
    from acino_fte.data_tools.calibration import read_cameras

    recording = simulate_tracks(replace(RING, moving=True, lens="fisheye", tracks="bare"))
    folder = write_tracks(recording, tmp_path / "birds")
    assert pd.read_csv(folder / "cam3.csv").track.isna().all()
    for read, camera in zip(read_cameras(folder / "cameras.json"), recording.cameras, strict=True):
        np.testing.assert_array_equal(read.rotation, camera.rotation)


def test_a_folder_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    recording = simulate_tracks(TrackSimulation(n_animals=2, n_frames=5))
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine.txt").write_text("mine")
    with pytest.raises(InputError):
        write_tracks(recording, tmp_path / "taken")
    assert [p.name for p in (tmp_path / "taken").iterdir()] == ["mine.txt"]
    monkeypatch.setattr(json, "dumps", lambda *a, **k: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_tracks(recording, tmp_path / "birds")
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]
