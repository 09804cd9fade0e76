"""The whole estimate: start, first fit, what the data say about noise and parameters, final fit, covariance.

1. start: triangulation and inverse kinematics (:mod:`acino_fte.initialise`), and a rough fit with the
   species' proportions and table of noise and the given calibration;
2. measurement noise from the residuals (:mod:`acino_fte.noise`), exchanged sides and better candidates
   (:mod:`acino_fte.assignments`; the rough fit is repeated while these change), returns of a lidar
   (:mod:`acino_fte.fusion`), and which parameters the data can tell (:mod:`acino_fte.observable`);
3. a fit with the parameters, then noise and assignments once more;
4. the final fit, to the solver's tolerance, and its covariance (:mod:`acino_fte.posterior`).

Every fit starts where the last one ended.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from acino_fte.arrow import NotPositiveDefinite
from acino_fte.assignments import Assignment, resolve
from acino_fte.association import ASSOCIATIONS, in_view
from acino_fte.condensed_solve import minimise
from acino_fte.contact import contact_terms
from acino_fte.diagnosis import diagnose
from acino_fte.errors import InputError
from acino_fte.fusion import Fusion
from acino_fte.initialise import initial_trajectory
from acino_fte.kinematics import Kinematics
from acino_fte.noise import estimate_noise
from acino_fte.observable import ORDER, observable
from acino_fte.parameters import check_families, describe
from acino_fte.posterior import Posterior, posterior
from acino_fte.problem import Assumptions, FTEOptions, FTEProblem, build_fte
from acino_fte.result import FTEResult, Status
from acino_fte.sequence import Sequence
from acino_fte.solve import Minimum, Progress, SolveOptions, predicted_pixels, rates
from acino_fte.terms import Term
from acino_fte.tune import tune

_ROUGH = 2e-3  # relative gain per iteration at which the first fit ends
_LOOKS = 4  # most rough fits: sides that are exchanged in a whole camera take more than one look
_NEAR = 3e-4  # and the second, whose residuals the noise is estimated from
NOISES = ("estimated", "table")


@dataclass(frozen=True)
class EstimateOptions:
    """Options of the whole estimate.

    Attributes
    ----------
    problem : FTEOptions
        Options of the trajectory problem; its ``fit`` is replaced by the one here.
    solver : SolveOptions
    fit : tuple of str, optional
        Families of parameters to estimate; None for those that the data can tell.
    noise : str
        Measurement noise: ``"estimated"`` from the data, or the species' ``"table"``.
    swaps : bool
        Look for exchanged sides, and choose among candidates.
    contact : bool
        Keep paws above the ground, and still in stance.
    tune_noise : bool
        Choose the process noise by maximum marginal likelihood.
    covariance : bool
        Work out the posterior covariance.
    lowering : str
        ``"condensed"``, or ``"explicit"`` for the final fit.
    association : str
        How returns of a lidar are associated (:data:`acino_fte.association.ASSOCIATIONS`).
    """

    problem: FTEOptions = field(default_factory=FTEOptions)
    solver: SolveOptions = field(default_factory=SolveOptions)
    fit: tuple[str, ...] | None = None
    noise: str = "estimated"
    swaps: bool = True
    contact: bool = False
    tune_noise: bool = False
    covariance: bool = True
    lowering: str = "condensed"
    association: str = "marker"

    def __post_init__(self) -> None:
        if self.fit is not None:
            object.__setattr__(self, "fit", check_families(self.fit))
        for key, value, known in (
            ("noise", self.noise, NOISES),
            ("lowering", self.lowering, ("condensed", "explicit")),
            ("association", self.association, ASSOCIATIONS),
        ):
            if value not in known:
                raise InputError(
                    f"The option {key} cannot be {value!r}.", key=key, expected=" or ".join(map(repr, known))
                )

    def summary(self) -> dict[str, Any]:
        """The options as plain values for the record."""
        chosen = "observable" if self.fit is None else list(self.fit)
        names = ("noise", "swaps", "contact", "tune_noise", "covariance", "lowering", "association")
        return {"fit": chosen, **{name: getattr(self, name) for name in names}}


def estimate_fte(
    sequence: Sequence,
    kinematics: Kinematics,
    options: EstimateOptions | None = None,
    *,
    progress: Progress | None = None,
    seconds: dict[str, float] | None = None,
) -> FTEResult:
    """Estimate trajectory, parameters, noise and covariance of a sequence.

    Parameters
    ----------
    sequence : Sequence
        The recording.
    kinematics : Kinematics
        Of the species, without parameters.
    options : EstimateOptions, optional
        The defaults estimate what the data can tell.
    progress : callable, optional
        Called with (iteration, objective) during the fits.
    seconds : dict, optional
        Time spent so far by stage; ``initialise``, ``build`` and ``solve`` are added.

    Raises
    ------
    InputError
        Nothing is detected, or nothing can be triangulated.
    """
    run = _Estimate(sequence, kinematics, options or EstimateOptions(), progress, seconds or {})
    return run.result()


class _Interrupted(Exception):
    """Ctrl-C during a fit: the estimate ends with what there is."""

    def __init__(self, problem: FTEProblem, minimum: Minimum) -> None:
        self.problem, self.minimum = problem, minimum


class _Estimate:
    """One estimate on its way: the current trajectory and what has been assumed and found so far."""

    def __init__(
        self,
        sequence: Sequence,
        kinematics: Kinematics,
        options: EstimateOptions,
        progress: Progress | None,
        seconds: dict[str, float],
    ) -> None:
        self.sequence, self.kinematics, self.options = in_view(sequence), kinematics, options
        self.progress = progress
        self.seconds = dict(seconds)
        self.skeleton = kinematics.skeleton
        self.detected = sequence.pixels(self.skeleton.marker_names, options.problem.likelihood)
        self.table = np.array([m.sd_px for m in self.skeleton.markers])
        self.assumed = Assumptions(pixels=self.detected, sd_px=self.table)
        self.fit: tuple[str, ...] = ()
        self.assignment: Assignment | None = None
        self.extra: tuple[Term, ...] = ()
        self.fuse = Fusion(self.sequence, self.skeleton, self.options.association, self.detected)
        self.findings: list[str] = []
        self.contacts: list[str] = []
        self.iterations = 0
        self.q = np.empty(0)
        self.theta = np.empty(0)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - began

    def result(self) -> FTEResult:
        """Run all stages."""
        with self._timed("initialise"):
            self.q = initial_trajectory(self.sequence, self.kinematics, self.options.problem)
            self.fuse.look(self.kinematics.positions(self.q), None)
            self.assumed = replace(self.assumed, depth=self.fuse.data)
        with self._timed("solve"):
            spread = None
            try:
                problem, minimum = self._fits()
                if self.options.covariance or self.options.tune_noise:
                    spread = self._posterior(problem, minimum)
                if self.options.tune_noise and spread is not None:
                    problem, minimum, spread = self._tuned(problem, minimum, spread)
            except _Interrupted as stopped:
                problem, minimum, spread = stopped.problem, stopped.minimum, None
        return self._result(problem, minimum, spread if self.options.covariance else None)

    # --- stages ------------------------------------------------------------------------------------

    def _fits(self) -> tuple[FTEProblem, Minimum]:
        options = self.options
        adaptive = options.noise == "estimated" or options.swaps or options.contact or self.fuse.used
        if adaptive or options.fit is None:
            for _ in range(_LOOKS):
                if not self._look(*self._fit(_ROUGH), None):
                    break
            self._choose()
        else:
            self.fit = options.fit
        if adaptive:
            problem, minimum = self._fit(_NEAR)
            estimated = options.noise == "estimated"
            self._look(problem, minimum, self._posterior(problem, minimum) if estimated else None)
        return self._fit(0.0)

    def _fit(self, enough: float) -> tuple[FTEProblem, Minimum]:
        """Solve with what is assumed now, from where the last fit ended."""
        with self._timed("build"):
            problem = self._problem()
        theta = self.theta if len(self.theta) == len(problem.parameters) else None
        if self.options.lowering == "explicit" and not enough:
            from acino_fte.explicit_solve import minimise_explicit

            minimum = minimise_explicit(problem, self.q, self.options.solver, self.progress, theta=theta)
        else:
            minimum = minimise(problem, self.q, self.options.solver, self.progress, enough, theta)
        self.q, self.theta = minimum.q, minimum.theta
        self.iterations += minimum.iterations
        if minimum.status is Status.INTERRUPTED:
            raise _Interrupted(problem, minimum)
        return problem, minimum

    def _problem(self) -> FTEProblem:
        options = replace(self.options.problem, fit=self.fit)
        return build_fte(self.sequence, self.kinematics, options, self.assumed).with_terms(*self.extra)

    def _look(self, problem: FTEProblem, minimum: Minimum, spread: Posterior | None) -> bool:
        """Let the residuals of a fit decide on noise, assignments and stance; whether an assignment changed.

        The noise comes first: sides are judged by it, and a table that is too small exaggerates the evidence.
        """
        self._measure(problem, minimum, spread)
        positions = problem.positions(minimum.q, minimum.theta)
        self.fuse.look(positions, (problem.parameters, minimum.theta), spread)
        self.assumed = replace(self.assumed, depth=self.fuse.data)
        changed = self.options.swaps and self._assign(problem, minimum)
        if changed:
            with self._timed("build"):
                problem = self._problem()
            self._measure(problem, minimum, spread)
        if self.options.contact:
            positions = problem.positions(minimum.q, minimum.theta)
            terms, self.contacts = contact_terms(problem, positions, self.sequence)
            self.extra = tuple(terms)
        return changed

    def _measure(self, problem: FTEProblem, minimum: Minimum, spread: Posterior | None) -> None:
        """Noise from the residuals."""
        if self.options.noise == "estimated":
            sd = estimate_noise(problem, minimum, spread, self.table)
            self.assumed = replace(self.assumed, sd_px=sd)

    def _assign(self, problem: FTEProblem, minimum: Minimum) -> bool:
        """Sides and candidates from the residuals; whether that changed any."""
        names, threshold = self.skeleton.marker_names, self.options.problem.likelihood
        before = self.assignment
        self.assignment = resolve(
            self.skeleton,
            self.detected,
            predicted_pixels(problem, minimum),
            np.asarray(self.assumed.sd_px),
            self.options.problem.loss,
            candidates=self.sequence.candidates(names, threshold),
            candidate_likelihood=self.sequence.candidate_likelihood(names),
            previous=self.assignment,
        )
        self.assumed = replace(self.assumed, pixels=self.assignment.pixels)
        changed = self.assignment.n_changed if before is None else self.assignment.n_different(before)
        return changed > 0

    def _choose(self) -> None:
        """Which parameters to fit: those asked for, or those that the data can tell."""
        asked = self.options.fit
        judged = observable(
            self.sequence,
            self.kinematics,
            self.options.problem,
            self.assumed,
            self.q,
            ORDER if asked is None else asked,
        )
        if asked is None:
            self.fit = check_families(j.family for j in judged if j.full)
            self.findings += [j.reason for j in judged]
            return
        self.fit = asked
        self.findings += [
            f"fitted because asked for, though {j.reason.split(': ', 1)[1]}: {j.family}"
            for j in judged
            if not j.full
        ]

    def _posterior(self, problem: FTEProblem, minimum: Minimum) -> Posterior | None:
        try:
            return posterior(problem, minimum)
        except NotPositiveDefinite:
            return None

    def _tuned(
        self, problem: FTEProblem, minimum: Minimum, spread: Posterior
    ) -> tuple[FTEProblem, Minimum, Posterior]:
        """Choose the process noise, and fit again with it."""

        def refit(factors: np.ndarray) -> tuple[FTEProblem, Minimum, Posterior | None]:
            self.assumed = replace(self.assumed, noise_factors=factors)
            again = self._fit(0.0)
            return *again, self._posterior(*again)

        tuned = tune(problem, minimum, spread, refit)
        self.assumed = replace(self.assumed, noise_factors=tuned.factors)
        self.q, self.theta = tuned.minimum.q, tuned.minimum.theta
        self.findings.append(tuned.finding)
        return tuned.problem, tuned.minimum, tuned.posterior

    # --- the result --------------------------------------------------------------------------------

    def _result(self, problem: FTEProblem, minimum: Minimum, spread: Posterior | None) -> FTEResult:
        velocity, acceleration = rates(minimum.q, problem.dt)
        observed, predicted = np.asarray(self.assumed.pixels), predicted_pixels(problem, minimum)
        sd = np.asarray(self.assumed.sd_px)
        return FTEResult(
            status=minimum.status,
            sequence=self.sequence,
            skeleton=self.skeleton,
            q=minimum.q,
            dq=velocity,
            ddq=acceleration,
            positions=problem.positions(minimum.q, minimum.theta),
            observed=observed,
            reprojected=predicted,
            objective=minimum.objective,
            iterations=self.iterations,
            method=f"fte-{self.options.lowering}",
            seconds=self._seconds(),
            options={
                "problem": problem.options.summary(),
                "solver": self.options.solver.summary(),
                "estimate": self.options.summary(),
            },
            parameters=self._parameters(problem, minimum, spread),
            q_sd=None if spread is None else spread.q_sd,
            position_covariance=None if spread is None else spread.positions,
            depth=self.fuse.residuals(
                problem.positions(minimum.q, minimum.theta), (problem.parameters, minimum.theta)
            ),
            findings=(*self._at_bounds(problem), *self._findings(observed, predicted, sd)),
        )

    def _seconds(self) -> dict[str, float]:
        """Building takes place between the fits; it is not counted twice."""
        build = self.seconds.get("build", 0.0)
        return {**self.seconds, "solve": self.seconds["solve"] - build}

    def _parameters(self, problem: FTEProblem, minimum: Minimum, spread: Posterior | None) -> dict[str, Any]:
        sd = None if spread is None else spread.theta_sd
        found = describe(problem.parameters, minimum.theta, sd, self.sequence.cameras.names[0])
        if self.options.noise == "estimated":
            values = np.asarray(self.assumed.sd_px).tolist()
            found["noise_px"] = dict(zip(self.skeleton.marker_names, values, strict=True))
        if self.assumed.noise_factors is not None:
            factors = np.asarray(self.assumed.noise_factors).tolist()
            found["process_noise_factor"] = dict(zip(self.skeleton.dof_names, factors, strict=True))
        return found

    def _at_bounds(self, problem: FTEProblem) -> list[str]:
        """A parameter at its bound wants to go where the prior says it cannot be: the model is wrong."""
        held = np.abs(self.theta) > (1 - 1e-3) * problem.parameters.bound
        names = [name for name, at in zip(problem.parameters.names, held, strict=True) if at]
        if not names:
            return []
        return [f"at their bounds, where the prior takes them to be impossible: {', '.join(names)}"]

    def _findings(self, observed: np.ndarray, predicted: np.ndarray, sd: np.ndarray) -> list[str]:
        cameras, frames = self.sequence.cameras.names, self.sequence.frames
        found = list(self.findings)
        if self.assignment is not None:
            found += self.assignment.findings(cameras, frames, self.skeleton)
        return (
            found
            + self.fuse.findings()
            + self.contacts
            + diagnose(observed, predicted, self.sequence.fps, cameras, frames, sd)
        )
