"""Exchanged sides and candidates: limbs, the hidden Markov chain, single hypotheses, whole recordings."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest

from acino_fte.assignments import HYSTERESIS, KEEP, RARE, Assignment, limb_groups, resolve, viterbi
from acino_fte.condensed_solve import minimise
from acino_fte.initialise import initial_trajectory
from acino_fte.kinematics import load_kinematics
from acino_fte.losses import Loss
from acino_fte.problem import Assumptions, FTEOptions, build_fte
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.skeleton import Skeleton, expand, load_skeleton
from acino_fte.species_file import SpeciesFile

N, C = 12, 3
LOSSES = [Loss("redescending"), Loss("geman_mcclure"), Loss("huber")]


# --- limbs ---


def test_limbs_of_the_cheetah(cheetah):
    names = cheetah.skeleton.marker_names
    limbs = {
        name: [[names[i] for i in pair] for pair in pairs] for name, pairs in limb_groups(cheetah.skeleton)
    }
    assert list(limbs) == ["eye", "shoulder to front_paw", "hip to back_paw"]
    assert limbs["eye"] == [["l_eye", "r_eye"]]
    assert limbs["hip to back_paw"] == [
        [f"{side}_{part}" for side in "lr"] for part in ("hip", "back_knee", "back_ankle", "back_paw")
    ]


@pytest.mark.parametrize(
    ("species", "sizes"),
    [("cheetah_acinoset", [1, 4, 4]), ("dog", [2, 4, 4]), ("human", [2, 3, 6])],
)
def test_limbs_of_other_species(species, sizes):
    skeleton = load_skeleton(species)
    limbs = limb_groups(skeleton)
    assert [len(pairs) for _, pairs in limbs] == sizes
    found = {tuple(pair) for _, pairs in limbs for pair in pairs.tolist()}
    assert found == {(skeleton.marker(a), skeleton.marker(b)) for a, b in skeleton.twins}


def link(parent, y=0.0, mirror=None):
    return {"parent": parent, "at": [0, y, 0], "mirror": mirror, "dofs": {"swing": {"turn": "y"}}}


def beetle():
    """Three pairs of legs on one trunk, feelers on the head, a spot on either side of the trunk."""
    links: dict = {"trunk": {"parent": "world", "dofs": {"x": {"slide": "x"}}}, "head": link("trunk")}
    markers: dict = {"spot_left": {"link": "trunk", "at": [0, 1, 0], "mirror": "spot_right"}}
    for i in "123":
        links[f"coxa{i}_l"] = link("trunk", 0.5, f"coxa{i}_r")
        links[f"tibia{i}_l"] = link(f"coxa{i}_l", 0.5, f"tibia{i}_r")
        markers[f"leg{i}_knee_l"] = {"link": f"tibia{i}_l", "mirror": f"leg{i}_knee_r"}
        markers[f"leg{i}_tip_l"] = {"link": f"tibia{i}_l", "at": [0, 1, 0], "mirror": f"leg{i}_tip_r"}
    links["feeler_l"] = link("head", 0.1, "feeler_r")
    markers["Lfeeler"] = {"link": "feeler_l", "at": [1, 0, 0], "mirror": "Rfeeler"}
    markers = {name: {"at": [0, 0, 0], "sd_px": 2, **entry} for name, entry in markers.items()}
    content = {"format": "acino-fte/skeleton/1", "name": "beetle", "links": links, "markers": markers}
    return expand(SpeciesFile.model_validate(content))


def test_limbs_of_an_insect():
    limbs = [(name, len(pairs)) for name, pairs in limb_groups(beetle())]
    assert limbs == [("spot", 1), *((f"leg{i}_knee to leg{i}_tip", 2) for i in "123"), ("Lfeeler", 1)]


def test_an_animal_without_sides(lizard):
    skeleton = replace(lizard.skeleton, twins=())
    assert limb_groups(skeleton) == []
    predicted = np.random.default_rng(0).uniform(0, 500, (N, C, 6, 2))
    found = resolve(skeleton, predicted + 1, predicted, np.full(6, 2.0), Loss())
    assert found.n_changed == 0
    np.testing.assert_array_equal(found.pixels, predicted + 1)
    assert found.findings(["a", "b", "c"], np.arange(N), skeleton) == []


# --- the chain ---


@pytest.mark.parametrize("seed", range(5))
def test_the_chain_of_least_cost(seed):
    """Against all chains there are."""
    rng = np.random.default_rng(seed)
    n, s = 6, 3
    cost, change = rng.normal(0, 2, (n, 2, s)), rng.uniform(0, 2, (s, s)) * (1 - np.eye(s))
    chains = np.array(list(product(range(s), repeat=n)))
    between = change[chains[:, :-1], chains[:, 1:]].sum(axis=1)
    for c in range(2):
        total = cost[np.arange(n), c, chains].sum(axis=1) + between
        np.testing.assert_array_equal(viterbi(cost, change)[:, c], chains[total.argmin()])


def test_chains_of_one_frame_and_of_equal_costs():
    change = 1.0 - np.eye(2)
    assert viterbi(np.array([[[3.0, 1.0]]]), change).tolist() == [[1]]
    assert not viterbi(np.zeros((5, 2, 2)), change).any()


# --- single hypotheses ---


@dataclass
class Scene:
    """A cheetah's predicted pixels, all markers far apart, and detections with noise of 2 px."""

    skeleton: Skeleton
    predicted: np.ndarray
    detections: np.ndarray
    sd: np.ndarray

    def swap(self, frames, cameras, limbs):
        """Exchange detections; returns what should be found, (N, C, M) bool."""
        truth = np.zeros(self.detections.shape[:3], dtype=bool)
        groups = limb_groups(self.skeleton)
        for pairs in (groups[g][1] for g in limbs):
            where = np.ix_(frames, cameras, pairs.ravel())
            self.detections[where] = self.detections[np.ix_(frames, cameras, pairs[:, ::-1].ravel())]
            truth[where] = True
        return truth

    def resolve(self, loss=LOSSES[0], **kwargs):
        return resolve(self.skeleton, self.detections, self.predicted, self.sd, loss, **kwargs)


