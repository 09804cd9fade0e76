"""Ground and stance: the plane under the paws, the frames in which they rest, and what the terms do."""

from dataclasses import replace

import numpy as np
import pyomo.environ as pyo
import pytest
from conftest import FPS, cameras_about, make_sequence, random_problem
from test_condensed import assert_close, away, dense, numeric_gradient, numeric_hessian

from acino_fte import contact
from acino_fte.condensed import Condensed
from acino_fte.condensed_solve import minimise
from acino_fte.explicit import build_explicit
from acino_fte.initialise import initial_trajectory
from acino_fte.kinematics import load_kinematics
from acino_fte.losses import Loss
from acino_fte.problem import build_fte
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.skeleton import expand
from acino_fte.species_file import SpeciesFile

LEVEL = (0.0, 0.0, 1.0, 0.0)
THIGH, SHANK, HIP = 0.3, 0.3, 0.5  # m
SPEED, STRIDE, DUTY = 2.0, 0.4, 0.5  # m/s, s, share of the stride that a foot stands


def _leg(x, side):
    """A leg of two links below the trunk."""
    turn = {"turn": "y", "noise": 3000}
    return {
        f"l_{side}_thigh": {
            "parent": "trunk",
            "at": [x, 0.1, 0],
            "mirror": f"r_{side}_thigh",
            "dofs": {"flex": {**turn, "range": [-80, 80]}},
        },
        f"l_{side}_shank": {
            "parent": f"l_{side}_thigh",
            "at": [0, 0, -THIGH],
            "mirror": f"r_{side}_shank",
            "dofs": {"flex": {**turn, "range": [0, 140]}},
        },
    }


def _feet():
    marker = {"at": [0, 0, -SHANK], "sd_px": 3}
    return {
        f"l_{side}_foot": {**marker, "link": f"l_{side}_shank", "mirror": f"r_{side}_foot"}
        for side in ("front", "back")
    }


WALKER = {
    "format": "acino-fte/skeleton/1",
    "name": "walker",
    "noise_fps": FPS,
    "links": {
        "trunk": {
            "parent": "world",
            "dofs": {
                **{a: {"slide": a, "noise": 3} for a in "xyz"},
                "yaw": {"turn": "z", "noise": 300},
                "pitch": {"turn": "y", "range": [-60, 60], "noise": 300},
            },
        },
        **_leg(0.35, "front"),
        **_leg(-0.35, "back"),
    },
    "markers": {
        "nose": {"link": "trunk", "at": [0.6, 0, 0.1], "sd_px": 3},
        "spine": {"link": "trunk", "at": [0, 0, 0.1], "sd_px": 3},
        "rump": {"link": "trunk", "at": [-0.45, 0, 0.05], "sd_px": 3},
        **{
            f"l_{s}_knee": {"link": f"l_{s}_shank", "sd_px": 3, "mirror": f"r_{s}_knee"}
            for s in ("front", "back")
        },
        **_feet(),
    },
    "contacts": ["l_front_foot", "l_back_foot"],
}


@pytest.fixture(scope="module")
def walker():
    return load_kinematics(expand(SpeciesFile.model_validate(WALKER)))


def footfall(time, phase):
    """Where a foot is, and whether it stands: x relative to the hip's path at time 0, height, (N,) bool."""
    strides = time / STRIDE + phase
    whole, part = np.floor(strides), strides % 1.0
    swing = np.clip((part - DUTY) / (1 - DUTY), 0, 1)
    ahead = swing - np.sin(2 * np.pi * swing) / (2 * np.pi)
    x = SPEED * STRIDE * (whole + ahead - phase + DUTY / 2)
    return x, 0.1 * np.sin(np.pi * swing) ** 2, part < DUTY


def walk(kinematics, n_frames):
    """q (N, Q) of a trot on the ground z = 0 and where its paws stand (N, 4): feet truly rest."""
    skeleton, time = kinematics.skeleton, np.arange(n_frames) / FPS
    q = np.zeros((n_frames, len(skeleton.dofs)))
    hip = SPEED * (time - time[-1] / 2)
    q[:, skeleton.dof("trunk.x")], q[:, skeleton.dof("trunk.z")] = hip, HIP
    standing = np.zeros((n_frames, len(skeleton.contacts)), dtype=bool)
    for k, marker in enumerate(skeleton.contacts):
        leg = skeleton.marker_names[marker].removesuffix("_foot")
        x, z, standing[:, k] = footfall(time, 0.5 if leg in ("l_front", "r_back") else 0.0)
        dx, dz = x - SPEED * time, z - HIP
        reach = np.hypot(dx, dz)
        knee = np.arccos((reach**2 - THIGH**2 - SHANK**2) / (2 * THIGH * SHANK))
        q[:, skeleton.dof(f"{leg}_shank.flex")] = knee
        q[:, skeleton.dof(f"{leg}_thigh.flex")] = np.arctan2(-dx, -dz) - np.arctan2(
            SHANK * np.sin(knee), THIGH + SHANK * np.cos(knee)
        )
    return q, standing


