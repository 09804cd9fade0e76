"""How likely is a piece of track to have a partner in another view at all? Learnt from the recording.

Reflections, insects and noise make short tracks that no other view has; animals make longer ones. The share π
of pieces with a partner is estimated for each length (1, 2–3, 4–7, 8–15 … dots) by expectation–maximisation:
with S the log of the mean Bayes factor of a piece over the pieces it might belong to,

    P(partner) = π e^S / (1 − π + π e^S),     π ← mean of P(partner)

(Dempster, Laird and Rubin 1977). A pair of pieces pays the prior log-odds of both its ends.
"""

from __future__ import annotations

import numpy as np

_STEPS = 30
_PSEUDO = 1.0  # one piece with a partner and one without, in every class of lengths


def partner_log_odds(
    n_dots: np.ndarray, u: np.ndarray, v: np.ndarray, weight: np.ndarray, n_views: int = 2
) -> np.ndarray:
    """Prior log-odds of having a partner, by length, never more than 0.

    Parameters
    ----------
    n_dots : (V,) int
        Length of every piece.
    u, v : (E,) int
        Pairs of pieces of different views.
    weight : (E,)
        Their log Bayes factors, less the log of the number of candidates in one view.
    n_views : int
        C; a piece has candidates in C − 1 views.

    Returns
    -------
    (V,)
    """
    n = len(n_dots)
    level = np.floor(np.log2(np.maximum(n_dots, 1))).astype(int)
    score = np.logaddexp(_log_sum(u, weight, n), _log_sum(v, weight, n)) - np.log(n_views - 1)
    total = np.bincount(level)
    share = np.full(len(total), 0.5)
    with np.errstate(over="ignore"):
        for _ in range(_STEPS):
            prior = np.log(share) - np.log1p(-share)
            probable = 1.0 / (1.0 + np.exp(-np.clip(score + prior[level], -700, 700)))
            share = (np.bincount(level, weights=probable, minlength=len(total)) + _PSEUDO) / (
                total + 2 * _PSEUDO
            )
    return np.minimum(np.log(share) - np.log1p(-share), 0.0)[level]


def _log_sum(who: np.ndarray, weight: np.ndarray, n: int) -> np.ndarray:
    """Log of the sum of e^weight of the pairs of each piece, (V,); −∞ for none."""
    top = np.full(n, -np.inf)
    np.maximum.at(top, who, weight)
    safe = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        return safe + np.log(np.bincount(who, weights=np.exp(weight - safe[who]), minlength=n))
