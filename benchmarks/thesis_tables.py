"""The tables of the thesis "3D Trajectory Reconstruction for Animal Data", run again here.

    python benchmarks/thesis_tables.py [--data FOLDER] [--seeds 5] [--fixed] [--json thesis_tables.json]

Table 1: 3, 5 and 7 animals, noise of 3 px. Table 3: 20 animals, noise of 0, 3 and 5 px. Table 5: starlings.
Each line is a method: pairing accuracy / used-data ratio as the thesis prints it, as measured once with its
public code, and here (mean over seeds of the noise; ± is the standard deviation of one run), with the ratio
that a perfect matching reaches, recall, the share of trajectories that are right as a whole, the mean error
of right pairs, and times. Its code's numbers for starlings B are those of a result file stored beside it, of
which it does not say the set. FOLDER holds the thesis's own sets (thesis_synthetic, starlings_A_thesis_rig,
starlings_B_thesis_rig) and adds them; without it only data made here are used, whose motion is like the
thesis's but not the same. Times of its code are of another machine. To add a method, add it to `methods`.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.load_tracks import load_tracks
from acino_fte.data_tools.match_metrics import score_matching
from acino_fte.data_tools.thesis_method import ThesisOptions, match_thesis
from acino_fte.data_tools.track_cameras import read_track_cameras
from acino_fte.data_tools.tracks2d import TrackRecording, Tracks2D

Method = Callable[[TrackRecording], Sequence[np.ndarray]]
Pair = tuple[float, float | None]
Known = dict[int, dict[str, Pair]]


@dataclass
class Case:
    """One row of a table: recordings that differ in their noise only, and what is known of them."""

    table: str
    name: str
    recordings: Callable[[int], Iterator[TrackRecording]]
    printed: dict[str, Pair] = field(default_factory=dict)
    measured: dict[str, Pair] = field(default_factory=dict)
    code_ms: dict[str, float] = field(default_factory=dict)


PRINTED: Known = {
    0: {"Set 1": (1.0, 0.98), "Set 2": (1.0, 0.64), "Set 3": (1.0, 0.83)},
    3: {"Set 1": (0.87, 0.86), "Set 2": (0.88, 0.59), "Set 3": (0.96, 0.51)},
    5: {"Set 1": (0.80, 0.81), "Set 2": (0.79, 0.58), "Set 3": (0.92, 0.39)},
}
MEASURED: Known = {
    0: {"Set 1": (1.0, 0.990), "Set 2": (1.0, 0.650), "Set 3": (1.0, 0.836)},
    3: {"Set 1": (0.875, 0.862), "Set 2": (0.885, 0.599), "Set 3": (0.969, 0.508)},
    5: {"Set 1": (0.795, 0.802), "Set 2": (0.795, 0.580), "Set 3": (0.940, 0.378)},
}
PRINTED_1: Known = {3: {"Set 2": (0.98, None)}, 5: {"Set 2": (0.97, None)}, 7: {"Set 2": (0.96, None)}}
MEASURED_1: Known = {
    3: {"Set 2": (0.990, 0.639), "Set 2 fixed": (0.998, 0.913)},
    5: {"Set 2": (0.976, None)},
    7: {"Set 2": (0.957, 0.628), "Set 2 fixed": (0.980, 0.864)},
}
PRINTED_5: dict[str, Pair] = {"Set 2": (1.0, None)}
MEASURED_5: dict[str, dict[str, Pair]] = {"A": {}, "B": {"Set 2": (0.9904, 0.9724)}}
CODE_MS = {
    3: {"Set 1": 10.0, "Set 2": 44.0},
    5: {"Set 1": 24.0},
    7: {"Set 1": 46.0, "Set 2": 222.0},
    20: {"Set 1": 607.0, "Set 2": 4500.0},
}


def thesis(sets: int, fixed: bool = False) -> Method:
    """The thesis's method as a column of the tables."""
    options = ThesisOptions(sets=sets, fixed=fixed)
    return lambda recording: match_thesis(recording, options)