@pytest.fixture
def scene(cheetah):
    rng = np.random.default_rng(1)
    skeleton = cheetah.skeleton
    places = np.stack(np.meshgrid(np.arange(6), np.arange(4)), axis=-1).reshape(-1, 2) * 60.0
    predicted = rng.permuted(np.broadcast_to(places, (N, C, *places.shape)), axis=2)
    detections = predicted + rng.normal(0, 2, predicted.shape)
    return Scene(skeleton, predicted, detections, np.array([m.sd_px for m in skeleton.markers]))


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.name)
def test_nothing_to_find(scene, loss):
    found = scene.resolve(loss)
    assert found.n_changed == found.n_swapped == 0
    np.testing.assert_array_equal(found.pixels, scene.detections)


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.name)
@pytest.mark.parametrize(
    ("frames", "limbs"),
    [([4], [1]), ([0], [2]), ([N - 1], [0]), ([3, 5, 7], [0, 2]), ([6], [0, 1, 2]), (range(N), [1, 2])],
    ids=["one", "first", "last", "every other", "whole animal", "always"],
)
def test_exchanged_limbs(scene, frames, limbs, loss):
    before = scene.detections.copy()
    truth = scene.swap(list(frames), [1], limbs)
    found = scene.resolve(loss)
    np.testing.assert_array_equal(found.swapped, truth)
    np.testing.assert_array_equal(found.pixels, before)
    assert found.n_swapped == found.n_changed == truth.sum()
    again = scene.resolve(loss, previous=found)
    assert again.n_different(found) == 0
    assert found.n_different(Assignment(before, np.zeros_like(truth), found.candidate)) == truth.sum()


def test_a_detection_whose_twin_is_missing(scene):
    knee, other = (scene.skeleton.marker(f"{side}_front_knee") for side in "lr")
    _, limb = limb_groups(scene.skeleton)[1]
    alone = scene.detections[5, 0, other].copy()
    scene.detections[5, 0, limb.ravel()] = np.nan
    scene.detections[5, 0, knee] = alone  # the right knee, detected as the left one
    found = scene.resolve()
    assert found.n_swapped == 1
    assert found.swapped[5, 0, other]
    np.testing.assert_array_equal(found.pixels[5, 0, other], alone)
    assert np.isnan(found.pixels[5, 0, knee]).all()


def test_one_gross_error_does_not_outvote_its_limb(scene):
    """Even if it sits exactly on the twin."""
    knee, other = (scene.skeleton.marker(f"{side}_front_knee") for side in "lr")
    scene.detections[5, 0, knee] = scene.predicted[5, 0, other]
    assert scene.resolve().n_changed == 0


