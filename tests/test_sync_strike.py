"""The animal as pivot: lag and its uncertainty from keypoints and returns, strikes of paws, the import."""

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from acino_fte.data_tools.import_pivot import pivot_hint
from acino_fte.data_tools.sync_animal import Glimpses, animal_lag
from acino_fte.data_tools.sync_outline import nearest_link, outline_of
from acino_fte.data_tools.sync_strike import paws_of, strikes_of
from acino_fte.errors import InputError

FPS = 60.0
LINKS = ((0, 1), (0, 2), (2, 3), (1, 4), (4, 5))
NAMES = ("shoulder", "hip", "front_knee", "front_paw", "back_knee", "back_paw")


def animal(t):
    """Markers (K, 6, 2) of two legs under a back, 600 px long, that swings and sways; px at times (K,).

    Strides get shorter, so that no two times look alike.
    """
    swing = 2 * np.pi * (2.0 * t + 0.4 * t**2)
    sway = np.column_stack([40 * np.sin(2 * np.pi * 0.4 * t), 20 * np.sin(swing + 1)])
    out = np.zeros((len(t), 6, 2))
    for i, (x, phase) in enumerate(((300, 0.0), (-300, 2.0))):
        top = np.array([x, 0.0])
        upper = 0.7 * np.sin(swing + phase)
        lower = upper + 0.5 * np.sin(swing + phase - 1.2) - 0.3
        out[:, i] = top
        knee = top + 120 * np.stack([np.sin(upper), np.cos(upper)], axis=-1)
        out[:, 2 + 2 * i] = knee
        out[:, 3 + 2 * i] = knee + 120 * np.stack([np.sin(lower), np.cos(lower)], axis=-1)
    return out + sway[:, None] + np.array([1000.0, 500.0])


def detected(seed=0, n=120, noise=3.0):
    """Detections with 15 % missing and 3 % outliers: times, positions, likelihoods."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / FPS
    position = animal(t) + noise * rng.normal(size=(n, 6, 2))
    wrong = rng.random((n, 6)) < 0.03
    position[wrong] = rng.uniform(0, 2000, (int(wrong.sum()), 2))
    position[rng.random((n, 6)) < 0.15] = np.nan
    return t, position, np.where(np.isfinite(position[..., 0]), 0.9, 0.0)


def scanned(lag, seed=0, seconds=2.0, per_second=12000, before=0.0, after=0.0):
    """Returns all over the picture: of links 24 px thick at 90 m, else of grass at 120–300 m."""
    rng = np.random.default_rng([seed, 1])
    time = np.sort(rng.uniform(-before, seconds + after, round(per_second * (seconds + before + after))))
    pixel = rng.uniform([500, 300], [1500, 850], (len(time), 2))
    place = animal(time)
    apart, _, _ = nearest_link(place, np.zeros_like(place), np.array(LINKS), pixel)
    hit = (np.abs(apart) < 12) & (time > 0) & (time < seconds)
    hit &= rng.random(len(time)) > 0.1
    depth = np.where(hit, 90 + 0.1 * rng.normal(size=len(time)), rng.uniform(120, 300, len(time)))
    return Glimpses(time + lag, pixel, depth)


@pytest.fixture(scope="module")
def outline():
    return outline_of(*detected())


def test_outliers_do_not_move_the_outline(outline):
    true = animal(outline.time)
    error = np.linalg.norm(outline.pixel - true, axis=-1)
    assert np.nanquantile(error, 0.99) < 12
    assert np.isfinite(error).mean() > 0.9
    assert {tuple(sorted(e)) for e in outline.edges.tolist()} == {tuple(sorted(e)) for e in LINKS}


def test_distance_normal_and_speed_of_the_nearest_link():
    place = np.array([[[0.0, 0.0], [10.0, 0.0]]] * 3)
    rate = np.array([[[0.0, 2.0], [0.0, 4.0]]] * 3)
    edges = np.array([[0, 1]])
    distance, normal, speed = nearest_link(place, rate, edges, np.array([[5.0, 3], [5, -3], [13, 4]]))
    assert np.abs(distance) == pytest.approx([3, 3, 5])
    assert distance[:2] * normal[:2, 1] == pytest.approx([3, -3])
    assert normal[2] == pytest.approx([0.6, 0.8])
    assert speed[2] == pytest.approx(0.8 * 4) and np.abs(speed[:2]) == pytest.approx([3, 3])


@pytest.mark.parametrize("seed", range(2))
def test_the_lag_is_as_sure_as_it_says(seed):
    outline = outline_of(*detected(seed))
    found = animal_lag(outline, scanned(0.0373, seed), (-0.15, 0.15))
    assert abs(found.lag - 0.0373) < 3 * found.sd
    assert found.sd < 0.004
    assert found.n_returns > 100
    assert not found.parts.any()


def test_an_error_of_the_calibration_is_no_time(outline):
    returns = scanned(0.02)
    moved = Glimpses(returns.time, returns.pixel + np.array([14.0, -9.0]), returns.depth)
    found = animal_lag(outline, moved, (-0.15, 0.15))
    assert abs(found.lag - 0.02) < 3 * found.sd
    assert found.shift == pytest.approx([14, -9], abs=3)


def test_a_longer_recording_of_the_lidar(outline):
    """The lidar began three seconds before the video, and other times are a stride or more away."""
    found = animal_lag(outline, scanned(3.0, before=2.0, after=1.0), (1.5, 4.5))
    assert abs(found.lag - 3.0) < 3 * found.sd
    assert found.sigmas > 3


def test_missing_frames_are_noticed():
    time, position, likelihood = detected(n=126)
    keep = np.r_[:30, 36:126]
    found = animal_lag(
        outline_of(time[:120], position[keep], likelihood[keep]), scanned(0.0, seconds=2.1), (-0.15, 0.15)
    )
    assert np.ptp(found.parts) == pytest.approx(6 / FPS, abs=0.02)


def test_what_cannot_be_known_is_refused(outline):
    empty = scanned(0.0)
    grass = Glimpses(empty.time, empty.pixel, np.random.default_rng(0).permutation(empty.depth))
    with pytest.raises(InputError, match="animal"):
        animal_lag(outline, grass, (-0.15, 0.15))
    time, position, likelihood = detected()
    still = np.broadcast_to(np.nanmedian(position, axis=0), position.shape)
    with pytest.raises(InputError, match="several times|too little|does not show"):
        animal_lag(outline_of(time, still, likelihood), scanned(0.0), (-0.15, 0.15))


def test_the_strike_is_where_the_way_down_ends():
    """A paw that falls by 600 px/s until 0.7083 s and then stays, under a body that pans away."""
    time, position, likelihood = detected(n=80, noise=1.0)
    fall = np.where(time < 0.7083, 600 * (time - 0.7083), 0.0)
    position[:, 3] = np.column_stack([0 * time + 1200, 760 + np.maximum(fall, -200)])
    likelihood[:, 3] = 0.9
    position[..., 1] += 500 * time[:, None]
    outline = outline_of(time, position, likelihood)
    assert paws_of(NAMES, outline) == [3, 5]
    assert 3 in paws_of(("a", "b", "c", "d", "e", "f"), outline)  # among the lowest
    strikes = [one for one in strikes_of(outline, [3]) if one.marker == 3]
    assert strikes[0].frame == pytest.approx(0.7083 * FPS, abs=0.5)


def test_hints_of_a_strike():
    assert pivot_hint("strike").frame is None
    hint = pivot_hint("Strike:120=3.4s")
    assert (hint.kind, hint.frame, hint.seconds) == ("strike", 120.0, 3.4)
    with pytest.raises(InputError, match="cannot be read"):
        pivot_hint("strike:3")


# --- simulated recordings -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A gallop 50 m away in pictures of 852 px, as an LVX file and keypoints."""
    pytest.importorskip("rosbags")
    from acino_fte.rig_files import write_rig_simulation
    from acino_fte.rig_options import RigOptions
    from acino_fte.simulate_rig import simulate_rig

    options = RigOptions(distance=50.0, width=852, n_frames=80, bushes=20, rest_s=1.0, seed=3)
    folder = tmp_path_factory.mktemp("strike") / "gallop"
    return write_rig_simulation(simulate_rig(options), folder, recording="lvx")


