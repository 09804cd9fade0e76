"""What it costs to know the animal, the cameras and the uncertainty, beside the plain problem.

    python benchmarks/bench_parameters.py [SEQUENCE --species cheetah --fps 120 --frames 80:190] [--json FILE]

Without a sequence: a simulated gallop of 200 frames before six cameras that are late and have moved, of an
animal with its own proportions. From loaded detections to the result, wall-clock and processor seconds, the
shortest of three runs in this process after one to warm up (compiled programs). Ratios are to the plain
problem: the species' table of noise, no parameters, no covariance.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

ALL = ("scale", "delay", "extrinsics", "offsets")
REPEATS = 3


def recording(arguments: argparse.Namespace):  # noqa: ANN201
    """The sequence and its kinematics."""
    from acino_fte.cli_estimate import frame_range
    from acino_fte.data_tools.load import load_sequence
    from acino_fte.kinematics import load_kinematics
    from acino_fte.simulate import SimulationOptions, simulate, simulation_to_sequence
    from acino_fte.skeleton import load_skeleton

    if arguments.sequence is None:
        skeleton = load_skeleton("cheetah")
        options = SimulationOptions(
            n_frames=200, delay_ms=8, moved_mm=20, moved_deg=0.2, proportions=0.05, occlusion=False
        )
        return simulation_to_sequence(simulate(skeleton, options)), load_kinematics(skeleton)
    sequence = load_sequence(
        arguments.sequence,
        species=arguments.species,
        fps=arguments.fps,
        frames=frame_range(arguments.frames),
    )
    return sequence, load_kinematics(load_skeleton(sequence.species))


def timed(sequence, kinematics, options) -> dict[str, float]:  # noqa: ANN001
    """Shortest wall-clock and processor time of an estimate, s, and its iterations."""
    from acino_fte.estimate import estimate_fte

    estimate_fte(sequence, kinematics, options)
    runs = []
    for _ in range(REPEATS):
        wall, processor = time.perf_counter(), time.process_time()
        result = estimate_fte(sequence, kinematics, options)
        runs.append((time.perf_counter() - wall, time.process_time() - processor))
    return {
        "wall_s": min(w for w, _ in runs),
        "processor_s": min(p for _, p in runs),
        "iterations": result.iterations,
    }


def main() -> int:
    """Run all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sequence", nargs="?", type=Path)
    parser.add_argument("--species")
    parser.add_argument("--fps", type=float)
    parser.add_argument("--frames")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    from acino_fte.estimate import EstimateOptions

    sequence, kinematics = recording(arguments)
    cases = {
        "plain": EstimateOptions(fit=(), noise="table", swaps=False, covariance=False),
        "plain + covariance": EstimateOptions(fit=(), noise="table", swaps=False),
        "all parameters + covariance": EstimateOptions(fit=ALL, noise="table", swaps=False),
        "same, noise estimated": EstimateOptions(fit=ALL, swaps=False),
        "same, sides too": EstimateOptions(fit=ALL),
        "default": EstimateOptions(),
    }
    found = {name: timed(sequence, kinematics, options) for name, options in cases.items()}
    plain = found["plain"]
    write = sys.stdout.write
    write(f"{sequence.name}: {sequence.n_frames} frames, {len(sequence.cameras)} cameras\n")
    write(f"{'':30}{'wall s':>9}{'ratio':>8}{'cpu s':>9}{'ratio':>8}{'iterations':>12}\n")
    for name, case in found.items():
        wall, processor = case["wall_s"] / plain["wall_s"], case["processor_s"] / plain["processor_s"]
        write(
            f"{name:30}{case['wall_s']:9.2f}{wall:8.2f}{case['processor_s']:9.2f}{processor:8.2f}"
            f"{case['iterations']:12d}\n"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=2))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