def tracks() -> Method | None:
    """The project's own method; None where it is not installed."""
    try:
        module = importlib.import_module("acino_fte.data_tools.track_matching")
    except ModuleNotFoundError:
        return None
    return lambda recording: module.match_tracks(recording).groups


def methods(fixed: bool) -> dict[str, Method]:
    """The columns, in order."""
    found: dict[str, Method] = {f"Set {n}": thesis(n) for n in (1, 2, 3)}
    if fixed:
        found |= {f"Set {n} fixed": thesis(n, fixed=True) for n in (2, 3)}
    own = tracks()
    if own is not None:
        found["tracks"] = own
    return found


def own_set(folder: Path, sigma: float) -> Callable[[int], Iterator[TrackRecording]]:
    """The thesis's 20 animals with Gaussian noise; what lies outside the image is not seen."""
    table = pd.read_csv(folder / "truth_3d_20.csv").rename(columns={"oid": "animal"})
    table = table.sort_values(["frame", "animal"], ignore_index=True)
    cameras = read_track_cameras(folder / "cameras.json")

    def make(seeds: int) -> Iterator[TrackRecording]:
        for seed in range(seeds if sigma else 1):
            yield noisy(table, cameras, sigma, seed)

    return make


def noisy(table: pd.DataFrame, cameras: CameraArray, sigma: float, seed: int) -> TrackRecording:
    """Dots of the animals of a table in every camera."""
    rng = np.random.default_rng(seed)
    frame, animal = table["frame"].to_numpy(), table["animal"].to_numpy()
    labels = tuple(str(k) for k in range(int(animal.max()) + 1))
    views = []
    for camera in cameras:
        xy = camera.project(table[["x", "y", "z"]].to_numpy())
        xy = xy + sigma * rng.normal(size=xy.shape)
        seen = camera.inside(xy)
        dots = frame[seen], animal[seen], xy[seen]
        views.append(Tracks2D(camera.name, *dots, labels, animal=animal[seen]))
    return TrackRecording("thesis", cameras, tuple(views), fps=30.0, truth_3d=table)


def as_it_is(folder: Path) -> Callable[[int], Iterator[TrackRecording]]:
    """A recording without noise of ours."""

    def make(seeds: int) -> Iterator[TrackRecording]:
        yield load_tracks(folder)

    return make


def made_here(n_animals: int, sigma: float) -> Callable[[int], Iterator[TrackRecording]]:
    """Recordings of the simulator with the thesis's rig and its jumpy motion; motion and noise by seed."""

    def make(seeds: int) -> Iterator[TrackRecording]:
        from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks

        for seed in range(seeds):
            options = TrackSimulation(n_animals=n_animals, motion="jumpy", noise_px=sigma, seed=seed)
            yield simulate_tracks(options)

    return make


def cases(data: Path | None) -> Iterator[Case]:
    """All rows of the tables."""
    for n in (3, 5, 7):
        known = PRINTED_1[n], MEASURED_1[n], CODE_MS[n]
        yield Case("Table 1 (noise 3 px)", f"n = {n}, made here", made_here(n, 3.0), *known)
    for sigma in (0, 3, 5):
        known = PRINTED[sigma], MEASURED[sigma], CODE_MS[20]
        if data is not None and (data / "thesis_synthetic").is_dir():
            own = own_set(data / "thesis_synthetic", sigma)
            yield Case("Table 3 (20 animals)", f"noise {sigma} px, its own set", own, *known)
        made = made_here(20, sigma)
        yield Case("Table 3 (20 animals)", f"noise {sigma} px, made here", made, *known)
    for letter in "AB":
        folder = data / f"starlings_{letter}_thesis_rig" if data is not None else None
        if folder is not None and folder.is_dir():
            yield Case("Table 5 (starlings)", letter, as_it_is(folder), PRINTED_5, MEASURED_5[letter])


