"""Smooths many paths at once: block-banded Gaussian systems, their solution and covariance, in linear time.

All pieces stand in one banded matrix H = Λ + P (Λ: what the views know of each frame; P: the prior of
:mod:`trajectory_motion`), whose Cholesky factor is one call of LAPACK. The covariance of each frame is the
selected inverse (Takahashi, Fagan and Chin 1973): with the factor's block column L_(N,t) of the three next
frames N and C = L_(N,t) L_tt⁻¹,

    Σ_(N,t) = −Σ_NN C,   Σ_tt = (L_tt L_ttᵀ)⁻¹ + Cᵀ Σ_NN C,

from the last frame to the first, all pieces side by side. It equals the smoother of Rauch, Tung and
Striebel (1965). Shapes: T nodes, S pieces.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs

from acino_fte.data_tools.trajectory_motion import N_LAGS, MotionModel, Pieces, prior_band

_NEXT = 3 * N_LAGS

_RIDGES = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)  # shares of the diagonal


class ChainFactor:
    """Cholesky factor of H for all pieces.

    Parameters
    ----------
    information : (T, 3, 3)
        Λ, symmetric.
    motion : MotionModel
        The prior.
    pieces : Pieces
        Which frames hang together.
    weight : (T,), optional
        Factor on the prior's information of each innovation.

    Raises
    ------
    numpy.linalg.LinAlgError
        H is not positive definite, or not finite.
    """

    def __init__(
        self,
        information: np.ndarray,
        motion: MotionModel,
        pieces: Pieces,
        weight: np.ndarray | None = None,
    ) -> None:
        self._pieces = pieces
        self._coefficients, self._tails = motion.coefficients[N_LAGS], motion.tails
        n = pieces.n_nodes
        self._prior = prior_band(motion, pieces, weight)
        band = np.zeros((n, 3, _NEXT + 3))  # LAPACK's columns: one per coordinate, its diagonal first
        for axis in range(3):
            band[:, axis, ::3] = self._prior.T
            for row in range(axis, 3):
                band[:, axis, row - axis] += information[:, row, axis]
        self._factor = _cholesky(band.reshape(3 * n, -1).T)

    @property
    def log_determinant(self) -> float:
        """log det H."""
        return 2.0 * float(np.log(self._factor[0]).sum())

    def solve(self, right: np.ndarray) -> np.ndarray:
        """H⁻¹ times (T, 3)."""
        return dpbtrs(self._factor, right.reshape(-1, 1), lower=1)[0].reshape(-1, 3)

    def prior_times(self, x: np.ndarray) -> np.ndarray:
        """P x of (T, 3)."""
        out = self._prior[0][:, None] * x
        for lag in range(1, min(N_LAGS, len(x) - 1) + 1):
            part = self._prior[lag, : len(x) - lag, None]
            out[lag:] += part * x[:-lag]
            out[:-lag] += part * x[lag:]
        return out

    def covariance(self) -> np.ndarray:
        """Σ_tt of every node, (T, 3, 3)."""
        return self.covariance_and_spread()[0]

    def covariance_and_spread(self) -> tuple[np.ndarray, np.ndarray]:
        """Σ_tt of every node (T, 3, 3), and the variance of its innovation (T,), sum of the axes, m².

        The variance is that of the fourth and later frames of a piece; zero for those before.
        """
        out, spread = np.empty((self._pieces.n_nodes, 3, 3)), np.zeros(self._pieces.n_nodes)
        order = np.argsort(-self._pieces.length, kind="stable")
        for part in np.array_split(order, max(1, self._pieces.n_nodes // 200_000)):
            self._sweep(part, out, spread)
        return out, spread

    def _columns(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """C (K, 9, 3) and (L_tt L_ttᵀ)⁻¹ (K, 3, 3) of nodes."""
        packed = self._factor.T.reshape(-1, 3, _NEXT + 3)[nodes]
        full = np.zeros((len(nodes), _NEXT + 3, 3))
        for axis in range(3):
            full[:, axis:, axis] = packed[:, axis, : _NEXT + 3 - axis]
        inverse = _inverse_lower(full[:, :3])
        return full[:, 3:] @ inverse, inverse.transpose(0, 2, 1) @ inverse

    def _sweep(self, chosen: np.ndarray, out: np.ndarray, spread: np.ndarray) -> None:
        """Fill `out` and `spread` for some pieces, given longest first."""
        length = self._pieces.length[chosen]
        last = self._pieces.start[chosen] + length - 1
        active = np.searchsorted(-length, -np.arange(length.max(initial=0)), side="left")
        begin = np.cumsum(active) - active
        back = np.repeat(np.arange(len(active)), active)
        piece = np.arange(len(back)) - np.repeat(begin, active)
        nodes = last[piece] - back
        c, own = self._columns(nodes)
        c, own = -c, 0.5 * own
        half = 0.5 * c.transpose(0, 2, 1)
        cross, block = np.empty_like(c), np.empty_like(own)  # Σ_(N,t), Σ_tt
        window, shifted = np.zeros((2, len(chosen), _NEXT, _NEXT))
        for first, count in zip(begin.tolist(), active.tolist(), strict=True):  # few rows: mind every call
            at = slice(first, first + count)
            w, x = window[:count], shifted[:count]
            beside = np.matmul(w, c[at], out=cross[at])
            part = half[at] @ beside
            part += own[at]
            part = np.add(part, part.transpose(0, 2, 1), out=block[at])  # or rounding grows without bound
            x[:, 3:, 3:] = w[:, :-3, :-3]
            x[:, :3, :3] = part
            x[:, 3:, :3] = beside[:, :-3]
            x[:, :3, 3:] = beside[:, :-3].transpose(0, 2, 1)
            window, shifted = shifted, window
        out[nodes] = block
        if np.isfinite(self._tails):
            fourth = back >= N_LAGS
            here = (
                begin[back[fourth] - np.arange(N_LAGS + 1)[:, None]] + piece[fourth]
            )  # t, t + 1, t + 2, t + 3
            spread[nodes[fourth] + N_LAGS] = self._innovation(here, block, cross)

    def _innovation(self, here: np.ndarray, block: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """Variance (K,) of the innovations of four frames each, whose rows are (4, K), sum of the axes."""
        trace = np.concatenate(
            [np.trace(block, axis1=1, axis2=2)[None], np.einsum("klaa->lk", cross.reshape(-1, N_LAGS, 3, 3))]
        )
        factors = self._coefficients[::-1]  # of t, t + 1, t + 2, t + 3
        total = np.zeros(here.shape[1])
        for i, first in enumerate(factors):
            total += first**2 * trace[0, here[i]]
            for lag, second in enumerate(factors[i + 1 :], 1):
                total += 2 * first * second * trace[lag, here[i]]
        return total


def _cholesky(band: np.ndarray) -> np.ndarray:
    """Banded Cholesky factor, with a little more on the diagonal where rounding needs it."""
    for ridge in _RIDGES:
        firmer = band.copy()
        firmer[0] += ridge * np.abs(band[0])
        factor, info = dpbtrf(firmer, lower=1, overwrite_ab=1)
        if not info and np.isfinite(factor[0]).all():
            return factor
    raise np.linalg.LinAlgError(f"the information is not positive definite at node {(info - 1) // 3}")


def _inverse_lower(matrix: np.ndarray) -> np.ndarray:
    """Inverse of lower triangles (K, 3, 3)."""
    a, b, c = (1.0 / matrix[:, i, i] for i in range(3))
    out = np.zeros_like(matrix)
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = a, b, c
    out[:, 1, 0] = -matrix[:, 1, 0] * a * b
    out[:, 2, 1] = -matrix[:, 2, 1] * b * c
    out[:, 2, 0] = (matrix[:, 2, 1] * matrix[:, 1, 0] * b - matrix[:, 2, 0]) * a * c
    return out
