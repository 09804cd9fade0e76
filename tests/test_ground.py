"""The ground plane that a sequence file may state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from data_tools_synthetic import message, write_recording

from acino_fte.data_tools.load import load_sequence
from acino_fte.data_tools.sequence_file import write_sequence_file


def recording(folder: Path, ground: Any) -> Path:
    """A recording whose sequence file says this of the ground."""
    path = write_recording(folder) / "sequence.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "ground": ground}, sort_keys=False))
    return folder


PLANES = [
    ({"normal": [0, 0, 1], "height": 0.25}, (0, 0, 1, 0.25)),
    ({"height": -1}, (0, 0, 1, -1)),
    ({"normal": [0, 3, 4]}, (0, 0.6, 0.8, 0)),
    ({"normal": [0, 3, 4], "height": 2}, (0, 0.6, 0.8, 2)),
    ({}, (0, 0, 1, 0)),
]


@pytest.mark.parametrize(("ground", "plane"), PLANES)
def test_the_plane_has_a_unit_normal(
    ground: dict[str, Any], plane: tuple[float, ...], tmp_path: Path
) -> None:
    sequence = load_sequence(recording(tmp_path / "run", ground))
    assert sequence.ground == pytest.approx(plane)
    part = sequence.select_frames(2, 5)
    assert part.ground == sequence.ground
    (tmp_path / "again").mkdir()
    write_sequence_file(tmp_path / "again" / "sequence.yaml", part.provenance)
    assert load_sequence(tmp_path / "again").ground == sequence.ground


def test_without_a_word_the_ground_is_not_known(tmp_path: Path) -> None:
    assert load_sequence(write_recording(tmp_path / "run")).ground is None


FAULTS = [
    ({"normal": [0, 0, 0]}, "ground.normal", "no direction"),
    ({"normal": [0, 0, 1e300]}, "ground.normal", "no direction"),
    ({"normal": [0, float("nan"), 1]}, "ground.normal.1", "finite"),
    ({"normal": [0, 0, "up"]}, "ground.normal.2", "number"),
    ({"normal": [0, 1]}, "ground.normal", "missing"),
    ({"height": float("inf")}, "ground.height", "finite"),
    ({"heigth": 0.1}, "ground.heigth", "did you mean 'height'"),
    (0.3, "ground", "dictionary"),
]


@pytest.mark.parametrize(("ground", "key", "said"), FAULTS)
def test_what_is_no_plane_is_refused(ground: Any, key: str, said: str, tmp_path: Path) -> None:
    error = message(load_sequence, recording(tmp_path / "run", ground))
    assert str(error.key).startswith(key)
    assert said in error.problem
    assert str(error.file).endswith("sequence.yaml")
