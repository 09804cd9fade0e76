"""Motions: in range for every species, feet on the ground, errors that help."""

import math

import numpy as np
import pytest

from acino_fte.errors import InputError
from acino_fte.kinematics import load_kinematics
from acino_fte.models import species_names
from acino_fte.motion_recipes import GALLOP, RECIPES
from acino_fte.motions import Recipe, Wave, fit_to_range, make_motion, motion_names
from acino_fte.simulate import SimulationOptions, simulate
from acino_fte.skeleton import Dof, load_skeleton

FPS = 120.0


def _kinematics(species):
    return load_kinematics(load_skeleton(species))


@pytest.fixture(scope="module")
def gallop():
    """Kinematics, q and positions of one second of gallop."""
    kinematics = _kinematics("cheetah")
    q = make_motion(kinematics, "gallop", 120, FPS)
    return kinematics, q, kinematics.positions(q)


def _all_motions():
    return [(s, m) for s in species_names() for m in motion_names(load_skeleton(s))]


@pytest.mark.parametrize(("species", "motion"), _all_motions())
def test_every_motion_keeps_to_the_ranges_and_above_the_ground(species, motion):
    kinematics = _kinematics(species)
    dofs = kinematics.skeleton.dofs
    for seed in (0, 1, 2) if motion == "wander" else (0,):
        q = make_motion(kinematics, motion, 200, FPS, seed=seed)
        assert np.all(np.isfinite(q))
        assert np.all(q >= [d.lower for d in dofs])
        assert np.all(q <= [d.upper for d in dofs])
        height = kinematics.positions(q)[:, :, 2]
        assert -0.02 < height.min() < 0.05
        assert height.max() < 2.5
        assert np.abs(np.diff(q, axis=0)).max() * FPS < 30.0  # rad/s and m/s: nothing jumps


def test_every_species_has_a_motion():
    for species in species_names():
        assert "wander" in motion_names(load_skeleton(species))


def test_smoothness_agrees_with_the_process_noise(gallop):
    kinematics, q, _ = gallop
    jump = np.diff(q, 3, axis=0) * FPS**2 / [d.noise for d in kinematics.skeleton.dofs]
    assert np.sqrt(np.mean(jump**2, axis=0)).max() < 1.5


def test_gallop_travels_at_its_speed(gallop):
    kinematics, _, p = gallop
    spine = p[:, kinematics.skeleton.marker("spine")]
    velocity = (spine[-1] - spine[0]) / (119 / FPS)
    assert velocity[0] == pytest.approx(13.0, abs=0.2)
    assert abs(velocity[1]) < 0.1
    assert spine[:, 2].min() > 0.6
    assert spine[:, 2].max() < 0.85


def test_gallop_footfalls_hind_then_front_with_two_flights(gallop):
    kinematics, _, p = gallop
    one = slice(0, 40)  # three strides a second at 120 Hz
    feet = ("l_back_paw", "r_back_paw", "r_front_paw", "l_front_paw")
    lowest = [int(np.argmin(p[one, kinematics.skeleton.marker(f), 2])) / 40 for f in feet]
    turns = np.mod(np.array(lowest) - lowest[0] + 0.05, 1.0)
    assert np.all(np.diff(turns) > 0), lowest
    height = p[:, [kinematics.skeleton.marker(f) for f in feet], 2]
    flight = np.all(height > 0.05, axis=1)[:40]
    starts = np.flatnonzero(flight & ~np.roll(flight, 1))
    assert len(starts) == 2  # the extended and the gathered flight
    assert np.all(height.min(axis=0) < 0.03)


def test_paws_slow_down_on_the_ground(gallop):
    kinematics, _, p = gallop
    for foot in ("l_back_paw", "r_back_paw", "r_front_paw", "l_front_paw"):
        paw = p[:, kinematics.skeleton.marker(foot)]
        speed = np.linalg.norm(np.diff(paw, axis=0), axis=1) * FPS
        assert speed.min() < 3.0  # of 13 m/s
        assert speed.max() > 20.0


def test_spine_flexes(gallop):
    kinematics, q, _ = gallop
    assert np.ptp(q[:, kinematics.skeleton.dof("back_torso.pitch")]) > math.radians(25)


def test_limbs_move_fore_and_aft_in_the_plane_of_the_body(gallop):
    kinematics, _, p = gallop
    skeleton = kinematics.skeleton
    for side, sign in (("l", 1), ("r", -1)):
        lateral = p[:, [skeleton.marker(f"{side}_{n}") for n in ("front_paw", "back_paw")], 1]
        assert np.all(sign * lateral > 0.05)
        shoulder = p[:, skeleton.marker(f"{side}_shoulder"), 0]
        ahead = p[:, skeleton.marker(f"{side}_front_paw"), 0] - shoulder
        assert ahead.max() > 0.2
        assert ahead.min() < -0.2


def test_turn_follows_a_curve_and_leans_into_it():
    kinematics = _kinematics("cheetah")
    q = make_motion(kinematics, "turn", 120, FPS)
    p = kinematics.positions(q)
    skeleton = kinematics.skeleton
    way = np.diff(q[:, [skeleton.dof("head.x"), skeleton.dof("head.y")]], axis=0)
    turned = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    assert turned[-1] - turned[0] == pytest.approx(9.0 / 25.0 * 118 / 120, abs=0.03)
    spine = p[60, skeleton.marker("spine")]
    feet = p[40:80, [skeleton.marker(f) for f in skeleton.marker_names if f.endswith("paw")]].mean(
        axis=(0, 1)
    )
    assert spine[1] > feet[1] + 0.1  # the curve goes to the left


