"""What a user waits for before anything is solved: imports, help, kinematics.

    python benchmarks/bench_small.py [--json bench_small.json]

Each figure is the median of several runs on this machine, with the largest value that is aimed for.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

AIMS = {
    "import acino_fte, s": 0.5,
    "acino-fte --help, s": 0.7,
    "acino-fte run --help, s": 0.7,
    "cheetah kinematics derived, s": 5.0,
    "cheetah kinematics from the cache, s": 0.2,
    "positions + Jacobian, 200 frames, ms": 4.0,
}

_LOAD = """
import time
from acino_fte.kinematics import load_kinematics
from acino_fte.skeleton import load_skeleton
skeleton = load_skeleton("cheetah")
began = time.perf_counter()
kinematics = load_kinematics(skeleton)
kinematics._positions, kinematics._twists
print(time.perf_counter() - began)
"""


def wall(command: list[str], runs: int = 7) -> float:
    """Median wall-clock seconds of a command, after one run to warm up."""
    seconds = []
    for _ in range(runs + 1):
        began = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds[1:])


def kinematics_seconds(cache: str) -> float:
    """Seconds to have compiled kinematics in a fresh process with the given cache."""
    environment = {**os.environ, "ACINO_FTE_CACHE": cache}
    done = subprocess.run(
        [sys.executable, "-c", _LOAD], check=True, capture_output=True, text=True, env=environment
    )
    return float(done.stdout)


def milliseconds(function: Callable[[], object], runs: int = 50) -> float:
    """Median milliseconds of a call."""
    function()
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return 1e3 * statistics.median(times)


def measure() -> dict[str, float]:
    """All figures."""
    import numpy as np

    from acino_fte.kinematics import load_kinematics
    from acino_fte.skeleton import load_skeleton

    kinematics = load_kinematics(load_skeleton("cheetah"))
    q = np.random.default_rng(0).normal(0.0, 0.3, (200, kinematics.n_dofs))
    with tempfile.TemporaryDirectory() as cache:
        derived = kinematics_seconds(cache)
        cached = statistics.median(kinematics_seconds(cache) for _ in range(5))
    python = [sys.executable, "-m", "acino_fte"]
    values = (
        wall([sys.executable, "-c", "import acino_fte"]),
        wall([*python, "--help"]),
        wall([*python, "run", "--help"]),
        derived,
        cached,
        milliseconds(lambda: kinematics.linearise(q)),
    )
    return dict(zip(AIMS, values, strict=True))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    figures = measure()
    for name, value in figures.items():
        print(f"{value:8.3f}  aim {AIMS[name]:4.1f}  {name}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
