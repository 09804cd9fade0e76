"""The full trajectory estimation problem, stated but not solved.

Minimise over q (N, Q) and the global parameters θ (:mod:`acino_fte.parameters`), within their bounds, the
negative log-posterior

    Σ_frames,cameras,markers ρ(|π(p(q, θ)) − z|/σ_px)  +  Σ_frames,markers ρ(|d|/σ_m)
        +  ½ Σ (w/σ_w)²  +  ½ Σ ((q − mean)/σ_prior)²  +  ½ Σ (θ/σ_θ)²,

with d the depth residual where there is a lidar (:mod:`acino_fte.depth`) and w the jump of acceleration from
frame to frame (Joska et al. 2021, eq. 4–9, with the ½ of a Gaussian likelihood, so that the curvature at the
optimum is an information matrix).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from acino_fte import delay
from acino_fte.depth import DepthData, depth_terms, expected_surface, surface_sd, surface_term
from acino_fte.errors import InputError
from acino_fte.kinematics import Kinematics
from acino_fte.losses import Loss
from acino_fte.parameters import KINEMATIC, Parameters, PriorWidths, check_families, declare, with_surface
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton
from acino_fte.terms import Term, measurement_term, model_term, parameter_term, prior_term, size_terms

_NONE = Parameters()


@dataclass(frozen=True)
class FTEOptions:
    """Options of the trajectory problem.

    Attributes
    ----------
    likelihood : float
        Detections count when their likelihood is above this (0–1).
    loss : Loss
        Loss of the measurements.
    noise_scale : float
        Factor on the process noise of the species: above 1 follows the data more closely, below 1
        gives smoother motion.
    prior_width : float
        Width of the joint-angle prior in units of half the joint's range; 0 leaves it out.
    fit : tuple of str
        Families of global parameters to estimate (:data:`acino_fte.parameters.FAMILIES`).
    widths : PriorWidths
        Standard deviations of their priors.
    """

    likelihood: float = 0.5
    loss: Loss = field(default_factory=lambda: Loss("geman_mcclure"))
    noise_scale: float = 1.0
    prior_width: float = 2.0
    fit: tuple[str, ...] = ()
    widths: PriorWidths = field(default_factory=PriorWidths)

    def __post_init__(self) -> None:
        for name, value, good in (
            ("likelihood", self.likelihood, 0.0 <= self.likelihood <= 1.0),
            ("noise_scale", self.noise_scale, self.noise_scale > 0),
            ("prior_width", self.prior_width, self.prior_width >= 0),
        ):
            if not good:
                raise InputError(f"The option {name} cannot be {value}.", key=name, remedy="see --help")
        object.__setattr__(self, "fit", check_families(self.fit))

    def summary(self) -> dict[str, Any]:
        """The options as plain values for the record."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Assumptions:
    """What the data may overrule; each None keeps what species and sequence say.

    Attributes
    ----------
    pixels : (N, C, M, 2), optional
        Detections that count, px, NaN where none.
    sd_px : (M,), optional
        Standard deviation of every marker's detections, px.
    noise_factors : (Q,), optional
        Factor on the process noise of every degree of freedom.
    depth : DepthData, optional
        What a lidar says, attached to the skeleton (:mod:`acino_fte.association`); None leaves it out.
    """

    pixels: np.ndarray | None = None
    sd_px: np.ndarray | None = None
    noise_factors: np.ndarray | None = None
    depth: DepthData | None = None