def test_flick_swings_the_tail():
    kinematics = _kinematics("cheetah")
    q = make_motion(kinematics, "flick", 120, FPS)
    assert np.ptp(q[:, kinematics.skeleton.dof("tail_base.yaw")]) > math.radians(90)


def test_pitch_means_the_same_whatever_the_order_of_the_root_angles():
    """Both cheetahs gallop alike, although their roots turn in different orders."""
    positions = []
    for species in ("cheetah", "cheetah_acinoset"):
        kinematics = _kinematics(species)
        head = kinematics.skeleton.marker_names.index("nose")
        positions.append(kinematics.positions(make_motion(kinematics, "turn", 60, FPS))[:, head])
    assert np.allclose(*positions, atol=1e-9)


def test_wander_depends_on_its_seed_only():
    kinematics = _kinematics("dog")
    first = make_motion(kinematics, "wander", 50, FPS, seed=3)
    assert np.array_equal(first, make_motion(kinematics, "wander", 50, FPS, seed=3))
    assert not np.allclose(first, make_motion(kinematics, "wander", 50, FPS, seed=4))


ODD_SPECIES = {
    "tethered": """
links: {arm: {parent: world, at: [0, 0, 1], dofs: {swing: {turn: y, range: [20, 60]}}}}
markers: {tip: {link: arm, at: [0, 0, -0.5]}}
""",
    "upside_down": """
links: {trunk: {parent: world, dofs: {roll: {turn: x}, z: {slide: z, range: [-0.1, 0.1]}, y: {slide: y}}}}
markers: {a: {link: trunk}, b: {link: trunk, at: [0.1, 0, 0]}}
""",
    "rigid": """
links: {trunk: {parent: world, dofs: {x: {slide: x}, y: {slide: y}, z: {slide: z}, yaw: {turn: z}}}}
markers: {a: {link: trunk}, b: {link: trunk, at: [0.001, 0, 0]}}
""",
}


@pytest.mark.parametrize("name", ODD_SPECIES)
def test_wander_copes_with_odd_species(name, tmp_path):
    path = tmp_path / f"{name}.yaml"
    path.write_text(f"format: acino-fte/skeleton/1\nname: {name}\n{ODD_SPECIES[name]}")
    simulation = simulate(load_skeleton(path), SimulationOptions(motion="wander", n_frames=50, swaps=0.5))
    dofs = simulation.skeleton.dofs
    assert np.all(np.isfinite(simulation.q))
    assert np.all(simulation.q >= [d.lower for d in dofs])
    assert np.all(simulation.q <= [d.upper for d in dofs])
    assert simulation.detections.in_image.mean() > 0.9


def test_wander_moves_every_joint():
    for species in species_names():
        q = make_motion(_kinematics(species), "wander", 240, FPS)
        assert np.ptp(q, axis=0).min() > 0.01


def test_treadmill_keeps_the_joints_and_shortens_the_path():
    kinematics = _kinematics("cheetah")
    free = make_motion(kinematics, "gallop", 600, FPS)
    held = make_motion(kinematics, "gallop", 600, FPS, longest_path=10.0)
    x = kinematics.skeleton.dof("head.x")
    assert np.ptp(free[:, x]) == pytest.approx(13 * 599 / 120, rel=0.01)
    assert np.ptp(held[:, x]) == pytest.approx(10.0, rel=0.01)
    assert np.array_equal(np.delete(free, x, axis=1), np.delete(held, x, axis=1))


def test_a_recipe_of_your_own():
    kinematics = _kinematics("cheetah")
    recipe = Recipe("nod", "nods", rate=1.0, speed=0.0, joints={"neck.p*": Wave(5, ((1, 10, 0),))})
    q = make_motion(kinematics, recipe, 121, FPS)
    neck = q[:, kinematics.skeleton.dof("neck.pitch")]
    assert np.degrees(neck[[0, 60]]) == pytest.approx([15, -5])


def test_wave_is_the_sum_it_says():
    stride = np.linspace(0, 2, 50)
    wave = Wave(3.0, ((2, 1.5, 40),), lag=0.1)
    assert np.allclose(wave(stride), 3 + 1.5 * np.cos(4 * np.pi * (stride - 0.1) + math.radians(40)))
    assert np.allclose(wave.delayed(0.2)(stride), wave(stride - 0.2))


def test_values_outside_are_shrunk_not_clipped():
    dof = Dof("a.b", "turn", (0, 1, 0), -0.5, 0.1, 1.0)
    wide = fit_to_range(3 * np.sin(np.linspace(0, 7, 200)), dof)
    assert wide.min() > -0.5
    assert wide.max() < 0.1
    assert np.unique(wide).size > 190
    inside = np.array([-0.3, 0.0])
    assert np.allclose(fit_to_range(inside, dof), inside)


def test_unknown_motion_lists_those_that_fit():
    with pytest.raises(InputError, match=r"no motion 'galop'; did you mean 'gallop'") as error:
        make_motion(_kinematics("cheetah"), "galop", 10, FPS)
    assert "gallop, flick, turn, wander" in str(error.value)


def test_motion_that_does_not_fit_names_the_joints():
    with pytest.raises(InputError, match="'gallop' does not fit the species 'human'") as error:
        make_motion(_kinematics("human"), "gallop", 10, FPS)
    assert "front_thigh.shoulder" in str(error.value)
    assert "walk, wander" in str(error.value)


def test_recipes_have_names_of_their_own():
    assert len({r.name for r in RECIPES}) == len(RECIPES)
    assert GALLOP.fits(load_skeleton("cheetah"))
    assert not GALLOP.fits(load_skeleton("dog"))
