"""Several methods on the same recordings, scored on the same detections.

What is compared is a *variant*: a method with the options that belong to it. Every variant faces all
detections above the likelihood threshold as they were read; that full trajectory estimation puts exchanged
sides right, or chooses among candidates, helps its trajectory but does not change what it is scored on. Where
a method has no position there is no error; that counts against its coverage and nowhere else.

Every number is defined in ``docs/metrics.md``, section *Comparing methods*.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from acino_fte.estimate import EstimateOptions
    from acino_fte.kinematics import Kinematics
    from acino_fte.problem import FTEOptions
    from acino_fte.result import FTEResult
    from acino_fte.sequence import Sequence
    from acino_fte.solve import Progress

IN_SAMPLE, LEFT_OUT, NOMINAL = "Reprojection error", "Left out, cross-fitted", "Left out, nominal"
TRUTH, TIME = "Truth", "Time"
REFUSED = "refused"
"""Status of a method that could not be applied to the input (``failed`` is a solver's)."""
MEAN = "mean"
"""Status of a row that is a mean over sequences."""


@dataclass(frozen=True)
class Variant:
    """A method as it is compared.

    Attributes
    ----------
    name : str
        On the command line and in files.
    title : str
        In tables and figures.
    method : str
        One of :data:`acino_fte.methods.METHODS`.
    does : str
        What it is, for those who read the table.
    fit : tuple of str, optional
        Parameters it estimates; None for those that the data can tell.
    noise : str
        Measurement noise, ``"estimated"`` or the species' ``"table"``; means something to ``fte`` alone.
    association : str
        Of a lidar's returns (:data:`acino_fte.association.ASSOCIATIONS`); means something to ``fte`` alone.
    lidar : bool
        Whether it is about the lidar: not among ``all``, and refused without one.
    """

    name: str
    title: str
    method: str
    does: str
    fit: tuple[str, ...] | None = ()
    noise: str = "table"
    association: str = "marker"
    lidar: bool = False

    def options(self, problem: FTEOptions) -> EstimateOptions:
        """Options of its estimate."""
        from acino_fte.estimate import EstimateOptions

        return EstimateOptions(problem=problem, fit=self.fit, noise=self.noise, association=self.association)


VARIANTS: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant(
            "fte",
            "FTE",
            "fte",
            "full trajectory estimation with all defaults: parameters that the data can tell and detection "
            "noise are estimated too",
            fit=None,
            noise="estimated",
        ),
        Variant(
            "fte-plain",
            "FTE, plain",
            "fte",
            "the trajectory alone: the given calibration, the species' proportions and table of noise "
            "(--fit none --noise table)",
        ),
        Variant("ekf", "EKF", "ekf", "extended Kalman filter and smoother on the skeleton"),
        Variant("sba", "SBA", "sba", "bundle adjustment of the triangulated markers, no skeleton"),
        Variant(
            "sba-cameras",
            "SBA, cameras",
            "sba",
            "bundle adjustment of the triangulated markers and of the cameras' poses",
            fit=("extrinsics",),
        ),
        Variant("tri", "Triangulation", "tri", "robust triangulation, every marker and frame on its own"),
        *(
            Variant(f"fte-{name}", f"FTE, {title}", "fte", does, None, "estimated", association, lidar=True)
            for name, title, association, does in (
                ("body", "whole body", "body", "FTE with every return on the body (--association body)"),
                (
                    "nearest",
                    "nearest return",
                    "nearest",
                    "FTE with the thesis's depth: of the nearest return",
                ),
                ("no-lidar", "no lidar", "none", "FTE from the image alone (--association none)"),
            )
        ),
    )
}
"""All variants by name, in the order of the table."""


@dataclass(frozen=True)
class Column:
    """A column of the table: its name in ``comparison.csv``, where metrics.json has it, how it is shown."""

    name: str
    path: tuple[str, ...]
    group: str
    title: str
    unit: str
    digits: int

    @property
    def head(self) -> str:
        """Title with its unit, ``median (px)``."""
        return f"{self.title} ({self.unit})"

    @property
    def full(self) -> str:
        """Head that stands without its group's, ``left out, nominal: median (px)``."""
        alone = {IN_SAMPLE: "", TIME: ""}
        return f"{alone.get(self.group, self.group.lower() + ': ')}{self.head}"

    def shown(self, value: float | None) -> str:
        """The value as text; shares in percent; a dash when undefined."""
        return "–" if value is None else f"{(100 if self.unit == '%' else 1) * value:.{self.digits}f}"


