"""The command ``acino-fte compare``: several methods on the same recordings, in one table."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from acino_fte.cli_common import EXIT_UNCONVERGED, on_terminal, reported_errors, stderr, stdout, warn
from acino_fte.errors import InputError

if TYPE_CHECKING:
    from acino_fte.cli_estimate import Source
    from acino_fte.comparison import Block, Variant
    from acino_fte.estimate import EstimateOptions
    from acino_fte.kinematics import Kinematics
    from acino_fte.sequence import Sequence
    from acino_fte.solve import Progress as ProgressCallback

_Step = Callable[[str], "ProgressCallback"]


def compare(
    sequences: Annotated[
        list[Path],
        typer.Argument(
            metavar="SEQUENCE",
            help="Folders with sequence.yaml or in the AcinoSet layout, or sequence.yaml files.",
            show_default=False,
        ),
    ],
    methods: Annotated[
        str,
        typer.Option(
            metavar="METHODS",
            help="Some of fte, fte-plain (no parameters, table of noise), ekf, sba, sba-cameras (corrects "
            "them too), tri, with commas between them; or 'all'. With a lidar also fte-body, fte-nearest "
            "(the thesis's depth) and fte-no-lidar.",
        ),
    ] = "all",
    holdout_cameras: Annotated[
        str | None,
        typer.Option(
            metavar="each|CAMERAS",
            help="Also estimate without each camera (or some: cam1,cam2) and score how well it is predicted. "
            "Takes one more estimate a camera: with C cameras about C + 1 times as long.",
            show_default="none",
        ),
    ] = None,
    species: Annotated[
        str | None, typer.Option(help="Species name, or a species file (.yaml); overrides the sequences'.")
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second; overrides the sequences'.")] = None,
    frames: Annotated[
        str | None,
        typer.Option(
            metavar="START:STOP", help="Frames to use, half-open, counted from 0; either may be left out."
        ),
    ] = None,
    likelihood: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Use, and score on, detections above this likelihood.")
    ] = 0.5,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the tables and the figure.")] = Path(
        "out/comparison"
    ),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors and warnings only.")] = False,
) -> None:
    """Compare methods on one SEQUENCE or several: errors, cameras left out, coverage, truth and time.

    Writes comparison.csv, .md, .tex, .json and a figure. Leaves with 0 when every solver converged, 3 when
    one did not, 2 when the input is wrong for all methods; one that refuses the input is a line in the table.
    """
    with reported_errors():
        from acino_fte.cli_estimate import Source, frame_range
        from acino_fte.comparison import choose
        from acino_fte.estimate import EstimateOptions
        from acino_fte.problem import FTEOptions

        variants = choose(methods)
        span = frame_range(frames)
        target = _target(sequences, out)
        options = EstimateOptions(FTEOptions(likelihood))
        sources = [Source(path, None, species, fps, span) for path in sequences]
        with _steps(len(sources) * (1 + len(variants)), quiet) as step:
            recordings = _distinct([_read(source, options, holdout_cameras, step) for source in sources])
            _tell(recordings)
            blocks = [_block(recording, variants, options, step) for recording in recordings]
        _refuse_if_all_did(blocks)
        settings = {
            "methods": [variant.name for variant in variants],
            "holdout_cameras": holdout_cameras,
            "species": species,
            "fps": fps,
            "frames": frames,
            "likelihood": likelihood,
        }
        _save(blocks, settings, target, quiet)
    if any(row.unconverged for block in blocks for row in block.rows):
        raise typer.Exit(EXIT_UNCONVERGED)


def _target(sequences: list[Path], out: Path) -> Path:
    """The output folder, apart from every input; each input is to be named once."""
    from acino_fte.comparison_files import COMPARISON
    from acino_fte.result_files import check_output_folder

    places = [path.resolve() for path in sequences]
    for i, place in enumerate(places):
        if place in places[:i]:
            raise InputError(
                "A sequence is named twice, and would count twice in the mean.", file=sequences[i]
            )
    for path in sequences:
        target = check_output_folder(out, input_folder=path, contents=COMPARISON)
    return target


@contextmanager
def _steps(total: int, quiet: bool) -> Iterator[_Step]:
    """A bar over sequences and methods on a terminal, nothing in a pipe; called with what begins now."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=stderr,
        transient=True,
        disable=quiet or not on_terminal(),
    ) as bar:
        task = bar.add_task("", total=total)
        begun = 0

        def step(text: str) -> ProgressCallback:
            nonlocal begun
            text = escape(text)
            bar.update(task, completed=begun, description=text)
            begun += 1

            def progress(iteration: int, objective: float) -> None:
                bar.update(task, description=f"{text}: iteration {iteration}")

            return progress

        yield step


