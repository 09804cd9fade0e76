"""Factorisation of a block-banded matrix with an arrow: all frames, and a few parameters they share.

The Hessian of a trajectory (N frames, Q degrees of freedom) and of P parameters shared by all frames is

    H = [[A, B], [Bᵀ, D]],   A(n, m) = 0 for |n − m| > L.

LAPACK's banded Cholesky factorisation takes A apart. Frames are then grouped into super-blocks, L at a time,
and A is block tridiagonal. With the factor's own super-blocks (Golub and Van Loan 2013, §4.5.1),

    L_i L_iᵀ = D_i = A_ii − W_i W_iᵀ,   W_i = A_(i,i−1) L_(i−1)⁻ᵀ,

substitution runs through them, and the blocks of Σ = A⁻¹ inside the band follow from one sweep back,
without the rest of the inverse (Takahashi, Fagan and Chin 1973; Erisman and Tinney 1975; Rue, Martino and
Chopin 2009 take the marginal variances of latent Gaussian models from it):

    Σ_ii = D_i⁻¹ + G_i Σ_(i+1,i+1) G_iᵀ,   Σ_(i,i+1) = −G_i Σ_(i+1,i+1),   G_i = D_i⁻¹ A_(i,i+1),

which is the smoother of Rauch, Tung and Striebel (1965). The parameters enter by the Schur complement of
the band (block inverse of H; Horn and Johnson 2013, §0.7.3):

    S = D − Bᵀ A⁻¹ B,   cov(θ) = S⁻¹,   cov(q, θ) = −Z S⁻¹,   cov(q) = A⁻¹ + Z S⁻¹ Zᵀ,   Z = A⁻¹ B.

Time and memory grow linearly with N.

Products go through SciPy's BLAS like the factorisations, not through NumPy's: each may bring its own
library, and the idle threads of the one keep those of the other from the processor (measured: twenty times
slower on two cores).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided
from scipy.linalg.blas import dgemm, dsyrk, dtrsm
from scipy.linalg.lapack import dpbtrf, dpotrf, dtrtri


class NotPositiveDefinite(np.linalg.LinAlgError):
    """The matrix has no Cholesky factor: some direction has no information, or the wrong curvature."""


@dataclass(frozen=True)
class SelectedInverse:
    """Blocks of Σ = H⁻¹ inside the band and in the arrow.

    Attributes
    ----------
    blocks : list of (N, Q, Q)
        Item l holds Σ(n, n − l) at index n; zeros where n < l.
    cross : (N, Q, P)
        Between frames and parameters.
    corner : (P, P)
        Of the parameters.
    """

    blocks: list[np.ndarray]
    cross: np.ndarray
    corner: np.ndarray


class ArrowFactor:
    """Cholesky factor of a symmetric positive definite H = [[A, B], [Bᵀ, D]].

    Parameters
    ----------
    blocks : list of (N, Q, Q)
        Item l holds A(n, n − l) at index n, l = 0 … L; what stands at n < l is ignored. Of the diagonal
        blocks only the lower triangle is read.
    arrow : (N, Q, P)
        B; P may be 0.
    corner : (P, P)
        D; only the lower triangle is read.

    Attributes
    ----------
    shape : tuple of int
        N, Q, P.
    log_determinant : float
        log det H.
    schur : (P, P)
        S = D − Bᵀ A⁻¹ B: the information about the parameters when the trajectory is marginalised.

    Raises
    ------
    NotPositiveDefinite
        H is not positive definite, or not finite.
    """

    def __init__(self, blocks: list[np.ndarray], arrow: np.ndarray, corner: np.ndarray) -> None:
        n, size, _ = blocks[0].shape
        self.shape = (n, size, len(corner))
        self._n_lags = len(blocks)
        self._group = max(1, min(len(blocks), n) - 1)  # frames in a super-block
        self._count = -(-n // self._group)
        _check_finite(arrow, np.tril(corner))
        self._factors, self._couplings = self._factorise(blocks)
        self._arrow = self._padded(arrow)
        if self._arrow.size:
            self._arrow = self._forward(self._arrow)  # L⁻¹B
        schur = np.tril(corner)
        self.schur = schur + np.tril(schur, -1).T - _gram(_rows(self._arrow))
        self._corner = _factor(self.schur, "the parameters")
        diagonals = [np.diagonal(self._factors, axis1=1, axis2=2), np.diagonal(self._corner)]
        self.log_determinant = 2 * float(sum(np.log(d).sum() for d in diagonals))

    def solve(self, state: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """H⁻¹ times a vector, or times K of them.

        Parameters
        ----------
        state : numpy.ndarray
            (N, Q) or (N, Q, K), the rows of the frames.
        corner : numpy.ndarray
            (P,) or (P, K), the rows of the parameters.

        Returns
        -------
        tuple of numpy.ndarray
            The same shapes.
        """
        n, size, p = self.shape
        half = self._forward(self._padded(state.reshape(n, size, -1)))
        if not p:
            return self._frames(self._backward(half)).reshape(state.shape), corner.copy()
        arrow = _rows(self._arrow)
        below = _product(arrow, _rows(half), scale=-1.0, add=corner.reshape(p, -1), transposed=True)
        theta = _up(self._corner, _down(self._corner, below))
        rest = _product(arrow, theta, scale=-1.0, add=_rows(half))
        q = self._backward(rest.reshape(half.shape))
        return self._frames(q).reshape(state.shape), theta.reshape(corner.shape)

    def selected_inverse(self) -> SelectedInverse:
        """Blocks of H⁻¹ inside the band and in the arrow, O(N)."""
        n, size, p = self.shape
        blocks = self._scatter(*self._band_inverse())
        if not p:
            return SelectedInverse(blocks, np.zeros(self.shape), np.zeros((0, 0)))
        z = self._frames(self._backward(self._arrow))  # A⁻¹B
        half = _down(self._corner, np.eye(p))  # with S = L_S L_Sᵀ: L_S⁻¹
        root = _product(_rows(z), np.ascontiguousarray(half.T)).reshape(n, size, p)  # Z L_S⁻ᵀ
        cross = _product(_rows(root), half, scale=-1.0).reshape(n, size, p)
        for lag, block in enumerate(blocks[:n]):
            block[lag:] += root[lag:] @ root[: n - lag].transpose(0, 2, 1)
        return SelectedInverse(blocks, cross, _gram(half))

    # --- frames and super-blocks -------------------------------------------------------------------

    def _places(self, lag: int) -> Iterator[tuple[int, int, bool]]:
        """Row, column and whether it is in the same super-block, of each frame of a super-block."""
        for row in range(self._group):
            yield row, (row - lag) % self._group, row >= lag

    def _scatter(self, diagonal: np.ndarray, lower: np.ndarray) -> list[np.ndarray]:
        """Frame blocks (N, Q, Q) of each lag from super-blocks, the inverse of :meth:`_gather`."""
        (n, size, _), group, count = self.shape, self._group, self._count
        diagonal = diagonal.reshape(count, group, size, group, size)
        lower = lower.reshape(count, group, size, group, size)
        blocks = np.zeros((self._n_lags, count * group, size, size))
        for lag, block in enumerate(blocks[: group + 1]):
            for row, column, same in self._places(lag):
                block[row::group] = (diagonal if same else lower)[:, row, :, column]
            block[:lag] = 0.0
        return [block[:n] for block in blocks]

    def _padded(self, values: np.ndarray) -> np.ndarray:
        """(N, Q, K) by super-block, (count, S, K)."""
        n, size, _ = self.shape
        padded = np.zeros((self._count * self._group, size, values.shape[-1]))
        padded[:n] = values
        return padded.reshape(self._count, self._group * size, -1)

    def _frames(self, values: np.ndarray) -> np.ndarray:
        """(count, S, K) by frame, (N, Q, K)."""
        n, size, _ = self.shape
        return values.reshape(self._count * self._group, size, -1)[:n]

    # --- the band ----------------------------------------------------------------------------------

    def _factorise(self, blocks: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """L_i and W_i (W_0 unused), each (count, S, S); the end is padded with I."""
        (n, size, _), frames = self.shape, self._count * self._group
        width = (self._group + 1) * size - 1  # of the band, below its diagonal
        band = np.zeros((frames * size, width + 1))  # row j holds A(j, j), A(j + 1, j), …
        for lag, block in enumerate(blocks[: self._group + 1]):
            # A(i, j) stands at i + j · width of the flat array: a block is a view with these strides
            place = _view(band, lag * size, (frames - lag, size, size), (size * (width + 1), 1, width))
            if lag == 0:
                place[:n] = np.tril(block)  # first: what is above the diagonal falls into other blocks
                place[n:] = np.eye(size)
            else:
                place[: n - lag] = block[lag:]
        _check_finite(band)
        factor, info = dpbtrf(band.T, lower=1, overwrite_ab=1)
        if info:
            frame = (info - 1) // size
            raise NotPositiveDefinite(f"the matrix is not positive definite at frame {frame}")
        return self._super_blocks(factor.T, width)

    def _super_blocks(self, band: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Super-blocks of a factor in banded storage (columns of the matrix by row)."""
        full = self._group * self.shape[1]
        shape, strides = (self._count, full, full), (full * (width + 1), 1, width)
        row, column = np.indices((full, full))
        lower = np.zeros(shape)
        inside = full + row - column <= width
        if self._count > 1:
            between = _view(band, full, (self._count - 1, full, full), strides)
            np.copyto(lower[1:], between, where=inside)
        diagonal = np.zeros(shape)
        np.copyto(diagonal, _view(band, 0, shape, strides), where=row >= column)
        return diagonal, lower

    def _forward(self, values: np.ndarray) -> np.ndarray:
        """L⁻¹ times (count, S, K)."""
        out = np.empty_like(values)
        for i, value in enumerate(values):
            if i:
                value = _product(self._couplings[i], out[i - 1], scale=-1.0, add=value)
            out[i] = _down(self._factors[i], value)
        return out

    def _backward(self, values: np.ndarray) -> np.ndarray:
        """L⁻ᵀ times (count, S, K)."""
        out = np.empty_like(values)
        for i in range(self._count - 1, -1, -1):
            value = values[i]
            if i + 1 < self._count:
                value = _product(self._couplings[i + 1], out[i + 1], scale=-1.0, add=value, transposed=True)
            out[i] = _up(self._factors[i], value)
        return out

    def _band_inverse(self) -> tuple[np.ndarray, np.ndarray]:
        """Σ_ii and Σ_(i,i−1) of A⁻¹, each (count, S, S); the first Σ_(i,i−1) is zero."""
        diagonal, lower = np.empty_like(self._factors), np.zeros_like(self._couplings)
        for i in range(self._count - 1, -1, -1):
            inverse = dtrtri(self._factors[i].T, lower=0)[0].T  # L_i⁻¹
            diagonal[i] = _gram(inverse)
            if i + 1 < self._count:
                gain = _product(self._couplings[i + 1], inverse)  # G_iᵀ
                lower[i + 1] = _product(diagonal[i + 1], gain, scale=-1.0)
                carried = _product(gain, lower[i + 1], transposed=True)
                diagonal[i] -= 0.5 * (carried + carried.T)
        return diagonal, lower


