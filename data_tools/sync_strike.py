"""The strike of a paw in a video: the frame at which its way down ends.

In the WildPose thesis the pivot frame is one that both sensors show, chosen by hand: a paw that touches the
ground, the instant of the greatest change of speed. Here it is found in the keypoints.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acino_fte.data_tools.sync_outline import Outline

_PAW = re.compile(r"paw|foot|feet|hoof|toe|claw|hand(?!le)", re.IGNORECASE)
_APART = 0.03  # s before and after, between which the change of speed is measured
_RANGE = (0.1, 0.9)  # quantiles of a paw's height; it strikes in the lower half between them


@dataclass(frozen=True)
class Strike:
    """A paw that strikes: `marker` (its number), `frame` (in parts of a frame), `change` of speed, px/s."""

    marker: int
    frame: float
    change: float


def paws_of(names: Sequence[str], outline: Outline) -> list[int]:
    """The markers that are paws, by their names; else the third of the markers that are lowest."""
    named = [i for i, name in enumerate(names) if _PAW.search(name)]
    known = [i for i in named if np.isfinite(outline.pixel[:, i, 0]).any()]
    if known:
        return known
    seen = np.flatnonzero(np.isfinite(outline.pixel[..., 1]).any(axis=0))
    height = np.nanmedian(outline.pixel[:, seen, 1], axis=0)
    return [int(i) for i in seen[np.argsort(-height)[: max(len(seen) // 3, 1)]]]


def strikes_of(outline: Outline, paws: Sequence[int]) -> list[Strike]:
    """All strikes, the most sudden first.

    The speed of a paw down the picture falls at a strike (an even pan does not matter to its change). The
    change over 0.06 s is the greatest there, in parts of a frame by the parabola through it and its
    neighbours; the paw must be in the lower half of its range below the animal's middle.
    """
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames without the animal
        middle = np.nanmedian(outline.pixel[..., 1], axis=1)
    speed = outline.rate[..., 1]
    step = float(np.median(np.diff(outline.time)))
    k = max(round(_APART / step), 1)
    found = []
    for paw in paws:
        height = outline.pixel[:, paw, 1] - middle
        if np.isfinite(height).sum() < 4 * k + 3:
            continue
        low = float(np.nanquantile(height, _RANGE).mean())
        change = np.full(len(speed), np.nan)
        change[k:-k] = speed[: -2 * k, paw] - speed[2 * k :, paw]
        change[(height < low) | ~np.isfinite(height)] = np.nan
        for n in range(1, len(change) - 1):
            a, b, c = change[n - 1 : n + 2]
            even = outline.time[n + 1] - outline.time[n - 1] < 2.5 * step
            if np.isfinite(a + b + c) and b > max(a, c, 0.0) and even:
                found.append(Strike(paw, n + 0.5 * (a - c) / (a - 2 * b + c), float(b)))
    return sorted(found, key=lambda one: -one.change)