@dataclass(frozen=True, eq=False)
class FTEProblem:
    """A trajectory problem: terms over q (N, Q) and θ (P,), and bounds. :func:`build_fte` makes one.

    Attributes
    ----------
    kinematics : Kinematics
    fps : float
        Frames per second.
    frames : (N,) int
        Frame numbers, for labels.
    terms : tuple of Term
    lower, upper : (Q,)
        Bounds of every frame's q, m and rad.
    options : FTEOptions
    sequence : Sequence, optional
        What the problem was built from.
    parameters : Parameters
        The global parameters θ.
    """

    kinematics: Kinematics
    fps: float
    frames: np.ndarray
    terms: tuple[Term, ...]
    lower: np.ndarray
    upper: np.ndarray
    options: FTEOptions = field(default_factory=FTEOptions)
    sequence: Sequence | None = None
    parameters: Parameters = field(default_factory=Parameters)

    @property
    def n_frames(self) -> int:
        """N."""
        return len(self.frames)

    @property
    def dt(self) -> float:
        """Time between frames, s."""
        return 1.0 / self.fps

    @cached_property
    def n_observations(self) -> int:
        """Number of detections that enter the problem."""
        return sum(len(t) for t in self.terms if t.family == "meas")

    def clip(self, q: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Push q (N, Q) into its bounds, ``margin`` times the range away from them."""
        width = np.where(np.isfinite(self.upper - self.lower), self.upper - self.lower, 0.0)
        return np.clip(q, self.lower + margin * width, self.upper - margin * width)

    def proportions(self, theta: np.ndarray) -> np.ndarray | None:
        """The part of θ that the kinematics take."""
        return theta[: self.parameters.n_kinematic] if self.kinematics.n_parameters else None

    def positions(self, q: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Marker positions (N, M, 3), m, at q (N, Q) and θ (P,)."""
        return self.kinematics.positions(q, self.proportions(theta))

    def with_terms(self, *terms: Term) -> FTEProblem:
        """The same problem with more terms."""
        return replace(self, terms=(*self.terms, *terms))


def build_problem(
    kinematics: Kinematics,
    fps: float,
    frames: np.ndarray,
    terms: list[Term],
    options: FTEOptions,
    parameters: Parameters = _NONE,
    noise_factors: np.ndarray | float = 1.0,
) -> FTEProblem:
    """Add motion model, priors and bounds to terms that hold the data."""
    skeleton, n = kinematics.skeleton, len(frames)
    if n > 3:
        model = model_term(skeleton, n, fps)
        factors = np.broadcast_to(noise_factors, len(skeleton.dofs))[model.items[:, 0]]
        terms = [*terms, replace(model, sd=model.sd * options.noise_scale * factors)]
    if options.prior_width > 0:
        terms = [*terms, prior_term(skeleton, n, options.prior_width)]
    if len(parameters):
        terms = [*terms, parameter_term(parameters)]
        kinematics = kinematics.with_parameters(f for f in parameters.families if f in KINEMATIC)
    lower = np.array([d.lower for d in skeleton.dofs])
    upper = np.array([d.upper for d in skeleton.dofs])
    return FTEProblem(
        kinematics, fps, np.asarray(frames), tuple(terms), lower, upper, options, parameters=parameters
    )


def build_fte(
    sequence: Sequence,
    kinematics: Kinematics,
    options: FTEOptions | None = None,
    assumptions: Assumptions | None = None,
) -> FTEProblem:
    """State the trajectory problem of a sequence. Pure: solves nothing, reads and writes nothing.

    Raises
    ------
    InputError
        No detection is above the likelihood threshold.
    """
    options, assumed = options or FTEOptions(), assumptions or Assumptions()
    skeleton = kinematics.skeleton
    pixels, sd = assumed.pixels, assumed.sd_px
    if pixels is None:
        pixels = sequence.pixels(skeleton.marker_names, options.likelihood)
    if sd is None:
        sd = np.array([m.sd_px for m in skeleton.markers])
    parameters = _parameters(sequence, skeleton, options)
    if assumed.depth is not None and assumed.depth.surface:
        expected = expected_surface(skeleton)
        parameters = with_surface(parameters, skeleton.marker_names, expected, surface_sd(expected))
    terms = [
        measurement_term(camera, pixels[:, c], sd, options.loss, sequence.n_frames, parameters)
        for c, camera in enumerate(sequence.cameras)
    ]
    present = [term for term in terms if term is not None]
    if not present:
        raise InputError(
            f"No detection of sequence '{sequence.name}' has a likelihood above {options.likelihood:g}.",
            key="likelihood",
            remedy="lower --likelihood, or choose frames in which the animal is seen",
        )
    if assumed.depth is not None:
        camera = sequence.cameras[assumed.depth.camera]
        present += depth_terms(assumed.depth, camera, sequence.n_frames, parameters)
        present += [surface_term(parameters)] if assumed.depth.surface else []
    if {"scale", "extrinsics"} <= set(parameters.families):
        present += size_terms(parameters, sequence.cameras, options.widths.size)
    factors = 1.0 if assumed.noise_factors is None else assumed.noise_factors
    problem = build_problem(kinematics, sequence.fps, sequence.frames, present, options, parameters, factors)
    return replace(problem, sequence=sequence)


def _parameters(sequence: Sequence, skeleton: Skeleton, options: FTEOptions) -> Parameters:
    """The parameters that the options ask for; no delays in a recording shorter than their stencil."""
    families = [f for f in options.fit if f != "delay" or sequence.n_frames >= delay.NODES]
    return declare(families, skeleton, sequence.cameras.names, sequence.fps, options.widths)
