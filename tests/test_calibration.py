"""Whether the uncertainty that the estimate states is right: errors against covariances, many recordings.

A motion drawn from the estimator's own prior has errors whose covariance is exactly the posterior's, but for
the curvature of the problem. Errors of neighbouring frames and markers belong together: over three recordings
of a second the normalised error has an uncertainty of 0.04 and the coverage one of 0.008.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import chi2
from test_global_parameters import fitted
from test_posterior import covariance
from test_recovery import parameter_nees

from acino_fte.condensed import Condensed
from acino_fte.condensed_solve import minimise
from acino_fte.estimate import EstimateOptions, estimate_fte
from acino_fte.losses import Loss
from acino_fte.metrics_truth import ELLIPSOID, normalised_errors, truth_vectors
from acino_fte.parameters import PriorWidths
from acino_fte.posterior import MOST_LEVERAGE, leverage, posterior
from acino_fte.problem import FTEOptions
from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence

WIDTH = 0.25  # of the joints' prior: at twice half a joint's range, as by default, draws leave the range


@dataclass(frozen=True)
class Scores:
    """Root mean square error and the one stated, mm; NEES per dimension; share in the 95 % ellipsoids."""

    rmse: float
    stated: float
    nees: float
    coverage: float

    def holds(self, nees=(0.9, 1.1), coverage=(0.93, 0.97)) -> bool:
        return (
            self.rmse <= 1.15 * self.stated
            and nees[0] <= self.nees <= nees[1]
            and coverage[0] <= self.coverage <= coverage[1]
        )


def estimates(kinematics, options, seeds, **simulated):
    for seed in seeds:
        recording = simulate(kinematics.skeleton, SimulationOptions(seed=seed, **simulated))
        result = estimate_fte(simulation_to_sequence(recording), kinematics, options)
        assert result.status.ok
        yield result


def scores(results) -> Scores:
    """Over all markers, frames and recordings."""
    results = list(results)
    errors = np.stack([truth_vectors(r) for r in results])
    covariances = np.stack([r.position_covariance for r in results])
    nees = np.stack([normalised_errors(r) for r in results])
    return Scores(
        1e3 * float(np.sqrt(np.mean(np.sum(errors**2, axis=-1)))),
        1e3 * float(np.sqrt(np.mean(np.trace(covariances, axis1=-2, axis2=-1)))),
        float(nees.mean()) / 3,
        float((nees <= chi2.ppf(ELLIPSOID, 3)).mean()),
    )


@pytest.mark.parametrize(
    ("loss", "faults"),
    [
        ("geman_mcclure", {}),  # a tenth missing, 2 % gross errors, markers hidden by the body
        ("geman_mcclure", {"noise_px": "species", "missing": 0.4, "n_cameras": 4}),
        ("squared", {"outliers": 0.0, "occlusion": False}),
    ],
    ids=["defaults", "few", "gaussian"],
)
def test_motions_from_the_prior(cheetah, loss, faults):
    """Three recordings, noise from the data: 0.9 to 1.1, 93 to 97 %, at most 1.15 times the bound."""
    options = EstimateOptions(FTEOptions(prior_width=WIDTH, loss=Loss(loss)), fit=())
    found = scores(estimates(cheetah, options, range(3), motion="prior", prior_width=WIDTH, **faults))
    assert found.holds(), found


def test_motions_from_the_prior_with_the_wrong_process_noise_tuned(cheetah):
    """They are 0.3 times as rough as the species says, and the estimate finds out."""
    options = EstimateOptions(FTEOptions(prior_width=WIDTH), fit=(), tune_noise=True)
    simulated = {"motion": "prior", "prior_width": WIDTH, "noise_scale": 0.3, "n_frames": 100}
    results = list(estimates(cheetah, options, range(2), **simulated))
    found = scores(results)
    assert found.holds(), found
    factors = [list(r.parameters["process_noise_factor"].values()) for r in results]
    assert np.exp(np.mean(np.log(factors))) == pytest.approx(0.3, rel=0.15)


def test_motions_and_parameters_from_their_priors(cheetah):
    """Proportions and cameras drawn from their priors too: 41 parameters a recording.

    All markers of a recording share the error of its cameras, so that five recordings say little about the
    markers: their normalised error has an uncertainty of 0.2.
    """
    widths = PriorWidths(scale=0.05, rotation=float(np.radians(0.2)), translation=0.02, size=1e3)
    problem, fit = FTEOptions(prior_width=WIDTH, widths=widths), ("scale", "extrinsics")
    simulated = {"motion": "prior", "prior_width": WIDTH, "n_frames": 80, "outliers": 0.0}
    drawn = {"moved_mm": 20.0, "moved_deg": 0.2, "proportions": 0.05}
    options = EstimateOptions(problem, fit=fit)
    results = list(estimates(cheetah, options, range(5), **simulated, **drawn))
    found = scores(results)
    assert found.rmse <= 1.4 * found.stated
    assert 0.6 <= found.nees <= 1.4
    assert found.coverage >= 0.9
    for nees, count in np.sum([parameter_nees(r, cheetah, problem, fit, fit) for r in results], axis=0):
        assert chi2.ppf(0.005, count) < nees < chi2.ppf(0.995, count), nees / count


@pytest.mark.parametrize("tuned", [False, True], ids=["species", "tuned"])
def test_a_gallop(cheetah, tuned):
    """A real motion is no draw from the prior: it is smoother, and the statement a little too modest.

    Over two recordings the normalised error has an uncertainty of 0.05.
    """
    options = EstimateOptions(fit=(), tune_noise=tuned)
    found = scores(estimates(cheetah, options, range(2), noise_px="species"))
    assert found.holds(nees=(0.8, 1.2), coverage=(0.92, 0.98)), found


@pytest.mark.parametrize("families", [(), ("scale", "offsets", "extrinsics")], ids="+".join)
def test_leverage_is_the_variance_of_the_predicted_pixel(lizard, families):
    """σ² times it, against finite differences of the residuals and the dense covariance of all unknowns.

    With the cameras unsure too the pixels are surer than the markers by themselves would have them.
    """
    problem, x = fitted(lizard, families, Loss("squared"), n=5)
    minimum = minimise(problem, Condensed(problem).unpack(x)[0])
    spread = posterior(problem, minimum)
    dense = covariance(problem, minimum)  # of (q, θ)
    condensed = Condensed(problem)
    packed = condensed.pack(minimum.q, minimum.theta)
    unit = np.concatenate([np.ones(minimum.q.size), problem.parameters.sd])
    slopes = []
    for i in range(len(packed)):
        step = 1e-6 * np.eye(len(packed))[i]
        slopes.append((pixels(condensed, packed + step) - pixels(condensed, packed - step)) / 2e-6 / unit[i])
    slopes = np.stack(slopes)
    expected = np.einsum("ik,ij,jk->k", slopes, dense, slopes, optimize=True)
    condensed.objective(packed)
    measured = [(t, e) for t, e in condensed.evaluated() if t.term.family == "meas"]
    found = np.concatenate([leverage(t, e, spread).ravel() for t, e in measured])
    np.testing.assert_allclose(found, np.minimum(expected, MOST_LEVERAGE), rtol=1e-4)
    assert found.max() < 1


def pixels(condensed, x):
    """Normalised residuals of all detections at x."""
    condensed.objective(x)
    return np.concatenate([e.e.ravel() for t, e in condensed.evaluated() if t.term.family == "meas"])
