"""Seconds and memory of the matching of 2D tracks, and how honest its confidence is.

    python benchmarks/bench_tracks.py [--quick] [--runs 3] [--json bench_tracks.json]
    python benchmarks/bench_tracks.py --reliability reliability.png [--seeds 2]

Recordings are simulated. Each is matched in a process of its own, the fastest of several runs counts. The
steps are those that the matching reports. The thesis's method runs on the same recording; times of the
thesis's own code are of another machine. With --reliability: how many of the matches that were given a
probability p are right, in bins of p, for recordings hard enough to have errors.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.match_metrics import score_matching
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.thesis_method import ThesisOptions, match_thesis
from acino_fte.data_tools.track_matching import MatchOptions, TrackMatches, match_tracks

FRAGMENTS: dict[str, Any] = {"tracks": "fragments"}
CASES: dict[str, dict[str, Any]] = {
    "20 x 600": {},
    "20 x 600 fragments": FRAGMENTS,
    "20 x 600 hard": FRAGMENTS | {"missed": 0.1, "clutter": 0.1},
    "20 x 1200": {"n_frames": 1200},
    "20 x 2400": {"n_frames": 2400},
    "20 x 4800": {"n_frames": 4800},
    "20 x 1200 fragments": FRAGMENTS | {"n_frames": 1200},
    "20 x 2400 fragments": FRAGMENTS | {"n_frames": 2400},
    "20 x 4800 fragments": FRAGMENTS | {"n_frames": 4800},
    "100 x 600": {"n_animals": 100},
    "100 x 600 fragments": FRAGMENTS | {"n_animals": 100},
}
LARGE: dict[str, dict[str, Any]] = {
    "1000 x 600": {"n_animals": 1000, "motion": "smooth"},
    "1000 x 600 fragments": FRAGMENTS | {"n_animals": 1000, "motion": "smooth"},
}
AIMS: dict[str, tuple[float, float]] = {  # s, GB
    "20 x 600": (0.3, np.inf),
    "1000 x 600": (30.0, np.inf),
    "1000 x 600 fragments": (60.0, 1.6),
}
THESIS_CODE_MS = {1: 607.0, 2: 4500.0}  # a frame, 20 animals; Set 3 is not published
HARD: dict[str, dict[str, Any]] = {
    "40 animals, 8 px, pieces of 2–6": {"n_animals": 40, "noise_px": 8.0, "piece_frames": (2, 6)},
    "100 animals, clutter": {"n_animals": 100, "missed": 0.1, "clutter": 0.2, "piece_frames": (3, 15)},
    "flock": {"motion": "flock", "noise_px": 5.0, "piece_frames": (5, 30)},
    "perched": {"motion": "perched", "noise_px": 5.0, "n_frames": 400},
    "three views, 8 px": {
        "rig": "ring",
        "n_cameras": 3,
        "n_animals": 40,
        "noise_px": 8.0,
        "piece_frames": (3, 10),
    },
    "four views, much clutter": {
        "rig": "ring",
        "n_cameras": 4,
        "motion": "smooth",
        "n_animals": 30,
        "noise_px": 5.0,
        "missed": 0.2,
        "clutter": 0.5,
        "piece_frames": (3, 15),
    },
    "exchanges": {"tracks": "whole", "noise_px": 5.0, "swap_px": 20.0, "missed": 0.05, "n_frames": 400},
}
BINS = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.999, 1.0)


def measure(name: str, follow: bool, thesis: bool) -> dict[str, Any]:
    """Match a case once, in this process: seconds of every step, peak memory, score."""
    options = TrackSimulation(**{"seed": 900} | (CASES | LARGE)[name])
    recording = simulate_tracks(options)
    marks: list[tuple[str, float]] = []
    began, cpu = time.perf_counter(), time.process_time()
    matches = match_tracks(
        recording,
        MatchOptions(follow=follow),
        progress=lambda step: marks.append((step, time.perf_counter())),
    )
    ended, cpu = time.perf_counter(), time.process_time() - cpu
    times = [began, *(when for _, when in marks[1:]), ended]
    steps: dict[str, float] = {}
    for (step, _), first, last in zip(marks, times[:-1], times[1:], strict=True):
        steps[step] = steps.get(step, 0.0) + last - first
    found = score_matching(recording, matches.groups, errors_3d=False).pooled
    return {
        "case": name,
        "follow": follow,
        "frames": options.n_frames,
        "seconds": ended - began,
        "cpu_seconds": cpu,
        "steps": steps,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "precision": found.precision,
        "recall": found.recall,
        "thesis_seconds": {k: thesis_seconds(recording, k) for k in (1, 2, 3)} if thesis else {},
    }


def thesis_seconds(recording, which: int) -> float:
    """Of the thesis's Set 1, 2 or 3 on the same recording."""
    began = time.perf_counter()
    match_thesis(recording, ThesisOptions(sets=which))
    return time.perf_counter() - began