def _check_finite(*parts: np.ndarray) -> None:
    if not all(np.isfinite(part.sum()) for part in parts):
        raise NotPositiveDefinite("the matrix has entries that are not finite")


def _view(array: np.ndarray, offset: int, shape: tuple[int, ...], strides: tuple[int, ...]) -> np.ndarray:
    """A view of a contiguous array with strides counted in entries."""
    flat = array.reshape(-1)[offset:]
    return as_strided(flat, shape, tuple(8 * s for s in strides))


# BLAS and LAPACK hold matrices by column, NumPy by row: each is handed its transpose, which costs no copy.


def _rows(values: np.ndarray) -> np.ndarray:
    """(…, S, K) as one tall matrix."""
    return values.reshape(np.prod(values.shape[:-1], dtype=int), values.shape[-1])


def _product(
    a: np.ndarray,
    b: np.ndarray,
    *,
    scale: float = 1.0,
    add: np.ndarray | None = None,
    transposed: bool = False,
) -> np.ndarray:
    """scale · a b, or scale · aᵀ b if transposed, plus `add`."""
    into = {} if add is None else {"beta": 1.0, "c": add.T}
    return dgemm(scale, b.T, a.T, trans_b=transposed, **into).T


def _gram(values: np.ndarray) -> np.ndarray:
    """XᵀX of X (S, K), K × K."""
    if not values.size:
        return np.zeros((values.shape[-1],) * 2)
    upper = dsyrk(1.0, values.T)  # zeros below its diagonal
    return upper + np.triu(upper, 1).T


def _factor(matrix: np.ndarray, where: str) -> np.ndarray:
    """Lower Cholesky factor; only the lower triangle of the matrix is read."""
    if not matrix.size:
        return matrix
    upper, info = dpotrf(matrix.T)
    if info:
        raise NotPositiveDefinite(f"the matrix is not positive definite at {where}")
    return upper.T


def _down(factor: np.ndarray, values: np.ndarray) -> np.ndarray:
    """L⁻¹ times (S, K)."""
    return dtrsm(1.0, factor.T, values.T, side=1).T


def _up(factor: np.ndarray, values: np.ndarray) -> np.ndarray:
    """L⁻ᵀ times (S, K)."""
    return dtrsm(1.0, factor.T, values.T, side=1, trans_a=1).T
