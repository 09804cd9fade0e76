"""How far the dots of one animal are from one epipolar plane, from the recording itself.

Before anything is matched: for some windows of 16 frames of the tracks of one view, the window of the other view
that is nearest in all of them, provided it is within a wide reach in nearly all; the median of the mean squares. The
reach is a share of the image's diagonal, made wider while it matters. After matching, the noise is that of the
matched dots: σ from the change of d between frames next to each other in a chunk, σ_s from the means of chunks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from acino_fte.data_tools.track_evidence import REACH, Dots, Evidence, Noise, gather_evidence

_REACH = 0.02  # of the diagonal
_WIDEST = 0.16
_FEWEST, _ALWAYS = 8, 0.9
_WINDOW, _WINDOWS = 16, 500
_LEAST_PX = 0.02
_SURE = 4.0  # standard errors by which the means of chunks must exceed the white noise
_TRIM = 1.0 / 0.9988  # variance of a Gaussian cut off at four standard deviations


def first_noise(pairs: list[tuple[Dots, Dots]], diagonal: float) -> Noise | None:
    """Noise before anything is matched; None when no pieces go together in any pair of views.

    Parameters
    ----------
    pairs : list of (Dots, Dots)
        The views of every pair.
    diagonal : float
        Of the images, px.
    """
    share = _REACH
    while True:
        reach = share * diagonal
        found = [_best_partners(a, b, reach) for a, b in pairs]
        squares = np.concatenate(found) if found else np.empty(0)
        if len(squares):
            noise = float(np.sqrt(np.median(squares)))
            if noise < reach / 5 or share >= _WIDEST:
                return Noise(max(noise, _LEAST_PX), 0.0)
        elif share >= _WIDEST:
            return None
        share *= 2


def _best_partners(a: Dots, b: Dots, reach: float) -> np.ndarray:
    """Mean d² of some windows of pieces of a with the nearest window of b."""
    a, b = _windows(a), _windows(b)
    length = np.bincount(a.piece[a.piece >= 0], minlength=a.n_pieces)
    long = np.flatnonzero(length >= _FEWEST)
    some = np.zeros(a.n_pieces, dtype=bool)
    some[long[:: max(1, len(long) // _WINDOWS)]] = True
    part = replace(a, piece=np.where((a.piece >= 0) & some[a.piece], a.piece, -1))
    e = gather_evidence(part, b, Noise(reach / REACH))
    good = (e.shared >= _FEWEST) & (e.near >= _ALWAYS * e.shared)
    best = np.full(a.n_pieces, np.inf)
    np.minimum.at(best, e.a[good], e.squares[good] / e.near[good])
    return best[np.isfinite(best)]


def _windows(dots: Dots) -> Dots:
    """Every piece in windows of a few frames, so that a track that changes hands is of use."""
    part = dots.piece * (dots.frame.max(initial=0) // _WINDOW + 1) + dots.frame // _WINDOW
    _, window = np.unique(np.where(dots.piece >= 0, part, -1), return_inverse=True)
    if (dots.piece < 0).any():
        window = window - 1
    return replace(dots, piece=window, n_pieces=int(window.max(initial=-1)) + 1)


def matched_noise(evidence: list[Evidence], partners: list[np.ndarray], before: Noise) -> Noise:
    """Noise of matched pieces.

    Parameters
    ----------
    evidence : list of Evidence
        One a pair of views.
    partners : list of (E,) bool
        Pairs of pieces that were put into one group.
    before : Noise
        What the evidence was gathered with.
    """
    near = sum(e.near[p].sum() for e, p in zip(evidence, partners, strict=True))
    if near < _FEWEST:
        return before
    squares = sum(e.squares[p].sum() for e, p in zip(evidence, partners, strict=True))
    means = sum((e.squared_means[p]).sum() for e, p in zip(evidence, partners, strict=True))
    chunks = sum(e.chunks[p].sum() for e, p in zip(evidence, partners, strict=True))
    if near - chunks < _FEWEST:
        return Noise(max(float(np.sqrt(squares / near * _TRIM)), _LEAST_PX), 0.0)
    within = (squares - means) / (near - chunks)
    white = float(np.sqrt(within * _TRIM))
    excess = means - chunks * within
    sure = excess > _SURE * within * np.sqrt(2.0 * chunks)
    slow = float(np.sqrt(excess / near)) if sure else 0.0
    return Noise(max(white, _LEAST_PX), slow)