def test_nothing_detected_and_nothing_predicted(scene):
    truth = scene.swap([4, 5, 6], [0, 1, 2], [1])
    scene.detections[5, 0] = np.nan
    scene.predicted[5, 1] = np.nan
    scene.detections[:, 2] = np.nan
    found = scene.resolve()
    np.testing.assert_array_equal(found.swapped[[4, 6], :2], truth[[4, 6], :2])
    assert not found.swapped[5, 0].any() and not found.swapped[:, 2].any()
    np.testing.assert_array_equal(np.isnan(found.pixels), np.isnan(scene.detections))
    scene.predicted[:, 1] = np.nan
    assert not scene.resolve().swapped[:, 1].any()


def test_evidence_has_to_outweigh_the_costs(scene):
    """One pair, exactly exchanged, saves (δ/σ)²; in a single frame it takes 2 · hysteresis + RARE."""
    eye = limb_groups(scene.skeleton)[0][1][0]
    scene.sd[:] = 2.0
    scene.detections = scene.predicted.copy()

    def found(saved, frames, **kwargs):
        scene.predicted[:, :, eye[1]] = scene.predicted[:, :, eye[0]] + [2.0 * np.sqrt(saved), 0.0]
        scene.detections = scene.predicted.copy()
        scene.swap(frames, [0], [0])
        return scene.resolve(**kwargs).n_swapped

    threshold = 2 * HYSTERESIS + RARE
    assert found(threshold - 0.1, [5]) == 0
    assert found(threshold + 0.1, [5]) == 2
    assert found(threshold + 0.1, [5], hysteresis=HYSTERESIS + 0.1) == 0
    assert found(RARE + HYSTERESIS - 0.1, [0]) == 0  # at the end there is only one change
    assert found(RARE + HYSTERESIS + 0.1, [0]) == 2
    assert found(threshold / 2 + 0.1, [5, 6, 7]) == 6  # several in a row need less each
    assert found(RARE - 0.1, range(N)) == 0  # however many


def test_limbs_that_look_alike_follow_the_whole_animal(scene):
    eye = limb_groups(scene.skeleton)[0][1][0]
    scene.predicted[:, :, eye[1]] = scene.predicted[:, :, eye[0]] + 3.0
    scene.detections[:, :, eye] = scene.predicted[:, :, eye]
    truth = scene.swap([3], [0], [0, 1, 2])
    scene.swap([8], [0], [0])
    np.testing.assert_array_equal(scene.resolve().swapped, truth)


def test_false_alarms_by_noise_alone(lizard):
    """Sides 1 to 6 standard deviations apart, and 60000 frames: fewer than the bound Φ(−4) allows."""
    rng = np.random.default_rng(3)
    n, c = 6000, 10
    left, right = (lizard.skeleton.marker(f"{side}_foot") for side in "lr")
    predicted = np.full((n, c, 6, 2), 100.0)
    predicted[:, :, right, 0] += 2.0 * np.linspace(1, 6, c)
    detections = predicted + rng.normal(0, 2.0, predicted.shape)
    found = resolve(lizard.skeleton, detections, predicted, np.full(6, 2.0), Loss())
    assert found.swapped[..., left].sum() <= 4


