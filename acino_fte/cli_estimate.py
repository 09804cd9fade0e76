"""From a sequence folder to a result, with a progress display: what ``acino-fte run`` does."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from acino_fte.cli_common import on_terminal, stderr, stdout, warn
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.estimate import EstimateOptions
    from acino_fte.kinematics import Kinematics
    from acino_fte.result import FTEResult
    from acino_fte.sequence import Sequence
    from acino_fte.solve import Progress as ProgressCallback


@dataclass(frozen=True)
class Source:
    """What to estimate: sequence path, result folder, and what overrides the sequence's own statements."""

    path: Path
    out: Path | None = None
    species: str | None = None
    fps: float | None = None
    frames: tuple[int | None, int | None] | None = None


def frame_range(text: str | None) -> tuple[int | None, int | None] | None:
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


def families(text: str) -> tuple[str, ...] | None:
    """``"scale,delay"`` as families of parameters; None for ``"auto"``, nothing for ``"none"``."""
    from acino_fte.parameters import FAMILIES, check_families

    words = [word.strip().lower() for word in text.split(",") if word.strip()]
    if words == ["auto"]:
        return None
    if words == ["none"]:
        return ()
    try:
        return check_families(words)
    except InputError as error:
        raise InputError(
            str(error).split("\n")[0],
            key="--fit",
            expected=f"'auto', 'none', or some of {', '.join(FAMILIES)} with commas between them",
            found=repr(text),
        ) from None


def estimate_source(
    source: Source,
    method: str,
    options: EstimateOptions,
    holdout: str | None = None,
    ladder: bool = False,
    quiet: bool = False,
) -> tuple[FTEResult, Path]:
    """Load, estimate and evaluate; the output folder is checked first."""
    seconds: dict[str, float] = {}
    with stages(seconds, quiet) as stage:
        with stage("load", "reading"):
            sequence, kinematics = load(source, options)
            target = _target(source, sequence)
            wanted = _cameras(sequence, holdout, ladder)
        for message in sequence.warnings:
            warn(message)
        with stage("estimate", "estimating") as progress:
            from acino_fte.methods import estimate

            spent = {"load": seconds["load"]}
            result = estimate(method, sequence, kinematics, options, progress=progress, seconds=spent)
        if holdout is not None:
            with stage("holdout", "leaving cameras out") as progress:
                found = _evaluate(sequence, kinematics, method, options, result, wanted, ladder, progress)
            spent = {**result.seconds, "holdout": seconds["holdout"]}
            result = replace(result, evaluation=found, seconds=spent)
    if not quiet:
        describe(sequence, result)
    return result, target


def load(source: Source, options: EstimateOptions) -> tuple[Sequence, Kinematics]:
    """The sequence, and the kinematics of its species; what SymPy must derive is derived here."""
    from acino_fte.data_tools.load import load_sequence
    from acino_fte.depth import depth_residual
    from acino_fte.kinematics import load_kinematics
    from acino_fte.parameters import FAMILIES, KINEMATIC
    from acino_fte.residuals import lower
    from acino_fte.skeleton import load_skeleton
    from acino_fte.terms import measurement_residual

    import_module("cyipopt")  # a second of importing that should not count as solving
    sequence = load_sequence(
        source.path,
        species=source.species,
        fps=source.fps,
        frames=source.frames,
        likelihood=options.problem.likelihood,
    )
    kinematics = load_kinematics(load_skeleton(sequence.species))
    fit = FAMILIES if options.fit is None else options.fit
    kinematics.with_parameters(f for f in fit if f in KINEMATIC)
    if sequence.lidar is not None:
        lower(depth_residual(surface=options.association != "nearest"))
    if options.fit is None:
        kinematics.with_parameters(("scale",))  # what is fitted, as a rule, of what is looked at
    for model in {camera.model for camera in sequence.cameras}:
        lower(measurement_residual(model))  # derived now, the first time, and not while solving
        if fit:
            lower(measurement_residual(model, moved="extrinsics" in fit, delayed="delay" in fit))
    return sequence, kinematics


