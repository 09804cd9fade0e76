"""Which global parameters the data can tell, by the rank of their information matrix.

With the trajectory marginalised, the information of the data about the parameters is the Schur complement
S = D − Bᵀ A⁻¹ B of the Gauss–Newton Hessian without the parameters' own priors (:mod:`acino_fte.arrow`). A
family is judged given those before it, which keep their priors,

    M = S_FF − S_FG (S_GG + Λ_G)⁻¹ S_GF,

in units of its prior's standard deviations: an eigenvalue below a tenth is a direction of which the data say
next to nothing (they narrow the prior by less than 5 %), and does not count for the rank. The size of the set
of cameras, which no picture shows, is held by a term of its own (:func:`acino_fte.terms.size_terms`); its
direction counts as known. The surface that a lidar sees is always a parameter, and given from the start.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from acino_fte.arrow import NotPositiveDefinite
from acino_fte.condensed import Condensed
from acino_fte.kinematics import Kinematics
from acino_fte.parameters import Parameters
from acino_fte.posterior import factorise
from acino_fte.problem import Assumptions, FTEOptions, build_fte
from acino_fte.sequence import Sequence

ORDER = ("delay", "scale", "extrinsics", "offsets")
_TOLD = 0.1  # information of the data in units of the prior's
NAMES = {
    "delay": "time offsets of the cameras",
    "scale": "segment scales",
    "extrinsics": "corrections of the cameras",
    "offsets": "marker offsets",
}


@dataclass(frozen=True)
class Observability:
    """What the data tell about one family of parameters.

    ``rank`` of ``count`` directions are told by the data; ``weakest`` names the
    parameter that leads the least observed direction.
    """

    family: str
    count: int
    rank: int
    weakest: str

    @property
    def full(self) -> bool:
        """Whether every direction is observed, and there is one."""
        return 0 < self.count == self.rank

    @property
    def reason(self) -> str:
        """One sentence: why the family is fitted, or why not."""
        name = NAMES[self.family]
        if not self.count:
            return f"{name} are not fitted: there is only one camera, or there are too few frames"
        if self.full:
            return f"{name} are fitted: all {self.count} directions are observed"
        return (
            f"{name} are not fitted: the data tell {self.rank} of {self.count} directions "
            f"(the least known is led by {self.weakest})"
        )


def observable(
    sequence: Sequence,
    kinematics: Kinematics,
    options: FTEOptions,
    assumptions: Assumptions,
    q: np.ndarray,
    families: Iterable[str] = ORDER,
) -> list[Observability]:
    """Judge families of parameters at a trajectory q (N, Q), each given those before it that are observed."""
    chosen = [family for family in ORDER if family in set(families)]
    problem = build_fte(sequence, kinematics, replace(options, fit=tuple(chosen)), assumptions)
    parameters = problem.parameters
    condensed = Condensed(problem)
    x = condensed.pack(problem.clip(q), np.zeros(len(parameters)))
    try:
        whitened = factorise(problem, *condensed.hessian_parts(x)).schur - np.eye(len(parameters))
    except NotPositiveDefinite:
        whitened = np.zeros((len(parameters), len(parameters)))
    result: list[Observability] = []
    given = parameters.of_family("surface")
    for family in chosen:
        places = parameters.of_family(family)
        judged = _judge(family, parameters, places, _given(whitened, places, given))
        result.append(judged)
        if judged.full:
            given = np.concatenate([given, places])
    return result


def _given(information: np.ndarray, places: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Information about some parameters when others, with unit priors, are marginalised."""
    own = information[np.ix_(places, places)]
    if not len(given):
        return own
    cross = information[np.ix_(given, places)]
    other = information[np.ix_(given, given)] + np.eye(len(given))
    return own - cross.T @ np.linalg.solve(other, cross)


def _judge(family: str, parameters: Parameters, places: np.ndarray, matrix: np.ndarray) -> Observability:
    if not len(places):
        return Observability(family, 0, 0, "")
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    leader = parameters.names[places[int(np.argmax(np.abs(vectors[:, 0])))]]
    return Observability(family, len(places), int((values >= _TOLD).sum()), leader)
