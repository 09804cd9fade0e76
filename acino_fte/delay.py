"""Where a marker is between two frames: a camera that is triggered late sees it at t + τ.

With the marker's positions p at the frames n, n−1, n−2 of a stencil, and the time u (in frames, relative to
frame n), quadratic interpolation gives

    p(u) = w₀ p_n + w₁ p_{n−1} + w₂ p_{n−2},   w₀ = (u+1)(u+2)/2,  w₁ = −u(u+2),  w₂ = u(u+1)/2

(Lagrange), so that ∂p/∂τ is the marker's own velocity and ∂²p/∂τ² its acceleration, by the same backward
differences of frames that the motion model uses. The stencil is centred on the frame of the observation,
and moved inwards at both ends of the recording.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from acino_fte.codegen import Program, ProgramBuilder, cached_programs

NODES = 3


def _derive() -> dict[str, Program]:
    import sympy as sp

    u = sp.Symbol("u", real=True)
    weights = [(u + 1) * (u + 2) / 2, -u * (u + 2), u * (u + 1) / 2]
    slopes = [sp.diff(w, u) for w in weights]
    bends = [sp.diff(w, u) for w in slopes]
    return {
        "weights": ProgramBuilder([u]).program(weights),
        "all": ProgramBuilder([u]).program(weights + slopes + bends),
    }


@cache
def programs() -> dict[str, Program]:
    """``weights``: u → w₀, w₁, w₂; ``all``: also their first and second derivatives for u."""
    return cached_programs("delay", (Path(__file__),), _derive)


def stencil(frames: np.ndarray, n_frames: int) -> np.ndarray:
    """Newest frame of the stencil (K,) about the frames (K,) of a recording of at least three frames."""
    return np.clip(frames + 1, NODES - 1, n_frames - 1)


def weights(u: np.ndarray) -> np.ndarray:
    """Weights and their derivatives for u (K,): (3 orders, 3 nodes, K), newest node first."""
    out = np.empty((9, len(u)))
    programs()["all"].numpy_function([u], out)
    return out.reshape(3, NODES, -1)
