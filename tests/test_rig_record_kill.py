"""A recorder is killed as ``kill -9`` does; benchmarks/bench_recorder.py does it a hundred times."""

import sys

import pytest

from acino_fte.rig.simulated_kills import SHARE, kill_recorders


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_after_a_kill_all_but_the_last_second_is_there(tmp_path):
    """Of what was written a second before, 99 % in the folder and in the rescued copy; the manifest fits."""
    found = list(kill_recorders(tmp_path, [0.1, 1.2, 1.5]))
    assert [left.problems for left in found] == [(), (), ()]
    assert any(left.expected.get("cam1", 0) > 5 for left in found)
    assert SHARE == 0.99 and min(left.share for left in found) >= SHARE