def fastest(name: str, follow: bool, runs: int, thesis: bool = False) -> dict[str, Any]:
    """The fastest of several runs, each in a fresh process."""
    command = [sys.executable, __file__, "--case", name, *([] if follow else ["--no-follow"])]
    found = []
    for k in range(runs):
        extra = ["--with-thesis"] if thesis and k == 0 else []
        done = subprocess.run([*command, *extra], check=True, capture_output=True, text=True)
        found.append(json.loads(done.stdout))
    best = min(found, key=lambda one: one["seconds"])
    return best | {"thesis_seconds": found[0]["thesis_seconds"]}


def report(one: dict[str, Any]) -> str:
    """A line and the steps of a case."""
    name, seconds = one["case"], one["seconds"]
    line = f"{name + ('' if one['follow'] else ', no 3D paths'):36s} {seconds:8.2f} s"
    line += f" {one['cpu_seconds']:8.2f} s CPU {one['peak_gb']:5.2f} GB"
    line += f" {1000 * seconds / one['frames']:8.3f} ms/frame  {one['precision']:.4f} / {one['recall']:.4f}"
    if name in AIMS:
        line += f"  (aim: {AIMS[name][0]:g} s" + (f", {AIMS[name][1]:g} GB)" if AIMS[name][1] < 99 else ")")
    steps = ", ".join(f"{step} {s:.2f}" for step, s in one["steps"].items())
    for which, s in one["thesis_seconds"].items():
        per_frame = 1000 * s / one["frames"]
        steps += f"\n    thesis, Set {which}, here: {per_frame:.2f} ms/frame, {s / seconds:.1f} times ours"
        published = THESIS_CODE_MS.get(int(which))
        if published:
            steps += (
                f"; its code {published:g} ms, {published / (1000 * seconds / one['frames']):.0f} times ours"
            )
    return f"{line}\n    {steps}"


@dataclass(frozen=True)
class Reliability:
    """How many of the matches that were given a probability are right, in bins of it.

    Attributes
    ----------
    told, right, count : (B,)
        Mean probability, share that is right and number of rows in every bin; NaN for an empty one.
    error : float
        Mean of |told − right| over the rows (expected calibration error; Naeini, Cooper and Hauskrecht 2015).
    """

    told: np.ndarray
    right: np.ndarray
    count: np.ndarray
    error: float


def told_and_right(matches: TrackMatches) -> tuple[np.ndarray, np.ndarray]:
    """Confidence of every matched row, and whether its piece's partners are of its animal, (K,) each.

    The partners of a piece are the rows of its group in the other views and its own frames; where there are
    none, in any frames. Most of them decide. Clutter has no right partner.
    """
    views = matches.recording.views
    which = np.repeat(np.arange(len(views)), [len(v) for v in views])
    group, sure, piece = (np.concatenate(x) for x in (matches.groups, matches.confidence, matches.pieces))
    animal = np.concatenate([np.asarray(v.animal) for v in views])
    frame = np.concatenate([v.frame for v in views])
    told, right = [], []
    order = np.argsort(group, kind="stable")
    order = order[group[order] >= 0]
    for rows in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        for k, v in {(int(p), int(w)) for p, w in zip(piece[rows], which[rows], strict=True)}:
            mine = rows[(piece[rows] == k) & (which[rows] == v)]
            others = rows[which[rows] != v]
            together = others[np.isin(frame[others], frame[mine])]
            partners = animal[together if len(together) else others]
            partners = partners[partners >= 0]
            most = np.bincount(partners).argmax() if len(partners) else -2
            told.append(sure[mine])
            right.append(animal[mine] == most)
    if not told:
        return np.zeros(0), np.zeros(0, dtype=bool)
    return np.concatenate(told), np.concatenate(right)