COLUMNS: tuple[Column, ...] = (
    *(
        Column(f"reprojection_{key}_px", ("reprojection_px", key), IN_SAMPLE, title, "px", 2)
        for key, title in (
            ("median", "median"),
            ("mean", "mean"),
            ("rmse", "RMSE"),
            ("std", "sd"),
            ("p90", "p90"),
        )
    ),
    Column("within_20px", ("reprojection_px", "within_20px"), IN_SAMPLE, "within 20 px", "%", 1),
    Column("pck_nose_eye", ("reprojection_px", "pck_nose_eye"), IN_SAMPLE, "within ½ nose–eye", "%", 1),
    Column("outlier_ratio", ("reprojection_px", "outlier_ratio"), IN_SAMPLE, "outliers", "%", 1),
    Column("coverage", ("reprojection_px", "coverage"), IN_SAMPLE, "coverage", "%", 1),
    Column("heldout_median_px", ("heldout_px", "median"), LEFT_OUT, "median", "px", 2),
    Column("heldout_within_20px", ("heldout_px", "within_20px"), LEFT_OUT, "within 20 px", "%", 1),
    Column("heldout_coverage", ("heldout_px", "coverage"), LEFT_OUT, "coverage", "%", 1),
    Column("heldout_nominal_median_px", ("heldout_nominal_px", "median"), NOMINAL, "median", "px", 2),
    Column(
        "heldout_nominal_within_20px", ("heldout_nominal_px", "within_20px"), NOMINAL, "within 20 px", "%", 1
    ),
    Column("heldout_nominal_coverage", ("heldout_nominal_px", "coverage"), NOMINAL, "coverage", "%", 1),
    Column("truth_mpjpe_mm", ("truth_mm", "mpjpe"), TRUTH, "mean error", "mm", 1),
    Column("seconds", ("seconds", "estimate"), TIME, "estimate", "s", 2),
)


@dataclass(frozen=True)
class Row:
    """One variant on one sequence, or its mean over several.

    Attributes
    ----------
    variant : Variant
    status : str
        How the solver ended, :data:`REFUSED` or :data:`MEAN`.
    numbers : dict
        Column name → value, None where undefined; shares between 0 and 1.
    metrics : dict
        The fields of metrics.json, scored on all detections; empty when refused.
    notes : tuple of str
        Why it was refused, what it lacks.
    error : InputError, optional
        Why it was refused.
    """

    variant: Variant
    status: str
    numbers: dict[str, float | None] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    error: InputError | None = None

    @property
    def refused(self) -> bool:
        """Whether the method could not be applied."""
        return self.status == REFUSED

    @property
    def unconverged(self) -> bool:
        """Whether the solver ended without an optimum."""
        return self.status not in ("converged", "acceptable", REFUSED, MEAN)

    @property
    def title(self) -> str:
        """Title of the variant, with what is wrong about it."""
        wrong = self.status.replace("_", " ") if self.refused or self.unconverged else ""
        return f"{self.variant.title} ({wrong})" if wrong else self.variant.title


@dataclass(frozen=True)
class Block:
    """The rows of one sequence, or of the mean over several."""

    name: str
    about: str
    rows: tuple[Row, ...]
    facts: dict[str, Any] = field(default_factory=dict)


def choose(text: str) -> list[Variant]:
    """``"fte,tri"`` as variants, in the order given; ``"all"`` for all but those about a lidar.

    Raises
    ------
    InputError
        There is no such variant, or none is named.
    """
    names = list(dict.fromkeys(word.strip().lower() for word in text.split(",") if word.strip()))
    if names == ["all"]:
        return [variant for variant in VARIANTS.values() if not variant.lidar]
    known = f"'all', or some of {', '.join(VARIANTS)} with commas between them"
    for name in names:
        if name not in VARIANTS:
            raise InputError(
                f"There is no method '{name}'{did_you_mean(name, VARIANTS)}", key="--methods", expected=known
            )
    if not names:
        raise InputError("No method is named.", key="--methods", expected=known, found=repr(text))
    return [VARIANTS[name] for name in names]


