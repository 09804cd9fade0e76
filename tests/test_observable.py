"""Which parameters the data can tell: recordings where that is known beforehand, and dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import cameras_about, make_sequence, random_motion
from test_condensed import dense

from acino_fte.cameras import CameraArray
from acino_fte.condensed import Condensed
from acino_fte.kinematics import load_kinematics
from acino_fte.observable import ORDER, Observability, observable
from acino_fte.parameters import PriorWidths
from acino_fte.problem import Assumptions, FTEOptions, build_fte
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
from acino_fte.skeleton import deformed

N = 20


def judged(lizard, q=None, n=4, families=ORDER, options=None, sequence=None):
    """What is observed of a lizard before some cameras, by family."""
    q = random_motion(lizard.skeleton, N, 0) if q is None else q
    sequence = sequence or make_sequence(lizard, q, cameras_about(n=n))
    found = observable(sequence, lizard, options or FTEOptions(), Assumptions(), q, families)
    return {j.family: j for j in found}


def ranks(found):
    return {family: (j.rank, j.count) for family, j in found.items()}


def test_six_cameras_tell_delays_scales_and_corrections(cheetah):
    simulation = simulate(cheetah.skeleton, SimulationOptions(n_frames=40, seed=1))
    sequence = simulation_to_sequence(simulation)
    found = observable(sequence, cheetah, FTEOptions(), Assumptions(), simulation.q)
    assert [j.family for j in found] == list(ORDER)
    by_family = {j.family: j for j in found}
    groups = len(cheetah.skeleton.groups)
    for family, count in (("delay", 5), ("scale", groups), ("extrinsics", 30)):
        assert by_family[family].full
        assert by_family[family].count == count
        assert f"are fitted: all {count} directions" in by_family[family].reason
    assert by_family["offsets"].count == 72
    assert not by_family["offsets"].full  # a marker's place along a joint's axis and the joint's angle


def test_one_camera_does_not_tell_the_size(lizard):
    """A larger animal farther away looks the same: one direction of the scales is missing."""
    found = judged(lizard, n=1)
    assert ranks(found)["scale"] == (2, 3)
    assert not found["scale"].full
    assert found["scale"].reason == (
        "segment scales are not fitted: the data tell 2 of 3 directions "
        f"(the least known is led by {found['scale'].weakest})"
    )
    for family in ("delay", "extrinsics"):
        assert ranks(found)[family] == (0, 0)
        assert not found[family].full
        assert "are not fitted: there is only one camera" in found[family].reason


def test_two_cameras_tell_the_size(lizard):
    found = judged(lizard, n=2)
    assert found["scale"].full and found["delay"].full and found["extrinsics"].full


def test_a_motionless_animal_does_not_tell_delays(lizard):
    still = np.repeat(random_motion(lizard.skeleton, 1, 3), N, axis=0)
    found = judged(lizard, still)
    assert ranks(found)["delay"] == (0, 3)
    assert found["delay"].reason.startswith(
        "time offsets of the cameras are not fitted: the data tell 0 of 3"
    )
    assert found["delay"].weakest.startswith("delay.c")
    assert found["scale"].full


def test_a_camera_that_saw_nothing_is_not_corrected(lizard):
    q = random_motion(lizard.skeleton, N, 0)
    pixels = cameras_about().project(lizard.positions(q))
    pixels[:, 2] = np.nan
    found = judged(lizard, q, sequence=make_sequence(lizard, q, cameras_about(), pixels=pixels))
    assert ranks(found)["delay"] == (2, 3)
    assert ranks(found)["extrinsics"] == (12, 18)
    assert found["delay"].weakest == "delay.c2"
    assert "extrinsics.c2" in found["extrinsics"].weakest
    assert found["scale"].full


def test_too_few_frames_for_a_delay(lizard):
    found = judged(lizard, random_motion(lizard.skeleton, N, 0)[:2])
    assert ranks(found)["delay"] == (0, 0)
    assert "too few frames" in found["delay"].reason


def test_only_families_that_are_asked_about_are_judged(lizard):
    assert list(judged(lizard, families=("extrinsics", "delay"))) == ["delay", "extrinsics"]
    assert judged(lizard, families=()) == {}


def test_options_and_assumptions_are_those_of_the_estimate(lizard):
    """Pixels that are not believed tell nothing; the size of the set of cameras is held by its own term."""
    q = random_motion(lizard.skeleton, N, 0)
    sequence = make_sequence(lizard, q, cameras_about())
    assumptions = Assumptions(sd_px=np.full(6, 1e4))
    for families, held in ((ORDER, 1), (("delay", "extrinsics", "offsets"), 0)):
        vague = observable(sequence, lizard, FTEOptions(), assumptions, q, families)
        assert {j.family: j.rank for j in vague} == {f: held if f == "extrinsics" else 0 for f in families}


def test_nothing_is_observed_when_the_trajectory_is_not(lizard):
    """One marker in one picture, and no prior: the band has no factor."""
    q = random_motion(lizard.skeleton, N, 0)
    pixels = cameras_about().project(lizard.positions(q))
    pixels[1:] = np.nan
    pixels[:, 1:] = np.nan
    pixels[:, :, 1:] = np.nan
    sequence = make_sequence(lizard, q, cameras_about(), pixels=pixels)
    found = judged(lizard, q, options=FTEOptions(prior_width=0), sequence=sequence)
    assert {j.rank for j in found.values()} == {0}


@pytest.mark.parametrize("unit", ["length", "pixel"])
@pytest.mark.parametrize("n", [1, 4])
def test_ranks_do_not_depend_on_the_units(lizard, unit, n):
    """The same recording in millimetres, or with pixels of half the size."""
    q = random_motion(lizard.skeleton, N, 0)
    plain = judged(lizard, q, n)
    factor = 1000.0 if unit == "length" else 2.0
    kinematics, widths, cameras, sd = lizard, PriorWidths(), list(cameras_about(n=n)), lizard.skeleton.markers
    sd = np.array([m.sd_px for m in sd])
    if unit == "length":
        skeleton = deformed(lizard.skeleton, dict.fromkeys(lizard.skeleton.groups, factor))
        slides = [d.kind == "slide" for d in skeleton.dofs]
        dofs = tuple(replace(d, noise=d.noise * factor) if d.kind == "slide" else d for d in skeleton.dofs)
        kinematics = load_kinematics(replace(skeleton, dofs=dofs))
        cameras = [replace(c, translation=c.translation * factor) for c in cameras]
        widths = replace(widths, offset=widths.offset * factor, translation=widths.translation * factor)
        q = np.where(slides, factor * q, q)
    else:
        cameras = [replace(c, matrix=np.diag([factor, factor, 1.0]) @ c.matrix) for c in cameras]
        sd = factor * sd
    sequence = make_sequence(kinematics, q, CameraArray(tuple(cameras)))
    options = FTEOptions(widths=widths)
    found = observable(sequence, kinematics, options, Assumptions(sd_px=sd), q)
    assert ranks({j.family: j for j in found}) == ranks(plain)


@pytest.mark.parametrize(("n", "sd_px"), [(1, 3.0), (3, 3.0), (2, 100.0), (4, 200.0)])
def test_ranks_are_those_of_the_dense_schur_complement(lizard, n, sd_px):
    """Each family given those before it that are told in full, and only those."""
    q = random_motion(lizard.skeleton, N, 0)
    sequence = make_sequence(lizard, q, cameras_about(n=n))
    assumptions = Assumptions(sd_px=np.full(6, sd_px))
    problem = build_fte(sequence, lizard, FTEOptions(fit=ORDER), assumptions)
    condensed = Condensed(problem)
    hessian = dense(condensed, condensed.pack(problem.clip(q), np.zeros(len(problem.parameters))))
    given = list(range(q.size))
    for found in observable(sequence, lizard, FTEOptions(), assumptions, q):
        own = (q.size + problem.parameters.of_family(found.family)).tolist()
        assert found.count == len(own)
        if not own:
            continue
        cross = hessian[np.ix_(given, own)]
        information = hessian[np.ix_(own, own)] - np.eye(len(own))
        information -= cross.T @ np.linalg.solve(hessian[np.ix_(given, given)], cross)
        values, vectors = np.linalg.eigh(information)
        assert found.rank == (values >= 0.1).sum()
        weakest = problem.parameters.names[own[np.abs(vectors[:, 0]).argmax()] - q.size]
        assert found.weakest == weakest
        given += own if found.full else []


def test_the_reason_is_one_sentence():
    full = Observability("delay", 5, 5, "delay.c1")
    assert full.full
    assert full.reason == "time offsets of the cameras are fitted: all 5 directions are observed"
    assert not Observability("delay", 0, 0, "").full
    assert "\n" not in Observability("offsets", 18, 3, "offsets.nose.x").reason