def test_many_limbs():
    """Nine limbs have 512 sets: only those of few exceptions are looked at."""
    skeleton = beetle()
    rng = np.random.default_rng(4)
    predicted = rng.permuted(np.broadcast_to(np.arange(16)[:, None] * 50.0, (N, 2, 16, 2)), axis=2)
    world = Scene(skeleton, predicted, predicted + rng.normal(0, 1, predicted.shape), np.full(16, 2.0))
    truth = world.swap([2, 3], [0], [1, 3]) | world.swap([7], [1], [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(world.resolve().swapped, truth)


# --- candidates ---


def with_candidates(scene, k=3):
    """Two more candidates for each marker, far away and less likely."""
    rng = np.random.default_rng(5)
    places = np.repeat(scene.detections[..., None, :], k, axis=-2)
    places[..., 1:, :] += rng.choice([-1, 1], (*places.shape[:3], k - 1, 2)) * 25.0
    likelihood = np.broadcast_to([0.9, 0.4, 0.2][:k], places.shape[:-1]).copy()
    return places, likelihood


def test_the_first_candidates_stay_when_they_fit(scene):
    places, likelihood = with_candidates(scene)
    found = scene.resolve(candidates=places, candidate_likelihood=likelihood)
    assert found.n_changed == 0
    np.testing.assert_array_equal(found.pixels, scene.detections)


def test_a_better_candidate_is_taken(scene):
    places, likelihood = with_candidates(scene)
    right = scene.detections.copy()
    for k, marker in ((1, 2), (2, 9)):
        places[4, 1, marker, [0, k]] = places[4, 1, marker, [k, 0]]
    found = scene.resolve(candidates=places, candidate_likelihood=likelihood)
    assert found.candidate[4, 1, 2] == 1 and found.candidate[4, 1, 9] == 2
    assert found.n_changed == 2 and found.n_swapped == 0
    np.testing.assert_array_equal(found.pixels, right)


def test_exchanged_sides_with_candidates(scene):
    """Each side has its place as the second candidate of the other."""
    places, likelihood = with_candidates(scene)
    _, limb = limb_groups(scene.skeleton)[1]
    right = scene.detections.copy()
    places[6, 2, limb[:, 0]], places[6, 2, limb[:, 1]] = (
        places[6, 2, limb[:, 1]],
        places[6, 2, limb[:, 0]].copy(),
    )
    ankle = scene.skeleton.marker("l_front_ankle")
    places[6, 2, ankle, [0, 1]] = places[6, 2, ankle, [1, 0]]
    found = scene.resolve(candidates=places, candidate_likelihood=likelihood)
    assert found.swapped[6, 2, limb].all() and found.n_swapped == 8
    assert found.candidate[6, 2, scene.skeleton.marker("r_front_ankle")] == 1  # of its twin
    np.testing.assert_array_equal(found.pixels, right)
    again = scene.resolve(candidates=places, candidate_likelihood=likelihood, previous=found)
    assert again.n_different(found) == 0


def chosen(scene, saved, ratio, previous=None):
    """The nose's candidate when the second one saves so much and is less likely by that ratio."""
    places = np.repeat(scene.predicted[..., None, :], 2, axis=-2)
    sigma = scene.sd[0]
    places[:, :, 0, 0, 0] += sigma * np.sqrt(2 * saved)
    likelihood = np.broadcast_to([0.8, 0.8 * ratio], places.shape[:-1])
    scene.detections = places[..., 0, :]
    return scene.resolve(candidates=places, candidate_likelihood=likelihood, previous=previous)


def test_likelihoods_and_the_previous_choice_count(scene):
    gap, ratio = np.log(5.0), 0.2
    stays, goes = chosen(scene, gap + KEEP - 0.1, ratio), chosen(scene, gap + KEEP + 0.1, ratio)
    assert stays.n_changed == 0
    assert (goes.candidate[..., 0] == 1).all() and goes.n_changed == N * C
    assert chosen(scene, gap - KEEP + 0.1, ratio, goes).n_changed == N * C
    assert chosen(scene, gap - KEEP - 0.1, ratio, goes).n_changed == 0


def test_candidates_that_are_not_there(scene):
    places, likelihood = with_candidates(scene)
    places[3, 0, 5, 0] = np.nan  # below the threshold, unlike the second one
    places[3, 0, 6] = np.nan
    likelihood[3, 0, 6] = np.nan
    likelihood[:, 1] = 0.0
    places[..., 2, :] = np.nan
    found = scene.resolve(candidates=places, candidate_likelihood=likelihood)
    np.testing.assert_array_equal(found.pixels[3, 0, 5], places[3, 0, 5, 1])
    assert found.candidate[3, 0, 5] == 1 and found.n_changed == 1
    assert np.isnan(found.pixels[3, 0, 6]).all() and found.candidate[3, 0, 6] == 0
    equal = scene.resolve(candidates=places)
    assert equal.n_changed == 1


# --- in words ---


def test_findings(scene):
    scene.swap([2, 3, 4, 7], [0], [1])
    scene.swap([9, 10], [0], [0, 1, 2])
    scene.swap([0], [2], [0, 2])
    places, likelihood = with_candidates(scene)
    places[5, 1, 0, [0, 1]] = places[5, 1, 0, [1, 0]]
    found = scene.resolve(candidates=places, candidate_likelihood=likelihood)
    assert found.findings(["north", "east", "south"], np.arange(100, 100 + N), scene.skeleton) == [
        "north: left and right exchanged in 6 of 12 frames: the whole animal in 2 (109:111); "
        "shoulder to front_paw in 4 (102:105, 107)",
        "east: 1 detections are not the detector's first choice: nose 1",
        "south: left and right exchanged in 1 of 12 frames: eye in 1 (100); hip to back_paw in 1 (100)",
    ]


def test_findings_are_short(cheetah):
    n = 60
    swapped = np.zeros((n, 1, 24), dtype=bool)
    swapped[::2, :, 1:3] = True
    many = Assignment(np.zeros((n, 1, 24, 2)), swapped, np.zeros((n, 1, 24), dtype=int))
    (sentence,) = many.findings(["cam1"], np.arange(n), cheetah.skeleton)
    assert sentence.endswith("eye in 30 (0, 2, 4, 6, 8, 10, 12, 14 and 22 more)")


# --- whole recordings ---


@dataclass
class Run:
    """What came of a simulated recording: errors in mm, swaps and what was found of them."""

    error: float
    error_unresolved: float
    error_without: float
    found: float
    found_of_all: float
    alarms: float


def solve(kinematics, sequence, truth, rounds):
    """Fits and assignments in turn; mean joint error in mm and the last assignment."""
    options, skeleton = FTEOptions(), kinematics.skeleton
    detected = sequence.pixels(skeleton.marker_names, options.likelihood)
    sd = np.array([m.sd_px for m in skeleton.markers])
    q, pixels, found = initial_trajectory(sequence, kinematics, options), detected, None
    for i in range(rounds + 1):
        problem = build_fte(sequence, kinematics, options, Assumptions(pixels=pixels))
        q = minimise(problem, q, enough=0.0 if i == rounds else 1e-3).q
        if i < rounds:
            predicted = sequence.cameras.project(kinematics.positions(q))
            found = resolve(skeleton, detected, predicted, sd, options.loss, previous=found)
            pixels = found.pixels
    return 1e3 * np.linalg.norm(kinematics.positions(q) - truth, axis=-1).mean(), found


def evaluate(kinematics, rounds=2, **options) -> Run:
    """Solve a simulated recording with swaps, with and without looking for them, and one without swaps.

    A swap is counted for every frame, camera and limb of which a swapped detection is above the threshold of
    likelihood. It can be told when the true projections of one of the limb's pairs, of which there is a
    detection, are more than three standard deviations (of the species) apart; else the images of both sides
    look the same. ``found`` is of those that can be told, ``found_of_all`` of all; ``alarms`` is of the limbs
    that can be told and were not swapped.
    """
    skeleton = kinematics.skeleton
    simulation = simulate(skeleton, SimulationOptions(**options))
    sequence = simulation_to_sequence(simulation)
    clean = simulation_to_sequence(simulate(skeleton, SimulationOptions(**{**options, "swaps": 0.0})))
    truth = simulation.positions
    error, assignment = solve(kinematics, sequence, truth, rounds)
    seen = np.isfinite(sequence.pixels(skeleton.marker_names, FTEOptions().likelihood)[..., 0])
    of_limbs: list[tuple[np.ndarray, ...]] = []
    for _, pairs in limb_groups(skeleton):
        left, right = pairs.T
        apart = np.linalg.norm(simulation.pixels[:, :, left] - simulation.pixels[:, :, right], axis=-1)
        sd = np.array([max(skeleton.markers[a].sd_px, skeleton.markers[b].sd_px) for a, b in pairs])
        of_limbs.append(
            (
                (simulation.detections.swapped & seen)[..., pairs.ravel()].any(axis=-1),
                ((apart > 3 * sd) & (seen[..., left] | seen[..., right])).any(axis=-1),
                assignment.swapped[..., pairs.ravel()].any(axis=-1),
            )
        )
    swapped, told, flagged = np.stack(of_limbs, axis=-1)
    return Run(
        error,
        solve(kinematics, sequence, truth, 0)[0],
        solve(kinematics, clean, truth, 0)[0],
        flagged[swapped & told].mean(),
        flagged[swapped].mean(),
        flagged[told & ~swapped].mean(),
    )


@pytest.mark.parametrize(
    ("species", "options"),
    [
        ("cheetah", {"swaps": 0.1, "seed": 0}),
        ("cheetah", {"swaps": 0.3, "seed": 2}),
        ("cheetah", {"swaps": 0.1, "seed": 3, "n_cameras": 3}),
        ("dog", {"swaps": 0.1, "motion": "wander", "n_frames": 80}),
        ("human", {"swaps": 0.3, "motion": "wander", "n_frames": 60}),
    ],
    ids=lambda v: v if isinstance(v, str) else f"{v['swaps']:.0%}",
)
def test_swaps_of_a_simulated_recording(species, options):
    """95 % of those that can be told are found, and the trajectory is as good as without swaps."""
    run = evaluate(load_kinematics(load_skeleton(species)), **options)
    assert run.found >= 0.95, run
    assert run.found_of_all >= 0.8, run
    assert run.alarms <= 0.005, run
    assert run.error <= 1.1 * run.error_without, run
    assert run.error_unresolved > run.error, run


def test_a_recording_without_swaps_stays_as_it_is(cheetah):
    run = evaluate(cheetah, swaps=0.02, seed=4, n_frames=80)
    assert run.alarms < 0.003
    assert run.error <= 1.05 * run.error_without
