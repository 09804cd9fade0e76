"""docs/match_tracks.md does what it says: commands, Python and the numbers that it shows, from top to bottom.

The bats are not part of the repository; their tutorial is followed where ``../shared/data/bats`` is present.
Figures are left out, to save time: test_match_cli draws them.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_new_species_tutorial import blocks, execute

from acino_fte.data_tools.load_tracks import load_tracks
from acino_fte.data_tools.match_files import MATCHING
from acino_fte.data_tools.match_points import SOURCE_NAMES

REPOSITORY = Path(__file__).resolve().parent.parent
PAGE = REPOSITORY / "docs" / "match_tracks.md"
EXAMPLE = REPOSITORY / "examples" / "bird_tracks"
BATS = REPOSITORY.parent / "shared" / "data" / "bats"
TEXT = PAGE.read_text(encoding="utf-8")
GUIDE, _, TUTORIAL = TEXT.partition("\n## Tutorial: bats in a cave\n")
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def follow(text: str, folder: Path) -> tuple[list[str], dict[str, object]]:
    """Carry out a page: what each command printed, and what Python ended with."""
    printed, names = [], {"__name__": "docs"}
    for language, block in blocks(text):
        if language == "bash":
            printed += [execute(_quick(line), folder) for line in block.splitlines() if line.strip()]
        elif language == "python":
            exec(compile(block, f"{PAGE.name}: {block.splitlines()[0]}", "exec"), names)
    return printed, names


def _quick(line: str) -> str:
    return line if "--no-figures" in line else f"{line} --no-figures"


def promised(text: str, first_words: str) -> str:
    """The block that shows what a command prints."""
    return next(block for kind, block in blocks(text) if kind == "text" and block.startswith(first_words))


def assert_prints(printed: str, shown: str) -> None:
    """The words are those shown, and the numbers nearly."""
    for mine, theirs in zip(shown.splitlines(), printed.splitlines(), strict=False):
        assert _NUMBER.sub("#", mine) == _NUMBER.sub("#", theirs)
        numbers = [[float(n) for n in _NUMBER.findall(line)] for line in (mine, theirs)]
        np.testing.assert_allclose(*numbers, rtol=0.03, atol=0.1, err_msg=f"{mine}\n{theirs}")
    assert len(printed.splitlines()) >= len(shown.splitlines())


def test_the_guide(tmp_path, monkeypatch):
    shutil.copytree(EXAMPLE, tmp_path / "examples" / EXAMPLE.name)
    monkeypatch.chdir(tmp_path)
    printed, names = follow(GUIDE, tmp_path)
    assert_prints(printed[0], promised(GUIDE, "10 animals"))
    written = {path.name for path in (tmp_path / "out" / "birds").iterdir()}
    assert written == set(MATCHING.files) - {"figures", "report.html"}
    assert names["matches"].n_groups == 10
    assert names["score"].pooled.precision > 0.99
    for method, least in (("birds", 0.999), ("dots", 0.99), ("thesis", 0.5)):
        metrics = json.loads((tmp_path / "out" / method / "metrics.json").read_text())
        assert metrics["truth"]["pairing_accuracy"] >= least, method


def test_the_guide_names_every_file_and_every_source():
    assert [name for name in MATCHING.files if f"`{name}`" not in GUIDE and f"`{name}/`" not in GUIDE] == []
    # points beyond the ends of a path are never written
    assert [name for name in SOURCE_NAMES if f"| `{name}` |" not in GUIDE] == ["extended"]


def test_the_example_is_made_again_number_for_number(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    readme = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    follow(readme, tmp_path)
    ours, theirs = load_tracks(EXAMPLE), load_tracks(tmp_path / "bird_tracks")
    for a, b in zip(ours.views, theirs.views, strict=True):
        np.testing.assert_array_equal(a.frame, b.frame)
        np.testing.assert_array_equal(a.track, b.track)
        np.testing.assert_array_equal(a.animal, b.animal)
        np.testing.assert_allclose(a.xy, b.xy, atol=2e-4)
    pd.testing.assert_frame_equal(ours.truth_3d, theirs.truth_3d, atol=1e-5)


def test_the_example_is_small():
    assert sum(path.stat().st_size for path in EXAMPLE.iterdir()) < 300_000


@pytest.mark.skipif(not BATS.is_dir(), reason="the recording ../shared/data/bats is absent")
def test_the_bats(tmp_path, monkeypatch):
    (tmp_path / "bats").symlink_to(BATS, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    printed, names = follow(TUTORIAL, tmp_path)
    assert_prints(printed[0], promised(TUTORIAL, "14 animals"))
    rows = names["rows"]
    matched = rows[rows["group"] >= 0]
    assert matched.groupby("group")["bat"].nunique().eq(1).all()
    assert matched.groupby("bat")["group"].nunique().eq(1).all()
    assert set(range(1, 16)) - set(matched["bat"]) == {6}
    alone = rows[rows["group"] < 0]
    assert sorted(zip(alone["bat"], alone["frame"], alone["camera"], strict=True)) == [
        (6, 88, "cam2"),
        (6, 89, "cam2"),
        (6, 90, "cam2"),
        (14, 369, "cam3"),
    ]
    assert 355 < np.linalg.norm(names["expected"] - names["bat_14"]["cam3"]) < 370
    apart = names["apart"]
    assert len(apart) == 606
    assert (apart > 1e-5).sum() == 1
    metrics = json.loads((tmp_path / "out" / "bats_dots" / "metrics.json").read_text())
    assert metrics["truth"]["pairing_accuracy"] >= 0.99
    assert metrics["truth"]["recall"] >= 0.95