def glide(kinematics, n_frames):
    """The same without a stance: legs stretched, feet a few centimetres above the ground, never slow."""
    q, _ = walk(kinematics, n_frames)
    names = kinematics.skeleton.dof_names
    q[:, 5:] = [0.3 if "shank" in name else -0.15 for name in names[5:]]
    q[:, 2] += 0.02 - kinematics.positions(q)[..., 2].min()
    return q


def recording(kinematics, q, n_cameras=3, noise_px=6.0, seed=0, blind=0.3):
    """Before a few cameras, with much noise and many feet not found."""
    cameras = cameras_about(len(q), n=n_cameras, target=(0, 0, 0.4), radius=4.0)
    rng = np.random.default_rng(seed)
    pixels = cameras.project(kinematics.positions(q))
    pixels += rng.normal(0, noise_px, pixels.shape)
    feet = list(kinematics.skeleton.contacts)
    lost = rng.random((len(q), n_cameras, len(feet))) < blind
    pixels[:, :, feet] = np.where(lost[..., None], np.nan, pixels[:, :, feet])
    return make_sequence(kinematics, q, cameras, pixels=pixels)


def solved(kinematics, sequence):
    problem = build_fte(sequence, kinematics)
    return problem, minimise(problem, initial_trajectory(sequence, kinematics)).q


def foot_errors(kinematics, q, truth):
    """Distances (N, K) of the feet from where they were, m."""
    feet = list(kinematics.skeleton.contacts)
    return np.linalg.norm((kinematics.positions(q) - kinematics.positions(truth))[:, feet], axis=-1)


# --- the residuals -------------------------------------------------------------------------------------


def lizard_terms(lizard, q):
    """Both terms on the feet of the lizard, the ground through the middle of their heights."""
    feet = [lizard.skeleton.marker("l_foot"), lizard.skeleton.marker("r_foot")]
    tilted = np.array([0.1, -0.2, 0.9])
    tilted /= np.linalg.norm(tilted)
    middle = float(np.median(lizard.positions(q)[:, feet] @ tilted))
    ground = (*tilted.tolist(), middle)
    standing = np.array([[1, 0], [1, 1], [1, 1], [0, 1], [1, 1], [1, 1]], dtype=bool)[: len(q)]
    return {
        "ground": contact.ground_term(feet, ground, len(q), sd=0.02),
        "stance": contact.stance_term(feet, standing),
        "squared": contact.ground_term(feet, ground, len(q), loss=Loss("squared")),
    }


@pytest.mark.parametrize("name", ["ground", "stance", "squared"])
def test_derivatives_and_both_lowerings(lizard, name):
    problem, q = random_problem(lizard, n_frames=6)
    term = lizard_terms(lizard, q)[name]
    alone, x = replace(problem, terms=(term,)), away(q)
    exact, plain = Condensed(alone, exact=True), Condensed(alone)
    assert exact.objective(x) > 0
    assert_close(plain.gradient(x), numeric_gradient(plain, x), 1e-6)
    assert_close(dense(exact, x), numeric_hessian(exact, x), 1e-5)
    eigenvalues = np.linalg.eigvalsh(dense(plain, x))
    assert eigenvalues.min() >= -1e-9 * eigenvalues.max()
    together, at = problem.with_terms(term), problem.clip(away(q).reshape(q.shape))
    value = pyo.value(build_explicit(together, at).objective)
    assert value == pytest.approx(Condensed(together).objective(at.ravel()), rel=1e-9)


def test_the_residuals_written_out(lizard):
    problem, q = random_problem(lizard, n_frames=6)
    terms = lizard_terms(lizard, q)
    positions = lizard.positions(q)
    ground = tuple(float(terms["squared"].data[k]) for k in ("nx", "ny", "nz", "d"))
    height = contact.heights(positions[:, [4, 5]], ground)
    depth = (np.sqrt(height**2 + 0.005**2) - height) / 2
    values = Condensed(replace(problem, terms=(terms["squared"],))).term_values(q.ravel())
    assert values == pytest.approx({"ground": 0.5 * ((depth / 0.01) ** 2).sum()})
    assert np.allclose(depth, np.maximum(-height, 0), atol=0.0026)
    below = height < -0.03
    assert below.any()
    assert np.allclose(depth[below], -height[below], rtol=0.01)

    term = terms["stance"]
    assert list(zip(term.frames.tolist(), term.items[:, 0].tolist(), strict=True)) == [
        (1, 4), (2, 4), (2, 5), (3, 5), (4, 5), (5, 4), (5, 5)
    ]  # fmt: skip
    squared = replace(term, loss=Loss("squared"))
    speed = (positions[term.frames, term.items[:, 0]] - positions[term.frames - 1, term.items[:, 0]]) * FPS
    values = Condensed(replace(problem, terms=(squared,))).term_values(q.ravel())
    assert values == pytest.approx({"stance": 0.5 * ((speed / contact.STANCE_SD) ** 2).sum()})