def reliability(told: np.ndarray, right: np.ndarray) -> Reliability:
    """Of rows (K,): the curve and its error."""
    place = np.clip(np.searchsorted(BINS, told, side="right") - 1, 0, len(BINS) - 2)
    count = np.bincount(place, minlength=len(BINS) - 1)
    with np.errstate(invalid="ignore"):
        mean_told = np.bincount(place, told, len(BINS) - 1) / count
        mean_right = np.bincount(place, right.astype(float), len(BINS) - 1) / count
    error = float(np.nansum(count * np.abs(mean_told - mean_right)) / max(len(told), 1))
    return Reliability(mean_told, mean_right, count, error)


def collect(options: dict[str, Any], seeds: range, follow: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Confidence and truth of the matched rows of some recordings."""
    found = []
    for seed in seeds:
        made = {"n_frames": 200, "tracks": "fragments", "seed": seed} | options
        found.append(
            told_and_right(
                match_tracks(simulate_tracks(TrackSimulation(**made)), MatchOptions(follow=follow))
            )
        )
    told, right = (np.concatenate(x) for x in zip(*found, strict=True))
    return told, right


def draw_reliability(curves: dict[str, Reliability], path: Path) -> None:
    """Share that is right against the probability told, one line a kind of recording."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(6.5, 6.0), layout="constrained")
    axis.fill_between([0, 1], [-0.03, 0.97], [0.03, 1.03], color="0.9", label="within 3 %")
    axis.plot([0, 1], [0, 1], color="0.5", linewidth=0.8)
    for name, curve in curves.items():
        filled = curve.count >= 30
        axis.plot(
            curve.told[filled],
            curve.right[filled],
            marker="o",
            markersize=3,
            label=f"{name} ({curve.error:.3f})",
        )
    axis.set(xlabel="probability told", ylabel="share right", xlim=(0.45, 1.01), ylim=(0.0, 1.02))
    axis.legend(fontsize=8, title="recording (expected calibration error)", title_fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def show_reliability(path: Path, n_seeds: int) -> dict[str, Any]:
    """Measure, print and draw the curves of all kinds of hard recordings, and of all together."""
    seeds = range(3000, 3000 + n_seeds)
    rows = {name: collect(options, seeds) for name, options in HARD.items()}
    rows["all"] = tuple(np.concatenate(x) for x in zip(*rows.values(), strict=True))  # type: ignore[assignment]
    curves = {name: reliability(*found) for name, found in rows.items()}
    for name, c in curves.items():
        print(f"{name:34s} {c.count.sum():7d} rows, told {np.mean(rows[name][0]):.3f}, ", end="")
        print(f"right {np.mean(rows[name][1]):.3f}, calibration error {c.error:.4f}")
        for low, told, right, n in zip(BINS[:-1], c.told, c.right, c.count, strict=True):
            if n:
                print(f"    from {low:5.3f}: {n:7d} rows, told {told:.3f}, right {right:.3f}")
    draw_reliability(curves, path)
    return {name: {k: np.asarray(v).tolist() for k, v in asdict(c).items()} for name, c in curves.items()}


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=3, help="runs of each case; the fastest counts")
    parser.add_argument("--quick", action="store_true", help="without the cases of 1,000 animals")
    parser.add_argument("--json", type=Path, help="write all numbers")
    parser.add_argument("--reliability", type=Path, help="draw the reliability of the confidence instead")
    parser.add_argument("--seeds", type=int, default=2, help="recordings of each kind for --reliability")
    parser.add_argument("--case", choices=[*CASES, *LARGE], help=argparse.SUPPRESS)
    parser.add_argument("--no-follow", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--with-thesis", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.case:
        print(json.dumps(measure(given.case, not given.no_follow, given.with_thesis)))
        return
    if given.reliability:
        found: Any = show_reliability(given.reliability, given.seeds)
    else:
        found = []
        for name in [*CASES, *([] if given.quick else LARGE)]:
            for follow in (True, False):
                runs = 1 if name in LARGE else given.runs
                found.append(fastest(name, follow, runs, thesis=follow and name == "20 x 600"))
                print(report(found[-1]), flush=True)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