def imported(folder, out, *more):
    from acino_fte import cli_import

    app = typer.Typer()
    app.command()(cli_import.import_recording)
    arguments = [
        folder / "recording" / "rig.lvx", "-o", out, "--calibration", folder / "lidar_camera.json",
        "--fps", "60", "--margin-px", "0", *more,
    ]  # fmt: skip
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, [str(a) for a in arguments])


def test_an_lvx_and_keypoints_by_the_strike(simulated, tmp_path):
    """No clock in common, no video; the truth: the lidar's first return is half a frame before frame 0."""
    import json

    keypoints = simulated / "recording" / "keypoints.csv"
    result = imported(simulated, tmp_path / "run", "--keypoints", keypoints, "--pivot", "strike:40=0.7")
    assert result.exit_code == 0, result.output
    assert "_paw strikes: frame" in result.output
    sync = json.loads((tmp_path / "run" / "import.json").read_text())["synchronisation"]
    assert sync["method"] == "pivot"
    assert sync["sd_ms"] < 4
    assert abs(1e3 * sync["first_frame_s"] - 0.5e3 / FPS) < 3 * sync["sd_ms"]


def test_without_keypoints_there_is_no_strike(simulated, tmp_path):
    keypoints = simulated / "recording" / "keypoints.csv"
    for more, word in (
        (("--keypoints", keypoints, "--pivot", "strike:900=1"), "0 to 79"),
        (("--keypoints", keypoints, "--pivot", "strike:40=90"), "No lidar return"),
        (("--keypoints", keypoints, "--pivot", "strikes"), "strike:FRAME=SECONDS"),
    ):
        result = imported(simulated, tmp_path / "run", *more)
        assert result.exit_code == 2 and word in result.output, result.output
        assert not (tmp_path / "run").exists()
