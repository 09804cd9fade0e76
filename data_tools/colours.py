"""A colour for each animal or camera, safe for colour-blind readers, without the import of matplotlib."""

from __future__ import annotations

import numpy as np

DISTINCT = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")
"""Of Okabe and Ito (2008), Color Universal Design, in the order of use."""
_DARKEST, _PALEST = 0.0, 0.9
_GOLDEN = 0.6180339887498949


def colours_of(n: int) -> np.ndarray:
    """A colour (n, 3) for each of n animals or cameras.

    Up to seven are those of Okabe and Ito (2008), up to 21 also their dark and their pale tones. More lie
    along an even, colour-blind safe scale, those of successive numbers far apart (the golden section).
    """
    pure = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in DISTINCT])
    tones = np.concatenate(
        [pure, np.where(pure.any(1, keepdims=True), 0.55 * pure, 0.35), 0.45 * pure + 0.55]
    )
    if n <= len(tones):
        return tones[:n]
    from matplotlib import colormaps

    place = np.arange(n) * _GOLDEN % 1.0
    rank = np.argsort(np.argsort(place)) / (n - 1)
    return colormaps["viridis"](_DARKEST + (_PALEST - _DARKEST) * rank)[:, :3]


def hex_colours(n: int) -> list[str]:
    """The same as ``#rrggbb``."""
    return ["#" + "".join(f"{round(255 * v):02x}" for v in colour) for colour in colours_of(n)]
