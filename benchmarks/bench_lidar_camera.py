"""Hand calibration on simulated picks: errors of held-out pairs against their noise floor and the bound.

``python benchmarks/bench_lidar_camera.py [RECORDINGS]``: for all targets, numbers of pairs and distances, the
RMSE of 60 held-out pairs over so many simulated recordings (12 unless told), divided by what the true cameras
give on the same pairs. Beside it the Cramér-Rao bound of that ratio for the same pairs and prior knowledge.
Picks: 1 px in the image, 2 cm in range.
"""

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.lidar_pairs import LidarPairs
from acino_fte.data_tools.lidar_solve import RIG, first_camera, known_before, solve_lidar_camera
from acino_fte.data_tools.lidar_solve_fit import at
from acino_fte.data_tools.lidar_solve_holdout import expected_rmse
from acino_fte.data_tools.lidar_solve_model import POSE, PickNoise
from acino_fte.data_tools.lidar_solve_simulate import RESOLUTION, TARGETS, SimulatedPicks, simulated_picks

DISTANCES = (5, 25, 50, 75, 100)
N_PAIRS = (12, 20, 40)
LIMIT = 1.2
NAMES = (*POSE, "log_f", "cx", "cy")


def square(camera: Camera, pairs: LidarPairs) -> float:
    """Mean square of the distances, px²."""
    return float(np.mean(((camera.project(pairs.xyz) - pairs.pixel) ** 2).sum(axis=1)))


def bound(picks: SimulatedPicks) -> tuple[float, float]:
    """Squares of noise floor and Cramér-Rao bound of the held-out pairs, px²."""
    priors = known_before(first_camera(RESOLUTION, None, "cam1", None), None, None, RIG)
    exact = at(picks.camera, NAMES, picks.pairs.pixel, picks.pairs.xyz, PickNoise(), priors)
    floor, reachable = expected_rmse(exact, picks.held_out.xyz, PickNoise())
    return floor**2, reachable**2


def cell(targets: str, n: int, distance: float, recordings: int) -> tuple[np.ndarray, float]:
    """Mean squares (4,) of estimate, truth, floor and bound; seconds a recording."""
    rows, seconds = [], 0.0
    for seed in range(recordings):
        picks = simulated_picks(distance, targets, n, seed)
        begun = time.process_time()
        found = solve_lidar_camera(picks.pairs, RESOLUTION)
        seconds += time.process_time() - begun
        rows.append(
            (square(found.camera, picks.held_out), square(picks.camera, picks.held_out), *bound(picks))
        )
    return np.mean(rows, axis=0), seconds / recordings


def main() -> None:
    """Print the table."""
    recordings = int(sys.argv[1]) if len(sys.argv) > 1 else 12
    print(f"RMSE of held-out pairs / noise floor (bound), {recordings} recordings; limit {LIMIT}")
    print("targets  pairs " + "".join(f"{d:>16d} m" for d in DISTANCES) + "   noise px   s")
    worst = 0.0
    for targets in TARGETS:
        for n in N_PAIRS:
            cells, floors, spent = [], [], 0.0
            for distance in DISTANCES:
                mean, seconds = cell(targets, n, float(distance), recordings)
                ratio, best = np.sqrt(mean[0] / mean[1]), np.sqrt(mean[3] / mean[2])
                worst = max(worst, ratio)
                cells.append(f"{ratio:8.3f} ({best:.3f}){'*' if ratio > LIMIT else ' '}")
                floors.append(np.sqrt(mean[1]))
                spent += seconds / len(DISTANCES)
            row = "".join(f"{text:>18s}" for text in cells)
            print(f"{targets:8s} {n:5d} {row}   {np.mean(floors):8.2f} {spent:5.2f}", flush=True)
    print(
        f"worst {worst:.3f}; * is beyond the limit. The thesis reports 20–118 px RMSE (here: noise × ratio)."
    )


if __name__ == "__main__":
    main()
