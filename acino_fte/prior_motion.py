"""Trajectories drawn from the estimator's own prior, for tests of what it says about its uncertainty.

The prior of :mod:`acino_fte.problem` is, for each degree of freedom on its own,

    −log p(q) = ½ Σ_{n≥3} (w_n / σ)²  +  ½ Σ_n ((q_n − mean) / (κ h))²  +  constant,
    w_n = (q_n − 3 q_{n−1} + 3 q_{n−2} − q_{n−3}) / dt²,

with σ the process noise of the species at this frame rate times ``noise_scale``, h half the range of the
degree of freedom and κ the ``prior_width``. Where there is a range this is a Gaussian with a banded precision
P = Uᵀ U, and U⁻¹ z with z standard normal is an exact draw (Rue and Held 2005, Gaussian Markov Random Fields,
algorithm 2.4). Without a range the second sum is absent: the prior says nothing of polynomials of degree two,
and w alone is drawn.
"""

from __future__ import annotations

import numpy as np

from acino_fte.errors import InputError
from acino_fte.kinematics import load_kinematics
from acino_fte.skeleton import Dof, Skeleton

_JUMP = (1.0, -3.0, 3.0, -1.0)  # w_n · dt², of q_n, q_{n−1}, …
_CLEARANCE = 0.02  # m, of the lowest marker above the ground


def prior_motion(
    skeleton: Skeleton,
    n_frames: int,
    fps: float,
    *,
    seed: int = 0,
    noise_scale: float = 1.0,
    prior_width: float = 0.25,
) -> np.ndarray:
    """Draw a trajectory from the prior with which :func:`acino_fte.problem.build_fte` estimates it.

    Joints with a range are drawn exactly, and are not clipped: with a prior width of 0.25 a range is four
    standard deviations to either side and hardly ever left, with the estimator's default of 2 mostly. Free
    degrees of freedom (the place and heading of the root) start from zero and lose the parabola that fits
    them best, which the prior does not see; what remains of the root's place is about half a metre after 120
    frames of a cheetah at 120 Hz and grows with the power 2.5 of the duration. Then the animal as a whole is
    put above the ground, which the prior does not see either.

    Parameters
    ----------
    skeleton : Skeleton
        Of any species.
    n_frames : int
        N.
    fps : float
        Hz.
    seed : int
        Each degree of freedom has its own stream.
    noise_scale, prior_width : float
        Of :class:`acino_fte.problem.FTEOptions`: give the estimator the same. Both above 0.

    Returns
    -------
    (N, Q) in rad and m.

    Raises
    ------
    InputError
        ``noise_scale`` or ``prior_width`` is not above 0.
    """
    for key, value in (("noise_scale", noise_scale), ("prior_width", prior_width)):
        if not 0 < value < np.inf:
            raise InputError(
                f"A motion cannot be drawn with this {key}.", key=key, expected="above 0", found=f"{value:g}"
            )
    streams = np.random.SeedSequence([seed, 0x9B]).spawn(len(skeleton.dofs))
    q = np.zeros((n_frames, len(skeleton.dofs)))
    for j, (dof, stream) in enumerate(zip(skeleton.dofs, streams, strict=True)):
        normal = np.random.default_rng(stream).standard_normal(n_frames)
        sd = noise_scale * process_noise(skeleton, dof, fps)
        if np.isfinite(dof.lower + dof.upper):
            q[:, j] = _draw_limited(normal, dof, sd, fps, prior_width)
        else:
            q[:, j] = _draw_free(normal, sd, fps)
    return _above_ground(skeleton, q)


def process_noise(skeleton: Skeleton, dof: Dof, fps: float) -> float:
    """Standard deviation of w at a frame rate (Hz), rad/s² or m/s²."""
    return float(dof.noise * np.sqrt(skeleton.noise_fps / fps))


def prior_precision(dof: Dof, n_frames: int, sd: float, fps: float, prior_width: float) -> np.ndarray:
    """Precision of a degree of freedom over time: its upper bands (4, N), as scipy.linalg keeps them.

    ``sd`` is the standard deviation of w, rad/s² or m/s². A degree of freedom without a range has none of
    the second sum (module docstring), and a singular precision.
    """
    bands = np.zeros((4, n_frames))
    if np.isfinite(dof.lower + dof.upper):
        bands[3] = (prior_width * 0.5 * (dof.upper - dof.lower)) ** -2
    if n_frames > 3:
        weight = (fps**2 / sd) ** 2
        for a, first in enumerate(_JUMP):
            for b, second in enumerate(_JUMP[a:], start=a):  # of q_{n−a} and of q_{n−b}, b ≥ a frames back
                bands[3 - (b - a), 3 - a : n_frames - a] += weight * first * second
    return bands


def _draw_limited(normal: np.ndarray, dof: Dof, sd: float, fps: float, prior_width: float) -> np.ndarray:
    """(N,) values of a degree of freedom with a range, from standard normals (N,)."""
    from scipy.linalg import cholesky_banded, solve_banded

    bands = prior_precision(dof, len(normal), sd, fps, prior_width)
    reach = min(3, len(normal) - 1)
    factor = cholesky_banded(bands[3 - reach :])
    return dof.middle + solve_banded((0, reach), factor, normal)


def _draw_free(normal: np.ndarray, sd: float, fps: float) -> np.ndarray:
    """(N,) values of a degree of freedom without a range: w (N,) added up, less the best parabola."""
    n_frames = len(normal)
    jump = np.where(np.arange(n_frames) < 3, 0.0, sd * normal)
    value = np.cumsum(np.cumsum(np.cumsum(jump))) / fps**2
    basis = np.vander(np.linspace(-1.0, 1.0, n_frames), 3)
    return value - basis @ np.linalg.lstsq(basis, value, rcond=None)[0]


def _above_ground(skeleton: Skeleton, q: np.ndarray) -> np.ndarray:
    """The same with the free vertical slide of the root moved so that no marker is ever below the ground."""
    for j in (j for link in skeleton.links if link.parent < 0 for j in link.dofs):
        dof = skeleton.dofs[j]
        if dof.kind == "slide" and dof.axis[2] != 0 and not np.isfinite(dof.lower + dof.upper):
            lowest = load_kinematics(skeleton).positions(q)[:, :, 2].min()
            q[:, j] += (_CLEARANCE - lowest) / dof.axis[2]
            break
    return q
