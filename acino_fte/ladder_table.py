"""Names of the rungs of the ladder (:func:`acino_fte.evaluate.climb`), for figure and report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

FAMILY_TITLES = {
    "delay": "time offsets",
    "scale": "proportions",
    "extrinsics": "camera poses",
    "offsets": "marker offsets",
}
"""Families of parameters in words."""


def rung_titles(rungs: Sequence[Mapping[str, Any]]) -> list[str]:
    """``nothing``, then ``+`` and what a rung adds to the one below."""
    titles = []
    for i, rung in enumerate(rungs):
        below = rungs[i - 1]["fit"] if i else []
        added = [FAMILY_TITLES.get(family, family) for family in rung["fit"] if family not in below]
        titles.append("+ " + ", ".join(added) if added else "nothing")
    return titles
