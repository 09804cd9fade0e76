"""How far the dots of one animal are from one epipolar plane, from the recording itself.

Before anything is matched: for some windows of 16 frames of the tracks of one view, the window of the other
view that is nearest in all of them, provided it is within a wide reach in nearly all. Windows in which a
track changes hands have no partner, or one by chance that is far off, so the noise is the lowest peak of the
logarithms of the mean squares, and the reach, a share of the image's diagonal, is made wider until there is
one well inside it. After matching, the noise is that of the matched dots: σ from the scatter of d about the
mean of a chunk of frames, σ_s from what the means of the chunks scatter beyond that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from acino_fte.data_tools.track_dots import Dots, Noise
from acino_fte.data_tools.track_evidence import REACH, Evidence, gather_evidence

_REACHES = (0.01, 0.02, 0.04, 0.08, 0.16)  # of the diagonal
_FEWEST, _ALWAYS = (8, 4, 2, 1), 0.9  # frames that windows must share; fewer for very short recordings
_WINDOW, _N_WINDOWS = 16, 500
_TOO_FEW, _TENTH = 4, 0.1
_PEAK = 2.0  # half width of a peak, in standard deviations of the logarithm of a mean square
_LEAST_PX = 0.02
_LEAST_SLOW = 0.03  # of the white noise
_LEAST_DOTS = 8
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
    for fewest in _FEWEST:
        for share in _REACHES:
            reach = share * diagonal
            found = [_best_partners(a, b, reach, fewest) for a, b in pairs]
            noise = _lowest_peak(np.concatenate(found), fewest) if found else None
            if noise is not None and noise < reach / 5:
                return _noise(noise, 0.0)
    return None


def _lowest_peak(squares: np.ndarray, n_dots: int) -> float | None:
    """Root of the mean squares about which the lowest tenth of the windows gather; None for too few windows.

    The median of a mean of n squares is (1 − 2/9n)³ of the variance (Wilson and Hilferty 1931).
    """
    if len(squares) < _TOO_FEW:
        return None
    level = np.sort(np.log(np.maximum(squares, _LEAST_PX**2 / 4)))
    width = _PEAK * np.sqrt(2.0 / n_dots)
    count = np.searchsorted(level, level + 2 * width, side="right") - np.arange(len(level))
    centre = level[np.argmax(count >= max(_TOO_FEW, _TENTH * len(level)))] + width
    for _ in range(10):
        inside = np.abs(level - centre) <= width
        if not inside.any():
            return None
        centre = float(np.median(level[inside]))
    return float(np.exp(0.5 * centre) / (1.0 - 2.0 / (9.0 * n_dots)) ** 1.5)


def _best_partners(a: Dots, b: Dots, reach: float, fewest: int) -> np.ndarray:
    """Mean d² of some windows of pieces of a with the nearest window of b."""
    a, b = _windows(a), _windows(b)
    if not a.n_pieces or not b.n_pieces:
        return np.empty(0)
    length = np.bincount(a.piece[a.piece >= 0], minlength=a.n_pieces)
    long = np.flatnonzero(length >= fewest)
    some = np.zeros(a.n_pieces, dtype=bool)
    some[long[:: max(1, len(long) // _N_WINDOWS)]] = True
    part = replace(a, piece=np.where((a.piece >= 0) & some[a.piece], a.piece, -1))
    e = gather_evidence(part, b, Noise(reach / REACH), weigh=False)
    good = (e.shared >= fewest) & (e.near >= _ALWAYS * e.shared)
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
    if near < _LEAST_DOTS:
        return before
    squares = sum(e.squares[p].sum() for e, p in zip(evidence, partners, strict=True))
    means = sum((e.squared_means[p]).sum() for e, p in zip(evidence, partners, strict=True))
    chunks = sum(e.chunks[p].sum() for e, p in zip(evidence, partners, strict=True))
    if near - chunks < _LEAST_DOTS:
        return _noise(float(np.sqrt(squares / near * _TRIM)), 0.0)
    within = (squares - means) / (near - chunks)
    white = float(np.sqrt(within * _TRIM))
    excess = means - chunks * within
    sure = excess > _SURE * within * np.sqrt(2.0 * chunks)
    slow = float(np.sqrt(excess / near)) if sure else 0.0
    return _noise(white, slow)


def _noise(white: float, slow: float) -> Noise:
    """No noise is nought, and no calibration is perfect."""
    white = max(white, _LEAST_PX)
    return Noise(white, max(slow, _LEAST_SLOW * white))