def run(method: Method, recording: TrackRecording) -> dict[str, float]:
    """Scores and milliseconds per frame of one matching."""
    began = time.perf_counter()
    groups = method(recording)
    seconds = time.perf_counter() - began
    score = score_matching(recording, groups).pooled
    errors = score.errors_mm
    return {
        "pa": score.precision,
        "udr": score.udr,
        "ceiling": score.udr_ceiling,
        "recall": score.recall,
        "right": score.trajectories_right,
        "error_mm": float(np.nanmean(errors)) if errors is not None and len(errors) else np.nan,
        "ms_per_frame": 1000.0 * seconds / recording.n_frames,
    }


def warm(columns: dict[str, Method]) -> None:
    """Run every method once, so that imports and tables are not timed."""
    recording = next(made_here(7, 3.0)(1))
    for method in columns.values():
        method(recording)


def pair(values: Pair | None) -> str:
    """Accuracy / used-data ratio as text."""
    if values is None:
        return "–"
    return " / ".join("–" if v is None else f"{v:.3f}" for v in values)


def line(name: str, case: Case, runs: pd.DataFrame) -> str:
    """One line of a table."""
    mean, sd = runs.mean(), runs.std(ddof=0)
    here = f"{mean['pa']:.4f} / {mean['udr']:.4f}"
    if len(runs) > 1:
        here += f" ± {sd['pa']:.3f} / {sd['udr']:.3f}"
    old = case.code_ms.get(name)
    cells = [
        f"  {name:<12}",
        f"{pair(case.printed.get(name)):<15}",
        f"{pair(case.measured.get(name)):<15}",
        f"{here:<33}",
        f"{mean['ceiling']:<8.4f}{mean['recall']:<8.4f}{mean['right']:<7.3f}",
        f"{mean['error_mm']:<8.2f}" if np.isfinite(mean["error_mm"]) else f"{'–':<8}",
        f"{'–' if old is None else f'{old:.0f}':<9}{mean['ms_per_frame']:.2f}",
    ]
    return "".join(cells)


HEADER = (
    f"  {'method':<12}{'thesis':<15}{'its code':<15}{'here':<33}{'ceiling':<8}{'recall':<8}{'tracks':<7}"
    f"{'mm':<8}{'its ms':<9}ms per frame"
)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder with the thesis's own sets")
    parser.add_argument("--seeds", type=int, default=5, help="runs with different noise (default 5)")
    parser.add_argument("--fixed", action="store_true", help="also with two faults of the forecast mended")
    parser.add_argument("--tables", default="135", help="which of the tables 1, 3 and 5 (default 135)")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    chosen = parser.parse_args(arguments)
    if chosen.data is not None and not chosen.data.is_dir():
        parser.error(f"there is no folder {chosen.data}")
    if chosen.seeds < 1:
        parser.error("--seeds must be 1 or more")
    return chosen


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    chosen = parse(arguments)
    columns = methods(chosen.fixed)
    warm(columns)
    numbers: list[dict[str, Any]] = []
    title = ""
    for case in cases(chosen.data):
        if case.table.split()[1] not in chosen.tables:
            continue
        if case.table != title:
            title = case.table
            print(f"\n{title}\n{HEADER}")
        print(f" {case.name}")
        recordings = list(case.recordings(chosen.seeds))
        for name, method in columns.items():
            runs = pd.DataFrame([run(method, recording) for recording in recordings])
            print(line(name, case, runs), flush=True)
            entry = {"table": case.table, "case": case.name, "method": name, "runs": len(runs)}
            means = {key: None if pd.isna(value) else float(value) for key, value in runs.mean().items()}
            numbers.append(
                entry | means | {"printed": case.printed.get(name), "measured": case.measured.get(name)}
            )
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(numbers, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