# --- the plane -----------------------------------------------------------------------------------------


def turned(positions, about, degrees):
    """Positions turned about a horizontal axis."""
    angle, axis = np.radians(degrees), np.array(about, dtype=float)
    cross = np.cross(np.eye(3), axis)
    rotation = np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return positions @ rotation.T


def angle_between(ground, normal):
    return np.degrees(np.arccos(np.clip(np.dot(ground[:3], normal), -1, 1)))


@pytest.mark.parametrize("seed", range(3))
def test_the_plane_under_a_walk(walker, seed):
    """In a curve, hence in two dimensions; with noise and paws that are far off."""
    rng = np.random.default_rng(seed)
    positions = walker.positions(walk(walker, 150)[0])
    turn, radius = positions[..., 0] / 1.5, positions[..., 1] + 1.5  # what rests before rests after
    positions = np.stack([radius * np.sin(turn), -radius * np.cos(turn), positions[..., 2]], axis=-1)
    positions = turned(positions + rng.normal(0, 0.005, positions.shape), (1, 0, 0), 8) + [0, 0, 0.7]
    wild = rng.random(positions.shape[:2]) < 0.05
    positions[wild] += rng.normal(0, 0.3, (wild.sum(), 3))
    ground = contact.fit_ground(positions, walker.skeleton.contacts)
    normal = turned(np.array([0.0, 0, 1]), (1, 0, 0), 8)
    assert np.linalg.norm(ground[:3]) == pytest.approx(1)
    assert ground[2] > 0
    assert angle_between(ground, normal) < 1.0
    assert abs(contact.heights(np.array([0, 0, 0.7]), ground)) < 0.01


def test_the_plane_under_a_straight_run(walker):
    """The slope along the track is seen, the tilt across it is not, and stays near zero."""
    rng = np.random.default_rng(0)
    positions = walker.positions(walk(walker, 120)[0])
    positions[..., 1] *= 0.05  # a narrow track
    positions = turned(positions, (0, 1, 0), -4) + rng.normal(0, 0.01, positions.shape)
    ground = contact.fit_ground(positions, walker.skeleton.contacts)
    assert angle_between(ground, turned(np.array([0.0, 0, 1]), (0, 1, 0), -4)) < 0.7
    assert abs(ground[1]) < 0.02


def test_a_standing_animal_stands_on_level_ground(walker):
    """Its four paws, one of them lifted, one seen too low, span little; the prior keeps the plane level."""
    q = np.repeat(walk(walker, 60)[0][:1], 60, axis=0)
    positions = walker.positions(q) + np.random.default_rng(1).normal(0, 0.004, (60, walker.n_markers, 3))
    feet = list(walker.skeleton.contacts)
    positions[:, feet, 2] = np.array([0.0, 0.0, 0.15, 0.0]) + np.random.default_rng(2).normal(
        0, 0.004, (60, 4)
    )
    ground = contact.fit_ground(positions, feet)
    assert angle_between(ground, [0, 0, 1]) < 2
    assert abs(ground[3]) < 0.02


def test_a_wall_is_no_ground(walker):
    positions = turned(walker.positions(walk(walker, 100)[0]), (0, 1, 0), -50)
    ground = contact.fit_ground(positions, walker.skeleton.contacts)
    assert angle_between(ground, [0, 0, 1]) < 20


def test_no_paw_anywhere(walker):
    positions = np.full((10, walker.n_markers, 3), np.nan)
    with pytest.raises(ValueError, match="no paw"):
        contact.fit_ground(positions, walker.skeleton.contacts)


# --- stance --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fps_factor", [1, 3])
def test_stance_is_found(walker, fps_factor):
    q, standing = walk(walker, 120)
    positions = walker.positions(q)[::fps_factor]
    found = contact.stance(positions, walker.skeleton.contacts, LEVEL, FPS / fps_factor)
    assert (found == standing[::fps_factor]).mean() > (0.9 if fps_factor == 1 else 0.8)
    assert (found & ~standing[::fps_factor]).sum() / found.sum() < 0.12  # feet set off slowly


