"""The command ``acino-fte run``: from a sequence folder to a trajectory with everything beside it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import EXIT_UNCONVERGED, reported_errors, stderr


class _Method(StrEnum):
    fte = "fte"
    ekf = "ekf"
    sba = "sba"
    tri = "tri"


class _Noise(StrEnum):
    estimated = "estimated"
    table = "table"


class _Association(StrEnum):
    marker = "marker"
    body = "body"
    nearest = "nearest"
    none = "none"


class _Lowering(StrEnum):
    condensed = "condensed"
    explicit = "explicit"


class _LossName(StrEnum):
    redescending = "redescending"
    squared = "squared"
    huber = "huber"
    cauchy = "cauchy"
    geman_mcclure = "geman_mcclure"


class _Hessian(StrEnum):
    auto = "auto"
    gauss_newton = "gauss-newton"
    exact = "exact"


_PROBLEM, _SOLVER, _EVALUATION, _OUTPUT = "Problem", "Solver", "Evaluation", "Output"


def run(
    sequence: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE",
            help="A folder with sequence.yaml, a folder in the AcinoSet layout, or a sequence.yaml.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Result folder. [dim]\\[default: out/NAME][/]", rich_help_panel=_OUTPUT
        ),
    ] = None,
    species: Annotated[
        str | None,
        typer.Option(help="Species name, or a species file (.yaml); overrides the sequence's."),
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second; overrides the sequence's.")] = None,
    frames: Annotated[
        str | None,
        typer.Option(
            metavar="START:STOP", help="Frames to use, half-open, counted from 0; either may be left out."
        ),
    ] = None,
    method: Annotated[
        _Method,
        typer.Option(
            help="Full trajectory estimation, or a baseline: Kalman smoother on the skeleton (ekf), bundle "
            "adjustment of the markers (sba), triangulation (tri)."
        ),
    ] = _Method.fte,
    fit: Annotated[
        str,
        typer.Option(
            metavar="FAMILIES",
            help="What to estimate beside the trajectory: some of scale,delay,extrinsics,offsets; 'auto' for "
            "what the data can tell; 'none'.",
            rich_help_panel=_PROBLEM,
        ),
    ] = "auto",
    noise: Annotated[
        _Noise,
        typer.Option(
            help="Detection noise per marker: from the data, or the species' table.",
            rich_help_panel=_PROBLEM,
        ),
    ] = _Noise.estimated,
    swaps: Annotated[
        bool,
        typer.Option(
            help="Look for exchanged left and right, and choose among candidates.", rich_help_panel=_PROBLEM
        ),
    ] = True,
    contact: Annotated[
        bool,
        typer.Option(
            "--contact", help="Keep paws above the ground, and still in stance.", rich_help_panel=_PROBLEM
        ),
    ] = False,
    association: Annotated[
        _Association,
        typer.Option(
            help="Depth from a lidar: at markers, of the whole body, the nearest return (thesis), or none.",
            rich_help_panel=_PROBLEM,
        ),
    ] = _Association.marker,
    tune_noise: Annotated[
        bool,
        typer.Option(
            "--tune-noise",
            help="Choose the process noise by maximum marginal likelihood.",
            rich_help_panel=_PROBLEM,
        ),
    ] = False,
    likelihood: Annotated[
        float,
        typer.Option(
            min=0.0, max=1.0, help="Use detections above this likelihood.", rich_help_panel=_PROBLEM
        ),
    ] = 0.5,
    loss: Annotated[
        _LossName, typer.Option(help="Loss of the reprojection error.", rich_help_panel=_PROBLEM)
    ] = _LossName.geman_mcclure,
    noise_scale: Annotated[
        float,
        typer.Option(
            help="Factor on the species' process noise: above 1 follows the detections more closely, "
            "below 1 is smoother.",
            rich_help_panel=_PROBLEM,
        ),
    ] = 1.0,
    lowering: Annotated[
        _Lowering,
        typer.Option(help="Condensed (fast), or the explicit Pyomo model.", rich_help_panel=_SOLVER),
    ] = _Lowering.condensed,
    hessian: Annotated[
        _Hessian, typer.Option(help="Hessian of the condensed problem.", rich_help_panel=_SOLVER)
    ] = _Hessian.auto,
    max_iter: Annotated[int, typer.Option(min=0, help="Most iterations.", rich_help_panel=_SOLVER)] = 500,
    tol: Annotated[
        float, typer.Option(help="Converged when no gradient entry exceeds this.", rich_help_panel=_SOLVER)
    ] = 0.1,
    max_seconds: Annotated[
        float, typer.Option(help="Most time for the solver.", rich_help_panel=_SOLVER)
    ] = 3600.0,
    linear_solver: Annotated[
        str, typer.Option(help="Linear solver of IPOPT.", rich_help_panel=_SOLVER)
    ] = "mumps",
    holdout_cameras: Annotated[
        str | None,
        typer.Option(
            metavar="each|CAMERAS",
            help="Estimate without each camera (or some: cam1,cam2) and score how well it is predicted.",
            rich_help_panel=_EVALUATION,
        ),
    ] = None,
    ladder: Annotated[
        bool,
        typer.Option(
            "--ladder",
            help="With --holdout-cameras: also with nothing fitted, and family by family.",
            rich_help_panel=_EVALUATION,
        ),
    ] = False,
    covariance: Annotated[
        bool, typer.Option(help="Work out standard deviations.", rich_help_panel=_OUTPUT)
    ] = True,
    figures: Annotated[
        bool, typer.Option(help="Draw figures and the report.", rich_help_panel=_OUTPUT)
    ] = True,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print errors and warnings only.", rich_help_panel=_OUTPUT)
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show IPOPT's own log.", rich_help_panel=_OUTPUT)
    ] = False,
) -> None:
    """Estimate the 3D trajectory of an animal from a SEQUENCE.

    Leaves with 0 when the solver converged, 2 when the input is wrong, 3 when it did not converge
    (the best iterate is saved and marked), 1 for anything else.
    """
    with reported_errors():
        from acino_fte.cli_estimate import Source, estimate_source, families, frame_range, save
        from acino_fte.estimate import EstimateOptions
        from acino_fte.losses import Loss
        from acino_fte.problem import FTEOptions
        from acino_fte.solve import SolveOptions

        solver = SolveOptions(
            max_iter=max_iter,
            tolerance=tol,
            max_seconds=max_seconds,
            print_level=5 if verbose else 0,
            linear_solver=linear_solver,
            hessian=hessian.value,
        )
        options = EstimateOptions(
            FTEOptions(likelihood, Loss(loss.value), noise_scale),
            solver,
            families(fit),
            noise.value,
            swaps,
            contact,
            tune_noise,
            covariance,
            lowering.value,
            association.value,
        )
        source = Source(sequence, out, species, fps, frame_range(frames))
        result, target = estimate_source(source, method.value, options, holdout_cameras, ladder, quiet)
        save(result, target, sequence, figures, quiet)
    if not result.status.ok:
        stderr.print(f"[bold yellow]{result.status}[/]: {escape(result.status.advice)}")
        raise typer.Exit(EXIT_UNCONVERGED)