@dataclass(frozen=True)
class _Recording:
    """A sequence with its kinematics and the cameras to leave out; or why it could not be read."""

    path: Path
    name: str
    found: tuple[Sequence, Kinematics] | InputError
    cameras: list[str] | None = None


def _read(source: Source, options: EstimateOptions, holdout: str | None, step: _Step) -> _Recording:
    """Read a sequence; all of them are read before anything is estimated."""
    from acino_fte.cli_estimate import load
    from acino_fte.holdout import check_cameras

    step(f"reading {source.path.name}")
    cameras = None
    try:
        sequence, kinematics = load(source, options)
        if holdout is not None:
            named = [name.strip() for name in holdout.split(",") if name.strip()]
            cameras = check_cameras(sequence, None if named == ["each"] else named)
    except InputError as error:
        return _Recording(source.path, source.path.resolve().name, error)
    return _Recording(source.path, sequence.name, (sequence, kinematics), cameras)


def _distinct(recordings: list[_Recording]) -> list[_Recording]:
    """Names that two recordings share get the name of their folder before them."""
    names = [recording.name for recording in recordings]
    return [
        r if names.count(r.name) == 1 else replace(r, name=f"{r.path.resolve().parent.name}/{r.name}")
        for r in recordings
    ]


def _tell(recordings: list[_Recording]) -> None:
    """Warn of what the reader noticed, and of sequences that the comparison has to do without."""
    for recording in recordings:
        if isinstance(recording.found, InputError):
            if len(recordings) > 1:
                warn(f"{recording.name} is left out. {recording.found}")
            continue
        for message in recording.found[0].warnings:
            warn(message if len(recordings) == 1 else f"{recording.name}: {message}")


def _block(recording: _Recording, variants: list[Variant], options: EstimateOptions, step: _Step) -> Block:
    """Apply every variant to a sequence."""
    from acino_fte.comparison import Block, apply_variant, block_of, refusal

    if isinstance(recording.found, InputError):
        rows = tuple(refusal(variant, recording.found) for variant in variants)
        return Block(recording.name, "could not be read", rows)
    sequence, kinematics = recording.found
    applied = []
    for variant in variants:
        progress = step(f"{recording.name}: {variant.title}")
        row = apply_variant(variant, sequence, kinematics, options.problem, recording.cameras, progress)
        for note in row.notes:
            warn(f"{recording.name}, {variant.title}: {note}")
        applied.append(row)
    return block_of(sequence, recording.name, applied, options.problem.likelihood)


def _refuse_if_all_did(blocks: list[Block]) -> None:
    """The input is wrong when no method could be applied to anything; what all of them say is said once."""
    rows = [row for block in blocks for row in block.rows]
    if not all(row.refused for row in rows):
        return
    errors = list({str(row.error): row.error for row in rows if row.error is not None}.values())
    if len(errors) == 1:
        raise errors[0]
    raise InputError(
        "No method could be applied.", found="\n            ".join(str(e).split("\n")[0] for e in errors)
    )


def _save(blocks: list[Block], options: dict[str, Any], target: Path, quiet: bool) -> None:
    """Write tables and figure; then the table on the terminal."""
    from acino_fte.comparison import mean_block
    from acino_fte.comparison_files import save_comparison
    from acino_fte.comparison_tables import plain

    mean = mean_block(blocks) if len(blocks) > 1 else None
    save_comparison(blocks, mean, options, target)
    if quiet:
        return
    for line in plain([*blocks, mean] if mean is not None else blocks):
        stdout.print(line, markup=False)
    stdout.print(f"written to {escape(str(target))}")
