"""Cost of a trajectory estimate: condensed, explicit, and in AcinoSet's formulation, in one run.

    python benchmarks/bench_fte.py [--quick] [--json bench_fte.json]

Times are wall-clock seconds on this machine, on simulated gallops (6 cameras, 24 markers, 2 px noise, 30 %
missing, 5 % gross outliers). Every condensed case runs in a fresh process: once to warm up (imports, compiled
programs), then three times, of which the median counts. "End to end" is from loaded detections to the result
(initialise + build + solve). Ratios compare runs of the same call.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

FPS = 120.0
CONDENSED = (100, 200, 1000, 2000)
EXPLICIT_FRAMES, ACINOSET_FRAMES = 50, 20
ACINOSET_CAP = 300.0  # seconds its solver may take; a run that hits it gives a lower bound


def make_sequence(n_frames: int):  # noqa: ANN201
    """A simulated gallop and its kinematics."""
    from acino_fte.kinematics import load_kinematics
    from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
    from acino_fte.skeleton import load_skeleton

    skeleton = load_skeleton("cheetah")
    options = SimulationOptions(
        n_frames=n_frames, fps=FPS, missing=0.3, outliers=0.05, occlusion=False, radius=6.0
    )
    return simulation_to_sequence(simulate(skeleton, options)), load_kinematics(skeleton)


def peak_mb() -> float:
    """Largest resident size of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0 if platform.system() != "Darwin" else 1024.0**2)