def _target(source: Source, sequence: Sequence) -> Path:
    from acino_fte.result_files import check_output_folder

    return check_output_folder(source.out or Path("out") / sequence.name, input_folder=source.path)


def _cameras(sequence: Sequence, holdout: str | None, ladder: bool) -> list[str] | None:
    """Cameras to leave out, checked before anything is estimated."""
    from acino_fte.holdout import check_cameras

    if holdout is None:
        if ladder:
            raise InputError(
                "The ladder is one of errors in cameras left out.",
                key="--ladder",
                remedy="add --holdout-cameras each",
            )
        return None
    names = None if holdout.strip() == "each" else [n.strip() for n in holdout.split(",") if n.strip()]
    return check_cameras(sequence, names)


def _evaluate(
    sequence: Sequence,
    kinematics: Kinematics,
    method: str,
    options: EstimateOptions,
    result: FTEResult,
    cameras: list[str] | None,
    ladder: bool,
    progress: ProgressCallback,
) -> dict[str, Any]:
    """Fields of metrics.json on cameras left out; with the ladder for every rung on the way."""
    from acino_fte.evaluate import climb, evaluate_holdout

    found = evaluate_holdout(sequence, kinematics, method, options, result, cameras, progress)
    if ladder and method == "fte":
        found["ladder"] = climb(sequence, kinematics, options, result, cameras, found, progress)
    return found


@contextmanager
def stages(seconds: dict[str, float], quiet: bool) -> Iterator:
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


def describe(sequence: Sequence, result: FTEResult) -> None:
    """A few lines on what came out."""
    metrics = result.metrics
    error, spent = metrics["reprojection_px"], metrics["seconds"]
    stdout.print(
        f"{escape(sequence.name)}: {result.skeleton.name}, {sequence.n_frames} frames at "
        f"{sequence.fps:g} Hz, {len(sequence.cameras)} cameras, {metrics['n_observations']} detections"
    )
    for finding in result.findings:
        stdout.print(f"[dim]·[/] {escape(finding)}")
    colour = "green" if result.status.ok else "yellow"
    stdout.print(
        f"[{colour}]{result.status}[/] after {result.iterations} iterations; "
        f"{spent['initialise'] + spent['build'] + spent['solve']:.2f} s, "
        f"{metrics['realtime_factor'] or 0:.2g} × real time"
    )
    if error["median"] is not None:
        stdout.print(
            f"reprojection error: median {error['median']:.1f} px, "
            f"{100 * error['within_20px']:.1f} % within 20 px"
        )
    depth = metrics.get("depth_m")
    if depth and depth["n"]:
        stdout.print(
            f"depth: {depth['n']} measurements, median {1e3 * depth['median']:.0f} mm from the surface, "
            f"{100 * depth['outlier_ratio']:.1f} % beyond 3 standard deviations"
        )
    for key, name in (("heldout_px", "cross-fitted"), ("heldout_nominal_px", "given calibration")):
        held = metrics.get(key)
        if held and held["median"] is not None:
            stdout.print(
                f"cameras left out, {name}: median {held['median']:.1f} px, "
                f"{100 * held['within_20px']:.1f} % within 20 px, coverage {100 * held['coverage']:.1f} %"
            )
    uncertainty = metrics.get("uncertainty")
    if uncertainty and uncertainty.get("median_sd_mm") is not None:
        stdout.print(f"standard deviation of a marker: median {uncertainty['median_sd_mm']:.1f} mm")
    truth = metrics.get("truth_mm")
    if truth and truth["mpjpe"] is not None:
        stdout.print(
            f"error against the truth: mean {truth['mpjpe']:.2f} mm, 95 % below {truth['p95']:.1f} mm"
        )


def save(result: FTEResult, target: Path, source: Path, figures: bool, quiet: bool) -> None:
    """Write the result, and say where."""
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
