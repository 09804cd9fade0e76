"""The animal as pivot on simulated recordings: error of the time of the frames against what is stated.

``python benchmarks/bench_strike.py [RECORDINGS]``: galloping cheetahs of 2 s, 90 m away in pictures of
2048 px and 50 m away in pictures of 852 px (3 px of noise, 15 % missing, 3 % outliers, 10 % background
returns), so many recordings each (12 unless told). Once the camera's delay is sought within 0.15 s, once the
lidar's clock is ahead by 3.7 s and all lags that have half of the frames are.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from acino_fte.data_tools.sync_animal import Glimpses, animal_lag
from acino_fte.data_tools.sync_outline import outline_of
from acino_fte.errors import InputError
from acino_fte.rig_options import RigOptions
from acino_fte.simulate_rig import RigSimulation, simulate_rig

CASES = ({"distance": 90.0, "width": 2048}, {"distance": 50.0, "width": 852})
LAGS = ((0.0371, (-0.15, 0.15)), (3.7, (2.7, 4.7)))


def glimpses(simulation: RigSimulation, lag: float) -> Glimpses:
    """The returns in the picture by a clock that is ahead by `lag`, s."""
    returns, (rotation, translation) = simulation.returns, simulation.lidar_to_camera
    assert returns is not None
    local = returns.xyz @ rotation.T + translation
    lens = replace(simulation.true_camera, rotation=np.eye(3), translation=np.zeros(3))
    pixel = lens.project(local)
    seen = lens.inside(pixel)
    return Glimpses(returns.time[seen] + lag, pixel[seen], local[seen, 2])


def main() -> None:
    """Print the table."""
    recordings = int(sys.argv[1]) if len(sys.argv) > 1 else 12
    print("metres  px    lag s   found      error ms: rms  most   stated: least  most   rms error/stated   s")
    for case in CASES:
        simulations = [simulate_rig(RigOptions(seed=seed, **case)) for seed in range(recordings)]
        for lag, lags in LAGS:
            rows, refused, spent = [], [], 0.0
            for simulation in simulations:
                found = simulation.detections
                seen = np.isfinite(found.position[:, 0]).all(axis=-1)
                frames = np.arange(simulation.options.n_frames) / simulation.options.fps
                begun = time.process_time()
                try:
                    outline = outline_of(frames, found.position[:, 0], np.where(seen, 0.9, 0.0))
                    one = animal_lag(outline, glimpses(simulation, lag), lags)
                    rows.append((1e3 * (one.lag - lag), 1e3 * one.sd))
                except InputError as error:
                    refused.append(str(error.found))
                spent += time.process_time() - begun
            error, sd = np.array(rows).T
            rms, ratio = np.sqrt(np.mean(error**2)), np.sqrt(np.mean((error / sd) ** 2))
            print(
                f"{case['distance']:6.0f} {case['width']:5d} {lag:7.3f} {len(rows):4d} of {recordings:<4d}"
                f"{rms:17.2f} {np.abs(error).max():5.2f} {sd.min():15.2f} {sd.max():5.2f} {ratio:15.2f}"
                f" {spent / recordings:9.1f}",
                flush=True,
            )
            for text in refused:
                print(f"        refused: {text}")


if __name__ == "__main__":
    main()