def test_stance_under_noise(walker):
    q, standing = walk(walker, 120)
    noise = np.random.default_rng(0).normal(0, 0.004, (120, walker.n_markers, 3))
    smooth = sum(np.roll(noise, k, axis=0) for k in range(-3, 4)) / 7**0.5  # as a solution's errors are
    found = contact.stance(walker.positions(q) + smooth, walker.skeleton.contacts, LEVEL, FPS)
    assert (found == standing).mean() > 0.8
    assert (found & ~standing).sum() / found.sum() < 0.1


def test_no_stance_in_the_air_nor_while_gliding(walker):
    q, _ = walk(walker, 60)
    assert not contact.stance(walker.positions(q) + [0, 0, 0.3], walker.skeleton.contacts, LEVEL, FPS).any()
    sliding = walker.positions(glide(walker, 60))
    assert not contact.stance(sliding, walker.skeleton.contacts, LEVEL, FPS).any()


@pytest.mark.parametrize("n_frames", [1, 2, 3, 4])
def test_very_short_recordings(walker, n_frames):
    positions = walker.positions(walk(walker, n_frames)[0])
    assert contact.stance(positions, walker.skeleton.contacts, LEVEL, FPS).shape == (n_frames, 4)
    contact.fit_ground(positions, walker.skeleton.contacts)


# --- what they do to a trajectory ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("stated", [True, False], ids=["stated", "fitted"])
def test_the_terms_reduce_the_error_of_the_paws(walker, stated, seed):
    """Errors of feet that stand shrink by a fifth or more, those of the others do not grow."""
    truth, standing = walk(walker, 80)
    sequence = replace(recording(walker, truth, seed=seed), ground=LEVEL if stated else None)
    problem, plain = solved(walker, sequence)
    terms, found = contact.contact_terms(problem, walker.positions(plain), sequence)
    assert [t.family for t in terms] == ["ground", "stance"]
    assert ("states it" if stated else "fitted plane, tilt") in found[0]
    better = minimise(problem.with_terms(*terms), plain)
    assert better.status.ok
    before, after = foot_errors(walker, plain, truth), foot_errors(walker, better.q, truth)
    assert after[standing].mean() < 0.85 * before[standing].mean()
    assert after[~standing].mean() < 1.01 * before[~standing].mean()


def test_no_harm_without_a_stance(walker):
    """The ground is right and no foot rests: nothing changes."""
    truth = glide(walker, 60)
    sequence = replace(recording(walker, truth), ground=LEVEL)
    problem, plain = solved(walker, sequence)
    terms, found = contact.contact_terms(problem, walker.positions(plain), sequence)
    better = minimise(problem.with_terms(*terms), plain)
    assert "stance in 0%" in found[0]
    before, after = foot_errors(walker, plain, truth).mean(), foot_errors(walker, better.q, truth).mean()
    assert after < 1.01 * before


def test_feet_that_slide_give_way(cheetah):
    """The simulated gallop slides at 1–3 m/s while it stands; what is called stance then does little harm."""
    sequence = simulation_to_sequence(simulate(cheetah.skeleton, SimulationOptions(n_frames=60, seed=3)))
    problem, plain = solved(cheetah, sequence)
    terms, _ = contact.contact_terms(problem, cheetah.positions(plain), sequence)
    better = minimise(problem.with_terms(*terms), plain).q
    feet = list(cheetah.skeleton.contacts)
    before, after = (
        np.linalg.norm((cheetah.positions(q) - sequence.truth.values)[:, feet], axis=-1).mean()
        for q in (plain, better)
    )
    assert after < 1.03 * before


def test_a_species_without_contacts(lizard):
    problem, q = random_problem(lizard)
    sequence = make_sequence(lizard, q, cameras_about())
    terms, found = contact.contact_terms(problem, lizard.positions(q), sequence)
    assert terms == []
    assert "does not say which markers touch it" in found[0]


def test_paws_on_no_plane(walker):
    """Feet all over the place: no ground is better than a wrong one."""
    truth, _ = walk(walker, 30)
    sequence = recording(walker, truth)
    positions = walker.positions(truth)
    feet = list(walker.skeleton.contacts)
    positions[:, feet, 2] += np.random.default_rng(1).normal(0, 0.4, (30, len(feet)))
    terms, found = contact.contact_terms(build_fte(sequence, walker), positions, sequence)
    assert terms == []
    assert "no plane fits the lowest paws" in found[0]


def test_a_stated_ground_that_is_wrong(walker):
    """It is used as it was stated, with a remark; no foot is called standing on it."""
    truth, _ = walk(walker, 40)
    sequence = replace(recording(walker, truth), ground=(0.0, 0.0, 1.0, -0.2))
    terms, found = contact.contact_terms(build_fte(sequence, walker), walker.positions(truth), sequence)
    assert [t.family for t in terms] == ["ground"]
    assert "slow paws are 20 cm above it" in found[0]
