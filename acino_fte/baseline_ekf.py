"""The baseline ``ekf``: an iterated extended Kalman filter and smoother on the skeleton.

The state is (q, Δt·q̇, Δt²·q̈): in these units backward Euler with acceleration as a random walk (theory,
eq. 10) is one matrix of ones and zeros whatever the frame rate, and covariances are well scaled. Every
detection of a frame is a measurement with the marker's ``sd_px``, and so is the weak prior on limited joints
(theory, eq. 9, last sum). The smoother then minimises the objective of the trajectory problem with a squared
loss over the detections it accepted.

*Filter and smoother.* ``filterpy.kalman.ExtendedKalmanFilter`` predicts and updates, ``filterpy.kalman.
rts_smoother`` smooths (Rauch, Tung and Striebel 1965). filterpy inverts a matrix as large as the measurement:
up to 2·C·M rows, of which no more than Q are independent. A QR decomposition of the whitened rows makes them
Q equivalent ones first (:func:`compress`).

*Linearisation.* About the initial trajectory in the first pass and about the smoothed one in the others, with
the same prior on the first frame in each: the iterated extended Kalman smoother, which is Gauss–Newton on the
batch problem (Bell 1994). Linearised about its own predictions, as a filter that runs live has to, the first
pass loses limbs where the skeleton does not fit the animal.

*Gate.* A detection counts if its squared Mahalanobis distance rᵀS⁻¹r, S = H·P·Hᵀ + R, is below the 99 %
quantile of χ² with two degrees of freedom (Bar-Shalom, Li and Kirubarajan 2001). r and P are those of the
prediction in the first pass and those of the smoothed trajectory in the others, which also knows what comes
after; the test is a little lenient there, because a detection that was accepted before has pulled on it. A
detection that fails leaves the measurement altogether: H, R and r lose its rows.

*Noise.* ``sd_px`` is that of the detector. Where the skeleton does not fit, residuals are larger, and a gate
at 99 % would reject nearly all detections. R is therefore (f·sd_px)², with f from the median residual of the
initial trajectory and never below one (:func:`misfit`).

The ranges of the joints are no part of a Kalman filter: the smoothed q is clipped to them at the end.

Shapes: N frames, C cameras, M markers, Q degrees of freedom, D = 3 Q states, K rows of measurement (or K
detections, of two rows each).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from acino_fte.baseline_tri import marker_sd, project_all
from acino_fte.cameras import CameraArray
from acino_fte.condensed import Condensed
from acino_fte.initialise import initial_trajectory
from acino_fte.kinematics import Kinematics
from acino_fte.problem import FTEOptions, FTEProblem, build_fte
from acino_fte.result import FTEResult, Status
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton
from acino_fte.terms import model_term, prior_term

GATE = -2.0 * float(np.log(0.01))
"""99 % quantile of χ² with two degrees of freedom, whose distribution is 1 − exp(−x/2)."""
PASSES = 3
_START_SD = {"turn": 0.5, "slide": 0.1}  # of q in the first frame about the initial trajectory, rad and m
_START_TIME = 0.05  # s: that of q̇ is so much in this time, and of q̈ in its square
_NOTABLE = 1.5  # misfit worth a sentence
_LOST = 0.5  # share of accepted detections below which the filter is on something else than the animal
_BLOCK = 128  # frames smoothed together: rts_smoother copies all it is given three times


# --- linear filter and smoother ----------------------------------------------------------------------


class Measurement(NamedTuple):
    """z = H·x + v with independent v: H (K, D), variances of v (K,), z (K,)."""

    matrix: np.ndarray
    variance: np.ndarray
    value: np.ndarray


@dataclass(frozen=True, eq=False)
class Smoothed:
    """States given all measurements: mean (N, D), covariance (N, D, D)."""

    mean: np.ndarray
    covariance: np.ndarray


Measure = Callable[[int, np.ndarray, np.ndarray], Measurement]


def kalman_smoother(
    n_frames: int,
    transition: np.ndarray,
    process: np.ndarray,
    measure: Measure,
    mean: np.ndarray,
    covariance: np.ndarray,
) -> Smoothed:
    """Kalman filter and Rauch–Tung–Striebel smoother of x_n = F·x_{n−1} + w, w ~ N(0, Q).

    Parameters
    ----------
    n_frames : int
        N.
    transition, process : (D, D)
        F and Q, the same for every step.
    measure : callable
        The measurement of a frame from (frame, predicted mean (D,), predicted covariance (D, D)). It may
        have any number of rows, none as well.
    mean, covariance : (D,), (D, D)
        Of the first frame before its measurement.
    """
    from filterpy.kalman import ExtendedKalmanFilter, rts_smoother  # takes a second to import

    size = len(mean)
    kalman = ExtendedKalmanFilter(size, size)
    kalman.x, kalman.P = np.array(mean, dtype=float), np.array(covariance, dtype=float)
    kalman.F, kalman.Q = transition, process
    means, covariances = np.empty((n_frames, size)), np.empty((n_frames, size, size))
    for n in range(n_frames):
        if n:
            kalman.predict()
        matrix, variance, value = compress(measure(n, kalman.x, kalman.P))
        if len(value):
            kalman.update(value, lambda _, h=matrix: h, lambda x, h=matrix: h @ x, R=np.diag(variance))
        means[n], covariances[n] = kalman.x, kalman.P
    for stop in range(n_frames, 1, -_BLOCK):  # the last frame of a block is the first of the one before
        part = slice(max(stop - _BLOCK - 1, 0), stop)
        steps = part.stop - part.start
        means[part], covariances[part], _, _ = rts_smoother(
            means[part], covariances[part], [transition] * steps, [process] * steps
        )
    return Smoothed(means, covariances)


def compress(measurement: Measurement) -> Measurement:
    """An equivalent measurement with no more rows than columns of H that are not zero.

    With R^(−½)·H = U·T (QR) the likelihood of x depends on z through Uᵀ·R^(−½)·z alone, whose noise is white
    (Bierman 1977, Factorization Methods for Discrete Sequential Estimation).
    """
    sd = np.sqrt(measurement.variance)
    matrix, value = measurement.matrix / sd[:, None], measurement.value / sd
    touched = np.flatnonzero(matrix.any(axis=0))
    if len(value) > len(touched):
        orthogonal, triangle = np.linalg.qr(matrix[:, touched])
        matrix = np.zeros((len(touched), matrix.shape[1]))
        matrix[:, touched] = triangle
        value = orthogonal.T @ value
    return Measurement(matrix, np.ones(len(value)), value)


def constant_acceleration(noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F and Q (D, D) of the state (q, Δt·q̇, Δt²·q̈); ``noise`` (Q,) is Δt² times the sd of the jump of q̈.

    q̈' = q̈ + w, q̇' = q̇ + Δt·q̈', q' = q + Δt·q̇' (theory, eq. 10), so w enters all three alike.
    """
    steps = np.array([[1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    return np.kron(steps, np.eye(len(noise))), np.kron(np.ones((3, 3)), np.diag(noise**2))


def inside_gate(
    slope: np.ndarray, residual: np.ndarray, sd: np.ndarray, covariance: np.ndarray, gate: float = GATE
) -> np.ndarray:
    """(K,) bool: whether residuals (K, 2) of K detections are as small as their covariance says.

    ``slope`` (K, 2, Q) are the detections' derivatives for q, ``sd`` (K,) their standard deviations, px, and
    ``covariance`` (Q, Q) that of q.
    """
    spread = slope @ covariance @ np.swapaxes(slope, 1, 2) + (sd**2)[:, None, None] * np.eye(2)
    distance = (residual * np.linalg.solve(spread, residual[..., None])[..., 0]).sum(-1)
    return distance < gate


# --- the animal --------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Observer:
    """What every frame measures of the state, linearised about a trajectory.

    Attributes
    ----------
    kinematics, cameras
    pixels : (N, C, M, 2)
    sd_px : (M,)
    dofs, mean, sd : (L,)
        The prior on the limited joints: which, m or rad.
    about : (N, Q)
        Trajectory to linearise about.
    covariance : (N, Q, Q), optional
        Of that trajectory, to gate with; without it the gate is about the prediction.
    accepted : (N, C, M) bool
        Detections that passed the gate, of the frames that were measured.
    """

    kinematics: Kinematics
    cameras: CameraArray
    pixels: np.ndarray
    sd_px: np.ndarray
    dofs: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    about: np.ndarray
    covariance: np.ndarray | None = None
    accepted: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        linear = self.kinematics.linearise(self.about)
        seen, self._by_point = project_all(self.cameras, linear.positions)
        self._by_dof = linear.jacobian
        self._residual = self.pixels - seen  # NaN behind a camera
        self.accepted = np.zeros(self.pixels.shape[:3], dtype=bool)

    @property
    def share(self) -> float:
        """Share of the detections that passed the gate."""
        return float(self.accepted.sum() / max(np.isfinite(self.pixels).all(-1).sum(), 1))

    def __call__(self, frame: int, mean: np.ndarray, covariance: np.ndarray) -> Measurement:
        """The measurement of a frame; mean (D,) and covariance (D, D) are of its prediction."""
        about, residual = self.about[frame], self._residual[frame]
        n_dofs = len(about)
        camera, marker = np.nonzero(np.isfinite(residual).all(-1))
        slope = self._by_point[frame, camera, marker] @ self._by_dof[frame, marker]  # (K, 2, Q)
        residual, sd = residual[camera, marker], self.sd_px[marker]
        if self.covariance is None:
            innovation = residual - slope @ (mean[:n_dofs] - about)
            good = inside_gate(slope, innovation, sd, covariance[:n_dofs, :n_dofs])
        else:
            good = inside_gate(slope, residual, sd, self.covariance[frame])
        self.accepted[frame, camera, marker] = good
        value = (residual[good] + slope[good] @ about).ravel()
        matrix = np.zeros((len(value) + len(self.dofs), len(mean)))
        matrix[: len(value), :n_dofs] = slope[good].reshape(-1, n_dofs)
        matrix[len(value) + np.arange(len(self.dofs)), self.dofs] = 1.0
        variance = np.concatenate([np.repeat(sd[good], 2), self.sd]) ** 2
        return Measurement(matrix, variance, np.concatenate([value, self.mean]))


def estimate_ekf(
    sequence: Sequence,
    kinematics: Kinematics,
    options: FTEOptions | None = None,
    *,
    start: np.ndarray | None = None,
    progress: Callable[[int, float], None] | None = None,
    seconds: dict[str, float] | None = None,
) -> FTEResult:
    """Filter and smooth a sequence (module docstring).

    ``start`` (N, Q) is :func:`acino_fte.initialise.initial_trajectory` unless given. ``objective`` is that of
    the trajectory problem at the result (theory, eq. 9), so that it compares with ``fte``; ``iterations`` are
    passes. ``q_sd`` and ``position_covariance`` are the smoother's, which knows no ranges. The status is
    ``diverged`` when most detections failed the gate. ``parameters["noise_px"]`` has f·sd_px where f > 1.

    Raises
    ------
    InputError
        No detection is above the likelihood threshold, or no marker can be triangulated.
    """
    options = replace(options or FTEOptions(), fit=())
    began = time.perf_counter()
    problem = build_fte(sequence, kinematics, options)
    if start is None:
        start = initial_trajectory(sequence, kinematics, options)
    pixels = sequence.pixels(kinematics.skeleton.marker_names, options.likelihood)
    table = marker_sd(kinematics.skeleton)
    factor = misfit(sequence.cameras.project(kinematics.positions(start)) - pixels, table)
    prior = _prior(kinematics.skeleton, options.prior_width)
    observer = _Observer(kinematics, sequence.cameras, pixels, factor * table, *prior, about=start)
    initialised = time.perf_counter()
    states = _iterate(observer, problem, start, progress)
    spent = {"initialise": initialised - began, "solve": time.perf_counter() - initialised}
    linear = kinematics.linearise(states.q)
    return FTEResult(
        status=Status.CONVERGED if states.share >= _LOST else Status.DIVERGED,
        sequence=sequence,
        skeleton=kinematics.skeleton,
        q=states.q,
        dq=states.dq,
        ddq=states.ddq,
        positions=linear.positions,
        observed=pixels,
        reprojected=sequence.cameras.project(linear.positions),
        objective=states.objective,
        iterations=PASSES,
        method="ekf",
        seconds={**(seconds or {}), **spent},
        options={"problem": options.summary(), "solver": {"passes": PASSES, "gate": GATE}},
        parameters={"noise_px": _by_marker(kinematics, factor * table)} if factor > 1 else {},
        q_sd=np.sqrt(np.maximum(np.diagonal(states.covariance, axis1=1, axis2=2), 0.0)),
        position_covariance=_carry(linear.jacobian, states.covariance),
        findings=_findings(states.share, factor),
    )


class _States(NamedTuple):
    """Where the passes end: q, dq, ddq (N, Q), covariance of q (N, Q, Q), share accepted, objective."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    covariance: np.ndarray
    share: float
    objective: float


def _iterate(
    observer: _Observer,
    problem: FTEProblem,
    start: np.ndarray,
    progress: Callable[[int, float], None] | None,
) -> _States:
    """Filter and smooth :data:`PASSES` times, each about the trajectory of the one before."""
    condensed, fps, n_dofs = Condensed(problem), problem.fps, start.shape[1]
    for number in range(1, PASSES + 1):
        smoothed = _smooth(observer, start, fps, problem.options.noise_scale)
        about, covariance = smoothed.mean[:, :n_dofs], smoothed.covariance[:, :n_dofs, :n_dofs]
        covariance = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
        q, share = problem.clip(about), observer.share
        objective = condensed.objective(q.ravel())
        if progress is not None:
            progress(number, objective)
        if number < PASSES:
            observer = replace(observer, about=about, covariance=covariance)
    dq = _rate(q, fps, smoothed.mean[0, n_dofs : 2 * n_dofs] * fps)
    ddq = _rate(dq, fps, smoothed.mean[0, 2 * n_dofs :] * fps**2)
    return _States(q, dq, ddq, covariance, share, objective)


def misfit(residuals: np.ndarray, sd_px: np.ndarray) -> float:
    """Factor f ≥ 1 on ``sd_px`` (M,) that residuals (N, C, M, 2), px, speak for; NaN where nothing was seen.

    The median length of a 2-vector of independent normal components is √(2 ln 2) standard deviations.
    """
    length = np.linalg.norm(residuals, axis=-1) / sd_px
    known = length[np.isfinite(length)]
    return max(1.0, float(np.median(known)) / np.sqrt(2.0 * np.log(2.0))) if known.size else 1.0


def _prior(skeleton: Skeleton, width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The prior on the limited joints of one frame: which, mean and sd (L,), m or rad."""
    if not width:
        return np.empty(0, dtype=int), np.empty(0), np.empty(0)
    term = prior_term(skeleton, 1, width)
    return term.items[:, 0], np.asarray(term.data["mean"]), term.sd


def _smooth(observer: _Observer, start: np.ndarray, fps: float, noise_scale: float) -> Smoothed:
    """One pass: the states (N, D) given all detections, from the initial trajectory (N, Q)."""
    skeleton = observer.kinematics.skeleton
    noise = model_term(skeleton, 2, fps).sd * noise_scale / fps**2  # of one step
    velocity = start[1] - start[0] if len(start) > 1 else np.zeros(len(noise))
    mean = np.concatenate([start[0], velocity, np.zeros(len(noise))])
    sd, step = np.array([_START_SD[dof.kind] for dof in skeleton.dofs]), 1.0 / (fps * _START_TIME)
    covariance = np.diag(np.concatenate([sd, sd * step, sd * step**2]) ** 2)
    return kalman_smoother(len(start), *constant_acceleration(noise), observer, mean, covariance)


def _rate(values: np.ndarray, fps: float, first: np.ndarray) -> np.ndarray:
    """Backward differences in time of values (N, Q), per s; ``first`` (Q,) is that of the first frame."""
    return np.concatenate([first[None], np.diff(values, axis=0) * fps])


def _carry(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariance (N, M, 3, 3), m², of positions with ∂p/∂q (N, M, 3, Q) given that of q (N, Q, Q): J·P·Jᵀ."""
    n, m, _, n_dofs = jacobian.shape
    carried = (jacobian.reshape(n, 3 * m, n_dofs) @ covariance).reshape(jacobian.shape)
    return carried @ np.swapaxes(jacobian, -1, -2)


def _by_marker(kinematics: Kinematics, values: np.ndarray) -> dict[str, float]:
    return dict(zip(kinematics.skeleton.marker_names, values.tolist(), strict=True))


def _findings(share: float, factor: float) -> tuple[str, ...]:
    """What the filter noticed, one sentence each."""
    found = [f"{share:.1%} of the detections passed the filter's gate."]
    if factor > _NOTABLE:
        found.append(
            f"The skeleton fits the detections {factor:.1f} times worse than their sd_px says, "
            "and the filter took that as their noise."
        )
    return tuple(found)
