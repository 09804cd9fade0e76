"""The command ``acino-fte run``: from a sequence folder to a trajectory with everything beside it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from acino_fte.cli_common import EXIT_UNCONVERGED, on_terminal, reported_errors, stderr, stdout, warn
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.problem import FTEOptions
    from acino_fte.result import FTEResult
    from acino_fte.sequence import Sequence
    from acino_fte.solve import Progress as ProgressCallback
    from acino_fte.solve import SolveOptions


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


_PROBLEM, _SOLVER, _OUTPUT = "Problem", "Solver", "Output"


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
    likelihood: Annotated[
        float,
        typer.Option(
            min=0.0, max=1.0, help="Use detections above this likelihood.", rich_help_panel=_PROBLEM
        ),
    ] = 0.5,
    loss: Annotated[
        _LossName, typer.Option(help="Loss of the reprojection error.", rich_help_panel=_PROBLEM)
    ] = _LossName.redescending,
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
        from acino_fte.losses import Loss
        from acino_fte.problem import FTEOptions
        from acino_fte.solve import SolveOptions

        options = FTEOptions(likelihood, Loss(loss.value), noise_scale)
        solver = SolveOptions(
            max_iter=max_iter,
            tolerance=tol,
            max_seconds=max_seconds,
            print_level=5 if verbose else 0,
            linear_solver=linear_solver,
            hessian=hessian.value,
        )
        result, target = _estimate(
            sequence, out, species, fps, _frame_range(frames), options, solver, lowering.value, quiet
        )
        _save(result, target, sequence, figures, quiet)
    if not result.status.ok:
        stderr.print(f"[bold yellow]{result.status}[/]: {escape(result.status.advice)}")
        raise typer.Exit(EXIT_UNCONVERGED)


def _frame_range(text: str | None) -> tuple[int | None, int | None] | None:
    """``"80:190"`` as (80, 190); either side may be empty."""
    if text is None:
        return None
    parts = text.split(":")
    try:
        if len(parts) != 2:
            raise ValueError
        start, stop = (int(p) if p.strip() else None for p in parts)
    except ValueError:
        raise InputError(
            "The frame range cannot be read.",
            key="--frames",
            expected="START:STOP, for example 80:190, 80: or :190",
            found=repr(text),
        ) from None
    return start, stop


def _estimate(
    path: Path,
    out: Path | None,
    species: str | None,
    fps: float | None,
    frames: tuple[int | None, int | None] | None,
    options: FTEOptions,
    solver: SolveOptions,
    lowering: str,
    quiet: bool,
) -> tuple[FTEResult, Path]:
    """Load, initialise, build and solve, with a progress display; the output folder is checked first."""
    from acino_fte.data_tools.load import load_sequence
    from acino_fte.initialise import initial_trajectory
    from acino_fte.kinematics import load_kinematics
    from acino_fte.problem import build_fte
    from acino_fte.residuals import lower
    from acino_fte.result_files import check_output_folder
    from acino_fte.skeleton import load_skeleton
    from acino_fte.solve import solve_fte
    from acino_fte.terms import measurement_residual

    seconds: dict[str, float] = {}
    with _stages(seconds, quiet) as stage:
        with stage("load", "reading"):
            import_module("cyipopt")  # a second of importing that should not count as solving
            loaded = load_sequence(
                path, species=species, fps=fps, frames=frames, likelihood=options.likelihood
            )
            target = check_output_folder(out or Path("out") / loaded.name, input_folder=path)
            kinematics = load_kinematics(load_skeleton(loaded.species))
            for model in {camera.model for camera in loaded.cameras}:
                lower(measurement_residual(model))  # derived now, the first time, and not while solving
        for message in loaded.warnings:
            warn(message)
        with stage("initialise", "triangulating"):
            start = initial_trajectory(loaded, kinematics, options)
        with stage("build", "building"):
            problem = build_fte(loaded, kinematics, options)
        with stage("solve", "solving") as progress:
            result = solve_fte(problem, start, solver, lowering=lowering, progress=progress, seconds=seconds)
    if not quiet:
        _describe(loaded, result)
    return result, target


@contextmanager
def _stages(seconds: dict[str, float], quiet: bool) -> Iterator:
    """Times each stage and shows it: a live line on a terminal, nothing in a pipe."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    show = on_terminal() and not quiet
    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=stderr,
        transient=True,
        disable=not show,
    ) as bar:

        @contextmanager
        def stage(name: str, text: str) -> Iterator[ProgressCallback]:
            task = bar.add_task(text)
            began = time.perf_counter()

            def progress(iteration: int, objective: float) -> None:
                bar.update(task, description=f"{text}: iteration {iteration}, objective {objective:.6g}")

            yield progress
            seconds[name] = time.perf_counter() - began
            bar.remove_task(task)

        yield stage


def _describe(sequence: Sequence, result: FTEResult) -> None:
    """A few lines on what came out."""
    metrics = result.metrics
    error = metrics["reprojection_px"]
    spent = metrics["seconds"]
    stdout.print(
        f"{escape(sequence.name)}: {result.skeleton.name}, {sequence.n_frames} frames at "
        f"{sequence.fps:g} Hz, {len(sequence.cameras)} cameras, {metrics['n_observations']} detections"
    )
    colour = "green" if result.status.ok else "yellow"
    stdout.print(
        f"[{colour}]{result.status}[/] after {result.iterations} iterations; "
        f"{spent['initialise'] + spent['build'] + spent['solve']:.2f} s, "
        f"{metrics['realtime_factor']:.2g} × real time"
    )
    if error["median"] is not None:
        stdout.print(
            f"reprojection error: median {error['median']:.1f} px, "
            f"{100 * error['within_20px']:.1f} % within 20 px"
        )
    truth = metrics.get("truth_mm")
    if truth:
        stdout.print(
            f"error against the truth: mean {truth['mpjpe']:.2f} mm, 95 % below {truth['p95']:.1f} mm"
        )


def _save(result: FTEResult, target: Path, source: Path, figures: bool, quiet: bool) -> None:
    from acino_fte.result_files import save_result

    with stderr.status("drawing figures") if on_terminal() and not quiet else _nothing():
        try:
            save_result(result, target, figures=figures, input_folder=source)
        except OSError as error:
            raise InputError(
                "The result cannot be written.",
                file=target,
                found=error.strerror or str(error),
                remedy="free some space or choose another folder with -o, and run again",
            ) from None
    if not quiet:
        stdout.print(f"written to {escape(str(target))}")


@contextmanager
def _nothing() -> Iterator[None]:
    yield