def condensed_case(n_frames: int, repeats: int) -> dict[str, Any]:
    """One condensed case, in this process."""
    import cyipopt  # noqa: F401
    import numpy as np

    from acino_fte.initialise import initial_trajectory
    from acino_fte.problem import build_fte
    from acino_fte.solve import solve_fte

    warm, kinematics = make_sequence(30)
    solve_fte(build_fte(warm, kinematics), initial_trajectory(warm, kinematics))
    imported = peak_mb()
    sequence, kinematics = make_sequence(n_frames)
    runs = []
    for _ in range(repeats):
        began = time.perf_counter()
        start = initial_trajectory(sequence, kinematics)
        initialised = time.perf_counter()
        problem = build_fte(sequence, kinematics)
        built = time.perf_counter()
        result = solve_fte(problem, start)
        ended = time.perf_counter()
        runs.append((ended - began, initialised - began, built - initialised, ended - built))
    total, initialise, build, solve = sorted(runs)[len(runs) // 2]
    error = np.linalg.norm(result.positions - sequence.truth.values, axis=-1)
    return {
        "frames": n_frames,
        "seconds": total,
        "initialise": initialise,
        "build": build,
        "solve": solve,
        "realtime_factor": n_frames / FPS / total,
        "iterations": result.iterations,
        "status": str(result.status),
        "mpjpe_mm": 1e3 * float(error.mean()),
        "mb_per_frame": (peak_mb() - imported) / n_frames,
    }


def in_fresh_process(n_frames: int, repeats: int) -> dict[str, Any]:
    """:func:`condensed_case` in a process of its own, so that its memory is its own."""
    command = [sys.executable, __file__, "--case", str(n_frames), "--repeats", str(repeats)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def explicit_case(n_frames: int) -> dict[str, Any]:
    """The explicit model: build, write and solve, against the condensed one from the same start."""
    from acino_fte.condensed_solve import minimise
    from acino_fte.explicit import build_explicit
    from acino_fte.initialise import initial_trajectory
    from acino_fte.problem import build_fte

    sequence, kinematics = make_sequence(n_frames)
    problem = build_fte(sequence, kinematics)
    start = initial_trajectory(sequence, kinematics)
    minimise(problem, start)
    began = time.perf_counter()
    condensed = minimise(build_fte(sequence, kinematics), start)
    condensed_seconds = time.perf_counter() - began
    measured, minimum = timed(build_explicit, problem, start)
    return measured | {
        "condensed_build_solve": condensed_seconds,
        "relative_objective_difference": abs(minimum.objective / condensed.objective - 1),
    }


def acinoset_case(n_frames: int) -> dict[str, Any]:
    """AcinoSet's formulation: build, write and solve (capped), on the first frames of the same gallop."""
    from acinoset_formulation import build as build_acinoset

    from acino_fte.initialise import initial_trajectory
    from acino_fte.problem import build_fte
    from acino_fte.solve import SolveOptions

    sequence, kinematics = make_sequence(n_frames)
    problem = build_fte(sequence, kinematics)
    start = initial_trajectory(sequence, kinematics)
    measured, _ = timed(build_acinoset, problem, start, SolveOptions(max_seconds=ACINOSET_CAP))
    return measured


def timed(
    build: Callable[..., Any], problem: Any, start: Any, options: Any = None
) -> tuple[dict[str, Any], Any]:
    """Build, write and solve a Pyomo model: the seconds of each, and the minimum."""
    from acino_fte.explicit_solve import available_route, solve_explicit

    began = time.perf_counter()
    model = build(problem, start)
    built = time.perf_counter() - began
    write, size = write_nl(model)
    began = time.perf_counter()
    minimum = solve_explicit(model, problem, options)
    measured = {
        "frames": problem.n_frames,
        "route": available_route(),
        "build": built,
        "write": write,
        "nl_mb": size,
        "solve": time.perf_counter() - began,
        "iterations": minimum.iterations,
        "status": str(minimum.status),
    }
    return measured, minimum


def write_nl(model: Any) -> tuple[float, float]:
    """Seconds to write a model as .nl, and its size in MB."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.nl"
        began = time.perf_counter()
        model.write(str(path), format="nl")
        return time.perf_counter() - began, path.stat().st_size / 1e6


def ratios(report: dict[str, Any]) -> dict[str, float]:
    """What the table ends with."""
    by_frames = {case["frames"]: case for case in report["condensed"]}
    result = {}
    if 200 in by_frames and 2000 in by_frames:
        result["2000 frames / 200 frames, time"] = by_frames[2000]["seconds"] / by_frames[200]["seconds"]
    ours, explicit, theirs = (
        report["explicit"]["condensed_build_solve"],
        report["explicit"],
        report["acinoset"],
    )
    result["explicit / condensed, build + solve, 50 frames"] = (explicit["build"] + explicit["solve"]) / ours
    if theirs:
        scaled = (theirs["build"] + theirs["solve"]) * EXPLICIT_FRAMES / theirs["frames"]
        result["AcinoSet formulation / condensed, build + solve, 50 frames (extrapolated)"] = scaled / ours
        per_frame = theirs["nl_mb"] / theirs["frames"] / (explicit["nl_mb"] / explicit["frames"])
        result["AcinoSet formulation / explicit, .nl bytes per frame"] = per_frame
    return result


def show(report: dict[str, Any]) -> None:
    """Print the tables."""
    print(f"\n{report['machine']}\n\ncondensed, 6 cameras x 24 markers")
    print("frames  seconds  initialise  build  solve  x real time  iterations  MB/frame  error mm  status")
    for c in report["condensed"]:
        print(
            f"{c['frames']:6d}  {c['seconds']:7.2f}  {c['initialise']:10.2f}"
            f"  {c['build']:5.2f}  {c['solve']:5.2f}"
            f"  {c['realtime_factor']:11.2f}  {c['iterations']:10d}  {c['mb_per_frame']:8.3f}"
            f"  {c['mpjpe_mm']:8.2f}  {c['status']}"
        )
    for name in ("explicit", "acinoset"):
        c = report[name]
        if c:
            print(f"\n{name}, {c['frames']} frames by {c['route']}: build {c['build']:.1f} s, ", end="")
            print(f"write {c['write']:.1f} s ({c['nl_mb']:.1f} MB), ", end="")
            print(f"solve {c['solve']:.1f} s, {c['iterations']} iterations, {c['status']}")
    print("\nratios")
    for name, value in report["ratios"].items():
        print(f"{value:10.2f}  {name}")


def main() -> None:
    """Run all cases and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="leave out 1000 and 2000 frames and AcinoSet's")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each condensed case")
    parser.add_argument("--case", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.case:
        print(json.dumps(condensed_case(arguments.case, arguments.repeats)))
        return
    frames = CONDENSED[:2] if arguments.quick else CONDENSED
    report: dict[str, Any] = {
        "machine": f"{platform.platform()}, Python {platform.python_version()}",
        "condensed": [in_fresh_process(n, arguments.repeats) for n in frames],
        "explicit": explicit_case(EXPLICIT_FRAMES),
        "acinoset": None if arguments.quick else acinoset_case(ACINOSET_FRAMES),
    }
    report["ratios"] = ratios(report)
    show(report)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
