"""Rescue of cut files: everything whole before the cut is in a copy that standard readers read."""

import hashlib
import json

import pytest
from recover_made import BAGS, LVXS, cuts, make, messages_before, read_standard

from acino_fte.errors import InputError
from acino_fte.rig.recover import recover

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

EVERY = 4  # of the 200 cuts; benchmarks/bench_recover.py makes them all


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return {form: make(folder, form) for form in (*BAGS, *LVXS)}


@pytest.mark.parametrize("form", [*BAGS, *LVXS])
def test_everything_before_a_cut_is_saved(made, form, tmp_path):
    """At every 4th of 200 places: at least the whole messages before it, byte for byte and in order; of a
    cut chunk what its decompressor still gives; never a message that was not written."""
    path, needed = made[form]
    data, everything = path.read_bytes(), read_standard(path, form)
    cut, copy = tmp_path / f"cut{path.suffix}", tmp_path / f"copy{path.suffix}"
    report = tmp_path / f"{copy.name}.recovery.json"
    for length in cuts(len(data), EVERY):
        cut.write_bytes(data[:length])
        before = messages_before(needed, length)
        try:
            found = recover(cut, copy)
        except InputError:
            assert before == 0, length
            assert not copy.exists() and not report.exists()
            continue
        saved = read_standard(copy, form)
        assert saved == everything[: len(saved)], length
        assert len(saved) == found.saved >= before, length
        if form in ("ros1-none", "mcap-none", "db3", *LVXS):
            assert len(saved) == before, length
        assert json.loads(report.read_text())["saved"] == len(saved)
        copy.unlink()
        report.unlink()
    assert cut.read_bytes() == data[:length]
    assert sorted(tmp_path.iterdir()) == [cut]  # nothing else was left anywhere


def state(folder):
    """Names, contents and times of all files."""
    return {
        str(file): (hashlib.sha256(file.read_bytes()).hexdigest(), file.stat().st_mtime_ns)
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }
