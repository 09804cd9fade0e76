"""One camera and a lidar: errors of the joints and seconds, for every way to associate returns.

    python benchmarks/bench_fusion.py [--seeds 3] [--frames 120]

Simulated recordings with the rig's defaults: 3 px, 15 % missing, 3 % outliers, 10 % of the returns on the
animal from something else, a surface 4 cm before the joints; 90 m at 2048 px and 50 m at 852 px. Besides
the lidar's scan, one return for every marker (``pseudo``, as a pseudo-RGB-D image gives). The last rows have
a body of the species' own radii, a calibration that is 0.5 mrad off, and a lidar that is 5 ms late. Ratios
are against the thesis's nearest return on the same recording. Seconds are of the whole estimate with its
covariance, after a first run that derives and compiles the formulas.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from acino_fte.estimate import EstimateOptions, estimate_fte
from acino_fte.kinematics import load_kinematics
from acino_fte.rig_options import RigOptions
from acino_fte.simulate_rig import rig_to_sequence, simulate_rig

PLACES: dict[str, dict[str, Any]] = {
    "90 m, 2048 px": {"distance": 90.0, "width": 2048},
    "50 m, 852 px": {"distance": 50.0, "width": 852},
}
FAULTS: dict[str, dict[str, Any]] = {
    "": {},
    "pseudo": {"lidar": "pseudo"},
    "own radii": {"body": "capsules"},
    "0.5 mrad off": {"lidar_turned_mrad": 0.5},
    "5 ms late": {"sync_ms": 5.0},
}
GOAL_MM, GOAL_P95_MM, GOAL_S = 25.0, 50.0, 2.0


def main() -> None:
    """Run, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=120)
    given = parser.parse_args()
    print(f"goals: mean {GOAL_MM:.0f} mm, 95 % {GOAL_P95_MM:.0f} mm, {GOAL_S:.0f} s for 120 frames")
    print(f"{'recording':28} {'association':11} {'mean':>6} {'95 %':>6} {'worst':>6} {'of thesis':>9} "
          f"{'wall s':>7} {'CPU s':>6}")  # fmt: skip
    for place, options in PLACES.items():
        for fault, extra in FAULTS.items():
            ways = ("nearest", "marker", "body", "none") if fault in ("", "pseudo") else ("nearest", "marker")
            thesis = 1.0
            for how in ways:
                runs = [
                    one({**options, **extra, "n_frames": given.frames, "seed": seed}, how)
                    for seed in range(given.seeds)
                ]
                mean, p95, wall, cpu = np.mean(runs, axis=0)
                thesis = mean if how == "nearest" else thesis
                print(
                    f"{', '.join(filter(None, (place, fault))):28} {how:11} {mean:6.1f} {p95:6.1f} "
                    f"{np.max(runs, axis=0)[0]:6.1f} {mean / thesis:8.2f}x {wall:7.2f} {cpu:6.2f}",
                    flush=True,
                )


def one(options: dict[str, Any], how: str) -> tuple[float, float, float, float]:
    """Mean error and 95th percentile, mm, seconds of the wall and of the processor."""
    simulation = simulate_rig(RigOptions(**options))
    sequence, kinematics = rig_to_sequence(simulation), load_kinematics(simulation.skeleton)
    settings = EstimateOptions(association=how)
    if how not in _WARM:
        _WARM.add(how)
        estimate_fte(sequence, kinematics, settings)
    began = time.perf_counter(), time.process_time()
    result = estimate_fte(sequence, kinematics, settings)
    wall, cpu = time.perf_counter() - began[0], time.process_time() - began[1]
    errors = 1e3 * np.linalg.norm(result.positions - simulation.positions, axis=-1)
    return float(errors.mean()), float(np.quantile(errors, 0.95)), wall, cpu


_WARM: set[str] = set()

if __name__ == "__main__":
    main()