def apply_variant(
    variant: Variant,
    sequence: Sequence,
    kinematics: Kinematics,
    problem: FTEOptions,
    cameras: list[str] | None = None,
    progress: Progress | None = None,
) -> Row:
    """Estimate with a variant, and score it.

    Parameters
    ----------
    variant : Variant
        What to estimate with.
    sequence : Sequence
        What to estimate from.
    kinematics : Kinematics
        Of the species, without parameters.
    problem : FTEOptions
        Likelihood threshold, loss and process noise of every method.
    cameras : list of str, optional
        Leave each of these cameras out as well, and predict it.
    progress : callable, optional
        Called with (iteration, objective).

    Returns
    -------
    Row
        A method that refuses the recording is a row that says why. One that only fails without a camera
        has no numbers on cameras left out.
    """
    from acino_fte.evaluate import evaluate_holdout
    from acino_fte.methods import estimate

    options = variant.options(problem)
    if variant.lidar and sequence.lidar is None:
        return refusal(variant, InputError("The sequence has no lidar.", remedy="leave this method out"))
    try:
        result = estimate(variant.method, sequence, kinematics, options, progress=progress)
    except InputError as error:
        return refusal(variant, error)
    _stop_if_interrupted(result)
    evaluation: dict[str, Any] = {}
    notes: tuple[str, ...] = ()
    if cameras:
        began = time.perf_counter()
        try:
            evaluation = evaluate_holdout(
                sequence, kinematics, variant.method, options, result, cameras, progress
            )
        except InputError as error:
            notes = (f"without a camera: {error.problem}",)
        result = replace(result, seconds={**result.seconds, "holdout": time.perf_counter() - began})
    metrics = scored(replace(result, evaluation=evaluation), problem.likelihood)
    return Row(variant, str(result.status), columns_of(metrics), metrics, notes)


def _stop_if_interrupted(result: FTEResult) -> None:
    """Ctrl-C ends the comparison and not only the method that was running."""
    if str(result.status) == "interrupted":
        raise KeyboardInterrupt


def refusal(variant: Variant, error: InputError) -> Row:
    """The row of a variant that refused a recording."""
    return Row(variant, REFUSED, columns_of({}), {}, (error.problem,), error)


def scored(result: FTEResult, likelihood: float) -> dict[str, Any]:
    """The fields of metrics.json with all detections above a threshold as observations, as they were read.

    ``seconds.estimate`` is added: from detections to trajectory and covariance, s.
    """
    pixels = result.sequence.pixels(result.skeleton.marker_names, likelihood)
    metrics = dict(replace(result, observed=pixels).metrics)
    spent = metrics["seconds"]
    metrics["seconds"] = {**spent, "estimate": sum(spent[k] for k in ("initialise", "build", "solve"))}
    return metrics


def columns_of(metrics: dict[str, Any]) -> dict[str, float | None]:
    """Column name → value of the fields of metrics.json."""
    values: dict[str, float | None] = {}
    for column in COLUMNS:
        value: Any = metrics
        for key in column.path:
            value = (value or {}).get(key)
        values[column.name] = value
    return values


def block_of(sequence: Sequence, name: str, rows: Iterable[Row], likelihood: float) -> Block:
    """The rows of a sequence, with what it is."""
    rows = tuple(rows)
    first, last = int(sequence.frames[0]), int(sequence.frames[-1])
    counts = [row.metrics["n_observations"] for row in rows if row.metrics]
    facts = {
        "species": sequence.species,
        "frames": [first, last + 1],
        "fps": sequence.fps,
        "cameras": sequence.cameras.names,
        "likelihood": likelihood,
        "n_detections": counts[0] if counts else None,
    }
    about = f"frames {first}–{last} at {sequence.fps:g} Hz, {len(sequence.cameras)} cameras"
    return Block(name, about + (f", {counts[0]} detections" if counts else ""), rows, facts)


def mean_block(blocks: list[Block]) -> Block:
    """The mean over sequences of every column, sequence by sequence of equal weight.

    A number that a sequence lacks (truth, say) is left out of the mean. A note says where a method lacks a
    number that others have, because its mean is then of fewer sequences than theirs.
    """
    had = [
        {name for row in block.rows for name, value in row.numbers.items() if value is not None}
        for block in blocks
    ]
    rows = []
    for variant in dict.fromkeys(row.variant for block in blocks for row in block.rows):
        found = [row for block in blocks for row in block.rows if row.variant == variant and not row.refused]
        if not found:
            rows.append(Row(variant, REFUSED, columns_of({}), notes=("refused every sequence",)))
            continue
        values = {column.name: _mean(row.numbers[column.name] for row in found) for column in COLUMNS}
        notes = [] if len(found) == len(blocks) else [f"mean of {len(found)} of {len(blocks)} sequences"]
        pairs = [(row, h) for b, h in zip(blocks, had, strict=True) for row in b.rows if row in found]
        fewer = [
            c.full for c in COLUMNS if any(row.numbers[c.name] is None and c.name in h for row, h in pairs)
        ]
        if fewer:
            notes.append(f"fewer sequences in {', '.join(fewer)}")
        if loose := sum(row.unconverged for row in found):
            notes.append(f"did not converge on {loose} of them")
        rows.append(Row(variant, MEAN, values, notes=tuple(notes)))
    return Block(f"Mean of {len(blocks)} sequences", "each of equal weight", tuple(rows))


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None
