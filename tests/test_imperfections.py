"""Late cameras, moved cameras, other proportions, displaced markers: what is simulated is what is stated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from acino_fte.data_tools.load import load_sequence
from acino_fte.errors import InputError
from acino_fte.imperfections import corrected_cameras, draw_imperfections
from acino_fte.kinematics import load_kinematics
from acino_fte.motions import make_motion, plan_motion
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.simulation_files import write_simulation
from acino_fte.skeleton import deformed, load_skeleton

CLEAN = SimulationOptions(n_frames=40, n_cameras=4, noise_px=0.0, missing=0.0, outliers=0.0, occlusion=False)
ALL = {"delay_ms": 6.0, "moved_mm": 20.0, "moved_deg": 0.5, "proportions": 0.05, "offsets_mm": 10.0}
MOTIONS = [
    ("cheetah", "gallop"),
    ("cheetah", "turn"),
    ("cheetah_acinoset", "turn"),
    ("human", "walk"),
    ("dog", "wander"),
]


@pytest.fixture(scope="module")
def cheetah():
    return load_skeleton("cheetah")


@pytest.fixture(scope="module")
def imperfect(cheetah):
    return simulate(cheetah, replace(CLEAN, **ALL))


def forward_positions(skeleton, q):
    """Marker positions (N, M, 3) by the definition of the skeleton, without SymPy."""
    frames, unturned = [], np.broadcast_to(np.eye(3), (len(q), 3, 3))
    for link in skeleton.links:
        rotation, origin = frames[link.parent] if link.parent >= 0 else (unturned, np.zeros((len(q), 3)))
        origin = origin + rotation @ np.array(link.at)
        for j in link.dofs:
            dof = skeleton.dofs[j]
            along = np.outer(q[:, j], dof.axis)
            if dof.kind == "slide":
                origin = origin + np.einsum("nij,nj->ni", rotation, along)
            else:
                rotation = rotation @ Rotation.from_rotvec(along).as_matrix()
        frames.append((rotation, origin))
    return np.stack(
        [frames[m.link][1] + frames[m.link][0] @ np.array(m.at) for m in skeleton.markers], axis=1
    )


@pytest.mark.parametrize(("species", "motion"), MOTIONS)
def test_a_motion_is_one_function_of_time(species, motion):
    kinematics = load_kinematics(load_skeleton(species))
    plan = plan_motion(kinematics, motion, 60, 120.0, seed=2, longest_path=4.0)
    q = make_motion(kinematics, motion, 60, 120.0, seed=2, longest_path=4.0)
    assert np.array_equal(plan.at_frames, q)
    assert np.allclose(plan(plan.time), q, atol=1e-12)
    for k in (1, 7):
        assert np.allclose(plan(plan.time + k / 120)[:-k], q[k:], atol=1e-12)
        assert np.allclose(plan(plan.time - k / 120)[k:], q[:-k], atol=1e-12)
    between = plan(plan.time[:-1] + 0.5 / 120)
    assert np.abs(between - 0.5 * (q[1:] + q[:-1])).max() < 0.1  # smooth, and on the same branch


@pytest.mark.parametrize(("species", "motion"), MOTIONS)
def test_pixels_of_a_late_camera_are_those_of_the_motion_at_that_time(species, motion):
    """Against the sampled truth alone: a spline through true positions at eight times the frame rate."""
    skeleton = load_skeleton(species)
    simulation = simulate(skeleton, replace(CLEAN, motion=motion, delay_ms=8.0))
    delays = np.array(list(simulation.parameters["time_offset_s"].values()))
    assert delays[0] == 0
    assert np.all(np.abs(delays) <= 8e-3)
    assert len(set(delays)) == len(delays)
    assert np.array_equal(simulation.q, simulate(skeleton, replace(CLEAN, motion=motion)).q)
    kinematics = load_kinematics(skeleton)
    plan = plan_motion(kinematics, motion, 40, 120.0)
    fine = np.arange(-16, 8 * 41 + 16) / (8 * 120.0)
    sampled = make_interp_spline(fine, kinematics.positions(plan(fine)), k=7)
    assert np.allclose(sampled(plan.time), simulation.positions, atol=1e-6)
    for c, camera in enumerate(simulation.true_cameras):
        expected = sampled(plan.time + delays[c])
        pixels = simulation.pixels[:, c : c + 1]
        assert np.nanmax(np.abs(camera.project(expected) - pixels[:, 0])) < 1e-3
    assert CLEAN.fps * np.abs(delays).max() > 0.1  # frames: the test means something


def test_a_delay_of_one_frame_shows_the_next_frame(cheetah, monkeypatch):
    plain = simulate(cheetah, replace(CLEAN, occlusion=True))
    one = np.array([0.0, 1 / 120, -2 / 120, 0.0])

    def draw(skeleton, options):
        return replace(draw_imperfections(skeleton, options), delay=one)

    monkeypatch.setattr("acino_fte.simulate.draw_imperfections", draw)
    late = simulate(cheetah, replace(CLEAN, occlusion=True, delay_ms=20.0))
    assert np.array_equal(late.q, plain.q)
    assert np.array_equal(late.positions, plain.positions)
    assert np.array_equal(late.pixels[:, [0, 3]], plain.pixels[:, [0, 3]])
    assert np.allclose(late.pixels[:-1, 1], plain.pixels[1:, 1], atol=1e-8)
    assert np.allclose(late.pixels[2:, 2], plain.pixels[:-2, 2], atol=1e-8)


def test_the_given_calibration_with_its_correction_is_the_true_camera(imperfect):
    points = imperfect.positions
    for given, true in zip(imperfect.cameras, imperfect.true_cameras, strict=True):
        truth = imperfect.parameters["extrinsics"][given.name]
        turn, shift = Rotation.from_rotvec(truth["rotation_rad"]), np.array(truth["translation_m"])
        local = turn.apply((points @ given.rotation.T + given.translation).reshape(-1, 3)) + shift
        straight = replace(given, rotation=np.eye(3), translation=np.zeros(3))
        assert np.allclose(
            straight.project(local.reshape(points.shape)), true.project(points), atol=1e-8, equal_nan=True
        )
    assert imperfect.cameras["cam1"] is imperfect.true_cameras["cam1"]
    assert np.linalg.norm(imperfect.cameras["cam2"].project(points) - imperfect.pixels[:, 1]) > 10
    mended = corrected_cameras(imperfect.cameras, imperfect.parameters["extrinsics"])
    assert np.allclose(mended.project(points), imperfect.true_cameras.project(points), atol=1e-8)


def test_moving_the_cameras_changes_the_calibration_only(cheetah):
    plain, moved = simulate(cheetah, CLEAN), simulate(cheetah, replace(CLEAN, moved_mm=30.0, moved_deg=1.0))
    assert np.array_equal(plain.pixels, moved.pixels)
    for a, b in zip(plain.cameras, moved.true_cameras, strict=True):
        assert np.array_equal(a.rotation, b.rotation)
        assert np.array_equal(a.translation, b.translation)


@pytest.mark.parametrize(("species", "motion"), [("cheetah", "gallop"), ("human", "walk"), ("dog", "wander")])
def test_true_positions_are_those_of_the_deformed_skeleton(species, motion):
    skeleton = load_skeleton(species)
    options = replace(CLEAN, motion=motion, proportions=0.08, offsets_mm=15.0, n_frames=5)
    simulation = simulate(skeleton, options)
    truth = simulation.parameters
    individual = deformed(skeleton, truth["segment_scale"], truth["marker_offset_m"])
    assert np.allclose(forward_positions(individual, simulation.q), simulation.positions, atol=1e-12)
    assert np.std(list(truth["segment_scale"].values())) > 0.02
    if motion != "gallop":  # whose height is in its recipe
        body = forward_positions(deformed(skeleton, truth["segment_scale"]), simulation.q)
        assert -0.005 < body[..., 2].min() < 0.03


def test_segments_are_longer_by_the_stated_factor(cheetah):
    plain, scaled = simulate(cheetah, CLEAN), simulate(cheetah, replace(CLEAN, proportions=0.1))
    assert np.array_equal(plain.q, scaled.q)
    factor = scaled.parameters["segment_scale"]
    for a, b, group in (
        ("l_front_knee", "l_front_ankle", "front_calf"),
        ("r_back_knee", "r_back_ankle", "back_calf"),
        ("l_front_ankle", "l_front_paw", "front_foot"),
        ("tail1", "tail2", "tail"),
    ):
        ends = [cheetah.marker(a), cheetah.marker(b)]
        before, after = (
            np.linalg.norm(np.diff(s.positions[:, ends], axis=1), axis=-1) for s in (plain, scaled)
        )
        assert np.allclose(after, factor[group] * before), group
    for a, b in zip(plain.cameras, scaled.cameras, strict=True):  # which stand where they stood
        assert np.array_equal(a.translation, b.translation)


def test_offsets_are_constant_and_as_long_as_they_say(cheetah):
    plain, moved = simulate(cheetah, CLEAN), simulate(cheetah, replace(CLEAN, offsets_mm=12.0))
    stated = np.array([moved.parameters["marker_offset_m"][m] for m in cheetah.marker_names])
    found = np.linalg.norm(moved.positions - plain.positions, axis=-1)
    assert np.allclose(found, np.linalg.norm(stated, axis=-1), atol=1e-12)
    assert np.std(stated) == pytest.approx(0.012, rel=0.25)


def test_parameters_are_complete_and_neutral_when_nothing_is_asked_for(cheetah):
    simulation = simulate(cheetah, CLEAN)
    truth = simulation.parameters
    assert truth == {
        "time_offset_s": dict.fromkeys(simulation.cameras.names, 0.0),
        "extrinsics": {
            c: {"rotation_rad": [0.0] * 3, "translation_m": [0.0] * 3} for c in simulation.cameras.names
        },
        "segment_scale": dict.fromkeys(cheetah.groups, 1.0),
        "marker_offset_m": {m: [0.0] * 3 for m in cheetah.marker_names},
    }
    assert simulation.swapped == []
    assert all(a is b for a, b in zip(simulation.cameras, simulation.true_cameras, strict=True))


@pytest.mark.parametrize("option", ALL)
def test_every_imperfection_has_its_own_stream(cheetah, imperfect, option):
    alone = simulate(cheetah, replace(CLEAN, **{option: ALL[option]})).parameters
    families = {
        "delay_ms": ("time_offset_s",),
        "proportions": ("segment_scale",),
        "offsets_mm": ("marker_offset_m",),
    }
    for family in families.get(option, ()):
        assert alone[family] == imperfect.parameters[family]
    if option.startswith("moved"):
        key = "translation_m" if option == "moved_mm" else "rotation_rad"
        for camera, pose in alone["extrinsics"].items():
            assert pose[key] == imperfect.parameters["extrinsics"][camera][key]
    changed = [f for f, v in alone.items() if v != simulate(cheetah, CLEAN).parameters[f]]
    assert changed == list(families.get(option, ("extrinsics",)))


def test_the_detector_does_the_same_whatever_the_imperfections(cheetah):
    faults = SimulationOptions(n_frames=40, n_cameras=4, radius=12.0, missing=0.2, swaps=0.2, occlusion=False)
    plain, other = simulate(cheetah, faults), simulate(cheetah, replace(faults, **ALL))
    both = (plain.detections.in_image & other.detections.in_image).all(axis=2)  # a swap can leave the image
    assert both.mean() > 0.9
    assert np.array_equal(plain.detections.missing[both], other.detections.missing[both])
    alike = ~(plain.detections.outlier | other.detections.outlier) & both[..., None]
    alike &= ~plain.detections.swapped & ~other.detections.swapped
    errors = [(s.detections.position - s.pixels)[alike] for s in (plain, other)]
    assert np.allclose(*errors, atol=1e-9, equal_nan=True)
    assert alike.mean() > 0.5


def test_sizes_follow_the_options(cheetah):
    options = SimulationOptions(n_cameras=400, **ALL)
    draw = draw_imperfections(cheetah, options)
    assert not np.any(draw.delay[0])
    assert not np.any(draw.turn[0])
    assert not np.any(draw.shift[0])
    assert 5.9e-3 < np.abs(draw.delay).max() <= 6e-3
    assert np.std(draw.delay) == pytest.approx(6e-3 / np.sqrt(3), rel=0.1)
    assert np.degrees(np.std(draw.turn)) == pytest.approx(0.5, rel=0.1)
    assert np.std(draw.shift) == pytest.approx(0.02, rel=0.1)
    twice = draw_imperfections(cheetah, replace(options, delay_ms=12.0))
    assert np.allclose(twice.delay, 2 * draw.delay)
    assert not np.allclose(draw_imperfections(cheetah, replace(options, seed=1)).delay, draw.delay)


def test_swaps_are_listed_with_the_markers_that_changed_places(cheetah):
    simulation = simulate(cheetah, replace(CLEAN, swaps=0.3))
    flagged = simulation.detections.swapped
    assert flagged.any()
    again = np.zeros_like(flagged)
    for frame, camera, markers in simulation.swapped:
        assert markers
        again[
            frame, simulation.cameras.names.index(camera), [cheetah.marker_names.index(m) for m in markers]
        ] = True
    assert np.array_equal(again, flagged)


def test_truth_comes_back_from_a_folder(cheetah, tmp_path):
    simulation = simulate(cheetah, replace(CLEAN, n_frames=12, swaps=0.3, **ALL))
    assert simulation.swapped
    folder = write_simulation(simulation, tmp_path / "run")
    assert "truth_parameters.json" in (folder / "README.md").read_text()
    sequence = load_sequence(folder)
    assert sequence.truth_parameters == simulation.truth_parameters
    assert sequence.truth_parameters == simulation_to_sequence(simulation).truth_parameters
    assert list(sequence.truth_parameters) == [
        "time_offset_s",
        "extrinsics",
        "segment_scale",
        "marker_offset_m",
        "swapped",
    ]
    part = load_sequence(folder, frames=(3, 9))
    assert part.truth_parameters == sequence.truth_parameters
    assert np.allclose(sequence.cameras["cam2"].rotation, simulation.cameras["cam2"].rotation, atol=1e-12)


def test_swaps_alone_are_written_too_and_nothing_is_when_there_is_nothing(cheetah, tmp_path):
    swapped = simulate(cheetah, replace(CLEAN, n_frames=12, swaps=0.3))
    assert load_sequence(write_simulation(swapped, tmp_path / "a")).truth_parameters["swapped"]
    plain = write_simulation(simulate(cheetah, replace(CLEAN, n_frames=12)), tmp_path / "b")
    assert not (plain / "truth_parameters.json").exists()
    assert load_sequence(plain).truth_parameters == {}


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("delay_ms", -1.0),
        ("delay_ms", float("nan")),
        ("moved_mm", "much"),
        ("moved_deg", 90.0),
        ("proportions", 2.0),
        ("offsets_mm", float("inf")),
        ("noise_scale", 0.0),
        ("prior_width", 0.0),
    ],
)
def test_wrong_options_are_named(option, value):
    with pytest.raises(InputError, match=f"option '{option}' is wrong") as error:
        SimulationOptions(**{option: value})
    assert error.value.expected
