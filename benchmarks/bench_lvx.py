"""A long LVX 1.1 recording of a Tele-15: peak memory and speed of reading, in a process of its own.

Run: python benchmarks/bench_lvx.py [--megabytes 1000]
Prints the peak resident memory against the bound of 300 MiB, the memory of a process that only imports the
reader, the speed, and how many times faster than the recording itself the file is written and read.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from acino_fte.data_tools.lvx_packets import LvxDevice
from acino_fte.data_tools.lvx_write import LvxWriter
from acino_fte.data_tools.recording import ImuSamples, LidarReturns

BOUND = 300.0  # MiB
STEP = 4_167
N = 24_000  # samples a frame
CHILD = """
import json, resource, sys, time
from acino_fte.data_tools.lvx import LvxReader
base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
start, n = time.perf_counter(), 0
with LvxReader(sys.argv[1]) as reader:
    for record in reader.records():
        n += len(record.value)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
damage = reader.damage
print(json.dumps([base, peak, time.perf_counter() - start, n, damage.n_read, damage.n_lost]))
"""


def write(path: Path, megabytes: float) -> tuple[int, float]:
    """Frames of 0.1 s, as WildPose's rig writes them; how many, and the seconds that it took."""
    rng = np.random.default_rng(0)
    zeros = np.zeros(N, np.uint8)
    xyz = rng.uniform([20, -5, -5], [100, 5, 5], (N, 3))
    samples = np.zeros((20, 3)), np.full((20, 3), 5.66)
    start, frames = time.perf_counter(), 0
    with LvxWriter(path, [LvxDevice(0, "3GGDJ6K00100101", 2)], frame_duration_ms=50) as writer:
        while frames * N / 96 * 1363 < megabytes * 1e6:
            lidar = frames * N * STEP + STEP * np.arange(N)
            imu = frames * 100_000_000 + 5_000_000 * np.arange(20)
            returns = LidarReturns(lidar, xyz, zeros + 50.0, zeros, zeros, "power_on")
            writer.write({"lidar0": returns, "imu0": ImuSamples(imu, *samples, "power_on")})
            frames += 1
    return frames, time.perf_counter() - start


def main() -> None:
    """Write, read, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--megabytes", type=float, default=1000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.lvx"
        frames, writing = write(path, options.megabytes)
        recorded, size = frames * N * STEP / 1e9, path.stat().st_size / 1e6
        out = subprocess.run([sys.executable, "-c", CHILD, str(path)], capture_output=True, check=True)
        base, peak, reading, n, n_read, n_lost = json.loads(out.stdout)
    print(f"{size:.0f} MB, {recorded:.0f} s of a Tele-15: {n_read} packages, {n} values, {n_lost} lost")
    print(f"peak {peak:.0f} MiB = {peak / BOUND:.2f} x the bound of {BOUND:.0f} (import alone: {base:.0f})")
    print(
        f"read in {reading:.1f} s: {size / reading:.0f} MB/s, {recorded / reading:.1f} x as fast as recorded"
    )
    print(f"written in {writing:.1f} s: {recorded / writing:.1f} x as fast as recorded")


if __name__ == "__main__":
    main()
